"""The law, Eq. (9), by hand and by matrices; the choice of a schedule's set swept over windows and delays."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations, pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autopilot.control import SETTLE_SAMPLES, TELL_NS, ChosenSets, Law, SetChanges, SetChooser, Window, law_of
from gains.model import Gains, Trim
from gains.store import load_gains
from gains.table import InputError

HIRM = load_gains("hirm-paper")
LAW = law_of(HIRM)
small = st.floats(-0.05, 0.05)


def trimmed(trim: Trim) -> Law:
    return law_of(replace(HIRM, model=replace(HIRM.model, trim=trim)))


def test_the_law_is_the_papers_by_hand():
    x, xr = (0.01, -0.02, 0.03), (0.01, 0.02, -0.03)
    by_hand = -0.5054 * 0.01 + 3.3877 * -0.02 + 3.1151 * 0.03
    by_hand += 0.2474 * 0.01 - 3.2382 * 0.02 - 3.1120 * -0.03
    assert LAW.command(x, xr) == (pytest.approx(by_hand, rel=1e-12), False)


@given(st.tuples(small, small, small), st.tuples(small, small, small))
def test_the_law_is_k1_x_plus_k2_xr_within_the_travel(x, xr):
    assert HIRM.K2 is not None
    wanted = float((HIRM.K1 @ x + HIRM.K2 @ xr)[0])
    u, saturated = LAW.command(x, xr)
    assert u == pytest.approx(np.clip(wanted, LAW.travel.low, LAW.travel.high), abs=1e-15)
    assert saturated == (abs(wanted) > LAW.travel.high)


def test_without_a_reference_model_the_law_is_state_feedback():
    pendulum = load_gains("pendulum-paper")
    u, _ = law_of(pendulum).command((0.1, -1.0), ())
    assert u == pytest.approx(11.06827 - 34.698)


def test_the_input_is_absolute_and_the_law_acts_on_deviations():
    law = trimmed(Trim(np.array([0.05, 0.0, 0.05]), np.array([-0.02])))
    assert law.command((0.05, 0.0, 0.05), (0.0, 0.0, 0.0)) == (-0.02, False)
    u, saturated = law.command((0.06, 0.0, 0.05), (0.0, 0.0, 0.0))
    assert u == pytest.approx(-0.02 - 0.005054, rel=1e-12)
    assert not saturated


@pytest.mark.parametrize(("theta", "end"), [(1.0, LAW.travel.high), (-1.0, LAW.travel.low)])
def test_the_travel_limits_the_input_and_says_so(theta, end):
    assert LAW.command((0.0, 0.0, theta), (0.0, 0.0, 0.0)) == (end, True)


def test_just_inside_the_travel_nothing_is_limited():
    theta = LAW.travel.high / 3.1151
    inside = LAW.command((0.0, 0.0, theta * 0.999999), (0.0, 0.0, 0.0))
    outside = LAW.command((0.0, 0.0, theta * 1.000001), (0.0, 0.0, 0.0))
    assert (inside[1], outside[1]) == (False, True)


def test_the_largest_state_that_fits_the_wire_is_limited():
    largest = float(np.finfo(np.float32).max)
    assert LAW.command((largest,) * 3, (0.0,) * 3) == (LAW.travel.high, True)


def test_a_law_of_several_inputs_is_refused():
    model = HIRM.model
    two = replace(model, B=np.hstack([model.B, model.B]), D=np.zeros((1, 2)), trim=Trim(np.zeros(3), np.zeros(2)))
    with pytest.raises(InputError, match="one input"):
        law_of(Gains("two", two, 1, 2, np.vstack([HIRM.K1, HIRM.K1]), np.zeros((2, 3))))


# a schedule

DELAYS = (None, *range(-1, 8))


def schedules() -> Iterator[tuple[Window, ...]]:
    """Every row of up to four windows within 0 to 6 that rises and leaves no delay out."""
    every = [(low, high) for low in range(7) for high in range(low, 7)]
    for count in range(1, 5):
        for windows in combinations(every, count):
            if all(a[0] < b[0] <= a[1] + 1 <= b[1] for a, b in pairwise(windows)):
                yield windows


SCHEDULES = tuple(schedules())


INTERVALS = tuple((low, high) for low in range(-1, 8) for high in range(low, 8))


def room(window: Window, low: int, high: int) -> int:
    """Return how far an interval is from the nearer end of a window."""
    return min(low - window[0], window[1] - high)


def width(window: Window) -> int:
    return window[1] - window[0]


def in_force(windows: tuple[Window, ...], present: int) -> SetChooser:
    chooser = SetChooser(windows)
    chooser.present = present
    return chooser


def narrowest(windows: tuple[Window, ...], low: int, high: int) -> int | None:
    """Return the set of the narrowest window around an interval, then with the most room, then the first."""
    fit = [i for i, w in enumerate(windows) if w[0] <= low and high <= w[1]]
    ranked = sorted(fit, key=lambda i: (width(windows[i]), -room(windows[i], low, high), i))
    return ranked[0] if ranked else None


def test_the_chosen_set_has_a_window_that_contains_the_interval_whenever_any_has():
    assert len(SCHEDULES) > 300
    contained = 0
    for windows in SCHEDULES:
        for low, high in INTERVALS:
            if narrowest(windows, low, high) is None:
                continue
            for present in range(len(windows)):
                for d in {low, high}:
                    chosen = windows[in_force(windows, present).choose(d, low, high)]
                    assert chosen[0] <= low <= high <= chosen[1]
                    contained += 1
    assert contained > 10_000


def test_the_present_set_stays_while_its_window_contains_the_interval_for_39_samples():
    assert SETTLE_SAMPLES == 40
    for windows in SCHEDULES:
        for present, (low, high) in enumerate(windows):
            for interval in INTERVALS:
                if low <= interval[0] and interval[1] <= high:
                    chooser = in_force(windows, present)
                    chosen = [chooser.choose(interval[0], *interval) for _ in range(39)]
                    assert chosen == [present] * 39


def test_a_new_set_is_the_one_with_the_narrowest_window_then_the_most_room_then_the_first():
    ties = 0
    for windows in SCHEDULES:
        for low, high in INTERVALS:
            best = narrowest(windows, low, high)
            for present in range(len(windows)):
                if best is not None and not (windows[present][0] <= low and high <= windows[present][1]):
                    assert in_force(windows, present).choose(low, low, high) == best
                    fit = [w for w in windows if w[0] <= low and high <= w[1]]
                    ties += len({width(w) for w in fit}) < len(fit)
    assert ties > 10


def test_an_unknown_delay_or_one_outside_every_window_changes_nothing():
    for windows in SCHEDULES:
        for present in range(len(windows)):
            assert in_force(windows, present).choose(None, None, None) == present
            for d in (-1, *range(8)):
                if not windows[0][0] <= d <= windows[-1][1]:
                    for low, high in ((d, d), (d - 1, d + 1), (-1, 8)):
                        assert in_force(windows, present).choose(d, low, high) == present


def test_an_interval_too_wide_for_every_window_leaves_the_choice_to_d():
    for windows in SCHEDULES:
        for present in range(len(windows)):
            for d in range(windows[0][0], windows[-1][1] + 1):
                chosen = in_force(windows, present).choose(d, -1, 8)
                if windows[present][0] <= d <= windows[present][1]:
                    assert chosen == present
                    continue
                fit = [i for i, w in enumerate(windows) if w[0] <= d <= w[1]]
                assert chosen == min(fit, key=lambda i: (-room(windows[i], d, d), width(windows[i]), i))


def test_a_narrower_window_takes_over_with_the_fortieth_sample_in_a_row_and_a_wider_one_never_does():
    took = 0
    for windows in SCHEDULES:
        for present in range(len(windows)):
            low, high = windows[present]
            for d in range(low, high + 1):
                best = narrowest(windows, d, d)
                chooser = in_force(windows, present)
                chosen = [chooser.choose(d, d, d) for _ in range(50)]
                narrower = width(windows[best]) < width(windows[present])
                assert chosen == ([present] * 39 + [best] * 11 if narrower else [present] * 50)
                took += narrower
    assert took > 100


def test_a_row_begins_anew_with_every_sample_that_breaks_it():
    windows = ((1, 2), (1, 6), (3, 4))
    for breaks in ((5, 5, 5), (1, 1, 6), (1, 0, 9), (3, 3, 3)):
        chooser = in_force(windows, 1)
        for _ in range(5):
            assert {chooser.choose(1, 1, 2) for _ in range(39)} == {1}
            assert chooser.choose(*breaks) == 1
        assert [chooser.choose(1, 1, 2) for _ in range(40)][-2:] == [1, 0]


def test_a_change_to_a_wider_window_ends_the_row_of_the_narrower_one():
    chooser = in_force(((1, 2), (1, 3), (1, 6)), 1)
    assert {chooser.choose(1, 1, 2) for _ in range(39)} == {1}
    assert chooser.choose(5, 5, 5) == 2
    assert {chooser.choose(1, 1, 2) for _ in range(39)} == {2}
    assert chooser.choose(1, 1, 2) == 0


def test_an_unknown_delay_breaks_no_row_and_makes_none():
    chooser = in_force(((1, 2), (1, 6)), 1)
    for _ in range(39):
        chooser.choose(1, 1, 1)
        chooser.choose(None, None, None)
    assert chooser.present == 1
    assert chooser.choose(1, 1, 1) == 0


@pytest.mark.parametrize(
    ("windows", "present", "interval", "chosen"),
    [
        (((1, 3), (2, 6), (4, 9)), 0, (4, 4), 1),  # narrower by one
        (((1, 3), (2, 6), (4, 9)), 0, (5, 7), 2),  # the only one
        (((1, 1), (2, 4), (3, 5)), 0, (3, 3), 1),  # room 1 against 0
        (((1, 1), (2, 4), (3, 5)), 0, (4, 4), 2),  # the same the other way round
        (((1, 2), (3, 4)), 0, (3, 3), 1),  # side by side
        (((1, 2), (3, 4)), 0, (2, 3), 0),  # too wide for both, and d stays
        (((0, 4), (2, 6), (5, 9)), 2, (3, 3), 0),  # room 1 each, equally wide
        (((1, 3), (2, 6)), 0, (2, 4), 1),
    ],
)
def test_choices_by_hand(windows, present, interval, chosen):
    assert in_force(windows, present).choose(interval[0], *interval) == chosen


@given(st.lists(st.integers(0, 8), min_size=1, max_size=300), st.sampled_from(SCHEDULES))
def test_a_delay_that_wanders_comes_back_to_a_narrower_window_at_most_once_in_40_samples(delays, windows):
    chooser = SetChooser(windows)
    chosen = [chooser.present, *(chooser.choose(d, d, d) for d in delays)]
    narrowed = [
        n
        for n, (a, b) in enumerate(pairwise(chosen))
        if a != b and windows[a][0] <= delays[n] <= windows[a][1]  # nothing but the row asked for it
    ]
    assert all(later - earlier >= SETTLE_SAMPLES for earlier, later in pairwise([-1, *narrowed]))


def test_a_delay_that_wanders_about_an_edge_switches_at_most_once():
    rng = np.random.default_rng(1)
    chooser, chosen = SetChooser(((1, 3), (1, 6))), []
    for _ in range(2000):
        d = int(rng.integers(2, 6))
        chosen.append(chooser.choose(d, d, d))
    assert sum(a != b for a, b in pairwise(chosen)) <= 1
    assert chosen[-1] == 1


def test_one_set_is_chosen_whatever_the_forecast():
    chooser = SetChooser(((1, 3),))
    assert {chooser.choose(d, d, d) for d in DELAYS} == {0}


def test_a_set_is_remembered_for_the_longest_delay_of_the_windows_and_no_longer():
    for d, fits in ((6, False), (7, True)):  # one sample later nothing is known, and nothing said
        chosen = ChosenSets(((1, 3), (2, 6)))
        chosen.note(10, 0)
        chosen.note(10 + d, 1)
        assert chosen.covers(10, 6) is fits


def test_a_command_fits_its_set_to_within_one_sample_and_its_first_delay_counts():
    for d in range(8):
        chosen = ChosenSets(((1, 3), (2, 6)))
        chosen.note(10, 0)
        assert chosen.covers(10, d) is (d <= 4)
        assert chosen.covers(10, 6)


def test_memory_stays_bounded_over_a_lossy_link():
    rng = np.random.default_rng(1)
    chosen = ChosenSets(((1, 3), (2, 6)))
    for j in np.flatnonzero(rng.random(100_000) > 0.1).tolist():
        chosen.note(j, j % 2)
        assert len(chosen._sets) <= 7
        assert min(chosen._sets) >= j - 6


def test_memory_stays_bounded_when_numbers_fall_back():
    chosen = ChosenSets(((1, 3), (2, 6)))
    for first in (100_000, 50_000, 0):
        for j in range(first, first + 1000):
            chosen.note(j, 0)
            assert len(chosen._sets) <= 7


@given(st.lists(st.tuples(st.integers(0, 3 * TELL_NS), st.integers(0, 3)), max_size=60))
def test_changes_are_all_counted_and_told_of_at_most_once_a_second(flown):
    changes, now_ns, told = SetChanges(), 0, []
    for wait_ns, gain_set in flown:
        now_ns += wait_ns
        if count := changes.flown(gain_set, now_ns):
            told.append((now_ns, count))
        since_ns = now_ns - told[-1][0] if told else TELL_NS
        assert changes.untold == 0 or since_ns < TELL_NS
    assert all(later[0] - earlier[0] >= TELL_NS for earlier, later in pairwise(told))
    assert changes.total == sum(a != b for (_, a), (_, b) in pairwise(flown))
    assert sum(count for _, count in told) + changes.untold == changes.total
