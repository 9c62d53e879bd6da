"""What a user who wants speed installs: the hot path compiled (setup.py), measured as the package without it is.

Its virtual flight as in :mod:`tests.bench.flight`, its turnaround as in :mod:`tests.bench.turnaround`. The compiled
package is built into a folder of its own and measured by a process that finds it first.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[2]
LIMITS = {"flight": (2.0, 4.0), "turnaround": (math.inf, 3.0)}
"""Of the rows of each: recording off and on; an autopilot that sleeps (told only), and one that does not."""


def measure() -> list[tuple[str, float, float, str]]:
    """Return what both measure of the compiled package; nothing where there is no C compiler."""
    if shutil.which("cc") is None:
        print("compiled: no C compiler", file=sys.stderr)
        return []
    with tempfile.TemporaryDirectory() as folder:
        build(Path(folder) / "package")
        (Path(folder) / "tests").symlink_to(ROOT / "tests")
        measured = subprocess.run(
            [sys.executable, "-m", "tests.bench", *LIMITS],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(Path(folder) / "package")},
            stdout=subprocess.PIPE,
            text=True,
            check=False,
        )
        rows = json.loads(measured.stdout.splitlines()[-1])
    limits = [limit for each in LIMITS.values() for limit in each]
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
