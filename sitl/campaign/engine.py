"""Ranges of flights, flown by compiled code: columns of numbers, one row per flight.

:func:`fly_range` is all that a worker runs. What it returns depends on the campaign and the flights' numbers alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from types import FunctionType
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gains.model import Matrix
from sitl.campaign import kernel, philox, signals
from sitl.campaign.job import Campaign
from sitl.campaign.kernel import LANES, MAX_DELAY, RESULTS, Sizes, block_of, loop_of, room, source_of
from sitl.campaign.signals import COLUMNS, draw_block, draw_of

__all__ = ["Columns", "Drawn", "columns_of", "drawn_block", "fly_range"]


class Drawn(NamedTuple):
    """What one flight meets: d, shape (samples,); w, (samples, nw); r, (samples, nm); δ, (samples, 1); x0, (nx,).

    ``parameters`` are those of ``COLUMNS``. Of a whole block each has one more axis, the last, of LANES.
    """

    d: NDArray[np.int32]
    w: Matrix
    r: Matrix
    delta: Matrix
    x0: Matrix
    parameters: Matrix

    def flight(self, lane: int) -> Drawn:
        """Return one flight of a block."""
        return Drawn._make(array[..., lane] for array in self)


Columns = dict[str, NDArray[Any]]
"""A table: equally long columns by name."""

_DELAYS = ("d_mean", "d_max", "outside", "changes")


def fly_range(campaign: Campaign, start: int, stop: int, delays: NDArray[np.uint8] | None = None) -> Columns:
    """Fly the flights from ``start`` to before ``stop``.

    Parameters
    ----------
    campaign : Campaign
        Of a linear plant.
    start, stop : int
    delays : ndarray of uint8, shape (flights, samples), optional
        d(k) where the campaign does not say it.

    Returns
    -------
    dict of ndarray, each of shape (flights,)
    """
    sizes, loop = loop_of(campaign.law, campaign.plant, limits=campaign.limits, uncertain=campaign.uncertain)
    draw = draw_of(campaign)
    longest = campaign.d_max if campaign.delays is None else campaign.delays.d_max
    if delays is None:
        given = np.zeros((0, campaign.samples), dtype=np.uint8)
    else:
        given, longest = delays, int(delays.max(initial=0))
        draw = draw._replace(thresholds=draw.thresholds[:0], cycle=draw.cycle[:0])
    assert longest <= MAX_DELAY
    window = (campaign.d_min, campaign.d_max)
    fly, _ = _compiled(sizes)
    table = fly(loop, draw, given, start, stop, campaign.samples, window, room(sizes, longest))
    return columns_of(campaign, start, table)


def drawn_block(campaign: Campaign, first: int) -> Drawn:
    """Return what a block of flights meets; d is 0 where a link says it."""
    sizes, _ = loop_of(campaign.law, campaign.plant, limits=campaign.limits, uncertain=campaign.uncertain)
    samples = campaign.samples
    w, r = np.zeros((samples, sizes.nw, LANES)), np.zeros((samples, sizes.nm, LANES))
    drawn = Drawn(
        np.zeros((samples, LANES), dtype=np.int32),
        w,
        r,
        np.zeros((samples, 1, LANES)),
        np.empty((sizes.nx, LANES)),
        np.empty((len(COLUMNS), LANES)),
    )
    _, draw = _compiled(sizes)
    draw(draw_of(campaign), first, *drawn)
    return drawn


def columns_of(campaign: Campaign, start: int, table: NDArray[np.float64]) -> Columns:
    """Name the rows of the kernel's table, and leave out what does not apply."""
    flights = table.shape[1]
    named = dict(zip((*RESULTS, *_DELAYS, *COLUMNS), table, strict=True))
    diverged = named["diverged_at"] >= 0.0
    error, disturbance = np.sqrt(named["error_squared"]), np.sqrt(named["input_squared"])
    with np.errstate(divide="ignore", invalid="ignore"):
        gain = np.where(diverged, np.inf, np.where(disturbance > 0.0, error / disturbance, np.nan))
    flown = np.where(diverged, named["diverged_at"], campaign.samples)
    columns: Columns = {
        "flight": np.arange(start, start + flights, dtype=np.int64),
        "diverged": diverged,
        "diverged_at": named["diverged_at"].astype(np.int64),
        "gain": gain,
        "rms_error": error / np.sqrt(flown),
        "max_error": named["max_error"],
        "max_state": named["max_state"],
        "growth": _growth(named, campaign.samples),
        "error_norm": error,
        "input_norm": disturbance,
        "d_mean": named["d_mean"],
        "d_max": named["d_max"].astype(np.int64),
        "outside": named["outside"],
        "changes": named["changes"].astype(np.int64),
    }
    for name in _applying(campaign):
        columns[name] = named[name] * (campaign.plant.Ts if name.endswith("_s") else 1.0)
    return columns


def _growth(named: Mapping[str, NDArray[np.float64]], samples: int) -> NDArray[np.float64]:
    """Return by how much the largest |x| grew per sample in the second half; nan where it did not, or overflowed."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        growth = (named["max_state"] / named["half_state"]) ** (1.0 / max(1, samples - samples // 2))
    return np.where(np.isfinite(growth), growth, np.nan)


def _applying(campaign: Campaign) -> list[str]:
    """Return the parameters that this campaign draws."""
    signals = {"gust": campaign.gust.kind, "reference": campaign.reference.kind}
    names = []
    for name, kind in signals.items():
        names += [f"{name}_amplitude"] if kind != "none" else []
        names += [f"{name}_period_s"] if kind in ("sine", "square") else []
    return names + ["delta_amplitude"] * campaign.uncertain + ["x0_norm"] * (campaign.x0 > 0.0)


@njit(error_model="numpy")
def _delay_facts(d, window):  # type: ignore[no-untyped-def]
    """Return mean and largest delay, share outside the window and number of changes, shape (4, LANES)."""
    facts = np.zeros((4, LANES))
    low, high = window
    for k in range(len(d)):
        before = d[max(0, k - 1)]
        for i in range(LANES):
            now = d[k, i]
            facts[0, i] += now
            facts[1, i] = max(facts[1, i], float(now))
            facts[2, i] += 1.0 if now < low or now > high else 0.0
            facts[3, i] += 1.0 if now != before[i] else 0.0
    for i in range(LANES):
        facts[0, i] /= len(d)
        facts[2, i] /= len(d)
    return facts


@cache
def _compiled(sizes: Sizes) -> tuple[Any, Any]:
    """Return the compiled functions that Python calls: flying a range, and drawing a block.

    numba keeps compiled code on disk, and knows it by the file of a function and by what the function closes over, not
    by what it calls. So both close over the text of all of that. (Not with an assertion: pytest, for which this package
    is a plug-in, rewrites those into what numba does not compile.)
    """
    modules = "".join(Path(str(module.__file__)).read_text() for module in (philox, kernel, signals))
    sources = modules + source_of(sizes)

    def fly(loop, draw, given, start, stop, samples, window, room):  # type: ignore[no-untyped-def]
        """Return the table of a range, shape (results, delays and parameters; flights)."""
        _ = sources
        nx, nw, nm = loop.A.shape[0], loop.E.shape[1], loop.Br.shape[1]
        d = np.zeros((samples, LANES), dtype=np.int32)
        w, r = np.zeros((samples, nw, LANES)), np.zeros((samples, nm, LANES))
        delta, x0 = np.zeros((samples, 1, LANES)), np.empty((nx, LANES))
        parameters = np.empty((len(COLUMNS), LANES))
        table = np.empty((len(RESULTS) + len(_DELAYS) + len(COLUMNS), stop - start))
        for first in range(start, stop, LANES):
            count = min(LANES, stop - first)
            if len(given):
                for i in range(count):
                    for k in range(samples):
                        d[k, i] = given[first - start + i, k]
            draw_block(draw, first, d, w, r, delta, x0, parameters)
            results = _block(loop, d, w, r, delta, x0, room[0], room[1])  # type: ignore[name-defined] # noqa: F821
            _put(table, first - start, count, 0, results)
            _put(table, first - start, count, len(RESULTS), _delay_facts(d, window))
            _put(table, first - start, count, len(RESULTS) + len(_DELAYS), parameters)
        return table

    def draw(drawn, first, d, w, r, delta, x0, parameters):  # type: ignore[no-untyped-def]
        """Draw a block (:func:`sitl.campaign.signals.draw_block`)."""
        _ = sources
        draw_block(drawn, first, d, w, r, delta, x0, parameters)

    # the block of these sizes as a global: a function that is closed over has another name in each process
    flying = FunctionType(fly.__code__, {**globals(), "_block": block_of(sizes)}, "fly", None, fly.__closure__)
    # and names of their own: of two functions of one name that come from the disk, one would run the other's code
    flying.__qualname__, draw.__qualname__ = (f"{name}_{'_'.join(map(str, sizes))}" for name in ("fly", "draw"))
    compiled = njit(cache=True, nogil=True, error_model="numpy")
    return compiled(flying), compiled(draw)


@njit(error_model="numpy")
def _put(table, at, count, row, block):  # type: ignore[no-untyped-def]
    """Copy the rows of a block into the table."""
    for n in range(len(block)):
        for i in range(count):
            table[row + n, at + i] = block[n, i]
