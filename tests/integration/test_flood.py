"""Strangers and a ground station flood autopilot and relay: each sample is answered, each datagram accounted for.

    autopilot <-> relay <-> this process as the plant

One stranger speaks to the autopilot's socket, another to the relay's, in frames that would be good from their
peers; the ground station is the one that the autopilot talks to. How long an answer takes is for the bench to
say; here it may take as long as it likes. Then the autopilot is stopped for a moment, so that its sockets fill
in the wrong order: hundreds of datagrams from ground, and only after them one from the plant.
"""

from __future__ import annotations

import base64
import os
import signal
import socket
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from time import perf_counter_ns  # noqa: TID251  a flight over UDP is in real time

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from autopilot.link.record import read_mcap
from tests.bench.flood import HOME, NS_PER_S, STATION_HZ, STRANGER_HZ, free_ports, station_datagrams, stranger_datagrams
from tests.bench.turnaround import FakePlant
from tests.integration.programs import TIMEOUT_S, eventually, program

pytestmark = pytest.mark.realtime

LOAD_NS = 2 * NS_PER_S
"""What the programs that flood are given to load."""
FLOOD_NS = 2 * NS_PER_S
MIN_FLOOD = 1_000
"""Less than this would be no flood, however slow the machine."""
MIN_SAMPLES = 20
STATION, PLANT = dialect.MAVLink(None, 254, 190), dialect.MAVLink(None, 1, 25)
WAITING = [dialect.MAVLink_heartbeat_message(6, 8, 0, mode, 4, 3).pack(STATION) for mode in range(300)]
"""Few enough for the receive buffer that an ordinary kernel grants."""
MARK = dialect.MAVLink_attitude_message(4_000_000_000, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0).pack(PLANT)
"""The one message from the plant that comes after all that wait."""


@dataclass(frozen=True)
class Bound:
    """One line of ``/proc/net/udp``."""

    local: int
    remote: int
    queued_bytes: int
    drops: int


def bound(choose: Callable[[Bound], bool]) -> Bound:
    """Return the first UDP socket of this machine of that kind, as the kernel lists them."""
    lines = Path("/proc/net/udp").read_text().splitlines()[1:]
    for words in map(str.split, lines):
        local, remote = (int(word.partition(":")[2], 16) for word in words[1:3])
        each = Bound(local, remote, int(words[4].partition(":")[2], 16), int(words[-1]))
        if choose(each):
            return each
    raise AssertionError("no such socket")


def at(port: int) -> Bound:
    return bound(lambda each: each.local == port)


def dialled(port: int) -> Bound:
    """Return the socket that is connected to a port."""
    return bound(lambda each: each.remote == port)


@dataclass(frozen=True)
class Flown:
    """What was asked, answered and sent, what the kernel dropped, and the recordings."""

    folder: Path
    asked: int
    answered: int
    sent: dict[str, int]
    dropped: dict[str, int]
    codes: list[int]

    @cached_property
    def received(self) -> list[tuple[str, bytes]]:
        """Port and frame of all that the autopilot received, in the order in which it was served."""
        return [
            (topic.removeprefix("mavlink/"), base64.b64decode(body["frame"]))
            for topic, _, body in read_mcap(self.folder / "autopilot.mcap")
            if topic.startswith("mavlink/") and body["direction"] == "received"
        ]

    def ports(self, name: str) -> dict:
        """Return what a program says at its end about its ports."""
        events = (body for topic, _, body in read_mcap(self.folder / f"{name}.mcap") if topic == "events")
        return next(body["data"] for body in events if body["kind"] == "ports")


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    folder = tmp_path_factory.mktemp("flood")
    plant = FakePlant()
    relay_port, station_port = free_ports(2)
    to_plant = f"{HOME}:{plant.socket.getsockname()[1]}"
    with ExitStack() as stack:
        stack.enter_context(closing(plant.socket))

        def run(*arguments: str):
            return stack.enter_context(program(folder, *arguments))

        relay = run("sitl", "relay", "--listen", f"{HOME}:{relay_port}", "--to", to_plant, "--record", "relay.mcap")
        line = ("--plant", f"{HOME}:{relay_port}", "--gcs", f"{HOME}:{station_port}", "--record", "autopilot.mcap")
        autopilot = run("autopilot", *line)
        assert plant.started(TIMEOUT_S)
        numbers = [str(n) for n in (perf_counter_ns() + LOAD_NS, FLOOD_NS, 2 * FLOOD_NS, 1)]
        floods = {
            who: run("tests.bench.flood", who.split()[0], str(port), str(rate_hz), *numbers)
            for who, port, rate_hz in (
                ("stranger of the autopilot", dialled(relay_port).local, STRANGER_HZ),
                ("stranger of the relay", relay_port, STRANGER_HZ),
                ("station", station_port, STATION_HZ),
            )
        }
        asked = answered = 0
        while any(flood.process.poll() is None for flood in floods.values()):
            answered += plant.ask(asked, TIMEOUT_S) is not None
            asked += 1
        sent = {who: int(flood.stdout) for who, flood in floods.items()}
        eventually("all served", lambda: at(relay_port).queued_bytes == dialled(station_port).queued_bytes == 0)
        dropped = {
            "relay": at(relay_port).drops,
            "autopilot": dialled(relay_port).drops,
            "station": dialled(station_port).drops,
        }
        _fill_in_the_wrong_order(plant, autopilot.process.pid, relay_port, station_port)
        codes = [each.end() for each in (autopilot, relay)]
    return Flown(folder, asked, answered, sent, dropped, codes)


def _fill_in_the_wrong_order(plant: FakePlant, pid: int, relay_port: int, station_port: int) -> None:
    """Stop the autopilot, queue datagrams from ground and then one from the plant, and let it go on."""
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as station:
        station.bind((HOME, station_port))
        station.connect((HOME, dialled(station_port).local))
        os.kill(pid, signal.SIGSTOP)
        eventually("stopped", lambda: Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "T")
        for frame in WAITING:
            station.send(frame)
        plant.send(MARK)
        eventually("the plant's message", lambda: dialled(relay_port).queued_bytes > 0)
        os.kill(pid, signal.SIGCONT)
        eventually("served", lambda: dialled(station_port).queued_bytes == 0)


def test_no_program_ends(flown: Flown) -> None:
    assert flown.codes == [0, 0]


def test_every_sample_is_answered(flown: Flown) -> None:
    assert min(flown.sent.values()) > MIN_FLOOD
    assert flown.asked > MIN_SAMPLES
    assert flown.answered == flown.asked


def test_the_kernel_keeps_strangers_from_a_port_that_dials(flown: Flown) -> None:
    assert flown.ports("autopilot")["plant"]["strangers"] == 0
    assert flown.dropped["autopilot"] == 0
    assert not set(stranger_datagrams()) & {frame for _, frame in flown.received}


def test_every_stranger_at_a_port_that_listens_is_counted_unless_the_kernel_dropped_him(flown: Flown) -> None:
    counted = flown.ports("relay")["autopilot"]["strangers"]
    assert counted + flown.dropped["relay"] == flown.sent["stranger of the relay"]


def test_every_datagram_of_the_ground_station_is_served_unless_the_kernel_dropped_it(flown: Flown) -> None:
    said = set(station_datagrams())
    served = sum(frame in said for port, frame in flown.received if port == "gcs0")
    assert served + flown.dropped["station"] == flown.sent["station"]


def test_the_plants_message_is_served_before_all_that_waited_from_ground(flown: Flown) -> None:
    order = [frame for _, frame in flown.received if frame == MARK or frame in set(WAITING)]
    assert order == [MARK, *WAITING]
