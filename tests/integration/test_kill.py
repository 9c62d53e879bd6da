"""``sitl fly`` killed or stopped in flight: what a ground station saw is the truth about what must be on the disk."""

from __future__ import annotations

import base64
import json
import re
import signal
import socket
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from time import perf_counter, sleep  # noqa: TID251  other processes live in real time

import numpy as np
import pytest
from mcap.reader import make_reader
from pymavlink.dialects.v20 import ardupilotmega as dialect

from autopilot.link.record import read_mcap
from sitl.rescue import recover
from tests.integration.programs import ENVIRONMENT, Program, a_socket, alive, children_of, eventually, program

pytestmark = [
    pytest.mark.realtime,
    pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="finds the programs in /proc"),
]

LOSS_S = 1.0
"""What a kill may cost."""
ABREAST = 3
"""Flights at a time, as most of a flight's start is waiting for imports."""


@dataclass
class Flight:
    """A flight over UDP and its ground station, which notes when it got what."""

    folder: Path
    running: Program
    station: socket.socket
    heard: list[tuple[float, bytes]] = field(default_factory=list)

    @property
    def recording(self) -> Path:
        return self.folder / "out" / "flight.mcap"

    def listen(self) -> None:
        """Take what has come to the ground station."""
        with suppress(BlockingIOError):
            while True:
                data = self.station.recv(1 << 16)
                self.heard.append((perf_counter(), data))


def take_off(folder: Path, stack: ExitStack, *options: str) -> Flight:
    """Start a flight."""
    station = stack.enter_context(closing(a_socket()))
    station.setblocking(False)
    gcs = f"udpout:127.0.0.1:{station.getsockname()[1]}"
    line = ["sitl", "fly", "nominal", "--port-base", "0", "--gcs", gcs, "--out", "out", *options]
    return Flight(folder, stack.enter_context(program(folder, *line)), station)


def listen_until(flights: Sequence[Flight], time: float) -> None:
    """Listen for all ground stations up to a time of ``perf_counter``."""
    while perf_counter() < time:
        for flight in flights:
            flight.listen()
        sleep(0.005)


def kill(flight: Flight) -> tuple[float, list[int]]:
    """Kill the supervisor; return when, and the programs it leaves behind."""
    children = list(children_of(flight.running.process.pid))
    flight.listen()
    flight.running.send(signal.SIGKILL)
    killed = perf_counter()
    assert flight.running.wait() == -signal.SIGKILL
    return killed, children


def frames_in(datagrams: list[bytes]) -> Counter[str]:
    """Count the messages of each name, with pymavlink's own parser."""
    mav = dialect.MAVLink(None)
    return Counter(m.get_type() for data in datagrams for m in mav.parse_buffer(data) or [])


def check_killed(flight: Flight, killed: float) -> float:
    """Check what is left of a killed flight; return how many seconds of it are lost."""
    target = flight.folder / "rescued.mcap"
    rescue = recover(flight.recording, target)
    assert not rescue.complete
    assert rescue.damaged_chunks == rescue.dropped_records == rescue.dropped_messages == 0
    with target.open("rb") as file:
        assert sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages()) == rescue.messages
    sent = [
        (log_time_ns / 1e9, base64.b64decode(body["frame"]))
        for topic, log_time_ns, body in read_mcap(target)
        if topic == "mavlink/gcs0" and body["direction"] == "sent"
    ]
    safe = [data for at, data in flight.heard if at < killed - LOSS_S]
    assert Counter(safe) <= Counter(data for _, data in sent)
    assert safe or not flight.heard or flight.heard[0][0] >= killed - LOSS_S
    # true time is one clock on this machine: the fastest datagram tells when the flight's began
    first_sent = {data: at for at, data in reversed(sent)}
    start = min((at - first_sent[data] for at, data in flight.heard if data in first_sent), default=killed)
    return killed - start - rescue.end_ns / 1e9


def dump_of(flight: Flight) -> subprocess.Popen[str]:
    """Start pymavlink's mavlogdump on the tlog."""
    command = [sys.executable, "-m", "pymavlink.tools.mavlogdump", "--format", "json", "flight.tlog"]
    pipe = subprocess.PIPE
    environment = {**ENVIRONMENT, "PYTHONWARNINGS": ""}  # pymavlink's own
    return subprocess.Popen(
        command, cwd=flight.recording.parent, env=environment, stdout=pipe, stderr=pipe, text=True
    )  # fmt: skip


def check_tlog(flight: Flight, killed: float, dump: subprocess.Popen[str]) -> None:
    """Check that mavlogdump finds all that the ground station got in good time."""
    out, err = dump.communicate(timeout=60)
    assert dump.returncode == 0, err
    found = Counter(json.loads(line)["meta"]["type"] for line in out.splitlines() if line.startswith("{"))
    assert frames_in([data for at, data in flight.heard if at < killed - LOSS_S]) <= found


def fly_and_kill(folder: Path, instants: Sequence[float]) -> None:
    """Fly one flight for each instant, all at once; kill each that many seconds after its first telemetry."""
    with ExitStack() as stack:
        flights = [take_off(folder / str(i), stack) for i in range(len(instants))]
        due: list[float | None] = [None] * len(flights)
        left: dict[int, tuple[float, list[int]]] = {}

        def all_killed() -> bool:
            listen_until(flights, perf_counter() + 0.05)
            for i, flight in enumerate(flights):
                assert i in left or flight.running.process.poll() is None, flight.running.stderr
                if due[i] is None and flight.heard:
                    due[i] = flight.heard[0][0] + instants[i]
                at = due[i]
                if i not in left and at is not None and perf_counter() >= at:
                    left[i] = kill(flight)
            return len(left) == len(flights)

        eventually("the kills", all_killed)
        dump = dump_of(flights[0])
        for i, flight in enumerate(flights):
            killed, children = left[i]
            assert len(children) == 3
            assert check_killed(flight, killed) < LOSS_S
        check_tlog(flights[0], left[0][0], dump)
        for _, children in left.values():
            eventually("the programs' end", lambda children=children: not any(map(alive, children)))
        for flight in flights:
            for log in flight.recording.parent.glob("*.log"):
                assert re.search("Traceback|Warning|Exception", log.read_text()) is None


def test_a_killed_flight_loses_less_than_a_second_and_its_programs_end(tmp_path: Path) -> None:
    fly_and_kill(tmp_path, np.random.default_rng(7).uniform(0.3, 3.0, ABREAST).tolist())


@pytest.mark.long
@pytest.mark.parametrize("seed", range(17))
def test_flights_killed_at_fifty_instants_lose_less_than_a_second(tmp_path: Path, seed: int) -> None:
    fly_and_kill(tmp_path, np.random.default_rng(100 + seed).uniform(0.0, 8.0, ABREAST).tolist())


@pytest.mark.long
def test_a_supervisor_that_stands_still_for_ten_seconds_delays_nothing_and_loses_nothing(tmp_path: Path) -> None:
    with ExitStack() as stack:
        flight = take_off(tmp_path, stack, "--duration", "16", "--json")
        eventually("telemetry", lambda: flight.listen() or flight.heard)
        listen_until([flight], perf_counter() + 1.0)
        stopped = perf_counter()
        flight.running.send(signal.SIGSTOP)
        listen_until([flight], stopped + 10.0)
        flight.running.send(signal.SIGCONT)
        eventually("its end", lambda: flight.listen() or flight.running.process.poll() is not None)
    summary = json.loads(flight.running.stdout)
    assert summary["problems"] == []
    assert summary["mode_at_end"] == "TRACKING"
    heard = [at for at, _ in flight.heard if stopped <= at <= stopped + 10.0]
    assert max(after - before for before, after in pairwise(heard)) < 0.3
    numbers = [body["k"] for topic, _, body in read_mcap(flight.recording) if topic == "plant/truth"]
    assert numbers == list(range(640))
