"""The gain of the switched loop from above: the bounded-real inequality per transition, one storage per path.

For every transition i → j of a :class:`~gains.switched.Graph` and the mode taken there

    [F G U]'P_j[F G U] + [H Hv 0]'[H Hv 0] + μ [J Jv 0]'[J Jv 0] − diag(P_i, η² I, μ I) ≺ 0.

Exact for storages ζ'P ζ that know the present delay and the last M before it, hence an upper bound on the gain that
tightens with M. The program is assembled sparse: a mode's operator X ↦ M'XM is computed once and placed for each of its
transitions. Everything is solved in balanced units and returned in those of the loop given.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from gains.balance import Scaling, balance
from gains.model import Augmented, Matrix
from gains.proof import INTERIOR
from gains.sdp import Cones, Raw, Status, packing, solve_cones
from gains.switched import Graph, Switched

__all__ = ["Answer", "balanced", "centred", "least_eta", "storages"]


class Answer(NamedTuple):
    """What the solver proposes, in the units of the loop.

    Attributes
    ----------
    status : Status
    value : float
        η of :func:`least_eta`; the margin t of :func:`storages` and :func:`centred`, in balanced units.
    P : ndarray, shape (paths, N, N)
    mu : ndarray, shape (edges,)
        Zeros where there is no uncertainty.
    duals : ndarray, shape (edges, S, S)
        Z ⪰ 0 of every transition, S = N + m + rows of Δ: dη² = Σ ⟨Z, dM⟩ for a change dM of the left sides.
    accuracy : float
        Relative gap or residual, whichever is larger.
    solver_s : float
    detail : str
        The solver's own word for the status.
    """

    status: Status
    value: float
    P: Matrix
    mu: Matrix
    duals: Matrix
    accuracy: float
    solver_s: float
    detail: str


def least_eta(switched: Switched, graph: Graph, tolerance: float = 1e-8) -> Answer:
    """Minimise η² over the storages and multipliers.

    Parameters
    ----------
    switched : Switched
    graph : Graph
    tolerance : float
        Of the solver, relative; a search can do with less than a proof.
    """
    loop, scaling = balanced(switched)
    program = _assembled(loop, graph, free="eta2", eta2=0.0)
    raw = solve_cones(program, tolerance)
    value = float(np.sqrt(max(raw.x[0], 0.0))) * scaling.eta_unit if np.isfinite(raw.x[0]) else np.nan
    return _answer(loop, graph, raw, scaling, value)


def centred(switched: Switched, graph: Graph, eta: float) -> Answer:
    """Go as far inside the inequalities at a given η as possible; a positive margin is a proof."""
    loop, scaling = balanced(switched)
    program = _assembled(loop, graph, free="margin", eta2=(eta / scaling.eta_unit) ** 2)
    raw = solve_cones(program)
    return _answer(loop, graph, raw, scaling, float(raw.x[0]))


def storages(switched: Switched, graph: Graph) -> Answer:
    """Go as far inside the inequalities without v and e as possible, with P ⪯ I: a positive margin proves stability."""
    silent = replace(
        switched,
        G=switched.G[:, :, :0],
        H=switched.H[:, :0],
        Hv=switched.Hv[:, :0, :0],
        Jv=switched.Jv[:, :, :0],
    )
    loop, scaling = balanced(silent)
    raw = solve_cones(_assembled(loop, graph, free="margin", eta2=0.0, normal=True))
    return _answer(loop, graph, raw, scaling, float(raw.x[0]))


def balanced(switched: Switched) -> tuple[Switched, Scaling]:
    """Return the loop in balanced units, and the units; states are scaled by powers of two, which rounds nothing."""
    N, ny = switched.N, switched.H.shape[1]
    none = np.zeros
    share = np.sqrt(max(1, len(switched.modes)))
    H = switched.H.reshape(-1, N) / share
    loop = Augmented(
        A=np.max(np.abs(switched.F), axis=0),
        A1=none((N, N)),
        B=np.max(np.abs(switched.G), axis=0),
        C=H,
        C1=none(H.shape),
        F=none((N, 0)),
        J1=none((0, N)),
        J2=none((0, N)),
    )
    J = np.sqrt(np.sum(switched.J**2, axis=0) / share**2)
    scaling = balance(loop, switched.U, J, none(J.shape))
    t = np.diag(scaling.T)
    v, e, p = scaling.v_unit, scaling.e_unit, scaling.p_unit
    assert ny == switched.Hv.shape[1]
    return replace(
        switched,
        F=switched.F / t[:, None] * t,
        G=switched.G / t[:, None] * v,
        H=switched.H * t / e,
        Hv=switched.Hv * v / e,
        U=switched.U / t[:, None] * p,
        J=switched.J * t / p,
        Jv=switched.Jv * v / p,
    ), scaling


# -- assembly: x = [η² or margin; μ of every edge; packed P of every path]


@dataclass(slots=True)
class _Rows:
    """Collects the rows of b − A x."""

    entries: list[tuple[NDArray[np.int_], NDArray[np.int_], NDArray[np.float64]]]
    sides: list[NDArray[np.float64]]
    sizes: list[int]
    count: int = 0

    def cone(self, size: int, side: NDArray[np.float64]) -> None:
        self.sides.append(side)
        self.sizes.append(size)
        self.count += len(side)

    def put(self, operator: sparse.coo_matrix, column: int) -> None:
        """Place an operator in the rows of the cone that comes next."""
        row, col = operator.row.astype(np.int_), operator.col.astype(np.int_)
        self.entries.append((row + self.count, col + column, operator.data))


class _Mode(NamedTuple):
    """The operators of one mode: −X ↦ −M'XM, the constant −H'H, and μ's column."""

    step: sparse.coo_matrix
    output: NDArray[np.float64]
    right: sparse.coo_matrix


def _assembled(loop: Switched, graph: Graph, *, free: str, eta2: float, normal: bool = False) -> Cones:
    N, m, p = loop.N, loop.m, loop.U.shape[1]
    S, nP, edges = N + m + p, N * (N + 1) // 2, len(graph.edges)
    first = 1 + (edges if loop.robust else 0)
    margin = free == "margin"
    inputs = np.zeros(S)
    inputs[N : N + m] = 1.0
    fixed = _packed(np.diag(eta2 * inputs)) if margin else _packed(-INTERIOR * np.eye(S))
    slope = _column(-np.eye(S) if margin else np.diag(inputs))
    keep, modes = _operator(np.eye(N, S)), [_mode(loop, i) for i in range(len(loop.modes))]
    rows = _Rows([], [], [])
    for e, (i, j, k) in enumerate(graph.edges):
        # the cone holds diag(P_i, η², μ) − M'P_jM − H'H − μ J'J: A x is its negative
        rows.put(-keep, first + i * nP)
        rows.put(modes[k].step, first + j * nP)
        rows.put(-slope, 0)
        if loop.robust:
            rows.put(modes[k].right, 1 + e)
        rows.cone(S, fixed - modes[k].output)
    own, floor = sparse.identity(nP, format="coo"), _packed(np.eye(N))
    for i in range(len(graph.paths)):
        rows.put(-own, first + i * nP)
        if margin:
            rows.put(_column(np.eye(N)), 0)
        rows.cone(N, np.zeros(nP) if margin else -INTERIOR * floor)
        if normal:
            rows.put(own, first + i * nP)
            rows.cone(N, floor)
    if loop.robust:
        for e in range(edges):
            rows.put(sparse.coo_matrix([[-1.0]]), 1 + e)
            rows.cone(1, np.zeros(1))
    row, column, data = (np.concatenate(part) for part in zip(*rows.entries, strict=True))
    size = first + len(graph.paths) * nP
    q = np.zeros(size)
    q[0] = -1.0 if margin else 1.0
    A = sparse.csc_matrix((data, (row, column)), shape=(rows.count, size))
    return Cones(q, A, np.concatenate(rows.sides), rows.sizes)


def _mode(loop: Switched, k: int) -> _Mode:
    p = loop.U.shape[1]
    H = np.hstack([loop.H[k], loop.Hv[k], np.zeros((loop.H.shape[1], p))])
    J = np.hstack([loop.J[k], loop.Jv[k], np.zeros((loop.J.shape[1], p))])
    multiplier = J.T @ J
    inner = np.arange(loop.N + loop.m, multiplier.shape[0])
    multiplier[inner, inner] -= 1.0
    return _Mode(_operator(np.hstack([loop.F[k], loop.G[k], loop.U])), _packed(H.T @ H), _column(multiplier))


def _operator(M: Matrix) -> sparse.coo_matrix:
    """Return X ↦ M'XM between packed forms, N by S."""
    N, S = M.shape
    rows, row_weight = packing(S)
    columns, column_weight = packing(N)
    a, b = np.divmod(rows, S)
    k, l = np.divmod(columns, N)  # noqa: E741  # the indices of an entry
    T = M[np.ix_(k, a)] * M[np.ix_(l, b)] + M[np.ix_(l, a)] * M[np.ix_(k, b)]
    return sparse.coo_matrix(T.T * row_weight[:, None] / (np.where(k == l, 2.0, column_weight)))


def _packed(X: Matrix) -> NDArray[np.float64]:
    index, weight = packing(X.shape[0])
    return np.asarray(X.reshape(-1)[index] * weight, dtype=np.float64)


def _column(X: Matrix) -> sparse.coo_matrix:
    return sparse.coo_matrix(_packed(X)[:, None])


@lru_cache(maxsize=8)
def _unpacking(N: int) -> Matrix:
    """Return the matrix that turns a packed form into the flat N by N matrix."""
    index, weight = packing(N)
    i, j = np.divmod(index, N)
    spread = np.zeros((N * N, len(index)))
    spread[i * N + j, np.arange(len(index))] = 1.0 / weight
    spread[j * N + i, np.arange(len(index))] = 1.0 / weight
    return spread


def _answer(loop: Switched, graph: Graph, raw: Raw, scaling: Scaling, value: float) -> Answer:
    N, m, edges = loop.N, loop.m, len(graph.edges)
    first = 1 + (edges if loop.robust else 0)
    t = np.diag(scaling.T)
    P = (raw.x[first:].reshape(len(graph.paths), -1) @ _unpacking(N).T).reshape(-1, N, N)
    P = P / t / t[:, None] * scaling.e_unit**2
    mu = raw.x[1:first] * (scaling.e_unit / scaling.p_unit) ** 2 if loop.robust else np.zeros(edges)
    units = np.concatenate([t, np.full(m, scaling.v_unit), np.full(loop.U.shape[1], scaling.p_unit)])
    duals = np.array(raw.duals[:edges]) * units * units[:, None] / scaling.v_unit**2
    return Answer(raw.status, value, P, mu, duals, raw.accuracy, raw.solver_s, raw.detail)
