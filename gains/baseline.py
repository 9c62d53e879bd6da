"""Controllers to compare with: what one would design who knows nothing of these proofs.

``lq``
    Tracking by delay-free LQ: the loop without delay, weighted error against weighted elevator, for the aircraft and
    its reference model together; then, as all gains here, zero error for every constant r.
``smith``
    The same gains on a predicted state (:class:`gains.model.SmithPredictor`).
``dfsm``
    A dynamic output-feedback discrete sliding mode with integral action, of the kind that the paper compares itself
    with: after Lai, Edwards, Spurgeon, "On output tracking using dynamic output feedback discrete-time sliding-mode
    controllers", IEEE TAC 52(10), 2007. Taken from there: the integral of the tracking error joins the state, a sliding
    surface is chosen on the whole, the discrete control is linear, the distance from the surface shrinking by a fixed
    factor per sample, and only the output is measured, so that a compensator of the plant's order supplies the rest.
    Ours: that compensator is an observer; poles are searched for, since the paper prints none; anti-windup.

``tuned_dfsm`` searches for the poles with which it follows a step and resists the gust of Eq. (52) best, under delays
that vary in a window. It sees those delays only so; no other knowledge of them is in the controller.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are
from scipy.optimize import Bounds, differential_evolution, minimize
from scipy.signal import place_poles

from gains.model import DynamicFeedback, Gains, Matrix, Model, Reference, SmithPredictor, spectral_radius
from gains.steady import equilibrium
from gains.table import InputError

__all__ = [
    "BASELINES",
    "Baseline",
    "SlidingMode",
    "constant_delay_radius",
    "dfsm",
    "flown_rms",
    "lq",
    "sliding_surface",
    "smith",
    "tuned_dfsm",
]

Baseline = Literal["lq", "smith", "dfsm"]
BASELINES: tuple[Baseline, ...] = ("lq", "smith", "dfsm")

EFFORT = 0.04
"""Weight of the elevator's square where the error's is 1: five degrees of elevator are as bad as one of error."""
SAMPLES = 400
"""Of each simulated response in the search: 10 s of the paper's aircraft."""
SEQUENCES = 8
UNSTABLE = 1e3
STABLE = 0.995
"""Spectral radius, at every constant delay of the window, above which nothing is flown in the search."""
LIMITS = ((0.5, 20.0), (0.3, 1.5), (0.3, 20.0), (0.5, 40.0), (1.0, 40.0), (-5.0, 5.0))
"""Of each number of a sliding mode, in the search."""


def lq(model: Model, window: tuple[int, int], name: str, effort: float = EFFORT) -> Gains:
    """Return the delay-free LQ tracking gains.

    Parameters
    ----------
    model : Model
        With a reference model.
    window : (int, int)
        d_min and d_max in which they may fly; nothing proves them there.
    name : str
        Of the gains.
    effort : float
        Weight of u'u beside e'e.

    Raises
    ------
    InputError
        When the model has no reference model, or LQ has no solution for it.
    """
    reference = _reference(model)
    A = np.block(
        [
            [model.A, np.zeros((model.nx, model.nr))],
            [np.zeros((model.nr, model.nx)), reference.Ar],
        ]
    )
    B = np.vstack([model.B, np.zeros((model.nr, model.nu))])
    C = np.hstack([model.C, -reference.Cr])
    R = effort * np.eye(model.nu)
    try:
        P = solve_discrete_are(A, B, C.T @ C + 1e-9 * np.eye(len(A)), R)
    except np.linalg.LinAlgError as error:
        raise InputError(f"{model.name}: expected a model that LQ can stabilise: {error}") from None
    K = -np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    K1, K2 = K[:, : model.nx], K[:, model.nx :]
    settled = equilibrium(model)
    assert settled is not None
    x, xr = settled.z[: model.nx], settled.z[model.nx :]
    K2 = K2 + (settled.u - K1 @ x - K2 @ xr) @ np.linalg.pinv(xr)
    return Gains(name, model, *window, K1, K2)


def smith(model: Model, window: tuple[int, int], name: str, effort: float = EFFORT) -> Gains:
    """Return the LQ gains on a predicted state; parameters as of :func:`lq`."""
    made = lq(model, window, name, effort)
    return Gains(name, model, *window, made.K1, made.K2, controller=SmithPredictor())


@dataclass(frozen=True, slots=True)
class SlidingMode:
    """What there is to choose of a sliding mode; frequencies in rad/s.

    Attributes
    ----------
    frequency, damping : float
        Of the oscillation on the surface.
    slow : float
        Of the real modes on the surface: one for each further state.
    reaching : float
        With which the distance from the surface decays.
    observer : float
        Of the observer's modes.
    feedforward : float
        From yr straight to the elevator, rad per rad.
    """

    frequency: float
    damping: float
    slow: float
    reaching: float
    observer: float
    feedforward: float


def dfsm(model: Model, window: tuple[int, int], name: str, chosen: SlidingMode) -> Gains:
    """Return the sliding mode with integral action for chosen poles.

    The state is that of the integrator, of the observer; A, B of both with the surface's row S obey
    S (A + B K) = exp(-reaching Ts) S, and the other poles of A + B K are those of the motion on the surface.

    Raises
    ------
    InputError
        When the model has not one input and one output, or its output does not show every state.
    """
    if model.nu != 1 or model.ny != 1 or model.D.any():
        raise InputError(f"{model.name}: expected one input and one output without feedthrough for a sliding mode")
    nx, Ts = model.nx, model.Ts
    A, B = _augmented(model)
    try:
        K = -place_poles(A, B, _poles(chosen, nx + 1, Ts)).gain_matrix
        spread = chosen.observer * (1.0 + 0.1 * np.arange(nx))
        observer = place_poles(model.A.T, model.C.T, np.exp(-spread * Ts)).gain_matrix.T
    except ValueError as error:
        raise InputError(f"{model.name}: expected a model whose output shows every state: {error}") from None
    K_i, K_x = K[:, :1], K[:, 1:]
    return Gains(
        name,
        model,
        *window,
        np.zeros((1, nx)),
        None if model.reference is None else np.zeros((1, model.nr)),
        controller=DynamicFeedback(
            Ac=np.block(
                [[np.eye(1), np.zeros((1, nx))], [model.B @ K_i, model.A + model.B @ K_x - observer @ model.C]]
            ),
            Bc=np.vstack([-Ts * model.C, observer @ model.C]),
            Bcr=np.vstack([[[Ts]], model.B * chosen.feedforward]),
            L=np.vstack([0.5 / K_i, model.B]),
            Cc=K,
            Dc=np.zeros((1, nx)),
            Dcr=np.array([[chosen.feedforward]]),
        ),
    )


def sliding_surface(model: Model, gains: Gains, chosen: SlidingMode) -> Matrix:
    """Return the row S of the surface s = S [integral of the error; x], of length 1."""
    assert isinstance(gains.controller, DynamicFeedback)
    A, B = _augmented(model)
    values, vectors = np.linalg.eig((A + B @ gains.controller.Cc).T)
    S = np.real(vectors[:, np.argmin(np.abs(values - math.exp(-chosen.reaching * model.Ts)))])
    return np.asarray(S / np.linalg.norm(S))


def tuned_dfsm(
    model: Model,
    window: tuple[int, int],
    name: str,
    *,
    seed: int = 1,
    generations: int = 30,
    progress: Callable[[float], None] | None = None,
) -> Gains:
    """Return the sliding mode that follows a step and resists the gust best, of those that a wide search finds.

    Of those stable at every constant delay of the window, it minimises the sum of the two mean squares, of a step of
    1 degree and of Eq. (52) in degrees per second, over these delays and random ones: differential evolution within
    ``LIMITS``, then a simplex.

    Parameters
    ----------
    model : Model
        With a reference model; one input, one output.
    window : (int, int)
        d_min and d_max.
    name : str
    seed : int
        Of the delays and of the search.
    generations : int
        Of the search, 60 candidates each.
    progress : callable, optional
        Is told the root of each better sum, degrees.

    Raises
    ------
    InputError
        When none is stable.
    """
    _reference(model)
    noise = np.random.default_rng(seed)
    constant = np.repeat(np.arange(window[0], window[1] + 1)[:, None], SAMPLES, axis=1)
    delays = np.vstack([constant, noise.integers(window[0], window[1] + 1, size=(SEQUENCES, SAMPLES))])
    best: tuple[float, SlidingMode] | None = None

    def cost(point: Matrix) -> float:
        nonlocal best
        chosen = SlidingMode(*(float(value) for value in (*np.exp(point[:-1]), point[-1])))
        try:
            made = dfsm(model, window, name, chosen)
        except InputError:
            return 2.0 * UNSTABLE
        slowest = max(constant_delay_radius(made, d) for d in range(window[0], window[1] + 1))
        if slowest >= STABLE:
            return UNSTABLE * slowest  # leads back to where it is worth flying
        value = sum(rms**2 for rms in flown_rms(made, delays))
        if not value < UNSTABLE:
            return UNSTABLE
        if best is None or value < best[0]:
            best = value, chosen
            if progress is not None:
                progress(math.sqrt(value))
        return value

    low, high = np.array(LIMITS).T
    low[:-1], high[:-1] = np.log(low[:-1]), np.log(high[:-1])
    found = differential_evolution(
        cost, Bounds(low, high), maxiter=generations, popsize=10, tol=1e-6, polish=False, rng=noise
    )
    minimize(cost, found.x, method="Nelder-Mead", options={"maxfev": 600, "xatol": 1e-4, "fatol": 1e-12})
    if best is None:
        asked = f"a sliding mode that is stable for delays {window[0]} to {window[1]}"
        raise InputError(f"{model.name}: expected {asked}, found none")
    return dfsm(model, window, name, best[1])


def flown_rms(gains: Gains, delays: NDArray[np.int64]) -> tuple[float, float]:
    """Return the rms errors, degrees, on a step of 1 degree and on the gust (52) alone, by Eqs. (4) and (8).

    Parameters
    ----------
    gains : Gains
        With a dynamic controller.
    delays : (sequences, samples) array of int
        d(k) of each; the elevator is neutral before the first command, and saturates nowhere.
    """
    model, c = gains.model, gains.controller
    assert isinstance(c, DynamicFeedback)
    reference = _reference(model)
    runs, samples = delays.shape
    row, rms = np.arange(runs), []
    for r, w in ((1.0, np.zeros(samples)), (0.0, _gust(samples))):
        x, xc, xr = np.zeros((runs, model.nx)), np.zeros((runs, c.Ac.shape[0])), np.zeros((runs, model.nr))
        sent, errors = np.zeros((runs, samples)), np.zeros((runs, samples))
        with np.errstate(over="ignore", invalid="ignore"):
            for k in range(samples):
                yr = xr @ reference.Cr.T
                errors[:, k] = (x @ model.C.T - yr)[:, 0]
                sent[:, k] = (xc @ c.Cc.T + x @ c.Dc.T + yr @ c.Dcr.T)[:, 0]
                xc = xc @ c.Ac.T + x @ c.Bc.T + yr @ c.Bcr.T
                j = k - delays[:, k]
                u = np.where(j >= 0, sent[row, np.maximum(j, 0)], 0.0)
                x = x @ model.A.T + u[:, None] * model.B[:, 0] + (w[k] * model.E[:, 0] if model.nw else 0.0)
                xr = xr @ reference.Ar.T + r * reference.Br[:, 0]
            rms.append(float(np.sqrt(np.mean(errors**2))))
    return rms[0], rms[1]


def constant_delay_radius(gains: Gains, d: int) -> float:
    """Return the spectral radius of the loop of a dynamic controller at a constant delay of d samples, d >= 1."""
    model, c = gains.model, gains.controller
    assert isinstance(c, DynamicFeedback)
    nx, nc = model.nx, c.Ac.shape[0]
    A = np.zeros((nx + nc + d, nx + nc + d))
    A[:nx, :nx], A[:nx, -1:] = model.A, model.B
    A[nx : nx + nc, :nx], A[nx : nx + nc, nx : nx + nc] = c.Bc, c.Ac
    A[nx + nc, :nx], A[nx + nc, nx : nx + nc] = c.Dc[0], c.Cc[0]
    A[nx + nc + 1 :, nx + nc : -1] = np.eye(d - 1)
    return spectral_radius(A)


def _gust(samples: int) -> Matrix:
    """Return w(k) of Eq. (52), degrees per second."""
    step, mu, w = np.array([[0.9922, 0.1247], [-0.1247, 0.9922]]), np.array([0.1, 0.1]), np.zeros(samples)
    for k in range(samples):
        w[k], mu = 25.0 * mu[0], step @ mu
    return w


def _augmented(model: Model) -> tuple[Matrix, Matrix]:
    """Return A, B of the integral of the error -y, and the plant."""
    A = np.block([[np.eye(1), -model.Ts * model.C], [np.zeros((model.nx, 1)), model.A]])
    return A, np.vstack([np.zeros((1, 1)), model.B])


def _poles(chosen: SlidingMode, count: int, Ts: float) -> NDArray[np.complex128]:
    """Return the poles on the surface and the one towards it; real ones are kept apart, as one input asks."""
    beside = chosen.frequency * np.sqrt(complex(1.0 - chosen.damping**2)) * 1j
    at = -chosen.damping * chosen.frequency
    pair = [at + beside, at - beside] if abs(beside) > 1e-6 else [at, 1.05 * at]
    slow = [-chosen.slow * (1.0 + 0.07 * n) for n in range(count - 3)]
    return np.exp(Ts * np.array([*pair, *slow, -chosen.reaching], dtype=np.complex128))


def _reference(model: Model) -> Reference:
    if model.reference is None:
        raise InputError(f"{model.name}: expected a model with [reference], found none")
    return model.reference
