"""The reference model, Eq. (8): xr(k+1) = Ar xr(k) + Br r(k), aligned to the expected instant of application.

The paper's law, Eq. (9), takes xr fresh at the actuator. The command computed from sample j is applied
at sample j + d, so it must carry xr(j + d); :class:`ReferenceModel` advances by the sample's number (also
across lost samples) and looks ahead by the forecast d. A programmed profile is known in advance, so with
the right d the alignment is exact.
"""

from __future__ import annotations

import itertools
import math
import re
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gains.model import Model, Reference
from gains.table import InputError

__all__ = ["AffineStep", "Profile", "ReferenceModel", "match_reference", "parse_profile"]

LOOP_LIMIT = 64
"""Up to so many steps are taken one by one; a longer stretch of constant r is one matrix power."""

Vector = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Profile:
    """A programmed reference: piecewise constant, zero before the first switch.

    Attributes
    ----------
    switches : tuple of (int, float)
        Sample number and the value of r from that sample on, in rising order.
    """

    switches: tuple[tuple[int, float], ...] = ()

    def r(self, k: int) -> float:
        """Return r(k)."""
        value = 0.0
        for start, r in self.switches:
            if k < start:
                break
            value = r
        return value

    def constant_until(self, k: int, end: int) -> int:
        """Return the first sample after k, at most ``end``, at which r may differ from r(k)."""
        return min((start for start, _ in self.switches if k < start < end), default=end)


_ITEM = re.compile(r"(?P<value>[-+0-9.eE]+)(?P<unit>deg|rad|)@(?P<time>[0-9.eE+-]+)s")


def parse_profile(text: str, Ts: float) -> Profile:
    """Return the profile written as ``5deg@1s,0deg@6s``: r becomes 5 degrees at 1 s and 0 at 6 s.

    Parameters
    ----------
    text : str
        Comma-separated ``VALUE@TIMEs``; a value may carry ``deg`` or ``rad``, else it is in the model's
        units. Empty for no reference.
    Ts : float
        Sampling period in s; a switch takes effect at the first sample not before its time.

    Raises
    ------
    InputError
        For anything else.
    """
    switches: list[tuple[int, float]] = []
    for item in filter(None, (part.strip() for part in text.split(","))):
        match = _ITEM.fullmatch(item)
        try:
            if match is None:
                raise ValueError
            value = float(match["value"])
            start = math.ceil(float(match["time"]) / Ts - 1e-9)
            if not math.isfinite(value) or start < 0:
                raise ValueError
        except (ValueError, OverflowError):
            raise InputError(f'reference "{text}": expected VALUE@TIMEs such as 5deg@1s, found "{item}"') from None
        switches.append((start, math.radians(value) if match["unit"] == "deg" else value))
    if any(later[0] <= earlier[0] for earlier, later in itertools.pairwise(switches)):
        raise InputError(f'reference "{text}": expected rising times')
    return Profile(tuple(switches))


class AffineStep(NamedTuple):
    """xr later = matrix @ xr + offset."""

    matrix: Vector
    offset: Vector


class ReferenceModel:
    """State of Eq. (8), driven by a profile.

    Parameters
    ----------
    reference : Reference
        Ar, Br, Cr; one reference input.
    profile : Profile
        r(k).

    Attributes
    ----------
    k : int
        The sample that the state belongs to; the state is zero at k = 0.
    """

    def __init__(self, reference: Reference, profile: Profile) -> None:
        self.reference = reference
        self.profile = profile
        self.k = 0
        self._states: deque[Vector] = deque([np.zeros(reference.Ar.shape[0])])
        """xr(k), xr(k + 1), ...: a state looked ahead to is not computed again."""

    @property
    def xr(self) -> Vector:
        """The state at sample k."""
        return self._states[0]

    def set(self, xr: Vector) -> None:
        """Put the state at sample k elsewhere."""
        self._states = deque([xr])

    def follow(self, profile: Profile) -> None:
        """Follow another profile from here on; the state stays."""
        self.profile = profile
        self.set(self.xr)

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
            at = self.k + len(self._states) - 1
            self._states.append(self._propagate(self._states[-1], at, at + 1))
        return tuple(self._states[samples].tolist())

    def step_ahead(self, samples: int) -> AffineStep:
        """Return how xr(k + samples) follows from xr(k)."""
        end = self.k + samples
        matrix = np.linalg.matrix_power(self.reference.Ar, samples)
        return AffineStep(matrix, self._propagate(np.zeros(matrix.shape[0]), self.k, end))

    def _propagate(self, xr: Vector, start: int, end: int) -> Vector:
        """Return xr(end) from xr(start)."""
        Ar, Br = self.reference.Ar, self.reference.Br[:, 0]
        while start < end:
            until = self.profile.constant_until(start, end)
            drive = Br * self.profile.r(start)
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
