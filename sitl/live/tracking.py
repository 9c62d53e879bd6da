"""Samples and commands of a running flight, put on one axis of time, and the error of Eq. (10) as it comes.

:class:`sitl.flightdata.FlightData` does this for a whole recording; here it is done sample by sample, with what is
known so far. The reference of sample k takes the r of all samples before, which the commands tell, and they come an
uplink later: so a sample waits for the first command from it or a later one, at most ``MAX_WAIT_S``. What that comes
to at the end of a flight is the report's number.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from autopilot.profile import parse_profile
from gains.model import Matrix, Model
from gains.table import InputError

__all__ = ["MAX_GAP", "MAX_WAITING", "MAX_WAIT_S", "Sample", "Tracking"]

MAX_WAIT_S = 0.5
"""How long a sample waits for a command; the last r that is known stands in then."""
MAX_WAITING = 1 << 12
"""Samples that wait, and commands that are remembered."""
MAX_GAP = 100_000
"""Samples in a row that may be missing; a number further on is refused."""
MAX_STARTS = 64
"""Restarts of the plant that are remembered."""

_PATHS = "file:"


class Sample(NamedTuple):
    """One sample of the plant, complete.

    Attributes
    ----------
    place : int
        Where it is on the axis of time, samples.
    k : int
        Its number, as the plant counts.
    y, yr, e : tuple of float
        Output, reference and error, absolute but for e, in units of the outputs. yr is nan without a reference.
    u : tuple of float
        Control held from it on, absolute.
    d : int or None
        True delay; None before the first command.
    engaged : bool
        Whether the law was to fly.
    """

    place: int
    k: int
    y: tuple[float, ...]
    yr: tuple[float, ...]
    e: tuple[float, ...]
    u: tuple[float, ...]
    d: int | None
    engaged: bool


class _Truth(NamedTuple):
    place: int
    k: int
    x: Matrix
    u: Matrix
    d: int | None
    start: int


@dataclass(slots=True)
class _Told:
    """What commands said, by place: the latest ``MAX_WAITING`` of them."""

    places: list[int] = field(default_factory=list)
    values: list[Any] = field(default_factory=list)

    def add(self, place: int, value: Any) -> None:
        at = bisect_right(self.places, place)
        self.places.insert(at, place)
        self.values.insert(at, value)
        if len(self.places) > MAX_WAITING:
            del self.places[: MAX_WAITING // 2], self.values[: MAX_WAITING // 2]

    def at(self, place: int, since: int, otherwise: Any) -> Any:
        """Return what was said last at a place or before, but not before ``since``."""
        at = bisect_right(self.places, place) - 1
        return self.values[at] if at >= 0 and self.places[at] >= since else otherwise


class Tracking:
    """Places samples and commands, and finds the error of each sample.

    Parameters
    ----------
    model : Model
        What is flown, with its reference model if it has one.
    programmed : str
        The programmed reference as the recording names it; it holds until a command says another r.

    Attributes
    ----------
    zero_ns : int or None
        Log time of sample 0.
    """

    def __init__(self, model: Model, programmed: str = "") -> None:
        self.model = model
        self.zero_ns: int | None = None
        self._profile = None
        if programmed and _PATHS not in programmed:  # a recording may name any file: that is not read
            try:
                self._profile = parse_profile(programmed, model.Ts)
            except InputError:
                self._profile = None
        self._starts = [0]
        self._waiting: deque[_Truth] = deque()
        self._newest = -1
        self._r = _Told()
        self._engaged = _Told()
        self._newest_command = -1
        self._xr = np.zeros(model.nr)
        self._xr_place = 0
        self._wait = max(1, math.ceil(MAX_WAIT_S / model.Ts))

    def truth(self, log_time_ns: int, body: Mapping[str, Any]) -> int:
        """Take a body of ``plant/truth``; return its place.

        Raises
        ------
        ValueError, TypeError, KeyError
            If it is none, or too far on.
        """
        model, k, d = self.model, _integer(body["k"]), body["d"]
        x, u = _vector(body["x"], model.nx), _vector(body["u"], model.nu)
        zero_ns = log_time_ns - k * model.Ts_ns if self.zero_ns is None else self.zero_ns
        place = self._starts[-1] + k
        if place > self._newest + MAX_GAP:
            raise ValueError(f"sample {k} is too far on")
        if place <= self._newest:
            place = max(round((log_time_ns - zero_ns) / model.Ts_ns), self._newest + 1)
            if place > self._newest + MAX_GAP:
                raise ValueError(f"sample {k} is too far on")
            self._starts = [*self._starts[1 - MAX_STARTS :], place - k]
        self.zero_ns, self._newest = zero_ns, place
        self._waiting.append(_Truth(place, k, x, u, None if d is None else _integer(d), self._starts[-1]))
        return place

    def command(self, body: Mapping[str, Any]) -> int | None:
        """Take a body of ``autopilot/command``; return its place, None when it is from before a restart.

        Raises
        ------
        ValueError, TypeError, KeyError
            If it is none.
        """
        place = self._place(_integer(body["j"]))
        if place is None:
            return None
        r = body["r"]
        if r is not None and self.model.reference is not None:
            told = _vector(r, self.model.reference.Br.shape[1])
            self._r.add(place, told)
            if self._profile is not None and told.tolist() != [self._programmed(place)]:
                self._profile = None
        flies = bool(body.get("armed", True)) and body.get("flight_mode") != "MANUAL"
        self._engaged.add(place, flies)
        self._newest_command = max(self._newest_command, place)
        return place

    def complete(self, *, end: bool = False) -> Iterator[Sample]:
        """Yield the samples that need not wait any longer; all of them at the ``end``."""
        while self._waiting:
            oldest = self._waiting[0]
            waited = self._newest - oldest.place >= self._wait or len(self._waiting) > MAX_WAITING
            if not (end or waited or oldest.place <= self._newest_command or oldest.start != self._starts[-1]):
                return
            self._waiting.popleft()
            yield self._sample(oldest)

    def time_s(self, log_time_ns: int) -> float:
        """Return a log time as seconds from sample 0; from the log's own zero while there is none."""
        return (log_time_ns - (self.zero_ns or 0)) / 1e9

    def _place(self, j: int) -> int | None:
        """Return where sample j lies: in the latest start that had reached it, or is about to."""
        newest = self._newest + 1
        for start in reversed(self._starts):
            if start + j <= newest or len(self._starts) == 1:
                return start + j
            newest = min(newest, start - 1)
        return None

    def _programmed(self, place: int) -> float:
        assert self._profile is not None
        return float(self._profile.r(place - max((s for s in self._starts if s <= place), default=0)))

    def _reference_input(self, place: int, start: int) -> Matrix:
        assert self.model.reference is not None
        width = self.model.reference.Br.shape[1]
        if self._profile is not None and width == 1:
            return np.array([self._programmed(place)])
        told: Matrix = self._r.at(place, start, np.zeros(width))
        return told

    def _sample(self, truth: _Truth) -> Sample:
        model, reference = self.model, self.model.reference
        deviation = model.C @ (truth.x - model.trim.x) + model.D @ (truth.u - model.trim.u)
        trim = model.C @ model.trim.x + model.D @ model.trim.u
        yr = np.zeros(model.ny)
        with np.errstate(all="ignore"):  # a flight that diverged
            if reference is not None:
                if self._xr_place < truth.start:  # the plant has started anew
                    self._xr, self._xr_place = np.zeros(model.nr), truth.start
                while self._xr_place < truth.place:
                    r = self._reference_input(self._xr_place, truth.start)
                    self._xr = reference.Ar @ self._xr + reference.Br @ r
                    self._xr_place += 1
                yr = reference.Cr @ self._xr
            error = deviation - yr
            shown = trim + yr if reference is not None else np.full(model.ny, np.nan)
            return Sample(
                truth.place,
                truth.k,
                tuple((deviation + trim).tolist()),
                tuple(shown.tolist()),
                tuple(error.tolist()),
                tuple(truth.u.tolist()),
                truth.d,
                bool(self._engaged.at(truth.place, -MAX_GAP, True)),
            )


def _integer(value: object) -> int:
    if type(value) is not int:
        raise TypeError("no integer")
    return value


def _vector(value: object, width: int) -> Matrix:
    made = np.array(value, dtype=np.float64)
    if made.shape != (width,):
        raise ValueError(f"expected {width} numbers")
    return made
