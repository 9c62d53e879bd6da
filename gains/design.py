"""Design of K1 and K2 (sections 4 and 5): a start, a method, and the proof of what it found.

A method proposes gains of falling η; :func:`gains.exact.eta`, or :func:`gains.lyapunov.eta` for the methods on Lemma 1,
alone makes a design of them. The best so far are kept, so that a design can be interrupted.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from gains import ccl, exact, lyapunov, printed
from gains.convexify import convexification
from gains.exact import ExactAnalysis
from gains.lifted_design import exact_steps
from gains.lifted_task import LiftedTask, lifted_task
from gains.model import Gains, Matrix, Model
from gains.proof import Analysis
from gains.quasinewton import Iterate, Progress, Step, quasi_newton
from gains.start import feasible, lq_gains, widened
from gains.steady import Law, equilibrium, every_law, steady_law
from gains.switched import Transitions
from gains.task import Task, task
from gains.weighting import Weighting, weighted

__all__ = ["ITERATIONS", "Bounds", "Design", "Method", "Progress", "Search", "SteadyState", "Step", "design"]

Method = Literal["exact", "lyapunov", "ccl", "printed"]
Search = Literal["best", "quasi-newton", "convexify"]
SteadyState = Literal["exact", "free"]

ITERATIONS: dict[Method | Search, int] = {"best": 300, "convexify": 60, "quasi-newton": 300, "ccl": 60, "printed": 60}
"""The most iterations of a search, or of a method that has but one."""

_ENTRIES = 3  # starts that "best" tries
_ENTRY = (3, 15)  # iterations of convexification and of quasi-Newton on each
_MAX_CHECKED = 20  # steps, from the best down, of which a proof is sought


@dataclass(frozen=True, slots=True)
class Bounds:
    """Bounds on the size of the entries of K1 and K2: numbers, or arrays of their shapes; inf for none."""

    K1: ArrayLike = np.inf
    K2: ArrayLike = np.inf


@dataclass(frozen=True, slots=True, eq=False)
class Design:
    """What a design found.

    Attributes
    ----------
    gains : Gains or None
        Verified on the whole window; None where none were found.
    eta : float or None
        Verified η of the gains, without weights.
    objective : float or None
        Verified η with the weights; the same as ``eta`` without them.
    analysis : ExactAnalysis, Analysis or None
        The proof of ``eta``.
    history : tuple of Step
    notes : tuple of str
        What the reader must know: the steady state is not exact, the design was interrupted.
    reason : str
        Why there are no gains; empty otherwise.
    """

    gains: Gains | None
    eta: float | None
    objective: float | None
    analysis: ExactAnalysis | Analysis | None
    history: tuple[Step, ...]
    notes: tuple[str, ...] = ()
    reason: str = ""


def design(
    model: Model,
    d_min: int,
    d_max: int,
    *,
    delta_max: float = 0.0,
    steady_state: SteadyState = "exact",
    start: Gains | None = None,
    method: Method = "exact",
    search: Search = "best",
    transitions: Transitions = "any",
    memory: int = 0,
    weights: Weighting | None = None,
    bounds: Bounds | None = None,
    progress: Progress | None = None,
    iterations: int | None = None,
    name: str | None = None,
) -> Design:
    """Design gains with a small η for every delay in [d_min, d_max] and every ‖Δ‖ ≤ delta_max, and prove it.

    An interrupt (Ctrl-C) ends the search; the best gains so far are verified and returned.

    Parameters
    ----------
    model : Model
    d_min, d_max : int
        0 ≤ d_min ≤ d_max, d_max ≥ 1, samples.
    delta_max : float
        0 for the nominal model.
    steady_state : {"exact", "free"}
        Whether the gains hold zero error at constant r (section 5a).
    start : Gains or None
        For this model; projected onto the steady-state constraint. None finds its own.
    method : {"exact", "lyapunov", "ccl", "printed"}
        "exact": on the lifted form; the others on Lyapunov–Krasovskii functionals, whose proofs hold for any
        transitions.
    search : {"best", "quasi-newton", "convexify"}
        For "exact" and "lyapunov". "best" of "exact": the interior-point search; of "lyapunov": convexification to get
        in, quasi-Newton to finish, from several starts.
    transitions : {"any", "fifo"}
    memory : int
        Past delays that a storage of "exact" knows.
    weights : Weighting or None
    bounds : Bounds or None
    progress : callable or None
        Called with every step.
    iterations : int or None
        Most iterations of the method; None takes those of :data:`ITERATIONS`.
    name : str or None
        Of the gains.

    Raises
    ------
    ValueError
        When an argument does not fit the model.
    """
    _check(model, d_min, d_max, delta_max, start)
    empty = _empty(model, d_min, d_max, name)
    aim, notes = _aim(model, weights)
    most = ITERATIONS[method if method in ("ccl", "printed") else search] if iterations is None else iterations
    asked = _Asked(empty, aim, delta_max, method, search, transitions, memory, most)
    blocked = printed.obstacle(empty) if method == "printed" else None
    if blocked is not None and blocked.eigenvalue is not None:
        return Design(None, None, None, None, (), (), blocked.reason)
    settled = equilibrium(model) if steady_state == "exact" else None
    if settled is not None and not settled.exact:
        notes.append("no constant input gives zero error for every constant r: the gains hold the least error")
    law = steady_law(model) if steady_state == "exact" else every_law(model)
    box = _box(model, bounds)
    history: list[Step] = []
    try:
        for step in _steps(asked, law, box, None if start is None else _joined(start)):
            history.append(step)
            if progress is not None:
                progress(step)
    except KeyboardInterrupt:
        notes.append("interrupted: the best gains so far")
    return _proven(asked, history, notes)


class _Asked(NamedTuple):
    """What is asked: gains without numbers, the weighted model, the bound on ‖Δ‖, the method and how it goes."""

    empty: Gains
    aim: Model
    delta_max: float
    method: Method
    search: Search
    transitions: Transitions
    memory: int
    iterations: int

    def gains(self, K: Matrix, *, weighted: bool = False) -> Gains:
        nx = self.empty.model.nx
        model = self.aim if weighted else self.empty.model
        return replace(self.empty, model=model, K1=K[:, :nx], K2=None if model.reference is None else K[:, nx:])

    def analysis(self, K: Matrix, *, weighted: bool = False) -> ExactAnalysis | Analysis:
        gains = self.gains(K, weighted=weighted)
        if self.method != "exact":
            return lyapunov.eta(gains, gains.d_min, gains.d_max, self.delta_max)
        driven = gains.model.nw > 0 or gains.model.reference is not None
        prove = exact.eta if driven else exact.stability
        return prove(
            gains,
            gains.d_min,
            gains.d_max,
            transitions=self.transitions,
            delta_max=self.delta_max,
            memory=self.memory,
        )

    def printed_eta(self, problem: Task, K: Matrix) -> float | None:
        gains = self.gains(problem.given(K), weighted=True)
        return printed.eta(gains, gains.d_min, gains.d_max, self.delta_max).eta


def _steps(asked: _Asked, law: Law, box: Matrix, start: Matrix | None) -> Iterator[Step]:
    """Yield the steps of a design."""
    window = asked.empty.d_min, asked.empty.d_max
    if asked.method != "exact":
        yield from _lyapunov_steps(asked, task(asked.aim, *window, asked.delta_max, law, box), start)
        return

    def problem(d_min: int, d_max: int) -> LiftedTask:
        return lifted_task(
            asked.aim,
            d_min,
            d_max,
            asked.delta_max,
            law,
            box,
            transitions=asked.transitions,
            memory=asked.memory,
        )

    yield from exact_steps(problem, window, start, asked.search, asked.iterations)


def _lyapunov_steps(asked: _Asked, problem: Task, start: Matrix | None) -> Iterator[Step]:
    """Yield the steps of a design on Lemma 1: the way in, then the method."""
    method, best = asked.method, asked.method == "lyapunov" and asked.search == "best"
    name = asked.search if method == "lyapunov" else method
    own = [] if start is None else [problem.point(problem.free(problem.own(start)))]
    starts = own + lq_gains(problem)
    if method == "printed":
        found = [Iterate(K, eta) for K in starts if (eta := asked.printed_eta(problem, K)) is not None]
        found.sort(key=lambda iterate: iterate.eta)
    else:
        found = feasible(problem, own) if not best else []
        found = found or feasible(problem, starts)
    if not found and method != "printed":
        for i, (share, way) in enumerate(widened(problem, starts), 1):
            yield Step("widen", i, share, way.eta, problem.given(way.K))
            found = [way] if share == 1.0 else []
    entries = [(problem.given(iterate.K), iterate.eta) for iterate in found]
    for i, (K, eta) in enumerate(entries, 1):
        yield Step("start", i, 1.0, eta, K)
    if best:
        reached = None
        for K, eta in entries[:_ENTRIES]:
            for step in _enter(asked, problem, K, eta):
                reached = step if reached is None or step.eta < reached.eta else reached
                yield step
        entries = [] if reached is None else [(reached.gains, reached.eta)]
    if entries:
        yield from _run(asked, problem, entries[0][0], name, asked.iterations)
    elif method in ("ccl", "printed"):
        yield from _run(asked, problem, None, name, asked.iterations)


def _enter(asked: _Asked, problem: Task, K: Matrix, eta: float) -> Iterator[Step]:
    """Yield the first steps of "best" from one start."""
    for method, iterations in zip(("convexify", "quasi-newton"), _ENTRY, strict=True):
        for step in _run(asked, problem, K, method, min(iterations, asked.iterations)):
            yield step
            if step.eta < eta:
                K, eta = step.gains, step.eta


def _run(asked: _Asked, problem: Task, K: Matrix | None, method: str, iterations: int) -> Iterator[Step]:
    """Yield the steps of one method, in the units of the loop that its start closes."""
    local = problem if K is None else problem.balanced(K)
    start = np.zeros((problem.nu, problem.n)) if K is None else local.own(K)
    iterates: Iterator[Iterate]
    if method == "convexify":
        iterates = convexification(local, start, iterations)
    elif method in ("best", "quasi-newton"):
        method, iterates = "quasi-newton", quasi_newton(local, start, iterations)
    else:
        inequality = ccl.corrected() if method == "ccl" else ccl.as_printed(asked.printed_eta)
        iterates = ccl.complementarity(local, inequality, iterations, None if K is None else start)
    for i, iterate in enumerate(iterates, 1):
        yield Step(method, i, 1.0, iterate.eta, local.given(iterate.K))


def _proven(asked: _Asked, history: list[Step], notes: list[str]) -> Design:
    """Return the best step that verifies."""
    whole = sorted((step for step in history if step.share == 1.0), key=lambda step: step.eta)
    stabilising: tuple[Step, ExactAnalysis | Analysis] | None = None
    for step in whole[:_MAX_CHECKED]:
        analysis = asked.analysis(step.gains)
        if analysis.verdict != "stable":
            continue
        if analysis.eta is None and asked.empty.model is asked.aim:
            stabilising = stabilising or (step, analysis)
            continue
        objective = analysis.eta if asked.empty.model is asked.aim else asked.analysis(step.gains, weighted=True).eta
        gains = asked.gains(step.gains)
        if asked.method == "printed":
            notes.append(f"the printed condition gives eta {step.eta:.6g}; the certificate is that of Lemma 1")
        return Design(gains, analysis.eta, objective, analysis, tuple(history), tuple(notes))
    if stabilising is not None:
        step, analysis = stabilising
        notes.append("the gains are proved stable, but no eta was proved for them")
        return Design(asked.gains(step.gains), None, None, analysis, tuple(history), tuple(notes))
    reach = max((step.share for step in history), default=0.0)
    reason = "no gains were found for which the sufficient condition holds"
    if whole:
        reason += "; of those that the solver proposed, none verified"
    elif reach > 0.0:
        reason += f"; delays and uncertainty could be widened to {reach:.0%} of those asked"
    return Design(None, None, None, None, tuple(history), tuple(notes), reason + " (other gains may do)")


def _check(model: Model, d_min: int, d_max: int, delta_max: float, start: Gains | None) -> None:
    """Raise ValueError where an argument does not fit the model."""
    if not (0 <= d_min <= d_max and d_max >= 1):
        raise ValueError(f"delays: expected 0 <= d_min <= d_max and d_max >= 1, found {d_min} to {d_max}")
    if delta_max < 0.0 or (delta_max > 0.0 and model.uncertainty is None):
        raise ValueError(f"delta_max: expected 0, or more for a model with uncertainty, found {delta_max:g}")
    if start is not None:
        expected, found = ((m.nu, m.nx, m.nr) for m in (model, start.model))
        if expected != found:
            raise ValueError(f"start: expected gains for {model.name}, found gains for {start.model.name}")


def _empty(model: Model, d_min: int, d_max: int, name: str | None) -> Gains:
    """Return gains of zeros, named."""
    K2 = None if model.reference is None else np.zeros((model.nu, model.nr))
    return Gains(name or f"{model.name}-{d_min}-{d_max}", model, d_min, d_max, np.zeros((model.nu, model.nx)), K2)


def _aim(model: Model, weights: Weighting | None) -> tuple[Model, list[str]]:
    """Return the model whose η is minimised."""
    aim = model if weights is None else weighted(model, weights)
    if model.nw == 0 and model.reference is None:
        note = "the model has neither disturbance nor reference: designed against a disturbance of every state"
        return replace(aim, E=np.eye(model.nx)), [note]
    return aim, []


def _box(model: Model, bounds: Bounds | None) -> Matrix:
    given = Bounds() if bounds is None else bounds
    parts = []
    for name, columns in (("K1", model.nx), ("K2", model.nr)):
        bound = np.asarray(getattr(given, name), dtype=np.float64)
        if bound.ndim and bound.shape != (model.nu, columns):
            raise ValueError(f"bounds on {name}: expected a number or shape {(model.nu, columns)}, found {bound.shape}")
        if not np.all(bound > 0.0):
            raise ValueError(f"bounds on {name}: expected positive numbers, found {getattr(given, name)!r}")
        parts.append(np.broadcast_to(bound, (model.nu, columns)))
    return np.hstack(parts)


def _joined(gains: Gains) -> Matrix:
    return gains.K1.copy() if gains.K2 is None else np.hstack([gains.K1, gains.K2])
