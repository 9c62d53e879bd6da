"""The autopilot as its ground stations see it: system 1, component 1, a fixed wing.

Ground stations talk to the autopilot only. It shows them what the plant says under its own name and on its own clock,
each message at the rate that each station has asked for, answers what they ask, and takes their commands. Nothing here
waits for a station, and what one datagram, one station or one tick can cost is bounded.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from autopilot.commander import Commander
from autopilot.config import Home
from autopilot.ground import commands
from autopilot.ground.parameters import Parameters
from autopilot.ground.position import Position
from autopilot.ground.services import ANSWERS, autopilot_version
from autopilot.ground.streams import GROUPS, RATE_PARAMETERS, Streams, interval_of
from autopilot.link.clock import NS_PER_MS, NS_PER_S, NS_PER_US, following
from autopilot.link.groundmessages import (
    CommandAck,
    CommandInt,
    CommandLong,
    CurrentMode,
    ExtendedSysState,
    GlobalPositionInt,
    HomePosition,
    ManualControl,
    ParamRequestList,
    ParamRequestRead,
    ParamSet,
    RcChannelsOverride,
    RequestDataStream,
    SensorBit,
    SetAttitudeTarget,
    SetMode,
    SysStatus,
)
from autopilot.link.node import Datagram
from autopilot.link.wire import (
    AUTOPILOT,
    GROUND_MESSAGES,
    AoaSsa,
    Attitude,
    Message,
    NamedValueFloat,
    NamedValueInt,
    Seal,
    ServoOutputRaw,
    Severity,
    Source,
    StatusText,
    VfrHud,
    Wire,
    autopilot_heartbeat,
)
from gains.model import GainLaw, Schedule
from gains.verify import Verification

__all__ = ["Vehicle", "banner"]

HEARTBEAT_NS = NS_PER_S
MAX_WAITING = 256
"""Messages that may wait for one station; further ones are refused and counted."""
MAX_TEXTS = 32
"""Texts that may wait when nothing else may."""
MAX_PER_TICK = 16
"""Waiting messages that one tick sends to one station."""
PARAMETERS_NS = 10 * NS_PER_MS
PARAMETERS_PER_TICK = 4
"""A list of parameters goes out in portions, so that no station and no link is flooded."""
MAX_TEXT = 50
"""Characters that one STATUSTEXT holds."""
MAX_BANNER = 8
"""Start-up messages that a ground station is told when it first speaks."""
IN_AIR = 2
"""MAV_LANDED_STATE."""
NO_BATTERY_MV, NO_BATTERY_CA, NO_BATTERY_PERCENT = 65535, -1, -1

_NAMED = (NamedValueInt, NamedValueFloat)


class _Shown(NamedTuple):
    """The latest message of a kind, and when it was; what a station has seen is known by this very object."""

    message: Message
    at_ns: int


@dataclass(slots=True, eq=False)
class _Station:
    """One ground station: its wire, what it wants to see, and what waits for it."""

    port: str
    wire: Wire
    streams: Streams
    waiting: deque[Message] = field(default_factory=deque)
    news: dict[type, None] = field(default_factory=dict)
    seen: defaultdict[type, dict[str, _Shown]] = field(default_factory=lambda: defaultdict(dict))
    heard: bool = False
    next_parameters_ns: int | None = None


class Vehicle:
    """What ground stations see, and what their messages do.

    Parameters
    ----------
    ports : sequence of str
        One port per ground station.
    banner : list of StatusText
        What a ground station is told at start and when it first speaks.
    commander : Commander
        Takes arming, modes, sticks and setpoints.
    parameters : Parameters
        Answers the parameter protocol.
    storage : Storage
        Parameters on disk.
    home : Home
        Where the map begins.
    providers : mapping
        Message type to a function of the time that returns the message as it is now, or None.
    seals : mapping
        Port to what signs and checks its frames.

    Attributes
    ----------
    refused : int
        Messages dropped because too many waited.
    elsewhere : int
        Messages that were addressed to another vehicle or component.
    """

    def __init__(
        self,
        ports: Iterable[str],
        banner: list[StatusText],
        commander: Commander,
        parameters: Parameters,
        storage: commands.Storage,
        home: Home,
        providers: Mapping[type, Callable[[int], Message | None]],
        seals: Mapping[str, Seal],
    ) -> None:
        assert len(banner) <= MAX_BANNER
        self.banner = banner
        self.commander = commander
        self.parameters = parameters
        self.position = Position(home)
        self.refused = 0
        self.elsewhere = 0
        autopilot_version()  # looked up now, not when it is asked for in flight
        self._storage = storage
        self._values = parameters.values
        rates = {message: self._values[name] for name, message in RATE_PARAMETERS.items()}
        self._providers: dict[type, Callable[[int], Message | None]] = {
            SysStatus: self._sys_status,
            GlobalPositionInt: self.position.message,
            HomePosition: self.position.home_message,
            CurrentMode: lambda _now_ns: CurrentMode(0, self.commander.mode, self.commander.mode),
            ExtendedSysState: lambda _now_ns: ExtendedSysState(0, IN_AIR),
            **providers,
        }
        self._stations = {
            port: _Station(
                port, Wire(AUTOPILOT, None, GROUND_MESSAGES, seals.get(port)), Streams(rates, self._providers)
            )
            for port in ports
        }
        self._shown: defaultdict[type, dict[str, _Shown]] = defaultdict(dict)
        self._out: list[Datagram] = []
        self._next_heartbeat_ns: int | None = None
        self._deadline_ns: int | None = None

    @property
    def ports(self) -> tuple[str, ...]:
        """The ports of the ground stations."""
        return tuple(self._stations)

    @property
    def wires(self) -> dict[str, Wire]:
        """The wire of each port."""
        return {port: station.wire for port, station in self._stations.items()}

    # What comes from a ground station

    def receive(self, port: str, datagram: bytes, now_ns: int) -> bool:
        """Take a ground station's datagram; return whether it is one."""
        self._deadline_ns = None
        station = self._stations[port]
        messages = station.wire.decode_from(datagram)
        if messages and not station.heard:
            station.heard = True
            for text in self.banner:
                self._wait(station, text)
        for source, message in messages:
            if _addressed(message):
                self._serve(station, source, message, now_ns)
            else:
                self.elsewhere += 1
        return bool(messages)

    def _serve(self, station: _Station, source: Source, message: Message, now_ns: int) -> None:
        match message:
            case CommandLong() | CommandInt():
                self._command(station, source, message, now_ns)
            case ParamRequestList() | ParamRequestRead() | ParamSet():
                self._parameter(station, source, message, now_ns)
            case SetAttitudeTarget():
                self.commander.attitude_target(message, (station.port, *source), now_ns)
            case ManualControl():
                self.commander.manual_control(message, (station.port, *source), now_ns)
            case RcChannelsOverride():
                self.commander.rc_override(message, (station.port, *source), now_ns)
            case RequestDataStream():
                _request_data_stream(station.streams, message, now_ns)
            case SetMode():
                mode = commands.mode_of(message.custom_mode)
                if mode is not None and message.base_mode & 1:
                    self.commander.set_mode(mode, now_ns)
            case _:
                answer = ANSWERS.get(type(message))
                reply = None if answer is None else answer(message, source, now_ns)
                if reply is not None:
                    self._wait(station, reply)

    def _command(self, station: _Station, source: Source, command: CommandLong | CommandInt, now_ns: int) -> None:
        """Carry out a command; the acknowledgement goes before what was asked for."""
        handled = commands.handle(command, now_ns, self.commander, station.streams, self._storage, self.current)
        self._wait(station, CommandAck(command.command, handled.result, *source))
        for message in handled.messages:
            self._wait(station, message)
        for text in handled.texts:
            self.say(Severity.CRITICAL, text)

    def _parameter(
        self, station: _Station, source: Source, message: ParamRequestList | ParamRequestRead | ParamSet, now_ns: int
    ) -> None:
        if isinstance(message, ParamRequestList):
            self.parameters.request_list(station.port)
            if station.next_parameters_ns is None:
                station.next_parameters_ns = now_ns
            return
        answer = self.parameters.handle(message, source, now_ns)
        for each in answer.to_asker:
            self._wait(station, each)
        for each in answer.to_all:
            self._wait_all(each)
        if answer.reason is not None:
            self.say(Severity.WARNING, answer.reason)

    # What ground stations see

    def show(self, message: Message, now_ns: int) -> None:
        """Take note of the latest message of its kind; each station sees it at its rate."""
        if isinstance(message, VfrHud):
            self.position.flown(message, now_ns)
        name = message.name if isinstance(message, _NAMED) else ""
        kind = type(message)
        self._shown[kind][name] = _Shown(message, now_ns)
        for station in self._stations.values():
            station.news[kind] = None

    def say(self, severity: int, text: str) -> None:
        """Send a STATUSTEXT to every ground station; there is room for it when nothing else may wait."""
        for station in self._stations.values():
            self._wait(station, StatusText(severity, text), MAX_WAITING + MAX_TEXTS)

    def current(self, message: type, now_ns: int) -> Iterable[Message]:
        """Return the messages of a type as they are now: several of a type with names, none of one unknown."""
        provide = self._providers.get(message)
        if provide is not None:
            found = provide(now_ns)
            return () if found is None else (found,)
        return [_on_our_clock(shown) for shown in self._shown[message].values()]

    # Time

    def tick(self, now_ns: int, *, degraded: bool) -> None:
        """Send what is due: what waits, streams, and the heartbeat, with the banner before the first one."""
        self._deadline_ns = None
        if self._next_heartbeat_ns is None:
            self._next_heartbeat_ns = now_ns
            self._start(now_ns)
        if self.parameters.values is not self._values:
            self._follow_values(now_ns)
        beat = now_ns >= self._next_heartbeat_ns
        if beat:
            self._next_heartbeat_ns = following(self._next_heartbeat_ns, HEARTBEAT_NS, now_ns)
        for station in self._stations.values():
            if beat:
                self._send(station, self._heartbeat(degraded=degraded))
            self._tick_station(station, now_ns)

    def _start(self, now_ns: int) -> None:
        for station in self._stations.values():
            station.streams.start(now_ns)
            self._send(station, self.position.home_message(now_ns))
            for text in self.banner:
                self._send(station, text)

    def _tick_station(self, station: _Station, now_ns: int) -> None:
        """Send one station what it is due, so much at once that no other waits long."""
        streams = station.streams
        for message in streams.to_make(now_ns):
            streams.sent(message, now_ns)
            for found in self.current(message, now_ns):
                self._send(station, found)
        for message in [each for each in station.news if streams.is_due(each, now_ns)]:
            streams.sent(message, now_ns)
            self._send_news(station, message)
        if station.next_parameters_ns is not None and now_ns >= station.next_parameters_ns:
            self._send_parameters(station, now_ns)
        for _ in range(min(MAX_PER_TICK, len(station.waiting))):
            self._send(station, station.waiting.popleft())

    def next_deadline_ns(self) -> int | None:
        """Return when ``tick`` is wanted: at once (0) while something waits for a station."""
        if self._next_heartbeat_ns is None:
            return None
        if self._deadline_ns is None:  # asked for much more often than it changes
            self._deadline_ns = self._earliest_ns(self._next_heartbeat_ns)
        return self._deadline_ns

    def _earliest_ns(self, earliest_ns: int) -> int:
        for station in self._stations.values():
            if station.waiting:
                return 0
            for due_ns in (station.streams.next_ns, station.next_parameters_ns):
                if due_ns is not None and due_ns < earliest_ns:
                    earliest_ns = due_ns
        return earliest_ns

    def _heartbeat(self, *, degraded: bool) -> Message:
        commander = self.commander
        mode = commander.mode
        return autopilot_heartbeat(armed=commander.armed, custom_mode=mode, flags=mode.flags, degraded=degraded)

    def _send_news(self, station: _Station, message: type) -> None:
        """Send what a station has not seen of a type: the latest, or the latest of each name."""
        del station.news[message]
        seen = station.seen[message]
        for name, shown in self._shown[message].items():
            if seen.get(name) is not shown:
                seen[name] = shown
                self._send(station, _on_our_clock(shown))

    def _send_parameters(self, station: _Station, now_ns: int) -> None:
        for value in self.parameters.next_values(station.port, PARAMETERS_PER_TICK):
            self._send(station, value)
        more = self.parameters.pending(station.port)
        station.next_parameters_ns = now_ns + PARAMETERS_NS if more else None

    def _follow_values(self, now_ns: int) -> None:
        """Take over default rates that were changed by parameters, and let stations know what changed unasked."""
        self._values = self.parameters.values
        for name, message in RATE_PARAMETERS.items():
            for station in self._stations.values():
                station.streams.set_default(message, self._values[name], now_ns)
        for station in self._stations.values():
            if station.next_parameters_ns is None and self.parameters.pending(station.port):
                station.next_parameters_ns = now_ns

    def _sys_status(self, now_ns: int) -> SysStatus:
        """Return SYS_STATUS; MAVProxy takes a geofence that is not healthy for a breach, even where there is none."""
        present = (
            SensorBit.GYRO
            | SensorBit.ANGULAR_RATE_CONTROL
            | SensorBit.ATTITUDE_STABILIZATION
            | SensorBit.MOTOR_OUTPUTS
            | SensorBit.AHRS
            | SensorBit.PREARM_CHECK
        )
        health = present if not self.commander.reasons(now_ns) else present & ~SensorBit.PREARM_CHECK
        bits = int(present), int(present), int(health | SensorBit.GEOFENCE)
        return SysStatus(*bits, 0, NO_BATTERY_MV, NO_BATTERY_CA, NO_BATTERY_PERCENT, 0, 0)

    # Sending

    def _wait_all(self, message: Message) -> None:
        for station in self._stations.values():
            self._wait(station, message)

    def _wait(self, station: _Station, message: Message, limit: int = MAX_WAITING) -> None:
        if len(station.waiting) < limit:
            station.waiting.append(message)
            self._deadline_ns = None
        else:
            self.refused += 1

    def _send(self, station: _Station, message: Message) -> None:
        self._out.append((station.port, station.wire.encode(message)))

    def outgoing(self) -> list[Datagram]:
        """Take away what is to be sent."""
        out, self._out = self._out, []
        return out


def _addressed(message: Message) -> bool:
    """Return whether a message is for everybody, or for system 1 and component 1 or all its components."""
    if isinstance(message, ManualControl):
        return message.target in (0, AUTOPILOT[0])
    system, component = getattr(message, "target_system", 0), getattr(message, "target_component", 0)
    answer = type(message) in ANSWERS and not hasattr(message, "count")
    return system in (0, AUTOPILOT[0]) and (component in (0, AUTOPILOT[1]) or (answer and system == 0))


def _request_data_stream(streams: Streams, asked: RequestDataStream, now_ns: int) -> None:
    """Set the rate of a group of messages, or of all for group 0, as ArduPilot does."""
    if asked.req_stream_id == 0:
        messages = [message for group in GROUPS.values() for message in group]
    else:
        messages = list(GROUPS.get(asked.req_stream_id, ()))
    interval_ns = interval_of(asked.req_message_rate) if asked.start_stop else None
    for message in messages:
        streams.ask(message, interval_ns, now_ns)


def _on_our_clock(shown: _Shown) -> Message:
    """Return a message with the time at which it was shown."""
    message, at_ns = shown
    match message:
        case Attitude(_, roll, pitch, yaw, rollspeed, pitchspeed, yawspeed):
            return Attitude(at_ns // NS_PER_MS, roll, pitch, yaw, rollspeed, pitchspeed, yawspeed)
        case AoaSsa():
            return AoaSsa(at_ns // NS_PER_US, message.AOA, message.SSA)
        case ServoOutputRaw():
            return ServoOutputRaw(at_ns // NS_PER_US, message.servo2_raw)
        case NamedValueInt():
            return NamedValueInt(at_ns // NS_PER_MS, message.name, message.value)
        case NamedValueFloat():
            return NamedValueFloat(at_ns // NS_PER_MS, message.name, message.value)
        case _:
            return message


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
