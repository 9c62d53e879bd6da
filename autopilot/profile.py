"""The programmed reference: r(k) of the profiles that AUTO flies, and the text that describes them.

A :class:`Source` gives r for each sample. :class:`Profile`, :class:`Sine` and :class:`Sampled` are values that know
all of r from the start; :func:`parse_profile` reads them from text. What a ground station streams is in
:mod:`autopilot.streamed`.
"""

from __future__ import annotations

import math
import re
from bisect import bisect_right
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import NoReturn, Protocol

from gains.table import InputError, read_content

__all__ = [
    "MAX_GAP",
    "MAX_ROWS",
    "Profile",
    "Sampled",
    "Shifted",
    "Sine",
    "Source",
    "parse_profile",
]

MAX_ROWS = 100_000
"""The longest file of a reference, rows: more than 40 minutes at 40 Hz."""


MAX_GAP = 8192
"""Up to so many changes of r are made one by one when samples were skipped: more than three minutes at 40 Hz."""

Switches = tuple[tuple[int, float], ...]


class Source(Protocol):
    """r(k), in the model's units (an angle in rad); k counts samples from 0."""

    def r(self, k: int) -> float:
        """Return r(k)."""
        ...

    def constant_until(self, k: int, end: int) -> int:
        """Return a sample after k, at most ``end``, before which r stays what r(k) is; ``end`` is after k."""
        ...


@dataclass(frozen=True, slots=True)
class Profile:
    """A programmed reference: piecewise constant, zero before the first switch.

    Attributes
    ----------
    switches : tuple of (int, float)
        Sample number and the value of r from that sample on, in rising order.
    """

    switches: tuple[tuple[int, float], ...] = ()

    def r(self, k: int) -> float:
        """Return r(k)."""
        value = 0.0
        for start, r in self.switches:
            if k < start:
                break
            value = r
        return value

    def constant_until(self, k: int, end: int) -> int:
        """Return the first sample after k, at most ``end``, at which r may differ from r(k)."""
        return min((start for start, _ in self.switches if k < start < end), default=end)


@dataclass(frozen=True, slots=True)
class Sine:
    """A sine from ``start_s`` on: r(k) = amplitude sin(2 pi frequency_hz (k Ts - start_s)), zero before and after.

    Attributes
    ----------
    amplitude : float
        In the model's units.
    frequency_hz, start_s, Ts : float
    duration_s : float, optional
        How long it lasts; without end by default.
    """

    amplitude: float
    frequency_hz: float
    start_s: float
    Ts: float
    duration_s: float | None = None

    @property
    def start(self) -> int:
        """The first sample of the sine."""
        return _sample_at(self.start_s, self.Ts)

    @property
    def end(self) -> int | None:
        """The first sample after the sine."""
        return None if self.duration_s is None else _sample_at(self.start_s + self.duration_s, self.Ts)

    def r(self, k: int) -> float:
        """Return r(k)."""
        if k < self.start or (self.end is not None and k >= self.end):
            return 0.0
        return self.amplitude * math.sin(2.0 * math.pi * self.frequency_hz * (k * self.Ts - self.start_s))

    def constant_until(self, k: int, end: int) -> int:
        """Return the next sample within the sine; its start before it, and ``end`` after it."""
        if k < self.start:
            return min(self.start, end)
        return end if self.end is not None and k >= self.end else k + 1


@dataclass(frozen=True, slots=True)
class Sampled:
    """A reference of many values, each held until the next; zero before the first.

    Attributes
    ----------
    starts : tuple of int
        The samples at which r changes, in rising order.
    values : tuple of float
        What r is from each of them on.
    """

    starts: tuple[int, ...]
    values: tuple[float, ...]

    def r(self, k: int) -> float:
        """Return r(k)."""
        i = bisect_right(self.starts, k)
        return self.values[i - 1] if i else 0.0

    def constant_until(self, k: int, end: int) -> int:
        """Return the first sample after k, at most ``end``, at which r may differ from r(k)."""
        i = bisect_right(self.starts, k)
        return min(self.starts[i], end) if i < len(self.starts) else end


@dataclass(frozen=True, slots=True)
class Shifted:
    """A source whose sample 0 is sample ``start``; zero before."""

    source: Source
    start: int

    def r(self, k: int) -> float:
        """Return r(k)."""
        return self.source.r(k - self.start) if k >= self.start else 0.0

    def constant_until(self, k: int, end: int) -> int:
        """Return a sample after k, at most ``end``, before which r stays what r(k) is."""
        if k < self.start:
            return min(self.start, end)
        return self.start + self.source.constant_until(k - self.start, end - self.start)


_NUMBER = r"[-+0-9.eE]+"
_VALUE_AT = rf"(?P<value>{_NUMBER})(?P<unit>deg|rad|)@(?P<start>{_NUMBER})s"
_WIDTH = rf":(?P<width>{_NUMBER})s"
_SINE = rf":(?P<frequency>{_NUMBER})Hz(?::(?P<duration>{_NUMBER})s)?"
_FORMS = {
    "": ("VALUE@TIMEs such as 5deg@1s", re.compile(_VALUE_AT)),
    "step": ("step:VALUE@TIMEs such as step:5deg@1s", re.compile(_VALUE_AT)),
    "doublet": ("doublet:VALUE@TIMEs:WIDTHs such as doublet:5deg@1s:2s", re.compile(_VALUE_AT + _WIDTH)),
    "3211": ("3211:VALUE@TIMEs:UNITs such as 3211:5deg@1s:0.5s", re.compile(_VALUE_AT + _WIDTH)),
    "sine": ("sine:VALUE@TIMEs:FREQUENCYHz[:DURATIONs] such as sine:5deg@1s:0.5Hz", re.compile(_VALUE_AT + _SINE)),
}
"""How an item is written, by the name before its colon: for complaints, and to read it."""

_DOUBLET = ((1.0, 1), (-1.0, 1))
_MULTISTEP_3211 = ((1.0, 3), (-1.0, 2), (1.0, 1), (-1.0, 1))
_MULTISTEPS = {"doublet": _DOUBLET, "3211": _MULTISTEP_3211}
"""Sign and width in units of each part; zero follows the last."""

_FILE = "file:"
_COLUMNS = {"time_s,value_rad": 1.0, "time_s,value_deg": math.pi / 180.0}
_ROW = re.compile(rf"({_NUMBER})\s*,\s*({_NUMBER})")


def parse_profile(text: str, Ts: float) -> Profile | Sine | Sampled:
    """Return the programmed reference written as ``5deg@1s,0deg@6s``: r becomes 5 degrees at 1 s and 0 at 6 s.

    A text is switches (the first four forms, separated by commas, each beginning after the one before has ended),
    or one sine, or one file::

        5deg@1s                    a step: 5 degrees from 1 s on
        step:5deg@1s               the same
        doublet:5deg@1s:2s         5 degrees for 2 s, -5 degrees for 2 s, then 0
        3211:5deg@1s:0.5s          the multistep 3-2-1-1: +, -, +, - for 3, 2, 1, 1 units of 0.5 s, then 0
        sine:5deg@1s:0.5Hz:20s     a sine of 0.5 Hz for 20 s, then 0; without the last number, for ever
        file:PATH                  CSV with the columns time_s,value_rad or time_s,value_deg; each value is held from
                                   its time on; a path without commas

    Parameters
    ----------
    text : str
        A value may carry ``deg`` or ``rad``, else it is in the model's units. Empty for no reference.
    Ts : float
        Sampling period in s; a change takes effect at the first sample not before its time.

    Raises
    ------
    InputError
        For anything else.
    """
    items = [item for part in text.split(",") if (item := part.strip())]
    if len(items) == 1 and items[0].startswith(_FILE):
        return _read_file(items[0].removeprefix(_FILE), Ts)
    read = [_read_item(text, item, Ts) for item in items]
    for made in read:
        if isinstance(made, Sine):
            if len(read) > 1:
                raise InputError(f'reference "{text}": expected a sine alone, found {len(read)} items')
            return made
    return Profile(_join(text, [made for made in read if not isinstance(made, Sine)]))


def _sample_at(time_s: float, Ts: float) -> int:
    """Return the first sample that is not before a time; a sample's own time, rounded, is that sample."""
    return math.ceil(time_s / Ts - 1e-9)


def _read_item(text: str, item: str, Ts: float) -> Switches | Sine:
    """Return what an item means that is no file."""
    if item.startswith(_FILE):
        raise InputError(f'reference "{text}": expected a file alone, found "{item}" and more')
    kind, colon, rest = item.partition(":")
    if not colon or kind not in _FORMS:
        kind, rest = "", item
    usage, pattern = _FORMS[kind]
    try:
        match = pattern.fullmatch(rest)
        if match is None:
            raise ValueError
        numbers = {name: float(found) for name, found in match.groupdict().items() if found and name != "unit"}
        if match["unit"] == "deg":
            numbers["value"] = math.radians(numbers["value"])
        if not all(map(math.isfinite, numbers.values())) or _sample_at(numbers["start"], Ts) < 0:
            raise ValueError
        made = _sine(text, item, numbers, Ts) if kind == "sine" else _switches(kind, numbers, Ts)
        edges = (made.start, made.end) if isinstance(made, Sine) else (start for start, _ in made)
        starts = [edge for edge in edges if edge is not None]
    except (ValueError, OverflowError):
        raise InputError(f'reference "{text}": expected {usage}, found "{item}"') from None
    if any(later <= earlier for earlier, later in pairwise(starts)):
        raise InputError(f'reference "{text}": expected parts of at least one sample, {Ts:g} s, found "{item}"')
    return made


def _sine(text: str, item: str, numbers: dict[str, float], Ts: float) -> Sine:
    """Return a sine; from half the sampling rate on, the samples would show another one."""
    if not 0.0 < numbers["frequency"] * Ts < 0.5:
        expected = f"a frequency above 0 and below {0.5 / Ts:g} Hz, half the sampling rate"
        raise InputError(f'reference "{text}": expected {expected}, found "{item}"')
    return Sine(numbers["value"], numbers["frequency"], numbers["start"], Ts, numbers.get("duration"))


def _switches(kind: str, numbers: dict[str, float], Ts: float) -> Switches:
    """Return the switches of a step or of a multistep."""
    value, start_s = numbers["value"], numbers["start"]
    if kind not in _MULTISTEPS:
        return ((_sample_at(start_s, Ts), value),)
    parts, unit_s = _MULTISTEPS[kind], numbers["width"]
    edges = accumulate((width for _, width in parts), initial=0)
    values = (*(sign * value for sign, _ in parts), 0.0)
    return tuple((_sample_at(start_s + edge * unit_s, Ts), r) for edge, r in zip(edges, values, strict=True))


def _join(text: str, read: list[Switches]) -> Switches:
    """Return the switches of all items; one may begin with the sample at which the one before returns to zero."""
    joined: list[tuple[int, float]] = []
    free = 0
    for switches in read:
        if switches[0][0] < free:
            raise InputError(f'reference "{text}": expected rising times')
        if joined and joined[-1][0] == switches[0][0]:
            joined.pop()
        joined += switches
        free = switches[-1][0] + (len(switches) == 1)
    return tuple(joined)


def _read_file(name: str, Ts: float) -> Sampled:
    """Return the reference of a CSV file; of several rows within one sample the last one counts."""
    try:
        content = read_content(name, "a CSV file").decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{name}: expected UTF-8 text, found byte {error.start} that is not") from None
    lines = [(number, line) for number, row in enumerate(content.split("\n"), 1) if (line := row.strip())]
    number, columns = lines[0] if lines else (1, "")
    if columns not in _COLUMNS:
        _refuse(name, number, " or ".join(_COLUMNS), columns)
    if not 1 < len(lines) <= 1 + MAX_ROWS:
        raise InputError(f"{name}: line {number}: expected 1 to {MAX_ROWS} rows below, found {len(lines) - 1}")
    changes: dict[int, float] = {}
    last_s = -math.inf
    for number, line in lines[1:]:
        try:
            time_s, value = _row(line)
            start = _sample_at(time_s, Ts)
        except (ValueError, OverflowError):
            _refuse(name, number, "a time of at least 0 and a value, such as 0.5,0.1", line)
        if time_s <= last_s:
            _refuse(name, number, f"a time after {last_s!r} s", line)
        last_s, changes[start] = time_s, value * _COLUMNS[columns]
    return Sampled(tuple(changes), tuple(changes.values()))


def _row(line: str) -> tuple[float, float]:
    """Return time and value of a row; raises ValueError where they are none."""
    match = _ROW.fullmatch(line)
    if match is None:
        raise ValueError
    time_s, value = float(match[1]), float(match[2])
    if not (math.isfinite(value) and time_s >= 0.0):
        raise ValueError
    return time_s, value


def _refuse(name: str, number: int, expected: str, found: str) -> NoReturn:
    shown = found if len(found) <= 40 else found[:40] + "…"
    raise InputError(f'{name}: line {number}: expected {expected}, found "{shown}"')
