"""The loop over a finite horizon: its gain from v to e at given delays and uncertainty, and what changes do.

At a level γ above the gain two Riccati recursions exist. Backward, ζ'P(k)ζ is the most that ‖e‖² − γ²‖v‖² can still
gain from ζ(k) = ζ on; forward, ζ'S(k)⁻¹ζ is the least γ²‖v‖² − ‖e‖² with which ζ(k) = ζ is reached from rest. The gain
exceeds γ exactly when the largest eigenvalue of S(k) P(k) exceeds 1, at any k. So with P from behind and S from before,
the eigenvalue values every other mode at sample k with the worst v for it, in a step of the recursion.

References
----------
T. Başar, P. Bernhard, "H∞-Optimal Control and Related Minimax Design Problems", 2nd ed., 1995, chapter 3 (the finite
horizon); M. Green, D. J. N. Limebeer, "Linear Robust Control", 1995, chapter 3.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, eigsh, splu

from gains.model import Matrix
from gains.switched import Switched

__all__ = ["Horizon", "Modes", "best_change", "modes_of"]

Sequence = NDArray[np.int64]
_MORE = 1.0 + 1e-9
"""By how much another mode must value more to be taken."""


class Modes(NamedTuple):
    """The matrices of every mode, of each delay with each uncertainty: ζ(k+1) = F ζ + G v, e = H ζ + V v."""

    F: Matrix
    G: Matrix
    H: Matrix
    V: Matrix


def modes_of(switched: Switched, deltas: Matrix) -> Modes:
    """Return the modes with p = Δ q for each of some Δ in the unit ball; mode i with Δ j stands at i·len(deltas) + j.

    Parameters
    ----------
    switched : Switched
    deltas : ndarray, shape (count, columns of U, rows of J)
        One, empty, where there is no uncertainty.
    """
    pairs = [(i, delta) for i in range(len(switched.modes)) for delta in deltas]
    U = switched.U
    return Modes(
        np.array([switched.F[i] + U @ delta @ switched.J[i] for i, delta in pairs]),
        np.array([switched.G[i] + U @ delta @ switched.Jv[i] for i, delta in pairs]),
        np.array([switched.H[i] for i, _ in pairs]),
        np.array([switched.Hv[i] for i, _ in pairs]),
    )


class Horizon:
    """The loop along one sequence, as one sparse system for all states at once.

    Parameters
    ----------
    modes : Modes
    sequence : ndarray of int, shape (N,)
        The mode of each sample.
    """

    def __init__(self, modes: Modes, sequence: Sequence) -> None:
        self._modes, self._sequence = modes, sequence
        N, n = len(sequence), modes.F.shape[1]
        rows = np.arange(N)
        step = sparse.bsr_array(
            (modes.F[sequence[1:]], rows[:-1], np.concatenate([[0], rows])), shape=(N * n, N * n), blocksize=(n, n)
        )  # the state after sample k of that before
        self._solver: Any = splu(
            sparse.csc_array(sparse.eye_array(N * n) - step), permc_spec="NATURAL", diag_pivot_thresh=0.0
        )

    def states(self, v: Matrix) -> Matrix:
        """Return ζ(0), …, ζ(N), shape (N + 1, n), from rest, of v, shape (N, m)."""
        driven = np.einsum("kij,kj->ki", self._modes.G[self._sequence], v)
        after = self._solver.solve(driven.ravel()).reshape(driven.shape)
        return np.vstack([np.zeros(driven.shape[1]), after])

    def errors(self, v: Matrix) -> Matrix:
        """Return e, shape (N, ny)."""
        H, V = self._modes.H[self._sequence], self._modes.V[self._sequence]
        return np.asarray(np.einsum("kij,kj->ki", H, self.states(v)[:-1]) + np.einsum("kij,kj->ki", V, v))

    def costates(self, e: Matrix) -> Matrix:
        """Return the gradient of ‖e‖²/2 by ζ(1), …, ζ(N), shape (N, n)."""
        by_state = np.einsum("kij,ki->kj", self._modes.H[self._sequence], e)
        later = np.vstack([by_state[1:], np.zeros(by_state.shape[1])])
        return np.asarray(self._solver.solve(later.ravel(), trans="T").reshape(later.shape))

    def gain(self, v: Matrix | None = None) -> tuple[float, Matrix]:
        """Return the gain from v to e and the v that has it, of norm 1, by Lanczos' method.

        Parameters
        ----------
        v : ndarray, shape (N, m), optional
            To begin with; by default random, of a fixed seed.
        """
        N, m = len(self._sequence), self._modes.G.shape[2]
        G, V = self._modes.G[self._sequence], self._modes.V[self._sequence]

        def squared(v: Matrix) -> Matrix:
            e = self.errors(v.reshape(N, m))
            adjoint = np.einsum("kij,ki->kj", G, self.costates(e)) + np.einsum("kij,ki->kj", V, e)
            return np.asarray(adjoint.ravel())

        first = np.random.default_rng(1).normal(size=N * m) if v is None else v.ravel()
        _, vectors = eigsh(LinearOperator((N * m, N * m), matvec=squared, dtype=np.float64), k=1, v0=first, tol=1e-9)
        worst = vectors[:, 0].reshape(N, m) / np.linalg.norm(vectors)
        return float(np.linalg.norm(self.errors(worst))), worst

    def aligned(self, v: Matrix, variants: int) -> Sequence:
        """Return the sequence with the Δ that, to first order, raise ‖e‖ most at this v.

        ‖e‖² is convex in each Δ(k), so the first-order gain of one change is a lower bound of what that brings.

        Parameters
        ----------
        v : ndarray, shape (N, m)
        variants : int
            How many Δ each mode comes with (:func:`modes_of`).
        """
        states, costates = self.states(v)[:-1], self.costates(self.errors(v))
        first = self._sequence - self._sequence % variants
        effects = []
        for other in range(variants):
            F, G = self._modes.F[first + other], self._modes.G[first + other]
            after = np.einsum("kij,kj->ki", F, states) + np.einsum("kij,kj->ki", G, v)
            effects.append(np.sum(costates * after, axis=1))
        return np.asarray(first + np.argmax(effects, axis=0), dtype=np.int64)


def _backward(modes: Modes, P: Matrix, square: float) -> Matrix:
    """Return P(k) of P(k+1) for each of some modes, shape (modes, n, n); nan where γ is below the gain."""
    F, G, H, V = modes
    lost = np.asarray(np.isnan(P).any(axis=(1, 2)))
    P = np.where(lost[:, None, None], 0.0, P)
    PG = P @ G
    M = square * np.eye(G.shape[2]) - V.swapaxes(1, 2) @ V - G.swapaxes(1, 2) @ PG
    L = V.swapaxes(1, 2) @ H + PG.swapaxes(1, 2) @ F
    lost |= np.linalg.eigvalsh(M)[:, 0] <= 0.0
    M[lost] = np.eye(G.shape[2])
    result = H.swapaxes(1, 2) @ H + F.swapaxes(1, 2) @ (P @ F) + L.swapaxes(1, 2) @ np.linalg.solve(M, L)
    return np.where(lost[:, None, None], np.nan, 0.5 * (result + result.swapaxes(1, 2)))


def _forward(modes: Modes, S: Matrix, square: float) -> Matrix:
    """Return S(k+1) of S(k) for one mode, shape (n, n); nan where γ is below the gain."""
    F, G, H, V = modes
    n, m = G.shape
    Z = np.zeros((n + m, n + m))
    Z[:n, :n] = S
    Z[n:, n:] = np.eye(m) / square
    C, step = np.hstack([H, V]), np.hstack([F, G])
    CZ = C @ Z
    M = np.eye(len(C)) - CZ @ C.T
    if np.linalg.eigvalsh(M)[0] <= 0.0:
        return np.full((n, n), np.nan)
    result = step @ (Z + CZ.T @ np.linalg.solve(M, CZ)) @ step.T
    return np.asarray(0.5 * (result + result.T))


def _values(root: Matrix, P: Matrix) -> Matrix:
    """Return the largest eigenvalue of S P, S = root root', for each of some P; infinite where that is nan."""
    lost = np.asarray(np.isnan(P).any(axis=(1, 2)))
    finite = np.asarray(np.where(lost[:, None, None], 0.0, P))
    return np.where(lost, np.inf, np.linalg.eigvalsh(root.T @ finite @ root)[:, -1])


def _roots(modes: Modes, sequence: Sequence, square: float) -> list[Matrix] | None:
    """Return a root of every S(k); None where γ is below the gain."""
    S = np.zeros((modes.F.shape[1],) * 2)
    roots = []
    for i in sequence:
        values, vectors = np.linalg.eigh(S)
        roots.append(vectors * np.sqrt(np.maximum(values, 0.0)))
        S = _forward(Modes(*(matrix[i] for matrix in modes)), S, square)
        if np.isnan(S).any():
            return None
    return roots


def best_change(
    modes: Modes, sequence: Sequence, gamma: float, allowed: NDArray[np.bool_], lengths: tuple[int, ...]
) -> Sequence:
    """Return a sequence whose gain may be larger.

    Runs of one mode are put in place of what is there, wherever that values most, from the end of the horizon to its
    beginning; the first that lifts the gain above gamma ends it.

    Parameters
    ----------
    modes : Modes
    sequence : ndarray of int, shape (N,)
    gamma : float
        Just above the gain of the sequence.
    allowed : ndarray of bool, shape (modes, modes)
        Which mode may follow which.
    lengths : tuple of int
        Of runs, rising.
    """
    square = gamma * gamma
    changed = sequence.copy()
    roots = _roots(modes, sequence, square)
    if roots is None:
        return changed
    N, n = len(sequence), modes.F.shape[1]
    cost = np.zeros((N + 1, n, n))
    for k in range(N - 1, -1, -1):
        cost[k] = _of_one(modes, changed[k], cost[k + 1], square)
        best, mode, run = float(_values(roots[k], cost[k : k + 1])[0]) * _MORE, -1, 0
        for length in lengths:
            others = _candidates(changed, k, length, allowed)
            if not len(others):
                continue
            some = Modes(*(matrix[others] for matrix in modes))
            P = np.broadcast_to(cost[k + length], (len(others), n, n))
            for _ in range(length):
                P = _backward(some, P, square)
            values = _values(roots[k], P)
            if values.max() > best:
                best, mode, run = float(values.max()), int(others[values.argmax()]), length
        if mode >= 0:
            changed[k : k + run] = mode
            if best >= 1.0:
                break
            for at in range(k + run - 1, k - 1, -1):
                cost[at] = _of_one(modes, mode, cost[at + 1], square)
    return changed


def _of_one(modes: Modes, i: int, P: Matrix, square: float) -> Matrix:
    return np.asarray(_backward(Modes(*(matrix[i : i + 1] for matrix in modes)), P[None], square)[0])


def _candidates(sequence: Sequence, k: int, length: int, allowed: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return the modes that may stand at samples k to before k + length, and are not there alone."""
    end = k + length
    if end > len(sequence):
        return np.zeros(0, dtype=np.intp)
    may = np.ones(len(allowed), dtype=bool)
    if k > 0:
        may &= allowed[sequence[k - 1]]
    if length > 1:
        may &= np.diagonal(allowed)
    if end < len(sequence):
        may &= allowed[:, sequence[end]]
    if (sequence[k:end] == sequence[k]).all():
        may[sequence[k]] = False
    return np.flatnonzero(may)
