"""Faults in virtual time: every stored fault scenario holds what it promises, is told in the recording, and repeats."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest
from rich.console import Console

from sitl.faults import Fault, fault_changes, fault_of, format_fault, parse_fault
from sitl.flight import fly_virtual
from sitl.fly import FlightOptions, Outcome, fly
from sitl.scenario import Scenario, load_scenario, stored_scenarios

STORED = [name for name in stored_scenarios() if name.startswith("fault-")]
S = 1_000_000_000
NOMINAL = load_scenario("nominal")
PROMPT_S = {"fault-kill-relay": 0.3, "fault-kill-plant": 0.9, "fault-kill-autopilot": 0.4, "fault-corrupt-gains": 0.4}
"""What recovery takes where a program starts at once, as it does in virtual time; the scenarios leave it time to."""


def outcome_of(scenario: Scenario) -> Outcome:
    return fly(scenario, FlightOptions(virtual=True, folder=None), Console(quiet=True))


def seeded(name: str, seed: int) -> Scenario:
    scenario = load_scenario(name)
    variants = {variant: replace(changed, seed=seed) for variant, changed in scenario.variants.items()}
    return replace(scenario, seed=seed, variants=variants)


def hold_what_they_promise(name: str, outcome: Outcome) -> None:
    assert outcome.passed, [verdict for verdict in outcome.verdicts if not verdict.passed]
    if name in PROMPT_S:
        assert outcome.summary["recovery_s"] <= PROMPT_S[name]


def with_faults(*texts: str, duration_s: float = 5.0, **changed: Any) -> Scenario:
    return replace(NOMINAL, duration_s=duration_s, checks=(), **changed).with_faults(map(parse_fault, texts))


def records_of(scenario: Scenario) -> list[tuple[str, int, Any]]:
    records: list[tuple[str, int, Any]] = []
    fly_virtual(scenario, lambda record, at_ns: records.append((record.topic, at_ns, record.body)))
    return records


def test_there_is_a_scenario_for_every_kind_of_fault() -> None:
    faults = [fault for name in STORED for fault in load_scenario(name).faults]
    kinds = {(type(fault).__name__, str(getattr(fault, "kind", getattr(fault, "program", "")))) for fault in faults}
    programs = ("plant", "relay", "autopilot")
    assert kinds >= {(kind, program) for kind in ("Kill", "Freeze", "Mute") for program in programs}
    assert kinds >= {("SensorFault", kind) for kind in ("frozen", "bias", "noise", "nan")}
    assert kinds >= {("ElevatorFault", kind) for kind in ("stuck", "slow", "reversed")}
    assert kinds >= {("ClockStep", "plant"), ("ClockStep", "autopilot"), ("CorruptGains", ""), ("DiskFull", "")}
    assert "ClockDrift" in {kind for kind, _ in kinds}


@pytest.mark.parametrize("name", STORED)
def test_every_fault_scenario_passes_its_checks(name: str) -> None:
    hold_what_they_promise(name, outcome_of(load_scenario(name)))


@pytest.mark.long
@pytest.mark.parametrize("seed", range(1, 21))
@pytest.mark.parametrize("name", STORED)
def test_every_fault_scenario_passes_its_checks_whatever_the_seed(name: str, seed: int) -> None:
    hold_what_they_promise(name, outcome_of(seeded(name, seed)))


@pytest.mark.parametrize(
    ("name", "changed", "metric"),
    [
        ("fault-kill-relay", {"servo_timeout": None}, "max_error_rad"),
        ("fault-mute", {"servo_timeout": None}, "max_error_rad"),
        ("fault-sensor-nan", {"servo_timeout": None}, "max_error_rad"),
        ("fault-elevator-reversed", {"failsafe": "monitor"}, "longest_saturation_s"),
    ],
)
def test_the_checks_fail_without_the_protection_that_they_are_about(
    name: str, changed: dict[str, Any], metric: str
) -> None:
    scenario = replace(load_scenario(name), **changed, variants={})
    checks = tuple(check for check in scenario.checks if not check.metric.startswith("variants."))
    outcome = outcome_of(replace(scenario, checks=checks))
    assert metric in {verdict.check.metric for verdict in outcome.verdicts if not verdict.passed}


MANY = ("kill:plant@1s+0.3s", "freeze:relay@2s+0.3s", "kill:autopilot@2.5s+0.3s", "sensor:q_rad_s:noise:0.01@3s")


def test_a_flight_with_faults_is_the_same_every_time_and_tells_of_each_at_its_instant() -> None:
    once, again = (records_of(with_faults(*MANY, duration_s=4.0)) for _ in range(2))
    assert once == again
    zero_ns = next(at_ns for topic, at_ns, _ in once if topic == "plant/truth")
    told = [
        (at_ns - zero_ns, change) for topic, at_ns, body in once if topic == "events" and (change := fault_of(body))
    ]
    expected = [(c.at_ns, (c.fault, c.phase)) for c in fault_changes(map(parse_fault, MANY))]
    assert told == expected


def test_the_flight_ends_by_true_time_although_its_plant_has_started_again() -> None:
    records = records_of(with_faults("kill:plant@1s+1s", duration_s=4.0))
    samples = [(at_ns, body["k"]) for topic, at_ns, body in records if topic == "plant/truth"]
    zero_ns = samples[0][0]
    gaps = [then[0] - now[0] for now, then in pairwise(samples) if then[1] == 0]
    assert len(gaps) == 1
    assert S < gaps[0] < 2.1 * S  # the autopilot's heartbeat, once a second, starts it
    assert 3.95 * S < samples[-1][0] - zero_ns < 4.0 * S


def test_a_plant_that_is_not_started_again_stays_dead() -> None:
    records = records_of(with_faults("kill:plant@1s", duration_s=2.0))
    dead = [(topic, body) for topic, at_ns, body in records if topic == "plant/truth"]
    assert len(dead) == 41
    assert records[-1][1] > S


def test_frames_of_the_autopilot_are_stamped_with_its_clock_as_it_runs() -> None:
    records = records_of(with_faults("step:autopilot:0.5s@1s", "kill:autopilot@2s+0.3s", duration_s=3.0))
    events = {body["text"]: at_ns for topic, at_ns, body in records if topic == "events" and body["kind"] == "fault"}
    stepped_ns, died_ns, booted_ns = events.values()
    frames = [(at_ns, body) for topic, at_ns, body in records if topic.startswith("mavlink/")]
    offsets = {
        (at_ns >= stepped_ns, at_ns >= booted_ns, round((body["t_ns"] - at_ns) / S, 1)) for at_ns, body in frames
    }
    assert not [at_ns for at_ns, _ in frames if died_ns < at_ns < booted_ns]
    began_s = 1042.0
    lives = [(False, False, began_s), (True, False, began_s + 0.5), (True, True, round(began_s - booted_ns / S, 1))]
    assert sorted(offsets) == lives


def test_whoever_flies_is_told_of_each_fault_as_it_begins() -> None:
    seen: list[Fault] = []
    texts = ["disk-full@0.5s", "elevator:stuck@0.2s+0.1s", "freeze:plant@0.3s+0.1s"]
    fly_virtual(with_faults(*texts, duration_s=1.0), on_fault=seen.append)
    assert [format_fault(fault) for fault in seen] == [texts[1], texts[2], texts[0]]


def test_the_summary_of_a_flight_says_when_each_fault_began_ended_and_was_over() -> None:
    summary = outcome_of(with_faults("freeze:autopilot@2s+0.5s", duration_s=4.0)).summary
    [fault] = summary["faults"]
    assert (fault["fault"], fault["begin_s"], fault["end_s"]) == ("freeze:autopilot@2s+0.5s", 2.0, 2.5)
    assert 2.5 < fault["recovered_s"] < 3.0
    assert summary["recovery_s"] == pytest.approx(fault["recovered_s"] - 2.5)


@pytest.mark.parametrize("seed", range(1, 5))
def test_a_clock_that_steps_between_two_numbers_of_one_flight_is_no_restart_of_the_plant(seed: int) -> None:
    records = records_of(with_faults("step:plant:0.5s@1.3s", seed=seed))
    events = [body for topic, _, body in records if topic == "events"]
    assert any(body["kind"] == "clock" for body in events), "the step was seen"
    assert not [body["text"] for body in events if body["kind"] == "epoch"]
