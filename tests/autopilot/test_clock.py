"""Clocks: exact in integers, both ways, over days of drift; wrapped counters against brute force."""

from __future__ import annotations

from fractions import Fraction
from math import floor

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autopilot.link.clock import NS_PER_S, Clock, following, unwrap

DAY_NS = 86_400 * NS_PER_S
quick = settings(deadline=None)
clocks = st.builds(
    Clock,
    st.integers(0, 100 * DAY_NS),
    st.integers(-200_000, 200_000),
    st.integers(0, 10 * DAY_NS),
)
times = st.integers(0, 60 * DAY_NS)


@quick
@given(clocks, times)
def test_node_time_is_the_exact_rational_rounded_down(clock, elapsed_ns):
    exact = clock.offset_ns + elapsed_ns * (1 + Fraction(clock.drift_ppb, NS_PER_S))
    assert clock.node_ns(clock.boot_ns + elapsed_ns) == floor(exact)


@quick
@given(clocks, times)
def test_true_time_is_the_earliest_that_shows_a_node_time(clock, elapsed_ns):
    node_ns = clock.offset_ns + elapsed_ns
    true_ns = clock.true_ns(node_ns)
    assert isinstance(true_ns, int)
    assert clock.node_ns(true_ns) >= node_ns > clock.node_ns(true_ns - 1)


@quick
@given(clocks, times)
def test_there_and_back_is_within_a_nanosecond(clock, elapsed_ns):
    true_ns = clock.boot_ns + elapsed_ns
    assert abs(clock.true_ns(clock.node_ns(true_ns)) - true_ns) <= 1


@quick
@given(clocks, times, st.integers(0, DAY_NS))
def test_a_clock_never_goes_back(clock, elapsed_ns, more_ns):
    true_ns = clock.boot_ns + elapsed_ns
    assert clock.node_ns(true_ns) <= clock.node_ns(true_ns + more_ns)


@quick
@given(times)
def test_a_plain_clock_is_the_identity(true_ns):
    assert Clock().node_ns(true_ns) == true_ns == Clock().true_ns(true_ns)


def test_40_ppm_over_a_day_is_3_456_s():
    assert Clock(0, 40_000).node_ns(DAY_NS) - DAY_NS == 3_456_000_000


def test_a_clock_starts_at_its_offset_when_it_boots():
    assert Clock(137, 200_000, 5_000).node_ns(5_000) == 137


@quick
@given(st.integers(0, 15), st.integers(-100, 100), st.sampled_from([3, 8, 10, 16]))
def test_unwrap_finds_the_nearest_congruent_number_by_brute_force(value, near, modulus):
    value %= modulus
    found = unwrap(value, near, modulus)
    congruent = [n for n in range(near - 2 * modulus, near + 2 * modulus) if n % modulus == value]
    assert found in congruent
    assert abs(found - near) == min(abs(n - near) for n in congruent)


@quick
@given(st.integers(0, 1 << 50), st.integers(-(1 << 31) + 1, (1 << 31) - 1), st.sampled_from([1 << 32]))
def test_unwrap_restores_a_counter_from_any_reading_within_half_its_range(near, away, modulus):
    assert unwrap((near + away) % modulus, near, modulus) == near + away


@pytest.mark.parametrize(
    ("value", "near", "expected"), [(5, (1 << 32) - 3, (1 << 32) + 5), ((1 << 32) - 3, (1 << 32) + 5, (1 << 32) - 3)]
)
def test_unwrap_crosses_the_wrap_both_ways(value, near, expected):
    assert unwrap(value, near, 1 << 32) == expected


@quick
@given(due=times, period=st.integers(1, 10**10), late=st.integers(0, 10**12))
def test_what_is_due_again_stays_on_its_grid_and_lies_in_the_next_period(due, period, late):
    again = following(due, period, due + late)
    assert (again - due) % period == 0
    assert due + late < again <= due + late + period
