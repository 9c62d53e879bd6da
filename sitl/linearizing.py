"""From a linearised aircraft to a model that flies: held at Ts, with sensors, travel and a reference model."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.table import Table as Grid

from gains.model import Actuator, Condition, Model, Trim, zero_order_hold
from gains.modelfile import Continuous
from gains.templates import Template, short_period, with_reference
from sitl.aircraft.linearised import STATES, Linearised

__all__ = ["held", "model_of", "pole_text", "reference_poles", "summary_grid", "summary_of"]

SENSORS = {"alpha_rad": "AOA_SSA.AOA", "q_rad_s": "ATTITUDE.pitchspeed", "theta_rad": "ATTITUDE.pitch"}


def held(linearised: Linearised) -> Continuous:
    """Return the continuous plant, as a model file states it."""
    return Continuous(linearised.Ap, linearised.Bp, linearised.Ep)


def model_of(
    linearised: Linearised, name: str, Ts: float, template: Template | None, bandwidth: float | None, damping: float
) -> Model:
    """Return the model of an aircraft near its trim, held exactly at Ts.

    Parameters
    ----------
    linearised : Linearised
        The aircraft.
    name : str
        Of the model.
    Ts : float
        Sampling period, s.
    template, bandwidth, damping
        Of the reference model (:func:`gains.templates.with_reference`); None for none.

    Raises
    ------
    InputError
        When the template makes no reference model of it.
    """
    inputs = np.hstack([linearised.Bp, linearised.Ep])
    A, BE = zero_order_hold(linearised.Ap, inputs, Ts)
    split = linearised.Bp.shape[1]
    model = Model(
        name=name,
        Ts=Ts,
        A=A,
        B=BE[:, :split],
        E=BE[:, split:],
        C=np.array([[0.0, 0.0, 1.0]]),
        D=np.zeros((1, split)),
        states=STATES,
        trim=Trim(np.array([linearised.alpha_rad, 0.0, linearised.theta_rad]), np.array([linearised.u])),
        actuator=Actuator(
            np.array([linearised.u_low]),
            np.array([linearised.u_high]),
            None if linearised.u_rate is None else np.array([linearised.u_rate]),
            None if linearised.u_tau is None else np.array([linearised.u_tau]),
        ),
        sensors=SENSORS,
        condition=Condition(linearised.airspeed_m_s, linearised.altitude_m),
    )
    return model if template is None else with_reference(model, template, bandwidth=bandwidth, damping=damping)


def reference_poles(model: Model) -> list[complex]:
    """Return the reference model's poles in continuous time, 1/s; none without a reference."""
    if model.reference is None:
        return []
    poles = np.log(np.linalg.eigvals(model.reference.Ar).astype(complex)) / model.Ts
    return sorted(poles.tolist(), key=lambda pole: (abs(pole), pole.imag))


def pole_text(poles: list[complex]) -> str:
    """Return poles as people read them."""
    return ", ".join(
        f"{pole.real:.3f}{pole.imag:+.3f}i" if abs(pole.imag) > 1e-9 else f"{pole.real:.3f}" for pole in poles
    )


def summary_of(linearised: Linearised, model: Model) -> dict[str, Any]:
    """Return what people ask of a trim: the numbers of ``sitl linearize --json``."""
    frequency, damping = short_period(model)
    return {
        "aircraft": linearised.aircraft,
        "model": model.name,
        "Ts": model.Ts,
        "airspeed_m_s": linearised.airspeed_m_s,
        "altitude_m": linearised.altitude_m,
        "alpha_rad": linearised.alpha_rad,
        "theta_rad": linearised.theta_rad,
        "elevator": linearised.u,
        "elevator_unit": linearised.u_unit,
        "throttle": linearised.throttle,
        "short_period_rad_s": frequency,
        "short_period_damping": damping,
        "reference_poles": [[pole.real, pole.imag] for pole in reference_poles(model)],
        "notes": list(linearised.notes),
    }


def summary_grid(summary: dict[str, Any], file: str) -> Grid:
    """Return the table for a person."""
    grid = Grid(show_header=False, box=None, padding=(0, 2, 0, 0))
    grid.add_column(style="bold")
    grid.add_column(overflow="fold")
    speed, altitude = summary["airspeed_m_s"], summary["altitude_m"]
    grid.add_row("aircraft", f"{summary['aircraft']}, level at {speed:.2f} m/s true, {altitude:.0f} m")
    unit = "°" if summary["elevator_unit"] == "rad" else ""
    elevator = float(np.degrees(summary["elevator"])) if unit else summary["elevator"]
    alpha, theta = np.degrees(summary["alpha_rad"]), np.degrees(summary["theta_rad"])
    grid.add_row(
        "trim", f"α {alpha:.3f}°, θ {theta:.3f}°, elevator {elevator:.3f}{unit}, throttle {summary['throttle']:.0%}"
    )
    grid.add_row(
        "short period", f"{summary['short_period_rad_s']:.3f} rad/s, damping {summary['short_period_damping']:.3f}"
    )
    if summary["reference_poles"]:
        poles = pole_text([complex(re, im) for re, im in summary["reference_poles"]])
        grid.add_row("reference", f"poles {poles} 1/s")
    for note in summary["notes"]:
        grid.add_row("", note)
    grid.add_row("model file", file)
    return grid
