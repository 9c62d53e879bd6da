"""Slips of the paper, and readings of what its text leaves open: each with a computation that anyone can repeat."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product

import numpy as np
from scipy.linalg import expm

from gains.model import Gains, Matrix, spectral_radius
from gains.store import load_gains, load_model
from sitl.reproduce import printed
from sitl.reproduce.cases import DURATION_S, PUBLISHED, STEP_DEG
from sitl.reproduce.claims import READING, Claim, Verdict, judged
from sitl.reproduce.flights import recursion, rms, scenario, uniform_delays
from sitl.reproduce.hirm import Hirm
from sitl.reproduce.proofs import Proofs

__all__ = ["slips"]

_DIGIT = 1.5e-4  # four printed decimals, each of them off by rounding, and a product of two rounded numbers
_ELEVATOR_DEG = 25.0


def slips(hirm: Hirm, proofs: Proofs, seed: int) -> tuple[Claim, ...]:
    """Return the slips and readings, in the order of the paper."""
    return (
        _weights(),
        *_printed_conditions(proofs),
        _lemma3(),
        _signs_of_the_plant(),
        *_entries(),
        _uncertainty(),
        _units(hirm),
        _reference_model(),
        _signs_of_the_gains(seed),
        _growing_gust(),
        _left_open(),
    )


def _hold(Ap: Matrix, b: Matrix, Ts: float) -> tuple[Matrix, Matrix]:
    """Return e^{Ap Ts} and ∫₀^Ts e^{Ap s} ds b, from one exponential."""
    joined = np.zeros((len(Ap) + 1, len(Ap) + 1))
    joined[:-1, :-1], joined[:-1, -1] = Ap, b
    held = expm(joined * Ts)
    return held[:-1, :-1], held[:-1, -1]


def _signed_plant() -> tuple[Matrix, Matrix]:
    return printed.AP * np.array([[-1, 1, 1], [-1, -1, 1], [1, 1, 1]]), -printed.BP


def _weights() -> Claim:
    """Find the coefficient of A1'RB in the block W24 from the expansion of d_max y'Ry at random vectors."""
    rng = np.random.default_rng(0)
    A1, R, B = rng.normal(size=(2, 2)), np.diag([1.0, 2.0]), rng.normal(size=(2, 1))
    d_max, zd, v = 3.0, rng.normal(size=2), rng.normal(size=1)

    def form(a: Matrix, b: Matrix) -> float:
        y = A1 @ a + B @ b
        return float(d_max * y @ R @ y)

    cross = (form(zd, v) - form(zd, np.zeros(1)) - form(np.zeros(2), v)) / 2.0
    factor = cross / float(zd @ A1.T @ R @ B @ v)
    return Claim(
        "slip-w24",
        "(26)",
        "The term of A₁ᵀRB in W24 has the factor 1 + d_max.",
        f"expanding d_max y_mᵀ R y_m gives the factor {factor:.3f} at d_max = {d_max:g}",
        judged(abs(factor - (1.0 + d_max)) < 1e-9),
        "Eq. (13) prints d_max, as the expansion gives; (26) has one too many.",
        numbers={"factor": factor},
    )


def _printed_conditions(proofs: Proofs) -> tuple[Claim, ...]:
    infeasible = [f for f in proofs.feasible if f.rho >= 1.0]
    found = "; ".join(f"{f.gains}: ρ(A) = {f.rho:.4f}, needs {f.necessary:.3f} < 1" for f in proofs.feasible)
    small = "; ".join(f"{s.printed or math.nan:.3f} against {s.lemma1 or math.nan:.3f}" for s in proofs.small)
    weaker = all((s.printed or math.inf) > (s.lemma1 or math.inf) for s in proofs.small)
    return (
        Claim(
            "slip-lemma-2",
            "Lemma 2, (31)",
            "The conditions of Lemma 2 can be met for the pendulum and the HIRM.",
            found,
            judged(not infeasible),
            "With z(k) = z(k−d), y_m = 0, v = 0, (31) requires AᵀPA + (A+A₁)ᵀP(A+A₁) ≺ P, so no aircraft with a pitch"
            " integrator, and no unstable plant, can meet it, whatever the gains.",
            numbers={f"rho_{f.gains}": f.rho for f in proofs.feasible},
        ),
        Claim(
            "slip-theorem-1",
            "Theorem 1, (54)",
            "The gains (54) are a solution of Theorem 1.",
            f"(40) contains (31), which needs {proofs.feasible[-1].necessary:.3f} < 1 for these gains",
            judged(proofs.feasible[-1].necessary < 1.0),
            "As above. The gains themselves are good: Lemma 1, and the exact analysis, prove them.",
        ),
        Claim(
            "reading-doubled",
            "Proof of Lemma 2, (34)–(36)",
            "Doubling P and dropping ΓᵀΛΓ makes Lemma 2 weaker than Lemma 1 even where it is feasible.",
            f"η on a small stable plant, printed against Lemma 1, d_max = 1, 2, 3: {small}",
            judged(weaker),
            "Schur complements on Lemma 1 directly need neither; they are what the corrected forms use.",
            by=READING,
        ),
    )


def _lemma3() -> Claim:
    """Put a repeated Δ to Lemma 3: with a skew J, −h I + δ (J + J') is −h I for every δ, but (38) needs h > 2."""
    h, skew = 1.0, np.array([[0.0, 1.0], [-1.0, 0.0]])
    worst = max(
        float(np.linalg.eigvalsh(-h * np.eye(2) + delta * (skew + skew.T))[-1]) for delta in np.linspace(-1, 1, 21)
    )
    best = min(
        float(np.linalg.eigvalsh((lam - h) * np.eye(2) + skew.T @ skew / lam)[-1]) for lam in np.geomspace(0.1, 10, 401)
    )
    return Claim(
        "slip-lemma-3",
        "(40) ⇔ (45)",
        "(45) holds for every Δ if and only if (40) holds for some λ.",
        f"a case with diag(Δ, Δ): largest eigenvalue {worst:.2f} for every Δ, yet {best:.2f} for the best λ",
        judged(not (worst < 0.0 < best)),
        "Lemma 3 is exact for a full block, and (45) repeats one Δ three times: (40) is sufficient only.",
        numbers={"worst": worst, "best": best},
    )


def _signs_of_the_plant() -> Claim:
    """Find the signs of (48) that give (49): the hold of every choice against the magnitudes that are printed."""
    looked = np.ones((3, 3), dtype=np.bool_)
    looked[2, 0] = looked[0, 1] = False  # claims of their own
    errors: dict[tuple[int, ...], float] = {}
    for signs in product((-1, 1), repeat=4):
        Ap, Bp = printed.AP.copy(), printed.BP.copy()
        Ap[0, 0] *= signs[0]
        Ap[1, 0] *= signs[1]
        Ap[1, 1] *= signs[2]
        Bp[0] *= signs[3]
        A, B = _hold(Ap, Bp, printed.Ts)
        off = np.abs(np.abs(A) - printed.A0)[looked].max(), np.abs(np.abs(B) - printed.B0).max()
        errors[signs] = float(max(off))
    best, second = sorted(errors.values())[:2]
    chosen = min(errors, key=errors.__getitem__)
    return Claim(
        "reading-signs-48",
        "(48), (49)",
        "The text has lost its minus signs; Z_α, M_α, M_q < 0 and Z_δ of the sign of M_δ are meant.",
        f"of 16 choices these match the magnitudes of (49) to {best:.1e}, the next best to {second:.1e}",
        judged(chosen == (-1, -1, -1, 1) and best < _DIGIT < second),
        "Zero-order hold of (48) at 25 ms. The sign of M_δ is that of u: negative, as (54) needs it.",
        by=READING,
        numbers={"best": best, "second": second},
    )


def _entries() -> tuple[Claim, ...]:
    Ap, Bp = _signed_plant()
    A, _ = _hold(Ap, Bp, printed.Ts)
    _, E = _hold(Ap, np.array([1.0, 0.0, 0.0]), printed.Ts)
    return (
        Claim(
            "slip-a0-31",
            "(49)",
            f"A₀[3,1] = {printed.A0[2, 0]:.4f}.",
            f"the exact hold of (48) gives {A[2, 0]:.5f}",
            judged(abs(abs(A[2, 0]) - printed.A0[2, 0]) < _DIGIT),
            "A zero too few after the point: −0.0003, which (53) needs too.",
            numbers={"held": float(A[2, 0])},
        ),
        Claim(
            "slip-a0-12",
            "(49)",
            f"A₀[1,2] = {printed.A0[0, 1]:.4f}, E[1] = {printed.E0[0]:.4f}.",
            f"the exact hold of (48) gives {A[0, 1]:.4f} and {E[0]:.4f}",
            judged(abs(A[0, 1] - printed.A0[0, 1]) < _DIGIT and abs(E[0] - printed.E0[0]) < _DIGIT),
            "The authors designed with the printed A₀, as (53) shows; both models are stored, hirm and hirm-printed.",
            numbers={"A12": float(A[0, 1]), "E1": float(E[0])},
        ),
    )


def _uncertainty() -> Claim:
    model = load_model("hirm-printed")
    assert model.uncertainty is not None
    F, J1 = model.uncertainty.F[:, 0], model.uncertainty.J1[0]
    ratio = printed.DELTA_A[0, :2] / (0.1 * F[0] * J1[:2])
    second = np.abs(printed.DELTA_A[1, :2] - 0.1 * F[1] * J1[:2]).max()
    return Claim(
        "slip-delta-a",
        "(49), (50)",
        "F Δ [J₁ J₂] of (50) is the ΔA, ΔB of (49).",
        f"at Δ = 0.1 the second row and ΔB agree (to {second:.1e}); the first row of ΔA is printed"
        f" {ratio[0]:.1f} and {ratio[1]:.1f} times as large",
        judged(bool(np.all(np.abs(ratio - 1.0) < 0.1))),
        "The first row of ΔA has lost a zero. (51) then simulates 0.15, half as much again, which the text calls"
        " slightly enhanced; Assumption 3 would allow 1, where the elevator may lose nearly all of its effect.",
        numbers={"ratio": float(ratio[0])},
    )


def _units(hirm: Hirm) -> Claim:
    row = hirm.row(PUBLISHED)
    per_radian = math.degrees(1.0)  # the loop is linear: a step of 1 rad is so many of 1 deg
    elevator = float(np.max(np.abs(row.flown["nominal"].u_deg))) * per_radian / STEP_DEG
    alpha = float(np.max(np.abs(np.rad2deg(row.flown["gust"].flight.x[:, 0])))) * per_radian
    return Claim(
        "reading-units",
        "Figures 6, 7, (52)",
        "The simulations are in degrees, though no unit is printed.",
        f"in radians a unit step would want {elevator:.0f}° of elevator, and (52) swing α by {alpha:.0f}°",
        judged(elevator > _ELEVATOR_DEG),
        "In degrees everything is ordinary; r is read in degrees and w in degrees per second.",
        by=READING,
        numbers={"elevator_deg": elevator, "alpha_deg": alpha},
    )


def _reference_model() -> Claim:
    """Compare (53) with Ar = A0 + B0 k and Br = −k3 B0."""
    model = load_model("hirm-printed")
    assert model.reference is not None
    Ar = model.A + model.B @ printed.AR_GAIN[None, :]
    matched = np.abs(np.abs(Ar) - printed.AR)
    others = matched.copy()
    others[1, 2] = 0.0
    Br = float(np.abs(-printed.AR_GAIN[2] * model.B - model.reference.Br).max())
    return Claim(
        "slip-ar-23",
        "(53)",
        f"Ar[2,3] = {printed.AR[1, 2]:.4f}.",
        f"Ar = A₀ + B₀ k gives {Ar[1, 2]:.4f}; with this k all other entries agree to {others.max():.0e}, Br to"
        f" {Br:.0e}",
        judged(matched[1, 2] < _DIGIT),
        f"k = ({', '.join(f'{v:g}' for v in printed.AR_GAIN)}) and Br = −{printed.AR_GAIN[2]:g} B₀; the entry above it,"
        " 0.0056, was printed twice.",
        numbers={"identity": float(Ar[1, 2]), "others": float(others.max())},
    )


def _signs_of_the_gains(seed: int) -> Claim:
    """Try the four choices for the signs of the entries of α in (54) on a step."""
    gains = load_gains(PUBLISHED)
    assert gains.K2 is not None
    delays = uniform_delays(seed, 1, gains.d_max, round(DURATION_S / gains.model.Ts))
    asked = scenario("hirm", PUBLISHED, delays, DURATION_S, seed=seed, step_deg=STEP_DEG)
    d = [float(delay) if k >= delay else math.nan for k, delay in enumerate(delays)]
    errors: dict[tuple[int, int], float] = {}
    for first, second in product((-1, 1), repeat=2):
        K1, K2 = gains.K1.copy(), gains.K2.copy()
        K1[0, 0], K2[0, 0] = first * printed.K_ALPHA[0], second * printed.K_ALPHA[1]
        tried = Gains("tried", gains.model, gains.d_min, gains.d_max, K1, K2)
        errors[first, second] = rms(np.rad2deg(recursion(replace(asked, gains=tried), d).error))
    chosen = min(errors, key=errors.__getitem__)
    shown = ", ".join(f"({'−+'[a > 0]}, {'−+'[b > 0]}) {value:.4f}" for (a, b), value in errors.items())
    return Claim(
        "reading-signs-54",
        "(54)",
        "K1[1] = −0.5054 and K2[1] = +0.2474 are meant.",
        f"rms error of a unit step, d(k) in 1..{gains.d_max}, by the signs of the two: {shown}",
        judged(chosen == (-1, 1)),
        "These signs track best, and they alone mirror K2 ≈ −K1.",
        by=READING,
        numbers={f"rms_{a:+d}{b:+d}": value for (a, b), value in errors.items()},
    )


def _growing_gust() -> Claim:
    radius = spectral_radius(np.array([[0.9922, 0.1247], [-0.1247, 0.9922]]))
    return Claim(
        "reading-gust",
        "(52)",
        "The gust is a harmonic of constant amplitude.",
        f"the printed matrix has spectral radius {radius:.6f}: over 10 s it grows by {radius**400 - 1.0:.1%}",
        judged(abs(radius - 1.0) < _DIGIT),
        "Up to the rounding of four decimals. Its initial value is printed as the number 0.1 and read as (0.1, 0.1).",
        by=READING,
        numbers={"radius": radius},
    )


def _left_open() -> Claim:
    return Claim(
        "reading-open",
        "4.2",
        "The simulations can be repeated from the paper.",
        "not printed: C of the HIRM, the window of d(k) in Figure 5 and the d_max of (54), initial states, units, the"
        " initial value of (52) as a vector, the DFSM controller's numbers",
        Verdict.OPEN,
        "Read as: C = Cr, pitch; d(k) in 1..3; zero; degrees; (0.1, 0.1). The DFSM controller is cited as Ref. 21,"
        " which is on disturbance observers; Ref. 20 is the sliding-mode one.",
        by=READING,
    )
