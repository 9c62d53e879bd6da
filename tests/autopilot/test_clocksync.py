"""The clock offset: an interval that holds the truth whatever the link does."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autopilot.clocksync import MAX_OUTSTANDING, STALE_NS, ClockStatus, ClockSync
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

    def status(self) -> ClockStatus:
        return self.sync.estimate(self.own.node_ns(self.true_ns)).status


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
        link.true_ns += gap_ns
    link.true_ns += wait_ns
    error_ns, bound_ns = link.error_ns()
    assert error_ns <= bound_ns + QUANTUM_NS
    assert link.sync.steps == 0


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
