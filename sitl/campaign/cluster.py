"""The door to Dask: a client of a scheduler that is there, or a cluster of this machine's cores."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from gains.command import version
from gains.table import InputError

__all__ = ["connected"]

_ADDRESS = re.compile(r"(tcp|tls)://(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9.-]+):[0-9]{1,5}")

PATIENCE_S = 15.0
"""For a scheduler to answer, and for its first worker."""


@contextmanager
def connected(address: str | None, workers: int) -> Iterator[Any]:
    """Yield a client.

    Parameters
    ----------
    address : str or None
        Of a scheduler; None starts workers on this machine, on 127.0.0.1 alone, and ends them.
    workers : int
        How many to start; each a process of one thread.

    Raises
    ------
    InputError
        When nobody answers, no worker is there, or one has not the same version of this package.
    """
    if address is not None and not _ADDRESS.fullmatch(address):  # some of what is none keeps Dask waiting for ever
        raise InputError(f'scheduler "{address}": expected local, none or tcp://HOST:PORT')
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        raise InputError("campaign: expected Dask (pip install 'lagproof[campaign]'), found none") from None
    with ExitStack() as stack:
        _silence(logging.getLogger("distributed.client"), stack)
        if address is None:
            cluster = stack.enter_context(
                LocalCluster(
                    n_workers=workers,
                    threads_per_worker=1,
                    host="127.0.0.1",
                    dashboard_address="127.0.0.1:0",
                    silence_logs=logging.ERROR,
                )
            )
            address = cluster.scheduler_address
        try:
            client = stack.enter_context(Client(address, timeout=PATIENCE_S, set_as_default=False))
            client.wait_for_workers(1, timeout=PATIENCE_S)
            found = set(client.run(version).values())
        except (OSError, TimeoutError, ValueError) as error:
            raise InputError(f'scheduler "{address}": expected one with workers, found: {_said(error)}') from None
        except ModuleNotFoundError as error:
            raise InputError(f'scheduler "{address}": expected workers with lagproof, found: {error}') from None
        if found != {version()}:
            raise InputError(
                f'scheduler "{address}": expected workers of lagproof {version()}, found {", ".join(sorted(found))}'
            )
        yield client


def _silence(logger: logging.Logger, stack: ExitStack) -> None:
    """Keep the traceback of a connection that is lost off stderr: the results that are lost with it say so."""
    stack.callback(logger.setLevel, logger.level)
    logger.setLevel(logging.CRITICAL)


def _said(error: Exception) -> str:
    """Return what an error says on one line."""
    return " ".join(str(error).split()) or type(error).__name__
