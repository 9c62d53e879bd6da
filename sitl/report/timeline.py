"""The figure of the failsafe: modes as bands, faults, and events as marks that tell what they were."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource, Range1d

from sitl.flightfile import FlightFile
from sitl.recovery import recoveries
from sitl.report.numbers import QUIET_KINDS, plain_paths
from sitl.report.plots import GREY, MODE_COLOURS, Panel, Shown, finish, hover, ink, new_plot

__all__ = ["timeline_panel"]


# -- failsafe


def timeline_panel(time: Range1d, flights: Sequence[Shown]) -> Panel:
    """Return the modes as bands, with faults and events below them where there is one flight."""
    alone = len(flights) == 1
    names = {1.0 - n: flight.label for n, flight in enumerate(flights)} if not alone else {1.0: "mode"}
    if alone:
        names |= {0.0: "faults"} if _fault_times(flights[0].file) else {}
        names[min(names) - 1.0] = "events"
    height = 90 + 34 * len(names)
    plot = new_plot(time, "timeline", "", height, (min(names) - 0.6, 1.6))
    plot.xaxis.axis_label = "time [s]"
    plot.yaxis.ticker = list(names)
    plot.yaxis.major_label_overrides = {at: name[:14] for at, name in names.items()}
    plot.ygrid.grid_line_color = None
    bands: dict[str, list[tuple[float, float, float, str]]] = {}
    for flight in flights:
        for m in flight.file.flight.modes:
            bands.setdefault(m.mode, []).append((m.start_s, m.end_s, 1.0 - flight.place, flight.label))
    for mode, shown in bands.items():
        data = {
            "left": np.array([b[0] for b in shown]),
            "right": np.array([b[1] for b in shown]),
            "low": np.array([b[2] - 0.36 for b in shown]),
            "high": np.array([b[2] + 0.36 for b in shown]),
            "mode": [mode] * len(shown),
            "flight": [b[3] for b in shown],
        }
        band = plot.quad(
            "left", "right", "high", "low", source=ColumnDataSource(data, name=f"mode-{mode}"), line_color=None,
            fill_color=MODE_COLOURS.get(mode, GREY), fill_alpha=0.85, legend_label=mode,
        )  # fmt: skip
        rows = [("mode", "@mode"), ("from", "@left{0.000} s"), ("to", "@right{0.000} s")]
        hover(plot, [band], rows if alone else [("flight", "@flight"), *rows], along=False)
    if alone:
        _faults(plot, flights[0])
        _events(plot, flights[0], min(names))
    return Panel("timeline", "Failsafe", finish(plot), "Hover over a band or an event for what it was.")


def _fault_times(file: FlightFile) -> list[tuple[float, float, str]]:
    """Return (from, to, text) of what the events tell of faults; to the end where one has none."""
    end_s = float(file.flight.time_s[-1]) + file.flight.model.Ts
    least = 0.004 * end_s  # what happens at one instant can be seen, too
    return [
        (f.begin_s, max(f.begin_s + least, end_s if f.end_s is None else f.end_s), plain_paths(f.fault))
        for f in recoveries(file.records)
    ]


def _faults(plot: Any, flight: Shown) -> None:
    times = _fault_times(flight.file)
    if not times:
        return
    data = {"left": [t[0] for t in times], "right": [t[1] for t in times], "text": [t[2] for t in times]}
    band = plot.quad(
        "left", "right", 0.36, -0.36, source=ColumnDataSource(data, name="faults"), fill_color="black",
        fill_alpha=0.6, line_color=None, legend_label="fault",
    )  # fmt: skip
    ink(band)
    hover(plot, [band], [("fault", "@text"), ("from", "@left{0.000} s")], along=False)


def _events(plot: Any, flight: Shown, at: float) -> None:
    shown = [e for e in flight.file.flight.events if e.kind not in QUIET_KINDS]
    if not shown:
        return
    data = {
        "t": np.array([e.time_s for e in shown]),
        "y": np.full(len(shown), at),
        "kind": [e.kind for e in shown],
        "text": [plain_paths(e.text) for e in shown],
    }
    marks = plot.scatter(
        "t", "y", source=ColumnDataSource(data, name="events"), marker="diamond", size=11, fill_color="black",
        fill_alpha=0.75, line_color=None, legend_label="event",
    )  # fmt: skip
    ink(marks)
    hover(plot, [marks], [("time", "@t{0.000} s"), ("@kind", "@text")], along=False)
