"""``gains design``: the command line of a design, its progress, and the gain file it writes."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, cast

import click
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from gains.command import NEGATIVE, SUCCESS, print_json
from gains.design import Bounds, Design, Method, Search, SteadyState, Step, design
from gains.proving import write_certified
from gains.store import load_gains, load_model, require_law, resolve
from gains.switched import Transitions
from gains.table import InputError
from gains.weighting import Weighting

__all__ = ["run_design"]


def run_design(
    model_name: str, window: tuple[int, int], output: Path, *, as_json: bool, options: dict[str, Any]
) -> int:
    """Design, say how it goes, write the gains with their certificate, and return the exit code.

    Parameters
    ----------
    model_name : str
        Stored model or model file.
    window : (int, int)
        d_min and d_max.
    output : Path
        The gain file.
    as_json : bool
        Whether standard output is one JSON object.
    options : dict
        ``method``, ``search``, ``memory``, ``transitions``, ``delta``, ``steady_state``, ``start``,
        ``iterations``, ``weight`` (pairs of name and number) and ``limit`` (pairs of gain and number), as the
        command line gives them.

    Raises
    ------
    InputError
        When an option does not fit the model, or the file cannot be written.
    """
    model = load_model(model_name)
    start = None if options["start"] is None else require_law(load_gains(options["start"]))
    begun = _clock()
    with _Reporter() as reporter:
        try:
            found = design(
                model,
                *window,
                delta_max=options["delta"],
                steady_state=cast(SteadyState, options["steady_state"]),
                start=start,
                method=cast(Method, options["method"]),
                search=cast(Search, options["search"]),
                transitions=cast(Transitions, options["transitions"]),
                memory=options["memory"],
                weights=_weighting(options["weight"]),
                bounds=_bounds(options["limit"]),
                progress=reporter.step,
                iterations=options["iterations"],
                name=output.stem,
            )
        except ValueError as error:
            raise InputError(str(error)) from None
    for note in found.notes:
        click.echo(f"gains: {note}", err=True)
    seconds = _clock() - begun
    written = (
        found.gains is not None
        and found.analysis is not None
        and write_certified(output, resolve(model_name), found.gains, found.analysis)
    )
    if as_json:
        print_json(_answer(found, options, window, output if written else None, seconds))
    else:
        click.echo(_line(found, output, window, seconds))
    return SUCCESS if written else NEGATIVE


_clock = time.perf_counter  # noqa: TID251  a command says how long it took


class _Reporter:
    """Progress of a design on standard error: a live line on a terminal, a plain one per step elsewhere."""

    def __init__(self) -> None:
        self._console = Console(stderr=True)
        self._best: dict[str, float] = {}
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(pulse_style="cyan"),
            TimeElapsedColumn(),
            console=self._console,
            transient=True,
            disable=not self._console.is_terminal,
        )
        self._task = self._progress.add_task("starting", total=None)

    def step(self, step: Step) -> None:
        """Show one step."""
        what = f"{step.method} {step.iteration}"
        if step.share < 1.0:
            text = f"{what}: {step.share:.0%} of the delays asked, eta {step.eta:.4f}"
        else:
            best = self._best["eta"] = min(step.eta, self._best.get("eta", np.inf))
            text = f"{what}: eta {step.eta:.4f}, best {best:.4f}"
        if self._console.is_terminal:
            self._progress.update(self._task, description=text)
        else:
            click.echo(f"gains: {text}", err=True)

    def __enter__(self) -> _Reporter:
        self._progress.start()
        return self

    def __exit__(self, *_exception: object) -> None:
        self._progress.stop()


def _weighting(pairs: tuple[tuple[str, float], ...]) -> Weighting | None:
    """Return the weights given by name."""
    return Weighting(**dict(pairs)) if pairs else None


def _bounds(pairs: tuple[tuple[str, float], ...]) -> Bounds | None:
    """Return the bounds on the entries of the gains given by name."""
    return Bounds(**dict(pairs)) if pairs else None


def _line(found: Design, output: Path, window: tuple[int, int], seconds: float) -> str:
    """Return what a person reads at the end."""
    if found.gains is None:
        return f"no design: {found.reason}"
    eta = "stable" if found.eta is None else f"eta {found.eta:.6g} verified"
    return f"{output}: {eta} for delays {window[0]} to {window[1]}, {len(found.history)} steps in {seconds:.1f} s"


def _answer(
    found: Design, options: dict[str, Any], window: tuple[int, int], output: Path | None, seconds: float
) -> dict[str, object]:
    """Return what a program reads at the end."""
    gains, verification = found.gains, None if found.analysis is None else found.analysis.verification
    return {
        "verdict": "undecided" if gains is None else "stable",
        "eta": found.eta,
        "objective": found.objective,
        "d_min": window[0],
        "d_max": window[1],
        "method": options["method"],
        "search": options["search"],
        "memory": options["memory"],
        "transitions": options["transitions"],
        "steady_state": options["steady_state"],
        "delta_max": options["delta"],
        "margin": None if verification is None else verification.margin,
        "K1": None if gains is None else gains.K1,
        "K2": None if gains is None else gains.K2,
        "steps": len(found.history),
        "notes": found.notes,
        "reason": found.reason or None,
        "file": None if output is None else str(output),
        "seconds": seconds,
    }
