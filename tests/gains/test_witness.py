"""Witnesses: pairs of known joint spectral radius, exhaustive search, the published sequences, and precision."""

from dataclasses import replace
from itertools import pairwise, product

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gains.decide import decide
from gains.model import Gains, Matrix, Model, Schedule, Trim, spectral_radius
from gains.store import load_gains
from gains.switched import Graph, Key, Mode, Switched, Transitions, as_flown, eq9, graph, state_loop
from gains.witness import Effort, Found, confirm, find_witness, primitive, successors
from tests.gains.loops import FEASIBLE, random_gains

GOLDEN = (1.0 + 5.0**0.5) / 2.0
SHEARS = np.array([[[1.0, 1.0], [0.0, 1.0]], [[1.0, 0.0], [1.0, 1.0]]])
SMALL = Effort(beam=16, depth=10, trajectories=4, steps=40, longest=16)


def by_hand(F: Matrix) -> Switched:
    """Modes without input and output."""
    modes, N = len(F), F.shape[1]
    return Switched(
        modes=tuple(Mode(d) for d in range(1, modes + 1)),
        F=F,
        G=np.zeros((modes, N, 0)),
        H=np.zeros((modes, 0, N)),
        Hv=np.zeros((modes, 0, 0)),
        U=np.zeros((N, 0)),
        J=np.zeros((modes, 0, N)),
        Jv=np.zeros((modes, 0, 0)),
        nx=N,
        nr=0,
    )


def joined(pairs: list[tuple[int, int]]) -> Graph:
    """A node for each mode."""
    nodes = max(max(pair) for pair in pairs) + 1
    return Graph(tuple((Key(i + 1),) for i in range(nodes)), np.array([(i, j, i) for i, j in pairs], dtype=np.intp))


EVERY = joined([(0, 0), (0, 1), (1, 0), (1, 1)])


# -- known joint spectral radii


@pytest.mark.parametrize("scale", [0.6, 0.7])
def test_two_shears_grow_by_the_golden_ratio_in_turn(scale: float) -> None:
    found = find_witness(by_hand(scale * SHEARS), EVERY)
    assert found.modes == (0, 1)
    assert found.delays == (1, 2)
    assert found.growth == pytest.approx(scale * GOLDEN, rel=1e-12)


def test_commuting_modes_grow_no_faster_than_the_faster() -> None:
    F = np.array([np.diag([0.9, 0.3]), np.diag([0.2, 0.8])])
    assert find_witness(by_hand(F), EVERY).growth == pytest.approx(0.9)


def test_cycles_keep_to_the_graph() -> None:
    F = np.array([[[2.0, 0.0], [0.0, 0.1]], [[0.5, 1.0], [1.0, 0.5]], [[0.1, 0.0], [0.0, 0.1]]])
    ring = joined([(0, 1), (1, 2), (2, 0)])  # mode 0 for ever would double
    found = find_witness(by_hand(F), ring, SMALL, polish=True)
    assert found.modes == (0, 1, 2)
    assert found.growth == pytest.approx(spectral_radius(F[2] @ F[1] @ F[0]) ** (1 / 3))


@pytest.mark.parametrize("transitions", ["any", "fifo"])
@pytest.mark.parametrize("seed", range(4))
def test_no_cycle_of_up_to_six_samples_grows_faster(seed: int, transitions: Transitions) -> None:
    rng = np.random.default_rng(seed)
    gains = random_gains(rng, nx=2, nu=1 + seed % 2, gain=float(rng.uniform(0.1, 1.5)))
    switched = eq9(gains, seed % 2, 3)
    edges = graph(switched, gains, transitions)
    found = find_witness(switched, edges, SMALL, polish=True)
    allowed = successors(edges, len(switched.modes))
    F = state_loop(switched).F
    for length in range(1, 7):
        for cycle in product(range(len(F)), repeat=length):
            if all(allowed[i, j] for i, j in pairwise((*cycle, cycle[0]))) and cycle[0] == min(cycle):
                assert growth(F, cycle) <= found.growth * (1 + 1e-9)


def growth(F: Matrix, cycle: tuple[int, ...]) -> float:
    whole = np.eye(F.shape[1])
    for i in cycle:
        whole = F[i] @ whole
    return float(spectral_radius(whole) ** (1.0 / len(cycle)))


# -- the loops of the paper


@pytest.mark.parametrize("transitions", ["any", "fifo"])
@pytest.mark.parametrize(
    ("name", "d_max", "expected", "length"), [("pendulum-paper", 7, 1.0017, 21), ("hirm-paper", 5, 1.0050, 9)]
)
def test_published_gains_diverge_one_sample_beyond_what_is_proved(
    name: str, d_max: int, expected: float, length: int, transitions: Transitions
) -> None:
    gains = load_gains(name)
    found = search(gains, d_max, transitions)
    assert expected <= found.growth <= expected + 0.0002
    assert len(found.delays) == length
    assert all(after <= d + 1 for d, after in pairwise((*found.delays, found.delays[0])))
    assert confirm(gains, found.delays) == pytest.approx(found.growth, rel=1e-9)
    assert confirm(gains, found.delays) > 1.0


@pytest.mark.parametrize(("name", "d_max"), [("pendulum-paper", 6), ("hirm-paper", 4)])
def test_nothing_found_grows_where_stability_is_proved(name: str, d_max: int) -> None:
    found = search(load_gains(name), d_max, "any")
    assert 0.98 < found.growth < 0.99
    assert found.delays == (1,)


def search(gains: Gains, d_max: int, transitions: Transitions) -> Found:
    switched = eq9(gains, 1, d_max)
    return find_witness(switched, graph(switched, gains, transitions))


# -- what the search promises


def test_search_is_reproduced_by_its_seed_and_needs_no_memory() -> None:
    gains = load_gains("hirm-paper")
    switched = eq9(gains, 1, 5)
    first = find_witness(switched, graph(switched, gains, "fifo"), SMALL, polish=True, seed=1)
    assert find_witness(switched, graph(switched, gains, "fifo", 1), SMALL, polish=True, seed=1) == first


def test_given_start_is_examined_and_no_other_where_it_grows() -> None:
    gains = load_gains("pendulum-paper")
    switched = eq9(gains, 1, 7)
    start = [1, *range(7), *[6] * 13]  # in rotation
    found = find_witness(switched, graph(switched, gains, "fifo"), starts=[start, [0, 6]])
    assert found.products == 8
    assert found.delays == (1, *range(1, 7), *[7] * 14) or found.growth > 1.0


def test_norm_is_free_to_choose() -> None:
    gains = load_gains("hirm-paper")
    switched = eq9(gains, 1, 5)
    found = find_witness(switched, graph(switched, gains, "any"), P=np.diag(np.arange(1.0, switched.N - 2)))
    assert found.growth > 1.005


def test_predictions_of_the_reference_are_one_mode_to_the_state() -> None:
    gains = load_gains("hirm-paper")
    flown, plain = as_flown(gains, 1, 3, (0, 2)), eq9(gains, 1, 3)
    found = find_witness(flown, graph(flown, gains, "any"), SMALL, polish=True)
    expected = find_witness(plain, graph(plain, gains, "any"), SMALL, polish=True)
    assert found.delays == expected.delays
    assert found.products == expected.products
    assert found.growth == pytest.approx(expected.growth)


def test_schedule_is_searched_and_confirmed_with_the_sets_of_its_commands() -> None:
    low = replace(random_gains(np.random.default_rng(7), nu=2, nr=0, gain=0.5), d_min=0, d_max=1)
    high = replace(low, d_min=1, d_max=3, K1=-low.K1)
    law = Schedule("two", low.model, (low, high))
    switched = eq9(law, 0, 3)
    found = find_witness(switched, graph(switched, law, "fifo"), SMALL, polish=True)
    keys = [Key(switched.modes[i].d, switched.modes[i].gain_set) for i in found.modes]
    assert {key.gain_set for key in keys} == {0, 1}
    assert confirm(law, keys) == pytest.approx(found.growth, rel=1e-9)
    assert max(confirm(own, (d,)) for own in law.sets for d in range(4)) < found.growth


@given(st.lists(st.integers(0, 3), min_size=1, max_size=6), st.integers(1, 3), st.integers(0, 5))
def test_primitive_period_is_the_same_for_every_rotation_and_repetition(
    cycle: list[int], times: int, turn: int
) -> None:
    found = primitive(cycle)
    assert primitive((cycle[turn:] + cycle[:turn]) * times) == found
    assert found[0] == min(cycle)
    assert len(cycle) % len(found) == 0


# -- multiple precision


@pytest.mark.parametrize("seed", range(5))
def test_confirmed_growth_is_that_of_the_lifted_product(seed: int) -> None:
    rng = np.random.default_rng(seed)
    gains = random_gains(rng, nu=1 + seed % 3, gain=0.5)
    switched = state_loop(eq9(gains, 0, 4))
    cycle = tuple(rng.integers(5, size=7).tolist())
    assert confirm(gains, cycle, digits=40) == pytest.approx(growth(switched.F, cycle), rel=1e-9)


def test_confirmed_growth_of_a_constant_delay_is_the_eigenvalue_to_the_last_bit() -> None:
    gains = load_gains("pendulum-paper")
    with mpmath.workdps(40):
        eigenvalues = mpmath.eig(mpmath.matrix(state_loop(eq9(gains, 5, 5)).F[0].tolist()), left=False, right=False)
        expected = float(max(abs(value) for value in eigenvalues))
    assert confirm(gains, (5,)) == expected


@pytest.mark.parametrize(("pole", "expected"), [(1.0 + 2.0**-50, 1.0 + 2.0**-50), (1.0, 1.0), (0.5, 0.5), (0.0, 0.0)])
def test_confirmed_growth_tells_the_least_growth_from_none(pole: float, expected: float) -> None:
    A = np.array([[pole, 1.0], [0.0, pole]])  # one eigenvector: the norm of its powers tends slowly
    still = replace(FEASIBLE, model=replace(FEASIBLE.model, A=A), K1=np.zeros((1, 2)))
    assert confirm(still, (1, 3, 2)) == expected


def test_cancellation_beyond_the_digits_refutes_no_stable_loop() -> None:
    a = np.array([2.0**200, -(2.0**200) + 2.0**150, -(2.0**150) + 2.0**100, -(2.0**100) + 2.0**50, -(2.0**50) + 1.0])
    A, B, E, C, D = 0.5 * np.outer(np.ones(5), a), np.zeros((5, 1)), np.zeros((5, 0)), np.eye(1, 5), np.zeros((1, 1))
    model = Model("cancelling", 0.1, A, B, E, C, D, tuple("abcde"), Trim(np.zeros(5), np.zeros(1)))
    assert confirm(Gains("cancelling", model, 1, 1, np.zeros((1, 5))), [1]) <= 1.0  # the spectral radius is 0.5


def test_an_entry_that_is_small_beside_its_row_and_column_is_not_lost() -> None:
    A = np.array([[0.5, 0, 0], [1e15, 0.5, 0], [0, 0, 0.5]])
    B = np.array([[0.0, 1, 0], [0, 0, 0], [0, 0, 0]])
    K1 = np.array([[0.1, 0, 0.1], [0.1, 2e-15, 0.1], [0, 1, 0]])
    model = Model(
        "steep",
        0.1,
        A,
        B,
        np.zeros((3, 0)),
        np.eye(1, 3),
        np.zeros((1, 3)),
        ("a", "b", "c"),
        Trim(np.zeros(3), np.zeros(3)),
    )
    assert decide(Gains("steep", model, 1, 2, K1), 1, 2).verdict == "unstable"
