"""A campaign from its first flight to its last: in this process, or by Dask on many cores and machines.

The first flights are timed, and the rest is cut into tasks that take about ``TASK_S`` each: short enough to be done
again without regret when a worker dies, long enough that handing them out costs nothing. Where all of it takes little
more than that, tasks are shorter, so that every worker has some. What comes back is written as it comes
(:mod:`sitl.campaign.parts`) or kept, and put in order by number.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np

from gains.table import InputError
from sitl.campaign.engine import Columns
from sitl.campaign.job import Campaign
from sitl.campaign.kernel import LANES
from sitl.campaign.parts import Parts, missing_ranges
from sitl.campaign.tasks import fly, is_compiled

__all__ = ["WITHOUT_SCHEDULER", "Outcome", "run"]

TASK_S = 1.0
"""What a task shall take."""

SHARES, LEAST_S = 8, 0.02
"""Tasks for each worker at the least, and what each of them shall take at the least."""

FIRST = 2 * LANES
"""Flights that are timed."""

WORTH_S = 10.0
"""What is left to fly must take this long before other processes are started for it."""

MOST = 1 << 18
"""Flights of a task, so that what it returns stays small."""

MAX_ROWS_KEPT = 1 << 25
"""Flights whose results are kept in memory; more want a folder."""

RETRIES = 3
"""How often a task that fails is tried again."""

WITHOUT_SCHEDULER = ("local", "none")
"""What is no scheduler's address."""

Told = Callable[[int], None]
Range = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Outcome:
    """What was flown.

    Attributes
    ----------
    columns : dict of ndarray
        One row per flight, by number.
    flown : int
        Flights that were flown now; the others were there.
    seconds : float
        That took, with starting workers, without compiling.
    workers : int
    """

    columns: Columns
    flown: int
    seconds: float
    workers: int


def run(
    campaign: Campaign,
    *,
    scheduler: str = "local",
    workers: int | None = None,
    parts: Parts | None = None,
    told: Told = lambda _: None,
) -> Outcome:
    """Fly a campaign.

    Parameters
    ----------
    campaign : Campaign
    scheduler : str
        "local": this process, and where that takes long a Dask cluster of one worker per core on this machine.
        "none": this process alone. Otherwise the address of a Dask scheduler.
    workers : int, optional
        Of this machine; by default one per core.
    parts : Parts, optional
        Where results are written, and what was flown before is found.
    told : callable
        Told how many flights more are done.

    Raises
    ------
    InputError
        When there are too many flights for the memory, or the scheduler cannot be reached or fly.
    """
    if parts is None and campaign.flights > MAX_ROWS_KEPT:
        raise InputError(f"flights: expected at most {MAX_ROWS_KEPT} without a folder (-o), found {campaign.flights}")
    workers = workers or len(os.sched_getaffinity(0))
    names = list(fly(campaign, 0, 1))  # compiled, or loaded
    ranges = missing_ranges([] if parts is None else parts.found(names), campaign.flights)
    told(campaign.flights - sum(stop - start for start, stop in ranges))
    collected = _Collected(parts, told)
    begun = time.perf_counter()
    ranges, per_flight_s = _timed(campaign, ranges, collected)
    left_s = per_flight_s * sum(stop - start for start, stop in ranges)
    tasks = _tasks(ranges, per_flight_s, min(max(left_s / (SHARES * workers), LEAST_S), TASK_S))
    if scheduler not in WITHOUT_SCHEDULER:
        workers = _with_dask(campaign, tasks, collected, scheduler, workers)
    elif scheduler == "local" and left_s > WORTH_S and workers > 1 and not is_compiled(campaign):
        workers = _with_dask(campaign, tasks, collected, None, workers)
    else:
        workers = workers if is_compiled(campaign) else 1
        _in_threads(campaign, tasks, collected, workers)
    seconds = time.perf_counter() - begun
    return Outcome(collected.columns(campaign.flights), collected.flown, seconds, workers)


class _Collected:
    """What has come back."""

    def __init__(self, parts: Parts | None, told: Told) -> None:
        self._parts, self._told = parts, told
        self._kept: dict[int, Columns] = {}
        self.flown = 0

    def add(self, start: int, stop: int, columns: Columns) -> None:
        """Take the results of one range."""
        if self._parts is None:
            self._kept[start] = columns
        else:
            self._parts.write(start, stop, columns)
        self.flown += stop - start
        self._told(stop - start)

    def columns(self, flights: int) -> Columns:
        """Return all of them, in the order of flights."""
        pieces = [self._kept[start] for start in sorted(self._kept)]
        if self._parts is not None:
            pieces = list(self._parts.read(flights))
        return {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}


def _timed(campaign: Campaign, ranges: list[Range], collected: _Collected) -> tuple[list[Range], float]:
    """Fly the first flights that are missing; return what is left, and the seconds that a flight took."""
    if not ranges:
        return [], 0.0
    (start, stop), *rest = ranges
    count = FIRST if is_compiled(campaign) else 1
    last = min(start + count, stop)
    begun = time.perf_counter()
    columns = fly(campaign, start, last)
    took_s = time.perf_counter() - begun
    collected.add(start, last, columns)
    return ([(last, stop)] if last < stop else []) + rest, took_s / (last - start)


def _tasks(ranges: list[Range], per_flight_s: float, task_s: float) -> Iterator[Range]:
    """Cut ranges into tasks of so long, at the multiples of whole blocks where a task has more than one."""
    count = min(max(1, round(task_s / max(per_flight_s, 1e-9))), MOST)
    if count > LANES:
        count -= count % LANES
    for start, stop in ranges:
        while start < stop:
            end = min(start - start % count + count, stop)
            yield start, end
            start = end


def _in_threads(campaign: Campaign, tasks: Iterator[Range], collected: _Collected, workers: int) -> None:
    """Fly in threads of this process: compiled code does not hold the interpreter."""
    with ThreadPoolExecutor(workers) as pool:

        def submit(one: Range) -> Future[Columns]:
            return pool.submit(fly, campaign, *one)

        running = {submit(one): one for one in islice(tasks, workers + 1)}
        while running:
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                collected.add(*running.pop(future), future.result())
                running |= {submit(one): one for one in islice(tasks, 1)}


def _with_dask(
    campaign: Campaign, tasks: Iterator[Range], collected: _Collected, address: str | None, workers: int
) -> int:
    """Fly on a Dask cluster, a local one without an address; return how many workers there were."""
    from sitl.campaign.cluster import connected

    with connected(address, workers) as client:
        count: int = max(1, sum(client.nthreads().values()))
        from distributed import as_completed

        def submit(one: Range) -> Any:
            return client.submit(fly, campaign, *one, pure=False, retries=RETRIES)

        running = {future.key: (one, future) for one in islice(tasks, 2 * count + 1) for future in [submit(one)]}
        completed = as_completed([future for _, future in running.values()], loop=client.loop)
        for future in completed:
            one, _ = running.pop(future.key)
            collected.add(*one, _result_of(future, one))
            for following in islice(tasks, 1):
                added = submit(following)
                running[added.key] = (following, added)
                completed.add(added)
    return count


def _result_of(future: Any, one: Range) -> Columns:
    """Return what a cluster flew; what failed each time, or was lost with the scheduler, is refused on one line."""
    try:
        columns: Columns = future.result()
    except Exception as error:
        said = " ".join(f"{type(error).__name__}: {error}".split())
        raise InputError(f"flights from {one[0]} to before {one[1]}: expected results, found {said}") from error
    return columns
