"""A recorded flight flown again: its delay sequence d(k), and the scenario that lives it.

The gate of the relay imposes the sequence (:mod:`sitl.link.gate`), so sample k of the aircraft holds a command as old
as it was in the recording, whatever flies: another plant, other gains, another failsafe. Nothing else of the link is
flown again; who wants the same packets late and lost writes ``--up trace=FILE#up --down trace=FILE#down``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from autopilot.profile import parse_profile
from gains.model import GainLaw, Model, sets_of
from gains.store import stored
from gains.table import InputError
from gains.witnessfile import MAX_PERIOD, Witness, sequence_of
from sitl.aircraft.wind import parse_wind
from sitl.checks import Check
from sitl.flightfile import FlightFile
from sitl.link.gate import check_flyable
from sitl.link.impairment import LinkSpec
from sitl.scenario import Scenario, load_scenario, stored_scenarios

__all__ = ["MAX_MISMATCHES", "recorded_sequence", "replay_of"]

_NONLINEAR = re.compile(r"(jsbsim|sixdof):[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
"""A plant that is no file. A recording may be anybody's, so it never chooses a path."""

_STORED = {"gains": "stored gains", "plant": "a stored plant"}

MAX_MISMATCHES = 0.01
"""Share of the samples that may live another delay: over UDP, on a machine that is busy with other things, some do."""


def recorded_sequence(recorded: FlightFile, source: str) -> Witness:
    """Return d(k) of every sample of a flight, from k = 0, as one period of a sequence.

    Before the first command a sample has no delay; d(k) = k + 1, the age of a command of sample -1, says the same: no
    command is let through.

    Raises
    ------
    InputError
        When samples are missing, or the plant has restarted: its numbers then do not tell which sample is meant; when
        there are more than ``MAX_PERIOD``, which no file of a sequence holds.
    """
    flight, model = recorded.flight, recorded.flight.model
    if (restarts := len(np.unique(flight.start)) - 1) > 0:
        raise InputError(f"{source}: expected a flight in which the plant never restarted, found {restarts} restarts")
    if not np.array_equal(flight.k, np.arange(len(flight.k))):
        missing = np.setdiff1d(np.arange(int(flight.k[-1]) + 1), flight.k)
        first = "another order" if not missing.size else f"sample {missing[0]} missing"
        raise InputError(f"{source}: expected every sample from 0 on, found {first}")
    if len(flight.k) > MAX_PERIOD:
        raise InputError(f"{source}: expected at most {MAX_PERIOD} samples, found {len(flight.k)}")
    delays = np.where(np.isnan(flight.d), flight.k + 1, flight.d).astype(np.int64)
    return sequence_of(tuple(delays.tolist()), model.Ts, recorded.law.name, model.name)


def replay_of(
    recorded: FlightFile,
    source: str,
    sequence: Witness,
    *,
    scenario_name: str | None = None,
    gains_name: str | None = None,
    plant_name: str | None = None,
    reference: str | None = None,
) -> Scenario:
    """Return the scenario that flies a recorded delay sequence again; it is in no file yet that a relay could read.

    Parameters
    ----------
    recorded : FlightFile
        The flight.
    source : str
        Its file, for complaints.
    sequence : Witness
        Its delays.
    scenario_name, gains_name, plant_name, reference : str, optional
        Others than the recording says.

    Raises
    ------
    InputError
        When the sequence cannot be flown, or what the recording names is not to be had any more as it was.
    """
    said, law, model = recorded.metadata, recorded.law, recorded.flight.model
    asked = scenario_name is not None
    scenario_name = scenario_name or _stored_scenario(said.get("scenario", ""), source)
    named = gains_name or _said(said, "gains", source)
    scenario = load_scenario(scenario_name, gains=named, plant=plant_name or _said(said, "plant", source))
    if not asked and said.get("title", scenario.title) != scenario.title:
        raise InputError(f"{source}: flown by another scenario than the stored {scenario_name}; say --scenario FILE")
    if gains_name is None and not _same_law(scenario.gains, law):
        raise InputError(f"{source}: flown with other gains than the stored {named}; say --gains FILE")
    if gains_name is None and plant_name is None and not _same_plant(scenario.plant, model):
        raise InputError(f"{source}: flown on another plant than the stored {scenario.plant.name}; say --plant FILE")
    reference = said.get("reference", scenario.reference) if reference is None else reference
    if reference.startswith("file:") and reference == said.get("reference") != scenario.reference:
        raise InputError(f"{source}: flown with a reference from a file; say --reference file:NAME")
    parse_profile(reference, scenario.gains.model.Ts)
    seed = said.get("seed", "")
    scenario = replace(
        scenario,
        title=f"{scenario.title}, with the delays of {recorded.name}",
        duration_s=len(sequence.delays) * model.Ts,
        seed=int(seed) if re.fullmatch(r"[0-9]{1,9}", seed) else scenario.seed,
        reference=reference,
        actuator="float" if said.get("actuator") == "float" else "pwm",
        wind=parse_wind(said["wind"]) if "wind" in said else None,
        latch="newest" if sequence.transitions == "fifo" else "last",
        up=LinkSpec(),
        down=LinkSpec(),
        rules=(),
        changes=(),
        faults=(),
        variants={},
        checks=(Check("the aircraft lives the delays of the recording", "witness.mismatch_fraction", MAX_MISMATCHES),),
        witness=sequence,
    )
    check_flyable(sequence, source, scenario.latch, scenario.plant)
    return scenario


def _stored_scenario(name: str, source: str) -> str:
    """Return the name of a stored scenario."""
    if name not in stored_scenarios():
        raise InputError(f"{source}: expected a flight of a stored scenario, found {name[:40]!r}; say --scenario FILE")
    return name


def _said(metadata: Mapping[str, str], key: str, source: str) -> str:
    """Return the gains or the plant that a recording names, where that is a stored one, or an aircraft."""
    name = metadata.get(key, "")
    if name not in {entry.name for entry in stored()} and not (key == "plant" and _NONLINEAR.fullmatch(name)):
        raise InputError(f"{source}: expected a flight of {_STORED[key]}, found {name[:40]!r}; say --{key} FILE")
    return name


def _same_law(one: GainLaw, other: GainLaw) -> bool:
    """Return whether two laws compute the same commands in the same windows."""

    def told(law: GainLaw) -> list[tuple[object, ...]]:
        return [
            (
                gains.d_min,
                gains.d_max,
                gains.K1.tobytes(),
                None if gains.K2 is None else gains.K2.tobytes(),
                repr(gains.controller),
            )
            for gains in sets_of(law)
        ]

    return told(one) == told(other) and _same_plant(one.model, other.model)


def _same_plant(one: Model, other: Model) -> bool:
    """Return whether two models are one, as far as Eq. (4) goes."""
    return one.Ts_ns == other.Ts_ns and all(
        np.array_equal(getattr(one, name), getattr(other, name)) for name in ("A", "B", "E", "C", "D")
    )
