"""The values of the vehicle's parameters, and the MAVLink parameter protocol over them.

Ground stations list, read and set them; a file keeps them (:mod:`autopilot.ground.parameterfile`). A value counts
when it is in range, in order with its neighbours (:mod:`autopilot.ground.parametertable`), and taken by the vehicle,
which is asked first. Nothing here does I/O: :meth:`Parameters.handle` returns what to answer, and a list that a
ground station asked for is handed out a few values at a time by :meth:`Parameters.next_values`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from types import MappingProxyType
from typing import Final

from autopilot.ground.parametertable import (
    BY_NAME,
    GAINS,
    MAX_NAME,
    PARAMETERS,
    Parameter,
    canonical,
    disorder,
    unfit,
)
from autopilot.link.groundmessages import (
    ParamError,
    ParamErrorCode,
    ParamRequestRead,
    ParamSet,
    ParamValue,
)
from autopilot.link.wire import Source
from gains.table import InputError, Table

__all__ = ["MAX_REASON", "PARAMETERS", "PARAM_TYPE", "Answer", "Change", "Parameter", "Parameters"]

PARAM_TYPE: Final = 9
"""MAV_PARAM_TYPE_REAL32: the type of every PARAM_VALUE, whole numbers and switches too.

Of an autopilot that they do not know, some tools take an integer for a number that was cast to a float, and others
for raw bytes in a float's place. Only a float reads the same to all of them.
"""
MAX_REASON = 50
"""Characters of a reason: what one STATUSTEXT holds."""

_DIGITS = 9  # as many as the shortest decimal of a 32-bit float can have
_NAMED = -1  # the index where a parameter is named, and not numbered

Change = Callable[[Mapping[str, float], str, int], str | None]
"""Takes all values as they will be, the name of one that changes, and own time in ns.

Returns why it is refused, None when it is taken.
"""


@dataclass(frozen=True, slots=True)
class Answer:
    """What a ground station's message leads to.

    Attributes
    ----------
    to_asker : tuple of ParamValue or ParamError
        To the station that sent it, in this order.
    to_all : tuple of ParamValue
        To every station.
    reason : str or None
        Why it was refused, of at most ``MAX_REASON`` characters where it is not the vehicle's own; None when it
        was not.
    """

    to_asker: tuple[ParamValue | ParamError, ...] = ()
    to_all: tuple[ParamValue, ...] = ()
    reason: str | None = None


class Parameters:
    """The values of all parameters, and the protocol that reads and sets them.

    Parameters
    ----------
    defaults : Mapping[str, float]
        Replace the table's; required for those that the table leaves open.
    change : Change
        Asked before a value counts. It must take what counted before: when one of several values is refused, those
        that it took already are given back by asking again.
    ports : sequence of str
        The ground stations that lists are handed out to.
    names : sequence of str
        The gain sets that ``GAINS`` counts, by name.
    ranges : Mapping[str, tuple[float, float]], optional
        Replace the table's, where what flies says it better: the travel of an elevator.

    Raises
    ------
    InputError
        When a default is out of range or order, or the names of the gain sets are too many or not distinct.
    """

    def __init__(
        self,
        defaults: Mapping[str, float],
        change: Change,
        *,
        ports: Sequence[str],
        names: Sequence[str],
        ranges: Mapping[str, tuple[float, float]] = MappingProxyType({}),
    ) -> None:
        assert defaults.keys() | ranges.keys() <= BY_NAME.keys()
        self.names = tuple(names)
        self._change = change
        ranges = {**ranges, GAINS: (0.0, float(_last(self.names)))}
        self.table = MappingProxyType({each.name: _within(each, ranges.get(each.name)) for each in PARAMETERS})
        self._index = {name: index for index, name in enumerate(self.table)}
        self.defaults = MappingProxyType(
            {name: _default(each, defaults.get(name, each.default)) for name, each in self.table.items()}
        )
        _require_order(self.defaults, "defaults")
        self._values: Mapping[str, float] = self.defaults
        # a parameter waits once for a station at most, so nothing needs to be refused
        self._waiting: dict[str, dict[str, None]] = {port: {} for port in ports}

    @property
    def values(self) -> Mapping[str, float]:
        """All values as they are now; a change makes a new mapping and leaves this one as it was."""
        return self._values

    def value(self, name: str) -> float:
        """Return one value."""
        return self._values[name]

    # -- the protocol

    def request_list(self, port: str) -> None:
        """Answer a PARAM_REQUEST_LIST: the whole list waits for this station, behind what waits already."""
        self._waiting[port].update(dict.fromkeys(self.table))

    def announce(self, names: Iterable[str]) -> None:
        """Let the values of these names wait for every station."""
        fresh = dict.fromkeys(names)
        assert fresh.keys() <= self.table.keys()
        for waiting in self._waiting.values():
            waiting.update(fresh)

    def pending(self, port: str) -> int:
        """Return how many values wait for a station."""
        return len(self._waiting[port])

    def next_values(self, port: str, n: int) -> tuple[ParamValue, ...]:
        """Take away the next ``n`` values that wait for a station, or fewer, as they are now."""
        waiting = self._waiting[port]
        names = tuple(islice(waiting, n))
        for name in names:
            del waiting[name]
        return tuple(self._message(name) for name in names)

    def handle(self, message: ParamRequestRead | ParamSet, asker: Source, now_ns: int) -> Answer:
        """Return the answer to a message that is addressed to this vehicle.

        Parameters
        ----------
        message : ParamRequestRead or ParamSet
        asker : (int, int)
            System and component that sent it.
        now_ns : int
            Own time, which the vehicle is told with a change.
        """
        match message:
            case ParamRequestRead():
                return self._read(message, asker)
            case ParamSet():
                return self._set(message, asker, now_ns)

    def _read(self, message: ParamRequestRead, asker: Source) -> Answer:
        """Answer a PARAM_REQUEST_READ; where there is an index the name does not count."""
        index, name = message.param_index, message.param_id
        if index == _NAMED:
            if name in self.table:
                return Answer((self._message(name),))
            return _no_such(name, asker)
        if 0 <= index < len(PARAMETERS):
            return Answer((self._message(PARAMETERS[index].name),))
        error = ParamError(*asker, "", index, ParamErrorCode.DOES_NOT_EXIST)
        return Answer((error,), reason=f"parameter {index}: expected 0 to {len(PARAMETERS) - 1}")

    def _set(self, message: ParamSet, asker: Source, now_ns: int) -> Answer:
        """Answer a PARAM_SET."""
        name = message.param_id
        if name not in self.table:
            return _no_such(name, asker)
        code, reason = ParamErrorCode.VALUE_OUT_OF_RANGE, self._unfit(message)
        if reason is None:
            after = {**self._values, name: canonical(message.param_value)}
            code, reason = ParamErrorCode.PERMISSION_DENIED, self._take(after, now_ns)
        value = self._message(name)
        if reason is None:
            return Answer(to_all=(value,))
        # the error comes first: a tool that hears the old value before it takes that for a loss and repeats itself
        return Answer((ParamError(*asker, name, _NAMED, code), value), reason=reason)

    def _unfit(self, message: ParamSet) -> str | None:
        """Return why a value cannot be its parameter's, or None."""
        name, value = message.param_id, canonical(message.param_value)
        if message.param_type != PARAM_TYPE:  # an integer is a cast number or raw bytes, and nothing says which
            return f"{name} of type {message.param_type}: expected a float ({PARAM_TYPE})"
        expected = unfit(self.table[name], value)
        if expected is None:
            wrong = disorder({**self._values, name: value}, name)
            expected = None if wrong is None else wrong[1]
        return None if expected is None else _reason(name, value, expected)

    def _message(self, name: str) -> ParamValue:
        """Return the value of one parameter as it is sent."""
        return ParamValue(name, self._values[name], PARAM_TYPE, len(self.table), self._index[name])

    # -- many at once

    def as_table(self) -> dict[str, str | int | float | bool]:
        """Return what a file keeps: what differs from the defaults, ``GAINS`` by the set's name.

        So a default that comes from gains or model is not written down for others, which have their own.
        """
        return {name: self._kept(name) for name, value in self._values.items() if value != self.defaults[name]}

    def _kept(self, name: str) -> str | int | float | bool:
        """Return one value as a file keeps it."""
        value = self._values[name]
        if name == GAINS:
            return self.names[int(value)]
        match self.table[name].kind:
            case "bool":
                return bool(value)
            case "int":
                return int(value)
            case "float":
                return value

    def load(self, table: Table, now_ns: int) -> tuple[str, ...]:
        """Take the values of a file, all of them or none, and the defaults of what it does not name.

        Returns
        -------
        tuple of str
            The names of what changed.

        Raises
        ------
        InputError
            Naming file, field, what was expected and what was found, or what the vehicle said; nothing changes.
        """
        after = {each.name: self._field(table, each) for each in self.table.values()}
        table.finish()
        _require_order(after, table.source)
        return self._take_all(after, table.source, now_ns)

    def reset(self, now_ns: int) -> tuple[str, ...]:
        """Take all defaults, or none of them; return the names of what changed.

        Raises
        ------
        InputError
            Saying what the vehicle said; nothing changes.
        """
        return self._take_all(self.defaults, "defaults", now_ns)

    def _field(self, table: Table, parameter: Parameter) -> float:
        """Return one value of a file, or its default."""
        name, default = parameter.name, self.defaults[parameter.name]
        if name == GAINS:
            return float(self.names.index(table.string(name, self.names[int(default)], choices=self.names)))
        match parameter.kind:
            case "bool":
                return float(table.boolean(name, default))
            case "int":
                return float(table.integer(name, default, low=int(parameter.low), high=int(parameter.high)))
            case "float":
                return canonical(table.number(name, default, low=parameter.low, high=parameter.high))

    def _take_all(self, after: Mapping[str, float], source: str, now_ns: int) -> tuple[str, ...]:
        """Take values that a file or the defaults hold; return the names of what changed."""
        changed = tuple(name for name, value in after.items() if value != self._values[name])
        reason = self._take(after, now_ns)
        if reason is not None:
            raise InputError(f"{source}: {reason}")
        return changed

    def _take(self, after: Mapping[str, float], now_ns: int) -> str | None:
        """Ask the vehicle for each value that changes; all count when all are taken, else say why none does."""
        before, after = self._values, MappingProxyType(dict(after))
        changed = [name for name, value in after.items() if value != before[name]]
        for place, name in enumerate(changed):
            reason = self._change(after, name, now_ns)
            if reason is not None:
                for taken in reversed(changed[:place]):
                    self._change(before, taken, now_ns)
                return reason
        if changed:
            self._values = after
        return None


def _within(parameter: Parameter, limits: tuple[float, float] | None) -> Parameter:
    """Return the parameter with other limits, if there are some."""
    if limits is None:
        return parameter
    low, high = limits
    return replace(parameter, low=canonical(low), high=canonical(high))


def _default(parameter: Parameter, value: float | None) -> float:
    """Return the default of a parameter, checked."""
    assert value is not None, f"{parameter.name}: its default depends on what flies"
    value = canonical(value)
    expected = unfit(parameter, value)
    if expected is not None:
        raise InputError(f"defaults: {parameter.name}: expected {expected}, found {value:.{_DIGITS}g}")
    return value


def _require_order(values: Mapping[str, float], source: str) -> None:
    """Refuse values of which one is not in order with another."""
    wrong = disorder(values)
    if wrong is not None:
        name, expected = wrong
        raise InputError(f"{source}: {name}: expected {expected}, found {values[name]:.{_DIGITS}g}")


def _last(names: Sequence[str]) -> int:
    """Return the number of the last gain set."""
    assert names
    most = int(BY_NAME[GAINS].high) + 1
    if len(names) > most:
        raise InputError(f"gain sets: expected at most {most}, found {len(names)}")
    name, count = Counter(names).most_common(1)[0]
    if count > 1:
        raise InputError(f"gain sets: expected different names, found {name} {count} times")
    return len(names) - 1


def _no_such(name: str, asker: Source) -> Answer:
    """Return the answer about a name that is not in the table; the reason is printable ASCII."""
    shown = "".join(c if c.isascii() and c.isprintable() else "?" for c in name[:MAX_NAME])
    error = ParamError(*asker, name, _NAMED, ParamErrorCode.DOES_NOT_EXIST)
    return Answer((error,), reason=f"{shown}: expected the name of a parameter")


def _reason(name: str, value: float, expected: str) -> str:
    """Return what was found and what was expected, the value with as many digits as one STATUSTEXT has room for."""
    texts = (f"{name} {value:.{digits}g}: expected {expected}" for digits in range(_DIGITS, 0, -1))
    return next((text for text in texts if len(text) <= MAX_REASON), f"{name}: expected {expected}")
