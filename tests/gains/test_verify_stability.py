"""Proofs of stability are re-checked: what passes, what is refused, and that the bounds on rounding are bounds."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from numpy.typing import NDArray

from gains import verify_stability
from gains.model import Gains, Matrix, Trim
from gains.stability import prove
from gains.store import load_gains
from gains.switched import eq9, graph, state_loop
from gains.switched_certificate import Block
from gains.verify_stability import check_blocks, check_contraction
from tests.gains.loops import FEASIBLE

Edges = NDArray[np.intp]
GOLDEN = (1.0 + math.sqrt(5.0)) / 2.0
SHEARS = np.array([[[1.0, 1.0], [0.0, 1.0]], [[1.0, 0.0], [1.0, 1.0]]])
ANDO_SHIH = np.array([[[1.0, 0.0], [1.0, 0.0]], [[0.0, 1.0], [0.0, -1.0]]])
FREE: Edges = np.array([(i, j, i) for i in range(2) for j in range(2)], dtype=np.intp)
APART: Edges = np.array([(0, 1, 0), (1, 0, 1)], dtype=np.intp)
EYE = np.eye(2)[None]


def block(P: Matrix, kind: str, states: tuple[int, ...] = (0, 1)) -> Block:
    return Block(states, kind, 0, P)


def passes(F: Matrix, blocks: list[Block], edges: Edges = FREE, error: float = 0.0) -> bool:
    return check_blocks(F, error * np.abs(F), edges, blocks).passed


@pytest.fixture(scope="module")
def hirm() -> tuple[Matrix, Edges, list[Block]]:
    law = load_gains("hirm-paper")
    loop = eq9(law, 1, 4)
    return np.asarray(state_loop(loop).F), graph(loop, law, "any").edges, list(prove(loop, law, "any").blocks)


# -- what is true passes


def test_a_common_form_passes_with_a_margin_above_its_rounding(hirm: tuple[Matrix, Edges, list[Block]]) -> None:
    F, edges, blocks = hirm
    found = check_blocks(F, 1e-15 * np.abs(F), edges, blocks)
    assert found.passed, found.reason
    assert 0.0 < found.rounding < found.margin
    assert found.reason == ""


@pytest.mark.parametrize("kind", ["quadratic", "tree"])
def test_shears_pass_just_below_their_joint_spectral_radius_only(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(verify_stability, "MAX_PRODUCTS", 5_000)
    assert passes((1.0 - 1e-9) / GOLDEN * SHEARS, [block(EYE, kind)], error=1e-16)
    assert not passes((1.0 + 1e-9) / GOLDEN * SHEARS, [block(EYE, kind)], error=1e-16)
    assert not passes((1.0 - 1e-9) / GOLDEN * SHEARS, [block(EYE, kind)], error=1e-8)


def test_a_tree_passes_where_no_form_does() -> None:
    assert not passes(0.9 * ANDO_SHIH, [block(EYE, "quadratic")])
    assert passes(0.9 * ANDO_SHIH, [block(EYE, "tree")])


def test_any_norm_will_do_for_a_tree(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(verify_stability, "MAX_PRODUCTS", 5_000)
    P = np.array([[[3.0, 1.0], [1.0, 2.0]]])
    assert passes(0.8 / GOLDEN * SHEARS, [block(P, "tree")])
    assert not passes(1.05 / GOLDEN * SHEARS, [block(P, "tree")])


@pytest.mark.parametrize("kind", ["paths", "tree"])
def test_a_form_for_each_node_is_held_to_its_graph(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(verify_stability, "MAX_PRODUCTS", 5_000)
    F, P = np.array([[[2.0]], [[0.4]]]), np.array([[[1.0]], [[0.2]]])
    assert passes(F, [block(P, kind, (0,))], APART)
    assert not passes(F, [block(P, kind, (0,))], FREE)
    assert not passes(F, [block(P[::-1], "paths", (0,))], APART)
    assert not passes(F * 1.2, [block(P, kind, (0,))], APART)


def test_units_do_not_matter_to_a_tree() -> None:
    t = np.array([1.0, 2.0**40])
    F = 0.9 * ANDO_SHIH / t[:, None] * t
    assert check_blocks(F, 1e-15 * np.abs(F), FREE, [block(EYE * t * t[:, None], "tree")]).passed


def test_a_mode_that_is_never_taken_does_not_matter() -> None:
    F = np.concatenate([0.9 / GOLDEN * SHEARS, 5.0 * EYE])
    for kind in ("quadratic", "tree"):
        assert passes(F, [block(EYE, kind)])


def test_the_trees_of_the_papers_loops_are_checked_quickly(hirm: tuple[Matrix, Edges, list[Block]]) -> None:
    F, edges, blocks = hirm
    trees = [replace(part, kind="tree", P=part.P + 0.2 * np.eye(len(part.states)) * part.P) for part in blocks]
    found = check_blocks(F, 1e-14 * np.abs(F), edges, trees)
    assert found.passed, found.reason
    assert found.rounding < 1e-9


# -- what is not is refused


def _one_number(P: Matrix) -> Matrix:
    P = P.copy()
    P[0, 0, 0] /= 16.0
    return P


def _asymmetric(P: Matrix) -> Matrix:
    P = P.copy()
    P[0, 0, 1] *= 1.0 + 1e-15
    return P


def _not_a_number(P: Matrix) -> Matrix:
    P = P.copy()
    P[0, 1, 1] = math.nan
    return P


TAMPERED: dict[str, Callable[[Matrix], Matrix]] = {
    "one number": _one_number,
    "not symmetric": _asymmetric,
    "not a number": _not_a_number,
    "infinite": lambda P: P * math.inf,
    "negative": lambda P: -P,
    "zero": lambda P: 0.0 * P,
    "singular": lambda P: np.ones_like(P),
    "tiny": lambda P: P * 1e-110,
    "huge": lambda P: P * 1e110,
    "two": lambda P: np.concatenate([P, P]),
    "smaller": lambda P: P[:, :-1, :-1],
}


@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize("how", list(TAMPERED))
def test_a_tampered_form_is_refused(hirm: tuple[Matrix, Edges, list[Block]], how: str) -> None:
    F, edges, blocks = hirm
    largest = max(range(len(blocks)), key=lambda i: len(blocks[i].states))
    blocks = [replace(b, P=TAMPERED[how](b.P)) if i == largest else b for i, b in enumerate(blocks)]
    found = check_blocks(F, 0.0 * F, edges, blocks)
    assert not found.passed
    assert found.reason


@pytest.mark.parametrize("how", ["not symmetric", "not a number", "infinite", "negative", "zero", "singular", "two"])
@pytest.mark.filterwarnings("ignore:invalid value")
def test_a_tampered_norm_is_refused(how: str) -> None:
    P = np.array([[[3.0, 1.0], [1.0, 2.0]]])
    assert passes(0.8 / GOLDEN * SHEARS, [block(P, "tree")])
    extra = np.concatenate([FREE, [(2, 2, 0)]])  # three nodes: two norms are one too few
    assert not passes(0.8 / GOLDEN * SHEARS, [block(TAMPERED[how](P), "tree")], extra)


def test_the_blocks_must_be_a_partition_in_an_order_of_dependence() -> None:
    F = np.array([[[0.5, 0.0], [7.0, 0.5]]])
    edges: Edges = np.zeros((1, 3), dtype=np.intp)
    first, second = (block(np.ones((1, 1, 1)), "quadratic", (i,)) for i in range(2))
    assert passes(F, [first, second], edges)
    for wrong in ([second, first], [first], [second], [], [first, second, second], [first, first]):
        assert not passes(F, wrong, edges)
    assert not passes(F, [first, replace(second, states=(2,))], edges)
    assert not passes(F, [first, replace(second, kind="other")], edges)
    assert not check_blocks(F, np.full_like(F, 1e-300), edges, [first, second]).passed  # zero must be exact


def test_without_transitions_nothing_is_proved() -> None:
    assert not passes(0.5 * SHEARS, [block(EYE, "quadratic")], FREE[:0])


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e120])
def test_a_loop_out_of_range_is_refused(value: float) -> None:
    F = 0.5 * SHEARS
    F[0, 0, 1] = value
    assert not check_blocks(F, np.zeros_like(F), FREE, [block(EYE, "tree")]).passed
    error = np.zeros_like(F)
    error[0, 0, 0] = value
    assert not check_blocks(0.5 * SHEARS, error, FREE, [block(EYE, "quadratic")]).passed


def test_a_norm_that_is_ill_conditioned_beyond_rounding_is_refused() -> None:
    P = np.array([[[1.0, 1.0], [1.0, 1.0 + 1e-14]]])
    assert not passes(0.5 / GOLDEN * SHEARS, [block(P, "tree")])


# -- the bounds hold in exact arithmetic


@pytest.mark.parametrize("seed", range(5))
def test_the_bound_on_a_product_holds_against_exact_arithmetic(seed: int) -> None:
    rng = np.random.default_rng(seed)
    F, root = rng.normal(size=(2, 2, 2)), rng.normal(size=(2, 2))
    P = np.repeat((root @ root.T + 1e-3 * np.eye(2))[None], 2, axis=0)
    edges: Edges = np.array([(0, 1, 0), (1, 0, 1)], dtype=np.intp)
    steps = verify_stability._in_norms(F, np.zeros_like(F), edges, P)
    assert steps is not None
    unit = np.exp2(np.rint(np.log2(np.diag(P[0])) / 2))
    S = np.linalg.cholesky(P[0] / unit / unit[:, None]).T * unit  # the norm is |S x|, exactly
    exact = [_times(_times(_exact(S), _exact(F[a])), _inverse(_exact(S))) for a in range(2)]
    at = verify_stability._Products(np.eye(2)[None], np.zeros(1), np.zeros(1, dtype=np.intp), 0)
    product = _exact(np.eye(2))
    for k in range(6):
        at = verify_stability._grown(steps, at)
        product = _times(exact[k % 2], product)
        off = [product[i][j] - Fraction(float(at.X[0, i, j])) for i in range(2) for j in range(2)]
        distance = math.sqrt(float(sum(x * x for x in off)))
        assert distance <= float(at.error[0])
        assert float(at.error[0]) < 1e-8 * float(np.abs(at.X).max())


@pytest.mark.parametrize("n", [1, 2, 7, 12])
def test_the_norms_are_upper_bounds_and_tight_near_one(n: int) -> None:
    rng = np.random.default_rng(n)
    X = rng.normal(size=(500, n, n)) * (rng.random((500, 1, n)) < 0.5)
    true = np.linalg.norm(X, 2, axis=(1, 2))
    X *= (rng.uniform(0.9, 1.1, size=500) / np.maximum(true, 1e-3))[:, None, None]
    true = np.linalg.norm(X, 2, axis=(1, 2))
    found = verify_stability._norms(verify_stability._Products(X, np.zeros(500), np.zeros(500, dtype=np.intp), 0))
    assert np.all(found >= true)
    assert np.array_equal(found < 1.0, true < 1.0)


Exact = list[list[Fraction]]


def _exact(X: Matrix) -> Exact:
    return [[Fraction(float(value)) for value in row] for row in X]


def _times(X: Exact, Y: Exact) -> Exact:
    return [
        [sum((a * b for a, b in zip(row, column, strict=True)), Fraction(0)) for column in zip(*Y, strict=True)]
        for row in X
    ]


def _inverse(X: Exact) -> Exact:
    (a, b), (c, d) = X
    size = a * d - b * c
    return [[d / size, -b / size], [-c / size, a / size]]


# -- contraction


def test_a_contraction_passes_and_a_tampered_one_does_not() -> None:
    v = np.array([1.0, 1.0])
    found = check_contraction(FEASIBLE, v)  # |A| + |B K1| has rows of sum 0.55 and 0.275
    assert found.passed
    assert found.margin == pytest.approx(0.45)
    assert not check_contraction(FEASIBLE, np.array([1.0, 1000.0])).passed
    for wrong in ([1.0, math.nan], [1.0, math.inf], [1.0, -1.0], [0.0, 1.0], [1.0]):
        assert not check_contraction(FEASIBLE, np.array(wrong)).passed


@pytest.mark.parametrize(("bk", "passed"), [(0.5 - 1e-12, True), (0.5, False), (-0.5, False), (1e200, False)])
def test_a_contraction_must_be_strict(bk: float, passed: bool) -> None:
    one = np.ones((1, 1))
    model = replace(
        FEASIBLE.model, A=0.5 * one, B=one, E=one, C=one, states=("a",), trim=Trim(np.zeros(1), np.zeros(1))
    )
    assert check_contraction(Gains("edge", model, 1, 3, bk * one), np.ones(1)).passed is passed
