"""Which aircraft a name stands for: what ``--plant`` takes.

    hirm, my-model.toml     a linear model, stored or a file
    sixdof:hirm             Eq. (1) in six degrees of freedom, with the aerodynamics of a stored airframe or of a file
    jsbsim:c172x            an aircraft of JSBSim

The last two need a model beside the name, made by ``sitl linearize``: its condition says where they are trimmed, its
states what the autopilot is sent, its actuator how the elevator moves.
"""

from __future__ import annotations

from collections.abc import Callable

from gains.model import Model
from gains.store import load_model
from gains.table import InputError
from sitl.aircraft.airframe import Airframe
from sitl.aircraft.wind import WindSpec

__all__ = ["airframe_maker", "is_nonlinear", "plant_model"]

KINDS = ("sixdof", "jsbsim")


def is_nonlinear(name: str) -> bool:
    """Return whether a plant is more than a linear model, by its name."""
    return name.partition(":")[0] in KINDS and ":" in name


def plant_model(name: str, described_by: Model) -> Model:
    """Return the model of a plant: its own, or for a nonlinear one the model it is described by.

    Raises
    ------
    InputError
        When there is no such model.
    """
    return described_by if is_nonlinear(name) else load_model(name)


def airframe_maker(name: str, model: Model, wind: WindSpec | None, seed: int) -> Callable[[], Airframe] | None:
    """Return what makes a nonlinear plant, new and trimmed; None for a linear model, which needs nothing but itself.

    Parameters
    ----------
    name : str
        As ``--plant`` takes it.
    model : Model
        What it is described by.
    wind : WindSpec or None
        Turbulence and gusts; a linear model has no room for them.
    seed : int
        Of the turbulence.

    Raises
    ------
    InputError
        When a linear model shall fly in wind, or the model says no condition. What makes the aircraft raises it, too.
    """
    if not is_nonlinear(name):
        if wind is not None:
            raise InputError(f"wind: expected sixdof:... or jsbsim:... as plant, found {name}, a linear model")
        return None
    condition = model.condition
    if condition is None:
        raise InputError(f"{name}: expected a model with [condition] (sitl linearize makes one), found {model.name}")
    kind, _, aircraft = name.partition(":")

    def make() -> Airframe:
        air = None if wind is None else wind.start(model.Ts, condition.airspeed_m_s, condition.altitude_m, seed)
        if kind == "sixdof":  # either costs time to import that a linear aircraft need not pay
            from sitl.aircraft.sixdof import SixDofAirframe

            return SixDofAirframe(aircraft, model, air)
        from sitl.aircraft.jsbsim import JsbsimAirframe

        return JsbsimAirframe(aircraft, model, air)

    return make
