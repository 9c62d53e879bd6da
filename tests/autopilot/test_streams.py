"""Rates: the grid of one stream against a plain count, and what three stations with rates of their own see."""

from __future__ import annotations

from collections import Counter
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as dialect

from autopilot.ground.streams import MIN_INTERVAL_NS, RATE_PARAMETERS, STREAMED, Streams, interval_of
from autopilot.link.groundmessages import AttitudeTarget, SysStatus
from autopilot.link.messages import Attitude, VfrHud
from autopilot.link.wire import VfrHud as AirFrame
from autopilot.link.wire import Wire
from tests.autopilot.test_commands import ACCEPTED, DENIED, UNSUPPORTED, Cockpit, cockpit, long
from tests.helpers import MS, TS, S

quick = settings(deadline=None)
SET, GET, REQUEST = 511, 510, 512
GROUPS = {
    "RAW_SENSORS": set(),
    "EXTENDED_STATUS": {"SYS_STATUS"},
    "RC_CHANNELS": {"SERVO_OUTPUT_RAW"},
    "POSITION": {"GLOBAL_POSITION_INT"},
    "EXTRA1": {"ATTITUDE", "AOA_SSA", "ATTITUDE_TARGET"},
    "EXTRA2": {"VFR_HUD"},
    "EXTRA3": {"NAMED_VALUE_INT", "NAMED_VALUE_FLOAT"},
}
DEFAULT_HZ = {"ATTITUDE": 20, "AOA_SSA": 10, "SERVO_OUTPUT_RAW": 10, "ATTITUDE_TARGET": 5, "VFR_HUD": 5}
DEFAULT_HZ |= {"GLOBAL_POSITION_INT": 2, "SYS_STATUS": 1, "HEARTBEAT": 1}


# one stream


def streams(interval_ns: int | None, start_ns: int = 0) -> Streams:
    """Return streams of which SYS_STATUS, which is made when it is due, has an interval."""
    made = Streams({}, {SysStatus})
    made.start(start_ns)
    made.ask(SysStatus, interval_ns, start_ns)
    return made


def served(made: Streams, until_ns: int, lateness: list[int] | None = None) -> list[int]:
    """Return when SYS_STATUS was sent: whenever it was due, and so much later each time."""
    late, times = list(lateness or []), []
    while made.next_ns is not None and made.next_ns <= until_ns:
        now_ns = made.next_ns + (late.pop(0) if late else 0)
        assert list(made.to_make(now_ns)) == [SysStatus]
        assert made.is_due(SysStatus, now_ns)
        made.sent(SysStatus, now_ns)
        times.append(now_ns)
    return times


intervals = st.integers(MIN_INTERVAL_NS, 100 * S)
starts = st.integers(0, 10**15)


@quick
@given(intervals, starts, st.integers(1, 300))
def test_a_stream_served_in_time_leaves_at_every_multiple_of_its_interval_and_never_else(interval_ns, start_ns, count):
    times = served(streams(interval_ns, start_ns), start_ns + count * interval_ns)
    assert times == [n * interval_ns for n in range(start_ns // interval_ns + 1, start_ns // interval_ns + 1 + count)]


@quick
@given(intervals, st.lists(st.floats(0.0, 0.999), max_size=100))
def test_lateness_of_less_than_an_interval_costs_no_message_and_does_not_add_up(interval_ns, parts):
    late = [int(part * interval_ns) for part in parts]
    times = served(streams(interval_ns), (len(late) + 3) * interval_ns, late)
    assert [t_ns // interval_ns for t_ns in times[: len(late)]] == list(range(1, len(late) + 1))
    assert len(times) == len(late) + 3


@quick
@given(intervals, st.integers(1, 10**6))
def test_a_pause_is_not_made_up_for(interval_ns, missed):
    made = streams(interval_ns)
    after_ns = interval_ns + missed * interval_ns + interval_ns // 3
    made.sent(SysStatus, after_ns)
    assert made.next_ns is not None
    assert after_ns - interval_ns < made.next_ns <= after_ns + interval_ns
    assert made.next_ns % interval_ns == 0


@pytest.mark.parametrize("hz", [0.1, 1.0, 3.0, 7.0, 29.97])
def test_two_hours_are_two_hours_of_messages(hz):
    interval_ns = interval_of(hz)
    assert interval_ns is not None
    assert abs(Fraction(interval_ns) - Fraction(S) / Fraction(hz)) <= Fraction(1, 2)
    assert len(served(streams(interval_ns), 7200 * S)) == 7200 * S // interval_ns


@pytest.mark.parametrize(("hz", "interval_ns"), [(0.0, None), (-1.0, None), (100.0, 10 * MS), (1e9, 10 * MS)])
def test_a_rate_of_0_is_off_and_none_is_above_100_hz(hz, interval_ns):
    assert interval_of(hz) == interval_ns


def test_a_stream_that_is_off_wakes_nobody_and_is_never_due():
    made = streams(None)
    assert made.next_ns is None
    assert not made.is_due(SysStatus, 10**18)
    assert made.to_make(10**18) == ()


def test_only_messages_that_are_made_when_due_wake_somebody():
    made = Streams({Attitude: 20.0, AttitudeTarget: 5.0}, {AttitudeTarget})
    made.start(0)
    assert made.next_ns == 200 * MS
    assert [made.is_due(Attitude, t_ns) for t_ns in (50 * MS - 1, 50 * MS)] == [False, True]
    assert made.to_make(200 * MS - 1) == ()
    assert list(made.to_make(200 * MS)) == [AttitudeTarget]


def test_messages_that_are_due_together_are_made_in_the_order_of_the_table():
    made = Streams(dict.fromkeys(STREAMED.values(), 1.0), STREAMED.values())
    made.start(0)
    assert list(made.to_make(2 * S)) == [each for each in STREAMED.values() if made.is_due(each, 2 * S)]


def test_a_default_counts_where_nothing_was_asked_for():
    made = Streams({Attitude: 20.0, VfrHud: 5.0}, ())
    made.start(0)
    made.ask(VfrHud, 40 * MS, 0)
    made.set_default(Attitude, 4.0, 0)
    made.set_default(VfrHud, 4.0, 0)
    assert (made.interval_ns(Attitude), made.interval_ns(VfrHud)) == (250 * MS, 40 * MS)
    made.ask_default(VfrHud, 0)
    assert made.interval_ns(VfrHud) == 250 * MS
    made.ask(Attitude, None, 0)
    made.set_default(Attitude, 9.0, 0)
    assert made.interval_ns(Attitude) is None


def test_each_message_that_has_a_rate_parameter_can_be_streamed():
    assert set(RATE_PARAMETERS.values()) <= set(STREAMED.values())
    assert {dialect.mavlink_map[number].msgname for number in STREAMED} >= set().union(*GROUPS.values())


# three stations


class Air(Cockpit):
    """A cockpit whose samples come with VFR_HUD."""

    def seconds(self, count: int) -> None:
        """Fly so many seconds from a whole second of our clock on."""
        plant = Wire((1, 25), None)
        for _ in range(count * S // TS):
            self.fly(1)
            self.node.receive("plant", plant.encode(AirFrame(100.0, 100.0, 90, 0, 1600.0, 0.0)), self.now_ns)
            self.take()
        self.to(self.now_ns + TS - MS)

    def counts(self, port: str, start: int) -> Counter[str]:
        return Counter(m.get_type() for m in self.heard(port, start))


def stations() -> Air:
    b = Air(cockpit(ground_stations=3).config)
    b.seconds(2)
    return b


@pytest.mark.parametrize("group", [*GROUPS, "ALL"])
def test_a_group_is_asked_for_and_stopped_by_each_station_for_itself(group):
    b = stations()
    number = getattr(dialect, f"MAV_DATA_STREAM_{group}")
    b.hear(dialect.MAVLink_request_data_stream_message(1, 1, number, 4, 1), port="gcs0")
    b.hear(dialect.MAVLink_request_data_stream_message(1, 1, number, 4, 0), port="gcs1")
    start = len(b.messages)
    b.seconds(4)
    members = set().union(*GROUPS.values()) if group == "ALL" else GROUPS[group]
    for kind, default_hz in DEFAULT_HZ.items():
        found = [b.counts(port, start)[kind] / 4 for port in b.stations]
        assert found == ([4, 0, default_hz] if kind in members else [default_hz] * 3), kind


@pytest.mark.parametrize("kind", [kind for kind in DEFAULT_HZ if kind != "HEARTBEAT"])
def test_an_interval_is_each_station_s_own_and_goes_back_to_the_default(kind):
    b = stations()
    number = getattr(dialect, f"MAVLINK_MSG_ID_{kind}")
    b.hear(long(SET, number, 200_000.0), port="gcs0")
    b.hear(long(SET, number, -1.0), port="gcs1")
    for port, expected_us in (("gcs0", 200_000), ("gcs1", -1), ("gcs2", 1_000_000 // DEFAULT_HZ[kind])):
        [told] = [m for m in b.order(GET, number, port=port) if m.get_type() == "MESSAGE_INTERVAL"]
        assert (told.message_id, told.interval_us) == (number, expected_us)
    start = len(b.messages)
    b.seconds(2)
    assert [b.counts(port, start)[kind] for port in b.stations] == [10, 0, 2 * DEFAULT_HZ[kind]]
    for port in ("gcs0", "gcs1"):
        b.hear(long(SET, number, 0.0), port=port)
    start = len(b.messages)
    b.seconds(2)
    assert [b.counts(port, start)[kind] for port in b.stations] == [2 * DEFAULT_HZ[kind]] * 3


def test_answers_about_rates_go_to_the_asker_alone():
    b = stations()
    start = len(b.messages)
    b.hear(long(GET, 30.0), long(REQUEST, 30.0), port="gcs1")
    assert [m.get_type() for m in b.heard("gcs1", start)] == [
        *("COMMAND_ACK", "MESSAGE_INTERVAL", "COMMAND_ACK", "ATTITUDE"),
    ]
    assert b.heard("gcs0", start) == b.heard("gcs2", start) == []


@pytest.mark.parametrize(
    ("number", "interval_us", "result"),
    [
        (30.0, -2.0, DENIED),
        (30.0, 3e9, DENIED),
        (30.0, 1.0, ACCEPTED),
        (0.0, 1e6, UNSUPPORTED),
        (24.0, 1e6, UNSUPPORTED),
        (-1.0, 1e6, UNSUPPORTED),
        (1e9, 1e6, UNSUPPORTED),
    ],
)
def test_intervals_that_cannot_be_are_refused(number, interval_us, result):
    b = cockpit().fly(1)
    assert b.result(SET, number, interval_us) == result


@pytest.mark.parametrize(("number", "interval_us"), [(24, 0), (65_535, 0), (0, 0), (30, 50_000)])
def test_what_is_not_to_be_had_has_the_interval_0(number, interval_us):
    b = cockpit().fly(1)
    ack, told = b.order(GET, number)
    assert (ack.result, told.message_id, told.interval_us) == (ACCEPTED, number, interval_us)


def test_an_interval_of_a_message_that_no_number_can_name_is_denied():
    b = cockpit().fly(1)
    for number in (-1.0, 65_536.0, 3e38):
        assert b.result(GET, number) == DENIED


def test_wild_requests_of_streams_raise_nothing_and_leave_the_other_station_alone():
    b = stations()
    rng = np.random.default_rng(2)
    for _ in range(300):
        stream, rate, on = (int(rng.integers(n)) for n in (256, 65_536, 256))
        b.hear(dialect.MAVLink_request_data_stream_message(1, 1, stream, rate, on), port="gcs0")
        b.hear(long(SET, float(rng.integers(-10, 500)), float(rng.choice([-1, 0, 1, 1e4, 1e12]))), port="gcs0")
    start = len(b.messages)
    b.seconds(2)
    assert {kind: b.counts("gcs1", start)[kind] / 2 for kind in DEFAULT_HZ} == DEFAULT_HZ
    assert max(b.counts("gcs0", start)[kind] / 2 for kind in DEFAULT_HZ) <= 100
