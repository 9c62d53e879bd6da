"""Rescues what a recording holds that was cut off, by a kill or a full disk, or that was damaged since.

An MCAP file is a row of records, each behind its length; messages stand in chunks, each behind its checksum; a
summary at the end tells a reader where they are, and a file that was cut off has none. So the rescue walks the
records from the start, checks each chunk, keeps what is whole, in its order and with its times, and writes a new
file, which the standard reader reads. Of a torn last chunk it keeps the whole messages in as many blocks as
decompress. Where a length lies, nobody knows where the next record begins: there the rescue ends.

The file may be anybody's: what it claims is compared with what is there before memory is spent on it, and
everything that is kept for the new summary has a bound. The rescue needs a few times ``MAX_RECORD_BYTES``, however
long the file is.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import stat
import struct
import tempfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, Metadata, Schema
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from autopilot.link.clock import NS_PER_S
from gains.command import require_writable
from gains.table import InputError
from sitl.mcapwalk import (
    BAD_CONTENT,
    DATA_END_BYTES,
    HEAD_BYTES,
    MAX_DEFINITION_BYTES,
    MAX_RECORD_BYTES,
    FileRecord,
    read_header,
    read_summary,
    records_in,
    stream_of,
    unpack_chunk,
    walk,
)

__all__ = ["Rescue", "recover"]

CHUNK_BYTES = 1 << 20
"""Content of a chunk of the new file."""
MAX_DEFINITIONS = 1 << 12
"""Schemas and channels together; further ones, and those beyond MAX_DEFINITION_BYTES, are dropped and counted."""
MAX_EXTRAS = 1 << 14
"""Metadata and attachments together, likewise."""
MAX_INDEX_ENTRIES = 1 << 22
"""Entries of the new summary: one for each chunk, and each channel in it. What comes after them is dropped."""

_MESSAGE = struct.Struct("<HIQQ")


@dataclass(frozen=True, slots=True)
class Rescue:
    """What became of a recording.

    Attributes
    ----------
    complete : bool
        It was finished and whole, and has been copied as it is.
    messages, attachments, metadata : int
        How many there are in the new file.
    start_ns, end_ns : int
        Earliest and latest log time of the messages; 0 without any.
    bytes_read : int
        Length of the file.
    bytes_dropped : int
        Of these, the bytes of records that are not, or not wholly, in the new file.
    damaged_chunks : int
        Chunks whose content is not what its checksum says, or cannot be had, or is too long.
    torn : bool
        The data end within a record, or a length in them lies.
    dropped_messages : int
        Messages of a channel that nothing describes.
    dropped_records : int
        Other records that are malformed, contradict earlier ones, or are beyond a limit.
    """

    complete: bool
    messages: int
    attachments: int
    metadata: int
    start_ns: int
    end_ns: int
    bytes_read: int
    bytes_dropped: int
    damaged_chunks: int
    torn: bool
    dropped_messages: int
    dropped_records: int

    @property
    def seconds(self) -> float:
        """How much time the messages span, s."""
        return (self.end_ns - self.start_ns) / NS_PER_S

    @property
    def nothing(self) -> bool:
        """Whether there was nothing to rescue."""
        return not (self.complete or self.messages or self.attachments)


def recover(source: Path, target: Path, *, force: bool = False) -> Rescue:
    """Write what a recording holds to a new, finished file; none where there is nothing to rescue.

    Parameters
    ----------
    source : Path
        The recording, cut off or not.
    target : Path
        The new file: it appears whole or not at all.
    force : bool
        Whether it may replace another one.

    Raises
    ------
    InputError
        When the source is no MCAP file, or the target exists, is the source, or cannot be made.
    OSError
        When the disk fails; the target is then as it was.
    """
    with _opened(source) as file:
        if target.exists() and os.path.samefile(source, target):
            raise InputError(f"{target}: expected another file than the recording itself")
        if target.exists() and not force:
            raise InputError(f"{target}: expected no such file (--force replaces it)")
        require_writable(target)
        handle, temporary = tempfile.mkstemp(prefix=f".{target.name}.", dir=target.parent)
        try:
            with os.fdopen(handle, "wb") as out:
                rescue = _rescue(file, out)
            if rescue.complete:
                shutil.copyfile(source, temporary)
            if not rescue.nothing:
                os.chmod(temporary, stat.S_IMODE(os.fstat(file.fileno()).st_mode))
                os.replace(temporary, target)
        finally:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(temporary)
    return rescue


@contextlib.contextmanager
def _opened(source: Path) -> Iterator[IO[bytes]]:
    """Open a file that begins as an MCAP file does; one of less than eight bytes may have been cut off there."""
    try:
        if not stat.S_ISREG(source.stat().st_mode):
            raise InputError(f"{source}: expected a regular file")
        file = source.open("rb")
    except OSError as error:
        raise InputError(f"{source}: {error.strerror or error}") from None
    with file:
        if not MCAP0_MAGIC.startswith(file.read(len(MCAP0_MAGIC))):
            raise InputError(f"{source}: expected an MCAP file, found other bytes at its start")
        yield file


# writing


class _Output:
    """The new file: takes records under their old ids, and counts.

    Attributes
    ----------
    full : bool
        The summary has no room for more.
    """

    def __init__(self, out: IO[bytes], header: Header) -> None:
        self.messages = self.attachments = self.metadata = 0
        self.start_ns = self.end_ns = 0
        self.dropped_messages = self.dropped_records = 0
        self._writer = Writer(out, chunk_size=2 * MAX_RECORD_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(header.profile, header.library)
        self._schemas: dict[int, tuple[Schema, int]] = {}
        self._channels: dict[int, tuple[Channel, int]] = {}
        self._definition_bytes = 0
        self._pending_bytes = 0
        self._pending_channels: set[int] = set()
        self._entries = 0

    @property
    def full(self) -> bool:
        return self._entries >= MAX_INDEX_ENTRIES

    def define(self, opcode: int, content: bytes | memoryview) -> None:
        """Take a schema or a channel; the first definition of an id holds, and an equal one is no news."""
        try:
            record = Schema.read(stream_of(content)) if opcode == Opcode.SCHEMA else Channel.read(stream_of(content))
        except BAD_CONTENT:
            self.dropped_records += 1
            return
        held: dict[int, tuple[Schema, int]] | dict[int, tuple[Channel, int]]
        held = self._schemas if isinstance(record, Schema) else self._channels
        if record.id in held:
            self.dropped_records += held[record.id][0] != record
            return
        known = isinstance(record, Schema) or record.schema_id == 0 or record.schema_id in self._schemas
        size = self._definition_bytes + len(content)
        many = len(self._schemas) + len(self._channels) >= MAX_DEFINITIONS
        if not known or many or size > MAX_DEFINITION_BYTES or (isinstance(record, Schema) and record.id == 0):
            self.dropped_records += 1
            return
        self._definition_bytes = size
        if isinstance(record, Schema):
            new = self._writer.register_schema(record.name, record.encoding, record.data)
            self._schemas[record.id] = record, new
            return
        schema = self._schemas[record.schema_id][1] if record.schema_id else 0
        new = self._writer.register_channel(record.topic, record.message_encoding, schema, record.metadata)
        self._channels[record.id] = record, new

    def message(self, content: bytes | memoryview) -> None:
        """Take a message of a known channel."""
        if len(content) < _MESSAGE.size:
            self.dropped_records += 1
            return
        channel, sequence, log_time_ns, publish_time_ns = _MESSAGE.unpack_from(content)
        if channel not in self._channels:
            self.dropped_messages += 1
            return
        new = self._channels[channel][1]
        self._writer.add_message(new, log_time_ns, bytes(content[_MESSAGE.size :]), publish_time_ns, sequence)
        self.start_ns = min(self.start_ns, log_time_ns) if self.messages else log_time_ns
        self.end_ns = max(self.end_ns, log_time_ns)
        self.messages += 1
        self._pending_bytes += HEAD_BYTES + len(content)
        self._pending_channels.add(channel)
        if self._pending_bytes >= CHUNK_BYTES:
            self._flush()

    def extra(self, opcode: int, content: bytes) -> None:
        """Take metadata or an attachment, behind the messages before it."""
        many = self.attachments + self.metadata >= MAX_EXTRAS or self._definition_bytes > MAX_DEFINITION_BYTES
        try:
            if many or (opcode == Opcode.METADATA and len(content) > MAX_DEFINITION_BYTES):
                raise ValueError("beyond a limit")
            if opcode == Opcode.METADATA:
                self._add_metadata(Metadata.read(stream_of(content)))
            else:
                self._add_attachment(Attachment.read(stream_of(content)), content)
        except BAD_CONTENT:
            self.dropped_records += 1

    def _add_metadata(self, record: Metadata) -> None:
        self._flush()
        self._writer.add_metadata(record.name, record.metadata)
        self._definition_bytes += len(record.name)
        self.metadata += 1

    def _add_attachment(self, record: Attachment, content: bytes) -> None:
        crc = int.from_bytes(content[-4:], "little")
        if crc and zlib.crc32(content[:-4]) != crc:
            raise ValueError("wrong checksum")
        self._flush()
        self._writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)
        self._definition_bytes += len(record.name) + len(record.media_type)
        self.attachments += 1

    def finish(self) -> None:
        """Write the summary."""
        self._writer.finish()  # type: ignore[no-untyped-call]

    def _flush(self) -> None:
        if self._pending_channels:
            self._entries += 1 + len(self._pending_channels)
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._pending_bytes = 0
        self._pending_channels.clear()


def _rescue(file: IO[bytes], out: IO[bytes]) -> Rescue:
    """Walk a recording once and write what is whole to a new file."""
    size = file.seek(0, os.SEEK_END)
    summary = read_summary(file, size)
    output = _Output(out, read_header(file))
    for definition in () if summary is None else summary.definitions:
        output.define(definition.opcode, definition.content)
    dropped = damaged = 0
    torn = ended = False
    end = size if summary is None else summary.start
    for record in walk(file, len(MCAP0_MAGIC), end):
        if output.full:
            dropped += end - record.offset
            break
        before = output.dropped_messages + output.dropped_records
        torn = torn or record.torn
        ended = record.opcode == Opcode.DATA_END
        if ended:
            # what follows in a file without a summary to be trusted is an index, which is made anew
            torn = torn or (summary is not None and record.offset + DATA_END_BYTES != end)
            break
        whole = _take(output, record)
        damaged += record.opcode == Opcode.CHUNK and not whole and not record.torn
        if not whole or record.torn or output.dropped_messages + output.dropped_records > before:
            dropped += record.size
    output.finish()
    said = summary is not None and summary.messages in (None, output.messages)
    return Rescue(
        complete=said and ended and not torn and not dropped,
        messages=output.messages,
        attachments=output.attachments,
        metadata=output.metadata,
        start_ns=output.start_ns,
        end_ns=output.end_ns,
        bytes_read=size,
        bytes_dropped=dropped,
        damaged_chunks=damaged,
        torn=torn,
        dropped_messages=output.dropped_messages,
        dropped_records=output.dropped_records,
    )


def _take(output: _Output, record: FileRecord) -> bool:
    """Pass a record of the data section on to the new file; return whether it could be read wholly."""
    match record.opcode:
        case _ if record.oversize:
            output.dropped_records += record.opcode != Opcode.CHUNK
            return False
        case Opcode.CHUNK:
            chunk = unpack_chunk(record)
            taken = 0
            for opcode, content in records_in(chunk.content):
                taken += HEAD_BYTES + len(content)
                if opcode == Opcode.MESSAGE:
                    output.message(content)
                else:
                    output.define(opcode, content)
            return chunk.whole and taken == len(chunk.content)
        case _ if record.torn:
            return False
        case Opcode.MESSAGE:
            output.message(record.content)
        case Opcode.SCHEMA | Opcode.CHANNEL:
            output.define(record.opcode, record.content)
        case Opcode.METADATA | Opcode.ATTACHMENT:
            output.extra(record.opcode, record.content)
    return True
