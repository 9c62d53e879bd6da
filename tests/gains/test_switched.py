"""The lifting over K1 x against the lifting over x, and against the equations run sample by sample; the graph."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gains.lower_gain import periodic_gain
from gains.model import Gains, Matrix, Schedule, Uncertainty, spectral_radius
from gains.switched import Graph, Key, Switched, Transitions, as_flown, eq9, factor, graph, state_loop
from tests.gains.lifted import full_state, run_eq9, run_flown, run_switched, with_delta
from tests.gains.loops import random_gains

seeds = st.integers(0, 2**32 - 1)
windows = st.sampled_from([(0, 0), (0, 1), (0, 3), (1, 1), (1, 4), (2, 3)])
few = settings(max_examples=40, deadline=None)


def loop(rng: np.random.Generator) -> Gains:
    """One or more inputs and outputs, with feedthrough; with or without reference; K1 of any rank, none included."""
    nu = int(rng.integers(1, 4))
    gains = random_gains(rng, int(rng.integers(1, 4)), nu, int(rng.integers(1, 3)), int(rng.integers(0, 3)))
    rank = int(rng.integers(0, nu + 1))
    return replace(gains, K1=rng.normal(size=(nu, rank)) @ gains.K1[:rank] if rank < nu else gains.K1)


def schedule(rng: np.random.Generator) -> Schedule:
    """Two sets, for 1 to 2 and for 2 to 4 samples."""
    low = replace(random_gains(rng, 3, 2, 2, 2), d_min=1, d_max=2)
    high = replace(low, d_min=2, d_max=4, K1=0.5 * low.K1 + 0.01, K2=-low.K2 if low.K2 is not None else None)
    return Schedule("two", low.model, (low, high))


def keys_of(switched: Switched) -> list[Key]:
    return [Key(mode.d, mode.gain_set) for mode in switched.modes]


# -- the matrices


@few
@given(seeds, windows)
def test_lifting_over_the_gains_has_the_spectrum_and_the_gain_of_lifting_over_the_states(
    seed: int, window: tuple[int, int]
) -> None:
    rng = np.random.default_rng(seed)
    gains = loop(rng)
    switched, full = eq9(gains, *window), full_state(gains, *window)
    assert keys_of(switched) == keys_of(full)
    saved = full.N - switched.N  # a rank that is lost to within rounding only may not be made use of
    assert (gains.model.nx - min(gains.K1.shape)) * window[1] <= saved
    assert saved <= (gains.model.nx - np.linalg.matrix_rank(gains.K1)) * window[1]
    cycle = rng.integers(len(switched.modes), size=int(rng.integers(1, 6))).tolist()
    radius, expected = (spectral_radius(product_of(form.F, cycle)) for form in (switched, full))
    assert radius == pytest.approx(expected, rel=1e-6, abs=1e-6)
    assert periodic_gain(switched, cycle) == pytest.approx(periodic_gain(full, cycle), rel=1e-5)


@few
@given(seeds, windows)
def test_switched_form_follows_equations_4_8_and_9(seed: int, window: tuple[int, int]) -> None:
    rng = np.random.default_rng(seed)
    gains = loop(rng)
    switched = eq9(gains, *window)
    check(switched, rng, lambda keys, _, v: run_eq9(gains, keys, v))


@few
@given(seeds, windows, st.sampled_from([(0,), (2,), (0, 1, 3)]))
def test_form_as_flown_follows_whole_commands_that_are_late(
    seed: int, window: tuple[int, int], aheads: tuple[int, ...]
) -> None:
    rng = np.random.default_rng(seed)
    gains = loop(rng)
    switched = as_flown(gains, *window, aheads)
    check(switched, rng, lambda keys, ahead, v: run_flown(gains, keys, ahead, v))


@pytest.mark.parametrize("seed", range(5))
def test_every_set_of_a_schedule_is_followed_in_both_forms(seed: int) -> None:
    rng = np.random.default_rng(seed)
    law = schedule(rng)
    check(eq9(law, 1, 4), rng, lambda keys, _, v: run_eq9(law, keys, v))
    check(as_flown(law, 1, 4, (0, 2)), rng, lambda keys, ahead, v: run_flown(law, keys, ahead, v))


def check(
    switched: Switched,
    rng: np.random.Generator,
    run: Callable[[Sequence[Key], Sequence[int], Matrix], Matrix],
) -> None:
    modes = rng.integers(len(switched.modes), size=30).tolist()
    v = rng.normal(size=(30, switched.m))
    expected = run([keys_of(switched)[i] for i in modes], [switched.modes[i].ahead for i in modes], v)
    assert run_switched(switched, modes, v) == pytest.approx(expected, rel=1e-9, abs=1e-9)


@few
@given(seeds, windows, st.booleans())
def test_uncertainty_enters_as_a_perturbed_plant(seed: int, window: tuple[int, int], flown: bool) -> None:
    rng = np.random.default_rng(seed)
    gains = loop(rng)
    model, delta_max = gains.model, 0.3
    F, J1, J2 = rng.normal(size=(model.nx, 2)), rng.normal(size=(3, model.nx)), rng.normal(size=(3, model.nu))
    gains = replace(gains, model=replace(model, uncertainty=Uncertainty(F, J1, J2, 1.0)))
    delta = rng.normal(size=(2, 3))
    change = delta_max * F @ delta
    moved = replace(gains, model=replace(model, A=model.A + change @ J1, B=model.B + change @ J2))

    def form(law: Gains, bound: float) -> Switched:
        return as_flown(law, *window, (0, 2), bound) if flown else eq9(law, *window, bound)

    uncertain, expected = form(gains, delta_max), form(moved, 0.0)
    assert uncertain.robust
    assert not expected.robust
    closed = with_delta(uncertain, delta)
    assert pytest.approx(expected.F, abs=1e-12) == closed.F
    assert pytest.approx(expected.G, abs=1e-12) == closed.G


@pytest.mark.parametrize("rank", range(4))
def test_factors_multiply_to_the_gains_with_as_many_rows_as_the_rank(rank: int) -> None:
    rng = np.random.default_rng(rank)
    K1 = (rng.integers(1, 9, size=(4, rank)) @ rng.integers(-8, 9, size=(rank, 3))).astype(np.float64)
    L, R = factor(K1)
    assert R.shape == (rank, 3)
    np.testing.assert_allclose(L @ R, K1, rtol=1e-15 * 16)


def test_what_is_small_beside_its_row_and_column_is_kept() -> None:
    K1 = np.array([[0.1, 0.0, 0.1], [0.1, 2e-15, 0.1], [0.0, 1.0, 0.0]])  # dropping 2e-15 makes another law of it
    L, R = factor(K1)
    np.testing.assert_allclose(L @ R, K1, rtol=16 * np.finfo(float).eps, atol=0.0)


@pytest.mark.parametrize("shape", [(1, 3), (2, 2), (3, 3), (3, 2)])
def test_factors_of_full_rank_are_exact(shape: tuple[int, int]) -> None:
    K1 = np.random.default_rng(0).normal(size=shape)
    L, R = factor(K1)
    assert np.array_equal(L @ R, K1)


@few
@given(seeds, windows)
def test_loop_over_the_state_has_the_spectrum_without_that_of_the_reference(seed: int, window: tuple[int, int]) -> None:
    rng = np.random.default_rng(seed)
    gains = random_gains(rng, nr=2)
    switched = eq9(gains, *window)
    part = state_loop(switched)
    assert (part.N, part.nr, part.m) == (switched.N - 2, 0, 0)
    assert gains.model.reference is not None
    cycle = rng.integers(len(switched.modes), size=3).tolist()
    of_reference = spectral_radius(np.linalg.matrix_power(gains.model.reference.Ar, 3))
    radius = max(spectral_radius(product_of(part.F, cycle)), of_reference)
    assert spectral_radius(product_of(switched.F, cycle)) == pytest.approx(radius, rel=1e-6)


def product_of(F: Matrix, cycle: Sequence[int]) -> Matrix:
    whole = np.eye(F.shape[1])
    for i in cycle:
        whole = F[i] @ whole
    return whole


# -- which mode may follow which


def admissible(path: Sequence[Key], transitions: Transitions) -> bool:
    return all(after.d <= key.d + 1 or transitions == "any" for key, after in pairwise(path))


@pytest.mark.parametrize("transitions", ["any", "fifo"])
@pytest.mark.parametrize("memory", [0, 1, 2])
@pytest.mark.parametrize(("d_min", "d_max"), [(0, 2), (1, 1), (1, 4)])
def test_graph_holds_every_admissible_path_and_joins_each_to_all_that_continue_it(
    transitions: Transitions, memory: int, d_min: int, d_max: int
) -> None:
    gains = random_gains(np.random.default_rng(0))
    switched = eq9(gains, d_min, d_max)
    found = graph(switched, gains, transitions, memory)
    keys = [Key(d) for d in range(d_min, d_max + 1)]
    expected = {path for path in product(keys, repeat=memory + 1) if admissible(path, transitions)}
    assert len(found.paths) == len(expected)
    assert set(found.paths) == expected
    joined = {
        (path, (*path, after)[1:]) for path in expected for after in keys if admissible((path[-1], after), transitions)
    }
    assert {(found.paths[i], found.paths[j]) for i, j, _ in found.edges} == joined
    assert len(found.edges) == len(joined)
    assert all(switched.modes[mode].d == found.paths[i][-1].d for i, _, mode in found.edges)


def test_every_prediction_of_the_reference_is_an_edge_of_its_own() -> None:
    gains = random_gains(np.random.default_rng(0))
    switched = as_flown(gains, 1, 3, (0, 1, 2))
    found = graph(switched, gains, "any")
    assert len(found.paths) == 3
    assert sorted(switched.modes[mode].ahead for *_, mode in found.edges) == sorted([0, 1, 2] * 9)


def test_command_that_is_held_keeps_its_set_and_a_new_one_fits_its_window_within_a_sample() -> None:
    law = schedule(np.random.default_rng(0))  # 1 to 2 and 2 to 4 samples
    followed = follows(graph(eq9(law, 1, 4), law, "fifo"))
    assert followed[Key(1, 0)] == {Key(1, 0), Key(1, 1), Key(2, 0)}
    assert followed[Key(3, 0)] == {*(Key(d, i) for d in (1, 2, 3) for i in (0, 1)), Key(4, 0)}
    assert followed[Key(4, 0)] == {*(Key(d, i) for d in (1, 2, 3) for i in (0, 1)), Key(4, 1)}


def follows(found: Graph) -> dict[Key, set[Key]]:
    return {path[-1]: {found.paths[j][-1] for i, j, _ in found.edges if found.paths[i] == path} for path in found.paths}
