"""Recorded links: delays and losses from a file, to be met again packet by packet or instant by instant."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

__all__ = ["MAX_ENTRIES", "Trace"]

MAX_ENTRIES = 1_000_000
"""Entries of one trace; a longer file is refused."""


@dataclass(frozen=True, slots=True)
class Trace:
    """A recorded link, which begins anew at its end.

    Attributes
    ----------
    source : str
        What it was read from, as in a SPEC: a file, with ``#up`` or ``#down`` where the file holds both directions.
    delays_ns : tuple of (int or None)
        The delay of each entry, None for a loss; at least one entry.
    times_ns : tuple of int, or None
        When each entry was recorded, from 0, never falling; a packet takes the last entry that is not after it. None:
        the n-th packet takes the n-th entry.
    length_ns : int
        After so long it begins anew, above the last time; of no meaning without times.
    """

    source: str
    delays_ns: tuple[int | None, ...]
    times_ns: tuple[int, ...] | None = None
    length_ns: int = 0

    def __post_init__(self) -> None:
        assert 0 < len(self.delays_ns) <= MAX_ENTRIES
        if self.times_ns is not None:
            assert len(self.times_ns) == len(self.delays_ns)
            assert self.times_ns[0] == 0
            assert self.length_ns > self.times_ns[-1]

    def delay_ns(self, number: int, link_ns: int) -> int | None:
        """Return the delay of the packet with this number (from 0) that enters at this time; None for a loss."""
        if self.times_ns is None:
            return self.delays_ns[number % len(self.delays_ns)]
        return self.delays_ns[bisect_right(self.times_ns, link_ns % self.length_ns) - 1]
