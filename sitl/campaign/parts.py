"""Results of a campaign on disk: a folder of Parquet files, each a range of flights, and what the campaign is.

    _campaign.json                                  the description, and the campaign's identity
    flights-000000000000-000000131072.parquet       flights from 0 to before 131072, one row each

A part is written beside its place and moved there, so one that is there is whole; which are there is all that a resumed
campaign needs to know. One that is damaged all the same is put aside, and its flights are flown again. The folder reads
as one table in any tool, ``pandas.read_parquet("folder")``, DuckDB, Polars: what begins with _ or . they pass over.
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import orjson
import pyarrow as pa
import pyarrow.parquet as pq

from gains.atomic import replace_file
from gains.table import InputError
from sitl.campaign.engine import Columns

__all__ = ["Part", "Parts", "missing_ranges"]

DESCRIPTION = "_campaign.json"
_NAME = re.compile(r"flights-([0-9]{12})-([0-9]{12})\.parquet")


class Part(NamedTuple):
    """One file, and its flights from ``start`` to before ``stop``."""

    start: int
    stop: int
    path: Path


class Parts:
    """The folder of one campaign.

    Parameters
    ----------
    folder : Path
        Made when it is not there.
    identity : str
        The campaign's.
    description : mapping
        What is written beside the parts.

    Attributes
    ----------
    aside : int
        Files that were put aside.

    Raises
    ------
    InputError
        When the folder holds something else.
    """

    def __init__(self, folder: Path, identity: str, description: Mapping[str, Any]) -> None:
        self.folder = folder
        self.aside = 0
        self._parts: list[Part] = []
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._claim(identity, description)
        except OSError as error:
            raise InputError(f"{folder}: expected a folder that can be written, found: {error.strerror}") from None

    def _claim(self, identity: str, description: Mapping[str, Any]) -> None:
        """Write the description, where there is none of another campaign."""
        path = self.folder / DESCRIPTION
        if path.exists():
            try:
                found = orjson.loads(path.read_bytes())["identity"]
            except (orjson.JSONDecodeError, KeyError, TypeError):
                raise InputError(f"{path}: expected the description of a campaign, found something else") from None
            if found != identity:
                raise InputError(
                    f"{self.folder}: expected an empty folder or results of the same campaign, found those of another"
                    f" ({str(found)[:12]}, not {identity[:12]})"
                )
        elif any(self.folder.iterdir()):
            raise InputError(f"{self.folder}: expected an empty folder or one with {DESCRIPTION}, found other files")
        replace_file(path, orjson.dumps({**description, "identity": identity}, option=orjson.OPT_INDENT_2))

    def found(self, names: Collection[str]) -> list[Part]:
        """Return the whole parts, in the order of flights.

        What is damaged, overlaps an earlier one, or has other flights or columns than its name and ``names`` say, is
        put aside and counted.
        """
        parts: list[Part] = []
        self._parts = parts
        for path in sorted(self.folder.iterdir()):
            match = _NAME.fullmatch(path.name)
            if match is None:
                continue
            start, stop = int(match[1]), int(match[2])
            if (not parts or start >= parts[-1].stop) and _is_whole(path, start, stop, names):
                parts.append(Part(start, stop, path))
            else:
                path.replace(path.with_name(f"_aside-{path.name}"))
                self.aside += 1
        return list(parts)

    def write(self, start: int, stop: int, columns: Columns) -> None:
        """Write one part.

        Raises
        ------
        InputError
            When it cannot be written, the disk being full for example.
        """
        path = self.folder / f"flights-{start:012d}-{stop:012d}.parquet"
        unfinished = path.with_name(f".{path.stem}.{os.getpid()}.tmp")
        try:
            pq.write_table(pa.table(dict(columns)), unfinished, compression="zstd", write_page_checksum=True)
            os.replace(unfinished, path)
        except OSError as error:
            unfinished.unlink(missing_ok=True)
            raise InputError(f"{path}: cannot be written: {error.strerror or error}") from None
        self._parts.append(Part(start, stop, path))

    def read(self, flights: int) -> Iterator[Columns]:
        """Yield the columns of the parts that were found or written, up to a number of flights, in order."""
        for part in sorted(self._parts):
            if part.start < flights:
                table = pq.read_table(part.path).slice(0, flights - part.start)
                yield {name: np.asarray(table[name]) for name in table.column_names}


def _is_whole(path: Path, start: int, stop: int, names: Collection[str]) -> bool:
    """Return whether a file can be read, and has these flights and columns."""
    try:
        table = pq.read_table(path, page_checksum_verification=True)
    except (OSError, pa.ArrowException):
        return False
    if set(table.column_names) != set(names) or not 0 < stop - start == table.num_rows:
        return False
    return np.array_equal(np.asarray(table["flight"]), np.arange(start, stop))


def missing_ranges(parts: list[Part], flights: int) -> list[tuple[int, int]]:
    """Return the ranges of flights before ``flights`` that no part has, in order."""
    ranges, at = [], 0
    for part in parts:
        if part.start > at:
            ranges.append((at, min(part.start, flights)))
        at = part.stop
        if at >= flights:
            break
    return [*ranges, (at, flights)] if at < flights else ranges
