"""``sitl rare``: the probability of a failure too rare to be met by flying."""

from __future__ import annotations

import math
import os
from typing import TYPE_CHECKING, Any

import click

from gains.command import NEGATIVE, SUCCESS, print_json
from sitl.commands.draws import Draws, draw_options, one_number, require_numba

if TYPE_CHECKING:
    from sitl.campaign.job import Campaign
    from sitl.campaign.splitting import RareEvent

__all__ = ["rare_command"]


@click.command("rare")
@click.option("--gains", "gains_name", required=True, help="What flies.")
@click.option("--delays", "delays_text", metavar="LAW", default="geometric:1", show_default=True,
              help="uniform, hold:P or geometric:MEAN (beyond the window).")  # fmt: skip
@draw_options
@click.option("--threshold", "threshold_text", metavar="ERROR",
              help="A flight fails whose error exceeds it, such as 2deg; default: where it diverges.")  # fmt: skip
@click.option("--particles", type=click.IntRange(2), default=1000, show_default=True, help="Flights at once.")
@click.option("--killed", type=click.IntRange(1), help="Least number killed per level; default: a tenth of them.")
@click.option("--replicas", type=click.IntRange(10, 10_000), default=20, show_default=True,
              help="Independent repetitions; their spread is the interval.")  # fmt: skip
@click.option("--workers", type=click.IntRange(1, 1024), help="Threads; default: one per core.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object on standard output.")
def rare_command(
    gains_name: str,
    delays_text: str,
    draws: Draws,
    threshold_text: str | None,
    particles: int,
    killed: int | None,
    replicas: int,
    workers: int | None,
    as_json: bool,
) -> int:
    """Estimate how probable it is that a flight fails, where that is too rare to be met by flying.

    \b
    sitl rare --gains hirm-paper --delays geometric:3 --threshold 2.5deg
    sitl rare --gains hirm-d3 --delays geometric:3 --threshold 3deg --replicas 40

    Flights that come near failure are copied, and their future drawn anew. Gust and reference come along, so this
    serves failures that delays bring about. The exit code is 1 when no failure was found.
    """
    require_numba()
    from gains.store import load_law, require_law
    from sitl.campaign.splitting import rare

    law = require_law(load_law(gains_name))
    job = draws.campaign(law, particles * replicas, draws.delays(law, delays_text))
    event = rare(
        job,
        None if threshold_text is None else one_number(threshold_text, "--threshold"),
        particles=particles,
        killed=killed,
        replicas=replicas,
        workers=workers or len(os.sched_getaffinity(0)),
    )
    if as_json:
        print_json({**_asked(gains_name, job), **event.to_json()})
    else:
        _show(gains_name, job, threshold_text, event)
    return SUCCESS if event.probability > 0.0 else NEGATIVE


def _asked(gains_name: str, job: Campaign) -> dict[str, Any]:
    """Return what was flown."""
    assert job.delays is not None
    return {
        "gains": gains_name,
        "model": job.plant_name,
        "d_min": job.d_min,
        "d_max": job.d_max,
        "delays": job.delays.text,
        "transitions": job.transitions,
    }


def _show(gains_name: str, job: Campaign, threshold_text: str | None, event: RareEvent) -> None:
    """Print a table."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    assert job.delays is not None
    failure = "diverges" if threshold_text is None else f"diverges or errs by more than {threshold_text}"
    flown = f"{gains_name} on {job.plant_name}, delays {job.delays.text}, {job.samples} samples"
    table = Table(title=Text(f"{flown}: a flight {failure}"), title_justify="left", show_header=False,
                  caption=Text(_caption(event)), caption_justify="left")  # fmt: skip
    table.add_column(justify="left")
    table.add_column(justify="right")
    for name, value in _rows(event):
        table.add_row(Text(name), Text(value))
    Console().print(table)


def _rows(event: RareEvent) -> list[tuple[str, str]]:
    """Return what is told of the estimate."""
    count = len(event.replicas)
    work = [
        ("levels per replica, mean", f"{sum(event.levels) / count:.1f}"),
        ("flights", f"{event.flights:,}"),
    ]
    if event.probability == 0.0:
        return [("probability", f"none of {count} replicas found a failure"), *work]
    found = sum(estimate > 0.0 for estimate in event.replicas)
    high = "?" if math.isnan(event.high) else f"{event.high:.3g}"
    estimate = [
        ("probability per flight", f"{event.probability:.3g}"),
        (f"{100 * event.confidence:g} % interval", f"{event.low:.3g} to {high}"),
        ("relative error", f"{100.0 * event.relative_error:.1f} %"),
        ("replicas that found failures", f"{found} of {count}"),
        ("first flights they stem from, mean", f"{sum(event.roots) / count:.1f} of {event.particles:,}"),
    ]
    plain = [
        ("plain Monte Carlo for the same error", f"{event.plain_flights_for_the_same_error:.3g} flights"),
        ("that is", f"{event.efficiency:.3g} times as many"),
    ]
    return estimate + work + (plain if event.relative_error > 0.0 else [])


def _caption(event: RareEvent) -> str:
    """Return what a reader must know before believing it."""
    if event.probability == 0.0:
        return "Rarer than can be told from these particles: more of them, or a lower threshold."
    if event.unsure:
        return (
            "The replicas differ much: no more than the order of magnitude is known, and it is likelier too low. More"
            " particles help."
        )
    return ""
