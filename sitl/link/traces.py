"""Recorded links: delays and losses from a file, to be met again packet by packet or instant by instant.

Packets that entered at one instant each have an entry of their own, with the same time. So many that enter at one
instant again take them in turn, and those beyond them the last; a packet that enters alone takes the last, too.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
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
        When each entry was recorded, from 0, never falling; a packet takes the last entry that is not after it, or its
        own of several of its instant; one before all of them takes the first. None: the n-th packet takes the n-th
        entry.
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
            assert self.times_ns[0] >= 0
            assert self.length_ns > self.times_ns[-1]

    def delay_ns(self, number: int, link_ns: int, before: int = 0) -> int | None:
        """Return the delay of a packet; None for a loss.

        Parameters
        ----------
        number : int
            Of the packet, from 0.
        link_ns : int
            When it enters.
        before : int
            How many packets have entered at this instant before it.
        """
        times_ns = self.times_ns
        if times_ns is None:
            return self.delays_ns[number % len(self.delays_ns)]
        at_ns = link_ns % self.length_ns
        last = max(0, bisect_right(times_ns, at_ns) - 1)
        if times_ns[last] == at_ns:
            last = min(last, bisect_left(times_ns, at_ns) + before)
        return self.delays_ns[last]
