"""What the paper says of the HIRM's flights and gains, and what we say of our designs, against flights and proofs."""

from __future__ import annotations

import math

import numpy as np

from gains.proof import remaining_effect
from gains.store import load_gains
from sitl.reproduce.cases import D_MAX, D_MIN, PUBLISHED, SETTLED_S, STEP_DEG, Role
from sitl.reproduce.claims import OURS, Claim, Section, Verdict, judged
from sitl.reproduce.flights import ROUNDING, rms
from sitl.reproduce.hirm import Hirm, flights_table, pulses_table, sequences_table, settled_deg
from sitl.reproduce.proofs import DELTA, Proofs

__all__ = ["hirm_section", "proof_claims"]

SETTLED = 0.05
"""Of the step: a response within it counts as good tracking, the paper giving no number."""
DFSM, LQ, NEAR = "hirm-dfsm", "hirm-lq", "hirm-d3"
LESS, NO_WORSE = 2.0, 1.02
"""What we say of the design for the window flown: by what factor its gust response is less, at what step error."""


def hirm_section(hirm: Hirm, proofs: Proofs) -> Section:
    """Return the page's part on the flights of example 2."""
    pulses = pulses_table(hirm)
    tables = (flights_table(hirm, proofs), sequences_table(hirm), *((pulses,) if pulses.rows else ()))
    return Section(
        "Example 2: the HIRM aircraft",
        (
            f"A pitch step of {STEP_DEG:g}° at k = 0, flown by every controller over one delay sequence, nominal and"
            " with Δ(k) of Eq. (51), continued periodically, and the gust of Eq. (52). Commands travel as floats, so"
            " that no rounding of pulses blurs the comparison.",
            _summary(hirm, "ours"),
            _summary(hirm, "comparison"),
        ),
        (
            ("figure5", f"Figure 5, the random delay: independent and uniform on {D_MIN}..{D_MAX}."),
            ("figure6", "Figure 6, the nominal step."),
            ("figure7", "Figure 7, the step with uncertainty and gust, and the gust alone."),
        ),
        tables,
        (*_paper_claims(hirm), *_our_claims(hirm, proofs)),
    )


def _summary(hirm: Hirm, role: Role) -> str:
    """Return what came of the comparison with the published gains, for better and worse, in a paragraph."""
    published = hirm.row(PUBLISHED)
    parts = []
    for row in hirm.present:
        if row.controller.role != role:
            continue
        step = row.step_rms_deg / published.step_rms_deg
        gust = row.gust_rms_deg / published.gust_rms_deg
        whole = rms(row.flown["uncertain"].error_deg) / rms(published.flown["uncertain"].error_deg)
        name = row.controller.label.removeprefix("ours, ")
        parts.append(f"{name}: {step:.2f} on the step, {gust:.2f} in the gust, {whole:.2f} in Figure 7")
    whose = "Our designs" if role == "ours" else "Other controllers"
    return (
        f"{whose}, rms error in units of the published gains': {'; '.join(parts) or 'none was flown'}. In Figure 7 the"
        " errors of step, gust and uncertainty add with their signs, and may cancel."
    )


def _paper_claims(hirm: Hirm) -> tuple[Claim, ...]:
    published = hirm.row(PUBLISHED)
    nominal, uncertain = published.flown["nominal"], published.flown["uncertain"]
    assert nominal.eq9 is not None
    fresh = rms(np.rad2deg(nominal.eq9.error))
    return (
        Claim(
            "figure-6-good",
            "Figure 6",
            "The proposed controller achieves good performance in spite of the delay.",
            f"after {SETTLED_S:g} s the error stays within {settled_deg(nominal):.4f}°, rms"
            f" {published.step_rms_deg:.4f}°",
            judged(settled_deg(nominal) <= SETTLED * STEP_DEG),
            f"Within {SETTLED:.0%} of the step counts as good; the paper gives no number.",
            numbers={"rms_deg": published.step_rms_deg},
        ),
        _against(
            hirm, DFSM, "figure-6-dfsm", "Figure 6", "The proposed controller tracks closer than the DFSM controller."
        ),
        Claim(
            "figure-7-good",
            "Figure 7",
            "The proposed controller remains good under uncertainty and gust.",
            f"after {SETTLED_S:g} s the error stays within {settled_deg(uncertain):.4f}°, rms"
            f" {rms(uncertain.error_deg):.4f}°",
            judged(settled_deg(uncertain) <= SETTLED * STEP_DEG),
            f"Within {SETTLED:.0%} of the step, as above.",
            numbers={"rms_deg": rms(uncertain.error_deg)},
        ),
        _against(
            hirm,
            LQ,
            "conclusion-delay-free",
            "5, (2)",
            "Compared with a delay-free controller, the proposed controller has better tracking performance.",
        ),
        Claim(
            "fresh-reference",
            "(9)",
            "x_r(k) reaches the actuator without delay.",
            f"rms error of the step {published.step_rms_deg:.4f}° where the whole command crosses the link,"
            f" {fresh:.4f}° with x_r fresh at the actuator",
            judged(published.step_rms_deg <= NO_WORSE * fresh),
            "A controller sits before the return link, so K₂ x_r is late with the rest; predicting x_r helps as far as"
            " the delay can be forecast, and here it jumps at random.",
            numbers={"flown_deg": published.step_rms_deg, "fresh_deg": fresh},
        ),
    )


def _against(hirm: Hirm, gains: str, claim: str, where: str, says: str) -> Claim:
    """Return a claim that the published gains beat a comparison controller; open where that was not flown."""
    row, published = hirm.row(gains), hirm.row(PUBLISHED)
    if row.missing:
        return Claim(claim, where, says, f"not flown: {row.missing}", Verdict.OPEN, "There is no such controller here.")
    ours = {case: rms(published.flown[case].error_deg) for case in ("nominal", "uncertain")}
    theirs = {case: rms(row.flown[case].error_deg) for case in ("nominal", "uncertain")}
    return Claim(
        claim,
        where,
        says,
        f"rms error {ours['nominal']:.4f}° against {theirs['nominal']:.4f}° of {row.controller.label} on the step;"
        f" {ours['uncertain']:.4f}° against {theirs['uncertain']:.4f}° with uncertainty and gust",
        Verdict.OPEN,
        f"{row.controller.label} here is of our own design, as the paper prints nothing of the one it speaks of: it"
        " shows what such a controller can do, not what theirs did.",
        numbers={"published_deg": ours["nominal"], "other_deg": theirs["nominal"]},
    )


def _our_claims(hirm: Hirm, proofs: Proofs) -> tuple[Claim, ...]:
    flown = [one for row in hirm.present for one in (*row.flown.values(), *row.pulses.values())]
    missed = sum(one.missed for one in flown)
    exact = [one.modelled for row in hirm.present for one in row.flown.values() if one.modelled is not None]
    return (
        Claim(
            "ours-hirm-flown",
            "Figures 5–7",
            "What is flown is what was computed: all controllers live one delay sequence, and the states are those of"
            " Eq. (4).",
            f"{missed} of {sum(one.prescribed for one in flown)} samples with another delay; states within"
            f" {max(exact):.1e} of the recursion, relative",
            judged(missed == 0 and max(exact) < ROUNDING),
            "The recursion takes the recorded delays, reference states, gust and Δ, and nothing else of the flight.",
            OURS,
            {"missed": missed, "modelled": max(exact)},
        ),
        _gust_claim(hirm),
        _settled_claim(hirm),
        _gain_claim(hirm, proofs),
    )


def _gust_claim(hirm: Hirm) -> Claim:
    near, published = hirm.row(NEAR), hirm.row(PUBLISHED)
    pairs = np.array(hirm.sequences[PUBLISHED]) / np.array(hirm.sequences[NEAR])
    ratio = published.gust_rms_deg / near.gust_rms_deg
    step = near.step_rms_deg / published.step_rms_deg
    least, worst = float(pairs[:, 1].min()), float(1.0 / pairs[:, 0].min())
    return Claim(
        "ours-gust",
        "(52), Figures 6 and 7",
        f"{NEAR} answers the gust less than 1/{LESS:g} as much as the published gains, at a step error no larger.",
        f"flown: {ratio:.2f} times less, step rms {step:.3f} times; over {len(pairs)} other sequences at least"
        f" {least:.2f} times less, step rms at most {worst:.3f} times",
        judged(min(ratio, least) > LESS and max(step, worst) < NO_WORSE),
        "The published gains are far from the least η: the printed conditions that led to them are conservative.",
        OURS,
        {"ratio": ratio, "step": step, "least": least, "worst_step": worst},
    )


def _settled_claim(hirm: Hirm) -> Claim:
    published = hirm.row(PUBLISHED)
    ours = [row for row in hirm.present if row.controller.role == "ours"]
    shown = ", ".join(f"{row.controller.gains} {row.settled_deg:.5f}°" for row in ours)
    return Claim(
        "ours-settled",
        "Figure 6",
        "Our designs hold a constant reference without error, and settle closer than the published gains.",
        f"largest error after {SETTLED_S:g} s: {shown}, published {published.settled_deg:.5f}°",
        judged(all(row.settled_deg < published.settled_deg for row in ours)),
        "Zero error at constant r is a linear constraint on K₁ and K₂, which the designs meet and (54) nearly does.",
        OURS,
        {row.controller.gains: row.settled_deg for row in ours},
    )


def _gain_claim(hirm: Hirm, proofs: Proofs) -> Claim:
    """Compare ‖e‖ / ‖v‖ of each nominal flight with the η that holds for every sequence of the window."""
    found, holds = [], True
    for row in hirm.present:
        bound = proofs.eta(row.controller.gains, D_MAX)
        if bound is None or bound.exact is None or row.controller.role == "comparison":
            continue
        gains = [row.flown[case].gain or math.inf for case in ("nominal", "gust")]
        found.append(f"{row.controller.gains} {max(gains):.4f} < {bound.exact:.4f}")
        holds = holds and max(gains) < bound.exact
    return Claim(
        "ours-eta-flown",
        "(12)",
        "No flight exceeds its certified η.",
        "largest ‖e‖₂ / ‖v‖₂ of the nominal flights: " + ", ".join(found),
        judged(holds),
        "η is that of Eq. (9), for the worst delays and the worst v; a step and a harmonic gust are not the worst.",
        OURS,
    )


def proof_claims(proofs: Proofs) -> tuple[Claim, ...]:
    """Return the claims about what is proved of the HIRM's gains."""
    robust = proofs.eta(PUBLISHED, D_MAX)
    assert robust is not None
    refuted = {d: one for d, one in proofs.full_delta.items() if one.verdict == "unstable"}
    broken = "; ".join(f"d in 1..{d}: {one.reason}, grows {one.growth:.4f} per sample" for d, one in refuted.items())
    left = remaining_effect(load_gains(PUBLISHED).model, 1.0)
    open_ = ", ".join(f"1..{d}" for d in proofs.full_delta if d not in refuted)
    ends = ", ".join(f"[{d}, 3] {a or math.nan:.4f}" for d, (a, _) in proofs.ends.items())
    exact = ", ".join(f"{b or math.nan:.4f}" for _, b in proofs.ends.values())
    first, last = proofs.ends[1][0] or math.nan, proofs.ends[3][0] or math.nan
    return (
        Claim(
            "robust-full",
            "Assumption 3, (54)",
            "(54) tolerates every Δ with ΔᵀΔ ≤ I, for which Theorem 1 designs.",
            f"{broken or 'not refuted'}; undecided on {open_ or 'no window'}",
            judged(False if refuted else None),
            f"Δ = −1 is admissible, and a Δ within the bound may leave the elevator {left:.1%} of its effect.",
            numbers={f"growth_{d}": one.growth for d, one in refuted.items()},
        ),
        Claim(
            "robust-015",
            "(51)",
            f"(54) tolerates the Δ that is simulated, |Δ| ≤ {DELTA:g}.",
            f"proved on 1..{D_MAX} with η {robust.exact_robust or math.nan:.4f} (Lemma 1:"
            f" {robust.lemma1_robust or math.nan:.4f})",
            judged(robust.exact_robust is not None),
            "For every Δ(k) within the bound, not the printed sequence alone.",
            numbers={"eta": robust.exact_robust},
        ),
        Claim(
            "d-min-matters",
            "5, (1)",
            "The criterion depends on the minimum delay, which makes it more specific.",
            f"η of (54) by Lemma 1: {ends}; exact: {exact}",
            judged(last < first * (1.0 - 1e-3)),
            "It does, but hardly before the window shrinks to one delay: d_min enters Lemma 1 through"
            " (d_max − d_min + 1) Q alone, and Q is nearly zero at the optimum. The exact analysis gains from every"
            " sample.",
            numbers={f"lemma1_{d}": a for d, (a, _) in proofs.ends.items()},
        ),
        _designs_claim(proofs),
    )


def _designs_claim(proofs: Proofs) -> Claim:
    found, holds = [], all(proofs.verified.values())
    for gains in proofs.verified:
        ours, published = proofs.eta(gains, D_MAX), proofs.eta(PUBLISHED, D_MAX)
        assert ours is not None
        assert published is not None
        reached = published.lower if published.lower is not None else published.exact
        found.append(f"{gains}: {ours.exact or math.nan:.4f}")
        holds = holds and ours.exact is not None and reached is not None and ours.exact < reached
    published = proofs.eta(PUBLISHED, D_MAX)
    assert published is not None
    sought = published.lower is not None
    against = (
        f"a delay sequence drives the published gains to {published.lower:.4f}" if sought else "no sequence sought"
    )
    fresh = f"; a design made in this run reaches {proofs.fresh:.4f}" if proofs.fresh is not None else ""
    return Claim(
        "ours-designs",
        "(12)",
        f"Our designs guarantee an η on 1..{D_MAX} that the published gains cannot have.",
        f"certificates of {', '.join(proofs.verified)} verified: {'yes' if all(proofs.verified.values()) else 'no'}; η"
        f" {', '.join(found)}; published: {published.exact or math.nan:.4f}, and {against}{fresh}",
        judged(holds),
        "Every certificate is checked again from its matrices. The lower bound is the H∞ norm of a periodic sequence.",
        OURS,
        {gains: (proofs.eta(gains, D_MAX) or published).exact for gains in proofs.verified},
    )
