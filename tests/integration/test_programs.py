"""The programs one by one, as a person starts and ends them, and ``sitl fly`` when its flight is cut short."""

from __future__ import annotations

import itertools
import json
import os
import re
import signal
import socket
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from autopilot.link.record import read_mcap
from autopilot.link.wire import (
    AUTOPILOT,
    PLANT,
    Attitude,
    HilActuatorControls,
    NamedValueInt,
    Timesync,
    Wire,
)
from sitl.processes import MAX_UNKNOWN, Supervisor
from tests.helpers import HEARTBEAT
from tests.integration.programs import (
    Program,
    a_socket,
    alive,
    children_of,
    eventually,
    free_port,
    listens,
    program,
    samples_in,
    topics_in,
)
from tests.integration.recursion import tables

pytestmark = pytest.mark.realtime

needs_proc = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="finds the programs in /proc")

PROGRAMS = ("plant", "relay", "autopilot")
ORDERS = list(itertools.permutations(PROGRAMS))
FLOWN = 60
ENOUGH = 20
COMPLAINTS = "Traceback|Warning|Exception"


# by hand


@dataclass
class ByHand:
    """Three programs in three terminals."""

    folder: Path
    plant_port: int = field(default_factory=free_port)
    relay_port: int = field(default_factory=free_port)
    running: dict[str, Program] = field(default_factory=dict)
    codes: dict[str, int] = field(default_factory=dict)

    def start(self, name: str, stack: ExitStack) -> None:
        plant, relay = f"127.0.0.1:{self.plant_port}", f"127.0.0.1:{self.relay_port}"
        line = {
            "plant": ["sitl", "plant", "--listen", plant, "--clock", "137s:+40ppm"],
            "relay": ["sitl", "relay", "--listen", relay, "--to", plant, "--link", "jittery"],
            "autopilot": ["autopilot", "--plant", f"udpout:{relay}", "--gcs", "none", "--reference", "5deg@1s"],
        }[name]
        record = ["--record", f"{name}.mcap"]
        self.running[name] = stack.enter_context(program(self.folder, *line, *record))

    def is_up(self, name: str) -> bool:
        """Whether a program has opened its sockets."""
        match name:
            case "plant":
                return listens(self.plant_port)
            case "relay":
                return listens(self.relay_port)
            case _:
                return "autopilot: gains" in self.running[name].stderr

    def recording(self, name: str) -> Path:
        return self.folder / f"{name}.mcap"


@pytest.fixture(scope="module")
def by_hand(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, ...], ByHand]:
    """One flight for each order of starting, all at the same time; each program ended with Ctrl-C."""
    flights = {order: ByHand(tmp_path_factory.mktemp("-".join(order))) for order in ORDERS}
    with ExitStack() as stack:
        for place in range(len(PROGRAMS)):
            for order, flight in flights.items():
                flight.start(order[place], stack)
            for order, flight in flights.items():
                eventually(f"{order[place]} of {order}", lambda f=flight, name=order[place]: f.is_up(name))
        for order, flight in flights.items():
            eventually(f"flight of {order}", lambda f=flight: samples_in(f.recording("plant")) >= FLOWN)
        for flight in flights.values():
            for started in flight.running.values():
                started.send(signal.SIGINT)
        for flight in flights.values():
            flight.codes = {name: started.wait() for name, started in flight.running.items()}
    return flights


@pytest.mark.parametrize("order", ORDERS, ids="-".join)
def test_programs_started_by_hand_fly_in_whatever_order(
    by_hand: dict[tuple[str, ...], ByHand], order: tuple[str, ...]
) -> None:
    flight = by_hand[order]
    assert flight.codes == dict.fromkeys(PROGRAMS, 0)
    counts = {name: topics_in(flight.recording(name)) for name in PROGRAMS}
    assert counts["plant"]["plant/truth"] >= FLOWN
    assert counts["relay"]["link/up"] > counts["relay"]["link/down"] >= ENOUGH
    assert counts["autopilot"]["autopilot/command"] >= ENOUGH
    truth, _ = tables(read_mcap(flight.recording("plant")))
    _, commands = tables(read_mcap(flight.recording("autopilot")))
    assert [body["k"] for body in truth] == list(range(len(truth)))
    flown = [body for body in truth if body["d"] is not None]
    assert len(flown) >= ENOUGH
    for body in flown:
        assert body["d"] == body["k"] - body["j"] >= 1
        assert body["j"] in commands
        assert abs(body["t_ns"] - 137_000_000_000) < 600_000_000_000  # the plant's own clock, and no other


@pytest.mark.parametrize("order", ORDERS, ids="-".join)
def test_programs_started_by_hand_say_nothing_but_what_the_autopilot_flies_and_what_the_relay_can_hold(
    by_hand: dict[tuple[str, ...], ByHand], order: tuple[str, ...]
) -> None:
    flight = by_hand[order]
    assert [flight.running[name].stdout for name in PROGRAMS] == ["", "", ""]
    assert flight.running["plant"].stderr == ""
    assert re.fullmatch(r"receive buffers: autopilot .*, plant .*\n", flight.running["relay"].stderr)
    banner = f"autopilot: gains hirm-paper (no verified certificate), plant 127.0.0.1:{flight.relay_port}\n"
    assert flight.running["autopilot"].stderr == banner


# one peer


def receive(sock: socket.socket, wire: Wire, kind: type) -> object:
    """Return the next message of a kind."""
    while True:
        for message in wire.decode(sock.recv(2048)):
            if isinstance(message, kind):
                return message


def test_a_plant_with_a_fixed_peer_flies_with_that_peer_and_hears_no_stranger(tmp_path: Path) -> None:
    port = free_port()
    with closing(a_socket()) as peer, closing(a_socket()) as stranger, ExitStack() as stack:
        address = ("127.0.0.1", port)
        me = "{}:{}".format(*peer.getsockname())
        line = ["sitl", "plant", "--listen", f"127.0.0.1:{port}", "--peer", me, "--record", "plant.mcap"]
        plant = stack.enter_context(program(tmp_path, *line))
        eventually("plant", lambda: listens(port))
        wire, forger = Wire(AUTOPILOT, PLANT), Wire(AUTOPILOT, PLANT)
        forged = [HEARTBEAT, Timesync(0, 666)]
        for message in forged * 50:
            stranger.sendto(forger.encode(message), address)
        peer.sendto(wire.encode(Timesync(0, 7)), address)
        assert receive(peer, wire, Timesync).ts1 == 7  # and so all before it has been read
        peer.sendto(wire.encode(HEARTBEAT), address)
        assert receive(peer, wire, NamedValueInt).name == "SAMPLE_K"
        for k in range(1, 40):
            t_us = receive(peer, wire, Attitude).time_boot_ms * 1000
            stranger.sendto(forger.encode(HilActuatorControls(t_us, 1.0)), address)
            if k == 20:
                peer.sendto(wire.encode(HilActuatorControls(t_us, 0.25)), address)
        stranger.setblocking(False)
        with pytest.raises(BlockingIOError):
            stranger.recv(1)
        assert plant.end() == 0
    truth, _ = tables(read_mcap(tmp_path / "plant.mcap"))
    assert {body["j"] for body in truth} == {None, 19}
    assert {round(body["u"][0], 6) for body in truth} <= {0.0, 0.109083}


def test_a_relay_with_a_fixed_peer_passes_on_nothing_of_a_stranger_in_either_direction(tmp_path: Path) -> None:
    port = free_port()
    with closing(a_socket()) as peer, closing(a_socket()) as plant, closing(a_socket()) as stranger:
        client, far = ("{}:{}".format(*sock.getsockname()) for sock in (peer, plant))
        line = ["sitl", "relay", "--listen", f"127.0.0.1:{port}", "--to", far, "--peer", client]
        with program(tmp_path, *line) as relay:
            eventually("relay", lambda: listens(port))
            forged = Wire(AUTOPILOT, PLANT).encode(HEARTBEAT)
            for _ in range(50):
                stranger.sendto(forged, ("127.0.0.1", port))
            peer.sendto(b"down", ("127.0.0.1", port))
            datagram, near = plant.recvfrom(2048)
            assert datagram == b"down"
            for _ in range(50):
                stranger.sendto(forged, near)
            plant.sendto(b"up", near)
            assert peer.recv(2048) == b"up"
            assert relay.end() == 0


# cut short


ENDS = ("ctrl-c", "ctrl-c to the group", "kill plant", "kill relay", "kill autopilot", "kill sitl", "hang")


@dataclass(frozen=True)
class Flying:
    """A flight of ``sitl fly`` under way: its folder, its program, and the process id of each program below it."""

    folder: Path
    sitl: Program
    pids: dict[str, int]

    @property
    def recording(self) -> Path:
        return self.folder / "out" / "flight.mcap"


@pytest.fixture(scope="module")
def flights(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Flying]]:
    """One flight for each way to end it, all under way at the same time; the relay of the last one hangs."""
    files = ["--port-base", "0", "--gcs", "none", "--out", "out", "--json"]
    flying = {}
    with ExitStack() as stack:
        for end in ENDS:
            folder = tmp_path_factory.mktemp(end.replace(" ", "-"))
            line = ["sitl", "fly", "nominal", "--duration", "300", *files]
            flying[end] = Flying(folder, stack.enter_context(program(folder, *line)), {})
        for flight in flying.values():
            eventually(
                "flight", lambda f=flight: samples_in(f.recording) >= ENOUGH or f.sitl.process.poll() is not None
            )
            children = children_of(flight.sitl.process.pid)
            for name, words in zip(PROGRAMS, (" sitl plant ", " sitl relay ", " -m autopilot "), strict=True):
                (flight.pids[name],) = (pid for pid, line in children.items() if words in line)
            assert len(children) == len(flight.pids)
        os.kill(flying["hang"].pids["relay"], signal.SIGSTOP)
        flying["hang"].sitl.send(signal.SIGINT)  # and now it takes some seconds
        yield flying


def all_gone(pids: dict[str, int]) -> bool:
    return not any(alive(pid) for pid in pids.values())


@needs_proc
@pytest.mark.parametrize("to", ["ctrl-c", "ctrl-c to the group"])
def test_ctrl_c_ends_a_flight_in_order(flights: dict[str, Flying], to: str) -> None:
    flight = flights[to]
    (os.kill if to == "ctrl-c" else os.killpg)(flight.sitl.process.pid, signal.SIGINT)
    assert flight.sitl.wait() == 130
    assert all_gone(flight.pids)
    assert flight.sitl.stdout.count("\n") == 1
    summary = json.loads(flight.sitl.stdout)
    assert summary["interrupted"] is True
    assert summary["samples"] >= ENOUGH
    assert json.loads((flight.folder / "out" / "summary.json").read_text()) == summary
    counts = topics_in(flight.recording)
    assert counts["plant/truth"] == summary["samples"]
    assert counts["autopilot/command"] >= ENOUGH - 5
    assert not re.search(COMPLAINTS, flight.sitl.stderr)


@needs_proc
@pytest.mark.parametrize("name", PROGRAMS)
def test_a_program_that_is_killed_ends_the_flight_and_is_named(flights: dict[str, Flying], name: str) -> None:
    flight = flights[f"kill {name}"]
    last_words = {"autopilot": "autopilot: gains hirm-paper (no verified certificate)"}.get(name, "it said nothing")
    os.kill(flight.pids[name], signal.SIGKILL)
    assert flight.sitl.wait(20) == 1
    assert all_gone(flight.pids)
    assert flight.sitl.stdout == ""
    assert flight.sitl.stderr.splitlines()[-1].startswith(f"sitl: error: {name} died (signal 9): {last_words}")
    assert not re.search(COMPLAINTS, flight.sitl.stderr)
    assert topics_in(flight.recording)["plant/truth"] >= ENOUGH


@needs_proc
def test_programs_end_by_themselves_when_sitl_is_killed(flights: dict[str, Flying]) -> None:
    flight = flights["kill sitl"]
    flight.sitl.end(signal.SIGKILL)
    eventually("end of the programs", lambda: all_gone(flight.pids), 10)
    for name in PROGRAMS:
        assert not re.search(COMPLAINTS, (flight.folder / "out" / f"{name}.log").read_text())


@needs_proc
def test_a_program_that_hangs_is_killed_and_named_when_the_flight_is_ended(flights: dict[str, Flying]) -> None:
    flight = flights["hang"]
    assert flight.sitl.wait(20) == 1
    assert all_gone(flight.pids)
    assert "relay" in flight.sitl.stderr.splitlines()[-1]
    assert topics_in(flight.recording)["plant/truth"] >= ENOUGH


@needs_proc
def test_ctrl_c_before_the_first_sample_is_no_bad_input(tmp_path: Path) -> None:
    files = ["--port-base", "0", "--gcs", "none", "--out", "out"]
    with program(tmp_path, "sitl", "fly", "nominal", *files) as sitl:
        children = eventually("plant", lambda: children_of(sitl.process.pid))
        code = sitl.end()
        eventually("end of the programs", lambda: not any(alive(pid) for pid in children), 10)
        assert not re.search(COMPLAINTS, sitl.stderr)
        assert code == 130


def test_strangers_who_connect_to_the_recorder_do_not_end_the_flight(tmp_path: Path) -> None:
    supervisor = Supervisor(tmp_path, lambda _record, _at_ns: None)
    with closing(supervisor), ExitStack() as stack:
        address = supervisor._listener.getsockname()
        strangers = []
        for _ in range(MAX_UNKNOWN):
            strangers.append(stack.enter_context(socket.create_connection(address)))
            supervisor.poll(1.0)
        for stranger in strangers:
            stranger.send(b"x")
        stack.enter_context(socket.create_connection(address))
        for _ in range(2 * MAX_UNKNOWN):
            supervisor.poll(0.01)
