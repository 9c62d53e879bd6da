"""The standard atmosphere against its published table, and against the laws it is made of."""

from __future__ import annotations

import math

import pytest

from gains.table import InputError
from sitl.aircraft.atmosphere import GRAVITY, standard_air

# ISO 2533 and U.S. Standard Atmosphere 1976 by geopotential altitude: m, K, Pa, kg/m^3, m/s
TABLE = [
    (0.0, 288.15, 101325.0, 1.2250, 340.29),
    (1000.0, 281.65, 89874.6, 1.11164, 336.43),
    (5000.0, 255.65, 54019.9, 0.73612, 320.53),
    (11000.0, 216.65, 22632.1, 0.36392, 295.07),
    (15000.0, 216.65, 12044.6, 0.19367, 295.07),
    (20000.0, 216.65, 5474.89, 0.088035, 295.07),
]


@pytest.mark.parametrize(("altitude_m", "kelvin", "pascal", "density", "sound"), TABLE)
def test_the_published_table_is_met_to_its_last_digit(
    altitude_m: float, kelvin: float, pascal: float, density: float, sound: float
) -> None:
    air = standard_air(altitude_m)
    assert air.temperature_K == pytest.approx(kelvin, abs=0.005)
    assert air.pressure_Pa == pytest.approx(pascal, rel=1e-5)
    assert air.density_kg_m3 == pytest.approx(density, rel=3e-5)
    assert air.sound_m_s == pytest.approx(sound, abs=0.005)


@pytest.mark.parametrize("altitude_m", [-900.0, 0.0, 1600.0, 10_999.0, 11_001.0, 19_000.0])
def test_pressure_carries_the_air_above_it(altitude_m: float) -> None:
    slope = (standard_air(altitude_m + 0.5).pressure_Pa - standard_air(altitude_m - 0.5).pressure_Pa) / 1.0
    assert slope == pytest.approx(-standard_air(altitude_m).density_kg_m3 * GRAVITY, rel=1e-6)


def test_nothing_jumps_at_the_tropopause() -> None:
    below, above = standard_air(11_000.0 - 1e-6), standard_air(11_000.0 + 1e-6)
    assert below == pytest.approx(above, rel=1e-8)


@pytest.mark.parametrize("altitude_m", [-1000.1, 20_000.1, math.inf, -math.inf, math.nan])
def test_altitudes_that_the_table_does_not_have_are_refused(altitude_m: float) -> None:
    with pytest.raises(InputError, match="altitude: expected -1000 to 20000 m, found "):
        standard_air(altitude_m)
