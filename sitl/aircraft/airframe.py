"""What the plant's Node asks of an aircraft: its state, its pose, and to be moved to the next sample.

An airframe is the truth of one flight and holds its state: a linear model (``linear.py``), the six degrees of freedom
of Eq. (1) (``sixdof.py``), or an aircraft of JSBSim (``jsbsim.py``). It knows no network, no sensor fault, no latch.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = ["Airframe", "Pose", "Vector"]

Vector = NDArray[np.float64]


class Pose(NamedTuple):
    """What the messages to the autopilot say beside the states of the model; an airframe without a quantity says 0.

    Attributes
    ----------
    roll_rad, pitch_rad, yaw_rad : float
        Euler angles of the body axes.
    p_rad_s, q_rad_s, r_rad_s : float
        Body rates.
    alpha_rad, beta_rad : float
        Angles of attack and sideslip, against the moving air.
    airspeed_m_s, groundspeed_m_s : float
        True airspeed, and speed over the ground.
    altitude_m, climb_m_s : float
        Above sea level, and its rate.
    throttle : float
        Of the engine, 0 to 1.
    """

    roll_rad: float = 0.0
    pitch_rad: float = 0.0
    yaw_rad: float = 0.0
    p_rad_s: float = 0.0
    q_rad_s: float = 0.0
    r_rad_s: float = 0.0
    alpha_rad: float = 0.0
    beta_rad: float = 0.0
    airspeed_m_s: float = 0.0
    groundspeed_m_s: float = 0.0
    altitude_m: float = 0.0
    climb_m_s: float = 0.0
    throttle: float = 0.0


class Airframe(Protocol):
    """One aircraft in one flight."""

    @property
    def x(self) -> Vector:
        """The states of the model, absolute, in its order and units; shape (nx,)."""

    @property
    def pose(self) -> Pose:
        """Attitude, rates, air data and position now."""

    def advance(self, u: Vector, w: Vector, delta: float) -> str | None:
        """Fly one sampling period.

        Parameters
        ----------
        u : (nu,) array
            Position of the actuator over it, absolute, units of the model's u.
        w : (nw,) array
            Disturbance held over it, in the units of E's columns: for the models here a gust as a rate of alpha, rad/s.
        delta : float
            Delta(k) of Eq. (6); an airframe that is no linear model ignores it.

        Returns
        -------
        str or None
            Why the aircraft cannot fly on, such as ground or a state beyond all bounds; it then stays where it is.
        """
