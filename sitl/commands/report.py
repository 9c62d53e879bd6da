"""The command ``sitl report``: one HTML page of one recorded flight, or of several side by side."""

from __future__ import annotations

import time
from pathlib import Path

import click

from gains.command import print_json, require_writable
from gains.table import InputError

__all__ = ["report"]

FILE = click.Path(path_type=Path)

_clock = time.perf_counter  # noqa: TID251  # a command says how long it took


@click.command()
@click.argument("recordings", metavar="FLIGHT.mcap...", nargs=-1, required=True, type=FILE)
@click.option(
    "-o",
    "--output",
    type=click.Path(dir_okay=False, path_type=Path),
    default=Path("report.html"),
    show_default=True,
    help="The page; an existing one is replaced.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def report(recordings: tuple[Path, ...], output: Path, as_json: bool) -> None:
    """Write a page about a recorded flight: tracking, delay, link, failsafe, and what is proved.

    Several recordings are drawn over one another, with their numbers side by side. The page is one file and needs no
    network. A recording is enough: it holds the model and the gains that it was flown with.
    """
    from gains.atomic import replace_file
    from sitl.flightfile import load_flight
    from sitl.report.page import report as page  # with Bokeh: --help does without
    from sitl.report.panels import MAX_FLIGHTS

    begun = _clock()
    if len(recordings) > MAX_FLIGHTS:
        raise InputError(f"expected at most {MAX_FLIGHTS} recordings on one page, found {len(recordings)}")
    require_writable(output)
    for recording in recordings:
        if output.exists() and recording.exists() and output.samefile(recording):
            raise InputError(f"{output}: expected another file than the recording itself")
    files = [load_flight(recording) for recording in recordings]
    content = page(files).encode()
    replace_file(output, content)
    seconds = _clock() - begun
    if as_json:
        flights = [{"name": file.name, "samples": len(file.flight.time_s)} for file in files]
        print_json({"file": output, "bytes": len(content), "flights": flights, "seconds": seconds})
    else:
        click.echo(f"{output}: {len(content) / 1e6:.1f} MB, {', '.join(file.name for file in files)}, {seconds:.1f} s")
