"""Interior-point search on the lifted form: Newton steps in the gains on the smooth φ_t(θ) of :mod:`gains.barrier`.

φ_t approaches η²(θ) as t grows. For each t the storages are centred for given gains, which gives the exact gradient and
Hessian of φ_t; the gains move by a Newton step with a line search, in which the storages are centred anew. Every place
is strictly feasible, so that the η of every iterate is an upper bound already.

The search begins with one storage for all modes, a small problem that leads most of the way, and goes on from there
with one for each path.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from gains.barrier import Barrier, Place
from gains.lifted_task import Family, LiftedTask
from gains.model import Matrix
from gains.quasinewton import Iterate

__all__ = ["Reached", "interior_point"]

_GAPS = (0.1, 1e-2, 1e-3, 1e-4)  # degree/t relative to η², in turn
_FINEST = 1e-4  # promised decrease of η² under which the search ends, relative
_LOOSE = 4.0  # gap at which a feasible place is first centred
_CENTRED = 1e-2  # decrement of a centred place
_ROUNDED = 0.1  # decrement that is taken where rounding allows no less
_CENTRINGS = 80
_INSIDE = 0.3  # gap at which one storage is handed on to all paths
_STEPS = 60  # most Newton steps in the gains at one gap
_ATTEMPTS = 12  # trials of the line search over the gains
_PATIENCE = 3  # steps of little progress before the end
_BACK = 0.4  # and what it shortens a step by
_SUFFICIENT = 1e-3
_ABOVE = 4.0  # η² at which gains of known η are taken, relative
_LIMITS = (1e4, 1e7)  # η² in balanced units under which gains are taken at the start
_FEASIBILITY = 250  # Newton steps for the first feasible place
_REPAIR = 8  # and for one near another
_ROOM = 1.5  # η² that a trial may have before it is centred, relative
_STABLE = 0.98  # spectral radius that starting storages are computed for


class Reached(NamedTuple):
    """An iterate of the search, and how far it may be from the least η² there, relative."""

    iterate: Iterate
    gap: float


def interior_point(
    task: LiftedTask, K: Matrix, iterations: int, *, gap: float = 0.0, eta: float | None = None
) -> Iterator[Reached]:
    """Yield gains of falling η from gains that storages of the lifted form prove stable; nothing if there are none.

    Parameters
    ----------
    task : LiftedTask
    K : ndarray, shape (nu, n)
        In units of the task; projected onto its affine subspace first, and inside its box.
    iterations : int
        Most Newton steps in the gains.
    gap : float
        Where to end, relative to η²; at the last of the search's own gaps at the latest.
    eta : float or None
        An η that the gains are known to have.
    """
    law = task.law
    family = task.family(K)
    whole = Barrier(family, task.graph.edges, len(task.graph.paths), task.box.reshape(-1), law.K0, law.N)
    unit = family.scaling.eta_unit
    known = [] if eta is None else [_ABOVE * (eta / unit) ** 2]
    at: Place | None = None
    before: Barrier | None = None
    for barrier in (whole.single(), whole) if whole.paths > 1 else (whole,):
        theta = task.free(K) if at is None else at.theta
        spread = None if at is None or before is None else _spread(before, at, barrier)
        start = spread or _first(barrier, family, theta, [*known, *_LIMITS])
        if start is None:
            continue
        at, before = start if spread else _lowered(barrier, start), barrier
        for level in _GAPS:
            t = barrier.degree / (level * at.cost)
            at = _centred(barrier, at, t) or at
            yield _reached(task, at, unit, level)
            for place, _ in zip(_descent(barrier, at, t, max(0.1 * level, _FINEST)), range(_STEPS), strict=False):
                at = place
                yield _reached(task, at, unit, level)
                iterations -= 1
                if iterations <= 0:
                    return
            if level <= gap:
                break


def _spread(single: Barrier, at: Place, whole: Barrier) -> Place | None:
    """Return the place of one storage for all, well inside, as one of the same storage for each path."""
    at = _centred(single, at, single.degree / (_INSIDE * at.cost)) or at
    mode = {int(k): e for e, (_, _, k) in enumerate(single.edges)}
    mu = at.mu[[mode[int(k)] for k in whole.edges[:, 2]]] if len(at.mu) else at.mu
    place = at._replace(P=np.repeat(at.P, whole.paths, axis=0), mu=mu)
    return place if whole.holds(place) else None


def _reached(task: LiftedTask, at: Place, unit: float, gap: float) -> Reached:
    return Reached(Iterate(task.point(at.theta), float(np.sqrt(at.cost)) * unit), gap)


def _first(barrier: Barrier, family: Family, theta: Matrix, limits: list[float]) -> Place | None:
    """Return a feasible place for given gains below a limit of η²."""
    N, P = family.N, np.zeros((family.N, family.N))
    for L in family.at(theta):
        F, H = L[:N, :N], L[N : N + family.ny, :N]
        F = F * min(1.0, _STABLE / max(float(np.max(np.abs(np.linalg.eigvals(F)))), np.finfo(float).tiny))
        P += solve_discrete_lyapunov(F.T, 0.1 * np.eye(N) + H.T @ H) / len(family.base)
    mu = np.ones(len(barrier.edges)) if family.p else np.zeros(0)
    start = Place(np.tile(3.0 * P, (barrier.paths, 1, 1)), 0.0, mu, theta)
    places = (_feasible(barrier, start, limit, _FEASIBILITY) for limit in limits)
    return next((place for place in places if place is not None), None)


def _feasible(barrier: Barrier, at: Place, eta2: float, steps: int) -> Place | None:
    """Return a feasible place of the given η² for the gains of a place; None where none was found."""
    there = at._replace(cost=eta2)
    if barrier.holds(there):
        return there
    asking = barrier.asking(eta2)
    lowest = float(np.min(np.linalg.eigvalsh(asking.matrices(at._replace(cost=0.0)))))
    here = at._replace(cost=1.2 * max(-lowest, 0.0) + 1e-3)
    t = 3.0 * barrier.degree / here.cost
    for _ in range(steps):
        moved = asking.descended(here, t)
        if moved is None:
            return None
        here, decrement = moved
        if here.cost < 0.0:
            return here._replace(cost=eta2)
        if decrement < 1.0:
            if here.cost > 1.5 * barrier.degree / t:  # the least τ is positive
                return None
            t *= 10.0
    return None


def _lowered(barrier: Barrier, at: Place) -> Place:
    """Return a place centred at the first gap, its η² brought down for the gains it has."""
    gap = _LOOSE
    while True:
        before = at.cost
        at = _centred(barrier, at, barrier.degree / (gap * at.cost), 0.5) or at
        if gap <= _GAPS[0] and at.cost > 0.9 * before:
            return at
        if at.cost > 0.5 * before:
            gap = max(gap / 4.0, _GAPS[0])


def _centred(barrier: Barrier, at: Place, t: float, enough: float = _CENTRED) -> Place | None:
    """Return the minimum of f for the gains of a place; None where rounding or patience ends too early."""
    last = np.inf
    for _ in range(_CENTRINGS):
        moved = barrier.descended(at, t)
        if moved is None:
            break
        at, decrement = moved
        if decrement < enough or (decrement < 0.5 * _ROUNDED and decrement > 0.5 * last):
            return at
        last = decrement
    return at if last < _ROUNDED else None


def _descent(barrier: Barrier, at: Place, t: float, tolerance: float) -> Iterator[Place]:
    """Yield places of falling φ_t by Newton steps in the gains, until a step promises less than the tolerance."""
    value, length, idle = barrier.value(at, t), 1.0, 0
    while at.theta.size and idle < _PATIENCE:
        step = barrier.newton(at, t, gains=True)
        if step is None or step.decrement < tolerance * t * at.cost:
            return
        for _ in range(_ATTEMPTS):
            there = _tried(barrier, at, barrier.moved(at, step.direction, length), t)
            fall = _SUFFICIENT * length * step.decrement
            if there is not None and barrier.value(there, t) < value - fall:
                break
            length *= _BACK
        else:
            return
        reached = barrier.value(there, t)
        idle = idle + 1 if value - reached < _FINEST * t * there.cost else 0
        at, value, length = there, reached, min(1.0, length / _BACK)
        yield at


def _tried(barrier: Barrier, at: Place, moved: Place, t: float) -> Place | None:
    """Return the centred place for the gains of a trial, starting from its storages or from those before."""
    if not barrier.holds(moved):
        near = moved._replace(P=at.P, mu=at.mu)
        feasible = _feasible(barrier, near, _ROOM * at.cost, _REPAIR)
        if feasible is None:
            return None
        moved = feasible
    return _centred(barrier, moved, t)
