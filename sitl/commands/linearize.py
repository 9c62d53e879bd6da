"""``sitl linearize``: a nonlinear aircraft near a trim, as a model file that ``gains design`` takes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from gains.command import FiniteRange, print_json, require_writable
from gains.table import InputError
from gains.templates import DAMPING, TEMPLATES, Template
from sitl.commands.options import FILE

if TYPE_CHECKING:
    from gains.model import Model
    from sitl.aircraft.linearised import Linearised

__all__ = ["linearize"]

FOOT = 0.3048
LOWEST_M, HIGHEST_M = -500.0, 80e3
"""Where there is air to fly in: from the Dead Sea to where the tables of the atmosphere end."""
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
    if output is not None:
        require_writable(output)  # before it is computed
    altitude = _altitude(altitude_ft, altitude_m)
    from sitl.linearizing import held, model_of, summary_grid, summary_of  # with what is slow to load

    linearised = _linearised(aircraft, vc_kts, tas_m_s, mach, altitude)
    called = name or (output or Path(aircraft.partition(":")[2])).name.removesuffix(".toml")
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
    altitude = altitude_m if altitude_ft is None else altitude_ft * FOOT
    assert altitude is not None
    if not LOWEST_M <= altitude <= HIGHEST_M:
        option, unit = ("--altitude-m", 1.0) if altitude_ft is None else ("--altitude-ft", FOOT)
        raise InputError(
            f"{option}: expected a number from {LOWEST_M / unit:.0f} to {HIGHEST_M / unit:.0f},"
            f" found {altitude / unit:g}"
        )
    return altitude


def _linearised(
    aircraft: str, vc_kts: float | None, tas_m_s: float | None, mach: float | None, altitude_m: float
) -> Linearised:
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


def _notes(linearised: Linearised, model: Model, template: Template | None) -> list[str]:
    """Return the comment at the head of the file."""
    from sitl.linearizing import pole_text, reference_poles

    notes = [
        f"{linearised.aircraft} near level flight at {linearised.airspeed_m_s:.2f} m/s true and"
        f" {linearised.altitude_m:.0f} m, made by sitl linearize.",
        "",
        *linearised.notes,
        "",
        f"Units: x = [alpha (rad), q (rad/s), theta (rad)], u = elevator ({linearised.u_unit}),"
        " w = gust as a rate of alpha (rad/s).",
    ]
    if template is not None:
        notes.append(f"Reference: template {template}, poles {pole_text(reference_poles(model))} 1/s; discrete at Ts.")
    return notes
