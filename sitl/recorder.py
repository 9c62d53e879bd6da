"""The flight's recorder: the MCAP and the tlog of one flight, and what the summary needs, in memory.

It takes the records of all processes with true times since the start of the flight. Frames go to the
files only; everything else is kept for the summary and the plot.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from pathlib import Path
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

    Attributes
    ----------
    kept : list of (topic, log_time_ns, body)
        All records but frames.
    unkept : int
        Records beyond MAX_KEPT.
    malformed : int
        Records that came from another process and were none.

    Raises
    ------
    InputError
        When the folder or the files cannot be made.
    """

    def __init__(
        self, folder: Path | None, metadata: Mapping[str, str], unix_us: int = 0, tlog_port: str = "gcs0"
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
        if folder is None:
            return
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self.files = {"mcap": folder / "flight.mcap", "tlog": folder / "flight.tlog"}
            self._mcap = McapRecorder(self.files["mcap"], metadata)
            self._tlog = TlogWriter(self.files["tlog"])
        except OSError as error:
            raise InputError(f"{folder}: {error.strerror or error}") from None

    def write(self, record: Record, log_time_ns: int) -> None:
        """Take a record made ``log_time_ns`` after the start of the flight."""
        if record.topic.startswith("mavlink/"):
            if self._tlog is not None and record.topic == self._tlog_topic:
                time_us = self._unix_us + log_time_ns // NS_PER_US
                for frame in split_frames(base64.b64decode(record.body["frame"]))[0]:
                    self._tlog.write(frame, time_us)
        elif len(self.kept) < MAX_KEPT:
            self.kept.append((record.topic, log_time_ns, record.body))
        else:
            self.unkept += 1
        if self._mcap is not None:
            self._mcap.write(record, log_time_ns)

    @property
    def problems(self) -> list[str]:
        """What went wrong with the files, for the summary."""
        problems = [f"{w.error}: {w.lost} lost" for w in (self._mcap, self._tlog) if w is not None and w.error]
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
