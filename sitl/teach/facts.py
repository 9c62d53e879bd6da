"""What is proved, refuted or left open about a window of delays, and the worst delay sequence that was found in it.

Everything here is asked of :mod:`gains`: proof or witness of :func:`gains.decide.decide`, η from above of
:func:`gains.exact.eta` where its program is small, η from below of :func:`gains.lower_gain.worst_gain`. Windows of one
d_min lie in one another, so a bound from above holds for those inside, and one from below for those around. A gain
file's own certificate counts as well, once it verifies.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from gains.certificate import read_certificate
from gains.decide import Decision, decide
from gains.exact import eta, program_rows
from gains.lower_gain import Ascent, worst_gain
from gains.model import Gains, spectral_radius
from gains.switched import Transitions, eq9, graph, state_loop
from gains.switched_certificate import SwitchedCertificate, read_switched
from gains.verify import verified

__all__ = ["Fact", "constant_fact", "nested", "stored_eta", "window_fact"]

_ROWS = 2_500  # of a program for eta: a second or so; the next larger window takes ten
_ASCENT = Ascent(kept=3, rounds=6, longest=20, frequencies=5)  # a fraction of a second for each window


@dataclass(frozen=True, slots=True)
class Fact:
    """What is known of every delay sequence in one window, for the nominal loop of Eq. (9).

    Attributes
    ----------
    d_min, d_max : int
        The window, samples; equal for a constant delay.
    verdict : {"stable", "unstable", "undecided"}
        "stable" only with a verified certificate, "unstable" only with a witness confirmed in multiple precision.
    method : str
        By what it was proved, in words; empty unless stable.
    margin : float
        Of the verification; NaN unless stable.
    sequence : tuple of int
        One period of the worst delays found: the witness, or else the sequence of the largest gain from v to e.
    growth : float
        Under ``sequence``, per sample; of a witness in multiple precision.
    eta, eta_lower : float
        Gain from v to e: proved, and reached by a delay sequence; NaN where not known, infinite where it diverges.
    lower, upper : float
        Bounds on the growth per sample under any sequence.
    """

    d_min: int
    d_max: int
    verdict: Literal["stable", "unstable", "undecided"]
    method: str
    margin: float
    sequence: tuple[int, ...]
    growth: float
    eta: float
    eta_lower: float
    lower: float
    upper: float


def constant_fact(gains: Gains, d: int) -> Fact:
    """Return what is known of the delay that is always ``d``."""
    return _fact(gains, decide(gains, d, d), "any", ())


def window_fact(gains: Gains, d_min: int, d_max: int, transitions: Transitions, worst: Sequence[Sequence[int]]) -> Fact:
    """Return what is known of every delay sequence in [d_min, d_max].

    Parameters
    ----------
    gains : Gains
    d_min, d_max : int
        Samples.
    transitions : {"any", "fifo"}
    worst : sequence of sequences of int
        Delay sequences that the search for a large gain begins with.
    """
    return _fact(
        gains, decide(gains, d_min, d_max, transitions=transitions, best_witness=True), transitions, tuple(worst)
    )


def nested(
    facts: Sequence[Fact], constants: Sequence[Fact], proved: tuple[int, float] | None = None
) -> tuple[Fact, ...]:
    """Return windows, rising, with what each says about those inside and around.

    Parameters
    ----------
    facts, constants : sequence of Fact
        Windows of one d_min, by rising d_max; and the delay that is always d_max, for each of them.
    proved : (int, float) or None
        A d_max up to which an η is proved elsewhere, and that η; see :func:`stored_eta`.
    """
    within: list[Fact] = []
    for fact, constant in zip(facts, constants, strict=True):
        within.append(_worst(fact, [*within[-1:], constant]))
    least = math.nan
    for i in range(len(within) - 1, -1, -1):
        fact, around = within[i], within[i + 1] if i + 1 < len(within) else None
        if fact.verdict == "undecided" and around is not None and around.verdict == "stable":
            fact = replace(fact, verdict="stable", method=around.method, margin=around.margin)
        if proved is not None and fact.d_max <= proved[0]:
            least = float(np.fmin(least, proved[1]))
        least = float(np.fmin(least, fact.eta))
        within[i] = replace(fact, eta=least) if fact.verdict == "stable" else fact
    return tuple(within)


def _worst(fact: Fact, inside: Sequence[Fact]) -> Fact:
    """Return a window with the worst delay sequence of its own and of those inside: what breaks one breaks it."""
    known = [fact, *inside]
    broken = [one for one in known if one.verdict == "unstable"]
    if broken:
        worst = max(broken, key=lambda one: one.growth)
        return replace(worst, d_min=fact.d_min, d_max=fact.d_max)
    worst = max(known, key=lambda one: (one.eta_lower, one is fact))
    return replace(fact, sequence=worst.sequence, growth=worst.growth, eta_lower=worst.eta_lower)


def stored_eta(gains: Gains, transitions: Transitions) -> tuple[int, float] | None:
    """Return (d_max, η) of the gain file's own certificate; None where there is none that verifies, or it says less."""
    if gains.certificate is None or not verified(gains).passed:
        return None
    exact = gains.certificate.get("method") == SwitchedCertificate.method
    claim = read_switched(gains) if exact else read_certificate(gains)
    if claim is None or claim.eta is None or (claim.transitions, transitions) == ("fifo", "any"):
        return None
    if isinstance(claim, SwitchedCertificate) and claim.aheads is not None:
        return None  # of the law as it runs, which is another loop
    return (claim.d_max, claim.eta) if claim.d_min <= gains.d_min else None


def _fact(gains: Gains, decision: Decision, transitions: Transitions, worst: Sequence[Sequence[int]]) -> Fact:
    d_min, d_max = decision.d_min, decision.d_max
    if decision.witness is not None and decision.growth is not None:
        bounds = (math.nan, math.inf, decision.lower, decision.upper)
        return Fact(d_min, d_max, "unstable", "", math.nan, decision.witness, decision.growth, *bounds)
    above = math.nan
    small = _has_gain(gains) and program_rows(gains, d_min, d_max, transitions) <= _ROWS
    if decision.verdict == "stable" and small:
        found = eta(gains, d_min, d_max, transitions=transitions)
        above = math.nan if found.eta is None else found.eta
    below, sequence = _largest_gain(gains, d_min, d_max, transitions, worst)
    margin = math.nan if decision.verification is None else decision.verification.margin
    return Fact(
        d_min,
        d_max,
        decision.verdict,
        _method(decision),
        margin,
        sequence,
        _growth(gains, sequence),
        above,
        below,
        decision.lower,
        decision.upper,
    )


def _has_gain(gains: Gains) -> bool:
    """Whether there is a v and an e: a disturbance or a reference."""
    return gains.model.nw + gains.model.nr > 0


def _largest_gain(
    gains: Gains, d_min: int, d_max: int, transitions: Transitions, worst: Sequence[Sequence[int]]
) -> tuple[float, tuple[int, ...]]:
    """Return the largest gain from v to e found, and its delays; without v or e the sequence is a constant d_max."""
    if not _has_gain(gains):
        return math.nan, (d_max,)
    switched = eq9(gains, d_min, d_max)
    starts = [[d - d_min for d in sequence] for sequence in worst]  # modes are numbered by rising delay
    below, cycle = worst_gain(switched, graph(switched, gains, transitions), starts, _ASCENT)
    return below, tuple(switched.modes[i].d for i in cycle)


def _growth(gains: Gains, sequence: Sequence[int]) -> float:
    """Return the growth per sample of the loop without v under a periodic delay sequence, in double precision."""
    loop = state_loop(eq9(gains, min(sequence), max(sequence)))
    period = np.linalg.multi_dot([np.eye(loop.N), *(loop.F[loop.index(d)] for d in reversed(sequence)), np.eye(loop.N)])
    return float(spectral_radius(period) ** (1.0 / len(sequence)))


def _method(decision: Decision) -> str:
    """Return by what a window was proved, in words."""
    certificate = decision.certificate
    if decision.verdict != "stable" or certificate is None:
        return ""
    if certificate.contraction is not None:
        return "contraction, which proves every bounded delay"
    kinds = {block.kind for block in certificate.blocks}
    if kinds == {"quadratic"} and decision.d_min == decision.d_max:
        return "a Lyapunov function of the one loop"
    words = {
        "quadratic": "one Lyapunov function for all delays",
        "tree": "a tree of products, each branch of which contracts",
        "paths": "a Lyapunov function for each path of past delays",
    }
    return ", and ".join(words[kind] for kind in words if kind in kinds) or "storage functions"
