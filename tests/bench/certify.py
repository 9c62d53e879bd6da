"""Certifying given gains, verification included, against the bare Clarabel solve of the same problem.

And the time outside the solver, against stating the same problem in cvxpy each time. Both ways are asked in turn, on
one problem: the printed gains on delays 1 to 3.
"""

from __future__ import annotations

import statistics
import time

from gains import lyapunov, sdp
from gains.proof import ask
from gains.store import load_gains

ROUNDS = 15
LIMIT_SOLVE = 1.5
LIMIT_OUTSIDE = 0.2  # five times smaller


def measure() -> list[tuple[str, float, float, str]]:
    """Return (what, ratio, limit, note) for the whole certification and for what is outside the solver."""
    gains = load_gains("hirm-paper")
    statement = lyapunov._least_eta(ask(gains, 1, 3, 0.0))
    problem = sdp.assemble(*statement)
    whole, bare, outside, built = [], [], [], []
    for _ in range(ROUNDS + 1):
        start = time.perf_counter()
        sdp._run(problem, sdp._settings())
        bare.append(time.perf_counter() - start)
        start = time.perf_counter()
        found = lyapunov.eta(gains, 1, 3)
        whole.append(time.perf_counter() - start)
        assert found.verdict == "stable", found.reason
        outside.append(whole[-1] - found.solver_s)  # balancing, assembly, reading back, verification
        built.append(sdp.solve(*statement, "cvxpy").setup_s)
    certify = statistics.median(w / b for w, b in zip(whole[1:], bare[1:], strict=True))
    assembly = statistics.median(o / b for o, b in zip(outside[1:], built[1:], strict=True))
    note = f"{statistics.median(whole[1:]) * 1e3:.1f} ms, Clarabel {statistics.median(bare[1:]) * 1e3:.1f} ms"
    other = f"{statistics.median(outside[1:]) * 1e3:.2f} ms, cvxpy {statistics.median(built[1:]) * 1e3:.1f} ms"
    return [
        ("certify and verify / bare Clarabel solve", certify, LIMIT_SOLVE, note),
        ("time outside the solver / with cvxpy each time", assembly, LIMIT_OUTSIDE, other),
    ]
