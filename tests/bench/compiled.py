"""A virtual flight with the hot path compiled (setup.py), against pymavlink alone, as :mod:`tests.bench.flight` has it.

The compiled package is built into a folder of its own and measured by a process that finds it first.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[2]
LIMIT_OFF = 2.0
LIMIT_ON = 4.0


def measure() -> list[tuple[str, float, float, str]]:
    """Return what flight.measure does of the compiled package; nothing where there is no C compiler."""
    if shutil.which("cc") is None:
        print("compiled: no C compiler", file=sys.stderr)
        return []
    with tempfile.TemporaryDirectory() as folder:
        build(Path(folder) / "package")
        (Path(folder) / "tests").symlink_to(ROOT / "tests")
        measured = subprocess.run(
            [sys.executable, "-m", "tests.bench", "flight"],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(Path(folder) / "package")},
            stdout=subprocess.PIPE,
            text=True,
            check=False,
        )
        rows = json.loads(measured.stdout.splitlines()[-1])
    limits = LIMIT_OFF, LIMIT_ON
    return [
        (f"compiled: {row['what']}", row["ratio"], limit, row["note"]) for row, limit in zip(rows, limits, strict=True)
    ]


def build(target: Path) -> None:
    """Install the compiled package into a folder."""
    subprocess.run(
        [
            sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps",
            "--no-build-isolation", "--target", str(target), str(ROOT),
        ],
        env={**os.environ, "LAGPROOF_COMPILE": "1"},
        check=True,
    )  # fmt: skip
