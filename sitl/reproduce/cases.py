"""What is flown: delays of Figures 2 to 4, window and step of Figures 5 to 7, controllers beside each other.

A controller more is a line more in ``CONTROLLERS``; one whose gain file is not installed is reported as not there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

__all__ = [
    "CONTROLLERS",
    "DURATION_S",
    "D_MAX",
    "D_MIN",
    "PENDULUM",
    "PENDULUM_DELAYS",
    "PENDULUM_LONG_S",
    "PENDULUM_S",
    "PENDULUM_X0",
    "PUBLISHED",
    "SETTLED_S",
    "STEP_DEG",
    "Controller",
    "Role",
]

Role = Literal["published", "ours", "comparison"]


@dataclass(frozen=True, slots=True)
class Controller:
    """One controller of Figures 6 and 7.

    Attributes
    ----------
    gains : str
        Its stored gain file.
    label : str
        As figures and tables call it.
    role : Role
        Whose it is; claims about our own designs are made of ``ours`` alone.
    """

    gains: str
    label: str
    role: Role


PUBLISHED = "hirm-paper"
CONTROLLERS = (
    Controller(PUBLISHED, "published (54)", "published"),
    Controller("hirm-d3", "ours, hirm-d3", "ours"),
    Controller("hirm-d4", "ours, hirm-d4", "ours"),
    Controller("hirm-dfsm", "DFSM", "comparison"),
    Controller("hirm-lq", "LQ", "comparison"),
    Controller("hirm-smith", "Smith predictor", "comparison"),
)

PENDULUM = "pendulum-paper"
PENDULUM_DELAYS = (4, 6, 7, 8)
"""Constant delays, samples: the paper's 4 and 6, the last that is stable and the first that is not."""
PENDULUM_X0 = (0.02, 0.0)
"""State at k = 0, rad and rad/s: the paper prints none; at this one no flight meets the actuator's stops."""
PENDULUM_S = 9.0
PENDULUM_LONG_S = 60.0
"""Length of the flights, s; of the one that a breaking sequence drives, which grows slowly, the longer."""

D_MIN, D_MAX = 1, 3
"""Window of the random d(k), samples: the paper prints none; in this one every gain set here is proved."""
STEP_DEG = 1.0
"""Step of r at k = 0, deg: r = 1 in the paper's unit."""
DURATION_S = 10.0
SETTLED_S = 8.0
"""From here on the step response has settled, and what remains of the error is the settled one."""
