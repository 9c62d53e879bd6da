"""The ``gains`` command: models, gains and schedules listed and shown; :mod:`gains.proving` has the other commands."""

from __future__ import annotations

from collections.abc import Sequence

import click
import numpy as np
from rich import box
from rich.columns import Columns
from rich.console import Console
from rich.table import Table as Grid
from threadpoolctl import threadpool_limits

from gains.command import print_json, run, version
from gains.frontier import frontier
from gains.model import DynamicFeedback, GainLaw, Gains, Matrix, Model, Schedule, SmithPredictor, sets_of
from gains.modelling import baseline, export, import_, reference
from gains.proving import JSON_OPTION, bound, certify, design, schedule, witness
from gains.store import load, load_law, load_model, stored
from gains.verify import verified

__all__ = ["cli", "main"]

_SET = ("d_min", "d_max", "K1", "K2")
_DYNAMIC = ("Ac", "Bc", "Bcr", "L", "Cc", "Dc", "Dcr")


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(version(), message="%(prog)s %(version)s")
def cli() -> None:
    """Models of aircraft and the control gains that fly them over a delayed link.

    NAME is a stored model or gain file, as 'gains list' shows them, or the path of a TOML file.

    \b
    Exit status: 0 success; 1 negative or undecided answer; 2 bad input.
    """


@cli.command("list")
@JSON_OPTION
def list_(as_json: bool) -> None:
    """List the stored models and gains."""
    entries = stored()
    if as_json:
        print_json({"stored": [entry._asdict() for entry in entries]})
        return
    grid = _grid("name", "kind", "what")
    for name, kind, path in entries:
        what = _model_line(load_model(path)) if kind == "model" else _law_line(load_law(path))
        grid.add_row(name, kind, what)
    _console().print(grid)


@cli.command()
@click.argument("name")
@JSON_OPTION
def show(name: str, as_json: bool) -> None:
    """Show the model, the gains or the schedule NAME.

    A model is shown discrete at its sampling period, whatever the file holds. Certificates are verified, also that of
    the conservative gains that a gain file names.
    """
    item = load(name)
    if as_json:
        print_json(_model_json(item) if isinstance(item, Model) else _law_json(item))
    elif isinstance(item, Model):
        _show_model(_console(), item)
    else:
        _show_law(_console(), item)


for command in (certify, bound, witness, schedule, design, frontier, reference, baseline, export, import_):
    cli.add_command(command)


def main() -> None:
    """Run the ``gains`` command; on one thread, as the matrices are small and threads cost more than they bring."""
    with threadpool_limits(limits=1):
        run(cli, "gains")


# -- for programs


def _model_json(model: Model) -> dict[str, object]:
    eigenvalues = _eigenvalues(model.A)
    reference, uncertainty, actuator = model.reference, model.uncertainty, model.actuator
    return {
        "kind": "model",
        "name": model.name,
        "Ts": model.Ts,
        **{key: getattr(model, key) for key in "ABECD"},
        "states": model.states,
        "trim": _fields(model.trim, "x", "u"),
        "actuator": actuator and _fields(actuator, "low", "high", "rate", "tau"),
        "sensors": model.sensors,
        "reference": reference and _fields(reference, "Ar", "Br", "Cr"),
        "uncertainty": uncertainty and _fields(uncertainty, "F", "J1", "J2", "delta_max"),
        "condition": model.condition and _fields(model.condition, "airspeed_m_s", "altitude_m"),
        "eigenvalues": [{"re": v.real, "im": v.imag, "modulus": abs(v)} for v in eigenvalues],
        "spectral_radius": max(abs(v) for v in eigenvalues),
    }


def _law_json(law: GainLaw) -> dict[str, object]:
    scheduled = isinstance(law, Schedule)
    return {
        "kind": "schedule" if scheduled else "gains",
        "name": law.name,
        "model": law.model.name,
        "Ts": law.model.Ts,
        "d_min": law.d_min,
        "d_max": law.d_max,
        **({"window": [_fields(gains, *_SET) for gains in sets_of(law)]} if scheduled else _fields(law, "K1", "K2")),
        **_controller_json(law),
        "certificate": _certificate(law),
        "conservative": None if law.conservative is None else _conservative_json(law.conservative),
    }


def _controller_json(law: GainLaw) -> dict[str, object]:
    """Return which controller flies, and the matrices of a dynamic one."""
    match None if isinstance(law, Schedule) else law.controller:
        case None:
            return {"controller": "law"}
        case DynamicFeedback() as dynamic:
            return {"controller": "dynamic", "dynamic": _fields(dynamic, *_DYNAMIC)}
        case SmithPredictor():
            return {"controller": "smith"}


def _conservative_json(gains: Gains) -> dict[str, object]:
    return {**_fields(gains, "name", *_SET), "certificate": _certificate(gains)}


def _fields(item: object, *names: str) -> dict[str, object]:
    return {name: getattr(item, name) for name in names}


# -- for people


def _show_model(console: Console, model: Model) -> None:
    console.print(f"{model.name}: {_model_line(model)}")
    if model.condition is not None:
        at = model.condition
        console.print(f"flight condition: {at.airspeed_m_s:g} m/s at {at.altitude_m:g} m")
    inputs, outputs = _labels("u", model.nu), _labels("y", model.ny)
    states = model.states
    dynamics = [_matrix("A", model.A, states, states), _matrix("B", model.B, states, inputs)]
    if model.nw:
        dynamics.append(_matrix("E", model.E, states, _labels("w", model.nw)))
    console.print(Columns(dynamics, padding=0))
    output = [_matrix("C", model.C, outputs, states), _matrix("D", model.D, outputs, inputs)]
    console.print(Columns(output, padding=0))
    values = _eigenvalues(model.A)
    grid = _grid("eigenvalue of A", "modulus")
    for value in values:
        grid.add_row(_complex(value), f"{abs(value):.6f}")
    console.print(grid, f"spectral radius {max(abs(v) for v in values):.6f}")
    _show_rest(console, model)


def _show_rest(console: Console, model: Model) -> None:
    """Show what a model need not have: sensors, actuator, reference, uncertainty."""
    if model.sensors:
        grid = _grid("state", "trim", "sensor")
        for state, x in zip(model.states, model.trim.x, strict=True):
            grid.add_row(state, f"{x:.6g}", model.sensors[state])
        console.print(grid)
    if model.actuator is not None:
        grid = _grid("actuator", *_labels("u", model.nu))
        grid.add_row("trim", *(f"{v:.6g}" for v in model.trim.u))
        for label, name in (("low", "low"), ("high", "high"), ("rate, per s", "rate"), ("tau, s", "tau")):
            values = getattr(model.actuator, name)
            if values is not None:
                grid.add_row(label, *(f"{v:.6g}" for v in values))
        console.print(grid)
    if model.reference is not None:
        names, inputs = _labels("xr", model.nr), _labels("r", model.reference.Br.shape[1])
        Ar = _matrix("Ar", model.reference.Ar, names, names)
        Br = _matrix("Br", model.reference.Br, names, inputs)
        Cr = _matrix("Cr", model.reference.Cr, _labels("y", model.ny), names)
        console.print(Columns([Ar, Br, Cr], padding=0))
    if model.uncertainty is not None:
        F, J1, J2 = model.uncertainty.F, model.uncertainty.J1, model.uncertainty.J2
        left, right = _labels("left", F.shape[1]), _labels("right", J1.shape[0])
        console.print(
            f"uncertainty [dA dB] = F Delta [J1 J2], |Delta| <= {model.uncertainty.delta_max:g}",
            Columns(
                [
                    _matrix("F", F, model.states, left),
                    _matrix("J1", J1, right, model.states),
                    _matrix("J2", J2, right, _labels("u", model.nu)),
                ]
            ),
        )


def _show_law(console: Console, law: GainLaw) -> None:
    console.print(f"{law.name}: {_law_line(law)}")
    if isinstance(law, Schedule):
        _show_windows(console, law)
    else:
        _show_gains(console, law)
    console.print(f"certificate: {_certificate(law)}", soft_wrap=True)
    if law.conservative is not None:
        gains = law.conservative
        proof = f"certificate {_certificate(gains)}"
        console.print(f"conservative: {gains.name}, {_window(gains)}, {proof}", soft_wrap=True)


def _show_gains(console: Console, gains: Gains) -> None:
    inputs = _labels("u", gains.model.nu)
    if isinstance(gains.controller, DynamicFeedback):
        _show_dynamic(console, gains, gains.controller)
        return
    if gains.controller is not None:
        console.print("controller: Smith predictor, u = K1 x^(j + d) + K2 xr(j + d)")
    console.print(_matrix("K1", gains.K1, inputs, gains.model.states))
    if gains.K2 is not None:
        console.print(_matrix("K2", gains.K2, inputs, _labels("xr", gains.model.nr)))


def _show_dynamic(console: Console, gains: Gains, dynamic: DynamicFeedback) -> None:
    """Show a controller that has a state of its own."""
    console.print("controller: xc(k+1) = Ac xc + Bc x + Bcr yr + L (u - v), v = Cc xc + Dc x + Dcr yr")
    model = gains.model
    states, inputs, outputs = _labels("xc", dynamic.Ac.shape[0]), _labels("u", model.nu), _labels("yr", model.ny)
    columns = {"c": states, "x": model.states, "r": outputs, "L": inputs}
    for rows, names in ((states, (("Ac", "c"), ("Bc", "x"), ("Bcr", "r"), ("L", "L"))),
                        (inputs, (("Cc", "c"), ("Dc", "x"), ("Dcr", "r")))):  # fmt: skip
        matrices = [_matrix(name, getattr(dynamic, name), rows, columns[kind]) for name, kind in names]
        console.print(Columns(matrices, padding=0))


def _show_windows(console: Console, schedule: Schedule) -> None:
    """Show the sets of a schedule side by side, K1 above K2, one column for each input."""
    model = schedule.model
    rows = [*(f"K1 {state}" for state in model.states), *(f"K2 {xr}" for xr in _labels("xr", model.nr))]
    inputs = _labels("u", model.nu)
    windows = [
        _matrix(f"set {index}: delay {gains.d_min} to {gains.d_max}", _stacked(gains), rows, inputs)
        for index, gains in enumerate(schedule.sets)
    ]
    console.print(Columns(windows, padding=0))


def _stacked(gains: Gains) -> Matrix:
    """Return K1 over K2, transposed; shape (nx + nr, nu)."""
    return gains.K1.T if gains.K2 is None else np.vstack([gains.K1.T, gains.K2.T])


def _model_line(model: Model) -> str:
    parts = [f"Ts {model.Ts * 1e3:g} ms", _count(model.nx, "state"), _count(model.nu, "input")]
    parts += ["reference model"] if model.reference is not None else []
    parts += ["uncertainty"] if model.uncertainty is not None else []
    return ", ".join(parts)


def _law_line(law: GainLaw) -> str:
    sets = f", schedule of {_count(len(law.sets), 'set')}" if isinstance(law, Schedule) else ""
    return f"for {law.model.name}, {_window(law)}{sets}"


def _window(law: GainLaw) -> str:
    low, high = (d * law.model.Ts * 1e3 for d in (law.d_min, law.d_max))
    return f"delay {law.d_min} to {law.d_max} samples ({low:g} to {high:g} ms)"


def _certificate(gains: GainLaw) -> str:
    if gains.certificate is None:
        return "none"
    verification = verified(gains)
    if not verification.passed:
        return f"present, not verified: {verification.reason}"
    eta, delta = gains.certificate.get("eta"), gains.certificate.get("delta_max")
    claim = "stability" if eta is None else f"eta {eta:.6g}"
    return f"verified: {claim}, ||Delta|| <= {delta:g}, margin {verification.margin:.2g}"


def _eigenvalues(A: Matrix) -> list[complex]:
    values = [complex(v) for v in np.linalg.eigvals(A)]
    return sorted(values, key=lambda v: (-abs(v), v.real, v.imag))


def _complex(value: complex) -> str:
    return f"{value.real:.6f}" if value.imag == 0 else f"{value.real:.6f} {value.imag:+.6f}j"


def _labels(letter: str, count: int) -> list[str]:
    return [letter] if count == 1 else [f"{letter}{i + 1}" for i in range(count)]


def _count(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _console() -> Console:
    return Console(markup=False, highlight=False, emoji=False)  # names in files are shown as they are


def _grid(*columns: str) -> Grid:
    grid = Grid(box=box.SIMPLE)
    for column in columns:
        grid.add_column(column)
    return grid


def _matrix(name: str, values: Matrix, rows: Sequence[str], columns: Sequence[str]) -> Grid:
    grid = Grid(box=box.SIMPLE)
    grid.add_column(name)
    for column in columns:
        grid.add_column(column, justify="right")
    for row, numbers in zip(rows, values, strict=True):
        grid.add_row(row, *(f"{v:.7g}" for v in numbers))
    return grid


if __name__ == "__main__":
    main()
