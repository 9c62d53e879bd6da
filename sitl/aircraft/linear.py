"""The linear aircraft, Eq. (4) with the uncertainty of Eqs. (6) and (7), and its actuator: truth, no network.

    x(k+1) = (A0 + F Delta(k) J1) x(k) + (B0 + F Delta(k) J2) u(k) + E w(k)

in deviations from trim. The actuator limits the command to its travel, follows it with a first-order lag
and moves no faster than its rate; without lag and rate it is there at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gains.model import Model

__all__ = ["LinearAircraft", "move_actuator"]

Vector = NDArray[np.float64]


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
