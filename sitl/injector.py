"""Faults over UDP: a schedule that says what is due, and what is done to the programs when it is.

The schedule is pure. The injector gives its orders to the supervisor, and tells of each as an event in the recording.
What happens to sensors and elevator the plant does itself, by its own command line, in its own time; here it is told
only. The neighbour of a program that starts again is told where it calls from: an order, but no fault.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence

from autopilot.link.clock import NS_PER_S
from autopilot.link.node import Record
from autopilot.link.orders import BreakSends, DriftClock, MovePeer, StepClock
from autopilot.link.udp import Address
from gains.table import InputError
from sitl.faults import (
    ClockDrift,
    ClockStep,
    CorruptGains,
    DiskFull,
    Fault,
    FaultChange,
    Freeze,
    Kill,
    Mute,
    Phase,
    fault_changes,
    fault_record,
    format_fault,
)
from sitl.processes import CAN_FREEZE, Supervisor

__all__ = ["CALLED", "FaultSchedule", "Injector", "check_feasible"]

CALLED = {"relay": "plant", "autopilot": "relay"}
"""Whom a program calls; the plant calls nobody."""


def check_feasible(faults: Iterable[Fault]) -> None:
    """Refuse faults that this system cannot bring about.

    Raises
    ------
    InputError
        For a freeze where there is no SIGSTOP.
    """
    for fault in faults:
        if isinstance(fault, Freeze) and not CAN_FREEZE:
            raise InputError(f'fault "{format_fault(fault)}": expected a system with SIGSTOP, or --virtual')


class FaultSchedule:
    """What is to happen next; times from sample k = 0.

    Parameters
    ----------
    faults : iterable of Fault
        All of a flight.
    """

    def __init__(self, faults: Iterable[Fault]) -> None:
        self._changes = deque(fault_changes(faults))

    def next_ns(self) -> int | None:
        """Return when the next fault begins or ends; None when all is done."""
        return self._changes[0].at_ns if self._changes else None

    def take(self, now_ns: int) -> FaultChange | None:
        """Take away the next change if it is due; None if none is."""
        return self._changes.popleft() if self._changes and self._changes[0].at_ns <= now_ns else None


class Injector:
    """Brings a flight's faults about.

    Parameters
    ----------
    faults : iterable of Fault
        All of the flight.
    supervisor : Supervisor
        Of the programs, all of which have said hello; from now on it reports to the injector.
    command_line : callable
        Takes a program's name, and ``corrupt_gains=True`` where its gain file shall be a damaged one; returns what
        to start.
    fill_disk : callable
        Fills the recorder's disk.
    write : callable
        Takes each event and its true time.
    now : callable
        Returns true time, ns.

    Attributes
    ----------
    zero_ns : int or None
        True time of sample k = 0, once it is known: nothing happens before.
    """

    def __init__(
        self,
        faults: Iterable[Fault],
        supervisor: Supervisor,
        command_line: Callable[..., Sequence[str]],
        fill_disk: Callable[[], None],
        write: Callable[[Record, int], None],
        now: Callable[[], int],
    ) -> None:
        self.zero_ns: int | None = None
        self._schedule = FaultSchedule(faults)
        self._supervisor = supervisor
        self._command_line = command_line
        self._fill_disk = fill_disk
        self._write = write
        self._now = now
        supervisor.on_hello = self._heard
        supervisor.on_exit = self._ended

    def next_ns(self) -> int | None:
        """Return the true time at which something is to be done; None for never, or not known yet."""
        at_ns = self._schedule.next_ns()
        return None if at_ns is None or self.zero_ns is None else self.zero_ns + at_ns

    def act(self) -> None:
        """Do what is due."""
        if self.zero_ns is None:
            return
        while (change := self._schedule.take((now_ns := self._now()) - self.zero_ns)) is not None:
            self._write(fault_record(change, now_ns, late_ns=now_ns - self.zero_ns - change.at_ns), now_ns)
            if change.phase is Phase.BEGIN:
                self._begin(change.fault)
            else:
                self._end(change.fault)

    def _begin(self, fault: Fault) -> None:
        supervisor = self._supervisor
        match fault:
            case Kill(program=program):
                supervisor.kill(program)
            case CorruptGains():
                supervisor.kill("autopilot")
                supervisor.start("autopilot", self._command_line("autopilot", corrupt_gains=True), may_end=True)
            case Freeze(program=program):
                supervisor.freeze(program)
            case Mute(program=program, for_ns=for_ns):
                assert for_ns is not None
                supervisor.order(program, BreakSends(for_ns))
            case ClockStep(program=program, by_ns=by_ns):
                supervisor.order(program, StepClock(by_ns))
            case ClockDrift(program=program, drift_ppb=drift_ppb):
                supervisor.order(program, DriftClock(drift_ppb))
            case DiskFull():
                self._fill_disk()
            case _:
                pass  # the plant's own

    def _end(self, fault: Fault) -> None:
        supervisor = self._supervisor
        match fault:
            case Kill(program=program):
                supervisor.start(program, self._command_line(program))
            case CorruptGains():
                supervisor.kill("autopilot")  # it refused long ago, or else is about to
                supervisor.start("autopilot", self._command_line("autopilot"))
            case Freeze(program=program):
                supervisor.thaw(program)
            case Mute(program=program):
                supervisor.order(program, BreakSends(0))
            case _:
                pass

    def _heard(self, name: str, ports: Mapping[str, Address], after_ns: int) -> None:
        """Tell of a program that is there again, and its neighbour where it is."""
        text = f"listens again, {after_ns / NS_PER_S:.2f} s after its start"
        self._tell("start", name, text, {"after_ns": after_ns})
        called = CALLED.get(name)
        if called is not None and "plant" in ports:
            self._supervisor.order(called, MovePeer(ports["plant"][1]))

    def _ended(self, name: str, code: int, last_words: str) -> None:
        """Tell of a program that has ended, as it might."""
        self._tell("exit", name, last_words or f"ended with exit code {code}", {"code": code})

    def _tell(self, kind: str, node: str, text: str, data: Mapping[str, object]) -> None:
        now_ns = self._now()
        self._write(Record("events", now_ns, {"kind": kind, "node": node, "text": text, "data": data}), now_ns)
