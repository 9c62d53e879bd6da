"""Ground stations that other people wrote, and the vehicle that they talk to: plant and autopilot on a direct line.

The vehicle waits to be armed, so a ground tool sees it before, during and after. Its gains are certified for six
samples of delay if nothing else is said, which a busy machine seldom exceeds, and the programmed profile is a step that
a station cannot miss.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from autopilot.link.record import read_mcap
from tests.integration.programs import Program, eventually, free_port, program

BIN = Path(sys.executable).parent
MAVPROXY = BIN / "mavproxy.py"
STEP_RAD = 0.0873
"""The profile of the vehicle's AUTO mode: 5 degrees, one second after it begins."""
PREARM_CHECK = 1 << 28
"""MAV_SYS_STATUS_PREARM_CHECK: the vehicle would let itself be armed."""


@dataclass(frozen=True)
class MavProxy:
    """MAVProxy without a head: commands on standard input, a transcript on standard output."""

    process: subprocess.Popen[bytes]
    out: Path

    @property
    def transcript(self) -> str:
        return self.out.read_text(errors="replace")

    def lines(self, start: int = 0) -> str:
        """Return the transcript from a character on, without the prompts that stand before its lines."""
        return re.sub(r"\b[A-Z]+> |\r", "", self.transcript[start:])

    def say(self, *lines: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write("".join(f"{line}\n" for line in lines).encode())
        self.process.stdin.flush()

    def ask(self, line: str, answer: str, timeout_s: float = 20.0) -> re.Match[str]:
        """Say a line, and return the first match of a pattern in the lines that the transcript gains from then on."""
        start = len(self.transcript)
        self.say(line)
        return eventually(
            f"{answer} after {line}", lambda: re.search(answer, self.lines(start), re.MULTILINE), timeout_s
        )


@contextmanager
def mavproxy(folder: Path, port: int, modules: str | None = "") -> Iterator[MavProxy]:
    """Run MAVProxy, listening on a port; it is told to exit, and killed.

    ``modules`` are what it loads, separated by commas; None for those that it loads by itself.
    """
    out = folder / "mavproxy.txt"
    command = [sys.executable, str(MAVPROXY), "--master", f"udpin:127.0.0.1:{port}", "--no-state", "--nowait"]
    environment = {**os.environ, "HOME": str(folder)}
    with (
        out.open("wb") as stdout,
        subprocess.Popen(
            command if modules is None else [*command, "--default-modules", modules],
            stdin=subprocess.PIPE,
            stdout=stdout,
            stderr=subprocess.STDOUT,
            cwd=folder,
            env=environment,
        ) as process,
    ):
        station = MavProxy(process, out)
        try:
            yield station
            station.say("set requireexit True", "exit")
        finally:
            process.kill()


@dataclass(frozen=True)
class Vehicle:
    """A plant and an autopilot that have been started by hand; once landed, there is a record of the flight."""

    folder: Path
    plant: Program
    autopilot: Program

    def land(self) -> None:
        """End both programs as Ctrl-C does; both must end well."""
        codes = [each.end(signal.SIGINT) for each in (self.autopilot, self.plant)]
        assert codes == [0, 0], self.autopilot.stderr + self.plant.stderr

    @property
    def flown(self) -> list[tuple[float, float, float]]:
        """Angle of attack, pitch rate and pitch of every sample as the plant knows them, rad, rad/s."""
        return [tuple(body["x"]) for topic, _, body in read_mcap(self.folder / "plant.mcap") if topic == "plant/truth"]


def near(seen: float, flown: Iterable[float]) -> bool:
    """Whether some sample had a value, to what 32-bit floats and degrees leave of it."""
    return min(abs(seen - value) for value in flown) < 1e-6


@contextmanager
def vehicle(folder: Path, station: int, gains: str = "hirm-d6", passphrase: str | None = None) -> Iterator[Vehicle]:
    """Start a vehicle that waits to be armed, its telemetry to a port of the loopback; killed if it is not landed.

    With a passphrase both its links are signed. What its programs have said is shown when the station fails.
    """
    port = free_port()
    plant_key: list[str] = []
    keys: list[str] = []
    if passphrase is not None:
        file = folder / "link.key"
        file.touch(mode=0o600)
        file.write_text(passphrase + "\n")
        plant_key, keys = ["--key", str(file)], ["--key", f"plant={file}", "--key", f"gcs={file}"]
    line = ["--plant", f"udpout:127.0.0.1:{port}", "--gcs", f"udpout:127.0.0.1:{station}"]
    flight = ["--gains", gains, "--reference", "5deg@1s", "--wait-arm"]
    with (
        program(
            folder, "sitl", "plant", "--listen", f"127.0.0.1:{port}", "--record", "plant.mcap", *plant_key
        ) as plant,
        program(folder, "autopilot", *line, *flight, *keys) as autopilot,
    ):
        try:
            yield Vehicle(folder, plant, autopilot)
        except BaseException:
            sys.stderr.write(plant.stderr + autopilot.stderr)
            raise
