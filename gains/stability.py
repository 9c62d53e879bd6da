"""Stability under every admissible switching of the delay, proved: the cheapest proof that there is.

    contraction   ρ(|A| + |B K1|) < 1: stable for every bounded delay
    quadratic     one P for all modes of a diagonal block; for a single matrix from the Lyapunov equation
    tree          every admissible product contracts in the norm of the best such P
    paths         one P for each path of the last M delays; else the tree in the norms of the best such P

Each is a function of its own, and :func:`steps` takes them in this order, so that a search for a witness can run
between. Where nothing is proved, a bound on the growth per sample remains. What is returned comes from floating-point
computation: :mod:`gains.verify_stability` alone makes proofs of it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from graphlib import TopologicalSorter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from gains.extremal import Tree, grow
from gains.model import GainLaw, Matrix, sets_of, spectral_radius
from gains.quadratic import Quadratic, common_quadratic, lyapunov_quadratic, node_quadratics
from gains.switched import Graph, Switched, Transitions, graph, state_loop
from gains.switched_certificate import Block

__all__ = [
    "Budget",
    "Part",
    "Stability",
    "parts_of",
    "prove",
    "prove_contraction",
    "prove_paths",
    "prove_quadratic",
    "prove_tree",
    "steps",
    "tighten",
]

_EDGE = 1e-8  # a rate within this of 1 is no proof: rounding could take it back


class Budget(NamedTuple):
    """What may be spent, by counts: the answer does not depend on the speed of the machine.

    Attributes
    ----------
    products : int
        Products of one tree; a tighter bound where nothing is proved may take as many again.
    tolerance : float
        Relative, of the best rate of one quadratic form.
    memory : int
        The most past delays that P may depend on; −1 leaves "paths" out.
    unknowns : int
        The most entries that the P of all paths may have together: the time of a solve grows with their cube.
    """

    products: int = 1_000_000
    tolerance: float = 1e-3
    memory: int = 1
    unknowns: int = 640


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A diagonal block of the loop.

    Attributes
    ----------
    states : tuple of int
        Which entries of [x; s(k−1); …; s(k−d_max)].
    F : ndarray, shape (matrices, n, n)
        Its distinct matrices.
    edges : ndarray of int, shape (edges, 3)
        (node, next node, matrix of the sample between).
    """

    states: tuple[int, ...]
    F: Matrix
    edges: NDArray[np.intp]


@dataclass(frozen=True, slots=True, eq=False)
class Stability:
    """How far stability is proved.

    Attributes
    ----------
    contraction : ndarray or None, shape (nx,)
        v > 0 with (|A| + |B K1|) v < v.
    blocks : tuple of Block
        The proof of each diagonal block, in an order in which none depends on a later one; empty until all are proved.
    memory : int
        Past delays that the nodes of the blocks' graph know.
    upper : float
        No admissible product grows faster per sample in the long run; infinite until something is known.
    products, solves : int
        Spent on trees and on semidefinite programs.
    """

    contraction: Matrix | None = None
    blocks: tuple[Block, ...] = ()
    memory: int = 0
    upper: float = math.inf
    products: int = 0
    solves: int = 0

    @property
    def proved(self) -> bool:
        """Whether there is a proof."""
        return self.contraction is not None or bool(self.blocks)


def prove(switched: Switched, law: GainLaw, transitions: Transitions, budget: Budget | None = None) -> Stability:
    """Return the first proof of stability, or the best bound; parameters as of :func:`steps`."""
    found = Stability()
    for found in steps(switched, law, transitions, budget):  # noqa: B007  # the last is the answer
        pass
    return found


def steps(
    switched: Switched, law: GainLaw, transitions: Transitions, budget: Budget | None = None
) -> Iterator[Stability]:
    """Yield what is known after each step, until there is a proof or nothing is left to try.

    The steps: contraction, quadratic, tree, paths, a tighter bound.

    Parameters
    ----------
    switched : Switched
        The reference and v are left out.
    law : Gains or Schedule
    transitions : {"any", "fifo"}
    budget : Budget, optional
    """
    budget = budget or Budget()
    v = prove_contraction(law)
    if v is not None:
        d_max = max(mode.d for mode in switched.modes)
        yield Stability(contraction=v, upper=_contraction(law, v) ** (1.0 / (d_max + 1)))
        return
    yield Stability()
    search = _Search(switched, law, transitions, budget)
    for step in (search.quadratics, search.trees, search.paths, search.tighten):
        step()
        yield search.found()
        if search.found().proved:
            return


def prove_contraction(law: GainLaw) -> Matrix | None:
    """Return v > 0 with M v < v, M = |A| + max |B K1| over the sets: (I − M) v = 1; None unless ρ(M) < 1."""
    M = _majorant(law)
    try:
        v = np.asarray(np.linalg.solve(np.eye(len(M)) - M, np.ones(len(M))), dtype=np.float64)
    except np.linalg.LinAlgError:
        return None
    if not (np.isfinite(v).all() and np.all(v > 0.0)):
        return None
    return v if _contraction(law, v) < 1.0 - _EDGE else None


def parts_of(switched: Switched, walks: Graph) -> tuple[Part, ...]:
    """Return the diagonal blocks of the state loop in an order in which none depends on a later one.

    They are the strongly connected components of the entries that are not zero in every mode.
    """
    F = np.asarray(state_loop(switched).F)
    used = np.unique(walks.edges[:, 2])
    pattern = np.any(F[used] != 0.0, axis=0)
    count, label = connected_components(pattern, directed=True, connection="strong")
    depends: dict[int, set[int]] = {i: set() for i in range(count)}
    for row, column in np.argwhere(pattern):
        if label[row] != label[column]:
            depends[int(label[row])].add(int(label[column]))
    parts = []
    for i in TopologicalSorter(depends).static_order():
        states = np.flatnonzero(label == i)
        own = F[np.ix_(used, states, states)]
        distinct, which = np.unique(own.reshape(len(used), -1), axis=0, return_inverse=True)
        letter = np.zeros(len(F), dtype=np.intp)
        letter[used] = which.reshape(-1)
        edges = np.unique(np.column_stack([walks.edges[:, :2], letter[walks.edges[:, 2]]]), axis=0)
        parts.append(Part(tuple(int(s) for s in states), distinct.reshape(-1, len(states), len(states)), edges))
    return tuple(parts)


def prove_quadratic(part: Part, tolerance: float = 1e-3) -> Quadratic:
    """Return one quadratic form for all matrices of a block; a proof where its rate is below 1."""
    if len(part.F) == 1:
        found = lyapunov_quadratic(part.F[0])
        if found is not None and found.rate < 1.0 - _EDGE:
            return found
    return common_quadratic(part.F, tolerance)


def prove_tree(part: Part, P: Matrix, products: int, gamma: float = 1.0) -> Tree:
    """Grow the products of a block over γ in the norms of P; a proof where the tree closes with γ = 1.

    P has shape (1, n, n), or (nodes, n, n) for a norm of each node.
    """
    return grow(part.F, part.edges, P, products, gamma)


def prove_paths(part: Part, form: Quadratic, trials: int = 4) -> Quadratic | None:
    """Return one quadratic form for each node that falls along every edge; a proof where the rate is below 1.

    None where none of a rate below that of ``form`` was found.
    """
    return node_quadratics(part.F, part.edges, 1.0 - 1e-4, form.rate, trials)


def tighten(part: Part, form: Quadratic, products: int, low: float = 1.0) -> tuple[float, int]:
    """Return a bound on the growth below the rate of quadratic forms, by trees of F/γ, and the products spent.

    Parameters
    ----------
    part : Part
    form : Quadratic
    products : int
        In all.
    low : float
        The growth is known, or taken, not to lie below.
    """
    upper, spent, trials = form.rate, 0, 4
    for _ in range(trials):
        if upper < low * (1.0 + 1e-4):
            break
        gamma = math.sqrt(low * upper)
        tree = prove_tree(part, form.P, products // trials, gamma)
        spent += tree.products
        upper, low = (min(upper, tree.upper), low) if tree.closed else (upper, gamma)
    return upper, spent


class _Search:
    """The steps on one loop, and what they have found."""

    def __init__(self, switched: Switched, law: GainLaw, transitions: Transitions, budget: Budget) -> None:
        self.switched, self.law, self.transitions, self.budget = switched, law, transitions, budget
        self.parts = parts_of(switched, graph(switched, law, transitions))
        self.forms: list[Quadratic] = []
        self.tightest: dict[int, tuple[Part, Quadratic]] = {}
        self.blocks: dict[int, Block] = {}
        self.uppers = [math.inf] * len(self.parts)
        self.memory = self.products = self.solves = 0
        self.radii = [_largest_radius(part) for part in self.parts]
        self.hopeless = max(self.radii) >= 1.0

    def found(self) -> Stability:
        """Return the state of the search."""
        proved = len(self.blocks) == len(self.parts)
        return Stability(
            blocks=tuple(self.blocks[i] for i in range(len(self.parts))) if proved else (),
            memory=self.memory,
            upper=max(self.uppers),
            products=self.products,
            solves=self.solves,
        )

    def quadratics(self) -> None:
        for i, part in enumerate(self.parts):
            form = prove_quadratic(part, self.budget.tolerance)
            self.forms.append(form)
            self.solves += form.solves
            self.uppers[i] = form.rate
            self.tightest[i] = part, form
            if form.rate < 1.0 - _EDGE:
                self.blocks[i] = Block(part.states, "quadratic", 0, form.P)

    def trees(self) -> None:
        for i, part in () if self.hopeless else self._open():
            tree = prove_tree(part, self.forms[i].P, self.budget.products)
            self.products += tree.products
            if tree.closed:
                self.uppers[i] = tree.upper
                self.blocks[i] = Block(part.states, "tree", 0, self.forms[i].P)

    def paths(self) -> None:
        """Try more and more memory for what is open; the blocks of one proof share its graph."""
        for memory in range(0 if self.hopeless else self.budget.memory + 1):
            parts = parts_of(self.switched, graph(self.switched, self.law, self.transitions, memory))
            proved = dict(self.blocks)
            for i, _ in self._open():
                block = self._by_paths(parts[i], i, memory)
                if block is None:
                    break
                proved[i] = block
            if len(proved) == len(self.parts):
                self.blocks, self.memory = proved, memory
                return

    def _by_paths(self, part: Part, i: int, memory: int) -> Block | None:
        """Return the proof of a block by one form for each path, or by a tree in their norms."""
        n = len(part.states)
        if (int(part.edges[:, 0].max()) + 1) * n * (n + 1) // 2 > self.budget.unknowns:
            return None
        several = prove_paths(part, self.forms[i])
        if several is None:
            return None
        self.solves += several.solves
        self.uppers[i] = min(self.uppers[i], several.rate)
        if several.rate < self.tightest[i][1].rate:
            self.tightest[i] = part, several
        if several.rate < 1.0 - _EDGE:
            return Block(part.states, "paths", memory, several.P)
        tree = prove_tree(part, several.P, self.budget.products)
        self.products += tree.products
        self.uppers[i] = min(self.uppers[i], tree.upper)
        return Block(part.states, "tree", memory, several.P) if tree.closed else None

    def tighten(self) -> None:
        for i, _ in self._open():
            upper, spent = tighten(*self.tightest[i], self.budget.products, max(1.0, self.radii[i]))
            self.uppers[i] = min(self.uppers[i], upper)
            self.products += spent

    def _open(self) -> Iterator[tuple[int, Part]]:
        """Yield the blocks that are without a proof."""
        for i, part in enumerate(self.parts):
            if i not in self.blocks:
                yield i, part


def _largest_radius(part: Part) -> float:
    """Return the largest spectral radius of a matrix that can repeat without end: from 1 on there is no proof."""
    node, after, a = part.edges.T
    return max((spectral_radius(part.F[i]) for i in np.unique(a[node == after])), default=0.0)


def _majorant(law: GainLaw) -> Matrix:
    """Return |A| + max |B K1|."""
    model = law.model
    delayed: Matrix = np.max([np.abs(model.B @ own.K1) for own in sets_of(law)], axis=0)
    return np.abs(model.A) + delayed


def _contraction(law: GainLaw, v: Matrix) -> float:
    """Return the largest (M v)_i / v_i."""
    return float(np.max(_majorant(law) @ v / v))
