"""Verification: what passes, what does not, and that its bound on rounding is one."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from gains import lmi, verify
from gains.certificate import Certificate
from gains.lmi import Uncertain, Weights, Window
from gains.lyapunov import eta, stability
from gains.model import Gains, Matrix, Model, Trim, augmented
from gains.store import load_gains
from gains.verify import check, verified
from tests.gains.loops import FEASIBLE, random_gains

HIRM = load_gains("hirm-paper")


@pytest.fixture(scope="module")
def proofs() -> dict[str, Certificate]:
    found = {
        "nominal": eta(HIRM, 1, 3),
        "robust": eta(HIRM, 1, 3, 0.15),
        "stability": stability(HIRM, 1, 3),
        "robust stability": stability(HIRM, 1, 3, 0.15),
    }
    assert all(a.certificate is not None for a in found.values())
    return {name: a.certificate for name, a in found.items() if a.certificate is not None}


KINDS = ["nominal", "robust", "stability", "robust stability"]


@pytest.mark.parametrize("kind", KINDS)
def test_a_proof_passes_with_a_margin_above_its_rounding(proofs: dict[str, Certificate], kind: str) -> None:
    found = check(HIRM, proofs[kind])
    assert found.passed, found.reason
    assert 0 < found.rounding < found.margin
    assert found.reason == ""


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(3))
def test_the_inequality_is_that_of_lmi(proofs: dict[str, Certificate], kind: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    gains = random_gains(rng, 3, 2, 2, 2 * (seed % 2), uncertain=True)
    n = gains.model.nx + gains.model.nr
    loop = augmented(gains.model, gains.K1, gains.K2)
    P, Q, R = ((X + X.T) / 2 for X in rng.normal(size=(3, n, n)))
    c = replace(proofs[kind], P=P, Q=Q, R=R, eta=None if proofs[kind].eta is None else 0.8)
    found, error = verify._inequality(gains, c)
    window, weights = Window(1, 3), Weights(P, Q, R)
    eta2 = None if c.eta is None else c.eta**2
    if c.delta_max:
        uncertain = Uncertain(c.delta_max * loop.F, loop.J1, loop.J2)
        expected = np.block(lmi.s_procedure(loop, uncertain, weights, c.mu, eta2, window))
    elif eta2 is None:
        expected = np.block(lmi.stability(loop, weights, window))
    else:
        expected = np.block(lmi.jensen(loop, weights, eta2, window))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    assert np.all(np.abs(found - expected) <= 2 * error)


def test_the_bound_on_rounding_holds_against_exact_arithmetic() -> None:
    rng = np.random.default_rng(0)
    gains = random_gains(rng, 2, 1, 1, 0)
    P, Q, R = (1e3 ** (i - 1) * (X + X.T) for i, X in enumerate(rng.normal(size=(3, 2, 2))))
    found, error = verify._inequality(gains, Certificate("lyapunov", "any", 1, 3, 0.0, 0.9, P, Q, R))
    exact = [[Fraction(0)] * 5 for _ in range(5)]
    A, B, K1, E, C, D = (_exact(X) for X in (*(getattr(gains.model, k) for k in "AB"), gains.K1, gains.model.E,
                                             gains.model.C, gains.model.D))  # fmt: skip
    identity, zero = _exact(np.eye(2)), _exact(np.zeros((2, 1)))
    step = _beside(A, _product(B, K1), E)
    move = _beside(_sum(A, identity, -1), _product(B, K1), E)
    now, past = _beside(identity, _exact(np.zeros((2, 2))), zero), _beside(_exact(np.zeros((2, 2))), identity, zero)
    out = _beside(C, _product(D, K1), _exact(np.zeros((1, 1))))
    P_, Q_, R_ = (_exact(X) for X in (P, Q, R))
    terms = [(Fraction(1), P_, step), (Fraction(3), R_, move), (Fraction(1), _exact(np.eye(1)), out)]
    terms += [(Fraction(-1), P_, now), (Fraction(3), Q_, now), (Fraction(-1), Q_, past)]
    terms += [(Fraction(-1, 3), R_, _sum(now, past, -1))]
    for factor, X, row in terms:
        piece = _product([list(c) for c in zip(*row, strict=True)], _product(X, row))
        exact = _sum(exact, piece, factor)
    exact[4][4] -= Fraction(0.9) ** 2
    for i in range(5):
        for j in range(5):
            assert abs(Fraction(float(found[i, j])) - exact[i][j]) <= Fraction(float(error[i, j]))


Exact = list[list[Fraction]]


def _exact(X: Matrix) -> Exact:
    return [[Fraction(float(v)) for v in row] for row in X]


def _product(X: Exact, Y: Exact) -> Exact:
    return [
        [sum((a * b for a, b in zip(row, col, strict=True)), Fraction(0)) for col in zip(*Y, strict=True)] for row in X
    ]


def _sum(X: Exact, Y: Exact, factor: Fraction | int) -> Exact:
    return [[a + factor * b for a, b in zip(r, s, strict=True)] for r, s in zip(X, Y, strict=True)]


def _beside(*parts: Exact) -> Exact:
    return [[v for part in parts for v in part[i]] for i in range(len(parts[0]))]


def test_a_smaller_eta_is_not_proved(proofs: dict[str, Certificate]) -> None:
    for kind in ("nominal", "robust"):
        value = proofs[kind].eta
        assert value is not None
        assert not check(HIRM, replace(proofs[kind], eta=0.9999 * value)).passed
        assert check(HIRM, replace(proofs[kind], eta=1.1 * value)).passed


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"P": -np.eye(6)}, "P is not positive definite"),
        ({"Q": np.zeros((6, 6))}, "Q is not positive definite"),
        ({"R": np.diag([1, 1, 1, 1, 1, -1e-9])}, "R is not positive definite"),
        ({"P": np.eye(6) + np.eye(6, k=1)}, "P is not symmetric"),
        ({"P": np.eye(6)}, "the inequality of Lemma 1 does not hold"),
        ({"R": np.full((6, 6), np.nan)}, "a number is not finite"),
        ({"P": 1e300 * np.eye(6)}, "a number is too small or too large to be computed with"),
        ({"eta": 1e200}, "a number is too small or too large to be computed with"),
        ({"d_max": 10**400}, "no window of delays: 1 to 1000001"),
        ({"d_max": 4}, "the inequality of Lemma 1 does not hold"),
        ({"d_min": 4}, "no window of delays: 4 to 3"),
        ({"delta_max": 0.15}, "the inequality of Lemma 1 does not hold"),
        ({"mu": -1.0}, "mu, eta or delta_max is out of range"),
        ({"eta": -1.0}, "mu, eta or delta_max is out of range"),
    ],
)
def test_wrong_matrices_fail_with_a_reason(
    proofs: dict[str, Certificate], change: dict[str, object], reason: str
) -> None:
    found = check(HIRM, replace(proofs["nominal"], **change))  # type: ignore[arg-type]
    assert not found.passed
    assert found.reason == reason


def test_a_changed_entry_is_found(proofs: dict[str, Certificate]) -> None:
    for name in "PQR":
        X = getattr(proofs["nominal"], name).copy()
        X[2, 2] *= 0.5
        assert not check(HIRM, replace(proofs["nominal"], **{name: X})).passed, name


def test_other_gains_are_not_proved(proofs: dict[str, Certificate]) -> None:
    other = replace(HIRM, K1=1.5 * HIRM.K1)
    assert not check(other, proofs["nominal"]).passed


@pytest.mark.parametrize(("excess", "passes"), [(1e-15, False), (1e-10, True)])
def test_a_margin_within_rounding_is_no_proof(excess: float, passes: bool) -> None:
    """x⁺ = a x exactly at d-independent Lyapunov equality, then a little inside."""
    model = replace(FEASIBLE.model, A=np.diag([0.5, 0.5]), B=np.zeros((2, 1)))
    gains = replace(FEASIBLE, model=model, K1=np.zeros((1, 2)))
    # P(1 − a²) = 3 Q + R/3 + 3·R/4 … tight by choosing P last
    Q, R = 1e-3 * np.eye(2), 1e-3 * np.eye(2)
    d = 3
    Rd = 1e-3 / d
    need = (3e-3 - Rd + d * 1e-3 * 0.25 + Rd**2 / (1e-3 + Rd)) / 0.75
    found = check(gains, Certificate("lyapunov", "any", 1, 3, 0.0, None, need * (1 + excess) * np.eye(2), Q, R))
    assert found.passed is passes


def test_verified_needs_a_certificate_that_covers_the_window(proofs: dict[str, Certificate]) -> None:
    assert verified(HIRM).reason == "there is no certificate"
    table = proofs["nominal"].table(HIRM, 1.0, {})
    assert verified(replace(HIRM, certificate=table)).reason == (
        "the gains are for delays 1 to 4, the certificate for 1 to 3"
    )
    narrow: Gains = replace(HIRM, d_min=2, d_max=3, certificate=table)
    assert verified(narrow).passed
    other = replace(HIRM, certificate={"method": "oracle"})
    assert verified(other).reason == "method 'oracle' cannot be verified by this version"


def test_matrices_so_small_that_products_vanish_prove_nothing() -> None:
    """x⁺ = A x with ρ(A) = 2: no proof, although every product of such P, Q, R with A underflows to rest."""
    n, tiny = 20, 5e-324
    zeros = np.zeros((n, 1))
    model = Model(
        "unstable", 0.03, np.full((n, n), 0.1), zeros, np.zeros((n, 0)), np.eye(n), zeros,
        tuple(f"x{i}" for i in range(n)), Trim(np.zeros(n), np.zeros(1)),
    )  # fmt: skip
    gains = Gains("unstable", model, 1, 1, np.zeros((1, n)))
    for p, q, r in ((4, 1, 1), (4, 1, 2), (4, 2, 1)):
        identity = tiny * np.eye(n)
        claim = Certificate("lyapunov", "any", 1, 1, 0.0, None, p * identity, q * identity, r * identity)
        assert not check(gains, claim).passed
