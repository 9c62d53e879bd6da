"""A question about given gains, put to a solver in balanced coordinates, and its answer, verified.

What the analyses have in common: the loop and its scaling, the variables P, Q, R, μ, and the way from what a
solver proposes to a verdict, which :mod:`gains.verify` alone decides.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from gains.balance import Scaling, balance, scaled
from gains.certificate import Certificate
from gains.lmi import Block, Blocks, System, Uncertain, Weights, Window
from gains.model import Augmented, Gains, Matrix, Model, augmented
from gains.sdp import Solution, Status, Variable
from gains.verify import Verification, check, least_eta

__all__ = [
    "INTERIOR",
    "NUDGE",
    "Analysis",
    "Question",
    "Verdict",
    "ask",
    "infeasible",
    "interior",
    "positive",
    "proof",
    "remaining_effect",
    "variables",
]

Verdict = Literal["stable", "undecided"]

INTERIOR = 1e-7  # distance kept from the cones' boundary, balanced units: what strictness costs in η̂²
NUDGE = 1e-6  # relative, of η: from the infimum that P, Q, R prove to a strict inequality


@dataclass(frozen=True, slots=True, eq=False)
class Analysis:
    """What was found out about given gains in a window of delays.

    Attributes
    ----------
    verdict : {"stable", "undecided"}
        "stable" only with a verified certificate.
    eta : float or None
        Verified: ‖e‖₂ < η ‖v‖₂ (12). None if undecided, or if only stability is proved.
    certificate : Certificate or None
    verification : Verification or None
        Of the certificate, or of the one that failed.
    reason : str
        Why undecided, or why without η; empty otherwise.
    status : Status
        Of the last solve.
    dual : ndarray or None
        Z ⪰ 0 over (z, z_d, v, p) in the model's units: a change dM of the inequality's left side at fixed P, Q,
        R, μ changes the optimal η² by ⟨Z, dM⟩, to first order; its v block has trace 1. See :func:`gradient`.
    setup_s, solver_s : float
        Wall time outside and inside the solver; verification belongs to neither.
    """

    verdict: Verdict
    eta: float | None
    certificate: Certificate | None
    verification: Verification | None
    reason: str
    status: Status
    dual: Matrix | None = None
    setup_s: float = 0.0
    solver_s: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Question:
    """Gains, a window and an uncertainty, in balanced coordinates."""

    gains: Gains
    window: Window
    delta_max: float
    original: Augmented
    system: System
    uncertain: Uncertain | None
    scaling: Scaling


def ask(gains: Gains, d_min: int, d_max: int, delta_max: float) -> Question:
    """Return the question in balanced coordinates."""
    assert 0 <= d_min <= d_max, (d_min, d_max)
    assert d_max >= 1
    assert delta_max == 0.0 or gains.model.uncertainty is not None
    loop = augmented(gains.model, gains.K1, gains.K2)
    uncertain = Uncertain(delta_max * loop.F, loop.J1, loop.J2) if delta_max > 0.0 else None
    if uncertain is None:
        n = loop.n
        scaling = balance(loop, np.zeros((n, 0)), np.zeros((0, n)), np.zeros((0, n)))
    else:
        scaling = balance(loop, *uncertain)
    system, uncertain = scaled(loop, uncertain, scaling)
    return Question(gains, Window(d_min, d_max), delta_max, loop, system, uncertain, scaling)


def variables(question: Question, *scalars: str) -> dict[str, Variable]:
    """Return P, Q, R, with uncertainty μ, and the numbers of the given names."""
    n = question.original.n
    names = {name: Variable(n, n, symmetric=True) for name in "PQR"}
    if question.uncertain is not None:
        names["mu"] = Variable()
    return names | {name: Variable() for name in scalars}


def interior(blocks: Blocks, distance: Block) -> Blocks:
    """Return the blocks of M + distance·I."""
    return [
        [block + distance * np.eye(block.shape[0]) if i == j else block for j, block in enumerate(row)]
        for i, row in enumerate(blocks)
    ]


def positive(x: Mapping[str, Block], floor: Block) -> list[Block]:
    """Return P − floor·I, Q − floor·I, R − floor·I and the multiplier μ if there is one."""
    limits = [x[name] - floor * np.eye(x[name].shape[0]) for name in "PQR"]
    return [*limits, x["mu"]] if "mu" in x else limits


def proof(
    question: Question,
    solution: Solution,
    eta: float | Literal["least"] | None,
    *,
    method: str = "lyapunov",
    before: Analysis | None = None,
) -> Analysis:
    """Return the verdict on the P, Q, R of a solution: undo the scaling, find the least η, verify.

    Parameters
    ----------
    question : Question
    solution : Solution
        With the values of P, Q, R and, with uncertainty, of μ; its status decides nothing.
    eta : float, "least" or None
        The η to prove; "least" for the infimum that P, Q, R prove, a little raised; None for stability.
    method : str
        As in :class:`~gains.certificate.Certificate`.
    before : Analysis or None
        An attempt whose time counts too.
    """
    setup_s = solution.setup_s + (0.0 if before is None else before.setup_s)
    solver_s = solution.solver_s + (0.0 if before is None else before.solver_s)
    x = solution.values
    undecided = Analysis("undecided", None, None, None, "", solution.status, None, setup_s, solver_s)
    if not all(np.isfinite(x[name]).all() for name in x):
        return replace(undecided, reason=f"the solver gave up ({solution.detail})")
    P, Q, R = question.scaling.weights(Weights(x["P"], x["Q"], x["R"]))
    mu = question.scaling.mu(float(x["mu"][0, 0])) if "mu" in x else 0.0
    window = question.window
    value = question.scaling.eta_unit if eta == "least" else eta  # any η serves to find the least one
    certificate = Certificate(method, "any", window.d_min, window.d_max, question.delta_max, value, P, Q, R, mu)
    if eta == "least":
        least = least_eta(question.gains, certificate)
        if not math.isfinite(least):
            return replace(undecided, reason="the solver's P, Q, R do not satisfy the inequality")
        certificate = replace(certificate, eta=max(least, 1e-9 * question.scaling.eta_unit) * (1.0 + NUDGE))
    verification = check(question.gains, certificate)
    if not verification.passed:
        return replace(undecided, verification=verification, reason=verification.reason)
    return replace(undecided, verdict="stable", eta=certificate.eta, certificate=certificate, verification=verification)


def remaining_effect(model: Model, delta_max: float) -> float:
    """Return the least share of its effect that an input keeps: min over i, ‖Δ‖ ≤ δ of b'(b + FΔJ2 e)/b'b, b = B e.

    In closed form 1 − δ ‖F'b‖ ‖J2 e‖ / ‖b‖² for each input e; 1 without uncertainty.
    """
    if model.uncertainty is None:
        return 1.0
    F, J2, B = model.uncertainty.F, model.uncertainty.J2, model.B
    loss = np.linalg.norm(F.T @ B, axis=0) * np.linalg.norm(J2, axis=0)
    size = np.maximum(np.sum(B**2, axis=0), np.finfo(np.float64).tiny)
    return float(np.min(1.0 - delta_max * loss / size))


def infeasible(question: Question) -> str:
    """Return the reason where the condition has no solution, in one sentence for people."""
    window = f"delays {question.window.d_min} to {question.window.d_max}"
    reason = f"Lemma 1, a sufficient condition, is infeasible for these gains and {window}"
    if question.delta_max > 0.0:
        share = remaining_effect(question.gains.model, question.delta_max)
        reason += f" with ||Delta|| <= {question.delta_max:g}, where an input may keep only {share:.1%} of its effect"
        reason += " (other gains may do)"
    return reason
