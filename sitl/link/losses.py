"""Which packets are lost: with the same probability each, in a correlated way, or in bursts.

To add a model: a class here, registered with ``@_named(...)``; its fields are its arguments in a SPEC.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from bisect import bisect_right
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import accumulate
from types import MappingProxyType
from typing import TypeVar

import numpy as np

from sitl.link.jitters import autoregressive, special_functions

__all__ = ["LOSSES", "CorrelatedLoss", "FourStateLoss", "GilbertElliott", "Loss", "memoryless"]

_Model = TypeVar("_Model", bound=type)


@dataclass(frozen=True, slots=True)
class Loss(ABC):
    """A loss with memory. Its fields are probabilities, in the order of the SPEC; those with a default may stay out.

    Raises
    ------
    ValueError
        When the probabilities do not go together.
    """

    @abstractmethod
    def sampler(self, rng: np.random.Generator) -> Callable[[], bool]:
        """Return a source that says of each packet in turn whether it is lost. It owns ``rng`` and keeps the state."""


_LOSSES: dict[str, type[Loss]] = {}

LOSSES: Mapping[str, type[Loss]] = MappingProxyType(_LOSSES)
"""Loss models by their name in a SPEC; the loss without memory is a plain probability."""


def _named(name: str) -> Callable[[_Model], _Model]:
    """Register a model under its name in a SPEC."""

    def register(model: _Model) -> _Model:
        assert name not in _LOSSES
        _LOSSES[name] = model
        return model

    return register


def memoryless(probability: float, rng: np.random.Generator) -> Callable[[], bool]:
    """Return a source of independent losses. It owns ``rng``."""
    random = rng.random
    return (lambda: random() < probability) if probability > 0.0 else (lambda: False)


@_named("corr")
@dataclass(frozen=True, slots=True)
class CorrelatedLoss(Loss):
    """Loss at a given rate, each packet's fate like that of the one before: a Gaussian copula.

    A packet is lost when z(n) <= Φ⁻¹(p), with z the stationary sequence of :mod:`sitl.link.jitters`. The rate is
    exactly p, and two packets are both lost with the probability Φ₂(Φ⁻¹(p), Φ⁻¹(p); rho^lag). (netem's ``loss random P
    CORR`` compares a blend of uniform numbers with p, which loses ever fewer packets as the correlation grows: computed
    so, ``10% 25%`` loses 1.8 % and ``10% 50%`` 0.1 %.)

    Attributes
    ----------
    p : float
        Probability that a packet is lost.
    rho : float
        Correlation of z from one packet to the next, below 1.
    """

    p: float
    rho: float

    def __post_init__(self) -> None:
        if not (0.0 <= self.p <= 1.0 and 0.0 <= self.rho < 1.0):
            raise ValueError("RHO below 1")

    def sampler(self, rng: np.random.Generator) -> Callable[[], bool]:
        """Return a source of correlated losses."""
        z, threshold = autoregressive(rng, self.rho), float(special_functions().ndtri(self.p))
        return lambda: z() <= threshold


@_named("ge")
@dataclass(frozen=True, slots=True)
class GilbertElliott(Loss):
    """Loss in bursts: two states, each with its loss probability; netem's ``loss gemodel p r 1-h 1-k``.

    As in netem, the first packet finds the good state, and each packet is lost with the probability of the
    state that it finds. The state moves once per packet, also for packets that meet a blackout, and never
    with time. (netem draws the move first and the loss second, but takes the loss probability of the state
    before the move.)

    Attributes
    ----------
    p, r : float
        Probabilities per packet of the moves from good to bad and from bad to good.
    bad, good : float
        Loss probabilities in the two states, 1 - h and 1 - k. Gilbert's model has good = 0, and the
        simple one bad = 1 too.

    References
    ----------
    E. N. Gilbert, "Capacity of a burst-noise channel", Bell Syst. Tech. J. 39(5), 1960; E. O. Elliott,
    "Estimates of error rates for codes on burst-noise channels", Bell Syst. Tech. J. 42(5), 1963;
    tc-netem(8); ``loss_gilb_ell`` in Linux ``net/sched/sch_netem.c``.
    """

    p: float
    r: float
    bad: float = 1.0
    good: float = 0.0

    def __post_init__(self) -> None:
        assert all(0.0 <= probability <= 1.0 for probability in (self.p, self.r, self.bad, self.good))

    @property
    def bad_share(self) -> float:
        """Share of packets that find the bad state in the long run, p / (p + r); 0 for p = 0, which stays in good."""
        return self.p / (self.p + self.r) if self.p > 0.0 else 0.0

    @property
    def loss_rate(self) -> float:
        """Share of packets lost in the long run: the states' loss probabilities, weighted by their shares."""
        return self.bad_share * self.bad + (1.0 - self.bad_share) * self.good

    @property
    def mean_burst(self) -> float:
        """Mean number of packets lost in a row, in the long run; 1 / r for bad = 1, good = 0.

        Bursts end as often as they begin, so it is P(lost) / P(lost, and the next one not). NaN when nothing
        is lost, infinity when a burst never ends.
        """
        if self.loss_rate == 0.0:
            return math.nan
        pass_after_bad = self.r * (1.0 - self.good) + (1.0 - self.r) * (1.0 - self.bad)
        pass_after_good = self.p * (1.0 - self.bad) + (1.0 - self.p) * (1.0 - self.good)
        ends = self.bad_share * self.bad * pass_after_bad + (1.0 - self.bad_share) * self.good * pass_after_good
        return self.loss_rate / ends if ends > 0.0 else math.inf

    def sampler(self, rng: np.random.Generator) -> Callable[[], bool]:
        """Return a source of losses. Each packet takes two values: the state's move, then the loss."""
        random, stay = rng.random, 1.0 - self.r
        is_bad = False

        def is_lost() -> bool:
            nonlocal is_bad
            probability = self.bad if is_bad else self.good
            # low values lead to bad from either state, so that (for p + r <= 1) a larger p or a smaller r,
            # like a larger loss probability, loses the same packets and more
            is_bad = random() < (stay if is_bad else self.p)
            return random() < probability

        return is_lost


@_named("state")
@dataclass(frozen=True, slots=True)
class FourStateLoss(Loss):
    """Loss in bursts with receptions in between: netem's ``loss state p13 p31 p32 p23 p14``.

    Four states: 1 received in a gap between bursts, 2 received within a burst, 3 lost within a burst, 4 lost
    alone, within a gap. The chain begins in 1 and moves once per packet; the packet is lost when it has come to
    3 or 4. From 4 it always returns to 1.

    Attributes
    ----------
    p13 : float
        A burst begins, with a loss.
    p31 : float or None
        It ends; None for 1 - p13, which alone makes the losses independent.
    p32, p23 : float
        A reception within a burst follows a loss, and a loss such a reception.
    p14 : float
        A loss alone.

    References
    ----------
    S. Salsano, F. Ludovici, A. Ordine, D. Giannuzzi, "Definition of a general and intuitive loss model for packet
    networks and its implementation in the Netem module in the Linux kernel", University of Rome Tor Vergata, 2012;
    tc-netem(8); ``loss_4state`` in Linux ``net/sched/sch_netem.c``.
    """

    p13: float
    p31: float | None = None
    p32: float = 0.0
    p23: float = 1.0
    p14: float = 0.0

    def __post_init__(self) -> None:
        given = (self.p13, self.leave, self.p32, self.p23, self.p14)
        if not all(0.0 <= probability <= 1.0 for probability in given):
            raise ValueError("each a probability")
        if self.p31 is None and (self.p32, self.p23, self.p14) != (0.0, 1.0, 0.0):
            raise ValueError("P31 where there is more")  # of Python alone: in a SPEC it comes before the rest
        if self.p13 + self.p14 > 1.0 or self.leave + self.p32 > 1.0:
            raise ValueError("P13 + P14 and P31 + P32 at most 1")

    @property
    def leave(self) -> float:
        """p31, also where it was not given."""
        return 1.0 - self.p13 if self.p31 is None else self.p31

    @property
    def moves(self) -> np.ndarray:
        """The transition matrix, shape (4, 4): row and column 0 are state 1."""
        p13, p31, p32, p23, p14 = self.p13, self.leave, self.p32, self.p23, self.p14
        return np.array(
            [
                [1.0 - p13 - p14, 0.0, p13, p14],
                [0.0, 1.0 - p23, p23, 0.0],
                [p31, p32, 1.0 - p31 - p32, 0.0],
                [1.0, 0.0, 0.0, 0.0],
            ]
        )

    def sampler(self, rng: np.random.Generator) -> Callable[[], bool]:
        """Return a source of losses. Each packet takes one value."""
        random, bounds = rng.random, [_bounds(row) for row in self.moves.tolist()]
        state = 0

        def is_lost() -> bool:
            nonlocal state
            state = bisect_right(bounds[state], random())
            return state >= 2

        return is_lost


def _bounds(probabilities: list[float]) -> list[float]:
    """Return below which value in [0, 1) the chain moves to each state; a sum of 0.999… must not lead anywhere else."""
    last = max(to for to, probability in enumerate(probabilities) if probability > 0.0)
    return [*accumulate(probabilities[:last]), 1.0]
