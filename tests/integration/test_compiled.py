"""The compiled package (setup.py) flies what the interpreted one does: recordings are equal to the last byte."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.bench.compiled import build

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler"),
]

FLIGHTS = ("nominal", "lossy", "conservative", "blackout", "pendulum", "turbulence", "uncertain", "witness",
           "fault-kill-autopilot", "fault-freeze-plant", "fault-clock-plant", "fault-sensor-noisy")  # fmt: skip


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("compiled") / "package"
    build(folder)
    return folder


def recordings(folder: Path, name: str, path: str) -> dict[str, bytes]:
    """Fly a scenario in virtual time with the package that is found on a path first."""
    folder.mkdir()
    flown = subprocess.run(
        [sys.executable, "-m", "sitl", "fly", name, "--virtual", "--out", "out", "--json"],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        timeout=300,
        check=False,
    )
    assert flown.returncode in (0, 1), flown.stderr.decode()
    files = ("flight.mcap", "flight.tlog")
    return {"printed": flown.stdout, **{file: (folder / "out" / file).read_bytes() for file in files}}


def test_the_hot_path_is_compiled_and_everything_else_is_there(package: Path) -> None:
    said = subprocess.run(
        [sys.executable, "-c", "import autopilot.app, sitl.link.link, sitl.scenario;"
         "print(autopilot.app.__file__, sitl.link.link.__file__, sitl.scenario.__file__, sep='\\n')"],
        cwd=package.parent, env={**os.environ, "PYTHONPATH": str(package)}, capture_output=True, text=True, check=True,
    ).stdout.split()  # fmt: skip
    assert all(Path(file).is_relative_to(package) for file in said)
    assert [Path(file).suffix in (".so", ".pyd") for file in said] == [True, True, False]


@pytest.mark.parametrize("name", FLIGHTS)
def test_a_flight_makes_the_same_bytes(package: Path, tmp_path: Path, name: str) -> None:
    interpreted = recordings(tmp_path / "interpreted", name, "")
    compiled = recordings(tmp_path / "compiled", name, str(package))
    assert len(interpreted["flight.mcap"]) > 10_000
    for what in interpreted:
        assert compiled[what] == interpreted[what], what
