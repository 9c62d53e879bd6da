"""What happens to a link in time: exact schedules against a link simulated tick by tick, chance against its law."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import linalg, stats

from sitl.link.impairment import MAX_PAUSES, Copy, Fate, Impairment, LinkSpec
from sitl.link.interruptions import EPOCH_CYCLES, MIN_MEAN_NS, Fading, Handover, Slots, Window
from tests.sitl.links import MS, S, impairment

# ------------------------------------------------------------------------------------------------- windows


@pytest.mark.parametrize("window", [Window(3, 2), Window(3, 2, 5), Window(0, 4, 7), Window(10, 0), Window(2, 1, 2)])
def test_a_window_covers_its_instants_and_no_others(window):
    repeats = range(100) if window.every_ns else range(1)
    starts = [window.start_ns + n * window.every_ns for n in repeats]
    for t in range(-5, 60):
        ends = [start + window.length_ns for start in starts if start <= t < start + window.length_ns]
        assert window.end_ns(t) == (ends[0] if ends else None)


def test_a_repeated_blackout_drops_the_same_stretch_of_every_period():
    link = impairment("blackout=3s:2s:10s")
    out = [t for t in range(40) if link.step(60, t * S)[0].fate is Fate.BLACKOUT]
    assert out == [3, 4, 13, 14, 23, 24, 33, 34]


def test_a_repeated_blackout_drops_what_would_leave_during_it():
    link = impairment("delay=1s,blackout=3s:2s:10s")
    out = [t for t in range(20) if link.step(60, t * S)[0].fate is Fate.BLACKOUT]
    assert out == [2, 3, 4, 12, 13, 14]


def test_what_waits_for_a_hold_leaves_at_its_end():
    link = impairment("delay=5ms,hold=1s:100ms:1s")
    entries = [0, S - 1, S, S + 50 * MS, S + 100 * MS - 1, S + 100 * MS, 2 * S + 1]
    begins = [0, S - 1, S + 100 * MS, S + 100 * MS, S + 100 * MS, S + 100 * MS, 2 * S + 100 * MS]
    assert [link.schedule(60, t)[0] for t in entries] == [t + 5 * MS for t in begins]


def test_a_packet_on_the_air_when_a_hold_begins_goes_on():
    link = impairment("rate=80kbps,hold=2ms:10ms")
    assert [link.schedule(50, 0)[0] for _ in range(3)] == [5 * MS, 17 * MS, 22 * MS]


def test_where_pauses_leave_no_time_packets_are_refused_and_the_link_is_not_stuck():
    holds = (Window(0, 3, 4), Window(2, 3, 4))
    link = Impairment(LinkSpec(holds=holds), np.random.default_rng(0))
    assert link.step(60, 0) == (Copy(Fate.REFUSED, 0),)
    assert link.step(60, 10 * MAX_PAUSES) == (Copy(Fate.REFUSED, 10 * MAX_PAUSES),)


# ----------------------------------------------------------------------------------- a link tick by tick


@dataclass
class TickedLink:
    """A link of 1 byte per ns at most, simulated ns by ns: who waits, who is on the air, what the slot still takes."""

    holds: tuple[Window, ...]
    slots: Slots | None
    has_rate: bool

    def exits(self, packets: list[tuple[int, int]], horizon: int) -> list[int | None]:
        """Return when each packet (when it enters, its size) has been sent."""
        exits: list[int | None] = []
        busy_until, admitted, budget = 0, 0, 0
        for t in range(horizon):
            if len(exits) == len(packets):
                break
            held = any(self._covers(window, t) for window in self.holds)
            if self.slots is not None and t % self.slots.period_ns == 0 and t >= busy_until:
                admitted = sum(entered <= t for entered, _ in packets)
                budget = self.slots.packets or len(packets)
            while t >= busy_until and len(exits) < len(packets) and packets[len(exits)][0] <= t:
                if held:
                    budget = 0  # its turn in the slot is over
                    break
                if self.slots is not None:
                    if len(exits) >= admitted or not budget:
                        break
                    budget -= 1
                busy_until = t + (packets[len(exits)][1] if self.has_rate else 0)
                exits.append(busy_until)
            if self.slots is not None and t >= busy_until and len(exits) >= admitted:
                budget = 0  # nobody follows directly
        return exits + [None] * (len(packets) - len(exits))

    @staticmethod
    def _covers(window: Window, t: int) -> bool:
        while window.every_ns and t >= window.start_ns + window.every_ns:
            t -= window.every_ns
        return window.start_ns <= t < window.start_ns + window.length_ns


holds = st.lists(
    st.builds(Window, st.integers(0, 60), st.integers(0, 12), st.just(0))
    | st.builds(Window, st.integers(0, 60), st.integers(0, 12), st.sampled_from([24, 48])),
    max_size=3,
).map(tuple)


@settings(deadline=None, max_examples=200)
@given(
    holds=holds,
    slots=st.none() | st.builds(Slots, st.sampled_from([1, 4, 6, 16]), st.integers(0, 3)),
    has_rate=st.booleans(),
    packets=st.lists(st.tuples(st.integers(0, 12), st.integers(0, 9)), min_size=1, max_size=12),
)
def test_holds_slots_and_rate_send_as_a_link_simulated_tick_by_tick(holds, slots, has_rate, packets):
    entries = np.cumsum([gap for gap, _ in packets]).tolist()
    timed = [(entered, size) for entered, (_, size) in zip(entries, packets, strict=True)]
    spec = LinkSpec(holds=holds, slots=slots, rate_bps=8 * S if has_rate else None)
    link = Impairment(spec, np.random.default_rng(0))
    found = [(link.schedule(size, entered) or (None,))[0] for entered, size in timed]
    assert found == TickedLink(holds, slots, has_rate).exits(timed, 600)


def test_as_many_packets_as_a_slot_takes_leave_in_it_and_the_rest_in_the_next():
    link = impairment("slot=20ms:4")
    assert [link.schedule(60, 1)[0] // MS for _ in range(10)] == [20] * 4 + [40] * 4 + [60] * 2
    assert link.schedule(60, 60 * MS) == (60 * MS,)  # there is room left
    assert link.schedule(60, 60 * MS + 1) == (80 * MS,)


def test_packets_of_one_slot_follow_each_other_at_the_rate():
    link = impairment("slot=20ms:3,rate=480kbps")
    assert [link.schedule(60, 1)[0] / MS for _ in range(5)] == [21, 22, 23, 41, 42]


def test_a_slot_that_is_full_stays_full_when_the_link_changes():
    spec = LinkSpec(slots=Slots(20 * MS, 2))
    link = Impairment(spec, np.random.default_rng(0))
    assert [link.schedule(60, 1)[0] for _ in range(2)] == [20 * MS] * 2
    changed = Impairment(LinkSpec(delay_ns=MS, slots=spec.slots), np.random.default_rng(0), link)
    assert changed.schedule(60, 2) == (41 * MS,)


@settings(max_examples=50)
@given(st.lists(st.tuples(st.integers(0, 3 * MS), st.integers(0, 400)), max_size=80), st.integers(1, 12))
def test_the_limit_refuses_what_finds_as_many_under_way_also_behind_slots_and_holds(packets, limit):
    timing = "rate=1Mbps,slot=10ms:3,hold=7ms:4ms:30ms,delay=5ms"
    link, free, under_way = impairment(f"{timing},limit={limit}"), impairment(timing), []
    now_ns = 0
    for gap, size in packets:
        now_ns += gap
        under_way = [t for t in under_way if t > now_ns]
        (copy,) = link.step(size, now_ns, len(under_way))
        assert (copy.fate is Fate.REFUSED) == (len(under_way) >= limit)
        if copy.fate is Fate.DELIVERED:  # as if what was refused had never been
            assert (copy.exit_ns,) == free.schedule(size, now_ns)
            under_way.append(copy.exit_ns)
        assert len(under_way) <= limit


# ------------------------------------------------------------------------------------------------- fading


GOOD, BAD = 1000 * MS, 400 * MS
STEP = MS
INSTANTS = 2_000_000


@functools.cache
def radio() -> np.ndarray:
    """Return whether the radio is bad, once per ms."""
    bad_at = Fading(GOOD, BAD, MS).process(np.random.default_rng(4))
    return np.fromiter(map(bad_at, range(0, INSTANTS * STEP, STEP)), bool, INSTANTS)


def moved(lag_ns: float) -> np.ndarray:
    """Return the transition probabilities over a time, by the exponential of the generator of (good, bad)."""
    return linalg.expm(np.array([[-1 / GOOD, 1 / GOOD], [1 / BAD, -1 / BAD]]) * lag_ns)


def test_the_share_of_bad_time_is_that_of_the_chain():
    share, relaxation_ns = BAD / (GOOD + BAD), 1.0 / (1 / GOOD + 1 / BAD)
    sigma = math.sqrt(share * (1 - share) * 2 * relaxation_ns / (INSTANTS * STEP))
    assert radio().mean() == pytest.approx(share, abs=3.3 * sigma)


def test_good_and_bad_times_are_exponential_and_the_first_is_good():
    bad = radio()
    assert not bad[0]
    changes = np.flatnonzero(np.diff(bad.astype(int))) * STEP
    dwells = np.diff(changes)  # to a ms, which the distribution of 1000 of them does not show
    for mean_ns, first in ((BAD, 0), (GOOD, 1)):
        assert len(dwells[first::2]) > 1000
        assert stats.kstest(dwells[first::2], stats.expon(scale=mean_ns).cdf).pvalue > 1e-3
    pairs = len(dwells) // 2
    assert abs(stats.spearmanr(dwells[: 2 * pairs : 2], dwells[1 : 2 * pairs : 2]).statistic) < 4 / math.sqrt(pairs)


@pytest.mark.parametrize("lag_ms", [10, 100, 300, 1000])
def test_being_bad_correlates_as_the_chain_in_continuous_time(lag_ms):
    bad = radio().astype(float)
    share, between = BAD / (GOOD + BAD), bad[lag_ms:]
    stays = float(moved(lag_ms * MS)[1, 1])
    expected = (share * stays - share**2) / (share - share**2)
    assert expected == pytest.approx(math.exp(-(1 / GOOD + 1 / BAD) * lag_ms * MS))
    products = (bad[:-lag_ms] - share) * (between - share) / (share - share**2)
    blocks = products[: len(products) // 20_000 * 20_000].reshape(-1, 20_000).mean(axis=1)
    assert products.mean() == pytest.approx(expected, abs=4 * blocks.std() / math.sqrt(len(blocks)))


def test_a_bad_radio_delays_and_loses_and_a_good_one_does_neither():
    delayed = impairment("delay=5ms,fade=200ms:100ms:80ms")
    losing = impairment("delay=5ms,fade=200ms:100ms:80ms:0.3")
    flights = [delayed.schedule(60, n * MS)[0] - n * MS for n in range(20_000)]
    assert set(flights) == {5 * MS, 85 * MS}
    fates = [losing.step(60, n * MS)[0] for n in range(20_000)]
    lost = [copy.fate is Fate.LOST for copy in fates]
    bad = [flight == 85 * MS for flight in flights]
    assert not any(is_lost and not is_bad for is_lost, is_bad in zip(lost, bad, strict=True))
    assert stats.binomtest(sum(lost), sum(bad), 0.3).pvalue > 1e-3
    assert all(
        copy.exit_ns - n * MS == flight
        for n, (copy, flight, gone) in enumerate(zip(fates, flights, lost, strict=True))
        if not gone
    )


def test_the_radio_is_bad_at_the_same_times_whatever_the_packets():
    dense, sparse = (Fading(GOOD, BAD, 0).process(np.random.default_rng(9)) for _ in range(2))
    often = {t: dense(t) for t in range(0, 100 * S, 10 * MS)}
    assert all(sparse(t) == often[t] for t in range(0, 100 * S, 730 * MS))


# ----------------------------------------------------------------------------------------------- handover

EVERY, LENGTH = 1000 * MS, 50 * MS


@functools.cache
def ends(instants: int = 200_000, step_ns: int = 10 * MS) -> np.ndarray:
    """Return when interruptions end, exactly: none is shorter than a step."""
    resume_ns = Handover(EVERY, LENGTH).process(np.random.default_rng(6))
    return np.unique([end for t in range(0, instants * step_ns, step_ns) if (end := resume_ns(t)) != t])


def test_times_between_handovers_are_exponential_and_independent():
    gaps = np.diff(ends()) - LENGTH
    assert len(gaps) > 1500
    assert stats.kstest(gaps, stats.expon(scale=EVERY).cdf).pvalue > 1e-3
    assert abs(stats.spearmanr(gaps[:-1], gaps[1:]).statistic) < 4 / math.sqrt(len(gaps))


def test_the_first_handover_comes_after_an_exponential_time_too():
    def first_end(seed: int) -> int:
        resume_ns = Handover(EVERY, LENGTH).process(np.random.default_rng(seed))
        return next(end for t in range(0, 100 * EVERY, LENGTH) if (end := resume_ns(t)) != t)

    starts = [first_end(seed) - LENGTH for seed in range(500)]
    assert stats.kstest(starts, stats.expon(scale=EVERY).cdf).pvalue > 1e-3


def test_nobody_is_sent_during_a_handover_and_what_waited_follows_at_once_and_in_order():
    link = impairment("handover=1s:50ms")
    entries = list(range(0, 100 * S, MS))
    exits = [link.schedule(60, entry)[0] for entry in entries]
    assert exits == sorted(exits)
    waited = [(entry, left) for entry, left in zip(entries, exits, strict=True) if left != entry]
    bursts: dict[int, list[int]] = {}
    for entry, left in waited:
        bursts.setdefault(left, []).append(entry)
    assert len(bursts) > 60
    for left, members in bursts.items():
        # all who came during it, and nobody else, left at its end
        assert members == list(range(-(-(left - LENGTH) // MS) * MS, left, MS))
    inside = np.searchsorted(sorted(bursts), exits, side="right")
    following = np.append(sorted(bursts), np.iinfo(np.int64).max)[inside]
    assert (np.array(exits) < following - LENGTH).all()


def test_after_a_handover_what_waited_is_sent_at_the_rate():
    link = impairment("handover=1s:50ms,rate=480kbps", seed=3)
    exits = np.array([link.schedule(60, n * 5 * MS)[0] for n in range(2000)])
    free = [exit_ns for n, exit_ns in enumerate(exits) if exit_ns == n * 5 * MS + MS]
    assert 1000 < len(free) < 1990
    assert np.diff(exits).min() == MS


@pytest.mark.parametrize("length_ns", [0, LENGTH])
def test_handovers_that_come_as_fast_as_allowed_are_followed_over_an_idle_minute(length_ns):
    resume_ns = Handover(MIN_MEAN_NS, length_ns).process(np.random.default_rng(0))
    assert resume_ns(60 * S) >= 60 * S


def test_interruptions_at_shorter_means_than_the_least_are_refused():
    for make in (
        lambda: Handover(MIN_MEAN_NS - 1, 0),
        lambda: Fading(MIN_MEAN_NS - 1, S, 0),
        lambda: Fading(S, MIN_MEAN_NS - 1, 0),
    ):
        with pytest.raises(AssertionError):
            make()


PROCESSES = pytest.mark.parametrize(
    ("process", "first_ns", "second_ns"),
    [(Handover(2 * MS, 1 * MS), 2 * MS, 1 * MS), (Fading(2 * MS, 3 * MS, 0), 2 * MS, 3 * MS)],
    ids=["handover", "fading"],
)


@PROCESSES
def test_what_happens_in_time_is_the_same_whoever_looks_and_however_far_ahead(process, first_ns, second_ns):
    epoch_ns = EPOCH_CYCLES * (first_ns + second_ns)
    rng = np.random.default_rng(5)
    instants = sorted({*rng.integers(0, 4 * epoch_ns, 2000).tolist(), 3 * epoch_ns, 10**6 * S})
    often, rarely = (process.process(np.random.default_rng(1)) for _ in range(2))
    seen = {at_ns: often(at_ns) for at_ns in instants}  # the last one is hundreds of millions of interruptions away
    assert {at_ns: rarely(at_ns) for at_ns in instants[::7]} == {at_ns: seen[at_ns] for at_ns in instants[::7]}
    assert len(set(seen.values())) > 1


@PROCESSES
def test_an_epoch_begins_within_an_interruption_as_often_as_these_take_their_share_of_the_time(
    process, first_ns, second_ns
):
    instants = [n * EPOCH_CYCLES * (first_ns + second_ns) for n in range(1, 2001)]
    look = process.process(np.random.default_rng(1))
    inside = [look(at_ns) not in (at_ns, False) for at_ns in instants]
    share = second_ns / (first_ns + second_ns)
    assert abs(np.mean(inside) - share) < 4 * np.sqrt(share * (1 - share) / len(instants))
