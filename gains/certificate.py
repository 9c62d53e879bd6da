"""What a proof leaves behind: the matrices, what they prove, and of which model and gains; NumPy only.

The hashes name the model and the gains that a certificate was made for. A matrix enters as its shape and its
entries, rounded to 1e-10 of the power of two above the largest (the hold of a continuous plant differs in its
last bits between machines); gains, as they stand in the file, enter exactly. The hash refuses a changed file
by name; :mod:`gains.verify` is what makes a proof.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gains.model import GainLaw, Matrix, Model, Schedule, read_only
from gains.table import Table

__all__ = [
    "MAX_DELAY",
    "METHODS",
    "Certificate",
    "claim_hash",
    "gains_hash",
    "law_hash",
    "model_hash",
    "read_certificate",
]

METHODS = ("lyapunov", "printed")  # proofs by P, Q, R; other methods leave other matrices
_QUANTUM = 1e-10

MAX_DELAY = 1_000_000
"""Samples; a window beyond it is no window."""


@dataclass(frozen=True, slots=True, eq=False)
class Certificate:
    """P, Q, R, μ with which Lemma 1 holds for all delays in [d_min, d_max] and all ‖Δ‖ ≤ delta_max.

    Attributes
    ----------
    method : str
        How the matrices were found: "lyapunov" (Lemma 1) or "printed" (Lemma 2, Theorem 1 as printed).
    transitions : str
        "any": delays may jump within the window.
    d_min, d_max : int
        Samples.
    delta_max : float
        Bound on ‖Δ‖; 0 without uncertainty.
    eta : float or None
        ‖e‖₂ < η ‖v‖₂ (12); None where stability alone is proved.
    P, Q, R : ndarray, shape (n, n)
        In the units of the model.
    mu : float
        Multiplier of the uncertainty; 0 where delta_max is 0.
    """

    method: str
    transitions: str
    d_min: int
    d_max: int
    delta_max: float
    eta: float | None
    P: Matrix
    Q: Matrix
    R: Matrix
    mu: float = 0.0

    def __post_init__(self) -> None:
        for name in ("P", "Q", "R"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def table(self, gains: GainLaw, margin: float, versions: Mapping[str, str]) -> dict[str, object]:
        """Return the [certificate] table of a gain file; every float at full double precision.

        Parameters
        ----------
        gains : Gains or Schedule
            What it certifies.
        margin : float
            As verification found it; for the reader.
        versions : Mapping[str, str]
            What computed it.
        """
        eta = {} if self.eta is None else {"eta": float(self.eta)}
        claim: dict[str, object] = {
            "method": self.method,
            "transitions": self.transitions,
            "d_min": self.d_min,
            "d_max": self.d_max,
            "delta_max": float(self.delta_max),
            **eta,
            "margin": float(margin),
            "mu": float(self.mu),
            **{name: getattr(self, name).tolist() for name in ("P", "Q", "R")},
        }
        hashes = {
            "model": model_hash(gains.model),
            "gains": law_hash(gains),
            "certificate": claim_hash(claim),
        }
        return {**claim, "sha256": hashes, "versions": dict(versions)}


def read_certificate(gains: GainLaw, source: str = "certificate") -> Certificate | None:
    """Return the certificate of a gain file; None if it has none or one of a method unknown here.

    Raises
    ------
    InputError
        When a field is missing or malformed.
    """
    if gains.certificate is None or gains.certificate.get("method") not in METHODS:
        return None
    table = Table(gains.certificate, source, "certificate")
    n = gains.model.nx + gains.model.nr
    return Certificate(
        method=table.string("method"),
        transitions=table.string("transitions", choices=("any", "fifo")),
        d_min=table.integer("d_min", low=0, high=MAX_DELAY),
        d_max=table.integer("d_max", low=1, high=MAX_DELAY),
        delta_max=table.number("delta_max", low=0.0),
        eta=table.number("eta", None, above=0.0),
        mu=table.number("mu", 0.0, low=0.0),
        P=table.matrix("P", shape=(n, n)),
        Q=table.matrix("Q", shape=(n, n)),
        R=table.matrix("R", shape=(n, n)),
    )


def model_hash(model: Model) -> str:
    """Return the SHA-256 of what a proof takes from a model, in hexadecimal.

    Ts, then A, B, E, C, D, then Ar, Br, Cr and F, J1, J2 where there are any. Bounds on Δ belong to the
    certificate.
    """
    digest = hashlib.sha256()
    _add(digest, "Ts", np.array([[model.Ts]]))
    for item in (model, model.reference, model.uncertainty):
        names = ("A", "B", "E", "C", "D") if item is model else ("Ar", "Br", "Cr", "F", "J1", "J2")
        for name in names:
            if item is not None and hasattr(item, name):
                _add(digest, name, getattr(item, name))
    return digest.hexdigest()


def gains_hash(K1: Matrix, K2: Matrix | None) -> str:
    """Return the SHA-256 of K1 and K2, their exact values, in hexadecimal."""
    digest = hashlib.sha256()
    for name, K in (("K1", K1), ("K2", K2)):
        if K is not None:
            digest.update(f"{name} {K.shape} {(K + 0.0).tolist()}\n".encode())  # + 0.0: no negative zeros
    return digest.hexdigest()


def law_hash(law: GainLaw) -> str:
    """Return the SHA-256 of a set of gains, or of a schedule's windows and gains in their order, in hexadecimal."""
    if not isinstance(law, Schedule):
        return gains_hash(law.K1, law.K2)
    windows = (f"{gains.d_min} {gains.d_max} {gains_hash(gains.K1, gains.K2)}\n" for gains in law.sets)
    return hashlib.sha256("".join(windows).encode()).hexdigest()


def claim_hash(certificate: Mapping[str, object]) -> str:
    """Return the SHA-256 of what a [certificate] table claims and proves it with: all but hashes and versions."""
    claim = {key: value for key, value in certificate.items() if key not in ("sha256", "versions")}
    return hashlib.sha256(json.dumps(claim, sort_keys=True, default=str).encode()).hexdigest()


def _add(digest: hashlib._Hash, name: str, matrix: Matrix) -> None:
    largest = float(np.max(np.abs(matrix), initial=0.0))
    exponent = math.frexp(largest)[1]
    rounded = np.rint(np.ldexp(matrix, -exponent) / _QUANTUM).astype(np.int64)
    digest.update(f"{name} {matrix.shape} {exponent} {rounded.tolist()}\n".encode())
