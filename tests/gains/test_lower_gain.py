"""Lower bounds on the gain: closed forms, frequency responses, finite horizons, another library, published numbers."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from gains.lower_gain import Ascent, constant_norms, periodic_gain, worst_gain
from gains.model import Gains, Matrix, augmented
from gains.store import load_gains
from gains.switched import Graph, Key, Mode, Switched, Transitions, as_flown, eq9, graph
from gains.witness import find_witness
from tests.gains.lifted import full_state
from tests.gains.loops import FEASIBLE, largest_gain, random_gains

HIRM = load_gains("hirm-paper")
SMALL = Ascent(exhaustive=2, kept=1, rounds=4, longest=8)


def by_hand(F: Matrix, G: Matrix, H: Matrix, Hv: Matrix) -> Switched:
    modes, N, m = G.shape
    none = np.zeros((modes, 0, N))
    delays = tuple(Mode(d) for d in range(1, modes + 1))
    return Switched(delays, F, G, H, Hv, U=np.zeros((N, 0)), J=none, Jv=np.zeros((modes, 0, m)), nx=N, nr=0)


def scalars(*modes: tuple[float, float, float, float]) -> Switched:
    """First-order modes (a, b, c, D): x⁺ = a x + b v, e = c x + D v."""
    a, b, c, D = (np.array(each).reshape(-1, 1, 1) for each in zip(*modes, strict=True))
    return by_hand(a, b, c, D)


def every_pair(modes: int) -> Graph:
    edges = [(i, j, i) for i, j in product(range(modes), repeat=2)]
    return Graph(tuple((Key(i + 1),) for i in range(modes)), np.array(edges, dtype=np.intp))


# -- closed forms


@pytest.mark.parametrize("a", [0.0, 0.3, 0.99, -0.3, -0.99])
def test_first_order_loop_has_its_gain_at_standstill_or_at_half_the_sampling_rate(a: float) -> None:
    expected = 1.5 / (1.0 - abs(a))
    found = periodic_gain(scalars((a, 0.5, 3.0, 0.0)), (0,))
    assert expected * (1.0 - 1e-6) <= found <= expected


def test_resonance_has_its_gain_at_its_own_frequency() -> None:
    r, angle = 0.999, 1.234
    turn = r * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    eye, none = np.eye(2)[None], np.zeros((1, 2, 2))
    found = periodic_gain(by_hand(turn[None], eye, eye, none), (0,))
    assert 1.0 / (1.0 - r) * (1.0 - 1e-6) <= found <= 1.0 / (1.0 - r)


def test_gain_without_memory_is_the_largest_feedthrough() -> None:
    switched = scalars((0.0, 0.0, 0.0, 2.0), (0.0, 0.0, 0.0, -3.0))
    assert constant_norms(switched) == [(1, pytest.approx(2.0)), (2, pytest.approx(3.0))]
    assert periodic_gain(switched, (0, 1)) == pytest.approx(3.0)


def test_switching_exceeds_both_constant_gains_where_one_mode_writes_and_the_other_reads() -> None:
    switched = scalars((0.0, 1.0, 2.0, 0.0), (0.0, 3.0, 1.0, 0.0))  # x⁺ = b v, e = c x
    assert constant_norms(switched) == [(1, pytest.approx(2.0)), (2, pytest.approx(3.0))]
    gain, cycle = worst_gain(switched, every_pair(2))
    assert gain == pytest.approx(6.0)
    assert cycle == (0, 1)


def test_period_is_one_loop_whatever_its_start_and_however_often_it_is_written() -> None:
    switched = eq9(HIRM, 1, 4)
    gain = periodic_gain(switched, (0, 1, 2, 3, 3))
    assert periodic_gain(switched, (2, 3, 3, 0, 1)) == gain
    assert periodic_gain(switched, (0, 1, 2, 3, 3) * 3) == gain


def test_gain_is_infinite_where_the_period_is_not_schur() -> None:
    assert periodic_gain(scalars((1.0, 1.0, 1.0, 0.0)), (0,)) == np.inf
    drifting = replace(HIRM, K1=np.zeros((1, 3)))  # the pitch integrator alone
    assert [norm for _, norm in constant_norms(eq9(drifting, 1, 2))] == [np.inf, np.inf]
    switched = eq9(HIRM, 1, 5)
    edges = graph(switched, HIRM, "fifo")
    witness = find_witness(switched, edges).modes
    gain, cycle = worst_gain(switched, edges, [witness], SMALL)
    assert gain == periodic_gain(switched, cycle) == np.inf


def test_gain_without_inputs_is_zero() -> None:
    still = replace(FEASIBLE, model=replace(FEASIBLE.model, E=np.zeros((2, 0))))
    switched = eq9(still, 1, 2)
    assert periodic_gain(switched, (0, 1)) == 0.0
    assert worst_gain(switched, graph(switched, still, "any"), effort=SMALL)[0] == 0.0


# -- other computations


@pytest.mark.parametrize("seed", range(4))
def test_constant_norms_are_the_peaks_of_the_frequency_response(seed: int) -> None:
    gains = random_gains(np.random.default_rng(seed), nu=2, ny=1 + seed % 2, gain=0.02)
    peaks = [(d, dense_peak(gains, d)) for d in range(4)]
    assert constant_norms(eq9(gains, 0, 3)) == [(d, pytest.approx(peak, rel=1e-5)) for d, peak in peaks]


def dense_peak(gains: Gains, d: int) -> float:
    """Largest singular value of C(z) (z I − A − A1 z^−d)⁻¹ B, C(z) = C + C1 z^−d, over 4000 angles."""
    loop = augmented(gains.model, gains.K1, gains.K2)
    z = np.exp(1j * np.linspace(0.0, np.pi, 4001))[:, None, None]
    states = np.linalg.solve(z * np.eye(loop.n) - loop.A - loop.A1 * z**-d, loop.B.astype(complex))
    return float(np.linalg.norm((loop.C + loop.C1 * z**-d) @ states, ord=2, axis=(1, 2)).max())


@pytest.mark.parametrize("seed", range(4))
def test_gain_of_a_period_is_what_long_horizons_rise_to(seed: int) -> None:
    rng = np.random.default_rng(seed)
    gains = random_gains(rng, nu=2, ny=2)
    cycle = tuple(rng.integers(4, size=5).tolist())
    found = periodic_gain(eq9(gains, 0, 3), cycle)
    short, long = (largest_gain(gains, np.array(cycle * times)) for times in (4, 24))
    assert short < long <= found
    assert long > 0.98 * found


def test_constant_norms_agree_with_slycot() -> None:
    control = pytest.importorskip("control")
    pytest.importorskip("slycot")
    for gains in (HIRM, random_gains(np.random.default_rng(0), nu=2, ny=2)):
        full = full_state(gains, 0, 4)
        for i, (_, norm) in enumerate(constant_norms(eq9(gains, 0, 4))):
            other, _ = control.linfnorm(control.ss(full.F[i], full.G[i], full.H[i], full.Hv[i], True), 1e-10)
            assert norm == pytest.approx(other, rel=2e-6)


# -- the loops of the paper


@pytest.mark.parametrize(
    ("d_max", "least", "upper"), [(1, 0.1126, 0.11263), (2, 0.1287, 0.1306), (3, 0.1854, 0.2022), (4, 0.3202, 0.4442)]
)
def test_published_gains_have_the_known_lower_bounds_and_stay_below_the_upper(
    d_max: int, least: float, upper: float
) -> None:
    switched = eq9(HIRM, 1, d_max)
    gain, cycle = worst_gain(switched, graph(switched, HIRM, "any"))
    assert least < gain < upper
    assert periodic_gain(switched, cycle) == gain


@pytest.mark.parametrize("transitions", ["any", "fifo"])
def test_worst_cycle_is_admissible_and_no_better_than_the_best_of_the_short_ones(transitions: Transitions) -> None:
    switched = as_flown(HIRM, 1, 3, (0, 1))
    gain, cycle = worst_gain(switched, graph(switched, HIRM, transitions), effort=SMALL)
    delays = [switched.modes[i].d for i in cycle]
    follows = list(zip(delays, [*delays[1:], delays[0]], strict=True))
    assert all(after <= d + 1 or transitions == "any" for d, after in follows)
    assert gain >= max(
        periodic_gain(switched, (i, j))
        for i, j in product(range(len(switched.modes)), repeat=2)
        if abs(switched.modes[i].d - switched.modes[j].d) <= 1
    ) * (1.0 - 1e-6)


def test_cycles_are_drawn_by_the_weights_of_their_edges_and_by_the_seed() -> None:
    switched = eq9(HIRM, 1, 4)
    edges = graph(switched, HIRM, "any")
    heavy = {(0, 1), (1, 2), (2, 3), (3, 0)}
    weights = np.array([1.0 if (i, j) in heavy else 0.0 for i, j, _ in edges.edges])
    drawn_only = Ascent(exhaustive=1, kept=1, rounds=0, longest=7)
    gain, cycle = worst_gain(switched, edges, effort=drawn_only, weights=weights)
    assert cycle == (0, 1, 2, 3)
    assert (gain, cycle) == worst_gain(switched, edges, effort=drawn_only, weights=weights)
    assert gain > worst_gain(switched, edges, effort=drawn_only)[0]
