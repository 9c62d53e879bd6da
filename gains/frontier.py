"""``gains frontier``: the η that designs reach as the window of delays grows, as a table, a CSV file and a plot.

Every point is a design of its own, from the model alone, and verified.
"""

from __future__ import annotations

import csv
import re
import time
from pathlib import Path
from typing import Any, NamedTuple, cast

import click
import numpy as np
from rich.console import Console
from rich.table import Table

from gains.command import NEGATIVE, SUCCESS, FiniteRange, print_json
from gains.model import Gains, Model
from gains.proving import JSON_OPTION, PLOT_OPTION, TRANSITIONS_OPTION, writable
from gains.store import DELAY_LIMIT, load_model
from gains.table import InputError

__all__ = ["Entry", "frontier", "plotted", "written"]

_clock = time.perf_counter  # noqa: TID251  a command says how long it took


class Entry(NamedTuple):
    """One point of the frontier.

    Attributes
    ----------
    d_max : int
    eta : float or None
        Verified; None where no design was found.
    seconds : float
        Wall time of the design.
    gains : Gains or None
    """

    d_max: int
    eta: float | None
    seconds: float
    gains: Gains | None


@click.command()
@click.argument("name", metavar="MODEL")
@click.option("--d-max", "d_max", required=True, metavar="FROM:TO", help="Largest delays to design for, in samples.")
@click.option("--d-min", type=click.IntRange(0, DELAY_LIMIT), default=1, show_default=True)
@TRANSITIONS_OPTION
@click.option("--delta", type=FiniteRange(min=0.0), default=0.0, help="Bound on the uncertainty; default 0: none.")
@click.option("--steady-state", type=click.Choice(["exact", "free"]), default="exact", show_default=True)
@click.option("-o", "--output", type=click.Path(path_type=Path), callback=writable, help="Write a CSV file.")
@PLOT_OPTION
@JSON_OPTION
def frontier(
    name: str, d_max: str, d_min: int, output: Path | None, plot: Path | None, as_json: bool, **options: Any
) -> int:
    """Design gains for MODEL for growing windows of delays, and say which eta is proved for each.

    Exit status 1 when for some window no design was found.
    """
    model = load_model(name)
    first, last = _range(d_max, d_min)
    entries: list[Entry] = []
    for d in range(first, last + 1):
        click.echo(f"gains: designing for delays {d_min} to {d}", err=True)
        entries.append(_entry(model, d_min, d, options))
    if output is not None:
        written(output, model, entries)
    if plot is not None:
        plotted(plot, model, d_min, entries)
    if as_json:
        print_json(_answer(model, d_min, options, entries))
    else:
        Console(markup=False, highlight=False, emoji=False).print(_table(model, entries))
    return SUCCESS if all(entry.eta is not None for entry in entries) else NEGATIVE


def _range(text: str, d_min: int) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,6}):(\d{1,6})", text)
    if match is None:
        raise InputError(f"--d-max: expected FROM:TO in samples, such as 1:6, found {text!r}")
    first, last = int(match[1]), int(match[2])
    if not max(d_min, 1) <= first <= last <= DELAY_LIMIT:
        raise InputError(f"--d-max: expected {max(d_min, 1)} <= FROM <= TO <= {DELAY_LIMIT}, found {text}")
    return first, last


def _entry(model: Model, d_min: int, d_max: int, options: dict[str, Any]) -> Entry:
    """Return the design of one window."""
    from gains.design import SteadyState, design  # with the solver: --help does without
    from gains.switched import Transitions

    begun = _clock()
    try:
        found = design(
            model,
            d_min,
            d_max,
            delta_max=options["delta"],
            steady_state=cast(SteadyState, options["steady_state"]),
            transitions=cast(Transitions, options["transitions"]),
        )
    except ValueError as error:
        raise InputError(str(error)) from None
    return Entry(d_max, found.eta, _clock() - begun, found.gains)


def written(output: Path, model: Model, entries: list[Entry]) -> None:
    """Write the points as CSV, one column for each entry of K1 and K2.

    Raises
    ------
    InputError
        When the file cannot be written.
    """
    inputs = [""] if model.nu == 1 else [f"u{i + 1}_" for i in range(model.nu)]
    names = [f"K1_{u}{state}" for u in inputs for state in model.states]
    names += [f"K2_{u}xr{j + 1}" for u in inputs for j in range(model.nr)]
    try:
        with output.open("w", newline="", encoding="utf-8") as file:
            rows = csv.writer(file)
            rows.writerow(["d_max", "seconds_of_latency", "eta", "seconds", *names])
            for entry in entries:
                eta = "" if entry.eta is None else entry.eta
                latency = f"{entry.d_max * model.Ts:.9g}"
                rows.writerow([entry.d_max, latency, eta, f"{entry.seconds:.3f}", *_flat(entry, len(names))])
    except OSError as error:
        raise InputError(f"{output}: {error.strerror or error}") from None


def _flat(entry: Entry, count: int) -> list[float | str]:
    gains = entry.gains
    if gains is None:
        return [""] * count
    parts = [gains.K1.reshape(-1)] + ([] if gains.K2 is None else [gains.K2.reshape(-1)])
    return [float(value) for value in np.concatenate(parts)]


def plotted(path: Path, model: Model, d_min: int, entries: list[Entry]) -> None:
    """Write η over d_max, with the latency in milliseconds on a second axis.

    Raises
    ------
    InputError
        When the file cannot be written.
    """
    from matplotlib.figure import Figure  # slow to import, and seldom wanted

    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.add_subplot()
    reached = [(entry.d_max, entry.eta) for entry in entries if entry.eta is not None]
    axes.plot([d for d, _ in reached], [eta for _, eta in reached], "o-", color="#1f5fa8", clip_on=False)
    for d, eta in reached:
        axes.annotate(f"{eta:.3g}", (d, eta), (-6, 6), textcoords="offset points", ha="right", color="#333333")
    axes.set_xticks([entry.d_max for entry in entries])
    axes.set_xlim(entries[0].d_max - 0.5, entries[-1].d_max + 0.3)
    axes.set_ylim(0.0, 1.15 * max((eta for _, eta in reached), default=1.0))
    axes.set_xlabel(f"largest delay d_max, samples (d_min = {d_min})")
    axes.set_ylabel("η, verified bound on ‖e‖₂ / ‖v‖₂")
    axes.grid(True, color="#dddddd", linewidth=0.6)
    axes.spines[["right"]].set_visible(False)
    ms = model.Ts * 1e3
    above = axes.secondary_xaxis("top", functions=(lambda d: np.multiply(d, ms), lambda t: np.divide(t, ms)))
    above.set_xticks([entry.d_max * ms for entry in entries])
    above.set_xlabel("latency, ms")
    try:
        figure.savefig(path, dpi=150)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None


def _table(model: Model, entries: list[Entry]) -> Table:
    table = Table("d_max", "latency, ms", "eta", "seconds", title=f"{model.name}: designed for every window")
    for column in table.columns:
        column.justify = "right"
    for entry in entries:
        eta = "none found" if entry.eta is None else f"{entry.eta:.6g}"
        table.add_row(str(entry.d_max), f"{entry.d_max * model.Ts * 1e3:g}", eta, f"{entry.seconds:.1f}")
    return table


def _answer(model: Model, d_min: int, options: dict[str, Any], entries: list[Entry]) -> dict[str, object]:
    return {
        "model": model.name,
        "d_min": d_min,
        "transitions": options["transitions"],
        "steady_state": options["steady_state"],
        "delta_max": options["delta"],
        "frontier": [
            {
                "d_max": entry.d_max,
                "seconds_of_latency": entry.d_max * model.Ts,
                "eta": entry.eta,
                "seconds": entry.seconds,
                "K1": None if entry.gains is None else entry.gains.K1,
                "K2": None if entry.gains is None else entry.gains.K2,
            }
            for entry in entries
        ],
    }
