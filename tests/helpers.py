"""What several test modules share: a plain MAVLink parser, broken frames, a link with a delay, one flight."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from pymavlink.dialects.v20 import all as dialect  # ardupilotmega has no CURRENT_MODE

from autopilot.app import AutopilotNode
from autopilot.config import AutopilotConfig
from autopilot.link.clock import Clock
from autopilot.link.node import Record
from autopilot.link.virtual import Participant, VirtualNetwork
from autopilot.link.wire import autopilot_heartbeat
from gains.store import load_gains
from sitl.plant import PlantConfig, PlantNode

MS = 1_000_000
S = 1_000_000_000
TS = 25 * MS
HIRM = load_gains("hirm-paper")
PLANT_CLOCK = Clock(137 * S, 40_000)
AUTOPILOT_CLOCK = Clock(1042 * S, -60_000)
LINE_CLOCK = Clock(11 * S, -20_000)
HEARTBEAT = autopilot_heartbeat(armed=True, custom_mode=10, flags=28, degraded=False)
"""Of an autopilot in AUTO."""


def parse(datagram: bytes) -> list:
    """Return the messages of one datagram as pymavlink's own stream parser reads them."""
    return dialect.MAVLink(None).parse_buffer(bytearray(datagram)) or []


def broken(frame: bytes, rng: np.random.Generator) -> bytes:
    """Return a frame that no receiver may accept: one or two bits flipped after the marker, cut, or noise.

    CRC-16 finds every one and two flipped bits at this length. Flips in the length (byte 1) and in the
    message id (bytes 7 to 9), which change what the checksum runs over, are left to the fixed seed.
    """
    match rng.integers(4):
        case 0 | 1:
            bits = np.frombuffer(frame, np.uint8).copy()
            for position in rng.choice(np.arange(8, 8 * len(frame)), size=rng.integers(1, 3), replace=False):
                bits[position // 8] ^= 1 << (position % 8)
            return bits.tobytes()
        case 2:
            return frame[: rng.integers(0, len(frame))]
        case _:
            return rng.bytes(rng.integers(0, 300))


@dataclass
class Line:
    """A Node with the ports ``plant`` and ``autopilot``: a link of any latency, without sitl's relay.

    ``up`` and ``down`` give the latency of a datagram that enters now, in ns; None loses it.
    """

    up: Callable[[int], int | None]
    down: Callable[[int], int | None]
    _queue: list[tuple[int, int, str, bytes]] = field(default_factory=list)
    _out: list[tuple[str, bytes]] = field(default_factory=list)
    _count: int = 0

    def receive(self, port: str, datagram: bytes, now_ns: int) -> None:
        latency, far = (self.up, "autopilot") if port == "plant" else (self.down, "plant")
        if (latency_ns := latency(now_ns)) is not None:
            heapq.heappush(self._queue, (now_ns + latency_ns, self._count, far, datagram))
            self._count += 1

    def tick(self, now_ns: int) -> None:
        while self._queue and self._queue[0][0] <= now_ns:
            self._out.append(heapq.heappop(self._queue)[2:])

    def next_deadline_ns(self) -> int | None:
        return self._queue[0][0] if self._queue else None

    def outgoing(self) -> list[tuple[str, bytes]]:
        out, self._out = self._out, []
        return out

    def records(self) -> list[Record]:
        return []


def constant(latency_ns: int) -> Callable[[int], int | None]:
    return lambda _now_ns: latency_ns


TEN_MS = constant(10 * MS)


class Flight:
    """Autopilot, line and plant in virtual time; everything they recorded and sent, by true time.

    ``up`` and ``down`` are given the time since the line's boot, which is true time but for 20 ppm.
    """

    def __init__(
        self,
        config: AutopilotConfig | None = None,
        plant: PlantConfig | None = None,
        up: Callable[[int], int | None] = TEN_MS,
        down: Callable[[int], int | None] = TEN_MS,
        *,
        plant_clock: Clock = PLANT_CLOCK,
        autopilot_clock: Clock = AUTOPILOT_CLOCK,
    ) -> None:
        self.autopilot = AutopilotNode(config or AutopilotConfig(HIRM))
        self.plant_config = plant or PlantConfig(HIRM.model)
        self.plant = PlantNode(self.plant_config)
        self._records: list[tuple[int, Record]] = []
        self.datagrams: list[tuple[int, str, str, str, bytes]] = []
        offset = LINE_CLOCK.offset_ns
        line = Line(lambda now: up(now - offset), lambda now: down(now - offset))
        wires = {
            ("autopilot", "plant"): ("line", "autopilot"),
            ("line", "autopilot"): ("autopilot", "plant"),
            ("plant", "autopilot"): ("line", "plant"),
            ("line", "plant"): ("plant", "autopilot"),
        }
        self.network = VirtualNetwork(
            [
                Participant("plant", self.plant, plant_clock),
                Participant("line", line, LINE_CLOCK),
                Participant("autopilot", self.autopilot, autopilot_clock),
            ],
            wires,
            lambda record, t_ns: self._records.append((t_ns, record)),
            lambda node, port, way, data, t_ns: self.datagrams.append((t_ns, node, port, way, data)),
            ("autopilot", "plant"),
        )

    def fly(self, until_ns: int) -> Flight:
        self.network.run(lambda: False, until_ns)
        return self

    def restart_plant(self, clock: Clock) -> None:
        self.plant = PlantNode(self.plant_config)
        self.network.replace("plant", self.plant, clock)

    def records(self, topic: str, since_ns: int = 0) -> list[Record]:
        return [r for t_ns, r in self._records if r.topic == topic and t_ns >= since_ns]

    def bodies(self, topic: str, since_ns: int = 0) -> list:
        return [r.body for r in self.records(topic, since_ns)]

    def events(self, kind: str, since_ns: int = 0) -> list:
        return [body for body in self.bodies("events", since_ns) if body["kind"] == kind]

    def transitions(self, since_ns: int = 0) -> list[tuple[str, str]]:
        return [(str(e["data"]["from"]), str(e["data"]["to"])) for e in self.events("failsafe", since_ns)]

    def when(self, kind: str, text: str = "") -> list[int]:
        """Return the true times of the events of a kind whose text contains ``text``."""
        return [
            t for t, r in self._records if r.topic == "events" and r.body["kind"] == kind and text in r.body["text"]
        ]

    def sent(self, node: str, port: str) -> Iterator[tuple[int, object]]:
        """Yield true time and message of everything a node has sent at a port, as pymavlink reads it."""
        for t_ns, name, where, way, datagram in self.datagrams:
            if (name, where, way) == (node, port, "sent"):
                for message in parse(datagram):
                    yield t_ns, message
