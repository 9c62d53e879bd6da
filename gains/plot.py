"""Two figures: stability and gain against the delay, and the response of the loop under a witness.

Drawn on figures of their own, not through pyplot: no global state, no display. Colours are those of Okabe and Ito,
which the colour-blind can tell apart; what is proved and what is refuted differ in shape and filling too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from gains.model import Model
from gains.plotdata import Margins, Response, Window
from gains.table import InputError

__all__ = ["FORMATS", "margins_figure", "plot_margins", "plot_response", "require_format", "response_figure"]

_SIZE_INCH = (9.0, 7.5)
_DPI = 150
FORMATS = ("png", "svg", "pdf")

_BLACK, _ORANGE, _SKY, _GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
_BLUE, _VERMILLION, _PURPLE, _GREY = "#0072B2", "#D55E00", "#CC79A7", "#767676"
_OUTPUT_COLOURS = (_VERMILLION, _PURPLE, _ORANGE, _BLACK)
_HELD_STYLES = (("-", _SKY), ("--", _BLUE))
_BAR = 0.16  # samples: width of the bar between two bounds
_MOST_TICKS = 14
_WIDE_RANGE = 8.0  # largest to smallest: beyond it a gain is drawn on a logarithmic axis
_TALL = 100.0  # beyond this growth a response is drawn on a logarithmic axis
_MARKS: dict[str, dict[str, Any]] = {
    "stable": {"marker": "o", "color": _BLUE, "markersize": 7},
    "unstable": {"marker": "D", "color": _VERMILLION, "markersize": 8, "fillstyle": "none", "markeredgewidth": 1.6},
    "undecided": {"marker": "s", "color": _GREY, "markersize": 7, "fillstyle": "none", "markeredgewidth": 1.6},
}
_MEANING = {"stable": "proved stable", "unstable": "refuted by a sequence", "undecided": "undecided"}
_METADATA: dict[str, dict[str, Any]] = {"png": {"Software": None}, "svg": {"Date": None}, "pdf": {"CreationDate": None}}


def require_format(path: Path) -> None:
    """Refuse a file whose suffix is none of ``FORMATS``.

    Raises
    ------
    InputError
    """
    if path.suffix[1:].lower() not in FORMATS:
        raise InputError(f"{path}: expected a file that ends with {', '.join('.' + each for each in FORMATS)}")


def plot_margins(path: Path, margins: Margins) -> None:
    """Draw :func:`margins_figure` to a file in the format of its suffix; raises InputError where it cannot."""
    _save(path, margins_figure(margins))


def plot_response(path: Path, response: Response) -> None:
    """Draw :func:`response_figure` to a file in the format of its suffix; raises InputError where it cannot."""
    _save(path, response_figure(response))


# -- margins


def margins_figure(margins: Margins) -> Figure:
    """Return the figure of stability and, where the model has v and e, of the gain against the delay.

    A window stands over its largest delay; constant delays stand over their own.
    """
    with_gain = any(np.isfinite(constant.norm) for constant in margins.constants)
    figure = Figure(figsize=_SIZE_INCH if with_gain else (_SIZE_INCH[0], 0.62 * _SIZE_INCH[1]), layout="constrained")
    panels = figure.subplots(2 if with_gain else 1, 1, sharex=True, squeeze=False)[:, 0]
    _draw_stability(panels[0], margins)
    if with_gain:
        _draw_gain(panels[1], margins)
    last = max(one.d_max for one in margins.windows) if margins.windows else margins.constants[-1].d
    delays = range(margins.d_min, last + 1)
    ticks = delays[:: math.ceil(len(delays) / _MOST_TICKS)]
    panels[-1].set_xticks(ticks)
    for panel in panels:
        panel.set_xlim(margins.d_min - 0.5, last + 0.5)
        _finish(panel, columns=3)
    panels[-1].set_xlabel(f"constant delay d, or the largest of a window {margins.d_min} … d  [samples]")
    _second_axis(panels[-1], 1e3 * margins.law.model.Ts, "latency  [ms]", ticks)
    figure.align_ylabels(list(panels))
    figure.suptitle(_margins_title(margins), fontsize=12)
    return figure


def _draw_stability(panel: Axes, margins: Margins) -> None:
    windows = margins.windows
    d = np.array([window.d_max for window in windows], dtype=np.float64)
    lower, upper = (np.array([getattr(window, name) for window in windows]) for name in ("lower", "upper"))
    for verdict, style in _MARKS.items():
        chosen = np.array([window.verdict == verdict for window in windows], dtype=bool)
        if chosen.any():
            at = upper if verdict == "stable" else lower  # what is below 1, what is above
            label = f"{_window(margins)}: {_MEANING[verdict]}"
            panel.plot(d[chosen], at[chosen], linestyle="none", label=label, zorder=3, **style)
    panel.bar(
        d, upper - lower, _BAR, lower, color=_SKY, alpha=0.5, edgecolor=_BLUE, linewidth=0.8,
        label=f"{_window(margins)}: joint spectral radius, bounds",
    )  # fmt: skip
    panel.plot(
        [constant.d for constant in margins.constants], [constant.radius for constant in margins.constants],
        color=_BLACK, linewidth=1.0, marker=".", markersize=6, label="constant d: exact", zorder=4,
    )  # fmt: skip
    panel.axhline(1.0, color=_BLACK, linewidth=1.1, linestyle="--", label="edge of stability")
    panel.use_sticky_edges = False
    _shade_refuted(panel, windows)
    panel.set_ylabel("spectral radius  [per sample]")


def _draw_gain(panel: Axes, margins: Margins) -> None:
    d = np.array([window.d_max for window in margins.windows], dtype=np.float64)
    proved, reached = (np.array([getattr(one, name) for one in margins.windows]) for name in ("eta", "eta_lower"))
    norms = np.array([constant.norm for constant in margins.constants])
    for values in (reached, norms):
        values[~np.isfinite(values)] = np.nan
    style: dict[str, Any] = {"color": _BLUE, "linewidth": 1.0, "markersize": 7}
    panel.plot(d, proved, marker="o", label=f"{_window(margins)}: η proved", **style)
    panel.plot(d, reached, marker="^", fillstyle="none", label=f"{_window(margins)}: reached by a sequence", **style)
    panel.fill_between(d, reached, proved, color=_SKY, alpha=0.4, linewidth=0)
    panel.plot(
        [constant.d for constant in margins.constants], norms, color=_BLACK, linewidth=1.0, marker=".",
        markersize=6, label="constant d: H∞ norm", zorder=4,
    )  # fmt: skip
    _shade_refuted(panel, margins.windows, label=f"{_window(margins)}: refuted, no finite gain")
    shown = np.concatenate([proved, reached, norms])
    if np.nanmax(shown) > _WIDE_RANGE * np.nanmin(shown):
        panel.set_yscale("log")
        panel.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        panel.yaxis.set_major_formatter("{x:g}")
        panel.yaxis.set_minor_formatter(NullFormatter())
    panel.set_ylabel("gain from v to e  [model's units]")


def _window(margins: Margins) -> str:
    return f"window {margins.d_min} … d"


def _shade_refuted(panel: Axes, windows: Sequence[Window], label: str | None = None) -> None:
    """Shade the delays whose windows hold a breaking sequence."""
    refuted = [window.d_max for window in windows if window.verdict == "unstable"]
    if refuted:
        left, right = refuted[0] - 0.5, refuted[-1] + 0.5
        panel.axvspan(left, right, color=_VERMILLION, alpha=0.1, linewidth=0, zorder=0, label=label)


def _margins_title(margins: Margins) -> str:
    law, found = margins.law, margins.found
    name = f"{law.name} on {law.model.name} · Ts {1e3 * law.model.Ts:g} ms · transitions: {margins.transitions}"
    if found.d_max == "unbounded":
        return f"{name}\nproved for every bounded delay"
    if found.d_max is None:
        said = f"no window from {margins.d_min} proved"
    else:
        said = f"proved from {margins.d_min} to {found.d_max} ({1e3 * law.model.Ts * found.d_max:g} ms)"
    if found.undecided:
        said += f", {', '.join(str(one.d_max) for one in found.undecided)} undecided"
    if found.refuted is not None and found.refuted.growth is not None:
        said += f", {found.refuted.d_max} breaks: a sequence grows {found.refuted.growth:.4f} per sample"
    return f"{name}\n{said}"


# -- response


def response_figure(response: Response) -> Figure:
    """Return the figure of the loop under a witness: outputs with their envelope, and the delays below."""
    figure = Figure(figsize=_SIZE_INCH, layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [3.0, 1.3]})
    _draw_response(above, response)
    k = np.arange(len(response.d))
    below.step(k, response.d, where="post", color=_BLACK, linewidth=1.0)
    below.set_ylim(min(response.d_min, int(response.d.min())) - 0.5, response.d_max + 0.5)
    below.xaxis.set_major_locator(MaxNLocator(integer=True))
    below.yaxis.set_major_locator(MaxNLocator(integer=True, nbins=8))
    below.set_ylabel("d(k)  [samples]")
    below.set_xlabel("k  [samples]")
    above.set_xlim(0, len(response.d))
    for panel in (above, below):
        _finish(panel, columns=4)
    _second_axis(below, response.gains.model.Ts, "time  [s]")
    figure.align_ylabels([above, below])
    figure.suptitle(_response_title(response), fontsize=12)
    return figure


def _draw_response(panel: Axes, response: Response) -> None:
    k = np.arange(len(response.d))
    names = _output_names(response.gains.model)
    for i, (name, y) in enumerate(zip(names, response.y.T, strict=True)):
        colour = _OUTPUT_COLOURS[i % len(_OUTPUT_COLOURS)]
        panel.plot(k, y, color=colour, linewidth=1.5, label=f"{name} under the witness", zorder=3)
    for sign in (1.0, -1.0):
        label = f"predicted growth, ±{response.growth:.4f}ᵏ" if sign > 0.0 else None
        panel.plot(k, sign * response.envelope, color=_GREY, linewidth=1.2, linestyle=":", label=label)
    for held, (line, colour) in zip(response.held, _HELD_STYLES, strict=False):
        for i, y in enumerate(held.y.T):
            label = f"constant d = {held.d} (ρ {held.radius:.4f})" if i == 0 else None
            panel.plot(k, y, color=colour, linestyle=line, linewidth=1.2, label=label)
    if response.envelope[-1] > _TALL * response.envelope[0]:
        panel.set_yscale("symlog", linthresh=1.0)
    panel.set_ylabel(f"{', '.join(names)}  [1 = peak in the first period]")


def _output_names(model: Model) -> list[str]:
    """Return the state that each output is, without its unit, or plain y."""
    names = []
    for i, row in enumerate(model.C):
        (states,) = np.nonzero(row)
        plain = len(states) == 1 and not model.D[i].any()
        state = model.states[states[0]] if plain else ""
        stem = next((state.removesuffix(end) for end in ("_rad_s", "_rad", "_m_s", "_m") if state.endswith(end)), state)
        names.append(stem or ("y" if model.ny == 1 else f"y{i + 1}"))
    return names


def _response_title(response: Response) -> str:
    gains = response.gains
    name = f"{gains.name} on {gains.model.name} · Ts {1e3 * gains.model.Ts:g} ms · transitions: {response.transitions}"
    window = f"witness for delays {response.d_min} to {response.d_max}"
    return f"{name}\n{window}: period {response.period}, grows {response.growth:.6f} per sample"


# -- both


def _second_axis(panel: Axes, unit: float, label: str, ticks: Sequence[int] = ()) -> None:
    """Add an axis under the panel's own that shows its samples in another unit, at the ticks if there are any."""
    axis = panel.secondary_xaxis(
        "bottom", functions=(lambda samples: np.multiply(samples, unit), lambda value: np.divide(value, unit))
    )
    axis.spines["bottom"].set_position(("outward", 38.0))
    axis.set_xlabel(label)
    if ticks:
        axis.set_xticks([unit * tick for tick in ticks])


def _finish(panel: Axes, columns: int) -> None:
    """Give a panel its grid and, above it where it covers nothing, its legend."""
    panel.grid(True, color="#e4e4e4", linewidth=0.6)
    panel.set_axisbelow(True)
    panel.spines[["top", "right"]].set_visible(False)
    if panel.get_legend_handles_labels()[0]:
        panel.legend(
            loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=columns, frameon=False, fontsize=8.5,
            borderaxespad=0.1, handlelength=1.8, columnspacing=1.3,
        )  # fmt: skip


def _save(path: Path, figure: Figure) -> None:
    """Write a figure; the same one gives the same bytes."""
    kind = path.suffix[1:].lower()
    FigureCanvasAgg(figure)
    try:
        with matplotlib.rc_context({"svg.hashsalt": path.stem}):
            figure.savefig(path, dpi=_DPI, format=kind, metadata=_METADATA[kind])
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None
