"""What a link does to packets: seeded, pure models, put together.

A :class:`LinkSpec` is one direction as data (:mod:`sitl.link.spec` reads it from text), an
:class:`Impairment` is that direction in operation. Its times are *link time*: nanoseconds since the first
packet entered the link in either direction.

One packet meets, in this order:

1. loss: by chance, in a bad time of the radio, or by the trace: gone, with no airtime used (as netem, which drops
   before it queues);
2. blackout: a radio that is out neither takes nor delivers, so a packet is dropped if it enters during
   ``[start, start + length)``, and so is a copy whose exit would fall inside;
3. duplication: a second copy, which then takes its own turn through the rest;
4. room: a copy the queue has no room for is refused, with no airtime used (``limit``: copies under way);
5. corruption: some bits of a copy are flipped;
6. reordering, as netem: with this probability a copy skips the rest but order, leaves at once and overtakes the
   queue; with ``gap=N`` only after N - 1 copies that did not;
7. sending: a copy waits until the one before is serialised, while the link pauses (``hold``, ``handover``), and for a
   slot, whatever ends last, then takes ``8 size / rate``; size is that of the datagram handed in, without headers.
   What waits when a slot opens goes back to back, as many as the slot takes; who comes later, or meets a pause,
   waits for the next slot, and one that opens while the link still sends is missed;
8. delay plus jitter plus what the trace says plus the radio's in a bad time, never below 0 together;
9. ``order=keep``: no copy leaves before one that left the stages above earlier. It wins over
   reordering: such a copy leaves as early as order allows.

Randomness: every feature draws from a stream of its own (loss; duplication; reordering, jitter and corruption of the
first copy; the same of the second; the radio's times, its losses; handovers), one value per packet whatever became of
the packets before and whatever becomes of this one (two for loss in bursts: the move of its state and the loss). The
n-th packet's jitter is therefore the same with loss and without, at 1 % and at 10 %: flights under different
links compare packet by packet.

Otherwise than netem, on purpose:

- A lost packet is lost with its duplicate: one event in the air. netem draws both and lets one copy through if both
  happen; the clone it enqueues then meets loss anew.
- Jitter and loss correlate by models that keep their distribution and rate; ``get_crandom``, by which netem correlates
  duplication, reordering and corruption too, keeps neither (:mod:`sitl.link.jitters`, ``CorrelatedLoss``).
- The rate comes before the delay: jitter may reorder what was serialised. In netem a packet is sent after the last one
  in the queue has left, so that a rate keeps the order whatever the jitter. With a constant delay both are the same.
- Bits are flipped in the datagram's payload, and it arrives, as from a serial radio that checks nothing. netem flips
  one bit anywhere in the packet, which UDP's checksum then refuses; here that is ``loss``.
- Slots are the multiples of a period, and precede the delay. In netem they follow it, and the next one is counted from
  when the budget of the last was used up.

To add a model, write a class in :mod:`sitl.link.jitters`, :mod:`sitl.link.losses` or :mod:`sitl.link.interruptions`.

References
----------
S. Hemminger, "Network Emulation with NetEm", linux.conf.au 2005; tc-netem(8);
Linux ``net/sched/sch_netem.c``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple, TypeAlias

import numpy as np

from autopilot.link.clock import NS_PER_S
from sitl.link.interruptions import Fading, Handover, Slots, Window
from sitl.link.jitters import Jitter
from sitl.link.losses import Loss, memoryless
from sitl.link.traces import Trace

__all__ = ["MAX_QUEUED", "Copy", "Corruption", "Fate", "Impairment", "LinkSpec"]

MAX_QUEUED = 10_000
"""The most copies under way in one direction, and again in each of its rules; more are refused (tail drop)."""

MAX_PAUSES = 100
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
        Of the jitter, from one packet to the next: rho of :mod:`sitl.link.jitters`, from 0 to below 1; 0 without
        jitter.
    loss : float or Loss
        Probability that a packet is lost, from 0 to 1, or a model with memory.
    dup, reorder : float
        Probabilities per packet (reorder: per copy), from 0 to 1.
    gap : int
        The fewest copies from one that overtakes to the next, itself included, and to the first one; 1 for no limit.
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
        assert self.correlation == 0.0 or self.jitter is not None
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


_DELIVERED = Fate.DELIVERED  # asked for with each packet, and found slowly in its enumeration

_Draw: TypeAlias = tuple[bool, int, tuple[int, ...]]
"""What chance has for one copy: whether it would overtake, its delay and jitter (ns), and the bits that are flipped.

A plain tuple, since there is one per packet.
"""


def _draws(
    spec: LinkSpec, reorder: np.random.Generator, jitter: np.random.Generator, corrupt: np.random.Generator
) -> Callable[[int], _Draw]:
    """Return a source of draws for the first, or for the second, copies of packets of the sizes that it is told."""
    overtaking, random = spec.reorder, reorder.random
    delay_ns, corruption = spec.delay_ns, spec.corruption
    further_ns = None if spec.jitter is None else spec.jitter.sampler(jitter, spec.correlation)

    def draw(size_bytes: int) -> _Draw:
        overtakes = overtaking > 0.0 and random() < overtaking
        flight_ns = delay_ns if further_ns is None else delay_ns + round(further_ns())
        return overtakes, flight_ns, () if corruption is None else _flips(corruption, corrupt, size_bytes)

    return draw


def _losses(loss: float | Loss, rng: np.random.Generator) -> Callable[[], bool]:
    """Return a source that says of each packet whether it is lost."""
    return loss.sampler(rng) if isinstance(loss, Loss) else memoryless(loss, rng)


def _flips(corruption: Corruption, rng: np.random.Generator, size_bytes: int) -> tuple[int, ...]:
    """Return which bits of one copy are flipped."""
    hit, *places = rng.random(1 + corruption.bits).tolist()
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
        What the direction did until now: its last packets still occupy the serialiser, if there still is one, and with
        ``order=keep`` none leaves before them. The loss, the trace, the radio's times, handovers and slots go on as
        they would have, each where its part of the spec is the same; the rest begins anew.
    """

    def __init__(self, spec: LinkSpec, rng: np.random.Generator, before: Impairment | None = None) -> None:
        self.spec = spec
        loss, dup, *rest = rng.spawn(6)
        *corrupt, fading, fading_loss, handover = rng.spawn(5)
        self._lost = None if spec.loss == 0.0 else _losses(spec.loss, loss)
        self._dup = dup.random if spec.dup > 0.0 else None
        self._first, self._second = (_draws(spec, rest[n], rest[2 + n], corrupt[n]) for n in range(2))
        self._bad_at = None if spec.fading is None else spec.fading.process(fading)
        self._fading_lost = None if spec.fading is None else memoryless(spec.fading.loss, fading_loss)
        self._resume_ns = None if spec.handover is None else spec.handover.process(handover)
        self._adds = spec.trace is not None or spec.fading is not None
        self._pauses = bool(spec.holds or spec.handover or spec.slots)
        self._queues = self._pauses or spec.rate_bps is not None
        self._blackouts, self._limit, self._keep_order = spec.blackouts, spec.limit, spec.keep_order
        self._apart = spec.gap - 1
        self._number = 0
        """Of the packet, for a trace without times."""
        self._instant_ns, self._together = -1, 0
        """When the latest packet entered, and how many did at that instant, for a trace with times."""
        self._since_overtaking = 0
        """Copies since one overtook, at most ``_apart``."""
        self._busy = 0
        """When the serialiser is free, in 1/rate ns of link time: integers, so that no error adds up."""
        self._slot, self._in_slot = -1, 0
        """The latest slot in use, and how many packets have begun in it."""
        self._last_exit_ns = 0
        """The latest instant at which a copy leaves."""
        if before is not None:
            self._follow(before)

    def _follow(self, before: Impairment) -> None:
        """Take over from what the direction did until now."""
        spec, last = self.spec, before.spec
        self._busy = before.free_ns * (spec.rate_bps or 1)
        self._last_exit_ns = before._last_exit_ns
        if spec.slots == last.slots:
            self._slot, self._in_slot = before._slot, before._in_slot
        if spec.loss == last.loss:
            self._lost = before._lost
        if spec.trace == last.trace:
            self._number = before._number
            self._instant_ns, self._together = before._instant_ns, before._together
        if spec.fading == last.fading:
            self._bad_at, self._fading_lost = before._bad_at, before._fading_lost
        if spec.handover == last.handover:
            self._resume_ns = before._resume_ns

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
        lost = self._lost is not None and self._lost()
        draw = self._first(size_bytes)
        further: _Draw | None = None
        if self._dup is not None:
            twice, second = self._dup() < self.spec.dup, self._second(size_bytes)
            further = second if twice else None
        extra_ns = self._extra_ns(now_ns) if self._adds else 0
        if lost or extra_ns is None:
            return (Copy(Fate.LOST, now_ns),)
        if self._blackouts and self.spec.is_out(now_ns):
            return (Copy(Fate.BLACKOUT, now_ns),)
        room = self._limit - queued
        if room > 0 and further is None:  # as nearly always
            return (self._launch(size_bytes, now_ns, draw, extra_ns),)
        return tuple(
            self._launch(size_bytes, now_ns, each, extra_ns) if n < room else Copy(Fate.REFUSED, now_ns)
            for n, each in enumerate((draw,) if further is None else (draw, further))
        )

    def _extra_ns(self, now_ns: int) -> int | None:
        """Return what trace and radio add to the delay of a packet that enters now; None if they lose it."""
        extra_ns: int | None = 0
        if self.spec.trace is not None:
            if now_ns != self._instant_ns:
                self._instant_ns, self._together = now_ns, 0
            extra_ns = self.spec.trace.delay_ns(self._number, now_ns, self._together)
            self._number += 1
            self._together += 1
        if self._bad_at is not None and self._fading_lost is not None and self.spec.fading is not None:
            lost = self._fading_lost()
            if self._bad_at(now_ns):
                extra_ns = None if lost or extra_ns is None else extra_ns + self.spec.fading.extra_ns
        return extra_ns

    def _launch(self, size_bytes: int, now_ns: int, draw: _Draw, extra_ns: int) -> Copy:
        """Return the exit of a copy that is neither lost nor refused; occupy the serialiser."""
        overtakes, flight_ns, flipped = draw
        exit_ns = now_ns
        if overtakes and self._since_overtaking >= self._apart:
            self._since_overtaking = 0
        else:
            if self._since_overtaking < self._apart:
                self._since_overtaking += 1
            if self._queues:
                sent_ns = self._serialise(size_bytes, now_ns)
                if sent_ns is None:
                    return Copy(Fate.REFUSED, now_ns)
                exit_ns = sent_ns
            flight_ns += extra_ns
            if flight_ns > 0:
                exit_ns += flight_ns
        if exit_ns >= self._last_exit_ns:
            self._last_exit_ns = exit_ns
        elif self._keep_order:
            exit_ns = self._last_exit_ns
        out = self._blackouts and self.spec.is_out(exit_ns)
        return Copy(Fate.BLACKOUT if out else _DELIVERED, exit_ns, flipped)

    def _serialise(self, size_bytes: int, now_ns: int) -> int | None:
        """Return when a copy that may be sent from now on has been sent; None when no time ever is free."""
        rate = self.spec.rate_bps or 1
        begin = max(self._busy, now_ns * rate)
        if self._pauses:
            ready_ns = -(-begin // rate)
            begin_ns = self._begin_ns(now_ns, ready_ns)
            if begin_ns is None:
                return None
            if begin_ns > ready_ns:
                begin = begin_ns * rate
        self._busy = begin + (0 if self.spec.rate_bps is None else 8 * size_bytes * NS_PER_S)
        return self.free_ns

    def _begin_ns(self, now_ns: int, ready_ns: int) -> int | None:
        """Return when the link next lets a packet begin: outside every pause, and in a slot with room.

        ``now_ns`` is when it entered, ``ready_ns`` when the packet before is through.
        """
        spec, slots, begin_ns = self.spec, self.spec.slots, ready_ns
        follows = slots is not None and now_ns <= self._slot * slots.period_ns and self._has_room(slots)
        for _ in range(MAX_PAUSES):
            waited_ns = begin_ns
            for window in spec.holds:
                waited_ns = window.end_ns(waited_ns) or waited_ns
            if self._resume_ns is not None:
                waited_ns = self._resume_ns(waited_ns)
            if slots is not None and not (follows and waited_ns == ready_ns):
                waited_ns = self._slot_ns(slots, waited_ns)
            if waited_ns == begin_ns:
                break
            begin_ns = waited_ns
        else:
            return None
        if slots is not None:
            slot, since_ns = divmod(begin_ns, slots.period_ns)
            if since_ns == 0 and slot > self._slot:
                self._slot, self._in_slot = slot, 0
            self._in_slot += 1
        return begin_ns

    def _has_room(self, slots: Slots) -> bool:
        """Return whether one more packet may begin in the latest slot in use."""
        return not slots.packets or self._in_slot < slots.packets

    def _slot_ns(self, slots: Slots, ready_ns: int) -> int:
        """Return when the first slot from then on opens that has room."""
        slot = -(-ready_ns // slots.period_ns)
        if slot == self._slot and not self._has_room(slots):
            slot += 1
        return slot * slots.period_ns
