"""One flight in virtual time: the scenario's three nodes in one process, recorded or not, and what befalls them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from autopilot.link.clock import NS_PER_S
from autopilot.link.node import Node, Record
from autopilot.link.record import frame_record
from autopilot.link.virtual import MAX_WAITING as DEFAULT_WAITING
from autopilot.link.virtual import Participant, VirtualNetwork
from sitl.faults import (
    ClockDrift,
    ClockStep,
    CorruptGains,
    Fault,
    FaultChange,
    Freeze,
    Kill,
    Mute,
    Phase,
    fault_changes,
    fault_record,
)
from sitl.plant import PlantNode
from sitl.scenario import Scenario

__all__ = ["WIRES", "fly_virtual", "virtual_network"]

MAX_WAITING = {"relay": 8192}
"""Datagrams that wait for a frozen program which asks for more room than is usual: the relay."""

START_UP_LIMIT_NS = 30 * NS_PER_S
"""A flight whose clockwork has not started by then never will."""

WIRES = {
    ("plant", "autopilot"): ("relay", "plant"),
    ("relay", "plant"): ("plant", "autopilot"),
    ("autopilot", "plant"): ("relay", "autopilot"),
    ("relay", "autopilot"): ("autopilot", "plant"),
}
"""Who is joined to whom: plant - relay - autopilot."""

Write = Callable[[Record, int], None]


def virtual_network(
    scenario: Scenario, write: Write | None, *, ground_stations: int = 1
) -> tuple[VirtualNetwork, PlantNode]:
    """Return the scenario's network, ready to run, and its plant.

    Parameters
    ----------
    scenario : Scenario
        What flies.
    write : callable or None
        Takes each record and its true time in ns; None records nothing.
    ground_stations : int
        Ports on which the autopilot sends telemetry; nobody listens in virtual time.
    """
    plant = scenario.plant_node()
    nodes: dict[str, Node] = {
        "plant": plant,
        "relay": scenario.relay_node() if write is not None else scenario.relay_node(log_rate=0),
        "autopilot": scenario.autopilot_node(ground_stations),
    }
    participants = [
        Participant(name, node, scenario.clocks[name], MAX_WAITING.get(name, DEFAULT_WAITING))
        for name, node in nodes.items()
    ]
    if write is None:
        return VirtualNetwork(participants, WIRES), plant

    def tap(_node: str, port: str, direction: str, datagram: bytes, true_ns: int) -> None:
        write(frame_record(port, network.clock("autopilot").node_ns(true_ns), direction, datagram), true_ns)

    network = VirtualNetwork(participants, WIRES, write, tap, ("autopilot",))
    return network, plant


def fly_virtual(
    scenario: Scenario,
    write: Write | None = None,
    *,
    ground_stations: int = 1,
    stopping: Callable[[], bool] = lambda: False,
    on_fault: Callable[[Fault], None] = lambda _: None,
) -> int:
    """Fly a scenario in virtual time and return the true time at its end, ns.

    A flight with faults ends by true time, as its plant may start again, or not at all.

    Parameters
    ----------
    scenario, write, ground_stations
        As for :func:`virtual_network`.
    stopping : callable
        Asked before each event; True ends the flight early.
    on_fault : callable
        Told of each fault as it begins; a full disk is for the caller to bring about.
    """
    network, plant = virtual_network(scenario, write, ground_stations=ground_stations)
    samples = scenario.samples
    if scenario.faults:
        network.run(lambda: plant.samples > 0 or stopping(), START_UP_LIMIT_NS)
        if plant.samples:
            _Faults(network, scenario, ground_stations, write, on_fault).fly(stopping)
        return network.now_ns
    limit_ns = START_UP_LIMIT_NS + round(samples * scenario.plant.Ts_ns * 1.01)
    network.run(lambda: plant.samples >= samples or stopping(), limit_ns)
    return network.now_ns


class _Faults:
    """A flight with faults, from its sample k = 0 on.

    Parameters
    ----------
    network : VirtualNetwork
        Whose time is that of sample k = 0.
    scenario, ground_stations, write, on_fault
        As for :func:`fly_virtual`.
    """

    def __init__(
        self,
        network: VirtualNetwork,
        scenario: Scenario,
        ground_stations: int,
        write: Write | None,
        on_fault: Callable[[Fault], None],
    ) -> None:
        self._network = network
        self._scenario = scenario
        self._ground_stations = ground_stations
        self._write = write
        self._on_fault = on_fault
        self._zero_ns = network.now_ns

    def fly(self, stopping: Callable[[], bool]) -> None:
        """Fly to the end, through all that goes wrong."""
        Ts_ns = self._scenario.plant.Ts_ns
        end_ns = self._zero_ns + self._scenario.samples * Ts_ns - Ts_ns // 2  # the last sample is in, whatever drifts
        for change in fault_changes(self._scenario.faults):
            at_ns = self._zero_ns + change.at_ns
            if at_ns > end_ns:
                break
            self._network.run(stopping, at_ns)
            if stopping():
                return
            self._make(change)
        self._network.run(stopping, end_ns)

    def _make(self, change: FaultChange) -> None:
        """Tell of a fault that begins or ends, and let it; in this order, as a full disk takes no word of itself."""
        if self._write is not None:
            now_ns = self._network.now_ns
            self._write(fault_record(change, now_ns), now_ns)
        if change.phase is Phase.BEGIN:
            self._begin(change.fault)
            self._on_fault(change.fault)
        else:
            self._end(change.fault)

    def _begin(self, fault: Fault) -> None:
        match fault:
            case Kill(program=program):
                self._network.kill(program)
            case CorruptGains():
                self._network.kill("autopilot")  # started with a damaged file it refuses to fly
            case Freeze(program=program):
                self._network.freeze(program)
            case Mute(program=program):
                self._network.mute(program, True)
            case ClockStep(program=program, by_ns=by_ns):
                self._network.step_clock(program, by_ns)
            case ClockDrift(program=program, drift_ppb=drift_ppb):
                self._network.drift_clock(program, drift_ppb)
            case _:
                pass  # the plant's own, or the caller's

    def _end(self, fault: Fault) -> None:
        match fault:
            case Kill(program=program):
                self._restart(program)
            case CorruptGains():
                self._restart("autopilot")
            case Freeze(program=program):
                self._network.thaw(program)
            case Mute(program=program):
                self._network.mute(program, False)
            case _:
                pass

    def _restart(self, program: str) -> None:
        """Start a program as it was started at first; its clock begins again where it began."""
        clock = replace(self._scenario.clocks[program], boot_ns=self._network.now_ns)
        self._network.replace(program, self._node(program), clock)

    def _node(self, program: str) -> Node:
        match program:
            case "plant":
                return self._scenario.plant_node()
            case "relay":
                return self._scenario.relay_node()
            case _:
                return self._scenario.autopilot_node(self._ground_stations)
