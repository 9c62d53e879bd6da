"""The closed loop under a varying delay as a switched linear system, section 5: exact.

The delay takes finitely many values, and the delayed state enters only through s(k) = R x(k) with K1 = L R, so that

    ζ(k) = [x(k); s(k−1); …; s(k−d_max); xr(k)]
    ζ(k+1) = F ζ(k) + G v(k) + U p(k),   e(k) = H ζ(k) + H_v v(k),   q(k) = J ζ(k) + J_v v(k),   p = Δ q

with one set of matrices for each mode. A mode is a delay d, a set of gains and, for the law as it is computed at the
controller, the samples a by which the reference is predicted. Which mode may follow which is a :class:`Graph`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import product
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr

from gains.model import GainLaw, Matrix, read_only, sets_of

__all__ = ["Graph", "Key", "Mode", "Switched", "Transitions", "as_flown", "eq9", "factor", "graph", "state_loop"]

Transitions = Literal["any", "fifo"]
_GRID = 2.0**24  # coefficients of a factorisation are sought on this grid first
_ULPS = Fraction(8, 2**52)  # relative, of every entry: what evaluating the law rounds away as well


class Mode(NamedTuple):
    """What one sample does: latch the command of delay d that gain set ``gain_set`` computed; predict by ``ahead``.

    ``ahead`` is that of the command computed now; 0 under Eq. (9), which takes xr at the plant.
    """

    d: int
    gain_set: int = 0
    ahead: int = 0


class Key(NamedTuple):
    """What decides about the transitions: the delay and the gain set of the command at the plant."""

    d: int
    gain_set: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Switched:
    """The matrices of every mode.

    Attributes
    ----------
    modes : tuple of Mode
    F : ndarray, shape (modes, N, N)
        N = nx + slots·d_max + nr.
    G : ndarray, shape (modes, N, m)
        v = [w; r].
    H, Hv : ndarray, shapes (modes, ny, N) and (modes, ny, m)
    U : ndarray, shape (N, rows of Δ)
        F̂, scaled by the bound on ‖Δ‖; no columns without uncertainty.
    J, Jv : ndarray, shapes (modes, columns of Δ, N) and (modes, columns of Δ, m)
    nx, nr : int
        The first nx entries of ζ are x, the last nr are xr.
    """

    modes: tuple[Mode, ...]
    F: Matrix
    G: Matrix
    H: Matrix
    Hv: Matrix
    U: Matrix
    J: Matrix
    Jv: Matrix
    nx: int
    nr: int

    def __post_init__(self) -> None:
        for name in ("F", "G", "H", "Hv", "U", "J", "Jv"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    @property
    def N(self) -> int:
        """Number of entries of ζ."""
        return int(self.F.shape[1])

    @property
    def m(self) -> int:
        """Number of entries of v."""
        return int(self.G.shape[2])

    @property
    def robust(self) -> bool:
        """Whether there is an uncertainty."""
        return int(self.U.shape[1]) > 0

    def index(self, d: int) -> int:
        """Return the first mode of a delay."""
        return next(i for i, mode in enumerate(self.modes) if mode.d == d)


@dataclass(frozen=True, slots=True, eq=False)
class Graph:
    """Storage functions and the transitions between them.

    Attributes
    ----------
    paths : tuple of tuple of Key
        One node for each admissible path of M + 1 keys, the present one last; node i has the storage ζ'P_i ζ.
    edges : ndarray of int, shape (edges, 3)
        (node, next node, mode taken at the node).
    """

    paths: tuple[tuple[Key, ...], ...]
    edges: NDArray[np.intp]


def factor(K1: Matrix) -> tuple[Matrix, Matrix]:
    """Return L, R with K1 = L R and as few rows in R as its rank asks for: rows of K1, or the identity.

    Every entry of the product equals that of K1 to within the rounding of the law itself; where no fewer rows do that,
    all are kept.

    Parameters
    ----------
    K1 : ndarray, shape (rows, nx)
    """
    rows, nx = K1.shape
    column = _powers(np.max(np.abs(K1), axis=0, initial=0.0))
    row = _powers(np.max(np.abs(K1 / column), axis=1, initial=0.0))
    unit = K1 / column / row[:, None]  # the rank does not depend on the units of x and u
    rank = int(np.linalg.matrix_rank(unit))
    if rank < min(rows, nx):
        _, _, order = qr(unit.T, mode="economic", pivoting=True)
        chosen = np.sort(order[:rank])
        raw = np.linalg.lstsq(unit[chosen].T, unit.T, rcond=None)[0].T
        for L in (np.rint(raw * _GRID) / _GRID, raw):  # a coefficient with few digits is exact
            L = L * row[:, None] / row[chosen]
            L[chosen] = np.eye(rank)
            if _is_product(L, K1[chosen], K1):
                return L, K1[chosen]
    return (np.eye(rows), K1.copy()) if rows <= nx else (K1.copy(), np.eye(nx))


def _is_product(L: Matrix, R: Matrix, K1: Matrix) -> bool:
    """Whether every entry of L R, computed without rounding, is that of K1 to within a few units in its last place."""
    left, right = ([[Fraction(x) for x in line] for line in matrix.tolist()] for matrix in (L, R.T))
    return all(
        abs(sum((a * b for a, b in zip(row, column, strict=True)), Fraction(0)) - Fraction(K1[i, j]))
        <= _ULPS * abs(Fraction(K1[i, j]))
        for i, row in enumerate(left)
        for j, column in enumerate(right)
    )


def _powers(sizes: Matrix) -> Matrix:
    """Return the nearest powers of two; 1 for zero."""
    return np.asarray(np.exp2(np.rint(np.log2(np.where(sizes > 0.0, sizes, 1.0)))), dtype=np.float64)


def eq9(law: GainLaw, d_min: int, d_max: int, delta_max: float = 0.0) -> Switched:
    """Return the loop of Eq. (9): xr reaches the actuator without delay.

    Parameters
    ----------
    law : Gains or Schedule
        Of a schedule, every set in every mode that :func:`graph` admits.
    d_min, d_max : int
        0 ≤ d_min ≤ d_max.
    delta_max : float
        Bound on ‖Δ‖; 0 for the nominal model.
    """
    sets = sets_of(law)
    L, R = factor(np.vstack([gains.K1 for gains in sets]))
    nu = law.model.nu
    outs = [L[i * nu : (i + 1) * nu] for i in range(len(sets))]
    modes = [Mode(key.d, key.gain_set) for key in _keys(law, d_min, d_max)]
    into = _Lifted(law, d_max, R.shape[0], delta_max)
    for mode in modes:
        gains = sets[mode.gain_set]
        K2 = np.zeros((nu, 0)) if gains.K2 is None else gains.K2
        control = into.row(nu)  # u as a map of (ζ, v)
        control[:, into.xr] = K2
        if mode.d == 0:
            control[:, into.x] = gains.K1
        else:
            control[:, into.slot(mode.d)] = outs[mode.gain_set]
        store = into.row(R.shape[0])
        store[:, into.x] = R
        into.add(mode, control, store)
    return into.switched()


def as_flown(law: GainLaw, d_min: int, d_max: int, aheads: Sequence[int], delta_max: float = 0.0) -> Switched:
    """Return the loop as it runs: the whole command is computed at the controller and held at the plant.

    c(j) = K1 x(j) + K2 (Ar^a xr(j) + Σ_{i<a} Ar^i Br r(j)), a free in ``aheads`` at every sample: xr is predicted by a
    samples with r held. With the one value 0 the reference is not aligned at all.
    """
    sets, model = sets_of(law), law.model
    nu, count = model.nu, len(sets)
    into = _Lifted(law, d_max, nu * count, delta_max)
    for key, ahead in product(_keys(law, d_min, d_max), aheads):
        mode = Mode(key.d, key.gain_set, ahead)
        commands = into.row(nu * count)
        for i, gains in enumerate(sets):
            rows = slice(i * nu, (i + 1) * nu)
            commands[rows, into.x] = gains.K1
            if gains.K2 is not None and model.reference is not None:
                Ar, Br = model.reference.Ar, model.reference.Br
                held = sum((np.linalg.matrix_power(Ar, n) @ Br for n in range(ahead)), np.zeros_like(Br))
                commands[rows, into.xr] = gains.K2 @ np.linalg.matrix_power(Ar, ahead)
                commands[rows, into.r] = gains.K2 @ held
        own = slice(mode.gain_set * nu, (mode.gain_set + 1) * nu)
        if mode.d == 0:
            control = commands[own].copy()
        else:
            control = into.row(nu)
            control[:, into.slot(mode.d)] = np.eye(nu * count)[own]
        into.add(mode, control, commands)
    return into.switched()


def state_loop(switched: Switched) -> Switched:
    """Return the loop over x and the slots alone, without v and e; it decides stability, as Ar is Schur by itself."""
    keep = slice(0, switched.N - switched.nr)
    modes = len(switched.modes)
    return replace(
        switched,
        F=switched.F[:, keep, keep],
        G=np.zeros((modes, keep.stop, 0)),
        H=np.zeros((modes, 0, keep.stop)),
        Hv=np.zeros((modes, 0, 0)),
        U=switched.U[keep],
        J=switched.J[:, :, keep],
        Jv=np.zeros((modes, switched.J.shape[1], 0)),
        nr=0,
    )


def graph(switched: Switched, law: GainLaw, transitions: Transitions, memory: int = 0) -> Graph:
    """Return which mode may follow which, with one storage for each path of ``memory`` past keys and the present one.

    Under "any" the delay may jump within the window; under "fifo" d⁺ ≤ d + 1. A schedule's set may be any whose
    window, widened by the one sample that an estimate may be wrong, contains d; a command that is held keeps its set.
    """
    keys = list(dict.fromkeys(Key(mode.d, mode.gain_set) for mode in switched.modes))
    follows = {key: [after for after in keys if _may_follow(law, key, after, transitions)] for key in keys}
    starts = {after for afters in follows.values() for after in afters} | {k for k in keys if _fits(law, k)}
    keys = [key for key in keys if key in starts]
    paths: list[tuple[Key, ...]] = [(key,) for key in keys]
    for _ in range(memory):
        paths = [(*path, after) for path in paths for after in follows[path[-1]]]
    number = {path: i for i, path in enumerate(paths)}
    taken: dict[Key, list[int]] = {}
    for i, mode in enumerate(switched.modes):
        taken.setdefault(Key(mode.d, mode.gain_set), []).append(i)
    edges = [
        (i, number[(*path, after)[1:]], mode)
        for i, path in enumerate(paths)
        for after in follows[path[-1]]
        for mode in taken[path[-1]]
    ]
    return Graph(tuple(paths), np.array(edges, dtype=np.intp).reshape(-1, 3))


def _fits(law: GainLaw, key: Key) -> bool:
    """Whether an estimate wrong by at most one sample can have chosen the set at this delay."""
    sets = sets_of(law)
    if len(sets) == 1:
        return True
    own = sets[key.gain_set]
    return own.d_min - 1 <= key.d <= own.d_max + 1


def _may_follow(law: GainLaw, key: Key, after: Key, transitions: Transitions) -> bool:
    if transitions == "fifo" and after.d > key.d + 1:
        return False
    if after.d == key.d + 1:  # the same command, held, keeps its set
        return after.gain_set == key.gain_set
    return _fits(law, after)


def _keys(law: GainLaw, d_min: int, d_max: int) -> list[Key]:
    """Return the pairs of delay and set, held ones included: a command may be held up to d_max."""
    assert 0 <= d_min <= d_max
    sets = sets_of(law)
    if len(sets) == 1:
        return [Key(d) for d in range(d_min, d_max + 1)]
    return [Key(d, i) for d in range(d_min, d_max + 1) for i, own in enumerate(sets) if d >= own.d_min - 1]


class _Lifted:
    """Collects the matrices of the modes, each from two maps of (ζ, v): the control, and what enters the first slot."""

    def __init__(self, law: GainLaw, d_max: int, width: int, delta_max: float) -> None:
        model = law.model
        nx, nr, nw = model.nx, model.nr, model.nw
        self.model, self.width, self.d_max = model, width, d_max
        self.N = nx + width * d_max + nr
        self.x, self.xr = slice(0, nx), slice(self.N - nr, self.N)
        inputs = 0 if model.reference is None else int(model.reference.Br.shape[1])
        self.m = nw + inputs
        self.w, self.r = slice(self.N, self.N + nw), slice(self.N + nw, self.N + self.m)
        uncertainty = model.uncertainty if delta_max > 0.0 else None
        p, q = (0, 0) if uncertainty is None else (uncertainty.F.shape[1], uncertainty.J1.shape[0])
        self.U = np.zeros((self.N, p))
        self.J1, self.J2 = np.zeros((q, nx)), np.zeros((q, model.nu))
        if uncertainty is not None:
            self.U[self.x] = delta_max * uncertainty.F
            self.J1, self.J2 = uncertainty.J1, uncertainty.J2
        self.modes: list[Mode] = []
        self.step: list[Matrix] = []
        self.error: list[Matrix] = []
        self.right: list[Matrix] = []

    def row(self, height: int) -> Matrix:
        return np.zeros((height, self.N + self.m))

    def slot(self, d: int) -> slice:
        """Return where s(k − d) stands in ζ."""
        first = self.x.stop + (d - 1) * self.width
        return slice(first, first + self.width)

    def add(self, mode: Mode, control: Matrix, store: Matrix) -> None:
        model, width = self.model, self.width
        step, error, right = self.row(self.N), self.row(model.ny), self.row(self.J1.shape[0])
        step[self.x] = model.B @ control
        step[self.x, self.x] += model.A
        step[self.x, self.w] = model.E
        if self.d_max:
            step[self.slot(1)] = store
        if self.d_max > 1:
            last = self.slot(self.d_max)
            moved = np.arange(self.slot(2).start, last.stop)
            step[moved, moved - width] = 1.0
        error[:] = model.D @ control
        error[:, self.x] += model.C
        right[:] = self.J2 @ control
        right[:, self.x] += self.J1
        if model.reference is not None:
            step[self.xr, self.xr] = model.reference.Ar
            step[self.xr, self.r] = model.reference.Br
            error[:, self.xr] -= model.reference.Cr
        self.modes.append(mode)
        self.step.append(step)
        self.error.append(error)
        self.right.append(right)

    def switched(self) -> Switched:
        step, error, right = np.stack(self.step), np.stack(self.error), np.stack(self.right)
        N = self.N
        return Switched(
            modes=tuple(self.modes),
            F=step[:, :, :N],
            G=step[:, :, N:],
            H=error[:, :, :N],
            Hv=error[:, :, N:],
            U=self.U,
            J=right[:, :, :N],
            Jv=right[:, :, N:],
            nx=self.model.nx,
            nr=self.model.nr,
        )
