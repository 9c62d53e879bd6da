"""What the tests of the switched form share: the lifting over all past states, and the loops run sample by sample."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gains.model import GainLaw, Matrix, Model, sets_of
from gains.switched import Key, Mode, Switched


def full_state(law: GainLaw, d_min: int, d_max: int) -> Switched:
    """z = [x(k); x(k−1); …; x(k−d_max); xr(k)] under Eqs. (4), (8), (9), for every delay and gain set."""
    model, sets = law.model, sets_of(law)
    nx, past = model.nx, model.nx * d_max
    Ar, Br, Cr = of_reference(model)
    nr, m = len(Ar), model.nw + Br.shape[1]
    modes = [Mode(d, i) for d in range(d_min, d_max + 1) for i in range(len(sets))]
    F, G, H, Hv = [], [], [], []
    for d, i, _ in modes:
        chosen = np.zeros((nx, nx + past + nr))
        chosen[:, nx * d : nx * (d + 1)] = np.eye(nx)
        u = sets[i].K1 @ chosen
        K2 = sets[i].K2
        u[:, nx + past :] += 0.0 if K2 is None else K2
        x = np.eye(nx, nx + past + nr)
        xr = np.eye(nx + past + nr)[nx + past :]
        F.append(np.vstack([model.A @ x + model.B @ u, np.eye(past, nx + past + nr), Ar @ xr]))
        into = np.zeros((nx + past + nr, m))
        into[:nx, : model.nw] = model.E
        into[nx + past :, model.nw :] = Br
        G.append(into)
        H.append(model.C @ x + model.D @ u - Cr @ xr)
        Hv.append(np.zeros((model.ny, m)))
    N, q = nx + past + nr, len(modes)
    return Switched(
        modes=tuple(modes),
        F=np.array(F),
        G=np.array(G),
        H=np.array(H),
        Hv=np.array(Hv),
        U=np.zeros((N, 0)),
        J=np.zeros((q, 0, N)),
        Jv=np.zeros((q, 0, m)),
        nx=nx,
        nr=nr,
    )


def of_reference(model: Model) -> tuple[Matrix, Matrix, Matrix]:
    if model.reference is None:
        return np.zeros((0, 0)), np.zeros((0, 0)), np.zeros((model.ny, 0))
    return model.reference.Ar, model.reference.Br, model.reference.Cr


def run_eq9(law: GainLaw, keys: Sequence[Key], v: Matrix) -> Matrix:
    """e(k) of Eqs. (4), (8), (9) from zero, shape (samples, ny)."""
    model, sets = law.model, sets_of(law)
    Ar, Br, Cr = of_reference(model)
    x, xr = [np.zeros(model.nx)], np.zeros(len(Ar))
    e = []
    for k, (d, i) in enumerate(keys):
        u = sets[i].K1 @ (x[k - d] if k >= d else 0.0 * x[0])
        K2 = sets[i].K2
        if K2 is not None:
            u = u + K2 @ xr
        w, r = v[k, : model.nw], v[k, model.nw :]
        e.append(model.C @ x[k] + model.D @ u - Cr @ xr)
        x.append(model.A @ x[k] + model.B @ u + model.E @ w)
        xr = Ar @ xr + Br @ r
    return np.array(e)


def run_flown(law: GainLaw, keys: Sequence[Key], aheads: Sequence[int], v: Matrix) -> Matrix:
    """e(k) from zero where sample k's commands, one of each set, are whole and reach the plant d(k) samples late."""
    model, sets = law.model, sets_of(law)
    Ar, Br, Cr = of_reference(model)
    x, xr = np.zeros(model.nx), np.zeros(len(Ar))
    commands: list[list[Matrix]] = []
    e = []
    for k, ((d, i), ahead) in enumerate(zip(keys, aheads, strict=True)):
        w, r = v[k, : model.nw], v[k, model.nw :]
        predicted = xr
        for _ in range(ahead):
            predicted = Ar @ predicted + Br @ r
        commands.append([own.K1 @ x + (0.0 if own.K2 is None else own.K2 @ predicted) for own in sets])
        u = commands[k - d][i] if k >= d else np.zeros(model.nu)
        e.append(model.C @ x + model.D @ u - Cr @ xr)
        x = model.A @ x + model.B @ u + model.E @ w
        xr = Ar @ xr + Br @ r
    return np.array(e)


def run_switched(switched: Switched, modes: Sequence[int], v: Matrix) -> Matrix:
    """e(k) of the switched form from zero, shape (samples, ny)."""
    zeta, e = np.zeros(switched.N), []
    for i, now in zip(modes, v, strict=True):
        e.append(switched.H[i] @ zeta + switched.Hv[i] @ now)
        zeta = switched.F[i] @ zeta + switched.G[i] @ now
    return np.array(e)


def with_delta(switched: Switched, delta: Matrix) -> Switched:
    """The loop at one Δ: p = Δ q fed back."""
    U = switched.U @ delta
    return replace(switched, F=switched.F + U @ switched.J, G=switched.G + U @ switched.Jv)
