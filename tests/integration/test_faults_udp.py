"""Faults over UDP: programs killed, frozen, muted, with stepped clocks and damaged files, and the flight that goes on.

What may be lost: a killed program loses what it had not yet sent to the recorder, at most its last second; nobody else
loses anything. Recovery is :mod:`sitl.recovery`'s: the law has the elevator again, and keeps it. A program that starts
again has to import its modules first, which takes as long as the machine has other things to do; so from its restart to
recovery is asserted where it listened again within a second, and always in the long tests, which want a quiet machine.
"""

from __future__ import annotations

import io
import json
import re
import signal
import statistics
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from rich.console import Console

from sitl.faults import PROGRAMS, parse_fault
from sitl.flightdata import FlightData
from sitl.fly import FlightOptions, fly
from sitl.plot import flight_figure
from sitl.scenario import load_scenario, stored_scenarios
from tests.integration.programs import alive, children_of, eventually, program

pytestmark = pytest.mark.realtime

RESUMED_S = 2.0
LOST_S = 1.0
PROMPT_START_S = 1.0
LATE_NS = 25_000_000
"""Polling ten times a second would make half of the faults later than this, twice over."""
COMPLAINTS = "Traceback|Warning|Exception"
TOPICS = {"plant": "plant/", "relay": "link/", "autopilot": "autopilot/command"}
"""How the topics begin that a program writes sample by sample."""

needs_proc = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="reads /proc")
needs_sigstop = pytest.mark.skipif(sys.platform == "win32", reason="no SIGSTOP")


@dataclass(frozen=True)
class Flight:
    """A flight with faults over UDP that has ended; times in s from sample k = 0."""

    folder: Path
    summary: Mapping[str, Any]
    records: list[tuple[str, float, dict[str, Any]]]

    def recovery(self, fault: str) -> dict[str, Any]:
        [found] = [each for each in self.summary["faults"] if each["fault"].startswith(fault)]
        return found

    def times(self, topic: str, start_s: float = -1e9, end_s: float = 1e9, **content: Any) -> list[float]:
        """Return when records of a topic, by its beginning, were made between two times."""
        return [
            at_s
            for name, at_s, body in self.records
            if name.startswith(topic) and start_s < at_s < end_s and content.items() <= body.items()
        ]

    def events(self, kind: str) -> list[tuple[float, dict[str, Any]]]:
        return [(at_s, body) for topic, at_s, body in self.records if topic == "events" and body["kind"] == kind]

    def listened_s(self, name: str, after_s: float) -> float:
        """Return when a program that was started after a time listened again."""
        return next(at_s for at_s, body in self.events("start") if body["node"] == name and at_s > after_s)

    def complaints(self) -> list[str]:
        logs = {path: path.read_text() for path in self.folder.glob("*.log")}
        assert len(logs) == len(PROGRAMS)
        return [text for text in logs.values() if re.search(COMPLAINTS, text)]


def flown(folder: Path, duration_s: float, *faults: str) -> Flight:
    """Fly the paper's example with faults over UDP, and read the recording."""
    scenario = replace(load_scenario("nominal"), duration_s=duration_s, checks=())
    scenario = scenario.with_faults([parse_fault(text) for text in faults])
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONWARNINGS", "error")
        outcome = fly(scenario, FlightOptions(False, folder, port_base=0), Console(file=io.StringIO()))
    with (folder / "flight.mcap").open("rb") as file:
        records = [(c.topic, m.log_time, json.loads(m.data)) for _, c, m in make_reader(file).iter_messages()]
    zero_ns = next(at_ns - body["late_ns"] for topic, at_ns, body in records if topic == "plant/truth")
    return Flight(folder, outcome.summary, [(topic, (at_ns - zero_ns) / 1e9, body) for topic, at_ns, body in records])


def gaps(times_s: list[float]) -> list[tuple[float, float]]:
    """Return the pairs of neighbours further apart than a recording may lose."""
    return [pair for pair in pairwise(sorted(times_s)) if pair[1] - pair[0] > LOST_S]


# Kills

KILL_ORDER = ("relay", "autopilot", "plant")


@pytest.fixture(scope="module")
def kills(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    rng = np.random.default_rng(53)
    instants = zip(KILL_ORDER, (1.0, 6.0, 11.0), strict=True)
    faults = [f"kill:{name}@{start_s + rng.uniform(0.0, 0.5):.3f}s+0.3s" for name, start_s in instants]
    return flown(tmp_path_factory.mktemp("kills"), 16.0, *faults)


@pytest.mark.parametrize("name", KILL_ORDER)
def test_a_killed_program_starts_again_and_the_law_flies_within_two_seconds(kills: Flight, name: str) -> None:
    kill = kills.recovery(f"kill:{name}")
    assert kill["recovered_s"] is not None, kills.summary["failsafe_transitions"]
    listened_s = kills.listened_s(name, kill["end_s"])
    assert kill["recovered_s"] - listened_s <= RESUMED_S
    if listened_s - kill["end_s"] <= PROMPT_START_S:
        assert kill["recovered_s"] - kill["end_s"] <= RESUMED_S


@pytest.mark.parametrize("name", KILL_ORDER)
def test_a_kill_loses_at_most_the_last_second_of_the_killed_programs_records(kills: Flight, name: str) -> None:
    kill = kills.recovery(f"kill:{name}")
    before = kills.times(TOPICS[name], end_s=kill["begin_s"])
    assert kill["begin_s"] - max(before) <= LOST_S
    assert kills.times(TOPICS[name], kill["begin_s"] + 0.1, kill["end_s"]) == []
    after = kills.times(TOPICS[name], kill["recovered_s"], kill["recovered_s"] + LOST_S)
    assert after, "its records do not go on"


def test_a_kill_costs_no_record_of_the_others(kills: Flight) -> None:
    plant, autopilot = kills.recovery("kill:plant"), kills.recovery("kill:autopilot")
    truth = kills.times("plant/truth")
    assert all(start_s > plant["begin_s"] - LOST_S for start_s, _ in gaps(truth))
    before = [b["k"] for topic, at_s, b in kills.records if topic == "plant/truth" and at_s < plant["begin_s"]]
    assert before == list(range(len(before)))
    sent = kills.times("mavlink/plant", direction="sent")
    assert all(autopilot["begin_s"] - LOST_S < start_s < autopilot["end_s"] for start_s, _ in gaps(sent))


def test_a_flight_with_kills_ends_in_time_complete_and_without_complaint(kills: Flight) -> None:
    assert kills.summary["duration_s"] == pytest.approx(16.0, abs=0.051)
    assert kills.summary["problems"] == []
    assert kills.complaints() == []
    assert {body["text"].partition(",")[0] for _, body in kills.events("start")} == {"listens again"}
    assert [body["node"] for _, body in kills.events("start")] == list(KILL_ORDER)


def test_the_plot_draws_no_line_over_the_time_without_a_plant(kills: Flight) -> None:
    records = [(topic, round((at_s + 1.0) * 1e9), body) for topic, at_s, body in kills.records]
    flight = FlightData.from_records(records, load_scenario("nominal").plant)
    kill = kills.recovery("kill:plant")
    [theta] = [line for line in flight_figure(flight).axes[0].lines if line.get_label() == "θ"]
    time_s, values = np.asarray(theta.get_xdata()), np.asarray(theta.get_ydata())
    [gap] = np.flatnonzero(np.isnan(values))
    assert kill["begin_s"] - 0.1 < time_s[gap] < kill["end_s"]
    assert kill["end_s"] < time_s[gap + 1] < kill["recovered_s"]
    assert (kills.folder / "flight.png").stat().st_size > 10_000


# Everything else

TROUBLES = {
    "freeze:plant": "@1s+0.4s",
    "freeze:relay": "@2.2s+0.4s",
    "freeze:autopilot": "@3.4s+0.4s",
    "mute:autopilot": "@4.6s+0.4s",
    "step:autopilot:-0.5s": "@6s",
    "corrupt-gains": "@8s+3.5s",
}


@pytest.fixture(scope="module")
def troubles(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    faults = [what + when for what, when in TROUBLES.items() if sys.platform != "win32" or "freeze" not in what]
    return flown(tmp_path_factory.mktemp("troubles"), 15.5, *faults)


@pytest.mark.parametrize("fault", [fault for fault in TROUBLES if fault != "corrupt-gains"])
def test_the_law_flies_again_within_two_seconds_of_the_end_of_the_fault(troubles: Flight, fault: str) -> None:
    found = troubles.recovery(fault)
    assert found["recovered_s"] is not None
    assert found["recovered_s"] - found["end_s"] <= RESUMED_S


def test_faults_are_not_late_by_the_refreshing_of_the_view(troubles: Flight) -> None:
    late_ns = [body["data"]["late_ns"] for _, body in troubles.events("fault")]
    assert len(late_ns) == 2 * len(troubles.summary["faults"]) - 1  # a step has no end
    assert min(late_ns) >= 0
    assert statistics.median(late_ns) < LATE_NS


@needs_sigstop
@pytest.mark.parametrize("name", PROGRAMS)
def test_a_frozen_program_writes_nothing_and_loses_nothing(troubles: Flight, name: str) -> None:
    freeze = troubles.recovery(f"freeze:{name}")
    assert troubles.times(TOPICS[name], freeze["begin_s"] + 0.1, freeze["end_s"]) == []
    assert troubles.times(TOPICS[name], freeze["end_s"], freeze["end_s"] + LOST_S)
    others = [topic for other, topic in TOPICS.items() if other == "plant" != name]
    assert all(troubles.times(topic, freeze["begin_s"] + 0.1, freeze["end_s"]) for topic in others)


def test_the_plant_flies_every_sample_though_it_stood_still(troubles: Flight) -> None:
    truth = [body["k"] for topic, _, body in troubles.records if topic == "plant/truth"]
    assert truth == list(range(len(truth)))
    assert troubles.summary["samples"] == pytest.approx(15.5 / 0.025, abs=1)


def test_nothing_that_a_mute_autopilot_sends_arrives(troubles: Flight) -> None:
    mute = troubles.recovery("mute:autopilot")
    assert troubles.times("link/down", mute["begin_s"] + 0.25, mute["end_s"]) == []
    assert troubles.times("plant/truth", mute["begin_s"], mute["end_s"])
    assert troubles.times("link/down", mute["end_s"], mute["end_s"] + LOST_S)


def test_a_step_of_its_clock_is_noticed_by_the_autopilot(troubles: Flight) -> None:
    step = troubles.recovery("step:")
    noticed = [at_s for at_s, body in troubles.events("clock") if body["node"] == "autopilot" and at_s > step["end_s"]]
    assert min(noticed) - step["end_s"] <= RESUMED_S


def test_an_autopilot_refuses_a_damaged_gain_file_in_one_line_and_flies_when_it_is_whole_again(
    troubles: Flight,
) -> None:
    fault = troubles.recovery("corrupt-gains")
    [(at_s, exit_)] = troubles.events("exit")
    assert fault["begin_s"] < at_s < fault["end_s"]
    assert (exit_["node"], exit_["data"]["code"]) == ("autopilot", 2)
    assert re.fullmatch(r"autopilot: error: .*damaged-gains\.toml: expected TOML, found: .*", exit_["text"])
    assert troubles.times("autopilot/command", fault["begin_s"] + 0.1, fault["end_s"]) == []
    listened_s = troubles.listened_s("autopilot", fault["begin_s"])
    assert listened_s > fault["end_s"], "it flew with a damaged file"
    assert fault["recovered_s"] - listened_s <= RESUMED_S
    assert troubles.complaints() == []


# Ends


@pytest.mark.long  # the supervisor's own test does the same to one program
@needs_proc
@needs_sigstop
def test_ctrl_c_while_a_program_is_frozen_ends_all_of_them_in_order(tmp_path: Path) -> None:
    files = ["--port-base", "0", "--gcs", "none", "--out", "out", "--json", "--fault", "freeze:relay@0.1s+9s"]
    with program(tmp_path, "sitl", "fly", "nominal", *files) as sitl:
        frozen = eventually("a frozen relay", lambda: [pid for pid in children_of(sitl.process.pid) if stopped(pid)])
        pids = children_of(sitl.process.pid)
        assert " relay " in pids[frozen[0]]
        assert sitl.end(signal.SIGINT, 20.0) == 130
        assert not any(alive(pid) for pid in pids)
        assert json.loads(sitl.stdout)["interrupted"] is True
        assert not re.search(COMPLAINTS, sitl.stderr)


def stopped(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "T"
    except OSError:
        return False


# Every stored scenario


@pytest.mark.long
@pytest.mark.parametrize("name", [name for name in stored_scenarios() if name.startswith("fault-")])
def test_every_fault_scenario_passes_its_checks_over_udp(name: str, tmp_path: Path) -> None:
    outcome = fly(load_scenario(name), FlightOptions(False, tmp_path, port_base=0), Console(quiet=True))
    assert outcome.passed, [verdict for verdict in outcome.verdicts if not verdict.passed]


# Fifty kills

SLOT_S = 4.5


@pytest.fixture(scope="module", params=PROGRAMS)
def many_kills(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Flight:
    rng = np.random.default_rng(PROGRAMS.index(request.param))
    faults = [f"kill:{request.param}@{1.0 + SLOT_S * n + rng.uniform(0.0, 1.0):.3f}s+0.3s" for n in range(17)]
    return flown(tmp_path_factory.mktemp("many"), 1.0 + SLOT_S * 17, *faults)


@pytest.mark.long
def test_fifty_kills_at_random_instants_cost_two_seconds_of_flight_and_one_of_recording_each(
    many_kills: Flight,
) -> None:
    kills = many_kills.summary["faults"]
    assert len(kills) == 17
    name = kills[0]["fault"].split("@")[0].removeprefix("kill:")
    slow = []
    for kill in kills:
        assert kill["begin_s"] - max(many_kills.times(TOPICS[name], end_s=kill["begin_s"])) <= LOST_S
        listened_s = many_kills.listened_s(name, kill["end_s"])
        if kill["recovered_s"] is None or kill["recovered_s"] - kill["end_s"] > RESUMED_S:
            slow.append((kill["fault"], listened_s - kill["end_s"], kill["recovered_s"]))
    assert slow == [], f"{len(slow)} of {len(kills)} later: fault, start-up in s, recovery at s"
    assert many_kills.complaints() == []
