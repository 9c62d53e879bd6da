"""Which samples and packets are drawn: all of a short flight; of a long one the extremes, so that none is hidden.

A screen has about two thousand columns. Where more rows than ``MAX_ROWS`` fall on them, the time is cut into buckets
and of each bucket the least and the greatest value of every curve are kept, with its first row: curves through them
look as those through all rows. Of packets some of the others are kept, too, so that a cloud stays a cloud. Losses and
modes are never thinned.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["MAX_PACKETS", "MAX_ROWS", "Run", "compact", "gaps", "kept_packets", "kept_rows", "runs"]

MAX_ROWS = 12_000
"""Rows of one source of curves."""
MAX_PACKETS = 3_000
"""Packets of one direction: each is a disc of its own, which costs a browser more than a point of a curve."""
_FLOAT32_LIMIT = 1e30

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]


def kept_rows(columns: Sequence[Floats], most: int = MAX_ROWS) -> Indices:
    """Return the rows to draw, rising.

    Parameters
    ----------
    columns : sequence of ndarray, each shape (N,)
        The curves; nan is no value.
    most : int
        All rows where there are no more; else about so many at the most.
    """
    count = len(columns[0])
    if count <= most:
        return np.arange(count)
    buckets = max(1, most // (2 * len(columns) + 1))
    edges = np.linspace(0, count, buckets + 1).astype(np.int64)[:-1]
    chosen = [edges, np.array([count - 1])]
    for column in columns:
        chosen += [_least(np.where(np.isnan(values), np.inf, values), edges) for values in (column, -column)]
    return np.unique(np.concatenate(chosen))


def _least(values: Floats, edges: Indices) -> Indices:
    """Return where in each bucket the first least value is."""
    counts = np.diff(np.append(edges, len(values)))
    bucket = np.repeat(np.arange(len(edges)), counts)
    (at,) = np.nonzero(values == np.minimum.reduceat(values, edges)[bucket])
    _, first = np.unique(bucket[at], return_index=True)
    return np.asarray(at[first], dtype=np.int64)


def kept_packets(delay: Floats, most: int = MAX_PACKETS) -> Indices:
    """Return the packets to draw, rising: the fastest and the slowest of each bucket, and every n-th of all.

    Parameters
    ----------
    delay : ndarray, shape (packets,)
        In the order of time.
    most : int
        All where there are no more.
    """
    if len(delay) <= most:
        return np.arange(len(delay))
    every = -(-len(delay) // (most // 2))
    return np.union1d(kept_rows([delay], most // 2), np.arange(0, len(delay), every))


def gaps(samples: Indices) -> Indices:
    """Return the rows after which samples are missing; a curve ends there and begins anew."""
    (last,) = np.nonzero(np.diff(samples) != 1)
    return np.asarray(last, dtype=np.int64)


class Run(NamedTuple):
    """Rows ``first`` to ``last`` in a row, both of them in it."""

    first: int
    last: int


def runs(flags: NDArray[np.bool_]) -> list[Run]:
    """Return the runs of True."""
    edges = np.diff(np.concatenate([[0], flags.astype(np.int8), [0]]))
    return [
        Run(int(first), int(after) - 1)
        for first, after in zip(np.nonzero(edges == 1)[0], np.nonzero(edges == -1)[0], strict=True)
    ]


def compact(values: NDArray[np.generic]) -> NDArray[np.generic]:
    """Return numbers as the page holds them: whole ones in 32 bits, others in float32 unless they are too large."""
    if np.issubdtype(values.dtype, np.integer):
        return values.astype(np.int32)
    finite = values[np.isfinite(values)]
    fits = not finite.size or float(np.abs(finite).max()) < _FLOAT32_LIMIT
    return values.astype(np.float32 if fits else np.float64)
