"""Zero steady-state error (section 5a): the gains that track every constant r, as an affine subspace.

For constant r the reference model settles at x̄r = (I − Ar)⁻¹ Br r, and the plant tracks it at (A − I) x̄ + B ū = 0,
C x̄ + D ū = Cr x̄r. The law holds that equilibrium if K1 x̄ + K2 x̄r = ū.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import null_space, orth

from gains.model import Matrix, Model

__all__ = ["Equilibrium", "Law", "equilibrium", "every_law", "steady_law"]

_EXACT = 1e-9  # relative residual below which an equation counts as met


@dataclass(frozen=True, slots=True, eq=False)
class Equilibrium:
    """Where constant r settles, one column for each entry of r.

    Attributes
    ----------
    z : ndarray, shape (nx + nr, number of reference inputs)
        x̄ over x̄r.
    u : ndarray, shape (nu, number of reference inputs)
    exact : bool
        False where no constant input gives zero error: then x̄, ū leave the least error.
    """

    z: Matrix
    u: Matrix
    exact: bool


@dataclass(frozen=True, slots=True, eq=False)
class Law:
    """The gains K = K0 + N θ, entries by rows, with K0 orthogonal to N and N orthonormal.

    Attributes
    ----------
    K0 : ndarray, shape (nu n,)
    N : ndarray, shape (nu n, free numbers)
    """

    K0: Matrix
    N: Matrix

    def scaled(self, scale: Matrix) -> Law:
        """Return the law of the gains multiplied entry by entry."""
        N = orth(scale[:, None] * self.N) if self.N.shape[1] else self.N
        K0 = scale * self.K0
        return Law(K0 - N @ (N.T @ K0), N)


def equilibrium(model: Model) -> Equilibrium | None:
    """Return the equilibrium of constant r; None where there is no reference model.

    The equations of the state are met first, the error is the least that remains; the smallest such (x̄, ū).
    """
    reference = model.reference
    if reference is None:
        return None
    nx, nu = model.nx, model.nu
    xr = np.linalg.solve(np.eye(model.nr) - reference.Ar, reference.Br)
    state, output = np.hstack([model.A - np.eye(nx), model.B]), np.hstack([model.C, model.D])
    settled = null_space(state)
    wanted = reference.Cr @ xr
    coordinates = (
        np.linalg.lstsq(output @ settled, wanted, rcond=None)[0] if settled.size else np.zeros((0, xr.shape[1]))
    )
    xu = settled @ coordinates
    error = float(np.linalg.norm(output @ xu - wanted))
    exact = error <= _EXACT * max(1.0, float(np.linalg.norm(wanted)))
    return Equilibrium(np.vstack([xu[:nx], xr]), xu[nx : nx + nu], exact)


def steady_law(model: Model) -> Law:
    """Return the gains with K1 x̄ + K2 x̄r = ū; every gain where there is no reference model."""
    at = equilibrium(model)
    if at is None:
        return every_law(model)
    rows = np.kron(np.eye(model.nu), at.z.T)
    K0 = np.linalg.lstsq(rows, at.u.reshape(-1), rcond=None)[0]
    return Law(K0, null_space(rows))


def every_law(model: Model) -> Law:
    """Return all gains."""
    size = model.nu * (model.nx + model.nr)
    return Law(np.zeros(size), np.eye(size))
