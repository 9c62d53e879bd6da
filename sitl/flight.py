"""One flight in virtual time: the scenario's three nodes in one process, recorded or not."""

from __future__ import annotations

from collections.abc import Callable

from autopilot.link.clock import NS_PER_S
from autopilot.link.node import Node, Record
from autopilot.link.record import frame_record
from autopilot.link.virtual import Participant, VirtualNetwork
from sitl.plant import PlantNode
from sitl.scenario import Scenario

__all__ = ["WIRES", "fly_virtual", "virtual_network"]

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
        "relay": scenario.relay_node(),
        "autopilot": scenario.autopilot_node(ground_stations),
    }
    participants = [Participant(name, node, scenario.clocks[name]) for name, node in nodes.items()]
    if write is None:
        return VirtualNetwork(participants, WIRES), plant
    clock = scenario.clocks["autopilot"]

    def tap(_node: str, port: str, direction: str, datagram: bytes, true_ns: int) -> None:
        write(frame_record(port, clock.node_ns(true_ns), direction, datagram), true_ns)

    return VirtualNetwork(participants, WIRES, write, tap, ("autopilot",)), plant


def fly_virtual(
    scenario: Scenario,
    write: Write | None = None,
    *,
    ground_stations: int = 1,
    stopping: Callable[[], bool] = lambda: False,
) -> int:
    """Fly a scenario in virtual time and return the true time at its end, ns.

    Parameters
    ----------
    scenario, write, ground_stations
        As for :func:`virtual_network`.
    stopping : callable
        Asked before each event; True ends the flight early.
    """
    network, plant = virtual_network(scenario, write, ground_stations=ground_stations)
    samples = scenario.samples
    limit_ns = START_UP_LIMIT_NS + round(samples * scenario.plant.Ts_ns * 1.01)
    network.run(lambda: plant.samples >= samples or stopping(), limit_ns)
    return network.now_ns
