"""The elevator on the wire."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autopilot.link.servo import Travel, travel_of
from gains.model import Actuator, Trim
from gains.store import load_model
from gains.table import InputError

quick = settings(deadline=None)
HIRM = load_model("hirm")
DEG = np.pi / 180
travels = st.builds(
    lambda low, span, part: Travel(low, low + span, low + part * span),
    st.floats(-100.0, 100.0),
    st.floats(0.01, 200.0),
    st.floats(0.0, 1.0),
)


def test_the_ends_of_the_travel_are_the_ends_of_the_scale():
    travel = travel_of(HIRM)
    assert [travel.to_pwm(u) for u in (-25 * DEG, 0.0, 25 * DEG)] == [1000, 1500, 2000]
    assert [travel.to_control(u) for u in (-25 * DEG, 0.0, 25 * DEG)] == pytest.approx([-1.0, 0.0, 1.0], abs=1e-15)
    assert [travel.from_pwm(p) for p in (1000, 1500, 2000)] == pytest.approx([-25 * DEG, 0.0, 25 * DEG], abs=1e-15)
    assert [travel.from_control(c) for c in (-1, 0, 1)] == pytest.approx([-25 * DEG, 0.0, 25 * DEG], abs=1e-15)


def test_one_microsecond_is_a_twentieth_of_a_degree():
    travel = travel_of(HIRM)
    assert travel.from_pwm(1501) - travel.from_pwm(1500) == pytest.approx(0.05 * DEG, rel=1e-9)


def test_neutral_is_the_trim_input():
    travel = travel_of(replace(HIRM, trim=Trim(np.zeros(3), np.array([-0.1]))))
    assert travel.neutral == -0.1
    assert travel.from_pwm(travel.to_pwm(travel.neutral)) == pytest.approx(-0.1, abs=0.025 * DEG + 1e-12)


@quick
@given(travels, st.floats(0.0, 1.0))
def test_a_pulse_is_within_half_its_last_bit(travel, part):
    u = travel.clip(travel.low + part * (travel.high - travel.low))
    half_lsb = 0.5 * (travel.high - travel.low) / 1000
    assert abs(travel.from_pwm(travel.to_pwm(u)) - u) <= half_lsb * (1 + 1e-9) + 1e-12


@quick
@given(travels, st.floats(0.0, 1.0))
def test_a_normalised_control_has_only_the_error_of_its_32_bits(travel, part):
    u = travel.clip(travel.low + part * (travel.high - travel.low))
    on_the_wire = float(np.float32(travel.to_control(u)))
    back = travel.from_control(on_the_wire)
    assert back is not None
    assert abs(back - u) <= 1e-7 * (travel.high - travel.low)


@quick
@given(travels, st.integers(1000, 2000))
def test_every_pulse_survives_the_way_there_and_back(travel, pulse):
    u = travel.from_pwm(pulse)
    assert travel.low - 1e-9 <= u <= travel.high + 1e-9
    assert travel.to_pwm(u) == pulse


@pytest.mark.parametrize("pulse", [0, 1, 999, 2001, 65_535])
def test_a_pulse_outside_the_travel_is_none(pulse):
    assert travel_of(HIRM).from_pwm(pulse) is None


@pytest.mark.parametrize("control", [-1.0001, 1.0001, 1e30, float("nan")])
def test_a_control_outside_the_travel_is_none(control):
    assert travel_of(HIRM).from_control(control) is None


@quick
@given(travels, st.floats(-1e9, 1e9))
def test_clipping_ends_in_the_travel_and_leaves_the_inside_alone(travel, u):
    clipped = travel.clip(u)
    assert travel.low <= clipped <= travel.high
    assert clipped == u or not travel.low <= u <= travel.high


def test_a_model_without_limits_is_refused():
    for actuator in (None, Actuator(rate=np.array([1.0]))):
        with pytest.raises(InputError, match="hirm: actuator: expected low and high"):
            travel_of(replace(HIRM, actuator=actuator))


def test_a_model_with_two_inputs_is_refused():
    model = replace(HIRM, B=np.zeros((3, 2)), D=np.zeros((1, 2)), trim=Trim(np.zeros(3), np.zeros(2)))
    with pytest.raises(InputError, match=r"plant\.B: .* found 2"):
        travel_of(model)
