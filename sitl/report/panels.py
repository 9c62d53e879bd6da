"""The figures of a report, drawn with Bokeh over one axis of time: zoom one and all follow.

Every figure gets its data from a source named after what it holds (``samples-0`` of the first flight, and so on), so
the page's numbers can be compared with the recording. This module draws what is sampled: output, error, elevator, air.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource, Range1d

from gains.model import Matrix
from sitl.braille import Quantity
from sitl.flightfile import FlightFile
from sitl.report.delaypanels import LINK_NAMES, delay_panel, link_panel
from sitl.report.drawn import compact, gaps, kept_rows, runs
from sitl.report.numbers import control, outputs, saturated
from sitl.report.plots import (
    COLOURS,
    GREY,
    PURPLE,
    Panel,
    Shown,
    finish,
    framed_around,
    hover,
    ink,
    named,
    new_plot,
    shade,
    told_of,
    value,
)
from sitl.report.timeline import timeline_panel

__all__ = ["MAX_FLIGHTS", "panels"]

MAX_FLIGHTS = len(COLOURS)
AIR = "air_"
"""Begins the names of the columns of what the plant tells beside the states of the model."""
_LEAST_TRAVEL_USED = 0.4  # with less of it in use, lines at the limits would flatten the curve
_AIR = {
    "airspeed_m_s": ("airspeed", 1.0, " m/s"), "altitude_m": ("altitude", 1.0, " m"),
    "climb_m_s": ("climb", 1.0, " m/s"), "roll_rad": ("roll φ", math.degrees(1.0), "°"),
    "beta_rad": ("sideslip β", math.degrees(1.0), "°"), "throttle": ("throttle", 100.0, " %"),
}  # fmt: skip


def panels(files: Sequence[FlightFile], labels: Sequence[str]) -> list[Panel]:
    """Return the figures of a flight, or of several in comparison, in the order of the page.

    Parameters
    ----------
    files : sequence of FlightFile
        From one to ``MAX_FLIGHTS``.
    labels : sequence of str
        What to call each.
    """
    assert 0 < len(files) <= MAX_FLIGHTS
    first = min(0.0, *(float(file.flight.time_s[0]) for file in files))
    last = max(float(file.flight.time_s[-1]) + file.flight.model.Ts for file in files)
    time = Range1d(start=first, end=last, bounds=(first, last), min_interval=4 * files[0].flight.model.Ts, name="time")
    flights = [
        Shown(file, label, n, COLOURS[n], *_samples(file, n))
        for n, (file, label) in enumerate(zip(files, labels, strict=True))
    ]
    made = [_tracking(time, flights), _error(time, flights), _control(time, flights), delay_panel(time, flights)]
    if len(flights) == 1:
        made += [link_panel(time, flights[0], way) for way in LINK_NAMES]
    made += [timeline_panel(time, flights), *_air(time, flights)]
    return made


def _samples(file: FlightFile, n: int) -> tuple[ColumnDataSource, bool]:
    """Return the source of a flight's samples, and whether it was thinned; a row of nan is where samples miss."""
    flight = file.flight
    columns: dict[str, Matrix] = {"t": flight.time_s, "d": flight.d}
    with np.errstate(over="ignore", invalid="ignore"):
        for i, quantity in enumerate(outputs(flight.model)):
            columns[f"y{i}"] = quantity.factor * flight.output[:, i]
            columns[f"yr{i}"] = quantity.factor * flight.reference[:, i]
            columns[f"e{i}"] = quantity.factor * flight.error[:, i]
        for i in range(flight.model.nu):
            columns[f"u{i}"] = control(flight.model).factor * flight.u[:, i]
    for name, values in file.air.items():
        columns[AIR + name] = _AIR.get(name, ("", 1.0, ""))[1] * values
    missing = gaps(np.rint(flight.time_s / flight.model.Ts).astype(np.int64))
    rows = np.union1d(kept_rows([values for name, values in columns.items() if name != "t"]), missing)
    at = np.searchsorted(rows, missing, side="right")
    data: dict[str, Any] = {"k": compact(np.insert(flight.k[rows], at, flight.k[missing] + 1))}
    for name, values in columns.items():
        fill = values[missing] + flight.model.Ts if name == "t" else np.nan
        data[name] = compact(np.insert(values[rows], at, fill))
    return ColumnDataSource(data, name=f"samples-{n}"), len(rows) < len(flight.time_s)


# -- tracking


def _tracking(time: Range1d, flights: Sequence[Shown]) -> Panel:
    quantities = outputs(flights[0].file.flight.model)
    label = ", ".join(dict.fromkeys(map(named, quantities)))
    framed = framed_around([_drawn(f, "y0") for f in flights], _reference_span(flights))
    plot = new_plot(time, "tracking", label, 300, framed)
    shade(plot, flights)
    alone = len(flights) == 1
    own = [flight.place for flight in flights if _own_reference(flights, flight.place)]
    for flight in flights:
        has_reference = flight.file.flight.model.reference is not None
        for i, quantity in enumerate(outputs(flight.file.flight.model)):
            if not alone and i:
                break
            if has_reference and flight.place in own:
                name = f"reference {quantity.reference}" + ("" if len(own) == 1 else f", {flight.label}")
                target = plot.line(
                    "t", f"yr{i}", source=flight.samples, line_dash="dashed", line_width=1.5, legend_label=name,
                    line_color="black" if len(own) == 1 else flight.colour,
                )  # fmt: skip
                if len(own) == 1:
                    ink(target)
            colour = COLOURS[i % len(COLOURS)] if alone else flight.colour
            name = quantity.name if alone else flight.label
            curve = plot.line(
                "t", f"y{i}", source=flight.samples, line_color=colour, line_width=2, legend_label=name
            )  # fmt: skip
            rows = [*told_of(flight, alone), (quantity.name, value(f"y{i}", quantity.unit))]
            if has_reference:
                rows += [(quantity.reference, value(f"yr{i}", quantity.unit))]
            rows += [("error", value(f"e{i}", quantity.unit)), ("true d(k)", "@d")]
            hover(plot, [curve], rows)
    note = _modes_note(flights) + _thinned_note(flights)
    return Panel("tracking", f"Output: {', '.join(q.name for q in quantities)}", finish(plot), note)


def _drawn(flight: Shown, column: str) -> Matrix:
    """Return a column of what is drawn of the samples."""
    return np.asarray(flight.samples.data[column], dtype=np.float64)


def _reference_span(flights: Sequence[Shown]) -> float:
    """Return how far the reference moves, in the shown unit; a little where it does not."""
    return max(1e-3, *(float(np.nanmax(yr) - np.nanmin(yr)) for yr in (_drawn(f, "yr0") for f in flights)))


def _own_reference(flights: Sequence[Shown], place: int) -> bool:
    """Return whether no other flight draws this one's reference: one of equal length before it, or a longer one."""
    mine = flights[place].file.flight
    for other in flights:
        theirs, count = other.file.flight, len(mine.time_s)
        longer = len(theirs.time_s) > count or (len(theirs.time_s) == count and other.place < place)
        equal = np.array_equal(theirs.time_s[:count], mine.time_s) and np.array_equal(
            theirs.reference[:count], mine.reference
        )
        if longer and equal:
            return False
    return True


def _modes_note(flights: Sequence[Shown]) -> str:
    modes = {m.mode for m in flights[0].file.flight.modes} - {"TRACKING"}
    return "Shaded: the law was not in TRACKING (see Failsafe). " if len(flights) == 1 and modes else ""


def _thinned_note(flights: Sequence[Shown]) -> str:
    thinned = [f for f in flights if f.thinned]
    if not thinned:
        return ""
    drawn, all_ = len(thinned[0].samples.data["t"]), len(thinned[0].file.flight.time_s)
    who = "" if len(flights) == 1 else f" of {thinned[0].label}"
    return (
        f"Thinned: {drawn:,} of {all_:,} samples{who} are drawn in this and the other figures, "
        "the least and greatest value of every stretch of every curve among them. "
    )


def _error(time: Range1d, flights: Sequence[Shown]) -> Panel:
    quantities = outputs(flights[0].file.flight.model)
    framed = framed_around([_drawn(f, "e0") for f in flights], _reference_span(flights))
    units = ", ".join(dict.fromkeys(quantity.unit.strip() for quantity in quantities))
    plot = new_plot(time, "error", f"e [{units}]" if units else "e", 180, framed)
    shade(plot, flights)
    alone = len(flights) == 1
    for flight in flights:
        for i, quantity in enumerate(outputs(flight.file.flight.model)):
            if not alone and i:
                break
            name = flight.label if not alone else f"{quantity.name} − {quantity.reference}"
            colour = flight.colour if not alone else COLOURS[(i + 1) % len(COLOURS)]
            curve = plot.line(
                "t", f"e{i}", source=flight.samples, line_color=colour, line_width=1.6, legend_label=name
            )  # fmt: skip
            rows = [*told_of(flight, alone), ("error", value(f"e{i}", quantity.unit))]
            hover(plot, [curve], rows)
    return Panel(
        "error", "Tracking error", finish(plot), "Against the reference model from rest, which failsafe never resets."
    )


# -- elevator


def _control(time: Range1d, flights: Sequence[Shown]) -> Panel:
    model = flights[0].file.flight.model
    quantity = control(model)
    used = framed_around([_drawn(f, "u0") for f in flights], _travel(flights[0]) or 1.0)
    plot = new_plot(time, "control", named(quantity), 190, used)
    shade(plot, flights)
    alone = len(flights) == 1
    for flight in flights:
        for i in range(flight.file.flight.model.nu if alone else 1):
            name = flight.label if not alone else quantity.name if model.nu == 1 else f"{quantity.name} {i + 1}"
            curve = plot.step(
                "t", f"u{i}", source=flight.samples, mode="after", line_width=1.6, legend_label=name,
                line_color=COLOURS[i % len(COLOURS)] if alone else flight.colour,
            )  # fmt: skip
            rows = [*told_of(flight, alone), (quantity.name, value(f"u{i}", quantity.unit))]
            hover(plot, [curve], rows)
        _saturation(plot, flight, quantity)
    drawn = _limits(plot, flights[0], quantity)
    note = "" if drawn else _travel_note(flights[0], quantity)
    return Panel("control", quantity.name.capitalize() if len(quantity.name) > 1 else "Control u", finish(plot), note)


def _travel(flight: Shown) -> float:
    """Return the travel of the first control in its shown unit; 0 without limits."""
    actuator = flight.file.flight.model.actuator
    if actuator is None or actuator.low is None or actuator.high is None:
        return 0.0
    return control(flight.file.flight.model).factor * float(actuator.high[0] - actuator.low[0])


def _limits(plot: Any, flight: Shown, quantity: Quantity) -> bool:
    """Draw the ends of the travel where a good part of it is in use; return whether so, or there are none."""
    actuator = flight.file.flight.model.actuator
    if actuator is None or actuator.low is None or actuator.high is None:
        return True
    used = float(np.nanmax(np.abs(_drawn(flight, "u0"))))
    low, high = (quantity.factor * float(limit[0]) for limit in (actuator.low, actuator.high))
    if used < _LEAST_TRAVEL_USED * (high - low) / 2:
        return False
    plot.hspan([low, high], line_color=GREY, line_dash="dashed", line_width=1.2, legend_label="travel")
    return True


def _travel_note(flight: Shown, quantity: Quantity) -> str:
    actuator = flight.file.flight.model.actuator
    assert actuator is not None
    assert actuator.low is not None
    assert actuator.high is not None
    low, high = (quantity.factor * float(limit[0]) for limit in (actuator.low, actuator.high))
    return f"Its travel, {low:.3g} to {high:.3g}{quantity.unit}, is far outside the figure."


def _saturation(plot: Any, flight: Shown, quantity: Quantity) -> None:
    """Mark where the control stood at an end of its travel: each time, however short."""
    data = flight.file.flight
    found = [(run, i) for i, flags in enumerate(saturated(data.model, data.u).T) for run in runs(flags)]
    if not found:
        return
    columns = {
        "x0": np.array([data.time_s[run.first] for run, _ in found]),
        "x1": np.array([data.time_s[run.last] + data.model.Ts for run, _ in found]),
        "y": np.array([quantity.factor * data.u[run.first, i] for run, i in found]),
        "samples": np.array([run.last - run.first + 1 for run, _ in found], dtype=np.int32),
    }
    marks = plot.segment(
        "x0", "y", "x1", "y", source=ColumnDataSource(columns, name=f"saturated-{flight.place}"), line_width=6,
        line_alpha=0.55, line_color=PURPLE, legend_label="saturated",
    )  # fmt: skip
    hover(plot, [marks], [("saturated", "@samples samples, from @x0{0.000} s")], along=False)


# -- air


def _air(time: Range1d, flights: Sequence[Shown]) -> list[Panel]:
    """Return one figure for each thing that the plant tells beside the states of the model."""
    names = list(dict.fromkeys(name for flight in flights for name in flight.file.air))
    return [_air_panel(time, [f for f in flights if name in f.file.air], name, len(flights) == 1) for name in names]


def _air_panel(time: Range1d, flights: Sequence[Shown], name: str, alone: bool) -> Panel:
    title, _, unit = _AIR.get(name, (name, 1.0, ""))
    quantity = Quantity(title, 1.0, unit)
    plot = new_plot(time, f"air-{name}", named(quantity), 150, None)
    shade(plot, flights)
    for flight in flights:
        legend = {} if alone else {"legend_label": flight.label}
        curve = plot.line("t", AIR + name, source=flight.samples, line_color=flight.colour, line_width=1.6, **legend)
        hover(plot, [curve], [*told_of(flight, alone), (title, f"@{AIR}{name}{{0.00}}{unit}")])
    return Panel(f"air-{name}", title.capitalize(), finish(plot))
