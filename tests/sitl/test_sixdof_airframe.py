"""The six degrees of freedom behind the plant's Node: its trim, its holds, its wind, its refusals and its end."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gains.model import Condition, Model, Trim
from gains.store import load_model
from gains.table import InputError
from sitl.aircraft.aerodynamics import load_aircraft, stored_aircraft
from sitl.aircraft.sixdof import SixDofAirframe, _Hold
from sitl.aircraft.trim import linearise, trimmed
from sitl.aircraft.wind import parse_wind

MODEL = load_model("hirm-6dof")
CALM = np.zeros(1)


def airframe(model: Model = MODEL, wind: str | None = None, seed: int = 1) -> SixDofAirframe:
    assert model.condition is not None
    V, h = model.condition.airspeed_m_s, model.condition.altitude_m
    return SixDofAirframe("hirm", model, None if wind is None else parse_wind(wind).start(model.Ts, V, h, seed))


def fly(aircraft: SixDofAirframe, seconds: float, du: float = 0.0, w: float = 0.0) -> str | None:
    for _ in range(round(seconds / MODEL.Ts)):
        if (reason := aircraft.advance(MODEL.trim.u + du, np.array([w]), 0.0)) is not None:
            return reason
    return None


def test_trim_stays_where_it_is() -> None:
    aircraft = airframe()
    start = aircraft.pose
    assert fly(aircraft, 20.0) is None
    assert aircraft.x == pytest.approx(MODEL.trim.x, abs=1e-9)
    assert aircraft.pose == pytest.approx(start, abs=1e-6)


def test_the_pose_at_the_start_is_level_flight_at_the_condition() -> None:
    pose, condition = airframe().pose, MODEL.condition
    assert condition is not None
    assert (pose.airspeed_m_s, pose.groundspeed_m_s) == pytest.approx((condition.airspeed_m_s,) * 2)
    assert (pose.altitude_m, pose.climb_m_s) == (condition.altitude_m, 0.0)
    assert pose.pitch_rad == pytest.approx(pose.alpha_rad)
    assert 0.1 < pose.throttle < 0.9


def test_a_flight_repeats_to_the_bit() -> None:
    one, two = (airframe(wind="dryden:moderate+gust:v:8mps:50m@1s") for _ in range(2))
    assert fly(one, 4.0, 0.01) == fly(two, 4.0, 0.01)
    assert one.pose == two.pose
    assert np.array_equal(one.x, two.x)
    other = airframe(wind="dryden:moderate+gust:v:8mps:50m@1s", seed=2)
    fly(other, 4.0, 0.01)
    assert other.pose != one.pose


def test_states_come_in_the_order_of_the_model() -> None:
    turned = [2, 0, 1]
    model = replace(
        MODEL,
        A=MODEL.A[np.ix_(turned, turned)],
        B=MODEL.B[turned],
        E=MODEL.E[turned],
        C=MODEL.C[:, turned],
        states=tuple(MODEL.states[i] for i in turned),
        trim=Trim(MODEL.trim.x[turned], MODEL.trim.u),
    )
    plain, other = airframe(), airframe(model)
    fly(plain, 0.5, -0.05)
    fly(other, 0.5, -0.05)
    assert np.array_equal(other.x, plain.x[turned])


def test_a_small_step_of_the_elevator_moves_it_as_the_model_says() -> None:
    aircraft, x = airframe(), np.zeros(3)
    du = math.radians(0.1)
    for _ in range(40):
        aircraft.advance(MODEL.trim.u + du, CALM, 0.0)
        x = MODEL.A @ x + MODEL.B[:, 0] * du
        assert aircraft.x - MODEL.trim.x == pytest.approx(x, abs=0.02 * float(np.abs(x).max()))
    assert x[1] < 0.0  # trailing edge down pitches down


def test_the_papers_gust_turns_alpha_and_leaves_pitch_alone() -> None:
    aircraft, w = airframe(), math.radians(2.0)
    aircraft.advance(MODEL.trim.u, np.array([w]), 0.0)
    moved = aircraft.x - MODEL.trim.x
    assert moved == pytest.approx(MODEL.E[:, 0] * w, rel=0.01, abs=1e-6)
    assert moved[0] > 0.98 * w * MODEL.Ts
    assert abs(moved[2]) < 1e-3 * moved[0]


# -- moving air


def test_air_that_rises_raises_the_angle_of_attack_and_the_nose_falls_into_it() -> None:
    aircraft = airframe(wind="gust:w:-3mps:1m@0s")  # w is down
    fly(aircraft, 0.1)
    V = aircraft.pose.airspeed_m_s
    assert aircraft.pose.alpha_rad - MODEL.trim.x[0] == pytest.approx(3.0 * math.cos(MODEL.trim.x[0]) / V, rel=0.1)
    assert aircraft.pose.q_rad_s < 0.0
    assert aircraft.pose.climb_m_s > 0.0


def test_a_headwind_is_airspeed_and_air_from_the_left_is_sideslip_to_the_left() -> None:
    head, side = airframe(wind="gust:u:-5mps:1m@0s"), airframe(wind="gust:v:5mps:1m@0s")
    start = head.pose
    fly(head, 0.05)
    fly(side, 0.05)
    assert head.pose.airspeed_m_s - start.airspeed_m_s == pytest.approx(5.0 * math.cos(MODEL.trim.x[0]), rel=0.02)
    assert head.pose.groundspeed_m_s == pytest.approx(start.groundspeed_m_s, abs=0.2)
    assert side.pose.beta_rad == pytest.approx(-5.0 / start.airspeed_m_s, rel=0.05)


def test_wings_are_level_again_after_a_gust_from_the_side() -> None:
    aircraft = airframe(wind="gust:v:10mps:30m@0s")
    rolled = 0.0
    for _ in range(480):
        aircraft.advance(MODEL.trim.u, CALM, 0.0)
        rolled = max(rolled, abs(aircraft.pose.roll_rad))
    assert rolled > 0.02
    assert abs(aircraft.pose.roll_rad) < 0.1 * rolled
    assert abs(aircraft.pose.p_rad_s) < 1e-3


@pytest.mark.parametrize("gust_m_s", [15.0, -15.0])
def test_airspeed_comes_back_after_the_wind_has_changed_for_good(gust_m_s: float) -> None:
    aircraft = airframe(wind=f"gust:u:{gust_m_s:g}mps:100m@0s")
    trim_m_s, farthest = aircraft.pose.airspeed_m_s, 0.0
    law = np.array([-0.5054, 3.3877, 3.1151])  # the paper's K1 of (54), as something must hold the nose
    for _ in range(800):
        u = MODEL.trim.u + law @ (aircraft.x - MODEL.trim.x)
        aircraft.advance(u, CALM, 0.0)
        farthest = max(farthest, abs(aircraft.pose.airspeed_m_s - trim_m_s))
    assert farthest > 5.0
    assert aircraft.pose.airspeed_m_s == pytest.approx(trim_m_s, abs=0.5)
    assert aircraft.pose.groundspeed_m_s - trim_m_s == pytest.approx(gust_m_s, abs=1.0)


def test_aileron_and_rudder_move_no_faster_than_their_actuators() -> None:
    hirm = load_aircraft("hirm")
    state, controls = trimmed(hirm, 100.0, 1600.0)
    hold, surfaces, dt_s = _Hold(hirm, state, controls), hirm.surfaces, 0.005
    rolled = state._replace(phi=3.0, r=2.0)
    before, moved = (0.0, 0.0), []
    for _ in range(200):
        controls = hold.act(rolled, 100.0, 0.0, dt_s)
        moved.append((controls.aileron - before[0], controls.rudder - before[1]))
        before = controls.aileron, controls.rudder
    assert np.abs(moved).max() == pytest.approx(surfaces.rate * dt_s)
    assert before == pytest.approx((-surfaces.aileron, surfaces.rudder), rel=1e-6)  # against both, and at the stop


# -- refusals and ends


def test_models_of_other_states_or_without_a_condition_are_refused() -> None:
    for model in (load_model("pendulum"), replace(MODEL, condition=None)):
        with pytest.raises(InputError, match="sixdof:hirm: expected a model with states alpha_rad, q_rad_s, theta_rad"):
            SixDofAirframe("hirm", model)


def test_a_model_of_another_trim_is_refused() -> None:
    others = (
        load_model("hirm"),  # of the same condition, with its angles counted from trim
        replace(MODEL, trim=Trim(MODEL.trim.x + np.array([2e-3, 0.0, 0.0]), MODEL.trim.u)),
        replace(MODEL, trim=Trim(MODEL.trim.x, MODEL.trim.u - 2e-3)),
        replace(MODEL, condition=Condition(105.0, 1600.0)),
        replace(MODEL, condition=Condition(100.22896669603553, 2500.0)),
    )
    for model in others:
        with pytest.raises(InputError, match=r"expected a model trimmed at .* rad off"):
            SixDofAirframe("hirm", model)
    near = replace(MODEL, trim=Trim(MODEL.trim.x + 0.5e-3, MODEL.trim.u))
    assert SixDofAirframe("hirm", near).x == pytest.approx(MODEL.trim.x, abs=1e-9)  # it flies its own


def test_an_unknown_aircraft_is_refused_with_the_nearest_name() -> None:
    with pytest.raises(InputError, match=r"sixdof:hrim: expected one of hirm.*; did you mean hirm\?"):
        SixDofAirframe("hrim", MODEL)


def test_the_ground_ends_a_flight_and_the_aircraft_stays_there() -> None:
    low = replace(MODEL, condition=Condition(100.0, 30.0))
    aircraft = low_trimmed(low)
    reason, k = None, 0
    while reason is None and k < 800:
        reason, k = aircraft.advance(np.array([0.05]), CALM, 0.0), k + 1
    assert reason == "ground"
    last = aircraft.pose
    assert 0.0 <= last.altitude_m < 10.0
    assert aircraft.advance(np.array([0.05]), CALM, 0.0) == "ground"
    assert aircraft.pose == last


def low_trimmed(model: Model) -> SixDofAirframe:
    assert model.condition is not None
    V, h = model.condition.airspeed_m_s, model.condition.altitude_m
    there = linearise("hirm", airspeed_m_s=V, altitude_m=h)
    trim = Trim(np.array([there.alpha_rad, 0.0, there.theta_rad]), np.array([there.u]))
    return SixDofAirframe("hirm", replace(model, trim=trim))


@pytest.mark.parametrize("du", [-0.4, 0.45])
def test_a_loop_ends_with_a_reason_before_the_angles_lose_their_meaning(du: float) -> None:
    aircraft = airframe()
    assert fly(aircraft, 60.0, du) in ("flight path or sideslip beyond 89 degrees", "no speed", "ground")
    assert all(map(math.isfinite, aircraft.pose))


@pytest.mark.parametrize("value", [1e3, 1e12, 1e200, 1e308, math.inf, math.nan])
def test_no_disturbance_and_no_command_raises(value: float) -> None:
    for u, w in ((value, 0.0), (0.0, value), (0.0, -value)):
        aircraft = airframe()
        start = aircraft.pose
        assert aircraft.advance(np.array([u]), np.array([w]), 0.0) is not None
        assert aircraft.pose == start


@pytest.mark.parametrize("wind", ["gust:w:1e6mps:1m@0s", "gust:v:1e200mps:1m@0s", "gust:u:-300mps:1m@0s"])
def test_no_wind_raises(wind: str) -> None:
    assert fly(airframe(wind=wind), 60.0) is not None


def test_severe_turbulence_is_flown() -> None:
    aircraft = airframe(wind="dryden:severe", seed=3)
    assert fly(aircraft, 5.0) is None
    assert abs(aircraft.pose.roll_rad) < 0.3


# -- parameter files


def parameter_file(folder: Path, old: str = "", new: str = "") -> str:
    text = stored_aircraft()["hirm"].read_text()
    assert old in text
    path = folder / "mine.toml"
    path.write_text(text.replace(old, new, 1) if old else text)
    return str(path)


def test_an_aircraft_from_a_file_flies_as_the_stored_one(tmp_path: Path) -> None:
    mine, stored = SixDofAirframe(parameter_file(tmp_path), MODEL), airframe()
    fly(mine, 0.5, -0.02)
    fly(stored, 0.5, -0.02)
    assert mine.pose == stored.pose


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("mass = 15296.0", "mass = -1.0", r"mass\.mass: expected .* above 0, found -1"),
        ("mass = 15296.0", "", r"mass\.mass: expected .* found nothing"),
        ("Ixz = -3124.0", "Ixz = 70000.0", r"mass\.Ixz: expected a number below 67046.* in size, found 70000"),
        ("chord = 3.511", "chord = 0.0", r"aerodynamics\.chord: expected .* above 0, found 0"),
        ("CL0 = 0.05", "CL0 = 'a'", r"aerodynamics\.CL0: expected a number, found"),
        ("CL0 = 0.05", "CL0 = nan", r"aerodynamics\.CL0: expected a .*number, found nan"),
        ("CL0 = 0.05", "CL0 = 0.05\nCLO = 0.1", r"aerodynamics\.CLO: "),
        ("[engine]", "[engines]", r"engine: expected a table, found nothing"),
        ("tau = 0.8", "tau = 0.0", r"engine\.tau: expected .* above 0, found 0"),
        ("thrust = 80000.0", "thrust = true", r"engine\.thrust: expected a number above 0, found"),
        ("elevator = 0.4363323129985824", "elevator = -0.4", r"surfaces\.elevator: expected .* above 0, found -0.4"),
        ('name = "hirm"', "name = 3", r"name: expected .* found 3"),
    ],
)
def test_a_bad_parameter_file_is_one_line_with_file_and_field(
    tmp_path: Path, old: str, new: str, complaint: str
) -> None:
    path = parameter_file(tmp_path, old, new)
    with pytest.raises(InputError, match=complaint) as refused:
        SixDofAirframe(path, MODEL)
    assert str(refused.value).startswith(f"{path}: ")
    assert "\n" not in str(refused.value)
