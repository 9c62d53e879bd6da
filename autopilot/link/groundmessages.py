"""The messages between a vehicle and its ground stations, as frozen values; field names and units are the dialect's.

What the control link carries is in :mod:`autopilot.link.messages`; :mod:`autopilot.link.wire` packs and parses both.
A field of the dialect that is not here is sent as zero and ignored when received. Numbers that a ground station
sends are not checked here: NaN is a legitimate "not used" in a command.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum, IntFlag

__all__ = [
    "AttitudeTarget",
    "AutopilotVersion",
    "AvailableModes",
    "Capability",
    "CommandAck",
    "CommandInt",
    "CommandLong",
    "CurrentMode",
    "ExtendedSysState",
    "FileTransferProtocol",
    "GlobalPositionInt",
    "GroundMessage",
    "HomePosition",
    "LogEntry",
    "LogRequestList",
    "ManualControl",
    "MavCmd",
    "MavResult",
    "MessageInterval",
    "MissionAck",
    "MissionClearAll",
    "MissionCount",
    "MissionRequest",
    "MissionRequestInt",
    "MissionRequestList",
    "ParamError",
    "ParamErrorCode",
    "ParamRequestList",
    "ParamRequestRead",
    "ParamSet",
    "ParamValue",
    "Ping",
    "RcChannelsOverride",
    "RequestDataStream",
    "SensorBit",
    "SetAttitudeTarget",
    "SetMode",
    "SysStatus",
]


class MavCmd(IntEnum):
    """MAV_CMD: the commands that are served."""

    DO_SET_MODE = 176
    PREFLIGHT_STORAGE = 245
    COMPONENT_ARM_DISARM = 400
    RUN_PREARM_CHECKS = 401
    GET_HOME_POSITION = 410
    GET_MESSAGE_INTERVAL = 510
    SET_MESSAGE_INTERVAL = 511
    REQUEST_MESSAGE = 512
    REQUEST_AUTOPILOT_CAPABILITIES = 520


class MavResult(IntEnum):
    """MAV_RESULT of a COMMAND_ACK."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4


class ParamErrorCode(IntEnum):
    """MAV_PARAM_ERROR of a PARAM_ERROR."""

    DOES_NOT_EXIST = 1
    VALUE_OUT_OF_RANGE = 2
    PERMISSION_DENIED = 3
    COMPONENT_NOT_FOUND = 4
    READ_ONLY = 5


class Capability(IntFlag):
    """MAV_PROTOCOL_CAPABILITY of an AUTOPILOT_VERSION."""

    PARAM_FLOAT = 2
    COMMAND_INT = 8
    SET_ATTITUDE_TARGET = 64
    MAVLINK2 = 8192
    PARAM_ENCODE_C_CAST = 131072


class SensorBit(IntFlag):
    """MAV_SYS_STATUS_SENSOR bits of a SYS_STATUS."""

    GYRO = 1
    ANGULAR_RATE_CONTROL = 1024
    ATTITUDE_STABILIZATION = 2048
    MOTOR_OUTPUTS = 32768
    GEOFENCE = 1 << 20
    AHRS = 1 << 21
    PREARM_CHECK = 1 << 28


@dataclass(frozen=True, slots=True)
class Ping:
    """PING: a request has targets 0; the answer carries the asker's. Microseconds."""

    time_usec: int
    seq: int
    target_system: int
    target_component: int


@dataclass(frozen=True, slots=True)
class CommandLong:
    """COMMAND_LONG: MAV_CMD with seven floats; NaN or 0 where unused."""

    target_system: int
    target_component: int
    command: int
    confirmation: int
    param1: float
    param2: float
    param3: float
    param4: float
    param5: float
    param6: float
    param7: float


@dataclass(frozen=True, slots=True)
class CommandInt:
    """COMMAND_INT: the same with a frame, and scaled integers for x and y (params 5 and 6)."""

    target_system: int
    target_component: int
    frame: int
    command: int
    param1: float
    param2: float
    param3: float
    param4: float
    x: int
    y: int
    z: float


@dataclass(frozen=True, slots=True)
class CommandAck:
    """COMMAND_ACK: MAV_CMD and MAV_RESULT, to the system and component that asked."""

    command: int
    result: int
    target_system: int
    target_component: int


@dataclass(frozen=True, slots=True)
class ParamRequestRead:
    """PARAM_REQUEST_READ: by index, or by name where the index is -1."""

    target_system: int
    target_component: int
    param_id: str
    param_index: int


@dataclass(frozen=True, slots=True)
class ParamRequestList:
    """PARAM_REQUEST_LIST."""

    target_system: int
    target_component: int


@dataclass(frozen=True, slots=True)
class ParamSet:
    """PARAM_SET: name of at most 16 characters, value, MAV_PARAM_TYPE."""

    target_system: int
    target_component: int
    param_id: str
    param_value: float
    param_type: int


@dataclass(frozen=True, slots=True)
class ParamValue:
    """PARAM_VALUE: the answer to all of the above."""

    param_id: str
    param_value: float
    param_type: int
    param_count: int
    param_index: int


@dataclass(frozen=True, slots=True)
class ParamError:
    """PARAM_ERROR: why a parameter was not read or set (MAV_PARAM_ERROR)."""

    target_system: int
    target_component: int
    param_id: str
    param_index: int
    error: int


@dataclass(frozen=True, slots=True)
class RequestDataStream:
    """REQUEST_DATA_STREAM: MAV_DATA_STREAM, Hz, 1 to start or 0 to stop."""

    target_system: int
    target_component: int
    req_stream_id: int
    req_message_rate: int
    start_stop: int


@dataclass(frozen=True, slots=True)
class SetMode:
    """SET_MODE, the message that DO_SET_MODE has replaced."""

    target_system: int
    base_mode: int
    custom_mode: int


@dataclass(frozen=True, slots=True)
class MissionRequestList:
    """MISSION_REQUEST_LIST of a MAV_MISSION_TYPE: mission 0, fence 1, rally 2."""

    target_system: int
    target_component: int
    mission_type: int


@dataclass(frozen=True, slots=True)
class MissionRequest:
    """MISSION_REQUEST of one item."""

    target_system: int
    target_component: int
    seq: int
    mission_type: int


@dataclass(frozen=True, slots=True)
class MissionRequestInt:
    """MISSION_REQUEST_INT of one item."""

    target_system: int
    target_component: int
    seq: int
    mission_type: int


@dataclass(frozen=True, slots=True)
class MissionCount:
    """MISSION_COUNT: how many items there are, or will be sent."""

    target_system: int
    target_component: int
    count: int
    mission_type: int


@dataclass(frozen=True, slots=True)
class MissionClearAll:
    """MISSION_CLEAR_ALL."""

    target_system: int
    target_component: int
    mission_type: int


@dataclass(frozen=True, slots=True)
class MissionAck:
    """MISSION_ACK with a MAV_MISSION_RESULT in ``type``."""

    target_system: int
    target_component: int
    type: int
    mission_type: int


@dataclass(frozen=True, slots=True)
class FileTransferProtocol:
    """FILE_TRANSFER_PROTOCOL: 251 bytes of its own."""

    target_network: int
    target_system: int
    target_component: int
    payload: bytes


@dataclass(frozen=True, slots=True)
class LogRequestList:
    """LOG_REQUEST_LIST."""

    target_system: int
    target_component: int


@dataclass(frozen=True, slots=True)
class LogEntry:
    """LOG_ENTRY; there are no logs on board where ``num_logs`` is 0."""

    id: int
    num_logs: int
    last_log_num: int


@dataclass(frozen=True, slots=True)
class SetAttitudeTarget:
    """SET_ATTITUDE_TARGET: milliseconds (u32), type mask, quaternion w x y z, rad/s, thrust from 0 to 1."""

    time_boot_ms: int
    target_system: int
    target_component: int
    type_mask: int
    q: tuple[float, ...]
    body_roll_rate: float
    body_pitch_rate: float
    body_yaw_rate: float
    thrust: float


@dataclass(frozen=True, slots=True)
class AttitudeTarget:
    """ATTITUDE_TARGET: what is flown, in the terms of SET_ATTITUDE_TARGET."""

    time_boot_ms: int
    type_mask: int
    q: tuple[float, ...]
    body_roll_rate: float
    body_pitch_rate: float
    body_yaw_rate: float
    thrust: float


@dataclass(frozen=True, slots=True)
class ManualControl:
    """MANUAL_CONTROL to system ``target``: a stick; x from -1000 (back) to 1000 (forward), 32767 for unused."""

    target: int
    x: int
    y: int
    z: int
    r: int
    buttons: int


@dataclass(frozen=True, slots=True)
class RcChannelsOverride:
    """RC_CHANNELS_OVERRIDE: the pitch channel's pulse in microseconds; 65535 is ignored, 0 gives it back."""

    target_system: int
    target_component: int
    chan2_raw: int


@dataclass(frozen=True, slots=True)
class SysStatus:
    """SYS_STATUS: sensor bits; load in per mille; 65535 mV, -1 cA and -1 % are a battery that is not known."""

    onboard_control_sensors_present: int
    onboard_control_sensors_enabled: int
    onboard_control_sensors_health: int
    load: int
    voltage_battery: int
    current_battery: int
    battery_remaining: int
    drop_rate_comm: int
    errors_comm: int


@dataclass(frozen=True, slots=True)
class GlobalPositionInt:
    """GLOBAL_POSITION_INT: 1e-7 degrees, millimetres, cm/s north, east, down, heading in 0.01 degrees."""

    time_boot_ms: int
    lat: int
    lon: int
    alt: int
    relative_alt: int
    vx: int
    vy: int
    vz: int
    hdg: int


@dataclass(frozen=True, slots=True)
class HomePosition:
    """HOME_POSITION: 1e-7 degrees and millimetres, the local position and attitude there, microseconds."""

    latitude: int
    longitude: int
    altitude: int
    q: tuple[float, ...]
    time_usec: int


@dataclass(frozen=True, slots=True)
class AutopilotVersion:
    """AUTOPILOT_VERSION: MAV_PROTOCOL_CAPABILITY bits, version as major, minor, patch and type in one byte each."""

    capabilities: int
    flight_sw_version: int
    flight_custom_version: bytes
    uid: int


@dataclass(frozen=True, slots=True)
class MessageInterval:
    """MESSAGE_INTERVAL: microseconds, -1 for off, 0 for a message that is not to be had."""

    message_id: int
    interval_us: int


@dataclass(frozen=True, slots=True)
class ExtendedSysState:
    """EXTENDED_SYS_STATE: MAV_VTOL_STATE and MAV_LANDED_STATE."""

    vtol_state: int
    landed_state: int


@dataclass(frozen=True, slots=True)
class AvailableModes:
    """AVAILABLE_MODES: one mode of ``number_modes``, numbered from 1."""

    number_modes: int
    mode_index: int
    standard_mode: int
    custom_mode: int
    properties: int
    mode_name: str


@dataclass(frozen=True, slots=True)
class CurrentMode:
    """CURRENT_MODE: MAV_STANDARD_MODE (0: none of these), custom mode now and the one intended."""

    standard_mode: int
    custom_mode: int
    intended_custom_mode: int


GroundMessage = (
    Ping
    | CommandLong
    | CommandInt
    | CommandAck
    | ParamRequestRead
    | ParamRequestList
    | ParamSet
    | ParamValue
    | ParamError
    | RequestDataStream
    | SetMode
    | MissionRequestList
    | MissionRequest
    | MissionRequestInt
    | MissionCount
    | MissionClearAll
    | MissionAck
    | FileTransferProtocol
    | LogRequestList
    | LogEntry
    | SetAttitudeTarget
    | AttitudeTarget
    | ManualControl
    | RcChannelsOverride
    | SysStatus
    | GlobalPositionInt
    | HomePosition
    | AutopilotVersion
    | MessageInterval
    | ExtendedSysState
    | AvailableModes
    | CurrentMode
)
