"""The delay and the clocks as numbers that a ground station plots, and as records.

Everything goes out as NAMED_VALUE_INT or NAMED_VALUE_FLOAT:

=========== ===== ==== ======= =============================================================================
name        type  Hz   unit    meaning
=========== ===== ==== ======= =============================================================================
D_EST       int   5    samples forecast delay of the newest command
D_LOW       int   5    samples least delay that the forecast allows
D_HIGH      int   5    samples greatest delay that the forecast allows
D_PROB      float 5    %       probability that the true delay lies in D_LOW to D_HIGH
D_MEAN      float 1    samples mean of the true delays that the plant reported in this second
D_MAX       int   1    samples greatest of them
D_EXACT     float 1    %       share of the latest forecasts (1000) that were exactly right
D_COVER     float 1    %       share of them whose interval held the true delay: what D_PROB promised
RTT_MS      float 1    ms      median TIMESYNC round trip of this second
CLK_ERR_MS  float 1    ms      largest error that the offset of the clocks can have
CLK_PPM     float 1    ppm     by how much the plant's clock runs faster than ours, the best guess
=========== ===== ==== ======= =============================================================================

What is unknown is not sent, and nothing is sent twice: a forecast, a second of reports or of round trips without
news is a gap in the plot. The share of right forecasts is sent while forecasts are scored; the clocks' numbers
while the clocks are synchronised, the skew from when there is a guess of it.

The record ``autopilot/estimate`` says the same of each second, in ns, ppb and shares of 1, and null for what is
unknown.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from statistics import median_low

from autopilot.clocksync import MAX_DRIFT_PPB, ClockEstimate, ClockStatus, ClockSync
from autopilot.delay import DelayEstimate, DelayEstimator
from autopilot.link.clock import NS_PER_MS, NS_PER_S, following
from autopilot.link.node import Record
from autopilot.link.wire import Message, NamedValueFloat, NamedValueInt

__all__ = ["DelayTelemetry", "Second", "record"]

FORECAST_NS = NS_PER_S // 5
"""Period of what a forecast says."""
SECOND_NS = NS_PER_S
"""Period of everything else, and of the records."""
MAX_ROUND_TRIPS = 64
"""The median is of so many round trips at the most, the latest."""

_MAX_INT32 = (1 << 31) - 1
_INT64 = 1 << 63
_PERCENT = 100.0
_PPB_PER_PPM = 1000.0


@dataclass(frozen=True, slots=True)
class Second:
    """What was measured in one second; None for what was not.

    Attributes
    ----------
    d_mean : float or None
        Mean delay that the plant reported, samples.
    d_max : int or None
        Greatest of them, samples.
    round_trip_ns : int or None
        Median TIMESYNC round trip.
    """

    d_mean: float | None = None
    d_max: int | None = None
    round_trip_ns: int | None = None


class DelayTelemetry:
    """What ground stations and recordings are told of delay and clocks, and when; own time passed in."""

    def __init__(self) -> None:
        self._forecast: DelayEstimate | None = None
        self._reports = self._sum = self._max = 0
        self._round_trips: deque[int] = deque(maxlen=MAX_ROUND_TRIPS)
        self._scored = 0
        self._next_forecast_ns: int | None = None
        self._next_second_ns: int | None = None

    def note_forecast(self, forecast: DelayEstimate) -> None:
        """Take the forecast of a command."""
        self._forecast = forecast

    def note_report(self, d: int) -> None:
        """Take a delay as the plant reported it, samples; below 1 there is none, and it is not believed."""
        if d < 1:
            return
        self._max = max(self._max, d)
        self._sum += d
        self._reports += 1

    def note_round_trip(self, round_trip_ns: int) -> None:
        """Take the round trip of one TIMESYNC exchange."""
        self._round_trips.append(round_trip_ns)

    def next_deadline_ns(self) -> int | None:
        """Return when :meth:`due` has something to say next; None before its first call."""
        if self._next_forecast_ns is None or self._next_second_ns is None:
            return None
        return min(self._next_forecast_ns, self._next_second_ns)

    def due(self, now_ns: int, clock: ClockSync, delay: DelayEstimator) -> tuple[list[Message], list[Record]]:
        """Return what is to be shown and recorded at ``now_ns``; mostly nothing. The first call starts the periods."""
        if self._next_forecast_ns is None or self._next_second_ns is None:
            self._next_forecast_ns, self._next_second_ns = now_ns + FORECAST_NS, now_ns + SECOND_NS
        messages: list[Message] = []
        records: list[Record] = []
        if now_ns >= self._next_forecast_ns:
            self._next_forecast_ns = following(self._next_forecast_ns, FORECAST_NS, now_ns)
            messages += self._forecast_messages(now_ns)
        if now_ns >= self._next_second_ns:
            self._next_second_ns = following(self._next_second_ns, SECOND_NS, now_ns)
            second = self._end_second()
            messages += self._second_messages(now_ns, second, clock, delay)
            records.append(record(now_ns, second, clock, delay))
        return messages, records

    def _forecast_messages(self, now_ns: int) -> list[Message]:
        """Return the newest forecast, when there is a new one and it is known."""
        forecast, self._forecast = self._forecast, None
        if forecast is None or forecast.d is None or forecast.low is None or forecast.high is None:
            return []
        if forecast.high > _MAX_INT32:
            return []  # an absurd stamp of the plant's: the message cannot hold it
        ms = now_ns // NS_PER_MS
        messages: list[Message] = [
            NamedValueInt(ms, "D_EST", forecast.d),
            NamedValueInt(ms, "D_LOW", forecast.low),
            NamedValueInt(ms, "D_HIGH", forecast.high),
        ]
        if forecast.probability is not None:
            messages.append(NamedValueFloat(ms, "D_PROB", _PERCENT * forecast.probability))
        return messages

    def _end_second(self) -> Second:
        """Return what was measured since the last call, and forget it."""
        second = Second(
            self._sum / self._reports if self._reports else None,
            self._max if self._reports else None,
            median_low(self._round_trips) if self._round_trips else None,
        )
        self._reports = self._sum = self._max = 0
        self._round_trips.clear()
        return second

    def _second_messages(self, now_ns: int, second: Second, clock: ClockSync, delay: DelayEstimator) -> list[Message]:
        """Return what is known of the second, of the forecasts scored in it, and of the clocks."""
        ms = now_ns // NS_PER_MS
        messages: list[Message] = []
        if second.d_mean is not None and second.d_max is not None:
            messages += [NamedValueFloat(ms, "D_MEAN", second.d_mean), NamedValueInt(ms, "D_MAX", second.d_max)]
        if delay.scored > self._scored:
            self._scored = delay.scored
            messages.append(NamedValueFloat(ms, "D_EXACT", _PERCENT * delay.exact))
            messages.append(NamedValueFloat(ms, "D_COVER", _PERCENT * delay.covered))
        if second.round_trip_ns is not None:
            messages.append(NamedValueFloat(ms, "RTT_MS", second.round_trip_ns / NS_PER_MS))
        estimate = clock.estimate(now_ns)
        if estimate.status is not ClockStatus.UNSYNCHRONISED:
            messages.append(NamedValueFloat(ms, "CLK_ERR_MS", estimate.bound_ns / NS_PER_MS))
        if _skew_known(estimate):
            messages.append(NamedValueFloat(ms, "CLK_PPM", estimate.skew_ppb / _PPB_PER_PPM))
        return messages


def _skew_known(estimate: ClockEstimate) -> bool:
    """Return whether the skew is more than the 0 at which every guess starts."""
    learned = estimate.skew_ppb != 0.0 or estimate.skew_bound_ppb < MAX_DRIFT_PPB
    return estimate.status is ClockStatus.LOCKED and learned


def record(now_ns: int, second: Second, clock: ClockSync, delay: DelayEstimator) -> Record:
    """Return the record ``autopilot/estimate`` of the second that ends at ``now_ns``; null for what is unknown."""
    estimate = clock.estimate(now_ns)
    known = (
        estimate.status is not ClockStatus.UNSYNCHRONISED
        and -_INT64 <= estimate.offset_ns < _INT64
        and estimate.bound_ns < _INT64  # a forged stamp: JSON's integers here have 64 bits
    )
    body = {
        "offset_ns": estimate.offset_ns if known else None,
        "offset_bound_ns": estimate.bound_ns if known else None,
        "skew_ppb": estimate.skew_ppb if known else None,
        "skew_bound_ppb": estimate.skew_bound_ppb if known else None,
        "clock": estimate.status,
        "round_trip_ns": second.round_trip_ns,
        "d_mean": second.d_mean,
        "d_max": second.d_max,
        "exact": delay.exact if delay.scored else None,
        "covered": delay.covered if delay.scored else None,
        "changes": delay.changes,
        "shift_ns": delay.shift_ns,
        "unmatched": clock.unmatched,
        "steps": clock.steps,
    }
    return Record("autopilot/estimate", now_ns, body)
