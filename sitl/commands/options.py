"""Types of options that several subcommands take. Light: each program loads it."""

from __future__ import annotations

from pathlib import Path

import click

from autopilot.link.ports import Address, parse_address
from autopilot.link.process import Parsed
from gains.table import InputError
from sitl.seeds import MAX_SEED

__all__ = ["CONTROL", "FILE", "SEED"]

FILE = click.Path(dir_okay=False, path_type=Path)
SEED = click.IntRange(0, MAX_SEED)


def _parse_control(text: str) -> Address:
    """Return the address written as ``[HOST:]PORT``, on 127.0.0.1 unless a host is named."""
    try:
        address = parse_address(text if ":" in text else f"127.0.0.1:{text}")
    except InputError:
        address = ("", 0)
    if not address[1]:  # at any free port nobody would know where to ask
        raise InputError(f'--control "{text}": expected [HOST:]PORT, from 1 to 65535; a SCENARIO goes before it')
    return address


CONTROL = Parsed("[HOST:]PORT", _parse_control)
"""Where a relay takes requests."""
