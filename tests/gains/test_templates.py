"""Reference models by template: poles where they should be, r followed without error, level 1, refusals."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from gains.model import Condition, Matrix, Model, Reference, Trim, zero_order_hold
from gains.store import load_model
from gains.table import InputError
from gains.templates import (
    BANDWIDTH_MAX,
    BANDWIDTH_MIN,
    CAP_MAX,
    CAP_MIN,
    TEMPLATES,
    _place,
    short_period,
    with_reference,
)

HIRM, PRINTED = load_model("hirm"), load_model("hirm-printed")
STATES = ("alpha_rad", "q_rad_s", "theta_rad")


def aircraft(
    Z_alpha: float = -2.0,
    M_alpha: float = -9.0,
    M_q: float = -1.0,
    *,
    Ts: float = 0.025,
    airspeed: float | None = 100.0,
    Z_delta: float = -0.1,
    M_delta: float = -10.0,
    pitch: float = 0.0,
) -> Model:
    """Return an aircraft whose motion in continuous time is known."""
    Ap = np.array([[Z_alpha, 1.0, 0.0], [M_alpha, M_q, 0.0], [0.0, 1.0, pitch]])
    A, B = zero_order_hold(Ap, np.array([[Z_delta], [M_delta], [0.0]]), Ts)
    pitch, none = np.array([[0.0, 0.0, 1.0]]), np.zeros((1, 1))
    condition = None if airspeed is None else Condition(airspeed, 0.0)
    trim = Trim(np.zeros(3), np.zeros(1))
    return Model("a", Ts, A, B, np.zeros((3, 0)), pitch, none, STATES, trim, condition=condition)


def reference(model: Model) -> Reference:
    assert model.reference is not None
    return model.reference


def poles(model: Model) -> Matrix:
    """Return the reference model's poles in continuous time, in order."""
    return np.sort_complex(np.log(np.linalg.eigvals(reference(model).Ar).astype(complex)) / model.Ts)


def settled(model: Model) -> Matrix:
    """Return y for constant r = 1."""
    part = reference(model)
    return np.asarray(part.Cr @ np.linalg.solve(np.eye(model.nr) - part.Ar, part.Br))


# -- level 1


def test_the_papers_reference_follows_from_its_poles() -> None:
    """(53) is A0 + B0 [-0.43, 1.43, 1.469], with Br = -1.469 B0; the poles alone give it again."""
    K = np.array([[-0.43, 1.43, 1.469]])
    found = -_place(PRINTED, np.linalg.eigvals(PRINTED.A + PRINTED.B @ K))
    assert found == pytest.approx(K, abs=1e-9)
    printed = reference(PRINTED)
    assert PRINTED.A + PRINTED.B @ found == pytest.approx(printed.Ar, abs=1e-4)  # four digits, rounded twice
    assert -found[0, 2] * PRINTED.B == pytest.approx(printed.Br, abs=1e-4)


@pytest.mark.parametrize("bandwidth", [0.2, 0.75, 5.0])
@pytest.mark.parametrize("damping", [0.35, 0.7, 1.0, 1.3])
def test_level_1_has_a_short_period_and_a_real_pole_of_the_pitch(bandwidth: float, damping: float) -> None:
    plain = aircraft()
    frequency = math.sqrt(2.0 * 1.0 + 9.0)  # of the aircraft itself; level 1 as it is
    wanted = np.roots(np.polymul([1.0, bandwidth], [1.0, 2.0 * damping * frequency, frequency**2]))
    found = poles(with_reference(plain, bandwidth=bandwidth, damping=damping))
    assert found == pytest.approx(np.sort_complex(wanted), abs=1e-5 if damping != 1.0 else 1e-3)  # a double pole's root


@settings(deadline=None, max_examples=50)
@given(
    st.floats(-8.0, -0.1),
    st.floats(-60.0, 3.0),
    st.floats(-8.0, 0.5),
    st.sampled_from([0.004, 0.025, 0.1]),
    st.floats(30.0, 300.0),
)
def test_any_aircraft_gets_a_level_1_reference_that_it_can_fly(
    Z_alpha: float, M_alpha: float, M_q: float, Ts: float, airspeed: float
) -> None:
    plain = aircraft(Z_alpha, M_alpha, M_q, Ts=Ts, airspeed=airspeed)
    part = reference(with_reference(plain))
    load = -Z_alpha * airspeed / 9.80665  # n per radian of alpha
    oscillation = [p for p in poles(with_reference(plain)) if abs(p.imag) > 1e-6]
    assert len(oscillation) == 2
    frequency = abs(oscillation[0])
    assert CAP_MIN * 0.999 <= frequency**2 / load <= CAP_MAX * 1.001
    own = math.sqrt(abs(Z_alpha * M_q - M_alpha))
    if CAP_MIN < own**2 / load < CAP_MAX:
        assert frequency == pytest.approx(own, rel=1e-5)
    assert -oscillation[0].real / frequency == pytest.approx(0.7, rel=1e-5)
    real = next(-p.real for p in poles(with_reference(plain)) if abs(p.imag) <= 1e-6)
    assert real == pytest.approx(min(max(0.5 * frequency, BANDWIDTH_MIN), BANDWIDTH_MAX), rel=1e-4)
    assert settled(with_reference(plain)) == pytest.approx(1.0, abs=1e-6)
    # Without delay a law can follow it exactly: what it asks is within reach of the elevator.
    asked = np.hstack([part.Ar - plain.A, part.Br])
    reach = plain.B @ np.linalg.lstsq(plain.B, asked, rcond=None)[0]
    assert reach == pytest.approx(asked, abs=1e-9)


def test_without_a_condition_every_frequency_is_level_1() -> None:
    slow = aircraft(-0.5, -0.01, -0.1, airspeed=None)
    assert abs(poles(with_reference(slow))[-1]) == pytest.approx(math.sqrt(0.5 * 0.1 + 0.01), rel=1e-4)


def test_the_states_may_come_in_any_order() -> None:
    order = [2, 0, 1]
    turned = replace(
        HIRM,
        A=HIRM.A[np.ix_(order, order)],
        B=HIRM.B[order],
        E=HIRM.E[order],
        C=HIRM.C[:, order],
        states=tuple(HIRM.states[i] for i in order),
        trim=Trim(HIRM.trim.x[order], HIRM.trim.u),
        sensors={},
        uncertainty=None,
    )
    one, other = reference(with_reference(HIRM)), reference(with_reference(turned))
    assert other.Ar == pytest.approx(one.Ar[np.ix_(order, order)], abs=1e-9)
    assert other.Br == pytest.approx(one.Br[order], abs=1e-9)


@pytest.mark.parametrize("template", TEMPLATES)
def test_only_the_reference_changes(template: str) -> None:
    made = with_reference(HIRM, template)  # type: ignore[arg-type]
    for name in HIRM.__dataclass_fields__:
        assert (
            name == "reference"
            or getattr(made, name) is getattr(HIRM, name)
            or np.array_equal(getattr(made, name), getattr(HIRM, name))
        )
    assert settled(made) == pytest.approx(1.0, abs=1e-9)


# -- the short period


@settings(deadline=None, max_examples=50)
@given(st.floats(-8.0, -0.1), st.floats(-60.0, -0.1), st.floats(-8.0, 0.0), st.sampled_from([0.004, 0.025, 0.1]))
def test_the_short_period_is_that_of_the_motion_before_it_was_sampled(
    Z_alpha: float, M_alpha: float, M_q: float, Ts: float
) -> None:
    frequency, damping = short_period(aircraft(Z_alpha, M_alpha, M_q, Ts=Ts))
    assert frequency == pytest.approx(math.sqrt(Z_alpha * M_q - M_alpha), rel=1e-6)
    assert damping == pytest.approx(-(Z_alpha + M_q) / (2.0 * frequency), rel=1e-6)


# -- second order


@pytest.mark.parametrize(("bandwidth", "damping"), [(1.0, 0.7), (0.1, 0.3), (6.0, 1.0), (2.0, 1.8)])
def test_the_second_order_is_scipys(bandwidth: float, damping: float) -> None:
    made = with_reference(HIRM, "second-order", bandwidth=bandwidth, damping=damping)
    part, t = reference(made), np.arange(400) * HIRM.Ts
    system = signal.TransferFunction([bandwidth**2], [1.0, 2.0 * damping * bandwidth, bandwidth**2])
    _, expected = signal.step(system, T=t)
    xr, found = np.zeros(2), []
    for _ in t:
        found.append(float((part.Cr @ xr).item()))
        xr = part.Ar @ xr + part.Br[:, 0]
    assert found == pytest.approx(expected, abs=1e-6)
    assert settled(made) == pytest.approx(1.0)


def test_the_second_order_fits_a_model_that_is_no_aircraft() -> None:
    pendulum = load_model("pendulum")
    one = replace(pendulum, C=pendulum.C[:1], D=pendulum.D[:1], reference=None)
    assert settled(with_reference(one, "second-order")) == pytest.approx(1.0)


# -- refusals


@pytest.mark.parametrize("template", TEMPLATES)
@pytest.mark.parametrize("value", [0.0, -1.0, 1e-9, 1e-300, 1e9, 1e300, math.inf, math.nan])
@pytest.mark.parametrize("option", ["bandwidth", "damping"])
def test_a_number_that_makes_no_reference_is_refused(template: str, option: str, value: float) -> None:
    with pytest.raises(InputError, match=rf"^{option}: expected a number from \S+ to \S+, found "):
        with_reference(HIRM, template, **{option: value})  # type: ignore[arg-type]


@pytest.mark.parametrize("template", TEMPLATES)
@pytest.mark.parametrize("bandwidth", [1e-3, math.pi / 0.025])
@pytest.mark.parametrize("damping", [0.01, 100.0])
def test_every_number_within_the_limits_makes_a_stable_reference(
    template: str, bandwidth: float, damping: float
) -> None:
    made = with_reference(HIRM, template, bandwidth=bandwidth, damping=damping)  # type: ignore[arg-type]
    assert np.abs(np.linalg.eigvals(reference(made).Ar)).max() < 1.0
    assert settled(made) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize(
    ("model", "complaint"),
    [
        (
            replace(HIRM, C=np.eye(3), D=np.zeros((3, 1)), reference=None),
            "expected one input and one output, found 1 and 3",
        ),
        (replace(HIRM, C=np.array([[1.0, 0.0, 0.0]])), "C: expected the pitch angle as output"),
        (replace(HIRM, D=np.array([[1.0]])), "C: expected the pitch angle as output"),
        (
            replace(HIRM, states=("alpha_rad", "q_rad_s", "gamma_rad"), sensors={}),
            "expected states alpha_rad, q_rad_s, t",
        ),
        (replace(HIRM, B=np.zeros((3, 1))), "expected an elevator that reaches every state"),
        (replace(HIRM, A=np.zeros((3, 3))), "expected a short period that was sampled"),
        (aircraft(Z_alpha=0.5), "expected lift that rises with alpha"),
        # lift and moment of the elevator cancel in the steady state; the pitch is no integral, or it were not reached
        (aircraft(M_alpha=-10.0, M_delta=-5.0, Z_delta=-1.0, pitch=-0.1), "expected an elevator that can hold another"),
    ],
)
def test_a_model_that_level_1_does_not_fit_is_refused(model: Model, complaint: str) -> None:
    with pytest.raises(InputError, match=f"^{model.name}: {complaint}"):
        with_reference(model)


def test_a_short_period_wants_alpha_and_q() -> None:
    with pytest.raises(InputError, match=r"^pendulum: expected states alpha_rad and q_rad_s, found "):
        short_period(load_model("pendulum"))
