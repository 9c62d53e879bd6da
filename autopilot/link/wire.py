"""MAVLink 2 frames of frozen messages, one datagram at a time; the only importer of pymavlink.

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
from dataclasses import dataclass, fields
from enum import StrEnum
from typing import Any, Protocol

from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import ardupilotmega as dialect

from autopilot.link import groundmessages as ground
from autopilot.link.messages import (
    AoaSsa,
    Attitude,
    ControlMessage,
    Heartbeat,
    HilActuatorControls,
    NamedValueFloat,
    NamedValueInt,
    ServoOutputRaw,
    Severity,
    StatusText,
    Timesync,
    VfrHud,
)

__all__ = [
    "AUTOPILOT",
    "CONTROL_MESSAGES",
    "GROUND_MESSAGES",
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
    "Source",
    "StatusText",
    "Timesync",
    "VfrHud",
    "Wire",
    "autopilot_heartbeat",
    "frames_of",
    "plant_heartbeat",
    "split_frames",
]

Source = tuple[int, int]
"""System and component."""

Message = ControlMessage | ground.GroundMessage

AUTOPILOT = (1, 1)
"""MAVLink system and component of the autopilot."""

PLANT = (1, 25)
"""MAVLink system and component of the plant."""

MAX_DATAGRAM_BYTES = 2048
"""Longest datagram that is looked at; a MAVLink 2 frame has at most 280 bytes."""

MAX_FRAMES = 64
"""Frames of one datagram that are looked at: what one datagram costs is bounded."""

U32 = 0xFFFFFFFF
ELEVATOR_CHANNEL = 1
"""Index of the elevator in HIL_ACTUATOR_CONTROLS.controls; servo output 2 in SERVO_OUTPUT_RAW."""

_SIGNED = dialect.MAVLINK_IFLAG_SIGNED

ACCEPTED = "accepted"
"""What a seal says of a frame that it accepts."""


class Reject(StrEnum):
    """Why a frame or a datagram was dropped."""

    OVERSIZE = "oversize"
    EXCESS = "excess"
    NO_FRAME = "no_frame"
    TRUNCATED = "truncated"
    UNKNOWN_ID = "unknown_id"
    UNHANDLED = "unhandled"
    WRONG_SOURCE = "wrong_source"
    MALFORMED = "malformed"
    BAD_CRC = "bad_crc"
    NON_FINITE = "non_finite"
    UNSIGNED = "unsigned"
    BAD_SIGNATURE = "bad_signature"
    REPLAYED = "replayed"
    TOO_OLD = "timestamp_too_old"
    TOO_NEW = "timestamp_too_new"
    UNRESERVED = "timestamp_unreserved"
    WRONG_LINK = "wrong_link"
    MALFORMED_SIGNATURE = "malformed_signature"
    TOO_MANY_STREAMS = "too_many_streams"


class Seal(Protocol):
    """Signs and checks the frames of one link (:mod:`autopilot.link.signing`)."""

    def sign(self, frame: bytes) -> bytes:
        """Return a frame that carries the flag and the checksum already, with its signature."""

    def check(self, frame: bytes) -> StrEnum:
        """Return ``accepted``, or why not in a word of :class:`Reject`; remember what is accepted."""

    def would_accept(self, frame: bytes) -> bool:
        """Return whether a frame is genuine and new, and remember nothing."""

    def tick(self, now_ns: int) -> None:
        """Take the own time."""


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


@dataclass(frozen=True, slots=True)
class _NewMessage:
    """A message of the common dialect that pymavlink's ardupilotmega does not have yet: its row of the same tables."""

    id: int
    crc_extra: int
    unpacker: struct.Struct
    ordered_fieldnames: tuple[str, ...]
    array_lengths: tuple[int, ...]


_AVAILABLE_MODES = _NewMessage(
    435,
    134,
    struct.Struct("<IIBBB35s"),
    ("custom_mode", "properties", "number_modes", "mode_index", "standard_mode", "mode_name"),
    (0, 0, 0, 0, 0, 35),
)
_CURRENT_MODE = _NewMessage(
    436, 193, struct.Struct("<IIB"), ("custom_mode", "intended_custom_mode", "standard_mode"), (0, 0, 0)
)


def _by_name(message: type, native: Any) -> _Codec:
    """Return the codec of a message whose fields have the dialect's names; what it lacks is zero on the wire."""
    places: dict[str, tuple[int, int]] = {}
    blank: list[Any] = []
    unpacked = native.unpacker.unpack(bytes(native.unpacker.size))
    for name, length in zip(native.ordered_fieldnames, native.array_lengths, strict=True):
        count = 1 if not length or isinstance(unpacked[len(blank)], bytes) else length
        places[name] = (len(blank), count)
        blank += unpacked[len(blank) : len(blank) + count]
    ours = [(each.name, *places[each.name], each.type) for each in fields(message)]

    def values(m: Any) -> tuple[Any, ...]:
        row = blank.copy()
        for name, place, count, _ in ours:
            value = getattr(m, name)
            if isinstance(value, str):
                row[place] = value.encode("ascii", "replace")
            elif count > 1:
                assert len(value) == count, f"{name}: expected {count} values, found {len(value)}"
                row[place : place + count] = value
            else:
                row[place] = value
        return tuple(row)

    def parsed(row: tuple[Any, ...]) -> Any:
        found: list[Any] = []
        for _, place, count, kind in ours:
            if kind == "str":
                found.append(_text(row[place]))
            elif count > 1:
                found.append(bytes(row[place : place + count]) if kind == "bytes" else row[place : place + count])
            else:
                found.append(row[place])
        return message(*found)

    return _Codec(native, values, parsed)


_GROUND_CODECS: dict[type, _Codec] = {
    ground.AvailableModes: _by_name(ground.AvailableModes, _AVAILABLE_MODES),
    ground.CurrentMode: _by_name(ground.CurrentMode, _CURRENT_MODE),
    **{
        message: _by_name(message, getattr(dialect, f"MAVLink_{name}_message"))
        for message, name in (
            (ground.AttitudeTarget, "attitude_target"),
            (ground.AutopilotVersion, "autopilot_version"),
            (ground.CommandAck, "command_ack"),
            (ground.CommandInt, "command_int"),
            (ground.CommandLong, "command_long"),
            (ground.ExtendedSysState, "extended_sys_state"),
            (ground.FileTransferProtocol, "file_transfer_protocol"),
            (ground.GlobalPositionInt, "global_position_int"),
            (ground.HomePosition, "home_position"),
            (ground.LogEntry, "log_entry"),
            (ground.LogRequestList, "log_request_list"),
            (ground.ManualControl, "manual_control"),
            (ground.MessageInterval, "message_interval"),
            (ground.MissionAck, "mission_ack"),
            (ground.MissionClearAll, "mission_clear_all"),
            (ground.MissionCount, "mission_count"),
            (ground.MissionRequest, "mission_request"),
            (ground.MissionRequestInt, "mission_request_int"),
            (ground.MissionRequestList, "mission_request_list"),
            (ground.ParamError, "param_error"),
            (ground.ParamRequestList, "param_request_list"),
            (ground.ParamRequestRead, "param_request_read"),
            (ground.ParamSet, "param_set"),
            (ground.ParamValue, "param_value"),
            (ground.Ping, "ping"),
            (ground.RcChannelsOverride, "rc_channels_override"),
            (ground.RequestDataStream, "request_data_stream"),
            (ground.SetAttitudeTarget, "set_attitude_target"),
            (ground.SetMode, "set_mode"),
            (ground.SysStatus, "sys_status"),
        )
    },
}
_ALL_CODECS = _CODECS | _GROUND_CODECS

CONTROL_MESSAGES = frozenset(_CODECS)
"""What autopilot and plant say to each other."""
GROUND_MESSAGES = frozenset(_GROUND_CODECS) | {Heartbeat, Timesync}
"""What a vehicle hears from ground stations."""
_HEADER = struct.Struct("<BBBBBBBHB")


def message_id(message: type) -> int:
    """Return the MAVLink id of a message type."""
    number: int = _ALL_CODECS[message].native.id
    return number


class Wire:
    """One end of one MAVLink link.

    Parameters
    ----------
    source : (int, int)
        System and component that sign what is packed here.
    peer : (int, int) or None
        System and component whose frames are accepted; None accepts every source but ``source``.
    accepts : frozenset of type
        The message types that are parsed.
    seal : Seal, optional
        Signs what is packed, and what is parsed must pass it.
    """

    def __init__(
        self,
        source: Source,
        peer: Source | None,
        accepts: frozenset[type] = CONTROL_MESSAGES,
        seal: Seal | None = None,
    ) -> None:
        self.source = source
        self.peer = peer
        self.seal = seal
        self._by_id = {codec.native.id: codec for message, codec in _ALL_CODECS.items() if message in accepts}
        self.rejects: Counter[Reject] = Counter()
        self.received = 0
        self.sent = 0
        self._sequence = 0

    def encode(self, message: Message) -> bytes:
        """Pack one message into one frame with the next sequence number."""
        codec = _ALL_CODECS[type(message)]
        native = codec.native
        payload = native.unpacker.pack(*codec.values(message))
        payload = payload.rstrip(b"\0") or payload[:1]
        system, component = self.source
        header = _HEADER.pack(
            dialect.PROTOCOL_MARKER_V2,
            len(payload),
            0 if self.seal is None else _SIGNED,
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
        frame: bytes = body + _crc(body[1:], native.crc_extra)
        return frame if self.seal is None else self.seal.sign(frame)

    def decode(self, datagram: bytes) -> list[Message]:
        """Return the accepted messages of one datagram, in order; count and drop the rest."""
        return [message for _, message in self.decode_from(datagram)]

    def decode_from(self, datagram: bytes) -> list[tuple[Source, Message]]:
        """Return the same with who sent each."""
        if len(datagram) > MAX_DATAGRAM_BYTES:
            self.rejects[Reject.OVERSIZE] += 1
            return []
        frames, leftover = split_frames(datagram)
        if leftover is not None:
            self.rejects[leftover] += 1
        if len(frames) > MAX_FRAMES:
            self.rejects[Reject.EXCESS] += len(frames) - MAX_FRAMES
            frames = frames[:MAX_FRAMES]
        accepted = []
        for frame in frames:
            parsed = self._parse(frame)
            if isinstance(parsed, Reject):
                self.rejects[parsed] += 1
            else:
                accepted.append(parsed)
        self.received += len(accepted)
        return accepted

    def _parse(self, frame: bytes) -> tuple[Source, Message] | Reject:
        """Return who sent a frame and its message, or why it is not accepted."""
        if frame[0] == dialect.PROTOCOL_MARKER_V2:
            source, number = (frame[5], frame[6]), int.from_bytes(frame[7:10], "little")
            start = dialect.HEADER_LEN_V2
        else:
            source, number = (frame[3], frame[4]), frame[5]
            start = dialect.HEADER_LEN_V1
        codec = self._by_id.get(number)
        if codec is None and number not in dialect.mavlink_map:
            return Reject.UNKNOWN_ID
        if source != self.peer if self.peer is not None else source == self.source:
            return Reject.WRONG_SOURCE
        if codec is None:
            return Reject.UNHANDLED
        native = codec.native
        end = start + frame[1]
        if _crc(frame[1:end], native.crc_extra) != frame[end : end + 2]:
            return Reject.BAD_CRC
        if self.seal is not None and (verdict := self.seal.check(frame)) != ACCEPTED:
            return Reject(verdict)
        size = native.unpacker.size
        payload = frame[start:end].ljust(size, b"\0")[:size]  # trailing zeros are not sent; extensions may follow
        message: Message = codec.message(native.unpacker.unpack(payload))
        for name in codec.floats:
            if not math.isfinite(getattr(message, name)):
                return Reject.NON_FINITE
        return source, message


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


def frames_of(source: Source, seal: Seal | None = None) -> Callable[[bytes], bool]:
    """Return a test for datagrams that carry a valid frame of ``source``: what a listener latches its peer on.

    With a seal the frame must be one that it would accept, so that nobody becomes the peer by an old frame.
    """
    wire = Wire((0, 0), source)

    def heard(datagram: bytes) -> bool:
        if not wire.decode(datagram):
            return False
        return seal is None or any(seal.would_accept(frame) for frame in split_frames(datagram)[0])

    return heard


def plant_heartbeat() -> Heartbeat:
    """Return the plant's HEARTBEAT: an aircraft without autopilot, so no ground station takes it for a vehicle."""
    return Heartbeat(dialect.MAV_TYPE_FIXED_WING, dialect.MAV_AUTOPILOT_INVALID, 0, 0, dialect.MAV_STATE_ACTIVE)


def autopilot_heartbeat(*, armed: bool, custom_mode: int, flags: int, degraded: bool) -> Heartbeat:
    """Return the autopilot's HEARTBEAT.

    Parameters
    ----------
    armed : bool
        Whether the elevator may leave neutral.
    custom_mode : int
        Number of the flight mode.
    flags : int
        MAV_MODE_FLAG bits of that mode beside those for armed and for custom modes.
    degraded : bool
        Whether failsafe has the elevator.
    """
    base_mode = dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | flags
    state = dialect.MAV_STATE_STANDBY
    if armed:
        base_mode |= dialect.MAV_MODE_FLAG_SAFETY_ARMED
        state = dialect.MAV_STATE_CRITICAL if degraded else dialect.MAV_STATE_ACTIVE
    return Heartbeat(dialect.MAV_TYPE_FIXED_WING, dialect.MAV_AUTOPILOT_GENERIC, base_mode, custom_mode, state)
