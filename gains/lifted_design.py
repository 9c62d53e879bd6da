"""Designs on the lifted form: the way in from the model alone, then a search for gains of small η.

The way in is a short design on Lemma 1, whose cost does not grow with the delays. Where Lemma 1 holds for a narrower
window only, the interior-point search takes the gains from there to the window asked, one sample at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from gains.interior import interior_point
from gains.lifted_convexify import lifted_convexification
from gains.lifted_task import LiftedTask
from gains.model import Matrix
from gains.quasinewton import Iterate, Step, quasi_newton
from gains.start import feasible, lq_gains, widened
from gains.task import Task

__all__ = ["exact_steps"]

_ENTRY = 15  # quasi-Newton iterations on Lemma 1
_ON_THE_WAY = 0.1  # gap of the interior-point search on narrower windows

Problems = Callable[[int, int], LiftedTask]


def exact_steps(
    problem: Problems, window: tuple[int, int], start: Matrix | None, search: str, iterations: int
) -> Iterator[Step]:
    """Yield the steps of a design: the way in, then the search.

    Parameters
    ----------
    problem : callable
        The design problem of a window (d_min, d_max).
    window : tuple of int
        The one asked.
    start : ndarray, shape (nu, n), or None
        [K1, K2] in the units of the model, tried first.
    search : {"best", "quasi-newton", "convexify"}
    iterations : int
        Most iterations of the search.
    """
    target = problem(*window)
    entry: Step | None = None
    found = False
    if start is not None:
        K = target.units.point(target.units.free(target.units.own(start)))
        if target.inside(K):
            for step in _searched(target, target.given(K), search, iterations, 1.0):
                found = True
                yield step
    if found:
        return
    for step in _way_in(problem, window):
        entry = step if step.share == 1.0 else entry
        yield step
    if entry is not None:
        yield from _searched(target, entry.gains, search, iterations, 1.0, entry.eta)


def _searched(
    task: LiftedTask, K: Matrix, search: str, iterations: int, share: float, eta: float | None = None
) -> Iterator[Step]:
    """Yield the steps of one search from gains in the units of the model."""
    local = task.balanced(K)
    start = local.point(local.free(local.own(K)))
    iterates: Iterator[Iterate]
    if search == "best":
        gap = 0.0 if share == 1.0 else _ON_THE_WAY
        iterates = (reached.iterate for reached in interior_point(local, start, iterations, gap=gap, eta=eta))
        search = "interior-point"
    elif search == "quasi-newton":
        iterates = quasi_newton(local, start, iterations)
    else:
        iterates = lifted_convexification(local, start, iterations)
    for i, iterate in enumerate(iterates, 1):
        yield Step(search, i, share, iterate.eta, local.given(iterate.K))


def _way_in(problem: Problems, window: tuple[int, int]) -> Iterator[Step]:
    """Yield the steps of designs on Lemma 1 and on narrower windows; those of share 1 are in the window asked."""
    d_min, d_max = window
    units = problem(*window).units
    starts = feasible(units, lq_gains(units))
    if not starts:
        for i, (share, way) in enumerate(widened(units, lq_gains(units)), 1):
            yield Step("widen", i, share, way.eta, units.given(way.K))
            starts = [way] if share == 1.0 else []
    if starts:
        yield from _on_lemma1(units, starts[0], 1.0)
        return
    for narrow in range(d_max - 1, max(d_min, 1) - 1, -1):
        units = problem(d_min, narrow).units
        starts = feasible(units, lq_gains(units))
        if starts:
            yield from _wider(problem, window, narrow, units, starts[0])
            return


def _wider(problem: Problems, window: tuple[int, int], narrow: int, units: Task, start: Iterate) -> Iterator[Step]:
    """Yield the steps from gains that Lemma 1 proves on a narrow window to such in the window asked."""
    d_min, d_max = window
    K: Matrix | None = None
    for step in _on_lemma1(units, start, narrow / d_max):
        K = step.gains
        yield step
    for d in range(narrow, d_max + 1):
        if K is None:
            return
        begin, K = K, None
        for step in _searched(problem(d_min, d), begin, "best", 300, d / d_max):
            K = step.gains
            yield step


def _on_lemma1(units: Task, start: Iterate, share: float) -> Iterator[Step]:
    """Yield the start and a few quasi-Newton steps on Lemma 1; η is what Lemma 1 proves."""
    K = units.given(start.K)
    yield Step("start", 1, share, start.eta, K)
    local = units.balanced(K)
    for i, iterate in enumerate(quasi_newton(local, local.own(K), _ENTRY), 1):
        yield Step("quasi-newton on Lemma 1", i, share, iterate.eta, local.given(iterate.K))
