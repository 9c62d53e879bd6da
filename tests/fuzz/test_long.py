"""Every target by the engine that there is, each in a process of its own, two at a time.

``LAGPROOF_FUZZ_SECONDS`` says how long all of it takes together; half an hour by default. Whatever is found lies in the
corpus afterwards.
"""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.fuzz.targets import CORPUS, TARGETS

ROOT = Path(__file__).parents[2]
TOTAL_S = float(os.environ.get("LAGPROOF_FUZZ_SECONDS", "1800"))
AT_ONCE = 2
SPARE_S = 120.0


def fuzz(name: str, seconds: float) -> str:
    """Fuzz one target; return what to tell, empty when nothing was found."""
    before = set((CORPUS / name).iterdir())
    run = subprocess.run(
        [sys.executable, "-m", "tests.fuzz", name, "--seconds", f"{seconds:.0f}"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        errors="replace",
        timeout=seconds + SPARE_S,
        check=False,
    )
    found = sorted(set((CORPUS / name).iterdir()) - before)
    if run.returncode == 0 and not found:
        return ""
    again = "\n".join(f"python -m tests.fuzz {name} {path.relative_to(ROOT)}" for path in found)
    return f"{name}: exit code {run.returncode}; to see it again:\n{again}\n{(run.stdout + run.stderr)[-3000:]}"


@pytest.mark.long
def test_nothing_is_found_in_the_time_there_is() -> None:
    seconds = max(1.0, TOTAL_S * AT_ONCE / len(TARGETS))
    with ThreadPoolExecutor(AT_ONCE) as pool:
        told = list(pool.map(lambda name: fuzz(name, seconds), TARGETS))
    assert not any(told), "\n\n".join(filter(None, told))
