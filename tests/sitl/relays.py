"""A relay in operation, and links of all kinds, for tests."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from hypothesis import strategies as st

from autopilot.link.node import Record
from sitl.link.gate import Gate
from sitl.link.impairment import Corruption, LinkSpec
from sitl.link.interruptions import Fading, Handover, Slots, Window
from sitl.link.relay import RelayNode
from sitl.link.spec import parse_spec

MS = 1_000_000
S = 1_000_000_000
PERFECT = LinkSpec()
ENTRY = {"up": "plant", "down": "autopilot"}
EXIT = {"up": "autopilot", "down": "plant"}


class Flight:
    """A relay driven as the virtual driver does: jump to each deadline, deliveries before ticks."""

    def __init__(
        self, up: str | LinkSpec, down: str | LinkSpec, seed: int = 1, gate: Gate | None = None, **more: Any
    ) -> None:
        up, down = (parse_spec(spec) if isinstance(spec, str) else spec for spec in (up, down))
        self.relay = RelayNode(up, down, seed, gate, **more)
        self.left: list[tuple[int, str, bytes]] = []
        self.records: list[Record] = []

    def take(self, now_ns: int) -> None:
        self.left += [(now_ns, port, payload) for port, payload in self.relay.outgoing()]
        self.records += self.relay.records()

    def until(self, end_ns: int) -> None:
        while (due_ns := self.relay.next_deadline_ns()) is not None and due_ns < end_ns:
            self.relay.tick(due_ns)
            self.take(due_ns)

    def send(self, port: str, payload: bytes, now_ns: int) -> None:
        self.until(now_ns)
        self.relay.receive(port, payload, now_ns)
        self.take(now_ns)

    def finish(self) -> None:
        self.until(1 << 62)


def fly(up: Any, down: Any, entries: list[tuple[int, str]], seed: int = 1, **more: Any) -> Flight:
    """Send (now_ns, port) in order, each payload its number, and let everything out."""
    flight = Flight(up, down, seed, **more)
    for number, (now_ns, port) in enumerate(entries):
        flight.send(port, number.to_bytes(4, "big"), now_ns)
    flight.finish()
    return flight


def both_ways(count: int, gap_ns: int = 25 * MS) -> list[tuple[int, str]]:
    return [(n * gap_ns, port) for n in range(count) for port in ("plant", "autopilot")]


probabilities = st.sampled_from([0.0, 0.1, 0.5, 1.0])
short_times = st.integers(0, 60).map(lambda ms: ms * MS)
windows = st.lists(
    st.builds(lambda start_ns, length_ns: Window(start_ns, length_ns, 0), short_times, short_times), max_size=2
).map(tuple)
link_specs = st.builds(
    lambda spec, jitter: replace(spec, jitter=parse_spec(jitter).jitter),
    st.builds(
        LinkSpec,
        delay_ns=short_times,
        loss=probabilities,
        dup=probabilities,
        reorder=probabilities,
        keep_order=st.booleans(),
        rate_bps=st.none() | st.sampled_from([9600, 57_600]),
        limit=st.sampled_from([1, 3, 10_000]),
        corruption=st.none() | st.builds(Corruption, probabilities, st.integers(1, 9)),
        slots=st.none() | st.builds(Slots, st.just(20 * MS), st.integers(0, 2)),
        blackouts=windows,
        holds=windows,
        handover=st.none() | st.just(Handover(50 * MS, 30 * MS)),
        fading=st.none() | st.just(Fading(40 * MS, 20 * MS, 30 * MS, 0.5)),
    ),
    st.sampled_from(["delay=0s", "jitter=uniform:28ms", "jitter=normal:9ms", "jitter=gamma:20ms"]),
)
arrivals = st.lists(st.tuples(short_times, st.sampled_from(["plant", "autopilot"])), max_size=40).map(
    lambda gaps: [
        (int(at_ns), port) for at_ns, (_, port) in zip(np.cumsum([gap for gap, _ in gaps]), gaps, strict=True)
    ]
)


def of(flight: Flight, way: str) -> list[Record]:
    return [record for record in flight.records if record.topic == f"link/{way}"]


def events(flight: Flight, kind: str) -> list[Record]:
    return [record for record in flight.records if record.topic == "events" and record.body["kind"] == kind]


def conserved(relay: RelayNode) -> bool:
    """Whether every copy of every direction, and of every rule, is accounted for."""
    directions = [direction for _, direction in relay._directions()]
    lanes = [(d.counters, d.queued) for d in directions]
    lanes += [(lane.counters, lane.queued) for d in directions for lane in d.rules]
    return all(
        c.sent + c.duplicated == c.delivered + c.lost + c.refused + c.gated + queued and queued >= 0
        for c, queued in lanes
    )
