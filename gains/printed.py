"""Lemma 2 and Theorem 1 as printed, Eqs. (31) and (40), for given gains: answered with the reason.

The printed conditions require A'PA + (A+A1)'P(A+A1) ≺ P: they are infeasible whenever ρ(A) ≥ 1, or for given
gains whenever ρ(A⊗A + (A+A1)⊗(A+A1)) ≥ 1, and then no solver is asked.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from gains import lmi
from gains.lmi import Block, Slack, Weights
from gains.model import Augmented, Gains, Matrix, augmented, spectral_radius
from gains.proof import INTERIOR, NUDGE, Analysis, Question, ask, interior, positive, proof, variables
from gains.sdp import Backend, Program, Solution, Status, Variable, solve

__all__ = ["Obstacle", "eta", "necessary_radius", "obstacle"]


@dataclass(frozen=True, slots=True, eq=False)
class Obstacle:
    """Why (31), and so (40), has no solution, whatever P, Q, R and, for an eigenvector, whatever gains.

    Attributes
    ----------
    eigenvalue : complex or None
        λ with A x = λ x, |λ| ≥ 1: with ξ = (x, x, 0, 0) the form ξ*(31)ξ is a sum of terms ≥ 0.
    vector : ndarray or None, shape (n,)
        x.
    radius : float
        ρ(A⊗A + (A+A1)⊗(A+A1)); below 1 is necessary.
    """

    eigenvalue: complex | None
    vector: np.ndarray[tuple[int], np.dtype[np.complex128]] | None
    radius: float

    @property
    def reason(self) -> str:
        """One sentence for people."""
        if self.eigenvalue is not None:
            return (
                f"the printed condition is infeasible for every choice of gains: A has an eigenvalue of modulus "
                f"{abs(self.eigenvalue):.6g} >= 1, whose vector x makes (31) nonnegative along (x, x, 0, 0)"
            )
        return (
            f"the printed condition is infeasible for these gains: it needs the spectral radius of "
            f"A(x)A + (A+A1)(x)(A+A1) below 1, found {self.radius:.4g}"
        )


def obstacle(gains: Gains) -> Obstacle | None:
    """Return what makes the printed conditions infeasible, or None where they may be feasible."""
    loop = augmented(gains.model, gains.K1, gains.K2)
    radius = necessary_radius(loop)
    values, vectors = np.linalg.eig(gains.model.A)
    largest = int(np.argmax(np.abs(values)))
    if abs(values[largest]) >= 1.0:
        x = np.zeros(loop.n, dtype=np.complex128)
        x[: gains.model.nx] = vectors[:, largest]
        return Obstacle(complex(values[largest]), x, radius)
    return Obstacle(None, None, radius) if radius >= 1.0 else None


def necessary_radius(loop: Augmented) -> float:
    """Return ρ(A⊗A + (A+A1)⊗(A+A1)): A'PA + (A+A1)'P(A+A1) ≺ P has a solution P ≻ 0 where it is below 1."""
    closed: Matrix = loop.A + loop.A1
    return spectral_radius(np.kron(loop.A, loop.A) + np.kron(closed, closed))


def eta(gains: Gains, d_min: int, d_max: int, delta_max: float = 0.0, *, backend: Backend = "clarabel") -> Analysis:
    """Return the least η that Lemma 2, or Theorem 1 with uncertainty, proves as printed for given gains.

    A solution proves Lemma 1 with 2P, Q, R, as 2‖A z + q‖² ≤ ‖2A z + q‖² + ‖q‖² for the two rows that carry P:
    that is the certificate.
    """
    blocked = obstacle(gains)
    if blocked is not None:
        return Analysis("undecided", None, None, None, blocked.reason, Status.INFEASIBLE)
    question = ask(gains, d_min, d_max, delta_max)
    n, m = question.original.n, question.original.B.shape[1]
    if m == 0:
        reason = "the printed condition bounds a gain, and the model has neither disturbance nor reference"
        return Analysis("undecided", None, None, None, reason, Status.FAILED)

    def statement(x: Mapping[str, Block]) -> Program:
        weights, slack = Weights(x["P"], x["Q"], x["R"]), Slack(x["Y"], x["W"], x["U"])
        if question.uncertain is None:
            M = lmi.eq31_given(question.system, weights, slack, x["eta2"], question.window)
        else:
            M = lmi.eq40_given(question.system, question.uncertain, weights, slack, x["mu"], x["eta2"], question.window)
        return Program(x["eta2"], [interior(M, INTERIOR)], positive(x, INTERIOR))

    free = {"Y": Variable(n, n), "W": Variable(n, n), "U": Variable(m, n)}
    solution = solve(variables(question, "eta2") | free, statement, backend)
    if solution.status not in (Status.OPTIMAL, Status.INACCURATE):
        reason = f"the printed condition has no solution that the solver found ({solution.status.value})"
        found = Analysis("undecided", None, None, None, reason, solution.status)
        return replace(found, setup_s=solution.setup_s, solver_s=solution.solver_s)
    value = float(solution.values["eta2"][0, 0])
    bound = math.sqrt(max(value, 0.0)) * question.scaling.eta_unit * (1.0 + NUDGE)
    return _lemma1_of(question, solution, bound)


def _lemma1_of(question: Question, solution: Solution, bound: float) -> Analysis:
    """Return the proof of Lemma 1 by 2P, Q, R; with uncertainty one μ of three merged: the best of a grid."""
    values = dict(solution.values) | {"P": 2.0 * solution.values["P"]}
    best = proof(question, replace(solution, values=values), bound, method="printed")
    for factor in np.geomspace(0.03, 30.0, 31) if "mu" in values else ():
        if best.verdict == "stable":
            break
        tried = values | {"mu": factor * values["mu"]}
        best = proof(question, replace(solution, values=tried), bound, method="printed")
    return best
