"""Clock offset between autopilot and plant from TIMESYNC exchanges, as an interval that cannot lie.

One exchange sends ``ts1`` (our clock), the peer answers with ``tc1`` (its clock) somewhere between our
sending and our receiving, so with offset = peer - own

    tc1 - t_received  <=  offset  <=  tc1 - ts1.

Each exchange is two inequalities that hold whatever the latency and however asymmetric the link. Over a
sliding window, widened with age by the largest drift two clocks may have, their intersection is the
estimate; an empty intersection means that a clock has stepped.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from enum import StrEnum

from autopilot.link.clock import NS_PER_MS, NS_PER_S

__all__ = ["ClockEstimate", "ClockStatus", "ClockSync"]

WINDOW = 100
"""Exchanges that bound the offset: 10 s at 10 Hz."""

MAX_DRIFT_PPM = 400
"""Largest relative drift between two clocks, two crystals at +-200 ppm."""

MAX_OUTSTANDING = 64
"""Requests that may wait for an answer; the oldest is forgotten first."""

MIN_EXCHANGES = 5
"""Exchanges before the interval counts as an estimate."""

STEP_CONFIRMATIONS = 3
"""Consecutive exchanges that contradict the window before the clock counts as stepped."""

STALE_NS = 5 * NS_PER_S
"""Without an exchange for so long the estimate is not trusted."""


class ClockStatus(StrEnum):
    """What the estimate is worth."""

    UNSYNCHRONISED = "unsynchronised"
    CONVERGING = "converging"
    LOCKED = "locked"


@dataclass(frozen=True, slots=True)
class ClockEstimate:
    """Offset of the peer's clock against ours.

    Attributes
    ----------
    offset_ns : int
        Peer's time minus own time, the middle of the interval.
    bound_ns : int
        Half the interval: the error cannot be larger while the drift stays within its limit.
    status : ClockStatus
        UNSYNCHRONISED: offset and bound mean nothing.
    """

    offset_ns: int
    bound_ns: int
    status: ClockStatus


@dataclass(frozen=True, slots=True)
class _Exchange:
    """The interval of one exchange, at the own time of its answer."""

    at_ns: int
    low_ns: int
    high_ns: int


@dataclass(slots=True)
class ClockSync:
    """Offset estimator: state of the window; ``step``-like methods, no I/O, own time passed in.

    Attributes
    ----------
    steps : int
        How often the peer's clock was found to have stepped.
    last_step_ns : int
        By how much it stepped last; negative is a jump back, as after a restart.
    unmatched : int
        Answers that matched no request of ours: late, replayed or forged.
    """

    steps: int = 0
    last_step_ns: int = 0
    unmatched: int = 0
    _outstanding: dict[int, None] = field(default_factory=dict)
    _window: deque[_Exchange] = field(default_factory=lambda: deque(maxlen=WINDOW))
    _contradicting: list[_Exchange] = field(default_factory=list)

    def request(self, now_ns: int) -> int:
        """Return the ``ts1`` of a new request sent now, and remember it."""
        if len(self._outstanding) >= MAX_OUTSTANDING:
            del self._outstanding[next(iter(self._outstanding))]
        self._outstanding[now_ns] = None
        return now_ns

    def answer(self, tc1: int, ts1: int, now_ns: int) -> int | None:
        """Take the peer's answer; return the round trip in ns, or None when it answers no request of ours."""
        if ts1 not in self._outstanding:
            self.unmatched += 1
            return None
        del self._outstanding[ts1]
        exchange = _Exchange(now_ns, tc1 - now_ns, tc1 - ts1)
        low_ns, high_ns = self._interval(now_ns)
        if self._window and (exchange.low_ns > high_ns or exchange.high_ns < low_ns):
            self._contradicting.append(exchange)
            if len(self._contradicting) >= STEP_CONFIRMATIONS:
                self._restart_window((low_ns + high_ns) // 2)
        else:
            self._contradicting.clear()
            self._window.append(exchange)
        return now_ns - ts1

    def estimate(self, now_ns: int) -> ClockEstimate:
        """Return the offset at ``now_ns``."""
        if not self._window or now_ns - self._window[-1].at_ns > STALE_NS:
            return ClockEstimate(0, 0, ClockStatus.UNSYNCHRONISED)
        low_ns, high_ns = self._interval(now_ns)
        status = ClockStatus.LOCKED if len(self._window) >= MIN_EXCHANGES else ClockStatus.CONVERGING
        return ClockEstimate((low_ns + high_ns) // 2, max(0, (high_ns - low_ns + 1) // 2), status)

    def _interval(self, now_ns: int) -> tuple[int, int]:
        """Intersect the window's intervals, each widened by the drift since its exchange."""
        low_ns, high_ns = -(1 << 63), 1 << 63
        for e in self._window:
            widening_ns = (now_ns - e.at_ns) * MAX_DRIFT_PPM // NS_PER_MS
            low_ns = max(low_ns, e.low_ns - widening_ns)
            high_ns = min(high_ns, e.high_ns + widening_ns)
        return low_ns, high_ns

    def _restart_window(self, old_offset_ns: int) -> None:
        """Forget the window and go on from the exchanges that contradicted it."""
        newest = self._contradicting[-1]
        self.steps += 1
        self.last_step_ns = (newest.low_ns + newest.high_ns) // 2 - old_offset_ns
        self._window.clear()
        self._window.extend(self._contradicting)
        self._contradicting.clear()
