"""Virtual time: equal seeds make equal bytes, whatever else differs; every stored scenario passes its checks."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from sitl.fly import FlightOptions, fly
from sitl.scenario import load_scenario, stored_scenarios
from tests.integration.programs import program

RUNS = {"once": ("7", "1"), "again": ("7", "2"), "another seed": ("8", "1")}
"""Seed, and the seed of Python's own hashes."""


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, bytes]]:
    folders = {name: tmp_path_factory.mktemp(name.replace(" ", "-")) for name in RUNS}
    with ExitStack() as stack:
        runs = [
            stack.enter_context(
                program(
                    folders[name],
                    *("sitl", "fly", "nominal", "--virtual", "--seed", seed, "--out", "out", "--json"),
                    PYTHONHASHSEED=hash_seed,
                )
            )
            for name, (seed, hash_seed) in RUNS.items()
        ]
        assert [run.wait() for run in runs] == [0, 0, 0]
    return {name: contents(folder) for name, folder in folders.items()}


def contents(folder: Path) -> dict[str, bytes]:
    printed = (folder / "0-sitl.stdout").read_bytes()
    return {
        "printed": printed,
        **{file: (folder / "out" / file).read_bytes() for file in ("flight.mcap", "flight.tlog")},
    }


@pytest.mark.parametrize("file", ["flight.mcap", "flight.tlog", "printed"])
def test_equal_seeds_make_equal_bytes_and_other_seeds_others(
    recordings: dict[str, dict[str, bytes]], file: str
) -> None:
    once, again, another = (recordings[name][file] for name in RUNS)
    assert len(once) > 1000
    assert once == again
    assert once != another


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("name", [name for name in stored_scenarios() if not name.startswith("fault-")])
def test_every_stored_scenario_passes_its_checks_in_virtual_time(name: str, seed: int) -> None:
    scenario = load_scenario(name)
    variants = {variant: replace(changed, seed=seed) for variant, changed in scenario.variants.items()}
    scenario = replace(scenario, seed=seed, variants=variants)
    outcome = fly(scenario, FlightOptions(virtual=True, folder=None), Console(quiet=True))
    assert len(outcome.verdicts) == len(scenario.checks) + 1
    assert outcome.passed, [verdict for verdict in outcome.verdicts if not verdict.passed]
