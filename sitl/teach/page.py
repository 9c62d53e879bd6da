"""The page as one HTML file: bokeh's figures and library inside, the curves as base64, no network.

What is shown of a case is computed here, curves and words alike. The script of the page (``teach.js``) only puts what
belongs to the slider's position in its place, so there is nothing in it that could disagree with Python.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping, Sequence
from html import escape
from importlib import resources
from typing import Any, Final

import numpy as np
from bokeh.embed import components
from bokeh.models import ColumnDataSource, HoverTool, Range1d
from bokeh.models.annotations import Span
from bokeh.plotting import figure
from bokeh.resources import Resources

from gains.command import version
from gains.model import Gains
from sitl.teach.lesson import PATTERNS, SAMPLES, Case, Floats, Lesson, output
from sitl.teach.words import SYMBOLS, standing, takeaway, title, verdict

__all__ = ["FIGURES", "page"]

FIGURES: Final = ("response", "command", "delay", "left")
"""Names of the figures, of their places in the page, and of the models in bokeh's document."""

_NAMES: Final = {"constant": "always d", "random": "at random up to d", "worst": "worst case up to d"}
_HEIGHTS: Final = {"response": 230, "command": 150, "delay": 130, "left": 190}
_INPUTS: Final = {
    "hirm": ("elevator, deg", math.degrees(1.0)),
    "pendulum": ("force u, N", 1.0),
}  # by the model's first word
_BEYOND: Final = 40.0  # heights of a picture: farther off a curve is not drawn
_FIRST: Final = 40  # samples that are framed where every case grows
_LEFT_LOW, _LEFT_HIGH = 1e-3, 1e2
_TIPS: Final = {"response": "y", "command": "u", "delay": "d", "left": "left"}
_COLUMNS: Final = ("t", "y", "yr", "u", "d", "left", "line")


def page(lessons: Sequence[Lesson]) -> str:
    """Return the page.

    Parameters
    ----------
    lessons : sequence of Lesson
        At least one, of gains with different names.
    """
    assert lessons
    script, divs = components(_figures())
    parts = {
        "systems": "".join(f'<option value="{i}">{title(lesson)}</option>' for i, lesson in enumerate(lessons)),
        "patterns": "".join(_choice(pattern, _NAMES[pattern]) for pattern in PATTERNS),
        "bokeh": Resources(mode="inline", components=["bokeh"]).render(),
        "figures": script,
        "data": _json({"systems": [_system(lesson) for lesson in lessons], "samples": SAMPLES}),
        "style": _file("teach.css"),
        "script": _file("teach.js"),
        "legend": "".join(
            f'<span><i class="cell {name}" aria-hidden="true">{symbol}</i> {text}</span>'
            for name, (symbol, text) in SYMBOLS.items()
            if name != "grows"
        ),
        "made": escape(f"lagproof {version()}: " + ", ".join(lesson.gains.name for lesson in lessons)),
        **{name: divs[name] for name in FIGURES},
    }
    text = _file("teach.html")
    for name, part in parts.items():
        text = text.replace(f"<!--{name}-->", part, 1)
    return text


def _choice(pattern: str, name: str) -> str:
    checked = " checked" if pattern == "worst" else ""
    return f'<label><input type="radio" name="pattern" value="{pattern}"{checked}><span>{name}</span></label>'


def _file(name: str) -> str:
    return resources.files("sitl.teach").joinpath(name).read_text(encoding="utf-8")


def _json(data: Mapping[str, Any]) -> str:
    """Return JSON that may stand in a script element."""
    return json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


# -- figures


def _figures() -> dict[str, Any]:
    """Return the figures by name; all show columns of one source over one axis of time."""
    source = ColumnDataSource({name: np.zeros(1) for name in _COLUMNS}, name="curves")
    seconds = Range1d(start=0.0, end=1.0, name="seconds")
    made = {name: _figure(name, seconds) for name in FIGURES}
    made["response"].line("t", "yr", source=source, line_width=2, line_dash="dashed", name="quiet")
    curves = {
        "response": made["response"].line("t", "y", source=source, line_width=2.2, name="curve"),
        "command": made["command"].step("t", "u", source=source, line_width=1.8, mode="after", name="curve"),
        "delay": made["delay"].step("t", "d", source=source, line_width=1.8, mode="after", name="steps"),
        "left": made["left"].line("t", "left", source=source, line_width=2.2, name="curve"),
    }
    made["left"].line("t", "line", source=source, line_width=2, line_dash="dashed", name="quiet")
    for which in ("low", "high"):
        limit = Span(location=0.0, dimension="width", line_dash="dotted", line_width=1.5, visible=False, name=which)
        made["command"].add_layout(limit)
    for name, value in {
        "response": "@y{0.000}",
        "command": "@u{0.000}",
        "delay": "@d",
        "left": "@left{0.0000}",
    }.items():
        tips = [("t", "@t{0.00} s"), (_TIPS[name], value)]
        made[name].add_tools(HoverTool(tooltips=tips, mode="vline", renderers=[curves[name]]))
    return made


def _figure(name: str, seconds: Range1d) -> Any:
    first = (_LEFT_LOW, _LEFT_HIGH) if name == "left" else (0.0, 1.0)
    plot = figure(
        name=name,
        height=_HEIGHTS[name],
        sizing_mode="stretch_width",
        x_range=seconds,
        y_range=Range1d(start=first[0], end=first[1]),
        y_axis_type="log" if name == "left" else "linear",
        toolbar_location=None,
        tools="",
        background_fill_color=None,
        border_fill_color=None,
        outline_line_color=None,
        min_border_left=64,
        min_border_right=12,
    )
    plot.yaxis.axis_label = {"response": "y", "command": "u", "delay": "d(k), samples", "left": "what is left"}[name]
    plot.xaxis.axis_label = "time, s" if name == "left" else None
    return plot


# -- data


def _system(lesson: Lesson) -> dict[str, Any]:
    """Return what the script needs of one set of gains."""
    gains, cases = lesson.gains, lesson.cases
    label, degrees = output(gains)
    command, scale = _INPUTS.get(gains.model.name.split("-")[0], ("u, as in the model", 1.0))
    shrinking = [case for case in cases.values() if case.growth < 1.0]
    framed = shrinking or list(cases.values())[:1]
    until = SAMPLES if shrinking else _FIRST
    views = {
        "response": _view([case.y[:until] * degrees for case in framed]),
        "command": _view([case.u[:until] * scale for case in framed]),
    }
    return {
        "name": gains.name,
        "Ts": gains.model.Ts,
        "first": lesson.delays[0],
        "last": lesson.delays[-1],
        "seconds": SAMPLES * gains.model.Ts,
        "labels": {"response": label, "command": command},
        "views": {**views, "delay": (0.0, lesson.delays[-1] + 1.0)},
        "limits": _limits(gains, scale, views["command"]),
        "yr": None if lesson.yr is None else _packed(lesson.yr * degrees),
        "takeaway": takeaway(lesson),
        "fifo": lesson.transitions == "fifo",
        "cases": {
            pattern: [_case(lesson, cases[pattern, d], views, degrees, scale) for d in lesson.delays]
            for pattern in PATTERNS
        },
    }


def _case(
    lesson: Lesson, case: Case, views: Mapping[str, tuple[float, float]], degrees: float, scale: float
) -> dict[str, Any]:
    said = verdict(lesson, case)
    left = case.left.copy()
    left[(left < _LEFT_LOW / _BEYOND) | (left > _LEFT_HIGH * _BEYOND)] = np.nan
    return {
        "standing": standing(case),
        "headline": said.headline,
        "about": said.about,
        "says": said.says,
        "numbers": said.numbers,
        "grows": case.growth > 1.0,
        "y": _packed(_visible(case.y * degrees, views["response"])),
        "u": _packed(_visible(case.u * scale, views["command"])),
        "d": base64.b64encode(case.delays.astype(np.uint8).tobytes()).decode(),
        "left": _packed(left),
        "line": _line(case),
    }


def _limits(gains: Gains, scale: float, view: tuple[float, float]) -> tuple[float, float] | None:
    """Return the ends of the actuator's travel as deviations from trim; None where neither is in the picture."""
    actuator, trim = gains.model.actuator, gains.model.trim.u[0]
    if actuator is None or actuator.low is None or actuator.high is None:
        return None
    ends = float(actuator.low[0] - trim) * scale, float(actuator.high[0] - trim) * scale
    return ends if view[0] < ends[0] or ends[1] < view[1] else None


def _view(curves: Sequence[Floats]) -> tuple[float, float]:
    """Return the range of all curves and a third more, the same for every case of a system.

    The curves that grow have no part in it: they leave the picture, and no axis hides that they do.
    """
    low, high = min(float(np.nanmin(curve)) for curve in curves), max(float(np.nanmax(curve)) for curve in curves)
    room = max(high - low, 1e-9) / 3.0
    return low - room, high + room


def _visible(curve: Floats, view: tuple[float, float]) -> Floats:
    """Return a curve up to where it has left the picture by far."""
    gone = np.abs(curve - sum(view) / 2.0) > _BEYOND * (view[1] - view[0])
    return np.where(np.logical_or.accumulate(gone), np.nan, curve)


def _line(case: Case) -> list[float]:
    """Return (log10 at k = 0, log10 per sample) of the growth that is predicted, through what was left in the end."""
    per_sample = float(np.log10(max(case.growth, 1e-12)))
    k = np.flatnonzero((case.left > 0.0) & (case.left < np.inf))
    k = k[len(k) * 2 // 3 :]
    above = np.log10(case.left[k]) - per_sample * k
    return [round(float(above.max(initial=-300.0)), 6), round(per_sample, 9)]


def _packed(curve: Floats) -> str:
    return base64.b64encode(np.ascontiguousarray(curve, dtype="<f4").tobytes()).decode()
