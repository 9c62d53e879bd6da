"""The relay: conservation, order, bounds, independence of the directions."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autopilot.link.node import Node
from autopilot.link.topics import SCHEMAS
from autopilot.link.wire import (
    AUTOPILOT,
    PLANT,
    Attitude,
    NamedValueInt,
    ServoOutputRaw,
    Timesync,
    Wire,
)
from gains.witnessfile import Witness
from sitl.link.gate import Gate
from sitl.link.impairment import MAX_QUEUED, Corruption, LinkSpec
from sitl.link.interruptions import Fading, Handover, Slots, Window
from sitl.link.relay import Counters, RelayNode
from sitl.link.spec import parse_spec
from tests.helpers import HEARTBEAT

MS = 1_000_000
S = 1_000_000_000
PERFECT = LinkSpec()
WITNESS = Witness("", "", 0.025, 1, 2, "fifo", 1.0, (2,))
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
        self.records = []

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


def fly(up, down, entries, seed=1) -> Flight:
    """Send (now_ns, port) in order, each payload its number, and let everything out."""
    flight = Flight(up, down, seed)
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


# ----------------------------------------------------------------------------------------- conservation


def conserved(relay: RelayNode) -> bool:
    return all(
        c.sent + c.duplicated == c.delivered + c.lost + c.refused + c.gated + relay.queued[way]
        for way, c in relay.counters.items()
    )


@given(up=link_specs, down=link_specs, entries=arrivals, seed=st.integers(0, 2**32), limit=st.integers(1, 10))
def test_every_copy_is_delivered_lost_refused_or_queued_at_every_instant(up, down, entries, seed, limit):
    up, down = (replace(spec, limit=limit) for spec in (up, down))
    flight = Flight(up, down, seed)
    for now_ns, port in entries:
        flight.send(port, b"packet", now_ns)
        assert conserved(flight.relay)
        assert max(flight.relay.queued.values()) <= limit
    flight.finish()
    assert conserved(flight.relay)
    assert flight.relay.queued == {"up": 0, "down": 0}


@given(up=link_specs, down=link_specs, entries=arrivals, seed=st.integers(0, 2**32))
def test_counters_say_what_the_records_and_the_ports_say(up, down, entries, seed):
    up, down = (replace(spec, corruption=None) for spec in (up, down))  # each payload is its packet's number
    flight = fly(up, down, entries, seed)
    for way, counters in flight.relay.counters.items():
        bodies = [record.body for record in flight.records if record.topic == f"link/{way}"]
        fates = [body["fate"] for body in bodies]
        left = [payload for _, port, payload in flight.left if port == EXIT[way]]
        expected = Counters(
            sent=sum(port == ENTRY[way] for _, port in entries),
            delivered=len(left),
            lost=fates.count("lost") + fates.count("blackout"),
            refused=fates.count("refused"),
            duplicated=sum(body["copy"] for body in bodies),
            reordered=sum(payload < max(left[:n]) for n, payload in enumerate(left) if n),
            bytes=sum(map(len, left)),
        )
        assert counters == expected
        assert fates.count("delivered") == len(left)


@given(up=link_specs, down=link_specs, entries=arrivals)
def test_records_come_in_time_order_and_fit_their_schema(up, down, entries):
    flight = fly(up, down, entries)
    assert [r.t_ns for r in flight.records] == sorted(r.t_ns for r in flight.records)
    for record in of(flight, "up") + of(flight, "down"):
        body = record.body
        assert body.keys() - {"bits"} == set(SCHEMAS[record.topic]["required"])
        assert body["sent_ns"] <= record.t_ns
        assert body["delivered_ns"] == (record.t_ns if body["fate"] == "delivered" else None)
        if body["fate"] in ("lost", "refused"):
            assert body["requested_ns"] is None
        elif body["requested_ns"] is not None:
            assert body["sent_ns"] + body["requested_ns"] == record.t_ns  # nobody is late here


@given(
    up=link_specs,
    down=link_specs,
    delays=st.lists(st.integers(1, 6), min_size=1, max_size=8).map(tuple),
    gaps=st.lists(st.tuples(st.booleans(), st.integers(0, 4)), max_size=60),
)
def test_with_a_gate_too_every_copy_is_accounted_for(up, down, delays, gaps):
    flight = Flight(up, down, gate=Gate(Witness("", "", 0.025, 1, 6, "any", 1.0, delays)))
    plant, autopilot = Wire(PLANT, AUTOPILOT), Wire(AUTOPILOT, PLANT)
    k = now_ns = 0
    for passes, number in gaps:
        now_ns += number * 5 * MS
        if passes:
            k += 1
            flight.send("plant", plant.encode(NamedValueInt(25 * k, "SAMPLE_K", k)), now_ns)
            flight.send("plant", plant.encode(Attitude(25 * k, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)), now_ns)
        else:
            flight.send("autopilot", autopilot.encode(ServoOutputRaw(25_000 * (k - number) % 2**32, 1500)), now_ns)
            flight.send("autopilot", autopilot.encode(Timesync(0, 5)), now_ns)
        assert conserved(flight.relay)
    flight.finish()
    assert conserved(flight.relay)
    counters = flight.relay.counters["down"]
    fates = [record.body["fate"] for record in of(flight, "down")]
    assert (fates.count("delivered"), fates.count("gated")) == (counters.delivered, counters.gated)
    assert len([port for _, port, _ in flight.left if port == "plant"]) == counters.delivered
    assert all(record.body.keys() - {"bits"} == set(SCHEMAS["link/down"]["required"]) for record in of(flight, "down"))
    assert flight.relay.counters["up"].gated == 0


def test_the_gate_leaves_other_packets_and_their_delay_alone():
    plain, gated = (Flight("delay=3ms", "delay=7ms", gate=gate) for gate in (None, Gate(WITNESS)))
    wire = Wire(AUTOPILOT, PLANT)
    frames = [wire.encode(message) for message in (Timesync(0, 5), HEARTBEAT)]
    for flight in (plain, gated):
        for n, payload in enumerate([*frames, b"noise", b""]):
            flight.send("autopilot", payload, n * MS)
            flight.send("plant", payload, n * MS)
        flight.finish()
    assert gated.left == plain.left
    assert gated.records == plain.records


def test_a_command_leaves_when_the_gate_says_and_its_record_says_so():
    flight = Flight(PERFECT, "delay=5ms", gate=Gate(WITNESS))
    plant, autopilot = Wire(PLANT, AUTOPILOT), Wire(AUTOPILOT, PLANT)
    first, second = (plant.encode(Attitude(25 * k, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)) for k in (0, 1))
    command = autopilot.encode(ServoOutputRaw(0, 1500))
    flight.send("plant", plant.encode(NamedValueInt(0, "SAMPLE_K", 0)) + first, 0)
    flight.send("autopilot", command, 1 * MS)
    flight.until(20 * MS)
    assert flight.relay.queued == {"up": 0, "down": 1}
    assert of(flight, "down") == []
    flight.send("plant", second, 25 * MS)
    assert flight.left[-2:] == [(25 * MS, "plant", command), (25 * MS, "autopilot", second)]
    (record,) = of(flight, "down")
    assert (record.body["sent_ns"], record.body["delivered_ns"]) == (1 * MS, 25 * MS)
    assert flight.relay.queued == {"up": 0, "down": 0}


def test_counters_and_what_the_gate_missed_are_recorded_once_a_second_while_packets_pass():
    flight = Flight(PERFECT, PERFECT, gate=Gate(WITNESS))
    wire = Wire(PLANT, AUTOPILOT)
    for k in range(200):
        number = wire.encode(NamedValueInt(25 * k, "SAMPLE_K", k))
        flight.send("plant", number + wire.encode(Attitude(25 * k, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)), 25 * k * MS)
    flight.relay.close(6 * S)
    flight.relay.close(8 * S)  # nothing has changed
    flight.take(8 * S)
    events = [record for record in flight.records if record.topic == "events"]
    assert [record.t_ns for record in events] == [1 * S, 2 * S, 3 * S, 4 * S, 6 * S]
    links = [record.body["data"]["links"]["link"] for record in events]
    assert [link["gate"] for link in links] == [{"absent": n} for n in (39, 79, 119, 159, 198)]
    assert [link["up"]["sent"] for link in links] == [41, 81, 121, 161, 200]
    assert links[-1]["up"] == asdict(flight.relay.counters["up"]) | {
        "queued": 0,
        "error_ns": {"p50": 0, "p99": 0, "max": 0},
    }
    assert links[-1]["down"]["error_ns"] is None
    assert all(record.body.keys() == SCHEMAS["events"]["properties"].keys() for record in events)


# ---------------------------------------------------------------------------------------- the direction


def test_up_is_plant_to_autopilot_and_down_the_other_way():
    flight = Flight("delay=1ms", "delay=2ms")
    flight.send("plant", b"state", 0)
    flight.send("autopilot", b"command", 0)
    flight.finish()
    assert flight.left == [(1 * MS, "autopilot", b"state"), (2 * MS, "plant", b"command")]
    assert [record.topic for record in flight.records] == ["link/up", "link/down"]


def test_the_relay_is_a_node_that_is_idle_until_a_packet_comes():
    node: Node = RelayNode(PERFECT, PERFECT, 1)
    node.tick(5)
    assert (node.next_deadline_ns(), node.outgoing(), node.records()) == (None, [], [])


def test_a_perfect_link_passes_packets_on_at_once():
    relay = RelayNode(PERFECT, PERFECT, 1)
    relay.receive("plant", b"a", 7)
    assert relay.outgoing() == [("autopilot", b"a")]
    assert relay.outgoing() == []
    assert relay.next_deadline_ns() is None
    (record,) = relay.records()
    assert record.t_ns == 7
    assert record.body == {
        "sent_ns": 7,
        "delivered_ns": 7,
        "number": 1,
        "size": 1,
        "fate": "delivered",
        "copy": 0,
        "requested_ns": 0,
    }


def test_a_packet_leaves_when_its_delay_has_elapsed_and_not_a_nanosecond_before():
    relay = RelayNode(parse_spec("delay=25ms"), PERFECT, 1)
    relay.receive("plant", b"a", 3)
    assert relay.next_deadline_ns() == 3 + 25 * MS
    relay.tick(2 + 25 * MS)
    assert relay.outgoing() == []
    relay.tick(3 + 25 * MS)
    assert relay.outgoing() == [("autopilot", b"a")]


def test_a_late_tick_records_when_the_packet_really_left():
    relay = RelayNode(parse_spec("delay=25ms"), PERFECT, 1)
    relay.receive("plant", b"a", 0)
    relay.tick(30 * MS)
    assert relay.records()[0].body["delivered_ns"] == 30 * MS


def test_packets_due_at_one_instant_leave_in_the_order_in_which_they_entered():
    relay = RelayNode(parse_spec("delay=5ms,order=keep"), PERFECT, 1)
    relay.receive("plant", b"a", 0)
    relay.receive("plant", b"b", 0)
    relay.receive("autopilot", b"c", 5 * MS)  # a delivery at the instant at which a and b are due
    assert relay.outgoing() == [("autopilot", b"a"), ("autopilot", b"b"), ("plant", b"c")]


def test_reordering_is_counted_at_the_exit():
    relay = RelayNode(parse_spec("delay=50ms,reorder=0.5"), PERFECT, 3)
    for number in range(40):
        relay.receive("plant", bytes([number]), 0)
    at_once = [payload for _, payload in relay.outgoing()]
    assert at_once == sorted(at_once)
    assert relay.counters["up"].reordered == 0
    relay.tick(50 * MS)
    late = [payload for _, payload in relay.outgoing()]
    assert len(late) + len(at_once) == 40
    assert relay.counters["up"].reordered == sum(payload < at_once[-1] for payload in late)


def test_a_second_copy_is_marked_and_does_not_count_as_reordered():
    flight = fly("dup=1", PERFECT, [(0, "plant"), (1, "plant")])
    assert [record.body["copy"] for record in flight.records] == [0, 1, 0, 1]
    assert flight.relay.counters["up"] == Counters(sent=2, delivered=4, duplicated=2, bytes=16)


# ------------------------------------------------------------------------------------------------ seeds


def test_same_seed_same_flight_and_another_seed_another():
    spec = "delay=5ms,jitter=uniform:28ms,loss=0.1,dup=0.1,reorder=0.1"
    one, same, other = (fly(spec, spec, both_ways(300), seed) for seed in (4, 4, 5))
    assert (one.left, one.records) == (same.left, same.records)
    assert one.left != other.left


def of(flight: Flight, way: str) -> list:
    return [record for record in flight.records if record.topic == f"link/{way}"]


@pytest.mark.parametrize("up", ["delay=0s", "loss=0.5,dup=0.5", "delay=1s,jitter=gamma:1s,rate=9600bps"])
def test_changing_one_direction_leaves_the_other_as_it_was(up):
    down = "delay=5ms,jitter=uniform:28ms,loss=0.1,dup=0.1"
    before = fly("delay=5ms,jitter=normal:1ms", down, both_ways(300))
    after = fly(up, down, both_ways(300))
    assert of(after, "down") == of(before, "down")
    assert of(after, "up") != of(before, "up")


def test_the_two_directions_are_independent():
    spec = "delay=5ms,jitter=uniform:28ms,loss=0.3"
    count = 5000
    flight = fly(spec, spec, both_ways(count, 100 * MS))
    up, down = ([record.body for record in of(flight, way)] for way in ("up", "down"))
    lost = np.array([[body["delivered_ns"] is None for body in way] for way in (up, down)], dtype=float)
    assert abs(np.corrcoef(lost)[0, 1]) < 4 / np.sqrt(count)
    flights = np.array(
        [
            [a["delivered_ns"] - a["sent_ns"], b["delivered_ns"] - b["sent_ns"]]
            for a, b in zip(up, down, strict=True)
            if a["delivered_ns"] is not None and b["delivered_ns"] is not None
        ],
        dtype=float,
    )
    assert len(flights) > 2000
    assert abs(np.corrcoef(flights.T)[0, 1]) < 4 / np.sqrt(len(flights))


@pytest.mark.parametrize("seed", range(5))
def test_the_nodes_own_clock_does_not_matter(seed):
    spec = "delay=5ms,jitter=gamma:28ms,loss=0.1,rate=57600bps,blackout=1s:1s"
    offset_ns = 123_456_789_012_345
    entries = both_ways(200)
    plain = fly(spec, spec, entries, seed)
    shifted = fly(spec, spec, [(at_ns + offset_ns, port) for at_ns, port in entries], seed)
    assert [(at_ns - offset_ns, *rest) for at_ns, *rest in shifted.left] == plain.left


# ------------------------------------------------------------------------------------------- boundaries


def test_blackouts_count_from_the_first_packet_in_either_direction():
    flight = Flight(PERFECT, "blackout=1s:1s")
    flight.send("plant", b"first", 10 * S)
    for at_ns in (11 * S - 1, 11 * S, 12 * S - 1, 12 * S):
        flight.send("autopilot", b"x", at_ns)
    fates = [record.body["fate"] for record in of(flight, "down")]
    assert fates == ["delivered", "blackout", "blackout", "delivered"]
    assert flight.relay.counters["down"].lost == 2


def test_a_packet_in_flight_into_a_blackout_is_recorded_when_it_would_have_left():
    flight = Flight("delay=100ms,blackout=50ms:1s", PERFECT)
    flight.send("plant", b"x", 0)
    assert flight.relay.queued["up"] == 1
    flight.finish()
    assert flight.left == []
    (record,) = flight.records
    assert (record.t_ns, record.body["fate"], record.body["delivered_ns"]) == (100 * MS, "blackout", None)


def test_a_full_queue_refuses_the_newest_and_leaves_the_other_direction_alone():
    relay = RelayNode(parse_spec("delay=1s"), PERFECT, 1)
    for number in range(MAX_QUEUED + 3):
        relay.receive("plant", number.to_bytes(4, "big"), number)
    relay.receive("autopilot", b"down", MAX_QUEUED)
    assert relay.queued == {"up": MAX_QUEUED, "down": 0}
    assert relay.counters["up"].refused == 3
    assert relay.outgoing() == [("plant", b"down")]
    assert [record.body["fate"] for record in relay.records()] == ["refused"] * 3 + ["delivered"]
    relay.tick(2 * S)
    assert [int.from_bytes(p, "big") for _, p in relay.outgoing()] == list(range(MAX_QUEUED))


def test_packets_due_at_the_instant_of_an_arrival_make_room_for_it():
    relay = RelayNode(parse_spec("delay=5ms,limit=1"), PERFECT, 1)
    relay.receive("plant", b"a", 0)
    relay.receive("plant", b"b", 5 * MS)  # a delivery comes before the tick of its instant
    assert relay.counters["up"].refused == 0
    assert relay.outgoing() == [("autopilot", b"a")]


def test_an_overloaded_serialiser_recovers_as_soon_as_its_queue_is_through():
    relay = RelayNode(parse_spec("rate=80kbps,limit=10"), PERFECT, 1)
    for _ in range(1000):
        relay.receive("plant", bytes(50), 0)
    assert asdict(relay.counters["up"])["refused"] == 990
    relay.tick(50 * MS)
    assert relay.queued["up"] == 0
    relay.receive("plant", bytes(50), 60 * MS)
    assert relay.next_deadline_ns() == 65 * MS


@given(up=link_specs, payload=st.binary(max_size=2000))
def test_any_payload_passes_unchanged(up, payload):
    flight = Flight(replace(up, loss=0.0, blackouts=(), fading=None, corruption=None), PERFECT)
    flight.send("plant", payload, 0)
    flight.finish()
    assert {left for _, _, left in flight.left} == {payload}


def test_counters_taken_do_not_change_later():
    relay = RelayNode(PERFECT, PERFECT, 1)
    before = relay.counters
    relay.receive("plant", b"x", 0)
    assert before["up"] == Counters()
