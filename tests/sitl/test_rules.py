"""Rules: which datagrams they apply to, by frames that pymavlink made, and what these then meet."""

from __future__ import annotations

from dataclasses import asdict

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v10 import ardupilotmega as dialect1
from pymavlink.dialects.v20 import ardupilotmega as dialect2

from gains.table import InputError
from sitl.link.impairment import LinkSpec
from sitl.link.rules import MAX_FRAMES, format_rule, parse_rule, rule_finder
from tests.sitl.relays import MS, PERFECT, Flight, both_ways, conserved, fly, of


def frame(name: str, dialect=dialect2, *, signed: bool = False) -> bytes:
    """A frame of a message, all its fields zero, as pymavlink packs it."""
    mav = dialect.MAVLink(None, 1, 1)
    if signed:
        mav.signing.secret_key, mav.signing.sign_outgoing = bytes(32), True
    message = getattr(dialect, f"MAVLink_{name.lower()}_message")
    fields = [b"" if kind == "char" else 0 for kind in message.fieldtypes]
    lengths = message.array_lengths
    arrays = [
        [0] * n if n and value == 0 else value for value, n in zip(fields, _in_order(message, lengths), strict=True)
    ]
    return bytes(message(*arrays).pack(mav))


def _in_order(message, lengths: list[int]) -> list[int]:
    """Array lengths are in the order on the wire; return them in that of the fields."""
    by_name = dict(zip(message.ordered_fieldnames, lengths, strict=True))
    return [by_name[name] for name in message.fieldnames]


ATTITUDE, HEARTBEAT, AOA = frame("ATTITUDE"), frame("HEARTBEAT"), frame("AOA_SSA")
RULES = [parse_rule("up:ATTITUDE:delay=1ms"), parse_rule("up:HEARTBEAT+11020:delay=2ms")]
find = rule_finder(RULES)


@pytest.mark.parametrize("name", ["ATTITUDE", "HEARTBEAT", "SERVO_OUTPUT_RAW", "STATUSTEXT", "PARAM_VALUE"])
@pytest.mark.parametrize("make", [frame, lambda name: frame(name, dialect1), lambda name: frame(name, signed=True)])
def test_a_message_is_known_by_the_header_of_either_version_signed_or_not(name, make):
    finder = rule_finder([parse_rule("up:ATTITUDE:loss=1"), parse_rule(f"up:{name}:loss=1")])
    assert finder(make(name)) == (0 if name == "ATTITUDE" else 1)
    assert rule_finder([parse_rule("up:SYS_STATUS:loss=1")])(make(name)) is None


def test_ids_above_a_byte_are_read_whole():
    assert find(AOA) == 1
    assert rule_finder([parse_rule(f"up:{11020 % 256}:loss=1")])(AOA) is None
    assert rule_finder([parse_rule(f"up:{11020 % 65536}:loss=1")])(AOA) == 0


def test_any_frame_of_a_datagram_counts_and_of_several_rules_the_first():
    other = frame("VFR_HUD")
    assert find(other) is None
    assert find(other + frame("HEARTBEAT", dialect1) + other) == 1
    assert find(HEARTBEAT + frame("TIMESYNC", signed=True) + ATTITUDE) == 0
    assert find(ATTITUDE + HEARTBEAT) == 0


def test_what_is_no_whole_frame_ends_the_search_and_no_checksum_is_looked_at():
    assert find(ATTITUDE[:-1]) is None
    assert find(b"noise" + ATTITUDE) is None
    assert find(HEARTBEAT + b"noise" + ATTITUDE) == 1
    assert find(ATTITUDE[:-2] + b"\0\0") == 0
    assert find(ATTITUDE[:2] + b"\x02" + ATTITUDE[3:]) is None  # an incompatible flag that nobody knows


def test_no_more_frames_are_read_than_there_may_be():
    other = frame("TIMESYNC")
    assert find(other * (MAX_FRAMES - 1) + ATTITUDE) == 0
    assert find(other * MAX_FRAMES + ATTITUDE) is None


@given(datagram=st.binary(max_size=300) | st.lists(st.sampled_from([ATTITUDE, AOA, b"\xfd\xff\xfe"])).map(b"".join))
def test_any_datagram_passes_by_the_rules_unharmed(datagram):
    assert find(datagram) in (None, 0, 1)


@pytest.mark.parametrize(
    "text", ["up:ATTITUDE:delay=40ms,loss=0.5", "down:ATTITUDE+AOA_SSA+253:loss=ge:0.1:0.3", "up:CURRENT_MODE:dup=1.0"]
)
def test_the_text_of_a_rule_reads_back(text):
    assert parse_rule(format_rule(parse_rule(text))) == parse_rule(text)
    assert format_rule(parse_rule(text)) == text


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("ATTITUDE:loss=1", "expected up:MESSAGE+MESSAGE:SPEC"),
        ("up:ATTITUDE", "expected up:MESSAGE+MESSAGE:SPEC"),
        ("both:ATTITUDE:loss=1", "expected up:MESSAGE+MESSAGE:SPEC"),
        ("up:ATITUDE:loss=1", "found ATITUDE"),
        ("up:ATTITUDE+:loss=1", "found nothing"),
        ("up:16777216:loss=1", "found 16777216"),
        ("up:ATTITUDE:loss=2", "loss: expected"),
    ],
)
def test_a_bad_rule_is_refused_in_one_line(text, said):
    with pytest.raises(InputError) as refusal:
        parse_rule(text)
    assert str(refusal.value).startswith(f'rule "{text}": ')
    assert said in str(refusal.value)


def test_a_message_with_a_rule_meets_its_spec_and_the_others_that_of_their_direction():
    flight = Flight("delay=5ms", "delay=7ms", rules=[parse_rule("up:ATTITUDE:delay=40ms")])
    for payload in (ATTITUDE, HEARTBEAT):
        flight.send("plant", payload, 0)
        flight.send("autopilot", payload, 0)
    flight.finish()
    assert flight.left == [
        (5 * MS, "autopilot", HEARTBEAT),
        (7 * MS, "plant", ATTITUDE),
        (7 * MS, "plant", HEARTBEAT),
        (40 * MS, "autopilot", ATTITUDE),
    ]
    assert [record.body.get("rule") for record in of(flight, "up")] == [None, "ATTITUDE"]
    assert all("rule" not in record.body for record in of(flight, "down"))


def test_rules_are_counted_each_for_itself_and_have_queues_of_their_own():
    rules = [parse_rule("up:ATTITUDE:delay=1s,limit=2"), parse_rule("up:HEARTBEAT:loss=1")]
    flight = Flight("delay=1s,limit=3", PERFECT, rules=rules)
    for n in range(5):
        for payload in (ATTITUDE, HEARTBEAT, AOA):
            flight.send("plant", payload, n)
            assert conserved(flight.relay)
    assert flight.relay.queued["up"] == 5
    flight.finish()
    flight.relay.close(3 * 10**9)
    data = flight.relay.records()[-1].body["data"]["links"]["link"]["up"]
    assert (data["sent"], data["delivered"], data["refused"], data["lost"]) == (15, 5, 5, 5)
    assert [
        (rule["rule"], rule["sent"], rule["delivered"], rule["refused"], rule["lost"]) for rule in data["rules"]
    ] == [
        ("up:ATTITUDE:delay=1s,limit=2", 5, 2, 3, 0),
        ("up:HEARTBEAT:loss=1.0", 5, 0, 0, 5),
    ]


def test_a_rule_changes_nothing_for_the_packets_that_it_is_not_about():
    spec = LinkSpec(delay_ns=5 * MS, dup=0.2)
    spec_text = "delay=5ms,jitter=uniform:28ms,loss=0.2,dup=0.2"
    plain = fly(spec_text, spec, both_ways(200))
    ruled = fly(spec_text, spec, both_ways(200), rules=[parse_rule("up:ATTITUDE:loss=0.5")])
    assert ruled.left == plain.left
    assert all(of(ruled, way) == of(plain, way) for way in ("up", "down"))


def test_equal_seeds_make_equal_fates_under_rules_and_the_direction_and_each_rule_draw_for_themselves():
    rules = [parse_rule("up:ATTITUDE:loss=0.5"), parse_rule("up:HEARTBEAT:loss=0.5")]
    fates = {}
    for seed in (3, 4):
        for run in range(2):
            flight = Flight("loss=0.5", PERFECT, seed, rules=rules)
            for n in range(300):
                for payload in (ATTITUDE, HEARTBEAT, AOA):
                    flight.send("plant", payload, n * MS)
            lost = {"ATTITUDE": [], "HEARTBEAT": [], None: []}
            for record in of(flight, "up"):
                lost[record.body.get("rule")].append(record.body["fate"] == "lost")
            fates[seed, run] = lost
    assert fates[3, 0] == fates[3, 1]
    assert fates[3, 0] != fates[4, 0]
    one, two, three = fates[3, 0].values()
    assert len({tuple(one), tuple(two), tuple(three)}) == 3
    for lost in (one, two, three):
        assert abs(sum(lost) - 150) < 5 * (300 * 0.25) ** 0.5
    assert asdict(flight.relay.counters["up"])["sent"] == 900
