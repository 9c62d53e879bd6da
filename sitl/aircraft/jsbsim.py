"""Aircraft of JSBSim: loaded, trimmed, linearised by ``FGLinearization``, and flown sample by sample.

The law commands the elevator's surface itself. So the wire from the aircraft's own flight control system to
``fcs/elevator-pos-rad`` is cut after the trim: its filters, play and stability augmentation, which differ from
aircraft to aircraft, have no part in the longitudinal loop, which is the loop of the paper. Aileron, rudder and
throttle stay with the aircraft's own systems, commanded by a wing-leveller, a yaw damper and a throttle hold
(``_Hold``), so that nothing but the longitudinal loop is what is tested. Fuel is not burnt.

JSBSim comes with the extra ``lagproof[jsbsim]``. Aircraft files may ask for sockets and output files; both are taken
out before JSBSim sees them.
"""

from __future__ import annotations

import difflib
import math
import shutil
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np

from gains.model import Matrix, Model
from gains.table import InputError
from sitl.aircraft.airframe import Pose, Vector
from sitl.aircraft.linearised import STATES, Linearised

if TYPE_CHECKING:
    from jsbsim import FGFDMExec, FGPropertyNode

    from sitl.aircraft.wind import Wind

__all__ = ["JsbsimAirframe", "aircraft_names", "linearise"]

FOOT = 0.3048
KNOT_FT_S = 1.687810
FDM_HZ = 400
"""JSBSim's own steps are at most this long, and a whole number of them is a sampling period."""
SURFACE = "fcs/elevator-pos-rad"
PROBE_RAD = 0.01
"""How far the elevator is moved each way to see what it does."""
TRIM_TOLERANCE_RAD = 1e-3
"""A model and its aircraft agree in their trim to within this, or they are not of one condition."""
GROUND_FT = 10.0
STALLED_RAD = math.pi / 2


def aircraft_names() -> list[str]:
    """Return the aircraft that JSBSim comes with.

    Raises
    ------
    InputError
        When JSBSim is not installed.
    """
    root = _root() / "aircraft"
    return sorted(folder.name for folder in root.iterdir() if (folder / f"{folder.name}.xml").is_file())


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
    low, high = _travel(aircraft, vc_kts, airspeed_m_s, altitude_m)
    flight = _Flight.trimmed(aircraft, vc_kts, airspeed_m_s, altitude_m, 1.0 / FDM_HZ)
    fdm, A, names = flight.fdm, flight.A, flight.states
    rows = [names.index(name) for name in ("Alpha", "Q", "Theta")]
    B = _effect(flight)
    if abs(B[1]) < 1e-6:
        raise InputError(f"jsbsim:{aircraft}: expected an aircraft that {SURFACE} pitches, found one that it does not")
    whole = [names.index(name) for name in ("Vt", "Alpha", "Q", "Theta")]
    Ap = A[np.ix_(rows, rows)]
    Ap[2] = [0.0, 1.0, 0.0]  # wings level: what the differences see beside this is the trim's trace of roll
    return Linearised(
        aircraft=f"jsbsim:{aircraft}",
        Ap=Ap,
        Bp=np.array([[B[0]], [B[1]], [0.0]]),
        Ep=np.array([[1.0], [0.0], [0.0]]),
        alpha_rad=fdm["aero/alpha-rad"],
        theta_rad=fdm["attitude/theta-rad"],
        u=flight.surface_rad,
        u_low=low,
        u_high=high,
        u_rate=None,
        u_tau=None,
        u_unit="rad",
        airspeed_m_s=fdm["velocities/vt-fps"] * FOOT,
        altitude_m=fdm["position/h-sl-ft"] * FOOT,
        throttle=flight.throttles[0],
        notes=(
            f"JSBSim {_version()}, FGLinearization at {fdm['velocities/vc-kts']:.1f} kt calibrated,"
            f" {fdm['position/h-sl-ft']:.0f} ft; B by moving the elevator's surface {PROBE_RAD:g} rad each way.",
            "The law moves the elevator's surface: the aircraft's own pitch control has no part in it.",
            f"Modes, 1/s, of the longitudinal motion with speed: {_modes(A[np.ix_(whole, whole)])};",
            f"at constant speed, as here: {_modes(Ap)}.",
        ),
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

    Raises
    ------
    InputError
        When there is no such aircraft, or the model describes another one, or another condition.
    """

    def __init__(self, aircraft: str, model: Model, wind: Wind | None = None) -> None:
        condition = model.condition
        if set(model.states) != set(STATES) or model.nu != 1 or condition is None:
            raise InputError(
                f"jsbsim:{aircraft}: expected a model with states {', '.join(STATES)}, one input and [condition]"
                f" (sitl linearize makes one), found {model.name} with {', '.join(model.states)}"
            )
        self._steps = math.ceil(model.Ts * FDM_HZ)
        self._flight = _Flight.trimmed(
            aircraft, None, condition.airspeed_m_s, condition.altitude_m, model.Ts / self._steps
        )
        self._order = [STATES.index(name) for name in model.states]
        self._wind = wind
        self._speed = condition.airspeed_m_s
        self._Ts = model.Ts
        self._k = 0
        self._down_m_s = 0.0
        self._read()
        off = max(np.abs(self.x - model.trim.x).max(), abs(self._flight.surface_rad - model.trim.u[0]))
        if off > TRIM_TOLERANCE_RAD:
            raise InputError(
                f"jsbsim:{aircraft}: expected a model trimmed at {condition.airspeed_m_s:.2f} m/s and"
                f" {condition.altitude_m:.0f} m as this aircraft is, found {model.name}, {off:.4f} rad off"
            )
        self._hold = _Hold.of(self._flight)

    def advance(self, u: Vector, w: Vector, delta: float) -> str | None:
        """Fly one sampling period (:meth:`sitl.aircraft.airframe.Airframe.advance`); ``delta`` is of no meaning."""
        fdm = self._flight.fdm
        self._flight.move(float(u[0]))
        rising = self._speed * float(w[0]) if w.size else 0.0
        body = self._wind.at(self._k) if self._wind is not None else None
        for _ in range(self._steps):
            self._down_m_s -= rising * self._Ts / self._steps
            self._blow(body)
            self._hold.act(fdm, self._Ts / self._steps)
            fdm.run()
        self._k += 1
        if not all(map(math.isfinite, (fdm["aero/alpha-rad"], fdm["attitude/theta-rad"], fdm["velocities/vt-fps"]))):
            return "no finite state"
        self._read()
        if fdm["position/h-agl-ft"] < GROUND_FT:
            return "ground"
        if abs(self.pose.alpha_rad) > STALLED_RAD:
            return "angle of attack beyond 90 degrees"
        return None

    def _blow(self, body: Vector | None) -> None:
        """Let the air move: the wind in body axes, and the gust of the model, which is vertical."""
        north, east, down = (0.0, 0.0, self._down_m_s)
        if body is not None:
            pose = self.pose
            wind = _to_earth(pose.roll_rad, pose.pitch_rad, pose.yaw_rad) @ body
            north, east, down = north + wind[0], east + wind[1], down + wind[2]
        elif not down:
            return
        fdm = self._flight.fdm
        for axis, velocity in (("north", north), ("east", east), ("down", down)):
            fdm[f"atmosphere/gust-{axis}-fps"] = velocity / FOOT

    def _read(self) -> None:
        fdm = self._flight.fdm
        self.pose = Pose(
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
            climb_m_s=-fdm["velocities/v-down-fps"] * FOOT,
            throttle=fdm["fcs/throttle-cmd-norm"],
        )
        states = (self.pose.alpha_rad, self.pose.q_rad_s, self.pose.pitch_rad)
        self.x: Vector = np.array([states[i] for i in self._order])


@dataclass(slots=True)
class _Flight:
    """A trimmed aircraft whose elevator is ours.

    Attributes
    ----------
    fdm : FGFDMExec
    A, B : ndarray
        FGLinearization's matrices with the elevator's surface held: units rad and ft/s.
    states, inputs : list of str
        Their names.
    surface_rad : float
        The elevator at trim.
    throttles : list of float
        Of each engine at trim.
    node : jsbsim.FGPropertyNode
        The property that is the elevator's surface.
    """

    fdm: FGFDMExec
    A: Matrix
    B: Matrix
    states: list[str]
    inputs: list[str]
    surface_rad: float
    throttles: list[float]
    node: FGPropertyNode

    @classmethod
    def trimmed(
        cls, aircraft: str, vc_kts: float | None, airspeed_m_s: float | None, altitude_m: float, dt_s: float
    ) -> _Flight:
        """Load an aircraft, trim it, cut the elevator's wire, and linearise what is left."""
        jsbsim = _jsbsim()
        fdm = _trimmed(aircraft, vc_kts, airspeed_m_s, altitude_m, dt_s)
        surface = fdm[SURFACE]
        node = fdm.get_property_manager().get_node(SURFACE)
        assert node is not None
        node.set_attribute(jsbsim.Attribute.WRITE, False)
        linear = jsbsim.FGLinearization(fdm)
        fdm.set_dt(dt_s)  # it has stopped the time
        return cls(
            fdm,
            np.array(linear.system_matrix),
            np.array(linear.input_matrix),
            list(linear.x_names),
            list(linear.u_names),
            surface,
            _throttles(fdm),
            node,
        )

    def move(self, surface_rad: float) -> None:
        """Put the elevator's surface somewhere, and keep the aircraft's own control away from it."""
        write = _jsbsim().Attribute.WRITE
        self.node.set_attribute(write, True)
        self.node.set_double_value(surface_rad)
        self.node.set_attribute(write, False)


@dataclass(slots=True)
class _Hold:
    """Wings level, yaw damped, airspeed held: what keeps everything but the longitudinal loop out of the way.

    The gains follow from the linearisation: the roll shall be a mode of 1.2 rad/s, critically damped; the yaw rate is
    damped to 1 / s; the airspeed error goes with 0.5 rad/s to the throttle, and its integral with a tenth of that.
    """

    roll: float
    roll_rate: float
    yaw_rate: float
    speed: float
    trim_ft_s: float
    aileron: float
    rudder: float
    throttles: list[float]
    integral: float = 0.0

    ROLL_RAD_S = 1.2
    YAW_PER_S = 1.0
    SPEED_RAD_S = 0.5

    @classmethod
    def of(cls, flight: _Flight) -> _Hold:
        """Return the hold of a trimmed aircraft."""
        fdm = flight.fdm

        def A(row: str, column: str) -> float:
            return float(flight.A[flight.states.index(row), flight.states.index(column)])

        def B(row: str, column: str) -> float:
            return float(flight.B[flight.states.index(row), flight.inputs.index(column)])

        aileron, rudder, thrust = B("P", "DaCmd"), B("R", "DrCmd"), B("Vt", "ThtlCmd")
        return cls(
            roll=cls.ROLL_RAD_S**2 / aileron if aileron else 0.0,
            roll_rate=max(0.0, 2.0 * cls.ROLL_RAD_S + A("P", "P")) / aileron if aileron else 0.0,
            yaw_rate=max(0.0, cls.YAW_PER_S + A("R", "R")) / rudder if rudder else 0.0,
            speed=cls.SPEED_RAD_S / thrust if thrust > 0.0 else 0.0,
            trim_ft_s=fdm["velocities/vt-fps"],
            aileron=fdm["fcs/aileron-cmd-norm"],
            rudder=fdm["fcs/rudder-cmd-norm"],
            throttles=list(flight.throttles),
        )

    def act(self, fdm: FGFDMExec, dt_s: float) -> None:
        """Command aileron, rudder and throttle for one step of JSBSim."""
        roll, p, r = fdm["attitude/phi-rad"], fdm["velocities/p-rad_sec"], fdm["velocities/r-rad_sec"]
        fdm["fcs/aileron-cmd-norm"] = _clipped(self.aileron - self.roll * roll - self.roll_rate * p, -1.0, 1.0)
        fdm["fcs/rudder-cmd-norm"] = _clipped(self.rudder - self.yaw_rate * r, -1.0, 1.0)
        error = self.trim_ft_s - fdm["velocities/vt-fps"]
        wanted = self.speed * (error + 0.1 * self.SPEED_RAD_S * self.integral)
        commands = [throttle + wanted for throttle in self.throttles]
        if all(0.0 < command < 1.0 for command in commands):  # at its stop the throttle gathers no error
            self.integral += error * dt_s
        for n, command in enumerate(commands):
            fdm[_throttle(n)] = _clipped(command, 0.0, 1.0)


def _clipped(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


def _throttle(n: int) -> str:
    return f"fcs/throttle-cmd-norm[{n}]"


def _throttles(fdm: FGFDMExec) -> list[float]:
    return [fdm[_throttle(n)] for n in range(fdm.get_propulsion().get_num_engines())]


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


def _effect(flight: _Flight) -> tuple[float, float]:
    """Return what a radian of elevator does to alpha' and q', by central difference with time standing still."""
    fdm, ends = flight.fdm, []
    dt_s = fdm.get_delta_t()
    fdm.suspend_integration()
    for sign in (1.0, -1.0):
        flight.move(flight.surface_rad + sign * PROBE_RAD)
        for _ in range(3):  # what depends on what was computed a step before settles
            fdm.run()
        ends.append((fdm["aero/alphadot-rad_sec"], fdm["accelerations/qdot-rad_sec2"]))
    flight.move(flight.surface_rad)
    for _ in range(3):
        fdm.run()
    fdm.resume_integration()
    fdm.set_dt(dt_s)
    (alpha_high, q_high), (alpha_low, q_low) = ends
    return (alpha_high - alpha_low) / (2.0 * PROBE_RAD), (q_high - q_low) / (2.0 * PROBE_RAD)


def _travel(aircraft: str, vc_kts: float | None, airspeed_m_s: float | None, altitude_m: float) -> tuple[float, float]:
    """Return the elevator's stops, rad: how far the aircraft's own control moves it within a second of full stick."""
    ends = []
    for stick in (-1.0, 1.0):
        fdm = _trimmed(aircraft, vc_kts, airspeed_m_s, altitude_m, 1.0 / FDM_HZ)
        fdm["fcs/elevator-cmd-norm"] = stick
        fdm["fcs/pitch-trim-cmd-norm"] = 0.0
        for _ in range(FDM_HZ):
            fdm.run()
            ends.append(fdm[SURFACE])
    return min(ends), max(ends)


def _trimmed(
    aircraft: str, vc_kts: float | None, airspeed_m_s: float | None, altitude_m: float, dt_s: float
) -> FGFDMExec:
    """Load an aircraft and trim it in level flight, its engines running.

    Raises
    ------
    InputError
        When there is no such aircraft, or no such trim.
    """
    jsbsim = _jsbsim()
    assert (vc_kts is None) != (airspeed_m_s is None)
    fdm = _loaded(aircraft)
    fdm.set_dt(dt_s)
    fdm["ic/h-sl-ft"] = altitude_m / FOOT
    if vc_kts is not None:
        fdm["ic/vc-kts"] = vc_kts
        speed = f"{vc_kts:g} kt"
    else:
        assert airspeed_m_s is not None
        fdm["ic/vt-fps"] = airspeed_m_s / FOOT
        speed = f"{airspeed_m_s:g} m/s"
    fdm["ic/gamma-deg"] = 0.0
    where = f"jsbsim:{aircraft}: expected a trim in level flight at {speed} and {altitude_m:.0f} m"
    try:
        fdm.run_ic()
        fdm["propulsion/set-running"] = -1
        fdm["simulation/do_simple_trim"] = 1
    except (jsbsim.TrimFailureError, jsbsim.BaseError) as failure:
        raise InputError(f"{where}, found none: {str(failure).strip() or 'trim failed'}") from None
    fdm["propulsion/fuel_freeze"] = 1
    if fdm["position/h-agl-ft"] < GROUND_FT:
        raise InputError(f"{where}, found the ground there")
    return fdm


def _loaded(aircraft: str) -> FGFDMExec:
    """Return JSBSim with an aircraft, which can neither talk to the network nor write files."""
    jsbsim = _jsbsim()
    known = aircraft_names()
    if aircraft not in known:
        near = difflib.get_close_matches(aircraft, known, 1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise InputError(f"jsbsim:{aircraft}: expected an aircraft that JSBSim has, found no such one{hint}")
    root = _root()
    with tempfile.TemporaryDirectory(prefix="lagproof-") as folder:
        copy = Path(folder) / aircraft
        shutil.copytree(root / "aircraft" / aircraft, copy)
        _silence(copy / f"{aircraft}.xml")
        fdm: FGFDMExec = jsbsim.FGFDMExec(str(root))
        fdm.set_debug_level(0)
        loaded = fdm.load_model_with_paths(aircraft, folder, str(root / "engine"), str(root / "systems"))
    if not loaded:
        raise InputError(f"jsbsim:{aircraft}: expected an aircraft that JSBSim can load, found that it cannot")
    return fdm


def _silence(path: Path) -> None:
    """Take the sockets and output files out of an aircraft's file."""
    tree = ElementTree.parse(path)
    top = tree.getroot()
    for element in [*top.findall("input"), *top.findall("output")]:
        top.remove(element)
    tree.write(path, encoding="utf-8", xml_declaration=True)


def _modes(A: Matrix) -> str:
    """Return the eigenvalues of a matrix as text, 1/s."""
    values = sorted(np.linalg.eigvals(A), key=lambda value: (-abs(value), value.imag))
    shown = [
        f"{v.real:.3f}" if abs(v.imag) < 1e-9 else f"{v.real:.3f}±{v.imag:.3f}i" for v in values if v.imag >= -1e-9
    ]
    return ", ".join(shown)


def _root() -> Path:
    return Path(_jsbsim().get_default_root_dir())


def _version() -> str:
    return str(_jsbsim().__version__)


@cache
def _jsbsim() -> Any:
    """Return JSBSim, silent.

    Raises
    ------
    InputError
        When it is not installed.
    """
    try:
        import jsbsim
    except ImportError:
        raise InputError("jsbsim: expected it to be installed: pip install 'lagproof[jsbsim]'") from None
    jsbsim.FGJSBBase().debug_lvl = 0  # type: ignore[no-untyped-call]  # else it prints a banner
    return jsbsim
