"""Frames: both ways against pymavlink's own parser, sealed or not, and everything that is no frame.

The messages of ground stations are compared with pymavlink's ``development`` dialect: its tables are others than
those that the wire uses, and AVAILABLE_MODES and CURRENT_MODE are among them.
"""

from __future__ import annotations

import math
import re
import struct
from dataclasses import fields
from enum import IntEnum, StrEnum
from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect
from pymavlink.dialects.v20 import development

from autopilot.link import groundmessages as ground
from autopilot.link.codecs import CODECS
from autopilot.link.signing import Signing, Verdict
from autopilot.link.wire import (
    AUTOPILOT,
    CONTROL_MESSAGES,
    GROUND_MESSAGES,
    MAX_FRAMES,
    PLANT,
    AoaSsa,
    Attitude,
    Heartbeat,
    HilActuatorControls,
    NamedValueFloat,
    NamedValueInt,
    Reject,
    ServoOutputRaw,
    Severity,
    StatusText,
    Timesync,
    VfrHud,
    Wire,
    autopilot_heartbeat,
    frames_of,
    message_id,
    plant_heartbeat,
    split_frames,
)
from tests.helpers import broken, parse

quick = settings(deadline=None)
f32 = st.floats(width=32, allow_nan=False, allow_infinity=False)
u8, u16, u32, u64 = (st.integers(0, (1 << n) - 1) for n in (8, 16, 32, 64))
i16, i32, i64 = (st.integers(-(1 << n), (1 << n) - 1) for n in (15, 31, 63))
ascii_text = st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=50)
names = st.text(st.characters(min_codepoint=48, max_codepoint=90), min_size=1, max_size=10)
messages = st.one_of(
    st.builds(Heartbeat, u8, u8, u8, u32, u8),
    st.builds(Attitude, u32, f32, f32, f32, f32, f32, f32),
    st.builds(AoaSsa, u64, f32, f32),
    st.builds(VfrHud, f32, f32, i16, u16, f32, f32),
    st.builds(ServoOutputRaw, u32, u16),
    st.builds(HilActuatorControls, u64, f32),
    st.builds(NamedValueFloat, u32, names, f32),
    st.builds(NamedValueInt, u32, names, i32),
    st.builds(Timesync, i64, i64),
    st.builds(StatusText, u8, ascii_text),
)
NAN, INF = math.nan, math.inf
GOOD = AoaSsa(123_456, 1.5, -0.5)
EXAMPLES = [
    Heartbeat(1, 8, 0, 0, 4),
    Attitude(1000, 0.125, -0.25, 0.375, -0.5, 0.625, -0.75),
    GOOD,
    VfrHud(100.0, 101.0, 359, 50, 1600.0, -1.5),
    ServoOutputRaw(4_000_000_000, 1500),
    HilActuatorControls(1 << 40, -0.25),
    NamedValueInt(77, "DELAY_K", 3),
    Timesync(0, 1_042_000_000_000),
    StatusText(6, "hello"),
    NamedValueFloat(78, "D_MEAN", 2.25),
]


def pair() -> tuple[Wire, Wire]:
    """Return the plant's and the autopilot's end."""
    return Wire(PLANT, AUTOPILOT), Wire(AUTOPILOT, PLANT)


def native(source: tuple[int, int] = PLANT) -> dialect.MAVLink:
    return dialect.MAVLink(None, srcSystem=source[0], srcComponent=source[1])


def as_pymavlink(message) -> dict[str, object]:
    """Return what pymavlink shall read in a message of ours."""
    match message:
        case ServoOutputRaw():
            return {"time_usec": message.time_usec, "servo2_raw": message.servo2_raw, "servo1_raw": 0}
        case HilActuatorControls():
            return {"time_usec": message.time_usec, "controls": [0.0, message.elevator] + [0.0] * 14}
    return message._asdict()


@quick
@given(st.lists(messages, min_size=1, max_size=10))
def test_a_plain_mavlink_parser_reads_our_frames_with_equal_fields(sent):
    plant, _ = pair()
    parsed = parse(b"".join(plant.encode(m) for m in sent))
    assert len(parsed) == len(sent)
    for ours, theirs in zip(sent, parsed, strict=True):
        assert (theirs.get_srcSystem(), theirs.get_srcComponent()) == PLANT
        for name, value in as_pymavlink(ours).items():
            assert getattr(theirs, name) == value, (type(ours), name)


@quick
@given(st.lists(messages, min_size=1, max_size=20))
def test_frames_of_one_end_are_the_same_messages_at_the_other(sent):
    plant, autopilot = pair()
    assert [m for ours in sent for m in autopilot.decode(plant.encode(ours))] == sent
    assert autopilot.received == plant.sent == len(sent)
    assert not autopilot.rejects


def test_sequence_numbers_are_consecutive_and_wrap_after_255():
    plant, _ = pair()
    parsed = parse(b"".join(plant.encode(GOOD) for _ in range(600)))
    assert [m.get_seq() for m in parsed] == [n % 256 for n in range(600)]


def test_frames_are_mavlink_2():
    plant, _ = pair()
    assert all(plant.encode(m)[0] == 0xFD for m in EXAMPLES)


def test_frames_packed_by_pymavlink_are_read_by_field():
    theirs = [
        dialect.MAVLink_heartbeat_message(1, 3, 81, 7, 4, 3),
        dialect.MAVLink_attitude_message(42, 0.5, 0.25, -1.0, 2.0, -0.125, 0.75),
        dialect.MAVLink_aoa_ssa_message(1 << 41, 3.5, -1.25),
        dialect.MAVLink_vfr_hud_message(100.5, 99.5, -1, 42, 1600.0, 2.5),
        dialect.MAVLink_servo_output_raw_message(0xFFFFFFFF, 1, 1100, 1200, 1300, 1400, 1500, 1600, 1700, 1800),
        dialect.MAVLink_hil_actuator_controls_message(9, [n / 16 for n in range(16)], 129, 0),
        dialect.MAVLink_named_value_float_message(6, b"TEN_LETTER", -0.375),
        dialect.MAVLink_named_value_int_message(5, b"SAMPLE_K", -7),
        dialect.MAVLink_timesync_message(-3, 1 << 60),
        dialect.MAVLink_statustext_message(4, b"fifty".ljust(50, b"!")),
    ]
    mavlink, (_, autopilot) = native(), pair()
    assert autopilot.decode(b"".join(m.pack(mavlink) for m in theirs)) == [
        Heartbeat(1, 3, 81, 7, 4),
        Attitude(42, 0.5, 0.25, -1.0, 2.0, -0.125, 0.75),
        AoaSsa(1 << 41, 3.5, -1.25),
        VfrHud(100.5, 99.5, -1, 42, 1600.0, 2.5),
        ServoOutputRaw(0xFFFFFFFF, 1200),
        HilActuatorControls(9, 1 / 16),
        NamedValueFloat(6, "TEN_LETTER", -0.375),
        NamedValueInt(5, "SAMPLE_K", -7),
        Timesync(-3, 1 << 60),
        StatusText(4, "fifty".ljust(50, "!")),
    ]


def test_mavlink_1_frames_of_the_peer_are_read_too():
    _, autopilot = pair()
    frame = dialect.MAVLink_attitude_message(42, 0.5, 0.25, -1.0, 2.0, -0.125, 0.75).pack(native(), force_mavlink1=True)
    assert frame[0] == 0xFE
    assert autopilot.decode(bytes(frame)) == [Attitude(42, 0.5, 0.25, -1.0, 2.0, -0.125, 0.75)]


def test_times_wrap_on_the_wire_as_u32():
    plant, autopilot = pair()
    for message, name in (
        (EXAMPLES[1], "time_boot_ms"),
        (EXAMPLES[4], "time_usec"),
        (EXAMPLES[6], "time_boot_ms"),
        (EXAMPLES[-1], "time_boot_ms"),
    ):
        [back] = autopilot.decode(plant.encode(message._replace(**{name: (1 << 32) + 9})))
        assert getattr(back, name) == 9


def test_text_is_cut_at_50_characters_and_made_ascii():
    plant, autopilot = pair()
    assert autopilot.decode(plant.encode(StatusText(4, "α" + "x" * 60))) == [StatusText(4, "?" + "x" * 49)]


@quick
@given(st.binary(max_size=2500), messages)
def test_no_datagram_touches_the_next_one(noise, message):
    plant, autopilot = pair()
    autopilot.decode(noise)
    assert autopilot.decode(plant.encode(message)) == [message]


@quick
@given(messages, st.data())
def test_a_cut_frame_is_counted_and_does_not_touch_the_next_one(message, data):
    plant, autopilot = pair()
    frame = plant.encode(message)
    assert autopilot.decode(frame[: data.draw(st.integers(1, len(frame) - 1))]) == []
    assert autopilot.rejects == {Reject.TRUNCATED: 1}
    assert autopilot.decode(frame) == [message]


@pytest.mark.parametrize("bad", [NAN, INF, -INF])
@pytest.mark.parametrize(
    ("message", "name"),
    [(m, n) for m in EXAMPLES for n in CODECS[type(m)].floats],
    ids=lambda v: v if isinstance(v, str) else type(v).__name__,
)
def test_what_is_not_finite_is_dropped_and_counted(message, name, bad):
    plant, autopilot = pair()
    frame = plant.encode(message._replace(**{name: bad}))
    assert autopilot.decode(frame) == []
    assert autopilot.rejects == {Reject.NON_FINITE: 1}


def test_every_float_of_every_message_is_checked_for_being_finite():
    for message in EXAMPLES:
        floats = {name for name, value in message._asdict().items() if isinstance(value, float)}
        assert set(CODECS[type(message)].floats) == floats


@pytest.mark.parametrize("source", [(2, 25), (1, 24), (1, 1), (255, 190), (0, 0)])
def test_frames_of_others_are_dropped_and_counted(source):
    _, autopilot = pair()
    assert autopilot.decode(Wire(source, None).encode(GOOD)) == []
    assert autopilot.rejects == {Reject.WRONG_SOURCE: 1}


def test_a_wire_without_peer_takes_everybody_but_itself():
    wire = Wire(AUTOPILOT, None)
    assert wire.decode(Wire((255, 190), None).encode(GOOD)) == [GOOD]
    assert wire.decode(Wire(AUTOPILOT, None).encode(GOOD)) == []
    assert wire.rejects == {Reject.WRONG_SOURCE: 1}


def test_an_unknown_id_is_counted():
    _, autopilot = pair()
    unknown = next(n for n in range(60_000, 70_000) if n not in dialect.mavlink_map)
    frame = bytearray(Wire(PLANT, None).encode(GOOD))
    frame[7:10] = unknown.to_bytes(3, "little")
    assert autopilot.decode(bytes(frame)) == []
    assert autopilot.rejects == {Reject.UNKNOWN_ID: 1}


def test_a_known_id_that_nobody_here_serves_is_counted():
    _, autopilot = pair()
    assert autopilot.decode(dialect.MAVLink_ping_message(1, 2, 3, 4).pack(native())) == []
    assert autopilot.rejects == {Reject.UNHANDLED: 1}


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda m: type(m).__name__)
def test_every_flipped_bit_of_payload_and_checksum_is_found(message):
    plant, autopilot = pair()
    frame = plant.encode(message)
    for position in range(8 * 10, 8 * len(frame)):
        flipped = bytearray(frame)
        flipped[position // 8] ^= 1 << (position % 8)
        assert autopilot.decode(bytes(flipped)) == []
    assert autopilot.rejects == {Reject.BAD_CRC: 8 * (len(frame) - 10)}


def test_an_unknown_incompatibility_flag_makes_a_frame_malformed():
    plant, autopilot = pair()
    frame = bytearray(plant.encode(GOOD))
    frame[2] = 0x02
    assert autopilot.decode(bytes(frame)) == []
    assert autopilot.rejects == {Reject.MALFORMED: 1}


def test_an_oversized_datagram_is_not_looked_at():
    plant, autopilot = pair()
    frame = plant.encode(GOOD)
    assert autopilot.decode(frame * (2048 // len(frame) + 1)) == []
    assert autopilot.rejects == {Reject.OVERSIZE: 1}


def test_an_empty_datagram_is_nothing():
    _, autopilot = pair()
    assert autopilot.decode(b"") == []
    assert not autopilot.rejects


def test_one_bad_frame_among_several_costs_only_itself():
    plant, autopilot = pair()
    first, second, third = (plant.encode(m) for m in EXAMPLES[1:4])
    damaged = second[:12] + bytes([second[12] ^ 1]) + second[13:]
    assert autopilot.decode(first + damaged + third) == [EXAMPLES[1], EXAMPLES[3]]
    assert autopilot.rejects == {Reject.BAD_CRC: 1}


def test_noise_after_good_frames_costs_only_the_rest():
    plant, autopilot = pair()
    assert autopilot.decode(plant.encode(GOOD) + b"noise") == [GOOD]
    assert autopilot.rejects == {Reject.NO_FRAME: 1}


def test_20000_broken_frames_raise_nothing_and_are_all_counted():
    rng = np.random.default_rng(1)
    plant, autopilot = pair()
    datagrams = [broken(plant.encode(EXAMPLES[n % len(EXAMPLES)]), rng) for n in range(20_000)]
    assert [m for d in datagrams for m in autopilot.decode(d)] == []
    assert sum(autopilot.rejects.values()) >= sum(1 for d in datagrams if d)
    assert autopilot.decode(plant.encode(GOOD)) == [GOOD]


@quick
@given(st.lists(messages, max_size=8), st.binary(max_size=40))
def test_frames_and_rest_make_up_the_datagram(sent, rest):
    plant, _ = pair()
    packed = [plant.encode(m) for m in sent]
    frames, leftover = split_frames(b"".join(packed) + rest)
    assert frames[: len(packed)] == packed
    assert (b"".join(packed) + rest).startswith(b"".join(frames))
    assert (leftover is None) == (len(b"".join(frames)) == len(b"".join(packed) + rest))


@quick
@given(st.integers(1, 255), st.integers(0, 255))
def test_nan_payloads_of_any_bit_pattern_are_found(quiet, sign):
    plant, autopilot = pair()
    pattern = struct.unpack("<f", bytes([quiet, 0, 0x80, 0x7F | (sign & 0x80)]))[0]
    assert autopilot.decode(plant.encode(AoaSsa(1, pattern, 0.0))) == []
    assert autopilot.rejects == {Reject.NON_FINITE: 1}


def test_a_listener_latches_on_a_valid_frame_of_the_expected_source_only():
    accept = frames_of(PLANT)
    frame = Wire(PLANT, None).encode(GOOD)
    assert accept(frame)
    assert not accept(Wire(AUTOPILOT, None).encode(GOOD))
    assert not accept(frame[:-1] + bytes([frame[-1] ^ 1]))
    assert not accept(b"hello")
    assert not accept(b"")


def test_no_ground_station_takes_the_plant_for_a_vehicle():
    [seen] = parse(Wire(PLANT, None).encode(plant_heartbeat()))
    assert (seen.type, seen.autopilot) == (dialect.MAV_TYPE_FIXED_WING, dialect.MAV_AUTOPILOT_INVALID)


@pytest.mark.parametrize("flags", [0, 64, 64 | 16, 16 | 8 | 4, 16 | 8])
@pytest.mark.parametrize("armed", [False, True])
@pytest.mark.parametrize("degraded", [False, True])
def test_the_autopilot_is_a_fixed_wing_vehicle_whose_heartbeat_tells_its_state(armed, degraded, flags):
    beat = autopilot_heartbeat(armed=armed, custom_mode=10, flags=flags, degraded=degraded)
    [seen] = parse(Wire(AUTOPILOT, None).encode(beat))
    assert (seen.type, seen.autopilot) == (dialect.MAV_TYPE_FIXED_WING, dialect.MAV_AUTOPILOT_GENERIC)
    armed_bit = dialect.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0
    assert seen.base_mode == dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | armed_bit | flags
    assert seen.custom_mode == 10
    flying = dialect.MAV_STATE_CRITICAL if degraded else dialect.MAV_STATE_ACTIVE
    assert seen.system_status == (flying if armed else dialect.MAV_STATE_STANDBY)


def test_severities_are_mavlinks():
    for name in ("CRITICAL", "ERROR", "WARNING", "NOTICE", "INFO"):
        assert getattr(Severity, name) == getattr(dialect, f"MAV_SEVERITY_{name}")


# what one datagram may cost


@pytest.mark.parametrize("more", [0, 1, 7])
def test_a_datagram_is_read_up_to_its_most_frames_and_the_excess_is_counted(more):
    plant, autopilot = pair()
    sent = [Timesync(0, n) for n in range(1, MAX_FRAMES + more + 1)]
    assert autopilot.decode(b"".join(plant.encode(m) for m in sent)) == sent[:MAX_FRAMES]
    assert autopilot.rejects == ({Reject.EXCESS: more} if more else {})


def test_bad_frames_count_among_those_that_a_datagram_may_have():
    plant, autopilot = pair()
    bad = plant.encode(Timesync(0, 1))[:-1] + b"\0"
    assert autopilot.decode(bad * MAX_FRAMES + plant.encode(GOOD)) == []
    assert autopilot.rejects == {Reject.BAD_CRC: MAX_FRAMES, Reject.EXCESS: 1}


# the messages of ground stations

STATION = (255, 190)
GROUND = get_args(ground.GroundMessage)
NUMBERS = {"float": f32, "double": f32, "char": st.integers(1, 127)}
NUMBERS |= {f"uint{n}_t": st.integers(0, (1 << n) - 1) for n in (8, 16, 32, 64)}
NUMBERS |= {f"int{n}_t": st.integers(-(1 << n - 1), (1 << n - 1) - 1) for n in (8, 16, 32, 64)}


def name_of(message: type) -> str:
    """Return the name that MAVLink has for a message type."""
    return re.sub(r"(?<!^)(?=[A-Z])", "_", message.__name__).upper()


def theirs_of(message: type):
    """Return pymavlink's class of a message type."""
    return getattr(development, f"MAVLink_{name_of(message).lower()}_message")


def values_of(message: type) -> st.SearchStrategy[dict[str, object]]:
    """Return values for all of a message's fields, by what pymavlink says of each, as pymavlink takes them."""
    theirs = theirs_of(message)
    ordered = dict(zip(theirs.ordered_fieldnames, theirs.array_lengths, strict=True))

    def field(name: str, kind: str) -> st.SearchStrategy[object]:
        length = ordered[name]
        if kind == "char":
            printable = st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=length)
            return printable.map(str.encode)
        return st.lists(NUMBERS[kind], min_size=length, max_size=length) if length else NUMBERS[kind]

    return st.fixed_dictionaries(
        {name: field(name, kind) for name, kind in zip(theirs.fieldnames, theirs.fieldtypes, strict=True)}
    )


def as_ours(message: type, values: dict[str, object]) -> object:
    """Return our message of such values."""
    convert = {"str": lambda v: v.decode(), "bytes": bytes}
    return message(**{f.name: convert.get(f.type, _frozen)(values[f.name]) for f in fields(message)})


def _frozen(value: object) -> object:
    return tuple(value) if isinstance(value, list) else value


def ends() -> tuple[Wire, Wire]:
    """Return a ground station's and the vehicle's end."""
    return Wire(STATION, None, GROUND_MESSAGES), Wire(AUTOPILOT, None, GROUND_MESSAGES)


@pytest.mark.parametrize("message", GROUND, ids=name_of)
@settings(deadline=None, max_examples=20)
@given(data=st.data())
def test_a_ground_message_is_read_by_pymavlink_and_by_us_with_equal_fields(message, data):
    values = data.draw(values_of(message))
    ours = as_ours(message, values)
    station, vehicle = ends()
    frame = vehicle.encode(ours)
    [theirs] = development.MAVLink(None).parse_buffer(bytearray(frame))
    assert (theirs.get_type(), theirs.get_msgId()) == (name_of(message), message_id(message))
    known = {f.name for f in fields(message)}
    for name, kind, length in zip(theirs.fieldnames, theirs.fieldtypes, lengths_of(theirs), strict=True):
        read = getattr(theirs, name)
        if name not in known:  # not sent, which is zero
            assert read == ([0] * length if length else 0), name
        elif kind == "char":
            assert read == values[name].decode(), name
        else:
            assert read == values[name], name
    assert station.decode_from(frame) == [(AUTOPILOT, ours)]


def lengths_of(theirs) -> list[int]:
    """Return the array lengths of a message of pymavlink's in the order of its fields."""
    by_name = dict(zip(theirs.ordered_fieldnames, theirs.array_lengths, strict=True))
    return [by_name[name] for name in theirs.fieldnames]


@pytest.mark.parametrize("message", GROUND, ids=name_of)
@settings(deadline=None, max_examples=20)
@given(data=st.data())
def test_a_ground_message_of_pymavlinks_is_read_whatever_its_other_fields_hold(message, data):
    values = data.draw(values_of(message))
    packer = development.MAVLink(None, srcSystem=STATION[0], srcComponent=STATION[1])
    frame = theirs_of(message)(**values).pack(packer)
    _, vehicle = ends()
    assert vehicle.decode_from(bytes(frame)) == [(STATION, as_ours(message, values))]
    assert not vehicle.rejects


def test_the_control_link_and_the_ground_speak_of_different_things():
    assert frozenset(GROUND) | {Heartbeat, Timesync} == GROUND_MESSAGES
    assert {Heartbeat, Timesync} == CONTROL_MESSAGES & GROUND_MESSAGES
    vehicle = Wire(AUTOPILOT, None, GROUND_MESSAGES)
    for message in EXAMPLES:
        read = vehicle.decode(Wire(STATION, None).encode(message))
        assert read == ([message] if type(message) in GROUND_MESSAGES else [])
    assert vehicle.rejects == {Reject.UNHANDLED: len(EXAMPLES) - 2}


def test_a_parameter_of_a_command_that_is_not_used_may_be_nan():
    command = dialect.MAVLink_command_long_message(1, 1, 512, 0, 148.0, *[NAN] * 6)
    [read] = Wire(AUTOPILOT, None, GROUND_MESSAGES).decode(command.pack(native(STATION)))
    assert (read.param1, math.isnan(read.param2), math.isnan(read.param7)) == (148.0, True, True)


def test_text_that_is_not_ascii_is_marked_and_not_refused():
    asked = dialect.MAVLink_param_request_read_message(1, 1, b"RATE_\xff\x80", -1)
    [read] = Wire(AUTOPILOT, None, GROUND_MESSAGES).decode(asked.pack(native(STATION)))
    assert read.param_id == "RATE_\ufffd\ufffd"


PREFIXES = {
    ground.MavCmd: ("MAV_CMD_",),
    ground.MavResult: ("MAV_RESULT_",),
    ground.ParamErrorCode: ("MAV_PARAM_ERROR_",),
    ground.Capability: ("MAV_PROTOCOL_CAPABILITY_",),
    ground.SensorBit: ("MAV_SYS_STATUS_", "MAV_SYS_STATUS_SENSOR_", "MAV_SYS_STATUS_SENSOR_3D_"),
}


@pytest.mark.parametrize(
    "member", [member for enum in PREFIXES for member in enum], ids=lambda m: f"{type(m).__name__}.{m.name}"
)
def test_the_numbers_of_commands_results_and_bits_are_the_dialects(member: IntEnum) -> None:
    names = [f"{prefix}{member.name}" for prefix in PREFIXES[type(member)]]
    [number] = {getattr(dialect, name) for name in names if hasattr(dialect, name)}
    assert member == number


# seals

KEY = bytes(range(32))
NOW = 37_500_000_000_000


def sealed(source: tuple[int, int], peer: tuple[int, int] | None, key: bytes = KEY, link: int = 0) -> Wire:
    return Wire(source, peer, seal=Signing(key, link, NOW))


def signing(source: tuple[int, int] = PLANT, key: bytes = KEY) -> dialect.MAVLink:
    """Return pymavlink's own end of a signed link."""
    end = native(source)
    end.signing.secret_key = key
    end.signing.timestamp = NOW
    end.signing.sign_outgoing = True
    return end


@quick
@given(st.lists(messages, min_size=1, max_size=10))
def test_sealed_frames_are_accepted_by_pymavlink_and_by_the_other_end(sent):
    plant, autopilot, parser = sealed(PLANT, AUTOPILOT), sealed(AUTOPILOT, PLANT), signing()
    datagram = b"".join(plant.encode(m) for m in sent)
    assert [m.get_msgId() for m in parser.parse_buffer(bytearray(datagram))] == [message_id(type(m)) for m in sent]
    assert parser.signing.goodsig_count == len(sent)
    assert autopilot.decode(datagram) == sent
    assert not autopilot.rejects


def test_frames_that_pymavlink_signs_are_accepted_once():
    end, autopilot = signing(), sealed(AUTOPILOT, PLANT)
    frames = [bytes(dialect.MAVLink_timesync_message(n, 2).pack(end)) for n in range(1, 20)]
    assert [m for f in frames for m in autopilot.decode(f)] == [Timesync(n, 2) for n in range(1, 20)]
    assert [m for f in frames for m in autopilot.decode(f)] == []
    assert autopilot.rejects == {Reject.REPLAYED: 19}


def test_a_seal_refuses_what_is_not_signed_or_signed_with_another_key():
    autopilot = sealed(AUTOPILOT, PLANT)
    assert autopilot.decode(Wire(PLANT, None).encode(GOOD) + sealed(PLANT, None, bytes(32)).encode(GOOD)) == []
    assert autopilot.rejects == {Reject.UNSIGNED: 1, Reject.BAD_SIGNATURE: 1}
    assert autopilot.decode(sealed(PLANT, None).encode(GOOD)) == [GOOD]


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda m: type(m).__name__)
def test_a_sealed_frame_with_any_flipped_bit_is_refused_and_the_frame_itself_is_still_accepted(message):
    plant, autopilot = sealed(PLANT, AUTOPILOT), sealed(AUTOPILOT, PLANT)
    frame = plant.encode(message)
    for position in range(8 * len(frame)):
        flipped = bytearray(frame)
        flipped[position // 8] ^= 1 << position % 8
        assert autopilot.decode(bytes(flipped)) == [], position
    assert autopilot.decode(frame) == [message]


def test_a_wire_without_a_seal_reads_signed_frames_too():
    _, autopilot = pair()
    assert autopilot.decode(sealed(PLANT, None).encode(GOOD) * 2) == [GOOD, GOOD]


class Saying:
    """A seal that says one word of every frame, and keeps what it was asked."""

    def __init__(self, word: StrEnum) -> None:
        self.word = word
        self.asked: list[bytes] = []

    def sign(self, frame: bytes) -> bytes:
        return frame

    def check(self, frame: bytes) -> StrEnum:
        self.asked.append(frame)
        return self.word

    def would_accept(self, frame: bytes) -> bool:
        return self.word is Verdict.ACCEPTED

    def tick(self, now_ns: int) -> None:
        pass


@pytest.mark.parametrize("verdict", Verdict)
def test_whatever_a_seal_says_is_counted_by_its_word(verdict):
    autopilot = Wire(AUTOPILOT, PLANT, seal=Saying(verdict))
    read = autopilot.decode(Wire(PLANT, None).encode(GOOD))
    if verdict is Verdict.ACCEPTED:
        assert (read, autopilot.rejects) == ([GOOD], {})
    else:
        assert read == []
        [(reject, count)] = autopilot.rejects.items()
        assert (str(reject), count) == (str(verdict), 1)


def test_a_seal_is_not_asked_about_what_is_dropped_without_it():
    seal = Saying(Verdict.ACCEPTED)
    autopilot = Wire(AUTOPILOT, PLANT, seal=seal)
    frame = Wire(PLANT, None).encode(GOOD)
    ping = bytes(dialect.MAVLink_ping_message(1, 2, 3, 4).pack(native()))
    for datagram in (frame[:-1] + bytes([frame[-1] ^ 1]), Wire(STATION, None).encode(GOOD), ping, frame[:-2], b"noise"):
        assert autopilot.decode(datagram) == []
    assert seal.asked == []


def test_a_listener_with_a_seal_latches_on_new_and_genuine_frames_only_and_uses_none_up():
    seal = Signing(KEY, 0, NOW)
    accept = frames_of(PLANT, seal)
    frame = sealed(PLANT, None).encode(GOOD)
    assert not accept(Wire(PLANT, None).encode(GOOD))
    assert not accept(sealed(PLANT, None, bytes(32)).encode(GOOD))
    assert accept(frame)
    assert accept(frame)
    assert Wire(AUTOPILOT, PLANT, seal=seal).decode(frame) == [GOOD]
    assert not accept(frame)
