"""The keys of one program: which of its links are signed, and where their timestamps are kept.

A key never comes from the command line, where every user of the machine could read it; options name files.
"""

from __future__ import annotations

from pathlib import Path

import click

from autopilot.link.clock import Clock
from autopilot.link.keyfile import TimestampStore, read_key, wall_clock_start
from autopilot.link.signing import Signing

__all__ = ["CONTROL_LINK", "Keyring", "ground_link"]

CONTROL_LINK = 0
"""Link id of both ends of the link between autopilot and plant: a frame of any other link is none of it."""


def ground_link(station: int) -> int:
    """Return the link id of what is sent to a ground station; each has its own."""
    return CONTROL_LINK + 1 + station


class Keyring:
    """Makes the signing of each link, and keeps their timestamps while they run.

    Parameters
    ----------
    program : str
        Its name; each program keeps timestamps of its own.
    clock : Clock
        The node's.
    """

    def __init__(self, program: str, clock: Clock) -> None:
        self._program = program
        self._clock = clock
        self._stores: dict[Path, tuple[bytes, TimestampStore]] = {}
        self._failed: set[Path] = set()

    def seal(
        self, port: str, key_file: Path, link_id: int, *, peer_link: int | None = None, accept_unsigned: bool = False
    ) -> Signing:
        """Return the signing of one port's link.

        Raises
        ------
        InputError
            When the key or the timestamps cannot be read, are malformed, or are open to others.
        """
        path = key_file.resolve()
        if path not in self._stores:
            key = read_key(path)
            self._stores[path] = key, TimestampStore(path, self._program, key)
        key, store = self._stores[path]
        start = wall_clock_start(self._clock.offset_ns)
        signing = Signing(key, link_id, start, store.load(port), accept_unsigned=accept_unsigned, peer_link=peer_link)
        store.attach(port, signing)
        return signing

    def pass_(self, now_ns: int) -> None:
        """Write what is due; called on every pass of the driver. A disk that fails is told of once."""
        for path, (_, store) in self._stores.items():
            store.pass_(now_ns)
            if store.failure and path not in self._failed:
                self._failed.add(path)
                why = f"{store.path}: not written ({store.failure}): old frames may pass after a restart"
                click.echo(f"{self._program}: warning: {why}", err=True)

    def close(self) -> None:
        """Write the exact timestamps; nothing is signed or accepted afterwards."""
        for _, store in self._stores.values():
            store.close()
