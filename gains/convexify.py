"""Sequential inner convexification of the corrected Theorem 1: every iterate is feasible, η falls monotonically.

The inverses in the corrected inequality are the only terms that are not linear in (P, Q, R, K). At any P0, R0
−P⁻¹ ⪯ −(2 S0 − S0 P S0) with S0 = P0⁻¹, and likewise −R⁻¹: the inequality with the right sides is convex, implies the
true one, and agrees with it at P0, R0. Each program is stated in coordinates where P0 = I, its rows of H multiplied by
R0^½ and those of G by P0^½; without that the solver breaks down.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from gains import lmi, sdp
from gains.lmi import Block, Weights
from gains.model import Matrix
from gains.quasinewton import Iterate
from gains.task import Gain, Task

__all__ = ["convexification", "roots"]

_FLOOR = 1e-10  # smallest eigenvalue of a storage taken, relative to the largest


def convexification(task: Task, K: Matrix, iterations: int, tolerance: float = 1e-4) -> Iterator[Iterate]:
    """Yield gains of falling η, from gains inside the box whose η is finite.

    Parameters
    ----------
    task : Task
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
        K = _step(task, here)
        there = task.gain(K) if np.all(np.isfinite(K)) else None
        if there is None or not there.eta < here.eta:
            return
        yield Iterate(K, there.eta)
        if there.eta > (1.0 - tolerance) * here.eta:
            return
        here = there


def _step(task: Task, at: Gain) -> Matrix:
    """Return the gains that minimise η over the inner approximation at P0, R0; NaN where the solver fails."""
    n, eye = task.n, np.eye(task.n)
    P_root, P_inverse = roots(at.weights.P)
    R_root, R_inverse = roots(at.weights.R)
    left = [P_inverse, P_inverse, np.eye(task.m), R_root, P_root, np.eye(task.C0.shape[0])]
    left += [np.eye(task.J0.shape[0])] if task.robust else []

    def statement(v: Mapping[str, Block]) -> sdp.Program:
        K = task.gains(v["theta"])
        weights = Weights(P_root @ v["P"] @ P_root, P_root @ v["Q"] @ P_root, R_root @ v["R"] @ R_root)
        S = P_inverse @ (2.0 * eye - v["P"]) @ P_inverse
        L = R_inverse @ (2.0 * eye - v["R"]) @ R_inverse
        if task.robust:
            blocks = lmi.corrected_robust(
                task.system(K), task.uncertain(K), weights, None, S, L, v["lam"], v["eta2"], task.window
            )
        else:
            blocks = lmi.corrected(task.system(K), weights, None, S, L, v["eta2"], task.window)
        scaled = [
            [a @ block @ b for b, block in zip(left, row, strict=True)] for a, row in zip(left, blocks, strict=True)
        ]
        return sdp.Program(v["eta2"], [scaled], [v["P"], v["Q"], v["R"], *task.room(K)])

    variables = {name: sdp.Variable(n, n, symmetric=True) for name in ("P", "Q", "R")}
    variables |= {"eta2": sdp.Variable(), "theta": sdp.Variable(task.law.N.shape[1], 1)}
    if task.robust:
        variables["lam"] = sdp.Variable()
    solution = sdp.solve(variables, statement)
    return np.asarray(task.gains(solution.values["theta"]), dtype=np.float64)


def roots(X: Matrix) -> tuple[Matrix, Matrix]:
    """Return X^½ and X^−½."""
    values, vectors = np.linalg.eigh((X + X.T) / 2)
    values = np.sqrt(np.maximum(values, _FLOOR * values[-1]))
    return (vectors * values) @ vectors.T, (vectors / values) @ vectors.T
