"""The understudy flies every stored law, goes the way of the real command, and leaves no trace in the real flight."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from types import FrameType
from typing import Any

import pytest
from click.testing import CliRunner

import autopilot.__main__
from autopilot.app import AutopilotNode
from autopilot.config import AutopilotConfig
from autopilot.failsafe import Mode
from autopilot.link.clock import NS_PER_MS, NS_PER_S, NS_PER_US
from autopilot.link.node import Record
from autopilot.profile import parse_profile
from autopilot.rehearsal import Rehearsal
from gains.model import GainLaw, Schedule
from gains.store import load_gains, load_law, stored
from sitl.flight import virtual_network
from sitl.scenario import load_scenario

SETTLED = 60
"""Samples after which the law flies and the delay is known."""
SAMPLES = 400
LAWS = {entry.name: load_law(entry.name) for entry in stored() if entry.kind != "model"}
HIRM = LAWS["hirm-d6"]
U32 = 1 << 32
MEASUREMENTS = {30, 11020}
"""Message ids of ATTITUDE and AOA_SSA."""


def flown(rehearsal: Rehearsal) -> set[Mode]:
    """Fly, and return the modes of all samples since it has settled."""
    modes = set()
    for k in range(SAMPLES):
        rehearsal.once()
        if k >= SETTLED:
            modes.add(rehearsal.node.pilot.mode)
    assert rehearsal.samples == SAMPLES
    return modes


def delays_right(rehearsal: Rehearsal) -> bool:
    """Whether the understudy has been told, of almost every command, that its forecast was right."""
    delay = rehearsal.node.delay
    return delay.scored > SAMPLES - SETTLED and delay.exact == delay.covered == 1.0


@pytest.mark.parametrize("name", sorted(LAWS))
def test_every_stored_law_flies_and_its_delay_is_known(name: str) -> None:
    rehearsal = Rehearsal(AutopilotConfig(gains=LAWS[name]))
    assert flown(rehearsal) == {Mode.TRACKING}
    assert delays_right(rehearsal)


def _schedule() -> GainLaw:
    near, far = (replace(load_gains(name), certificate=None) for name in ("hirm-d3", "hirm-d6"))
    return Schedule("two", near.model, (near, replace(far, model=near.model, d_min=4)))


OPTIONS = {
    "a window that begins late": AutopilotConfig(replace(HIRM, d_min=3, certificate=None)),
    "a schedule": AutopilotConfig(_schedule()),
    "float commands": AutopilotConfig(HIRM, actuator="float"),
    "no angle of attack": AutopilotConfig(HIRM, alpha="vfr_hud"),
    "armed by hand, ground lost": AutopilotConfig(HIRM, wait_arm=True, ground_timeout_ns=NS_PER_S, ground_stations=2),
    "failsafe that looks on": AutopilotConfig(HIRM, failsafe="monitor"),
    "not aligned": AutopilotConfig(HIRM, align=False),
    "a reference at the stops": AutopilotConfig(HIRM, parse_profile("sine:25deg@0s:0.5Hz", HIRM.model.Ts)),
}


@pytest.mark.parametrize("config", OPTIONS.values(), ids=OPTIONS.keys())
def test_it_flies_whatever_the_autopilot_is_told(config: AutopilotConfig) -> None:
    rehearsal = Rehearsal(config)
    assert flown(rehearsal) == {Mode.TRACKING}
    assert delays_right(rehearsal)
    assert rehearsal.node.delay.forecast(0, 0).d is not None


@pytest.mark.parametrize("wrap_ns", [U32 * NS_PER_US, U32 * NS_PER_MS, (1 << 31) * 25 * NS_PER_MS], ids=str)
def test_it_flies_on_when_counters_wrap(wrap_ns: int) -> None:
    rehearsal = Rehearsal(AutopilotConfig(HIRM), wrap_ns - (SAMPLES - 100) * HIRM.model.Ts_ns)
    assert flown(rehearsal) == {Mode.TRACKING}
    assert delays_right(rehearsal)


def _called(call: Callable[[], None]) -> set[str]:
    """Return which functions of the autopilot a call runs."""
    names = set()

    def note(frame: FrameType, event: str, _argument: object) -> None:
        code = frame.f_code
        if event == "call" and ("/autopilot/" in code.co_filename or code.co_filename == "<string>"):
            names.add(f"{code.co_filename.rpartition('/')[2]}:{code.co_name}")

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        call()
    finally:
        sys.setprofile(before)
    return names


def test_it_goes_the_way_of_the_real_command() -> None:
    """Every function between a measurement in and the command out of a flight is one that the understudy runs."""
    scenario = load_scenario("nominal")
    network, plant = virtual_network(scenario, None)
    node = next(p.node for p in network._participants if p.name == "autopilot")
    assert isinstance(node, AutopilotNode)
    real: set[str] = set()
    receive = node.receive

    def noted(port: str, datagram: bytes, now_ns: int) -> None:
        measurement = int.from_bytes(datagram[7:10], "little") in MEASUREMENTS
        if plant.samples > SETTLED and measurement:
            real.update(_called(partial(receive, port, datagram, now_ns)))
        else:
            receive(port, datagram, now_ns)

    node.receive = noted  # type: ignore[method-assign]
    network.run(lambda: plant.samples >= 2 * SETTLED, 10**11)
    rehearsal = Rehearsal(node.config)
    flown(rehearsal)
    rehearsed = _called(rehearsal.once)
    assert {"delay.py:forecast", "pilot.py:fly", "control.py:command", "wire.py:decode"} <= real
    assert real - rehearsed == set()


def test_the_real_flight_does_not_notice() -> None:
    def records(*, rehearse: bool) -> list[tuple[Record, int]]:
        scenario = load_scenario("nominal")
        written: list[tuple[Record, int]] = []
        network, plant = virtual_network(scenario, lambda record, t_ns: written.append((record, t_ns)))
        node = next(p.node for p in network._participants if p.name == "autopilot")
        assert isinstance(node, AutopilotNode)
        rehearsal = Rehearsal(node.config)

        def ended() -> bool:
            if rehearse:
                rehearsal.once()
            return plant.samples >= 100

        network.run(ended, 10**11)
        assert (rehearsal.samples > 100) is rehearse
        return written

    assert records(rehearse=True) == records(rehearse=False)


@pytest.mark.parametrize("busy", [True, False])
def test_the_program_rehearses_what_it_flies_when_it_never_sleeps(monkeypatch: pytest.MonkeyPatch, busy: bool) -> None:
    given: dict[str, Any] = {}
    monkeypatch.setattr(autopilot.__main__, "run_node", lambda _name, node, *_, **more: given.update(more, node=node))
    line = ["--actuator", "float", *(["--busy"] if busy else []), "--gains", "hirm-d4"]
    assert CliRunner().invoke(autopilot.__main__.cli, line, catch_exceptions=False).exit_code == 0
    assert given["busy"] is busy
    if not busy:
        assert given["idle"] is None
        return
    rehearsal = given["idle"].__self__
    given["idle"]()
    assert isinstance(rehearsal, Rehearsal)
    assert rehearsal.samples == 1
    assert rehearsal.node is not given["node"]
    config = rehearsal.node.config
    assert (config.gains.name, config.actuator) == ("hirm-d4", "float")
