"""Delay and clocks for ground stations and recordings: the numbers, when they are told, and when they are not."""

from __future__ import annotations

import json
import re

import jsonschema
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autopilot import telemetry as module
from autopilot.app import AutopilotNode
from autopilot.clocksync import MIN_EXCHANGES, STALE_NS, ClockSync
from autopilot.config import AutopilotConfig
from autopilot.delay import UNKNOWN, DelayEstimate, DelayEstimator, DelayStatus
from autopilot.ground.vehicle import Vehicle
from autopilot.link.node import Record
from autopilot.link.record import decode_line, encode_line, schema_of
from autopilot.link.wire import Message, NamedValueFloat, NamedValueInt
from autopilot.telemetry import FORECAST_NS, MAX_ROUND_TRIPS, SECOND_NS, DelayTelemetry, Second, record
from tests.helpers import HIRM, MS, TS, S, parse

quick = settings(deadline=None, max_examples=50)
START = 1042 * S + 7
FORECAST = DelayEstimate(3, 2, 4, 0.96875, DelayStatus.ESTIMATED)
OFFSET_NS = 905 * S
PPM = 80


def synchronised(exchanges: int, until_ns: int = START, ppm: int = PPM) -> ClockSync:
    """Return a clock after exchanges at 10 Hz over 6 and 14 ms, the last received at ``until_ns``."""
    sync, down_ns, up_ns = ClockSync(), 6 * MS, 14 * MS
    for n in reversed(range(exchanges)):
        received_ns = until_ns - n * 100 * MS
        sent_ns = sync.request(received_ns - up_ns - down_ns)
        arrived_ns = sent_ns + down_ns
        sync.answer(arrived_ns + OFFSET_NS + (arrived_ns - START) * ppm // 1_000_000, sent_ns, received_ns)
    return sync


def scored(n: int, exact: float = 0.75, covered: float = 0.9375) -> DelayEstimator:
    """Return an estimator that has scored so many forecasts."""
    delay = DelayEstimator(TS)
    delay.scored, delay.exact, delay.covered = n, exact, covered
    return delay


class Telemetry(DelayTelemetry):
    """One whose periods have started at START, with a clock and an estimator that know nothing by default."""

    def __init__(self) -> None:
        super().__init__()
        self.clock, self.delay = ClockSync(), DelayEstimator(TS)
        assert self.at(START) == ([], [])

    def at(self, now_ns: int) -> tuple[list[Message], list[Record]]:
        return self.due(now_ns, self.clock, self.delay)

    def shown(self, now_ns: int) -> dict[str, int | float]:
        """Return what is shown at a time, by name; every message has that time's stamp, and no name comes twice."""
        messages, _ = self.at(now_ns)
        values = {m.name: m.value for m in messages if isinstance(m, NamedValueInt | NamedValueFloat)}
        assert len(values) == len(messages)
        assert all(m.time_boot_ms == now_ns // MS for m in messages)
        return values

    def body(self, now_ns: int) -> dict[str, object]:
        """Return the one record made at a time, as it reads in a recording."""
        [made] = self.at(now_ns)[1]
        assert (made.topic, made.t_ns) == ("autopilot/estimate", now_ns)
        body = json.loads(encode_line(made, 0))["body"]
        jsonschema.validate(body, dict(schema_of(made.topic)), jsonschema.Draft202012Validator)
        assert list(body) == schema_of(made.topic)["required"]
        return body


def everything() -> Telemetry:
    """Return one that has something to say under every name."""
    telemetry = Telemetry()
    telemetry.clock, telemetry.delay = synchronised(600), scored(9)
    telemetry.note_forecast(FORECAST)
    telemetry.note_report(2)
    telemetry.note_round_trip(20 * MS)
    return telemetry


# Forecasts


def test_the_newest_forecast_is_shown_every_200_ms():
    telemetry = Telemetry()
    seen = []
    for n in range(40):  # 1 s of samples
        telemetry.note_forecast(FORECAST._replace(d=100 + n))
        values = telemetry.shown(START + n * TS)
        if values:
            seen.append((n, values["D_EST"]))
    assert seen == [(n, 100 + n) for n in range(8, 40, 8)]


def test_a_forecast_is_shown_with_its_interval_and_its_probability_in_percent():
    telemetry = Telemetry()
    telemetry.note_forecast(FORECAST)
    assert telemetry.shown(START + FORECAST_NS) == {"D_EST": 3, "D_LOW": 2, "D_HIGH": 4, "D_PROB": 96.875}


def test_no_forecast_is_shown_twice():
    telemetry = Telemetry()
    telemetry.note_forecast(FORECAST)
    assert telemetry.shown(START + FORECAST_NS)
    assert telemetry.shown(START + 2 * FORECAST_NS) == {}


def test_an_unknown_delay_is_shown_as_nothing_and_not_as_the_one_before():
    telemetry = Telemetry()
    telemetry.note_forecast(FORECAST)
    telemetry.note_forecast(UNKNOWN)
    assert telemetry.shown(START + FORECAST_NS) == {}


@pytest.mark.parametrize(("high", "fits"), [((1 << 31) - 1, True), (1 << 31, False)])
def test_a_delay_that_no_message_can_hold_is_not_shown(high, fits):
    telemetry = Telemetry()
    telemetry.note_forecast(FORECAST._replace(high=high))
    assert bool(telemetry.shown(START + FORECAST_NS)) is fits


# Each second


def test_mean_and_greatest_of_the_reported_delays_are_those_of_the_last_second():
    telemetry = Telemetry()
    for d in (1, 2, 2, 6):
        telemetry.note_report(d)
    assert telemetry.shown(START + SECOND_NS) == {"D_MEAN": 2.75, "D_MAX": 6}
    telemetry.note_report(1)
    assert telemetry.shown(START + 2 * SECOND_NS) == {"D_MEAN": 1.0, "D_MAX": 1}
    assert telemetry.shown(START + 3 * SECOND_NS) == {}


def test_a_reported_delay_that_cannot_be_is_not_shown():
    telemetry = Telemetry()
    for d in (0, -1, -(1 << 31)):
        telemetry.note_report(d)
    assert telemetry.shown(START + SECOND_NS) == {}


def test_the_round_trip_is_the_median_of_the_last_second():
    telemetry = Telemetry()
    for ms in (21, 20, 900, 22, 23):
        telemetry.note_round_trip(ms * MS)
    assert telemetry.shown(START + SECOND_NS) == {"RTT_MS": 22.0}
    assert telemetry.shown(START + 2 * SECOND_NS) == {}


def test_a_flood_of_round_trips_and_reports_takes_no_memory():
    telemetry = Telemetry()
    most = 10 * MAX_ROUND_TRIPS
    for n in range(1, most + 1):
        telemetry.note_round_trip(n * MS)
        telemetry.note_report(n)
    assert len(telemetry._round_trips) == MAX_ROUND_TRIPS
    values = telemetry.shown(START + SECOND_NS)
    assert values["RTT_MS"] == most - MAX_ROUND_TRIPS // 2
    assert (values["D_MEAN"], values["D_MAX"]) == ((most + 1) / 2, most)


def test_the_share_of_right_forecasts_is_shown_in_percent_and_only_while_forecasts_are_scored():
    telemetry = Telemetry()
    assert telemetry.shown(START + SECOND_NS) == {}
    telemetry.delay = scored(4)
    assert telemetry.shown(START + 2 * SECOND_NS) == {"D_EXACT": 75.0, "D_COVER": 93.75}
    assert telemetry.shown(START + 3 * SECOND_NS) == {}
    telemetry.delay.scored += 1
    assert telemetry.shown(START + 4 * SECOND_NS) == {"D_EXACT": 75.0, "D_COVER": 93.75}


def test_the_clocks_are_not_shown_before_they_are_known():
    telemetry = Telemetry()
    telemetry.clock = synchronised(1)
    assert telemetry.shown(START + SECOND_NS).keys() == {"CLK_ERR_MS"}
    telemetry.clock = synchronised(MIN_EXCHANGES)
    assert telemetry.shown(START + 2 * SECOND_NS).keys() == {"CLK_ERR_MS", "CLK_PPM"}
    assert telemetry.shown(START + STALE_NS + SECOND_NS) == {}


def test_a_skew_of_0_is_shown_when_it_is_known_and_not_while_it_is_a_first_guess():
    telemetry = Telemetry()
    telemetry.clock = synchronised(MIN_EXCHANGES, ppm=0)
    assert "CLK_PPM" not in telemetry.shown(START + SECOND_NS)
    telemetry.clock = synchronised(1200, ppm=0)
    assert telemetry.shown(START + 2 * SECOND_NS)["CLK_PPM"] == pytest.approx(0.0, abs=1e-3)


def test_the_clocks_are_shown_with_an_error_that_holds_and_the_true_skew():
    telemetry = Telemetry()
    telemetry.clock = synchronised(600, START + SECOND_NS)
    now_ns = START + SECOND_NS
    values = telemetry.shown(now_ns)
    error_ns = telemetry.clock.estimate(now_ns).offset_ns - (OFFSET_NS + SECOND_NS * PPM // 1_000_000)
    assert abs(error_ns) / MS <= values["CLK_ERR_MS"] < 20.0  # never worse than one round trip
    assert values["CLK_PPM"] == pytest.approx(PPM, abs=1.0)


# Time


def test_the_first_call_starts_the_periods():
    telemetry = DelayTelemetry()
    telemetry.note_forecast(FORECAST)
    assert telemetry.next_deadline_ns() is None
    assert telemetry.due(START, ClockSync(), DelayEstimator(TS)) == ([], [])
    assert telemetry.next_deadline_ns() == START + FORECAST_NS


def test_nothing_is_said_between_deadlines():
    telemetry = everything()
    assert telemetry.at(START + FORECAST_NS - 1) == ([], [])


@quick
@given(st.lists(st.integers(0, 60).map(lambda n: n * 50 * MS), max_size=40))
def test_deadlines_stay_on_their_grid_and_lie_ahead_however_late_a_call_is(pauses_ns):
    telemetry, now_ns = Telemetry(), START
    for pause_ns in pauses_ns:
        before_ns, now_ns = now_ns - START, now_ns + pause_ns
        telemetry.note_forecast(FORECAST)
        messages, records = telemetry.at(now_ns)
        for found, period_ns in ((messages, FORECAST_NS), (records, SECOND_NS)):
            assert bool(found) is ((now_ns - START) // period_ns > before_ns // period_ns)
        assert len(records) <= 1
        deadline_ns = telemetry.next_deadline_ns()
        assert now_ns < deadline_ns <= now_ns + FORECAST_NS
        assert (deadline_ns - START) % FORECAST_NS == 0


# On the wire


def test_the_table_of_names_is_what_is_sent():
    telemetry, sent = everything(), {}
    messages = []
    for n in range(1, 6):
        telemetry.note_forecast(FORECAST)
        now, _ = telemetry.at(START + n * FORECAST_NS)
        messages += now
    for message in messages:
        kind = "int" if isinstance(message, NamedValueInt) else "float"
        sent.setdefault((message.name, kind), []).append(message)
    rows = re.findall(r"^([A-Z_]+) +(int|float) +(\d) ", module.__doc__, re.MULTILINE)
    assert {(name, kind): int(hz) for name, kind, hz in rows} == {key: len(each) for key, each in sent.items()}
    assert all(len(name) <= 10 for name, _ in sent)


def read(vehicle: Vehicle, until_ns: int) -> dict[str, list]:
    """Tick as with every sample, and return the named values that a station reads, by name."""
    found: dict[str, list] = {}
    for now_ns in range(until_ns - FORECAST_NS + TS, until_ns + 1, TS):
        vehicle.tick(now_ns, degraded=False)
        for m in (m for _, datagram in vehicle.outgoing() for m in parse(datagram)):
            if m.get_type() in ("NAMED_VALUE_INT", "NAMED_VALUE_FLOAT"):
                found.setdefault(m.name, []).append(m)
    return found


def started(now_ns: int) -> Vehicle:
    """Return the vehicle of an autopilot whose first heartbeat is gone."""
    vehicle = AutopilotNode(AutopilotConfig(HIRM)).vehicle
    vehicle.tick(now_ns, degraded=False)
    vehicle.outgoing()
    return vehicle


def test_a_ground_station_reads_name_value_and_our_time():
    telemetry, now_ns = everything(), START + SECOND_NS
    vehicle = started(now_ns)
    messages, _ = telemetry.at(now_ns)
    for message in messages:
        vehicle.show(message, now_ns)
    found = read(vehicle, now_ns + FORECAST_NS)
    assert len(found) == len(messages) == 11
    for ours in messages:
        [theirs] = found[ours.name]
        assert isinstance(ours, NamedValueInt) == (theirs.get_type() == "NAMED_VALUE_INT")
        assert theirs.time_boot_ms == now_ns // MS
        assert theirs.value == pytest.approx(ours.value, rel=1e-6)


def test_a_station_misses_none_of_the_numbers_and_gets_none_twice():
    telemetry, vehicle = everything(), started(START)
    shown: list[tuple[str, int]] = []
    got: list[tuple[str, int]] = []
    for n in range(1, 101):
        now_ns = START + n * FORECAST_NS
        telemetry.note_forecast(FORECAST)
        telemetry.note_report(2)
        for message in telemetry.at(now_ns)[0]:
            vehicle.show(message, now_ns)
            shown.append((message.name, now_ns // MS))
        got += [(m.name, m.time_boot_ms) for each in read(vehicle, now_ns + FORECAST_NS).values() for m in each]
    assert len(shown) > 400
    assert sorted(got) == sorted(shown)


def test_the_vehicle_stamps_a_named_float_on_our_clock():
    vehicle = started(START)
    vehicle.show(NamedValueFloat(7, "D_MEAN", 1.5), START)
    found = read(vehicle, START + FORECAST_NS)
    [m] = found.pop("D_MEAN")
    assert (m.get_type(), m.time_boot_ms, m.value) == ("NAMED_VALUE_FLOAT", START // MS, 1.5)
    assert found == {}


# Records


def test_what_is_unknown_is_null_in_the_record():
    body = Telemetry().body(START + SECOND_NS)
    assert {name for name, value in body.items() if value is None} == {
        *("offset_ns", "offset_bound_ns", "skew_ppb", "skew_bound_ppb", "round_trip_ns"),
        *("d_mean", "d_max", "exact", "covered"),
    }
    assert body["clock"] == "unsynchronised"
    assert [body[name] for name in ("changes", "shift_ns", "unmatched", "steps")] == [0, 0, 0, 0]


def test_the_record_says_what_is_shown():
    telemetry, now_ns = everything(), START + SECOND_NS
    for d, ms in ((2, 20), (5, 26)):
        telemetry.note_report(d)
        telemetry.note_round_trip(ms * MS)
    telemetry.delay.changes, telemetry.delay.shift_ns = 2, -3 * MS
    telemetry.clock.answer(1, 1, START)
    body, estimate = telemetry.body(now_ns), telemetry.clock.estimate(now_ns)
    assert body == {
        "offset_ns": estimate.offset_ns,
        "offset_bound_ns": estimate.bound_ns,
        "skew_ppb": estimate.skew_ppb,
        "skew_bound_ppb": estimate.skew_bound_ppb,
        "clock": "locked",
        "round_trip_ns": 20 * MS,
        "d_mean": 3.0,
        "d_max": 5,
        "exact": 0.75,
        "covered": 0.9375,
        "changes": 2,
        "shift_ns": -3 * MS,
        "unmatched": 1,
        "steps": 0,
    }


def test_there_is_one_record_each_second_whatever_is_known():
    telemetry = Telemetry()
    made = [r.t_ns for n in range(501) for r in telemetry.at(START + n * 10 * MS)[1]]
    assert made == [START + n * SECOND_NS for n in range(1, 6)]


@pytest.mark.parametrize("peer_ns", [-(1 << 63), (1 << 63) - 1])
def test_an_offset_beyond_64_bits_does_not_break_the_recording(peer_ns):
    clock = ClockSync()
    for n in range(MIN_EXCHANGES):
        clock.answer(peer_ns, clock.request(n * MS), n * MS + 1)
    now_ns = MIN_EXCHANGES * MS
    made = record(now_ns, Second(), clock, DelayEstimator(TS))
    read, _ = decode_line(encode_line(made, 0))
    jsonschema.validate(dict(read.body), dict(schema_of(read.topic)), jsonschema.Draft202012Validator)
    offset_ns = clock.estimate(now_ns).offset_ns
    assert read.body["offset_ns"] == (offset_ns if abs(offset_ns) < 1 << 63 else None)
    assert abs(offset_ns) == pytest.approx(1 << 63)
