"""``sitl fly``: a flight and its verdict; ``sitl scenarios``: which there are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from autopilot.link.clock import NS_PER_S
from autopilot.link.keyfile import read_key
from autopilot.link.process import ADDRESS
from autopilot.link.udp import Address, dial, true_ns
from autopilot.profile import parse_profile
from gains.command import NEGATIVE, SUCCESS, FiniteRange, print_json
from gains.table import InputError
from sitl.aircraft.wind import parse_wind
from sitl.commands.links import link_options
from sitl.commands.options import CONTROL, FILE, SEED
from sitl.faults import parse_fault
from sitl.fly import FlightOptions, Outcome, fly
from sitl.link.changes import format_change
from sitl.link.control import DEFAULT_CONTROL
from sitl.link.presets import parse_link
from sitl.link.relayfile import parse_changes, parse_rules
from sitl.link.rules import format_rule
from sitl.link.spec import parse_spec
from sitl.processes import FlightFailed
from sitl.programs import DEFAULT_PORT_BASE
from sitl.scenario import Scenario, check_changes, load_scenario, stored_scenarios
from sitl.summary import summary_table

__all__ = ["flight_options", "fly_and_tell", "fly_command", "ground_stations", "new_folder", "scenarios"]

INTERRUPTED = 130


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


_FLIGHT_OPTIONS = (
    click.option("--virtual", is_flag=True, help="In virtual time: one process, no socket, much faster."),
    click.option("--failsafe", type=click.Choice(["on", "monitor"]), help="monitor: report, but fly the law."),
    click.option("--out", type=click.Path(file_okay=False, path_type=Path), help="Folder for the files."),
    click.option("--gcs", multiple=True, default=("udpout:127.0.0.1:14550",), show_default=True,
                 help='Ground station; may be repeated; "none" for none.'),
    click.option("--port-base", type=click.IntRange(0, 65_000), default=DEFAULT_PORT_BASE, show_default=True,
                 help="The plant's port, the relay's is the next; 0 for any free ones."),
    click.option("--json", "as_json", is_flag=True, help="Print the summary as one JSON object."),
    click.option("--junit", type=FILE, callback=_in_a_folder, help="Write the checks as a JUnit report, too."),
)  # fmt: skip


def flight_options(command: Any) -> Any:
    """Add to a click command what any flight can be told: how it flies, and where it goes."""
    for option in reversed(_FLIGHT_OPTIONS):
        command = option(command)
    return command


def ground_stations(gcs: Sequence[str]) -> tuple[str, ...]:
    """Return the addresses of the ground stations, refused now rather than by a program."""
    stations = tuple(address for address in gcs if address != "none")
    for address in stations:
        dial("gcs", ADDRESS.convert(address, None, None)).socket.close()
    return stations


@click.command("fly")
@click.argument("scenario_name", metavar="[SCENARIO]", default="nominal")
@click.option("--plant", "plant_name",
              help="Another plant than the scenario's: a model, or sixdof:NAME or jsbsim:NAME.")  # fmt: skip
@click.option("--gains", "gains_name", help="Other gains than the scenario's.")
@link_options
@click.option("--rule", "rules", multiple=True,
              help="Another link for some messages, as in up:ATTITUDE:delay=40ms; may be repeated"
                   " (docs/links.md).")  # fmt: skip
@click.option("--at", "changes_at", multiple=True,
              help="A change more of the link in flight, as in 3s:up:loss=0.5; may be repeated"
                   " (docs/links.md).")  # fmt: skip
@click.option("--control", type=CONTROL, is_flag=False, flag_value=DEFAULT_CONTROL, metavar="[[HOST:]PORT]",
              help=f'Let "sitl relay set" change the link in flight, at {DEFAULT_CONTROL} or elsewhere.')  # fmt: skip
@click.option("--wind", "wind_text", help="Turbulence and gusts, as in dryden:moderate+gust:5mps:100m@3s (README).")
@click.option("--seed", type=SEED, help="Of everything random.")
@click.option("--duration", type=FiniteRange(0.0, 86_400.0, min_open=True), help="Seconds.")
@click.option("--actuator", type=click.Choice(["pwm", "float"]), help="SERVO_OUTPUT_RAW or HIL_ACTUATOR_CONTROLS.")
@click.option("--reference", help="Another programmed reference than the scenario's (README).")
@click.option("--alternative", "alternatives", multiple=True, help="Gains that a ground station may choose instead.")
@click.option("--parameters", "parameters_file", type=FILE, help="File of the vehicle's parameters.")
@click.option("--wait-arm", is_flag=True, help="Leave arming to a ground station; else the vehicle arms itself.")
@click.option("--key", "key_file", type=FILE, help="Sign the control link with the key in this file.")
@click.option("--gcs-key", "gcs_key_file", type=FILE, help="Sign the ground stations' links with this key.")
@click.option(
    "--fault",
    "faults",
    multiple=True,
    help="A fault more, as in kill:autopilot@5s+0.5s; may be repeated (docs/faults.md).",
)
@flight_options
def fly_command(
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
    control: Address | None,
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
    if virtual and (wait_arm or key_file or gcs_key_file or alternatives or parameters_file):
        options = "--wait-arm, --key, --gcs-key, --alternative, --parameters"
        raise InputError(f"--virtual: expected none of {options}: there is no ground station in virtual time")
    if virtual and control is not None:
        raise InputError("--control: expected none with --virtual, which is over before anybody could ask: see --at")
    for path in filter(None, (key_file, gcs_key_file)):
        read_key(path)  # refused now rather than by a program
    stations = ground_stations(gcs)
    folder = out or new_folder(scenario.name)
    ground = ["--wait-arm"] if wait_arm else []
    ground += [word for name in alternatives for word in ("--alternative", name)]
    ground += [] if parameters_file is None else ["--parameters", str(parameters_file)]
    flight = FlightOptions(virtual, folder, stations, port_base, tuple(ground), key_file, gcs_key_file, control)
    return fly_and_tell(scenario, flight, as_json=as_json, junit=junit)


def fly_and_tell(scenario: Scenario, flight: FlightOptions, *, as_json: bool, junit: Path | None) -> int:
    """Fly, print what it came to, and return the exit status."""
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


def new_folder(name: str) -> Path:
    """Make and return a folder below ``flights`` that no other flight has: a name and the time of day."""
    name = f"{name}-{datetime.now():%Y%m%d-%H%M%S}"
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
    rules, changes_at = changes.pop("rules", ()), changes.pop("changes_at", ())
    rules = parse_rules((*map(format_rule, scenario.rules), *rules), "--rule")
    changes_at = parse_changes((*map(format_change, scenario.changes), *changes_at), "--at")
    given = {name: value for name, value in changes.items() if value is not None}
    if "wind_text" in given:
        given["wind"] = parse_wind(given.pop("wind_text"))
    if "reference" in given:
        parse_profile(given["reference"], scenario.gains.model.Ts)  # refused now rather than by a program
    if "duration" in given:
        given["duration_s"] = given.pop("duration")
    check_changes(changes_at, given.get("duration_s", scenario.duration_s))
    if preset is not None:
        given["up"], given["down"] = parse_link(preset, None, None)
    given |= {way: parse_spec(text) for way, text in (("up", up), ("down", down)) if text is not None}

    def changed(one: Scenario) -> Scenario:
        return replace(one, rules=rules, changes=changes_at, **given).with_faults((*one.faults, *faults))

    variants = {name: changed(variant) for name, variant in scenario.variants.items()}
    scenario = replace(changed(scenario), variants=variants)
    if make := scenario.airframe_maker():
        make()  # refused now rather than by a program
    return scenario


@click.command()
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
