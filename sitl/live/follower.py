"""What a recording holds, while it is still being written: bytes in, records out.

A file that is being written ends anywhere, and its last record may be there by half. So bytes are taken in as they
come, and a record is told when it is whole: never before, never twice. The end of the recording is its DataEnd; what
follows there repeats what came before. Bytes that are no recording end the following, and are no error: the file may
be anybody's.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata
from mcap.writer import MCAP0_MAGIC

from autopilot.link.record import METADATA_NAME
from sitl.mcapwalk import (
    BAD_CONTENT,
    HEAD_BYTES,
    MAX_RECORD_BYTES,
    FileRecord,
    records_in,
    stream_of,
    unpack_chunk,
)

__all__ = ["MAX_CHANNELS", "About", "Attached", "End", "Follower", "Found", "Message"]

MAX_CHANNELS = 1 << 10
"""Channels of one recording; messages of further ones are refused."""

_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_WANTED = frozenset((Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK, Opcode.ATTACHMENT, Opcode.METADATA))
_MAX_LOG_TIME_NS = 1 << 63


class Message(NamedTuple):
    """A message: its topic, true time since the start of the flight in ns, and its JSON, not looked at."""

    topic: str
    log_time_ns: int
    data: bytes


class About(NamedTuple):
    """What the recording says about the flight."""

    metadata: dict[str, str]


class Attached(NamedTuple):
    """A file that the recording holds, such as the model."""

    name: str
    data: bytes


class End(NamedTuple):
    """The recording is finished, or (``damaged``) cannot be read any further."""

    damaged: bool


Found = Message | About | Attached | End


class Follower:
    """Reads a recording piece by piece; it never raises over what the pieces hold.

    Attributes
    ----------
    over : bool
        The recording has ended or is damaged: no piece changes anything any more.
    refused : int
        Records that are malformed, too long, of another encoding than JSON, or of a channel too many or unknown;
        a damaged chunk counts as one.
    """

    def __init__(self) -> None:
        self.over = False
        self.refused = 0
        self._buffer = bytearray()
        self._begun = False
        self._skip = 0
        self._channels: dict[int, str] = {}

    @property
    def held(self) -> int:
        """Bytes that wait for the rest of their record: at most MAX_RECORD_BYTES and the latest piece."""
        return len(self._buffer)

    def take(self, piece: bytes) -> Iterator[Found]:
        """Take the next bytes of the file and yield what has become whole, in the order of the file.

        The pieces may be cut anywhere. To be exhausted before the next piece is taken.
        """
        if self.over:
            return
        self._buffer += piece
        if not self._begun:
            head = bytes(self._buffer[: len(MCAP0_MAGIC)])
            if not MCAP0_MAGIC.startswith(head):
                yield self._end(damaged=True)
                return
            if len(head) < len(MCAP0_MAGIC):
                return
            del self._buffer[: len(MCAP0_MAGIC)]
            self._begun = True
        while not self.over and (record := self._next()) is not None:
            yield from self._found_in(record)

    def _next(self) -> FileRecord | None:
        """Cut the next whole record off the buffer; None while there is none. Those not looked at have no content."""
        dropped = min(self._skip, len(self._buffer))
        self._skip -= dropped
        del self._buffer[:dropped]
        if self._skip or len(self._buffer) < HEAD_BYTES:
            return None
        opcode, length = _HEAD.unpack_from(self._buffer)
        if opcode in _WANTED and length <= MAX_RECORD_BYTES:
            if len(self._buffer) < HEAD_BYTES + length:
                return None
            content = bytes(self._buffer[HEAD_BYTES : HEAD_BYTES + length])
            del self._buffer[: HEAD_BYTES + length]
            return FileRecord(opcode, 0, HEAD_BYTES + length, content, torn=False)
        del self._buffer[:HEAD_BYTES]
        self._skip = length
        return FileRecord(opcode, 0, HEAD_BYTES + length, b"", torn=False, oversize=opcode in _WANTED)

    def _found_in(self, record: FileRecord) -> Iterator[Found]:
        """Yield what one record of the file says."""
        if record.oversize:
            self.refused += 1
        elif record.opcode == Opcode.CHUNK:
            chunk = unpack_chunk(record)
            self.refused += not chunk.whole
            for opcode, content in records_in(chunk.content):
                yield from self._read(opcode, content)
        elif record.opcode in (Opcode.DATA_END, Opcode.FOOTER):
            yield self._end(damaged=False)
        elif record.opcode == 0:  # no record has this: the file is not what its lengths say
            yield self._end(damaged=True)
        else:
            yield from self._read(record.opcode, record.content)

    def _read(self, opcode: int, content: bytes | memoryview) -> Iterator[Found]:
        """Yield what a message, an attachment or the metadata says; remember a channel."""
        try:
            match opcode:
                case Opcode.MESSAGE:
                    yield self._message(content)
                case Opcode.CHANNEL:
                    self._define(Channel.read(stream_of(content)))
                case Opcode.METADATA:
                    about = Metadata.read(stream_of(content))
                    if about.name == METADATA_NAME:
                        yield About(about.metadata)
                case Opcode.ATTACHMENT:
                    crc = int.from_bytes(content[-4:], "little")
                    if crc and zlib.crc32(content[:-4]) != crc:
                        raise ValueError("wrong checksum")
                    attachment = Attachment.read(stream_of(content))
                    yield Attached(attachment.name, attachment.data)
        except BAD_CONTENT:
            self.refused += 1

    def _define(self, channel: Channel) -> None:
        if channel.message_encoding != "json" or len(self._channels) >= MAX_CHANNELS:
            raise ValueError("a channel that is not read")
        self._channels[channel.id] = channel.topic

    def _message(self, content: bytes | memoryview) -> Message:
        channel, _, log_time_ns, _ = _MESSAGE.unpack_from(content)
        if channel not in self._channels or log_time_ns >= _MAX_LOG_TIME_NS:
            raise ValueError("a message of no known channel, or of no time")
        return Message(self._channels[channel], log_time_ns, bytes(content[_MESSAGE.size :]))

    def _end(self, *, damaged: bool) -> End:
        self.over = True
        self._buffer.clear()
        return End(damaged)
