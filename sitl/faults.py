"""Faults on demand, as data and as text: ``WHAT@AT`` or ``WHAT@AT+FOR``, times from sample k = 0.

=============================  ==========================================================================
``kill:PROGRAM@5s+0.5s``       the program is killed (SIGKILL) at 5 s and started again 0.5 s later
``freeze:PROGRAM@5s+1s``       it stands still (SIGSTOP) for a second; what comes waits for it
``step:PROGRAM:-0.5s@5s``      its clock jumps
``drift:PROGRAM:150ppm@5s``    its clock runs at another rate from then on
``mute:PROGRAM@5s+0.5s``       every send of it fails, as with a network interface that is down
``corrupt-gains@5s+1s``        the autopilot is killed, and its gain file is damaged until a second later
``disk-full@5s``               the recorder's disk is full from then on
``sensor:STATE:frozen@5s+1s``  the sensor of a state repeats its last value; ``bias:0.02`` adds to it,
                               ``noise:0.01`` adds N(0, 0.01²), in the state's unit; ``nan`` sends NaN
``elevator:stuck@5s+1s``       the actuator stays where it is; ``slow:0.1`` limits its rate, in units of u
                               per s; ``reversed`` moves it to the other side of neutral
=============================  ==========================================================================

PROGRAM is ``plant``, ``relay`` or ``autopilot``. Without FOR a fault lasts to the end of the flight; a kill without
FOR is not followed by a start. A program that starts again starts as it did the first time: with the clock of its
command line, and a plant at k = 0, where its sensors and its elevator fail again in their time. What a fault does is
in the plant (sensor, elevator), or with whoever runs the programs: :mod:`sitl.flight` in virtual time,
:mod:`sitl.processes` over UDP.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from enum import StrEnum
from typing import Any

from autopilot.link.clock import NS_PER_MS, NS_PER_S
from autopilot.link.node import Record
from gains.table import InputError

__all__ = [
    "MAX_FAULTS",
    "PROGRAMS",
    "AircraftFault",
    "ClockDrift",
    "ClockStep",
    "CorruptGains",
    "DiskFull",
    "ElevatorFault",
    "ElevatorFaultKind",
    "Fault",
    "FaultChange",
    "Freeze",
    "Kill",
    "Mute",
    "Phase",
    "SensorFault",
    "SensorFaultKind",
    "aircraft_faults",
    "check_faults",
    "fault_changes",
    "fault_of",
    "fault_record",
    "format_fault",
    "parse_fault",
    "program_of",
]

PROGRAMS = ("plant", "relay", "autopilot")

MAX_FAULTS = 256
"""Faults of one flight."""
MAX_TIME_NS = 86_400 * NS_PER_S
MAX_DRIFT_PPB = 200_000
"""A crystal's drift at the most, as everywhere in this program."""


@dataclass(frozen=True, slots=True)
class _Timed:
    """What every fault has.

    Attributes
    ----------
    at_ns : int
        When it begins, from sample k = 0.
    for_ns : int or None
        How long it lasts; None to the end.
    """

    at_ns: int
    for_ns: int | None

    @property
    def end_ns(self) -> int | None:
        """When it is over; None for never."""
        return None if self.for_ns is None else self.at_ns + self.for_ns


@dataclass(frozen=True, slots=True)
class Kill(_Timed):
    """A program dies; it is started again when the fault is over."""

    program: str


@dataclass(frozen=True, slots=True)
class Freeze(_Timed):
    """A program stands still; what comes meanwhile waits for it."""

    program: str


@dataclass(frozen=True, slots=True)
class ClockStep(_Timed):
    """A program's clock jumps by ``by_ns``, once; ``for_ns`` is None."""

    program: str
    by_ns: int


@dataclass(frozen=True, slots=True)
class ClockDrift(_Timed):
    """A program's clock has the drift ``drift_ppb`` from then on; ``for_ns`` is None."""

    program: str
    drift_ppb: int


@dataclass(frozen=True, slots=True)
class Mute(_Timed):
    """Every send of a program fails."""

    program: str


@dataclass(frozen=True, slots=True)
class CorruptGains(_Timed):
    """The autopilot is killed and finds its gain file damaged until the fault is over."""


@dataclass(frozen=True, slots=True)
class DiskFull(_Timed):
    """The recorder's disk has no room left; ``for_ns`` is None."""


class SensorFaultKind(StrEnum):
    """What is wrong with a sensor."""

    FROZEN = "frozen"
    BIAS = "bias"
    NOISE = "noise"
    NAN = "nan"


@dataclass(frozen=True, slots=True)
class SensorFault(_Timed):
    """The sensor of one state: ``value`` is the bias or the standard deviation, in the state's unit, else 0."""

    state: str
    kind: SensorFaultKind
    value: float


class ElevatorFaultKind(StrEnum):
    """What is wrong with the actuator."""

    STUCK = "stuck"
    SLOW = "slow"
    REVERSED = "reversed"


@dataclass(frozen=True, slots=True)
class ElevatorFault(_Timed):
    """The actuator: ``value`` is its largest rate, units of u per s, where it is slow, else 0."""

    kind: ElevatorFaultKind
    value: float


AircraftFault = SensorFault | ElevatorFault
"""What the plant does itself."""
Fault = Kill | Freeze | ClockStep | ClockDrift | Mute | CorruptGains | DiskFull | AircraftFault

_TIME = re.compile(r"([-+]?[0-9]{1,12}(?:\.[0-9]{1,9})?)(s|ms)")
_PPM = re.compile(r"([-+]?[0-9]{1,6}(?:\.[0-9]{1,3})?)ppm")
_VALUE = re.compile(r"[-+]?[0-9]{1,12}(\.[0-9]{1,12})?")
_ONCE = (ClockStep, ClockDrift, DiskFull)
"""Faults without an end."""


def parse_fault(text: str) -> Fault:
    """Return the fault that a text says; :func:`format_fault` is the inverse.

    Raises
    ------
    InputError
        When it says none, in one line.
    """
    what, at, when = text.partition("@")
    if not at:
        raise InputError(f'fault "{text}": expected WHAT@AT or WHAT@AT+FOR, as in kill:plant@5s+0.5s')
    start, plus, length = when.partition("+")
    at_ns = _time_ns(text, start)
    for_ns = _time_ns(text, length) if plus else None
    fault = _what(text, what.split(":"), at_ns, for_ns)
    if isinstance(fault, _ONCE) and for_ns is not None:
        raise InputError(f'fault "{text}": expected no +FOR: it does not end')
    if for_ns == 0:
        raise InputError(f'fault "{text}": expected +FOR above 0, found {length}')
    if isinstance(fault, Freeze | Mute | CorruptGains) and for_ns is None:
        raise InputError(f'fault "{text}": expected +FOR, how long it lasts')
    return fault


def _what(text: str, words: list[str], at_ns: int, for_ns: int | None) -> Fault:
    match words:
        case ["kill" | "freeze" | "mute" | "step" | "drift", program, *_] if program in PROGRAMS:
            fault = _program_fault(text, words, at_ns, for_ns)
        case ["sensor" | "elevator", *_]:
            fault = _aircraft_fault(text, words, at_ns, for_ns)
        case ["corrupt-gains"]:
            fault = CorruptGains(at_ns, for_ns)
        case ["disk-full"]:
            fault = DiskFull(at_ns, for_ns)
        case _:
            fault = None
    if fault is None:
        programs = "|".join(PROGRAMS)
        raise InputError(
            f'fault "{text}": expected kill:P, freeze:P, mute:P, step:P:TIME, drift:P:PPM with P {programs},'
            " corrupt-gains, disk-full, sensor:STATE:frozen|nan|bias:X|noise:X, or elevator:stuck|reversed|slow:X"
        )
    return fault


def _program_fault(text: str, words: list[str], at_ns: int, for_ns: int | None) -> Fault | None:
    match words:
        case ["kill", program]:
            return Kill(at_ns, for_ns, program)
        case ["freeze", program]:
            return Freeze(at_ns, for_ns, program)
        case ["mute", program]:
            return Mute(at_ns, for_ns, program)
        case ["step", program, by]:
            return ClockStep(at_ns, for_ns, program, _time_ns(text, by, signed=True))
        case ["drift", program, drift]:
            return ClockDrift(at_ns, for_ns, program, _drift_ppb(text, drift))
    return None


def _aircraft_fault(text: str, words: list[str], at_ns: int, for_ns: int | None) -> Fault | None:
    match words:
        case ["sensor", state, "frozen" | "nan" as kind] if state:
            return SensorFault(at_ns, for_ns, state, SensorFaultKind(kind), 0.0)
        case ["sensor", state, "bias" | "noise" as kind, value] if state:
            return SensorFault(at_ns, for_ns, state, SensorFaultKind(kind), _value(text, value, kind == "noise"))
        case ["elevator", "stuck" | "reversed" as kind]:
            return ElevatorFault(at_ns, for_ns, ElevatorFaultKind(kind), 0.0)
        case ["elevator", "slow", value]:
            return ElevatorFault(at_ns, for_ns, ElevatorFaultKind.SLOW, _value(text, value, True))
    return None


def _time_ns(text: str, time: str, *, signed: bool = False) -> int:
    match = _TIME.fullmatch(time)
    value = Decimal(match[1]) * (NS_PER_S if match[2] == "s" else NS_PER_MS) if match else Decimal("NaN")
    if match is None or value != int(value) or abs(value) > MAX_TIME_NS or (not signed and time[0] in "+-"):
        raise InputError(f'fault "{text}": expected times such as 5s or 250ms, found {time or "nothing"}')
    return int(value)


def _drift_ppb(text: str, drift: str) -> int:
    match = _PPM.fullmatch(drift)
    ppb = int(Decimal(match[1]) * 1000) if match else MAX_DRIFT_PPB + 1
    if abs(ppb) > MAX_DRIFT_PPB:
        raise InputError(f'fault "{text}": expected a drift within 200ppm, such as -150ppm, found {drift or "nothing"}')
    return ppb


def _value(text: str, value: str, positive: bool) -> float:
    number = float(value) if _VALUE.fullmatch(value) else 0.0
    if number == 0.0 or (positive and number < 0.0):
        kind = "a number above 0" if positive else "a number other than 0"
        raise InputError(f'fault "{text}": expected {kind} such as 0.02, found {value or "nothing"}')
    return number


def format_fault(fault: Fault) -> str:
    """Return the text of a fault."""
    match fault:
        case Kill(program=program) | Freeze(program=program) | Mute(program=program):
            what = f"{type(fault).__name__.lower()}:{program}"
        case ClockStep(program=program, by_ns=by_ns):
            what = f"step:{program}:{_seconds(by_ns)}"
        case ClockDrift(program=program, drift_ppb=ppb):
            what = f"drift:{program}:{Decimal(ppb) / 1000:f}ppm"
        case CorruptGains():
            what = "corrupt-gains"
        case DiskFull():
            what = "disk-full"
        case SensorFault(state=state, kind=kind, value=value):
            what = f"sensor:{state}:{kind}" + (f":{_decimal(value)}" if value else "")
        case ElevatorFault(kind=elevator_kind, value=value):
            what = f"elevator:{elevator_kind}" + (f":{_decimal(value)}" if value else "")
    length = "" if fault.for_ns is None else f"+{_seconds(fault.for_ns)}"
    return f"{what}@{_seconds(fault.at_ns)}{length}"


def _seconds(time_ns: int) -> str:
    return f"{(Decimal(time_ns) / NS_PER_S).normalize():f}s"


def _decimal(value: float) -> str:
    return f"{Decimal(repr(value)):f}"


def aircraft_faults(faults: Iterable[Fault]) -> tuple[AircraftFault, ...]:
    """Return the faults that the plant does itself."""
    return tuple(fault for fault in faults if isinstance(fault, AircraftFault))


def check_faults(faults: Sequence[Fault], states: Sequence[str], duration_ns: int | None = None) -> None:
    """Refuse faults that cannot be done.

    Parameters
    ----------
    faults : sequence of Fault
        All of a flight.
    states : sequence of str
        The model's.
    duration_ns : int or None
        Length of the flight, in which each fault must lie; None where that is not known.

    Raises
    ------
    InputError
        When a state does not exist, a fault lies outside the flight, two faults of a program overlap, or there
        are more than MAX_FAULTS.
    """
    if len(faults) > MAX_FAULTS:
        raise InputError(f"faults: expected at most {MAX_FAULTS}, found {len(faults)}")
    for fault in faults:
        text = format_fault(fault)
        if isinstance(fault, SensorFault) and fault.state not in states:
            raise InputError(f'fault "{text}": expected a state of {", ".join(states)}, found {fault.state}')
        if duration_ns is not None and (fault.at_ns >= duration_ns or (fault.end_ns or 0) > duration_ns):
            raise InputError(f'fault "{text}": expected it within the flight of {_seconds(duration_ns)}')
    for program in PROGRAMS:
        _check_program([fault for fault in faults if program_of(fault) == program])


def program_of(fault: Fault) -> str | None:
    """Return the program that a fault happens to; None where it is not one of PROGRAMS, or only a part of it."""
    match fault:
        case Kill(program=program) | Freeze(program=program) | Mute(program=program):
            return program
        case ClockStep(program=program) | ClockDrift(program=program):
            return program
        case CorruptGains():
            return "autopilot"
    return None


def _check_program(faults: list[Fault]) -> None:
    """Refuse two faults of one program at a time: a dead program has no clock, and one that starts is not mute."""
    lasting = [fault for fault in faults if not isinstance(fault, _ONCE)]
    for fault in faults:
        for other in lasting:
            first, then = sorted((other, fault), key=lambda each: each.at_ns)
            over_ns = first.at_ns + 1 if isinstance(first, _ONCE) else first.end_ns
            if other is not fault and (over_ns is None or then.at_ns < over_ns):
                raise InputError(f'fault "{format_fault(fault)}": expected it outside {format_fault(other)}')


class Phase(StrEnum):
    """What happens to a fault."""

    BEGIN = "begin"
    END = "end"


@dataclass(frozen=True, slots=True)
class FaultChange:
    """A fault that begins or ends ``at_ns``, from sample k = 0."""

    at_ns: int
    phase: Phase
    fault: Fault


def fault_changes(faults: Iterable[Fault]) -> list[FaultChange]:
    """Return what is to be done in the order of doing: at one instant what ends before what begins, then as given."""
    changes = []
    for fault in faults:
        changes.append(FaultChange(fault.at_ns, Phase.BEGIN, fault))
        if fault.end_ns is not None:
            changes.append(FaultChange(fault.end_ns, Phase.END, fault))
    return sorted(changes, key=lambda change: (change.at_ns, change.phase is Phase.BEGIN))


def fault_record(change: FaultChange, t_ns: int, **data: object) -> Record:
    """Return the event that tells a recording of a change, with more ``data`` where there is any."""
    text = format_fault(change.fault)
    body = {
        "kind": "fault",
        "node": "scenario",
        "text": f"{text} {change.phase}s",
        "data": {"fault": text, "phase": change.phase.value, **data},
    }
    return Record("events", t_ns, body)


def fault_of(event: Mapping[str, Any]) -> tuple[Fault, Phase] | None:
    """Return what an event of a recording, of whatever origin, tells of a fault; None where it tells of none."""
    if event["kind"] != "fault" or event["node"] != "scenario":
        return None
    try:
        return parse_fault(str(event["data"].get("fault"))), Phase(event["data"].get("phase"))
    except (InputError, ValueError):
        return None
