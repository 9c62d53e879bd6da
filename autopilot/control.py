"""The control law, Eq. (9): u(k) = K1 x(k - d(k)) + K2 xr(k), around trim, within the elevator's travel.

Of a schedule's sets of gains, the forecast of a command's delay chooses the one that computes it.

The law runs once per sample on a handful of numbers, right between a packet in and a packet out. Plain
floats do that several times faster than arrays, most of all when the processor's caches are cold.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from operator import mul

from autopilot.link.clock import NS_PER_S
from autopilot.link.servo import Travel, travel_of
from gains.model import Gains

__all__ = ["ChosenSets", "Law", "SetChanges", "SetChooser", "Window", "law_of"]

TELL_NS = NS_PER_S
"""Changes of the set in force are told of at most once in this time."""

SETTLE_SAMPLES = 40
"""A set with a narrower window takes over when it could have for so many samples in a row: 1 s at 25 ms."""

Window = tuple[int, int]
"""d_min and d_max of a set of gains, samples."""


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

    def command(self, x: Sequence[float], xr: Sequence[float], j: int = 0, d: int = 0) -> tuple[float, bool]:
        """Return u of Eq. (9), absolute and within the travel, and whether the travel limited it.

        Parameters
        ----------
        x : sequence of float, length nx
            State of the sample, absolute.
        xr : sequence of float, length nr
            Reference state at the expected instant of application; empty without a reference model.
        j, d : int
            Of no meaning here: what other controllers ask for (:class:`autopilot.controllers.Controller`).
        """
        dx = [value - trim for value, trim in zip(x, self.trim_x, strict=True)]
        wanted = self.travel.neutral + sum(map(mul, self.K1, dx)) + sum(map(mul, self.K2, xr))
        u = self.travel.clip(wanted)
        return u, u != wanted


def law_of(gains: Gains, travel: Travel | None = None) -> Law:
    """Return the law of a set of gains.

    Parameters
    ----------
    gains : Gains
        The gains.
    travel : Travel, optional
        The elevator's; else the model's.

    Raises
    ------
    InputError
        When the model has not exactly one input with limits.
    """
    travel = travel_of(gains.model) if travel is None else travel
    K2 = () if gains.K2 is None else tuple(gains.K2[0].tolist())
    return Law(tuple(gains.K1[0].tolist()), K2, tuple(gains.model.trim.x.tolist()), travel)


class SetChooser:
    """Which of a schedule's sets computes a command, by the interval of its forecast; with hysteresis.

    The set in force stays while its window contains the interval [low, high]. Otherwise the narrowest window that
    contains it wins, as it has the better gains; of equals the one with more room around the interval, and of those
    the first. A narrower window than that of the set in force wins only when it has contained SETTLE_SAMPLES
    intervals in a row, so that a delay that wanders about the edge of a window does not switch all the time.

    An interval too wide for any window leaves the choice to d alone: the set in force while its window contains d,
    else the one with the most room around d. An unknown delay, or one outside every window, changes nothing;
    failsafe decides there.

    Parameters
    ----------
    windows : sequence of Window
        Of each set, in the order of the schedule; one for plain gains.

    Attributes
    ----------
    present : int
        Index of the set in force.
    """

    def __init__(self, windows: Sequence[Window]) -> None:
        self.windows = windows
        self.present = 0
        self._candidate = 0
        self._in_a_row = 0

    def choose(self, d: int | None, low: int | None, high: int | None) -> int:
        """Return the index of the set for a command with this forecast, which is in force from now on."""
        if len(self.windows) == 1 or d is None or low is None or high is None:
            return self.present
        best = self._narrowest(low, high)
        if best is None:
            self._in_a_row = 0
            if not self._contains(self.present, d, d):
                self.present = self._roomiest(d)
        elif not self._contains(self.present, low, high):
            self.present, self._in_a_row = best, 0
        elif self._width(best) >= self._width(self.present):
            self._in_a_row = 0
        else:
            self._in_a_row = self._in_a_row + 1 if best == self._candidate else 1
            self._candidate = best
            if self._in_a_row >= SETTLE_SAMPLES:
                self.present, self._in_a_row = best, 0
        return self.present

    def _contains(self, index: int, low: int, high: int) -> bool:
        d_min, d_max = self.windows[index]
        return d_min <= low and high <= d_max

    def _width(self, index: int) -> int:
        d_min, d_max = self.windows[index]
        return d_max - d_min

    def _room(self, index: int, low: int, high: int) -> int:
        d_min, d_max = self.windows[index]
        return min(low - d_min, d_max - high)

    def _narrowest(self, low: int, high: int) -> int | None:
        """Return the set of the narrowest window that contains the interval."""
        fit = [i for i in range(len(self.windows)) if self._contains(i, low, high)]
        return min(fit, key=lambda i: (self._width(i), -self._room(i, low, high), i), default=None)

    def _roomiest(self, d: int) -> int:
        """Return the set with the most room around d; the present one when no window contains d."""
        fit = [i for i in range(len(self.windows)) if self._contains(i, d, d)]
        return min(fit, key=lambda i: (-self._room(i, d, d), self._width(i), i), default=self.present)


@dataclass(slots=True)
class ChosenSets:
    """Which set computed which command of a schedule, to check the forecast that chose it against what came of it.

    The certificate of a schedule admits an estimate that is wrong by one sample. A command that is held while its
    delay grows keeps its set, so that its first delay alone counts.

    Parameters
    ----------
    windows : sequence of Window
        Of each set; with one there is nothing to check.
    """

    windows: Sequence[Window]
    _sets: dict[int, int] = field(default_factory=dict)
    _applied: int = -1

    def note(self, j: int, gain_set: int) -> None:
        """Remember the set of the command of sample j, and no more than the delays of the windows can ask for.

        Numbers rise, with gaps. After one that falls those above it are forgotten.
        """
        if len(self.windows) > 1:
            self._sets[j] = gain_set
            limit = j - self.windows[-1][1]
            while not limit <= (oldest := next(iter(self._sets))) <= j:
                del self._sets[oldest]

    def covers(self, j: int, d: int) -> bool:
        """Return whether the set of a command fits the first delay reported of it, to within one sample."""
        if j <= self._applied or j not in self._sets:
            return True
        self._applied = j
        low, high = self.windows[self._sets[j]]
        return low - 1 <= d <= high + 1


@dataclass(slots=True)
class SetChanges:
    """The changes of the set that computed the flown commands; which of them are told of, as they may come often.

    Attributes
    ----------
    total : int
        All changes so far.
    untold : int
        Those since the last one told of.
    """

    total: int = 0
    untold: int = 0
    _flown: int | None = None
    _next_ns: int | None = None

    def flown(self, gain_set: int, now_ns: int) -> int:
        """Take the set of a flown command; return how many changes are to be told of now, as a rule none."""
        if self._flown is not None and gain_set != self._flown:
            self.total += 1
            self.untold += 1
        self._flown = gain_set
        if not self.untold or (self._next_ns is not None and now_ns < self._next_ns):
            return 0
        changes, self.untold, self._next_ns = self.untold, 0, now_ns + TELL_NS
        return changes
