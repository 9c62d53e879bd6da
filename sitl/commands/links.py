"""The command ``sitl links``: which links there are by name, and after which measurements."""

from __future__ import annotations

from typing import Any

import click

from gains.command import print_json
from sitl.link.presets import PRESETS, SOURCES, preset_table

__all__ = ["link_options", "links"]

_LINK_OPTIONS = (
    click.option("--link", "preset", type=click.Choice(sorted(PRESETS)), help="A link for both directions."),
    click.option("--up", help="Plant to autopilot: delay=25ms,jitter=uniform:28ms,loss=0.1,... (docs/links.md)."),
    click.option("--down", help="Autopilot to plant, likewise."),
)


def link_options(command: Any) -> Any:
    """Add ``--link``, ``--up`` and ``--down`` to a click command; it gets ``preset, up, down``."""
    for option in reversed(_LINK_OPTIONS):
        command = option(command)
    return command


@click.command()
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def links(as_json: bool) -> None:
    """List the links by name: their SPECs, and where these come from."""
    rows = preset_table()
    if as_json:
        presets = {row.name: {key: value for key, value in row._asdict().items() if key != "name"} for row in rows}
        print_json({"presets": presets, "sources": dict(SOURCES)})
        return
    for row in rows:
        click.echo(f"{row.name}: {row.title}")
        directions = [("up, down", row.up)] if row.up == row.down else [("up", row.up), ("down", row.down)]
        for name, text in [*directions, ("source", row.source), ("chosen", row.chosen)]:
            click.echo(f"  {name:<9} {text}")
        click.echo()
    for name, text in SOURCES.items():
        click.echo(f"[{name}] {text}")
