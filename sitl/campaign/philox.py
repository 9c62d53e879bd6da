"""Random numbers without a state: Philox 4x32-10, compiled.

A counter-based generator is a bijection of a counter under a key. The key is the campaign's seed, the counter says
which flight, what for and how far: so a flight meets the same whichever block, worker or machine flies it, and what one
feature draws moves nothing of another. The tests hold it to the published vectors.

References
----------
J. K. Salmon, M. A. Moraes, R. O. Dror, D. E. Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC'11, 2011.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

__all__ = [
    "DELAY",
    "DELTA",
    "GUST",
    "HOLD",
    "PARAMETERS",
    "SPLIT",
    "normals",
    "philox",
    "uniform",
    "words",
    "words_inlined",
]

DELAY, HOLD, PARAMETERS, GUST, DELTA, SPLIT = range(6)
"""What numbers are for: the last word of the counter."""

ROUNDS = 10
_M0, _M1 = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
_W0, _W1 = np.uint64(0x9E3779B9), np.uint64(0xBB67AE85)
_LOW, _HALF = np.uint64(0xFFFFFFFF), np.uint64(32)


@njit(inline="always")
def philox(c0, c1, c2, c3, k0, k1):  # type: ignore[no-untyped-def]
    """Return four words of 32 bits from a counter of four under a key of two, each in a uint64."""
    for _ in range(ROUNDS):
        left, right = _M0 * c0, _M1 * c2
        c0, c1, c2, c3 = (right >> _HALF) ^ c1 ^ k0, right & _LOW, (left >> _HALF) ^ c3 ^ k1, left & _LOW
        k0, k1 = (k0 + _W0) & _LOW, (k1 + _W1) & _LOW
    return c0, c1, c2, c3


@njit(inline="always")
def words_inlined(seed, flight, index, purpose):  # type: ignore[no-untyped-def]
    """Return what :func:`words` does, as a part of the loop that asks: several flights at once."""
    key, number = np.uint64(seed), np.uint64(flight)
    return philox(number & _LOW, number >> _HALF, np.uint64(index), np.uint64(purpose), key & _LOW, key >> _HALF)


@njit
def words(seed, flight, index, purpose):  # type: ignore[no-untyped-def]
    """Return the four words of a flight's ``index``-th draw for a purpose."""
    return words_inlined(seed, flight, index, purpose)


@njit
def uniform(word):  # type: ignore[no-untyped-def]
    """Return a number in (0, 1) from a word: the middle of its interval, so that neither end is met."""
    return (np.float64(word) + 0.5) * 2.0**-32


@njit
def normals(first, second):  # type: ignore[no-untyped-def]
    """Return two independent standard normal numbers from two words, after Box and Muller."""
    radius = math.sqrt(-2.0 * math.log(uniform(first)))
    angle = 2.0 * math.pi * uniform(second)
    return radius * math.cos(angle), radius * math.sin(angle)
