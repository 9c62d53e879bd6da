"""Angle of attack: from AOA_SSA, or from VFR_HUD and pitch where no AOA_SSA comes.

    alpha = theta - gamma,    gamma = asin(climb / airspeed)

with wings level in still air. Otherwise, for small angles, what it gives is

* too small by alpha (1 - cos phi) at the bank angle phi: 13 % of alpha at 30 degrees;
* too small by wz / airspeed in air that rises with wz: 0.6 degrees at 1 m/s and 100 m/s (horizontal wind
  does nothing, as airspeed is against the air);
* wrong by gamma (1 - true / shown) where the airspeed shown is not the true one: many vehicles show the
  calibrated one, which is 8 % below the true one at 1600 m;
* late: VFR_HUD carries no time, so gamma is that of an instant up to HUD_LIMIT_NS, and the difference
  of two transits, before the sample, and alpha is off by as much as gamma has moved in it.

Noise: :func:`alpha_sigma_rad`. No certificate speaks of any of this: it is proved for the state itself.

Which source is taken is a choice for an epoch of the plant. ``auto`` takes AOA_SSA; only where none comes for
ALPHA_WAIT_NS, from the first ATTITUDE on, does it go over to VFR_HUD. MIN_ANGLES of AOA_SSA decide: it takes that one,
or goes back to it, and stays. Fewer decide nothing, as a stray one must not cost the angle of attack for ever. Once
decided, an AOA_SSA that stops has no stand-in: failsafe knows what to do without a state, but nothing would tell it
of a wrong one.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal

from autopilot.link.clock import NS_PER_S
from autopilot.link.sensors import Sensor
from autopilot.link.wire import AoaSsa, Attitude, VfrHud
from gains.table import InputError

__all__ = [
    "ALPHA_WAIT_NS",
    "HUD_LIMIT_NS",
    "MIN_AIRSPEED_M_S",
    "MIN_ANGLES",
    "AlphaChoice",
    "AlphaSelector",
    "AlphaSource",
    "alpha_selector",
    "alpha_sigma_rad",
    "gamma_rad",
]

ALPHA_WAIT_NS = 2 * NS_PER_S
"""How long ``auto`` waits for AOA_SSA, or for the next one, before it takes VFR_HUD."""

MIN_ANGLES = 5
"""So many AOA_SSA, none of them ALPHA_WAIT_NS after the one before, decide ``auto``: fewer may be stray ones."""

HUD_LIMIT_NS = NS_PER_S // 2
"""A VFR_HUD that came longer ago, own time, says nothing about now."""

MIN_AIRSPEED_M_S = 5.0
"""Below this airspeed there is no flight path angle: its noise grows as 1 / airspeed."""

AlphaChoice = Literal["auto", "aoa_ssa", "vfr_hud"]


class AlphaSource(StrEnum):
    """Where the angle of attack of a sample comes from."""

    AOA_SSA = "aoa_ssa"
    VFR_HUD = "vfr_hud"
    NONE = "none"
    """The model has none."""


def gamma_rad(hud: VfrHud) -> float | None:
    """Return the flight path angle asin(climb / airspeed), rad; None where these two do not give one."""
    if hud.airspeed < MIN_AIRSPEED_M_S or abs(hud.climb) > hud.airspeed:
        return None
    return math.asin(hud.climb / hud.airspeed)


def alpha_sigma_rad(hud: VfrHud, climb_m_s: float, airspeed_m_s: float = 0.0) -> float | None:
    """Return the standard deviation of alpha that the noise of VFR_HUD makes.

    sigma^2 = (sigma_climb^2 + (sin(gamma) sigma_airspeed)^2) / (airspeed cos(gamma))^2: in level flight
    1 m/s of climb at 100 m/s is 0.57 degrees, and airspeed hardly matters. The noise of pitch adds to it.

    Parameters
    ----------
    hud : VfrHud
        The point of linearisation.
    climb_m_s, airspeed_m_s : float
        Standard deviations of its two fields, independent of each other.

    Returns
    -------
    float or None
        rad; None where there is no flight path angle, or it is vertical.
    """
    gamma = gamma_rad(hud)
    if gamma is None or abs(hud.climb) == hud.airspeed:
        return None
    return math.hypot(climb_m_s, math.sin(gamma) * airspeed_m_s) / (hud.airspeed * math.cos(gamma))


@dataclass(slots=True)
class AlphaSelector:
    """Which source the angle of attack has now, and its value where that is VFR_HUD; own time passed in.

    Attributes
    ----------
    source : AlphaSource
        Where it comes from. While ``auto`` waits that is AOA_SSA.
    undecided : bool
        Whether the source may still change: ``auto`` before MIN_ANGLES of AOA_SSA.
    since_ns : int or None
        Own time of the last change of source; None while there was none in this epoch.
    """

    source: AlphaSource
    undecided: bool = False
    since_ns: int | None = None
    _auto: bool = field(init=False)
    _attitude_ns: int | None = None
    _angles: int = 0
    _angle_ns: int = 0
    _hud: VfrHud | None = None
    _hud_ns: int = 0

    def __post_init__(self) -> None:
        self._auto = self.undecided

    def restart(self) -> None:
        """Begin a new epoch: nothing has come yet, and ``auto`` waits for AOA_SSA again."""
        if self._auto:
            self.source, self.undecided, self.since_ns = AlphaSource.AOA_SSA, True, None
        self._hud = None
        self._attitude_ns = None
        self._angles = 0

    def air(self, hud: VfrHud, now_ns: int) -> None:
        """Take a VFR_HUD; the last to come counts as the newest."""
        self._hud, self._hud_ns = hud, now_ns

    def angle(self, now_ns: int) -> None:
        """Note that AOA_SSA has come: while ``auto`` waits it waits anew, and with MIN_ANGLES it is decided."""
        if not self.undecided:
            return
        self._angles = self._angles + 1 if now_ns - self._angle_ns < ALPHA_WAIT_NS else 1
        self._angle_ns = now_ns
        self._attitude_ns = None
        if self._angles >= MIN_ANGLES:
            self.undecided = False
            self._change(AlphaSource.AOA_SSA, now_ns)

    def attitude(self, now_ns: int) -> None:
        """Note that ATTITUDE has come: ``auto`` goes over to VFR_HUD when it has waited long enough."""
        if not self.undecided or self.source is not AlphaSource.AOA_SSA:
            return
        if self._attitude_ns is None:
            self._attitude_ns = now_ns
        elif now_ns - self._attitude_ns >= ALPHA_WAIT_NS and self._fresh(now_ns) is not None:
            self._change(AlphaSource.VFR_HUD, now_ns)

    def alpha_rad(self, theta_rad: float, now_ns: int) -> float | None:
        """Return theta - gamma with the newest VFR_HUD, rad; None when it is too old or gives no gamma."""
        hud = self._fresh(now_ns)
        gamma = gamma_rad(hud) if hud is not None else None
        return theta_rad - gamma if gamma is not None else None

    def report(self) -> str:
        """Return what people must know of the source, in at most 50 characters."""
        if self.source is AlphaSource.NONE:
            return "no alpha"
        sigma = alpha_sigma_rad(self._hud, 1.0) if self.source is AlphaSource.VFR_HUD and self._hud else None
        noise = f": {math.degrees(sigma):.2f} deg per m/s of climb" if sigma is not None else ""
        return f"alpha from {self.source.name}{noise}"

    def _fresh(self, now_ns: int) -> VfrHud | None:
        return self._hud if now_ns - self._hud_ns <= HUD_LIMIT_NS else None

    def _change(self, source: AlphaSource, now_ns: int) -> None:
        if source is not self.source:
            self.source, self.since_ns = source, now_ns


def alpha_selector(sensors: Iterable[Sensor], choice: AlphaChoice, name: str) -> AlphaSelector:
    """Return the selector of a model with these sensors.

    Raises
    ------
    InputError
        When VFR_HUD is asked for and cannot stand in: it has no sideslip, and a sample needs ATTITUDE.
    """
    fields = {(sensor.message, sensor.field) for sensor in sensors}
    messages = {message for message, _ in fields}
    if AoaSsa not in messages:
        return AlphaSelector(AlphaSource.NONE)
    able = Attitude in messages and (AoaSsa, "SSA") not in fields
    if choice == "vfr_hud":
        if not able:
            raise InputError(f"{name}: alpha vfr_hud: expected states in AOA_SSA.AOA and ATTITUDE, found others")
        return AlphaSelector(AlphaSource.VFR_HUD)
    return AlphaSelector(AlphaSource.AOA_SSA, undecided=able and choice == "auto")
