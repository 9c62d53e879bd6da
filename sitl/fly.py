"""``sitl fly``: one flight from start to verdict, over UDP as three processes or in virtual time as one."""

from __future__ import annotations

import re
import signal
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import time_ns  # noqa: TID251  a tlog carries the time of day
from typing import Any

import orjson
from rich.console import Console

from autopilot.link.clock import NS_PER_MS, NS_PER_S, NS_PER_US
from autopilot.link.node import Record
from autopilot.link.udp import true_ns
from gains.command import version
from gains.table import InputError
from sitl.flight import fly_virtual
from sitl.flightdata import FlightData
from sitl.processes import ChildDied, FlightFailed, Supervisor
from sitl.recorder import FlightRecorder
from sitl.scenario import Scenario, autopilot_arguments, plant_arguments, relay_arguments
from sitl.summary import Verdict, judge, summarise
from sitl.view import FlightView

__all__ = ["FlightOptions", "Outcome", "fly"]

REFRESH_NS = 100 * NS_PER_MS
SILENCE_LIMIT_NS = 20 * NS_PER_S
"""A flight whose plant sends no sample for so long is over."""
NO_SAMPLE = f"no sample within {SILENCE_LIMIT_NS // NS_PER_S} s: does the link pass anything?"
DEFAULT_PORT_BASE = 14600


@dataclass(frozen=True, slots=True)
class FlightOptions:
    """How a scenario is flown.

    Attributes
    ----------
    virtual : bool
        In virtual time, else over UDP.
    folder : Path or None
        Where the files go; None keeps none.
    ground_stations : tuple of str
        Addresses that get telemetry.
    port_base : int
        The plant listens there and the relay on the next port; 0 for any free ports.
    ground_arguments : tuple of str
        Options of the autopilot that are about ground stations, over UDP.
    key_file, gcs_key_file : Path or None
        Keys of the control link and of the ground stations' links, over UDP.
    """

    virtual: bool
    folder: Path | None
    ground_stations: tuple[str, ...] = ()
    port_base: int = DEFAULT_PORT_BASE
    ground_arguments: tuple[str, ...] = ()
    key_file: Path | None = None
    gcs_key_file: Path | None = None


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
        recorder = stack.enter_context(FlightRecorder(options.folder, _metadata(scenario, options), unix_us, tlog_port))
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

    fly_virtual(scenario, write, ground_stations=len(options.ground_stations), stopping=interrupted)


def _fly_in_processes(
    scenario: Scenario,
    options: FlightOptions,
    recorder: FlightRecorder,
    view: FlightView,
    interrupted: Callable[[], bool],
) -> None:
    """Fly over UDP: plant, relay and autopilot as processes of their own."""
    start_ns = true_ns()
    flown, end_ns = 0, 1 << 63

    def write(record: Record, at_ns: int) -> None:
        nonlocal flown, end_ns
        if at_ns > end_ns:
            return  # flown while the programs were being told to end
        if record.topic == "plant/truth":
            flown = int(record.body["k"]) + 1
            if flown == scenario.samples:
                end_ns = at_ns
        log_time_ns = max(0, at_ns - start_ns)
        recorder.write(record, log_time_ns)
        view.take(record, log_time_ns)

    with ExitStack() as stack:
        folder = options.folder or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        supervisor = Supervisor(folder, write)
        stack.callback(supervisor.close)
        _start_programs(scenario, options, supervisor, interrupted)
        seen, seen_ns = 0, true_ns()
        try:
            while flown < scenario.samples and not interrupted():
                supervisor.poll(REFRESH_NS / 1e9)
                view.refresh(true_ns() - start_ns)
                if flown > seen:
                    seen, seen_ns = flown, true_ns()
                elif true_ns() - seen_ns > SILENCE_LIMIT_NS:
                    raise FlightFailed(NO_SAMPLE)
        finally:
            killed = supervisor.stop()
            recorder.malformed = supervisor.malformed
        if killed:
            raise ChildDied(killed[0], None, "it did not end when asked to")


def _start_programs(
    scenario: Scenario, options: FlightOptions, supervisor: Supervisor, interrupted: Callable[[], bool]
) -> None:
    """Start the programs, each as soon as the address it dials is known; an error of theirs is an input error."""
    plant_port = options.port_base
    relay_port = options.port_base + 1 if options.port_base else 0
    stations = [argument for address in options.ground_stations or ("none",) for argument in ("--gcs", address)]
    try:
        key = [] if options.key_file is None else ["--key", str(options.key_file)]
        listen = ["--listen", f"127.0.0.1:{plant_port}"]
        supervisor.start("plant", ["sitl", "plant", *listen, *key, *plant_arguments(scenario)])
        if not plant_port:
            plant_port = supervisor.wait_ready("plant", interrupted).get("autopilot", ("", 0))[1]
        if interrupted():
            return
        relay = ["--listen", f"127.0.0.1:{relay_port}", "--to", f"127.0.0.1:{plant_port}"]
        supervisor.start("relay", ["sitl", "relay", *relay, *relay_arguments(scenario)])
        if not relay_port:
            relay_port = supervisor.wait_ready("relay", interrupted).get("autopilot", ("", 0))[1]
        if interrupted():
            return
        plant = ["--plant", f"udpout:127.0.0.1:{relay_port}", *_ground_arguments(options)]
        supervisor.start("autopilot", ["autopilot", *plant, *stations, *autopilot_arguments(scenario)])
        for name in ("plant", "relay", "autopilot"):
            supervisor.wait_ready(name, interrupted)
    except ChildDied as death:
        if death.code == 2 and death.last_words:
            raise InputError(re.sub(r"^\w+: error: ", "", death.last_words)) from None
        raise


def _ground_arguments(options: FlightOptions) -> list[str]:
    """Return the options of the autopilot that are none of the scenario."""
    arguments = list(options.ground_arguments)
    for port, path in (("plant", options.key_file), ("gcs", options.gcs_key_file)):
        arguments += [] if path is None else ["--key", f"{port}={path}"]
    return arguments


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
    summary["problems"] = recorder.problems
    files = dict(recorder.files)
    if options.folder is not None:
        files["plot"] = options.folder / "flight.png"
        from sitl.plot import plot_flight  # slow to import, and the programs that fly have no use for it

        plot_flight(files["plot"], flight)
        files["summary"] = options.folder / "summary.json"
    summary["files"] = {name: str(path) for name, path in files.items()}
    verdicts = judge(() if interrupted else scenario.checks, summary)
    summary["checks"] = [
        {"name": v.check.name, "metric": v.check.metric, "value": v.value, "passed": v.passed} for v in verdicts
    ]
    summary["passed"] = all(v.passed for v in verdicts)
    if options.folder is not None:
        files["summary"].write_bytes(orjson.dumps(summary, option=orjson.OPT_INDENT_2) + b"\n")
    return Outcome(summary, verdicts, interrupted)


def _fly_beside(variant: Scenario) -> dict[str, Any]:
    """Fly a variant in virtual time and return its summary."""
    with FlightRecorder(None, {"reference": variant.reference}) as recorder:
        fly_virtual(variant, recorder.write)
    flight = FlightData.from_records(recorder.kept, variant.plant, recorder.metadata)
    return summarise(variant, recorder.kept, flight, virtual=True)
