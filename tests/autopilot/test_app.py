"""The autopilot as a whole: start, one command per sample, failsafe, restarts; in virtual time."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect
from scipy.signal import dlsim

from autopilot.app import AutopilotNode
from autopilot.config import AutopilotConfig
from autopilot.failsafe import Mode
from autopilot.link.clock import Clock
from autopilot.link.groundmessages import CommandLong
from autopilot.link.topics import SCHEMAS
from autopilot.link.wire import (
    AUTOPILOT,
    PLANT,
    AoaSsa,
    Attitude,
    Message,
    NamedValueInt,
    Timesync,
    VfrHud,
    Wire,
    plant_heartbeat,
)
from autopilot.profile import Profile, parse_profile
from gains.store import load_gains
from gains.table import InputError
from sitl.plant import PlantConfig, PlantNode
from tests.autopilot.bench import X0, Bench
from tests.helpers import AUTOPILOT_CLOCK, HIRM, MS, PLANT_CLOCK, TS, Flight, S, broken, constant, parse

DAY = 86_400 * S
D_MAX = HIRM.d_max
STEP = parse_profile("5deg@1s", 0.025)
LEARNT = 3 * S
"""By this time every flight here is well in TRACKING."""


def cut(latency_ns: int, *blackouts: tuple[float, float]) -> Callable[[int], int | None]:
    """Return a constant latency that loses everything in the given stretches of seconds."""
    return lambda now_ns: None if any(a * S <= now_ns < b * S for a, b in blackouts) else latency_ns


def changing(*steps: tuple[float, int]) -> Callable[[int], int]:
    """Return a latency that changes at the given seconds."""
    return lambda now_ns: [latency_ns for at_s, latency_ns in steps if now_ns >= at_s * S][-1]


def by_scipy(profile: Profile) -> np.ndarray:
    """Return xr(0), xr(1), ... of Eq. (8) as scipy simulates it."""
    m = HIRM.model.reference
    r = np.array([profile.r(k) for k in range(400)])
    return dlsim((m.Ar, m.Br, m.Cr, np.zeros((1, 1)), 1.0), r[:, None], x0=np.zeros(3))[2]


def modes(flight: Flight, since_ns: int = 0) -> set[str]:
    return {str(body["mode"]) for body in flight.bodies("autopilot/command", since_ns)}


# start-up


def test_timesync_comes_first_and_the_heartbeat_only_when_the_delay_can_be_forecast():
    flight = Flight(up=constant(20 * MS), down=constant(20 * MS)).fly(2 * S)
    sent = [(t_ns, m.get_type()) for t_ns, m in flight.sent("autopilot", "plant")]
    assert sent[0] == (0, "TIMESYNC")
    first_beat_ns = next(t_ns for t_ns, kind in sent if kind == "HEARTBEAT")
    answers = [t_ns for t_ns, m in flight.sent("plant", "autopilot") if m.get_type() == "TIMESYNC"]
    assert sum(t_ns + 20 * MS <= first_beat_ns for t_ns in answers) == 5
    assert first_beat_ns < 0.4 * S
    assert not any(kind.startswith("SERVO") for t_ns, kind in sent if t_ns < first_beat_ns)
    assert {body["status"] for body in flight.bodies("autopilot/command")} == {"converging"}
    assert all(body["d"] == 2 for body in flight.bodies("autopilot/command"))


def test_a_plant_without_timesync_gets_its_heartbeat_after_two_seconds():
    node = AutopilotNode(AutopilotConfig(HIRM))
    beats, now_ns = [], 1042 * S
    while now_ns <= 1045 * S:
        node.tick(now_ns)
        beats += [now_ns for p, d in node.outgoing() for m in parse(d) if (p, m.get_type()) == ("plant", "HEARTBEAT")]
        now_ns = max(now_ns + 1, node.next_deadline_ns())
    assert 1044 * S <= beats[0] <= 1044 * S + 50 * MS
    assert beats[1] - beats[0] == S


def test_an_unknown_delay_is_never_flown():
    b = Bench(answers=False)
    for k in range(200):
        b.sample(k)
    assert len(b.commands) == 200
    assert {(str(c["mode"]), c["d"], str(c["status"]), c["u"][0]) for c in b.commands} == {
        ("STANDBY", None, "unknown", 0.0)
    }


def test_the_station_is_told_at_start_that_the_gains_have_no_certificate():
    flight = Flight().fly(S)
    texts = [m.text for _, m in flight.sent("autopilot", "gcs0") if m.get_type() == "STATUSTEXT"]
    assert "no verified certificate" in texts[0]
    assert "hirm-paper" in texts[0]
    [event] = flight.events("gains")
    assert (event["data"]["verified"], event["data"]["d_min"], event["data"]["d_max"]) == (False, 1, 4)


def test_a_long_name_does_not_push_the_missing_certificate_out_of_the_text():
    b = Bench(AutopilotConfig(replace(HIRM, name="hirm-pitch-hold-over-the-long-radio-link")))
    b.to(b.now_ns)
    assert "no verified certificate" in b.texts()[0]


def test_a_model_that_cannot_be_flown_is_refused():
    with pytest.raises(InputError, match=r"sensors\.alpha_rad"):
        AutopilotNode(AutopilotConfig(replace(HIRM, model=replace(HIRM.model, sensors={}))))


# one command per sample


@pytest.mark.parametrize(
    ("actuator", "kind", "wraps"), [("pwm", "SERVO_OUTPUT_RAW", True), ("float", "HIL_ACTUATOR_CONTROLS", False)]
)
def test_every_sample_makes_one_command_with_the_samples_own_stamp(actuator, kind, wraps):
    flight = Flight(AutopilotConfig(HIRM, STEP, actuator=actuator), PlantConfig(HIRM.model, X0)).fly(5 * S)
    commands = flight.bodies("autopilot/command")
    truth = {body["k"]: body for body in flight.bodies("plant/truth")}
    j = [c["j"] for c in commands]
    assert j == list(range(len(j)))
    assert len(j) > 180
    frames = [m for _, m in flight.sent("autopilot", "plant") if m.get_type() not in ("TIMESYNC", "HEARTBEAT")]
    assert {m.get_type() for m in frames} == {kind}
    assert len(frames) == len(commands)
    for command, frame in zip(commands, frames, strict=True):
        stamp_us = truth[command["j"]]["t_ns"] // 1000
        assert frame.time_usec == (stamp_us % (1 << 32) if wraps else stamp_us)
        assert command["sample_ns"] // 1000 == stamp_us
        assert command["x"] == pytest.approx(truth[command["j"]]["x"], rel=1e-6, abs=1e-9)


@pytest.mark.parametrize(("actuator", "tolerance"), [("pwm", math.radians(0.025)), ("float", 1e-7)])
def test_the_plant_flies_what_was_commanded_for_the_sample_it_says(actuator, tolerance):
    flight = Flight(AutopilotConfig(HIRM, STEP, actuator=actuator), PlantConfig(HIRM.model, X0)).fly(5 * S)
    u = {c["j"]: c["u"][0] for c in flight.bodies("autopilot/command")}
    flown = [body for body in flight.bodies("plant/truth") if body["j"] is not None]
    assert len(flown) > 180
    assert max(abs(body["u"][0] - u[body["j"]]) for body in flown) <= tolerance * 1.001


@pytest.mark.parametrize(("up_ms", "down_ms"), [(0, 0), (10, 10), (20, 60), (60, 20), (3, 71), (49, 49)])
def test_on_a_constant_link_the_forecast_is_the_d_the_plant_flies(up_ms, down_ms):
    flight = Flight(up=constant(up_ms * MS), down=constant(down_ms * MS)).fly(8 * S)
    forecast = {c["j"]: c["d"] for c in flight.bodies("autopilot/command")}
    truth = [body for body in flight.bodies("plant/truth") if body["j"] is not None]
    assert {body["d"] for body in truth} == {max(1, math.ceil((up_ms + down_ms) / 25))}
    assert all(forecast[body["j"]] == body["d"] for body in truth)


def test_the_command_is_equation_9_with_the_reference_of_the_instant_of_application():
    flight = Flight(
        AutopilotConfig(HIRM, STEP), PlantConfig(HIRM.model, X0), up=constant(20 * MS), down=constant(20 * MS)
    ).fly(6 * S)
    xr = by_scipy(STEP)
    commands = flight.bodies("autopilot/command")
    assert {c["d"] for c in commands} == {2}
    for c in commands:
        np.testing.assert_allclose(c["xr"], xr[c["j"] + 2], rtol=1e-9, atol=1e-12)
        u = float((HIRM.K1 @ c["x"] + HIRM.K2 @ xr[c["j"] + 2])[0])
        assert c["u"][0] == pytest.approx(np.clip(u, -math.radians(25), math.radians(25)), abs=1e-12)
        assert c["r"] == [STEP.r(c["j"])]


def test_the_aircraft_follows_its_reference():
    flight = Flight(AutopilotConfig(HIRM, STEP), up=constant(20 * MS), down=constant(20 * MS)).fly(15 * S)
    truth = flight.bodies("plant/truth")
    assert truth[-1]["x"][2] == pytest.approx(math.radians(5.0), rel=0.05)
    assert flight.transitions() == [("STANDBY", "TRACKING")]


def test_a_model_without_reference_is_regulated():
    flight = Flight(
        AutopilotConfig(load_gains("pendulum-paper")),
        PlantConfig(load_gains("pendulum-paper").model, np.array([0.05, 0.0])),
    ).fly(8 * S)
    commands, truth = flight.bodies("autopilot/command"), flight.bodies("plant/truth")
    assert (commands[0]["xr"], commands[0]["r"]) == (None, None)
    assert np.max(np.abs(truth[-1]["x"])) < 0.01


def test_lost_samples_do_not_shift_the_numbers_or_the_reference():
    rng = np.random.default_rng(4)
    losing = Flight(
        AutopilotConfig(HIRM, STEP), up=lambda now: None if now > LEARNT and rng.random() < 0.05 else 10 * MS
    ).fly(8 * S)
    xr = by_scipy(STEP)
    stamps = {body["t_ns"] // 1000: body["k"] for body in losing.bodies("plant/truth")}
    commands = losing.bodies("autopilot/command")
    assert len(losing.bodies("plant/truth")) - len(commands) > 0
    assert all(stamps[c["sample_ns"] // 1000] == c["j"] for c in commands)
    assert losing.transitions() == [("STANDBY", "TRACKING")]
    for c in commands:
        np.testing.assert_allclose(c["xr"], xr[c["j"] + c["d"]], rtol=1e-9, atol=1e-12)


# failsafe


def test_no_fresh_state_leaves_tracking_when_d_max_samples_have_passed():
    b = Bench().tracking(9)
    last_ns = b.now_ns
    b.to(last_ns + D_MAX * TS - 1)
    assert b.mode == "TRACKING"
    b.to(last_ns + D_MAX * TS + TS // 2)
    assert b.mode == "HOLD"
    assert b.transitions()[-1] == "TRACKING to HOLD: no state for 4 samples"


def test_a_sample_at_the_last_instant_keeps_tracking():
    b = Bench().tracking(9)
    b.now_ns = b.t0_ns + (9 + D_MAX) * TS
    b.give(
        Attitude(b.now_ns // MS, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        AoaSsa(b.now_ns // 1000, 0.0, 0.0),
    )
    b.to(b.now_ns)
    assert b.mode == "TRACKING"


def held(bench: Bench) -> int:
    """Fall silent until HOLD; return when it began."""
    bench.to(bench.now_ns + (D_MAX + 1) * TS)
    assert bench.mode == "HOLD"
    return bench.node.failsafe.since_ns


def test_hold_gives_way_to_neutral_just_when_its_time_is_over():
    b = Bench().tracking(9)
    over_ns = held(b) + b.config.hold_ns
    b.to(over_ns - 1)
    assert b.mode == "HOLD"
    b.to(over_ns)
    assert b.mode == "NEUTRAL"


def test_hold_keeps_the_last_command_and_neutral_sends_trim_every_sample():
    b = Bench().tracking(9)
    pulses = [m.servo2_raw for p, m in b.messages if (p, m.get_type()) == ("plant", "SERVO_OUTPUT_RAW")]
    assert pulses[-1] != 1500
    seen = len(b.messages)
    b.to(held(b) + b.config.hold_ns + 20 * TS)
    pulses = [m.servo2_raw for p, m in b.messages[seen:] if (p, m.get_type()) == ("plant", "SERVO_OUTPUT_RAW")]
    assert pulses == [1500] * 21
    b.sample(80, age_ns=200 * MS)  # a sample whose delay lies outside
    assert (b.mode, b.commands[-1]["u"]) == ("NEUTRAL", [0.0])


def test_in_hold_samples_are_answered_with_the_held_command():
    b = Bench().tracking(9)
    [last] = b.commands[-1]["u"]
    for k in range(10, 15):
        b.sample(k, age_ns=150 * MS, x=2 * X0)
    assert {(str(c["mode"]), c["u"][0]) for c in b.commands[-5:]} == {("HOLD", last)}


def test_three_good_samples_come_back_and_two_do_not():
    b = Bench().tracking(9)
    b.to(b.now_ns + 2 * S)
    seen = []
    for k in range(100, 104):
        b.sample(k)
        seen.append(b.mode)
    assert seen == ["NEUTRAL", "NEUTRAL", "TRACKING", "TRACKING"]


@pytest.mark.parametrize("gap", [D_MAX + 1, 40])
def test_good_samples_with_silence_between_them_are_no_row(gap):
    b = Bench().tracking(9)
    b.to(b.now_ns + 2 * S)
    for n in range(6):
        b.sample(100 + n * gap)
        assert b.mode == "NEUTRAL"


@pytest.mark.parametrize(("age_ms", "d"), [(99, 4), (100, 4), (101, 5), (125, 5), (126, 6)])
def test_a_delay_outside_the_window_leaves_tracking_at_that_very_sample(age_ms, d):
    b = Bench()
    for k in range(10):
        b.sample(k, age_ns=60 * MS)
    assert (b.mode, b.commands[-1]["d"]) == ("TRACKING", 3)
    b.sample(10, age_ns=age_ms * MS)
    assert (b.mode, b.commands[-1]["d"]) == ("TRACKING" if d <= D_MAX else "HOLD", d)


@pytest.mark.parametrize(
    ("d_min", "reported", "mode"), [(1, 4, "TRACKING"), (1, 5, "HOLD"), (2, 1, "HOLD"), (2, 2, "TRACKING")]
)
def test_a_reported_delay_outside_the_window_on_either_side_leaves_tracking(d_min, reported, mode):
    b = Bench(AutopilotConfig(replace(HIRM, d_min=d_min)))
    for k in range(10):
        b.sample(k, age_ns=40 * MS)  # forecast 2
    assert b.mode == "TRACKING"
    b.give(NamedValueInt((b.t0_ns + 10 * TS) // MS, "DELAY_K", reported))
    assert b.mode == mode


def test_a_blackout_is_hold_then_neutral_then_tracking_by_itself():
    flight = Flight(
        AutopilotConfig(HIRM, STEP),
        up=cut(10 * MS, (4, 6)),
        down=cut(10 * MS, (4, 6)),
        plant=PlantConfig(HIRM.model, X0),
    ).fly(12 * S)
    assert flight.transitions(LEARNT) == [("TRACKING", "HOLD"), ("HOLD", "NEUTRAL"), ("NEUTRAL", "TRACKING")]
    hold, neutral, back = flight.when("failsafe")[-3:]
    assert 4 * S - TS < hold - D_MAX * TS < 4 * S + 10 * MS + TS // 2
    assert neutral - hold == pytest.approx(S // 2, rel=1e-3)
    assert 6 * S + 2 * TS <= back <= 6 * S + 12 * TS
    assert abs(flight.bodies("plant/truth")[-1]["x"][2] - math.radians(5)) < 0.01


@pytest.mark.parametrize("way", ["up", "down"])
def test_one_dead_direction_is_enough(way):
    flight = Flight(**{way: cut(10 * MS, (4, 7))}).fly(12 * S)
    assert flight.transitions(LEARNT)[0] == ("TRACKING", "HOLD")
    assert flight.transitions(LEARNT)[-1][1] == "TRACKING"
    hold = flight.when("failsafe", "TRACKING to HOLD")[0]
    assert hold <= 4 * S + (D_MAX + 2) * TS
    assert "TRACKING" not in modes(flight, hold + 1) - modes(flight, 7 * S)
    assert flight.transitions(7 * S)[-1][1] == "TRACKING"


def test_a_link_that_becomes_too_slow_is_hold_and_neutral_until_it_is_fast_again():
    flight = Flight(down=changing((0, 10 * MS), (4, 130 * MS), (10, 10 * MS))).fly(20 * S)
    transitions = flight.transitions(LEARNT)
    assert transitions == [("TRACKING", "HOLD"), ("HOLD", "NEUTRAL"), ("NEUTRAL", "TRACKING")]
    hold, neutral, back = flight.when("failsafe")[-3:]
    assert 4 * S < hold <= 4 * S + (D_MAX + 3) * TS
    assert hold < neutral < 5 * S
    assert 10 * S < back < 15 * S


@pytest.mark.parametrize("own_ppm", [-200, 0, 200])
def test_a_steady_stream_is_never_stale_even_at_d_max_1(own_ppm):
    gains = replace(HIRM, d_max=1)
    flight = Flight(
        AutopilotConfig(gains),
        up=constant(5 * MS),
        down=constant(5 * MS),
        autopilot_clock=Clock(1042 * S, own_ppm * 1000),
    ).fly(6 * S)
    assert flight.transitions() == [("STANDBY", "TRACKING")]


@pytest.mark.parametrize("failsafe", ["on", "monitor"])
def test_every_transition_is_one_text_and_one_record(failsafe):
    config = AutopilotConfig(HIRM, STEP, failsafe=failsafe, ground_stations=2)
    link = changing((0, 10 * MS), (4, 130 * MS), (7, 10 * MS))
    flight = Flight(config, up=cut(10 * MS, (12, 13.5)), down=link).fly(16 * S)
    records = flight.events("failsafe")
    assert len(records) >= 7
    for port in ("gcs0", "gcs1"):
        texts = [m.text for _, m in flight.sent("autopilot", port) if m.get_type() == "STATUSTEXT" and " to " in m.text]
        assert texts == [r["text"] for r in records]
    assert {r["data"]["monitor"] for r in records} == {failsafe == "monitor"}


def test_monitor_reports_and_flies_on():
    config = AutopilotConfig(HIRM, STEP, failsafe="monitor")
    flight = Flight(
        config, down=changing((0, 10 * MS), (4, 130 * MS)), plant=PlantConfig(HIRM.model, servo_timeout=None)
    ).fly(8 * S)
    assert flight.transitions(LEARNT)[0] == ("TRACKING", "HOLD")
    commands = [c for c in flight.bodies("autopilot/command") if c["mode"] != "TRACKING"]
    assert len(commands) > 50
    for c in commands:
        u = float((HIRM.K1 @ c["x"] + HIRM.K2 @ c["xr"])[0])
        assert c["u"][0] == pytest.approx(np.clip(u, -math.radians(25), math.radians(25)), abs=1e-12)


@pytest.mark.parametrize("blackout", [(4, 5.5), (1.3, 1.5), (1.3, 2.2)])
def test_the_elevator_hardly_jumps_when_the_law_comes_back_in_mid_manoeuvre(blackout):
    config = AutopilotConfig(HIRM, STEP, actuator="float")
    flight = Flight(config, PlantConfig(HIRM.model, X0), up=cut(10 * MS, blackout)).fly(8 * S)
    back = flight.when("failsafe")[-1]
    first = flight.bodies("autopilot/command", back)[0]
    [before] = [c["u"][0] for c in flight.bodies("autopilot/command") if c["j"] == first["j"] - 1]
    assert first["mode"] == "TRACKING"
    assert abs(first["u"][0] - before) < math.radians(1.0)
    left_alone = float((HIRM.K1 @ first["x"] + HIRM.K2 @ by_scipy(STEP)[first["j"] + first["d"]])[0])
    assert abs(first["u"][0] - before) < 0.5 * abs(left_alone - before)


# restarts and clocks


def test_a_restarted_plant_is_a_new_epoch_and_is_flown_again():
    flight = Flight(AutopilotConfig(HIRM, STEP), PlantConfig(HIRM.model, X0)).fly(6 * S)
    flight.restart_plant(Clock(PLANT_CLOCK.offset_ns, 40_000, flight.network.now_ns))
    flight.fly(14 * S)
    assert [e["text"] for e in flight.events("epoch")] == ["plant restarted, epoch 1"]
    assert len(flight.events("clock")) == 1
    assert ("NEUTRAL", "STANDBY") in flight.transitions(6 * S) or ("HOLD", "STANDBY") in flight.transitions(6 * S)
    assert flight.transitions()[-1] == ("STANDBY", "TRACKING")
    assert flight.when("failsafe")[-1] < 9 * S
    new = [c for c in flight.bodies("autopilot/command") if c["epoch"] == 1]
    stamps = {body["t_ns"] // 1000: body["k"] for body in flight.bodies("plant/truth", 6 * S)}
    assert new[0]["j"] < 80
    assert all(stamps[c["sample_ns"] // 1000] == c["j"] for c in new)
    truth = flight.bodies("plant/truth")[-1]
    assert truth["x"][2] == pytest.approx(math.radians(5), rel=0.1)


def test_three_restarts_are_three_epochs():
    flight = Flight(plant=PlantConfig(HIRM.model, X0))
    for n in range(3):
        flight.fly((5 + 5 * n) * S)
        flight.restart_plant(Clock(PLANT_CLOCK.offset_ns, 40_000, flight.network.now_ns))
    flight.fly(22 * S)
    assert len(flight.events("epoch")) == 3
    assert flight.bodies("autopilot/command")[-1]["epoch"] == 3
    assert flight.transitions()[-1] == ("STANDBY", "TRACKING")


class NoNumbers(PlantNode):
    """A plant that sends neither SAMPLE_K nor DELAY_K."""

    def _send(self, message: Message) -> None:
        if not isinstance(message, NamedValueInt):
            super()._send(message)


@pytest.mark.parametrize("step_ns", [30 * MS, -30 * MS, 5 * S])
def test_a_plant_that_sends_no_numbers_is_flown_again_after_a_step_of_its_clock(step_ns):
    flight = Flight()
    flight.plant = NoNumbers(flight.plant_config)
    flight.network.replace("plant", flight.plant, PLANT_CLOCK)
    flight.fly(20 * S)
    # the node keeps its grid, so that a step of the clock is one of the stamps
    flight.network.replace("plant", flight.plant, replace(PLANT_CLOCK, offset_ns=PLANT_CLOCK.offset_ns + step_ns))
    flight.fly(27 * S)
    assert len(flight.events("clock")) == 1
    assert flight.events("epoch") == []
    assert flight.autopilot.failsafe.mode is Mode.TRACKING
    j = [c["j"] for c in flight.bodies("autopilot/command")]
    assert j == sorted(set(j))


@pytest.mark.parametrize("wrong", [10**6, 0])
def test_one_wrong_number_of_the_plant_is_not_flown(wrong):
    b = Bench().tracking(60)
    b.give(NamedValueInt(b.now_ns // MS, "SAMPLE_K", wrong))
    for k in range(61, 200):
        b.sample(k)
    assert b.commands[-1]["j"] == 199
    assert (len(b.transitions()), b.node.epoch) == (1, 0)


def forged(b: Bench, ahead_ns: int) -> None:
    """Let both halves of a sample come that is stamped ahead of time."""
    t_ns = b.now_ns + ahead_ns
    b.give(AoaSsa(t_ns // 1000, 1.0, 0.0), Attitude((t_ns // MS) % (1 << 32), 0.0, 0.05, 0.0, 0.0, 0.0, 0.0))


def test_numbers_that_were_wrong_twice_are_a_new_epoch_when_they_are_right_again():
    b = Bench().tracking(60)
    for k in (61, 62):
        b.give(NamedValueInt((b.t0_ns + k * TS) // MS, "SAMPLE_K", k + 10**6))
    forged(b, 2 * TS)
    assert b.commands[-1]["j"] > 10**6
    for k in range(63, 100):
        b.sample(k)
    assert [e["text"] for e in b.events if e["kind"] == "epoch"] == ["sample numbers fell back, epoch 1"]
    assert (b.mode, b.commands[-1]["j"]) == ("TRACKING", 99)


def test_a_sample_from_far_ahead_while_the_clock_is_lost_costs_a_second():
    b = Bench().tracking(60)
    b.answers = False
    for k in range(61, 741):
        b.sample(k)
    forged(b, 10 * DAY)
    b.answers = True
    came = len(b.commands)
    for k in range(741, 900):
        b.sample(k)
    assert [e["text"] for e in b.events if e["kind"] == "epoch"] == ["stamps fell back, epoch 1"]
    assert [c["j"] for c in b.commands[came:]] == list(range(741 + S // TS, 900))
    assert b.mode == "TRACKING"


@pytest.mark.parametrize("ahead_ns", [10 * DAY, 100 * DAY, 584_000 * 365 * DAY - 600 * S])
def test_a_sample_from_far_ahead_before_the_clock_is_known_costs_a_second_at_most(ahead_ns):
    b = Bench(answers=False)
    b.to(b.now_ns + 10 * MS)
    forged(b, min(ahead_ns, ((1 << 64) - 1) * 1000 - b.now_ns))
    b.answers = True
    for k in range(100):
        b.sample(k)
    assert b.mode == "TRACKING"
    assert b.commands[-1]["j"] == 99
    assert all(c["sample_ns"] < 1 << 62 for c in b.commands)


def test_reordering_is_no_restart():
    rng = np.random.default_rng(5)
    flight = Flight(up=lambda _now: int(rng.integers(1, 60)) * MS, down=lambda _now: int(rng.integers(1, 30)) * MS).fly(
        20 * S
    )
    assert flight.events("epoch") == []
    assert flight.events("clock") == []
    j = [c["j"] for c in flight.bodies("autopilot/command")]
    assert j == sorted(set(j))


@pytest.mark.parametrize("up_for_ns", [0, 71 * 60 * S + 34 * S, 50 * DAY, 400 * DAY])
def test_a_plant_is_flown_however_long_it_has_been_up(up_for_ns):
    flight = Flight(plant_clock=Clock(up_for_ns, 40_000)).fly(5 * S)
    assert flight.transitions() == [("STANDBY", "TRACKING")]
    assert {body["d"] for body in flight.bodies("plant/truth")[-100:]} == {1}


@pytest.mark.parametrize("wrap_ns", [(1 << 32) * 1000, (1 << 32) * MS])
def test_counters_that_wrap_in_flight_are_not_noticed(wrap_ns):
    flight = Flight(plant_clock=Clock(wrap_ns - 4 * S, 40_000), autopilot_clock=Clock(wrap_ns - 3 * S, 0)).fly(8 * S)
    assert flight.transitions() == [("STANDBY", "TRACKING")]
    assert {body["d"] for body in flight.bodies("plant/truth")[-200:]} == {1}


# ground stations


def seen_by_station(flight: Flight) -> dict[str, list]:
    """Return what a station got, by type: our time and message."""
    seen: dict[str, list] = {}
    for t_ns, m in flight.sent("autopilot", "gcs0"):
        assert (m.get_srcSystem(), m.get_srcComponent()) == AUTOPILOT
        seen.setdefault(m.get_type(), []).append((AUTOPILOT_CLOCK.node_ns(t_ns), m))
    return seen


def test_a_station_sees_what_the_plant_says_as_the_autopilot_on_its_clock():
    flight = Flight(AutopilotConfig(HIRM, STEP), PlantConfig(HIRM.model, X0)).fly(4 * S)
    seen = seen_by_station(flight)
    commands = [(r.t_ns, r.body) for r in flight.records("autopilot/command")]
    pulses = [m.servo2_raw for _, m in flight.sent("autopilot", "plant") if m.get_type() == "SERVO_OUTPUT_RAW"]
    by_ms = {at_ns // MS: (body, pulse) for (at_ns, body), pulse in zip(commands, pulses, strict=True)}
    for kind, hz in (("ATTITUDE", 20), ("AOA_SSA", 10), ("SERVO_OUTPUT_RAW", 10)):
        slots = [now_ns * hz // S for now_ns, _ in seen[kind] if now_ns > commands[0][0] + S]
        assert slots == list(range(slots[0], slots[0] + len(slots))), kind
        assert len(slots) >= (commands[-1][0] - commands[0][0] - S) * hz // S
        for now_ns, m in seen[kind]:
            stamp_ms = m.time_boot_ms if kind == "ATTITUDE" else (m.time_usec // 1000)
            newest_ms = max(ms for ms in by_ms if ms <= now_ns // MS)
            assert stamp_ms == newest_ms
            body, pulse = by_ms[newest_ms]
            match kind:
                case "ATTITUDE":
                    assert m.pitch == pytest.approx(body["x"][2], rel=1e-6, abs=1e-9)
                    assert m.pitchspeed == pytest.approx(body["x"][1], rel=1e-6, abs=1e-9)
                case "AOA_SSA":
                    assert math.radians(m.AOA) == pytest.approx(body["x"][0], rel=1e-6, abs=1e-9)
                case _:
                    assert m.servo2_raw == pulse
    assert {m.name for _, m in seen["NAMED_VALUE_INT"]} == {"DELAY_K", "D_EST", "D_LOW", "D_HIGH", "D_MAX"}
    assert "VFR_HUD" in seen
    assert "TIMESYNC" not in seen


def test_a_station_is_not_shown_an_old_attitude_as_a_new_one():
    flight = Flight(up=cut(10 * MS, (4, 7))).fly(7 * S)
    seen = seen_by_station(flight)
    last_ns = max(r.t_ns for r in flight.records("autopilot/command"))
    assert last_ns < AUTOPILOT_CLOCK.node_ns(4 * S + TS)
    for kind, stamp, unit_ns in (("ATTITUDE", "time_boot_ms", MS), ("AOA_SSA", "time_usec", 1000)):
        stamps = [getattr(m, stamp) * unit_ns for _, m in seen[kind]]
        assert stamps == sorted(set(stamps))
        assert stamps[-1] == last_ns // unit_ns * unit_ns
        assert max(now_ns for now_ns, _ in seen[kind]) < last_ns + 150 * MS  # its interval, and the next tick


def test_the_reference_that_is_flown_is_shown_and_no_attitude_while_no_law_flies():
    flight = Flight(AutopilotConfig(HIRM, STEP), up=cut(10 * MS, (4, 7))).fly(9 * S)
    ignored = dialect.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE
    shown = [(t_ns, m) for t_ns, m in flight.sent("autopilot", "gcs0") if m.get_type() == "ATTITUDE_TARGET"]
    flying = [m for t_ns, m in shown if LEARNT <= t_ns < 4 * S or t_ns >= 8 * S]
    assert len(flying) == 10
    for m in flying:
        assert not m.type_mask & ignored
        assert 2 * math.asin(m.q[2]) == pytest.approx(HIRM.model.trim.x[2] + math.radians(5.0), abs=1e-6)
    silent = [m for t_ns, m in shown if 4 * S + (D_MAX + 2) * TS < t_ns < 7 * S]
    assert len(silent) == 14
    assert all(m.type_mask & ignored for m in silent)


# armed and disarmed


def beats(b: Bench) -> list[tuple[int, bool]]:
    """Return custom mode and armed bit of each heartbeat that the station got."""
    own = [m for port, m in b.messages if (port, m.get_type()) == ("gcs0", "HEARTBEAT")]
    return [(m.custom_mode, bool(m.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED)) for m in own]


STATION = Wire((255, 190), None)


def ask(b: Bench, command: int, *params: float) -> list[int]:
    """Send a command as a station does, and return the results that were acknowledged."""
    seen = len(b.messages)
    asked = CommandLong(1, 1, command, 0, *params, *[0.0] * (7 - len(params)))
    b.node.receive("gcs0", STATION.encode(asked), b.now_ns)
    b.to(b.now_ns)
    return [m.result for port, m in b.messages[seen:] if (port, m.get_type()) == ("gcs0", "COMMAND_ACK")]


ARM_DISARM, FORCE = dialect.MAV_CMD_COMPONENT_ARM_DISARM, 21196.0


def test_by_default_the_vehicle_arms_itself_once_with_the_first_good_sample():
    b = Bench()
    b.to(b.now_ns + S)
    assert beats(b)[-1] == (10, False)
    b.sample(0)
    b.sample(1)
    assert [(c["mode"], c["armed"], c["flight_mode"]) for c in b.commands] == [("TRACKING", True, "AUTO")] * 2
    assert b.texts().count("armed without a verified certificate") == 1
    assert ask(b, ARM_DISARM, 0.0) == [dialect.MAV_RESULT_ACCEPTED]
    for k in range(2, 50):
        b.sample(k)
    assert {(c["mode"], c["armed"], c["u"][0]) for c in b.commands[2:]} == {("STANDBY", False, 0.0)}
    assert beats(b)[-1] == (10, False)
    assert b.transitions()[-1] == "TRACKING to STANDBY: disarmed"


def test_a_vehicle_that_was_disarmed_before_its_first_sample_does_not_arm_itself():
    b = Bench()
    b.to(b.now_ns + 500 * MS)
    assert ask(b, ARM_DISARM, 0.0) == [dialect.MAV_RESULT_ACCEPTED]
    for k in range(20):
        b.sample(k)
    assert {(c["mode"], c["armed"], c["u"][0]) for c in b.commands} == {("STANDBY", False, 0.0)}


def test_told_to_wait_it_stays_neutral_until_a_station_arms_it():
    b = Bench(AutopilotConfig(HIRM, wait_arm=True))
    for k in range(50):
        b.sample(k)
    assert {(c["mode"], c["armed"], c["u"][0]) for c in b.commands} == {("STANDBY", False, 0.0)}
    assert ask(b, ARM_DISARM, 1.0) == [dialect.MAV_RESULT_FAILED]
    assert b.texts()[-1] == "PreArm: no verified certificate"
    b.sample(50)
    assert b.mode == "STANDBY"
    assert ask(b, ARM_DISARM, 1.0, FORCE) == [dialect.MAV_RESULT_ACCEPTED]
    for k in range(51, 100):
        b.sample(k)
    assert {(c["mode"], c["armed"]) for c in b.commands[51:]} == {("TRACKING", True)}
    assert beats(b)[-1] == (10, True)


def test_a_vehicle_that_is_asked_to_arm_before_its_plant_speaks_says_what_is_missing():
    b = Bench(AutopilotConfig(load_gains("hirm-d4"), wait_arm=True))
    b.to(b.now_ns + S)
    assert ask(b, ARM_DISARM, 1.0) == [dialect.MAV_RESULT_FAILED]
    assert b.texts()[-1] == "PreArm: no fresh state"
    for k in range(40, 50):
        b.sample(k)
    assert ask(b, ARM_DISARM, 1.0) == [dialect.MAV_RESULT_ACCEPTED]
    b.sample(50)
    assert b.mode == "TRACKING"


def test_a_stations_frames_do_not_reach_the_elevator():
    b = Bench().tracking(9)
    count, mode = len(b.commands), b.node.failsafe
    station = Wire((1, 25), None)
    t_ns = b.now_ns + TS
    for message in (
        Attitude(t_ns // MS, 0, 1.0, 0, 0, 1.0, 0),
        AoaSsa(t_ns // 1000, 9.0, 0.0),
        NamedValueInt(0, "DELAY_K", 99),
    ):
        b.node.receive("gcs0", station.encode(message), b.now_ns)
    b.take()
    assert (len(b.commands), b.node.failsafe) == (count, mode)


# hostile datagrams


def test_records_keep_their_schema():
    flight = Flight(AutopilotConfig(HIRM, STEP), up=cut(10 * MS, (4, 5.5))).fly(8 * S)
    for topic in ("events", "autopilot/command", "plant/truth"):
        for body in flight.bodies(topic):
            assert set(body) == set(SCHEMAS[topic]["required"])


def test_20000_broken_datagrams_change_no_state():
    rng = np.random.default_rng(6)
    b, spared = Bench(), Bench()
    strangers = [Wire(source, None) for source in ((1, 1), (2, 25), (255, 190), (1, 26))]
    noise = Wire(PLANT, None)
    for k in range(100):
        for bench in (b, spared):
            bench.sample(k)
        t_ns = b.now_ns + TS
        messages = [
            Attitude(t_ns // MS, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6),
            AoaSsa(t_ns // 1000, 5.0, 0.1),
            NamedValueInt(t_ns // MS, "DELAY_K", 99),
            NamedValueInt(t_ns // MS, "SAMPLE_K", 7),
            Timesync(b.now_ns + 999 * S, b.now_ns),
            VfrHud(1.0, 1.0, 0, 0, 0.0, 0.0),
            plant_heartbeat(),
        ]
        before = (b.node.failsafe, b.node.clock.estimate(b.now_ns), b.node.samples.newest_ns, b.node.next_deadline_ns())
        for n in range(200):
            message = messages[n % len(messages)]
            datagram = strangers[n % 4].encode(message) if n % 5 == 0 else broken(noise.encode(message), rng)
            b.node.receive("plant", datagram, b.now_ns)
        after = (b.node.failsafe, b.node.clock.estimate(b.now_ns), b.node.samples.newest_ns, b.node.next_deadline_ns())
        assert before == after
        assert b.node.outgoing() == []
        assert b.node.records() == []
    assert b.mode == "TRACKING"
    assert b.commands == spared.commands
    assert sum(b.node.wire.rejects.values()) >= 19_000
    assert b.node.clock.unmatched == spared.node.clock.unmatched == 0


def test_valid_frames_with_wild_contents_raise_nothing_and_good_ones_are_still_flown():
    rng = np.random.default_rng(7)
    b = Bench().tracking(9)

    def wild() -> float:
        return float(np.float32(rng.normal() * 10.0 ** rng.integers(-30, 30)))

    for k in range(10, 60):
        for _ in range(20):
            ms = int(rng.integers(0, 1 << 32))
            b.give(
                Attitude(ms, *(wild() for _ in range(6))),
                AoaSsa(int(rng.integers(0, 1 << 63)), wild(), wild()),
                VfrHud(wild(), wild(), 0, 0, wild(), wild()),
                NamedValueInt(ms, "DELAY_K", int(rng.integers(-(1 << 31), 1 << 31))),
                Timesync(int(rng.integers(1, 1 << 62)), int(rng.integers(0, 1 << 62))),
            )
        b.sample(k)
    for k in range(60, 70):
        b.sample(k)
    assert [c["j"] for c in b.commands][-10:] == list(range(60, 70))
    assert b.node.failsafe.mode is Mode.TRACKING
    assert all(math.isfinite(c["u"][0]) for c in b.commands)


@pytest.mark.parametrize("profile", [Profile(), Profile(((0, 1e308), (5, -1e308)))])
def test_no_finite_reference_makes_an_infinite_command(profile):
    b = Bench(AutopilotConfig(HIRM, profile)).tracking(9)
    assert all(abs(c["u"][0]) <= math.radians(25) + 1e-12 for c in b.commands)
