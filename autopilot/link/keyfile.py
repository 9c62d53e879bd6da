"""The files of MAVLink signing: the key, and the timestamps that must outlive a restart.

A key file is private to its owner, and nothing of its content ever appears in a message. Beside the key file NAME
a program keeps NAME.PROGRAM.timestamps, one file per program, so that programs that share a key never overwrite each
other's; only one run of a program may use a key file at a time. Entries are found by port and by a fingerprint
of the key, so floors of a former key say nothing about the present one, and are still there when it comes back.

The file is replaced as a whole: a temporary file takes its name. However the program ends, the file is complete, and
`signing.py` relies on nothing that is not in it yet. At start and at the end it is also flushed to the disk, in flight
it is not, because a disk may take longer for that than a sample lasts: after a loss of power, or a crash of the whole
machine, the floors may be as old as what the system had last written back.
On Windows neither owner nor mode is checked: access is not expressed by them there.
"""

from __future__ import annotations

import os
import stat
import unicodedata
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from time import time_ns  # noqa: TID251  timestamps of signatures count from a date

import tomli_w

from autopilot.link.clock import NS_PER_S
from autopilot.link.signing import LAST_TIMESTAMP, MAX_STREAMS, UNIT_NS, Signing, Stream, Timestamps, timestamp_of
from gains.atomic import replace_file
from gains.table import InputError, Table

__all__ = ["TimestampStore", "read_key", "timestamps_path", "wall_clock_start"]

MAX_KEY_FILE_BYTES = 4096
MAX_TIMESTAMPS_BYTES = 1 << 20
MAX_ENTRIES = 64
"""Ports times keys that one timestamps file holds; full entries of so many stay far below its largest size."""

WRITE_PERIOD_NS = NS_PER_S
EARLY_PERIOD_NS = NS_PER_S // 10
"""How soon the file is written again when a link waits for it: no peer can make it a matter of every frame."""

_POSIX = os.name == "posix"
_HEX = frozenset("0123456789abcdefABCDEF")
_KEY_DIGITS = 64


def read_key(path: str | Path) -> bytes:
    """Return the signing key of a key file.

    Exactly 64 hexadecimal digits are the key itself; any other line is a passphrase, and the SHA-256 of its UTF-8 is
    the key, as MAVProxy, QGroundControl and Mission Planner derive it.

    Returns
    -------
    bytes, 32

    Raises
    ------
    InputError
        When the file is missing, not a regular file, somebody else's, open to others, or not one line of text; blanks
        around the line count as a mistake, since nobody would see them.
    """
    content = _read_private(path, "a key file", MAX_KEY_FILE_BYTES)
    try:
        line = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        # Not chained: the error would carry the content.
        problem: str | None = f"byte {error.start}, which is no UTF-8"
    else:
        line = line.removesuffix("\n").removesuffix("\r")
        problem = _problem_of(line)
    if problem is not None:
        raise InputError(f"{path}: expected one line, 64 hexadecimal digits or a passphrase, found {problem}")
    if len(line) == _KEY_DIGITS and _HEX.issuperset(line):
        return bytes.fromhex(line)
    return sha256(line.encode("utf-8")).digest()


def _problem_of(line: str) -> str | None:
    """Return why a line is neither a key nor a passphrase, without saying what is in it; None when it may be one."""
    if not line:
        return "an empty file"
    if "\n" in line or "\r" in line:
        return "several lines"
    if any(unicodedata.category(character) == "Cc" for character in line):
        return "control characters"
    if line != line.strip():
        return "blanks at an end of the line"
    return None


def _read_private(path: str | Path, what: str, max_bytes: int) -> bytes:
    """Return the content of a regular file that nobody but its owner, us, can read or change.

    All checks are of the file that was opened, not of a name that may stand for another one by then.
    """
    try:
        with open(path, "rb", opener=_open_at_once) as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise InputError(f"{path}: expected {what}, found something that is no regular file")
            if _POSIX:
                _require_private(path, what, status)
            content = file.read(max_bytes + 1)
    except FileNotFoundError:
        raise InputError(f"{path}: expected {what}, found nothing of that name") from None
    except OSError as error:
        raise InputError(f"{path}: expected {what} that can be read, found: {error.strerror}") from None
    except ValueError as error:  # a NUL in the name
        raise InputError(f"{path}: expected a file name, found: {error}") from None
    if len(content) > max_bytes:
        raise InputError(f"{path}: expected {what} of at most {max_bytes} bytes, found more")
    return content


def _open_at_once(path: str, flags: int) -> int:
    """Open a file, and a pipe without waiting for its other end: what it is shows only when it is open."""
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def _require_private(path: str | Path, what: str, status: os.stat_result) -> None:
    mode = stat.S_IMODE(status.st_mode)
    if status.st_uid != os.geteuid():
        raise InputError(f"{path}: expected {what} of user {os.geteuid()}, found one of user {status.st_uid}")
    if mode & 0o177:
        raise InputError(f"{path}: expected {what} of mode 0600 or stricter, found mode {mode:04o}")


def wall_clock_start(now_ns: int) -> int:
    """Return what the wall clock showed when a clock that shows ``now_ns`` now was zero.

    Parameters
    ----------
    now_ns : int
        A node's own time at this instant.

    Returns
    -------
    int
        In units of 10 µs since 2015 GMT; negative for a machine that does not know the date.

    Raises
    ------
    InputError
        When the date is beyond what a timestamp can say.
    """
    timestamp = timestamp_of(time_ns())
    if timestamp > LAST_TIMESTAMP:
        raise InputError("clock: expected a date before 2104, found a later one")
    return timestamp - now_ns // UNIT_NS


def timestamps_path(key_file: str | Path, program: str) -> Path:
    """Return where a program keeps the timestamps that belong to a key file."""
    path = Path(key_file)
    return path.with_name(f"{path.name}.{program}.timestamps")


@dataclass(frozen=True, slots=True)
class _Entry:
    """What the file says about one port under one key."""

    port: str
    key: str

    def as_table(self, timestamps: Timestamps) -> dict[str, object]:
        """Return the entry as a table for the file."""
        streams = [
            {"system": system, "component": component, "link": link, "floor": floor}
            for (system, component, link), floor in timestamps.floors.items()
        ]
        return {
            "name": self.port,
            "key": self.key,
            "next": timestamps.next,
            "unseen": timestamps.unseen,
            "stream": streams,
        }


class TimestampStore:
    """The timestamps file of one program, written ahead while its links run.

    For each port: make its :class:`Signing` from :meth:`load`, then :meth:`attach` it; all this before a socket opens.
    Call :meth:`pass_` on every pass of the driver and :meth:`close` at the end, however it came.

    Parameters
    ----------
    key_file : str or Path
        The key file, beside which the timestamps are kept.
    program : str
        The program's name.
    key : bytes, 32
        What :func:`read_key` returned.

    Attributes
    ----------
    path : Path
        The timestamps file.
    writes : int
        How often it was written.
    failures : int
        How often writing failed; until it works again, a crash leaves the floors of the last write.
    failure : str
        What the system said about the last failure.

    Raises
    ------
    InputError
        When the file is there and malformed or not private; a missing one is a first run.
    """

    def __init__(self, key_file: str | Path, program: str, key: bytes) -> None:
        self.path = timestamps_path(key_file, program)
        self.writes = 0
        self.failures = 0
        self.failure = ""
        self._key = _fingerprint(key)
        self._entries: dict[_Entry, Timestamps] = _read_entries(self.path) if os.path.lexists(self.path) else {}
        self._links: dict[_Entry, Signing] = {}
        self._written_ns: int | None = None
        self._closed = False

    def load(self, port: str) -> Timestamps:
        """Return what earlier runs left for a port under this key; nothing is known of a new one."""
        return self._entries.get(_Entry(port, self._key), Timestamps())

    def attach(self, port: str, signing: Signing) -> None:
        """Keep the timestamps of a port's link from here on; the first reserve is written at once.

        Raises
        ------
        InputError
            When the file cannot be written, or holds too many entries.
        """
        entry = _Entry(port, self._key)
        if entry not in self._entries and len(self._entries) >= MAX_ENTRIES:
            raise InputError(
                f"{self.path}: expected at most {MAX_ENTRIES} entries, found no room for port {port}; "
                "delete the entries of keys that are out of use"
            )
        self._links[entry] = signing
        self._write({link: own.ahead() for link, own in self._links.items()}, flush=True)
        if self.failure:
            raise InputError(f"{self.path}: expected a file that can be written, found: {self.failure}")

    def pass_(self, now_ns: int) -> None:
        """Write what changed if a second has passed, or sooner if a link waits for it.

        Parameters
        ----------
        now_ns : int
            The driver's time; only differences count.
        """
        if self._closed or not self._links:
            return
        if self._written_ns is not None:
            waiting = any(link.wants_store for link in self._links.values())
            if now_ns - self._written_ns < (EARLY_PERIOD_NS if waiting else WRITE_PERIOD_NS):
                return
        self._written_ns = now_ns
        ahead = {entry: link.ahead() for entry, link in self._links.items()}
        if any(self._entries.get(entry) != timestamps for entry, timestamps in ahead.items()):
            self._write(ahead, flush=False)

    def close(self) -> None:
        """Write the exact values; no frame may be signed or accepted afterwards."""
        if self._closed:
            return
        self._closed = True
        if self._links:
            self._write({entry: link.exact() for entry, link in self._links.items()}, flush=True)

    def _write(self, timestamps: dict[_Entry, Timestamps], *, flush: bool) -> None:
        """Write all entries, some of them new, and tell the links what holds now; count a failure."""
        entries = {**self._entries, **timestamps}
        content = tomli_w.dumps({"port": [entry.as_table(of) for entry, of in entries.items()]})
        try:
            replace_file(self.path, content.encode("utf-8"), private=True, flush=flush)
        except OSError as error:
            self.failures += 1
            self.failure = error.strerror or type(error).__name__
            for link in self._links.values():
                link.stored(None)
            return
        self.writes += 1
        self.failure = ""
        self._entries = entries
        for entry, link in self._links.items():
            link.stored(timestamps[entry])


def _fingerprint(key: bytes) -> str:
    """Return what tells keys apart and does not help to find one."""
    return sha256(b"timestamps of the key " + key).hexdigest()[:16]


def _read_entries(path: Path) -> dict[_Entry, Timestamps]:
    content = _read_private(path, "a file of timestamps", MAX_TIMESTAMPS_BYTES)
    table = Table.parse(content, str(path))
    ports = table.tables("port", ())
    if len(ports) > MAX_ENTRIES:
        raise table.error("port", f"at most {MAX_ENTRIES} entries", str(len(ports)))
    entries: dict[_Entry, Timestamps] = {}
    for port in ports:
        entry = _Entry(port.string("name"), port.string("key"))
        if entry in entries:
            raise port.error("name", "one entry per port and key", f"{entry.port} twice")
        floors = _read_floors(port)
        due, unseen = (port.integer(name, low=-1, high=LAST_TIMESTAMP) for name in ("next", "unseen"))
        entries[entry] = Timestamps(due, unseen, floors)
    table.finish()
    return entries


def _read_floors(port: Table) -> dict[Stream, int]:
    streams = port.tables("stream", ())
    if len(streams) > MAX_STREAMS:
        raise port.error("stream", f"at most {MAX_STREAMS} streams", str(len(streams)))
    floors: dict[Stream, int] = {}
    for table in streams:
        system, component, link = (table.integer(name, low=0, high=255) for name in ("system", "component", "link"))
        if (system, component, link) in floors:
            raise port.error("stream", "every stream once", f"{system}, {component}, {link} twice")
        floors[system, component, link] = table.integer("floor", low=-1, high=LAST_TIMESTAMP)
    return floors
