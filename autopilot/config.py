"""What one autopilot flies, and how: the options of the program as values."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from autopilot.alpha import AlphaChoice
from autopilot.link.clock import NS_PER_S
from autopilot.monitors import SATURATION_NS
from autopilot.reference import Profile
from gains.model import GainLaw

__all__ = ["AutopilotConfig"]


@dataclass(frozen=True, slots=True)
class AutopilotConfig:
    """What one autopilot flies, and how.

    Attributes
    ----------
    gains : Gains or Schedule
        K1 and K2 with their windows, and the model; the conservative gains too, if the file names some.
    profile : Profile
        The programmed reference.
    actuator : "pwm" or "float"
        SERVO_OUTPUT_RAW or HIL_ACTUATOR_CONTROLS to the plant.
    failsafe : "on" or "monitor"
        "monitor" reports every transition, and lets the law fly all the same.
    alpha : "auto", "aoa_ssa" or "vfr_hud"
        Where the angle of attack comes from (:mod:`autopilot.alpha`).
    align : bool
        Whether the reference is looked ahead by the forecast of d; without it a command carries xr of its sample.
    hold_ns : int
        How long the last command is held before neutral.
    saturation_ns : int
        How long the elevator may stay at its limit; 0 for ever.
    ground_timeout_ns : int
        Silence of all ground stations that counts as a loss, once one was heard; 0 for none.
    ground_stations : int
        Number of ports gcs0, gcs1, ...
    """

    gains: GainLaw
    profile: Profile = field(default_factory=Profile)
    actuator: Literal["pwm", "float"] = "pwm"
    failsafe: Literal["on", "monitor"] = "on"
    alpha: AlphaChoice = "auto"
    align: bool = True
    hold_ns: int = NS_PER_S // 2
    saturation_ns: int = SATURATION_NS
    ground_timeout_ns: int = 0
    ground_stations: int = 1
