"""Stable or not, decided: a verified proof, or a breaking delay sequence confirmed in multiple precision.

The steps of :mod:`gains.stability` and of :mod:`gains.witness` take turns, cheapest first, until one of them decides.
What remains undecided has both bounds on the joint spectral radius: what a sequence reaches, and what none exceeds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from gains.definite import Verification
from gains.exact import stability
from gains.lyapunov import constant_radius
from gains.model import GainLaw, Gains, Matrix, Schedule, sets_of
from gains.stability import Budget, Stability, steps
from gains.switched import Graph, Key, Switched, Transitions, eq9, factor, graph
from gains.switched_certificate import SwitchedCertificate
from gains.verify_switched import check_switched
from gains.witness import Effort, Found, confirm, find_witness

__all__ = ["Bound", "Decision", "bound", "decide", "possible", "refute"]

_QUICK = Effort(beam=0, depth=0, trajectories=0, steps=0, polished=1, rounds=0)
_ROBUST_MEMORY = 1
_SHARE = 1.0 - 1e-9  # of the bound on the uncertainty: what is tried stays inside it, rounding included
_WIDEST = 64  # delays of a window whose structured sequences are tried before anything else
_EDGE = 1e-9  # a growth within this of 1 in double precision is worth a confirmation


@dataclass(frozen=True, slots=True, eq=False)
class Decision:
    """What was decided about a window of delays, and what was spent.

    Attributes
    ----------
    verdict : {"stable", "unstable", "undecided"}
        "stable" only with a verified certificate, "unstable" only with a confirmed witness.
    d_min, d_max : int
        Samples.
    certificate : SwitchedCertificate or None
        Proves stability; without η.
    verification : Verification or None
    unbounded : bool
        Whether the proof holds for every bounded delay.
    witness : tuple of int or None
        One period of delays under which the loop diverges.
    witness_sets : tuple of int or None
        The gain sets of its commands; None for plain gains.
    growth : float or None
        Of the witness, per sample, in multiple precision.
    lower, upper : float
        Bounds on the joint spectral radius of the nominal loop over [x; s(k−1); …; s(k−d_max)].
    products, solves : int
        Products examined and semidefinite programs solved.
    reason : str
        Why undecided, or at which Δ the witness breaks the loop; empty otherwise.
    """

    verdict: Literal["stable", "unstable", "undecided"]
    d_min: int
    d_max: int
    certificate: SwitchedCertificate | None = None
    verification: Verification | None = None
    unbounded: bool = False
    witness: tuple[int, ...] | None = None
    witness_sets: tuple[int, ...] | None = None
    growth: float | None = None
    lower: float = 0.0
    upper: float = math.inf
    products: int = 0
    solves: int = 0
    reason: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Bound:
    """The largest window that is proved, and the smallest that is refuted.

    Attributes
    ----------
    d_max : int, "unbounded" or None
        None if not even [d_min, d_min] is proved.
    proof : Decision or None
        At ``d_max``.
    refuted : Decision or None
        The smallest window for which a witness was found; None where the limit was reached.
    undecided : tuple of Decision
        The windows between.
    """

    d_max: int | Literal["unbounded"] | None
    proof: Decision | None
    refuted: Decision | None
    undecided: tuple[Decision, ...] = ()


def decide(
    law: GainLaw,
    d_min: int,
    d_max: int,
    *,
    transitions: Transitions = "any",
    delta_max: float = 0.0,
    best_witness: bool = False,
    budget: Budget | None = None,
    effort: Effort | None = None,
) -> Decision:
    """Decide stability for every admissible sequence of delays in [d_min, d_max] and every ‖Δ‖ ≤ delta_max.

    Parameters
    ----------
    law : Gains or Schedule
    d_min, d_max : int
        0 ≤ d_min ≤ d_max.
    transitions : {"any", "fifo"}
    delta_max : float
        0 for the nominal model. A witness is sought for Δ = 0, which every bound admits.
    best_witness : bool
        Whether to go on from the first witness to the one of largest growth found.
    budget : Budget or None
        For proofs.
    effort : Effort or None
        For witnesses.
    """
    case = _Case(law, d_min, d_max, transitions, delta_max, effort or Effort(), best_witness)
    if delta_max > 0.0:
        return case.robust()
    for turn, found in enumerate(steps(case.switched, law, transitions, budget)):
        case.spend(found)
        if found.proved:
            decided = case.proved(found)
            if decided.verdict == "stable":
                return decided
        refuted = case.search(turn)
        if refuted is not None:
            return refuted
    return case.undecided("neither a proof nor a breaking delay sequence was found")


def refute(law: GainLaw, d_min: int, d_max: int, transitions: Transitions = "any") -> Decision | None:
    """Return the decision where a structured delay sequence breaks the loop; None where a search would be needed.

    Constant delays come first, the smallest before all: their loops are small, whatever the window.
    """
    if isinstance(law, Gains):
        for d in range(d_min, d_max + 1):
            if constant_radius(law, d) <= 1.0 + _EDGE:
                continue
            growth = confirm(law, [d])
            if growth > 1.0:
                return Decision("unstable", d_min, d_max, witness=(d,), growth=growth, lower=growth)
    if d_max - d_min > _WIDEST:
        return None
    return _Case(law, d_min, d_max, transitions, 0.0, _QUICK, False).search(0)


def bound(
    law: GainLaw,
    d_min: int,
    limit: int,
    transitions: Transitions = "any",
    *,
    budget: Budget | None = None,
    effort: Effort | None = None,
    tell: Callable[[str], None] | None = None,
) -> Bound:
    """Return the largest d_max ≤ limit with [d_min, d_max] proved stable, and a witness for the next.

    A proof holds for every window inside, a witness for every window around: quick witnesses narrow the search from
    above, and the largest window that they leave is decided first.

    Parameters
    ----------
    law : Gains or Schedule
    d_min, limit : int
    transitions : {"any", "fifo"}
    budget, effort : Budget, Effort or None
    tell : callable or None
        Called with a line for each decision.
    """
    say = tell or (lambda _text: None)
    low = max(d_min, law.d_max) if isinstance(law, Schedule) else d_min  # a schedule's windows all take part
    refuted: Decision | None = None
    undecided: list[Decision] = []
    top = limit
    for d in range(low, limit + 1):
        refuted = refute(law, d_min, d, transitions)
        if refuted is not None:
            say(f"{d}: a delay sequence grows {refuted.growth:.6f} per sample")
            top = d - 1
            break
    for d in range(top, low - 1, -1):
        decision = decide(law, d_min, d, transitions=transitions, budget=budget, effort=effort)
        say(f"{d}: {decision.verdict}")
        if decision.verdict == "unstable":
            refuted, undecided = decision, []
        elif decision.verdict == "stable":
            largest: int | Literal["unbounded"] = "unbounded" if decision.unbounded else d
            return Bound(largest, decision, refuted, tuple(reversed(undecided)))
        else:
            undecided.append(decision)
    return Bound(None, None, refuted, tuple(reversed(undecided)))


class _Case:
    """One window: its loop, what is known of it and what was spent."""

    def __init__(
        self,
        law: GainLaw,
        d_min: int,
        d_max: int,
        transitions: Transitions,
        delta_max: float,
        effort: Effort,
        best: bool,
    ) -> None:
        self.law, self.d_min, self.d_max = law, d_min, d_max
        self.transitions, self.delta_max, self.effort, self.best = transitions, delta_max, effort, best
        self.switched: Switched = eq9(law, d_min, d_max)
        self.walks: Graph = graph(self.switched, law, transitions)
        self.known = Decision("undecided", d_min, d_max)
        self.found: Found | None = None
        self.looked = 0  # products of the searches for witnesses

    def spend(self, found: Stability) -> None:
        """Note what the proofs have found and cost so far."""
        upper = min(self.known.upper, found.upper)
        self.known = replace(self.known, upper=upper, products=found.products + self.looked, solves=found.solves)

    def search(self, turn: int) -> Decision | None:
        """Seek a witness, quickly in the first turn, thoroughly in the second; return the decision if there is one."""
        if turn > 1:
            return None
        thorough = turn == 1 or self.best
        starts = () if self.found is None else (self.found.modes,)
        effort = self.effort if thorough else _QUICK
        found = find_witness(self.switched, self.walks, effort, starts=starts, polish=thorough and self.best)
        self.found = found
        self.looked += found.products
        self.known = replace(self.known, products=self.known.products + found.products)
        sets = [self.switched.modes[i].gain_set for i in found.modes]
        if not possible(found.delays, sets):
            return None
        growth = found.growth
        if growth > 1.0 - _EDGE:  # near and above 1 double precision does not decide
            growth = confirm(self.law, [Key(d, which) for d, which in zip(found.delays, sets, strict=True)])
        lower = max(self.known.lower, growth)
        self.known = replace(self.known, lower=lower)
        if not growth > 1.0:
            return None
        return replace(
            self.known,
            verdict="unstable",
            witness=found.delays,
            witness_sets=tuple(sets) if len(sets_of(self.law)) > 1 else None,
            growth=growth,
        )

    def proved(self, found: Stability) -> Decision:
        """Return the decision on what is said to be a proof."""
        left, right = _factors(self.law)
        certificate = SwitchedCertificate(
            transitions=self.transitions,
            d_min=self.d_min,
            d_max=self.d_max,
            delta_max=0.0,
            eta=None,
            memory=found.memory,
            left=left,
            right=right,
            contraction=found.contraction,
            blocks=found.blocks,
        )
        return self._checked(certificate, unbounded=found.contraction is not None)

    def robust(self) -> Decision:
        """Decide with uncertainty: a witness for Δ = 0, or storages with multipliers."""
        for turn in range(2):
            refuted = self.search(turn)
            if refuted is not None:
                return refuted
        for sign, law in self._perturbed():
            refuted = refute(law, self.d_min, self.d_max, self.transitions)
            if refuted is not None:
                note = f"Delta held at {sign}{self.delta_max:g}"
                return replace(
                    self.known, verdict="unstable", witness=refuted.witness, growth=refuted.growth, reason=note
                )
        for memory in range(_ROBUST_MEMORY + 1):
            analysis = stability(
                self.law,
                self.d_min,
                self.d_max,
                transitions=self.transitions,
                delta_max=self.delta_max,
                memory=memory,
            )
            self.known = replace(self.known, solves=self.known.solves + max(1, analysis.solves))
            if analysis.certificate is not None:
                upper = min(self.known.upper, 1.0)
                return replace(
                    self.known,
                    verdict="stable",
                    certificate=analysis.certificate,
                    verification=analysis.verification,
                    upper=upper,
                )
        for nominal in steps(self.switched, self.law, self.transitions):
            self.known = replace(self.known, upper=min(self.known.upper, nominal.upper))
        return self.undecided(
            f"no storages prove it for ||Delta|| <= {self.delta_max:g}; the bounds are those of Delta = 0"
        )

    def _perturbed(self) -> list[tuple[str, Gains]]:
        """Return the gains on the models of constant Δ = ±δ I, inside the bound, with the sign; none of a schedule."""
        law, model = self.law, self.law.model
        if model.uncertainty is None or not isinstance(law, Gains):
            return []
        F, J1, J2 = model.uncertainty.F, model.uncertainty.J1, model.uncertainty.J2
        corner = _SHARE * self.delta_max * np.eye(F.shape[1], J1.shape[0])
        return [
            (sign, replace(law, model=replace(model, A=model.A + F @ held @ J1, B=model.B + F @ held @ J2)))
            for sign, held in (("+", corner), ("-", -corner))
        ]

    def undecided(self, reason: str) -> Decision:
        """Return what is known."""
        return replace(self.known, reason=self.known.reason or reason)

    def _checked(self, certificate: SwitchedCertificate, *, unbounded: bool) -> Decision:
        verification = check_switched(self.law, certificate)
        if not verification.passed:
            self.known = replace(self.known, reason=f"a proof was found that does not verify: {verification.reason}")
            return self.known
        return replace(
            self.known, verdict="stable", certificate=certificate, verification=verification, unbounded=unbounded
        )


def possible(delays: Sequence[int], sets: Sequence[int]) -> bool:
    """Whether each command of a cycle, which may come back with a larger delay, keeps one gain set throughout."""
    L = len(delays)
    used = {((k - d) % L, which) for k, (d, which) in enumerate(zip(delays, sets, strict=True))}
    return len({j for j, _ in used}) == len(used)


def _factors(law: GainLaw) -> tuple[Matrix | None, Matrix | None]:
    """Return L, R with K1 = L R where the slots hold fewer numbers than K1 has rows."""
    stacked = np.vstack([gains.K1 for gains in sets_of(law)])
    left, right = factor(stacked)
    return (None, None) if right.shape == stacked.shape else (left, right)
