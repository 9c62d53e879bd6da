"""Parameters over MAVLink and on disk; bytes are pymavlink's, and so is one of the clients."""

from __future__ import annotations

import math
import re
import struct
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest
import tomli_w
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from pymavlink import mavparm
from pymavlink.dialects.v20 import ardupilotmega as dialect

from autopilot.config import AutopilotConfig
from autopilot.ground.parameterfile import ParameterFile
from autopilot.ground.parameters import MAX_REASON, PARAM_TYPE, Answer, Parameters
from autopilot.ground.parameters_page import COMMAND, PATH, page
from autopilot.ground.parametertable import BY_NAME, MAX_NAME, MAX_WHOLE, PARAMETERS, canonical, disorder
from autopilot.link.groundmessages import ParamError, ParamErrorCode, ParamRequestRead, ParamSet, ParamValue
from autopilot.link.wire import AUTOPILOT, GROUND_MESSAGES, Wire
from gains.table import InputError, Table
from tests.helpers import HIRM, S, parse

quick = settings(deadline=None)
GCS = (255, 190)
NAMES = ("hirm-d3", "hirm-d4", "hirm-d6")
OPEN = {"DELAY_MIN": 1, "DELAY_MAX": 4, "ELEV_LOW_DEG": -25, "ELEV_HIGH_DEG": 25}
COUNT = len(PARAMETERS)
INTEGER_TYPES = [1, 2, 3, 4, 5, 6, 7, 8]
"""MAV_PARAM_TYPE_UINT8 to _INT64."""
FLT_MAX = 3.4028234663852886e38

float32s = st.floats(width=32, allow_nan=True, allow_infinity=True)
names = st.sampled_from([each.name for each in PARAMETERS])


class Vehicle:
    """What is asked before a value counts: it notes everything, and refuses what it is told to refuse."""

    def __init__(self, **refusals: str) -> None:
        self.refusals = refusals
        self.asked: list[tuple[str, float, int]] = []

    def __call__(self, values: Mapping[str, float], name: str, now_ns: int) -> str | None:
        self.asked.append((name, values[name], now_ns))
        return self.refusals.get(name)


def make(vehicle: Vehicle | None = None, ports: tuple[str, ...] = ("gcs0",), **defaults: float) -> Parameters:
    return Parameters(OPEN | defaults, vehicle or Vehicle(), ports=ports, names=NAMES)


def put(parameters: Parameters, name: str, value: float, kind: int = PARAM_TYPE) -> Answer:
    return parameters.handle(ParamSet(1, 1, name, value, kind), GCS, 7)


def get(parameters: Parameters, name: str = "", index: int = -1) -> Answer:
    return parameters.handle(ParamRequestRead(1, 1, name, index), GCS, 7)


def sent(message: ParamValue | ParamError) -> dialect.MAVLink_message:
    """Return a message as pymavlink reads it off the wire."""
    (read,) = parse(Wire(AUTOPILOT, None).encode(message))
    return read


def packed(message: dialect.MAVLink_message) -> ParamSet | ParamRequestRead:
    """Return a ground station's message, packed by pymavlink, as the vehicle reads it."""
    frame = message.pack(dialect.MAVLink(None, *GCS))
    (read,) = Wire(AUTOPILOT, None, GROUND_MESSAGES).decode(frame)
    assert isinstance(read, ParamSet | ParamRequestRead)
    return read


def as_float32(value: float) -> float:
    return struct.unpack("<f", struct.pack("<f", value))[0]


def refused(answer: Answer, name: str, value: float, code: ParamErrorCode) -> str:
    """Check a refusal of a parameter that exists, and return its reason."""
    error, unchanged = answer.to_asker
    assert error == ParamError(*GCS, name, -1, code)
    assert isinstance(unchanged, ParamValue)
    assert (unchanged.param_id, unchanged.param_value) == (name, value)
    assert answer.to_all == ()
    assert answer.reason is not None
    assert 0 < len(answer.reason) <= MAX_REASON
    return answer.reason


def loaded(parameters: Parameters, text: str) -> tuple[str, ...]:
    return parameters.load(Table.parse(text.encode(), "p.toml"), 9)


# the table


def test_every_parameter_fits_its_wire_and_its_own_range():
    assert len(BY_NAME) == COUNT <= 1 << 15
    for each in PARAMETERS:
        assert re.fullmatch(rf"[A-Z][A-Z0-9_]{{0,{MAX_NAME - 1}}}", each.name)
        assert each.meaning.endswith(".")
        assert each.default is None or each.low <= each.default <= each.high
        assert each.kind == "float" or max(abs(each.low), abs(each.high)) <= MAX_WHOLE


def test_the_failsafe_s_defaults_are_those_of_the_command_line():
    config = AutopilotConfig(HIRM)
    assert BY_NAME["FS_HOLD_S"].default == config.hold_ns / S
    assert BY_NAME["FS_SAT_S"].default == config.saturation_ns / S
    assert BY_NAME["FS_GCS_S"].default == config.ground_timeout_ns / S


@quick
@given(st.floats(width=32, allow_nan=False, allow_infinity=False))
@example(as_float32(0.1))
@example(as_float32(16777217.0))
@example(FLT_MAX)
def test_a_value_is_the_shortest_decimal_of_its_32_bits(value):
    decimal = canonical(value)
    assert as_float32(decimal) == value
    assert canonical(decimal) == decimal
    digits = len(re.sub(r"e.*|[-.]", "", repr(decimal)).strip("0"))
    assert digits <= 1 or as_float32(float(f"{value:.{digits - 1}g}")) != value
    assert math.copysign(1.0, canonical(-0.0)) == 1.0


# reading


def test_every_value_is_read_by_name_and_by_index_as_a_float():
    parameters = make()
    for index, each in enumerate(PARAMETERS):
        value = OPEN.get(each.name, each.default)
        for name, number in ((each.name.encode(), -1), (b"", index)):
            request = packed(dialect.MAVLink_param_request_read_message(1, 1, name, number))
            answer = parameters.handle(request, GCS, 0)
            assert (answer.to_all, answer.reason) == ((), None)
            (read,) = map(sent, answer.to_asker)
            assert (read.param_id, read.param_value) == (each.name, as_float32(value))
            assert read.param_type == dialect.MAV_PARAM_TYPE_REAL32
            assert (read.param_index, read.param_count) == (index, COUNT)


def test_an_index_counts_more_than_a_name():
    (value,) = get(make(), "DELAY_MAX", 0).to_asker
    assert value.param_id == "GAINS"


@quick
@given(st.text(max_size=16).filter(lambda name: name not in BY_NAME))
@example("")
@example("gains")
@example("GAINS ")
@example("GAINS\n")
@example("DELAY_MAXDELAY_M")
def test_a_name_that_is_not_exactly_one_of_the_table_does_not_exist(name):
    vehicle = Vehicle()
    parameters = make(vehicle)
    before = parameters.values
    for answer in (get(parameters, name), put(parameters, name, 1.0)):
        (error,) = answer.to_asker
        assert error == ParamError(*GCS, name, -1, ParamErrorCode.DOES_NOT_EXIST)
        assert sent(error).error == dialect.MAV_PARAM_ERROR_DOES_NOT_EXIST
        assert answer.to_all == ()
        assert answer.reason is not None
        assert len(answer.reason) <= MAX_REASON
        assert answer.reason.isascii()
        assert answer.reason.isprintable()
    assert parameters.values is before
    assert vehicle.asked == []


@pytest.mark.parametrize("index", [-32768, -2, COUNT, 32767])
def test_an_index_outside_the_table_does_not_exist(index):
    answer = get(make(), "GAINS", index)
    (error,) = answer.to_asker
    assert error == ParamError(*GCS, "", index, ParamErrorCode.DOES_NOT_EXIST)
    assert answer.reason == f"parameter {index}: expected 0 to {COUNT - 1}"


# lists


def test_a_list_goes_out_in_portions_to_each_station_at_its_own_pace():
    parameters = make(ports=("gcs0", "gcs1"))
    assert parameters.next_values("gcs0", 5) == ()
    parameters.request_list("gcs0")
    first = parameters.next_values("gcs0", 5)
    parameters.request_list("gcs1")
    assert [parameters.pending(port) for port in ("gcs0", "gcs1")] == [COUNT - 5, COUNT]
    received = {"gcs0": list(first), "gcs1": []}
    for port, portion in [("gcs1", 3), ("gcs0", 4)] * COUNT:
        values = parameters.next_values(port, portion)
        assert len(values) <= portion
        received[port] += values
    for values in received.values():
        assert [v.param_id for v in values] == [each.name for each in PARAMETERS]
        assert [v.param_index for v in values] == list(range(COUNT))
        assert {v.param_count for v in values} == {COUNT}
    assert [parameters.pending(port) for port in ("gcs0", "gcs1")] == [0, 0]


def test_a_repeated_request_gives_that_station_the_whole_list_again_behind_what_waits_and_no_other():
    parameters = make(ports=("gcs0", "gcs1"))
    parameters.request_list("gcs0")
    parameters.request_list("gcs1")
    parameters.next_values("gcs0", 7)
    parameters.next_values("gcs1", 7)
    for _ in range(1000):
        parameters.request_list("gcs0")
    assert parameters.pending("gcs0") == COUNT
    whole = [v.param_index for v in parameters.next_values("gcs0", COUNT)]
    assert whole == [*range(7, COUNT), *range(7)]
    assert [v.param_index for v in parameters.next_values("gcs1", 2)] == [7, 8]


def test_a_list_over_a_link_that_loses_half_is_completed_by_index():
    parameters = make()
    parameters.request_list("gcs0")
    heard = {v.param_index: v for v in parameters.next_values("gcs0", COUNT) if v.param_index % 2}
    assert len(heard) == COUNT // 2
    for missing in set(range(COUNT)) - heard.keys():
        (heard[missing],) = get(parameters, index=missing).to_asker
    assert {v.param_id: v.param_value for v in heard.values()} == parameters.values


def test_a_list_that_is_under_way_shows_values_as_they_are_when_sent():
    parameters = make()
    parameters.request_list("gcs0")
    put(parameters, PARAMETERS[-1].name, 3.0)
    assert parameters.next_values("gcs0", COUNT)[-1].param_value == 3.0


def test_news_waits_once_for_each_station_however_often_it_comes():
    parameters = make(ports=("gcs0", "gcs1"))
    parameters.request_list("gcs0")
    for _ in range(100):
        parameters.announce(iter(["STICK_DEG", "RATE_ATT"]))
    assert [parameters.pending(port) for port in ("gcs0", "gcs1")] == [COUNT, 2]
    assert [v.param_id for v in parameters.next_values("gcs1", 9)] == ["STICK_DEG", "RATE_ATT"]


# setting


@quick
@given(names, st.data())
def test_a_value_in_range_counts_and_is_told_to_all(name, data):
    limits = make().table[name]
    if limits.kind == "float":
        value = data.draw(st.floats(as_float32(limits.low), as_float32(limits.high), width=32))
    else:
        value = float(data.draw(st.integers(int(limits.low), int(limits.high))))
    vehicle = Vehicle()
    parameters = make(vehicle)
    before = parameters.values
    after = {**before, name: canonical(value)}
    answer = parameters.handle(
        packed(dialect.MAVLink_param_set_message(1, 1, name.encode(), value, dialect.MAV_PARAM_TYPE_REAL32)), GCS, 7
    )
    if disorder(after) is not None:
        refused(answer, name, before[name], ParamErrorCode.VALUE_OUT_OF_RANGE)
        return
    assert (answer.to_asker, answer.reason) == ((), None)
    (told,) = map(sent, answer.to_all)
    assert (told.param_id, told.param_value) == (name, value)
    assert parameters.values == after
    assert vehicle.asked == ([] if before[name] == canonical(value) else [(name, canonical(value), 7)])


@quick
@given(names, float32s)
@example("ELEV_HIGH_DEG", -FLT_MAX)
@example("ELEV_HIGH_DEG", as_float32(-90.00001))
@example("ELEV_LOW_DEG", as_float32(-1.2345678e-5))
@example("REF_TIME_S", as_float32(0.1))
@example("ARM_CERT", 0.5)
@example("GAINS", 3.0)
@example("DELAY_MIN", 5.0)
def test_whatever_is_sent_no_value_leaves_its_range_or_order(name, value):
    parameters = make()
    before = parameters.values
    answer = put(parameters, name, value)
    limits = parameters.table[name]
    for each in parameters.table.values():
        found = parameters.value(each.name)
        assert each.low <= found <= each.high
        assert each.kind == "float" or found == int(found)
    assert disorder(parameters.values) is None
    if answer.reason is None:
        assert as_float32(parameters.value(name)) == value
    else:
        reason = refused(answer, name, before[name], ParamErrorCode.VALUE_OUT_OF_RANGE)
        assert parameters.values is before
        assert reason.startswith(f"{name} ")
        assert "expected" in reason
        fits = math.isfinite(value) and limits.low <= canonical(value) <= limits.high
        assert not fits or limits.kind != "float" or name.startswith("ELEV")


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("FS_HOLD_S", math.nan, "FS_HOLD_S nan: expected a finite number"),
        ("FS_HOLD_S", math.inf, "FS_HOLD_S inf: expected a finite number"),
        ("FS_HOLD_S", -math.inf, "FS_HOLD_S -inf: expected a finite number"),
        ("FS_HOLD_S", 60.5, "FS_HOLD_S 60.5: expected 0 to 60"),
        ("FS_HOLD_S", 1e300, "FS_HOLD_S inf: expected a finite number"),
        ("REF_TIME_S", as_float32(0.09), "REF_TIME_S 0.09: expected 0.1 to 60"),
        ("GAINS", 1.5, "GAINS 1.5: expected a whole number"),
        ("GAINS", 3.0, "GAINS 3: expected 0 to 2"),
        ("GAINS", -1.0, "GAINS -1: expected 0 to 2"),
        ("DELAY_MAX", 201.0, "DELAY_MAX 201: expected 1 to 200"),
        ("ARM_CERT", 2.0, "ARM_CERT 2: expected 0 or 1"),
        ("ARM_CERT", 0.5, "ARM_CERT 0.5: expected 0 or 1"),
        ("DELAY_MIN", 5.0, "DELAY_MIN 5: expected at most DELAY_MAX"),
        ("ELEV_LOW_DEG", 25.0, "ELEV_LOW_DEG 25: expected below ELEV_HIGH_DEG"),
        ("ELEV_HIGH_DEG", -25.0, "ELEV_HIGH_DEG -25: expected above ELEV_LOW_DEG"),
        ("ELEV_HIGH_DEG", -FLT_MAX, "ELEV_HIGH_DEG -3.4028235e+38: expected -90 to 90"),
    ],
)
def test_a_refusal_says_what_was_found_and_what_was_expected(name, value, reason):
    vehicle = Vehicle()
    parameters = make(vehicle)
    answer = put(parameters, name, value)
    assert refused(answer, name, parameters.defaults[name], ParamErrorCode.VALUE_OUT_OF_RANGE) == reason
    assert vehicle.asked == []


def test_least_and_greatest_delay_may_be_equal():
    parameters = make()
    assert put(parameters, "DELAY_MIN", 4.0).reason is None
    reason = put(parameters, "DELAY_MAX", 3.0).reason
    assert reason == "DELAY_MAX 3: expected at least DELAY_MIN"


def test_a_refusal_by_the_vehicle_keeps_the_value_and_gives_its_reason():
    vehicle = Vehicle(GAINS="hirm-d4: armed, and no verified certificate")
    parameters = make(vehicle)
    reason = refused(put(parameters, "GAINS", 1.0), "GAINS", 0.0, ParamErrorCode.PERMISSION_DENIED)
    assert reason == "hirm-d4: armed, and no verified certificate"
    assert vehicle.asked == [("GAINS", 1.0, 7)]
    assert parameters.value("GAINS") == 0.0


def test_the_error_precedes_the_old_value_on_the_wire():
    error, value = map(sent, put(make(), "STICK_DEG", 91.0).to_asker)
    assert (error.get_type(), value.get_type()) == ("PARAM_ERROR", "PARAM_VALUE")
    assert (error.target_system, error.target_component, error.param_id) == (*GCS, "STICK_DEG")
    assert error.error == dialect.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE
    assert (value.param_id, value.param_value) == ("STICK_DEG", 15.0)


def test_the_vehicle_is_asked_before_a_value_counts():
    seen = []

    def change(values: Mapping[str, float], name: str, now_ns: int) -> None:
        seen.append((values[name], parameters.value(name)))

    parameters = Parameters(OPEN, change, ports=(), names=NAMES)
    held = parameters.values
    put(parameters, "STICK_DEG", 20.0)
    assert seen == [(20.0, 15.0)]
    assert (held["STICK_DEG"], parameters.values["STICK_DEG"]) == (15.0, 20.0)
    with pytest.raises(TypeError):
        parameters.values["STICK_DEG"] = 30.0


def test_the_same_value_again_is_taken_without_asking():
    vehicle = Vehicle()
    parameters = make(vehicle)
    for _ in range(3):
        assert put(parameters, "REF_TIME_S", as_float32(0.3)).to_all[0].param_value == 0.3
    assert vehicle.asked == [("REF_TIME_S", 0.3, 7)]
    vehicle.refusals["REF_TIME_S"] = "no"
    assert put(parameters, "REF_TIME_S", as_float32(0.3)).reason is None


def test_minus_zero_is_zero():
    parameters = make()
    for name in ("FS_HOLD_S", "GAINS", "ARM_CERT"):
        assert put(parameters, name, -0.0).reason is None
        assert math.copysign(1.0, parameters.value(name)) == 1.0


@pytest.mark.parametrize("kind", [0, *INTEGER_TYPES, 10, 11, 255])
def test_a_value_that_is_no_32_bit_float_is_refused_even_where_it_would_fit(kind):
    vehicle = Vehicle()
    reason = refused(put(make(vehicle), "DELAY_MAX", 3.0, kind), "DELAY_MAX", 4.0, ParamErrorCode.VALUE_OUT_OF_RANGE)
    assert reason == f"DELAY_MAX of type {kind}: expected a float (9)"
    assert vehicle.asked == []


class Client:
    """The link of pymavlink's own parameter client, which gets its answers from the vehicle at once."""

    def __init__(self, parameters: Parameters) -> None:
        self.parameters = parameters
        self.heard: list[dialect.MAVLink_message] = []

    def param_set_send(self, name: str, value: float, parm_type: int | None = None) -> None:
        kind = dialect.MAVLINK_TYPE_FLOAT if parm_type is None else parm_type
        message = dialect.MAVLink_param_set_message(1, 1, name.encode(), value, kind)
        answer = self.parameters.handle(packed(message), GCS, 0)
        self.heard += [m for m in map(sent, answer.to_asker + answer.to_all) if m.get_type() == "PARAM_VALUE"]

    def recv_match(self, type: str, blocking: bool) -> dialect.MAVLink_message | None:
        return self.heard.pop(0) if self.heard else None


def test_pymavlink_s_client_sets_floats_and_its_integers_are_told_apart_from_numbers():
    parameters = make()
    client = Client(parameters)
    assert mavparm.MAVParmDict().mavset(client, "DELAY_MAX", 3)
    assert parameters.value("DELAY_MAX") == 3.0
    assert mavparm.MAVParmDict().mavset(client, "FS_HOLD_S", "0.7")
    assert parameters.value("FS_HOLD_S") == 0.7
    assert mavparm.MAVParmDict().mavset(client, "DELAY_MAX", 2, parm_type=dialect.MAV_PARAM_TYPE_INT32)  # raw bytes
    assert parameters.value("DELAY_MAX") == 3.0


# many at once


def any_value(name: str) -> st.SearchStrategy[float | str | bool]:
    """Return the values that a file may hold."""
    each = BY_NAME[name]
    if name == "GAINS":
        return st.sampled_from(NAMES)
    if each.kind == "bool":
        return st.booleans()
    if each.kind == "int":
        return st.integers(int(each.low), int(each.high))
    return st.floats(each.low, each.high)


@quick
@given(st.fixed_dictionaries({}, optional={name: any_value(name) for name in BY_NAME}))
def test_what_is_kept_comes_back_exactly(kept):
    given_values = {name: NAMES.index(value) if name == "GAINS" else canonical(value) for name, value in kept.items()}
    vehicle = Vehicle()
    parameters = make(vehicle)
    expected = parameters.defaults | given_values
    assume(disorder(expected) is None)
    loaded(parameters, tomli_w.dumps(kept))
    assert parameters.values == expected
    again = make()
    changed = loaded(again, tomli_w.dumps(parameters.as_table()))
    assert again.values == expected
    assert set(changed) == parameters.as_table().keys() == {name for name, _, _ in vehicle.asked}


def test_a_file_keeps_only_what_is_not_the_default_and_gains_by_name():
    parameters = make()
    assert parameters.as_table() == {}
    put(parameters, "GAINS", 2.0)
    put(parameters, "ARM_CERT", 0.0)
    put(parameters, "DELAY_MAX", 3.0)
    put(parameters, "REF_TIME_S", as_float32(0.1))
    put(parameters, "STICK_DEG", 15.0)
    assert tomli_w.dumps(parameters.as_table()).splitlines() == [
        'GAINS = "hirm-d6"',
        "DELAY_MAX = 3",
        "REF_TIME_S = 0.1",
        "ARM_CERT = false",
    ]
    other = Parameters(OPEN, Vehicle(), ports=(), names=("hirm-d6", "hirm-d3"))
    loaded(other, tomli_w.dumps(parameters.as_table()))
    assert (other.value("GAINS"), other.value("REF_TIME_S")) == (0.0, 0.1)


def test_what_a_file_does_not_name_gets_its_default_again():
    vehicle = Vehicle()
    parameters = make(vehicle, STICK_DEG=12)
    put(parameters, "STICK_DEG", 20.0)
    put(parameters, "REF_MAX_DEG", 10.0)
    vehicle.asked.clear()
    assert loaded(parameters, "REF_MAX_DEG = 11\nDELAY_MAX = 4") == ("REF_MAX_DEG", "STICK_DEG")
    assert vehicle.asked == [("REF_MAX_DEG", 11.0, 9), ("STICK_DEG", 12.0, 9)]


def test_the_gain_set_given_at_start_need_not_be_the_first():
    parameters = make(GAINS=1)
    put(parameters, "GAINS", 0.0)
    assert parameters.as_table() == {"GAINS": "hirm-d3"}
    assert loaded(parameters, "") == ("GAINS",)
    assert parameters.value("GAINS") == 1.0


def test_two_values_that_are_in_order_only_together_are_taken_from_a_file():
    parameters = make()
    assert put(parameters, "DELAY_MIN", 5.0).reason is not None
    assert loaded(parameters, "DELAY_MIN = 5\nDELAY_MAX = 6") == ("DELAY_MIN", "DELAY_MAX")


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (
            "STICK_DEGR = 3",
            "p.toml: STICK_DEGR: expected one of GAINS, .*, found an unknown key; did you mean STICK_DE",
        ),
        ("stick_deg = 3", "p.toml: stick_deg: expected one of .*, found an unknown key"),
        ("STICK_DEG = 91", "p.toml: STICK_DEG: expected a number from 0 to 90, found 91"),
        ("STICK_DEG = nan", "p.toml: STICK_DEG: expected a finite number from 0 to 90, found nan"),
        ("STICK_DEG = inf", "p.toml: STICK_DEG: expected a finite number from 0 to 90, found inf"),
        ('STICK_DEG = "3"', 'p.toml: STICK_DEG: expected a number from 0 to 90, found the string "3"'),
        ("DELAY_MAX = 3.0", "p.toml: DELAY_MAX: expected an integer from 1 to 200, found 3.0"),
        ("DELAY_MAX = 0", "p.toml: DELAY_MAX: expected an integer from 1 to 200, found 0"),
        ("ARM_CERT = 1", "p.toml: ARM_CERT: expected true or false, found 1"),
        ('GAINS = "hirm-d5"', 'p.toml: GAINS: expected one of hirm-d3, hirm-d4, hirm-d6, found the string "hirm-d5"'),
        ("GAINS = 1", "p.toml: GAINS: expected one of hirm-d3, hirm-d4, hirm-d6, found 1"),
        ("DELAY_MIN = 5", "p.toml: DELAY_MAX: expected at least DELAY_MIN, found 4"),
        ("ELEV_LOW_DEG = 3\nELEV_HIGH_DEG = 3", "p.toml: ELEV_HIGH_DEG: expected above ELEV_LOW_DEG, found 3"),
    ],
)
def test_a_file_is_refused_whole_with_one_clear_line(text, complaint):
    vehicle = Vehicle()
    parameters = make(vehicle)
    before = parameters.values
    with pytest.raises(InputError, match=f"^{complaint}"):
        loaded(parameters, f"REF_MAX_DEG = 9\n{text}")
    assert parameters.values is before
    assert vehicle.asked == []


def test_a_file_of_which_the_vehicle_refuses_one_value_leaves_all_as_it_was():
    vehicle = Vehicle(STICK_DEG="not while armed")
    parameters = make(vehicle)
    before = parameters.values
    with pytest.raises(InputError, match=r"^p\.toml: not while armed$"):
        loaded(parameters, "STICK_DEG = 3\nDELAY_MAX = 3\nFS_HOLD_S = 2\nRATE_ATT = 1")
    assert parameters.values is before
    assert vehicle.asked == [
        ("DELAY_MAX", 3.0, 9),
        ("FS_HOLD_S", 2.0, 9),
        ("STICK_DEG", 3.0, 9),
        ("FS_HOLD_S", 0.5, 9),  # given back, the latest first
        ("DELAY_MAX", 4.0, 9),
    ]


def test_defaults_come_back_all_or_none():
    vehicle = Vehicle()
    parameters = make(vehicle)
    loaded(parameters, "STICK_DEG = 3\nDELAY_MAX = 3")
    vehicle.refusals["STICK_DEG"] = "no"
    with pytest.raises(InputError, match=r"^defaults: no$"):
        parameters.reset(9)
    assert parameters.value("DELAY_MAX") == 3.0
    vehicle.refusals.clear()
    assert parameters.reset(9) == ("DELAY_MAX", "STICK_DEG")
    assert parameters.values == parameters.defaults
    assert parameters.reset(9) == ()


# construction


def test_defaults_are_checked_like_any_value():
    with pytest.raises(InputError, match=r"^defaults: FS_HOLD_S: expected 0 to 60, found 61$"):
        make(FS_HOLD_S=61)
    with pytest.raises(InputError, match=r"^defaults: FS_SAT_S: expected a finite number, found nan$"):
        make(FS_SAT_S=math.nan)
    with pytest.raises(InputError, match=r"^defaults: DELAY_MAX: expected at least DELAY_MIN, found 4$"):
        make(DELAY_MIN=5)


def test_a_model_s_travel_may_be_another_range_than_the_table_s():
    travel = (math.degrees(-100.0), math.degrees(100.0))
    parameters = Parameters(
        OPEN | {"ELEV_LOW_DEG": travel[0], "ELEV_HIGH_DEG": travel[1]},
        Vehicle(),
        ports=(),
        names=NAMES[:1],
        ranges={"ELEV_LOW_DEG": travel, "ELEV_HIGH_DEG": travel},
    )
    assert put(parameters, "ELEV_LOW_DEG", -5000.0).reason is None
    answer = put(parameters, "ELEV_HIGH_DEG", FLT_MAX)
    refused(answer, "ELEV_HIGH_DEG", canonical(travel[1]), ParamErrorCode.VALUE_OUT_OF_RANGE)
    assert answer.reason == "ELEV_HIGH_DEG 3e+38: expected -5729.58 to 5729.58"
    assert put(parameters, "GAINS", 1.0).reason == "GAINS 1: expected 0"


def test_gain_sets_are_few_and_told_apart_by_name():
    with pytest.raises(InputError, match=r"^gain sets: expected different names, found b 2 times$"):
        Parameters(OPEN, Vehicle(), ports=(), names=("a", "b", "c", "b"))
    Parameters(OPEN, Vehicle(), ports=(), names=[str(n) for n in range(16)])
    with pytest.raises(InputError, match=r"^gain sets: expected at most 16, found 17$"):
        Parameters(OPEN, Vehicle(), ports=(), names=[str(n) for n in range(17)])


# the file


def test_a_file_is_read_as_it_was_written_and_nothing_is_left_beside_it(tmp_path):
    file = ParameterFile(tmp_path / "parameters.toml")
    assert file.read() is None
    parameters = make()
    put(parameters, "GAINS", 1.0)
    put(parameters, "FS_HOLD_S", as_float32(0.7))
    file.write({})
    file.write(parameters.as_table())
    again = make()
    table = file.read()
    assert table is not None
    again.load(table, 0)
    assert again.values == parameters.values
    assert [path.name for path in tmp_path.iterdir()] == ["parameters.toml"]


def test_a_write_that_fails_leaves_the_old_file(tmp_path, monkeypatch):
    file = ParameterFile(tmp_path / "parameters.toml")
    file.write({"STICK_DEG": 3.0})
    before = file.path.read_bytes()

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(OSError, match="No space left"):
        file.write({"STICK_DEG": 4.0})
    assert file.path.read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["parameters.toml"]
    with pytest.raises(OSError, match="No such file"):
        ParameterFile(tmp_path / "nowhere" / "parameters.toml").write({})


def test_a_file_that_cannot_be_read_is_not_taken_for_none(tmp_path):
    with pytest.raises(InputError, match="expected a readable file"):
        ParameterFile(tmp_path).read()
    (tmp_path / "p.toml").write_text("STICK_DEG = \n")
    with pytest.raises(InputError, match=r"p\.toml: expected TOML"):
        ParameterFile(tmp_path / "p.toml").read()
    with pytest.raises(InputError, match="expected a"):
        ParameterFile(Path("a\0b")).read()


# the page


def test_the_page_is_what_the_table_says():
    path = Path(__file__).parents[2] / PATH
    assert path.read_text(encoding="utf-8") == page(), f"{PATH} is out of date; run: {COMMAND}"


def test_the_page_has_every_parameter_once_and_in_order():
    rows = [line.split(" | ") for line in page().splitlines() if line.startswith("| `")]
    assert [row[0].strip("| `") for row in rows] == [each.name for each in PARAMETERS]
    assert {len(row) for row in rows} == {7}
    assert rows[3][1:5] == ["float", "0 to 60", "0.5", "s"]


def test_the_page_is_written_by_its_command(tmp_path):
    target = tmp_path / "docs" / "parameters.md"
    words = COMMAND.split()
    subprocess.run([sys.executable, *words[1:-1], str(target)], check=True, cwd=Path(__file__).parents[2])
    assert target.read_text(encoding="utf-8") == page()
