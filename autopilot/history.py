"""The latest measurements, bounded in number, and which of them say something of the link.

Rows of integers wait in a list that is cheap to append to, and become an array when they are looked at.
"""

from __future__ import annotations

from collections import deque
from itertools import chain

import numpy as np
from numpy.typing import NDArray

__all__ = ["STALL_REQUESTS", "STALL_SHARE", "Window", "read_together", "without_stalls"]

STALL_REQUESTS = 5
"""So many requests in a row that were read together, within"""
STALL_SHARE = 0.1
"""this share of the time between their sending, are a stall of the peer."""


class Window:
    """The latest rows of integers, bounded.

    Parameters
    ----------
    capacity : int
        Rows that are kept.
    columns : int
        Integers of a row.

    Attributes
    ----------
    append : callable
        Takes a row as a tuple; as cheap as can be, since it is called for each sample.
    """

    def __init__(self, capacity: int, columns: int) -> None:
        self._capacity = capacity
        self._rows = np.zeros((0, columns), dtype=np.int64)
        self._new: deque[tuple[int, ...]] = deque(maxlen=capacity)
        self.append = self._new.append

    @property
    def new(self) -> int:
        """Rows since the last call of :meth:`rows`."""
        return len(self._new)

    @property
    def size(self) -> int:
        """Rows kept."""
        rows = len(self._rows) + len(self._new)
        return rows if rows < self._capacity else self._capacity

    def rows(self) -> NDArray[np.int64]:
        """Return all rows, oldest first."""
        if self._new:
            numbers = np.fromiter(chain.from_iterable(self._new), np.int64)  # three times as fast as an array of tuples
            self._rows = np.concatenate([self._rows, numbers.reshape(len(self._new), -1)])[-self._capacity :]
            self._new.clear()
        return self._rows

    def keep(self, last: int) -> None:
        """Drop all but the last rows."""
        self._rows = self.rows()[len(self._rows) - min(last, len(self._rows)) :]


def read_together(sent_apart_ns: int, read_apart_ns: int) -> bool:
    """Return whether two requests in a row were read together although they were sent apart."""
    return abs(read_apart_ns) < STALL_SHARE * sent_apart_ns


def without_stalls(exchanges: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the exchanges, rows of (sent, transit), without those that only waited for the peer to wake up.

    A peer that stood still reads all requests of that time at once: they say how long it stood, not how long the
    way is. Of STALL_REQUESTS or more in a row that were read together only the last, which waited least, is kept.
    """
    if len(exchanges) <= STALL_REQUESTS:
        return exchanges
    sent_ns, read_ns = exchanges[:, 0], exchanges.sum(axis=1)
    together = np.abs(read_ns[1:] - read_ns[:-1]) < STALL_SHARE * (sent_ns[1:] - sent_ns[:-1])
    if np.count_nonzero(together) < STALL_REQUESTS - 1:
        return exchanges
    edges = np.flatnonzero(np.diff(np.concatenate([[0], together.view(np.int8), [0]])))
    keep = np.ones(len(exchanges), dtype=np.bool_)
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        if end - begin + 1 >= STALL_REQUESTS:
            keep[begin:end] = False
    return exchanges[keep]
