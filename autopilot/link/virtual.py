"""The virtual driver: the same nodes in one process, no socket, no sleep; time jumps to the next event.

Events are ordered by true time; at equal instants deliveries come before ticks, then node order, then
sequence. Nothing else decides, so a flight is the same bytes for the same seed.
"""

from __future__ import annotations

from collections import deque
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
        self._deliveries: list[deque[tuple[str, bytes]]] = [deque() for _ in self._participants]
        self._deadlines: list[int | None] = [None] * len(self._participants)
        self._due: list[int | None] = [None] * len(self._participants)
        for i in range(len(self._participants)):
            self._schedule(i)

    def replace(self, name: str, node: Node, clock: Clock) -> None:
        """Boot a new node under an old name, as after a crash: datagrams under way still arrive."""
        i = self._index[name]
        self._participants[i] = Participant(name, node, clock)
        self._deadlines[i] = self._due[i] = None
        self._schedule(i)

    def run(self, until: Callable[[], bool], limit_ns: int) -> None:
        """Fly until ``until()`` holds or true time passes ``limit_ns``."""
        while not until():
            if self._deliver():
                continue
            i = self._earliest()
            due_ns = self._due[i]
            if due_ns is None or due_ns > limit_ns:
                self.now_ns = max(self.now_ns, limit_ns)
                return
            self.now_ns = max(self.now_ns, due_ns)
            p = self._participants[i]
            p.node.tick(p.clock.node_ns(self.now_ns))
            self._collect(i)

    def _deliver(self) -> bool:
        """Hand over what is under way to the first node that has something; wires take no time."""
        for i, waiting in enumerate(self._deliveries):
            if waiting:
                port, datagram = waiting.popleft()
                p = self._participants[i]
                if self._tapped[i]:
                    self._tap(p.name, port, "received", datagram, self.now_ns)  # type: ignore[misc]
                p.node.receive(port, datagram, p.clock.node_ns(self.now_ns))
                self._collect(i)
                return True
        return False

    def _earliest(self) -> int:
        """Return the node whose tick is due first, the first of equals."""
        earliest, first_ns, now_ns = 0, None, self.now_ns
        for i, due_ns in enumerate(self._due):
            if due_ns is not None and (first_ns is None or due_ns < first_ns):
                earliest, first_ns = i, due_ns
                if due_ns <= now_ns:
                    break  # what is overdue is due now, and of equals the first counts
        return earliest

    def _schedule(self, i: int) -> None:
        """Ask a node for its deadline, and map it to true time when it is a new one."""
        p = self._participants[i]
        deadline_ns = p.node.next_deadline_ns()
        if deadline_ns != self._deadlines[i]:
            self._deadlines[i] = deadline_ns
            self._due[i] = None if deadline_ns is None else p.clock.true_ns(deadline_ns)

    def _collect(self, i: int) -> None:
        """Take what a node has sent and recorded, and its new deadline."""
        p = self._participants[i]
        for port, datagram in p.node.outgoing():
            if self._tapped[i]:
                self._tap(p.name, port, "sent", datagram, self.now_ns)  # type: ignore[misc]
            far = self._wires.get((i, port))
            if far is not None:
                self._deliveries[far[0]].append((far[1], datagram))
        records = p.node.records()
        if self._sink is not None:
            for record in records:
                self._sink(record, p.clock.true_ns(record.t_ns))
        self._schedule(i)
