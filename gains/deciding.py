"""The commands of the exact method: ``gains certify``, ``gains bound``, ``gains witness``, ``gains schedule``.

Each answer is a proof, a breaking delay sequence, or "undecided" with both bounds on the joint spectral radius and the
effort spent.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import click

from gains.command import NEGATIVE, SUCCESS, print_json
from gains.decide import Bound, Decision, bound, decide, possible, refute
from gains.exact import ExactAnalysis, eta, program_rows
from gains.lower_gain import worst_gain
from gains.model import GainLaw, Gains, Schedule
from gains.plotdata import margins, response
from gains.proving import write_certified
from gains.store import load_gains, model_path, require_law, resolve
from gains.switched import Switched, Transitions, eq9, graph
from gains.table import InputError
from gains.witnessfile import Witness, write_witness

__all__ = ["Question", "run_bound", "run_certify", "run_schedule", "run_witness"]

_FLOWN_ROWS = 6_000  # of the programs of the law as it runs: larger ones take minutes
_STAYS = (30,)  # samples
_SHOWN = 12  # delays of a sequence that are printed one by one
_clock = time.perf_counter  # noqa: TID251  # a command says how long it took


class Question(NamedTuple):
    """What is asked of given gains.

    Attributes
    ----------
    law : Gains or Schedule
    d_min, d_max : int
        Samples.
    transitions : {"any", "fifo"}
    delta_max : float
        Bound on ‖Δ‖.
    memory : int
        Past delays that a storage knows.
    flown : bool
        Whether the law as it runs is asked, too.
    """

    law: GainLaw
    d_min: int
    d_max: int
    transitions: Transitions
    delta_max: float
    memory: int
    flown: bool


class Certified(NamedTuple):
    """What was found out.

    Attributes
    ----------
    analysis : ExactAnalysis or None
        The proof of η; None where stability alone was asked.
    decision : Decision or None
        On stability, where no η was proved.
    eta_lower : float or None
        A gain that a delay sequence reaches.
    worst : tuple of int or None
        That sequence.
    unaligned, aligned : float or None
        η of the law as it runs: xr not predicted; predicted by any number of samples in the window.
    """

    analysis: ExactAnalysis | None
    decision: Decision | None
    eta_lower: float | None
    worst: tuple[int, ...] | None
    unaligned: float | None
    aligned: float | None

    @property
    def proof(self) -> ExactAnalysis | Decision | None:
        """What carries the certificate, if there is one."""
        for found in (self.analysis, self.decision):
            if found is not None and found.verdict == "stable":
                return found
        return None

    @property
    def verdict(self) -> str:
        """As the command prints it."""
        if self.proof is not None:
            return "stable"
        return "undecided" if self.decision is None else self.decision.verdict


def run_certify(question: Question, name: str, output: Path | None, *, as_json: bool) -> int:
    """Certify by the exact method, print the answer, write the gains, and return the exit code."""
    start = _clock()
    law = question.law
    click.echo(f"gains: certifying {law.name}, delay {_window(question)}, method exact", err=True)
    found = _certified(question)
    seconds = _clock() - start
    if output is not None and (found.proof is None or not write_certified(output, model_path(name), law, found.proof)):
        click.echo(f"gains: {output} not written: there is no certificate", err=True)
    if as_json:
        print_json(_certify_json(question, found, seconds))
    else:
        click.echo("\n".join(_certify_lines(question, found)))
    return SUCCESS if found.verdict == "stable" else NEGATIVE


def run_bound(
    law: GainLaw, d_min: int, limit: int, transitions: Transitions, *, as_json: bool, plot: Path | None = None
) -> int:
    """Find the largest d_max by the exact method, print the answer, draw it and return the exit code.

    Raises
    ------
    InputError
        When the plot cannot be written.
    """
    start = _clock()
    click.echo(f"gains: bounding the delay of {law.name} from {d_min} up to {limit}, method exact", err=True)
    found = bound(law, d_min, limit, transitions, tell=_tell)
    seconds = _clock() - start
    if plot is not None:
        from gains.plot import plot_margins  # with the plotting library: other answers do without

        plot_margins(plot, margins(law, d_min, limit, transitions, found, _tell))
    if as_json:
        print_json({**_bound_json(law, d_min, limit, transitions, found, seconds), "plot": plot})
    else:
        click.echo("\n".join(_bound_lines(law, d_min, limit, transitions, found)))
    return NEGATIVE if found.d_max is None else SUCCESS


def run_witness(
    gains: Gains,
    window: tuple[int, int],
    transitions: Transitions,
    output: Path,
    *,
    as_json: bool,
    plot: Path | None = None,
) -> int:
    """Find the witness of largest growth in a window, write it as CSV, draw the loop under it, return the exit code.

    Raises
    ------
    InputError
        When a file cannot be written.
    """
    d_min, d_max = window
    start = _clock()
    click.echo(f"gains: seeking a witness for {gains.name}, delay {d_min} to {d_max}, {transitions}", err=True)
    found = decide(gains, d_min, d_max, transitions=transitions, best_witness=True)
    if found.witness is not None and found.growth is not None:
        model = gains.model
        text = Witness(gains.name, model.name, model.Ts, d_min, d_max, transitions, found.growth, found.witness)
        write_witness(output, text)
        if plot is not None:
            from gains.plot import plot_response

            plot_response(plot, response(gains, found, transitions))
    elif plot is not None:
        click.echo(f"gains: {plot} not written: there is no witness", err=True)
    if as_json:
        answer = {
            "verdict": found.verdict,
            "d_min": d_min,
            "d_max": d_max,
            "transitions": transitions,
            "witness": found.witness,
            "growth_per_sample": found.growth,
            **_bounds_json(found),
            "file": None if found.witness is None else str(output),
            "plot": None if found.witness is None else plot,
            "seconds": _clock() - start,
        }
        print_json(answer)
    elif found.witness is not None:
        click.echo(f"{output}: {_sequence(found.witness)} grows {found.growth:.6f} per sample")
    else:
        why = "the loop is proved stable" if found.verdict == "stable" else _undecided(found)
        click.echo(f"{gains.name}: no witness for delays {d_min} to {d_max} ({transitions}): {why}")
    return NEGATIVE if found.witness is None else SUCCESS


def run_schedule(names: Sequence[str], output: Path, transitions: Transitions, delta: float, *, as_json: bool) -> int:
    """Join gains into a schedule, certify it under every switching, and return the exit code.

    Raises
    ------
    InputError
        When the gains are for different models, or their windows do not follow one another.
    """
    sets = sorted((require_law(load_gains(name)) for name in names), key=lambda gains: (gains.d_min, gains.d_max))
    models = {resolve(model_path(name)) for name in names}
    if len(models) > 1:
        raise InputError(f"schedule: expected gains for one model, found {', '.join(sorted(m.stem for m in models))}")
    for before, after in pairwise(sets):
        if not before.d_min < after.d_min <= before.d_max + 1 <= after.d_max:
            windows = ", ".join(f"{own.name} {own.d_min} to {own.d_max}" for own in sets)
            hint = "'gains certify NAME --delay MIN:MAX -o FILE' narrows a window"
            raise InputError(
                f"schedule: expected windows that rise without a gap, none in another, found {windows}; {hint}"
            )
    model = sets[0].model
    if delta > 0.0 and model.uncertainty is None:
        raise InputError(f"--delta: expected 0, as model {model.name} has no [uncertainty], found {delta:g}")
    named = tuple(
        replace(own, name=f"{output.stem}[{i}]", model=model, certificate=None, conservative=None)
        for i, own in enumerate(sets)
    )
    law = Schedule(output.stem, model, named)
    question = Question(law, law.d_min, law.d_max, transitions, delta, 0, True)
    return run_certify(question, names[0], output, as_json=as_json)


def _certified(question: Question) -> Certified:
    law, d_min, d_max, transitions, delta_max, memory, _ = question
    switched = eq9(law, d_min, d_max, delta_max)
    analysis: ExactAnalysis | None = None
    refuted = refute(law, d_min, d_max, transitions)
    if refuted is not None:
        return Certified(None, refuted, None, None, None, None)
    if switched.m:
        rows = program_rows(law, d_min, d_max, transitions, delta_max, None, memory)
        click.echo(f"gains: seeking storages for eta: {switched.N} states, a program of {rows} rows", err=True)
        analysis = eta(law, d_min, d_max, transitions=transitions, delta_max=delta_max, memory=memory)
        if analysis.verdict != "stable":
            click.echo(f"gains: no eta: {analysis.reason}; deciding stability alone", err=True)
    if analysis is None or analysis.verdict != "stable":
        decision = decide(law, d_min, d_max, transitions=transitions, delta_max=delta_max)
        return Certified(analysis, decision, None, None, None, None)
    click.echo(f"gains: eta {analysis.eta:.6g} verified; seeking delay sequences that reach it", err=True)
    nominal = eq9(law, d_min, d_max)
    walks = graph(nominal, law, transitions)
    lower, worst = worst_gain(nominal, walks, _slow_cycles(nominal))
    delays = tuple(nominal.modes[i].d for i in worst)
    unaligned, aligned = _as_flown(question) if question.flown and law.model.nr else (None, None)
    if not possible(delays, [nominal.modes[i].gain_set for i in worst]):
        return Certified(analysis, None, None, None, unaligned, aligned)
    return Certified(analysis, None, lower, delays, unaligned, aligned)


def _slow_cycles(switched: Switched) -> list[list[int]]:
    """Return cycles that stay long at the smallest, then at the largest delay: where the search of a gain begins."""
    low, high = 0, switched.index(max(mode.d for mode in switched.modes))
    return [[low] * m + list(range(low + 1, high)) + [high] * n for m in _STAYS for n in _STAYS]


def _as_flown(question: Question) -> tuple[float | None, float | None]:
    """Return η of the law as it runs, xr not predicted and predicted by any number of samples in the window."""
    law, d_min, d_max, transitions, delta_max, _, _ = question
    found: list[float | None] = []
    for aheads in ((0,), tuple(range(d_min, d_max + 1))):
        if program_rows(law, d_min, d_max, transitions, delta_max, aheads) > _FLOWN_ROWS:
            click.echo(f"gains: eta as flown with {len(aheads)} predictions not tried: too large", err=True)
            found.append(None)
            continue
        click.echo(f"gains: eta as flown, prediction by {', '.join(map(str, aheads))}", err=True)
        analysis = eta(law, d_min, d_max, transitions=transitions, delta_max=delta_max, aheads=aheads)
        found.append(analysis.eta)
    return found[0], found[1]


def _tell(text: str) -> None:
    click.echo(f"gains: {text}", err=True)


# -- answers


def _certify_json(question: Question, found: Certified, seconds: float) -> dict[str, Any]:
    analysis, decision, proof = found.analysis, found.decision, found.proof
    verification = None if proof is None else proof.verification
    return {
        "verdict": found.verdict,
        "eta": None if analysis is None else analysis.eta,
        "eta_lower": found.eta_lower,
        "d_min": question.d_min,
        "d_max": question.d_max,
        "transitions": question.transitions,
        "method": "exact",
        "delta_max": question.delta_max,
        "margin": None if verification is None else verification.margin,
        "witness": None if decision is None else decision.witness,
        "growth_per_sample": None if decision is None else decision.growth,
        "seconds": seconds,
        "seconds_of_latency": question.d_max * question.law.model.Ts if proof is not None else None,
        "memory": question.memory,
        "eta_lower_sequence": found.worst,
        "eta_as_flown": {"unaligned": found.unaligned, "aligned": found.aligned},
        **({} if decision is None else _bounds_json(decision)),
        "reason": None if proof is not None else (decision.reason if decision is not None else None),
    }


def _bounds_json(decision: Decision) -> dict[str, object]:
    return {
        "jsr_lower": decision.lower,
        "jsr_upper": decision.upper,
        "unbounded": decision.unbounded,
        "effort": {"products": decision.products, "solves": decision.solves},
    }


def _certify_lines(question: Question, found: Certified) -> list[str]:
    law, analysis, decision, proof = question.law, found.analysis, found.decision, found.proof
    where = f"delays {_window(question)} ({question.transitions})"
    where += f" and ||Delta|| <= {question.delta_max:g}" if question.delta_max > 0.0 else ""
    if proof is None:
        assert decision is not None
        if decision.witness is not None:
            grows = f"{_sequence(decision.witness)} grows {decision.growth:.6f} per sample"
            grows += f", {decision.reason}" if decision.reason else ""
            return [f"{law.name}: unstable for {where}: {grows}"]
        return [f"{law.name}: undecided for {where}: {_undecided(decision)}"]
    lines = [f"{law.name}: stable for {where}, survives {_latency(law, question.d_max)}"]
    if decision is not None and decision.unbounded:
        lines.append("  stable for every bounded delay: the loop contracts whatever the delay does")
    if analysis is not None and analysis.eta is not None:
        lines.append(f"  eta, xr at the plant, Eq. (9)              {analysis.eta:.6g}")
        if found.eta_lower is not None and found.worst is not None:
            gap = analysis.eta / found.eta_lower - 1.0 if found.eta_lower > 0.0 else float("inf")
            reached = f"{found.eta_lower:.6g} (gap {gap:.1%}): {_sequence(found.worst)}"
            lines.append(f"    a delay sequence reaches                {reached}")
        if question.law.model.nr and question.flown:
            lines.append(f"  eta as flown, xr not predicted            {_or_not(found.unaligned)}")
            lines.append(
                f"  eta as flown, xr predicted by any of them {_or_not(found.aligned)} (r held, not known ahead)"
            )
    if proof.verification is not None:
        lines.append(f"  verified: margin {proof.verification.margin:.2g}, rounding {proof.verification.rounding:.2g}")
    return lines


def _bound_json(
    law: GainLaw, d_min: int, limit: int, transitions: Transitions, found: Bound, seconds: float
) -> dict[str, Any]:
    refuted = None
    if found.refuted is not None:
        refuted = {
            "d_max": found.refuted.d_max,
            "witness": found.refuted.witness,
            "growth_per_sample": found.refuted.growth,
        }
    open_ = [
        {"d_max": decision.d_max, **_bounds_json(decision), "reason": decision.reason} for decision in found.undecided
    ]
    largest = found.d_max
    latency = largest * law.model.Ts if isinstance(largest, int) else None
    return {
        "d_min": d_min,
        "d_max": largest,
        "seconds_of_latency": latency,
        "limit": limit,
        "method": "exact",
        "transitions": transitions,
        "refuted": refuted,
        "seconds": seconds,
        "undecided": open_,
        "jsr": None if found.proof is None else {"lower": found.proof.lower, "upper": found.proof.upper},
    }


def _bound_lines(law: GainLaw, d_min: int, limit: int, transitions: Transitions, found: Bound) -> list[str]:
    if found.d_max == "unbounded":
        return [f"{law.name}: proved stable for every bounded delay: |A| + |B K1| contracts"]
    if found.d_max is None:
        lines = [f"{law.name}: no window from {d_min} is proved stable ({transitions})"]
    else:
        assert isinstance(found.d_max, int)
        where = f"delays {d_min} to {found.d_max} ({transitions})"
        lines = [f"{law.name}: proved stable for {where}, survives {_latency(law, found.d_max)}"]
        if found.d_max == limit:
            lines.append(f"  {limit} was the limit asked; a larger --limit may prove more")
    lines += [f"  {decision.d_max}: undecided: {_undecided(decision)}" for decision in found.undecided]
    if found.refuted is not None and found.refuted.witness is not None:
        grows = f"grows {found.refuted.growth:.6f} per sample"
        lines.append(f"  {found.refuted.d_max}: refuted: {_sequence(found.refuted.witness)} {grows}")
    return lines


def _or_not(value: float | None) -> str:
    return "not computed: the program is too large" if value is None else f"{value:.6g}"


def _window(question: Question) -> str:
    return f"{question.d_min} to {question.d_max}"


def _latency(law: GainLaw, d_max: int) -> str:
    return f"{d_max * law.model.Ts * 1e3:g} ms at this Ts ({law.model.Ts * 1e3:g} ms)"


def _undecided(decision: Decision) -> str:
    bounds = f"joint spectral radius between {decision.lower:.6f} and {decision.upper:.6f}"
    effort = f"{decision.products} products, {decision.solves} programs solved"
    return f"{decision.reason}; {bounds} after {effort}" if decision.reason else f"{bounds} after {effort}"


def _sequence(delays: tuple[int, ...]) -> str:
    """Return a delay sequence as text, runs of a long one shortened: 1, 2, 7 (14 times)."""
    if len(delays) <= _SHOWN:
        return ",".join(map(str, delays))
    runs: list[tuple[int, int]] = []
    for d in delays:
        if runs and runs[-1][0] == d:
            runs[-1] = (d, runs[-1][1] + 1)
        else:
            runs.append((d, 1))
    return ", ".join(str(d) if count == 1 else f"{d} ({count} times)" for d, count in runs)
