"""The flight through MAVLink against a direct recursion of Eqs. (4) and (9).

The recursion knows nothing of nodes, links, frames or clocks. It takes only d(k), xr(j) and w(k) from
the recording and computes the flight again with NumPy.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from autopilot.link.clock import Clock
from sitl.flight import fly_virtual
from sitl.flightdata import FlightData
from sitl.link.presets import parse_link
from sitl.recorder import FlightRecorder
from sitl.scenario import Scenario, load_scenario
from tests.integration.recursion import deviation, tables


def fly(scenario: Scenario) -> tuple[list[dict], dict[int, dict]]:
    recorder = FlightRecorder(None, {})
    fly_virtual(scenario, recorder.write)
    return tables(recorder.kept)


@pytest.mark.parametrize("name", ["nominal", "gust", "pendulum"])
@pytest.mark.parametrize("seed", [1, 7, 42])
def test_a_flight_with_float_commands_is_the_recursion_to_1e_5_rad(name: str, seed: int) -> None:
    duration_s = 400 * load_scenario(name).plant.Ts
    scenario = replace(load_scenario(name), actuator="float", seed=seed, duration_s=duration_s)
    truth, commands = fly(scenario)
    assert len(truth) == 400
    assert {body["d"] for body in truth} >= {1, 2}
    assert deviation(scenario, truth, commands) < 1e-5


def test_a_large_step_saturates_the_elevator_and_is_still_the_recursion() -> None:
    scenario = replace(load_scenario("nominal"), actuator="float", reference="40deg@1s")
    truth, commands = fly(scenario)
    limit = scenario.plant.actuator.high[0]
    assert sum(abs(body["u"][0]) > limit - 1e-6 for body in truth) > 5
    assert deviation(scenario, truth, commands) < 1e-5


@pytest.mark.parametrize("seed", [1, 7, 42])
def test_a_flight_with_pulses_is_the_recursion_to_2e_4_rad(seed: int) -> None:
    scenario = replace(load_scenario("nominal"), actuator="pwm", seed=seed)
    truth, commands = fly(scenario)
    assert 1e-7 < deviation(scenario, truth, commands) < 2e-4


@pytest.mark.parametrize("delay", ["0ms", "12ms", "30ms"])
def test_with_a_constant_delay_the_reference_state_of_a_command_is_that_of_equation_8_when_applied(delay: str) -> None:
    up, down = parse_link(None, f"delay={delay}", f"delay={delay}")
    scenario = replace(load_scenario("nominal"), up=up, down=down)
    truth, commands = fly(scenario)
    reference = scenario.gains.model.reference
    assert reference is not None
    xr, r = np.zeros(3), [0.0]
    checked = 0
    for body in truth:
        k = body["k"]
        if body["j"] is not None:
            assert np.abs(np.array(commands[body["j"]]["xr"]) - xr).max() < 1e-12
            checked += 1
        r = commands[k]["r"] if k in commands else r  # the commands of the last samples are still under way
        xr = reference.Ar @ xr + reference.Br @ np.array(r)
    assert checked > 390
    assert np.abs(xr).max() > 0.05


@pytest.mark.parametrize("wraps_at_s", [4294.967296, 4294967.296], ids=["u32 us", "u32 ms"])
def test_a_flight_across_a_wrap_of_the_plants_stamps_is_the_recursion(wraps_at_s: float) -> None:
    scenario = replace(load_scenario("nominal"), actuator="float")
    clocks = {**scenario.clocks, "plant": Clock(round((wraps_at_s - 5.0) * 1e9), 40_000)}
    truth, commands = fly(replace(scenario, clocks=clocks))
    assert truth[0]["t_ns"] < wraps_at_s * 1e9 < truth[-1]["t_ns"]
    assert max(body["d"] for body in truth if body["d"] is not None) <= 3
    assert deviation(scenario, truth, commands) < 1e-5


def test_clocks_that_all_start_at_zero_fly_too() -> None:
    scenario = load_scenario("nominal")
    up, down = parse_link("perfect", None, None)
    clocks = dict.fromkeys(scenario.clocks, Clock())
    truth, commands = fly(replace(scenario, actuator="float", up=up, down=down, clocks=clocks))
    assert len(truth) == 400
    assert deviation(scenario, truth, commands) < 1e-5


def test_the_error_of_an_outage_is_against_the_reference_that_was_programmed() -> None:
    scenario = replace(load_scenario("blackout"), reference="5deg@1s,0deg@2s")
    recorder = FlightRecorder(None, {"reference": scenario.reference})
    fly_virtual(scenario, recorder.write)
    flight = FlightData.from_records(recorder.kept, scenario.plant, recorder.metadata)
    reference, xr = scenario.plant.reference, np.zeros(3)
    assert reference is not None
    for k in range(scenario.samples):
        assert abs(flight.reference[k, 0] - (reference.Cr @ xr)[0]) < 1e-12
        xr = reference.Ar @ xr + reference.Br[:, 0] * (np.radians(5.0) if 40 <= k < 80 else 0.0)
