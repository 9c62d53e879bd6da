"""Messages to samples: pairing by time, order, numbers; half a sample is no sample."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autopilot.link.wire import AoaSsa, Attitude
from autopilot.state import (
    JUMP_BACK_NS,
    MAX_PENDING,
    MAX_STAMP_NS,
    NUMBER_WAIT_NS,
    RESYNC_MEASUREMENTS,
    RESYNC_NS,
    Drop,
    Sample,
    SampleAssembler,
)
from gains.store import load_model
from tests.helpers import HIRM, MS, TS, S

quick = settings(deadline=None)
MODEL = HIRM.model
T0 = 137 * S + TS
U32_MS = (1 << 32) * MS
U32_US = (1 << 32) * 1000


def state(k: int) -> np.ndarray:
    """Return the state at sample k: every one tells its sample."""
    return np.array([1e-3 * k, 2.0 + k, -3.0 - 0.5 * k])


def halves(k: int, t0_ns: int = T0, late_us: int = 137) -> tuple[Attitude, AoaSsa]:
    """Return both messages of sample k, whose instant is not on the grid of milliseconds."""
    t_ns = t0_ns + k * TS + late_us * 1000
    x = state(k)
    attitude = Attitude((t_ns // MS) % (1 << 32), 0.0, x[2], 0.0, 0.0, x[1], 0.0)
    return attitude, AoaSsa(t_ns // 1000, float(np.degrees(x[0])), 0.0)


def numbered(k: int = 0, t0_ns: int = T0) -> SampleAssembler:
    """Return an assembler that knows the number of sample k."""
    assembler = SampleAssembler(MODEL)
    assembler.number(k, halves(k, t0_ns)[0].time_boot_ms)
    return assembler


def feed(assembler: SampleAssembler, messages, now_ns: int = 0) -> list[Sample]:
    samples = (assembler.add(message, now_ns) for message in messages)
    return [sample for sample in samples if sample is not None]


def assert_right(samples: list[Sample]) -> None:
    """Check that numbers rise strictly and that every state is that of its number."""
    numbers = [sample.j for sample in samples]
    assert numbers == sorted(set(numbers))
    for sample in samples:
        np.testing.assert_allclose(sample.x, state(sample.j), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_two_halves_make_a_sample_in_either_order(order):
    assembler = numbered()
    both = halves(0)
    assert assembler.add(both[order[0]], 0) is None
    sample = assembler.add(both[order[1]], 0)
    assert (sample.j, sample.t_ns) == (0, T0 + 137_000)
    assert set(sample.parts) == set(both)
    assert_right([sample])


def test_half_a_sample_is_no_sample():
    assembler = numbered()
    for which in (0, 1):
        assert feed(assembler, [halves(k)[which] for k in range(20 * which, 20 * which + 20)]) == []


def test_the_halves_of_different_samples_do_not_go_together():
    assembler = numbered()
    assert feed(assembler, [m for k in range(0, 40, 2) for m in (halves(k)[0], halves(k + 1)[1])]) == []


@pytest.mark.parametrize("late_us", [0, 1, 500, 999])
def test_the_millisecond_grid_of_attitude_meets_the_microseconds_of_angle_of_attack(late_us):
    assembler = numbered()
    samples = feed(assembler, [m for k in range(100) for m in halves(k, late_us=late_us)])
    assert [s.j for s in samples] == list(range(100))
    assert [s.t_ns for s in samples] == [T0 + k * TS + late_us * 1000 for k in range(100)]
    assert_right(samples)


def test_halves_belong_together_below_half_a_period_and_not_at_it():
    for apart_ms, together in ((12, True), (13, False)):
        assembler = numbered()
        attitude, air = halves(0, late_us=0)
        samples = feed(assembler, [attitude, air._replace(time_usec=air.time_usec + apart_ms * 1000)])
        assert bool(samples) is together


def test_duplicates_are_dropped_and_counted():
    assembler = numbered()
    attitude, air = halves(0)
    assert len(feed(assembler, [attitude, attitude, air, air, attitude])) == 1
    assert assembler.drops == {Drop.DUPLICATE: 3}


def test_a_late_sample_is_dropped_and_counted():
    assembler = numbered()
    feed(assembler, halves(5))
    assert feed(assembler, halves(4)) == []
    assert assembler.drops == {Drop.LATE: 2}
    assert not assembler.jumped_back


def test_a_newer_sample_leaves_the_older_half_behind():
    assembler = numbered()
    feed(assembler, [halves(3)[0], *halves(4)])
    assert assembler.drops == {Drop.HALF: 1}
    assert feed(assembler, [halves(3)[1]]) == []
    assert assembler.drops == {Drop.HALF: 1, Drop.LATE: 1}


def test_waiting_halves_are_bounded():
    assembler = numbered()
    feed(assembler, [halves(k)[0] for k in range(10 * MAX_PENDING)])
    assert len(assembler._pending) == MAX_PENDING
    assert assembler.drops == {Drop.HALF: 9 * MAX_PENDING}
    assert [s.j for s in feed(assembler, [halves(10 * MAX_PENDING - 1)[1]])] == [10 * MAX_PENDING - 1]


@st.composite
def jumbled(draw):
    """Draw a stream whose messages are lost, doubled, and up to eight samples out of place."""
    count = draw(st.integers(1, 25))
    messages = [(k, half) for k in range(count) for half in (0, 1)]
    copies = draw(st.lists(st.integers(0, 3), min_size=len(messages), max_size=len(messages)))
    stream = [m for m, n in zip(messages, copies, strict=True) for _ in range(n)]
    places = draw(st.lists(st.floats(0.0, 8.0), min_size=len(stream), max_size=len(stream)))
    order = sorted(range(len(stream)), key=lambda i: stream[i][0] + places[i])
    return [stream[i] for i in order]


@settings(deadline=None, max_examples=300)
@given(jumbled())
def test_whatever_the_order_numbers_rise_and_only_whole_right_samples_come(stream):
    assembler = numbered()
    samples = feed(assembler, [halves(k)[half] for k, half in stream])
    assert_right(samples)
    assert {s.j for s in samples} <= {k for k, _ in stream if (k, 0) in stream and (k, 1) in stream}
    accounted = 2 * len(samples) + sum(assembler.drops.values()) + sum(len(p.parts) for p in assembler._pending)
    assert accounted == len(stream)


@quick
@given(st.lists(st.booleans(), min_size=1, max_size=40))
def test_in_order_every_whole_sample_comes_and_no_other(kept):
    assembler = numbered()
    stream = [m for k, whole in enumerate(kept) for m in (halves(k) if whole else halves(k)[:1])]
    assert [s.j for s in feed(assembler, stream)] == [k for k, whole in enumerate(kept) if whole]


# numbers


def test_the_number_is_the_plants_although_the_first_samples_are_lost():
    assembler = SampleAssembler(MODEL)
    assert feed(assembler, [m for k in range(7, 10) for m in halves(k)]) == []
    sample = assembler.number(9, halves(9)[0].time_boot_ms)
    assert sample.j == 9
    assert_right([sample, *feed(assembler, [m for k in range(10, 20) for m in halves(k)])])


def test_a_sample_waits_for_its_number_once():
    assembler = SampleAssembler(MODEL)
    feed(assembler, halves(3))
    assert assembler.number(3, halves(3)[0].time_boot_ms).j == 3
    assert assembler.number(3, halves(3)[0].time_boot_ms) is None


@pytest.mark.parametrize("told", [0, 3, 9, 25])
def test_any_number_of_the_epoch_numbers_every_sample(told):
    assembler = numbered(told)
    samples = feed(assembler, [m for k in range(5, 30) for m in halves(k)])
    assert [s.j for s in samples] == list(range(5, 30))


def test_numbers_hold_over_an_hour_of_lost_numbers():
    assembler = numbered()
    samples = [s for k in range(0, 144_000, 999) for s in feed(assembler, halves(k))]
    assert [s.j for s in samples] == list(range(0, 144_000, 999))


def test_a_plant_that_sends_no_numbers_is_numbered_from_the_first_sample_seen():
    assembler = SampleAssembler(MODEL)
    came = {}
    for k in range(200):
        for sample in feed(assembler, halves(50 + k), now_ns=k * TS):
            came[k] = sample.j
    first = NUMBER_WAIT_NS // TS
    assert list(came) == list(range(first, 200))
    assert list(came.values()) == list(range(first, 200))


def tell(assembler: SampleAssembler, k: int, number: int | None = None) -> Sample | None:
    """Give the plant's number of sample k, or a wrong one."""
    return assembler.number(k if number is None else number, halves(k)[0].time_boot_ms)


@pytest.mark.parametrize("wrong", [0, 44, 46, 10**6, (1 << 31) - 1, -1, -(1 << 31)])
def test_one_wrong_number_changes_nothing(wrong):
    assembler = numbered()
    numbers = []
    for k in range(200):
        if k % 40 == 0:
            tell(assembler, k)
        if k == 45:
            tell(assembler, k, wrong)
            tell(assembler, k, wrong)  # a copy of it confirms nothing
        numbers += [s.j for s in feed(assembler, halves(k))]
    assert numbers == list(range(200))
    assert assembler.lost == ""


def test_two_numbers_that_agree_are_believed_against_the_running_one():
    assembler = numbered()
    feed(assembler, halves(0))
    tell(assembler, 10, 1010)
    assert [s.j for s in feed(assembler, halves(11))] == [11]
    tell(assembler, 50, 1050)
    assert [s.j for s in feed(assembler, halves(51))] == [1051]


def test_a_number_between_them_that_agrees_with_the_running_one_keeps_it():
    assembler = numbered()
    for k, number in ((10, 1010), (20, 20), (30, 1030)):
        tell(assembler, k, number)
    assert [s.j for s in feed(assembler, halves(31))] == [31]


def test_numbers_that_fall_back_twice_lose_the_track_and_those_of_the_new_epoch_are_believed_at_once():
    assembler = numbered(10**6)
    feed(assembler, halves(10**6))
    for k in (10**6 + 40, 10**6 + 80):
        assert assembler.lost == ""
        assembler.number(k - 10**6, halves(k)[0].time_boot_ms)
    assert assembler.lost == "sample numbers fell back"
    assembler.restart()
    assert assembler.lost == ""
    tell(assembler, 10**6 + 80, 80)
    assert [s.j for s in feed(assembler, halves(10**6 + 81))] == [81]


def test_a_number_that_falls_back_a_little_is_no_new_epoch():
    assembler = numbered()
    feed(assembler, halves(39))
    for k in (40, 80):
        tell(assembler, k, k - 2)
    assert [s.j for s in feed(assembler, halves(81))] == [79]
    assert assembler.lost == ""


def test_without_numbers_of_the_plant_a_forgotten_number_goes_on_from_the_last():
    assembler = SampleAssembler(MODEL)
    came = []
    for k in range(400):
        if k == 200:
            assembler.forget_number()
        came += [(k, s.j) for s in feed(assembler, halves(k, T0 + 30 * MS * (k >= 200)), now_ns=k * TS)]
    wait = NUMBER_WAIT_NS // TS
    assert [k for k, _ in came] == [*range(wait, 200), *range(200 + wait, 400)]
    assert [j for _, j in came] == [k for k, _ in came]
    assert assembler.lost == ""


# clocks


def test_milliseconds_wrap_after_49_days_in_mid_flight():
    t0_ns = U32_MS - 10 * TS
    assembler = numbered(0, t0_ns)
    samples = feed(assembler, [m for k in range(40) for m in halves(k, t0_ns)])
    assert [s.j for s in samples] == list(range(40))
    assert [s.t_ns for s in samples] == [t0_ns + k * TS + 137_000 for k in range(40)]


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
@pytest.mark.parametrize("up_for_ns", [U32_MS - 10 * TS, U32_MS, 5 * U32_MS + 3 * S])
def test_without_the_plants_time_angle_of_attack_tells_how_often_milliseconds_have_wrapped(up_for_ns, order):
    assembler = SampleAssembler(MODEL)
    assembler.number(0, halves(0, up_for_ns)[0].time_boot_ms)
    samples = feed(assembler, [halves(k, up_for_ns)[half] for k in range(40) for half in order])
    assert [s.j for s in samples] == list(range(40))
    assert [s.t_ns for s in samples] == [up_for_ns + k * TS + 137_000 for k in range(40)]
    assert not assembler.drops


def test_once_the_plants_time_is_known_stamps_of_attitude_alone_go_on_from_it():
    assembler = SampleAssembler(load_model("pendulum"))
    t0_ns, step_ns = 2 * U32_MS - 300 * MS, 30 * MS
    stamps = [t0_ns + k * step_ns for k in range(30)]
    assembler.number(0, t0_ns // MS % (1 << 32))
    samples = [
        assembler.add(Attitude(t_ns // MS % (1 << 32), *(6 * [0.0])), 0, t_ns if k >= 20 else None)
        for k, t_ns in enumerate(stamps)
    ]
    assert [s.j for s in samples] == list(range(30))
    assert [s.t_ns for s in samples] == [t_ns - U32_MS * (k < 20) for k, t_ns in enumerate(stamps)]
    assert assembler.command_of(stamps[-1] // MS % (1 << 32), 2) == 27
    assert not assembler.drops


def test_a_sample_that_waits_for_its_number_is_moved_to_the_plants_time_with_it():
    assembler = SampleAssembler(load_model("pendulum"))
    t_ns = U32_MS + 7 * S
    assert assembler.add(Attitude(7000, *(6 * [0.0])), 0) is None
    sample = assembler.number(5, 7000, t_ns)
    assert (sample.j, sample.t_ns, assembler.newest_ns) == (5, t_ns, t_ns)


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("up_for_ns", [U32_US - 10 * TS, U32_US, 7 * U32_US + 3 * S, 3 * U32_MS - 10 * TS])
def test_an_angle_of_attack_stamped_by_a_u32_counter_wraps_after_71_minutes(up_for_ns, known):
    assembler = SampleAssembler(MODEL)
    near_ns = up_for_ns if known else None
    assembler.number(0, halves(0, up_for_ns)[0].time_boot_ms, near_ns)
    samples = []
    for k in range(40):
        attitude, air = halves(k, up_for_ns)
        for message in (attitude, air._replace(time_usec=air.time_usec % (1 << 32))):
            samples.append(assembler.add(message, 0, near_ns and near_ns + (k + 1) * TS))
    stamps = [s.t_ns for s in samples if s is not None]
    assert [s.j for s in samples if s is not None] == list(range(40))
    if known or up_for_ns < U32_MS:
        assert stamps == [up_for_ns + k * TS + 137_000 for k in range(40)]
    assert not assembler.drops


def test_such_a_vehicle_is_found_again_after_a_blackout_across_the_wrap():
    t0_ns = U32_US - 10 * TS
    assembler = numbered(0, t0_ns)
    stream = [m for k in (*range(5), *range(900, 910)) for m in halves(k, t0_ns)]
    stream = [m._replace(time_usec=m.time_usec % (1 << 32)) if isinstance(m, AoaSsa) else m for m in stream]
    assert [s.j for s in feed(assembler, stream)] == [*range(5), *range(900, 910)]


@pytest.mark.parametrize("back_ms", [1, 900, 10_000])
def test_no_stamp_is_before_the_plants_clock_began(back_ms):
    for message in (Attitude((1 << 32) - back_ms, *(6 * [0.0])), AoaSsa((1 << 32) - 1000 * back_ms, 0.0, 0.0)):
        assembler = SampleAssembler(MODEL)
        assert assembler.add(message, 0, 500 * MS) is None
        assert assembler.drops == {Drop.FROM_THE_FUTURE: 1}


def test_a_stamp_from_the_future_is_refused_and_the_present_goes_on():
    assembler = numbered()
    feed(assembler, halves(0))
    latest_ns = T0 + 2 * TS
    for message in halves(10_000):
        assert assembler.add(message, 0, latest_ns) is None
    assert assembler.drops == {Drop.FROM_THE_FUTURE: 2}
    assert [s.j for s in (assembler.add(m, 0, latest_ns) for m in halves(1)) if s] == [1]


def test_more_than_a_second_back_is_a_jump_and_less_is_lateness():
    back = JUMP_BACK_NS // TS
    assembler = numbered()
    feed(assembler, halves(100))
    feed(assembler, halves(100 - back)[1:])
    assert (assembler.jumped_back, assembler.drops) == (False, {Drop.LATE: 1})
    feed(assembler, halves(99 - back)[1:])
    assert (assembler.jumped_back, assembler.drops) == (True, {Drop.LATE: 1, Drop.JUMPED_BACK: 1})
    feed(assembler, halves(101))
    assert not assembler.jumped_back


def test_a_new_epoch_starts_from_nothing_and_keeps_its_counters():
    assembler = numbered()
    feed(assembler, halves(400))
    feed(assembler, halves(0))
    assembler.restart()
    assert not assembler.jumped_back
    assert assembler.newest_ns is None
    assert assembler.number(2, halves(2)[0].time_boot_ms) is None
    samples = feed(assembler, [m for k in range(5) for m in halves(k)])
    assert [s.j for s in samples] == list(range(5))
    assert assembler.drops == {Drop.JUMPED_BACK: 2}


@pytest.mark.parametrize("time_usec", [MAX_STAMP_NS // 1000 + 1, (1 << 63) - 1, (1 << 64) - 1])
@pytest.mark.parametrize("peer_ns", [None, T0, (1 << 63) - 1])
def test_a_stamp_that_no_clock_shows_is_refused(time_usec, peer_ns):
    assembler = SampleAssembler(MODEL)
    assert assembler.add(AoaSsa(time_usec, 0.0, 0.0), 0, peer_ns) is None
    assert assembler.drops == {Drop.FROM_THE_FUTURE: 1}
    assert assembler.newest_ns is None


# the way back


def ahead(days: float = 10.0) -> SampleAssembler:
    """Return an assembler whose newest sample is stamped far ahead of the plant's time."""
    assembler = numbered()
    feed(assembler, halves(round(days * 86_400 * S) // TS))
    return assembler


def lost_at(assembler: SampleAssembler, stream, peer_ns: int | None = None) -> tuple[int, int] | None:
    """Feed (own time, message); return when the track was lost, and after how many messages."""
    for n, (now_ns, message) in enumerate(stream, 1):
        assembler.add(message, now_ns, peer_ns)
        if assembler.lost:
            return now_ns, n
    return None


@pytest.mark.parametrize("days", [0.001, 1.0, 10.0, 20.0])
def test_stamps_that_rise_with_time_but_are_older_than_the_newest_lose_the_track_after_a_second(days):
    stream = [(k * TS, m) for k in range(100) for m in halves(k)]
    assembler = ahead(days)
    came = lost_at(assembler, stream)
    assert came is not None
    assert came[0] == RESYNC_NS
    assert assembler.lost == "stamps fell back"
    assembler.restart()
    tell(assembler, 41)
    assert [s.j for s in feed(assembler, [m for k in range(41, 50) for m in halves(k)])] == list(range(41, 50))


def test_on_a_lossy_link_the_track_is_lost_after_so_many_measurements():
    stream = [(k * TS, halves(k)[1]) for k in range(0, 1000, 8)]
    assert lost_at(ahead(), stream) == ((RESYNC_MEASUREMENTS - 1) * 8 * TS, RESYNC_MEASUREMENTS)


def test_old_stamps_that_do_not_rise_with_time_are_no_lost_track():
    burst = [(0, m) for k in range(200) for m in halves(k)]  # all at once
    still = [(k * TS, halves(0)[1]) for k in range(1000)]  # one, again and again
    seldom = [(k * TS, halves(k)[1]) for k in range(0, 4000, 85)]
    for stream in (burst, still, seldom):
        assert lost_at(ahead(), stream) is None


def test_stamps_after_the_plants_time_are_no_lost_track():
    stream = [(k * TS, m) for k in range(1000) for m in halves(400 + k)]
    assert lost_at(ahead(), stream, T0 - S) is None


def test_old_copies_between_samples_that_come_are_no_lost_track():
    stream = []
    for k in range(100, 1000):
        stream += [(k * TS, m) for old in (90, 50, 20) for m in halves(k - old)]
        if k % 30 == 0:
            stream += [(k * TS, m) for m in halves(k)]
    assert lost_at(numbered(), stream) is None


def test_halves_from_far_ahead_starve_no_sample():
    assembler = numbered()
    feed(assembler, [halves(10**6 + k)[1] for k in range(MAX_PENDING)])
    assert [s.j for s in feed(assembler, [m for k in range(20) for m in halves(k)])] == list(range(20))


def test_a_sample_stamped_turns_ahead_before_the_clock_is_known_does_not_keep_its_number():
    assembler = SampleAssembler(load_model("pendulum"))
    t0_ms, turn = T0 // MS, 1 << 32
    assembler.number(0, t0_ms)
    for ms in (t0_ms, t0_ms + turn // 3, t0_ms + 2 * (turn // 3), t0_ms + 30):
        assert assembler.add(Attitude(ms % turn, *(6 * [0.0])), 0) is not None
    assert assembler.add(Attitude(t0_ms + 60, *(6 * [0.0])), 0, T0 + 60 * MS) is None
    assert assembler.lost == "sample numbers fell back"


def test_a_model_that_needs_attitude_alone_is_whole_with_it():
    assembler = SampleAssembler(load_model("pendulum"))
    assembler.number(0, T0 // MS)
    samples = feed(assembler, [Attitude(T0 // MS + 30 * k, 0.0, 0.1, 0.0, 0.0, 0.2, 0.0) for k in range(5)])
    assert [s.j for s in samples] == list(range(5))
    assert samples[0].x == (0.1, 0.2)
    assert (assembler.needed, numbered().needed) == ({Attitude}, {Attitude, AoaSsa})
