"""Turnaround of the autopilot while strangers and a ground station flood it, against the same without.

Quiet and flooded seconds alternate in one run, so that both see the same machine; what is compared are the
medians and the 99th percentiles over the samples of either kind. Two paths are measured: the autopilot's own
connected socket, at which the kernel drops strangers, and through the relay, whose listening socket hears
everybody. The ground station is the one that the autopilot talks to: each of its datagrams is served.

The floods come from processes of their own, paced, pinned to the last processor, while the rest keeps to the
first, at real-time priority where that is allowed: what is measured is what a flood costs the programs that
receive it, and neither what it costs to make one nor what else the machine does. (At ordinary priority on a busy
machine the slowest samples of both kinds are those that waited for a processor: four to six milliseconds.)

A flood ends by itself. As a program (``python -m tests.bench.flood``) this module is one.
"""

from __future__ import annotations

import os
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field

from pymavlink.dialects.v20 import ardupilotmega as dialect

from tests.bench.turnaround import PERIOD_S, REFERENCE, FakePlant

STRANGER_HZ = 20_000
STATION_HZ = 2_000
WARM_UP = 120
"""Samples before the first block; the programs that flood load meanwhile."""
BLOCK = 40
"""Samples in a row that are quiet, or flooded."""
BLOCKS = 12
"""Of each kind."""
MEDIAN_LIMIT = 1.5
P99_FACTOR = 2.0
P99_FLOOR_S = 0.002
MEASURED_PRIORITY = 1
PACE_S = 0.0005
MAX_BEHIND_S = 0.01
"""What a flood could not send for so long it does not catch up on."""
NS_PER_S = 1_000_000_000
HOME = "127.0.0.1"


@dataclass(frozen=True)
class Windows:
    """When a flood runs: ``count`` times for ``length_ns``, every ``period_ns``, on the clock of perf_counter_ns."""

    first_ns: int
    length_ns: int
    period_ns: int
    count: int

    def __iter__(self) -> Iterator[tuple[int, int]]:
        for i in range(self.count):
            begin_ns = self.first_ns + i * self.period_ns
            yield begin_ns, begin_ns + self.length_ns

    @property
    def seconds(self) -> float:
        return self.count * self.length_ns / NS_PER_S


def flood(send: Callable[[bytes], object], datagrams: list[bytes], rate_hz: int, windows: Windows) -> int:
    """Send at a rate during the windows; return how many were sent."""
    sent = 0
    for begin_ns, end_ns in windows:
        time.sleep(max(0, begin_ns - time.perf_counter_ns()) / NS_PER_S)
        done = 0
        while (now_ns := time.perf_counter_ns()) < end_ns:
            due = (now_ns - begin_ns) * rate_hz // NS_PER_S
            done = max(done, due - int(MAX_BEHIND_S * rate_hz))
            for i in range(done, due):
                send(datagrams[i % len(datagrams)])
                sent += 1
            done = max(done, due)
            time.sleep(PACE_S)
    return sent


def stranger_datagrams() -> list[bytes]:
    """Return what would be the autopilot's heartbeat, or the plant's attitude, from the right address."""
    autopilot, plant = dialect.MAVLink(None, 1, 1), dialect.MAVLink(None, 1, 25)
    return [
        dialect.MAVLink_heartbeat_message(1, 3, 129, 0, 4, 3).pack(autopilot),
        dialect.MAVLink_attitude_message(1000, 0.0, 0.1, 0.0, 0.0, 0.0, 0.0).pack(plant),
    ]


def station_datagrams() -> list[bytes]:
    """Return what ground stations say, each a valid frame."""
    station = dialect.MAVLink(None, 255, 190)
    return [
        dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(station),
        dialect.MAVLink_param_request_read_message(1, 1, b"NO_SUCH", -1).pack(station),
        dialect.MAVLink_command_long_message(1, 1, 512, 0, 148, 0, 0, 0, 0, 0, 0).pack(station),
    ]


def main(kind: str, port: str, *numbers: str) -> None:
    """Be one flood: of a stranger to a port, or of the ground station at a port; print what was sent."""
    rate_hz, *times = map(int, numbers)
    make_way()
    windows = Windows(*times)
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    if kind == "stranger":
        datagrams, peer = stranger_datagrams(), (HOME, int(port))
    else:
        datagrams = station_datagrams()
        sock.bind((HOME, int(port)))
        sock.settimeout(windows.seconds + 60.0)
        peer = sock.recvfrom(2048)[1]
    print(flood(lambda datagram: sock.sendto(datagram, peer), datagrams, rate_hz, windows))


def make_way() -> None:
    """Keep this process to the last processor, if it may use that, at ordinary priority, whatever its parent has."""
    with suppress(OSError):
        os.sched_setaffinity(0, {(os.cpu_count() or 1) - 1})
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


@contextmanager
def undisturbed() -> Iterator[str]:
    """Keep this process and those that it starts to one processor, before all others; tell whether that is allowed."""
    had, policy, priority = os.sched_getaffinity(0), os.sched_getscheduler(0), os.sched_getparam(0)
    os.sched_setaffinity(0, {min(had)})
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(MEASURED_PRIORITY))
        how = "real-time priority"
    except PermissionError:
        how = "ordinary priority"
    try:
        yield how
    finally:
        os.sched_setscheduler(0, policy, priority)
        os.sched_setaffinity(0, had)


def free_ports(count: int) -> list[int]:
    """Return ports at which nobody listens."""
    with ExitStack() as stack:
        socks = [stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(count)]
        for sock in socks:
            sock.bind((HOME, 0))
        return [int(sock.getsockname()[1]) for sock in socks]


@dataclass
class Measured:
    """The turnarounds of one path in seconds, what was not answered, and what was really sent."""

    times: dict[bool, list[float]] = field(default_factory=lambda: {False: [], True: []})
    missed: dict[bool, int] = field(default_factory=lambda: {False: 0, True: 0})
    sent_hz: dict[str, float] = field(default_factory=dict)

    def rows(self, path: str, how: str) -> list[tuple[str, float, float, str]]:
        (quiet, flooded), (quiet_p99, flooded_p99) = (
            [statistic(self.times[kind]) for kind in (False, True)] for statistic in (statistics.median, percentile_99)
        )
        rates = ", ".join(f"{who} {hz:.0f}/s" for who, hz in self.sent_hz.items())
        limit_s = max(P99_FACTOR * quiet_p99, P99_FLOOR_S)
        return [
            (
                f"{path}: median turnaround / quiet",
                flooded / quiet,
                MEDIAN_LIMIT,
                f"{flooded * 1e6:.0f} us, quiet {quiet * 1e6:.0f} us; {rates}; {how}",
            ),
            (
                f"{path}: 99th percentile / max({P99_FACTOR:g} x quiet, {P99_FLOOR_S * 1e3:g} ms)",
                flooded_p99 / limit_s,
                1.0,
                f"{flooded_p99 * 1e6:.0f} us, quiet {quiet_p99 * 1e6:.0f} us, {len(self.times[True])} samples each",
            ),
            (
                f"{path}: samples not answered",
                float(self.missed[True]),
                0.0,
                f"of {BLOCK * BLOCKS}; quiet {self.missed[False]}",
            ),
        ]


def percentile_99(values: list[float]) -> float:
    return statistics.quantiles(values, n=100)[98]


def measure() -> list[tuple[str, float, float, str]]:
    """Return the rows of both paths."""
    rows = []
    for through in (False, True):
        with undisturbed() as how:
            rows += _measure(how, through_relay=through)
    return rows


def _measure(how: str, *, through_relay: bool) -> list[tuple[str, float, float, str]]:
    plant = FakePlant()
    relay_port, station_port = free_ports(2)
    plant_port = plant.socket.getsockname()[1]
    length_ns = round(BLOCK * PERIOD_S * NS_PER_S)
    with ExitStack() as stack:
        stack.callback(plant.socket.close)
        if through_relay:
            stack.enter_context(
                _running("sitl", "relay", "--listen", f"{HOME}:{relay_port}", "--to", f"{HOME}:{plant_port}")
            )
        near = relay_port if through_relay else plant_port
        stack.enter_context(
            _running(
                *("autopilot", "--plant", f"{HOME}:{near}", "--gcs", f"udpout:{HOME}:{station_port}"),
                *("--reference", REFERENCE),
            )
        )
        assert plant.started(), "the autopilot did not start"
        assert plant.peer is not None
        if os.sched_getscheduler(0) == os.SCHED_RR:
            os.sched_setparam(0, os.sched_param(MEASURED_PRIORITY + 1))  # who measures does not wait for the measured
        first_ns = round((plant.start + (WARM_UP + BLOCK - 0.5) * PERIOD_S) * NS_PER_S)
        numbers = [str(n) for n in (first_ns, length_ns, 2 * length_ns, BLOCKS)]
        floods = {
            who: stack.enter_context(_running("tests.bench.flood", who, str(port), str(rate_hz), *numbers))
            for who, port, rate_hz in (
                ("stranger", relay_port if through_relay else plant.peer[1], STRANGER_HZ),
                ("station", station_port, STATION_HZ),
            )
        }
        measured = _ask(plant)
        for who, process in floods.items():
            measured.sent_hz[who] = int(process.communicate(timeout=30.0)[0]) / (BLOCKS * BLOCK * PERIOD_S)
    return measured.rows("flooded relay and autopilot" if through_relay else "flooded autopilot", how)


def _ask(plant: FakePlant) -> Measured:
    """Ask for one command per sample, quiet and flooded blocks in turn."""
    measured = Measured()
    for k in range(WARM_UP + 2 * BLOCKS * BLOCK):
        turnaround = plant.ask(k)
        if k < WARM_UP:
            continue
        flooded = (k - WARM_UP) // BLOCK % 2 == 1
        if turnaround is None:
            measured.missed[flooded] += 1
        else:
            measured.times[flooded].append(turnaround)
    return measured


@contextmanager
def _running(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(
        [sys.executable, "-m", *arguments], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
