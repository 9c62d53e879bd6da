"""The matrix inequalities of the method: one function per inequality, as nested lists of blocks.

Every function returns the full symmetric array of blocks of a matrix that shall be negative definite. The
blocks are built with ``@``, ``+``, ``−``, products with numbers and ``.T`` alone, so that the same function
serves numbers and the affine expressions of a solver; nothing here knows a solver.

Block order: z(k), z(k−d), d·y_m(i) with y_m(i) = z(i+1) − z(i), v; the Jensen form drops the third.
A, A1, B, C, C1 are the calligraphic matrices of Eq. (11), n = nx + nr, m = number of entries of v.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from gains.model import Augmented

__all__ = [
    "Block",
    "Blocks",
    "Loop",
    "Slack",
    "System",
    "Uncertain",
    "Weights",
    "Window",
    "corrected",
    "corrected_robust",
    "eq13",
    "eq22",
    "eq31",
    "eq31_given",
    "eq40",
    "eq40_given",
    "eq41",
    "jensen",
    "s_procedure",
    "stability",
    "standard",
]

Block = Any  # a numpy array, or an affine expression of a solver
Blocks = list[list[Block]]
Row = list[Block | None]  # None is a block of zeros


class System(NamedTuple):
    """The matrices of Eq. (10), numbers or expressions in K1 and K2."""

    A: Block
    A1: Block
    B: Block
    C: Block
    C1: Block


Loop = System | Augmented  # what has the matrices of Eq. (10)


class Uncertain(NamedTuple):
    """[ΔA ΔA1] = F Δ [J1 J2] with ‖Δ‖ ≤ 1, Eqs. (6), (7): F̄ (n, p), J̄1 and J̄2 (q, n) of section 3.

    F is scaled by the bound on ‖Δ‖.
    """

    F: Block
    J1: Block
    J2: Block


class Weights(NamedTuple):
    """P, Q, R ≻ 0 of the Lyapunov–Krasovskii functional, shape (n, n)."""

    P: Block
    Q: Block
    R: Block


class Slack(NamedTuple):
    """The free matrices Y and W, shape (n, n), and U, shape (m, n)."""

    Y: Block
    W: Block
    U: Block


class Window(NamedTuple):
    """The delays d_min ≤ d(k) ≤ d_max, samples, Eq. (5)."""

    d_min: int
    d_max: int

    @property
    def c(self) -> int:
        """Number of delays, d_max − d_min + 1."""
        return self.d_max - self.d_min + 1


def eq13(system: Loop, weights: Weights, slack: Slack, eta2: Block, window: Window) -> Blocks:
    """Return the left side of Eq. (13), Lemma 1, as printed; blocks z, z_d, dy, v."""
    A, A1, B, C, C1 = system.A, system.A1, system.B, system.C, system.C1
    P, Q, R = weights
    Y, W, U = slack
    d = window.d_max
    H = A - np.eye(A.shape[0])
    AP, A1P, RH, RB = A.T @ P, A1.T @ P, R @ H, R @ B
    S = A1P @ (A + A1)
    return _symmetric(
        [
            [
                d * (H.T @ RH) - P + window.c * Q + Y + Y.T + C.T @ C,
                AP @ (A + A1) / 2 + d * (RH.T @ A1) + W.T - Y + C.T @ C1,
                AP @ A / 2 - Y,
                AP @ B / 2 + d * (RH.T @ B) + U.T,
            ],
            [
                (S + S.T) / 2 + d * (A1.T @ R @ A1) - Q - W - W.T + C1.T @ C1,
                A1P @ A / 2 - W,
                AP @ B / 2 + A1P @ B + d * (A1.T @ RB) - U.T,
            ],
            [-R / d, AP @ B / 2 - U.T],
            [B.T @ P @ B + d * (B.T @ RB) - eta2 * np.eye(B.shape[1])],
        ]
    )


def eq22(system: Loop, weights: Weights, slack: Slack, window: Window) -> Blocks:
    """Return the left side of Eq. (22), stability only: (13) without its last row, its last column and C."""
    silent = System(system.A, system.A1, system.B, 0 * system.C, 0 * system.C1)
    return [row[:-1] for row in eq13(silent, weights, slack, 0.0, window)[:-1]]


def standard(system: Loop, weights: Weights, slack: Slack, eta2: Block, window: Window) -> Blocks:
    """Return Lemma 1 in standard form: base + G'PG + d_max H'RH + Ce'Ce; blocks z, z_d, dy, v.

    It is Eq. (13) after the change of Y by A'PA/2, of W by A1'PA/2 and of U by B'PA/2.
    """
    return _given(system, weights, _base(weights, slack, eta2, window, system.B.shape[1]), window, full=True)


def jensen(system: Loop, weights: Weights, eta2: Block, window: Window, *, full: bool = False) -> Blocks:
    """Return Lemma 1 in Jensen form, Y = −R/d_max, W = R/d_max, U = 0: the optimum of the standard form.

    Blocks z, z_d, v; with ``full`` z, z_d, dy, v, the standard form at that choice.
    """
    m = system.B.shape[1]
    if full:
        return standard(system, weights, _jensen_slack(weights, window, m), eta2, window)
    return _given(system, weights, _jensen_base(weights, eta2, window, m), window, full=False)


def stability(system: Loop, weights: Weights, window: Window) -> Blocks:
    """Return the stability part of the Jensen form, (22) with the best slack: blocks z, z_d."""
    base = _jensen_base(weights, 0.0, window, 0)[:2]
    G, H, _ = _rows(system, full=False)
    return _plus([row[:2] for row in base], [(weights.P, G[:2]), (window.d_max * weights.R, H[:2])])


def s_procedure(
    system: Loop, uncertain: Uncertain, weights: Weights, mu: Block, eta2: Block | None, window: Window
) -> Blocks:
    """Return Lemma 1 for every ‖Δ‖ ≤ 1 and given gains, linear in P, Q, R, μ = 1/λ; blocks z, z_d, v, p.

    [base 0; 0 −μI] + [G0 F̄]'P[G0 F̄] + d_max [H0 F̄]'R[H0 F̄] + [Ce 0]'[Ce 0] + μ [Jb 0]'[Jb 0] in Jensen form;
    the same as :func:`corrected_robust` by Schur complements. Without ``eta2`` stability only: blocks z, z_d, p.
    """
    F, J1, J2 = uncertain
    p = F.shape[1]
    if eta2 is None:
        base = stability(system, weights, window)
        G0: Row = [system.A, system.A1]
        H0: Row = [system.A - np.eye(system.A.shape[0]), system.A1]
    else:
        base = jensen(system, weights, eta2, window)
        G0, H0, _ = _rows(system, full=False)
    base[0][0] = base[0][0] + mu * (J1.T @ J1)
    base[0][1] = base[0][1] + mu * (J1.T @ J2)
    base[1][0] = base[0][1].T
    base[1][1] = base[1][1] + mu * (J2.T @ J2)
    PF, RF = weights.P @ F, window.d_max * (weights.R @ F)
    column = [G.T @ PF + H.T @ RF for G, H in zip(G0, H0, strict=True) if G is not None and H is not None]
    corner = F.T @ PF + F.T @ RF - mu * np.eye(p)
    return [[*row, last] for row, last in zip(base, column, strict=True)] + [[*(b.T for b in column), corner]]


def eq31(system: Loop, weights: Weights, slack: Slack, S: Block, L: Block, eta2: Block, window: Window) -> Blocks:
    """Return the left side of Eq. (31), Lemma 2, as printed; S stands for P⁻¹ and L for R⁻¹ (32).

    Blocks z, z_d, dy, v | rows of R, P, P, e. Infeasible whenever ρ(A) ≥ 1.
    """
    n, ne = system.A.shape[0], system.C.shape[0]
    rows = _printed_rows(system)
    diagonal = [L / window.d_max, S, S, np.eye(ne)]
    sizes = [n, n, n, ne]
    return _bordered(_printed_base(weights, slack, eta2, window, system), rows, _minus_diagonal(diagonal, sizes))


def eq31_given(system: Loop, weights: Weights, slack: Slack, eta2: Block, window: Window) -> Blocks:
    """Return (31) for given gains, linear in P and R: H11 + H12 diag(d_max R, P, P, I) H12'."""
    H, G1, G2, Ce = _printed_rows(system)
    P, d = weights.P, window.d_max
    base = _printed_base(weights, slack, eta2, window, system)
    return _plus(base, [(d * weights.R, H), (P, G1), (P, G2), (None, Ce)])


def eq40(
    system: Loop,
    uncertain: Uncertain,
    weights: Weights,
    slack: Slack,
    S: Block,
    L: Block,
    lam: Block,
    eta2: Block,
    window: Window,
) -> Blocks:
    """Return the left side of Eq. (40), Theorem 1, as printed: z, z_d, dy, v | R, P, P, e | three J rows."""
    F, J1, J2 = uncertain
    n, ne, p = system.A.shape[0], system.C.shape[0], J1.shape[0]
    FF = lam * (F @ F.T)
    corner = _minus_diagonal([L / window.d_max, S, S, np.eye(ne)], [n, n, n, ne])
    corner[0][0] = corner[0][0] + FF
    corner[0][1] = corner[1][0] = FF
    corner[1][1] = corner[1][1] + 2 * FF
    corner[2][2] = corner[2][2] + FF
    inner = _bordered(_printed_base(weights, slack, eta2, window, system), _printed_rows(system), corner)
    J: list[Row] = [[*row, None, None, None, None] for row in _printed_uncertain(J1, J2)]
    return _bordered(inner, J, _minus_diagonal([lam * np.eye(p)] * 3, [p] * 3))


def eq40_given(
    system: Loop, uncertain: Uncertain, weights: Weights, slack: Slack, mu: Block, eta2: Block, window: Window
) -> Blocks:
    """Return (40) for given gains, linear in P, R and μ = 1/λ; blocks z, z_d, dy, v and one p per repeated Δ."""
    F, J1, J2 = uncertain
    d, p = window.d_max, F.shape[1]
    base: Blocks = eq31_given(system, weights, slack, eta2, window)
    rows = _printed_uncertain(J1, J2)
    base = _plus(base, [(mu, row) for row in rows], scalar=True)
    H, G1, G2, _ = _printed_rows(system)
    P, R = weights.P, d * weights.R
    # the rows of R, P, P are reached by Δ through [F 0 0], [F F 0] and [0 0 F]
    into = [(R, H, [F, None, None]), (P, G1, [F, F, None]), (P, G2, [None, None, F])]
    columns = [[_cross(into, i, k, system, p) for k in range(3)] for i in range(4)]
    FRF, FPF = F.T @ R @ F, F.T @ P @ F
    corner = _symmetric(
        [
            [FRF + FPF - mu * np.eye(p), FPF, np.zeros((p, p))],
            [FPF - mu * np.eye(p), np.zeros((p, p))],
            [FPF - mu * np.eye(p)],
        ]
    )
    upper = [[*row, *columns[i]] for i, row in enumerate(base)]
    return upper + [[*(columns[i][k].T for i in range(4)), *corner[k]] for k in range(3)]


def eq41(X: Block, Y: Block) -> Blocks:
    """Return −[[X, I], [I, Y]], to be negative semidefinite, Eq. (41): X ⪰ Y⁻¹ for (R, L) and for (P, S)."""
    minus = -np.eye(X.shape[0])
    return [[-X, minus], [minus, -Y]]


def corrected(
    system: Loop, weights: Weights, slack: Slack | None, S: Block, L: Block, eta2: Block, window: Window
) -> Blocks:
    """Return the corrected Lemma 2: Schur complements on the standard form; S stands for P⁻¹, L for R⁻¹.

    Blocks z, z_d, dy, v | H | G | e; without ``slack`` the Jensen form, blocks z, z_d, v | H | G | e.
    """
    n, ne = system.A.shape[0], system.C.shape[0]
    G, H, Ce = _rows(system, full=slack is not None)
    corner = _minus_diagonal([L / window.d_max, S, np.eye(ne)], [n, n, ne])
    return _bordered(_either_base(weights, slack, eta2, window, system), [H, G, Ce], corner)


def corrected_robust(
    system: Loop,
    uncertain: Uncertain,
    weights: Weights,
    slack: Slack | None,
    S: Block,
    L: Block,
    lam: Block,
    eta2: Block,
    window: Window,
) -> Blocks:
    """Return the corrected Theorem 1: :func:`corrected` for every ‖Δ‖ ≤ 1; blocks … | H | G | e | J."""
    F, J1, J2 = uncertain
    n, ne, q = system.A.shape[0], system.C.shape[0], J1.shape[0]
    G, H, Ce = _rows(system, full=slack is not None)
    FF = lam * (F @ F.T)
    sizes = [n, n, ne, q]
    corner = _minus_diagonal([L / window.d_max, S, np.eye(ne), lam * np.eye(q)], sizes)
    corner[0][0] = corner[0][0] + FF
    corner[0][1] = corner[1][0] = FF
    corner[1][1] = corner[1][1] + FF
    J: Row = [J1, J2, *[None] * (len(G) - 2)]
    return _bordered(_either_base(weights, slack, eta2, window, system), [H, G, Ce, J], corner)


# -- the parts that the inequalities share


def _base(weights: Weights, slack: Slack, eta2: Block, window: Window, m: int) -> Blocks:
    """Return the base of section 3: what depends on neither the system nor the output."""
    P, Q, R = weights
    Y, W, U = slack
    return _symmetric(
        [
            [window.c * Q - P + Y + Y.T, W.T - Y, -Y, U.T],
            [-Q - W - W.T, -W, -U.T],
            [-R / window.d_max, -U.T],
            [-eta2 * np.eye(m)],
        ]
    )


def _jensen_slack(weights: Weights, window: Window, m: int) -> Slack:
    R = weights.R / window.d_max
    return Slack(-R, R, np.zeros((m, R.shape[0])))


def _jensen_base(weights: Weights, eta2: Block, window: Window, m: int) -> Blocks:
    """Return the base at the Jensen slack after a Schur complement on the dy block: z, z_d, v."""
    P, Q, R = weights
    zero = np.zeros((P.shape[0], m))
    Rd = R / window.d_max
    return _symmetric([[window.c * Q - P - Rd, Rd, zero], [-Q - Rd, zero], [-eta2 * np.eye(m)]])


def _either_base(weights: Weights, slack: Slack | None, eta2: Block, window: Window, system: Loop) -> Blocks:
    m = system.B.shape[1]
    return _jensen_base(weights, eta2, window, m) if slack is None else _base(weights, slack, eta2, window, m)


def _printed_base(weights: Weights, slack: Slack, eta2: Block, window: Window, system: Loop) -> Blocks:
    """Return H11 of Lemma 2: the base with P doubled."""
    base = _base(weights, slack, eta2, window, system.B.shape[1])
    base[0][0] = base[0][0] - weights.P
    return base


def _rows(system: Loop, *, full: bool) -> tuple[Row, Row, Row]:
    """Return G = [A, A1, 0, B], H = [A − I, A1, 0, B] and Ce = [C, C1, 0, 0], the third only if ``full``."""
    dy: Row = [None] if full else []
    n = system.A.shape[0]
    G: Row = [system.A, system.A1, *dy, system.B]
    H: Row = [system.A - np.eye(n), system.A1, *dy, system.B]
    return G, H, [system.C, system.C1, *dy, None]


def _printed_rows(system: Loop) -> list[Row]:
    """Return the four block columns of H12 in Lemma 2, transposed."""
    A, A1, B = system.A, system.A1, system.B
    return [
        [A - np.eye(A.shape[0]), A1, None, B],
        [A, A + A1, A, B],
        [None, A1, None, B],
        [system.C, system.C1, None, None],
    ]


def _printed_uncertain(J1: Block, J2: Block) -> list[Row]:
    """Return the rows of J̃ in Theorem 1."""
    return [[J1, J2, None, None], [None, J1, J1, None], [None, J2, None, None]]


def _given(system: Loop, weights: Weights, base: Blocks, window: Window, *, full: bool) -> Blocks:
    """Return base + G'PG + d_max H'RH + Ce'Ce."""
    G, H, Ce = _rows(system, full=full)
    return _plus(base, [(weights.P, G), (window.d_max * weights.R, H), (None, Ce)])


def _plus(base: Blocks, terms: Sequence[tuple[Block | None, Row]], *, scalar: bool = False) -> Blocks:
    """Return base + Σ G'XG over the terms (X, G); X None is the identity, or a number if ``scalar``."""
    upper = [list(row[i:]) for i, row in enumerate(base)]
    for X, row in terms:
        for j, right in enumerate(row):
            if right is None:
                continue
            weighted = right if X is None or scalar else X @ right
            for i, left in enumerate(row[: j + 1]):
                if left is None:
                    continue
                product = left.T @ weighted
                upper[i][j - i] = upper[i][j - i] + (X * product if scalar else product)
    return _symmetric(upper)


def _bordered(base: Blocks, rows: Sequence[Row], corner: Blocks) -> Blocks:
    """Return [[base, rows'], [rows, corner]]."""
    full: list[list[Block]] = []
    for row, diagonal in zip(rows, range(len(corner)), strict=True):
        height = corner[diagonal][diagonal].shape[0]
        full.append(
            [np.zeros((height, base[j][j].shape[0])) if block is None else block for j, block in enumerate(row)]
        )
    top = [[*line, *(row[i].T for row in full)] for i, line in enumerate(base)]
    return top + [[*row, *corner[k]] for k, row in enumerate(full)]


def _minus_diagonal(blocks: Sequence[Block], sizes: Sequence[int]) -> Blocks:
    return [
        [-block if i == j else np.zeros((size, sizes[j])) for j in range(len(sizes))]
        for i, (block, size) in enumerate(zip(blocks, sizes, strict=True))
    ]


def _cross(into: Sequence[tuple[Block, Row, Row]], i: int, k: int, system: Loop, p: int) -> Block:
    """Return Σ left_i' X right_k over the terms, zeros where there is none."""
    widths = [system.A.shape[0]] * 3 + [system.B.shape[1]]
    total: Block = np.zeros((widths[i], p))
    for X, lefts, rights in into:
        left, right = lefts[i], rights[k]
        if left is not None and right is not None:
            total = total + left.T @ X @ right
    return total


def _symmetric(upper: Sequence[Sequence[Block]]) -> Blocks:
    """Return the full array of blocks from the rows of its upper triangle."""
    size = len(upper)
    return [[upper[i][j - i] if i <= j else upper[j][i - j].T for j in range(size)] for i in range(size)]
