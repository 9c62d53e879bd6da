"""What the numbers of a flight mean, in sentences and tables; text only, the page escapes it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Literal, NamedTuple

from autopilot.failsafe import FLOWN_BY_LAW
from gains.certificate import model_hash
from gains.model import GainLaw, Schedule
from sitl.aircraft.plants import is_nonlinear
from sitl.flightfile import FlightFile
from sitl.report.numbers import QUANTILES, QUIET_KINDS, Numbers, finite, outputs, plain_paths, proof

__all__ = ["Card", "Table", "certificate", "facts", "labels", "link", "numbers", "story", "troubles", "verdict"]

Mood = Literal["good", "fair", "bad"]

MAX_EVENTS = 400
"""Rows of the table of events; the page says how many further ones there are."""
_ALL = 0.9995


class Card(NamedTuple):
    """A question about the flight, its answer in a few words, and a sentence with the numbers."""

    question: str
    answer: str
    mood: Mood
    sentence: str


class Table(NamedTuple):
    """A table: a heading for each column, and rows of which the first cell is a heading."""

    columns: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]


def labels(files: Sequence[FlightFile]) -> list[str]:
    """Return what to call each flight among the others."""
    names = [file.name for file in files]
    if len(set(names)) == len(names):
        return names
    return [f"{name} ({n})" for n, name in enumerate(names, 1)]


# -- the story


def verdict(numbers: Numbers) -> tuple[str, Mood]:
    """Return the flight's outcome in a few words."""
    if numbers.diverged:
        return "Diverged", "bad"
    if not numbers.law_s:
        return "No law flew", "bad"
    if numbers.mode_at_end not in FLOWN_BY_LAW or not numbers.settled:
        return "Did not track to the end", "bad"
    if numbers.law_s >= _ALL * numbers.flown_s:
        return "Tracked throughout", "good"
    return "Tracked, with failsafe in between", "fair"


def story(file: FlightFile, numbers: Numbers) -> list[Card]:
    """Return the three questions that a flight is flown for."""
    return [_tracked(file, numbers), _lived(file, numbers), _proved(file, numbers)]


def _tracked(file: FlightFile, numbers: Numbers) -> Card:
    quantity = outputs(file.flight.model)[0]
    rms, peak, final = (
        finite(value) + quantity.unit for value in (numbers.rms_error, numbers.max_error, numbers.final_error)
    )
    errors = f"The error of {quantity.name} was {rms} rms, {peak} at most and up to {final} in the last second"
    if numbers.reference_range:
        errors += f", while the reference moved by {finite(numbers.reference_range)}{quantity.unit}"
    share = f"a law had the elevator for {_share(numbers.law_s, numbers.flown_s)} of the time since it first flew"
    answer, mood = verdict(numbers)
    short = {
        "Diverged": "No: it diverged",
        "No law flew": "No law flew",
        "Did not track to the end": f"Not to the end: {numbers.mode_at_end}",
        "Tracked throughout": "Yes",
        "Tracked, with failsafe in between": "Yes, with failsafe in between",
    }[answer]
    if answer == "Did not track to the end" and numbers.mode_at_end in FLOWN_BY_LAW:
        short = "Not in the last second"
    return Card("Did it track?", short, mood, f"{errors}; {share}.")


def _lived(file: FlightFile, numbers: Numbers) -> Card:
    histogram = {int(d): n for d, n in numbers.delay["true_histogram"].items()}
    if not histogram:
        return Card("What delay did it live?", "None: no command arrived", "bad", "The plant applied no command.")
    Ts_ms = 1e3 * file.flight.model.Ts
    low, high = min(histogram), max(histogram)
    samples = f"{low} samples" if low == high else f"{low} to {high} samples"
    span = f"{low * Ts_ms:.4g} ms" if low == high else f"{low * Ts_ms:.4g} to {high * Ts_ms:.4g} ms"
    usual, count = max(histogram.items(), key=lambda item: item[1])
    sentence = f"That is {span} of loop delay at Ts = {Ts_ms:.4g} ms; d = {usual} for "
    sentence += f"{_share(count, sum(histogram.values()))} of the samples."
    exact, covered = numbers.delay["estimated_exact_fraction"], numbers.delay["covered_fraction"]
    if exact is not None:
        sentence += f" The autopilot's forecast was exact for {exact:.1%} of its commands,"
        sentence += f" and its interval held the true delay for {covered:.1%}."
    outside = numbers.outside or 0.0
    return Card("What delay did it live?", samples, "good" if not outside else "fair", sentence)


def _proved(file: FlightFile, numbers: Numbers) -> Card:
    law, question = file.law, "Was it inside the proved window?"
    checked = proof(law)
    window = f"d = {law.d_min} to {law.d_max}"
    outside = numbers.outside
    inside = "no delay is known" if outside is None else f"{_percent(1.0 - outside)} of the samples lived a delay in it"
    if not checked.passed:
        sentence = f"The gains {plain_paths(law.name)} are for {window} ({inside}), but nothing about it is verified: "
        return Card(question, "Nothing is proved", "fair", sentence + f"{checked.reason}.")
    steps = "growing by one sample at most" if (law.certificate or {}).get("transitions") == "fifo" else "in any order"
    proved = f"The certificate of {plain_paths(law.name)} for {window}, {steps}, was verified for this page"
    proved += _of_what(file)
    if outside is None:
        return Card(question, "No delay is known", "fair", f"{proved}.")
    if outside == 0.0:
        return Card(
            question, "Yes, all the time", "good", f"{proved}; every sample with a command lived a delay in it."
        )
    wide = law.conservative
    beyond = f" Outside it failsafe decides{'' if wide is None else f', with {wide.name} up to d = {wide.d_max}'}."
    return Card(question, f"Not for {_percent(outside)}", "fair", f"{proved}; {inside}.{beyond}")


def _of_what(file: FlightFile) -> str:
    """Return what to remember where another aircraft flew than the proof speaks of; empty otherwise."""
    plant = file.metadata.get("plant", "")
    if is_nonlinear(plant):
        return f" (it speaks of the linear model {file.law.model.name} near trim; {plain_paths(plant)} flew)"
    if model_hash(file.flight.model) != model_hash(file.law.model):
        return f" (it speaks of the model {file.law.model.name}; {file.flight.model.name} flew)"
    return ""


def _share(part: float, whole: float) -> str:
    return _percent(part / whole) if whole else "—"


def _percent(share: float) -> str:
    """Return a share in percent that says 100 or 0 only where it is all or nothing."""
    percent = 100.0 * min(1.0, share)
    if percent == 0.0:
        return "0 %"
    if percent < 0.1:
        return "<0.1 %"
    return "100 %" if percent == 100.0 else f"{min(percent, 99.9):.1f} %"


# -- the header


def facts(file: FlightFile) -> list[tuple[str, str]]:
    """Return what the recording says about itself, as names and values."""
    said = file.metadata
    time = {"virtual": "virtual time", "udp": "real time, over UDP"}.get(said.get("time", ""), said.get("time", ""))
    found = [
        ("Scenario", said.get("scenario", "")),
        ("Gains", file.law.name),
        ("Plant", said.get("plant", "").rpartition("/")[2] or file.flight.model.name),
        ("Reference", said.get("reference", "")),
        ("Wind", said.get("wind", "")),
        *_links_said(said),
        ("Witness", said.get("witness", "")),
        ("Length", _length(file)),
        ("Seed", said.get("seed", "")),
        ("Flown in", time),
        ("By", f"lagproof {said['lagproof']}" if "lagproof" in said else ""),
    ]
    return [(name, plain_paths(value)) for name, value in found if value]


def _length(file: FlightFile) -> str:
    Ts, time_s = file.flight.model.Ts, file.flight.time_s
    return f"{float(time_s[-1] - time_s[0]) + Ts:.4g} s, {len(time_s):,} samples of {1e3 * Ts:.4g} ms"


def _links_said(said: Mapping[str, str]) -> list[tuple[str, str]]:
    up, down = said.get("up", ""), said.get("down", "")
    both = [("Link, each way", up)] if up == down else [("Link up", up), ("Link down", down)]
    return [*both, ("Rules", said.get("rules", "")), ("Changes", said.get("changes", ""))]


# -- tables


def numbers(files: Sequence[FlightFile], measured: Sequence[Numbers]) -> Table:
    """Return the summary's numbers, a column for each flight."""
    unit = outputs(files[0].flight.model)[0].unit
    rows: list[tuple[str, Callable[[Numbers], str]]] = [
        ("Verdict", lambda n: verdict(n)[0]),
        ("Error, rms", lambda n: finite(n.rms_error) + unit),
        ("Error, largest", lambda n: finite(n.max_error) + unit),
        ("Error, last second", lambda n: finite(n.final_error) + unit),
        ("True delay", lambda n: _delays(n.delay["true_histogram"])),
        ("Outside the window", lambda n: "—" if n.outside is None else _percent(n.outside)),
        ("Forecast exact", lambda n: _fraction(n.delay["estimated_exact_fraction"])),
        ("Forecast within one", lambda n: _fraction(n.delay["within_one_fraction"])),
        ("Forecast interval held", lambda n: _fraction(n.delay["covered_fraction"])),
        ("Forecast unknown", lambda n: _fraction(n.delay["unknown_fraction"])),
        ("Elevator saturated", lambda n: f"{n.saturated_s:.3g} s"),
        ("A law had the elevator", lambda n: _share(n.law_s, n.flown_s)),
        ("Failsafe transitions", lambda n: str(n.failsafe_events)),
        ("Mode at the end", lambda n: n.mode_at_end),
        ("Packets lost up, down", lambda n: ", ".join(_lost(n, way) for way in ("up", "down"))),
        ("Samples late by over 1 ms", lambda n: f"{n.late:,} of {n.samples:,}"),
        ("Length", lambda n: f"{n.seconds:.4g} s"),
    ]
    body = [(name, *(tell(n) for n in measured)) for name, tell in rows]
    if len(files) > 1:
        body[1:1] = [
            ("Gains", *(plain_paths(file.law.name) for file in files)),
            ("Window", *(f"{file.law.d_min} to {file.law.d_max}" for file in files)),
            ("Certificate", *("verified" if proof(file.law).passed else "none verified" for file in files)),
            ("Median delay up, down", *(", ".join(_median(n, way) for way in ("up", "down")) for n in measured)),
        ]
    columns = tuple(labels(files)) if len(files) > 1 else ("this flight",)
    return Table(("", *columns), body)


def _delays(histogram: Mapping[str, int]) -> str:
    if not histogram:
        return "no command arrived"
    whole = sum(histogram.values())
    usual = sorted(histogram.items(), key=lambda item: -item[1])[:4]
    shown = ", ".join(f"{d}: {_share(n, whole)}" for d, n in sorted(usual, key=lambda item: int(item[0])))
    others = f", others to {max(map(int, histogram))}" if len(histogram) > 4 else ""
    return shown + others


def _fraction(value: float | None) -> str:
    return "—" if value is None else _percent(value)


def _lost(numbers: Numbers, way: str) -> str:
    counts = numbers.links[way].counts
    return f"{counts['lost']:,} ({_share(counts['lost'], counts['sent'] + counts['duplicated'])})"


def _median(numbers: Numbers, way: str) -> str:
    delays = numbers.links[way].delays_ms
    return f"{delays[1]:.3g} ms" if delays else "—"


def link(measured: Numbers) -> Table:
    """Return counts and quantiles of both directions."""
    ways = {"up": "up, from the plant", "down": "down, to the plant"}
    counted = [
        (name, *(f"{measured.links[way].counts[name]:,}" for way in ways)) for name in measured.links["up"].counts
    ]
    why = dict.fromkeys(fate for way in ways for fate in measured.links[way].fates)
    reasons = [(f"… {fate}", *(f"{measured.links[way].fates.get(fate, 0):,}" for way in ways)) for fate in why]
    at = next((n for n, row in enumerate(counted) if row[0] == "lost"), len(counted) - 1) + 1
    counted[at:at] = reasons if len(why) > 1 or "lost" not in why else []
    timed = []
    for n, quantile in enumerate(QUANTILES):
        name = "delay, longest" if quantile == 1.0 else "delay, median" if quantile == 0.5 else f"delay, {quantile:.0%}"
        cells = (measured.links[way].delays_ms for way in ways)
        timed.append((name, *(f"{cell[n]:.4g} ms" if cell else "—" for cell in cells)))
    return Table(("packets", *ways.values()), [*counted, *timed])


def certificate(law: GainLaw) -> Table:
    """Return what is proved of a law and its conservative gains, verified now."""
    laws = [law] if law.conservative is None else [law, law.conservative]
    told = [_certificate(one) for one in laws]
    rows = [(name, *(one.get(name, "—") for one in told)) for name in told[0] | told[-1]]
    names = ("the law", "conservative gains")[: len(laws)]
    return Table(("", *names), rows)


_METHODS = {
    "exact": "exact, on the switched lifted loop",
    "lyapunov": "Lemma 1, Lyapunov–Krasovskii",
}
_TRANSITIONS = {"any": "any, within the window", "fifo": "at most one more per sample"}


def _certificate(law: GainLaw) -> dict[str, str]:
    checked = proof(law)
    claim = law.certificate or {}
    told = {"Gains": plain_paths(law.name), "Window": f"d = {law.d_min} to {law.d_max}"}
    if isinstance(law, Schedule):
        told["Schedule"] = f"{len(law.sets)} sets of gains, switching proved as one"
    told["Verified now"] = "yes" if checked.passed else f"no: {checked.reason}"
    if not claim:
        return told
    eta, delta = claim.get("eta"), claim.get("delta_max")
    if checked.passed:
        gain = f" and ‖e‖ ≤ {eta:.4g} ‖v‖" if isinstance(eta, float) else ""
        told["Proved"] = f"stable for every delay sequence in the window{gain}"
    told["Method"] = _METHODS.get(str(claim.get("method")), plain_paths(str(claim.get("method"))))
    told["Changes of the delay"] = _TRANSITIONS.get(str(claim.get("transitions", "any")), "—")
    told["η"] = f"{eta:.6g}" if isinstance(eta, float) else "stability only"
    told["Uncertainty"] = f"every ‖Δ‖ ≤ {delta:g}" if isinstance(delta, float) and delta > 0.0 else "none"
    if checked.passed and math.isfinite(checked.margin):
        told["Least eigenvalue"] = f"{checked.margin:.2g}, rounding at most {checked.rounding:.1g}"
    return told


def troubles(file: FlightFile, measured: Numbers) -> Table | None:
    """Return the faults of a flight and how each ended; None without."""
    if not measured.faults:
        return None
    rows = []
    for fault in measured.faults:
        end = "lasts" if fault.end_s is None else f"{fault.end_s:.3f} s"
        again = "—" if fault.end_s is None else "never"
        if fault.recovered_s is not None and fault.end_s is not None:
            again = f"{fault.recovered_s - fault.end_s:.3g} s later"
        rows.append((plain_paths(fault.fault), f"{fault.begin_s:.3f} s", end, again))
    return Table(("fault", "from", "to", "the law has the elevator again"), rows)


def events(file: FlightFile) -> tuple[Table, int]:
    """Return the events of a flight, and how many more there are."""
    shown = [event for event in file.flight.events if event.kind not in QUIET_KINDS]
    rows = [(f"{event.time_s:.3f} s", event.kind, plain_paths(event.text)) for event in shown[:MAX_EVENTS]]
    return Table(("time", "kind", "what"), rows), max(0, len(shown) - MAX_EVENTS)
