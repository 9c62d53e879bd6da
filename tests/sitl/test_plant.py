"""The plant's clockwork, driven by hand: who latches what when, and what the other end is told."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from itertools import pairwise

import jsonschema
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from autopilot.link.topics import SCHEMAS
from autopilot.link.wire import (
    AUTOPILOT,
    Heartbeat,
    HilActuatorControls,
    Message,
    ServoOutputRaw,
    Timesync,
    Wire,
)
from gains.model import Actuator, Trim
from gains.store import load_model
from sitl.aircraft.airframe import Pose
from sitl.aircraft.disturbance import HarmonicGust, SquareDelta
from sitl.aircraft.linear import DIVERGED
from sitl.faults import parse_fault
from sitl.plant import MAX_CATCH_UP, MAX_COMMANDS, SILENCE, PlantConfig, PlantNode, Refusal
from tests.helpers import HEARTBEAT, HIRM, MS, TS, S, broken, parse

quick = settings(deadline=None)
MODEL = HIRM.model
T0 = 137 * S


@dataclass
class Bench:
    """A plant on the bench: frames in, messages and records out, at times given by hand."""

    plant: PlantNode
    wire: Wire = field(default_factory=lambda: Wire(AUTOPILOT, None))
    messages: list = field(default_factory=list)
    made: list = field(default_factory=list)

    def take(self) -> None:
        self.messages += [m for _, datagram in self.plant.outgoing() for m in parse(datagram)]
        self.made += self.plant.records()

    def send(self, message: Message, now_ns: int) -> None:
        self.plant.receive("autopilot", self.wire.encode(message), now_ns)
        self.take()

    def command(self, j: int, u: float, now_ns: int) -> None:
        """Send the command of sample j."""
        stamp_us = (T0 + j * TS) // 1000
        self.send(HilActuatorControls(stamp_us, self.plant.travel.to_control(u)), now_ns)

    def tick(self, now_ns: int) -> None:
        self.plant.tick(now_ns)
        self.take()

    def samples(self, first: int, last: int) -> None:
        """Tick samples ``first`` to ``last`` on their instants."""
        for k in range(first, last + 1):
            self.tick(T0 + k * TS)

    @property
    def truth(self) -> list:
        return [r.body for r in self.made if r.topic == "plant/truth"]

    def events(self, kind: str) -> list:
        return [r.body for r in self.made if r.topic == "events" and r.body["kind"] == kind]

    def of(self, kind: str) -> list:
        return [m for m in self.messages if m.get_type() == kind]

    def named(self, name: str) -> list:
        return [m for m in self.of("NAMED_VALUE_INT") if m.name == name]


def bench(start_ns: int | None = T0, **config) -> Bench:
    """Return a plant whose sample 0 is at T0."""
    made = Bench(PlantNode(PlantConfig(**{"model": MODEL, **config})))
    if start_ns is not None:
        made.send(HEARTBEAT, start_ns)
    return made


# start


def test_before_anybody_speaks_the_plant_is_silent_and_asks_for_nothing():
    b = bench(None)
    assert b.plant.next_deadline_ns() is None
    b.tick(T0 + S)
    assert (b.messages, b.made) == ([], [])


def test_the_state_is_held_until_the_first_heartbeat():
    x0 = np.array([0.1, 0.2, 0.3])
    b = bench(None, x0=x0)
    b.send(Timesync(0, 7), T0)
    for n in range(100):
        b.tick(T0 + n * TS)
    assert b.truth == []
    b.send(HEARTBEAT, T0 + 100 * TS)
    b.tick(T0 + 100 * TS)
    assert [(t["k"], t["t_ns"], t["x"]) for t in b.truth] == [(0, T0 + 100 * TS, x0.tolist())]


@pytest.mark.parametrize(("late_ns", "t0_ns"), [(0, T0), (1, T0 + TS), (TS - 1, T0 + TS), (TS, T0 + TS)])
def test_sample_0_is_the_first_instant_of_the_grid_from_the_first_heartbeat_on(late_ns, t0_ns):
    b = bench(T0 + late_ns)
    b.tick(t0_ns - 1)
    assert b.truth == []
    b.tick(t0_ns)
    assert [(t["k"], t["t_ns"]) for t in b.truth] == [(0, t0_ns)]
    assert len(b.events("clockwork")) == 1


def test_later_heartbeats_do_not_start_again():
    b = bench()
    b.samples(0, 5)
    b.send(HEARTBEAT, T0 + 5 * TS + 1)
    b.samples(6, 9)
    assert [t["k"] for t in b.truth] == list(range(10))


def test_frames_of_others_start_nothing():
    b = bench(None)
    b.plant.receive("autopilot", Wire((255, 190), None).encode(HEARTBEAT), T0)
    assert b.plant.next_deadline_ns() is None


def test_without_a_first_state_the_flight_starts_at_trim():
    trim = Trim(np.array([0.05, 0.0, 0.05]), np.array([-0.02]))
    b = bench(model=replace(MODEL, trim=trim))
    b.samples(0, 50)
    for body in b.truth:
        assert body["x"] == pytest.approx(trim.x, abs=1e-15)
        assert body["u"] == [-0.02]


def test_the_plant_speaks_as_an_aircraft_without_autopilot_once_a_second():
    b = bench()
    for n in range(101):
        b.tick(T0 + n * TS)
    beats = b.of("HEARTBEAT")
    assert len(beats) == 3
    assert {(m.get_srcSystem(), m.get_srcComponent(), m.autopilot) for m in beats} == {
        (1, 25, dialect.MAV_AUTOPILOT_INVALID)
    }


# TIMESYNC


def test_timesync_is_answered_with_the_plants_time_before_and_in_flight():
    b = bench(None)
    b.send(Timesync(0, 77), T0 - 123)
    b.send(HEARTBEAT, T0)
    b.samples(0, 1)
    b.send(Timesync(0, -5), T0 + TS + 9)
    assert [(m.tc1, m.ts1) for m in b.of("TIMESYNC")] == [(T0 - 123, 77), (T0 + TS + 9, -5)]


def test_a_timesync_answer_is_not_answered():
    b = bench()
    b.send(Timesync(5, 77), T0)
    assert b.of("TIMESYNC") == []


# latch


def test_a_reply_within_the_same_sample_is_applied_at_the_next_so_d_min_is_1():
    b = bench()
    b.samples(0, 0)
    b.command(0, 0.1, T0)  # at the very instant of the sample, after it
    b.samples(1, 1)
    assert [(t["j"], t["d"], t["u"]) for t in b.truth] == [(None, None, [0.0]), (0, 1, [pytest.approx(0.1, abs=1e-7)])]


def test_a_command_at_the_instant_of_a_sample_is_in_time_and_one_ns_later_is_not():
    for late_ns, d in ((0, 1), (1, None)):
        b = bench()
        b.samples(0, 0)
        b.plant.receive("autopilot", b.wire.encode(HilActuatorControls(T0 // 1000, 0.5)), T0 + TS + late_ns)
        b.tick(T0 + TS + late_ns)
        assert b.truth[1]["d"] == d


def test_without_new_commands_d_grows_by_one_per_sample():
    b = bench(servo_timeout=None)
    b.samples(0, 0)
    b.command(0, 0.1, T0 + 1)
    b.samples(1, 300)
    assert [t["d"] for t in b.truth[1:]] == list(range(1, 301))
    assert {t["u"][0] for t in b.truth[1:]} == {b.truth[1]["u"][0]}


def test_newest_latches_the_newest_sample_and_last_the_last_arrival():
    for latch, expected in (("newest", [(3, 1), (3, 2)]), ("last", [(1, 3), (0, 5)])):
        b = bench(latch=latch)
        b.samples(0, 3)
        for n, j in enumerate((2, 3, 1)):
            b.command(j, 0.01 * j, T0 + 3 * TS + n)
        b.samples(4, 4)
        b.command(0, 0.0, T0 + 4 * TS + 1)
        b.samples(5, 5)
        assert [(t["j"], t["d"]) for t in b.truth[4:]] == expected
        assert b.truth[4]["u"] == [pytest.approx(0.01 * expected[0][0], abs=1e-7)]


def test_only_last_flies_a_delay_that_jumps_up_by_more_than_one():
    for latch, jumps in (("newest", False), ("last", True)):
        b = bench(latch=latch)
        b.samples(0, 10)
        b.command(10, 0.0, T0 + 10 * TS + 1)
        b.samples(11, 11)
        b.command(4, 0.0, T0 + 11 * TS + 1)
        b.samples(12, 12)
        assert (b.truth[12]["d"] - b.truth[11]["d"] > 1) is jumps


@pytest.mark.parametrize("latch", ["newest", "last"])
def test_a_command_of_equal_stamp_replaces_the_one_before(latch):
    b = bench(latch=latch)
    b.samples(0, 3)
    for u in (0.1, 0.2):
        b.command(3, u, T0 + 3 * TS + 1)
    b.samples(4, 4)
    b.command(3, -0.1, T0 + 4 * TS + 1)
    b.samples(5, 5)
    assert [t["u"][0] for t in b.truth[4:]] == pytest.approx([0.2, -0.1], abs=1e-7)
    assert [t["d"] for t in b.truth[4:]] == [1, 2]


@pytest.mark.parametrize("j", [4, 5, 1000, -1, -1000])
def test_a_sample_that_has_not_been_sent_cannot_be_answered(j):
    b = bench()
    b.samples(0, 3)
    b.command(j, 0.1, T0 + 3 * TS + 1)
    b.samples(4, 4)
    assert b.truth[4]["j"] is None
    assert b.plant.refusals == {Refusal.STAMP: 1}


@pytest.mark.parametrize("stamp_us", [0, (1 << 63), (1 << 64) - 1])
def test_absurd_stamps_are_refused(stamp_us):
    b = bench()
    b.samples(0, 3)
    b.send(HilActuatorControls(stamp_us, 0.5), T0 + 3 * TS + 1)
    assert b.plant.refusals == {Refusal.STAMP: 1}


def test_a_command_before_the_first_heartbeat_is_refused():
    b = bench(None)
    b.command(0, 0.1, T0)
    assert b.plant.refusals == {Refusal.NOT_FLYING: 1}


def test_a_pulse_outside_the_travel_is_refused():
    b = bench()
    b.samples(0, 0)
    for pulse in (0, 999, 2001, 65_535):
        b.send(ServoOutputRaw(T0 // 1000, pulse), T0 + 1)
    for control in (-1.5, 1.5):
        b.send(HilActuatorControls(T0 // 1000, control), T0 + 1)
    b.samples(1, 1)
    assert b.plant.refusals == {Refusal.RANGE: 6}
    assert b.truth[1]["j"] is None


def test_commands_of_one_sample_are_bounded():
    b = bench()
    b.samples(0, 0)
    for _ in range(MAX_COMMANDS + 9):
        b.command(0, 0.1, T0 + 1)
    assert b.plant.refusals == {Refusal.OVERFLOW: 9}
    b.samples(1, 1)
    b.command(1, 0.1, T0 + TS + 1)
    b.samples(2, 2)
    assert b.truth[2]["d"] == 1


def test_pulses_are_quantised_and_floats_are_not():
    for message, tolerance in (
        (lambda t: ServoOutputRaw(t, 1734), 0.0),
        (lambda t: HilActuatorControls(t, 0.468), 2e-8),
    ):
        b = bench()
        b.samples(0, 0)
        b.send(message(T0 // 1000), T0 + 1)
        b.samples(1, 1)
        assert b.truth[1]["u"][0] == pytest.approx(math.radians(25 * 0.468), abs=tolerance or 1e-15)


def test_microsecond_stamps_wrap_after_71_minutes():
    turn_ns = (1 << 32) * 1000
    start_ns = -(-turn_ns // TS) * TS - 20 * TS
    b = bench(start_ns)
    for k in range(60):
        t_ns = start_ns + k * TS
        b.tick(t_ns)
        b.send(ServoOutputRaw((t_ns // 1000) & 0xFFFFFFFF, 1600), t_ns + 1)
    assert start_ns // turn_ns != (start_ns + 59 * TS) // turn_ns
    assert [t["d"] for t in b.truth] == [None] + [1] * 59
    assert not b.plant.refusals


@settings(deadline=None, max_examples=60)
@given(
    st.lists(st.tuples(st.integers(0, 30), st.integers(0, 12 * TS), st.booleans()), max_size=40),
    st.sampled_from(["newest", "last"]),
)
def test_the_latch_is_that_of_the_papers_loop_for_any_arrivals(plan, latch):
    """Against the sentence itself: of the commands that came by t_k, the newest stamp, or the last arrival."""
    arrivals = sorted((T0 + j * TS + 1 + late_ns, n, j) for n, (j, late_ns, kept) in enumerate(plan) if kept)
    b = bench(latch=latch, servo_timeout=None)
    waiting = list(arrivals)
    for k in range(45):
        t_ns = T0 + k * TS
        while waiting and waiting[0][0] <= t_ns:
            at_ns, n, j = waiting.pop(0)
            b.command(j, n / 100, at_ns)
        b.tick(t_ns)
    for body in b.truth:
        came = [(j, at_ns, n) for at_ns, n, j in arrivals if at_ns <= T0 + body["k"] * TS]
        if not came:
            assert (body["j"], body["d"]) == (None, None)
            continue
        j, _, n = max(came) if latch == "newest" else max(came, key=lambda c: c[1:])
        assert (body["j"], body["d"]) == (j, body["k"] - j)
        assert body["u"][0] == pytest.approx(n / 100, abs=1e-7)
    if latch == "newest":
        d = [body["d"] for body in b.truth if body["d"] is not None]
        assert all(after <= before + 1 for before, after in pairwise(d))


# late wake-ups


def test_a_late_wake_up_catches_up_every_sample_and_says_how_late():
    b = bench()
    b.samples(0, 0)
    b.tick(T0 + 5 * TS + 3)
    assert [(t["k"], t["t_ns"], t["late_ns"]) for t in b.truth] == [
        (k, T0 + k * TS, 5 * TS + 3 - k * TS if k else 0) for k in range(6)
    ]
    assert b.plant.next_deadline_ns() == T0 + 6 * TS
    assert [m.time_boot_ms for m in b.of("ATTITUDE")] == [(T0 + k * TS) // MS for k in range(6)]


def test_catching_up_uses_only_the_commands_that_had_come_by_each_sample():
    b = bench()
    b.samples(0, 2)
    b.command(1, 0.1, T0 + 3 * TS + 5)
    b.command(2, 0.2, T0 + 5 * TS - 5)
    b.tick(T0 + 6 * TS)
    assert [t["j"] for t in b.truth] == [None, None, None, None, 1, 2, 2]
    assert [t["u"][0] for t in b.truth[4:]] == pytest.approx([0.1, 0.2, 0.2], abs=1e-7)


def test_a_late_flight_is_the_same_flight():
    on_time, late = bench(x0=np.array([0.1, 0.0, 0.1])), bench(x0=np.array([0.1, 0.0, 0.1]))
    on_time.samples(0, 60)
    late.samples(0, 0)
    late.tick(T0 + 60 * TS + 7)
    assert [t["x"] for t in late.truth] == [t["x"] for t in on_time.truth]


def test_one_wake_up_works_off_a_bounded_number_and_the_rest_follows_at_once():
    b = bench()
    now_ns = T0 + 1000 * TS
    b.tick(now_ns)
    assert len(b.truth) == MAX_CATCH_UP
    while (due_ns := b.plant.next_deadline_ns()) is not None and due_ns <= now_ns:
        b.tick(now_ns)
    assert [t["k"] for t in b.truth] == list(range(1001))


def test_a_tick_before_its_time_is_harmless():
    b = bench()
    b.samples(0, 0)
    for n in range(1, 10):
        b.tick(T0 + n)
    assert len(b.truth) == 1


# servo time-out


def test_the_servo_times_out_to_neutral_and_comes_back():
    b = bench(servo_timeout=9)
    b.samples(0, 0)
    b.command(0, 0.2, T0 + 1)
    b.samples(1, 20)
    assert [t["timeout"] for t in b.truth] == [False] * 10 + [True] * 11
    assert [t["u"][0] for t in b.truth[1:]] == pytest.approx([0.2] * 9 + [0.0] * 11, abs=1e-7)
    b.command(20, 0.1, T0 + 20 * TS + 1)
    b.samples(21, 21)
    assert (b.truth[21]["timeout"], b.truth[21]["d"]) == (False, 1)
    assert b.truth[21]["u"][0] == pytest.approx(0.1, abs=1e-7)
    assert [e["data"]["active"] for e in b.events("servo_timeout")] == [True, False]


def test_an_old_command_does_not_keep_the_servo_alive():
    b = bench(servo_timeout=5)
    b.samples(0, 5)
    b.command(5, 0.2, T0 + 5 * TS + 1)
    for k in range(6, 15):
        b.samples(k, k)
        b.command(3, 0.1, T0 + k * TS + 1)
    assert [t["timeout"] for t in b.truth[6:]] == [False] * 5 + [True] * 4


def test_before_the_first_command_there_is_nothing_to_time_out():
    b = bench(servo_timeout=2)
    b.samples(0, 50)
    assert b.events("servo_timeout") == []
    assert not any(t["timeout"] for t in b.truth)


def test_neutral_is_the_trim_input():
    trim = Trim(np.zeros(3), np.array([-0.1]))
    b = bench(model=replace(MODEL, trim=trim), servo_timeout=3)
    b.samples(0, 0)
    b.command(0, 0.2, T0 + 1)
    b.samples(1, 10)
    assert b.truth[10]["u"] == [-0.1]


# what is sent


def test_each_sample_sends_its_state_on_the_samples_own_stamp():
    x0 = np.array([0.02, -0.1, 0.05])
    b = bench(x0=x0)
    b.tick(T0 + 3 * TS + 11)
    for k, (attitude, air, hud) in enumerate(zip(b.of("ATTITUDE"), b.of("AOA_SSA"), b.of("VFR_HUD"), strict=True)):
        alpha, q, theta = b.truth[k]["x"]
        assert (attitude.time_boot_ms, air.time_usec) == ((T0 + k * TS) // MS, (T0 + k * TS) // 1000)
        assert [attitude.pitchspeed, attitude.pitch] == pytest.approx([q, theta], rel=1e-6)
        assert math.radians(air.AOA) == pytest.approx(alpha, rel=1e-6)
        assert hud.airspeed == pytest.approx(100.23, rel=1e-6)
        assert hud.climb == pytest.approx(100.23 * math.sin(theta - alpha), rel=1e-5)
    assert b.of("VFR_HUD")[0].alt == pytest.approx(1600.0)


def test_the_delay_is_reported_as_the_plant_saw_it():
    b = bench()
    b.samples(0, 3)
    b.command(2, 0.1, T0 + 3 * TS + 1)
    b.samples(4, 8)
    assert [(m.time_boot_ms, m.value) for m in b.named("DELAY_K")] == [
        ((T0 + k * TS) // MS, k - 2) for k in range(4, 9)
    ]


def numbered(b: Bench) -> list[int]:
    """Return the samples that were sent with their number, each with the stamp of its instant."""
    numbers = [(m.time_boot_ms, m.value) for m in b.named("SAMPLE_K")]
    assert [stamp for stamp, _ in numbers] == [(T0 + k * TS) // MS for _, k in numbers]
    return [k for _, k in numbers]


def test_the_number_is_sent_with_every_sample_until_a_command_and_then_every_second():
    b = bench(servo_timeout=None)
    b.samples(0, 4)
    for k in range(5, 201):
        b.command(k - 1, 0.0, T0 + (k - 1) * TS + 1)
        b.tick(T0 + k * TS)
    assert numbered(b) == [*range(5), 40, 80, 120, 160, 200]


@pytest.mark.parametrize("servo_timeout", [None, 5])
def test_an_autopilot_that_starts_again_need_not_wait_a_second_for_the_number(servo_timeout: int | None):
    b = bench(servo_timeout=servo_timeout)
    b.samples(0, 4)
    b.command(4, 0.0, T0 + 4 * TS + 1)
    b.samples(5, 20)
    assert numbered(b) == [*range(5), *range(5 + SILENCE, 21)]
    b.command(20, 0.0, T0 + 20 * TS + 1)
    b.samples(21, 21 + SILENCE - 1)
    assert numbered(b)[-1] == 20


def test_a_plant_without_aoa_ssa_sends_all_else_as_with_it():
    x0 = np.array([0.02, -0.1, 0.05])
    told, untold = bench(x0=x0), bench(x0=x0, aoa=False)
    for b in (told, untold):
        b.samples(0, 40)
    assert len(told.of("AOA_SSA")) == 41
    assert [m.to_dict() for m in untold.messages] == [m.to_dict() for m in told.messages if m.get_type() != "AOA_SSA"]
    assert untold.truth == told.truth


def test_the_pendulum_sends_no_angle_of_attack():
    b = bench(model=load_model("pendulum"), x0=np.array([0.1, 0.0]))
    b.tick(T0 + 10 * S)
    assert b.of("AOA_SSA") == []
    assert b.of("ATTITUDE")[0].pitch == pytest.approx(0.1)


# the aircraft


def test_the_record_is_the_equations_by_matrices():
    gust, delta = HarmonicGust(1), SquareDelta()
    b = bench(x0=np.array([0.01, 0.0, 0.02]), gust=gust, delta=delta)
    for k in range(80):
        b.samples(k, k)
        b.command(k, 0.1 * math.sin(0.3 * k), T0 + k * TS + 1)
    m, mu = MODEL, np.array([0.1, 0.1])
    for now, then in pairwise(b.truth):
        k = now["k"]
        w = math.radians(25.0 * mu[0])
        big = 0.15 if k % 40 < 20 else -0.15
        A = m.A + big * m.uncertainty.F @ m.uncertainty.J1
        B = m.B + big * m.uncertainty.F @ m.uncertainty.J2
        assert (now["w"], now["delta"]) == ([pytest.approx(w, rel=1e-12)], big)
        expected = A @ now["x"] + B[:, 0] * now["u"][0] + m.E[:, 0] * w
        np.testing.assert_allclose(then["x"], expected, rtol=1e-12, atol=1e-15)
        mu = np.array([[0.9922, 0.1247], [-0.1247, 0.9922]]) @ mu


def test_two_plants_of_one_configuration_do_not_share_their_gust():
    config = PlantConfig(MODEL, gust=HarmonicGust(1))
    flights = [Bench(PlantNode(config)), Bench(PlantNode(config))]
    for b in flights:
        b.send(HEARTBEAT, T0)
        b.samples(0, 60)
    assert [t["w"] for t in flights[0].truth] == [t["w"] for t in flights[1].truth]


def test_a_lagging_actuator_is_recorded_where_it_is():
    limits = Actuator(MODEL.actuator.low, MODEL.actuator.high, tau=np.array([0.05]))
    b = bench(model=replace(MODEL, actuator=limits), servo_timeout=None)
    b.samples(0, 0)
    b.command(0, 0.2, T0 + 1)
    b.samples(1, 40)
    t = MODEL.Ts * np.arange(1, 41)
    found = [body["u"][0] for body in b.truth[1:]]
    np.testing.assert_allclose(found, 0.2 * (1 - np.exp(-t / 0.05)), atol=1e-7)


def test_a_crash_stops_the_aircraft_and_not_the_plant():
    b = bench(model=load_model("pendulum"), x0=np.array([0.5, 0.0]))
    step_ns = 30 * MS
    start = b.plant.next_deadline_ns()
    for n in range(400):
        b.tick(T0 + n * step_ns + start % step_ns)
    x = np.array([t["x"] for t in b.truth])
    assert np.all(np.abs(x) < DIVERGED)
    assert np.all(x[-1] == x[-50])
    assert len(b.truth) > 390
    assert len(b.events("diverged")) == 1


@dataclass
class Puppet:
    """An airframe moved by hand: one degree of roll and ten metres up per sample, and a wall at the fifth."""

    x: np.ndarray = field(default_factory=lambda: np.array([0.05, 0.0, 0.07]))
    pose: Pose = field(
        default_factory=lambda: Pose(pitch_rad=0.07, alpha_rad=0.05, throttle=0.42, yaw_rad=-math.pi / 2)
    )
    moved: list = field(default_factory=list)

    def advance(self, u, w, delta) -> str | None:
        self.moved.append((u.tolist(), w.tolist()))
        if len(self.moved) == 5:
            return "a wall"
        up = {"roll_rad": self.pose.roll_rad + math.radians(1.0), "altitude_m": self.pose.altitude_m + 10.0}
        self.pose = self.pose._replace(**up, airspeed_m_s=80.0, climb_m_s=1.5, beta_rad=0.01, p_rad_s=0.3)
        return None


def test_an_airframe_says_all_of_its_pose_and_is_recorded_with_it():
    b = bench(airframe=Puppet)
    b.samples(0, 2)
    attitude, air, hud = b.of("ATTITUDE")[2], b.of("AOA_SSA")[2], b.of("VFR_HUD")[2]
    assert attitude.roll == pytest.approx(math.radians(2.0))
    assert (attitude.rollspeed, attitude.pitch, attitude.yaw) == pytest.approx((0.3, 0.07, -math.pi / 2))
    assert math.radians(air.AOA) == pytest.approx(0.05)
    assert math.radians(air.SSA) == pytest.approx(0.01)
    assert (hud.airspeed, hud.alt, hud.climb, hud.heading, hud.throttle) == (80.0, 20.0, 1.5, 270, 42)
    assert b.truth[2]["air"]["altitude_m"] == 20.0
    jsonschema.validate(b.truth[2], dict(SCHEMAS["plant/truth"]))


def test_a_sensor_fault_of_an_airframe_changes_what_is_sent_and_not_the_pose():
    b = bench(airframe=Puppet, faults=(parse_fault("sensor:theta_rad:bias:0.5@0s"),))
    b.samples(0, 0)
    assert b.of("ATTITUDE")[0].pitch == pytest.approx(0.57)
    assert math.radians(b.of("AOA_SSA")[0].AOA) == pytest.approx(0.05)


def test_an_airframe_that_cannot_fly_on_stays_where_it_is_and_says_why():
    b = bench(airframe=Puppet)
    b.samples(0, 9)
    assert [e["text"] for e in b.events("diverged")] == ["a wall at sample 5"]
    assert b.truth[9]["air"] == b.truth[4]["air"]
    assert len(b.plant.airframe.moved) == 5


def test_an_airframe_starts_where_it_is_at_each_start_of_the_plant():
    config = PlantConfig(MODEL, airframe=Puppet)
    first, second = PlantNode(config), PlantNode(config)
    first.airframe.advance(np.zeros(1), np.zeros(1), 0.0)
    assert second.airframe.pose.altitude_m == 0.0


def test_records_keep_their_schema():
    b = bench(gust=HarmonicGust(1), delta=SquareDelta())
    b.samples(0, 3)
    b.command(3, 0.1, T0 + 3 * TS + 1)
    b.samples(4, 20)
    for record in b.made:
        assert set(record.body) == set(SCHEMAS[record.topic]["required"])


# faults


def faulty(*texts: str, samples: int = 40, **config) -> Bench:
    """Return a plant with faults after some samples, flown with a command that moves from sample to sample."""
    b = bench(x0=np.array([0.01, 0.1, 0.02]), faults=tuple(map(parse_fault, texts)), **config)
    for k in range(samples):
        b.samples(k, k)
        b.command(k, 0.1 * math.sin(0.5 * k), T0 + k * TS + 1)
    return b


def pitches(b: Bench) -> list:
    return [m.pitch for m in b.of("ATTITUDE")]


HEALTHY = faulty()
TRUE = np.array([t["x"][2] for t in HEALTHY.truth])


def test_a_frozen_sensor_repeats_what_it_said_last_from_the_first_sample_in_the_fault_to_the_last():
    b = faulty("sensor:theta_rad:frozen@250ms+250ms")  # samples 10 to 19
    expected = [*TRUE[:10], *[TRUE[9]] * 10, *TRUE[20:]]
    assert pitches(b) == pytest.approx(expected, abs=1e-7)


def test_a_fault_that_begins_and_ends_between_samples_takes_those_inside():
    b = faulty("sensor:theta_rad:bias:0.5@251ms+249.000001ms")  # after sample 10, just past sample 20
    assert np.flatnonzero(np.abs(pitches(b) - TRUE) > 0.1).tolist() == list(range(11, 21))


def test_a_sensor_frozen_from_the_beginning_repeats_its_first_value():
    assert pitches(faulty("sensor:theta_rad:frozen@0s")) == pytest.approx([TRUE[0]] * 40, abs=1e-7)


def test_a_bias_adds_in_the_unit_of_the_state_and_noise_is_gaussian_and_of_the_seed():
    b = faulty("sensor:alpha_rad:bias:0.02@0s")
    air = [math.radians(m.AOA) for m in b.of("AOA_SSA")]
    assert air == pytest.approx([t["x"][0] + 0.02 for t in b.truth], abs=1e-7)
    one, same, other = (faulty("sensor:theta_rad:noise:0.1@0s", samples=400, seed=seed) for seed in (1, 1, 2))
    noise = np.array(pitches(one)) - [t["x"][2] for t in one.truth]
    assert pitches(one) == pitches(same)
    assert pitches(one) != pitches(other)
    assert abs(noise.mean()) < 4 * 0.1 / math.sqrt(400)
    assert abs(np.mean(np.abs(noise) > 0.0674) - 0.5) < 4 * 0.5 / math.sqrt(400)  # half of N(0, s²) is within 0.674 s


def test_one_more_fault_does_not_change_the_noise_of_another():
    alone = faulty("sensor:theta_rad:noise:0.1@0s")
    together = faulty("sensor:theta_rad:noise:0.1@0s", "sensor:q_rad_s:noise:0.1@0s")
    assert pitches(alone) == pitches(together)


def test_a_sensor_that_says_nan_says_it_in_its_field_only():
    b = faulty("sensor:theta_rad:nan@250ms+250ms")
    assert [k for k, m in enumerate(b.of("ATTITUDE")) if math.isnan(m.pitch)] == list(range(10, 20))
    assert [m.pitchspeed for m in b.of("ATTITUDE")] == [m.pitchspeed for m in HEALTHY.of("ATTITUDE")]
    assert [(m.alt, m.climb) for m in b.of("VFR_HUD")] == [(m.alt, m.climb) for m in HEALTHY.of("VFR_HUD")]


def test_what_sensors_say_does_not_change_the_truth():
    b = faulty("sensor:theta_rad:nan@0s", "sensor:q_rad_s:bias:3@0s", "sensor:alpha_rad:noise:1@0s")
    assert b.truth == HEALTHY.truth


def positions(b: Bench) -> np.ndarray:
    return np.array([t["u"][0] for t in b.truth])


def test_a_stuck_elevator_stays_where_it_is_and_the_record_says_so():
    b, free = positions(faulty("elevator:stuck@250ms+250ms")), positions(HEALTHY)
    assert b[10:20].tolist() == [free[9]] * 10
    assert [*b[:10], *b[20:]] == [*free[:10], *free[20:]]


def test_a_slow_elevator_is_limited_in_its_rate():
    b, free = positions(faulty("elevator:slow:0.5@0s")), positions(HEALTHY)
    steps = np.abs(np.diff(b))
    assert steps.max() == pytest.approx(0.5 * MODEL.Ts, rel=1e-12)
    assert np.abs(np.diff(free)).max() > 2 * steps.max()


def test_a_slow_elevator_is_no_faster_than_its_model():
    limits = Actuator(MODEL.actuator.low, MODEL.actuator.high, rate=np.array([0.2]))
    b = faulty("elevator:slow:0.5@0s", model=replace(MODEL, actuator=limits))
    assert np.abs(np.diff(positions(b))).max() == pytest.approx(0.2 * MODEL.Ts, rel=1e-12)


def test_a_reversed_elevator_goes_as_far_to_the_other_side_of_neutral():
    trim = Trim(np.zeros(3), np.array([-0.02]))
    straight = faulty(model=replace(MODEL, trim=trim))
    b = faulty("elevator:reversed@250ms", model=replace(MODEL, trim=trim))
    assert positions(b)[:10].tolist() == positions(straight)[:10].tolist()
    assert positions(b)[10:] + 0.02 == pytest.approx(-(positions(straight)[10:] + 0.02), abs=1e-15)
    assert np.abs(positions(b)[10:] + 0.02).max() > 0.05


# hostile datagrams


def test_20000_broken_datagrams_change_nothing_that_flies():
    rng = np.random.default_rng(2)
    flown, spared = bench(), bench()
    noise = Wire(AUTOPILOT, None)
    strangers = [Wire(source, None) for source in ((1, 25), (2, 1), (255, 190), (1, 2))]
    sent = 0
    for k in range(100):
        for b in (flown, spared):
            b.samples(k, k)
            b.command(k, 0.2 * math.sin(0.1 * k), T0 + k * TS + 1)
        before = flown.plant.next_deadline_ns()
        for n in range(200):
            message = (ServoOutputRaw(T0 // 1000 + 25_000 * k, 1900), HEARTBEAT, Timesync(0, 5))[n % 3]
            datagram = strangers[n % 4].encode(message) if n % 5 == 0 else broken(noise.encode(message), rng)
            flown.plant.receive("autopilot", datagram, T0 + k * TS + 2)
            sent += 1
        assert flown.plant.next_deadline_ns() == before
    assert sent == 20_000
    assert flown.plant.outgoing() == []
    assert flown.truth == spared.truth
    assert flown.events("clockwork") == spared.events("clockwork")
    assert flown.plant.refusals == spared.plant.refusals


def test_valid_frames_with_wild_contents_raise_nothing():
    rng = np.random.default_rng(3)
    b = bench()
    for k in range(50):
        b.samples(k, k)
        for _ in range(20):
            stamp = int(rng.integers(0, 1 << 63)) * 2
            b.send(ServoOutputRaw(stamp, int(rng.integers(0, 1 << 16))), T0 + k * TS + 1)
            b.send(
                HilActuatorControls(stamp, float(np.float32(rng.normal() * 10.0 ** rng.integers(-30, 30)))),
                T0 + k * TS + 1,
            )
            b.send(Timesync(int(rng.integers(-(1 << 62), 1 << 62)), stamp // 2 - 1), T0 + k * TS + 1)
            b.send(Heartbeat(*(int(n) for n in rng.integers(0, 255, 5))), T0 + k * TS + 1)
    assert [t["k"] for t in b.truth] == list(range(50))
    assert np.all(np.isfinite([t["x"] for t in b.truth]))
