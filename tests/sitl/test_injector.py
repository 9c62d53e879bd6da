"""The injector: what is due and when, what the supervisor is told, and what the recording says of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from autopilot.link.clock import NS_PER_MS, NS_PER_S
from autopilot.link.node import Record
from autopilot.link.orders import BreakSends, DriftClock, MovePeer, StepClock
from gains.store import load_law, resolve, stored
from gains.table import InputError
from sitl import injector as injector_module
from sitl.faults import PROGRAMS, Kill, Phase, parse_fault
from sitl.injector import FaultSchedule, Injector, check_feasible
from sitl.programs import DAMAGED_GAINS, FlightOptions, Programs, damaged
from sitl.scenario import load_scenario

ZERO_NS = 77 * NS_PER_S


class Told:
    """A supervisor that only listens, and a clock that only moves when told to."""

    def __init__(self, *faults: str) -> None:
        self.now_ns = ZERO_NS
        self.done: list[tuple[Any, ...]] = []
        self.events: list[tuple[Record, int]] = []
        self.injector = Injector(
            [parse_fault(text) for text in faults],
            self,  # type: ignore[arg-type]
            lambda name, corrupt_gains=False: [name, "corrupt" if corrupt_gains else "whole"],
            lambda: self.done.append(("fill disk",)),
            lambda record, at_ns: self.events.append((record, at_ns)),
            lambda: self.now_ns,
        )
        self.injector.zero_ns = ZERO_NS

    def kill(self, name: str) -> None:
        self.done.append(("kill", name))

    def start(self, name: str, words: list[str], *, may_end: bool = False) -> None:
        self.done.append(("start", *words, may_end))

    def freeze(self, name: str) -> None:
        self.done.append(("freeze", name))

    def thaw(self, name: str) -> None:
        self.done.append(("thaw", name))

    def order(self, name: str, order: object) -> None:
        self.done.append((name, order))

    def at(self, seconds: float) -> list[tuple[Any, ...]]:
        """Act at a time from sample k = 0, and return what was done."""
        self.now_ns = ZERO_NS + round(seconds * NS_PER_S)
        self.done.clear()
        self.injector.act()
        return list(self.done)


@given(st.lists(st.tuples(st.integers(0, 50), st.none() | st.integers(1, 20)), max_size=12), st.integers(1, 9))
def test_a_schedule_gives_each_change_once_in_order_and_never_early(times: list[tuple[int, int | None]], step: int):
    faults = [Kill(at, length, "plant") for at, length in times]
    schedule = FaultSchedule(faults)
    taken = []
    for now_ns in range(0, 80 + step, step):
        next_ns = schedule.next_ns()
        while (change := schedule.take(now_ns)) is not None:
            assert next_ns is not None
            assert next_ns <= change.at_ns <= now_ns
            taken.append(change)
        assert schedule.next_ns() is None or schedule.next_ns() > now_ns
    assert [c.at_ns for c in taken] == sorted(c.at_ns for c in taken)
    assert sorted((c.phase, c.at_ns) for c in taken) == sorted(
        [(Phase.BEGIN, f.at_ns) for f in faults] + [(Phase.END, f.end_ns) for f in faults if f.end_ns is not None]
    )
    assert schedule.next_ns() is None


def test_nothing_happens_before_sample_zero():
    told = Told("kill:plant@0s")
    told.injector.zero_ns = None
    assert told.at(100.0) == []
    assert told.injector.next_ns() is None


@pytest.mark.parametrize(
    ("fault", "begin", "end"),
    [
        ("kill:relay@1s+0.3s", [("kill", "relay")], [("start", "relay", "whole", False)]),
        ("kill:plant@1s", [("kill", "plant")], []),
        ("freeze:plant@1s+1s", [("freeze", "plant")], [("thaw", "plant")]),
        ("mute:relay@1s+2s", [("relay", BreakSends(2 * NS_PER_S))], [("relay", BreakSends(0))]),
        ("step:autopilot:-0.5s@1s", [("autopilot", StepClock(-NS_PER_S // 2))], []),
        ("drift:plant:150ppm@1s", [("plant", DriftClock(150_000))], []),
        ("disk-full@1s", [("fill disk",)], []),
        ("elevator:stuck@1s+1s", [], []),
        (
            "corrupt-gains@1s+1s",
            [("kill", "autopilot"), ("start", "autopilot", "corrupt", True)],
            [("kill", "autopilot"), ("start", "autopilot", "whole", False)],
        ),
    ],
)
def test_each_fault_is_begun_and_ended_once_and_told_of(fault: str, begin: list[Any], end: list[Any]):
    told = Told(fault)
    assert told.injector.next_ns() == ZERO_NS + NS_PER_S
    assert told.at(0.999) == []
    assert told.at(1.002) == begin
    assert told.at(1.002) == []
    assert told.at(60.0) == end
    assert told.injector.next_ns() is None
    lasts = "+" in fault
    bodies = [record.body for record, _ in told.events]
    assert [(b["kind"], b["node"], b["data"]["phase"]) for b in bodies] == [
        ("fault", "scenario", phase) for phase in ("begin", "end")[: 1 + lasts]
    ]
    assert bodies[0]["data"]["late_ns"] == 2 * NS_PER_MS
    assert told.events[0][1] == told.events[0][0].t_ns == ZERO_NS + 1002 * NS_PER_MS
    assert {parse_fault(b["data"]["fault"]) for b in bodies} == {parse_fault(fault)}


@pytest.mark.parametrize(
    ("name", "called"),
    [("autopilot", ("relay", MovePeer(4321))), ("relay", ("plant", MovePeer(4321))), ("plant", None)],
)
def test_a_neighbour_is_told_where_a_program_that_is_there_again_calls_from(name: str, called: Any):
    told = Told()
    ports = {"autopilot": ("127.0.0.1", 14600)} if name == "plant" else {"plant": ("127.0.0.1", 4321)}
    told.injector._heard(name, ports, 1_500_000_000)
    assert told.done == ([] if called is None else [called])
    [(record, at_ns)] = told.events
    assert at_ns == ZERO_NS
    assert (record.body["kind"], record.body["node"]) == ("start", name)
    assert record.body["text"] == "listens again, 1.50 s after its start"


@pytest.mark.parametrize(
    ("words", "text"), [("autopilot: error: x", "autopilot: error: x"), ("", "ended with exit code 2")]
)
def test_an_end_is_told_with_its_last_words(words: str, text: str):
    told = Told()
    told.injector._ended("autopilot", 2, words)
    [(record, _)] = told.events
    assert record.body == {"kind": "exit", "node": "autopilot", "text": text, "data": {"code": 2}}


def test_a_freeze_is_refused_in_one_line_where_there_is_no_sigstop(monkeypatch):
    faults = [parse_fault("kill:plant@1s"), parse_fault("freeze:relay@2s+1s")]
    check_feasible(faults)
    monkeypatch.setattr(injector_module, "CAN_FREEZE", False)
    check_feasible(faults[:1])
    with pytest.raises(InputError, match=r'fault "freeze:relay@2s\+1s": expected a system with SIGSTOP, or --virtual'):
        check_feasible(faults)


@pytest.mark.parametrize("entry", [entry for entry in stored() if entry.kind == "gains"], ids=lambda entry: entry.name)
def test_every_stored_gain_file_is_refused_when_it_has_lost_a_sector(entry: Any, tmp_path: Path):
    path = tmp_path / "gains.toml"
    content = entry.path.read_bytes()
    path.write_bytes(damaged(content))
    assert len(path.read_bytes()) == len(content)
    with pytest.raises(InputError, match=r"expected TOML"):
        load_law(path)


def test_even_a_tiny_file_is_damaged():
    assert damaged(b"") == b"\0"
    assert damaged(b"a = 1\n") == bytes(6)


@pytest.mark.parametrize("name", PROGRAMS)
def test_a_program_starts_again_by_the_command_line_of_its_first_start(name: str, tmp_path: Path):
    programs = Programs(load_scenario("nominal"), FlightOptions(False, None), 4001, 4002)
    assert programs.again(name, tmp_path) == getattr(programs, name)()
    assert not list(tmp_path.iterdir())
    assert "127.0.0.1:4001" in programs.plant()
    assert {"127.0.0.1:4001", "127.0.0.1:4002"} < set(programs.relay())
    assert "udpout:127.0.0.1:4002" in programs.autopilot()


def test_a_damaged_gain_file_is_a_copy_and_the_only_change(tmp_path: Path):
    scenario = load_scenario("nominal")
    before = resolve(scenario.gains_name).read_bytes()
    programs = Programs(scenario, FlightOptions(False, None), 4001, 4002)
    words = programs.again("autopilot", tmp_path, corrupt_gains=True)
    path = tmp_path / DAMAGED_GAINS
    changed = [(old, new) for old, new in zip(programs.autopilot(), words, strict=True) if old != new]
    assert changed == [(scenario.gains_name, str(path))]
    assert path.read_bytes() != before == resolve(scenario.gains_name).read_bytes()
    with pytest.raises(InputError, match="nowhere"):
        programs.again("autopilot", tmp_path / "nowhere", corrupt_gains=True)
