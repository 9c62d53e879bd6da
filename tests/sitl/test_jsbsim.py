"""Aircraft of JSBSim: their linear models are what is flown, and nothing but the longitudinal loop is in the way."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from gains.design import design
from gains.model import Condition, Gains, Model, Trim
from gains.store import load_model
from gains.table import InputError
from sitl.aircraft.jsbsim import JsbsimAirframe, aircraft_names, linearise
from sitl.aircraft.jsbsimelevator import Elevator, elevator_of
from sitl.aircraft.jsbsimload import FOOT, SURFACE, aircraft_file, jsbsim_package, trimmed
from sitl.aircraft.linear import move_actuator
from sitl.aircraft.linearised import Linearised
from sitl.aircraft.wind import parse_wind
from sitl.linearizing import model_of

TS = 0.025
CONDITIONS = {"c172x": (100.0, 5000.0), "f16": (300.0, 5249.0), "737": (280.0, 20000.0), "A4": (300.0, 10000.0)}
"""Calibrated airspeed, kt, and altitude, ft."""
ALL = pytest.mark.parametrize("aircraft", CONDITIONS)
DEGREE = np.pi / 180.0
CALM = np.zeros(1)


@cache
def linearised(aircraft: str) -> Linearised:
    vc_kts, altitude_ft = CONDITIONS[aircraft]
    return linearise(aircraft, vc_kts=vc_kts, altitude_m=altitude_ft * FOOT)


@cache
def model(aircraft: str) -> Model:
    return model_of(linearised(aircraft), aircraft, TS, None, None, 0.7)


@ALL
def test_a_flown_doublet_agrees_with_the_held_linear_model(aircraft):
    """Within 4 % of the largest deviation, over the second and a half in which the speed has not yet changed."""
    m, flown = model(aircraft), JsbsimAirframe(aircraft, model(aircraft))
    doublet = np.repeat([0.0, 0.01, -0.01, 0.0], [4, 20, 20, 16])
    x, expected, found = np.zeros(3), [], []
    for moved in doublet:
        expected.append(x)
        found.append(flown.x - m.trim.x)
        assert flown.advance(m.trim.u + moved, CALM, 0.0) is None
        x = m.A @ x + m.B[:, 0] * moved
    off = np.abs(np.array(found) - np.array(expected)).max(axis=0) / np.abs(expected).max(axis=0)
    assert (off < 0.04).all()


@ALL
def test_a_trimmed_aircraft_left_alone_stays_there(aircraft):
    m, flown = model(aircraft), JsbsimAirframe(aircraft, model(aircraft))
    for _ in range(80):
        assert flown.advance(m.trim.u, CALM, 0.0) is None
    assert np.abs(flown.x - m.trim.x).max() < 1e-4
    assert flown.pose.airspeed_m_s == pytest.approx(m.condition.airspeed_m_s, abs=0.01)
    assert abs(flown.pose.roll_rad) < 0.5 * DEGREE  # a propeller has torque, and ailerons have play


@pytest.mark.parametrize(("aircraft", "travel_rad"), [("737", 0.3), ("A4", 0.35)])
def test_the_surfaces_effect_is_the_sticks_where_nothing_stands_between_them(aircraft, travel_rad):
    """FGLinearization moves the stick; these two move their elevator in proportion to it."""
    vc_kts, altitude_ft = CONDITIONS[aircraft]
    fdm = trimmed(aircraft, vc_kts=vc_kts, airspeed_m_s=None, altitude_m=altitude_ft * FOOT, dt_s=1.0 / 400.0)
    linear = jsbsim_package().FGLinearization(fdm)
    stick = np.array(linear.input_matrix)[[linear.x_names.index(n) for n in ("Alpha", "Q")], 2]
    assert linearised(aircraft).Bp[:2, 0] * travel_rad == pytest.approx(stick, rel=1e-3)


def test_a_model_is_of_the_bare_aircraft_where_the_aircraft_has_augmentation():
    """The pitch damping of the F-16's control system would be several times that of its airframe."""
    found = linearised("f16")
    assert -1.5 < found.Ap[1, 1] < -0.5
    assert any("own pitch control" in note for note in found.notes)


def test_the_trim_is_level_and_absolute():
    found = linearised("c172x")
    assert found.alpha_rad == pytest.approx(found.theta_rad, abs=1e-5)
    assert 0.2 * DEGREE < found.alpha_rad < 3.0 * DEGREE
    assert found.altitude_m == pytest.approx(1524.0, abs=0.1)
    assert found.airspeed_m_s == pytest.approx(55.4, abs=0.1)  # 100 kt at 5,000 ft: 107.7 kt true


def test_a_gust_is_a_rate_of_alpha():
    m, flown = model("A4"), JsbsimAirframe("A4", model("A4"))
    w = np.array([0.2])
    x = np.zeros(3)
    for _ in range(10):
        assert flown.advance(m.trim.u, w, 0.0) is None
        x = m.A @ x + m.E @ w
    assert flown.x - m.trim.x == pytest.approx(x, rel=0.05)


def test_air_that_rises_is_an_angle_of_attack():
    flown = JsbsimAirframe("A4", model("A4"), parse_wind("gust:w:-2mps:0.1m").start(TS, 177.66, 3048.0, 1))
    speed, before = flown.pose.airspeed_m_s, flown.pose.alpha_rad
    flown.advance(model("A4").trim.u, CALM, 0.0)  # at sample 0 the gust has yet to begin
    assert flown.pose.alpha_rad == pytest.approx(before, abs=1e-5)
    flown.advance(model("A4").trim.u, CALM, 0.0)
    assert flown.pose.alpha_rad - before == pytest.approx(2.0 / speed, rel=0.1)


@pytest.mark.parametrize("aircraft", ["A4", "f16"])
def test_the_wings_stay_level_and_the_speed_is_held_in_turbulence(aircraft):
    m = model(aircraft)
    flown = JsbsimAirframe(aircraft, m, _turbulence(m))
    roll, speed = [], []
    for _ in range(400):
        pitch = flown.pose.pitch_rad - m.trim.x[2]
        surface = m.trim.u - np.sign(m.B[1, 0]) * (0.3 * pitch + 0.1 * flown.pose.q_rad_s)
        assert flown.advance(surface, CALM, 0.0) is None
        roll.append(flown.pose.roll_rad)
        speed.append(flown.pose.groundspeed_m_s - m.condition.airspeed_m_s)
    assert np.abs(roll).max() < 25.0 * DEGREE
    assert np.std(roll) > 0.0
    assert np.abs(speed).max() < 4.0


def test_two_flights_are_equal_bit_for_bit():
    def fly() -> list[bytes]:
        m = model("A4")
        flown, path = JsbsimAirframe("A4", m, _turbulence(m)), []
        for k in range(100):
            flown.advance(m.trim.u + 0.01 * np.sin(k / 7.0), np.array([0.01]), 0.0)
            path.append(flown.x.tobytes() + np.array(flown.pose).tobytes())
        return path

    assert fly() == fly()


def test_jsbsim_says_nothing_and_writes_nothing(tmp_path, monkeypatch, capfd):
    """The 737's file asks for sockets, the Cessna's for a file; a trim that fails is said in the complaint alone."""
    monkeypatch.chdir(tmp_path)
    before = _open_files()
    flown = JsbsimAirframe("737", model("737"))
    flown.advance(model("737").trim.u, CALM, 0.0)
    assert _open_files() == before
    fdm = trimmed("c172x", vc_kts=100.0, airspeed_m_s=None, altitude_m=1500.0, dt_s=0.01)
    assert all(fdm.run() for _ in range(100))
    with pytest.raises(InputError, match=r"c172x: expected a trim in level flight at 200 kt .* udot"):
        linearise("c172x", vc_kts=200.0, altitude_m=1500.0)
    assert capfd.readouterr() == ("", "")
    assert list(tmp_path.iterdir()) == []


def test_an_aircraft_that_meets_the_ground_stays_there():
    low = linearise("A4", airspeed_m_s=160.0, altitude_m=60.0)
    m = model_of(low, "low", TS, None, None, 0.7)
    flown = JsbsimAirframe("A4", m)
    reasons = [flown.advance(m.trim.u + 0.05, CALM, 0.0) for _ in range(200)]
    n = reasons.index("ground")
    assert set(reasons[:n]) == {None}
    assert set(reasons[n:]) == {"ground"}
    assert 0.0 < flown.pose.altitude_m < 30.0


def test_an_aircraft_beyond_all_bounds_says_why_and_stays_where_it_was():
    m = model("f16")
    tumbling = JsbsimAirframe("f16", m, parse_wind("gust:u:400mps:0.1m").start(TS, 166.0, 1600.0, 1))
    assert tumbling.advance(m.trim.u, CALM, 0.0) is None  # at sample 0 the gust has yet to begin
    before = tumbling.x
    assert tumbling.advance(m.trim.u, CALM, 0.0) == "angle of attack beyond 90 degrees"
    assert tumbling.x is before
    assert JsbsimAirframe("f16", m).advance(np.array([np.nan]), CALM, 0.0) == "no finite input"


def test_names_are_those_that_jsbsim_has():
    assert {*CONDITIONS, "c172p", "X15"} <= set(aircraft_names())
    with pytest.raises(InputError, match=r"jsbsim:C172X: expected an aircraft that JSBSim has.*did you mean c172x"):
        linearise("C172X", vc_kts=100.0, altitude_m=1500.0)
    with pytest.raises(InputError, match="expected a calibrated or a true airspeed"):
        linearise("c172x", altitude_m=1500.0)


def test_without_jsbsim_the_complaint_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "jsbsim", None)
    jsbsim_package.cache_clear()
    with pytest.raises(InputError, match=r"pip install 'lagproof\[jsbsim\]'"):
        aircraft_names()
    jsbsim_package.cache_clear()


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"condition": None}, r"expected a model with states .* and \[condition\]"),
        ({"states": ("alpha_rad", "q_rad_s", "gamma_rad")}, "expected a model with states alpha_rad"),
        ({"condition": Condition(160.0, 3048.0)}, "expected a model trimmed at 160.00 m/s .* rad off"),
        ({"trim": Trim(np.zeros(3), np.zeros(1))}, "expected a model trimmed at 177.66 m/s"),
    ],
)
def test_a_model_of_something_else_is_refused(change, complaint):
    with pytest.raises(InputError, match=complaint):
        JsbsimAirframe("A4", replace(model("A4"), sensors={}, **change))
    with pytest.raises(InputError, match="found pendulum"):
        JsbsimAirframe("A4", load_model("pendulum"))


def test_the_states_come_in_the_models_order():
    m = model("A4")
    order = [2, 0, 1]
    turned = replace(m, states=tuple(m.states[i] for i in order), trim=Trim(m.trim.x[order], m.trim.u))
    one, other = JsbsimAirframe("A4", m), JsbsimAirframe("A4", turned)
    for flown in (one, other):
        flown.advance(m.trim.u + 0.02, CALM, 0.0)
    assert (other.x == one.x[order]).all()


def test_travel_rate_and_lag_are_those_of_the_aircrafts_files():
    assert elevator_of(aircraft_file("A4")) == Elevator(-0.35, 0.30)
    assert elevator_of(aircraft_file("c172x")) == Elevator(-0.34, 0.34, tau=1.0 / 60.0)
    f16 = elevator_of(aircraft_file("f16"))
    assert (f16.low, f16.high, f16.tau) == (-0.436, 0.436, None)
    assert f16.rate == pytest.approx(0.872 / 0.3)  # stop to stop in 0.3 s
    assert elevator_of(aircraft_file("X15")) == Elevator()


def test_an_actuator_behind_the_scale_limits_it_further(tmp_path):
    path = tmp_path / "x.xml"
    path.write_text(
        f"""<fdm_config><flight_control><channel name="Pitch">
        <aerosurface_scale name="Elevator Control"><input>fcs/elevator-cmd-norm</input>
        <range><min>-20</min><max>15</max></range><gain>0.02</gain></aerosurface_scale>
        <actuator name="move"><input>fcs/elevator-control</input><lag>20</lag><rate_limit>1.5</rate_limit>
        <clipto><min>-0.2</min><max>0.5</max></clipto><output>{SURFACE}</output></actuator>
        </channel></flight_control></fdm_config>"""
    )
    assert elevator_of(path) == Elevator(-0.2, 0.3, 1.5, 0.05)


@pytest.mark.long
@pytest.mark.parametrize("aircraft", ["c172x", "f16"])
def test_designed_gains_track_a_pitch_step_with_delays_from_one_to_six(aircraft):
    m = model_of(linearised(aircraft), aircraft, TS, "level1", None, 0.7)
    found = design(m, 1, 6).gains
    assert found is not None
    error = np.abs(_tracking_error(aircraft, found, 2.0 * DEGREE, 30.0))
    assert error.max() < 0.3 * DEGREE
    assert error[-1] < 0.2 * DEGREE


def _tracking_error(aircraft: str, gains: Gains, step: float, seconds: float) -> np.ndarray:
    """Fly Eq. (9) with delays at random, and return the output less the reference's, rad."""
    m, reference = gains.model, gains.model.reference
    flown, delays = JsbsimAirframe(aircraft, m), np.random.default_rng(1)
    assert reference is not None
    assert gains.K2 is not None
    xr, position, history, error = np.zeros(m.nr), m.trim.u, [np.zeros(3)] * gains.d_max, []
    for _ in range(round(seconds / TS)):
        history.append(flown.x - m.trim.x)
        d = delays.integers(gains.d_min, gains.d_max + 1)
        position = move_actuator(m, position, m.trim.u + gains.K1 @ history[-1 - d] + gains.K2 @ xr)
        error.append((m.C @ history[-1] - reference.Cr @ xr)[0])
        assert flown.advance(position, CALM, 0.0) is None
        xr = reference.Ar @ xr + reference.Br[:, 0] * step
    return np.array(error)


def _open_files() -> int:
    """Return how many files and sockets this process has open, where the system says it."""
    listed = Path("/proc/self/fd")
    return len(list(listed.iterdir())) if listed.is_dir() else 0


def _turbulence(m: Model):
    assert m.condition is not None
    return parse_wind("dryden:light").start(TS, m.condition.airspeed_m_s, m.condition.altitude_m, 1)
