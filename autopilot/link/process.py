"""One node as an operating-system process: common options, signals, where its records go, how it ends.

Ctrl-C, SIGTERM and the end of the record stream all end the process in the same way: the loop stops
between two passes, the records are passed on, the files are closed.
"""

from __future__ import annotations

import gc
import re
import signal
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import click

from autopilot.link.clock import NS_PER_S, Clock
from autopilot.link.kernel import buffer_bytes, largest_buffer_bytes, sharpen_timers
from autopilot.link.keyring import Keyring
from autopilot.link.node import Node, Record
from autopilot.link.orders import obey
from autopilot.link.ports import RECEIVE_BUFFER_BYTES, Address, UdpPort, parse_address, true_ns
from autopilot.link.record import McapRecorder
from autopilot.link.stream import StreamSink
from autopilot.link.udp import RecordSink, UdpDriver
from gains.table import InputError

__all__ = [
    "ADDRESS",
    "CLOCK",
    "Parsed",
    "ProcessOptions",
    "format_clock",
    "parse_clock",
    "process_options",
    "run_node",
]

F = TypeVar("F", bound=Callable[..., Any])


MAX_DRIFT_PPB = 200_000
"""A crystal's drift at the most; clock estimates hold for two such clocks."""

_CLOCK = re.compile(r"(?P<offset>[0-9]{1,9}(\.[0-9]{1,9})?)s(:(?P<drift>[-+]?[0-9]{1,9}(\.[0-9]{1,9})?)ppm)?")


@dataclass(frozen=True, slots=True)
class ProcessOptions:
    """What every program that runs a node can be told.

    Attributes
    ----------
    clock : Clock
        The node's clock.
    record : Path or None
        MCAP file of its own.
    stream : Address or None
        Recorder to stream to.
    """

    clock: Clock
    record: Path | None
    stream: Address | None


def parse_clock(text: str) -> Clock:
    """Return the clock written as ``OFFSETs`` or ``OFFSETs:DRIFTppm``, for example ``137s:+40ppm``.

    Raises
    ------
    InputError
        For anything else, a negative offset, or a drift beyond that of any crystal, 200 ppm.
    """
    match = _CLOCK.fullmatch(text)
    offset_ns = round(float(match["offset"]) * NS_PER_S) if match else 0
    drift_ppb = round(float(match["drift"] or 0.0) * 1000) if match else 0
    if match is None or abs(drift_ppb) > MAX_DRIFT_PPB:
        raise InputError(f'clock "{text}": expected OFFSETs:DRIFTppm within 200 ppm, such as 137s:+40ppm')
    return Clock(offset_ns, drift_ppb)


def format_clock(clock: Clock) -> str:
    """Return the text that :func:`parse_clock` reads back."""
    return f"{clock.offset_ns / NS_PER_S:.9f}s:{clock.drift_ppb / 1000:.3f}ppm"


class Parsed(click.ParamType[Any]):
    """A click type from a function that raises InputError."""

    def __init__(self, name: str, parse: Callable[[str], Any]) -> None:
        self.name = name
        self._parse = parse

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Parse text; pass on what is parsed already."""
        return self._parse(value) if isinstance(value, str) else value


ADDRESS = Parsed("ADDRESS", parse_address)
CLOCK = Parsed("CLOCK", parse_clock)


def process_options(command: F) -> F:
    """Add ``--clock``, ``--record`` and ``--stream`` to a click command; it gets ``clock, record, stream``."""
    for option in (
        click.option("--stream", type=ADDRESS, hidden=True, help="Recorder to stream records to."),
        click.option(
            "--record",
            type=click.Path(dir_okay=False, path_type=Path),
            help="Write an MCAP recording of this program.",
        ),
        click.option(
            "--clock",
            type=CLOCK,
            default="0s",
            show_default=True,
            help="The node's own clock: OFFSETs:DRIFTppm at start.",
        ),
    ):
        command = option(command)
    return command


class _FileSink:
    """Writes a program's own recording, its times counted from the start of the program."""

    def __init__(self, recorder: McapRecorder) -> None:
        self._recorder = recorder
        self._start_ns = true_ns()

    def write(self, record: Record, log_time_ns: int) -> None:
        self._recorder.write(record, max(0, log_time_ns - self._start_ns))

    def pump(self) -> None:
        """Nothing waits: the recorder writes whole chunks as they fill."""


def run_node(
    name: str,
    node: Node,
    openers: Sequence[Callable[[], UdpPort]],
    options: ProcessOptions,
    metadata: Mapping[str, str],
    *,
    tap: bool,
    banner: str = "",
    control: int = 1,
    keyring: Keyring | None = None,
    spin_ns: int = 0,
    busy: bool = False,
    idle: Callable[[], None] | None = None,
    at_end: Callable[[int], None] | None = None,
) -> None:
    """Run a node over UDP until Ctrl-C, SIGTERM or the end of the record stream.

    Parameters
    ----------
    name : str
        The program.
    node : Node
        What runs.
    openers : sequence of callable
        Each opens one of the node's ports, control ports first.
    options : ProcessOptions
        Clock and recordings.
    metadata : mapping
        Of the program's own recording.
    tap : bool
        Whether datagrams are recorded.
    banner : str
        What is said once everything is open.
    control : int
        How many of the ports are control ports.
    keyring : Keyring, optional
        The keys of the ports; it is closed at the end.
    spin_ns : int
        How long before a deadline the driver stops sleeping, as :class:`autopilot.link.udp.UdpDriver` takes it.
    busy : bool
        Whether it never sleeps, likewise.
    idle : callable, optional
        What it does then while nothing comes, likewise.
    at_end : callable, optional
        Called with the node's time when the loop has ended; what the node records then is recorded.

    Raises
    ------
    InputError
        When the recording cannot be written or the recorder is not there.
    """
    stopped = False

    def stop(_signum: int, _frame: object) -> None:
        nonlocal stopped
        stopped = True

    for signum in (signal.SIGINT, signal.SIGTERM):
        signal.signal(signum, stop)
    with ExitStack() as stack:
        if keyring is not None:
            stack.callback(keyring.close)
        ports: list[UdpPort] = []
        for open_port in openers:
            ports.append(open_port())
            stack.callback(ports[-1].socket.close)  # whatever else cannot be opened
        sink, stream = _open_sink(stack, name, ports, options, metadata)
        for line in filter(None, (banner, _buffers_said(ports) if stream is None else "")):
            click.echo(line, err=True)
        sharpen_timers()
        gc.collect()
        gc.freeze()  # what is loaded now stays: no later collection has to look at it
        driver = UdpDriver(
            node, ports, options.clock, sink, tap=tap, control=control, spin_ns=spin_ns, busy=busy, idle=idle
        )
        stack.callback(driver.close)
        driver.on_pass = _chores(driver, keyring, stream)
        driver.run(lambda: stopped or (stream is not None and stream.closed))
        if at_end is not None:
            at_end(driver.clock.node_ns(true_ns()))
            if sink is not None:
                for record in node.records():
                    sink.write(record, driver.clock.true_ns(record.t_ns))
        if sink is not None:
            lost = stream.lost if stream is not None else 0
            sink.write(_port_counters(name, ports, lost, driver.clock.node_ns(true_ns())), true_ns())


def _open_sink(
    stack: ExitStack, name: str, ports: Sequence[UdpPort], options: ProcessOptions, metadata: Mapping[str, str]
) -> tuple[RecordSink | None, StreamSink | None]:
    """Return where the records go, and the stream if it is one; both end with the stack."""
    if options.stream is not None:
        stream = StreamSink(options.stream, name, {port.name: port.local for port in ports})
        stack.callback(stream.close)
        return stream, stream
    if options.record is None:
        return None, None
    try:
        return _FileSink(stack.enter_context(McapRecorder(options.record, metadata))), None
    except OSError as error:
        raise InputError(f"{options.record}: {error.strerror or error}") from None


def _chores(driver: UdpDriver, keyring: Keyring | None, stream: StreamSink | None) -> Callable[[int], None]:
    """Return what is done at the end of each pass: writing timestamps ahead, carrying out orders."""

    def on_pass(now_ns: int) -> None:
        if keyring is not None:
            keyring.pass_(now_ns)
        if stream is not None:
            for order in stream.orders():
                obey(order, driver)

    return on_pass


def _buffers_said(ports: Sequence[UdpPort]) -> str:
    """Return the line about receive buffers of ports that take bursts; empty for a program that has none."""
    wide = [port for port in ports if port.asked_bytes > RECEIVE_BUFFER_BYTES]
    if not wide:
        return ""
    limit = largest_buffer_bytes()
    given = ", ".join(f"{port.name} {_mebi(buffer_bytes(port.socket))} of {_mebi(port.asked_bytes)}" for port in wide)
    return f"receive buffers: {given} (net.core.rmem_max: {'unknown' if limit is None else _mebi(limit)})"


def _mebi(size: int) -> str:
    return f"{size / (1 << 20):.3g} MiB"


def _port_counters(name: str, ports: Sequence[UdpPort], records_lost: int, t_ns: int) -> Record:
    """Return the event that says what the ports refused and could not send, and what was not recorded."""
    data = {
        port.name: {
            "strangers": port.strangers,
            "empty": port.empty,
            "unsent": port.unsent,
            "overflowed": port.overflowed,
            "unstamped": port.unstamped if port.stamps else None,
            "buffer_bytes": buffer_bytes(port.socket),
        }
        for port in ports
    }
    limits = {"records_lost": records_lost, "buffer_limit_bytes": largest_buffer_bytes()}
    body = {"kind": "ports", "node": name, "text": f"{name} ports", "data": {**data, **limits}}
    return Record("events", t_ns, body)
