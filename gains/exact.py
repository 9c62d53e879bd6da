"""Exact analysis of given gains on the lifted form: η from above with a verified proof.

A solver proposes storages; :mod:`gains.verify_switched` alone makes a verdict of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gains.bounded_real import Answer, centred, least_eta, storages
from gains.definite import Verification
from gains.model import GainLaw, sets_of
from gains.proof import NUDGE, Verdict
from gains.sdp import Status
from gains.switched import Graph, Switched, Transitions, as_flown, eq9, factor, graph, state_loop
from gains.switched_certificate import SwitchedCertificate
from gains.verify_switched import check_switched, least_eta_of

__all__ = ["MAX_ROWS", "ExactAnalysis", "eta", "program_rows", "stability"]

MAX_ROWS = 12_000
"""Rows of a program that are still solved in minutes; beyond it an answer without η is better than none."""

_RELAX = (1e-4, 1e-2)  # relative, of η: how far from an optimum that is not attained a proof is sought


@dataclass(frozen=True, slots=True, eq=False)
class ExactAnalysis:
    """What was proved about given gains.

    Attributes
    ----------
    verdict : {"stable", "undecided"}
        "stable" only with a verified certificate.
    eta : float or None
        Verified: ‖e‖₂ < η ‖v‖₂ (12). None if undecided, or if only stability is proved.
    certificate : SwitchedCertificate or None
    verification : Verification or None
        Of the certificate, or of the one that failed.
    reason : str
        Why undecided, or why without η; empty otherwise.
    status : Status
        Of the last solve.
    answer : Answer or None
        What the solver proposed, with its duals.
    solves : int
        Programs solved.
    """

    verdict: Verdict
    eta: float | None
    certificate: SwitchedCertificate | None
    verification: Verification | None
    reason: str
    status: Status
    answer: Answer | None = None
    solves: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class _Question:
    law: GainLaw
    switched: Switched
    graph: Graph
    blank: SwitchedCertificate


def eta(
    law: GainLaw,
    d_min: int,
    d_max: int,
    *,
    transitions: Transitions = "any",
    delta_max: float = 0.0,
    memory: int = 0,
    aheads: Sequence[int] | None = None,
) -> ExactAnalysis:
    """Return the least η that storages with the given memory prove, robust against ‖Δ‖ ≤ delta_max.

    Parameters
    ----------
    law : Gains or Schedule
        Its own window is not used, but that of a schedule's sets.
    d_min, d_max : int
        0 ≤ d_min ≤ d_max.
    transitions : {"any", "fifo"}
    delta_max : float
        0 for the nominal model; otherwise the model has an uncertainty.
    memory : int
        Past delays that a storage knows.
    aheads : sequence of int or None
        None for Eq. (9); otherwise the law as it runs, xr predicted by any of these samples.
    """
    question = _ask(law, d_min, d_max, transitions, delta_max, memory, aheads)
    if _rows(question.switched, question.graph) > MAX_ROWS:
        reason = f"the program for eta has more than {MAX_ROWS} rows"
        return ExactAnalysis("undecided", None, None, None, reason, Status.FAILED)
    assert question.switched.m > 0, "without disturbance and reference there is no eta"
    answer = least_eta(question.switched, question.graph)
    found, value, solves = _proof(question, answer), answer.value, 1
    for relax in _RELAX:
        if found.verdict == "stable" or not (math.isfinite(value) and value > 0.0 and _hopeful(answer)):
            break
        found = _proof(question, centred(question.switched, question.graph, value * (1.0 + relax)))
        solves += 1
    return replace(found, answer=answer, solves=solves)


def stability(
    law: GainLaw, d_min: int, d_max: int, *, transitions: Transitions = "any", delta_max: float = 0.0, memory: int = 0
) -> ExactAnalysis:
    """Return whether storages with the given memory prove stability; parameters as of :func:`eta`."""
    question = _ask(law, d_min, d_max, transitions, delta_max, memory, None)
    loop = state_loop(question.switched)
    question = replace(question, switched=loop, graph=graph(loop, law, transitions, memory))
    if _rows(loop, question.graph) > MAX_ROWS:
        reason = f"the program for stability has more than {MAX_ROWS} rows"
        return ExactAnalysis("undecided", None, None, None, reason, Status.FAILED)
    answer = storages(loop, question.graph)
    return replace(_proof(question, answer, with_eta=False), answer=answer, solves=1)


def program_rows(
    law: GainLaw,
    d_min: int,
    d_max: int,
    transitions: Transitions = "any",
    delta_max: float = 0.0,
    aheads: Sequence[int] | None = None,
    memory: int = 0,
) -> int:
    """Return the rows of the program of :func:`eta`: what its cost grows with."""
    question = _ask(law, d_min, d_max, transitions, delta_max, memory, aheads)
    return _rows(question.switched, question.graph)


def _ask(
    law: GainLaw,
    d_min: int,
    d_max: int,
    transitions: Transitions,
    delta_max: float,
    memory: int,
    aheads: Sequence[int] | None,
) -> _Question:
    stacked = np.vstack([gains.K1 for gains in sets_of(law)])
    left, right = factor(stacked)
    own = aheads is None and right.shape != stacked.shape
    loop = eq9(law, d_min, d_max, delta_max) if aheads is None else as_flown(law, d_min, d_max, aheads, delta_max)
    blank = SwitchedCertificate(
        transitions=transitions,
        d_min=d_min,
        d_max=d_max,
        delta_max=delta_max,
        eta=None,
        aheads=None if aheads is None else tuple(aheads),
        memory=memory,
        left=left if own else None,
        right=right if own else None,
    )
    return _Question(law, loop, graph(loop, law, transitions, memory), blank)


def _rows(switched: Switched, transitions: Graph) -> int:
    S = switched.N + switched.m + switched.U.shape[1]
    return len(transitions.edges) * int(S * (S + 1) // 2)


def _hopeful(answer: Answer) -> bool:
    return answer.status in (Status.OPTIMAL, Status.INACCURATE) or answer.accuracy < 1e-3


def _proof(question: _Question, answer: Answer, *, with_eta: bool = True) -> ExactAnalysis:
    """Return the verdict on what a solver proposes: find the least η, verify."""
    undecided = ExactAnalysis("undecided", None, None, None, "", answer.status)
    if not (np.isfinite(answer.P).all() and np.isfinite(answer.mu).all()):
        return replace(undecided, reason=f"the solver gave up ({answer.detail})")
    if answer.status in (Status.INFEASIBLE, Status.UNBOUNDED):
        return replace(undecided, reason="no storages of this memory exist")
    mu = np.maximum(answer.mu, 0.0) if question.switched.robust else np.zeros(0)
    certificate = replace(question.blank, P=answer.P, mu=mu, eta=1.0 if with_eta else None)
    if with_eta:
        least = least_eta_of(question.law, certificate)
        if not math.isfinite(least):
            return replace(undecided, reason="the solver's storages do not satisfy the inequalities")
        floor = 1e-9 * max(least, float(np.finfo(float).tiny))
        certificate = replace(certificate, eta=max(least, floor) * (1.0 + NUDGE))
    verification = check_switched(question.law, certificate)
    if not verification.passed:
        return replace(undecided, verification=verification, reason=verification.reason)
    return replace(undecided, verdict="stable", eta=certificate.eta, certificate=certificate, verification=verification)
