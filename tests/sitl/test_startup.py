"""A program that starts again in flight has no time for libraries that it does not use."""

from __future__ import annotations

import subprocess
import sys

import pytest

SLOW = ("cvxpy", "clarabel", "matplotlib", "scipy.linalg", "scipy.sparse", "scipy.special")


@pytest.mark.parametrize(
    "flown",
    [
        "import sitl.commands.plant",
        "import sitl.commands.relay; from sitl.link.relay import RelayNode; from sitl.link.spec import parse_spec\n"
        "spec = parse_spec('delay=25ms,jitter=uniform:28ms,loss=ge:0.1:0.5'); RelayNode(spec, spec, 1)",
    ],
    ids=["plant", "relay"],
)
def test_plant_and_relay_load_no_library_before_they_need_it(flown: str) -> None:
    code = f"import sys\n{flown}\nprint(*sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    modules = set(run.stdout.split())
    assert "numpy" in modules
    assert not modules.intersection(SLOW)
