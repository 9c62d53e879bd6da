"""Moving air: Dryden turbulence and discrete gusts, as MIL-F-8785C states them, sampled at Ts.

    dryden:moderate               turbulence of this severity, its intensity and scale by altitude
    dryden:1.5mps                 turbulence of this intensity (sigma of the vertical gust)
    gust:w:5mps:100m@3s           a "1 - cosine" gust along the body axis u, v or w: to 5 m/s within 100 m of air
    dryden:light+gust:u:4mps:60m@5s     several of them

Velocities are those of the air in body axes (u ahead, v to the right, w down). Turbulence is frozen: the aircraft
flies through it at the airspeed of its trim. Sources: MIL-F-8785C (1980), 3.7.1 to 3.7.5; the intensities at altitude
are those of its figure 7. Its rotary gusts are left out: they matter for wide spans.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gains.table import InputError
from sitl.aircraft.airframe import Vector
from sitl.link.changes import format_time, parse_time_ns

__all__ = ["Dryden", "DrydenSpec", "GustSpec", "Wind", "WindSpec", "format_wind", "parse_wind"]

FOOT = 0.3048
KNOT = 0.514444
AXES = ("u", "v", "w")

SEVERITIES = {"light": 15.0 * KNOT, "moderate": 30.0 * KNOT, "severe": 45.0 * KNOT}
"""Wind at 20 ft, m/s, that stands for a severity near the ground (3.7.3.4)."""

_FIGURE_7_FT = (500.0, 1750.0, 3750.0, 7500.0, 15e3, 25e3, 35e3, 45e3, 55e3, 65e3, 75e3, 80e3)
_FIGURE_7 = {
    "light": (6.6, 6.9, 7.4, 6.7, 4.6, 2.7, 0.4, 0.0, 0.0, 0.0, 0.0, 0.0),
    "moderate": (8.6, 9.6, 10.6, 10.1, 8.0, 6.6, 5.0, 4.2, 2.7, 0.0, 0.0, 0.0),
    "severe": (15.6, 17.6, 23.0, 23.6, 22.1, 20.0, 16.0, 15.1, 12.1, 7.9, 6.2, 5.1),
}
"""Intensity, ft/s, by altitude, that is exceeded with a probability of 1e-2, 1e-3 and 1e-5."""

LOW_FT, HIGH_FT = 1000.0, 2000.0
"""Below the first the low-altitude form holds, above the second the high one; between them both are interpolated."""
HIGH_SCALE_FT = 1750.0
LEAST_HEIGHT_FT = 10.0
LEAST_SPEED_M_S, MOST_SPEED_M_S = 1.0, 2000.0
"""Between these airspeeds the filters are exact at any altitude and Ts <= 1 s; beyond, their exponentials overflow."""


class Wind(Protocol):
    """The air along one flight."""

    def at(self, k: int) -> Vector:
        """Return the velocity of the air at sample k, (u, v, w) in body axes, m/s; k never goes back."""


@dataclass(frozen=True, slots=True)
class DrydenSpec:
    """Turbulence.

    Attributes
    ----------
    level : str or float
        A severity, or the intensity of the vertical gust, m/s.
    """

    level: str | float

    def scales(self, altitude_m: float) -> tuple[Vector, Vector]:
        """Return intensities and scale lengths of u, v, w at a height above ground, m/s and m (3.7.2.1, 3.7.3.4)."""
        h = altitude_m / FOOT
        low = self._low(min(max(h, LEAST_HEIGHT_FT), LOW_FT))
        high = self._high(max(h, HIGH_FT))
        share = min(max((h - LOW_FT) / (HIGH_FT - LOW_FT), 0.0), 1.0)
        return (1.0 - share) * low[0] + share * high[0], (1.0 - share) * low[1] + share * high[1]

    def _low(self, h: float) -> tuple[Vector, Vector]:
        ratio = 0.177 + 0.000823 * h
        sigma_w = 0.1 * SEVERITIES[self.level] if isinstance(self.level, str) else self.level
        along = h / ratio**1.2
        return np.array([sigma_w / ratio**0.4, sigma_w / ratio**0.4, sigma_w]), FOOT * np.array([along, along, h])

    def _high(self, h: float) -> tuple[Vector, Vector]:
        if isinstance(self.level, str):
            sigma = FOOT * float(np.interp(h, _FIGURE_7_FT, _FIGURE_7[self.level]))
        else:
            sigma = self.level
        return np.full(3, sigma), np.full(3, HIGH_SCALE_FT * FOOT)


@dataclass(frozen=True, slots=True)
class GustSpec:
    """A discrete gust: 0 before, V/2 (1 - cos(pi s / length)) after s metres of air, and V from there on (3.7.1.3).

    Attributes
    ----------
    axis : str
        u, v or w.
    speed_m_s : float
        V, with its sign.
    length_m : float
        Of the way to it.
    start_ns : int
        From sample 0.
    """

    axis: str
    speed_m_s: float
    length_m: float
    start_ns: int

    def at(self, t_s: float, airspeed_m_s: float) -> float:
        """Return the velocity at a time from sample 0."""
        share = min(max((t_s - self.start_ns / 1e9) * airspeed_m_s / self.length_m, 0.0), 1.0)
        return 0.5 * self.speed_m_s * (1.0 - math.cos(math.pi * share))


@dataclass(frozen=True, slots=True)
class WindSpec:
    """Turbulence and gusts, which add up.

    Attributes
    ----------
    parts : tuple of DrydenSpec or GustSpec
    """

    parts: tuple[DrydenSpec | GustSpec, ...]

    def start(self, Ts: float, airspeed_m_s: float, altitude_m: float, seed: int) -> Wind:
        """Return the air of one flight.

        Parameters
        ----------
        Ts : float
            Sampling period, s.
        airspeed_m_s : float
            Of the aircraft through the air, which turns lengths into times.
        altitude_m : float
            Of the aircraft; the ground is at sea level.
        seed : int
            Of the turbulence; each part draws from a stream of its own.

        Raises
        ------
        InputError
            When the aircraft is too slow or too fast for frozen turbulence.
        """
        if not LEAST_SPEED_M_S <= airspeed_m_s <= MOST_SPEED_M_S:
            raise InputError(
                f"wind: expected an airspeed of {LEAST_SPEED_M_S:g} to {MOST_SPEED_M_S:g} m/s, found {airspeed_m_s:g}"
            )
        turbulence = tuple(
            Dryden(part, Ts, airspeed_m_s, altitude_m, np.random.default_rng((seed, n)))
            for n, part in enumerate(self.parts)
            if isinstance(part, DrydenSpec)
        )
        gusts = tuple(part for part in self.parts if isinstance(part, GustSpec))
        return _Air(Ts, airspeed_m_s, turbulence, gusts)


class Dryden:
    """Turbulence with the Dryden spectra, by filters of white noise that are exact at the samples.

    The spectra belong to 1 / (1 + T s) for u and (1 + sqrt(3) T s) / (1 + T s)^2 for v and w, with T = L / V. Each
    filter starts in its steady state, so the variance is sigma^2 from the first sample on.

    Parameters
    ----------
    spec : DrydenSpec
    Ts, airspeed_m_s, altitude_m
        As of :meth:`WindSpec.start`.
    noise : numpy.random.Generator
    """

    def __init__(
        self, spec: DrydenSpec, Ts: float, airspeed_m_s: float, altitude_m: float, noise: np.random.Generator
    ) -> None:
        sigma, length = spec.scales(altitude_m)
        scales = zip(sigma.tolist(), (length / airspeed_m_s).tolist(), strict=True)
        self._axes = [_Filter(s, T, Ts, along=n == 0) for n, (s, T) in enumerate(scales)]
        self._noise = noise
        self._k = 0
        self._states = [each.root_steady @ noise.standard_normal(each.order) for each in self._axes]

    def at(self, k: int) -> Vector:
        """Return the velocity at sample k; k never goes back."""
        while self._k < k:
            self._states = [
                each.A @ state + each.root_noise @ self._noise.standard_normal(each.order)
                for each, state in zip(self._axes, self._states, strict=True)
            ]
            self._k += 1
        return np.array([float(each.c @ state) for each, state in zip(self._axes, self._states, strict=True)])


class _Filter:
    """A shaping filter, x(k+1) = A x(k) + root_noise n(k), y = c x, with steady covariance root_steady root_steady'."""

    def __init__(self, sigma: float, T: float, Ts: float, *, along: bool) -> None:
        from scipy.linalg import expm, solve_discrete_lyapunov  # costs 0.2 s, which calm air need not pay

        if along:
            F, b, self.c = np.array([[-1.0 / T]]), np.array([[1.0]]), np.array([math.sqrt(2.0 / T)])
        else:
            F = np.array([[0.0, 1.0], [-1.0 / T**2, -2.0 / T]])
            b = np.array([[0.0], [1.0]])
            self.c = np.array([1.0 / T**2, math.sqrt(3.0) / T]) * math.sqrt(T)
        self.c = sigma * self.c
        self.order = len(F)
        # Van Loan: the covariance that white noise of unit intensity leaves behind in one sampling period
        n = self.order
        block = np.zeros((2 * n, 2 * n))
        block[:n, :n], block[:n, n:], block[n:, n:] = -F, b @ b.T, F.T
        held = expm(block * Ts)
        self.A = held[n:, n:].T
        Q = self.A @ held[:n, n:]
        self.root_noise = np.linalg.cholesky((Q + Q.T) / 2.0)
        steady = solve_discrete_lyapunov(self.A, Q)
        self.root_steady = np.linalg.cholesky((steady + steady.T) / 2.0)


@dataclass(frozen=True, slots=True)
class _Air:
    """The sum of all parts."""

    Ts: float
    airspeed_m_s: float
    turbulence: tuple[Dryden, ...]
    gusts: tuple[GustSpec, ...]

    def at(self, k: int) -> Vector:
        velocity = sum((each.at(k) for each in self.turbulence), np.zeros(3))
        for gust in self.gusts:
            velocity[AXES.index(gust.axis)] += gust.at(k * self.Ts, self.airspeed_m_s)
        return np.asarray(velocity, dtype=np.float64)


def parse_wind(text: str) -> WindSpec:
    """Return what a text says, as this module's head shows it.

    Raises
    ------
    InputError
        For anything else.
    """
    return WindSpec(tuple(_part(part, text) for part in text.split("+")))


def _part(part: str, text: str) -> DrydenSpec | GustSpec:
    kind, _, rest = part.partition(":")
    if kind == "dryden":
        if rest in SEVERITIES:
            return DrydenSpec(rest)
        if not rest.endswith("mps"):
            raise _no_wind(text, part)
        return DrydenSpec(_number(rest, "mps", text, above=0.0))
    way, at, start = rest.partition("@")
    words = way.split(":")
    if kind != "gust" or len(words) != 3 or words[0] not in AXES:
        raise _no_wind(text, part)
    speed, length = _number(words[1], "mps", text), _number(words[2], "m", text, above=0.0)
    return GustSpec(words[0], speed, length, parse_time_ns(start, f'wind "{text}"') if at else 0)


def _no_wind(text: str, part: str) -> InputError:
    known = ", ".join(SEVERITIES)
    return InputError(
        f'wind "{text}": expected dryden:1.5mps, dryden: and one of {known}, or gust:w:5mps:100m@3s,'
        f" found {part or 'nothing'}"
    )


def _number(word: str, unit: str, text: str, *, above: float = -math.inf) -> float:
    try:
        value = float(word.removesuffix(unit)) if word.endswith(unit) else math.nan
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > above):
        raise InputError(
            f'wind "{text}": expected a number{" above 0" if above == 0.0 else ""} in {unit}, found {word}'
        )
    return value


def format_wind(spec: WindSpec) -> str:
    """Return the text that :func:`parse_wind` takes."""
    return "+".join(_format_part(part) for part in spec.parts)


def _format_part(part: DrydenSpec | GustSpec) -> str:
    if isinstance(part, GustSpec):
        return f"gust:{part.axis}:{part.speed_m_s!r}mps:{part.length_m!r}m@{format_time(part.start_ns)}"
    return f"dryden:{part.level}" if isinstance(part.level, str) else f"dryden:{part.level!r}mps"
