"""Models and gains for other tools: python-control's StateSpace, NumPy's .npz, MATLAB's .mat; and back.

A file is a flat set of arrays of doubles, and names as text: docs/interop.md lists them. What is read goes through the
readers of TOML files, so it is refused in the same words; other variables of a workspace are passed over. Nothing is
ever unpickled, and sizes are looked at before anything is unpacked. Certificates do not travel: they are bound to
their file by hashes, and ``gains certify`` makes one again.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from gains.atomic import replace_file
from gains.gainfile import read_gains
from gains.model import Gains, Matrix, Model, Trim, zero_order_hold
from gains.modelfile import model_content
from gains.store import parse_model, require_law
from gains.table import InputError, Table

if TYPE_CHECKING:
    import control

__all__ = ["closed_loop", "export_file", "from_state_space", "import_file", "to_state_space"]

MAX_BYTES = 16 << 20
"""Of a file, and of what it unpacks to."""
_MODEL = {
    "name": ("name",),
    "Ts": ("Ts",),
    **{key: ("plant", key) for key in ("A", "B", "E", "C", "D", "states")},
    "trim_x": ("trim", "x"),
    "trim_u": ("trim", "u"),
    **{key: ("actuator", key) for key in ("low", "high", "rate", "tau")},
    **{key: ("reference", key) for key in ("Ar", "Br", "Cr")},
    **{key: ("uncertainty", key) for key in ("F", "J1", "J2", "delta_max")},
    **{key: ("condition", key) for key in ("airspeed_m_s", "altitude_m")},
}
"""Variable, and where a model file has it."""
_TEXTS = ("name", "gains_name", "states", "sensors")
_SCALARS = ("Ts", "delta_max", "airspeed_m_s", "altitude_m", "d_min", "d_max")
_VECTORS = ("trim_x", "trim_u", "low", "high", "rate", "tau")
_GAINS = ("d_min", "d_max", "K1", "K2")

Variables = dict[str, Any]


def export_file(item: Model | Gains, path: str | Path) -> None:
    """Write a model, or gains with their model, as .npz or .mat, whichever the name says.

    Raises
    ------
    InputError
        When the name says neither, the gains fly another controller than the law, or the file cannot be written.
    """
    path, out = Path(path), io.BytesIO()
    variables = _variables(item)
    if path.suffix == ".npz":
        np.savez_compressed(out, **variables)
    elif path.suffix == ".mat":
        from scipy.io import savemat  # costs 0.2 s

        savemat(cast(Any, out), variables, format="5", do_compression=True, oned_as="column")
    else:
        raise InputError(f"{path}: expected a name that ends in .npz or .mat")
    try:
        replace_file(path, out.getvalue())
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None


def import_file(path: str | Path) -> Model | Gains:
    """Return the model, or the gains with their model, of a .npz or .mat file.

    Raises
    ------
    InputError
        When it is none, is too large, or does not hold what a model needs.
    """
    path = Path(path)
    source = str(path)
    found = _read_npz(path) if path.suffix == ".npz" else _read_mat(path)
    content: dict[str, Any] = {"plant": {"continuous": False}}
    for variable, keys in _MODEL.items():
        if variable in found:
            place = content
            for key in keys[:-1]:
                place = place.setdefault(key, {})
            place[keys[-1]] = _value(variable, found[variable], source)
    if "sensors" in found and "states" in found:
        names = [_value(key, found[key], source) for key in ("states", "sensors")]
        content["sensors"] = dict(zip(*names, strict=False))
    model = parse_model(Table(content, source))
    if "K1" not in found:
        return model
    gains = {key: _value(key, found[key], source) for key in _GAINS if key in found}
    name = _value("gains_name", found["gains_name"], source) if "gains_name" in found else path.stem
    table = Table(gains, source)
    law = read_gains(table, name, model)
    table.finish()
    return law


def to_state_space(model: Model) -> control.StateSpace:
    """Return x(k+1) = A x + [B E] [u; w], y = C x + [D 0] [u; w] for python-control, discrete with dt = Ts.

    Deviations from trim; inputs are u0 … and w0 …, outputs y0 …, states have the model's names.

    Raises
    ------
    InputError
        When python-control is not installed.
    """
    inputs = [f"u{i}" for i in range(model.nu)] + [f"w{i}" for i in range(model.nw)]
    outputs = [f"y{i}" for i in range(model.ny)]
    D = np.hstack([model.D, np.zeros((model.ny, model.nw))])
    B = np.hstack([model.B, model.E])
    return _control().ss(
        model.A, B, model.C, D, model.Ts, inputs=inputs, outputs=outputs, states=list(model.states), name=model.name
    )


def from_state_space(
    system: control.StateSpace, *, inputs: int | None = None, Ts: float | None = None, name: str | None = None
) -> Model:
    """Return the model of a system of python-control, at trim zero.

    Parameters
    ----------
    system : control.StateSpace
        Discrete, or continuous with ``Ts`` given: then it is held exactly.
    inputs : int, optional
        How many of the inputs are u; the others are disturbances, which reach no output at once. All by default.
    Ts : float, optional
        Sampling period, s, of a continuous system.
    name : str, optional

    Raises
    ------
    InputError
        When the system is neither, or the disturbances have feedthrough.
    """
    called = name or str(system.name)
    A, B, C, D = (np.asarray(getattr(system, key), dtype=np.float64) for key in "ABCD")
    split = B.shape[1] if inputs is None else inputs
    if not 1 <= split <= B.shape[1]:
        raise InputError(f"{called}: inputs: expected 1 to {B.shape[1]}, found {split}")
    if D[:, split:].any():
        raise InputError(f"{called}: D: expected disturbances without feedthrough, found some with")
    if system.isdtime(strict=True) and system.dt is not True:
        period = float(system.dt)
    elif system.isctime(strict=True) and Ts is not None:
        period = Ts
        A, B = zero_order_hold(A, B, Ts)
    else:
        raise InputError(f"{called}: expected a discrete system with its dt, or a continuous one and Ts")
    trim = Trim(np.zeros(A.shape[0]), np.zeros(split))
    states = tuple(str(label) for label in system.state_labels)
    return Model(called, period, A, B[:, :split], B[:, split:], C, D[:, :split], states, trim)


def closed_loop(gains: Gains, d: int) -> control.StateSpace:
    """Return the loop of Eqs. (10) and (11) at a constant delay, from v = [w; r] to e, for python-control.

    Parameters
    ----------
    gains : Gains
        With a reference model or without; then there is no r.
    d : int
        Samples, at least 0. The state is [x(k); …; x(k - d); xr(k)].

    Raises
    ------
    InputError
        When python-control is not installed, or the gains fly another controller than the law.
    """
    model, reference = require_law(gains).model, gains.model.reference
    nx, nr, past = model.nx, model.nr, model.nx * d
    n = nx + past + nr
    A, C = np.zeros((n, n)), np.zeros((model.ny, n))
    A[:nx, :nx] = model.A
    A[:nx, past : past + nx] += model.B @ gains.K1
    A[nx : nx + past, :past] = np.eye(past)
    C[:, :nx] = model.C
    C[:, past : past + nx] += model.D @ gains.K1
    B = np.zeros((n, model.nw + (0 if reference is None else reference.Br.shape[1])))
    B[:nx, : model.nw] = model.E
    if reference is not None and gains.K2 is not None:
        A[:nx, n - nr :], A[n - nr :, n - nr :] = model.B @ gains.K2, reference.Ar
        B[n - nr :, model.nw :] = reference.Br
        C[:, n - nr :] = model.D @ gains.K2 - reference.Cr
    return _control().ss(A, B, C, np.zeros((model.ny, B.shape[1])), model.Ts, name=f"{gains.name} d={d}")


def _control() -> Any:
    try:
        import control
    except ImportError:
        raise InputError("control: expected it to be installed: pip install 'lagproof[control]'") from None
    return control


def _variables(item: Model | Gains) -> Variables:
    """Return what a file holds: arrays of doubles, and texts."""
    model = item if isinstance(item, Model) else require_law(item).model
    content: Mapping[str, Any] = model_content(model)
    variables: Variables = {}
    for variable, keys in _MODEL.items():
        value: Any = content
        for key in keys:
            value = value.get(key) if isinstance(value, Mapping) else None
        if value is not None:
            variables[variable] = np.array(value) if variable in _TEXTS else np.array(value, dtype=np.float64)
    if model.sensors:
        variables["sensors"] = np.array([model.sensors[state] for state in model.states])
    if isinstance(item, Gains):
        variables |= {"gains_name": np.array(item.name), "d_min": np.array(float(item.d_min))}
        variables |= {"d_max": np.array(float(item.d_max)), "K1": np.array(item.K1)}
        variables |= {} if item.K2 is None else {"K2": np.array(item.K2)}
    return variables


def _value(variable: str, found: NDArray[Any], source: str) -> Any:
    """Return a variable as a TOML file would have it."""
    if variable in _TEXTS:
        texts = [str(text).rstrip() for text in _flat(found)]
        if variable in ("states", "sensors"):
            return texts
        return texts[0] if len(texts) == 1 else texts
    if np.iscomplexobj(found):
        raise InputError(f"{source}: {variable}: expected real numbers, found complex ones")
    try:
        numbers: Matrix = np.asarray(found, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{source}: {variable}: expected an array of numbers, found {found.dtype}") from None
    if variable in _SCALARS:
        if numbers.size != 1:
            raise InputError(f"{source}: {variable}: expected a number, found {numbers.size}")
        value = float(numbers.reshape(()))
        return int(value) if variable in ("d_min", "d_max") and value.is_integer() else value
    return numbers.ravel().tolist() if variable in _VECTORS else np.atleast_2d(numbers).tolist()


def _flat(found: NDArray[Any]) -> list[Any]:
    """Return the texts of an array, of MATLAB's cell arrays too."""
    values = np.atleast_1d(found).ravel().tolist()
    return [value.ravel()[0] if isinstance(value, np.ndarray) and value.size == 1 else value for value in values]


def _content(path: Path) -> bytes:
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"{path}: expected at most {MAX_BYTES >> 20} MiB, found {path.stat().st_size >> 20}")
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None


def _read_npz(path: Path) -> Mapping[str, NDArray[Any]]:
    content = io.BytesIO(_content(path))
    try:
        with zipfile.ZipFile(content) as archive:
            unpacked = sum(entry.file_size for entry in archive.infolist())
        if unpacked > MAX_BYTES:
            raise InputError(f"{path}: expected at most {MAX_BYTES >> 20} MiB unpacked, found {unpacked >> 20}")
        with np.load(content, allow_pickle=False) as arrays:
            known = {*_MODEL, *_GAINS, *_TEXTS}
            return {name: arrays[name] for name in arrays.files if name in known}
    except InputError:
        raise
    except Exception as error:  # whatever a damaged archive makes its readers raise
        raise InputError(f"{path}: expected a NumPy .npz file, found none: {error}") from None


def _read_mat(path: Path) -> Mapping[str, NDArray[Any]]:
    from scipy.io import loadmat, whosmat  # costs 0.2 s

    content = io.BytesIO(_content(path))
    try:
        known = {*_MODEL, *_GAINS, *_TEXTS}
        headers = [(name, shape) for name, shape, _ in whosmat(cast(Any, content)) if name in known]
        unpacked = sum(8 * int(np.prod(shape, dtype=np.float64)) for _, shape in headers)
        if unpacked > MAX_BYTES:
            raise InputError(f"{path}: expected at most {MAX_BYTES >> 20} MiB unpacked, found {unpacked >> 20}")
        content.seek(0)
        found = loadmat(cast(Any, content), variable_names=[name for name, _ in headers])
        return {name: np.asarray(found[name]) for name, _ in headers}
    except InputError:
        raise
    except NotImplementedError:
        raise InputError(f"{path}: expected a MATLAB file of version 7 or older (save -v7), found 7.3") from None
    except Exception as error:  # whatever a damaged file makes its reader raise
        raise InputError(f"{path}: expected a .npz or .mat file, found none: {error}") from None
