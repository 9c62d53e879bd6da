"""Random loops on both sides of the edge of stability, and plain runs of them under many delay sequences at once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from gains.model import Gains, Matrix, Model, Trim, spectral_radius
from gains.switched import Transitions

Delays = NDArray[np.intp]


def near_edge(seed: int, spread: float = 0.05) -> Gains:
    """A plant of up to four states under gains of LQR or of chance, with d_max of up to six samples.

    Plant and gains are scaled together until the fastest of some simple delay sequences grows by a number drawn from
    1 − spread to 1 + spread per sample.
    """
    rng = np.random.default_rng(seed)
    nx, nu = int(rng.integers(1, 5)), int(rng.integers(1, 3))
    A = _plant(rng, nx)
    B = rng.normal(size=(nx, nu)) * (rng.random(size=(nx, nu)) < 0.8)
    B[int(rng.integers(nx)), 0] += 1.0
    if rng.random() < 0.6:
        K1 = _lqr(A, B, np.diag(rng.uniform(0.1, 1.0, size=nx)), 10.0 ** rng.uniform(0, 3) * np.eye(nu))
    else:
        K1 = 10.0 ** rng.uniform(-2, 0) * rng.normal(size=(nu, nx))
    d_min = int(rng.integers(0, 3))
    d_max = int(rng.integers(max(1, d_min), 7))
    target = rng.uniform(1.0 - spread, 1.0 + spread)
    low, high = 0.0, 1.0
    while _simple_growth(high * A, high * B @ K1, d_min, d_max) < target:
        low, high = high, 2.0 * high
    for _ in range(12):
        middle = (low + high) / 2.0
        below = _simple_growth(middle * A, middle * B @ K1, d_min, d_max) < target
        low, high = (middle, high) if below else (low, middle)
    model = Model(
        name=f"near-edge-{seed}",
        Ts=0.05,
        A=high * A,
        B=high * B,
        E=np.eye(nx),
        C=np.eye(nx),
        D=np.zeros((nx, nu)),
        states=tuple(f"x{i}" for i in range(nx)),
        trim=Trim(np.zeros(nx), np.zeros(nu)),
    )
    return Gains(model.name, model, d_min, d_max, K1)


def _plant(rng: np.random.Generator, nx: int) -> Matrix:
    """A dense plant, a chain of integrators or a lightly damped one; some unstable."""
    kind = int(rng.integers(3))
    if kind == 0:
        A = rng.normal(size=(nx, nx))
        return np.asarray(A * rng.uniform(0.8, 1.1) / spectral_radius(A))
    if kind == 1:
        return np.eye(nx) + np.diag(rng.uniform(0.02, 0.3, size=nx - 1), 1)
    A = np.diag(rng.uniform(0.5, 1.05, size=nx))
    for i in range(0, nx - 1, 2):
        angle, r = rng.uniform(0.05, 1.0), rng.uniform(0.9, 1.03)
        A[i : i + 2, i : i + 2] = r * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    mixed = np.eye(nx) + 0.3 * rng.normal(size=(nx, nx))
    return np.asarray(mixed @ A @ np.linalg.inv(mixed))


def _lqr(A: Matrix, B: Matrix, Q: Matrix, R: Matrix) -> Matrix:
    """The first gains of an optimum over 50 samples: they exist without stabilisability too."""
    P = Q
    for _ in range(50):
        K = -np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
        P = Q + A.T @ P @ (A + B @ K)
    return np.asarray(K)


def _simple_growth(A: Matrix, BK: Matrix, d_min: int, d_max: int) -> float:
    """Growth per sample of the fastest of: every constant delay, every pair in turn, one sample held to d_max."""
    nx = len(A)
    F = []
    for d in range(d_min, d_max + 1):
        step = np.eye(nx * (d_max + 1), k=-nx)
        step[:nx, :nx] += A
        step[:nx, nx * d : nx * (d + 1)] += BK
        F.append(step)
    sequences = [(i,) for i in range(len(F))] + [(i, j) for i in range(len(F)) for j in range(i)]
    sequences += [(*range(len(F)), *([len(F) - 1] * a)) for a in range(2 * d_max)]
    grown = []
    for sequence in sequences:
        whole = np.eye(len(F[0]))
        for i in sequence:
            whole = F[i] @ whole
        grown.append(spectral_radius(whole) ** (1.0 / len(sequence)))
    return float(max(grown))


def sequences(
    rng: np.random.Generator, d_min: int, d_max: int, transitions: Transitions, samples: int, count: int
) -> Delays:
    """Random admissible delays, shape (samples, count): held, climbing, falling, jumping, each as often as chance."""
    hold, climb, low = rng.uniform(0.0, 1.0, size=(3, count))
    d = rng.integers(d_min, d_max + 1, size=count)
    found = np.empty((samples, count), dtype=np.intp)
    for k in range(samples):
        found[k] = d
        u = rng.random(size=(3, count))
        new = np.where(u[2] < low, d_min, rng.integers(d_min, d_max + 1, size=count))
        new = np.where(u[1] < climb, d + 1, new)
        new = np.where(u[0] < hold * 0.8, d, new)
        d = np.minimum(new, d + 1 if transitions == "fifo" else d_max).clip(d_min, d_max)
    return found


def run(gains: Gains, delays: Delays, rng: np.random.Generator) -> Matrix:
    """‖[x(k); …; x(k − d_max)]‖ of x(k+1) = A x(k) + B K1 x(k − d(k)), shape (samples + 1, count), random pasts."""
    return _simulated(gains, rng, delays.shape[1], len(delays), lambda k, _past, _before: delays[k])


def run_against(gains: Gains, transitions: Transitions, rng: np.random.Generator, samples: int, count: int) -> Matrix:
    """As :func:`run`, each delay chosen so that x(k+1) is longest in a random direction or norm of the run."""
    nx = gains.model.nx
    weights = rng.normal(size=(count, nx, nx))
    window = np.arange(gains.d_min, gains.d_max + 1)
    A, BK = gains.model.A, gains.model.B @ gains.K1

    def worst(k: int, past: Matrix, before: Delays) -> Delays:
        after = past[0] @ A.T + past[window] @ BK.T  # (delays, count, nx)
        length = np.linalg.norm(np.einsum("cij,dcj->dci", weights, after), axis=2)
        if transitions == "fifo" and k > 0:
            length[window[:, None] > before + 1] = -1.0
        return np.asarray(window[length.argmax(axis=0)], dtype=np.intp)

    return _simulated(gains, rng, count, samples, worst)


def _simulated(
    gains: Gains, rng: np.random.Generator, count: int, samples: int, choose: Callable[[int, Matrix, Delays], Delays]
) -> Matrix:
    A, BK = gains.model.A, gains.model.B @ gains.K1
    past = rng.normal(size=(gains.d_max + 1, count, gains.model.nx))  # x(k), x(k−1), …
    norms = [np.linalg.norm(past, axis=(0, 2))]
    d = np.zeros(count, dtype=np.intp)
    every = np.arange(count)
    for k in range(samples):
        d = choose(k, past, d)
        past = np.concatenate([(past[0] @ A.T + past[d, every] @ BK.T)[None], past[:-1]])
        norms.append(np.linalg.norm(past, axis=(0, 2)))
    return np.array(norms)
