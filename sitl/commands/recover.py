"""``sitl recover``: what a recording holds that was cut off, in a new file that every reader reads."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import click

from gains.command import NEGATIVE, SUCCESS, print_json
from sitl.rescue import Rescue, recover

__all__ = ["recover_command"]

FILE = click.Path(path_type=Path)


@click.command("recover")
@click.argument("recording", metavar="FILE", type=FILE)
@click.option("-o", "--out", type=FILE, help="The new file; FILE.recovered.mcap by default.")
@click.option("--force", is_flag=True, help="Replace the new file if it exists.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def recover_command(recording: Path, out: Path | None, force: bool, as_json: bool) -> int:
    """Rescue what a recording holds that was cut off: exit 1 when that is nothing.

    FILE stays as it is; a complete one is copied.
    """
    target = out or recording.with_name(f"{recording.name.removesuffix('.mcap')}.recovered.mcap")
    rescue = recover(recording, target, force=force)
    if as_json:
        file = None if rescue.nothing else str(target)
        print_json({"file": file, **asdict(rescue), "seconds": rescue.seconds})
    elif rescue.nothing:
        click.echo(f"sitl: error: {recording}: nothing to rescue in its {rescue.bytes_read} bytes", err=True)
    else:
        click.echo(_told(recording, target, rescue))
    return NEGATIVE if rescue.nothing else SUCCESS


def _told(recording: Path, target: Path, rescue: Rescue) -> str:
    """Return what was rescued, for a person."""
    held = f"{rescue.messages} messages, {rescue.seconds:.3f} s"
    if rescue.complete:
        return f"{recording} is complete: {held}; copied to {target}"
    losses = [
        f"{number} {what}"
        for number, what in (
            (rescue.damaged_chunks, "damaged chunks"),
            (rescue.dropped_messages, "messages that nothing describes"),
            (rescue.dropped_records, "records malformed or beyond a limit"),
        )
        if number
    ]
    dropped = f"{rescue.bytes_dropped} of {rescue.bytes_read} bytes dropped"
    return f"rescued {held} from {recording} to {target}\n" + ", ".join((dropped, *losses))
