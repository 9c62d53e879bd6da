"""Where the aircraft is on a map: home, and from there the way that airspeed and heading make.

The models here know nothing of the place they fly at, and maps of ground stations need one. The position is dead
reckoning on a sphere, plausible and no more: nothing flies by it.
"""

from __future__ import annotations

import math

from autopilot.config import Home
from autopilot.link.clock import NS_PER_MS, NS_PER_S, NS_PER_US
from autopilot.link.groundmessages import GlobalPositionInt, HomePosition
from autopilot.link.messages import VfrHud

__all__ = ["Position"]

EARTH_RADIUS_M = 6_371_000.0
MIN_STEP_NS = NS_PER_S // 10
"""A map needs no finer steps."""
MAX_GAP_NS = 2 * NS_PER_S
"""A longer gap between two VFR_HUD adds no way."""
POLE_DEG = 89.0
"""Dead reckoning goes no closer to a pole."""


class Position:
    """Dead reckoning from home.

    Parameters
    ----------
    home : Home
        Where it begins.
    """

    def __init__(self, home: Home) -> None:
        self.home = home
        self._latitude_deg, self._longitude_deg = home.latitude_deg, home.longitude_deg
        self._air: VfrHud | None = None
        self._air_ns = 0

    def flown(self, air: VfrHud, now_ns: int) -> None:
        """Take airspeed, heading, altitude and climb as of now."""
        if self._air is not None and now_ns - self._air_ns < MIN_STEP_NS:
            return
        if self._air is not None and now_ns - self._air_ns <= MAX_GAP_NS:
            way_m = self._air.groundspeed * (now_ns - self._air_ns) / NS_PER_S
            heading = math.radians(self._air.heading)
            north, east = way_m * math.cos(heading), way_m * math.sin(heading)
            latitude = self._latitude_deg + math.degrees(north / EARTH_RADIUS_M)
            self._latitude_deg = max(-POLE_DEG, min(POLE_DEG, latitude))
            across_m = EARTH_RADIUS_M * math.cos(math.radians(self._latitude_deg))
            self._longitude_deg = (self._longitude_deg + math.degrees(east / across_m) + 180.0) % 360.0 - 180.0
        self._air, self._air_ns = air, now_ns

    def message(self, now_ns: int) -> GlobalPositionInt | None:
        """Return GLOBAL_POSITION_INT; None without a fresh VFR_HUD, or for numbers that do not fit into it."""
        air = self._air
        if air is None or now_ns - self._air_ns > MAX_GAP_NS:
            return None
        if not (abs(air.alt) < 2e6 and abs(air.groundspeed) < 327.0 and abs(air.climb) < 327.0):
            return None
        heading = math.radians(air.heading)
        return GlobalPositionInt(
            now_ns // NS_PER_MS & 0xFFFFFFFF,
            round(self._latitude_deg * 1e7),
            round(self._longitude_deg * 1e7),
            round(air.alt * 1e3),
            round((air.alt - self.home.altitude_m) * 1e3),
            round(air.groundspeed * math.cos(heading) * 100.0),
            round(air.groundspeed * math.sin(heading) * 100.0),
            round(-air.climb * 100.0),
            air.heading % 360 * 100,
        )

    def home_message(self, now_ns: int) -> HomePosition:
        """Return HOME_POSITION."""
        home = self.home
        return HomePosition(
            round(home.latitude_deg * 1e7),
            round(home.longitude_deg * 1e7),
            round(home.altitude_m * 1e3),
            (1.0, 0.0, 0.0, 0.0),
            now_ns // NS_PER_US,
        )
