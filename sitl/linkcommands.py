"""The command ``sitl links``: which links there are by name, and after which measurements."""

from __future__ import annotations

import click

from gains.command import print_json
from sitl.link.presets import SOURCES, preset_table

__all__ = ["links"]


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
