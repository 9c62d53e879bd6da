"""The inequalities of section 5 as they stand, on the lifting over all past states, in cvxpy with its defaults."""

from __future__ import annotations

from itertools import product

import cvxpy as cp
import numpy as np

from gains.switched import Switched, Transitions

MARGIN = 1e-6  # of the largest entry of P: what makes "stable" strict


def least_eta(full: Switched, transitions: Transitions = "any") -> float:
    """Least η with [F G]'P⁺[F G] + [H Hv]'[H Hv] ⪯ diag(P, η² I) for every transition; infinite without one."""
    eta2 = cp.Variable(nonneg=True)
    P = [cp.Variable((full.N, full.N), PSD=True) for _ in full.modes]
    zero = np.zeros((full.N, full.m))
    limits = []
    for i, j in _pairs(full, transitions):
        step, error = np.hstack([full.F[i], full.G[i]]), np.hstack([full.H[i], full.Hv[i]])
        right = cp.bmat([[P[i], zero], [zero.T, eta2 * np.eye(full.m)]])
        limits.append(_symmetric(right - step.T @ P[j] @ step - error.T @ error) >> 0)
    problem = cp.Problem(cp.Minimize(eta2), limits)
    problem.solve(solver=cp.CLARABEL)
    return float(np.sqrt(problem.value)) if np.isfinite(problem.value) else float("inf")


def stable(full: Switched, transitions: Transitions = "any") -> bool:
    """Whether F'P⁺F ≺ P, 0 ≺ P ⪯ I for every transition: decided by the largest margin t."""
    t = cp.Variable()
    one = np.eye(full.N)
    P = [cp.Variable((full.N, full.N), symmetric=True) for _ in full.modes]
    limits = [_symmetric(P[i] - full.F[i].T @ P[j] @ full.F[i]) >> t * one for i, j in _pairs(full, transitions)]
    limits += [form >> t * one for form in P] + [form << one for form in P]
    problem = cp.Problem(cp.Maximize(t), limits)
    problem.solve(solver=cp.CLARABEL)
    return bool(t.value is not None and t.value > MARGIN)


def _pairs(full: Switched, transitions: Transitions) -> list[tuple[int, int]]:
    d = [mode.d for mode in full.modes]
    return [(i, j) for i, j in product(range(len(d)), repeat=2) if transitions == "any" or d[j] <= d[i] + 1]


def _symmetric(expression: cp.Expression) -> cp.Expression:
    return (expression + expression.T) / 2
