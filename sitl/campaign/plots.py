"""The figures of a campaign: gains beside η, how rare large errors are, errors by delay, sensitivities, pairs.

None holds a point per flight: histograms, quantiles and at most ``MAX_POINTS`` of a curve are drawn.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource, FixedTicker, LogScale, LogTicker, LogTickFormatter, Range1d
from numpy.typing import NDArray

from sitl.campaign.comparison import Pair
from sitl.campaign.intervals import proportion
from sitl.campaign.sensitivity import Sensitivity
from sitl.campaign.statistics import Columns, Gains, held
from sitl.campaign.words import PARAMETER_NAMES
from sitl.report.drawn import compact
from sitl.report.plots import BLUE, GREY, ORANGE, VERMILLION, Panel, finish, hover, ink, literal, new_plot

__all__ = ["MAX_POINTS", "delay_panel", "exceedance_panel", "gain_panel", "pair_panel", "sensitivity_panel"]

MAX_POINTS = 300
MAX_BARS = 120
CELLS = (60, 45)
"""Of the map of errors by delay: along the delay, along the error."""
MIN_STRIP = 50
"""Flights of a strip of the map, of which quantiles are drawn."""
SHOWN_SHARE = 0.999
"""Of the flights that the map holds for sure."""

Floats = NDArray[np.float64]


def gain_panel(gains: Gains) -> Panel:
    """Return the histogram of gains with η as a line; where there are many bars, two or more become one."""
    edges, counts = np.array(gains.histogram.edges), np.array(gains.histogram.counts)
    (full,) = np.nonzero(counts)
    merged = -(-int(np.ptp(full) + 1) // MAX_BARS) if full.size else 1
    edges, counts = (
        edges[::merged],
        counts.reshape(-1, merged).sum(axis=1),
    )  # 480 bins, by 4 at the most: η stays an edge
    (full,) = np.nonzero(counts)
    shown = slice(full[0], full[-1] + 1) if full.size else slice(len(counts) // 2 - 1, len(counts) // 2)
    left, right = edges[:-1][shown], edges[1:][shown]
    data = {"left": left, "right": right, "flights": counts[shown]}
    shown_to = max(float(right[-1]), gains.eta or 0.0)
    plot = new_plot(Range1d(start=float(left[0]) / 1.05, end=shown_to * 1.1), "gain", "flights", 280, None)
    _logarithmic(plot, "x")
    plot.xaxis.axis_label = "gain ‖e‖ / ‖v‖"
    bars = plot.quad(
        left="left", right="right", top="flights", bottom=0, source=_source(data), fill_color=BLUE, fill_alpha=0.8,
        line_color=None,
    )  # fmt: skip
    hover(plot, [bars], [("gain", "@left{0.0000} – @right{0.0000}"), ("flights", "@flights{0,0}")], along=False)
    if gains.eta is not None:
        plot.vspan([gains.eta], line_color=VERMILLION, line_dash="dashed", line_width=2, legend_label="η, proved")
    off = gains.histogram.below + gains.histogram.beyond
    note = "A bin holds its upper edge, and η is an edge: what is right of the line exceeded it. "
    note += f"{gains.infinite:,} flights diverged and are not drawn. " if gains.infinite else ""
    note += f"{gains.undefined:,} flights had no input. " if gains.undefined else ""
    note += f"{off:,} flights are off the grid, at 0 or far from all others." if off else ""
    return Panel("gain", "Gain of each flight", finish(plot), note.strip())


def exceedance_panel(columns: Columns, unit: str, threshold: float | None, confidence: float) -> Panel | None:
    """Return what share of the flights had a largest error of so much or more; None where all diverged."""
    errors = held(columns, "max_error")
    falling = np.sort(errors)[::-1]
    flights, infinite = len(falling), int(np.count_nonzero(np.isinf(falling)))
    if infinite == flights:
        return None
    counts = np.unique(np.geomspace(infinite + 1, flights, MAX_POINTS).astype(np.int64))
    told = [proportion(int(count), flights, confidence) for count in counts]
    share = counts / flights
    data = {
        "error": falling[counts - 1],
        "share": share,
        "low": np.array([one.low for one in told]),
        "high": np.array([one.high for one in told]),
    }
    right = max(float(data["error"][0]), threshold or 0.0) or 1.0
    plot = new_plot(Range1d(start=0.0, end=1.03 * right), "exceedance", "share of flights", 300,
                    (0.5 * float(data["low"].min()), 1.5))  # fmt: skip
    _logarithmic(plot, "y")
    plot.xaxis.axis_label = f"largest error{_in(unit)}"
    source = _source(data)
    plot.varea("error", "low", "high", source=source, fill_color=BLUE, fill_alpha=0.2,
               legend_label=f"{100.0 * confidence:g} % interval, each point by itself")  # fmt: skip
    curve = plot.line("error", "share", source=source, line_color=BLUE, line_width=2, legend_label="this campaign")
    hover(plot, [curve], [("largest error", "@error{0.0000}"), ("in a share of", "@share{0.0[000000]}")])
    if threshold is not None:
        plot.vspan([threshold], line_color=VERMILLION, line_dash="dashed", line_width=2, legend_label="threshold")
    note = "How often a flight's largest error was at least so large."
    note += f" The curve ends at the {infinite:,} flights that diverged." if infinite else ""
    return Panel("exceedance", "How rare large errors are", finish(plot), note)


def delay_panel(columns: Columns, unit: str) -> Panel | None:
    """Return a map of rms errors by mean delay with median and 95 %; None where the mean delay is always the same."""
    errors = held(columns, "rms_error")
    if "d_mean" not in columns:
        return None
    kept = np.isfinite(errors) & np.isfinite(columns["d_mean"])
    delay, error = columns["d_mean"][kept], errors[kept]
    if not delay.size or delay.min() == delay.max():
        return None
    top = float(np.quantile(error, SHOWN_SHARE)) * 1.1 or 1.0
    above = int(np.count_nonzero(error > top))
    span = (float(delay.min()), float(delay.max()))
    counts, x, y = np.histogram2d(delay, error, bins=CELLS, range=(span, (0.0, top)))
    column, row = np.nonzero(counts)
    flights = counts[column, row]
    cells = {
        "left": x[column], "right": x[column + 1], "bottom": y[row], "top": y[row + 1],
        "flights": flights.astype(np.int64), "alpha": 0.12 + 0.88 * np.log1p(flights) / np.log1p(flights.max()),
    }  # fmt: skip
    plot = new_plot(Range1d(start=span[0], end=span[1]), "delay", f"rms error{_in(unit)}", 320, (0.0, top))
    plot.xaxis.axis_label = "mean delay [samples]"
    drawn = plot.quad(
        left="left", right="right", bottom="bottom", top="top", fill_alpha="alpha", source=_source(cells),
        fill_color=BLUE, line_color=None,
    )  # fmt: skip
    hover(plot, [drawn], [("mean delay", "@left{0.00} – @right{0.00}"), ("rms error", "@bottom{0.0000} – @top{0.0000}"),
                          ("flights", "@flights{0,0}")], along=False)  # fmt: skip
    strips = _source(_strips(delay, error))
    plot.line("delay", "high", source=strips, line_color=VERMILLION, line_width=2, legend_label="95 %")
    ink(plot.line("delay", "median", source=strips, line_width=2, legend_label="median"))
    note = "The darker, the more flights, by the logarithm."
    note += f" {above:,} flights are above the figure." if above else ""
    lost = len(errors) - int(np.count_nonzero(kept))
    note += f" {lost:,} flights diverged and are not drawn." if lost else ""
    return Panel("delay", "Error by delay", finish(plot), note)


def _strips(delay: Floats, error: Floats) -> dict[str, Floats]:
    """Return median and 95 % of the errors in strips of equally many flights along the delay."""
    order = np.argsort(delay)
    strips = np.array_split(order, max(1, min(CELLS[0] // 2, len(order) // MIN_STRIP)))
    quantiles = np.array([np.quantile(error[strip], (0.5, 0.95)) for strip in strips])
    return {
        "delay": np.array([delay[strip].mean() for strip in strips]),
        "median": quantiles[:, 0],
        "high": quantiles[:, 1],
    }


def sensitivity_panel(found: Sensitivity, result: str, name: str) -> Panel | None:
    """Return bars of what each parameter does to a result, with two standard errors; None without parameters."""
    effects = [effect for effect in found.effects if math.isfinite(effect.spearman)]
    if not effects:
        return None
    places = -np.arange(len(effects), dtype=np.float64)
    plot = new_plot(Range1d(start=-1.05, end=1.05), name, "", 90 + 42 * len(effects), (float(places[-1]) - 0.6, 0.6))
    plot.yaxis.ticker = FixedTicker(ticks=places.tolist())
    plot.ygrid.visible = False
    plot.yaxis.major_label_overrides = {
        float(place): PARAMETER_NAMES[effect.name] for place, effect in zip(places, effects, strict=True)
    }
    kinds: Sequence[tuple[str, str, str, float]] = (
        ("sobol", "first-order Sobol index", BLUE, 0.19),
        ("spearman", "Spearman's rank correlation", ORANGE, -0.19),
    )
    for kind, label, colour, shift in kinds:
        value = np.array([getattr(effect, kind) for effect in effects])
        error = np.array([getattr(effect, f"{kind}_error") for effect in effects])
        data = {"y": places + shift, "value": value, "low": value - 2 * error, "high": value + 2 * error}
        source = _source(data)
        bars = plot.hbar(y="y", right="value", left=0, height=0.32, source=source, fill_color=colour, line_color=None,
                         legend_label=label)  # fmt: skip
        ink(plot.segment(x0="low", y0="y", x1="high", y1="y", source=source, line_width=1.5))
        hover(plot, [bars], [(label, "@value{0.000}"), ("two standard errors", "@low{0.000} – @high{0.000}")],
              along=False)  # fmt: skip
    return Panel(name, f"What moves the {result}", finish(plot))


def pair_panel(pair: Pair, place: int) -> Panel:
    """Return the histogram of rms errors' ratios of two controllers, flight by flight."""
    edges = np.exp(np.array(pair.edges))
    data = {"left": edges[:-1], "right": edges[1:], "flights": np.array(pair.counts)}
    plot = new_plot(Range1d(start=float(edges[0]), end=float(edges[-1])), f"pair-{place}", "flights", 260, None)
    _logarithmic(plot, "x")
    plot.xaxis.axis_label = f"rms error of {pair.a} / that of {pair.b}"
    bars = plot.quad(
        left="left", right="right", top="flights", bottom=0, source=_source(data), fill_color=BLUE, fill_alpha=0.8,
        line_color=None,
    )  # fmt: skip
    hover(plot, [bars], [("ratio", "@left{0.000} – @right{0.000}"), ("flights", "@flights{0,0}")], along=False)
    plot.vspan([1.0], line_color=GREY, line_width=2, legend_label="equal")
    median = pair.log_ratio
    if edges[0] <= math.exp(min(max(median.value, -700.0), 700.0)) <= edges[-1]:
        plot.vspan([math.exp(median.value)], line_color=VERMILLION, line_dash="dashed", line_width=2,
                   legend_label="median")  # fmt: skip
    note = f"Left of 1, {pair.a} tracks better."
    note += f" {pair.off:,} flights are off the figure." if pair.off else ""
    note += f" In {pair.both_diverged:,} both diverged." if pair.both_diverged else ""
    return Panel(f"pair-{place}", f"{pair.a} beside {pair.b}, flight by flight", finish(plot), note)


def _logarithmic(plot: Any, way: str) -> None:
    """Make one axis logarithmic."""
    setattr(plot, f"{way}_scale", LogScale())
    axis, grid = (plot.xaxis, plot.xgrid) if way == "x" else (plot.yaxis, plot.ygrid)
    ticker = LogTicker()
    axis.ticker, axis.formatter, grid.ticker = ticker, LogTickFormatter(ticker=ticker), ticker


def _source(data: dict[str, Any]) -> ColumnDataSource:
    return ColumnDataSource({name: compact(values) for name, values in data.items()})


def _in(unit: str) -> str:
    return f" [{literal(unit)}]" if unit else ""
