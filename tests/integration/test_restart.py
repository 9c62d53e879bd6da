"""A node that dies in flight and comes back, and the law that takes over again."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import pytest

from autopilot.link.clock import Clock
from autopilot.link.node import Record
from sitl.faults import parse_fault
from sitl.flight import fly_virtual, virtual_network
from sitl.scenario import load_scenario

S = 1_000_000_000
NOMINAL = replace(load_scenario("nominal"), duration_s=30.0)


def events_of(records: list[tuple[Record, int]], kind: str, since_ns: int) -> list[tuple[float, str]]:
    return [
        ((at - since_ns) / 1e9, r.body["text"])
        for r, at in records
        if r.topic == "events" and r.body["kind"] == kind and at >= since_ns
    ]


@pytest.mark.parametrize("offset_s", [137, 0, 500], ids=["its own clock again", "back to zero", "a clock ahead"])
def test_a_restarted_plant_is_a_new_epoch_and_is_flown_within_three_seconds(offset_s: int) -> None:
    records: list[tuple[Record, int]] = []
    network, plant = virtual_network(NOMINAL, lambda r, at: records.append((r, at)))
    network.run(lambda: plant.samples >= 200, 60 * S)
    died_ns = network.now_ns
    reborn = NOMINAL.plant_node()
    network.replace("plant", reborn, Clock(offset_s * S, 40_000, died_ns))
    network.run(lambda: reborn.samples >= 200, 60 * S)
    why = "sample numbers fell back" if offset_s == 500 else "plant restarted"
    assert [text for _, text in events_of(records, "epoch", died_ns)] == [f"{why}, epoch 1"]
    tracking = [at for at, text in events_of(records, "failsafe", died_ns) if "to TRACKING" in text]
    assert tracking[0] < 3.0
    last = [r.body for r, _ in records if r.topic == "autopilot/command"][-1]
    assert (last["mode"], last["epoch"]) == ("TRACKING", 1)
    assert reborn.samples - 5 <= last["j"] < reborn.samples


def test_a_plant_that_restarts_while_its_clock_goes_on_is_a_new_epoch_within_two_numbers() -> None:
    records: list[tuple[Record, int]] = []
    network, plant = virtual_network(NOMINAL, lambda r, at: records.append((r, at)))
    network.run(lambda: plant.samples >= 200, 60 * S)
    died_ns, clock = network.now_ns, NOMINAL.clocks["plant"]
    reborn = NOMINAL.plant_node()
    network.replace("plant", reborn, clock)
    network.run(lambda: reborn.samples >= 200, 60 * S)
    assert events_of(records, "clock", died_ns) == []
    [(at_s, text)] = events_of(records, "epoch", died_ns)
    assert text == "sample numbers fell back, epoch 1"
    assert at_s < 2.5
    last = [r.body for r, _ in records if r.topic == "autopilot/command"][-1]
    assert (last["mode"], last["epoch"]) == ("TRACKING", 1)
    assert reborn.samples - 5 <= last["j"] < reborn.samples


def test_a_restarted_autopilot_is_not_blamed_for_the_delays_of_the_one_before() -> None:
    records: list[tuple[Record, int]] = []
    network, plant = virtual_network(NOMINAL, lambda r, at: records.append((r, at)))
    network.run(lambda: plant.samples >= 200, 60 * S)
    network.replace("autopilot", NOMINAL.autopilot_node(1), Clock(7 * S, 0, network.now_ns + 3 * S))
    died_ns = network.now_ns
    network.run(lambda: plant.samples >= 600, 60 * S)
    texts = [text for _, text in events_of(records, "failsafe", died_ns)]
    assert len(texts) == 1
    assert texts[0].startswith("STANDBY to TRACKING")


@pytest.mark.parametrize("variant", [None, "no-servo-timeout"])
def test_the_law_takes_over_without_a_jump_of_the_elevator(variant: str | None) -> None:
    scenario = load_scenario("blackout")
    scenario = replace(scenario if variant is None else scenario.variants[variant], actuator="float")
    commands: list[dict] = []
    fly_virtual(scenario, lambda r, _: commands.append(dict(r.body)) if r.topic == "autopilot/command" else None)
    for before, after in pairwise(commands):
        if before["mode"] in ("HOLD", "NEUTRAL") and after["mode"] == "TRACKING":
            assert abs(after["u"][0] - before["u"][0]) < 1e-6
            break
    else:
        pytest.fail("no re-entry")


def test_the_law_of_a_restarted_autopilot_takes_over_without_a_jump_of_the_elevator() -> None:
    """The aircraft has climbed to the reference by then; the new autopilot's own reference model begins at rest."""
    scenario = load_scenario("nominal").with_faults([parse_fault("kill:autopilot@5s+0.5s")])
    commands: list[dict] = []
    fly_virtual(scenario, lambda r, _: commands.append(dict(r.body)) if r.topic == "autopilot/command" else None)
    [first] = [i for i, (before, after) in enumerate(pairwise(commands), 1) if after["j"] - before["j"] > 10]
    assert all(command["u"] == [0.0] for command in commands[first:] if command["mode"] == "STANDBY")
    flown = [command for command in commands[first:] if command["mode"] == "TRACKING"]
    assert flown[0]["r"] == [pytest.approx(math.radians(5.0))]
    assert abs(flown[0]["u"][0]) < 1e-3, "the plant's time-out has put the elevator to neutral"
    assert max(abs(command["u"][0]) for command in flown) < math.radians(2.0)
