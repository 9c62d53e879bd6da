"""What a flight came to: the numbers of ``sitl fly --json``, the checks that decide, the table for a person."""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from rich.table import Table as Grid
from rich.text import Text

from autopilot.failsafe import FLOWN_BY_FIRST_LAW, Mode
from gains.model import GainLaw
from gains.verify import verified
from sitl.aircraft.plants import is_nonlinear
from sitl.checks import LINK_COUNTS, Check
from sitl.flightdata import FlightData
from sitl.link.impairment import Fate
from sitl.recovery import longest_recovery_s, recoveries
from sitl.scenario import Scenario
from sitl.witness import witness_summary

__all__ = ["LATE_NS", "Verdict", "delay_summary", "judge", "link_summary", "summarise", "summary_table"]

LATE_NS = 1_000_000
"""A sample served more than a millisecond after its instant counts as late."""

REENTRY_S = 2.0
"""How long after a re-entry to TRACKING its saturation is looked at."""

SAME_INSTANT_NS = 100_000
"""Records of two programs within a tenth of a millisecond may stand in the wrong order."""

MAX_BARS = 6
"""Delays that the table lists one by one."""

Kept = tuple[str, int, Mapping[str, Any]]


@dataclass(frozen=True, slots=True)
class Verdict:
    """A check and what came out.

    Attributes
    ----------
    check : Check
        The claim.
    value : object
        The metric's value; None when the summary has none.
    passed : bool
        Whether it is a number within the bounds, or the text that was wanted.
    """

    check: Check
    value: object
    passed: bool


def summarise(scenario: Scenario, kept: Sequence[Kept], flight: FlightData, *, virtual: bool) -> dict[str, Any]:
    """Return the summary of a flight as ``sitl fly --json`` prints it, without files, variants and checks.

    Errors are e = C x + D u - yr, Eq. (10), in the units of the outputs, against the reference model that
    starts at rest at k = 0 and is never re-initialised: what failsafe costs is in them. Samples at which no law was to
    fly, as the ground had disarmed the vehicle or flew it by hand, are left out. A plant that restarts is at k = 0
    again, and so is the reference model; while it is dead there are no errors.
    """
    error = np.abs(flight.flown_error[:, 0])
    last_second = max(1, round(1.0 / scenario.plant.Ts))
    transitions = [body for topic, _, body in kept if topic == "events" and body["kind"] == "failsafe"]
    leaving = [t for t in transitions if t["data"]["from"] != Mode.STANDBY]
    faults = recoveries(kept)
    summary = {
        "scenario": scenario.name,
        "title": scenario.title,
        "gains": scenario.gains.name,
        "plant": scenario.plant_name if is_nonlinear(scenario.plant_name) else scenario.plant.name,
        "seed": scenario.seed,
        "virtual": virtual,
        "certificate": _certificate(scenario.gains),
        "conservative": _conservative(scenario.gains),
        "duration_s": _span(flight) * scenario.plant.Ts,
        "samples": len(flight.time_s),
        "released_s": int(np.count_nonzero(~flight.engaged)) * scenario.plant.Ts,
        "diverged": any(topic == "events" and body["kind"] == "diverged" for topic, _, body in kept),
        "rms_error_rad": float(flight.rms_error[0]),
        "max_error_rad": float(error.max()),
        "final_error_rad": float(error[-last_second:].max()),
        "max_output_rad": float(np.abs(flight.output[:, 0]).max()),
        "delay": {**delay_summary(flight), "outside_fraction": outside_fraction(flight, scenario.gains)},
        "link": link_summary(kept),
        "failsafe_events": len(leaving),
        "failsafe_reaction_samples": failsafe_reaction_samples(kept, scenario),
        "failsafe_transitions": [t["text"] for t in transitions],
        "mode_at_end": flight.modes[-1].mode if flight.modes else Mode.STANDBY.value,
        "mode_s": _mode_s(flight),
        "longest_saturation_s": _longest(_at_limit(flight)) * scenario.plant.Ts,
        "reentry_saturation_s": _reentry_saturation_s(flight),
        "late_ticks": int(np.count_nonzero(flight.late_ns > LATE_NS)),
        "faults": [asdict(fault) for fault in faults],
        "recovery_s": longest_recovery_s(faults),
    }
    if scenario.witness is not None:
        gated = sum(topic == "link/down" and body["fate"] == Fate.GATED for topic, _, body in kept)
        summary["witness"] = {**witness_summary(scenario.witness, flight, _at_limit(flight)), "gated": gated}
    return summary


def _span(flight: FlightData) -> int:
    """Return the length of the flight, samples: those that a dead plant did not fly count, too."""
    return round(float(flight.time_s[-1] - flight.time_s[0]) / flight.model.Ts) + 1


def _mode_s(flight: FlightData) -> dict[str, float]:
    """Return for how long each mode had the elevator, s; before the first command nobody has."""
    seconds = {mode.value: sum(m.end_s - m.start_s for m in flight.modes if m.mode == mode) for mode in Mode}
    rest = _span(flight) * flight.model.Ts - sum(seconds.values())
    return {**seconds, Mode.STANDBY.value: seconds[Mode.STANDBY.value] + max(0.0, rest)}


def _certificate(gains: GainLaw) -> str:
    """Return what is proved of the gains, in a few words."""
    proof = verified(gains)
    if not proof.passed or gains.certificate is None:
        return "none verified"
    eta = gains.certificate.get("eta")
    gain = f", eta {eta:.4g}" if isinstance(eta, float) else ""
    delta = gains.certificate.get("delta_max")
    robust = f", every |Delta| <= {delta:g}" if isinstance(delta, float) and delta > 0.0 else ""
    return f"verified for d = {gains.d_min}..{gains.d_max}{gain}{robust}"


def _conservative(gains: GainLaw) -> dict[str, Any] | None:
    """Return what the conservative gains are, and what is proved of them; None without."""
    wide = gains.conservative
    if wide is None:
        return None
    return {"gains": wide.name, "d_min": wide.d_min, "d_max": wide.d_max, "certificate": _certificate(wide)}


def delay_summary(flight: FlightData) -> dict[str, Any]:
    """Return how long the loop delay was, and how well it was forecast.

    A forecast is scored at the first sample that its command was applied; fractions are of those.
    """
    true = flight.d[~np.isnan(flight.d)].astype(int)
    first: dict[int, int] = {}
    for start, k, j in zip(flight.start, flight.k, flight.j, strict=True):
        if not np.isnan(j):
            first.setdefault(int(start + j), int(k - j))
    forecast = np.column_stack([flight.forecast, flight.forecast_low, flight.forecast_high])
    forecasts = dict(zip(flight.command_sample.tolist(), forecast, strict=True))
    misses = np.array([forecasts[j] - d for j, d in first.items() if j in forecasts]).reshape(-1, 3)
    misses = misses[~np.isnan(misses[:, 0])]
    known, covered = misses[:, 0], (misses[:, 1] <= 0) & (misses[:, 2] >= 0)
    return {
        "true_histogram": {str(d): n for d, n in sorted(Counter(true.tolist()).items())},
        "estimated_exact_fraction": float(np.mean(known == 0)) if known.size else None,
        "within_one_fraction": float(np.mean(np.abs(known) <= 1)) if known.size else None,
        "covered_fraction": float(np.mean(covered)) if known.size else None,
        "unknown_fraction": float(np.mean(np.isnan(flight.forecast))) if flight.forecast.size else None,
    }


def outside_fraction(flight: FlightData, gains: GainLaw) -> float | None:
    """Return the fraction of the samples with a known true delay at which it lay outside the gains' window."""
    true = flight.d[~np.isnan(flight.d)]
    return float(np.mean((true < gains.d_min) | (true > gains.d_max))) if true.size else None


def link_summary(kept: Iterable[Kept]) -> dict[str, dict[str, int]]:
    """Return the packet counts of each direction; ``sent`` counts each packet once, the others its copies.

    What a gate swallowed is in none but ``sent``.
    """
    summary = {}
    for way in ("up", "down"):
        summary[way] = dict.fromkeys(LINK_COUNTS, 0)
    newest = {"up": 0, "down": 0}
    for topic, _, body in kept:
        if not topic.startswith("link/"):
            continue
        way = topic.removeprefix("link/")
        counts = summary[way]
        counts["duplicated" if body["copy"] else "sent"] += 1
        if body["delivered_ns"] is None:
            counts["lost"] += body["fate"] != Fate.GATED
            continue
        counts["delivered"] += 1
        if body["number"] < newest[way]:
            counts["reordered"] += 1
        newest[way] = max(newest[way], body["number"])
    return summary


def failsafe_reaction_samples(kept: Iterable[Kept], scenario: Scenario) -> float | None:
    """Return how long the law flew on (TRACKING, LEVEL) with the delay outside the gains' window; None if it never was.

    In samples, the longest of the flight: from the record of a sample whose delay lies outside, as the plant
    reports it, or of a command forecast to land outside, to the failsafe leaving TRACKING or the end.
    """
    low, high = scenario.gains.d_min, scenario.gains.d_max
    changes: list[tuple[int, Mode]] = []
    outside_ns: list[int] = []
    end_ns = 0
    for topic, at_ns, body in kept:
        end_ns = max(end_ns, at_ns)
        if topic == "events" and body["kind"] == "failsafe":
            changes.append((at_ns, Mode(body["data"]["to"])))
        elif topic in ("plant/truth", "autopilot/command") and body["d"] is not None and not low <= body["d"] <= high:
            outside_ns.append(at_ns)
    changes.sort(key=lambda change: change[0])
    longest_ns = None
    for at_ns in outside_ns:
        following = bisect_left(changes, at_ns - SAME_INSTANT_NS, key=lambda change: change[0])
        if following and changes[following - 1][1] in FLOWN_BY_FIRST_LAW:
            left_ns = changes[following][0] if following < len(changes) else end_ns
            longest_ns = max(longest_ns or 0, left_ns - at_ns)
    return None if longest_ns is None else longest_ns / scenario.plant.Ts_ns


def judge(checks: Iterable[Check], summary: Mapping[str, Any]) -> list[Verdict]:
    """Return the verdict of each check; a flight that diverged fails a check of its own."""
    survived = Verdict(Check("the aircraft stays in the sky", "diverged"), summary["diverged"], not summary["diverged"])
    return [survived, *(_judge(check, summary) for check in checks)]


def _judge(check: Check, summary: Mapping[str, Any]) -> Verdict:
    value: Any = summary
    for key in check.metric.split("."):
        value = value.get(key) if isinstance(value, Mapping) else None
    if check.equals is not None:
        return Verdict(check, value, value == check.equals)
    number = isinstance(value, int | float) and not np.isnan(value)
    low = -np.inf if check.at_least is None else check.at_least
    high = np.inf if check.at_most is None else check.at_most
    return Verdict(check, value, bool(number and low <= value <= high))


def _at_limit(flight: FlightData) -> np.ndarray:
    """Return where the actuator stands at an end of its travel; shape (N,)."""
    actuator = flight.model.actuator
    if actuator is None or actuator.low is None or actuator.high is None:
        return np.zeros(len(flight.time_s), dtype=bool)
    slack = 1e-9 * (actuator.high - actuator.low)
    return np.asarray(np.any((flight.u <= actuator.low + slack) | (flight.u >= actuator.high - slack), axis=1))


def _longest(flags: np.ndarray) -> int:
    """Return the length of the longest run of True."""
    longest = run = 0
    for flag in flags.tolist():
        run = run + 1 if flag else 0
        longest = max(longest, run)
    return longest


def _reentry_saturation_s(flight: FlightData) -> float | None:
    """Return the longest saturation in the seconds after any re-entry to TRACKING; None without re-entry."""
    begins = [interval.start_s for interval in flight.modes if interval.mode == Mode.TRACKING][1:]
    if not begins:
        return None
    at_limit = _at_limit(flight)
    return (
        max(_longest(at_limit[(flight.time_s >= begin) & (flight.time_s < begin + REENTRY_S)]) for begin in begins)
        * flight.model.Ts
    )


def summary_table(summary: Mapping[str, Any], verdicts: Sequence[Verdict]) -> Grid:
    """Return the table a person reads after the flight."""
    grid = Grid(show_header=False, title=f"{summary['scenario']}: {summary['title']}", title_justify="left")
    grid.add_column(no_wrap=True)
    grid.add_column()
    delay = summary["delay"]
    grid.add_row("flight", f"{summary['samples']} samples, {summary['duration_s']:g} s, seed {summary['seed']}")
    grid.add_row("gains", f"{summary['gains']} on {summary['plant']} (certificate: {summary['certificate']})")
    if summary.get("conservative") is not None:
        wide = summary["conservative"]
        grid.add_row("conservative gains", f"{wide['gains']} (certificate: {wide['certificate']})")
    rms, peak, final = (np.degrees(summary[f"{m}_error_rad"]) for m in ("rms", "max", "final"))
    released_s = summary.get("released_s", 0.0)
    released = f"; without {released_s:.3g} s disarmed or by hand" if released_s else ""
    grid.add_row("tracking error", f"rms {rms:.3g}°, largest {peak:.3g}°, last second {final:.3g}°{released}")
    grid.add_row("true delay", _histogram_text(delay["true_histogram"]) + _outside_text(delay["outside_fraction"]))
    grid.add_row("forecast", _forecast_text(delay))
    for way, counts in summary["link"].items():
        grid.add_row(f"link {way}", "  ".join(f"{name} {n}" for name, n in counts.items()))
    grid.add_row("failsafe", f"{summary['failsafe_events']} transitions, {summary['mode_at_end']} at the end")
    if "witness" in summary:
        grid.add_row("witness", _witness_text(summary["witness"]))
    for fault in summary.get("faults", []):
        grid.add_row("fault", _fault_text(fault))
    grid.add_row("late samples", f"{summary['late_ticks']} by more than 1 ms")
    for name, variant in summary.get("variants", {}).items():
        peak = np.degrees(variant["max_error_rad"])
        grid.add_row(f"beside: {name}", f"largest error {peak:.3g}°, {variant['mode_at_end']} at the end")
    for problem in summary.get("problems", []):
        grid.add_row("recording", Text(problem, "red"))
    for verdict in verdicts:
        mark = Text("passed ", "green") if verdict.passed else Text("FAILED ", "bold red")
        grid.add_row("check", mark + Text(f"{verdict.check.name}: {_claim(verdict)}"))
    for name, path in summary.get("files", {}).items():
        grid.add_row(name, str(path))
    return grid


def _histogram_text(histogram: Mapping[str, int]) -> str:
    """Return the counts of the delays; of a long tail only its sum and its end."""
    shown = [f"d={d}: {n}" for d, n in list(histogram.items())[:MAX_BARS]]
    tail = list(histogram.items())[MAX_BARS:]
    if tail:
        last = tail[-1][0] if len(tail) == 1 else f"{tail[0][0]}..{tail[-1][0]}"
        shown.append(f"d={last}: {sum(n for _, n in tail)}")
    return "  ".join(shown) or "no command arrived"


def _outside_text(fraction: float | None) -> str:
    return f"  ({fraction:.2%} outside the window)" if fraction else ""


def _forecast_text(delay: Mapping[str, Any]) -> str:
    if delay["estimated_exact_fraction"] is None:
        return "none scored"
    exact, near = delay["estimated_exact_fraction"], delay["within_one_fraction"]
    covered, unknown = delay["covered_fraction"], delay["unknown_fraction"]
    return f"exact {exact:.1%}, within one sample {near:.1%}, inside the interval {covered:.1%}, unknown {unknown:.1%}"


def _fault_text(fault: Mapping[str, Any]) -> str:
    if fault["end_s"] is None:
        return f"{fault['fault']}: lasts to the end"
    if fault["recovered_s"] is None:
        return f"{fault['fault']}: the law does not get the elevator back"
    return f"{fault['fault']}: the law has the elevator {fault['recovered_s'] - fault['end_s']:.3g} s after its end"


def _witness_text(witness: Mapping[str, Any]) -> str:
    grown = "too short to tell" if witness["growth_per_sample"] is None else f"{witness['growth_per_sample']:.6f}"
    lived = f"{witness['mismatches']} of {witness['prescribed_samples']} samples lived another delay"
    if witness["predicted"] is None:
        return lived
    return f"growth per sample {grown}, predicted {witness['predicted']:.6f}; {lived}"


def _claim(verdict: Verdict) -> str:
    """Return metric, value and bounds in one line."""
    check, value = verdict.check, verdict.value
    shown = f"{value:.4g}" if isinstance(value, float) else str(value)
    wanted = [f"= {check.equals}"] if check.equals is not None else []
    wanted += [f"≥ {check.at_least:g}"] if check.at_least is not None else []
    wanted += [f"≤ {check.at_most:g}"] if check.at_most is not None else []
    return f"{check.metric} = {shown}" + (f" (wanted {' and '.join(wanted)})" if wanted else "")
