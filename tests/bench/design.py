"""A design for delays 1 to 6 against the same evaluations of η and its gradient written plainly in cvxpy.

The plain way takes minutes, so it is counted: the seconds of one plain evaluation, measured in this run (full-size
storages, one ``cvxpy.Problem`` for each, Clarabel), times the accepted steps of our search. A quasi-Newton descent
takes another number of evaluations, more than its accepted steps: the count stands in for it.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from gains.design import design
from gains.lifted_task import lifted_task
from gains.steady import every_law
from gains.store import load_model

D_MAX = 6
LIMIT = 0.25


def measure() -> list[tuple[str, float, float, str]]:
    """Return (what, ratio, limit, note)."""
    model = load_model("hirm-printed")
    begun = time.perf_counter()
    found = design(model, 1, D_MAX, steady_state="free")
    ours = time.perf_counter() - begun
    assert found.gains is not None, found.reason
    assert found.gains.K2 is not None
    evaluations = sum(step.method == "interior-point" for step in found.history)
    box = np.full((model.nu, model.nx + model.nr), np.inf)
    problem = lifted_task(model, 1, D_MAX, 0.0, every_law(model), box)
    loop = problem.loop(np.hstack([found.gains.K1, found.gains.K2]))
    begun = time.perf_counter()
    eta = _plain(loop, problem.graph)
    plain = (time.perf_counter() - begun) * evaluations
    note = f"eta {found.eta:.4f} in {ours:.1f} s; cvxpy {plain:.0f} s in {evaluations} evaluations (eta {eta:.4f})"
    return [("design for delays 1 to 6 / plain cvxpy", ours / plain, LIMIT, note)]


def _plain(loop: Any, graph: Any) -> float:
    """Return η, stated in cvxpy and solved by Clarabel; the duals are read as a gradient needs them."""
    import cvxpy

    P = [cvxpy.Variable((loop.N, loop.N), symmetric=True) for _ in graph.paths]
    eta2 = cvxpy.Variable()
    limits = [X >> 1e-7 * np.eye(loop.N) for X in P]
    above, below = np.eye(loop.N, loop.N + loop.m), np.eye(loop.m, loop.N + loop.m, loop.N)
    for i, j, k in graph.edges:
        M, H = np.hstack([loop.F[k], loop.G[k]]), np.hstack([loop.H[k], loop.Hv[k]])
        own = above.T @ P[i] @ above + eta2 * (below.T @ below)
        limits.append(own - M.T @ P[j] @ M - H.T @ H >> 0)
    problem = cvxpy.Problem(cvxpy.Minimize(eta2), limits)
    problem.solve(solver=cvxpy.CLARABEL)
    assert all(limit.dual_value is not None for limit in limits)
    return float(np.sqrt(problem.value))
