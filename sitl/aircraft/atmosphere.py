"""The International Standard Atmosphere (ISO 2533), sea level to 20 km, and standard gravity."""

from __future__ import annotations

import math
from typing import NamedTuple

from gains.table import InputError

__all__ = ["GRAVITY", "Air", "standard_air"]

GRAVITY = 9.80665
"""m/s^2."""
GAS = 287.05287
"""Specific gas constant of air, J/(kg K)."""
HEAT_RATIO = 1.4
SEA_LEVEL_K, SEA_LEVEL_PA = 288.15, 101_325.0
LAPSE = -0.0065
"""K/m, up to the tropopause."""
TROPOPAUSE_M = 11_000.0
LOWEST_M, HIGHEST_M = -1000.0, 20_000.0


class Air(NamedTuple):
    """Still air at one altitude.

    Attributes
    ----------
    temperature_K, pressure_Pa, density_kg_m3 : float
    sound_m_s : float
        Speed of sound.
    """

    temperature_K: float
    pressure_Pa: float
    density_kg_m3: float
    sound_m_s: float


def standard_air(altitude_m: float) -> Air:
    """Return the air at a geopotential altitude.

    Raises
    ------
    InputError
        Below -1 km or above 20 km.
    """
    if not LOWEST_M <= altitude_m <= HIGHEST_M:
        raise InputError(f"altitude: expected {LOWEST_M:.0f} to {HIGHEST_M:.0f} m, found {altitude_m:g}")
    below = min(altitude_m, TROPOPAUSE_M)
    temperature = SEA_LEVEL_K + LAPSE * below
    pressure = SEA_LEVEL_PA * (temperature / SEA_LEVEL_K) ** (-GRAVITY / (GAS * LAPSE))
    pressure *= math.exp(-GRAVITY * (altitude_m - below) / (GAS * temperature))
    return Air(temperature, pressure, pressure / (GAS * temperature), math.sqrt(HEAT_RATIO * GAS * temperature))
