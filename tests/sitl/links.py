"""One direction of a link for tests: a SPEC in operation, and how long packets spend in it."""

from __future__ import annotations

import numpy as np

from sitl.link.impairment import Impairment
from sitl.link.spec import parse_spec

MS = 1_000_000
S = 1_000_000_000
SAMPLES = 20_000


def impairment(text: str, seed: int = 1) -> Impairment:
    return Impairment(parse_spec(text), np.random.default_rng(seed))


def flights_ns(text: str, seed: int = 1, samples: int = SAMPLES) -> np.ndarray:
    """Time in the link of each packet, one a second."""
    link = impairment(text, seed)
    return np.array([link.schedule(100, n * S)[0] - n * S for n in range(samples)], dtype=float)
