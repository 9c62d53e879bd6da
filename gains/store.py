"""Model and gain files: find by name or path, read, check every field and shape.

A name that :func:`stored` lists stands for the file that comes with the program; anything else is a path.
Names and paths inside a file are the same; its paths start at its own folder.
The quantities of [reference] and [uncertainty] are discrete at Ts, also where the plant is continuous.
"""

from __future__ import annotations

import difflib
import os
import re
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Literal, NamedTuple, TypeVar

import numpy as np
import tomli_w

from gains.atomic import replace_file
from gains.gainfile import DELAY_LIMIT, check_conservative, content_of, read_gains, read_schedule
from gains.model import (
    Actuator,
    Condition,
    GainLaw,
    Gains,
    Matrix,
    Model,
    Reference,
    Trim,
    Uncertainty,
    spectral_radius,
    zero_order_hold,
)
from gains.table import InputError, Table, describe

__all__ = [
    "DELAY_LIMIT",
    "Stored",
    "load",
    "load_gains",
    "load_law",
    "load_model",
    "model_path",
    "parse_gains",
    "parse_law",
    "parse_model",
    "require_law",
    "resolve",
    "save_gains",
    "stored",
]

TS_MIN_S, TS_MAX_S = 1e-6, 3600.0
_SENSOR = re.compile(r"[A-Z][A-Z0-9_]*\.[A-Za-z][A-Za-z0-9_]*")

Kind = Literal["model", "gains"]
AnyLaw = TypeVar("AnyLaw", bound=GainLaw)


class Stored(NamedTuple):
    """A file that comes with the program."""

    name: str
    kind: Kind
    path: Path


def stored() -> list[Stored]:
    """Return the stored models and gains, models first, each sorted by name."""
    entries = [Stored(name, _kind(Table.load(path)), path) for name, path in _stored_paths().items()]
    return sorted(entries, key=lambda entry: (entry.kind != "model", entry.name))


def resolve(name_or_path: str | Path, folder: Path | None = None) -> Path:
    """Return the file that a stored name or a path stands for; relative paths start at ``folder``.

    Raises
    ------
    InputError
        When it is neither, naming the nearest stored name.
    """
    paths = _stored_paths()
    name = str(name_or_path)
    if name in paths:
        return paths[name]
    path = Path(name_or_path) if folder is None else folder / name_or_path
    try:
        found = path.exists()
    except (OSError, ValueError):
        found = True  # opening it will tell what is wrong
    if not found:
        near = difflib.get_close_matches(name, paths, 1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise InputError(f"{name}: expected a stored name or a file, found neither{hint}")
    return path


def load_model(name_or_path: str | Path) -> Model:
    """Return the model of a file, discrete at its Ts.

    Raises
    ------
    InputError
        Naming the file, the field, what was expected and what was found.
    """
    return parse_model(Table.load(resolve(name_or_path)))


def load_gains(name_or_path: str | Path) -> Gains:
    """Return the one set of gains of a file together with the model and the conservative gains it names.

    Raises
    ------
    InputError
        Naming the file, the field, what was expected and what was found; for a schedule too.
    """
    return parse_gains(Table.load(resolve(name_or_path)))


def load_law(name_or_path: str | Path) -> GainLaw:
    """Return the gains or the schedule of a file together with the model and the conservative gains it names.

    Raises
    ------
    InputError
        Naming the file, the field, what was expected and what was found.
    """
    return parse_law(Table.load(resolve(name_or_path)))


def load(name_or_path: str | Path) -> Model | GainLaw:
    """Return the model, the gains or the schedule of a file, whichever it holds."""
    table = Table.load(resolve(name_or_path))
    return parse_model(table) if _kind(table) == "model" else parse_law(table)


def parse_model(table: Table) -> Model:
    """Return the model that the table of a whole file describes."""
    if _kind(table) != "model":
        raise InputError(f"{table.source}: expected a model file ([plant]), found a gain file")
    name = table.string("name")
    Ts = table.number("Ts", low=TS_MIN_S, high=TS_MAX_S)
    plant = table.table("plant")
    A, B, E, C, D = _plant(plant, Ts)
    nx, nu = B.shape
    states = plant.strings("states", length=nx)
    if len(set(states)) != nx:
        raise plant.error("states", "distinct names", f"{max(states, key=states.count)} twice")
    actuator = _actuator(table.table("actuator", None), nu)
    model = Model(
        name=name,
        Ts=Ts,
        A=A,
        B=B,
        E=E,
        C=C,
        D=D,
        states=states,
        trim=_trim(table.table("trim", None), nx, nu, actuator, table.source),
        actuator=actuator,
        sensors=_sensors(table.table("sensors", None), states),
        reference=_reference(table.table("reference", None), C.shape[0]),
        uncertainty=_uncertainty(table.table("uncertainty", None), nx, nu),
        condition=_condition(table.table("condition", None)),
    )
    table.finish()
    return model


def parse_gains(table: Table) -> Gains:
    """Return the one set of gains that the table of a whole file describes, with its model."""
    if _kind(table) == "gains" and "window" in table:
        raise table.error("window", "one set of gains (d_min, d_max, K1)", "a schedule")
    law = parse_law(table)
    assert isinstance(law, Gains)
    return law


def parse_law(table: Table) -> GainLaw:
    """Return the gains or the schedule that the table of a whole file describes, with what else it names."""
    law = _parse_alone(table)
    named = table.string("conservative", None)
    table.finish()
    if named is None:
        return law
    file = _named_path(table, "conservative")
    gains = _parse_conservative(table, file)
    check_conservative(table.source, replace(law, conservative=gains))
    # one object for both models, which agree in all that either law and its proof speak of
    return replace(law, conservative=replace(gains, model=law.model), conservative_file=file)


def require_law(law: AnyLaw) -> AnyLaw:
    """Return gains that fly the law of Eq. (9), of which proofs speak.

    Raises
    ------
    InputError
        When another controller flies in its place.
    """
    if isinstance(law, Gains) and law.controller is not None:
        kind = type(law.controller).__name__
        raise InputError(
            f"{law.name}: expected gains of the law u = K1 x + K2 xr, found a {kind}: no proof speaks of it"
        )
    return law


def model_path(gains_name_or_path: str | Path) -> Path:
    """Return the file of the model that a gain file names.

    Raises
    ------
    InputError
        When there is no such file, or it names none.
    """
    return _named_path(Table.load(resolve(gains_name_or_path)), "model")


def save_gains(path: str | Path, gains: GainLaw, model: str | Path) -> None:
    """Write a gain file, with its certificate if it has one; a file of that name is replaced at once or not at all.

    Parameters
    ----------
    path : str or Path
    gains : Gains or Schedule
        Every number is written at full double precision.
    model : str or Path
        The stored name or the file of the model; the file names it, as the conservative gains, relative to itself.

    Raises
    ------
    InputError
        When the conservative gains do not fit, or the file would replace theirs; nothing is written.
    """
    path, conservative = Path(path), None
    if gains.conservative is not None:
        assert gains.conservative_file is not None
        check_conservative(str(path), gains)
        _require_other(str(path), gains.conservative_file)
        conservative = _name_for(gains.conservative_file, path)
    content = content_of(gains, _name_for(resolve(model), path), conservative)
    replace_file(path, tomli_w.dumps(content).encode())


def _parse_alone(table: Table) -> GainLaw:
    """Return the gains or the schedule of a file with the model, without the conservative gains that it may name."""
    if _kind(table) != "gains":
        raise InputError(f"{table.source}: expected a gain file (model, K1), found a model file")
    name = table.string("name")
    model = parse_model(Table.load(_named_path(table, "model")))
    return (read_schedule if "window" in table else read_gains)(table, name, model)


def _parse_conservative(table: Table, file: Path) -> Gains:
    """Return the gains of the file that a table names as conservative: one set, and the end of the chain."""
    named = Table.load(file)
    _require_other(table.source, file)
    name, one_set = table.string("conservative"), "one set of gains (d_min, d_max, K1)"
    if _kind(named) != "gains":
        raise table.error("conservative", one_set, f"{name}, a model")
    if "window" in named:
        raise table.error("conservative", one_set, f"{name}, a schedule")
    if "conservative" in named:
        raise table.error("conservative", "gains without conservative ones of their own", f"{name}, which has some")
    gains = _parse_alone(named)
    named.finish()
    assert isinstance(gains, Gains)
    if gains.controller is not None:
        raise table.error("conservative", "gains of the law u = K1 x + K2 xr", f"{name}, another controller")
    return gains


def _require_other(source: str, file: Path) -> None:
    """Refuse gains that are their own conservative ones."""
    if file.resolve() == Path(source).resolve():
        raise InputError(f"{source}: conservative: expected another file, found this one")


def _named_path(table: Table, key: str) -> Path:
    """Return the file that a key of a gain file names, by a stored name or a path relative to the file."""
    try:
        return resolve(table.string(key), table.folder)
    except InputError as error:
        prefix = f"{table.source}: "
        raise InputError(str(error) if str(error).startswith(prefix) else f"{prefix}{key}: {error}") from None


def _name_for(file: Path, path: Path) -> str:
    """Return what a file at ``path`` shall call another: its stored name, or its path relative to that file."""
    stored_names = {stored_file: name for name, stored_file in _stored_paths().items()}
    return stored_names.get(file) or os.path.relpath(file.resolve(), path.resolve().parent)


def _stored_paths() -> dict[str, Path]:
    folder = Path(str(resources.files("gains") / "stored"))
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def _kind(table: Table) -> Kind:
    """Tell a model from gains by the keys that only one of them has; what has none is read as a model."""
    is_gains = "plant" not in table and any(key in table for key in ("model", "K1", "window"))
    return "gains" if is_gains else "model"


def _plant(plant: Table, Ts: float) -> tuple[Matrix, Matrix, Matrix, Matrix, Matrix]:
    """Return A, B, E, C, D at Ts."""
    continuous = plant.boolean("continuous")
    A = plant.matrix("A")
    nx = A.shape[0]
    if A.shape[1] != nx:
        raise plant.error("A", "a square matrix", f"{nx} by {A.shape[1]}")
    B = plant.matrix("B", shape=(nx, None))
    E = plant.matrix("E", np.zeros((nx, 0)), shape=(nx, None))
    C = plant.matrix("C", np.eye(nx), shape=(None, nx))
    D = plant.matrix("D", np.zeros((C.shape[0], B.shape[1])), shape=(C.shape[0], B.shape[1]))
    if continuous:
        with np.errstate(all="ignore"):
            A, held = zero_order_hold(A, np.hstack([B, E]), Ts)
        if not (np.isfinite(A).all() and np.isfinite(held).all()):
            raise plant.error("A", f"a finite zero-order hold at Ts = {Ts:g} s", "an overflow")
        B, E = held[:, : B.shape[1]], held[:, B.shape[1] :]
    return A, B, E, C, D


def _actuator(table: Table | None, nu: int) -> Actuator | None:
    if table is None:
        return None
    low = high = None
    if "low" in table or "high" in table:
        low = table.vector("low", length=nu)
        high = table.vector("high", length=nu)
        for i in range(nu):
            if low[i] >= high[i]:
                raise table.error("high", f"a number above low ({low[i]:g})", f"{high[i]:g}", at=f"[{i}]")
    rate = table.vector("rate", None, length=nu, above=0.0)
    tau = table.vector("tau", None, length=nu, low=0.0)
    return Actuator(low, high, rate, tau)


def _trim(table: Table | None, nx: int, nu: int, actuator: Actuator | None, source: str) -> Trim:
    x, u = np.zeros(nx), np.zeros(nu)
    if table is not None:
        x, u = table.vector("x", x, length=nx), table.vector("u", u, length=nu)
    if actuator is not None and actuator.low is not None and actuator.high is not None:
        for i in range(nu):
            low, high = actuator.low[i], actuator.high[i]
            if not low <= u[i] <= high:
                expected = f"a number in the travel of [actuator], {low:g} to {high:g}"
                raise InputError(f"{source}: trim.u[{i}]: expected {expected}, found {u[i]:g}")
    return Trim(x, u)


def _sensors(table: Table | None, states: tuple[str, ...]) -> dict[str, str]:
    if table is None:
        return {}
    for name in table:
        if name not in states:
            near = difflib.get_close_matches(name, states, 1)
            hint = f"; did you mean {near[0]}?" if near else ""
            raise table.error(name, f"a state ({', '.join(states)})", f"an unknown name{hint}")
    expected = "MESSAGE.field, such as ATTITUDE.pitch"
    sensors: dict[str, str] = {}
    for state in states:
        if state not in table:
            raise table.error(state, expected, "nothing")
        sensors[state] = table.string(state)
        if not _SENSOR.fullmatch(sensors[state]):
            raise table.error(state, expected, describe(sensors[state]))
    return sensors


def _reference(table: Table | None, ny: int) -> Reference | None:
    if table is None:
        return None
    Ar = table.matrix("Ar")
    nr = Ar.shape[0]
    if Ar.shape[1] != nr:
        raise table.error("Ar", "a square matrix", f"{nr} by {Ar.shape[1]}")
    radius = spectral_radius(Ar)
    if not radius < 1.0:
        raise table.error("Ar", "a Schur matrix (spectral radius below 1)", f"spectral radius {radius:.9g}")
    return Reference(Ar, table.matrix("Br", shape=(nr, None)), table.matrix("Cr", shape=(ny, nr)))


def _uncertainty(table: Table | None, nx: int, nu: int) -> Uncertainty | None:
    if table is None:
        return None
    F = table.matrix("F", shape=(nx, None))
    J1 = table.matrix("J1", shape=(None, nx))
    J2 = table.matrix("J2", shape=(J1.shape[0], nu))
    return Uncertainty(F, J1, J2, table.number("delta_max", low=0.0))


def _condition(table: Table | None) -> Condition | None:
    if table is None:
        return None
    return Condition(table.number("airspeed_m_s", above=0.0), table.number("altitude_m"))
