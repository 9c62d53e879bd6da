"""The one interface of everything on the network: a Node does no I/O.

Autopilot, aircraft and relay are Nodes. A driver (``udp`` or ``virtual``) owns the sockets and the
clock; it hands a node each datagram with the node's own time, calls ``tick`` when the node's deadline
has come, and takes away what the node wants to send and to record. The same node therefore flies over
real sockets and in virtual time.

Order within one instant, kept by both drivers: deliveries before ticks, then node order, then sequence.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

__all__ = ["Datagram", "Node", "Record"]

Datagram = tuple[str, bytes]
"""(port name, payload). A port is a name; the driver maps it to a socket and its one peer."""


class Record(NamedTuple):
    """One message of a recording.

    Attributes
    ----------
    topic : str
        Where it goes, for example ``plant/truth``.
    t_ns : int
        When it was made, on the node's own clock; the driver maps it to true time.
    body : mapping
        What the topic's JSON schema describes (:mod:`autopilot.link.record`).
    """

    topic: str
    t_ns: int
    body: Mapping[str, Any]


class Node(Protocol):
    """A participant of the network, without I/O. All times are the node's own, integer nanoseconds."""

    def receive(self, port: str, datagram: bytes, now_ns: int) -> None:
        """Take one datagram that arrived on a port. Trusts nothing in it; never raises for its content."""

    def tick(self, now_ns: int) -> None:
        """Do what is due at ``now_ns``. Harmless when nothing is."""

    def next_deadline_ns(self) -> int | None:
        """When ``tick`` wants to be called next, or None for not before another datagram."""

    def outgoing(self) -> list[Datagram]:
        """Take away the datagrams to send, in order."""

    def records(self) -> list[Record]:
        """Take away the records made, in order."""
