"""The inequalities against each other and against the definition of the functional."""

import numpy as np
import pytest

from gains import lmi
from gains.lmi import Slack, System, Uncertain, Weights, Window
from gains.model import Matrix


def full(blocks: lmi.Blocks) -> Matrix:
    return np.block(blocks)


def symmetric(rng: np.random.Generator, n: int) -> Matrix:
    X = rng.normal(size=(n, n))
    return (X + X.T) / 2


def positive(rng: np.random.Generator, n: int) -> Matrix:
    X = rng.normal(size=(n, n))
    return X @ X.T + 0.1 * np.eye(n)


def random_system(rng: np.random.Generator, n: int = 4, m: int = 2, ne: int = 2) -> System:
    sizes = ((n, n), (n, n), (n, m), (ne, n), (ne, n))
    return System(*(rng.normal(size=size) for size in sizes))


def schur(matrix: Matrix, kept: int) -> Matrix:
    """The Schur complement onto the first rows."""
    a, b, c = matrix[:kept, :kept], matrix[:kept, kept:], matrix[kept:, kept:]
    return a - b @ np.linalg.solve(c, b.T)


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize(("n", "m", "ne"), [(4, 2, 2), (1, 1, 1), (3, 1, 4)])
def test_printed_and_standard_form_are_equal_after_the_change_of_the_slack(seed: int, n: int, m: int, ne: int) -> None:
    rng = np.random.default_rng(seed)
    s = random_system(rng, n, m, ne)
    weights = Weights(*(symmetric(rng, n) for _ in range(3)))
    Y, W, U = rng.normal(size=(n, n)), rng.normal(size=(n, n)), rng.normal(size=(m, n))
    window = Window(1 + seed % 2, 2 + seed)
    printed = full(lmi.eq13(s, weights, Slack(Y, W, U), 0.7, window))
    P = weights.P
    changed = Slack(Y - s.A.T @ P @ s.A / 2, W - s.A1.T @ P @ s.A / 2, U - s.B.T @ P @ s.A / 2)
    standard = full(lmi.standard(s, weights, changed, 0.7, window))
    np.testing.assert_allclose(printed, standard, rtol=0, atol=1e-12 * np.abs(printed).max())
    stability = full(lmi.eq22(s, weights, Slack(Y, W, U), window))
    silent = System(s.A, s.A1, s.B, 0 * s.C, 0 * s.C1)
    expected = full(lmi.standard(silent, weights, changed, 0.7, window))[: 3 * n, : 3 * n]
    np.testing.assert_allclose(stability, expected, rtol=0, atol=1e-12 * np.abs(printed).max())


@pytest.mark.parametrize("seed", range(5))
def test_jensen_form_is_the_standard_form_at_its_slack_and_its_schur_complement(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, m, window = 4, 2, Window(2, 5)
    s, weights = random_system(rng), Weights(*(positive(rng, 4) for _ in range(3)))
    R = weights.R / window.d_max
    slack = Slack(-R, R, np.zeros((m, n)))
    standard = full(lmi.standard(s, weights, slack, 0.7, window))
    np.testing.assert_array_equal(full(lmi.jensen(s, weights, 0.7, window, full=True)), standard)
    order = np.r_[0 : 2 * n, 3 * n : 3 * n + m, 2 * n : 3 * n]  # dy last
    reduced = full(lmi.jensen(s, weights, 0.7, window))
    scale = np.abs(reduced).max()
    np.testing.assert_allclose(schur(standard[np.ix_(order, order)], 2 * n + m), reduced, rtol=0, atol=1e-12 * scale)
    silent = System(s.A, s.A1, s.B, 0 * s.C, 0 * s.C1)
    corner = full(lmi.jensen(silent, weights, 0.7, window))[: 2 * n, : 2 * n]
    np.testing.assert_allclose(full(lmi.stability(s, weights, window)), corner, rtol=0, atol=1e-12 * scale)


@pytest.mark.parametrize("with_slack", [True, False])
def test_corrected_synthesis_inequality_is_the_standard_form_by_schur_complements(with_slack: bool) -> None:
    rng = np.random.default_rng(1)
    n, m, window = 4, 2, Window(1, 3)
    s, weights = random_system(rng), Weights(*(positive(rng, 4) for _ in range(3)))
    slack = Slack(rng.normal(size=(n, n)), rng.normal(size=(n, n)), rng.normal(size=(m, n))) if with_slack else None
    S, L = np.linalg.inv(weights.P), np.linalg.inv(weights.R)
    blocks = full(lmi.corrected(s, weights, slack, S, L, 0.7, window))
    np.testing.assert_allclose(blocks, blocks.T, rtol=0, atol=1e-13 * np.abs(blocks).max())
    expected = full(lmi.standard(s, weights, slack, 0.7, window) if slack else lmi.jensen(s, weights, 0.7, window))
    np.testing.assert_allclose(schur(blocks, len(expected)), expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


def test_robust_synthesis_inequality_is_the_s_procedure_by_schur_complements() -> None:
    rng = np.random.default_rng(2)
    n, m, window, mu = 4, 2, Window(1, 3), 50.0
    s, weights = random_system(rng), Weights(*(positive(rng, 4) for _ in range(3)))
    uncertain = Uncertain(0.1 * rng.normal(size=(n, 3)), rng.normal(size=(2, n)), rng.normal(size=(2, n)))
    S, L = np.linalg.inv(weights.P), np.linalg.inv(weights.R)
    synthesis = full(lmi.corrected_robust(s, uncertain, weights, None, S, L, 1 / mu, 0.7, window))
    given = full(lmi.s_procedure(s, uncertain, weights, mu, 0.7, window))
    kept = 2 * n + m
    assert np.linalg.eigvalsh(given[kept:, kept:])[-1] < 0
    expected = schur(given, kept)
    np.testing.assert_allclose(schur(synthesis, kept), expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    silent = System(s.A, s.A1, s.B, 0 * s.C, 0 * s.C1)
    rows = np.r_[0 : 2 * n, kept : kept + 3]
    stability = full(lmi.s_procedure(s, uncertain, weights, mu, None, window))
    expected = full(lmi.s_procedure(silent, uncertain, weights, mu, 0.7, window))[np.ix_(rows, rows)]
    np.testing.assert_allclose(stability, expected, rtol=1e-12, atol=1e-12)


def test_printed_lemma_2_and_theorem_1_for_given_gains_are_their_schur_complements() -> None:
    rng = np.random.default_rng(3)
    n, m, window, mu = 4, 2, Window(1, 3), 200.0
    s, weights = random_system(rng), Weights(*(positive(rng, 4) for _ in range(3)))
    slack = Slack(rng.normal(size=(n, n)), rng.normal(size=(n, n)), rng.normal(size=(m, n)))
    S, L = np.linalg.inv(weights.P), np.linalg.inv(weights.R)
    kept = 3 * n + m
    expected = full(lmi.eq31_given(s, weights, slack, 0.7, window))
    found = schur(full(lmi.eq31(s, weights, slack, S, L, 0.7, window)), kept)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    uncertain = Uncertain(0.1 * rng.normal(size=(n, 2)), rng.normal(size=(3, n)), rng.normal(size=(3, n)))
    given = full(lmi.eq40_given(s, uncertain, weights, slack, mu, 0.7, window))
    assert np.linalg.eigvalsh(given[kept:, kept:])[-1] < 0
    found = schur(full(lmi.eq40(s, uncertain, weights, slack, S, L, 1 / mu, 0.7, window)), kept)
    expected = schur(given, kept)
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())


def test_printed_lemma_2_is_nonnegative_along_the_eigenvector_of_section_4() -> None:
    rng = np.random.default_rng(4)
    n, m, d_min, d_max = 3, 1, 1, 4
    A, value = rng.normal(size=(n, n)), 1.05
    A[:, 0] = [value, 0.0, 0.0]
    s = System(A, rng.normal(size=(n, n)), rng.normal(size=(n, m)), rng.normal(size=(1, n)), rng.normal(size=(1, n)))
    P, Q, R = weights = Weights(*(positive(rng, n) for _ in range(3)))
    slack = Slack(rng.normal(size=(n, n)), rng.normal(size=(n, n)), rng.normal(size=(m, n)))
    x = np.eye(n)[0]
    xi = np.concatenate([x, x, np.zeros(n + m)])
    found = xi @ full(lmi.eq31_given(s, weights, slack, 0.7, Window(d_min, d_max))) @ xi
    closed = s.A + s.A1
    move, go, out = (closed - np.eye(n)) @ x, closed @ x, (s.C + s.C1) @ x
    expected = (d_max - d_min) * x @ Q @ x + d_max * move @ R @ move
    expected += 2 * ((value**2 - 1) * x @ P @ x + go @ P @ go) + out @ out
    assert found == pytest.approx(expected, rel=1e-12)
    assert found > 0


def test_eq41_bounds_the_inverse() -> None:
    rng = np.random.default_rng(5)
    X = positive(rng, 3)
    assert np.linalg.eigvalsh(full(lmi.eq41(X, 1.01 * np.linalg.inv(X))))[-1] < 0
    assert np.linalg.eigvalsh(full(lmi.eq41(X, 0.99 * np.linalg.inv(X))))[-1] > 0
