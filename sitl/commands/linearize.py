"""``sitl linearize``: a nonlinear aircraft near a trim, as a model file that ``gains design`` takes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import numpy as np

from gains.command import FiniteRange, print_json
from gains.table import InputError
from gains.templates import DAMPING, TEMPLATES, Template
from sitl.commands.options import FILE

__all__ = ["linearize"]

FOOT = 0.3048
_POSITIVE = FiniteRange(0.0, min_open=True)


@click.command()
@click.argument("aircraft")
@click.option("--vc-kts", type=_POSITIVE, help="Calibrated airspeed, knots; of jsbsim: aircraft.")
@click.option("--tas-m-s", type=_POSITIVE, help="True airspeed, m/s.")
@click.option("--mach", type=_POSITIVE, help="Mach number; of sixdof: aircraft.")
@click.option("--altitude-ft", type=FiniteRange(), help="Above sea level, feet.")
@click.option("--altitude-m", type=FiniteRange(), help="Above sea level, metres.")
@click.option("--ts-ms", type=FiniteRange(4.0, 1000.0), default=25.0, show_default=True, help="Sampling period.")
@click.option(
    "--template",
    type=click.Choice([*TEMPLATES, "none"]),
    default="level1",
    show_default=True,
    help="Reference model: a level-1 short period and a bandwidth, a plain second order, or none.",
)
@click.option("--bandwidth", type=_POSITIVE, help="Of the reference model, rad/s; by default after the short period.")
@click.option("--damping", type=_POSITIVE, default=DAMPING, show_default=True, help="Of the reference's oscillation.")
@click.option("--name", help="Of the model; by default the output file's, or the aircraft's.")
@click.option("-o", "--output", type=FILE, help="Model file; without one it goes to standard output.")
@click.option("--json", "as_json", is_flag=True, help="Print trim and modes as one JSON object; wants -o.")
def linearize(
    aircraft: str,
    vc_kts: float | None,
    tas_m_s: float | None,
    mach: float | None,
    altitude_ft: float | None,
    altitude_m: float | None,
    ts_ms: float,
    template: str,
    bandwidth: float | None,
    damping: float,
    name: str | None,
    output: Path | None,
    as_json: bool,
) -> None:
    """Trim AIRCRAFT (jsbsim:c172x, sixdof:hirm) in level flight, and write its model near that trim.

    \b
    sitl linearize jsbsim:c172x --vc-kts 100 --altitude-ft 5000 -o c172.toml
    sitl linearize sixdof:hirm --mach 0.3 --altitude-m 1600 -o hirm6.toml
    """
    if as_json and output is None:
        raise InputError("--json: expected -o FILE, too: standard output cannot hold both")
    from sitl.linearizing import held, model_of, summary_grid, summary_of  # with what is slow to load

    altitude = _altitude(altitude_ft, altitude_m)
    linearised = _linearised(aircraft, vc_kts, tas_m_s, mach, altitude)
    called = name or (output.stem if output is not None else aircraft.partition(":")[2])
    chosen: Template | None = next((known for known in TEMPLATES if known == template), None)
    model = model_of(linearised, called, ts_ms / 1000.0, chosen, bandwidth, damping)
    from gains.modelfile import model_text, save_model

    notes = _notes(linearised, model, chosen)
    if output is None:
        click.echo(model_text(model, plant=held(linearised), notes=notes), nl=False)
        return
    save_model(output, model, plant=held(linearised), notes=notes)
    if as_json:
        print_json({**summary_of(linearised, model), "file": str(output)})
        return
    from rich.console import Console

    Console().print(summary_grid(summary_of(linearised, model), str(output)))


def _altitude(altitude_ft: float | None, altitude_m: float | None) -> float:
    if (altitude_ft is None) == (altitude_m is None):
        raise InputError("--altitude-ft, --altitude-m: expected one of them")
    if altitude_m is not None:
        return altitude_m
    assert altitude_ft is not None
    return altitude_ft * FOOT


def _linearised(
    aircraft: str, vc_kts: float | None, tas_m_s: float | None, mach: float | None, altitude_m: float
) -> Any:
    """Return what the maker of this kind of aircraft says of it."""
    kind, colon, name = aircraft.partition(":")
    speeds = {"--vc-kts": vc_kts, "--tas-m-s": tas_m_s, "--mach": mach}
    given = [option for option, value in speeds.items() if value is not None]
    takes = {"jsbsim": ("--vc-kts", "--tas-m-s"), "sixdof": ("--mach", "--tas-m-s")}
    if not colon or kind not in takes or not name:
        raise InputError(f"{aircraft}: expected jsbsim:NAME or sixdof:NAME")
    if len(given) != 1 or given[0] not in takes[kind]:
        raise InputError(f"{aircraft}: expected one of {', '.join(takes[kind])}, found {', '.join(given) or 'none'}")
    if kind == "jsbsim":
        from sitl.aircraft.jsbsim import linearise as linearise_jsbsim

        return linearise_jsbsim(name, vc_kts=vc_kts, airspeed_m_s=tas_m_s, altitude_m=altitude_m)
    from sitl.aircraft.trim import linearise as linearise_sixdof

    return linearise_sixdof(name, mach=mach, airspeed_m_s=tas_m_s, altitude_m=altitude_m)


def _notes(linearised: Any, model: Any, template: Template | None) -> list[str]:
    """Return the comment at the head of the file."""
    notes = [
        f"{linearised.aircraft} near level flight at {linearised.airspeed_m_s:.2f} m/s true and"
        f" {linearised.altitude_m:.0f} m, made by sitl linearize.",
        "",
        *linearised.notes,
        "",
        f"Units: x = [alpha (rad), q (rad/s), theta (rad)], u = elevator ({linearised.u_unit}),"
        " w = gust as a rate of alpha (rad/s).",
    ]
    if template is not None and model.reference is not None:
        poles = np.log(np.linalg.eigvals(model.reference.Ar).astype(complex)) / model.Ts
        shown = ", ".join(f"{p.real:.3f}{p.imag:+.3f}i" if abs(p.imag) > 1e-9 else f"{p.real:.3f}" for p in poles)
        notes.append(f"Reference: template {template}, poles {shown} 1/s; discrete at Ts.")
    return notes
