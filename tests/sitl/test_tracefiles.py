"""Recorded links: what each kind of file says, and that anything else is refused in one line."""

from __future__ import annotations

import gzip
import json
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autopilot.link.node import Record
from autopilot.link.record import McapRecorder
from gains.table import InputError
from sitl.link import tracefiles
from sitl.link.relay import RelayNode
from sitl.link.spec import format_spec, parse_spec
from sitl.link.tracefiles import load_table, load_trace
from sitl.link.traces import Trace
from tests.sitl.links import MS, S, impairment


@pytest.fixture
def write(tmp_path):
    """Return a function that writes a file and returns its name."""

    def written(content: str | bytes, name: str = "trace") -> str:
        path = tmp_path / name
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return str(path)

    return written


def refusal(source: str) -> str:
    """Return why a trace is refused, without the name of the file."""
    with pytest.raises(InputError) as error:
        load_trace(source)
    text = str(error.value)
    assert "\n" not in text
    return text.removeprefix(source.partition("#")[0] + ": ")


# ------------------------------------------------------------------------------------------------------------ CSV


def test_a_list_of_delays_is_met_packet_by_packet_and_begins_anew(write):
    path = write("delay_ms\n10\nlost\n\n0.5\n")
    assert load_trace(path) == Trace(path, (10 * MS, None, MS // 2))
    link = impairment(f"trace={path}")
    assert [link.schedule(10, n * S) for n in range(4)] == [(10 * MS,), (), (2 * S + MS // 2,), (3 * S + 10 * MS,)]


def test_delays_with_times_are_met_by_time(write):
    path = write("t_s,delay_ms\n100.0,10\n100.5,20\n101.0,\n")
    trace = load_trace(path)
    assert trace == Trace(path, (10 * MS, 20 * MS, None), (0, S // 2, S), 3 * S // 2)
    assert [trace.delay_ns(7, at_ns) for at_ns in (0, S // 2 - 1, S // 2, S, 3 * S // 2)] == [
        10 * MS,
        10 * MS,
        20 * MS,
        None,
        10 * MS,
    ]


def test_packets_of_one_instant_take_the_entries_of_that_instant_in_turn(write):
    path = write("t_s,delay_ms\n0,10\n1,20\n1,\n1,40\n2,50\n")
    link = impairment(f"trace={path}")
    times_ns = [0, 0, S, S, S, S, S + 1, 2 * S]
    delays_ms = [(exit_ns[0] - at_ns) // MS if (exit_ns := link.schedule(10, at_ns)) else None for at_ns in times_ns]
    assert delays_ms == [10, 10, 20, None, 40, 40, 40, 50]


def test_a_table_of_both_directions_is_chosen_from_with_up_and_down(write):
    path = write("up_ms,down_ms\r\n1,2\r\nlost,4\r\n")
    assert load_trace(f"{path}#up").delays_ns == (MS, None)
    assert load_trace(f"{path}#down").delays_ns == (2 * MS, 4 * MS)
    assert load_trace(f"{path}#up").source == f"{path}#up"


def test_a_spec_with_a_trace_is_written_as_it_was_read(write):
    path = write("up_ms,down_ms\n1,2\n", "name#with hash.csv")
    assert format_spec(parse_spec(f"loss=0.1,trace={path}#down")) == f"loss=0.1,trace={path}#down"


def test_a_byte_order_mark_is_no_part_of_the_header(write):
    assert load_trace(write(b"\xef\xbb\xbfdelay_ms\n3\n")).delays_ns == (3 * MS,)


@pytest.mark.parametrize(
    ("content", "way", "message"),
    [
        ("delay_ms\n1\n-2\n", "", "line 3: delay_ms: expected a delay from 0 to 1000000 ms, lost or nothing, found -2"),
        ("delay_ms\nnan\n", "", "line 2: delay_ms: expected a delay from 0 to 1000000 ms, lost or nothing, found nan"),
        ("delay_ms\n1e9\n", "", "line 2: delay_ms: expected a delay from 0 to 1000000 ms, lost or nothing, found 1e9"),
        ("delay_ms\n1_0\n", "", "line 2: delay_ms: expected a delay from 0 to 1000000 ms, lost or nothing, found 1_0"),
        ("delay_ms\n", "", "expected 1 to 1000000 entries, found none"),
        ("delay_ms\n1,2\n", "", "line 2: expected delay_ms, found 2 of 1"),
        ("delay_ms\n1\n", "#up", "expected up_ms,down_ms for #up, found delay_ms"),
        ("up_ms,down_ms\n1,2\n", "", "expected #up or #down after a file that holds both, found none"),
        ("t_s,delay_ms\n2,1\n1,1\n", "", "line 3: t_s: expected a time not before the one above, found 1"),
        ("t_s,delay_ms\n,1\n", "", "line 2: t_s: expected a time from 0 to 10000000000 s, found nothing"),
    ],
)
def test_a_bad_table_is_refused_with_its_line(write, content, way, message):
    assert refusal(write(content) + way) == message


@pytest.mark.parametrize(
    "content", ["", "10\n20\n", "delay\n1\n", "delay_ms,delay_ms\n1,2\n", "delay_ms,up_ms\n1,2\n", "t_s\n1\n"]
)
def test_a_file_of_no_known_kind_is_refused_with_all_that_is_known(write, content):
    header = content.partition("\n")[0] or "nothing"
    assert refusal(write(content)) == (
        "line 1: expected the header delay_ms or up_ms,down_ms, with or without t_s, a flight recording, or the output "
        f"of ping or irtt, found {header}"
    )


def test_files_that_are_missing_or_no_text_or_too_large_are_refused(write, tmp_path, monkeypatch):
    assert refusal(str(tmp_path / "none")) == "expected a trace, found nothing of that name"
    assert refusal(str(tmp_path)) == "expected a readable file, found: Is a directory"
    assert refusal(write(b"delay_ms\n\xff\n")) == "expected a trace in UTF-8, found byte 9 that is not"
    packed = gzip.compress(b"delay_ms\n" + b"1\n" * 5000)
    assert refusal(write(packed[:-9])).startswith("expected a gzip file, found: ")
    monkeypatch.setattr(tracefiles, "MAX_FILE_BYTES", 10_000)
    assert refusal(write(packed)) == "expected at most 10000 bytes unpacked, found more"


def test_more_entries_than_a_trace_holds_are_refused(write, monkeypatch):
    monkeypatch.setattr(tracefiles, "MAX_ENTRIES", 3)
    assert load_trace(write("delay_ms\n1\n1\n1\n")).delays_ns == (MS,) * 3
    assert refusal(write("delay_ms\n1\n1\n1\n1\n")) == "expected 1 to 3 entries, found 4"
    assert refusal(write(LINUX)) == "expected 1 to 3 entries, found 6"
    assert refusal(write(json.dumps({"round_trips": [TRIP] * 4}))) == "expected 1 to 3 entries, found 4"


@given(
    st.binary(max_size=200)
    | st.from_regex(rb"(delay_ms|t_s,delay_ms|PING |\{|\x1f\x8b|\x89MCAP0\r\n).*", fullmatch=True)
)
def test_any_file_is_a_trace_or_refused_in_one_line(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / "any"
    path.write_bytes(content)
    for way in ("", "#up"):
        complaint = ""
        try:
            trace = load_trace(f"{path}{way}")
        except InputError as error:
            complaint = str(error)
        else:
            assert all(delay_ns is None or delay_ns >= 0 for delay_ns in trace.delays_ns)
        assert "\n" not in complaint


# ------------------------------------------------------------------------------------------------------------ ping

LINUX = """\
PING ground.example.net (192.0.2.7) 56(84) bytes of data.
64 bytes from ground.example.net (192.0.2.7): icmp_seq=2 ttl=52 time=17.6 ms
64 bytes from ground.example.net (192.0.2.7): icmp_seq=2 ttl=52 time=44.1 ms (DUP!)
no answer yet for icmp_seq=3
64 bytes from ground.example.net (192.0.2.7): icmp_seq=5 ttl=52 time=0.104 ms
64 bytes from ground.example.net (192.0.2.7): icmp_seq=4 ttl=52 time=1230 ms
From 192.0.2.1 icmp_seq=6 Destination Host Unreachable

--- ground.example.net ping statistics ---
6 packets transmitted, 3 received, +1 duplicates, +1 errors, 50% packet loss, time 5071ms
rtt min/avg/max/mdev = 0.104/415.901/1230.000/577.1 ms
"""
MACOS = """\
PING 192.0.2.7 (192.0.2.7): 56 data bytes
64 bytes from 192.0.2.7: icmp_seq=0 ttl=117 time=12.500 ms
Request timeout for icmp_seq 1
64 bytes from 192.0.2.7: icmp_seq=2 ttl=117 time=13.100 ms
^C
--- 192.0.2.7 ping statistics ---
3 packets transmitted, 2 packets received, 33.3% packet loss
"""
BUSYBOX = """\
PING 192.0.2.7 (192.0.2.7): 56 data bytes
64 bytes from 192.0.2.7: seq=0 ttl=117 time=12.500 ms
64 bytes from 192.0.2.7: seq=2 ttl=117 time=13.100 ms
"""


def test_ping_gives_half_of_each_round_trip_and_a_loss_for_each_number_without_reply(write):
    trace = load_trace(write(LINUX))
    assert trace.delays_ns == (None, 8_800_000, None, 615 * MS, 52_000, None)
    assert trace.times_ns == tuple(n * S for n in range(6))
    assert trace.length_ns == 6 * S


@pytest.mark.parametrize("text", [MACOS, BUSYBOX])
def test_ping_of_other_systems_counts_from_zero(write, text):
    assert load_trace(write(text)).delays_ns == (6_250_000, None, 6_550_000)


def test_ping_over_ipv6_is_read(write):
    linux = "PING 2001:db8::7(2001:db8::7) 56 data bytes\n64 bytes from 2001:db8::7: icmp_seq=1 ttl=64 time=2 ms\n"
    macos = (
        "PING6(56=40+8+8 bytes) 2001:db8::1 --> 2001:db8::7\n16 bytes from 2001:db8::7, icmp_seq=0 hlim=57 time=2 ms\n"
    )
    assert load_trace(write(macos)).delays_ns == (MS,)
    assert load_trace(write(linux)).delays_ns == (MS,)


def test_stamps_of_ping_tell_the_interval(write):
    replies = [(1, 20.0), (2, 120.0), (4, 20.0), (11, 70.0)]  # sent each 200 ms, stamped when they come back
    lines = [
        f"[{1_700_000_000 + 0.2 * n + ms / 1000:.6f}] 64 bytes from h: icmp_seq={n} ttl=9 time={ms} ms"
        for n, ms in replies
    ]
    trace = load_trace(write("\n".join(lines)))
    assert trace.times_ns == pytest.approx([n * S // 5 for n in range(11)], abs=1000)
    assert trace.delays_ns[:4] == (10 * MS, 60 * MS, None, 10 * MS)


def test_numbers_of_ping_go_on_where_they_wrap(write):
    numbers = [65_533, 65_535, 0, 65_534, 2]
    lines = [f"64 bytes from h: icmp_seq={n} ttl=9 time={2 * i} ms" for i, n in enumerate(numbers)]
    assert load_trace(write("\n".join(lines))).delays_ns == (0, 3 * MS, MS, 2 * MS, None, 4 * MS)


def test_ping_without_a_reply_or_for_one_direction_is_refused(write):
    assert refusal(write("PING h (192.0.2.7): 56 data bytes\n")) == "expected the output of ping, found no reply in it"
    path = write(LINUX)
    assert refusal(f"{path}#up") == "expected no #up: ping tells round trips, of which a trace takes half"


# ------------------------------------------------------------------------------------------------------------ irtt

TRIP = {
    "seqno": 0,
    "lost": "false",
    "timestamps": {"client": {"send": {"wall": 1_700_000_000_000_000_000, "monotonic": 5_000_000}}, "server": {}},
    "delay": {"receive": 14_000_000, "rtt": 40_000_000, "send": 26_000_000},
    "ipdv": {},
}


def irtt(*trips: tuple[float, object, dict]) -> str:
    """Return a result of irtt with (ms when sent, lost, delay) of some round trips."""
    written = [
        {
            **TRIP,
            "seqno": n,
            "lost": lost,
            "delay": delay,
            "timestamps": {"client": {"send": {"monotonic": round(ms * MS)}}},
        }
        for n, (ms, lost, delay) in enumerate(trips)
    ]
    return json.dumps({"version": {"irtt": "0.9.1", "json_format": 1}, "stats": {}, "round_trips": written})


GOOD = {"receive": 14 * MS, "rtt": 40 * MS, "send": 25 * MS}  # a millisecond went by at the server
RESULT = irtt((5, "false", GOOD), (25, "true_up", {}), (45, "true_down", {}), (65, "true", {}), (85, False, GOOD))


def test_irtt_gives_each_direction_by_the_time_of_sending(write):
    path = write(RESULT)
    up, down = load_trace(f"{path}#up"), load_trace(f"{path}#down")
    assert up.delays_ns == (25 * MS, None, None, 25 * MS)  # what was lost on the other way says nothing
    assert up.times_ns == (0, 20 * MS, 60 * MS, 80 * MS)
    assert down.delays_ns == (14 * MS, None, None, 14 * MS)
    assert down.times_ns == (0, 40 * MS, 60 * MS, 80 * MS)


def test_irtt_without_a_direction_gives_half_of_each_round_trip_packed_or_not(write):
    trace = load_trace(write(RESULT))
    assert trace.delays_ns == (20 * MS, None, None, None, 20 * MS)
    assert trace.length_ns == 100 * MS
    packed = load_trace(write(gzip.compress(RESULT.encode()), "result.json.gz"))
    assert (packed.delays_ns, packed.times_ns) == (trace.delays_ns, trace.times_ns)


SKEWED = irtt((5, "false", {"receive": 45 * MS, "rtt": 40 * MS, "send": -5 * MS}))
LOST = "round_trips[0].lost: expected true, true_up, true_down or false, found"
CLOCKS = "without one clock at both ends leave out #{way}, which takes half the round trip"
ONE_WAY = "round_trips[0].delay.{name}: expected 0 to 40000000 ns, the round trip, found {found}: " + CLOCKS


@pytest.mark.parametrize(
    ("content", "way", "message"),
    [
        (SKEWED, "#up", ONE_WAY.format(name="send", found=-5_000_000, way="up")),
        (SKEWED, "#down", ONE_WAY.format(name="receive", found=45_000_000, way="down")),
        (irtt((5, "false", {"rtt": 40 * MS})), "#up", ONE_WAY.format(name="send", found=None, way="up")),
        (irtt((5, "false", {})), "", "round_trips[0].delay.rtt: expected 0 to 1000000000000 ns, found None"),
        (irtt((5, "maybe", GOOD)), "", f"{LOST} maybe"),
        ('{"round_trips": [3]}', "", f"{LOST} None"),
        (
            irtt((5, "false", GOOD), (4, "false", GOOD)),
            "",
            "round_trips[1]: expected to be sent after the one before, found 4000000 ns",
        ),
        (irtt((5, "true_down", {})), "#up", "expected 1 to 1000000 entries, found none"),
        (
            '{"round_trips": [{"lost": "true"}]}',
            "",
            "round_trips[0].timestamps.client.send.monotonic: expected a time in ns, found nothing",
        ),
        ('{"stats": {}}', "", "round_trips: expected the list of irtt, found NoneType"),
    ],
)
def test_a_bad_result_of_irtt_is_refused_with_its_field(write, content, way, message):
    assert refusal(write(content) + way) == message


def test_text_that_only_begins_like_json_is_refused(write):
    assert refusal(write("{")).startswith("expected the JSON of irtt, found: ")


# ------------------------------------------------------------------------------------------------------ recordings


def recording(path: str, packets: list[tuple[str, int, int | None, int, int, str]]) -> str:
    """Write (direction, sent, delivered, number, copy, fate) of packets as a flight recording."""
    with McapRecorder(path, {}) as recorder:
        for way, sent_ns, delivered_ns, number, copy, fate in packets:
            body = {
                "sent_ns": sent_ns,
                "delivered_ns": delivered_ns,
                "number": number,
                "size": 30,
                "fate": fate,
                "copy": copy,
            }
            recorder.write(Record(f"link/{way}", sent_ns, body), max(0, delivered_ns or sent_ns))
    return path


def test_a_recording_gives_both_directions_on_their_common_time(tmp_path):
    path = recording(
        str(tmp_path / "flight.mcap"),
        [
            ("down", 100 * MS, 107 * MS, 1, 0, "delivered"),
            ("down", 100 * MS, 109 * MS, 1, 1, "delivered"),
            ("up", 300 * MS, None, 2, 0, "lost"),
            ("up", 200 * MS, 205 * MS, 1, 0, "delivered"),
            ("up", 350 * MS, None, 3, 0, "gated"),
            ("up", 400 * MS, 409 * MS, 4, 0, "delivered"),
        ],
    )
    up, down = load_trace(f"{path}#up"), load_trace(f"{path}#down")
    assert up == Trace(f"{path}#up", (5 * MS, None, 9 * MS), (100 * MS, 200 * MS, 300 * MS), 400 * MS)
    assert [up.delay_ns(0, at_ns) for at_ns in (0, 100 * MS, 199 * MS)] == [5 * MS] * 3
    assert down.delays_ns == (7 * MS,)
    assert down.times_ns == (0,)


def test_a_recorded_flight_gives_back_its_delays_and_losses(tmp_path):
    spec = parse_spec("delay=5ms,jitter=uniform:28ms,loss=0.1")
    relay, bodies, delays = RelayNode(spec, spec, 3), [], {}
    for n in range(200):
        relay.receive("plant", b"x" * 30, n * 25 * MS)
        while (due_ns := relay.next_deadline_ns()) is not None and due_ns <= (n + 1) * 25 * MS:
            relay.tick(due_ns)
            relay.outgoing()
        bodies += relay.records()
    bodies += relay.records()
    path = str(tmp_path / "flight.mcap")
    with McapRecorder(path, {}) as recorder:
        for record in bodies:
            recorder.write(record, record.t_ns)
            if record.topic == "link/up":
                body = record.body
                delays[body["sent_ns"]] = (
                    None if body["delivered_ns"] is None else body["delivered_ns"] - body["sent_ns"]
                )
    assert len(delays) > 190
    link = impairment(f"trace={path}#up")
    for at_ns, delay_ns in delays.items():
        assert link.schedule(30, at_ns) == (() if delay_ns is None else (at_ns + delay_ns,))
    assert 5 < sum(delay_ns is None for delay_ns in delays.values()) < 40


def test_a_recording_wants_a_direction_and_packets_in_it(tmp_path):
    path = recording(str(tmp_path / "flight.mcap"), [("up", 0, 5, 1, 0, "delivered")])
    assert refusal(path) == "expected #up or #down after a flight recording, found none"
    assert refusal(f"{path}#down") == "expected packets under link/down, found none"


def test_a_recording_that_is_cut_off_is_refused_with_the_way_to_save_it(tmp_path):
    path = recording(
        str(tmp_path / "flight.mcap"), [("up", n * MS, n * MS + 5, n, 0, "delivered") for n in range(2000)]
    )
    content = (tmp_path / "flight.mcap").read_bytes()
    for length in (8, len(content) // 2, len(content) - 1):
        (tmp_path / "flight.mcap").write_bytes(content[:length])
        assert refusal(f"{path}#up") == (
            f'expected a whole flight recording, found one that is cut off: run "sitl recover {path}" first'
        )


def test_a_damaged_recording_is_refused(tmp_path):
    path = recording(str(tmp_path / "flight.mcap"), [("up", n * MS, n * MS + 5, n, 0, "delivered") for n in range(500)])
    content = (tmp_path / "flight.mcap").read_bytes()
    damaged = np.frombuffer(content, np.uint8).copy()
    damaged[len(content) // 4 : -200] = 0x5A
    (tmp_path / "flight.mcap").write_bytes(damaged.tobytes())
    assert refusal(f"{path}#up").startswith("expected a readable flight recording, found: ")


def test_a_recorded_delay_below_zero_is_refused(tmp_path):
    path = recording(str(tmp_path / "flight.mcap"), [("up", 10, 5, 1, 0, "delivered")])
    assert refusal(f"{path}#up") == "link/up: packet 1: expected a delay from 0 to 1000000000000 ns, found -5"


def test_reading_specs_costs_no_reader_of_recordings():
    code = "import sys, sitl.link.spec; print('mcap' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"


# ---------------------------------------------------------------------------------------------------------- tables


@pytest.mark.parametrize("content", ["30\n10\n20.5\n", "delay_ms\n30\n\n10\n20.5\n"])
def test_a_table_of_delays_is_sorted(write, content):
    assert load_table(write(content)) == (10 * MS, 20_500_000, 30 * MS)


def test_jitter_from_a_table_stays_within_it(write):
    path = write("30\n10\n20\n")
    link = impairment(f"jitter=table:{path}")
    delays = np.array([link.schedule(10, n * S)[0] - n * S for n in range(2000)]) / MS
    assert delays.min() >= 10.0
    assert delays.max() <= 30.0
    assert np.median(delays) == pytest.approx(20.0, abs=1.0)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("1\n", "expected 2 to 1000000 delays, found 1"),
        ("delay_ms\n1\n", "expected 2 to 1000000 delays, found 1"),
        ("1\nlost\n", "line 2: delay_ms: expected a delay from 0 to 1000000 ms, found lost"),
        ("1\n\n-1\n", "line 3: delay_ms: expected a delay from 0 to 1000000 ms, found -1"),
    ],
)
def test_a_bad_table_of_delays_is_refused(write, content, message):
    path = write(content)
    with pytest.raises(InputError) as error:
        load_table(path)
    assert str(error.value) == f"{path}: {message}"
