"""Impairment against scipy's distributions, queueing theory, netem's rules, and exact schedules."""

from __future__ import annotations

import itertools
import math
from collections import deque

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from sitl.link.impairment import Copy, Fate, Impairment, LinkSpec
from sitl.link.interruptions import Window
from sitl.link.jitters import NormalJitter
from sitl.link.spec import parse_spec
from sitl.link.traces import Trace
from tests.sitl.links import MS, SAMPLES, S, flights_ns, impairment


def accepts(successes: int, trials: int, probability: float) -> bool:
    return stats.binomtest(successes, trials, probability).pvalue > 1e-3


def is_sorted(instants: list[int]) -> bool:
    return all(a <= b for a, b in itertools.pairwise(instants))


# ---------------------------------------------------------------------------------------- distributions


@pytest.mark.parametrize(
    ("spec", "distribution"),
    [
        ("delay=5ms,jitter=uniform:28ms", stats.uniform(loc=5 * MS, scale=28 * MS)),
        ("delay=50ms,jitter=normal:4ms", stats.norm(loc=50 * MS, scale=4 * MS)),
        ("delay=5ms,jitter=gamma:20ms", stats.gamma(a=2, loc=5 * MS, scale=10 * MS)),
    ],
)
def test_jitter_follows_its_distribution(spec, distribution):
    assert stats.kstest(flights_ns(spec), distribution.cdf).pvalue > 1e-3


def test_uniform_jitter_stays_within_its_width():
    samples = flights_ns("delay=5ms,jitter=uniform:28ms")
    assert samples.min() >= 5 * MS
    assert samples.max() <= 33 * MS


def test_normal_jitter_never_makes_the_total_negative():
    samples = flights_ns("delay=1ms,jitter=normal:2ms")
    assert samples.min() == 0
    clamped = int((samples == 0).sum())
    assert accepts(clamped, SAMPLES, float(stats.norm.cdf(-0.5)))
    truth = stats.norm(loc=1 * MS, scale=2 * MS)
    flown = samples[samples > 0]
    assert stats.kstest(flown, lambda t: (truth.cdf(t) - truth.cdf(0)) / truth.sf(0)).pvalue > 1e-3


@pytest.mark.parametrize("probability", [0.01, 0.1, 0.5])
def test_loss_rate_is_the_probability_given(probability):
    links = [impairment(f"loss={probability}", seed) for seed in range(20)]
    lost = sum(not link.schedule(100, n) for link in links for n in range(SAMPLES // 20))
    assert accepts(lost, SAMPLES, probability)


def test_losses_come_without_memory():
    link = impairment("loss=0.3")
    lost = np.array([not link.schedule(100, n) for n in range(SAMPLES)], dtype=float)
    assert abs(np.corrcoef(lost[:-1], lost[1:])[0, 1]) < 4 / math.sqrt(SAMPLES)


def test_certain_loss_loses_all_and_no_loss_loses_none():
    certain, none = impairment("loss=1"), impairment("loss=0")
    assert all(certain.step(100, n) == (Copy(Fate.LOST, n),) for n in range(100))
    assert all(none.schedule(100, n) == (n,) for n in range(100))


def test_duplicate_rate_is_the_probability_given_and_copies_draw_their_own_delay():
    links = [impairment("jitter=uniform:28ms,dup=0.5", seed) for seed in range(20)]
    schedules = [link.schedule(100, n * S) for link in links for n in range(SAMPLES // 20)]
    pairs = np.array([s for s in schedules if len(s) == 2], dtype=float) % S
    assert {len(s) for s in schedules} == {1, 2}
    assert accepts(len(pairs), SAMPLES, 0.5)
    assert abs(np.corrcoef(pairs.T)[0, 1]) < 4 / math.sqrt(len(pairs))
    assert stats.kstest(pairs[:, 1], stats.uniform(scale=28 * MS).cdf).pvalue > 1e-3


def test_reordered_packets_skip_the_delay_and_the_rest_keep_it():
    link = impairment("delay=50ms,reorder=0.05")
    flights = [link.schedule(100, n * MS)[0] - n * MS for n in range(SAMPLES)]
    assert set(flights) == {0, 50 * MS}
    assert accepts(flights.count(0), SAMPLES, 0.05)


def test_plain_loss_compares_one_value_a_packet_of_the_first_stream_with_its_probability():
    link = impairment("loss=0.1,dup=0.1,jitter=normal:1ms", seed=3)
    values = np.random.default_rng(3).spawn(6)[0].random(1000)
    assert [link.step(100, n)[0].fate is Fate.LOST for n in range(1000)] == (values < 0.1).tolist()


# ------------------------------------------------------------------------------------------------- rate


@given(
    sizes=st.lists(st.integers(0, 1500), min_size=1, max_size=50),
    rate_bps=st.integers(1, 10**9),
    delay_ns=st.integers(0, S),
    holds=st.sampled_from([(), (Window(10**18, S),)]),  # also where the link may pause, but does not
)
def test_back_to_back_packets_are_spaced_by_their_serialisation(sizes, rate_bps, delay_ns, holds):
    link = Impairment(LinkSpec(delay_ns=delay_ns, rate_bps=rate_bps, holds=holds), np.random.default_rng(0))
    exits = [link.schedule(size, 0)[0] - delay_ns for size in sizes]
    # exact: the n-th packet is through when all bits up to its last are, rounded up to a whole ns
    assert exits == [-(-8 * S * int(total) // rate_bps) for total in np.cumsum(sizes)]


def test_spacing_at_a_rate_that_divides_is_size_times_8_over_rate():
    link = impairment("rate=80kbps")
    exits = [link.schedule(50, 0)[0] for _ in range(5)]
    assert np.diff(exits).tolist() == [5 * MS] * 4


def test_an_idle_serialiser_does_not_delay_the_next_packet():
    link = impairment("rate=80kbps")
    assert link.schedule(50, 0) == (5 * MS,)
    assert link.schedule(50, 5 * MS) == (10 * MS,)
    assert link.schedule(50, S) == (S + 5 * MS,)


def test_a_reordered_packet_does_not_wait_for_the_serialiser():
    link = impairment("rate=80kbps,reorder=0.5")
    exits = {link.schedule(50, 0)[0] for _ in range(50)}
    assert exits == {0} | {n * 5 * MS for n in range(1, len(exits))}


@pytest.mark.parametrize("room", [0, 1])
def test_refused_copies_take_no_airtime(room):
    link = impairment("rate=80kbps,dup=1,limit=7")
    copies = [link.step(50, 0, 7 - room) for _ in range(100)]
    assert all([copy.fate for copy in pair].count(Fate.REFUSED) == 2 - room for pair in copies)
    assert link.schedule(50, 0)[0] == (room * 100 + 1) * 5 * MS


def poisson_ns(load: float, service_ns: int, packets: int, seed: int) -> list[int]:
    """Return when packets enter that come as a Poisson process."""
    gaps = np.random.default_rng(seed).exponential(service_ns / load, packets)
    return np.cumsum(gaps).astype(np.int64).tolist()


@pytest.mark.parametrize("load", [0.3, 0.7])
def test_the_mean_wait_at_a_rate_is_that_of_pollaczek_and_khinchine(load):
    service_ns = MS
    link = impairment("rate=800kbps")
    entries = poisson_ns(load, service_ns, 100_000, 3)
    waits = np.array([link.schedule(100, entry)[0] - entry - service_ns for entry in entries], dtype=float)
    expected = load * service_ns / (2.0 * (1.0 - load))  # M/D/1
    blocks = waits.reshape(-1, 1000).mean(axis=1)
    assert waits.mean() == pytest.approx(expected, abs=4.0 * blocks.std() / math.sqrt(len(blocks)))
    assert np.mean(waits == 0.0) == pytest.approx(1.0 - load, abs=0.02)


def refusals(load: float, limit: int, packets: int = 30_000) -> tuple[list[bool], list[bool]]:
    """Return which packets a limited link refuses, and which a queue refuses that counts who is in the system."""
    service_ns = MS
    link = impairment(f"rate=800kbps,limit={limit}")
    refused, expected, under_way, system = [], [], [], deque[int]()
    for entry in poisson_ns(load, service_ns, packets, 4):
        under_way = [exit_ns for exit_ns in under_way if exit_ns > entry]
        copy = link.step(100, entry, len(under_way))[0]
        refused.append(copy.fate is Fate.REFUSED)
        if copy.fate is Fate.DELIVERED:
            under_way.append(copy.exit_ns)
        while system and system[0] <= entry:
            system.popleft()
        expected.append(len(system) >= limit)
        if not expected[-1]:
            system.append(max(system[-1] if system else 0, entry) + service_ns)
    return refused, expected


@pytest.mark.parametrize(("load", "limit"), [(0.7, 2), (0.95, 5), (3.0, 60)])
def test_the_limit_refuses_what_finds_the_queue_full(load, limit):
    refused, expected = refusals(load, limit)
    assert refused == expected
    assert sum(refused) > 100


def test_a_link_that_holds_one_packet_refuses_as_erlang_says():
    refused, _ = refusals(0.7, 1)
    assert accepts(sum(refused), len(refused), 0.7 / 1.7)


# ------------------------------------------------------------------------------------------------- delay


def test_delay_jitter_and_trace_are_below_0_only_together():
    trace = Trace("", (10 * MS,))
    samples = np.array(
        [
            Impairment(LinkSpec(jitter=NormalJitter(20 * MS), trace=trace), np.random.default_rng(seed)).schedule(60, 0)
            for seed in range(2000)
        ],
        dtype=float,
    )
    assert accepts(int((samples == 0.0).sum()), len(samples), float(stats.norm.cdf(-0.5)))


def test_a_trace_without_times_gives_each_packet_the_next_entry_lost_or_not_and_begins_anew():
    trace = Trace("", (5 * MS, None, 7 * MS))
    link = Impairment(LinkSpec(delay_ns=MS, loss=0.5, trace=trace), np.random.default_rng(2))
    plain = impairment("loss=0.5", seed=2)
    for n in range(300):
        (copy,), entry = link.step(60, n * S), trace.delays_ns[n % 3]
        lost = plain.step(60, n * S)[0].fate is Fate.LOST
        assert copy == (Copy(Fate.LOST, n * S) if lost or entry is None else Copy("delivered", n * S + MS + entry))


def test_a_trace_with_times_gives_a_packet_the_last_entry_not_after_it_and_begins_anew():
    trace = Trace("", (1, None, 3), (0, 10, 25), 40)
    link = Impairment(LinkSpec(trace=trace), np.random.default_rng(0))
    expected = ([1] * 10 + [None] * 15 + [3] * 15) * 3
    assert [(link.schedule(60, t) or (None,))[0] for t in range(120)] == [
        None if delay is None else t + delay for t, delay in enumerate(expected)
    ]


# ------------------------------------------------------------------------------------------ reordering


def overtaken(values: np.ndarray, probability: float, gap: int) -> list[bool]:
    """Return which packets overtake by the rule of ``netem_enqueue``, given the random number of each."""
    counter, out = 0, []
    for value in values:
        queue_it = counter < gap - 1 or value >= probability
        counter = counter + 1 if queue_it else 0
        out.append(not queue_it)
    return out


@pytest.mark.parametrize("probability", [0.0, 0.2, 0.9, 1.0])
@pytest.mark.parametrize("gap", [1, 2, 5, 100])
def test_reordering_with_a_gap_follows_the_rule_of_netem(probability, gap):
    link = impairment(f"delay=50ms,reorder={probability},gap={gap}", seed=8)
    values = np.random.default_rng(8).spawn(6)[2].random(3000)
    found = [link.schedule(60, n * MS)[0] == n * MS for n in range(3000)]
    assert found == overtaken(values, probability, gap)


def test_packets_between_two_that_overtake_are_the_gap_and_a_geometric_number_more():
    link = impairment("delay=50ms,reorder=0.3,gap=4")
    places = np.flatnonzero([link.schedule(60, n * MS)[0] == n * MS for n in range(40_000)])
    beyond = np.diff(places) - 3
    found = np.bincount(np.minimum(beyond, 10))[1:]
    assert beyond.min() == 1
    expected = len(beyond) * np.append(stats.geom.pmf(np.arange(1, 10), 0.3), stats.geom.sf(9, 0.3))
    assert stats.chisquare(found, expected).pvalue > 1e-3


def test_a_copy_that_is_refused_does_not_count_for_the_gap():
    link = impairment("delay=50ms,reorder=1,gap=3,limit=1")
    assert [link.step(60, 0)[0].exit_ns for _ in range(2)] == [50 * MS] * 2
    assert link.step(60, 0, 1)[0].fate is Fate.REFUSED
    assert [link.step(60, 0)[0].exit_ns for _ in range(2)] == [0, 50 * MS]


# ------------------------------------------------------------------------------------------ corruption


def test_corruption_hits_as_often_as_asked_and_flips_bits_anywhere():
    link, size = impairment("corrupt=0.2:3"), 7
    flipped = [link.step(size, n)[0].flipped for n in range(50_000)]
    hits = [bits for bits in flipped if bits]
    assert accepts(len(hits), len(flipped), 0.2)
    assert {len(bits) for bits in hits} == {3}
    counts = np.bincount(np.ravel(hits), minlength=8 * size)
    assert len(counts) == 8 * size
    assert stats.chisquare(counts).pvalue > 1e-3


@pytest.mark.parametrize("size", [0, 1, 65_535])
def test_flipped_bits_are_bits_of_the_packet(size):
    link = impairment("corrupt=1:100")
    flipped = link.step(size, 0)[0].flipped
    assert len(flipped) == (100 if size else 0)
    assert all(0 <= bit < 8 * size for bit in flipped)


def test_the_two_copies_of_a_duplicate_are_hit_independently():
    link = impairment("dup=1,corrupt=0.5")
    hits = np.array([[bool(copy.flipped) for copy in link.step(10, n)] for n in range(20_000)], dtype=float)
    assert accepts(int(hits.sum()), hits.size, 0.5)
    assert abs(np.corrcoef(hits.T)[0, 1]) < 4.0 / math.sqrt(len(hits))


# ------------------------------------------------------------------------------------------------ order


@given(
    seed=st.integers(0, 2**32),
    gaps=st.lists(st.integers(0, 20 * MS), min_size=1, max_size=100),
    rest=st.sampled_from(["", ",reorder=0.3", ",dup=0.3,loss=0.2", ",rate=57600bps,reorder=0.1"]),
)
def test_order_keep_never_reorders(seed, gaps, rest):
    link = impairment("delay=5ms,jitter=uniform:28ms,order=keep" + rest, seed)
    entries = np.cumsum(gaps).tolist()
    exits = [instant for entry in entries for instant in link.schedule(60, entry)]
    assert is_sorted(exits)


def test_without_order_keep_jitter_reorders():
    link = impairment("delay=5ms,jitter=uniform:28ms")
    assert not is_sorted([link.schedule(60, n * MS)[0] for n in range(100)])


@given(
    seed=st.integers(0, 2**32),
    text=st.sampled_from(["delay=5ms,jitter=gamma:20ms", "jitter=normal:9ms,rate=57600bps,dup=0.5,reorder=0.2"]),
    entries=st.lists(st.integers(0, 100 * MS), max_size=60).map(sorted),
)
def test_no_packet_leaves_before_it_enters(seed, text, entries):
    link = impairment(text, seed)
    assert all(instant >= entry for entry in entries for instant in link.schedule(60, entry))


# -------------------------------------------------------------------------------------------- blackouts


def test_a_blackout_takes_no_packet_from_its_start_to_just_before_its_end():
    link = impairment("blackout=3s:2s,blackout=8s:1s")
    fates = {t: link.step(60, t)[0].fate for t in (0, 3 * S - 1, 3 * S, 5 * S - 1, 5 * S, 8 * S, 9 * S)}
    out = {t for t, fate in fates.items() if fate is Fate.BLACKOUT}
    assert out == {3 * S, 5 * S - 1, 8 * S}


def test_a_blackout_drops_what_would_leave_during_it():
    link = impairment("delay=100ms,blackout=1s:1s")
    instants = [9 * S // 10 - 1, 9 * S // 10, 2 * S - 1, 2 * S]
    copies = [link.step(60, t)[0] for t in instants]
    assert [copy.fate for copy in copies] == ["delivered", "blackout", "blackout", "delivered"]
    assert copies[1].exit_ns == S  # in flight until it would have left
    assert copies[2].exit_ns == 2 * S - 1  # never taken
    assert link.schedule(60, 2 * S) == (2 * S + 100 * MS,)


# ---------------------------------------------------------------------------------------------- changes


def test_after_a_change_packets_wait_for_what_the_serialiser_still_sends():
    before = impairment("rate=80kbps")
    assert before.schedule(50, 0) == (5 * MS,)
    assert Impairment(LinkSpec(rate_bps=800_000), np.random.default_rng(0), before).schedule(50, 0) == (5500_000,)
    assert Impairment(LinkSpec(), np.random.default_rng(0), before).schedule(50, 0) == (0,)  # nothing to wait for


@pytest.mark.parametrize("order", ["", ",order=keep"])
def test_after_a_change_to_order_keep_no_packet_leaves_before_those_of_before(order):
    before = impairment(f"delay=50ms{order}")
    before.schedule(50, 0)
    changed = Impairment(LinkSpec(delay_ns=MS, keep_order=True), np.random.default_rng(0), before)
    assert changed.schedule(50, 1) == (50 * MS,)


@pytest.mark.parametrize(
    ("model", "changed"),
    [
        ("loss=0.3", "delay=1ms"),
        ("loss=ge:0.05:0.2", "reorder=0.5"),
        ("loss=state:0.05:0.2:0.3", "dup=0.5"),
        ("fade=50ms:50ms:0ms:1", "rate=1Mbps,order=keep"),
        ("handover=100ms:50ms", "loss=0.5"),
    ],
)
def test_a_change_of_something_else_leaves_losses_and_interruptions_as_they_would_have_been(model, changed):
    def stopped(copy: Copy, entry: int) -> bool:
        return copy.fate is Fate.LOST if "handover" not in model else copy.exit_ns != entry

    plain, link = impairment(model), impairment(model)
    for n in range(2000):
        if n == 1000:
            link = Impairment(parse_spec(f"{model},{changed}"), np.random.default_rng(99), link)
        expected, found = (way.step(60, n * MS)[0] for way in (plain, link))
        hidden = "handover" in model and found.fate is Fate.LOST
        assert hidden or stopped(found, n * MS) == stopped(expected, n * MS)


def test_a_change_of_something_else_leaves_the_place_in_a_trace():
    trace = Trace("", (1, 2, 3))
    link = Impairment(LinkSpec(trace=trace), np.random.default_rng(0))
    assert link.schedule(60, 0) == (1,)
    link = Impairment(LinkSpec(trace=trace, delay_ns=10), np.random.default_rng(0), link)
    assert link.schedule(60, 0) == (12,)
    assert Impairment(LinkSpec(trace=Trace("", (5,))), np.random.default_rng(0), link).schedule(60, 0) == (5,)
