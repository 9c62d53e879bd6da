"""The tree of admissible products: all of them contract after finitely many samples, in the norm of quadratic forms.

A product is grown sample by sample and pruned as soon as its norm is below 1. Where no product is left, every
admissible product is a chain of pruned ones and a remainder of bounded length: the loop is exponentially stable. With
F/γ in place of F the same proves a bound γ on the joint spectral radius.

With one form for all nodes a product starts at any node, and what may follow is the set of nodes it can have reached
(the subset construction), so that no sequence of matrices is grown twice. With a form for each node, ‖Π‖ is taken from
the norm of the node where the product starts to that of the node where it ends. Growth is depth-first, a batch of
products at a time: memory stays bounded, and the answer depends on the number of products alone.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gains.model import Matrix

__all__ = ["Tree", "grow", "in_forms", "subset_graph"]

MARGIN = 1e-9  # a product is pruned below 1 − MARGIN, so that rounding cannot bring it back in verification
_DEEPEST = 2000  # samples after which a product that has not contracted is given up
_BATCH = 1 << 18  # entries of the products that are grown at once
_SQUARINGS = 4


class Tree(NamedTuple):
    """What growing products came to.

    Attributes
    ----------
    closed : bool
        Whether every product was pruned: stable, with joint spectral radius at most ``upper``.
    upper : float
        The largest bound γ ‖Π‖^(1/length) of the pruned products where closed; infinite otherwise.
    products : int
        Products grown.
    depth : int
        Samples of the longest.
    """

    closed: bool
    upper: float
    products: int
    depth: int


def subset_graph(edges: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the graph whose walks from node 0 are the sequences of matrices of all walks, each sequence once.

    A node stands for the set of nodes that can have been reached; node 0 is the set of all.

    Parameters
    ----------
    edges : ndarray of int, shape (edges, 3)
        (node, next node, matrix of the sample between); so is what is returned.
    """
    leads: dict[tuple[int, int], set[int]] = {}
    for node, after, a in edges.tolist():
        leads.setdefault((node, a), set()).add(after)
    everywhere = frozenset(node for node, _ in leads)
    number, pending = {everywhere: 0}, [everywhere]
    found = []
    for i, nodes in enumerate(pending):  # grows while it is read
        for a in sorted({a for node, a in leads if node in nodes}):
            reached = frozenset(b for node in nodes for b in leads.get((node, a), ())) & everywhere
            if reached and reached not in number:
                number[reached] = len(pending)
                pending.append(reached)
            if reached:
                found.append((i, number[reached], a))
    return np.array(found, dtype=np.intp).reshape(-1, 3)


def grow(F: Matrix, edges: NDArray[np.intp], P: Matrix, limit: int, gamma: float = 1.0) -> Tree:
    """Grow the products of F/γ, pruning in the norms of P, until none is left or ``limit`` is reached.

    Parameters
    ----------
    F : ndarray, shape (matrices, n, n)
    edges : ndarray of int, shape (edges, 3)
        (node, next node, matrix of the sample between).
    P : ndarray, shape (1 or nodes, n, n)
        P ≻ 0: one for all nodes, or one for each.
    limit : int
        Products grown at most, but for those of the last batch.
    gamma : float
    """
    n = F.shape[1]
    one = len(P) == 1
    arcs = subset_graph(edges) if one else edges
    starts = np.zeros(1, dtype=np.intp) if one else np.unique(edges[:, 0])
    steps = in_forms(F, arcs, P) / gamma
    leaving = [np.flatnonzero(arcs[:, 0] == node) for node in range(int(arcs[:, :2].max()) + 1)]
    batch = max(1, _BATCH // (max(len(out) for out in leaving) * n * n))
    stack = [(np.repeat(np.eye(n)[None], len(starts), axis=0), starts, 0)]
    products, deepest, upper = 0, 0, 0.0
    while stack:
        if products >= limit or deepest >= _DEEPEST:
            return Tree(False, math.inf, products, deepest)
        parents, at, depth = stack.pop()
        if len(parents) > batch:
            stack.append((parents[:-batch], at[:-batch], depth))
            parents, at = parents[-batch:], at[-batch:]
        chosen = [(out, parents[at == node]) for node, out in enumerate(leaving)]
        children = np.concatenate([(steps[out, None] @ own).reshape(-1, n, n) for out, own in chosen])
        at = np.concatenate([np.repeat(arcs[out, 1], len(own)) for out, own in chosen])
        products, depth = products + len(children), depth + 1
        norms = _norms(children)
        left = norms >= 1.0 - MARGIN
        upper = max(upper, float(np.max(norms[~left], initial=0.0)) ** (1.0 / depth))
        deepest = max(deepest, depth)
        if left.any():
            stack.append((children[left], at[left], depth))
    return Tree(True, gamma * upper, products, deepest)


def in_forms(F: Matrix, edges: NDArray[np.intp], P: Matrix) -> Matrix:
    """Return S⁺ F S⁻¹ of every edge, with S'S = P at its node and S⁺ at the next: parameters as of :func:`grow`.

    Raises
    ------
    numpy.linalg.LinAlgError
        When a P is not positive definite.
    """
    S = np.linalg.cholesky(P).transpose(0, 2, 1)
    node, after, a = edges.T if len(P) > 1 else (0 * edges[:, 0], 0 * edges[:, 1], edges[:, 2])
    turned = np.linalg.solve(S[node].transpose(0, 2, 1), (S[after] @ F[a]).transpose(0, 2, 1))
    return np.asarray(turned.transpose(0, 2, 1), dtype=np.float64)


def _norms(products: Matrix) -> Matrix:
    """Return upper bounds on the 2-norms that are below 1 exactly where the norms are, but for rounding.

    From ‖G^q‖_F^(1/2q) ≥ ‖Π‖ with G = Π'Π, q = 2^_SQUARINGS, which exceeds ‖Π‖ by n^(1/4q) at most; eigenvalues
    decide where that is not enough.
    """
    n = products.shape[1]
    squares = np.sum(products**2, axis=1)
    bounds = np.sqrt(np.sum(squares, axis=1))
    open_ = np.flatnonzero((bounds >= 1.0 - MARGIN) & (squares.max(axis=1) < 1.0))
    gram = products[open_].transpose(0, 2, 1) @ products[open_]
    power = gram
    for _ in range(_SQUARINGS):
        power = power @ power
    exponent = 0.5 / 2**_SQUARINGS
    bounds[open_] = np.sum(power**2, axis=(1, 2)) ** (exponent / 2)
    near = (bounds[open_] >= 1.0 - MARGIN) & (bounds[open_] <= n ** (exponent / 2))
    bounds[open_[near]] = np.sqrt(np.linalg.eigvalsh(gram[near])[:, -1])
    return np.asarray(bounds, dtype=np.float64)
