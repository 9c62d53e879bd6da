"""What a campaign's statistics mean, in sentences and tables; text only, a page escapes it.

Every bound that is told is rounded away from what was measured, so that the sentence is true as it stands.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from decimal import ROUND_CEILING, ROUND_FLOOR, ROUND_HALF_EVEN, Decimal
from typing import Any

from sitl.campaign.comparison import Comparison, Pair
from sitl.campaign.intervals import Proportion, Quantile, proportion
from sitl.campaign.sensitivity import Sensitivity
from sitl.campaign.statistics import Statistics
from sitl.report.numbers import finite
from sitl.report.words import Card, Mood, Table

__all__ = [
    "PARAMETER_NAMES", "cards", "chance", "compared", "concluded", "controllers", "facts", "failures", "left_out",
    "not_concluded", "pairs", "quantile_table", "sensitivities", "title", "verdict",
]  # fmt: skip

PARAMETER_NAMES = {
    "d_mean": "mean delay",
    "d_max": "largest delay",
    "outside": "share outside the window",
    "changes": "changes of the delay",
    "gust_amplitude": "gust amplitude",
    "gust_period_s": "gust period",
    "reference_amplitude": "reference amplitude",
    "reference_period_s": "reference period",
    "delta_amplitude": "uncertainty",
    "x0_norm": "initial state",
}
QUANTITY_NAMES = {"rms_error": "rms error", "max_error": "largest error", "gain": "gain"}
_DIGITS = 3


def chance(p: float, rounding: str = ROUND_HALF_EVEN) -> str:
    """Return a probability in three digits: 0.0312, 3e-6; a bound is rounded up or down by ``decimal``'s names."""
    if math.isnan(p):
        return "—"
    if p in (0.0, 1.0):
        return f"{p:.0f}"
    exact = Decimal(p)
    digits = exact.quantize(Decimal(1).scaleb(exact.adjusted() - _DIGITS + 1), rounding=rounding)
    if digits >= Decimal("0.001"):
        return f"{float(digits):.6g}"
    mantissa, _, exponent = f"{float(digits):.{_DIGITS - 1}e}".partition("e")
    return f"{mantissa.rstrip('0').rstrip('.')}e{int(exponent)}"


def _between(told: Proportion) -> str:
    return f"{chance(told.low, ROUND_FLOOR)} – {chance(told.high, ROUND_CEILING)}"


def _percent(share: float) -> str:
    return f"{100.0 * share:.6g} %"


def _count(n: int, one: str = "flight", many: str = "flights") -> str:
    return f"{n:,} {one if n == 1 else many}"


def _unit(description: Mapping[str, Any]) -> str:
    unit = str(description.get("unit") or "")
    return f" {unit}" if unit else ""


def _seconds(description: Mapping[str, Any]) -> str:
    return finite(float(description["samples"]) * float(description["Ts"]), 4)


def _window(description: Mapping[str, Any]) -> str:
    low, high = description["d_min"], description["d_max"]
    return f"d = {low}" if low == high else f"d = {low} to {high}"


# -- what was flown


def title(description: Mapping[str, Any], statistics: Statistics) -> str:
    """Return one line about what was flown."""
    return (
        f"{_count(statistics.flights)} of {description['gains']} on {description['model']},"
        f" {_seconds(description)} s each"
    )


def facts(description: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return names and values of what was flown."""
    order = "growing by one sample at most" if description["transitions"] == "fifo" else "in any order"
    eta = description.get("eta")
    return [
        ("Gains", str(description["gains"])),
        ("Plant", str(description["model"])),
        ("Window", _window(description)),
        ("Delays", f"{description['delays']}, {order}"),
        ("Samples", f"{int(description['samples']):,} at {1e3 * float(description['Ts']):.4g} ms"),
        ("Seed", str(description["seed"])),
        ("η", f"{'none' if eta is None else finite(float(eta), 5)} ({description.get('eta_source') or 'not said'})"),
    ]


def verdict(statistics: Statistics) -> tuple[str, Mood]:
    """Return the campaign's outcome in a few words."""
    if statistics.diverged.count:
        return f"{_count(statistics.diverged.count)} of {statistics.flights:,} diverged", "bad"
    if statistics.gains.above_inside:
        return f"{_count(statistics.gains.above_inside)} inside the window exceeded η", "bad"
    if statistics.beyond is not None and statistics.beyond.count:
        return f"{_count(statistics.beyond.count)} of {statistics.flights:,} exceeded the threshold", "fair"
    return f"None of {_count(statistics.flights)} failed", "good"


def cards(description: Mapping[str, Any], statistics: Statistics) -> list[Card]:
    """Return the three questions that a campaign is flown for."""
    said, mood = verdict(statistics)
    unit = _unit(description)
    typical = {q.p: q for q in statistics.quantiles["max_error"]}
    rms = {q.p: q for q in statistics.quantiles["rms_error"]}
    return [
        Card("Did a flight fail?", said, mood, _bound_of(statistics.failed, "fails", statistics.confidence)),
        Card(
            "How large is the error?",
            f"{finite(typical[1.0].value)}{unit} at most",
            "bad" if math.isinf(typical[1.0].value) else "good",
            f"In 99 % of the flights it never exceeded {finite(typical[0.99].value)}{unit}; half of them had"
            f" {finite(rms[0.5].value)}{unit} rms or less.",
        ),
        _gain_card(description, statistics),
    ]


def _gain_card(description: Mapping[str, Any], statistics: Statistics) -> Card:
    gains, question = statistics.gains, "How close did it come to η?"
    largest = f"The largest ‖e‖/‖v‖ of a flight that did not diverge was {finite(gains.largest, 4)}"
    if gains.eta is None or gains.ratio is None:
        reason = description.get("eta_source") or "no reason is given"
        return Card(question, "No η is known", "fair", f"{largest}. Nothing bounds it: {reason}.")
    if math.isnan(gains.ratio):
        return Card(question, "No gain is known", "fair", "No flight that did not diverge had an input.")
    sentence = f"{largest}; η = {finite(gains.eta, 5)}, and {_above(statistics)}."
    mood: Mood = "bad" if gains.above_inside else "fair" if gains.above else "good"
    return Card(question, f"{100.0 * gains.ratio:.3g} % of it", mood, sentence)


def _above(statistics: Statistics) -> str:
    gains = statistics.gains
    if not gains.above:
        return "no flight exceeded it"
    left = gains.above - gains.above_inside
    outside = f"{_count(left)} exceeded it after leaving the window, where it is not promised"
    inside = f"{_count(gains.above_inside)} exceeded it inside the window, which contradicts the certificate"
    return " and ".join(part for part, n in ((inside, gains.above_inside), (outside, left)) if n)


def _bound_of(told: Proportion, does: str, confidence: float) -> str:
    """Return the sentence about one probability."""
    opening = f"With {_percent(confidence)} confidence, a flight drawn like these {does} with a probability"
    if told.count == 0:
        return f"{opening} of at most {chance(told.high, ROUND_CEILING)}."
    return f"{opening} between {chance(told.low, ROUND_FLOOR)} and {chance(told.high, ROUND_CEILING)}."


# -- tables


def failures(description: Mapping[str, Any], statistics: Statistics) -> Table:
    """Return how many flights failed, and how probable that is."""
    kinds = [("diverged", statistics.diverged)]
    if statistics.beyond is not None:
        kinds.append(
            (
                f"error beyond {finite(statistics.threshold or 0.0, 4)}{_unit(description)}, or diverged",
                statistics.beyond,
            )
        )
    if statistics.above is not None:
        kinds.append(("gain above η, inside the window", statistics.above))
    kinds += [("failed in any of these ways", statistics.failed), ("left the window", statistics.left_window)]
    confidence = _percent(statistics.confidence)
    return Table(
        ("flights that", "count", "share", f"probability, {confidence} interval", f"below, {confidence}"),
        [
            (name, f"{told.count:,}", chance(told.share), _between(told), chance(told.upper, ROUND_CEILING))
            for name, told in kinds
        ],
    )


def quantile_table(description: Mapping[str, Any], statistics: Statistics) -> Table:
    """Return the quantiles of errors and gain with their intervals."""
    unit = str(description.get("unit") or "")
    names = [f"{QUANTITY_NAMES[name]}{f' [{unit}]' if unit and name != 'gain' else ''}" for name in QUANTITY_NAMES]
    interval = f"{_percent(statistics.confidence)} interval"
    columns = ("quantile", *(part for name in names for part in (name, interval)))
    rows = [
        (_share_name(row[0].p), *(part for told in row for part in (finite(told.value, 4), _ends(told))))
        for row in zip(*(statistics.quantiles[name] for name in QUANTITY_NAMES), strict=True)
    ]
    return Table(columns, rows)


def _share_name(p: float) -> str:
    return "largest" if p == 1.0 else f"{100.0 * p:.6g} %"


def _ends(told: Quantile) -> str:
    if told.p == 1.0 or math.isnan(told.value):
        return "—"
    low = "?" if told.low == -math.inf else finite(told.low, 4)
    # inf is an end that is unknown, or that of flights that diverged: then the quantile above may be so, too
    high = "?" if told.high == math.inf and told.value != math.inf else finite(told.high, 4)
    return f"{low} – {high}"


def sensitivities(found: Sensitivity) -> Table:
    """Return how far each parameter moves a result."""
    return Table(
        ("parameter", "first-order Sobol index", "Spearman's rank correlation"),
        [
            (
                PARAMETER_NAMES[effect.name],
                _with_error(effect.sobol, effect.sobol_error),
                _with_error(effect.spearman, effect.spearman_error),
            )
            for effect in found.effects
        ],
    )


def _with_error(value: float, error: float) -> str:
    """Return an estimate to two digits of its standard error."""
    if math.isnan(value):
        return "—"
    places = 3 if error <= 0.0 else min(6, max(1, 1 - math.floor(math.log10(error))))
    return f"{round(value, places) + 0.0:.{places}f} ± {error:.{places}f}"


def left_out(found: Sensitivity) -> str:
    """Return what the table of sensitivities does not say."""
    said = [f"± is one standard error; of {_count(found.flights)}."]
    for names, why in ((found.constant, "the same in all of them"), (found.undefined, "not known of all of them")):
        if names:
            said.append(f"Left out, being {why}: {', '.join(PARAMETER_NAMES[name] for name in names)}.")
    if found.infinite:
        said.append(f"The Sobol indices leave out {_count(found.infinite)} that diverged.")
    return " ".join(said)


# -- conclusions


def concluded(description: Mapping[str, Any], statistics: Statistics) -> list[str]:
    """Return what the campaign allows to say, a sentence each."""
    confidence, unit = _percent(statistics.confidence), _unit(description)
    said = [_bound_of(statistics.diverged, "diverges", statistics.confidence)]
    if statistics.beyond is not None:
        does = f"has an error beyond {finite(statistics.threshold or 0.0, 4)}{unit}, or diverges,"
        said.append(_bound_of(statistics.beyond, does, statistics.confidence))
    quantile = next(q for q in statistics.quantiles["max_error"] if q.p == 0.99)
    if math.isfinite(quantile.high):
        said.append(
            f"With {confidence} confidence, 99 % of such flights have a largest error of at most"
            f" {_rounded_up(quantile.high)}{unit}."
        )
    largest = statistics.quantiles["max_error"][-1].value
    if math.isfinite(largest):
        beyond = proportion(0, statistics.flights - statistics.unkept, statistics.confidence).upper
        said.append(
            f"With {confidence} confidence, a share of at most {chance(beyond, ROUND_CEILING)} of such flights has a"
            f" larger error than the largest seen, {_rounded_up(largest)}{unit}."
        )
    gains = statistics.gains
    if gains.eta is not None and gains.ratio is not None and math.isfinite(gains.ratio):
        said.append(
            f"The largest gain was {100.0 * gains.ratio:.3g} % of η = {finite(gains.eta, 5)}; {_above(statistics)}."
        )
    if gains.undefined:
        said.append(f"{_count(gains.undefined)} had no input and no gain.")
    if statistics.unkept:
        said.append(f"Quantiles leave out {_count(statistics.unkept)}, more than are kept.")
    return [*said, f"Each statement has its {confidence} by itself."]


def _rounded_up(value: float, digits: int = 4) -> str:
    """Return a bound in few digits, never below it."""
    if value == 0.0:
        return "0"
    exact = Decimal(value)
    return f"{float(exact.quantize(Decimal(1).scaleb(exact.adjusted() - digits + 1), rounding=ROUND_CEILING)):.6g}"


def not_concluded(description: Mapping[str, Any]) -> list[str]:
    """Return what the campaign does not allow to say, a sentence each."""
    order = "that grows by one sample at most" if description["transitions"] == "fifo" else "in any order"
    said = [
        "A campaign samples a declared distribution of delays, gusts, references and plants. It says nothing of"
        " flights drawn otherwise, and next to nothing of sequences that this distribution hardly ever draws: the"
        " worst one may be among these.",
    ]
    if description.get("eta") is None:
        reason = description.get("eta_source") or "no reason is given"
        return [*said, f"No certificate speaks of what was flown here ({reason}): statistics are all there is."]
    return [
        *said,
        f"The certificate covers every sequence of delays {_window(description)} {order}, and every input, for the"
        f" linear loop: there ‖e‖ never exceeds {finite(float(description['eta']), 5)} ‖v‖, however long it flies.",
    ]


# -- comparison


def controllers(comparison: Comparison) -> Table:
    """Return the numbers of each controller side by side."""
    every = comparison.statistics
    rows: list[tuple[str, ...]] = [
        ("flights", *(f"{s.flights:,}" for s in every)),
        ("failed", *(f"{s.failed.count:,}" for s in every)),
        ("probability of failure", *(_between(s.failed) for s in every)),
    ]
    for name, called in QUANTITY_NAMES.items():
        for p in (0.5, 0.95, 1.0):
            told = [next(q for q in s.quantiles[name] if q.p == p) for s in every]
            rows.append((f"{called}, {_share_name(p)}", *(finite(q.value, 4) for q in told)))
    return Table(("", *comparison.names), rows)


def pairs(comparison: Comparison) -> Table:
    """Return what each pair comes to."""
    interval = f"{_percent(comparison.pairs[0].confidence)} interval"
    names = ("rms error of A / that of B, median", interval, "share of flights in which A is better", interval,
             "signed ranks, p", "only A failed", "only B failed", "McNemar, p")  # fmt: skip
    columns = [_pair_cells(pair) for pair in comparison.pairs]
    return Table(
        ("", *(f"A: {pair.a}, B: {pair.b}" for pair in comparison.pairs)), list(zip(names, *columns, strict=True))
    )


def _pair_cells(pair: Pair) -> tuple[str, ...]:
    return (
        _ratio(pair.log_ratio.value),
        f"{_ratio(pair.log_ratio.low)} – {_ratio(pair.log_ratio.high)}",
        chance(pair.better.share),
        _between(pair.better),
        _p_value(pair.p_signed_rank),
        f"{pair.only_a_failed:,}",
        f"{pair.only_b_failed:,}",
        _p_value(pair.p_failures),
    )


def _p_value(p: float) -> str:
    """Return a p-value; none is 0."""
    return "< 1e-300" if p < 1e-300 else chance(p)


def _equal_to(p: float) -> str:
    said = _p_value(p)
    return said if said.startswith("<") else f"= {said}"


def _ratio(log_ratio: float) -> str:
    """Return a ratio from its logarithm, however large."""
    try:
        return finite(math.exp(log_ratio), 4)
    except OverflowError:
        return "∞"


def compared(comparison: Comparison) -> list[str]:
    """Return what each pair allows to say, a sentence each."""
    return [part for pair in comparison.pairs for part in _pair_sentences(pair)]


def _pair_sentences(pair: Pair) -> list[str]:
    confidence = _percent(pair.confidence)
    low, high = pair.log_ratio.low, pair.log_ratio.high
    both = f"between {_ratio(low)} and {_ratio(high)} times that of {pair.b}, with {confidence} confidence"
    if low > 0.0 or high < 0.0:
        better, worse = (pair.a, pair.b) if high < 0.0 else (pair.b, pair.a)
        errors = f"{better} tracks better than {worse}: in the median flight {pair.a} has an rms error {both}."
    else:
        errors = f"Neither {pair.a} nor {pair.b} tracks better in the median flight: {pair.a} has an rms error {both}."
    said = [errors]
    if pair.only_a_failed + pair.only_b_failed:
        distinct = pair.p_failures < 1.0 - pair.confidence
        said.append(
            f"{_count(pair.only_a_failed)} failed with {pair.a} alone, {pair.only_b_failed:,} with {pair.b} alone:"
            f" {'more than' if distinct else 'no more than'} chance explains (p {_equal_to(pair.p_failures)})."
        )
    if pair.both_diverged:
        said.append(f"In {_count(pair.both_diverged)} both diverged; of errors these decide nothing.")
    return said
