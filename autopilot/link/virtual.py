"""The virtual driver: the same nodes in one process, no socket, no sleep; time jumps to the next event.

Events are ordered by true time; at equal instants deliveries come before ticks, then node order, then
sequence. Nothing else decides, so a flight is the same bytes for the same seed.

Between two events a node may be killed and replaced, frozen and thawed, muted, and its clock may be set or given
another rate: what happens to programs on real machines. The node is not told.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum

from autopilot.link.clock import Clock
from autopilot.link.node import Datagram, Node, Record

__all__ = ["MAX_WAITING", "Loss", "Participant", "VirtualNetwork"]

MAX_WAITING = 256
"""Datagrams that wait for a frozen node unless it says otherwise: small ones in a socket buffer of 208 KiB, as Linux
has it by default."""

_NEVER_NS = 1 << 63

Sink = Callable[[Record, int], None]
"""Takes a record and the true time at which it was made."""

Tap = Callable[[str, str, str, bytes, int], None]
"""Sees every datagram of a node: node, port, "sent" or "received", bytes, true time."""


class Loss(StrEnum):
    """Why a datagram got lost between two nodes; what an impaired link loses is the relay's business."""

    DEAD = "dead"
    """Whom it was for did not live, or died before taking it."""
    OVERFLOW = "overflow"
    """Too many waited for a frozen node."""
    MUTE = "mute"
    """Its sender was mute."""


@dataclass(slots=True)
class Participant:
    """A node, its name and its clock.

    Attributes
    ----------
    name : str
    node : Node
    clock : Clock
    max_waiting : int
        Datagrams that may wait for it while it is frozen.
    """

    name: str
    node: Node
    clock: Clock
    max_waiting: int = MAX_WAITING


@dataclass(slots=True, eq=False)
class _Seat:
    """A node's place in the network, and what has been done to it; dead or frozen, it is kept from anything.

    Attributes
    ----------
    participant : Participant
        Who sits there now.
    tapped : bool
        Whether the tap sees its datagrams.
    wires : dict
        The seat and the port at the other end, by port.
    waiting : deque of (port, payload)
        What has come, and was not taken yet.
    deadline_ns : int or None
        Of the node, by its own clock.
    due_ns : int
        The same in true time; ``_NEVER_NS`` without one.
    """

    participant: Participant
    tapped: bool
    wires: dict[str, tuple[_Seat, str]] = field(default_factory=dict)
    waiting: deque[Datagram] = field(default_factory=deque)
    deadline_ns: int | None = None
    due_ns: int = _NEVER_NS
    dead: bool = False
    frozen: bool = False
    mute: bool = False


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

    Attributes
    ----------
    now_ns : int
        True time.
    losses : mapping of str to Counter
        Datagrams lost at each node, by :class:`Loss`.
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
        self._seats = [_Seat(p, p.name in tapped and tap is not None) for p in self._participants]
        for (i, port), (far, far_port) in self._wires.items():
            self._seats[i].wires[port] = (self._seats[far], far_port)
        self.losses: dict[str, Counter[Loss]] = {p.name: Counter() for p in self._participants}
        for seat in self._seats:
            self._reschedule(seat)

    # What may happen to a node

    def replace(self, name: str, node: Node, clock: Clock) -> None:
        """Boot a new node under an old name: it takes what waits for a frozen one; of a dead one nothing waits."""
        i, seat = self._index[name], self._seat(name)
        seat.participant = Participant(name, node, clock, seat.participant.max_waiting)
        self._participants[i] = seat.participant
        seat.dead = seat.frozen = seat.mute = False
        self._reschedule(seat)

    def kill(self, name: str) -> None:
        """Let a node die: what waited for it is lost, and what comes, until it is replaced."""
        seat = self._seat(name)
        seat.dead = True
        self.losses[name][Loss.DEAD] += len(seat.waiting)
        seat.waiting.clear()
        self._reschedule(seat)

    def freeze(self, name: str) -> None:
        """Let a node stand still: what comes waits, as far as there is room, and so does what is due."""
        seat = self._seat(name)
        seat.frozen = True
        self._reschedule(seat)

    def thaw(self, name: str) -> None:
        """Let a frozen node go on: it takes all that waits, and then does all that is due."""
        seat = self._seat(name)
        seat.frozen = False
        self._reschedule(seat)

    def mute(self, name: str, active: bool) -> None:
        """Let all that a node sends get lost, or no longer so."""
        self._seat(name).mute = active

    def clock(self, name: str) -> Clock:
        """Return a node's clock as it runs now."""
        return self._seat(name).participant.clock

    def step_clock(self, name: str, by_ns: int) -> None:
        """Set a node's clock forward, or back."""
        clock = self.clock(name)
        self._set_clock(name, Clock(clock.offset_ns + by_ns, clock.drift_ppb, clock.boot_ns))

    def drift_clock(self, name: str, drift_ppb: int) -> None:
        """Give a node's clock another rate; it goes on from what it shows."""
        self._set_clock(name, Clock(self.clock(name).node_ns(self.now_ns), drift_ppb, self.now_ns))

    def _set_clock(self, name: str, clock: Clock) -> None:
        seat = self._seat(name)
        seat.participant.clock = clock
        self._reschedule(seat)

    def _seat(self, name: str) -> _Seat:
        return self._seats[self._index[name]]

    # Events

    def run(self, until: Callable[[], bool], limit_ns: int) -> None:
        """Fly until ``until()`` holds, asked before each tick, or true time passes ``limit_ns``."""
        while True:
            self._deliver()
            if until():
                return
            seat = self._earliest()
            due_ns = seat.due_ns
            if due_ns > limit_ns:
                self.now_ns = max(self.now_ns, limit_ns)
                return
            if due_ns > self.now_ns:
                self.now_ns = due_ns
            p = seat.participant
            p.node.tick(p.clock.node_ns(self.now_ns))
            self._collect(seat)

    def _deliver(self) -> None:
        """Hand over what is under way, always to the first node that has something; wires take no time."""
        seats, i = self._seats, 0
        while i < len(seats):
            seat = seats[i]
            waiting = seat.waiting
            if not waiting or seat.frozen:
                i += 1
                continue
            p = seat.participant
            receive, now_ns = p.node.receive, p.clock.node_ns(self.now_ns)
            while waiting:
                port, datagram = waiting.popleft()
                if seat.tapped:
                    self._tap(p.name, port, "received", datagram, self.now_ns)  # type: ignore[misc]
                receive(port, datagram, now_ns)
            if self._collect(seat):
                i = 0

    def _deliver_to(self, seat: _Seat, port: str, datagram: bytes) -> None:
        """Put a datagram before a node, if there is one, and room."""
        if seat.dead:
            self.losses[seat.participant.name][Loss.DEAD] += 1
        elif seat.frozen and len(seat.waiting) >= seat.participant.max_waiting:
            self.losses[seat.participant.name][Loss.OVERFLOW] += 1
        else:
            seat.waiting.append((port, datagram))

    def _earliest(self) -> _Seat:
        """Return the seat whose tick is due first, the first of equals."""
        earliest = self._seats[0]
        for seat in self._seats:
            if seat.due_ns < earliest.due_ns:
                earliest = seat
            if earliest.due_ns <= self.now_ns:
                break  # what is overdue is due now, and of equals the first counts
        return earliest

    def _reschedule(self, seat: _Seat) -> None:
        """Ask for a deadline anew, as the node, its clock or what has been done to it is another."""
        p = seat.participant
        seat.deadline_ns = None if seat.dead or seat.frozen else p.node.next_deadline_ns()
        seat.due_ns = _NEVER_NS if seat.deadline_ns is None else p.clock.true_ns(seat.deadline_ns)

    def _collect(self, seat: _Seat) -> bool:
        """Take what a node has sent and recorded, and its new deadline; return whether it sent anything."""
        p = seat.participant
        node = p.node
        outgoing = node.outgoing()
        if outgoing:
            self._send(seat, outgoing)
        records = node.records()
        if self._sink is not None:
            for record in records:
                self._sink(record, p.clock.true_ns(record.t_ns))
        if node.next_deadline_ns() != seat.deadline_ns:
            self._reschedule(seat)
        return bool(outgoing)

    def _send(self, seat: _Seat, outgoing: Sequence[Datagram]) -> None:
        """Put what a node has sent before those at the other ends."""
        if seat.mute:
            self.losses[seat.participant.name][Loss.MUTE] += len(outgoing)
            return
        for port, datagram in outgoing:
            if seat.tapped:
                self._tap(seat.participant.name, port, "sent", datagram, self.now_ns)  # type: ignore[misc]
            far = seat.wires.get(port)
            if far is not None:
                self._deliver_to(far[0], far[1], datagram)
