"""The law, Eq. (9), by hand and by matrices; the choice of a schedule's set swept over windows and delays."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations, pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autopilot.control import TELL_NS, Law, SetChanges, Window, choose_set, law_of
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


def room(window: Window, d: int) -> int:
    """Return how far d is from the nearer end of its window."""
    return min(d - window[0], window[1] - d)


def test_the_chosen_set_has_a_window_that_contains_the_delay_whenever_any_has():
    assert len(SCHEDULES) > 300
    for windows in SCHEDULES:
        for d in range(windows[0][0], windows[-1][1] + 1):
            for present in range(len(windows)):
                low, high = windows[choose_set(windows, present, d)]
                assert low <= d <= high


def test_the_present_set_stays_while_its_window_contains_the_delay():
    for windows in SCHEDULES:
        for present, (low, high) in enumerate(windows):
            assert {choose_set(windows, present, d) for d in range(low, high + 1)} == {present}


def test_an_unknown_delay_or_one_outside_every_window_changes_nothing():
    for windows in SCHEDULES:
        for d in DELAYS:
            if d is None or not windows[0][0] <= d <= windows[-1][1]:
                assert [choose_set(windows, i, d) for i in range(len(windows))] == list(range(len(windows)))


def test_a_new_set_is_the_one_with_the_most_room_then_the_narrowest_then_the_first():
    ties = 0
    for windows in SCHEDULES:
        for present in range(len(windows)):
            for d in range(windows[0][0], windows[-1][1] + 1):
                chosen = choose_set(windows, present, d)
                if chosen == present:
                    continue
                others = [i for i, (low, high) in enumerate(windows) if low <= d <= high and i != chosen]
                low, high = windows[chosen]
                for i in others:
                    assert room(windows[i], d) <= room((low, high), d)
                    if room(windows[i], d) == room((low, high), d):
                        width = windows[i][1] - windows[i][0]
                        assert high - low < width or (high - low == width and chosen < i)
                        ties += 1
    assert ties > 10


@pytest.mark.parametrize(
    ("windows", "present", "d", "chosen"),
    [
        (((1, 3), (2, 6), (4, 9)), 0, 4, 1),  # room 2 against 0
        (((1, 3), (2, 6), (4, 9)), 0, 6, 2),  # room 2 against 0
        (((1, 1), (2, 4), (3, 6)), 0, 3, 1),  # room 1 against 0
        (((1, 2), (3, 4)), 0, 3, 1),  # side by side
        (((0, 6), (4, 9), (9, 12)), 2, 5, 1),  # room 1 each, and the second is narrower
        (((0, 4), (2, 6), (5, 9)), 2, 3, 0),  # room 1 each, equally wide
        (((0, 4), (2, 6), (5, 9)), 2, 2, 0),  # room 2 against 0
    ],
)
def test_choices_by_hand(windows, present, d, chosen):
    assert choose_set(windows, present, d) == chosen


def test_a_delay_that_wanders_inside_an_overlap_switches_once():
    windows, present, chosen = ((1, 3), (2, 6)), 0, []
    for d in (1, 2, 3, 4, 3, 2, 3, 2, 4, 1, 2, 3):
        present = choose_set(windows, present, d)
        chosen.append(present)
    assert chosen == [0, 0, 0, 1, 1, 1, 1, 1, 1, 0, 0, 0]


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
