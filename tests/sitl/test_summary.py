"""What a flight with faults came to: when the law had the elevator again, by records made by hand."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from io import StringIO
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from gains.store import load_gains
from sitl.checks import Check
from sitl.faults import fault_changes, fault_record, parse_fault
from sitl.flightdata import FlightData
from sitl.recovery import Recovery, longest_recovery_s, recoveries
from sitl.scenario import load_scenario
from sitl.summary import delay_summary, judge, outside_fraction, summarise, summary_table

HIRM = load_gains("hirm-paper")
MODEL = HIRM.model
TS, S = MODEL.Ts_ns, 1_000_000_000
ZERO = 7 * S

Entry = tuple[str, int, dict[str, Any]]


def truth(k: int, at_ns: int, j: int | None, timeout: bool = False) -> Entry:
    d = None if j is None else k - j
    body = {"k": k, "late_ns": 0, "x": [0.0] * 3, "u": [0.0], "j": j, "d": d, "w": [0.0], "timeout": timeout}
    return "plant/truth", at_ns, body


def command(j: int, at_ns: int, mode: str, d: int | None = 2) -> Entry:
    body = {"j": j, "x": [0.0] * 3, "xr": None, "r": [0.0], "d": d, "d_low": d, "d_high": d}
    return "autopilot/command", at_ns, {**body, "saturated": False, "mode": mode}


def changes(*texts: str) -> list[Entry]:
    at = [(change, ZERO + change.at_ns) for change in fault_changes(map(parse_fault, texts))]
    return [("events", at_ns, dict(fault_record(change, at_ns).body)) for change, at_ns in at]


def flown(modes: Iterable[str], timeouts: range = range(0), gap: range = range(0)) -> list[Entry]:
    """Return a flight whose sample k makes a command in mode k, in force two samples later; none in the gap."""
    entries: list[Entry] = []
    held = None
    modes = list(modes)
    for k, mode in enumerate(modes):
        held = k - 2 if k >= 2 and k - 2 not in gap else held
        entries.append(truth(k, ZERO + k * TS, held, k in timeouts))
        if k not in gap:
            entries.append(command(k, ZERO + k * TS + 1, mode))
    return entries


def told(flight: list[Entry], *texts: str) -> list[Recovery]:
    return recoveries(sorted([*flight, *changes(*texts)], key=lambda entry: entry[1]))


LAW, HOLD = ["TRACKING"], ["HOLD"]


def test_the_law_is_back_with_the_first_held_command_that_it_made_since_the_end() -> None:
    [fault] = told(flown(LAW * 40 + HOLD * 20 + LAW * 140), "freeze:relay@1s+0.25s")  # samples 40 to 50
    assert (fault.begin_s, fault.end_s) == (1.0, 1.25)
    assert fault.recovered_s == pytest.approx(62 * 0.025)
    assert longest_recovery_s([fault]) == pytest.approx(0.3)


def test_a_command_made_before_the_end_is_no_recovery() -> None:
    [fault] = told(flown(LAW * 200), "sensor:q_rad_s:nan@1s+0.25s")
    assert fault.recovered_s == pytest.approx(52 * 0.025)  # of sample 50, made at the very end of the fault


def test_a_servo_time_out_and_a_gap_are_no_law() -> None:
    [late] = told(flown(LAW * 200, timeouts=range(40, 70)), "mute:autopilot@1s+0.25s")
    assert late.recovered_s == pytest.approx(70 * 0.025)
    [gap] = told(flown(LAW * 200, gap=range(40, 80)), "kill:autopilot@1s+0.25s")
    assert gap.recovered_s == pytest.approx(82 * 0.025)


def test_a_law_that_loses_the_elevator_within_a_second_has_not_recovered() -> None:
    clock_noticed_late = LAW * 60 + HOLD * 20 + LAW * 120
    [fault] = told(flown(clock_noticed_late), "step:autopilot:0.5s@1s")
    assert (fault.begin_s, fault.end_s) == (1.0, 1.0)
    assert fault.recovered_s == pytest.approx(82 * 0.025)
    [later] = told(flown(LAW * 90 + HOLD * 20 + LAW * 90), "step:autopilot:0.5s@1s")
    assert later.recovered_s == pytest.approx(42 * 0.025)


def test_up_to_the_next_fault_is_long_enough() -> None:
    first, second = told(flown(LAW * 50 + HOLD * 20 + LAW * 130), "disk-full@1s", "freeze:plant@1.25s+0.25s")
    assert first.recovered_s == pytest.approx(42 * 0.025)
    assert second.recovered_s == pytest.approx(72 * 0.025)


def test_faults_with_no_sample_between_them_are_recovered_from_together() -> None:
    texts = ("drift:plant:200ppm@1.001s", "drift:autopilot:-200ppm@1.002s", "disk-full@1.003s")
    assert [fault.recovered_s for fault in told(flown(LAW * 200), *texts)] == [pytest.approx(43 * 0.025)] * 3
    both = told(flown(LAW * 50 + HOLD * 20 + LAW * 130), "step:plant:1s@1.2501s", "step:autopilot:1s@1.2502s")
    assert [fault.recovered_s for fault in both] == [pytest.approx(72 * 0.025)] * 2


@pytest.mark.parametrize("modes", [LAW * 40 + HOLD * 160, LAW * 199 + HOLD, LAW * 40 + ["NEUTRAL"] * 160])
def test_a_law_that_never_comes_back_has_never_recovered_and_a_check_on_that_fails(modes: list[str]) -> None:
    flight = flown(modes) if modes[-2] != "TRACKING" else flown(modes[:45] + HOLD * 155)
    faults = told(flight, "disk-full@0.5s", "kill:relay@1s+0.25s")
    assert [fault.recovered_s is None for fault in faults] == [False, True]
    assert longest_recovery_s(faults) is None
    verdicts = judge([Check("back", "recovery_s", at_most=1e9)], {"diverged": False, "recovery_s": None})
    assert [verdict.passed for verdict in verdicts] == [True, False]


def test_the_law_that_flew_before_is_as_good_as_tracking() -> None:
    conservative = ["CONSERVATIVE"]
    [same] = told(flown(conservative * 200), "freeze:relay@1s+0.25s")
    assert same.recovered_s == pytest.approx(52 * 0.025)
    [weaker] = told(flown(LAW * 40 + conservative * 160), "freeze:relay@1s+0.25s")
    assert weaker.recovered_s is None


def test_a_fault_that_lasts_has_no_end_and_does_not_count() -> None:
    faults = told(flown(LAW * 200), "elevator:stuck@1s", "freeze:relay@2s+0.25s")
    assert (faults[0].end_s, faults[0].recovered_s) == (None, None)
    assert longest_recovery_s(faults) == pytest.approx(0.05)
    assert longest_recovery_s(faults[:1]) is None
    assert recoveries(flown(LAW * 20)) == []
    assert longest_recovery_s([]) is None


def restarted() -> list[Entry]:
    """Return 40 samples, nothing for 20, and 60 of a plant that started again; a command of each is held after two."""
    first = flown(LAW * 40)
    second = [(topic, at_ns + 60 * TS, body) for topic, at_ns, body in flown(LAW * 60)]
    return [*first, *second]


def test_numbers_of_another_start_of_the_plant_are_not_mixed_up() -> None:
    entries = restarted()
    entries += [command(k, ZERO + 50 * TS + k, "TRACKING") for k in range(38, 42)]  # of what was under way
    [fault] = told(entries, "kill:plant@1s+0.5s")
    assert fault.recovered_s == pytest.approx(62 * 0.025)


def test_the_forecasts_of_two_starts_are_scored_each_by_its_own_delays() -> None:
    entries = [(t, at, {**b, "d": 2 + (at > ZERO + 50 * TS)} if t == "autopilot/command" else b)
               for t, at, b in restarted()]  # fmt: skip
    scored = delay_summary(FlightData.from_records(entries, MODEL))
    assert scored["true_histogram"] == {"2": 96}
    assert scored["estimated_exact_fraction"] == pytest.approx(38 / 96)  # those of the first start were right


def test_samples_outside_the_window_are_counted_of_those_whose_delay_is_known() -> None:
    flight = FlightData.from_records(restarted(), MODEL)
    known = np.count_nonzero(~np.isnan(flight.d))
    narrow = replace(HIRM, d_min=1, d_max=1)
    assert outside_fraction(flight, narrow) == 1.0
    assert outside_fraction(flight, HIRM) == 0.0
    one_late = replace(flight, d=np.where(np.arange(len(flight.d)) == 50, 5.0, flight.d))
    assert outside_fraction(one_late, HIRM) == pytest.approx(1 / known)


def test_the_summary_lists_the_faults_counts_the_dead_time_and_says_it_to_people() -> None:
    scenario = load_scenario("nominal")
    entries = sorted([*restarted(), *changes("kill:plant@1s+0.5s", "elevator:stuck@2s")], key=lambda entry: entry[1])
    flight = FlightData.from_records(entries, scenario.plant, {"reference": ""})
    summary = summarise(scenario, entries, flight, virtual=True)
    assert (summary["samples"], summary["duration_s"]) == (100, pytest.approx(120 * 0.025))
    assert sum(summary["mode_s"].values()) == pytest.approx(120 * 0.025)
    assert [fault["fault"] for fault in summary["faults"]] == ["kill:plant@1s+0.5s", "elevator:stuck@2s"]
    assert summary["recovery_s"] == pytest.approx(0.05)
    assert np.isfinite(summary["rms_error_rad"])
    console = Console(width=200, file=StringIO())
    console.print(summary_table(summary, []))
    assert isinstance(console.file, StringIO)
    text = console.file.getvalue()
    assert "kill:plant@1s+0.5s: the law has the elevator 0.05 s after its end" in text
    assert "elevator:stuck@2s: lasts to the end" in text
