"""Where a design starts when no gains are given: delay-free LQ tracking, then the delays widened step by step.

Without delay and uncertainty an LQ law is feasible; :meth:`gains.task.Task.relaxed` leads from there to the problem
asked. On the way a few quasi-Newton steps on η keep the gains away from the edge of feasibility, where η grows
without bound, so that the next widening has room.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
from scipy.linalg import LinAlgError, solve_discrete_are

from gains import sdp
from gains.lmi import Block
from gains.model import Matrix
from gains.quasinewton import Iterate, quasi_newton
from gains.task import Gain, Task

__all__ = ["feasible", "lq_gains", "widened"]

_EFFORTS = tuple(10.0**k for k in range(-2, 9))  # weights on u tried against y, both in the task's units
_REGULAR = 1e-9  # weight on the states that y does not see, relative
_TINY = 1e-6  # relaxation below which widening has failed
_BISECTIONS = 5
_MARGIN = 0.9  # share of the feasible widening that is taken
_STEPS = 60
_ROOM = 0.9  # share of the box that starting gains keep to
_ADVANCE = 1e-3  # share of what is missing under which a widening counts as stuck
_DESCENTS = (6, 20)  # quasi-Newton iterations after a widening, and where it is stuck
_TRIES = 3  # starting gains that are widened


def lq_gains(task: Task) -> list[Matrix]:
    """Return delay-free LQ tracking gains, small effort first; on the task's affine subspace.

    K1 is the LQ feedback; K2 = Γ − K1 Π with the least-squares solution of Π Ar = A Π + B Γ, C Π + D Γ = Cr, corrected
    for zero error at constant r by the smallest change of K2.
    """
    nx, n, nu = task.nx, task.n, task.nu
    A, B, C = task.A0[:nx, :nx], task.Bu[:nx], task.C0[:, :nx]
    feed = _feedforward(task)
    state = C.T @ C
    size = max(float(np.trace(state)) / nx, np.finfo(float).tiny)
    state = state + _REGULAR * size * np.eye(nx)
    found = []
    for effort in _EFFORTS:
        weight = effort * size * np.eye(nu)
        try:
            X = solve_discrete_are(A, B, state, weight)
        except (LinAlgError, ValueError):
            continue
        K1 = -np.linalg.solve(weight + B.T @ X @ B, B.T @ X @ A)
        K = np.hstack([K1, feed[1] - K1 @ feed[0]])
        if np.all(np.isfinite(K)):
            found.append(_steady(task, K))
    return [*found, _steady(task, np.zeros((nu, n)))]


def feasible(task: Task, starts: list[Matrix]) -> list[Iterate]:
    """Return the starting gains whose η is finite, smallest first."""
    found = [Iterate(K, gain.eta) for K in starts if (gain := _gain(task, K))]
    return sorted(found, key=lambda iterate: iterate.eta)


def widened(task: Task, starts: list[Matrix]) -> Iterator[tuple[float, Iterate]]:
    """Yield (t, gains feasible for ``task.relaxed(t)``), up to t = 1 if it is reached.

    Parameters
    ----------
    task : Task
    starts : list of ndarray, shape (nu, n)
        Inside the box; those that reach furthest are widened.
    """
    reach = [(_reach(task, K, 0.0), K) for K in starts]
    for t, K in sorted(reach, key=lambda pair: -pair[0])[:_TRIES]:
        for step in _widen(task, K, t) if t > 0.0 else ():
            yield step
            if step[0] == 1.0:
                return


def _widen(task: Task, K: Matrix, t: float) -> Iterator[tuple[float, Iterate]]:
    """Widen from gains feasible at t until the problem asked, or until stuck."""
    t *= _MARGIN
    for _ in range(_STEPS):
        last = t
        for iterations in _DESCENTS:
            easier = task.relaxed(t).balanced(task.given(K))
            for reached in deque(quasi_newton(easier, easier.own(task.given(K)), iterations), maxlen=1):
                K = task.own(easier.given(reached.K))
                yield t, Iterate(K, reached.eta)
            whole = _gain(task, K)
            if whole is not None:
                yield 1.0, Iterate(K, whole.eta)
                return
            t += _MARGIN * (_reach(task, K, t) - t)
            if t - last > _ADVANCE * (1.0 - last):
                break
        else:
            return


def _reach(task: Task, K: Matrix, t: float) -> float:
    """Return about the largest relaxation at which the gains are feasible, at least t; 0 if there is none."""
    low, high = t, 1.0
    if low == 0.0:
        low = 0.5
        while _gain(task.relaxed(low), K) is None:
            high, low = low, low / 4
            if low < _TINY:
                return 0.0
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        if _gain(task.relaxed(middle), K) is None:
            high = middle
        else:
            low = middle
    return low


def _gain(task: Task, K: Matrix) -> Gain | None:
    """Return η in the units of the loop that these gains close."""
    if not task.inside(K):
        return None
    own = task.balanced(task.given(K))
    return own.gain(own.own(task.given(K)))


def _feedforward(task: Task) -> tuple[Matrix, Matrix]:
    """Return Π and Γ: x = Π xr and u = Γ xr make the plant follow the reference model as well as it can."""
    nx, n, nu = task.nx, task.n, task.nu
    A, B, C, D = task.A0[:nx, :nx], task.Bu[:nx], task.C0[:, :nx], task.D
    Ar, Cr = task.A0[nx:, nx:], -task.C0[:, nx:]
    nr = n - nx
    if nr == 0:
        return np.zeros((nx, 0)), np.zeros((nu, 0))
    eye = np.eye(nr)
    rows = np.block(
        [[np.kron(A, eye) - np.kron(np.eye(nx), Ar.T), np.kron(B, eye)], [np.kron(C, eye), np.kron(D, eye)]]
    )
    wanted = np.concatenate([np.zeros(nx * nr), Cr.reshape(-1)])
    solution = np.linalg.lstsq(rows, wanted, rcond=None)[0]
    return solution[: nx * nr].reshape(nx, nr), solution[nx * nr :].reshape(nu, nr)


def _steady(task: Task, K: Matrix) -> Matrix:
    """Return gains on the affine subspace: K2 is changed alone where that suffices."""
    N, K0, nx = task.law.N, task.law.K0, task.nx
    normal = np.eye(N.shape[0]) - N @ N.T  # projects onto what the law fixes
    second = np.broadcast_to(np.arange(task.n) >= nx, K.shape).reshape(-1)
    missing = normal @ (K0 - K.reshape(-1))
    change = np.linalg.lstsq(normal[:, second], missing, rcond=1e-9)[0] if np.any(second) else np.zeros(0)
    moved = K.copy().reshape(-1)
    moved[second] += change
    return _boxed(task, task.point(task.free(moved.reshape(K.shape))))


def _boxed(task: Task, K: Matrix) -> Matrix:
    """Return the nearest gains on the affine subspace and well inside the box; as they are where there are none."""
    if np.all(np.abs(K) <= _ROOM * task.box):
        return K
    inner = replace(task, box=_ROOM * task.box)
    size = K.size

    def statement(v: Mapping[str, Block]) -> sdp.Program:
        distance = task.law.N @ v["theta"] + (task.law.K0 - K.reshape(-1))[:, None]
        blocks = [[-v["far"], distance.T], [distance, -np.eye(size)]]
        return sdp.Program(v["far"], [blocks], inner.room(task.gains(v["theta"])))

    solution = sdp.solve({"theta": sdp.Variable(task.law.N.shape[1], 1), "far": sdp.Variable()}, statement)
    if solution.status is not sdp.Status.OPTIMAL:
        return K
    return np.asarray(task.gains(solution.values["theta"]), dtype=np.float64)
