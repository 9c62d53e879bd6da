"""From the campaigns that were asked for to what is told of them: the shell of ``sitl campaign``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from gains.atomic import replace_file
from gains.certificate import model_hash
from gains.model import Model
from gains.table import InputError
from sitl.aircraft.plants import is_nonlinear
from sitl.campaign.bounds import Bound, certified_bound
from sitl.campaign.cluster import require_scheduler
from sitl.campaign.comparison import MAX_CONTROLLERS, Comparison, compare
from sitl.campaign.engine import Columns
from sitl.campaign.job import Campaign, identity
from sitl.campaign.page import campaign_page
from sitl.campaign.parts import Parts
from sitl.campaign.replaying import growth_per_sample, write_delays
from sitl.campaign.run import WITHOUT_SCHEDULER, Outcome, run
from sitl.campaign.statistics import Statistics, measure
from sitl.campaign.tables import campaign_tables, comparison_tables

__all__ = ["Report", "conduct"]


_UNITS = {"_rad": "rad", "_rad_s": "rad/s", "_m": "m", "_m_s": "m/s"}
"""By how the name of a state ends."""


@dataclass(frozen=True, slots=True, eq=False)
class Flown:
    """One campaign, what is proved of it, and what became of it."""

    name: str
    job: Campaign
    bound: Bound
    outcome: Outcome
    aside: int

    @property
    def columns(self) -> Columns:
        """One row per flight."""
        return self.outcome.columns

    @property
    def steps_per_s(self) -> float:
        """Samples flown per second."""
        return self.outcome.flown * self.job.samples / max(self.outcome.seconds, 1e-9)


def conduct(
    jobs: Mapping[str, Campaign],
    delays: str,
    scheduler: str,
    workers: int | None,
    threshold: float | None,
    folder: Path | None,
    *,
    quiet: bool,
) -> Report:
    """Fly campaigns one after the other, with a progress bar on stderr, and return the report.

    Parameters
    ----------
    jobs : mapping
        Campaigns by the names of their gains; of several, each has a folder of its own in ``folder``.
    delays : str
        What was asked for, in words.
    scheduler, workers
        As for :func:`sitl.campaign.run.run`.
    threshold : float or None
        An error beyond it is a failure.
    folder : Path or None
        Where results are written.
    quiet : bool
        Without the bar.

    Raises
    ------
    InputError
        For too many to compare, two that would share a folder, no scheduler at its address, and what
        :func:`sitl.campaign.run.run` refuses.
    """
    _check_names(list(jobs), folder)
    if scheduler not in WITHOUT_SCHEDULER:
        require_scheduler(scheduler)
    console = Console(stderr=True)
    flown = []
    bar = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*bar, console=console, disable=quiet or not console.is_terminal, transient=True) as progress:
        for name, job in jobs.items():
            task = progress.add_task(f"{name}: eta", total=job.flights)
            bound = _bound(job)
            own = folder if folder is None or len(jobs) == 1 else folder / _file_name(name)
            parts = None if own is None else Parts(own, identity(job), describe(name, job, delays, bound))
            progress.update(task, description=name)
            outcome = run(
                job,
                scheduler=scheduler,
                workers=workers,
                parts=parts,
                told=lambda n, task=task: progress.advance(task, n),  # type: ignore[misc]
            )
            flown.append(Flown(name, job, bound, outcome, 0 if parts is None else parts.aside))
    comparison = None
    if len(flown) > 1:
        etas = {one.name: one.bound.eta for one in flown}
        comparison = compare({one.name: one.columns for one in flown}, etas=etas, threshold=threshold)
        measured = comparison.statistics
    else:
        measured = (measure(flown[0].columns, eta=flown[0].bound.eta, threshold=threshold),)
    return Report(tuple(flown), measured, comparison, delays, threshold)


def _check_names(names: list[str], folder: Path | None) -> None:
    """Refuse before anything flies what could not be compared or kept afterwards."""
    if len(names) > MAX_CONTROLLERS:
        raise InputError(f"--gains: expected at most {MAX_CONTROLLERS} to compare, found {len(names)}")
    own = [_file_name(name) for name in names]
    twice = next((name for name in own if own.count(name) > 1), None)
    if folder is not None and twice is not None:
        raise InputError(f"{folder}: expected --gains of different names, for a folder each, found {twice} twice")


def _file_name(name: str) -> str:
    return Path(name).name.removesuffix(".toml")


def _bound(job: Campaign) -> Bound:
    """Return what is proved of the loop that flies."""
    if is_nonlinear(job.plant_name):
        return Bound(None, "proofs speak of the linear loop")
    if job.limits:
        return Bound(None, "proofs speak of an elevator without limits")
    if model_hash(job.plant) != model_hash(job.law.model):
        return Bound(None, "another plant than the gains' model")
    if job.x0 > 0.0:
        return Bound(None, "gains are counted from rest")
    return certified_bound(job.law, job.d_min, job.d_max, job.transitions, job.delta.high)


def describe(name: str, job: Campaign, delays: str, bound: Bound) -> dict[str, Any]:
    """Return what a campaign is, for pages and files."""
    return {
        "gains": name,
        "model": job.plant_name,
        "d_min": job.d_min,
        "d_max": job.d_max,
        "delays": delays,
        "transitions": job.transitions,
        "samples": job.samples,
        "flights": job.flights,
        "seed": job.seed,
        "Ts": job.plant.Ts,
        "unit": _unit_of(job.plant),
        "eta": bound.eta,
        "eta_source": bound.source,
    }


def _unit_of(plant: Model) -> str:
    """Return the unit of the outputs where each of them is a state, whose name says it; "" where that is not known."""
    found = {next((unit for end, unit in _UNITS.items() if state.endswith(end)), "") for state in plant.output_states}
    return found.pop() if len(found) == 1 and not plant.D.any() else ""


@dataclass(frozen=True, slots=True, eq=False)
class Report:
    """What was flown, and what is told of it.

    Attributes
    ----------
    flown : tuple of Flown
    measured : tuple of Statistics
        Of each.
    comparison : Comparison or None
        Of several.
    delays : str
        What was asked for, in words.
    threshold : float or None
        An error beyond it is a failure.
    """

    flown: tuple[Flown, ...]
    measured: tuple[Statistics, ...]
    comparison: Comparison | None
    delays: str
    threshold: float | None

    @property
    def negative(self) -> bool:
        """Whether a flight failed: diverged, or exceeded the threshold, or η without leaving the window."""
        return any(measured.failed.count > 0 for measured in self.measured)

    def to_json(self) -> dict[str, Any]:
        """Return the first campaign's numbers, and with several those of each and their comparison."""
        numbers = [_numbers(flown, measured) for flown, measured in zip(self.flown, self.measured, strict=True)]
        if self.comparison is None:
            return numbers[0]
        pairs = self.comparison.to_json()["pairs"]
        return {**numbers[0], "campaigns": numbers, "pairs": pairs}

    def show(self) -> None:
        """Print tables."""
        console = Console()
        for flown, measured in zip(self.flown, self.measured, strict=True):
            for table in campaign_tables(self._description(flown), flown.columns, measured=measured):
                console.print(table)
            console.print(_sentence(flown), highlight=False)
        for table in [] if self.comparison is None else comparison_tables(self.comparison):
            console.print(table)

    def write_page(self, path: Path) -> None:
        """Write the HTML page."""
        first = self.flown[0]
        page = campaign_page(
            self._description(first),
            first.columns,
            self.comparison,
            threshold=self.threshold,
            measured=self.measured[0],
        )
        replace_file(path, page.encode())

    def write_worst(self, path: Path) -> None:
        """Write d(k) of the first campaign's worst flight."""
        first = self.flown[0]
        write_delays(path, first.job, worst_flight(first.columns), first.name)

    def _description(self, flown: Flown) -> dict[str, Any]:
        return describe(flown.name, flown.job, self.delays, flown.bound)


def _sentence(flown: Flown) -> str:
    """Return how fast it went, on one line."""
    outcome = flown.outcome
    if not outcome.flown:
        return "All flights were there already."
    by = "1 worker" if outcome.workers == 1 else f"{outcome.workers} workers"
    aside = f" Files that were damaged or of no use, put aside as _aside-…: {flown.aside}." if flown.aside else ""
    return (
        f"{outcome.flown:,} flights flown in {outcome.seconds:.1f} s by {by}:"
        f" {flown.steps_per_s / 1e6:.3g} million plant-steps/s.{aside}"
    )


def worst_flight(columns: Columns) -> int:
    """Return the first flight that diverged, or else that of the largest gain or, without v, of the largest error."""
    for name in ("diverged", "gain", "max_error"):
        values = np.nan_to_num(columns[name].astype(np.float64), nan=0.0)
        if values.any():
            break
    return int(columns["flight"][np.argmax(values)])


def _numbers(flown: Flown, measured: Statistics) -> dict[str, Any]:
    """Return what ``--json`` says of one campaign."""
    columns, job, outcome = flown.columns, flown.job, flown.outcome
    told = measured.to_json()
    rms = {f"{found.p:g}": found.value for found in measured.quantiles["rms_error"]}
    return {
        "gains": flown.name,
        "flights": job.flights,
        "samples": job.samples,
        "seed": job.seed,
        "diverged": measured.diverged.count,
        "max_gain": measured.gains.largest,
        "eta": flown.bound.eta,
        "eta_source": flown.bound.source,
        "above_eta": None if measured.above is None else measured.above.count,
        "rms_error_rad": rms,
        "failure_probability": told["failed"],
        "growth_per_sample": _growth(flown),
        "worst_flight": worst_flight(columns),
        "flown_now": outcome.flown,
        "put_aside": flown.aside,
        "workers": outcome.workers,
        "seconds": outcome.seconds,
        "plant_steps_per_s": flown.steps_per_s,
        "statistics": told,
    }


def _growth(flown: Flown) -> dict[str, float | None] | None:
    """Return the growth that a cycle predicts for ever, and the median of what the flights' second halves did.

    Measured is the largest |x| so far, which cannot fall: nothing is measured of a loop that does not grow.
    """
    delays = flown.job.delays
    if delays is None or not delays.cycle:
        return None
    predicted, measured = growth_per_sample(flown.job, delays.cycle), flown.columns["growth"]
    known = measured[np.isfinite(measured)]
    grows = len(known) > 0 and (predicted is None or predicted > 1.0)
    return {"predicted": predicted, "measured": float(np.median(known)) if grows else None}
