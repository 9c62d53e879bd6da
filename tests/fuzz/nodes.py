"""What scripts of datagrams (:mod:`tests.fuzz.script`) do to the nodes: they live on, bounded, and all is recorded."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

from autopilot.app import AutopilotNode
from autopilot.config import AutopilotConfig
from autopilot.link.clock import NS_PER_MS, NS_PER_S, Clock
from autopilot.link.codecs import CODECS
from autopilot.link.node import Node
from autopilot.link.record import decode_line, encode_line
from autopilot.link.wire import (
    AUTOPILOT,
    PLANT,
    HilActuatorControls,
    Message,
    ServoOutputRaw,
    Source,
    Timesync,
    Wire,
)
from gains.witnessfile import Witness
from sitl.aircraft.disturbance import HarmonicGust, SquareDelta
from sitl.link.gate import Gate
from sitl.link.impairment import MAX_QUEUED
from sitl.link.relay import RelayNode
from sitl.link.spec import parse_spec
from sitl.plant import PlantConfig, PlantNode
from tests.fuzz.refusing import refusing
from tests.fuzz.script import Advance, Answer, Framed, frame, steps
from tests.fuzz.wires import STATION
from tests.helpers import HEARTBEAT, HIRM, Flight

START_NS = 1000 * NS_PER_S
AUTOPILOT_CLOCK = Clock(START_NS, 0)
"""Its requests in the prelude are the same again, so the recorded answers match them."""
PRELUDE_NS = 400 * NS_PER_MS
MAX_BURST = 400
"""Datagrams that one step may make a node send: a bounded answer, times the samples caught up and the stations."""
MAX_AT_ONCE = 10
"""Ticks at one instant."""
GROUND_PORTS = ("gcs0", "gcs1")

LINKS = (
    ("delay=5ms,jitter=uniform:28ms,loss=0.1,dup=0.1,reorder=0.2", "delay=0ns"),
    ("rate=57600bps,limit=5,corrupt=0.5:9", "slot=20ms:2,order=keep,dup=0.5"),
    ("blackout=10ms:5ms:30ms,jitter=gamma:4ms,corr=0.5", "hold=0s:50ms:200ms,fade=50ms:20ms:10ms:0.5"),
    ("handover=100ms:30ms,loss=ge:0.1:0.3", "corrupt=1:1000,rate=1bps"),
)
WITNESS = Witness("", "", 0.025, 1, 4, "any", 1.01, (1, 3, 2, 4, 1))


class Conversation:
    """One node, its clock, and what it has sent.

    Parameters
    ----------
    node : Node
    check : callable
        Is given each datagram that the node sends.
    now_ns : int
        The node's own time.
    """

    def __init__(self, node: Node, check: Callable[[str, bytes], None], now_ns: int = START_NS) -> None:
        self.node = node
        self.now_ns = now_ns
        self._check = check
        self.drain()

    def receive(self, port: str, payload: bytes) -> None:
        self.node.receive(port, payload, self.now_ns)
        self.drain()

    def advance(self, by_ns: int) -> None:
        """Let time pass: every deadline on the way is met, in order."""
        end_ns, at_once = self.now_ns + by_ns, 0
        while (due_ns := self.node.next_deadline_ns()) is not None and due_ns <= end_ns:
            before_ns = self.now_ns
            self.now_ns = max(self.now_ns, due_ns)
            self.node.tick(self.now_ns)
            self.drain()
            at_once = 0 if self.now_ns > before_ns else at_once + 1
            assert at_once <= MAX_AT_ONCE, "ticks that change nothing: the node would spin"
        self.now_ns = end_ns

    def drain(self) -> None:
        """Take what the node sends and records, as a driver does; a record that is none raises here."""
        sent = self.node.outgoing()
        assert len(sent) <= MAX_BURST, f"{len(sent)} datagrams at once"
        for port, payload in sent:
            self._check(port, payload)
        for record in self.node.records():
            decode_line(encode_line(record, 0))


@refusing()
def autopilot(data: bytes) -> None:
    """The first byte says whether the autopilot flies already and how it is configured; the rest is a script."""
    head, script = data[:1] or b"\0", data[1:]
    options = head[0]
    config = AutopilotConfig(
        HIRM,
        actuator="float" if options & 2 else "pwm",
        alpha="vfr_hud" if options & 4 else "auto",
        wait_arm=bool(options & 8),
        ground_timeout_ns=NS_PER_S if options & 16 else 0,
        ground_stations=len(GROUND_PORTS),
    )
    node = AutopilotNode(config)
    station = _Peer(AUTOPILOT, ("plant", *GROUND_PORTS))
    talk = Conversation(node, station.hear)
    if options & 1:
        _fly_in(talk)
    ports = ("plant", "plant", *GROUND_PORTS)
    for step in steps(script):
        match step:
            case Advance(by_ns):
                talk.advance(by_ns)
            case Answer(value):
                answer = Timesync(value, station.newest_request)
                talk.receive("plant", Wire(PLANT, AUTOPILOT).encode(answer))
            case Framed(port, codec, payload):
                source = PLANT if ports[port] == "plant" else STATION
                talk.receive(ports[port], frame(codec, payload, source))
            case _:
                talk.receive(ports[step.port], step.payload)
        talk.advance(0)
    travel = node.pilot.travel
    assert math.isfinite(node.pilot.u)
    assert travel.low <= node.pilot.u <= travel.high
    assert all(math.isfinite(value) for value in node.settings.parameters.values.values())
    talk.advance(NS_PER_S)
    _expect_answer(talk, station, "plant", PLANT)


@refusing()
def plant(data: bytes) -> None:
    """The first byte says what kind of plant; the rest is a script."""
    options = data[0] if data else 0
    node = PlantNode(
        PlantConfig(
            HIRM.model,
            gust=HarmonicGust(HIRM.model.nw, 2) if options & 1 and HIRM.model.nw else None,
            delta=SquareDelta(0.15, 20) if options & 2 and HIRM.model.uncertainty is not None else None,
            latch="last" if options & 4 else "newest",
            servo_timeout=3 if options & 8 else None,
            aoa=not options & 16,
        )
    )
    peer = _Peer(PLANT, ("autopilot",))
    talk = Conversation(node, peer.hear)
    if options & 32:
        talk.receive("autopilot", Wire(AUTOPILOT, PLANT).encode(HEARTBEAT))
        talk.advance(200 * NS_PER_MS)
    for step in steps(data[1:]):
        match step:
            case Advance(by_ns):
                talk.advance(by_ns)
            case Answer(value):
                u = (value % 2001 - 1000) / 1000.0
                command: Message = HilActuatorControls(peer.newest_stamp_us, u)
                if value & 1:
                    command = ServoOutputRaw(peer.newest_stamp_us, value % 65536)
                talk.receive("autopilot", Wire(AUTOPILOT, PLANT).encode(command))
            case Framed(_, codec, payload):
                talk.receive("autopilot", frame(codec, payload, AUTOPILOT))
            case _:
                talk.receive("autopilot", step.payload)
        talk.advance(0)
    _expect_answer(talk, peer, "autopilot", AUTOPILOT)


@refusing()
def relay(data: bytes) -> None:
    """The first byte chooses the link; the rest is a script. Packets are conserved at every instant."""
    options = data[0] if data else 0
    up, down = map(parse_spec, LINKS[options % len(LINKS)])
    node = RelayNode(up, down, seed=options, gate=Gate(WITNESS) if options & 16 else None)
    entered = {"up": 0, "down": 0}
    talk = Conversation(node, lambda port, payload: None)
    for step in steps(data[1:]):
        if isinstance(step, Advance):
            talk.advance(step.by_ns)
        else:
            port = "plant" if getattr(step, "port", 0) & 1 else "autopilot"
            source = PLANT if port == "plant" else AUTOPILOT
            entered["up" if port == "plant" else "down"] += 1
            match step:
                case Answer(value):
                    talk.receive(port, Wire(source, None).encode(ServoOutputRaw(value, value % 65536)))
                case Framed(_, codec, payload):
                    talk.receive(port, frame(codec, payload, source))
                case _:
                    talk.receive(port, step.payload)
        _check_conserved(node, entered)
    talk.advance(20 * NS_PER_S)
    _check_conserved(node, entered)


def _check_conserved(node: RelayNode, entered: dict[str, int]) -> None:
    for way, counters in node.counters.items():
        out = counters.delivered + counters.lost + counters.refused + counters.gated + node.queued[way]
        assert counters.sent == entered[way]
        assert counters.sent + counters.duplicated == out, (way, counters, node.queued)
        assert 0 <= node.queued[way] <= MAX_QUEUED


class _Peer:
    """Checks that a node's datagrams are frames of it, and remembers what an honest peer would answer."""

    def __init__(self, source: Source, ports: tuple[str, ...]) -> None:
        self.newest_request = 0
        self.newest_stamp_us = 0
        self.answers: list[int] = []
        self._ports = ports
        self._wire = Wire((0, 0), source, frozenset(CODECS))

    def hear(self, port: str, payload: bytes) -> None:
        assert port in self._ports
        messages = self._wire.decode(payload)
        assert not self._wire.rejects, f"the node sent {self._wire.rejects}: {payload.hex()}"
        for message in messages:
            match message:
                case Timesync(tc1=0):
                    self.newest_request = message.ts1
                case Timesync():
                    self.answers.append(message.ts1)
                case HilActuatorControls():
                    assert -1.0 <= message.elevator <= 1.0
                case ServoOutputRaw():
                    assert 1000 <= message.servo2_raw <= 2000 or message.servo2_raw == 0
                case _:
                    stamp = getattr(message, "time_usec", None)
                    self.newest_stamp_us = self.newest_stamp_us if stamp is None else stamp


def _expect_answer(talk: Conversation, peer: _Peer, port: str, source: Source) -> None:
    """Check that the node is alive: it answers a TIMESYNC request."""
    talk.receive(port, Wire(source, None).encode(Timesync(0, 4711)))
    talk.advance(0)
    assert 4711 in peer.answers


@cache
def _prelude() -> tuple[tuple[int, bytes], ...]:
    """Return what an autopilot hears at the beginning of a flight: own time since the start, and the datagram."""
    flight = Flight(AutopilotConfig(HIRM), autopilot_clock=AUTOPILOT_CLOCK).fly(PRELUDE_NS)
    heard = [(t, data) for t, node, port, way, data in flight.datagrams if (node, way) == ("autopilot", "received")]
    return tuple(heard)


def _fly_in(talk: Conversation) -> None:
    """Let the autopilot hear the beginning of a flight: it flies when this is over."""
    start_ns = talk.now_ns
    for at_ns, payload in _prelude():
        talk.advance(max(0, start_ns + at_ns - talk.now_ns))
        talk.receive("plant", payload)
