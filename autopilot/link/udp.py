"""The UDP driver: one node, its sockets, the wall clock, one selector loop.

One pass of the loop is bounded work: it looks at every port, serves a bounded number of datagrams of the control
ports, then one of one other port, the next in turn that has any, then what is due. So whatever waits at the other
ports, a control datagram waits for one of them and one tick at the most, and each of them has every other's
turn once between two of its own. What a flood piles up, it piles up in the kernel's buffer of the port that it
floods; what does not fit there the kernel drops and counts. Ground stations need no budget beyond that: serving
2,000 datagrams a second takes ten to fifteen percent of a processor, and control comes before each of them.

Sleeps end late, by tens of microseconds even on an idle machine. A driver with ``spin_ns`` therefore wakes that much
before the node's deadline and looks at its ports, again and again, until the deadline has come. A ``busy`` driver never
sleeps. A processor that slept answers late, and others have emptied its caches meanwhile: a datagram is answered
sooner, and a processor is taken for it. What such a driver does while nothing comes may keep the caches warm
(:mod:`autopilot.rehearsal`). What the sockets themselves do is told in :mod:`autopilot.link.ports`.
"""

from __future__ import annotations

import select
from collections.abc import Callable, Collection, Sequence
from typing import Protocol

from autopilot.link.clock import NS_PER_MS, NS_PER_S, Clock
from autopilot.link.node import Datagram, Node, Record
from autopilot.link.ports import Address, UdpPort, answer, dial, listen, parse_address, true_ns
from autopilot.link.record import frame_record

__all__ = [
    "Address",
    "RecordSink",
    "UdpDriver",
    "UdpPort",
    "answer",
    "dial",
    "listen",
    "next_in_turn",
    "parse_address",
    "true_ns",
]

MAX_PER_PASS = 32
"""Datagrams of one control port that one pass takes, strangers' included; of the other ports it takes one in all."""

MAX_WAIT_NS = NS_PER_S // 4
"""Longest sleep, so that a request to stop is soon seen."""

MAX_SPIN_NS = 10 * NS_PER_MS
"""Longest spin before a deadline, and the most that is saved up for spinning."""

IDLE_NS = 2 * NS_PER_MS
"""Pause between what a busy driver does while nothing comes: so a packet seldom waits for the end of it."""

SPIN_SHARE = 2
"""Spinning takes at most one part in so many of the time, or a dense flow of packets would keep a processor."""


class RecordSink(Protocol):
    """Where a driver's records go."""

    def write(self, record: Record, log_time_ns: int) -> None:
        """Take a record and its true time, as :func:`true_ns` counts."""

    def pump(self) -> None:
        """Pass on what can be passed on without waiting."""


def next_in_turn(ready: Sequence[bool], last: int) -> int | None:
    """Return the index of the first that is ready after ``last``, going round; None when none is."""
    count = len(ready)
    return next((i % count for i in range(last + 1, last + 1 + count) if ready[i % count]), None)


class UdpDriver:
    """Runs one node until told to stop.

    Parameters
    ----------
    node : Node
        The node.
    ports : sequence of UdpPort
        Control ports first.
    clock : Clock
        The node's clock; it boots when the driver is made.
    sink : RecordSink, optional
        Takes the records.
    tap : bool
        Whether datagrams are recorded too (``mavlink/<port>``).
    control : int
        How many of the ports are control ports.
    on_pass : callable, optional
        Called with the node's time at the end of each pass.
    spin_ns : int
        How long before the node's deadline to stop sleeping and look at the ports again and again: from 0 to
        ``MAX_SPIN_NS``.
    busy : bool
        Never to sleep.
    idle : callable, optional
        What a busy driver does now and then while nothing comes; a datagram that comes meanwhile waits for its end.

    Attributes
    ----------
    node, clock, on_pass
        As given; the clock as it runs now.
    ports : list of UdpPort
    """

    def __init__(
        self,
        node: Node,
        ports: Sequence[UdpPort],
        clock: Clock,
        sink: RecordSink | None = None,
        *,
        tap: bool = False,
        control: int = 1,
        on_pass: Callable[[int], None] | None = None,
        spin_ns: int = 0,
        busy: bool = False,
        idle: Callable[[], None] | None = None,
    ) -> None:
        assert 0 <= spin_ns <= MAX_SPIN_NS, spin_ns
        self.node = node
        self.clock = Clock(clock.offset_ns, clock.drift_ppb, true_ns())
        self.ports = list(ports)
        self._control, self._others = self.ports[:control], self.ports[control:]
        self._last = -1
        self.on_pass = on_pass
        self._busy = busy
        self._idle = idle
        self._next_idle_ns = 0
        self._spin_ns = spin_ns
        self._spin_left_ns = spin_ns
        self._spin_seen_ns = true_ns()
        self._by_name = {port.name: port for port in ports}
        self._by_number: dict[int, UdpPort] = {}
        self._sink = sink
        self._tap = tap and sink is not None

    def run(self, stopping: Callable[[], bool]) -> None:
        """Serve the node until ``stopping()`` holds."""
        self._by_number = {port.socket.fileno(): port for port in self.ports}
        while not stopping():
            self.serve(self._wait())

    def serve(self, ready: Collection[UdpPort]) -> None:
        """Make one pass: control, one datagram of the others, what is due.

        Parameters
        ----------
        ready : collection of UdpPort
            Those that have a datagram.
        """
        for port in self._control:
            if port in ready:
                self._take(port, MAX_PER_PASS)
        if self._others:
            turn = next_in_turn([port in ready for port in self._others], self._last)
            if turn is not None:
                self._last = turn
                self._take(self._others[turn], 1)
        now_ns = self._tick()
        self._record(self._send())
        if self._sink is not None:
            self._sink.pump()
        if self.on_pass is not None:
            self.on_pass(now_ns)

    def close(self) -> None:
        """Close the sockets."""
        for port in self.ports:
            port.socket.close()

    def step_clock(self, by_ns: int) -> None:
        """Move the node's clock by so much, from now on."""
        now_ns = true_ns()
        self.clock = Clock(self.clock.node_ns(now_ns) + by_ns, self.clock.drift_ppb, now_ns)

    def drift_clock(self, drift_ppb: int) -> None:
        """Let the node's clock run at another rate, from now on."""
        now_ns = true_ns()
        self.clock = Clock(self.clock.node_ns(now_ns), drift_ppb, now_ns)

    def break_sends(self, for_ns: int) -> None:
        """Send nothing for so long; what should have been sent is counted as unsent."""
        for port in self.ports:
            port.broken_until_ns = true_ns() + for_ns

    def _wait(self) -> Collection[UdpPort]:
        """Sleep until a datagram comes or the node's deadline, whichever is first; return who has one.

        The last ``spin_ns`` before the deadline, or always if it is busy, it does not sleep but looks again and again.
        """
        deadline_ns = self.node.next_deadline_ns()
        if self._busy:
            return self._look_until(None if deadline_ns is None else self.clock.true_ns(deadline_ns))
        if deadline_ns is None:
            return self._look(MAX_WAIT_NS)
        due_ns, now_ns = self.clock.true_ns(deadline_ns), true_ns()
        spin_ns = self._may_spin_ns(now_ns) if self._spin_ns else 0
        if due_ns - now_ns > spin_ns:
            sleep_ns = min(due_ns - now_ns - spin_ns, MAX_WAIT_NS)
            ready = self._look(sleep_ns)
            if ready or not spin_ns or sleep_ns == MAX_WAIT_NS:
                return ready
            now_ns = true_ns()
        begin_ns = now_ns
        while not (ready := self._look(0)) and (now_ns := true_ns()) < due_ns:
            pass
        self._spin_left_ns -= now_ns - begin_ns
        return ready

    def _look_until(self, due_ns: int | None) -> Collection[UdpPort]:
        """Look, without sleeping, until a datagram comes, it is due or ``MAX_WAIT_NS`` have passed."""
        now_ns = true_ns()
        until_ns = now_ns + MAX_WAIT_NS if due_ns is None else min(due_ns, now_ns + MAX_WAIT_NS)
        while not (ready := self._look(0)) and (now_ns := true_ns()) < until_ns:
            if self._idle is not None and now_ns >= self._next_idle_ns:
                self._idle()
                self._next_idle_ns = true_ns() + IDLE_NS
        return ready

    def _may_spin_ns(self, now_ns: int) -> int:
        """Return how long the next spin may be: what is asked for, or what is left of its share of the time."""
        gained_ns = (now_ns - self._spin_seen_ns) // SPIN_SHARE
        self._spin_left_ns = max(0, min(MAX_SPIN_NS, self._spin_left_ns + gained_ns))
        self._spin_seen_ns = now_ns
        return min(self._spin_ns, self._spin_left_ns)

    def _look(self, wait_ns: int) -> Collection[UdpPort]:
        """Return the ports that have a datagram, waiting at most so long for one."""
        numbers = select.select(self._by_number, (), (), wait_ns / NS_PER_S)[0]
        return [self._by_number[number] for number in numbers]

    def _take(self, port: UdpPort, most: int) -> None:
        """Hand the node at most so many datagrams, sending its answers at once."""
        for _ in range(most):
            datagram = port.receive(true_ns())
            at_ns = true_ns()  # not before it came: clocks are compared by this
            if datagram is None:
                return
            if not datagram:
                continue
            if port.stamps:
                at_ns = port.came_ns(at_ns)
            now_ns = self.clock.node_ns(at_ns)
            self.node.receive(port.name, datagram, now_ns)
            if port.stamps:
                self._tick()  # what has come due since then leaves now, and the node knows when that is
            sent = self._send()
            if self._tap and self._sink is not None:
                self._sink.write(frame_record(port.name, now_ns, "received", datagram), at_ns)
                self._record(sent)

    def _tick(self) -> int:
        """Have the node do what is due; return its time."""
        now_ns = self.clock.node_ns(true_ns())
        deadline_ns = self.node.next_deadline_ns()
        if deadline_ns is not None and now_ns >= deadline_ns:
            self.node.tick(now_ns)
        return now_ns

    def _send(self) -> list[Datagram]:
        """Send what the node has for the network, and return it."""
        outgoing = self.node.outgoing()
        for name, datagram in outgoing:
            self._by_name[name].send(datagram)
        return outgoing

    def _record(self, sent: list[Datagram]) -> None:
        """Record what was sent and what the node has made."""
        records = self.node.records()
        if self._sink is None:
            return
        if self._tap and sent:
            at_ns = true_ns()
            for name, datagram in sent:
                self._sink.write(frame_record(name, self.clock.node_ns(at_ns), "sent", datagram), at_ns)
        for record in records:
            self._sink.write(record, self.clock.true_ns(record.t_ns))
