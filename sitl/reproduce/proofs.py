"""What the gains package proves about the paper's gains and ours: η by method, robust η, printed conditions."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from gains import exact, lyapunov, printed
from gains.decide import Decision, decide
from gains.design import design
from gains.lower_gain import worst_gain
from gains.model import Gains, Model, Trim, augmented, spectral_radius
from gains.store import load_gains
from gains.switched import eq9, graph
from gains.table import InputError
from gains.verify import verified
from sitl.reproduce.cases import CONTROLLERS, D_MAX, D_MIN, PENDULUM, PUBLISHED
from sitl.reproduce.claims import Cell, Table
from sitl.reproduce.flights import follows_eq9

__all__ = ["DELTA", "Eta", "Feasible", "Proofs", "Sizes", "eta_table", "feasibility_table", "prove", "small_example"]

DELTA = 0.15
"""Bound on ‖Δ‖ that the paper simulates, Eq. (51)."""
WINDOWS = (1, 2, 3, 4)
"""d_max of the published gains' table."""
FRESH = "designed in this run, from the model alone"


@dataclass(frozen=True, slots=True)
class Eta:
    """What is proved of gains in one window, d_min = 1.

    Attributes
    ----------
    gains : str
    d_max : int
    lemma1, lemma1_robust : float or None
        η by Lemma 1, nominal and with ‖Δ‖ ≤ ``DELTA``; None where infeasible.
    exact, exact_robust : float or None
        η on the lifted form, storages that know the present delay.
    lower : float or None
        η that a delay sequence reaches; None where it was not sought.
    """

    gains: str
    d_max: int
    lemma1: float | None
    lemma1_robust: float | None
    exact: float | None
    exact_robust: float | None
    lower: float | None = None


@dataclass(frozen=True, slots=True)
class Feasible:
    """Whether Lemma 2 as printed, Eq. (31), may have a solution for given gains.

    Attributes
    ----------
    gains : str
    rho : float
        ρ(A): at 1 and above no gains at all are feasible.
    necessary : float
        ρ(A⊗A + (A+A1)⊗(A+A1)): below 1 is necessary for these gains.
    """

    gains: str
    rho: float
    necessary: float


@dataclass(frozen=True, slots=True)
class Sizes:
    """The printed Lemma 2 against Lemma 1 on a small plant where the printed one is feasible.

    Attributes
    ----------
    d_max : int
    printed, lemma1 : float or None
        η.
    """

    d_max: int
    printed: float | None
    lemma1: float | None


@dataclass(frozen=True, slots=True, eq=False)
class Proofs:
    """All of it.

    Attributes
    ----------
    etas : tuple of Eta
        Published gains in every window, then each other set in the window of the flights, and its own.
    ends : mapping of int to (float or None, float or None)
        η of the published gains on [d_min, 3] by Lemma 1 and exact, by d_min.
    feasible : tuple of Feasible
    small : tuple of Sizes
    full_delta : mapping of int to Decision
        The published gains at ‖Δ‖ ≤ 1, by d_max.
    verified : mapping of str to bool
        Of our stored designs: whether the certificate in the file passes.
    fresh : float or None
        η of a design for the window of the flights made in this run; None where quick.
    skipped : tuple of str
        What a quick run left out.
    """

    etas: tuple[Eta, ...]
    ends: dict[int, tuple[float | None, float | None]]
    feasible: tuple[Feasible, ...]
    small: tuple[Sizes, ...]
    full_delta: dict[int, Decision]
    verified: dict[str, bool]
    fresh: float | None = None
    skipped: tuple[str, ...] = field(default=())

    def eta(self, gains: str, d_max: int) -> Eta | None:
        """Return the row of a gain file and a window."""
        return next((row for row in self.etas if (row.gains, row.d_max) == (gains, d_max)), None)


def prove(tell: Callable[[str], None], *, quick: bool = False) -> Proofs:
    """Prove everything; a quick run seeks no lower bounds and designs nothing."""
    published = load_gains(PUBLISHED)
    etas = []
    for d_max in WINDOWS:
        tell(f"proofs: η of {PUBLISHED}, delays 1 to {d_max}")
        etas.append(_eta(published, d_max, lower=not quick))
    ours = [load_gains(c.gains) for c in CONTROLLERS if c.role == "ours"]
    for gains in (*ours, *_comparisons()):
        for d_max in sorted({D_MAX, gains.d_max} if gains in ours else {D_MAX}):
            tell(f"proofs: η of {gains.name}, delays 1 to {d_max}")
            etas.append(_eta(gains, d_max, lower=not quick))
    tell("proofs: the printed conditions")
    ends = {d: (lyapunov.eta(published, d, 3).eta, exact.eta(published, d, 3).eta) for d in (1, 2, 3)}
    feasible = tuple(_feasible(load_gains(name)) for name in (PENDULUM, PUBLISHED))
    small = tuple(
        Sizes(d, printed.eta(small_example(), 1, d).eta, lyapunov.eta(small_example(), 1, d).eta) for d in (1, 2, 3)
    )
    tell("proofs: the published gains at ‖Δ‖ ≤ 1")
    full = {d: decide(published, 1, d, delta_max=1.0) for d in (1, 2, 3)}
    proofs = Proofs(tuple(etas), ends, feasible, small, full, {one.name: verified(one).passed for one in ours})
    if quick:
        return replace(proofs, skipped=("lower bounds of η by delay sequences", "the design in the run"))
    tell(f"proofs: a design for delays {D_MIN} to {D_MAX}")
    found = design(published.model, D_MIN, D_MAX)
    fresh = Eta(FRESH, D_MAX, None, None, found.eta, None) if found.gains is None else _eta(found.gains, D_MAX, False)
    fresh = replace(fresh, gains=FRESH)
    return replace(proofs, etas=(*etas, fresh), fresh=found.eta)


def _comparisons() -> list[Gains]:
    """Return the comparison controllers that are plain gains of Eq. (9); proofs speak of no other."""
    found = []
    for controller in CONTROLLERS:
        if controller.role == "comparison":
            try:
                law = load_gains(controller.gains)
            except InputError:
                continue
            if follows_eq9(law):
                found.append(law)
    return found


def _eta(gains: Gains, d_max: int, lower: bool) -> Eta:
    loop = eq9(gains, 1, d_max)
    reached = worst_gain(loop, graph(loop, gains, "any"))[0] if lower else None
    return Eta(
        gains.name,
        d_max,
        lyapunov.eta(gains, 1, d_max).eta,
        lyapunov.eta(gains, 1, d_max, DELTA).eta,
        exact.eta(gains, 1, d_max).eta,
        exact.eta(gains, 1, d_max, delta_max=DELTA).eta,
        None if reached is None or not math.isfinite(reached) else reached,
    )


def _feasible(gains: Gains) -> Feasible:
    loop = augmented(gains.model, gains.K1, gains.K2)
    return Feasible(gains.name, spectral_radius(gains.model.A), printed.necessary_radius(loop))


def small_example() -> Gains:
    """Return gains on a stable plant of two states for which Lemma 2 as printed has a solution."""
    model = Model(
        "small",
        1.0,
        np.diag([0.4, 0.2]),
        np.array([[1.0], [0.5]]),
        np.eye(2),
        np.array([[1.0, 0.0]]),
        np.zeros((1, 1)),
        ("x1", "x2"),
        Trim(np.zeros(2), np.zeros(1)),
    )
    return Gains("small", model, 1, 3, np.array([[-0.1, -0.05]]))


def eta_table(proofs: Proofs) -> Table:
    """Return η of every set of gains and window."""
    rows: list[tuple[Cell, ...]] = [
        (e.gains, f"1 to {e.d_max}", e.lemma1, e.exact, e.lower, e.lemma1_robust, e.exact_robust) for e in proofs.etas
    ]
    return Table(
        "eta",
        "HIRM: η with ‖e‖₂ < η ‖v‖₂ for every delay sequence of the window",
        (
            "gains",
            "delays",
            "Lemma 1",
            "exact",
            "a sequence reaches",
            f"Lemma 1, ‖Δ‖ ≤ {DELTA:g}",
            f"exact, ‖Δ‖ ≤ {DELTA:g}",
        ),
        tuple(rows),
        (
            "Each number but the sequences' is proved: its inequality is checked again by eigenvalues. – : no proof"
            " found, or not sought. Exact: storage functions that know the present delay.",
        ),
    )


def feasibility_table(proofs: Proofs) -> Table:
    """Return what the printed Lemma 2 and Theorem 1 can do."""
    rows: list[tuple[Cell, ...]] = [
        (f.gains, f.rho, f.necessary, None, None, "infeasible" if f.rho >= 1.0 else "may be feasible")
        for f in proofs.feasible
    ]
    rows += [
        (f"small plant, d_max = {s.d_max}", None, None, s.printed, s.lemma1, "feasible" if s.printed else "infeasible")
        for s in proofs.small
    ]
    return Table(
        "feasibility",
        "Lemma 2 and Theorem 1 as printed",
        (
            "case",
            "ρ(A)",
            "ρ(A⊗A + (A+A₁)⊗(A+A₁))",
            "η, Lemma 2 as printed",
            "η, Lemma 1",
            "Eq. (31), and with it (40)",
        ),
        tuple(rows),
        (
            "Along (x, x, 0, 0) with A x = λ x, |λ| ≥ 1, the form of (31) is a sum of terms that are not negative, for"
            " all P, Q, R and all gains. For given gains the second radius must be below 1. The small plant, stable by"
            " itself, shows how much the printed condition gives away where it is feasible.",
        ),
    )
