"""Analysis of given gains by Lyapunov–Krasovskii functionals: η, stability, the largest delay, and dη²/dK.

Lemma 1 in Jensen form; with uncertainty its S-procedure. A solver proposes P, Q, R; :mod:`gains.verify` alone
makes a verdict of them. The conditions are sufficient: where they fail the verdict is "undecided".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from gains import lmi
from gains.lmi import Block, Blocks, Weights
from gains.model import Gains, Matrix, augmented, spectral_radius
from gains.proof import (
    INTERIOR,
    Analysis,
    Question,
    Verdict,
    ask,
    infeasible,
    interior,
    positive,
    proof,
    remaining_effect,
    variables,
)
from gains.sdp import Backend, Program, Solution, Status, Variable, solve

__all__ = [
    "Analysis",
    "Bound",
    "Verdict",
    "constant_radius",
    "eta",
    "gradient",
    "largest_constant_d",
    "largest_d_max",
    "remaining_effect",
    "stability",
]

# relative, of η²: how far from an optimum that is not attained a proof is sought
_RELAX = (1e-4, 1e-3, 1e-2, 1e-1, 1.0)
_EDGE = 1e-9  # a spectral radius within this of 1 is neither below nor above


@dataclass(frozen=True, slots=True, eq=False)
class Bound:
    """The largest window that a method proves.

    Attributes
    ----------
    d_max : int or None
        None if not even [d_min, d_min] is proved.
    analysis : Analysis or None
        The proof at ``d_max``; None for the exact method of constant delays.
    refuted : tuple of int and float, or None
        (d, growth per sample) of the first constant delay that diverges; exact method only.
    """

    d_max: int | None
    analysis: Analysis | None
    refuted: tuple[int, float] | None = None


def eta(gains: Gains, d_min: int, d_max: int, delta_max: float = 0.0, *, backend: Backend = "clarabel") -> Analysis:
    """Return the least η that Lemma 1 proves for given gains, robust against ‖Δ‖ ≤ delta_max.

    Without disturbance and reference (v empty) stability alone is asked.

    Parameters
    ----------
    gains : Gains
        Its own window is not used.
    d_min, d_max : int
        0 ≤ d_min ≤ d_max, d_max ≥ 1.
    delta_max : float
        0 for the nominal model; otherwise the model has an uncertainty.
    backend : {"clarabel", "cvxpy"}
    """
    question = ask(gains, d_min, d_max, delta_max)
    if question.original.B.shape[1] == 0:
        return _stability(question, backend)
    solution = solve(*_least_eta(question), backend)
    dual = _dual(question, solution)
    if solution.status in (Status.OPTIMAL, Status.INACCURATE):
        found = proof(question, solution, eta="least")
        value = float(solution.values["eta2"][0, 0])
        for relax in _RELAX:
            if found.verdict == "stable" or not (math.isfinite(value) and value > 0.0):
                break
            centred = solve(*_centred(question, value * (1.0 + relax)), backend)
            found = proof(question, centred, eta="least", before=found)
        if found.verdict == "stable":
            return replace(found, dual=dual, status=solution.status)
    return _without_eta(question, solution, backend)


def stability(
    gains: Gains, d_min: int, d_max: int, delta_max: float = 0.0, *, backend: Backend = "clarabel"
) -> Analysis:
    """Return whether Lemma 1 without its last row, Eq. (22), proves stability; parameters as in :func:`eta`."""
    return _stability(ask(gains, d_min, d_max, delta_max), backend)


def largest_d_max(gains: Gains, d_min: int, limit: int, delta_max: float = 0.0) -> Bound:
    """Return the largest d_max ≤ limit with stability proved on [d_min, d_max].

    Lemma 1 is monotone in d_max (the same P, Q, R prove every narrower window), so that a doubling search and
    bisection find it.
    """
    best: Analysis | None = None
    low, high, stride = max(d_min, 1) - 1, limit + 1, 1
    while low + 1 < high:
        middle = min(low + stride, high - 1) if stride else (low + high) // 2
        found = stability(gains, d_min, middle, delta_max)
        if found.verdict == "stable":
            best, low, stride = found, middle, 2 * stride
        else:
            high, stride = middle, 0
    return Bound(None if best is None else low, best)


def largest_constant_d(gains: Gains, d_min: int, limit: int) -> Bound:
    """Return the largest d ≤ limit such that every constant delay in [d_min, d] is stable: exact."""
    best: int | None = None
    for d in range(d_min, limit + 1):
        radius = constant_radius(gains, d)
        if radius >= 1.0 - _EDGE:
            return Bound(best, None, (d, radius) if radius > 1.0 + _EDGE else None)
        best = d
    return Bound(best, None)


def constant_radius(gains: Gains, d: int) -> float:
    """Return the spectral radius of x(k+1) = A x(k) + B K1 x(k−d) over [x(k), s(k−1), …, s(k−d)], s = K1 x."""
    model, K1 = gains.model, gains.K1
    nx, nu = model.nx, model.nu
    if d == 0:
        return spectral_radius(model.A + model.B @ K1)
    companion = np.zeros((nx + nu * d, nx + nu * d))
    companion[:nx, :nx], companion[:nx, -nu:] = model.A, model.B
    companion[nx : nx + nu, :nx] = K1
    companion[nx + nu :, nx:-nu] = np.eye(nu * (d - 1))
    return spectral_radius(companion)


def gradient(gains: Gains, analysis: Analysis) -> tuple[Matrix, Matrix | None]:
    """Return dη²/dK1 and dη²/dK2 at an optimum of :func:`eta`, from the dual of its inequality.

    With M the left side of the S-procedure form, z⁺ = G ζ, z⁺ − z = H ζ, e = Ce ζ, q = J ζ, ζ = (z, z_d, v, p):
    dη² = ⟨Z, dM⟩ = 2 ⟨(P G + d_max R H) Z, dG⟩ + 2 ⟨Ce Z, dCe⟩ + 2 μ ⟨J Z, dJ⟩, P, Q, R and μ being stationary.

    Returns
    -------
    dK1 : ndarray, shape (nu, nx)
    dK2 : ndarray or None, shape (nu, nr)
    """
    certificate, Z = analysis.certificate, analysis.dual
    assert certificate is not None, "no optimum, no gradient"
    assert Z is not None
    model, loop = gains.model, augmented(gains.model, gains.K1, gains.K2)
    n, nx, N = loop.n, model.nx, Z.shape[0]
    rest = N - 2 * n - loop.B.shape[1]
    G = np.hstack([loop.A, loop.A1, loop.B, certificate.delta_max * loop.F[:, :rest]])
    H = G - np.eye(n, N)
    pad = np.zeros((1, N - 2 * n))
    Ce = np.hstack([loop.C, loop.C1, np.repeat(pad, model.ny, axis=0)])
    step = 2.0 * (certificate.P @ G + certificate.d_max * (certificate.R @ H)) @ Z
    into = model.B.T @ step[:nx] + model.D.T @ (2.0 * Ce @ Z)
    if model.uncertainty is not None and rest:
        J = np.hstack([loop.J1, loop.J2, np.repeat(pad, loop.J1.shape[0], axis=0)])
        into = into + model.uncertainty.J2.T @ (2.0 * certificate.mu * J @ Z)
    return into[:, n : n + nx], None if gains.K2 is None else into[:, nx:n]


# -- statements for the solver, balanced coordinates


def _least_eta(question: Question) -> tuple[dict[str, Variable], Callable[[Mapping[str, Block]], Program]]:
    """State: minimise η² subject to Lemma 1."""

    def statement(x: Mapping[str, Block]) -> Program:
        M = interior(_lemma1(question, x, x["eta2"]), INTERIOR)
        return Program(x["eta2"], [M], positive(x, INTERIOR))

    return variables(question, "eta2"), statement


def _centred(question: Question, eta2: float) -> tuple[dict[str, Variable], Callable[[Mapping[str, Block]], Program]]:
    """State: at a given η², go as far inside Lemma 1 as possible."""

    def statement(x: Mapping[str, Block]) -> Program:
        M = interior(_lemma1(question, x, eta2), x["t"])
        return Program(-x["t"], [M], positive(x, x["t"]))

    return variables(question, "t"), statement


def _most_stable(question: Question) -> tuple[dict[str, Variable], Callable[[Mapping[str, Block]], Program]]:
    """State: with P, Q, R bounded, go as far inside the stability condition (22) as possible; t > 0 is a proof."""

    def statement(x: Mapping[str, Block]) -> Program:
        M = interior(_lemma1(question, x, None), x["t"])
        one = np.eye(question.original.n)
        return Program(-x["t"], [M], [*positive(x, x["t"]), *(one - x[name] for name in "PQR")])

    return variables(question, "t"), statement


def _lemma1(question: Question, x: Mapping[str, Block], eta2: Block | None) -> Blocks:
    weights = Weights(x["P"], x["Q"], x["R"])
    if question.uncertain is not None:
        return lmi.s_procedure(question.system, question.uncertain, weights, x["mu"], eta2, question.window)
    if eta2 is None:
        return lmi.stability(question.system, weights, question.window)
    return lmi.jensen(question.system, weights, eta2, question.window)


# -- from solutions to verdicts


def _stability(question: Question, backend: Backend) -> Analysis:
    solution = solve(*_most_stable(question), backend)
    found = proof(question, solution, eta=None)
    if found.verdict == "undecided" and solution.status is Status.OPTIMAL:
        if float(solution.values["t"][0, 0]) > _EDGE:
            return replace(found, reason="the solver found a proof that does not verify")
        return replace(found, reason=infeasible(question))
    return found


def _without_eta(question: Question, solution: Solution, backend: Backend) -> Analysis:
    """Return what is left where no η was proved: stability, or the reason why not even that."""
    found = _stability(question, backend)
    reason = found.reason
    if found.verdict == "stable":
        reason = f"stable, but no eta was proved: the solver ended {solution.status.value}"
    return replace(
        found,
        reason=reason,
        setup_s=found.setup_s + solution.setup_s,
        solver_s=found.solver_s + solution.solver_s,
    )


def _dual(question: Question, solution: Solution) -> Matrix | None:
    if not np.isfinite(solution.duals[0]).all():
        return None
    return question.scaling.dual(solution.duals[0], question.original.B.shape[1])
