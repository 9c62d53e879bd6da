"""What a ground station sees: heartbeat, attitude, servo, delay and messages, as system 1, component 1.

Ground stations talk to the autopilot only; it repeats what they want to see from the plant under its own
name and on its own clock.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from autopilot.link.clock import NS_PER_MS, NS_PER_S, NS_PER_US
from autopilot.link.node import Datagram
from autopilot.link.wire import (
    AUTOPILOT,
    AoaSsa,
    Attitude,
    Message,
    NamedValueInt,
    ServoOutputRaw,
    StatusText,
    VfrHud,
    Wire,
    autopilot_heartbeat,
)

__all__ = ["Vehicle"]

HEARTBEAT_NS = NS_PER_S
MAX_BANNER = 8
"""Start-up messages that a ground station is told when it first speaks."""


@dataclass(slots=True)
class Vehicle:
    """The autopilot as its ground stations see it.

    Parameters
    ----------
    ports : tuple of str
        One port per ground station.
    banner : list of StatusText
        What a ground station is told at start and when it first speaks.
    """

    ports: tuple[str, ...]
    banner: list[StatusText] = field(default_factory=list)
    wires: dict[str, Wire] = field(default_factory=dict)
    _out: list[Datagram] = field(default_factory=list)
    _heard: set[str] = field(default_factory=set)
    _next_heartbeat_ns: int | None = None
    _attitude: Attitude | None = None
    _aoa: AoaSsa | None = None

    def __post_init__(self) -> None:
        """Open one wire per ground station; any system but our own may speak."""
        assert len(self.banner) <= MAX_BANNER
        self.wires = {port: Wire(AUTOPILOT, None) for port in self.ports}

    def receive(self, port: str, datagram: bytes) -> None:
        """Take a ground station's datagram. Its commands are not served yet; they are counted by the wire."""
        if self.wires[port].decode(datagram) and port not in self._heard:
            self._heard.add(port)
            for text in self.banner:
                self._out.append((port, self.wires[port].encode(text)))

    def tick(self, now_ns: int, *, tracking: bool, degraded: bool) -> None:
        """Send the heartbeat when it is due, and the banner with the first one."""
        if self._next_heartbeat_ns is None:
            self._next_heartbeat_ns = now_ns
            for text in self.banner:
                self.send(text)
        if now_ns >= self._next_heartbeat_ns:
            self._next_heartbeat_ns += HEARTBEAT_NS
            self.send(autopilot_heartbeat(tracking=tracking, degraded=degraded))

    def next_deadline_ns(self) -> int | None:
        """Return when the next heartbeat is due."""
        return self._next_heartbeat_ns

    def saw(self, message: Message, now_ns: int) -> None:
        """Take note of a message of the plant and repeat what is shown at once."""
        if isinstance(message, Attitude):
            self._attitude = message
        elif isinstance(message, AoaSsa):
            self._aoa = message
        elif isinstance(message, VfrHud):
            self.send(message)
        elif isinstance(message, NamedValueInt):
            self.send(replace(message, time_boot_ms=now_ns // NS_PER_MS))

    def flew(self, pulse_us: int, now_ns: int) -> None:
        """Show the newest attitude and angle of attack, and the elevator pulse just commanded."""
        if self._attitude is not None:
            self.send(replace(self._attitude, time_boot_ms=now_ns // NS_PER_MS))
        if self._aoa is not None:
            self.send(replace(self._aoa, time_usec=now_ns // NS_PER_US))
        self.send(ServoOutputRaw(now_ns // NS_PER_US, pulse_us))

    def say(self, severity: int, text: str) -> None:
        """Send a STATUSTEXT to every ground station."""
        self.send(StatusText(severity, text))

    def send(self, message: Message) -> None:
        """Send a message to every ground station."""
        for port, wire in self.wires.items():
            self._out.append((port, wire.encode(message)))

    def outgoing(self) -> list[Datagram]:
        """Take away what is to be sent."""
        out, self._out = self._out, []
        return out
