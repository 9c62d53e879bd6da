"""Bad input to the programs: exit code 2, one line on standard error that names it, nothing on standard output."""

from __future__ import annotations

import signal
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path

import click
import pytest

import autopilot.__main__
import sitl.__main__
from autopilot.link import ports as link_ports
from gains.command import run
from gains.store import resolve
from sitl.scenario import stored_scenarios
from tests.integration.programs import Program, a_socket, program

NO_GCS = ["--gcs", "none"]
NOWHERE = "udpout:no.such.host.invalid:14550"
PAPER = resolve("hirm-paper").read_text()
PENDULUM = resolve("pendulum-paper").read_text()
NOMINAL = stored_scenarios()["nominal"].read_text()

FILES = {
    "no.toml": "name = \n",
    "empty.toml": "",
    "narrow.toml": PAPER.replace("K1 = [[-0.5054, 3.3877, 3.1151]]", "K1 = [[3.3877, 3.1151]]"),
    "words.toml": PAPER.replace("3.3877", '"three"', 1),
    "nan.toml": PAPER.replace("3.3877", "nan", 1),
    "backwards.toml": PAPER.replace("d_min = 1", "d_min = 5"),
    "nomodel.toml": PAPER.replace('"hirm"', '"hurm"'),
    "noK2.toml": PAPER.replace("K2 =", "# K2 ="),
    "K2.toml": PENDULUM + "K2 = [[1.0, 2.0]]\n",
    "extra.toml": PAPER + "K3 = 1\n",
    "noE.toml": resolve("pendulum").read_text().replace("E =", "# E ="),
    "unknown.toml": NOMINAL.replace("duration_s", "duration_h"),
    "key.toml": "colour = 3\n" + NOMINAL,
    "unbound.toml": NOMINAL.replace("at_most = 0.002", ""),
    "rules.toml": NOMINAL.replace("[link]", '[link]\nrules = ["up:ATTITUDE"]'),
    "changes.toml": NOMINAL.replace("[link]", '[link]\nchanges = ["2s:up:loss=0.1", "99s:up:loss=0.1"]'),
    "link.toml": NOMINAL.replace('preset = "jittery"', 'up = "delay=5"'),
    "clock.toml": NOMINAL + '[clocks]\nplant = "soon"\n',
    "misfit.toml": NOMINAL.replace('plant = "hirm"', 'plant = "pendulum"'),
    "steps.toml": NOMINAL.replace("5deg@1s", "5deg@1s,0deg@1s"),
    "still.toml": NOMINAL.replace("duration_s = 10.0", "duration_s = 0.0"),
    "ghost.toml": NOMINAL.replace('gains = "hirm-paper"', 'gains = "hirm-papers"'),
}


@pytest.fixture(autouse=True)
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def complaint(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[[list[str]], str]:
    """Give a function that runs a command line in this process and returns its one line of complaint."""

    def run_it(line: list[str]) -> str:
        name, *arguments = line
        command: click.Command = {"sitl": sitl.__main__.cli, "autopilot": autopilot.__main__.cli}[name]
        monkeypatch.setattr(sys, "argv", [name, *arguments])
        handlers = [signal.getsignal(signum) for signum in (signal.SIGINT, signal.SIGTERM)]
        try:
            with pytest.raises(SystemExit) as ended:
                run(command, name)
        finally:
            for signum, handler in zip((signal.SIGINT, signal.SIGTERM), handlers, strict=True):
                signal.signal(signum, handler)
        out, err = capsys.readouterr()
        assert (ended.value.code, out) == (2, ""), err
        return one_line(err, name)

    return run_it


def one_line(err: str, name: str) -> str:
    assert err.endswith("\n")
    assert err.count("\n") == 1, err
    assert err.startswith(f"{name}: error: ")
    return err


@pytest.fixture
def no_socket(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let nobody open a socket; still a class, for the modules that are imported meanwhile and derive from it."""

    class Refused(socket.socket):
        def __init__(self, *_arguments: object, **_more: object) -> None:
            raise AssertionError("a socket was opened before the input was read")

    monkeypatch.setattr(socket, "socket", Refused)


@pytest.fixture
def sockets(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[socket.socket]]:
    """Give a list of the sockets that the programs open."""
    opened: list[socket.socket] = []
    make = link_ports._socket

    def remember(family: socket.AddressFamily) -> socket.socket:
        opened.append(make(family))
        return opened[-1]

    monkeypatch.setattr(link_ports, "_socket", remember)
    yield opened
    for sock in opened:
        sock.close()


FLY = ["sitl", "fly"]
PLANT = ["sitl", "plant", "--listen", "127.0.0.1:0"]
RELAY = ["sitl", "relay", "--listen", "127.0.0.1:0"]
AUTOPILOT = ["autopilot", *NO_GCS]


@pytest.mark.usefixtures("no_socket")
@pytest.mark.parametrize(
    ("line", "named"),
    [
        # scenarios
        ([*FLY, "nominale"], ['"nominale"', "nominal"]),
        ([*FLY, "no.toml"], ["no.toml"]),
        ([*FLY, "empty.toml"], ["empty.toml", "gains"]),
        ([*FLY, "."], ['"."']),
        ([*FLY, "unknown.toml"], ["unknown.toml", "duration_"]),
        ([*FLY, "key.toml"], ["key.toml", "colour"]),
        ([*FLY, "unbound.toml"], ["unbound.toml", "check", "at_most"]),
        ([*FLY, "link.toml"], ["delay=5"]),
        ([*FLY, "rules.toml"], ["rules.toml: link.rules[0]:", '"up:ATTITUDE"']),
        ([*FLY, "changes.toml"], ["changes.toml: link.changes[1]:", "at most 40s", "99s"]),
        ([*FLY, "clock.toml"], ['"soon"']),
        ([*FLY, "misfit.toml"], ["angle_rad", "pendulum"]),
        ([*FLY, "steps.toml"], ["rising times"]),
        ([*FLY, "still.toml"], ["still.toml", "duration_s"]),
        ([*FLY, "ghost.toml"], ["hirm-papers", "did you mean hirm-paper?"]),
        ([*FLY, "nominal", "--plant", "pendulum"], ["pendulum"]),
        ([*FLY, "nominal", "--gains", "narrow.toml"], ["narrow.toml", "K1"]),
        ([*FLY, "nominal", "--duration", "0"], ["--duration"]),
        ([*FLY, "nominal", "--duration", "-1"], ["--duration"]),
        ([*FLY, "nominal", "--port-base", "65535"], ["--port-base"]),
        ([*FLY, "nominal", "--actuator", "pmw"], ["--actuator", "pmw"]),
        ([*FLY, "nominal", "--gcs", "127.0.0.1"], ["127.0.0.1", "HOST:PORT"]),
        ([*FLY, "nominal", "--up", "delay=5"], ["delay=5"]),
        ([*FLY, "nominal", "--link", "jitery"], ["--link", "jitery"]),
        ([*FLY, "nominal", "--rule", "ATTITUDE:loss=1"], ["ATTITUDE:loss=1", "up:MESSAGE"]),
        ([*FLY, "nominal", "--at", "2:up:loss=1"], ["2:up:loss=1", "unit"]),
        ([*FLY, "nominal", "--control", "port"], ["--control", "[HOST:]PORT"]),
        ([*FLY, "nominal", "--virtual", "--control", "14602"], ["--virtual", "--control"]),
        ([*FLY, "nominal", "--out", "no.toml"], ["--out", "no.toml"]),
        ([*FLY, "nominal", "more"], ["more"]),
        # gain files
        ([*AUTOPILOT, "--gains", "hirm-papr"], ["hirm-papr", "did you mean hirm-paper?"]),
        ([*AUTOPILOT, "--gains", "no.toml"], ["no.toml"]),
        ([*AUTOPILOT, "--gains", "empty.toml"], ["empty.toml"]),
        ([*AUTOPILOT, "--gains", "."], ["."]),
        ([*AUTOPILOT, "--gains", "hirm"], ["hirm.toml", "gain file"]),
        ([*AUTOPILOT, "--gains", "narrow.toml"], ["narrow.toml", "K1", "3", "2"]),
        ([*AUTOPILOT, "--gains", "words.toml"], ["words.toml", "K1", "three"]),
        ([*AUTOPILOT, "--gains", "nan.toml"], ["nan.toml", "K1"]),
        ([*AUTOPILOT, "--gains", "backwards.toml"], ["backwards.toml", "d_max", "5", "4"]),
        ([*AUTOPILOT, "--gains", "nomodel.toml"], ["nomodel.toml", "model", "hurm"]),
        ([*AUTOPILOT, "--gains", "noK2.toml"], ["noK2.toml", "K2"]),
        ([*AUTOPILOT, "--gains", "K2.toml"], ["K2.toml", "K2", "[reference]"]),
        ([*AUTOPILOT, "--gains", "extra.toml"], ["extra.toml", "K3"]),
        ([*AUTOPILOT, "--require-certificate"], ["hirm-paper", "certificate"]),
        # the autopilot's options
        (["autopilot", "--gcs", "localhost"], ["localhost", "HOST:PORT"]),
        (["autopilot", "--gcs", "localhost:port"], ["localhost:port"]),
        ([*AUTOPILOT, "--plant", "127.0.0.1:65536"], ["127.0.0.1:65536"]),
        ([*AUTOPILOT, "--plant", "udpout:"], ['"udpout:"']),
        ([*AUTOPILOT, "--reference", "5deg"], ['"5deg"']),
        ([*AUTOPILOT, "--reference", "5deg@-1s"], ["5deg@-1s"]),
        ([*AUTOPILOT, "--clock", "137"], ['"137"', "OFFSETs:DRIFTppm"]),
        ([*AUTOPILOT, "--clock", "1s:20000ppm"], ["20000ppm"]),
        ([*AUTOPILOT, "--hold", "-1"], ["--hold"]),
        ([*AUTOPILOT, "--record", "."], ["--record"]),
        ([*AUTOPILOT, "--nonsense"], ["--nonsense"]),
        (["autopilot", *(["--gcs", "127.0.0.1:9"] * 9)], ["at most 8", "9"]),
        # the plant's
        ([*PLANT, "--plant", "hurm"], ["hurm"]),
        ([*PLANT, "--plant", "hirm-paper"], ["hirm-paper"]),
        ([*PLANT, "--x0", "0.1,0"], ["--x0", "3", "2"]),
        ([*PLANT, "--x0", "0.1,0,x"], ["--x0", "0.1,0,x"]),
        ([*PLANT, "--x0", "0,0,nan"], ["--x0", "finite"]),
        ([*PLANT, "--plant", "noE.toml", "--gust", "0"], ["--gust", "pendulum"]),
        ([*PLANT, "--plant", "pendulum", "--uncertainty", "0.15:20"], ["--uncertainty", "pendulum"]),
        ([*PLANT, "--uncertainty", "much"], ["--uncertainty", "much"]),
        ([*PLANT, "--servo-timeout", "-1"], ["--servo-timeout"]),
        ([*PLANT, "--latch", "oldest"], ["--latch", "oldest"]),
        (["sitl", "plant", "--listen", "14600"], ['"14600"']),
        ([*PLANT, "--peer", "127.0.0.1"], ['"127.0.0.1"']),
        # the relay's
        ([*RELAY, "--up", "delay=5"], ["delay=5"]),
        ([*RELAY, "--down", "loss=2"], ["loss=2"]),
        ([*RELAY, "--up", "lag=5ms"], ["lag"]),
        ([*RELAY, "--up", "trace=nowhere.csv"], ["nowhere.csv"]),
        ([*RELAY, "--seed", "-1"], ["--seed"]),
        (["sitl", "relay", "--listen", "::1"], ["::1"]),
        (["sitl", "nothing"], ["nothing"]),
        (["sitl"], ["command"]),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) and value[0] in ("sitl", "autopilot") else "",
)
def test_it_is_named_before_a_socket_opens(
    complaint: Callable[[list[str]], str], line: list[str], named: list[str]
) -> None:
    message = complaint(line)
    assert all(word in message for word in named), message


@pytest.mark.parametrize(
    ("line", "named"),
    [
        ([*FLY, "nominal", "--virtual", "--out", "out", "--duration", "nan"], "--duration"),
        ([*FLY, "nominal", "--virtual", "--out", "out", "--duration", "1", "--seed", "9" * 30, "--json"], "--seed"),
        ([*PLANT, "--gust", "nan"], "--gust"),
        ([*PLANT, "--gust", "inf"], "--gust"),
        ([*AUTOPILOT, "--hold", "nan"], "--hold"),
    ],
    ids=lambda value: " ".join(value[-4:]) if isinstance(value, list) else "",
)
def test_a_number_that_is_none_is_named(complaint: Callable[[list[str]], str], line: list[str], named: str) -> None:
    assert named in complaint(line)


@pytest.mark.parametrize(
    ("line", "named"),
    [
        (["sitl", "plant", "--listen", NOWHERE], "no.such.host.invalid:14550"),
        (["sitl", "plant", "--listen", "192.0.2.1:14600"], "192.0.2.1:14600"),
        ([*PLANT, "--peer", NOWHERE], "no.such.host.invalid:14550"),
        ([*RELAY, "--to", NOWHERE], "no.such.host.invalid:14550"),
        (["autopilot", "--gcs", NOWHERE], "no.such.host.invalid:14550"),
        ([*AUTOPILOT, "--plant", NOWHERE], "no.such.host.invalid:14550"),
        ([*AUTOPILOT, "--plant", f"{'a' * 64}.org:1"], "cannot be resolved"),
        ([*AUTOPILOT, "--plant", "255.255.255.255:1"], "255.255.255.255:1"),
        pytest.param(
            [*AUTOPILOT, "--record", "nowhere/a.mcap"],
            "nowhere/a.mcap",
        ),
        ([*PLANT, "--record", "no.toml/a.mcap"], "no.toml/a.mcap"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
@pytest.mark.usefixtures("sockets")
def test_an_address_or_a_file_that_cannot_be_had_is_named(
    complaint: Callable[[list[str]], str], line: list[str], named: str
) -> None:
    assert named in complaint(line)


@pytest.mark.usefixtures("sockets")
def test_a_recorder_that_is_not_there_is_named(complaint: Callable[[list[str]], str]) -> None:
    with closing(socket.socket()) as taken:
        taken.bind(("127.0.0.1", 0))  # and does not listen
        host, port = taken.getsockname()
        assert f"{host}:{port}" in complaint([*PLANT, "--stream", f"{host}:{port}"])


@pytest.mark.parametrize(
    "line",
    [[*PLANT, "--peer", NOWHERE], [*RELAY, "--to", NOWHERE], [*PLANT, "--record", "nowhere/a.mcap"]],
    ids=["peer", "second port", "recording"],
)
def test_a_program_that_refuses_its_input_closes_its_sockets(
    complaint: Callable[[list[str]], str], line: list[str], sockets: list[socket.socket]
) -> None:
    complaint(line)
    assert [sock.fileno() for sock in sockets] == [-1] * len(sockets)


KINDS = ("plant", "relay", "fly, its plant", "fly, its relay")
REFUSED = {
    "scenario": (["nominale"], '"nominale"'),
    "folder": (["nominal", "--out", "../no.toml/out"], "no.toml/out"),
    "ground station": (["nominal", "--gcs", NOWHERE, "--out", "out", "--port-base", "0"], "no.such.host.invalid:14550"),
}


@dataclass(frozen=True)
class Refusals:
    """Programs that have ended, and the ports that were taken from them."""

    programs: dict[str, Program]
    ports: dict[str, int]

    def complaint(self, name: str) -> str:
        """Return the one line that a program has said, its exit code being that of bad input."""
        refused = self.programs[name]
        assert (refused.process.returncode, refused.stdout) == (2, "")
        return one_line(refused.stderr, "sitl")


@pytest.fixture(scope="module")
def refusals(tmp_path_factory: pytest.TempPathFactory) -> Refusals:
    """Run programs that are refused, as processes, all at the same time."""
    folder = tmp_path_factory.mktemp("refused")
    (folder / "no.toml").touch()
    lines = {name: ["fly", *line] for name, (line, _) in REFUSED.items()}
    ports = {}
    with ExitStack() as stack:
        for kind in KINDS:
            port = ports[kind] = stack.enter_context(closing(a_socket())).getsockname()[1]
            base = port - 1 if kind == "fly, its relay" else port
            fly = ["fly", "nominal", *NO_GCS, "--out", "out", "--port-base", str(base)]
            lines[kind] = fly if "fly" in kind else [kind, "--listen", f"127.0.0.1:{port}"]
        programs = {
            name: stack.enter_context(program(folder / str(number), "sitl", *line))
            for number, (name, line) in enumerate(lines.items())
        }
        for started in programs.values():
            started.wait()
    return Refusals(programs, ports)


@pytest.mark.parametrize("kind", KINDS)
def test_a_busy_port_is_named(refusals: Refusals, kind: str) -> None:
    message = refusals.complaint(kind)
    assert f"127.0.0.1:{refusals.ports[kind]}" in message
    assert "in use" in message


@pytest.mark.parametrize("name", REFUSED)
def test_sitl_fly_refuses_in_one_line(refusals: Refusals, name: str) -> None:
    assert REFUSED[name][1] in refusals.complaint(name)


def test_a_complaint_of_the_autopilot_is_passed_on_as_one_complaint(refusals: Refusals) -> None:
    assert refusals.complaint("ground station").count("error: ") == 1
