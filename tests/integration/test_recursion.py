"""The flight through MAVLink against a direct recursion of Eqs. (4) and (9).

The recursion below knows nothing of nodes, links, frames or clocks. It takes only d(k), xr(j) and w(k) from
the recording and computes the flight again with NumPy.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gains.model import Gains
from sitl.flight import fly_virtual
from sitl.impairment import parse_link
from sitl.recorder import FlightRecorder
from sitl.scenario import Scenario, load_scenario


def recursion(gains: Gains, truth: list[dict], commands: dict[int, dict], x0: np.ndarray) -> np.ndarray:
    """Return x(k) of Eqs. (4) and (9), with the elevator's travel, for every recorded sample."""
    m = gains.model
    xs = [np.array(x0, dtype=float)]
    for k, body in enumerate(truth):
        u = np.zeros(m.nu)
        if body["d"] is not None:
            j = k - body["d"]
            u = gains.K1 @ xs[j]
            if gains.K2 is not None:
                u = u + gains.K2 @ np.array(commands[j]["xr"])
            u = np.clip(u, m.actuator.low, m.actuator.high)
        xs.append(m.A @ xs[k] + m.B @ u + m.E @ np.array(body["w"]))
    return np.array(xs[:-1])


def tables(recorder: FlightRecorder) -> tuple[list[dict], dict[int, dict]]:
    truth = [body for topic, _, body in recorder.kept if topic == "plant/truth"]
    commands = {body["j"]: body for topic, _, body in recorder.kept if topic == "autopilot/command"}
    return truth, commands


def fly(scenario: Scenario) -> tuple[list[dict], dict[int, dict]]:
    recorder = FlightRecorder(None, {})
    fly_virtual(scenario, recorder.write)
    return tables(recorder)


def deviation(scenario: Scenario, truth: list[dict], commands: dict[int, dict]) -> float:
    """Return max |C (x - x')|, the output's difference in rad."""
    m = scenario.gains.model
    x0 = m.trim.x if scenario.x0 is None else scenario.x0
    flown = np.array([body["x"] for body in truth])
    computed = recursion(scenario.gains, truth, commands, x0)
    assert [body["k"] for body in truth] == list(range(len(truth)))
    return float(np.abs((flown - computed) @ m.C.T).max())


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
