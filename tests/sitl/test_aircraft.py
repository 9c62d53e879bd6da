"""The linear aircraft against the paper's matrices, the gust by hand, the actuator against its equation."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from gains.model import Actuator, Trim
from gains.store import load_model
from sitl.aircraft.disturbance import HarmonicGust, SquareDelta
from sitl.aircraft.linear import LinearAircraft, move_actuator

quick = settings(deadline=None)
PRINTED, EXACT = load_model("hirm-printed"), load_model("hirm")
vectors = st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3).map(np.array)
numbers = st.floats(-1.0, 1.0)

# Eqs. (49) and (50), as printed
A0 = np.array([[0.9862, 0.0243, 0.0], [-0.0264, 0.9894, 0.0], [-0.0003, 0.0249, 1.0]])
B0 = np.array([[-0.0038], [-0.0810], [-0.0010]])
E0 = np.array([[0.0230], [0.0], [0.0]])
F, J1, J2 = np.array([[0.04], [0.8], [0.0]]), np.array([[0.033, 0.014, 0.0]]), np.array([[0.1]])


@quick
@given(vectors, numbers, numbers, st.floats(-0.15, 0.15))
def test_a_step_is_equation_4_with_the_uncertainty_of_6_and_7(x, u, w, delta):
    A, B = A0 + F @ J1 * delta, B0 + F @ J2 * delta
    expected = A @ x + B[:, 0] * u + E0[:, 0] * w
    found = LinearAircraft(PRINTED).step(x, np.array([u]), np.array([w]), delta)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-15)


def test_a_tenth_of_delta_is_the_papers_error_of_a_tenth():
    unit = np.eye(3)
    aircraft = LinearAircraft(PRINTED)
    nothing = np.zeros(1)
    change = np.array(
        [aircraft.step(e, nothing, nothing, 0.1) - aircraft.step(e, nothing, nothing, 0.0) for e in unit]
    ).T
    np.testing.assert_allclose(change[1], [0.0026, 0.0011, 0.0], atol=5e-5)
    change_B = aircraft.step(np.zeros(3), np.ones(1), nothing, 0.1) - aircraft.step(
        np.zeros(3), np.ones(1), nothing, 0.0
    )
    np.testing.assert_allclose(change_B, [0.0004, 0.0080, 0.0], atol=5e-5)


def test_the_exact_aircraft_is_the_solution_of_equation_48():
    Ap = np.array([[-0.5427, 1.0, 0.0], [-1.069, -0.4134, 0.0], [0.0, 1.0, 0.0]])
    Bp, Ep = np.array([-0.113, -3.259, 0.0]), np.array([1.0, 0.0, 0.0])
    x0, u, w = np.array([0.05, -0.1, 0.2]), 0.1, -0.3
    truth = solve_ivp(lambda _t, x: Ap @ x + Bp * u + Ep * w, (0.0, 0.5), x0, rtol=1e-11, atol=1e-13).y[:, -1]
    x = x0
    for _ in range(20):
        x = LinearAircraft(EXACT).step(x, np.array([u]), np.array([w]), 0.0)
    np.testing.assert_allclose(x, truth, rtol=1e-8)


@quick
@given(vectors, numbers, vectors, numbers, st.floats(-0.15, 0.15))
def test_trim_is_where_deviations_are_counted_from(x, u, trim_x, trim_u, delta):
    trimmed = LinearAircraft(replace(PRINTED, trim=Trim(trim_x, np.array([trim_u]))))
    plain = LinearAircraft(PRINTED)
    w = np.array([0.1])
    found = trimmed.step(trim_x + x, np.array([trim_u + u]), w, delta)
    np.testing.assert_allclose(found - trim_x, plain.step(x, np.array([u]), w, delta), atol=1e-12)
    np.testing.assert_allclose(trimmed.step(trim_x, np.array([trim_u]), np.zeros(1), delta), trim_x, atol=1e-15)


def test_a_step_changes_nothing_it_is_given():
    x, u, w = np.ones(3), np.ones(1), np.ones(1)
    LinearAircraft(PRINTED).step(x, u, w, 0.15)
    assert (x.tolist(), u.tolist(), w.tolist()) == ([1.0] * 3, [1.0], [1.0])


# the gust, Eq. (52)

MU_1 = 0.1 * (0.9922 + 0.1247), 0.1 * (0.9922 - 0.1247)  # by hand
MU_2 = 0.9922 * MU_1[0] + 0.1247 * MU_1[1], -0.1247 * MU_1[0] + 0.9922 * MU_1[1]


def test_the_gusts_first_values_are_those_by_hand():
    gust = HarmonicGust(1, unit=1.0)
    assert [gust.w(k)[0] for k in range(3)] == pytest.approx([2.5, 25 * 0.11169, 25 * MU_2[0]], rel=1e-12)


def test_the_gust_is_in_degrees_per_second():
    assert HarmonicGust(1).w(0)[0] == pytest.approx(math.radians(2.5), rel=1e-15)


def test_the_gust_is_a_harmonic_of_50_samples_that_hardly_decays():
    gust = HarmonicGust(1, unit=1.0)
    w = np.array([gust.w(k)[0] for k in range(400)])
    radius, angle = math.hypot(0.9922, 0.1247), math.atan2(0.1247, 0.9922)
    k = np.arange(400)
    np.testing.assert_allclose(
        w, 2.5 * math.sqrt(2) * radius**k * np.cos(angle * k - math.pi / 4), rtol=1e-9, atol=1e-9
    )


@pytest.mark.parametrize("start_k", [1, 40])
def test_a_gust_that_starts_later_is_the_same_gust_later(start_k):
    early, late = HarmonicGust(2), HarmonicGust(2, start_k)
    assert all(not late.w(k).any() for k in range(start_k))
    for k in range(100):
        np.testing.assert_array_equal(late.w(start_k + k), early.w(k))


def test_the_gust_enters_through_the_first_disturbance_and_may_be_asked_with_gaps():
    gust, other = HarmonicGust(3), HarmonicGust(3)
    for k in range(50):
        gust.w(k)
    np.testing.assert_array_equal(gust.w(50), other.w(50))
    assert other.w(50)[1:].tolist() == [0.0, 0.0]
    np.testing.assert_array_equal(other.w(50), other.w(50))


# Delta(k), Eq. (51)


def test_delta_is_the_papers_square_wave():
    delta = [SquareDelta().delta(k) for k in range(60)]
    assert delta == [0.15] * 20 + [-0.15] * 20 + [0.15] * 20


def test_delta_takes_its_amplitude_and_half_period():
    assert [SquareDelta(0.1, 2).delta(k) for k in range(6)] == [0.1, 0.1, -0.1, -0.1, 0.1, 0.1]


# the actuator


def actuated(**limits):
    return replace(EXACT, actuator=Actuator(**{name: np.array([value]) for name, value in limits.items()}))


def run(model, command, samples, start=0.0):
    position, found = np.array([start]), []
    for _ in range(samples):
        position = move_actuator(model, position, np.array([command]))
        found.append(float(position[0]))
    return np.array(found)


@pytest.mark.parametrize("tau", [0.01, 0.05, 0.5])
def test_a_lag_is_the_first_order_step_response(tau):
    t = EXACT.Ts * np.arange(1, 101)
    np.testing.assert_allclose(run(actuated(tau=tau), 0.2, 100), 0.2 * (1 - np.exp(-t / tau)), rtol=1e-12)


def test_a_rate_is_a_ramp_that_stops_at_the_command():
    found = run(actuated(rate=1.0), 0.11, 8)
    np.testing.assert_allclose(found, [0.025, 0.05, 0.075, 0.1, 0.11, 0.11, 0.11, 0.11], rtol=1e-12)
    np.testing.assert_allclose(run(actuated(rate=1.0), -0.11, 5), -found[:5], rtol=1e-12)


def test_lag_and_rate_together_move_by_the_slower():
    model = actuated(tau=0.05, rate=1.0)
    found = np.concatenate([[0.0], run(model, 1.0, 200)])
    moved = np.diff(found)
    lag = (1 - math.exp(-EXACT.Ts / 0.05)) * (1.0 - found[:-1])
    np.testing.assert_allclose(moved, np.minimum(lag, 0.025), atol=1e-15)


def test_the_travel_limits_the_command_before_the_lag():
    model = actuated(low=-0.1, high=0.1, tau=0.05)
    t = EXACT.Ts * np.arange(1, 51)
    np.testing.assert_allclose(run(model, 5.0, 50), 0.1 * (1 - np.exp(-t / 0.05)), rtol=1e-12)


@pytest.mark.parametrize("model", [replace(EXACT, actuator=None), actuated(tau=0.0), actuated(low=-9.0, high=9.0)])
def test_without_lag_and_rate_the_actuator_is_there_at_once(model):
    assert run(model, 0.3, 2).tolist() == [0.3, 0.3]
