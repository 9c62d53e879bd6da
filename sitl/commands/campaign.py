"""``sitl campaign``: many flights at once, and what may be concluded from them."""

from __future__ import annotations

from pathlib import Path

import click

from gains.command import NEGATIVE, SUCCESS, print_json, require_writable
from gains.table import InputError
from sitl.commands.draws import Draws, draw_options, one_number, require_numba
from sitl.commands.links import link_options
from sitl.commands.options import FILE

__all__ = ["campaign"]


@click.command()
@click.option("--gains", "gains_names", multiple=True, required=True,
              help="What flies; several are flown on the same draws and compared, in pairs.")  # fmt: skip
@click.option("--delays", "delays_text", metavar="LAW",
              help="uniform, hold:P, geometric:MEAN (beyond it) or cycle:FILE.  [default: uniform]")  # fmt: skip
@draw_options
@link_options
@click.option("--wind", "wind_text", help="Of a nonlinear aircraft, as in dryden:moderate (README).")
@click.option("--flights", type=click.IntRange(1), default=100_000, show_default=True)
@click.option("--scheduler", default="local", show_default=True, metavar="ADDRESS",
              help="A Dask scheduler, tcp://HOST:PORT; local: this machine's cores; none: this process.")  # fmt: skip
@click.option("--workers", type=click.IntRange(1, 1024), help="Of this machine; default: one per core.")
@click.option(
    "--threshold",
    "threshold_text",
    help="An error beyond it is a failure, too: 0.5deg, for example; without a unit in the output's, radians.",
)
@click.option("-o", "--output", "folder", type=click.Path(file_okay=False, path_type=Path),
              help="Folder for the results of every flight, as Parquet; one with results is gone on with.")  # fmt: skip
@click.option("--page", type=FILE, help="Write an HTML page.")
@click.option(
    "--worst", type=FILE, help="Write d(k) of the flight of largest gain, or the first that diverged, as CSV."
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object on standard output.")
def campaign(
    gains_names: tuple[str, ...],
    delays_text: str | None,
    draws: Draws,
    preset: str | None,
    up: str | None,
    down: str | None,
    wind_text: str | None,
    flights: int,
    scheduler: str,
    workers: int | None,
    threshold_text: str | None,
    folder: Path | None,
    page: Path | None,
    worst: Path | None,
    as_json: bool,
) -> int:
    """Fly many flights, each with delays, gust, reference and uncertainty of its own, and count.

    \b
    sitl campaign --gains hirm-d6 --delay 1:6 --flights 1000000
    sitl campaign --gains hirm-paper --link lte --flights 10000 --page lte.html
    sitl campaign --gains hirm-d3 --gains hirm-d6 --delays geometric:2

    The exit code is 1 when a flight diverged, erred beyond the threshold, or exceeded η inside the window.
    """
    for file in (page, worst):
        if file is not None:
            require_writable(file)
    require_numba()
    from gains.store import load_law, require_law
    from gains.witnessfile import MAX_PERIOD
    from sitl.aircraft.wind import parse_wind
    from sitl.campaign.conducting import conduct
    from sitl.link.presets import parse_link

    twice = next((name for name in gains_names if gains_names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"--gains: expected different ones to compare, found {twice} twice")
    laws = {name: require_law(load_law(name)) for name in gains_names}
    first = laws[gains_names[0]]
    link = None if preset is None and up is None and down is None else parse_link(preset, up, down)
    if link is not None and delays_text is not None:
        raise InputError("--delays: expected none beside --link, --up and --down, which make the delays")
    delays = None if link is not None else draws.delays(first, delays_text or "uniform")
    wind = None if wind_text is None else parse_wind(wind_text)
    jobs = {name: draws.campaign(law, flights, delays, link, wind, first) for name, law in laws.items()}
    if worst is not None and draws.samples > MAX_PERIOD:
        raise InputError(f"--worst: expected at most {MAX_PERIOD} samples, found {draws.samples}")
    threshold = None if threshold_text is None else one_number(threshold_text, "--threshold")
    links = (preset, up and f"up {up}", down and f"down {down}")
    asked = " ".join(filter(None, links)) if delays is None else delays.text
    report = conduct(jobs, asked, scheduler, workers, threshold, folder, quiet=as_json)
    if worst is not None:
        report.write_worst(worst)
    if page is not None:
        report.write_page(page)
    if as_json:
        print_json(report.to_json())
    else:
        report.show()
    return NEGATIVE if report.negative else SUCCESS
