"""100,000 hostile datagrams at every socket of a flight: the flight goes on, and each of them is counted.

    autopilot <-> this process <-> relay <-> plant

This process passes on what the programs send each other, and adds what no peer would send: from the address
that the autopilot and the relay know as their peer, and from a stranger's. A burst is followed by a TIMESYNC
request, and the next one waits for the answer: no datagram is lost to a full buffer, so all can be counted.

The window of the gains is a second, so that nothing but a datagram can put the autopilot into failsafe.
"""

from __future__ import annotations

import itertools
import select
import socket
import struct
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from time import monotonic  # noqa: TID251  a flight over UDP is in real time

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from autopilot.link.record import read_mcap
from autopilot.link.signing import Verdict
from autopilot.link.wire import (
    AUTOPILOT,
    MAX_DATAGRAM_BYTES,
    PLANT,
    AoaSsa,
    Attitude,
    HilActuatorControls,
    NamedValueInt,
    Reject,
    ServoOutputRaw,
    Timesync,
    Wire,
    plant_heartbeat,
)
from gains.store import resolve
from tests.helpers import HEARTBEAT, broken
from tests.integration.programs import a_socket, eventually, free_port, listens, program, topics_in

pytestmark = pytest.mark.realtime

DATAGRAMS = 100_000
BURST = 200
KINDS = 10_000
TIMEOUT_S = 60.0
OTHERS = ((255, 190), (1, 26), (2, 1), (0, 0), (1, 2))
NAN, INF = float("nan"), float("inf")
ATTITUDE = Attitude(1000, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
TO_AUTOPILOT = (
    *(plant_heartbeat(), Timesync(5, 6), Timesync(0, 6), ATTITUDE, AoaSsa(10**6, 1.5, 0.5)),
    *(NamedValueInt(1000, "DELAY_K", 3), NamedValueInt(1000, "SAMPLE_K", 9)),
)
TO_PLANT = (
    *(HEARTBEAT, Timesync(5, 6), Timesync(0, 6)),
    *(ServoOutputRaw(10**6, 1900), HilActuatorControls(10**6, 1.0)),
)
NO_NUMBERS = {
    "plant": [HilActuatorControls(10**6, value) for value in (NAN, INF, -INF)],
    "autopilot": [
        *(Attitude(1000, 0.0, value, 0.0, 0.0, 0.0, 0.0) for value in (NAN, INF, -INF)),
        *(AoaSsa(10**6, value, 0.0) for value in (NAN, INF, -INF)),
    ],
}


def hostile(receiver: str, seed: int) -> list[bytes]:
    """Return datagrams that a receiver may not accept, none of them empty: damaged, forged, without numbers."""
    source, peer = (PLANT, AUTOPILOT) if receiver == "autopilot" else (AUTOPILOT, PLANT)
    messages = TO_AUTOPILOT if receiver == "autopilot" else TO_PLANT
    rng = np.random.default_rng(seed)
    sender = Wire(source, peer)
    forgers = [Wire(other, peer) for other in OTHERS]
    made = []
    while len(made) < KINDS:
        message = messages[rng.integers(len(messages))]
        match rng.integers(10):
            case 0:
                made.append(forgers[rng.integers(len(forgers))].encode(message))
            case 1:
                infinite = NO_NUMBERS[receiver]
                made.append(sender.encode(infinite[rng.integers(len(infinite))]))
            case 2:
                made.append(sender.encode(message) + rng.bytes(rng.integers(MAX_DATAGRAM_BYTES, 4000)))
            case 3:
                made.append(unknown(rng, source))
            case _:
                made.append(broken(sender.encode(message), rng))
        if not made[-1]:
            made.pop()
    wire = Wire(peer, source)
    assert [wire.decode(datagram) for datagram in made] == [[]] * KINDS
    of_signatures = {Reject(verdict) for verdict in Verdict if verdict is not Verdict.ACCEPTED}
    assert set(wire.rejects) >= set(Reject) - of_signatures - {Reject.UNHANDLED, Reject.EXCESS}
    return made


def unknown(rng: np.random.Generator, source: tuple[int, int]) -> bytes:
    """Return a frame of the right source with a message id that no dialect knows."""
    number = next(n for n in rng.integers(1 << 24, size=100).tolist() if n not in dialect.mavlink_map)
    header = struct.pack("<BBBBBBBHB", 0xFD, 4, 0, 0, 0, *source, number & 0xFFFF, number >> 16)
    return header + rng.bytes(6)


@dataclass
class Flood:
    """Hostile datagrams on their way to one socket, a burst at a time."""

    send: Callable[[bytes], object]
    datagrams: list[bytes]
    ask: Callable[[int], object]
    """Sends a request with this number behind a burst."""
    token: int
    sent: int = 0
    answered: bool = True

    @property
    def done(self) -> bool:
        return self.sent >= DATAGRAMS and self.answered

    def go_on(self) -> None:
        """Send the next burst, if the last one has been read."""
        if not self.answered or self.sent >= DATAGRAMS:
            return
        for i in range(self.sent, min(self.sent + BURST, DATAGRAMS)):
            self.send(self.datagrams[i % KINDS])
            self.sent += 1
        self.token += 1
        self.answered = False
        self.ask(self.token)


@dataclass
class Middle:
    """Passes datagrams on between the autopilot and the relay, and counts the samples."""

    near: socket.socket
    """The autopilot's peer."""
    far: socket.socket
    """The relay's client."""
    autopilot: tuple[str, int] = ("", 0)
    samples: int = 0
    ears: dict[str, Wire] = field(default_factory=dict)
    mouths: dict[str, Wire] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.ears = {"autopilot": Wire(PLANT, AUTOPILOT), "relay": Wire(AUTOPILOT, PLANT)}
        self.mouths = {"autopilot": Wire(PLANT, AUTOPILOT), "relay": Wire(AUTOPILOT, PLANT)}

    def to_autopilot(self, datagram: bytes) -> None:
        self.near.sendto(datagram, self.autopilot)

    def ask_autopilot(self, token: int) -> None:
        self.to_autopilot(self.mouths["autopilot"].encode(Timesync(0, token)))

    def ask_plant(self, token: int) -> None:
        self.far.send(self.mouths["relay"].encode(Timesync(0, token)))

    def pass_on(self, until: Callable[[], bool], flood: Flood | None = None) -> None:
        """Pass on, and flood, until the condition holds."""
        deadline = monotonic() + TIMEOUT_S
        while not until():
            assert monotonic() < deadline
            if flood is not None:
                flood.go_on()
            for sock in select.select([self.near, self.far], [], [], 0.1)[0]:
                if sock is self.near:
                    datagram, self.autopilot = sock.recvfrom(2048)
                    if not self._answers(datagram, "autopilot", flood):
                        self.far.send(datagram)
                else:
                    datagram = sock.recv(2048)
                    if not self._answers(datagram, "relay", flood):
                        self.to_autopilot(datagram)

    def _answers(self, datagram: bytes, whom: str, flood: Flood | None) -> bool:
        """Whether a datagram is the answer that a flood waits for; samples are counted."""
        for message in self.ears[whom].decode(datagram):
            if isinstance(message, Attitude):
                self.samples += 1
            elif isinstance(message, Timesync) and flood is not None and message.tc1 and message.ts1 == flood.token:
                flood.answered = True
                return True
        return False


@dataclass(frozen=True)
class Flown:
    """A flight that has been flooded, and has ended."""

    folder: Path
    codes: dict[str, int]
    stderr: dict[str, str]
    samples: dict[str, int]
    """Samples that came during each flood."""
    rejected: Counter[Reject]
    """What the autopilot must have refused."""

    @cached_property
    def bodies(self) -> dict[str, list[dict]]:
        """The recorded bodies of each topic; of the events, the autopilot's."""
        found: dict[str, list[dict]] = {}
        for name, topics in (("plant", {"plant/truth"}), ("autopilot", {"autopilot/command", "events"})):
            for topic, _, body in read_mcap(self.folder / f"{name}.mcap"):
                if topic in topics:
                    found.setdefault(topic, []).append(body)
        return found


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    folder = tmp_path_factory.mktemp("hostile")
    (folder / "wide.toml").write_text(resolve("hirm-paper").read_text().replace("d_max = 4", "d_max = 40"))
    plant_port, relay_port = free_port(), free_port()
    to_autopilot, to_plant = hostile("autopilot", 1), hostile("plant", 2)
    with ExitStack() as stack:
        near, far, stranger = (stack.enter_context(closing(a_socket())) for _ in range(3))
        far.connect(("127.0.0.1", relay_port))
        middle = Middle(near, far)
        plant, relay = f"127.0.0.1:{plant_port}", f"127.0.0.1:{relay_port}"
        lines = {
            "plant": ["sitl", "plant", "--listen", plant, "--servo-timeout", "60"],
            "relay": ["sitl", "relay", "--listen", relay, "--to", plant],
            "autopilot": [
                *("autopilot", "--plant", "{}:{}".format(*near.getsockname()), "--gcs", "none", "--gains", "wide.toml"),
                *("--actuator", "float", "--reference", "5deg@1s"),
            ],
        }
        programs = {}
        for name, line in lines.items():
            record = [] if name == "relay" else ["--record", f"{name}.mcap"]
            programs[name] = stack.enter_context(program(folder, *line, *record))
        eventually("plant", lambda: listens(plant_port))
        eventually("relay", lambda: listens(relay_port))
        middle.pass_on(lambda: middle.samples >= 80)
        home = middle.autopilot

        def from_stranger(port: int) -> Callable[[bytes], object]:
            return lambda datagram: stranger.sendto(datagram, ("127.0.0.1", port))

        tokens = itertools.count(1 << 40, 1 << 20)
        floods = {
            "the relay and the plant, from their peers": (far.send, to_plant, middle.ask_plant),
            "the relay, from a stranger": (from_stranger(relay_port), to_plant, middle.ask_plant),
            "the plant, from a stranger": (from_stranger(plant_port), to_plant, middle.ask_plant),
            "the autopilot, from its peer": (middle.to_autopilot, to_autopilot, middle.ask_autopilot),
            "the autopilot, from a stranger": (from_stranger(home[1]), to_autopilot, middle.ask_autopilot),
        }
        samples = {}
        for name, (send, datagrams, ask) in floods.items():
            flood, before = Flood(send, datagrams, ask, next(tokens)), middle.samples
            middle.pass_on(lambda flood=flood: flood.done, flood)
            assert flood.sent == DATAGRAMS
            samples[name] = middle.samples - before
        last = middle.samples + 80
        middle.pass_on(lambda: middle.samples >= last)  # two seconds: the counters are recorded once a second
        codes = {name: programs[name].end() for name in ("autopilot", "relay", "plant")}
        stderr = {name: programs[name].stderr for name in lines}
    wire = Wire(AUTOPILOT, PLANT)
    for i in range(DATAGRAMS):
        wire.decode(to_autopilot[i % KINDS])
    return Flown(folder, codes, stderr, samples, wire.rejects)


def test_no_program_ends_or_complains(flown: Flown) -> None:
    assert flown.codes == {"autopilot": 0, "relay": 0, "plant": 0}
    assert flown.stderr["plant"] == ""
    assert flown.stderr["relay"].startswith("receive buffers: ")
    assert [flown.stderr[name].count("\n") for name in ("relay", "autopilot")] == [1, 1]


def test_samples_keep_coming_during_every_flood(flown: Flown) -> None:
    assert len(flown.samples) == 5
    for flood, samples in flown.samples.items():
        assert samples >= 10, flood


def test_the_plant_flies_on_and_its_delay_is_known_at_every_sample(flown: Flown) -> None:
    truth = flown.bodies["plant/truth"]
    assert [body["k"] for body in truth] == list(range(len(truth)))
    first = next(body["k"] for body in truth if body["d"] is not None)
    assert first < 40
    for body in truth[first:]:
        assert body["d"] == body["k"] - body["j"] >= 1
        assert not body["timeout"]
    assert all(later["j"] >= sooner["j"] for sooner, later in itertools.pairwise(truth[first:]))
    assert abs(truth[-1]["x"][2] - np.radians(5.0)) < np.radians(0.1)


def test_the_failsafe_and_the_law_see_nothing_of_it(flown: Flown) -> None:
    events = flown.bodies["events"]
    assert [(e["data"]["from"], e["data"]["to"]) for e in events if e["kind"] == "failsafe"] == [
        ("STANDBY", "TRACKING")
    ]
    assert {e["kind"] for e in events} == {"gains", "counters", "failsafe", "ports", "alpha", "commander"}
    commands = flown.bodies["autopilot/command"]
    assert {body["mode"] for body in commands} == {"TRACKING"}
    truth = {body["k"]: body for body in flown.bodies["plant/truth"]}
    for body in commands:
        assert np.allclose(body["x"], truth[body["j"]]["x"], rtol=0.0, atol=1e-6)


def test_every_hostile_datagram_of_the_peer_is_counted_by_its_kind_and_none_of_the_strangers(flown: Flown) -> None:
    counters = [e["data"] for e in flown.bodies["events"] if e["kind"] == "counters"]
    assert counters[0]["rejects"] == {}
    assert counters[-1]["rejects"] == {kind.value: n for kind, n in flown.rejected.items()}
    assert sum(flown.rejected.values()) >= DATAGRAMS


def test_the_recording_holds_every_datagram_that_the_autopilot_heard(flown: Flown) -> None:
    counts = topics_in(flown.folder / "autopilot.mcap")
    assert counts["mavlink/plant"] > DATAGRAMS
