"""The sockets of a node: one peer per port, strangers counted and dropped.

A peer that is not there is no error. A port that dials talks to its one peer, by a connected socket: the kernel
drops strangers, and we never wake for them. A port that listens latches the first address whose datagram it is
told to accept, lets go of it after a silence, and counts strangers. Its socket stays unconnected, since the
kernel would tell neither how many it dropped nor that somebody new calls. Dropping a stranger costs one system call
and one comparison: 20,000 a second take about as much of a processor as a ground station's 2,000 datagrams. A port
that answers hears every program of this machine, and nobody else can reach it.

A port with ``stamps`` knows when the kernel got a datagram, and not only when this program woke up for it. The kernel
stamps by the wall clock, which may be stepped; how old a stamp is says when the datagram came by a clock that is not.
"""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Callable
from time import perf_counter_ns, time_ns  # noqa: TID251  drivers read clocks; the first is common to all processes

from autopilot.link import kernel
from autopilot.link.clock import NS_PER_S
from gains.table import InputError

__all__ = [
    "LATCH_SILENCE_NS",
    "MAX_STAMP_AGE_NS",
    "RECEIVE_BUFFER_BYTES",
    "WIDE_BUFFER_BYTES",
    "Address",
    "UdpPort",
    "answer",
    "dial",
    "listen",
    "parse_address",
    "true_ns",
]

MAX_DATAGRAM = 65_535

LATCH_SILENCE_NS = 3 * NS_PER_S
"""A latched peer that has been silent for so long may be replaced: it may have restarted elsewhere."""

MAX_STAMP_AGE_NS = NS_PER_S
"""A datagram's time of arrival further back is not believed: the wall clock may have been stepped."""

RECEIVE_BUFFER_BYTES = 1 << 20
"""What the kernel is asked to hold for each port, in its own accounting: hundreds of bytes for a small datagram."""

WIDE_BUFFER_BYTES = 8 << 20
"""The same for a port that takes bursts."""

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
    if not colon or not host or not port.isascii() or not port.isdigit() or len(port) > 5 or int(port) > 65_535:
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
    """One socket of a node; made by :func:`dial`, :func:`listen` or :func:`answer`.

    Attributes
    ----------
    name : str
        The node's name for it.
    peer : Address or None
        Whom it talks to; None until one is latched.
    strangers : int
        Datagrams of other senders, dropped.
    empty : int
        Datagrams of the peer without anything in them, dropped.
    unsent : int
        Datagrams that could not be sent: no peer, or the system refused.
    unstamped : int
        Datagrams whose time of arrival was asked for, and that came without one that can be believed.
    broken_until_ns : int
        True time until which nothing can be sent, as with a network interface that is down: a fault on demand.
    stamps : bool
        Whether the kernel tells when a datagram came.
    asked_bytes : int
        The receive buffer that was asked for.
    """

    def __init__(
        self,
        name: str,
        sock: socket.socket,
        peer: Address | None,
        accept: Callable[[bytes], bool] | None,
        *,
        connected: bool,
        answers: bool = False,
        stamps: bool = False,
        asked_bytes: int = RECEIVE_BUFFER_BYTES,
    ) -> None:
        self.name = name
        self.socket = sock
        self.peer = peer
        self.strangers = 0
        self.empty = 0
        self.unsent = 0
        self.unstamped = 0
        self.broken_until_ns = 0
        self.asked_bytes = asked_bytes
        self.stamps = stamps and kernel.stamp_arrivals(sock)
        self._accept = accept
        self._connected = connected
        self._answers = answers
        self._heard_ns: int | None = None
        self._age_ns: int | None = None
        self._not_before_ns: int | None = None
        self._buffer = memoryview(bytearray(MAX_DATAGRAM))
        self._buffers = [self._buffer]
        kernel.widen(sock, asked_bytes)

    @property
    def local(self) -> Address:
        """The address it is bound to."""
        name = self.socket.getsockname()
        return str(name[0]), int(name[1])

    @property
    def overflowed(self) -> int | None:
        """Datagrams that the kernel dropped, the receive buffer being full; None where it does not tell."""
        return kernel.dropped(self.socket)

    def receive(self, now_ns: int) -> bytes | None:
        """Return the next datagram of the peer, b"" for one that was dropped, None when there is none."""
        try:
            if self.stamps:
                size, sender = self._receive_stamped()
            else:
                size, sender = self.socket.recvfrom_into(self._buffer)
        except BlockingIOError:
            self._not_before_ns = now_ns
            return None
        except OSError:
            return b""  # an earlier datagram of ours found nobody: no host, no network, or no program there
        if self._answers:
            self.peer = sender[:2]
        elif not self._connected and sender[:2] != self.peer and not self._latches(sender[:2], size, now_ns):
            self.strangers += 1
            return b""
        self._heard_ns = now_ns
        self.empty += not size
        return bytes(self._buffer[:size])

    def came_ns(self, now_ns: int) -> int:
        """Return the true time at which the datagram just received came, ``now_ns`` where the kernel does not tell.

        It is never later than ``now_ns``, earlier than that of the datagram before, or earlier than the last time
        that nothing had come.
        """
        came_ns = now_ns if self._age_ns is None else now_ns - self._age_ns
        if self._not_before_ns is not None and came_ns < self._not_before_ns:
            came_ns = min(self._not_before_ns, now_ns)
        self._not_before_ns = came_ns
        return came_ns

    def send(self, datagram: bytes) -> None:
        """Send to the peer; count what cannot be sent."""
        if self.peer is None or (self.broken_until_ns and true_ns() < self.broken_until_ns):
            self.unsent += 1
            return
        try:
            if self._connected:
                self.socket.send(datagram)
            else:
                self.socket.sendto(datagram, self.peer)
        except OSError:
            self.unsent += 1  # nobody listens there, or the send buffer is full: UDP loses it

    def _receive_stamped(self) -> tuple[int, Address]:
        """Receive into the buffer and note how long the datagram has waited; return its size and sender."""
        size, ancillary, _, sender = self.socket.recvmsg_into(self._buffers, kernel.STAMP_SPACE)
        stamp_ns = kernel.stamp_of(ancillary)
        age_ns = None if stamp_ns is None else time_ns() - stamp_ns
        if age_ns is None or not 0 <= age_ns <= MAX_STAMP_AGE_NS:
            self.unstamped += 1
            age_ns = None
        self._age_ns = age_ns
        return size, sender

    def _latches(self, sender: Address, size: int, now_ns: int) -> bool:
        """Whether a stranger, whose datagram is in the buffer, becomes the peer."""
        if self._accept is None or (self._heard_ns is not None and now_ns - self._heard_ns <= LATCH_SILENCE_NS):
            return False
        if not self._accept(bytes(self._buffer[:size])):
            return False
        self.peer = sender
        return True


def dial(name: str, address: Address, *, stamps: bool = False, buffer_bytes: int = RECEIVE_BUFFER_BYTES) -> UdpPort:
    """Return a port that talks to one address and hears nobody else.

    Parameters
    ----------
    name : str
        The node's name for it.
    address : Address
        Its peer.
    stamps : bool
        Whether the node shall be told when the kernel got a datagram, where the kernel tells.
    buffer_bytes : int
        The receive buffer to ask for.

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
    return UdpPort(name, sock, resolved, None, connected=True, stamps=stamps, asked_bytes=buffer_bytes)


def listen(
    name: str,
    address: Address,
    *,
    peer: Address | None = None,
    accept: Callable[[bytes], bool] | None = None,
    stamps: bool = False,
    buffer_bytes: int = RECEIVE_BUFFER_BYTES,
) -> UdpPort:
    """Return a bound port that talks to ``peer``, or else to the first sender of an accepted datagram.

    ``stamps`` and ``buffer_bytes`` are those of :func:`dial`.

    Raises
    ------
    InputError
        When the address is busy, not ours, or cannot be resolved.
    """
    fixed = _resolve(peer)[1] if peer is not None else None
    sock = _bound(address)
    accept = accept if peer is None else None
    return UdpPort(name, sock, fixed, accept, connected=False, stamps=stamps, asked_bytes=buffer_bytes)


def answer(name: str, address: Address) -> UdpPort:
    """Return a bound port that hears every program of this machine and talks to the sender of the latest datagram.

    Raises
    ------
    InputError
        When the address is no loopback address, busy, or cannot be resolved.
    """
    resolved = _resolve(address)[1]
    if not ipaddress.ip_address(resolved[0]).is_loopback:
        raise InputError(f"address {address[0]}:{address[1]}: expected one of this machine alone, such as 127.0.0.1")
    return UdpPort(name, _bound(resolved), None, None, connected=False, answers=True)


def _bound(address: Address) -> socket.socket:
    """Return a socket at an address; raise InputError when that is busy, not ours, or cannot be resolved."""
    family, resolved = _resolve(address)
    sock = _socket(family)
    try:
        sock.bind(resolved)
    except OSError as error:
        sock.close()
        raise InputError(f"address {address[0]}:{address[1]}: {error.strerror}") from None
    return sock


def _socket(family: socket.AddressFamily) -> socket.socket:
    sock = socket.socket(family, socket.SOCK_DGRAM)
    sock.setblocking(False)
    return sock
