"""What flights say of all flights drawn like them: failures, quantiles and gains, with confidence intervals.

Every interval is distribution-free and exact: Clopper and Pearson's for a probability, order statistics for a quantile.
Nothing is interpolated, so an infinite value stays one. A flight that diverged was stopped there: its errors and its
gain count as infinite, whatever was measured until then. A gain without an input (0/0, nan) is left out and counted.

:class:`Tally` is fed with parts of a campaign and keeps three columns as float64, 24 MB per million flights, because
quantiles need all values; :func:`measure` takes whole columns and adds the sensitivities.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gains.table import InputError
from sitl.campaign.intervals import CONFIDENCE, QUANTILES, Proportion, Quantile, plain, proportion, quantiles
from sitl.campaign.sensitivity import MAX_ROWS, Sensitivity, sensitivities

__all__ = [
    "MAX_KEPT",
    "Columns",
    "Gains",
    "Histogram",
    "Statistics",
    "Tally",
    "columns_of",
    "failures",
    "held",
    "measure",
]

RANKED = ("rms_error", "max_error", "gain")
"""Columns whose values are kept for quantiles."""
MAX_KEPT = 1 << 26
"""Flights whose values a tally keeps, 1.6 GB; of later ones it counts all the same, and says how many they are."""

BINS_PER_DECADE = 40
DECADES = 6
"""Of the histogram of gains, to either side of η, or of 1 where there is none."""

Columns = Mapping[str, NDArray[Any]]
"""A table: equally long columns by name."""
Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Histogram:
    """Counts on a grid of equal ratios.

    Attributes
    ----------
    edges : tuple of float
        Rising; a bin holds its upper edge, not its lower one.
    counts : tuple of int
        One fewer.
    below, beyond : int
        Finite values that are off the grid; zeros are below it.
    """

    edges: tuple[float, ...]
    counts: tuple[int, ...]
    below: int
    beyond: int


@dataclass(frozen=True, slots=True)
class Gains:
    """Gains ‖e‖/‖v‖ of the flights, beside the bound η.

    Attributes
    ----------
    eta : float or None
    largest : float
        Of the finite ones; nan of none.
    ratio : float or None
        The largest over η.
    above, above_inside : int
        Flights above η, diverged ones among them, and those of them that never left the window: there η is promised.
    infinite, undefined : int
        Flights that diverged, and flights without an input.
    histogram : Histogram
        Of the finite ones; η is one of its edges.
    """

    eta: float | None
    largest: float
    ratio: float | None
    above: int
    above_inside: int
    infinite: int
    undefined: int
    histogram: Histogram


@dataclass(frozen=True, slots=True)
class Statistics:
    """What became of a campaign's flights.

    Attributes
    ----------
    flights : int
    confidence : float
        Of every interval by itself.
    threshold : float or None
        An error beyond it is a failure.
    diverged : Proportion
    beyond : Proportion or None
        Flights whose largest error exceeded the threshold or that diverged; None without one.
    above : Proportion or None
        Flights that exceeded η without leaving the window; None without η.
    failed : Proportion
        Flights of which any of these three is true.
    left_window : Proportion
        Flights with at least one sample outside the window.
    quantiles : dict of str to tuple of Quantile
        Of rms_error, max_error and gain, at ``QUANTILES``.
    gains : Gains
    unkept : int
        Flights whose values the quantiles do not hold.
    rms_sensitivity, gain_sensitivity, failure_sensitivity : Sensitivity or None
        Which parameters move the rms error, the gain where all have one, and failure where some flights failed; all
        None of a tally.
    """

    flights: int
    confidence: float
    threshold: float | None
    diverged: Proportion
    beyond: Proportion | None
    above: Proportion | None
    failed: Proportion
    left_window: Proportion
    quantiles: dict[str, tuple[Quantile, ...]]
    gains: Gains
    unkept: int
    rms_sensitivity: Sensitivity | None = None
    gain_sensitivity: Sensitivity | None = None
    failure_sensitivity: Sensitivity | None = None

    def to_json(self) -> dict[str, Any]:
        """Return it as :func:`plain` has it."""
        found: dict[str, Any] = plain(self)
        return found


# -- columns


def columns_of(table: Any) -> dict[str, NDArray[Any]]:
    """Return the columns of a mapping, or of a pyarrow Table, as arrays.

    Raises
    ------
    InputError
        When one is missing that every campaign has, they are not equally long, or an error is no number.
    """
    names = list(table) if isinstance(table, Mapping) else list(table.column_names)
    columns = {name: np.asarray(table[name]) for name in names}
    for name in ("flight", "diverged", "outside", *RANKED):
        if name not in columns:
            raise InputError(f"campaign: expected a column {name}, found {', '.join(names) or 'none'}")
    rows = len(columns["flight"])
    for name, column in columns.items():
        if column.shape != (rows,):
            raise InputError(f"campaign: {name}: expected {rows} rows, found shape {column.shape}")
    for name in ("rms_error", "max_error"):
        lost = np.isnan(columns[name]) & ~columns["diverged"]
        if lost.any():
            raise InputError(f"campaign: {name}: expected numbers, found nan in flight {columns['flight'][lost][0]}")
    return columns


def held(columns: Columns, name: str) -> Floats:
    """Return the rms_error, max_error or gain that counts: infinite where the flight diverged."""
    return np.where(columns["diverged"], np.inf, columns[name])


# -- the whole


class Tally:
    """Counts and values of a campaign that comes in parts.

    Parameters
    ----------
    eta : float or None
        The proved bound of the gain.
    threshold : float or None
        An error beyond it is a failure.
    confidence : float
    most : int
        Flights whose values are kept for the quantiles.
    """

    def __init__(
        self,
        eta: float | None = None,
        threshold: float | None = None,
        confidence: float = CONFIDENCE,
        most: int = MAX_KEPT,
    ) -> None:
        self._eta, self._threshold, self._confidence, self._most = eta, threshold, confidence, most
        exponents = np.arange(-DECADES * BINS_PER_DECADE, DECADES * BINS_PER_DECADE + 1) / BINS_PER_DECADE
        self._edges = (1.0 if eta is None else eta) * 10.0**exponents
        self._bins = np.zeros(len(self._edges) + 1, dtype=np.int64)
        self._kept: dict[str, list[Floats]] = {name: [] for name in RANKED}
        self._largest = math.nan
        self._flights = self._unkept = 0
        self._diverged = self._beyond = self._failed = self._left = 0
        self._above = self._above_inside = self._undefined = 0

    def add(self, table: Any) -> None:
        """Count flights, each once.

        Raises
        ------
        InputError
            As :func:`columns_of`.
        """
        columns = columns_of(table)
        rows = len(columns["flight"])
        room = max(0, self._most - (self._flights - self._unkept))
        values = {name: held(columns, name) for name in RANKED}
        for name, kept in self._kept.items():
            kept.append(values[name][:room].copy())
        self._flights += rows
        self._unkept += max(0, rows - room)
        self._diverged += int(np.count_nonzero(columns["diverged"]))
        self._left += int(np.count_nonzero(columns["outside"] > 0.0))
        beyond, above = self._exceeding(columns, values)
        self._beyond += int(np.count_nonzero(beyond))
        inside = above & (columns["outside"] == 0.0)
        self._above += int(np.count_nonzero(above))
        self._above_inside += int(np.count_nonzero(inside))
        self._failed += int(np.count_nonzero(columns["diverged"] | beyond | inside))
        self._count_gains(values["gain"])

    def _exceeding(self, columns: Columns, values: Mapping[str, Floats]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return which flights exceed the threshold, and which η."""
        none = np.zeros(len(columns["flight"]), dtype=np.bool_)
        beyond = none if self._threshold is None else values["max_error"] > self._threshold
        above = none if self._eta is None else values["gain"] > self._eta
        return beyond, above

    def _count_gains(self, gain: Floats) -> None:
        self._undefined += int(np.count_nonzero(np.isnan(gain)))
        finite = gain[np.isfinite(gain)]
        self._bins += np.bincount(np.searchsorted(self._edges, finite), minlength=len(self._bins))
        if finite.size:
            self._largest = float(np.fmax(self._largest, finite.max()))

    def statistics(self) -> Statistics:
        """Return what the flights came to so far; sorts what is kept, and leaves it."""
        confidence, flights = self._confidence, self._flights
        ranked = {}
        for name, parts in self._kept.items():
            values = np.concatenate([np.zeros(0), *parts])
            values = values[~np.isnan(values)]
            values.sort()
            ranked[name] = quantiles(values, QUANTILES, confidence)
        return Statistics(
            flights=flights,
            confidence=confidence,
            threshold=self._threshold,
            diverged=proportion(self._diverged, flights, confidence),
            beyond=None if self._threshold is None else proportion(self._beyond, flights, confidence),
            above=None if self._eta is None else proportion(self._above_inside, flights, confidence),
            failed=proportion(self._failed, flights, confidence),
            left_window=proportion(self._left, flights, confidence),
            quantiles=ranked,
            gains=self._gains(),
            unkept=self._unkept,
        )

    def _gains(self) -> Gains:
        histogram = Histogram(
            tuple(self._edges.tolist()), tuple(self._bins[1:-1].tolist()), int(self._bins[0]), int(self._bins[-1])
        )
        return Gains(
            eta=self._eta,
            largest=self._largest,
            ratio=None if self._eta is None else self._largest / self._eta,
            above=self._above,
            above_inside=self._above_inside,
            infinite=self._diverged,
            undefined=self._undefined,
            histogram=histogram,
        )


def failures(columns: Columns, eta: float | None, threshold: float | None) -> NDArray[np.bool_]:
    """Return which flights failed: diverged, an error beyond the threshold, or above η without leaving the window."""
    failed = columns["diverged"].astype(np.bool_)
    if threshold is not None:
        failed |= columns["max_error"] > threshold
    if eta is not None:
        failed |= (columns["gain"] > eta) & (columns["outside"] == 0.0)
    return failed


def measure(
    table: Any, *, eta: float | None = None, threshold: float | None = None, confidence: float = CONFIDENCE
) -> Statistics:
    """Return the statistics of whole columns, with the sensitivities.

    Parameters
    ----------
    table : mapping of str to ndarray, or pyarrow Table
        One row per flight.
    eta, threshold, confidence
        As for :class:`Tally`.

    Raises
    ------
    InputError
        As :func:`columns_of`.
    """
    columns = columns_of(table)
    tally = Tally(eta, threshold, confidence)
    tally.add(columns)
    failed = failures(columns, eta, threshold)
    results = {"rms_sensitivity": held(columns, "rms_error")}
    gain = held(columns, "gain")
    if not np.isnan(gain).any():
        results["gain_sensitivity"] = gain
    if 0 < np.count_nonzero(failed[:MAX_ROWS]) < min(MAX_ROWS, len(failed)):
        results["failure_sensitivity"] = failed.astype(np.float64)
    found = dict(zip(results, sensitivities(columns, list(results.values())), strict=True))
    return replace(
        tally.statistics(),
        rms_sensitivity=found["rms_sensitivity"],
        gain_sensitivity=found.get("gain_sensitivity"),
        failure_sensitivity=found.get("failure_sensitivity"),
    )
