"""The failsafe table, every pair of it, against the requirement's own words.

"No fresh state within d_max samples, or d outside the certified window, leaves TRACKING for HOLD, then
NEUTRAL, and comes back by itself."
"""

from __future__ import annotations

from itertools import product

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autopilot.failsafe import TRANSITIONS, Event, FailsafeState, Limits, Mode, step

quick = settings(deadline=None)
HOLD_NS = 500
LIMITS = Limits(hold_ns=HOLD_NS, good_samples=3)


def expected(mode: str, event: str) -> str:
    """Return the next mode as the requirement says it in words."""
    if event == "restarted":
        return "STANDBY"  # a new aircraft: begin again
    if mode == "STANDBY":
        return "TRACKING" if event in ("good", "recovered") else "STANDBY"
    if mode == "TRACKING":
        return "HOLD" if event in ("stale", "outside") else "TRACKING"
    if event == "recovered":
        return "TRACKING"  # comes back by itself
    if mode == "HOLD" and event == "expired":
        return "NEUTRAL"
    return mode


PAIRS = list(product(Mode, Event))


def test_the_sweep_covers_every_pair():
    assert {str(mode) for mode in Mode} == {"STANDBY", "TRACKING", "HOLD", "NEUTRAL"}
    assert {str(e) for e in Event} == {"good", "recovered", "outside", "stale", "expired", "restarted"}
    assert len(PAIRS) == 24


@pytest.mark.parametrize(("mode", "event"), PAIRS)
def test_every_pair_goes_where_the_requirement_says(mode, event):
    after = step(FailsafeState(mode, since_ns=1000), event, 1000 + HOLD_NS, LIMITS)
    assert after.mode == expected(mode, event)
    assert TRANSITIONS.get((mode, event), mode) == expected(mode, event)


@pytest.mark.parametrize(("mode", "event"), PAIRS)
def test_a_change_of_mode_starts_its_time_and_a_stay_keeps_it(mode, event):
    after = step(FailsafeState(mode, since_ns=1000), event, 1000 + HOLD_NS, LIMITS)
    assert after.since_ns == (1000 if after.mode is mode else 1000 + HOLD_NS)


@pytest.mark.parametrize(("mode", "event"), PAIRS)
@pytest.mark.parametrize("good", range(4))
def test_only_good_samples_make_a_row(mode, event, good):
    before = FailsafeState(mode, 1000, good)
    after = step(before, event, 1000 + HOLD_NS, LIMITS)
    if after.mode is not mode:
        assert after.good_in_a_row == 0
    elif event is Event.GOOD:
        assert after.good_in_a_row == min(good + 1, 3)
    elif event is Event.EXPIRED:
        assert after.good_in_a_row == good
    else:
        assert after.good_in_a_row == 0


@pytest.mark.parametrize("waited_ns", [0, 1, HOLD_NS - 1])
def test_hold_does_not_expire_before_its_time(waited_ns):
    before = FailsafeState(Mode.HOLD, 1000, 2)
    assert step(before, Event.EXPIRED, 1000 + waited_ns, LIMITS) == before


@pytest.mark.parametrize("mode", [Mode.HOLD, Mode.NEUTRAL])
def test_the_third_good_sample_in_a_row_comes_back_and_the_second_does_not(mode):
    state = FailsafeState(mode, 0)
    modes = []
    for _ in range(3):
        state = step(state, Event.GOOD, 10, LIMITS)
        modes.append(state.mode)
    assert modes == [mode, mode, Mode.TRACKING]


@pytest.mark.parametrize("spoiler", [Event.OUTSIDE, Event.STALE])
@pytest.mark.parametrize("mode", [Mode.HOLD, Mode.NEUTRAL])
def test_a_bad_sample_breaks_the_row(mode, spoiler):
    state = FailsafeState(mode, 0)
    for event in (Event.GOOD, Event.GOOD, spoiler, Event.GOOD, Event.GOOD):
        state = step(state, event, 10, LIMITS)
    assert state.mode is mode
    assert step(state, Event.GOOD, 10, LIMITS).mode is Mode.TRACKING


@pytest.mark.parametrize("spoiler", [Event.OUTSIDE, Event.STALE])
def test_one_bad_sample_ends_tracking_however_long_the_row_before(spoiler):
    state = FailsafeState(Mode.TRACKING, 0)
    for n in range(1000):
        state = step(state, Event.GOOD, n, LIMITS)
    assert state.mode is Mode.TRACKING
    assert step(state, spoiler, 1000, LIMITS).mode is Mode.HOLD


events = st.lists(st.tuples(st.sampled_from(Event), st.integers(0, 400)), max_size=60)


@quick
@given(events)
def test_no_sequence_leaves_the_table_or_reaches_neutral_but_through_hold(sequence):
    state, now_ns = FailsafeState(), 0
    for event, gap_ns in sequence:
        now_ns += gap_ns
        before, state = state, step(state, event, now_ns, LIMITS)
        if before.mode is not state.mode:
            assert state.mode == expected(before.mode, event) or (
                event is Event.GOOD and before.good_in_a_row == 2 and state.mode is Mode.TRACKING
            )
            assert state.since_ns == now_ns
        if state.mode is Mode.NEUTRAL and before.mode is not Mode.NEUTRAL:
            assert before.mode is Mode.HOLD
            assert now_ns - before.since_ns >= HOLD_NS
        assert 0 <= state.good_in_a_row <= 3


@quick
@given(events)
def test_three_good_samples_bring_any_state_to_tracking(sequence):
    state, now_ns = FailsafeState(), 0
    for event, gap_ns in sequence:
        now_ns += gap_ns
        state = step(state, event, now_ns, LIMITS)
    for _ in range(3):
        state = step(state, Event.GOOD, now_ns, LIMITS)
    assert state.mode is Mode.TRACKING


def test_a_step_does_not_change_the_state_it_is_given():
    before = FailsafeState(Mode.HOLD, 0, 1)
    step(before, Event.GOOD, 1, LIMITS)
    assert before == FailsafeState(Mode.HOLD, 0, 1)
