"""One figure of a flight: output, control, delay and link over time.

Drawn on figures of its own, not through pyplot: no global state, no display. Colours are those of Okabe
and Ito, which the colour-blind can tell apart.
"""

from __future__ import annotations

import os
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from gains.model import Matrix, Model
from sitl.flightdata import LINKS, FlightData

__all__ = ["DPI", "SIZE_INCH", "flight_figure", "plot_flight"]

SIZE_INCH = (10.0, 9.0)
DPI = 150

_BLACK, _ORANGE, _SKY, _GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
_BLUE, _VERMILLION, _PURPLE, _GREY = "#0072B2", "#D55E00", "#CC79A7", "#767676"
_MODE_COLOURS = {
    "STANDBY": _GREY, "LEVEL": _SKY, "CONSERVATIVE": _PURPLE, "HOLD": _ORANGE, "NEUTRAL": _VERMILLION
}  # fmt: skip
_OUTPUT_COLOURS = (_BLUE, _VERMILLION, _GREEN, _PURPLE)
_LINK_COLOURS = {"up": _BLUE, "down": _ORANGE}
_LINK_NAMES = {"up": "up, plant to autopilot", "down": "down, autopilot to plant"}
_SYMBOLS = {"theta": "θ", "alpha": "α", "q": "q", "pitch": "θ", "beta": "β", "phi": "φ", "roll": "φ"}
_TRACKING = "TRACKING"
_LEAST_DELAY_SHOWN = 6.0
_FORECAST_HOLD = 3
_LEAST_TRAVEL_USED = 0.4  # with less of it in use, lines at the limits would flatten the curve


class _Quantity(NamedTuple):
    """How a quantity is drawn: its name, its unit (maybe empty), and what to multiply it by."""

    name: str
    unit: str
    scale: float

    @property
    def label(self) -> str:
        return f"{self.name} [{self.unit}]" if self.unit else self.name


def plot_flight(path_png: str | os.PathLike[str], flight: FlightData) -> None:
    """Draw a flight to a PNG file of ``SIZE_INCH`` at ``DPI``."""
    figure = flight_figure(flight)
    FigureCanvasAgg(figure)
    figure.savefig(path_png, dpi=DPI, format="png", metadata={"Software": None})


def flight_figure(flight: FlightData) -> Figure:
    """Return the figure of a flight: four panels over one time axis.

    From the top: output and reference; control with its travel; true and forecast delay with the certified
    window; delay of each packet with the lost ones marked. Modes other than TRACKING are shaded.
    """
    figure = Figure(figsize=SIZE_INCH, layout="constrained")
    panels: list[Axes] = list(figure.subplots(4, 1, sharex=True, gridspec_kw={"height_ratios": [3.0, 2.0, 2.0, 2.0]}))
    _draw_output(panels[0], flight)
    _draw_control(panels[1], flight)
    _draw_delay(panels[2], flight)
    _draw_link(panels[3], flight)
    _shade_modes(panels, flight)
    end_s = float(flight.time_s[-1]) + flight.model.Ts
    for panel in panels:
        panel.set_xlim(min(0.0, float(flight.time_s[0])), end_s)
        panel.grid(True, color="#e4e4e4", linewidth=0.6)
        panel.set_axisbelow(True)
        panel.spines[["top", "right"]].set_visible(False)
        if panel.get_legend_handles_labels()[0]:
            _legend_above(panel)
    panels[-1].set_xlabel("time [s]")
    figure.align_ylabels(panels)
    figure.suptitle(_title(flight), fontsize=12)
    return figure


def _state_quantity(name: str) -> _Quantity:
    """Return how a state is drawn: angles and rates in degrees, others as they are."""
    for suffix, unit, scale in (
        ("_rad_s", "deg/s", float(np.rad2deg(1.0))),
        ("_rad", "deg", float(np.rad2deg(1.0))),
        ("_deg_s", "deg/s", 1.0),
        ("_deg", "deg", 1.0),
        ("_m_s", "m/s", 1.0),
    ):
        if name.endswith(suffix):
            stem = name.removesuffix(suffix)
            return _Quantity(_SYMBOLS.get(stem, stem), unit, scale)
    return _Quantity(name, "", 1.0)


def _output_quantities(model: Model) -> list[_Quantity]:
    """Return how each output is drawn: as the state it is, or as plain y."""
    quantities = []
    for i, row in enumerate(model.C):
        (states,) = np.nonzero(row)
        plain = len(states) == 1 and row[states[0]] == 1.0 and not model.D[i].any()
        name = "y" if model.ny == 1 else f"y{i + 1}"
        quantities.append(_state_quantity(model.states[states[0]]) if plain else _Quantity(name, "", 1.0))
    return quantities


def _control_quantity(model: Model) -> _Quantity:
    """Return how u is drawn: in degrees where its travel is that of an angle in rad, else as it is."""
    actuator = model.actuator
    if actuator is None or actuator.low is None or actuator.high is None:
        return _Quantity("u", "", 1.0)
    travel = max(float(np.max(np.abs(actuator.low))), float(np.max(np.abs(actuator.high))))
    if travel < np.pi / 2 and any(state.endswith("_rad") for state in model.states):
        return _Quantity("elevator", "deg", float(np.rad2deg(1.0)))
    return _Quantity("u", "", 1.0)


def _curve(flight: FlightData, values: Matrix) -> tuple[Matrix, Matrix]:
    """Return times and values of the samples, with a nan where samples are missing: a dead plant draws no line."""
    Ts = flight.model.Ts
    (last,) = np.nonzero(np.diff(flight.time_s) > 1.5 * Ts)
    return np.insert(flight.time_s, last + 1, flight.time_s[last] + Ts), np.insert(values, last + 1, np.nan)


def _draw_output(panel: Axes, flight: FlightData) -> None:
    quantities = _output_quantities(flight.model)
    for i, quantity in enumerate(quantities):
        colour = _OUTPUT_COLOURS[i % len(_OUTPUT_COLOURS)]
        if flight.model.reference is not None:
            target = quantity.scale * flight.reference[:, i]
            name = f"reference {quantity.name}r"
            panel.plot(*_curve(flight, target), color=_BLACK, linewidth=1.1, linestyle="--", label=name)
        panel.plot(
            *_curve(flight, quantity.scale * flight.output[:, i]),
            color=colour,
            linewidth=1.5,
            label=quantity.name,
        )
    panel.set_ylabel(", ".join(dict.fromkeys(quantity.label for quantity in quantities)))


def _draw_control(panel: Axes, flight: FlightData) -> None:
    quantity = _control_quantity(flight.model)
    actuator = flight.model.actuator
    for i in range(flight.model.nu):
        u = quantity.scale * flight.u[:, i]
        name = quantity.name if flight.model.nu == 1 else f"{quantity.name} {i + 1}"
        colour = _OUTPUT_COLOURS[i % len(_OUTPUT_COLOURS)]
        panel.step(*_curve(flight, u), where="post", color=colour, linewidth=1.2, label=name)
        if actuator is None or actuator.low is None or actuator.high is None:
            continue
        low, high = quantity.scale * float(actuator.low[i]), quantity.scale * float(actuator.high[i])
        if np.nanmax(np.abs(u)) < _LEAST_TRAVEL_USED * (high - low) / 2:
            continue
        for limit in (low, high):
            panel.axhline(limit, color=_GREY, linewidth=0.9, linestyle="--")
        panel.plot([], [], color=_GREY, linewidth=0.9, linestyle="--", label="travel limits")
        slack = 1e-9 * (high - low)
        at_limit = (u <= low + slack) | (u >= high - slack)
        if at_limit.any():
            panel.plot(flight.time_s[at_limit], u[at_limit], ".", color=_VERMILLION, markersize=4, label="saturated")
    panel.set_ylabel(quantity.label)


def _draw_delay(panel: Axes, flight: FlightData) -> None:
    grid_s, low, high = _forecast_band(flight)
    window = [float(flight.metadata[name]) for name in ("d_min", "d_max") if name in flight.metadata]
    largest = float(np.nanmax([0.0, *flight.d, *high]))
    usual = max([_LEAST_DELAY_SHOWN, *(bound + 2.0 for bound in window)])
    top = max(usual, min(largest, 1.5 * usual))
    if np.isfinite(low).any():
        panel.fill_between(
            grid_s, low - 0.2, high + 0.2, step="post", color=_SKY, alpha=0.45, linewidth=0,
            label="forecast interval",
        )  # fmt: skip
    known = np.isfinite(flight.forecast)
    if known.any():
        applied_s = (flight.command_s + flight.model.Ts * (flight.forecast + 0.5))[known]
        panel.plot(applied_s, flight.forecast[known], ".", color=_VERMILLION, markersize=4.5, label="forecast d")
    panel.step(*_curve(flight, flight.d), where="post", color=_BLACK, linewidth=0.9, label="true d(k)")
    for n, bound in enumerate(window):
        label = "d_min, d_max" if n == 0 else None
        panel.axhline(bound, color=_GREEN, linewidth=1.1, linestyle="--", label=label)
    beyond = flight.d > top
    if beyond.any():
        height = np.full(int(beyond.sum()), top + 0.3)
        label = f"beyond, to {int(np.nanmax(flight.d))}"
        panel.plot(flight.time_s[beyond], height, "^", color=_BLACK, markersize=3, label=label)
    panel.set_ylim(-0.4, top + 0.6)
    panel.yaxis.set_major_locator(MaxNLocator(integer=True, nbins=7))
    panel.set_ylabel("delay [samples]")


def _forecast_band(flight: FlightData) -> tuple[Matrix, Matrix, Matrix]:
    """Return times and bounds of the forecast where it was to apply, at k = j + d, on the grid of samples.

    A forecast stands until the next, for at most ``_FORECAST_HOLD`` samples: a silence is a gap.
    """
    known = np.isfinite(flight.forecast) & np.isfinite(flight.forecast_low) & np.isfinite(flight.forecast_high)
    if not known.any():
        return np.zeros(0), np.zeros(0), np.zeros(0)
    applied = np.rint(flight.command_s[known] / flight.model.Ts + flight.forecast[known]).astype(np.int64)
    bounds = np.column_stack([flight.forecast_low[known], flight.forecast_high[known]])
    first = int(applied.min())
    band = np.full((int(applied.max()) - first + 1 + _FORECAST_HOLD, 2), np.nan)
    for hold in reversed(range(_FORECAST_HOLD)):
        band[applied - first + hold] = bounds
    grid_s = np.arange(first, first + len(band), dtype=np.float64) * flight.model.Ts
    return grid_s, np.asarray(band[:, 0], dtype=np.float64), np.asarray(band[:, 1], dtype=np.float64)


def _draw_link(panel: Axes, flight: FlightData) -> None:
    longest_ms = max(1.0, *(_longest_ms(flight.links[way].delay_s) for way in LINKS))
    panel.set_ylim(0.0, 1.3 * longest_ms)
    for row, way in enumerate(LINKS):
        entered_s, delay_s = flight.links[way]
        lost = np.isnan(delay_s)
        colour = _LINK_COLOURS[way]
        if (~lost).any():
            panel.plot(
                entered_s[~lost], 1e3 * delay_s[~lost], ".", color=colour, markersize=3.5, alpha=0.7,
                markeredgewidth=0, label=_LINK_NAMES[way],
            )  # fmt: skip
        if lost.any():
            height = np.full(int(lost.sum()), 0.97 - 0.08 * row)
            panel.plot(
                entered_s[lost], height, "|", color=colour, markersize=6, markeredgewidth=0.9,
                transform=panel.get_xaxis_transform(), label=f"{way}, lost ({int(lost.sum())})",
            )  # fmt: skip
    panel.set_ylabel("one-way delay [ms]")


def _longest_ms(delay_s: Matrix) -> float:
    """Return the longest delay, ms; 0 where nothing arrived."""
    arrived = delay_s[np.isfinite(delay_s)]
    return 1e3 * float(arrived.max()) if len(arrived) else 0.0


def _shade_modes(panels: list[Axes], flight: FlightData) -> None:
    """Shade every mode but TRACKING across all panels; the legend of the first names them."""
    named = set()
    for start_s, end_s, mode in flight.modes:
        if mode == _TRACKING or end_s <= start_s:
            continue
        colour = _MODE_COLOURS.get(mode, _BLACK)
        for n, panel in enumerate(panels):
            label = mode if n == 0 and mode not in named else None
            panel.axvspan(start_s, end_s, color=colour, alpha=0.22, linewidth=0, zorder=0, label=label)
        named.add(mode)


def _legend_above(panel: Axes) -> None:
    """Put the legend over the panel, where it covers nothing."""
    panel.legend(
        loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=7, frameon=False, fontsize=8.5, markerscale=1.8,
        borderaxespad=0.1, handlelength=1.6, columnspacing=1.3,
    )  # fmt: skip


def _title(flight: FlightData) -> str:
    parts = [flight.metadata.get("scenario", flight.model.name)]
    parts += [f"{name} {flight.metadata[name]}" for name in ("gains", "seed") if name in flight.metadata]
    errors = []
    for quantity, rms in zip(_output_quantities(flight.model), flight.rms_error, strict=True):
        errors.append(f"{quantity.scale * rms:.3g} {quantity.unit}".strip())
    return " · ".join([*parts, f"rms error {', '.join(errors)}"])
