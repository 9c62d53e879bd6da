"""How far something was from what was asked for: a histogram of times that never grows.

Buckets are as wide as their place is large: 32 to each power of two, and one nanosecond below 64 ns. A quantile
is told as the largest value of the bucket that holds it, and never beyond the largest value seen: it is not below the
true one, and at most 1/32 above.
"""

from __future__ import annotations

import math

__all__ = ["MAX_HELD_NS", "Histogram"]

_FINE_BITS = 5
_FINE = 1 << _FINE_BITS

MAX_HELD_NS = (1 << 50) - 1
"""Thirteen days: what is larger counts as this, but for ``largest_ns``."""

_BUCKETS = (MAX_HELD_NS.bit_length() - _FINE_BITS + 1) * _FINE


class Histogram:
    """Times in ns, from 0 on.

    Attributes
    ----------
    count : int
        How many.
    largest_ns : int
        The largest of them; 0 without any.
    """

    __slots__ = ("_counts", "count", "largest_ns")

    def __init__(self) -> None:
        self._counts = [0] * _BUCKETS
        self.count = 0
        self.largest_ns = 0

    def add(self, value_ns: int) -> None:
        """Take one value."""
        self.count += 1
        if value_ns > self.largest_ns:
            self.largest_ns = value_ns
        if value_ns > MAX_HELD_NS:
            value_ns = MAX_HELD_NS
        shift = value_ns.bit_length() - _FINE_BITS - 1
        self._counts[value_ns if shift <= 0 else (shift << _FINE_BITS) + (value_ns >> shift)] += 1

    def quantile(self, q: float) -> int | None:
        """Return the least value that this part of all are not above, as the head of the module says; None of none."""
        assert 0.0 <= q <= 1.0
        if not self.count:
            return None
        rank = max(1, math.ceil(q * self.count))
        below = 0
        for bucket, count in enumerate(self._counts):
            below += count
            if below >= rank:
                return min(_largest_of(bucket), self.largest_ns)
        raise AssertionError("more were counted than are held")

    def summary(self) -> dict[str, int | None] | None:
        """Return median, 99th percentile and maximum, ns; None when there is nothing to tell."""
        if not self.count:
            return None
        return {"p50": self.quantile(0.5), "p99": self.quantile(0.99), "max": self.largest_ns}


def _largest_of(bucket: int) -> int:
    shift = max(0, (bucket >> _FINE_BITS) - 1)
    return ((bucket - (shift << _FINE_BITS) + 1) << shift) - 1
