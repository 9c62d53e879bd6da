"""The link as a Node: each direction impaired on its own, seeded, every packet accounted for.

A datagram from port ``plant`` goes *up* and leaves by port ``autopilot``; one from ``autopilot`` goes
*down* and leaves by ``plant``. What is under way waits in one heap, in order of exit, then of entry.
At the plant's end there may be a gate, which times the commands: it sees the plant's packets as they enter
and the autopilot's as they would leave.

Conservation, per direction and at every instant::

    sent + duplicated = delivered + lost + refused + gated + queued

``sent`` counts packets, ``duplicated`` the further copies made of them, by chance or by the gate; each copy
then has one fate. ``queued`` includes what waits at the gate.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from heapq import heappop, heappush
from typing import NamedTuple

import numpy as np

from autopilot.link.clock import NS_PER_S
from autopilot.link.node import Datagram, Record
from sitl.link.gate import Gate, GateStep, Miss
from sitl.link.impairment import Fate, Impairment, LinkSpec

__all__ = ["Counters", "RelayNode"]


@dataclass(slots=True)
class Counters:
    """What one direction did.

    Attributes
    ----------
    sent : int
        Packets that entered.
    delivered : int
        Copies that left.
    lost : int
        Copies lost by chance or to a blackout.
    refused : int
        Copies the queue had no room for.
    gated : int
        Copies that the gate swallowed.
    duplicated : int
        Further copies made, whatever became of them.
    reordered : int
        Copies that left after a copy of a packet that had entered later.
    bytes : int
        Payload of the delivered copies.
    """

    sent: int = 0
    delivered: int = 0
    lost: int = 0
    refused: int = 0
    gated: int = 0
    duplicated: int = 0
    reordered: int = 0
    bytes: int = 0


def flip(datagram: bytes, bits: tuple[int, ...]) -> bytes:
    """Return the datagram with these bits flipped; bit 0 is the lowest of the first byte."""
    flipped = bytearray(datagram)
    for bit in bits:
        flipped[bit >> 3] ^= 1 << (bit & 7)
    return bytes(flipped)


class _Direction:
    """The state of one direction."""

    __slots__ = ("counters", "exit_port", "impairment", "newest", "queued", "topic")

    def __init__(self, topic: str, exit_port: str, impairment: Impairment) -> None:
        self.topic = topic
        self.exit_port = exit_port
        self.impairment = impairment
        self.counters = Counters()
        self.queued = 0
        self.newest = 0
        """The number of the latest-entered packet of which a copy has left."""


class _Packet(NamedTuple):
    """One copy of a packet, ordered by exit, then entry; ``sequence`` is unique: no more is compared."""

    exit_ns: int
    sequence: int
    direction: _Direction
    number: int
    copy: int
    entered_ns: int
    fate: Fate
    payload: bytes


class RelayNode:
    """A link between an autopilot and a plant.

    Parameters
    ----------
    up : LinkSpec
        From port ``plant`` to port ``autopilot``.
    down : LinkSpec
        From port ``autopilot`` to port ``plant``.
    seed : int
        Seed of both directions, which draw from independent streams.
    gate : Gate, optional
        Times the commands at the plant's end.
    """

    def __init__(self, up: LinkSpec, down: LinkSpec, seed: int, gate: Gate[_Packet] | None = None) -> None:
        up_rng, down_rng = (
            np.random.Generator(np.random.PCG64(child)) for child in np.random.SeedSequence(seed).spawn(2)
        )
        self._up = _Direction("link/up", "autopilot", Impairment(up, up_rng))
        self._down = _Direction("link/down", "plant", Impairment(down, down_rng))
        self._entries = {"plant": self._up, "autopilot": self._down}
        self._gate = gate
        self._told_misses: dict[Miss, int] = {}
        self._next_misses_ns = 0
        self._heap: list[_Packet] = []
        self._sequence = 0
        self._start_ns: int | None = None
        """When the first packet entered, in either direction: link time 0."""
        self._outgoing: list[Datagram] = []
        self._records: list[Record] = []

    @property
    def counters(self) -> dict[str, Counters]:
        """What each direction (``up``, ``down``) did so far: copies, which do not change later."""
        return {name: replace(direction.counters) for name, direction in (("up", self._up), ("down", self._down))}

    @property
    def queued(self) -> dict[str, int]:
        """How many copies are under way in each direction (``up``, ``down``), at the gate or before it."""
        return {"up": self._up.queued, "down": self._down.queued}

    def receive(self, port: str, datagram: bytes, now_ns: int) -> None:
        """Take a packet into the link. What is due, itself included, leaves at once and in order."""
        direction = self._entries[port]
        if self._start_ns is None:
            self._start_ns = now_ns
        if self._heap:
            self._release(now_ns)
        if self._gate is not None and direction is self._up:
            self._obey(self._gate.sense(datagram), now_ns)
            self._tell_misses(self._gate.misses, now_ns)
        counters = direction.counters
        counters.sent += 1
        number = counters.sent
        copies = direction.impairment.step(len(datagram), now_ns - self._start_ns, direction.queued)
        counters.duplicated += len(copies) - 1
        for copy, (fate, exit_link_ns, flipped) in enumerate(copies):
            exit_ns = self._start_ns + exit_link_ns
            self._sequence += 1
            payload = flip(datagram, flipped) if flipped else datagram
            packet = _Packet(exit_ns, self._sequence, direction, number, copy, now_ns, fate, payload)
            if fate is Fate.DELIVERED or exit_ns > now_ns:
                direction.queued += 1
                heappush(self._heap, packet)
            else:
                self._settle(packet, now_ns)
        self._release(now_ns)

    def tick(self, now_ns: int) -> None:
        """Let out what is due."""
        self._release(now_ns)

    def next_deadline_ns(self) -> int | None:
        """Return when the next packet leaves, or None."""
        return self._heap[0].exit_ns if self._heap else None

    def outgoing(self) -> list[Datagram]:
        """Take away the packets that have left, in order."""
        out, self._outgoing = self._outgoing, []
        return out

    def records(self) -> list[Record]:
        """Take away the records, one per copy, made when it left or was dropped."""
        made, self._records = self._records, []
        return made

    def _release(self, now_ns: int) -> None:
        heap = self._heap
        while heap and heap[0].exit_ns <= now_ns:
            packet = heappop(heap)
            packet.direction.queued -= 1
            self._settle(packet, now_ns)

    def _settle(self, packet: _Packet, now_ns: int) -> None:
        """Let a copy meet its fate at ``now_ns``; a command that would leave goes to the gate instead."""
        if self._gate is not None and packet.direction is self._down and packet.fate is Fate.DELIVERED:
            step = self._gate.command(packet.payload, packet)
            if step is not None:
                self._down.queued += 1  # until the gate lets go of it, which may be at once
                self._obey(step, now_ns)
                return
        self._conclude(packet, now_ns)

    def _obey(self, step: GateStep[_Packet], now_ns: int) -> None:
        """Do what the gate decided. A command that goes to the plant again is a further copy."""
        down = self._down
        for packet, times in step.released:
            if times:
                down.counters.duplicated += 1
            else:
                down.queued -= 1
            self._conclude(packet._replace(copy=packet.copy + times), now_ns)
        for packet in step.dropped:
            down.queued -= 1
            self._conclude(packet._replace(fate=Fate.GATED), now_ns)

    def _tell_misses(self, misses: Mapping[Miss, int], now_ns: int) -> None:
        """Record what the gate could not do as prescribed, when that has changed; at most once a second."""
        if now_ns < self._next_misses_ns or misses == self._told_misses:
            return
        self._next_misses_ns, self._told_misses = now_ns + NS_PER_S, dict(misses)
        data = {"gate": {miss.value: n for miss, n in misses.items()}}
        body = {"kind": "counters", "node": "relay", "text": "relay counters", "data": data}
        self._records.append(Record("events", now_ns, body))

    def _conclude(self, packet: _Packet, now_ns: int) -> None:
        """Count and record a copy whose fate is fulfilled at ``now_ns``; send it if that is delivery."""
        direction = packet.direction
        counters = direction.counters
        size = len(packet.payload)
        delivered = packet.fate is Fate.DELIVERED
        if delivered:
            counters.delivered += 1
            counters.bytes += size
            if packet.number < direction.newest:
                counters.reordered += 1
            else:
                direction.newest = packet.number
            self._outgoing.append((direction.exit_port, packet.payload))
        elif packet.fate is Fate.REFUSED:
            counters.refused += 1
        elif packet.fate is Fate.GATED:
            counters.gated += 1
        else:
            counters.lost += 1
        body = {
            "sent_ns": packet.entered_ns,
            "delivered_ns": now_ns if delivered else None,
            "number": packet.number,
            "size": size,
            "fate": packet.fate.value,
            "copy": packet.copy,
        }
        self._records.append(Record(direction.topic, now_ns, body))
