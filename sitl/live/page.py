"""The page of a flight that is being flown: empty figures, and the script that fills them from the stream.

Everything is inline, Bokeh's own script too. What a recording says reaches the page as data only: JSON in a block of
its own, and text that the script sets as text.
"""

from __future__ import annotations

import html
import math
import string
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import bokeh
import orjson
from bokeh.core.types import ID
from bokeh.embed import json_item
from bokeh.layouts import column
from bokeh.models import ColumnDataSource, HoverTool, Model, Plot, Range1d
from bokeh.plotting import figure

from gains.model import Model as Aircraft
from gains.table import InputError
from sitl.braille import Quantity, input_quantity, output_quantity
from sitl.live.feed import COLUMNS, MAX_ROWS, WINDOW_S
from sitl.live.server import STREAM_PATH
from sitl.live.session import Flight
from sitl.view import MODE_STYLES

__all__ = ["render"]

_SKY, _GREEN, _BLUE, _VERMILLION, _PURPLE, _ORANGE, _GREY = (
    "#56B4E9", "#009E73", "#0072B2", "#D55E00", "#CC79A7", "#E69F00", "#808080",
)  # fmt: skip
"""Of Okabe and Ito, which the colour-blind can tell apart; each can be seen on white and on black."""
_MODE_COLOURS = {
    "STANDBY": _GREY, "TRACKING": _GREEN, "LEVEL": _SKY,
    "CONSERVATIVE": _PURPLE, "HOLD": _ORANGE, "NEUTRAL": _VERMILLION,
}  # fmt: skip
assert _MODE_COLOURS.keys() == MODE_STYLES.keys()

_FITTED = {
    "output": {"samples": ["y", "yr", "e"]},
    "control": {"samples": ["u"]},
    "delay": {"samples": ["d"], "commands": ["d", "low", "high"]},
    "link": {"up": ["ms"], "down": ["ms"]},
}
"""The columns that the vertical range of each figure is fitted to, by source."""
_TOOLS = "xpan,xwheel_zoom,xbox_zoom,reset"
_PLAIN = Quantity("u", 1.0, "")


def render(flight: Flight, run: str) -> str:
    """Return the page of a flight, to be filled by the stream of the server that is called ``run``."""
    output, control = _quantities(flight.model)
    described = {
        "run": run,
        "flight": flight.number,
        "stream": STREAM_PATH,
        "columns": COLUMNS,
        "rollover": MAX_ROWS,
        "window_s": WINDOW_S,
        "factors": {"y": output.factor, "yr": output.factor, "e": output.factor, "u": control.factor},
        "output": {"name": output.name, "reference": output.reference, "unit": output.unit},
        "control": {"name": control.name, "unit": control.unit},
        "window": _window(flight),
        "colours": _MODE_COLOURS,
        "texts": [],
        "fitted": _FITTED,
    }
    figures: Any = None
    if flight.number:
        plots = _plots(flight, output, control)
        described["texts"] = _named_texts(plots)
        figures = json_item(column(*plots, sizing_mode="stretch_width"), ID("figures"))
    return string.Template(_file("live.html")).substitute(
        title=html.escape(_title(flight)),
        facts=_facts(flight, output),
        style=_file("live.css"),
        bokeh=_bokeh() if flight.number else "",
        described=_json(described),
        figures=_json(figures),
        script=_file("live.js"),
    )


def _title(flight: Flight) -> str:
    return f"Live: {flight.name}" if flight.number else "Live: no flight yet"


def _facts(flight: Flight, output: Quantity) -> str:
    """Return what the recording says of the flight, as a line of HTML."""
    said = [flight.metadata[key] for key in ("title",) if key in flight.metadata]
    said += [f"{key} {flight.metadata[key]}" for key in ("plant", "gains", "seed", "time") if key in flight.metadata]
    if flight.number and flight.model is None:
        said.append("the recording does not say which model this is: its samples cannot be shown")
    elif flight.model is not None and flight.model.ny > 1:
        said.append(f"{output.name} is the first of {flight.model.ny} outputs")
    return html.escape(" · ".join(said))


def _quantities(model: Aircraft | None) -> tuple[Quantity, Quantity]:
    """Return how the output and the control are shown."""
    if model is None:
        return Quantity("y", 1.0, ""), _PLAIN
    try:
        control = input_quantity(model)
    except InputError:  # a model without travel
        control = _PLAIN
    return output_quantity(model), control


def _window(flight: Flight) -> list[float] | None:
    """Return d_min and d_max as the recording says them."""
    try:
        window = [float(flight.metadata[key]) for key in ("d_min", "d_max")]
    except (KeyError, ValueError):
        return None
    return window if all(map(math.isfinite, window)) else None


def _plots(flight: Flight, output: Quantity, control: Quantity) -> list[Plot]:
    """Return the figures: output, control, delay, link, and who flew."""
    sources = {
        name: ColumnDataSource({column: [] for column in columns}, name=name) for name, columns in COLUMNS.items()
    }
    sources["modes"] = ColumnDataSource({"left": [], "right": [], "mode": [], "colour": []}, name="modes")
    for way in ("up", "down"):
        sources[f"{way}-lost"] = ColumnDataSource({"t": []}, name=f"{way}-lost")
    shared = Range1d(start=0.0, end=WINDOW_S, name="time")
    plots = [
        _output_plot(shared, sources, output),
        _control_plot(shared, sources, control),
        _delay_plot(shared, sources, flight),
        _link_plot(shared, sources),
        _modes_plot(shared, sources),
    ]
    for plot in plots:
        plot.toolbar.logo = None
        plot.background_fill_alpha = plot.border_fill_alpha = 0.0
        plot.outline_line_alpha = 0.0
        plot.grid.grid_line_alpha = 0.25
        plot.grid.grid_line_color = _GREY
        for legend in plot.legend:
            legend.orientation, legend.click_policy, legend.location = "horizontal", "hide", "top_left"
            legend.background_fill_alpha, legend.border_line_alpha = 0.0, 0.0
            legend.label_text_font_size, legend.padding, legend.ncols = "10px", 2, 3
            legend.spacing, legend.glyph_width, legend.label_standoff = 2, 14, 3
            plot.add_layout(legend, "above")
    return plots


def _plot(shared: Range1d, name: str, label: str, height: int, low: float = 0.0, high: float = 1.0) -> Any:
    """Return an empty figure over the shared time; the script fits its range to what can be seen."""
    plot = figure(
        height=height, sizing_mode="stretch_width", x_range=shared, tools=_TOOLS, active_scroll=None,
        toolbar_location="right", y_axis_label=label, min_border_left=56, output_backend="canvas", lod_threshold=None,
        y_range=Range1d(start=low, end=high, name=f"{name}-range"),
    )  # fmt: skip
    plot.toolbar.autohide = True
    return plot


def _hover(plot: Any, renderers: list[Any], *rows: tuple[str, str]) -> None:
    plot.add_tools(HoverTool(renderers=renderers, tooltips=list(rows), point_policy="snap_to_data"))


def _labelled(name: str, unit: str) -> str:
    return f"{name} [{unit.strip()}]" if unit.strip() else name


def _output_plot(shared: Range1d, sources: dict[str, ColumnDataSource], output: Quantity) -> Any:
    plot = _plot(shared, "output", _labelled(output.name, output.unit), 250)
    plot.line("t", "yr", source=sources["samples"], color=_GREY, line_dash="dashed", line_width=1.6,
              legend_label=f"reference {output.reference}")  # fmt: skip
    y = plot.line("t", "y", source=sources["samples"], color=_BLUE, line_width=1.8, legend_label=output.name)
    plot.line("t", "e", source=sources["samples"], color=_VERMILLION, line_width=1.0, legend_label="error")
    _hover(plot, [y], ("time", "@t{0.000} s"), ("k", "@k"), (output.name, "@y{0.000}" + output.unit),
           (output.reference, "@yr{0.000}" + output.unit), ("error", "@e{0.0000}" + output.unit))  # fmt: skip
    return plot


def _control_plot(shared: Range1d, sources: dict[str, ColumnDataSource], control: Quantity) -> Any:
    plot = _plot(shared, "control", _labelled(control.name, control.unit), 170)
    u = plot.step("t", "u", source=sources["samples"], mode="after", color=_BLUE, line_width=1.4)
    _hover(plot, [u], ("time", "@t{0.000} s"), ("k", "@k"), (control.name, "@u{0.000}" + control.unit))
    return plot


def _delay_plot(shared: Range1d, sources: dict[str, ColumnDataSource], flight: Flight) -> Any:
    plot = _plot(shared, "delay", "delay [samples]", 190)
    Ts = 0.025 if flight.model is None else flight.model.Ts
    plot.vbar("at", bottom="low", top="high", width=Ts, source=sources["commands"], fill_color=_SKY, fill_alpha=0.35,
              line_color=_SKY, line_alpha=0.35, line_width=3, legend_label="forecast interval")  # fmt: skip
    plot.scatter("at", "d", source=sources["commands"], color=_VERMILLION, size=5, legend_label="forecast d")
    d = plot.step("t", "d", source=sources["samples"], mode="after", color=_GREY, line_width=1.4,
                  legend_label="true d(k)")  # fmt: skip
    if window := _window(flight):
        plot.hspan(window, line_color=_GREEN, line_dash="dashed", line_width=1.4, legend_label="window")
    _hover(plot, [d], ("time", "@t{0.000} s"), ("k", "@k"), ("d(k)", "@d"))
    return plot


def _link_plot(shared: Range1d, sources: dict[str, ColumnDataSource]) -> Any:
    plot = _plot(shared, "link", "one-way delay [ms]", 190)
    for way, colour, height in (("up", _BLUE, -1.0), ("down", _ORANGE, -2.0)):
        dots = plot.scatter("t", "ms", source=sources[way], color=colour, alpha=0.7, size=3.5, legend_label=way)
        plot.scatter("t", height, source=sources[f"{way}-lost"], color=colour, marker="dash", angle=math.pi / 2, size=8,
                     line_width=1.5, legend_label=f"{way}, lost")  # fmt: skip
        _hover(plot, [dots], ("time", "@t{0.000} s"), (way, "@ms{0.00} ms"))
    return plot


def _modes_plot(shared: Range1d, sources: dict[str, ColumnDataSource]) -> Any:
    plot = _plot(shared, "modes", "mode", 110)
    plot.xaxis.axis_label = "time [s]"
    band = plot.quad(left="left", right="right", bottom=0, top=1, color="colour", alpha=0.75, source=sources["modes"])
    plot.yaxis.major_label_text_font_size, plot.yaxis.major_tick_line_color = "0px", None
    plot.yaxis.minor_tick_line_color, plot.ygrid.grid_line_color = None, None
    _hover(plot, [band], ("mode", "@mode"), ("from", "@left{0.00} s"), ("to", "@right{0.00} s"))
    return plot


def _named_texts(plots: list[Plot]) -> list[str]:
    """Name what has text on it, so that the script can colour it; return the names."""
    texts: list[Model] = [part for plot in plots for part in (*plot.axis, *plot.legend)]
    for number, part in enumerate(texts):
        part.name = f"text-{number}"
    return [str(part.name) for part in texts]


def _json(content: object) -> str:
    """Return JSON that can stand in a script element: nothing in it ends that, or begins a comment."""
    return orjson.dumps(content, option=orjson.OPT_NON_STR_KEYS).decode().replace("<", "\\u003c")


def _file(name: str) -> str:
    return (resources.files("sitl.live") / name).read_text(encoding="utf-8")


@cache
def _bokeh() -> str:
    """Return BokehJS without what belongs to widgets, tables and notebooks."""
    path = Path(str(bokeh.__file__)).parent / "server" / "static" / "js" / "bokeh.min.js"
    return path.read_text(encoding="utf-8").replace("</script", "<\\/script")
