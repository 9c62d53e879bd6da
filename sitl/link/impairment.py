"""What a link does to packets: seeded, pure models, put together.

A :class:`LinkSpec` is one direction as data (:mod:`sitl.link.spec` reads it from text), an
:class:`Impairment` is that direction in operation. Its times are *link time*: nanoseconds since the first
packet entered the link in either direction.

One packet meets, in this order:

1. loss: by chance, in a bad time of the radio, or by the trace: gone, with no airtime used (as netem, which drops
   before it queues);
2. blackout: a radio that is out neither takes nor delivers, so a packet is dropped if it enters during
   ``[start, start + duration)``, and so is a copy whose exit would fall inside;
3. duplication: a second copy, which then takes its own turn through the rest;
4. room: a copy the queue has no room for is refused, with no airtime used (``limit``: copies under way);
5. corruption: some bits of a copy are flipped;
6. reordering, as netem: with this probability a copy skips the rest but order, leaves at once and overtakes the
   queue; with ``gap=N`` only a copy that comes N - 1 or more after the last one that did so;
7. sending: a copy waits until the one before is serialised, while the link pauses (``hold``, ``handover``), and for a
   slot, whatever ends last, then takes ``8 size / rate``; size is that of the datagram handed in, without headers;
8. delay plus jitter plus what the trace says, never below 0 together, plus the radio's in a bad time;
9. ``order=keep``: no copy leaves before one that left the stages above earlier. It wins over
   reordering: such a copy leaves as early as order allows.

Randomness: every feature draws from a stream of its own (loss; duplication; reordering, jitter and corruption of the
first copy; the same of the second; the radio's times, its losses; handovers), one value per packet whatever became of
the packets before and whatever becomes of this one (two for loss in bursts: the move of its state and the loss). The
n-th packet's jitter is therefore the same with loss and without, at 1 % and at 10 %: flights under different
links compare packet by packet.

To add a model, write a class in :mod:`sitl.link.jitters`, :mod:`sitl.link.losses` or :mod:`sitl.link.interruptions`.

References
----------
S. Hemminger, "Network Emulation with NetEm", linux.conf.au 2005; tc-netem(8);
Linux ``net/sched/sch_netem.c``.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from autopilot.link.clock import NS_PER_S
from sitl.link.interruptions import Fading, Handover, Slots, Window
from sitl.link.jitters import Jitter
from sitl.link.losses import Loss, memoryless
from sitl.link.traces import Trace

__all__ = ["MAX_QUEUED", "Copy", "Corruption", "Fate", "Impairment", "LinkSpec"]

MAX_QUEUED = 10_000
"""The most copies under way in one direction; more are refused (tail drop)."""

MAX_PAUSES = 1000
"""Pauses that a packet waits for in a row: schedules may overlap so that no time is free, and then it is refused."""


class Corruption(NamedTuple):
    """Copies whose bits are flipped.

    Attributes
    ----------
    probability : float
        That a copy is hit, from 0 to 1.
    bits : int
        How many of its bits are flipped, at random places, which may coincide: at least 1.
    """

    probability: float
    bits: int = 1


@dataclass(frozen=True, slots=True)
class LinkSpec:
    """One direction of a link, as data. The default impairs nothing.

    Attributes
    ----------
    delay_ns : int
        Constant delay.
    jitter : Jitter or None
        Distribution of the time added to the delay.
    correlation : float
        Of the jitter, from one packet to the next: rho of :mod:`sitl.link.jitters`, from 0 to below 1.
    loss : float or Loss
        Probability that a packet is lost, from 0 to 1, or a model with memory.
    dup, reorder : float
        Probabilities per packet (reorder: per copy), from 0 to 1.
    gap : int
        The fewest copies from one that overtakes to the next, itself included; 1 for no such limit.
    corruption : Corruption or None
        Flipped bits.
    keep_order : bool
        Whether packets leave in the order in which they entered.
    rate_bps : int or None
        Serialisation rate, bit/s.
    limit : int
        The most copies under way; further ones are refused.
    slots : Slots or None
        When packets may be sent.
    blackouts, holds : tuple of Window
        When the link is out, and when it pauses; they may overlap.
    handover : Handover or None
        Pauses at random.
    fading : Fading or None
        Good and bad times.
    trace : Trace or None
        Delays and losses as recorded.
    """

    delay_ns: int = 0
    jitter: Jitter | None = None
    correlation: float = 0.0
    loss: float | Loss = 0.0
    dup: float = 0.0
    reorder: float = 0.0
    gap: int = 1
    corruption: Corruption | None = None
    keep_order: bool = False
    rate_bps: int | None = None
    limit: int = MAX_QUEUED
    slots: Slots | None = None
    blackouts: tuple[Window, ...] = ()
    holds: tuple[Window, ...] = ()
    handover: Handover | None = None
    fading: Fading | None = None
    trace: Trace | None = None

    def __post_init__(self) -> None:
        assert self.delay_ns >= 0
        assert 0.0 <= self.correlation < 1.0
        assert isinstance(self.loss, Loss) or 0.0 <= self.loss <= 1.0
        assert all(0.0 <= probability <= 1.0 for probability in (self.dup, self.reorder))
        assert self.gap >= 1
        assert self.rate_bps is None or self.rate_bps > 0
        assert 1 <= self.limit <= MAX_QUEUED

    def is_out(self, link_ns: int) -> bool:
        """Return whether a blackout covers this instant of link time."""
        return any(window.end_ns(link_ns) is not None for window in self.blackouts)


class Fate(StrEnum):
    """What became of one copy of a packet."""

    DELIVERED = "delivered"
    LOST = "lost"
    BLACKOUT = "blackout"
    REFUSED = "refused"
    GATED = "gated"
    """Swallowed by the gate, :mod:`sitl.link.gate`: no sample of the witness asks for it."""


class Copy(NamedTuple):
    """One copy of a packet: its fate, when (link time, ns) it leaves or is dropped, which of its bits are flipped."""

    fate: Fate
    exit_ns: int
    flipped: tuple[int, ...] = ()


class _Draw(NamedTuple):
    """What chance has for one copy: whether it would overtake, its delay and jitter, and the bits that are flipped."""

    overtakes: bool
    flight_ns: int
    flipped: tuple[int, ...]


class _CopyStreams:
    """The random streams of the first, or of the second, copies."""

    def __init__(
        self, spec: LinkSpec, reorder: np.random.Generator, jitter: np.random.Generator, corrupt: np.random.Generator
    ) -> None:
        self._spec = spec
        self._reorder = reorder.random
        self._jitter = None if spec.jitter is None else spec.jitter.sampler(jitter, spec.correlation)
        self._corrupt = corrupt

    def draw(self, size_bytes: int) -> _Draw:
        """Draw for one copy."""
        spec = self._spec
        overtakes = spec.reorder > 0.0 and self._reorder() < spec.reorder
        flight_ns = spec.delay_ns
        if self._jitter is not None:
            flight_ns = max(0, flight_ns + round(self._jitter()))
        flipped = () if spec.corruption is None else self._flips(spec.corruption, size_bytes)
        return _Draw(overtakes, flight_ns, flipped)

    def _flips(self, corruption: Corruption, size_bytes: int) -> tuple[int, ...]:
        hit, *places = self._corrupt.random(1 + corruption.bits).tolist()
        if hit >= corruption.probability or not size_bytes:
            return ()
        return tuple(int(place * 8 * size_bytes) for place in places)


class Impairment:
    """One direction of a link in operation: a :class:`LinkSpec` and the state it needs.

    Parameters
    ----------
    spec : LinkSpec
        What the direction does.
    rng : numpy.random.Generator
        Where its streams are spawned from; none of its own values is drawn.
    before : Impairment, optional
        What the direction did until now: its last packets still occupy the serialiser and keep their order.
    """

    def __init__(self, spec: LinkSpec, rng: np.random.Generator, before: Impairment | None = None) -> None:
        self.spec = spec
        loss, dup, *rest = rng.spawn(6)
        *corrupt, fading, fading_loss, handover = rng.spawn(5)
        self._lost = spec.loss.sampler(loss) if isinstance(spec.loss, Loss) else memoryless(spec.loss, loss)
        self._dup = dup.random
        self._copies = tuple(_CopyStreams(spec, rest[n], rest[2 + n], corrupt[n]) for n in range(2))
        self._bad_at = None if spec.fading is None else spec.fading.process(fading)
        self._fading_lost = None if spec.fading is None else memoryless(spec.fading.loss, fading_loss)
        self._resume_ns = None if spec.handover is None else spec.handover.process(handover)
        self._pauses = bool(spec.holds or spec.handover or spec.slots)
        self._number = 0
        """Of the packet, for a trace without times."""
        self._since_overtaking = 0
        """Copies since one overtook, at most gap - 1."""
        self._busy = 0
        """When the serialiser is free, in 1/rate ns of link time: integers, so that no error adds up."""
        self._slot, self._in_slot = -1, 0
        """The latest slot in use, and how many packets have begun in it."""
        self._last_exit_ns = 0
        if before is not None:
            self._busy = before.free_ns * (spec.rate_bps or 1)
            self._last_exit_ns = before._last_exit_ns

    @property
    def free_ns(self) -> int:
        """When the serialiser is free, link time."""
        return -(-self._busy // (self.spec.rate_bps or 1))

    def schedule(self, size_bytes: int, now_ns: int) -> tuple[int, ...]:
        """Return when the copies of a packet that enters at ``now_ns`` leave; empty if none does."""
        copies = self.step(size_bytes, now_ns)
        return tuple(copy.exit_ns for copy in copies if copy.fate is Fate.DELIVERED)

    def step(self, size_bytes: int, now_ns: int, queued: int = 0) -> tuple[Copy, ...]:
        """Take one packet and return its copies with their fates, the original first.

        Parameters
        ----------
        size_bytes : int
            Its size.
        now_ns : int
            When it enters, link time; not before the packet before it.
        queued : int
            How many copies are under way.

        Returns
        -------
        tuple of Copy
            One, or two if it was duplicated. A copy in flight that meets a blackout has the instant at
            which it would have left: until then it is in the queue.
        """
        spec = self.spec
        lost = self._lost()
        extra_ns = self._extra_ns(now_ns)
        draws = [self._copies[0].draw(size_bytes)]
        if spec.dup > 0.0:
            twice, further = self._dup() < spec.dup, self._copies[1].draw(size_bytes)
            if twice:
                draws.append(further)
        if lost or extra_ns is None:
            return (Copy(Fate.LOST, now_ns),)
        if spec.blackouts and spec.is_out(now_ns):
            return (Copy(Fate.BLACKOUT, now_ns),)
        room = spec.limit - queued
        if room > 0 and len(draws) == 1:  # as nearly always
            return (self._launch(size_bytes, now_ns, draws[0], extra_ns),)
        return tuple(
            self._launch(size_bytes, now_ns, draw, extra_ns) if n < room else Copy(Fate.REFUSED, now_ns)
            for n, draw in enumerate(draws)
        )

    def _extra_ns(self, now_ns: int) -> int | None:
        """Return what trace and radio add to the delay of a packet that enters now; None if they lose it."""
        extra_ns: int | None = 0
        if self.spec.trace is not None:
            extra_ns = self.spec.trace.delay_ns(self._number, now_ns)
            self._number += 1
        if self._bad_at is not None and self._fading_lost is not None and self.spec.fading is not None:
            lost = self._fading_lost()
            if self._bad_at(now_ns):
                extra_ns = None if lost or extra_ns is None else extra_ns + self.spec.fading.extra_ns
        return extra_ns

    def _launch(self, size_bytes: int, now_ns: int, draw: _Draw, extra_ns: int) -> Copy:
        """Return the exit of a copy that is neither lost nor refused; occupy the serialiser."""
        spec = self.spec
        exit_ns = now_ns
        if draw.overtakes and self._since_overtaking >= spec.gap - 1:
            self._since_overtaking = 0
        else:
            self._since_overtaking = min(self._since_overtaking + 1, spec.gap - 1)
            if spec.rate_bps is not None or self._pauses:
                sent_ns = self._serialise(size_bytes, now_ns)
                if sent_ns is None:
                    return Copy(Fate.REFUSED, now_ns)
                exit_ns = sent_ns
            exit_ns += draw.flight_ns + extra_ns
        if spec.keep_order:
            exit_ns = self._last_exit_ns = max(exit_ns, self._last_exit_ns)
        out = bool(spec.blackouts) and spec.is_out(exit_ns)
        return Copy(Fate.BLACKOUT if out else Fate.DELIVERED, exit_ns, draw.flipped)

    def _serialise(self, size_bytes: int, now_ns: int) -> int | None:
        """Return when a copy that may be sent from now on has been sent; None when no time ever is free."""
        rate = self.spec.rate_bps or 1
        begin = max(self._busy, now_ns * rate)
        if self._pauses:
            ready_ns = -(-begin // rate)
            begin_ns = self._begin_ns(ready_ns)
            if begin_ns is None:
                return None
            if begin_ns > ready_ns:
                begin = begin_ns * rate
        self._busy = begin + (0 if self.spec.rate_bps is None else 8 * size_bytes * NS_PER_S)
        return self.free_ns

    def _begin_ns(self, ready_ns: int) -> int | None:
        """Return when the link next lets a packet begin: outside every pause, and in a slot with room."""
        spec, begin_ns = self.spec, ready_ns
        for _ in range(MAX_PAUSES):
            waited_ns = begin_ns
            for window in spec.holds:
                waited_ns = window.end_ns(waited_ns) or waited_ns
            if self._resume_ns is not None:
                waited_ns = self._resume_ns(waited_ns)
            if spec.slots is not None:
                waited_ns = self._slot_ns(spec.slots, waited_ns)
            if waited_ns == begin_ns:
                break
            begin_ns = waited_ns
        else:
            return None
        if spec.slots is not None:
            slot = begin_ns // spec.slots.period_ns
            self._in_slot = self._in_slot + 1 if slot == self._slot else 1
            self._slot = slot
        return begin_ns

    def _slot_ns(self, slots: Slots, ready_ns: int) -> int:
        """Return the first slot from then on that has room."""
        slot = -(-ready_ns // slots.period_ns)
        if slots.packets and slot <= self._slot:
            slot = self._slot + (self._in_slot >= slots.packets)
        return slot * slots.period_ns
