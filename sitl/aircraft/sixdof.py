"""Six degrees of freedom: Eq. (1) of the paper in full, over a flat earth, in the standard atmosphere.

The nine states V, alpha, beta, gamma, phi, psi (wind axes), p, q, r (body axes), and beside them the position and the
thrust, which follows its command with a lag. V, alpha and beta are those of the motion over the ground; in moving air
the loads are those of the motion through it.

Between samples the classical Runge-Kutta method of fourth order takes fixed steps of at most 5 ms: the same flight to
the last bit on every machine, at the cost of a few lines; a test holds it to SciPy's adaptive DOP853.

``SixDofAirframe`` flies it behind the plant's Node. A wing-leveller, a yaw damper and a throttle hold (``_Hold``) keep
everything but the longitudinal loop out of the way.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from gains.model import Matrix, Model
from gains.table import InputError
from sitl.aircraft.aerodynamics import Aircraft, Surfaces, load_aircraft, loads
from sitl.aircraft.airframe import Pose, Vector
from sitl.aircraft.atmosphere import GRAVITY, HIGHEST_M, standard_air
from sitl.aircraft.linearised import STATES

if TYPE_CHECKING:
    from sitl.aircraft.wind import Wind

__all__ = ["Controls", "SixDofAirframe", "State", "body_angles", "derivatives", "integrate"]

STEP_S = 0.005
"""Longest step of the integration; the fastest mode of a fighter at these speeds takes a hundred times as long."""
TRIM_TOLERANCE_RAD = 1e-3
SLOWEST_M_S = 1.0
STEEPEST_RAD = math.radians(89.0)
"""Beyond this gamma the wind axes' Euler angles, and beyond this beta Eq. (1), have nothing more to say."""
NOT_FINITE = "no finite state"
_STILL = (0.0, 0.0, 0.0)

Triple = tuple[float, float, float]


class State(NamedTuple):
    """The state of Eq. (1), the position, and the thrust.

    Attributes
    ----------
    V : float
        Speed over the ground, m/s.
    alpha, beta, gamma, phi, psi : float
        rad; gamma, phi, psi are the Euler angles of the wind axes.
    p, q, r : float
        Body rates, rad/s.
    north, east, height : float
        m.
    thrust : float
        N.
    """

    V: float
    alpha: float
    beta: float
    gamma: float
    phi: float
    psi: float
    p: float
    q: float
    r: float
    north: float
    east: float
    height: float
    thrust: float


class Controls(NamedTuple):
    """Surfaces, rad, and throttle, 0 to 1."""

    elevator: float
    aileron: float = 0.0
    rudder: float = 0.0
    throttle: float = 0.0


def derivatives(aircraft: Aircraft, state: State, controls: Controls, gust: float = 0.0, air: Triple = _STILL) -> State:
    """Return the time derivatives of the state, Eq. (1).

    Parameters
    ----------
    aircraft : Aircraft
    state : State
    controls : Controls
    gust : float
        The w of Eq. (2): a rate of alpha, rad/s. It turns the path against the body, so theta does not feel it.
    air : (u, v, w)
        Velocity of the air in body axes, m/s.

    Raises
    ------
    InputError
        Where there is no standard air: below -1 km and above 20 km.
    """
    V, alpha, beta, gamma, phi, psi, p, q, r, _, _, height, thrust = state
    m, Ix, Iy, Iz, Ixz = aircraft.mass
    sa, ca, sb, cb = math.sin(alpha), math.cos(alpha), math.sin(beta), math.cos(beta)
    sg, cg, sf, cf = math.sin(gamma), math.cos(gamma), math.sin(phi), math.cos(phi)
    density = standard_air(height).density_kg_m3
    load = loads(aircraft.aerodynamics, density, *_through(state, air), (p, q, r), controls[:3])
    X, Y, Z = load.X + thrust, load.Y, load.Z
    # without gravity, in wind axes
    Fx = ca * cb * X + sb * Y + sa * cb * Z
    Fy = -ca * sb * X + cb * Y - sa * sb * Z
    Fz = -sa * X + ca * Z
    q_w = (-Fz - m * GRAVITY * cg * cf) / (m * V) - gust
    r_w = (Fy + m * GRAVITY * cg * sf) / (m * V)
    alpha_dot = q - q_w / cb - (p * ca + r * sa) * sb / cb
    p_w = p * ca * cb + (q - alpha_dot) * sb + r * sa * cb
    L = load.L + Ixz * p * q + (Iy - Iz) * q * r
    N = load.N - Ixz * q * r + (Ix - Iy) * p * q
    det = Ix * Iz - Ixz * Ixz
    turning = q_w * sf + r_w * cf
    wanted = aircraft.thrust_N(controls.throttle, density)
    return State(
        V=Fx / m - GRAVITY * sg,
        alpha=alpha_dot,
        beta=r_w + p * sa - r * ca,
        gamma=q_w * cf - r_w * sf,
        phi=p_w + turning * sg / cg,
        psi=turning / cg,
        p=(Iz * L + Ixz * N) / det,
        q=(load.M + Ixz * (r * r - p * p) + (Iz - Ix) * r * p) / Iy,
        r=(Ixz * L + Ix * N) / det,
        north=V * cg * math.cos(psi),
        east=V * cg * math.sin(psi),
        height=V * sg,
        thrust=(wanted - thrust) / aircraft.engine.tau,
    )


def _through(state: State, air: Triple) -> Triple:
    """Return speed, alpha and beta of the motion through the air."""
    if air == _STILL:
        return state.V, state.alpha, state.beta
    V, alpha, beta = state[:3]
    u = V * math.cos(alpha) * math.cos(beta) - air[0]
    v = V * math.sin(beta) - air[1]
    w = V * math.sin(alpha) * math.cos(beta) - air[2]
    ahead = math.hypot(u, w)
    return math.hypot(ahead, v), math.atan2(w, u), math.atan2(v, ahead)


def integrate(
    aircraft: Aircraft, state: State, controls: Controls, dt_s: float, gust: float = 0.0, air: Triple = _STILL
) -> State:
    """Return the state after one step of the classical Runge-Kutta method; parameters as of :func:`derivatives`."""

    def moved(by: State, share: float) -> State:
        return State(*[value + share * rate for value, rate in zip(state, by, strict=True)])

    k1 = derivatives(aircraft, state, controls, gust, air)
    k2 = derivatives(aircraft, moved(k1, dt_s / 2.0), controls, gust, air)
    k3 = derivatives(aircraft, moved(k2, dt_s / 2.0), controls, gust, air)
    k4 = derivatives(aircraft, moved(k3, dt_s), controls, gust, air)
    rates = zip(state, k1, k2, k3, k4, strict=True)
    return State(*[value + dt_s / 6.0 * (a + 2.0 * b + 2.0 * c + d) for value, a, b, c, d in rates])


def body_angles(state: State) -> Triple:
    """Return roll, pitch and yaw of the body axes, rad."""
    body = _wind_to_body(state) @ _earth_to_wind(state)
    pitch = -math.asin(max(-1.0, min(1.0, float(body[0, 2]))))
    return math.atan2(body[1, 2], body[2, 2]), pitch, math.atan2(body[0, 1], body[0, 0])


def _wind_to_body(state: State) -> Matrix:
    sa, ca, sb, cb = math.sin(state.alpha), math.cos(state.alpha), math.sin(state.beta), math.cos(state.beta)
    return np.array([[ca * cb, -ca * sb, -sa], [sb, cb, 0.0], [sa * cb, -sa * sb, ca]])


def _earth_to_wind(state: State) -> Matrix:
    (sf, cf), (sg, cg), (sy, cy) = ((math.sin(a), math.cos(a)) for a in (state.phi, state.gamma, state.psi))
    return np.array(
        [
            [cg * cy, cg * sy, -sg],
            [sf * sg * cy - cf * sy, sf * sg * sy + cf * cy, sf * cg],
            [cf * sg * cy + sf * sy, cf * sg * sy - sf * cy, cf * cg],
        ]
    )


class SixDofAirframe:
    """An aircraft of Eq. (1) in flight, from the trim of a model's condition.

    Parameters
    ----------
    name : str
        Of a stored aircraft, or its parameter file.
    model : Model
        Made by ``sitl linearize`` for this aircraft; states alpha_rad, q_rad_s and theta_rad, in any order.
    wind : Wind or None
        Air that moves, in body axes.

    Raises
    ------
    InputError
        When there is no such aircraft, or the model describes another one, or another condition.
    """

    def __init__(self, name: str, model: Model, wind: Wind | None = None) -> None:
        from sitl.aircraft.trim import trimmed  # with SciPy, which only a trim needs

        condition = model.condition
        if set(model.states) != set(STATES) or model.nu != 1 or condition is None:
            raise InputError(
                f"sixdof:{name}: expected a model with states {', '.join(STATES)}, one input and [condition]"
                f" (sitl linearize makes one), found {model.name} with {', '.join(model.states)}"
            )
        self._aircraft = load_aircraft(name)
        self._state, trim = trimmed(self._aircraft, condition.airspeed_m_s, condition.altitude_m)
        self._order = [STATES.index(state) for state in model.states]
        self._steps = math.ceil(model.Ts / STEP_S)
        self._dt_s = model.Ts / self._steps
        self._wind = wind
        self._air: Triple = _STILL
        self._k = 0
        self._hold = _Hold(self._aircraft, self._state, trim)
        self._read()
        off = max(float(np.abs(self.x - model.trim.x).max()), abs(trim.elevator - float(model.trim.u[0])))
        if off > TRIM_TOLERANCE_RAD:
            raise InputError(
                f"sixdof:{name}: expected a model trimmed at {condition.airspeed_m_s:.2f} m/s and"
                f" {condition.altitude_m:.0f} m as this aircraft is, found {model.name}, {off:.4f} rad off"
            )

    def advance(self, u: Vector, w: Vector, delta: float) -> str | None:
        """Fly one sampling period (:meth:`sitl.aircraft.airframe.Airframe.advance`); ``delta`` is of no meaning."""
        state, gust = self._state, float(w[0]) if w.size else 0.0
        if self._wind is not None:
            along, across, down = self._wind.at(self._k).tolist()
            self._air = (along, across, down)
        for _ in range(self._steps):
            controls = self._hold.act(state, _through(state, self._air)[0], float(u[0]), self._dt_s)
            try:
                state = integrate(self._aircraft, state, controls, self._dt_s, gust, self._air)
            except InputError as no_air:  # at the top of the atmosphere, or far beyond its ends, within the step
                return str(no_air)
            except (ArithmeticError, ValueError):  # so far off that it has no sine any more
                return NOT_FINITE
            if (reason := _beyond(state)) is not None:
                return reason
        self._k += 1
        self._state = state
        self._read()
        return None

    def _read(self) -> None:
        state = self._state
        roll, pitch, yaw = body_angles(state)
        airspeed, alpha, beta = _through(state, self._air)
        self.pose = Pose(
            roll_rad=roll,
            pitch_rad=pitch,
            yaw_rad=yaw,
            p_rad_s=state.p,
            q_rad_s=state.q,
            r_rad_s=state.r,
            alpha_rad=alpha,
            beta_rad=beta,
            airspeed_m_s=airspeed,
            groundspeed_m_s=state.V * math.cos(state.gamma),
            altitude_m=state.height,
            climb_m_s=state.V * math.sin(state.gamma),
            throttle=self._hold.throttle,
        )
        states = (alpha, state.q, pitch)
        self.x: Vector = np.array([states[i] for i in self._order])


def _beyond(state: State) -> str | None:
    """Return why an aircraft cannot fly on, if it cannot."""
    if not all(map(math.isfinite, state)):
        return NOT_FINITE
    if state.height < 0.0:
        return "ground"
    if state.height > HIGHEST_M:
        return f"above {HIGHEST_M:.0f} m"
    if state.V < SLOWEST_M_S:
        return "no speed"
    if abs(state.gamma) > STEEPEST_RAD or abs(state.beta) > STEEPEST_RAD:
        return "flight path or sideslip beyond 89 degrees"
    return None


class _Hold:
    """Wings level, yaw damped, speed held; gains after the aircraft's own derivatives at trim.

    The roll is to be a mode of 1.2 rad/s, critically damped; the yaw rate is damped to 1 / s; the error of the speed
    goes to the thrust with 0.5 rad/s, its integral with a tenth of that.
    """

    ROLL_RAD_S = 1.2
    YAW_PER_S = 1.0
    SPEED_RAD_S = 0.5

    def __init__(self, aircraft: Aircraft, trim: State, controls: Controls) -> None:
        aero, mass = aircraft.aerodynamics, aircraft.mass
        density = standard_air(trim.height).density_kg_m3
        couple = 0.5 * density * trim.V**2 * aero.area * aero.span
        over = 0.5 * aero.span / trim.V
        aileron = couple * aero.Cl_aileron / mass.Ix
        rudder = couple * aero.Cn_rudder / mass.Iz
        roll_damping, yaw_damping = couple * over * aero.Cl_p / mass.Ix, couple * over * aero.Cn_r / mass.Iz
        full = aircraft.thrust_N(1.0, density) / mass.mass
        self._surfaces = aircraft.surfaces
        self.throttle = self._trim_throttle = controls.throttle
        self._trim_V = trim.V
        self._roll = self.ROLL_RAD_S**2 / aileron if aileron else 0.0
        self._roll_rate = max(0.0, 2.0 * self.ROLL_RAD_S + roll_damping) / aileron if aileron else 0.0
        self._yaw_rate = max(0.0, self.YAW_PER_S + yaw_damping) / rudder if rudder else 0.0
        self._speed = self.SPEED_RAD_S / full
        self._integral = self._aileron = self._rudder = 0.0

    def act(self, state: State, airspeed: float, elevator: float, dt_s: float) -> Controls:
        """Return all controls for one step of the integration."""
        surfaces = self._surfaces
        error = self._trim_V - airspeed
        wanted = self._trim_throttle + self._speed * (error + 0.1 * self.SPEED_RAD_S * self._integral)
        self.throttle = min(max(wanted, 0.0), 1.0)
        if self.throttle == wanted:  # at its stop it gathers no error
            self._integral += error * dt_s
        aileron = -self._roll * state.phi - self._roll_rate * state.p
        rudder = -self._yaw_rate * state.r
        self._aileron = _moved(self._aileron, aileron, surfaces.aileron, surfaces, dt_s)
        self._rudder = _moved(self._rudder, rudder, surfaces.rudder, surfaces, dt_s)
        return Controls(elevator, self._aileron, self._rudder, self.throttle)


def _moved(position: float, wanted: float, travel: float, surfaces: Surfaces, dt_s: float) -> float:
    """Return where a surface is after one step: lag, rate and travel."""
    target = min(max(wanted, -travel), travel)
    way = (target - position) * -math.expm1(-dt_s / surfaces.tau)
    most = surfaces.rate * dt_s
    return position + min(max(way, -most), most)
