"""Cone complementarity linearisation, the paper's Algorithm 1, on the corrected or on the printed inequality.

S and L stand for P⁻¹ and R⁻¹ with Eq. (41); tr(S_i P + P_i S + L_i R + R_i L) falls towards 4 (nx + nr), Eq. (42). The
iteration stops when the gains found prove η by the inequality for given gains, never by the trace alone. η is bisected.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from gains import lmi, sdp
from gains.lmi import Block, Blocks, Slack, Weights
from gains.model import Matrix
from gains.quasinewton import Iterate
from gains.task import Task

__all__ = ["Inequality", "as_printed", "complementarity", "corrected"]

_BISECTION = 0.9  # ratio of neighbouring targets of η at the end
_FIRST = 0.5  # first target, relative to the η reached
_MAX_HALVINGS = 8


@dataclass(frozen=True, slots=True)
class Inequality:
    """An inequality in P, Q, R, S, L, K for the iteration, and the η that given gains have by it.

    Attributes
    ----------
    blocks : callable
        (task, K, weights, slack, S, L, λ, η²) to blocks that shall be negative definite.
    eta : callable
        (task, K) to η, None where the inequality proves none.
    slack : bool
        Whether the inequality has Y, W, U.
    """

    blocks: Callable[[Task, Block, Weights, Slack | None, Block, Block, Block, Block], Blocks]
    eta: Callable[[Task, Matrix], float | None]
    slack: bool


def complementarity(
    task: Task, inequality: Inequality, iterations: int, start: Matrix | None = None
) -> Iterator[Iterate]:
    """Yield gains of falling η: one for each target of the bisection that was reached.

    Parameters
    ----------
    task : Task
    inequality : Inequality
    iterations : int
        Most iterations of Algorithm 1 for one target.
    start : ndarray or None, shape (nu, n)
        Gains whose η is the first to be improved on; without them the first target is found by trying.
    """
    reached = None if start is None else inequality.eta(task, start)
    if reached is None:
        reached = yield from _first(task, inequality, iterations)
        if reached is None:
            return
    low, high = 0.0, reached
    target = _FIRST * high
    for _ in range(_MAX_HALVINGS):
        found = _algorithm_1(task, inequality, target, iterations)
        if found is None:
            low = target
        else:
            yield found
            high = found.eta
        if low > _BISECTION * high:
            return
        target = (low + high) / 2 if low > 0.0 else _FIRST * high


def _first(task: Task, inequality: Inequality, iterations: int) -> Generator[Iterate, None, float | None]:
    """Yield the first gains reached, the target growing from the unit of η, and return their η."""
    target = task.eta_unit
    for _ in range(_MAX_HALVINGS):
        found = _algorithm_1(task, inequality, target, iterations)
        if found is not None:
            yield found
            return found.eta
        target *= 4.0
    return None


def _algorithm_1(task: Task, inequality: Inequality, target: float, iterations: int) -> Iterate | None:
    """Return gains with η at most the target; None where none were found in so many iterations."""
    n = task.n
    at = dict.fromkeys("PRSL", np.eye(n))
    eta2 = (target / task.eta_unit) ** 2
    for _ in range(iterations):
        solution = sdp.solve(_variables(task, inequality), _statement(task, inequality, dict(at), eta2))
        if solution.status not in (sdp.Status.OPTIMAL, sdp.Status.INACCURATE):
            return None
        K = np.asarray(task.gains(solution.values["theta"]), dtype=np.float64)
        eta = inequality.eta(task, K)
        if eta is not None and eta <= target:
            return Iterate(K, eta)
        at = {name: solution.values[name] for name in at}
    return None


def _variables(task: Task, inequality: Inequality) -> dict[str, sdp.Variable]:
    n = task.n
    variables = {name: sdp.Variable(n, n, symmetric=True) for name in "PQRSL"}
    variables["theta"] = sdp.Variable(task.law.N.shape[1], 1)
    if task.robust:
        variables["lam"] = sdp.Variable()
    if inequality.slack:
        variables |= {"Y": sdp.Variable(n, n), "W": sdp.Variable(n, n), "U": sdp.Variable(task.m, n)}
    return variables


def _statement(task: Task, inequality: Inequality, at: Mapping[str, Matrix], eta2: float) -> sdp.Statement:
    """State: minimise the linearised trace under the inequality and (41)."""

    def statement(v: Mapping[str, Block]) -> sdp.Program:
        K = task.gains(v["theta"])
        slack = Slack(v["Y"], v["W"], v["U"]) if inequality.slack else None
        lam = v["lam"] if task.robust else 0.0
        weights = Weights(v["P"], v["Q"], v["R"])
        blocks = inequality.blocks(task, K, weights, slack, v["S"], v["L"], lam, eta2)
        cost = _trace(at["S"], v["P"]) + _trace(at["P"], v["S"]) + _trace(at["L"], v["R"]) + _trace(at["R"], v["L"])
        complementary = [lmi.eq41(v["P"], v["S"]), lmi.eq41(v["R"], v["L"])]
        return sdp.Program(cost, [blocks, *complementary], [v["Q"], *task.room(K)])

    return statement


def _trace(weight: Matrix, X: Block) -> Block:
    """Return tr(weight X), shape (1, 1)."""
    total: Block = np.zeros((1, 1))
    for row, unit in zip(weight, np.eye(weight.shape[0]), strict=True):
        total = row[None, :] @ X @ unit[:, None] + total
    return total


def _corrected(
    task: Task, K: Block, weights: Weights, slack: Slack | None, S: Block, L: Block, lam: Block, eta2: Block
) -> Blocks:
    system, window = task.system(K), task.window
    if task.robust:
        return lmi.corrected_robust(system, task.uncertain(K), weights, slack, S, L, lam, eta2, window)
    return lmi.corrected(system, weights, slack, S, L, eta2, window)


def _printed(
    task: Task, K: Block, weights: Weights, slack: Slack | None, S: Block, L: Block, lam: Block, eta2: Block
) -> Blocks:
    assert slack is not None
    system, window = task.system(K), task.window
    if task.robust:
        return lmi.eq40(system, task.uncertain(K), weights, slack, S, L, lam, eta2, window)
    return lmi.eq31(system, weights, slack, S, L, eta2, window)


def corrected() -> Inequality:
    """Return the corrected Theorem 1, tested by Lemma 1 itself."""

    def eta(task: Task, K: Matrix) -> float | None:
        found = task.gain(K)
        return None if found is None else found.eta

    return Inequality(_corrected, eta, slack=False)


def as_printed(eta: Callable[[Task, Matrix], float | None]) -> Inequality:
    """Return Lemma 2 or Theorem 1 as printed, with a test for given gains."""
    return Inequality(_printed, eta, slack=True)
