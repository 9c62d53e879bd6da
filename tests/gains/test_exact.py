"""The exact eta: published numbers, the inequality stated plainly, and runs of Eqs. (4), (8), (9), none above it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from gains.exact import MAX_ROWS, ExactAnalysis, eta, program_rows, stability
from gains.lower_gain import periodic_gain, worst_gain
from gains.model import GainLaw, Gains, Matrix, Schedule, sets_of
from gains.store import load_gains
from gains.switched import Key, Transitions, eq9, graph
from gains.verify_switched import check_switched
from tests.gains.lifted import full_state, of_reference
from tests.gains.loops import random_gains
from tests.gains.near_edge import sequences
from tests.gains.plain import least_eta

HIRM = load_gains("hirm-paper")


def proved(found: ExactAnalysis) -> float:
    assert found.verdict == "stable", found.reason
    assert found.verification is not None
    assert found.verification.passed
    assert found.eta is not None
    return found.eta


# -- published numbers


@pytest.mark.parametrize(("d_max", "expected"), [(1, 0.1126), (2, 0.1315), (3, 0.2110), (4, 0.4645)])
def test_the_published_gains_have_the_published_eta(d_max: int, expected: float) -> None:
    assert proved(eta(HIRM, 1, d_max)) == pytest.approx(expected, rel=0.005)


@pytest.mark.parametrize(("d_max", "most"), [(2, 0.1311), (3, 0.2073), pytest.param(4, 0.4442, marks=pytest.mark.long)])
def test_one_past_delay_in_the_storages_tightens_eta(d_max: int, most: float) -> None:
    without, with_memory = proved(eta(HIRM, 1, d_max)), proved(eta(HIRM, 1, d_max, memory=1))
    assert with_memory <= most * 1.0005
    assert with_memory < without


@pytest.mark.parametrize(("d_max", "expected"), [(1, 0.1267), (2, 0.1773), (3, 0.3314)])
def test_the_published_gains_have_the_published_robust_eta(d_max: int, expected: float) -> None:
    assert proved(eta(HIRM, 1, d_max, delta_max=0.15)) == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize(("ahead", "expected"), [(0, 0.285), (1, 0.285), (2, 0.343), (3, 0.438)])
def test_the_law_as_it_runs_has_the_published_eta(ahead: int, expected: float) -> None:
    assert proved(eta(HIRM, 1, 3, aheads=(ahead,))) == pytest.approx(expected, rel=0.005)


def test_a_prediction_that_varies_costs_at_least_as_much_as_each_alone() -> None:
    both = proved(eta(HIRM, 1, 2, aheads=(1, 2)))
    assert both >= max(proved(eta(HIRM, 1, 2, aheads=(a,))) for a in (1, 2)) * (1.0 - 1e-6)


@pytest.mark.parametrize("d_max", [2, 3, 4])
def test_fewer_transitions_never_cost_more(d_max: int) -> None:
    assert proved(eta(HIRM, 1, d_max, transitions="fifo")) <= proved(eta(HIRM, 1, d_max)) * (1.0 + 1e-6)


def test_eta_is_above_what_a_delay_sequence_reaches_and_equals_it_for_a_constant_delay() -> None:
    for d_max, reached in ((1, 0.1126), (2, 0.1287), (3, 0.1854)):
        switched = eq9(HIRM, 1, d_max)
        lower, _ = worst_gain(switched, graph(switched, HIRM, "any"))
        found = proved(eta(HIRM, 1, d_max))
        assert reached <= lower * 1.0005
        assert lower <= found
    constant = eq9(HIRM, 2, 2)
    assert proved(eta(HIRM, 2, 2)) == pytest.approx(periodic_gain(constant, (0,)), rel=1e-4)


def test_no_eta_is_claimed_where_a_delay_sequence_diverges() -> None:
    diverging = replace(several_inputs(0, 1), K1=np.ones((2, 3)))
    for found in (eta(diverging, 0, 1), stability(diverging, 0, 1)):
        assert (found.verdict, found.eta, found.certificate) == ("undecided", None, None)
        assert found.reason


def test_a_program_that_would_take_minutes_is_refused_before_it_is_made() -> None:
    assert program_rows(HIRM, 1, 16) > MAX_ROWS
    found = eta(HIRM, 1, 16)
    assert (found.verdict, found.solves) == ("undecided", 0)
    assert str(MAX_ROWS) in found.reason


# -- the same inequality, stated plainly on the lifting over all past states


def test_eta_is_that_of_the_plain_program_over_all_past_states() -> None:
    assert proved(eta(HIRM, 1, 2)) == pytest.approx(least_eta(full_state(HIRM, 1, 2)), rel=1e-4)


def several_inputs(seed: int, rank: int) -> Gains:
    """Two inputs and outputs, feedthrough, a reference; K1 of a rank."""
    rng = np.random.default_rng(seed)
    gains = random_gains(rng, nx=3, nu=2, ny=2, nr=1, gain=0.15)
    assert np.any(gains.model.D)
    return replace(gains, K1=rng.normal(size=(2, 1)) @ gains.K1[:1]) if rank == 1 else gains


@pytest.mark.parametrize("transitions", ["any", "fifo"])
@pytest.mark.parametrize(("seed", "rank", "window"), [(0, 1, (0, 2)), (6, 1, (1, 2)), (2, 2, (0, 2)), (3, 2, (1, 2))])
def test_several_inputs_of_any_rank_have_the_eta_of_the_plain_program(
    seed: int, rank: int, window: tuple[int, int], transitions: Transitions
) -> None:
    gains = several_inputs(seed, rank)
    found = eta(gains, *window, transitions=transitions)
    assert proved(found) == pytest.approx(least_eta(full_state(gains, *window), transitions), rel=1e-4)
    assert found.certificate is not None
    assert found.certificate.P.shape[1] == gains.model.nx + rank * window[1] + gains.model.nr


def test_a_loop_without_feedback_has_the_eta_of_its_plant() -> None:
    gains = several_inputs(4, 2)
    still = replace(gains, K1=np.zeros((2, 3)))
    assert proved(eta(still, 0, 3)) == pytest.approx(periodic_gain(eq9(still, 1, 1), (0,)), rel=1e-4)


def test_units_change_eta_by_their_ratio_alone() -> None:
    gains = several_inputs(2, 2)
    model = gains.model
    assert model.reference is not None
    scaled = replace(
        model,
        E=1e4 * model.E,
        C=1e-3 * model.C,
        D=1e-3 * model.D,
        reference=replace(model.reference, Br=1e4 * model.reference.Br, Cr=1e-3 * model.reference.Cr),
    )
    assert proved(eta(replace(gains, model=scaled), 1, 2)) == pytest.approx(10.0 * proved(eta(gains, 1, 2)), rel=1e-5)


# -- runs of the equations


def worst(law: GainLaw, keys: Sequence[Key], aheads: Sequence[int] | None = None, delta: Matrix | None = None) -> float:
    """The norm of the map from v to e over the samples of Eqs. (4), (6), (8), (9): no disturbance does worse.

    Every unit disturbance is a column. With ``aheads`` whole commands are late, with ``delta`` the plant varies.
    """
    model, sets = law.model, sets_of(law)
    Ar, Br, Cr = of_reference(model)
    F, J1, J2 = (np.zeros(1), np.zeros(model.nx), np.zeros(model.nu))
    if delta is not None:
        assert model.uncertainty is not None
        F, J1, J2 = model.uncertainty.F[:, 0], model.uncertainty.J1[0], model.uncertainty.J2[0]
    samples, m = len(keys), model.nw + Br.shape[1]
    unit = np.eye(samples * m).reshape(samples, m, samples * m)
    x, xr = [np.zeros((model.nx, samples * m))], np.zeros((len(Ar), samples * m))
    sent: list[list[Matrix]] = []  # the part of the command that is late, of each set
    e = []
    for k, (d, i) in enumerate(keys):
        w, r = unit[k, : model.nw], unit[k, model.nw :]
        predicted = xr
        for _ in range(aheads[k] if aheads is not None else 0):
            predicted = Ar @ predicted + Br @ r
        sent.append([own.K1 @ x[k] + (_K2(own) @ predicted if aheads is not None else 0.0) for own in sets])
        u = sent[k - d][i] if k >= d else np.zeros((model.nu, samples * m))
        u = u if aheads is not None else u + _K2(sets[i]) @ xr
        e.append(model.C @ x[k] + model.D @ u - Cr @ xr)
        after = model.A @ x[k] + model.B @ u + model.E @ w
        if delta is not None:
            after += np.outer(F, delta[k] * (J1 @ x[k] + J2 @ u))
        x.append(after)
        xr = Ar @ xr + Br @ r
    response = np.concatenate(e)
    return float(np.sqrt(np.linalg.eigvalsh(response @ response.T)[-1]))


def _K2(own: Gains) -> Matrix:
    return np.zeros((own.model.nu, own.model.nr)) if own.K2 is None else own.K2


def plain_keys(
    rng: np.random.Generator, d_min: int, d_max: int, transitions: Transitions, count: int, samples: int
) -> list[list[Key]]:
    drawn = sequences(rng, d_min, d_max, transitions, samples, count).T
    return [[Key(int(d)) for d in column] for column in drawn]


@pytest.mark.parametrize("transitions", ["any", "fifo"])
def test_no_delay_sequence_and_no_disturbance_exceeds_eta(transitions: Transitions) -> None:
    claimed = proved(eta(HIRM, 1, 3, transitions=transitions))
    for keys in plain_keys(np.random.default_rng(5), 1, 3, transitions, 20, 60):
        assert worst(HIRM, keys) <= claimed


def test_a_delay_sequence_and_its_disturbance_come_near_to_eta() -> None:
    claimed = proved(eta(HIRM, 1, 3))
    switched = eq9(HIRM, 1, 3)
    _, cycle = worst_gain(switched, graph(switched, HIRM, "any"))
    keys = [Key(switched.modes[i].d) for i in cycle] * (480 // len(cycle))
    assert 0.8 * claimed < worst(HIRM, keys) < claimed


@pytest.mark.parametrize(("seed", "rank"), [(0, 1), (2, 2)])
def test_no_run_of_several_inputs_exceeds_eta(seed: int, rank: int) -> None:
    gains = several_inputs(seed, rank)
    claimed = proved(eta(gains, 0, 3))
    for keys in plain_keys(np.random.default_rng(seed), 0, 3, "any", 20, 60):
        assert 0.0 < worst(gains, keys) <= claimed


def test_no_run_of_the_law_as_it_runs_exceeds_its_eta() -> None:
    rng = np.random.default_rng(6)
    claimed = proved(eta(HIRM, 1, 2, aheads=(1, 2)))
    for keys in plain_keys(rng, 1, 2, "any", 20, 60):
        assert worst(HIRM, keys, aheads=rng.integers(1, 3, size=len(keys)).tolist()) <= claimed


def test_no_run_exceeds_the_robust_eta_whatever_the_plant_does_in_its_bound() -> None:
    rng = np.random.default_rng(7)
    claimed = proved(eta(HIRM, 1, 2, delta_max=0.15))
    largest = 0.0
    for i, keys in enumerate(plain_keys(rng, 1, 2, "any", 30, 60)):
        delta = np.full(len(keys), 0.15) if i < 5 else rng.choice([-0.15, 0.0, 0.15], size=len(keys))
        largest = max(largest, worst(HIRM, keys, delta=delta))
    held, slow = [Key(2)] * 300, np.full(300, 0.15)
    assert worst(HIRM, held) < worst(HIRM, held, delta=slow)  # it does harm
    assert max(largest, worst(HIRM, held, delta=slow)) <= claimed


# -- schedules


LOW = replace(HIRM, d_min=1, d_max=2)
HIGH = replace(HIRM, d_min=2, d_max=3, K1=0.7 * HIRM.K1, K2=0.7 * HIRM.K2 if HIRM.K2 is not None else None)
TWO = Schedule("two", HIRM.model, (LOW, HIGH))


@pytest.fixture(scope="module")
def scheduled() -> ExactAnalysis:
    return eta(TWO, 1, 3)


def test_a_schedule_costs_at_least_as_much_as_each_set_alone_in_its_window(scheduled: ExactAnalysis) -> None:
    whole = proved(scheduled)
    for own in TWO.sets:
        assert whole >= proved(eta(own, own.d_min, own.d_max)) * (1.0 - 1e-6)
    assert scheduled.certificate is not None
    assert check_switched(TWO, scheduled.certificate).passed


@pytest.mark.parametrize("seed", range(20))
def test_no_switching_between_sets_exceeds_eta_of_the_schedule(scheduled: ExactAnalysis, seed: int) -> None:
    keys = chosen(TWO, np.random.default_rng(seed), 100)
    assert {key.gain_set for key in keys} == {0, 1}
    assert worst(TWO, keys) <= proved(scheduled)


def chosen(law: Schedule, rng: np.random.Generator, samples: int) -> list[Key]:
    """Delays of commands that arrive at random, each with the set its estimate chose; a held command keeps its set."""
    keys: list[Key] = []
    j, which = 0, 0  # the command at the plant: when it was computed, and by which set
    for k in range(samples):
        late = [k - d for d in range(law.d_min, law.d_max + 1) if k - d != j]
        if not keys or k - j > law.d_max or rng.random() < 0.6:
            j = int(rng.choice(late))
            estimate = k - j + int(rng.integers(-1, 2))
            fitting = [i for i, own in enumerate(law.sets) if own.d_min <= estimate <= own.d_max]
            nearest = 0 if estimate < law.d_min else len(law.sets) - 1
            which = int(rng.choice(fitting)) if fitting else nearest
        keys.append(Key(k - j, which))
    return keys
