"""The control law, Eq. (9): u(k) = K1 x(k - d(k)) + K2 xr(k), around trim, within the elevator's travel.

The law runs once per sample on a handful of numbers, right between a packet in and a packet out. Plain
floats do that several times faster than arrays, most of all when the processor's caches are cold.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from operator import mul

from autopilot.link.servo import Travel, travel_of
from gains.model import Gains

__all__ = ["Law", "law_of"]


@dataclass(frozen=True, slots=True)
class Law:
    """The gains of one input, as rows of floats.

    Attributes
    ----------
    K1 : tuple of float, length nx
        Row of K1.
    K2 : tuple of float, length nr
        Row of K2; empty without a reference model.
    trim_x : tuple of float, length nx
        State at trim.
    travel : Travel
        Limits of the input, and its value at trim.
    """

    K1: tuple[float, ...]
    K2: tuple[float, ...]
    trim_x: tuple[float, ...]
    travel: Travel

    def command(self, x: Sequence[float], xr: Sequence[float]) -> tuple[float, bool]:
        """Return u of Eq. (9), absolute and within the travel, and whether the travel limited it.

        Parameters
        ----------
        x : sequence of float, length nx
            State of the sample, absolute.
        xr : sequence of float, length nr
            Reference state at the expected instant of application; empty without a reference model.
        """
        dx = [value - trim for value, trim in zip(x, self.trim_x, strict=True)]
        wanted = self.travel.neutral + sum(map(mul, self.K1, dx)) + sum(map(mul, self.K2, xr))
        u = self.travel.clip(wanted)
        return u, u != wanted


def law_of(gains: Gains) -> Law:
    """Return the law of a set of gains.

    Raises
    ------
    InputError
        When the model has not exactly one input with limits.
    """
    travel = travel_of(gains.model)
    K2 = () if gains.K2 is None else tuple(gains.K2[0].tolist())
    return Law(tuple(gains.K1[0].tolist()), K2, tuple(gains.model.trim.x.tolist()), travel)
