"""Designs on Lemma 1: what the methods reach, that each is proved, and that gradients and constraints hold."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import pytest

from gains import design as designs
from gains import lyapunov
from gains.ccl import complementarity, corrected
from gains.convexify import convexification
from gains.design import Bounds, Design, Step
from gains.model import Gains, Model, Reference, Trim
from gains.quasinewton import Point, bfgs
from gains.start import feasible, lq_gains
from gains.steady import equilibrium, every_law, steady_law
from gains.store import load_gains, load_model
from gains.task import Task, task
from gains.verify import check
from gains.weighting import Weighting, weighted

design = partial(designs.design, method="lyapunov")

HIRM = load_model("hirm")
PAPER = load_gains("hirm-paper")
PENDULUM = load_model("pendulum")
K54 = np.hstack([PAPER.K1, PAPER.K2])


def free_box(model: Model) -> np.ndarray:
    return np.full((model.nu, model.nx + model.nr), np.inf)


def hirm_task(delta_max: float = 0.0, d_max: int = 3) -> Task:
    return task(HIRM, 1, d_max, delta_max, steady_law(HIRM), free_box(HIRM)).balanced(K54)


def plant(A, B, E, C, D=None, reference: Reference | None = None) -> Model:
    A, B, E, C = (np.atleast_2d(np.asarray(X, dtype=float)) for X in (A, B, E, C))
    D = np.zeros((len(C), B.shape[1])) if D is None else np.asarray(D, dtype=float)
    states = tuple(f"x{i}" for i in range(len(A)))
    return Model(
        "plant", 0.03, A, B, E, C, D, states, Trim(np.zeros(len(A)), np.zeros(B.shape[1])), reference=reference
    )


def in_other_units(model: Model, units: np.ndarray) -> Model:
    """Return the model with each state counted in another unit."""
    S, back = np.diag(units), np.diag(1 / units)
    assert model.uncertainty is not None
    return replace(
        model,
        A=S @ model.A @ back,
        B=S @ model.B,
        E=S @ model.E,
        C=model.C @ back,
        uncertainty=replace(model.uncertainty, F=S @ model.uncertainty.F, J1=model.uncertainty.J1 @ back),
    )


def two_by_two(radius: float, *, feedthrough: bool = True) -> Model:
    rng = np.random.default_rng(0)
    A = np.eye(4) + 0.1 * rng.normal(size=(4, 4))  # slow against its sampling, as sampled plants are
    A *= radius / np.max(np.abs(np.linalg.eigvals(A)))
    Ar = np.diag([0.85, 0.92])
    D = 0.1 * rng.normal(size=(2, 2)) * feedthrough
    B, E, C = rng.normal(size=(4, 2)), 0.1 * rng.normal(size=(4, 1)), rng.normal(size=(2, 4))
    return plant(A, B, E, C, D, Reference(Ar, np.eye(2) - Ar, np.eye(2)))


def assert_proved(found: Design, model: Model, delta_max: float = 0.0) -> Gains:
    """Assert that NumPy alone verifies the certificate, for the window and the uncertainty asked."""
    assert found.gains is not None, found.reason
    assert found.analysis is not None
    assert found.analysis.certificate is not None
    certificate = found.analysis.certificate
    assert check(found.gains, certificate).passed
    assert (certificate.d_min, certificate.d_max) == (found.gains.d_min, found.gains.d_max)
    assert (certificate.eta, certificate.delta_max) == (found.eta, delta_max)
    assert found.gains.model is model
    return found.gains


def steady_error(gains: Gains) -> float:
    at = equilibrium(gains.model)
    assert at is not None
    K = np.hstack([gains.K1, gains.K2])
    return float(np.max(np.abs(K @ at.z - at.u)))


# -- the gradient and the descent


@pytest.mark.parametrize("delta_max", [0.0, 0.15])
def test_gradient_is_the_slope_of_eta(delta_max: float) -> None:
    problem = hirm_task(delta_max)
    K = problem.own(K54)
    here = problem.gain(K)
    assert here is not None
    step = 1e-4
    for j in range(K.shape[1]):
        aside = np.zeros_like(K)
        aside[0, j] = step
        above, below = problem.gain(K + aside), problem.gain(K - aside)
        assert above is not None
        assert below is not None
        slope = np.log(above.eta / below.eta) / (2 * step)
        assert here.gradient[0, j] == pytest.approx(slope, rel=2e-3, abs=2e-3 * np.max(np.abs(here.gradient)))


def test_gradient_counts_the_feedthrough() -> None:
    model = two_by_two(0.9)
    problem = task(model, 1, 2, 0.0, every_law(model), free_box(model))
    K = 0.02 * np.random.default_rng(1).normal(size=(2, 6))
    here = problem.gain(K)
    assert here is not None
    for index in np.ndindex(*K.shape):
        aside = np.zeros_like(K)
        aside[index] = 1e-4
        above, below = problem.gain(K + aside), problem.gain(K - aside)
        assert above is not None
        assert below is not None
        slope = np.log(above.eta / below.eta) / 2e-4
        assert here.gradient[index] == pytest.approx(slope, rel=5e-3, abs=5e-3 * np.max(np.abs(here.gradient)))


def test_eta_of_the_task_is_that_of_the_analysis() -> None:
    problem = hirm_task()
    found = problem.gain(problem.own(K54))
    assert found is not None
    assert found.eta == pytest.approx(lyapunov.eta(PAPER, 1, 3).eta, rel=1e-4)


def test_task_does_not_depend_on_units() -> None:
    units = np.array([1.0, 1e3, 1e-3])
    model = in_other_units(HIRM, units)
    K = K54 / np.concatenate([units, np.ones(3)])
    problem = task(model, 1, 3, 0.15, every_law(model), free_box(model)).balanced(K)
    found, same = problem.gain(problem.own(K)), hirm_task(0.15)
    expected = same.gain(same.own(K54))
    assert found is not None
    assert expected is not None
    assert found.eta == pytest.approx(expected.eta, rel=1e-4)


def test_descent_finds_the_minimum_at_a_kink_and_never_leaves_the_domain() -> None:
    # 100 |x − 1| + y², +∞ where x > 1.5: the minimum (1, 0) is where the gradient jumps
    def function(x: np.ndarray) -> Point | None:
        if x[0] > 1.5:
            return None
        value = 100 * abs(x[0] - 1) + x[1] ** 2
        return Point(x, float(value), np.array([100 * np.sign(x[0] - 1), 2 * x[1]]))

    points = list(bfgs(function, np.array([-3.0, 2.0]), 200, 1e-10))
    assert points[-1].x == pytest.approx([1.0, 0.0], abs=1e-3)
    assert all(a.value > b.value for a, b in pairwise(points))


# -- the steady state


def test_law_holds_the_equilibrium_for_every_coordinate() -> None:
    for model in (HIRM, two_by_two(0.9)):
        law, at = steady_law(model), equilibrium(model)
        assert at is not None
        assert at.exact
        theta = np.random.default_rng(0).normal(size=law.N.shape[1])
        K = (law.K0 + law.N @ theta).reshape(model.nu, -1)
        assert K @ at.z == pytest.approx(at.u, abs=1e-9)


def test_equilibrium_tracks_a_constant_reference() -> None:
    model = two_by_two(0.9)
    at = equilibrium(model)
    assert at is not None
    assert model.reference is not None
    x, xr = at.z[: model.nx], at.z[model.nx :]
    assert model.A @ x + model.B @ at.u == pytest.approx(x, abs=1e-9)
    assert model.C @ x + model.D @ at.u == pytest.approx(model.reference.Cr @ xr, abs=1e-9)


def test_more_outputs_than_inputs_are_tracked_in_least_squares_with_a_note() -> None:
    Ar = np.diag([0.9, 0.8])
    A, B = np.array([[0.9, 0.1], [0.0, 0.8]]), np.array([[0.0], [1.0]])
    model = plant(A, B, 0.1 * np.eye(2), np.eye(2), None, Reference(Ar, np.eye(2) - Ar, np.eye(2)))
    found = design(model, 1, 2, iterations=10)
    assert_proved(found, model)
    assert any("least error" in note for note in found.notes)


# -- what the methods reach


@pytest.mark.parametrize("start", [PAPER, None], ids=["printed gains", "no start"])
@pytest.mark.parametrize(
    ("delta_max", "steady_state", "asked"),
    [(0.0, "exact", 0.163), (0.0, "free", 0.159), (0.15, "exact", 0.200), (0.15, "free", 0.191)],
)
def test_quasi_newton_reaches_what_was_asked(delta_max, steady_state, asked, start) -> None:
    found = design(
        HIRM,
        1,
        3,
        delta_max=delta_max,
        steady_state=steady_state,
        start=start,
        method="lyapunov",
        search="quasi-newton",
    )
    gains = assert_proved(found, HIRM, delta_max)
    assert found.eta <= asked
    assert steady_state == "free" or steady_error(gains) < 1e-9


@pytest.mark.parametrize(
    ("steady_state", "asked"), [("exact", 0.163), pytest.param("free", 0.159, marks=pytest.mark.long)]
)
def test_best_reaches_what_was_asked_from_no_start(steady_state, asked) -> None:
    found = design(HIRM, 1, 3, steady_state=steady_state)
    assert_proved(found, HIRM)
    assert found.eta <= asked


@pytest.mark.parametrize("delta_max", [0.0, 0.15])
def test_convexification_falls_monotonically(delta_max: float) -> None:
    problem = hirm_task(delta_max)
    K = problem.point(problem.free(problem.own(K54)))
    first = problem.gain(K)
    assert first is not None
    reached = [first.eta, *(iterate.eta for iterate in convexification(problem, K, 6))]
    assert len(reached) == 7
    assert all(a > b for a, b in pairwise(reached))


@pytest.mark.long
@pytest.mark.parametrize(("steady_state", "asked"), [("exact", 0.243), ("free", 0.218)])
def test_convexification_alone_reaches_what_was_asked(steady_state, asked) -> None:
    found = design(HIRM, 1, 3, search="convexify", start=PAPER, steady_state=steady_state)
    assert_proved(found, HIRM)
    assert found.eta <= asked


@pytest.mark.long
@pytest.mark.parametrize("start", [PAPER, None], ids=["printed gains", "no start"])
def test_cone_complementarity_reaches_what_was_asked(start) -> None:
    found = design(HIRM, 1, 3, method="ccl", start=start)
    assert_proved(found, HIRM)
    assert found.eta <= 0.31


def test_cone_complementarity_needs_no_start() -> None:
    model = plant(np.diag([0.4, 0.2]), [[1], [0.5]], np.eye(2), [[1, 0]])
    problem = task(model, 1, 1, 0.0, every_law(model), free_box(model))
    reached = [iterate.eta for iterate in complementarity(problem, corrected(), 10)]
    assert reached
    assert reached[-1] < 1.460  # of K1 = [-0.1, -0.05]


# -- as printed


@pytest.mark.parametrize("model", [HIRM, PENDULUM], ids=["hirm", "pendulum"])
def test_printed_theorem_is_refused_with_the_eigenvalue(model: Model) -> None:
    found = design(model, 1, 3, method="printed")
    assert found.gains is None
    assert "eigenvalue" in found.reason


def test_printed_theorem_designs_where_it_is_feasible() -> None:
    model = plant(np.diag([0.4, 0.2]), [[1], [0.5]], np.eye(2), [[1, 0]])
    found = design(model, 1, 1, method="printed", iterations=20)
    assert_proved(found, model)
    assert found.eta < 1.663  # of K1 = [-0.1, -0.05], by the same condition
    assert found.analysis is not None


# -- models of every kind


@pytest.mark.parametrize("d_max", [3, 6])
def test_unstable_plant_is_stabilised_from_no_start(d_max: int) -> None:
    found = design(PENDULUM, 1, d_max, search="quasi-newton", iterations=40)
    gains = assert_proved(found, PENDULUM)
    assert lyapunov.largest_constant_d(gains, 1, d_max).d_max == d_max


def test_badly_scaled_states_reach_the_same_eta() -> None:
    model = in_other_units(HIRM, np.array([1.0, 1e3, 1e-3]))
    found = design(model, 1, 3, delta_max=0.15, search="quasi-newton")
    assert_proved(found, model, 0.15)
    assert found.eta <= 0.200


@pytest.mark.parametrize("radius", [0.9, 1.03])
def test_several_inputs_and_outputs_with_feedthrough(radius: float) -> None:
    model = two_by_two(radius)
    found = design(model, 1, 2, search="quasi-newton", iterations=15)
    assert steady_error(assert_proved(found, model)) < 1e-8


def test_no_reference_model_needs_no_second_gain() -> None:
    model = replace(HIRM, reference=None)
    found = design(model, 1, 3, search="quasi-newton", iterations=40)
    assert assert_proved(found, model).K2 is None


@pytest.mark.parametrize("d", [1, 3])
def test_constant_delay(d: int) -> None:
    found = design(HIRM, d, d, search="quasi-newton", iterations=10)
    assert_proved(found, HIRM)


def test_no_input_at_all_designs_for_stability() -> None:
    model = replace(PENDULUM, E=np.zeros((2, 0)))
    found = design(model, 1, 3, search="quasi-newton", iterations=5)
    assert found.gains is not None
    assert found.analysis is not None
    assert found.analysis.verdict == "stable"
    assert found.eta is None
    assert found.notes


def test_delays_that_turn_the_feedback_around_are_undecided() -> None:
    # an unstable mode that alternates: gains right for one sample of delay are wrong for two
    model = plant([[-1.2]], [[1.0]], [[1.0]], [[1.0]])
    found = design(model, 1, 2)
    assert found.gains is None
    assert "other gains may do" in found.reason


# -- weights, bounds, progress


def test_bounds_are_kept() -> None:
    bounds = Bounds(K1=[[1.0, 3.0, 2.0]], K2=2.0)
    found = design(HIRM, 1, 3, bounds=bounds, search="quasi-newton", iterations=10)
    gains = assert_proved(found, HIRM)
    assert np.all(np.abs(gains.K1) <= np.array([[1.0, 3.0, 2.0]]))
    assert np.all(np.abs(gains.K2) <= 2.0)
    assert steady_error(gains) < 1e-9


def test_bounds_hold_in_convexification() -> None:
    found = design(HIRM, 1, 3, bounds=Bounds(2.0, 2.0), search="convexify", iterations=5)
    gains = assert_proved(found, HIRM)
    assert max(np.max(np.abs(gains.K1)), np.max(np.abs(gains.K2))) <= 2.0


def test_effort_weight_makes_gains_smaller() -> None:
    plain = design(HIRM, 1, 3, search="quasi-newton", iterations=15)
    thrifty = design(HIRM, 1, 3, search="quasi-newton", iterations=15, weights=Weighting(effort=0.1))
    assert np.linalg.norm(assert_proved(thrifty, HIRM).K1) < 0.7 * np.linalg.norm(assert_proved(plain, HIRM).K1)
    assert thrifty.objective > thrifty.eta >= plain.eta


def test_weights_scale_eta() -> None:
    aim = weighted(HIRM, Weighting(w=2.0, r=2.0, e=3.0))
    gains = replace(PAPER, model=aim)
    assert lyapunov.eta(gains, 1, 3).eta == pytest.approx(6.0 * lyapunov.eta(PAPER, 1, 3).eta, rel=1e-4)


@pytest.mark.parametrize("weighting", [Weighting(e=[1.0, 2.0]), Weighting(w=0.0), Weighting(effort=-1.0)])
def test_weights_that_make_no_sense_are_refused(weighting: Weighting) -> None:
    with pytest.raises(ValueError, match="weight"):
        design(HIRM, 1, 3, weights=weighting)


@pytest.mark.parametrize("bounds", [Bounds(K1=[1.0, 2.0]), Bounds(K2=0.0)])
def test_bounds_that_make_no_sense_are_refused(bounds: Bounds) -> None:
    with pytest.raises(ValueError, match="bounds"):
        design(HIRM, 1, 3, bounds=bounds)


def test_arguments_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="delays"):
        design(HIRM, 3, 1)
    with pytest.raises(ValueError, match="delta_max"):
        design(PENDULUM, 1, 2, delta_max=0.1)
    with pytest.raises(ValueError, match="start"):
        design(PENDULUM, 1, 2, start=PAPER)


def test_interrupted_design_keeps_its_best_gains() -> None:
    seen: list[Step] = []

    def interrupt(step: Step) -> None:
        seen.append(step)
        if step.iteration == 4 and step.method == "quasi-newton":
            raise KeyboardInterrupt

    found = design(HIRM, 1, 3, search="quasi-newton", progress=interrupt)
    assert_proved(found, HIRM)
    assert tuple(seen) == found.history
    assert found.eta == pytest.approx(min(step.eta for step in seen), rel=1e-4)
    assert any("interrupted" in note for note in found.notes)


def test_lq_starts_are_on_the_law_and_one_is_feasible() -> None:
    problem = task(HIRM, 1, 3, 0.15, steady_law(HIRM), free_box(HIRM))
    starts = lq_gains(problem)
    assert all(np.allclose(problem.point(problem.free(K)), K, atol=1e-8) for K in starts)
    assert feasible(problem, starts)
