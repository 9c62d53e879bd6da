"""A schedule of two sets in flight over the jittery link, in virtual time and as the programs fly it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from autopilot.control import SETTLE_SAMPLES
from gains.model import Schedule
from gains.store import load_gains, save_gains
from sitl.flight import fly_virtual
from sitl.fly import FlightOptions, fly
from sitl.link.presets import parse_link
from sitl.recorder import FlightRecorder
from sitl.scenario import Scenario, load_scenario
from tests.integration.programs import program

pytestmark = pytest.mark.realtime

HIRM = load_gains("hirm-paper")
assert HIRM.K2 is not None
SETS = (
    replace(HIRM, name="two[0]", d_min=1, d_max=2, K1=1.02 * HIRM.K1, K2=1.02 * HIRM.K2),
    replace(HIRM, name="two[1]", d_min=2, d_max=4, K1=0.98 * HIRM.K1, K2=0.98 * HIRM.K2),
)
"""The published gains, a little stiffer for short delays and softer for long ones."""


@pytest.fixture(scope="module")
def schedule(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("schedule") / "two.toml"
    save_gains(path, Schedule("two", HIRM.model, SETS), "hirm")
    return path


def jittery(schedule: Path, seed: int) -> Scenario:
    up, down = parse_link("jittery", None, None)
    scenario = load_scenario("nominal", gains=str(schedule))
    return replace(scenario, up=up, down=down, seed=seed, actuator="float", checks=())


def flown(scenario: Scenario) -> FlightRecorder:
    recorder = FlightRecorder(None, {})
    fly_virtual(scenario, recorder.write)
    return recorder


def bodies(recorder: FlightRecorder, topic: str) -> list[Mapping[str, Any]]:
    return [body for name, _, body in recorder.kept if name == topic]


@pytest.mark.parametrize("seed", [2, 3, 4])
def test_every_command_is_the_law_of_its_recorded_set_whose_window_contains_the_forecast(
    schedule: Path, seed: int
) -> None:
    recorder = flown(jittery(schedule, seed))
    commands = [c for c in bodies(recorder, "autopilot/command") if c["mode"] == "TRACKING"]
    assert len(commands) > 380
    limit = HIRM.model.actuator.high[0]
    for c in commands:
        gains = SETS[c["gain_set"]]
        assert gains.d_min <= c["d"] <= gains.d_max
        u = float((gains.K1 @ c["x"] + gains.K2 @ c["xr"])[0])
        assert abs(c["u"][0] - np.clip(u, -limit, limit)) < 1e-9
    assert {c["gain_set"] for c in commands} == {0, 1}
    commanded = {c["j"]: c["u"][0] for c in commands}
    truth = [body for body in bodies(recorder, "plant/truth") if body["j"] is not None]
    assert max(abs(body["u"][0] - commanded[body["j"]]) for body in truth) < 1e-7  # float32 on the wire


@pytest.mark.parametrize("seed", [2, 3, 4])
def test_the_set_changes_when_the_interval_leaves_its_window_or_a_narrower_one_has_held_it_for_long(
    schedule: Path, seed: int
) -> None:
    commands = bodies(flown(jittery(schedule, seed)), "autopilot/command")
    changes = 0
    for n, (before, after) in enumerate(pairwise(commands), start=1):
        if after["gain_set"] == before["gain_set"]:
            continue
        changes += 1
        old, new = SETS[before["gain_set"]], SETS[after["gain_set"]]
        if old.d_min <= after["d_low"] and after["d_high"] <= old.d_max:
            lately = commands[n - SETTLE_SAMPLES + 1 : n + 1]
            assert new.d_max - new.d_min < old.d_max - old.d_min
            assert all(new.d_min <= c["d_low"] and c["d_high"] <= new.d_max for c in lately)
        else:
            assert new.d_min <= after["d"] <= new.d_max
    assert changes > 5


def test_a_schedule_flies_to_equal_bytes_for_a_seed_and_is_named_in_the_summary(schedule: Path, tmp_path: Path) -> None:
    recorded = {}
    for run, seed in (("once", 3), ("again", 3), ("other", 4)):
        options = FlightOptions(virtual=True, folder=tmp_path / run)
        outcome = fly(jittery(schedule, seed), options, Console(quiet=True))
        assert outcome.passed
        assert outcome.summary["gains"] == "two"
        assert outcome.summary["certificate"] == "none verified"
        recorded[run] = [(tmp_path / run / file).read_bytes() for file in ("flight.mcap", "flight.tlog")]
    assert recorded["once"] == recorded["again"]
    assert recorded["once"][0] != recorded["other"][0]


def test_the_programs_fly_a_schedule_and_the_autopilot_says_its_windows(schedule: Path, tmp_path: Path) -> None:
    arguments = ("--gains", str(schedule), "--duration", "2", "--port-base", "0", "--gcs", "none", "--json")
    with program(tmp_path, "sitl", "fly", "nominal", *arguments, "--out", "out") as flight:
        assert flight.wait() in (0, 1)  # two seconds are too short for some of the scenario's checks
    summary = json.loads((tmp_path / "0-sitl.stdout").read_text())
    assert (summary["gains"], summary["diverged"], summary["mode_at_end"]) == ("two", False, "TRACKING")
    [log] = (tmp_path / "out").glob("*autopilot*.log")
    assert "gains two (no verified certificate), delay 1..2, 2..4, plant" in log.read_text()
