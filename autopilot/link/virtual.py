"""The virtual driver: the same nodes in one process, no socket, no sleep; time jumps to the next event.

Events are ordered by true time; at equal instants deliveries come before ticks, then node order, then
sequence. Nothing else decides, so a flight is the same bytes for the same seed.

Between two events a node may be killed and replaced, frozen and thawed, muted, and its clock may be set or given
another rate: what happens to programs on real machines. The node is not told.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

from autopilot.link.clock import Clock
from autopilot.link.node import Datagram, Node, Record

__all__ = ["MAX_WAITING", "Loss", "Participant", "VirtualNetwork"]

MAX_WAITING = 256
"""Datagrams that wait for a frozen node unless it says otherwise: small ones in a socket buffer of 208 KiB, as Linux
has it by default."""

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


@dataclass(slots=True)
class _State:
    """What has been done to a node; the first two keep it from anything."""

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
        self._tapped = [p.name in tapped and tap is not None for p in self._participants]
        self._deliveries: list[deque[tuple[str, bytes]]] = [deque() for _ in self._participants]
        self._deadlines: list[int | None] = [None] * len(self._participants)
        self._due: list[int | None] = [None] * len(self._participants)
        self._states = [_State() for _ in self._participants]
        self.losses: dict[str, Counter[Loss]] = {p.name: Counter() for p in self._participants}
        for i in range(len(self._participants)):
            self._schedule(i)

    # What may happen to a node

    def replace(self, name: str, node: Node, clock: Clock) -> None:
        """Boot a new node under an old name: it takes what waits for a frozen one; of a dead one nothing waits."""
        i = self._index[name]
        self._participants[i] = Participant(name, node, clock, self._participants[i].max_waiting)
        self._states[i] = _State()
        self._schedule(i, anew=True)

    def kill(self, name: str) -> None:
        """Let a node die: what waited for it is lost, and what comes, until it is replaced."""
        i = self._index[name]
        self._states[i].dead = True
        self.losses[name][Loss.DEAD] += len(self._deliveries[i])
        self._deliveries[i].clear()
        self._schedule(i, anew=True)

    def freeze(self, name: str) -> None:
        """Let a node stand still: what comes waits, as far as there is room, and so does what is due."""
        i = self._index[name]
        self._states[i].frozen = True
        self._schedule(i, anew=True)

    def thaw(self, name: str) -> None:
        """Let a frozen node go on: it takes all that waits, and then does all that is due."""
        i = self._index[name]
        self._states[i].frozen = False
        self._schedule(i, anew=True)

    def mute(self, name: str, active: bool) -> None:
        """Let all that a node sends get lost, or no longer so."""
        self._states[self._index[name]].mute = active

    def clock(self, name: str) -> Clock:
        """Return a node's clock as it runs now."""
        return self._participants[self._index[name]].clock

    def step_clock(self, name: str, by_ns: int) -> None:
        """Set a node's clock forward, or back."""
        clock = self.clock(name)
        self._set_clock(name, Clock(clock.offset_ns + by_ns, clock.drift_ppb, clock.boot_ns))

    def drift_clock(self, name: str, drift_ppb: int) -> None:
        """Give a node's clock another rate; it goes on from what it shows."""
        self._set_clock(name, Clock(self.clock(name).node_ns(self.now_ns), drift_ppb, self.now_ns))

    def _set_clock(self, name: str, clock: Clock) -> None:
        i = self._index[name]
        self._participants[i].clock = clock
        self._schedule(i, anew=True)

    # Events

    def run(self, until: Callable[[], bool], limit_ns: int) -> None:
        """Fly until ``until()`` holds, asked before each tick, or true time passes ``limit_ns``."""
        while True:
            self._deliver()
            if until():
                return
            i = self._earliest()
            due_ns = self._due[i]
            if due_ns is None or due_ns > limit_ns:
                self.now_ns = max(self.now_ns, limit_ns)
                return
            self.now_ns = max(self.now_ns, due_ns)
            p = self._participants[i]
            p.node.tick(p.clock.node_ns(self.now_ns))
            self._collect(i)

    def _deliver(self) -> None:
        """Hand over what is under way, always to the first node that has something; wires take no time."""
        i, count = 0, len(self._participants)
        while i < count:
            waiting = self._deliveries[i]
            if not waiting or self._states[i].frozen:
                i += 1
                continue
            p = self._participants[i]
            receive, now_ns = p.node.receive, p.clock.node_ns(self.now_ns)
            while waiting:
                port, datagram = waiting.popleft()
                if self._tapped[i]:
                    self._tap(p.name, port, "received", datagram, self.now_ns)  # type: ignore[misc]
                receive(port, datagram, now_ns)
            if self._collect(i):
                i = 0

    def _deliver_to(self, i: int, port: str, datagram: bytes) -> None:
        """Put a datagram before a node, if there is one, and room."""
        state, waiting = self._states[i], self._deliveries[i]
        if state.dead:
            self.losses[self._participants[i].name][Loss.DEAD] += 1
        elif state.frozen and len(waiting) >= self._participants[i].max_waiting:
            self.losses[self._participants[i].name][Loss.OVERFLOW] += 1
        else:
            waiting.append((port, datagram))

    def _earliest(self) -> int:
        """Return the node whose tick is due first, the first of equals."""
        earliest, first_ns, now_ns = 0, None, self.now_ns
        for i, due_ns in enumerate(self._due):
            if due_ns is not None and (first_ns is None or due_ns < first_ns):
                earliest, first_ns = i, due_ns
                if due_ns <= now_ns:
                    break  # what is overdue is due now, and of equals the first counts
        return earliest

    def _schedule(self, i: int, *, anew: bool = False) -> None:
        """Ask a node for its deadline, and map it to true time when it is a new one, or the node or its clock is."""
        p, state = self._participants[i], self._states[i]
        deadline_ns = None if state.dead or state.frozen else p.node.next_deadline_ns()
        if deadline_ns != self._deadlines[i] or anew:
            self._deadlines[i] = deadline_ns
            self._due[i] = None if deadline_ns is None else p.clock.true_ns(deadline_ns)

    def _collect(self, i: int) -> bool:
        """Take what a node has sent and recorded, and its new deadline; return whether it sent anything."""
        p = self._participants[i]
        outgoing = p.node.outgoing()
        if outgoing:
            self._send(i, p, outgoing)
        records = p.node.records()
        if self._sink is not None:
            for record in records:
                self._sink(record, p.clock.true_ns(record.t_ns))
        self._schedule(i)
        return bool(outgoing)

    def _send(self, i: int, p: Participant, outgoing: Sequence[Datagram]) -> None:
        """Put what a node has sent before those at the other ends."""
        if self._states[i].mute:
            self.losses[p.name][Loss.MUTE] += len(outgoing)
            return
        for port, datagram in outgoing:
            if self._tapped[i]:
                self._tap(p.name, port, "sent", datagram, self.now_ns)  # type: ignore[misc]
            far = self._wires.get((i, port))
            if far is not None:
                self._deliver_to(far[0], far[1], datagram)
