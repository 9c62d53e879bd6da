"""The failsafe table, every pair of it, against the requirement's own words.

"No fresh state within d_max samples, or d outside the certified window, leaves TRACKING for HOLD, then
NEUTRAL, and comes back by itself."
"""

from __future__ import annotations

import subprocess
import sys
from itertools import groupby, product
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autopilot.failsafe import FLOWN_BY_LAW, TRANSITIONS, Event, FailsafeState, Limits, Mode, step
from autopilot.failsafe_page import COMMAND, PATH, page

quick = settings(deadline=None)
HOLD_NS = 500
REST_NS = 2000
CALM = 7
LIMITS = Limits(HOLD_NS, 3, CALM, REST_NS)
WITH_CONSERVATIVE = Limits(HOLD_NS, 3, CALM, REST_NS, conservative=True)
BOTH = pytest.mark.parametrize("limits", [LIMITS, WITH_CONSERVATIVE], ids=["one law", "conservative law too"])
either = st.sampled_from([LIMITS, WITH_CONSERVATIVE])

NO_STATE = {"outside", "stale", "half", "implausible", "frozen"}
"""Words for: the law must not fly with this."""
FULL_ROW = {"recovered", "calm"}


def expected(mode: str, event: str, conservative: bool = True) -> str:
    """Return the next mode as the requirement says it in words, for a single event that completes no row."""
    if event == "wide" and not conservative:
        event = "outside"  # no gains are made for that delay
    if event == "wide_recovered" and not conservative:
        return mode  # nothing to fly with
    if event == "restarted":
        return "STANDBY"  # a new aircraft: begin again
    if event == "released":
        return "STANDBY"  # disarmed, or a hand has the elevator: nothing that failsafe could hold
    if event == "saturated":
        return mode if mode == "STANDBY" else "NEUTRAL"  # to hold the last command would hold it at the limit
    by_mode = {
        "STANDBY": _from_standby,
        "TRACKING": _from_the_law,
        "LEVEL": _from_the_law,
        "CONSERVATIVE": _from_the_conservative_law,
        "HOLD": _from_no_law,
        "NEUTRAL": _from_no_law,
    }
    return by_mode[mode](mode, event)


def _from_standby(mode: str, event: str) -> str:
    if event == "wide_recovered":
        return "CONSERVATIVE"
    return "TRACKING" if event == "good" or event in FULL_ROW else mode


def _from_the_law(mode: str, event: str) -> str:
    if event in NO_STATE or event in ("wide", "clock_lost"):
        return "HOLD"
    return {"ground_lost": "LEVEL", "ground_back": "TRACKING"}.get(event, mode)


def _from_the_conservative_law(mode: str, event: str) -> str:
    if event in NO_STATE:
        return "HOLD"
    return "TRACKING" if event == "calm" else mode  # not on the first good row: no switching to and fro


def _from_no_law(mode: str, event: str) -> str:
    if event == "wide_recovered":
        return "CONSERVATIVE"
    if event in FULL_ROW:
        return "TRACKING"  # comes back by itself
    return "NEUTRAL" if event == "expired" else mode


def run(state: FailsafeState, events: list[Event], limits: Limits, now_ns: int = 10) -> FailsafeState:
    for event in events:
        state = step(state, event, now_ns, limits)
    return state


PAIRS = list(product(Mode, Event))


def test_the_sweep_covers_every_pair():
    assert {str(mode) for mode in Mode} == {"STANDBY", "TRACKING", "LEVEL", "CONSERVATIVE", "HOLD", "NEUTRAL"}
    samples = {"good", "wide", "outside", "implausible", "frozen"}
    rows = {"recovered", "calm", "wide_recovered"}
    others = {"stale", "half", "clock_lost", "saturated", "ground_lost", "ground_back", "expired"}
    others |= {"restarted", "released"}
    assert {str(e) for e in Event} == samples | rows | others
    assert len(PAIRS) == 102


def test_every_mode_and_event_says_what_it_means_and_is_found_by_its_word():
    for word in (*Mode, *Event):
        assert word.meaning.endswith(".")
        assert type(word)(str(word)) is word


def test_the_law_flies_in_the_three_modes_that_say_so():
    assert {str(mode) for mode in FLOWN_BY_LAW} == {"TRACKING", "LEVEL", "CONSERVATIVE"}


@BOTH
@pytest.mark.parametrize(("mode", "event"), PAIRS)
def test_every_pair_goes_where_the_requirement_says(mode, event, limits):
    after = step(FailsafeState(mode, since_ns=1000), event, 1000 + HOLD_NS, limits)
    assert after.mode == expected(mode, event, limits.conservative)


@pytest.mark.parametrize(("mode", "event"), PAIRS)
def test_the_table_itself_says_the_same(mode, event):
    assert TRANSITIONS.get((mode, event), mode) == expected(mode, event)
    assert TRANSITIONS.get((mode, event)) is not mode


@BOTH
@pytest.mark.parametrize(("mode", "event"), PAIRS)
def test_a_change_of_mode_starts_its_time_and_a_stay_keeps_it(mode, event, limits):
    after = step(FailsafeState(mode, since_ns=1000), event, 1000 + HOLD_NS, limits)
    assert after.since_ns == (1000 if after.mode is mode else 1000 + HOLD_NS)


# rows

BREAKS_NO_ROW = {"saturated", "ground_lost", "ground_back", "expired"}


@BOTH
@pytest.mark.parametrize(("mode", "event"), PAIRS)
@pytest.mark.parametrize("good", [0, 1, 2, CALM - 1, CALM])
def test_only_good_samples_make_a_row(mode, event, good, limits):
    before = FailsafeState(mode, 1000, good, good)
    after = step(before, event, 1000 + HOLD_NS, limits)
    if after.mode is not mode:
        assert (after.good_in_a_row, after.usable_in_a_row) == (0, 0)
    elif event is Event.GOOD:
        assert (after.good_in_a_row, after.usable_in_a_row) == (min(good + 1, CALM), min(good + 1, CALM))
    elif event in BREAKS_NO_ROW:
        assert (after.good_in_a_row, after.usable_in_a_row) == (good, good)
    else:
        assert after.good_in_a_row == 0


@pytest.mark.parametrize("mode", [Mode.STANDBY, Mode.CONSERVATIVE, Mode.HOLD, Mode.NEUTRAL])
def test_a_lost_clock_breaks_the_row_of_good_samples_and_not_that_of_usable_ones(mode):
    after = step(FailsafeState(mode, 0, 2, 2), Event.CLOCK_LOST, 10, WITH_CONSERVATIVE)
    assert (after.mode, after.good_in_a_row, after.usable_in_a_row) == (mode, 0, 2)


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


@pytest.mark.parametrize("samples", [s for s in product([Event.GOOD, Event.WIDE], repeat=3) if Event.WIDE in s])
@pytest.mark.parametrize("mode", [Mode.HOLD, Mode.NEUTRAL])
def test_three_usable_samples_that_are_not_all_good_come_back_to_the_conservative_law(mode, samples):
    state = run(FailsafeState(mode), list(samples[:2]), WITH_CONSERVATIVE)
    assert state.mode is mode
    assert step(state, samples[2], 10, WITH_CONSERVATIVE).mode is Mode.CONSERVATIVE


@pytest.mark.parametrize("mode", [Mode.TRACKING, Mode.LEVEL])
def test_a_wide_sample_ends_tracking_even_when_it_completes_a_row(mode):
    state = run(FailsafeState(mode), [Event.GOOD] * 2, WITH_CONSERVATIVE)
    assert step(state, Event.WIDE, 10, WITH_CONSERVATIVE).mode is Mode.HOLD


def test_one_good_sample_starts_the_law_even_when_it_completes_a_row_for_the_other():
    state = run(FailsafeState(), [Event.WIDE] * 2, WITH_CONSERVATIVE)
    assert state.mode is Mode.STANDBY
    assert step(state, Event.GOOD, 10, WITH_CONSERVATIVE).mode is Mode.TRACKING
    assert step(state, Event.WIDE, 10, WITH_CONSERVATIVE).mode is Mode.CONSERVATIVE


def test_no_sample_counts_for_two_changes_of_mode():
    state = run(FailsafeState(Mode.HOLD), [Event.WIDE, Event.GOOD, Event.GOOD], WITH_CONSERVATIVE)
    assert state == FailsafeState(Mode.CONSERVATIVE, 10, cautious=True)
    state = run(state, [Event.GOOD] * (CALM - 1), WITH_CONSERVATIVE)
    assert state.mode is Mode.CONSERVATIVE
    assert step(state, Event.GOOD, 10, WITH_CONSERVATIVE).mode is Mode.TRACKING


@pytest.mark.parametrize("spoiler", [Event.WIDE, Event.CLOCK_LOST, Event.RECOVERED])
def test_what_wanders_over_the_edge_stays_with_the_conservative_law(spoiler):
    state = FailsafeState(Mode.CONSERVATIVE)
    for _ in range(100):
        state = run(state, [*[Event.GOOD] * (CALM - 1), spoiler], WITH_CONSERVATIVE)
    assert state.mode is Mode.CONSERVATIVE


SPOILERS = [Event.OUTSIDE, Event.STALE, Event.HALF, Event.IMPLAUSIBLE, Event.FROZEN]


@BOTH
@pytest.mark.parametrize("spoiler", SPOILERS)
@pytest.mark.parametrize("mode", [Mode.HOLD, Mode.NEUTRAL])
def test_a_bad_sample_breaks_the_row(mode, spoiler, limits):
    state = run(FailsafeState(mode), [Event.GOOD, Event.GOOD, spoiler, Event.GOOD, Event.GOOD], limits)
    assert state.mode is mode
    assert step(state, Event.GOOD, 10, limits).mode is Mode.TRACKING


@pytest.mark.parametrize("spoiler", SPOILERS)
@pytest.mark.parametrize("mode", sorted(FLOWN_BY_LAW))
def test_one_bad_sample_ends_the_law_however_long_the_row_before(mode, spoiler):
    state = run(
        FailsafeState(mode), [Event.GOOD if mode is not Mode.CONSERVATIVE else Event.WIDE] * 1000, WITH_CONSERVATIVE
    )
    assert state.mode is mode
    assert step(state, spoiler, 1000, WITH_CONSERVATIVE).mode is Mode.HOLD


# after saturation


@BOTH
@pytest.mark.parametrize("mode", sorted(FLOWN_BY_LAW | {Mode.HOLD}))
def test_after_saturation_neutral_lasts_its_time_whatever_the_samples_say(mode, limits):
    state = step(FailsafeState(mode), Event.SATURATED, 1000, limits)
    assert (state.mode, state.resting) == (Mode.NEUTRAL, True)
    for event in (Event.GOOD, Event.WIDE, *[Event.GOOD] * 50, Event.CALM, Event.RECOVERED, *[Event.GOOD] * 3):
        state = step(state, event, 1000 + REST_NS - 1, limits)
        assert state.mode is Mode.NEUTRAL
    assert step(state, Event.GOOD, 1000 + REST_NS, limits).mode is Mode.TRACKING


def test_neutral_after_an_expired_hold_need_not_rest():
    state = step(FailsafeState(Mode.HOLD), Event.EXPIRED, HOLD_NS, LIMITS)
    assert (state.mode, state.resting) == (Mode.NEUTRAL, False)
    assert run(state, [Event.GOOD] * 3, LIMITS, HOLD_NS).mode is Mode.TRACKING


def test_a_saturation_told_again_neither_prolongs_the_rest_nor_breaks_the_row():
    state = run(FailsafeState(Mode.TRACKING), [Event.SATURATED, Event.GOOD, Event.GOOD, Event.SATURATED], LIMITS, 1000)
    assert step(state, Event.GOOD, 1000 + REST_NS, LIMITS).mode is Mode.TRACKING


def test_a_restarted_plant_need_not_rest():
    state = run(FailsafeState(Mode.TRACKING), [Event.SATURATED, Event.RESTARTED, Event.GOOD], LIMITS)
    assert state.mode is Mode.TRACKING


# the ground's hand


@BOTH
@pytest.mark.parametrize("mode", [mode for mode in Mode if mode is not Mode.STANDBY])
def test_what_was_released_begins_like_a_new_aircraft_but_remembers_a_lost_ground_station(mode, limits):
    before = FailsafeState(mode, 1000, 2, 2, resting=True, cautious=True, ground_lost=True)
    after = step(before, Event.RELEASED, 3000, limits)
    assert after == FailsafeState(Mode.STANDBY, 3000, ground_lost=True)
    assert step(after, Event.GOOD, 3001, limits).mode is Mode.LEVEL


@BOTH
def test_a_release_again_in_standby_is_no_change(limits):
    assert step(FailsafeState(since_ns=1000), Event.RELEASED, 3000, limits) == FailsafeState(since_ns=1000)


# the ground station


@BOTH
@pytest.mark.parametrize("mode", [Mode.STANDBY, Mode.HOLD, Mode.NEUTRAL])
def test_a_ground_station_lost_without_the_law_is_remembered_until_the_law_is_back(mode, limits):
    state = run(FailsafeState(mode), [Event.GROUND_LOST, *[Event.GOOD] * 3], limits)
    assert (state.mode, state.ground_lost) == (Mode.LEVEL, True)
    state = run(FailsafeState(mode), [Event.GROUND_LOST, Event.GROUND_BACK, *[Event.GOOD] * 3], limits)
    assert (state.mode, state.ground_lost) == (Mode.TRACKING, False)


def test_a_ground_station_lost_under_the_conservative_law_is_known_there_and_levels_after_it():
    state = step(FailsafeState(Mode.CONSERVATIVE), Event.GROUND_LOST, 10, WITH_CONSERVATIVE)
    assert (state.mode, state.ground_lost) == (Mode.CONSERVATIVE, True)
    assert run(state, [Event.GOOD] * CALM, WITH_CONSERVATIVE).mode is Mode.LEVEL


def test_a_hold_on_the_way_does_not_bring_the_reference_back():
    lost = [Event.GROUND_LOST, Event.STALE, *[Event.GOOD] * 3]
    state = run(FailsafeState(Mode.TRACKING), lost, LIMITS)
    assert state.mode is Mode.LEVEL
    assert step(state, Event.GROUND_BACK, 10, LIMITS).mode is Mode.TRACKING


# any sequence

events = st.lists(st.tuples(st.sampled_from(Event), st.integers(0, 400)), max_size=60)
"""Events and the time before each."""


def after(sequence: list[tuple[Event, int]], limits: Limits) -> tuple[FailsafeState, int]:
    state, now_ns = FailsafeState(), 0
    for event, gap_ns in sequence:
        now_ns += gap_ns
        state = step(state, event, now_ns, limits)
    return state, now_ns


@quick
@given(events, either)
def test_no_sequence_leaves_the_requirement_or_reaches_neutral_before_its_time(sequence, limits):
    state, now_ns = FailsafeState(), 0
    for event, gap_ns in sequence:
        now_ns += gap_ns
        before, state = state, step(state, event, now_ns, limits)
        if before.mode is not state.mode:
            said = {event}
            if event is Event.GOOD:
                said |= {Event.RECOVERED} if before.good_in_a_row >= 2 else set()
                said |= {Event.CALM} if before.good_in_a_row >= CALM - 1 else set()
            if event in (Event.GOOD, Event.WIDE) and before.usable_in_a_row >= 2:
                said |= {Event.WIDE_RECOVERED}
            reached = {expected(before.mode, e, limits.conservative) for e in said}
            assert state.mode in reached or (state.mode is Mode.LEVEL and state.ground_lost and "TRACKING" in reached)
            assert state.since_ns == now_ns
        if state.mode is Mode.NEUTRAL and before.mode is not Mode.NEUTRAL and event is not Event.SATURATED:
            assert (before.mode, event) == (Mode.HOLD, Event.EXPIRED)
            assert now_ns - before.since_ns >= HOLD_NS
        assert 0 <= state.good_in_a_row <= state.usable_in_a_row <= CALM


@quick
@given(events, st.sampled_from(SPOILERS), either)
def test_no_law_has_the_elevator_right_after_what_no_law_may_fly_with(sequence, spoiler, limits):
    state, now_ns = after(sequence, limits)
    assert step(state, spoiler, now_ns, limits).mode not in FLOWN_BY_LAW


@quick
@given(events, st.sampled_from([Event.WIDE, Event.CLOCK_LOST, Event.SATURATED]), either)
def test_the_narrow_law_never_has_the_elevator_right_after_a_wide_delay_a_lost_clock_or_saturation(
    sequence, event, limits
):
    state, now_ns = after(sequence, limits)
    assert step(state, event, now_ns, limits).mode not in (Mode.TRACKING, Mode.LEVEL)


@quick
@given(events)
def test_without_a_conservative_set_its_mode_is_never_reached(sequence):
    state, now_ns = FailsafeState(), 0
    for event, gap_ns in sequence:
        now_ns += gap_ns
        state = step(state, event, now_ns, LIMITS)
        assert state.mode is not Mode.CONSERVATIVE


@quick
@given(events)
def test_without_a_conservative_set_a_wide_sample_is_an_outside_one(sequence):
    outside = [(Event.OUTSIDE if event is Event.WIDE else event, gap_ns) for event, gap_ns in sequence]
    assert after(sequence, LIMITS) == after(outside, LIMITS)


@quick
@given(events, either)
def test_the_reference_is_level_whenever_the_law_flies_without_a_ground_station(sequence, limits):
    state, now_ns, lost = FailsafeState(), 0, False
    for event, gap_ns in sequence:
        now_ns += gap_ns
        state = step(state, event, now_ns, limits)
        lost = {Event.GROUND_LOST: True, Event.GROUND_BACK: False}.get(event, lost)
        assert state.ground_lost is lost
        assert state.mode is not (Mode.TRACKING if lost else Mode.LEVEL)


@quick
@given(events, either)
def test_good_samples_and_a_little_time_bring_any_state_to_the_law(sequence, limits):
    state, now_ns = after(sequence, limits)
    for _ in range(3 + CALM):
        state = step(state, Event.GOOD, now_ns + REST_NS, limits)
    assert state.mode is (Mode.LEVEL if state.ground_lost else Mode.TRACKING)


@pytest.mark.parametrize("mode", Mode)
@pytest.mark.parametrize("conservative", [False, True])
def test_a_second_of_good_samples_is_enough_with_the_limits_that_fly(mode, conservative):
    limits = Limits(500_000_000, conservative=conservative)
    state = FailsafeState(mode, resting=mode is Mode.NEUTRAL)
    for k in range(1, 41):
        state = step(state, Event.GOOD, k * 25_000_000, limits)
    assert state.mode in (Mode.TRACKING, Mode.LEVEL)


@quick
@given(events, either)
def test_expired_changes_nothing_before_its_time(sequence, limits):
    state, now_ns = after(sequence, limits)
    later = step(state, Event.EXPIRED, now_ns, limits)
    if state.mode is not Mode.HOLD or now_ns - state.since_ns < HOLD_NS:
        assert later is state
    else:
        assert later.mode is Mode.NEUTRAL


def test_a_step_does_not_change_the_state_it_is_given():
    before = FailsafeState(Mode.HOLD, 0, 1)
    step(before, Event.GOOD, 1, LIMITS)
    assert before == FailsafeState(Mode.HOLD, 0, 1)


# the page


def test_the_page_is_what_the_table_says():
    path = Path(__file__).parents[2] / PATH
    assert path.read_text(encoding="utf-8") == page(), f"{PATH} is out of date; run: {COMMAND}"


def test_the_page_shows_every_transition_in_diagram_and_table():
    lines = page().splitlines()
    for (mode, event), to in TRANSITIONS.items():
        edge = next(line for line in lines if line.strip().startswith(f"{mode} --> {to}:"))
        assert str(event) in edge.split(": ")[1].split(", ")
        row = next(line for line in lines if line.startswith(f"| *{event}* |") and line.count("|") == len(Mode) + 2)
        assert [cell.strip() for cell in row.split("|")][2 + list(Mode).index(mode)] == to


def test_the_page_is_written_by_its_command(tmp_path):
    target = tmp_path / "docs" / "failsafe.md"
    words = COMMAND.split()
    subprocess.run([sys.executable, *words[1:-1], str(target)], check=True, cwd=Path(__file__).parents[2])
    assert target.read_text(encoding="utf-8") == page()


def test_after_the_conservative_gains_a_hold_is_no_short_cut_to_the_law():
    limits = Limits(hold_ns=HOLD_NS, conservative=True)
    state, now_ns = FailsafeState(Mode.TRACKING), 0
    flown = []
    for event in [Event.WIDE] * 4 + [Event.OUTSIDE] + [Event.GOOD] * 43:
        now_ns += 1
        state = step(state, event, now_ns, limits)
        flown.append(str(state.mode))
    assert [mode for mode, _ in groupby(flown)] == ["HOLD", "CONSERVATIVE", "HOLD", "CONSERVATIVE", "TRACKING"]
    assert flown[:5].count("CONSERVATIVE") == 1
    assert flown[-3:] == ["CONSERVATIVE", "CONSERVATIVE", "TRACKING"]  # 3 GOOD samples, and then 40 calm ones
    state = step(step(state, Event.OUTSIDE, now_ns + 1, limits), Event.GOOD, now_ns + 2, limits)
    for later_ns in (3, 4):
        state = step(state, Event.GOOD, now_ns + later_ns, limits)
    assert state.mode is Mode.TRACKING  # the law itself flew last
