"""Writing model files: the other direction of :func:`gains.store.load_model`.

Every number is written at full double precision, so what is read again is the same model, to the last bit.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import tomli_w

from gains.atomic import replace_file
from gains.model import Actuator, Matrix, Model, Reference
from gains.table import InputError

__all__ = ["Continuous", "model_content", "model_text", "save_model"]

_NUMBERS = re.compile(r"\[\n((?: +[-+0-9.e]+,\n)+) *\]")
"""A row of numbers, one per line; a matrix is easier to read with one row per line. No string has line ends in it."""
_NO_COMMENT = re.compile("[\x00-\x08\x0a-\x1f\x7f\ud800-\udfff]")
"""What TOML, or UTF-8, has no room for in a comment."""
_SURROGATE = re.compile("[\ud800-\udfff]")


@dataclass(frozen=True, slots=True, eq=False)
class Continuous:
    """The plant before it is held at Ts: x'(t) = Ap x + Bp u + Ep w.

    Attributes
    ----------
    Ap : ndarray, shape (nx, nx)
    Bp : ndarray, shape (nx, nu)
    Ep : ndarray, shape (nx, nw)
    """

    Ap: Matrix
    Bp: Matrix
    Ep: Matrix


def save_model(path: str | Path, model: Model, *, plant: Continuous | None = None, notes: Iterable[str] = ()) -> None:
    """Write a model file; a file of that name is replaced at once or not at all.

    Parameters
    ----------
    path : str or Path
    model : Model
        What is written.
    plant : Continuous, optional
        Written instead of the model's A, B and E, which must be its exact hold.
    notes : iterable of str
        Lines of comment at the head of the file.

    Raises
    ------
    InputError
        When the file cannot be written.
    """
    try:
        replace_file(Path(path), model_text(model, plant=plant, notes=notes).encode())
    except OSError as error:
        raise InputError(f"{path}: expected a file that can be written, found: {error.strerror}") from None


def model_text(model: Model, *, plant: Continuous | None = None, notes: Iterable[str] = ()) -> str:
    """Return the text of a model file; parameters as of :func:`save_model`.

    Raises
    ------
    InputError
        When the model's name is no text that UTF-8 has room for.
    """
    if not model.name or _SURROGATE.search(model.name):
        raise InputError(f"name: expected a name in UTF-8, found {model.name!r}")
    lines = (_NO_COMMENT.sub("\ufffd", line) for note in notes for line in note.splitlines() or [""])
    head = "".join(f"# {line}".rstrip() + "\n" for line in lines)
    text = tomli_w.dumps(model_content(model, plant))
    return head + ("\n" if head else "") + _NUMBERS.sub(lambda row: f"[{' '.join(row[1].split()).rstrip(',')}]", text)


def model_content(model: Model, plant: Continuous | None = None) -> dict[str, object]:
    """Return what a model file says, as TOML has it; parameters as of :func:`save_model`."""
    A, B, E = (model.A, model.B, model.E) if plant is None else (plant.Ap, plant.Bp, plant.Ep)
    content: dict[str, object] = {
        "name": model.name,
        "Ts": model.Ts,
        "plant": {
            "continuous": plant is not None,
            "A": A.tolist(),
            "B": B.tolist(),
            **({"E": E.tolist()} if E.shape[1] else {}),
            "C": model.C.tolist(),
            "D": model.D.tolist(),
            "states": list(model.states),
        },
        "trim": {"x": model.trim.x.tolist(), "u": model.trim.u.tolist()},
    }
    if model.actuator is not None:
        content["actuator"] = _actuator(model.actuator)
    if model.sensors:
        content["sensors"] = dict(model.sensors)
    if model.reference is not None:
        content["reference"] = _reference(model.reference)
    if (uncertainty := model.uncertainty) is not None:
        matrices = {"F": uncertainty.F.tolist(), "J1": uncertainty.J1.tolist(), "J2": uncertainty.J2.tolist()}
        content["uncertainty"] = {**matrices, "delta_max": uncertainty.delta_max}
    if (condition := model.condition) is not None:
        content["condition"] = {"airspeed_m_s": condition.airspeed_m_s, "altitude_m": condition.altitude_m}
    return content


def _actuator(actuator: Actuator) -> Mapping[str, object]:
    given = {"low": actuator.low, "high": actuator.high, "rate": actuator.rate, "tau": actuator.tau}
    return {name: value.tolist() for name, value in given.items() if value is not None}


def _reference(reference: Reference) -> Mapping[str, object]:
    return {"Ar": reference.Ar.tolist(), "Br": reference.Br.tolist(), "Cr": reference.Cr.tolist()}
