"""Eqs. (4), (8) and (9) for many delay sequences at once, without network, elevator limits or quantisation.

    u(k) = K1 x(k − d(k)) + K2 xr(k)
    x(k+1) = A x(k) + B u(k),   y(k) = C x(k) + D u(k)
    xr(k+1) = Ar xr(k) + Br r(k),   yr(k) = Cr xr(k)

Until the first command has arrived, at k = d(k), the actuator is neutral: u(k) = 0. There is no disturbance.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gains.model import Gains, Matrix

__all__ = ["MOST", "Delays", "Run", "fly", "size"]

MOST = 1e100
"""A run whose state exceeds it is no number from there on: a loop that grows by half in each sample gets there."""

Delays = NDArray[np.intp]
"""Delay sequences d(k), shape (runs, K), in samples."""


class Run(NamedTuple):
    """What became of every run; deviations from trim, in the units of the model.

    Attributes
    ----------
    x : ndarray, shape (runs, K, nx)
    u : ndarray, shape (runs, K, nu)
    y : ndarray, shape (runs, K, ny)
    yr : ndarray or None, shape (K, ny)
        The reference model's output, the same in all runs; None without a reference model.
    """

    x: Matrix
    u: Matrix
    y: Matrix
    yr: Matrix | None


def fly(gains: Gains, delays: Delays, x0: Matrix, r: Matrix | None = None) -> Run:
    """Return the runs of a loop from one start, each under its own delay sequence.

    Parameters
    ----------
    gains : Gains
    delays : ndarray of int, shape (runs, K)
        Not below 0.
    x0 : ndarray, shape (nx,)
        x(0).
    r : ndarray or None, shape (K, number of reference inputs)
        None leaves the reference model at rest.
    """
    model = gains.model
    runs, samples = delays.shape
    xr = _reference(gains, samples, r)
    feed = np.zeros((samples, model.nu)) if xr is None or gains.K2 is None else xr @ gains.K2.T
    x = np.zeros((runs, samples + 1, model.nx))
    u = np.zeros((runs, samples, model.nu))
    x[:, 0] = x0
    each = np.arange(runs)
    for k in range(samples):
        j = k - delays[:, k]
        commanded = x[each, np.maximum(j, 0)] @ gains.K1.T + feed[k]
        u[:, k] = np.where((j >= 0)[:, None], commanded, 0.0)
        after = x[:, k] @ model.A.T + u[:, k] @ model.B.T
        x[:, k + 1] = np.where(np.max(np.abs(after), axis=1, keepdims=True) > MOST, np.nan, after)
    x = x[:, :-1]
    yr = None if xr is None or model.reference is None else xr @ model.reference.Cr.T
    return Run(x, u, x @ model.C.T + u @ model.D.T, yr)


def _reference(gains: Gains, samples: int, r: Matrix | None) -> Matrix | None:
    """Return xr(k), Eq. (8), from rest; None without a reference model or without r."""
    reference = gains.model.reference
    if reference is None or r is None:
        return None
    xr = np.zeros((samples, gains.model.nr))
    for k in range(samples - 1):
        xr[k + 1] = reference.Ar @ xr[k] + reference.Br @ r[k]
    return xr


def size(x: Matrix, scale: Matrix, depth: int) -> Matrix:
    """Return max over i and the last ``depth`` + 1 samples of |x_i| / scale_i, shape (runs, K − depth).

    It is a norm of what the loop remembers, [x(k); …; x(k−depth)], so its growth per sample is the loop's.

    Parameters
    ----------
    x : ndarray, shape (runs, K, nx)
    scale : ndarray, shape (nx,)
        Positive.
    depth : int
        The largest delay, samples.
    """
    now = np.max(np.abs(x) / scale, axis=2)
    return np.asarray(np.lib.stride_tricks.sliding_window_view(now, depth + 1, axis=1).max(axis=2))
