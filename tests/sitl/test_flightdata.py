"""A recorded flight in which programs start again: every record finds its place, or none, but never a wrong one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gains.store import load_gains
from sitl.faults import fault_changes, fault_record, parse_fault
from sitl.flightdata import FlightData

MODEL = load_gains("hirm-paper").model
TS, S = MODEL.Ts_ns, 1_000_000_000
ZERO = 7 * S
"""Log time of the first sample 0."""

Entry = tuple[str, int, dict[str, Any]]


def truth(k: int, at_ns: int, j: int | None = None) -> Entry:
    d = None if j is None else k - j
    body = {"k": k, "late_ns": 0, "x": [0.0] * 3, "u": [0.0], "j": j, "d": d, "w": [0.0], "timeout": False}
    return "plant/truth", at_ns, body


def command(j: int, at_ns: int, mode: str = "TRACKING", d: int | None = 2, r: float = 0.0) -> Entry:
    body = {"j": j, "x": [0.0] * 3, "xr": None, "r": [r], "d": d, "d_low": d, "d_high": d}
    return "autopilot/command", at_ns, {**body, "saturated": False, "mode": mode}


def packet(sent_ns: int, delivered_ns: int | None, at_ns: int) -> Entry:
    body = {"sent_ns": sent_ns, "delivered_ns": delivered_ns, "number": 1, "size": 1, "fate": "delivered", "copy": 0}
    return "link/up", at_ns, body


def fault(text: str, at_ns: int, index: int = 0) -> Entry:
    record = fault_record(fault_changes([parse_fault(text)])[index], at_ns)
    return record.topic, at_ns, dict(record.body)


def flight_of(*entries: Entry, **metadata: str) -> FlightData:
    return FlightData.from_records(entries, MODEL, metadata)


RESTART = [
    *(truth(k, ZERO + k * TS) for k in range(10)),
    *(truth(k, ZERO + (30 + k) * TS) for k in range(10)),
]
"""Ten samples, a gap of twenty, ten more of another plant."""


def test_the_samples_of_a_plant_that_starts_again_stand_where_they_were_in_true_time() -> None:
    flight = flight_of(*RESTART)
    assert np.rint(flight.time_s / MODEL.Ts).astype(int).tolist() == [*range(10), *range(30, 40)]
    assert flight.start.tolist() == [0] * 10 + [30] * 10
    assert flight.k.tolist() == [*range(10), *range(10)]


@pytest.mark.parametrize(
    ("j", "sample", "place"),
    [
        (5, 7, 5),  # in the first life
        (3, 34, 33),  # in the second
        (3, 28, 3),  # made while no plant lives, from what was under way
        (8, 33, 8),  # a sample of the first life, made when the second had not reached its number yet
        (50, 33, None),  # a number that no plant has reached
    ],
)
def test_a_command_stands_at_the_sample_it_was_made_from(j: int, sample: int, place: int | None) -> None:
    at_ns = ZERO + sample * TS + 1
    flight = flight_of(*sorted([*RESTART, command(j, at_ns)], key=lambda entry: entry[1]))
    assert flight.command_sample.tolist() == ([] if place is None else [place])


def test_in_a_flight_without_restart_a_command_needs_no_sample_beside_it() -> None:
    flight = flight_of(truth(0, ZERO), command(400, ZERO + 400 * TS))
    assert flight.command_sample.tolist() == flight.command_j.tolist() == [400]


def test_a_command_of_no_sample_does_not_make_the_programmed_reference_another() -> None:
    strange = command(50, ZERO + 33 * TS, r=0.0)  # the programmed reference has stepped by then
    entries = sorted([*RESTART, strange, *(command(k, ZERO + k * TS + 1) for k in range(10))], key=lambda e: e[1])
    flight = flight_of(*entries, reference="5deg@1s")
    assert not flight.reference.any()
    assert flight.reference.shape == (20, 1)


@pytest.mark.parametrize(
    ("text", "dead"),
    [
        ("kill:autopilot@0.1s", True),
        ("corrupt-gains@0.1s+1s", True),
        ("kill:relay@0.1s", False),
        ("freeze:autopilot@0.1s+1s", False),
    ],
)
def test_an_autopilot_that_is_dead_flies_in_no_mode(text: str, dead: bool) -> None:
    entries = [truth(k, ZERO + k * TS) for k in range(8)]
    flight = flight_of(*entries, command(0, ZERO), fault(text, ZERO + 4 * TS))
    found = [(round(mode.start_s / MODEL.Ts, 6), round(mode.end_s / MODEL.Ts, 6), mode.mode) for mode in flight.modes]
    assert found == ([(0, 4, "TRACKING"), (4, 8, "STANDBY")] if dead else [(0, 8, "TRACKING")])


def test_packets_enter_at_their_true_time_through_a_restart_of_the_relay() -> None:
    entries = []
    for n in range(20):
        entered_ns = ZERO + n * TS
        shown_ns = 11 * S + (n if n < 10 else n - 10) * TS  # its clock begins again with the tenth packet
        lost = n in (4, 15)
        at_ns = entered_ns if lost else entered_ns + 3_000_000
        entries.append(packet(shown_ns, None if lost else shown_ns + 3_000_000, at_ns))
    packets = flight_of(truth(0, ZERO), *entries).links["up"]
    np.testing.assert_allclose(packets.entered_s, np.arange(20) * MODEL.Ts, atol=1e-9)
    assert np.flatnonzero(np.isnan(packets.delay_s)).tolist() == [4, 15]
    np.testing.assert_allclose(packets.delay_s[~np.isnan(packets.delay_s)], 0.003, atol=1e-9)


def test_a_link_that_delivers_nothing_has_packets_all_the_same() -> None:
    packets = flight_of(truth(0, ZERO), packet(11 * S, None, ZERO), packet(11 * S + TS, None, ZERO + TS)).links["up"]
    np.testing.assert_allclose(packets.entered_s, [0.0, MODEL.Ts], atol=1e-9)
