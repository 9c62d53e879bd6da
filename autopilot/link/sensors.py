"""Which MAVLink field carries which state: ``[sensors]`` of the model file, for both ends of the link.

The plant writes a state into its field, the autopilot reads it back; units differ (AOA_SSA is in
degrees), so one table serves both directions.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from autopilot.link.clock import NS_PER_MS
from autopilot.link.wire import AoaSsa, Attitude
from gains.model import Model
from gains.table import InputError

__all__ = ["MIN_TS_NS", "Measurement", "Sensor", "pitch_index", "sensors_of"]

Measurement = Attitude | AoaSsa

MIN_TS_NS = 4 * NS_PER_MS
"""Shortest sampling period that ATTITUDE's 1 ms stamps can resolve with room to spare."""


@dataclass(frozen=True, slots=True)
class Sensor:
    """A field of a message that carries one state.

    Attributes
    ----------
    message : type
        Attitude or AoaSsa.
    field : str
        The field's name.
    to_field : float
        Field value = state (rad, rad/s) * to_field.
    """

    message: type[Measurement]
    field: str
    to_field: float


_SENSORS: Mapping[str, Sensor] = {
    **{
        f"ATTITUDE.{field}": Sensor(Attitude, field, 1.0)
        for field in ("roll", "pitch", "yaw", "rollspeed", "pitchspeed", "yawspeed")
    },
    **{f"AOA_SSA.{field}": Sensor(AoaSsa, field, math.degrees(1.0)) for field in ("AOA", "SSA")},
}


def sensors_of(model: Model) -> tuple[Sensor, ...]:
    """Return the sensor of each state, in the order of the states.

    Raises
    ------
    InputError
        When the model cannot be flown over these messages: a state without sensor, an unknown or doubly
        used field, or samples that follow each other faster than the stamps can tell apart.
    """
    if model.Ts_ns < MIN_TS_NS:
        raise InputError(f"{model.name}: Ts: expected at least {MIN_TS_NS / 1e9} s for flight, found {model.Ts}")
    used: dict[str, str] = {}
    sensors = []
    for state in model.states:
        name = model.sensors.get(state, "none")
        if name not in _SENSORS:
            known = ", ".join(_SENSORS)
            raise InputError(f"{model.name}: sensors.{state}: expected one of {known}, found {name}")
        if name in used:
            raise InputError(f"{model.name}: sensors.{state}: {name} already carries {used[name]}")
        used[name] = state
        sensors.append(_SENSORS[name])
    return tuple(sensors)


def pitch_index(model: Model) -> int | None:
    """Return which state is the pitch angle; None where none is."""
    carried = [model.sensors.get(state) for state in model.states]
    return carried.index("ATTITUDE.pitch") if "ATTITUDE.pitch" in carried else None
