"""How long it takes until the law has the elevator again after a fault, from the records of a flight.

It has the elevator at a sample when the plant holds a command that a law made since the fault was over; the plant's
servo time-out is no law. It has it *again* when it keeps it for a second, or up to the next fault or the end: a clock
that steps is noticed some samples later, and what the law does until then is not yet recovery. A next fault that leaves
no sample in between counts as the same.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any, NamedTuple

from autopilot.failsafe import FLOWN_BY_LAW, Mode
from autopilot.link.clock import NS_PER_S
from sitl.faults import ClockDrift, ClockStep, DiskFull, Fault, Phase, fault_of, format_fault

__all__ = ["LASTING_NS", "Recovery", "longest_recovery_s", "recoveries"]

LASTING_NS = NS_PER_S
"""The law has the elevator again when it keeps it for so long."""

Kept = tuple[str, int, Mapping[str, Any]]


@dataclass(frozen=True, slots=True)
class Recovery:
    """A fault of a flight and how it came to an end; times in s from sample k = 0.

    Attributes
    ----------
    fault : str
        Its text.
    begin_s : float
        When it began.
    end_s : float or None
        When it was over: at once for what happens at one instant, such as a step of a clock; None where it lasted.
    recovered_s : float or None
        Since when the law has the elevator again; None where it never does, or the fault lasted.
    """

    fault: str
    begin_s: float
    end_s: float | None
    recovered_s: float | None


class _Period(NamedTuple):
    """A fault as recorded, true times."""

    text: str
    begin_ns: int
    end_ns: int | None


@dataclass(frozen=True, slots=True)
class _Flown:
    """The records that matter, each list in order of time."""

    steps: list[Kept]
    """Samples, and commands."""
    modes: list[tuple[int, str]]
    begins_ns: list[int]

    def mode_before(self, at_ns: int) -> str | None:
        """Return the mode of the failsafe before a time."""
        i = bisect_left(self.modes, at_ns, key=itemgetter(0))
        return self.modes[i - 1][1] if i else None

    def recovered_ns(self, period: _Period, end_ns: int) -> int | None:
        """Return since when a law has the elevator again after a fault."""
        before = self.mode_before(period.begin_ns)
        laws = {Mode.TRACKING.value} | ({before} & {mode.value for mode in FLOWN_BY_LAW})
        limits = iter(self.begins_ns[bisect_left(self.begins_ns, end_ns + 1) :])
        limit_ns = next(limits, None)
        made: dict[int, str] = {}
        since_ns: int | None = None
        last_k = -1
        for topic, at_ns, body in self.steps[bisect_left(self.steps, end_ns, key=itemgetter(1)) :]:
            if topic == "autopilot/command":
                made[body["j"]] = body["mode"]
                continue
            while limit_ns is not None and at_ns >= limit_ns and last_k < 0:
                limit_ns = next(limits, None)
            if limit_ns is not None and at_ns >= limit_ns:
                break
            if body["k"] <= last_k:
                made.clear()  # the plant has started again
            last_k = body["k"]
            if body["timeout"] or made.get(body["j"]) not in laws:
                since_ns = None
            elif since_ns is None:
                since_ns = at_ns
            elif at_ns - since_ns >= LASTING_NS:
                break
        return since_ns


def recoveries(kept: Sequence[Kept]) -> list[Recovery]:
    """Return each fault that the records tell of, in the order of beginning."""
    changes = [(at_ns, *change) for topic, at_ns, body in kept if topic == "events" and (change := fault_of(body))]
    if not changes:
        return []
    flown = _Flown([], [], [])
    for topic, at_ns, body in sorted(kept, key=itemgetter(1)):
        if topic in ("plant/truth", "autopilot/command"):
            flown.steps.append((topic, at_ns, body))
        if topic == "autopilot/command":
            flown.modes.append((at_ns, body["mode"]))
        elif topic == "events" and body["kind"] == "failsafe":
            flown.modes.append((at_ns, body["data"]["to"]))
    periods = _periods(sorted(changes, key=itemgetter(0)))
    flown.begins_ns.extend(period.begin_ns for period in periods)
    zero_ns = next((at_ns for topic, at_ns, _ in flown.steps if topic == "plant/truth"), 0)
    return [_recovery(period, flown, zero_ns) for period in periods]


def _periods(changes: Sequence[tuple[int, Fault, Phase]]) -> list[_Period]:
    """Return what the events tell, each begin with the first end of the same fault that is not another's."""
    periods = []
    ends = [(fault, at_ns) for at_ns, fault, phase in changes if phase is Phase.END]
    for at_ns, fault, phase in changes:
        if phase is Phase.END:
            continue
        end = next((end for end in ends if end[0] == fault and end[1] >= at_ns), None)
        if end is not None:
            ends.remove(end)
        at_once = isinstance(fault, ClockStep | ClockDrift | DiskFull)
        end_ns = at_ns if at_once else None if end is None else end[1]
        periods.append(_Period(format_fault(fault), at_ns, end_ns))
    return periods


def _recovery(period: _Period, flown: _Flown, zero_ns: int) -> Recovery:
    begin_s = (period.begin_ns - zero_ns) / NS_PER_S
    if period.end_ns is None:
        return Recovery(period.text, begin_s, None, None)
    recovered_ns = flown.recovered_ns(period, period.end_ns)
    recovered_s = None if recovered_ns is None else (recovered_ns - zero_ns) / NS_PER_S
    return Recovery(period.text, begin_s, (period.end_ns - zero_ns) / NS_PER_S, recovered_s)


def longest_recovery_s(faults: Iterable[Recovery]) -> float | None:
    """Return the longest time from the end of a fault to recovery, s; None where there was none, or never one."""
    waits = [
        None if fault.recovered_s is None else fault.recovered_s - fault.end_s
        for fault in faults
        if fault.end_s is not None
    ]
    known = [wait for wait in waits if wait is not None]
    return max(known) if known and len(known) == len(waits) else None
