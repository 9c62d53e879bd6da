"""Changes of a link in flight: when they count, what they leave alone, and that a live one can be repeated exactly."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gains.table import InputError
from sitl.link.changes import MAX_CHANGES, Change, format_change, format_time, parse_change, parse_time_ns
from sitl.link.impairment import Fate, Impairment
from sitl.link.relay import RelayNode
from sitl.link.spec import parse_spec
from tests.sitl.relays import MS, PERFECT, Flight, S, both_ways, conserved, events, fly, link_specs, of, short_times

BUSY = "delay=5ms,jitter=uniform:28ms,loss=0.1,dup=0.1"


def request(flight: Flight, now_ns: int, **fields: object) -> dict:
    """Send a request and return the reply."""
    flight.until(now_ns)
    flight.relay.receive("control", json.dumps({"id": 1, **fields}).encode(), now_ns)
    flight.take(now_ns)
    at_ns, port, reply = flight.left.pop()
    assert (at_ns, port) == (now_ns, "control")
    return json.loads(reply)


def test_a_packet_meets_the_new_spec_from_the_instant_of_the_change_on_and_those_under_way_keep_their_times():
    flight = Flight("delay=50ms", "delay=7ms", changes=[parse_change("100ms:up:delay=1ms")])
    for at_ns in (0, 70 * MS, 100 * MS - 1, 100 * MS):
        flight.send("plant", at_ns.to_bytes(8, "big"), at_ns + S)
    flight.send("autopilot", b"down", 100 * MS + S)
    flight.finish()
    assert [(at_ns - S, port) for at_ns, port, _ in flight.left] == [
        (50 * MS, "autopilot"),
        (101 * MS, "autopilot"),
        (107 * MS, "plant"),
        (120 * MS, "autopilot"),
        (150 * MS - 1, "autopilot"),
    ]
    (event,) = events(flight, "link_change")
    assert event.body["data"] == {
        "link": "link",
        "direction": "up",
        "link_ns": 100 * MS,
        "spec": "delay=1ms",
        "at": "100ms:up:delay=1ms",
        "live": False,
    }


def test_a_change_takes_over_a_busy_serialiser_and_the_order_of_packets():
    flight = Flight("rate=8kbps,order=keep", PERFECT, changes=[parse_change("1ms:up:rate=80kbps,order=keep")])
    flight.send("plant", bytes(100), 0)  # 100 ms of airtime
    flight.send("plant", bytes(10), 1 * MS)  # 1 ms at the new rate
    flight.finish()
    assert [at_ns for at_ns, _, _ in flight.left] == [100 * MS, 101 * MS]


def test_the_nth_change_draws_from_the_stream_that_is_documented():
    losses = ("loss=0.4", "loss=0.6", "loss=0.3")  # what stays as it was would go on as it was
    texts = [f"{n}s:down:{losses[n - 1]}" for n in (2, 1, 3)]
    flight = fly(PERFECT, "loss=0.5", both_ways(160), seed=9, changes=[parse_change(text) for text in texts])
    fates = [record.body["fate"] for record in of(flight, "down")]
    for n, start in enumerate((40, 80, 120)):
        rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(9, spawn_key=(2, 1, n))))
        link = Impairment(parse_spec(losses[n]), rng)
        assert fates[start : start + 40] == [link.step(4, k * 25 * MS)[0].fate for k in range(start, start + 40)]
    assert set(fates) == {Fate.DELIVERED, Fate.LOST}


def test_of_several_changes_that_are_due_all_are_made_and_the_last_one_holds():
    changes = [parse_change(text) for text in ("2ms:up:delay=9ms", "1ms:up:delay=1s", "2ms:up:delay=3ms")]
    flight = Flight(PERFECT, PERFECT, changes=changes)
    flight.send("plant", b"a", 0)
    flight.send("plant", b"b", 5 * MS)
    flight.finish()
    assert flight.left == [(0, "autopilot", b"a"), (8 * MS, "autopilot", b"b")]
    assert [event.body["data"]["spec"] for event in events(flight, "link_change")] == [
        "delay=1s",
        "delay=9ms",
        "delay=3ms",
    ]


def test_a_live_change_at_the_instant_of_a_planned_one_comes_after_it_and_says_so():
    planned = ["10ms:up:delay=1ms", "10000001ns:up:delay=2ms", "10000002ns:down:delay=3ms"]
    flight = Flight(PERFECT, PERFECT, changes=[parse_change(text) for text in planned])
    flight.send("plant", b"a", 0)
    assert request(flight, 10 * MS, do="set", up="delay=30ms")["at"] == ["10000002ns:up:delay=30ms"]
    flight.send("plant", b"b", 10 * MS)
    flight.send("plant", b"c", 11 * MS)
    flight.finish()
    assert flight.left[1:] == [(11 * MS, "autopilot", b"b"), (41 * MS, "autopilot", b"c")]


def test_a_change_of_one_direction_leaves_the_other_as_it_was():
    plain = fly(BUSY, BUSY, both_ways(200))
    changed = fly(BUSY, BUSY, both_ways(200), changes=[parse_change("1s:up:loss=1")])
    assert of(changed, "down") == of(plain, "down")
    assert [r.body for r in of(changed, "up") if r.body["sent_ns"] < S] == [
        r.body for r in of(plain, "up") if r.body["sent_ns"] < S
    ]
    assert all(record.body["fate"] == "lost" for record in of(changed, "up") if record.body["sent_ns"] >= S)


@settings(max_examples=40)
@given(
    specs=st.tuples(link_specs, link_specs),
    steps=st.lists(
        st.tuples(
            short_times,
            st.sampled_from(["plant", "autopilot"])
            | st.dictionaries(st.sampled_from(["up", "down"]), link_specs, min_size=1),
        ),
        max_size=30,
    ),
    planned=st.lists(st.builds(Change, short_times, st.sampled_from(["up", "down"]), link_specs), max_size=2),
)
def test_a_flight_with_live_changes_is_repeated_packet_by_packet_from_its_recording(specs, steps, planned):
    flight, now_ns, packets = Flight(*specs, seed=5, changes=planned), 7 * S, []
    for gap_ns, what in steps:
        now_ns += gap_ns
        if isinstance(what, str):
            packets.append((now_ns, what, len(packets).to_bytes(4, "big")))
            flight.send(what, packets[-1][2], now_ns)
        else:
            flight.until(now_ns)
            flight.relay._links[0].order(what, now_ns)
        assert conserved(flight.relay)
    flight.finish()
    changes = [parse_change(event.body["data"]["at"]) for event in events(flight, "link_change")]
    again = Flight(*specs, seed=5, changes=changes + [change for change in planned if change not in changes])
    for now_ns, port, payload in packets:
        again.send(port, payload, now_ns)
    again.finish()
    assert again.left == flight.left
    for way in ("up", "down"):
        assert of(again, way) == of(flight, way)


def test_a_request_changes_the_link_from_then_on_and_says_how_to_repeat_it():
    flight = Flight(BUSY, BUSY)
    packets = [(5 * S + at_ns, port) for at_ns, port in both_ways(200)]
    for n, (at_ns, port) in enumerate(packets):
        if n == 171:  # between the two packets of one instant
            reply = request(flight, at_ns, do="set", up="delay=60ms", down="loss=0.3,jitter=gamma:5ms")
        flight.send(port, n.to_bytes(2, "big"), at_ns)
    flight.finish()
    at = [f"{85 * 25 * MS + 1}ns:up:delay=60ms", f"{85 * 25 * MS + 1}ns:down:jitter=gamma:5ms,loss=0.3"]
    assert reply == {"id": 1, "ok": True, "link": "link", "at": at}
    told = events(flight, "link_change")
    assert [event.body["data"]["at"] for event in told] == at
    assert all(event.body["data"]["live"] and event.t_ns == 5 * S + 85 * 25 * MS for event in told)
    again = Flight(BUSY, BUSY, changes=[parse_change(text) for text in at])
    for n, (at_ns, port) in enumerate(packets):
        again.send(port, n.to_bytes(2, "big"), at_ns)
    again.finish()
    assert again.left == flight.left


def test_a_request_before_the_first_packet_counts_from_the_beginning():
    flight = Flight(PERFECT, PERFECT)
    assert request(flight, 3 * S, do="set", up="delay=9ms")["at"] == ["0ns:up:delay=9ms"]
    flight.send("plant", b"x", 4 * S)
    flight.finish()
    assert flight.left == [(4 * S + 9 * MS, "autopilot", b"x")]


def test_a_packet_that_came_before_a_live_change_and_was_read_after_it_meets_the_old_spec():
    relay = RelayNode(parse_spec("delay=5ms"), PERFECT, 1, stamped=True)
    relay.receive("plant", b"a", S)
    relay.receive("control", b'{"id":1,"do":"set","up":"delay=50ms"}', S + 10 * MS)
    relay.receive("plant", b"b", S + 9 * MS)
    relay.receive("plant", b"c", S + 10 * MS)
    relay.tick(2 * S)
    bodies = [record.body for record in relay.records() if record.topic == "link/up"]
    assert [body["requested_ns"] for body in bodies] == [5 * MS, 5 * MS, 50 * MS]


def test_no_more_changes_wait_than_there_is_room_for_and_a_request_too_many_does_nothing():
    flight = Flight(PERFECT, PERFECT, changes=[Change(S + n, "up", PERFECT) for n in range(MAX_CHANGES)])
    refusal = request(flight, 0, do="set", up="loss=1", down="loss=1")
    assert refusal == {
        "id": 1,
        "ok": False,
        "error": f"link link: expected at most {MAX_CHANGES} changes to wait, found more",
    }
    flight.send("autopilot", b"x", 0)
    assert len(flight.left) == 1


@given(time_ns=st.integers(0, 10**15), way=st.sampled_from(["up", "down"]), spec=link_specs)
def test_the_text_of_a_change_reads_back(time_ns, way, spec):
    change = Change(time_ns, way, spec)
    assert parse_change(format_change(change)) == change
    assert parse_time_ns(format_time(time_ns), "") == time_ns


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("3s:loss=0.5", "expected TIME:up:SPEC or TIME:down:SPEC"),
        ("up:loss=0.5", "expected TIME:up:SPEC or TIME:down:SPEC"),
        ("3:up:loss=0.5", "time: expected a time with its unit (s, ms, us, ns), found 3"),
        ("-3s:up:loss=0.5", "found -3s"),
        ("3s,loss=1:up:loss=0.5", "found 3s,loss=1"),
        (":up:loss=0.5", "found nothing"),
        ("3s:up:loss=5", "loss: expected"),
    ],
)
def test_a_bad_change_is_refused_in_one_line(text, said):
    with pytest.raises(InputError) as refusal:
        parse_change(text)
    assert str(refusal.value).startswith(f'change "{text}": ')
    assert said in str(refusal.value)
