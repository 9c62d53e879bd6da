"""The control law, Eq. (9): u(k) = K1 x(k - d(k)) + K2 xr(k), around trim, within the actuator's travel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from autopilot.link.servo import Travel
from gains.model import Model

__all__ = ["law", "limited"]


def law(
    K1: NDArray[np.float64],
    K2: NDArray[np.float64] | None,
    dx: NDArray[np.float64],
    xr: NDArray[np.float64] | None,
) -> float:
    """Return K1 dx + K2 xr, Eq. (9), for one input.

    Parameters
    ----------
    K1, K2 : (1, nx) and (1, nr) arrays
        Gains; K2 is None without a reference model.
    dx : (nx,) array
        Deviation of the state from trim.
    xr : (nr,) array or None
        Reference state at the expected instant of application.
    """
    u = float((K1 @ dx)[0])
    if K2 is not None and xr is not None:
        u += float((K2 @ xr)[0])
    return u


def limited(
    model: Model,
    travel: Travel,
    K1: NDArray[np.float64],
    K2: NDArray[np.float64] | None,
    x: NDArray[np.float64],
    xr: NDArray[np.float64] | None,
) -> tuple[float, bool]:
    """Return the absolute input of Eq. (9) within the travel, and whether the travel limited it."""
    wanted = travel.neutral + law(K1, K2, x - model.trim.x, xr)
    u = travel.clip(wanted)
    return u, u != wanted
