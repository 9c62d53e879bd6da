"""The three programs of a flight over UDP: the command lines that a person could type, and the order of starting.

What is started again in flight is started by the same command line. A port that was any free one at first is then the
one that it turned out to be, since the others send to it.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from autopilot.link.ports import Address
from gains.store import resolve
from gains.table import InputError
from sitl.arguments import autopilot_arguments, plant_arguments, relay_arguments
from sitl.processes import ChildDied, Supervisor
from sitl.scenario import Scenario

__all__ = ["DEFAULT_PORT_BASE", "FlightOptions", "Programs", "damaged", "start_programs"]

DEFAULT_PORT_BASE = 14600
DAMAGED_GAINS = "damaged-gains.toml"
"""The gain file of a fault, in the flight's folder."""

SECTOR = 512
"""Bytes that a damaged file has lost."""


@dataclass(frozen=True, slots=True)
class FlightOptions:
    """How a scenario is flown.

    Attributes
    ----------
    virtual : bool
        In virtual time, else over UDP.
    folder : Path or None
        Where the files go; None keeps none.
    ground_stations : tuple of str
        Addresses that get telemetry.
    port_base : int
        The plant listens there and the relay on the next port; 0 for any free ports.
    ground_arguments : tuple of str
        Options of the autopilot that are about ground stations, over UDP.
    key_file, gcs_key_file : Path or None
        Keys of the control link and of the ground stations' links, over UDP.
    control : Address or None
        Where the relay takes requests, over UDP.
    """

    virtual: bool
    folder: Path | None
    ground_stations: tuple[str, ...] = ()
    port_base: int = DEFAULT_PORT_BASE
    ground_arguments: tuple[str, ...] = ()
    key_file: Path | None = None
    gcs_key_file: Path | None = None
    control: Address | None = None


@dataclass(slots=True)
class Programs:
    """How the programs of a flight are started: command lines that a person could type.

    Attributes
    ----------
    scenario : Scenario
        What is flown.
    options : FlightOptions
        How.
    plant_port, relay_port : int
        Where they listen; 0 is any free port, until it is known which.
    """

    scenario: Scenario
    options: FlightOptions
    plant_port: int
    relay_port: int

    def plant(self) -> list[str]:
        """Return what to start as the plant."""
        key = [] if self.options.key_file is None else ["--key", str(self.options.key_file)]
        return ["sitl", "plant", "--listen", f"127.0.0.1:{self.plant_port}", *key, *plant_arguments(self.scenario)]

    def relay(self) -> list[str]:
        """Return what to start as the relay."""
        ports = ["--listen", f"127.0.0.1:{self.relay_port}", "--to", f"127.0.0.1:{self.plant_port}"]
        control = self.options.control
        asked = [] if control is None else [f"--control={control[0]}:{control[1]}"]
        return ["sitl", "relay", *ports, *asked, *relay_arguments(self.scenario)]

    def autopilot(self, gains_name: str | None = None) -> list[str]:
        """Return what to start as the autopilot, by default with the scenario's gains."""
        plant = ["--plant", f"udpout:127.0.0.1:{self.relay_port}"]
        scenario = self.scenario if gains_name is None else replace(self.scenario, gains_name=gains_name)
        return ["autopilot", *plant, *self._ground_arguments(), *autopilot_arguments(scenario)]

    def again(self, name: str, folder: Path, *, corrupt_gains: bool = False) -> list[str]:
        """Return what to start in flight in place of a program that has been killed.

        Parameters
        ----------
        name : str
            The program.
        folder : Path
            Where a damaged copy of the gain file goes.
        corrupt_gains : bool
            Whether the autopilot shall find that one.

        Raises
        ------
        InputError
            When the copy cannot be written.
        """
        if name == "plant":
            return self.plant()
        if name == "relay":
            return self.relay()
        if not corrupt_gains:
            return self.autopilot()
        path = folder / DAMAGED_GAINS
        try:
            path.write_bytes(damaged(resolve(self.scenario.gains_name).read_bytes()))
        except OSError as error:
            raise InputError(f"{path}: {error.strerror or error}") from None
        return self.autopilot(str(path))

    def _ground_arguments(self) -> list[str]:
        """Return the options of the autopilot that are none of the scenario."""
        options = self.options
        arguments = list(options.ground_arguments)
        for port, path in (("plant", options.key_file), ("gcs", options.gcs_key_file)):
            arguments += [] if path is None else ["--key", f"{port}={path}"]
        addresses = options.ground_stations or ("none",)
        return [*arguments, *(word for address in addresses for word in ("--gcs", address))]


def damaged(content: bytes) -> bytes:
    """Return a file as a disk gives it back that has lost the sector in the middle: zeros stand there."""
    start = max(0, len(content) // 2 - SECTOR // 2)
    return content[:start] + bytes(max(1, min(SECTOR, len(content) - start))) + content[start + SECTOR :]


def start_programs(
    scenario: Scenario, options: FlightOptions, supervisor: Supervisor, interrupted: Callable[[], bool]
) -> Programs:
    """Start the programs, each as soon as the address it dials is known; an error of theirs is an input error.

    Parameters
    ----------
    scenario : Scenario
        What is flown.
    options : FlightOptions
        How.
    supervisor : Supervisor
        Of none so far.
    interrupted : callable
        Asked while waiting; True leaves off.

    Raises
    ------
    InputError
        When a program refuses what it was given.
    ChildDied
        When one ends otherwise.
    """
    programs = Programs(scenario, options, options.port_base, options.port_base + 1 if options.port_base else 0)
    try:
        supervisor.start("plant", programs.plant())
        if not programs.plant_port:
            programs.plant_port = supervisor.wait_ready("plant", interrupted).get("autopilot", ("", 0))[1]
        if interrupted():
            return programs
        supervisor.start("relay", programs.relay())
        if not programs.relay_port:
            programs.relay_port = supervisor.wait_ready("relay", interrupted).get("autopilot", ("", 0))[1]
        if interrupted():
            return programs
        supervisor.start("autopilot", programs.autopilot())
        for name in ("plant", "relay", "autopilot"):
            supervisor.wait_ready(name, interrupted)
    except ChildDied as death:
        if death.code == 2 and death.last_words:
            raise InputError(re.sub(r"^\w+: error: ", "", death.last_words)) from None
        raise
    return programs
