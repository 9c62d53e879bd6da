"""What the page says about a case, in words: the verdict, the numbers under it, and what a whole set of gains teaches.

Text is HTML: whatever comes from a file is escaped here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import ROUND_CEILING, ROUND_FLOOR, Decimal
from html import escape
from itertools import groupby
from typing import Literal

from sitl.teach.facts import Fact
from sitl.teach.lesson import RUNS, Case, Lesson, Pattern

__all__ = ["SYMBOLS", "Standing", "Verdict", "runs_of", "standing", "takeaway", "title", "verdict"]

Standing = Literal["proved", "refuted", "undecided", "calm", "grows"]
"""How a case stands. "calm": this simulation shows nothing, and there is no proof; "grows": it shows it."""

SYMBOLS: dict[Standing, tuple[str, str]] = {
    "proved": ("✓", "proved stable"),
    "refuted": ("✗", "refuted"),
    "undecided": ("?", "undecided"),
    "calm": ("~", "looks calm, without proof"),
    "grows": ("✗", "grows in the simulation"),
}

_TITLES = {
    "pendulum-paper": "Pendulum, published gains (47)",
    "pendulum-exact-paper": "Pendulum (exact hold), published gains (47)",
    "hirm-paper": "HIRM, published gains (54)",
    "hirm-d3": "HIRM, our design for 1 to 3 samples",
    "hirm-d4": "HIRM, our design for 1 to 4 samples",
    "hirm-d6": "HIRM, our design for 1 to 6 samples",
}


@dataclass(frozen=True, slots=True)
class Verdict:
    """What is said about a case; HTML.

    Attributes
    ----------
    standing : Standing
    headline, about, says : str
        The verdict; about what; one or two sentences.
    numbers : tuple of (str, str)
        Name and value.
    """

    standing: Standing
    headline: str
    about: str
    says: str
    numbers: tuple[tuple[str, str], ...]


def title(lesson: Lesson) -> str:
    """Return the name of a system, HTML."""
    gains = lesson.gains
    return escape(_TITLES.get(gains.name, f"{gains.model.name}, gains {gains.name}"))


def standing(case: Case) -> Standing:
    """Return how a case stands."""
    if case.fact.verdict == "stable":
        return "proved"
    if case.pattern == "random":
        return "grows" if case.drawn is not None and case.drawn.grew else "calm"
    return "refuted" if case.fact.verdict == "unstable" else "undecided"


def verdict(lesson: Lesson, case: Case) -> Verdict:
    """Return what the page says about a case."""
    how, Ts = standing(case), lesson.gains.model.Ts
    fact = case.fact
    window = _window(fact)
    headlines = {
        "proved": "Stable: proved",
        "refuted": "Unstable: a delay sequence breaks it",
        "undecided": "Undecided",
        "calm": "Looks calm, and is refuted" if fact.verdict == "unstable" else "Looks calm, without proof",
        "grows": "Unstable, and this simulation shows it",
    }
    if case.pattern == "constant" and how == "refuted":
        headlines["refuted"] = "Unstable: this constant delay breaks it"
    abouts = {
        "constant": f"A delay that is always {_samples(case.d)} ({_ms(case.d, Ts)})",
        "random": f"Delays drawn at random in {window}, up to {_ms(case.d, Ts)}",
        "worst": f"Every delay sequence in {window}, up to {_ms(case.d, Ts)}",
    }
    says = {"constant": _constant, "random": _random, "worst": _worst}[case.pattern](case)
    return Verdict(how, headlines[how], abouts[case.pattern], says, tuple(_numbers(case, Ts)))


def takeaway(lesson: Lesson) -> str:
    """Return what a set of gains teaches, HTML: how far constant and varying delays go, and what simulations say."""
    low = lesson.gains.d_min
    constant = _last_stable(lesson, "constant")
    proved = _last_stable(lesson, "worst")
    if constant is None or proved is None:
        return f"No delay from {low} on is stable with these gains."
    parts = [f"Held constant, every delay up to <b>{constant}</b> is stable."]
    refuted = next((d for d in lesson.delays if lesson.cases["worst", d].fact.verdict == "unstable"), None)
    open_ = [d for d in lesson.delays if lesson.cases["worst", d].fact.verdict == "undecided"]
    parts.append(f"Allowed to vary, delays in <b>{low}…{proved}</b> are proved stable")
    parts[-1] += "".join(f", {low}…{d} is undecided" for d in open_)
    if refuted is None:
        parts[-1] += "."
        return " ".join(parts)
    fact = lesson.cases["worst", refuted].fact
    if refuted <= constant:
        parts[-1] += f", but <b>{low}…{refuted}</b> breaks"
        parts[-1] += (
            ": a delay that moves among values each of which is harmless makes the loop grow by a factor of"
            f" {_rate(fact.growth)} per sample."
        )
    else:
        parts[-1] += f", and {low}…{refuted} breaks."
    calm = sum(standing(lesson.cases["random", d]) == "calm" for d in lesson.delays)
    if calm:
        windows = "window" if calm == 1 else "windows"
        parts.append(
            f"In {calm} {windows} without a proof, all {RUNS} flights under random delays look perfectly calm:"
            " a simulation is no proof."
        )
    return " ".join(parts)


def runs_of(sequence: Sequence[int]) -> str:
    """Return a delay sequence with its runs as powers: 1² 2 3 7¹⁴, HTML."""
    runs = [(d, len(list(same))) for d, same in groupby(sequence)]
    return " ".join(str(d) if count == 1 else f"{d}<sup>×{count}</sup>" for d, count in runs)


def _constant(case: Case) -> str:
    if case.fact.verdict == "stable":
        return "The loop under this one delay decays. It says nothing about a delay that varies, even below this value."
    if case.fact.verdict == "undecided":
        return "The loop is too close to the edge of stability to decide."
    return "From nearly every start, what is left grows by this factor from sample to sample, and never settles."


def _random(case: Case) -> str:
    drawn, fact = case.drawn, case.fact
    assert drawn is not None, "random delays are flown many times"
    span = f"{_rate(drawn.least)} to {_rate(drawn.largest)} per sample"
    flights = f"{RUNS} flights of {1200:,} samples"
    if fact.verdict == "stable":
        return f"The proof covers every sequence in the window, so these as well; {flights} change by {span}."
    if drawn.grew:
        return f"Of {flights}, {drawn.grew} grow ({span})."
    if fact.verdict == "unstable":
        return (
            f"All of {flights} shrink ({span}). Yet a sequence in this very window grows {_rate(fact.growth)} per"
            " sample: chance does not find it. Choose <i>worst case</i> to fly it."
        )
    return f"All of {flights} shrink ({span}), but neither a proof nor a breaking sequence is known for this window."


def _worst(case: Case) -> str:
    fact = case.fact
    if fact.verdict == "unstable":
        return "Shown is the sequence of fastest growth that was found. One such sequence refutes the whole window."
    if fact.verdict == "undecided":
        return "Neither a proof nor a breaking sequence was found. Shown is the sequence of the largest gain found."
    held = (
        f"simply the constant delay {fact.sequence[0]}" if len(set(fact.sequence)) == 1 else "the one of largest gain"
    )
    return f"No sequence whatsoever breaks it. Shown is the worst that was found: {held}."


def _numbers(case: Case, Ts: float) -> list[tuple[str, str]]:
    fact = case.fact
    rows: list[tuple[str, str]] = []
    if fact.verdict == "stable":
        rows.append(("proof", f"{fact.method}; verified, margin {fact.margin:.1g}"))
    of = {"constant": "", "random": ", measured in this flight", "worst": ", this sequence"}[case.pattern]
    rows.append((f"growth per sample{of}", f"<b>{_rate(case.growth)}</b>: {_tenfold(case.growth, Ts)}"))
    if case.pattern != "constant":
        name = "breaking sequence" if fact.verdict == "unstable" else "worst sequence found"
        again = len(set(fact.sequence)) > 1
        rows.append((name, f"{runs_of(fact.sequence)}, then again" if again else f"always {fact.sequence[0]}"))
    if fact.verdict == "undecided":
        rows.append(("any sequence grows at most", "not known" if math.isinf(fact.upper) else _rate(fact.upper)))
    rows.append(("gain η, Eq. (12)", _eta(fact)))
    return rows


def _eta(fact: Fact) -> str:
    if fact.verdict == "unstable":
        return "none: the error has no bound"
    above = "no bound computed here" if math.isnan(fact.eta) else f"η ≤ {_digits(fact.eta, ROUND_CEILING)} proved"
    return above if math.isnan(fact.eta_lower) else f"{above}, η ≥ {_digits(fact.eta_lower, ROUND_FLOOR)} reached"


def _digits(value: float, rounding: str) -> str:
    """Return four digits, a bound from above rounded up and one from below down: each is still a bound."""
    number = Decimal(value)
    if not number:
        return "0"
    return f"{number.quantize(Decimal(1).scaleb(number.adjusted() - 3), rounding):f}"


def _rate(growth: float) -> str:
    """Return a growth per sample with as many digits as tell it from 1."""
    text = f"{growth:.4f}"
    return f"{growth:.7f}" if text == "1.0000" else text


def _tenfold(growth: float, Ts: float) -> str:
    """Return how long it takes to become ten times as large, or as small."""
    if growth <= 0.0 or abs(math.log(growth)) < 1e-9:
        return "steady"
    seconds = abs(math.log(10.0) / math.log(growth)) * Ts
    return f"×10 every {seconds:.3g} s" if growth > 1.0 else f"÷10 every {seconds:.3g} s"


def _last_stable(lesson: Lesson, pattern: Pattern) -> int | None:
    """Return the last d before the first that is not proved."""
    last = None
    for d in lesson.delays:
        if lesson.cases[pattern, d].fact.verdict != "stable":
            break
        last = d
    return last


def _window(fact: Fact) -> str:
    return f"{fact.d_min}…{fact.d_max}"


def _samples(d: int) -> str:
    return "1 sample" if d == 1 else f"{d} samples"


def _ms(d: int, Ts: float) -> str:
    return f"{d * Ts * 1e3:g} ms"
