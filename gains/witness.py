"""Witnesses: admissible periodic switching whose lifted product has a spectral radius above 1, a proof of divergence.

One period of modes i(0), …, i(L−1) repeated without end takes ζ(0) to F_i(L−1) … F_i(0) ζ(0) in L samples, so that
ρ^(1/L) of the product, its growth per sample, bounds the joint spectral radius of the admissible products from below.
:func:`find_witness` seeks the largest, cheapest first: constant delays, the structured family of section 5, greedy
worst-case trajectories, a beam search, and polishing of the best. :func:`confirm` decides in multiple precision, from
the gains alone, whether what was found is a witness. Effort is bounded by counts, never by time, and the random
starts are seeded: the same question has the same answer.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import mpmath
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import matrix_balance

from gains.model import GainLaw, Matrix, sets_of
from gains.switched import Graph, Key, Mode, Switched, state_loop

__all__ = ["Cycle", "Cycles", "Effort", "Found", "Moves", "confirm", "find_witness", "primitive", "successors"]

Cycle = tuple[int, ...]
Cycles = NDArray[np.intp]

_EDGE = 1e-9  # a growth within this of 1 is neither above nor below
_BETTER = 1e-12  # relative: less is the rounding of the same product, repeated or rotated
_AT_ONCE = 1 << 21  # numbers in one batch of products
_MOST_SQUARINGS = 90
_SETTLED = 1e-17  # change of log ρ(M) under which a squaring ends
_UNRELIABLE = 1e-3  # rounding of a power, relative, beyond which its trace says nothing
_COARSE = (1, 2, 3, 4, 6, 8, 11, 15, 20, 27)


class Effort(NamedTuple):
    """How much is tried.

    Attributes
    ----------
    beam, depth : int
        Products kept at each length of the beam search, and the longest.
    trajectories, steps : int
        Number and length of the greedy trajectories.
    polished, rounds : int
        How many of the best cycles are polished, and the most improvements of one.
    longest : int
        Longest cycle tried by trajectories and polishing.
    """

    beam: int = 64
    depth: int = 32
    trajectories: int = 32
    steps: int = 200
    polished: int = 4
    rounds: int = 40
    longest: int = 64


@dataclass(frozen=True, slots=True)
class Found:
    """The admissible cycle of largest growth that was found.

    Attributes
    ----------
    modes : tuple of int
        One primitive period, as indices into ``Switched.modes``, rotated to be lexicographically smallest.
    delays : tuple of int
        Its delays, samples.
    growth : float
        ρ^(1/L) per sample in double precision; a lower bound on the joint spectral radius, above 1 a witness.
    products : int
        How many periodic products were examined.
    """

    modes: Cycle
    delays: tuple[int, ...]
    growth: float
    products: int


def find_witness(
    switched: Switched,
    graph: Graph,
    effort: Effort = Effort(),  # noqa: B008  # a tuple of integers
    *,
    P: Matrix | None = None,
    starts: Iterable[Sequence[int]] = (),
    polish: bool = False,
    seed: int = 0,
) -> Found:
    """Return the admissible cycle of modes with the largest growth ρ^(1/L) found, also where that is below 1.

    Parameters
    ----------
    switched : Switched
        Its loop over x and the slots alone is searched; modes that predict xr differently are one.
    graph : Graph
        Which mode may follow which; a cycle is admissible when its last mode may be followed by its first.
    effort : Effort
    P : ndarray or None, shape (N − nr, N − nr)
        Positive definite: the beam and the trajectories go by ‖ζ‖² = ζ'Pζ. None for the leading eigenvector of
        P ↦ Σ F'PF, which grows evenly on the average.
    starts : iterable of sequences of int
        Cycles to begin with, as indices into ``switched.modes``.
    polish : bool
        Seek the best; otherwise return as soon as a growth is above 1.
    seed : int
        Of the random starts of the trajectories.
    """
    loop = state_loop(switched)
    keys = [Key(mode.d, mode.gain_set) for mode in loop.modes]
    kept = [keys.index(key) for key in dict.fromkeys(keys)]  # how far xr is predicted does not touch x and the slots
    modes = [loop.modes[i] for i in kept]
    moves = Moves(modes, successors(graph, len(loop.modes))[np.ix_(kept, kept)])
    search = _Search(_in_norm(loop.F[kept], P), moves, modes, effort)
    search.offer(moves.admissible(np.arange(len(kept))[:, None]))
    for start in starts:
        given = [kept.index(keys.index(keys[i])) for i in start]
        search.offer(moves.admissible(np.array([given], dtype=np.intp)))
    steps: list[Callable[[], None]] = [
        lambda: search.structured(wide=False),
        lambda: search.structured(wide=True),
        lambda: search.trajectories(np.random.default_rng(seed)),
        search.beam,
        search.polish,
    ]
    for step in steps:
        if polish or search.growth <= 1.0 + _EDGE:
            step()
    assert search.best, "a delay can follow itself"
    best = primitive([kept[i] for i in search.best[0][1]])
    return Found(best, tuple(switched.modes[i].d for i in best), search.growth, search.products)


def confirm(law: GainLaw, sequence: Sequence[int | Key], digits: int = 50) -> float:
    """Return the growth per sample of a periodic sequence, from A, B and K1 as they stand, in multiple precision.

    A period takes h = (x(k); K1 x(k−1); …; K1 x(k−d)), d the largest delay of the sequence, to M h: M comes from
    running Eq. (4) under Eq. (9). ρ(M) lies below ‖M^k‖^(1/k), which falls to it, and above (|tr M^k|/N)^(1/k); every
    squaring carries a bound on its rounding. A result above 1 proves that the loop diverges; where the digits do not
    suffice more are carried, and where those do not either the result is at most 1.

    Parameters
    ----------
    law : Gains or Schedule
    sequence : sequence of int or Key
        One period: d(0), …, d(L−1); of a schedule, with the gain set of each command.
    digits : int
        Decimal digits carried at first.
    """
    keys = [key if isinstance(key, Key) else Key(key) for key in sequence]
    growth = 1.0
    for carried in (digits, 4 * digits, 20 * digits):
        growth, certain = _growth(law, keys, carried)
        if certain:
            return growth
    return min(growth, 1.0)


def _growth(law: GainLaw, keys: Sequence[Key], digits: int) -> tuple[float, bool]:
    """Return the growth per sample, and whether the digits suffice for it: only then is more than 1 a proof."""
    with mpmath.workdps(digits):
        unit = mpmath.mpf(10) ** (2 - digits)
        power = _period(law, keys)
        N = power.rows
        error = unit * N * len(keys) * mpmath.mnorm(_period(law, keys, modulus=True), "f")
        log_norm, last, proved = mpmath.mpf(0), mpmath.inf, False
        for squarings in range(_MOST_SQUARINGS):
            k = 2**squarings  # power = M^k / e^(k log_norm), to within the error
            size = mpmath.mnorm(power, "f")
            if not size:
                return 0.0, True  # never a witness
            power, error = power / size, error / size + N * unit
            log_norm += mpmath.log(size) / k
            if error > _UNRELIABLE:
                break
            trace = abs(sum(power[i, i] for i in range(N))) - N * error
            proved = proved or (trace > 0 and log_norm + mpmath.log(trace / N) / k > 0)
            settled = last - log_norm <= _SETTLED and k > N
            if settled and (proved or log_norm + mpmath.log1p(error) / k <= 0):
                return float(mpmath.exp(log_norm / len(keys))), True
            last = log_norm
            power, error = power * power, 2 * error + error**2 + N * unit
        return float(mpmath.exp(log_norm / len(keys))), False


def _period(law: GainLaw, keys: Sequence[Key], *, modulus: bool = False) -> Any:
    """Return M with h(L) = M h(0) as an mpmath matrix, shape (N, N), or a majorant of it; see :func:`confirm`."""

    def of(matrix: Matrix) -> Matrix:
        return np.abs(matrix) if modulus else matrix

    A, B = (_rows(of(matrix)) for matrix in (law.model.A, law.model.B))
    K1 = {key.gain_set: _rows(of(sets_of(law)[key.gain_set].K1)) for key in keys}
    nx, nu, depth = law.model.nx, law.model.nu, max(key.d for key in keys)
    N = nx + nu * len(K1) * depth
    unit = iter(mpmath.eye(N).tolist())
    x = [next(unit) for _ in range(nx)]
    past = [{i: [next(unit) for _ in range(nu)] for i in K1} for _ in range(depth)]  # K1 x(k−1), K1 x(k−2), …
    for d, gain_set in keys:
        past.insert(0, {i: _times(rows, x) for i, rows in K1.items()})
        x = _times([a + b for a, b in zip(A, B, strict=True)], x + past[d][gain_set])
        past = past[:depth]
    return mpmath.matrix(x + [row for slot in past for rows in slot.values() for row in rows])


def _rows(matrix: Matrix) -> list[list[Any]]:
    """Return the doubles of a matrix, exactly."""
    return [[mpmath.mpf(value) for value in row] for row in matrix.tolist()]


def _times(left: list[list[Any]], right: list[list[Any]]) -> list[list[Any]]:
    return [[mpmath.fdot(row, column) for column in zip(*right, strict=True)] for row in left]


def successors(graph: Graph, modes: int) -> NDArray[np.bool_]:
    """Return which mode may follow which, shape (modes, modes): a row for the first, a column for the second."""
    taken = np.zeros((len(graph.paths), modes), dtype=bool)
    taken[graph.edges[:, 0], graph.edges[:, 2]] = True
    allowed = np.zeros((modes, modes), dtype=bool)
    for _, after, mode in graph.edges:
        allowed[mode] |= taken[after]
    return allowed


def primitive(cycle: Sequence[int]) -> Cycle:
    """Return the primitive period of a cycle, in its lexicographically smallest rotation."""
    whole = tuple(cycle)
    length = len(whole)
    period = next(n for n in range(1, length + 1) if length % n == 0 and whole[n:] + whole[:n] == whole)
    return min(whole[i:period] + whole[:i] for i in range(period))


class Moves:
    """Admissible cycles and the changes from one to others.

    Parameters
    ----------
    modes : sequence of Mode
    allowed : ndarray of bool, shape (modes, modes)
        Which mode may follow which; see :func:`successors`.

    Attributes
    ----------
    allowed : ndarray of bool, shape (modes, modes)
    nearest : ndarray of int, shape (modes, modes)
        The admissible successor of the first mode that is nearest to the second: the second itself where it may follow.
    """

    def __init__(self, modes: Sequence[Mode], allowed: NDArray[np.bool_]) -> None:
        keys = np.array([tuple(mode) for mode in modes]).reshape(-1, 3)
        apart = np.abs(keys[:, None] - keys) @ np.array([len(modes) ** 2, len(modes), 1])
        self.allowed = allowed
        self.nearest = np.where(allowed[:, None, :], apart[None], apart.max() + 1).argmin(axis=2)

    def admissible(self, cycles: Cycles) -> Cycles:
        """Return those of the cycles, shape (cycles, L), in which every mode may follow the one before, cyclically."""
        return cycles[self.allowed[cycles, np.roll(cycles, -1, axis=1)].all(axis=1)]

    def repaired(self, cycles: Cycles) -> Cycles:
        """Return the cycles, shape (cycles, L), each mode from the second replaced by the nearest that may follow.

        Those that do not close are left out.
        """
        cycles = cycles.copy()
        for k in range(1, cycles.shape[1]):
            cycles[:, k] = self.nearest[cycles[:, k - 1], cycles[:, k]]
        return self.admissible(cycles)

    def neighbours(self, cycle: Cycle, longest: int) -> Iterator[Cycles]:
        """Yield the cycles one change away, by length: a mode exchanged or inserted, some deleted or repeated."""
        length = len(cycle)
        turned = np.array([cycle[i:] + cycle[:i] for i in range(length)], dtype=np.intp)
        every = np.repeat(np.arange(len(self.allowed)), length)[:, None]
        whole = np.tile(turned, (len(self.allowed), 1))
        yield self.repaired(np.hstack([every, whole[:, 1:]]))
        if length < longest:
            yield self.repaired(np.hstack([every, whole]))
        for n in range(1, min(4, length)):
            yield self.repaired(turned[:, n:])
            if length + n <= longest:
                yield self.repaired(np.hstack([turned[:, :n], turned]))


class _Search:
    """The cycles of largest growth so far, and the steps that look for larger.

    Parameters
    ----------
    F : ndarray, shape (modes, N, N)
        In coordinates in which the 2-norm is the one to go by.
    moves : Moves
    modes : sequence of Mode
    effort : Effort
    """

    def __init__(self, F: Matrix, moves: Moves, modes: Sequence[Mode], effort: Effort) -> None:
        self.F, self.moves, self.modes, self.effort = F, moves, modes, effort
        self.best: list[tuple[float, Cycle]] = []
        self.products = 0

    @property
    def growth(self) -> float:
        return self.best[0][0] if self.best else 0.0

    def offer(self, cycles: Cycles) -> tuple[float, Cycle]:
        """Examine admissible cycles of one length, shape (cycles, L); return the best of them, keep the best of all."""
        growth = _growths(self.F, cycles)
        self.products += len(cycles)
        ranked = np.argsort(-growth, kind="stable")[: self.effort.polished]
        offered = [(float(growth[i]), primitive(cycles[i].tolist())) for i in ranked]
        kept = {cycle: value for value, cycle in [*offered, *self.best]}
        self.best = sorted(((value, cycle) for cycle, value in kept.items()), key=lambda one: (-one[0], one[1]))
        del self.best[self.effort.polished :]
        return offered[0] if offered else (0.0, ())

    def structured(self, *, wide: bool) -> None:
        """Offer the family of section 5, for each set of gains in turn."""
        low, high = min(mode.d for mode in self.modes), max(mode.d for mode in self.modes)
        by_length: dict[int, list[list[int]]] = {}
        for gain_set in sorted({mode.gain_set for mode in self.modes}):
            number = {mode.d: i for i, mode in enumerate(self.modes)}
            number |= {mode.d: i for i, mode in enumerate(self.modes) if mode.gain_set == gain_set}
            for delays in _wide(low, high) if wide else _narrow(low, high):
                by_length.setdefault(len(delays), []).append([number[d] for d in delays])
        for cycles in by_length.values():
            self.offer(np.unique(self.moves.repaired(np.array(cycles, dtype=np.intp)), axis=0))

    def trajectories(self, rng: np.random.Generator) -> None:
        """Follow the mode that stretches ζ most, from random ζ, and offer every end of the path that closes."""
        count, steps = self.effort.trajectories, self.effort.steps
        state = rng.normal(size=(count, self.F.shape[1]))
        path = np.zeros((count, steps), dtype=np.intp)
        may = np.tile(self.moves.allowed.any(axis=1), (count, 1))
        for k in range(steps):
            after = np.einsum("mij,cj->cmi", self.F, state)
            path[:, k] = np.where(may, np.linalg.norm(after, axis=2), -1.0).argmax(axis=1)
            state = after[np.arange(count), path[:, k]]
            state /= np.maximum(np.linalg.norm(state, axis=1, keepdims=True), np.finfo(float).tiny)
            may = self.moves.allowed[path[:, k]]
        for length in range(2, min(self.effort.longest, steps) + 1):
            self.offer(self.moves.admissible(np.unique(path[:, -length:], axis=0)))

    def beam(self) -> None:
        """Offer the closed ones among the longer and longer products of largest norm."""
        paths, products = np.arange(len(self.F))[:, None], self.F
        for length in range(2, self.effort.depth + 1):
            parent, mode = np.nonzero(self.moves.allowed[paths[:, -1]])
            paths = np.hstack([paths[parent], mode[:, None]])
            products = self.F[mode] @ products[parent]
            norms = np.linalg.norm(products, axis=(1, 2))  # ρ is no larger
            self.offer(self.moves.admissible(paths[norms > self.growth**length]))
            kept = np.argsort(-norms, kind="stable")[: self.effort.beam]
            paths, products = paths[kept], products[kept]

    def polish(self) -> None:
        """Change the best cycles, one change at a time, for as long as the growth rises."""
        for growth, cycle in self.best.copy():
            for _ in range(self.effort.rounds):
                tried = max(self.offer(cycles) for cycles in self.moves.neighbours(cycle, self.effort.longest))
                if tried[0] <= growth * (1.0 + _BETTER):
                    break
                growth, cycle = tried


def _narrow(low: int, high: int) -> Iterator[list[int]]:
    """Yield b samples at low, the ramp to high from wherever it starts, and a samples at high."""
    for start in range(low + 1, high + 1):
        for a in range(1, 3 * high + 21) if start == low + 1 else _COARSE:
            for b in range(1, 6):
                yield [low] * b + list(range(start, high)) + [high] * a


def _wide(low: int, high: int) -> Iterator[list[int]]:
    """Yield the same between any two delays of the window, less finely."""
    for bottom in range(low, high):
        for top in range(bottom + 1, high + 1):
            for a in _COARSE:
                for b in (1, 2, 3):
                    yield [bottom] * b + list(range(bottom + 1, top)) + [top] * a


def _in_norm(F: Matrix, P: Matrix | None) -> Matrix:
    """Return the modes, shape (modes, N, N), in coordinates in which ζ'Pζ is the squared 2-norm; see find_witness."""
    if P is None:
        _, scale = matrix_balance(np.abs(F).sum(axis=0), permute=False, separate=True)
        F = F / scale[0][:, None] * scale[0]
        P = one = np.eye(F.shape[1])
        for _ in range(100):
            P = np.einsum("mki,kl,mlj->ij", F, P, F, optimize=True)
            P = (P + P.T) / max(np.trace(P), np.finfo(float).tiny) + 1e-6 * one  # away from singular
    root = np.linalg.cholesky(P).T
    return np.asarray(root @ F @ np.linalg.inv(root))


def _growths(F: Matrix, cycles: Cycles) -> Matrix:
    """Return ρ(F_i(L−1) … F_i(0))^(1/L) for each cycle.

    Parameters
    ----------
    F : ndarray, shape (modes, N, N)
    cycles : ndarray of int, shape (cycles, L)
    """
    found = []
    at_once = max(1, _AT_ONCE // F[0].size)
    for first in range(0, len(cycles), at_once):
        some = cycles[first : first + at_once]
        products = F[some[:, 0]]
        for i in some.T[1:]:
            products = F[i] @ products
        found.append(np.abs(np.linalg.eigvals(products)).max(axis=1) ** (1.0 / some.shape[1]))
    return np.concatenate(found) if found else np.zeros(0)
