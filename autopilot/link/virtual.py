"""The virtual driver: the same nodes in one process, no socket, no sleep; time jumps to the next event.

Events are ordered by true time; at equal instants deliveries come before ticks, then node order, then
sequence. Nothing else decides, so a flight is the same bytes for the same seed.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from autopilot.link.clock import Clock
from autopilot.link.node import Node, Record

__all__ = ["Participant", "VirtualNetwork"]

Sink = Callable[[Record, int], None]
"""Takes a record and the true time at which it was made."""

Tap = Callable[[str, str, str, bytes, int], None]
"""Sees every datagram of a node: node, port, "sent" or "received", bytes, true time."""


@dataclass(slots=True)
class Participant:
    """A node, its name and its clock."""

    name: str
    node: Node
    clock: Clock


class VirtualNetwork:
    """Nodes joined by ideal wires; impairment is the relay's business.

    Parameters
    ----------
    participants : sequence of Participant
        In the order that breaks ties.
    wires : mapping
        (node, port) to (node, port), both directions listed; a port without a wire loses what is sent.
    sink : callable, optional
        Takes the records.
    tap : callable, optional
        Sees the datagrams of the nodes in ``tapped``.
    tapped : sequence of str
        Names of the nodes whose datagrams the tap sees.
    """

    def __init__(
        self,
        participants: Sequence[Participant],
        wires: Mapping[tuple[str, str], tuple[str, str]],
        sink: Sink | None = None,
        tap: Tap | None = None,
        tapped: Sequence[str] = (),
    ) -> None:
        self.now_ns = 0
        self._participants = list(participants)
        self._index = {p.name: i for i, p in enumerate(self._participants)}
        self._wires = {(self._index[a], port): (self._index[b], far) for (a, port), (b, far) in wires.items()}
        self._sink = sink
        self._tap = tap
        self._tapped = [p.name in tapped and tap is not None for p in self._participants]
        self._deliveries: list[tuple[int, int, int, str, bytes]] = []
        self._sequence = 0
        self._due: list[int | None] = [self._next_due(i) for i in range(len(self._participants))]

    def replace(self, name: str, node: Node, clock: Clock) -> None:
        """Boot a new node under an old name, as after a crash: datagrams under way still arrive."""
        i = self._index[name]
        self._participants[i] = Participant(name, node, clock)
        self._due[i] = self._next_due(i)

    def run(self, until: Callable[[], bool], limit_ns: int) -> None:
        """Fly until ``until()`` holds or true time passes ``limit_ns``."""
        while not until():
            instant = self._earliest()
            if instant is None or instant > limit_ns:
                self.now_ns = max(self.now_ns, limit_ns)
                return
            self.now_ns = instant
            if self._deliveries and self._deliveries[0][0] <= instant:
                _, i, _, port, datagram = heapq.heappop(self._deliveries)
                p = self._participants[i]
                if self._tapped[i]:
                    self._tap(p.name, port, "received", datagram, instant)  # type: ignore[misc]
                p.node.receive(port, datagram, p.clock.node_ns(instant))
            else:
                i = next(i for i, due in enumerate(self._due) if due is not None and due <= instant)
                p = self._participants[i]
                p.node.tick(p.clock.node_ns(instant))
            self._collect(i)

    def _earliest(self) -> int | None:
        earliest = self._deliveries[0][0] if self._deliveries else None
        for due in self._due:
            if due is not None and (earliest is None or due < earliest):
                earliest = due
        return None if earliest is None else max(self.now_ns, earliest)

    def _next_due(self, i: int) -> int | None:
        p = self._participants[i]
        deadline_ns = p.node.next_deadline_ns()
        return None if deadline_ns is None else p.clock.true_ns(deadline_ns)

    def _collect(self, i: int) -> None:
        """Take what a node has sent and recorded, and its new deadline."""
        p = self._participants[i]
        for port, datagram in p.node.outgoing():
            if self._tapped[i]:
                self._tap(p.name, port, "sent", datagram, self.now_ns)  # type: ignore[misc]
            far = self._wires.get((i, port))
            if far is not None:
                heapq.heappush(self._deliveries, (self.now_ns, far[0], self._sequence, far[1], datagram))
                self._sequence += 1
        records = p.node.records()
        if self._sink is not None:
            for record in records:
                self._sink(record, p.clock.true_ns(record.t_ns))
        self._due[i] = self._next_due(i)
