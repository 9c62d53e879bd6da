"""What all figures of a report share: colours, the empty figure with its tools, legends, hover texts, shaded modes.

Backgrounds are transparent and curves have colours of Okabe and Ito, which can be seen on light and on dark and which
the colour-blind can tell apart. What must have the colour of the text is tagged ``INK``; the page's script gives it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from bokeh.models import (
    BoxZoomTool,
    ColumnDataSource,
    DataRange1d,
    HoverTool,
    PanTool,
    Range1d,
    ResetTool,
    WheelZoomTool,
)
from bokeh.plotting import figure

from gains.model import Matrix
from sitl.braille import Quantity
from sitl.flightfile import FlightFile

__all__ = [
    "BLUE", "COLOURS", "GREEN", "GREY", "INK", "MODE_COLOURS", "ORANGE", "PURPLE", "SKY", "VERMILLION", "Panel",
    "Shown", "finish", "framed_around", "hover", "ink", "literal", "named", "new_plot", "shade", "told_of", "value",
]  # fmt: skip

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Of the flights side by side, and of the outputs of one."""
BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY = COLOURS
GREY = "#808080"
MODE_COLOURS = {
    "STANDBY": GREY, "TRACKING": GREEN, "LEVEL": SKY, "CONSERVATIVE": PURPLE, "HOLD": ORANGE, "NEUTRAL": VERMILLION,
}  # fmt: skip
INK = "ink"
"""Tag of glyphs in the colour of the text."""
MARGIN = 70
"""Left of every figure, px, so that their axes of time stand below one another; the script narrows it on phones."""
BEYOND = 40.0
"""Of a flight that diverged, how many times the span of its reference is not exceeded by a figure that shows all."""


class Panel(NamedTuple):
    """A figure with its heading and, maybe, a sentence below it."""

    name: str
    heading: str
    figure: Any
    note: str = ""


class Shown(NamedTuple):
    """A flight, its label among the others, its place and its colour.

    Attributes
    ----------
    samples : ColumnDataSource
        What is drawn of its samples, for all figures.
    thinned : bool
        Whether those are not all.
    """

    file: FlightFile
    label: str
    place: int
    colour: str
    samples: ColumnDataSource
    thinned: bool


def new_plot(time: Range1d, name: str, label: str, height: int, y_range: tuple[float, float] | None) -> Any:
    """Return an empty figure; without a range it fits itself to what it shows."""
    tools: list[Any] = [
        PanTool(dimensions="both"),
        BoxZoomTool(dimensions="auto"),
        WheelZoomTool(dimensions="width", modifiers="ctrl", description="Wheel zoom: Ctrl and wheel"),
        ResetTool(),
    ]
    plot = figure(
        name=name, height=height, sizing_mode="stretch_width", x_range=time, y_axis_label=label, tools=tools,
        toolbar_location="above", active_drag=tools[1], active_scroll=tools[2], min_border_left=MARGIN,
        min_border_right=8, background_fill_color=None, border_fill_color=None, outline_line_color=None,
        lod_threshold=None, y_range=DataRange1d() if y_range is None else Range1d(start=y_range[0], end=y_range[1]),
    )  # fmt: skip
    plot.toolbar.logo = None
    plot.grid.grid_line_color, plot.grid.grid_line_alpha = GREY, 0.2
    for axis in plot.axis:
        axis.axis_line_color = axis.major_tick_line_color = GREY
        axis.minor_tick_line_color = None
        axis.axis_label_text_font_style, axis.axis_label_text_font_size = "normal", "12px"
        axis.major_label_text_font_size = "11px"
    return plot


def finish(plot: Any) -> Any:
    """Put the legend above the figure, where it hides nothing; a click on an entry hides its curve."""
    for legend in plot.legend:
        legend.orientation, legend.click_policy = "horizontal", "hide"
        legend.background_fill_alpha, legend.border_line_alpha, legend.inactive_fill_alpha = 0.0, 0.0, 0.35
        legend.label_text_font_size, legend.padding, legend.margin, legend.spacing = "12px", 0, 2, 12
        legend.glyph_width, legend.label_standoff, legend.ncols = 18, 4, max(1, len(legend.items))
        plot.add_layout(legend, "above")
    return plot


def ink(renderer: Any) -> Any:
    """Let a glyph have the colour of the text."""
    for glyph in (renderer.glyph, renderer.nonselection_glyph, renderer.muted_glyph):
        if hasattr(glyph, "tags"):
            glyph.tags = [INK]
    return renderer


def hover(plot: Any, renderers: list[Any], rows: Sequence[tuple[str, str]], *, along: bool = True) -> None:
    """Tell values of some curves: those at the pointer's time, or of what is under it."""
    mode: Literal["mouse", "vline"] = "vline" if along else "mouse"
    plot.add_tools(HoverTool(renderers=renderers, tooltips=list(rows), mode=mode, point_policy="snap_to_data"))


def named(quantity: Quantity) -> str:
    """Return the name of an axis."""
    return f"{quantity.name} [{quantity.unit.strip()}]" if quantity.unit else quantity.name


def framed_around(lists: Sequence[Matrix], span: float) -> tuple[float, float] | None:
    """Return a range for curves of which some may run far away; None where they do not."""
    values = np.concatenate([np.zeros(0), *lists])
    values = values[np.isfinite(values)]
    if not values.size or not span or float(np.ptp(values)) <= BEYOND * span:
        return None
    return (-BEYOND / 4 * span, BEYOND / 4 * span)


def shade(plot: Any, flights: Sequence[Shown]) -> None:
    """Shade the modes of one flight in which its law did not fly; side by side they would hide one another."""
    if len(flights) > 1:
        return
    shown = [m for m in flights[0].file.flight.modes if m.mode != "TRACKING" and m.end_s > m.start_s]
    for mode in dict.fromkeys(m.mode for m in shown):
        data = {
            "x0": np.array([m.start_s for m in shown if m.mode == mode]),
            "x1": np.array([m.end_s for m in shown if m.mode == mode]),
        }
        colour = MODE_COLOURS.get(mode, GREY)
        plot.vstrip(
            "x0", "x1", source=ColumnDataSource(data), level="underlay",
            fill_color=colour, fill_alpha=0.2, line_color=None,
        )  # fmt: skip


def value(column: str, unit: str) -> str:
    """Return what a hover text shows of a column."""
    return f"@{column}{{0.000}}{unit}"


def literal(text: str) -> str:
    """Return a text as a tooltip shall show it: what Bokeh would read as a field is none."""
    return text.replace("@", "＠").replace("$", "＄").replace("{", "(").replace("}", ")").replace("<", "‹")


def told_of(flight: Shown, alone: bool) -> list[tuple[str, str]]:
    """Return the first rows of a hover text about a sample: which flight where there are several, when, and k."""
    rows = [] if alone else [("flight", literal(flight.label))]
    return [*rows, ("time", "@t{0.000} s"), ("sample k", "@k")]
