"""Forecast of the loop delay d(k): the sample at which the plant will latch the command that leaves now.

The plant senses sample j at t_j and latches at t_j + i Ts. A command that leaves at own time t arrives
after the unknown transit of the return link, so

    d = max(1, ceil((t + offset + transit - t_j) / Ts)).

Transit is sampled by the TIMESYNC requests that take the same way: tc1 - (ts1 + offset). The offset
appears with opposite signs in the two terms and cancels, so an asymmetric link, which biases the offset,
does not bias d.

The estimate is a median with an interval; without fresh transits it is UNKNOWN, which is never a number.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from enum import StrEnum

from autopilot.link.clock import NS_PER_S

__all__ = ["DelayEstimate", "DelayEstimator", "DelayStatus"]

WINDOW = 64
"""Transits that describe the return link."""

MIN_TRANSITS = 5
"""Transits before there is a forecast."""

STALE_NS = 5 * NS_PER_S
"""After so long without a transit there is no forecast, and the transits before describe the link no more."""


class DelayStatus(StrEnum):
    """Whether there is a forecast."""

    UNKNOWN = "unknown"
    ESTIMATED = "estimated"


@dataclass(frozen=True, slots=True)
class DelayEstimate:
    """Forecast of d for one command.

    Attributes
    ----------
    d, low, high : int or None
        Median, and the least and largest d that the recent transits allow; None when UNKNOWN.
    status : DelayStatus
        UNKNOWN or ESTIMATED.
    """

    d: int | None
    low: int | None
    high: int | None
    status: DelayStatus


UNKNOWN = DelayEstimate(None, None, None, DelayStatus.UNKNOWN)


@dataclass(slots=True)
class DelayEstimator:
    """Recent transits of the return link, in the plant's time.

    Parameters
    ----------
    Ts_ns : int
        Sampling period.
    """

    Ts_ns: int
    _transits: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=WINDOW))
    _quantiles: tuple[int, int, int] | None = None

    def transit(self, tc1: int, ts1: int, now_ns: int) -> None:
        """Take one TIMESYNC exchange: its request left at ts1 (own time) and arrived at tc1 (plant's time)."""
        if self._transits and now_ns - self._transits[-1][0] > STALE_NS:
            self._transits.clear()
        self._transits.append((now_ns, tc1 - ts1))
        ordered = sorted(transit for _, transit in self._transits)
        self._quantiles = (ordered[0], ordered[len(ordered) // 2], ordered[-1])

    def forget(self) -> None:
        """Drop every transit: the plant's clock has stepped."""
        self._transits.clear()
        self._quantiles = None

    def forecast(self, sample_ns: int, now_ns: int) -> DelayEstimate:
        """Return d for a command leaving at ``now_ns`` (own) that used the sample stamped ``sample_ns`` (plant)."""
        if self._quantiles is None or len(self._transits) < MIN_TRANSITS:
            return UNKNOWN
        if now_ns - self._transits[-1][0] > STALE_NS:
            return UNKNOWN
        low, median, high = self._quantiles
        age_ns, Ts_ns = now_ns - sample_ns, self.Ts_ns
        return DelayEstimate(
            max(1, -(-(age_ns + median) // Ts_ns)),
            max(1, -(-(age_ns + low) // Ts_ns)),
            max(1, -(-(age_ns + high) // Ts_ns)),
            DelayStatus.ESTIMATED,
        )
