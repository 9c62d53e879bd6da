"""The comparison controllers in flight, against their own equations run by NumPy over what was recorded."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from gains.baseline import lq
from gains.model import DynamicFeedback, Gains, SmithPredictor
from gains.store import load_gains, load_law
from sitl.flight import fly_virtual
from sitl.link.presets import parse_link
from sitl.recorder import FlightRecorder
from sitl.scenario import Scenario, load_scenario
from tests.integration.recursion import tables


def fly(scenario: Scenario) -> tuple[list[dict[str, Any]], dict[int, dict[str, Any]]]:
    recorder = FlightRecorder(None, {})
    fly_virtual(scenario, recorder.write)
    return tables(recorder.kept)


def scenario_of(gains: str, **changes: Any) -> Scenario:
    return replace(load_scenario("nominal", gains=gains), actuator="float", duration_s=6.0, **changes)


def predictor(gains: Gains, commands: dict[int, dict[str, Any]], j: int) -> float:
    """Return the command of sample j by the predictor's equation, from what was recorded."""
    model, command = gains.model, commands[j]
    x, d = np.array(command["x"]), command["d"]
    for i in range(j - d, j):
        under_way = [n for n in commands if n <= i]
        u = commands[max(under_way)]["u"] if under_way else [0.0]
        x = model.A @ x + model.B @ np.array(u)
    assert gains.K2 is not None
    return float((gains.K1 @ x + gains.K2 @ np.array(command["xr"]))[0])


@pytest.mark.parametrize("link", ["jittery", "lossy"])
def test_the_smith_predictor_flies_its_equation(link: str) -> None:
    gains = load_gains("hirm-smith")
    up, down = parse_link(link, None, None)
    _, commands = fly(scenario_of("hirm-smith", up=up, down=down))
    flown = [j for j, c in commands.items() if c["mode"] == "TRACKING" and not c["saturated"] and c["d"] is not None]
    assert len(flown) > 150
    assert {commands[j]["d"] for j in flown} >= {2, 3}
    assert max(abs(predictor(gains, commands, j) - commands[j]["u"][0]) for j in flown) < 1e-9


def test_with_a_constant_delay_the_smith_predictor_flies_the_loop_without_delay() -> None:
    """After the delay of the first command the aircraft moves as if x(k) were fed back at once."""
    gains = load_gains("hirm-smith")
    model, reference = gains.model, gains.model.reference
    assert reference is not None
    assert gains.K2 is not None
    up, down = parse_link(None, "delay=30ms", "delay=30ms")
    truth, commands = fly(scenario_of("hirm-smith", up=up, down=down))
    first = next(body["k"] for body in truth if body["j"] is not None)
    assert {body["d"] for body in truth[first:]} == {3}
    x, xr = np.array(truth[first]["x"]), np.array(commands[first - 3]["xr"])
    r = [body["r"] for _, body in sorted(commands.items())]
    worst = 0.0
    for k in range(first, len(truth) - 4):
        worst = max(worst, float(np.abs(np.array(truth[k]["x"]) - x).max()))
        x = model.A @ x + model.B @ (gains.K1 @ x + gains.K2 @ xr)
        xr = reference.Ar @ xr + reference.Br @ np.array(r[k])
    assert np.abs(x).max() > 0.01
    assert worst < 1e-6


def dynamic(gains: Gains, commands: dict[int, dict[str, Any]], *, saturates: bool | None) -> float:
    """Return the largest difference between the commands of a flight and those of the controller's recursion."""
    c, reference, worst = gains.controller, gains.model.reference, 0.0
    assert isinstance(c, DynamicFeedback)
    assert reference is not None
    travel = gains.model.actuator
    assert travel is not None
    assert travel.low is not None
    assert travel.high is not None
    xc, last = np.zeros(c.Ac.shape[0]), None
    dx = yr = np.zeros(1)
    limited = 0
    for j in sorted(commands):
        steps = 1 if last is None else j - last
        for step in range(steps):
            if step == steps - 1:
                dx, yr = np.array(commands[j]["x"]), reference.Cr @ np.array(commands[j]["xr"])
            v = c.Cc @ xc + c.Dc @ dx + c.Dcr @ yr
            u = np.clip(v, travel.low, travel.high)
            xc = c.Ac @ xc + c.Bc @ dx + c.Bcr @ yr + c.L @ (u - v)
        last = j
        limited += bool(abs(u[0] - v[0]) > 1e-12)
        worst = max(worst, abs(float(u[0]) - commands[j]["u"][0]))
    assert saturates is None or (limited > 3) is saturates
    return worst


@pytest.mark.parametrize(("reference", "saturates"), [("2deg@1s", False), ("40deg@1s", True)])
def test_the_sliding_mode_flies_its_equations(reference: str, saturates: bool) -> None:
    gains = load_gains("hirm-dfsm")
    _, commands = fly(scenario_of("hirm-dfsm", reference=reference, failsafe="monitor"))
    assert len(commands) > 200
    assert dynamic(gains, commands, saturates=saturates) < 1e-9


def test_over_lost_samples_the_sliding_mode_goes_on_with_the_last_it_saw() -> None:
    up, down = parse_link(None, "delay=10ms,loss=0.1", "delay=10ms")
    _, commands = fly(scenario_of("hirm-dfsm", up=up, down=down, reference="2deg@1s", failsafe="monitor"))
    assert len(commands) < 230  # of 240: of each sample both messages must arrive
    assert dynamic(load_gains("hirm-dfsm"), commands, saturates=None) < 1e-9


@pytest.mark.parametrize("gains", ["hirm-lq", "hirm-smith", "hirm-dfsm"])
def test_each_comes_back_after_a_blackout_without_a_jump(gains: str) -> None:
    up, down = parse_link(None, "delay=15ms,blackout=3s:1s", "delay=15ms,blackout=3s:1s")
    truth, commands = fly(scenario_of(gains, up=up, down=down, reference="2deg@1s"))
    modes = [c["mode"] for _, c in sorted(commands.items())]
    assert "HOLD" in modes or "NEUTRAL" in modes
    assert modes[-1] == "TRACKING"
    at = [n for n, (a, b) in enumerate(pairwise(modes)) if a != "TRACKING" and b == "TRACKING"][-1]
    ordered = [c for _, c in sorted(commands.items())]
    assert abs(ordered[at + 1]["u"][0] - ordered[at]["u"][0]) < 0.01
    assert not any(body["timeout"] for body in truth[-10:])


def test_nothing_is_proved_of_them_and_the_autopilot_says_so() -> None:
    for name in ("hirm-smith", "hirm-dfsm"):
        law = load_law(name)
        assert isinstance(law, Gains)
        assert law.certificate is None
    assert isinstance(load_gains("hirm-smith").controller, SmithPredictor)


def test_the_predictor_has_the_gains_of_lq() -> None:
    made, stored = lq(load_gains("hirm-paper").model, (1, 6), "lq"), load_gains("hirm-smith")
    assert np.abs(made.K1 - stored.K1).max() < 1e-9
