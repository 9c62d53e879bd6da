"""Campaigns by Dask, and campaigns that are killed: neither changes a number."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import distributed
import numpy as np
import pyarrow.parquet as pq
import pytest
from distributed import LocalCluster

from gains.table import InputError
from sitl.campaign import cluster, tasks
from sitl.campaign.run import run
from sitl.link.presets import parse_link
from tests.integration.programs import ENVIRONMENT, eventually
from tests.sitl.test_campaign_parts import campaign, equal, parts_in

LINKED = {"delays": None, "link": parse_link("lte", None, None), "samples": 400}
"""Flown in Python, some ten milliseconds a flight: long enough to be killed in the middle."""


@pytest.fixture(scope="module")
def dask() -> Iterator[LocalCluster]:
    with LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
        silence_logs=logging.CRITICAL,
    ) as local:
        yield local


def processes_of(local: LocalCluster) -> set[int]:
    return {worker.pid for worker in local.workers.values() if worker.pid is not None}


def test_a_cluster_flies_the_same_to_the_last_bit(dask: LocalCluster) -> None:
    job = campaign(flights=3000)
    outcome = run(job, scheduler=dask.scheduler_address)
    assert outcome.workers == 2
    assert equal(outcome.columns, run(job, scheduler="none", workers=1).columns)


def test_links_are_sampled_by_a_cluster_as_by_one_process(dask: LocalCluster, tmp_path: Path) -> None:
    job = campaign(**LINKED, flights=40)
    outcome = run(job, scheduler=dask.scheduler_address, parts=parts_in(tmp_path, job))
    assert len(list(tmp_path.glob("flights-*"))) > 4
    assert equal(outcome.columns, tasks.fly(job, 0, 40))


@pytest.mark.long
def test_a_worker_that_is_killed_changes_nothing(dask: LocalCluster) -> None:
    job, killed, told = campaign(**LINKED, flights=600), set[int](), 0

    def kill_one(flights: int) -> None:
        nonlocal told
        told += flights
        if told >= 100 and not killed:
            victim = min(processes_of(dask))
            os.kill(victim, signal.SIGKILL)
            killed.add(victim)

    outcome = run(job, scheduler=dask.scheduler_address, told=kill_one)
    assert killed
    assert told == 600
    eventually("another worker in its place", lambda: len(processes_of(dask)) == 2)
    assert not killed & processes_of(dask)
    assert equal(outcome.columns, run(job, scheduler="none", workers=1).columns)


@pytest.mark.long
def test_a_campaign_that_is_killed_goes_on_where_it_was(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "sitl", "campaign", "--gains", "hirm-paper", "--link", "lte", "--flights", "300",
               "--scheduler", "none", "--json", "-o"]  # fmt: skip
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    subprocess.run([*command, str(whole)], env=ENVIRONMENT, check=True, capture_output=True, timeout=120)
    for parts in (2, 5):
        process = subprocess.Popen([*command, str(broken)], env=ENVIRONMENT, stdout=subprocess.DEVNULL)
        eventually("some parts", lambda n=parts: len(list(broken.glob("flights-*.parquet"))) >= n)  # type: ignore[misc]
        process.kill()
        process.wait()
    kept = {path.name for path in broken.glob("flights-*")}
    assert len(kept) < len(list(whole.glob("flights-*")))
    subprocess.run([*command, str(broken)], env=ENVIRONMENT, check=True, capture_output=True, timeout=120)
    assert kept <= {path.name for path in broken.glob("flights-*")}
    assert equal(*(by_flight(folder) for folder in (whole, broken)))


def by_flight(folder: Path) -> dict[str, Any]:
    table = pq.read_table(folder).sort_by("flight")
    return {name: np.asarray(table[name]) for name in table.column_names}


def test_a_scheduler_that_is_not_there_is_named_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "PATIENCE_S", 1.0)
    with pytest.raises(InputError, match=r"tcp://127\.0\.0\.1:9") as refused:
        run(campaign(), scheduler="tcp://127.0.0.1:9")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "address", ["", "nonsense", "tcp://", "tcp://127.0.0.1", "127.0.0.1:8786", "tcp://127.0.0.1:x", "gopher://there:70"]
)
def test_what_is_no_address_is_refused_on_one_line(address: str) -> None:
    with pytest.raises(InputError, match="expected local, none or tcp://HOST:PORT"):
        run(campaign(), scheduler=address)


@pytest.mark.parametrize("address", ["tcp://10.0.0.7:8786", "tls://dask.example.org:8786", "tcp://[::1]:8786"])
def test_addresses_of_schedulers_are_asked(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def nobody(address: str, **_: object) -> None:
        asked.append(address)
        raise OSError("nobody is there")

    monkeypatch.setattr(distributed, "Client", nobody)
    with pytest.raises(InputError, match="nobody is there"):
        run(campaign(), scheduler=address)
    assert asked == [address]


def test_workers_of_another_version_are_refused(dask: LocalCluster, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "version", lambda: f"of process {os.getpid()}")
    with pytest.raises(InputError, match="expected workers of lagproof"):
        run(campaign(), scheduler=dask.scheduler_address)


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="Linux tells who listens where")
def test_the_local_cluster_listens_on_this_machine_alone() -> None:
    before = listening()
    with cluster.connected(None, 1) as client:
        assert len(client.scheduler_info()["workers"]) == 1
        opened = listening() - before
    assert opened
    assert {address for address, _ in opened} == {"0100007F"}


def listening() -> set[tuple[str, str]]:
    """Return addresses and ports, in hexadecimal as the kernel has them, of both families."""
    lines = [line.split() for file in ("tcp", "tcp6") for line in Path("/proc/net", file).read_text().splitlines()[1:]]
    return {(local.partition(":")[0], local.partition(":")[2]) for _, local, _, state, *_ in lines if state == "0A"}
