"""Counters that wrap in flight: u32 microseconds after 71.6 minutes, u32 milliseconds after 49.7 days, either clock.

A flight across a wrap is compared with the same flight far from any: same seed, same drift, and clocks that
differ by whole sampling periods, so that their grids agree, and the autopilot's by whole buckets of exchanges
too. Nothing may differ but the stamps themselves.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import pytest

from autopilot.app import AutopilotNode
from autopilot.config import AutopilotConfig
from autopilot.envelope import BUCKET_NS
from autopilot.link.clock import Clock
from autopilot.link.node import Record
from autopilot.link.wire import PLANT, Attitude, NamedValueInt, Timesync, Wire
from gains.store import load_gains
from sitl.flight import fly_virtual
from sitl.link.spec import parse_spec
from sitl.plant import PlantConfig
from sitl.scenario import Scenario, load_scenario
from tests.helpers import MS, Flight, S, parse

US_WRAP, MS_WRAP = (1 << 32) * 1000, (1 << 32) * MS
WRAPS = {"71.6 minutes": US_WRAP, "49.7 days": MS_WRAP, "99.4 days": 2 * MS_WRAP}
LINK = "delay=2ms,jitter=uniform:36ms,dup=0.02"
"""What is sent together arrives up to 36 ms apart, in any order, and later samples before earlier ones."""
BEFORE_NS = {"in flight": 6 * S, "while the clocks synchronise": 150 * MS, "just before the start": 0}
"""How long before the wrap the clock boots; sample 0 comes about 0.3 s later."""
FLIGHTS = [("nominal", "pwm"), ("nominal", "float"), ("pendulum", "pwm"), ("witness", "pwm"), ("witness", "float")]
CASES = [
    *((name, actuator, ("plant",)) for name, actuator in FLIGHTS),
    *(("nominal", "pwm", nodes) for nodes in (("autopilot",), ("relay",), ("plant", "autopilot", "relay"))),
]


@dataclass
class Flown:
    """All that a flight has come to, but for its stamps, and the plant's stamps."""

    truth: list = field(default_factory=list)
    commands: list = field(default_factory=list)
    events: list = field(default_factory=list)
    counters: list = field(default_factory=list)
    stamps_ns: list = field(default_factory=list)

    def write(self, record: Record, _true_ns: int) -> None:
        body = dict(record.body)
        if record.topic == "plant/truth":
            self.stamps_ns.append(body.pop("t_ns"))
            self.truth.append(body)
        elif record.topic == "autopilot/command":
            del body["sample_ns"]
            self.commands.append(body)
        elif record.topic == "events":
            (self.counters if body["kind"] == "counters" else self.events).append(without_bytes(body))

    def count(self, node: str, what: str) -> Mapping[str, int]:
        return [c["data"][what] for c in self.counters if c["node"] == node][-1]


def without_bytes(body: Any) -> Any:
    """Return an event without numbers of bytes: MAVLink sends no zeros at a payload's end, so they depend on stamps."""
    if isinstance(body, Mapping):
        return {key: without_bytes(value) for key, value in body.items() if key != "bytes"}
    return body


def flight(name: str, actuator: str) -> Scenario:
    """Return a stored scenario, 12 s of it; over the link above unless its link replays a witness."""
    stored = replace(load_scenario(name), duration_s=12.0, actuator=actuator, seed=5)
    return stored if stored.witness is not None else replace(stored, up=parse_spec(LINK), down=parse_spec(LINK))


def fly(scenario: Scenario) -> Flown:
    flown = Flown()
    fly_virtual(scenario, flown.write)
    return flown


@cache
def flown_far_from_any_wrap(name: str, actuator: str) -> Flown:
    return fly(flight(name, actuator))


def booted(scenario: Scenario, nodes: tuple[str, ...], boot_ns: int) -> Scenario:
    """Return the scenario with clocks that boot at ``boot_ns``, or before as little as keeps their grids."""
    clocks = dict(scenario.clocks)
    for name in nodes:
        grid_ns = scenario.plant.Ts_ns if name == "plant" else math.lcm(scenario.plant.Ts_ns, BUCKET_NS)
        offset_ns = clocks[name].offset_ns
        clocks[name] = replace(clocks[name], offset_ns=offset_ns + (boot_ns - offset_ns) // grid_ns * grid_ns)
    return replace(scenario, clocks=clocks)


@pytest.mark.parametrize("before", BEFORE_NS)
@pytest.mark.parametrize("wrap", WRAPS)
@pytest.mark.parametrize(
    ("name", "actuator", "nodes"), CASES, ids=lambda part: part if isinstance(part, str) else "+".join(part)
)
def test_a_flight_across_a_wrap_is_the_flight_far_from_it(
    name: str, actuator: str, nodes: tuple[str, ...], wrap: str, before: str
) -> None:
    scenario = booted(flight(name, actuator), nodes, WRAPS[wrap] - BEFORE_NS[before])
    flown, far = fly(scenario), flown_far_from_any_wrap(name, actuator)
    for stream in ("truth", "commands", "events", "counters"):
        assert getattr(flown, stream) == getattr(far, stream)
    if "plant" in nodes:
        assert (flown.stamps_ns[0] < WRAPS[wrap]) is (before == "in flight")
        assert flown.stamps_ns[-1] > WRAPS[wrap]


@pytest.mark.parametrize(("name", "actuator"), FLIGHTS)
def test_that_flight_loses_nothing_to_stamps(name: str, actuator: str) -> None:
    far = flown_far_from_any_wrap(name, actuator)
    assert far.stamps_ns[-1] < US_WRAP // 2
    assert far.count("plant", "refusals") == {}
    assert set(far.count("autopilot", "drops")) <= {"late", "duplicate", "half"}
    failsafe = [event["text"].split(":")[0] for event in far.events if event["kind"] == "failsafe"]
    assert failsafe[:1] == ["STANDBY to TRACKING"]
    assert len(failsafe) == 1 or name == "witness"  # which leaves the window again and again, as it should
    assert len(far.commands) > 0.9 * len(far.truth)


# an autopilot that meets a plant before their clocks are synchronised


@pytest.mark.parametrize("up_for_ns", [0, US_WRAP, MS_WRAP - 10 * S, MS_WRAP - 5 * S, MS_WRAP, 3 * MS_WRAP + 9 * S])
@pytest.mark.parametrize("actuator", ["pwm", "float"])
@pytest.mark.parametrize("gains_name", ["hirm-paper", "pendulum-paper"])
def test_an_autopilot_that_restarts_beside_a_flying_plant_counts_as_the_plant_does(
    gains_name: str, actuator: str, up_for_ns: int
) -> None:
    gains = load_gains(gains_name)
    config = AutopilotConfig(gains, actuator=actuator)
    flown = Flight(config, PlantConfig(gains.model), plant_clock=Clock(up_for_ns, 40_000)).fly(5 * S)
    flown.autopilot = AutopilotNode(config)
    flown.network.replace("autopilot", flown.autopilot, Clock(77 * S, 0, flown.network.now_ns))
    flown.fly(9 * S)
    assert flown.transitions(5 * S) == [("STANDBY", "TRACKING")]
    assert flown.autopilot.samples.drops == {}
    # nothing but TIMESYNC tells how often ATTITUDE's stamps have wrapped, and the u64 of a command must say it
    untold = actuator == "float" and gains_name == "pendulum-paper" and up_for_ns > MS_WRAP - 6 * S
    assert set(flown.plant.refusals) <= ({"stamp"} if untold else set())
    stamps_us = {body["k"]: body["t_ns"] // 1000 for body in flown.bodies("plant/truth")}
    commands = flown.bodies("autopilot/command", 6 * S)
    assert len(commands) > 80
    assert [c["sample_ns"] // 1000 for c in commands] == [stamps_us[c["j"]] for c in commands]
    assert {body["d"] for body in flown.bodies("plant/truth", 6 * S)} == {1}


@pytest.mark.parametrize("up_for_ns", [US_WRAP - 600 * S, US_WRAP + 600 * S, MS_WRAP // 2, MS_WRAP - 600 * S, MS_WRAP])
@pytest.mark.parametrize("gains_name", ["hirm-paper", "pendulum-paper"])
def test_a_plant_that_restarts_is_a_new_epoch_however_long_it_had_been_up(gains_name: str, up_for_ns: int) -> None:
    gains = load_gains(gains_name)
    config = AutopilotConfig(gains)
    flown = Flight(config, PlantConfig(gains.model), plant_clock=Clock(up_for_ns, 40_000)).fly(5 * S)
    flown.restart_plant(Clock(0, 40_000, flown.network.now_ns))
    flown.fly(10 * S)
    assert len(flown.events("epoch")) == 1
    assert flown.transitions()[-1] == ("STANDBY", "TRACKING")
    stamps_ms = {body["k"]: body["t_ns"] // MS for body in flown.bodies("plant/truth", 5 * S)}
    commands = [c for c in flown.bodies("autopilot/command", 5 * S) if c["epoch"] == 1]
    assert len(commands) > 50
    assert [c["sample_ns"] // MS for c in commands] == [stamps_ms[c["j"]] for c in commands]


# stamps that no clock could have shown


def test_a_stamp_just_before_the_plants_boot_is_refused_and_not_sent_back() -> None:
    gains = load_gains("pendulum-paper")
    node = AutopilotNode(AutopilotConfig(gains, actuator="float"))
    wire, now_ns, plant_ns = Wire(PLANT, None), 0, 500 * MS
    for _ in range(10):
        node.tick(now_ns)
        requests = [m for _, d in node.outgoing() for m in parse(d) if m.get_type() == "TIMESYNC"]
        for m in requests:
            node.receive("plant", wire.encode(Timesync(plant_ns + now_ns, m.ts1)), now_ns)
        now_ns += 60 * MS
    node.receive("plant", wire.encode(NamedValueInt((1 << 32) - 60, "SAMPLE_K", 0)), now_ns)
    node.receive("plant", wire.encode(Attitude((1 << 32) - 60, *(6 * [0.0]))), now_ns)
    assert node.samples.drops == {"from_the_future": 1}
    assert node.samples.newest_ns is None
