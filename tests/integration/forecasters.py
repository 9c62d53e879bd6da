"""The best possible forecast of the delay: by one who knows both links' distributions and the true age of the sample.

A sample is complete when ATTITUDE and AOA_SSA have come, each with a jitter of its own; one that is older than a
complete one makes no command. A command of age a that travels r comes in time for sample m when a + r <= m Ts, and is
applied then unless a newer one has come by that sample too. Among the applied ones

    P(d = m | a)  ~  [F(m Ts - a) - F((m - 1) Ts - a)] P(no newer command in time for m | a).

Where packets overtake, travels are independent and :func:`by_convolution` computes this. Where they keep order, or to
check the other way, :func:`by_table` counts P(d | a) in a long simulation that shares nothing with the programs.
Milliseconds throughout.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from autopilot.link.clock import NS_PER_MS
from sitl.link.impairment import LinkSpec
from sitl.link.jitters import GammaJitter, UniformJitter
from sitl.link.losses import GilbertElliott
from sitl.link.spec import parse_spec
from tests.integration.estimation import TS_NS, Bools, Case, Floats, Forecasts, Ints

__all__ = ["best", "by_convolution", "by_table"]

TS = TS_NS / NS_PER_MS
COVERAGE = 0.95
MOST = 16
"""Delays that are considered."""
TABLE_SEED = 20_260
TABLE_SAMPLES = 800_000
BIN = 0.5
"""Width of the table's bins of ages."""
FEW = 300
"""A bin with fewer commands borrows from its neighbours."""
GRID = 0.02
LONGEST = 400.0
"""No packet travels so long."""
NEWER = 4
"""Newer commands that may come in time."""
PER_SAMPLE = 4
"""Packets up per sample: DELAY_K, ATTITUDE, AOA_SSA, VFR_HUD."""
DOWN_PER_SAMPLE = 1.25
"""Packets down per sample: its command, and TIMESYNC at 10 Hz."""
SIM_DRIFT = 2e-4
"""The period of TIMESYNC differs from a multiple of the plant's, so that all phases are met."""


def best(case: Case, ages: Floats) -> Forecasts:
    """Return the best forecasts for commands of some ages."""
    return (by_table if case.keep_order else by_convolution)(case, ages)


def _pick(weights: Floats) -> Forecasts:
    """Return mode and narrowest greedy interval of probability COVERAGE; ``weights[n, m]`` belongs to d = m."""
    chosen = np.zeros((len(weights), 3), dtype=np.int64)
    probability = np.zeros(len(weights))
    weights = weights / weights.sum(axis=1, keepdims=True)
    for n, row in enumerate(weights.tolist()):
        d = low = high = row.index(max(row))
        total = row[d]
        while total < COVERAGE:
            below, above = row[low - 1] if low > 0 else -1.0, row[high + 1] if high + 1 < len(row) else -1.0
            low, high = (low - 1, high) if below >= above else (low, high + 1)
            total += max(below, above)
        chosen[n], probability[n] = (d, low, high), total
    return Forecasts(chosen[:, 0], chosen[:, 1], chosen[:, 2], np.minimum(probability, 1.0))


# By convolution


def _cdf(spec: LinkSpec) -> Callable[[Floats], Floats]:
    """Return the distribution function of a packet's travel, ms."""
    delay = spec.delay_ns / NS_PER_MS
    if spec.jitter is None:
        return lambda t: (t >= delay - 1e-9).astype(np.float64)
    scale = spec.jitter.scale_ns / NS_PER_MS
    match spec.jitter:
        case GammaJitter():
            gamma = stats.gamma(2.0, loc=delay, scale=scale / 2.0)
            return lambda t: np.asarray(gamma.cdf(t), dtype=np.float64)
        case UniformJitter():
            uniform = stats.uniform(delay, scale)
            return lambda t: np.asarray(uniform.cdf(t), dtype=np.float64)
        case _:
            raise AssertionError(spec)


def _passes(spec: LinkSpec, packets: float) -> float:
    """Return the probability that a packet passes, given that the one so many packets before did."""
    if not isinstance(spec.loss, GilbertElliott):
        assert spec.loss == 0.0
        return 1.0
    lost, memory = spec.loss.bad_share, 1.0 - spec.loss.p - spec.loss.r
    return float(1.0 - lost + lost * memory**packets)


def by_convolution(case: Case, ages: Floats) -> Forecasts:
    """Return the best forecasts where packets overtake."""
    up, down = map(parse_spec, case.specs)
    up_cdf, down_cdf = _cdf(up), _cdf(down)
    x = np.arange(0.0, LONGEST, GRID)
    share = np.diff(up_cdf(np.append(x, LONGEST)) ** 2, prepend=0.0)[: x.size]  # of the age of a sample
    # complete: ATTITUDE passes, so many packets after the AOA_SSA of the sample at hand, and AOA_SSA next to it
    complete = [0.0] + [_passes(up, PER_SAMPLE * i - 1) * _passes(up, 1) for i in range(1, NEWER + 1)]
    makes = np.ones(x.size)  # ... a command: no newer sample is complete before it
    for i in range(1, NEWER + 1):
        makes *= 1.0 - complete[i] * up_cdf(x - i * TS) ** 2
    later = _above(share)
    in_time = [_above(share * makes * down_cdf(y * TS - x)) for y in range(MOST + 1)]
    weights = np.zeros((ages.size, MOST + 1))
    for m in range(1, MOST + 1):
        weights[:, m] = down_cdf(m * TS - ages) - (down_cdf((m - 1) * TS - ages) if m > 1 else 0.0)
        for i in range(1, min(m - 1, NEWER) + 1):
            at = np.clip(np.ceil((ages - i * TS) / GRID - 1e-6), 0, x.size).astype(np.int64)
            possible = complete[i] * later[at] + 1.0 - complete[i]
            came = complete[i] * _passes(down, DOWN_PER_SAMPLE * i) * in_time[m - i][at]
            weights[:, m] *= 1.0 - np.divide(came, possible, out=np.zeros(ages.size), where=possible > 0.0)
    return _pick(weights)


def _above(shares: Floats) -> Floats:
    """Return the sums from each place to the last, with a 0 behind them."""
    return np.append(np.cumsum(shares[::-1])[::-1], 0.0)


# By a table


@dataclass(frozen=True, slots=True, eq=False)
class _Table:
    """P(d | age): ``weights[b, m]`` for ages from ``first + b BIN``."""

    first: float
    weights: Floats


def by_table(case: Case, ages: Floats) -> Forecasts:
    """Return the best forecasts by counting."""
    table = _simulated(case)
    return _pick(table.weights[np.clip(((ages - table.first) / BIN).astype(int), 0, len(table.weights) - 1)])


@cache
def _simulated(case: Case) -> _Table:
    """Fly packets, without an autopilot or a plant, and count the delays of the commands that were applied."""
    rng = np.random.default_rng(TABLE_SEED)
    up, down = map(parse_spec, case.specs)
    n = TABLE_SAMPLES
    ticks = np.arange(n) * TS
    requests = np.arange(0.0, ticks[-1], 100.0 * (1.0 + SIM_DRIFT)) + 3.3
    sends = np.concatenate([np.repeat(ticks, PER_SAMPLE), ticks[::40], ticks[::40] + 7.0, requests + _mean(down)])
    arrivals = _link(up, sends, case.keep_order, rng)[: PER_SAMPLE * n].reshape(n, PER_SAMPLE)
    complete = arrivals[:, 1:3].max(axis=1)
    j = np.flatnonzero(np.isfinite(complete) & (complete < _later_least(complete)))
    sends = np.concatenate([complete[j], requests, ticks[::40] + 11.0])
    came = _link(down, sends, case.keep_order, rng)[: j.size]
    in_force = np.ceil(np.maximum(came - ticks[j], 1e-6) / TS - 1e-9)
    at = j.astype(np.float64) + in_force
    applied = np.isfinite(at) & (at < _later_least(at))
    return _counted((complete[j] - ticks[j])[applied], in_force[applied].astype(np.int64))


def _link(spec: LinkSpec, sends: Floats, keep_order: bool, rng: np.random.Generator) -> Floats:
    """Return when packets arrive; infinity for lost ones."""
    order = np.argsort(sends, kind="stable")
    exits = sends[order] + _draws(spec, sends.size, rng)
    lost = _losses(spec, sends.size, rng)
    if keep_order:
        exits = np.maximum.accumulate(np.where(lost, -np.inf, exits))
    arrivals = np.empty(sends.size)
    arrivals[order] = np.where(lost, np.inf, exits)
    return arrivals


def _draws(spec: LinkSpec, n: int, rng: np.random.Generator) -> Floats:
    travel = np.full(n, spec.delay_ns / NS_PER_MS)
    match spec.jitter:
        case GammaJitter(scale_ns):
            travel += rng.gamma(2.0, scale_ns / NS_PER_MS / 2.0, n)
        case UniformJitter(scale_ns):
            travel += rng.uniform(0.0, scale_ns / NS_PER_MS, n)
        case _:
            assert spec.jitter is None
    return travel


def _losses(spec: LinkSpec, n: int, rng: np.random.Generator) -> Bools:
    """Return which packets find the bad state: runs of geometric lengths, a good one first."""
    if not isinstance(spec.loss, GilbertElliott):
        return np.zeros(n, dtype=np.bool_)
    assert (spec.loss.bad, spec.loss.good) == (1.0, 0.0)
    runs = int(n * spec.loss.p) + 1000
    lengths = np.stack([rng.geometric(spec.loss.p, runs), rng.geometric(spec.loss.r, runs)], axis=1).ravel()
    states = np.repeat(np.arange(lengths.size) % 2 == 1, lengths)
    assert states.size >= n
    return states[:n]


def _mean(spec: LinkSpec) -> float:
    return float(_draws(spec, 1000, np.random.default_rng(1)).mean())


def _later_least(times: NDArray[np.float64]) -> Floats:
    """Return of each the least of all that follow it."""
    least = np.minimum.accumulate(times[::-1])[::-1]
    return np.append(least[1:], np.inf)


def _counted(ages: Floats, d: Ints) -> _Table:
    first = float(np.floor(ages.min() / BIN) * BIN)
    bin_ = ((ages - first) / BIN).astype(np.int64)
    counts = np.zeros((bin_.max() + 1, MOST + 1))
    np.add.at(counts, (bin_, np.minimum(d, MOST)), 1.0)
    total = np.cumsum(np.vstack([np.zeros(MOST + 1), counts]), axis=0)
    weights = np.empty_like(counts)
    for b in range(len(counts)):
        reach = 0
        while True:
            weights[b] = total[min(b + reach + 1, len(counts))] - total[max(b - reach, 0)]
            if weights[b].sum() >= FEW or reach > len(counts):
                break
            reach += 1
    return _Table(first, weights)
