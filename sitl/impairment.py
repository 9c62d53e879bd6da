"""What a link does to packets: seeded, pure models.

A :class:`LinkSpec` is one direction as data (:mod:`sitl.linkspec` reads it from text), an
:class:`Impairment` is that direction in operation. Its times are *link time*: nanoseconds since the first
packet entered the link in either direction.

One packet meets, in this order:

1. loss: gone, with no airtime used (as netem, which drops before it queues);
2. blackout: a radio that is out neither takes nor delivers, so a packet is dropped if it enters during
   ``[start, start + duration)``, and so is a copy whose exit would fall inside;
3. duplication: a second copy, which then takes its own turn through the rest;
4. room: a copy the queue has no room for is refused, with no airtime used;
5. reordering, as netem: with this probability a copy skips rate, delay and jitter, leaves at once and
   overtakes the queue;
6. rate: a copy waits until the one before is serialised, then takes ``8 size / rate``; size is that of
   the datagram handed in, without headers;
7. delay plus jitter, never below 0 together;
8. ``order=keep``: no copy leaves before one that left the stages above earlier. It wins over
   reordering: such a copy leaves as early as order allows.

Randomness: every feature draws from a stream of its own (loss, duplication; reordering and jitter of the
first copy; the same of the second), one value per packet whatever became of the packets before and
whatever becomes of this one (two for loss in bursts: the move of its state and the loss). The n-th
packet's jitter is therefore the same with loss and without, at 1 % and at 10 %: flights under different
links compare packet by packet.

To add a model, write a class and register it: a jitter with ``@_named(_JITTERS, ...)``, a loss with
``@_named(_LOSSES, ...)``.

References
----------
S. Hemminger, "Network Emulation with NetEm", linux.conf.au 2005; tc-netem(8);
Linux ``net/sched/sch_netem.c``.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

import numpy as np

from autopilot.link.clock import NS_PER_S

__all__ = [
    "JITTERS",
    "LOSSES",
    "Copy",
    "Fate",
    "GammaJitter",
    "GilbertElliott",
    "Impairment",
    "Jitter",
    "LinkSpec",
    "Loss",
    "NormalJitter",
    "UniformJitter",
]

_Model = TypeVar("_Model", bound=type)


def _named(models: dict[str, type[Any]], name: str) -> Callable[[_Model], _Model]:
    """Register a model under its name in a SPEC."""

    def register(model: _Model) -> _Model:
        assert name not in models
        models[name] = model
        return model

    return register


@dataclass(frozen=True, slots=True)
class Jitter(ABC):
    """A distribution of the time added to the delay, with one scale. A model with more reads it itself.

    Attributes
    ----------
    scale_ns : int
        Width, standard deviation or mean, as the model says.
    """

    scale_ns: int

    @abstractmethod
    def sampler(self, rng: np.random.Generator) -> Callable[[], float]:
        """Return a source of jitter in ns. It owns ``rng``; a correlated model keeps its state in it."""


_JITTERS: dict[str, type[Jitter]] = {}

JITTERS: Mapping[str, type[Jitter]] = MappingProxyType(_JITTERS)
"""Jitter models by their name in a SPEC."""


@_named(_JITTERS, "uniform")
@dataclass(frozen=True, slots=True)
class UniformJitter(Jitter):
    """Jitter U[0, W]; the scale is the width W."""

    def sampler(self, rng: np.random.Generator) -> Callable[[], float]:
        """Return a source of U[0, W]."""
        random, width_ns = rng.random, float(self.scale_ns)
        return lambda: width_ns * random()


@_named(_JITTERS, "normal")
@dataclass(frozen=True, slots=True)
class NormalJitter(Jitter):
    """Jitter N(0, S²); the scale is S. A sum of delay and jitter below 0 becomes 0 and raises the mean."""

    def sampler(self, rng: np.random.Generator) -> Callable[[], float]:
        """Return a source of N(0, S²)."""
        normal, sigma_ns = rng.standard_normal, float(self.scale_ns)
        return lambda: sigma_ns * normal()


@_named(_JITTERS, "gamma")
@dataclass(frozen=True, slots=True)
class GammaJitter(Jitter):
    """Jitter Gamma(2, M / 2): two exponential waits in a row; the scale is the mean M."""

    def sampler(self, rng: np.random.Generator) -> Callable[[], float]:
        """Return a source of Gamma(2, M / 2)."""
        gamma, half_ns = rng.standard_gamma, self.scale_ns / 2.0
        return lambda: half_ns * gamma(2.0)


@dataclass(frozen=True, slots=True)
class Loss(ABC):
    """A loss with memory. Its fields are probabilities, in the order of the SPEC; those with a default may stay out."""

    @abstractmethod
    def sampler(self, rng: np.random.Generator) -> Callable[[], bool]:
        """Return a source that says of each packet in turn whether it is lost. It owns ``rng`` and keeps the state."""


_LOSSES: dict[str, type[Loss]] = {}

LOSSES: Mapping[str, type[Loss]] = MappingProxyType(_LOSSES)
"""Loss models by their name in a SPEC; the loss without memory is a plain probability."""


@_named(_LOSSES, "ge")
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


def _memoryless(probability: float, rng: np.random.Generator) -> Callable[[], bool]:
    """Return a source of independent losses. It owns ``rng``."""
    random = rng.random
    return lambda: random() < probability


@dataclass(frozen=True, slots=True)
class LinkSpec:
    """One direction of a link, as data. The default impairs nothing.

    Attributes
    ----------
    delay_ns : int
        Constant delay.
    jitter : Jitter or None
        Distribution of the time added to the delay.
    loss : float or Loss
        Probability that a packet is lost, from 0 to 1, or a model with memory.
    dup, reorder : float
        Probabilities per packet (reorder: per copy), from 0 to 1.
    keep_order : bool
        Whether packets leave in the order in which they entered.
    rate_bps : int or None
        Serialisation rate, bit/s.
    blackouts : tuple of (start_ns, duration_ns)
        When the link is out, in link time; they may overlap.
    """

    delay_ns: int = 0
    jitter: Jitter | None = None
    loss: float | Loss = 0.0
    dup: float = 0.0
    reorder: float = 0.0
    keep_order: bool = False
    rate_bps: int | None = None
    blackouts: tuple[tuple[int, int], ...] = ()

    def __post_init__(self) -> None:
        assert self.delay_ns >= 0
        assert isinstance(self.loss, Loss) or 0.0 <= self.loss <= 1.0
        assert all(0.0 <= probability <= 1.0 for probability in (self.dup, self.reorder))
        assert self.rate_bps is None or self.rate_bps > 0
        assert all(start_ns >= 0 and duration_ns >= 0 for start_ns, duration_ns in self.blackouts)

    def is_out(self, link_ns: int) -> bool:
        """Return whether a blackout covers this instant of link time."""
        return any(start_ns <= link_ns < start_ns + length_ns for start_ns, length_ns in self.blackouts)


class Fate(StrEnum):
    """What became of one copy of a packet."""

    DELIVERED = "delivered"
    LOST = "lost"
    BLACKOUT = "blackout"
    REFUSED = "refused"
    GATED = "gated"
    """Swallowed by the gate, :mod:`sitl.gate`: no sample of the witness asks for it."""


class Copy(NamedTuple):
    """One copy of a packet: its fate, and when (link time, ns) it leaves or is dropped."""

    fate: Fate
    exit_ns: int


class Impairment:
    """One direction of a link in operation: a :class:`LinkSpec` and the state it needs.

    Parameters
    ----------
    spec : LinkSpec
        What the direction does.
    rng : numpy.random.Generator
        Where its six streams are spawned from; none of its own values is drawn.
    """

    def __init__(self, spec: LinkSpec, rng: np.random.Generator) -> None:
        self.spec = spec
        loss, dup, *rest = rng.spawn(6)
        self._lost = spec.loss.sampler(loss) if isinstance(spec.loss, Loss) else _memoryless(spec.loss, loss)
        self._dup = dup.random
        self._reorder = (rest[0].random, rest[1].random)
        jitter = spec.jitter
        self._jitter = None if jitter is None else (jitter.sampler(rest[2]), jitter.sampler(rest[3]))
        self._busy = 0
        """When the serialiser is free, in 1/rate ns of link time: integers, so that no error adds up."""
        self._last_exit_ns = 0

    def schedule(self, size_bytes: int, now_ns: int) -> tuple[int, ...]:
        """Return when the copies of a packet that enters at ``now_ns`` leave; empty if none does."""
        copies = self.step(size_bytes, now_ns)
        return tuple(copy.exit_ns for copy in copies if copy.fate is Fate.DELIVERED)

    def step(self, size_bytes: int, now_ns: int, room: int = 2) -> tuple[Copy, ...]:
        """Take one packet and return its copies with their fates, the original first.

        Parameters
        ----------
        size_bytes : int
            Its size.
        now_ns : int
            When it enters, link time; not before the packet before it.
        room : int
            How many copies the queue can still take.

        Returns
        -------
        tuple of Copy
            One, or two if it was duplicated. A copy in flight that meets a blackout has the instant at
            which it would have left: until then it is in the queue.
        """
        spec = self.spec
        lost = self._lost()
        flights = [self._draw(0)]
        if spec.dup > 0.0:
            twice, further = self._dup() < spec.dup, self._draw(1)
            if twice:
                flights.append(further)
        if lost:
            return (Copy(Fate.LOST, now_ns),)
        if spec.blackouts and spec.is_out(now_ns):
            return (Copy(Fate.BLACKOUT, now_ns),)
        if room > 0 and len(flights) == 1:  # as nearly always
            return (self._launch(size_bytes, now_ns, flights[0]),)
        return tuple(
            self._launch(size_bytes, now_ns, flight_ns) if n < room else Copy(Fate.REFUSED, now_ns)
            for n, flight_ns in enumerate(flights)
        )

    def _draw(self, which: int) -> int | None:
        """Return the delay and jitter of the first (0) or second (1) copy, ns; None: it overtakes."""
        spec = self.spec
        overtakes = spec.reorder > 0.0 and self._reorder[which]() < spec.reorder
        flight_ns = spec.delay_ns
        if self._jitter is not None:
            flight_ns = max(0, flight_ns + round(self._jitter[which]()))
        return None if overtakes else flight_ns

    def _launch(self, size_bytes: int, now_ns: int, flight_ns: int | None) -> Copy:
        """Return the exit of a copy that is neither lost nor refused; occupy the serialiser."""
        spec = self.spec
        exit_ns = now_ns
        if flight_ns is not None:
            if spec.rate_bps is not None:
                self._busy = max(self._busy, now_ns * spec.rate_bps) + 8 * size_bytes * NS_PER_S
                exit_ns = -(-self._busy // spec.rate_bps)
            exit_ns += flight_ns
        if spec.keep_order:
            exit_ns = self._last_exit_ns = max(exit_ns, self._last_exit_ns)
        return Copy(Fate.BLACKOUT if spec.blackouts and spec.is_out(exit_ns) else Fate.DELIVERED, exit_ns)
