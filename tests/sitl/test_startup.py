"""A program that starts again in flight has no time for libraries that it does not use."""

from __future__ import annotations

import subprocess
import sys

SLOW = ("cvxpy", "clarabel", "matplotlib", "rich", "scipy")

STARTED = {
    "plant": (
        "import sitl.__main__, sitl.commands.plant as it\n"
        "from gains.store import load_model\n"
        "it.PlantNode(it.PlantConfig(load_model('pendulum')))"
    ),
    "relay": (
        "import sitl.__main__, sitl.commands.relay as it\n"
        "from sitl.link.spec import parse_spec\n"
        "spec = parse_spec('delay=25ms,jitter=uniform:28ms,loss=ge:0.1:0.5')\n"
        "it.RelayNode(spec, spec, 1)"
    ),
    "autopilot": (
        "import autopilot.__main__ as it\n"
        "from gains.store import load_law\n"
        "it.AutopilotNode(it.AutopilotConfig(load_law('pendulum-paper')))"
    ),
}
"""How each program comes to its node, with a discrete model: holding a continuous one takes SciPy."""


def test_no_program_starts_with_a_library_that_takes_long() -> None:
    code = "\nimport sys\nprint(*sys.modules)"
    runs = {
        name: subprocess.Popen([sys.executable, "-c", text + code], stdout=subprocess.PIPE, text=True)
        for name, text in STARTED.items()
    }
    loaded = {name: run.communicate()[0].split() for name, run in runs.items()}
    assert [name for name, run in runs.items() if run.returncode != 0] == []
    for name, modules in loaded.items():
        assert "numpy" in modules, name
        assert [module for module in modules if module.partition(".")[0] in SLOW] == [], name
