"""Quadratic forms that fall: one P ≻ 0 with F_i'P F_i ⪯ γ²P for every i, or one for each node of a graph, γ least.

γ bounds the growth per sample of every product of the matrices, in any order; with P⁺ of the next node on the left, of
every product along the graph. It is found by bisection, each trial one semidefinite program. For one P a trial is made
in coordinates in which the best so far is the identity, and takes up only the matrices that bind. What is returned has
been evaluated, not believed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from gains.bounded_real import storages
from gains.extremal import in_forms
from gains.lmi import Block, Blocks
from gains.model import Matrix, spectral_radius
from gains.sdp import Program, Statement, Variable, solve
from gains.switched import Graph, Key, Mode, Switched

__all__ = ["Quadratic", "common_quadratic", "lyapunov_quadratic", "node_quadratics"]

_DOUBLINGS = 30  # (1 − 1e-8)^(2^30) is below the rounding
_SOLVES = 60  # more than any bisection and the joining of matrices has needed


class Quadratic(NamedTuple):
    """Quadratic forms and how fast they fall.

    Attributes
    ----------
    P : ndarray, shape (1 or nodes, n, n)
        P ≻ 0.
    rate : float
        The largest ‖P⁺^½ F_i P^−½‖, as computed.
    solves : int
        Semidefinite programs solved.
    """

    P: Matrix
    rate: float
    solves: int


def lyapunov_quadratic(F: Matrix) -> Quadratic | None:
    """Return a form for one matrix from the Lyapunov equation F'P F/γ² − P = −I, γ = (1 + ρ(F))/2; None if ρ ≥ 1.

    P = Σ (F/γ)^k'(F/γ)^k, twice as many terms at a time.

    Parameters
    ----------
    F : ndarray, shape (n, n)
    """
    radius = spectral_radius(F)
    if radius >= 1.0:
        return None
    units = _units(F[None])
    power, P = 2.0 / (1.0 + radius) * F / units[:, None] * units[None, :], np.eye(len(F))
    for _ in range(_DOUBLINGS):
        P = P + power.T @ P @ power
        power = power @ power
    try:
        S = np.linalg.cholesky(P).T / units[None, :] if np.isfinite(P).all() else None
    except np.linalg.LinAlgError:
        S = None
    if S is None:
        return None
    return Quadratic(_form(S)[None], float(_rates(F[None], S)[0]), 0)


def common_quadratic(F: Matrix, tolerance: float = 1e-3) -> Quadratic:
    """Return the form with the least common rate, to within a relative ``tolerance`` of it.

    Parameters
    ----------
    F : ndarray, shape (modes, n, n)
    tolerance : float
    """
    S = np.diag(1.0 / _units(F))
    rates = _rates(F, S)
    low = max(spectral_radius(matrix) for matrix in F)
    high = float(rates.max())
    active = {int(np.argmax(rates))}
    solves = 0
    while high > (1.0 + tolerance) * low and high > 0.0 and solves < _SOLVES and F.shape[1] > 1:
        trial = math.sqrt(max(low, high / 4.0) * high)
        chosen = sorted(active)
        better = _falling(_in_form(F[chosen], S), trial)
        solves += 1
        if better is None:
            low = trial
            continue
        factor = better @ S
        rates = _rates(F, factor)
        worst = int(np.argmax(rates))
        if rates[worst] < high:
            S, high = factor / np.max(np.abs(factor)), float(rates[worst])
        if rates[worst] > trial and worst in active:
            low = trial  # the solver could not make good what it promised
        active.add(worst)
    return Quadratic(_form(S)[None], high, solves)


def node_quadratics(F: Matrix, edges: NDArray[np.intp], low: float, high: float, trials: int) -> Quadratic | None:
    """Return one form for each node, of a rate below ``high``; None where none was found.

    The first trial is at ``low``: where that succeeds it is the last.

    Parameters
    ----------
    F : ndarray, shape (matrices, n, n)
    edges : ndarray of int, shape (edges, 3)
        (node, next node, matrix of the sample between).
    low, high : float
    trials : int
        Semidefinite programs at most.
    """
    best, trial = None, low
    walks = Graph(tuple((Key(i),) for i in range(int(edges[:, :2].max()) + 1)), edges)
    for solves in range(1, trials + 1):
        answer = storages(_silent(F / trial), walks)
        P = (answer.P + answer.P.transpose(0, 2, 1)) / 2
        rate = _rate(F, edges, P)
        if rate < high:
            best, high = Quadratic(P / np.max(np.abs(P)), rate, solves), rate
        if high < low:
            break
        low = trial if rate > trial else low
        trial = math.sqrt(low * high)
    return best if best is None else best._replace(solves=solves)


def _silent(F: Matrix) -> Switched:
    """Return a loop without input and output."""
    count, n, _ = F.shape
    rows, columns = np.zeros((count, 0, n)), np.zeros((count, n, 0))
    none = np.zeros((count, 0, 0))
    modes = tuple(Mode(a) for a in range(count))
    return Switched(modes, F, columns, rows, none, np.zeros((n, 0)), rows, none, nx=n, nr=0)


def _rate(F: Matrix, edges: NDArray[np.intp], P: Matrix) -> float:
    """Return the largest norm along an edge; infinite where P is no set of forms."""
    try:
        return float(np.linalg.norm(in_forms(F, edges, P), 2, axis=(1, 2)).max())
    except np.linalg.LinAlgError:
        return math.inf


def _falling(F: Matrix, rate: float) -> Matrix | None:
    """Return upper-triangular S with S'S = P ⪯ I that maximises −t in F_i'P F_i − rate² P ⪯ t I; None if t ≥ 0."""
    n = F.shape[1]
    identity = np.eye(n)

    def statement(variables: Mapping[str, Block]) -> Program:
        P, t = variables["P"], variables["t"]
        falls: list[Blocks] = [[[matrix.T @ P @ matrix - rate**2 * P - t * identity]] for matrix in F]
        return Program(t, [*falls, [[P - identity]]])

    stated: Statement = statement
    solution = solve({"P": Variable(n, n, True), "t": Variable()}, stated)
    P, t = solution.values["P"], float(solution.values["t"][0, 0])
    if not (np.isfinite(P).all() and t < -1e-8 * rate**2):
        return None
    try:
        return np.asarray(np.linalg.cholesky((P + P.T) / 2).T, dtype=np.float64)
    except np.linalg.LinAlgError:
        return None


def _units(F: Matrix) -> Matrix:
    """Return powers of two t that balance max_i |F_i|: LAPACK's balancing of diag(t)⁻¹ F diag(t)."""
    largest = np.max(np.abs(F), axis=0)
    np.fill_diagonal(largest, 0.0)
    _, _, _, scale, _ = lapack.dgebal(largest, scale=1, permute=0)
    return np.asarray(scale, dtype=np.float64)


def _in_form(F: Matrix, S: Matrix) -> Matrix:
    """Return S F_i S⁻¹: the matrices in the coordinates in which S'S is the identity."""
    return np.asarray(np.linalg.solve(S.T, (S @ F).transpose(0, 2, 1)).transpose(0, 2, 1), dtype=np.float64)


def _rates(F: Matrix, S: Matrix) -> Matrix:
    """Return ‖S F_i S⁻¹‖; infinite where numbers are too far apart to tell."""
    with np.errstate(over="ignore", invalid="ignore"):
        turned = _in_form(F, S)
    finite = np.isfinite(turned).all(axis=(1, 2))
    rates = np.full(len(F), np.inf)
    rates[finite] = np.linalg.norm(turned[finite], 2, axis=(1, 2))
    return rates


def _form(S: Matrix) -> Matrix:
    """Return S'S, exactly symmetric, with its largest diagonal entry near 1 by a power of two."""
    P = S.T @ S
    P = (P + P.T) / 2
    return np.asarray(P * np.exp2(-np.rint(np.log2(np.max(np.diag(P))))), dtype=np.float64)
