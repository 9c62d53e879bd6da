"""Models of the aircraft and the gains that fly it: Eqs. (4), (6), (8) and (9).

    x(k+1) = A x(k) + B u(k) + E w(k),   y(k) = C x(k) + D u(k)
    xr(k+1) = Ar xr(k) + Br r(k),        yr(k) = Cr xr(k)
    u(k) = K1 x(k − d(k)) + K2 xr(k)

States, inputs and outputs are deviations from trim. All arrays are read-only float64.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from itertools import pairwise
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "Actuator",
    "Augmented",
    "Condition",
    "Controller",
    "DynamicFeedback",
    "GainLaw",
    "Gains",
    "Matrix",
    "Model",
    "Reference",
    "Schedule",
    "SmithPredictor",
    "Trim",
    "Uncertainty",
    "augmented",
    "read_only",
    "sets_of",
    "spectral_radius",
    "zero_order_hold",
]

Matrix = NDArray[np.float64]


def read_only(array: ArrayLike) -> Matrix:
    """Return a contiguous float64 copy that cannot be written."""
    copy = np.array(array, dtype=np.float64, order="C")
    copy.flags.writeable = False
    return copy


def _freeze(instance: object) -> None:
    """Make every array of a frozen dataclass read-only, so that no holder can change it for another."""
    for entry in fields(instance):  # type: ignore[arg-type]  # called from dataclasses only
        value = getattr(instance, entry.name)
        if isinstance(value, np.ndarray):
            object.__setattr__(instance, entry.name, read_only(value))


@dataclass(frozen=True, slots=True, eq=False)
class Trim:
    """The absolute values that deviations are counted from.

    Attributes
    ----------
    x : ndarray, shape (nx,)
        State at trim, in the units of the states.
    u : ndarray, shape (nu,)
        Input at trim, in the units of the inputs; the neutral position of the actuator.
    """

    x: Matrix
    u: Matrix

    def __post_init__(self) -> None:
        _freeze(self)


@dataclass(frozen=True, slots=True, eq=False)
class Actuator:
    """Limits and lag of the actuator; None where there is none. ``low`` and ``high`` come together.

    Attributes
    ----------
    low, high : ndarray or None, shape (nu,)
        Travel, absolute, in units of u.
    rate : ndarray or None, shape (nu,)
        Largest speed, in units of u per second.
    tau : ndarray or None, shape (nu,)
        Time constant of a first-order lag, seconds.
    """

    low: Matrix | None = None
    high: Matrix | None = None
    rate: Matrix | None = None
    tau: Matrix | None = None

    def __post_init__(self) -> None:
        assert (self.low is None) == (self.high is None)
        _freeze(self)


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """The reference model xr(k+1) = Ar xr(k) + Br r(k), yr = Cr xr (8), discrete at the model's Ts.

    Attributes
    ----------
    Ar : ndarray, shape (nr, nr)
        Schur: spectral radius below 1.
    Br : ndarray, shape (nr, number of reference inputs)
    Cr : ndarray, shape (ny, nr)
    """

    Ar: Matrix
    Br: Matrix
    Cr: Matrix

    def __post_init__(self) -> None:
        _freeze(self)


@dataclass(frozen=True, slots=True, eq=False)
class Uncertainty:
    """Norm-bounded uncertainty [ΔA ΔB] = F Δ(k) [J1 J2], ‖Δ(k)‖ ≤ delta_max (6), (7), discrete at Ts.

    Attributes
    ----------
    F : ndarray, shape (nx, rows of Δ)
    J1 : ndarray, shape (columns of Δ, nx)
    J2 : ndarray, shape (columns of Δ, nu)
    delta_max : float
        Bound on the spectral norm of Δ; the paper scales F so that it is 1.
    """

    F: Matrix
    J1: Matrix
    J2: Matrix
    delta_max: float

    def __post_init__(self) -> None:
        _freeze(self)


@dataclass(frozen=True, slots=True)
class Condition:
    """The flight condition a model was linearised at; for display.

    Attributes
    ----------
    airspeed_m_s : float
        True airspeed.
    altitude_m : float
        Pressure altitude.
    """

    airspeed_m_s: float
    altitude_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """A linear aircraft sampled at Ts, Eq. (4), with what is needed to fly it.

    Attributes
    ----------
    name : str
    Ts : float
        Sampling period, seconds.
    A : ndarray, shape (nx, nx)
    B : ndarray, shape (nx, nu)
    E : ndarray, shape (nx, nw)
        Disturbance input; nw = 0 where the file has none.
    C : ndarray, shape (ny, nx)
    D : ndarray, shape (ny, nu)
    states : tuple of str, length nx
        Names of the states, with units; their order is that of x.
    trim : Trim
    actuator : Actuator or None
    sensors : Mapping[str, str]
        State name to the MAVLink field that carries it, "MESSAGE.field"; all states, or empty.
    reference : Reference or None
    uncertainty : Uncertainty or None
    condition : Condition or None
    """

    name: str
    Ts: float
    A: Matrix
    B: Matrix
    E: Matrix
    C: Matrix
    D: Matrix
    states: tuple[str, ...]
    trim: Trim
    actuator: Actuator | None = None
    sensors: Mapping[str, str] = field(default_factory=dict)
    reference: Reference | None = None
    uncertainty: Uncertainty | None = None
    condition: Condition | None = None

    def __post_init__(self) -> None:
        _freeze(self)
        nx, nu, ny = self.nx, self.nu, self.ny
        shapes = [array.shape for array in (self.A, self.B, self.E, self.C, self.D)]
        assert shapes == [(nx, nx), (nx, nu), (nx, self.nw), (ny, nx), (ny, nu)], shapes
        assert (len(self.states), self.trim.x.shape, self.trim.u.shape) == (nx, (nx,), (nu,))
        assert not self.sensors or set(self.sensors) == set(self.states)

    @property
    def Ts_ns(self) -> int:
        """Sampling period in nanoseconds."""
        return round(self.Ts * 1e9)

    @property
    def nx(self) -> int:
        """Number of states."""
        return int(self.A.shape[0])

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return int(self.B.shape[1])

    @property
    def ny(self) -> int:
        """Number of outputs."""
        return int(self.C.shape[0])

    @property
    def nw(self) -> int:
        """Number of disturbances."""
        return int(self.E.shape[1])

    @property
    def output_states(self) -> tuple[str, ...]:
        """Name of the state that each output is by C; "" for one that is scaled, mixed or none."""
        chosen = [np.flatnonzero(row) for row in self.C]
        return tuple(
            self.states[which[0]] if len(which) == 1 and row[which[0]] == 1.0 else ""
            for row, which in zip(self.C, chosen, strict=True)
        )

    @property
    def nr(self) -> int:
        """Number of states of the reference model; 0 without one."""
        return 0 if self.reference is None else int(self.reference.Ar.shape[0])


@dataclass(frozen=True, slots=True)
class SmithPredictor:
    """The law on a predicted state, u(k) = K1 x^(j + d) + K2 xr(j + d), from the commands that are under way."""


@dataclass(frozen=True, slots=True, eq=False)
class DynamicFeedback:
    """A linear dynamic controller in place of the law, of deviations from trim.

        xc(k+1) = Ac xc(k) + Bc x(k) + Bcr yr(k) + L (u(k) - v(k)),   v(k) = Cc xc(k) + Dc x(k) + Dcr yr(k)

    u is v within the elevator's travel. A column of zeros in Bc and Dc is a state that is not measured.

    Attributes
    ----------
    Ac : ndarray, shape (nc, nc)
    Bc : ndarray, shape (nc, nx)
    Bcr : ndarray, shape (nc, ny)
    L : ndarray, shape (nc, nu)
        Anti-windup: what a limited elevator takes back.
    Cc : ndarray, shape (nu, nc)
    Dc : ndarray, shape (nu, nx)
    Dcr : ndarray, shape (nu, ny)
    """

    Ac: Matrix
    Bc: Matrix
    Bcr: Matrix
    L: Matrix
    Cc: Matrix
    Dc: Matrix
    Dcr: Matrix

    def __post_init__(self) -> None:
        _freeze(self)


Controller: TypeAlias = SmithPredictor | DynamicFeedback
"""What may fly instead of the law of Eq. (9), to compare; no certificate speaks of it."""


@dataclass(frozen=True, slots=True, eq=False)
class Gains:
    """The law u(k) = K1 x(k − d(k)) + K2 xr(k), Eq. (9), and the delays it may be used at.

    Attributes
    ----------
    name : str
    model : Model
    d_min, d_max : int
        The window of delays, samples.
    K1 : ndarray, shape (nu, nx)
    K2 : ndarray or None, shape (nu, nr)
        None where the model has no reference.
    certificate : Mapping[str, object] or None
        The file's table as it is: nothing here has been verified.
    conservative : Gains or None
        Gains for the same model and a wider window around this one, to fly when the delay leaves this one. They have
        a certificate of their own, and no conservative gains.
    conservative_file : Path or None
        The file of the conservative gains, for naming it again; of no meaning without them.
    controller : Controller or None
        What flies instead of the law of Eq. (9); None for the law. K1 and K2 of a dynamic controller are zero.
    """

    name: str
    model: Model
    d_min: int
    d_max: int
    K1: Matrix
    K2: Matrix | None = None
    certificate: Mapping[str, object] | None = None
    conservative: Gains | None = None
    conservative_file: Path | None = None
    controller: Controller | None = None

    def __post_init__(self) -> None:
        _freeze(self)
        assert self.conservative is None or self.conservative.conservative is None
        assert 0 <= self.d_min <= self.d_max
        assert self.K1.shape == (self.model.nu, self.model.nx)
        assert (self.K2 is None) == (self.model.reference is None)
        assert self.K2 is None or self.K2.shape == (self.model.nu, self.model.nr)


@dataclass(frozen=True, slots=True, eq=False)
class Schedule:
    """Sets of gains for one model, each with its own window of delays; the delay of a command chooses its set.

    Attributes
    ----------
    name : str
    model : Model
    sets : tuple of Gains
        At least one, without certificates. d_min and d_max rise from each to the next, so that no window lies in
        another, and no delay between the first d_min and the last d_max is left out. What one of them has for
        conservative gains is not the schedule's.
    certificate : Mapping[str, object] or None
        The file's table as it is, over all switching between the sets: nothing here has been verified.
    conservative : Gains or None
        As of :class:`Gains`: for a wider window around all the schedule's.
    conservative_file : Path or None
    """

    name: str
    model: Model
    sets: tuple[Gains, ...]
    certificate: Mapping[str, object] | None = None
    conservative: Gains | None = None
    conservative_file: Path | None = None

    def __post_init__(self) -> None:
        assert self.sets
        assert self.conservative is None or self.conservative.conservative is None
        assert all(gains.model is self.model and gains.certificate is None for gains in self.sets)
        for before, after in pairwise(self.sets):
            assert before.d_min < after.d_min <= before.d_max + 1 <= after.d_max

    @property
    def d_min(self) -> int:
        """The least delay of any window, samples."""
        return self.sets[0].d_min

    @property
    def d_max(self) -> int:
        """The largest delay of any window, samples."""
        return self.sets[-1].d_max


GainLaw: TypeAlias = Gains | Schedule
"""What a gain file holds: one set of gains, or several for windows of delays."""


def sets_of(law: GainLaw) -> tuple[Gains, ...]:
    """Return the sets of gains of a law; plain gains are the one set."""
    return law.sets if isinstance(law, Schedule) else (law,)


@dataclass(frozen=True, slots=True, eq=False)
class Augmented:
    """The closed loop over z = [x; xr], v = [w; r], e = y − yr, Eqs. (10) and (11).

        z(k+1) = A z(k) + A1 z(k−d(k)) + B v(k),   e(k) = C z(k) + C1 z(k−d(k))

    with the uncertainty [ΔA ΔA1] = F Δ [J1 J2], ‖Δ‖ ≤ 1, where the model has one; B, C and C1 are certain.

    Attributes
    ----------
    A, A1 : ndarray, shape (n, n)
        n = nx + nr.
    B : ndarray, shape (n, m)
        m = nw + number of reference inputs; may be 0.
    C, C1 : ndarray, shape (ny, n)
    F : ndarray, shape (n, rows of Δ)
        F̄ = [F; 0], as in the model, not scaled by its delta_max; no columns without uncertainty.
    J1, J2 : ndarray, shape (columns of Δ, n)
        J̄1 = [J1, J2 K2] and J̄2 = [J2 K1, 0]; no rows without uncertainty.
    """

    A: Matrix
    A1: Matrix
    B: Matrix
    C: Matrix
    C1: Matrix
    F: Matrix
    J1: Matrix
    J2: Matrix

    def __post_init__(self) -> None:
        _freeze(self)

    @property
    def n(self) -> int:
        """Number of states of plant and reference model together."""
        return int(self.A.shape[0])


def augmented(model: Model, K1: Matrix, K2: Matrix | None) -> Augmented:
    """Return the closed loop of a model under the law (9): the calligraphic matrices of Eqs. (10), (11).

    Parameters
    ----------
    model : Model
    K1 : ndarray, shape (nu, nx)
    K2 : ndarray or None, shape (nu, nr)
        None where the model has no reference.
    """
    nx, nr, nw, ny = model.nx, model.nr, model.nw, model.ny
    reference, uncertainty = model.reference, model.uncertainty
    none = np.zeros
    F, J1, J2 = none((nx, 0)), none((0, nx)), none((0, model.nu))
    if uncertainty is not None:
        F, J1, J2 = uncertainty.F, uncertainty.J1, uncertainty.J2
    Ar, Br, Cr = none((0, 0)), none((0, 0)), none((ny, 0))
    if reference is not None:
        Ar, Br, Cr = reference.Ar, reference.Br, reference.Cr
    if K2 is None:
        K2 = none((model.nu, 0))
    q = J1.shape[0]
    return Augmented(
        A=np.block([[model.A, model.B @ K2], [none((nr, nx)), Ar]]),
        A1=np.block([[model.B @ K1, none((nx, nr))], [none((nr, nx + nr))]]),
        B=np.block([[model.E, none((nx, Br.shape[1]))], [none((nr, nw)), Br]]),
        C=np.hstack([model.C, model.D @ K2 - Cr]),
        C1=np.hstack([model.D @ K1, none((ny, nr))]),
        F=np.vstack([F, none((nr, F.shape[1]))]),
        J1=np.hstack([J1, J2 @ K2]),
        J2=np.hstack([J2 @ K1, none((q, nr))]),
    )


def zero_order_hold(Ap: Matrix, Bp: Matrix, Ts: float) -> tuple[Matrix, Matrix]:
    """Return A = e^{Ap Ts} and B = ∫₀^Ts e^{Ap s} ds Bp.

    Both come from one exponential, exp([[Ap, I], [0, 0]] Ts) = [[A, ∫₀^Ts e^{Ap s} ds], [0, I]]; Bp stays
    outside, so that its size does not spoil the scaling. Several inputs are held at once by their columns:
    ``zero_order_hold(Ap, np.hstack([Bp, Ep]), Ts)``.

    Parameters
    ----------
    Ap : ndarray, shape (nx, nx)
        Per second.
    Bp : ndarray, shape (nx, m)
        Per second; m may be 0.
    Ts : float
        Sampling period, seconds.

    Returns
    -------
    A : ndarray, shape (nx, nx)
    B : ndarray, shape (nx, m)
    """
    from scipy.linalg import expm  # costs 0.2 s, which a program that flies a discrete model need not pay

    nx = Ap.shape[0]
    block = np.zeros((2 * nx, 2 * nx))
    block[:nx, :nx] = Ap
    block[:nx, nx:] = np.eye(nx)
    held = np.asarray(expm(block * Ts), dtype=np.float64)
    return held[:nx, :nx].copy(), held[:nx, nx:] @ Bp


def spectral_radius(matrix: Matrix) -> float:
    """Return max |λ| over the eigenvalues of a square matrix; below 1 means Schur."""
    return float(np.max(np.abs(np.linalg.eigvals(matrix))))
