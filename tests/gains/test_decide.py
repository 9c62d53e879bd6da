"""Decisions on stability: published windows, closed forms, and many loops near the edge, each answer flown plainly."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from gains.decide import Decision, bound, decide, refute
from gains.model import Gains, Matrix, Model, Schedule, Trim, Uncertainty, sets_of
from gains.store import load_gains
from gains.switched import Transitions, eq9, graph
from gains.verify_switched import check_switched
from gains.witness import find_witness
from tests.gains.near_edge import near_edge, run, run_against, sequences

HIRM, PENDULUM = load_gains("hirm-paper"), load_gains("pendulum-paper")
BOTH: list[Transitions] = ["any", "fifo"]


def of(A: Matrix, BK: Matrix, d_max: int = 3, d_min: int = 1) -> Gains:
    """x(k+1) = A x(k) + BK x(k − d)."""
    nx = len(A)
    E, D = np.zeros((nx, 0)), np.zeros((nx, nx))
    trim = Trim(np.zeros(nx), np.zeros(nx))
    model = Model("hand", 0.1, A, np.eye(nx), E, np.eye(nx), D, tuple(f"x{i}" for i in range(nx)), trim)
    return Gains("hand", model, d_min, d_max, BK)


def scalar(a: float, b: float, d_max: int = 3, d_min: int = 1) -> Gains:
    return of(np.array([[a]]), np.array([[b]]), d_max, d_min)


def decided(gains: Gains, transitions: Transitions = "any") -> Decision:
    return decide(gains, gains.d_min, gains.d_max, transitions=transitions)


# -- the published windows


@pytest.mark.parametrize("transitions", BOTH)
@pytest.mark.parametrize(
    ("gains", "largest", "growth"), [(PENDULUM, 6, 1.001), (HIRM, 4, 1.005)], ids=["pendulum", "hirm"]
)
def test_the_published_gains_are_proved_up_to_a_window_and_refuted_one_sample_beyond(
    gains: Gains, largest: int, growth: float, transitions: Transitions
) -> None:
    said: list[str] = []
    found = bound(gains, 1, 20, transitions, tell=said.append)
    assert (found.d_max, found.undecided) == (largest, ())
    assert found.proof is not None
    assert_proved(gains, found.proof, transitions)
    assert found.refuted is not None
    assert found.refuted.d_max == largest + 1
    assert found.refuted.growth is not None
    assert found.refuted.growth >= growth
    assert_diverges(replace(gains, d_max=largest + 1), found.refuted, transitions)
    assert said == [
        f"{largest + 1}: a delay sequence grows {found.refuted.growth:.6f} per sample",
        f"{largest}: stable",
    ]


def test_the_largest_growth_is_sought_where_it_is_asked_for() -> None:
    first, best = decide(HIRM, 1, 6), decide(HIRM, 1, 6, best_witness=True)
    assert first.growth is not None
    assert best.growth is not None
    assert 1.0 < first.growth <= best.growth
    assert_diverges(replace(HIRM, d_max=6), best, "any")


# -- closed forms


@pytest.mark.parametrize(("a", "b"), [(0.5, 0.3), (0.5, -0.499), (-0.9, 0.05), (0.5, 0.0), (0.0, -0.99)])
def test_a_loop_that_contracts_whatever_the_delay_does_is_unbounded(a: float, b: float) -> None:
    found = bound(scalar(a, b), 1, 8)
    assert found.d_max == "unbounded"
    assert found.refuted is None
    assert found.proof is not None
    assert found.proof.unbounded
    assert found.proof.certificate is not None
    assert found.proof.certificate.contraction is not None
    assert found.proof.upper < 1.0


@pytest.mark.parametrize("edge", [1e-3, 1e-6])
def test_a_positive_loop_is_stable_exactly_where_its_entries_sum_below_one(edge: float) -> None:
    assert decided(scalar(0.6, 0.4 - edge)).verdict == "stable"
    beyond = decided(scalar(0.6, 0.4 + edge))
    assert beyond.verdict == "unstable"
    assert beyond.growth is not None
    assert beyond.growth > 1.0
    assert beyond.certificate is None


@pytest.mark.parametrize("a", [0.0, 0.9, 1.1])
def test_a_loop_without_feedback_is_as_stable_as_its_plant(a: float) -> None:
    turn = a * np.array([[0.6, -0.8], [0.8, 0.6]])  # |A| does not contract
    found = decided(of(turn, np.zeros((2, 2))))
    assert found.verdict == ("unstable" if a > 1.0 else "stable")
    assert found.growth == (pytest.approx(a) if a > 1.0 else None)


def test_a_constant_delay_is_decided_by_its_eigenvalues() -> None:
    # x(k+1) = x(k) + b x(k − d), b < 0, is stable for −b < 2 sin(π / (2 (2d + 1)))
    for d in (1, 2, 5):
        edge = 2.0 * math.sin(math.pi / (2 * (2 * d + 1)))
        assert decided(scalar(1.0, -0.999 * edge, d, d)).verdict == "stable"
        assert decided(scalar(1.0, -1.001 * edge, d, d)).witness == (d,)


def test_blocks_are_decided_one_by_one() -> None:
    def chained(last: float) -> Gains:
        """The published loop, which drives a fourth state with feedback of its own."""
        A, B, K1 = HIRM.model.A, HIRM.model.B, HIRM.K1
        K = np.block([[K1, np.zeros((1, 1))], [np.array([[3.0, 1.0, -2.0, last]])]])
        whole = of(np.block([[A, np.zeros((3, 1))], [5.0 * np.ones((1, 3)), np.array([[0.4]])]]), np.zeros((4, 4)))
        inputs = np.block([[B, np.zeros((3, 1))], [np.zeros((1, 1)), np.ones((1, 1))]])
        model = replace(whole.model, B=inputs, D=np.zeros((4, 2)), trim=Trim(np.zeros(4), np.zeros(2)))
        return replace(whole, model=model, K1=K)

    found = decided(chained(-0.45))
    assert_proved(chained(-0.45), found, "any")
    assert found.certificate is not None
    assert sorted(len(block.states) for block in found.certificate.blocks if len(block.states) > 1) == [4, 6]
    broken = decided(chained(-1.45))
    assert broken.verdict == "unstable"
    assert_diverges(chained(-1.45), broken, "any")


def test_gains_whose_rank_is_lost_in_rounding_are_decided() -> None:
    A = np.block([[HIRM.model.A, np.zeros((3, 1))], [5.0 * np.ones((1, 3)), np.array([[0.4]])]])
    BK = np.zeros((4, 4))
    BK[:3, :3], BK[3] = HIRM.model.B @ HIRM.K1, [3.0, 3.0, 3.0, -0.45]  # of rank two but for rounding
    found = decided(of(A, BK))
    assert_proved(of(A, BK), found, "any", flights=100)


# -- windows


def test_bound_ends_at_its_limit_and_says_that_nothing_was_refuted() -> None:
    found = bound(PENDULUM, 1, 4)
    assert (found.d_max, found.refuted, found.undecided) == (4, None, ())
    assert found.proof is not None
    assert found.proof.d_max == 4


def test_nothing_is_proved_where_the_least_delay_diverges() -> None:
    found = bound(HIRM, 6, 8)
    assert (found.d_max, found.proof) == (None, None)
    assert found.refuted is not None
    assert (found.refuted.d_max, found.refuted.witness) == (6, (6,))


def test_quick_refutation_agrees_with_the_decision() -> None:
    assert refute(HIRM, 1, 4) is None
    quick = refute(HIRM, 1, 5)
    assert quick is not None
    assert quick.verdict == "unstable"
    assert_diverges(replace(HIRM, d_max=5), quick, "any")


# -- uncertainty


def uncertain(a: float) -> Gains:
    """x(k+1) = (a + Δ) x(k)."""
    gains = scalar(a, 0.0)
    one = np.ones((1, 1))
    return replace(gains, model=replace(gains.model, uncertainty=Uncertainty(one, one, 0.0 * one, 1.0)))


def test_an_uncertain_pole_is_proved_exactly_as_far_as_it_stays_inside() -> None:
    inside = decide(uncertain(0.5), 1, 2, delta_max=0.499)
    assert inside.verdict == "stable"
    assert inside.certificate is not None
    assert inside.certificate.delta_max == 0.499
    outside = decide(uncertain(0.5), 1, 2, delta_max=0.501)
    assert (outside.verdict, outside.certificate, outside.reason) == ("unstable", None, "Delta held at +0.501")
    assert outside.growth == pytest.approx(1.001, rel=1e-6)


@pytest.mark.parametrize(("d_max", "verdict"), [(2, "stable"), (5, "unstable")])
def test_the_published_gains_are_decided_with_uncertainty(d_max: int, verdict: str) -> None:
    found = decide(HIRM, 1, d_max, delta_max=0.15)
    assert found.verdict == verdict
    if found.certificate is not None:
        assert check_switched(HIRM, found.certificate).passed


# -- schedules


def two_sets(factor: float) -> Schedule:
    low, high = scalar(1.0, -0.3, 1, 0), scalar(1.0, -0.3 * factor, 3, 1)
    return Schedule("two", low.model, (replace(low, d_min=0), replace(high, model=low.model)))


def test_a_schedule_is_proved_or_refuted_over_all_switching() -> None:
    gentle = two_sets(0.5)
    found = decide(gentle, 0, 3)
    assert found.verdict == "stable"
    assert found.certificate is not None
    assert check_switched(gentle, found.certificate).passed
    rough = two_sets(2.0)
    refuted = decide(rough, 0, 3)
    assert refuted.verdict == "unstable"
    assert refuted.witness is not None
    assert refuted.witness_sets is not None
    assert refuted.growth is not None
    past = [1.0, 0.3, -0.2, 0.1]
    start = max(map(abs, past))
    for _ in range(math.ceil(math.log(1e5) / math.log(refuted.growth) / len(refuted.witness))):
        for d, which in zip(refuted.witness, refuted.witness_sets, strict=True):
            own = sets_of(rough)[which]
            assert own.d_min - 1 <= d <= own.d_max + 1 or d > own.d_max
            past = [past[0] + float(own.K1[0, 0]) * past[d], *past[:-1]]
    assert max(map(abs, past)) > 100.0 * start


# -- every answer, flown plainly


def assert_proved(gains: Gains, found: Decision, transitions: Transitions, *, flights: int = 1000) -> None:
    """A verified certificate, no sequence that grows, and flights that all decay."""
    assert found.verdict == "stable", found.reason
    assert found.certificate is not None
    assert check_switched(gains, found.certificate).passed
    assert (found.witness, found.growth) == (None, None)
    window = replace(gains, d_min=found.d_min, d_max=found.d_max)
    rng = np.random.default_rng(1)
    drawn = sequences(rng, found.d_min, found.d_max, transitions, 1000, flights)
    for norms in (run(window, drawn, rng), run_against(window, transitions, rng, 1000, flights // 5)):
        assert np.all(norms[-100:].max(axis=0) < norms[:500].max(axis=0))


def assert_diverges(gains: Gains, found: Decision, transitions: Transitions) -> None:
    """No certificate, and a witness that is admissible and grows as it says."""
    assert found.verdict == "unstable"
    assert (found.certificate, found.verification) == (None, None)
    assert found.witness is not None
    assert found.growth is not None
    witness = np.array(found.witness)
    assert gains.d_min <= witness.min()
    assert witness.max() <= gains.d_max
    assert transitions == "any" or np.all(np.roll(witness, -1) <= witness + 1)
    samples = math.log(1e4) / math.log(found.growth)
    delays = np.tile(witness, math.ceil(samples / len(witness)))[:, None].repeat(4, axis=1)
    norms = run(gains, delays, np.random.default_rng(2))
    assert np.all(norms[-1] > 10.0 * norms[0])


def assert_no_sequence_grows(gains: Gains, transitions: Transitions) -> None:
    switched = eq9(gains, gains.d_min, gains.d_max)
    assert find_witness(switched, graph(switched, gains, transitions), polish=True).growth < 1.0


def answered(seed: int, *, flights: int = 1000, search: bool = True) -> Decision:
    """The decision on a loop near the edge, after its claims have been tried."""
    gains, transitions = near_edge(seed), BOTH[seed % 2]
    found = decided(gains, transitions)
    if found.verdict == "stable":
        assert_proved(gains, found, transitions, flights=flights)
        if search:
            assert_no_sequence_grows(gains, transitions)
    elif found.verdict == "unstable":
        assert_diverges(gains, found, transitions)
    else:
        assert (found.certificate, found.witness) == (None, None)
        assert found.reason
        assert found.lower < 1.0 <= found.upper
    return found


@pytest.mark.parametrize("seed", range(32, 48))
def test_a_loop_near_the_edge_is_decided_and_the_answer_holds_in_flight(seed: int) -> None:
    assert answered(seed, flights=300).verdict != "undecided"


@pytest.mark.long
def test_of_two_hundred_loops_near_the_edge_all_but_four_at_most_are_decided_and_every_answer_holds() -> None:
    found = {seed: answered(seed) for seed in range(200)}
    verdicts = [decision.verdict for decision in found.values()]
    assert min(verdicts.count("stable"), verdicts.count("unstable")) > 60  # on both sides
    undecided = {seed: (d.lower, d.upper) for seed, d in found.items() if d.verdict == "undecided"}
    assert len(undecided) <= 4, undecided
