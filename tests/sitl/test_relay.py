"""The relay: conservation, order, bounds, independence of the directions."""

from __future__ import annotations

from dataclasses import asdict, replace
from itertools import product
from typing import Any

import jsonschema
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autopilot.link.codecs import message_ids
from autopilot.link.node import Node
from autopilot.link.topics import SCHEMAS, is_topic, schema_of
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
from sitl.link.changes import Change
from sitl.link.direction import LinkConfig
from sitl.link.gate import Gate
from sitl.link.impairment import MAX_QUEUED, Impairment
from sitl.link.link import MAX_AT_ONCE
from sitl.link.relay import Counters, RelayNode
from sitl.link.rules import WAYS, Rule, parse_rule
from sitl.link.spec import parse_spec
from sitl.link.status import link_counters, link_status
from tests.helpers import HEARTBEAT
from tests.sitl.relays import (
    ENTRY,
    EXIT,
    MS,
    PERFECT,
    Flight,
    S,
    arrivals,
    both_ways,
    conserved,
    events,
    fly,
    link_specs,
    of,
    short_times,
)

WITNESS = Witness("", "", 0.025, 1, 2, "fifo", 1.0, (2,))


# ----------------------------------------------------------------------------------------- conservation


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
        assert body.keys() - {"bits"} == {*SCHEMAS[record.topic]["required"], "requested_ns"}
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
    expected = {*SCHEMAS["link/down"]["required"], "requested_ns"}
    assert all(record.body.keys() - {"bits"} == expected for record in of(flight, "down"))
    assert all(
        record.body["requested_ns"] is not None for record in of(flight, "down") if record.body["fate"] == "gated"
    )
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
    told = events(flight, "counters")
    assert [record.t_ns for record in told] == [1 * S, 2 * S, 3 * S, 4 * S, 6 * S]
    links = [record.body["data"]["links"]["link"] for record in told]
    assert [link["gate"] for link in links] == [{"absent": n} for n in (39, 79, 119, 159, 198)]
    assert [link["up"]["sent"] for link in links] == [41, 81, 121, 161, 200]
    assert links[-1]["up"] == asdict(flight.relay.counters["up"]) | {
        "queued": 0,
        "error_ns": {"p50": 0, "p99": 0, "max": 0},
    }
    assert links[-1]["down"]["error_ns"] is None
    assert all(record.body.keys() == SCHEMAS["events"]["properties"].keys() for record in told)


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


# ------------------------------------------------------------------------------- rules, changes, stamps


frames = st.sampled_from(
    [b"packet", b""]
    + [
        Wire(PLANT, AUTOPILOT).encode(message)
        for message in (Attitude(0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), Timesync(0, 5), HEARTBEAT)
    ]
)
rules = st.lists(
    st.builds(
        lambda way, messages, spec: Rule(way, messages, message_ids(messages.split("+")), spec),
        st.sampled_from(WAYS),
        st.sampled_from(["ATTITUDE", "TIMESYNC+ATTITUDE", "0"]),
        link_specs,
    ),
    max_size=3,
)
changes = st.lists(st.builds(Change, short_times, st.sampled_from(WAYS), link_specs), max_size=3)


@given(
    specs=st.tuples(link_specs, link_specs),
    rules=rules,
    changes=changes,
    packets=st.lists(st.tuples(short_times, short_times, st.sampled_from(["plant", "autopilot"]), frames), max_size=30),
    stamped=st.booleans(),
)
def test_with_rules_changes_and_stamps_too_every_copy_is_accounted_for(specs, rules, changes, packets, stamped):
    """Packets that are read late, each port's in order, as from two sockets of a program that was busy."""
    flight = Flight(*specs, rules=rules, changes=changes, stamped=stamped)
    came_ns = {"plant": 0, "autopilot": 0}
    now_ns = 0
    for gap_ns, late_ns, port, payload in packets:
        now_ns = max(now_ns, came_ns[port]) + late_ns
        came_ns[port] = min(came_ns[port] + gap_ns, now_ns)
        flight.relay.receive(port, payload, came_ns[port] if stamped else now_ns)
        assert conserved(flight.relay)
        flight.relay.tick(now_ns)
        flight.take(now_ns)
        assert conserved(flight.relay)
    flight.finish()
    assert conserved(flight.relay)
    assert flight.relay.queued == {"up": 0, "down": 0}
    for way in WAYS:
        bodies = [record.body for record in of(flight, way)]
        numbers = {body["number"]: body["sent_ns"] for body in bodies}
        entered_ns = [numbers[n] for n in sorted(numbers)]
        assert entered_ns == sorted(entered_ns)
        assert all(body["delivered_ns"] is None or body["delivered_ns"] >= body["sent_ns"] for body in bodies)
        assert len(bodies) == sum(
            getattr(flight.relay.counters[way], name) for name in ("delivered", "lost", "refused", "gated")
        )
    assert flight.relay._links[0].clock_steps == 0


def test_a_packet_that_was_read_late_entered_when_it_came_and_leaves_when_that_is_told():
    relay = RelayNode(parse_spec("delay=5ms"), PERFECT, 1, stamped=True)
    relay.receive("plant", b"a", 10 * MS)
    assert relay.next_deadline_ns() == 15 * MS
    relay.tick(16 * MS)
    relay.receive("autopilot", b"b", 9 * MS)  # it came before the first one, and was read after it
    assert relay.outgoing() == [("autopilot", b"a")]
    relay.tick(17 * MS)
    assert relay.outgoing() == [("plant", b"b")]
    late, early = (record.body for record in relay.records())
    assert (late["sent_ns"], late["delivered_ns"], late["requested_ns"]) == (10 * MS, 16 * MS, 5 * MS)
    assert (early["sent_ns"], early["delivered_ns"], early["requested_ns"]) == (10 * MS, 17 * MS, 0)


@pytest.mark.parametrize("stamped", [False, True])
def test_a_clock_that_is_set_back_neither_stops_the_link_nor_holds_packets(stamped):
    flight = Flight("delay=5ms,order=keep,rate=57600bps", "delay=7ms", stamped=stamped)
    now_ns = 100 * S
    for n in range(40):
        now_ns += 25 * MS - (50 * S if n == 20 else 0)
        for port in ("plant", "autopilot"):
            flight.relay.receive(port, b"x", now_ns)
            flight.take(now_ns)
        for due_ns in (now_ns + 6 * MS, now_ns + 10 * MS):
            flight.relay.tick(due_ns)
            flight.take(due_ns)
    assert flight.relay.queued == {"up": 0, "down": 0}
    delays = [record.body["delivered_ns"] - record.body["sent_ns"] for way in WAYS for record in of(flight, way)]
    assert len(delays) == 80
    assert all(5 * MS <= delay_ns <= 10 * MS for delay_ns in delays)


def test_no_more_packets_are_recorded_in_a_second_than_asked_for_and_the_others_are_counted():
    flight = Flight(PERFECT, PERFECT, log_rate=10)
    for n in range(250):
        flight.send("plant", b"x", n * 10 * MS)
    assert [record.body["number"] for record in of(flight, "up")] == [
        *range(1, 11),
        *range(101, 111),
        *range(201, 211),
    ]
    assert flight.relay.counters["up"].unlogged == 220
    assert flight.relay.counters["up"].delivered == 250


def test_a_clock_that_is_set_back_neither_stops_the_log_nor_the_counters():
    flight = Flight(PERFECT, PERFECT, log_rate=10)
    for n in range(40):
        flight.relay.receive("plant", b"x", 100 * S + n * 100 * MS - (50 * S if n >= 20 else 0))
        flight.take(0)
    assert len(of(flight, "up")) == 40
    told = [event.t_ns // S for event in events(flight, "counters")]
    assert told == [101, 52, 53]
    assert events(flight, "counters")[0].body["data"]["links"]["link"].get("clock_steps") is None
    assert events(flight, "counters")[-1].body["data"]["links"]["link"]["clock_steps"] == 1


def test_the_counters_are_told_while_packets_only_leave():
    flight = Flight("delay=1500ms", PERFECT)
    flight.send("plant", b"a", 0)
    flight.send("plant", b"b", 900 * MS)
    flight.finish()
    told = [(event.t_ns, event.body["data"]["links"]["link"]["up"]) for event in events(flight, "counters")]
    assert [(t_ns, up["delivered"], up["queued"]) for t_ns, up in told] == [(1500 * MS, 1, 1)]


def test_each_rule_draws_from_the_stream_that_is_documented():
    rules = [parse_rule(f"{way}:{messages}:loss=0.5") for way in WAYS for messages in ("HEARTBEAT", "TIMESYNC")]
    flight = Flight(PERFECT, PERFECT, 9, rules=rules)
    wire = Wire(PLANT, AUTOPILOT)
    frames = {"HEARTBEAT": wire.encode(HEARTBEAT), "TIMESYNC": wire.encode(Timesync(0, 5))}
    for n in range(40):
        for way, payload in product(WAYS, frames.values()):
            flight.send(ENTRY[way], payload, n * MS)
    for (i, way), (k, name) in product(enumerate(WAYS), enumerate(frames)):
        rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(9, spawn_key=(3, i, k))))
        link = Impairment(parse_spec("loss=0.5"), rng)
        fates = [record.body["fate"] for record in of(flight, way) if record.body["rule"] == name]
        assert fates == [link.step(1, n * MS)[0].fate for n in range(40)]


def test_a_direction_counts_the_packets_of_its_rules_and_a_rule_its_own():
    wire = Wire(PLANT, AUTOPILOT)
    flight = Flight("delay=1ms", PERFECT, rules=[parse_rule("up:HEARTBEAT:delay=9ms")], log_rate=4)
    for n in range(3):
        flight.send("plant", wire.encode(HEARTBEAT), n)
        flight.send("plant", wire.encode(Timesync(0, 5)), n)
    direction = flight.relay._links[0].up
    assert (direction.queued, direction.rules[0].queued) == (6, 3)
    assert link_counters(flight.relay._links[0])["up"]["queued"] == 6
    flight.finish()
    up = link_counters(flight.relay._links[0])["up"]
    (rule,) = up["rules"]
    names = ("sent", "delivered", "reordered", "unlogged", "queued")
    assert [up[name] for name in names] == [6, 6, 3, 2, 0]
    assert [rule[name] for name in names] == [3, 3, 3, 2, 0]


def test_what_is_due_at_once_leaves_in_parts_each_of_which_knows_when():
    """Letting out a thousand packets takes longer than a thousand packets may be late unnoticed."""
    relay = RelayNode(parse_spec("hold=0s:1s"), PERFECT, 1, stamped=True)
    for n in range(3 * MAX_AT_ONCE):
        relay.receive("plant", bytes([n]), n)
    left = []
    for part in range(3):
        assert relay.next_deadline_ns() == S
        relay.tick(S + part * MS)
        left += [payload for _, payload in relay.outgoing()]
        assert len(left) == (part + 1) * MAX_AT_ONCE
    assert left == [bytes([n]) for n in range(3 * MAX_AT_ONCE)]
    assert relay.next_deadline_ns() is None
    delivered_ns = [record.body["delivered_ns"] - S for record in relay.records() if record.topic == "link/up"]
    assert delivered_ns == [part * MS for part in range(3) for _ in range(MAX_AT_ONCE)]
    assert relay._links[0].up.errors.largest_ns == 2 * MS


def test_what_the_gate_timed_tells_nothing_of_precision():
    flight = Flight(PERFECT, "delay=5ms", gate=Gate(WITNESS))
    plant, autopilot = Wire(PLANT, AUTOPILOT), Wire(AUTOPILOT, PLANT)
    flight.send("plant", plant.encode(NamedValueInt(0, "SAMPLE_K", 0)), 0)
    for k in range(4):
        flight.send("plant", plant.encode(Attitude(25 * k, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)), 25 * k * MS)
        flight.send("autopilot", autopilot.encode(ServoOutputRaw(25_000 * k, 1500)), (25 * k + 1) * MS)
    flight.finish()
    down = flight.relay._links[0].down
    assert (down.counters.delivered, down.errors.count) == (3, 0)
    status = link_status(flight.relay._links[0], 80 * MS)["down"]
    assert (status["rate_hz"], status["requested_ns"]) == (3.0, None)
    assert status["achieved_ns"] == {"p50": 24 * MS, "p99": 24 * MS}
    flight.send("autopilot", autopilot.encode(Timesync(0, 5)), S)
    flight.finish()
    assert (down.counters.delivered, down.errors.summary()) == (4, {"p50": 0, "p99": 0, "max": 0})


def test_a_record_with_all_that_may_be_in_it_fits_its_schema_and_one_of_a_wrong_type_does_not():
    flight = Flight("loss=1", PERFECT, rules=[parse_rule("up:HEARTBEAT:corrupt=1")])
    flight.send("plant", Wire(PLANT, AUTOPILOT).encode(HEARTBEAT), 0)
    flight.send("plant", b"x", 1)
    whole, lost = (dict(record.body) for record in of(flight, "up"))
    assert whole.keys() >= {"bits", "rule", "requested_ns"}
    assert lost["requested_ns"] is None
    validator = jsonschema.Draft202012Validator(schema_of("link/one/up"))
    assert validator.is_valid(whole)
    assert validator.is_valid(lost)
    for name, wrong in (("bits", [0.5]), ("rule", 3), ("requested_ns", "1")):
        assert not validator.is_valid(whole | {name: wrong})


def test_the_bits_that_were_flipped_are_recorded():
    flight = Flight("corrupt=1:3", PERFECT)
    flight.send("plant", bytes(20), 0)
    ((_, _, payload),) = flight.left
    (record,) = of(flight, "up")
    flipped = {8 * place + bit for place in range(20) for bit in range(8) if payload[place] >> bit & 1}
    assert flipped == {bit for bit in record.body["bits"] if record.body["bits"].count(bit) % 2}
    assert len(record.body["bits"]) == 3


def test_counters_say_how_far_delays_were_from_those_asked_for():
    relay = RelayNode(parse_spec("delay=20ms"), PERFECT, 1)
    for n in range(100):
        relay.receive("plant", b"x", n * 30 * MS)
        relay.tick(n * 30 * MS + 20 * MS + n * 10)
    relay.close(4 * S)
    data = relay.records()[-1].body["data"]
    error_ns = data["links"]["link"]["up"]["error_ns"]
    assert error_ns["max"] == 990
    assert 490 <= error_ns["p50"] <= 490 * 33 / 32
    assert 980 <= error_ns["p99"] <= 990


# --------------------------------------------------------------------------------------- several links


def two_links(**more: Any) -> RelayNode:
    slow, lossy = (parse_spec(text) for text in ("delay=5ms", "loss=1"))
    return RelayNode.joining([LinkConfig(slow, slow, 1, "one"), LinkConfig(lossy, PERFECT, 2, "two")], **more)


def test_several_links_have_their_own_ports_topics_and_beginnings():
    relay = two_links()
    relay.receive("one/plant", b"a", 0)
    relay.receive("two/autopilot", b"b", 1 * MS)
    relay.receive("two/plant", b"c", 2 * MS)
    assert relay.outgoing() == [("two/plant", b"b")]
    assert relay.next_deadline_ns() == 5 * MS
    relay.tick(5 * MS)
    assert relay.outgoing() == [("one/autopilot", b"a")]
    records = relay.records()
    assert [record.topic for record in records] == ["link/two/down", "link/two/up", "link/one/up"]
    assert all(is_topic(record.topic) for record in records)
    assert {name: c.sent for name, c in relay.counters.items()} == {
        "one/up": 1,
        "one/down": 0,
        "two/up": 1,
        "two/down": 1,
    }


def test_of_several_links_the_one_whose_packet_leaves_first_is_served_first():
    fast, slow = parse_spec("delay=2ms"), parse_spec("delay=9ms")
    relay = RelayNode.joining([LinkConfig(slow, slow, 1, "slow"), LinkConfig(fast, fast, 2, "fast")])
    relay.receive("slow/plant", b"a", 0)
    relay.receive("fast/plant", b"b", 1 * MS)
    left = []
    while (due_ns := relay.next_deadline_ns()) is not None:
        relay.tick(due_ns)
        left += [(due_ns, *datagram) for datagram in relay.outgoing()]
    assert left == [(3 * MS, "fast/autopilot", b"b"), (9 * MS, "slow/autopilot", b"a")]


def test_all_links_of_a_relay_share_what_may_be_recorded_in_a_second():
    relay = two_links(log_rate=5)
    for n in range(4):
        relay.receive("one/plant", b"x", n)
        relay.receive("two/plant", b"x", n)
    relay.tick(10 * MS)
    packets = [record.topic for record in relay.records() if record.topic != "events"]
    assert len(packets) == 5
    assert sum(counters.unlogged for counters in relay.counters.values()) == 3


def test_a_link_does_the_same_beside_others_as_alone():
    spec = parse_spec("delay=5ms,jitter=uniform:28ms,loss=0.1,dup=0.1")
    alone = RelayNode(spec, spec, 7)
    beside = RelayNode.joining([LinkConfig(PERFECT, PERFECT, 7, "first"), LinkConfig(spec, spec, 7, "second")])
    for n in range(200):
        beside.receive("first/plant", b"x", n * 10 * MS + 1)
        for relay, prefix in ((alone, ""), (beside, "second/")):
            relay.receive(f"{prefix}plant", n.to_bytes(2, "big"), n * 10 * MS + 5)
    for relay in (alone, beside):
        relay.tick(9 * S)
    bodies = [
        [record.body for record in relay.records() if record.topic == topic]
        for relay, topic in ((alone, "link/up"), (beside, "link/second/up"))
    ]
    assert len(bodies[0]) > 200
    strip = [[{**body, "delivered_ns": body["fate"]} for body in each] for each in bodies]
    assert strip[0] == strip[1]
