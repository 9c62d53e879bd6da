"""A schedule in flight: the set of each command, what is told of it, failsafe around all windows, re-entry."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from autopilot.config import AutopilotConfig
from autopilot.link.wire import NamedValueInt
from autopilot.profile import parse_profile
from gains.model import Schedule
from sitl.plant import PlantConfig
from tests.autopilot.bench import X0, Bench
from tests.helpers import HIRM, MS, TS, Flight, S, constant

FIRST = replace(HIRM, name="two[0]", d_max=2)
SECOND = replace(HIRM, name="two[1]", d_min=2, K1=1.2 * HIRM.K1, K2=1.2 * HIRM.K2)
TWO = Schedule("two", HIRM.model, (FIRST, SECOND))
CONFIG = AutopilotConfig(TWO)


def flown(*delays: int, bench: Bench | None = None) -> Bench:
    """Let a sample arrive for each delay, late enough that this delay is forecast; skip those that came before."""
    bench = bench or Bench(CONFIG)
    k = bench.commands[-1]["j"] if bench.commands else -1
    for d in delays:
        age_ns = d * TS - 5 * MS
        k = max(k + 1, -(-(bench.now_ns - bench.t0_ns - age_ns) // TS))
        bench.sample(k, age_ns=age_ns)
    assert [c["d"] for c in bench.commands[-len(delays) :]] == list(delays)
    return bench


def sets(bench: Bench) -> list[int]:
    return [c["gain_set"] for c in bench.commands]


def changes(bench: Bench) -> list[str]:
    return [e["text"] for e in bench.events if e["kind"] == "gain_set"]


def by_set(command: dict, gain_set: int) -> float:
    """Return u of Eq. (9) with a set's gains, within the travel."""
    gains = TWO.sets[gain_set]
    u = float((gains.K1 @ command["x"] + gains.K2 @ command["xr"])[0])
    return float(np.clip(u, -math.radians(25), math.radians(25)))


def test_each_command_is_equation_9_with_the_gains_of_its_recorded_set():
    b = flown(1, 2, 3, 2, 4, 3, 1, 2, 3)
    assert sets(b) == [0, 0, 1, 1, 1, 1, 0, 0, 1]
    for c in b.commands:
        assert c["u"][0] == pytest.approx(by_set(c, c["gain_set"]), abs=1e-12)
        assert abs(by_set(c, 0) - by_set(c, 1)) > 1e-3


def test_plain_gains_are_set_0():
    assert set(sets(flown(1, 2, 3, 4, 1, bench=Bench(AutopilotConfig(HIRM))))) == {0}


def test_the_window_of_failsafe_is_that_of_all_sets_together():
    b = flown(1, 4, 4, 1, 4)
    assert (b.mode, b.transitions()) == ("TRACKING", ["STANDBY to TRACKING: delay 1"])
    flown(5, bench=b)
    assert b.mode == "HOLD"


def test_no_fresh_state_leaves_tracking_after_the_largest_d_max_whatever_set_is_in_force():
    b = flown(1, 1, 1)
    last_ns = b.now_ns
    b.to(last_ns + TWO.d_max * TS)
    assert (b.mode, sets(b)[-1]) == ("TRACKING", 0)
    b.to(last_ns + TWO.d_max * TS + TS // 2)
    assert b.mode == "HOLD"


@pytest.mark.parametrize(("d", "mode"), [(3, "TRACKING"), (4, "HOLD")])
def test_a_forecast_may_be_wrong_by_one_sample_and_no_more(d: int, mode: str):
    b = flown(*[1] * 10)  # set 0, window 1..2
    b.give(NamedValueInt(b.now_ns // MS, "DELAY_K", d))
    assert b.mode == mode


def test_a_command_that_is_held_while_its_delay_grows_keeps_its_set():
    b = flown(*[1] * 10)
    for d in (2, 3, 4):  # of one command: its stamp moves on with its delay
        b.give(NamedValueInt(b.now_ns // MS + (d - 4) * TS // MS, "DELAY_K", d))
        assert b.mode == "TRACKING"


@pytest.mark.parametrize("failsafe", ["on", "monitor"])
def test_outside_every_window_the_set_in_force_stays(failsafe):
    b = flown(1, 1, 3, 3, 6, 7, 5, bench=Bench(replace(CONFIG, failsafe=failsafe)))
    assert sets(b) == [0, 0, 1, 1, 1, 1, 1]
    outside = b.commands[-1]
    assert outside["mode"] == "HOLD"
    assert outside["u"][0] == (b.commands[3]["u"][0] if failsafe == "on" else pytest.approx(by_set(outside, 1)))


def test_an_unknown_delay_flown_by_the_monitor_is_flown_with_the_first_set():
    b = Bench(replace(CONFIG, failsafe="monitor"), answers=False)
    for k in range(100):
        b.sample(k)
    assert {c["d"] for c in b.commands} == {None}
    assert set(sets(b)) == {0}
    assert b.commands[-1]["u"][0] == pytest.approx(by_set(b.commands[-1], 0))


# what is told


def test_name_sets_and_windows_are_told_at_start():
    b = Bench(CONFIG)
    b.to(b.now_ns)
    assert b.texts() == ["no verified certificate: schedule two", "2 gain sets: delay 1..2, 2..4"]
    [event] = [e for e in b.events if e["kind"] == "gains"]
    assert event["data"] == {
        "gains": "two", "d_min": 1, "d_max": 4, "windows": [(1, 2), (2, 4)],
        "verified": False, "reason": "there is no certificate",
    }  # fmt: skip


def test_a_change_of_set_is_told_once():
    b = flown(1, 1, 3, 3, 2, 3)
    assert changes(b) == ["gain set 1: delay 2 to 4"]
    assert b.texts()[-1] == "gain set 1: delay 2 to 4"
    [event] = [e for e in b.events if e["kind"] == "gain_set"]
    assert event["data"] == {"gain_set": 1, "d": 3, "changes": 1}


def test_changes_at_every_sample_are_told_once_a_second_and_all_counted():
    b = flown(*[1, 3] * 60)
    assert sets(b) == [0, 1] * 60
    seconds = (b.now_ns - b.t0_ns) / S
    told = [e["data"]["changes"] for e in b.events if e["kind"] == "gain_set"]
    assert seconds - 1 <= len(told) <= seconds + 1
    assert [t for t in b.texts() if t.startswith("gain set")] == changes(b)
    assert changes(b)[1].endswith(f", {told[1]} changes")
    b.to(b.now_ns + 2 * S)
    counters = [e for e in b.events if e["kind"] == "counters"]
    assert counters[-1]["data"]["gain_set_changes"] == 119
    assert sum(told) == 119 - b.node.gain_set_changes.untold


def test_the_last_change_of_a_burst_is_told_when_its_second_is_over():
    b = flown(1, 3, 1, 3, 1)
    assert changes(b) == ["gain set 1: delay 2 to 4"]
    flown(*[1] * 45, bench=b)
    assert changes(b)[1:] == ["gain set 0: delay 1 to 2, 3 changes"]


def test_the_first_sets_of_a_flight_and_those_in_hold_are_no_change():
    b = flown(3, 3, 3)
    assert (sets(b), changes(b)) == ([1, 1, 1], [])
    flown(6, 1, 3, bench=b)
    assert (sets(b)[-3:], b.mode, changes(b)) == ([1, 0, 1], "HOLD", [])


# re-entry


def test_re_entry_meets_the_held_command_with_the_gains_of_the_set_in_force():
    config = AutopilotConfig(TWO, parse_profile("5deg@1s", 0.025), actuator="float")
    cut = lambda now_ns: None if 1.3 * S <= now_ns < 1.6 * S else 30 * MS  # noqa: E731
    flight = Flight(config, PlantConfig(HIRM.model, X0), up=cut, down=constant(30 * MS)).fly(4 * S)
    commands = flight.bodies("autopilot/command")
    at = next(i for i in range(1, len(commands)) if commands[i - 1]["mode"] == "HOLD" and commands[i]["mode"] != "HOLD")
    held, back = commands[at - 1], commands[at]
    assert (back["mode"], back["gain_set"], back["d"]) == ("TRACKING", 1, 3)
    assert back["u"][0] == pytest.approx(held["u"][0], abs=1e-6)
    assert abs(by_set(back, 0) - held["u"][0]) > 1e-4
