"""Which parameter of a campaign hurts: how far each one, alone, moves a result, with standard errors.

Two measures, of the flights as they were drawn. Spearman's rank correlation says how strongly a result rises with a
parameter, infinite results among them. The first-order Sobol index, Var(E[result | parameter]) / Var(result), says what
share of the variance the parameter explains, rising or not; it needs finite results. Standard errors come from the
influence functions: of how much each flight moves the estimate. They suppose no distribution, but large samples.

Drawn parameters are independent of one another, so that their indices are of the parameter itself. What the delays came
to (their mean, largest, changes) belongs together: of those an index says what knowing it would tell.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["MAX_ROWS", "PARAMETERS", "Effect", "Sensitivity", "rank_correlation", "sensitivities", "sobol_index"]

PARAMETERS = (
    "d_mean", "d_max", "outside", "changes", "gust_amplitude", "gust_period_s", "reference_amplitude",
    "reference_period_s", "delta_amplitude", "x0_norm",
)  # fmt: skip
"""Columns that may explain a result."""
MAX_ROWS = 1 << 19
"""Flights that are looked at, the first ones: their standard errors of about 0.0014 are enough for an order."""
MAX_BINS = 1000
MIN_FLIGHTS = 30
"""Of fewer finite results no index is told."""

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]


class Estimate(NamedTuple):
    """A number and its standard error; both nan where there is none."""

    value: float
    error: float


NONE = Estimate(math.nan, math.nan)


@dataclass(frozen=True, slots=True)
class Effect:
    """What one parameter does to a result.

    Attributes
    ----------
    name : str
        The parameter's column.
    spearman, spearman_error : float
        Rank correlation, and its standard error.
    sobol, sobol_error : float
        First-order index, and its standard error; below 0 it is noise.
    """

    name: str
    spearman: float
    spearman_error: float
    sobol: float
    sobol_error: float


@dataclass(frozen=True, slots=True)
class Sensitivity:
    """What the parameters do to a result.

    Attributes
    ----------
    flights : int
        Looked at.
    effects : tuple of Effect
        The largest Sobol index first.
    constant : tuple of str
        Parameters that are the same in all flights: nothing can be said of them.
    undefined : tuple of str
        Parameters that are nan in some flights.
    infinite : int
        Flights of an infinite result, which the Sobol indices leave out.
    """

    flights: int
    effects: tuple[Effect, ...]
    constant: tuple[str, ...]
    undefined: tuple[str, ...]
    infinite: int


class _Order(NamedTuple):
    """A sample's order; of each value in that order the first and one past the last place of those equal to it."""

    order: Indices
    first: Indices
    last: Indices

    @property
    def middle(self) -> Floats:
        """Mid-distribution of each value in order: places below it and half of those at it, over all."""
        shares: Floats = (self.first + self.last) / (2.0 * len(self.first))
        return shares

    def scattered(self, values: Floats) -> Floats:
        """Return values that are in this order in the order of the sample."""
        out = np.empty_like(values)
        out[self.order] = values
        return out

    def above(self, values: Floats) -> Floats:
        """Return for each place the mean over the sample of the values above it, of those equal to it half."""
        sums = np.concatenate(([0.0], np.cumsum(values)))
        means: Floats = (sums[-1] - 0.5 * (sums[self.first] + sums[self.last])) / len(values)
        return means


def _ordered(sample: Floats) -> _Order:
    order = np.argsort(sample)
    return _Order(order, *_ties(sample[order]))


def _ties(rising: Floats) -> tuple[Indices, Indices]:
    """Return for each of the rising values the first place of its equals, and the one past their last."""
    anew = np.concatenate(([True], rising[1:] != rising[:-1], [True]))
    edges = np.flatnonzero(anew)
    counts = np.diff(edges)
    return np.repeat(edges[:-1], counts), np.repeat(edges[1:], counts)


def sensitivities(columns: Mapping[str, NDArray[Any]], results: Sequence[Floats]) -> tuple[Sensitivity, ...]:
    """Return what each parameter does to each of some results.

    Parameters
    ----------
    columns : mapping of str to ndarray, shape (N,)
        Of these the first ``MAX_ROWS`` of ``PARAMETERS`` are looked at.
    results : sequence of ndarray, each shape (N,)
        May be infinite, not nan.
    """
    results = [result[:MAX_ROWS] for result in results]
    effects: list[list[Effect]] = [[] for _ in results]
    constant, undefined = [], []
    ranked = [_ordered(result) for result in results]
    finite = [np.isfinite(result) for result in results]
    for name in PARAMETERS:
        if name not in columns or not len(columns[name]):
            continue
        parameter = columns[name][:MAX_ROWS].astype(np.float64)
        if np.isnan(parameter).any():
            undefined.append(name)
        elif parameter.min() == parameter.max():
            constant.append(name)
        else:
            order = _ordered(parameter)
            for n, result in enumerate(results):
                spearman = _rank_correlation(order, ranked[n])
                sobol = _sobol_of_finite(parameter, order, result, finite[n])
                effects[n].append(Effect(name, *spearman, *sobol))
    return tuple(
        Sensitivity(
            flights=len(told),
            effects=tuple(sorted(found, key=_largest_first)),
            constant=tuple(constant),
            undefined=tuple(undefined),
            infinite=int(np.count_nonzero(~told)),
        )
        for found, told in zip(effects, finite, strict=True)
    )


def _largest_first(effect: Effect) -> float:
    return math.inf if math.isnan(effect.sobol) else -effect.sobol


def rank_correlation(one: Floats, other: Floats) -> Estimate:
    """Return Spearman's ρ of two samples, shape (N,), equal values with their mean rank; nan of a constant one."""
    return _rank_correlation(_ordered(one), _ordered(other))


def _rank_correlation(x: _Order, y: _Order) -> Estimate:
    """Return ρ = cov(F(x), G(y)) / sqrt(var F(x) var G(y)), F and G the mid-distributions.

    The covariance is E[F G] - 1/4. One more flight at (x, y) changes it by F(x) G(y) itself, and by what it adds to
    the F of all larger x and to the G of all larger y. The error of the variances, which only ties have, is left out.
    """
    F, G = x.middle, y.scattered(y.middle)[x.order]
    scale = math.sqrt(max(0.0, float(np.mean(F * F)) - 0.25) * max(0.0, float(np.mean(G * G)) - 0.25))
    if scale <= 0.0:
        return NONE
    influence = F * G
    value = (float(influence.mean()) - 0.25) / scale
    influence += x.above(G)
    influence += y.scattered(y.above(x.scattered(F)[y.order]))[x.order]
    return Estimate(value, float(influence.std()) / scale / math.sqrt(len(F)))


def sobol_index(parameter: Floats, result: Floats) -> Estimate:
    """Return the first-order Sobol index of a parameter from given data.

    Parameters
    ----------
    parameter, result : ndarray, shape (N,)
        Any sample of independent rows; of infinite results nothing is told, nor of fewer than ``MIN_FLIGHTS``.
    """
    return _sobol_of_finite(parameter, _ordered(parameter), result, np.isfinite(result))


def _sobol_of_finite(parameter: Floats, order: _Order, result: Floats, finite: NDArray[np.bool_]) -> Estimate:
    """Return the index, of the rows with a finite result."""
    first, last, along = order.first, order.last, result[order.order]
    if not finite.all():
        kept = finite[order.order]
        along = along[kept]
        first, last = _ties(parameter[order.order][kept])
    if len(along) < MIN_FLIGHTS:
        return NONE
    return _sobol_index(first + last, along)


def _sobol_index(twice_rank: Indices, result: Floats) -> Estimate:
    """Return the variance of bin means over the variance, less what noise within the bins adds to the former.

    The bins have equal probability, but equal values share one: a parameter of few values has a bin for each. Since
    the noise of their means is taken out, there can be many: sqrt(N) of them make what is lost within each small
    beside the standard error.

    Parameters
    ----------
    twice_rank : ndarray, shape (N,)
        Twice the middle place of each parameter among all, rising.
    result : ndarray, shape (N,)
        In this order.
    """
    count = len(result)
    bins = min(MAX_BINS, math.isqrt(count))
    equal = twice_rank * bins // (2 * count)
    which = np.cumsum(np.diff(equal, prepend=equal[0]) != 0)
    sizes = np.bincount(which)
    used = len(sizes)
    # by its largest value first: squares of what nearly diverged would overflow
    y = result / max(float(np.abs(result).max()), np.finfo(np.float64).tiny)
    y -= y.mean()
    total = float(y @ y)
    if total <= 0.0 or not 1 < used < count:
        return NONE
    means = np.bincount(which, weights=y) / sizes
    between = float(sizes @ means**2)
    within = (total - between) / (count - used)
    value = (between - (used - 1) * within) / total
    mean = means[which]
    influence = (2.0 * y - mean) * mean - value * y * y
    error = float(influence.var()) / (total / count) ** 2 / count
    # The variance of a sum of ``used`` squares of noise, which is all there is where the parameter does nothing. The
    # influence has twice too much of it, because each mean has its own rows' noise.
    noise = 2.0 * (used - 1) * (within / total) ** 2
    return Estimate(value, math.sqrt(max(error - noise, noise)))
