"""The door to Dask: a client of a scheduler that is there, or a cluster of this machine's cores."""

from __future__ import annotations

import logging
import re
import signal
import socket
import struct
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from gains.command import version
from gains.table import InputError

__all__ = ["connected", "dask_setup", "require_scheduler"]

_ADDRESS = re.compile(r"tcp://(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9.-]+):([0-9]{1,5})")

PATIENCE_S = 15.0
"""For a scheduler to answer, and for its first worker."""

_GREETING, _LONGEST_GREETING = struct.Struct("Q"), 1 << 20
"""What Dask sends first over tcp: the length in bytes of its handshake, which comes unasked."""


def require_scheduler(address: str) -> None:
    """Refuse an address where nothing greets as a Dask scheduler does, at once and on one line.

    Dask itself takes the first bytes of whatever is there for a length, and waits for so many or wants room for them.

    Raises
    ------
    InputError
    """
    match = _ADDRESS.fullmatch(address)
    if match is None:
        raise InputError(f'scheduler "{address}": expected local, none or tcp://HOST:PORT')
    _require_dask()
    try:
        with socket.create_connection((match[1].strip("[]"), int(match[2])), PATIENCE_S) as peer:
            peer.settimeout(PATIENCE_S)
            greeting = peer.recv(_GREETING.size, socket.MSG_WAITALL)
    except (OSError, OverflowError, UnicodeError) as error:
        raise InputError(f'scheduler "{address}": expected one with workers, found: {_said(error)}') from None
    if len(greeting) < _GREETING.size or not 0 < _GREETING.unpack(greeting)[0] < _LONGEST_GREETING:
        raise InputError(f'scheduler "{address}": expected a Dask scheduler, found something else')


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
    if address is not None:
        require_scheduler(address)
    _require_dask()
    from distributed import Client, LocalCluster

    with ExitStack() as stack:
        _silence(logging.getLogger("distributed.client"), stack)
        if address is None:
            cluster = stack.enter_context(
                LocalCluster(
                    n_workers=workers,
                    threads_per_worker=1,
                    host="127.0.0.1",
                    dashboard_address="127.0.0.1:0",
                    silence_logs=logging.CRITICAL,
                    preload=[__name__],
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


def dask_setup(_worker: Any) -> None:
    """Let a worker of this machine pass over Ctrl-C, which a terminal sends to it, too: the command ends it.

    Dask calls this by its name in each worker process that it starts with this module as ``preload``.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _require_dask() -> None:
    try:
        import distributed  # noqa: F401
    except ImportError:
        raise InputError("campaign: expected Dask (pip install 'lagproof[campaign]'), found none") from None


def _silence(logger: logging.Logger, stack: ExitStack) -> None:
    """Keep the traceback of a connection that is lost off stderr: the results that are lost with it say so."""
    stack.callback(logger.setLevel, logger.level)
    logger.setLevel(logging.CRITICAL)


def _said(error: Exception) -> str:
    """Return what an error says on one line."""
    return " ".join(str(error).split()) or type(error).__name__
