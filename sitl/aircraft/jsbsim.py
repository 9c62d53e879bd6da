"""Aircraft of JSBSim: linearised by ``FGLinearization``, and flown sample by sample.

The law commands the elevator's surface itself. So the wire from the aircraft's own flight control system to
``fcs/elevator-pos-rad`` is cut after the trim: its filters, play and stability augmentation, which differ from
aircraft to aircraft, have no part in the longitudinal loop, which is the loop of the paper. Aileron, rudder and
throttle stay with the aircraft's own systems, commanded by a wing-leveller, a yaw damper and a throttle hold
(``jsbsimflight.py``), so that nothing but the longitudinal loop is what is tested. Fuel is not burnt.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from gains.model import Matrix, Model
from gains.table import InputError
from sitl.aircraft.airframe import Pose, Vector
from sitl.aircraft.jsbsimelevator import Elevator, elevator_of
from sitl.aircraft.jsbsimflight import PROBE_RAD, Flight, Hold
from sitl.aircraft.jsbsimload import FOOT, GROUND_M, SURFACE, aircraft_file, aircraft_names, jsbsim_package, trimmed
from sitl.aircraft.linearised import STATES, Linearised

if TYPE_CHECKING:
    import jsbsim

    from sitl.aircraft.wind import Wind

__all__ = ["JsbsimAirframe", "aircraft_names", "linearise"]

FDM_HZ = 400
"""JSBSim's own steps are at most this long, and a whole number of them is a sampling period. The loads answer the
elevator one step late, a tenth of a sample at 25 ms."""
TRIM_TOLERANCE_RAD = 1e-3
"""A model and its aircraft agree in their trim to within this, or they are not of one condition."""
TUMBLING_RAD = math.pi / 2
"""The angle of attack, either way, from which there is no more flight to speak of."""


def linearise(
    aircraft: str, *, vc_kts: float | None = None, airspeed_m_s: float | None = None, altitude_m: float
) -> Linearised:
    """Return an aircraft near level flight at constant speed.

    Parameters
    ----------
    aircraft : str
        A name of JSBSim.
    vc_kts, airspeed_m_s : float
        Calibrated airspeed in knots, or true airspeed; one of them.
    altitude_m : float
        Above sea level.

    Raises
    ------
    InputError
        When there is no such aircraft, it cannot be trimmed there, or its elevator does nothing.
    """
    flight = Flight.start(aircraft, vc_kts, airspeed_m_s, altitude_m, 1.0 / FDM_HZ)
    fdm = flight.fdm
    Ap = flight.part("Alpha", "Q", "Theta")
    Ap[2] = [0.0, 1.0, 0.0]  # wings level: what the differences see beside this is the trim's trace of roll
    lift, pitch = flight.elevator_effect()
    if abs(pitch) < 1e-6:
        raise InputError(f"jsbsim:{aircraft}: expected an aircraft that {SURFACE} pitches, found one that it does not")
    elevator = elevator_of(aircraft_file(aircraft))
    if elevator.low is None or elevator.high is None:
        elevator = elevator.within(*_travel(aircraft, vc_kts, airspeed_m_s, altitude_m))
    assert elevator.low is not None
    assert elevator.high is not None
    if not elevator.low < flight.surface_rad < elevator.high:
        raise InputError(
            f"jsbsim:{aircraft}: expected a trim within the elevator's travel, {elevator.low:.4f} to"
            f" {elevator.high:.4f} rad, found {flight.surface_rad:.4f}"
        )
    return Linearised(
        aircraft=f"jsbsim:{aircraft}",
        Ap=Ap,
        Bp=np.array([[lift], [pitch], [0.0]]),
        Ep=np.array([[1.0], [0.0], [0.0]]),
        alpha_rad=fdm["aero/alpha-rad"],
        theta_rad=fdm["attitude/theta-rad"],
        u=flight.surface_rad,
        u_low=elevator.low,
        u_high=elevator.high,
        u_rate=elevator.rate,
        u_tau=elevator.tau,
        u_unit="rad",
        airspeed_m_s=fdm["velocities/vt-fps"] * FOOT,
        altitude_m=fdm["position/h-sl-ft"] * FOOT,
        throttle=flight.throttles[0] if flight.throttles else 0.0,
        notes=_notes(flight, Ap, elevator),
    )


def _notes(flight: Flight, Ap: Matrix, elevator: Elevator) -> tuple[str, ...]:
    """Return what people should know of a linearisation."""
    fdm = flight.fdm
    rate = "as fast as it likes" if elevator.rate is None else f"at most {elevator.rate:.3g} rad/s"
    lag = "without lag" if elevator.tau is None else f"with a lag of {elevator.tau * 1e3:.3g} ms"
    return (
        f"JSBSim {jsbsim_package().__version__}, FGLinearization at {fdm['velocities/vc-kts']:.1f} kt calibrated,"
        f" {fdm['position/h-sl-ft']:.0f} ft; B by moving the elevator's surface {PROBE_RAD:g} rad each way.",
        "The law moves the elevator's surface: the aircraft's own pitch control and augmentation have no part in it.",
        f"By the aircraft's file the elevator moves {rate}, {lag}.",
        f"Modes of the longitudinal motion, 1/s: {_modes(flight.part('Vt', 'Alpha', 'Q', 'Theta'))}; at constant"
        f" speed, as here: {_modes(Ap)}. Left out: the slow mode with speed, which the throttle holds.",
    )


class JsbsimAirframe:
    """An aircraft of JSBSim in flight, from the trim of a model's condition.

    Parameters
    ----------
    aircraft : str
        A name of JSBSim.
    model : Model
        Made by ``sitl linearize`` for this aircraft; states alpha_rad, q_rad_s and theta_rad, in any order.
    wind : Wind or None
        Air that moves, in body axes.

    Attributes
    ----------
    x : (3,) array
        The model's states, absolute.
    pose : Pose

    Raises
    ------
    InputError
        When there is no such aircraft, or the model describes another one, or another condition.
    """

    def __init__(self, aircraft: str, model: Model, wind: Wind | None = None) -> None:
        condition = model.condition
        if set(model.states) != set(STATES) or model.nu != 1 or model.nw > 1 or condition is None:
            raise InputError(
                f"jsbsim:{aircraft}: expected a model with states {', '.join(STATES)}, one input, at most one"
                f" disturbance, and [condition] (sitl linearize makes one),"
                f" found {model.name} with {', '.join(model.states)}"
            )
        self._steps = math.ceil(model.Ts * FDM_HZ)
        self._dt_s = model.Ts / self._steps
        self._flight = Flight.start(aircraft, None, condition.airspeed_m_s, condition.altitude_m, self._dt_s)
        self._order = [STATES.index(name) for name in model.states]
        self._wind = wind
        self._speed = condition.airspeed_m_s
        self._k = 0
        self._rising_m_s = 0.0
        self._ended: str | None = None
        self.pose = _pose(self._flight.fdm)
        self.x = self._states()
        off = max(np.abs(self.x - model.trim.x).max(), abs(self._flight.surface_rad - model.trim.u[0]))
        if not off <= TRIM_TOLERANCE_RAD:
            raise InputError(
                f"jsbsim:{aircraft}: expected a model trimmed at {condition.airspeed_m_s:.2f} m/s and"
                f" {condition.altitude_m:.0f} m as this aircraft is, found {model.name}, {off:.4f} rad off"
            )
        self._hold = Hold.of(self._flight)

    def advance(self, u: Vector, w: Vector, delta: float) -> str | None:
        """Fly one sampling period (:meth:`sitl.aircraft.airframe.Airframe.advance`).

        The elevator and the wind are held over it; ``w``, a rate of alpha, is air that rises faster and faster.
        ``delta`` has no meaning here.
        """
        if self._ended is None:
            self._ended = self._fly(float(u[0]), self._speed * float(w[0]) if w.size else 0.0)
        return self._ended

    def _fly(self, surface_rad: float, lift_m_s2: float) -> str | None:
        """Fly one sampling period, with air that rises faster by so much each second; return why it is the last."""
        fdm = self._flight.fdm
        if not math.isfinite(surface_rad) or not math.isfinite(lift_m_s2):
            return "no finite input"
        self._flight.move(surface_rad)
        body = self._wind.at(self._k) if self._wind is not None else None
        try:
            for _ in range(self._steps):
                self._rising_m_s += lift_m_s2 * self._dt_s
                self._blow(body)
                self._hold.act(fdm, self._dt_s)
                fdm.run()
        except jsbsim_package().BaseError as failure:
            return " ".join(str(failure).split())
        self._k += 1
        pose = _pose(fdm)
        if not all(map(math.isfinite, pose)):
            return "state beyond all bounds"
        if abs(pose.alpha_rad) > TUMBLING_RAD:
            return "angle of attack beyond 90 degrees"
        if fdm["position/h-agl-ft"] * FOOT < GROUND_M:
            return "ground"
        self.pose = pose
        self.x = self._states()
        return None

    def _blow(self, body: Vector | None) -> None:
        """Let the air move: the wind in body axes, and the gust of the model, which is vertical."""
        north, east, down = 0.0, 0.0, -self._rising_m_s
        if body is not None:
            fdm = self._flight.fdm
            angles = (fdm[f"attitude/{name}-rad"] for name in ("phi", "theta", "psi"))
            wind = _to_earth(*angles) @ body
            north, east, down = north + wind[0], east + wind[1], down + wind[2]
        for axis, velocity in (("north", north), ("east", east), ("down", down)):
            self._flight.fdm[f"atmosphere/gust-{axis}-fps"] = velocity / FOOT

    def _states(self) -> Vector:
        states = (self.pose.alpha_rad, self.pose.q_rad_s, self.pose.pitch_rad)
        return np.array([states[i] for i in self._order])


def _pose(fdm: jsbsim.FGFDMExec) -> Pose:
    return Pose(
        roll_rad=fdm["attitude/phi-rad"],
        pitch_rad=fdm["attitude/theta-rad"],
        yaw_rad=fdm["attitude/psi-rad"],
        p_rad_s=fdm["velocities/p-rad_sec"],
        q_rad_s=fdm["velocities/q-rad_sec"],
        r_rad_s=fdm["velocities/r-rad_sec"],
        alpha_rad=fdm["aero/alpha-rad"],
        beta_rad=fdm["aero/beta-rad"],
        airspeed_m_s=fdm["velocities/vt-fps"] * FOOT,
        groundspeed_m_s=fdm["velocities/vg-fps"] * FOOT,
        altitude_m=fdm["position/h-sl-ft"] * FOOT,
        climb_m_s=fdm["velocities/h-dot-fps"] * FOOT,
        throttle=fdm["fcs/throttle-cmd-norm"],
    )


def _to_earth(roll: float, pitch: float, yaw: float) -> Matrix:
    """Return the rotation from body axes to north, east, down."""
    (sr, cr), (sp, cp), (sy, cy) = ((math.sin(a), math.cos(a)) for a in (roll, pitch, yaw))
    return np.array(
        [
            [cp * cy, sr * sp * cy - cr * sy, cr * sp * cy + sr * sy],
            [cp * sy, sr * sp * sy + cr * cy, cr * sp * sy - sr * cy],
            [-sp, sr * cp, cr * cp],
        ]
    )


def _travel(aircraft: str, vc_kts: float | None, airspeed_m_s: float | None, altitude_m: float) -> tuple[float, float]:
    """Return the elevator's stops, rad: how far the aircraft's own control moves it within a second of full stick."""
    ends = []
    for stick in (-1.0, 1.0):
        fdm = trimmed(aircraft, vc_kts=vc_kts, airspeed_m_s=airspeed_m_s, altitude_m=altitude_m, dt_s=1.0 / FDM_HZ)
        fdm["fcs/elevator-cmd-norm"], fdm["fcs/pitch-trim-cmd-norm"] = stick, 0.0
        for _ in range(FDM_HZ):
            fdm.run()
            ends.append(fdm[SURFACE])
    return min(ends), max(ends)


def _modes(A: Matrix) -> str:
    """Return the eigenvalues of a matrix as text."""
    values = sorted(np.linalg.eigvals(A).astype(complex), key=lambda value: (-abs(value), value.imag))
    return ", ".join(
        f"{round(value.real, 3) + 0.0:.3f}" if abs(value.imag) < 1e-9 else f"{value.real:.3f}±{value.imag:.3f}i"
        for value in values
        if value.imag >= -1e-9
    )
