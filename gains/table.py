"""Tables of a TOML file, read with exact complaints.

A :class:`Table` knows the file and the field it came from, so that each check is one line where it is
made and each complaint reads ``FILE: FIELD: expected …, found …``. Keys that nobody asked for are refused
by :meth:`Table.finish`: a misspelt optional key must not pass for an absent one.
"""

from __future__ import annotations

import difflib
import json
import math
import re
import tomllib
from collections.abc import Callable, Iterator, Mapping
from enum import Enum
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

__all__ = ["MAX_FILE_BYTES", "InputError", "Table", "describe", "read_content"]

MAX_FILE_BYTES = 64 * 2**20  # a certificate of some hundred modes stays far below

T = TypeVar("T")
V = TypeVar("V")
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_MAX_SHOWN = 40


class InputError(Exception):
    """A file or a value that a user gave cannot be used; its message is one printable line."""

    def __init__(self, message: str) -> None:
        super().__init__("".join(c if c.isprintable() else ascii(c)[1:-1] for c in message))


class _Absent(Enum):
    REQUIRED = "required"


REQUIRED: Final = _Absent.REQUIRED


def read_content(path: str | Path, what: str) -> bytes:
    """Return the content of a file of at most ``MAX_FILE_BYTES``.

    Parameters
    ----------
    path : str or Path
    what : str
        What is expected there, for the complaint about nothing.

    Raises
    ------
    InputError
        When the file is missing, unreadable or too large.
    """
    try:
        with open(path, "rb") as file:
            content = file.read(MAX_FILE_BYTES + 1)
    except FileNotFoundError:
        raise InputError(f"{path}: expected {what}, found nothing of that name") from None
    except OSError as error:
        raise InputError(f"{path}: expected a readable file, found: {error.strerror}") from None
    except ValueError as error:  # a NUL in the name
        raise InputError(f"{path}: expected a file name, found: {error}") from None
    if len(content) > MAX_FILE_BYTES:
        raise InputError(f"{path}: expected at most {MAX_FILE_BYTES} bytes, found more")
    return content


class Table:
    """A table of a TOML file and its place there.

    Parameters
    ----------
    data : Mapping[str, object]
        What ``tomllib`` read.
    source : str
        The file, as complaints shall name it.
    field : str
        The table's own place in the file; empty for the whole file.

    Notes
    -----
    A reading method called without ``default`` requires the key; otherwise an absent key gives the
    default, unchecked. Booleans are not numbers; an integer is a number, 1.0 is no integer.
    """

    def __init__(self, data: Mapping[str, object], source: str, field: str = "") -> None:
        self.source = source
        self.field = field
        self._data = data
        self._known: dict[str, None] = {}
        self._children: list[Table] = []

    @classmethod
    def load(cls, path: str | Path) -> Table:
        """Read a TOML file of at most ``MAX_FILE_BYTES``.

        Raises
        ------
        InputError
            When the file is missing, unreadable, too large, not UTF-8 or not TOML.
        """
        return cls.parse(read_content(path, "a file"), str(path))

    @classmethod
    def parse(cls, content: bytes, source: str) -> Table:
        """Read the bytes of a TOML file that complaints shall name ``source``."""
        try:
            return cls(tomllib.loads(content.decode("utf-8-sig")), source)
        except UnicodeDecodeError as error:
            raise InputError(f"{source}: expected UTF-8 text, found byte {error.start} that is not") from None
        except (ValueError, RecursionError) as error:
            raise InputError(f"{source}: expected TOML, found: {error}") from None

    # -- places and complaints

    @property
    def folder(self) -> Path:
        """The folder of the file, to which relative paths in it refer."""
        return Path(self.source).parent

    def __contains__(self, key: str) -> bool:
        return key in self._data

    def __iter__(self) -> Iterator[str]:
        return iter(self._data)

    def name(self, key: str) -> str:
        """Return the full name of a field, such as ``plant.B``."""
        shown = key if _BARE_KEY.fullmatch(key) else json.dumps(key, ensure_ascii=False)
        return f"{self.field}.{shown}" if self.field else shown

    def error(self, key: str, expected: str, found: str, *, at: str = "") -> InputError:
        """Return the complaint ``FILE: FIELD: expected …, found …`` for raising.

        ``at`` is the place inside an array, such as ``[0][1]``.
        """
        return InputError(f"{self.source}: {self.name(key)}{at}: expected {expected}, found {found}")

    def finish(self) -> None:
        """Refuse keys that were never asked for, here and in every table taken from this one.

        Raises
        ------
        InputError
            Naming the first such key and the nearest one that is known.
        """
        for key in self._data:
            if key not in self._known:
                near = difflib.get_close_matches(key, self._known, 1)
                hint = f"; did you mean {near[0]}?" if near else ""
                raise self.error(key, f"one of {', '.join(self._known)}", f"an unknown key{hint}")
        for child in self._children:
            child.finish()

    # -- scalars

    def string(self, key: str, default: T | _Absent = REQUIRED, *, choices: tuple[str, ...] | None = None) -> str | T:
        """Return a string that is not empty, one of ``choices`` if given."""
        expected = f"one of {', '.join(choices)}" if choices else "a string"

        def read(value: object) -> str:
            if not isinstance(value, str) or not value or (choices and value not in choices):
                raise self.error(key, expected, describe(value))
            return value

        return self._get(key, default, expected, read)

    def boolean(self, key: str, default: T | _Absent = REQUIRED) -> bool | T:
        """Return a boolean."""

        def read(value: object) -> bool:
            if not isinstance(value, bool):
                raise self.error(key, "true or false", describe(value))
            return value

        return self._get(key, default, "true or false", read)

    def integer(
        self, key: str, default: T | _Absent = REQUIRED, *, low: int | None = None, high: int | None = None
    ) -> int | T:
        """Return an integer in [low, high]."""
        expected = _interval("an integer", low, high, None)

        def read(value: object) -> int:
            if not isinstance(value, int) or isinstance(value, bool):
                raise self.error(key, expected, describe(value))
            if (low is not None and value < low) or (high is not None and value > high):
                raise self.error(key, expected, describe(value))
            return value

        return self._get(key, default, expected, read)

    def number(
        self,
        key: str,
        default: T | _Absent = REQUIRED,
        *,
        low: float | None = None,
        high: float | None = None,
        above: float | None = None,
    ) -> float | T:
        """Return a finite number in [low, high], or greater than ``above``."""
        expected = _interval("a number", low, high, above)
        return self._get(key, default, expected, lambda value: self._number(key, value, low, high, above))

    # -- arrays

    def strings(self, key: str, default: T | _Absent = REQUIRED, *, length: int | None = None) -> tuple[str, ...] | T:
        """Return an array of strings, none of them empty."""
        expected = f"an array of {_count(length, 'string')}"

        def read(value: object) -> tuple[str, ...]:
            items = self._items(key, value, expected, length, "string")
            for i, item in enumerate(items):
                if not isinstance(item, str) or not item:
                    raise self.error(key, "a string", describe(item), at=f"[{i}]")
            return tuple(str(item) for item in items)

        return self._get(key, default, expected, read)

    def vector(
        self,
        key: str,
        default: T | _Absent = REQUIRED,
        *,
        length: int | None = None,
        low: float | None = None,
        high: float | None = None,
        above: float | None = None,
    ) -> NDArray[np.float64] | T:
        """Return an array of finite numbers, each bounded as in :meth:`number`; shape (length,)."""
        expected = f"an array of {_count(length, 'number')}"

        def read(value: object) -> NDArray[np.float64]:
            items = self._items(key, value, expected, length, "number")
            numbers = [self._number(key, v, low, high, above, f"[{i}]") for i, v in enumerate(items)]
            return np.array(numbers, dtype=np.float64)

        return self._get(key, default, expected, read)

    def matrix(
        self,
        key: str,
        default: T | _Absent = REQUIRED,
        *,
        shape: tuple[int | None, int | None] = (None, None),
    ) -> NDArray[np.float64] | T:
        """Return a matrix of finite numbers, an array of rows; None in ``shape`` leaves a size open."""
        expected = "a matrix (an array of rows)"

        def read(value: object) -> NDArray[np.float64]:
            rows = self._items(key, value, expected, shape[0], "row")
            if not rows:
                raise self.error(key, expected, "an empty array")
            columns = shape[1]
            for i, row in enumerate(rows):
                if not isinstance(row, list) or not row:
                    raise self.error(key, "a row of numbers", describe(row), at=f"[{i}]")
                if columns is not None and len(row) != columns:
                    at = f"[{i}]" if i else ""
                    raise self.error(key, _count(columns, "column"), str(len(row)), at=at)
                columns = len(row)
            numbers = [
                [self._number(key, v, at=f"[{i}][{j}]") for j, v in enumerate(row)] for i, row in enumerate(rows)
            ]
            return np.array(numbers, dtype=np.float64)

        return self._get(key, default, expected, read)

    # -- tables

    def table(self, key: str, default: T | _Absent = REQUIRED) -> Table | T:
        """Return a table inside this one."""

        def read(value: object) -> Table:
            if not isinstance(value, dict):
                raise self.error(key, "a table", describe(value))
            return self._child(value, self.name(key))

        return self._get(key, default, "a table", read)

    def tables(self, key: str, default: T | _Absent = REQUIRED) -> tuple[Table, ...] | T:
        """Return the tables of an array of tables, ``[[key]]``."""
        expected = "an array of tables"

        def read(value: object) -> tuple[Table, ...]:
            items = self._items(key, value, expected, None, "table")
            for i, item in enumerate(items):
                if not isinstance(item, dict):
                    raise self.error(key, "a table", describe(item), at=f"[{i}]")
            return tuple(self._child(item, f"{self.name(key)}[{i}]") for i, item in enumerate(items))

        return self._get(key, default, expected, read)

    def mapping(self, key: str, default: T | _Absent = REQUIRED) -> Mapping[str, object] | T:
        """Return a table as it is, whatever keys it has."""

        def read(value: object) -> Mapping[str, object]:
            if not isinstance(value, dict):
                raise self.error(key, "a table", describe(value))
            return value

        return self._get(key, default, "a table", read)

    # -- inside

    def _get(self, key: str, default: T | _Absent, expected: str, read: Callable[[object], V]) -> V | T:
        self._known[key] = None
        if key in self._data:
            return read(self._data[key])
        if not isinstance(default, _Absent):
            return default
        near = difflib.get_close_matches(key, [k for k in self._data if k not in self._known], 1, 0.75)
        hint = f"; is {near[0]} a misspelling of it?" if near else ""
        raise self.error(key, expected, f"nothing{hint}")

    def _child(self, data: Mapping[str, object], field: str) -> Table:
        child = Table(data, self.source, field)
        self._children.append(child)
        return child

    def _items(
        self, key: str, value: object, expected: str, length: int | None, item: str
    ) -> list[Any]:  # what is inside is checked by the callers
        if not isinstance(value, list):
            raise self.error(key, expected, describe(value))
        if length is not None and len(value) != length:
            raise self.error(key, _count(length, item), str(len(value)))
        return value

    def _number(
        self,
        key: str,
        value: object,
        low: float | None = None,
        high: float | None = None,
        above: float | None = None,
        at: str = "",
    ) -> float:
        expected = _interval("a number", low, high, above)
        if not isinstance(value, (int, float)) or isinstance(value, bool):
            raise self.error(key, expected, describe(value), at=at)
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if not math.isfinite(number):
            finite = _interval("a finite number", low, high, above)
            raise self.error(key, finite, describe(value), at=at)
        outside = (low is not None and number < low) or (high is not None and number > high)
        if outside or (above is not None and number <= above):
            raise self.error(key, expected, describe(value), at=at)
        return number


def describe(value: object) -> str:
    """Return a TOML value as a complaint shows it: short, on one line, with its type."""
    if isinstance(value, bool):
        return f"the boolean {str(value).lower()}"
    if isinstance(value, int) and value.bit_length() > 64:  # repr refuses integers of many digits
        return f"an integer of {value.bit_length()} bits"
    if isinstance(value, (int, float)):
        return repr(value)
    if isinstance(value, str):
        shown = value if len(value) <= _MAX_SHOWN else value[:_MAX_SHOWN] + "…"
        return f"the string {json.dumps(shown, ensure_ascii=False)}"
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, list):
        return "an array" if value else "an empty array"
    return "a date or time"


def _interval(noun: str, low: float | None, high: float | None, above: float | None) -> str:
    if above is not None:
        return f"{noun} above {_bound(above)}" + (f" and at most {_bound(high)}" if high is not None else "")
    if low is not None and high is not None:
        return f"{noun} from {_bound(low)} to {_bound(high)}"
    if low is not None:
        return f"{noun} of at least {_bound(low)}"
    if high is not None:
        return f"{noun} of at most {_bound(high)}"
    return noun


def _bound(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:g}"


def _count(length: int | None, noun: str) -> str:
    if length is None:
        return f"{noun}s"
    return f"{length} {noun}" if length == 1 else f"{length} {noun}s"
