"""Eq. (1) in six degrees of freedom: what is conserved, what is symmetric, how the angles follow the rates."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import root
from scipy.spatial.transform import Rotation

from sitl.aircraft.aerodynamics import Aerodynamics, Aircraft, Engine, load_aircraft
from sitl.aircraft.atmosphere import GRAVITY
from sitl.aircraft.sixdof import Controls, State, body_angles, derivatives, integrate
from sitl.aircraft.trim import trimmed

V, ALTITUDE_M, DT = 100.22896669603553, 1600.0, 0.005

Array = NDArray[np.float64]

HIRM = load_aircraft("hirm")


def without_loads(aircraft: Aircraft) -> Aircraft:
    """Return an aircraft that the air does not feel, without an engine."""
    still = Aerodynamics(1.0, 1.0, 1.0, *[0.0] * (len(Aerodynamics._fields) - 3))
    return replace(aircraft, aerodynamics=still, engine=Engine(1e-9, 0.7, 0.8))


TUMBLING = State(90.0, 0.3, -0.2, 0.4, 0.5, 1.0, 0.6, -0.4, 0.3, 0.0, 0.0, 6000.0, 0.0)


def fly(aircraft: Aircraft, state: State, controls: Controls, seconds: float) -> Iterator[State]:
    for _ in range(round(seconds / DT)):
        state = integrate(aircraft, state, controls, DT)
        yield state


# -- conservation


def test_without_forces_specific_energy_is_kept() -> None:
    free = without_loads(HIRM)
    energy = [0.5 * s.V**2 + GRAVITY * s.height for s in fly(free, TUMBLING, Controls(0.0), 6.0)]
    assert energy == pytest.approx([0.5 * TUMBLING.V**2 + GRAVITY * TUMBLING.height] * len(energy), rel=1e-11)


def test_without_forces_the_path_is_a_parabola() -> None:
    end = list(fly(without_loads(HIRM), TUMBLING, Controls(0.0), 4.0))[-1]
    along, up = TUMBLING.V * math.cos(TUMBLING.gamma), TUMBLING.V * math.sin(TUMBLING.gamma)
    assert end.north == pytest.approx(4.0 * along * math.cos(TUMBLING.psi), rel=1e-9)
    assert end.east == pytest.approx(4.0 * along * math.sin(TUMBLING.psi), rel=1e-9)
    assert end.height - TUMBLING.height == pytest.approx(4.0 * up - 8.0 * GRAVITY, rel=1e-7)


def test_without_moments_angular_momentum_in_earth_axes_and_rotational_energy_are_kept() -> None:
    mass = HIRM.mass
    inertia = np.array([[mass.Ix, 0.0, -mass.Ixz], [0.0, mass.Iy, 0.0], [-mass.Ixz, 0.0, mass.Iz]])

    def momentum(s: State) -> tuple[Array, float]:
        rates = np.array([s.p, s.q, s.r])
        to_earth = Rotation.from_euler("ZYX", body_angles(s)[::-1])
        return to_earth.apply(inertia @ rates), float(rates @ inertia @ rates)

    start = momentum(TUMBLING)
    for s in list(fly(without_loads(HIRM), TUMBLING, Controls(0.0), 6.0))[::50]:
        H, T = momentum(s)  # the direction is kept only if the angles follow the rates
        assert pytest.approx(start[0], abs=1e-7 * float(np.linalg.norm(start[0]))) == H
        assert pytest.approx(start[1], rel=1e-9) == T


# -- symmetry

angles = st.floats(-0.6, 0.6)
states = st.builds(
    State,
    st.floats(60.0, 250.0),
    *[angles] * 8,
    north=st.just(0.0),
    east=st.just(0.0),
    height=st.floats(100.0, 15e3),
    thrust=st.floats(0.0, 6e4),
)
MIRROR = np.array([1, 1, -1, 1, -1, -1, -1, 1, -1, 1, -1, 1, 1], dtype=float)


@settings(max_examples=60)
@given(states, angles, angles, angles, st.tuples(*[st.floats(-15.0, 15.0)] * 3))
def test_a_mirrored_state_has_mirrored_derivatives(
    state: State, elevator: float, aileron: float, rudder: float, air: tuple[float, float, float]
) -> None:
    here = derivatives(HIRM, state, Controls(elevator, aileron, rudder, 0.4), 0.1, air)
    mirrored = derivatives(
        HIRM,
        State(*(MIRROR * state).tolist()),
        Controls(elevator, -aileron, -rudder, 0.4),
        0.1,
        (air[0], -air[1], air[2]),
    )
    assert np.array(mirrored) == pytest.approx(MIRROR * here, rel=1e-9, abs=1e-9)


def test_a_symmetric_flight_stays_symmetric_to_the_bit() -> None:
    state, controls = trimmed(HIRM, V, ALTITUDE_M)
    for s in fly(HIRM, state, controls._replace(elevator=controls.elevator - 0.05), 4.0):
        assert (s.beta, s.phi, s.psi, s.p, s.r, s.east) == (0.0,) * 6


# -- kinematics


def test_body_angles_are_those_of_the_two_rotations() -> None:
    for state in (TUMBLING, TUMBLING._replace(phi=-2.5, gamma=-1.0, psi=3.0, alpha=-0.4, beta=0.6)):
        wind = Rotation.from_euler("ZYX", [state.psi, state.gamma, state.phi])
        body = wind * Rotation.from_euler("ZYX", [-state.beta, state.alpha, 0.0])  # by -beta, then by alpha
        assert body_angles(state) == pytest.approx(tuple(body.as_euler("ZYX")[::-1]), abs=1e-12)


def test_a_steady_turn_is_coordinated() -> None:
    aircraft = replace(HIRM, aerodynamics=HIRM.aerodynamics._replace(CY_rudder=0.0))
    bank = math.radians(50.0)

    def at(unknown: Array) -> tuple[State, Controls]:
        alpha, p, q, r, elevator, aileron, rudder, thrust = unknown.tolist()
        state = State(150.0, alpha, 0.0, 0.0, bank, 0.3, p, q, r, 0.0, 0.0, ALTITUDE_M, thrust * 1e5)
        return state, Controls(elevator, aileron, rudder)

    def unsteady(unknown: Array) -> list[float]:
        rate = derivatives(aircraft, *at(unknown))
        return [*rate[:5], *rate[6:9]]  # all but psi

    found = root(unsteady, np.array([0.1, 0.0, 0.1, 0.05, 0.0, 0.0, 0.0, 0.3]), tol=1e-13)
    state, controls = at(found.x)
    rate = derivatives(aircraft, state, controls)
    assert max(map(abs, unsteady(found.x))) < 1e-9
    turning = GRAVITY * math.tan(bank) / 150.0
    assert rate.psi == pytest.approx(turning, rel=1e-9)
    roll, pitch, _ = body_angles(state)  # a turn about the vertical, seen from the body
    assert state.p == pytest.approx(-turning * math.sin(pitch), rel=1e-8)
    assert state.q == pytest.approx(turning * math.cos(pitch) * math.sin(roll), rel=1e-8)
    assert state.r == pytest.approx(turning * math.cos(pitch) * math.cos(roll), rel=1e-8)
