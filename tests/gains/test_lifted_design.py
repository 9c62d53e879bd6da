"""Designs on the lifted form: gradients against differences, what the searches reach, constraints, the frontier."""

from __future__ import annotations

import csv
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from gains import exact
from gains.__main__ import cli
from gains.barrier import Barrier
from gains.bounded_real import least_eta
from gains.design import Bounds, design
from gains.interior import _first
from gains.lifted_convexify import lifted_convexification
from gains.lifted_task import LiftedTask, lifted_task
from gains.model import Gains, Model, Reference, Trim, Uncertainty
from gains.quasinewton import quasi_newton
from gains.steady import equilibrium, every_law, steady_law
from gains.store import load_gains, load_model
from gains.switched import eq9, graph

HIRM = load_model("hirm")
PRINTED = load_model("hirm-printed")
PAPER = load_gains("hirm-paper")
K54 = np.hstack([PAPER.K1, PAPER.K2])


def random_model(seed: int, nu: int) -> Model:
    rng = np.random.default_rng(seed)
    A = np.eye(3) + 0.1 * rng.normal(size=(3, 3))
    A *= 0.9 / np.max(np.abs(np.linalg.eigvals(A)))
    Ar = np.diag([0.8, 0.9])
    return Model(
        "random",
        0.03,
        A,
        0.3 * rng.normal(size=(3, nu)),
        0.1 * rng.normal(size=(3, 1)),
        rng.normal(size=(2, 3)),
        0.1 * rng.normal(size=(2, nu)),
        ("x1", "x2", "x3"),
        Trim(np.zeros(3), np.zeros(nu)),
        reference=Reference(Ar, np.eye(2) - Ar, np.eye(2)),
        uncertainty=Uncertainty(0.1 * rng.normal(size=(3, 1)), rng.normal(size=(1, 3)), rng.normal(size=(1, nu)), 0.1),
    )


def no_box(model: Model) -> np.ndarray:
    return np.full((model.nu, model.nx + model.nr), np.inf)


def gains_of(model: Model, K: np.ndarray, d_min: int, d_max: int) -> Gains:
    return Gains("g", model, d_min, d_max, K[:, : model.nx], K[:, model.nx :])


def hirm_task(d_max: int, delta_max: float = 0.0) -> tuple[LiftedTask, np.ndarray]:
    problem = lifted_task(HIRM, 1, d_max, delta_max, steady_law(HIRM), no_box(HIRM)).balanced(K54)
    return problem, problem.point(problem.free(problem.own(K54)))


@pytest.mark.parametrize(("nu", "d_min", "delta_max", "transitions"), [(1, 1, 0.0, "any"), (2, 0, 0.1, "fifo")])
def test_gradient_is_the_slope_of_eta(nu, d_min, delta_max, transitions) -> None:
    model = random_model(nu, nu)
    problem = lifted_task(model, d_min, 2, delta_max, every_law(model), no_box(model), transitions=transitions)
    problem = replace(problem, tolerance=1e-9)
    K = problem.own(0.1 * np.random.default_rng(5).normal(size=(nu, 5)))
    here = problem.gain(K)
    assert here is not None
    slopes = np.zeros_like(K)
    for index in np.ndindex(*K.shape):
        aside = np.zeros_like(K)
        aside[index] = 1e-3
        above, below = problem.gain(K + aside), problem.gain(K - aside)
        assert above is not None
        assert below is not None
        slopes[index] = np.log(above.eta / below.eta) / 2e-3
    assert here.gradient == pytest.approx(slopes, abs=0.02 * np.max(np.abs(slopes)))


@pytest.mark.parametrize(("d_min", "delta_max"), [(0, 0.0), (1, 0.1)])
def test_eta_of_the_task_is_that_of_the_loop(d_min: int, delta_max: float) -> None:
    model = random_model(3, 2)
    K = 0.02 * np.random.default_rng(6).normal(size=(2, 5))
    problem = lifted_task(model, d_min, 2, delta_max, every_law(model), no_box(model))
    law = gains_of(model, K, d_min, 2)
    loop = eq9(law, d_min, 2, delta_max)
    found = problem.gain(problem.own(K))
    assert found is not None
    assert found.eta == pytest.approx(least_eta(loop, graph(loop, law, "any")).value, rel=1e-4)


@pytest.mark.parametrize("eta2", [None, 7.0])
def test_barrier_has_the_derivatives_that_it_says(eta2: float | None) -> None:
    model = random_model(4, 2)
    problem = lifted_task(model, 0, 2, 0.1, every_law(model), np.full((2, 5), 9.0))
    theta = problem.free(problem.own(0.02 * np.random.default_rng(7).normal(size=(2, 5))))
    family = problem.family(problem.point(theta))
    law, edges = problem.law, problem.graph.edges
    barrier = Barrier(family, edges, len(problem.graph.paths), problem.box.reshape(-1), law.K0, law.N, eta2)
    at = _first(barrier.asking(None), family, theta, [1e4, 1e7])
    assert at is not None
    assert barrier.holds(at)
    gradient, hessian = barrier._system(at, 2.0)
    direction = np.random.default_rng(8).normal(size=len(gradient)) * 1e-3
    step = 1e-3
    above, below = barrier.moved(at, direction, step), barrier.moved(at, direction, -step)
    slope = (barrier.value(above, 2.0) - barrier.value(below, 2.0)) / (2 * step)
    change = (barrier._system(above, 2.0)[0] - barrier._system(below, 2.0)[0]) / (2 * step)
    assert gradient @ direction == pytest.approx(slope, rel=1e-4, abs=1e-6)
    assert hessian @ direction == pytest.approx(change, abs=1e-4 * np.max(np.abs(change)))


def test_design_beats_its_start_and_verifies() -> None:
    start = exact.eta(PAPER, 1, 2)
    found = design(HIRM, 1, 2, start=PAPER)
    assert found.gains is not None, found.reason
    assert found.eta < 0.5 * start.eta
    again = exact.eta(found.gains, 1, 2)
    assert again.verdict == "stable"
    at = equilibrium(HIRM)
    assert np.hstack([found.gains.K1, found.gains.K2]) @ at.z == pytest.approx(at.u, abs=1e-9)


@pytest.mark.parametrize(("steady_state", "asked"), [("exact", 0.0755), ("free", 0.0740)])
def test_window_to_three_reaches_what_was_asked(steady_state: str, asked: float) -> None:
    found = design(PRINTED, 1, 3, steady_state=steady_state)
    assert found.analysis is not None, found.reason
    assert found.analysis.verdict == "stable"
    assert found.eta <= asked


@pytest.mark.long
@pytest.mark.parametrize(
    ("d_max", "steady_state", "asked"), [(4, "exact", 0.1175), (4, "free", 0.1142), (6, "free", 0.202)]
)
def test_wide_windows_reach_what_was_asked(d_max: int, steady_state: str, asked: float) -> None:
    found = design(PRINTED, 1, d_max, steady_state=steady_state)
    assert found.eta is not None, found.reason
    assert found.eta <= asked


@pytest.mark.parametrize("delta_max", [0.0, 0.15])
def test_convexification_falls_monotonically(delta_max: float) -> None:
    problem, K = hirm_task(2, delta_max)
    first = problem.gain(K)
    assert first is not None
    reached = [first.eta, *(iterate.eta for iterate in lifted_convexification(problem, K, 3))]
    assert len(reached) == 4
    assert all(a > b for a, b in pairwise(reached))


def test_quasi_newton_runs_on_the_lifted_form() -> None:
    problem, K = hirm_task(2)
    reached = [iterate.eta for iterate in quasi_newton(problem, K, 10)]
    assert reached[-1] < 0.06


def test_bounds_are_kept() -> None:
    found = design(HIRM, 1, 2, bounds=Bounds(K1=[[1.0, 3.0, 6.0]], K2=6.0))
    assert found.gains is not None, found.reason
    assert np.all(np.abs(found.gains.K1) <= [[1.0, 3.0, 6.0]])
    assert np.max(np.abs(found.gains.K2)) <= 6.0


def test_several_inputs_and_uncertainty_are_designed() -> None:
    model = random_model(2, 2)
    found = design(model, 0, 2, delta_max=0.1, transitions="fifo", iterations=10)
    assert found.gains is not None, found.reason
    assert found.analysis.certificate.transitions == "fifo"


def test_frontier_writes_an_eta_that_does_not_fall(tmp_path: Path) -> None:
    out, plot = tmp_path / "frontier.csv", tmp_path / "frontier.png"
    code = cli.main(["frontier", "hirm", "--d-max", "2:3", "-o", str(out), "--plot", str(plot)], standalone_mode=False)
    assert code == 0
    with out.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["d_max"] for row in rows] == ["2", "3"]
    assert float(rows[0]["eta"]) <= float(rows[1]["eta"])
    assert float(rows[1]["seconds_of_latency"]) == pytest.approx(0.075)
    assert {"K1_theta_rad", "K2_xr3"} <= set(rows[0])
    assert plot.stat().st_size > 10_000
