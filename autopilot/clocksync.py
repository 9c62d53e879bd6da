"""Clock offset and skew between autopilot and plant from TIMESYNC exchanges, with bounds that hold for any latency.

One exchange sends ``ts1`` (our clock), the peer answers with ``tc1`` (its clock) somewhere between our sending
and our receiving, so with offset = peer - own

    offset(t_received)  >=  tc1 - t_received,      offset(ts1)  <=  tc1 - ts1.

Each exchange is two inequalities that hold whatever the latency and however asymmetric the link. They are used
twice. *Any rates* within the limits: an interval, widened with its age by the largest drift of two clocks, kept
by one recursion. Nothing but a clock that steps can contradict it. *Constant rates*: the straight lines that
satisfy the inequalities of the last two minutes (``envelope.py``); they give the offset much closer, and the skew.

What contradicts is set aside, and counts when it is confirmed. Three exchanges in a row that contradict the
interval, and not each other: a clock has stepped, and all begins anew from them. Three that contradict the lines
alone: a rate has changed, and only the lines begin anew.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import NamedTuple

from autopilot.envelope import GRAIN_NS, MAX_DRIFT_PPB, WINDOW_NS, Fit, Window
from autopilot.link.clock import NS_PER_S

__all__ = ["MAX_DRIFT_PPB", "ClockEstimate", "ClockLine", "ClockStatus", "ClockSync"]

MAX_OUTSTANDING = 64
"""Requests that may wait for an answer; the oldest is forgotten first."""

MIN_EXCHANGES = 5
"""Exchanges before the estimate counts as locked."""

FEW_EXCHANGES = 20
"""So many exchanges are fitted one by one; after that the lines are renewed once per bucket."""

CONFIRMATIONS = 3
"""Exchanges that contradict before what they contradict is given up."""

STALE_NS = 15 * NS_PER_S
"""Without an exchange for so long the estimate is not trusted; at 10 Hz and 90 % loss such a gap is one in months."""


class ClockStatus(StrEnum):
    """What the estimate is worth."""

    UNSYNCHRONISED = "unsynchronised"
    CONVERGING = "converging"
    LOCKED = "locked"
    STEPPED = "stepped"


@dataclass(frozen=True, slots=True)
class ClockEstimate:
    """Offset and skew of the peer's clock against ours, at one own time.

    Attributes
    ----------
    offset_ns : int
        Peer's time minus own time, the best guess.
    bound_ns : int
        The error cannot be larger while both clocks keep their rates (but for ``envelope.WANDER_PPB``).
    status : ClockStatus
        UNSYNCHRONISED: the numbers mean nothing. STEPPED: a clock has stepped a few exchanges ago; the numbers
        are of the new clock, and as loose as while CONVERGING.
    skew_ppb : float
        By how much the peer's clock runs faster than ours, parts per billion, the best guess.
    skew_bound_ppb : float
        Its error cannot be larger, under the same condition.
    """

    offset_ns: int
    bound_ns: int
    status: ClockStatus
    skew_ppb: float = 0.0
    skew_bound_ppb: float = float(2 * MAX_DRIFT_PPB)


UNSYNCHRONISED = ClockEstimate(0, 0, ClockStatus.UNSYNCHRONISED)


@dataclass(frozen=True, slots=True)
class ClockLine:
    """The best guess of the offset as a function of own time.

    Attributes
    ----------
    t_ref_ns : int
        An own time.
    offset_ns : int
        Peer's time minus own time at ``t_ref_ns``.
    skew_ppb : float
        How the offset grows, parts per billion of own time.
    """

    t_ref_ns: int
    offset_ns: int
    skew_ppb: float

    def at(self, t_ns: int) -> int:
        """Return the offset at an own time."""
        return self.offset_ns + round((t_ns - self.t_ref_ns) * self.skew_ppb / NS_PER_S)


def _drift_ns(elapsed_ns: int) -> int:
    """Return by how much two clocks may part in a time, rounded up."""
    return -(-elapsed_ns * MAX_DRIFT_PPB // NS_PER_S)


class _Interval(NamedTuple):
    """low <= offset <= high at own time ``at_ns``, from ``exchanges`` exchanges, for any rates."""

    at_ns: int
    low_ns: int
    high_ns: int
    exchanges: int = 1

    def meet(self, other: _Interval) -> _Interval | None:
        """Return the intersection with a later interval; None when there is none."""
        drift_ns = _drift_ns(other.at_ns - self.at_ns)
        low_ns, high_ns = self.low_ns - drift_ns, self.high_ns + drift_ns
        if other.low_ns > low_ns:
            low_ns = other.low_ns
        if other.high_ns < high_ns:
            high_ns = other.high_ns
        if low_ns > high_ns:
            return None
        return _Interval(other.at_ns, low_ns, high_ns, self.exchanges + other.exchanges)


def _interval_of(sent_ns: int, peer_ns: int, received_ns: int) -> _Interval:
    """Return what an exchange says of the offset when it was received; the clocks have drifted since the sending."""
    low_ns, high_ns = peer_ns - received_ns, peer_ns - sent_ns + _drift_ns(received_ns - sent_ns)
    return _Interval(received_ns, low_ns - GRAIN_NS, high_ns + GRAIN_NS)


_Exchange = tuple[int, int, int]
"""One request and its answer: own time of sending, peer's time, own time of receiving."""


@dataclass(slots=True)
class ClockSync:
    """Estimator of offset and skew, and the requests under way; no I/O, own time passed in, which never runs back.

    Attributes
    ----------
    steps : int
        How often a clock, the peer's or ours, was found to have stepped.
    last_step_ns : int
        By how much the offset stepped last; negative is a jump back of the peer, as after a restart.
    slips : int
        How often no line fitted any more, and the lines began anew: a rate has changed, or a clock stepped a little.
    unmatched : int
        Answers that matched no request of ours: late, replayed or forged.
    contradictions : int
        Answers that contradicted what was known when they came.
    """

    steps: int = 0
    last_step_ns: int = 0
    slips: int = 0
    unmatched: int = 0
    contradictions: int = 0
    _outstanding: dict[int, None] = field(default_factory=dict)
    _interval: _Interval | None = None
    _window: Window = field(default_factory=Window)
    _fit: Fit | None = None
    _contradicting: list[_Exchange] = field(default_factory=list)
    _contradicted: _Interval | None = None
    _doubting: list[_Exchange] = field(default_factory=list)
    _since_step: int = MIN_EXCHANGES

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
        interval = _interval_of(ts1, tc1, now_ns)
        met = interval if self._interval is None else self._interval.meet(interval)
        if met is None:
            self._contradict((ts1, tc1, now_ns), interval)
            return now_ns - ts1
        self._interval = met
        if self._contradicting:
            self._contradicting.clear()
        self._since_step += 1
        fit = self._fit
        if fit is None or now_ns - fit.at_ns > WINDOW_NS or fit.allows(ts1, tc1, now_ns):
            begins = self._window.add(ts1, tc1, now_ns, fit.slope if fit is not None else 0.0)
            if begins or self._window.exchanges < FEW_EXCHANGES:
                self._renew((ts1, tc1, now_ns))
        else:
            self._doubt((ts1, tc1, now_ns))
        return now_ns - ts1

    def estimate(self, now_ns: int) -> ClockEstimate:
        """Return offset and skew at ``now_ns``."""
        interval, fit = self._interval, self._fit
        if interval is None or fit is None or now_ns - interval.at_ns > STALE_NS:
            return UNSYNCHRONISED
        if self._since_step < MIN_EXCHANGES:
            status = ClockStatus.STEPPED
        elif self._window.exchanges < MIN_EXCHANGES:
            status = ClockStatus.CONVERGING
        else:
            status = ClockStatus.LOCKED
        return ClockEstimate(
            fit.guess_ns(now_ns), fit.bound_ns(now_ns), status, fit.slope * NS_PER_S, fit.slope_bound() * NS_PER_S
        )

    def line(self, now_ns: int) -> ClockLine | None:
        """Return the best guess as a function of own time, near ``now_ns``; None before the first exchange."""
        fit = self._fit
        return None if fit is None else ClockLine(now_ns, fit.guess_ns(now_ns), fit.slope * NS_PER_S)

    def peer_at_most_ns(self, now_ns: int) -> int | None:
        """Return what the peer's clock shows at the most, for any rates; None while not locked."""
        interval = self._interval
        if interval is None:
            return None
        at_ns, _, high_ns, exchanges = interval
        elapsed_ns = now_ns - at_ns
        if exchanges < MIN_EXCHANGES or elapsed_ns > STALE_NS:
            return None
        return now_ns + high_ns - (-elapsed_ns * MAX_DRIFT_PPB // NS_PER_S)

    def _renew(self, newest: _Exchange) -> None:
        """Fit the lines again; when none fits, begin anew from the newest exchange, which always has one."""
        fit = self._window.fit(newest[-1])
        if fit is None:
            self.slips += 1
            self._window.clear()
            self._window.add(*newest, 0.0)
            fit = self._window.fit(newest[-1])
        assert fit is not None
        self._fit = fit

    def _begin(self, exchanges: list[_Exchange]) -> None:
        """Begin the lines anew from a few exchanges."""
        self._window.clear()
        for exchange in exchanges:
            self._window.add(*exchange, 0.0)
        self._doubting = []
        self._renew(exchanges[-1])

    def _doubt(self, exchange: _Exchange) -> None:
        """Set aside an exchange that no line allows; with the third within a window the lines are given up."""
        self.contradictions += 1
        oldest_ns = exchange[-1] - WINDOW_NS
        self._doubting = [earlier for earlier in self._doubting if earlier[-1] >= oldest_ns]
        self._doubting.append(exchange)
        if len(self._doubting) >= CONFIRMATIONS:
            self.slips += 1
            self._begin(self._doubting)

    def _contradict(self, exchange: _Exchange, interval: _Interval) -> None:
        """Set aside an exchange that no rates allow; the third in a row, none against another, is a step."""
        self.contradictions += 1
        joined = self._contradicted.meet(interval) if self._contradicting and self._contradicted else None
        if joined is None:
            self._contradicting.clear()
        self._contradicted = joined or interval
        self._contradicting.append(exchange)
        if len(self._contradicting) >= CONFIRMATIONS:
            self._step()

    def _step(self) -> None:
        """Go on from the exchanges that contradicted the interval."""
        assert self._fit is not None
        now_ns = self._contradicting[-1][-1]
        before_ns = self._fit.guess_ns(now_ns)
        self._interval = self._contradicted
        self._begin(self._contradicting)
        self._contradicting.clear()
        self.steps += 1
        self.last_step_ns = self._fit.guess_ns(now_ns) - before_ns
        self._since_step = 0
