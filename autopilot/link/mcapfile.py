"""An MCAP file in the making: byte for byte what the mcap library's own writer makes, at a fraction of its cost.

A flight records a thousand messages a second and little else, and the library spends two objects and a dozen small
writes on each. Here a message is one packed header, its data and two numbers for the index, which is packed when the
chunk is full. All other records are the library's own.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Protocol

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

__all__ = ["McapWriter", "Output"]

_MESSAGE = struct.Struct("<BQHIQQ")
"""What precedes the data: opcode, length, channel, sequence (here 0), time of the log, time of publication."""
_MESSAGE_BYTES = 22
"""What of it the length counts."""
_INDEX = struct.Struct("<BQHI")
"""What precedes the pairs of time and offset: opcode, length, channel, bytes of the pairs."""
_INDEX_BYTES = 6
_SUMMARY_END = struct.Struct("<BQQQ")
"""The footer up to its checksum, which covers it."""
_FOOTER_BYTES = 20


class Output(Protocol):
    """Where the bytes go, from its beginning."""

    def write(self, data: bytes, /) -> object:
        """Append bytes."""


class McapWriter:
    """Writes one MCAP file: zstd chunks of about ``chunk_bytes``, all indexes, and a summary.

    Parameters
    ----------
    output : Output
        Takes the file; it is not closed.
    profile, library : str
        What the header says.
    chunk_bytes : int
        A chunk that holds more than this is written.
    """

    def __init__(self, output: Output, profile: str, library: str, chunk_bytes: int) -> None:
        self._output = output
        self._chunk_bytes = chunk_bytes
        self._compressor = zstandard.ZstdCompressor()
        self._length = 0
        self._chunk = bytearray()
        self._index: dict[int, list[int]] = {}
        """Of the chunk: time and offset of each message, one after the other, by channel."""
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._chunks: list[ChunkIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._messages: Counter[int] = Counter()
        self._write(MCAP0_MAGIC)
        self._write(_packed(Header(profile, library)))

    def add_metadata(self, name: str, metadata: Mapping[str, str]) -> None:
        """Write a record of metadata, ahead of the chunk in progress."""
        offset, length = self._length, self._write(_packed(Metadata(name, dict(metadata))))
        self._metadata.append(MetadataIndex(offset=offset, length=length, name=name))

    def add_attachment(self, name: str, media_type: str, content: bytes) -> None:
        """Write an attachment, of time 0, ahead of the chunk in progress."""
        attachment = Attachment(create_time=0, log_time=0, name=name, media_type=media_type, data=content)
        offset, length = self._length, self._write(_packed(attachment))
        self._attachments.append(
            AttachmentIndex(
                offset=offset,
                length=length,
                log_time=0,
                create_time=0,
                data_size=len(content),
                name=name,
                media_type=media_type,
            )
        )

    def register(self, topic: str, encoding: str, schema_name: str, schema_encoding: str, schema: bytes) -> int:
        """Return the number of a new channel, which is of a schema of its own."""
        number = len(self._channels) + 1
        self._schemas.append(Schema(id=number, data=schema, encoding=schema_encoding, name=schema_name))
        self._add(self._schemas[-1])
        self._channels.append(Channel(id=number, topic=topic, message_encoding=encoding, metadata={}, schema_id=number))
        self._add(self._channels[-1])
        return number

    def add_message(self, channel: int, time_ns: int, data: bytes) -> bool:
        """Put a message into the chunk; return whether that has filled it, and it was written."""
        chunk, index = self._chunk, self._index.get(channel)
        if index is None:
            index = self._index[channel] = []
        index += (time_ns, len(chunk))
        chunk += _MESSAGE.pack(Opcode.MESSAGE, _MESSAGE_BYTES + len(data), channel, 0, time_ns, time_ns)
        chunk += data
        return len(chunk) > self._chunk_bytes and self.flush()

    def flush(self) -> bool:
        """Write the chunk in progress; return whether there was one: schemas and channels wait for a message."""
        if not self._index:
            return False
        data, compressed = self._chunk, self._compressor.compress(self._chunk)
        chunk = Chunk(
            compression="zstd",
            data=compressed,
            message_end_time=max(max(index[::2]) for index in self._index.values()),
            message_start_time=min(min(index[::2]) for index in self._index.values()),
            uncompressed_crc=zlib.crc32(data),
            uncompressed_size=len(data),
        )
        start, length = self._length, self._write(_packed(chunk))
        offsets, indexes_start = {}, self._length
        for channel, index in self._index.items():
            offsets[channel] = self._length
            self._write(_message_index(channel, index))
            self._messages[channel] += len(index) // 2
        self._chunks.append(
            ChunkIndex(
                chunk_length=length,
                chunk_start_offset=start,
                compression=chunk.compression,
                compressed_size=len(compressed),
                message_end_time=chunk.message_end_time,
                message_index_length=self._length - indexes_start,
                message_index_offsets=offsets,
                message_start_time=chunk.message_start_time,
                uncompressed_size=chunk.uncompressed_size,
            )
        )
        self._chunk, self._index = bytearray(), {}
        return True

    def finish(self) -> None:
        """Write the last chunk, the summary and the end of the file."""
        self.flush()
        self._write(_packed(DataEnd(0)))
        start = offset = self._length
        summary, offsets = b"", []
        for opcode, records in self._summary():
            group = _packed(*records)
            offsets.append(SummaryOffset(group_opcode=opcode, group_start=offset, group_length=len(group)))
            summary += group
            offset += len(group)
        summary += _packed(*offsets)
        self._write(summary)
        crc = zlib.crc32(_SUMMARY_END.pack(Opcode.FOOTER, _FOOTER_BYTES, start, offset), zlib.crc32(summary))
        self._write(_packed(Footer(summary_start=start, summary_offset_start=offset, summary_crc=crc)))
        self._write(MCAP0_MAGIC)

    def _summary(self) -> list[tuple[Opcode, Iterable[McapRecord]]]:
        """Return the groups of the summary, in order."""
        statistics = Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=self._messages,
            chunk_count=len(self._chunks),
            message_count=self._messages.total(),
            message_end_time=max((chunk.message_end_time for chunk in self._chunks), default=0),
            message_start_time=min((chunk.message_start_time for chunk in self._chunks), default=0),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        return [
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, self._attachments),
            (Opcode.METADATA_INDEX, self._metadata),
        ]

    def _add(self, record: Schema | Channel) -> None:
        """Put a record into the chunk, which is written if that fills it and it has a message."""
        self._chunk += _packed(record)
        if len(self._chunk) > self._chunk_bytes:
            self.flush()

    def _write(self, data: bytes) -> int:
        """Write bytes; return how many."""
        self._output.write(data)
        self._length += len(data)
        return len(data)


def _packed(*records: McapRecord) -> bytes:
    """Return records as the library writes them."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def _message_index(channel: int, index: list[int]) -> bytes:
    """Return the record that says where in its chunk the messages of a channel are."""
    size = 8 * len(index)
    head = _INDEX.pack(Opcode.MESSAGE_INDEX, _INDEX_BYTES + size, channel, size)
    return head + struct.pack(f"<{len(index)}Q", *index)
