"""How each message becomes a payload and comes back: the tables of pymavlink's ``ardupilotmega`` dialect.

Ids, payload formats and CRC extras are the dialect's; two messages that it does not have yet have their rows here.
Frames around the payloads are :mod:`autopilot.link.wire`.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from operator import attrgetter
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from autopilot.link import groundmessages as ground
from autopilot.link.messages import (
    AoaSsa,
    Attitude,
    Heartbeat,
    HilActuatorControls,
    NamedValueFloat,
    NamedValueInt,
    ServoOutputRaw,
    StatusText,
    Timesync,
    VfrHud,
)
from gains.table import InputError

__all__ = ["CODECS", "CONTROL_MESSAGES", "GROUND_MESSAGES", "U32", "Codec", "message_id", "message_ids"]

U32 = 0xFFFFFFFF
ELEVATOR_CHANNEL = 1
"""Index of the elevator in HIL_ACTUATOR_CONTROLS.controls; servo output 2 in SERVO_OUTPUT_RAW."""


@dataclass(frozen=True, slots=True)
class Codec:
    """How one message type becomes a payload and comes back.

    Attributes
    ----------
    id : int
        The message's number.
    id_bytes : bytes
        The same as it stands in a header.
    crc_extra : bytes
        What the checksum runs over behind the payload: one byte, which tells versions of the message apart.
    payload : struct.Struct
        Format of the payload, with its extensions.
    values : callable
        The message's values in the order of the payload.
    message : callable
        The message of such values.
    floats : tuple of str
        Fields that must be finite.
    float_sum : callable or None
        Their sum: finite only if each of them is, as doubles hold any sum of a few single-precision
        numbers. None without floats.
    """

    id: int
    id_bytes: bytes
    crc_extra: bytes
    payload: struct.Struct
    values: Callable[[Any], tuple[Any, ...]]
    message: Callable[[tuple[Any, ...]], Any]
    floats: tuple[str, ...] = ()
    float_sum: Callable[[Any], float] | None = None


def _codec(
    native: Any,
    values: Callable[[Any], tuple[Any, ...]],
    message: Callable[[tuple[Any, ...]], Any],
    floats: tuple[str, ...] = (),
) -> Codec:
    """Return the codec of a message by the dialect's row for it: number, payload format, CRC extra."""
    number = native.id
    float_sum: Callable[[Any], float] | None = None
    if len(floats) == 1:
        float_sum = attrgetter(*floats)
    elif floats:
        floats_of = attrgetter(*floats)
        float_sum = lambda m: sum(floats_of(m))  # noqa: E731  one expression, as the codecs below
    return Codec(
        number,
        number.to_bytes(3, "little"),
        bytes((native.crc_extra,)),
        native.unpacker,
        values,
        message,
        floats,
        float_sum,
    )


_ATTITUDE_FLOATS = ("roll", "pitch", "yaw", "rollspeed", "pitchspeed", "yawspeed")
_NO_SERVOS = (0,) * 8
_NO_CONTROLS = (0.0,) * 16


def _text(raw: bytes) -> str:
    """Return a MAVLink char array as text; what is not ASCII is replaced."""
    return raw.split(b"\0", 1)[0].decode("ascii", errors="replace")


_CONTROL_CODECS: dict[type, Codec] = {
    Heartbeat: _codec(
        dialect.MAVLink_heartbeat_message,
        lambda m: (m.custom_mode, m.type, m.autopilot, m.base_mode, m.system_status, 3),
        lambda v: Heartbeat(v[1], v[2], v[3], v[0], v[4]),
    ),
    Attitude: _codec(
        dialect.MAVLink_attitude_message,
        lambda m: (m.time_boot_ms & U32, m.roll, m.pitch, m.yaw, m.rollspeed, m.pitchspeed, m.yawspeed),
        lambda v: Attitude(*v),
        _ATTITUDE_FLOATS,
    ),
    AoaSsa: _codec(
        dialect.MAVLink_aoa_ssa_message,
        lambda m: (m.time_usec, m.AOA, m.SSA),
        lambda v: AoaSsa(*v),
        ("AOA", "SSA"),
    ),
    VfrHud: _codec(
        dialect.MAVLink_vfr_hud_message,
        lambda m: (m.airspeed, m.groundspeed, m.alt, m.climb, m.heading, m.throttle),
        lambda v: VfrHud(v[0], v[1], v[4], v[5], v[2], v[3]),
        ("airspeed", "groundspeed", "alt", "climb"),
    ),
    ServoOutputRaw: _codec(
        dialect.MAVLink_servo_output_raw_message,
        lambda m: (m.time_usec & U32, 0, m.servo2_raw, 0, 0, 0, 0, 0, 0, 0, *_NO_SERVOS),
        lambda v: ServoOutputRaw(v[0], v[2]),
    ),
    HilActuatorControls: _codec(
        dialect.MAVLink_hil_actuator_controls_message,
        lambda m: (m.time_usec, 0, 0.0, m.elevator, *_NO_CONTROLS[2:], 0),
        lambda v: HilActuatorControls(v[0], v[2 + ELEVATOR_CHANNEL]),
        ("elevator",),
    ),
    NamedValueFloat: _codec(
        dialect.MAVLink_named_value_float_message,
        lambda m: (m.time_boot_ms & U32, m.value, m.name.encode("ascii")),
        lambda v: NamedValueFloat(v[0], _text(v[2]), v[1]),
        ("value",),
    ),
    NamedValueInt: _codec(
        dialect.MAVLink_named_value_int_message,
        lambda m: (m.time_boot_ms & U32, m.value, m.name.encode("ascii")),
        lambda v: NamedValueInt(v[0], _text(v[2]), v[1]),
    ),
    Timesync: _codec(
        dialect.MAVLink_timesync_message,
        lambda m: (m.tc1, m.ts1),
        lambda v: Timesync(v[0], v[1]),
    ),
    StatusText: _codec(
        dialect.MAVLink_statustext_message,
        lambda m: (m.severity, m.text.encode("ascii", "replace")[:50], 0, 0),
        lambda v: StatusText(v[0], _text(v[1])),
    ),
}


@dataclass(frozen=True, slots=True)
class _NewMessage:
    """A message of the common dialect that pymavlink's ardupilotmega does not have yet: its row of the same tables."""

    id: int
    crc_extra: int
    unpacker: struct.Struct
    ordered_fieldnames: tuple[str, ...]
    array_lengths: tuple[int, ...]


_AVAILABLE_MODES = _NewMessage(
    435,
    134,
    struct.Struct("<IIBBB35s"),
    ("custom_mode", "properties", "number_modes", "mode_index", "standard_mode", "mode_name"),
    (0, 0, 0, 0, 0, 35),
)
_CURRENT_MODE = _NewMessage(
    436, 193, struct.Struct("<IIB"), ("custom_mode", "intended_custom_mode", "standard_mode"), (0, 0, 0)
)


def _by_name(message: type, native: Any) -> Codec:
    """Return the codec of a message whose fields have the dialect's names; what it lacks is zero on the wire."""
    places: dict[str, tuple[int, int]] = {}
    blank: list[Any] = []
    unpacked = native.unpacker.unpack(bytes(native.unpacker.size))
    for name, length in zip(native.ordered_fieldnames, native.array_lengths, strict=True):
        count = 1 if not length or isinstance(unpacked[len(blank)], bytes) else length
        places[name] = (len(blank), count)
        blank += unpacked[len(blank) : len(blank) + count]
    ours = [(each.name, *places[each.name], each.type) for each in fields(message)]

    def values(m: Any) -> tuple[Any, ...]:
        row = blank.copy()
        for name, place, count, _ in ours:
            value = getattr(m, name)
            if isinstance(value, str):
                row[place] = value.encode("ascii", "replace")
            elif count > 1:
                assert len(value) == count, f"{name}: expected {count} values, found {len(value)}"
                row[place : place + count] = value
            else:
                row[place] = value
        return tuple(row)

    def parsed(row: tuple[Any, ...]) -> Any:
        found: list[Any] = []
        for _, place, count, kind in ours:
            if kind == "str":
                found.append(_text(row[place]))
            elif count > 1:
                found.append(bytes(row[place : place + count]) if kind == "bytes" else row[place : place + count])
            else:
                found.append(row[place])
        return message(*found)

    return _codec(native, values, parsed)


_GROUND_CODECS: dict[type, Codec] = {
    ground.AvailableModes: _by_name(ground.AvailableModes, _AVAILABLE_MODES),
    ground.CurrentMode: _by_name(ground.CurrentMode, _CURRENT_MODE),
    **{
        message: _by_name(message, getattr(dialect, f"MAVLink_{name}_message"))
        for message, name in (
            (ground.AttitudeTarget, "attitude_target"),
            (ground.AutopilotVersion, "autopilot_version"),
            (ground.CommandAck, "command_ack"),
            (ground.CommandInt, "command_int"),
            (ground.CommandLong, "command_long"),
            (ground.ExtendedSysState, "extended_sys_state"),
            (ground.FileTransferProtocol, "file_transfer_protocol"),
            (ground.GlobalPositionInt, "global_position_int"),
            (ground.HomePosition, "home_position"),
            (ground.LogEntry, "log_entry"),
            (ground.LogRequestList, "log_request_list"),
            (ground.ManualControl, "manual_control"),
            (ground.MessageInterval, "message_interval"),
            (ground.MissionAck, "mission_ack"),
            (ground.MissionClearAll, "mission_clear_all"),
            (ground.MissionCount, "mission_count"),
            (ground.MissionRequest, "mission_request"),
            (ground.MissionRequestInt, "mission_request_int"),
            (ground.MissionRequestList, "mission_request_list"),
            (ground.ParamError, "param_error"),
            (ground.ParamRequestList, "param_request_list"),
            (ground.ParamRequestRead, "param_request_read"),
            (ground.ParamSet, "param_set"),
            (ground.ParamValue, "param_value"),
            (ground.Ping, "ping"),
            (ground.RcChannelsOverride, "rc_channels_override"),
            (ground.RequestDataStream, "request_data_stream"),
            (ground.SetAttitudeTarget, "set_attitude_target"),
            (ground.SetMode, "set_mode"),
            (ground.SysStatus, "sys_status"),
        )
    },
}
CODECS = _CONTROL_CODECS | _GROUND_CODECS

CONTROL_MESSAGES = frozenset(_CONTROL_CODECS)
"""What autopilot and plant say to each other."""
GROUND_MESSAGES = frozenset(_GROUND_CODECS) | {Heartbeat, Timesync}
"""What a vehicle hears from ground stations."""


def message_id(message: type) -> int:
    """Return the MAVLink id of a message type."""
    return CODECS[message].id


_IDS = {native.msgname: number for number, native in dialect.mavlink_map.items()}
_IDS |= {"AVAILABLE_MODES": _AVAILABLE_MODES.id, "CURRENT_MODE": _CURRENT_MODE.id}
_MAX_ID = (1 << 24) - 1


def message_ids(names: Iterable[str]) -> frozenset[int]:
    """Return the MAVLink ids of messages named as in ``ATTITUDE`` or by number; a number need not be known here.

    Raises
    ------
    InputError
        For a name that the dialect does not have, or a number that no message can have.
    """
    ids = set()
    for name in names:
        numbered = name.isascii() and name.isdigit() and len(name) <= 8
        number = int(name) if numbered else _IDS.get(name)
        if number is None or number > _MAX_ID:
            raise InputError(
                f"message: expected a MAVLink name such as ATTITUDE or a number up to {_MAX_ID}, found "
                f"{name or 'nothing'}"
            )
        ids.add(number)
    return frozenset(ids)
