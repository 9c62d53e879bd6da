"""Exact certificates: every kind passes and survives its file; what was tampered with is refused, with a reason."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import pytest
import tomli_w
from hypothesis import given, settings
from hypothesis import strategies as st

from gains.certificate import claim_hash
from gains.decide import Decision, decide
from gains.exact import ExactAnalysis, eta
from gains.model import GainLaw, Gains, Matrix, Model, Schedule
from gains.proving import write_certified
from gains.stability import Budget
from gains.store import load_gains, load_law
from gains.switched import eq9
from gains.switched_certificate import SwitchedCertificate
from gains.table import InputError
from gains.verify import Verification, verified
from gains.verify_switched import check_switched
from tests.gains.near_edge import near_edge
from tests.gains.test_decide import scalar, two_sets
from tests.gains.test_exact import TWO, several_inputs

HIRM, PENDULUM = load_gains("hirm-paper"), load_gains("pendulum-paper")
RANK_ONE, TREE = several_inputs(0, 1), near_edge(142)

Found = ExactAnalysis | Decision
PROOFS: dict[str, tuple[GainLaw, Callable[[], Found]]] = {
    "eta": (HIRM, lambda: eta(HIRM, 1, 2)),
    "eta with memory": (HIRM, lambda: eta(HIRM, 1, 2, memory=1)),
    "eta of fifo": (HIRM, lambda: eta(HIRM, 1, 4, transitions="fifo")),
    "robust eta": (HIRM, lambda: eta(HIRM, 1, 2, delta_max=0.15)),
    "eta as flown": (HIRM, lambda: eta(HIRM, 1, 2, aheads=(1, 2))),
    "eta of rank one": (RANK_ONE, lambda: eta(RANK_ONE, 0, 2)),
    "eta of a schedule": (TWO, lambda: eta(TWO, 1, 3)),
    "robust stability": (HIRM, lambda: decide(HIRM, 1, 2, delta_max=0.15)),
    "quadratic": (PENDULUM, lambda: decide(PENDULUM, 1, 2)),
    "quadratic of a schedule": (two_sets(0.5), lambda: decide(two_sets(0.5), 0, 3)),
    "tree": (TREE, lambda: decide(TREE, 0, 1)),
    "paths": (TREE, lambda: decide(TREE, 0, 1, budget=Budget(products=1))),
    "contraction": (scalar(0.5, 0.3), lambda: decide(scalar(0.5, 0.3), 1, 3)),
}
_made: dict[str, Found] = {}


def proof(kind: str) -> tuple[GainLaw, Found, SwitchedCertificate]:
    """The law, what was found, and its certificate; found once."""
    law, make = PROOFS[kind]
    found = _made.setdefault(kind, _made[kind] if kind in _made else make())
    assert found.certificate is not None
    return law, found, found.certificate


def saved_model(model: Model, path: Path) -> Path:
    content: dict[str, Any] = {"name": model.name, "Ts": model.Ts}
    content["plant"] = {"continuous": False, "states": list(model.states)}
    content["plant"] |= {name: getattr(model, name).tolist() for name in "ABCD"}
    if model.nw:
        content["plant"]["E"] = model.E.tolist()
    if model.reference is not None:
        content["reference"] = {name: getattr(model.reference, name).tolist() for name in ("Ar", "Br", "Cr")}
    path.write_bytes(tomli_w.dumps(content).encode())
    return path


def saved(kind: str, folder: Path) -> Path:
    law, found, _ = proof(kind)
    name: str | Path = law.model.name if law.model.name in ("hirm", "pendulum") else "model.toml"
    if name == "model.toml":
        name = saved_model(law.model, folder / name)
    file = folder / "gains.toml"
    assert write_certified(file, name, law, found)
    return file


# -- what is true passes


def test_the_kinds_are_what_they_are_called() -> None:
    for kind in ("tree", "paths"):
        assert [block.kind for block in proof(kind)[2].blocks] == [kind]
    assert {block.kind for block in proof("quadratic")[2].blocks} == {"quadratic"}
    assert proof("contraction")[2].contraction is not None
    assert proof("eta of rank one")[2].left is not None
    assert proof("robust eta")[2].mu.size


@pytest.mark.parametrize("kind", PROOFS)
def test_a_proof_passes_with_a_margin_above_its_rounding_and_survives_its_file(kind: str, tmp_path: Path) -> None:
    law, _, certificate = proof(kind)
    direct = check_switched(law, certificate)
    assert direct.passed, direct.reason
    assert direct.reason == ""
    assert 0.0 <= direct.rounding < direct.margin
    loaded = load_law(saved(kind, tmp_path))
    assert verified(loaded) == direct
    assert loaded.certificate is not None
    assert loaded.certificate["method"] == "exact"
    assert loaded.certificate.get("eta") == certificate.eta


# -- what is not, does not


def changed(kind: str, **change: Any) -> str:
    """The reason why a certificate with changed fields fails; empty where it passes."""
    law, _, certificate = proof(kind)
    found = check_switched(law, replace(certificate, **change))
    assert found.passed == (found.reason == "")
    return found.reason


@pytest.mark.parametrize(
    "kind",
    ["eta", "eta with memory", "eta of fifo", "robust eta", "eta as flown", "eta of rank one", "eta of a schedule"],
)
def test_a_smaller_eta_is_not_proved_and_a_larger_is(kind: str) -> None:
    value = proof(kind)[2].eta
    assert value is not None
    assert "inequality of transition" in changed(kind, eta=0.9999 * value)
    assert changed(kind, eta=1.1 * value) == ""


NAN, INF = float("nan"), float("inf")
BEYOND = "a number is too small or too large to be computed with"
NOT_FINITE = "a number is not finite"
OUT = "mu, eta or delta_max is out of range"
COUNT = "expected 2 storages of size 8"
FACTORS = "the factors of K1 do not multiply to it"
FALLS = "the inequality of transition"


@pytest.mark.parametrize(
    ("kind", "change", "reason"),
    [
        ("eta", {"eta": None}, "expected 2 storages of size 5"),
        ("eta", {"eta": -0.2}, OUT),
        ("eta", {"eta": NAN}, NOT_FINITE),
        ("eta", {"eta": INF}, NOT_FINITE),
        ("eta", {"eta": 1e300}, BEYOND),
        ("eta", {"eta": 1e-300}, BEYOND),
        ("eta", {"memory": 1}, "expected 4 storages of size 8"),
        ("eta", {"memory": -1}, "memory or blocks are out of range"),
        ("eta", {"memory": 10**6}, "memory or blocks are out of range"),
        ("eta", {"d_max": 3}, "expected 3 storages of size 9"),
        ("eta", {"d_max": 1}, "expected 1 storages of size 7"),
        ("eta", {"d_min": 0}, "expected 3 storages of size 8"),
        ("eta", {"d_min": 3}, "no window of delays: 3 to 2"),
        ("eta", {"d_min": -1}, "no window of delays: -1 to 2"),
        ("eta", {"d_max": 10**6}, "the window or the predictions are too many"),
        ("eta", {"d_max": 10**30}, "no window of delays: 1 to 1000001"),
        ("eta", {"delta_max": 0.1}, "expected one multiplier for each transition"),
        ("eta", {"delta_max": -0.1}, OUT),
        ("eta", {"delta_max": NAN}, NOT_FINITE),
        ("eta", {"mu": np.ones(4)}, "expected one multiplier for each transition"),
        ("eta", {"aheads": ()}, "the predictions are out of range"),
        ("eta", {"aheads": (-1,)}, "the predictions are out of range"),
        ("eta", {"aheads": (10**6,)}, "the predictions are out of range"),
        ("eta", {"aheads": (10**4,)}, FALLS),
        ("eta", {"aheads": (0,)}, FALLS),
        ("eta", {"contraction": np.ones(3)}, "blocks and contraction prove stability alone"),
        ("eta of fifo", {"transitions": "any"}, FALLS),
        ("robust eta", {"delta_max": 0.2}, FALLS),
        ("robust eta", {"delta_max": 1e200}, BEYOND),
        ("robust eta", {"delta_max": 0.0}, "expected one multiplier for each transition"),
        ("eta as flown", {"aheads": None}, FALLS),
        ("eta as flown", {"aheads": (1, 3)}, FALLS),
        ("eta as flown", {"aheads": (0, 1, 2)}, FALLS),
        ("eta of rank one", {"left": None}, FACTORS),
        ("eta of rank one", {"left": None, "right": None}, "expected 3 storages of size 8"),
        ("eta of a schedule", {"d_max": 2}, "a window of the schedule lies outside"),
        ("eta of a schedule", {"d_min": 2}, "a window of the schedule lies outside"),
        ("robust stability", {"delta_max": 0.3}, FALLS),
        ("robust stability", {"eta": 10.0}, "expected 2 storages of size 8"),
        ("quadratic", {"blocks": ()}, "expected 2 storages of size 4"),
        ("quadratic", {"d_max": 7}, "the blocks are not a partition of the states"),
        ("quadratic", {"delta_max": 0.1}, "an uncertainty that the model does not have"),
        ("quadratic", {"eta": 1.0}, "blocks and contraction prove stability alone"),
        ("quadratic", {"d_max": 10**6}, "the window or the predictions are too many"),
        ("contraction", {"contraction": np.zeros(1)}, "the vector of the contraction is not positive"),
        ("contraction", {"contraction": np.full(1, NAN)}, "the vector of the contraction is not positive"),
        ("contraction", {"contraction": np.ones(2)}, "the vector of the contraction is not positive"),
        ("contraction", {"eta": 0.1}, "blocks and contraction prove stability alone"),
    ],
)
def test_a_changed_field_fails_with_its_reason(kind: str, change: dict[str, Any], reason: str) -> None:
    assert reason in changed(kind, **change)


@pytest.mark.parametrize(
    ("how", "reason"),
    [
        (lambda P: P[::-1], FALLS),
        (lambda P: 1.01 * P, FALLS),
        (lambda P: 0.99 * P, FALLS),
        (lambda P: -P, "a storage is not positive definite"),
        (lambda P: P[:1], COUNT),
        (lambda P: np.concatenate([P, P]), COUNT),
        (lambda P: P[:, :-1, :-1], COUNT),
        (lambda P: np.zeros((0, 0, 0)), COUNT),
        (lambda P: P * NAN, NOT_FINITE),
        (lambda P: P * INF, NOT_FINITE),
        (lambda P: 1e300 * P, BEYOND),
        (lambda P: 1e-300 * P, BEYOND),
        (lambda P: P + np.eye(8, k=1), "a storage is not symmetric"),
    ],
)
def test_changed_storages_fail_with_their_reason(how: Callable[[Matrix], Matrix], reason: str) -> None:
    assert reason in changed("eta", P=how(proof("eta")[2].P))


@pytest.mark.parametrize(
    ("how", "reason"),
    [
        (lambda mu: -mu, OUT),
        (lambda mu: 1.2 * mu, FALLS),
        (lambda mu: mu[::-1], FALLS),
        (lambda mu: mu[:-1], "expected one multiplier for each transition"),
        (lambda mu: 0.0 * mu, BEYOND),
        (lambda mu: mu * NAN, NOT_FINITE),
        (lambda mu: 1e300 * mu, BEYOND),
    ],
)
def test_changed_multipliers_fail_with_their_reason(how: Callable[[Matrix], Matrix], reason: str) -> None:
    assert reason in changed("robust eta", mu=how(proof("robust eta")[2].mu))


def test_factors_that_do_not_multiply_to_the_gains_are_refused() -> None:
    law, _, certificate = proof("eta of rank one")
    left, right = certificate.left, certificate.right
    assert left is not None
    assert right is not None
    for wrong in (
        (1.0001 * left, right),
        (left, 1.0001 * right),
        (left[::-1], right),
        (left.T, right),
        (left, right[:0]),
    ):
        assert changed("eta of rank one", left=wrong[0], right=wrong[1]) == FACTORS
    for value in (NAN, INF, 1e200):
        assert changed("eta of rank one", left=np.full((2, 1), value), right=right) == FACTORS
    assert changed("eta", left=np.ones((3, 1)), right=HIRM.K1) == FACTORS
    cancelling = np.array([[1e16, -1e16]])  # its rounding is larger than K1
    assert changed("eta", left=cancelling, right=np.vstack([HIRM.K1, HIRM.K1])) == FACTORS
    assert isinstance(law, Gains)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"states": (0, 1, 2)}, "not a partition"),
        ({"states": (0, 0, 1, 2)}, "not a partition"),
        ({"states": (1, 2, 3, 4)}, "not a partition"),
        ({"states": (3, 2, 1, 0)}, "a quadratic form does not fall"),
        ({"states": ()}, "not a partition"),
        ({"kind": "paths"}, "expected 2 matrices of size 4"),
        ({"kind": "guess"}, "no proof of the kind 'guess'"),
        ({"P": -np.eye(4)[None]}, "a matrix of a block is not positive definite"),
        ({"P": np.eye(4)[None]}, "a quadratic form does not fall"),
        ({"P": np.eye(3)[None]}, "expected 1 matrices of size 4"),
        ({"P": np.full((1, 4, 4), NAN)}, NOT_FINITE),
        ({"P": np.zeros((0, 0, 0))}, "expected 1 matrices of size 4"),
    ],
)
def test_a_changed_block_fails_with_its_reason(change: dict[str, Any], reason: str) -> None:
    (block,) = proof("quadratic")[2].blocks
    assert reason in changed("quadratic", blocks=(replace(block, **change),))


def test_a_block_twice_is_no_partition() -> None:
    (block,) = proof("quadratic")[2].blocks
    assert "not a partition" in changed("quadratic", blocks=(block, block))


def test_a_proof_for_all_transitions_holds_for_fewer() -> None:
    assert proof("eta")[2].transitions == "any"
    assert changed("eta", transitions="fifo") == ""


def test_other_gains_and_other_models_are_not_proved(tmp_path: Path) -> None:
    for kind in ("eta", "robust eta", "quadratic", "contraction"):
        law, _, certificate = proof(kind)
        assert isinstance(law, Gains)
        assert not check_switched(replace(law, K1=1.9 * law.K1), certificate).passed
        faster = replace(law.model, A=1.5 * law.model.A)
        assert not check_switched(replace(law, model=faster), certificate).passed
    file = saved("eta", tmp_path)
    file.write_text(file.read_text().replace("-0.5054", "-0.5055"))
    with pytest.raises(InputError, match=r"sha256\.gains"):
        load_law(file)


def test_a_certificate_for_a_narrower_window_does_not_cover_the_gains() -> None:
    law, found, certificate = proof("eta")
    assert isinstance(law, Gains)
    table = certificate.table(law, 1.0, {})
    wide = replace(law, d_max=3, certificate=table)
    assert verified(wide).reason == "the gains are for delays 1 to 3, the certificate for 1 to 2"
    assert verified(replace(law, d_min=2, d_max=2, certificate=table)).passed
    assert found.certificate is certificate


def test_a_schedule_with_its_sets_exchanged_is_not_proved() -> None:
    law, _, certificate = proof("eta of a schedule")
    assert isinstance(law, Schedule)
    low, high = law.sets
    crossed = Schedule("two", law.model, (replace(low, K1=high.K1, K2=high.K2), replace(high, K1=low.K1, K2=low.K2)))
    assert not check_switched(crossed, certificate).passed


# -- anything at all


_SCALARS = st.one_of(
    st.sampled_from([NAN, INF, -INF, 0.0, -0.0, 1e308, -1e308, 5e-324, -1, 0, 1, 2, 10**6, 10**30, "", "any", True]),
    st.floats(),
    st.integers(-3, 5),
)
_VALUES = st.recursive(_SCALARS, lambda inner: st.lists(inner, max_size=3), max_leaves=6)


def told(law: GainLaw) -> Verification:
    """What verification says; a refusal by one line is a failure too."""
    try:
        return verified(law)
    except InputError as error:
        return Verification(False, 0.0, 0.0, str(error).splitlines()[0])


@settings(max_examples=150, deadline=None)
@given(st.sampled_from(sorted(PROOFS)), st.integers(0, 10**6), _VALUES, st.booleans())
def test_a_field_that_is_anything_is_refused_or_proves_what_it_says(
    kind: str, which: int, value: Any, drop: bool
) -> None:
    law, _, certificate = proof(kind)
    table = certificate.table(law, 1.0, {})
    keys = sorted(set(table) - {"sha256", "versions"})
    key = keys[which % len(keys)]
    if drop:
        del table[key]
    else:
        table[key] = value
    table["sha256"] = {**table["sha256"], "certificate": claim_hash(table)}  # type: ignore[dict-item]
    found = told(replace(law, certificate=table))
    if key in ("P", "block", "method"):
        assert not found.passed
    assert found.passed == (found.reason == "")


@settings(max_examples=150, deadline=None)
@given(st.sampled_from(sorted(PROOFS)), st.integers(0, 10**6), st.integers(0, 10**6), _SCALARS)
def test_a_number_among_the_matrices_that_is_anything_is_an_error_or_a_verdict(
    kind: str, which: int, where: int, value: Any
) -> None:
    law, _, certificate = proof(kind)
    table = certificate.table(law, 1.0, {})
    nested = [key for key in ("P", "mu", "left", "right", "contraction", "block") if key in table]
    item: Any = table[nested[which % len(nested)]]
    if isinstance(item[0], dict):
        item = item[0]["P"]
    while isinstance(item[0], list):
        item = item[where % len(item)]
    item[where % len(item)] = value
    found = told(replace(law, certificate=table))
    assert found.passed == (found.reason == "")


# -- against multiple precision


def least_eigenvalue(law: Gains, P: Matrix, eta_: float, i: int, j: int) -> mpmath.mpf:
    """Of diag(P_i, η² I) − [F G]'P_j[F G] − [H Hv]'[H Hv] in 40 digits."""
    switched = eq9(law, 1, 2)
    with mpmath.workdps(40):
        step, error = (
            mpmath.matrix(np.hstack([left[i], right[i]]).tolist())
            for left, right in ((switched.F, switched.G), (switched.H, switched.Hv))
        )
        size, N = switched.N + switched.m, switched.N
        left = mpmath.diag([mpmath.mpf(eta_) ** 2] * size)
        for a in range(N):
            for b in range(N):
                left[a, b] = mpmath.mpf(float(P[i][a, b]))
        matrix = left - step.T * mpmath.matrix(P[j].tolist()) * step - error.T * error
        return min(mpmath.eigsy(matrix, eigvals_only=True))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(-12.0, 0.0))
def test_a_perturbation_passes_only_where_every_inequality_holds_in_multiple_precision(seed: int, power: float) -> None:
    law, _, certificate = proof("eta")
    assert isinstance(law, Gains)
    assert certificate.eta is not None
    noise = np.random.default_rng(seed).normal(size=certificate.P.shape)
    P = certificate.P * (1.0 + 10.0**power * (noise + noise.transpose(0, 2, 1)))
    passed = check_switched(law, replace(certificate, P=P)).passed
    holds = all(least_eigenvalue(law, P, certificate.eta, i, j) > 0 for i in range(2) for j in range(2))
    assert holds or not passed
    if power > -3.0:
        assert not passed


def test_a_violation_within_rounding_does_not_pass() -> None:
    """The least η that the storages prove, taken in 40 digits: just below it nothing passes."""
    law, _, certificate = proof("eta")
    assert isinstance(law, Gains)
    assert certificate.eta is not None
    low, high = 0.9 * certificate.eta, certificate.eta
    for _ in range(45):
        middle = (low + high) / 2.0
        holds = all(least_eigenvalue(law, certificate.P, middle, i, j) > 0 for i in range(2) for j in range(2))
        low, high = (low, middle) if holds else (middle, high)
    for value in np.linspace(low * (1.0 - 1e-9), low, 20):
        assert not check_switched(law, replace(certificate, eta=float(value))).passed
