"""Distributions of the time that a packet takes beyond the link's constant delay, independent or correlated.

A correlated jitter follows exactly the distribution that was asked for. It is a Gaussian copula:
z(n) = rho z(n-1) + sqrt(1 - rho²) e(n) with e(n) standard normal, and the jitter is F⁻¹(Φ(z(n))). The
autocorrelation of normal jitter is rho^lag then, and the rank correlation of any jitter 6/π asin(rho^lag / 2).

Otherwise than netem, on purpose: ``get_crandom`` blends two uniform numbers, and ``tabledist`` takes the remainder of
the blend, by the width of the jitter or by the length of a table. Computed so, jitters of some ms come out
uncorrelated whatever the correlation asked for, and jitters of seconds correlated but no longer uniform. netem's
distributions are centred on the delay and its tables end at 4 standard deviations; here ``uniform``, ``gamma`` and
``pareto`` begin at the delay, as the queues that they stand for do, and nothing is cut off.

To add a model: a class here, registered with ``@_named(...)``.

References
----------
R. B. Nelsen, "An Introduction to Copulas", 2nd ed., 2006; W. H. Kruskal, "Ordinal measures of association",
J. Am. Stat. Assoc. 53, 1958; tc-netem(8); ``get_crandom`` and ``tabledist`` in Linux
``net/sched/sch_netem.c``; ``netem/paretonormal.c`` of iproute2.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np

__all__ = [
    "JITTERS",
    "GammaJitter",
    "Jitter",
    "NormalJitter",
    "ParetoJitter",
    "ParetoNormalJitter",
    "TableJitter",
    "UniformJitter",
    "autoregressive",
    "special_functions",
]

Source = Callable[[], float]
"""Where numbers come from, one per call."""

_Model = TypeVar("_Model", bound=type)


def special_functions() -> Any:
    """Return :mod:`scipy.special`, whose import would cost every relay 0.2 s at its start; few links need it."""
    import scipy.special

    return scipy.special


class Jitter(ABC):
    """A distribution of the time added to the delay."""

    @abstractmethod
    def independent(self, rng: np.random.Generator) -> Source:
        """Return a source of independent jitter, ns. It owns ``rng``."""

    @abstractmethod
    def correlated(self, normals: Callable[[], Source]) -> Source:
        """Return a source of jitter, ns, from standard normal numbers.

        Parameters
        ----------
        normals : callable
            Returns a further source of standard normal numbers, with the wanted correlation from one to the next.
        """

    def sampler(self, rng: np.random.Generator, correlation: float = 0.0) -> Source:
        """Return a source of jitter in ns. It owns ``rng``.

        Parameters
        ----------
        correlation : float
            rho of the standard normal sequence behind it, from 0 to below 1.
        """
        if correlation == 0.0:
            return self.independent(rng)
        return self.correlated(lambda: autoregressive(rng.spawn(1)[0], correlation))


def autoregressive(rng: np.random.Generator, rho: float) -> Source:
    """Return the stationary sequence z(n) = rho z(n-1) + sqrt(1 - rho²) e(n), each N(0, 1)."""
    normal, fresh = rng.standard_normal, math.sqrt(1.0 - rho * rho)
    z = float(normal())

    def following() -> float:
        nonlocal z
        now = z
        z = rho * z + fresh * normal()
        return now

    return following


_JITTERS: dict[str, type[Jitter]] = {}

JITTERS: Mapping[str, type[Jitter]] = MappingProxyType(_JITTERS)
"""Jitter models by their name in a SPEC."""


def _named(name: str) -> Callable[[_Model], _Model]:
    """Register a model under its name in a SPEC."""

    def register(model: _Model) -> _Model:
        assert name not in _JITTERS
        _JITTERS[name] = model
        return model

    return register


@_named("uniform")
@dataclass(frozen=True, slots=True)
class UniformJitter(Jitter):
    """Jitter U[0, W].

    Attributes
    ----------
    scale_ns : int
        The width W.
    """

    scale_ns: int

    def independent(self, rng: np.random.Generator) -> Source:
        """Return a source of U[0, W]."""
        random, width_ns = rng.random, float(self.scale_ns)
        return lambda: width_ns * random()

    def correlated(self, normals: Callable[[], Source]) -> Source:
        """Return W Φ(z)."""
        z, width_ns, ndtr = normals(), float(self.scale_ns), special_functions().ndtr
        return lambda: width_ns * float(ndtr(z()))


@_named("normal")
@dataclass(frozen=True, slots=True)
class NormalJitter(Jitter):
    """Jitter N(0, S²). A sum of delay and jitter below 0 becomes 0 and raises the mean.

    Attributes
    ----------
    scale_ns : int
        The standard deviation S.
    """

    scale_ns: int

    def independent(self, rng: np.random.Generator) -> Source:
        """Return a source of N(0, S²)."""
        normal, sigma_ns = rng.standard_normal, float(self.scale_ns)
        return lambda: sigma_ns * normal()

    def correlated(self, normals: Callable[[], Source]) -> Source:
        """Return S z."""
        z, sigma_ns = normals(), float(self.scale_ns)
        return lambda: sigma_ns * z()


@_named("gamma")
@dataclass(frozen=True, slots=True)
class GammaJitter(Jitter):
    """Jitter Gamma(k, M / k): for k = 2, two exponential waits in a row.

    Attributes
    ----------
    scale_ns : int
        The mean M.
    shape : float
        k, above 0.
    """

    scale_ns: int
    shape: float = 2.0

    def independent(self, rng: np.random.Generator) -> Source:
        """Return a source of Gamma(k, M / k)."""
        gamma, shape, theta_ns = rng.standard_gamma, self.shape, self.scale_ns / self.shape
        return lambda: theta_ns * gamma(shape)

    def correlated(self, normals: Callable[[], Source]) -> Source:
        """Return the quantile of Φ(z), or from P(J > t) = Φ(-z), so that neither tail loses digits."""
        z, shape, theta_ns = normals(), self.shape, self.scale_ns / self.shape
        special = special_functions()

        def jitter_ns() -> float:
            value = z()
            share = float(special.ndtr(-abs(value)))
            quantile = special.gammaincinv if value < 0.0 else special.gammainccinv
            return theta_ns * float(quantile(shape, share))

        return jitter_ns


@_named("pareto")
@dataclass(frozen=True, slots=True)
class ParetoJitter(Jitter):
    """Jitter of Pareto's second kind (Lomax), P(J > t) = (1 + t / (M (a - 1)))^-a: most packets early, a few very late.

    Attributes
    ----------
    scale_ns : int
        The mean M.
    shape : float
        The tail's exponent a, above 1; the variance is finite above 2.
    """

    scale_ns: int
    shape: float = 3.0

    def independent(self, rng: np.random.Generator) -> Source:
        """Return a source of Lomax(a) with mean M."""
        pareto, shape, lambda_ns = rng.pareto, self.shape, self.scale_ns * (self.shape - 1.0)
        return lambda: lambda_ns * pareto(shape)

    def correlated(self, normals: Callable[[], Source]) -> Source:
        """Return the quantile, from P(J > t) = Φ(-z), which loses no digits in the tail."""
        z, power, lambda_ns = normals(), -1.0 / self.shape, self.scale_ns * (self.shape - 1.0)
        ndtr = special_functions().ndtr
        return lambda: lambda_ns * (float(ndtr(-z())) ** power - 1.0)


@_named("paretonormal")
@dataclass(frozen=True, slots=True)
class ParetoNormalJitter(Jitter):
    """Jitter S Q(u) with u from U[0, 1]: as netem's table of this name, a quarter normal and three quarters Pareto.

    The parts are added quantile by quantile, Q(u) = Φ⁻¹(u) / 4 + (1 - u)^(-1/3) - 3/2: one packet is late in both.
    The Pareto part, of exponent 3 and mean 0, is netem's too: (4/3) ((1 - u)^(-1/3) - 3/2). A sum of delay and jitter
    below 0 becomes 0.

    Attributes
    ----------
    scale_ns : int
        The scale S. The mean is 0, the standard deviation 1.05 S.
    """

    scale_ns: int

    def independent(self, rng: np.random.Generator) -> Source:
        """Return the quantile of Φ(z) with z independent."""
        return self.correlated(lambda: rng.standard_normal)

    def correlated(self, normals: Callable[[], Source]) -> Source:
        """Return S Q(Φ(z)) = S (z / 4 + Φ(-z)^(-1/3) - 3/2), which loses no digits in the tail."""
        z, scale_ns, ndtr = normals(), float(self.scale_ns), special_functions().ndtr

        def jitter_ns() -> float:
            value = z()
            late = math.pow(ndtr(-value), -1.0 / 3.0)
            return scale_ns * (value / 4.0 + late - 1.5)

        return jitter_ns


@_named("table")
@dataclass(frozen=True, slots=True)
class TableJitter(Jitter):
    """Jitter as measured: the quantiles of a list of delays, straight lines between neighbours.

    Attributes
    ----------
    source : str
        The file that they come from.
    sorted_ns : tuple of int
        At least two delays, ascending: the first is the quantile of 0, the last of 1, equally spaced between.
    """

    source: str
    sorted_ns: tuple[int, ...]

    def __post_init__(self) -> None:
        assert len(self.sorted_ns) >= 2

    def independent(self, rng: np.random.Generator) -> Source:
        """Return a source of quantiles of U[0, 1]."""
        random = rng.random
        return lambda: self._quantile(random())

    def correlated(self, normals: Callable[[], Source]) -> Source:
        """Return the quantile of Φ(z)."""
        z, ndtr = normals(), special_functions().ndtr
        return lambda: self._quantile(float(ndtr(z())))

    def _quantile(self, share: float) -> float:
        place = share * (len(self.sorted_ns) - 1)
        below = min(int(place), len(self.sorted_ns) - 2)
        low_ns, high_ns = self.sorted_ns[below], self.sorted_ns[below + 1]
        return low_ns + (place - below) * (high_ns - low_ns)
