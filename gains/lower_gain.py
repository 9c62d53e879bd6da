"""Lower bounds on the l2 gain from v to e under switching: the H∞ norms of admissible periodic sequences.

A sequence of modes of period L, lifted in time, is one time-invariant system from the L inputs of a period to its L
outputs, T(z) = 𝒞 (z I − Φ)⁻¹ ℬ + 𝒟, with the gain of the periodic loop as its H∞ norm. Every admissible cycle
therefore bounds the gain under switching from below, as storage functions bound it from above. :func:`periodic_gain`
finds the peak of one cycle by the level sets of Bruinsma and Steinbuch (Systems & Control Letters 14, 1990), in
discrete time by the unit eigenvalues of a symplectic pencil, and returns the gain at that one frequency less what
rounding may have added. :func:`worst_gain` ascends over cycles, which are screened at a few frequencies. Effort is
bounded by counts and the draws are seeded: the same question has the same answer.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigvals

from gains.model import Matrix
from gains.switched import Graph, Switched
from gains.witness import Cycle, Cycles, Moves, primitive, successors

__all__ = ["Ascent", "constant_norms", "periodic_gain", "worst_gain"]

_EPS = float(np.finfo(float).eps)
_ON_CIRCLE = 1e-6  # of the pencil's eigenvalues: a false one costs one evaluation
_GRID = 24
_LEVELS = 30  # the level sets converge quadratically: 3 to 6 are used
_TIMES = (4, 8, 12)  # how often a mode stands in a start of two blocks
_AT_ONCE = 1 << 19  # numbers in one batch of responses


class Ascent(NamedTuple):
    """How much is tried.

    Attributes
    ----------
    exhaustive, most : int
        All cycles up to the first length are screened, as long as there are no more than the second of one length.
    drawn : int
        Cycles drawn by the weights of the edges.
    kept, rounds : int
        How many of the best, each of another length, and how many of those given or drawn are changed, and the most
        improvements of one.
    longest : int
        Longest cycle.
    frequencies : int
        At which a cycle is screened, beside those that its parent suggests.
    tolerance : float
        Relative, of the norm.
    """

    exhaustive: int = 6
    most: int = 1000
    drawn: int = 64
    kept: int = 6
    rounds: int = 30
    longest: int = 32
    frequencies: int = 7
    tolerance: float = 1e-6


class _Peak(NamedTuple):
    gain: float
    cycle: Cycle
    theta: float


def periodic_gain(switched: Switched, modes: Sequence[int], tolerance: float = 1e-6) -> float:
    """Return a lower bound, within a relative tolerance, on the l2 gain under a periodic sequence of modes.

    Infinite when the product over the period is not Schur; 0 without inputs or outputs.

    Parameters
    ----------
    switched : Switched
    modes : sequence of int
        One period, as indices into ``switched.modes``.
    tolerance : float
        The true norm is below (1 + tolerance) times the largest gain at the frequencies that were evaluated.
    """
    return _peak(switched, primitive(modes), tolerance).gain


def constant_norms(switched: Switched, tolerance: float = 1e-6) -> list[tuple[int, float]]:
    """Return (d, H∞ norm from v to e) of every mode held for ever, in the order of the modes; inf where it diverges."""
    return [(mode.d, periodic_gain(switched, (i,), tolerance)) for i, mode in enumerate(switched.modes)]


def worst_gain(
    switched: Switched,
    graph: Graph,
    starts: Iterable[Sequence[int]] = (),
    effort: Ascent = Ascent(),  # noqa: B008  # a tuple of numbers
    *,
    weights: Matrix | None = None,
    seed: int = 0,
) -> tuple[float, Cycle]:
    """Return the largest gain found over admissible cycles, and the cycle; infinite where one diverges.

    Parameters
    ----------
    switched : Switched
    graph : Graph
    starts : iterable of sequences of int
        Cycles to begin with beside the shortest, as indices into ``switched.modes``; those that the graph does not
        admit are passed over.
    effort : Ascent
    weights : ndarray or None, shape (edges,)
        Nonnegative; start cycles are drawn by them. The traces of the dual of the storage inequalities weigh the
        transitions that decide the upper bound.
    seed : int
        Of these draws.
    """
    moves = Moves(switched.modes, successors(graph, len(switched.modes)))
    drawn = [] if weights is None else _drawn(graph, weights, effort, np.random.default_rng(seed))
    given = [moves.admissible(np.array([cycle], dtype=np.intp)) for cycle in [*starts, *drawn]]
    screen = np.linspace(0.0, np.pi, _GRID)

    def best_of(batches: Iterable[Cycles]) -> list[_Peak]:
        return sorted(peak for cycles in batches for peak in _best(switched, cycles, screen, 1))

    of_length = {len(peak.cycle): peak for peak in best_of([*_shortest(moves, effort), *_blocks(moves, effort)])}
    ranked = [*sorted(of_length.values())[-effort.kept :], *best_of(given)[-effort.kept :]]
    passed: set[Cycle] = set()
    best = max(_ascended(switched, moves, peak, effort, passed) for peak in reversed(ranked))
    return best.gain, best.cycle


def _ascended(switched: Switched, moves: Moves, start: _Peak, effort: Ascent, passed: set[Cycle]) -> _Peak:
    """Return the cycle that single changes lead to, each to the best of all neighbours, while the gain rises.

    At a cycle that an earlier ascent has passed the way on is known. The cycles of this one are added.
    """
    best = _peak(switched, start.cycle, effort.tolerance)
    for _ in range(effort.rounds):
        if not math.isfinite(best.gain) or best.cycle in passed:
            break
        passed.add(best.cycle)
        tried = [
            peak
            for cycles in moves.neighbours(best.cycle, effort.longest)
            for peak in _best(switched, cycles, _suggested(best, cycles.shape[1], effort.frequencies), 1, best.gain)
        ]
        better = _peak(switched, max(tried).cycle, effort.tolerance) if tried else best
        if better.gain <= best.gain * (1.0 + effort.tolerance):
            break
        best = better
    return best


def _suggested(parent: _Peak, length: int, count: int) -> Matrix:
    """Return angles in [0, π]: a grid, the parent's, and the parent's frequency per sample over another length."""
    same = parent.theta * length / len(parent.cycle)
    folded = abs(math.remainder(same, 2.0 * math.pi))
    return np.array([*np.linspace(0.0, np.pi, count), parent.theta, folded])


def _shortest(moves: Moves, effort: Ascent) -> list[Cycles]:
    """Return all admissible cycles of length 1, 2, …, by length, while there are few."""
    modes = len(moves.allowed)
    found = []
    for length in range(1, effort.exhaustive + 1):
        if modes**length > effort.most and length > 1:
            break
        every = np.array(list(product(range(modes), repeat=length)), dtype=np.intp)
        once = every[every[:, 0] == every.min(axis=1)]  # of the rotations
        found.append(moves.admissible(once))
    return found


def _blocks(moves: Moves, effort: Ascent) -> list[Cycles]:
    """Return the cycles of one mode several times, then another: the slow modes answer to slow switching."""
    modes = len(moves.allowed)
    pairs = np.array([(i, j) for i in range(modes) for j in range(i)], dtype=np.intp).reshape(-1, 2)[: effort.most]
    return [moves.repaired(np.repeat(pairs, times, axis=1)) for times in _TIMES if 2 * times <= effort.longest]


def _drawn(graph: Graph, weights: Matrix, effort: Ascent, rng: np.random.Generator) -> list[Cycle]:
    """Return cycles of random walks on the graph, each from an edge to the first return to its node."""
    starts, ends, modes = graph.edges.T
    chance = np.maximum(weights, 0.0) + 1e-9 * np.max(weights)
    cycles = []
    for _ in range(effort.drawn):
        edge = int(rng.choice(len(chance), p=chance / chance.sum()))
        home, walk = starts[edge], [int(modes[edge])]
        while ends[edge] != home and len(walk) < effort.longest:
            out = np.flatnonzero(starts == ends[edge])
            edge = int(rng.choice(out, p=chance[out] / chance[out].sum()))
            walk.append(int(modes[edge]))
        if ends[edge] == home:
            cycles.append(tuple(walk))
    return cycles


# -- one cycle, or many of one length


class _Lifted(NamedTuple):
    """x(L) = Φ x(0) + ℬ v and e = 𝒞 x(0) + 𝒟 v over one period of each of several cycles.

    Attributes
    ----------
    Phi : ndarray, shape (cycles, N, N)
    B : ndarray, shape (cycles, N, L·m)
    C : ndarray, shape (cycles, L·ny, N)
    D : ndarray, shape (cycles, L·ny, L·m)
    """

    Phi: Matrix
    B: Matrix
    C: Matrix
    D: Matrix


def _lifted(F: Matrix, G: Matrix, H: Matrix, Hv: Matrix, cycles: Cycles) -> _Lifted:
    """Return the lifting in time of cycles, shape (cycles, L), from the matrices of every mode."""
    count, length = cycles.shape
    N, m, ny = F.shape[1], G.shape[2], H.shape[1]
    state = np.zeros((count, N, N + length * m))  # x(k) as a map of (x(0), v)
    state[:, :, :N] = np.eye(N)
    output = np.zeros((count, length, ny, N + length * m))
    for k, modes in enumerate(cycles.T):
        now = slice(N + k * m, N + (k + 1) * m)
        output[:, k] = H[modes] @ state
        output[:, k, :, now] += Hv[modes]
        state = F[modes] @ state
        state[:, :, now] += G[modes]
    output = output.reshape(count, length * ny, N + length * m)
    return _Lifted(state[:, :, :N], state[:, :, N:], output[:, :, :N], output[:, :, N:])


def _response(lifted: _Lifted, theta: Matrix) -> NDArray[np.complex128]:
    """Return T(e^{jθ}), shape (cycles, angles, L·ny, L·m)."""
    z = np.exp(1j * theta)[:, None, None]
    pencil = z * np.eye(lifted.Phi.shape[1]) - lifted.Phi[:, None]
    left = np.linalg.solve(pencil.swapaxes(2, 3), lifted.C.swapaxes(1, 2)[:, None].astype(complex)).swapaxes(2, 3)
    return np.asarray(left @ lifted.B[:, None] + lifted.D[:, None])


def _gains(lifted: _Lifted, theta: Matrix, above: float = 0.0) -> Matrix:
    """Return the largest singular value of T(e^{jθ}), shape (cycles, angles); 0 where it cannot be above ``above``."""
    T = _response(lifted, theta)
    largest = np.zeros(T.shape[:2])
    if 0 in T.shape:
        return largest
    flat = T if T.shape[2] <= T.shape[3] else T.swapaxes(2, 3)
    squared = flat @ flat.conj().swapaxes(2, 3)
    may = np.linalg.norm(squared, axis=(2, 3)) > above**2  # ‖T‖⁴ is no more than the sum of all eigenvalues squared
    largest[may] = np.sqrt(np.linalg.eigvalsh(squared[may])[:, -1].clip(0.0))
    return largest


def _best(switched: Switched, cycles: Cycles, theta: Matrix, count: int, above: float = 0.0) -> list[_Peak]:
    """Return the cycles of largest gain over the angles, at most ``count``; a divergent one has an infinite gain.

    Of gains that are not above ``above`` no more is known than that.
    """
    peaks: list[_Peak] = []
    length = cycles.shape[1]
    at_once = max(1, _AT_ONCE // (len(theta) * (switched.N + length) * (switched.N + length * switched.m)))
    for first in range(0, len(cycles), at_once):
        some = cycles[first : first + at_once]
        lifted = _lifted(switched.F, switched.G, switched.H, switched.Hv, some)
        diverges = np.abs(np.linalg.eigvals(lifted.Phi)).max(axis=1) >= 1.0
        gains = np.full((len(some), len(theta)), np.inf)
        gains[~diverges] = _gains(_Lifted(*(matrix[~diverges] for matrix in lifted)), theta, above)
        for i in np.argsort(-gains.max(axis=1), kind="stable")[:count]:
            at = gains[i].argmax()
            peaks.append(_Peak(float(gains[i, at]), primitive(some[i].tolist()), float(theta[at])))
    return sorted(peaks, reverse=True)[:count]


def _peak(switched: Switched, cycle: Cycle, tolerance: float) -> _Peak:
    """Return the norm of one cycle and the angle of its peak, by the midpoints of level sets."""
    lifted = _lifted(switched.F, switched.G, switched.H, switched.Hv, np.array([cycle], dtype=np.intp))
    if np.abs(np.linalg.eigvals(lifted.Phi[0])).max() >= 1.0:
        return _Peak(math.inf, cycle, 0.0)
    if 0 in lifted.D.shape:
        return _Peak(0.0, cycle, 0.0)
    angles = np.linspace(0.0, np.pi, _GRID)
    gain, theta = 0.0, 0.0
    for _ in range(_LEVELS):
        gains = _gains(lifted, angles)[0]
        if gains.max() <= gain * (1.0 + tolerance):
            break
        gain, theta = float(gains.max()), float(angles[gains.argmax()])
        crossings = _crossings(lifted, gain * (1.0 + tolerance))
        if not len(crossings):
            break
        edges = np.concatenate([[0.0], crossings, [np.pi]])
        angles = (edges[1:] + edges[:-1]) / 2.0
    return _Peak(_certain(switched, cycle, lifted, theta), cycle, theta)


def _crossings(lifted: _Lifted, level: float) -> Matrix:
    """Return the angles in [0, π], rising, at which a singular value of T(e^{jθ}) may equal the level.

    They are among the unit eigenvalues of z [[I, −B S Bᵀ], [0, Φᵀ + Cᵀ D S Bᵀ]] − [[Φ + B S Dᵀ C, 0],
    [−Cᵀ (I + D S Dᵀ) C, I]], S = (level² I − DᵀD)⁻¹, which is x⁺ = Φ x + B v and its adjoint with v eliminated.
    """
    Phi, B, C, D = (matrix[0] for matrix in lifted)
    N = len(Phi)
    S = np.linalg.inv(level**2 * np.eye(B.shape[1]) - D.T @ D)
    moved = Phi + B @ S @ D.T @ C
    right = np.block([[moved, np.zeros((N, N))], [-C.T @ (C + D @ S @ D.T @ C), np.eye(N)]])
    left = np.block([[np.eye(N), -B @ S @ B.T], [np.zeros((N, N)), moved.T]])
    with np.errstate(all="ignore"):
        z = eigvals(right, left)
    z = z[np.isfinite(z)]
    return np.sort(np.abs(np.angle(z[np.abs(np.abs(z) - 1.0) < _ON_CIRCLE])))


def _certain(switched: Switched, cycle: Cycle, lifted: _Lifted, theta: float) -> float:
    """Return the gain at an angle less what rounding may have added to it.

    The worst v of the period and its x(0) are run through the modes. What the steps and the end, x(L) = z x(0), leave
    over is a disturbance of the state, that may have raised e by no more than its own gain: no product enters.
    """
    z = np.exp(1j * theta)
    v = np.linalg.svd(_response(lifted, np.array([theta]))[0, 0])[2][0].conj()
    x = first = np.linalg.solve(z * np.eye(switched.N) - lifted.Phi[0], lifted.B[0] @ v)
    inputs = v.reshape(len(cycle), switched.m)
    unit = 4.0 * _EPS * (switched.N + switched.m)
    outputs, doubt, left_over = [], [], []
    for mode, now in zip(cycle, inputs, strict=True):
        step = np.hstack([switched.F[mode], switched.G[mode]])
        error = np.hstack([switched.H[mode], switched.Hv[mode]])
        both = np.concatenate([x, now])
        outputs.append(error @ both)
        doubt.append(unit * (np.abs(error) @ np.abs(both)))
        left_over.append(unit * (np.abs(step) @ np.abs(both)))
        x = step @ both
    left_over.append(np.abs(x - z * first) + 4.0 * _EPS * np.abs(first))
    every = np.tile(np.eye(switched.N), (len(switched.modes), 1, 1))
    none = np.zeros((len(switched.modes), switched.H.shape[1], switched.N))
    disturbed = _lifted(switched.F, every, switched.H, none, np.array([cycle], dtype=np.intp))
    spread = 2.0 * float(_gains(disturbed, np.array([theta]))[0, 0]) * float(np.linalg.norm(np.concatenate(left_over)))
    seen = float(np.linalg.norm(np.concatenate(outputs))) - float(np.linalg.norm(np.concatenate(doubt)))
    return max(0.0, (seen - spread) / float(np.linalg.norm(v)) * (1.0 - 2.0 * _EPS * lifted.D.size))
