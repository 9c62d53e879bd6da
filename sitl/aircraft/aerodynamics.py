"""An aircraft by its derivatives: what its parameter file says, and the forces and moments that follow.

Coefficients are linear in angles, rates and surfaces but for the induced drag. Lift and drag act in stability axes of
the moving air, the moments about the body axes; rates are made dimensionless with b/2V and c/2V. Signs: elevator
trailing edge down pitches down; aileron positive rolls right; rudder positive (trailing edge left) yaws left. Stored
aircraft lie in ``sitl/airframes``.
"""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import NamedTuple

from gains.table import InputError, Table
from sitl.aircraft.atmosphere import standard_air

__all__ = ["Aerodynamics", "Aircraft", "Engine", "Loads", "Mass", "Surfaces", "load_aircraft", "stored_aircraft"]

SEA_LEVEL_DENSITY = standard_air(0.0).density_kg_m3


class Mass(NamedTuple):
    """kg and kg m^2, body axes through the centre of mass; the aircraft is symmetric."""

    mass: float
    Ix: float
    Iy: float
    Iz: float
    Ixz: float


class Aerodynamics(NamedTuple):
    """Reference area (m^2), span and chord (m), and derivatives, per radian; CD = CD0 + k CL^2."""

    area: float
    span: float
    chord: float
    CL0: float
    CL_alpha: float
    CL_q: float
    CL_elevator: float
    CD0: float
    k: float
    Cm0: float
    Cm_alpha: float
    Cm_q: float
    Cm_elevator: float
    CY_beta: float
    CY_rudder: float
    Cl_beta: float
    Cl_p: float
    Cl_r: float
    Cl_aileron: float
    Cl_rudder: float
    Cn_beta: float
    Cn_p: float
    Cn_r: float
    Cn_aileron: float
    Cn_rudder: float


class Engine(NamedTuple):
    """Thrust along the body's x axis: full at sea level (N), how it falls with the density, and its lag (s)."""

    thrust: float
    exponent: float
    tau: float


class Surfaces(NamedTuple):
    """Travel of each surface each way, rad; rate, rad/s, and lag, s, of each actuator."""

    elevator: float
    aileron: float
    rudder: float
    rate: float
    tau: float


@dataclass(frozen=True, slots=True)
class Aircraft:
    """A rigid aircraft.

    Attributes
    ----------
    name : str
    mass : Mass
    aerodynamics : Aerodynamics
    engine : Engine
    surfaces : Surfaces
    """

    name: str
    mass: Mass
    aerodynamics: Aerodynamics
    engine: Engine
    surfaces: Surfaces

    def thrust_N(self, throttle: float, density: float) -> float:
        """Return what the engine gives in the end at a throttle from 0 to 1."""
        return throttle * self.engine.thrust * math.pow(density / SEA_LEVEL_DENSITY, self.engine.exponent)


class Loads(NamedTuple):
    """Force (N) and moment (N m) of the air in body axes."""

    X: float
    Y: float
    Z: float
    L: float
    M: float
    N: float


def loads(
    aero: Aerodynamics,
    density: float,
    airspeed: float,
    alpha: float,
    beta: float,
    rates: tuple[float, float, float],
    surfaces: tuple[float, float, float],
) -> Loads:
    """Return what the air does to the aircraft.

    Parameters
    ----------
    aero : Aerodynamics
    density : float
        kg/m^3.
    airspeed, alpha, beta : float
        Against the moving air: m/s, rad.
    rates : (p, q, r)
        Body rates, rad/s.
    surfaces : (elevator, aileron, rudder)
        rad.
    """
    elevator, aileron, rudder = surfaces
    pressure = 0.5 * density * airspeed * airspeed * aero.area
    over = 0.5 / airspeed if airspeed > 0.0 else 0.0
    p, q, r = rates[0] * aero.span * over, rates[1] * aero.chord * over, rates[2] * aero.span * over
    CL = aero.CL0 + aero.CL_alpha * alpha + aero.CL_q * q + aero.CL_elevator * elevator
    CD = aero.CD0 + aero.k * CL * CL
    CY = aero.CY_beta * beta + aero.CY_rudder * rudder
    Cl = aero.Cl_beta * beta + aero.Cl_p * p + aero.Cl_r * r + aero.Cl_aileron * aileron + aero.Cl_rudder * rudder
    Cm = aero.Cm0 + aero.Cm_alpha * alpha + aero.Cm_q * q + aero.Cm_elevator * elevator
    Cn = aero.Cn_beta * beta + aero.Cn_p * p + aero.Cn_r * r + aero.Cn_aileron * aileron + aero.Cn_rudder * rudder
    sin, cos = math.sin(alpha), math.cos(alpha)
    return Loads(
        pressure * (CL * sin - CD * cos),
        pressure * CY,
        pressure * (-CL * cos - CD * sin),
        pressure * aero.span * Cl,
        pressure * aero.chord * Cm,
        pressure * aero.span * Cn,
    )


def stored_aircraft() -> dict[str, Path]:
    """Return name and file of each stored aircraft."""
    folder = Path(str(resources.files("sitl") / "airframes"))
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def load_aircraft(name_or_path: str) -> Aircraft:
    """Return a stored aircraft, or one from a file.

    Raises
    ------
    InputError
        When there is none, or the file is not well formed.
    """
    stored = stored_aircraft()
    path = stored.get(name_or_path, Path(name_or_path))
    if name_or_path not in stored and not path.is_file():
        near = difflib.get_close_matches(name_or_path, stored, 1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise InputError(f"sixdof:{name_or_path}: expected one of {', '.join(stored)}, or a file{hint}")
    table = Table.load(path)
    aircraft = Aircraft(
        table.string("name"),
        _mass(table.table("mass")),
        Aerodynamics(*_numbers(table.table("aerodynamics"), Aerodynamics._fields, ("area", "span", "chord"))),
        Engine(*_numbers(table.table("engine"), Engine._fields, ("thrust", "tau"))),
        Surfaces(*_numbers(table.table("surfaces"), Surfaces._fields, Surfaces._fields)),
    )
    table.finish()
    return aircraft


def _mass(table: Table) -> Mass:
    mass = Mass(*_numbers(table, Mass._fields, ("mass", "Ix", "Iy", "Iz")))
    if mass.Ixz**2 >= mass.Ix * mass.Iz:
        raise table.error("Ixz", f"a number below {math.sqrt(mass.Ix * mass.Iz):g} in size", f"{mass.Ixz:g}")
    return mass


def _numbers(table: Table, names: tuple[str, ...], positive: tuple[str, ...]) -> list[float]:
    return [table.number(name, above=0.0) if name in positive else table.number(name) for name in names]
