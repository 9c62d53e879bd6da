"""Eqs. (4) and (9) run directly over what a flight recorded, to compare the flight with."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from gains.model import Gains
from sitl.scenario import Scenario


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


def tables(records: Iterable[tuple[str, int, Mapping[str, Any]]]) -> tuple[list[dict], dict[int, dict]]:
    """Return the truth of each sample, and the commands by the sample that they used."""
    truth, commands = [], {}
    for topic, _, body in records:
        if topic == "plant/truth":
            truth.append(body)
        elif topic == "autopilot/command":
            commands[body["j"]] = body
    return truth, commands


def deviation(scenario: Scenario, truth: list[dict], commands: dict[int, dict]) -> float:
    """Return max |C (x - x')|, the output's difference in rad."""
    m = scenario.gains.model
    x0 = m.trim.x if scenario.x0 is None else scenario.x0
    flown = np.array([body["x"] for body in truth])
    computed = recursion(scenario.gains, truth, commands, x0)
    assert [body["k"] for body in truth] == list(range(len(truth)))
    return float(np.abs((flown - computed) @ m.C.T).max())
