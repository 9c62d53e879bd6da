"""Types of options that several subcommands take. Light: each program loads it."""

from __future__ import annotations

from pathlib import Path

import click

from sitl.seeds import MAX_SEED

__all__ = ["FILE", "SEED"]

FILE = click.Path(dir_okay=False, path_type=Path)
SEED = click.IntRange(0, MAX_SEED)
