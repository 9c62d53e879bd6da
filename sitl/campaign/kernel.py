"""Eqs. (4), (8) and (9) for one block of flights at once, written out for the sizes at hand and compiled.

    u(k) = K1 x(k − d(k)) + K2 xr(k)
    x(k+1) = (A + F δ(k) J1) x(k) + (B + F δ(k) J2) u(k) + E w(k),   e(k) = C x(k) + D u(k) − Cr xr(k)
    xr(k+1) = Ar xr(k) + Br r(k)

Each quantity is a row with one place per flight, so the compiler puts several flights into one instruction. It neither
reorders sums nor fuses products: a flight comes out to the last bit the same in any place of any block, on any machine.
What the flights meet, d, w, r and δ, is handed in.

The source is written by :func:`source_of` with every sum in full and every coefficient a variable. With loops over the
sizes instead the compiler sometimes sees through them and sometimes does not, and then is five times slower.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gains.model import GainLaw, Matrix, Model, sets_of
from sitl.aircraft.linear import DIVERGED

__all__ = ["LANES", "MAX_DELAY", "RESULTS", "Loop", "Sizes", "block_of", "loop_of", "room", "set_of_delay", "source_of"]

LANES = 32
"""Flights of a block."""

MAX_DELAY = 127
"""The largest delay that can be flown, samples."""

RESULTS = ("error_squared", "input_squared", "max_error", "max_state", "half_state", "diverged_at")
"""Rows of what a block returns (:func:`block_of`)."""


class Sizes(NamedTuple):
    """How large everything is.

    ``rows`` is that of K1 over all sets of gains, ``blocks`` that of Δ.
    """

    nx: int
    nu: int
    ny: int
    nw: int
    nr: int
    nm: int
    rows: int
    blocks: int
    limited: bool


class Loop(NamedTuple):
    """The matrices of one law and its model, in deviations from trim, C-contiguous.

    K1 and K2 stand over each other for all sets of a schedule; ``set_of[d]`` is the set that flies at delay d.
    """

    A: Matrix
    B: Matrix
    E: Matrix
    C: Matrix
    D: Matrix
    K1: Matrix
    K2: Matrix
    Ar: Matrix
    Br: Matrix
    Cr: Matrix
    F: Matrix
    J1: Matrix
    J2: Matrix
    set_of: NDArray[np.int64]
    low: Matrix
    high: Matrix
    decay: Matrix
    furthest: Matrix


def loop_of(law: GainLaw, plant: Model, *, limits: bool, uncertain: bool) -> tuple[Sizes, Loop]:
    """Return what the kernel needs of a law that flies a plant.

    Parameters
    ----------
    law : Gains or Schedule
    plant : Model
        Of as many states and inputs as the law's.
    limits : bool
        Whether the elevator's travel, lag and rate count.
    uncertain : bool
        Whether δ does.
    """
    sets = sets_of(law)
    reference, uncertainty = law.model.reference, plant.uncertainty if uncertain else None
    nx, nu, ny = plant.nx, plant.nu, plant.ny
    none = np.zeros((nx, 0))
    nr = 0 if reference is None else len(reference.Ar)
    Ar, Br, Cr = (none[:0], none[:0], np.zeros((ny, 0))) if reference is None else reference_matrices(law.model)
    K2 = [np.zeros((nu, nr)) if one.K2 is None else one.K2 for one in sets]
    F, J1, J2 = (
        (none, np.zeros((0, nx)), np.zeros((0, nu)))
        if uncertainty is None
        else (uncertainty.F, uncertainty.J1, uncertainty.J2)
    )
    actuator = plant.actuator if limits else None
    wide, none_u = np.full(nu, np.inf), np.zeros(nu)
    low = -wide if actuator is None or actuator.low is None else actuator.low - plant.trim.u
    high = wide if actuator is None or actuator.high is None else actuator.high - plant.trim.u
    tau = none_u if actuator is None or actuator.tau is None else actuator.tau
    decay = np.where(tau > 0.0, np.exp(-plant.Ts / np.where(tau > 0.0, tau, 1.0)), 0.0)
    furthest = wide if actuator is None or actuator.rate is None else actuator.rate * plant.Ts
    arrays = (plant.A, plant.B, plant.E, plant.C, plant.D, np.vstack([one.K1 for one in sets]), np.vstack(K2))
    matrices = [np.array(matrix, dtype=np.float64, order="C") for matrix in (*arrays, Ar, Br, Cr, F, J1, J2)]
    vectors = [np.array(vector, dtype=np.float64) for vector in (low, high, decay, furthest)]
    loop = Loop._make([*matrices, set_of_delay(law), *vectors])
    nm = loop.Br.shape[1]
    return Sizes(nx, nu, ny, plant.nw, nr, nm, nu * len(sets), F.shape[1], actuator is not None), loop


def reference_matrices(model: Model) -> tuple[Matrix, Matrix, Matrix]:
    """Return Ar, Br, Cr of a model that has them."""
    assert model.reference is not None
    return model.reference.Ar, model.reference.Br, model.reference.Cr


def set_of_delay(law: GainLaw) -> NDArray[np.int64]:
    """Return the set of gains for each delay: the first whose window has it, below and beyond the nearest."""
    windows = [(one.d_min, one.d_max) for one in sets_of(law)]
    distance = [[max(low - d, d - high, 0) for low, high in windows] for d in range(MAX_DELAY + 1)]
    return np.asarray(np.argmin(np.array(distance), axis=1), dtype=np.int64)


def room(sizes: Sizes, d_max: int) -> tuple[Matrix, Matrix]:
    """Return what a block needs to work in, rows and history, for delays up to d_max."""
    assert 0 <= d_max <= MAX_DELAY
    rows = sizes.nx + sizes.nr + 2 * sizes.nu + len(RESULTS)
    return np.empty(rows * LANES), np.empty(sizes.rows * LANES * 2 ** d_max.bit_length())


@cache
def block_of(sizes: Sizes) -> Any:
    """Return the compiled function that flies one block: ``block(loop, d, w, r, delta, initial, rows, history)``.

    loop : Loop
    d : ndarray of int32, shape (samples, LANES)
        From 0 to the largest that ``history`` has room for. Before sample 0 there was nothing: x(k − d) is 0 there.
    w, r : ndarray, shapes (samples, nw, LANES) and (samples, nm, LANES)
    delta : ndarray, shape (samples, 1, LANES)
        δ(k): Δ(k) = δ(k) I.
    initial : ndarray, shape (nx, LANES)
        x(0).
    rows, history : ndarray
        Room, with any content (:func:`room`).

    It returns the rows ``RESULTS``, shape (len(RESULTS), LANES), as a part of ``rows``.
    """
    namespace: dict[str, Any] = {"LANES": LANES, "DIVERGED": DIVERGED}
    exec(compile(source_of(sizes), f"<loop of {sizes}>", "exec"), namespace)
    namespace["block"].__qualname__ = f"block_{'_'.join(map(str, sizes))}"  # see engine._compiled
    return njit(error_model="numpy")(namespace["block"])


def source_of(sizes: Sizes) -> str:
    """Return the Python source of :func:`block_of`."""
    nx, nu, ny, nw, nr, nm, _, nq, limited = sizes
    x, u, e, w, xr, r, q = (_names(*one) for one in zip(("x", "u", "e", "w", "xr", "r", "q"),
                                                         (nx, nu, ny, nw, nr, nm, nq), strict=True))  # fmt: skip
    place = {name: n for n, name in enumerate([*x, *xr, *u, *(f"at_{name}" for name in u), *RESULTS])}
    several, diverged = sizes.rows > nu, _row(place["diverged_at"])
    now = [
        *(f"{name} = {_row(place[name])}" for name in (*x, *xr)),
        *(f"{name} = wk[{n}, i]" for n, name in enumerate(w)),
        *(f"{name} = rk[{n}, i]" for n, name in enumerate(r)),
        *(f"{name} = {_row(place[name])}" + ("" if several else _sum("K2", n, xr)) for n, name in enumerate(u)),
        *(line for n, name in enumerate(u) if limited for line in _limited(n, name, place)),
        f"flying = {diverged} < 0.0",
        *(f"{name} = {_first(_sum('C', n, x) + _sum('D', n, u) + _sum('Cr', n, xr, '-'))}" for n, name in enumerate(e)),
        *(f"{name} = {name} if flying else 0.0" for name in e),
        f"{_row(place['error_squared'])} += {_first(''.join(f' + {name} * {name}' for name in e))}",
        f"{_row(place['max_error'])} = max({_row(place['max_error'])}, {', '.join(f'abs({name})' for name in e)})",
        f"v = {_first(''.join(f' + {name} * {name}' for name in (*w, *r)))}",
        f"{_row(place['input_squared'])} += v if flying else 0.0",
        *(f"{name} = dk[0, i] * ({_first(_sum('J1', n, x) + _sum('J2', n, u))})" for n, name in enumerate(q)),
        *(
            f"next_{name} = {_first(_sum('A', n, x) + _sum('B', n, u) + _sum('E', n, w) + _sum('F', n, q))}"
            for n, name in enumerate(x)
        ),
        *(f"next_{name} = {_first(_sum('Ar', n, xr) + _sum('Br', n, r))}" for n, name in enumerate(xr)),
        *(f"{_row(place[name])} = next_{name}" for name in (*x, *xr)),
        f"largest = max({_row(place['max_state'])}, {', '.join(f'abs(next_{name})' for name in x)})",
        f"{_row(place['max_state'])} = largest",
        f"{_row(place['half_state'])} = largest if k < half else {_row(place['half_state'])}",
        f"{diverged} = k + 1.0 if flying and largest >= DIVERGED else {diverged}",
    ]
    chosen = "loop.set_of[delays[i]] * " + str(nu) if several else "0"
    delayed = [
        f"first = {chosen}",
        f"past = ((k - delays[i]) & recent) * {sizes.rows} + first",
        *(
            f"{_row(place[name])} = history[(past + {n}) * LANES + i]"
            + "".join(f" + loop.K2[first + {n}, {j}] * {_row(place[other])}" for j, other in enumerate(xr) if several)
            for n, name in enumerate(u)
        ),
    ]
    remembered = [
        *(f"{name} = {_row(place[name])}" for name in x),
        *(f"history[(newest + {n}) * LANES + i] = {_first(_sum('K1', n, x))}" for n in range(sizes.rows)),
    ]
    shapes = {"A": (nx, nx), "B": (nx, nu), "E": (nx, nw), "C": (ny, nx), "D": (ny, nu), "K1": (sizes.rows, nx),
              "K2": (nu, nr), "Ar": (nr, nr), "Br": (nr, nm), "Cr": (ny, nr), "F": (nx, nq), "J1": (nq, nx),
              "J2": (nq, nu)}  # fmt: skip
    named = [f"{name}_{i}_{j} = loop.{name}[{i}, {j}]" for name, (m, n) in shapes.items() for i, j in np.ndindex(m, n)]
    return _TEMPLATE.format(
        coefficients=_lines(named, 4),
        recent=f"len(history) // ({sizes.rows} * LANES) - 1",
        results=place[RESULTS[0]],
        diverged=place["diverged_at"],
        states=nx,
        stride=sizes.rows,
        remembered=_lines(remembered, 12),
        delayed=_lines(delayed, 12),
        now=_lines(now, 12),
    )


_TEMPLATE = """
def block(loop, d, w, r, delta, initial, rows, history):
{coefficients}
    recent = {recent}
    half = len(d) // 2
    rows[:] = 0.0
    rows[{diverged} * LANES :] = -1.0
    history[:] = 0.0
    for n in range({states}):
        for i in range(LANES):
            rows[n * LANES + i] = initial[n, i]
    for k in range(len(d)):
        delays, wk, rk, dk = d[k], w[k], r[k], delta[k]
        newest = (k & recent) * {stride}
        for i in range(LANES):
{remembered}
        for i in range(LANES):
{delayed}
        for i in range(LANES):
{now}
    return rows[{results} * LANES :].reshape(-1, LANES)
"""


def _names(name: str, count: int) -> list[str]:
    return [f"{name}{n}" for n in range(count)]


def _row(number: int) -> str:
    """Return where one flight's number of a row is."""
    return f"rows[{number} * LANES + i]"


def _sum(matrix: str, row: int, names: list[str], sign: str = "+") -> str:
    """Return the product of a matrix' row with named numbers, each term with its sign before it."""
    return "".join(f" {sign} {matrix}_{row}_{n} * {name}" for n, name in enumerate(names))


def _first(terms: str) -> str:
    """Return a sum without the sign before its first term."""
    return terms.removeprefix(" + ") or "0.0"


def _limited(n: int, name: str, place: Mapping[str, int]) -> list[str]:
    """Return the lines that replace u by where the elevator is (:func:`sitl.aircraft.linear.move_actuator`)."""
    at = _row(place[f"at_{name}"])
    return [
        f"{name} = min(max({name}, loop.low[{n}]), loop.high[{n}])",
        f"{name} = {name} + loop.decay[{n}] * ({at} - {name})",
        f"{name} = {at} + min(max({name} - {at}, -loop.furthest[{n}]), loop.furthest[{n}])",
        f"{at} = {name}",
    ]


def _lines(lines: Iterable[str], indent: int) -> str:
    return "\n".join(" " * indent + line for line in lines)
