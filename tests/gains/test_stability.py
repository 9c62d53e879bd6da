"""Stability under switching: known joint spectral radii, known bounds, the paper's loops, and simulation."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from gains.extremal import grow, subset_graph
from gains.model import Gains, Matrix, Model, Schedule, Trim, spectral_radius
from gains.quadratic import common_quadratic, lyapunov_quadratic
from gains.stability import (
    Budget,
    Part,
    Stability,
    parts_of,
    prove,
    prove_contraction,
    prove_paths,
    prove_quadratic,
    prove_tree,
    steps,
    tighten,
)
from gains.store import load_gains
from gains.switched import Graph, Key, Mode, Switched, Transitions, as_flown, eq9, graph, state_loop
from gains.verify_stability import check_blocks, check_contraction

GOLDEN = (1.0 + math.sqrt(5.0)) / 2.0
# joint spectral radius GOLDEN, reached by the product of both; the Euclidean norm is extremal
SHEARS = np.array([[[1.0, 1.0], [0.0, 1.0]], [[1.0, 0.0], [1.0, 1.0]]])
# joint spectral radius 1, but no quadratic norm is below sqrt(2): Ando and Shih (1998)
ANDO_SHIH = np.array([[[1.0, 0.0], [1.0, 0.0]], [[0.0, 1.0], [0.0, -1.0]]])
QUICK = Budget(products=20_000, memory=-1)


def free(F: Matrix) -> Part:
    """Any matrix may follow any."""
    count = len(F)
    edges = np.array([(i, j, i) for i in range(count) for j in range(count)], dtype=np.intp)
    return Part(tuple(range(F.shape[1])), F, edges)


def switched_of(F: Matrix) -> Switched:
    count, N, _ = F.shape
    none = np.zeros((count, 0, 0))
    rows, columns = np.zeros((count, 0, N)), np.zeros((count, N, 0))
    return Switched(tuple(Mode(i) for i in range(count)), F, columns, rows, none, np.zeros((N, 0)), rows, none, N, 0)


def walks_of(part: Part) -> Graph:
    return Graph(tuple((Key(i),) for i in range(int(part.edges[:, :2].max()) + 1)), part.edges)


def scalar_loop(a: float, bk: float, d_min: int = 1, d_max: int = 3) -> Gains:
    one = np.ones((1, 1))
    model = Model("scalar", 0.1, a * one, one, one, one, 0 * one, ("x",), Trim(np.zeros(1), np.zeros(1)))
    return Gains("scalar", model, d_min, d_max, bk * one)


def verified(found: Stability, switched: Switched, law: Gains, transitions: Transitions) -> bool:
    if found.contraction is not None:
        return check_contraction(law, found.contraction).passed
    F = np.asarray(state_loop(switched).F)
    edges = graph(switched, law, transitions, found.memory).edges
    return check_blocks(F, 1e-15 * np.abs(F), edges, found.blocks).passed


# -- analytic cases


def test_the_best_common_form_of_two_shears_has_the_golden_rate() -> None:
    assert common_quadratic(SHEARS).rate == pytest.approx(GOLDEN, rel=1e-3)
    assert common_quadratic(SHEARS).rate >= GOLDEN * (1 - 1e-12)


@pytest.mark.parametrize("scale", [0.999, 0.9])
def test_shears_scaled_below_their_joint_spectral_radius_are_proved(scale: float) -> None:
    part = free(SHEARS * scale / GOLDEN)
    form = prove_quadratic(part, 1e-5)
    assert form.rate < 1.0 or prove_tree(part, form.P, 10_000).closed


def test_shears_scaled_above_their_joint_spectral_radius_are_not_proved() -> None:
    part = free(SHEARS * 1.001 / GOLDEN)
    form = prove_quadratic(part, 1e-5)
    assert form.rate > 1.0
    assert not prove_tree(part, form.P, 10_000).closed
    upper, spent = tighten(part, form, 10_000)
    assert 1.001 * (1 - 1e-9) <= upper <= form.rate
    assert spent <= 10_000 + 4 * 2000


def test_the_common_rate_of_ando_and_shih_is_the_square_root_of_two() -> None:
    assert common_quadratic(ANDO_SHIH, 1e-4).rate == pytest.approx(math.sqrt(2.0), rel=2e-4)


def test_a_tree_proves_what_no_common_form_can() -> None:
    part = free(0.95 * ANDO_SHIH)
    form = prove_quadratic(part)
    assert form.rate > 1.3
    tree = prove_tree(part, form.P, 1000)
    assert tree.closed
    assert 0.95 * (1 - 1e-9) <= tree.upper < 1.0


def test_a_form_for_each_mode_proves_what_no_common_form_can() -> None:
    part = free(0.95 * ANDO_SHIH)
    several = prove_paths(part, prove_quadratic(part))
    assert several is not None
    assert several.rate < 1.0
    assert several.P.shape == (2, 2, 2)


def test_commuting_normal_matrices_have_their_largest_spectral_radius() -> None:
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    F = np.array([turn @ np.diag(d) @ turn.T for d in ([0.9, -0.3, 0.2], [0.1, 0.95, -0.7])])
    assert common_quadratic(F).rate == pytest.approx(0.95, rel=1e-3)


@pytest.mark.parametrize("unit", [1.0, 2.0**20])
def test_a_rate_does_not_depend_on_units(unit: float) -> None:
    t = np.array([1.0, unit])
    found = common_quadratic(SHEARS / t[:, None] * t)
    assert found.rate == pytest.approx(GOLDEN, rel=1e-3)


def test_one_matrix_is_proved_by_a_lyapunov_equation_up_to_its_spectral_radius() -> None:
    F = np.array([[0.999, 1e4], [0.0, 0.999]])
    found = lyapunov_quadratic(F)
    assert found is not None
    assert 0.999 <= found.rate < 1.0
    assert lyapunov_quadratic(F / 0.998) is None


def test_a_graph_that_forbids_repetition_is_proved_where_free_switching_diverges() -> None:
    F = np.array([[[2.0]], [[0.4]]])
    apart = Part((0,), F, np.array([(0, 1, 0), (1, 0, 1), (1, 1, 1)], dtype=np.intp))
    tree = prove_tree(apart, np.ones((1, 1, 1)), 1000)
    assert tree.closed
    assert tree.upper == pytest.approx(math.sqrt(0.8), rel=1e-9)
    assert not prove_tree(free(F), np.ones((1, 1, 1)), 1000).closed


def test_a_tree_with_a_norm_for_each_node_closes_at_once_where_the_norms_fall() -> None:
    F = np.array([[[2.0]], [[0.4]]])
    edges = np.array([(0, 1, 0), (1, 0, 1)], dtype=np.intp)
    tree = grow(F, edges, np.array([[[1.0]], [[0.2]]]), 1000)
    assert tree.closed
    assert (tree.products, tree.depth) == (2, 1)
    assert tree.upper == pytest.approx(math.sqrt(0.8))


def test_the_subset_graph_reads_every_sequence_once() -> None:
    any_of_three = free(np.zeros((3, 1, 1))).edges
    assert subset_graph(any_of_three).tolist() == [[0, 0, 0], [0, 0, 1], [0, 0, 2]]
    law = scalar_loop(0.5, 0.1, 1, 4)
    walks = graph(eq9(law, 1, 4), law, "fifo", 1).edges
    words = {(a,) for _, _, a in walks.tolist()}
    arcs = subset_graph(walks)
    reached = {0: [()]}
    for _ in range(3):
        longer: dict[int, list[tuple[int, ...]]] = {}
        for node, after, a in arcs.tolist():
            for word in reached.get(node, []):
                longer.setdefault(after, []).append((*word, a))
        reached = longer
    words = [word for found in reached.values() for word in found]
    admissible = {(a, b, c) for a in range(4) for b in range(4) for c in range(4) if b <= a + 1 and c <= b + 1}
    assert len(words) == len(set(words)) == len(admissible)
    assert set(words) == admissible


def test_equal_products_at_a_tight_budget_are_deterministic() -> None:
    part = free(1.001 / GOLDEN * SHEARS)
    P = prove_quadratic(part).P
    assert prove_tree(part, P, 3000) == prove_tree(part, P, 3000)


# -- blocks


def test_blocks_come_in_an_order_in_which_none_depends_on_a_later_one() -> None:
    F = np.zeros((2, 4, 4))
    F[:, 0, 0], F[:, 2, 2] = 0.5, 0.3
    F[0, 1, 3] = F[1, 3, 1] = 0.5  # strongly connected over both modes only
    F[0, 0, 1], F[1, 3, 2] = 1e6, 1e6
    parts = parts_of(switched_of(F), walks_of(free(F)))
    assert [part.states for part in parts] == [(2,), (1, 3), (0,)]
    assert [len(part.F) for part in parts] == [1, 2, 1]


def test_strong_coupling_between_blocks_does_not_matter() -> None:
    F = np.array([[[0.9, 0.0], [1e8, -0.9]], [[0.9, 0.0], [-1e8, 0.9]]])
    found = [prove_quadratic(part) for part in parts_of(switched_of(F), walks_of(free(F)))]
    assert max(form.rate for form in found) < 1.0


# -- laws


def test_a_contraction_is_proved_for_every_bounded_delay() -> None:
    law = scalar_loop(0.5, -0.4)
    v = prove_contraction(law)
    assert v is not None
    assert check_contraction(law, v).passed
    found = prove(eq9(law, 0, 3), law, "any")
    assert found.contraction is not None
    assert 0.5 < found.upper < 1.0
    assert prove_contraction(scalar_loop(0.5, -0.5)) is None
    assert prove_contraction(scalar_loop(0.5, 0.6)) is None


def test_the_contraction_of_a_schedule_takes_the_larger_gains() -> None:
    low, high = scalar_loop(0.5, 0.1, 1, 1), scalar_loop(0.5, -0.4, 2, 3)
    law = Schedule("two", low.model, (low, replace(high, model=low.model)))
    v = prove_contraction(law)
    assert v is not None
    assert check_contraction(law, v).passed
    steep = Schedule("two", low.model, (low, replace(high, model=low.model, K1=np.array([[0.6]]))))
    assert prove_contraction(steep) is None


@pytest.mark.parametrize("transitions", ["any", "fifo"])
@pytest.mark.parametrize(("name", "d_max", "rate"), [("pendulum-paper", 6, 0.991), ("hirm-paper", 4, 0.9886)])
def test_the_papers_loops_are_proved_by_a_common_form(
    name: str, d_max: int, rate: float, transitions: Transitions
) -> None:
    law = load_gains(name)
    loop = eq9(law, 1, d_max)
    found = prove(loop, law, transitions)
    assert [block.kind for block in found.blocks].count("quadratic") == len(found.blocks) > 0
    assert found.upper <= rate
    assert verified(found, loop, law, transitions)


@pytest.mark.parametrize(("name", "d_max"), [("pendulum-paper", 7), ("hirm-paper", 5)])
def test_one_sample_more_is_not_proved_and_the_bound_stays_above_one(name: str, d_max: int) -> None:
    law = load_gains(name)
    found = prove(eq9(law, 1, d_max), law, "fifo", QUICK)
    assert not found.proved
    assert 1.0017 < found.upper < 1.02
    assert found.products >= QUICK.products
    assert found.solves > 0


def test_the_law_as_flown_has_the_state_loop_of_eq_9() -> None:
    law = load_gains("hirm-paper")
    loop = as_flown(law, 1, 4, (1, 2, 3))
    found = prove(loop, law, "any")
    assert found.proved
    assert verified(found, loop, law, "any")
    assert found.upper == pytest.approx(prove(eq9(law, 1, 4), law, "any").upper, rel=2e-3)


def test_a_constant_delay_is_decided_by_its_spectral_radius() -> None:
    law = load_gains("pendulum-paper")
    assert prove(eq9(law, 7, 7), law, "any", QUICK).proved  # 0.9924
    found = prove(eq9(law, 8, 8), law, "any", QUICK)  # 1.0087
    assert not found.proved
    assert found.upper >= spectral_radius(np.asarray(state_loop(eq9(law, 8, 8)).F[0])) > 1.0


def test_no_tree_is_grown_where_a_constant_delay_diverges() -> None:
    law = load_gains("hirm-paper")
    trace = list(steps(eq9(law, 1, 6), law, "any", QUICK))
    assert not trace[-1].proved
    assert trace[2].products == trace[3].products == 0


def near_the_edge(seed: int) -> tuple[Gains, Transitions]:
    """A random loop with its gains scaled so that the worst constant delay nearly diverges."""
    rng = np.random.default_rng(seed)
    nx = int(rng.integers(1, 4))
    A, B = rng.normal(size=(nx, nx)), rng.normal(size=(nx, 1))
    A *= rng.uniform(0.7, 1.0) / spectral_radius(A)
    model = replace(
        scalar_loop(0.0, 0.0).model,
        A=A,
        B=B,
        E=B,
        C=B.T,
        states=tuple("abc"[:nx]),
        trim=Trim(np.zeros(nx), np.zeros(1)),
    )
    K = rng.normal(size=(1, nx))
    d_min, d_max = int(rng.integers(0, 2)), int(rng.integers(2, 5))
    for scale in np.geomspace(3.0, 1e-3, 40):
        law = Gains("edge", model, d_min, d_max, scale * K)
        if max(spectral_radius(F) for F in np.asarray(eq9(law, d_min, d_max).F)) < 0.96:
            break
    return law, ("any", "fifo")[seed % 2]


@pytest.mark.parametrize("seed", range(12))
def test_what_is_proved_passes_verification_and_survives_random_delays(seed: int) -> None:
    law, transitions = near_the_edge(seed)
    loop = eq9(law, law.d_min, law.d_max)
    found = prove(loop, law, transitions, QUICK)
    if not found.proved:
        assert found.upper > 1.0 - 1e-6
        return
    assert verified(found, loop, law, transitions)
    rng = np.random.default_rng(seed)
    runs, A, BK = 200, law.model.A, law.model.B @ law.K1
    x = rng.normal(size=(law.d_max + 1, runs, law.model.nx))
    first, d = np.abs(x).max(), rng.integers(law.d_min, law.d_max + 1, size=runs)
    for _ in range(600):
        free_choice = rng.integers(law.d_min, law.d_max + 1, size=runs)
        d = np.minimum(free_choice, d + 1) if transitions == "fifo" else free_choice
        x = np.concatenate([(x[0] @ A.T + x[d, np.arange(runs)] @ BK.T)[None], x[:-1]])
    assert np.abs(x).max() < first
