"""The design problem: the loop (10), (11) as an affine function of the gains, and η(K) with its gradient.

K = [K1, K2], shape (nu, n), is free in an affine subspace (zero error for constant r, section 5a) and in a box.
Everything here is in the units of a balanced loop: z = T ẑ, v = v_unit v̂, e = e_unit ê, u = U û, K = U K̂ T⁻¹.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, cast

import numpy as np

from gains import lmi, sdp
from gains.balance import balance
from gains.lmi import Block, System, Uncertain, Weights, Window
from gains.model import Augmented, Matrix, Model, augmented
from gains.proof import INTERIOR, interior, positive
from gains.steady import Law

__all__ = ["Gain", "Task", "task"]

_SYMMETRIC = ("P", "Q", "R")
_STRICT = 1.0 - 1e-6  # share of the box that programs may use
_ROUGH = 1e-4  # an "almost" solved program guides the search where its gap and residual are this small; no proof


class Gain(NamedTuple):
    """η at some gains, its gradient and the matrices that prove it, all in the task's units.

    Attributes
    ----------
    eta : float
    gradient : ndarray, shape (nu, n)
        d(log η)/dK̂.
    weights : Weights
    mu : float
        0 without uncertainty.
    """

    eta: float
    gradient: Matrix
    weights: Weights
    mu: float


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """Find K̂ that makes η small.

    The loop is A = A0 + Bu K̂ Mr, A1 = Bu K̂ Mx, C = C0 + D K̂ Mr, C1 = D K̂ Mx, J̄1 = J0 + J2 K̂ Mr, J̄2 = J2 K̂ Mx,
    where Mx and Mr keep the columns of x and of xr.

    Attributes
    ----------
    A0, Bu, Bv, C0, D, F, J0, J2 : ndarray
        F is scaled by the bound on ‖Δ‖ and has no columns without uncertainty.
    nx : int
    d_min, d_max : float
        Whole numbers, but on the way of :func:`gains.start.widened`.
    law : Law
        The affine subspace, in units of K̂.
    box : ndarray, shape (nu, n)
        Bounds on the entries' size, in units of K̂; inf where there is none.
    T : ndarray, shape (n,)
    U : ndarray, shape (nu,)
    v_unit, e_unit, p_unit : float
    """

    A0: Matrix
    Bu: Matrix
    Bv: Matrix
    C0: Matrix
    D: Matrix
    F: Matrix
    J0: Matrix
    J2: Matrix
    nx: int
    d_min: float
    d_max: float
    law: Law
    box: Matrix
    T: Matrix
    U: Matrix
    v_unit: float = 1.0
    e_unit: float = 1.0
    p_unit: float = 1.0

    @property
    def n(self) -> int:
        """Number of states of plant and reference model together."""
        return int(self.A0.shape[0])

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return int(self.Bu.shape[1])

    @property
    def m(self) -> int:
        """Number of entries of v = [w; r]."""
        return int(self.Bv.shape[1])

    @property
    def robust(self) -> bool:
        """Whether there is an uncertainty."""
        return int(self.F.shape[1]) > 0

    @property
    def window(self) -> Window:
        """The delays; between whole numbers only a path, never a proof."""
        return Window(cast(Any, self.d_min), cast(Any, self.d_max))

    def system(self, K: Block) -> System:
        """Return the matrices of (10) as numbers or expressions in K̂."""
        Kx, Kr = K @ self._keep(x=True), K @ self._keep(x=False)
        return System(self.A0 + self.Bu @ Kr, self.Bu @ Kx, self.Bv, self.C0 + self.D @ Kr, self.D @ Kx)

    def uncertain(self, K: Block) -> Uncertain:
        """Return F̄, J̄1 and J̄2 of (6) as numbers or expressions in K̂."""
        return Uncertain(self.F, self.J0 + self.J2 @ K @ self._keep(x=False), self.J2 @ K @ self._keep(x=True))

    def inside(self, K: Matrix) -> bool:
        """Whether K̂ is strictly inside its box."""
        return bool(np.all(np.abs(K) < self.box))

    def gain(self, K: Matrix) -> Gain | None:
        """Return the least η that Lemma 1 (Jensen form, robust by the S-procedure) proves; None if it proves none.

        The gradient is that of the Lagrangian: with Z the dual of Ω = base + G'PG + d_max H'RH + Ce'Ce + μ Jb'Jb,
        ∂η²/∂G = 2 (P G + d_max R H) Z, ∂η²/∂Ce = 2 Ce Z, ∂η²/∂Jb = 2 μ Jb Z.
        """
        system, uncertain, window = self.system(K), self.uncertain(K), self.window

        def omega(v: Mapping[str, Block]) -> lmi.Blocks:
            weights = Weights(v["P"], v["Q"], v["R"])
            if self.robust:
                return lmi.s_procedure(system, uncertain, weights, v["mu"], v["eta2"], window)
            return lmi.jensen(system, weights, v["eta2"], window)

        variables = {name: sdp.Variable(self.n, self.n, symmetric=True) for name in _SYMMETRIC}
        numbers = ["eta2", *(["mu"] if self.robust else [])]
        variables |= {name: sdp.Variable() for name in numbers}

        def statement(v: Mapping[str, Block]) -> sdp.Program:
            return sdp.Program(v["eta2"], [interior(omega(v), INTERIOR)], positive(v, INTERIOR))

        solution = sdp.solve(variables, statement)
        if solution.status not in (sdp.Status.OPTIMAL, sdp.Status.INACCURATE):
            return None
        values = dict(solution.values)
        eta2 = float(values["eta2"][0, 0])
        if not eta2 > 0.0:
            return None
        rough = max(solution.gap / eta2, solution.residual)
        if solution.status is sdp.Status.INACCURATE and not rough < _ROUGH:
            return None
        weights, mu = Weights(*(values[name] for name in _SYMMETRIC)), float(values["mu"][0, 0]) if self.robust else 0.0
        gradient = self._gradient(system, uncertain, weights, mu, solution.duals[0]) / (2.0 * eta2)
        return Gain(float(np.sqrt(eta2)) * self.eta_unit, gradient, weights, mu)

    @property
    def eta_unit(self) -> float:
        """η of the loop in units of η̂."""
        return self.e_unit / self.v_unit

    def given(self, K: Matrix) -> Matrix:
        """Return K̂ in the units of the model."""
        return self.U[:, None] * K / self.T

    def own(self, K: Matrix) -> Matrix:
        """Return K of the model's units in those of the task."""
        return K * self.T / self.U[:, None]

    def gains(self, theta: Block) -> Block:
        """Return K̂ as an expression in its coordinates, shape (free numbers, 1), in the affine subspace."""
        n, total = self.n, self.law.K0.reshape(self.nu, self.n)
        for i, unit in enumerate(np.eye(self.nu)[:, :, None]):
            total = unit @ (self.law.N[i * n : (i + 1) * n] @ theta).T + total
        return total

    def room(self, K: Block) -> list[Block]:
        """Return what is nonnegative where K̂ is inside its box, by more than a solver's tolerance."""
        left, right = np.eye(self.nu), np.eye(self.n)
        bounded = np.argwhere(np.isfinite(self.box))
        entries = [(_STRICT * self.box[i, j], left[i : i + 1] @ K @ right[:, j : j + 1]) for i, j in bounded]
        return [sign * entry + limit * np.ones((1, 1)) for limit, entry in entries for sign in (1.0, -1.0)]

    def free(self, K: Matrix) -> Matrix:
        """Return the coordinates of K̂ in the affine subspace, after projection onto it."""
        return np.asarray(self.law.N.T @ (K.reshape(-1) - self.law.K0), dtype=np.float64)

    def point(self, theta: Matrix) -> Matrix:
        """Return K̂ at the given coordinates."""
        return np.asarray((self.law.K0 + self.law.N @ theta).reshape(self.nu, self.n), dtype=np.float64)

    def relaxed(self, t: float) -> Task:
        """Return an easier problem: t = 1 is this one, t → 0 has no delay and no uncertainty.

        Both c = d_max − d_min + 1 and d_max go straight from the delay-free 1 and 0 to their values, F with them.
        """
        width = 1.0 + t * (self.d_max - self.d_min)
        d_max = t * self.d_max
        return replace(self, d_min=d_max + 1.0 - width, d_max=d_max, F=t * self.F)

    def _keep(self, *, x: bool) -> Matrix:
        """Return Mx or Mr."""
        return np.diag((np.arange(self.n) < self.nx) == x).astype(np.float64)

    def _gradient(self, system: System, uncertain: Uncertain, weights: Weights, mu: float, Z: Matrix) -> Matrix:
        """Return ∂η̂²/∂K̂ from the dual Z over (z, z_d, v, p)."""
        n, m = self.n, self.m
        tail = [np.zeros((self.C0.shape[0], m + self.F.shape[1])), np.zeros((self.J0.shape[0], m + self.F.shape[1]))]
        G = np.hstack([system.A, system.A1, system.B, self.F])
        H = G.copy()
        H[:, :n] -= np.eye(n)
        to_G = 2.0 * (weights.P @ G + self.window.d_max * (weights.R @ H)) @ Z
        to_C = 2.0 * np.hstack([system.C, system.C1, tail[0]]) @ Z
        to_J = 2.0 * mu * np.hstack([uncertain.J1, uncertain.J2, tail[1]]) @ Z
        total = self.Bu.T @ to_G + self.D.T @ to_C + self.J2.T @ to_J
        return np.hstack([total[:, n : n + self.nx], total[:, self.nx : n]])

    def balanced(self, K: Matrix) -> Task:
        """Return the same problem in the units of the loop closed by K (of the model's units, as given)."""
        return _in_units(self, self.own(K))


def task(model: Model, d_min: int, d_max: int, delta_max: float, law: Law, box: Matrix) -> Task:
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
    """
    none = np.zeros((model.nu, model.nx + model.nr))
    open_ = augmented(model, none[:, : model.nx], none[:, model.nx :] if model.nr else None)
    robust = delta_max > 0.0 and model.uncertainty is not None
    p, q = (open_.F.shape[1], open_.J1.shape[0]) if robust else (0, 0)
    J2 = model.uncertainty.J2 if robust and model.uncertainty is not None else np.zeros((0, model.nu))
    given = Task(
        A0=open_.A,
        Bu=np.vstack([model.B, np.zeros((model.nr, model.nu))]),
        Bv=open_.B,
        C0=open_.C,
        D=model.D,
        F=delta_max * open_.F[:, :p],
        J0=open_.J1[:q],
        J2=J2,
        nx=model.nx,
        d_min=d_min,
        d_max=d_max,
        law=law,
        box=box,
        T=np.ones(open_.n),
        U=np.ones(model.nu),
    )
    return given.balanced(none)


def _in_units(task: Task, K: Matrix) -> Task:
    """Return the problem in units that balance the loop closed by K̂."""
    system, uncertain = task.system(K), task.uncertain(K)
    loop = Augmented(*system, *uncertain)
    s = balance(loop, loop.F, loop.J1, loop.J2)
    t = np.diag(s.T)
    size = np.sqrt(np.sum((K * t) ** 2, axis=1))
    reach = np.linalg.norm(task.Bu / t[:, None], axis=0)
    u = np.where(size > 0.0, size, 1.0 / np.where(reach > 0.0, reach, 1.0))  # of the feedback, else of its effect
    scale = (t[None, :] / u[:, None]).reshape(-1)  # K̂ new = scale · K̂ old
    v, e, p = s.v_unit, s.e_unit, s.p_unit
    return replace(
        task,
        A0=task.A0 / t[:, None] * t,
        Bu=task.Bu / t[:, None] * u,
        Bv=task.Bv / t[:, None] * v,
        C0=task.C0 * t / e,
        D=task.D * u / e,
        F=task.F / t[:, None] * p,
        J0=task.J0 * t / p,
        J2=task.J2 * u / p,
        law=task.law.scaled(scale),
        box=task.box * t / u[:, None],
        T=task.T * t,
        U=task.U * u,
        v_unit=task.v_unit * v,
        e_unit=task.e_unit * e,
        p_unit=task.p_unit * p,
    )
