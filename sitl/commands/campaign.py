"""``sitl campaign``: many flights at once, and what may be concluded from them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from gains.command import NEGATIVE, SUCCESS, FiniteRange, print_json, require_writable
from gains.proving import parse_window
from gains.table import InputError
from sitl.commands.links import link_options
from sitl.commands.options import FILE, SEED

if TYPE_CHECKING:
    from gains.model import GainLaw, Model
    from sitl.campaign.job import Campaign

__all__ = ["campaign"]

MISSING = "campaign: expected numba and pyarrow (pip install 'lagproof[campaign]'), found none"
_NOT_NEGATIVE = FiniteRange(0.0)


@click.command()
@click.option("--gains", "gains_names", multiple=True, required=True,
              help="What flies; several are flown on the same draws and compared, in pairs.")  # fmt: skip
@click.option("--plant", "plant_name", help="Another plant than the gains' model: a model, sixdof:NAME or jsbsim:NAME.")
@click.option("--delay", "window", metavar="MIN:MAX", help="Window of delays in samples; default: the gain file's.")
@click.option("--delays", "delays_text", metavar="LAW",
              help="uniform, hold:P, geometric:MEAN (beyond it) or cycle:FILE.  [default: uniform]")  # fmt: skip
@click.option("--transitions", type=click.Choice(["any", "fifo"]), default="any", show_default=True,
              help="fifo: a delay exceeds the one before by at most one sample.")  # fmt: skip
@link_options
@click.option("--gust", "gust_text", default="sine:0..3.5deg:0.5s..10s", show_default=True,
              help="none, step:A, sine:A[:T], square:A[:T] or white:A, with numbers or spans LOW..HIGH.")  # fmt: skip
@click.option("--reference", "reference_text", default="square:0..5deg:1s..10s", show_default=True,
              help="Likewise; of no meaning without a reference model.")  # fmt: skip
@click.option("--delta", "delta_text", default="0", show_default=True, help="Amplitude of the uncertainty, or a span.")
@click.option("--x0", type=_NOT_NEGATIVE, default=0.0, show_default=True,
              help="Each state begins within so much of trim; 0 for gains to mean anything.")  # fmt: skip
@click.option("--wind", "wind_text", help="Of a nonlinear aircraft, as in dryden:moderate (README).")
@click.option("--limits", is_flag=True, help="Let the elevator's travel, lag and rate count.")
@click.option("--flights", type=click.IntRange(1), default=100_000, show_default=True)
@click.option("--samples", type=click.IntRange(1), default=400, show_default=True)
@click.option("--seed", type=SEED, default=1, show_default=True, help="Of everything random.")
@click.option("--scheduler", default="local", show_default=True, metavar="ADDRESS",
              help="A Dask scheduler, tcp://HOST:PORT; local: this machine's cores; none: this process.")  # fmt: skip
@click.option("--workers", type=click.IntRange(1, 1024), help="Of this machine; default: one per core.")
@click.option("--threshold", "threshold_text", help="An error beyond it is a failure, too: 0.5deg, for example.")
@click.option("-o", "--output", "folder", type=click.Path(file_okay=False, path_type=Path),
              help="Folder for the results of every flight, as Parquet; one with results is gone on with.")  # fmt: skip
@click.option("--page", type=FILE, help="Write an HTML page.")
@click.option(
    "--worst", type=FILE, help="Write d(k) of the flight of largest gain, or the first that diverged, as CSV."
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object on standard output.")
def campaign(
    gains_names: tuple[str, ...],
    plant_name: str | None,
    window: str | None,
    delays_text: str | None,
    transitions: Literal["any", "fifo"],
    preset: str | None,
    up: str | None,
    down: str | None,
    gust_text: str,
    reference_text: str,
    delta_text: str,
    x0: float,
    wind_text: str | None,
    limits: bool,
    flights: int,
    samples: int,
    seed: int,
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

    The exit code is 1 when a flight diverged, or exceeded η inside the window.
    """
    _require_possible(page, worst)
    from gains.store import load_law, require_law
    from sitl.aircraft.plants import plant_model
    from sitl.aircraft.wind import parse_wind
    from sitl.campaign.conducting import conduct
    from sitl.campaign.distributions import parse_delays, parse_signal, parse_span
    from sitl.campaign.job import Campaign
    from sitl.campaign.kernel import MAX_DELAY
    from sitl.link.presets import parse_link

    laws = [require_law(load_law(name)) for name in gains_names]
    first = laws[0]
    name = plant_name or first.model.name
    plant = first.model if plant_name is None else plant_model(plant_name, first.model)
    for law in laws:
        _check_fit(law, plant)
    d_min, d_max = (first.d_min, first.d_max) if window is None else parse_window(window)
    if d_max > MAX_DELAY:
        raise InputError(f"--delay: expected at most {MAX_DELAY} samples, found {d_max}")
    link = None if preset is None and up is None and down is None else parse_link(preset, up, down)
    if link is not None and delays_text is not None:
        raise InputError("--delays: expected none beside --link, --up and --down, which make the delays")
    delays = parse_delays(delays_text or "uniform", d_min, d_max, fifo=transitions == "fifo", longest=MAX_DELAY)
    jobs = [
        Campaign(
            law=law,
            plant=plant,
            plant_name=name,
            d_min=d_min,
            d_max=d_max,
            transitions=transitions,
            delays=delays if link is None else None,
            link=link,
            gust=parse_signal(gust_text, "gust"),
            reference=parse_signal(reference_text if law.model.reference is not None else "none", "reference"),
            delta=parse_span(delta_text, "delta", {"": 1.0}),
            x0=x0,
            wind=None if wind_text is None else parse_wind(wind_text),
            limits=limits,
            flights=flights,
            samples=samples,
            seed=seed,
        )
        for law in laws
    ]
    for job in jobs:
        _check_possible(job)
    asked = (
        delays.text if link is None else " ".join(filter(None, (preset, up and f"up {up}", down and f"down {down}")))
    )
    threshold = None if threshold_text is None else _number(threshold_text, "threshold")
    report = conduct(
        dict(zip(gains_names, jobs, strict=True)), asked, scheduler, workers, threshold, folder, quiet=as_json
    )
    if worst is not None:
        report.write_worst(worst)
    if page is not None:
        report.write_page(page)
    if as_json:
        print_json(report.to_json())
    else:
        report.show()
    return NEGATIVE if report.negative else SUCCESS


def _number(text: str, what: str) -> float:
    """Return one number with or without a unit of angle."""
    from sitl.campaign.distributions import parse_span

    low, high = parse_span(text, f'{what} "{text}"')
    if low != high:
        raise InputError(f'{what} "{text}": expected one number')
    return high


def _require_possible(*files: Path | None) -> None:
    """Refuse, before anything is flown, files that cannot be written, and an installation without what flies."""
    for file in files:
        if file is not None:
            require_writable(file)
    try:
        import numba  # noqa: F401
        import pyarrow  # noqa: F401
    except ImportError:
        raise InputError(MISSING) from None


def _check_fit(law: GainLaw, plant: Model) -> None:
    """Refuse a plant that the gains' state or sampling does not describe."""
    if plant.states != law.model.states or plant.Ts_ns != law.model.Ts_ns:
        raise InputError(
            f"gains {law.name}: expected a plant with states {', '.join(law.model.states)} at Ts {law.model.Ts} s,"
            f" found {plant.name} with {', '.join(plant.states)} at {plant.Ts} s"
        )


def _check_possible(job: Campaign) -> None:
    """Refuse what the plant cannot do."""
    from sitl.aircraft.plants import airframe_maker, is_nonlinear
    from sitl.campaign.job import MAX_FLIGHTS, MAX_SAMPLES

    for option, number, most in (("--flights", job.flights, MAX_FLIGHTS), ("--samples", job.samples, MAX_SAMPLES)):
        if number > most:
            raise InputError(f"{option}: expected at most {most}, found {number}")
    nonlinear = is_nonlinear(job.plant_name)
    if job.uncertain and (nonlinear or job.plant.uncertainty is None):
        raise InputError(f"--delta: expected a linear plant with [uncertainty], found {job.plant_name} without")
    if nonlinear and job.x0 > 0.0:
        raise InputError(f"--x0: expected a linear model as plant, found {job.plant_name}")
    airframe_maker(job.plant_name, job.plant, job.wind, job.seed)
    limits: Any = job.plant.actuator
    if job.limits and limits is None:
        raise InputError(f"--limits: expected a plant with [actuator], found {job.plant_name} without")
