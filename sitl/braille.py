"""Curves, bars, numbers and lines of text in the character cells of a terminal, with Unicode or ASCII alone.

A cell of Braille holds 2 x 4 dots, so a plot of 60 x 8 cells has 120 x 32 of them; in ASCII a cell is one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

from rich.text import Text

from autopilot.link.servo import travel_of
from gains.model import Model

__all__ = [
    "EMPTY",
    "Part",
    "Point",
    "Quantity",
    "bar",
    "count",
    "fit",
    "histogram",
    "input_quantity",
    "nice_range",
    "output_quantity",
    "percent",
    "plain",
    "plot",
    "raster",
]

Point = tuple[float, float]
Range = tuple[float, float]

Part = tuple[str, str]
"""(text, rich style) of a piece of a line."""

EMPTY = -1
"""The curve of a cell that no curve crosses."""
PLOT_LIMIT = 1e9
"""A value beyond this is a number, not a point of a plot."""
LEAST_SPAN = 1.0
AXIS_STYLE = "bright_black"
SHOWN_BINS = 7

_DOTS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))
"""Bit of the dot in each row and column of a Braille cell, above U+2800."""
_ASCII_MARKS = ".*o+x"
_LEVELS = "▁▂▃▄▅▆▇█"
_ASCII_LEVELS = ".:-=+*#@"
_ASCII = str.maketrans(
    {"°": " deg", "±": "+-", "–": "-", "—": "-", "−": "-", "…": "...", "≥": ">=", "²": "^2", "∞": "inf"}
    | {"θ": "theta", "α": "alpha", "β": "beta", "γ": "gamma", "φ": "phi", "Δ": "Delta", "│": "|", "┃": "|"}
)

_SYMBOLS = {"theta": "θ", "alpha": "α", "beta": "β", "gamma": "γ", "phi": "φ"}
_UNITS = {"_rad_s": (math.degrees(1.0), "°/s"), "_rad": (math.degrees(1.0), "°"), "_m_s": (1.0, " m/s")}


class Quantity(NamedTuple):
    """How a number is shown: its name, the factor to the shown unit, that unit."""

    name: str
    factor: float
    unit: str

    @property
    def reference(self) -> str:
        """Return the name of its reference: θr for θ."""
        return self.name + ("r" if len(self.name) == 1 else "_r")

    def show(self, value: float) -> str:
        """Return the number in the shown unit; a dash when there is none."""
        shown = value * self.factor
        if math.isnan(shown):
            return "—"
        text = f"{round(shown, 2) + 0.0:.2f}" if abs(shown) < 1e5 else f"{shown:.1e}"
        return text + self.unit


def output_quantity(model: Model, *, ascii_only: bool = False) -> Quantity:
    """Return how the first output is shown: an angle in degrees where it is a state in rad, a plain y if no state."""
    (places,) = model.C[0].nonzero()
    if len(places) != 1 or model.C[0, places[0]] != 1.0 or model.D[0].any():
        return Quantity("y", 1.0, "")
    state = model.states[places[0]]
    for suffix, (factor, unit) in _UNITS.items():
        if state.endswith(suffix):
            stem = state.removesuffix(suffix)
            name = stem if ascii_only else _SYMBOLS.get(stem, stem)
            return Quantity(name, factor, plain(unit, ascii_only=ascii_only))
    return Quantity(state, 1.0, "")


def input_quantity(model: Model, *, ascii_only: bool = False) -> Quantity:
    """Return how the input is shown: an aircraft's elevator in degrees, else a plain u, as no file says its unit."""
    travel = travel_of(model)
    aircraft = any(sensor.startswith("AOA_SSA.") for sensor in model.sensors.values())
    if aircraft and max(abs(travel.low), abs(travel.high)) <= math.pi:
        return Quantity("elevator", math.degrees(1.0), plain("°", ascii_only=ascii_only))
    return Quantity("u", 1.0, "")


def count(n: int | None) -> str:
    """Return a whole number; a dash when there is none."""
    return "—" if n is None else str(n)


def percent(part: int, whole: int, digits: int = 1) -> str:
    """Return a share as a percentage; a dash where there is no whole."""
    return f"{100.0 * part / whole:.{digits}f} %" if whole else "—"


def plain(text: str, *, ascii_only: bool = False) -> str:
    """Return the text without control characters, and in ASCII if asked."""
    if ascii_only:
        text = text.translate(_ASCII).encode("ascii", "replace").decode("ascii")
    return "".join(c if c.isprintable() else " " for c in text)


def fit(left: Sequence[Part], width: int, right: Sequence[Part] = (), *, ascii_only: bool = False) -> Text:
    """Return a line no longer than the width, made of parts at its left and right ends; the left gives way."""
    ends = [
        Text.assemble(*((plain(text, ascii_only=ascii_only), style) for text, style in parts), no_wrap=True)
        for parts in (left, right)
    ]
    line, last = ends
    if right:
        room = max(1, width - last.cell_len - 2)
        line.truncate(room, overflow="crop" if ascii_only else "ellipsis")
        line.pad_right(max(0, width - line.cell_len - last.cell_len))
        line.append_text(last)
    line.truncate(width, overflow="crop" if ascii_only else "ellipsis")
    return line


def raster(
    curves: Sequence[Iterable[Point]],
    size: tuple[int, int],
    x_range: Range,
    y_range: Range,
    *,
    ascii_only: bool = False,
) -> list[list[tuple[str, int]]]:
    """Return rows of (character, index of the curve on top), the first row uppermost.

    Of several curves the first is dotted, so that they can be told apart without colour; later ones lie on
    top. A point that is not finite, or outside the ranges, interrupts its curve.

    Parameters
    ----------
    curves : sequence of iterables of (x, y)
    size : (int, int)
        Columns and rows, in cells.
    x_range, y_range : (float, float)
        What the left and right, the lower and upper edges stand for; each rising.
    ascii_only : bool
        Draw with ASCII instead of Braille.
    """
    columns, rows = size
    across, down = (1, 1) if ascii_only else (2, 4)
    bits = [[0] * columns for _ in range(rows)]
    owner = [[EMPTY] * columns for _ in range(rows)]
    for index, curve in enumerate(curves):
        dotted = index == 0 and len(curves) > 1 and not ascii_only
        last: tuple[int, int] | None = None
        for point in curve:
            here = _dot(point, (columns * across, rows * down), x_range, y_range)
            if here is not None:
                for x, y in _line(last or here, here):
                    if not (dotted and (x + y) % 2):
                        bits[y // down][x // across] |= _DOTS[y % down][x % across]
                        owner[y // down][x // across] = index
            last = here

    def character(dot_bits: int, index: int) -> str:
        if index == EMPTY:
            return " "
        return _ASCII_MARKS[index] if ascii_only else chr(0x2800 + dot_bits)

    return [
        [(character(cell, index), index) for cell, index in zip(*row, strict=True)]
        for row in zip(bits, owner, strict=True)
    ]


def _dot(point: Point, dots: tuple[int, int], x_range: Range, y_range: Range) -> tuple[int, int] | None:
    """Return the dot nearest to a point, counted from the upper left, or None outside the ranges."""
    (x, y), (left, right), (low, high) = point, x_range, y_range
    if not (left <= x <= right and low <= y <= high):  # true for nan, too
        return None
    return (
        round((x - left) / (right - left) * (dots[0] - 1)),
        round((high - y) / (high - low) * (dots[1] - 1)),
    )


def _line(start: tuple[int, int], end: tuple[int, int]) -> list[tuple[int, int]]:
    """Return the dots of the straight line between two dots, both included."""
    (x0, y0), (x1, y1) = start, end
    steps = max(abs(x1 - x0), abs(y1 - y0))
    if steps == 0:
        return [end]
    return [(round(x0 + (x1 - x0) * i / steps), round(y0 + (y1 - y0) * i / steps)) for i in range(steps + 1)]


def nice_range(values: Iterable[float]) -> Range:
    """Return round limits that hold the values, those beyond ``PLOT_LIMIT`` left out."""
    shown = [value for value in values if abs(value) < PLOT_LIMIT]
    low, high = (min(shown), max(shown)) if shown else (0.0, 0.0)
    span = max(high - low, LEAST_SPAN)
    decade = 10.0 ** math.floor(math.log10(span))
    step = next(decade * m for m in (0.2, 0.5, 1.0, 2.0, 5.0) if span <= 5.0 * decade * m)
    low = min(low, math.floor(low / step) * step)  # rounding must not leave a value out
    return low, max(high, math.ceil(high / step) * step, low + LEAST_SPAN)


def plot(
    curves: Sequence[Sequence[Point]],
    styles: Sequence[str],
    size: tuple[int, int],
    x_range: Range,
    unit: str,
    *,
    ascii_only: bool = False,
) -> list[list[Part]]:
    """Return the lines of a plot with its axes: rows of curves, then one with the ends of x in seconds.

    Parameters
    ----------
    curves, x_range, ascii_only
        As for :func:`raster`; the range of y is that of the values shown.
    styles : sequence of str
        One for each curve.
    size : (int, int)
        Columns of the labels on the left, and of all; rows of the curves.
    """
    columns, rows = size
    margin = 10
    low, high = nice_range(y for curve in curves for x, y in curve if x_range[0] <= x <= x_range[1])
    labels = {0: f"{high:.6g}", (rows - 1) // 2: unit, rows - 1: f"{low:.6g}"}
    lines: list[list[Part]] = []
    cells = raster(curves, (columns - margin, rows), x_range, (low, high), ascii_only=ascii_only)
    for row, line in enumerate(cells):
        label = plain(labels.get(row, ""), ascii_only=ascii_only)
        parts = [(label.rjust(margin - 2) + " │", AXIS_STYLE)]
        lines.append(parts + [(c, styles[curve] if curve != EMPTY else "") for c, curve in line])
    left, right = (f"{x:.1f} s" for x in x_range)
    axis = " " * margin + left + right.rjust(columns - margin - len(left))
    return [*lines, [(axis, AXIS_STYLE)]]


def bar(start: float, end: float, cells: int, style: str, *, ascii_only: bool = False) -> list[Part]:
    """Return a horizontal bar filled between two fractions of its width, to half a cell.

    The ends may come in either order; beyond the bar they are cut off, and nan fills nothing. In ASCII the
    bar is exact to one cell.
    """
    if math.isnan(start) or math.isnan(end):
        start = end = 0.0
    low, high = sorted(round(min(max(value, 0.0), 1.0) * 2 * cells) for value in (start, end))
    marks = "-===" if ascii_only else "─╸╺━"
    halves = [(low <= 2 * i < high) + 2 * (low <= 2 * i + 1 < high) for i in range(cells)]
    return [(marks[filled], style if filled else AXIS_STYLE) for filled in halves]


def histogram(counts: Sequence[int], style_of: Callable[[int], str], *, ascii_only: bool = False) -> list[Part]:
    """Return a column and a share for each value 0, 1, ... from the least seen on; a dash before the first.

    The last of ``SHOWN_BINS`` holds all the larger values, as does the last of the counts.
    """
    seen = [value for value, n in enumerate(counts) if n]
    if not seen:
        return [("—", AXIS_STYLE)]
    shown = range(seen[0], min(seen[-1], seen[0] + SHOWN_BINS - 1) + 1)
    bins = [*counts[shown[0] : shown[-1]], sum(counts[shown[-1] :])]
    levels = _ASCII_LEVELS if ascii_only else _LEVELS
    parts: list[Part] = []
    for value, n in zip(shown, bins, strict=True):
        more = "≥" if value == shown[-1] and (seen[-1] > value or value == len(counts) - 1) else ""
        mark = levels[math.ceil(n / max(bins) * len(levels)) - 1] if n else " "
        parts += [(f"{more}{value} ", ""), (mark, style_of(value))]
        parts.append((f" {percent(n, sum(bins), 0)}  ", AXIS_STYLE))
    return parts
