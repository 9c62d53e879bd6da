"""Two independent codes fly the same: a quaternion in body axes under SciPy's DOP853, and JSBSim."""

from __future__ import annotations

import math
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from sitl.aircraft.aerodynamics import Aircraft, load_aircraft, stored_aircraft
from sitl.aircraft.atmosphere import GRAVITY, standard_air
from sitl.aircraft.sixdof import Controls, State, body_angles, integrate
from sitl.aircraft.trim import trimmed

V, ALTITUDE_M, DT = 100.22896669603553, 1600.0, 0.005

Array = NDArray[np.float64]

HIRM = load_aircraft("hirm")


# -- an independent code: body axes, quaternion, adaptive DOP853, coefficients from the file as they stand there


def quaternion_flight(trim: State, air: tuple[float, float, float], legs: list[tuple[float, Controls]]) -> Array:
    """Return V, alpha, beta, p, q, r, roll, pitch, yaw, height after each leg of (seconds, controls)."""
    file = tomllib.loads(stored_aircraft()["hirm"].read_text())
    a, m = file["aerodynamics"], file["mass"]
    inertia = np.array([[m["Ix"], 0.0, -m["Ixz"]], [0.0, m["Iy"], 0.0], [-m["Ixz"], 0.0, m["Iz"]]])

    def rates(_: float, y: Array, controls: Controls) -> Array:
        to_earth, omega, thrust = Rotation.from_quat(y[3:7]), y[7:10], y[13]
        through = y[:3] - air
        speed = float(np.linalg.norm(through))
        alpha, beta = math.atan2(through[2], through[0]), math.asin(through[1] / speed)
        density = standard_air(-y[12]).density_kg_m3
        force = 0.5 * density * speed**2 * a["area"]
        p, q, r = omega * [a["span"], a["chord"], a["span"]] / (2.0 * speed)
        at = {"alpha": alpha, "beta": beta, "p": p, "q": q, "r": r}
        at |= {"elevator": controls.elevator, "aileron": controls.aileron, "rudder": controls.rudder}

        def coefficient(name: str) -> float:
            """Sum all derivatives that the file has of one coefficient."""
            terms = [a[f"{name}_{by}"] * value for by, value in at.items() if f"{name}_{by}" in a]
            return float(a.get(f"{name}0", 0.0) + sum(terms))

        lift = coefficient("CL")
        drag = a["CD0"] + a["k"] * lift**2
        turn = Rotation.from_euler("y", -alpha)  # stability axes to body axes
        aero = turn.apply([-drag, coefficient("CY"), -lift]) * force
        arms = np.array([a["span"], a["chord"], a["span"]])
        moment = force * arms * [coefficient("Cl"), coefficient("Cm"), coefficient("Cn")]
        pull = (aero + np.array([thrust, 0.0, 0.0])) / m["mass"] + to_earth.inv().apply([0.0, 0.0, GRAVITY])
        x, yq, z, w = y[3:7]
        ox, oy, oz = omega
        turning = 0.5 * np.array([
            w * ox + yq * oz - z * oy, w * oy + z * ox - x * oz, w * oz + x * oy - yq * ox, -x * ox - yq * oy - z * oz
        ])  # fmt: skip
        full = file["engine"]["thrust"] * (density / 1.225) ** file["engine"]["exponent"]
        return np.concatenate([
            pull - np.cross(omega, y[:3]),
            turning,
            np.linalg.solve(inertia, moment - np.cross(omega, inertia @ omega)),
            to_earth.apply(y[:3]),
            [(controls.throttle * full - thrust) / file["engine"]["tau"]],
        ])  # fmt: skip

    y = np.concatenate([
        trim.V * np.array([math.cos(trim.alpha), 0.0, math.sin(trim.alpha)]),
        Rotation.from_euler("y", trim.alpha).as_quat(),
        [0.0, 0.0, 0.0, 0.0, 0.0, -trim.height, trim.thrust],
    ])  # fmt: skip
    rows = []
    for seconds, controls in legs:
        y = solve_ivp(rates, (0.0, seconds), y, method="DOP853", args=(controls,), rtol=1e-10, atol=1e-10).y[:, -1]
        speed = float(np.linalg.norm(y[:3]))
        yaw, pitch, roll = Rotation.from_quat(y[3:7]).as_euler("ZYX")
        along = [speed, math.atan2(y[2], y[0]), math.asin(y[1] / speed)]
        rows.append([*along, *y[7:10], roll, pitch, yaw, -y[12]])
    return np.array(rows)


@pytest.mark.parametrize("air", [(0.0, 0.0, 0.0), (-6.0, 4.0, -3.0)], ids=["still", "wind"])
def test_a_quaternion_in_body_axes_flies_the_same(air: tuple[float, float, float]) -> None:
    state, trim = trimmed(HIRM, V, ALTITUDE_M)
    moves = [(0.05, 0.05, -0.03), (-0.05, 0.04, 0.03), (0.0, -0.02, 0.0), (-0.02, 0.0, 0.0), (0.0, 0.0, 0.0)]
    legs = [
        (2.0, Controls(trim.elevator + de, da, dr, trim.throttle + 0.2 * (i > 1)))
        for i, (de, da, dr) in enumerate(moves)
    ]
    expected = quaternion_flight(state, air, legs)
    for (seconds, controls), row in zip(legs, expected, strict=True):
        for _ in range(round(seconds / DT)):
            state = integrate(HIRM, state, controls, DT, 0.0, air)
        roll, pitch, yaw = body_angles(state)
        found = [state.V, state.alpha, state.beta, state.p, state.q, state.r, roll, pitch, yaw, state.height]
        assert found == pytest.approx(row.tolist(), rel=1e-7, abs=1e-7)
    assert np.abs(expected[:, 6]).max() > 0.5  # it was a manoeuvre
    assert np.abs(expected[:, 2]).max() > 0.02


# -- another independent code: JSBSim


JSBSIM_DT = 0.00025
"""It takes commands one of its steps late and integrates by a method of second order: all differences halve with it."""


def jsbsim_aircraft(folder: Path, aircraft: Aircraft) -> None:
    """Write an aircraft of JSBSim with the same mass and derivatives, its thrust a force from without."""
    a, m = aircraft.aerodynamics, aircraft.mass
    alpha = "<property>aero/alpha-rad</property>"
    rate = "<property>velocities/{}-aero-rad_sec</property><property>aero/{}</property>"
    at = {
        "alpha": alpha,
        "beta": "<property>aero/beta-rad</property>",
        "p": rate.format("p", "bi2vel"),
        "q": rate.format("q", "ci2vel"),
        "r": rate.format("r", "bi2vel"),
        "elevator": "<property>fcs/elevator-pos-rad</property>",
        "aileron": "<property>fcs/left-aileron-pos-rad</property>",
        "rudder": "<property>fcs/rudder-pos-rad</property>",
    }
    values = a._asdict()

    def coefficient(name: str) -> str:
        terms = {by: values[f"{name}_{by}"] for by in at if f"{name}_{by}" in values}
        products = [f"<product><value>{value!r}</value>{at[by]}</product>" for by, value in terms.items()]
        return f"<sum><value>{values.get(f'{name}0', 0.0)!r}</value>{''.join(products)}</sum>"

    lift, side, roll, pitch, yaw = (coefficient(name) for name in ("CL", "CY", "Cl", "Cm", "Cn"))
    force = "<property>aero/qbar-psf</property><property>metrics/Sw-sqft</property>"
    drag = f"<sum><value>{a.CD0!r}</value><product><value>{a.k!r}</value>{lift}{lift}</product></sum>"
    sin, cos = f"<sin>{alpha}</sin>", f"<cos>{alpha}</cos>"
    span, chord = "<property>metrics/bw-ft</property>", "<property>metrics/cbarw-ft</property>"
    along = f"<difference><product>{lift}{sin}</product><product>{drag}{cos}</product></difference>"
    down = (
        f"<product><value>-1</value><sum><product>{lift}{cos}</product><product>{drag}{sin}</product></sum></product>"
    )
    axes = {
        "X": along, "Y": side, "Z": down,
        "ROLL": span + roll, "PITCH": chord + pitch, "YAW": span + yaw,
    }  # fmt: skip
    functions = "".join(
        f'<axis name="{axis}"><function name="aero/{axis}"><product>{force}{body}</product></function></axis>'
        for axis, body in axes.items()
    )
    nowhere = "<x>0</x><y>0</y><z>0</z>"
    text = f"""<?xml version="1.0"?>
<fdm_config name="same" version="2.0" release="BETA">
<fileheader><author>test</author><filecreationdate>2020-01-01</filecreationdate><version>1</version></fileheader>
<metrics><wingarea unit="M2">{a.area!r}</wingarea><wingspan unit="M">{a.span!r}</wingspan>
<chord unit="M">{a.chord!r}</chord>
<location name="AERORP" unit="M">{nowhere}</location></metrics>
<mass_balance negated_crossproduct_inertia="false"><ixx unit="KG*M2">{m.Ix!r}</ixx><iyy unit="KG*M2">{m.Iy!r}</iyy>
<izz unit="KG*M2">{m.Iz!r}</izz><ixz unit="KG*M2">{m.Ixz!r}</ixz><emptywt unit="KG">{m.mass!r}</emptywt>
<location name="CG" unit="M">{nowhere}</location></mass_balance>
<ground_reactions/><propulsion/>
<external_reactions><force name="thrust" frame="BODY"><location unit="M">{nowhere}</location>
<direction><x>1</x><y>0</y><z>0</z></direction></force></external_reactions>
<flight_control name="none"/>
<aerodynamics>{functions}</aerodynamics></fdm_config>"""
    (folder / "same").mkdir()
    (folder / "same" / "same.xml").write_text(text)
    # a planet a hundred times too large does not turn: the flat earth, with gravity the same at every height
    radius = 6.4e8
    (folder / "planet.xml").write_text(
        f'<?xml version="1.0"?><planet name="flat"><equatorial_radius unit="M">{radius!r}</equatorial_radius>'
        f'<polar_radius unit="M">{radius!r}</polar_radius><rotation_rate unit="RAD/SEC">0</rotation_rate>'
        f'<GM unit="M3/SEC2">{GRAVITY * radius**2!r}</GM><J2>0</J2></planet>'
    )


DOUBLETS = {
    "elevator": [(1.0, (0.04, 0.0, 0.0)), (1.0, (-0.04, 0.0, 0.0)), (3.0, (0.0, 0.0, 0.0))],
    "aileron and rudder": [(1.0, (0.0, 0.03, 0.0)), (1.0, (0.0, -0.03, 0.04)), (3.0, (0.0, 0.0, -0.04))],
}


@pytest.mark.parametrize("doublet", list(DOUBLETS))
def test_jsbsim_flies_the_same(tmp_path: Path, doublet: str) -> None:
    jsbsim = pytest.importorskip("jsbsim")
    aircraft = replace(HIRM, engine=HIRM.engine._replace(tau=1e9))  # both with constant thrust
    state, trim = trimmed(aircraft, V, ALTITUDE_M)
    jsbsim_aircraft(tmp_path, aircraft)
    jsbsim.FGJSBBase().debug_lvl = 0
    fdm = jsbsim.FGFDMExec(str(tmp_path))
    fdm.set_debug_level(0)
    fdm.load_planet(str(tmp_path / "planet.xml"), False)
    fdm.set_aircraft_path(str(tmp_path))
    assert fdm.load_model("same", True)
    fdm.set_dt(JSBSIM_DT)
    foot, pound = 0.3048, 4.4482216152605
    fdm["ic/h-sl-ft"] = ALTITUDE_M / foot
    fdm["ic/vt-fps"] = V / foot
    fdm["ic/alpha-rad"] = state.alpha
    fdm["ic/gamma-rad"] = 0.0
    fdm["fcs/elevator-pos-rad"] = trim.elevator
    fdm["external_reactions/thrust/magnitude"] = state.thrust / pound
    assert fdm.run_ic()
    found, expected = [], []
    for seconds, (de, da, dr) in DOUBLETS[doublet]:
        controls = Controls(trim.elevator + de, da, dr, trim.throttle)
        fdm["fcs/elevator-pos-rad"] = controls.elevator
        fdm["fcs/left-aileron-pos-rad"], fdm["fcs/rudder-pos-rad"] = da, dr
        for _ in range(round(seconds / DT)):
            state = integrate(aircraft, state, controls, DT)
        for _ in range(round(seconds / JSBSIM_DT)):
            fdm.run()
        roll, pitch, _ = body_angles(state)
        expected.append([state.V / 100.0, state.alpha, state.beta, state.p, state.q, state.r, roll, pitch])
        names = ("aero/alpha-rad", "aero/beta-rad", *(f"velocities/{axis}-rad_sec" for axis in "pqr"))
        angles = (fdm["attitude/phi-rad"], fdm["attitude/theta-rad"])
        found.append([fdm["velocities/vt-fps"] * foot / 100.0, *(fdm[name] for name in names), *angles])
    # steps of 0.25 ms at 0.2 rad/s and 0.2 rad/s^2, and a density that is 5e-5 off, as its altitude is not geopotential
    assert np.array(found) == pytest.approx(np.array(expected), abs=6e-5)
    moved = np.ptp(expected, axis=0)
    assert moved[[5 if "rudder" in doublet else 4, 3 if "rudder" in doublet else 1]].min() > 0.01  # 170 times that
