"""Lemma 1 for given gains: the published and prototyped numbers, units, edge cases, and simulation."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gains import lyapunov, printed
from gains.lyapunov import Analysis, eta, gradient, largest_constant_d, largest_d_max, remaining_effect, stability
from gains.model import Gains, Matrix, augmented, spectral_radius
from gains.store import load_gains
from tests.gains.loops import FEASIBLE, in_units, largest_gain, random_gains, simulate

HIRM, PENDULUM = load_gains("hirm-paper"), load_gains("pendulum-paper")


def proved(found: Analysis) -> float:
    assert found.verdict == "stable", found.reason
    assert found.verification is not None
    assert found.verification.passed
    assert found.verification.margin > found.verification.rounding > 0
    assert found.eta is not None
    return found.eta


# -- the numbers of the paper and of its reading


@pytest.mark.parametrize(("d_max", "expected"), [(1, 0.1231), (2, 0.2475), (3, 0.3956)])
def test_printed_gains_have_the_eta_of_lemma_1(d_max: int, expected: float) -> None:
    assert proved(eta(HIRM, 1, d_max)) == pytest.approx(expected, abs=0.0005)


@pytest.mark.parametrize(("d_max", "expected"), [(1, 0.1546), (2, 0.3055), (3, 1.015)])
def test_printed_gains_have_the_robust_eta_of_lemma_1(d_max: int, expected: float) -> None:
    assert proved(eta(HIRM, 1, d_max, 0.15)) == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("delta", [0.0, 0.15])
def test_printed_gains_at_d_max_4_are_undecided_with_the_reason(delta: float) -> None:
    found = eta(HIRM, 1, 4, delta)
    assert (found.verdict, found.eta, found.certificate) == ("undecided", None, None)
    assert "Lemma 1, a sufficient condition, is infeasible for these gains and delays 1 to 4" in found.reason


def test_at_full_uncertainty_the_elevator_is_nearly_lost_and_that_is_the_reason() -> None:
    assert remaining_effect(HIRM.model, 1.0) == pytest.approx(0.012, abs=0.0005)
    for d_max in (1, 3):
        found = eta(HIRM, 1, d_max, 1.0)
        assert found.verdict == "undecided"
        assert "keep only 1.2% of its effect (other gains may do)" in found.reason
        assert "every" not in found.reason


def test_remaining_effect_is_the_worst_over_the_uncertainty() -> None:
    rng = np.random.default_rng(0)
    model = random_gains(rng, 3, 2, 1, 0, uncertain=True).model
    assert model.uncertainty is not None
    worst = np.inf
    for _ in range(20000):
        delta = rng.normal(size=(1, 2))
        delta /= np.linalg.norm(delta)
        moved = model.B + 0.1 * model.uncertainty.F @ delta @ model.uncertainty.J2
        worst = min(worst, float(np.min(np.sum(model.B * moved, axis=0) / np.sum(model.B**2, axis=0))))
    assert remaining_effect(model, 0.1) == pytest.approx(worst, abs=1e-3)
    assert remaining_effect(PENDULUM.model, 1.0) == 1.0


def test_pendulum_is_proved_up_to_five_samples() -> None:
    found = largest_d_max(PENDULUM, 1, 20)
    assert found.d_max == 5
    assert found.analysis is not None
    assert found.analysis.certificate is not None
    assert found.analysis.certificate.d_max == 5
    assert largest_d_max(PENDULUM, 1, 3).d_max == 3
    assert largest_d_max(PENDULUM, 6, 20).d_max is None
    assert largest_d_max(HIRM, 1, 20).d_max == 3


@pytest.mark.parametrize(("d_max", "expected"), [(4, 91.31), (5, 194.3)])
def test_pendulum_has_the_eta_of_lemma_1(d_max: int, expected: float) -> None:
    assert proved(eta(PENDULUM, 1, d_max)) == pytest.approx(expected, rel=5e-4)


def test_constant_delays_are_exact() -> None:
    found = largest_constant_d(PENDULUM, 1, 20)
    assert found.d_max == 7
    assert found.refuted is not None
    assert found.refuted == (8, pytest.approx(1.0087, abs=1e-4))
    assert lyapunov.constant_radius(PENDULUM, 7) == pytest.approx(0.9924, abs=1e-4)
    found = largest_constant_d(HIRM, 1, 20)
    assert (found.d_max, found.refuted) == (5, (6, pytest.approx(1.0179, abs=1e-4)))
    found = largest_constant_d(HIRM, 1, 4)
    assert (found.d_max, found.refuted) == (4, None)


@pytest.mark.parametrize("nu", [1, 2])
@pytest.mark.parametrize("d", [0, 1, 4])
def test_the_companion_of_inputs_has_the_spectrum_of_that_of_states(nu: int, d: int) -> None:
    gains = random_gains(np.random.default_rng(d), 3, nu, 1, 0)
    nx = 3
    whole = np.zeros((nx * (d + 1), nx * (d + 1)))
    whole[:nx, :nx] = gains.model.A
    whole[:nx, nx * d :] += gains.model.B @ gains.K1
    whole[nx:, : nx * d] = np.eye(nx * d)
    assert lyapunov.constant_radius(gains, d) == pytest.approx(spectral_radius(whole), rel=1e-6)


# -- the printed conditions


@pytest.mark.parametrize(("d_max", "as_printed", "lemma_1"), [(1, 1.663, 1.460), (2, 1.760, 1.545), (3, 3.120, 1.735)])
def test_printed_lemma_2_where_it_is_feasible(d_max: int, as_printed: float, lemma_1: float) -> None:
    found = printed.eta(FEASIBLE, 1, d_max)
    assert proved(found) == pytest.approx(as_printed, abs=1e-3)
    assert found.certificate is not None
    assert found.certificate.method == "printed"
    assert proved(eta(FEASIBLE, 1, d_max)) == pytest.approx(lemma_1, abs=1e-3)


def test_printed_theorem_1_is_more_conservative_than_lemma_1() -> None:
    source = random_gains(np.random.default_rng(0), 2, 1, 1, 0, uncertain=True).model.uncertainty
    gains = replace(FEASIBLE, model=replace(FEASIBLE.model, uncertainty=source))
    as_printed, robust = proved(printed.eta(gains, 1, 2, 0.02)), proved(eta(gains, 1, 2, 0.02))
    assert as_printed > robust > proved(eta(gains, 1, 2))
    assert as_printed > proved(printed.eta(gains, 1, 2))


def test_printed_conditions_are_infeasible_with_the_reason() -> None:
    found = printed.eta(PENDULUM, 1, 1)
    assert found.verdict == "undecided"
    assert "A has an eigenvalue of modulus" in found.reason
    for gains, radius in ((HIRM, 1.954), (PENDULUM, 2.218)):
        loop = augmented(gains.model, gains.K1, gains.K2)
        assert printed.necessary_radius(loop) == pytest.approx(radius, abs=1e-3)
        assert printed.eta(gains, 1, 1).verdict == "undecided"
    near = replace(FEASIBLE, model=replace(FEASIBLE.model, A=np.diag([0.9, 0.8])))
    found = printed.eta(near, 1, 1)
    assert "spectral radius" in found.reason
    assert "these gains" in found.reason


# -- units and shapes


@pytest.mark.parametrize("delta", [0.0, 0.15])
@pytest.mark.parametrize("scale", [[1e3, 1.0, 1.0], [1.0, 1e-3, 1e3], [1e3, 1e-3, 1.0]])
def test_states_in_other_units_give_the_same_eta(scale: list[float], delta: float) -> None:
    expected = proved(eta(HIRM, 1, 3, delta))
    found = eta(in_units(HIRM, np.array(scale), 1e-3), 1, 3, delta)
    assert proved(found) == pytest.approx(1e3 * expected, rel=1e-3)


def test_unstable_plants_several_inputs_and_outputs_and_feedthrough() -> None:
    rng = np.random.default_rng(3)
    gains = random_gains(rng, 3, 2, 2, 2)
    A = np.diag([1.02, 0.9, 0.5])
    K1 = -0.15 * np.linalg.pinv(gains.model.B) @ A
    gains = replace(gains, model=replace(gains.model, A=A), K1=K1)
    assert spectral_radius(A) > 1
    value = proved(eta(gains, 1, 2))
    assert value > largest_gain(gains, rng.integers(1, 3, size=60).astype(float))


def test_one_delay_only_and_wider_windows_cost() -> None:
    values = [proved(eta(HIRM, d, 3)) for d in (3, 2, 1)]
    assert values == sorted(values)
    assert proved(eta(HIRM, 2, 2)) < proved(eta(HIRM, 1, 2)) + 1e-6
    assert proved(eta(HIRM, 0, 2)) > proved(eta(HIRM, 1, 2))


def test_without_disturbance_and_reference_stability_is_the_answer() -> None:
    gains = replace(PENDULUM, model=replace(PENDULUM.model, E=np.zeros((2, 0))))
    found = eta(gains, 1, 5)
    assert (found.verdict, found.eta) == ("stable", None)
    assert found.certificate is not None
    assert eta(gains, 1, 6).verdict == "undecided"


def test_stability_agrees_with_eta_on_what_is_feasible() -> None:
    for d_max in (1, 2, 3, 4):
        assert stability(HIRM, 1, d_max).verdict == eta(HIRM, 1, d_max).verdict


# -- the gradient


@pytest.mark.parametrize("delta", [0.0, 0.15])
@pytest.mark.parametrize("name", ["hirm", "feedthrough"])
def test_the_dual_gives_the_gradient_of_eta_squared(name: str, delta: float) -> None:
    gains = HIRM if name == "hirm" else random_gains(np.random.default_rng(5), 3, 2, 2, 2, uncertain=True, gain=0.02)
    delta = delta if name == "hirm" else 0.02 * delta
    found = eta(gains, 1, 3, delta)
    proved(found)
    assert found.dual is not None
    n, m = gains.model.nx + gains.model.nr, augmented(gains.model, gains.K1, gains.K2).B.shape[1]
    block = found.dual[2 * n : 2 * n + m, 2 * n : 2 * n + m]
    assert np.trace(block) == pytest.approx(1.0, rel=1e-4)
    assert np.linalg.eigvalsh(found.dual)[0] > -1e-6 * np.abs(found.dual).max()
    dK1, dK2 = gradient(gains, found)
    assert dK2 is not None
    for key, slope in (("K1", dK1), ("K2", dK2)):
        K = getattr(gains, key)
        for at in np.ndindex(K.shape):
            step = np.zeros(K.shape)
            step[at] = 1e-4
            ends = [proved(eta(replace(gains, **{key: K + s * step}), 1, 3, delta)) ** 2 for s in (1, -1)]
            expected = (ends[0] - ends[1]) / 2e-4
            assert slope[at] == pytest.approx(expected, rel=5e-3, abs=5e-3 * np.abs(slope).max())


# -- against simulation


def adversarial(gains: Gains, d_max: int, samples: int, rng: np.random.Generator) -> Matrix:
    """Delays that at each sample take the one of [1, d_max] whose next state is largest."""
    loop = augmented(gains.model, gains.K1, gains.K2)
    z = np.zeros((samples + 1, loop.n))
    z[0] = rng.normal(size=loop.n)
    delays = np.ones(samples)
    for k in range(samples):
        ways = [loop.A @ z[k] + loop.A1 @ z[max(k - d, 0)] for d in range(1, d_max + 1)]
        best = int(np.argmax([np.linalg.norm(w) for w in ways]))
        delays[k], z[k + 1] = best + 1, ways[best]
        z[k + 1] /= max(np.linalg.norm(z[k + 1]), 1e-3) if np.linalg.norm(z[k + 1]) > 1e6 else 1.0
    return delays


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    st.integers(0, 10**6), st.integers(1, 3), st.integers(1, 2), st.integers(0, 2), st.sampled_from([0.05, 0.2, 0.5])
)
def test_no_simulation_contradicts_the_verdict(seed: int, d_max: int, nu: int, nr: int, gain: float) -> None:
    rng = np.random.default_rng(seed)
    gains = random_gains(rng, 3, nu, 2, nr, gain=gain)
    found = eta(gains, 1, d_max)
    if found.verdict == "undecided":
        return
    limit = proved(found)
    sequences = [rng.integers(1, d_max + 1, size=30).astype(float), adversarial(gains, d_max, 30, rng)]
    sequences += [np.full(30, float(d)) for d in (1, d_max)]
    for delays in sequences:
        assert largest_gain(gains, delays) < limit


@settings(max_examples=15, deadline=None, derandomize=True)
@given(st.integers(0, 10**6))
def test_no_uncertainty_within_the_bound_contradicts_the_robust_eta(seed: int) -> None:
    rng = np.random.default_rng(seed)
    gains = random_gains(rng, 2, 1, 1, 1, uncertain=True)
    found = eta(gains, 1, 2, 0.05)
    if found.verdict == "undecided":
        return
    limit, model = proved(found), gains.model
    assert model.uncertainty is not None
    for _ in range(4):
        delta = rng.normal(size=(1, 2))
        delta *= 0.05 / np.linalg.norm(delta)
        moved = model.uncertainty.F @ delta
        other = replace(model, A=model.A + moved @ model.uncertainty.J1, B=model.B + moved @ model.uncertainty.J2)
        assert largest_gain(replace(gains, model=other), rng.integers(1, 3, size=30).astype(float)) < limit


def test_the_loop_of_the_proofs_is_eq_4_with_eq_9() -> None:
    """Eqs. (10), (11) against plant, law and reference model stepped one by one."""
    rng = np.random.default_rng(7)
    gains = random_gains(rng, 3, 2, 2, 2)
    m, K2 = gains.model, gains.K2
    assert m.reference is not None
    assert K2 is not None
    delays, v = rng.integers(0, 4, size=20), rng.normal(size=(20, 2))
    z, e = simulate(gains, delays.astype(float), v)
    x, xr = [np.zeros(3)], np.zeros(2)
    for k, d in enumerate(delays):
        np.testing.assert_allclose(z[k], np.concatenate([x[k], xr]), rtol=1e-12, atol=1e-12)
        u = gains.K1 @ (x[k - d] if k >= d else np.zeros(3)) + K2 @ xr
        np.testing.assert_allclose(e[k], m.C @ x[k] + m.D @ u - m.reference.Cr @ xr, rtol=1e-12, atol=1e-12)
        x.append(m.A @ x[k] + m.B @ u + m.E @ v[k, :1])
        xr = m.reference.Ar @ xr + m.reference.Br @ v[k, 1:]
