"""Trim and linear model of the six degrees of freedom: the paper's (48), flight mechanics by hand, and refusals."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from gains.model import Matrix
from gains.store import load_model
from gains.table import InputError
from sitl.aircraft.aerodynamics import Aircraft, load_aircraft
from sitl.aircraft.atmosphere import GRAVITY, standard_air
from sitl.aircraft.linearised import Linearised
from sitl.aircraft.sixdof import Controls, State, derivatives, integrate
from sitl.aircraft.trim import linearise, longitudinal, trimmed

A48 = np.array([[-0.5427, 1.0, 0.0], [-1.069, -0.4134, 0.0], [0.0, 1.0, 0.0]])
B48 = np.array([[-0.113], [-3.259], [0.0]])
ALTITUDE_M = 1600.0


@pytest.fixture(scope="module")
def hirm() -> Aircraft:
    return load_aircraft("hirm")


@pytest.fixture(scope="module")
def linear() -> Linearised:
    return linearise("hirm", mach=0.3, altitude_m=ALTITUDE_M)


def test_the_hirm_at_mach_0_3_and_1600_m_is_the_papers(linear: Linearised) -> None:
    for found, printed in ((linear.Ap, A48), (linear.Bp, B48), (linear.Ep, np.array([[1.0], [0.0], [0.0]]))):
        assert np.abs(found - printed)[printed == 0.0].max() < 0.005
        assert found[printed != 0.0] == pytest.approx(printed[printed != 0.0], rel=1e-5)


def test_the_stored_model_is_the_stored_aircraft(linear: Linearised) -> None:
    stored = load_model("hirm-6dof")
    whole = np.zeros((5, 5))
    whole[:3] = np.hstack([linear.Ap, linear.Bp, linear.Ep])
    held = expm(whole * stored.Ts)
    assert np.hstack([stored.A, stored.B, stored.E]) == pytest.approx(held[:3], abs=1e-9)
    assert stored.trim.x == pytest.approx([linear.alpha_rad, 0.0, linear.theta_rad], abs=1e-9)
    assert stored.trim.u == pytest.approx([linear.u], abs=1e-9)
    assert stored.condition is not None
    assert stored.condition.airspeed_m_s == pytest.approx(linear.airspeed_m_s, abs=1e-9)
    actuator = stored.actuator
    assert actuator is not None
    told = (actuator.low, actuator.high, actuator.rate, actuator.tau)
    assert [float(value[0]) for value in told if value is not None] == [
        linear.u_low,
        linear.u_high,
        linear.u_rate,
        linear.u_tau,
    ]


def test_mach_and_speed_name_the_same_condition(linear: Linearised) -> None:
    speed = 0.3 * 334.0965  # the speed of sound at 1600 m, from the published table by interpolation
    assert linear.airspeed_m_s == pytest.approx(speed, abs=0.01)
    by_speed = linearise("hirm", airspeed_m_s=linear.airspeed_m_s, altitude_m=ALTITUDE_M)
    assert np.array_equal(by_speed.Ap, linear.Ap)
    assert by_speed.u == linear.u


@pytest.mark.parametrize("gamma_deg", [-4.0, 0.0, 6.0])
def test_lift_thrust_and_weight_balance_at_trim(hirm: Aircraft, gamma_deg: float) -> None:
    gamma, V = math.radians(gamma_deg), 120.0
    state, controls = trimmed(hirm, V, 3000.0, gamma)
    aero, pressure = hirm.aerodynamics, 0.5 * standard_air(3000.0).density_kg_m3 * V**2 * hirm.aerodynamics.area
    CL = aero.CL0 + aero.CL_alpha * state.alpha + aero.CL_elevator * controls.elevator
    CD = aero.CD0 + aero.k * CL**2
    weight = hirm.mass.mass * GRAVITY
    sin, cos = math.sin(state.alpha), math.cos(state.alpha)
    assert pressure * CL + state.thrust * sin == pytest.approx(weight * math.cos(gamma), rel=1e-9)
    assert state.thrust * cos - pressure * CD == pytest.approx(weight * math.sin(gamma), abs=1e-6 * weight)
    assert aero.Cm0 + aero.Cm_alpha * state.alpha + aero.Cm_elevator * controls.elevator == pytest.approx(0.0, abs=1e-9)
    assert max(map(abs, derivatives(hirm, state, controls)[:9])) < 1e-8
    assert state.thrust == pytest.approx(hirm.thrust_N(controls.throttle, standard_air(3000.0).density_kg_m3))


def test_the_faster_the_flatter(hirm: Aircraft) -> None:
    speeds = (90.0, 110.0, 130.0, 160.0, 200.0)
    trims = [trimmed(hirm, V, ALTITUDE_M) for V in speeds]
    incidence = [state.alpha for state, _ in trims]
    elevator = [controls.elevator for _, controls in trims]
    assert incidence == sorted(incidence, reverse=True)
    assert elevator == sorted(elevator)  # trailing edge further down at speed: statically stable


@pytest.mark.parametrize(
    ("V", "altitude_m", "gamma"), [(20.0, 1600.0, 0.0), (1500.0, 1600.0, 0.0), (100.0, 19e3, 0.0), (100.0, 1600.0, 1.0)]
)
def test_what_cannot_be_flown_is_one_complaint(hirm: Aircraft, V: float, altitude_m: float, gamma: float) -> None:
    with pytest.raises(InputError, match=f"sixdof:hirm: expected a trim at {V:g} m/s .* found none"):
        trimmed(hirm, V, altitude_m, gamma)


def test_an_elevator_of_too_little_travel_has_no_trim(hirm: Aircraft, linear: Linearised) -> None:
    for share, flies in ((1.01, True), (0.99, False)):
        short = replace(hirm, surfaces=hirm.surfaces._replace(elevator=share * abs(linear.u)))
        if flies:
            assert trimmed(short, linear.airspeed_m_s, ALTITUDE_M)[1].elevator == pytest.approx(linear.u)
        else:
            with pytest.raises(InputError, match="found none within the elevator's travel"):
                trimmed(short, linear.airspeed_m_s, ALTITUDE_M)


def test_the_jacobian_is_that_of_differences_of_higher_order(hirm: Aircraft) -> None:
    state, controls = trimmed(hirm, 100.0, ALTITUDE_M)

    def rates(at: Matrix) -> Matrix:
        V, alpha, q, theta, elevator, gust = at.tolist()
        there = state._replace(V=V, alpha=alpha, q=q, gamma=theta - alpha)
        rate = derivatives(hirm, there, controls._replace(elevator=elevator), gust)
        return np.array([rate.V, rate.alpha, rate.q, rate.alpha + rate.gamma])

    here = np.array([state.V, state.alpha, 0.0, state.alpha, controls.elevator, 0.0])
    columns = []
    for i, h in enumerate((0.1, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3)):
        step = np.eye(6)[i] * h
        near, far = rates(here + step) - rates(here - step), rates(here + 2 * step) - rates(here - 2 * step)
        columns.append((8.0 * near - far) / (12.0 * h))
    assert longitudinal(hirm, state, controls) == pytest.approx(np.column_stack(columns), rel=1e-7, abs=1e-8)


def test_the_short_period_is_what_its_derivatives_say_by_hand(hirm: Aircraft, linear: Linearised) -> None:
    values = np.linalg.eigvals(linear.Ap)
    pair = values[np.abs(values.imag) > 0.1]
    assert np.abs(pair) == pytest.approx(math.sqrt(0.5427 * 0.4134 + 1.069), rel=1e-4)
    assert pair.real == pytest.approx(-0.5 * (0.5427 + 0.4134), rel=1e-4)


def test_the_phugoid_of_an_aircraft_that_keeps_its_incidence_is_lanchesters(hirm: Aircraft) -> None:
    aero = hirm.aerodynamics  # its weight in thrust and a thousand times its stiffness: no incidence, no pitching
    stiff = replace(hirm, aerodynamics=aero._replace(Cm_alpha=1e3 * aero.Cm_alpha, Cm_elevator=1e3 * aero.Cm_elevator))
    for V in (100.0, 150.0, 200.0):
        state, controls = trimmed(stiff, V, ALTITUDE_M)
        values = np.linalg.eigvals(longitudinal(stiff, state, controls)[:, :4])
        slow = values[np.argsort(np.abs(values))][:2]
        assert np.abs(slow) == pytest.approx(math.sqrt(2.0) * GRAVITY / V, rel=0.03)
    plain = np.linalg.eigvals(longitudinal(hirm, *trimmed(hirm, 100.0, ALTITUDE_M))[:, :4])
    assert np.sort(np.abs(plain))[:2] == pytest.approx(math.sqrt(2.0) * GRAVITY / 100.0, rel=0.15)


def test_a_small_doublet_flies_as_the_linear_model_says(hirm: Aircraft, linear: Linearised) -> None:
    state, controls = trimmed(hirm, linear.airspeed_m_s, ALTITUDE_M)
    whole = np.zeros((4, 4))
    whole[:3] = np.hstack([linear.Ap, linear.Bp])
    held = expm(whole * 0.005)
    x, flown, told = np.zeros(3), [], []
    for i in range(400):
        du = math.radians(0.2) * (1.0 if i < 100 else -1.0 if i < 200 else 0.0)
        state = integrate(hirm, state, controls._replace(elevator=controls.elevator + du), 0.005)
        x = held[:3, :3] @ x + held[:3, 3] * du
        flown.append([state.alpha - linear.alpha_rad, state.q, state.alpha + state.gamma - linear.theta_rad])
        told.append(x)
    peak = np.abs(told).max(axis=0)
    assert (np.abs(np.array(flown) - told).max(axis=0) < 0.02 * peak).all()


def test_speed_that_is_left_out_is_told(linear: Linearised) -> None:
    assert any("with speed" in note and "0.12" in note for note in linear.notes)  # the phugoid, 0.12 rad/s


def test_a_trim_is_straight_and_level(hirm: Aircraft) -> None:
    state, controls = trimmed(hirm, 100.0, ALTITUDE_M)
    assert state == State(100.0, state.alpha, 0, 0, 0, 0, 0, 0, 0, 0, 0, ALTITUDE_M, state.thrust)
    assert controls == Controls(controls.elevator, 0.0, 0.0, controls.throttle)
