"""What happens to a link in time, whatever packets it carries: outages, pauses, handovers, fades, slots.

All times are link time, ns from 0. Random ones draw from a stream of their own as time passes, never per packet,
so that two directions with equal seeds, or a flight with more packets, meet the same interruptions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

__all__ = ["MIN_MEAN_NS", "Fading", "Handover", "Slots", "Window"]

MIN_MEAN_NS = 1_000_000
"""The least mean time from one random interruption to the next: each is drawn, also those that no packet meets."""

EPOCH_CYCLES = 10_000
"""Mean cycles after which a random process begins anew, by its long-run law and with a stream of its own.

So what happens is a function of time alone, and to look far ahead, or after a long silence, takes bounded work.
"""


class Window(NamedTuple):
    """A stretch of time by schedule, [start, start + length), once or again and again.

    Attributes
    ----------
    start_ns, length_ns : int
        The first one.
    every_ns : int
        From one start to the next; 0 for once.
    """

    start_ns: int
    length_ns: int
    every_ns: int = 0

    def end_ns(self, link_ns: int) -> int | None:
        """Return when the window that covers this instant ends; None where none does."""
        since_ns = link_ns - self.start_ns
        if since_ns < 0:
            return None
        if self.every_ns:
            since_ns %= self.every_ns
        return link_ns - since_ns + self.length_ns if since_ns < self.length_ns else None


@dataclass(frozen=True, slots=True)
class Handover:
    """A modem that changes its cell: at random instants nothing is sent for a while, and what waited follows at once.

    Interruptions begin as a Poisson process would, counted from the end of the one before.

    Attributes
    ----------
    every_ns : int
        Mean time from the end of one to the beginning of the next, ``MIN_MEAN_NS`` or more.
    length_ns : int
        How long each takes.
    """

    every_ns: int
    length_ns: int

    def __post_init__(self) -> None:
        assert self.every_ns >= MIN_MEAN_NS
        assert self.length_ns >= 0

    def process(self, rng: np.random.Generator) -> Callable[[int], int]:
        """Return a function from an instant to when the link sends next; instants must not fall. It owns ``rng``."""
        cycle_ns = self.every_ns + self.length_ns
        epoch_ns, epoch = EPOCH_CYCLES * cycle_ns, 0
        root, start_ns = rng, round(rng.exponential(self.every_ns))

        def resume_ns(link_ns: int) -> int:
            nonlocal rng, epoch, start_ns
            if link_ns >= (epoch + 1) * epoch_ns:
                epoch = link_ns // epoch_ns
                rng, start_ns = _of_epoch(root, epoch), epoch * epoch_ns
                if rng.random() * cycle_ns < self.length_ns:
                    start_ns -= int(rng.random() * self.length_ns)
                else:
                    start_ns += round(rng.exponential(self.every_ns))
            while link_ns >= start_ns + self.length_ns:
                start_ns += self.length_ns + round(rng.exponential(self.every_ns))
            return start_ns + self.length_ns if link_ns >= start_ns else link_ns

        return resume_ns


@dataclass(frozen=True, slots=True)
class Fading:
    """A radio that is good or bad for exponential times: a Markov chain in continuous time that modulates the delay.

    It begins good. In the long run the share of bad time is B / (G + B), and the autocorrelation of being bad
    exp(-(1/G + 1/B) lag).

    Attributes
    ----------
    good_ns, bad_ns : int
        Mean length of a good and of a bad time, G and B, ``MIN_MEAN_NS`` or more.
    extra_ns : int
        Delay added to a packet that enters while the radio is bad.
    loss : float
        Probability that such a packet is lost, beside any other loss.
    """

    good_ns: int
    bad_ns: int
    extra_ns: int
    loss: float = 0.0

    def __post_init__(self) -> None:
        assert min(self.good_ns, self.bad_ns) >= MIN_MEAN_NS
        assert self.extra_ns >= 0
        assert 0.0 <= self.loss <= 1.0

    def process(self, rng: np.random.Generator) -> Callable[[int], bool]:
        """Return a function from an instant to whether it is bad; instants must not fall. It owns ``rng``."""
        cycle_ns = self.good_ns + self.bad_ns
        epoch_ns, epoch = EPOCH_CYCLES * cycle_ns, 0
        root, is_bad, end_ns = rng, False, round(rng.exponential(self.good_ns))

        def bad_at(link_ns: int) -> bool:
            nonlocal rng, epoch, is_bad, end_ns
            if link_ns >= (epoch + 1) * epoch_ns:
                epoch = link_ns // epoch_ns
                rng = _of_epoch(root, epoch)
                is_bad = bool(rng.random() * cycle_ns < self.bad_ns)
                end_ns = epoch * epoch_ns + round(rng.exponential(self.bad_ns if is_bad else self.good_ns))
            while link_ns >= end_ns:
                is_bad = not is_bad
                end_ns += round(rng.exponential(self.bad_ns if is_bad else self.good_ns))
            return is_bad

        return bad_at


@dataclass(frozen=True, slots=True)
class Slots:
    """A shared channel that opens at the multiples of a period only: TDMA radios, satellites' frames.

    Who waits when it opens is sent then, one behind the other.

    Attributes
    ----------
    period_ns : int
        From one slot to the next, above 0.
    packets : int
        How many packets may begin in one slot; 0 for any number.
    """

    period_ns: int
    packets: int = 0


def _of_epoch(root: np.random.Generator, epoch: int) -> np.random.Generator:
    """Return the stream of an epoch of a process, the same whichever epochs were looked at before."""
    seeds = root.bit_generator.seed_seq
    assert isinstance(seeds, np.random.SeedSequence)
    return np.random.Generator(
        np.random.PCG64(np.random.SeedSequence(seeds.entropy, spawn_key=(*seeds.spawn_key, epoch)))
    )
