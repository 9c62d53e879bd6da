"""Positive definiteness decided by eigenvalues with a bound on everything that rounding can have changed; NumPy only.

A matrix passes when its smallest eigenvalue exceeds that bound. Before that it is brought to a diagonal near 1 by
powers of two, which rounds nothing and makes margin and bound independent of units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gains.model import Matrix

__all__ = ["EPS", "LEAST", "MOST", "UNDERFLOW", "Verification", "definite", "failed"]

EPS = float(np.finfo(np.float64).eps)
LEAST, MOST = 1e-100, 1e100  # what a certificate and a model may hold: products stay far from under- and overflow
UNDERFLOW = 1e-200  # more than all that underflow can take from an entry between those limits
_EIGENVALUES = 8  # LAPACK's symmetric eigenvalues err by less than this times N eps times the norm


@dataclass(frozen=True, slots=True)
class Verification:
    """Whether a certificate proves what it says.

    Attributes
    ----------
    passed : bool
    margin : float
        The smallest eigenvalue among the matrices that shall be positive definite, each with a diagonal near
        1; that of the matrix whose margin is least beside its rounding.
    rounding : float
        Bound on the error of that eigenvalue; ``margin > rounding`` in every matrix is what passed means.
    reason : str
        What failed; empty if nothing did.
    """

    passed: bool
    margin: float
    rounding: float
    reason: str


def definite(matrix: Matrix, error: Matrix, reason: str) -> Verification:
    """Return whether a symmetric matrix, known up to an error in each entry, is positive definite.

    Parameters
    ----------
    matrix, error : ndarray, shape (n, n)
    reason : str
        What is said where it is not.
    """
    diagonal = np.diag(matrix)
    if not (np.isfinite(matrix).all() and np.all(diagonal > 0.0)):
        return failed(reason)
    unit = np.exp2(-np.rint(np.log2(diagonal) / 2))
    scaled = matrix * unit[:, None] * unit[None, :]
    if np.diag(scaled).min() < 0.25 or np.diag(scaled).max() > 4.0:
        return failed(reason)
    try:
        margin = float(np.linalg.eigvalsh(scaled)[0])
    except np.linalg.LinAlgError:
        return failed(f"{reason}: its eigenvalues could not be computed")
    rounding = float(np.max(np.sum(error * unit[:, None] * unit[None, :], axis=1)))
    rounding += _EIGENVALUES * len(diagonal) * EPS * float(np.linalg.norm(scaled))
    passed = margin > rounding
    return Verification(passed, margin, rounding, "" if passed else reason)


def failed(reason: str) -> Verification:
    """Return that nothing is proved, and why."""
    return Verification(False, -math.inf, 0.0, reason)
