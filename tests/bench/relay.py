"""The relay as an instrument: how far its delays are from those asked for, and what passes at 20,000 packets/s.

Packets cross one forwarding process on the loopback, one way: in turn a plain echo, whose transit is what the machine
itself costs, the relay with jitter, and a naive relay on asyncio (``call_later`` per packet), which is what one would
write first. What is asked of each packet comes from the relay's own seeded model, run here in virtual time; when a
packet came is the kernel's stamp, so that the receiver's own waking is in none of the numbers.

Medians and slowest packets are compared with the echo's transit. On the slowest that is hard: the host of a virtual
machine may take a processor away for milliseconds, which an echo hardly shows, since who sends is stopped as well,
while a packet that should leave meanwhile is late. So the note tells the echo's time since the packet should have been
sent, too: what the machine does to a timer and an echo.

The rate is one way and without delay, from a process of its own on the last processor, while the relays keep to the
first; the receiver empties its buffer now and then. A relay's processor time is what the system charges it.

As a program (``python -m tests.bench.relay KIND ...``) this module is one of these processes.
"""

from __future__ import annotations

import asyncio
import os
import select
import signal
import socket
import statistics
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from autopilot.link.kernel import STAMP_SPACE, stamp_arrivals, stamp_of, widen
from autopilot.link.ports import WIDE_BUFFER_BYTES
from sitl.link.impairment import LinkSpec
from sitl.link.relay import RelayNode
from sitl.link.spec import parse_spec
from tests.bench.flood import (
    HOME,
    MEASURED_PRIORITY,
    NS_PER_S,
    Windows,
    flood,
    free_ports,
    make_way,
    percentile_99,
    undisturbed,
)

Row = tuple[str, float, float, str]
Command = Callable[[int, int], tuple[str, ...]]
"""From the ports where a relay shall listen and where it shall send, the arguments to Python that run it."""

SPEC = "delay=20ms,jitter=uniform:10ms"
SEED = 7
PERIOD_S = 0.01
WARM_UP = 20
BLOCK = 50
ROUNDS = 10
TURNS = ("echo", "relay", "naive", "relay")
"""Whose blocks make one round; the relay's percentile wants the most packets."""
SETTLE_S = 0.05
"""After a block, until what is under way has come."""
ABOVE_P50_S = 1e-4
ABOVE_P99_S = 1e-3

FLOOD_HZ = 20_000
FLOOD_S = 4.0
FLOOD_BYTES = 60
DRAIN_S = 0.005
COST_LIMIT = 2.0
LEAST_SENT = 0.97
"""Of the packets of a flood: less, and the rate was another."""

READY_S = 30.0
MAX_DATAGRAM = 2048
PACKET = struct.Struct("<iq")
"""Number, from 0 in the order of sending, and delay in ns, which the naive relay reads from the packet."""
PROBE = PACKET.pack(-1, 0)


def echo_command(near: int, far: int) -> tuple[str, ...]:
    return "-m", "tests.bench.relay", "echo", str(near), str(far)


def naive_command(near: int, far: int) -> tuple[str, ...]:
    return "-m", "tests.bench.relay", "naive", str(near), str(far)


def relay_command(near: int, far: int) -> tuple[str, ...]:
    return "-m", "sitl", "relay", "--listen", f"{HOME}:{near}", "--to", f"{HOME}:{far}", "--accept", "any"


def jitter_command(near: int, far: int) -> tuple[str, ...]:
    return *relay_command(near, far), "--down", SPEC, "--seed", str(SEED)


def main(kind: str, *numbers: str) -> None:
    """Be one process of the bench; it ends when it is told to, the flood by itself."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())
    first, second = map(int, numbers)
    if kind == "flood":
        make_way()
        with closing(socket.socket(fileno=first)) as sock:
            datagrams = [packet(number, 0) for number in range(round(FLOOD_HZ * FLOOD_S))]
            print(flood(sock.send, datagrams, FLOOD_HZ, Windows(second, round(FLOOD_S * NS_PER_S), 1, 1)))
    elif kind == "echo":
        echo(first, second)
    else:
        asyncio.run(naive(first, second))


def echo(near: int, far: int) -> None:
    """Forward, and nothing else."""
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as sock:
        sock.bind((HOME, near))
        while True:
            sock.sendto(sock.recvfrom(MAX_DATAGRAM)[0], (HOME, far))


class Naive(asyncio.DatagramProtocol):
    """Forwards each packet when a timer of its own has ended."""

    def __init__(self, far: int) -> None:
        self.far = (HOME, far)

    def connection_made(self, transport: asyncio.DatagramTransport) -> None:
        self.transport = transport
        self.loop = asyncio.get_running_loop()

    def datagram_received(self, data: bytes, addr: object) -> None:
        delay_s = PACKET.unpack_from(data)[1] / NS_PER_S
        self.loop.call_later(delay_s, self.transport.sendto, data, self.far)


async def naive(near: int, far: int) -> None:
    loop = asyncio.get_running_loop()
    await loop.create_datagram_endpoint(lambda: Naive(far), (HOME, near))
    await asyncio.Event().wait()


def packet(number: int, delay_ns: int) -> bytes:
    return PACKET.pack(number, delay_ns).ljust(FLOOD_BYTES, b"\0")


def asked_ns(count: int) -> list[int]:
    """Return the delays that the relay's model has for so many packets, probes included."""
    node = RelayNode(LinkSpec(), parse_spec(SPEC), SEED)
    delays = []
    for number in range(count):
        entered_ns = number * NS_PER_S
        node.receive("autopilot", packet(number, 0), entered_ns)
        exit_ns = node.next_deadline_ns()
        assert exit_ns is not None
        node.tick(exit_ns)
        assert len(node.outgoing()) == 1
        delays.append(exit_ns - entered_ns)
    return delays


@dataclass
class Way:
    """One way through a forwarding process: a socket at either end, and how often it has been used."""

    process: subprocess.Popen[str]
    near: socket.socket
    far: socket.socket
    probes: int = 0

    def probe(self) -> None:
        """Send until something comes out: the process is there, and knows this sender."""
        for _ in range(round(READY_S / DRAIN_S)):
            with suppress(ConnectionRefusedError):
                self.near.send(PROBE)
            if select.select([self.far], [], [], DRAIN_S)[0]:
                break
        else:
            raise AssertionError("the process did not start to forward")
        time.sleep(SETTLE_S)
        self.probes = len(list(self.arrivals()))

    def arrivals(self) -> Iterator[tuple[int, int]]:
        """Take what has come: number, and wall clock in ns when the kernel got it."""
        while True:
            try:
                data, ancillary, _, _ = self.far.recvmsg(MAX_DATAGRAM, STAMP_SPACE)
            except BlockingIOError:
                return
            stamp_ns = stamp_of(ancillary)
            assert stamp_ns is not None, "the kernel does not stamp"
            yield PACKET.unpack_from(data)[0], stamp_ns

    def busy_s(self) -> float:
        """Return the processor time that the process has used."""
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@contextmanager
def way(command: Command) -> Iterator[Way]:
    """Run a forwarding process between two sockets."""
    with ExitStack() as stack:
        near, far = (stack.enter_context(closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))) for _ in range(2))
        far.bind((HOME, 0))
        far.setblocking(False)
        widen(far, WIDE_BUFFER_BYTES)
        assert stamp_arrivals(far), "the kernel does not stamp"
        (number,) = free_ports(1)
        near.connect((HOME, number))
        process = subprocess.Popen(
            [sys.executable, *command(number, far.getsockname()[1])], stderr=subprocess.DEVNULL, text=True
        )
        stack.callback(process.wait)
        stack.callback(process.terminate)
        yield Way(process, near, far)


@dataclass
class Delays:
    """What one way did to the packets of its blocks."""

    way: Way
    asked_ns: list[int]
    sent_ns: list[int] = field(default_factory=list)
    late_s: list[float] = field(default_factory=list)
    """How late each was sent."""
    came_ns: dict[int, int] = field(default_factory=dict)

    def block(self, count: int) -> None:
        """Send so many packets at the pace, taking what comes meanwhile."""
        begin = time.perf_counter()
        for i in range(count):
            self._take_until(begin + i * PERIOD_S)
            number = len(self.sent_ns)
            data = packet(number, self.asked_ns[number])
            self.late_s.append(time.perf_counter() - begin - i * PERIOD_S)
            self.sent_ns.append(time.time_ns())
            self.way.near.send(data)
        self._take_until(time.perf_counter() + SETTLE_S)

    def errors_s(self) -> list[float]:
        """Return how far each packet's delay was from the one asked for; all must have come."""
        assert len(self.came_ns) == len(self.sent_ns), f"{len(self.came_ns)} of {len(self.sent_ns)} came"
        numbers = range(WARM_UP, len(self.sent_ns))
        return [abs(self.came_ns[n] - self.sent_ns[n] - self.asked_ns[n]) / NS_PER_S for n in numbers]

    def since_due_s(self) -> list[float]:
        """Return the same, counted from when each packet should have been sent."""
        return [error_s + late_s for error_s, late_s in zip(self.errors_s(), self.late_s[WARM_UP:], strict=True)]

    def _take_until(self, end: float) -> None:
        while (left := end - time.perf_counter()) > 0:
            select.select([self.way.far], [], [], left)
            self.came_ns.update(self.way.arrivals())


def measure() -> list[Row]:
    """Return the rows about delays and about the rate."""
    with undisturbed() as how:
        before_all_others()
        return delay_rows(how) + rate_rows()


def before_all_others() -> None:
    """Let this process, which measures, not wait for those that are measured."""
    if os.sched_getscheduler(0) == os.SCHED_RR:
        os.sched_setparam(0, os.sched_param(MEASURED_PRIORITY + 1))


def measured_delays(commands: dict[str, Command]) -> dict[str, Delays]:
    """Return what each way did to its packets."""
    count = WARM_UP + BLOCK * ROUNDS * max(TURNS.count(name) for name in commands)
    with ExitStack() as stack:
        ways = {name: stack.enter_context(way(command)) for name, command in commands.items()}
        for each in ways.values():
            each.probe()
        model_ns = asked_ns(max(each.probes for each in ways.values()) + count)
        delays = {
            name: Delays(each, [0] * count if name == "echo" else model_ns[each.probes :])
            for name, each in ways.items()
        }
        for each in delays.values():
            each.block(WARM_UP)
        for _ in range(ROUNDS):
            for name in TURNS:
                delays[name].block(BLOCK)
        return delays


def stolen_s() -> float:
    """Return the time for which the host of a virtual machine has kept its processors from it."""
    return int(Path("/proc/stat").read_text().split()[8]) / os.sysconf("SC_CLK_TCK")


def delay_rows(how: str) -> list[Row]:
    begin, stolen = time.perf_counter(), stolen_s()
    delays = measured_delays({"echo": echo_command, "relay": jitter_command, "naive": naive_command})
    stolen = (stolen_s() - stolen) / (time.perf_counter() - begin) / (os.cpu_count() or 1)
    how += f", {stolen:.1%} of the processors' time stolen"
    error = "|delay - asked| of the relay"
    echoed, ours, theirs = (statistics.median(delays[name].errors_s()) for name in ("echo", "relay", "naive"))
    slow_echo, slow, slow_naive = (percentile_99(delays[name].errors_s()) for name in ("echo", "relay", "naive"))
    slow_machine = percentile_99(delays["echo"].since_due_s())
    return [
        (
            f"{error}: median above an echo / {ABOVE_P50_S * 1e3:g} ms",
            (ours - echoed) / ABOVE_P50_S,
            1.0,
            f"{ours * 1e6:.0f} us, echo {echoed * 1e6:.0f} us; {how}",
        ),
        (
            f"{error}: 99th percentile above an echo / {ABOVE_P99_S * 1e3:g} ms",
            (slow - slow_echo) / ABOVE_P99_S,
            1.0,
            f"{slow * 1e6:.0f} us, echo {slow_echo * 1e6:.0f} us, timer and echo {slow_machine * 1e6:.0f} us",
        ),
        (f"{error}: median / naive asyncio relay", ours / theirs, 1.0, f"naive {theirs * 1e6:.0f} us"),
        (f"{error}: 99th percentile / naive", slow / slow_naive, 1.0, f"naive {slow_naive * 1e6:.0f} us"),
    ]


@dataclass(frozen=True)
class Flooded:
    """What became of a flood."""

    sent: int
    lost: int
    busy_s: float

    @property
    def cost_us(self) -> float:
        """Processor time per packet."""
        return self.busy_s / self.sent * 1e6


def flooded(command: Command) -> Flooded:
    """Send a flood through a forwarding process and count what comes out."""
    with way(command) as through:
        through.probe()
        busy_s = through.busy_s()
        start_ns = time.perf_counter_ns() + 2 * NS_PER_S
        number = through.near.fileno()
        with subprocess.Popen(
            [sys.executable, "-m", "tests.bench.relay", "flood", str(number), str(start_ns)],
            pass_fds=[number],
            stdout=subprocess.PIPE,
            text=True,
        ) as flooding:
            came: set[int] = set()
            while flooding.poll() is None:
                came.update(number for number, _ in through.arrivals())
                time.sleep(DRAIN_S)
            assert flooding.stdout is not None
            sent = int(flooding.stdout.read())
        time.sleep(SETTLE_S)
        came.update(number for number, _ in through.arrivals())
        assert sent >= LEAST_SENT * FLOOD_HZ * FLOOD_S, f"the flood sent only {sent} packets in {FLOOD_S} s"
        return Flooded(sent, sent - len(came), through.busy_s() - busy_s)


def rate_rows() -> list[Row]:
    ours, theirs = flooded(relay_command), flooded(naive_command)
    return [
        (
            f"relay: packets lost at {FLOOD_HZ}/s",
            float(ours.lost),
            0.0,
            f"of {ours.sent}; naive asyncio relay {theirs.lost} of {theirs.sent}",
        ),
        (
            "relay: processor time per packet / naive asyncio relay",
            ours.cost_us / theirs.cost_us,
            COST_LIMIT,
            f"{ours.cost_us:.1f} us, naive {theirs.cost_us:.1f} us",
        ),
    ]


if __name__ == "__main__":
    main(*sys.argv[1:])
