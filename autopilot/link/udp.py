"""The UDP driver: one node, its sockets, the wall clock, one selector loop.

One pass of the loop is bounded work: it looks at every port, serves a bounded number of datagrams of the control
ports, then one of one other port, the next in turn that has any, then what is due. So whatever waits at the other
ports, a control datagram waits for one of them and one tick at the most, and each of them has every other's
turn once between two of its own. What a flood piles up, it piles up in the kernel's buffer of the port that it
floods; what does not fit there the kernel drops and counts. Ground stations need no budget beyond that: serving
2,000 datagrams a second takes ten to fifteen percent of a processor, and control comes before each of them.

A peer that is not there is no error. A port that dials talks to its one peer, by a connected socket: the kernel
drops strangers, and we never wake for them. A port that listens latches the first address whose datagram it is
told to accept, lets go of it after a silence, and counts strangers. Its socket stays unconnected, since the
kernel would tell neither how many it dropped nor that somebody new calls. Dropping a stranger costs one system call
and one comparison: 20,000 a second take about as much of a processor as the ground station's 2,000.
"""

from __future__ import annotations

import select
import socket
import struct
from collections.abc import Callable, Collection, Sequence
from time import perf_counter_ns  # noqa: TID251  a driver reads the clock; this one is common to all processes
from typing import Protocol

from autopilot.link.clock import NS_PER_S, Clock
from autopilot.link.node import Datagram, Node, Record
from autopilot.link.record import frame_record
from gains.table import InputError

__all__ = [
    "Address",
    "RecordSink",
    "UdpDriver",
    "UdpPort",
    "dial",
    "listen",
    "next_in_turn",
    "parse_address",
    "true_ns",
]

MAX_PER_PASS = 32
"""Datagrams of one control port that one pass takes, strangers' included; of the other ports it takes one in all."""

MAX_DATAGRAM = 65_535

LATCH_SILENCE_NS = 3 * NS_PER_S
"""A latched peer that has been silent for so long may be replaced: it may have restarted elsewhere."""

MAX_WAIT_NS = NS_PER_S // 4
"""Longest sleep, so that a request to stop is soon seen."""

RECEIVE_BUFFER_BYTES = 1 << 20
"""What the kernel is asked to hold for each port, in its own accounting: hundreds of bytes for a small datagram."""

SO_MEMINFO = 55
"""Linux, ``asm-generic/socket.h``; Python does not name it."""
MEMINFO = struct.Struct("=9I")
MEMINFO_DROPS = 8

Address = tuple[str, int]


def true_ns() -> int:
    """Return true time as all processes on this machine see it, in ns since an arbitrary instant."""
    return perf_counter_ns()


def parse_address(text: str) -> Address:
    """Return host and port of ``127.0.0.1:14600``, ``[::1]:14600``, or the same after ``udpout:`` or ``udpin:``.

    Raises
    ------
    InputError
        For anything else.
    """
    bare = text.removeprefix("udpout:").removeprefix("udpin:")
    host, colon, port = bare.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not colon or not host or not port.isascii() or not port.isdigit() or int(port) > 65_535:
        raise InputError(f'address "{text}": expected HOST:PORT such as 127.0.0.1:14550')
    return host, int(port)


def _resolve(address: Address) -> tuple[socket.AddressFamily, Address]:
    host, port = address
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
    except (OSError, UnicodeError) as error:
        raise InputError(f"address {host}:{port}: cannot be resolved ({error})") from None
    return found[0], (str(found[4][0]), int(found[4][1]))


class UdpPort:
    """One socket of a node; made by :func:`dial` or :func:`listen`.

    Attributes
    ----------
    name : str
        The node's name for it.
    peer : Address or None
        Whom it talks to; None until one is latched.
    strangers : int
        Datagrams of other senders, dropped.
    unsent : int
        Datagrams that could not be sent: no peer, or the system refused.
    """

    def __init__(
        self,
        name: str,
        sock: socket.socket,
        peer: Address | None,
        accept: Callable[[bytes], bool] | None,
        *,
        connected: bool,
    ) -> None:
        self.name = name
        self.socket = sock
        self.peer = peer
        self.strangers = 0
        self.unsent = 0
        self._accept = accept
        self._connected = connected
        self._heard_ns: int | None = None
        self._buffer = memoryview(bytearray(MAX_DATAGRAM))

    @property
    def local(self) -> Address:
        """The address it is bound to."""
        name = self.socket.getsockname()
        return str(name[0]), int(name[1])

    @property
    def overflowed(self) -> int | None:
        """Datagrams that the kernel dropped, the receive buffer being full; None where it does not tell."""
        try:
            info = self.socket.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, MEMINFO.size)
        except OSError:
            return None
        return int(MEMINFO.unpack(info)[MEMINFO_DROPS]) if len(info) == MEMINFO.size else None

    def receive(self, now_ns: int) -> bytes | None:
        """Return the next datagram of the peer, b"" for one that was dropped, None when there is none."""
        try:
            size, sender = self.socket.recvfrom_into(self._buffer)
        except BlockingIOError:
            return None
        except OSError:
            return b""  # an earlier datagram of ours found nobody: no host, no network, or no program there
        if not self._connected and sender[:2] != self.peer and not self._latches(sender[:2], size, now_ns):
            self.strangers += 1
            return b""
        self._heard_ns = now_ns
        return bytes(self._buffer[:size])

    def send(self, datagram: bytes) -> None:
        """Send to the peer; count what cannot be sent."""
        if self.peer is None:
            self.unsent += 1
            return
        try:
            if self._connected:
                self.socket.send(datagram)
            else:
                self.socket.sendto(datagram, self.peer)
        except OSError:
            self.unsent += 1  # nobody listens there, or the send buffer is full: UDP loses it

    def _latches(self, sender: Address, size: int, now_ns: int) -> bool:
        """Whether a stranger, whose datagram is in the buffer, becomes the peer."""
        if self._accept is None or (self._heard_ns is not None and now_ns - self._heard_ns <= LATCH_SILENCE_NS):
            return False
        if not self._accept(bytes(self._buffer[:size])):
            return False
        self.peer = sender
        return True


def dial(name: str, address: Address) -> UdpPort:
    """Return a port that talks to one address and hears nobody else.

    Raises
    ------
    InputError
        When the address cannot be resolved or reached.
    """
    if address[1] == 0:
        raise InputError(f"address {address[0]}:0: expected a port to send to, found 0")
    family, resolved = _resolve(address)
    sock = _socket(family)
    try:
        sock.connect(resolved)
    except OSError as error:
        sock.close()
        raise InputError(f"address {address[0]}:{address[1]}: {error.strerror}") from None
    return UdpPort(name, sock, resolved, None, connected=True)


def listen(
    name: str, address: Address, *, peer: Address | None = None, accept: Callable[[bytes], bool] | None = None
) -> UdpPort:
    """Return a bound port that talks to ``peer``, or else to the first sender of an accepted datagram.

    Raises
    ------
    InputError
        When the address is busy, not ours, or cannot be resolved.
    """
    family, resolved = _resolve(address)
    fixed = _resolve(peer)[1] if peer is not None else None
    sock = _socket(family)
    try:
        sock.bind(resolved)
    except OSError as error:
        sock.close()
        raise InputError(f"address {address[0]}:{address[1]}: {error.strerror}") from None
    return UdpPort(name, sock, fixed, accept if peer is None else None, connected=False)


def _socket(family: socket.AddressFamily) -> socket.socket:
    sock = socket.socket(family, socket.SOCK_DGRAM)
    sock.setblocking(False)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
    return sock


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
    ) -> None:
        self.node = node
        self.clock = Clock(clock.offset_ns, clock.drift_ppb, true_ns())
        self._ports = list(ports)
        self._control, self._others = self._ports[:control], self._ports[control:]
        self._last = -1
        self._on_pass = on_pass
        self._sockets = [port.socket for port in ports]
        self._by_name = {port.name: port for port in ports}
        self._sink = sink
        self._tap = tap and sink is not None

    def run(self, stopping: Callable[[], bool]) -> None:
        """Serve the node until ``stopping()`` holds."""
        while not stopping():
            ready = self._wait()
            self.serve([port for port in self._ports if port.socket in ready])

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
        turn = next_in_turn([port in ready for port in self._others], self._last)
        if turn is not None:
            self._last = turn
            self._take(self._others[turn], 1)
        now_ns = self._now_ns()
        deadline_ns = self.node.next_deadline_ns()
        if deadline_ns is not None and now_ns >= deadline_ns:
            self.node.tick(now_ns)
        self._record(self._send())
        if self._sink is not None:
            self._sink.pump()
        if self._on_pass is not None:
            self._on_pass(now_ns)

    def close(self) -> None:
        """Close the sockets."""
        for port in self._ports:
            port.socket.close()

    def _now_ns(self) -> int:
        return self.clock.node_ns(true_ns())

    def _wait(self) -> list[socket.socket]:
        """Sleep until a datagram comes or the node's deadline, whichever is first; return who has one."""
        deadline_ns = self.node.next_deadline_ns()
        wait_ns = MAX_WAIT_NS
        if deadline_ns is not None:
            wait_ns = min(wait_ns, max(0, self.clock.true_ns(deadline_ns) - true_ns()))
        return select.select(self._sockets, [], [], wait_ns / NS_PER_S)[0]

    def _take(self, port: UdpPort, most: int) -> None:
        """Hand the node at most so many datagrams, sending its answers at once."""
        for _ in range(most):
            datagram = port.receive(true_ns())
            at_ns = true_ns()  # not before it came: clocks are compared by this
            if datagram is None:
                return
            if not datagram:
                continue
            now_ns = self.clock.node_ns(at_ns)
            self.node.receive(port.name, datagram, now_ns)
            sent = self._send()
            if self._tap and self._sink is not None:
                self._sink.write(frame_record(port.name, now_ns, "received", datagram), at_ns)
            self._record(sent)

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
