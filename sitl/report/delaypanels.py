"""The figures of the delay: that of the loop with its forecast, and that of each packet on the link."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource, Range1d
from numpy.typing import NDArray

from sitl.flightfile import FlightFile
from sitl.link.impairment import Fate
from sitl.report.drawn import compact, kept_packets, kept_rows
from sitl.report.plots import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SKY,
    VERMILLION,
    Panel,
    Shown,
    finish,
    hover,
    ink,
    literal,
    new_plot,
    shade,
    told_of,
)

__all__ = ["LINK_NAMES", "delay_panel", "link_panel"]

LINK_NAMES = {"up": "up, from the plant", "down": "down, to the plant"}
_LINK_COLOURS = {"up": BLUE, "down": ORANGE}
_LOSS_COLOURS = {"lost": VERMILLION, "blackout": PURPLE, "refused": GREY}
_FORECAST_HOLD = 3
_LEAST_DELAY_SHOWN = 6.0


# -- delay


def delay_panel(time: Range1d, flights: Sequence[Shown]) -> Panel:
    """Return the true delay with the window of the gains; of one flight alone its forecast, too."""
    law = flights[0].file.law
    longest = max(float(np.nanmax([0.0, *f.file.flight.d, *f.file.flight.forecast_high])) for f in flights)
    usual = max(_LEAST_DELAY_SHOWN, *(f.file.law.d_max + 2.0 for f in flights))
    top = max(usual, min(longest, 1.5 * usual))
    plot = new_plot(time, "delay", "delay [samples]", 230, (-0.5, top + 0.6))
    plot.yaxis.ticker.desired_num_ticks = 6
    plot.yaxis.ticker.min_interval = 1
    shade(plot, flights)
    alone = len(flights) == 1
    if alone:
        _forecast(plot, flights[0])
    for flight in flights:
        curve = plot.step(
            "t", "d", source=flight.samples, mode="after", line_width=1.6,
            line_color="black" if alone else flight.colour, legend_label="true d(k)" if alone else flight.label,
        )  # fmt: skip
        if alone:
            ink(curve)
        hover(plot, [curve], [*told_of(flight, alone), ("true d(k)", "@d")])
    windows = dict.fromkeys((f.file.law.d_min, f.file.law.d_max) for f in flights)
    if len(windows) == 1:
        plot.hspan([law.d_min, law.d_max], line_color=GREEN, line_dash="dashed", line_width=1.8,
                   legend_label=f"window {law.d_min}…{law.d_max}")  # fmt: skip
    else:
        for flight in flights:
            bounds = [flight.file.law.d_min, flight.file.law.d_max]
            plot.hspan(bounds, line_color=flight.colour, line_dash="dashed", line_width=1.2, line_alpha=0.8)
    note = "Dashed: the window of the gains. " if len(windows) > 1 else ""
    if longest > top:
        note += f"The longest delay, {longest:.0f} samples, is above the figure: drag or zoom. "
    if alone:
        note += "A forecast stands where it was to apply, at k = j + d."
    return Panel("delay", "Loop delay d(k)", finish(plot), note)


def _forecast(plot: Any, flight: Shown) -> None:
    """Draw the interval of the forecast as boxes, one for each run of equal bounds, and the forecast as dots."""
    data = flight.file.flight
    known = np.isfinite(data.forecast) & np.isfinite(data.forecast_low) & np.isfinite(data.forecast_high)
    if not known.any():
        return
    Ts = data.model.Ts
    applied = data.command_sample[known] + np.rint(data.forecast[known]).astype(np.int64)
    order = np.argsort(applied, kind="stable")
    applied = applied[order]
    low, high, d = (v[known][order] for v in (data.forecast_low, data.forecast_high, data.forecast))
    until = np.append(np.minimum(applied[1:], applied[:-1] + _FORECAST_HOLD), applied[-1] + 1)
    anew = (np.diff(low) != 0) | (np.diff(high) != 0) | (applied[1:] > until[:-1])
    first = np.flatnonzero(np.append(True, anew))
    final = np.append(first[1:] - 1, len(applied) - 1)
    boxes = {
        "left": compact(applied[first] * Ts), "right": compact(until[final] * Ts),
        "low": compact(low[first] - 0.25), "high": compact(high[first] + 0.25),
        "d_low": low[first].astype(np.int32), "d_high": high[first].astype(np.int32),
    }  # fmt: skip
    plot.quad(
        "left", "right", "high", "low", source=ColumnDataSource(boxes, name=f"intervals-{flight.place}"),
        fill_color=SKY, fill_alpha=0.4, line_color=None, legend_label="forecast interval",
    )  # fmt: skip
    rows = kept_rows([d, low, high])
    dots = {
        "t": compact(((applied + 0.5) * Ts)[rows]), "j": compact(data.command_j[known][order][rows]),
        "d": d[rows].astype(np.int32), "low": low[rows].astype(np.int32), "high": high[rows].astype(np.int32),
    }  # fmt: skip
    marks = plot.scatter(
        "t", "d", source=ColumnDataSource(dots, name=f"forecasts-{flight.place}"), size=4.5, fill_color=VERMILLION,
        line_color=None, legend_label="forecast d",
    )  # fmt: skip
    told = [("command of sample j", "@j"), ("forecast d", "@d, in @low to @high"), ("to apply at", "@t{0.000} s")]
    hover(plot, [marks], told, along=False)


# -- link


def link_panel(time: Range1d, flight: Shown, way: str) -> Panel:
    """Return the delay of each packet of one direction, and every loss."""
    data = flight.file.flight
    entered_s, delay_s = data.links[way]
    arrived = np.flatnonzero(np.isfinite(delay_s))
    arrived_s = np.concatenate([packets.delay_s[np.isfinite(packets.delay_s)] for packets in data.links.values()])
    longest = max(1.0, 1e3 * float(arrived_s.max(initial=0.0)))
    plot = new_plot(time, f"link-{way}", "delay [ms]", 190, (-0.04 * longest, 1.2 * longest))
    shade(plot, [flight])
    drawn = arrived[kept_packets(delay_s[arrived])]
    k = np.floor(entered_s / data.model.Ts + 1e-9)
    dots = {"t": compact(entered_s[drawn]), "ms": compact(1e3 * delay_s[drawn]), "k": k[drawn].astype(np.int32)}
    marks = plot.scatter(
        "t", "ms", source=ColumnDataSource(dots, name=f"packets-{way}"), size=4, fill_color=_LINK_COLOURS[way],
        fill_alpha=0.65, line_color=None, legend_label="delay of each packet",
    )  # fmt: skip
    hover(plot, [marks], [("entered", "@t{0.0000} s, sample @k"), ("one-way delay", "@ms{0.00} ms")], along=False)
    lost = np.flatnonzero(~np.isfinite(delay_s))
    if len(lost):
        _losses(plot, flight, way, lost, (1.04 * longest, 1.17 * longest))
    note = "" if len(drawn) == len(arrived) else (
        f"Thinned: {len(drawn):,} of {len(arrived):,} packets are drawn, the fastest and the slowest of every stretch "
        "among them; every loss is."
    )  # fmt: skip
    return Panel(f"link-{way}", f"Link {LINK_NAMES[way]}", finish(plot), note)


def _losses(plot: Any, flight: Shown, way: str, lost: NDArray[np.int64], ends: tuple[float, float]) -> None:
    """Mark every loss: one curve of upright strokes for those of one fate, which is quick to draw however many."""
    data = flight.file.flight
    entered_s = data.links[way].entered_s
    fates = np.array(_fates(flight.file, way, len(entered_s)), dtype=object)
    for fate in dict.fromkeys(fates[lost]):
        t = entered_s[lost[fates[lost] == fate]]
        columns = {
            "t": compact(np.repeat(t, 3)),
            "y": np.tile(np.array([*ends, np.nan], dtype=np.float32), len(t)),
            "k": np.repeat(np.floor(t / data.model.Ts + 1e-9).astype(np.int32), 3),
        }
        name = literal(str(fate)[:20])
        strokes = plot.line(
            "t", "y", source=ColumnDataSource(columns, name=f"{fate}-{way}"), line_width=1.4,
            line_color=_LOSS_COLOURS.get(str(fate), VERMILLION), legend_label=f"{name}: {len(t):,}",
        )  # fmt: skip
        hover(plot, [strokes], [(name, "@t{0.000} s, sample @k")], along=False)


def _fates(file: FlightFile, way: str, count: int) -> list[str]:
    """Return what became of each packet, in the order of :class:`~sitl.flightdata.LinkPackets`."""
    fates = [body["fate"] for topic, _, body in file.records if topic == f"link/{way}" and body["fate"] != Fate.GATED]
    return fates if len(fates) == count else [Fate.LOST.value] * count  # a flight that was not read from these records
