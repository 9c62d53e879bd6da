"""A trimmed aircraft of JSBSim whose elevator is ours, and what holds the rest of it where it was.

JSBSim writes the elevator's surface from the aircraft's own flight control system in each step. Its property is made
read-only to that, and writable for the moment in which ours is written: no aircraft's file need be changed for it, and
whatever the aircraft has between stick and surface is out of the way.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from gains.model import Matrix
from gains.table import InputError
from sitl.aircraft.jsbsimload import SURFACE, jsbsim_package, trimmed

if TYPE_CHECKING:
    import jsbsim

__all__ = ["PROBE_RAD", "Flight", "Hold"]

PROBE_RAD = 0.01
"""How far the elevator is moved each way to see what it does."""
UNSETTLED = frozenset({"Boeing314"})
"""Aircraft whose engines find no steady state: FGLinearization would look for it for hours, deaf to Ctrl-C."""


@dataclass(slots=True)
class Flight:
    """A trimmed aircraft whose elevator is ours.

    Attributes
    ----------
    fdm : jsbsim.FGFDMExec
    A, B : ndarray
        FGLinearization's matrices with the elevator's surface held; rad and ft/s.
    states, inputs : list of str
        Their names.
    surface_rad : float
        The elevator at trim.
    throttles : list of float
        Of each engine at trim.
    node : jsbsim.FGPropertyNode
        The property that is the elevator's surface.
    """

    fdm: jsbsim.FGFDMExec
    A: Matrix
    B: Matrix
    states: list[str]
    inputs: list[str]
    surface_rad: float
    throttles: list[float]
    node: jsbsim.FGPropertyNode

    @classmethod
    def start(
        cls, aircraft: str, vc_kts: float | None, airspeed_m_s: float | None, altitude_m: float, dt_s: float
    ) -> Flight:
        """Load an aircraft, trim it, cut the elevator's wire, and linearise what is left."""
        if aircraft in UNSETTLED:
            raise InputError(f"jsbsim:{aircraft}: expected an aircraft whose engines settle, found one whose never do")
        package = jsbsim_package()
        fdm = trimmed(aircraft, vc_kts=vc_kts, airspeed_m_s=airspeed_m_s, altitude_m=altitude_m, dt_s=dt_s)
        surface = fdm[SURFACE]
        node = fdm.get_property_manager().get_node(SURFACE)
        assert node is not None
        node.set_attribute(package.Attribute.WRITE, False)
        linear = package.FGLinearization(fdm)
        fdm.set_dt(dt_s)  # it has stopped the time
        return cls(
            fdm,
            np.array(linear.system_matrix),
            np.array(linear.input_matrix),
            list(linear.x_names),
            list(linear.u_names),
            surface,
            [fdm[_throttle(n)] for n in range(fdm.get_propulsion().get_num_engines())],
            node,
        )

    def part(self, *names: str) -> Matrix:
        """Return A of some of the states, the others held."""
        rows = [self.states.index(name) for name in names]
        return self.A[np.ix_(rows, rows)]

    def entry(self, matrix: Matrix, row: str, column: str) -> float:
        """Return an entry of A or B by its names."""
        columns = self.states if matrix is self.A else self.inputs
        return float(matrix[self.states.index(row), columns.index(column)])

    def move(self, surface_rad: float) -> None:
        """Put the elevator's surface somewhere, and keep the aircraft's own control away from it."""
        write = jsbsim_package().Attribute.WRITE
        self.node.set_attribute(write, True)
        self.node.set_double_value(surface_rad)
        self.node.set_attribute(write, False)

    def elevator_effect(self) -> tuple[float, float]:
        """Return what a radian of elevator does to alpha' and q', by central difference with time standing still."""
        fdm, ends = self.fdm, []
        dt_s = fdm.get_delta_t()
        fdm.suspend_integration()
        for offset in (PROBE_RAD, -PROBE_RAD, 0.0):  # at last back to the trim
            self.move(self.surface_rad + offset)
            for _ in range(3):  # what depends on what was computed a step before settles
                fdm.run()
            ends.append((fdm["aero/alphadot-rad_sec"], fdm["accelerations/qdot-rad_sec2"]))
        fdm.resume_integration()
        fdm.set_dt(dt_s)
        (lift_up, pitch_up), (lift_down, pitch_down), _ = ends
        return (lift_up - lift_down) / (2.0 * PROBE_RAD), (pitch_up - pitch_down) / (2.0 * PROBE_RAD)


@dataclass(slots=True)
class Hold:
    """Wings level, yaw damped, airspeed held: what keeps everything but the longitudinal loop out of the way.

    The gains follow from the linearisation: the roll shall be a mode of 2 rad/s, critically damped; the yaw rate is
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

    ROLL_RAD_S: ClassVar[float] = 2.0
    YAW_PER_S: ClassVar[float] = 1.0
    SPEED_RAD_S: ClassVar[float] = 0.5

    @classmethod
    def of(cls, flight: Flight) -> Hold:
        """Return the hold of a trimmed aircraft; what has no effect there is left alone."""
        fdm, A, B = flight.fdm, flight.A, flight.B
        aileron, rudder = flight.entry(B, "P", "DaCmd"), flight.entry(B, "R", "DrCmd")
        thrust = flight.entry(B, "Vt", "ThtlCmd")
        return cls(
            roll=cls.ROLL_RAD_S**2 / aileron if aileron else 0.0,
            roll_rate=max(0.0, 2.0 * cls.ROLL_RAD_S + flight.entry(A, "P", "P")) / aileron if aileron else 0.0,
            yaw_rate=max(0.0, cls.YAW_PER_S + flight.entry(A, "R", "R")) / rudder if rudder else 0.0,
            speed=cls.SPEED_RAD_S / thrust if thrust > 0.0 else 0.0,
            trim_ft_s=fdm["velocities/vt-fps"],
            aileron=fdm["fcs/aileron-cmd-norm"],
            rudder=fdm["fcs/rudder-cmd-norm"],
            throttles=list(flight.throttles),
        )

    def act(self, fdm: jsbsim.FGFDMExec, dt_s: float) -> None:
        """Command aileron, rudder and throttle for one step of JSBSim, each within its travel."""
        roll, p, r = fdm["attitude/phi-rad"], fdm["velocities/p-rad_sec"], fdm["velocities/r-rad_sec"]
        fdm["fcs/aileron-cmd-norm"] = _limited(self.aileron - self.roll * roll - self.roll_rate * p, -1.0, 1.0)
        fdm["fcs/rudder-cmd-norm"] = _limited(self.rudder - self.yaw_rate * r, -1.0, 1.0)
        error = self.trim_ft_s - fdm["velocities/vt-fps"]
        wanted = self.speed * (error + 0.1 * self.SPEED_RAD_S * self.integral)
        commands = [throttle + wanted for throttle in self.throttles]
        if all(0.0 < command < 1.0 for command in commands):  # at its stop the throttle gathers no error
            self.integral += error * dt_s
        for n, command in enumerate(commands):
            fdm[_throttle(n)] = _limited(command, 0.0, 1.0)


def _limited(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


def _throttle(n: int) -> str:
    return f"fcs/throttle-cmd-norm[{n}]"
