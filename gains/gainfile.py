"""What a gain file holds beside its model's name: one set of gains, or the [[window]] tables of a schedule.

:mod:`gains.store` finds the file and its model. The certificate of a schedule speaks of all switching between its
sets; either kind is refused here when its model, its gains or the certificate itself have changed since the proof.
The conservative gains that a file may name are proved by a certificate of their own, and no part of this one.
"""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from gains.certificate import claim_hash, law_hash, model_hash
from gains.model import Controller, DynamicFeedback, GainLaw, Gains, Matrix, Model, Schedule, SmithPredictor
from gains.table import InputError, Table

__all__ = ["DELAY_LIMIT", "check_conservative", "content_of", "read_gains", "read_schedule"]

DELAY_LIMIT = 1000  # samples; buffers in the loop grow with d_max


def read_gains(table: Table, name: str, model: Model) -> Gains:
    """Return the one set of gains of a file, its certificate with it."""
    d_min, d_max = _window(table)
    controller = _controller(table, model)
    if isinstance(controller, DynamicFeedback):
        K1, K2 = np.zeros((model.nu, model.nx)), None if model.reference is None else np.zeros((model.nu, model.nr))
    else:
        K1, K2 = _matrices(table, model)
    gains = Gains(name, model, d_min, d_max, K1, K2, table.mapping("certificate", None), controller=controller)
    if controller is not None and gains.certificate is not None:
        raise table.error("certificate", "none, as no proof speaks of this controller", "one")
    _check_hashes(table.source, gains, "K1 and K2")
    return gains


def read_schedule(table: Table, name: str, model: Model) -> Schedule:
    """Return the schedule of a file, its certificate with it; windows rise, and leave no delay out."""
    windows = table.tables("window")
    if not windows:
        raise table.error("window", "at least one window", "none")
    sets: list[Gains] = []
    for window in windows:
        d_min, d_max = _window(window)
        if sets:
            before = sets[-1]
            if not before.d_min < d_min <= before.d_max + 1:
                low, high = before.d_min + 1, before.d_max + 1
                raise window.error("d_min", f"a number from {low} to {high}, by the window before", str(d_min))
            if d_max <= before.d_max:
                raise window.error("d_max", f"a number above {before.d_max}, by the window before", str(d_max))
        sets.append(Gains(f"{name}[{len(sets)}]", model, d_min, d_max, *_matrices(window, model)))
    schedule = Schedule(name, model, tuple(sets), table.mapping("certificate", None))
    _check_hashes(table.source, schedule, "the windows and their K1 and K2")
    return schedule


def check_conservative(source: str, law: GainLaw) -> None:
    """Refuse conservative gains for another model than the law's, or for a window that is not wider and around its.

    Raises
    ------
    InputError
        Naming the file ``source`` of the law, what was expected and what was found.
    """
    gains = law.conservative
    if gains is None:
        return
    expected = found = ""
    if not _same_model(gains.model, law.model):
        expected = f"gains for the same model ({law.model.name}: Ts, states, trim and matrices)"
        found = f"{gains.name}, for another ({gains.model.name})"
    elif not (gains.d_min <= law.d_min and law.d_max < gains.d_max):
        expected = f"gains for delays from {law.d_min} or less to {law.d_max + 1} or more"
        found = f"{gains.name}, for {gains.d_min} to {gains.d_max}"
    if expected:
        raise InputError(f"{source}: conservative: expected {expected}, found {found}")


def content_of(law: GainLaw, model: str, conservative: str | None) -> dict[str, object]:
    """Return what a gain file says, for writing.

    Parameters
    ----------
    law : Gains or Schedule
        Every number is written at full double precision.
    model : str
        What the file calls the model.
    conservative : str or None
        What the file calls the conservative gains; None if it names none.
    """
    content: dict[str, object] = {"name": law.name, "model": model}
    content |= {} if conservative is None else {"conservative": conservative}
    if isinstance(law, Schedule):
        content["window"] = [_set_content(gains) for gains in law.sets]
    else:
        content |= _set_content(law)
    if law.certificate is not None:
        content["certificate"] = dict(law.certificate)
    return content


def _set_content(gains: Gains) -> dict[str, object]:
    K2 = {} if gains.K2 is None else {"K2": gains.K2.tolist()}
    window = {"d_min": gains.d_min, "d_max": gains.d_max}
    match gains.controller:
        case None:
            return {**window, "K1": gains.K1.tolist(), **K2}
        case SmithPredictor():
            return {**window, "controller": "smith", "K1": gains.K1.tolist(), **K2}
        case DynamicFeedback() as dynamic:
            matrices = {entry.name: getattr(dynamic, entry.name).tolist() for entry in fields(dynamic)}
            return {**window, "controller": "dynamic", "dynamic": matrices}


def _controller(table: Table, model: Model) -> Controller | None:
    """Return what flies instead of the law; None where the file says nothing of it."""
    kind = table.string("controller", "law", choices=("law", "smith", "dynamic"))
    if kind == "law":
        return None
    if kind == "smith":
        return SmithPredictor()
    dynamic = table.table("dynamic")
    nx, nu, ny = model.nx, model.nu, model.ny
    Ac = dynamic.matrix("Ac")
    nc = Ac.shape[0]
    if Ac.shape[1] != nc:
        raise dynamic.error("Ac", "a square matrix", f"{nc} by {Ac.shape[1]}")
    return DynamicFeedback(
        Ac=Ac,
        Bc=dynamic.matrix("Bc", shape=(nc, nx)),
        Bcr=dynamic.matrix("Bcr", shape=(nc, ny)),
        L=dynamic.matrix("L", np.zeros((nc, nu)), shape=(nc, nu)),
        Cc=dynamic.matrix("Cc", shape=(nu, nc)),
        Dc=dynamic.matrix("Dc", shape=(nu, nx)),
        Dcr=dynamic.matrix("Dcr", shape=(nu, ny)),
    )


def _window(table: Table) -> tuple[int, int]:
    d_min = table.integer("d_min", low=0, high=DELAY_LIMIT)
    return d_min, table.integer("d_max", low=d_min, high=DELAY_LIMIT)


def _matrices(table: Table, model: Model) -> tuple[Matrix, Matrix | None]:
    """Return K1 and K2."""
    K1 = table.matrix("K1", shape=(model.nu, model.nx))
    if model.reference is not None:
        return K1, table.matrix("K2", shape=(model.nu, model.nr))
    if "K2" in table:
        raise table.error("K2", f"none, as model {model.name} has no [reference]", "one")
    return K1, None


def _same_model(one: Model, other: Model) -> bool:
    """Tell whether a law for one model, with its proof, is one for the other; names do not count."""
    if one is other:
        return True
    at_one_trim = np.array_equal(one.trim.x, other.trim.x) and np.array_equal(one.trim.u, other.trim.u)
    return one.states == other.states and at_one_trim and model_hash(one) == model_hash(other)


def _check_hashes(source: str, law: GainLaw, gains: str) -> None:
    """Refuse a certificate that was made for another model or other gains, or that has been changed."""
    certificate = law.certificate
    if certificate is None:
        return
    hashes = Table(certificate, source, "certificate").table("sha256")
    actual_hashes = {
        "model": (f"model {law.model.name}", model_hash(law.model)),
        "gains": (gains, law_hash(law)),
        "certificate": ("the certificate", claim_hash(certificate)),
    }
    for key, (what, actual) in actual_hashes.items():
        expected = hashes.string(key)
        if expected != actual:
            raise hashes.error(
                key, f"the hash of {what}, {actual[:12]}…", f"{expected[:12]}…: made for another, or changed"
            )
