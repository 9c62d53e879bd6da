"""``sitl rare``: the probability of a failure too rare to be met by flying."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any, Literal

import click

from gains.command import NEGATIVE, SUCCESS, FiniteRange, print_json
from gains.proving import parse_window
from gains.table import InputError
from sitl.commands.campaign import _check_fit, _check_possible
from sitl.commands.options import SEED

if TYPE_CHECKING:
    from sitl.campaign.job import Campaign
    from sitl.campaign.splitting import RareEvent

__all__ = ["rare_command"]

MISSING = "rare: expected numba (pip install 'lagproof[campaign]'), found none"


@click.command("rare")
@click.option("--gains", "gains_name", required=True, help="What flies.")
@click.option("--plant", "plant_name", help="Another model than the gains' as plant.")
@click.option("--delay", "window", metavar="MIN:MAX", help="Window of delays in samples; default: the gain file's.")
@click.option("--delays", "delays_text", metavar="LAW", default="geometric:1", show_default=True,
              help="uniform, hold:P or geometric:MEAN (beyond the window).")  # fmt: skip
@click.option("--transitions", type=click.Choice(["any", "fifo"]), default="any", show_default=True,
              help="fifo: a delay exceeds the one before by at most one sample.")  # fmt: skip
@click.option("--gust", "gust_text", default="sine:0..3.5deg:0.5s..10s", show_default=True,
              help="none, step:A, sine:A[:T], square:A[:T] or white:A, with numbers or spans LOW..HIGH.")  # fmt: skip
@click.option("--reference", "reference_text", default="square:0..5deg:1s..10s", show_default=True,
              help="Likewise; of no meaning without a reference model.")  # fmt: skip
@click.option("--delta", "delta_text", default="0", show_default=True, help="Amplitude of the uncertainty, or a span.")
@click.option("--x0", type=FiniteRange(0.0), default=0.0, show_default=True,
              help="Each state begins within so much of trim.")  # fmt: skip
@click.option("--limits", is_flag=True, help="Let the elevator's travel, lag and rate count.")
@click.option("--threshold", "threshold_text", metavar="ERROR",
              help="A flight fails whose error exceeds it, such as 2deg; default: where it diverges.")  # fmt: skip
@click.option("--particles", type=click.IntRange(2), default=1000, show_default=True, help="Flights at once.")
@click.option("--killed", type=click.IntRange(1), help="Least number killed per level; default: a tenth of them.")
@click.option("--replicas", type=click.IntRange(10, 10_000), default=20, show_default=True,
              help="Independent repetitions; their spread is the interval.")  # fmt: skip
@click.option("--samples", type=click.IntRange(1), default=400, show_default=True)
@click.option("--seed", type=SEED, default=1, show_default=True, help="Of everything random.")
@click.option("--workers", type=click.IntRange(1, 1024), help="Threads; default: one per core.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object on standard output.")
def rare_command(
    gains_name: str,
    plant_name: str | None,
    window: str | None,
    delays_text: str,
    transitions: Literal["any", "fifo"],
    gust_text: str,
    reference_text: str,
    delta_text: str,
    x0: float,
    limits: bool,
    threshold_text: str | None,
    particles: int,
    killed: int | None,
    replicas: int,
    samples: int,
    seed: int,
    workers: int | None,
    as_json: bool,
) -> int:
    """Estimate how probable it is that a flight fails, where that is too rare to be met by flying.

    \b
    sitl rare --gains hirm-paper --delays geometric:3 --threshold 2.5deg
    sitl rare --gains pendulum-paper --delays geometric:2 --gust step:0.1deg --threshold 1

    Flights that come near failure are copied, and their future drawn anew. Gust and reference come along, so this
    serves failures that delays bring about. The exit code is 1 when no failure was found.
    """
    try:
        import numba  # noqa: F401
    except ImportError:
        raise InputError(MISSING) from None
    from gains.store import load_law, require_law
    from sitl.aircraft.plants import is_nonlinear, plant_model
    from sitl.campaign.distributions import parse_delays, parse_signal, parse_span
    from sitl.campaign.job import Campaign
    from sitl.campaign.kernel import MAX_DELAY
    from sitl.campaign.splitting import rare

    law = require_law(load_law(gains_name))
    plant = law.model if plant_name is None else plant_model(plant_name, law.model)
    if is_nonlinear(plant_name or law.model.name):
        raise InputError(f"--plant: expected a linear model, found {plant_name}")
    _check_fit(law, plant)
    d_min, d_max = (law.d_min, law.d_max) if window is None else parse_window(window)
    if d_max > MAX_DELAY:
        raise InputError(f"--delay: expected at most {MAX_DELAY} samples, found {d_max}")
    job = Campaign(
        law=law,
        plant=plant,
        plant_name=plant_name or law.model.name,
        d_min=d_min,
        d_max=d_max,
        transitions=transitions,
        delays=parse_delays(delays_text, d_min, d_max, fifo=transitions == "fifo", longest=MAX_DELAY),
        link=None,
        gust=parse_signal(gust_text, "gust"),
        reference=parse_signal(reference_text if law.model.reference is not None else "none", "reference"),
        delta=parse_span(delta_text, "delta", {"": 1.0}),
        x0=x0,
        wind=None,
        limits=limits,
        flights=particles * replicas,
        samples=samples,
        seed=seed,
    )
    _check_possible(job)
    event = rare(
        job,
        _threshold(threshold_text),
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


def _threshold(text: str | None) -> float | None:
    """Return the error that a text names, in units of the output."""
    from sitl.campaign.distributions import parse_span

    if text is None:
        return None
    span = parse_span(text, "--threshold")
    if span.low != span.high or span.low == 0.0:
        raise InputError(f'--threshold: expected a number above 0, such as 2deg, found "{text}"')
    return span.low


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
    estimate = [
        ("probability per flight", f"{event.probability:.3g}"),
        (f"{100 * event.confidence:g} % interval", f"{event.low:.3g} to {event.high:.3g}"),
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
    if event.relative_error > UNSURE:
        return (
            "The replicas differ much: no more than the order of magnitude is known, and it is likelier too low. More"
            " particles help."
        )
    return ""


UNSURE = 0.3
"""Relative error beyond which Student's interval is not believed."""
