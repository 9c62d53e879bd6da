"""Recordings: the MCAP and tlog writers, and the lines of records between processes.

A process streams its records as lines of JSON to the one program that writes the files, or writes its own
file when started by hand. A file is for after the flight, so it never disturbs one: a full disk ends the
recording and is counted, not raised. Nothing of the wall clock goes into a file; equal records make equal
bytes.

Each finished chunk goes to the operating system in one write, at the latest when the messages in it span
``MAX_CHUNK_NS``, and the frames of a tlog likewise: a killed process loses less than one second.
"""

from __future__ import annotations

import errno
import os
from binascii import b2a_base64
from collections.abc import Iterator, Mapping
from io import FileIO
from types import MappingProxyType
from typing import Any, Self

import numpy as np
import orjson
from mcap.reader import make_reader

from autopilot.link.mcapfile import McapWriter
from autopilot.link.node import Record
from autopilot.link.topics import FRAME_SCHEMA, SCHEMAS, is_topic, schema_of

__all__ = [
    "MAX_LINE_BYTES",
    "SCHEMAS",
    "McapRecorder",
    "TlogWriter",
    "decode_line",
    "encode_line",
    "frame_record",
    "is_topic",
    "read_mcap",
    "read_metadata",
    "schema_of",
]

MAX_LINE_BYTES = 1 << 17
"""Longest line: the largest UDP datagram in base64, with room for the rest."""

MAX_TOPICS = 64
"""Topics in one file; records of further topics are refused and counted."""

CHUNK_BYTES = 1 << 14
MAX_CHUNK_NS = 500_000_000
FRAMES_PER_FLUSH = 64
MAX_FLUSH_US = MAX_CHUNK_NS // 1000
METADATA_NAME = "flight"
ATTACHMENT_TYPE = "application/toml"

_PROFILE = "lagproof"
_TIME_LIMIT_NS = 1 << 63
_LINE_KEYS = frozenset(("topic", "t_ns", "log_time_ns", "body"))
_JSON_OPTIONS = orjson.OPT_SERIALIZE_NUMPY


def frame_record(port: str, t_ns: int, direction: str, datagram: bytes) -> Record:
    """Return the record of one datagram at a port; ``direction`` is ``sent`` or ``received``."""
    body = {"t_ns": t_ns, "direction": direction, "frame": b2a_base64(datagram, newline=False).decode("ascii")}
    return Record(f"mavlink/{port}", t_ns, body)


def _plain(value: object) -> object:
    """Return what orjson does not know by itself: arrays that are not contiguous, read-only mappings."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, Mapping):
        return dict(value)
    raise TypeError(f"no JSON for {type(value).__name__}")


def encode_line(record: Record, log_time_ns: int) -> bytes:
    r"""Return a record as one line of JSON, ending in ``\n``.

    Raises
    ------
    ValueError
        If the line would be longer than ``MAX_LINE_BYTES``.
    """
    content = {"topic": record.topic, "t_ns": record.t_ns, "log_time_ns": log_time_ns, "body": record.body}
    line = orjson.dumps(content, default=_plain, option=_JSON_OPTIONS | orjson.OPT_APPEND_NEWLINE)
    if len(line) > MAX_LINE_BYTES:
        raise ValueError(f"record of {record.topic}: {len(line)} bytes, at most {MAX_LINE_BYTES}")
    return line


def decode_line(line: bytes) -> tuple[Record, int]:
    """Return the record of one line and its log time in ns; the inverse of ``encode_line``.

    Raises
    ------
    ValueError
        If the line is not one that ``encode_line`` makes: too long, no JSON, other keys, an unknown topic,
        a body that is no object, a time that is no integer or out of range.
    """
    if len(line) > MAX_LINE_BYTES:
        raise ValueError(f"line of {len(line)} bytes, at most {MAX_LINE_BYTES}")
    content = orjson.loads(line)
    if type(content) is not dict or content.keys() != _LINE_KEYS:
        raise ValueError(f"line is no object with the keys {', '.join(sorted(_LINE_KEYS))}")
    topic, t_ns = content["topic"], content["t_ns"]
    log_time_ns, body = content["log_time_ns"], content["body"]
    if type(topic) is not str or not is_topic(topic):
        raise ValueError(f"unknown topic {str(topic)[:80]!r}")
    if type(body) is not dict:
        raise ValueError(f"{topic}: body is no object")
    if type(t_ns) is not int or not -_TIME_LIMIT_NS <= t_ns < _TIME_LIMIT_NS:
        raise ValueError(f"{topic}: t_ns is no 64-bit integer")
    if type(log_time_ns) is not int or not 0 <= log_time_ns < _TIME_LIMIT_NS:
        raise ValueError(f"{topic}: log_time_ns is no 64-bit integer from 0")
    return Record(topic, t_ns, body), log_time_ns


class _File:
    """An append-only file: collects bytes, hands them over in one write, remembers its first failure.

    Neither unbuffered (a system call per message) nor buffered (a finished chunk of 4 KiB would wait in an
    8 KiB buffer): ``drain`` says when.
    """

    def __init__(self, path: str | os.PathLike[str]):
        self._raw = FileIO(path, "w")
        self._pending = bytearray()
        self._full = False
        self.error = ""

    def write(self, data: bytes) -> None:
        self._pending += data

    @property
    def pending(self) -> int:
        return len(self._pending)

    def drain(self) -> bool:
        """Hand all collected bytes to the operating system; return whether it took them."""
        data = memoryview(bytes(self._pending))
        self._pending.clear()
        try:
            while data and not self.error:
                if self._full:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                data = data[self._raw.write(data) :]
        except OSError as failure:
            self._fail(failure)
        return not self.error

    def fill_disk(self) -> None:
        """Let every further write fail as on a full disk."""
        self._full = True

    def close(self) -> bool:
        done = self.drain()
        try:
            self._raw.close()
        except OSError as failure:
            self._fail(failure)
            return False
        return done

    def _fail(self, failure: OSError) -> None:
        self.error = self.error or f"{os.fsdecode(str(self._raw.name))}: {failure.strerror or failure}"


class McapRecorder:
    """Writes records to an MCAP file: JSON with JSON Schema, small zstd chunks, each written at once.

    Parameters
    ----------
    path : path
        The file; an existing one is replaced.
    metadata : mapping of str to str
        Written once at the start under the name ``flight``: scenario, seed, versions and so on.
    attachments : mapping of str to bytes, optional
        Texts of the files that the flight was flown with, by name; written at the start, too, so that a recording
        that is cut off has them.

    Attributes
    ----------
    lost : int
        Messages that did not reach the file after it failed, all those of the torn chunk included.
    refused : int
        Messages of topics beyond ``MAX_TOPICS``.
    error : str
        What ended the recording; empty while it goes well.

    Raises
    ------
    OSError
        If the file cannot be opened or takes no header.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        metadata: Mapping[str, str],
        attachments: Mapping[str, bytes] = MappingProxyType({}),
    ):
        self.lost = 0
        self.refused = 0
        self._file = _File(path)
        self._closed = False
        self._channels: dict[str, int] = {}
        self._unsaved = 0
        self._chunk_start_ns = 0
        self._writer = McapWriter(self._file, _PROFILE, _PROFILE, CHUNK_BYTES)
        self._writer.add_metadata(METADATA_NAME, metadata)
        if not self._file.drain():
            self._file.close()
            raise OSError(self._file.error)
        for name, content in attachments.items():  # at time 0: nothing of the wall clock
            self._writer.add_attachment(name, ATTACHMENT_TYPE, content)
        self._file.drain()  # a disk that is full by now ends the recording, not the flight

    @property
    def error(self) -> str:
        """What ended the recording; empty while it goes well."""
        return self._file.error

    def write(self, record: Record, log_time_ns: int) -> None:
        """Add one record at a true time since the start of the flight, ns, at least 0.

        Never raises for the file's sake: after a failure it only counts.

        Raises
        ------
        ValueError
            If the topic is unknown.
        """
        assert not self._closed, "recording is closed"
        assert log_time_ns >= 0, log_time_ns
        channel = self._channels.get(record.topic)
        if channel is None:
            channel = self._register(record.topic)
        if channel is None:
            self.refused += 1
            return
        if self._file.error:
            self.lost += 1
            return
        if not self._unsaved:
            self._chunk_start_ns = log_time_ns
        self._unsaved += 1
        data = orjson.dumps(record.body, _plain, _JSON_OPTIONS)
        written = self._writer.add_message(channel, log_time_ns, data)
        if not written and log_time_ns - self._chunk_start_ns >= MAX_CHUNK_NS:
            written = self._writer.flush()
        if written:
            self._drain()

    def fill_disk(self) -> None:
        """Let the disk be full from now on, on demand: what has not reached the file by now does not."""
        self._file.fill_disk()

    def close(self) -> None:
        """Write the last chunk and the summary, and close the file; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        if not self._file.error:
            self._writer.finish()
            self._drain()
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _register(self, topic: str) -> int | None:
        """Return a new channel, or None where the file holds too many."""
        schema = schema_of(topic)
        if len(self._channels) >= MAX_TOPICS:
            return None
        text = orjson.dumps(dict(schema))
        name = "mavlink/datagram" if schema is FRAME_SCHEMA else topic
        channel = self._writer.register(topic, "json", name, "jsonschema", text)
        self._channels[topic] = channel
        if self._file.pending:
            self._drain()  # the schema filled the chunk; the next message opens another
        return channel

    def _drain(self) -> None:
        if not self._file.drain():
            self.lost += self._unsaved
        self._unsaved = 0


class TlogWriter:
    """Writes a telemetry log as ground stations do: big-endian u64 time in µs, then the frame.

    Parameters
    ----------
    path : path
        The file; an existing one is replaced.

    Attributes
    ----------
    lost : int
        Frames that did not reach the file after it failed.
    error : str
        What ended the log; empty while it goes well.
    """

    def __init__(self, path: str | os.PathLike[str]):
        self.lost = 0
        self._file = _File(path)
        self._unsaved = 0
        self._first_us = 0

    @property
    def error(self) -> str:
        """What ended the log; empty while it goes well."""
        return self._file.error

    def write(self, frame: bytes, time_us: int) -> None:
        """Add exactly one frame; never raises for the file's sake."""
        if self._file.error:
            self.lost += 1
            return
        if not self._unsaved:
            self._first_us = time_us
        self._file.write(time_us.to_bytes(8, "big") + frame)
        self._unsaved += 1
        if self._unsaved >= FRAMES_PER_FLUSH or time_us - self._first_us >= MAX_FLUSH_US:
            self._drain()

    def fill_disk(self) -> None:
        """Let the disk be full from now on, on demand: what has not reached the file by now does not."""
        self._file.fill_disk()

    def close(self) -> None:
        """Write what is left and close the file."""
        self._drain()
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _drain(self) -> None:
        if not self._file.drain():
            self.lost += self._unsaved
        self._unsaved = 0


def read_mcap(path: str | os.PathLike[str]) -> Iterator[tuple[str, int, dict[str, Any]]]:
    """Yield (topic, log time in ns, body) of every message of a finished recording, in file order."""
    with open(path, "rb") as file:
        for _, channel, message in make_reader(file).iter_messages(log_time_order=False):
            yield channel.topic, message.log_time, orjson.loads(message.data)


def read_metadata(path: str | os.PathLike[str]) -> dict[str, str]:
    """Return what ``McapRecorder`` was told about the flight; empty where the file does not say."""
    with open(path, "rb") as file:
        for metadata in make_reader(file).iter_metadata():
            if metadata.name == METADATA_NAME:
                return metadata.metadata
    return {}
