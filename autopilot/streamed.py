"""The reference that is flown: a target that the ground may change at any time, shaped, and kept as promised.

The commands in flight were computed with r some samples ahead (:mod:`autopilot.reference`), so what a :class:`Streamed`
source has once told of a sample is promised, and the next wish counts from the first sample after that. The target is
a number, a rate, or a programmed source (:mod:`autopilot.profile`).
"""

from __future__ import annotations

import math
import sys
from bisect import bisect_right

from autopilot.profile import MAX_GAP, Profile, Source

__all__ = ["MAX_PROMISES", "Streamed"]

MAX_PROMISES = 2 * MAX_GAP
"""A streamed reference remembers so many changes of r; nobody looks back further than one gap."""


class Streamed:
    """The reference that a ground station streams: a target, a rate or another source, shaped, and kept as promised.

    r(k) = r(k - 1) + move, where the move towards the target is at most the rate limit, and the target is cut to
    the limits. r(k) is fixed when it is asked for first, together with all samples before it, and by
    :meth:`constant_until` up to the end that it is given. What is set later holds from the first sample on that
    was not asked for yet. When limits are set that r is outside of, it comes in at the rate limit.

    A gap may make more than ``MAX_GAP`` changes of r due at once; then r goes to the target of the last sample asked
    for, whatever the rate limit, and stays there for the rest of the gap.

    Parameters
    ----------
    source : Source, optional
        The target; zero by default.
    start : int
        The first sample that will ever be asked for.
    value : float
        r(start - 1), from which the first move goes.
    rate_limit : float, optional
        The largest change of r, units per sample; none by default.

    Attributes
    ----------
    limited : int
        Promised samples whose target was cut to the limits.
    skipped : int
        Promised samples that a gap beyond ``MAX_GAP`` put at the target.
    dropped : int
        Changes of r that were forgotten unasked, because there were more than ``MAX_PROMISES``.
    """

    def __init__(
        self, source: Source | None = None, *, start: int = 0, value: float = 0.0, rate_limit: float | None = None
    ) -> None:
        assert math.isfinite(value)
        self.limited = self.skipped = self.dropped = 0
        # the promised r as changes: from _starts[i] on it is _values[i], and from the last on up to _horizon
        self._starts = [start - 1]
        self._values = [value]
        self._horizon = start - 1
        self._first = start
        # so that what is cut to the limits is always finite
        self._low, self._high = -sys.float_info.max, sys.float_info.max
        self._rate: float | None = None
        self.set_source(Profile() if source is None else source, rate_limit)

    @property
    def horizon(self) -> int:
        """The last sample that r is promised for; ``start - 1`` before the first asking."""
        return self._horizon

    def set_target(self, value: float, rate_limit: float | None = None) -> None:
        """Let r move to a value, by at most ``rate_limit`` per sample if given, and stay there."""
        assert math.isfinite(value)
        self.set_source(Profile(((self._horizon + 1, value),)), rate_limit)

    def set_source(self, source: Source, rate_limit: float | None = None) -> None:
        """Let r follow another source, by at most ``rate_limit`` per sample if given."""
        self._source, self._rate = source, None
        self._limit_rate(rate_limit)

    def set_rate(self, units_per_sample: float, rate_limit: float | None = None) -> None:
        """Let r move on from where it is, by so much per sample, as far as the limits let it."""
        assert math.isfinite(units_per_sample)
        self._rate = units_per_sample
        self._limit_rate(rate_limit)

    def set_limits(self, low: float, high: float) -> None:
        """Keep the target within [low, high]."""
        assert -math.inf < low <= high < math.inf
        self._low, self._high = low, high

    def r(self, k: int) -> float:
        """Return r(k), from now on promised; asking for what was forgotten is an error of the caller."""
        self._promise(k)
        return self._values[self._piece(k)]

    def constant_until(self, k: int, end: int) -> int:
        """Return the first sample after k, at most ``end``, at which r differs from r(k); promises r before ``end``."""
        self._promise(end - 1)
        following = self._piece(k) + 1
        return min(self._starts[following], end) if following < len(self._starts) else end

    def forget(self, before: int) -> None:
        """Drop what was promised for the samples before ``before``; they cannot be asked for again."""
        self._first = max(self._first, before)
        if len(self._starts) == 1:
            return
        del self._starts[: (past := max(0, bisect_right(self._starts, before) - 1))], self._values[:past]

    def _piece(self, k: int) -> int:
        """Return the place of the piece of constant r that holds sample k."""
        assert k >= self._first, f"r({k}) was forgotten, r({self._first}) is the first one kept"
        return bisect_right(self._starts, k) - 1

    def _limit_rate(self, rate_limit: float | None) -> None:
        assert rate_limit is None or rate_limit >= 0.0
        self._rate_limit = math.inf if rate_limit is None else rate_limit

    def _promise(self, last: int) -> None:
        """Fix r up to the sample ``last``."""
        changes = 0
        while self._horizon < last:
            k = self._horizon + 1
            if changes < MAX_GAP:
                value, until = self._next(k, last + 1)
            else:
                value, until = self._cut(self._wanted(last)), last + 1
                self.skipped += until - k
            if value != self._values[-1]:
                self._starts.append(k)
                self._values.append(value)
            changes += 1
            self._horizon = until - 1
        if (excess := len(self._starts) - MAX_PROMISES) > 0:
            self.dropped += excess
            self.forget(self._starts[excess])

    def _next(self, k: int, end: int) -> tuple[float, int]:
        """Return r(k), the first sample after the horizon, and until when it stays so, at most ``end``."""
        before, wanted = self._values[-1], self._wanted(k)
        target = self._cut(wanted)
        move = target - before
        value = target if abs(move) <= self._rate_limit else before + math.copysign(self._rate_limit, move)
        if self._rate is not None:
            until = end if value == before else k + 1
        else:  # arrived, or not able to move: the same for as long as the target stays
            settled = end > k + 1 and value in (target, before)
            until = self._source.constant_until(k, end) if settled else k + 1
        if target != wanted:
            self.limited += until - k
        return value, until

    def _wanted(self, k: int) -> float:
        """Return where r shall go from the horizon to sample k."""
        return self._source.r(k) if self._rate is None else self._values[-1] + self._rate * (k - self._horizon)

    def _cut(self, wanted: float) -> float:
        return min(max(wanted, self._low), self._high)
