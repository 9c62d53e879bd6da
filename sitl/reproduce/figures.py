"""Figures 2 to 7 again, from the flights: colours of Okabe and Ito, and a line style each, to be read in grey too.

Drawn on figures of their own, not through pyplot: no global state, no display.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from gains.model import Matrix
from sitl.aircraft.disturbance import SquareDelta
from sitl.reproduce.cases import D_MAX, D_MIN, STEP_DEG
from sitl.reproduce.hirm import Case, Hirm
from sitl.reproduce.pendulum import Constant, Pendulum

__all__ = ["DPI", "NAMES", "draw", "save"]

NAMES = ("figure2", "figure3", "figure4", "figure5", "figure6", "figure7")
DPI = 130

_BLACK, _ORANGE, _SKY, _GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
_BLUE, _VERMILLION, _PURPLE, _GREY = "#0072B2", "#D55E00", "#CC79A7", "#9a9a9a"
_SHOWN_S = 4.0  # of Figures 5 and 6: the step settles within
_DELAYS_S = 3.0  # of d(k) in Figure 4: a few periods


class _Line(NamedTuple):
    colour: str
    style: str | tuple[int, tuple[float, ...]]


_LINES = (
    _Line(_VERMILLION, "-"),
    _Line(_BLUE, (0, (6.0, 2.0))),
    _Line(_GREEN, (0, (5.0, 1.5, 1.0, 1.5))),
    _Line(_PURPLE, (0, (1.2, 1.6))),
    _Line(_ORANGE, (0, (8.0, 1.5, 1.0, 1.5, 1.0, 1.5))),
    _Line(_SKY, (0, (3.0, 1.2))),
)


def draw(pendulum: Pendulum, hirm: Hirm) -> dict[str, Figure]:
    """Return the six figures by name."""
    constants = {c.d: c for c in pendulum.constants}
    return {
        "figure2": _single(constants[4]),
        "figure3": _single(constants[6]),
        "figure4": _beyond(pendulum, constants),
        "figure5": _delays(hirm),
        "figure6": _step(hirm),
        "figure7": _disturbed(hirm),
    }


def save(figure: Figure, path_png: Path) -> None:
    """Write a figure as a PNG file; equal figures are equal bytes."""
    FigureCanvasAgg(figure)
    figure.savefig(path_png, dpi=DPI, format="png", metadata={"Software": None})


def _panels(rows: int, columns: int, size: tuple[float, float], heights: Sequence[float]) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, gridspec_kw={"height_ratios": heights})
    return figure, list(grid.T.ravel())


def _finish(panels: Iterable[Axes]) -> None:
    for panel in panels:
        panel.grid(True, color="#e4e4e4", linewidth=0.6)
        panel.set_axisbelow(True)
        panel.spines[["top", "right"]].set_visible(False)


def _share_time(panels: Sequence[Axes], end_s: float) -> None:
    """Give panels above each other one axis of time, labelled at the last."""
    for panel in panels:
        panel.set_xlim(0.0, end_s)
        panel.tick_params(labelbottom=panel is panels[-1])


def _legend(panel: Axes, columns: int) -> None:
    """Put the legend over the panel, where it covers nothing."""
    panel.legend(
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        ncols=columns,
        frameon=False,
        fontsize=8.5,
        borderaxespad=0.1,
        handlelength=3.2,
    )


def _states(panels: Sequence[Axes], time_s: Matrix, x: Matrix, growth: float, label: str) -> None:
    """Draw angle and rate, and the growth per sample as an envelope through the largest later swing."""
    for panel, i, name in ((panels[0], 0, "angle x₁ [deg]"), (panels[1], 1, "rate x₂ [deg/s]")):
        values = np.rad2deg(x[:, i])
        panel.plot(time_s, values, color=_BLUE if i == 0 else _VERMILLION, linewidth=1.5, label=label)
        k = np.arange(len(values))
        half = len(values) // 2
        scale = float(np.max(np.abs(values[half:]) / growth ** k[half:]))
        envelope = scale * growth**k
        shown = 1.15 * float(np.max(np.abs(values)))
        for sign in (1.0, -1.0):
            panel.plot(
                time_s,
                np.where(envelope <= shown, sign * envelope, np.nan),
                color=_GREY,
                linewidth=1.1,
                linestyle=":",
                label=f"growth {growth:.4f} per sample" if sign > 0 else None,
            )
        panel.axhline(0.0, color=_BLACK, linewidth=0.6)
        panel.set_ylim(-shown, shown)
        panel.set_ylabel(name)
    _legend(panels[0], 1)
    _share_time(panels, float(time_s[-1]))
    panels[-1].set_xlabel("time [s]")


def _single(constant: Constant) -> Figure:
    figure, panels = _panels(2, 1, (7.0, 4.6), (1.0, 1.0))
    flight = constant.flown.flight
    _states(panels, flight.time_s, flight.x, constant.radius, f"flown, d = {constant.d}")
    _finish(panels)
    figure.align_ylabels(panels)
    figure.suptitle(f"Pendulum, gains (47), constant delay d = {constant.d} samples", fontsize=11)
    return figure


def _beyond(pendulum: Pendulum, constants: dict[int, Constant]) -> Figure:
    figure, panels = _panels(3, 3, (13.0, 6.4), (1.0, 1.0, 0.6))
    refuted = pendulum.bounds.exact.refuted
    assert refuted is not None
    assert refuted.growth is not None
    columns = [(f"flown, d = {d}", constants[d].flown.flight, constants[d].radius) for d in (7, 8)]
    columns.append((f"flown, d(k) ≤ {refuted.d_max}", pendulum.witness.flight, refuted.growth))
    for n, (label, flight, growth) in enumerate(columns):
        column = panels[3 * n : 3 * n + 3]
        _states(column[:2], flight.time_s, flight.x, growth, label)
        early = flight.time_s <= _DELAYS_S
        column[2].step(flight.time_s[early], flight.d[early], where="post", color=_BLACK, linewidth=0.8)
        column[2].set_ylim(0.0, 9.0)
        column[2].yaxis.set_major_locator(MaxNLocator(integer=True, nbins=5))
        column[2].set_ylabel("d(k) [samples]")
        column[2].set_xlim(0.0, _DELAYS_S)
        column[2].set_xlabel(f"time [s], first {_DELAYS_S:g} s")
    _finish(panels)
    figure.align_ylabels(panels)
    figure.suptitle(
        "Pendulum, gains (47): constant delays beyond the paper's 6, and a sequence in 1..7 that diverges", fontsize=11
    )
    return figure


def _delays(hirm: Hirm) -> Figure:
    figure = Figure(figsize=(9.0, 2.8), layout="constrained")
    left, right = figure.subplots(1, 2, gridspec_kw={"width_ratios": [4.0, 1.0]})
    flight = hirm.present[0].flown["nominal"].flight
    until = flight.time_s <= _SHOWN_S
    left.step(flight.time_s[until], flight.d[until], where="post", color=_BLACK, linewidth=0.9)
    left.set_xlim(0.0, _SHOWN_S)
    left.set_ylim(0.0, D_MAX + 1.0)
    left.set_xlabel(f"time [s] (first {_SHOWN_S:g} s of {flight.time_s[-1] + flight.model.Ts:g} s)")
    left.set_ylabel("d(k) [samples]")
    values = np.arange(D_MIN, D_MAX + 1)
    right.bar(values, [float(np.mean(np.array(hirm.delays) == d)) for d in values], color=_GREY, width=0.7)
    right.set_xticks(values)
    right.set_xlabel("d [samples]")
    right.set_ylabel("share")
    left.yaxis.set_major_locator(MaxNLocator(integer=True))
    _finish((left, right))
    figure.suptitle(f"The delay that every controller lived: uniform on {D_MIN}..{D_MAX}", fontsize=11)
    return figure


def _curves(panels: Sequence[Axes], hirm: Hirm, case: Case) -> None:
    """Draw output, error and elevator of every controller that was flown."""
    output, error, elevator = panels
    first = hirm.present[0].flown[case].flight
    output.plot(
        first.time_s, np.rad2deg(first.reference[:, 0]), color=_GREY, linewidth=3.2, alpha=0.7, label="reference θr"
    )
    for line, row in zip(_LINES, hirm.rows, strict=False):
        if row.missing:
            continue
        flown = row.flown[case]
        how: dict[str, Any] = {"color": line.colour, "linestyle": line.style, "linewidth": 1.4}
        output.plot(flown.flight.time_s, np.rad2deg(flown.flight.output[:, 0]), label=row.controller.label, **how)
        error.plot(flown.flight.time_s, flown.error_deg, **how)
        elevator.step(flown.flight.time_s, flown.u_deg, where="post", **how)
    output.set_ylabel("pitch θ [deg]")
    error.set_ylabel("error θ − θr [deg]")
    elevator.set_ylabel("elevator [deg]")
    _legend(output, 4)


def _gust_alone(panel: Axes, hirm: Hirm) -> None:
    """Draw the error in the gust without step and uncertainty: what the certified η is to bound."""
    for line, row in zip(_LINES, hirm.rows, strict=False):
        if not row.missing:
            flown = row.flown["gust"]
            panel.plot(flown.flight.time_s, flown.error_deg, color=line.colour, linestyle=line.style, linewidth=1.4)
    panel.set_ylabel("gust alone:\nerror [deg]")


def _step(hirm: Hirm) -> Figure:
    figure, panels = _panels(3, 1, (9.0, 7.6), (1.2, 1.0, 1.0))
    _curves(panels, hirm, "nominal")
    _share_time(panels, _SHOWN_S)
    panels[-1].set_xlabel("time [s]")
    _finish(panels)
    figure.align_ylabels(panels)
    figure.suptitle(f"HIRM, nominal: {STEP_DEG:g}° step, d(k) of Figure 5", fontsize=11)
    return figure


def _disturbed(hirm: Hirm) -> Figure:
    figure, panels = _panels(5, 1, (9.0, 11.0), (1.2, 1.2, 1.0, 1.0, 0.7))
    _curves(panels[:3], hirm, "uncertain")
    _gust_alone(panels[3], hirm)
    flight = hirm.present[0].flown["uncertain"].flight
    last = panels[-1]
    last.plot(flight.time_s, np.rad2deg(flight.w[:, 0]), color=_BLACK, linewidth=1.2, label="gust w (52), left")
    last.set_ylabel("w [deg/s]")
    right = last.twinx()
    delta = [SquareDelta().delta(int(k)) for k in flight.k]
    right.step(
        flight.time_s, delta, where="post", color=_ORANGE, linewidth=1.1, linestyle="--", label="Δ(k) (51), right"
    )
    right.set_ylabel("Δ")
    right.set_ylim(-0.3, 0.3)
    right.spines[["top"]].set_visible(False)
    handles = [*last.get_legend_handles_labels()[0], *right.get_legend_handles_labels()[0]]
    last.legend(handles=handles, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, frameon=False, fontsize=8.5)
    _share_time(panels, float(flight.time_s[-1]))
    last.set_xlabel("time [s]")
    _finish(panels)
    figure.align_ylabels(panels)
    figure.suptitle(f"HIRM with Δ(k) of (51) and the gust (52): {STEP_DEG:g}° step, d(k) of Figure 5", fontsize=11)
    return figure
