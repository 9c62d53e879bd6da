"""A scenario as the options of its three programs, for flights over UDP: what a person could type."""

from __future__ import annotations

from autopilot.link.process import format_clock
from gains.store import model_path
from sitl.aircraft.plants import is_nonlinear
from sitl.aircraft.wind import format_wind
from sitl.faults import aircraft_faults, format_fault
from sitl.link.changes import format_change
from sitl.link.rules import format_rule
from sitl.link.spec import format_spec
from sitl.scenario import Scenario

__all__ = ["autopilot_arguments", "plant_arguments", "relay_arguments"]


def plant_arguments(scenario: Scenario) -> list[str]:
    """Return the options with which ``sitl plant`` builds the scenario's plant."""
    arguments = ["--plant", scenario.plant_name, "--latch", scenario.latch]
    arguments += ["--servo-timeout", str(scenario.servo_timeout or 0)]
    arguments += [] if scenario.aoa else ["--no-aoa"]
    arguments += ["--clock", format_clock(scenario.clocks["plant"])]
    if is_nonlinear(scenario.plant_name):
        arguments += ["--model", str(model_path(scenario.gains_name))]
    if scenario.wind is not None:
        arguments += ["--wind", format_wind(scenario.wind)]
    if scenario.x0 is not None:
        arguments += ["--x0", ",".join(repr(value) for value in scenario.x0.tolist())]
    if scenario.gust is not None:
        arguments += ["--gust", repr(scenario.gust.start_k * scenario.plant.Ts)]
    if scenario.delta is not None:
        arguments += ["--uncertainty", f"{scenario.delta.amplitude!r}:{scenario.delta.half_period}"]
    faults = aircraft_faults(scenario.faults)
    if faults or scenario.wind is not None:
        arguments += ["--seed", str(scenario.seed)]
        arguments += [word for fault in faults for word in ("--fault", format_fault(fault))]
    return arguments


def relay_arguments(scenario: Scenario) -> list[str]:
    """Return the options with which ``sitl relay`` builds the scenario's link."""
    arguments = ["--up", format_spec(scenario.up), "--down", format_spec(scenario.down)]
    if scenario.witness_name is not None:
        arguments += ["--witness", scenario.witness_name]
    arguments += [word for rule in scenario.rules for word in ("--rule", format_rule(rule))]
    arguments += [word for change in scenario.changes for word in ("--at", format_change(change))]
    return [*arguments, "--seed", str(scenario.seed), "--clock", format_clock(scenario.clocks["relay"])]


def autopilot_arguments(scenario: Scenario) -> list[str]:
    """Return the options with which ``autopilot`` builds the scenario's autopilot."""
    arguments = ["--gains", scenario.gains_name, "--actuator", scenario.actuator]
    arguments += ["--failsafe", scenario.failsafe, "--alpha", scenario.alpha]
    arguments += [] if scenario.align else ["--no-align"]
    arguments += ["--clock", format_clock(scenario.clocks["autopilot"])]
    return [*arguments, "--reference", scenario.reference] if scenario.reference else arguments
