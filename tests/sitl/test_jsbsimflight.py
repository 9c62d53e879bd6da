"""JSBSim's aircraft kept out of the loop's way: trim, wing-leveller, speed hold and wind; every aircraft it has."""

from __future__ import annotations

import re
import socket
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from gains.model import Model
from sitl.aircraft.airframe import Pose
from sitl.aircraft.jsbsim import JsbsimAirframe, _travel, aircraft_names, linearise
from sitl.aircraft.jsbsimelevator import elevator_of
from sitl.aircraft.jsbsimload import FOOT, aircraft_file
from sitl.aircraft.wind import parse_wind
from sitl.linearizing import model_of

TS, DEGREE = 0.025, np.pi / 180.0
CONDITIONS = {"c172x": (100.0, 5000.0), "f16": (300.0, 5249.0), "737": (280.0, 20000.0), "A4": (300.0, 10000.0)}
"""Calibrated airspeed, kt, and altitude, ft."""
ALL = pytest.mark.parametrize("aircraft", CONDITIONS)


@cache
def model(aircraft: str) -> Model:
    vc_kts, altitude_ft = CONDITIONS[aircraft]
    return model_of(linearise(aircraft, vc_kts=vc_kts, altitude_m=altitude_ft * FOOT), aircraft, TS, None, None, 0.7)


def fly(aircraft: str, seconds: float, wind: str | None = None) -> tuple[JsbsimAirframe, list[Pose]]:
    """Fly at the trim's pitch angle, which a hand at the stick would hold; return the aircraft and its poses."""
    m = model(aircraft)
    assert m.condition is not None
    speed, altitude = m.condition.airspeed_m_s, m.condition.altitude_m
    flown = JsbsimAirframe(aircraft, m, None if wind is None else parse_wind(wind).start(TS, speed, altitude, 1))
    poses = [flown.pose]
    for _ in range(round(seconds / TS)):
        held = 0.3 * (flown.pose.pitch_rad - m.trim.x[2]) + 0.1 * flown.pose.q_rad_s
        assert flown.advance(m.trim.u - np.sign(m.B[1, 0]) * held, np.zeros(1), 0.0) is None
        poses.append(flown.pose)
    return flown, poses


# -- what is held


@pytest.mark.long
@ALL
def test_a_trim_stays_for_a_minute(aircraft: str) -> None:
    flown, poses = fly(aircraft, 60.0)
    m = model(aircraft)
    assert m.condition is not None
    assert np.ptp([pose.pitch_rad for pose in poses]) < 0.02 * DEGREE
    assert np.ptp([pose.alpha_rad for pose in poses]) < 0.01 * DEGREE
    assert np.ptp([pose.airspeed_m_s for pose in poses]) < 0.02
    assert np.ptp([pose.altitude_m for pose in poses]) < 3.0
    assert max(abs(pose.roll_rad) for pose in poses) < 0.2 * DEGREE
    assert flown.x == pytest.approx(m.trim.x, abs=0.02 * DEGREE)


@ALL
def test_roll_and_airspeed_come_back_after_gusts_from_the_side_and_from_ahead(aircraft: str) -> None:
    """Air that moves to the right pushes the nose of the relative wind to the left; 4 m/s from ahead are airspeed."""
    _, poses = fly(aircraft, 22.0, "gust:v:5mps:20m@0.5s+gust:u:-4mps:20m@8s")
    roll = np.array([pose.roll_rad for pose in poses]) / DEGREE
    speed = np.array([pose.airspeed_m_s for pose in poses]) - poses[0].airspeed_m_s
    beta = np.array([pose.beta_rad for pose in poses]) / DEGREE
    assert beta.min() < -1.0
    assert np.abs(roll[20:320]).max() > 0.5  # it was disturbed
    assert max(np.abs(roll[280:320]).max(), np.abs(roll[-40:]).max()) < 1.0  # in between, a propeller's torque
    assert 3.0 < speed[320:400].max() < 4.2
    assert np.abs(speed[-40:]).max() < 0.6
    assert max(abs(pose.altitude_m - poses[0].altitude_m) for pose in poses) < 15.0


def test_the_ground_passes_slower_when_the_air_comes_from_ahead() -> None:
    _, poses = fly("A4", 1.0, "gust:u:-4mps:1m@0.1s")
    assert poses[0].groundspeed_m_s == pytest.approx(poses[0].airspeed_m_s, abs=0.01)
    assert poses[12].airspeed_m_s - poses[12].groundspeed_m_s == pytest.approx(4.0, abs=0.1)


def test_no_fuel_is_burnt() -> None:
    flown, _ = fly("A4", 2.0)
    fdm = flown._flight.fdm  # what no pose says
    fuel = fdm["propulsion/total-fuel-lbs"]
    assert fuel > 0.0
    flown.advance(model("A4").trim.u, np.zeros(1), 0.0)
    assert fdm["propulsion/total-fuel-lbs"] == fuel
    assert fdm["propulsion/engine/thrust-lbs"] > 100.0  # and it runs


# -- the elevator


@ALL
def test_the_stick_moves_the_elevator_within_the_travel_of_its_file_and_nearly_all_of_it(aircraft: str) -> None:
    vc_kts, altitude_ft = CONDITIONS[aircraft]
    low, high = _travel(aircraft, vc_kts, None, altitude_ft * FOOT)
    said = elevator_of(aircraft_file(aircraft))
    assert said.low is not None
    assert said.high is not None
    assert said.low - 1e-6 <= low < high <= said.high + 1e-6
    assert high - low > (0.9 if aircraft != "f16" else 0.5) * (said.high - said.low)  # its own control limits the F-16


# -- what its files would do to the machine


@pytest.mark.parametrize("aircraft", ["737", "c172x"])
def test_the_ports_that_an_aircrafts_file_names_stay_free(aircraft: str) -> None:
    ports = {int(port) for port in re.findall(r'port="(\d+)"', aircraft_file(aircraft).read_text())}
    assert len(ports) >= 3
    kinds = (socket.SOCK_STREAM, socket.SOCK_DGRAM)
    free = [(kind, port) for kind in kinds for port in ports if _is_free(kind, port)]
    assert free  # else this machine says nothing
    flown, _ = fly(aircraft, 0.1)
    assert [each for each in free if _is_free(*each)] == free
    assert flown.pose.altitude_m > 100.0


def _is_free(kind: socket.SocketKind, port: int) -> bool:
    with socket.socket(socket.AF_INET, kind) as sock:
        try:
            sock.bind(("", port))
        except OSError:
            return False
        return True


# -- all of them

TRY = """
import sys
import numpy as np
from gains.table import InputError
from sitl.aircraft.jsbsim import JsbsimAirframe, linearise
from sitl.linearizing import model_of
name, said = sys.argv[1], ""
for vc_kts, altitude_m in ((100, 1500), (150, 1500), (250, 3000), (70, 1000), (300, 6000), (40, 300)):
    try:
        found = linearise(name, vc_kts=vc_kts, altitude_m=altitude_m)
        model = model_of(found, name, 0.025, None, None, 0.7)
        flown = JsbsimAirframe(name, model)
        for _ in range(10):
            assert flown.advance(model.trim.u, np.zeros(1), 0.0) is None
        assert np.abs(flown.x - model.trim.x).max() < 0.02, flown.x - model.trim.x
        assert model.actuator.low[0] < model.trim.u[0] < model.actuator.high[0]
        print(f"flies {vc_kts} kt")
        break
    except InputError as refused:
        said = str(refused)
        assert said.startswith("jsbsim:") and "expected" in said and "found" in said and "\\n" not in said, said
else:
    print("refused", said)
"""
FLY = {
    *CONDITIONS,
    *("787-8", "A320", "B747", "Camel", "Concorde", "DHC6", "F4N", "F80C", "J3Cub", "MD11", "T37"),
    *("c172p", "c172r", "c182", "f15", "global5000", "t6texan2"),
}
"""Aircraft that can be trimmed at one of a few plausible conditions, and are then flown."""


@pytest.mark.long
def test_every_aircraft_of_jsbsim_flies_or_is_refused_in_one_line(tmp_path: Path) -> None:
    """Each in a process of its own: the interpreter survives, nothing is printed, no file is left."""
    came_to: dict[str, str] = {}
    for name in aircraft_names():
        ran = subprocess.run(
            [sys.executable, "-c", TRY, name], cwd=tmp_path, capture_output=True, text=True, timeout=120.0, check=False
        )
        assert (ran.returncode, ran.stderr) == (0, ""), (name, ran.stderr[-1000:])
        lines = ran.stdout.splitlines()
        assert len(lines) == 1, (name, ran.stdout[:1000])
        came_to[name] = lines[0]
        print(f"{name}: {lines[0][:200]}")
    assert not any(tmp_path.iterdir())
    assert {name for name, line in came_to.items() if line.startswith("flies")} >= FLY
