"""Sequential inner convexification on the lifted form: every iterate is feasible, η falls monotonically.

For a transition i → j the bounded-real inequality is, with λ = 1/μ,

    [[−diag(P_i, η² I), [F G]', [H Hv]', [J Jv]'], [·, −P_j⁻¹ + λ U U', 0, 0], [·, ·, −I, 0], [·, ·, ·, −λ I]] ≺ 0,

linear in everything but P_j⁻¹, and −P_j⁻¹ ⪯ −(2 S0 − S0 P_j S0) with S0 = P0_j⁻¹. K1 stands in the row that computes s
and K2 in the row of x; for d = 0 K1 stands there as well. Every storage is stated in coordinates where P0 = I.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from gains import sdp
from gains.convexify import roots
from gains.lifted_task import Family, LiftedGain, LiftedTask
from gains.lmi import Block, Blocks
from gains.model import Matrix
from gains.quasinewton import Iterate

__all__ = ["lifted_convexification"]


def lifted_convexification(task: LiftedTask, K: Matrix, iterations: int, tolerance: float = 1e-4) -> Iterator[Iterate]:
    """Yield gains of falling η, from gains inside the box whose η is finite.

    Parameters
    ----------
    task : LiftedTask
    K : ndarray, shape (nu, n)
        On the task's affine subspace.
    iterations : int
    tolerance : float
        Relative decrease of η under which the method ends.
    """
    here = task.gain(K)
    for _ in range(iterations):
        if here is None:
            return
        K = _step(task, K, here)
        there = task.gain(K) if np.all(np.isfinite(K)) else None
        if there is None or not there.eta < here.eta:
            return
        yield Iterate(K, there.eta)
        if there.eta > (1.0 - tolerance) * here.eta:
            return
        here = there


def _step(task: LiftedTask, K: Matrix, at: LiftedGain) -> Matrix:
    """Return the gains that minimise η over the inner approximation at P0; NaN where the solver fails."""
    family, paths = task.family(K), len(task.graph.paths)
    t = np.diag(family.scaling.T)
    P0 = at.answer.P * t * t[:, None] / family.scaling.e_unit**2
    factors = [roots(P) for P in P0]
    variables = {f"P{i}": sdp.Variable(family.N, family.N, symmetric=True) for i in range(paths)}
    variables |= {"eta2": sdp.Variable(), "theta": sdp.Variable(task.law.N.shape[1], 1)}
    if family.p:
        variables |= {f"lam{e}": sdp.Variable() for e in range(len(task.graph.edges))}

    def statement(v: Mapping[str, Block]) -> sdp.Program:
        stacks = [_stack(family, v["theta"], mode) for mode in range(len(family.base))]
        blocks = [
            _transition(family, stacks[k], v, (i, j, e), factors)
            for e, (i, j, k) in enumerate(task.graph.edges.tolist())
        ]
        positive = [v[name] for name in variables if name.startswith(("P", "lam"))]
        return sdp.Program(v["eta2"], blocks, [*positive, *task.units.room(task.units.gains(v["theta"]))])

    solution = sdp.solve(variables, statement)
    return np.asarray(task.units.gains(solution.values["theta"]), dtype=np.float64)


def _stack(family: Family, theta: Block, mode: int) -> Block:
    """Return [F G; H Hv; J Jv] of a mode as an expression in θ."""
    columns = family.N + family.m
    total: Block = family.base[mode][:, :columns]
    for row, slope in zip(np.eye(family.slopes.shape[1]), family.slopes[mode], strict=True):
        total = total + (row[None] @ theta) * slope[:, :columns]
    return total


def _transition(
    family: Family,
    stack: Block,
    v: Mapping[str, Block],
    edge: tuple[int, int, int],
    factors: list[tuple[Matrix, Matrix]],
) -> Blocks:
    """Return the convex inequality of one transition, in coordinates where both storages are I at the start."""
    i, j, e = edge
    N, ny, m = family.N, family.ny, family.m
    rows = np.eye(N + ny + family.q)
    into = np.zeros((N + m, N + m))
    into[:N, :N], into[N:, N:] = factors[i][1], np.eye(m)
    step = factors[j][0] @ rows[:N] @ stack @ into
    output, right = rows[N : N + ny] @ stack @ into, rows[N + ny :] @ stack @ into
    above, below = np.eye(N, N + m), np.eye(m, N + m, N)
    own = above.T @ v[f"P{i}"] @ above + v["eta2"] * (below.T @ below)
    next_ = 2.0 * np.eye(N) - v[f"P{j}"]
    if not family.p:
        zero = np.zeros((N, ny))
        return [[-own, step.T, output.T], [step, -next_, zero], [output, zero.T, -np.eye(ny)]]
    lam, pushed = v[f"lam{e}"], factors[j][0] @ family.base[0][:N, N + m :]
    return [
        [-own, step.T, output.T, right.T],
        [step, lam * (pushed @ pushed.T) - next_, np.zeros((N, ny)), np.zeros((N, family.q))],
        [output, np.zeros((ny, N)), -np.eye(ny), np.zeros((ny, family.q))],
        [right, np.zeros((family.q, N)), np.zeros((family.q, ny)), -lam * np.eye(family.q)],
    ]
