"""Reference models by template, Eq. (8), so that nobody need invent Ar and Br.

``level1`` is the aircraft itself as it should answer. As the paper's reference was made (Ar = A0 + B0 K, Br =
-K_theta B0), the closed loop of a state feedback whose poles are chosen: a short period that MIL-F-8785C calls level 1,
and a real pole, the bandwidth with which the pitch angle follows r. Without delay a law could follow it exactly, since
it asks nothing but what the elevator can do.

``second-order`` is y'' = w^2 (r - y) - 2 z w y' for any model with one output.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import numpy as np

from gains.model import Matrix, Model, Reference, zero_order_hold
from gains.table import InputError

__all__ = ["DAMPING", "TEMPLATES", "Template", "short_period", "with_reference"]

Template = Literal["level1", "second-order"]
TEMPLATES: tuple[Template, ...] = ("level1", "second-order")

DAMPING = 0.7
"""In the middle of level 1's 0.35 to 1.30 (MIL-F-8785C, table IV, categories A and C)."""
CAP_MIN, CAP_MAX = 0.28, 3.6
"""Level 1 of omega_sp^2 / (n/alpha), 1/(s^2 g), category A (MIL-F-8785C, figure 1)."""
BANDWIDTH_SHARE = 0.5
BANDWIDTH_MIN, BANDWIDTH_MAX = 0.5, 1.0
"""Default bandwidth, rad/s: half of the short period's frequency, within these; ours."""
GRAVITY = 9.80665

SLOWEST_RAD_S = 1e-3
"""No bandwidth is below this, or above half the sampling rate: none of those could be told in a flight."""
DAMPING_LOW, DAMPING_HIGH = 0.01, 100.0
STEADY_MIN = 1e-9
"""What a unit of elevator must leave behind in the output."""

_STATES = ("alpha_rad", "q_rad_s", "theta_rad")


def with_reference(
    model: Model, template: Template = "level1", *, bandwidth: float | None = None, damping: float = DAMPING
) -> Model:
    """Return a model with the reference model of a template; its output follows a constant r without error.

    Parameters
    ----------
    model : Model
        With one input and one output; for ``level1`` with states alpha_rad, q_rad_s, theta_rad and the pitch as output.
    template : "level1" or "second-order"
    bandwidth : float, optional
        rad/s: of the pitch's real pole, or w of the second order. By default half of the short period's frequency,
        between 0.5 and 1 rad/s; 1 rad/s where there is no short period.
    damping : float
        Of the complex poles.

    Raises
    ------
    InputError
        When the template does not fit the model, or the numbers make no reference model.
    """
    if model.nu != 1 or model.ny != 1:
        raise InputError(f"{model.name}: expected one input and one output, found {model.nu} and {model.ny}")
    for name, value, low, high in (
        ("bandwidth", bandwidth, SLOWEST_RAD_S, math.pi / model.Ts),
        ("damping", damping, DAMPING_LOW, DAMPING_HIGH),
    ):
        if value is not None and not low <= value <= high:
            raise InputError(f"{name}: expected a number from {low:g} to {high:g}, found {value:g}")
    if template == "level1":
        reference = _level1(model, bandwidth, damping)
    else:
        reference = _second_order(model, 1.0 if bandwidth is None else bandwidth, damping)
    return replace(model, reference=reference)


def short_period(model: Model) -> tuple[float, float]:
    """Return frequency, rad/s, and damping of the short period: of alpha and q, with pitch and speed held.

    A real pair counts as one of the frequency that its product gives; the damping is then 1 or more.

    Raises
    ------
    InputError
        When the model has no alpha_rad and q_rad_s, or is no motion in continuous time that was sampled.
    """
    return _frequency_and_damping(_alpha_and_q(model))


def _frequency_and_damping(motion: Matrix) -> tuple[float, float]:
    frequency = math.sqrt(abs(float(np.linalg.det(motion))))
    return frequency, float(-np.trace(motion) / (2.0 * frequency)) if frequency else 1.0


def _alpha_and_q(model: Model) -> Matrix:
    """Return the motion of alpha and q in continuous time, the other states held; shape (2, 2), per second."""
    from scipy.linalg import logm  # costs 0.2 s

    if not set(_STATES[:2]) <= set(model.states):
        raise InputError(f"{model.name}: expected states {_STATES[0]} and {_STATES[1]}, found {_listed(model)}")
    rows = [model.states.index(name) for name in _STATES[:2]]
    sampled = model.A[np.ix_(rows, rows)]
    poles = np.linalg.eigvals(sampled).astype(complex)
    if ((np.abs(poles.imag) < 1e-12) & (poles.real <= 0.0)).any():
        raise InputError(f"{model.name}: expected a short period that was sampled, found a discrete pole at 0 or below")
    return np.asarray(logm(sampled).real / model.Ts, dtype=np.float64)


def _listed(model: Model) -> str:
    return ", ".join(model.states)


def _level1(model: Model, bandwidth: float | None, damping: float) -> Reference:
    if set(model.states) != set(_STATES):
        raise InputError(
            f"{model.name}: expected states {', '.join(_STATES)} for template level1, found {_listed(model)}"
        )
    pitch = model.states.index("theta_rad")
    if not np.array_equal(model.C[0], np.eye(model.nx)[pitch]) or model.D.any():
        raise InputError(f"{model.name}: C: expected the pitch angle as output for template level1, found another one")
    motion = _alpha_and_q(model)
    low, high = _level1_frequencies(model, motion)
    frequency = min(max(_frequency_and_damping(motion)[0], low), high)
    if bandwidth is None:
        bandwidth = min(max(BANDWIDTH_SHARE * frequency, BANDWIDTH_MIN), BANDWIDTH_MAX)
    beside = frequency * np.sqrt(complex(1.0 - damping**2)) * 1j
    poles = np.exp(model.Ts * np.array([-bandwidth, -damping * frequency + beside, -damping * frequency - beside]))
    K = -_place(model, poles)
    Ar = model.A + model.B @ K
    gain = float((model.C @ np.linalg.solve(np.eye(model.nx) - Ar, model.B)).item())
    if abs(gain) < STEADY_MIN:
        raise InputError(f"{model.name}: expected an elevator that can hold another pitch angle, found one that cannot")
    return Reference(Ar, model.B / gain, model.C)


def _place(model: Model, poles: Matrix) -> Matrix:
    """Return K for which A - B K has these poles, by Ackermann's formula."""
    n = model.nx
    reach = np.hstack([np.linalg.matrix_power(model.A, i) @ model.B for i in range(n)])
    if np.linalg.cond(reach) > 1e12:
        raise InputError(f"{model.name}: expected an elevator that reaches every state, found one that does not")
    characteristic = np.real(np.poly(poles))
    polynomial = sum(
        (c * np.linalg.matrix_power(model.A, n - i) for i, c in enumerate(characteristic)), np.zeros((n, n))
    )
    return np.asarray(np.linalg.solve(reach.T, np.eye(n)[-1]) @ polynomial).reshape(1, n)


def _level1_frequencies(model: Model, motion: Matrix) -> tuple[float, float]:
    """Return the short-period frequencies of level 1, rad/s; without a condition all are.

    n/alpha, the load factor per radian, is V/g times the damping of alpha, -Z_alpha.
    """
    if model.condition is None:
        return 0.0, math.inf
    load = -float(motion[0, 0]) * model.condition.airspeed_m_s / GRAVITY
    if not load > 0.0:
        raise InputError(
            f"{model.name}: expected lift that rises with alpha for template level1, found Z_alpha = {motion[0, 0]:.3g}"
        )
    return math.sqrt(CAP_MIN * load), math.sqrt(CAP_MAX * load)


def _second_order(model: Model, frequency: float, damping: float) -> Reference:
    Ap = np.array([[0.0, 1.0], [-(frequency**2), -2.0 * damping * frequency]])
    Ar, Br = zero_order_hold(Ap, np.array([[0.0], [frequency**2]]), model.Ts)
    return Reference(Ar, Br, np.array([[1.0, 0.0]]))
