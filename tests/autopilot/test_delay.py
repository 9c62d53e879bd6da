"""The forecast of d against the latch of the plant: the first sample at or after the arrival."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autopilot.delay import MIN_TRANSITS, STALE_NS, UNKNOWN, WINDOW, DelayEstimator, DelayStatus
from tests.helpers import MS, TS, S

quick = settings(deadline=None)


def true_d(arrival_ns: int, j: int = 0) -> int:
    """Return d by counting the plant's samples until one has the command."""
    k = j + 1
    while k * TS < arrival_ns:
        k += 1
    return k - j


@dataclass
class Loop:
    """A plant whose sample j is at j Ts of its clock, an autopilot ``offset_ns`` behind it, a link."""

    up_ns: int
    down_ns: int
    offset_ns: int = 0
    estimator: DelayEstimator = field(default_factory=lambda: DelayEstimator(TS))
    plant_ns: int = 0

    def transit(self, down_ns: int | None = None, up_ns: int | None = None) -> None:
        """Make one TIMESYNC exchange, and go on by 100 ms."""
        down_ns = self.down_ns if down_ns is None else down_ns
        up_ns = self.up_ns if up_ns is None else up_ns
        ts1 = self.plant_ns - self.offset_ns
        self.estimator.transit(self.plant_ns + down_ns, ts1, ts1 + down_ns + up_ns)
        self.plant_ns += 100 * MS

    def forecast(self, j: int, compute_ns: int = 0):
        """Forecast d for the command of sample j."""
        leaves_ns = j * TS + self.up_ns + compute_ns
        return self.estimator.forecast(j * TS, leaves_ns - self.offset_ns)


@quick
@given(
    st.integers(0, 150 * MS),
    st.integers(0, 150 * MS),
    st.integers(-(10**15), 10**15),
    st.integers(0, 10 * MS),
)
def test_constant_latencies_are_forecast_exactly_whatever_the_clocks(up_ns, down_ns, offset_ns, compute_ns):
    loop = Loop(up_ns, down_ns, offset_ns)
    for _ in range(MIN_TRANSITS):
        loop.transit()
    j = -(-loop.plant_ns // TS)
    forecast = loop.forecast(j, compute_ns)
    d = true_d(up_ns + compute_ns + down_ns)
    assert (forecast.d, forecast.low, forecast.high) == (d, d, d)
    assert forecast.status is DelayStatus.ESTIMATED


@pytest.mark.parametrize("offset_ns", [0, 905 * S, -905 * S])
def test_a_20_60_ms_link_and_its_mirror_image_have_the_same_d(offset_ns):
    found = []
    for up_ms, down_ms in ((20, 60), (60, 20), (40, 40)):
        loop = Loop(up_ms * MS, down_ms * MS, offset_ns)
        for _ in range(20):
            loop.transit()
        found.append(loop.forecast(100).d)
    assert found == [4, 4, 4]


@pytest.mark.parametrize(
    ("arrival_ns", "d"),
    [(0, 1), (1, 1), (TS - 1, 1), (TS, 1), (TS + 1, 2), (2 * TS, 2), (2 * TS + 1, 3), (4 * TS, 4), (4 * TS + 1, 5)],
)
def test_d_changes_just_after_a_sample(arrival_ns, d):
    assert true_d(arrival_ns) == d
    loop = Loop(0, arrival_ns)
    for _ in range(5):
        loop.transit()
    assert loop.forecast(100).d == d


def test_there_is_no_number_before_five_transits():
    loop = Loop(10 * MS, 10 * MS)
    for n in range(MIN_TRANSITS):
        assert n < 5
        assert loop.forecast(100) is UNKNOWN
        loop.transit()
    assert loop.forecast(100).d == 1
    assert (UNKNOWN.d, UNKNOWN.low, UNKNOWN.high, UNKNOWN.status) == (None, None, None, DelayStatus.UNKNOWN)


def test_after_five_seconds_of_silence_there_is_no_number():
    loop = Loop(0, 0)
    for _ in range(10):
        loop.transit()
    heard_ns = 900 * MS
    assert loop.estimator.forecast(0, heard_ns + STALE_NS).d is not None
    assert loop.estimator.forecast(0, heard_ns + STALE_NS + 1) is UNKNOWN
    assert STALE_NS == 5 * S


def test_transits_from_before_a_long_silence_do_not_describe_the_link_after_it():
    loop = Loop(10 * MS, 10 * MS)
    for _ in range(WINDOW):
        loop.transit()
    loop.plant_ns += 60 * S
    for _ in range(MIN_TRANSITS):
        loop.down_ns = 110 * MS
        loop.transit()
    forecast = loop.forecast(loop.plant_ns // TS)
    assert (forecast.d, forecast.low) == (5, 5)


def test_one_transit_after_a_long_silence_is_no_estimate():
    loop = Loop(10 * MS, 10 * MS)
    for _ in range(WINDOW):
        loop.transit()
    loop.plant_ns += 60 * S
    loop.transit()
    assert loop.forecast(loop.plant_ns // TS) is UNKNOWN


def test_a_clock_step_forgets_every_transit():
    loop = Loop(10 * MS, 10 * MS)
    for _ in range(WINDOW):
        loop.transit()
    loop.estimator.forget()
    assert loop.forecast(loop.plant_ns // TS) is UNKNOWN


def test_the_window_is_bounded_and_follows_the_link():
    loop = Loop(0, 10 * MS)
    for _ in range(500):
        loop.transit()
    assert len(loop.estimator._transits) == WINDOW
    for _ in range(WINDOW):
        loop.transit(down_ns=60 * MS)
    forecast = loop.forecast(loop.plant_ns // TS)
    assert (forecast.low, forecast.d, forecast.high) == (3, 3, 3)


@quick
@given(st.integers(0, 2**32), st.integers(0, 40 * MS), st.integers(1, 80 * MS))
def test_the_interval_holds_the_truth_for_jitter_that_the_window_has_seen(seed, base_ns, width_ns):
    rng = np.random.default_rng(seed)
    loop = Loop(15 * MS, base_ns)
    seen = []
    for _ in range(WINDOW):
        seen.append(base_ns + int(rng.integers(0, width_ns)))
        loop.transit(down_ns=seen[-1], up_ns=int(rng.integers(0, 50 * MS)))
    j = loop.plant_ns // TS
    forecast = loop.forecast(j)
    for down_ns in rng.choice(seen, 20):
        assert forecast.low <= true_d(15 * MS + int(down_ns)) <= forecast.high
    assert forecast.low <= forecast.d <= forecast.high
    assert forecast.low == true_d(15 * MS + min(seen))
    assert forecast.high == true_d(15 * MS + max(seen))


def test_the_forecast_is_the_median_of_the_recent_transits():
    loop = Loop(0, 10 * MS)
    for n in range(WINDOW):
        loop.transit(down_ns=(10 if n % 4 else 200) * MS)
    forecast = loop.forecast(loop.plant_ns // TS)
    assert (forecast.low, forecast.d, forecast.high) == (1, 1, 8)
