"""What a ground station sees, read by pymavlink."""

from __future__ import annotations

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from autopilot.link.wire import (
    AoaSsa,
    Attitude,
    NamedValueInt,
    ServoOutputRaw,
    Severity,
    StatusText,
    VfrHud,
    Wire,
)
from autopilot.vehicle import MAX_WAITING, Vehicle, banner
from gains.model import Gains, Schedule
from gains.verify import verified
from tests.helpers import HIRM, MS, S, parse

GCS = (255, 190)


def read(vehicle: Vehicle, port: str = "gcs0") -> list:
    return [m for name, datagram in vehicle.outgoing() if name == port for m in parse(datagram)]


def kinds(messages: list) -> list[str]:
    return [m.get_type() for m in messages]


def quiet(*ports: str) -> Vehicle:
    """Return a vehicle whose first heartbeat is gone."""
    vehicle = Vehicle(ports or ("gcs0",))
    vehicle.tick(0, tracking=False, degraded=False)
    vehicle.outgoing()
    return vehicle


def tick(vehicle: Vehicle) -> None:
    """Tick before the next heartbeat is due."""
    vehicle.tick(1, tracking=False, degraded=False)


def test_everything_speaks_as_system_1_component_1_with_its_own_numbers_per_port():
    vehicle = Vehicle(("gcs0", "gcs1"), [StatusText(Severity.WARNING, "hello")])
    for n in range(300):
        vehicle.tick(n * S, tracking=True, degraded=False)
    datagrams = vehicle.outgoing()
    for port in vehicle.ports:
        messages = [m for name, datagram in datagrams if name == port for m in parse(datagram)]
        assert {(m.get_srcSystem(), m.get_srcComponent()) for m in messages} == {(1, 1)}
        assert [m.get_seq() for m in messages] == [n % 256 for n in range(301)]


def test_the_heartbeat_comes_once_a_second_and_says_what_flies():
    vehicle = Vehicle(("gcs0",))
    assert vehicle.next_deadline_ns() is None
    beats = []
    for ms in range(0, 5001, 50):
        vehicle.tick(1042 * S + ms * MS, tracking=ms >= 1500, degraded=ms >= 3500)
        beats += [(ms, m) for m in read(vehicle)]
    assert [ms for ms, _ in beats] == [0, 1000, 2000, 3000, 4000, 5000]
    assert {(m.type, m.autopilot != dialect.MAV_AUTOPILOT_INVALID) for _, m in beats} == {
        (dialect.MAV_TYPE_FIXED_WING, True)
    }
    tracking = [bool(m.base_mode & dialect.MAV_MODE_FLAG_STABILIZE_ENABLED) for _, m in beats]
    assert tracking == [False, False, True, True, True, True]
    critical = [m.system_status == dialect.MAV_STATE_CRITICAL for _, m in beats]
    assert critical == [False, False, False, False, True, True]
    assert vehicle.next_deadline_ns() == 1042 * S + 6 * S


def test_the_banner_is_told_at_start_and_once_more_to_a_station_that_first_speaks():
    vehicle = Vehicle(("gcs0", "gcs1"), [StatusText(Severity.WARNING, "no certificate")])
    vehicle.tick(0, tracking=False, degraded=False)
    assert [m.text for m in read(vehicle) if m.get_type() == "STATUSTEXT"] == ["no certificate"]
    station = Wire(GCS, None)
    heard = []
    for _ in range(3):
        vehicle.receive("gcs1", station.encode(StatusText(6, "hi")))
        heard += [(port, m.text) for port, d in vehicle.outgoing() for m in parse(d)]
    assert heard == [("gcs1", "no certificate")]


def test_noise_and_our_own_echo_are_nobody_speaking():
    vehicle = Vehicle(("gcs0",), [StatusText(Severity.WARNING, "no certificate")])
    frame = Wire(GCS, None).encode(StatusText(6, "hi"))
    for datagram in (b"", b"noise", frame[:-1], Wire((1, 1), None).encode(StatusText(6, "hi"))):
        vehicle.receive("gcs0", datagram)
    assert vehicle.outgoing() == []


def test_what_is_shown_goes_out_at_the_next_tick_on_the_autopilots_clock():
    vehicle = quiet()
    now_ns = 1042 * S + 3 * MS
    vehicle.show(Attitude(5, 0.0, 0.25, 0.0, 0.0, -0.5, 0.0), now_ns)
    vehicle.show(AoaSsa(5_000, 1.5, 0.0), now_ns)
    vehicle.show(ServoOutputRaw(0, 1520), now_ns)
    vehicle.show(VfrHud(100.0, 100.0, 0, 0, 1600.0, 2.5), now_ns)
    vehicle.show(NamedValueInt(7, "DELAY_K", 3), now_ns)
    assert vehicle.outgoing() == []
    assert vehicle.next_deadline_ns() <= now_ns
    tick(vehicle)
    attitude, air, servo, hud, delay = read(vehicle)
    assert (attitude.time_boot_ms, attitude.pitch, attitude.pitchspeed) == (1_042_003, 0.25, -0.5)
    assert (air.time_usec, air.AOA) == (1_042_003_000, 1.5)
    assert (servo.time_usec, servo.servo2_raw) == (1_042_003_000, 1520)
    assert (hud.airspeed, hud.alt, hud.climb) == (100.0, 1600.0, 2.5)
    assert (delay.time_boot_ms, delay.name, delay.value) == (1_042_003, "DELAY_K", 3)
    assert vehicle.next_deadline_ns() == S


def test_what_waits_for_a_tick_is_bounded_and_counted():
    vehicle = quiet()
    for n in range(MAX_WAITING + 9):
        vehicle.show(NamedValueInt(0, "DELAY_K", n), 0)
    tick(vehicle)
    assert [m.value for m in read(vehicle)] == list(range(MAX_WAITING))
    assert vehicle.refused == 9


def test_a_transition_is_said_even_when_everything_else_is_full():
    vehicle = quiet()
    for n in range(MAX_WAITING):
        vehicle.show(NamedValueInt(0, "DELAY_K", n), 0)
    vehicle.say(Severity.WARNING, "TRACKING to HOLD")
    tick(vehicle)
    assert read(vehicle)[-1].text == "TRACKING to HOLD"


def test_a_message_goes_to_every_station():
    vehicle = quiet("gcs0", "gcs1", "gcs2")
    vehicle.say(Severity.NOTICE, "hello")
    tick(vehicle)
    sent = [(port, m.severity, m.text) for port, d in vehicle.outgoing() for m in parse(d)]
    assert sent == [(port, 5, "hello") for port in ("gcs0", "gcs1", "gcs2")]


def test_without_stations_nothing_is_sent():
    vehicle = Vehicle(())
    vehicle.show(ServoOutputRaw(0, 1500), 0)
    vehicle.tick(0, tracking=True, degraded=False)
    assert vehicle.outgoing() == []


def test_times_wrap_for_a_station_too():
    vehicle = quiet()
    now_ns = ((1 << 32) + 9) * MS
    vehicle.show(Attitude(5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), now_ns)
    vehicle.show(ServoOutputRaw(0, 1500), now_ns)
    tick(vehicle)
    attitude, servo = read(vehicle)
    assert attitude.time_boot_ms == 9
    assert servo.time_usec == (now_ns // 1000) % (1 << 32)


def scheduled(windows: list[tuple[int, int]]) -> Schedule:
    sets = [Gains(f"set {i}", HIRM.model, low, high, HIRM.K1, HIRM.K2) for i, (low, high) in enumerate(windows)]
    return Schedule("wide", HIRM.model, tuple(sets))


@pytest.mark.parametrize(
    ("windows", "text"),
    [
        ([(1, 2), (2, 4)], "2 gain sets: delay 1..2, 2..4"),
        ([(d, d + 1) for d in range(8, 12)], "4 gain sets: delay 8..9, 9..10, 10..11, 11..12"),
        ([(d, d + 1) for d in range(1, 40)], "39 gain sets: delay 1 to 40"),
    ],
)
def test_the_windows_of_a_schedule_are_told_whole_or_as_one(windows: list[tuple[int, int]], text: str) -> None:
    schedule = scheduled(windows)
    certificate, sets = banner(schedule, verified(schedule))
    assert certificate.text == "no verified certificate: schedule wide"
    assert sets.text == text
    assert len(sets.text) <= 50


def test_one_set_of_gains_is_announced_in_one_text() -> None:
    [text] = banner(HIRM, verified(HIRM))
    assert text.text == "no verified certificate: gains hirm-paper"
