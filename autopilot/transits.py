"""The law of the way back: how long commands travel, and which of them are ever applied.

A command that leaves at age a (of its sample) and travels r is in time for the sample m later when a + r <= m Ts.
It is applied then, with d = m, unless a newer command has come by that sample too. So of the commands that are
applied

    P(d = m | a)  ~  [H(F(m Ts - a)) - H(F((m - 1) Ts - a))] open(m, a),

F the distribution of r as the TIMESYNC requests sample it, H a correction of it, and open(m, a) the probability
that no newer command comes in time. Ages and transits contain the unknown offset between the clocks with opposite
signs; their sum, the loop time, does not.

H maps [0, 1] onto itself. Commands need not travel as TIMESYNC does: they differ in size, and where the link keeps
order they queue behind each other. The reported delays tell: each says between which two levels of F its command
was. Which H makes them likeliest is found by expectation maximisation, as for any interval-censored sample
(Turnbull 1976), on a few bins that are narrow at both tails.

Arrays in nanoseconds, vectorised; called a few times per minute, while no command waits.

References
----------
B. W. Turnbull, "The empirical distribution function with arbitrarily grouped, censored and truncated data",
J. R. Stat. Soc. B 38, 1976.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["EVEN", "Reports", "TransitLaw", "least_shift", "transit_law"]

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

_EDGES = np.array([0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.95, 0.98, 0.99, 1.0])
"""Levels of F between which the correction is linear."""
_WIDTHS = np.diff(_EDGES)

EVEN: Floats = np.ones(_WIDTHS.size)
"""The density of H that corrects nothing."""

PRIOR_REPORTS = 30.0
"""The even density weighs as much as so many reports."""
MIN_REPORTS = 20
"""Fewer reports correct nothing."""
ITERATIONS = 2
"""Steps of expectation maximisation per renewal; the next renewal goes on from there."""

MAX_NEWER = 4
"""Newer commands that are looked at: the fifth would have to gain five samples."""
LEAST_OPEN = 1e-6
"""What is applied against all odds has a probability all the same."""
MAX_BINS = 64
"""Bins of the ages."""
BINS_PER_SAMPLE = 25
"""Bins of the ages per sampling period, where MAX_BINS allows it."""
MAX_SLOTS = 48
"""A loop of more samples is forecast without asking who overtakes."""

_ALL_OPEN = [1.0]

MIN_AGREEMENT = 3
"""A shift must explain so many reports more than none."""


@dataclass(frozen=True, slots=True, eq=False)
class Reports:
    """First delays of commands that were applied.

    Attributes
    ----------
    ages : (n,) int array
        Age of each command when it left, ns.
    d : (n,) int array
        Its delay, samples.
    """

    ages: Ints
    d: Ints


@dataclass(frozen=True, slots=True, eq=False)
class TransitLaw:
    """What a forecast needs, as plain lists: it is made between a packet in and a packet out.

    Attributes
    ----------
    transits : list of int, length n
        Transits of TIMESYNC requests, rising, ns.
    levels : list of float, length n + 1
        H(i / n): the probability that a command travels less than ``transits[i]``.
    first_age_ns, bin_ns : int
        Left end of the first bin of ages, and the width of all.
    open : list of lists of float
        open[bin][m]; empty when nothing overtakes.
    density : (14,) array
        The density of H.
    """

    transits: list[int]
    levels: list[float]
    first_age_ns: int
    bin_ns: int
    open: list[list[float]]
    density: Floats

    def open_at(self, age_ns: int) -> list[float]:
        """Return the open[m] of an age, all above 0; the last stands for every larger m."""
        if not self.open:
            return _ALL_OPEN
        bin_ = (age_ns - self.first_age_ns) // self.bin_ns
        return self.open[bin_ if 0 <= bin_ < len(self.open) else 0 if bin_ < 0 else -1]


def transit_law(transits: Ints, ages: Ints, reports: Reports, Ts_ns: int, density: Floats) -> TransitLaw:
    """Return the law that transits, ages and reports describe.

    Parameters
    ----------
    transits : (n,) int array
        Of TIMESYNC requests, in any order, ns; at least one.
    ages : (m,) int array
        Of the commands that have left lately, ns.
    reports : Reports
        What came of some of them.
    Ts_ns : int
        Sampling period.
    density : (14,) array
        The density of H from the last time; ``EVEN`` to begin with.
    """
    transits = np.sort(transits)
    n = transits.size
    first, width, opened = 0, 1, np.ones((0, 0))
    slots = 0 if ages.size == 0 else int(-(-(int(ages.max()) + int(transits[-1])) // Ts_ns)) + 1
    if 1 < slots <= MAX_SLOTS:
        first, width, counts = _bins(ages, Ts_ns)
        opened = _open(transits, _levels_of(density), counts, first, width, Ts_ns, slots)
        if reports.d.size >= MIN_REPORTS:
            density = _correct(transits, opened, first, width, Ts_ns, reports, density)
    levels = np.interp(np.arange(n + 1) / n, _EDGES, _levels_of(density))
    return TransitLaw(transits.tolist(), levels.tolist(), first, width, opened.tolist(), density)


def least_shift(reports: Reports, shortest_ns: int, longest_ns: int, Ts_ns: int) -> int:
    """Return by how much longer than TIMESYNC the commands seem to travel, ns; 0 when the reports do not tell.

    A command of age a that was applied with delay d came in ((d - 1) Ts, d Ts], so the shift s obeys

        (d - 1) Ts - a - longest  <  s  <=  d Ts - a - shortest.

    Each report is one such interval; the answer lies in as many of them as any value does: 0 if that does, else in
    the middle of those that do.
    """
    low = (reports.d - 1) * Ts_ns - reports.ages - longest_ns
    high = reports.d * Ts_ns - reports.ages - shortest_ns
    low = np.where(reports.d == 1, np.iinfo(np.int64).min, low)  # what comes early waits for the first sample
    below, above = np.sort(low), np.sort(high)

    def agreeing(shift: Ints | np.int64) -> Ints:
        return np.searchsorted(below, shift, "left") - np.searchsorted(above, shift, "left")

    candidates = np.concatenate([[0], high, low[reports.d > 1] + 1])
    agree = agreeing(candidates)
    if agree.max() - agree[0] < MIN_AGREEMENT:
        return 0
    best = candidates[agree == agree.max()]
    middle = best.min() + (best.max() - best.min()) // 2
    apart = agreeing(middle) < agree.max()
    return int(best[np.argmin(np.abs(best))] if apart else middle)


def _levels_of(density: Floats) -> Floats:
    """Return H at the edges of its bins."""
    return np.concatenate([[0.0], np.cumsum(density * _WIDTHS)])


def _bins(ages: Ints, Ts_ns: int) -> tuple[int, int, Floats]:
    """Return the first left end, the width and the shares of the bins of the ages."""
    first, last = int(ages.min()), int(ages.max())
    width = max(Ts_ns // BINS_PER_SAMPLE, (last - first) // MAX_BINS + 1)
    counts = np.bincount((ages - first) // width)
    return first, width, counts / ages.size


def _open(transits: Ints, H: Floats, counts: Floats, first: int, width: int, Ts_ns: int, slots: int) -> Floats:
    """Return the probability per bin of ages and slot m (0 to slots) that no newer command is in time for m.

    The i-th newer command has not left yet, so its age exceeds a - i Ts; it comes in time when its own loop time
    is at most (m - i) Ts.
    """
    bins = counts.size
    centres = first + (np.arange(bins) + 0.5) * width
    loop_ns = np.arange(slots + 1) * Ts_ns
    in_time = np.interp(np.searchsorted(transits, loop_ns[:, None] - centres, "right") / transits.size, _EDGES, H)
    joint = _from_the_right(counts * in_time)  # [y, b] = P(loop time <= y Ts, age in bin b or later)
    later = _from_the_right(counts)
    opened = np.ones((bins, slots + 1))
    for i in range(1, min(slots, MAX_NEWER + 1)):
        bin_ = np.clip(np.ceil((centres - i * Ts_ns - first) / width), 0, bins).astype(np.int64)
        share = np.divide(joint[:, bin_], later[bin_], out=np.zeros((slots + 1, bins)), where=later[bin_] > 0.0)
        opened[:, i + 1 :] *= 1.0 - share[1 : slots + 1 - i].T
    return np.maximum(opened, LEAST_OPEN)


def _from_the_right(shares: Floats) -> Floats:
    """Return the sums from each bin to the last, with a 0 behind them."""
    sums = np.cumsum(shares[..., ::-1], axis=-1)[..., ::-1]
    return np.concatenate([sums, np.zeros((*shares.shape[:-1], 1))], axis=-1)


def _correct(
    transits: Ints, opened: Floats, first: int, width: int, Ts_ns: int, reports: Reports, density: Floats
) -> Floats:
    """Return the density of H after a few steps towards the one that makes the reports likeliest."""
    bins, slots = opened.shape[0], opened.shape[1] - 1
    bin_ = np.clip((reports.ages - first) // width, 0, bins - 1)
    known = (reports.d >= 1) & (reports.d <= slots)
    seen = np.bincount(bin_[known] * (slots + 1) + reports.d[known])
    kinds = np.flatnonzero(seen)
    seen = seen[kinds]
    bin_, d = kinds // (slots + 1), kinds % (slots + 1)
    centres = first + (bin_ + 0.5) * width
    level = np.searchsorted(transits, np.arange(slots + 1) * Ts_ns - centres[:, None], "right") / transits.size
    level[:, 0] = 0.0  # what comes early waits for the first sample
    within = np.clip((level[:, :, None] - _EDGES[:-1]) / _WIDTHS, 0.0, 1.0)
    weights = np.diff(within, axis=1) * _WIDTHS * opened[bin_, 1:, None]  # [report, slot, bin of H]
    observed, possible = weights[np.arange(d.size), d - 1], weights.sum(axis=1)
    for _ in range(ITERATIONS):
        likely, total = observed @ density, possible @ density
        tell = (likely > 1e-9 * total) & (likely < (1.0 - 1e-6) * total)
        have = (seen[tell] / likely[tell]) @ observed[tell] * density
        want = (seen[tell] / total[tell]) @ possible[tell] * density
        density = density * (PRIOR_REPORTS * _WIDTHS + have) / (PRIOR_REPORTS * _WIDTHS + want)
        density = density / (density @ _WIDTHS)
    return density
