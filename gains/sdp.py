"""Semidefinite programs: the only door to Clarabel and cvxpy. Blocks in; status, values, duals, residuals out.

A program is stated by a function of its variables that returns a cost and blocks. The function is evaluated
once with :class:`Affine` expressions, which carry the coefficient of every entry of every variable as a stack
of matrices; the stack is the solver's operator, scaled and reordered. The block functions stay the single
source of truth, and nothing is compiled that has to be kept in step with them. What depends on the shapes
alone (basis matrices, index maps) is computed once per shape.

The ``cvxpy`` backend evaluates the same function with cvxpy's expressions: slower, and the reference.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import clarabel
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from gains.lmi import Block, Blocks
from gains.model import Matrix

__all__ = [
    "Affine",
    "Backend",
    "Cones",
    "Program",
    "Raw",
    "Solution",
    "Statement",
    "Status",
    "Variable",
    "packing",
    "solve",
    "solve_cones",
]

Backend = Literal["clarabel", "cvxpy"]
_SQRT2 = math.sqrt(2.0)
_clock = time.perf_counter  # noqa: TID251  # what a solve costs is reported; no answer depends on it


class Status(Enum):
    """How a solve ended. Only OPTIMAL is a solution, and only verification makes it a proof."""

    OPTIMAL = "optimal"
    INFEASIBLE = "infeasible"
    UNBOUNDED = "unbounded"
    INACCURATE = "inaccurate"  # "almost" solved, infeasible or unbounded
    FAILED = "failed"


class Variable(NamedTuple):
    """A variable of a program: a matrix of shape (rows, columns), symmetric or free; (1, 1) is a number."""

    rows: int = 1
    columns: int = 1
    symmetric: bool = False


@dataclass(frozen=True, slots=True)
class Program:
    """Minimise ``cost`` subject to every entry of ``negative`` ⪯ 0 and of ``positive`` ⪰ 0.

    Attributes
    ----------
    cost : Block
        A number, (1, 1).
    negative : sequence of Blocks
        Symmetric, as the functions of :mod:`gains.lmi` return them.
    positive : sequence of Block
        Symmetric matrices, or numbers.
    """

    cost: Block
    negative: Sequence[Blocks]
    positive: Sequence[Block] = ()


Statement = Callable[[Mapping[str, Block]], Program]


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """What the solver returned.

    Attributes
    ----------
    status : Status
    value : float
        The cost reached; NaN without a solution.
    values : Mapping[str, ndarray]
        The variables, whatever the status; NaN where the solver has none.
    duals : tuple of ndarray
        One Z ⪰ 0 for each entry of ``negative``: with M the entry as a function of the data,
        d(cost)/d(data) = ⟨Z, dM/d(data)⟩ at the optimum. Zero rows where an entry has blocks without rows.
    residual : float
        The larger of the solver's primal and dual residuals.
    gap : float
        Primal minus dual cost, absolute.
    iterations : int
    setup_s : float
        Wall time outside the solver: stating, assembling, reading back.
    solver_s : float
        Wall time inside it.
    detail : str
        The solver's own word for the status.
    """

    status: Status
    value: float
    values: Mapping[str, Matrix]
    duals: tuple[Matrix, ...]
    residual: float
    gap: float
    iterations: int
    setup_s: float
    solver_s: float
    detail: str


class Affine:
    """An affine matrix expression: a constant and, for each variable, a stack of coefficients.

    Parameters
    ----------
    constant : ndarray, shape (r, c)
    parts : dict of str to ndarray, shape (entries of the variable, r, c)
    """

    __array_ufunc__ = None  # numpy leaves "array @ expression" to this class
    __slots__ = ("constant", "parts")

    def __init__(self, constant: Matrix, parts: dict[str, NDArray[np.float64]]) -> None:
        self.constant = constant
        self.parts = parts

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and columns."""
        return self.constant.shape

    @property
    def T(self) -> Affine:
        """The transpose."""
        return Affine(self.constant.T, {k: v.transpose(0, 2, 1) for k, v in self.parts.items()})

    def __matmul__(self, other: Affine | Matrix) -> Affine:
        if isinstance(other, Affine):
            return NotImplemented  # a product of two is not affine
        return Affine(self.constant @ other, {k: v @ other for k, v in self.parts.items()})

    def __rmatmul__(self, other: Matrix) -> Affine:
        return Affine(other @ self.constant, {k: other @ v for k, v in self.parts.items()})

    def __mul__(self, other: Affine | Matrix | float) -> Affine:
        if isinstance(other, Affine):
            return NotImplemented
        return Affine(self.constant * other, {k: v * other for k, v in self.parts.items()})

    __rmul__ = __mul__

    def __truediv__(self, other: float) -> Affine:
        return self * (1.0 / other)

    def __neg__(self) -> Affine:
        return self * -1.0

    def __add__(self, other: Affine | Matrix | float) -> Affine:
        if not isinstance(other, Affine):
            return Affine(self.constant + other, self.parts)
        parts = dict(self.parts)
        for k, v in other.parts.items():
            parts[k] = parts[k] + v if k in parts else v
        return Affine(self.constant + other.constant, parts)

    __radd__ = __add__

    def __sub__(self, other: Affine | Matrix | float) -> Affine:
        return self + (-other)

    def __rsub__(self, other: Matrix | float) -> Affine:
        return -self + other


def solve(variables: Mapping[str, Variable], statement: Statement, backend: Backend = "clarabel") -> Solution:
    """Solve the program that ``statement`` returns for the given variables.

    Parameters
    ----------
    variables : Mapping[str, Variable]
    statement : Statement
        Called once, with an expression for each variable.
    backend : {"clarabel", "cvxpy"}
    """
    return _solve_cvxpy(variables, statement) if backend == "cvxpy" else _solve_clarabel(variables, statement)


# -- direct assembly for Clarabel


class Assembled(NamedTuple):
    """Minimise q'x subject to b − A x in the cones: Clarabel's standard form.

    ``negative`` holds the rows and the size of each entry of :attr:`Program.negative`, in order.
    """

    q: NDArray[np.float64]
    A: sparse.csc_matrix
    b: NDArray[np.float64]
    cones: list[Any]
    negative: list[tuple[slice, int]]


class Cones(NamedTuple):
    """Minimise q'x subject to b − A x ∈ a product of cones of semidefinite matrices, assembled by the caller.

    Attributes
    ----------
    q : ndarray, shape (variables,)
    A : sparse matrix, shape (rows, variables)
    b : ndarray, shape (rows,)
    sizes : sequence of int
        Sizes of the matrices, in the order of their rows, each in the packed form of :func:`packing`.
    """

    q: NDArray[np.float64]
    A: sparse.csc_matrix
    b: NDArray[np.float64]
    sizes: Sequence[int]


class Raw(NamedTuple):
    """What the solver returned for :class:`Cones`.

    Attributes
    ----------
    status : Status
    x : ndarray
    duals : list of ndarray
        One Z ⪰ 0 for each cone.
    accuracy : float
        The larger of the residuals and of the gap relative to the cost.
    solver_s : float
    detail : str
        The solver's own word for the status.
    """

    status: Status
    x: NDArray[np.float64]
    duals: list[Matrix]
    accuracy: float
    solver_s: float
    detail: str


def solve_cones(problem: Cones, tolerance: float = 1e-8) -> Raw:
    """Solve a program in Clarabel's standard form.

    Parameters
    ----------
    problem : Cones
    tolerance : float
        Relative gap and residuals at which the solver ends.
    """
    settings = _settings()
    settings.tol_gap_rel = settings.tol_feas = tolerance
    settings.tol_gap_abs = 0.1 * tolerance
    cones = [clarabel.PSDTriangleConeT(size) if size > 1 else clarabel.NonnegativeConeT(1) for size in problem.sizes]
    start = _clock()
    answer = _run(Assembled(problem.q, problem.A, problem.b, cones, []), settings)
    solver_s = _clock() - start
    ends = np.cumsum([0, *(size * (size + 1) // 2 for size in problem.sizes)])
    z = np.asarray(answer.z)
    duals = [_unpacked(z[a:e], size) for a, e, size in zip(ends, ends[1:], problem.sizes, strict=False)]
    cost, dual = float(answer.obj_val), float(answer.obj_val_dual)
    gap = abs(cost - dual) / max(abs(cost), abs(dual), np.finfo(float).tiny)
    detail = str(answer.status)
    accuracy = max(float(answer.r_prim), float(answer.r_dual), gap)
    return Raw(_STATUS.get(detail, Status.FAILED), np.asarray(answer.x), duals, accuracy, solver_s, detail)


def assemble(variables: Mapping[str, Variable], statement: Statement) -> Assembled:
    """Evaluate a statement and return Clarabel's standard form."""
    offsets: dict[str, slice] = {}
    expressions: dict[str, Block] = {}
    count = 0
    for name, variable in variables.items():
        basis = _basis(variable)
        offsets[name] = slice(count, count + len(basis))
        expressions[name] = Affine(np.zeros((variable.rows, variable.columns)), {name: basis})
        count += len(basis)
    program = statement(expressions)
    q = np.zeros(count)
    for name, part in program.cost.parts.items():
        q[offsets[name]] = part.reshape(-1)
    cones: list[Any] = []
    placed: list[tuple[slice, int]] = []
    operators: list[NDArray[np.float64]] = []
    sides: list[NDArray[np.float64]] = []
    row = 0
    pieces = [(blocks, 1.0) for blocks in program.negative] + [([[block]], -1.0) for block in program.positive]
    for blocks, sign in pieces:
        operator, side, size = _rows_of(blocks, sign, offsets, count)
        cones.append(clarabel.PSDTriangleConeT(size) if size > 1 else clarabel.NonnegativeConeT(size))
        placed.append((slice(row, row + len(side)), size))
        row += len(side)
        operators.append(operator)
        sides.append(side)
    A = sparse.csc_matrix(np.vstack(operators))
    return Assembled(q, A, np.concatenate(sides), cones, placed[: len(program.negative)])


def _rows_of(
    blocks: Blocks, sign: float, offsets: Mapping[str, slice], count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    """Return operator and right side of −sign·M(x) in the cone, in scaled packed form, and the size of M."""
    heights = [row[i].shape[0] for i, row in enumerate(blocks)]
    ends = np.concatenate([[0], np.cumsum(heights)])
    size = int(ends[-1])
    packed, weight = packing(size)
    constant = np.zeros((size, size))
    stack = np.zeros((count, size, size))
    for i, row in enumerate(blocks):
        rows = slice(ends[i], ends[i + 1])
        for j in range(i, len(row)):
            block, columns = row[j], slice(ends[j], ends[j + 1])
            if not isinstance(block, Affine):
                constant[rows, columns] = block
                continue
            constant[rows, columns] = block.constant
            for name, part in block.parts.items():
                stack[offsets[name], rows, columns] = part
    operator = stack.reshape(count, size * size)[:, packed]
    return (sign * operator * weight).T, -sign * constant.reshape(-1)[packed] * weight, size


def _solve_clarabel(variables: Mapping[str, Variable], statement: Statement) -> Solution:
    start = _clock()
    problem = assemble(variables, statement)
    settings = _settings()
    entered = _clock()
    answer = _run(problem, settings)
    left = _clock()
    x, z = np.asarray(answer.x), np.asarray(answer.z)
    values: dict[str, Matrix] = {}
    at = 0
    for name, variable in variables.items():
        basis = _basis(variable)
        values[name] = np.tensordot(x[at : at + len(basis)], basis, axes=1)
        at += len(basis)
    duals = tuple(_unpacked(z[rows], size) for rows, size in problem.negative)
    detail = str(answer.status)
    status = _STATUS.get(detail, Status.FAILED)
    return Solution(
        status=status,
        value=float(answer.obj_val) if status is Status.OPTIMAL else math.nan,
        values=values,
        duals=duals,
        residual=max(float(answer.r_prim), float(answer.r_dual)),
        gap=abs(float(answer.obj_val) - float(answer.obj_val_dual)),
        iterations=int(answer.iterations),
        setup_s=(entered - start) + (_clock() - left),
        solver_s=left - entered,
        detail=detail,
    )


def _settings() -> Any:
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.chordal_decomposition_enable = False  # the matrices are dense
    settings.direct_solve_method = "faer"  # supernodal: several times faster than the default on dense blocks
    settings.max_threads = 1
    return settings


def _run(problem: Assembled, settings: Any) -> Any:
    """Run Clarabel once; what a bare solve of the same problem costs."""
    n = len(problem.q)
    quadratic = sparse.csc_matrix((n, n))
    solver = clarabel.DefaultSolver(quadratic, problem.q, problem.A, problem.b, problem.cones, settings)
    return solver.solve()


_STATUS = {
    "Solved": Status.OPTIMAL,
    "PrimalInfeasible": Status.INFEASIBLE,
    "DualInfeasible": Status.UNBOUNDED,
    "AlmostSolved": Status.INACCURATE,
    "AlmostPrimalInfeasible": Status.INACCURATE,
    "AlmostDualInfeasible": Status.INACCURATE,
}


@lru_cache(maxsize=64)
def _basis(variable: Variable) -> NDArray[np.float64]:
    """Return the matrices that each entry of a variable multiplies, shape (entries, rows, columns)."""
    rows, columns, symmetric = variable
    if not symmetric:
        return np.eye(rows * columns).reshape(-1, rows, columns)
    i, j = np.triu_indices(rows)
    basis = np.zeros((len(i), rows, rows))
    basis[np.arange(len(i)), i, j] = basis[np.arange(len(i)), j, i] = 1.0
    return basis


@lru_cache(maxsize=64)
def packing(size: int) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Return the flat indices of the upper triangle by columns, and the weights 1 and √2 of the packed form."""
    j, i = np.tril_indices(size)
    return i * size + j, np.where(i == j, 1.0, _SQRT2)


def _unpacked(z: NDArray[np.float64], size: int) -> Matrix:
    packed, weight = packing(size)
    flat = np.zeros(size * size)
    flat[packed] = z / weight
    matrix = flat.reshape(size, size)
    return matrix + np.triu(matrix, 1).T


# -- the reference: cvxpy


def _solve_cvxpy(variables: Mapping[str, Variable], statement: Statement) -> Solution:
    import cvxpy  # slow to import, and seldom wanted

    start = _clock()
    expressions = {name: _cvxpy_variable(variable) for name, variable in variables.items()}
    program = statement(expressions)
    negative = [_cvxpy_matrix(blocks) for blocks in program.negative]
    limits = [matrix << 0 for matrix in negative]
    limits += [block >> 0 if block.ndim else block >= 0 for block in program.positive]
    problem = cvxpy.Problem(cvxpy.Minimize(program.cost), limits)
    solver_s, iterations, detail = math.nan, 0, "SolverError"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # "inaccurate" is in the status
        try:
            problem.solve(solver=cvxpy.CLARABEL)
            solver_s = float(problem.solver_stats.solve_time)
            iterations = int(problem.solver_stats.num_iters)
            detail = str(problem.status)
        except cvxpy.SolverError:
            pass
    status = _CVXPY_STATUS.get(detail, Status.FAILED)
    values = {
        name: np.full((v.rows, v.columns), math.nan)
        if expressions[name].value is None
        else np.asarray(expressions[name].value, dtype=np.float64).reshape(v.rows, v.columns)
        for name, v in variables.items()
    }
    duals = tuple(
        np.full(m.shape, math.nan) if c.dual_value is None else np.asarray(c.dual_value)
        for m, c in zip(negative, limits, strict=False)
    )
    violated = [float(np.max(c.violation())) for c in limits] if status is Status.OPTIMAL else [math.nan]
    return Solution(
        status=status,
        value=float(problem.value) if status is Status.OPTIMAL else math.nan,
        values=values,
        duals=duals,
        residual=max(violated),
        gap=math.nan,
        iterations=iterations,
        setup_s=_clock() - start - (0.0 if math.isnan(solver_s) else solver_s),
        solver_s=solver_s,
        detail=detail,
    )


def _cvxpy_variable(variable: Variable) -> Any:
    import cvxpy

    if variable == Variable():
        return cvxpy.Variable()
    return cvxpy.Variable((variable.rows, variable.columns), symmetric=variable.symmetric)


def _cvxpy_matrix(blocks: Blocks) -> Any:
    import cvxpy

    filled = [i for i, row in enumerate(blocks) if row[i].shape[0]]
    matrix = cvxpy.bmat([[blocks[i][j] for j in filled] for i in filled])
    return (matrix + matrix.T) / 2


_CVXPY_STATUS = {
    "optimal": Status.OPTIMAL,
    "infeasible": Status.INFEASIBLE,
    "unbounded": Status.UNBOUNDED,
    "optimal_inaccurate": Status.INACCURATE,
    "infeasible_inaccurate": Status.INACCURATE,
    "unbounded_inaccurate": Status.INACCURATE,
}
