"""The law of the way back against simulation and plain loops: who is overtaken, H, and shifts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autopilot.transits import (
    _EDGES,
    _WIDTHS,
    EVEN,
    MAX_BINS,
    MAX_NEWER,
    MAX_SLOTS,
    Reports,
    TransitLaw,
    _bins,
    _correct,
    _open,
    least_shift,
    transit_law,
)
from tests.helpers import MS, TS

NOTHING = Reports(np.zeros(0, np.int64), np.zeros(0, np.int64))
quick = settings(deadline=None, max_examples=30)


def gamma_ns(rng: np.random.Generator, n: int, base_ms: float, mean_ms: float, shape: float = 2.0) -> np.ndarray:
    """Draw transits."""
    return np.rint((base_ms + rng.gamma(shape, mean_ms / shape, n)) * MS).astype(np.int64)


def uniform_ns(rng: np.random.Generator, n: int, low_ms: float, high_ms: float) -> np.ndarray:
    return rng.integers(round(low_ms * MS), round(high_ms * MS), n)


def probabilities(law: TransitLaw, age_ns: int, most: int) -> np.ndarray:
    """Return P(d = m | age) for m = 0 to ``most`` by the formula at the head of the module."""
    limits = np.arange(most + 1) * TS - age_ns
    level = np.array(law.levels)[np.searchsorted(law.transits, limits, "right")]
    level[0] = 0.0
    weights = np.concatenate([[0.0], np.diff(level)])
    if law.open:
        row = law.open[min(max((age_ns - law.first_age_ns) // law.bin_ns, 0), len(law.open) - 1)]
        row = np.array(row + [row[-1]] * (most + 1))[: most + 1]
        weights = weights * row
    return weights / weights.sum()


@dataclass
class Plant:
    """What came of commands that left at ``ages`` and travelled ``travels``: the newest that is there is latched."""

    ages: np.ndarray
    travels: np.ndarray

    def first_delays(self) -> Reports:
        """Return age and delay of every command that was ever applied, in the order of the samples."""
        n = self.ages.size
        j = np.arange(n)
        leaves = j * TS + self.ages
        # a sample that comes after a newer one is dropped, so it has no command
        left = leaves <= np.minimum.accumulate(np.concatenate([leaves[1:], [np.iinfo(np.int64).max]])[::-1])[::-1]
        slot = np.maximum(j + 1, -(-(leaves + self.travels) // TS))
        newest = np.full(n + 400, -1)
        np.maximum.at(newest, slot[left & (slot < n)], j[left & (slot < n)])
        newest = np.maximum.accumulate(newest)
        first = np.flatnonzero(np.diff(newest) > 0) + 1
        first = first[(first < n) & (newest[first] >= 0)]
        applied = newest[first]
        return Reports(self.ages[applied], first - applied)


# who is overtaken


def opened_by_loops(transits: np.ndarray, ages: np.ndarray, first: int, width: int, slots: int) -> np.ndarray:
    """Return ``_open`` by its words: every age with every transit, one newer command after the other."""
    bin_of = (ages - first) // width
    bins = int(bin_of.max()) + 1
    centre = [first + (b + 0.5) * width for b in range(bins)]
    opened = np.ones((bins, slots + 1))
    for b in range(bins):
        for m in range(slots + 1):
            for i in range(1, MAX_NEWER + 1):
                if m - i < 1:
                    continue
                later = [c for c in bin_of if c >= (centre[b] - i * TS - first) / width]
                came = sum(r <= (m - i) * TS - centre[c] for c in later for r in transits)
                opened[b, m] *= 1.0 - came / (len(later) * len(transits))
    return opened


@pytest.mark.parametrize("seed", range(4))
def test_the_chance_of_not_being_overtaken_is_that_of_every_age_with_every_transit(seed):
    rng = np.random.default_rng(seed)
    transits = np.sort(uniform_ns(rng, 12, 1, 120))
    ages = uniform_ns(rng, 15, 3, (10, 40, 90, 140)[seed])
    slots = -(-int(ages.max() + transits[-1]) // TS) + 1
    first, width, counts = _bins(ages, TS)
    expected = opened_by_loops(transits, ages, first, width, slots)
    occupied = counts > 0
    found = _open(transits, _EDGES, counts, first, width, TS, slots)
    np.testing.assert_allclose(found[occupied], expected[occupied], atol=2e-6)
    assert found.min() < 0.9
    assert (found[:, :2] == 1.0).all()  # to be in time for slot 1 a newer one would have to arrive before it left


@pytest.mark.parametrize("age_ms", [8, 20, 34])
@pytest.mark.parametrize("power", [0.5, 1.0, 2.0])
def test_the_chance_of_not_being_overtaken_is_what_a_simulation_counts(age_ms, power):
    """Commands travel by H(u) = u^power of the law of TIMESYNC."""
    rng = np.random.default_rng(age_ms)
    ages, transits = uniform_ns(rng, 4000, 5, 35), np.sort(gamma_ns(rng, 1000, 5, 40))
    slots = -(-int(ages.max() + transits.max()) // TS) + 1
    first, width, counts = _bins(ages, TS)
    found = _open(transits, _EDGES**power, counts, first, width, TS, slots)[(age_ms * MS - first) // width]
    n = 20_000
    arrivals = np.full((n, 8), np.inf)
    for i in range(1, 9):
        newer = rng.choice(ages[ages > age_ms * MS - i * TS], n)
        arrivals[:, i - 1] = i * TS + newer + np.quantile(transits, rng.random(n) ** (1.0 / power))
    counted = [(arrivals.min(axis=1) > m * TS).mean() for m in range(slots + 1)]
    likely = [m for m in range(1, slots + 1) if counted[m] > 0.02]  # beyond it the fifth newer command counts
    assert len(likely) >= 3
    assert np.abs(found[likely] - np.array(counted)[likely]).max() < 0.03


@pytest.mark.parametrize("ages_ms", [(5, 29), (10, 11), (10, 75)])
def test_the_delays_of_applied_commands_are_as_likely_as_a_plant_counts_them(ages_ms):
    rng = np.random.default_rng(11)
    n = 400_000
    ages = uniform_ns(rng, n, *ages_ms)
    applied = Plant(ages, gamma_ns(rng, n, 10, 35)).first_delays()
    law = transit_law(gamma_ns(rng, 20_000, 10, 35), ages[:20_000], NOTHING, TS, EVEN)
    worst = 0.0
    for age_ns in np.linspace(ages_ms[0] + 0.5, ages_ms[1] - 0.5, 5) * MS:
        near = np.abs(applied.ages - age_ns) <= MS // 2
        counted = np.bincount(applied.d[near], minlength=12)[:12] / near.sum()
        found = probabilities(law, int(age_ns), 30)
        worst = max(worst, np.abs(found[:12] - counted).max())
    assert worst < 0.03
    alone = TransitLaw(law.transits, law.levels, 0, 1, [], EVEN)
    assert np.abs(probabilities(alone, int(age_ns), 30)[:12] - counted).max() > 0.05


def test_on_a_link_whose_jitter_is_less_than_a_sample_nobody_is_overtaken():
    rng = np.random.default_rng(1)
    law = transit_law(uniform_ns(rng, 500, 20, 40), np.full(500, 5 * MS), NOTHING, TS, EVEN)
    for m in (1, 2):
        assert all(row[m] == 1.0 for row in law.open)
    np.testing.assert_allclose(probabilities(law, 5 * MS, 4)[1:3], [0.0, 1.0], atol=0.05)


# the correction


def renewed(
    transits: np.ndarray, ages: np.ndarray, reports: Reports, renewals: int, density: np.ndarray = EVEN
) -> TransitLaw:
    law = transit_law(transits, ages, reports, TS, density)
    for _ in range(renewals - 1):
        law = transit_law(transits, ages, reports, TS, law.density)
    return law


@pytest.mark.parametrize("power", [0.5, 1.0, 2.0, 3.0])
def test_without_overtaking_h_converges_to_the_law_by_which_the_commands_travel(power):
    """The level U of a command's transit among those of TIMESYNC has the distribution H(u) = u^power."""
    rng = np.random.default_rng(round(10 * power))
    timesync, n = np.sort(gamma_ns(rng, 1024, 20, 30)), 60_000
    ages = uniform_ns(rng, n, 5, 30)
    travels = np.quantile(timesync, rng.random(n) ** (1.0 / power)).astype(np.int64)
    first, width, counts = _bins(ages, TS)
    nobody = np.ones((counts.size, 40))
    density = EVEN
    for _ in range(30):
        density = _correct(timesync, nobody, first, width, TS, shifted(0, travels, ages), density)
    H = np.concatenate([[0.0], np.cumsum(density * _WIDTHS)])
    assert np.abs(H - _EDGES**power).max() < 0.03


@pytest.mark.parametrize("power", [0.5, 2.0, 3.0])
@pytest.mark.parametrize("mean_ms", [12, 35, 60])
def test_with_reports_the_forecast_converges_to_what_a_plant_counts(power, mean_ms):
    rng = np.random.default_rng(mean_ms)
    timesync, n = np.sort(gamma_ns(rng, 1024, 20, mean_ms)), 60_000
    ages = uniform_ns(rng, n, 5, 30)
    levels = np.sort(gamma_ns(rng, 50_000, 20, mean_ms))
    travels = np.quantile(levels, rng.random(n) ** (1.0 / power)).astype(np.int64)
    applied = Plant(ages, travels).first_delays()
    known = Reports(applied.ages[:2048], applied.d[:2048])
    even, corrected = (renewed(timesync, ages[:1024], said, 20) for said in (NOTHING, known))

    def error(law: TransitLaw) -> float:
        """Return the error of the distribution of d, over all ages."""
        apart = []
        for age_ms in (8, 17, 26):
            near = np.abs(applied.ages - age_ms * MS) <= MS
            counted = np.bincount(applied.d[near], minlength=20)[:20] / near.sum()
            apart.append(np.abs(probabilities(law, age_ms * MS, 30)[:20] - counted).sum() / 2)
        return max(apart)

    assert error(even) > 0.2
    assert error(renewed(timesync, ages[:1024], known, 3)) < 0.6 * error(even)
    assert error(corrected) < 0.12
    assert error(corrected) < 0.35 * error(even)


@pytest.mark.parametrize("seed", range(5))
def test_where_there_is_nothing_to_correct_h_stays_within_its_statistical_error(seed):
    rng = np.random.default_rng(seed)
    ages = uniform_ns(rng, 2048, 5, 30)
    applied = Plant(ages, gamma_ns(rng, 2048, 20, 30)).first_delays()
    law = renewed(gamma_ns(rng, 1024, 20, 30), ages[-1024:], applied, 10)
    n = applied.d.size
    kolmogorov = 1.95 * np.sqrt(1 / 1024 + 1 / n)  # of two samples of one distribution, exceeded by one in 1000
    assert np.abs(np.array(law.levels) - np.arange(1025) / 1024).max() < kolmogorov + 0.03


def test_fewer_than_20_reports_correct_nothing():
    rng = np.random.default_rng(2)
    transits, ages = gamma_ns(rng, 200, 20, 30), uniform_ns(rng, 200, 5, 30)
    late = Reports(ages[:20], np.full(20, 4))
    few = Reports(late.ages[:-1], late.d[:-1])
    assert transit_law(transits, ages, few, TS, EVEN).density is EVEN
    assert transit_law(transits, ages, late, TS, EVEN).density is not EVEN


@quick
@given(st.integers(0, 2**32), st.integers(1, 300), st.integers(0, 100))
def test_whatever_is_reported_h_rises_from_0_to_1(seed, n, reports):
    rng = np.random.default_rng(seed)
    transits, ages = uniform_ns(rng, n, -20, 200), uniform_ns(rng, n, -50, 200)
    said = Reports(rng.choice(ages, reports), rng.integers(-3, 40, reports))
    law = renewed(transits, ages, said, 3)
    assert law.transits == sorted(transits.tolist())
    levels = np.array(law.levels)
    assert (levels[0], levels[-1]) == (0.0, pytest.approx(1.0))
    assert (np.diff(levels) > 0.0).all()
    assert law.density @ _WIDTHS == pytest.approx(1.0)
    opened = np.array(law.open)
    assert opened.size == 0 or (opened.min() >= 0.0 and opened.max() <= 1.0)


def test_the_bins_of_h_are_those_between_its_edges():
    assert (_EDGES[0], _EDGES[-1]) == (0.0, 1.0)
    assert (EVEN.shape, EVEN @ _WIDTHS) == ((_EDGES.size - 1,), pytest.approx(1.0))
    transits = np.arange(100) * MS
    doubled = np.where(_EDGES[:-1] < 0.5, 2.0, 0.0)
    levels = transit_law(transits, np.zeros(0, np.int64), NOTHING, TS, doubled).levels
    np.testing.assert_allclose(levels, np.minimum(1.0, 2.0 * np.arange(101) / 100), atol=1e-12)


# degenerate links


@pytest.mark.parametrize("transit_ns", [0, 1, 60 * MS, -(10**15)])
def test_one_transit_and_one_age_are_a_law(transit_ns):
    law = transit_law(np.array([transit_ns]), np.array([5 * MS - min(transit_ns, 0)]), NOTHING, TS, EVEN)
    assert (law.transits, law.levels) == ([transit_ns], [0.0, 1.0])


def test_equal_transits_and_ages_have_one_delay_and_reports_of_others_change_nothing_of_it():
    ages = np.full(500, 10 * MS)
    said = Reports(ages[:100], np.arange(100) % 7)
    law = renewed(np.full(300, 50 * MS), ages, said, 5)
    np.testing.assert_allclose(probabilities(law, 10 * MS, 6), [0, 0, 0, 1, 0, 0, 0])


def test_without_ages_nobody_is_asked_who_overtakes():
    law = transit_law(np.array([3, 1, 2]) * MS, np.zeros(0, np.int64), NOTHING, TS, EVEN)
    assert (law.transits, law.open) == ([MS, 2 * MS, 3 * MS], [])
    assert law.levels == pytest.approx([0, 1 / 3, 2 / 3, 1])


@pytest.mark.parametrize(("samples", "asked"), [(MAX_SLOTS - 1, True), (MAX_SLOTS, False), (10**9, False)])
def test_a_loop_beyond_64_slots_is_forecast_without_asking_who_overtakes(samples, asked):
    law = transit_law(np.array([samples * TS - 5 * MS]), np.array([5 * MS]), NOTHING, TS, EVEN)
    assert bool(law.open) is asked


def test_ages_spread_over_years_are_no_more_than_256_bins():
    ages = np.array([0, 1 << 59, 1 << 60])
    _, width, counts = _bins(ages, TS)
    assert counts.size <= MAX_BINS + 1
    assert counts.sum() == pytest.approx(1.0)
    assert width * counts.size > 1 << 60
    assert transit_law(np.array([MS]), ages, NOTHING, TS, EVEN).open == []


def test_stamps_of_the_future_make_no_slots():
    law = transit_law(np.array([MS]), np.array([-(1 << 60)]), Reports(np.full(50, -5), np.full(50, 1)), TS, EVEN)
    assert law.open == []


# by how much longer commands travel


def shifted(shift_ns: int, travels: np.ndarray, ages: np.ndarray) -> Reports:
    """Return the reports of commands that all travel longer by a shift, none of them overtaken."""
    return Reports(ages, np.maximum(1, -(-(ages + travels + shift_ns) // TS)))


@pytest.mark.parametrize("shift_ms", [3, 30, -20, 250])
def test_a_shift_is_recovered_within_what_the_reports_allow(shift_ms):
    rng = np.random.default_rng(abs(shift_ms))
    travels, ages = np.full(256, 60 * MS), uniform_ns(rng, 256, 0, 30)
    found = least_shift(shifted(shift_ms * MS, travels, ages), 60 * MS, 60 * MS, TS)
    assert abs(found - shift_ms * MS) < MS // 2


@quick
@given(st.integers(0, 2**32), st.integers(-40, 200), st.integers(0, 40))
def test_the_shift_is_one_that_every_report_allows_and_0_if_that_is(seed, shift_ms, jitter_ms):
    rng = np.random.default_rng(seed)
    travels, ages = uniform_ns(rng, 100, 60, 61 + jitter_ms), uniform_ns(rng, 100, 0, 30)
    reports = shifted(shift_ms * MS, travels, ages)
    shortest, longest = int(travels.min()), int(travels.max())

    def allowed(shift_ns: int) -> int:
        low, high = (reports.d - 1) * TS - ages - longest, reports.d * TS - ages - shortest
        return int((((low < shift_ns) | (reports.d == 1)) & (shift_ns <= high)).sum())

    found = least_shift(reports, shortest, longest, TS)
    assert allowed(shift_ms * MS) == 100
    if 100 - allowed(0) >= 3:
        assert allowed(found) == 100
    else:
        assert found == 0


def test_reports_that_no_shift_explains_all_are_followed_where_most_agree_and_outliers_do_not_count():
    rng = np.random.default_rng(3)
    travels, ages = np.full(256, 60 * MS), uniform_ns(rng, 256, 0, 30)
    reports = shifted(30 * MS, travels, ages)
    wild = reports.d.copy()
    wild[::10] += rng.integers(3, 200, wild[::10].size)
    alone = least_shift(reports, 60 * MS, 60 * MS, TS)
    assert least_shift(Reports(ages, wild), 60 * MS, 60 * MS, TS) == pytest.approx(alone, abs=MS)


def test_two_reports_are_not_enough_for_a_shift_and_three_are():
    late = Reports(np.full(3, 10 * MS), np.full(3, 4))
    assert least_shift(Reports(late.ages[:2], late.d[:2]), 60 * MS, 60 * MS, TS) == 0
    # late by more than 5 ms, by 30 ms at the most: the middle
    assert least_shift(late, 60 * MS, 60 * MS, TS) == pytest.approx(17.5 * MS, abs=1)


def test_what_comes_early_waits_for_the_first_sample_so_a_delay_of_1_is_no_lower_bound():
    early = Reports(np.full(50, 1 * MS), np.ones(50, np.int64))
    assert least_shift(early, 10 * MS, 10 * MS, TS) == 0
    # of 60 ms, d = 1 says that commands travel at most 24 ms, whatever less
    assert least_shift(early, 60 * MS, 60 * MS, TS) == -36 * MS
    # nor by clocks so far off that they seem to have come before their sample
    assert least_shift(Reports(np.full(50, -40 * MS), np.ones(50, np.int64)), 10 * MS, 10 * MS, TS) == 0
    late = Reports(np.full(3, 1 * MS), np.full(3, 2))
    both = Reports(np.concatenate([early.ages, late.ages]), np.concatenate([early.d, late.d]))
    assert least_shift(both, 1 * MS, 30 * MS, TS) == 0


def test_a_command_that_would_just_have_been_in_time_for_the_sample_before_is_shifted():
    just = Reports(np.full(3, 15 * MS), np.full(3, 2))  # with 10 ms it is there when the first sample is taken
    assert least_shift(just, 10 * MS, 10 * MS, TS) > 0
    assert least_shift(just, 10 * MS, 10 * MS + 1, TS) == 0


def test_of_two_shifts_that_agree_as_well_the_smaller_one_is_taken():
    ages = np.zeros(8, np.int64)
    d = np.array([4, 4, 4, 4, 9, 9, 9, 9])
    found = least_shift(Reports(ages, d), 30 * MS, 30 * MS, TS)
    assert 45 * MS < found <= 70 * MS
    mirrored = least_shift(Reports(ages, np.array([12, 12, 12, 12, 9, 9, 9, 9])), 240 * MS, 240 * MS, TS)
    assert -40 * MS < mirrored <= -15 * MS


def test_without_reports_there_is_no_shift():
    assert least_shift(NOTHING, 10 * MS, 20 * MS, TS) == 0
