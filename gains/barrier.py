"""The logarithmic barrier of the bounded-real inequalities, as a function of storages, η², multipliers and gains.

For every transition i → j and the mode k taken there, with L = [M; H; J] of :class:`~gains.lifted_task.Family`,

    S = diag(P_i, η² I, μ I) + τ I − M'P_jM − H'H − μ J'J ≻ 0.

f = t·(η² or τ) − Σ log det S is convex for given gains. Its Newton system is assembled in closed form: X ↦ M X M' has
the structure of a Kronecker product, so that a step costs little more than one dense factorisation. That the gains may
vary with the rest gives, by a Schur complement, the exact gradient and Hessian of

    φ_t(θ) = min f / t,

a smooth function within (number of rows)/t of η²(θ).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from gains.lifted_task import Family
from gains.model import Matrix

__all__ = ["Barrier", "Place", "Step"]

_RIDGES = (1e-14, 1e-12, 1e-10, 1e-8)  # on the diagonal of the normalised Hessian, in turn: rounding at the boundary
_FLAT = 1e-10  # smallest curvature in θ that is taken, relative to the largest
_SHRINK, _SUFFICIENT = 0.6, 0.05  # of the line search
_MAX_TRIALS = 40


class Place(NamedTuple):
    """A point of the barrier, in balanced units.

    Attributes
    ----------
    P : ndarray, shape (paths, N, N)
    cost : float
        η², or τ where the barrier asks for feasibility.
    mu : ndarray, shape (edges,)
        No entries without uncertainty.
    theta : ndarray
    """

    P: Matrix
    cost: float
    mu: Matrix
    theta: Matrix


class Step(NamedTuple):
    """A Newton direction; ``decrement`` is what f would lose at least, twice, were it quadratic."""

    direction: NDArray[np.float64]
    decrement: float


class _Parts(NamedTuple):
    """What gradient and Hessian are made of, one entry for each edge: X = S⁻¹, L, T = diag(P_j, I, μ I)."""

    X: Matrix
    L: Matrix
    T: Matrix


@dataclass(frozen=True, slots=True, eq=False)
class Barrier:
    """The barrier of one design problem.

    Attributes
    ----------
    family : Family
    edges : ndarray of int, shape (edges, 3)
    paths : int
    box : ndarray, shape (entries,)
        Bounds on |K0 + N θ|; inf where there is none.
    K0, N : ndarray
        The affine subspace of the gains.
    eta2 : float or None
        None: η² is the cost. Otherwise it is fixed and τ is the cost.
    """

    family: Family
    edges: NDArray[np.intp]
    paths: int
    box: Matrix
    K0: Matrix
    N: Matrix
    eta2: float | None = None

    @property
    def degree(self) -> int:
        """Number of rows of all S: at a minimum of f the cost is within degree/t of the least."""
        return int(len(self.edges) * self.family.base.shape[2])

    def single(self) -> Barrier:
        """Return the barrier with one storage for all paths, each mode a transition to itself."""
        modes = np.unique(self.edges[:, 2])
        return replace(self, edges=np.column_stack([0 * modes, 0 * modes, modes]), paths=1)

    def asking(self, eta2: float | None) -> Barrier:
        """Return the barrier that minimises η² (None), or τ at a given η²."""
        return replace(self, eta2=eta2)

    # -- values

    def matrices(self, at: Place) -> Matrix:
        """Return S of every edge."""
        return self._matrices(at, self.family.at(at.theta))

    def _matrices(self, at: Place, L: Matrix) -> Matrix:
        f = self.family
        before, after, mode = self.edges.T
        M, H, J = L[:, : f.N], L[:, f.N : f.N + f.ny], L[:, f.N + f.ny :]
        stepped = M[mode]
        S = -(np.swapaxes(stepped, 1, 2) @ (at.P[after] @ stepped)) - (np.swapaxes(H, 1, 2) @ H)[mode]
        if f.p:
            S -= at.mu[:, None, None] * (np.swapaxes(J, 1, 2) @ J)[mode]
            inner = np.arange(f.N + f.m, S.shape[1])
            S[:, inner, inner] += at.mu[:, None]
        S[:, : f.N, : f.N] += at.P[before]
        input_ = np.arange(f.N, f.N + f.m)
        S[:, input_, input_] += at.cost if self.eta2 is None else self.eta2
        if self.eta2 is not None:
            every = np.arange(S.shape[1])
            S[:, every, every] += at.cost
        return np.asarray(S, dtype=np.float64)

    def holds(self, at: Place) -> bool:
        """Whether every S is positive definite and the gains are inside their box."""
        return bool(np.isfinite(self.value(at, 0.0)))

    def value(self, at: Place, t: float) -> float:
        """Return f; inf outside its domain."""
        room = self._room(at.theta)
        if not np.all(room > 0.0):
            return float(np.inf)
        try:
            factors = np.linalg.cholesky(self.matrices(at))
        except np.linalg.LinAlgError:
            return float(np.inf)
        logs = 2.0 * float(np.sum(np.log(np.einsum("eii->ei", factors))))
        return float(t * at.cost - logs - np.sum(np.log(room)))

    def _room(self, theta: Matrix) -> Matrix:
        """Return 1 − (K/box)² of every bounded entry."""
        K = self.K0 + self.N @ theta
        return np.asarray(1.0 - (K / self.box)[np.isfinite(self.box)] ** 2, dtype=np.float64)

    # -- Newton steps

    def newton(self, at: Place, t: float, *, gains: bool) -> Step | None:
        """Return the Newton direction of f, with or without the gains; None where rounding leaves none.

        Along the gains the curvature of φ_t is taken by its size: the direction falls where φ_t is not convex too.
        """
        gradient, hessian = self._system(at, t)
        k = len(gradient) - len(at.theta)
        diagonal = np.diag(hessian)[:k]
        if not (np.all(np.isfinite(hessian)) and np.all(diagonal > 0.0)):
            return None
        size = np.sqrt(diagonal)
        normal = hessian[:k, :k] / size / size[:, None]
        for ridge in _RIDGES:
            try:
                factor = cho_factor(normal + ridge * np.eye(k), check_finite=False)
                break
            except np.linalg.LinAlgError:
                continue
        else:
            return None

        def solve(right: Matrix) -> Matrix:
            scaled = right.T / size
            return np.asarray((cho_solve(factor, scaled.T, check_finite=False).T / size).T, dtype=np.float64)

        direction = np.zeros_like(gradient)
        cross = hessian[:k, k:]
        if gains and cross.shape[1]:
            response = solve(cross)
            reduced = hessian[k:, k:] - cross.T @ response
            slope = gradient[k:] - response.T @ gradient[:k]
            values, vectors = np.linalg.eigh((reduced + reduced.T) / 2)
            values = np.maximum(np.abs(values), _FLAT * np.max(np.abs(values)))
            direction[k:] = -vectors @ ((vectors.T @ slope) / values)
        direction[:k] = -solve(gradient[:k] + cross @ direction[k:])
        decrement = float(-gradient @ direction)
        return Step(direction, decrement) if np.isfinite(decrement) else None

    def moved(self, at: Place, direction: NDArray[np.float64], length: float) -> Place:
        """Return the place at some length along a direction."""
        a, b, weight = self._packing()
        size = self.paths * len(a)
        change = np.zeros_like(at.P)
        values = direction[:size].reshape(self.paths, -1) * weight
        change[:, a, b] += values
        change[:, b, a] += values
        mu, theta = direction[size + 1 : size + 1 + len(at.mu)], direction[size + 1 + len(at.mu) :]
        return Place(
            at.P + length * change,
            at.cost + length * float(direction[size]),
            at.mu + length * mu,
            at.theta + length * theta,
        )

    def descended(self, at: Place, t: float) -> tuple[Place, float] | None:
        """Return the place after one Newton step with the gains held, and its decrement; None where there is none."""
        step = self.newton(at, t, gains=False)
        if step is None:
            return None
        here, length = self.value(at, t), 1.0
        for _ in range(_MAX_TRIALS):
            there = self.moved(at, step.direction, length)
            if self.value(there, t) <= here - _SUFFICIENT * length * step.decrement:
                return there, step.decrement
            length *= _SHRINK
        return None

    # -- assembly: [packed P of every path; cost; μ of every edge; θ]

    def _packing(self) -> tuple[NDArray[np.intp], NDArray[np.intp], Matrix]:
        """Return rows, columns and weights: an entry x of packed P stands for x·weight (e_a e_b' + e_b e_a')."""
        a, b = np.triu_indices(self.family.N)
        return a, b, np.where(a == b, 0.5, 1.0)

    def _packed(self, matrices: Matrix) -> Matrix:
        """Return ⟨E_ab, ·⟩ of a stack of matrices."""
        a, b, weight = self._packing()
        return np.asarray(weight * (matrices[..., a, b] + matrices[..., b, a]), dtype=np.float64)

    def _congruences(self, A: Matrix) -> Matrix:
        """Return the packed operator of X ↦ Σ A X A' over a stack."""
        flat = A.reshape(len(A), -1)
        products = (flat.T @ flat).reshape(-1)
        straight, crossed, weight = _entries(self.family.N)
        return np.asarray(weight * (products[straight] + products[crossed]), dtype=np.float64)

    def _parts(self, at: Place) -> _Parts:
        f = self.family
        _, after, mode = self.edges.T
        stacks = f.at(at.theta)
        X = np.linalg.inv(self._matrices(at, stacks))
        T = np.zeros((len(mode), stacks.shape[1], stacks.shape[1]))
        T[:, : f.N, : f.N] = at.P[after]
        outputs, right = np.arange(f.N, f.N + f.ny), np.arange(f.N + f.ny, stacks.shape[1])
        T[:, outputs, outputs] = 1.0
        if f.p:
            T[:, right, right] = at.mu[:, None]
        return _Parts((X + np.swapaxes(X, 1, 2)) / 2, stacks[mode], T)

    def _system(self, at: Place, t: float) -> tuple[NDArray[np.float64], Matrix]:
        """Return gradient and Hessian of f."""
        parts = self._parts(at)
        width = self.family.N * (self.family.N + 1) // 2
        storage = self.paths * width
        count = storage + 1 + len(at.mu) + len(at.theta)
        gradient, hessian = np.zeros(count), np.zeros((count, count))
        self._add_storages(parts, gradient, hessian, width)
        numbers = np.r_[storage, count - len(at.theta) : count]
        slopes, second = self._slopes(at, parts)
        self._add_numbers(parts, slopes, second, gradient, hessian, numbers)
        gradient[storage] += t
        if len(at.mu):
            multipliers = storage + 1 + np.arange(len(at.mu))
            self._add_multipliers(parts, slopes, second, gradient, hessian, numbers, multipliers)
            hessian[np.ix_(multipliers, numbers)] = hessian[np.ix_(numbers, multipliers)].T
        hessian[storage:, :storage] = hessian[:storage, storage:].T
        self._add_box(at.theta, gradient, hessian)
        return gradient, hessian

    def _add_storages(self, parts: _Parts, gradient: NDArray[np.float64], hessian: Matrix, width: int) -> None:
        """Add what depends on the storages alone."""
        N = self.family.N
        X, M = parts.X, parts.L[:, :N]
        XM = X @ np.swapaxes(M, 1, 2)
        own, target, cross = X[:, :N, :N], M @ XM, XM[:, :N]
        before, after, _ = self.edges.T
        own_slope, target_slope = self._packed(own), self._packed(target)
        for i in range(self.paths):
            a = slice(i * width, (i + 1) * width)
            hessian[a, a] += self._congruences(np.concatenate([own[before == i], target[after == i]]))
            gradient[a] += np.sum(target_slope[after == i], axis=0) - np.sum(own_slope[before == i], axis=0)
        for e, (i, j, _) in enumerate(self.edges):
            a, b = slice(i * width, (i + 1) * width), slice(j * width, (j + 1) * width)
            operator = self._congruences(cross[e : e + 1])
            hessian[a, b] -= operator
            hessian[b, a] -= operator.T

    def _slopes(self, at: Place, parts: _Parts) -> tuple[Matrix, Matrix]:
        """Return dS/d(cost, θ) and dL/dθ X, one stack for each edge."""
        f = self.family
        mode = self.edges[:, 2]
        count, size = len(self.edges), f.base.shape[2]
        slopes = np.zeros((count, 1 + len(at.theta), size, size))
        diagonal = np.arange(f.N, f.N + f.m) if self.eta2 is None else np.arange(size)
        slopes[:, 0, diagonal, diagonal] = 1.0
        change = f.slopes[mode]
        half = np.swapaxes(change, 2, 3) @ (parts.T @ parts.L)[:, None]
        slopes[:, 1:] = -(half + np.swapaxes(half, 2, 3))
        return slopes, change @ parts.X[:, None]

    def _add_numbers(
        self,
        parts: _Parts,
        slopes: Matrix,
        second: Matrix,
        gradient: NDArray[np.float64],
        hessian: Matrix,
        numbers: NDArray[np.intp],
    ) -> None:
        """Add what depends on the cost and on θ; S is quadratic in θ and bilinear in θ and P_j."""
        f = self.family
        X, M, mode = parts.X[:, None], parts.L[:, None, : f.N], self.edges[:, 2]
        turned = X @ slopes @ X
        gradient[numbers] -= np.einsum("eab,ecab->c", parts.X, slopes)
        own = self._packed(turned[:, :, : f.N, : f.N])
        target = -self._packed(M @ turned @ np.swapaxes(M, 2, 3))
        target[:, 1:] += 2.0 * self._packed(second[:, :, : f.N] @ np.swapaxes(M, 2, 3))
        width = own.shape[2]
        for e, (i, j, _) in enumerate(self.edges):
            hessian[i * width : (i + 1) * width, numbers] += own[e].T
            hessian[j * width : (j + 1) * width, numbers] += target[e].T
        block = np.einsum("ecab,edab->cd", turned, slopes)
        change = parts.T[:, None] @ f.slopes[mode]
        block[1:, 1:] += 2.0 * np.einsum("ecab,edab->cd", second, change)
        hessian[np.ix_(numbers, numbers)] += block

    def _add_multipliers(
        self,
        parts: _Parts,
        slopes: Matrix,
        second: Matrix,
        gradient: NDArray[np.float64],
        hessian: Matrix,
        numbers: NDArray[np.intp],
        multipliers: NDArray[np.intp],
    ) -> None:
        """Add what depends on the multipliers; each enters the S of its own edge alone."""
        f = self.family
        X, M, J = parts.X, parts.L[:, : f.N], parts.L[:, f.N + f.ny :]
        slope = -np.swapaxes(J, 1, 2) @ J
        inner = np.arange(f.N + f.m, slope.shape[1])
        slope[:, inner, inner] += 1.0
        turned = X @ slope @ X
        gradient[multipliers] -= np.einsum("eab,eab->e", X, slope)
        hessian[multipliers, multipliers] += np.einsum("eab,eab->e", turned, slope)
        own = self._packed(turned[:, : f.N, : f.N])
        target = -self._packed(M @ turned @ np.swapaxes(M, 1, 2))
        width = own.shape[1]
        for e, (i, j, _) in enumerate(self.edges):
            hessian[i * width : (i + 1) * width, multipliers[e]] += own[e]
            hessian[j * width : (j + 1) * width, multipliers[e]] += target[e]
        mixed = np.einsum("eab,ecab->ec", turned, slopes)
        mixed[:, 1:] += 2.0 * np.einsum("ecab,eab->ec", second[:, :, f.N + f.ny :], J)
        hessian[np.ix_(numbers, multipliers)] += mixed.T

    def _add_box(self, theta: Matrix, gradient: NDArray[np.float64], hessian: Matrix) -> None:
        """Add −Σ log(1 − (K/box)²)."""
        bounded = np.isfinite(self.box)
        if not np.any(bounded):
            return
        ratio = ((self.K0 + self.N @ theta) / self.box)[bounded]
        room, N = 1.0 - ratio**2, self.N[bounded] / self.box[bounded, None]
        own = slice(len(gradient) - len(theta), None)
        gradient[own] += N.T @ (2.0 * ratio / room)
        hessian[own, own] += (N.T * (2.0 / room + 4.0 * ratio**2 / room**2)) @ N


@lru_cache(maxsize=4)
def _entries(N: int) -> tuple[NDArray[np.intp], NDArray[np.intp], Matrix]:
    """Return where A_ac A_bd and A_ad A_bc stand in the flat Kronecker product of A, for packed entries ab and cd."""
    a, b = np.triu_indices(N)
    row, other = a[:, None] * N, b[:, None] * N
    straight, crossed = (row + a) * N**2 + other + b, (row + b) * N**2 + other + a
    weight = np.where(a == b, 0.5, 1.0)
    return straight, crossed, 2.0 * weight[:, None] * weight
