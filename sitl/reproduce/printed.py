"""What the paper prints and the stored models do not hold: magnitudes as they stand in the text, and a reading.

The text that was read has lost its minus signs, so these are absolute values; the stored models carry the signs.
"""

from __future__ import annotations

import numpy as np

__all__ = ["A0", "AP", "AR", "AR_GAIN", "B0", "BP", "DELTA_A", "DELTA_B", "E0", "K_ALPHA", "Ts"]

Ts = 0.025
"""Sampling period of the HIRM example, s."""
AP = np.array([[0.5427, 1.0, 0.0], [1.069, 0.4134, 0.0], [0.0, 1.0, 0.0]])
"""|Ap| of Eq. (48)."""
BP = np.array([0.113, 3.259, 0.0])
"""|Bp| of Eq. (48)."""
A0 = np.array([[0.9862, 0.0243, 0.0], [0.0264, 0.9894, 0.0], [0.0030, 0.0249, 1.0]])
"""|A0| of Eq. (49)."""
B0 = np.array([0.0038, 0.0810, 0.0010])
"""|B0| of Eq. (49)."""
E0 = np.array([0.0230, 0.0, 0.0])
"""E of Eq. (49)."""
DELTA_A = np.array([[0.0014, 0.0004, 0.0], [0.0026, 0.0011, 0.0], [0.0, 0.0, 0.0]])
"""|ΔA| of Eq. (49)."""
DELTA_B = np.array([0.0004, 0.0080, 0.0])
"""|ΔB| of Eq. (49)."""
AR = np.array([[0.9878, 0.0189, 0.0056], [0.0085, 0.8736, 0.0056], [0.0001, 0.0235, 0.9985]])
"""|Ar| of Eq. (53)."""
AR_GAIN = np.array([-0.43, 1.43, 1.469])
"""The state feedback k with which Ar = A0 + B0 k and Br = −k₃ B0 give Eq. (53)."""
K_ALPHA = (0.5054, 0.2474)
"""The entries of K1 and K2 in Eq. (54) that multiply α, without signs."""
