"""Reads the records of an MCAP file that may be cut off, damaged, or anybody's.

The standard reader trusts lengths and needs a summary. This one compares what a file claims with what is there
before it spends memory on it, says of each record whether it is torn, and raises nothing over content.
"""

from __future__ import annotations

import contextlib
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from typing import IO

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Header, Statistics
from mcap.writer import MCAP0_MAGIC

__all__ = [
    "BAD_CONTENT",
    "DATA_END_BYTES",
    "HEAD_BYTES",
    "MAX_DEFINITION_BYTES",
    "MAX_RECORD_BYTES",
    "Chunk",
    "FileRecord",
    "FileSummary",
    "read_header",
    "read_summary",
    "records_in",
    "stream_of",
    "unpack_chunk",
    "walk",
]

MAX_RECORD_BYTES = 1 << 25
"""Longest record that is looked at, and longest content of a chunk."""
MAX_DEFINITION_BYTES = 1 << 22
"""All schemas and channels of a file together, and the longest metadata."""
BAD_CONTENT = (McapError, ValueError, OverflowError, struct.error)
"""What the records of :mod:`mcap` raise over content that is none of theirs."""

MAX_HEADER_BYTES = 1 << 16

_PIECE_BYTES = 1 << 16
_RECORD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQII")
_LENGTH = struct.Struct("<Q")
_FOOTER = struct.Struct("<QQI")
_FOOTER_BYTES = _RECORD.size + _FOOTER.size
HEAD_BYTES = _RECORD.size
"""Opcode and length, before the content of each record."""
DATA_END_BYTES = _RECORD.size + 4
_LOOKED_AT = frozenset(
    (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK, Opcode.ATTACHMENT, Opcode.METADATA, Opcode.STATISTICS)
)
"""The others, indexes, can be made anew."""


@dataclass(frozen=True, slots=True)
class FileRecord:
    """A record of the file: what there is of it.

    Attributes
    ----------
    offset, size : int
        Where it is and how many bytes of it are there, opcode and length included.
    content : bytes
        Without opcode and length; empty for those that are not looked at, or are too long.
    torn : bool
        It does not end within the file, or is no record at all.
    oversize : bool
        It would have been looked at, but is longer than MAX_RECORD_BYTES.
    """

    opcode: int
    offset: int
    size: int
    content: bytes
    torn: bool
    oversize: bool = False


def walk(file: IO[bytes], start: int, end: int) -> Iterator[FileRecord]:
    """Yield the records between two places of a file; the last one may be torn."""
    position = start
    while position < end:
        file.seek(position)
        head = file.read(min(_RECORD.size, end - position))
        opcode, length = _RECORD.unpack(head) if len(head) == _RECORD.size else (0, 0)
        if opcode == 0:  # the end, or no record at all
            yield FileRecord(0, position, end - position, b"", True)
            return
        rest = end - position - _RECORD.size
        size = min(length, rest)
        wanted = opcode in _LOOKED_AT and (size <= MAX_RECORD_BYTES or length > rest)
        content = file.read(min(size, MAX_RECORD_BYTES)) if wanted else b""
        yield FileRecord(
            opcode,
            position,
            _RECORD.size + size,
            content,
            torn=length > rest,
            oversize=opcode in _LOOKED_AT and not wanted,
        )
        position += _RECORD.size + size


@dataclass(frozen=True, slots=True)
class Chunk:
    """A chunk's content.

    Attributes
    ----------
    content : bytearray
        As far as it can be had; empty where it is known to be wrong.
    whole : bool
        Whether that is all of it.
    """

    content: bytearray
    whole: bool


def unpack_chunk(record: FileRecord) -> Chunk:
    """Decompress a chunk and compare its size and checksum; of a torn one, return what there is and cannot tell."""
    body = memoryview(record.content)
    none = Chunk(bytearray(), False)
    if len(body) < _CHUNK.size:
        return none
    _, _, size, crc, name_bytes = _CHUNK.unpack_from(body)
    start = _CHUNK.size + name_bytes + _LENGTH.size
    if len(body) < start or size > MAX_RECORD_BYTES:
        return none
    compression = bytes(body[_CHUNK.size : _CHUNK.size + name_bytes])
    (length,) = _LENGTH.unpack_from(body, _CHUNK.size + name_bytes)
    if not record.torn and length != len(body) - start:
        return none
    content = _decompress(compression, body[start:])
    if record.torn and len(content) < size:
        return Chunk(content, False)
    if record.torn and not compression:
        del content[size:]  # what only seems to belong to it, as its length lies
    if len(content) != size or (crc and zlib.crc32(content) != crc):
        return none
    return Chunk(content, not record.torn)


def _decompress(compression: bytes, data: memoryview) -> bytearray:
    """Return the content as far as it goes, and a little more than is allowed where it goes further."""
    if compression == b"":
        return bytearray(data)
    content = bytearray()
    if compression == b"zstd":
        reader = zstandard.ZstdDecompressor(max_window_size=MAX_RECORD_BYTES).stream_reader(data)
        with contextlib.suppress(zstandard.ZstdError):
            while len(content) <= MAX_RECORD_BYTES and (piece := reader.read(_PIECE_BYTES)):
                content += piece
    return content


def records_in(content: bytearray) -> Iterator[tuple[int, memoryview]]:
    """Yield opcode and content of the whole records in a chunk."""
    view = memoryview(content)
    start = 0
    while start + _RECORD.size <= len(view):
        opcode, length = _RECORD.unpack_from(view, start)
        start += _RECORD.size
        if length > len(view) - start or opcode not in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
            return
        yield opcode, view[start : start + length]
        start += length


def stream_of(content: bytes | memoryview) -> ReadDataStream:
    """Return what the records of :mod:`mcap` read from."""
    return ReadDataStream(BytesIO(content))


@dataclass(frozen=True, slots=True)
class FileSummary:
    """The end of a finished file, its checksum compared.

    Attributes
    ----------
    start : int
        Where the data are over, DataEnd included.
    messages : int or None
        How many there are in the file; None where it does not say.
    definitions : list of FileRecord
        Schemas and channels, which a damaged chunk may have held, too.
    """

    start: int
    messages: int | None = None
    definitions: list[FileRecord] = field(default_factory=list)


def read_summary(file: IO[bytes], size: int) -> FileSummary | None:
    """Return the summary of a finished file of ``size`` bytes; None without one, or without its right checksum."""
    at = size - len(MCAP0_MAGIC) - _FOOTER_BYTES
    if at < len(MCAP0_MAGIC):
        return None
    file.seek(at)
    end = file.read(_FOOTER_BYTES + len(MCAP0_MAGIC))
    if len(end) != _FOOTER_BYTES + len(MCAP0_MAGIC) or not end.endswith(MCAP0_MAGIC):
        return None
    start, _, crc = _FOOTER.unpack_from(end, _RECORD.size)
    if _RECORD.unpack_from(end) != (Opcode.FOOTER, _FOOTER.size) or not (start == 0 or len(MCAP0_MAGIC) <= start <= at):
        return None
    start = start or at
    if not crc or crc != _checksum(file, start, at + _FOOTER_BYTES - 4):
        return None
    definitions: list[FileRecord] = []
    messages, held = None, 0
    for record in walk(file, start, at):
        if record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL) and held + record.size <= MAX_DEFINITION_BYTES:
            held += record.size
            definitions.append(record)
        elif record.opcode == Opcode.STATISTICS:
            with contextlib.suppress(*BAD_CONTENT):
                messages = Statistics.read(stream_of(record.content)).message_count
    return FileSummary(start, messages, definitions)


def _checksum(file: IO[bytes], start: int, end: int) -> int:
    file.seek(start)
    crc = 0
    while start < end and (piece := file.read(min(_PIECE_BYTES, end - start))):
        crc = zlib.crc32(piece, crc)
        start += len(piece)
    return crc


def read_header(file: IO[bytes]) -> Header:
    """Return the file's header; an empty one where it is torn."""
    file.seek(len(MCAP0_MAGIC))
    head = file.read(_RECORD.size)
    if len(head) == _RECORD.size:
        opcode, length = _RECORD.unpack(head)
        if opcode == Opcode.HEADER and length <= MAX_HEADER_BYTES:
            with contextlib.suppress(*BAD_CONTENT):
                header: Header = Header.read(stream_of(file.read(length)))
                return header
    return Header("", "")
