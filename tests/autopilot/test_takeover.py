"""Who has the elevator when hands change under bad samples, and what a station may ask for without harm to it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as dialect

from tests.autopilot.test_commands import ACCEPTED, ALONE, ARM, SET_MODE, STORAGE, Cockpit, cockpit
from tests.helpers import MS, TS, S

MANUAL, STABILIZE, GUIDED = 0, 2, 15
REJECTED = dialect.MAV_RESULT_TEMPORARILY_REJECTED
SAVE = 1.0
LATE_NS = 9 * TS
"""A state so old that its command is outside every window."""


def armed(mode: int, **options) -> Cockpit:
    b = cockpit(**options).fly(40, reported=1)
    assert b.result(ARM, 1.0) == ACCEPTED
    assert b.result(SET_MODE, 1.0, mode) == ACCEPTED
    return b


def stick(x: int) -> dialect.MAVLink_message:
    return dialect.MAVLink_manual_control_message(1, x, 0, 0, 0, 0)


@pytest.mark.parametrize("bad", [0, 1, 4])
def test_a_law_takes_over_from_the_hand_without_a_jump_also_after_samples_that_none_could_fly_on(bad):
    b = armed(MANUAL)
    b.hear(stick(0)).fly(5, reported=1)
    assert b.u == 0.0
    b.result(SET_MODE, 1.0, STABILIZE)
    before = len(b.commands)
    b.fly(bad, age_ns=LATE_NS)
    assert {c["mode"] for c in b.commands[before:]} <= {"STANDBY"}
    b.fly(8, reported=1)
    flown = [c for c in b.commands[before:] if c["mode"] == "TRACKING"]
    assert flown
    assert abs(flown[0]["u"][0]) < 1e-6


def test_a_stick_in_manual_moves_the_elevator_also_while_no_state_comes():
    b = armed(MANUAL)
    b.hear(stick(-1000)).fly(3, reported=1)
    held = b.u
    assert abs(held) > 0.1
    start = len(b.messages)
    for _ in range(20):
        b.to(b.now_ns + 20 * MS)
        b.hear(stick(-1000))
    pulses = [m.servo2_raw for port, m in b.messages[start:] if (port, m.get_type()) == ("plant", "SERVO_OUTPUT_RAW")]
    assert len(pulses) > 5
    assert set(pulses) == {b.node.pilot.travel.to_pwm(held)}
    assert any("no state" in text for text in b.statements(start))


def test_a_disarmed_elevator_is_neutral_within_a_sample_also_while_no_state_comes():
    b = armed(GUIDED)
    b.fly(3, np.array([0.05, 0.0, 0.1]), reported=1)
    assert b.u != 0.0
    start, at_ns = len(b.messages), b.now_ns
    assert b.result(ARM, 0.0) == ACCEPTED
    b.to(at_ns + TS)
    pulses = [m.servo2_raw for port, m in b.messages[start:] if (port, m.get_type()) == ("plant", "SERVO_OUTPUT_RAW")]
    assert pulses
    assert set(pulses) == {1500}


def test_a_pitch_rate_never_takes_the_reference_beyond_upright_and_rests_while_no_law_flies():
    b = armed(GUIDED)
    up = dialect.MAVLink_set_attitude_target_message(0, 1, 1, 128 | 1 | 4 | 64, [1, 0, 0, 0], 0.0, 0.2, 0.0, 0.0)
    for _ in range(800):
        b.hear(up).fly(1, reported=1)
    r = np.array([c["r"][0] for c in b.commands])
    assert r.max() <= math.pi / 2
    assert r.max() > 0.5
    resting = [c["r"][0] for c in b.commands[-100:] if c["mode"] in ("HOLD", "NEUTRAL")]
    assert not resting or max(resting) - min(resting) < 0.2 * 10 * TS / S


@pytest.mark.parametrize("rate_hz", [1e-4, 1e-30])
def test_the_slowest_rate_still_has_an_interval_that_can_be_told(rate_hz):
    b = cockpit().fly(4, reported=1)
    for name, number in (("RATE_ATT", 30), ("RATE_POS", 33)):
        b.put(name, rate_hz)
        b.to(b.now_ns + 20 * MS)
        [told] = [m for m in b.order(510, number) if m.get_type() == "MESSAGE_INTERVAL"]
        assert 0 < told.interval_us <= 2**31 - 1


def test_the_disk_is_asked_for_parameters_a_few_times_in_a_second_and_no_more():
    b = cockpit(gains=ALONE).fly(4, reported=1)
    results = [b.result(STORAGE, SAVE) for _ in range(20)]
    assert results[0] != REJECTED
    assert results[-10:] == [REJECTED] * 10
    b.to(b.now_ns + S)
    assert b.result(STORAGE, SAVE) != REJECTED


def test_of_two_stations_the_first_has_the_stick_and_a_stick_given_back_is_nobodys_silence():
    b = armed(STABILIZE, ground_stations=2)
    b.hear(stick(-500)).fly(2, reported=1)
    target = b.node.commander.target
    b.hear(stick(500), port="gcs1").fly(2, reported=1)
    assert b.node.commander.target is target
    assert sum("another station" in text for text in b.statements()) == 1
    back = [65535] * 8
    back[1] = 0
    b.hear(dialect.MAVLink_rc_channels_override_message(1, 1, *back))
    assert b.node.commander.stick == 0.0
    b.hear(stick(500), port="gcs1")
    assert b.node.commander.target is not target
    b.fly(20, reported=1)
