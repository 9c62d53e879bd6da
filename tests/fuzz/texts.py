"""What lines and words do to the grammars: they mean something, and the same when written again, or are refused."""

from __future__ import annotations

import math
import socket
from contextlib import suppress
from functools import cache
from pathlib import Path

from autopilot.link.clock import NS_PER_S
from autopilot.link.node import Record
from autopilot.link.orders import decode_order, encode_order
from autopilot.link.process import format_clock, parse_clock
from autopilot.link.record import decode_line, encode_line
from autopilot.link.udp import parse_address
from autopilot.profile import parse_profile
from gains.table import InputError
from sitl.faults import check_faults, format_fault, parse_fault
from sitl.link.spec import format_spec, parse_spec
from sitl.processes import Supervisor, _Child, _Connection
from tests.fuzz.refusing import refusing
from tests.helpers import HIRM

TS = 0.025
TOKEN = "t"
"""The token of a stream here; a real one is long and random, and nobody gets past it."""


def _text(data: bytes) -> str:
    """Return any bytes as text, what is no UTF-8 as the surrogates that a command line gives."""
    return data.decode("utf-8", "surrogateescape")


@refusing(InputError)
def spec(data: bytes) -> None:
    """A link; a file that it may name is none of this target."""
    text = _text(data)
    if any(word in text for word in ("trace", "table")):
        return
    link = parse_spec(text)
    again = parse_spec(format_spec(link))
    assert again == link, format_spec(link)


@refusing(InputError)
def fault(data: bytes) -> None:
    """A fault on demand, and whether this aircraft can have it."""
    made = parse_fault(_text(data))
    assert parse_fault(format_fault(made)) == made, format_fault(made)
    check_faults([made], HIRM.model.states, 10 * NS_PER_S)


@refusing(InputError)
def address(data: bytes) -> None:
    """An address of a command line."""
    host, port = parse_address(_text(data))
    assert host
    assert 0 <= port <= 65_535
    assert parse_address(f"[{host}]:{port}")[1] == port


@refusing(InputError)
def clock(data: bytes) -> None:
    """A clock of a command line."""
    made = parse_clock(_text(data))
    assert parse_clock(format_clock(made)) == made


@refusing(InputError)
def profile(data: bytes) -> None:
    """A programmed reference: every r is a number, and stays what it is as long as it says."""
    text = _text(data)
    if "file:" in text:
        return
    check_source(parse_profile(text, TS))


def check_source(source: object) -> None:
    """Check the promises of :class:`autopilot.profile.Source`, at its own changes too."""
    k = 0
    for _ in range(20):
        r = source.r(k)  # type: ignore[attr-defined]
        assert math.isfinite(r)
        end = k + 10_000
        until = source.constant_until(k, end)  # type: ignore[attr-defined]
        assert k < until <= end
        assert source.r(until - 1) == r  # type: ignore[attr-defined]
        k = until


@refusing(ValueError)
def line(data: bytes) -> None:
    """A line of a record stream."""
    record, log_time_ns = decode_line(data)
    again = decode_line(encode_line(Record(record.topic, record.t_ns, record.body), log_time_ns))
    assert again == (record, log_time_ns)


@refusing(ValueError)
def order(data: bytes) -> None:
    """A supervisor's order."""
    made = decode_order(data)
    assert decode_order(encode_order(made)) == made


@cache
def _supervisor() -> tuple[Supervisor, list[Record]]:
    written: list[Record] = []
    supervisor = Supervisor(Path(), lambda record, _: written.append(record))
    supervisor._token = TOKEN
    return supervisor, written


@refusing()
def stream(data: bytes) -> None:
    """Everything that a process writes into the supervisor's socket, hello included; then it goes."""
    supervisor, written = _supervisor()
    supervisor._children.clear()
    supervisor._children["plant"] = _Child("plant", None, Path())  # type: ignore[arg-type]
    supervisor.malformed = 0
    written.clear()
    ours, theirs = socket.socketpair()
    ours.setblocking(False)
    connection = _Connection(ours)
    supervisor._selector.register(ours, 1, connection)
    supervisor._unknown.append(connection)
    with suppress(BrokenPipeError, ConnectionResetError), theirs:
        for start in range(0, len(data), 1 << 12):
            theirs.sendall(data[start : start + (1 << 12)])
            supervisor._read(connection)
    supervisor._read(connection)
    assert connection.socket.fileno() < 0, "the stream has ended, and its socket is open"
    assert supervisor._unknown == []
    after_hello = max(0, data.count(b"\n") - 1) if connection.child is not None else 0
    assert len(written) + supervisor.malformed == after_hello
