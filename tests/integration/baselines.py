"""What others do with TIMESYNC, from its published description, turned into a forecast of the loop delay.

Each estimator is fed the exchanges and samples of one recording, and asked for every command that was applied. mavros
and PX4 turn a peer's stamp into own time, which gives the sample's age, and report the round trip: who wants to know
when a command will be in force adds half the mean round trip of the last exchanges to the age. The same is done with
the age that ArduPilot's one-way minimum gives. Until mavros and PX4 have converged they take a stamp for "now": the age
reads 0.

References
----------
mavros, ``sys_time``; PX4, ``Timesync``; ArduPilot, ``JitterCorrection``: the defaults of each.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from autopilot.clocksync import ClockSync
from autopilot.link.clock import NS_PER_MS, NS_PER_S
from tests.integration.estimation import SETTLED_S, TS_NS, Flight, Floats, Forecasts, Ints

__all__ = ["BASELINES", "Holt", "OneWayMinimum", "Row", "compare"]

GATE_NS = 10 * NS_PER_MS
"""Round trips above it are not used."""
MAX_DEVIATION_NS = 100 * NS_PER_MS
WINDOW = 500
"""Exchanges before the filter has converged."""
FIRST_GAIN, LAST_GAIN = 0.05, 0.003
"""Of alpha and beta both."""
ONE_WAY_SAMPLES = 100
ROUND_TRIPS = 100
"""Over so many the round trip is averaged: 10 s."""


class OffsetEstimator(Protocol):
    """Offset of the plant's clock, its time minus ours."""

    def exchange(self, ts1: int, tc1: int, now_ns: int) -> None:
        """Take an exchange."""

    def sample(self, stamp_ns: int, now_ns: int) -> None:
        """Take the stamp of a sample that has come."""

    def offset_ns(self, now_ns: int) -> float | None:
        """Return the offset; None before there is one."""


class Holt:
    """Double exponential smoothing of the offset that half a round trip gives: mavros and PX4.

    Parameters
    ----------
    deviations : int
        After more of them in a row it begins anew: 10 in mavros, 5 in PX4.
    gate_ns : float
        Longest round trip that is used.
    """

    def __init__(self, deviations: int, gate_ns: float = GATE_NS) -> None:
        self._deviations, self._gate_ns = deviations, gate_ns
        self._begin()

    def _begin(self) -> None:
        self._n = self._deviated = 0
        self._offset = self._step = 0.0

    def exchange(self, ts1: int, tc1: int, now_ns: int) -> None:
        if now_ns - ts1 >= self._gate_ns:
            return
        observed = tc1 - (ts1 + now_ns) / 2.0
        if self._n >= WINDOW and abs(observed - self._offset) > MAX_DEVIATION_NS:
            self._deviated += 1
            if self._deviated > self._deviations:
                self._begin()
            return
        last = 1.0
        if self._n < WINDOW:
            last = 1.0 - math.exp(0.5 * (1.0 - 1.0 / (1.0 - self._n / WINDOW)))
        gain = last * LAST_GAIN + (1.0 - last) * FIRST_GAIN
        before = self._offset
        if self._n == 0:
            self._offset = observed
        else:
            self._offset = gain * observed + (1.0 - gain) * (self._offset + self._step)
            self._step = gain * (self._offset - before) + (1.0 - gain) * self._step
        self._n += 1
        self._deviated = 0

    def sample(self, stamp_ns: int, now_ns: int) -> None:
        pass

    def offset_ns(self, now_ns: int) -> float | None:
        return self._offset if self._n >= WINDOW else None


class OneWayMinimum:
    """The shortest way that a stamp has taken, renewed every 100 samples: ArduPilot."""

    def __init__(self) -> None:
        self._way: int | None = None
        self._least: int | None = None
        self._n = 0

    def exchange(self, ts1: int, tc1: int, now_ns: int) -> None:
        pass

    def sample(self, stamp_ns: int, now_ns: int) -> None:
        way = now_ns - stamp_ns
        if self._way is None or way < self._way:
            self._way = way
        self._least = way if self._least is None else min(self._least, way)
        self._n += 1
        if self._n == ONE_WAY_SAMPLES:
            self._way, self._least, self._n = self._least, None, 0

    def offset_ns(self, now_ns: int) -> float | None:
        return None if self._way is None else float(-self._way)


class _Ours:
    """The offset of :mod:`autopilot.clocksync`, for its error alone."""

    def __init__(self) -> None:
        self._clock = ClockSync()

    def exchange(self, ts1: int, tc1: int, now_ns: int) -> None:
        self._clock.request(ts1)
        self._clock.answer(tc1, ts1, now_ns)

    def sample(self, stamp_ns: int, now_ns: int) -> None:
        pass

    def offset_ns(self, now_ns: int) -> float | None:
        line = self._clock.line(now_ns)
        return None if line is None else float(line.at(now_ns))


# a link of 10 ms or more passes no gate of 10 ms, so there is one filter without it
BASELINES: dict[str, Callable[[], OffsetEstimator]] = {
    "mavros": lambda: Holt(10),
    "PX4": lambda: Holt(5),
    "no gate": lambda: Holt(10, math.inf),
    "one-way": OneWayMinimum,
}
OURS = "ours"


@dataclass(frozen=True, slots=True)
class _Heard:
    """What an estimator said of each command: the offset, and the mean round trip then."""

    offset_ns: Floats
    round_trip_ns: Floats
    usable_s: float


class Row(NamedTuple):
    """One estimator on one flight.

    Attributes
    ----------
    who : str
        Its name.
    bias_ms, spread_ms : float
        Mean and standard deviation of the error of the one-way offset after the first seconds; nan for none.
    wrong : float
        Share of wrong d.
    usable_s : float
        From the first request of TIMESYNC until it gives an offset; nan for never.
    usable_wrong, ours_wrong : float
        Share of wrong d among the commands for which it had an offset, and ours among the same; nan for none.
    """

    who: str
    bias_ms: float
    spread_ms: float
    wrong: float
    usable_s: float
    usable_wrong: float
    ours_wrong: float


def compare(flight: Flight) -> list[Row]:
    """Return the rows of a flight, ours first."""
    rows, d = flight.applied
    ours = Forecasts.of(flight).d != d
    plant = flight.scenario.clocks["plant"]
    left, true_ns = flight.commands[:, 2], flight.commands[:, 3]
    true_offset = np.array([plant.node_ns(int(t)) for t in true_ns], dtype=np.int64) - left
    settled = true_ns >= true_ns[0] + SETTLED_S * NS_PER_S
    found = []
    makers: dict[str, Callable[[], OffsetEstimator]] = {OURS: _Ours, **BASELINES}
    for who, make in makers.items():
        heard = _replay(flight, make())
        errors = ((heard.offset_ns - true_offset) / NS_PER_MS)[settled]
        errors = errors[np.isfinite(errors)]
        wrong = ours if who == OURS else _delays(flight, heard)[rows] != d
        usable = np.isfinite(heard.offset_ns[rows])
        found.append(
            Row(
                who,
                _mean(errors),
                float(errors.std()) if errors.size else math.nan,
                _mean(wrong),
                heard.usable_s,
                _mean(wrong[usable]),
                _mean(ours[usable]),
            )
        )
    return found


def _mean(values: NDArray[Any]) -> float:
    return float(values.mean()) if values.size else math.nan


def _delays(flight: Flight, heard: _Heard) -> Ints:
    """Return the forecast d of all commands: age and half the round trip."""
    ages = flight.commands[:, 2] + heard.offset_ns - flight.commands[:, 1]
    ages = np.where(np.isfinite(ages), ages, 0.0)
    d: Ints = np.maximum(1, np.ceil((ages + heard.round_trip_ns / 2.0) / TS_NS)).astype(np.int64)
    return d


def _replay(flight: Flight, estimator: OffsetEstimator) -> _Heard:
    """Feed an estimator in the order in which the autopilot heard."""
    offsets, means = [], []
    trips: deque[int] = deque(maxlen=ROUND_TRIPS)
    usable_s = math.nan
    exchanges = iter(flight.exchanges.tolist())
    following = next(exchanges, None)
    begun_ns = int(flight.exchanges[0, 0])
    for _, stamp_ns, now_ns, *_ in flight.commands.tolist():
        while following is not None and following[2] <= now_ns:
            trips.append(following[2] - following[0])
            estimator.exchange(*following)
            following = next(exchanges, None)
        estimator.sample(stamp_ns, now_ns)
        offset_ns = estimator.offset_ns(now_ns)
        if offset_ns is not None and math.isnan(usable_s):
            usable_s = (now_ns - begun_ns) / NS_PER_S
        offsets.append(math.nan if offset_ns is None else offset_ns)
        means.append(sum(trips) / len(trips) if trips else 0.0)
    return _Heard(np.array(offsets), np.array(means), usable_s)
