"""The linear aircraft, Eq. (4) with the uncertainty of Eqs. (6) and (7), and its actuator: truth, no network.

    x(k+1) = (A0 + F Delta(k) J1) x(k) + (B0 + F Delta(k) J2) u(k) + E w(k)

in deviations from trim; ``LinearAirframe`` flies it. The actuator limits the command to its travel, follows
it with a first-order lag and moves no faster than its rate; without lag and rate it is there at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gains.model import Model
from sitl.aircraft.airframe import Pose

__all__ = ["DIVERGED", "LinearAircraft", "LinearAirframe", "move_actuator"]

Vector = NDArray[np.float64]

DIVERGED = 1e6
"""A state beyond this is a crash: the aircraft stays where it is."""

_POSE_OF = {
    "ATTITUDE.roll": "roll_rad",
    "ATTITUDE.pitch": "pitch_rad",
    "ATTITUDE.yaw": "yaw_rad",
    "ATTITUDE.rollspeed": "p_rad_s",
    "ATTITUDE.pitchspeed": "q_rad_s",
    "ATTITUDE.yawspeed": "r_rad_s",
    "AOA_SSA.AOA": "alpha_rad",
    "AOA_SSA.SSA": "beta_rad",
}
"""What a state is, by the message field that carries it."""


@dataclass(frozen=True, slots=True)
class LinearAircraft:
    """The plant of a model file.

    Parameters
    ----------
    model : Model
        A, B, E, and F, J1, J2 where it has them.
    """

    model: Model

    def step(self, x: Vector, u: Vector, w: Vector, delta: float) -> Vector:
        """Return x(k+1).

        Parameters
        ----------
        x : (nx,) array
            State at sample k, absolute.
        u : (nu,) array
            Input held over [k, k+1), absolute.
        w : (nw,) array
            Disturbance held over [k, k+1), in the units of E's columns.
        delta : float
            Delta(k): the same scalar on the diagonal.
        """
        m = self.model
        dx, du = x - m.trim.x, u - m.trim.u
        following = m.A @ dx + m.B @ du + m.E @ w
        if delta and m.uncertainty is not None:
            following = following + m.uncertainty.F @ (delta * (m.uncertainty.J1 @ dx + m.uncertainty.J2 @ du))
        return np.asarray(m.trim.x + following)


class LinearAirframe:
    """A linear aircraft in flight, at the speed of the model's condition; its altitude follows the flight path.

    Parameters
    ----------
    model : Model
        The aircraft; ``sensors`` says what its states are.
    x0 : (nx,) array, optional
        State at the beginning, absolute; trim by default.

    Attributes
    ----------
    x : (nx,) array
        The state, absolute.
    pose : Pose
        What it says, with speed and altitude.
    """

    def __init__(self, model: Model, x0: Vector | None = None) -> None:
        self.x: Vector = np.array(model.trim.x if x0 is None else x0, dtype=np.float64)
        condition = model.condition
        self._aircraft = LinearAircraft(model)
        self._Ts = model.Ts
        self._states = [(i, _POSE_OF[sensor]) for i, sensor in _sensed(model) if sensor in _POSE_OF]
        self._speed = condition.airspeed_m_s if condition is not None else 0.0
        self.pose = self._pose(condition.altitude_m if condition is not None else 0.0)

    def advance(self, u: Vector, w: Vector, delta: float) -> str | None:
        """Fly one sampling period (:meth:`sitl.aircraft.airframe.Airframe.advance`)."""
        following = self._aircraft.step(self.x, u, w, delta)
        if not all(-DIVERGED < value < DIVERGED for value in following.tolist()):
            return f"state beyond {DIVERGED:g}"
        self.x = following
        self.pose = self._pose(self.pose.altitude_m + self.pose.climb_m_s * self._Ts)
        return None

    def _pose(self, altitude: float) -> Pose:
        """Return what the states say, at an altitude."""
        x, speed = self.x.tolist(), self._speed
        said = {name: x[i] for i, name in self._states}
        climb = speed * math.sin(said.get("pitch_rad", 0.0) - said.get("alpha_rad", 0.0))
        return Pose(**said, airspeed_m_s=speed, groundspeed_m_s=speed, altitude_m=altitude, climb_m_s=climb)


def _sensed(model: Model) -> list[tuple[int, str]]:
    """Return the number of each state that a message carries, and the field."""
    return [(i, model.sensors[state]) for i, state in enumerate(model.states) if state in model.sensors]


def move_actuator(model: Model, position: Vector, command: Vector) -> Vector:
    """Return the actuator's position over the next sampling period, in units of u.

    Parameters
    ----------
    position : (nu,) array
        Where it was over the last period.
    command : (nu,) array
        Where it shall go.
    """
    actuator = model.actuator
    if actuator is None:
        return command
    target = command
    if actuator.low is not None and actuator.high is not None:
        target = np.clip(command, actuator.low, actuator.high)
    if actuator.tau is not None:
        moved = [0.0 if tau == 0.0 else math.exp(-model.Ts / tau) for tau in actuator.tau]
        target = target + np.array(moved) * (position - target)
    if actuator.rate is not None:
        furthest = actuator.rate * model.Ts
        target = position + np.clip(target - position, -furthest, furthest)
    return np.asarray(target)
