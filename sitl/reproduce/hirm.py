"""Example 2: the HIRM under one random d(k) (Figure 5), nominal (Figure 6) and disturbed (7), by every controller."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from gains.store import load_law, stored
from gains.table import InputError
from gains.verify import verified
from sitl.reproduce.cases import (
    CONTROLLERS,
    D_MAX,
    D_MIN,
    DURATION_S,
    PUBLISHED,
    SETTLED_S,
    STEP_DEG,
    Controller,
)
from sitl.reproduce.claims import Cell, Table
from sitl.reproduce.flights import Flown, fly, follows_eq9, recursion, rms, scenario, uniform_delays
from sitl.reproduce.proofs import Proofs

__all__ = ["Hirm", "Row", "flights_table", "fly_hirm", "pulses_table", "sequences_table"]

Case = Literal["nominal", "uncertain", "gust"]
OTHER_SEQUENCES = 12
"""Delay sequences beside the flown one, over which Eq. (9) is computed."""

_FLIGHTS: Mapping[Case, dict[str, bool]] = {
    "nominal": {"step": True, "gust": False, "delta": False},  # Figure 6
    "uncertain": {"step": True, "gust": True, "delta": True},  # Figure 7
    "gust": {"step": False, "gust": True, "delta": False},  # what the gust alone does
}


@dataclass(frozen=True, slots=True, eq=False)
class Row:
    """One controller and its flights.

    Attributes
    ----------
    controller : Controller
    flown : mapping of str to Flown
        Under ``nominal``, ``uncertain`` and ``gust``; empty where there is none.
    pulses : mapping of str to Flown
        The same with 1000 to 2000 µs pulses in place of floats.
    missing : str
        Why it was not flown; empty otherwise.
    """

    controller: Controller
    flown: Mapping[Case, Flown]
    pulses: Mapping[Case, Flown]
    missing: str = ""

    @property
    def step_rms_deg(self) -> float:
        """Rms of the error of the nominal step."""
        return rms(self.flown["nominal"].error_deg)

    @property
    def gust_rms_deg(self) -> float:
        """Rms of the error in the gust alone."""
        return rms(self.flown["gust"].error_deg)

    @property
    def settled_deg(self) -> float:
        """Largest error of the nominal step once it has settled."""
        return settled_deg(self.flown["nominal"])


@dataclass(frozen=True, slots=True, eq=False)
class Hirm:
    """Everything about the HIRM's flights.

    Attributes
    ----------
    delays : tuple of int
        d(k) of Figure 5.
    rows : tuple of Row
        In the order of ``CONTROLLERS``.
    sequences : mapping of str to tuple of (float, float)
        By gain file: rms of Eq. (9) on the step and in the gust alone, deg, one pair for each of the other sequences.
    """

    delays: tuple[int, ...]
    rows: tuple[Row, ...]
    sequences: Mapping[str, tuple[tuple[float, float], ...]]

    def row(self, gains: str) -> Row:
        """Return the row of a gain file."""
        return next(row for row in self.rows if row.controller.gains == gains)

    @property
    def present(self) -> tuple[Row, ...]:
        """The rows that were flown."""
        return tuple(row for row in self.rows if not row.missing)


def settled_deg(flown: Flown) -> float:
    """Return the largest |e| after ``SETTLED_S``, deg."""
    return float(np.max(np.abs(flown.error_deg[flown.flight.time_s >= SETTLED_S])))


def fly_hirm(
    seed: int, tell: Callable[[str], None], *, quick: bool = False, controllers: Sequence[Controller] = CONTROLLERS
) -> Hirm:
    """Fly every controller three times on one delay sequence, and, unless quick, again with pulses."""
    samples = round(DURATION_S / load_law(PUBLISHED).model.Ts)
    delays = uniform_delays(seed, D_MIN, D_MAX, samples)
    rows = []
    for controller in controllers:
        tell(f"HIRM: {controller.label}")
        rows.append(_row(controller, delays, seed, quick))
    sequences = {}
    for row in rows:
        if not row.missing and row.flown["nominal"].eq9 is not None:
            tell(f"HIRM: {row.controller.label} on other delay sequences")
            count = 2 if quick else OTHER_SEQUENCES
            sequences[row.controller.gains] = _sequences(row.controller.gains, delays, seed, count)
    return Hirm(delays, tuple(rows), sequences)


def _row(controller: Controller, delays: tuple[int, ...], seed: int, quick: bool) -> Row:
    try:
        load_law(controller.gains)
    except InputError as error:
        if controller.gains not in {entry.name for entry in stored()}:
            return Row(controller, {}, {}, f"no gain file {controller.gains} is stored")
        return Row(controller, {}, {}, str(error).splitlines()[0])
    flown = {case: _flight(controller.gains, case, delays, seed, "float") for case in _FLIGHTS}
    pulses = {} if quick else {case: _flight(controller.gains, case, delays, seed, "pwm") for case in _FLIGHTS}
    return Row(controller, flown, pulses)


def _flight(gains: str, case: Case, delays: tuple[int, ...], seed: int, actuator: Literal["float", "pwm"]) -> Flown:
    how = _FLIGHTS[case]
    asked = scenario(
        "hirm",
        gains,
        delays,
        DURATION_S,
        seed=seed,
        step_deg=STEP_DEG if how["step"] else 0.0,
        gust=how["gust"],
        delta=how["delta"],
        actuator=actuator,
    )
    return fly(asked)


def _sequences(gains: str, delays: tuple[int, ...], seed: int, count: int) -> tuple[tuple[float, float], ...]:
    """Return rms of Eq. (9), step and gust alone, for other sequences of the same kind."""
    step = scenario("hirm", gains, delays, DURATION_S, seed=seed, step_deg=STEP_DEG)
    gust = replace(scenario("hirm", gains, delays, DURATION_S, seed=seed, gust=True), witness=None)
    pairs = []
    for n in range(1, count + 1):
        d = [
            float(delay) if k >= delay else math.nan
            for k, delay in enumerate(uniform_delays(seed + n, D_MIN, D_MAX, len(delays)))
        ]
        errors = [np.rad2deg(recursion(asked, d).error[:, 0]) for asked in (step, gust)]
        pairs.append((rms(errors[0]), rms(errors[1])))
    return tuple(pairs)


def flights_table(hirm: Hirm, proofs: Proofs) -> Table:
    """Return the numbers of Figures 6 and 7."""
    published = hirm.row(PUBLISHED)
    rows: list[tuple[Cell, ...]] = []
    for row in hirm.rows:
        label = row.controller.label
        if row.missing:
            rows.append((label, *[None] * 11, f"not flown: {row.missing}"))
            continue
        nominal, uncertain = row.flown["nominal"], row.flown["uncertain"]
        rows.append(
            (
                label,
                row.step_rms_deg,
                None if nominal.eq9 is None else rms(np.rad2deg(nominal.eq9.error)),
                row.settled_deg,
                float(np.max(np.abs(nominal.u_deg))),
                rms(uncertain.error_deg),
                rms(uncertain.error_deg - nominal.error_deg),
                settled_deg(uncertain),
                row.gust_rms_deg,
                published.gust_rms_deg / row.gust_rms_deg,
                nominal.missed + uncertain.missed + row.flown["gust"].missed,
                None if (bound := proofs.eta(row.controller.gains, D_MAX)) is None else bound.exact,
                _standing(row),
            )
        )
    return Table(
        "hirm_flights",
        f"Flights of Figures 6 and 7: {STEP_DEG:g}° step, d(k) in {D_MIN}..{D_MAX}, float commands",
        (
            "controller",
            "Fig. 6: rms error [deg]",
            "same with xr fresh, Eq. (9) [deg]",
            f"largest error after {SETTLED_S:g} s [deg]",
            "max elevator [deg]",
            "Fig. 7: rms error [deg]",
            "what (51) and (52) add, rms [deg]",
            f"Fig. 7: largest error after {SETTLED_S:g} s [deg]",
            "gust alone: rms error [deg]",
            "gust response, published / this",
            "samples with another delay",
            f"proved η, delays {D_MIN} to {D_MAX}",
            "window of the gain file",
        ),
        tuple(rows),
        (
            "All on the same delay sequence. The command carries xr for the instant at which it is forecast to be"
            " applied; here the delay jumps at random and no forecast can follow, so the step is tracked less closely"
            " than with xr fresh at the actuator, as Eq. (9) assumes. The response to the gust does not depend on it.",
        ),
    )


def _standing(row: Row) -> str:
    """Return the window of the gain file and what proves it, or why nothing does."""
    law = load_law(row.controller.gains)
    if not follows_eq9(law):
        return f"{law.d_min} to {law.d_max}; no proof speaks of a controller other than Eq. (9)"
    certificate = "certificate verified" if verified(law).passed else "no certificate in the file"
    return f"{law.d_min} to {law.d_max}; {certificate}"


def pulses_table(hirm: Hirm) -> Table:
    """Return what 1000 to 2000 µs pulses do to the same flights."""
    rows: list[tuple[Cell, ...]] = []
    for row in hirm.present:
        if row.pulses:
            pairs = [(row.flown[case], row.pulses[case]) for case in _FLIGHTS]
            settled = (settled_deg(row.flown["nominal"]), settled_deg(row.pulses["nominal"]))
            numbers = [rms(one.error_deg) for pair in pairs for one in pair]
            rows.append((row.controller.label, *numbers, *settled))
    return Table(
        "hirm_pulses",
        "The same flights with 1000–2000 µs pulses, 0.05° of elevator each",
        (
            "controller",
            "Fig. 6 rms, float [deg]",
            "pulses [deg]",
            "Fig. 7 rms, float [deg]",
            "pulses [deg]",
            "gust alone rms, float [deg]",
            "pulses [deg]",
            f"largest error after {SETTLED_S:g} s, float [deg]",
            "pulses [deg]",
        ),
        tuple(rows),
        _pulses_notes(hirm),
    )


def _pulses_notes(hirm: Hirm) -> tuple[str, ...]:
    """Return what pulses come to, in a sentence."""
    pairs = [(row.flown[case], row.pulses[case]) for row in hirm.present if row.pulses for case in _FLIGHTS]
    if not pairs:
        return ()
    change = max(abs(rms(pulses.error_deg) / rms(floats.error_deg) - 1.0) for floats, pulses in pairs)
    settled = max(settled_deg(row.pulses["nominal"]) for row in hirm.present if row.pulses)
    return (
        f"Pulses change no rms error by more than {change:.1%}, and leave at most {settled:.4f}° of error on a"
        " settled step: a rounded elevator never quite meets its place, and no certificate speaks of rounding.",
    )


def sequences_table(hirm: Hirm) -> Table:
    """Return the spread of Eq. (9) over other delay sequences of the same kind."""
    rows: list[tuple[Cell, ...]] = []
    published = np.array(hirm.sequences[PUBLISHED])
    for gains, pairs in hirm.sequences.items():
        values = np.array(pairs)
        ratio = published[:, 1] / values[:, 1]
        rows.append(
            (
                hirm.row(gains).controller.label,
                len(values),
                float(values[:, 0].min()),
                float(values[:, 0].max()),
                float(values[:, 1].min()),
                float(values[:, 1].max()),
                float(ratio.min()),
                float(ratio.max()),
            )
        )
    return Table(
        "hirm_sequences",
        "Not one lucky sequence: Eq. (9) computed on others of the same kind",
        (
            "controller",
            "sequences",
            "step rms, least [deg]",
            "greatest [deg]",
            "gust alone rms, least [deg]",
            "greatest [deg]",
            "gust response, published / this: least",
            "greatest",
        ),
        tuple(rows),
    )
