"""What a ground station sees: heartbeat, attitude, servo, delay and messages, as system 1, component 1.

Ground stations talk to the autopilot only; it repeats what they want to see from the plant under its own
name and on its own clock.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from autopilot.link.clock import NS_PER_MS, NS_PER_S, NS_PER_US, following
from autopilot.link.node import Datagram
from autopilot.link.wire import (
    AUTOPILOT,
    AoaSsa,
    Attitude,
    Message,
    NamedValueFloat,
    NamedValueInt,
    ServoOutputRaw,
    Severity,
    StatusText,
    Wire,
    autopilot_heartbeat,
)
from gains.model import GainLaw, Schedule
from gains.verify import Verification

__all__ = ["Vehicle", "banner"]

HEARTBEAT_NS = NS_PER_S
MAX_WAITING = 256
"""Messages that may wait for the next tick; further ones are refused and counted."""
MAX_TEXTS = 32
"""Texts that may wait when nothing else may."""
MAX_TEXT = 50
"""Characters that one STATUSTEXT holds."""
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

    Attributes
    ----------
    refused : int
        Messages dropped because too many waited.
    """

    ports: tuple[str, ...]
    banner: list[StatusText] = field(default_factory=list)
    wires: dict[str, Wire] = field(default_factory=dict)
    refused: int = 0
    _out: list[Datagram] = field(default_factory=list)
    _waiting: list[Message] = field(default_factory=list)
    _heard: set[str] = field(default_factory=set)
    _next_heartbeat_ns: int | None = None

    def __post_init__(self) -> None:
        """Open one wire per ground station; any system but our own may speak."""
        assert len(self.banner) <= MAX_BANNER
        self.wires = {port: Wire(AUTOPILOT, None) for port in self.ports}

    def receive(self, port: str, datagram: bytes) -> bool:
        """Take a ground station's datagram; return whether it is one.

        Its commands are not served yet; they are counted by the wire.
        """
        if not self.wires[port].decode(datagram):
            return False
        if port not in self._heard:
            self._heard.add(port)
            for text in self.banner:
                self._out.append((port, self.wires[port].encode(text)))
        return True

    def tick(self, now_ns: int, *, tracking: bool, degraded: bool) -> None:
        """Send what waits, and the heartbeat when it is due, with the banner before the first one."""
        if self._next_heartbeat_ns is None:
            self._next_heartbeat_ns = now_ns
            for text in self.banner:
                self._send(text)
        waiting, self._waiting = self._waiting, []
        for message in waiting:
            self._send(message)
        if now_ns >= self._next_heartbeat_ns:
            self._next_heartbeat_ns = following(self._next_heartbeat_ns, HEARTBEAT_NS, now_ns)
            self._send(autopilot_heartbeat(tracking=tracking, degraded=degraded))

    def next_deadline_ns(self) -> int | None:
        """Return when the next heartbeat is due; what waits goes with any earlier tick."""
        return self._next_heartbeat_ns

    def show(self, message: Message, now_ns: int) -> None:
        """Repeat a message under our name, on our clock, at the next tick."""
        match message:
            case Attitude(_, roll, pitch, yaw, rollspeed, pitchspeed, yawspeed):
                message = Attitude(now_ns // NS_PER_MS, roll, pitch, yaw, rollspeed, pitchspeed, yawspeed)
            case AoaSsa():
                message = AoaSsa(now_ns // NS_PER_US, message.AOA, message.SSA)
            case ServoOutputRaw():
                message = ServoOutputRaw(now_ns // NS_PER_US, message.servo2_raw)
            case NamedValueInt():
                message = NamedValueInt(now_ns // NS_PER_MS, message.name, message.value)
            case NamedValueFloat():
                message = NamedValueFloat(now_ns // NS_PER_MS, message.name, message.value)
            case _:
                pass
        self._wait(message)

    def say(self, severity: int, text: str) -> None:
        """Send a STATUSTEXT to every ground station, at the next tick."""
        self._wait(StatusText(severity, text), MAX_WAITING + MAX_TEXTS)

    def _wait(self, message: Message, limit: int = MAX_WAITING) -> None:
        if len(self._waiting) < limit:
            self._waiting.append(message)
        else:
            self.refused += 1

    def _send(self, message: Message) -> None:
        for port, wire in self.wires.items():
            self._out.append((port, wire.encode(message)))

    def outgoing(self) -> list[Datagram]:
        """Take away what is to be sent."""
        out, self._out = self._out, []
        return out


def banner(gains: GainLaw, proof: Verification, conservative: Verification | None = None) -> list[StatusText]:
    """Return what a ground station must know at start: what of it all is proved, and the windows of a schedule.

    Parameters
    ----------
    gains : Gains or Schedule
        What flies.
    proof : Verification
        Of its certificate.
    conservative : Verification, optional
        Of the certificate of its conservative gains.
    """
    what = f"{'schedule' if isinstance(gains, Schedule) else 'gains'} {gains.name}"
    if proof.passed:
        fifo = gains.certificate is not None and gains.certificate.get("transitions") == "fifo"
        texts = [StatusText(Severity.INFO, f"certificate verified{' (fifo)' if fifo else ''}: {what}")]
    else:
        texts = [StatusText(Severity.WARNING, f"no verified certificate: {what}")]
    if isinstance(gains, Schedule):
        windows = ", ".join(f"{each.d_min}..{each.d_max}" for each in gains.sets)
        text = f"{len(gains.sets)} gain sets: delay {windows}"
        overall = f"{len(gains.sets)} gain sets: delay {gains.d_min} to {gains.d_max}"
        texts.append(StatusText(Severity.INFO, text if len(text) <= MAX_TEXT else overall))
    wide = gains.conservative
    if wide is not None and conservative is not None:
        severity = Severity.INFO if conservative.passed else Severity.WARNING
        unproved = "" if conservative.passed else "unproved "
        texts.append(StatusText(severity, f"{unproved}conservative {wide.name}: delay {wide.d_min}..{wide.d_max}"))
    return texts
