"""The ``autopilot`` program: flies gains, or a schedule of them, over MAVLink."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Literal

import click

from autopilot.alpha import AlphaChoice
from autopilot.app import AutopilotNode
from autopilot.config import AutopilotConfig, Home
from autopilot.ground.parameterfile import ParameterFile
from autopilot.ground.settings import Settings
from autopilot.link.clock import NS_PER_S, Clock
from autopilot.link.keyring import CONTROL_LINK, Keyring, ground_link
from autopilot.link.process import ADDRESS, Parsed, ProcessOptions, process_options, run_node
from autopilot.link.udp import Address, dial
from autopilot.link.wire import Seal
from autopilot.profile import parse_profile
from autopilot.rehearsal import Rehearsal
from gains.command import FiniteRange, run, version
from gains.model import Schedule
from gains.store import load_law
from gains.table import InputError

__all__ = ["main"]

MAX_GROUND_STATIONS = 8


def parse_home(text: str) -> Home:
    """Return the place written as ``47.4,8.5,488``: degrees, and metres above the sea.

    Raises
    ------
    InputError
        For anything else.
    """
    try:
        latitude, longitude, altitude = map(float, text.split(","))
    except ValueError:
        latitude = longitude = altitude = math.nan
    if not (abs(latitude) <= 85.0 and abs(longitude) <= 180.0 and abs(altitude) <= 100_000.0):
        raise InputError(f'home "{text}": expected LATITUDE,LONGITUDE,ALTITUDE such as 47.4,8.5,488')
    return Home(latitude, longitude, altitude)


HOME = Parsed("HOME", parse_home)


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.option(
    "--gains",
    "gains_name",
    default="hirm-paper",
    show_default=True,
    help="Stored gains, or a gain file; a schedule too.",
)
@click.option(
    "--plant",
    type=ADDRESS,
    default="udpout:127.0.0.1:14601",
    show_default=True,
    help="The plant, or the relay before it.",
)
@click.option(
    "--gcs",
    multiple=True,
    default=("udpout:127.0.0.1:14550",),
    show_default=True,
    help='A ground station; may be repeated; "none" for none.',
)
@click.option(
    "--reference", default="", help="Pitch reference: 5deg@1s,0deg@6s; or doublet:, 3211:, sine:, file: (README)."
)
@click.option(
    "--actuator",
    type=click.Choice(["pwm", "float"]),
    default="pwm",
    show_default=True,
    help="SERVO_OUTPUT_RAW, or HIL_ACTUATOR_CONTROLS without quantisation.",
)
@click.option(
    "--failsafe",
    type=click.Choice(["on", "monitor"]),
    default="on",
    show_default=True,
    help="monitor: report transitions, fly the law all the same.",
)
@click.option(
    "--alpha",
    type=click.Choice(["auto", "aoa_ssa", "vfr_hud"]),
    default="auto",
    show_default=True,
    help="Where the angle of attack comes from; auto: VFR_HUD where no AOA_SSA ever comes.",
)
@click.option(
    "--align/--no-align",
    default=True,
    show_default=True,
    help="Look the reference ahead by the forecast delay.",
)
@click.option(
    "--hold",
    "hold_s",
    type=FiniteRange(0.0, 60.0),
    default=0.5,
    show_default=True,
    help="Seconds that failsafe holds the last command before neutral.",
)
@click.option(
    "--saturation",
    "saturation_s",
    type=FiniteRange(0.0, 3600.0),
    default=1.0,
    show_default=True,
    help="Seconds that the elevator may stay at its limit before neutral; 0 for ever.",
)
@click.option(
    "--ground-timeout",
    "ground_timeout_s",
    type=FiniteRange(0.0, 3600.0),
    default=0.0,
    show_default=True,
    help="Seconds without a ground station, once one was heard, until the reference is eased to zero; 0: never.",
)
@click.option("--wait-arm", is_flag=True, help="Leave arming to a ground station; else it arms itself, once.")
@click.option(
    "--alternative",
    "alternatives",
    multiple=True,
    help="Gains that a ground station may choose instead (parameter GAINS); may be repeated.",
)
@click.option(
    "--parameters",
    "parameters_file",
    type=click.Path(dir_okay=False, path_type=Path),
    help="File of the parameters that ground stations have saved; they count before the options here.",
)
@click.option(
    "--home", type=HOME, default="47.397742,8.545594,488", show_default=True, help="LATITUDE,LONGITUDE,ALTITUDE."
)
@click.option(
    "--key",
    "keys",
    multiple=True,
    help="PORT=FILE: sign a link with the key in a file; PORT is plant, gcs0, gcs1, ..., or gcs for all of these.",
)
@click.option("--accept-unsigned", "unsigned", multiple=True, help="A signed PORT that hears unsigned frames, too.")
@click.option("--require-certificate", is_flag=True, help="Refuse gains without a verified certificate.")
@click.option("--busy", is_flag=True, help="Never sleep: it takes a processor of its own, and commands leave sooner.")
@process_options
@click.version_option(version())
def cli(
    gains_name: str,
    plant: Address,
    gcs: tuple[str, ...],
    reference: str,
    actuator: Literal["pwm", "float"],
    failsafe: Literal["on", "monitor"],
    alpha: AlphaChoice,
    align: bool,
    hold_s: float,
    saturation_s: float,
    ground_timeout_s: float,
    wait_arm: bool,
    alternatives: tuple[str, ...],
    parameters_file: Path | None,
    home: Home,
    keys: tuple[str, ...],
    unsigned: tuple[str, ...],
    require_certificate: bool,
    busy: bool,
    clock: Clock,
    record: Path | None,
    stream: Address | None,
) -> None:
    """Fly GAINS: state from the plant over MAVLink in, elevator commands out, whatever the link does.

    Runs until Ctrl-C. Telemetry goes to the ground stations, the control link to the plant; each port
    hears its one peer and nobody else.
    """
    gains = load_law(gains_name)
    stations = [ADDRESS.convert(text, None, None) for text in gcs if text != "none"]
    if len(stations) > MAX_GROUND_STATIONS:
        raise InputError(f"--gcs: expected at most {MAX_GROUND_STATIONS} ground stations, found {len(stations)}")
    if parameters_file is not None and not parameters_file.absolute().parent.is_dir():
        raise InputError(f"{parameters_file}: expected a file in a folder that exists, found no such folder")
    options = ProcessOptions(clock, record, stream)
    keyring = Keyring("autopilot", clock)
    config = AutopilotConfig(
        gains=gains,
        profile=parse_profile(reference, gains.model.Ts),
        actuator=actuator,
        failsafe=failsafe,
        alpha=alpha,
        align=align,
        hold_ns=round(hold_s * NS_PER_S),
        saturation_ns=round(saturation_s * NS_PER_S),
        ground_timeout_ns=round(ground_timeout_s * NS_PER_S),
        ground_stations=len(stations),
        wait_arm=wait_arm,
        alternatives=tuple(load_law(name) for name in alternatives),
        home=home,
        parameters=None if parameters_file is None else ParameterFile(parameters_file),
        seals=_seals(keyring, keys, unsigned, len(stations)),
    )
    if isinstance(gains, Schedule) and gains.certificate is not None:  # of all switching: it may take half a minute
        click.echo(f"autopilot: checking the certificate of schedule {gains.name}", err=True)
    with closing(keyring):
        node = AutopilotNode(config)
        if require_certificate:
            _require_certificates(node.settings)
        _run(node, keyring, options, plant, stations, busy=busy)


def _require_certificates(settings: Settings) -> None:
    """Refuse laws without a verified certificate, all that may be flown.

    Raises
    ------
    InputError
        Naming the first.
    """
    for law, proof, wide in zip(settings.laws, settings.proofs, settings.conservative_proofs, strict=True):
        for which, each, verification in (("gains", law, proof), ("conservative gains", law.conservative, wide)):
            if each is not None and verification is not None and not verification.passed:
                reason = f"no verified certificate ({verification.reason}), but --require-certificate"
                raise InputError(f"{which} {each.name}: {reason}")


def _run(
    node: AutopilotNode,
    keyring: Keyring,
    options: ProcessOptions,
    plant: Address,
    stations: Sequence[Address],
    *,
    busy: bool,
) -> None:
    """Open the ports, say what flies, and fly until told to end."""
    gains, proof = node.pilot.gains, node.proof
    openers = [partial(dial, "plant", plant), *(partial(dial, f"gcs{i}", a) for i, a in enumerate(stations))]
    proved = "certificate verified" if proof.passed else "no verified certificate"
    windows = ", ".join(f"{d_min}..{d_max}" for d_min, d_max in node.windows)
    scheduled = f", delay {windows}" if len(node.windows) > 1 else ""
    wide, wide_proof, also = gains.conservative, node.conservative_proof, ""
    if wide is not None and wide_proof is not None:
        also = (
            f", conservative {wide.name} ({'certificate verified' if wide_proof.passed else 'no verified certificate'})"
        )
    banner = f"autopilot: gains {gains.name} ({proved}){scheduled}{also}, plant {plant[0]}:{plant[1]}"
    metadata = {"program": "autopilot", "gains": gains.name, "version": version()}
    run_node(
        "autopilot",
        node,
        openers,
        options,
        metadata,
        tap=True,
        banner=banner,
        keyring=keyring,
        busy=busy,
        idle=Rehearsal(node.config).once if busy else None,
    )


def _seals(keyring: Keyring, keys: Sequence[str], unsigned: Sequence[str], stations: int) -> dict[str, Seal]:
    """Return the signing of each port that has a key.

    Raises
    ------
    InputError
        For a port that is not there, or one that is to accept unsigned frames and has no key.
    """
    ground = [f"gcs{i}" for i in range(stations)]
    files: dict[str, Path] = {}
    for text in keys:
        port, equals, name = text.partition("=")
        if not equals or not name:
            raise InputError(f'--key "{text}": expected PORT=FILE such as plant=plant.key')
        files |= dict.fromkeys(_ports("--key", port, ground), Path(name))
    open_ports = {each for port in unsigned for each in _ports("--accept-unsigned", port, ground)}
    if keyless := sorted(open_ports - files.keys()):
        raise InputError(f"--accept-unsigned {keyless[0]}: expected a port with a --key; one without hears everybody")
    seals: dict[str, Seal] = {}
    for port, path in files.items():
        control = port == "plant"
        link = CONTROL_LINK if control else ground_link(ground.index(port))
        peer_link = CONTROL_LINK if control else None
        seals[port] = keyring.seal(port, path, link, peer_link=peer_link, accept_unsigned=port in open_ports)
    return seals


def _ports(option: str, port: str, ground: Sequence[str]) -> Sequence[str]:
    """Return the ports that a word stands for."""
    if port == "gcs":
        return ground
    if port != "plant" and port not in ground:
        raise InputError(f"{option} {port}: expected plant, gcs, or one of {', '.join(ground) or 'no ground station'}")
    return [port]


def main() -> None:
    """Run the ``autopilot`` command."""
    run(cli, "autopilot")


if __name__ == "__main__":
    main()
