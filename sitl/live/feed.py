"""The records of a running flight as rows to draw, and the numbers beside them.

A feed keeps the last ``WINDOW_S`` of everything that is drawn, and counts over the whole flight what the summary
counts. Who looks gets a snapshot first, then what is new since. What a record says that makes no sense is counted and
dropped: a recording may be anybody's.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import orjson

from autopilot.failsafe import Mode
from gains.model import Model
from sitl.faults import CorruptGains, Kill, Phase, fault_of, program_of
from sitl.flightdata import LINKS
from sitl.link.impairment import Fate
from sitl.live.tracking import Sample, Tracking
from sitl.summary import LATE_NS

__all__ = ["COLUMNS", "MAX_ROWS", "WINDOW_S", "Feed", "News", "Rows", "Told"]

WINDOW_S = 60.0
"""What is kept to be drawn, s; less where MAX_ROWS are fewer."""
MAX_ROWS = 16_384
"""Rows of one source; the oldest go first."""
MAX_EVENTS = 256
MAX_DELAY = 64
"""Delays from here on are counted as one."""
MAX_TEXT = 200
MAX_COMPARED = 1 << 12
"""Commands whose forecast waits for the true delay."""

COLUMNS: Mapping[str, tuple[str, ...]] = {
    "samples": ("t", "k", "y", "yr", "e", "u", "d"),
    "commands": ("t", "j", "d", "low", "high", "at"),
    "up": ("t", "ms"),
    "down": ("t", "ms"),
    "modes": ("t", "mode"),
    "events": ("t", "kind", "node", "text"),
}
"""Sources and their columns. Times in s from sample 0; ``ms`` is null for a packet that was lost.

A command's ``t`` is the time of the sample that it was computed from, ``at`` the one that it was forecast for.
"""

_SILENT = frozenset({"counters", "gains", "ports"})
_BAD_BODY = (KeyError, TypeError, ValueError, AttributeError, OverflowError, IndexError)


class Rows:
    """The latest rows of one source.

    Attributes
    ----------
    total : int
        How many there have been.
    """

    def __init__(self, columns: Sequence[str], limit: int = MAX_ROWS) -> None:
        self.columns = tuple(columns)
        self.total = 0
        self._rows: deque[tuple[Any, ...]] = deque(maxlen=limit)

    def add(self, *row: Any) -> None:
        """Add a row; its first column is its time in s."""
        assert len(row) == len(self.columns)
        self._rows.append(row)
        self.total += 1

    def forget(self, before_s: float) -> None:
        """Let go of the rows before a time; the newest one stays."""
        while len(self._rows) > 1 and self._rows[0][0] < before_s:
            self._rows.popleft()

    def shift(self, by_s: float) -> None:
        """Move all rows in time."""
        moved = [(round(row[0] + by_s, 6), *row[1:]) for row in self._rows]
        self._rows.clear()
        self._rows.extend(moved)

    def since(self, total: int) -> dict[str, list[Any]] | None:
        """Return the rows that have come since there were ``total``, by column; None without any."""
        number = min(self.total - total, len(self._rows))
        if number <= 0:
            return None
        rows = [self._rows[at] for at in range(-number, 0)] if number < len(self._rows) else self._rows
        return {name: list(column) for name, column in zip(self.columns, zip(*rows, strict=True), strict=True)}


class _Link:
    """Counts of one direction."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.latest_ms: deque[float] = deque(maxlen=1024)

    def numbers(self) -> dict[str, Any]:
        ms = np.array(self.latest_ms) if self.latest_ms else None
        quantiles = [None] * 3 if ms is None else [round(float(q), 3) for q in np.quantile(ms, (0.5, 0.95, 1.0))]
        counts = {name: self.counts[name] for name in ("sent", "delivered", "lost", "duplicated")}
        return {**counts, "median_ms": quantiles[0], "p95_ms": quantiles[1], "max_ms": quantiles[2]}


class _Forecasts:
    """How many commands had their delay forecast exactly, at the first sample that each was applied."""

    def __init__(self) -> None:
        self.compared = self.exact = 0
        self._forecast: dict[int, int | None] = {}
        self._true: dict[int, int] = {}

    def forecast(self, j: int, d: int | None) -> None:
        self._forecast[j] = d
        _bound(self._forecast)
        if j in self._true:
            self._compare(j)

    def applied(self, j: int, d: int) -> None:
        if j not in self._true:
            self._true[j] = d
            _bound(self._true)
            if j in self._forecast:
                self._compare(j)

    def restart(self) -> None:
        self._forecast.clear()
        self._true.clear()

    def _compare(self, j: int) -> None:
        forecast = self._forecast[j]
        if forecast is not None:
            self.compared += 1
            self.exact += forecast == self._true[j]


class Told(NamedTuple):
    """What somebody has been told: how many rows of each source, and on which axis of time."""

    rows: Mapping[str, int]
    axis: int


class News(NamedTuple):
    """Rows by source and column; ``anew``: they replace those before."""

    rows: dict[str, dict[str, list[Any]]]
    anew: bool


class Feed:
    """What a flight's page shows, from its records.

    Parameters
    ----------
    model : Model or None
        What is flown. Where that is unknown, so are the period and the output: samples and commands are not shown.
    metadata : mapping of str to str
        Of the recording.

    Attributes
    ----------
    records : int
        Messages of all topics so far.
    malformed : int
        Those of a topic that is shown whose body makes no sense.
    """

    def __init__(self, model: Model | None, metadata: Mapping[str, str]) -> None:
        self.model = model
        self.records = 0
        self.malformed = 0
        self.now_s = 0.0
        self._tracking = None if model is None else Tracking(model, metadata.get("reference", ""))
        self._axis = 0
        self._rows = {
            name: Rows(columns, MAX_EVENTS if name == "events" else MAX_ROWS) for name, columns in COLUMNS.items()
        }
        self._links = {way: _Link() for way in LINKS}
        self._delays: Counter[int] = Counter()
        self._forecasts = _Forecasts()
        self._samples = self._engaged = self._late = 0
        self._square = self._largest = 0.0
        self._saturated = self._commands = self._failsafes = 0
        self._mode: str | None = None
        self._last: Sample | None = None
        self._k = -1
        self._verified: bool | None = None

    def take(self, topic: str, log_time_ns: int, data: bytes) -> None:
        """Take one message; those of other topics are only counted."""
        self.records += 1
        if not topic.startswith(("plant/", "autopilot/", "link/", "events")):
            return
        try:
            body = orjson.loads(data)
            match topic:
                case "plant/truth":
                    self._truth(log_time_ns, body)
                case "autopilot/command":
                    self._command(log_time_ns, body)
                case "link/up" | "link/down":
                    self._packet(topic.removeprefix("link/"), log_time_ns, body)
                case "events":
                    self._event(log_time_ns, body)
                case _:
                    return
        except _BAD_BODY:
            self.malformed += 1
            return
        self.now_s = max(self.now_s, self._time_s(log_time_ns))

    def settle(self, *, end: bool = False) -> None:
        """Add the samples that are complete, and let go of what has left the window; ``end``: nothing more comes."""
        if self._tracking is not None and self.model is not None:
            for sample in self._tracking.complete(end=end):
                self._add(sample, self.model.Ts)
        for rows in self._rows.values():
            rows.forget(self.now_s - WINDOW_S)

    def told(self) -> Told:
        """Return what somebody knows who has been told everything, for :meth:`since`."""
        return Told({name: rows.total for name, rows in self._rows.items()}, self._axis)

    def since(self, told: Told | None = None) -> News:
        """Return what is new since then; everything that is kept without ``told``."""
        anew = told is None or told.axis != self._axis
        before = {} if told is None or anew else told.rows
        new = {name: rows.since(before.get(name, 0)) for name, rows in self._rows.items()}
        return News({name: columns for name, columns in new.items() if columns is not None}, anew)

    def numbers(self) -> dict[str, Any]:
        """Return the numbers beside the figures, over the whole flight so far; None stands for unknown."""
        last, forecasts, engaged = self._last, self._forecasts, self._engaged
        return {
            "time_s": round(self.now_s, 3),
            "samples": self._samples,
            "k": None if last is None else last.k,
            "y": None if last is None else _short(last.y[0]),
            "yr": None if last is None else _short(last.yr[0]),
            "u": None if last is None else _short(last.u[0]),
            "d": None if last is None else last.d,
            "mode": self._mode,
            "rms_error": math.sqrt(self._square / engaged) if engaged else None,
            "max_error": self._largest if engaged else None,
            "delays": [[d, n] for d, n in sorted(self._delays.items())],
            "exact_fraction": forecasts.exact / forecasts.compared if forecasts.compared else None,
            "saturated_fraction": self._saturated / self._commands if self._commands else None,
            "failsafe_events": self._failsafes,
            "late_ticks": self._late,
            "verified": self._verified,
            "link": {way: link.numbers() for way, link in self._links.items()},
            "records": self.records,
            "malformed": self.malformed,
        }

    def _time_s(self, log_time_ns: int) -> float:
        """Return a log time as seconds from sample 0; from the log's own zero where there is no sample."""
        return log_time_ns / 1e9 if self._tracking is None else self._tracking.time_s(log_time_ns)

    def _truth(self, log_time_ns: int, body: Mapping[str, Any]) -> None:
        if self._tracking is None or self.model is None:
            return
        late = int(body["late_ns"]) > LATE_NS
        j, d = body["j"], body["d"]
        unknown = self._tracking.zero_ns is None
        place = self._tracking.truth(log_time_ns, body)
        if unknown and self._tracking.zero_ns is not None:
            self._begin(self._tracking.zero_ns / 1e9)
        self._late += late
        if body["k"] <= self._k:
            self._forecasts.restart()
        self._k = body["k"]
        if type(j) is int and type(d) is int:
            self._delays[min(max(d, 0), MAX_DELAY)] += 1
            self._forecasts.applied(j, d)
        self.now_s = max(self.now_s, place * self.model.Ts)

    def _begin(self, zero_s: float) -> None:
        """Put what came before the first sample where it belongs: before zero."""
        for rows in self._rows.values():
            rows.shift(-zero_s)
        self.now_s -= zero_s
        self._axis += 1

    def _add(self, sample: Sample, Ts: float) -> None:
        self._last = sample
        self._samples += 1
        y, yr, e, u = sample.y[0], sample.yr[0], sample.e[0], sample.u[0]
        if sample.engaged:
            self._engaged += 1
            self._square += e * e if abs(e) < 1e150 else math.inf
            self._largest = max(self._largest, abs(e))
        self._rows["samples"].add(
            round(sample.place * Ts, 6), sample.k, _short(y), _short(yr), _short(e), _short(u), sample.d
        )

    def _command(self, log_time_ns: int, body: Mapping[str, Any]) -> None:
        d, low, high = (_whole_or_none(body[name]) for name in ("d", "d_low", "d_high"))
        mode, saturated = Mode(body["mode"]), bool(body["saturated"])
        place = None if self._tracking is None else self._tracking.command(body)
        self._commands += 1
        self._saturated += saturated
        self._change_mode(log_time_ns, mode)
        if place is not None and self.model is not None:
            self._forecasts.forecast(body["j"], d)
            at = None if d is None else round((place + d) * self.model.Ts, 6)
            self._rows["commands"].add(round(place * self.model.Ts, 6), body["j"], d, low, high, at)

    def _packet(self, way: str, log_time_ns: int, body: Mapping[str, Any]) -> None:
        if body["fate"] == Fate.GATED:
            return
        link, left_s = self._links[way], self._time_s(log_time_ns)
        delivered_ns = _whole_or_none(body["delivered_ns"])
        delay_s = None if delivered_ns is None else (delivered_ns - int(body["sent_ns"])) / 1e9
        link.counts["duplicated" if body["copy"] else "sent"] += 1
        link.counts["lost" if delay_s is None else "delivered"] += 1
        if delay_s is None:
            self._rows[way].add(round(left_s, 6), None)
        else:
            link.latest_ms.append(1e3 * delay_s)
            self._rows[way].add(round(left_s - delay_s, 6), _short(1e3 * delay_s))

    def _event(self, log_time_ns: int, body: Mapping[str, Any]) -> None:
        kind, node, text = (str(body[name])[:MAX_TEXT] for name in ("kind", "node", "text"))
        data = body["data"]
        if kind == "failsafe":
            self._change_mode(log_time_ns, Mode(data["to"]))
            self._failsafes += data["from"] != Mode.STANDBY
        elif kind == "gains":
            self._verified = bool(data.get("verified"))
        elif _kills_autopilot(body):
            self._change_mode(log_time_ns, Mode.STANDBY)
        if kind not in _SILENT:
            self._rows["events"].add(round(self._time_s(log_time_ns), 6), kind, node, text)

    def _change_mode(self, log_time_ns: int, mode: Mode) -> None:
        if mode.value != self._mode:
            self._mode = mode.value
            self._rows["modes"].add(round(self._time_s(log_time_ns), 6), mode.value)


def _bound(table: dict[int, Any]) -> None:
    """Let go of the oldest half of a table that is full."""
    if len(table) > MAX_COMPARED:
        for key in list(table)[: MAX_COMPARED // 2]:
            del table[key]


def _kills_autopilot(event: Mapping[str, Any]) -> bool:
    """Return whether an event tells that a fault has killed the autopilot: then nobody flies."""
    fault, phase = fault_of(event) or (None, None)
    return isinstance(fault, Kill | CorruptGains) and program_of(fault) == "autopilot" and phase is Phase.BEGIN


def _whole_or_none(value: object) -> int | None:
    if value is not None and type(value) is not int:
        raise TypeError("no integer")
    return value


def _short(value: float) -> float | None:
    """Return six digits of a number: what a screen can show; None for one that is none."""
    return float(f"{value:.6g}") if math.isfinite(value) else None
