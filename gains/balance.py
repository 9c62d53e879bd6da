"""Coordinates in which the closed loop (10) is well scaled, and the way back for P, Q, R, μ, η and the dual.

    z = T ẑ,  v = v_unit v̂,  e = e_unit ê,  p = p_unit p̂    (p the input of the uncertainty)

The diagonal T comes from LAPACK's balancing of the loop closed from e to v: where e and v are measured in
units that give the loop unit gain, the result does not depend on the units of states, inputs or outputs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from gains.lmi import System, Uncertain, Weights
from gains.model import Augmented, Matrix

__all__ = ["Scaling", "balance", "scaled"]


@dataclass(frozen=True, slots=True, eq=False)
class Scaling:
    """Units of the balanced loop.

    Attributes
    ----------
    T : ndarray, shape (n, n)
        z = T ẑ.
    v_unit, e_unit, p_unit : float
    """

    T: Matrix
    v_unit: float
    e_unit: float
    p_unit: float

    @property
    def eta_unit(self) -> float:
        """η in units of the balanced η̂."""
        return self.e_unit / self.v_unit

    def weights(self, weights: Weights) -> Weights:
        """Return P, Q, R of the original coordinates."""
        inverse = np.linalg.inv(self.T) * self.e_unit

        def back(X: Matrix) -> Matrix:
            Y = inverse.T @ X @ inverse
            return (Y + Y.T) / 2

        return Weights(*(back(X) for X in weights))

    def mu(self, mu: float) -> float:
        """Return μ of the original units."""
        return mu * (self.e_unit / self.p_unit) ** 2

    def dual(self, Z: Matrix, columns: int) -> Matrix:
        """Return the dual over (z, z_d, v, p) in original units, with dη² = ⟨Z, dM⟩; its v block has trace 1.

        Parameters
        ----------
        Z : ndarray
            The dual of the balanced inequality, with dη̂² = ⟨Ẑ, dM̂⟩.
        columns : int
            Number m of entries of v.
        """
        n = self.T.shape[0]
        D = np.zeros_like(Z)
        D[:n, :n] = D[n : 2 * n, n : 2 * n] = self.T
        rest = np.full(Z.shape[0] - 2 * n, self.p_unit)
        rest[:columns] = self.v_unit
        np.fill_diagonal(D[2 * n :, 2 * n :], rest)
        return D @ Z @ D.T / self.v_unit**2


def balance(system: Augmented, F: Matrix, J1: Matrix, J2: Matrix) -> Scaling:
    """Return a diagonal scaling of the loop and of its uncertainty [ΔA ΔA1] = F Δ [J1 J2]; states by powers of two.

    Parameters
    ----------
    system : Augmented
        Its own uncertainty is not used.
    F : ndarray, shape (n, p)
        No columns without uncertainty.
    J1, J2 : ndarray, shape (q, n)
    """
    n = system.n
    M = np.abs(system.A) + np.abs(system.A1)
    np.fill_diagonal(M, 0.0)
    b, c = _rows(system.B), _columns(np.vstack([system.C, system.C1]).reshape(2, -1, n))
    t = _balanced(M)
    scale = max(float(np.max(M / t[:, None] * t[None, :], initial=0.0)), 1e-3)
    loop = np.zeros((n + 1, n + 1))
    loop[:n, :n] = M
    loop[:n, n] = b * scale / _unit(b / t)
    loop[n, :n] = c * scale / _unit(c * t)
    t = _balanced(loop)
    t = t[:n] / t[n]
    v_unit, e_unit = 1.0 / _unit(b / t), _unit(c * t)
    p_unit = float(np.sqrt(_unit(_columns(np.stack([J1, J2])) * t) / _unit(_rows(F) / t)))
    return Scaling(np.diag(t), v_unit, e_unit, p_unit)


def scaled(system: Augmented, uncertain: Uncertain | None, scaling: Scaling) -> tuple[System, Uncertain | None]:
    """Return the loop in the coordinates of a scaling."""
    T, v, e, p = scaling.T, scaling.v_unit, scaling.e_unit, scaling.p_unit
    inverse = np.linalg.inv(T)
    loop = System(
        inverse @ system.A @ T, inverse @ system.A1 @ T, inverse @ system.B * v, system.C @ T / e, system.C1 @ T / e
    )
    if uncertain is None:
        return loop, None
    F, J1, J2 = uncertain
    return loop, Uncertain(inverse @ F * p, J1 @ T / p, J2 @ T / p)


def _balanced(matrix: Matrix) -> Matrix:
    """Return LAPACK's scale factors t: diag(t)⁻¹ M diag(t) has rows and columns of near norms."""
    _, _, _, scale, _ = lapack.dgebal(matrix, scale=1, permute=0)
    return np.asarray(scale, dtype=np.float64)


def _rows(matrix: Matrix) -> Matrix:
    return np.asarray(np.sqrt(np.sum(matrix**2, axis=1)), dtype=np.float64)


def _columns(stack: Matrix) -> Matrix:
    return np.asarray(np.sqrt(np.sum(stack**2, axis=(0, 1))), dtype=np.float64)


def _unit(values: Matrix) -> float:
    """Return the Euclidean norm, 1 where it is zero."""
    norm = float(np.sqrt(np.sum(values**2)))
    return norm if norm > 0.0 else 1.0
