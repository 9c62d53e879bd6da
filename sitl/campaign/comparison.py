"""Controllers flown on the same draws, compared flight by flight: which tracks better, how often, and which fails.

Pairs say much more than two campaigns side by side, because a flight's gust and delays are the same for both. What is
compared is the logarithm of the rms errors' ratio, by its median, which no distribution and no infinite value disturbs,
and by Wilcoxon's signed ranks; and the flights that only one of the two fails, by McNemar's exact test. A controller
that diverged has the larger error; where both did, the flight decides nothing and is counted.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom, wilcoxon

from gains.table import InputError
from sitl.campaign.intervals import CONFIDENCE, Proportion, Quantile, plain, proportion, quantiles
from sitl.campaign.statistics import Columns, Statistics, columns_of, failures, held, measure

__all__ = ["MAX_CONTROLLERS", "Comparison", "Pair", "compare", "compare_pair", "mcnemar"]

MAX_CONTROLLERS = 6
SHOWN_BINS = 80
DRAWN_ALIKE = ("d_mean", "d_max", "changes", "gust_amplitude", "gust_period_s", "reference_amplitude",
               "reference_period_s", "delta_amplitude", "x0_norm")  # fmt: skip
"""Columns that the same draw makes the same, whatever flies."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Pair:
    """Two controllers A and B on the same flights.

    Attributes
    ----------
    a, b : str
        Their names.
    flights : int
        That both flew.
    confidence : float
    both_diverged : int
        Flights that decide nothing about errors.
    log_ratio : Quantile
        Median of log(rms error of A / that of B) with its exact interval; below 0, A tracks better.
    p_signed_rank : float
        Wilcoxon's: how probable such signed ranks are, were the differences symmetric about 0.
    p_sign : float
        The sign test's, of flights without ties: were either as often the better one.
    better, worse : Proportion
        Flights in which A's error is the smaller, and the larger, of all flights.
    ties : int
    only_a_failed, only_b_failed, both_failed : int
        A failure is a divergence, or an error beyond the threshold.
    p_failures : float
        McNemar's exact: were both as likely to be the only one that fails.
    edges, counts : tuple
        Histogram of the finite log ratios but for the outermost, symmetric about 0.
    off : int
        Flights off the histogram: infinite ratios and the outermost.
    """

    a: str
    b: str
    flights: int
    confidence: float
    both_diverged: int
    log_ratio: Quantile
    p_signed_rank: float
    p_sign: float
    better: Proportion
    worse: Proportion
    ties: int
    only_a_failed: int
    only_b_failed: int
    both_failed: int
    p_failures: float
    edges: tuple[float, ...]
    counts: tuple[int, ...]
    off: int


@dataclass(frozen=True, slots=True)
class Comparison:
    """Controllers flown on the same draws.

    Attributes
    ----------
    names : tuple of str
    statistics : tuple of Statistics
        Of each, over all of its flights.
    pairs : tuple of Pair
        Each two of them, in the order of names. Every test and interval stands for itself.
    """

    names: tuple[str, ...]
    statistics: tuple[Statistics, ...]
    pairs: tuple[Pair, ...]

    def to_json(self) -> dict[str, Any]:
        """Return it as :func:`sitl.campaign.intervals.plain` has it."""
        found: dict[str, Any] = plain(self)
        return found


def compare(
    tables: Mapping[str, Any],
    *,
    etas: Mapping[str, float | None] | None = None,
    threshold: float | None = None,
    confidence: float = CONFIDENCE,
) -> Comparison:
    """Compare two or more controllers.

    Parameters
    ----------
    tables : mapping of str to (mapping of str to ndarray, or pyarrow Table)
        One row per flight, by the controllers' names; in any order, of other flights some may be there too.
    etas : mapping of str to float or None, optional
        What is proved of each.
    threshold : float or None
        An error beyond it is a failure.
    confidence : float

    Raises
    ------
    InputError
        For less than two or more than ``MAX_CONTROLLERS``, controllers without a common flight, a flight that is there
        twice, flights whose draws differ, or columns that are no campaign's.
    """
    if not 2 <= len(tables) <= MAX_CONTROLLERS:
        raise InputError(f"comparison: expected 2 to {MAX_CONTROLLERS} controllers, found {len(tables)}")
    columns = {name: columns_of(table) for name, table in tables.items()}
    known = etas or {}
    return Comparison(
        names=tuple(columns),
        statistics=tuple(
            measure(own, eta=known.get(name), threshold=threshold, confidence=confidence)
            for name, own in columns.items()
        ),
        pairs=tuple(
            compare_pair((a, columns[a]), (b, columns[b]), threshold=threshold, confidence=confidence)
            for a, b in combinations(columns, 2)
        ),
    )


def compare_pair(
    one: tuple[str, Columns], other: tuple[str, Columns], *, threshold: float | None, confidence: float = CONFIDENCE
) -> Pair:
    """Compare two controllers, each with its name and columns; raises as :func:`compare`."""
    (a, of_a), (b, of_b) = one, other
    of_a, of_b = _matched(a, of_a, b, of_b)
    differences = _log_ratio(held(of_a, "rms_error"), held(of_b, "rms_error"))
    told = differences[~np.isnan(differences)]
    told.sort()
    flights = len(differences)
    wins, losses = int(np.count_nonzero(told < 0.0)), int(np.count_nonzero(told > 0.0))
    failed_a, failed_b = failures(of_a, None, threshold), failures(of_b, None, threshold)
    only_a, only_b = int(np.count_nonzero(failed_a & ~failed_b)), int(np.count_nonzero(failed_b & ~failed_a))
    edges, counts = _histogram(told)
    return Pair(
        a=a,
        b=b,
        flights=flights,
        confidence=confidence,
        both_diverged=flights - len(told),
        log_ratio=quantiles(told, [0.5], confidence)[0],
        p_signed_rank=_signed_rank(told),
        p_sign=mcnemar(wins, losses),
        better=proportion(wins, flights, confidence),
        worse=proportion(losses, flights, confidence),
        ties=len(told) - wins - losses,
        only_a_failed=only_a,
        only_b_failed=only_b,
        both_failed=int(np.count_nonzero(failed_a & failed_b)),
        p_failures=mcnemar(only_a, only_b),
        edges=tuple(edges.tolist()),
        counts=tuple(counts.tolist()),
        off=len(told) - int(counts.sum()),
    )


def mcnemar(only_one: int, only_other: int) -> float:
    """Return the exact two-sided p-value of McNemar's test, the sign test of the discordant flights; 1 of none."""
    return min(1.0, 2.0 * float(binom.cdf(min(only_one, only_other), only_one + only_other, 0.5)))


def _matched(a: str, of_a: Columns, b: str, of_b: Columns) -> tuple[Columns, Columns]:
    """Return the rows of the common flights, in their order."""
    for name, columns in ((a, of_a), (b, of_b)):
        if len(np.unique(columns["flight"])) < len(columns["flight"]):
            raise InputError(f"comparison: {name}: expected each flight once, found one twice")
    common, in_a, in_b = np.intersect1d(of_a["flight"], of_b["flight"], assume_unique=True, return_indices=True)
    if not len(common):
        raise InputError(f"comparison: expected flights that {a} and {b} have in common, found none")
    kept_a = {name: column[in_a] for name, column in of_a.items()}
    kept_b = {name: column[in_b] for name, column in of_b.items()}
    for name in DRAWN_ALIKE:
        if name in kept_a and name in kept_b:
            differs = ~np.isclose(kept_a[name], kept_b[name], rtol=1e-9, atol=0.0, equal_nan=True)
            if differs.any():
                raise InputError(
                    f"comparison: expected {a} and {b} on the same draws, found another {name} in flight"
                    f" {common[differs][0]}"
                )
    return kept_a, kept_b


def _log_ratio(one: Floats, other: Floats) -> Floats:
    """Return log(one / other) without overflow; 0 where both are 0, nan where both are infinite."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.log(one) - np.log(other)
    return np.where((one == 0.0) & (other == 0.0), 0.0, ratio)


def _signed_rank(differences: Floats) -> float:
    """Return Wilcoxon's two-sided p-value, zeros left out; 1 where nothing differs."""
    moved = differences[differences != 0.0]
    if not moved.size:
        return 1.0
    finite = moved[np.isfinite(moved)]
    most = 2.0 * float(np.abs(finite).max()) if finite.size else 1.0
    # what is infinite only has to rank above all others
    return float(wilcoxon(np.clip(moved, -most, most)).pvalue)


def _histogram(rising: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Return a histogram of 99.8 % of the finite values, symmetric about 0."""
    finite = np.abs(rising[np.isfinite(rising)])
    most = float(np.quantile(finite, 0.998)) if finite.size else 0.0
    edges = np.linspace(-1.0, 1.0, SHOWN_BINS + 1) * (most or 1.0)
    counts, _ = np.histogram(rising[np.isfinite(rising)], bins=edges)
    return edges, counts
