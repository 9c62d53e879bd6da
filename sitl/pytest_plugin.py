"""Flights as fixtures, for the tests of other projects: a ground station, a companion computer, a log analyser.

``lagproof_pair`` starts an aircraft and its autopilot over UDP, with the link between them that the test asks for, and
ends them when the test is over, however it ends::

    def test_my_station_sees_the_vehicle(lagproof_pair):
        pair = lagproof_pair("nominal", link="lossy", gcs=True)
        station = my_station.listen(*pair.gcs_address)
        ...
        assert pair.wait(60.0)["passed"]

``lagproof_fly`` flies in virtual time, in a second or two, and returns the summary.

Every flight is a process of its own (``sitl fly``), so nothing of it reaches the test's process: no warning filter, no
signal handler, no solver. This module imports nothing that takes time.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

__all__ = ["FlightError", "Fly", "Pair", "PairFactory", "lagproof_fly", "lagproof_pair"]

STOP_TIMEOUT_S = 15.0
"""How long a flight may take to write its files when it is told to end."""

FLY_TIMEOUT_S = 300.0
MAX_LOG_BYTES = 1 << 16
"""Of each program's standard error, its end."""


class FlightError(Exception):
    """A flight came to nothing: no summary in time, or none at all. Its message ends with what the programs said."""


class Pair:
    """A flight under way in the background: plant, relay and autopilot, recorded into a folder.

    Attributes
    ----------
    folder : Path
        Where the recording and the programs' logs are.
    gcs_address : (str, int) or None
        Where the autopilot looks for its ground station: host and UDP port to listen at. None without one.
    """

    def __init__(self, folder: Path, gcs_address: tuple[str, int] | None, arguments: Sequence[str]) -> None:
        self.folder = folder
        self.gcs_address = gcs_address
        with (folder / "fly.log").open("wb") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "sitl", "fly", *arguments],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=log,
                # A folder of the other project may be called sitl, too: the working folder is none of the path.
                env={**os.environ, "PYTHONSAFEPATH": "1"},
                start_new_session=True,  # Ctrl-C ends the test, which ends this
            )

    @property
    def running(self) -> bool:
        """Whether the flight is still under way."""
        return self._process.poll() is None

    @property
    def pid(self) -> int:
        """Process id of the supervisor, whose children the programs are."""
        return self._process.pid

    @property
    def mcap(self) -> Path:
        """The recording."""
        return self.folder / "flight.mcap"

    @property
    def tlog(self) -> Path:
        """What the ground station was sent; without one, the control link."""
        return self.folder / "flight.tlog"

    @property
    def log(self) -> str:
        """What the programs have written to standard error so far."""
        return "".join(_end_of(path) for path in sorted(self.folder.glob("*.log")))

    def wait(self, timeout: float) -> dict[str, Any]:
        """Return the summary as ``sitl fly --json`` prints it, when the flight is over.

        Parameters
        ----------
        timeout : float
            In seconds.

        Raises
        ------
        FlightError
            When it is not over in time, or there is no summary.
        """
        try:
            code = self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            raise FlightError(f"flight in {self.folder}: not over within {timeout:g} s\n{self.log}") from None
        try:
            summary: dict[str, Any] = json.loads((self.folder / "summary.json").read_bytes())
        except (OSError, ValueError):
            raise FlightError(f"flight in {self.folder}: exit code {code}, no summary\n{self.log}") from None
        return summary

    def tell_to_end(self) -> None:
        """Ask the flight to end, and do not wait for it; nothing happens when it is over."""
        self._process.send_signal(signal.SIGTERM)

    def stop(self) -> None:
        """End the flight now; recording and summary are complete up to here. A second call does nothing."""
        self.tell_to_end()
        try:
            self._process.wait(STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()  # the programs end by themselves when their supervisor is gone
            self._process.wait()


class PairFactory:
    """Starts flights over UDP below one folder, each with ports of its own; see :meth:`__call__`."""

    def __init__(self, folder: Path) -> None:
        self.pairs: list[Pair] = []
        self._folder = folder
        self._ports: set[int] = set()

    def __call__(
        self,
        scenario: str = "nominal",
        *,
        duration: float | None = None,
        gcs: bool | tuple[str, int] = False,
        link: str | None = None,
        up: str | None = None,
        down: str | None = None,
        gains: str | None = None,
        plant: str | None = None,
        reference: str | None = None,
        wait_arm: bool = False,
        seed: int | None = None,
        options: Sequence[str] = (),
    ) -> Pair:
        """Start a flight and return at once; it ends with the test at the latest.

        Parameters
        ----------
        scenario : str
            Stored name, or a file.
        duration : float, optional
            In seconds from the first sample; the scenario's by default.
        gcs : bool or (str, int)
            Whether there is a ground station, at a free UDP port of this machine; or its address.
        link, up, down, gains, plant, reference, seed
            As the options of ``sitl fly``.
        wait_arm : bool
            Whether the vehicle waits to be armed by the ground station.
        options : sequence of str
            Further options of ``sitl fly``.
        """
        folder = self._folder / f"flight-{len(self.pairs)}"
        folder.mkdir()
        address = gcs if isinstance(gcs, tuple) else ("127.0.0.1", self._free_port()) if gcs else None
        arguments = _arguments(
            scenario,
            folder,
            {
                "duration": duration,
                "link": link,
                "up": up,
                "down": down,
                "gains": gains,
                "plant": plant,
                "reference": reference,
                "seed": seed,
            },
        )
        arguments += ["--port-base", "0", "--gcs", "none" if address is None else f"udpout:{_shown(address)}"]
        arguments += ["--wait-arm"] if wait_arm else []
        pair = Pair(folder, address, [*arguments, *options])
        self.pairs.append(pair)
        return pair

    def _free_port(self) -> int:
        """Return a UDP port that nobody has, and that was not returned before."""
        while True:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
                sock.bind(("127.0.0.1", 0))
                port = int(sock.getsockname()[1])
            if port not in self._ports:
                self._ports.add(port)
                return port


class Fly:
    """Flies scenarios in virtual time; see :meth:`__call__`."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._count = 0

    def __call__(
        self,
        scenario: str = "nominal",
        *,
        virtual: bool = True,
        duration: float | None = None,
        link: str | None = None,
        up: str | None = None,
        down: str | None = None,
        gains: str | None = None,
        plant: str | None = None,
        reference: str | None = None,
        seed: int | None = None,
        options: Sequence[str] = (),
        timeout: float = FLY_TIMEOUT_S,
    ) -> dict[str, Any]:
        """Fly to the end and return the summary; ``summary["passed"]`` is the verdict, ``summary["files"]`` the files.

        Parameters are those of :meth:`PairFactory.__call__`; without ``virtual`` the flight is over UDP, in real time.

        Raises
        ------
        FlightError
            When it came to nothing, or is not over within ``timeout`` seconds.
        """
        folder = self._folder / f"fly-{self._count}"
        self._count += 1
        folder.mkdir()
        given = {"duration": duration, "link": link, "up": up, "down": down, "gains": gains, "plant": plant}
        arguments = _arguments(scenario, folder, {**given, "reference": reference, "seed": seed})
        arguments += ["--gcs", "none", *(["--virtual"] if virtual else ["--port-base", "0"])]
        pair = Pair(folder, None, [*arguments, *options])
        try:
            return pair.wait(timeout)
        finally:
            pair.stop()


def _arguments(scenario: str, folder: Path, given: dict[str, object]) -> list[str]:
    """Return a scenario and the options that were given, as ``sitl fly`` takes them."""
    arguments = [scenario, "--out", str(folder)]
    for name, value in given.items():
        arguments += [] if value is None else [f"--{name}={value}"]
    return arguments


def _shown(address: tuple[str, int]) -> str:
    host, port = address
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def _end_of(path: Path) -> str:
    """Return the end of a log, under its name; nothing of an empty one."""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - MAX_LOG_BYTES))
        text = file.read().decode("utf-8", errors="replace")
    return f"[{path.name}]\n{text}" if text else ""


@pytest.fixture
def lagproof_pair(tmp_path: Path) -> Iterator[PairFactory]:
    """Start flights in the background; all are ended with the test."""
    factory = PairFactory(tmp_path)
    try:
        yield factory
    finally:
        for pair in factory.pairs:
            pair.tell_to_end()  # all at once: each draws and writes its files first
        for pair in factory.pairs:
            pair.stop()


@pytest.fixture
def lagproof_fly(tmp_path: Path) -> Fly:
    """Fly scenarios in virtual time, one after the other."""
    return Fly(tmp_path)
