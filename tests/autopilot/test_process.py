"""Clocks on the command line; what a program says of its ports."""

from __future__ import annotations

import gc
import os
import signal
from collections.abc import Iterator
from functools import partial

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autopilot.link import process
from autopilot.link.clock import Clock
from autopilot.link.kernel import largest_buffer_bytes
from autopilot.link.ports import RECEIVE_BUFFER_BYTES, WIDE_BUFFER_BYTES, listen
from autopilot.link.process import ProcessOptions, format_clock, parse_clock, run_node
from autopilot.link.record import read_mcap
from gains.table import InputError

S = 1_000_000_000


@pytest.mark.parametrize(
    ("text", "clock"),
    [
        ("0s", Clock()),
        ("137s", Clock(137 * S)),
        ("137s:+40ppm", Clock(137 * S, 40_000)),
        ("1042s:-60ppm", Clock(1042 * S, -60_000)),
        ("0.25s:0.5ppm", Clock(S // 4, 500)),
        ("1000s:200ppm", Clock(1000 * S, 200_000)),
    ],
)
def test_clocks_are_read(text, clock):
    assert parse_clock(text) == clock


@pytest.mark.parametrize(
    "text",
    [
        "",
        "137",
        "s",
        "-1s",
        "137ms",
        "nans",
        "infs",
        "1e999s",
        "137s:40",
        "137s:ppm:",
        "137s:201ppm",
        "137s:-201ppm",
        "137s:nanppm",
        "137s+40ppm",
        "x137s",
    ],
)
def test_what_is_no_clock_is_refused(text):
    with pytest.raises(InputError, match=r'clock ".*": expected OFFSETs:DRIFTppm within 200 ppm, such as 137s:\+40ppm'):
        parse_clock(text)


@settings(deadline=None)
@given(st.integers(0, 1 << 50), st.integers(-200_000, 200_000))
def test_a_formatted_clock_is_read_back_exactly(offset_ns, drift_ppb):
    clock = Clock(offset_ns, drift_ppb)
    assert parse_clock(format_clock(clock)) == clock


class Brief:
    """A node that ends its program at its first tick."""

    def receive(self, port, datagram, now_ns):
        pass

    def tick(self, now_ns):
        os.kill(os.getpid(), signal.SIGTERM)

    def next_deadline_ns(self):
        return 0

    def outgoing(self):
        return []

    def records(self):
        return []


@pytest.fixture
def program(monkeypatch) -> Iterator[None]:
    """Give the test's process back what a program changes of its own."""
    had = {signum: signal.getsignal(signum) for signum in (signal.SIGINT, signal.SIGTERM)}
    monkeypatch.setattr(process, "sharpen_timers", lambda: True)
    yield
    for signum, handler in had.items():
        signal.signal(signum, handler)
    gc.unfreeze()


@pytest.mark.usefixtures("program")
@pytest.mark.parametrize("wide", [False, True])
def test_a_program_says_and_records_which_buffers_it_has(tmp_path, capsys, wide):
    asked = WIDE_BUFFER_BYTES if wide else RECEIVE_BUFFER_BYTES
    ports = [
        partial(listen, name, ("127.0.0.1", 0), stamps=stamps, buffer_bytes=asked)
        for name, stamps in (("a", True), ("b", False))
    ]
    options = ProcessOptions(Clock(), tmp_path / "own.mcap", None)
    run_node("relay", Brief(), ports, options, {}, tap=False, control=2, banner="relay: here", spin_ns=1000)
    ((topic, _, body),) = read_mcap(tmp_path / "own.mcap")
    assert (topic, body["kind"], body["data"]["buffer_limit_bytes"]) == ("events", "ports", largest_buffer_bytes())
    given = {name: body["data"][name]["buffer_bytes"] for name in ("a", "b")}
    assert all(0 < size <= asked for size in given.values())
    assert [body["data"][name]["unstamped"] for name in ("a", "b")] == [0, None]
    banner, *said = capsys.readouterr().err.splitlines()
    assert banner == "relay: here"
    if wide:
        (line,) = said
        assert line.startswith(f"receive buffers: a {given['a'] / (1 << 20):.3g} MiB of 8 MiB, b ")
        assert "(net.core.rmem_max: " in line
    else:
        assert said == []


@pytest.mark.usefixtures("program")
def test_a_program_spins_as_it_is_told(monkeypatch):
    spins = []

    class Driver(process.UdpDriver):
        def __init__(self, *args, **more):
            spins.append(more["spin_ns"])
            super().__init__(*args, **more)

    monkeypatch.setattr(process, "UdpDriver", Driver)
    for more in ({}, {"spin_ns": 300_000}):
        run_node(
            "p",
            Brief(),
            [partial(listen, "p", ("127.0.0.1", 0))],
            ProcessOptions(Clock(), None, None),
            {},
            tap=False,
            **more,
        )
    assert spins == [0, 300_000]
