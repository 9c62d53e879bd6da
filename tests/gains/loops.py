"""What the tests of the proofs share: random loops, other units, and simulation of Eq. (10)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gains.model import Gains, Matrix, Model, Reference, Trim, Uncertainty, augmented, spectral_radius

FEASIBLE = Gains(
    "feasible",
    Model(
        name="feasible",
        Ts=0.1,
        A=np.diag([0.4, 0.2]),
        B=np.array([[1.0], [0.5]]),
        E=np.eye(2),
        C=np.array([[1.0, 0.0]]),
        D=np.zeros((1, 1)),
        states=("a", "b"),
        trim=Trim(np.zeros(2), np.zeros(1)),
    ),
    1,
    3,
    np.array([[-0.1, -0.05]]),
)


def random_gains(
    rng: np.random.Generator,
    nx: int = 3,
    nu: int = 1,
    ny: int = 1,
    nr: int = 2,
    *,
    uncertain: bool = False,
    gain: float = 0.1,
) -> Gains:
    """A loop whose plant and reference are Schur, with direct feedthrough, several inputs and outputs at will."""
    A = rng.normal(size=(nx, nx))
    A *= rng.uniform(0.5, 0.95) / spectral_radius(A)
    Ar = rng.normal(size=(nr, nr))
    Ar *= 0.8 / spectral_radius(Ar) if nr else 1.0
    model = Model(
        name="random",
        Ts=0.1,
        A=A,
        B=rng.normal(size=(nx, nu)),
        E=rng.normal(size=(nx, 1)),
        C=rng.normal(size=(ny, nx)),
        D=rng.normal(size=(ny, nu)),
        states=tuple(f"x{i}" for i in range(nx)),
        trim=Trim(np.zeros(nx), np.zeros(nu)),
        reference=Reference(Ar, rng.normal(size=(nr, 1)), rng.normal(size=(ny, nr))) if nr else None,
        uncertainty=Uncertainty(rng.normal(size=(nx, 1)), rng.normal(size=(2, nx)), rng.normal(size=(2, nu)), 0.02)
        if uncertain
        else None,
    )
    K2 = rng.normal(size=(nu, nr)) if nr else None
    return Gains("random", model, 1, 3, gain * rng.normal(size=(nu, nx)), K2)


def in_units(gains: Gains, t: Matrix, error: float = 1.0) -> Gains:
    """The same loop with states x = diag(t) x_new and outputs y = error · y_new."""
    m = gains.model
    model = replace(
        m,
        A=m.A / t[:, None] * t,
        B=m.B / t[:, None],
        E=m.E / t[:, None],
        C=m.C * t / error,
        D=m.D / error,
        reference=None if m.reference is None else replace(m.reference, Cr=m.reference.Cr / error),
        uncertainty=None
        if m.uncertainty is None
        else replace(m.uncertainty, F=m.uncertainty.F / t[:, None], J1=m.uncertainty.J1 * t),
    )
    return replace(gains, model=model, K1=gains.K1 * t)


def simulate(gains: Gains, delays: Matrix, v: Matrix) -> tuple[Matrix, Matrix]:
    """Return z(k), shape (samples + 1, n), and e(k), shape (samples, ny), of Eq. (10) from zero; z(k) = 0 for k < 0."""
    loop = augmented(gains.model, gains.K1, gains.K2)
    z, e = np.zeros((len(v) + 1, loop.n)), np.zeros((len(v), gains.model.ny))
    for k, d in enumerate(delays.astype(int)):
        past = z[k - d] if k >= d else np.zeros(loop.n)
        e[k] = loop.C @ z[k] + loop.C1 @ past
        z[k + 1] = loop.A @ z[k] + loop.A1 @ past + loop.B @ v[k]
    return z, e


def largest_gain(gains: Gains, delays: Matrix) -> float:
    """Return the norm of the map from v to e over a finite delay sequence: its worst disturbance, exactly."""
    samples = len(delays)
    m = augmented(gains.model, gains.K1, gains.K2).B.shape[1]
    columns = []
    for k in range(samples):
        for i in range(m):
            v = np.zeros((samples, m))
            v[k, i] = 1.0
            columns.append(simulate(gains, delays, v)[1].reshape(-1))
    return float(np.linalg.norm(np.array(columns), 2))
