"""``sitl adversary``: the worst delays, inputs and uncertainty inside the certified sets, beside η."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import click

from gains.command import NEGATIVE, SUCCESS, FiniteRange, print_json, require_writable
from gains.proving import parse_window
from gains.table import InputError
from sitl.commands.options import FILE, SEED

__all__ = ["adversary"]


@click.command()
@click.option("--gains", "gains_name", required=True, help="What flies.")
@click.option("--delay", "window", metavar="MIN:MAX", help="Window of delays in samples; default: the gain file's.")
@click.option("--transitions", type=click.Choice(["any", "fifo"]), default="any", show_default=True)
@click.option("--delta", type=FiniteRange(0.0), default=0.0, show_default=True, help="Bound on the uncertainty.")
@click.option("--samples", type=click.IntRange(2, 20_000), default=1200, show_default=True,
              help="The horizon: the longer, the nearer to the gain over all time.")  # fmt: skip
@click.option("--starts", type=click.IntRange(1, 100), default=3, show_default=True,
              help="Sequences to begin with: the worst periodic one, the longest delay, random ones.")  # fmt: skip
@click.option("--memory", type=click.IntRange(0, 2), default=0, show_default=True,
              help="Past delays that the storages of η know: a smaller η, for more time.")  # fmt: skip
@click.option("--seed", type=SEED, default=1, show_default=True)
@click.option("-o", "--output", type=FILE, help="Write d, w, r and Δ of every sample as CSV.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object on standard output.")
def adversary(
    gains_name: str,
    window: str | None,
    transitions: Literal["any", "fifo"],
    delta: float,
    samples: int,
    starts: int,
    memory: int,
    seed: int,
    output: Path | None,
    as_json: bool,
) -> int:
    """Search for the flight of largest ‖e‖/‖v‖ inside the certified sets, from rest.

    \b
    sitl adversary --gains hirm-paper --delay 1:3
    sitl adversary --gains hirm-d6 --delta 0.05 -o worst.csv

    The exit code is 1 when the gain exceeds η, which no proof allows.
    """
    if output is not None:
        require_writable(output)
    from gains.store import load_law, require_law
    from sitl.campaign.adversary import search, worst_csv
    from sitl.campaign.bounds import certified_bound

    law = require_law(load_law(gains_name))
    d_min, d_max = (law.d_min, law.d_max) if window is None else parse_window(window)
    if delta > 0.0 and law.model.uncertainty is None:
        raise InputError(f"--delta: expected a model with [uncertainty], found {law.model.name} without")
    bound = certified_bound(law, d_min, d_max, transitions, delta, memory)
    worst = search(
        law, d_min, d_max, transitions=transitions, delta_max=delta, samples=samples, starts=starts, seed=seed
    )
    told = {
        "gains": gains_name,
        "d_min": d_min,
        "d_max": d_max,
        "transitions": transitions,
        "delta_max": delta,
        "samples": samples,
        "gain": worst.gain,
        "eta": bound.eta,
        "eta_source": bound.source,
        "memory": memory,
        "ratio": None if bound.eta is None else worst.gain / bound.eta,
        "sweeps": worst.sweeps,
        "seed": seed,
    }
    if output is not None:
        worst_csv(output, worst, told)
    if as_json:
        print_json({**told, "delays": worst.delays, "file": None if output is None else str(output)})
    else:
        _show(told)
    return NEGATIVE if bound.eta is not None and worst.gain > bound.eta else SUCCESS


def _show(told: dict[str, object]) -> None:
    """Print a table."""
    from rich.console import Console
    from rich.table import Table

    table = Table("", "", show_header=False)
    eta, ratio = told["eta"], told["ratio"]
    table.add_row("largest ‖e‖/‖v‖ found", f"{told['gain']:.6g}")
    table.add_row(
        "η, proved",
        f"none for this window: {told['eta_source']}" if eta is None else f"{eta:.6g} ({told['eta_source']})",
    )
    if isinstance(ratio, float):
        table.add_row("of η", f"{100.0 * ratio:.1f} %")
    table.add_row("delays", f"{told['d_min']} to {told['d_max']}, {told['transitions']}; {told['samples']} samples")
    Console().print(table)
