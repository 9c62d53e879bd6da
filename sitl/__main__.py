"""The ``sitl`` program: the world around the autopilot, piece by piece or as one flight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, Literal

import click
import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from autopilot.link.clock import NS_PER_S
from autopilot.link.keyfile import read_key
from autopilot.link.keyring import CONTROL_LINK, Keyring
from autopilot.link.process import ADDRESS, ProcessOptions, process_options, run_node
from autopilot.link.udp import Address, dial, listen, true_ns
from autopilot.link.wire import AUTOPILOT, frames_of
from autopilot.profile import parse_profile
from gains.command import NEGATIVE, SUCCESS, FiniteRange, print_json, run, version
from gains.store import load_model
from gains.table import InputError
from gains.witnessfile import read_witness
from sitl.aircraft.disturbance import HarmonicGust, SquareDelta
from sitl.faults import AircraftFault, aircraft_faults, check_faults, parse_fault
from sitl.fly import DEFAULT_PORT_BASE, FlightOptions, Outcome, fly
from sitl.link.gate import Gate, check_flyable
from sitl.link.presets import PRESETS, parse_link
from sitl.link.relay import RelayNode
from sitl.link.spec import parse_spec
from sitl.linkcommands import links
from sitl.plant import DEFAULT_SERVO_TIMEOUT, PlantConfig, PlantNode
from sitl.processes import FlightFailed
from sitl.rescuecommand import recover_command
from sitl.scenario import MAX_SEED, Scenario, load_scenario, stored_scenarios
from sitl.summary import summary_table

__all__ = ["main"]

INTERRUPTED = 130
FILE = click.Path(dir_okay=False, path_type=Path)
SEED = click.IntRange(0, MAX_SEED)


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(version())
def cli() -> None:
    """Fly the autopilot in the loop: aircraft, link, scenarios, recordings."""


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


@cli.command()
@click.option("--plant", "plant_name", default="hirm", show_default=True, help="Stored model, or a model file.")
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
@click.option("--no-aoa", is_flag=True, help="Send no AOA_SSA, as many vehicles do not.")
@click.option("--fault", "fault_texts", multiple=True, help="Failing sensor or elevator; may be repeated (README).")
@click.option("--seed", type=SEED, default=1, show_default=True, help="Of a failing sensor's noise.")
@click.option("--key", "key_file", type=FILE, help="Sign the link with the key in this file (README, Security).")
@click.option("--accept-unsigned", is_flag=True, help="With --key: hear frames without signature, too.")
@process_options
def plant(
    plant_name: str,
    address: Address,
    peer: Address | None,
    latch: Literal["newest", "last"],
    servo_timeout: int,
    x0: str | None,
    gust_s: float | None,
    uncertainty: str | None,
    no_aoa: bool,
    fault_texts: tuple[str, ...],
    seed: int,
    key_file: Path | None,
    accept_unsigned: bool,
    **process: Any,
) -> None:
    """Fly an aircraft: integrate, sense, take the elevator from the network. Runs until Ctrl-C."""
    model = load_model(plant_name)
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


LINK_OPTIONS = (
    click.option("--link", "preset", type=click.Choice(sorted(PRESETS)), help="A link for both directions."),
    click.option("--up", help="Plant to autopilot: delay=25ms,jitter=uniform:28ms,loss=0.1,... (README)."),
    click.option("--down", help="Autopilot to plant, likewise."),
)


def _link_options(command: Any) -> Any:
    for option in reversed(LINK_OPTIONS):
        command = option(command)
    return command


@cli.command()
@click.option("--listen", "address", type=ADDRESS, default="127.0.0.1:14601", show_default=True)
@click.option("--to", type=ADDRESS, default="127.0.0.1:14600", show_default=True, help="The plant.")
@click.option("--peer", type=ADDRESS, help="The one client to hear; else the first that sends a valid frame.")
@click.option("--accept", type=click.Choice(["mavlink", "any"]), default="mavlink", show_default=True,
              help="What a client must send to be heard: a frame of the autopilot, or anything.")  # fmt: skip
@_link_options
@click.option("--seed", type=SEED, default=1, show_default=True)
@click.option("--witness", "witness_name", type=click.Path(dir_okay=False),
              help="Time the commands so that the plant lives the delay sequence of this file.")  # fmt: skip
@process_options
def relay(
    address: Address,
    to: Address,
    peer: Address | None,
    accept: str,
    preset: str | None,
    up: str | None,
    down: str | None,
    seed: int,
    witness_name: str | None,
    **process: Any,
) -> None:
    """Delay, lose and reorder what passes between a client and the plant. Runs until Ctrl-C."""
    link = parse_link(preset, up, down)
    witness = None if witness_name is None else read_witness(witness_name)
    if witness is not None:
        check_flyable(witness, str(witness_name))
    heard = frames_of(AUTOPILOT) if accept == "mavlink" else lambda _datagram: True
    openers = [partial(listen, "autopilot", address, peer=peer, accept=heard), partial(dial, "plant", to)]
    metadata = {"program": "sitl relay", "seed": str(seed), "lagproof": version()}
    node = RelayNode(*link, seed, None if witness is None else Gate(witness))
    run_node("relay", node, openers, ProcessOptions(**process), metadata, tap=False, control=len(openers))


def _in_a_folder(_context: click.Context, parameter: click.Parameter, path: Path | None) -> Path | None:
    """Refuse now, rather than after the flight, a file in a folder that is not there."""
    if path is not None and not path.parent.is_dir():
        raise InputError(f"--{parameter.name} {path}: expected a file in a folder that is there")
    return path


def _report(path: Path | None, name: str, start_ns: int, came_to: Outcome | str) -> None:
    """Write the JUnit report that was asked for."""
    if path is None:
        return
    from sitl.junit import write_junit  # the programs that fly have no use for its library

    seconds = (true_ns() - start_ns) / NS_PER_S
    if isinstance(came_to, str):
        write_junit(path, name, (), {}, seconds, error=came_to)
    else:
        write_junit(path, name, came_to.verdicts, came_to.summary, seconds)


@cli.command("fly")
@click.argument("scenario_name", metavar="[SCENARIO]", default="nominal")
@click.option("--plant", "plant_name", help="Another plant than the scenario's.")
@click.option("--gains", "gains_name", help="Other gains than the scenario's.")
@_link_options
@click.option("--seed", type=SEED, help="Of everything random.")
@click.option("--duration", type=FiniteRange(0.0, 86_400.0, min_open=True), help="Seconds.")
@click.option("--virtual", is_flag=True, help="In virtual time: one process, no socket, much faster.")
@click.option("--actuator", type=click.Choice(["pwm", "float"]), help="SERVO_OUTPUT_RAW or HIL_ACTUATOR_CONTROLS.")
@click.option("--failsafe", type=click.Choice(["on", "monitor"]), help="monitor: report, but fly the law.")
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), help="Folder for the files.")
@click.option("--gcs", multiple=True, default=("udpout:127.0.0.1:14550",), show_default=True,
              help='Ground station; may be repeated; "none" for none.')  # fmt: skip
@click.option("--reference", help="Another programmed reference than the scenario's (README).")
@click.option("--alternative", "alternatives", multiple=True, help="Gains that a ground station may choose instead.")
@click.option("--parameters", "parameters_file", type=FILE, help="File of the vehicle's parameters.")
@click.option("--wait-arm", is_flag=True, help="Leave arming to a ground station; else the vehicle arms itself.")
@click.option("--key", "key_file", type=FILE, help="Sign the control link with the key in this file.")
@click.option("--gcs-key", "gcs_key_file", type=FILE, help="Sign the ground stations' links with this key.")
@click.option("--fault", "faults", multiple=True, help="A fault more, as in kill:autopilot@5s+0.5s; may be repeated.")
@click.option("--port-base", type=click.IntRange(0, 65_000), default=DEFAULT_PORT_BASE, show_default=True,
              help="The plant's port, the relay's is the next; 0 for any free ones.")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print the summary as one JSON object.")
@click.option("--junit", type=FILE, callback=_in_a_folder, help="Write the checks as a JUnit report, too.")
def fly_(
    scenario_name: str,
    plant_name: str | None,
    gains_name: str | None,
    preset: str | None,
    up: str | None,
    down: str | None,
    virtual: bool,
    out: Path | None,
    gcs: tuple[str, ...],
    alternatives: tuple[str, ...],
    parameters_file: Path | None,
    wait_arm: bool,
    key_file: Path | None,
    gcs_key_file: Path | None,
    port_base: int,
    as_json: bool,
    junit: Path | None,
    **changes: Any,
) -> int:
    """Fly a SCENARIO (nominal by default) and judge it: exit 0 when every check passes.

    A scenario is a stored name (see "sitl scenarios") or a TOML file.
    """
    scenario = load_scenario(scenario_name, gains=gains_name, plant=plant_name)
    scenario = _changed(scenario, preset, up, down, changes)
    stations = tuple(address for address in gcs if address != "none")
    for address in stations:
        dial("gcs", ADDRESS.convert(address, None, None)).socket.close()  # refused now rather than by a program
    if virtual and (wait_arm or key_file or gcs_key_file or alternatives or parameters_file):
        options = "--wait-arm, --key, --gcs-key, --alternative, --parameters"
        raise InputError(f"--virtual: expected none of {options}: there is no ground station in virtual time")
    for path in filter(None, (key_file, gcs_key_file)):
        read_key(path)  # refused now rather than by a program
    folder = out or _new_folder(f"{scenario.name}-{datetime.now():%Y%m%d-%H%M%S}")
    ground = ["--wait-arm"] if wait_arm else []
    ground += [word for name in alternatives for word in ("--alternative", name)]
    ground += [] if parameters_file is None else ["--parameters", str(parameters_file)]
    flight = FlightOptions(virtual, folder, stations, port_base, tuple(ground), key_file, gcs_key_file)
    console = Console(stderr=True)
    start_ns = true_ns()
    try:
        outcome = fly(scenario, flight, console)
    except FlightFailed as failure:
        click.echo(f"sitl: error: {failure}", err=True)
        _report(junit, scenario.name, start_ns, str(failure))
        return NEGATIVE
    _report(junit, scenario.name, start_ns, outcome)
    if as_json:
        print_json(outcome.summary)
    else:
        Console().print(summary_table(outcome.summary, outcome.verdicts))
    if outcome.interrupted:
        return INTERRUPTED
    return SUCCESS if outcome.passed else NEGATIVE


def _new_folder(name: str) -> Path:
    """Make and return a folder below ``flights`` that no other flight has."""
    for suffix in ("", *(f"-{n}" for n in range(2, 1000))):
        folder = Path("flights") / f"{name}{suffix}"
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise InputError(f"{folder}: {error.strerror or error}") from None
        return folder
    raise InputError(f"flights/{name}: expected fewer than a thousand flights in one second")


def _changed(
    scenario: Scenario, preset: str | None, up: str | None, down: str | None, changes: dict[str, Any]
) -> Scenario:
    """Return the scenario with what the command line changes; its variants change alike."""
    faults = tuple(parse_fault(text) for text in changes.pop("faults", ()))
    given = {name: value for name, value in changes.items() if value is not None}
    if "reference" in given:
        parse_profile(given["reference"], scenario.gains.model.Ts)  # refused now rather than by a program
    if "duration" in given:
        given["duration_s"] = given.pop("duration")
    if preset is not None:
        given["up"], given["down"] = parse_link(preset, None, None)
    given |= {way: parse_spec(text) for way, text in (("up", up), ("down", down)) if text is not None}

    def changed(one: Scenario) -> Scenario:
        return replace(one, **given).with_faults((*one.faults, *faults))

    variants = {name: changed(variant) for name, variant in scenario.variants.items()}
    return replace(changed(scenario), variants=variants)


@cli.command()
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def scenarios(as_json: bool) -> None:
    """List the stored scenarios."""
    titles = {name: load_scenario(name).title for name in stored_scenarios()}
    if as_json:
        print_json(titles)
        return
    _print_pairs(list(titles.items()))


def _print_pairs(pairs: Sequence[tuple[str, str]]) -> None:
    width = max(len(name) for name, _ in pairs)
    for name, text in pairs:
        click.echo(f"{name:<{width}}  {text}")


for command in (links, recover_command):
    cli.add_command(command)


def main() -> None:
    """Run the ``sitl`` command."""
    run(cli, "sitl")


if __name__ == "__main__":
    main()
