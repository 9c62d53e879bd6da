"""What a relay can do in flight, a scenario and ``sitl fly`` can say: rules, changes, live control."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

import sitl.commands.fly as command
from gains.table import InputError
from sitl.__main__ import cli
from sitl.flight import fly_virtual
from sitl.fly import Outcome
from sitl.link.changes import parse_change
from sitl.link.rules import parse_rule
from sitl.programs import FlightOptions, Programs
from sitl.scenario import Scenario, load_scenario, relay_arguments

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


def test_over_udp_they_go_to_the_relay_as_they_are(tmp_path: Path) -> None:
    scenario = load(tmp_path, f'rules = ["{RULE}"]\nchanges = ["{CHANGE}"]')
    arguments = relay_arguments(scenario)
    assert arguments[arguments.index("--rule") + 1] == RULE
    assert parse_change(arguments[arguments.index("--at") + 1]) == parse_change(CHANGE)
    assert not {"--rule", "--at"} & set(relay_arguments(load_scenario("nominal")))


@pytest.mark.parametrize(
    ("more", "complaint"),
    [
        ('rules = ["AOA_SSA:delay=40ms"]', 'rule "AOA_SSA:delay=40ms"'),
        ('changes = ["2s:sideways:delay=1ms"]', 'change "2s:sideways:delay=1ms"'),
        (f"rules = {[RULE] * 17}".replace("'", '"'), "link.rules: expected at most 16, found 17"),
        ('rules = "x"', "rules"),
    ],
)
def test_what_is_no_rule_or_change_is_refused(tmp_path: Path, more: str, complaint: str) -> None:
    with pytest.raises(InputError) as error:
        load(tmp_path, more)
    assert complaint in str(error.value)
    assert "\n" not in str(error.value)


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
    assert [options.control for _, options in flown] == [("127.0.0.1", 14602), ("127.0.0.1", 4567)]
    relay = Programs(flown[1][0], replace(flown[1][1], port_base=4001), 4001, 4002).relay()
    assert "--control=127.0.0.1:4567" in relay
    with pytest.raises(InputError, match="--control: expected none with --virtual"):
        CliRunner().invoke(cli, ["fly", "nominal", "--virtual", "--control"], catch_exceptions=False)
    assert len(flown) == 2
