"""The monitors: what they must find, and what they must leave alone; each attacked with what a link may bring."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autopilot.config import AutopilotConfig
from autopilot.failsafe import Event
from autopilot.link.sensors import sensors_of
from autopilot.link.wire import AUTOPILOT, PLANT, AoaSsa, Attitude, Wire
from autopilot.monitors import (
    COMMAND_MEMORY,
    FROZEN_CHANGE,
    FROZEN_SAMPLES,
    JUMP_RAD,
    JUMP_SAMPLES,
    UNSTICK_SAMPLES,
    Halves,
    Plausibility,
    Saturation,
    Silence,
)
from autopilot.profile import parse_profile
from gains.store import load_gains
from sitl.flight import fly_virtual
from sitl.scenario import load_scenario
from tests.helpers import HIRM, MS, Flight, S

quick = settings(deadline=None)
MODEL = HIRM.model
"""States alpha, q, theta; trim at zero; 25 ms."""
TRIM = (0.0, 0.0, 0.0)
FOUND_WITHIN = FROZEN_SAMPLES + 1
"""The first of a row is no repetition."""


def monitor(model=MODEL) -> Plausibility:
    return Plausibility(model)


def verdicts(p: Plausibility, xs, us=None, start: int = 0) -> list[str | None]:
    """Judge samples in turn, each followed by its command (neutral by default), and return the events."""
    said = []
    for n, x in enumerate(xs):
        verdict = p.judge(start + n, x)
        said.append(None if verdict is None else str(verdict.event))
        p.commanded(0.0 if us is None else us[n])
    return said


# Implausible: range

FIELDS = [
    "ATTITUDE.roll",
    "ATTITUDE.pitch",
    "ATTITUDE.yaw",
    "ATTITUDE.rollspeed",
    "ATTITUDE.pitchspeed",
    "ATTITUDE.yawspeed",
    "AOA_SSA.AOA",
    "AOA_SSA.SSA",
]
RANGES = dict(zip(FIELDS, [math.pi, math.pi / 2, math.pi, 10.0, 10.0, 10.0, math.pi / 2, math.pi / 2], strict=True))
TURNS = ("ATTITUDE.roll", "ATTITUDE.yaw")


def model_of(field: str):
    """Return the model with its last state, theta, carried by a field."""
    others = [f for f in FIELDS if f != field][:2]
    return replace(MODEL, sensors=dict(zip(MODEL.states, [*others, field], strict=True)))


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_each_field_may_reach_its_limit_as_a_float_of_32_bits_and_not_pass_it(field, sign):
    model = model_of(field)
    edge = sign * float(np.float32(math.degrees(RANGES[field]))) / math.degrees(1.0)
    assert monitor(model).judge(0, (0.0, 0.0, edge)) is None
    assert monitor(model).judge(0, (0.0, 0.0, sign * float(np.float32(RANGES[field])))) is None
    beyond = monitor(model).judge(0, (0.0, 0.0, edge * 1.001))
    assert beyond is not None
    assert beyond.event is Event.IMPLAUSIBLE
    assert beyond.reason == f"theta_rad {edge * 1.001:.3g} beyond {RANGES[field]:.3g}"


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan, 1e300, -1e300, 3.4e38])
@pytest.mark.parametrize("state", range(3))
def test_infinite_and_huge_values_are_implausible_and_leave_no_trace(state, value):
    p = monitor()
    good = [0.01, 0.0, 0.02]
    bad = [*good[:state], value, *good[state + 1 :]]
    assert verdicts(p, [good, bad, good, bad, good]) == [None, "implausible", None, "implausible", None]


@quick
@given(st.lists(st.tuples(*[st.floats(width=32)] * 3), max_size=40))
def test_no_numbers_at_all_break_the_monitor(xs):
    p = monitor()
    for said, x in zip(verdicts(p, xs), xs, strict=True):
        inside = all(abs(v) <= limit for v, limit in zip(x, (math.pi / 2, 10.0, math.pi / 2), strict=True))
        assert inside or said == "implausible"


# Implausible: jumps


def jump_limit(samples: int) -> float:
    return 10.0 * samples * 0.025 + JUMP_RAD


@pytest.mark.parametrize("gap", [1, 2, 3])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("state", [0, 2])
def test_an_angle_may_turn_as_fast_as_an_aircraft_can_and_not_faster(state, sign, gap):
    for share, wanted in ((0.999, None), (1.001, Event.IMPLAUSIBLE)):
        p = monitor()
        x = [0.0, 0.0, 0.0]
        assert p.judge(7, tuple(x)) is None
        x[state] = sign * share * jump_limit(gap)
        verdict = p.judge(7 + gap, tuple(x))
        assert (verdict.event if verdict else None) is wanted
        if verdict:
            assert verdict.reason == f"{MODEL.states[state]} jumped {x[state]:.3g}, limit {jump_limit(gap):.3g}"


def test_a_rate_may_jump():
    assert verdicts(monitor(), [(0.0, -9.0, 0.0), (0.0, 9.0, 0.1)]) == [None, None]


def test_the_first_sample_may_be_anywhere_and_so_may_the_first_after_a_long_gap():
    p = monitor()
    assert p.judge(1_000_000, (-1.5, 0.0, 1.5)) is None
    assert p.judge(1_000_000 + JUMP_SAMPLES + 1, (1.5, 0.0, -1.5)) is None


def test_a_single_wrong_sample_costs_itself_only():
    spike = (0.0, 0.0, 1.0)
    assert verdicts(monitor(), [TRIM, spike, TRIM, TRIM]) == [None, "implausible", None, None]


def test_a_lasting_jump_is_believed_as_soon_as_an_aircraft_could_have_turned_so_far():
    said = verdicts(monitor(), [TRIM] + [(0.0, 0.0, 1.0)] * 6)
    assert said == [None, "implausible", "implausible", "implausible", None, None, None]
    assert jump_limit(3) < 1.0 < jump_limit(4)


@pytest.mark.parametrize("field", TURNS)
def test_an_angle_that_passes_the_half_turn_has_not_jumped(field):
    p = monitor(model_of(field))
    assert verdicts(p, [(0.0, 0.0, 3.1), (0.0, 0.0, -3.1), (0.0, 0.0, 3.1)]) == [None, None, None]


def test_after_a_restart_nothing_is_known_of_the_plant_before():
    p = monitor()
    verdicts(p, [(0.03, 0.0, 0.1)] * 30, [0.2] * 30)
    p.forget()
    assert p.judge(0, (0.0, 0.0, -1.4)) is None


# Frozen

OFFSETS = [
    pytest.param((0.1, 0.0, 0.0), id="alpha"),
    pytest.param((0.0, 0.1, 0.0), id="q"),
    pytest.param((0.1, -0.2, 0.3), id="all"),
]


def test_an_aircraft_at_trim_may_stand_still_for_ever():
    p = monitor()
    assert set(verdicts(p, [TRIM] * 1000)) == {None}


@pytest.mark.parametrize("zero", [0.0, -0.0])
def test_the_sign_of_a_zero_is_no_movement_and_no_alarm(zero):
    p = monitor()
    assert set(verdicts(p, [(0.0, zero, -zero), (0.0, -zero, zero)] * 50)) == {None}


def test_trim_is_the_models_and_not_zero():
    trim = replace(MODEL.trim, x=np.array([0.1, 0.0, 0.1]), u=np.array([-0.05]))
    p = monitor(replace(MODEL, trim=trim))
    assert set(verdicts(p, [(0.1, 0.0, 0.1)] * 100, [-0.05] * 100)) == {None}
    p = monitor(replace(MODEL, trim=trim))
    assert verdicts(p, [TRIM] * 100, [-0.05] * 100).index("frozen") == FOUND_WITHIN - 1


@pytest.mark.parametrize("x", OFFSETS)
def test_what_is_frozen_away_from_trim_is_found_after_so_many_samples_and_not_before(x):
    said = verdicts(monitor(), [x] * 50)
    assert said == [None] * (FOUND_WITHIN - 1) + ["frozen"] * (50 - FOUND_WITHIN + 1)


def test_the_reason_names_state_value_and_limit():
    p = monitor()
    verdicts(p, [(0.0, 0.1, 0.0)] * FOUND_WITHIN)
    verdict = p.judge(FOUND_WITHIN, (0.0, 0.1, 0.0))
    assert verdict is not None
    assert verdict.reason.startswith("alpha_rad frozen at 0, theta_rad off by 0.025")
    assert verdict.reason.endswith("> 0.0087")


def law(x, xr=TRIM) -> float:
    """Return Eq. (9) with the published gains."""
    return float((HIRM.K1 @ np.array(x) + HIRM.K2 @ np.array(xr))[0])


def test_frozen_in_level_flight_with_a_pitch_error_is_found_once_the_law_must_have_moved_it():
    x = (0.0, 0.0, 0.05)  # nothing but the elevator moves this one
    said = verdicts(monitor(), [x] * 60, [law(x)] * 60)
    assert said.index("frozen") <= FOUND_WITHIN + COMMAND_MEMORY


def test_at_rest_with_a_command_that_may_still_be_on_its_way_nothing_is_frozen():
    x = (0.0, 0.0, 0.05)
    p = monitor()
    verdicts(p, [x] * 100)
    assert set(verdicts(p, [x] * COMMAND_MEMORY, [0.3] * COMMAND_MEMORY, 100)) == {None}


def frozen_at_neutral() -> Plausibility:
    """Return a monitor that has found all states frozen; neutral, which needs no movement, goes out from now on."""
    p, x = monitor(), (0.0, 0.0, 0.05)
    assert verdicts(p, [x] * 60, [law(x)] * 60)[-1] == "frozen"
    p.commanded(0.0)
    return p


def test_what_is_frozen_stays_frozen_at_neutral_until_it_moves():
    p = frozen_at_neutral()
    assert set(verdicts(p, [(0.0, 0.0, 0.05)] * 100, start=60)) == {"frozen"}
    moved = (1e-9, 1e-9, 0.05 + 1e-9)
    assert verdicts(p, [moved, moved], start=160) == [None, None]


def test_what_is_frozen_is_believed_again_when_it_need_not_have_moved_for_200_samples_in_a_row():
    assert UNSTICK_SAMPLES == 200
    said = verdicts(frozen_at_neutral(), [(0.0, 0.0, 0.05)] * 5000, start=60)
    assert said == ["frozen"] * 199 + [None] * 4801


def test_and_found_again_as_soon_as_it_must_move():
    x = (0.0, 0.0, 0.05)
    p = frozen_at_neutral()
    verdicts(p, [x] * 300, start=60)
    assert verdicts(p, [x] * 60, [law(x)] * 60, 360).index("frozen") <= FOUND_WITHIN + COMMAND_MEMORY


def test_the_row_of_samples_that_fit_begins_anew_with_one_that_does_not():
    x = (0.0, 0.0, 0.05)
    p = frozen_at_neutral()
    assert set(verdicts(p, [x] * 150, start=60)) == {"frozen"}
    pushed = [law(x)] * (COMMAND_MEMORY + FROZEN_SAMPLES + 1)
    assert set(verdicts(p, [x] * len(pushed), pushed, 210)) == {"frozen"}
    said = verdicts(p, [x] * 300, start=210 + len(pushed))
    assert said == ["frozen"] * 200 + [None] * 100  # neutral counts from the sample after it was sent


@pytest.mark.parametrize("x", OFFSETS)
def test_what_must_move_even_at_neutral_is_never_believed_again(x):
    assert set(verdicts(monitor(), [x] * 5000)[FOUND_WITHIN:]) == {"frozen"}


WRONG = [
    pytest.param((0.25, 0.0, 0.0), id="alpha"),
    pytest.param((0.0, 9.0, 0.0), id="q"),
    pytest.param((0.0, 0.0, 0.25), id="theta"),
    pytest.param((0.25, 9.0, 0.25), id="all"),
]


@pytest.mark.parametrize("x", WRONG)
@pytest.mark.parametrize("gap", [1, 2, 19])
def test_a_single_wrong_sample_blames_nobody_who_stands_still(gap, x):
    for at in range(10, 25):
        for sign in (-1.0, 1.0):
            p = monitor()
            for j in range(at):
                assert p.judge(j, TRIM) is None
            assert p.judge(at, tuple(sign * value for value in x)) is None
            for j in range(at + gap, at + gap + 60):
                assert p.judge(j, TRIM) is None, (at, j)


def test_several_wrong_samples_may_blame_the_right_ones_but_not_for_ever():
    said = verdicts(monitor(), [TRIM] * 20 + [(0.0, 1.5, 0.0)] * 3 + [TRIM] * 400)
    assert said[22:230].count("frozen") >= UNSTICK_SAMPLES
    assert set(said[22 + FROZEN_SAMPLES + UNSTICK_SAMPLES :]) == {None}


@pytest.mark.parametrize(("wrong", "alarms"), [(1, 0), (2, 1)])
def test_wrong_samples_do_not_keep_an_aircraft_at_rest_in_neutral_for_ever(wrong, alarms):
    flight = Flight(
        AutopilotConfig(HIRM, parse_profile("5deg@15s", MODEL.Ts)),
        up=lambda now_ns: None if 3 * S < now_ns < 5 * S else 10 * MS,
    ).fly(4 * S)
    receive, reader, writer, spoilt = flight.autopilot.receive, Wire(AUTOPILOT, PLANT), Wire(PLANT, AUTOPILOT), []

    def spoil(port: str, datagram: bytes, now_ns: int) -> None:
        """Let the first ATTITUDE after the gap be wrong in q."""
        messages = reader.decode(datagram) if port == "plant" and len(spoilt) < wrong else []
        if messages and isinstance(messages[0], Attitude):
            datagram = writer.encode(messages[0]._replace(pitchspeed=1.5))
            spoilt.append(now_ns)
        receive(port, datagram, now_ns)

    flight.autopilot.receive = spoil
    flight.fly(25 * S)
    said = [e["text"] for e in flight.events("failsafe", 5 * S)]
    assert len(spoilt) == wrong
    assert sum("alpha_rad frozen at 0" in text for text in said) == alarms
    assert flight.transitions()[-1] == ("NEUTRAL", "TRACKING")
    assert flight.bodies("plant/truth")[-1]["x"][2] == pytest.approx(math.radians(5.0), rel=0.05)


def test_gaps_in_the_numbers_delay_no_alarm():
    p = monitor()
    said = [p.judge(j, (0.1, 0.0, 0.0)) for j in range(0, 300, 13)]
    assert [s is not None for s in said] == [False] * (FOUND_WITHIN - 1) + [True] * (len(said) - FOUND_WITHIN + 1)


def least_miss(row, us) -> np.ndarray:
    """Return by how much each state of a row misses the model's change at the least, for any input among ``us``."""
    (numbers, states), trim = zip(*row, strict=True), MODEL.trim
    held = [x for j, after, x in zip(numbers, numbers[1:], states, strict=False) for _ in range(after - j)]
    free = sum((MODEL.A - np.eye(3)) @ (np.array(x) - trim.x) for x in held)
    forced = [len(held) * MODEL.B[:, 0] * (u - trim.u[0]) for u in (min(us), max(us))]
    off = np.array([free + each - (np.array(states[-1]) - np.array(states[0])) for each in forced])
    miss = np.where(off[0] * off[1] <= 0.0, 0.0, abs(off).min(axis=0))
    return miss * FROZEN_SAMPLES / len(held)


@pytest.mark.parametrize("seed", range(3))
def test_frozen_is_what_its_definition_says_whatever_stands_still_is_lost_or_commanded(seed):
    rng, p, us = np.random.default_rng(seed), monitor(), [0.0] * (COMMAND_MEMORY + FROZEN_SAMPLES)
    gust = abs(MODEL.E).sum(axis=1)
    calm = gust < 0.01 * gust.max()
    moved = [[i for i in range(3) if i == n or (calm[i] and MODEL.A[i, n])] for n in range(3)]
    x, j, u, row, stuck, found = (0.02, 0.0, 0.01), 0, 0.0, [], set(), 0
    for k in range(UNSTICK_SAMPLES):  # no longer: by then what stands still may be believed again
        if k % 20 == 0:
            stands, u = rng.random(3) < 0.6, rng.choice([0.0, -0.05, 0.1])
        x = tuple(float(v if s else v + rng.choice([0.0, 0.0, 0.002])) for v, s in zip(x, stands, strict=True))
        j += int(rng.integers(1, 4))
        row = [*row[-FROZEN_SAMPLES:], (j, x)]
        stuck = {n for n in stuck if row[-2][1][n] == x[n]}
        still = [n for n in range(3) if len(row) > FROZEN_SAMPLES and len({each[n] for _, each in row}) == 1]
        if still and any(least_miss(row, us)[i] > FROZEN_CHANGE for n in still for i in moved[n]):
            least = np.min([least_miss(row[:m] + row[m + 1 :], us) for m in range(len(row))], axis=0)
            stuck |= {n for n in still if any(least[i] > FROZEN_CHANGE for i in moved[n])}
        verdict = p.judge(j, x)
        assert (verdict is not None) == bool(stuck), k
        found += verdict is not None
        for _ in range(rng.integers(3)):  # no command, one, or one sent again
            p.commanded(u)
            us = [*us[1:], u]
    assert 0 < found < UNSTICK_SAMPLES


def test_a_steady_climb_with_lost_samples_and_a_steady_rate_is_not_frozen():
    model = replace(MODEL, A=np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.025, 1.0]]))
    p = monitor(model)
    for j in [j for j in range(120) if j % 3 and j % 7]:
        assert p.judge(j, (0.0, 0.25, 0.25 * 0.025 * j)) is None, j


def test_a_number_that_does_not_rise_begins_anew():
    p = monitor()
    verdicts(p, [(0.1, 0.0, 0.0)] * 30)
    assert verdicts(p, [(-1.0, 0.0, 1.0)] * (FOUND_WITHIN - 1)) == [None] * (FOUND_WITHIN - 1)


def test_implausible_samples_between_neither_hide_nor_feed_a_frozen_row():
    p = monitor()
    said = verdicts(p, [(0.1, 0.0, 0.0), (9.0, 0.0, 0.0)] * 20)
    assert said[1::2] == ["implausible"] * 20
    assert said[0::2].index("frozen") == FOUND_WITHIN - 1


def test_one_bit_of_movement_is_movement():
    xs = [(0.1 + n * 1e-16, 0.1 + n * 1e-16, 0.1 + n * 1e-16) for n in range(100)]
    assert len(set(xs)) > 1
    assert verdicts(monitor(), [(x[0], x[1], x[2] if n % 2 else 0.2) for n, x in enumerate(xs)]).count("frozen") == 0


@quick
@given(
    st.tuples(*[st.floats(-0.5, 0.5)] * 3),
    st.lists(st.floats(-0.4, 0.4), min_size=60, max_size=60),
)
def test_an_aircraft_that_obeys_its_model_is_never_frozen_whatever_the_delay(x0, us):
    for d in (1, 4, COMMAND_MEMORY):
        p, x, said = monitor(), np.array(x0), []
        for j in range(60):
            said += verdicts(p, [tuple(x.tolist())], [us[j]], j)
            u = us[j - d] if j >= d else 0.0
            x = MODEL.A @ x + MODEL.B[:, 0] * u
        assert "frozen" not in said


# Real flights

FLIGHTS = ["nominal", "gust", "uncertain", "lossy", "blackout", "pendulum"]


@cache
def flown(name: str, actuator: str, duration_s: float | None = None) -> tuple[dict, ...]:
    """Return the commands of a stored scenario flown in virtual time."""
    scenario = replace(load_scenario(name), actuator=actuator, variants={})
    scenario = scenario if duration_s is None else replace(scenario, duration_s=duration_s)
    commands: list[dict] = []
    fly_virtual(scenario, lambda r, _: commands.append(dict(r.body)) if r.topic == "autopilot/command" else None)
    return tuple(commands)


def model_flown(name: str):
    return load_gains("pendulum-paper" if name == "pendulum" else "hirm-paper").model


def alarms(commands, model) -> list:
    p = monitor(model)
    said = []
    for c in commands:
        verdict = p.judge(c["j"], c["x"])
        p.commanded(c["u"][0])
        if verdict is not None:
            said.append((c["j"], verdict.reason))
    return said


@pytest.mark.parametrize("actuator", ["pwm", "float"])
@pytest.mark.parametrize("name", FLIGHTS)
def test_no_sample_of_a_real_flight_raises_an_alarm(name, actuator):
    commands = flown(name, actuator)
    assert len(commands) > 250
    assert alarms(commands, model_flown(name)) == []


def test_a_long_settled_flight_with_a_quantised_elevator_raises_no_alarm():
    commands = flown("nominal", "pwm", 60.0)
    assert len({c["x"][2] for c in commands[-500:]}) == 1  # the pitch angle stands still, bit for bit
    assert alarms(commands, MODEL) == []


def test_a_small_error_of_the_model_does_not_add_up():
    assert set(verdicts(monitor(), [(0.0, 0.0, 0.0873)] * 5000, [0.0004] * 5000)) == {None}


def moves_most(commands, state: int) -> int:
    """Return the sample from which a state moves most in FROZEN_SAMPLES."""
    values = [c["x"][state] for c in commands]
    return max(range(len(values) - 50), key=lambda i: abs(values[i + FROZEN_SAMPLES] - values[i]))


@pytest.mark.parametrize("name", ["nominal", "gust", "uncertain"])
@pytest.mark.parametrize("state", [0, 1, 2])
def test_a_single_state_that_freezes_where_it_moves_most_is_found_and_named(state, name):
    commands = flown(name, "pwm")
    start = moves_most(commands, state)
    p, found = monitor(), []
    for i, c in enumerate(commands[: start + 20 + FOUND_WITHIN]):
        x = list(c["x"])
        x[state] = commands[start]["x"][state] if i >= start else x[state]
        verdict = p.judge(c["j"], x)
        p.commanded(c["u"][0])
        if verdict is not None:
            assert verdict.reason.startswith(f"{MODEL.states[state]} frozen")
            found.append(i - start)
    assert found


@pytest.mark.parametrize("name", ["gust", "uncertain"])
def test_a_state_that_freezes_as_a_whole_in_a_manoeuvre_is_found_within_a_second(name):
    commands = flown(name, "pwm")
    start = moves_most(commands, 2) + 3
    p, x = monitor(), commands[start]["x"]
    before = commands[: start + 1]
    verdicts(p, [c["x"] for c in before], [c["u"][0] for c in before])
    us = [law(x, c["xr"]) for c in commands[start + 1 : start + 41]]
    said = verdicts(p, [x] * 40, us, start + 1)
    assert said.index("frozen") <= FOUND_WITHIN + COMMAND_MEMORY


@pytest.mark.parametrize("step_deg", [0.01, 0.1, 0.5])
@pytest.mark.parametrize("name", ["nominal", "gust", "lossy"])
def test_a_coarse_sensor_is_not_a_frozen_one(name, step_deg):
    step = math.radians(step_deg)
    coarse = [c | {"x": [round(value / step) * step for value in c["x"]]} for c in flown(name, "pwm")]
    assert any(a["x"] == b["x"] for a, b in pairwise(coarse))
    assert alarms(coarse, MODEL) == []


@pytest.mark.parametrize("w_rad_s", [0.1, 1.0, 3.0])
def test_a_sudden_gust_out_of_still_air_is_no_alarm(w_rad_s):
    p, x, said = monitor(), np.zeros(3), []
    for j in range(150):
        said += verdicts(p, [tuple(np.float32(x).tolist())], start=j)
        x = MODEL.A @ x + MODEL.E[:, 0] * (w_rad_s if 100 <= j < 104 else 0.0)
    assert set(said) == {None}
    assert abs(x[0]) > 1e-3


# Saturation


def test_the_elevator_may_stay_at_its_limit_for_its_time_and_not_longer():
    s = Saturation(S)
    assert [s.told(True, n * 25 * MS) for n in range(40)] == [None] * 40
    assert s.told(True, S) is Event.SATURATED
    assert s.told(True, S + 25 * MS) is Event.SATURATED


def test_one_command_within_the_travel_begins_the_time_anew():
    s = Saturation(S)
    s.told(True, 0)
    s.told(False, S - 1)
    assert s.told(True, S) is None
    assert s.told(True, 2 * S - 1) is None
    assert s.told(True, 2 * S) is Event.SATURATED
    assert s.told(False, 2 * S + 1) is None


def test_a_limit_of_zero_switches_saturation_off():
    s = Saturation(0)
    assert {s.told(True, n * S) for n in range(100)} == {None}


# Silence


def test_who_was_never_heard_is_never_lost():
    s = Silence(S)
    assert s.deadline_ns() is None
    assert s.tick(10**18) is None
    assert not s.lost


def test_a_loss_and_a_return_are_told_once_each():
    s = Silence(3 * S)
    assert s.heard(S) is None
    assert s.deadline_ns() == 4 * S
    assert s.tick(4 * S - 1) is None
    assert s.tick(4 * S) is Event.GROUND_LOST
    assert (s.lost, s.deadline_ns(), s.tick(100 * S)) == (True, None, None)
    assert s.heard(101 * S) is Event.GROUND_BACK
    assert (s.lost, s.heard(102 * S), s.tick(103 * S)) == (False, None, None)
    assert s.tick(105 * S) is Event.GROUND_LOST


def test_a_timeout_of_zero_switches_silence_off():
    s = Silence(0)
    assert s.heard(0) is None
    assert (s.deadline_ns(), s.tick(10**18), s.lost) == (None, None, False)


# Halves


def halves() -> Halves:
    return Halves(frozenset({Attitude, AoaSsa}))


@pytest.mark.parametrize(
    ("comes", "stops", "text"), [(Attitude, AoaSsa, "AOA_SSA missing"), (AoaSsa, Attitude, "ATTITUDE missing")]
)
def test_the_half_that_has_stopped_is_named_while_the_other_comes(comes, stops, text):
    h = halves()
    h.came(stops, 0)
    h.came(comes, MS)
    assert h.missing(-1) is None
    assert h.missing(0) == text
    assert h.missing(MS) is None  # since then nothing has come
    h.came(comes, 26 * MS)
    assert h.missing(MS) == text
    h.came(stops, 27 * MS)
    assert h.missing(MS) is None


def test_a_half_that_never_came_is_missing_from_the_first_of_the_other_on():
    h = halves()
    assert h.missing(0) is None
    h.came(Attitude, 7 * S)
    assert h.missing(0) == "AOA_SSA missing"
    h.forget()
    assert h.missing(0) is None


def test_a_link_that_is_gone_misses_no_half():
    h = halves()
    h.came(Attitude, S)
    h.came(AoaSsa, S + MS)
    assert h.missing(S + MS) is None


def test_a_state_in_one_message_has_no_halves():
    needed = {sensor.message for sensor in sensors_of(load_gains("pendulum-paper").model)}
    assert needed == {Attitude}
    h = Halves(needed)
    for n in range(10):
        h.came(Attitude, n * S)
        assert h.missing(n * S - 1) is None
