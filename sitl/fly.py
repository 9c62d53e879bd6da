"""``sitl fly``: one flight from start to verdict, over UDP as three processes or in virtual time as one."""

from __future__ import annotations

import shlex
import signal
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import time_ns  # noqa: TID251  a tlog carries the time of day
from typing import Any

import orjson
from rich.console import Console

from autopilot.link.clock import NS_PER_MS, NS_PER_S, NS_PER_US
from autopilot.link.node import Record
from autopilot.link.udp import true_ns
from gains.command import version
from sitl.aircraft.wind import format_wind
from sitl.faults import DiskFull, Fault
from sitl.flight import fly_virtual
from sitl.flightdata import FlightData
from sitl.flightfile import attachments_of
from sitl.injector import Injector, check_feasible
from sitl.link.changes import format_change
from sitl.link.rules import format_rule
from sitl.link.spec import format_spec
from sitl.processes import ChildDied, FlightFailed, Supervisor
from sitl.programs import DEFAULT_PORT_BASE, FlightOptions, start_programs
from sitl.recorder import FlightRecorder
from sitl.scenario import Scenario
from sitl.summary import Verdict, judge, summarise
from sitl.view import FlightView

__all__ = ["DEFAULT_PORT_BASE", "FlightOptions", "Outcome", "fly"]

REFRESH_NS = 100 * NS_PER_MS
SILENCE_LIMIT_NS = 20 * NS_PER_S
"""A flight whose plant sends no sample for so long is over."""
NO_SAMPLE = f"no sample within {SILENCE_LIMIT_NS // NS_PER_S} s: does the link pass anything?"


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a flight came to.

    Attributes
    ----------
    summary : dict
        As ``--json`` prints it.
    verdicts : list of Verdict
        Its checks.
    interrupted : bool
        Ended by Ctrl-C.
    """

    summary: dict[str, Any]
    verdicts: list[Verdict]
    interrupted: bool

    @property
    def passed(self) -> bool:
        """Whether every check passed."""
        return all(verdict.passed for verdict in self.verdicts)


def fly(scenario: Scenario, options: FlightOptions, console: Console) -> Outcome:
    """Fly a scenario, write its files, and judge it.

    Raises
    ------
    InputError
        When a file or an address is not to be had.
    FlightFailed
        When one of the programs ended by itself, or no sample came; the files are complete up to then.
    """
    unix_us = 0 if options.virtual else time_ns() // NS_PER_US
    with ExitStack() as stack:
        interrupted = stack.enter_context(_interruptible())
        tlog_port = "gcs0" if options.ground_stations else "plant"
        files = {} if options.folder is None else attachments_of(scenario.gains_name, scenario.plant_name)
        recorder = stack.enter_context(
            FlightRecorder(options.folder, _metadata(scenario, options), unix_us, tlog_port, files)
        )
        view = stack.enter_context(FlightView(scenario, console, virtual=options.virtual))
        if options.virtual:
            _fly_in_process(scenario, options, recorder, view, interrupted)
        else:
            _fly_in_processes(scenario, options, recorder, view, interrupted)
    return _conclude(scenario, options, recorder, interrupted())


def _metadata(scenario: Scenario, options: FlightOptions) -> dict[str, str]:
    """Return what the recording says about itself; nothing of the wall clock, so equal flights are equal bytes."""
    gains = scenario.gains
    return {
        "scenario": scenario.name,
        "title": scenario.title,
        "seed": str(scenario.seed),
        "gains": gains.name,
        "d_min": str(gains.d_min),
        "d_max": str(gains.d_max),
        "plant": scenario.plant_name,
        "Ts": repr(scenario.plant.Ts),
        "actuator": scenario.actuator,
        "reference": scenario.reference,
        **({"wind": format_wind(scenario.wind)} if scenario.wind is not None else {}),
        "up": format_spec(scenario.up),
        "down": format_spec(scenario.down),
        **({"rules": shlex.join(map(format_rule, scenario.rules))} if scenario.rules else {}),
        **({"changes": shlex.join(map(format_change, scenario.changes))} if scenario.changes else {}),
        **({} if scenario.witness_name is None else {"witness": Path(scenario.witness_name).name}),
        "time": "virtual" if options.virtual else "udp",
        "lagproof": version(),
    }


@contextmanager
def _interruptible() -> Iterator[Callable[[], bool]]:
    """Turn Ctrl-C and SIGTERM into a question, so that a flight ends between two events."""
    stopped = False

    def stop(_signum: int, _frame: object) -> None:
        nonlocal stopped
        stopped = True

    before = {signum: signal.signal(signum, stop) for signum in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: stopped
    finally:
        for signum, handler in before.items():
            signal.signal(signum, handler)


def _fly_in_process(
    scenario: Scenario,
    options: FlightOptions,
    recorder: FlightRecorder,
    view: FlightView,
    interrupted: Callable[[], bool],
) -> None:
    """Fly in virtual time."""
    refreshed_ns = true_ns()

    def write(record: Record, log_time_ns: int) -> None:
        nonlocal refreshed_ns
        recorder.write(record, log_time_ns)
        view.take(record, log_time_ns)
        if record.topic == "plant/truth" and true_ns() - refreshed_ns >= REFRESH_NS:
            refreshed_ns = true_ns()
            view.refresh(log_time_ns)

    def on_fault(fault: Fault) -> None:
        if isinstance(fault, DiskFull):
            recorder.fill_disk()

    stations = len(options.ground_stations)
    fly_virtual(scenario, write, ground_stations=stations, stopping=interrupted, on_fault=on_fault)


@dataclass(slots=True)
class _Progress:
    """How far a flight over UDP is, as its samples tell; all times true.

    Attributes
    ----------
    samples : int
        The flight's length.
    Ts_ns : int
        The plant's sampling time.
    timed : bool
        Whether it ends by true time, as its plant may start again, or not at all; else with its last sample.
    newest_ns : int or None
        When the newest sample was taken.
    zero_ns : int or None
        When sample k = 0 was.
    end_ns : int
        When the flight is over; far ahead where that is not known.
    """

    samples: int
    Ts_ns: int
    timed: bool
    newest_ns: int | None = None
    zero_ns: int | None = None
    end_ns: int = 1 << 63

    def take(self, truth: Mapping[str, Any], at_ns: int) -> None:
        """Take a record of plant/truth."""
        k = int(truth["k"])
        self.newest_ns = at_ns
        if self.zero_ns is None:
            self.zero_ns = at_ns - int(truth["late_ns"]) - k * self.Ts_ns
            if self.timed:  # the last sample is in, whatever drifts
                self.end_ns = self.zero_ns + self.samples * self.Ts_ns - self.Ts_ns // 2
        if not self.timed and k + 1 >= self.samples:
            self.end_ns = at_ns

    def silent(self, since_ns: int, now_ns: int) -> bool:
        """Whether the plant has sent nothing for too long; in a flight with faults that may have been ordered."""
        if self.timed and self.zero_ns is not None:
            return False
        return now_ns - (self.newest_ns or since_ns) > SILENCE_LIMIT_NS


def _fly_in_processes(
    scenario: Scenario,
    options: FlightOptions,
    recorder: FlightRecorder,
    view: FlightView,
    interrupted: Callable[[], bool],
) -> None:
    """Fly over UDP: plant, relay and autopilot as processes of their own."""
    check_feasible(scenario.faults)
    start_ns = true_ns()
    progress = _Progress(scenario.samples, scenario.plant.Ts_ns, bool(scenario.faults))

    def write(record: Record, at_ns: int) -> None:
        if at_ns > progress.end_ns and record.body.get("kind") != "ports":
            return  # flown while the programs were being told to end; what they could not record they tell last
        if record.topic == "plant/truth":
            progress.take(record.body, at_ns)
        log_time_ns = max(0, at_ns - start_ns)
        recorder.write(record, log_time_ns)
        view.take(record, log_time_ns)

    with ExitStack() as stack:
        folder = options.folder or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        supervisor = Supervisor(folder, write)
        stack.callback(supervisor.close)
        programs = start_programs(scenario, options, supervisor, interrupted)
        command_line = partial(programs.again, folder=folder)
        injector = Injector(scenario.faults, supervisor, command_line, recorder.fill_disk, write, true_ns)
        try:
            _follow(supervisor, injector, progress, lambda: view.refresh(true_ns() - start_ns), interrupted)
        finally:
            killed = supervisor.stop()
            recorder.malformed = supervisor.malformed
        if killed:
            raise ChildDied(killed[0], None, "it did not end when asked to")


def _follow(
    supervisor: Supervisor,
    injector: Injector,
    progress: _Progress,
    refresh: Callable[[], None],
    interrupted: Callable[[], bool],
) -> None:
    """Pass on what comes and do what is due, until the flight is over."""
    refresh_ns = start_ns = true_ns()
    while (now_ns := true_ns()) < progress.end_ns and not interrupted():
        injector.zero_ns = progress.zero_ns
        injector.act()
        if now_ns >= refresh_ns:
            refresh()
            refresh_ns = now_ns + REFRESH_NS
        wake_ns = min(refresh_ns, progress.end_ns, injector.next_ns() or refresh_ns)
        supervisor.poll(max(0, wake_ns - true_ns()) / NS_PER_S)
        if progress.silent(start_ns, true_ns()):
            raise FlightFailed(NO_SAMPLE)


def _conclude(scenario: Scenario, options: FlightOptions, recorder: FlightRecorder, interrupted: bool) -> Outcome:
    """Compute the summary, fly the variants beside it, draw, judge."""
    try:
        flight = FlightData.from_records(recorder.kept, scenario.plant, recorder.metadata)
    except ValueError:
        if interrupted:
            raise KeyboardInterrupt from None
        raise FlightFailed(NO_SAMPLE) from None
    summary = summarise(scenario, recorder.kept, flight, virtual=options.virtual)
    summary["interrupted"] = interrupted
    if not interrupted:
        summary["variants"] = {name: _fly_beside(variant) for name, variant in scenario.variants.items()}
    folder = options.folder
    files = recorder.files
    if folder is not None:
        from sitl.plot import plot_flight  # slow to import, and the programs that fly have no use for it

        recorder.save("plot", folder / "flight.png", lambda path: plot_flight(path, flight))
        files = {**recorder.files, "summary": folder / "summary.json"}
    summary["problems"] = recorder.problems
    summary["files"] = {name: str(path) for name, path in files.items()}
    verdicts = judge(() if interrupted else scenario.checks, summary)
    summary["checks"] = [
        {"name": v.check.name, "metric": v.check.metric, "value": v.value, "passed": v.passed} for v in verdicts
    ]
    summary["passed"] = all(v.passed for v in verdicts)
    if folder is not None:
        content = orjson.dumps(summary, option=orjson.OPT_INDENT_2 | orjson.OPT_APPEND_NEWLINE)
        recorder.save("summary", files["summary"], lambda path: path.write_bytes(content))
        summary["problems"] = recorder.problems
        summary["files"] = {name: str(path) for name, path in recorder.files.items()}
    return Outcome(summary, verdicts, interrupted)


def _fly_beside(variant: Scenario) -> dict[str, Any]:
    """Fly a variant in virtual time and return its summary."""
    with FlightRecorder(None, {"reference": variant.reference}) as recorder:
        fly_virtual(variant, recorder.write)
    flight = FlightData.from_records(recorder.kept, variant.plant, recorder.metadata)
    return summarise(variant, recorder.kept, flight, virtual=True)
