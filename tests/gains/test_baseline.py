"""Comparison controllers: LQ against python-control, the sliding mode against its own poles."""

from __future__ import annotations

import math
from dataclasses import replace

import control
import numpy as np
import pytest

from gains.baseline import SlidingMode, dfsm, flown_rms, lq, sliding_surface, smith
from gains.model import DynamicFeedback, SmithPredictor, spectral_radius
from gains.store import load_gains, load_model, save_gains
from gains.table import InputError
from gains.verify import verified

HIRM = load_model("hirm")
CHOSEN = SlidingMode(2.0, 0.8, 1.0, 8.0, 8.0, 0.3)


def test_the_state_feedback_of_lq_is_that_of_python_control() -> None:
    K, _, _ = control.dlqr(HIRM.A, HIRM.B, HIRM.C.T @ HIRM.C + 1e-9 * np.eye(3), [[0.04]])
    assert np.abs(lq(HIRM, (1, 4), "lq").K1 + K).max() < 1e-6


def test_lq_holds_every_constant_reference() -> None:
    gains, reference = lq(HIRM, (1, 4), "lq"), HIRM.reference
    assert reference is not None
    assert gains.K2 is not None
    x, xr = np.zeros(3), np.zeros(3)
    for _ in range(4000):
        x, xr = HIRM.A @ x + HIRM.B @ (gains.K1 @ x + gains.K2 @ xr), reference.Ar @ xr + reference.Br[:, 0]
    assert x[2] == pytest.approx((reference.Cr @ xr)[0], abs=1e-9)


def test_the_predictor_is_lq_by_another_controller() -> None:
    one, other = lq(HIRM, (1, 6), "x"), smith(HIRM, (1, 6), "x")
    assert np.array_equal(one.K1, other.K1)
    assert isinstance(other.controller, SmithPredictor)


def closed_loop(chosen: SlidingMode) -> np.ndarray:
    """Return the loop of the sliding mode without delay: plant, integrator, observer."""
    c = dfsm(HIRM, (1, 4), "x", chosen).controller
    assert isinstance(c, DynamicFeedback)
    return np.block([[HIRM.A + HIRM.B @ c.Dc, HIRM.B @ c.Cc], [c.Bc, c.Ac]])


def test_the_loop_without_delay_has_the_poles_of_the_surface_of_reaching_and_of_the_observer() -> None:
    found = np.log(np.linalg.eigvals(closed_loop(CHOSEN)).astype(complex)) / HIRM.Ts
    beside = 2.0 * math.sqrt(1.0 - 0.8**2)
    wanted = [-1.6 + beside * 1j, -1.6 - beside * 1j, -1.0, -8.0, -8.0, -8.8, -9.6]
    assert sorted(found, key=lambda v: (v.real, v.imag)) == pytest.approx(
        sorted(map(complex, wanted), key=lambda v: (v.real, v.imag)), abs=1e-3
    )


def test_the_distance_from_the_surface_shrinks_by_a_fixed_factor() -> None:
    gains = dfsm(HIRM, (1, 4), "x", CHOSEN)
    S = sliding_surface(HIRM, gains, CHOSEN)
    c = gains.controller
    assert isinstance(c, DynamicFeedback)
    xi, x = 0.1, np.array([0.02, -0.05, 0.03])
    for _ in range(20):
        s = S @ np.array([xi, *x])
        xi, x = xi - HIRM.Ts * (HIRM.C @ x)[0], HIRM.A @ x + HIRM.B @ (c.Cc @ np.array([xi, *x]))
        assert S @ np.array([xi, *x]) == pytest.approx(math.exp(-8.0 * HIRM.Ts) * s, rel=1e-6, abs=1e-12)


def test_only_the_pitch_angle_is_measured() -> None:
    c = load_gains("hirm-dfsm").controller
    assert isinstance(c, DynamicFeedback)
    assert not c.Dc.any()
    assert not c.Bc[:, :2].any()


def test_the_stored_one_integrates_so_a_constant_error_cannot_last() -> None:
    gains = load_gains("hirm-dfsm")
    delays = np.full((1, 4000), 3)
    step, _ = flown_rms(gains, delays)
    assert step < 0.01  # of 1 degree, over 100 s


def test_the_stored_one_beats_a_guess() -> None:
    delays = np.random.default_rng(5).integers(1, 4, size=(8, 400))
    stored, guess = flown_rms(load_gains("hirm-dfsm"), delays), flown_rms(dfsm(HIRM, (1, 4), "x", CHOSEN), delays)
    assert stored[0] < 0.5 * guess[0]
    assert stored[1] < guess[1]


def test_without_delay_lq_is_stable() -> None:
    gains = lq(HIRM, (1, 4), "x")
    assert spectral_radius(HIRM.A + HIRM.B @ gains.K1) < 1.0


@pytest.mark.parametrize("name", ["hirm-smith", "hirm-dfsm"])
def test_no_proof_speaks_of_them(name: str) -> None:
    proof = verified(load_gains(name))
    assert not proof.passed
    assert proof.reason == "no proof speaks of this controller"


@pytest.mark.parametrize("name", ["hirm-smith", "hirm-dfsm"])
def test_a_file_holds_them_to_the_last_bit(name: str, tmp_path) -> None:
    gains = load_gains(name)
    save_gains(tmp_path / "again.toml", gains, "hirm")
    again = load_gains(tmp_path / "again.toml")
    assert type(again.controller) is type(gains.controller)
    assert np.array_equal(again.K1, gains.K1)
    if isinstance(gains.controller, DynamicFeedback):
        assert isinstance(again.controller, DynamicFeedback)
        for entry in ("Ac", "Bc", "Bcr", "L", "Cc", "Dc", "Dcr"):
            assert np.array_equal(getattr(again.controller, entry), getattr(gains.controller, entry))


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ('controller = "smit"', "controller: expected one of law, smith, dynamic"),
        ('controller = "dynamic"', "dynamic: expected a table"),
        ('controller = "smith"\n[certificate]\nmethod = "x"', "certificate: expected none, as no proof speaks"),
    ],
)
def test_what_is_no_controller_is_refused(change: str, complaint: str, tmp_path) -> None:
    text = 'name = "x"\nmodel = "hirm"\nd_min = 1\nd_max = 4\nK1 = [[0.0, 0.0, 0.0]]\nK2 = [[0.0, 0.0, 0.0]]\n'
    (tmp_path / "x.toml").write_text(text + change)
    with pytest.raises(InputError) as refused:
        load_gains(tmp_path / "x.toml")
    assert complaint in str(refused.value)


def test_a_model_without_reference_has_none() -> None:
    with pytest.raises(InputError, match="expected a model with \\[reference\\]"):
        lq(replace(HIRM, reference=None), (1, 4), "x")
