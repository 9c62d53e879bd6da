"""What may fly instead of the law of Eq. (9), to compare with it: one interface, the law's own.

*Smith predictor*, in its form for state feedback (Manitius and Olbrot 1979, finite spectrum assignment): the state at
the instant of application is predicted from the commands under way, and the gains of the loop without delay act on
that. It lives on the forecast d being right, and on a model that is; what a lost command makes of the plant it learns
with the next state.

*Dynamic feedback*: any linear controller with a state of its own, such as the output-feedback sliding mode with
integral action of :mod:`gains.baseline`. It knows nothing of the delay, so its reference is not looked ahead.

No certificate speaks of either. They see what the law sees: per sample the state, the reference looked ahead, the
number and the forecast of the delay.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from autopilot.control import Law, law_of
from autopilot.link.servo import Travel, travel_of
from gains.model import DynamicFeedback, Gains, Matrix, SmithPredictor

__all__ = ["Controller", "DynamicController", "PredictiveController", "StatefulController", "controller_of"]

MAX_UNDER_WAY = 256
"""Commands remembered; a forecast beyond that is looked ahead to with the oldest."""
MAX_CATCH_UP = 100
"""Missing samples over which a dynamic controller goes on with what it last saw; after more it is at rest."""


class Controller(Protocol):
    """What computes commands."""

    def command(self, x: Sequence[float], xr: Sequence[float], j: int, d: int) -> tuple[float, bool]:
        """Return the input for a sample, absolute and within the travel, and whether the travel limited it.

        Parameters
        ----------
        x : sequence of float, length nx
            State of the sample, absolute.
        xr : sequence of float, length nr
            Reference state at the expected instant of application; empty without a reference model.
        j : int
            Number of the sample; rises, with gaps, within an epoch.
        d : int
            By how many samples the command is expected to be late.
        """


class StatefulController(Controller, Protocol):
    """A controller that remembers."""

    def sent(self, j: int, u: float) -> None:
        """Take note of the command of a sample, whoever made it: the controller, failsafe, or a stick."""

    def take_over(self, x: Sequence[float], u: float, j: int, d: int) -> Matrix | None:
        """Prepare to fly from a state, with u applied now.

        Returns
        -------
        (nx,) array or None
            The deviation from trim that the gains K1 will act on, for the reference to be matched to; None where the
            controller has itself taken care that the elevator does not jump.
        """

    def restart(self) -> None:
        """Forget everything: a new epoch."""


class PredictiveController:
    """The law on the state predicted to the instant of application.

    Parameters
    ----------
    gains : Gains
        Made for the loop without delay.
    travel : Travel
        The elevator's.
    """

    def __init__(self, gains: Gains, travel: Travel) -> None:
        self._law: Law = law_of(gains, travel)
        self._A, self._B = gains.model.A, gains.model.B[:, 0]
        self._trim_x, self._neutral = gains.model.trim.x, travel.neutral
        self._sent: dict[int, float] = {}

    def command(self, x: Sequence[float], xr: Sequence[float], j: int, d: int) -> tuple[float, bool]:
        """Return u = K1 x^(j + d) + K2 xr(j + d)."""
        return self._law.command((self._trim_x + self._predicted(x, j, d)).tolist(), xr)

    def sent(self, j: int, u: float) -> None:
        """Remember a command under way."""
        self._sent[j] = u
        if len(self._sent) > MAX_UNDER_WAY:
            del self._sent[next(iter(self._sent))]

    def take_over(self, x: Sequence[float], u: float, j: int, d: int) -> Matrix | None:
        """Return the predicted state."""
        return self._predicted(x, j, d)

    def restart(self) -> None:
        """Forget the commands."""
        self._sent.clear()

    def _predicted(self, x: Sequence[float], j: int, d: int) -> Matrix:
        """Return the deviation of the state at sample j + d, if each command is as late as this one is expected to be.

        The plant then holds the command of sample i - d over sample i; where none was sent, the one before it.
        """
        dx = np.array(x) - self._trim_x
        if not self._sent:
            return dx
        known = sorted(self._sent)
        at = 0
        held = self._neutral
        for i in range(j - d, j):
            while at < len(known) and known[at] <= i:
                held = self._sent[known[at]]
                at += 1
            dx = self._A @ dx + self._B * (held - self._neutral)
        return dx


class DynamicController:
    """A linear controller with a state, one step per sample of the plant.

    Over samples that never came it goes on with the last ones that did.

    Parameters
    ----------
    gains : Gains
        With a :class:`gains.model.DynamicFeedback`.
    travel : Travel
        The elevator's.
    """

    def __init__(self, gains: Gains, travel: Travel) -> None:
        assert isinstance(gains.controller, DynamicFeedback)
        self._c = gains.controller
        self._Cr = np.zeros((gains.model.ny, 0)) if gains.model.reference is None else gains.model.reference.Cr
        self._trim_x, self._travel = gains.model.trim.x, travel
        self.restart()

    def restart(self) -> None:
        """Be at rest."""
        self._xc = np.zeros(self._c.Ac.shape[0])
        self._last: int | None = None
        self._dx, self._yr = np.zeros(self._c.Bc.shape[1]), np.zeros(self._c.Bcr.shape[1])

    def command(self, x: Sequence[float], xr: Sequence[float], j: int, d: int) -> tuple[float, bool]:
        """Return u, and step the state."""
        missing = 0 if self._last is None else j - self._last - 1
        if missing > MAX_CATCH_UP:
            self.restart()
        else:
            for _ in range(missing):
                self._step()
        self._last = j
        self._dx = np.array(x) - self._trim_x
        self._yr = self._Cr @ np.array(xr, dtype=np.float64)
        return self._step()

    def sent(self, j: int, u: float) -> None:
        """Nothing: what is sent is not what it acts on."""

    def take_over(self, x: Sequence[float], u: float, j: int, d: int) -> Matrix | None:
        """Move the state as little as need be for the next command to be u, with the reference where the output is."""
        dx = np.array(x) - self._trim_x
        self._last = None
        wanted = (u - self._travel.neutral) - float((self._c.Dc @ dx)[0]) - float((self._c.Dcr @ self._yr)[0])
        row = self._c.Cc[0]
        size = float(row @ row)
        if size > 0.0:
            self._xc = self._xc + row * (wanted - float(row @ self._xc)) / size
        return None

    def _step(self) -> tuple[float, bool]:
        c = self._c
        wanted = float((c.Cc @ self._xc + c.Dc @ self._dx + c.Dcr @ self._yr)[0]) + self._travel.neutral
        u = self._travel.clip(wanted)
        self._xc = c.Ac @ self._xc + c.Bc @ self._dx + c.Bcr @ self._yr + c.L[:, 0] * (u - wanted)
        return u, u != wanted


def controller_of(gains: Gains, travel: Travel | None = None) -> Law | StatefulController:
    """Return what flies a set of gains.

    Parameters
    ----------
    gains : Gains
    travel : Travel, optional
        The elevator's; else the model's.

    Raises
    ------
    InputError
        When the model has not exactly one input with limits.
    """
    travel = travel_of(gains.model) if travel is None else travel
    match gains.controller:
        case SmithPredictor():
            return PredictiveController(gains, travel)
        case DynamicFeedback():
            return DynamicController(gains, travel)
        case None:
            return law_of(gains, travel)
