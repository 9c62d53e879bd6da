"""The control law, Eq. (9): u(k) = K1 x(k - d(k)) + K2 xr(k), around trim, within the elevator's travel.

Of a schedule's sets of gains, the forecast delay of a command chooses the one that computes it.

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

__all__ = ["ChosenSets", "Law", "SetChanges", "Window", "choose_set", "law_of"]

TELL_NS = NS_PER_S
"""Changes of the set in force are told of at most once in this time."""

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


def choose_set(windows: Sequence[Window], present: int, d: int | None) -> int:
    """Return the index of the set of gains for a command whose delay is forecast as d.

    The present set stays while its window contains d, so that a delay that wanders between two windows does not
    switch at every sample. Otherwise it is the set whose window has the most room around d, min(d - d_min, d_max - d);
    of equals the one with the narrower window, and of those the first. An unknown delay, or one that no window
    contains, changes nothing: failsafe decides there.

    Parameters
    ----------
    windows : sequence of Window
        Of each set, in the order of the schedule; one for plain gains.
    present : int
        Index of the set in force.
    d : int or None
        Forecast delay, samples; None when unknown.
    """
    if d is None:
        return present
    d_min, d_max = windows[present]
    if d_min <= d <= d_max:
        return present
    rooms = [(min(d - low, high - d), low - high, -i) for i, (low, high) in enumerate(windows) if low <= d <= high]
    return -max(rooms)[2] if rooms else present


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
        """Remember the set of the command of sample j, and no more than the delays of the windows can ask for."""
        if len(self.windows) > 1:
            self._sets[j] = gain_set
            self._sets.pop(j - self.windows[-1][1] - 1, None)

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
