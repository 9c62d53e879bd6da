"""Frozen message types and MAVLink 2 frames, one datagram at a time; the only importer of pymavlink.

A :class:`Wire` is one end of one link: it numbers the frames it packs and checks the frames it parses.
No parser state outlives a datagram, so a bad or truncated datagram can never swallow the next one.
What is not a well-formed frame of the expected peer, with finite fields and a message of interest, is
counted by kind and dropped.

Ids, payload formats and CRC extras are the tables of pymavlink's ``ardupilotmega`` dialect. Its stateful
``MAVLink`` object is not used: it keeps a stream's state across datagrams, does not advance the sequence
number when packing, and takes about three times as long. Field names and units are the dialect's.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import ardupilotmega as dialect

__all__ = [
    "AUTOPILOT",
    "PLANT",
    "AoaSsa",
    "Attitude",
    "Heartbeat",
    "HilActuatorControls",
    "Message",
    "NamedValueFloat",
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
class NamedValueFloat:
    """NAMED_VALUE_FLOAT: milliseconds (u32, wraps), a name of at most 10 characters, a finite 32-bit float."""

    time_boot_ms: int
    name: str
    value: float


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
    | NamedValueFloat
    | NamedValueInt
    | Timesync
    | StatusText
)


@dataclass(frozen=True, slots=True)
class _Codec:
    """How one message type becomes a payload and comes back.

    Attributes
    ----------
    native : type
        The dialect's class: id, payload format, CRC extra.
    values : callable
        The message's values in the order of the payload.
    message : callable
        The message of such values.
    floats : tuple of str
        Fields that must be finite.
    """

    native: Any
    values: Callable[[Any], tuple[Any, ...]]
    message: Callable[[tuple[Any, ...]], Any]
    floats: tuple[str, ...] = ()


_ATTITUDE_FLOATS = ("roll", "pitch", "yaw", "rollspeed", "pitchspeed", "yawspeed")
_NO_SERVOS = (0,) * 8
_NO_CONTROLS = (0.0,) * 16


def _text(raw: bytes) -> str:
    """Return a MAVLink char array as text; what is not ASCII is replaced."""
    return raw.split(b"\0", 1)[0].decode("ascii", errors="replace")


_CODECS: dict[type, _Codec] = {
    Heartbeat: _Codec(
        dialect.MAVLink_heartbeat_message,
        lambda m: (m.custom_mode, m.type, m.autopilot, m.base_mode, m.system_status, 3),
        lambda v: Heartbeat(v[1], v[2], v[3], v[0], v[4]),
    ),
    Attitude: _Codec(
        dialect.MAVLink_attitude_message,
        lambda m: (m.time_boot_ms & U32, m.roll, m.pitch, m.yaw, m.rollspeed, m.pitchspeed, m.yawspeed),
        lambda v: Attitude(*v),
        _ATTITUDE_FLOATS,
    ),
    AoaSsa: _Codec(
        dialect.MAVLink_aoa_ssa_message,
        lambda m: (m.time_usec, m.AOA, m.SSA),
        lambda v: AoaSsa(*v),
        ("AOA", "SSA"),
    ),
    VfrHud: _Codec(
        dialect.MAVLink_vfr_hud_message,
        lambda m: (m.airspeed, m.groundspeed, m.alt, m.climb, m.heading, m.throttle),
        lambda v: VfrHud(v[0], v[1], v[4], v[5], v[2], v[3]),
        ("airspeed", "groundspeed", "alt", "climb"),
    ),
    ServoOutputRaw: _Codec(
        dialect.MAVLink_servo_output_raw_message,
        lambda m: (m.time_usec & U32, 0, m.servo2_raw, 0, 0, 0, 0, 0, 0, 0, *_NO_SERVOS),
        lambda v: ServoOutputRaw(v[0], v[2]),
    ),
    HilActuatorControls: _Codec(
        dialect.MAVLink_hil_actuator_controls_message,
        lambda m: (m.time_usec, 0, 0.0, m.elevator, *_NO_CONTROLS[2:], 0),
        lambda v: HilActuatorControls(v[0], v[2 + ELEVATOR_CHANNEL]),
        ("elevator",),
    ),
    NamedValueFloat: _Codec(
        dialect.MAVLink_named_value_float_message,
        lambda m: (m.time_boot_ms & U32, m.value, m.name.encode("ascii")),
        lambda v: NamedValueFloat(v[0], _text(v[2]), v[1]),
        ("value",),
    ),
    NamedValueInt: _Codec(
        dialect.MAVLink_named_value_int_message,
        lambda m: (m.time_boot_ms & U32, m.value, m.name.encode("ascii")),
        lambda v: NamedValueInt(v[0], _text(v[2]), v[1]),
    ),
    Timesync: _Codec(
        dialect.MAVLink_timesync_message,
        lambda m: (m.tc1, m.ts1),
        lambda v: Timesync(v[0], v[1]),
    ),
    StatusText: _Codec(
        dialect.MAVLink_statustext_message,
        lambda m: (m.severity, m.text.encode("ascii", "replace")[:50], 0, 0),
        lambda v: StatusText(v[0], _text(v[1])),
    ),
}

_BY_ID: dict[int, _Codec] = {codec.native.id: codec for codec in _CODECS.values()}
_HEADER = struct.Struct("<BBBBBBBHB")


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
        self._sequence = 0

    def encode(self, message: Message) -> bytes:
        """Pack one message into one frame with the next sequence number."""
        codec = _CODECS[type(message)]
        native = codec.native
        payload = native.unpacker.pack(*codec.values(message))
        payload = payload.rstrip(b"\0") or payload[:1]
        system, component = self.source
        header = _HEADER.pack(
            dialect.PROTOCOL_MARKER_V2,
            len(payload),
            0,
            0,
            self._sequence,
            system,
            component,
            native.id & 0xFFFF,
            native.id >> 16,
        )
        self._sequence = (self._sequence + 1) % 256
        self.sent += 1
        body = header + payload
        return body + _crc(body[1:], native.crc_extra)

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
        native = codec.native
        start = dialect.HEADER_LEN_V2 if frame[0] == dialect.PROTOCOL_MARKER_V2 else dialect.HEADER_LEN_V1
        end = start + frame[1]
        if _crc(frame[1:end], native.crc_extra) != frame[end : end + 2]:
            return Reject.BAD_CRC
        size = native.unpacker.size
        payload = frame[start:end].ljust(size, b"\0")[:size]  # trailing zeros are not sent; extensions may follow
        message: Message = codec.message(native.unpacker.unpack(payload))
        for name in codec.floats:
            if not math.isfinite(getattr(message, name)):
                return Reject.NON_FINITE
        return message


def _crc(body: bytes, crc_extra: int) -> bytes:
    """Return the checksum of a frame without its marker: CRC-16/MCRF4XX, the message's CRC extra included."""
    crc: int = mcrf4xx(body + bytes((crc_extra,)))
    return crc.to_bytes(2, "little")


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
