"""How often each message goes to one ground station, as that station has asked.

A message is due at the multiples of its interval of our own clock, so its rate never drifts and messages of equal rate
leave together. One that is due leaves when there is news of it; one that came late by less than two intervals does not
delay the next, so a stream as fast as its source loses nothing to jitter, and what came later is not made up for.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from autopilot.link.clock import NS_PER_S, NS_PER_US
from autopilot.link.groundmessages import AttitudeTarget, CurrentMode, ExtendedSysState, GlobalPositionInt, SysStatus
from autopilot.link.messages import AoaSsa, Attitude, NamedValueFloat, NamedValueInt, ServoOutputRaw, VfrHud
from autopilot.link.wire import message_id

__all__ = ["GROUPS", "RATE_PARAMETERS", "STREAMED", "Streams", "interval_of"]

RATE_PARAMETERS: Mapping[str, type] = {
    "RATE_ATT": Attitude,
    "RATE_HUD": VfrHud,
    "RATE_AOA": AoaSsa,
    "RATE_SERVO": ServoOutputRaw,
    "RATE_DELAY": NamedValueInt,
    "RATE_EST": NamedValueFloat,
    "RATE_POS": GlobalPositionInt,
    "RATE_TARGET": AttitudeTarget,
    "RATE_SYS": SysStatus,
}
"""Which parameter holds the default rate of which message."""

FIXED_RATES: Mapping[type, float] = {CurrentMode: 0.5, ExtendedSysState: 0.0}
"""Default rates that are no parameters, Hz."""

STREAMED: Mapping[int, type] = {message_id(each): each for each in (*RATE_PARAMETERS.values(), *FIXED_RATES)}
"""Message id to type of all that can be had at a rate."""

_RAW, _STATUS, _RC, _POSITION, _EXTRA1, _EXTRA2, _EXTRA3 = 1, 2, 3, 6, 10, 11, 12
GROUPS: Mapping[int, tuple[type, ...]] = {
    _RAW: (),
    _STATUS: (SysStatus,),
    _RC: (ServoOutputRaw,),
    _POSITION: (GlobalPositionInt,),
    _EXTRA1: (Attitude, AoaSsa, AttitudeTarget),
    _EXTRA2: (VfrHud,),
    _EXTRA3: (NamedValueInt, NamedValueFloat),
}
"""MAV_DATA_STREAM to messages, as ArduPilot groups them; 0 is all of these."""

MIN_INTERVAL_NS = NS_PER_S // 100
"""The fastest stream: 100 Hz. The elevator has the link's time first."""
MAX_INTERVAL_NS = ((1 << 31) - 1) * NS_PER_US
"""The slowest: once in 36 minutes, the longest interval that MESSAGE_INTERVAL can tell."""


def interval_of(rate_hz: float) -> int | None:
    """Return the interval of a rate, ns, within the limits; None for rate 0, which is off."""
    return None if rate_hz <= 0.0 else round(min(max(MIN_INTERVAL_NS, NS_PER_S / rate_hz), MAX_INTERVAL_NS))


class Streams:
    """When each message is due at one ground station.

    Parameters
    ----------
    rates : mapping
        Message type to default rate, Hz; a type that is missing is off.
    timed : collection of type
        Messages that are made when they are due; the others come by themselves, and wake nobody.

    Attributes
    ----------
    next_ns : int or None
        When the next of those that are made is due.
    """

    def __init__(self, rates: Mapping[type, float], timed: Collection[type]) -> None:
        self._defaults = {each: interval_of(rates.get(each, FIXED_RATES.get(each, 0.0))) for each in STREAMED.values()}
        self._timed = tuple(timed)  # in order: what is due together leaves so
        self._asked: dict[type, int | None] = {}
        self._due_ns: dict[type, int] = {}
        self._started = False
        self.next_ns: int | None = None

    def start(self, now_ns: int) -> None:
        """Begin to count, at the first multiple of each interval."""
        self._started = True
        for message in self._defaults:
            self._restart(message, now_ns)

    def interval_ns(self, message: type) -> int | None:
        """Return the interval in force; None for off."""
        return self._asked[message] if message in self._asked else self._defaults[message]

    def ask(self, message: type, interval_ns: int | None, now_ns: int) -> None:
        """Set an interval; None switches the message off."""
        self._asked[message] = None if interval_ns is None else max(MIN_INTERVAL_NS, interval_ns)
        self._restart(message, now_ns)

    def ask_default(self, message: type, now_ns: int) -> None:
        """Go back to the default."""
        self._asked.pop(message, None)
        self._restart(message, now_ns)

    def set_default(self, message: type, rate_hz: float, now_ns: int) -> None:
        """Change the default rate; it counts where the station has asked for nothing else."""
        before = self.interval_ns(message)
        self._defaults[message] = interval_of(rate_hz)
        if self.interval_ns(message) != before:
            self._restart(message, now_ns)

    def is_due(self, message: type, now_ns: int) -> bool:
        """Return whether a message is due now, which it is until it is sent."""
        due_ns = self._due_ns.get(message)
        return due_ns is not None and due_ns <= now_ns

    def to_make(self, now_ns: int) -> Sequence[type]:
        """Return what must be made now, as it is due."""
        if self.next_ns is None or now_ns < self.next_ns:
            return ()
        return [message for message in self._timed if self.is_due(message, now_ns)]

    def sent(self, message: type, now_ns: int) -> None:
        """Take note that a message that was due has been sent, or could not be made."""
        interval_ns = self.interval_ns(message)
        assert interval_ns is not None
        following_ns = self._due_ns[message] + interval_ns
        self._set(message, following_ns if following_ns + interval_ns > now_ns else _multiple(interval_ns, now_ns))

    def _restart(self, message: type, now_ns: int) -> None:
        interval_ns = self.interval_ns(message)
        if self._started:
            self._set(message, None if interval_ns is None else _multiple(interval_ns, now_ns))

    def _set(self, message: type, due_ns: int | None) -> None:
        if due_ns is None:
            self._due_ns.pop(message, None)
        else:
            self._due_ns[message] = due_ns
        if message in self._timed:
            self.next_ns = min((due for each, due in self._due_ns.items() if each in self._timed), default=None)


def _multiple(interval_ns: int, after_ns: int) -> int:
    """Return the first multiple of an interval after a time."""
    return (after_ns // interval_ns + 1) * interval_ns
