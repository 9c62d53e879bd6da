"""Moving air: Dryden's spectra, the intensities of the military specification, discrete gusts, and their text."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import integrate, signal

from gains.table import InputError
from sitl.aircraft.wind import AXES, DrydenSpec, GustSpec, WindSpec, format_wind, parse_wind

FOOT, KNOT = 0.3048, 1852.0 / 3600.0
TS, V, LOW_M = 0.025, 100.0, 150.0
SAMPLES = 1 << 15


@pytest.fixture(scope="module")
def record() -> NDArray[np.float64]:
    """Turbulence of 2 m/s near the ground, 14 minutes of it, one row per sample."""
    air = parse_wind("dryden:2mps").start(TS, V, LOW_M, seed=1)
    return np.array([air.at(k) for k in range(SAMPLES)])


def density(axis: int, sigma: float, T: float, f_hz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return Dryden's power spectral density, one-sided, per hertz, as MIL-F-8785C writes it over Omega = omega / V."""
    along = (2.0 * np.pi * f_hz * T) ** 2
    shape = 2.0 / (1.0 + along) if axis == 0 else (1.0 + 3.0 * along) / (1.0 + along) ** 2
    return np.asarray(sigma**2 * 2.0 * T * shape)


# -- turbulence against the forms


def test_the_analytic_forms_of_this_test_hold_the_whole_variance() -> None:
    for axis in range(3):
        whole, _ = integrate.quad(lambda f, axis=axis: float(density(axis, 1.5, 2.0, np.array(f))), 0.0, np.inf)
        assert whole == pytest.approx(1.5**2, rel=1e-6)


@pytest.mark.parametrize("axis", [0, 1, 2], ids=AXES)
def test_the_spectrum_is_drydens(record: NDArray[np.float64], axis: int) -> None:
    sigma, length = DrydenSpec(2.0).scales(LOW_M)
    f_hz, found = signal.welch(record[:, axis], fs=1.0 / TS, nperseg=2048, detrend="constant")
    expected = density(axis, float(sigma[axis]), float(length[axis]) / V, f_hz)
    # in bands, each of some hundred independent values, so about 1 / sqrt(100) of noise; far below aliasing
    for low, high in ((0.1, 0.4), (0.4, 1.5), (1.5, 4.0)):
        band = (f_hz >= low) & (f_hz < high)
        assert np.sum(found[band]) == pytest.approx(np.sum(expected[band]), rel=0.25), (low, high)


def test_the_variance_is_sigma_squared(record: NDArray[np.float64]) -> None:
    sigma, length = DrydenSpec(2.0).scales(LOW_M)
    for axis in range(3):
        T = float(length[axis]) / V
        independent = SAMPLES * TS / (2.0 * T)  # roughly: one value for each correlation time, both ways
        rel = 4.0 * math.sqrt(2.0 / independent)
        assert np.var(record[:, axis]) == pytest.approx(sigma[axis] ** 2, rel=rel)
        assert rel < 0.5  # it says something
    across = np.corrcoef(record.T)
    assert np.abs(across - np.eye(3)).max() < 0.2  # the three axes know nothing of each other


def test_the_first_sample_has_the_full_variance_already() -> None:
    spec = parse_wind("dryden:2mps")
    first = np.array([spec.start(TS, V, LOW_M, seed).at(0) for seed in range(400)])
    sigma, _ = DrydenSpec(2.0).scales(LOW_M)
    assert np.var(first, axis=0) == pytest.approx(sigma**2, rel=4.0 * math.sqrt(2.0 / 400))


def test_successive_samples_are_correlated_as_the_continuous_filter_says(record: NDArray[np.float64]) -> None:
    _, length = DrydenSpec(2.0).scales(LOW_M)
    for axis, form in ((0, lambda x: math.exp(-x)), (2, lambda x: math.exp(-x) * (1.0 - x / 2.0))):
        values = record[:, axis] - record[:, axis].mean()
        for lag in (1, 4, 16):
            found = float(values[:-lag] @ values[lag:] / (values @ values))
            assert found == pytest.approx(form(lag * TS * V / float(length[axis])), abs=0.05), (axis, lag)


def test_a_seed_repeats_to_the_bit_and_parts_draw_from_streams_of_their_own() -> None:
    spec, both = parse_wind("dryden:light"), parse_wind("dryden:light+dryden:light")
    assert np.array_equal(spec.start(TS, V, LOW_M, 3).at(50), spec.start(TS, V, LOW_M, 3).at(50))
    assert not np.array_equal(spec.start(TS, V, LOW_M, 3).at(50), spec.start(TS, V, LOW_M, 4).at(50))
    one, two = spec.start(TS, V, LOW_M, 3).at(50), both.start(TS, V, LOW_M, 3).at(50)
    assert not np.array_equal(2.0 * one, two)
    gusty = parse_wind("gust:w:0mps:10m+dryden:light").start(TS, V, LOW_M, 3)
    assert not np.array_equal(gusty.at(50), one)  # a stream belongs to the place in the text


def test_samples_that_were_left_out_change_nothing_after_them() -> None:
    each, some = (parse_wind("dryden:severe").start(TS, V, LOW_M, 3) for _ in range(2))
    steps = np.array([each.at(k) for k in range(101)])
    assert np.array_equal(some.at(40), steps[40])
    assert np.array_equal(some.at(40), steps[40])
    assert np.array_equal(some.at(100), steps[100])


@settings(deadline=None, max_examples=60)
@given(
    Ts=st.sampled_from([0.001, 0.004, 0.025, 0.1, 1.0]),
    airspeed=st.floats(1.0, 2000.0),
    altitude=st.floats(-500.0, 40e3),
    level=st.sampled_from(["light", "moderate", "severe", 1e-3, 3.0, 100.0]),
)
def test_any_flight_condition_has_air_of_the_right_strength(
    Ts: float, airspeed: float, altitude: float, level: str | float
) -> None:
    spec = DrydenSpec(level)
    air = WindSpec((spec,)).start(Ts, airspeed, altitude, 7)
    values = np.array([air.at(k) for k in range(20)])
    assert np.isfinite(values).all()
    assert (np.abs(values) <= 7.0 * spec.scales(altitude)[0]).all()  # seven sigma: never, in so few


@pytest.mark.parametrize("airspeed", [0.0, -5.0, 1e-300, 0.99, 2001.0, 1e300, math.inf, math.nan])
def test_an_airspeed_that_no_aircraft_has_is_refused(airspeed: float) -> None:
    with pytest.raises(InputError, match="wind: expected an airspeed of 1 to 2000 m/s, found "):
        parse_wind("dryden:light").start(TS, airspeed, LOW_M, 0)


# -- intensities and scale lengths


def test_low_altitude_follows_the_wind_at_20_ft() -> None:
    sigma, length = DrydenSpec("moderate").scales(500.0 * FOOT)  # 30 kt at 20 ft, 500 ft above ground
    ratio = 0.177 + 0.000823 * 500.0
    assert sigma[2] == pytest.approx(3.0 * KNOT, rel=1e-6)
    assert sigma[0] == sigma[1] == pytest.approx(3.0 * KNOT / ratio**0.4, rel=1e-6)
    assert length[2] == pytest.approx(500.0 * FOOT)
    assert length[0] == length[1] == pytest.approx(500.0 * FOOT / ratio**1.2)


@pytest.mark.parametrize(
    ("level", "ft", "ft_s"),
    [("light", 3750, 7.4), ("moderate", 3750, 10.6), ("severe", 3750, 23.0), ("severe", 35e3, 16.0), ("light", 5e4, 0)],
)
def test_high_altitude_follows_figure_7(level: str, ft: float, ft_s: float) -> None:
    sigma, length = DrydenSpec(level).scales(ft * FOOT)
    assert sigma == pytest.approx([ft_s * FOOT] * 3)  # isotropic
    assert length == pytest.approx([1750.0 * FOOT] * 3)


@pytest.mark.parametrize("level", ["light", "moderate", "severe", 1.5])
def test_intensity_and_scale_have_no_jump_anywhere(level: str | float) -> None:
    for ft in (10.0, 500.0, 1000.0, 1750.0, 2000.0, 3750.0, 15e3, 45e3, 80e3):  # where one rule ends
        below, at, above = (np.hstack(DrydenSpec(level).scales((ft + step) * FOOT)) for step in (-1e-3, 0.0, 1e-3))
        assert below == pytest.approx(at, rel=1e-3, abs=1e-6)
        assert above == pytest.approx(at, rel=1e-3, abs=1e-6)


def test_below_10_ft_and_above_80000_ft_the_air_is_as_there() -> None:
    for level in ("light", "severe", 1.5):
        for beyond, at in ((-300.0, 10.0), (0.0, 10.0), (200e3, 80e3)):
            assert np.array_equal(DrydenSpec(level).scales(beyond * FOOT), DrydenSpec(level).scales(at * FOOT))


def test_a_severity_orders_the_strength_at_every_altitude() -> None:
    for h in (3.0, 100.0, 450.0, 1000.0, 5000.0, 12e3):
        light, moderate, severe = (DrydenSpec(level).scales(h)[0][2] for level in ("light", "moderate", "severe"))
        assert light < moderate < severe


# -- discrete gusts


def test_a_gust_is_one_minus_cosine_over_its_length_and_stays() -> None:
    air = parse_wind("gust:w:-5mps:100m@2s").start(TS, 50.0, LOW_M, 0)
    t = np.arange(0.0, 6.0, TS)
    values = np.array([air.at(k) for k in range(len(t))])
    s = np.clip((t - 2.0) * 50.0, 0.0, 100.0)
    assert values[:, 2] == pytest.approx(-2.5 * (1.0 - np.cos(np.pi * s / 100.0)), abs=1e-12)
    assert not values[:, :2].any()
    assert not values[t <= 2.0, 2].any()
    assert values[-1, 2] == -5.0


def test_parts_add_up() -> None:
    both = parse_wind("gust:u:4mps:60m@1s+gust:u:-1mps:10m@0s+gust:v:2mps:30m").start(TS, V, LOW_M, 0)
    assert both.at(4000) == pytest.approx([3.0, 2.0, 0.0])


# -- text


numbers = st.floats(-1e6, 1e6, allow_nan=False)
above_0 = st.floats(1e-6, 1e6, exclude_min=True)
parts = st.one_of(
    st.builds(DrydenSpec, st.one_of(st.sampled_from(["light", "moderate", "severe"]), above_0)),
    st.builds(GustSpec, st.sampled_from(AXES), numbers, above_0, st.integers(0, 3_600_000_000_000)),
)


@given(st.lists(parts, min_size=1, max_size=5))
def test_what_is_formatted_parses_to_the_same(spec: list[DrydenSpec | GustSpec]) -> None:
    wind = WindSpec(tuple(spec))
    text = format_wind(wind)
    assert parse_wind(text) == wind
    assert format_wind(parse_wind(text)) == text


def test_the_texts_of_the_module_mean_what_it_says() -> None:
    assert parse_wind("dryden:moderate") == WindSpec((DrydenSpec("moderate"),))
    assert parse_wind("dryden:1.5mps") == WindSpec((DrydenSpec(1.5),))
    gust = GustSpec("w", 5.0, 100.0, 3_000_000_000)
    assert parse_wind("gust:w:5mps:100m@3s") == WindSpec((gust,))
    assert parse_wind("gust:w:5mps:100m") == WindSpec((replace(gust, start_ns=0),))
    assert len(parse_wind("dryden:light+gust:u:4mps:60m@5s").parts) == 2


@pytest.mark.parametrize(
    "text",
    [
        "",
        "+",
        "dryden",
        "dryden:",
        "dryden:storm",
        "dryden:1.5",
        "dryden:0mps",
        "dryden:-1mps",
        "dryden:nanmps",
        "dryden:infmps",
        "dryden:1e999mps",
        "dryden:light+",
        "gust:w:5mps",
        "gust:x:5mps:100m",
        "gust:w:5m:100mps",
        "gust:w:5mps:0m",
        "gust:w:5mps:-1m",
        "gust:w:infmps:100m",
        "gust:w:5mps:100m@",
        "gust:w:5mps:100m@3",
        "gust:w:5mps:100m@-1s",
        "gust:w:5mps:100m@3s@4s",
        "gust:w:5mps:100m:9@3s",
        "breeze:light",
    ],
)
def test_anything_else_is_refused_with_the_whole_text(text: str) -> None:
    with pytest.raises(InputError) as refused:
        parse_wind(text)
    assert str(refused.value).startswith(f'wind "{text}": expected ')
    assert ", found " in str(refused.value)


@given(st.text(alphabet="drydengust:w+@smp0123456789.e-_ lh", max_size=40))
def test_no_text_raises_anything_but_a_complaint(text: str) -> None:
    try:
        spec = parse_wind(text)
    except InputError:
        return
    assert parse_wind(format_wind(spec)) == spec
