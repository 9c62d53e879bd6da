"""What one autopilot flies, and how: the options of the program as values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, Protocol

from autopilot.alpha import AlphaChoice
from autopilot.link.clock import NS_PER_S
from autopilot.link.wire import Seal
from autopilot.monitors import SATURATION_NS
from autopilot.profile import Profile, Source
from gains.model import GainLaw
from gains.table import Table

__all__ = ["ZURICH", "AutopilotConfig", "Home", "ParameterStore"]


@dataclass(frozen=True, slots=True)
class Home:
    """Where the flight begins on the map: degrees, and metres above the sea."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float


ZURICH = Home(47.397742, 8.545594, 488.0)
"""Where simulated aircraft of the field often begin."""


class ParameterStore(Protocol):
    """Where parameters are kept."""

    def read(self) -> Table | None:
        """Return what is kept; None for nothing."""

    def write(self, values: Mapping[str, object]) -> None:
        """Keep values, all of them or none; OSError when that is not possible."""


@dataclass(frozen=True, slots=True)
class AutopilotConfig:
    """What one autopilot flies, and how.

    Attributes
    ----------
    gains : Gains or Schedule
        K1 and K2 with their windows, and the model; the conservative gains too, if the file names some.
    profile : Source
        The programmed reference, flown in AUTO.
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
    wait_arm : bool
        Whether arming is left to the ground; else the vehicle arms itself once, when the checks pass.
    alternatives : tuple of GainLaw
        Laws for the same model that a ground station may choose instead.
    home : Home
        Where the map begins.
    parameters : ParameterStore or None
        Where parameters are kept; what is there counts from the start.
    seals : mapping
        Port to what signs and checks its frames; a port that is missing is not signed.
    """

    gains: GainLaw
    profile: Source = field(default_factory=Profile)
    actuator: Literal["pwm", "float"] = "pwm"
    failsafe: Literal["on", "monitor"] = "on"
    alpha: AlphaChoice = "auto"
    align: bool = True
    hold_ns: int = NS_PER_S // 2
    saturation_ns: int = SATURATION_NS
    ground_timeout_ns: int = 0
    ground_stations: int = 1
    wait_arm: bool = False
    alternatives: tuple[GainLaw, ...] = ()
    home: Home = ZURICH
    parameters: ParameterStore | None = None
    seals: Mapping[str, Seal] = field(default_factory=dict)
