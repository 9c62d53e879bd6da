"""What a sample says of the distribution it is from, whatever that is: probabilities and quantiles, with intervals.

The interval of a probability is Clopper and Pearson's, that of a quantile is between two order statistics: both hold
the truth with at least their confidence. Nothing is interpolated, so an infinite value stays one.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta, binom

__all__ = ["CONFIDENCE", "QUANTILES", "Proportion", "Quantile", "plain", "proportion", "quantiles"]

CONFIDENCE = 0.95
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95, 0.99, 0.999, 1.0)

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Proportion:
    """A count out of a total, and what it says of the probability.

    Attributes
    ----------
    count, total : int
    low, high : float
        Clopper and Pearson's two-sided interval: its ends have half the remaining probability each.
    upper : float
        The one-sided bound of the same confidence; about 3 / total at 95 % where the count is 0.
    """

    count: int
    total: int
    low: float
    high: float
    upper: float

    @property
    def share(self) -> float:
        """The count over the total; nan of none."""
        return self.count / self.total if self.total else math.nan


@dataclass(frozen=True, slots=True)
class Quantile:
    """The least value that a share ``p`` of the flights does not exceed.

    Attributes
    ----------
    p : float
        1 is the largest value of the sample, of which no interval speaks.
    value : float
        An order statistic of the sample; nan of none.
    low, high : float
        Order statistics that hold the quantile of all flights with at least the confidence between them; -inf or inf
        where the sample is too small to have one, and for p = 1.
    """

    p: float
    value: float
    low: float
    high: float


def proportion(count: int, total: int, confidence: float = CONFIDENCE) -> Proportion:
    """Return the interval of Clopper and Pearson for the probability behind ``count`` successes out of ``total``."""
    assert 0 <= count <= total
    assert 0.0 < confidence < 1.0
    half = (1.0 - confidence) / 2.0
    low = float(beta.ppf(half, count, total - count + 1)) if count else 0.0
    return Proportion(
        count, total, low, _upper(count, total, half), _upper(count, total, 1.0 - confidence)
    )  # fmt: skip


def _upper(count: int, total: int, remaining: float) -> float:
    """Return the probability at which so few successes or fewer have a probability of ``remaining``."""
    if count == total:  # none of none says nothing
        return 1.0
    if count == 0:  # (1 - p)^total = remaining, without the cancellation
        return -math.expm1(math.log(remaining) / total)
    return float(beta.isf(remaining, count + 1, total - count))


def quantiles(
    rising: Floats, shares: Sequence[float] = QUANTILES, confidence: float = CONFIDENCE
) -> tuple[Quantile, ...]:
    """Return quantiles with distribution-free intervals.

    Parameters
    ----------
    rising : ndarray, shape (N,)
        The sample, sorted; without nan.
    shares : sequence of float
        In (0, 1].
    confidence : float
    """
    return tuple(_quantile(rising, p, confidence) for p in shares)


def _quantile(rising: Floats, p: float, confidence: float) -> Quantile:
    """Return one quantile: the number B of values up to the true one is binomial (N, p), whatever the distribution."""
    count = len(rising)
    if not count:
        return Quantile(p, math.nan, -math.inf, math.inf)
    # as a fraction of the decimal number, because 0.07 · 100 > 7 in floating point
    value = float(rising[max(1, math.ceil(Fraction(str(p)) * count)) - 1])
    if p == 1.0:
        return Quantile(p, value, -math.inf, math.inf)
    half = (1.0 - confidence) / 2.0
    low, high = int(binom.ppf(half, count, p)), int(binom.isf(half, count, p)) + 1
    return Quantile(
        p,
        value,
        float(rising[low - 1]) if low >= 1 else -math.inf,
        float(rising[high - 1]) if high <= count else math.inf,
    )


def plain(value: Any) -> Any:
    """Return results as JSON has them: objects and lists; nan becomes None, infinities the texts "inf" and "-inf"."""
    if dataclasses.is_dataclass(value):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(name): plain(one) for name, one in value.items()}
    if isinstance(value, tuple | list):
        return [plain(one) for one in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else str(value)
    return value
