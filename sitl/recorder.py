"""The flight's recorder: the MCAP and the tlog of one flight, and what the summary needs, in memory.

It takes the records of all processes with true times since the start of the flight. Frames go to the
files only; everything else is kept for the summary and the plot.

A full disk ends the files and not the flight: what they lack is counted and told, the flight goes on, and
``sitl recover`` reads what was written up to then.
"""

from __future__ import annotations

import contextlib
import errno
import os
import sys
from binascii import a2b_base64
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

from autopilot.link.clock import NS_PER_US
from autopilot.link.node import Record
from autopilot.link.record import McapRecorder, TlogWriter
from autopilot.link.wire import split_frames
from gains.table import InputError

__all__ = ["MAX_KEPT", "FlightRecorder"]

MAX_KEPT = 4_000_000
"""Records kept in memory, a few hours of flight; further ones are in the files only, and counted."""

Kept = tuple[str, int, Mapping[str, Any]]


class FlightRecorder:
    """Writes ``flight.mcap`` and ``flight.tlog`` into a folder, which it makes.

    Parameters
    ----------
    folder : Path or None
        None keeps the flight in memory only.
    metadata : mapping of str to str
        Of the MCAP file.
    unix_us : int
        Unix time of the start of the flight, for the tlog; 0 in virtual time, where there is none.
    tlog_port : str
        The port whose frames the tlog holds: one link, as a ground station would have logged it.
    attachments : mapping of str to bytes, optional
        Files that the MCAP file shall hold, by name.

    Attributes
    ----------
    kept : list of (topic, log_time_ns, body)
        All records but frames.
    unkept : int
        Records beyond MAX_KEPT.
    malformed : int
        Records that came from another process and were none.
    files : dict of str to Path
        What has been written, by its name in the summary.

    Raises
    ------
    InputError
        When the folder or the files cannot be made.
    """

    def __init__(
        self,
        folder: Path | None,
        metadata: Mapping[str, str],
        unix_us: int = 0,
        tlog_port: str = "gcs0",
        attachments: Mapping[str, bytes] = MappingProxyType({}),
    ) -> None:
        self.kept: list[Kept] = []
        self.unkept = 0
        self.malformed = 0
        self.metadata = dict(metadata)
        self.files: dict[str, Path] = {}
        self._unix_us = unix_us
        self._tlog_topic = f"mavlink/{tlog_port}"
        self._mcap: McapRecorder | None = None
        self._tlog: TlogWriter | None = None
        self._full = False
        self._unsaved: list[str] = []
        if folder is None:
            return
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self.files = {"mcap": folder / "flight.mcap", "tlog": folder / "flight.tlog"}
            self._mcap = McapRecorder(self.files["mcap"], metadata, attachments)
            self._tlog = TlogWriter(self.files["tlog"])
        except OSError as error:
            raise InputError(f"{folder}: {error.strerror or error}") from None

    def write(self, record: Record, log_time_ns: int) -> None:
        """Take a record made ``log_time_ns`` after the start of the flight."""
        if record.topic.startswith("mavlink/"):
            if self._tlog is not None and record.topic == self._tlog_topic:
                time_us = self._unix_us + log_time_ns // NS_PER_US
                for frame in split_frames(a2b_base64(record.body["frame"]))[0]:
                    self._tlog.write(frame, time_us)
        elif len(self.kept) < MAX_KEPT:
            self.kept.append((sys.intern(record.topic), log_time_ns, record.body))
        else:
            self.unkept += 1
        if self._mcap is not None:
            self._mcap.write(record, log_time_ns)

    def fill_disk(self) -> None:
        """Let the disk be full from now on: the fault ``disk-full``. All further writes fail."""
        self._full = True
        for writer in (self._mcap, self._tlog):
            if writer is not None:
                writer.fill_disk()

    def save(self, name: str, path: Path, write: Callable[[Path], object]) -> None:
        """Write a further file of the flight; where that fails, it is a problem for the summary, and no file.

        Parameters
        ----------
        name : str
            Of the file in the summary.
        path : Path
            Where it goes.
        write : callable
            Writes it there; an OSError of it is not passed on.
        """
        try:
            if self._full:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            write(path)
        except OSError as failure:
            self._unsaved.append(f"{path}: {failure.strerror or failure}")
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)  # a part of a file, or that of another flight
        else:
            self.files[name] = path

    @property
    def problems(self) -> list[str]:
        """What went wrong with the files, for the summary."""
        problems = [f"{w.error}: {w.lost} lost" for w in (self._mcap, self._tlog) if w is not None and w.error]
        problems += self._unsaved
        if self._mcap is not None and self._mcap.refused:
            problems.append(f"{self._mcap.refused} records of too many topics are not in the files")
        if self.unkept:
            problems.append(f"{self.unkept} records are in the files only: the summary leaves them out")
        for topic, _, body in self.kept:
            if topic == "events" and body["kind"] == "ports" and body["data"]["records_lost"]:
                problems.append(f"{body['node']} could not record {body['data']['records_lost']} records")
        if self.malformed:
            problems.append(f"{self.malformed} malformed records were dropped")
        return problems

    def close(self) -> None:
        """Finish the files."""
        if self._mcap is not None:
            self._mcap.close()
        if self._tlog is not None:
            self._tlog.close()

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Finish the files."""
        self.close()
