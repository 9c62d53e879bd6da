"""Forecast of the loop delay d(k): the sample at which the plant will latch the command that leaves now.

The plant senses sample j at t_j and latches at t_j + i Ts. A command that leaves at own time s arrives on the
plant's clock at s + offset + transit, so with its age a = s + offset - t_j

    d = max(1, ceil((a + transit) / Ts)).

TIMESYNC requests take the same way and sample the transit: tc1 - (ts1 + offset). The offset appears with opposite
signs in the two terms and cancels: an asymmetric link, which biases the offset, does not bias d. The skew of the
clocks, which does not cancel over a window of transits, comes from :mod:`autopilot.clocksync`.

The plant reports d(k) at each sample. Of two reports in a row that name different commands, the second is the first
delay of its command. These first delays correct the forecast: where commands travel otherwise than TIMESYNC, and
where some are overtaken (:mod:`autopilot.transits`). A link that has changed shows in the levels of new transits
among the old ones, which are then dropped; reports show it sooner, and move the forecast until then.

A forecast is the likeliest d, an interval, and the probability with which it contains the true d. Without fresh
transits or reports it is UNKNOWN, which is never a number.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import deque
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from autopilot.clocksync import ClockLine
from autopilot.history import Window, read_together, without_stalls
from autopilot.link.clock import NS_PER_S, NS_PER_US
from autopilot.transits import EVEN, Reports, TransitLaw, least_shift, transit_law

__all__ = ["COVERAGE", "DelayEstimate", "DelayEstimator", "DelayStatus"]

COVERAGE = 0.95
"""The interval is the narrowest that contains d with at least this probability."""

MAX_TRANSITS = 1024
"""Transits that describe the link: 100 s at 10 Hz."""
MAX_REPORTS = 4096
"""First delays that correct it: 100 s at 40 Hz. They decide the stated probability, so they are many."""
MAX_AGES = 1024
"""Ages that tell who overtakes."""
MAX_SENT = 256
"""Commands that wait for their report, and reports that wait for the one before."""

MIN_TRANSITS = 5
"""Transits before there is a forecast."""
MANY_TRANSITS = 64
"""Transits before the forecast's probability deserves its name; until then it is CONVERGING."""

STALE_NS = 5 * NS_PER_S
"""After so long without a transit or a report there is no forecast."""
FORGET_NS = 30 * NS_PER_S
"""Transits from before so long a silence describe the link no more."""

RENEW_TRANSITS = 160
"""The law is renewed after so many new transits at the latest, earlier while there are few,"""
RENEW_REPORTS = 640
"""or after so many reports."""
RENEW_SHARE = 4
"""While there are few: when the new ones are one in so many."""

FADE_SHARE = 0.04
"""What the next transit may differ from all before, where these are all alike, as a share of Ts: 1 ms of 25."""

CHANGE_TRANSITS = 16
"""Transits in a row that may show a change of the link, among at least as many before."""
CHANGE_SIGMA = 5.0
"""Their mean level must be off by so many standard deviations: once in three weeks at 10 Hz by chance."""
CHANGE_TOLERANCE_NS = 50 * NS_PER_US
"""Transits that differ by less are equal."""

CONTRADICTIONS = 3
"""So many reports beyond every transit ask for a shift; in a row they raise the suspicion of a change."""
SUSPECT_TRANSITS = MIN_TRANSITS
"""Transits in a row that confirm it, all at one end of those before:"""
SUSPECT_LEVEL = 0.4
"""off their middle by so much of at most one half, by chance once in 4,500 suspicions."""
SHIFT_REPORTS = 256
"""The latest reports, which decide the shift; after a suspicion only those since then."""
MAX_SPREAD = 1000
"""Delays that a forecast looks at, whatever transits a peer makes us believe in."""
MAX_TIME_NS = 1 << 61
"""No clock shows more, 73 years, of the Unix epoch too; what does is refused. Sums of two fit 64 bits with room."""
SCORES = 1000
"""Forecasts over which their success is averaged."""


class DelayStatus(StrEnum):
    """What a forecast is worth."""

    UNKNOWN = "unknown"
    """There is none."""
    CONVERGING = "converging"
    """It rests on few transits."""
    ESTIMATED = "estimated"


class DelayEstimate(NamedTuple):
    """Forecast of d for one command.

    Attributes
    ----------
    d : int or None
        The likeliest delay, samples; None when UNKNOWN.
    low, high : int or None
        The narrowest interval of delays that contains the true one with probability COVERAGE or more.
    probability : float or None
        The probability of that interval.
    status : DelayStatus
        What the numbers are worth.
    """

    d: int | None
    low: int | None
    high: int | None
    probability: float | None
    status: DelayStatus


UNKNOWN = DelayEstimate(None, None, None, None, DelayStatus.UNKNOWN)


class DelayEstimator:
    """What is known of the way of the commands; own times passed in, no I/O.

    Parameters
    ----------
    Ts_ns : int
        Sampling period.

    Attributes
    ----------
    due : bool
        Whether enough is new for :meth:`renew`.
    changes : int
        How often the link was found to have changed.
    shift_ns : int
        By how much longer the commands travel than TIMESYNC.
    scored : int
        Forecasts whose command was reported as applied.
    exact, covered : float
        Share of the latest of them that were right, and whose interval contained d.
    """

    def __init__(self, Ts_ns: int) -> None:
        self.Ts_ns = Ts_ns
        self.changes = self.scored = 0
        self.exact = self.covered = 0.0
        self.forget()

    def forget(self) -> None:
        """Drop all that is known: the plant's clock has stepped, or the plant is a new one."""
        self._transits = Window(MAX_TRANSITS, 2)
        self._ages = Window(MAX_AGES, 2)
        self._reports = Window(MAX_REPORTS, 3)
        self._sent: dict[int, tuple[int, int, DelayEstimate]] = {}
        self._latched: dict[int, int] = {}
        self._last_request = (0, 0)
        self._levels: deque[float] = deque(maxlen=CHANGE_TRANSITS)
        self._law: TransitLaw | None = None
        self._line = ClockLine(0, 0, 0.0)
        self._skew = 0.0
        self._fade_ns = 0.0
        self._status = DelayStatus.UNKNOWN
        self._heard_ns = self._transit_ns = 0
        self._restart(0)

    def _restart(self, transits: int) -> None:
        """Keep the last transits only; nothing that was learnt from reports or ages before."""
        self.shift_ns = 0
        self._transits.keep(transits)
        self._ages.keep(0)
        self._reports.keep(0)
        self._sent.clear()
        self._levels.clear()
        self._contradictions = self._in_a_row = 0
        self._suspected = False
        self._in_doubt = 0
        self._since_suspicion = SHIFT_REPORTS
        self._density = EVEN
        self.due = transits >= MIN_TRANSITS
        if transits < MIN_TRANSITS:
            self._law = None

    # What comes in

    def transit(self, tc1: int, ts1: int, now_ns: int) -> None:
        """Take one TIMESYNC exchange: its request left at ts1 (own time) and arrived at tc1 (plant's time)."""
        if abs(tc1 - ts1) > MAX_TIME_NS:
            return
        if now_ns - self._heard_ns > FORGET_NS and now_ns - self._transit_ns > FORGET_NS and self._transits.size:
            self._restart(0)
        self._heard_ns = self._transit_ns = now_ns
        self._transits.append((ts1, tc1 - ts1))
        self._see_due()
        (sent_ns, read_ns), self._last_request = self._last_request, (ts1, tc1)
        if self._suspected:
            self._in_doubt += 1
        law = self._law
        stalled = read_together(ts1 - sent_ns, tc1 - read_ns)
        if law is not None and not stalled and len(law.transits) >= CHANGE_TRANSITS:
            self._see_change(tc1 - ts1 - self._line.at(ts1), law.transits)

    def _see_change(self, transit_ns: int, transits: list[int]) -> None:
        """Compare the latest transits with those before; drop these when the link has changed."""
        transit_ns += self.shift_ns  # as those before are
        known = len(transits)
        lower = bisect_left(transits, transit_ns - CHANGE_TOLERANCE_NS)
        upper = bisect_right(transits, transit_ns + CHANGE_TOLERANCE_NS)
        self._levels.append((lower + upper) / (2 * known) - 0.5)
        n = len(self._levels)
        if self._suspected:
            changed = _at_one_end(self._levels) >= SUSPECT_TRANSITS
        else:
            variance = (1.0 / n + 1.0 / known) / 12.0  # of two samples of one distribution (Mann and Whitney)
            changed = n == CHANGE_TRANSITS and abs(sum(self._levels)) > n * CHANGE_SIGMA * math.sqrt(variance)
        if changed:
            self.changes += 1
            new = _at_one_end(self._levels)
            self._restart(new if new >= MIN_TRANSITS else n)
        elif n == CHANGE_TRANSITS:
            self._suspected, self._in_doubt = False, 0  # commands travel otherwise now, TIMESYNC does not: a shift

    def sent(self, j: int, sample_ns: int, now_ns: int, forecast: DelayEstimate) -> None:
        """Take note of the command of sample j, stamped ``sample_ns`` (plant), that leaves at ``now_ns`` (own)."""
        if abs(sample_ns) > MAX_TIME_NS:
            return
        self._ages.append((now_ns, sample_ns))
        self._sent[j] = (now_ns, sample_ns, forecast)
        if len(self._sent) > MAX_SENT:
            del self._sent[next(iter(self._sent))]

    def repeated(self, j: int) -> None:
        """Take note that the command of sample j is sent once more: its first delay would tell nothing any more."""
        self._sent.pop(j, None)

    def forget_commands(self) -> None:
        """Drop what is under way: the plant counts its samples anew. What is known of the link stays."""
        self._sent.clear()
        self._latched.clear()

    def report(self, k: int, j: int, now_ns: int) -> None:
        """Take the plant's word that the command of sample j was in force at its sample k."""
        latched = self._latched
        latched[k] = j
        if len(latched) > MAX_SENT:
            del latched[next(iter(latched))]
        if latched.get(k - 1, j) < j:
            self._applied(j, k - j, now_ns)
        after = latched.get(k + 1)
        if after is not None and after > j:
            self._applied(after, k + 1 - after, now_ns)

    def _applied(self, j: int, d: int, now_ns: int) -> None:
        """Learn from the first delay of a command."""
        sent = self._sent.pop(j, None)
        if sent is None or d < 1:
            return
        left_ns, sample_ns, forecast = sent
        self._heard_ns = now_ns
        sane = forecast.d is None or abs(forecast.d - d) <= MAX_SPREAD  # else a stamp of another clock
        if sane:
            self._reports.append((left_ns, sample_ns, d))
        if self._reports.new >= RENEW_REPORTS:
            self._see_due()
        forecast_d, low, high = forecast[:3]
        if forecast_d is None or low is None or high is None:
            return
        self.scored += 1
        weight = 1.0 / (self.scored if self.scored < SCORES else SCORES)
        covered = low <= d <= high
        self.exact += weight * ((forecast_d == d) - self.exact)
        self.covered += weight * (covered - self.covered)
        self._since_suspicion += 1
        if sane and not covered and self._law is not None and self._contradicts(self._law, sample_ns, left_ns, d):
            self._contradictions += 1
            self._in_a_row += 1
            if self._in_a_row == CONTRADICTIONS and len(self._law.transits) >= CHANGE_TRANSITS:
                self._suspect()
            self._see_due()
        else:
            self._in_a_row = 0

    def _contradicts(self, law: TransitLaw, sample_ns: int, left_ns: int, d: int) -> bool:
        """Return whether a command came earlier or later than any transit allows."""
        age_ns = self._age_ns(sample_ns, left_ns)
        late = d > 1 and (d - 1) * self.Ts_ns - age_ns >= law.transits[-1]
        return late or d * self.Ts_ns - age_ns < law.transits[0]

    def _suspect(self) -> None:
        """Let the latest reports alone decide the shift, and look closely at the next transits."""
        self._since_suspicion = CONTRADICTIONS
        if not self._suspected:
            self._suspected = True
            self._in_doubt = self._transits.new
            self._levels.clear()

    # The law

    def _see_due(self) -> None:
        """See whether enough is new."""
        new, size = self._transits.new, self._transits.size
        self.due = size >= MIN_TRANSITS and (
            new >= RENEW_TRANSITS
            or new * RENEW_SHARE >= size
            or self._reports.new >= RENEW_REPORTS
            or self._contradictions >= CONTRADICTIONS
        )

    def renew(self, line: ClockLine) -> None:
        """Describe the link anew, on the present line of the clocks. Takes a good part of a millisecond."""
        self._line, self._skew = line, line.skew_ppb / NS_PER_S
        exchanges = self._transits.rows()
        if self._in_doubt < len(exchanges):
            exchanges = exchanges[: len(exchanges) - self._in_doubt]  # the others may be of another link
        exchanges = without_stalls(exchanges)
        transits = exchanges[:, 1] - self._offsets(exchanges[:, 0])
        reports = self._reports.rows()
        ages = reports[:, 0] + self._offsets(reports[:, 0]) - reports[:, 1]
        if self._contradictions >= CONTRADICTIONS or self.shift_ns:
            last = min(self._since_suspicion, SHIFT_REPORTS)
            latest = Reports(ages[-last:], reports[-last:, 2])
            self.shift_ns = least_shift(latest, int(transits.min()), int(transits.max()), self.Ts_ns)
        self._contradictions = 0
        self.due = False
        left = self._ages.rows()
        self._law = transit_law(
            transits + self.shift_ns,
            left[:, 0] + self._offsets(left[:, 0]) - left[:, 1],
            Reports(ages, reports[:, 2]),
            self.Ts_ns,
            self._density,
        )
        self._density = self._law.density
        n = len(self._law.transits)
        spread_ns = self._law.transits[-1] - self._law.transits[0]
        self._fade_ns = max(spread_ns / math.log(n + 1), self.Ts_ns * FADE_SHARE)
        self._status = DelayStatus.ESTIMATED if n >= MANY_TRANSITS else DelayStatus.CONVERGING

    def _offsets(self, t_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the clock line at own times."""
        line = self._line
        drift_ns: NDArray[np.int64] = np.rint((t_ns - line.t_ref_ns) * self._skew).astype(np.int64)
        return drift_ns + line.offset_ns

    def _age_ns(self, sample_ns: int, left_ns: int) -> int:
        """Return the age of a sample (plant's time) at an own time."""
        line = self._line
        return left_ns + line.offset_ns + round((left_ns - line.t_ref_ns) * self._skew) - sample_ns

    # The forecast

    def ready(self, now_ns: int) -> bool:
        """Return whether a command that left now would have a forecast."""
        return self._law is not None and now_ns - self._heard_ns <= STALE_NS

    def forecast(self, sample_ns: int, now_ns: int) -> DelayEstimate:
        """Return d for a command leaving at ``now_ns`` (own) that used the sample stamped ``sample_ns`` (plant)."""
        law, line, Ts_ns = self._law, self._line, self.Ts_ns
        if law is None or now_ns - self._heard_ns > STALE_NS:
            return UNKNOWN
        # as _age_ns, which would cost a call
        age_ns = now_ns + line.offset_ns + round((now_ns - line.t_ref_ns) * self._skew) - sample_ns
        transits, levels = law.transits, law.levels
        first = -(-(age_ns + transits[0]) // Ts_ns)
        last = -(-(age_ns + transits[-1]) // Ts_ns)
        if first < 1:
            if age_ns + transits[-1] < -Ts_ns // 2:
                return UNKNOWN  # no command arrives before its sample was taken: the stamps are wrong
            first, last = 1, max(1, last)
        if first == last:
            return DelayEstimate(first, first, first, self._most(law, age_ns, first, first), self._status)
        if last > first + MAX_SPREAD:
            last = first + MAX_SPREAD
        opened = law.open_at(age_ns)
        known = len(opened) - 1
        weights, total, before, limit_ns = [], 0.0, 0.0, first * Ts_ns - age_ns
        for m in range(first, last):
            level = levels[bisect_right(transits, limit_ns)]
            weight = (level - before) * opened[m if m < known else known]
            weights.append(weight)
            total += weight
            before, limit_ns = level, limit_ns + Ts_ns
        weight = (1.0 - before) * opened[last if last < known else known]
        weights.append(weight)
        total += weight
        return self._summary(law, age_ns, first, weights, total)

    def _summary(self, law: TransitLaw, age_ns: int, first: int, weights: list[float], total: float) -> DelayEstimate:
        """Return the likeliest of the delays from ``first`` on, and the interval around it."""
        best = weights.index(max(weights))
        low = high = best
        covered, enough, last = weights[best], COVERAGE * total, len(weights) - 1
        while covered < enough and (low > 0 or high < last):
            if high == last or (low > 0 and weights[low - 1] >= weights[high + 1]):
                low -= 1
                covered += weights[low]
            else:
                high += 1
                covered += weights[high]
        while low < best or best < high:  # with several humps more may have been taken than is needed
            end = low if best == high or (low < best and weights[low] <= weights[high]) else high
            if covered - weights[end] < enough:
                break
            covered -= weights[end]
            low, high = (low + 1, high) if end == low else (low, high - 1)
        most, share = self._most(law, age_ns, first + low, first + high), covered / total
        return DelayEstimate(first + best, first + low, first + high, most if most < share else share, self._status)

    def _most(self, law: TransitLaw, age_ns: int, low: int, high: int) -> float:
        """Return the most that n transits can say for an interval of delays: one more may lie beyond them all.

        It does so with probability 1 / (n + 1) on each side; that it also leaves the interval is taken to fade
        exponentially with the room up to its end, on the scale on which n transits have spread.
        """
        transits = law.transits
        room_ns = high * self.Ts_ns - age_ns - transits[-1]
        beyond = math.exp(-room_ns / self._fade_ns) if room_ns >= 0 else 0.0
        room_ns = transits[0] - (low - 1) * self.Ts_ns + age_ns
        if low > 1 and room_ns >= 0:
            beyond += math.exp(-room_ns / self._fade_ns)
        return 1.0 - beyond / (len(transits) + 1)


def _at_one_end(levels: deque[float]) -> int:
    """Return how many of the last levels lie at the same end, in a row."""
    end = math.copysign(1.0, levels[-1])
    n = 0
    for level in reversed(levels):
        if level * end < SUSPECT_LEVEL:
            break
        n += 1
    return n
