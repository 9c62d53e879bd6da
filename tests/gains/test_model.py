"""Holds and closed loops against scipy, against an analytic case and against the printed numbers."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import cont2discrete

from gains.model import (
    Actuator,
    Gains,
    Matrix,
    Model,
    Schedule,
    Trim,
    read_only,
    sets_of,
    spectral_radius,
    zero_order_hold,
)
from gains.store import load_gains, load_model


def delayed_companion(A: Matrix, B: Matrix, K1: Matrix, d: int) -> Matrix:
    """x(k+1) = A x(k) + B K1 x(k−d) as one matrix over [x(k), x(k−1), …, x(k−d)]."""
    nx = A.shape[0]
    companion = np.zeros((nx * (d + 1), nx * (d + 1)))
    companion[:nx, :nx] = A
    companion[:nx, nx * d :] += B @ K1
    companion[nx:, : nx * d] = np.eye(nx * d)
    return companion


def test_zero_order_hold_of_the_double_integrator_is_the_analytic_one() -> None:
    Ts = 0.25
    A, B = zero_order_hold(np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), Ts)
    np.testing.assert_allclose(A, [[1.0, Ts], [0.0, 1.0]], rtol=0, atol=1e-15)
    np.testing.assert_allclose(B, [[Ts**2 / 2], [Ts]], rtol=0, atol=1e-15)


@pytest.mark.parametrize("inputs", [1, 3])
def test_zero_order_hold_agrees_with_scipy(inputs: int) -> None:
    rng = np.random.default_rng(7)
    for nx in range(1, 7):
        Ap, Bp = rng.normal(size=(nx, nx)), rng.normal(size=(nx, inputs))
        A, B = zero_order_hold(Ap, Bp, 0.1)
        A_scipy, B_scipy, *_ = cont2discrete((Ap, Bp, np.eye(nx), np.zeros((nx, inputs))), 0.1)
        np.testing.assert_allclose(A, A_scipy, rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(B, B_scipy, rtol=1e-12, atol=1e-14)


def test_zero_order_hold_keeps_its_precision_for_inputs_of_any_size() -> None:
    Ap, Bp = np.array([[-1.0, 2.0], [0.0, -3.0]]), np.array([[1.0], [1.0]])
    A, B = zero_order_hold(Ap, Bp, 0.1)
    A_large, B_large = zero_order_hold(Ap, 2.0**60 * Bp, 0.1)
    assert (A_large == A).all()
    assert (B_large == 2.0**60 * B).all()


def test_zero_order_hold_of_no_input_has_no_columns() -> None:
    A, B = zero_order_hold(np.eye(2), np.zeros((2, 0)), 0.1)
    assert A.shape == (2, 2)
    assert B.shape == (2, 0)


def test_exact_hold_of_hirm_is_the_printed_one_but_for_the_two_entries_known_to_differ() -> None:
    exact, printed = load_model("hirm"), load_model("hirm-printed")
    differs = np.abs(exact.A - printed.A) > 1e-4
    assert np.argwhere(differs).tolist() == [[0, 1]]
    assert exact.A[0, 1] == pytest.approx(0.0247, abs=5e-5)
    assert exact.A[2, 0] == pytest.approx(-0.00033, abs=5e-6)
    np.testing.assert_allclose(exact.B, printed.B, rtol=0, atol=1e-4)
    assert exact.E[0, 0] == pytest.approx(0.0248, abs=5e-5)
    assert printed.E[:, 0].tolist() == [0.0230, 0.0, 0.0]


def test_disturbance_of_hirm_is_held_like_its_input() -> None:
    model = load_model("hirm")
    Ap = np.array([[-0.5427, 1.0, 0.0], [-1.069, -0.4134, 0.0], [0.0, 1.0, 0.0]])
    Ep = np.array([[1.0], [0.0], [0.0]])
    _, E, *_ = cont2discrete((Ap, Ep, np.eye(3), np.zeros((3, 1))), 0.025)
    np.testing.assert_allclose(model.E, E, rtol=0, atol=1e-15)


def test_reference_of_hirm_is_the_printed_plant_under_state_feedback() -> None:
    model = load_model("hirm-printed")
    assert model.reference is not None
    feedback = np.array([[-0.43, 1.43, 1.469]])
    np.testing.assert_allclose(model.reference.Ar, model.A + model.B @ feedback, rtol=0, atol=1e-4)
    np.testing.assert_allclose(model.reference.Br, -1.469 * model.B, rtol=0, atol=1e-4)


def test_reference_of_hirm_has_unit_steady_state_gain() -> None:
    reference = load_model("hirm").reference
    assert reference is not None
    gain = reference.Cr @ np.linalg.solve(np.eye(3) - reference.Ar, reference.Br)
    assert gain.item() == pytest.approx(1.0, abs=0.02)


def test_exact_hold_of_the_pendulum_is_the_printed_one() -> None:
    exact, printed = load_model("pendulum-exact"), load_model("pendulum")
    np.testing.assert_allclose(exact.A, printed.A, rtol=0, atol=5.0001e-5)
    np.testing.assert_allclose(exact.B, printed.B, rtol=0, atol=5.0001e-5)


@pytest.mark.parametrize(
    ("name", "d", "radius"),
    [
        ("hirm-paper", 5, 0.9989),
        ("hirm-paper", 6, 1.0179),
        ("pendulum-paper", 7, 0.9924),
        ("pendulum-paper", 8, 1.0087),
    ],
)
def test_closed_loop_at_a_constant_delay_has_the_known_spectral_radius(name: str, d: int, radius: float) -> None:
    gains = load_gains(name)
    companion = delayed_companion(gains.model.A, gains.model.B, gains.K1, d)
    assert spectral_radius(companion) == pytest.approx(radius, abs=5e-5)


@pytest.mark.parametrize("name", ["hirm-paper", "pendulum-paper"])
def test_closed_loop_is_stable_at_every_constant_delay_of_its_window(name: str) -> None:
    gains = load_gains(name)
    for d in range(gains.d_min, gains.d_max + 1):
        assert spectral_radius(delayed_companion(gains.model.A, gains.model.B, gains.K1, d)) < 1.0


def test_spectral_radius_of_a_rotation_is_its_scale() -> None:
    assert spectral_radius(np.array([[0.0, -0.5], [0.5, 0.0]])) == pytest.approx(0.5)


def test_arrays_of_a_model_are_read_only_copies() -> None:
    A = np.eye(1)
    model = Model(
        "one", 0.1, A, np.ones((1, 1)), np.zeros((1, 0)), np.eye(1), np.zeros((1, 1)), ("x",),
        Trim(np.zeros(1), np.zeros(1)),
    )  # fmt: skip
    A[0, 0] = 5.0
    assert model.A[0, 0] == 1.0
    for array in (model.A, model.B, model.E, model.C, model.D, model.trim.x, model.trim.u):
        assert array.dtype == np.float64
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0.0
    assert (model.nx, model.nu, model.ny, model.nw, model.nr) == (1, 1, 1, 0, 0)


def test_read_only_leaves_its_argument_alone() -> None:
    source = np.arange(6.0).reshape(2, 3).T
    copy = read_only(source)
    assert copy.flags.c_contiguous
    assert not copy.flags.writeable
    assert source.flags.writeable


def test_shapes_that_disagree_assert() -> None:
    with pytest.raises(AssertionError):
        Model(
            "one", 0.1, np.eye(2), np.ones((1, 1)), np.zeros((2, 0)), np.eye(2), np.zeros((2, 1)), ("x", "y"),
            Trim(np.zeros(2), np.zeros(1)),
        )  # fmt: skip


def test_a_travel_with_one_end_asserts() -> None:
    with pytest.raises(AssertionError):
        Actuator(low=np.zeros(1))


@pytest.mark.parametrize(("name", "Ts_ns"), [("hirm", 25_000_000), ("pendulum", 30_000_000)])
def test_sampling_period_is_whole_nanoseconds(name: str, Ts_ns: int) -> None:
    assert load_model(name).Ts_ns == Ts_ns


def test_gains_survive_pickling() -> None:
    gains = pickle.loads(pickle.dumps(load_gains("hirm-paper")))
    assert (gains.K1 == load_gains("hirm-paper").K1).all()
    assert gains.model.sensors["theta_rad"] == "ATTITUDE.pitch"


HIRM = load_gains("hirm-paper")


def with_windows(*windows: tuple[int, int]) -> tuple[Gains, ...]:
    return tuple(replace(HIRM, name=f"s[{i}]", d_min=a, d_max=b) for i, (a, b) in enumerate(windows))


def test_the_window_of_a_schedule_is_that_of_all_its_sets() -> None:
    sets = with_windows((1, 3), (2, 5), (6, 9))
    schedule = Schedule("s", HIRM.model, sets)
    assert (schedule.d_min, schedule.d_max) == (1, 9)
    assert sets_of(schedule) == sets
    assert sets_of(HIRM) == (HIRM,)


@pytest.mark.parametrize(
    "windows",
    [
        [],
        [(2, 5), (1, 3)],  # not in order
        [(1, 3), (1, 3)],
        [(1, 3), (1, 5)],  # one in the other
        [(1, 5), (2, 5)],
        [(1, 5), (2, 4)],
        [(1, 3), (5, 6)],  # 4 left out
    ],
)
def test_windows_out_of_order_inside_one_another_or_apart_assert(windows: list[tuple[int, int]]) -> None:
    with pytest.raises(AssertionError):
        Schedule("s", HIRM.model, with_windows(*windows))


def test_sets_of_another_model_or_with_a_certificate_of_their_own_assert() -> None:
    for odd in (replace(HIRM, model=replace(HIRM.model)), replace(HIRM, certificate={})):
        with pytest.raises(AssertionError):
            Schedule("s", HIRM.model, (odd,))


def test_a_schedule_survives_pickling() -> None:
    schedule = pickle.loads(pickle.dumps(Schedule("s", HIRM.model, with_windows((1, 2), (3, 4)))))
    assert [(gains.d_min, gains.d_max) for gains in schedule.sets] == [(1, 2), (3, 4)]
