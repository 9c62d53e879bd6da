"""Programs whose answer is known, statuses, duals, and cvxpy as the reference."""

from collections.abc import Mapping

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov

from gains import lmi, sdp
from gains.lmi import Block, Slack, Weights, Window
from gains.lyapunov import eta, gradient
from gains.model import Matrix, augmented
from gains.sdp import Affine, Backend, Program, Status, Variable, solve
from gains.store import load_gains

BACKENDS: tuple[Backend, ...] = ("clarabel", "cvxpy")


def lyapunov_trace(A: Matrix, Q: Matrix) -> tuple[dict[str, Variable], sdp.Statement]:
    """Minimise tr P subject to A'PA − P + Q ⪯ 0, whose answer solves the Lyapunov equation."""
    n = len(A)

    def statement(x: Mapping[str, Block]) -> Program:
        P = x["P"]
        cost = sum(np.eye(n)[[i]] @ P @ np.eye(n)[[i]].T for i in range(n))
        return Program(cost, [[[A.T @ P @ A - P + Q]]], [P])

    return {"P": Variable(n, n, symmetric=True)}, statement


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_least_lyapunov_matrix_is_scipys(backend: Backend) -> None:
    A, Q = np.array([[0.5, 0.3], [-0.2, 0.7]]), np.array([[2.0, 0.5], [0.5, 1.0]])
    found = solve(*lyapunov_trace(A, Q), backend)
    expected = solve_discrete_lyapunov(A.T, Q)
    assert found.status is Status.OPTIMAL
    assert found.value == pytest.approx(np.trace(expected), rel=1e-6)
    np.testing.assert_allclose(found.values["P"], expected, rtol=1e-5)
    # the dual is the Gramian: d(cost)/dQ = Z with A Z A' − Z + I = 0
    np.testing.assert_allclose(found.duals[0], solve_discrete_lyapunov(A, np.eye(2)), rtol=1e-5)
    assert found.residual < 1e-6
    assert found.iterations > 0
    assert found.setup_s > 0
    assert found.solver_s > 0


@pytest.mark.parametrize("backend", BACKENDS)
def test_an_infeasible_program_is_infeasible_and_has_no_value(backend: Backend) -> None:
    found = solve(*lyapunov_trace(np.diag([1.2, 0.5]), np.eye(2)), backend)
    assert found.status is Status.INFEASIBLE
    assert np.isnan(found.value)


@pytest.mark.parametrize("backend", BACKENDS)
def test_an_unbounded_program_is_unbounded(backend: Backend) -> None:
    found = solve({"t": Variable()}, lambda x: Program(x["t"], [[[x["t"] * np.eye(2) - np.eye(2)]]]), backend)
    assert found.status is Status.UNBOUNDED
    assert np.isnan(found.value)


def test_almost_is_not_solved() -> None:
    names = {word for word, status in sdp._STATUS.items() if status is Status.OPTIMAL}
    assert names == {"Solved"}
    assert sdp._STATUS["AlmostSolved"] is Status.INACCURATE
    assert "MaxIterations" not in sdp._STATUS  # and so FAILED


def test_a_solver_that_gives_up_has_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = sdp._settings()
    settings.max_iter = 2
    monkeypatch.setattr(sdp, "_settings", lambda: settings)
    found = solve(*lyapunov_trace(np.diag([0.9, 0.5]), np.eye(2)))
    assert found.status is Status.FAILED
    assert np.isnan(found.value)


def test_affine_expressions_evaluate_to_the_same_blocks_as_numbers() -> None:
    rng = np.random.default_rng(0)
    loop = augmented(load_gains("hirm-paper").model, *(getattr(load_gains("hirm-paper"), k) for k in ("K1", "K2")))
    n, m, window = loop.n, loop.B.shape[1], Window(1, 3)
    shapes = {name: Variable(n, n, symmetric=True) for name in "PQR"}
    shapes |= {"Y": Variable(n, n), "W": Variable(n, n), "U": Variable(m, n), "eta2": Variable()}

    def blocks(x: Mapping[str, Block], eta2: Block) -> lmi.Blocks:
        return lmi.eq13(loop, Weights(x["P"], x["Q"], x["R"]), Slack(x["Y"], x["W"], x["U"]), eta2, window)

    problem = sdp.assemble(shapes, lambda x: Program(x["eta2"], [blocks(x, x["eta2"])]))
    vector = rng.normal(size=len(problem.q))
    values, at = {}, 0
    for name, shape in shapes.items():
        basis = sdp._basis(shape)
        values[name] = np.tensordot(vector[at : at + len(basis)], basis, axes=1)
        at += len(basis)
    numbers = np.block(blocks(values, values["eta2"][0, 0]))
    assembled = sdp._unpacked(problem.A @ vector - problem.b, len(numbers))
    np.testing.assert_allclose(assembled, numbers, rtol=1e-12, atol=1e-12 * np.abs(numbers).max())


def test_affine_expressions_follow_the_rules_of_matrices() -> None:
    rng = np.random.default_rng(1)
    X = Affine(np.zeros((2, 3)), {"X": np.eye(6).reshape(6, 2, 3)})
    value, M = rng.normal(size=(2, 3)), rng.normal(size=(3, 2))

    def at(e: Affine) -> Matrix:
        return e.constant + np.tensordot(value.reshape(-1), e.parts["X"], axes=1)

    np.testing.assert_allclose(
        at(1.0 - (2 * X @ M - M.T @ X.T / 4).T + X.constant @ M), 1.0 - (2 * value @ M - M.T @ value.T / 4).T
    )
    with pytest.raises(TypeError):
        X @ X.T  # not affine


@pytest.mark.parametrize("delta", [0.0, 0.15])
def test_direct_assembly_and_cvxpy_agree(delta: float) -> None:
    gains = load_gains("hirm-paper")
    direct, reference = (eta(gains, 1, 3, delta, backend=backend) for backend in BACKENDS)
    assert direct.eta == pytest.approx(reference.eta, rel=1e-5)
    for ours, theirs in zip(gradient(gains, direct), gradient(gains, reference), strict=True):
        assert ours is not None
        assert theirs is not None  # the duals themselves are not unique to a solver's accuracy, what they say is
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-4 * np.abs(theirs).max())
