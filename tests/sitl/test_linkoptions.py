"""What a relay can do in flight, a scenario and ``sitl fly`` can say: rules, changes, live control."""

from __future__ import annotations

import json
import shlex
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from click.testing import CliRunner
from mcap.reader import make_reader

import sitl.commands.fly as command
from autopilot.link.node import Record
from gains.table import InputError
from sitl.__main__ import cli
from sitl.arguments import relay_arguments
from sitl.flight import fly_virtual
from sitl.fly import Outcome
from sitl.link.changes import parse_change
from sitl.link.rules import parse_rule
from sitl.programs import FlightOptions, Programs
from sitl.scenario import Scenario, load_scenario
from tests.integration.programs import eventually, free_port, program

S, MS = 1_000_000_000, 1_000_000
RULE, CHANGE = "up:AOA_SSA:delay=40ms", "2s:up:delay=80ms"
TEXT = """
title = "a link that changes"
gains = "hirm-d6"
plant = "hirm"
duration_s = 4.0
[link]
up = "delay=5ms"
{more}
"""


def load(folder: Path, more: str) -> Scenario:
    (folder / "s.toml").write_text(TEXT.format(more=more))
    return load_scenario(str(folder / "s.toml"))


def test_rules_and_changes_of_a_scenario_are_in_force_in_virtual_time(tmp_path: Path) -> None:
    scenario = load(tmp_path, f'rules = ["{RULE}"]\nchanges = ["{CHANGE}"]')
    packets: list[dict[str, Any]] = []
    fly_virtual(scenario, lambda r, _: packets.append(dict(r.body)) if r.topic == "link/up" else None)
    begin_ns = min(each["sent_ns"] for each in packets) - 5 * MS  # the link's time is that of the first packet down
    asked = {
        (each.get("rule"), each["sent_ns"] - begin_ns > 2 * S, each["requested_ns"] // MS)
        for each in packets
        if abs(each["sent_ns"] - begin_ns - 2 * S) > 100 * MS
    }
    assert asked == {(None, False, 5), (None, True, 80), ("AOA_SSA", False, 40), ("AOA_SSA", True, 40)}


def test_from_a_change_on_the_aircraft_lives_the_changed_delay(tmp_path: Path) -> None:
    """Constant delays that sum to 20 ms, then 70 ms, are one sample of 25 ms, then three; the third is reached by two
    samples that repeat the newest command, as what was sent before the change has all arrived."""
    scenario = load(tmp_path, 'down = "delay=10ms"\nchanges = ["2s:up:delay=60ms"]')
    scenario = replace(scenario, up=replace(scenario.up, delay_ns=10 * MS))
    lived: list[tuple[int, int]] = []
    entered: list[tuple[int, int]] = []

    def write(record: Record, true_ns: int) -> None:
        if record.topic == "plant/truth":
            lived.append((true_ns, record.body["d"]))
        elif record.topic == "link/up":
            entered.append((true_ns - record.body["requested_ns"], record.body["requested_ns"] // MS))

    fly_virtual(scenario, write)
    assert {asked for _, asked in entered} == {10, 60}
    changed_ns = min(at_ns for at_ns, asked in entered if asked == 60) - MS  # of clocks that drift apart
    assert max(at_ns for at_ns, asked in entered if asked == 10) < changed_ns
    first = next(n for n, (at_ns, _) in enumerate(lived) if at_ns >= changed_ns)
    assert 0 < first < len(lived) - 40
    found = [d for _, d in lived]
    assert found[5:] == [1] * (first - 4) + [2] + [3] * (len(lived) - first - 2)


def test_over_udp_they_go_to_the_relay_as_they_are(tmp_path: Path) -> None:
    scenario = load(tmp_path, f'rules = ["{RULE}"]\nchanges = ["{CHANGE}"]')
    arguments = relay_arguments(scenario)
    assert arguments[arguments.index("--rule") + 1] == RULE
    assert parse_change(arguments[arguments.index("--at") + 1]) == parse_change(CHANGE)
    assert not {"--rule", "--at"} & set(relay_arguments(load_scenario("nominal")))


@pytest.mark.parametrize(
    ("more", "complaint"),
    [
        ('rules = ["AOA_SSA:delay=40ms"]', 'link.rules[0]: rule "AOA_SSA:delay=40ms": expected up:MESSAGE'),
        (f'rules = ["{RULE}", "up:0:loss=2"]', 'link.rules[1]: rule "up:0:loss=2": '),
        (f"rules = {json.dumps([RULE] * 17)}", "link.rules: expected at most 16, found 17"),
        ('rules = "x"', "link.rules: expected an array"),
        ("rules = [3]", "link.rules[0]: expected a string, found"),
        ('rule = ["x"]', "link.rule: expected one of"),
        ('changes = ["2s:sideways:delay=1ms"]', 'link.changes[0]: change "2s:sideways:delay=1ms": expected TIME:up'),
        (f'changes = ["{CHANGE}", "2:up:loss=1"]', 'link.changes[1]: change "2:up:loss=1": time: expected a time'),
        ('changes = ["34.1s:up:loss=1"]', 'link.changes[0]: change "34100ms:up:loss=1.0": expected at most 34s'),
        (f"changes = {json.dumps([CHANGE] * 1001)}", "link.changes: expected at most 1000, found 1001"),
    ],
)
def test_what_is_no_rule_or_change_is_refused(tmp_path: Path, more: str, complaint: str) -> None:
    with pytest.raises(InputError) as error:
        load(tmp_path, more)
    assert str(error.value).startswith(f"{tmp_path / 's.toml'}: {complaint}")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--rule", "ATTITUDE:loss=1"], 'rule "ATTITUDE:loss=1": expected up:MESSAGE'),
        (["--rule", RULE] * 17, "--rule: expected at most 16, found 17"),
        (["--at", "soon:up:loss=1"], 'change "soon:up:loss=1": time: expected a time'),
        (["--at", "40001ms:up:loss=1"], "expected at most 40s, which is a flight of 10 s and its start, found 40001ms"),
        (["--duration", "2", "--at", "33s:up:loss=1"], "expected at most 32s"),
        (["--control", "0"], '--control "0": expected [HOST:]PORT, from 1 to 65535'),
        (["--control", "65536"], '--control "65536": expected [HOST:]PORT'),
        (["--control", "nominal"], "a SCENARIO goes before it"),
    ],
)
def test_sitl_fly_refuses_a_link_that_cannot_be(words: list[str], complaint: str) -> None:
    result = CliRunner().invoke(cli, ["fly", *words])
    assert isinstance(result.exception, InputError)
    assert complaint in str(result.exception)


def test_a_change_while_the_flight_may_still_last_is_taken(tmp_path: Path) -> None:
    """Link time begins before sample k = 0, so what was changed by hand near the end can be repeated."""
    assert load(tmp_path, 'changes = ["34s:up:loss=1"]').changes == (parse_change("34s:up:loss=1"),)


@pytest.fixture
def flown(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Scenario, FlightOptions]]:
    """Take the place of the flight, and give what would have flown."""
    flights: list[tuple[Scenario, FlightOptions]] = []

    def fly(scenario: Scenario, options: FlightOptions, _console: object) -> Outcome:
        flights.append((scenario, options))
        return Outcome({}, [], interrupted=False)

    monkeypatch.setattr(command, "fly", fly)
    return flights


def run(*words: str) -> tuple[int, str]:
    result = CliRunner().invoke(cli, ["fly", *words, "--json"])
    return result.exit_code, result.output


def test_the_command_line_adds_to_those_of_the_scenario_and_of_its_variants(
    tmp_path: Path, flown: list[tuple[Scenario, FlightOptions]]
) -> None:
    load(tmp_path, f'rules = ["{RULE}"]\n[variant.loose]\nservo_timeout = 0')
    more = ["--rule", "down:42:loss=1", "--at", CHANGE, "--at", "3s:down:loss=0.1", "--out", str(tmp_path / "out")]
    assert run(str(tmp_path / "s.toml"), *more)[0] == 0
    [(scenario, options)] = flown
    for one in (scenario, *scenario.variants.values()):
        assert one.rules == (parse_rule(RULE), parse_rule("down:42:loss=1"))
        assert one.changes == (parse_change(CHANGE), parse_change("3s:down:loss=0.1"))
    assert options.control is None


def test_a_flight_over_udp_may_be_controlled_and_one_in_virtual_time_may_not(
    tmp_path: Path, flown: list[tuple[Scenario, FlightOptions]]
) -> None:
    out = ["--out", str(tmp_path / "out")]
    assert run("nominal", "--control", *out)[0] == 0
    assert run("nominal", "--control", "127.0.0.1:4567", *out)[0] == 0
    assert run("nominal", "--control", "4568", *out)[0] == 0
    assert run("nominal", "--control", "[::1]:4569", *out)[0] == 0
    assert [options.control for _, options in flown] == [
        *(("127.0.0.1", port) for port in (14602, 4567, 4568)),
        ("::1", 4569),
    ]
    relay = Programs(flown[1][0], replace(flown[1][1], port_base=4001), 4001, 4002).relay()
    assert "--control=127.0.0.1:4567" in relay
    with pytest.raises(InputError, match="--control: expected none with --virtual"):
        CliRunner().invoke(cli, ["fly", "nominal", "--virtual", "--control"], catch_exceptions=False)
    assert len(flown) == 4


def test_a_relay_that_is_started_again_gets_the_same_rules_changes_and_control(tmp_path: Path) -> None:
    scenario = load(tmp_path, f'rules = ["{RULE}"]\nchanges = ["{CHANGE}", "3s:down:loss=0.1"]')
    programs = Programs(scenario, FlightOptions(False, None, control=("127.0.0.1", 4567)), 4001, 4002)
    words = programs.again("relay", tmp_path)
    assert words == programs.relay()
    given = [(word, text) for word, text in pairwise(words) if word in ("--rule", "--at")]
    assert [(word, parse_rule(text) if word == "--rule" else parse_change(text)) for word, text in given] == [
        ("--rule", parse_rule(RULE)),
        ("--at", parse_change(CHANGE)),
        ("--at", parse_change("3s:down:loss=0.1")),
    ]
    assert "--control=127.0.0.1:4567" in words


def test_a_relay_that_is_started_again_changes_again_as_its_link_time_begins_anew(tmp_path: Path) -> None:
    top = 'faults = ["kill:relay@1.5s+0.2s"]'
    (tmp_path / "s.toml").write_text(top + TEXT.format(more='changes = ["1s:up:delay=9ms"]'))
    changes: list[dict[str, Any]] = []

    def write(record: Record, _true_ns: int) -> None:
        if record.topic == "events" and record.body["kind"] == "link_change":
            changes.append(record.body["data"])

    fly_virtual(load_scenario(str(tmp_path / "s.toml")), write)
    assert [change["at"] for change in changes] == ["1s:up:delay=9ms"] * 2


def test_what_a_recording_says_of_its_link_repeats_the_flight(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Random delays before and after the change: no other link makes the same packets."""
    monkeypatch.setitem(sys.modules, "sitl.plot", SimpleNamespace(plot_flight=lambda *_: None))  # a second each
    load(tmp_path, "")
    line = [str(tmp_path / "s.toml"), "--virtual", "--duration", "1"]
    given = ["--link", "lossy", "--seed", "5", "--rule", "up:AOA_SSA:jitter=uniform:9ms"]
    (tmp_path / "a trace.csv").write_text("delay_ms\n9\n11\n\n")
    given += ["--at", "0.5s:up:jitter=normal:3ms,delay=9ms", "--at", f"0.7s:down:trace={tmp_path / 'a trace.csv'}"]
    assert run(*line, *given, "--out", str(tmp_path / "first"))[0] == 0
    said = metadata(tmp_path / "first")
    given = ["--up", said["up"], "--down", said["down"], "--seed", said["seed"]]
    given += [word for text in shlex.split(said["rules"]) for word in ("--rule", text)]
    given += [word for text in shlex.split(said["changes"]) for word in ("--at", text)]
    assert run(*line, *given, "--out", str(tmp_path / "second"))[0] == 0
    first, second = ((tmp_path / name / "flight.mcap").read_bytes() for name in ("first", "second"))
    assert first == second
    assert run(*line, *given[:-2], "--out", str(tmp_path / "third"))[0] == 0
    assert first != (tmp_path / "third" / "flight.mcap").read_bytes()


def metadata(folder: Path) -> dict[str, str]:
    """Return what a flight's recording says about itself, as the mcap reader reads it."""
    with (folder / "flight.mcap").open("rb") as file:
        [about] = make_reader(file).iter_metadata()
    return about.metadata


@pytest.mark.realtime
def test_a_flight_over_udp_with_control_answers_sitl_relay_and_obeys_it(tmp_path: Path) -> None:
    port = str(free_port())
    line = ["sitl", "fly", "nominal", "--gcs", "none", "--port-base", "0", "--control", port, "--out", "out"]
    with program(tmp_path, *line, "--rule", "up:0:delay=1ms", "--at", "90s:down:delay=1ms", "--duration", "60") as fly:

        def ask(*words: str) -> Any:
            """Return what the relay answers; None when there is no relay yet."""
            assert fly.process.poll() is None, fly.stderr
            answer = CliRunner().invoke(cli, ["relay", *words, "--control", f"127.0.0.1:{port}"])
            return answer.output if answer.exit_code == 0 else None

        def flying() -> Any:
            shown = ask("show", "--json")
            link = json.loads(shown)["links"]["link"] if shown else None
            return link if link and link["up"]["delivered"] > 0 else None

        link = eventually("packets", flying)
        assert [rule["rule"] for rule in link["up"]["rules"]] == ["up:0:delay=1ms"]
        assert link["down"]["next_changes"] == ["90s:down:delay=1ms"]
        assert ask("set", "--up", "delay=7ms").endswith(":up:delay=7ms\n")
        assert flying()["up"]["spec"] == "delay=7ms"
        assert fly.end() == 130
