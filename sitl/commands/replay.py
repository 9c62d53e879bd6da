"""``sitl replay``: the delay sequence of a recorded flight, flown again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import click

from gains.table import InputError
from gains.witnessfile import Witness, write_witness
from sitl.commands.fly import flight_options, fly_and_tell, ground_stations, new_folder
from sitl.commands.options import FILE, SEED
from sitl.flightfile import load_flight
from sitl.programs import FlightOptions
from sitl.replaying import recorded_sequence, replay_of

__all__ = ["DELAYS_FILE", "replay"]

DELAYS_FILE = "delays.csv"


@click.command()
@click.argument("recording", metavar="FLIGHT.mcap", type=FILE)
@click.option("--scenario", "scenario_name", help="The scenario that was flown, where it is not a stored one.")
@click.option("--plant", "plant_name", help="Another plant: a model, or sixdof:NAME or jsbsim:NAME.")
@click.option("--gains", "gains_name", help="Other gains.")
@click.option("--reference", help="Another programmed reference (README).")
@click.option("--seed", type=SEED, help="Of everything random.")
@flight_options
def replay(
    recording: Path,
    scenario_name: str | None,
    plant_name: str | None,
    gains_name: str | None,
    reference: str | None,
    seed: int | None,
    virtual: bool,
    failsafe: Literal["on", "monitor"] | None,
    out: Path | None,
    gcs: tuple[str, ...],
    port_base: int,
    as_json: bool,
    junit: Path | None,
) -> int:
    """Fly the delays of a recording again, d(k) for each sample k: exit 0 when they were lived in a flight that lasts.

    Scenario, gains, plant, reference and seed are those of the recording unless told otherwise; its link and its
    faults are not flown again, only what became of the commands.
    """
    recorded = load_flight(recording)
    sequence = recorded_sequence(recorded, str(recording))
    scenario = replay_of(
        recorded,
        str(recording),
        sequence,
        scenario_name=scenario_name,
        gains_name=gains_name,
        plant_name=plant_name,
        reference=reference,
    )
    stations = ground_stations(gcs)
    folder = out or new_folder(f"replay-{recorded.name}")
    scenario = replace(
        scenario,
        seed=scenario.seed if seed is None else seed,
        failsafe=failsafe or scenario.failsafe,
        witness_name=_write_delays(sequence, folder, recording),
    )
    return fly_and_tell(scenario, FlightOptions(virtual, folder, stations, port_base), as_json=as_json, junit=junit)


def _write_delays(sequence: Witness, folder: Path, recording: Path) -> str:
    """Write a delay sequence into the folder of a flight, where the relay reads it, and return the file's name."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        overwritten = (folder / "flight.mcap").exists() and (folder / "flight.mcap").samefile(recording)
    except OSError as error:
        raise InputError(f"--out {folder}: {error.strerror or error}") from None
    if overwritten:
        raise InputError(f"--out {folder}: expected another folder than that of the recording")
    write_witness(folder / DELAYS_FILE, sequence)
    return str(folder / DELAYS_FILE)
