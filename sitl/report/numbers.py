"""What a flight came to, measured from its recording alone: tracking, delay, window, link, modes, faults."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from autopilot.failsafe import FLOWN_BY_LAW, Mode
from gains.definite import Verification, failed
from gains.model import GainLaw, Matrix, Model
from gains.table import InputError
from gains.verify import verified
from sitl.braille import Quantity, input_quantity, output_quantity
from sitl.flightdata import LINKS
from sitl.flightfile import FlightFile
from sitl.link.impairment import Fate
from sitl.recovery import Recovery, recoveries
from sitl.summary import LATE_NS, delay_summary, link_summary, outside_fraction

__all__ = [
    "QUANTILES",
    "QUIET_KINDS",
    "Link",
    "Numbers",
    "control",
    "measure",
    "outputs",
    "plain_paths",
    "proof",
    "saturated",
]

QUIET_KINDS = frozenset(("counters", "ports"))
"""Kinds of events that come every second and tell a person nothing."""
QUANTILES = (0.05, 0.5, 0.95, 0.99, 1.0)
"""Of the delays of the packets that arrived."""
TRACKED = 0.1
"""The flight tracks where the error of its last second stays below this part of the reference's range."""

_PATH = re.compile(r"(?<![^\s:=,;'\"(])(?:~|\.\.?)?/(?:[^\s,;'\"/]+/)*(?=[^\s,;'\"/])")


class Link(NamedTuple):
    """One direction of the link.

    Attributes
    ----------
    counts : mapping of str to int
        As ``sitl fly --json`` has them: sent, delivered, lost and so on.
    delays_ms : tuple of float
        At the ``QUANTILES``; empty where nothing arrived.
    fates : mapping of str to int
        What became of the lost ones: loss, blackout, refused.
    """

    counts: Mapping[str, int]
    delays_ms: tuple[float, ...]
    fates: Mapping[str, int]


@dataclass(frozen=True, slots=True)
class Numbers:
    """The numbers of one flight; errors in the shown unit of the first output.

    Attributes
    ----------
    seconds : float
        Length, those included that a dead plant did not fly.
    samples, late : int
        Samples in the recording, and those served more than a millisecond late.
    rms_error, max_error, final_error : float
        Of e = y - yr where the law was to fly; final: the largest of the last second.
    reference_range : float
        Greatest less least value of the reference.
    saturated_s : float
        How long the elevator stood at an end of its travel.
    diverged : bool
    law_s, mode_s
        For how long a law flew since it first did, and each mode, s.
    flown_s : float
        From the first command of a law to the end, s, without the time in which no law was to fly.
    mode_at_end : str
    failsafe_events : int
        Transitions, but for the first engagement.
    delay : mapping
        As ``sitl fly --json`` has it.
    outside : float or None
        Share of the samples whose true delay was outside the window.
    links : mapping of str to Link
    faults : tuple of Recovery
    """

    seconds: float
    samples: int
    late: int
    rms_error: float
    max_error: float
    final_error: float
    reference_range: float
    saturated_s: float
    diverged: bool
    law_s: float
    flown_s: float
    mode_s: Mapping[str, float]
    mode_at_end: str
    failsafe_events: int
    delay: Mapping[str, Any]
    outside: float | None
    links: Mapping[str, Link]
    faults: tuple[Recovery, ...]

    @property
    def settled(self) -> bool:
        """Whether the last second's error is small beside the reference's range; true without a reference."""
        return self.reference_range == 0.0 or self.final_error <= TRACKED * self.reference_range


def measure(file: FlightFile) -> Numbers:
    """Return the numbers of a flight."""
    flight, Ts = file.flight, file.flight.model.Ts
    factor = outputs(flight.model)[0].factor
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(flight.flown_error[:, 0]) * factor
        last_second = np.abs(flight.error[-max(1, round(1.0 / Ts)) :, 0]) * factor
    modes = flight.modes
    mode_s = {mode.value: sum(m.end_s - m.start_s for m in modes if m.mode == mode) for mode in Mode}
    first = next((m.start_s for m in modes if m.mode in FLOWN_BY_LAW), None)
    idle_s = float(np.count_nonzero(~flight.engaged & (flight.time_s >= (first or 0.0)))) * Ts
    end_s = float(flight.time_s[-1]) + Ts
    transitions = [
        body for topic, _, body in file.records if topic == "events" and body["kind"] == "failsafe"
    ]  # fmt: skip
    return Numbers(
        seconds=end_s - float(flight.time_s[0]),
        samples=len(flight.time_s),
        late=int(np.count_nonzero(flight.late_ns > LATE_NS)),
        rms_error=float(flight.rms_error[0]) * factor,
        max_error=float(error.max()),
        final_error=float(last_second.max()),
        reference_range=float(np.ptp(flight.reference[:, 0])) * factor,
        saturated_s=float(np.count_nonzero(saturated(flight.model, flight.u).any(axis=1))) * Ts,
        diverged=file.diverged,
        law_s=sum(mode_s[mode.value] for mode in FLOWN_BY_LAW),
        flown_s=0.0 if first is None else max(0.0, end_s - first - idle_s),
        mode_s=mode_s,
        mode_at_end=modes[-1].mode if modes else Mode.STANDBY.value,
        failsafe_events=sum(body["data"]["from"] != Mode.STANDBY for body in transitions),
        delay=delay_summary(flight),
        outside=outside_fraction(flight, file.law),
        links=_links(file),
        faults=tuple(recoveries(file.records)),
    )


def _links(file: FlightFile) -> dict[str, Link]:
    counts = link_summary(file.records)
    fates: dict[str, dict[str, int]] = {way: {} for way in LINKS}
    for topic, _, body in file.records:
        way = topic.removeprefix("link/")
        if way in fates and way != topic and body["delivered_ns"] is None and body["fate"] != Fate.GATED:
            fates[way][body["fate"]] = fates[way].get(body["fate"], 0) + 1
    links = {}
    for way in LINKS:
        delay_s = file.flight.links[way].delay_s
        arrived_ms = 1e3 * delay_s[np.isfinite(delay_s)]
        quantiles = tuple(map(float, np.quantile(arrived_ms, QUANTILES))) if arrived_ms.size else ()
        links[way] = Link(counts[way], quantiles, fates[way])
    return links


def saturated(model: Model, u: Matrix) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Return where each control stands at an end of its travel; shape (N, nu)."""
    actuator = model.actuator
    if actuator is None or actuator.low is None or actuator.high is None:
        return np.zeros(u.shape, dtype=np.bool_)
    slack = 1e-9 * (actuator.high - actuator.low)
    return np.asarray((u <= actuator.low + slack) | (u >= actuator.high - slack))


def outputs(model: Model) -> list[Quantity]:
    """Return how each output is shown, all with names of their own."""
    shown = [output_quantity(replace(model, C=model.C[[i]], D=model.D[[i]], reference=None)) for i in range(model.ny)]
    if len({quantity.name for quantity in shown}) < len(shown):
        shown = [quantity._replace(name=f"{quantity.name}{i + 1}") for i, quantity in enumerate(shown)]
    return shown


def control(model: Model) -> Quantity:
    """Return how the controls are shown."""
    try:
        return input_quantity(model)
    except InputError:  # several of them, or one without travel
        return Quantity("u", 1.0, "")


@lru_cache(maxsize=64)
def proof(law: GainLaw) -> Verification:
    """Return whether the law's certificate proves its window, verified now; one that is malformed proves nothing."""
    try:
        return verified(law)
    except InputError as error:
        return failed(plain_paths(str(error)))


def plain_paths(text: str) -> str:
    """Return a text with file names in the place of absolute paths and of those from a home or a parent folder."""
    return _PATH.sub("", text)


def finite(value: float, digits: int = 3) -> str:
    """Return a number in few digits; a dash where it is none."""
    if not math.isfinite(value):
        return "∞" if math.isinf(value) else "—"
    return f"{value:.{digits}g}"
