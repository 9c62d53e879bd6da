"""Campaigns by Dask: not a number changes, and no port opens but on this machine. What breaks: test_campaign_crash."""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import distributed
import pytest
from distributed import LocalCluster

from gains.table import InputError
from sitl.campaign import cluster, tasks
from sitl.campaign.run import run
from sitl.link.presets import parse_link
from tests.sitl.campaigns import local_cluster
from tests.sitl.test_campaign_parts import campaign, equal, parts_in

LINKED = {"delays": None, "link": parse_link("lte", None, None), "samples": 400}
"""Flown in Python, some ten milliseconds a flight: long enough to be killed in the middle."""


@pytest.fixture(scope="module")
def dask() -> Iterator[LocalCluster]:
    with local_cluster() as local:
        yield local


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


@pytest.mark.parametrize(
    "address",
    [
        "",
        "nonsense",
        "tcp://",
        "tcp://127.0.0.1",
        "127.0.0.1:8786",
        "tcp://127.0.0.1:x",
        "gopher://there:70",
        "tls://127.0.0.1:8786",
    ],
)
def test_what_is_no_address_is_refused_on_one_line(address: str) -> None:
    with pytest.raises(InputError, match="expected local, none or tcp://HOST:PORT"):
        run(campaign(), scheduler=address)


@pytest.mark.parametrize("address", ["tcp://10.0.0.7:8786", "tcp://dask.example.org:8786", "tcp://[::1]:8786"])
def test_addresses_of_schedulers_are_asked(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def nobody(address: str, **_: object) -> None:
        asked.append(address)
        raise OSError("nobody is there")

    monkeypatch.setattr(cluster, "require_scheduler", lambda _: None)
    monkeypatch.setattr(distributed, "Client", nobody)
    with pytest.raises(InputError, match="nobody is there"):
        run(campaign(), scheduler=address)
    assert asked == [address]


@pytest.mark.parametrize("greeting", [b"", b"SSH-2.0-OpenSSH_9.2p1\r\n", b"HTTP", b"\0" * 16, None])
def test_what_greets_otherwise_than_a_scheduler_is_refused_on_one_line(
    greeting: bytes | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "PATIENCE_S", 0.3)
    over = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as server:

        def greet() -> None:
            peer, _ = server.accept()
            with peer:
                if greeting is None:  # as a web server, which waits to be asked
                    over.wait(30.0)
                else:
                    peer.sendall(greeting)

        thread = threading.Thread(target=greet)
        thread.start()
        with pytest.raises(InputError) as refused:
            cluster.require_scheduler(f"tcp://127.0.0.1:{server.getsockname()[1]}")
        over.set()
        thread.join()
    assert "scheduler" in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_scheduler_is_one(dask: LocalCluster) -> None:
    cluster.require_scheduler(dask.scheduler_address)


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
