"""What an exact proof leaves in a gain file: storages, multipliers, and what they prove; NumPy only.

The storages stand in canonical order. Keys (delay, set) are sorted by delay, then by set; a path is M + 1 keys, each of
which may follow the one before, the present one last, and paths are in lexicographic order. Transitions are ordered by
path, then by the next key, then by the prediction of the reference. Symmetric matrices are stored by the rows of their
upper triangle.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from gains.certificate import MAX_DELAY, claim_hash, law_hash, model_hash
from gains.model import GainLaw, Matrix, read_only, sets_of
from gains.table import Table

__all__ = ["MAX_MEMORY", "MAX_STORAGES", "Block", "SwitchedCertificate", "read_switched"]

MAX_MEMORY = 3
"""Past delays that a storage may know."""

MAX_STORAGES = 4096
"""Storages and blocks that a file may hold: more is not a certificate but a load."""


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """The proof of stability of one diagonal block of the loop.

    Attributes
    ----------
    states : tuple of int
        Which entries of [x; s(k−1); …; s(k−d_max)].
    kind : str
        "quadratic": F'PF ≺ P in every mode; "tree": every admissible product is a chain of products of norm ‖·‖_P
        below 1; "paths": one P for each path.
    memory : int
        M of "paths".
    P : ndarray, shape (1 or paths, n, n)
    """

    states: tuple[int, ...]
    kind: str
    memory: int
    P: Matrix

    def __post_init__(self) -> None:
        object.__setattr__(self, "P", read_only(self.P))


@dataclass(frozen=True, slots=True, eq=False)
class SwitchedCertificate:
    """A proof on the lifted form for every admissible sequence of delays, and all ‖Δ‖ ≤ delta_max.

    Attributes
    ----------
    transitions : str
        "any", or "fifo": d⁺ ≤ d + 1.
    d_min, d_max : int
        Samples.
    delta_max : float
        Bound on ‖Δ‖; 0 without uncertainty.
    eta : float or None
        ‖e‖₂ < η ‖v‖₂ (12); None where stability alone is proved.
    aheads : tuple of int or None
        Samples by which the controller may predict xr; None for Eq. (9), which takes xr at the plant.
    memory : int
        Past delays that a storage knows.
    P : ndarray, shape (paths, N, N)
        The storages; empty where contraction or blocks are the proof. Without η they are over [x; s(k−1); …], else
        over ζ, both of :mod:`gains.switched`.
    mu : ndarray, shape (transitions,)
        Multipliers of the uncertainty; empty where delta_max is 0.
    left, right : ndarray or None
        K1 = left right where the slots hold fewer numbers than K1 has rows (of a schedule: all K1, stacked).
    contraction : ndarray or None, shape (nx,)
        v > 0 with (|A| + |B K1|) v < v: stable for every bounded delay.
    blocks : tuple of Block
    """

    method: ClassVar[str] = "exact"

    transitions: str
    d_min: int
    d_max: int
    delta_max: float
    eta: float | None
    aheads: tuple[int, ...] | None = None
    memory: int = 0
    P: Matrix = field(default_factory=lambda: np.zeros((0, 0, 0)))
    mu: Matrix = field(default_factory=lambda: np.zeros(0))
    left: Matrix | None = None
    right: Matrix | None = None
    contraction: Matrix | None = None
    blocks: tuple[Block, ...] = ()

    def __post_init__(self) -> None:
        for name in ("P", "mu", "left", "right", "contraction"):
            value = getattr(self, name)
            object.__setattr__(self, name, None if value is None else read_only(value))

    def table(self, law: GainLaw, margin: float, versions: Mapping[str, str]) -> dict[str, object]:
        """Return the [certificate] table of a gain file; parameters as of :class:`gains.certificate.Certificate`'s."""
        claim: dict[str, object] = {
            "method": self.method,
            "transitions": self.transitions,
            "d_min": self.d_min,
            "d_max": self.d_max,
            "delta_max": float(self.delta_max),
            **({} if self.eta is None else {"eta": float(self.eta)}),
            "margin": float(margin),
            "memory": self.memory,
        }
        if self.aheads is not None:
            claim["aheads"] = list(self.aheads)
        for name in ("left", "right", "contraction"):
            if getattr(self, name) is not None:
                claim[name] = getattr(self, name).tolist()
        if self.P.size:
            claim["P"] = _packed(self.P)
        if self.mu.size:
            claim["mu"] = self.mu.tolist()
        if self.blocks:
            claim["block"] = [
                {"states": list(b.states), "kind": b.kind, "memory": b.memory, "P": _packed(b.P)} for b in self.blocks
            ]
        hashes = {"model": model_hash(law.model), "gains": law_hash(law), "certificate": claim_hash(claim)}
        return {**claim, "sha256": hashes, "versions": dict(versions)}


def read_switched(law: GainLaw, source: str = "certificate") -> SwitchedCertificate:
    """Return the exact certificate of a gain file.

    Raises
    ------
    InputError
        When a field is missing or malformed.
    """
    assert law.certificate is not None
    table = Table(law.certificate, source, "certificate")
    nx, rows = law.model.nx, len(sets_of(law)) * law.model.nu
    return SwitchedCertificate(
        transitions=table.string("transitions", choices=("any", "fifo")),
        d_min=table.integer("d_min", low=0, high=MAX_DELAY),
        d_max=table.integer("d_max", low=0, high=MAX_DELAY),
        delta_max=table.number("delta_max", low=0.0),
        eta=table.number("eta", None, above=0.0),
        aheads=_aheads(table),
        memory=table.integer("memory", 0, low=0, high=MAX_MEMORY),
        P=_unpacked(table, "P"),
        mu=table.vector("mu", np.zeros(0)),
        left=table.matrix("left", None, shape=(rows, None)),
        right=table.matrix("right", None, shape=(None, nx)),
        contraction=table.vector("contraction", None, length=nx),
        blocks=tuple(_block(block) for block in table.tables("block", ())),
    )


def _aheads(table: Table) -> tuple[int, ...] | None:
    values = table.vector("aheads", None)
    if values is None:
        return None
    if not len(values) or not all(value == int(value) and 0 <= value <= MAX_DELAY for value in values):
        raise table.error("aheads", "whole numbers of samples", f"{values.tolist()}")
    if len(set(values.tolist())) != len(values):
        raise table.error("aheads", "each value once", f"{values.tolist()}")
    return tuple(int(value) for value in values)


def _block(table: Table) -> Block:
    states = table.vector("states")
    if not all(value == int(value) and value >= 0 for value in states):
        raise table.error("states", "indices of states", f"{states.tolist()}")
    return Block(
        states=tuple(int(value) for value in states),
        kind=table.string("kind", choices=("quadratic", "tree", "paths")),
        memory=table.integer("memory", 0, low=0, high=MAX_MEMORY),
        P=_unpacked(table, "P"),
    )


def _packed(stack: Matrix) -> list[list[float]]:
    i, j = np.triu_indices(stack.shape[1])
    return [[float(value) for value in P[i, j]] for P in stack]


def _unpacked(table: Table, key: str) -> Matrix:
    """Return a stack of symmetric matrices from the rows of their upper triangles."""
    packed: Matrix | None = table.matrix(key, None)
    if packed is None:
        return np.zeros((0, 0, 0))
    count, size = packed.shape
    n = int((np.sqrt(8.0 * size + 1.0) - 1.0) / 2.0)
    if n * (n + 1) // 2 != size or count > MAX_STORAGES:
        expected = f"up to {MAX_STORAGES} rows of n (n + 1)/2 numbers, upper triangles"
        raise table.error(key, expected, f"{count} rows of {size}")
    i, j = np.triu_indices(n)
    stack = np.zeros((count, n, n))
    stack[:, i, j] = packed
    stack[:, j, i] = packed
    return stack
