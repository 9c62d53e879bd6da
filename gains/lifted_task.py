"""The design problem on the lifted form (section 5): the loop of Eq. (9), affine in K, and η with its gradient.

The slots hold s = K1 x itself, one row for each input, so that every matrix of every mode is affine in K = [K1, K2].
One mode's matrices stand in one stack

    L_k(K) = [F G U; H Hv 0; J Jv 0],    ζ(k+1) = F ζ + G v + U p,  e = H ζ + Hv v,  q = J ζ + Jv v,  p = Δ q.

K̂ is in the units of :class:`gains.task.Task`, whose affine subspace (zero error for constant r) and box are shared.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from gains.balance import Scaling
from gains.bounded_real import Answer, balanced, least_eta
from gains.model import Gains, Matrix, Model, read_only
from gains.sdp import Status
from gains.steady import Law
from gains.switched import Graph, Switched, Transitions, eq9, graph
from gains.task import Task, task

__all__ = ["Family", "LiftedGain", "LiftedTask", "lifted_task"]

_ROUGH = 1e-4  # an "almost" solved program guides the search where its gap and residual are this small; no proof


class LiftedGain(NamedTuple):
    """η at some gains and its gradient.

    Attributes
    ----------
    eta : float
    gradient : ndarray, shape (nu, n)
        d(log η)/dK̂.
    answer : Answer
        The storages and duals behind them, in the units of the model.
    """

    eta: float
    gradient: Matrix
    answer: Answer


@dataclass(frozen=True, slots=True, eq=False)
class Family:
    """L_k(θ) = base_k + Σ θ_a slopes_ka in balanced units, θ the coordinates of K̂ in its affine subspace.

    Attributes
    ----------
    base : ndarray, shape (modes, N + ny + q, N + m + p)
    slopes : ndarray, shape (modes, free numbers, N + ny + q, N + m + p)
    N, m, p, ny, q : int
        Entries of ζ, v, Δ's output, e and Δ's input.
    scaling : Scaling
        The units.
    """

    base: Matrix
    slopes: Matrix
    N: int
    m: int
    p: int
    ny: int
    q: int
    scaling: Scaling

    def at(self, theta: Matrix) -> Matrix:
        """Return L of every mode."""
        return np.asarray(self.base + np.tensordot(theta, self.slopes, axes=(0, 1)), dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class LiftedTask:
    """Find K̂ that makes η of the switched loop small.

    Attributes
    ----------
    model : Model
    window : tuple of int
        d_min and d_max.
    delta_max : float
    units : Task
        The subspace, the box and the units of K̂; its inequality is not used.
    shape : Switched
        Modes and dimensions; its matrices are those of some gains.
    graph : Graph
    base : ndarray, shape (modes, N + ny + q, N + m + p)
        L without feedback, in the units of the model.
    entries : ndarray, shape (modes, nu n, N + ny + q, N + m + p)
        dL/dK, entries of K by rows.
    tolerance : float
        Of the solver, relative.
    """

    model: Model
    window: tuple[int, int]
    delta_max: float
    units: Task
    shape: Switched
    graph: Graph
    base: Matrix
    entries: Matrix
    tolerance: float = 1e-7

    def __post_init__(self) -> None:
        for name in ("base", "entries"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    @property
    def law(self) -> Law:
        """The affine subspace, in units of K̂."""
        return self.units.law

    @property
    def box(self) -> Matrix:
        """Bounds on the entries' size, in units of K̂."""
        return self.units.box

    def inside(self, K: Matrix) -> bool:
        """Whether K̂ is strictly inside its box."""
        return self.units.inside(K)

    def free(self, K: Matrix) -> Matrix:
        """Return the coordinates of K̂ in the affine subspace, after projection onto it."""
        return self.units.free(K)

    def point(self, theta: Matrix) -> Matrix:
        """Return K̂ at the given coordinates."""
        return self.units.point(theta)

    def given(self, K: Matrix) -> Matrix:
        """Return K̂ in the units of the model."""
        return self.units.given(K)

    def own(self, K: Matrix) -> Matrix:
        """Return K of the model's units in those of the task."""
        return self.units.own(K)

    def balanced(self, K: Matrix) -> LiftedTask:
        """Return the same problem in the units of the loop closed by K (of the model's units, as given)."""
        return replace(self, units=self.units.balanced(K))

    def stacks(self, K: Matrix) -> Matrix:
        """Return L of every mode at K, in the units of the model."""
        return np.asarray(self.base + np.tensordot(K.reshape(-1), self.entries, axes=(0, 1)), dtype=np.float64)

    def loop(self, K: Matrix) -> Switched:
        """Return the switched loop at K, in the units of the model."""
        L, N, m, ny = self.stacks(K), self.shape.N, self.shape.m, self.model.ny
        e, q = slice(N, N + ny), slice(N + ny, None)
        v = slice(N, N + m)
        return replace(
            self.shape,
            F=L[:, :N, :N],
            G=L[:, :N, v],
            H=L[:, e, :N],
            Hv=L[:, e, v],
            U=L[0, :N, N + m :],
            J=L[:, q, :N],
            Jv=L[:, q, v],
        )

    def gain(self, K: Matrix) -> LiftedGain | None:
        """Return the least η that the storages prove at K̂, with its gradient; None if they prove none.

        With Z the duals of the transitions, ∂η²/∂F_i = 2 Σ_j P_j [F G U]_i Z_ij, ∂η²/∂H_i = 2 [H Hv 0]_i Σ_j Z_ij,
        ∂η²/∂J_i = 2 Σ_j μ_ij [J Jv 0]_i Z_ij.
        """
        given = self.given(K)
        answer = least_eta(self.loop(given), self.graph, self.tolerance)
        usable = answer.status is Status.OPTIMAL or (answer.status is Status.INACCURATE and answer.accuracy < _ROUGH)
        if not (usable and answer.value > 0.0):
            return None
        slope = self._slope(given, answer) * self.units.U[:, None] / self.units.T
        return LiftedGain(answer.value, slope / (2.0 * answer.value**2), answer)

    def _slope(self, K: Matrix, answer: Answer) -> Matrix:
        """Return ∂η²/∂K, in the units of the model."""
        N, ny = self.shape.N, self.model.ny
        _, after, mode = self.graph.edges.T
        scaled = self.stacks(K)[mode]
        scaled[:, :N] = answer.P[after] @ scaled[:, :N]
        scaled[:, N + ny :] *= answer.mu[:, None, None]
        to_L = 2.0 * scaled @ answer.duals
        slope = np.einsum("ers,ekrs->k", to_L, self.entries[mode])
        return np.asarray(slope.reshape(K.shape), dtype=np.float64)

    def family(self, K: Matrix) -> Family:
        """Return L as a function of θ, in units balanced at K̂."""
        _, scaling = balanced(self.loop(self.given(K)))
        N, m, p = self.shape.N, self.shape.m, self.shape.U.shape[1]
        ny, q = self.model.ny, self.shape.J.shape[1]
        t = np.diag(scaling.T)
        rows = np.concatenate([t, np.full(ny, scaling.e_unit), np.full(q, scaling.p_unit)])
        columns = np.concatenate([t, np.full(m, scaling.v_unit), np.full(p, scaling.p_unit)])
        to_units = columns / rows[:, None]
        back = (self.units.U[:, None] / self.units.T).reshape(-1)  # K = back · K̂
        base = self.base + np.tensordot(back * self.law.K0, self.entries, axes=(0, 1))
        slopes = np.tensordot(back[:, None] * self.law.N, self.entries, axes=(0, 1)).swapaxes(0, 1)
        return Family(base * to_units, slopes * to_units, N, m, p, ny, q, scaling)


def lifted_task(
    model: Model,
    d_min: int,
    d_max: int,
    delta_max: float,
    law: Law,
    box: Matrix,
    *,
    transitions: Transitions = "any",
    memory: int = 0,
) -> LiftedTask:
    """Return the design problem of a model, in units balanced without feedback.

    Parameters
    ----------
    model : Model
    d_min, d_max : int
    delta_max : float
        Bound on ‖Δ‖; 0 takes the nominal model.
    law : Law
    box : ndarray, shape (nu, nx + nr)
        Bounds on the entries of K; inf where there is none.
    transitions : {"any", "fifo"}
    memory : int
        Past delays that a storage knows.
    """
    K2 = None if model.reference is None else np.zeros((model.nu, model.nr))
    silent = Gains(model.name, model, d_min, d_max, np.zeros((model.nu, model.nx)), K2)
    modes = eq9(silent, d_min, d_max, delta_max)
    base, entries = _affine(model, d_max, delta_max, [mode.d for mode in modes.modes])
    size = model.nx + model.nu * d_max + model.nr
    blank = np.zeros((len(modes.modes), size, size))
    U = np.zeros((size, base.shape[2] - size - modes.m))
    shape = replace(modes, F=blank, U=U)
    units = task(model, d_min, d_max, delta_max, law, box)
    return LiftedTask(
        model, (d_min, d_max), delta_max, units, shape, graph(modes, silent, transitions, memory), base, entries
    )


def _affine(model: Model, d_max: int, delta_max: float, delays: list[int]) -> tuple[Matrix, Matrix]:
    """Return L without feedback, and dL/dK, of each delay."""
    nx, nu, nr, nw, ny = model.nx, model.nu, model.nr, model.nw, model.ny
    reference, uncertainty = model.reference, model.uncertainty if delta_max > 0.0 else None
    N, n = nx + nu * d_max + nr, nx + nr
    m = nw + (0 if reference is None else int(reference.Br.shape[1]))
    p, q = (0, 0) if uncertainty is None else (uncertainty.F.shape[1], uncertainty.J1.shape[0])
    xr = slice(N - nr, N)
    input_ = np.zeros((N + ny + q, nu))  # what u adds to the rows
    input_[:nx], input_[N : N + ny] = model.B, model.D
    fixed = np.zeros((N + ny + q, N + m + p))
    fixed[:nx, :nx], fixed[:nx, N : N + nw], fixed[N : N + ny, :nx] = model.A, model.E, model.C
    moved = np.arange(nx + nu, nx + nu * d_max)
    fixed[moved, moved - nu] = 1.0
    if reference is not None:
        fixed[xr, xr], fixed[xr, N + nw : N + m], fixed[N : N + ny, xr] = reference.Ar, reference.Br, -reference.Cr
    if uncertainty is not None:
        input_[N + ny :], fixed[N + ny :, :nx] = uncertainty.J2, uncertainty.J1
        fixed[:nx, N + m :] = delta_max * uncertainty.F
    base = np.repeat(fixed[None], len(delays), axis=0)
    entries = np.zeros((len(delays), nu, n, *fixed.shape))
    i, x, r = np.arange(nu)[:, None], np.arange(nx), np.arange(nr)
    entries[:, i, x, nx + i, x] = 1.0 if d_max else 0.0  # s = K1 x enters the first slot
    for k, d in enumerate(delays):
        if d == 0:
            entries[k][:, x, :, x] += input_.T
        else:
            base[k][:, nx + (d - 1) * nu : nx + d * nu] += input_
        entries[k][:, nx + r, :, N - nr + r] += input_.T
    return base, entries.reshape(len(delays), nu * n, *fixed.shape)
