"""The reference model, Eq. (8): xr(k+1) = Ar xr(k) + Br r(k), aligned to the expected instant of application.

The paper's law, Eq. (9), takes xr fresh at the actuator. The command computed from sample j is applied
at sample j + d, so it must carry xr(j + d); :class:`ReferenceModel` advances by the sample's number (also
across lost samples) and looks ahead by the forecast d. A programmed r is known in advance, and a streamed one is
promised as far as it was looked ahead to, so with the right d the alignment is exact.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from autopilot.profile import MAX_GAP, Source
from gains.model import Model, Reference

__all__ = ["AffineStep", "ReferenceModel", "match_reference"]

LOOP_LIMIT = 64
"""Up to so many steps are taken one by one; a longer stretch of constant r is one matrix power."""

CHANGES_LIMIT = 2 * MAX_GAP
"""Up to so many changes of r are followed over one gap; a streamed reference makes fewer of them."""

Vector = NDArray[np.float64]


class AffineStep(NamedTuple):
    """xr later = matrix @ xr + offset."""

    matrix: Vector
    offset: Vector


class ReferenceModel:
    """State of Eq. (8), driven by a source of r.

    Parameters
    ----------
    reference : Reference
        Ar, Br, Cr; one reference input.
    source : Source
        r(k).

    Attributes
    ----------
    k : int
        The sample that the state belongs to; the state is zero at k = 0.
    skipped : int
        Samples of gaps in which r changed more often than ``CHANGES_LIMIT``: r was taken as in the gap's last sample.
    """

    def __init__(self, reference: Reference, source: Source) -> None:
        self.reference = reference
        self.source = source
        self.k = 0
        self.skipped = 0
        self._Br = reference.Br[:, 0]
        self._states: deque[Vector] = deque([np.zeros(reference.Ar.shape[0])])
        """xr(k), xr(k + 1), ...: a state looked ahead to is not computed again."""

    @property
    def xr(self) -> Vector:
        """The state at sample k."""
        return self._states[0]

    def set(self, xr: Vector) -> None:
        """Put the state at sample k elsewhere."""
        self._states = deque([xr])

    def advance(self, j: int) -> Vector:
        """Move the state on to sample j and return xr(j); an earlier sample than the present one moves nothing."""
        while self.k < j and len(self._states) > 1:
            self._states.popleft()
            self.k += 1
        if self.k < j:
            self.set(self._propagate(self.xr, self.k, j))
            self.k = j
        return self.xr

    def ahead(self, samples: int) -> tuple[float, ...]:
        """Return xr(k + samples) without moving the state."""
        while len(self._states) <= samples:
            r = self.source.r(self.k + len(self._states) - 1)
            self._states.append(self.reference.Ar @ self._states[-1] + self._Br * r)
        return tuple(self._states[samples].tolist())

    def step_ahead(self, samples: int) -> AffineStep:
        """Return how xr(k + samples) follows from xr(k)."""
        end = self.k + samples
        matrix = np.linalg.matrix_power(self.reference.Ar, samples)
        return AffineStep(matrix, self._propagate(np.zeros(matrix.shape[0]), self.k, end))

    def _propagate(self, xr: Vector, start: int, end: int) -> Vector:
        """Return xr(end) from xr(start)."""
        Ar, Br = self.reference.Ar, self._Br
        changes = 0
        while start < end:
            if changes < CHANGES_LIMIT:
                until, r = self.source.constant_until(start, end), self.source.r(start)
            else:  # Ar is Schur: what r was then is forgotten within seconds
                until, r = end, self.source.r(end - 1)
                self.skipped += end - start
            changes += 1
            drive = Br * r
            if until - start <= LOOP_LIMIT:
                for _ in range(until - start):
                    xr = Ar @ xr + drive
            else:
                n = xr.size
                step = np.eye(n + 1)
                step[:n, :n], step[:n, n] = Ar, drive
                xr = (np.linalg.matrix_power(step, until - start) @ np.append(xr, 1.0))[:n]
            start = until
        return xr


def match_reference(model: Model, K1: Vector, K2: Vector, x: Vector, u: float, ahead: AffineStep) -> Vector:
    """Return the xr(j) with which the command of sample j continues from u without a jump.

    Solves Cr xr = C x and K2 xr(j + d) = u - K1 x as closely as possible, xr(j + d) being what the command will
    use; it stays nearest to x itself where the reference model has the plant's states (as in model following,
    Eq. (53)), else nearest to zero.

    Parameters
    ----------
    x : (nx,) array
        Deviation from trim at sample j.
    u : float
        Deviation of the input that is applied now.
    ahead : AffineStep
        From xr(j) to xr(j + d).
    """
    assert model.reference is not None
    Cr = model.reference.Cr
    base = x if Cr.shape[1] == x.size else np.zeros(Cr.shape[1])
    rows = np.vstack([Cr, K2 @ ahead.matrix])
    wanted = np.concatenate([model.C @ x, u - K1 @ x - K2 @ ahead.offset])
    return np.asarray(base + np.linalg.pinv(rows, rcond=1e-6) @ (wanted - rows @ base))
