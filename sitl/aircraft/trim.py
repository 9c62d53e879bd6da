"""Trim of an aircraft of Eq. (1), and its linear model there, Eq. (2)."""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import root

from gains.model import Matrix
from gains.table import InputError
from sitl.aircraft.aerodynamics import Aircraft, load_aircraft
from sitl.aircraft.atmosphere import standard_air
from sitl.aircraft.linearised import Linearised
from sitl.aircraft.sixdof import Controls, State, derivatives

__all__ = ["linearise", "longitudinal", "trimmed"]

DIFFERENCE = 1e-5
"""Of the central differences, rad, rad/s, and parts of the speed."""


def trimmed(
    aircraft: Aircraft, airspeed_m_s: float, altitude_m: float, gamma_rad: float = 0.0
) -> tuple[State, Controls]:
    """Return the state and controls of steady, straight flight with wings level.

    Parameters
    ----------
    aircraft : Aircraft
    airspeed_m_s : float
        True airspeed.
    altitude_m : float
    gamma_rad : float
        Flight path angle; the speed is steady, the density that of this altitude.

    Raises
    ------
    InputError
        When there is no such flight within the elevator's travel and the engine's power.
    """
    if not 0.0 < airspeed_m_s < math.inf:
        raise InputError(f"sixdof:{aircraft.name}: expected a trim at an airspeed above 0, found {airspeed_m_s:g} m/s")
    full = aircraft.thrust_N(1.0, standard_air(altitude_m).density_kg_m3)

    def at(unknown: Matrix) -> tuple[State, Controls]:
        alpha, elevator, throttle = unknown.tolist()
        state = State(
            airspeed_m_s, alpha, 0.0, gamma_rad, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, altitude_m, throttle * full
        )
        return state, Controls(elevator, throttle=throttle)

    def unsteady(unknown: Matrix) -> list[float]:
        rate = derivatives(aircraft, *at(unknown))
        return [rate.V / 10.0, rate.alpha, rate.q]

    found = root(unsteady, np.array([0.05, 0.0, 0.3]), tol=1e-13)
    state, controls = at(found.x)
    left = max(map(abs, unsteady(found.x)))
    inside = abs(controls.elevator) <= aircraft.surfaces.elevator and 0.0 <= controls.throttle <= 1.0
    if left > 1e-9 or not inside or abs(state.alpha) > math.pi / 4.0:
        raise InputError(
            f"sixdof:{aircraft.name}: expected a trim at {airspeed_m_s:g} m/s and {altitude_m:g} m, found none within"
            f" the elevator's travel, the engine's power and 45 degrees of incidence"
        )
    return state, controls


def linearise(
    name: str, *, airspeed_m_s: float | None = None, mach: float | None = None, altitude_m: float
) -> Linearised:
    """Return an aircraft near level flight at constant speed, Eq. (2).

    Parameters
    ----------
    name : str
        Of a stored aircraft, or its parameter file.
    airspeed_m_s, mach : float
        True airspeed or Mach number; one of them.
    altitude_m : float

    Raises
    ------
    InputError
        When there is no such aircraft, or no trim.
    """
    aircraft = load_aircraft(name)
    assert (airspeed_m_s is None) != (mach is None)
    speed = airspeed_m_s if mach is None else mach * standard_air(altitude_m).sound_m_s
    assert speed is not None
    state, controls = trimmed(aircraft, speed, altitude_m)
    whole = longitudinal(aircraft, state, controls)
    A, B, E = whole[1:, 1:4], whole[1:, 4:5], whole[1:, 5:6]
    return Linearised(
        aircraft=f"sixdof:{name}",
        Ap=A,
        Bp=B,
        Ep=E,
        alpha_rad=state.alpha,
        theta_rad=state.alpha,
        u=controls.elevator,
        u_low=-aircraft.surfaces.elevator,
        u_high=aircraft.surfaces.elevator,
        u_rate=aircraft.surfaces.rate,
        u_tau=aircraft.surfaces.tau,
        u_unit="rad",
        airspeed_m_s=speed,
        altitude_m=altitude_m,
        throttle=controls.throttle,
        notes=(
            f"Eq. (1) by central differences; thrust {state.thrust:.0f} N.",
            f"Modes, 1/s, of the longitudinal motion with speed: {_modes(whole[:, :4])};",
            f"at constant speed, as here: {_modes(A)}.",
        ),
    )


def longitudinal(aircraft: Aircraft, state: State, controls: Controls) -> Matrix:
    """Return the Jacobian of V', alpha', q', theta' with respect to V, alpha, q, theta, elevator and gust; (4, 6).

    Wings level, so theta = alpha + gamma; thrust and altitude are held.
    """
    scales = (state.V, 1.0, 1.0, 1.0, 1.0, 1.0)

    def rates(at: Matrix) -> Matrix:
        V, alpha, q, theta, elevator, gust = at.tolist()
        there = state._replace(V=V, alpha=alpha, q=q, gamma=theta - alpha)
        rate = derivatives(aircraft, there, controls._replace(elevator=elevator), gust)
        return np.array([rate.V, rate.alpha, rate.q, rate.alpha + rate.gamma])

    here = np.array([state.V, state.alpha, state.q, state.alpha + state.gamma, controls.elevator, 0.0])
    columns = []
    for i, scale in enumerate(scales):
        step = np.zeros(6)
        step[i] = DIFFERENCE * scale
        columns.append((rates(here + step) - rates(here - step)) / (2.0 * step[i]))
    return np.column_stack(columns)


def _modes(A: Matrix) -> str:
    """Return the eigenvalues of a matrix as text."""
    upper = sorted((v for v in np.linalg.eigvals(A).astype(complex) if v.imag >= -1e-9), key=lambda v: -abs(v))
    return ", ".join(f"{v.real:.3f}" if abs(v.imag) < 1e-9 else f"{v.real:.3f}±{v.imag:.3f}i" for v in upper)
