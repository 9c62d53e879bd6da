"""The options that say what flies, and from what flights are drawn: of ``sitl campaign`` and ``sitl rare``."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, fields
from functools import wraps
from typing import TYPE_CHECKING, Any, Literal

import click
import numpy as np

from gains.command import FiniteRange
from gains.proving import parse_window
from gains.table import InputError
from sitl.commands.options import SEED

if TYPE_CHECKING:
    from gains.model import GainLaw, Model
    from sitl.aircraft.wind import WindSpec
    from sitl.campaign.distributions import DelayProcess
    from sitl.campaign.job import Campaign
    from sitl.link.impairment import LinkSpec

__all__ = ["Draws", "draw_options", "one_number", "require_numba"]

_OPTIONS = (
    click.option("--plant", help="Another plant than the gains' model: a model, sixdof:NAME or jsbsim:NAME."),
    click.option("--delay", "window", metavar="MIN:MAX",
                 help="Window of delays in samples; default: the gain file's."),
    click.option("--transitions", type=click.Choice(["any", "fifo"]), default="any", show_default=True,
                 help="fifo: a delay exceeds the one before by at most one sample."),
    click.option("--gust", default="sine:0..3.5deg:0.5s..10s", show_default=True,
                 help="none, step:A, sine:A[:T], square:A[:T] or white:A; A and T numbers or spans LOW..HIGH, A in"
                 " the channel's unit, radians of an angle, without one."),
    click.option("--reference", default="square:0..5deg:1s..10s", show_default=True,
                 help="Likewise; of no meaning without a reference model."),
    click.option("--delta", default="0", show_default=True, help="Amplitude of the uncertainty, or a span."),
    click.option("--x0", type=FiniteRange(0.0), default=0.0, show_default=True,
                 help="Each state begins within so much of trim; 0 for gains to mean anything."),
    click.option("--limits", is_flag=True, help="Let the elevator's travel, lag and rate count."),
    click.option("--samples", type=click.IntRange(1), default=400, show_default=True),
    click.option("--seed", type=SEED, default=1, show_default=True, help="Of everything random."),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Draws:
    """What :func:`draw_options` were given; angles and spans are texts yet."""

    plant: str | None
    window: str | None
    transitions: Literal["any", "fifo"]
    gust: str
    reference: str
    delta: str
    x0: float
    limits: bool
    samples: int
    seed: int

    def delays(self, law: GainLaw, text: str) -> DelayProcess:
        """Return the process that a text names, on the window of the options or else the law's.

        Raises
        ------
        InputError
            When the text names none, or the window is longer than can be flown.
        """
        from sitl.campaign.distributions import parse_delays
        from sitl.campaign.kernel import MAX_DELAY

        d_min, d_max = self.window_of(law)
        return parse_delays(text, d_min, d_max, fifo=self.transitions == "fifo", longest=MAX_DELAY)

    def campaign(
        self,
        law: GainLaw,
        flights: int,
        delays: DelayProcess | None,
        link: tuple[LinkSpec, LinkSpec] | None = None,
        wind: WindSpec | None = None,
        first: GainLaw | None = None,
    ) -> Campaign:
        """Return the campaign of a law.

        Parameters
        ----------
        law : Gains or Schedule
        flights : int
        delays : DelayProcess or None
        link : (LinkSpec, LinkSpec), optional
            Up and down, where these make the delays.
        wind : WindSpec, optional
        first : Gains or Schedule, optional
            Of several laws that are compared the first: its model is what all of them fly, and its window what is
            claimed, where the options say neither.

        Raises
        ------
        InputError
            When a text means nothing, or the plant cannot do what is asked.
        """
        from sitl.aircraft.plants import plant_model
        from sitl.campaign.distributions import parse_signal, parse_span
        from sitl.campaign.job import Campaign

        own = (first or law).model
        plant = own if self.plant is None else plant_model(self.plant, own)
        _check_fit(law, plant)
        _check_references(first or law, law)
        d_min, d_max = self.window_of(first or law)
        job = Campaign(
            law=law,
            plant=plant,
            plant_name=self.plant or own.name,
            d_min=d_min,
            d_max=d_max,
            transitions=self.transitions,
            delays=delays,
            link=link,
            gust=parse_signal(self.gust, "gust"),
            reference=parse_signal(self.reference if law.model.reference is not None else "none", "reference"),
            delta=parse_span(self.delta, "delta", {"": 1.0}),
            x0=self.x0,
            wind=wind,
            limits=self.limits,
            flights=flights,
            samples=self.samples,
            seed=self.seed,
        )
        _check_possible(job)
        return job

    def window_of(self, law: GainLaw) -> tuple[int, int]:
        """Return (d_min, d_max) of the options or else the law's."""
        from sitl.campaign.kernel import MAX_DELAY

        d_min, d_max = (law.d_min, law.d_max) if self.window is None else parse_window(self.window)
        if d_max > MAX_DELAY:
            raise InputError(f"--delay: expected at most {MAX_DELAY} samples, found {d_max}")
        return d_min, d_max


def draw_options(command: Callable[..., int]) -> Callable[..., int]:
    """Add the options to a command, which gets them as one argument, ``draws``."""
    names = [field.name for field in fields(Draws)]

    @wraps(command)
    def with_draws(**given: Any) -> int:
        draws = Draws(**{name: given.pop(name) for name in names})
        return command(draws=draws, **given)

    decorated: Callable[..., int] = with_draws
    for option in reversed(_OPTIONS):
        decorated = option(decorated)
    return decorated


def one_number(text: str, option: str) -> float:
    """Return the number above 0, with or without a unit of angle, that a text names.

    Raises
    ------
    InputError
        When it names none, or a span.
    """
    from sitl.campaign.distributions import parse_span

    low = high = 0.0
    with suppress(InputError):  # what is no number, as what is none above 0
        low, high = parse_span(text, option)
    if low != high or low <= 0.0:
        raise InputError(f'{option} "{text}": expected a number above 0, such as 2deg')
    return high


def require_numba() -> None:
    """Refuse an installation without what compiles flights, and writes them."""
    try:
        import numba  # noqa: F401
        import pyarrow  # noqa: F401
    except ImportError:
        raise InputError("expected numba and pyarrow (pip install 'lagproof[campaign]'), found none") from None


def _check_fit(law: GainLaw, plant: Model) -> None:
    """Refuse a plant that the gains' state or sampling does not describe."""
    if plant.states != law.model.states or plant.Ts_ns != law.model.Ts_ns:
        raise InputError(
            f"gains {law.name}: expected a plant with states {', '.join(law.model.states)} at Ts {law.model.Ts} s,"
            f" found {plant.name} with {', '.join(plant.states)} at {plant.Ts} s"
        )


def _check_references(first: GainLaw, law: GainLaw) -> None:
    """Refuse to compare laws that do not track the same: errors from references of their own are no pairs."""
    one, other = first.model.reference, law.model.reference
    if one is None or other is None:
        same = one is other
    else:
        same = all(np.array_equal(getattr(one, name), getattr(other, name)) for name in ("Ar", "Br", "Cr"))
    if not same:
        raise InputError(
            f"--gains: expected gains with the same reference model to compare, found {first.name} and {law.name}"
            " with others"
        )


def _check_possible(job: Campaign) -> None:
    """Refuse what the plant cannot do."""
    from sitl.aircraft.plants import airframe_maker, is_nonlinear
    from sitl.campaign.job import MAX_FLIGHTS, MAX_SAMPLES
    from sitl.campaign.signals import MAX_CHANNELS

    for option, number, most in (("--flights", job.flights, MAX_FLIGHTS), ("--samples", job.samples, MAX_SAMPLES)):
        if number > most:
            raise InputError(f"{option}: expected at most {most}, found {number}")
    channels = max(job.plant.nw, 0 if job.law.model.reference is None else job.law.model.reference.Br.shape[1])
    if channels > MAX_CHANNELS:
        raise InputError(f"--plant: expected at most {MAX_CHANNELS} channels of gust or reference, found {channels}")
    nonlinear = is_nonlinear(job.plant_name)
    if job.uncertain and (nonlinear or job.plant.uncertainty is None):
        raise InputError(f"--delta: expected a linear plant with [uncertainty], found {job.plant_name} without")
    if nonlinear and job.x0 > 0.0:
        raise InputError(f"--x0: expected a linear model as plant, found {job.plant_name}")
    airframe_maker(job.plant_name, job.plant, job.wind, job.seed)
    if job.limits and job.plant.actuator is None:
        raise InputError(f"--limits: expected a plant with [actuator], found {job.plant_name} without")
