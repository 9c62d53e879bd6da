"""The commands of the relay: options and how they are refused, and set, show and watch against a relay on UDP."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager

import pytest
from click.testing import CliRunner, Result

import sitl.commands.relay as relay_module
from autopilot.link.clock import Clock
from autopilot.link.udp import UdpDriver, answer, true_ns
from gains.table import InputError
from sitl.__main__ import cli
from sitl.commands import relaycontrol
from sitl.commands.relay import DEFAULT_SPIN_NS
from sitl.commands.relaycontrol import NoAnswer, status_view
from sitl.link.direction import LinkConfig
from sitl.link.gate import Gate
from sitl.link.relay import DEFAULT_LOG_RATE, RelayNode
from sitl.link.spec import parse_spec
from tests.sitl.relays import MS, PERFECT

pytestmark = pytest.mark.realtime


@contextmanager
def serving(node: RelayNode) -> Iterator[str]:
    """Serve the control port of a relay; give its address."""
    with closing(UdpDriver(node, [answer("control", ("127.0.0.1", 0))], Clock())) as driver:
        stopped = threading.Event()
        host, port = driver.ports[0].local
        thread = threading.Thread(target=driver.run, args=(stopped.is_set,))
        thread.start()
        try:
            yield f"{host}:{port}"
        finally:
            stopped.set()
            thread.join()


def sitl(*arguments: str) -> Result:
    return CliRunner().invoke(cli, ["relay", *arguments])


def refusal(*arguments: str) -> str:
    result = sitl(*arguments)
    if isinstance(result.exception, SystemExit):
        assert result.exit_code == 2
        return result.output
    assert isinstance(result.exception, InputError), result.exception
    return str(result.exception)


# ---------------------------------------------------------------------------------------------- options


@pytest.fixture
def started(monkeypatch):
    """What the command would run."""
    runs = []

    def run(name, node, openers, options, metadata, **more):
        runs.append((node, openers, metadata, more))

    monkeypatch.setattr(relay_module, "run_node", run)
    return runs


def test_by_default_it_is_one_perfect_link_without_control(started):
    result = sitl()
    assert result.exit_code == 0, result.output
    ((node, openers, metadata, more),) = started
    assert more.pop("at_end") == node.close
    assert more == {"tap": False, "control": 2, "spin_ns": DEFAULT_SPIN_NS}
    assert [(opener.args[0], opener.args[1]) for opener in openers] == [
        ("autopilot", ("127.0.0.1", 14601)),
        ("plant", ("127.0.0.1", 14600)),
    ]
    assert metadata["seed"] == "1"
    assert node.counters.keys() == {"up", "down"}
    assert node._outbox.log_rate == 0  # nobody records


def test_every_option_of_a_link_reaches_it(started, tmp_path):
    rules, changes = ["up:ATTITUDE:delay=40ms", "down:0:loss=1.0"], ["3s:up:loss=0.5", "1s:down:delay=9ms"]
    options = ["--link", "radio", "--up", "delay=5ms", "--seed", "9", "--spin", "1ms", "--record", str(tmp_path / "r")]
    options += [word for rule in rules for word in ("--rule", rule)]
    options += [word for change in changes for word in ("--at", change)]
    result = sitl(*options)
    assert result.exit_code == 0, result.output
    ((node, _, metadata, more),) = started
    (link,) = node._links
    assert link.up.main.impairment.spec == parse_spec("delay=5ms")
    assert [lane.rule.messages for lane in (*link.up.rules, *link.down.rules)] == ["ATTITUDE", "0"]
    assert [len(direction.changes) for direction in link.directions] == [1, 1]
    assert (metadata["seed"], more["spin_ns"], node._outbox.log_rate) == ("9", MS, DEFAULT_LOG_RATE)


@pytest.mark.parametrize(
    ("words", "address"), [(["--control"], ("127.0.0.1", 14602)), (["--control", "[::1]:99"], ("::1", 99))]
)
def test_control_is_the_last_port_at_its_default_address_or_another(started, words, address):
    assert sitl(*words).exit_code == 0
    ((_, openers, _, more),) = started
    assert openers[-1].func is answer
    assert openers[-1].args == ("control", address)
    assert (len(openers), more["control"]) == (3, 2)


def test_a_witness_still_times_the_commands(started, tmp_path):
    from gains.witnessfile import Witness, write_witness

    write_witness(tmp_path / "w.csv", Witness("", "", 0.025, 1, 2, "fifo", 1.0, (2,)))
    assert sitl("--witness", str(tmp_path / "w.csv")).exit_code == 0
    assert isinstance(started[0][0]._links[0].gate, Gate)


CONFIG = "\n".join(
    f'[[link]]\nname = "{name}"\nlisten = "127.0.0.1:{near}"\nto = "127.0.0.1:{far}"\naccept = "any"'
    for name, near, far in (("one", 5001, 5002), ("two", 5003, 5004))
)


def test_a_file_opens_two_ports_for_each_of_its_links(started, tmp_path):
    (tmp_path / "relay.toml").write_text(CONFIG)
    assert sitl("--config", str(tmp_path / "relay.toml"), "--control").exit_code == 0
    ((node, openers, _, more),) = started
    assert [opener.args[0] for opener in openers] == [
        *("one/autopilot", "one/plant", "two/autopilot", "two/plant"),
        "control",
    ]
    assert set(node._entries) == {opener.args[0] for opener in openers[:-1]}
    assert more["control"] == 4


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--control", "0.0.0.0:14602"], "expected one of this machine alone"),
        (["--control", "192.0.2.1:14602"], "expected one of this machine alone"),
        (["--rule", "up:NOTHING:loss=1"], 'rule "up:NOTHING:loss=1"'),
        (["--rule", "up:0:loss=1"] * 17, "--rule: expected at most 16, found 17"),
        (["--at", "now:up:loss=1"], 'change "now:up:loss=1"'),
        (["--spin", "11ms"], "--spin: expected at most 10ms, found 11ms"),
        (["--spin", "11"], "--spin: expected a time with its unit"),
        (["--config", "/nowhere.toml"], "/nowhere.toml: expected a file"),
        (["--seed", "2", "show"], "show: expected its options after it"),
        (["bogus"], "No such command 'bogus'"),
        (["--log-rate", "-1"], "log-rate"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(arguments, said):
    ends = ["--listen", "127.0.0.1:0"] if arguments[0] in ("--control", "--rule", "--at", "--spin") else []
    assert said in refusal(*ends, *arguments)


def test_a_file_takes_the_place_of_the_options_of_a_link(tmp_path):
    (tmp_path / "relay.toml").write_text(CONFIG)
    for words in (["--up", "loss=1"], ["--seed", "1"], ["--listen", "127.0.0.1:1"], ["--rule", "up:0:loss=1"]):
        assert "no other option of a link" in refusal("--config", str(tmp_path / "relay.toml"), *words)


# ---------------------------------------------------------------------------------------- set, show, watch


def test_set_changes_a_running_relay_and_prints_what_repeats_it():
    node = RelayNode(PERFECT, PERFECT, 1)
    with serving(node) as address:
        done = sitl("set", "--control", address, "--up", "loss=0.5", "--down", "delay=9ms")
        assert (done.exit_code, done.output) == (0, "--at 0ns:up:loss=0.5\n--at 0ns:down:delay=9ms\n")
        shown = sitl("show", "--control", address, "--json")
    assert node._links[0].down.spec_at(0) == parse_spec("delay=9ms")
    status = json.loads(shown.output)
    assert status["links"]["link"]["up"]["spec"] == "loss=0.5"
    assert status["control"] == {"requests": 2, "refused": 0, "malformed": 0}


def test_a_refusal_of_the_relay_is_bad_input():
    with serving(RelayNode(PERFECT, PERFECT, 1)) as address:
        assert "without files" in refusal("set", "--control", address, "--up", "trace=/etc/hostname")
        assert "found other" in refusal("set", "--control", address, "--name", "other", "--up", "loss=1")
        assert "at least one of preset" in refusal("set", "--control", address)
        assert "at most 4096 bytes" in refusal("set", "--control", address, "--up", "hold=1s:1s," * 500)


def test_show_is_a_table_of_every_link_with_texts_as_they_are(monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    node = RelayNode.joining([LinkConfig(parse_spec("delay=5ms"), PERFECT, n, name) for n, name in enumerate("ab")])
    for n in range(10):
        node.receive("a/plant", bytes(50), n * 10 * MS)
        node.tick(n * 10 * MS + 6 * MS)
    node.outgoing()
    with serving(node) as address:
        assert sitl("set", "--control", address, "--name", "b", "--link", "lossy").exit_code == 0
        shown = sitl("show", "--control", address)
    assert shown.exit_code == 0, shown.output
    for text in ("10 sent, 10 delivered", "p50 5.000 ms, p99 5.000 ms", "p50 6.000 ms", "jitter=uniform:28ms"):
        assert text in shown.output


def test_a_change_to_come_is_shown_as_it_is_written():
    """A colon, a word and a colon are no picture."""
    from rich.console import Console

    way = {"spec": "delay=0ns", "sent": 0, "delivered": 0, "lost": 0, "refused": 0, "gated": 0, "duplicated": 0}
    way |= {"reordered": 0, "queued": 0, "rate_hz": 0.0, "rate_bps": 0.0, "next_changes": ["9s:up:loss=0.5"]}
    way |= dict.fromkeys(("requested_ns", "achieved_ns", "error_ns"))
    console = Console(width=100)
    with console.capture() as capture:
        console.print(status_view({"[red]link": {"link_ns": 0, "up": way, "down": way}}))
    assert "9s:up:loss=0.5" in capture.get()
    assert "[red]link" in capture.get()


def test_watch_shows_until_it_is_interrupted(monkeypatch):
    waits = []

    class Pause:
        def wait(self, seconds: float) -> bool:
            waits.append(seconds)
            if len(waits) == 3:
                raise KeyboardInterrupt
            return False

    monkeypatch.setattr(relaycontrol, "Event", Pause)
    node = RelayNode(PERFECT, PERFECT, 1)
    with serving(node) as address:
        watched = sitl("watch", "--control", address)
    assert watched.exit_code == 0, watched.output
    assert node._control["requests"] == 3
    assert waits == [relaycontrol.WATCH_S] * 3


@pytest.mark.parametrize("command", ["set", "show", "watch"])
def test_where_no_relay_answers_one_line_says_so_and_the_exit_code_is_1(monkeypatch, command):
    monkeypatch.setattr(relaycontrol, "ANSWER_S", 0.05)
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as silent:
        silent.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{silent.getsockname()[1]}"
        begin_ns = true_ns()
        result = sitl(command, "--control", address, *(["--up", "loss=1"] if command == "set" else []))
    assert result.exit_code == 1
    assert (
        result.stderr == f"sitl: error: relay at {address}: no answer within 0.05 s: was it started with --control?\n"
    )
    assert true_ns() - begin_ns >= 50 * MS


def test_a_caller_passes_over_replies_to_earlier_requests(monkeypatch):
    monkeypatch.setattr(relaycontrol, "ANSWER_S", 0.05)
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as relay:
        relay.bind(("127.0.0.1", 0))
        with closing(relaycontrol.Caller(relay.getsockname())) as caller:
            near = caller._socket.getsockname()
            relay.sendto(b"noise", near)
            relay.sendto(b'{"id":7,"ok":true}', near)
            relay.sendto(b'{"id":1,"ok":true,"right":1}', near)
            assert caller.ask("show")["right"] == 1
            with pytest.raises(NoAnswer):
                caller.ask("show")
