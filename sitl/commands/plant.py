"""``sitl plant``: an aircraft as a program of its own."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import click
import numpy as np
from numpy.typing import NDArray

from autopilot.link.keyring import CONTROL_LINK, Keyring
from autopilot.link.process import ADDRESS, ProcessOptions, process_options, run_node
from autopilot.link.udp import Address, listen
from autopilot.link.wire import AUTOPILOT, frames_of
from gains.command import FiniteRange, version
from gains.model import Model
from gains.store import load_model
from gains.table import InputError
from sitl.aircraft.disturbance import HarmonicGust, SquareDelta
from sitl.aircraft.plants import airframe_maker, is_nonlinear
from sitl.aircraft.wind import parse_wind
from sitl.commands.options import FILE, SEED
from sitl.faults import AircraftFault, aircraft_faults, check_faults, parse_fault
from sitl.plant import DEFAULT_SERVO_TIMEOUT, PlantConfig, PlantNode

__all__ = ["plant"]


def _vector(text: str) -> NDArray[np.float64]:
    """Return comma-separated numbers as an array."""
    try:
        values = np.array([float(part) for part in text.split(",")])
    except ValueError:
        raise InputError(f'--x0 "{text}": expected numbers such as 0.1,0') from None
    if not np.all(np.isfinite(values)):
        raise InputError(f'--x0 "{text}": expected finite numbers')
    return values


def _square(text: str) -> SquareDelta:
    """Return AMPLITUDE:HALF_PERIOD as the signal of Eq. (51)."""
    amplitude, _, half_period = text.partition(":")
    try:
        delta = SquareDelta(float(amplitude), int(half_period or 20))
    except ValueError:
        raise InputError(f'--uncertainty "{text}": expected AMPLITUDE:SAMPLES such as 0.15:20') from None
    if not np.isfinite(delta.amplitude) or delta.half_period < 1:
        raise InputError(f'--uncertainty "{text}": expected a finite amplitude and at least one sample')
    return delta


def _plant_faults(texts: Sequence[str], states: Sequence[str]) -> tuple[AircraftFault, ...]:
    """Return the faults that a plant does itself."""
    faults = [parse_fault(text) for text in texts]
    check_faults(faults, states)
    for text, fault in zip(texts, faults, strict=True):
        if not isinstance(fault, AircraftFault):
            raise InputError(f'--fault "{text}": expected sensor:... or elevator:...; "sitl fly --fault" takes all')
    return aircraft_faults(faults)


def _model(plant_name: str, model_name: str | None) -> Model:
    """Return the model of the plant: of a linear one its own."""
    if not is_nonlinear(plant_name):
        if model_name is not None:
            raise InputError(f"--model: expected sixdof:... or jsbsim:... as --plant, found {plant_name}")
        return load_model(plant_name)
    if model_name is None:
        raise InputError(f"--plant {plant_name}: expected --model, too; sitl linearize makes one")
    return load_model(model_name)


@click.command()
@click.option(
    "--plant",
    "plant_name",
    default="hirm",
    show_default=True,
    help="Stored model or a model file; or sixdof:NAME or jsbsim:NAME, with --model.",
)
@click.option("--model", "model_name", help="The model that describes a sixdof: or jsbsim: plant (sitl linearize).")
@click.option("--listen", "address", type=ADDRESS, default="127.0.0.1:14600", show_default=True)
@click.option("--peer", type=ADDRESS, help="The one address to hear; else the first that sends a valid frame.")
@click.option(
    "--latch",
    type=click.Choice(["newest", "last"]),
    default="newest",
    show_default=True,
    help="Of the commands that came in time: the newest sample's, or the last arrived.",
)
@click.option(
    "--servo-timeout",
    type=click.IntRange(0),
    default=DEFAULT_SERVO_TIMEOUT,
    show_default=True,
    help="Samples without a new command after which the elevator goes to neutral; 0 for never.",
)
@click.option("--x0", help="State at k = 0, comma-separated; trim by default.")
@click.option("--gust", "gust_s", type=FiniteRange(0.0), help="The gust of Eq. (52), from this time in s on.")
@click.option("--uncertainty", help="Delta(k) of Eq. (51) as AMPLITUDE:HALF_PERIOD, for example 0.15:20.")
@click.option("--wind", "wind_text", help="Turbulence and gusts of such a plant, as in dryden:moderate (README).")
@click.option("--no-aoa", is_flag=True, help="Send no AOA_SSA, as many vehicles do not.")
@click.option(
    "--fault", "fault_texts", multiple=True, help="Failing sensor or elevator; may be repeated (docs/faults.md)."
)
@click.option("--seed", type=SEED, default=1, show_default=True, help="Of turbulence and a failing sensor's noise.")
@click.option("--key", "key_file", type=FILE, help="Sign the link with the key in this file (README, Security).")
@click.option("--accept-unsigned", is_flag=True, help="With --key: hear frames without signature, too.")
@process_options
def plant(
    plant_name: str,
    model_name: str | None,
    address: Address,
    peer: Address | None,
    latch: Literal["newest", "last"],
    servo_timeout: int,
    x0: str | None,
    gust_s: float | None,
    uncertainty: str | None,
    wind_text: str | None,
    no_aoa: bool,
    fault_texts: tuple[str, ...],
    seed: int,
    key_file: Path | None,
    accept_unsigned: bool,
    **process: Any,
) -> None:
    """Fly an aircraft: integrate, sense, take the elevator from the network. Runs until Ctrl-C."""
    model = _model(plant_name, model_name)
    if is_nonlinear(plant_name) and (x0 is not None or uncertainty is not None):
        raise InputError(f"--x0, --uncertainty: expected a linear model as plant, found {plant_name}")
    start = _vector(x0) if x0 is not None else None
    if start is not None and start.shape != (model.nx,):
        raise InputError(f"--x0: expected {model.nx} numbers, found {start.size}")
    if gust_s is not None and model.nw == 0:
        raise InputError(f"--gust: expected a plant with a disturbance input E, found {model.name} without")
    if uncertainty is not None and model.uncertainty is None:
        raise InputError(f"--uncertainty: expected a plant with [uncertainty], found {model.name} without")
    config = PlantConfig(
        model,
        start,
        None if gust_s is None else HarmonicGust(model.nw, round(gust_s / model.Ts)),
        None if uncertainty is None else _square(uncertainty),
        latch,
        servo_timeout or None,
        not no_aoa,
        _plant_faults(fault_texts, model.states),
        seed,
        airframe_maker(plant_name, model, None if wind_text is None else parse_wind(wind_text), seed),
    )
    options = ProcessOptions(**process)
    keyring, seal = Keyring("plant", options.clock), None
    if key_file is not None:
        seal = keyring.seal(
            "autopilot", key_file, CONTROL_LINK, peer_link=CONTROL_LINK, accept_unsigned=accept_unsigned
        )
    openers = [partial(listen, "autopilot", address, peer=peer, accept=frames_of(AUTOPILOT, seal))]
    metadata = {"program": "sitl plant", "plant": plant_name, "lagproof": version()}
    run_node("plant", PlantNode(config, seal), openers, options, metadata, tap=False, keyring=keyring)
