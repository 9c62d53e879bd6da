"""Faults as text and as data: what is read is what is written, what cannot be done is refused in one line."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autopilot.link.topics import SCHEMAS
from gains.table import InputError
from sitl.faults import (
    MAX_FAULTS,
    PROGRAMS,
    ClockDrift,
    ClockStep,
    CorruptGains,
    DiskFull,
    ElevatorFault,
    ElevatorFaultKind,
    Fault,
    Freeze,
    Kill,
    Mute,
    Phase,
    SensorFault,
    SensorFaultKind,
    aircraft_faults,
    check_faults,
    fault_changes,
    fault_of,
    fault_record,
    format_fault,
    parse_fault,
)

S, MS = 1_000_000_000, 1_000_000
STATES = ("alpha_rad", "q_rad_s", "theta_rad")

TEXTS: list[tuple[str, Fault]] = [
    ("kill:plant@5s+0.5s", Kill(5 * S, S // 2, "plant")),
    ("kill:relay@5s", Kill(5 * S, None, "relay")),
    ("freeze:autopilot@250ms+1s", Freeze(250 * MS, S, "autopilot")),
    ("step:plant:-0.5s@5s", ClockStep(5 * S, None, "plant", -S // 2)),
    ("step:relay:20ms@0s", ClockStep(0, None, "relay", 20 * MS)),
    ("drift:autopilot:-150.5ppm@5s", ClockDrift(5 * S, None, "autopilot", -150_500)),
    ("mute:relay@0.000000001s+1ms", Mute(1, MS, "relay")),
    ("corrupt-gains@5s+1s", CorruptGains(5 * S, S)),
    ("disk-full@5s", DiskFull(5 * S, None)),
    ("sensor:theta_rad:frozen@5s", SensorFault(5 * S, None, "theta_rad", SensorFaultKind.FROZEN, 0.0)),
    ("sensor:q_rad_s:bias:-0.02@5s+1s", SensorFault(5 * S, S, "q_rad_s", SensorFaultKind.BIAS, -0.02)),
    ("sensor:q_rad_s:noise:0.01@5s+1s", SensorFault(5 * S, S, "q_rad_s", SensorFaultKind.NOISE, 0.01)),
    ("sensor:alpha_rad:nan@5s+1s", SensorFault(5 * S, S, "alpha_rad", SensorFaultKind.NAN, 0.0)),
    ("elevator:stuck@5s+1s", ElevatorFault(5 * S, S, ElevatorFaultKind.STUCK, 0.0)),
    ("elevator:slow:0.1@5s+1s", ElevatorFault(5 * S, S, ElevatorFaultKind.SLOW, 0.1)),
    ("elevator:reversed@5s", ElevatorFault(5 * S, None, ElevatorFaultKind.REVERSED, 0.0)),
]


@pytest.mark.parametrize(("text", "fault"), TEXTS)
def test_a_text_is_the_fault_that_it_says_and_is_written_so_that_it_says_it_again(text: str, fault: Fault) -> None:
    assert parse_fault(text) == fault
    assert parse_fault(format_fault(fault)) == fault


def test_texts_are_written_in_seconds_without_needless_zeros() -> None:
    assert format_fault(parse_fault("freeze:plant@0250ms+1000ms")) == "freeze:plant@0.25s+1s"
    assert format_fault(parse_fault("elevator:slow:0.10@100s")) == "elevator:slow:0.1@100s"
    assert format_fault(parse_fault("drift:plant:+200ppm@5.0s")) == "drift:plant:200ppm@5s"


times = st.integers(0, 86_400 * S)
lengths = st.integers(1, 86_400 * S)
maybe = st.one_of(st.none(), lengths)
programs = st.sampled_from(PROGRAMS)
values = st.floats(1e-6, 1e6).map(lambda v: float(f"{v:.9f}"))
faults = st.one_of(
    st.builds(Kill, times, maybe, programs),
    st.builds(Freeze, times, lengths, programs),
    st.builds(Mute, times, lengths, programs),
    st.builds(ClockStep, times, st.none(), programs, st.integers(-86_400 * S, 86_400 * S)),
    st.builds(ClockDrift, times, st.none(), programs, st.integers(-200_000, 200_000)),
    st.builds(CorruptGains, times, lengths),
    st.builds(DiskFull, times, st.none()),
    st.builds(SensorFault, times, maybe, st.sampled_from(STATES), st.just(SensorFaultKind.NOISE), values),
    st.builds(ElevatorFault, times, maybe, st.just(ElevatorFaultKind.SLOW), values),
)


@settings(deadline=None, max_examples=60)
@given(faults)
def test_every_fault_survives_being_written_and_read(fault: Fault) -> None:
    assert parse_fault(format_fault(fault)) == fault


@settings(deadline=None, max_examples=60)
@given(st.one_of(st.text(max_size=40), st.from_regex(r"[a-z]{4,8}:[a-z:.0-9-]{0,12}@[-+.0-9ms]{0,12}", fullmatch=True)))
def test_any_text_is_a_fault_or_refused(text: str) -> None:
    try:
        fault = parse_fault(text)
    except InputError:
        return
    assert parse_fault(format_fault(fault)) == fault


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "expected WHAT@AT"),
        ("kill:plant", "expected WHAT@AT"),
        ("kill:plant@", "expected times such as 5s or 250ms, found nothing"),
        ("kill:plant@5", "expected times such as 5s or 250ms, found 5"),
        ("kill:plant@-5s", "expected times"),
        ("kill:plant@5s+", "expected times"),
        ("kill:plant@5s+0s", r"expected \+FOR above 0, found 0s"),
        ("kill:plant@5s+-1s", "expected times"),
        ("kill:plant@0.0000001ms", "expected times"),
        ("kill:plant@86401s", "expected times"),
        ("kill:gcs@5s", "with P plant|relay|autopilot"),
        ("kill:plant:now@5s", "expected kill:P"),
        ("freeze:plant@5s", r"expected \+FOR, how long it lasts"),
        ("mute:plant@5s", r"expected \+FOR"),
        ("corrupt-gains@5s", r"expected \+FOR"),
        ("corrupt-gains:x@5s+1s", "expected kill:P"),
        ("step:plant:1s@5s+1s", r"expected no \+FOR"),
        ("disk-full@5s+1s", r"expected no \+FOR"),
        ("step:plant@5s", "expected kill:P"),
        ("step:plant:fast@5s", "expected times"),
        ("drift:plant:201ppm@5s", "expected a drift within 200ppm"),
        ("drift:plant:fast@5s", "expected a drift within 200ppm"),
        ("sensor::nan@5s", "expected kill:P"),
        ("sensor:q:bias@5s", "expected kill:P"),
        ("sensor:q:bias:0@5s", "expected a number other than 0"),
        ("sensor:q:noise:-1@5s", "expected a number above 0"),
        ("sensor:q:noise:nan@5s", "expected a number above 0"),
        ("sensor:q:noise:1e9@5s", "expected a number above 0"),
        ("elevator:slow@5s", "expected kill:P"),
        ("elevator:slow:0@5s", "expected a number above 0"),
        ("elevator:gone@5s", "expected kill:P"),
    ],
)
def test_what_says_no_fault_is_refused(text: str, complaint: str) -> None:
    with pytest.raises(InputError, match=complaint):
        parse_fault(text)


def check(*texts: str, duration_s: float | None = 10.0) -> None:
    length_ns = None if duration_s is None else round(duration_s * S)
    check_faults([parse_fault(text) for text in texts], STATES, length_ns)


@pytest.mark.parametrize(
    ("texts", "complaint"),
    [
        (["sensor:beta_rad:nan@1s"], "expected a state of alpha_rad, q_rad_s, theta_rad, found beta_rad"),
        (["kill:plant@10s"], "expected it within the flight of 10s"),
        (["kill:plant@9s+1.001s"], "expected it within the flight of 10s"),
        (["kill:plant@1s+1s", "freeze:plant@1.9s+1s"], "expected it outside"),
        (["freeze:plant@1.9s+1s", "kill:plant@1s+1s"], "expected it outside"),
        (["kill:plant@1s", "kill:plant@5s+1s"], "expected it outside"),
        (["corrupt-gains@1s+1s", "mute:autopilot@1.5s+1s"], "expected it outside"),
        (["kill:relay@1s+1s", "step:relay:1s@1.5s"], "expected it outside"),
        (["kill:relay@1s+1s", "step:relay:1s@1s"], "expected it outside"),
        (["kill:relay@1s+1s", "kill:relay@1s+1s"], "expected it outside"),
        (["disk-full@1s"] * (MAX_FAULTS + 1), "expected at most 256, found 257"),
    ],
)
def test_faults_that_cannot_be_are_refused(texts: list[str], complaint: str) -> None:
    with pytest.raises(InputError, match=complaint):
        check(*texts)


def test_faults_that_can_be_are_not() -> None:
    check("kill:plant@9s+1s")
    check("kill:plant@1s+1s", "kill:plant@2s+1s", "kill:relay@1s+1s", "step:plant:1s@3s", "drift:plant:1ppm@3s")
    check("sensor:q_rad_s:nan@1s", "sensor:q_rad_s:bias:1@1s", "elevator:stuck@1s", "kill:autopilot@1s")
    check("kill:plant@100s", duration_s=None)


def test_the_plant_does_the_faults_of_its_own_parts() -> None:
    faults = [fault for _, fault in TEXTS]
    assert aircraft_faults(faults) == tuple(f for f in faults if isinstance(f, SensorFault | ElevatorFault))


def test_changes_come_in_order_of_time_and_at_one_instant_what_ends_comes_first() -> None:
    texts = ["kill:plant@2s+1s", "freeze:relay@1s+1s", "disk-full@2s", "kill:relay@3s"]
    changes = fault_changes(map(parse_fault, texts))
    assert [(c.at_ns // S, c.phase.value, format_fault(c.fault)) for c in changes] == [
        (1, "begin", "freeze:relay@1s+1s"),
        (2, "end", "freeze:relay@1s+1s"),
        (2, "begin", "kill:plant@2s+1s"),
        (2, "begin", "disk-full@2s"),
        (3, "end", "kill:plant@2s+1s"),
        (3, "begin", "kill:relay@3s"),
    ]


def test_the_record_of_a_change_is_an_event_of_the_scenario() -> None:
    begin, end = fault_changes([parse_fault("kill:plant@2s+1s")])
    record = fault_record(begin, 7, late_ns=3)
    assert (record.topic, record.t_ns) == ("events", 7)
    assert set(record.body) == set(SCHEMAS["events"]["required"])
    assert (record.body["kind"], record.body["node"]) == ("fault", "scenario")
    assert record.body["text"] == "kill:plant@2s+1s begins"
    assert record.body["data"] == {"fault": "kill:plant@2s+1s", "phase": Phase.BEGIN, "late_ns": 3}
    assert fault_record(end, 8).body["data"] == {"fault": "kill:plant@2s+1s", "phase": "end"}
    assert fault_of(record.body) == (parse_fault("kill:plant@2s+1s"), Phase.BEGIN)


@pytest.mark.parametrize(
    ("node", "data"),
    [
        ("plant", {"fault": "kill:plant@2s", "phase": "begin"}),
        ("scenario", {}),
        ("scenario", {"fault": "kill:gcs@2s", "phase": "begin"}),
        ("scenario", {"fault": "kill:plant@2s", "phase": "middle"}),
    ],
)
def test_another_event_of_that_kind_tells_of_no_fault(node: str, data: dict[str, str]) -> None:
    assert fault_of({"kind": "fault", "node": node, "text": "", "data": data}) is None
