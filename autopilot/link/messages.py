"""The messages of the control link as frozen values; field names and units are the dialect's.

They are named tuples, which are made in a third of the time of a frozen dataclass: twenty for each sample. Two of
different types may compare equal, so what a message is must be asked of its type.

:mod:`autopilot.link.wire` packs and parses them. What only ground stations say and hear is in
:mod:`autopilot.link.groundmessages`.
"""

from __future__ import annotations

from typing import NamedTuple

__all__ = [
    "AoaSsa",
    "Attitude",
    "ControlMessage",
    "Heartbeat",
    "HilActuatorControls",
    "NamedValueFloat",
    "NamedValueInt",
    "ServoOutputRaw",
    "Severity",
    "StatusText",
    "Timesync",
    "VfrHud",
]


class Severity:
    """MAV_SEVERITY of a STATUSTEXT."""

    CRITICAL = 2
    ERROR = 3
    WARNING = 4
    NOTICE = 5
    INFO = 6


class Heartbeat(NamedTuple):
    """HEARTBEAT: MAV_TYPE, MAV_AUTOPILOT, MAV_MODE_FLAG, custom mode, MAV_STATE."""

    type: int
    autopilot: int
    base_mode: int
    custom_mode: int
    system_status: int


class Attitude(NamedTuple):
    """ATTITUDE: milliseconds (u32, wraps), radians, radians per second."""

    time_boot_ms: int
    roll: float
    pitch: float
    yaw: float
    rollspeed: float
    pitchspeed: float
    yawspeed: float


class AoaSsa(NamedTuple):
    """AOA_SSA: microseconds (u64), angle of attack and sideslip in **degrees**."""

    time_usec: int
    AOA: float
    SSA: float


class VfrHud(NamedTuple):
    """VFR_HUD: metres per second, degrees, percent, metres; it carries no time."""

    airspeed: float
    groundspeed: float
    heading: int
    throttle: int
    alt: float
    climb: float


class ServoOutputRaw(NamedTuple):
    """SERVO_OUTPUT_RAW: microseconds (u32, wraps) of the sample the command used; elevator pulse in microseconds."""

    time_usec: int
    servo2_raw: int


class HilActuatorControls(NamedTuple):
    """HIL_ACTUATOR_CONTROLS: microseconds (u64) of the sample the command used; controls[1] from -1 to 1."""

    time_usec: int
    elevator: float


class NamedValueFloat(NamedTuple):
    """NAMED_VALUE_FLOAT: milliseconds (u32, wraps), a name of at most 10 characters, a finite 32-bit float."""

    time_boot_ms: int
    name: str
    value: float


class NamedValueInt(NamedTuple):
    """NAMED_VALUE_INT: milliseconds (u32, wraps), a name of at most 10 characters, a signed 32-bit value."""

    time_boot_ms: int
    name: str
    value: int


class Timesync(NamedTuple):
    """TIMESYNC: a request has tc1 = 0; the reply echoes ts1 and puts its own time into tc1 (nanoseconds)."""

    tc1: int
    ts1: int


class StatusText(NamedTuple):
    """STATUSTEXT: MAV_SEVERITY and up to 50 characters."""

    severity: int
    text: str


ControlMessage = (
    Heartbeat
    | Attitude
    | AoaSsa
    | VfrHud
    | ServoOutputRaw
    | HilActuatorControls
    | NamedValueFloat
    | NamedValueInt
    | Timesync
    | StatusText
)
