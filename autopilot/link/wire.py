"""Frozen message types and MAVLink 2 frames, one datagram at a time; the only importer of pymavlink.

A :class:`Wire` is one end of one link: it numbers the frames it packs and checks the frames it parses.
No parser state outlives a datagram, so a bad or truncated datagram can never swallow the next one.
What is not a well-formed frame of the expected peer, with finite fields and a message of interest, is
counted by kind and dropped.

Field names and units are those of the ``ardupilotmega`` dialect.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from operator import attrgetter
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

__all__ = [
    "AUTOPILOT",
    "PLANT",
    "AoaSsa",
    "Attitude",
    "Heartbeat",
    "HilActuatorControls",
    "Message",
    "NamedValueInt",
    "Reject",
    "ServoOutputRaw",
    "Severity",
    "StatusText",
    "Timesync",
    "VfrHud",
    "Wire",
    "autopilot_heartbeat",
    "frames_of",
    "plant_heartbeat",
    "split_frames",
]

AUTOPILOT = (1, 1)
"""MAVLink system and component of the autopilot."""

PLANT = (1, 25)
"""MAVLink system and component of the plant."""

MAX_DATAGRAM_BYTES = 2048
"""Longest datagram that is looked at; a MAVLink 2 frame has at most 280 bytes."""

U32 = 0xFFFFFFFF
ELEVATOR_CHANNEL = 1
"""Index of the elevator in HIL_ACTUATOR_CONTROLS.controls; servo output 2 in SERVO_OUTPUT_RAW."""

_SIGNED = dialect.MAVLINK_IFLAG_SIGNED


class Reject(StrEnum):
    """Why a frame or a datagram was dropped."""

    OVERSIZE = "oversize"
    NO_FRAME = "no_frame"
    TRUNCATED = "truncated"
    UNKNOWN_ID = "unknown_id"
    UNHANDLED = "unhandled"
    WRONG_SOURCE = "wrong_source"
    MALFORMED = "malformed"
    BAD_CRC = "bad_crc"
    NON_FINITE = "non_finite"


class Severity:
    """MAV_SEVERITY of a STATUSTEXT."""

    ERROR = dialect.MAV_SEVERITY_ERROR
    WARNING = dialect.MAV_SEVERITY_WARNING
    NOTICE = dialect.MAV_SEVERITY_NOTICE
    INFO = dialect.MAV_SEVERITY_INFO


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """HEARTBEAT: MAV_TYPE, MAV_AUTOPILOT, MAV_MODE_FLAG, custom mode, MAV_STATE."""

    type: int
    autopilot: int
    base_mode: int
    custom_mode: int
    system_status: int


@dataclass(frozen=True, slots=True)
class Attitude:
    """ATTITUDE: milliseconds (u32, wraps), radians, radians per second."""

    time_boot_ms: int
    roll: float
    pitch: float
    yaw: float
    rollspeed: float
    pitchspeed: float
    yawspeed: float


@dataclass(frozen=True, slots=True)
class AoaSsa:
    """AOA_SSA: microseconds (u64), angle of attack and sideslip in **degrees**."""

    time_usec: int
    AOA: float
    SSA: float


@dataclass(frozen=True, slots=True)
class VfrHud:
    """VFR_HUD: metres per second, degrees, percent, metres; it carries no time."""

    airspeed: float
    groundspeed: float
    heading: int
    throttle: int
    alt: float
    climb: float


@dataclass(frozen=True, slots=True)
class ServoOutputRaw:
    """SERVO_OUTPUT_RAW: microseconds (u32, wraps) of the sample the command used; elevator pulse in microseconds."""

    time_usec: int
    servo2_raw: int


@dataclass(frozen=True, slots=True)
class HilActuatorControls:
    """HIL_ACTUATOR_CONTROLS: microseconds (u64) of the sample the command used; controls[1] from -1 to 1."""

    time_usec: int
    elevator: float


@dataclass(frozen=True, slots=True)
class NamedValueInt:
    """NAMED_VALUE_INT: milliseconds (u32, wraps), a name of at most 10 characters, a signed 32-bit value."""

    time_boot_ms: int
    name: str
    value: int


@dataclass(frozen=True, slots=True)
class Timesync:
    """TIMESYNC: a request has tc1 = 0; the reply echoes ts1 and puts its own time into tc1 (nanoseconds)."""

    tc1: int
    ts1: int


@dataclass(frozen=True, slots=True)
class StatusText:
    """STATUSTEXT: MAV_SEVERITY and up to 50 characters."""

    severity: int
    text: str


Message = (
    Heartbeat
    | Attitude
    | AoaSsa
    | VfrHud
    | ServoOutputRaw
    | HilActuatorControls
    | NamedValueInt
    | Timesync
    | StatusText
)


@dataclass(frozen=True, slots=True)
class _Codec:
    """How one message type becomes a pymavlink message and comes back."""

    encode: Callable[[Any], Any]
    decode: Callable[[Any], Any]
    floats: tuple[str, ...]


def _plain(message_type: type, native: Any, floats: tuple[str, ...] = ()) -> _Codec:
    """Return the codec of a type whose fields are exactly the dialect's."""
    fields = attrgetter(*native.fieldnames)
    return _Codec(lambda m: native(*fields(m)), lambda m: message_type(*fields(m)), floats)


def _plain_stamped(message_type: type, native: Any, floats: tuple[str, ...] = ()) -> _Codec:
    """Return the codec of a plain type whose first field is a u32 time that wraps."""
    fields = attrgetter(*native.fieldnames[1:])
    first = attrgetter(native.fieldnames[0])
    everything = attrgetter(*native.fieldnames)
    return _Codec(lambda m: native(first(m) & U32, *fields(m)), lambda m: message_type(*everything(m)), floats)


def _encode_heartbeat(m: Heartbeat) -> Any:
    return dialect.MAVLink_heartbeat_message(m.type, m.autopilot, m.base_mode, m.custom_mode, m.system_status, 3)


def _encode_servo(m: ServoOutputRaw) -> Any:
    return dialect.MAVLink_servo_output_raw_message(m.time_usec & U32, 0, 0, m.servo2_raw, 0, 0, 0, 0, 0, 0)


def _encode_hil(m: HilActuatorControls) -> Any:
    controls = [0.0] * 16
    controls[ELEVATOR_CHANNEL] = m.elevator
    return dialect.MAVLink_hil_actuator_controls_message(m.time_usec, controls, 0, 0)


def _decode_hil(m: Any) -> HilActuatorControls:
    return HilActuatorControls(m.time_usec, m.controls[ELEVATOR_CHANNEL])


def _encode_named(m: NamedValueInt) -> Any:
    return dialect.MAVLink_named_value_int_message(m.time_boot_ms & U32, m.name.encode("ascii"), m.value)


def _text(raw: str | bytes) -> str:
    """Return a MAVLink char array as text; what is not ASCII is replaced."""
    if isinstance(raw, bytes):
        raw = raw.decode("ascii", errors="replace")
    return raw.split("\0", 1)[0]


_CODECS: dict[type, _Codec] = {
    Heartbeat: _Codec(
        _encode_heartbeat,
        lambda m: Heartbeat(m.type, m.autopilot, m.base_mode, m.custom_mode, m.system_status),
        (),
    ),
    Attitude: _plain_stamped(
        Attitude,
        dialect.MAVLink_attitude_message,
        ("roll", "pitch", "yaw", "rollspeed", "pitchspeed", "yawspeed"),
    ),
    AoaSsa: _plain(AoaSsa, dialect.MAVLink_aoa_ssa_message, ("AOA", "SSA")),
    VfrHud: _plain(VfrHud, dialect.MAVLink_vfr_hud_message, ("airspeed", "groundspeed", "alt", "climb")),
    ServoOutputRaw: _Codec(_encode_servo, lambda m: ServoOutputRaw(m.time_usec, m.servo2_raw), ()),
    HilActuatorControls: _Codec(_encode_hil, _decode_hil, ("elevator",)),
    NamedValueInt: _Codec(_encode_named, lambda m: NamedValueInt(m.time_boot_ms, _text(m.name), m.value), ()),
    Timesync: _plain(Timesync, dialect.MAVLink_timesync_message),
    StatusText: _Codec(
        lambda m: dialect.MAVLink_statustext_message(m.severity, m.text.encode("ascii", "replace")[:50]),
        lambda m: StatusText(m.severity, _text(m.text)),
        (),
    ),
}

_BY_ID: dict[int, _Codec] = {
    dialect.MAVLINK_MSG_ID_HEARTBEAT: _CODECS[Heartbeat],
    dialect.MAVLINK_MSG_ID_ATTITUDE: _CODECS[Attitude],
    dialect.MAVLINK_MSG_ID_AOA_SSA: _CODECS[AoaSsa],
    dialect.MAVLINK_MSG_ID_VFR_HUD: _CODECS[VfrHud],
    dialect.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW: _CODECS[ServoOutputRaw],
    dialect.MAVLINK_MSG_ID_HIL_ACTUATOR_CONTROLS: _CODECS[HilActuatorControls],
    dialect.MAVLINK_MSG_ID_NAMED_VALUE_INT: _CODECS[NamedValueInt],
    dialect.MAVLINK_MSG_ID_TIMESYNC: _CODECS[Timesync],
    dialect.MAVLINK_MSG_ID_STATUSTEXT: _CODECS[StatusText],
}


class Wire:
    """One end of one MAVLink link.

    Parameters
    ----------
    source : (int, int)
        System and component that sign what is packed here.
    peer : (int, int) or None
        System and component whose frames are accepted; None accepts every source but ``source``.
    """

    def __init__(self, source: tuple[int, int], peer: tuple[int, int] | None) -> None:
        self.source = source
        self.peer = peer
        self.rejects: Counter[Reject] = Counter()
        self.received = 0
        self.sent = 0
        self._mavlink = dialect.MAVLink(None, srcSystem=source[0], srcComponent=source[1])

    def encode(self, message: Message) -> bytes:
        """Pack one message into one frame with the next sequence number."""
        frame: bytes = _CODECS[type(message)].encode(message).pack(self._mavlink)
        self._mavlink.seq = (self._mavlink.seq + 1) % 256
        self.sent += 1
        return frame

    def decode(self, datagram: bytes) -> list[Message]:
        """Return the accepted messages of one datagram, in order; count and drop the rest."""
        if len(datagram) > MAX_DATAGRAM_BYTES:
            self.rejects[Reject.OVERSIZE] += 1
            return []
        frames, leftover = split_frames(datagram)
        if leftover is not None:
            self.rejects[leftover] += 1
        messages = []
        for frame in frames:
            parsed = self._parse(frame)
            if isinstance(parsed, Reject):
                self.rejects[parsed] += 1
            else:
                messages.append(parsed)
        self.received += len(messages)
        return messages

    def _parse(self, frame: bytes) -> Message | Reject:
        """Return one frame's message, or why it is not accepted."""
        if frame[0] == dialect.PROTOCOL_MARKER_V2:
            source = (frame[5], frame[6])
            message_id = int.from_bytes(frame[7:10], "little")
        else:
            source = (frame[3], frame[4])
            message_id = frame[5]
        if message_id not in dialect.mavlink_map:
            return Reject.UNKNOWN_ID
        if source != self.peer if self.peer is not None else source == self.source:
            return Reject.WRONG_SOURCE
        codec = _BY_ID.get(message_id)
        if codec is None:
            return Reject.UNHANDLED
        try:
            native = self._mavlink.decode(bytearray(frame))
        except dialect.MAVError:  # length and flags are checked already: what is left is the checksum
            return Reject.BAD_CRC
        message: Message = codec.decode(native)
        for name in codec.floats:
            if not math.isfinite(getattr(message, name)):
                return Reject.NON_FINITE
        return message


def split_frames(datagram: bytes) -> tuple[list[bytes], Reject | None]:
    """Return the frames of one datagram by their length fields, and what its rest is when it is no frame."""
    frames: list[bytes] = []
    start, end = 0, len(datagram)
    while start < end:
        marker = datagram[start]
        if marker == dialect.PROTOCOL_MARKER_V2:
            if end - start < dialect.HEADER_LEN_V2 + 2:
                return frames, Reject.TRUNCATED
            flags = datagram[start + 2]
            if flags & ~_SIGNED:
                return frames, Reject.MALFORMED
            length = dialect.HEADER_LEN_V2 + datagram[start + 1] + 2
            if flags & _SIGNED:
                length += dialect.MAVLINK_SIGNATURE_BLOCK_LEN
        elif marker == dialect.PROTOCOL_MARKER_V1:
            if end - start < dialect.HEADER_LEN_V1 + 2:
                return frames, Reject.TRUNCATED
            length = dialect.HEADER_LEN_V1 + datagram[start + 1] + 2
        else:
            return frames, Reject.NO_FRAME
        if end - start < length:
            return frames, Reject.TRUNCATED
        frames.append(datagram[start : start + length])
        start += length
    return frames, None


def frames_of(source: tuple[int, int]) -> Callable[[bytes], bool]:
    """Return a test for datagrams that carry a valid frame of ``source``: what a listener latches its peer on."""
    wire = Wire((0, 0), source)
    return lambda datagram: bool(wire.decode(datagram))


def plant_heartbeat() -> Heartbeat:
    """Return the plant's HEARTBEAT: an aircraft without autopilot, so no ground station takes it for a vehicle."""
    return Heartbeat(dialect.MAV_TYPE_FIXED_WING, dialect.MAV_AUTOPILOT_INVALID, 0, 0, dialect.MAV_STATE_ACTIVE)


def autopilot_heartbeat(*, tracking: bool, degraded: bool) -> Heartbeat:
    """Return the autopilot's HEARTBEAT.

    Parameters
    ----------
    tracking : bool
        Whether the control law has the elevator.
    degraded : bool
        Whether failsafe has it.
    """
    base_mode = dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | dialect.MAV_MODE_FLAG_SAFETY_ARMED
    if tracking:
        base_mode |= dialect.MAV_MODE_FLAG_STABILIZE_ENABLED
    state = dialect.MAV_STATE_CRITICAL if degraded else dialect.MAV_STATE_ACTIVE
    return Heartbeat(dialect.MAV_TYPE_FIXED_WING, dialect.MAV_AUTOPILOT_GENERIC, base_mode, 0, state)
