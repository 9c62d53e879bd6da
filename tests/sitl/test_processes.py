"""The supervisor and real processes: killed and started again, frozen and thawed, ordered about, and always ended."""

from __future__ import annotations

import os
import signal
import socket
import sys
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path
from time import monotonic  # noqa: TID251  other processes live in real time
from typing import Any

import pytest

from autopilot.link.node import Record
from autopilot.link.orders import BreakSends, StepClock, encode_order
from autopilot.link.stream import encode_hello
from sitl.processes import MAX_ORDERS, ChildDied, Supervisor

TIMEOUT_S = 20.0
"""Only a test that is about to fail waits so long."""

SILENT_S = 0.1
"""A program that runs writes dozens of records in this time."""

CHILD = """
    import json, os, select, signal, socket, sys, time

    name, ports = sys.argv[1], {"autopilot": ["127.0.0.1", int(sys.argv[2])]}
    if "refuse" in sys.argv:
        sys.exit(f"{name}: error: no good")
    if "mute" in sys.argv:
        time.sleep(60)
    print(f"{name} began", file=sys.stderr, flush=True)
    host, port = sys.argv[-1].rsplit(":", 1)
    stream = socket.create_connection((host, int(port)))
    hello = {"hello": name, "token": os.environ["LAGPROOF_STREAM_TOKEN"], "ports": ports}
    stream.sendall(json.dumps(hello).encode() + b"\\n")
    n = 0
    while True:
        heard = b""
        if select.select([stream], [], [], 0.002)[0]:
            heard = stream.recv(4096)
            if not heard:
                break
        n += 1
        body = {"kind": "test", "node": name, "text": heard.decode(), "data": {"n": n, "pid": os.getpid()}}
        line = {"topic": "events", "t_ns": n, "log_time_ns": time.perf_counter_ns(), "body": body}
        stream.sendall(json.dumps(line).encode() + b"\\n")
"""
"""A program that keeps the rules of the record stream, and tells of what it hears on it. Standard library only."""


class Flight:
    """A supervisor and what it was told."""

    def __init__(self, folder: Path) -> None:
        self.records: list[tuple[Record, int]] = []
        self.hellos: list[tuple[str, int, int]] = []
        self.exits: list[tuple[str, int, str]] = []
        self.supervisor = Supervisor(folder, lambda record, at_ns: self.records.append((record, at_ns)))
        self.supervisor.on_hello = lambda name, ports, after: self.hellos.append((name, ports["autopilot"][1], after))
        self.supervisor.on_exit = lambda *exit_: self.exits.append(exit_)

    def start(self, name: str, *words: str, port: int = 14600, wait: bool = True, may_end: bool = False) -> None:
        self.supervisor.start(name, ["lagproof_test_child", name, str(port), *words], may_end=may_end)
        if wait:
            self.supervisor.wait_ready(name, lambda: False)

    def until(self, condition: Callable[[], Any]) -> Any:
        deadline = monotonic() + TIMEOUT_S
        while not (value := condition()):
            assert monotonic() < deadline, "not in time"
            self.supervisor.poll(0.01)
        return value

    def listen(self, seconds: float) -> None:
        deadline = monotonic() + seconds
        while (left := deadline - monotonic()) > 0:
            self.supervisor.poll(min(left, 0.05))

    def of(self, name: str) -> list[dict[str, Any]]:
        return [record.body for record, _ in self.records if record.body["node"] == name]

    def pids(self, name: str) -> list[int]:
        return list(dict.fromkeys(body["data"]["pid"] for body in self.of(name)))


@pytest.fixture
def flight(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Flight]:
    (tmp_path / "lagproof_test_child.py").write_text(textwrap.dedent(CHILD))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    flight = Flight(tmp_path)
    yield flight
    flight.supervisor.close()


def gone(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


def test_a_killed_program_is_no_failure_and_its_records_are_whole_up_to_its_death(flight: Flight) -> None:
    flight.start("plant")
    flight.until(lambda: len(flight.of("plant")) > 20)
    flight.supervisor.kill("plant")
    [pid] = flight.pids("plant")
    assert gone(pid)
    numbers = [body["data"]["n"] for body in flight.of("plant")]
    assert numbers == list(range(1, len(numbers) + 1))
    assert flight.supervisor.malformed == 0
    flight.listen(SILENT_S)
    assert len(flight.of("plant")) == len(numbers)
    assert flight.exits == []
    assert flight.supervisor.stop() == []


def test_a_program_that_starts_again_says_hello_again_and_its_records_go_on(flight: Flight) -> None:
    flight.start("plant", port=4001)
    flight.until(lambda: flight.of("plant"))
    flight.supervisor.kill("plant")
    flight.start("plant", port=4002, wait=False)
    flight.until(lambda: len(flight.pids("plant")) == 2)
    assert [(name, port) for name, port, _ in flight.hellos] == [("plant", 4001), ("plant", 4002)]
    assert all(0 < after_ns < TIMEOUT_S * 1e9 for _, _, after_ns in flight.hellos)
    assert flight.supervisor.wait_ready("plant", lambda: False) == {"autopilot": ("127.0.0.1", 4002)}
    assert flight.supervisor.stop() == []
    words = (flight.supervisor._folder / "plant.log").read_text().splitlines()
    assert words == ["plant began", "plant began"]


def test_a_second_connection_of_a_name_is_refused_while_the_first_lives(flight: Flight) -> None:
    flight.start("plant")
    with socket.create_connection(flight.supervisor._listener.getsockname()) as second:
        second.settimeout(0.01)
        second.sendall(encode_hello("plant", flight.supervisor._token, {}))

        def refused() -> bool:
            try:
                return second.recv(1) == b""
            except TimeoutError:
                return False

        flight.until(refused)
    assert len(flight.hellos) == 1
    assert flight.supervisor.stop() == []


def test_a_hello_that_a_killed_program_left_behind_is_not_that_of_the_next(flight: Flight) -> None:
    flight.start("plant", "mute", wait=False)
    with socket.create_connection(flight.supervisor._listener.getsockname()) as late:
        late.sendall(encode_hello("plant", flight.supervisor._token, {"autopilot": ("127.0.0.1", 1)}))
        flight.supervisor.kill("plant")
        flight.supervisor._listen(0.2)
        flight.start("plant", port=4002)
        assert [port for _, port, _ in flight.hellos] == [4002]


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGSTOP")
def test_a_frozen_program_is_silent_and_alive_and_goes_on_when_it_thaws(flight: Flight) -> None:
    flight.start("plant")
    flight.start("relay")
    flight.until(lambda: flight.of("plant") and flight.of("relay"))
    flight.supervisor.freeze("plant")
    flight.listen(SILENT_S)  # what it had said
    before, relay = len(flight.of("plant")), len(flight.of("relay"))
    flight.listen(SILENT_S)
    assert len(flight.of("plant")) == before
    assert len(flight.of("relay")) > relay
    flight.supervisor.thaw("plant")
    flight.until(lambda: len(flight.of("plant")) > before)
    assert len(flight.pids("plant")) == 1
    assert flight.supervisor.stop() == []


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGSTOP")
@pytest.mark.parametrize("how", ["stop", "close", "kill"])
def test_a_frozen_program_ends_with_the_rest(flight: Flight, how: str) -> None:
    flight.start("plant")
    pid = flight.until(lambda: flight.pids("plant"))[0]
    flight.supervisor.freeze("plant")
    match how:
        case "stop":
            assert flight.supervisor.stop() == []  # in order: it heard the end of its stream
        case "close":
            flight.supervisor.close()
        case _:
            flight.supervisor.kill("plant")
    assert gone(pid)


def test_orders_reach_a_program_in_order_even_those_given_before_its_hello(flight: Flight) -> None:
    orders = [StepClock(-5), BreakSends(7)]
    flight.start("relay", wait=False)
    for order in orders:
        flight.supervisor.order("relay", order)
    wanted = b"".join(encode_order(order) for order in orders).decode()
    flight.until(lambda: "".join(body["text"] for body in flight.of("relay")) == wanted)
    flight.supervisor.order("relay", StepClock(1))
    wanted += encode_order(StepClock(1)).decode()
    flight.until(lambda: "".join(body["text"] for body in flight.of("relay")) == wanted)
    assert flight.supervisor.refused_orders == 0


def test_orders_that_cannot_be_given_are_counted(flight: Flight) -> None:
    flight.start("relay", "mute", wait=False)
    for _ in range(MAX_ORDERS + 3):
        flight.supervisor.order("relay", StepClock(1))
    assert flight.supervisor.refused_orders == 3
    flight.supervisor.kill("relay")
    flight.supervisor.order("relay", StepClock(1))
    assert flight.supervisor.refused_orders == 4


def test_a_program_that_may_end_is_told_of_with_its_own_last_words_and_can_start_again(flight: Flight) -> None:
    flight.start("autopilot")
    flight.supervisor.kill("autopilot")
    flight.start("autopilot", "refuse", wait=False, may_end=True)
    flight.until(lambda: flight.exits)
    assert flight.exits == [("autopilot", 1, "autopilot: error: no good")]
    flight.supervisor.kill("autopilot")
    flight.start("autopilot")
    flight.listen(SILENT_S)
    assert flight.exits == [("autopilot", 1, "autopilot: error: no good")]


def test_a_program_killed_right_after_it_ended_as_it_might_is_told_of_once(flight: Flight) -> None:
    flight.start("autopilot", "refuse", wait=False, may_end=True)
    flight.supervisor._children["autopilot"].process.wait(TIMEOUT_S)
    flight.supervisor.kill("autopilot")
    flight.listen(SILENT_S)
    assert flight.exits == [("autopilot", 1, "autopilot: error: no good")]


@pytest.mark.parametrize("again", [False, True], ids=["the first", "one started again"])
def test_a_death_that_nobody_ordered_is_still_one(flight: Flight, again: bool) -> None:
    flight.start("plant")
    if again:
        flight.supervisor.kill("plant")
        flight.start("plant")
    flight.supervisor._children["plant"].process.send_signal(signal.SIGTERM)
    with pytest.raises(ChildDied, match=r"plant died \(signal 15\): plant began"):
        flight.listen(TIMEOUT_S)
