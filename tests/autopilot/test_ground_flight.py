"""Flights with a ground station in virtual time: plant, line, autopilot, and a station of pymavlink and a script."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as dialect
from scipy.spatial.transform import Rotation

from autopilot.app import AutopilotNode
from autopilot.config import AutopilotConfig
from autopilot.link.clock import Clock
from autopilot.link.node import Record
from autopilot.link.virtual import Participant, VirtualNetwork
from autopilot.profile import parse_profile
from gains.model import Gains
from gains.store import load_gains
from sitl.plant import PlantConfig, PlantNode
from tests.helpers import AUTOPILOT_CLOCK, LINE_CLOCK, MS, PLANT_CLOCK, Line, S, constant

D4, D6 = load_gains("hirm-d4"), load_gains("hirm-d6")
"""Delays 1 to 4 and 1 to 6, both with a verified certificate."""
MODEL = D4.model
TRAVEL = math.radians(25)
NO_JUMP = 1e-9
"""What the elevator may move at the very sample at which a law takes over, rad: rounding."""
SMOOTH = math.radians(5) * abs(float((D4.K2 @ MODEL.reference.Br)[0, 0]))
"""What it may move from sample to sample in the second after, rad: as much as at once at a step of 5 degrees."""
MANUAL, STABILIZE, AUTO, GUIDED = 0, 2, 10, 15
IGNORE_RATES, IGNORE_ATTITUDE = 7, 128
TWENTY_MS = constant(20 * MS)
Timed = tuple[float, dialect.MAVLink_message]


class Station:
    """A Node that sends what its script says, (seconds, message), and keeps what it gets."""

    def __init__(self, script: Iterable[Timed]) -> None:
        self.got: list[tuple[int, bytes]] = []
        self._mav = dialect.MAVLink(None, 255, 190)
        self._script = sorted(script, key=lambda timed: -timed[0])
        self._out: list[tuple[str, bytes]] = []

    def receive(self, port: str, datagram: bytes, now_ns: int) -> None:
        self.got.append((now_ns, datagram))

    def tick(self, now_ns: int) -> None:
        while (due_ns := self.next_deadline_ns()) is not None and due_ns <= now_ns:
            self._out.append(("autopilot", self._script.pop()[1].pack(self._mav)))

    def next_deadline_ns(self) -> int | None:
        return round(self._script[-1][0] * S) if self._script else None

    def outgoing(self) -> list[tuple[str, bytes]]:
        out, self._out = self._out, []
        return out

    def records(self) -> list[Record]:
        return []


class GroundFlight:
    """A flight with one ground station; seconds are true time, the law begins to fly before 1 s."""

    def __init__(
        self,
        seconds: float,
        *scripts: Iterable[Timed],
        gains: Gains = D4,
        reference: str = "",
        x0: np.ndarray | None = None,
        up: Callable[[int], int | None] = TWENTY_MS,
        down: Callable[[int], int | None] = TWENTY_MS,
        **options,
    ) -> None:
        config = AutopilotConfig(gains, parse_profile(reference, 0.025), actuator="float", **options)
        self.node = AutopilotNode(config)
        self.station = Station(timed for script in scripts for timed in script)
        self.commands: list[dict] = []
        self.truth: list[dict] = []
        wires = [
            (("autopilot", "plant"), ("line", "autopilot")),
            (("line", "plant"), ("plant", "autopilot")),
            (("autopilot", "gcs0"), ("station", "autopilot")),
        ]
        self.network = VirtualNetwork(
            [
                Participant("plant", PlantNode(PlantConfig(MODEL, x0)), PLANT_CLOCK),
                Participant("line", Line(up, down), LINE_CLOCK),
                Participant("autopilot", self.node, AUTOPILOT_CLOCK),
                Participant("station", self.station, Clock()),
            ],
            {**dict(wires), **{far: near for near, far in wires}},
            self._keep,
        )
        self.network.run(lambda: False, round(seconds * S))

    def _keep(self, record: Record, true_ns: int) -> None:
        kept = {"autopilot/command": self.commands, "plant/truth": self.truth}.get(record.topic)
        if kept is not None:
            kept.append({**record.body, "true_s": true_ns / S})

    def seen(self, kind: str) -> list[tuple[float, dialect.MAVLink_message]]:
        """Return what the station has got of a kind, with the true seconds."""
        parser = dialect.MAVLink(None)
        read = [(t_ns / S, m) for t_ns, datagram in self.station.got for m in parser.parse_buffer(datagram) or []]
        return [(t_s, m) for t_s, m in read if m.get_type() == kind]

    def told(self, text: str) -> list[float]:
        """Return when a text was told, s."""
        return [t_s for t_s, m in self.seen("STATUSTEXT") if m.text == text]

    def after(self, since_s: float, until_s: float = math.inf) -> list[dict]:
        return [c for c in self.commands if since_s <= c["true_s"] < until_s]

    def theta_deg(self, at_s: float) -> float:
        return math.degrees(next(t["x"][2] for t in self.truth if t["true_s"] >= at_s))


def long(command: int, *params: float) -> dialect.MAVLink_message:
    return dialect.MAVLink_command_long_message(1, 1, command, 0, *params, *[0.0] * (7 - len(params)))


def mode(number: int) -> dialect.MAVLink_message:
    return long(176, dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, number)


def put(name: str, value: float) -> dialect.MAVLink_message:
    return dialect.MAVLink_param_set_message(1, 1, name.encode(), value, dialect.MAV_PARAM_TYPE_REAL32)


def stick(x: int) -> dialect.MAVLink_message:
    return dialect.MAVLink_manual_control_message(1, x, 0, 0, 0, 0)


def attitude(
    pitch_deg: float, roll_deg: float = 0.0, yaw_deg: float = 0.0, stamp_ms: int = 0
) -> dialect.MAVLink_message:
    """Return SET_ATTITUDE_TARGET of a yaw, a pitch and a roll, by SciPy; a stamp of 0 says nothing."""
    x, y, z, w = Rotation.from_euler("ZYX", [yaw_deg, pitch_deg, roll_deg], degrees=True).as_quat()
    return dialect.MAVLink_set_attitude_target_message(stamp_ms, 1, 1, IGNORE_RATES, [w, x, y, z], 0.0, 0.0, 0.0, 0.5)


def pitch_rate(deg_s: float) -> dialect.MAVLink_message:
    mask, nothing = IGNORE_ATTITUDE | 1 | 4, [math.nan] * 4
    return dialect.MAVLink_set_attitude_target_message(0, 1, 1, mask, nothing, 0.0, math.radians(deg_s), 0.0, 0.5)


def every(message: dialect.MAVLink_message, since_s: float, until_s: float, rate_hz: float = 20.0) -> list[Timed]:
    """Return a stream of one message."""
    return [(since_s + n / rate_hz, message) for n in range(round((until_s - since_s) * rate_hz))]


def eq8(flight: GroundFlight) -> np.ndarray:
    """Return xr(0), xr(1), ... of Eq. (8) with the recorded r, from rest, by NumPy; every sample must be there."""
    assert [c["j"] for c in flight.commands] == list(range(len(flight.commands)))
    reference, xr = MODEL.reference, [np.zeros(3)]
    assert reference is not None
    for command in flight.commands:
        xr.append(reference.Ar @ xr[-1] + reference.Br[:, 0] * command["r"][0])
    return np.array(xr)


def eq9(gains: Gains, command: dict) -> float:
    """Return u of Eq. (9) with the recorded xr, within the travel, by NumPy."""
    assert gains.K2 is not None
    u = float((gains.K1 @ np.array(command["x"]) + gains.K2 @ np.array(command["xr"]))[0])
    return float(np.clip(u, -TRAVEL, TRAVEL))


def u_of(commands: list[dict]) -> np.ndarray:
    return np.array([c["u"][0] for c in commands])


def r_of(commands: list[dict]) -> np.ndarray:
    return np.array([c["r"][0] for c in commands])


def takes_over(flight: GroundFlight) -> int:
    """Return the place of the last command whose predecessor no law has computed."""
    by_law = [c["mode"] == "TRACKING" for c in flight.commands]
    return max(n for n in range(1, len(by_law)) if by_law[n] and not by_law[n - 1])


# nobody at the ground


PROFILE = "2deg@1s,-1deg@2.5s"


def test_a_vehicle_that_arms_itself_flies_the_profile_from_sample_0():
    flight = GroundFlight(6, reference=PROFILE)
    profile = parse_profile(PROFILE, 0.025)
    assert [c["r"][0] for c in flight.commands] == [profile.r(c["j"]) for c in flight.commands]
    assert all(c["armed"] and c["mode"] == "TRACKING" for c in flight.commands)
    xr = eq8(flight)
    for c in flight.commands[: -c_max(flight)]:
        assert c["xr"] == pytest.approx(xr[c["j"] + c["d"]], abs=1e-12)
        assert c["u"][0] == pytest.approx(eq9(D4, c), abs=1e-12)


def c_max(flight: GroundFlight) -> int:
    """Return the largest forecast of a delay: the last commands look ahead to samples that are not recorded."""
    return max(c["d"] for c in flight.commands)


def test_a_station_that_talks_all_the_time_but_commands_nothing_changes_no_bit_of_the_flight():
    quiet = GroundFlight(6, reference=PROFILE)
    talk = [
        dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3),
        dialect.MAVLink_param_request_list_message(1, 1),
        dialect.MAVLink_request_data_stream_message(1, 1, 0, 50, 1),
        dialect.MAVLink_set_attitude_target_message(0, 1, 1, 7, [0.9, 0.0, 0.4, 0.0], 0.0, 0.0, 0.0, 0.5),
        stick(-700),
        long(512, 30.0),
        long(400, 1.0),
        long(31_000),
    ]
    busy = GroundFlight(6, *(every(m, 0.01 * n, 5.9, 11.0) for n, m in enumerate(talk)), reference=PROFILE)
    assert [(t["x"], t["u"], t["d"]) for t in busy.truth] == [(t["x"], t["u"], t["d"]) for t in quiet.truth]
    assert [(c["xr"], c["u"], c["r"]) for c in busy.commands] == [(c["xr"], c["u"], c["r"]) for c in quiet.commands]
    assert len(busy.seen("PARAM_VALUE")) > 100


# MANUAL


def test_in_manual_the_stick_pulled_back_pitches_the_aircraft_up_and_is_the_elevator():
    flight = GroundFlight(6, [(2.0, mode(MANUAL))], every(stick(-100), 2.5, 3.5))
    x = np.zeros(3)
    for _ in range(40):
        x = MODEL.A @ x + MODEL.B[:, 0] * 0.1 * TRAVEL
    nose_up = math.copysign(0.1 * TRAVEL, x[2])
    assert nose_up < 0.0  # as the HIRM has it: more elevator pitches down
    held = flight.after(2.6, 3.5)
    assert u_of(held) == pytest.approx(nose_up, abs=1e-12)
    assert {(c["mode"], c["flight_mode"]) for c in held} == {("STANDBY", "MANUAL")}
    assert flight.theta_deg(3.6) - flight.theta_deg(2.5) == pytest.approx(abs(math.degrees(x[2])), rel=0.15)


def test_a_stick_that_falls_silent_leaves_the_elevator_neutral_after_the_time_out_and_that_is_said():
    flight = GroundFlight(6, [(1.5, put("REF_TIME_S", 0.5)), (2.0, mode(MANUAL))], every(stick(-100), 2.5, 3.0))
    last_s = 2.5 + 9 / 20
    assert flight.told("MANUAL: silence, elevator neutral") == [pytest.approx(last_s + 0.5, abs=2 * MS / S)]
    assert set(u_of(flight.after(last_s + 0.53))) == {0.0}
    assert 0.0 not in set(u_of(flight.after(2.53, last_s + 0.5)))


# STABILIZE


def test_in_stabilize_the_stick_is_the_pitch_reference_and_the_aircraft_goes_there():
    flight = GroundFlight(9, [(1.5, put("STICK_DEG", 8.0)), (2.0, mode(STABILIZE))], every(stick(-500), 2.5, 9.0, 5.0))
    assert set(r_of(flight.after(2.7))) == {math.radians(8.0) * 0.5}
    assert flight.theta_deg(8.9) == pytest.approx(4.0, abs=0.05)


def test_a_pulse_is_the_stick_too_and_silence_brings_the_reference_back_to_trim():
    pulse = dialect.MAVLink_rc_channels_override_message(1, 1, 0, 1400, 0, 0, 0, 0, 0, 0)
    flight = GroundFlight(10, [(2.0, mode(STABILIZE))], every(pulse, 2.5, 4.0, 5.0))
    assert r_of(flight.after(2.7, 4.7)) == pytest.approx(math.radians(-3.0))
    assert flight.told("STABILIZE: silence, holding trim") == [pytest.approx(3.9 + 1.0, abs=2 * MS / S)]
    assert set(r_of(flight.after(4.95))) == {0.0}
    assert flight.theta_deg(9.9) == pytest.approx(0.0, abs=0.05)


# GUIDED


@pytest.fixture(scope="module")
def guided() -> GroundFlight:
    """A flight whose reference is streamed from 2 s to 7 s: 3 degrees of pitch in a banked turn, then silence."""
    return GroundFlight(12, [(2.0, mode(GUIDED))], every(attitude(3.0, 25.0, 100.0), 2.0, 7.0))


def test_in_guided_the_pitch_of_the_quaternion_is_the_reference_and_the_aircraft_goes_there(guided):
    assert r_of(guided.after(2.2, 7.9)) == pytest.approx(math.radians(3.0), abs=1e-7)  # 32-bit quaternions
    assert guided.theta_deg(7.0) == pytest.approx(3.0, abs=0.05)


def test_a_stream_that_falls_silent_returns_the_reference_to_trim_and_that_is_said(guided):
    assert guided.told("GUIDED: silence, holding trim") == [pytest.approx(6.95 + 1.0, abs=2 * MS / S)]
    assert set(r_of(guided.after(8.1))) == {0.0}
    assert guided.theta_deg(11.9) == pytest.approx(0.0, abs=0.05)


def test_attitude_target_is_the_reference_that_is_flown(guided):
    shown = guided.seen("ATTITUDE_TARGET")
    assert len(shown) > 50
    for t_s, m in shown:
        if not guided.commands or t_s < guided.commands[0]["true_s"] + 0.05:
            continue
        flown = [c for c in guided.commands if c["true_s"] <= t_s][-1]
        q = m.q
        pitch = Rotation.from_quat([q[1], q[2], q[3], q[0]]).as_euler("ZYX")[1]
        assert pitch == pytest.approx(flown["r"][0], abs=1e-7)
        assert not m.type_mask & IGNORE_ATTITUDE
    assert {round(math.degrees(2 * math.asin(m.q[2])), 4) for _, m in shown} == {0.0, 3.0}


def test_attitude_target_has_no_attitude_while_no_law_flies():
    flight = GroundFlight(4, [(2.0, mode(MANUAL)), (3.0, long(400, 0.0))])
    masks = [(t_s, bool(m.type_mask & IGNORE_ATTITUDE)) for t_s, m in flight.seen("ATTITUDE_TARGET")]
    assert {ignored for t_s, ignored in masks if 1.5 < t_s < 2.0} == {False}
    assert {ignored for t_s, ignored in masks if t_s > 2.1} == {True}


def test_a_pitch_rate_moves_the_reference_at_that_rate_from_where_it_is():
    flight = GroundFlight(6, [(2.0, mode(GUIDED))], every(attitude(2.0), 2.0, 3.0), every(pitch_rate(-1.5), 3.0, 5.0))
    moving = r_of(flight.after(3.2, 5.0))
    assert np.diff(moving) == pytest.approx(math.radians(-1.5) * 0.025, rel=1e-6)
    still = r_of(flight.after(2.2, 3.0))
    begun = next(c["j"] for c in flight.commands if c["true_s"] > 3.0 and c["r"][0] != still[-1])
    for c in flight.after(3.2, 5.0):
        expected = still[-1] - math.radians(1.5) * 0.025 * (c["j"] - begun + 1)
        assert c["r"][0] == pytest.approx(expected, abs=1e-7)


def test_setpoints_that_were_overtaken_or_are_no_numbers_are_refused_and_change_nothing():
    good = [(2.0 + n / 20, attitude(2.0, stamp_ms=90_000 + 50 * n)) for n in range(60)]
    late = [(2.01 + n / 20, attitude(9.0, stamp_ms=90_000 + 50 * n - 300)) for n in range(60)]
    nan = dialect.MAVLink_set_attitude_target_message(0, 1, 1, IGNORE_RATES, [math.nan] * 4, 0.0, 0.0, 0.0, 0.5)
    flight = GroundFlight(5, [(1.9, mode(GUIDED))], good, late, every(nan, 2.3, 4.9))
    assert r_of(flight.after(2.2, 5.0)[:-1]) == pytest.approx(math.radians(2.0), abs=1e-7)
    assert flight.node.commander.refused == len(late) + 52
    # what is refused keeps nothing alive: 1 s after the last good one the stream is silent
    silent = GroundFlight(5, [(1.9, mode(GUIDED))], good[:20], late[:20], every(nan, 2.3, 4.9))
    assert silent.told("GUIDED: silence, holding trim") == [pytest.approx(2.95 + 1.0, abs=2 * MS / S)]


def wandering(since_s: float, until_s: float, most_deg: float, seed: int = 5) -> list[Timed]:
    """Return a stream of random pitches, at times that fit no sample."""
    rng = np.random.default_rng(seed)
    times = np.sort(rng.uniform(since_s, until_s, round(15 * (until_s - since_s))))
    return [(float(t_s), attitude(float(rng.uniform(-most_deg, most_deg)))) for t_s in times]


def jittery(seed: int) -> Callable[[int], int]:
    rng = np.random.default_rng(seed)
    return lambda _now_ns: int(rng.integers(5, 30)) * MS


@pytest.mark.parametrize("jitter", [False, True])
def test_what_was_flown_obeys_equation_8_with_the_recorded_reference_although_it_was_streamed(jitter):
    links = {"up": jittery(1), "down": jittery(2)} if jitter else {}
    flight = GroundFlight(10, [(2.0, mode(GUIDED))], wandering(2.0, 9.0, 3.0), **links)
    xr = eq8(flight)
    d = {c["d"] for c in flight.commands}
    assert len(d) > 1 if jitter else d == {2}
    for c in flight.commands[: -c_max(flight)]:
        assert c["xr"] == pytest.approx(xr[c["j"] + c["d"]], abs=1e-12)
        assert c["u"][0] == pytest.approx(eq9(D4, c), abs=1e-12)
    assert len(set(r_of(flight.commands))) > 80


def test_no_setpoint_takes_the_reference_beyond_its_limits():
    limits = [(1.2, put("REF_MAX_DEG", 2.0)), (1.3, put("REF_RATE_DS", 8.0)), (2.0, mode(GUIDED))]
    flight = GroundFlight(9, limits, wandering(2.0, 6.0, 60.0), every(pitch_rate(90.0), 6.0, 7.5))
    r = r_of(flight.commands)
    most, move = math.radians(2.0), math.radians(8.0) * 0.025
    assert np.abs(r).max() == pytest.approx(most, abs=1e-12)
    assert np.abs(np.diff(r)).max() == pytest.approx(move, abs=1e-12)
    assert (r.min(), r.max()) == (pytest.approx(-most), pytest.approx(most))
    assert np.abs(np.array([c["xr"] for c in flight.commands])[:, 2]).max() < math.radians(2.5)


def test_the_limits_hold_for_the_programmed_profile_and_for_the_stick_too():
    limits = [(0.01, put("REF_MAX_DEG", 3.0)), (0.01, put("REF_RATE_DS", 5.0)), (4.0, mode(STABILIZE))]
    flight = GroundFlight(7, limits, every(stick(1000), 4.2, 7.0), reference="9deg@1s")
    r = r_of(flight.commands)
    assert (r.max(), r.min()) == (pytest.approx(math.radians(3.0)), pytest.approx(math.radians(-3.0)))
    assert np.abs(np.diff(r)).max() <= math.radians(5.0) * 0.025 + 1e-12


# AUTO again


def starts(flight: GroundFlight, reference: str, since_s: float, until_s: float = math.inf) -> int:
    """Return the sample at which the profile began between two times; before it the reference is zero."""
    profile = parse_profile(reference, 0.025)
    flown = [(c["j"], c["r"][0]) for c in flight.after(since_s, until_s)]
    first = flown[0][0]
    begun = [
        start
        for start in range(first, first + 40)
        if all(r == (profile.r(j - start) if j >= start else 0.0) for j, r in flown)
    ]
    assert len(begun) == 1, begun
    return begun[0]


def test_auto_begins_its_profile_anew_each_time_it_is_entered():
    reference = "2deg@0.5s,0deg@1s,1deg@2s"
    script = [(4.0, mode(GUIDED)), (5.0, mode(AUTO)), (7.5, mode(STABILIZE)), (8.0, mode(AUTO))]
    flight = GroundFlight(11, script, reference=reference)
    for since_s, until_s in ((5.0, 7.5), (8.0, 11.0)):
        entered = flight.after(since_s)[0]
        assert entered["flight_mode"] == "AUTO"
        # what commands under way have looked ahead to is promised, so the profile begins a little later
        assert 0 < starts(flight, reference, since_s, until_s) - entered["j"] <= c_max(flight) + 1


# taking over


HANDS = {
    "AUTO": (AUTO, [], ""),
    "AUTO at a step": (AUTO, [], "2deg@0s"),
    "STABILIZE": (STABILIZE, every(stick(-200), 4.0, 7.0), ""),
    "GUIDED": (GUIDED, every(attitude(2.0), 4.0, 7.0), ""),
}


@pytest.mark.parametrize("case", HANDS)
def test_the_law_takes_over_from_the_stick_without_a_jump_and_flies_equation_9(case):
    number, stream, reference = HANDS[case]
    hand = [(3.0, mode(MANUAL)), (4.0, mode(number))]
    flight = GroundFlight(7, hand, every(stick(-40), 3.0, 4.0), stream, reference=reference)
    at = takes_over(flight)
    u = u_of(flight.commands)
    assert flight.commands[at]["true_s"] == pytest.approx(4.0, abs=0.05)
    assert u[at - 1] == pytest.approx(-0.04 * TRAVEL)
    assert abs(u[at] - u[at - 1]) < NO_JUMP
    assert np.abs(np.diff(u[at : at + 40])).max() < SMOOTH
    for c in flight.commands[at:]:
        assert c["u"][0] == pytest.approx(eq9(D4, c), abs=1e-12)


def test_a_vehicle_that_is_armed_late_takes_over_without_a_jump_and_flies_its_profile_from_the_beginning():
    reference = "1.5deg@0.5s,0deg@1.5s"
    x0 = np.array([0.01, 0.0, 0.03])
    flight = GroundFlight(8, [(3.0, long(400, 1.0))], reference=reference, x0=x0, wait_arm=True)
    at = takes_over(flight)
    u = u_of(flight.commands)
    assert set(u[:at]) == {0.0}
    assert {t["u"][0] for t in flight.truth if t["true_s"] < 3.0} == {0.0}
    assert abs(u[at]) < NO_JUMP
    assert np.abs(np.diff(u[at : at + 40])).max() < SMOOTH
    for c in flight.commands[at:]:
        assert c["u"][0] == pytest.approx(eq9(D4, c), abs=1e-12)
    assert starts(flight, reference, 3.0) - flight.commands[at]["j"] <= c_max(flight) + 1
    assert flight.theta_deg(7.9) == pytest.approx(0.0, abs=0.1)


def test_the_reference_that_was_matched_goes_on_by_equation_8():
    flight = GroundFlight(6, [(3.0, mode(MANUAL)), (4.0, mode(GUIDED))], every(stick(-40), 3.0, 4.0))
    at = takes_over(flight)
    reference, commands = MODEL.reference, flight.commands
    assert reference is not None
    r = {c["j"]: c["r"][0] for c in commands}
    for before, after in zip(commands[at:-5], commands[at + 1 : -4], strict=True):
        assert before["d"] == after["d"]
        expected = reference.Ar @ np.array(before["xr"]) + reference.Br[:, 0] * r[before["j"] + before["d"]]
        assert after["xr"] == pytest.approx(expected, abs=1e-12)


# other gains in flight


def test_other_gains_are_taken_in_flight_without_a_jump_and_fly_equation_9_from_then_on():
    flight = GroundFlight(6, [(1.9, put("GAINS", 1.0))], alternatives=(D6,), reference="3deg@1s")
    u = u_of(flight.commands)
    at = next(n for n, c in enumerate(flight.commands) if c["true_s"] > 1.9)
    assert abs(u[at - 1] - u[at - 2]) > 1e-4  # amid the step's manoeuvre
    assert abs(u[at] - u[at - 1]) < NO_JUMP
    for n, c in enumerate(flight.commands):
        assert c["u"][0] == pytest.approx(eq9(D4 if n < at else D6, c), abs=1e-12)
    assert {c["mode"] for c in flight.commands} == {"TRACKING"}
    assert [m.param_value for _, m in flight.seen("PARAM_VALUE") if m.param_id == "GAINS"] == [1.0]
    assert flight.theta_deg(5.9) == pytest.approx(3.0, abs=0.1)


# the map


def metres(a: dialect.MAVLink_message, b: dialect.MAVLink_message) -> float:
    """Return the great-circle distance of two GLOBAL_POSITION_INT, by the haversine."""
    (lat1, lon1), (lat2, lon2) = (np.radians([m.lat / 1e7, m.lon / 1e7]) for m in (a, b))
    h = math.sin((lat2 - lat1) / 2) ** 2 + math.cos(lat1) * math.cos(lat2) * math.sin((lon2 - lon1) / 2) ** 2
    return 2 * 6_371_000.0 * math.asin(math.sqrt(h))


def test_the_position_on_the_map_moves_at_the_airspeed():
    flight = GroundFlight(30)
    fixes = [m for _, m in flight.seen("GLOBAL_POSITION_INT")]
    [airspeed] = {round(m.airspeed, 3) for _, m in flight.seen("VFR_HUD")}
    assert airspeed == pytest.approx(100.23, abs=0.01)  # the HIRM at Mach 0.3
    seconds = (fixes[-1].time_boot_ms - fixes[0].time_boot_ms) / 1000
    assert len(fixes) == pytest.approx(2 * seconds + 1)
    step_s = 0.2  # each fix is as old as the last VFR_HUD that counted, at most
    assert metres(fixes[0], fixes[-1]) == pytest.approx(airspeed * seconds, abs=airspeed * step_s)
    assert math.hypot(fixes[-1].vx, fixes[-1].vy) == pytest.approx(100 * airspeed, abs=1.0)
