"""Proofs of stability under switching re-checked from their stored matrices; NumPy only.

Nothing here comes from the modules that made the proof. Quadratic forms are checked by the eigenvalues of what they
shall lose in a sample. A tree of products is grown again from its P, each product with a bound on its distance from
the exact one; it is pruned only where norm and bound together are below 1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gains.definite import EPS, LEAST, MOST, UNDERFLOW, Verification, definite, failed
from gains.model import GainLaw, Matrix, sets_of
from gains.switched_certificate import Block

__all__ = ["MAX_DEPTH", "MAX_OPERATIONS", "MAX_PRODUCTS", "MAX_SETS", "check_blocks", "check_contraction"]

MAX_PRODUCTS = 2_000_000
"""Products that the trees of one certificate may grow to in verification."""

MAX_OPERATIONS = 1 << 33
"""What these may cost, n³ for each product of size n: some fifteen seconds, however large the blocks are."""

MAX_DEPTH = 4000
"""Samples of the longest product of such a tree."""

MAX_SETS = 4096
"""Sets of nodes that a graph may lead to."""

_BATCH = 1 << 18  # entries of the products that are grown at once
_SAFETY = 16  # times n² eps: more than the relative rounding of any norm here


class _Allowance:
    """What the trees of one certificate may still cost: a file must not keep its reader for hours."""

    def __init__(self) -> None:
        self._products, self._operations = MAX_PRODUCTS, MAX_OPERATIONS

    def take(self, products: int, n: int) -> bool:
        """Take so many products of size n away, and return whether that was allowed."""
        self._products -= products
        self._operations -= products * n**3
        return self._products >= 0 and self._operations >= 0


def check_contraction(law: GainLaw, v: Matrix) -> Verification:
    """Return whether v > 0 and (|A| + |B K1|) v < v: x falls in the norm max |x_i|/v_i for every bounded delay.

    Of a schedule |B K1| is the largest of its sets, entry by entry.

    Parameters
    ----------
    law : Gains or Schedule
    v : ndarray, shape (nx,)
    """
    model = law.model
    if v.shape != (model.nx,) or not np.all((v > LEAST) & (v < MOST)):
        return failed("the vector of the contraction is not positive")
    B = np.abs(model.B)
    delayed = [np.abs(model.B @ own.K1) + model.nu * EPS * (B @ np.abs(own.K1)) + UNDERFLOW for own in sets_of(law)]
    whole = np.abs(model.A) + np.max(delayed, axis=0)
    if not (np.isfinite(whole).all() and whole.max() < MOST):
        return failed("a number of the model or the gains is too large to be computed with")
    with np.errstate(under="ignore"):
        share = (whole @ v) / v
    worst = int(np.argmax(share))
    margin, rounding = 1.0 - float(share[worst]), 2 * (model.nx + 4) * EPS * (1.0 + float(share[worst]))
    passed = margin > rounding
    return Verification(passed, margin, rounding, "" if passed else "(|A| + |B K1|) v < v does not hold")


def check_blocks(F: Matrix, error: Matrix, edges: NDArray[np.intp], blocks: Sequence[Block]) -> Verification:
    """Return whether every block is proved stable for every walk of the graph, and the blocks prove the whole.

    Parameters
    ----------
    F : ndarray, shape (modes, N, N)
        ζ⁺ = F ζ.
    error : ndarray, shape (modes, N, N)
        How far each entry may be from exact.
    edges : ndarray of int, shape (edges, 3)
        (node, next node, mode taken at the node), all that are admissible. A block of kind "paths" has one P for
        each node, a "tree" one for each or one for all.
    blocks : sequence of Block
        In an order in which none depends on a later one.
    """
    unusable = _unusable(F, error, edges, blocks)
    if unusable:
        return failed(unusable)
    number = np.zeros(F.shape[1], dtype=np.intp)
    for i, block in enumerate(blocks):
        number[list(block.states)] = i
    later = number[:, None] < number[None, :]
    used = np.unique(edges[:, 2])
    if np.any(F[used][:, later]) or np.any(error[used][:, later]):
        return failed("a block depends on a later one")
    results, allowance = [], _Allowance()
    for block in blocks:
        own = np.ix_(range(len(F)), block.states, block.states)
        results.append(_block(F[own], error[own], edges, block, allowance))
        if not results[-1].passed:
            return results[-1]
    return min(results, key=lambda v: v.margin / v.rounding if v.rounding > 0.0 else math.inf)


def _unusable(F: Matrix, error: Matrix, edges: NDArray[np.intp], blocks: Sequence[Block]) -> str:
    """Return why the blocks make no sense; empty if they do."""
    if not (np.isfinite(F).all() and np.abs(F).max(initial=0.0) < MOST and np.all((error >= 0.0) & (error < MOST))):
        return "a number of the loop is too large to be computed with"
    if not len(edges):
        return "there is no transition"
    if sorted(state for block in blocks for state in block.states) != list(range(F.shape[1])):
        return "the blocks are not a partition of the states"
    nodes = int(edges[:, :2].max()) + 1
    for block in blocks:
        n, counts = len(block.states), {"quadratic": (1,), "tree": (1, nodes), "paths": (nodes,)}.get(block.kind)
        if counts is None:
            return f"there is no proof of the kind {block.kind!r}"
        if block.P.shape not in [(count, n, n) for count in counts]:
            return f"expected {counts[-1]} matrices of size {n} for a block of kind {block.kind}"
        if not (np.isfinite(block.P).all() and np.array_equal(block.P, block.P.transpose(0, 2, 1))):
            return "a matrix of a block is not symmetric"
        if np.einsum("kii->ki", block.P).min() < LEAST or np.abs(block.P).max() > MOST:
            return "a matrix of a block is not positive definite, or too small or too large to be computed with"
    return ""


def _block(F: Matrix, error: Matrix, edges: NDArray[np.intp], block: Block, allowance: _Allowance) -> Verification:
    """Check one block by its own part of F."""
    results = [definite(P, np.zeros_like(P), "a matrix of a block is not positive definite") for P in block.P]
    with np.errstate(over="ignore", invalid="ignore", under="ignore"):
        if all(result.passed for result in results):
            if block.kind == "tree":
                results.append(_tree(F, error, edges, block.P, allowance))
            elif block.kind == "paths":
                results += [_falls(F[k], error[k], block.P[i], block.P[j]) for i, j, k in edges.tolist()]
            else:
                results += [_falls(F[k], error[k], block.P[0], block.P[0]) for k in np.unique(edges[:, 2])]
    return min(results, key=lambda v: (v.passed, v.margin / v.rounding if v.rounding > 0.0 else -math.inf))


def _falls(F: Matrix, error: Matrix, P: Matrix, after: Matrix) -> Verification:
    """Return whether F'P⁺F ≺ P."""
    size, weight = np.abs(F), np.abs(after)
    matrix = P - F.T @ after @ F
    bound = error.T @ weight @ (size + error) + size.T @ weight @ error
    bound += (2 * len(F) + 4) * EPS * (size.T @ weight @ size + np.abs(P))
    return definite((matrix + matrix.T) / 2, 1.01 * bound + UNDERFLOW, "a quadratic form does not fall in every sample")


class _Steps(NamedTuple):
    """The matrix of each edge, from norm to norm, and bounds on its 2-norm and on that of its error."""

    edges: NDArray[np.intp]
    X: Matrix
    norm: Matrix
    error: Matrix


class _Products(NamedTuple):
    """Products Π, bounds on the 2-norms of their errors, the nodes they have reached, and their length in samples."""

    X: Matrix
    error: Matrix
    at: NDArray[np.intp]
    length: int

    def part(self, which: slice | NDArray[np.bool_]) -> _Products:
        return _Products(self.X[which], self.error[which], self.at[which], self.length)


def _tree(F: Matrix, error: Matrix, edges: NDArray[np.intp], P: Matrix, allowance: _Allowance) -> Verification:
    """Grow the admissible products until each is pruned, depth-first, the modes with equal matrices as one.

    With one P a product starts at any node; with a P for each, at each, and its norm is from its node to its last.
    """
    both = np.concatenate([F, error], axis=1).reshape(len(F), -1)
    _, first, same = np.unique(both, axis=0, return_index=True, return_inverse=True)
    edges = np.unique(np.column_stack([edges[:, :2], same.reshape(-1)[edges[:, 2]]]), axis=0)
    starts = np.unique(edges[:, 0])
    if len(P) == 1:
        read = _subsets(edges)
        if read is None:
            return failed("the graph leads to more sets of nodes than can be kept")
        edges, starts, P = read, np.zeros(1, dtype=np.intp), np.repeat(P, int(read[:, :2].max()) + 1, axis=0)
    steps = _in_norms(F[first], error[first], edges, P)
    if steps is None:
        return failed("a norm is too far from well conditioned")
    n = F.shape[1]
    batch = max(1, _BATCH // (len(edges) * n * n))
    stack = [_Products(np.repeat(np.eye(n)[None], len(starts), axis=0), np.zeros(len(starts)), starts, 0)]
    worst = Verification(True, 1.0, 0.0, "")
    while stack:
        top = stack.pop()
        if len(top.X) > batch:
            stack.append(top.part(slice(0, -batch)))
        grown = _grown(steps, top.part(slice(-batch, None)))
        allowed = allowance.take(len(grown.X), n)
        usable = np.isfinite(grown.X).all() and np.isfinite(grown.error).all()
        if not allowed or top.length >= MAX_DEPTH or not usable:
            return failed("the tree of products does not end")
        norm = _norms(grown)
        short = norm + grown.error < 1.0
        if short.any():
            tight = int(np.argmax(np.where(short, norm + grown.error, 0.0)))
            here = Verification(True, 1.0 - float(norm[tight]), float(grown.error[tight]), "")
            worst = min(worst, here, key=lambda v: v.margin - v.rounding)
        if not short.all():
            stack.append(grown.part(~short))
    return worst


def _grown(steps: _Steps, products: _Products) -> _Products:
    """Return every product longer by one sample: |X̂Π̂ − fl(XΠ)| ≤ |X̂| |Π̂ − Π| + |X̂ − X| |Π| + n eps |X|_F |Π|_F."""
    n = products.X.shape[1]
    size = np.sqrt(np.sum(products.X**2, axis=(1, 2)))
    parts = []
    for (node, after, _), X, norm, error in zip(*steps, strict=True):
        here = products.at == node
        rounding = (error + (n + 2) * EPS * np.linalg.norm(X)) * size[here]
        longer = 1.001 * rounding + norm * products.error[here] * (1.0 + 8 * EPS) + UNDERFLOW
        parts.append((X @ products.X[here], longer, np.full(len(longer), after)))
    grown, bounds, at = (np.concatenate(part) for part in zip(*parts, strict=True))
    return _Products(grown, bounds, at, products.length + 1)


def _in_norms(F: Matrix, error: Matrix, edges: NDArray[np.intp], P: Matrix) -> _Steps | None:
    """Return S⁺ F S⁻¹ of every edge for S'S near P at its node and S⁺ at the next.

    Any nonsingular S is a norm |S x|: S itself counts, not how near S'S is to P.
    """
    n = P.shape[1]
    tiny = (n + 4) * EPS
    unit = np.exp2(np.rint(np.log2(np.einsum("kii->ki", P)) / 2))
    try:
        S = np.linalg.cholesky(P / unit[:, :, None] / unit[:, None, :]).transpose(0, 2, 1)
        Z = np.linalg.inv(S)
    except np.linalg.LinAlgError:
        return None
    residual = np.linalg.norm(np.eye(n) - S @ Z, axis=(1, 2))
    residual += tiny * np.linalg.norm(np.abs(S) @ np.abs(Z) + np.eye(n), axis=(1, 2))
    if not residual.max() < 0.5:
        return None
    inverse = 1.01 * np.linalg.norm(Z, axis=(1, 2)) / (1.0 - residual)  # no less than the norm of S⁻¹
    node, after, a = edges.T
    step = F[a] * unit[after][:, :, None] / unit[node][:, None, :]
    off = error[a] * unit[after][:, :, None] / unit[node][:, None, :]
    X = S[after] @ step @ Z[node]
    gap = np.abs(S[after] @ step - X @ S[node]) + np.abs(S[after]) @ off + UNDERFLOW
    gap += tiny * (np.abs(S[after]) @ np.abs(step) + np.abs(X) @ np.abs(S[node]))
    far = 1.01 * inverse[node] * np.linalg.norm(gap, axis=(1, 2))
    if not (np.isfinite(X).all() and np.isfinite(far).all()):
        return None
    norm = np.linalg.norm(X, 2, axis=(1, 2)) * (1.0 + _SAFETY * n * n * EPS) + far
    return _Steps(edges, X, np.asarray(norm), np.asarray(far))


def _norms(products: _Products) -> Matrix:
    """Return upper bounds on the 2-norms: Frobenius', the 32nd root of |(Π'Π)^16|_F, singular values between those.

    Where the norm is surely not below 1 the bound may be left coarse.
    """
    product, bound = products.X, products.error
    n = product.shape[1]
    squares = np.sum(product**2, axis=1)
    norms = np.sqrt(np.sum(squares, axis=1))
    unsure = np.flatnonzero((norms + bound >= 0.99) & (squares.max(axis=1) <= 1.01))
    power = product[unsure].transpose(0, 2, 1) @ product[unsure]
    for _ in range(4):
        power = power @ power
    norms[unsure] = np.sum(power**2, axis=(1, 2)) ** (1.0 / 64)
    near = unsure[(norms[unsure] + bound[unsure] >= 0.999) & (norms[unsure] <= 1.01 * n ** (1.0 / 64))]
    if len(near):
        norms[near] = np.linalg.svd(product[near], compute_uv=False)[:, 0]
    return np.asarray(norms * (1.0 + _SAFETY * n * n * EPS), dtype=np.float64)


def _subsets(edges: NDArray[np.intp]) -> NDArray[np.intp] | None:
    """Return the graph of the sets of nodes that walks can have reached, from set 0 of all; edges as those given.

    None where there are more than MAX_SETS.
    """
    leads: dict[tuple[int, int], set[int]] = {}
    for node, after, a in edges.tolist():
        leads.setdefault((node, a), set()).add(after)
    sets = [frozenset(edges[:, 0].tolist())]
    number = {sets[0]: 0}
    found: list[tuple[int, int, int]] = []
    for i, nodes in enumerate(sets):  # grows while it is read
        onward: dict[int, set[int]] = {}
        for (node, a), afters in leads.items():
            if node in nodes:
                onward.setdefault(a, set()).update(afters & sets[0])
        for a, afters in onward.items():
            reached = frozenset(afters)
            if reached and reached not in number:
                number[reached] = len(sets)
                sets.append(reached)
            if reached:
                found.append((i, number[reached], a))
        if len(sets) > MAX_SETS:
            return None
    return np.array(found, dtype=np.intp).reshape(-1, 3)
