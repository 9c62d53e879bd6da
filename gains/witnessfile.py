"""Witness files: a periodic sequence of delays under which given gains diverge, as CSV.

A witness is one period d(0), ..., d(L-1) of a delay sequence, repeated without end; its lifted product has a
spectral radius above 1, which proves that the loop diverges. A file holds the period and what it was found
for::

    # lagproof witness
    # gains: pendulum-paper
    # model: pendulum
    # Ts_s: 0.03
    # d_min: 1
    # d_max: 7
    # transitions: fifo
    # growth_per_sample: 1.0017445994791603
    k,d
    0,2
    1,3

Comments are ``# key: value`` in any order; keys that are not known are passed over. A file without a growth is no
witness of anything, just a sequence to be flown, such as the one that a recorded flight has lived.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NoReturn

from gains.table import InputError, read_content

__all__ = ["MAX_PERIOD", "TRANSITIONS", "Witness", "read_witness", "sequence_of", "write_witness"]

MAX_PERIOD = 100_000
"""The longest period of a file, samples."""

TRANSITIONS = ("any", "fifo")
"""Which delay may follow which: any, or at most one sample more than the last."""

_REQUIRED = ("Ts_s", "d_min", "d_max", "transitions")
_KNOWN = (*_REQUIRED, "growth_per_sample", "gains", "model")
_COLUMNS = "k,d"
_ROW = re.compile(r"([0-9]{1,9}),([0-9]{1,9})")
_INTEGER = re.compile(r"[0-9]{1,9}")


@dataclass(frozen=True, slots=True)
class Witness:
    """One period of a delay sequence, and what it was found for.

    Attributes
    ----------
    gains, model : str
        Names of the gains and of their model; empty when the file does not say.
    Ts : float
        Sampling period, s.
    d_min, d_max : int
        The window that the delays keep to, samples.
    transitions : "any" or "fifo"
        Which delay may follow which; under "fifo" d(k+1) <= d(k) + 1, from the last of a period to the first
        of the next too.
    growth_per_sample : float or None
        rho^(1/L) of the period's lifted product: by how much the loop grows from sample to sample; None where nothing
        is claimed.
    delays : tuple of int, length L
        d(0), ..., d(L-1), samples.
    """

    gains: str
    model: str
    Ts: float
    d_min: int
    d_max: int
    transitions: str
    growth_per_sample: float | None
    delays: tuple[int, ...]


def sequence_of(delays: tuple[int, ...], Ts: float, gains: str, model: str, growth: float | None = None) -> Witness:
    """Return delays as a file holds them, one period as long as they are, in the window and order that they keep.

    Parameters
    ----------
    delays : tuple of int
        d(0), d(1), ..., samples.
    Ts : float
        Sampling period, s.
    gains, model : str
        Names of what it comes from.
    growth : float, optional
        What is claimed of it.
    """
    in_order = all(d <= before + 1 for before, d in pairwise((delays[-1], *delays)))
    return Witness(gains, model, Ts, min(delays), max(delays), "fifo" if in_order else "any", growth, delays)


def read_witness(path: str | Path) -> Witness:
    """Return the witness of a file.

    Raises
    ------
    InputError
        When the file cannot be read, or is no witness: a key missing or not a number, rows not numbered
        0..L-1, a delay outside the window, a jump that the transitions do not allow, no row or too many.
    """
    source = str(path)
    values: dict[str, str] = {}
    rows: list[str] = []
    for line in _lines(path, source):
        if line.startswith("#"):
            key, colon, value = (part.strip() for part in line[1:].partition(":"))
            if colon and key in _KNOWN:
                if key in values:
                    _refuse(source, key, "one value", "a second one")
                values[key] = value
        elif line:
            rows.append(line)
    for key in _REQUIRED:
        if key not in values:
            _refuse(source, key, f'a line "# {key}: ..."', "none")
    if not rows or rows[0] != _COLUMNS:
        _refuse(source, "columns", _COLUMNS, _shown(rows[0]) if rows else "no row")
    witness = Witness(
        gains=values.get("gains", ""),
        model=values.get("model", ""),
        Ts=_number(source, "Ts_s", values["Ts_s"]),
        d_min=_integer(source, "d_min", values["d_min"]),
        d_max=_integer(source, "d_max", values["d_max"]),
        transitions=values["transitions"],
        growth_per_sample=(
            _number(source, "growth_per_sample", values["growth_per_sample"]) if "growth_per_sample" in values else None
        ),
        delays=_delays(source, rows[1:]),
    )
    _check(witness, source)
    return witness


def write_witness(path: str | Path, witness: Witness) -> None:
    """Write a witness as a file that :func:`read_witness` reads back as the same.

    Raises
    ------
    InputError
        When it is not well formed, or the file cannot be written.
    """
    source = str(path)
    _check(witness, source)
    growth = witness.growth_per_sample
    lines = [
        "# lagproof witness",
        f"# gains: {witness.gains}",
        f"# model: {witness.model}",
        f"# Ts_s: {float(witness.Ts)!r}",
        f"# d_min: {witness.d_min}",
        f"# d_max: {witness.d_max}",
        f"# transitions: {witness.transitions}",
        *([] if growth is None else [f"# growth_per_sample: {float(growth)!r}"]),
        _COLUMNS,
        *(f"{k},{d}" for k, d in enumerate(witness.delays)),
    ]
    try:
        Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")
    except OSError as error:
        raise InputError(f"{source}: expected a file that can be written, found: {error.strerror}") from None


def _lines(path: str | Path, source: str) -> Iterable[str]:
    """Return the lines of a text file, without the space around them."""
    try:
        text = read_content(path, "a witness file").decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{source}: expected UTF-8 text, found byte {error.start} that is not") from None
    return (line.strip() for line in text.split("\n"))


def _delays(source: str, rows: list[str]) -> tuple[int, ...]:
    """Return d of the rows ``k,d``, which must be numbered from 0."""
    if len(rows) > MAX_PERIOD:
        _refuse(source, "rows", f"at most {MAX_PERIOD}", str(len(rows)))
    delays = []
    for k, row in enumerate(rows):
        match = _ROW.fullmatch(row)
        if match is None or int(match[1]) != k:
            _refuse(source, f"row {k}", f"{k} and its delay, such as {k},1", _shown(row))
        delays.append(int(match[2]))
    return tuple(delays)


def _number(source: str, key: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        _refuse(source, key, "a number", _shown(text))


def _integer(source: str, key: str, text: str) -> int:
    if not _INTEGER.fullmatch(text):
        _refuse(source, key, "a number of samples", _shown(text))
    return int(text)


def _check(witness: Witness, source: str) -> None:
    """Refuse a witness that is not one."""
    for key, value in (("Ts_s", witness.Ts), ("growth_per_sample", witness.growth_per_sample)):
        if value is not None and not (math.isfinite(value) and value > 0.0):
            _refuse(source, key, "a finite number above 0", repr(value))
    for key, name in (("gains", witness.gains), ("model", witness.model)):
        if not name.isprintable() or name != name.strip():
            _refuse(source, key, "a name on one line", repr(name))
    if witness.transitions not in TRANSITIONS:
        _refuse(source, "transitions", " or ".join(TRANSITIONS), _shown(witness.transitions))
    _check_delays(witness, source)


def _check_delays(witness: Witness, source: str) -> None:
    """Refuse delays outside the window, and those that the transitions do not allow."""
    if not 0 <= witness.d_min <= witness.d_max:
        _refuse(source, "d_max", f"at least d_min = {max(0, witness.d_min)}", str(witness.d_max))
    if not 1 <= len(witness.delays) <= MAX_PERIOD:
        _refuse(source, "rows", f"1 to {MAX_PERIOD}", str(len(witness.delays)))
    for k, d in enumerate(witness.delays):
        if not witness.d_min <= d <= witness.d_max:
            _refuse(source, f"row {k}", f"a delay from {witness.d_min} to {witness.d_max}", str(d))
    if witness.transitions == "fifo":
        _check_fifo(witness.delays, source)


def _check_fifo(delays: tuple[int, ...], source: str) -> None:
    """Refuse a jump up by more than one sample, also from the end of a period to the next."""
    for k, (last, d) in enumerate(pairwise((delays[-1], *delays))):
        if d > last + 1:
            _refuse(source, f"row {k}", f"at most {last + 1} after {last}, as transitions are fifo", str(d))


def _shown(text: str) -> str:
    """Return a part of the file as a complaint shows it: short, and quoted."""
    return f'"{text[:40]}…"' if len(text) > 40 else f'"{text}"'


def _refuse(source: str, field: str, expected: str, found: str) -> NoReturn:
    raise InputError(f"{source}: {field}: expected {expected}, found {found}")
