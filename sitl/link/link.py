"""A link: two directions, each impaired on its own, seeded, every packet accounted for.

A packet from the plant goes *up*, one from the autopilot goes *down*. What is under way waits in one heap, in order of
exit, then of entry. At the plant's end there may be a gate, which times the commands: it sees the plant's packets as
they enter and the autopilot's as they would leave.

Conservation, per direction and at every instant, and likewise per rule::

    sent + duplicated = delivered + lost + refused + gated + queued

``sent`` counts packets, ``duplicated`` the further copies made of them, by chance or by the gate; each copy
then has one fate. ``queued`` includes what waits at the gate.

Inside, time is *link time*, from 0 when the first packet enters. A packet may be handed in with a time that has passed
already, that at which the kernel got it (``stamped``): it entered then, but leaves when the node is told that it is
time, so that what is recorded is what was. The times of one direction never fall; where the node's do, its clock has
been set back, and link time goes on from where it was.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from heapq import heappop, heappush
from typing import Any, TypeAlias

from autopilot.link.clock import NS_PER_S
from autopilot.link.node import Datagram, Record
from gains.table import InputError
from sitl.link.changes import MAX_CHANGES, Change, format_change
from sitl.link.direction import DEFAULT_NAME, Direction, Lane, LinkConfig
from sitl.link.gate import Gate, GateStep
from sitl.link.impairment import Copy, Fate, LinkSpec
from sitl.link.rules import Way
from sitl.link.spec import format_spec

__all__ = ["Link", "Outbox"]

MAX_AT_ONCE = 16
"""Copies that one tick of a stamped link lets out: the next ones leave with the next tick, and are told its time."""

_LONG_AGO_NS = -(1 << 62)


@dataclass(slots=True)
class Outbox:
    """What the links of one node have made, and how much of it they may still record.

    Attributes
    ----------
    log_rate : int
        The most records of packets in one second.
    outgoing : list of Datagram
        What has left.
    records : list of Record
        What is to be recorded.
    """

    log_rate: int
    outgoing: list[Datagram]
    records: list[Record]
    _second_ns: int = _LONG_AGO_NS
    _logged: int = 0

    def may_log(self, now_ns: int) -> bool:
        """Return whether this second, which begins with its first packet, has room for one more, and take it."""
        if not 0 <= now_ns - self._second_ns < NS_PER_S:
            self._second_ns, self._logged = now_ns, 0
        if self._logged >= self.log_rate:
            return False
        self._logged += 1
        return True


_Packet: TypeAlias = tuple[int, int, Direction, Lane, int, int, int, Fate, tuple[int, ...], bytes]
"""One copy of a packet: when it leaves, sequence, direction, lane, number of the packet, of the copy, when it entered,
fate, flipped bits, payload; times are link time.

Ordered by exit, then entry; ``sequence`` is unique: no more is compared. A plain tuple, which is unpacked where it is
looked at, since there is one per packet: with names it would take several times as long to make and to read.
"""

_DELIVERED = Fate.DELIVERED  # asked for with each packet, and found slowly in its enumeration


class Link:
    """A link between an autopilot and a plant.

    Parameters
    ----------
    config : LinkConfig
        What it does.
    outbox : Outbox
        Takes what leaves and what is recorded.
    gate : Gate, optional
        Times the commands at the plant's end.
    prefix : str
        Of its ports and of its directions in topics: ``NAME/`` where there are several links.
    stamped : bool
        Whether packets may come with times that have passed; nothing then leaves but by :meth:`tick`.

    Attributes
    ----------
    clock_steps : int
        How often the node's clock was found to have been set back.
    """

    def __init__(
        self,
        config: LinkConfig,
        outbox: Outbox,
        gate: Gate[_Packet] | None = None,
        *,
        prefix: str = "",
        stamped: bool = False,
    ) -> None:
        self.name = config.name
        self.up = Direction(config, "up", f"link/{prefix}up", f"{prefix}autopilot")
        self.down = Direction(config, "down", f"link/{prefix}down", f"{prefix}plant")
        self.gate = gate
        self.clock_steps = 0
        self._outbox = outbox
        self._stamped = stamped
        self._heap: list[_Packet] = []
        self._sequence = 0
        self._begun = False
        self._origin_ns = 0
        """Link time 0 by the node's clock: when the first packet entered, in either direction."""
        self._newest_ns = 0
        """The latest link time that there was: now."""

    @property
    def title(self) -> str:
        """What it is called in a sentence."""
        return "the link" if self.name == DEFAULT_NAME else f"link {self.name}"

    @property
    def directions(self) -> tuple[Direction, Direction]:
        """Both, up first."""
        return self.up, self.down

    def next_deadline_ns(self) -> int | None:
        """Return when the next packet leaves, by the node's clock, or None."""
        return self._origin_ns + self._heap[0][0] if self._heap else None

    def link_ns(self, now_ns: int) -> int:
        """Return the link time at which it is ``now_ns`` by the node's clock; 0 before the first packet."""
        if self._begun:
            self._pass_to(now_ns)
        return self._newest_ns

    def receive(self, direction: Direction, datagram: bytes, now_ns: int) -> None:
        """Take a packet into the link. What is due, itself included, leaves at once and in order, unless stamped."""
        link_ns = self._enter(direction, now_ns)
        if self.gate is not None and direction is self.up:
            self._obey(self.gate.sense(datagram))
        while direction.next_change_ns <= link_ns:
            change = direction.change()
            if not change.live:
                self._tell(change, self._origin_ns + self._newest_ns)
        lane = direction.lane(datagram) if direction.rules else direction.main
        counters = direction.counters
        counters.sent += 1
        if lane.counters is not None:
            lane.counters.sent += 1
        number = counters.sent
        if lane.passes and lane.queued < lane.limit:
            copies: tuple[Copy, ...] = (Copy(_DELIVERED, link_ns),)
        else:
            copies = lane.impairment.step(len(datagram), link_ns, lane.queued)
        for copy, (fate, exit_ns, flipped) in enumerate(copies):
            if copy:
                _count_further(direction, lane)
            self._sequence += 1
            payload = flip(datagram, flipped) if flipped else datagram
            packet = (exit_ns, self._sequence, direction, lane, number, copy, link_ns, fate, flipped, payload)
            if exit_ns > self._newest_ns or (self._stamped and fate is _DELIVERED):
                direction.queued += 1
                lane.queued += 1
                heappush(self._heap, packet)
            else:
                self._settle(packet)

    def tick(self, now_ns: int) -> None:
        """Let out what is due; of a stamped link no more than ``MAX_AT_ONCE`` copies, so that it stays due."""
        if self._begun:
            self._pass_to(now_ns)
            if self._heap and self._heap[0][0] <= self._newest_ns:
                self._release(MAX_AT_ONCE if self._stamped else None)

    def order(self, specs: Mapping[Way, LinkSpec], now_ns: int) -> list[Change]:
        """Change directions from now on, after every packet that has entered; return the changes.

        Raises
        ------
        InputError
            When too many changes wait already, and then none is made.
        """
        directions = [direction for direction in self.directions if direction.way in specs]
        if any(len(direction.changes) >= MAX_CHANGES for direction in directions):
            raise InputError(f"link {self.name}: expected at most {MAX_CHANGES} changes to wait, found more")
        at_ns = max(self.link_ns(now_ns), *(direction.entered_ns + 1 for direction in self.directions))
        planned_ns = {change.at_ns for direction in directions for change in direction.changes if not change.live}
        while at_ns in planned_ns:  # which of two comes first must be clear to who repeats them
            at_ns += 1
        changes = [Change(at_ns, direction.way, specs[direction.way], live=True) for direction in directions]
        for direction, change in zip(directions, changes, strict=True):
            direction.order(change)
            self._tell(change, now_ns)
        return changes

    # Times

    def _enter(self, direction: Direction, now_ns: int) -> int:
        """Return the link time at which a packet enters; let out what is due before, unless stamped."""
        if not self._begun:
            self._begun, self._origin_ns = True, now_ns
        link_ns = now_ns - self._origin_ns
        if not self._stamped:
            if link_ns != self._newest_ns:
                self._pass_to(now_ns)
                link_ns = self._newest_ns
            if self._heap and self._heap[0][0] <= link_ns:
                self._release()
        elif link_ns < direction.came_ns:
            self._set_back(direction.came_ns - link_ns)
            link_ns = direction.came_ns
        direction.came_ns = link_ns
        if link_ns < 0:  # what came before the first of the other direction may be read after it
            link_ns = 0
        direction.entered_ns = link_ns
        if link_ns > self._newest_ns:
            self._newest_ns = link_ns
        return link_ns

    def _pass_to(self, now_ns: int) -> None:
        """Let link time pass to ``now_ns``."""
        link_ns = now_ns - self._origin_ns
        if link_ns < self._newest_ns:
            self._set_back(self._newest_ns - link_ns)
        else:
            self._newest_ns = link_ns

    def _set_back(self, by_ns: int) -> None:
        self._origin_ns -= by_ns
        self.clock_steps += 1

    def _tell(self, change: Change, t_ns: int) -> None:
        """Record a change, with the text that repeats it."""
        at = format_change(change)
        data = {
            "link": self.name,
            "direction": change.way,
            "link_ns": change.at_ns,
            "spec": format_spec(change.spec),
            "at": at,
            "live": change.live,
        }
        body = {"kind": "link_change", "node": "relay", "text": f"{self.title} changes at {at}", "data": data}
        self._outbox.records.append(Record("events", t_ns, body))

    # Packets

    def _release(self, most: int | None = None) -> None:
        """Let out what is due, or the first so many copies of it."""
        heap, now_ns, left = self._heap, self._newest_ns, most
        while heap and heap[0][0] <= now_ns and left != 0:
            if left is not None:
                left -= 1
            packet = heappop(heap)
            packet[2].queued -= 1
            packet[3].queued -= 1
            if self.gate is None:
                self._conclude(packet)
            else:
                self._settle(packet)

    def _settle(self, packet: _Packet) -> None:
        """Let a copy meet its fate now; a command that would leave goes to the gate instead."""
        _, _, direction, lane, _, _, _, fate, _, payload = packet
        if self.gate is not None and direction is self.down and fate is _DELIVERED:
            step = self.gate.command(payload, packet)
            if step is not None:
                direction.queued += 1  # until the gate lets go of it, which may be at once
                lane.queued += 1
                self._obey(step)
                return
        self._conclude(packet)

    def _obey(self, step: GateStep[_Packet]) -> None:
        """Do what the gate decided. A command that goes to the plant again is a further copy."""
        for packet, times in step.released:
            exit_ns, sequence, direction, lane, number, copy, entered_ns, fate, flipped, payload = packet
            if times:
                _count_further(direction, lane)
                copy += times
            else:
                direction.queued -= 1
                lane.queued -= 1
            again = (exit_ns, sequence, direction, lane, number, copy, entered_ns, fate, flipped, payload)
            self._conclude(again, timed=True)
        for exit_ns, sequence, direction, lane, number, copy, entered_ns, _, flipped, payload in step.dropped:
            direction.queued -= 1
            lane.queued -= 1
            gated = (exit_ns, sequence, direction, lane, number, copy, entered_ns, Fate.GATED, flipped, payload)
            self._conclude(gated, timed=True)

    def _conclude(self, packet: _Packet, *, timed: bool = False) -> None:
        """Count and record a copy whose fate is fulfilled now; send it if that is delivery.

        ``timed`` says that the gate chose the time, so it tells nothing about precision.
        """
        exit_ns, _, direction, lane, number, _, entered_ns, fate, _, payload = packet
        now_ns, outbox, size = self._newest_ns, self._outbox, len(payload)
        late = number < direction.newest
        direction.counters.count(fate, size, late)
        if lane.counters is not None:
            lane.counters.count(fate, size, late)
        if fate is _DELIVERED:
            if not late:
                direction.newest = number
            outbox.outgoing.append((direction.exit_port, payload))
            direction.delivered(now_ns, size, entered_ns, None if timed else exit_ns)
        t_ns = self._origin_ns + now_ns
        if outbox.may_log(t_ns):
            outbox.records.append(Record(direction.topic, t_ns, self._body(packet)))
        else:
            direction.counters.unlogged += 1
            if lane.counters is not None:
                lane.counters.unlogged += 1

    def _body(self, packet: _Packet) -> dict[str, Any]:
        """Return what is recorded of a copy."""
        exit_ns, _, _, lane, number, copy, entered_ns, fate, flipped, payload = packet
        delivered = fate is _DELIVERED
        travelled = delivered or fate is Fate.GATED or exit_ns > entered_ns
        body: dict[str, Any] = {
            "sent_ns": self._origin_ns + entered_ns,
            "delivered_ns": self._origin_ns + self._newest_ns if delivered else None,
            "number": number,
            "size": len(payload),
            "fate": fate._value_,  # what ``value`` returns, which finds it slowly
            "copy": copy,
            "requested_ns": exit_ns - entered_ns if travelled else None,
        }
        if flipped:
            body["bits"] = list(flipped)
        if lane.rule is not None:
            body["rule"] = lane.rule.messages
        return body


def flip(datagram: bytes, bits: tuple[int, ...]) -> bytes:
    """Return the datagram with these bits flipped; bit 0 is the lowest of the first byte."""
    flipped = bytearray(datagram)
    for bit in bits:
        flipped[bit >> 3] ^= 1 << (bit & 7)
    return bytes(flipped)


def _count_further(direction: Direction, lane: Lane) -> None:
    direction.counters.duplicated += 1
    if lane.counters is not None:
        lane.counters.duplicated += 1
