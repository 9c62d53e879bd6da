"""Small changes to bytes, and a plain loop of them: the engine of last resort, and hypothesis' way around a sample."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

MAX_BYTES = 1 << 14


class Edit(NamedTuple):
    """One change at a place: ``at`` is taken modulo the length, ``span`` bytes are concerned, ``insert`` goes there."""

    kind: int
    at: int
    span: int
    insert: bytes


KINDS = 5
"""Overwrite, insert, delete, repeat, flip a bit."""


def edited(data: bytes, edits: Sequence[Edit]) -> bytes:
    """Return the data with some changes made, one after the other."""
    for kind, where, span, insert in edits:
        at = where % (len(data) + 1)
        match kind % KINDS:
            case 0:
                data = data[:at] + insert + data[at + len(insert) :]
            case 1:
                data = data[:at] + insert + data[at:]
            case 2:
                data = data[:at] + data[at + span :]
            case 3:
                data = data[:at] + data[at : at + span] * 2 + data[at + span :]
            case _ if at < len(data):
                data = data[:at] + bytes((data[at] ^ 1 << (span % 8),)) + data[at + 1 :]
    return data[:MAX_BYTES]


def mutated(rng: np.random.Generator, seeds: Sequence[bytes], words: Sequence[bytes]) -> bytes:
    """Return a sample with one to six changes, some of them by words that the target knows, or by a part of another."""
    edits = []
    for _ in range(int(rng.integers(1, 7))):
        match int(rng.integers(4)):
            case 0 if words:
                insert = words[rng.integers(len(words))]
            case 1:
                other = seeds[rng.integers(len(seeds))]
                start = int(rng.integers(len(other) + 1))
                insert = other[start : start + int(rng.integers(1, 40))]
            case _:
                insert = rng.bytes(int(rng.integers(1, 5)))
        edits.append(Edit(int(rng.integers(KINDS)), int(rng.integers(MAX_BYTES)), int(rng.geometric(0.1)), insert))
    return edited(seeds[rng.integers(len(seeds))], edits)


def loop(
    run: Callable[[bytes], object],
    seeds: Sequence[bytes],
    words: Sequence[bytes],
    until: Callable[[], bool],
    seed: int = 1,
) -> tuple[int, bytes | None, Exception | None]:
    """Run a target on changed samples until it is time, or one fails: return how many ran, and the failing one."""
    rng = np.random.default_rng(seed)
    ran = 0
    while not until():
        data = mutated(rng, seeds, words)
        ran += 1
        try:
            run(data)
        except Exception as error:
            return ran, data, error
    return ran, None, None
