"""MAVLink commands: each one of a ground station gets a COMMAND_ACK, and UNSUPPORTED is an answer.

Parameters of a command that a tool does not use are NaN or 0; both mean the default here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple, Protocol

from autopilot.commander import Commander, FlightMode
from autopilot.ground.services import autopilot_version, available_modes
from autopilot.ground.streams import MAX_INTERVAL_NS, STREAMED, Streams
from autopilot.link.clock import NS_PER_US
from autopilot.link.groundmessages import (
    AutopilotVersion,
    AvailableModes,
    CommandInt,
    CommandLong,
    HomePosition,
    MavCmd,
    MavResult,
    MessageInterval,
)
from autopilot.link.wire import Message, message_id

__all__ = ["Handled", "Storage", "handle", "mode_of"]

FORCE = (21196.0, 2989.0)
"""COMPONENT_ARM_DISARM: ArduPilot's and QGroundControl's words for force, in param2."""
PX4_OFFBOARD = 6
"""The custom mode by which MAVSDK asks for streamed setpoints: GUIDED here. ArduPlane's mode 6 does not exist here."""
MAX_TEXT = 50


class Handled(NamedTuple):
    """What became of a command.

    Attributes
    ----------
    result : MavResult
        For the COMMAND_ACK.
    messages : tuple of Message
        What the asker gets beside it.
    texts : tuple of str
        Warnings for everybody.
    """

    result: MavResult
    messages: tuple[Message, ...] = ()
    texts: tuple[str, ...] = ()


class Storage(Protocol):
    """Parameters on disk."""

    def busy(self, now_ns: int) -> bool:
        """Return whether it was asked for too often."""

    def save(self) -> str | None:
        """Write them, and return why that was not possible."""

    def reload(self, now_ns: int) -> str | None:
        """Read them, and return why that was not possible."""

    def defaults(self, now_ns: int) -> str | None:
        """Go back to the defaults, and return why that was not possible."""


class Asked(NamedTuple):
    """A command and what it can act on.

    Attributes
    ----------
    p1, p2 : float
        Its first two parameters; what is not finite is 0, where that is a default.
    now_ns : int
        Own time.
    commander : Commander
        Arming and modes.
    streams : Streams
        Of the station that asks.
    storage : Storage
        Parameters on disk.
    current : callable
        Returns the messages of a type as they are now (:meth:`autopilot.ground.vehicle.Vehicle.current`).
    """

    p1: float
    p2: float
    now_ns: int
    commander: Commander
    streams: Streams
    storage: Storage
    current: Callable[[type, int], Iterable[Message]]


def handle(
    command: CommandLong | CommandInt,
    now_ns: int,
    commander: Commander,
    streams: Streams,
    storage: Storage,
    current: Callable[[type, int], Iterable[Message]],
) -> Handled:
    """Carry out a command that is addressed to us."""
    if command.command == MavCmd.COMPONENT_ARM_DISARM and not math.isfinite(command.param1):
        return Handled(MavResult.DENIED)  # the one parameter here that has no default
    p1, p2 = (value if math.isfinite(value) else 0.0 for value in (command.param1, command.param2))
    served = _SERVED.get(command.command)
    if served is None:
        return Handled(MavResult.UNSUPPORTED)
    return served(Asked(p1, p2, now_ns, commander, streams, storage, current))


def _arm(asked: Asked) -> Handled:
    force = asked.p2 in FORCE
    if asked.p1 == 0.0:
        asked.commander.disarm(asked.now_ns)
        return Handled(MavResult.ACCEPTED)
    if asked.p1 != 1.0:
        return Handled(MavResult.DENIED)
    return _checked(asked.commander.arm(asked.now_ns, force=force))


def _checks(asked: Asked) -> Handled:
    reasons = asked.commander.reasons(asked.now_ns)
    return Handled(MavResult.ACCEPTED, texts=_prearm(reasons))


def _checked(reasons: list[str]) -> Handled:
    return Handled(MavResult.FAILED if reasons else MavResult.ACCEPTED, texts=_prearm(reasons))


def _prearm(reasons: Iterable[str]) -> tuple[str, ...]:
    """Return the reasons as ground stations of the field know them."""
    return tuple(f"PreArm: {reason}"[:MAX_TEXT] for reason in reasons)


def mode_of(number: float) -> FlightMode | None:
    """Return the flight mode of a custom mode's number, if there is one."""
    if number == PX4_OFFBOARD:
        return FlightMode.GUIDED
    return next((mode for mode in FlightMode if mode == number), None)


def _mode(asked: Asked) -> Handled:
    mode = mode_of(asked.p2)
    if mode is None or not int(asked.p1) & 1:  # only custom modes have names here
        return Handled(MavResult.DENIED)
    asked.commander.set_mode(mode, asked.now_ns)
    return Handled(MavResult.ACCEPTED)


def _storage(asked: Asked) -> Handled:
    storage = asked.storage
    if storage.busy(asked.now_ns):
        return Handled(MavResult.TEMPORARILY_REJECTED)
    if asked.p1 == 1.0:
        reason = storage.save()
    elif asked.p1 == 0.0:
        reason = storage.reload(asked.now_ns)
    elif asked.p1 == 2.0:
        reason = storage.defaults(asked.now_ns)
    else:
        return Handled(MavResult.DENIED)
    return Handled(MavResult.ACCEPTED) if reason is None else Handled(MavResult.FAILED, texts=(reason[:MAX_TEXT],))


def _set_interval(asked: Asked) -> Handled:
    message = STREAMED.get(int(asked.p1))
    if message is None:
        return Handled(MavResult.UNSUPPORTED)
    if asked.p2 == 0.0:
        asked.streams.ask_default(message, asked.now_ns)
    elif asked.p2 == -1.0:
        asked.streams.ask(message, None, asked.now_ns)
    elif 0.0 < asked.p2 * NS_PER_US <= MAX_INTERVAL_NS:
        asked.streams.ask(message, round(asked.p2 * NS_PER_US), asked.now_ns)
    else:
        return Handled(MavResult.DENIED)
    return Handled(MavResult.ACCEPTED)


def _interval(asked: Asked) -> Handled:
    number = int(asked.p1)
    message = STREAMED.get(number)
    if message is None:  # 0: not to be had
        known = 0 <= number <= 0xFFFF
        return Handled(MavResult.ACCEPTED, (MessageInterval(number, 0),)) if known else Handled(MavResult.DENIED)
    interval_ns = asked.streams.interval_ns(message)
    return Handled(
        MavResult.ACCEPTED, (MessageInterval(number, -1 if interval_ns is None else interval_ns // NS_PER_US),)
    )


def _request(asked: Asked) -> Handled:
    return _send(asked, int(asked.p1))


def _send(asked: Asked, number: int) -> Handled:
    if number == message_id(AutopilotVersion):
        return Handled(MavResult.ACCEPTED, (autopilot_version(),))
    if number == message_id(AvailableModes):
        modes = available_modes(int(asked.p2)) if asked.p2 >= 0.0 else []
        return Handled(MavResult.ACCEPTED if modes else MavResult.DENIED, tuple(modes))
    message = HomePosition if number == message_id(HomePosition) else STREAMED.get(number)
    if message is None:
        return Handled(MavResult.UNSUPPORTED)
    found = tuple(asked.current(message, asked.now_ns))
    return Handled(MavResult.ACCEPTED if found else MavResult.TEMPORARILY_REJECTED, found)


def _home(asked: Asked) -> Handled:
    return _send(asked, message_id(HomePosition))


def _version(asked: Asked) -> Handled:
    return _send(asked, message_id(AutopilotVersion))


_SERVED: Mapping[int, Callable[[Asked], Handled]] = {
    MavCmd.COMPONENT_ARM_DISARM: _arm,
    MavCmd.RUN_PREARM_CHECKS: _checks,
    MavCmd.DO_SET_MODE: _mode,
    MavCmd.PREFLIGHT_STORAGE: _storage,
    MavCmd.SET_MESSAGE_INTERVAL: _set_interval,
    MavCmd.GET_MESSAGE_INTERVAL: _interval,
    MavCmd.REQUEST_MESSAGE: _request,
    MavCmd.GET_HOME_POSITION: _home,
    MavCmd.REQUEST_AUTOPILOT_CAPABILITIES: _version,
}
