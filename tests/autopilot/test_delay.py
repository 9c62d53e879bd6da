"""The forecast of d against the latch of a simulated plant: the first sample at or after the arrival."""

from __future__ import annotations

import heapq
import math
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autopilot import delay
from autopilot.clocksync import ClockLine
from autopilot.delay import (
    COVERAGE,
    FORGET_NS,
    MANY_TRANSITS,
    MIN_TRANSITS,
    STALE_NS,
    UNKNOWN,
    DelayEstimate,
    DelayEstimator,
    DelayStatus,
)
from tests.helpers import MS, TS, S

quick = settings(deadline=None, max_examples=60)
Draw = Callable[[np.random.Generator], float]
"""One transit, ms."""


def constant_ms(value: float) -> Draw:
    return lambda _rng: value


def gamma_ms(base: float, mean: float) -> Draw:
    return lambda rng: base + rng.gamma(2.0, mean / 2.0)


def uniform_ms(low: float, high: float) -> Draw:
    return lambda rng: rng.uniform(low, high)


EIGHT_MS = constant_ms(8.0)


def true_d(loop_ns: int) -> int:
    """Return d by counting the plant's samples until one has the command."""
    k = 1
    while k * TS < loop_ns:
        k += 1
    return k


# links that do not change: transits alone


@dataclass
class Loop:
    """A plant whose sample j is at j Ts of its clock, an autopilot ``offset_ns`` behind it, a constant link."""

    up_ns: int = 10 * MS
    down_ns: int = 10 * MS
    offset_ns: int = 0
    plant_ns: int = 0
    skew_ppb: int = 0

    def __post_init__(self) -> None:
        self.estimator = DelayEstimator(TS)

    def own_ns(self, plant_ns: int) -> int:
        return plant_ns - self.offset_ns - plant_ns * self.skew_ppb // S

    def line(self) -> ClockLine:
        """Return the line of the clocks through now."""
        own_ns = self.own_ns(self.plant_ns)
        skew = self.skew_ppb / S
        return ClockLine(own_ns, self.plant_ns - own_ns, skew / (1.0 - skew) * S)

    def transits(self, count: int, *downs_ns: int) -> Loop:
        """Make TIMESYNC exchanges 100 ms apart, the transits in turn; renew whenever it is due."""
        for n in range(count):
            down_ns = downs_ns[n % len(downs_ns)] if downs_ns else self.down_ns
            ts1 = self.own_ns(self.plant_ns)
            self.estimator.transit(self.plant_ns + down_ns, ts1, ts1 + down_ns + self.up_ns)
            self.plant_ns += 100 * MS
            if self.estimator.due:
                self.estimator.renew(self.line())
        return self

    def forecast(self, compute_ns: int = 0) -> DelayEstimate:
        """Forecast d for the command of the newest sample."""
        sample_ns = self.plant_ns // TS * TS
        leaves_ns = sample_ns + self.up_ns + compute_ns
        return self.estimator.forecast(sample_ns, self.own_ns(leaves_ns))

    @property
    def now_ns(self) -> int:
        """Own time when the last exchange was over."""
        return self.own_ns(self.plant_ns - 100 * MS) + self.down_ns + self.up_ns


@quick
@given(
    st.integers(0, 150 * MS),
    st.integers(0, 150 * MS),
    st.integers(-(10**15), 10**15),
    st.integers(0, 10 * MS),
    st.integers(MIN_TRANSITS, 100),
)
def test_constant_latencies_are_forecast_exactly_whatever_the_clocks(up_ns, down_ns, offset_ns, compute_ns, count):
    forecast = Loop(up_ns, down_ns, offset_ns).transits(count).forecast(compute_ns)
    d = true_d(up_ns + compute_ns + down_ns)
    assert (forecast.d, forecast.low, forecast.high) == (d, d, d)


@pytest.mark.parametrize("offset_ns", [0, 905 * S, -905 * S])
def test_a_20_60_ms_link_and_its_mirror_image_have_the_same_d_by_a_line_that_takes_them_as_symmetric(offset_ns):
    found = []
    for up_ms, down_ms in ((20, 60), (60, 20), (40, 40)):
        loop = Loop(up_ms * MS, down_ms * MS, offset_ns).transits(20)
        biased = replace(loop.line(), offset_ns=loop.line().offset_ns + (down_ms - up_ms) * MS // 2)
        loop.estimator.renew(biased)
        found.append(loop.forecast().d)
    assert found == [4, 4, 4]


@pytest.mark.parametrize(
    ("loop_ns", "d"),
    [(0, 1), (1, 1), (TS - 1, 1), (TS, 1), (TS + 1, 2), (2 * TS, 2), (2 * TS + 1, 3), (4 * TS, 4), (4 * TS + 1, 5)],
)
def test_d_changes_just_after_a_sample(loop_ns, d):
    assert true_d(loop_ns) == d
    assert Loop(0, loop_ns).transits(5).forecast().d == d


def test_a_command_in_time_with_one_of_several_transits_is_in_time_at_the_very_nanosecond():
    loop = Loop(0).transits(99, 10 * MS, 20 * MS, 30 * MS)
    before, at = loop.forecast(TS - 20 * MS), loop.forecast(TS - 20 * MS + 1)
    assert (before.d, at.d) == (1, 2)  # two of three transits are in time, or only one


@pytest.mark.parametrize("skew_ppm", [-400, 0, 400])
@pytest.mark.parametrize("margin_us", [-1, 1])
def test_the_skew_of_the_clocks_does_not_blur_a_window_of_100_s(skew_ppm, margin_us):
    loop = Loop(0, 2 * TS + margin_us * 1000, 77 * S, skew_ppb=skew_ppm * 1000).transits(1100)
    law = loop.estimator._law
    assert law is not None
    assert law.transits[-1] - law.transits[0] <= 4  # where 100 s of 400 ppm are 40 ms
    forecast = loop.forecast()
    assert (forecast.low, forecast.d, forecast.high) == ((2, 2, 2) if margin_us < 0 else (3, 3, 3))


# never a number when unknown


def test_there_is_no_number_before_five_transits():
    loop = Loop()
    for _ in range(MIN_TRANSITS):
        assert loop.forecast() is UNKNOWN
        assert not loop.estimator.ready(loop.now_ns)
        loop.transits(1)
    assert MIN_TRANSITS == 5
    assert loop.forecast().d == 1
    assert loop.estimator.ready(loop.now_ns)
    assert UNKNOWN[:4] == (None, None, None, None)
    assert UNKNOWN.status is DelayStatus.UNKNOWN


def test_after_five_seconds_without_transit_and_report_there_is_no_number():
    loop = Loop().transits(10)
    assert STALE_NS == 5 * S
    assert loop.estimator.forecast(0, loop.now_ns + STALE_NS).d is not None
    assert loop.estimator.ready(loop.now_ns + STALE_NS)
    assert loop.estimator.forecast(0, loop.now_ns + STALE_NS + 1) is UNKNOWN
    assert not loop.estimator.ready(loop.now_ns + STALE_NS + 1)


def told(estimator: DelayEstimator, j: int, d: int, now_ns: int, forecast: DelayEstimate = UNKNOWN) -> None:
    """Let the command of sample j be applied with delay d, with another one in force before."""
    estimator.sent(j, j * TS, now_ns, forecast)
    estimator.report(j + d - 1, j - 1, now_ns)
    estimator.report(j + d, j, now_ns)


def test_reports_alone_keep_the_forecast_alive():
    loop = Loop().transits(10)
    e, now_ns = loop.estimator, loop.now_ns
    for j in range(1, 20):
        now_ns += 4 * S
        told(e, j * 100, 1, now_ns)
        assert e.ready(now_ns + STALE_NS)
        assert e.forecast(0, now_ns + STALE_NS).d is not None
    assert e.forecast(0, now_ns + STALE_NS + 1) is UNKNOWN


def test_reports_alone_are_no_beginning():
    e = DelayEstimator(TS)
    for j in range(1, 200):
        told(e, 10 * j, 1, j * S)
    assert e.forecast(0, 200 * S) is UNKNOWN
    assert not e.due


def test_transits_from_before_half_a_minute_of_silence_do_not_describe_the_link_after_it():
    for silence_ns, forgotten in ((FORGET_NS, False), (FORGET_NS + 1, True)):
        loop = Loop().transits(60)
        loop.plant_ns += silence_ns - 100 * MS + 20 * MS - 120 * MS
        loop.down_ns = 110 * MS
        loop.transits(1)
        assert (loop.forecast() is UNKNOWN) is forgotten
        loop.transits(MIN_TRANSITS)
        assert loop.forecast().low == (5 if forgotten else 1)


def test_forget_leaves_nothing_but_the_scores():
    loop = Loop().transits(70)
    for j in range(1, 50):
        told(loop.estimator, j, 1, loop.now_ns, loop.forecast())
    loop.estimator.forget()
    assert loop.forecast() is UNKNOWN
    assert (loop.estimator.due, loop.estimator.shift_ns) == (False, 0)
    assert (loop.estimator.scored, loop.estimator.exact) == (49, 1.0)
    loop.down_ns = 60 * MS
    assert loop.transits(MIN_TRANSITS).forecast()[:3] == (3, 3, 3)


# intervals and probabilities by hand


@pytest.mark.parametrize("n", [5, 20, 63, 64, 200])
def test_alike_transits_leave_little_doubt_five_milliseconds_before_the_sample(n):
    loop = Loop().transits(n)
    loop.estimator.renew(loop.line())
    assert loop.forecast().probability == pytest.approx(1.0 - math.exp(-5.0) / (n + 1))


@pytest.mark.parametrize("n", [5, 12, 40])
@pytest.mark.parametrize("kind", ["gamma", "uniform"])
def test_few_transits_hold_at_least_as_often_as_they_say(kind, n):
    rng = np.random.default_rng(n)
    stated, held = [], []
    for _ in range(200):
        jitter = 5 * rng.standard_gamma(2, n + 50) if kind == "gamma" else 30 * rng.random(n + 50)
        downs = ((20 + jitter) * MS).astype(int).tolist()
        loop = Loop(int(rng.integers(0, 25)) * MS).transits(n, *downs[:n])
        loop.estimator.renew(loop.line())
        forecast = loop.forecast()
        d = np.array([true_d(loop.up_ns + down) for down in downs[n:]])
        stated.append(forecast.probability)
        held.append(np.mean((forecast.low <= d) & (d <= forecast.high)))
    assert np.mean(stated) - 0.02 < np.mean(held)
    assert np.mean(held) - np.mean(stated) < 0.1


def test_the_forecast_is_converging_while_it_rests_on_few_transits():
    loop = Loop()
    statuses = []
    for _ in range(MANY_TRANSITS):
        loop.transits(1)
        loop.estimator.renew(loop.line())
        statuses.append(loop.forecast().status)
    assert statuses[MIN_TRANSITS:-1] == [DelayStatus.CONVERGING] * (MANY_TRANSITS - 1 - MIN_TRANSITS)
    assert statuses[-1] is DelayStatus.ESTIMATED


def by_shares(*shares_d: tuple[int, int]) -> DelayEstimate:
    """Forecast for transits of which so many make each delay."""
    downs = [d * TS - 15 * MS for count, d in shares_d for _ in range(count)]
    rng = np.random.default_rng(0)
    loop = Loop(10 * MS).transits(len(downs), *rng.permutation(downs).tolist())
    loop.estimator.renew(loop.line())
    return loop.forecast()


@pytest.mark.parametrize(
    ("shares", "d", "low", "high", "probability"),
    [
        (((50, 1), (50, 2)), 1, 1, 2, 1.0),
        (((51, 2), (49, 1)), 2, 1, 2, 1.0),
        (((97, 2), (3, 3)), 2, 2, 2, 0.97),
        (((97, 3), (3, 1)), 3, 3, 3, 0.97),
        (((95, 2), (5, 3)), 2, 2, 2, 0.95),
        (((94, 2), (6, 3)), 2, 2, 3, 1.0),
        (((20, 1), (60, 2), (20, 3)), 2, 1, 3, 1.0),
        (((3, 1), (60, 2), (37, 3)), 2, 2, 3, 0.97),
        (((37, 1), (60, 2), (3, 3)), 2, 1, 2, 0.97),
        (((60, 1), (37, 4), (3, 9)), 1, 1, 4, 0.97),
    ],
)
def test_d_is_the_likeliest_and_its_interval_the_narrowest_with_95_percent(shares, d, low, high, probability):
    # without ages nobody is overtaken
    forecast = by_shares(*shares)
    assert (forecast.d, forecast.low, forecast.high) == (d, low, high)
    assert probability - 2 / 101 <= forecast.probability <= probability  # one more than 100 may lie beyond them


@quick
@given(st.integers(0, 2**32), st.integers(5, 200), st.integers(0, 200))
def test_the_interval_contains_d_with_its_probability_by_the_transits_themselves(seed, n, width_ms):
    rng = np.random.default_rng(seed)
    downs = rng.integers(0, width_ms * MS + 1, n)
    loop = Loop(10 * MS).transits(n, *downs.tolist())
    loop.estimator.renew(loop.line())
    forecast = loop.forecast()
    d = np.array([true_d(10 * MS + int(down)) for down in downs])
    counts = np.bincount(d)
    assert counts[forecast.d] == counts.max()
    assert forecast.low <= forecast.d <= forecast.high
    inside = ((forecast.low <= d) & (d <= forecast.high)).mean()
    assert inside - 2 / (n + 1) <= forecast.probability <= inside + 1e-9  # sums of floats
    assert inside >= COVERAGE or (forecast.low, forecast.high) == (d.min(), d.max())
    if forecast.low < forecast.high:
        ends = min(counts[forecast.low], counts[forecast.high])
        assert counts[forecast.low : forecast.high + 1].sum() - ends < COVERAGE * n + 1e-9 or ends == 0


# a plant that latches and reports


@dataclass
class Link:
    """A plant that latches the newest command at each sample and reports it; TIMESYNC at 10 Hz; all of it over a link.

    Times are the plant's; the autopilot's are ``offset_ns`` less.
    """

    down: Draw
    up: Draw = EIGHT_MS
    seed: int = 0
    ordered: bool = False
    longer_ms: float = 0.0
    """By how much commands travel longer than TIMESYNC."""
    timesync: bool = True
    lose_reports: float = 0.0
    offset_ns: int = 905 * S
    k: int = 0
    results: list[tuple[int, DelayEstimate, int]] = field(default_factory=list)
    """Own sample, forecast and true first delay of each command that was applied."""

    def __post_init__(self) -> None:
        self.estimator = DelayEstimator(TS)
        self.rng = np.random.default_rng(self.seed)
        self._forecasts: dict[int, DelayEstimate] = {}
        self._commands: list[tuple[int, int]] = []
        self._answers: list[tuple[int, int, int]] = []
        self._newest = -1
        self._last_ns = 0
        self._last_up_ns = 0

    def run(self, seconds: float) -> Link:
        for _ in range(round(seconds * S / TS)):
            self._sample()
        return self

    def _arrives(self, leaves_ns: int, longer_ms: float = 0.0) -> int:
        at_ns = leaves_ns + round((self.down(self.rng) + longer_ms) * MS)
        if self.ordered:
            self._last_ns = at_ns = max(at_ns, self._last_ns)
        return at_ns

    def _sample(self) -> None:
        e, k, t_ns = self.estimator, self.k, self.k * TS
        self.k += 1
        while self._commands and self._commands[0][0] <= t_ns:
            j = heapq.heappop(self._commands)[1]
            if j > self._newest:
                self._newest = j
        j = self._newest
        if j in self._forecasts:
            self.results.append((j, self._forecasts.pop(j), k - j))
        self._last_up_ns = at_ns = max(t_ns + round(self.up(self.rng) * MS), self._last_up_ns)
        own_ns = at_ns - self.offset_ns
        while self._answers and self._answers[0][0] <= at_ns:
            answer_ns, tc1, ts1 = heapq.heappop(self._answers)
            e.transit(tc1, ts1, answer_ns - self.offset_ns)
        if e.due:
            e.renew(ClockLine(own_ns, self.offset_ns, 0.0))
        if j >= 0 and not (self.lose_reports and self.rng.random() < self.lose_reports):
            e.report(k, j, own_ns)
        forecast = e.forecast(t_ns, own_ns)
        e.sent(k, t_ns, own_ns, forecast)
        self._forecasts[k] = forecast
        heapq.heappush(self._commands, (self._arrives(at_ns, self.longer_ms), k))
        if self.timesync and k % 4 == 0:
            tc1 = self._arrives(at_ns)
            heapq.heappush(self._answers, (tc1 + round(self.up(self.rng) * MS), tc1, own_ns))

    def right(self, last: int = 0) -> float:
        """Return the share of the last forecasts that were right."""
        return float(np.mean([f.d == d for _, f, d in self.results[-last:]]))

    def inside(self, last: int = 0) -> float:
        """Return the share of the last forecasts whose interval contained d."""
        return float(np.mean([f.d is not None and f.low <= d <= f.high for _, f, d in self.results[-last:]]))

    def wrong_for(self, since_k: int) -> float:
        """Return the seconds from a sample on until the last forecast whose interval did not contain d."""
        wrong = [j for j, f, d in self.results if j >= since_k and not (f.d is not None and f.low <= d <= f.high)]
        return (max(wrong, default=since_k - 1) + 1 - since_k) * TS / S


@pytest.mark.parametrize("ordered", [False, True])
@pytest.mark.parametrize("seed", range(2))
def test_the_interval_of_a_jittery_link_contains_d_as_often_as_its_probability_says(seed, ordered):
    link = Link(gamma_ms(20, 25), uniform_ms(5, 15), seed, ordered).run(250)
    known = link.results[4000:]
    said = np.mean([f.probability for _, f, _ in known])
    assert said >= COVERAGE
    assert link.inside(len(known)) > COVERAGE - 0.02
    assert link.inside(len(known)) == pytest.approx(said, abs=0.03)
    likeliest = max(np.mean([d == m for _, _, d in known]) for m in range(1, 10))
    assert link.right(len(known)) >= likeliest - 0.02
    assert (link.estimator.scored, link.estimator.changes) == (pytest.approx(len(link.results), rel=0.01), 0)


@pytest.mark.parametrize(
    ("before_ms", "after_ms", "found_s"),
    [(10, 130, 1.0), (130, 10, 1.0), (40, 65, 1.0), (25, 40, 1.8), (40, 25, 1.8)],  # the last two do not change d
)
def test_a_constant_link_that_changes_is_forecast_by_three_reports_and_found_within_a_second(
    before_ms, after_ms, found_s
):
    link = Link(constant_ms(before_ms)).run(60)
    assert link.right(2000) == 1.0
    link.down, changed = constant_ms(after_ms), link.k
    link.run(found_s)
    assert link.estimator.changes == 1
    link.run(20 - found_s)
    d = true_d((8 + after_ms) * MS)
    assert link.wrong_for(changed) <= (true_d((8 + max(before_ms, after_ms)) * MS) + 4) * TS / S
    soon = changed + S // 2 // TS
    assert {f[:3] for j, f, _ in link.results if j >= soon} == {(d, d, d)}
    assert {f[:3] for _, f, _ in link.results[-600:]} == {(d, d, d)}
    assert link.estimator.changes == 1
    assert link.estimator.shift_ns == 0


def test_a_link_that_changes_and_changes_back_is_followed_both_times():
    link = Link(constant_ms(10)).run(30)
    for n, down_ms in enumerate((130, 10, 130, 10)):
        link.down, changed = constant_ms(down_ms), link.k
        link.run(10)
        assert link.wrong_for(changed) <= 1.5
        assert link.estimator.changes == n + 1


@pytest.mark.parametrize("seed", range(3))
def test_a_jittery_link_whose_base_moves_is_found_within_a_window_of_16_transits(seed):
    link = Link(gamma_ms(20, 10), seed=seed).run(60)
    link.down, changed = gamma_ms(80, 10), link.k
    link.run(3)
    assert link.estimator.changes == 1
    assert link.estimator._reports.size < 3 * S // TS
    assert link.estimator._ages.size < 3 * S // TS
    link.run(30)
    after = [(f, d) for j, f, d in link.results if j >= changed + 3 * S // TS]
    assert np.mean([f.low <= d <= f.high for f, d in after]) > 0.9


@pytest.mark.parametrize("down_ms", [130, 26])
def test_without_any_report_a_change_is_found_by_16_transits(down_ms):
    loop = Loop(8 * MS, 10 * MS).transits(100)
    loop.down_ns = down_ms * MS
    loop.transits(17)
    assert loop.estimator.changes == 1
    d = true_d((8 + down_ms) * MS)
    assert loop.forecast()[:3] == (d, d, d)  # nothing of the link before is kept


@pytest.mark.parametrize(("seed", "ordered"), [(0, False), (1, True), (2, False)])
def test_in_an_hour_of_jitter_no_change_is_found(seed, ordered):
    link = Link(gamma_ms(25, 20), seed=seed, ordered=ordered).run(3600)
    assert link.estimator.changes == 0
    assert abs(link.estimator.shift_ns) <= 10 * MS


@pytest.mark.parametrize("seed", range(6))
def test_in_an_hour_of_jittery_transits_without_reports_no_change_is_found(seed):
    rng = np.random.default_rng(seed)
    loop = Loop()
    downs = np.rint((20 + rng.gamma(2.0, 10.0, 36_000)) * MS).astype(int)
    loop.transits(downs.size, *downs.tolist())
    assert loop.estimator.changes == 0


@pytest.mark.parametrize("longer_ms", [3, 10, 40, -3])
def test_commands_that_travel_otherwise_than_timesync_are_forecast_by_their_reports(longer_ms):
    link = Link(constant_ms(40 - 0.5), uniform_ms(2, 22), seed=1, longer_ms=longer_ms).run(60)
    assert link.inside(1600) > 0.97
    assert link.right(1600) > 0.97
    assert abs(link.estimator.shift_ns - longer_ms * MS) < 2 * MS
    assert link.estimator.changes == 0


def test_a_shift_that_has_gone_is_given_up():
    link = Link(constant_ms(39.5), uniform_ms(2, 22), longer_ms=30).run(40)
    assert link.estimator.shift_ns == pytest.approx(30 * MS, abs=2 * MS)
    link.longer_ms, changed = 0.0, link.k
    link.run(40)
    assert link.wrong_for(changed) < 3.0
    assert abs(link.estimator.shift_ns) < 2 * MS


def test_when_timesync_falls_silent_reports_move_the_forecast():
    link = Link(constant_ms(10)).run(30)
    link.timesync = False
    link.run(1)
    link.down, changed = constant_ms(60), link.k
    link.run(20)
    assert link.wrong_for(changed) < 1.5
    assert link.right(300) == 1.0


def test_lost_reports_are_missed_and_no_more():
    link = Link(gamma_ms(20, 20), uniform_ms(5, 15), lose_reports=0.3).run(100)
    assert link.inside(2000) > 0.92
    assert 0 < link.estimator.scored < 0.75 * len(link.results)


# reports that are not what they should be


def test_of_two_reports_in_a_row_the_second_is_the_first_delay_of_its_command_in_any_order():
    for order in (((10, 8), (11, 9)), ((11, 9), (10, 8))):
        loop = Loop().transits(10)
        e = loop.estimator
        e.sent(9, 9 * TS, 0, DelayEstimate(2, 2, 2, 0.9, DelayStatus.ESTIMATED))
        e.report(*order[0], 0)
        assert e.scored == 0
        e.report(*order[1], 0)
        assert (e.scored, e.exact, e.covered) == (1, 1.0, 1.0)


def test_duplicates_and_commands_held_on_count_once():
    loop = Loop().transits(10)
    e = loop.estimator
    e.sent(9, 9 * TS, 0, DelayEstimate(2, 2, 2, 0.9, DelayStatus.ESTIMATED))
    for k, j in ((10, 8), (11, 9), (11, 9), (10, 8), (12, 9), (13, 9), (12, 9)):
        e.report(k, j, 0)
    assert (e.scored, e.exact) == (1, 1.0)


def test_without_the_report_before_it_is_not_known_whether_a_delay_is_the_first():
    e = Loop().transits(10).estimator
    e.sent(9, 9 * TS, 0, DelayEstimate(2, 2, 2, 0.9, DelayStatus.ESTIMATED))
    e.report(12, 9, 0)
    assert e.scored == 0


@pytest.mark.parametrize(
    ("k", "j"),
    [(11, 7777), (1 << 31, 10), (-(1 << 31), 10), (10, 10), (9, 10), (10 + (1 << 31) - 1, 10), (11, -(1 << 31))],
)
def test_forged_reports_of_unknown_commands_or_impossible_delays_teach_nothing_wrong(k, j):
    loop = Loop(10 * MS, 10 * MS).transits(100)
    e = loop.estimator
    for n in range(10, 40):
        e.sent(n, n * TS, n * TS + 10 * MS, loop.forecast())
    for _ in range(5):
        e.report(k - 1, j - 1, 0)
        e.report(k, j, 0)
    e.renew(loop.line())
    loop.transits(1)
    assert loop.forecast()[:3] == (1, 1, 1)
    assert e.scored == (0 if k - j < 1 or j < 10 or j > 40 else 1)


def test_random_reports_never_raise_and_leave_an_honest_link_right():
    rng = np.random.default_rng(3)
    link = Link(constant_ms(40)).run(20)
    limits = [-(1 << 31), -1, 0, 1, (1 << 31) - 1]
    for _ in range(400):
        link.run(0.05)
        own_ns = link.k * TS - link.offset_ns
        for _ in range(3):
            d = int(rng.choice([*limits, int(rng.integers(-10, 300))]))
            j = link.k - int(rng.integers(0, 400))
            link.estimator.report(j + d, j, own_ns)
    assert link.right(300) > 0.9


@pytest.mark.parametrize("stamp", [1 << 62, -(1 << 62), 1 << 80, -(1 << 80), (1 << 63) - 1, 1 << 60, -(1 << 60)])
def test_absurd_stamps_never_raise_and_are_not_remembered(stamp):
    loop = Loop().transits(100)
    e, line = loop.estimator, loop.line()
    for n in range(20):
        now_ns = loop.now_ns + n
        e.forecast(stamp, now_ns)
        told_d = e.forecast(stamp, now_ns)
        assert told_d.d is None or told_d.d >= 1
        e.sent(500 + n, stamp, now_ns, told_d)
        e.report(500 + n, 499 + n, now_ns)
        e.report(501 + n, 500 + n, now_ns)
        if abs(stamp) > 1 << 61:
            e.transit(stamp, now_ns, now_ns)
            e.transit(now_ns, stamp, now_ns)
    e.renew(line)
    loop.transits(3)
    assert loop.forecast().d == 1


@pytest.mark.parametrize("stamp", [(1 << 62) - 1, 1 << 80, 1 << 60, 1_700_000_000 * S])
@pytest.mark.parametrize("ages", [0, 100])
def test_absurd_stamps_of_samples_never_raise_on_a_jittery_link(stamp, ages):
    loop = Loop()
    for n in range(ages):
        loop.estimator.sent(n, n * TS, n * TS + 10 * MS, UNKNOWN)
    loop.transits(100, 10 * MS, 20 * MS, 40 * MS, 60 * MS)
    old, future = (loop.estimator.forecast(sign * stamp, loop.now_ns) for sign in (-1, 1))
    assert old.d > 10**9
    assert 0 <= old.high - old.low <= 3
    assert future is UNKNOWN  # no sample is taken after its command


def test_one_absurd_transit_among_others_costs_no_time_and_changes_no_forecast():
    loop = Loop().transits(100)
    loop.estimator.transit(loop.plant_ns + (1 << 59), loop.plant_ns, loop.now_ns)
    loop.estimator.renew(loop.line())
    forecast = loop.forecast()
    assert forecast[:3] == (1, 1, 1)
    assert forecast.probability == pytest.approx(100 / 101)


def test_a_stall_of_the_plant_is_no_property_of_the_link():
    loop = Loop(10 * MS).transits(60, 12 * MS, 18 * MS)
    for n in range(20):  # requests of 2 s, all read when the plant wakes up
        loop.transits(1, (20 - n) * 100 * MS)
    loop.transits(5, 12 * MS, 18 * MS)
    loop.estimator.renew(loop.line())
    forecast = loop.forecast()
    assert (forecast.low, forecast.high) == (1, 2)


def test_a_plant_that_counts_anew_is_not_taken_for_the_one_before():
    e = DelayEstimator(TS)
    for k in range(40, 60):
        e.sent(k, k * TS, k * TS + 10 * MS, UNKNOWN)
        e.report(k + 1, k, k * TS + 30 * MS)
    e.forget_commands()
    for k in range(45):
        e.sent(k, k * TS, k * TS + 10 * MS, UNKNOWN)
    before = e._reports.size
    e.report(41, 39, 0)  # the old plant had the command of sample 41 in force at 42, the new one has not
    assert e._reports.size == before


# scores


def test_exact_and_covered_are_the_shares_of_the_latest_forecasts():
    e = Loop().transits(10).estimator
    right, near = (
        DelayEstimate(2, 1, 3, 0.95, DelayStatus.ESTIMATED),
        DelayEstimate(3, 1, 3, 0.95, DelayStatus.ESTIMATED),
    )
    far = DelayEstimate(4, 4, 5, 0.95, DelayStatus.ESTIMATED)
    for n, forecast in enumerate([right, right, near, far, UNKNOWN]):
        told(e, 10 * (n + 1), 2, 0, forecast)
    assert (e.scored, e.exact, e.covered) == (4, pytest.approx(0.5), pytest.approx(0.75))
    for n in range(5000):
        told(e, 10 * (n + 10), 2, 0, right)
    assert e.exact > 0.99
    for n in range(1000):
        told(e, 10 * (n + 6000), 2, 0, far)
    assert e.exact == pytest.approx(np.exp(-1.0), abs=0.01)


# bounds


def test_what_is_never_renewed_is_bounded_too():
    e = DelayEstimator(TS)
    for n in range(20_000):
        e.sent(n, n * TS, n * TS + 10 * MS, UNKNOWN)
        e.report(n + 1, n, n * TS + 20 * MS)
    assert len(e._ages._new) == delay.MAX_AGES
    assert len(e._reports._new) == delay.MAX_REPORTS
    assert not e.due  # without a transit there is nothing to describe


def test_memory_is_bounded_over_100000_calls():
    link = Link(gamma_ms(20, 20), uniform_ms(5, 15))
    e = link.estimator
    link.run(250)
    e.renew(ClockLine(0, link.offset_ns, 0.0))
    tracemalloc.start()
    for n in range(25_000):
        now_ns = link.k * TS + n * MS
        e.transit(now_ns + 20 * MS + n % 7 * MS, now_ns, now_ns)
        e.sent(10**6 + n, now_ns, now_ns, UNKNOWN)
        e.report(10**6 + 2 * n, 10**6 + n, now_ns)
        e.forecast(now_ns, now_ns)
        if e.due:
            e.renew(ClockLine(now_ns, 0, 0.0))
        if n == 12_500:
            half = tracemalloc.get_traced_memory()[0]
    grown = tracemalloc.get_traced_memory()[0] - half
    tracemalloc.stop()
    assert grown < 300_000
    for name, most in (("_transits", delay.MAX_TRANSITS), ("_ages", delay.MAX_AGES), ("_reports", delay.MAX_REPORTS)):
        window = getattr(e, name)
        assert len(window._rows) <= most
        assert len(window._new) <= most
    assert len(e._sent) <= delay.MAX_SENT
    assert len(e._latched) <= delay.MAX_SENT
    assert all(a < b for a, b in pairwise(e._latched))
