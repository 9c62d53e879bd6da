"""Quasi-Newton descent on η(K): BFGS with the line search of Lewis and Overton (2013).

η(K) is smooth almost everywhere and has kinks; their weak Wolfe conditions, found by bisection and doubling, let BFGS
run through them. Gains without a finite η count as +∞, so a step never leaves the feasible set.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple, Protocol

import numpy as np

from gains.model import Matrix
from gains.steady import Law

__all__ = ["Iterate", "Point", "Problem", "Progress", "Step", "bfgs", "quasi_newton"]

_ARMIJO = 1e-4
_CURVATURE = 0.5
_MAX_TRIALS = 20  # of one line search
_FIRST_STEP = 0.1  # length of the first trial step
_FLAT = 1e-8  # predicted decrease under which a line search ends: the solver's own accuracy
_PATIENCE = 3  # iterations of little progress before the end
_BARRIERS = (1e-2, 1e-3, 1e-4)  # weights of the logarithmic barrier of the box, in turn


class Iterate(NamedTuple):
    """Gains that a method reached, in the task's units, and their η."""

    K: Matrix
    eta: float


class Step(NamedTuple):
    """One step of a design, as progress shows it and history keeps it.

    Attributes
    ----------
    method : str
        "start", "widen", or the method.
    iteration : int
        From 1 in each method.
    share : float
        1, or how far the delays are widened: then η is that of the easier problem.
    eta : float
        η, weighted; by the solver, not yet verified.
    gains : ndarray, shape (nu, nx + nr)
        [K1, K2].
    """

    method: str
    iteration: int
    share: float
    eta: float
    gains: Matrix


Progress = Callable[[Step], None]


class Slope(Protocol):
    """η at some gains and d(log η)/dK̂."""

    @property
    def eta(self) -> float:
        """η."""
        ...

    @property
    def gradient(self) -> Matrix:
        """d(log η)/dK̂, shape (nu, n)."""
        ...


class Problem(Protocol):
    """What the descent asks of a design problem: :class:`gains.task.Task`, :class:`gains.lifted_task.LiftedTask`."""

    @property
    def law(self) -> Law:
        """The affine subspace of K̂."""
        ...

    @property
    def box(self) -> Matrix:
        """Bounds on the entries of K̂."""
        ...

    def inside(self, K: Matrix) -> bool:
        """Whether K̂ is strictly inside its box."""
        ...

    def free(self, K: Matrix) -> Matrix:
        """Return the coordinates of K̂."""
        ...

    def point(self, theta: Matrix) -> Matrix:
        """Return K̂ at the given coordinates."""
        ...

    def gain(self, K: Matrix) -> Slope | None:
        """Return η and its gradient; None where η is not finite."""
        ...


class Point(NamedTuple):
    """A point of the descent: coordinates, value, gradient."""

    x: Matrix
    value: float
    gradient: Matrix


Function = Callable[[Matrix], "Point | None"]


def quasi_newton(task: Problem, K: Matrix, iterations: int, tolerance: float = 2e-6) -> Iterator[Iterate]:
    """Yield gains of falling η, from gains inside the box whose η is finite.

    With a box, log η − κ Σ log(1 − (K/box)²) is minimised for falling κ; an iterate may then raise η.

    Parameters
    ----------
    task : Problem
    K : ndarray, shape (nu, n)
        Projected onto the task's affine subspace first.
    iterations : int
    tolerance : float
        Relative decrease of η under which an iteration counts as little progress.
    """
    boxed = bool(np.any(np.isfinite(task.box)))
    theta = task.free(K)
    for barrier in _BARRIERS if boxed else (0.0,):
        seen: dict[bytes, Slope] = {}

        def function(x: Matrix, barrier: float = barrier, seen: dict[bytes, Slope] = seen) -> Point | None:
            K = task.point(x)
            found = task.gain(K) if task.inside(K) else None
            if found is None:
                return None
            seen[x.tobytes()] = found
            ratio = K / task.box
            value = float(np.log(found.eta) - barrier * np.sum(np.log1p(-(ratio**2))))
            slope = found.gradient + barrier * 2.0 * ratio / task.box / (1.0 - ratio**2)
            return Point(x, value, task.law.N.T @ slope.reshape(-1))

        for point in bfgs(function, theta, iterations, tolerance):
            theta = point.x
            yield Iterate(task.point(theta), seen[theta.tobytes()].eta)
            seen.clear()


def bfgs(function: Function, x: Matrix, iterations: int, tolerance: float) -> Iterator[Point]:
    """Yield the points of a BFGS descent, each of smaller value than the one before.

    Parameters
    ----------
    function : callable
        Point at given coordinates; None where the value is +∞.
    x : ndarray, shape (k,)
        Start; nothing is yielded if its value is +∞.
    iterations : int
    tolerance : float
        Absolute decrease under which an iteration counts as little progress.
    """
    here = function(x)
    if here is None or not x.size:
        return
    H = _first_metric(here)
    fresh, idle = True, 0
    for _ in range(iterations):
        direction = -H @ here.gradient
        if not here.gradient @ direction < 0.0:
            H, fresh = _first_metric(here), True
            direction = -H @ here.gradient
        there = _line_search(function, here, direction)
        if there is None:
            if fresh:
                return
            H, fresh = _first_metric(here), True
            continue
        step, change = there.x - here.x, there.gradient - here.gradient
        curvature = float(step @ change)
        if curvature > 0.0:
            if fresh:
                H, fresh = np.eye(x.size) * curvature / float(change @ change), False
            V = np.eye(x.size) - np.outer(step, change) / curvature
            H = V @ H @ V.T + np.outer(step, step) / curvature
        idle = idle + 1 if here.value - there.value < tolerance else 0
        here = there
        yield here
        if idle >= _PATIENCE:
            return


def _first_metric(point: Point) -> Matrix:
    length = max(float(np.linalg.norm(point.gradient)), np.finfo(float).tiny)
    return np.eye(point.x.size) * (_FIRST_STEP / length)


def _line_search(function: Function, here: Point, direction: Matrix) -> Point | None:
    """Return a point that meets the weak Wolfe conditions, else the last one that met the first; None if none did."""
    slope = float(here.gradient @ direction)
    low, high, t = 0.0, np.inf, 1.0
    best: Point | None = None
    for _ in range(_MAX_TRIALS):
        there = function(here.x + t * direction)
        if there is None or not there.value < here.value + _ARMIJO * t * slope:
            high = t
        else:
            best = there
            if there.gradient @ direction >= _CURVATURE * slope:
                return best
            low = t
        t = (low + high) / 2 if high < np.inf else 2.0 * low
        if t * -slope < _FLAT:
            break
    return best
