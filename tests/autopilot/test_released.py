"""What changes hands: elevator, reference, gains, sticks and senders, each in a way in which that once went wrong."""

from __future__ import annotations

import math
import socket
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from pymavlink.dialects.v20 import all as dialect

import autopilot.__main__
import autopilot.app
from autopilot.link import signing
from autopilot.link.signing import Signing, Verdict
from autopilot.link.wire import AoaSsa, Attitude, NamedValueInt
from gains.definite import Verification
from gains.model import Schedule
from gains.store import load_gains
from gains.table import InputError
from tests.autopilot.bench import TREMBLE
from tests.autopilot.test_commands import ACCEPTED, ALONE, ARM, CUSTOM, FAILED, MODES, SET_MODE, STORAGE, Cockpit, X
from tests.autopilot.test_commands import cockpit as parked
from tests.autopilot.test_ground_flight import (
    GUIDED,
    MANUAL,
    TRAVEL,
    GroundFlight,
    attitude,
    every,
    long,
    mode,
    pitch_rate,
    put,
    stick,
)
from tests.autopilot.test_signing import KEY, NOW, SECOND, frame
from tests.helpers import LINE_CLOCK, MS, TS, S

D6 = load_gains("hirm-d6")
BARE = replace(D6, certificate=None)
THREE = Schedule(
    "three",
    D6.model,
    (
        replace(BARE, name="three[0]", d_max=2),
        replace(BARE, name="three[1]", d_min=2, d_max=3),
        replace(BARE, name="three[2]", d_min=3),
    ),
)
TWO = Schedule("two", D6.model, (replace(BARE, name="two[0]", d_max=5), replace(BARE, name="two[1]", d_min=5)))
"""Both cover the delays 1 to 6."""
LAST_INTERVAL_US = (1 << 31) - 1
"""The longest interval that MESSAGE_INTERVAL can tell."""
NO_JUMP = 1e-9
"""What the elevator may move when the law takes over, rad: rounding."""
UNUSABLE_NS = 160 * MS
"""Age of a sample whose command has the delay 7, outside the window."""
SPIKE = np.array([0.0, 0.0, 1.4])
"""A pitch that no aircraft has reached after four samples."""
NEUTRAL_US = 1500
TEMPORARILY_REJECTED = dialect.MAV_RESULT_TEMPORARILY_REJECTED


def flying(mode_name: str = "AUTO", **options) -> Cockpit:
    """Return a cockpit whose law flies, in a flight mode, its elevator unquantised."""
    options = {"wait_arm": False, "actuator": "float", **options}
    b = parked(**options).fly(20)
    assert b.mode == "TRACKING"
    if mode_name != "AUTO":
        assert b.result(SET_MODE, CUSTOM, MODES[mode_name]) == ACCEPTED
    return b


def pulse(us: int) -> dialect.MAVLink_message:
    return dialect.MAVLink_rc_channels_override_message(1, 1, 0, us, 0, 0, 0, 0, 0, 0)


def r_of(b: Cockpit, start: int = 0) -> np.ndarray:
    return np.array([c["r"][0] for c in b.commands[start:]])


# rates that fit their message


@pytest.mark.parametrize("rate_hz", [1e-4, 1e-30])
@pytest.mark.parametrize(("name", "message_id"), [("RATE_ATT", 30), ("RATE_POS", 33)])
def test_a_rate_however_small_has_an_interval_that_its_message_can_tell(name, message_id, rate_hz):
    b = parked().fly(2)
    b.put(name, rate_hz)
    answer = b.order(dialect.MAV_CMD_GET_MESSAGE_INTERVAL, float(message_id))
    [ack] = [m for m in answer if m.get_type() == "COMMAND_ACK"]
    [interval] = [m for m in answer if m.get_type() == "MESSAGE_INTERVAL"]
    assert (ack.result, interval.message_id) == (ACCEPTED, message_id)
    assert interval.interval_us == LAST_INTERVAL_US  # 1e-4 Hz would be more, too
    b.fly(2).to(b.now_ns + S)


# gains that change between a sample's command and the tick that follows


@pytest.mark.parametrize(("d", "gain_set"), [(3, 1), (4, 2)])
def test_gains_that_change_between_a_command_and_its_tick_take_its_set_for_none_of_theirs(monkeypatch, d, gain_set):
    monkeypatch.setattr(autopilot.app, "verified", lambda _law: Verification(True, 1.0, 0.0, ""))
    b = parked(gains=THREE, alternatives=(TWO,), wait_arm=False).fly(20, age_ns=d * TS - 5 * MS)
    assert (b.mode, b.commands[-1]["d"], b.commands[-1]["gain_set"]) == ("TRACKING", d, gain_set)
    j = b.commands[-1]["j"] + 1
    t_ns = b.t0_ns + j * TS
    b.to(t_ns + d * TS - 5 * MS)
    chosen = put("GAINS", 1.0).pack(b.stations["gcs0"])
    for port, datagram in [
        ("plant", b.wire.encode(Attitude(t_ns // MS, 0.0, X[2] + TREMBLE / 2, 0.0, 0.0, X[1] + TREMBLE / 2, 0.0))),
        ("plant", b.wire.encode(AoaSsa(t_ns // 1000, math.degrees(X[0]), 0.0))),
        ("gcs0", chosen),
    ]:
        b.node.receive(port, datagram, b.now_ns)
    assert b.node.next_deadline_ns() == 0  # the command has left, its tick is still to come
    assert b.node.pilot.gains is TWO
    b.to(b.now_ns)
    assert (b.commands[-1]["j"], b.commands[-1]["gain_set"]) == (j, gain_set)
    b.give(NamedValueInt((t_ns + d * TS) // MS, "DELAY_K", d))
    assert b.fly(20, age_ns=d * TS - 5 * MS, reported=d).mode == "TRACKING"
    assert [e["text"] for e in b.events if e["kind"] == "failsafe"][1:] == []
    assert {c["gain_set"] for c in b.commands[-20:]} == {0}


# the stick, and neutral, without samples


def dead_from(since_s: float) -> Callable[[int], int | None]:
    """Return a line of 20 ms that is cut at a time."""
    return lambda now_ns: 20 * MS if now_ns - LINE_CLOCK.offset_ns < since_s * S else None


def elevator(flight: GroundFlight, since_s: float, until_s: float) -> list[float]:
    """Return what the plant's elevator did, without repetitions, rad."""
    u = [t["u"][0] for t in flight.truth if since_s <= t["true_s"] < until_s]
    return [u[0], *(after for before, after in pairwise(u) if after != before)]


def test_in_manual_the_stick_goes_on_moving_the_elevator_although_no_state_comes():
    held = every(stick(-100), 2.1, 4.5), every(stick(60), 4.5, 6.0)
    flight = GroundFlight(8, [(2.0, mode(MANUAL))], *held, up=dead_from(3.0))
    assert flight.commands[-1]["true_s"] < 3.1
    assert elevator(flight, 2.3, 4.5) == [pytest.approx(-0.1 * TRAVEL)]
    assert elevator(flight, 4.6, 6.9) == [pytest.approx(0.06 * TRAVEL)]
    assert elevator(flight, 7.1, 7.9) == [0.0]  # the stick has been silent for a second
    assert len(flight.told("no state for 4 samples, manual control")) == 1


@pytest.mark.parametrize("since", [0.5, 1.5, 10.0])
@pytest.mark.parametrize("mode_name", ["MANUAL", "STABILIZE"])
def test_disarmed_the_plant_has_neutral_within_a_sample_although_no_sample_comes(mode_name, since):
    b = flying(mode_name, actuator="pwm")
    b.hear(stick(-300)).fly(5)
    assert b.u != 0.0
    b.to(b.now_ns + round(since * TS))
    start = len(b.messages)
    b.hear(long(ARM, 0.0))
    b.to(b.now_ns + TS)
    sent = [m.servo2_raw for port, m in b.messages[start:] if (port, m.get_type()) == ("plant", "SERVO_OUTPUT_RAW")]
    assert sent
    assert set(sent) == {NEUTRAL_US}


# from the stick to the law


@pytest.mark.parametrize("bad", ["late", "spikes"])
@pytest.mark.parametrize("count", [0, 1, 4])
def test_the_law_takes_over_from_the_stick_without_a_jump_after_samples_that_none_can_fly_on(count, bad):
    b = flying("MANUAL")
    b.hear(stick(-100)).fly(10)
    assert b.u == pytest.approx(-0.1 * TRAVEL)
    start = len(b.commands)
    assert b.result(SET_MODE, CUSTOM, MODES["STABILIZE"]) == ACCEPTED
    for n in range(count):
        if bad == "late":
            b.fly(1, age_ns=UNUSABLE_NS)
        else:
            b.fly(1, X + (-1) ** n * SPIKE)
    assert {c["mode"] for c in b.commands[start:]} <= {"STANDBY"}
    b.fly(20)
    modes = [c["mode"] for c in b.commands[start - 1 :]]
    at = start - 1 + modes.index("TRACKING")
    before, first = b.commands[at - 1], b.commands[at]
    assert abs(first["u"][0] - before["u"][0]) < NO_JUMP
    unmatched = float((ALONE.K1 @ np.array(first["x"]))[0])
    assert abs(unmatched - before["u"][0]) > 0.01  # so much would it have been from a reference at rest


# setpoints


def test_delays_far_outside_the_window_hold_no_setpoint_back_longer_than_the_window_asks():
    slow = lambda now_ns: (1000 if 3.0 <= (now_ns - LINE_CLOCK.offset_ns) / S < 7.0 else 20) * MS  # noqa: E731
    times = np.arange(2.5, 11.0, 0.31)
    setpoints = [(float(t_s), attitude(1.0 + n % 2)) for n, t_s in enumerate(times)]
    flight = GroundFlight(12, [(2.0, mode(GUIDED))], setpoints, gains=ALONE, down=slow)
    assert max(c["d"] for c in flight.commands if c["d"] is not None) > 35
    assert {c["mode"] for c in flight.commands} >= {"TRACKING", "NEUTRAL"}
    for t_s, message in setpoints:
        wanted = pytest.approx(2.0 * math.asin(message.q[2]), abs=1e-6)
        given = next(n for n, c in enumerate(flight.commands) if c["true_s"] > t_s)
        reached = next(n for n, c in enumerate(flight.commands[given:], given) if c["r"][0] == wanted)
        assert flight.commands[reached]["j"] - flight.commands[given]["j"] <= ALONE.d_max + 2


@pytest.mark.parametrize(("rate_deg_s", "saturation_ns"), [(30.0, 0), (-30.0, 0), (30.0, S)])
def test_a_pitch_rate_for_20_s_takes_the_reference_to_no_more_than_upright(rate_deg_s, saturation_ns):
    b = flying("GUIDED", saturation_ns=saturation_ns)
    for _ in range(50):
        b.hear(pitch_rate(rate_deg_s)).fly(16)
    r = math.copysign(1.0, rate_deg_s) * r_of(b)
    assert r.min() == 0.0
    assert r.max() <= math.pi / 2
    if saturation_ns == 0:
        assert r[-1] == pytest.approx(math.pi / 2)
        assert {c["mode"] for c in b.commands} == {"TRACKING"}


def kept_moving(b: Cockpit, chunks: int, let: Callable[[], object]) -> None:
    """Let something happen again and again, while a stream asks for 1 degree per second."""
    for _ in range(chunks):
        b.hear(pitch_rate(1.0))
        let()


MOVE = math.radians(1.0) * 0.025
"""What the reference moves per sample at 1 degree per second, rad."""


@pytest.mark.parametrize("case", ["late", "spikes", "silence"])
def test_a_pitch_rate_moves_nothing_while_failsafe_has_the_elevator(case):
    b = flying("GUIDED")
    kept_moving(b, 10, lambda: b.fly(4))
    assert np.diff(r_of(b)[-20:]) == pytest.approx(MOVE)
    start = len(b.commands)
    bad: dict[str, Callable[[], object]] = {
        "late": lambda: b.fly(4, age_ns=UNUSABLE_NS),
        "spikes": lambda: [b.fly(1, X + sign * SPIKE) for sign in (1, -1, 1, -1)],
        "silence": lambda: b.to(b.now_ns + 4 * TS),
    }
    kept_moving(b, 20, bad[case])
    assert b.mode == "NEUTRAL"
    kept_moving(b, 1, lambda: b.fly(1))
    assert b.mode == "NEUTRAL"
    # d_max samples may pass until failsafe has the elevator, and so many more are promised by then
    assert np.ptp(r_of(b, start - 1)) <= (2 * ALONE.d_max + 2) * MOVE
    kept_moving(b, 5, lambda: b.fly(4))
    assert b.mode == "TRACKING"
    assert np.diff(r_of(b)[-10:]) == pytest.approx(MOVE)


# a frozen sensor


def test_other_gains_do_not_make_a_frozen_sensor_look_fresh():
    b = flying(alternatives=(D6,))
    stuck = np.array([0.02, 0.0, 0.05])
    still = lambda: b.fly(1, stuck - (b.commands[-1]["j"] + 1) % 2 * TREMBLE)  # noqa: E731
    while b.mode == "TRACKING":
        assert len(b.commands) < 100
        still()
    assert any("frozen" in text for text in b.transitions())
    assert b.put("GAINS", 1.0) == 1.0
    assert b.node.pilot.gains is D6
    start = len(b.commands)
    for _ in range(10):
        still()
    assert "TRACKING" not in {c["mode"] for c in b.commands[start:]}
    assert b.fly(6, stuck).mode == "TRACKING"


# certificates


NOTHING_KEPT, PAPER_KEPT, D4_KEPT = "", 'GAINS = "hirm-paper"\n', 'GAINS = "hirm-d4"\n'


@pytest.mark.parametrize(
    ("gains", "alternative", "kept"),
    [
        ("hirm-d4", "hirm-paper", NOTHING_KEPT),
        ("hirm-d4", "hirm-paper", PAPER_KEPT),
        ("hirm-paper", "hirm-d4", D4_KEPT),
    ],
    ids=["an alternative", "the one that the parameters choose", "the one that the parameters leave"],
)
def test_where_certificates_are_required_every_law_that_may_be_chosen_has_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, gains: str, alternative: str, kept: str
):
    (tmp_path / "kept.toml").write_text(kept)

    def refuse(*_arguments: object, **_more: object) -> None:
        raise AssertionError("a socket was opened although a certificate is missing")

    monkeypatch.setattr(socket, "socket", refuse)
    line = ["--gcs", "none", "--gains", gains, "--alternative", alternative, "--require-certificate"]
    line += ["--parameters", str(tmp_path / "kept.toml")]
    refused = CliRunner().invoke(autopilot.__main__.cli, line).exception
    assert isinstance(refused, InputError), refused
    assert str(refused).startswith("gains hirm-paper: no verified certificate ")
    assert str(refused).endswith("but --require-certificate")


# signatures


def heard(end: Signing, seconds: float, **how) -> Verdict:
    """Let a frame of the sender's time come now."""
    return end.check(frame(NOW + round(seconds * SECOND), **how))


@pytest.mark.parametrize(("late_s", "verdict"), [(59.9, Verdict.ACCEPTED), (61.0, Verdict.TOO_OLD)])
def test_a_frame_that_nothing_newer_overtook_is_taken_for_a_minute_and_then_no_more(late_s, verdict):
    end = Signing(KEY, 0, NOW)
    for second in range(10):
        end.tick(second * S)
        assert heard(end, second) is Verdict.ACCEPTED
    end.tick(round((9.5 + late_s) * S))
    assert heard(end, 9.5) is verdict
    end.tick(100 * S)
    assert heard(end, 100) is Verdict.ACCEPTED  # the stream itself goes on


def test_a_frame_kept_back_for_more_than_a_minute_is_refused_although_few_newer_ones_came():
    end = Signing(KEY, 0, NOW)
    for second in (0, 1, 3, 4):
        end.tick(second * S)
        assert heard(end, second) is Verdict.ACCEPTED
    end.tick(65 * S)
    assert heard(end, 2) is Verdict.TOO_OLD


@pytest.mark.parametrize("accepting", [False, True])
def test_whether_an_unsigned_frame_would_be_accepted_is_known_without_a_copy(monkeypatch, accepting):
    def refuse(_value: object) -> None:
        raise AssertionError("copied for a stranger")

    monkeypatch.setattr(signing, "deepcopy", refuse)
    end = Signing(KEY, 0, NOW, accept_unsigned=accepting)
    plain = dialect.MAVLink_timesync_message(1, 2)
    for version in (False, True):
        assert end.would_accept(plain.pack(dialect.MAVLink(None, 1, 25), force_mavlink1=version)) is accepting
    assert not end.counts


# two stations


def two(mode_name: str, *, same_ids: bool) -> Cockpit:
    b = flying(mode_name, ground_stations=2)
    b.stations["gcs1"] = dialect.MAVLink(None, 255 if same_ids else 254, 190)
    return b


def wish(b: Cockpit, mode_name: str) -> float:
    """Return where the stick is at the newest command, as a part of its reach."""
    newest = b.commands[-1]
    reach = -TRAVEL if mode_name == "MANUAL" else b.node.commander.stick_rad  # more elevator pitches down
    return float((newest["u"] if mode_name == "MANUAL" else newest["r"])[0]) / reach


@pytest.mark.parametrize("same_ids", [False, True])
@pytest.mark.parametrize("mode_name", ["MANUAL", "STABILIZE"])
def test_the_first_of_two_stations_has_the_stick_until_it_falls_silent(mode_name, same_ids):
    b = two(mode_name, same_ids=same_ids)
    start = len(b.messages)
    b.hear(stick(-100)).fly(8)
    for _ in range(6):
        b.hear(stick(400), port="gcs1").hear(stick(-100)).hear(pulse(1200), port="gcs1").fly(8)
        assert wish(b, mode_name) == pytest.approx(0.1)
    assert b.statements(start).count(f"{mode_name}: another station has the stick") == 1
    silent_ns = b.hear(stick(-100)).now_ns
    while b.now_ns < silent_ns + 900 * MS:
        b.hear(stick(400), port="gcs1").fly(1)
    assert wish(b, mode_name) == pytest.approx(0.1)
    while b.now_ns < silent_ns + 1300 * MS:
        b.hear(stick(400), port="gcs1").fly(1)
    assert wish(b, mode_name) == pytest.approx(-0.4)
    b.hear(stick(-100)).fly(8)
    assert wish(b, mode_name) == pytest.approx(-0.4)


@pytest.mark.parametrize("mode_name", ["MANUAL", "STABILIZE"])
def test_a_stick_that_is_given_back_is_free_at_once_and_nobody_is_missed(mode_name):
    b = two(mode_name, same_ids=False)
    b.hear(pulse(1600)).fly(8)
    b.hear(pulse(0), port="gcs1").fly(8)  # which has nothing to give back
    assert wish(b, mode_name) == pytest.approx(0.2)
    start = len(b.messages)
    b.hear(pulse(0)).fly(8)
    assert wish(b, mode_name) == 0.0
    b.fly(60)  # longer than a stick may be silent
    b.hear(pulse(1600)).fly(8).hear(pulse(0))
    b.hear(stick(400), port="gcs1").fly(8)
    assert wish(b, mode_name) == pytest.approx(-0.4)
    assert b.statements(start) == []


# storage


def test_storage_is_refused_for_a_while_when_it_is_asked_for_more_than_five_times_in_a_second():
    b = parked().fly(2)
    b.to(b.now_ns + 2 * S)
    results = []
    for n in range(8):
        results.append(b.result(STORAGE, float(n % 2)))
        b.to(b.now_ns + 100 * MS)
    assert results == [FAILED] * 5 + [TEMPORARILY_REJECTED] * 3  # without a file the first ones fail
    b.to(b.now_ns + S)
    assert b.result(STORAGE, 1.0) == FAILED
