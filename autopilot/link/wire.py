"""MAVLink 2 frames of frozen messages, one datagram at a time.

A :class:`Wire` is one end of one link: it numbers the frames it packs and checks the frames it parses.
No parser state outlives a datagram, so a bad or truncated datagram can never swallow the next one.
What is not a well-formed frame of the expected peer, with finite fields and a message of interest, is
counted by kind and dropped.

The payloads are made by pymavlink's tables (:mod:`autopilot.link.codecs`). Its stateful ``MAVLink`` object is not
used: it keeps a stream's state across datagrams, does not advance the sequence number when packing, and takes about
three times as long.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Callable
from enum import StrEnum
from typing import Protocol

from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import ardupilotmega as dialect

from autopilot.link.codecs import CODECS, CONTROL_MESSAGES, GROUND_MESSAGES, U32, message_id
from autopilot.link.groundmessages import GroundMessage
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
    "U32",
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
    "message_id",
    "plant_heartbeat",
    "split_frames",
]

Source = tuple[int, int]
"""System and component."""

Message = ControlMessage | GroundMessage

AUTOPILOT = (1, 1)
"""MAVLink system and component of the autopilot."""

PLANT = (1, 25)
"""MAVLink system and component of the plant."""

MAX_DATAGRAM_BYTES = 2048
"""Longest datagram that is looked at; a MAVLink 2 frame has at most 280 bytes."""

MAX_FRAMES = 64
"""Frames of one datagram that are looked at: what one datagram costs is bounded."""

_SIGNED = dialect.MAVLINK_IFLAG_SIGNED
_V1, _V1_HEADER_BYTES = dialect.PROTOCOL_MARKER_V1, dialect.HEADER_LEN_V1
_V2, _V2_HEADER_BYTES = dialect.PROTOCOL_MARKER_V2, dialect.HEADER_LEN_V2

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


_HEADER = struct.Struct("<BBBB2s3s")
"""What follows the marker: length, two flags, number, system and component, message id."""
_CRC = struct.Struct("<H")
_MARKER = bytes((_V2,))


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
        self._source_bytes = bytes(source)
        self.peer = peer
        self.seal = seal
        self._by_id = {codec.id: codec for message, codec in CODECS.items() if message in accepts}
        self.rejects: Counter[Reject] = Counter()
        self.received = 0
        self.sent = 0
        self._sequence = 0

    def encode(self, message: Message) -> bytes:
        """Pack one message into one frame with the next sequence number."""
        codec = CODECS[type(message)]
        payload = codec.payload.pack(*codec.values(message))
        payload = payload.rstrip(b"\0") or payload[:1]
        flags = 0 if self.seal is None else _SIGNED
        body = _HEADER.pack(len(payload), flags, 0, self._sequence, self._source_bytes, codec.id_bytes) + payload
        self._sequence = (self._sequence + 1) % 256
        self.sent += 1
        frame = _MARKER + body + _CRC.pack(mcrf4xx(body + codec.crc_extra))
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
        if frame[0] == _V2:
            source, number = (frame[5], frame[6]), frame[7] | frame[8] << 8 | frame[9] << 16
            start = _V2_HEADER_BYTES
        else:
            source, number = (frame[3], frame[4]), frame[5]
            start = _V1_HEADER_BYTES
        codec = self._by_id.get(number)
        if codec is None and number not in dialect.mavlink_map:
            return Reject.UNKNOWN_ID
        if source != self.peer if self.peer is not None else source == self.source:
            return Reject.WRONG_SOURCE
        if codec is None:
            return Reject.UNHANDLED
        end = start + frame[1]
        if mcrf4xx(frame[1:end] + codec.crc_extra) != frame[end] | frame[end + 1] << 8:
            return Reject.BAD_CRC
        if self.seal is not None and (verdict := self.seal.check(frame)) != ACCEPTED:
            return Reject(verdict)
        size = codec.payload.size
        payload = frame[start:end].ljust(size, b"\0")[:size]  # trailing zeros are not sent; extensions may follow
        message: Message = codec.message(codec.payload.unpack(payload))
        if codec.float_sum is not None and not math.isfinite(codec.float_sum(message)):
            return Reject.NON_FINITE
        return source, message


def split_frames(datagram: bytes) -> tuple[list[bytes], Reject | None]:
    """Return the frames of one datagram by their length fields, and what its rest is when it is no frame."""
    frames: list[bytes] = []
    start, end = 0, len(datagram)
    while start < end:
        marker = datagram[start]
        if marker == _V2:
            if end - start < _V2_HEADER_BYTES + _CRC.size:
                return frames, Reject.TRUNCATED
            flags = datagram[start + 2]
            if flags & ~_SIGNED:
                return frames, Reject.MALFORMED
            length = _V2_HEADER_BYTES + datagram[start + 1] + _CRC.size
            if flags & _SIGNED:
                length += dialect.MAVLINK_SIGNATURE_BLOCK_LEN
        elif marker == _V1:
            if end - start < _V1_HEADER_BYTES + _CRC.size:
                return frames, Reject.TRUNCATED
            length = _V1_HEADER_BYTES + datagram[start + 1] + _CRC.size
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
