"""Exact certificates re-checked from their stored matrices, by eigenvalues in double precision; NumPy only.

Nothing here comes from the modules that made the certificate: the lifted loop and its transitions are put together
again, by their own code, from the model and the gains, with a bound on the rounding of each entry. Then every
transition's inequality is checked as :mod:`gains.verify` checks Lemma 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gains.certificate import MAX_DELAY
from gains.definite import EPS, LEAST, MOST, UNDERFLOW, Verification, definite, failed
from gains.model import GainLaw, Gains, Matrix, sets_of
from gains.switched_certificate import MAX_MEMORY, MAX_STORAGES, SwitchedCertificate
from gains.verify_stability import check_blocks, check_contraction

__all__ = ["check_switched", "least_eta_of"]

_ENTRIES = 1 << 24  # of all modes' maps together: what is larger is not a certificate but a load
_AHEAD = 10_000  # samples: beyond it a prediction is none
_OPERATIONS = 1 << 31  # of the eigenvalues of all transitions: some ten seconds
_ULPS = Fraction(8, 2**52)  # relative, of every entry of K1
_SPARE = 16  # operations beyond those that are counted


class _Key(NamedTuple):
    d: int
    which: int


@dataclass(frozen=True, slots=True, eq=False)
class _Mode:
    """ζ⁺, e and q as linear maps of (ζ, v, p), and entrywise majorants of what they were summed from."""

    step: Matrix
    output: Matrix
    right: Matrix
    step_: Matrix
    output_: Matrix
    right_: Matrix


def check_switched(law: GainLaw, certificate: SwitchedCertificate) -> Verification:
    """Return whether an exact certificate proves what it says."""
    unusable = _unusable(law, certificate)
    if unusable:
        return failed(unusable)
    if certificate.contraction is not None:
        return _worst([_schur(law), check_contraction(law, certificate.contraction)])
    if _entries(law, certificate) > _ENTRIES:
        return failed("the window or the predictions are too many to be computed with")
    with np.errstate(over="ignore", invalid="ignore", under="ignore"):  # what is not finite does not pass
        return _checked(law, certificate)


def _checked(law: GainLaw, certificate: SwitchedCertificate) -> Verification:
    """Check a certificate that makes sense, other than a contraction."""
    loop = _Loop(law, certificate)
    if loop.storages > MAX_STORAGES:
        return failed("there are more storages than a certificate may hold")
    if len(loop.edges) * (loop.size + loop.m + loop.p) ** 3 > _OPERATIONS:
        return failed("there is more to check than a certificate may ask for")
    if loop.beyond():
        return failed("a number is too small or too large to be computed with")
    if certificate.blocks:
        if any(block.kind == "paths" and block.memory != certificate.memory for block in certificate.blocks):
            return failed("a block has another memory than the certificate")
        return _worst([_schur(law), _blocks(loop, certificate)])
    shape = (loop.storages, loop.size, loop.size)
    if certificate.P.shape != shape:
        return failed(f"expected {shape[0]} storages of size {shape[1]}")
    if certificate.mu.shape != ((len(loop.edges),) if certificate.delta_max > 0.0 else (0,)):
        return failed("expected one multiplier for each transition")
    if not np.array_equal(certificate.P, certificate.P.transpose(0, 2, 1)):
        return failed("a storage is not symmetric")
    checks = [definite(P, np.zeros_like(P), "a storage is not positive definite") for P in certificate.P]
    checks += [_transition(loop, certificate, e) for e in range(len(loop.edges))]
    if certificate.eta is None:
        checks.append(_schur(law))
    return _worst(checks)


def least_eta_of(law: GainLaw, certificate: SwitchedCertificate) -> float:
    """Return the infimum of the η that the storages prove, by Schur complements; infinite if none.

    A value for :func:`check_switched`, not a proof; any η in the certificate will do.
    """
    assert certificate.eta is not None
    loop = _Loop(law, certificate)
    largest = 0.0
    for e in range(len(loop.edges)):
        matrix, _ = loop.inequality(certificate, e)
        v = slice(loop.size, loop.size + loop.m)
        rest = np.r_[0 : v.start, v.stop : matrix.shape[0]]
        base = matrix[np.ix_(rest, rest)]
        if not np.all(np.diag(base) > 0.0):
            return math.inf
        unit = 1.0 / np.sqrt(np.diag(base))
        try:
            factor = np.linalg.cholesky(base * unit[:, None] * unit)
        except np.linalg.LinAlgError:
            return math.inf
        cross = np.linalg.solve(factor, matrix[rest, v] * unit[:, None])
        corner = certificate.eta**2 * np.eye(loop.m) - matrix[v, v] + cross.T @ cross
        largest = max(largest, float(np.linalg.eigvalsh(corner)[-1]))
    return math.sqrt(largest)


def _unusable(law: GainLaw, certificate: SwitchedCertificate) -> str:
    """Return why a certificate makes no sense; empty if it does."""
    c = certificate
    if not (0 <= c.d_min <= c.d_max <= MAX_DELAY):
        return f"no window of delays: {c.d_min} to {min(c.d_max, MAX_DELAY + 1)}"
    if not 0 <= c.memory <= MAX_MEMORY or len(c.blocks) > MAX_STORAGES:
        return "memory or blocks are out of range"
    if c.aheads is not None and not (c.aheads and 0 <= min(c.aheads) <= max(c.aheads) <= _AHEAD):
        return "the predictions are out of range"
    scalars = np.array([c.delta_max, c.eta or 0.0])
    numbers = [c.P.reshape(-1), c.mu, scalars, *(block.P.reshape(-1) for block in c.blocks)]
    if not all(np.isfinite(part).all() for part in numbers):
        return "a number is not finite"
    if (c.eta is not None and c.eta <= 0.0) or c.delta_max < 0.0 or np.any(c.mu < 0.0):
        return "mu, eta or delta_max is out of range"
    if c.delta_max > 0.0 and law.model.uncertainty is None:
        return "it speaks of an uncertainty that the model does not have"
    if (c.blocks or c.contraction is not None) and (c.eta is not None or c.delta_max > 0.0):
        return "blocks and contraction prove stability alone, without uncertainty"
    if not _factors(law, c):
        return "the factors of K1 do not multiply to it"
    if any(d < c.d_min or d > c.d_max for own in sets_of(law) for d in (own.d_min, own.d_max)):
        return "a window of the schedule lies outside the certificate's" if len(sets_of(law)) > 1 else ""
    return ""


def _entries(law: GainLaw, certificate: SwitchedCertificate) -> int:
    """Return how many entries the maps of all modes have, at most, before any is built."""
    c, sets = certificate, sets_of(law)
    width = len(sets) * law.model.nu if c.right is None else max(len(c.right), 1)
    size = law.model.nx + width * c.d_max + law.model.nr
    return (c.d_max - c.d_min + 1) * len(sets) * len(c.aheads or (0,)) * size * size


def _factors(law: GainLaw, certificate: SwitchedCertificate) -> bool:
    """Whether every entry of the factors' product is that of K1 to within the law's own rounding; true without factors.

    The product is computed without rounding, and an entry that is zero must be zero: what is proved is the law that
    flies, to within a few units in the last place of each gain.
    """
    left, right = certificate.left, certificate.right
    if left is None and right is None:
        return True
    wanted = np.vstack([gains.K1 for gains in sets_of(law)])
    if left is None or right is None or (len(left), right.shape[1]) != wanted.shape or left.shape[1] != len(right):
        return False
    if not (np.isfinite(left).all() and np.isfinite(right).all()):
        return False
    rows, columns = ([[Fraction(x) for x in line] for line in X.tolist()] for X in (left, right.T))
    return all(
        abs(sum((a * b for a, b in zip(row, column, strict=True)), Fraction(0)) - Fraction(wanted[i, j]))
        <= _ULPS * abs(Fraction(wanted[i, j]))
        for i, row in enumerate(rows)
        for j, column in enumerate(columns)
    )


class _Loop:
    """The lifted loop of a certificate, put together from the model and the gains."""

    def __init__(self, law: GainLaw, certificate: SwitchedCertificate) -> None:
        model, sets = law.model, sets_of(law)
        self.law, self.sets, self.model, self.certificate = law, sets, model, certificate
        flown = certificate.aheads is not None
        stacked = np.vstack([gains.K1 for gains in sets])
        self.left, self.right = np.eye(len(stacked)), stacked
        if not flown and certificate.left is not None and certificate.right is not None:
            self.left, self.right = certificate.left, certificate.right
        self.width = len(stacked) if flown else int(self.right.shape[0])
        self.nx, d_max = model.nx, certificate.d_max
        self.with_v = certificate.eta is not None
        self.nr = model.nr if self.with_v else 0
        self.size = self.nx + self.width * d_max + self.nr
        inputs = 0 if model.reference is None else int(model.reference.Br.shape[1])
        self.nw, self.m = model.nw, (model.nw + inputs if self.with_v else 0)
        uncertainty = model.uncertainty if certificate.delta_max > 0.0 else None
        self.p = 0 if uncertainty is None else int(uncertainty.F.shape[1])
        self.q = 0 if uncertainty is None else int(uncertainty.J1.shape[0])
        self.keys = [
            _Key(d, i)
            for d in range(certificate.d_min, d_max + 1)
            for i, own in enumerate(sets)
            if len(sets) == 1 or d >= own.d_min - 1
        ]
        self.aheads = certificate.aheads if flown and certificate.aheads is not None else (0,)
        follows = {key: [after for after in self.keys if self._follows(key, after)] for key in self.keys}
        reached = {after for afters in follows.values() for after in afters}
        self.keys = [key for key in self.keys if key in reached or self._fits(key)]
        self.storages = self._count(follows)
        self.paths: list[tuple[_Key, ...]] = []
        self.edges: list[tuple[int, int, _Key, int]] = []
        if self.storages <= MAX_STORAGES:
            self._enumerate(follows)
        self._modes: dict[tuple[_Key, int], _Mode] = {}

    def _count(self, follows: dict[_Key, list[_Key]]) -> int:
        """Return the number of paths before any is built."""
        ends = dict.fromkeys(self.keys, 1)
        for _ in range(self.certificate.memory):
            grown = dict.fromkeys(self.keys, 0)
            for key, many in ends.items():
                for after in follows[key]:
                    grown[after] += many
            ends = grown
        return sum(ends.values())

    def _enumerate(self, follows: dict[_Key, list[_Key]]) -> None:
        self.paths = [(key,) for key in self.keys]
        for _ in range(self.certificate.memory):
            self.paths = [(*path, after) for path in self.paths for after in follows[path[-1]]]
        number = {path: i for i, path in enumerate(self.paths)}
        self.edges = [
            (i, number[(*path, after)[1:]], path[-1], ahead)
            for i, path in enumerate(self.paths)
            for after in follows[path[-1]]
            for ahead in self.aheads
        ]

    def _fits(self, key: _Key) -> bool:
        own = self.sets[key.which]
        return len(self.sets) == 1 or own.d_min - 1 <= key.d <= own.d_max + 1

    def _follows(self, key: _Key, after: _Key) -> bool:
        """Whether a key may come after another: a held command keeps its set, a new one has a set that fits."""
        if after.d == key.d + 1:
            return after.which == key.which
        return self._fits(after) and not (self.certificate.transitions == "fifo" and after.d > key.d + 1)

    def beyond(self) -> bool:
        """Whether the rounding of what follows could not be bounded."""
        c = self.certificate
        diagonals = [np.diagonal(stack, axis1=1, axis2=2).reshape(-1) for stack in (c.P, *(b.P for b in c.blocks))]
        sizes = np.abs(np.concatenate([*diagonals, c.mu, [c.eta or 1.0, c.delta_max or 1.0]]))
        largest = max(np.abs(part).max(initial=0.0) for part in (c.P, *(b.P for b in c.blocks)))
        if sizes.min() < LEAST or max(sizes.max(), largest) > MOST:
            return True
        model, sets = self.model, self.sets
        given = [model.A, model.B, model.C, model.D, model.E, self.left, self.right, *(own.K1 for own in sets)]
        given += [_K2(own) for own in sets]
        if any(np.any((np.abs(part) < LEAST) & (part != 0.0)) for part in given):
            return True  # a product that underflows would look like no connection
        maps = (self.mode(key, ahead) for key in self.keys for ahead in self.aheads)
        parts = (part for one in maps for part in (one.step_, one.output_, one.right_))
        return any(np.abs(part).max(initial=0.0) > MOST for part in parts)

    def mode(self, key: _Key, ahead: int) -> _Mode:
        """Return the maps of one mode."""
        if (key, ahead) not in self._modes:
            exact, majorant = (self._assembled(key, ahead, modulus=modulus) for modulus in (False, True))
            self._modes[key, ahead] = _Mode(*exact, *majorant)
        return self._modes[key, ahead]

    def _assembled(self, key: _Key, ahead: int, *, modulus: bool) -> tuple[Matrix, Matrix, Matrix]:
        model, d_max, width = self.model, self.certificate.d_max, self.width

        def of(matrix: Matrix) -> Matrix:
            return np.abs(matrix) if modulus else matrix

        total = self.size + self.m + self.p
        control, store = self._control(key, ahead, of)
        step, output, right = np.zeros((self.size, total)), np.zeros((model.ny, total)), np.zeros((self.q, total))
        x, xr = slice(0, self.nx), slice(self.size - self.nr, self.size)
        step[x] = of(model.B) @ control
        step[x, x] += of(model.A)
        for i in range(d_max):
            rows = slice(self.nx + i * width, self.nx + (i + 1) * width)
            if i == 0:
                step[rows] = store
            else:
                step[rows, rows.start - width : rows.stop - width] = np.eye(width)
        if self.with_v:
            step[x, self.size : self.size + self.nw] = of(model.E)
            output[:] = of(model.D) @ control
            output[:, x] += of(model.C)
            if model.reference is not None:
                step[xr, xr] = of(model.reference.Ar)
                step[xr, self.size + self.nw : self.size + self.m] = of(model.reference.Br)
                output[:, xr] += of(model.reference.Cr) * (1.0 if modulus else -1.0)
        if self.p and model.uncertainty is not None:
            step[x, self.size + self.m :] = self.certificate.delta_max * of(model.uncertainty.F)
            right[:] = of(model.uncertainty.J2) @ control
            right[:, x] += of(model.uncertainty.J1)
        return step, output, right

    def _control(self, key: _Key, ahead: int, of: Callable[[Matrix], Matrix]) -> tuple[Matrix, Matrix]:
        """Return u, and what enters the first slot, as maps of (ζ, v, p)."""
        nu, sets, total = self.model.nu, self.sets, self.size + self.m + self.p
        own = slice(key.which * nu, (key.which + 1) * nu)
        slot = slice(self.nx + (key.d - 1) * self.width, self.nx + key.d * self.width)
        control, store = np.zeros((nu, total)), np.zeros((self.width, total))
        if self.certificate.aheads is None:
            store[:, : self.nx] = of(self.right)
            if key.d == 0:
                control[:, : self.nx] = of(sets[key.which].K1)
            else:
                control[:, slot] = of(self.left)[own]
            if self.nr:
                control[:, self.size - self.nr : self.size] = of(_K2(sets[key.which]))
            return control, store
        for i, gains in enumerate(sets):
            rows = slice(i * nu, (i + 1) * nu)
            store[rows, : self.nx] = of(gains.K1)
            if self.nr and self.model.reference is not None:
                K2, Ar, Br = of(_K2(gains)), of(self.model.reference.Ar), of(self.model.reference.Br)
                r = slice(self.size + self.nw, self.size + self.m)
                for _ in range(ahead):
                    store[rows, r] += K2 @ Br
                    K2 = K2 @ Ar
                store[rows, self.size - self.nr : self.size] = K2
        if key.d == 0:
            control[:] = store[own]
        else:
            control[:, slot] = np.eye(self.width)[own]
        return control, store

    def inequality(self, certificate: SwitchedCertificate, e: int) -> tuple[Matrix, Matrix]:
        """Return the matrix of a transition that shall be positive definite, and a bound on its entries' errors."""
        i, j, key, ahead = self.edges[e]
        mode, P = self.mode(key, ahead), certificate.P
        mu = float(certificate.mu[e]) if self.p else 0.0
        corner = np.zeros(self.size + self.m + self.p)
        if certificate.eta is not None:
            corner[self.size : self.size + self.m] = certificate.eta**2
        corner[self.size + self.m :] = mu
        now = np.zeros((len(corner), len(corner)))
        now[: self.size, : self.size] = P[i]
        terms = mode.step.T @ P[j] @ mode.step + mode.output.T @ mode.output + mu * (mode.right.T @ mode.right)
        bound = mode.step_.T @ np.abs(P[j]) @ mode.step_ + mode.output_.T @ mode.output_
        bound += mu * (mode.right_.T @ mode.right_) + np.abs(now) + np.diag(corner)
        matrix = now + np.diag(corner) - terms
        return (matrix + matrix.T) / 2, self.operations * EPS * bound + UNDERFLOW

    @property
    def operations(self) -> int:
        """Roundings behind an entry at most, with room to spare."""
        inner = self.size + self.model.ny + self.q + self.model.nu + self.width
        return 4 * inner + 8 * (self.nr + 1) * (max(self.aheads) + 2) + _SPARE


def _K2(gains: Gains) -> Matrix:
    return np.zeros((gains.model.nu, 0)) if gains.K2 is None else gains.K2


def _transition(loop: _Loop, certificate: SwitchedCertificate, e: int) -> Verification:
    matrix, error = loop.inequality(certificate, e)
    return definite(matrix, error, f"the inequality of transition {e} does not hold")


def _blocks(loop: _Loop, certificate: SwitchedCertificate) -> Verification:
    """Check blocks of the loop over x and the slots."""
    modes = [loop.mode(key, loop.aheads[0]) for key in loop.keys]
    number = {key: i for i, key in enumerate(loop.keys)}
    F = np.stack([mode.step[:, : loop.size] for mode in modes])
    error = np.stack([mode.step_[:, : loop.size] for mode in modes]) * (loop.operations * EPS)
    error[error > 0.0] += UNDERFLOW
    edges: NDArray[np.intp] = np.array([(i, j, number[key]) for i, j, key, _ in loop.edges], dtype=np.intp)
    return check_blocks(F, error, edges.reshape(-1, 3), certificate.blocks)


def _schur(law: GainLaw) -> Verification:
    """Return whether Ar is Schur: a power of it is small. What is block-triangular with it is stable with it."""
    reference = law.model.reference
    if reference is None:
        return Verification(True, 1.0, 0.0, "")
    X, error = reference.Ar.copy(), 0.0
    for _ in range(64):
        norm = float(np.linalg.norm(X))
        if norm + error < 0.5:
            return Verification(True, 0.5 - norm, error, "")
        if not norm + error < MOST:
            break
        error = 2.0 * norm * error + error**2 + 2.0 * len(X) * EPS * norm**2 + UNDERFLOW
        X = X @ X
    return failed("Ar is not Schur")


def _worst(checks: list[Verification]) -> Verification:
    """Return the first that failed, else the one whose margin is least beside its rounding."""
    return min(checks, key=lambda v: (v.passed, v.margin / v.rounding if v.rounding > 0.0 else math.inf))
