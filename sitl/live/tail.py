"""The growing file: its new bytes, whether it has been begun anew, and which of many is the newest.

A program that is started again with the same ``--record`` empties its file and fills it again; an editor or a copy
puts another file in its place. Either way what was read before is no beginning of what comes now, and the reading
starts over. A file that is emptied and is longer again before anybody looked is known by its first bytes and those
before the place that was reached: they are compared each time.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

__all__ = ["MAX_FILES", "PIECE_BYTES", "Piece", "Tail", "Watch"]

PIECE_BYTES = 1 << 16
"""The most that is read at once."""
MAX_FILES = 1 << 13
"""Entries of folders that are looked at in one search for the newest recording."""

_COMPARED_BYTES = 1024
_SUFFIX = ".mcap"


class Piece(NamedTuple):
    """What is new in a file; ``anew``: it does not continue what was read before."""

    data: bytes
    anew: bool


class Tail:
    """Reads a file as it grows. It need not exist yet, and may go; only a regular file is read.

    Attributes
    ----------
    path : Path
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._fd: int | None = None
        self._position = 0
        self._head = self._before = b""

    def read(self) -> Piece:
        """Return the next bytes, at most PIECE_BYTES; none while there are none, whatever the reason is."""
        try:
            anew = self._reopened()
            if self._fd is None:
                return Piece(b"", False)
            if not anew and not self._continues():
                anew, self._position, self._head, self._before = True, 0, b"", b""
            data = os.pread(self._fd, PIECE_BYTES, self._position)
        except OSError:
            return Piece(b"", False)
        self._position += len(data)
        self._head = (self._head + data[:_COMPARED_BYTES])[:_COMPARED_BYTES]
        self._before = (self._before + data)[-_COMPARED_BYTES:]
        return Piece(data, anew)

    def close(self) -> None:
        """Close the file."""
        if self._fd is not None:
            os.close(self._fd)
            self._fd = None

    def _reopened(self) -> bool:
        """Open the file where none is open or another one stands in its place; return whether that was a change."""
        try:
            there = os.stat(self.path)
        except OSError:
            return False  # gone, but what is open can be read to its end
        if self._fd is not None and os.path.samestat(os.fstat(self._fd), there):
            return False
        if not stat.S_ISREG(there.st_mode):
            return False
        fd = os.open(self.path, os.O_RDONLY | os.O_NONBLOCK)  # a pipe put there meanwhile must not hold us
        had_one = self._fd is not None
        self.close()
        self._fd, self._position, self._head, self._before = fd, 0, b"", b""
        return had_one

    def _continues(self) -> bool:
        assert self._fd is not None
        head = os.pread(self._fd, len(self._head), 0)
        before = os.pread(self._fd, len(self._before), self._position - len(self._before))
        return (head, before) == (self._head, self._before)


class Watch:
    """Which recording to follow: the newest of a folder and of the folders in it, and from then on each new one.

    A file is new when it was not there at the last look, or is another file of that name, or has become shorter: it
    was begun anew. Time of change decides between several; it does not for those that were there before, since two
    flights at once would take turns.

    Attributes
    ----------
    unseen : int
        Entries beyond MAX_FILES at the last look, which were passed over.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.unseen = 0
        self._known: dict[tuple[str, int, int], int] = {}

    def look(self) -> Path | None:
        """Return the recording to go on to; None when there is no new one."""
        self.unseen = 0
        found = {(path, there.st_dev, there.st_ino): there for path, there in self._recordings()}
        new = [
            (there.st_mtime_ns, key[0]) for key, there in found.items() if there.st_size < self._known.get(key, 1 << 63)
        ]
        self._known = {key: there.st_size for key, there in found.items()}
        return Path(max(new)[1]) if new else None

    def _recordings(self) -> Iterator[tuple[str, os.stat_result]]:
        budget = MAX_FILES
        folders = [str(self.folder)]
        for depth in range(2):
            below: list[str] = []
            for folder in folders:
                for entry in _entries(folder):
                    budget -= 1
                    if budget < 0:
                        self.unseen += 1
                    elif entry.name.endswith(_SUFFIX):
                        try:
                            there = entry.stat()
                        except OSError:
                            continue
                        if stat.S_ISREG(there.st_mode):
                            yield entry.path, there
                    elif depth == 0 and entry.is_dir():
                        below.append(entry.path)
            folders = sorted(below, reverse=True)  # the newest first, as their names are times


def _entries(folder: str) -> list[os.DirEntry[str]]:
    try:
        with os.scandir(folder) as entries:
            return list(entries)
    except OSError:
        return []
