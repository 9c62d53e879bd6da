"""Campaigns whose tasks, workers, scheduler or own process fail: all is flown, or one line says what was lost."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from distributed import LocalCluster

from gains.store import load_gains
from gains.table import InputError
from sitl.campaign import run as running
from sitl.campaign.engine import Columns
from sitl.campaign.job import Campaign
from sitl.campaign.tasks import fly
from sitl.link.presets import parse_link
from tests.integration.programs import ENVIRONMENT, Program, alive, children_of, eventually, program
from tests.sitl.campaigns import local_cluster
from tests.sitl.test_campaign_parts import campaign, equal, parts_in

LINE = ("sitl", "campaign", "--gains", "hirm-paper", "--link", "lte", "--json", "--flights")
"""Flown in Python, some ten milliseconds a flight: long enough to be hit in the middle."""


def linked(flights: int, **changes: Any) -> Campaign:
    return campaign(delays=None, link=parse_link("lte", None, None), samples=400, flights=flights, **changes)


@pytest.fixture(scope="module")
def dask() -> Iterator[LocalCluster]:
    with local_cluster() as local:
        yield local


def processes_of(local: LocalCluster) -> set[int]:
    return {worker.pid for worker in local.workers.values() if worker.pid is not None}


def by_flight(folder: Path) -> dict[str, Any]:
    table = pq.read_table(folder).sort_by("flight")
    return {name: np.asarray(table[name]) for name in table.column_names}


def parts_of(folder: Path) -> set[str]:
    return {path.name for path in folder.glob("flights-*.parquet")}


# -- a cluster


def test_processes_fly_what_threads_and_a_single_range_fly_to_the_last_bit(dask: LocalCluster) -> None:
    law = load_gains("pendulum-paper")
    job = campaign(law=law, plant=law.model, plant_name="pendulum", flights=2000, x0=0.01)
    expected = fly(job, 0, 2000)
    for scheduler, workers in (("none", 1), ("none", 3), ("local", 2), (dask.scheduler_address, None)):
        outcome = running.run(job, scheduler=scheduler, workers=workers)
        assert outcome.flown == 2000
        assert equal(outcome.columns, expected)
    assert len(np.unique(expected["rms_error"])) == 2000


def test_tasks_that_fail_are_tried_again_and_change_nothing(
    dask: LocalCluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job, failures = linked(24), 3

    def fail_thrice(job: Campaign, start: int, stop: int) -> Columns:
        tries = tmp_path / f"{start}-{stop}"
        with tries.open("a") as file:
            file.write("I")
        if start > 0 and tries.stat().st_size <= failures:
            raise RuntimeError("out of luck")
        return fly(job, start, stop)

    monkeypatch.setattr(running, "fly", fail_thrice)
    monkeypatch.setattr(running, "_timed", lambda _job, ranges, _collected: (ranges, 0.1))
    outcome = running.run(job, scheduler=dask.scheduler_address)
    tried = {path.name: path.stat().st_size for path in tmp_path.iterdir()}
    assert sum(size == 1 + failures for size in tried.values()) > 2
    assert max(tried.values()) == 1 + failures
    assert outcome.flown == 24
    assert equal(outcome.columns, fly(job, 0, 24))


def test_a_task_that_always_fails_ends_on_one_line_and_keeps_what_was_flown(
    dask: LocalCluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job, tries = linked(40), tmp_path / "tries"

    def fail_late(job: Campaign, start: int, stop: int) -> Columns:
        if start <= 30 < stop:
            with tries.open("a") as file:
                file.write("I")
            raise RuntimeError("out\nof luck")
        return fly(job, start, stop)

    monkeypatch.setattr(running, "fly", fail_late)
    with pytest.raises(InputError, match=r"flights from .* to before .*RuntimeError: out of luck") as ended:
        running.run(job, scheduler=dask.scheduler_address, parts=parts_in(tmp_path / "out", job))
    assert "\n" not in str(ended.value)
    start, stop = map(int, re.findall(r"\d+", str(ended.value)))
    assert start <= 30 < stop
    assert tries.stat().st_size == 4
    assert parts_of(tmp_path / "out")
    monkeypatch.undo()
    again = running.run(job, scheduler="none", workers=1, parts=parts_in(tmp_path / "out", job))
    assert 0 < again.flown < 40
    assert equal(again.columns, fly(job, 0, 40))


@pytest.mark.long
def test_a_worker_that_dies_in_the_middle_changes_nothing(dask: LocalCluster, tmp_path: Path) -> None:
    job, killed, told = linked(600), list[int](), 0
    before = processes_of(dask)

    def kill_one(flights: int) -> None:
        nonlocal told
        told += flights
        if told >= 100 and not killed:
            killed.append(min(processes_of(dask)))
            os.kill(killed[0], signal.SIGKILL)
            eventually("the end of a worker", lambda: not alive(killed[0]))
            assert told < 500  # in the middle

    outcome = running.run(job, scheduler=dask.scheduler_address, parts=parts_in(tmp_path, job), told=kill_one)
    assert len(killed) == 1
    assert killed[0] in before
    assert told == outcome.flown == 600
    assert equal(by_flight(tmp_path), fly(job, 0, 600))
    eventually("another worker in its place", lambda: len(processes_of(dask)) == 2)


@pytest.mark.long
def test_a_task_that_ends_every_worker_ends_on_one_line(dask: LocalCluster, monkeypatch: pytest.MonkeyPatch) -> None:
    own = os.getpid()

    def end_worker(job: Campaign, start: int, stop: int) -> Columns:
        if start <= 30 < stop and os.getpid() != own:
            os.kill(os.getpid(), signal.SIGKILL)
        return fly(job, start, stop)

    monkeypatch.setattr(running, "fly", end_worker)
    with pytest.raises(InputError, match="KilledWorker") as ended:
        running.run(linked(40), scheduler=dask.scheduler_address)
    assert "\n" not in str(ended.value)
    eventually("both workers", lambda: len(processes_of(dask)) == 2)


@pytest.mark.long
def test_the_cluster_of_this_machine_flies_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job = linked(60)
    monkeypatch.setattr(running, "WORTH_S", 0.0)
    outcome = running.run(job, scheduler="local", workers=2, parts=parts_in(tmp_path, job))
    assert (outcome.workers, outcome.flown) == (2, 60)
    assert equal(outcome.columns, fly(job, 0, 60))


# -- a scheduler that is not there, or no longer


@pytest.mark.long
def test_a_scheduler_that_nobody_is_at_ends_with_2_and_one_line(tmp_path: Path) -> None:
    line = (*LINE, "100", "-o", str(tmp_path / "out"), "--scheduler", "tcp://127.0.0.1:9")
    with program(tmp_path, *line) as flying:
        assert flying.wait(120.0) == 2
        assert flying.stdout == ""
        assert_one_line(flying, "tcp://127.0.0.1:9")
    assert not (tmp_path / "out").exists()


def assert_one_line(flying: Program, named: str) -> None:
    assert flying.stderr.startswith("sitl: error: ")
    assert flying.stderr.index("\n") == len(flying.stderr) - 1
    assert named in flying.stderr


@contextmanager
def scheduler_of_its_own(folder: Path) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """Start a scheduler and a worker as the manual does; give the scheduler and its address."""
    told, quiet = folder / "scheduler.json", {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    start = [sys.executable, "-m", "dask"]
    with ExitStack() as stack:
        at = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(told)]
        environment = {name: value for name, value in ENVIRONMENT.items() if name != "PYTHONWARNINGS"}
        scheduler = subprocess.Popen([*start, "scheduler", *at], env=environment, **quiet)  # type: ignore[call-overload]
        stack.callback(ended, scheduler)
        eventually("a scheduler", told.exists)
        address = str(json.loads(told.read_text())["address"])
        line = [*start, "worker", address, "--nthreads", "1", "--host", "127.0.0.1", "--no-dashboard"]
        worker = subprocess.Popen(
            [*line, "--death-timeout", "5", "--local-directory", str(folder)],
            env=environment,
            **quiet,  # type: ignore[call-overload]
        )
        stack.callback(ended, worker)
        yield scheduler, address


def ended(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(20.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


@pytest.mark.long
def test_a_scheduler_that_dies_in_the_middle_is_told_and_the_rest_is_flown_later(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with (
        scheduler_of_its_own(tmp_path) as (scheduler, address),
        program(tmp_path, *LINE, "600", "-o", str(out), "--scheduler", address) as flying,
    ):
        eventually("some parts", lambda: len(parts_of(out)) >= 4)
        scheduler.kill()
        assert flying.wait() == 2
        assert flying.stdout == ""
        assert flying.stderr.count("\n") == 1
        assert flying.stderr.startswith("sitl: error: flights from ")
    kept = parts_of(out)
    with program(tmp_path, *LINE, "600", "-o", str(out), "--scheduler", "none") as flying:
        assert flying.wait() == 0, flying.stderr
        assert 0 < json.loads(flying.stdout)["flown_now"] < 600
    assert kept <= parts_of(out)
    assert equal(by_flight(out), fly(linked_as_asked(600), 0, 600))


def linked_as_asked(flights: int) -> Campaign:
    """Return the campaign of the command line."""
    return linked(flights, seed=1)


# -- the command itself


@pytest.mark.long
def test_killed_at_any_time_the_same_command_has_the_same_rows_in_the_end(tmp_path: Path) -> None:
    out, expected = tmp_path / "out", fly(linked_as_asked(300), 0, 300)
    for count in (1, 3, 6):
        with program(tmp_path, *LINE, "300", "-o", str(out), "--scheduler", "none") as flying:
            eventually("some parts", lambda n=count: len(parts_of(out)) >= n)  # type: ignore[misc]
            assert flying.end(signal.SIGKILL) == -signal.SIGKILL
        kept = by_flight(out)
        assert 0 < len(kept["flight"]) < 300
        assert equal(kept, {name: values[kept["flight"]] for name, values in expected.items()})
    (out / ".flights-000000000200-000000000300.1.tmp").write_bytes(b"PAR1")
    with program(tmp_path, *LINE, "300", "-o", str(out), "--scheduler", "none") as flying:
        assert flying.wait() == 0, flying.stderr
        assert json.loads(flying.stdout)["flown_now"] == 300 - len(kept["flight"])
    assert equal(by_flight(out), expected)


@pytest.mark.long
def test_interrupted_it_ends_with_130_and_goes_on_later(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with program(tmp_path, *LINE, "300", "-o", str(out), "--scheduler", "none") as flying:
        eventually("some parts", lambda: len(parts_of(out)) >= 2)
        assert flying.end(signal.SIGINT) == 130
        assert (flying.stdout, flying.stderr.strip()) == ("", "")
    with program(tmp_path, *LINE, "300", "-o", str(out), "--scheduler", "none") as flying:
        assert flying.wait() == 0, flying.stderr
        assert json.loads(flying.stdout)["flown_now"] < 300
    assert equal(by_flight(out), fly(linked_as_asked(300), 0, 300))


@contextmanager
def two_workers(folder: Path, flights: int) -> Iterator[tuple[Program, list[int]]]:
    """Give a command that flies with a cluster of its own and has written some parts, and who works for it."""
    out = folder / "out"
    with program(folder, *LINE, str(flights), "-o", str(out), "--workers", "2") as flying:
        eventually("some parts", lambda: len(parts_of(out)) >= 6)
        workers = [pid for pid in children_of(flying.process.pid) if alive(pid)]
        assert len(workers) >= 2
        yield flying, workers


@pytest.mark.long
def test_ctrl_c_with_a_cluster_of_its_own_is_quiet_and_leaves_no_worker_behind(tmp_path: Path) -> None:
    """A terminal sends it to every process of the group."""
    with two_workers(tmp_path, 60000) as (flying, workers):
        os.killpg(flying.process.pid, signal.SIGINT)
        assert flying.wait() == 130
        assert (flying.stdout, flying.stderr.strip()) == ("", "")
    eventually("the end of the workers", lambda: not any(alive(pid) for pid in workers))


@pytest.mark.long
def test_killed_with_a_cluster_of_its_own_no_worker_is_left_behind(tmp_path: Path) -> None:
    with two_workers(tmp_path, 6000) as (flying, workers):
        flying.end(signal.SIGKILL)
    eventually("the end of the workers", lambda: not any(alive(pid) for pid in workers))
    kept = by_flight(tmp_path / "out")
    expected = fly(linked_as_asked(1), 0, int(kept["flight"][40]) + 1)
    assert equal({name: values[:41] for name, values in kept.items()},
                 {name: values[kept["flight"][:41]] for name, values in expected.items()})  # fmt: skip
