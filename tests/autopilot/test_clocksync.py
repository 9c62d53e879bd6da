"""Offset and skew of a clock: bounds that hold the truth whatever the link does, and a guess that comes close to it."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autopilot.clocksync import MAX_OUTSTANDING, STALE_NS, ClockEstimate, ClockLine, ClockStatus, ClockSync
from autopilot.envelope import MAX_BUCKETS, WINDOW_NS
from autopilot.link.clock import Clock
from tests.helpers import AUTOPILOT_CLOCK, MS, PLANT_CLOCK, S

quick = settings(deadline=None, max_examples=60)
QUANTUM_NS = 2
"""Both clocks show whole nanoseconds."""


@dataclass
class Exchanges:
    """Two clocks and a link; true time goes on from exchange to exchange."""

    own: Clock = AUTOPILOT_CLOCK
    peer: Clock = PLANT_CLOCK
    sync: ClockSync = field(default_factory=ClockSync)
    true_ns: int = 0

    def exchange(self, down_ns: int, up_ns: int) -> None:
        """Make one exchange whose request takes ``down_ns`` and whose answer takes ``up_ns``."""
        ts1 = self.sync.request(self.own.node_ns(self.true_ns))
        tc1 = self.peer.node_ns(self.true_ns + down_ns)
        self.true_ns += down_ns + up_ns
        now_ns = self.own.node_ns(self.true_ns)
        assert self.sync.answer(tc1, ts1, now_ns) == now_ns - ts1

    def error_ns(self) -> tuple[int, int]:
        """Return the error of the estimate now, and its bound."""
        now_ns = self.own.node_ns(self.true_ns)
        estimate = self.sync.estimate(now_ns)
        return abs(estimate.offset_ns - (self.peer.node_ns(self.true_ns) - now_ns)), estimate.bound_ns

    def skew_error_ppb(self) -> tuple[float, float]:
        """Return the error of the skew now, and its bound."""
        estimate = self.sync.estimate(self.own.node_ns(self.true_ns))
        return abs(estimate.skew_ppb - skew_ppb(self.own, self.peer)), estimate.skew_bound_ppb

    def status(self) -> ClockStatus:
        return self.sync.estimate(self.own.node_ns(self.true_ns)).status


def skew_ppb(own: Clock, peer: Clock) -> float:
    """Return by how much the peer's clock runs faster than ours."""
    return ((S + peer.drift_ppb) / (S + own.drift_ppb) - 1) * S


@dataclass(frozen=True)
class Seen:
    """What was estimated at a true time, and how wrong it was."""

    true_ns: int
    estimate: ClockEstimate
    error_ns: int
    skew_error_ppb: float

    @property
    def honest(self) -> bool:
        return (
            self.error_ns <= self.estimate.bound_ns + QUANTUM_NS and self.skew_error_ppb <= self.estimate.skew_bound_ppb
        )


Latency = Callable[[np.random.Generator], float]
"""One draw, in ms."""


def constant_ms(base_ms: float) -> Latency:
    return lambda _rng: base_ms


def gamma_ms(base_ms: float, mean_ms: float) -> Latency:
    return lambda rng: base_ms + rng.gamma(2.0, mean_ms / 2)


LINKS: dict[str, tuple[Latency, Latency]] = {
    "LAN": (lambda rng: 0.1 + rng.exponential(0.1), lambda rng: 0.1 + rng.exponential(0.1)),
    "LTE": (gamma_ms(25, 10), gamma_ms(25, 10)),
    "uniform 30 to 70": (lambda rng: rng.uniform(30, 70), lambda rng: rng.uniform(30, 70)),
    "asymmetric 20/60": (constant_ms(20), constant_ms(60)),
    "jitter down": (gamma_ms(25, 10), constant_ms(25)),
    "jitter up": (constant_ms(25), gamma_ms(25, 10)),
}


@dataclass
class Simulation:
    """Requests on a grid over a random link, answers that may overtake each other; clocks and link may be changed."""

    link: tuple[Latency, Latency]
    seed: int = 0
    loss: float = 0.0
    rate_hz: int = 10
    own: Clock = AUTOPILOT_CLOCK
    peer: Clock = PLANT_CLOCK
    own_step_ns: int = 0
    sync: ClockSync = field(default_factory=ClockSync)
    seen: list[Seen] = field(default_factory=list)
    forge: Callable[[int], int | None] = lambda _ts1: None
    _true_ns: int = 0
    _flying: list[tuple[int, int, int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)

    def own_ns(self, true_ns: int) -> int:
        return self.own.node_ns(true_ns) + self.own_step_ns

    def run(self, seconds: float) -> Simulation:
        """Go on, and look at the estimate before each request and after each answer."""
        end_ns = self._true_ns + round(seconds * S)
        while self._true_ns < end_ns:
            while self._flying and self._flying[0][0] <= self._true_ns:
                arrival_ns, ts1, tc1 = heapq.heappop(self._flying)
                self.sync.answer(tc1, ts1, self.own_ns(arrival_ns))
                self._look(arrival_ns)
            self._look(self._true_ns)
            ts1 = self.sync.request(self.own_ns(self._true_ns))
            down_ns, up_ns = (round(draw(self._rng) * MS) for draw in self.link)
            if self._rng.random() >= self.loss:
                tc1 = self.forge(ts1)
                if tc1 is None:
                    tc1 = self.peer.node_ns(self._true_ns + down_ns)
                heapq.heappush(self._flying, (self._true_ns + down_ns + up_ns, ts1, tc1))
            self._true_ns += S // self.rate_hz
        return self

    def _look(self, true_ns: int) -> None:
        now_ns = self.own_ns(true_ns)
        estimate = self.sync.estimate(now_ns)
        error_ns = abs(estimate.offset_ns - (self.peer.node_ns(true_ns) - now_ns))
        self.seen.append(Seen(true_ns, estimate, error_ns, abs(estimate.skew_ppb - skew_ppb(self.own, self.peer))))

    def since(self, true_s: float) -> list[Seen]:
        return [seen for seen in self.seen if seen.true_ns >= true_s * S]


latencies = st.integers(0, 300 * MS)
drifts = st.integers(-200_000, 200_000)


@quick
@given(
    drifts,
    drifts,
    st.lists(st.tuples(latencies, latencies, st.integers(0, 400 * MS)), min_size=1, max_size=150),
    st.integers(0, STALE_NS - S),
)
def test_the_true_offset_is_always_inside_the_bound(own_ppb, peer_ppb, plan, wait_ns):
    link = Exchanges(Clock(1042 * S, own_ppb), Clock(137 * S, peer_ppb))
    for down_ns, up_ns, gap_ns in plan:
        link.exchange(down_ns, up_ns)
        error_ns, bound_ns = link.error_ns()
        assert error_ns <= bound_ns + QUANTUM_NS
        skew_error_ppb, skew_bound_ppb = link.skew_error_ppb()
        assert skew_error_ppb <= skew_bound_ppb
        link.true_ns += gap_ns
    link.true_ns += wait_ns
    error_ns, bound_ns = link.error_ns()
    assert error_ns <= bound_ns + QUANTUM_NS
    assert (link.sync.steps, link.sync.slips, link.sync.contradictions) == (0, 0, 0)


@pytest.mark.parametrize("own_ppb", [-200_000, 200_000])
@pytest.mark.parametrize("peer_ppb", [-200_000, 200_000])
def test_the_worst_drift_of_both_clocks_on_a_perfect_link_stays_inside_the_bound(own_ppb, peer_ppb):
    link = Exchanges(Clock(0, own_ppb), Clock(0, peer_ppb))
    for _ in range(60):
        link.exchange(0, 0)
        link.true_ns += 4 * S
        error_ns, bound_ns = link.error_ns()
        assert error_ns <= bound_ns + QUANTUM_NS
    assert link.sync.steps == 0


def test_the_worst_drift_is_never_taken_for_a_step_on_a_quiet_link():
    link = Exchanges(Clock(0, -200_000), Clock(0, 200_000))
    for _ in range(300):
        link.exchange(0, 0)
        link.true_ns += 10 * S
    assert link.sync.steps == 0


def test_a_base_asymmetric_link_biases_the_middle_but_not_the_interval():
    link = Exchanges()
    for _ in range(200):
        link.exchange(60 * MS, 20 * MS)
        link.true_ns += 20 * MS
    error_ns, bound_ns = link.error_ns()
    assert error_ns <= bound_ns <= 42 * MS
    assert error_ns == pytest.approx(20 * MS, abs=1 * MS)


def test_jitter_narrows_the_interval_to_the_best_of_both_ways():
    rng = np.random.default_rng(1)
    link = Exchanges()
    for _ in range(500):
        link.exchange(*(int(5 * MS + rng.gamma(2.0, 10 * MS)) for _ in range(2)))
        link.true_ns += 50 * MS
    error_ns, bound_ns = link.error_ns()
    assert error_ns <= bound_ns < 12 * MS


TRUTHS = [(AUTOPILOT_CLOCK, PLANT_CLOCK), (Clock(5 * S, 50_000), Clock(10**18, -50_000)), (Clock(10**18), Clock())]


@pytest.mark.parametrize("name", LINKS)
@pytest.mark.parametrize("seed", range(3))
def test_over_five_minutes_the_truth_is_always_inside_the_bounds_and_the_estimate_locked_from_five_seconds(name, seed):
    own, peer = TRUTHS[seed]
    flown = Simulation(LINKS[name], seed, own=own, peer=peer).run(300)
    synchronised = [seen for seen in flown.seen if seen.estimate.status is not ClockStatus.UNSYNCHRONISED]
    assert all(seen.honest for seen in synchronised)
    assert all(seen.estimate.status is ClockStatus.LOCKED for seen in flown.since(5))
    assert (flown.sync.steps, flown.sync.slips, flown.sync.contradictions) == (0, 0, 0)


@pytest.mark.parametrize(
    ("name", "offset_us", "skew_at_60_ppm", "skew_at_130_ppm"),
    [
        ("LAN", 2, 0.05, 0.02),
        ("LTE", 500, 20, 10),
        ("uniform 30 to 70", 500, 25, 10),
        ("asymmetric 20/60", 20_002, 0.0001, 0.0001),
        ("jitter down", 400, 0.001, 0.001),
        ("jitter up", 400, 0.001, 0.001),
    ],
)
@pytest.mark.parametrize("seed", range(3))
def test_the_guess_comes_as_close_as_the_link_lets_it(name, offset_us, skew_at_60_ppm, skew_at_130_ppm, seed):
    own, peer = TRUTHS[seed]
    flown = Simulation(LINKS[name], seed, own=own, peer=peer).run(300)
    settled = flown.since(130)
    assert np.sqrt(np.mean([float(seen.error_ns) ** 2 for seen in settled])) <= offset_us * 1000
    assert max(seen.skew_error_ppb for seen in flown.since(60)) <= skew_at_60_ppm * 1000
    assert max(seen.skew_error_ppb for seen in settled) <= skew_at_130_ppm * 1000


def test_the_proved_bound_of_the_skew_is_a_few_ppm_on_a_quiet_link_and_no_use_on_a_rough_one():
    quiet, rough = (Simulation(LINKS[name]).run(200).seen[-1].estimate for name in ("LAN", "LTE"))
    assert quiet.skew_bound_ppb < 6_000
    assert rough.skew_bound_ppb > 100_000


@pytest.mark.parametrize("name", LINKS)
def test_with_nine_of_ten_exchanges_lost_the_estimate_still_locks_and_stays_locked(name):
    for seed in range(5):
        flown = Simulation(LINKS[name], seed, loss=0.9).run(300)
        assert flown.since(5)[0].estimate.status is not ClockStatus.UNSYNCHRONISED
        assert all(seen.estimate.status is ClockStatus.LOCKED for seen in flown.since(15))
        assert all(seen.honest for seen in flown.since(15))


@pytest.mark.parametrize("phase", range(4))
def test_crystals_that_follow_the_temperature_within_one_ppm_stay_inside_the_bounds(phase):
    rng, sync, period_s, swing_ppm = np.random.default_rng(phase), ClockSync(), 300.0, 0.5
    for k in range(6000):
        sent_ns = k * 100 * MS
        down_ns, up_ns = (int(0.1 * MS + rng.exponential(0.02 * MS)) for _ in range(2))

        def offset_ns(t_ns):
            angle = 2 * np.pi * t_ns / S / period_s + phase
            return round(t_ns * 2e-5 + swing_ppm * 1e3 * period_s / (2 * np.pi) * np.sin(angle))

        ts1, now_ns = sync.request(sent_ns), sent_ns + down_ns + up_ns
        sync.answer(sent_ns + down_ns + offset_ns(sent_ns + down_ns), ts1, now_ns)
        estimate = sync.estimate(now_ns)
        assert abs(estimate.offset_ns - offset_ns(now_ns)) <= estimate.bound_ns + QUANTUM_NS
    assert sync.contradictions == 0


@pytest.mark.parametrize("change_ppb", [-150_000, 150_000])
@pytest.mark.parametrize("name", LINKS)
def test_a_sudden_change_of_rate_is_no_step_and_is_believed_within_two_windows(name, change_ppb):
    flown = Simulation(LINKS[name], peer=Clock(137 * S, 0), own=Clock(1042 * S, 0)).run(200)
    # the peer's clock goes on from where it stands
    flown.peer = Clock(flown.peer.node_ns(200 * S), change_ppb, boot_ns=200 * S)
    flown._flying.clear()
    flown.run(2 * WINDOW_NS / S)
    assert flown.sync.steps == 0
    assert all(seen.honest for seen in flown.since(205))
    assert flown.seen[-1].skew_error_ppb <= 10_000
    assert flown.sync.slips <= 1


def test_status_goes_from_unsynchronised_over_converging_to_locked():
    link = Exchanges()
    seen = [link.status()]
    for _ in range(6):
        link.exchange(MS, MS)
        seen.append(link.status())
    assert seen == [ClockStatus.UNSYNCHRONISED] + [ClockStatus.CONVERGING] * 4 + [ClockStatus.LOCKED] * 2


def test_an_estimate_is_believed_until_just_before_it_is_stale():
    sync = ClockSync()
    for n in range(5):
        sync.answer(n * MS, sync.request(n * MS), n * MS)
    last_ns = 4 * MS
    assert sync.estimate(last_ns + STALE_NS).status is ClockStatus.LOCKED
    assert sync.estimate(last_ns + STALE_NS + 1).status is ClockStatus.UNSYNCHRONISED


def test_after_a_long_silence_the_lines_begin_anew():
    link = Exchanges()
    for _ in range(50):
        link.exchange(MS, MS)
        link.true_ns += 98 * MS
    link.true_ns += WINDOW_NS + 3 * S
    assert link.status() is ClockStatus.UNSYNCHRONISED
    link.exchange(60 * MS, 60 * MS)
    assert link.status() is ClockStatus.CONVERGING
    error_ns, bound_ns = link.error_ns()
    assert error_ns <= bound_ns


def test_the_first_exchanges_count_at_once():
    link = Exchanges()
    for n, latency_ms in enumerate((300, 100, 30, 10, 3, 1)):
        link.exchange(latency_ms * MS, latency_ms * MS)
        assert link.error_ns()[1] <= 1.1 * latency_ms * MS, n


@pytest.mark.parametrize("seed", range(5))
def test_while_jitter_hides_the_skew_the_guess_is_one_that_common_crystals_have(seed):
    flown = Simulation(LINKS["LTE"], seed, own=Clock(), peer=Clock()).run(20)
    assert max(abs(seen.estimate.skew_ppb) for seen in flown.seen) <= 60_000


@dataclass
class Perfect:
    """Clocks without drift, for 20 s on a link of 50 us each way; then exchanges that say what they are told to."""

    sync: ClockSync = field(default_factory=ClockSync)

    def __post_init__(self) -> None:
        for k in range(200):
            self.at(k * 100 * MS, 0, WIDTH)

    def at(self, t_ns: int, offset_ns: int, width_ns: int = 0) -> None:
        """Make one exchange that says offset +- width."""
        ts1 = self.sync.request(t_ns - width_ns)
        self.sync.answer(t_ns + offset_ns, ts1, t_ns + width_ns)

    def told(self) -> tuple[int, int, int]:
        return self.sync.steps, self.sync.slips, self.sync.contradictions


WIDTH = 50_000
BARELY = 300_000
"""An offset that after a second of silence no line allows, and the interval does."""


def test_three_doubts_within_a_window_give_up_the_lines_and_are_then_forgotten():
    clocks = Perfect()
    told = []
    for k in range(3):
        clocks.at((21 + 2 * k) * S, BARELY)
        told.append(clocks.told())
    assert told == [(0, 0, 1), (0, 0, 2), (0, 1, 3)]
    estimate = clocks.sync.estimate(25 * S)
    assert abs(estimate.offset_ns - BARELY) <= estimate.bound_ns <= 20_000
    clocks.at(27 * S, BARELY - 700_000)
    assert clocks.told() == (0, 1, 4)


def test_doubts_older_than_the_window_do_not_count():
    clocks = Perfect()
    for t_s in (21, 23):
        clocks.at(t_s * S, BARELY)
    for t_s in range(24, 24 + WINDOW_NS // S):
        clocks.at(t_s * S, 0, WIDTH)
    clocks.at((26 + WINDOW_NS // S) * S, BARELY)
    assert clocks.told() == (0, 0, 3)


def test_a_rate_that_changed_during_a_long_silence_contradicts_nothing():
    clocks = Perfect()
    clocks.at(23 * S + WINDOW_NS, 6 * MS, WIDTH)  # 46 ppm: no line allows that
    assert clocks.told() == (0, 0, 0)
    estimate = clocks.sync.estimate(23 * S + WINDOW_NS + WIDTH)
    assert abs(estimate.offset_ns - 6 * MS) <= estimate.bound_ns <= 60_000


def test_exchanges_that_were_allowed_one_by_one_but_fit_no_line_begin_it_anew():
    clocks = Perfect()
    clocks.at(20_000 * MS, 0, WIDTH)
    clocks.at(20_100 * MS, 40_000)
    clocks.at(20_400 * MS, -40_000)  # 267 ppm from the one before: no contradiction for any rates
    assert clocks.told() == (0, 0, 0)
    clocks.at(22_000 * MS, 0, WIDTH)
    assert clocks.told() == (0, 1, 0)
    estimate = clocks.sync.estimate(22_000 * MS)
    assert estimate.status is ClockStatus.CONVERGING
    assert estimate.bound_ns == pytest.approx(WIDTH, rel=0.1)


def test_a_step_whose_exchanges_fit_no_line_begins_anew_from_the_newest():
    clocks = Perfect()
    clocks.at(20_000 * MS, 10 * S)
    clocks.at(20_850 * MS, 10 * S - 300_000 - 750 * MS, 750 * MS)  # sent 0.1 s later, and 3000 ppm from there
    clocks.at(21_700 * MS, 10 * S, 10 * MS)
    assert clocks.told() == (1, 1, 3)
    estimate = clocks.sync.estimate(21_710 * MS)
    assert abs(estimate.offset_ns - 10 * S) <= estimate.bound_ns <= 11 * MS


def test_the_line_is_the_best_guess_at_any_own_time():
    link = Exchanges()
    assert link.sync.line(0) is None
    for _ in range(100):
        link.exchange(10 * MS, 10 * MS)
        link.true_ns += 80 * MS
    now_ns = link.own.node_ns(link.true_ns)
    line = link.sync.line(now_ns)
    assert line is not None
    assert line.at(now_ns) == line.offset_ns == link.sync.estimate(now_ns).offset_ns
    for before_ns in (0, 50 * MS, 5 * S, 60 * S):
        true_ns = link.true_ns - before_ns
        truth_ns = link.peer.node_ns(true_ns) - link.own.node_ns(true_ns)
        assert line.at(link.own.node_ns(true_ns)) == pytest.approx(truth_ns, abs=5_000)


def test_a_line_keeps_nanoseconds_at_the_largest_times():
    line = ClockLine(10**18, -(10**18) + 1, 12_345.678)
    assert line.at(10**18) == -(10**18) + 1
    assert line.at(10**18 + 10 * S) == -(10**18) + 1 + 123_457
    assert line.at(10**18 - 10 * S) == -(10**18) + 1 - 123_457


def test_answers_that_match_no_request_change_nothing():
    link = Exchanges()
    for _ in range(10):
        link.exchange(MS, MS)
    now_ns = link.own.node_ns(link.true_ns)
    before = link.sync.estimate(now_ns)
    for ts1 in (0, -1, now_ns, 1 << 62, link.own.node_ns(0)):
        assert link.sync.answer(5, ts1, now_ns) is None
    assert link.sync.unmatched == 5
    assert link.sync.estimate(now_ns) == before
    assert link.sync.steps == 0


def test_an_answer_counts_once():
    sync = ClockSync()
    ts1 = sync.request(10)
    assert sync.answer(100, ts1, 20) == 10
    assert sync.answer(100, ts1, 30) is None


@pytest.mark.parametrize("step_ns", [-200 * S, -2 * S, -MS * 200, 200 * MS, 2 * S, 3600 * S])
def test_a_step_is_found_at_the_third_exchange_with_its_sign_and_size(step_ns):
    link = Exchanges(peer=Clock(5000 * S, 40_000))
    for _ in range(50):
        link.exchange(10 * MS, 15 * MS)
        link.true_ns += 75 * MS
    link.peer = Clock(link.peer.offset_ns + step_ns, link.peer.drift_ppb)
    steps = []
    for _ in range(4):
        link.exchange(10 * MS, 15 * MS)
        link.true_ns += 75 * MS
        steps.append(link.sync.steps)
    assert steps == [0, 0, 1, 1]
    assert link.sync.last_step_ns == pytest.approx(step_ns, abs=26 * MS)
    error_ns, bound_ns = link.error_ns()
    assert error_ns <= bound_ns < 26 * MS


def test_a_restart_is_a_jump_back():
    link = Exchanges()
    for _ in range(30):
        link.exchange(10 * MS, 10 * MS)
        link.true_ns += 80 * MS
    link.peer = Clock(137 * S, 40_000, boot_ns=link.true_ns)
    for _ in range(3):
        link.exchange(10 * MS, 10 * MS)
    assert link.sync.steps == 1
    assert link.sync.last_step_ns == pytest.approx(-3 * S, abs=50 * MS)


def test_one_outlier_is_no_step():
    link = Exchanges()
    for n in range(60):
        link.exchange(10 * MS, 10 * MS)
        link.true_ns += 80 * MS
        if n % 5 == 4:
            ts1 = link.sync.request(link.own.node_ns(link.true_ns))
            link.sync.answer(ts1 + 5000 * S, ts1, ts1 + MS)
            link.true_ns += 2 * MS
    assert link.sync.steps == 0
    error_ns, bound_ns = link.error_ns()
    assert error_ns <= bound_ns <= 13 * MS


@pytest.mark.parametrize("step_ns", [-10 * S, -100 * MS, 100 * MS, 10 * S])
@pytest.mark.parametrize("name", LINKS)
def test_a_step_of_the_peer_is_found_within_a_second_on_any_link(name, step_ns):
    flown = Simulation(LINKS[name]).run(100)
    flown.peer = Clock(flown.peer.offset_ns + step_ns, flown.peer.drift_ppb)
    flown.run(100)
    assert (flown.sync.steps, flown.sync.slips) == (1, 0)
    assert flown.sync.last_step_ns == pytest.approx(step_ns, abs=45 * MS)
    assert all(seen.honest for seen in flown.since(101))
    stepped = [seen.true_ns for seen in flown.seen if seen.estimate.status is ClockStatus.STEPPED]
    assert min(stepped) >= 100.2 * S
    assert max(stepped) < 101 * S
    assert all(seen.estimate.status is ClockStatus.LOCKED for seen in flown.since(101))


@pytest.mark.parametrize("step_ns", [100 * MS, 10 * S, 100 * S])
@pytest.mark.parametrize("name", LINKS)
def test_a_step_of_our_own_clock_is_found_as_well(name, step_ns):
    flown = Simulation(LINKS[name]).run(100)
    flown.own_step_ns += step_ns
    flown.run(100)
    assert flown.sync.steps == 1
    assert flown.sync.last_step_ns == pytest.approx(-step_ns, abs=45 * MS)
    assert all(seen.honest for seen in flown.since(102))
    assert all(seen.estimate.status is ClockStatus.LOCKED for seen in flown.since(102))


def test_after_a_step_the_status_says_so_until_five_more_exchanges():
    link = Exchanges(peer=Clock(5000 * S, 40_000))
    for _ in range(10):
        link.exchange(MS, MS)
    link.peer = Clock(100 * S, 40_000)
    statuses = []
    for _ in range(9):
        link.exchange(MS, MS)
        statuses.append(link.status())
        error_ns, bound_ns = link.error_ns()
        assert len(statuses) < 3 or error_ns <= bound_ns
    assert statuses == [ClockStatus.LOCKED] * 2 + [ClockStatus.STEPPED] * 5 + [ClockStatus.LOCKED] * 2


@pytest.mark.parametrize("step_us", [-15_000, -1_000, 1_000, 15_000])
@pytest.mark.parametrize("name", ["LTE", "uniform 30 to 70", "jitter down", "jitter up"])
def test_a_step_too_small_to_see_is_outlived_within_a_window(name, step_us):
    flown = Simulation(LINKS[name], seed=3).run(200)
    flown.peer = Clock(flown.peer.offset_ns + step_us * 1000, flown.peer.drift_ppb)
    flown.run(WINDOW_NS / S + 60)
    after = flown.since(200 + WINDOW_NS / S + 5)
    assert all(seen.honest for seen in after)
    assert max(seen.error_ns for seen in after) <= 2 * MS


@pytest.mark.parametrize("name", LINKS)
def test_a_wrong_first_answer_is_overruled(name):
    wrong = iter([1 << 62])
    flown = Simulation(LINKS[name], forge=lambda _ts1: next(wrong, None)).run(20)
    assert flown.sync.steps == 1
    assert all(seen.honest and seen.estimate.status is ClockStatus.LOCKED for seen in flown.since(2))


@pytest.mark.parametrize("lie_ns", [-(1 << 61), -3600 * S, -200 * MS, 200 * MS, 3600 * S, 1 << 61])
@pytest.mark.parametrize("in_a_row", [1, 2])
@pytest.mark.parametrize("name", ["LAN", "LTE"])
def test_forged_answers_to_true_requests_change_nothing_unless_three_come_in_a_row(name, lie_ns, in_a_row):
    rng = np.random.default_rng(1)
    sent: list[int] = []

    def forge(ts1):
        sent.append(ts1)
        lying = len(sent) > 50 and len(sent) % 10 < in_a_row
        return (
            ts1 - AUTOPILOT_CLOCK.offset_ns + PLANT_CLOCK.offset_ns + lie_ns + int(rng.integers(MS)) if lying else None
        )

    flown = Simulation(LINKS[name], forge=forge).run(60)
    true = Simulation(LINKS[name]).run(60)
    assert (flown.sync.steps, flown.sync.slips) == (0, 0)
    assert flown.sync.contradictions > 20
    assert all(seen.honest and seen.estimate.status is ClockStatus.LOCKED for seen in flown.since(5))
    assert flown.seen[-1].estimate.bound_ns <= 1.2 * true.seen[-1].estimate.bound_ns


def test_lies_that_contradict_each_other_are_never_a_step():
    lies = np.random.default_rng(2)
    flown = Simulation(LINKS["LTE"]).run(20)
    flown.forge = lambda ts1: ts1 + int(lies.integers(-(1 << 61), 1 << 61))
    flown.run(20)
    assert flown.sync.steps == 0
    flown.forge = lambda _ts1: None
    flown.run(20)
    assert flown.sync.steps == 0
    assert all(seen.honest and seen.estimate.status is ClockStatus.LOCKED for seen in flown.since(41))


def test_a_liar_who_is_believed_is_given_up_as_soon_as_the_truth_comes_back():
    flown = Simulation(LINKS["LTE"]).run(20)
    flown.forge = lambda ts1: ts1 + 5 * S
    flown.run(20)
    assert flown.sync.steps == 1
    flown.forge = lambda _ts1: None
    flown.run(20)
    assert flown.sync.steps == 2
    assert all(seen.honest and seen.estimate.status is ClockStatus.LOCKED for seen in flown.since(42))


@pytest.mark.parametrize("lie_us", [-400, -150, 150, 400])
def test_a_few_lies_too_small_for_a_step_are_outlived(lie_us):
    flown = Simulation(LINKS["LAN"]).run(60)
    middle_ns = PLANT_CLOCK.node_ns(60 * S) - AUTOPILOT_CLOCK.node_ns(60 * S) + 150_000
    lies = iter([middle_ns + lie_us * 1000] * 10)
    flown.forge = lambda ts1: ts1 + lie if (lie := next(lies, None)) is not None else None
    flown.run(WINDOW_NS / S + 20)
    assert all(seen.honest and seen.estimate.status is ClockStatus.LOCKED for seen in flown.since(65 + WINDOW_NS / S))
    assert flown.seen[-1].error_ns < 20_000


def test_replayed_answers_and_answers_nobody_asked_for_change_nothing():
    true, attacked = Simulation(LINKS["LTE"]), Simulation(LINKS["LTE"])
    true.run(30)
    for k in range(30):
        attacked.run(1)
        now_ns = attacked.own_ns((k + 1) * S)
        for back_ms in range(0, 1000, 100):
            attacked.sync.answer(now_ns, attacked.own_ns((k + 1) * S - 500 * MS - back_ms * MS), now_ns)
        for unknown in (0, now_ns + 1, -now_ns, 1 << 62):
            attacked.sync.answer(now_ns, unknown, now_ns)
    assert attacked.sync.unmatched == 30 * 14
    assert attacked.seen == true.seen


def test_memory_is_bounded_over_a_hundred_thousand_exchanges_whatever_they_say():
    rng, sync = np.random.default_rng(4), ClockSync()
    wild = rng.integers(-(1 << 62), 1 << 62, 100_000)
    kind = rng.random(100_000)
    for k in range(100_000):
        now_ns = k * 100 * MS
        ts1 = sync.request(now_ns)
        if kind[k] < 0.9:
            sync.answer(now_ns + (int(wild[k]) if kind[k] < 0.05 else 5 * MS), ts1, now_ns + 10 * MS)
        if k % 1000 == 0:
            assert len(sync._outstanding) <= MAX_OUTSTANDING
            assert len(sync._window._buckets) <= MAX_BUCKETS
            assert len(sync._contradicting) < 3
            assert len(sync._doubting) < 3


def test_memory_is_bounded_when_nobody_answers_and_when_everybody_does():
    sync = ClockSync()
    for n in range(5000):
        sync.request(n)
    assert len(sync._outstanding) == MAX_OUTSTANDING
    assert sync.answer(0, 5000 - MAX_OUTSTANDING - 1, 6000) is None
    assert sync.answer(0, 5000 - MAX_OUTSTANDING, 6000) is not None
    for n in range(10_000, 15_000):
        sync.answer(n, sync.request(n), n)
    assert len(sync._outstanding) < MAX_OUTSTANDING
    assert len(sync._contradicting) < 3


@quick
@given(st.lists(st.tuples(st.integers(-(1 << 62), 1 << 62), st.booleans()), max_size=200))
def test_no_answer_whatever_raises_or_grows_anything(answers):
    sync = ClockSync()
    for n, (tc1, ours) in enumerate(answers):
        ts1 = sync.request(n * MS)
        sync.answer(tc1, ts1 if ours else tc1, n * MS)
        estimate = sync.estimate(n * MS)
        assert estimate.bound_ns >= 0
    assert len(sync._contradicting) < 3
    assert len(sync._outstanding) <= MAX_OUTSTANDING
