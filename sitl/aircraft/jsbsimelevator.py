"""What an aircraft's file says of its elevator: travel, speed and lag, by reading JSBSim's flight control system.

From the component that moves the surface it goes up the wire, over ``aerosurface_scale`` (travel), ``actuator``
(travel, lag, rate) and ``kinematic`` (travel and rate), and ends where anything else stands. What an aircraft does not
say so is None.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

from sitl.aircraft.jsbsimload import SURFACE

__all__ = ["Elevator", "elevator_of"]

MAX_COMPONENTS = 8
"""So far up the wire; no aircraft of JSBSim has more in a row."""


@dataclass(frozen=True, slots=True)
class Elevator:
    """An elevator's surface.

    Attributes
    ----------
    low, high : float or None
        Travel, rad.
    rate : float or None
        Its fastest motion, rad/s.
    tau : float or None
        Its lag, s.
    """

    low: float | None = None
    high: float | None = None
    rate: float | None = None
    tau: float | None = None

    def within(self, low: float, high: float) -> Elevator:
        """Return it with its travel limited."""
        return replace(
            self,
            low=low if self.low is None else max(low, self.low),
            high=high if self.high is None else min(high, self.high),
        )

    def slower(self, rate: float) -> Elevator:
        """Return it with its rate limited."""
        return replace(self, rate=rate if self.rate is None else min(rate, self.rate))


def elevator_of(path: Path) -> Elevator:
    """Return what a file says of its elevator.

    Parameters
    ----------
    path : Path
        An aircraft's file that JSBSim loads.
    """
    components = [part for part in _flight_control(path).iter() if part.find("input") is not None]
    moved = [part for part in components if SURFACE in _outputs(part)]
    elevator, scale = Elevator(), 1.0
    for _ in range(MAX_COMPONENTS):
        if not moved:
            break
        part = moved[-1]  # the last one to write wins
        if part.tag == "aerosurface_scale":
            (low, high), domain, gain = _span(part, "range"), _span(part, "domain"), _number(part, "gain", 1.0)
            elevator = elevator.within(scale * gain * low, scale * gain * high)
            scale *= gain * (high - low) / (domain[1] - domain[0])
        elif part.tag == "actuator":
            elevator = _of_actuator(elevator, part, scale)
        elif part.tag == "kinematic":
            elevator = _of_kinematic(elevator, part, scale)
        else:
            break
        wire = (part.findtext("input") or "").strip()
        moved = [part for part in components if wire in _outputs(part)]
    return elevator


def _of_actuator(elevator: Elevator, part: ElementTree.Element, scale: float) -> Elevator:
    """Return the elevator behind an actuator."""
    if part.find("clipto") is not None:
        low, high = _span(part, "clipto")
        elevator = elevator.within(scale * low, scale * high)
    if lag := _number(part, "lag", 0.0):  # C1 of C1 / (s + C1)
        elevator = replace(elevator, tau=1.0 / lag + (elevator.tau or 0.0))
    if rate := _number(part, "rate_limit", 0.0):
        elevator = elevator.slower(scale * rate)
    return elevator


def _of_kinematic(elevator: Elevator, part: ElementTree.Element, scale: float) -> Elevator:
    """Return the elevator behind a kinematic: each setting's time is that of the way to it from the one before."""
    settings = [
        (_number(each, "position", 0.0), _number(each, "time", 0.0)) for each in part.findall("traverse/setting")
    ]
    positions = [position for position, _ in settings]
    if len(positions) < 2:
        return elevator
    elevator = elevator.within(scale * min(positions), scale * max(positions))
    pairs = pairwise(settings)
    rates = [abs(after - before) / time for (before, _), (after, time) in pairs if time > 0.0]
    return elevator.slower(scale * min(rates)) if rates else elevator


def _flight_control(path: Path) -> ElementTree.Element:
    """Return the flight control system, from the file beside where it is in one."""
    found = ElementTree.parse(path).getroot().find("flight_control")
    beside = None if found is None else found.get("file")
    if beside is not None:
        named = path.parent / (beside if beside.endswith(".xml") else f"{beside}.xml")
        found = ElementTree.parse(named).getroot() if named.is_file() else None
    return ElementTree.Element("flight_control") if found is None else found


def _outputs(part: ElementTree.Element) -> list[str]:
    """Return the properties that a component writes."""
    name = part.get("name", "").strip()
    own = name if "/" in name else "fcs/" + "-".join(name.lower().split())
    return [own, *((each.text or "").strip() for each in part.findall("output"))]


def _span(part: ElementTree.Element, name: str) -> tuple[float, float]:
    """Return a table's min and max, as JSBSim takes it where it is not there."""
    table = part.find(name)
    return (-1.0, 1.0) if table is None else (_number(table, "min", -1.0), _number(table, "max", 1.0))


def _number(part: ElementTree.Element, name: str, default: float) -> float:
    """Return a number; what stands for a property, or is no number, is the default."""
    try:
        return float(part.findtext(name) or default)
    except ValueError:
        return default
