"""Clock offset between autopilot and plant from TIMESYNC exchanges, as an interval that cannot lie.

One exchange sends ``ts1`` (our clock), the peer answers with ``tc1`` (its clock) somewhere between our
sending and our receiving, so with offset = peer - own

    tc1 - t_received  <=  offset  <=  tc1 - ts1.

Each exchange is two inequalities that hold whatever the latency and however asymmetric the link. The
intersection of all of them, each widened with its age by the largest drift that two clocks may have, is
the estimate. All widen at the same rate, so the intersection is kept by one recursion, and nothing is
ever forgotten but by growing loose. An empty intersection means that a clock has stepped.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

from autopilot.link.clock import NS_PER_S

__all__ = ["ClockEstimate", "ClockStatus", "ClockSync"]

MAX_DRIFT_PPB = 400_100
"""Largest relative drift between two clocks, parts per billion: two crystals at +-200 ppm, one against the other."""

MAX_OUTSTANDING = 64
"""Requests that may wait for an answer; the oldest is forgotten first."""

MIN_EXCHANGES = 5
"""Exchanges before the interval counts as locked."""

STEP_CONFIRMATIONS = 3
"""Consecutive exchanges that contradict the interval before the clock counts as stepped."""

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


def _drift_ns(elapsed_ns: int) -> int:
    """Return by how much two clocks may part in a time, rounded up."""
    return -(-elapsed_ns * MAX_DRIFT_PPB // NS_PER_S)


@dataclass(frozen=True, slots=True)
class _Interval:
    """low <= offset <= high at own time ``at_ns``, from ``exchanges`` exchanges."""

    at_ns: int
    low_ns: int
    high_ns: int
    exchanges: int = 1

    def at(self, now_ns: int) -> _Interval:
        """Return the interval widened by the drift since."""
        widening_ns = _drift_ns(now_ns - self.at_ns)
        return _Interval(now_ns, self.low_ns - widening_ns, self.high_ns + widening_ns, self.exchanges)

    def meet(self, other: _Interval) -> _Interval | None:
        """Return the intersection with a later interval; None when there is none."""
        mine = self.at(other.at_ns)
        low_ns, high_ns = max(mine.low_ns, other.low_ns), min(mine.high_ns, other.high_ns)
        if low_ns > high_ns:
            return None
        return _Interval(other.at_ns, low_ns, high_ns, self.exchanges + other.exchanges)

    @property
    def middle_ns(self) -> int:
        """The middle of the interval."""
        return (self.low_ns + self.high_ns) // 2


@dataclass(slots=True)
class ClockSync:
    """Offset estimator: the interval and the requests under way; no I/O, own time passed in.

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
    _interval: _Interval | None = None
    _contradicting: list[_Interval] = field(default_factory=list)

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
        # the upper bound is from the time of sending: the clocks have drifted since
        exchange = _Interval(now_ns, tc1 - now_ns, tc1 - ts1 + _drift_ns(now_ns - ts1))
        narrowed = exchange if self._interval is None else self._interval.meet(exchange)
        if narrowed is not None:
            self._interval = narrowed
            self._contradicting.clear()
        else:
            self._contradicting.append(exchange)
            if len(self._contradicting) >= STEP_CONFIRMATIONS:
                self._step()
        return now_ns - ts1

    def estimate(self, now_ns: int) -> ClockEstimate:
        """Return the offset at ``now_ns``."""
        if self._interval is None or now_ns - self._interval.at_ns > STALE_NS:
            return ClockEstimate(0, 0, ClockStatus.UNSYNCHRONISED)
        interval = self._interval.at(now_ns)
        status = ClockStatus.LOCKED if interval.exchanges >= MIN_EXCHANGES else ClockStatus.CONVERGING
        return ClockEstimate(interval.middle_ns, (interval.high_ns - interval.low_ns + 1) // 2, status)

    def peer_at_most_ns(self, now_ns: int) -> int | None:
        """Return what the peer's clock shows at the most; None while not locked."""
        interval = self._interval
        if interval is None or interval.exchanges < MIN_EXCHANGES or now_ns - interval.at_ns > STALE_NS:
            return None
        return now_ns + interval.high_ns + _drift_ns(now_ns - interval.at_ns)

    def _step(self) -> None:
        """Go on from the exchanges that contradicted the interval."""
        assert self._interval is not None
        newest = self._contradicting[-1]
        self.steps += 1
        self.last_step_ns = newest.middle_ns - self._interval.at(newest.at_ns).middle_ns
        joined: _Interval | None = newest
        for exchange in self._contradicting[:-1]:
            joined = joined and exchange.meet(joined)
        self._interval = joined or newest  # they may contradict each other when the clock stepped among them
        self._contradicting.clear()
