"""Answers that depend on the question alone: clocks and pings, and what is not on board, said at once.

Ground stations ask for missions, fences, rally points, files and logs when they connect. There are none; silence
would cost them seconds of waiting and repeats, so each question gets its short answer.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version

from autopilot.commander import FlightMode
from autopilot.link.groundmessages import (
    AutopilotVersion,
    AvailableModes,
    Capability,
    FileTransferProtocol,
    LogEntry,
    LogRequestList,
    MissionAck,
    MissionClearAll,
    MissionCount,
    MissionRequest,
    MissionRequestInt,
    MissionRequestList,
    Ping,
)
from autopilot.link.messages import Timesync
from autopilot.link.wire import Message, Source

__all__ = ["ANSWERS", "autopilot_version", "available_modes"]

MISSION_ACCEPTED, MISSION_UNSUPPORTED, MISSION_INVALID_SEQUENCE = 0, 3, 13
"""MAV_MISSION_RESULT."""
FTP_NAK, FTP_FILE_NOT_FOUND = 129, 10
_FTP = struct.Struct("<HBBBBBBI")
"""Sequence, session, opcode, size, opcode asked, burst complete, padding, offset; 239 bytes of data follow."""
FTP_BYTES = 251
OFFICIAL_RELEASE = 255


def _mission_list(asked: MissionRequestList, source: Source, _now_ns: int) -> Message:
    return MissionCount(*source, 0, asked.mission_type)


def _mission_item(asked: MissionRequest | MissionRequestInt, source: Source, _now_ns: int) -> Message:
    return MissionAck(*source, MISSION_INVALID_SEQUENCE, asked.mission_type)


def _mission_upload(asked: MissionCount, source: Source, _now_ns: int) -> Message:
    """Refuse items; an empty mission is what there is already."""
    return MissionAck(*source, MISSION_UNSUPPORTED if asked.count else MISSION_ACCEPTED, asked.mission_type)


def _mission_clear(asked: MissionClearAll, source: Source, _now_ns: int) -> Message:
    return MissionAck(*source, MISSION_ACCEPTED, asked.mission_type)


def _file(asked: FileTransferProtocol, source: Source, _now_ns: int) -> Message:
    """Say of any file operation that there is no such file."""
    sequence, session, opcode, *_ = _FTP.unpack_from(asked.payload)
    header = _FTP.pack((sequence + 1) & 0xFFFF, session, FTP_NAK, 1, opcode, 0, 0, 0)
    return FileTransferProtocol(0, *source, (header + bytes((FTP_FILE_NOT_FOUND,))).ljust(FTP_BYTES, b"\0"))


def _logs(_asked: LogRequestList, _source: Source, _now_ns: int) -> Message:
    return LogEntry(0, 0, 0)


def _ping(asked: Ping, source: Source, _now_ns: int) -> Message | None:
    """Answer a request; an answer, which names its asker, gets none."""
    return None if asked.target_system or asked.target_component else Ping(asked.time_usec, asked.seq, *source)


def _timesync(asked: Timesync, _source: Source, now_ns: int) -> Message | None:
    return Timesync(max(1, now_ns), asked.ts1) if asked.tc1 == 0 else None


ANSWERS: Mapping[type, Callable[..., Message | None]] = {
    MissionRequestList: _mission_list,
    MissionRequest: _mission_item,
    MissionRequestInt: _mission_item,
    MissionCount: _mission_upload,
    MissionClearAll: _mission_clear,
    FileTransferProtocol: _file,
    LogRequestList: _logs,
    Ping: _ping,
    Timesync: _timesync,
}
"""Message type to the function (message, its source, now) that answers it."""


@cache
def autopilot_version() -> AutopilotVersion:
    """Return AUTOPILOT_VERSION: what is served, and which lagproof this is."""
    try:
        text = version("lagproof")
    except PackageNotFoundError:  # run from a source tree that is not installed
        text = "0.0.0"
    major, minor, patch = (int("".join(filter(str.isdigit, part)) or 0) for part in (*text.split("."), "0", "0")[:3])
    capabilities = (
        Capability.PARAM_FLOAT
        | Capability.PARAM_ENCODE_C_CAST
        | Capability.COMMAND_INT
        | Capability.SET_ATTITUDE_TARGET
        | Capability.MAVLINK2
    )
    number = major << 24 | minor << 16 | patch << 8 | OFFICIAL_RELEASE
    return AutopilotVersion(int(capabilities), number, b"lagproof", 1)


def available_modes(index: int) -> list[AvailableModes]:
    """Return AVAILABLE_MODES of one mode, numbered from 1, or of all for 0; empty for a mode that is not there."""
    modes = list(FlightMode)
    described = [AvailableModes(len(modes), i, 0, mode, 0, mode.name) for i, mode in enumerate(modes, 1)]
    return described if index == 0 else described[index - 1 : index]
