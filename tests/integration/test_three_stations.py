"""Three ground stations that never stop asking, for a minute and for two hours: exact rates and answers, flat memory.

The stations are nodes of the virtual network, joined to the autopilot's ports by wires that take no time, and live on
the autopilot's clock, so that a message's place on the grid of its interval is when it comes. The link to the plant has
jitter, but no gap between two samples as long as the shortest interval asked for.
"""

from __future__ import annotations

import gc
import math
import resource
import sys
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as dialect

from autopilot.app import AutopilotNode
from autopilot.ground.parameters import PARAMETERS
from autopilot.link.clock import NS_PER_S, NS_PER_US
from autopilot.link.node import Node, Record
from autopilot.link.virtual import Participant, VirtualNetwork
from gains.model import Reference
from sitl.flight import WIRES
from sitl.link.presets import parse_link
from sitl.plant import PlantNode
from sitl.scenario import Scenario, load_scenario

LINK = "delay=15ms,jitter=uniform:10ms"
"""Each way; two samples then come at most 35 ms apart, and delays are 2 or 3 samples."""
TURN_NS = NS_PER_S // 20
"""A station speaks so often."""
SETTLE_S = 5
"""What was asked for at first counts from then on."""
DEFAULTS_US = {
    "HEARTBEAT": 1_000_000,
    "SYS_STATUS": 1_000_000,
    "ATTITUDE": 50_000,
    "AOA_SSA": 100_000,
    "SERVO_OUTPUT_RAW": 100_000,
    "NAMED_VALUE_INT": 100_000,
    "VFR_HUD": 200_000,
    "ATTITUDE_TARGET": 200_000,
    "GLOBAL_POSITION_INT": 500_000,
    "CURRENT_MODE": 2_000_000,
}
SLOW_US = dict.fromkeys([name for name in DEFAULTS_US if name not in ("HEARTBEAT", "CURRENT_MODE")], 250_000)
Speech = Callable[[int, int], Iterable[dialect.MAVLink_message]]


def number_of(name: str) -> int:
    return int(getattr(dialect, f"MAVLINK_MSG_ID_{name}"))


@dataclass
class Stream:
    """What came of one message type: how much in the window, and how often its grid had a place left out or doubled."""

    interval_ns: int
    count: int = 0
    astray: int = 0
    slot: int | None = None

    def came(self, now_ns: int) -> None:
        slot = now_ns // self.interval_ns
        self.astray += self.slot is not None and slot != self.slot + 1
        self.count += 1
        self.slot = slot


@dataclass
class Station:
    """A ground station: every turn it says what its speech says of that turn, and it counts what it gets."""

    identity: tuple[int, int]
    speech: Speech
    intervals_us: dict[str, int]
    window_ns: tuple[int, int] = (0, 0)
    got: Counter[int] = field(default_factory=Counter)
    results: Counter[int] = field(default_factory=Counter)
    said: Counter[str] = field(default_factory=Counter)
    astray: int = 0

    def __post_init__(self) -> None:
        self._mav = dialect.MAVLink(None, *self.identity)
        self._turn = 0
        self._next_ns: int | None = None
        self._out: list[tuple[str, bytes]] = []
        self._parameter = 0
        us = {number_of(name): value for name, value in self.intervals_us.items()}
        self.streams = {number: Stream(value * NS_PER_US) for number, value in us.items()}

    def receive(self, port: str, datagram: bytes, now_ns: int) -> None:
        number = int.from_bytes(datagram[7:10], "little")
        self.got[number] += 1
        stream = self.streams.get(number)
        if stream is not None and self._counts(stream, datagram, now_ns):
            stream.came(now_ns)
        if number == dialect.MAVLINK_MSG_ID_COMMAND_ACK:
            [ack] = dialect.MAVLink(None).parse_buffer(bytearray(datagram))
            self.results[ack.result] += 1
            self.astray += (ack.target_system, ack.target_component) != self.identity
        elif number == dialect.MAVLINK_MSG_ID_PARAM_VALUE:
            [value] = dialect.MAVLink(None).parse_buffer(bytearray(datagram))
            self.astray += value.param_index != self._parameter
            self._parameter = (self._parameter + 1) % len(PARAMETERS)

    def _counts(self, stream: Stream, datagram: bytes, now_ns: int) -> bool:
        """Return whether a message counts: its place is in the window, and of values with names one is looked at."""
        if int.from_bytes(datagram[7:10], "little") == number_of("NAMED_VALUE_INT") and b"DELAY_K" not in datagram:
            return False
        first, last = (edge_ns // stream.interval_ns for edge_ns in self.window_ns)
        return first < now_ns // stream.interval_ns <= last

    def wrong(self) -> dict[str, tuple[int, int, int]]:
        """Return count, what it should be, and places astray of each stream that is not exact."""
        since_ns, until_ns = self.window_ns
        found = {}
        for number, stream in self.streams.items():
            expected = until_ns // stream.interval_ns - since_ns // stream.interval_ns
            if (stream.count, stream.astray) != (expected, 0):
                found[dialect.mavlink_map[number].msgname] = (stream.count, expected, stream.astray)
        return found

    def tick(self, now_ns: int) -> None:
        assert self._next_ns is not None
        while self._next_ns <= now_ns:
            for message in self.speech(self._turn, self._next_ns):
                self.said[message.get_type()] += 1
                self._out.append(("autopilot", message.pack(self._mav)))
            self._turn += 1
            self._next_ns += TURN_NS

    def next_deadline_ns(self) -> int | None:
        return self._next_ns

    def start(self, now_ns: int) -> None:
        self._next_ns = now_ns

    def outgoing(self) -> list[tuple[str, bytes]]:
        out, self._out = self._out, []
        return out

    def records(self) -> list[Record]:
        return []


# what they say


def long(command: int, *params: float) -> dialect.MAVLink_message:
    return dialect.MAVLink_command_long_message(1, 1, command, 0, *params, *[0.0] * (7 - len(params)))


def interval(name: str, interval_us: float) -> dialect.MAVLink_message:
    return long(511, number_of(name), interval_us)


HELLO = dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)


def pilots(turn: int, now_ns: int) -> Iterable[dialect.MAVLink_message]:
    """Speak as a station that flies GUIDED by setpoints, a slow sine of 2 degrees, at rates that fit no sample."""
    if turn == 0:
        yield long(176, dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, 15)
        yield interval("ATTITUDE", 142_857)
        yield interval("SYS_STATUS", 333_333)
    if turn % 20 == 0:
        yield HELLO
    half = math.radians(1.0) * math.sin(turn * 0.05)
    q = [math.cos(half), 0.0, math.sin(half), 0.0]
    yield dialect.MAVLink_set_attitude_target_message(now_ns // 10**6 % (1 << 32), 1, 1, 7, q, 0.0, 0.0, 0.0, 0.5)


def lists(turn: int, _now_ns: int) -> Iterable[dialect.MAVLink_message]:
    """Speak as a station that wants all at 4 Hz, lists the parameters every 10 s, and has a stick without a use."""
    if turn == 0:
        yield dialect.MAVLink_request_data_stream_message(1, 1, 0, 4, 1)
    if turn % 200 == 0:
        yield dialect.MAVLink_param_request_list_message(1, 1)
    if turn % 2 == 0:
        yield dialect.MAVLink_manual_control_message(1, -900, 0, 0, 0, 0)


def asks(turn: int, now_ns: int) -> Iterable[dialect.MAVLink_message]:
    """Speak as a station that asks, for what there is and for what there is not."""
    if turn == 0:
        yield interval("ATTITUDE", -1.0)
    match turn % 8:
        case 0:
            yield dialect.MAVLink_ping_message(now_ns // 1000, turn % (1 << 32), 0, 0)
        case 1:
            yield long(512, 148.0)
        case 2:
            yield long(31_000 + turn % 500)
        case 3:
            yield dialect.MAVLink_mission_request_list_message(1, 1, turn % 3)
        case 4:
            yield dialect.MAVLink_timesync_message(0, now_ns)
        case 5:
            yield long(176, dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, 7.0)
        case 6:
            yield dialect.MAVLink_command_int_message(1, 1, 0, 401, 0, 0, 0.0, 0.0, 0.0, 0.0, 0, 0, 0.0)
        case 7:
            yield long(510, 30.0)


# the flight


@dataclass
class Promises:
    """Checks each command's xr against Eq. (8) with the recorded r, sample by sample, and counts the modes."""

    reference: Reference
    modes: Counter[str] = field(default_factory=Counter)
    flight_modes: Counter[str] = field(default_factory=Counter)
    worst: float = 0.0
    checked: int = 0
    _xr: np.ndarray = field(default_factory=lambda: np.zeros(3))
    _k: int = 0
    _carried: deque[tuple[int, np.ndarray]] = field(default_factory=lambda: deque(maxlen=16))

    def write(self, record: Record, _true_ns: int) -> None:
        if record.topic != "autopilot/command":
            return
        body = record.body
        assert body["j"] == self._k, "a sample was lost"
        for k, xr in self._carried:
            if k == self._k:
                self.worst = max(self.worst, float(np.abs(xr - self._xr).max()))
                self.checked += 1
        self._carried.append((self._k + body["d"], np.array(body["xr"])))
        self._xr = self.reference.Ar @ self._xr + self.reference.Br[:, 0] * body["r"][0]
        self._k += 1
        self.modes[body["mode"]] += 1
        self.flight_modes[body["flight_mode"]] += 1


@dataclass
class Flight:
    """A scenario's nodes and three stations, in virtual time."""

    seconds: int

    def __post_init__(self) -> None:
        up, down = parse_link(None, LINK, LINK)
        self.scenario: Scenario = replace(load_scenario("nominal"), up=up, down=down, reference="")
        slow = {**DEFAULTS_US, **SLOW_US}
        quiet = {name: us for name, us in DEFAULTS_US.items() if name != "ATTITUDE"}
        self.stations = [
            Station((255, 190), pilots, {**DEFAULTS_US, "ATTITUDE": 142_857, "SYS_STATUS": 333_333}),
            Station((254, 190), lists, slow),
            Station((253, 191), asks, quiet),
        ]
        self.plant: PlantNode = self.scenario.plant_node()
        self.autopilot: AutopilotNode = self.scenario.autopilot_node(len(self.stations))
        assert self.scenario.plant.reference is not None
        self.promises = Promises(self.scenario.plant.reference)
        clocks, wires = dict(self.scenario.clocks), dict(WIRES)
        nodes: dict[str, Node] = {
            "plant": self.plant,
            "relay": self.scenario.relay_node(),
            "autopilot": self.autopilot,
        }
        for i, station in enumerate(self.stations):
            nodes[f"station{i}"], clocks[f"station{i}"] = station, clocks["autopilot"]
            wires |= {("autopilot", f"gcs{i}"): (f"station{i}", "autopilot")}
            wires |= {(f"station{i}", "autopilot"): ("autopilot", f"gcs{i}")}
            start_ns = -(-clocks["autopilot"].node_ns(3 * NS_PER_S) // NS_PER_S) * NS_PER_S
            station.start(start_ns + i * 7_000_000)
            station.window_ns = (start_ns + SETTLE_S * NS_PER_S, start_ns + self.seconds * NS_PER_S)
        participants = [Participant(name, node, clocks[name]) for name, node in nodes.items()]
        self.network = VirtualNetwork(participants, wires, self.promises.write)

    def fly(self, parts: int = 1, after: Callable[[], None] = lambda: None) -> Flight:
        """Fly to the end of the window and a little further, in equal parts."""
        end_ns = round((self.seconds + 6) * NS_PER_S)
        for part in range(1, parts + 1):
            self.network.run(lambda: False, end_ns * part // parts)
            after()
        return self

    def check(self) -> None:
        """Require exact rates, exact answers, and that all of it was flown by the law."""
        assert [station.wrong() for station in self.stations] == [{}, {}, {}]
        assert [station.astray for station in self.stations] == [0, 0, 0]
        assert self.promises.worst < 1e-9
        assert self.promises.checked > 39 * self.seconds
        assert set(self.promises.modes) == {"TRACKING"}
        assert self.promises.flight_modes["GUIDED"] > 39 * self.seconds
        assert (self.autopilot.vehicle.refused, self.autopilot.vehicle.elsewhere) == (0, 0)
        assert self.autopilot.commander.refused == 0
        self._check_answers()

    def _check_answers(self) -> None:
        pilot, lister, asker = self.stations
        for station in self.stations:
            commands = station.said["COMMAND_LONG"] + station.said["COMMAND_INT"]
            assert sum(station.results.values()) == commands
        assert lister.got[number_of("PARAM_VALUE")] == lister.said["PARAM_REQUEST_LIST"] * len(PARAMETERS)
        assert asker.got[number_of("PING")] == asker.said["PING"]
        assert asker.got[number_of("TIMESYNC")] == asker.said["TIMESYNC"]
        assert asker.got[number_of("MISSION_COUNT")] == asker.said["MISSION_REQUEST_LIST"]
        assert asker.got[number_of("AUTOPILOT_VERSION")] == pytest.approx(asker.said["PING"], abs=1)
        for other in (pilot, lister):
            assert not {number_of(name) for name in ("PING", "TIMESYNC", "MISSION_COUNT")} & set(other.got)


def test_a_minute_with_three_stations_has_exact_rates_and_answers_and_promises_that_hold() -> None:
    Flight(57).fly().check()


def memory(blocks: list[int], peaks_kib: list[int]) -> None:
    gc.collect()
    blocks.append(sys.getallocatedblocks())
    peaks_kib.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)


@pytest.mark.long
def test_two_hours_with_three_stations_leave_the_memory_flat_and_no_rate_drifts() -> None:
    blocks: list[int] = []
    peaks_kib: list[int] = []
    Flight(7200).fly(4, partial(memory, blocks, peaks_kib)).check()
    assert max(blocks[1:]) - blocks[0] < 5_000, blocks  # 216,000 samples later
    assert peaks_kib[-1] - peaks_kib[0] < 2_000, peaks_kib
