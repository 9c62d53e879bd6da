"""Files that describe the links of one relay.

A file holds a table ``[[link]]`` for each::

    [[link]]
    name = "gcs"
    listen = "127.0.0.1:14701"    # where the ground station, or autopilot, calls
    to = "127.0.0.1:14600"        # the vehicle, or plant
    accept = "any"                # or "mavlink", the default; peer = "ADDRESS" for one client alone
    seed = 7                      # without it the first link has 1, the second 2, ...
    preset = "radio"              # and, or, up and down, as on the command line
    up = "delay=40ms,loss=0.1"
    rules = ["up:ATTITUDE+AOA_SSA:delay=40ms"]
    changes = ["3s:up:loss=0.5"]
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from autopilot.link.ports import Address, parse_address
from gains.table import InputError, Table
from sitl.link.changes import MAX_CHANGES, Change, parse_change
from sitl.link.direction import LinkConfig
from sitl.link.presets import parse_link
from sitl.link.relay import MAX_LINKS
from sitl.link.rules import MAX_RULES, Rule, parse_rule
from sitl.seeds import MAX_SEED

__all__ = ["RelayLink", "load_relay", "parse_changes", "parse_rules"]

_NAME = re.compile(r"[a-z0-9_-]{1,32}")

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class RelayLink:
    """A link and its two ends.

    Attributes
    ----------
    config : LinkConfig
    listen, to : Address
        Where the client calls, and the far side.
    peer : Address or None
        The one client to hear; None for the first that is accepted.
    accept_any : bool
        Whether whatever a client sends makes it heard, and not only a frame of the autopilot.
    """

    config: LinkConfig
    listen: Address
    to: Address
    peer: Address | None = None
    accept_any: bool = False


def parse_rules(texts: Sequence[str], where: str = "rules") -> tuple[Rule, ...]:
    """Return the rules of one link.

    Raises
    ------
    InputError
        As :func:`parse_rule`, and for too many.
    """
    if len(texts) > MAX_RULES:
        raise InputError(f"{where}: expected at most {MAX_RULES}, found {len(texts)}")
    return tuple(map(parse_rule, texts))


def parse_changes(texts: Sequence[str], where: str = "changes") -> tuple[Change, ...]:
    """Return the changes of one link.

    Raises
    ------
    InputError
        As :func:`parse_change`, and for too many.
    """
    if len(texts) > MAX_CHANGES:
        raise InputError(f"{where}: expected at most {MAX_CHANGES}, found {len(texts)}")
    return tuple(map(parse_change, texts))


def load_relay(path: str | Path) -> tuple[RelayLink, ...]:
    """Return the links of a file.

    Raises
    ------
    InputError
        When the file is missing or says anything else than the head of the module tells, in one line.
    """
    table = Table.load(path)
    tables = table.tables("link")
    if not 1 <= len(tables) <= MAX_LINKS:
        raise table.error("link", f"1 to {MAX_LINKS} tables", str(len(tables)))
    links = tuple(_link(link, 1 + n) for n, link in enumerate(tables))
    names = [link.config.name for link in links]
    for n, name in enumerate(names):
        if name in names[:n]:
            raise tables[n].error("name", "a name of its own", name)
    table.finish()
    return links


def _link(table: Table, seed: int) -> RelayLink:
    """Return one link; ``seed`` is that of a link without one."""
    name = table.string("name")
    if not _NAME.fullmatch(name):
        raise table.error("name", "1 to 32 of a-z, 0-9, - and _", name[:40])
    preset, up, down, peer = (table.string(key, default=None) for key in ("preset", "up", "down", "peer"))
    up_spec, down_spec = _read(table, lambda: parse_link(preset, up, down))
    rules, changes = (table.strings(key, default=()) for key in ("rules", "changes"))
    config = LinkConfig(
        up_spec,
        down_spec,
        table.integer("seed", default=seed, low=0, high=MAX_SEED),
        name,
        _read(table, lambda: parse_rules(rules)),
        _read(table, lambda: parse_changes(changes)),
    )
    listen, to = table.string("listen"), table.string("to")
    return RelayLink(
        config,
        _read(table, lambda: parse_address(listen)),
        _read(table, lambda: parse_address(to)),
        None if peer is None else _read(table, lambda: parse_address(peer)),
        table.string("accept", default="mavlink", choices=("mavlink", "any")) == "any",
    )


def _read(table: Table, read: Callable[[], T]) -> T:
    """Return what a text of the table says; a complaint names file and table."""
    try:
        return read()
    except InputError as error:
        raise InputError(f"{table.source}: {table.field}: {error}") from None
