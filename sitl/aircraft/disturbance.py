"""What disturbs the aircraft: the paper's harmonic gust, Eq. (52), and its uncertainty signal, Eq. (51).

Both are functions of the sample number, so a flight can be computed again from its record.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

__all__ = ["HarmonicGust", "SquareDelta"]


@dataclass(slots=True)
class HarmonicGust:
    """w(k) = [25, 0] mu(k), mu(k+1) = [[.9922, .1247], [-.1247, .9922]] mu(k), mu(0) = [.1, .1], Eq. (52).

    Parameters
    ----------
    nw : int
        Number of disturbances; the gust enters through the first.
    start_k : int
        Sample at which it begins; mu(0) belongs to it.
    unit : float
        The unit of w in the model's units. The paper's simulations are in degrees: the printed 25 gives
        degrees per second, which is pi/180 of the model's radians per second.
    """

    nw: int
    start_k: int = 0
    unit: float = math.pi / 180.0
    _k: int = 0
    _mu: NDArray[np.float64] = field(default_factory=lambda: np.array([0.1, 0.1]))

    def w(self, k: int) -> NDArray[np.float64]:
        """Return w(k); k never goes back."""
        w = np.zeros(self.nw)
        if k < self.start_k:
            return w
        step = np.array([[0.9922, 0.1247], [-0.1247, 0.9922]])
        while self._k < k - self.start_k:
            self._mu = step @ self._mu
            self._k += 1
        w[0] = 25.0 * self._mu[0] * self.unit
        return w


@dataclass(frozen=True, slots=True)
class SquareDelta:
    """Delta(k) = +amplitude for half_period samples, then -amplitude, Eq. (51), continued periodically.

    Parameters
    ----------
    amplitude : float
        0.15 in the paper.
    half_period : int
        20 samples in the paper, which prints one period.
    """

    amplitude: float = 0.15
    half_period: int = 20

    def delta(self, k: int) -> float:
        """Return Delta(k)."""
        return self.amplitude if (k // self.half_period) % 2 == 0 else -self.amplitude
