"""The probability of a failure too rare to be met by flying: adaptive multilevel splitting.

N paths are drawn, each with a score that only rises along it, such as the largest |e| so far. The K-th smallest final
score is a level. Every path that does not exceed it is replaced by a copy of one that does, chosen at random, up to
the first sample beyond the level, and goes on from there anew; the share that survived is one factor of the
probability. So it goes on, from level to level, until the next one is beyond the threshold. Levels are where the paths
are: nothing needs to be known of the system.

The estimate is unbiased for any N and K, in discrete time and with scores that tie, because all ties with the level
are killed and the sample that jumps over it is kept (Bréhier et al.). What a single run is worth nobody can tell from
that run, so several independent ones are flown, and their spread is the interval. Their estimates are skewed, most of
them low and a few far above: Student's interval would be too short at its upper end, and is studentised by resampling
instead (Efron's bootstrap-t).

References
----------
B. Efron, "Nonparametric standard errors and confidence intervals", Canad. J. Statist. 9(2), 1981.
F. Cérou, A. Guyader, "Adaptive multilevel splitting for rare event analysis", Stoch. Anal. Appl. 25(2), 2007.
C.-E. Bréhier, M. Gazeau, L. Goudenège, T. Lelièvre, M. Rousset, "Unbiasedness of some generalized adaptive multilevel
splitting algorithms", Ann. Appl. Probab. 26(6), 2016.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from gains.model import Matrix
from gains.table import InputError
from sitl.aircraft.linear import DIVERGED
from sitl.aircraft.plants import is_nonlinear
from sitl.campaign.intervals import CONFIDENCE, plain, proportion
from sitl.campaign.job import Campaign

__all__ = ["LEAST", "MAX_REPLICAS", "MIN_REPLICAS", "Descent", "Paths", "RareEvent", "event_of", "rare", "split"]

LEAST = 1e-30
"""A replica whose share has fallen below this is given up as 0, which takes less than this from the expectation."""

MIN_REPLICAS, MAX_REPLICAS = 10, 10_000

UNSURE = 0.8
"""Standard deviation of the replicas over their mean beyond which the interval is not believed."""

_STREAM, _RESAMPLED = 0x5911, 0xB007
"""Of the seeds: which survivors are copied, and which replicas are drawn again."""

_RESAMPLES = 3999

Integers = NDArray[np.int64]


class Paths(Protocol):
    """Random paths of a Markov process that can be cut and drawn anew."""

    scores: Matrix
    """Largest score up to and with each sample, shape (paths, samples)."""

    @property
    def roots(self) -> Integers:
        """Number of the first path from which each one stems, shape (paths,)."""

    def branch(self, killed: Integers, parents: Integers, kept: Integers) -> None:
        """Replace paths, scores included: the first ``kept`` samples are the parent's, the rest is drawn anew."""


class Descent(NamedTuple):
    """What one replica found.

    Attributes
    ----------
    probability : float
        The estimate; 0 where no path came beyond the threshold.
    levels : int
        How many there were.
    paths : int
        How many were drawn, the first ones included.
    roots : int
        From how many of the first paths those stem that came beyond the threshold.
    given_up : bool
        Whether the share fell below ``LEAST``.
    """

    probability: float
    levels: int
    paths: int
    roots: int
    given_up: bool


def split(paths: Paths, threshold: float, killed: int, rng: np.random.Generator) -> Descent:
    """Return an unbiased estimate of the probability that a path's score exceeds the threshold.

    Parameters
    ----------
    paths : Paths
        As they were drawn; they are changed.
    threshold : float
    killed : int
        K, how many are killed at least per level.
    rng : numpy.random.Generator
        Chooses which survivors are copied.
    """
    total = len(paths.scores)
    assert 1 <= killed < total
    share, levels, drawn = 1.0, 0, total
    while True:
        final = paths.scores[:, -1]
        level = float(np.partition(final, killed - 1)[killed - 1])
        if level > threshold:
            beyond = final > threshold
            found = share * float(np.mean(beyond))
            return Descent(found, levels, drawn, len(np.unique(paths.roots[beyond])), False)
        dead, alive = np.flatnonzero(final <= level), np.flatnonzero(final > level)
        share *= len(alive) / total
        levels += 1
        if share < LEAST:  # 0 where none survived
            return Descent(0.0, levels, drawn, 0, share > 0.0)
        parents = alive[rng.integers(len(alive), size=len(dead))]
        kept = np.count_nonzero(paths.scores[parents] <= level, axis=1) + 1
        paths.branch(dead, parents, kept)
        drawn += len(dead)


@dataclass(frozen=True, slots=True)
class RareEvent:
    """The probability of a failure, from independent replicas.

    Attributes
    ----------
    threshold : float or None
        Of |e|, in units of the output; None for divergence alone.
    probability : float
        Of one flight's failure: the mean over the replicas.
    low, high : float
        Its interval, of the bootstrap-t within [0, 1]; of Clopper and Pearson where no replica had a level, and so all
        flights are independent. Nothing is known above, nan, where the replicas are all the same, as where none found
        a failure.
    confidence : float
    relative_error : float
        Standard error of the probability over it; nan where that is 0.
    replicas : tuple of float
        The estimates.
    levels : tuple of int
        How many each replica had.
    roots : tuple of int
        From how many of its first flights a replica's failures stem: few mean that a failure hangs on gust, reference
        and x(0), which splitting does not draw anew, and that more particles help.
    given_up : int
        Replicas that were given up as 0, their share below ``LEAST``.
    particles, killed, samples, seed : int
    flights : int
        How many were flown, over all replicas.
    plain_flights_for_the_same_error : float
        How many flights of plain Monte Carlo have the same relative error.
    """

    threshold: float | None
    probability: float
    low: float
    high: float
    confidence: float
    relative_error: float
    replicas: tuple[float, ...]
    levels: tuple[int, ...]
    roots: tuple[int, ...]
    given_up: int
    particles: int
    killed: int
    samples: int
    seed: int
    flights: int
    plain_flights_for_the_same_error: float

    @property
    def efficiency(self) -> float:
        """How many times more flights plain Monte Carlo needs."""
        return self.plain_flights_for_the_same_error / self.flights

    @property
    def unsure(self) -> bool:
        """Whether the interval is not to be believed: the replicas differ so much that few of them say it all."""
        return not self.relative_error * math.sqrt(len(self.replicas)) <= UNSURE

    def to_json(self) -> dict[str, Any]:
        """Return it all as JSON has it, null for what is not known."""
        return {**plain(self), "efficiency": plain(self.efficiency), "unsure": self.unsure}


def rare(
    campaign: Campaign,
    threshold: float | None,
    *,
    particles: int = 1000,
    killed: int | None = None,
    replicas: int = 20,
    seed: int | None = None,
    workers: int = 1,
    told: Callable[[int], None] = lambda _: None,
) -> RareEvent:
    """Estimate the probability that a flight of a campaign fails.

    Parameters
    ----------
    campaign : Campaign
        Of a linear plant, with delays drawn from a process; its number of flights is of no meaning.
    threshold : float or None
        A flight fails where |e| of an output exceeds it, or the loop diverges; None counts divergence alone.
    particles : int
        N, paths per replica.
    killed : int, optional
        K, how many are killed at least per level; by default a tenth.
    replicas : int
        From ``MIN_REPLICAS`` to ``MAX_REPLICAS``.
    seed : int, optional
        Of everything random; by default the campaign's. The same one gives the same result to the last bit.
    workers : int
        Threads, fewer where their paths would not fit into ``MAX_CELLS`` together; of no effect on the result.
    told : callable
        Told how many replicas more are done.

    Raises
    ------
    InputError
        When the plant is not linear, the delays cannot be drawn anew from any sample on, or a number is out of range.
    """
    from sitl.campaign.branching import MAX_CELLS, FlightPaths  # with numba

    killed = max(1, particles // 10) if killed is None else killed
    _check(campaign, threshold, particles, killed, replicas)
    drawn = campaign if seed is None else dataclasses.replace(campaign, seed=seed)
    beyond = math.nextafter(DIVERGED, 0.0) if threshold is None else threshold

    def descend(replica: int) -> Descent:
        paths = FlightPaths(drawn, particles, replica, by_state=threshold is None)
        rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(drawn.seed, spawn_key=(_STREAM, replica))))
        found = split(paths, beyond, killed, rng)
        told(1)
        return found

    found = [descend(0)]  # which compiles
    at_once = max(1, min(workers, MAX_CELLS // (particles * campaign.samples)))
    with ThreadPoolExecutor(at_once) as pool:
        found += pool.map(descend, range(1, replicas))
    return event_of(found, threshold, particles, killed, drawn)


def _check(campaign: Campaign, threshold: float | None, particles: int, killed: int, replicas: int) -> None:
    """Refuse what cannot be split."""
    if is_nonlinear(campaign.plant_name):
        raise InputError(f"plant: expected a linear model, found {campaign.plant_name}")
    if threshold is not None and not 0.0 < threshold < math.inf:
        raise InputError(f"threshold: expected a number above 0, found {threshold:g}")
    if not 1 <= killed < particles:
        raise InputError(f"killed: expected at least 1 and fewer than the {particles} particles, found {killed}")
    if not MIN_REPLICAS <= replicas <= MAX_REPLICAS:
        raise InputError(f"replicas: expected from {MIN_REPLICAS} to {MAX_REPLICAS}, found {replicas}")


def event_of(
    found: list[Descent], threshold: float | None, particles: int, killed: int, campaign: Campaign
) -> RareEvent:
    """Return what replicas say together."""
    estimates = np.array([one.probability for one in found])
    mean = float(np.mean(estimates))
    error = float(np.std(estimates, ddof=1)) / math.sqrt(len(found))
    relative = error / mean if mean > 0.0 else math.nan
    if any(one.levels for one in found):
        low, high = _bootstrap_t(estimates, campaign.seed)
    else:
        flown = particles * len(found)
        exact = proportion(round(mean * flown), flown, CONFIDENCE)
        low, high = exact.low, exact.high
    return RareEvent(
        threshold=threshold,
        probability=mean,
        low=low,
        high=high,
        confidence=CONFIDENCE,
        relative_error=relative,
        replicas=tuple(one.probability for one in found),
        levels=tuple(one.levels for one in found),
        roots=tuple(one.roots for one in found),
        given_up=sum(one.given_up for one in found),
        particles=particles,
        killed=killed,
        samples=campaign.samples,
        seed=campaign.seed,
        flights=sum(one.paths for one in found),
        plain_flights_for_the_same_error=(1.0 - mean) / (mean * relative**2) if relative > 0.0 else math.nan,
    )


def _bootstrap_t(estimates: Matrix, seed: int) -> tuple[float, float]:
    """Return the interval of the mean whose t is distributed as that of samples drawn from the sample itself."""
    count, mean = len(estimates), float(np.mean(estimates))
    error = float(np.std(estimates, ddof=1))
    if error == 0.0:
        return 0.0, math.nan
    rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=(_RESAMPLED,))))
    t = np.empty(_RESAMPLES)
    for n in range(_RESAMPLES):
        again = estimates[rng.integers(count, size=count)]
        away, spread = float(np.mean(again)) - mean, float(np.std(again, ddof=1))
        t[n] = away / spread if spread > 0.0 else math.copysign(math.inf, away)
    tail = 0.5 - CONFIDENCE / 2.0
    least, most = np.quantile(t, (tail, 1.0 - tail), method="inverted_cdf")
    return max(0.0, mean - float(most) * error), min(1.0, mean - float(least) * error)
