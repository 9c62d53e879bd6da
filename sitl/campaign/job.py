"""A campaign as data: what flies, how often, and from what each flight is drawn.

A :class:`Campaign` goes to workers on other machines as it is, and its :func:`identity` names it on disk: of two
campaigns with the same identity flight n is the same flight, to the last bit.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np

from gains.model import GainLaw, Model, sets_of
from gains.switched import Transitions
from sitl.aircraft.plants import is_nonlinear
from sitl.aircraft.wind import WindSpec
from sitl.campaign.distributions import DelayProcess, Signal, Span
from sitl.link.impairment import LinkSpec

__all__ = ["MAX_FLIGHTS", "MAX_SAMPLES", "Campaign", "identity"]

MAX_FLIGHTS = 10**12
MAX_SAMPLES = 10**6

FORMAT = 3
"""Of what is drawn how: a campaign that was begun with another one is not gone on with."""


@dataclass(frozen=True, slots=True, eq=False)
class Campaign:
    """Flights drawn from declared distributions.

    Attributes
    ----------
    law : Gains or Schedule
        What flies.
    plant : Model
        What is flown, or what describes it.
    plant_name : str
        As ``--plant`` names it: linear, ``sixdof:…`` or ``jsbsim:…``.
    d_min, d_max : int
        The window that is claimed.
    transitions : {"any", "fifo"}
    delays : DelayProcess or None
        None where a link makes them.
    link : (LinkSpec, LinkSpec) or None
        Up and down.
    gust, reference : Signal
    delta : Span
        Amplitude of the uncertainty, a square wave like Eq. (51) of a period and a phase of its own.
    x0 : float
        Each state begins within ± x0; 0 for trim.
    wind : WindSpec or None
        Of a nonlinear aircraft.
    limits : bool
        Whether the elevator's travel, lag and rate count.
    flights, samples, seed : int
    """

    law: GainLaw
    plant: Model
    plant_name: str
    d_min: int
    d_max: int
    transitions: Transitions
    delays: DelayProcess | None
    link: tuple[LinkSpec, LinkSpec] | None
    gust: Signal
    reference: Signal
    delta: Span
    x0: float
    wind: WindSpec | None
    limits: bool
    flights: int
    samples: int
    seed: int

    @property
    def uncertain(self) -> bool:
        """Whether the uncertainty is at work."""
        return self.delta.high > 0.0


def identity(campaign: Campaign) -> str:
    """Return what tells campaigns of other flights apart, 64 hexadecimal digits; how many are flown does not count.

    All that a flight is computed from counts, to the last bit: the plant with its actuator and trim, the gains, the
    reference model, and of a ``sixdof:`` aircraft the numbers of its file (of a ``jsbsim:`` one its name alone). Names
    of models, certificates, and how an option was worded do not.
    """
    law, delays = campaign.law, campaign.delays
    drawn = (
        (campaign.d_min, campaign.d_max, campaign.transitions),
        None if delays is None else (delays.weights, delays.d_min, delays.hold, delays.fifo, delays.cycle),
        campaign.link,
        (campaign.gust, campaign.reference, campaign.delta, campaign.x0),
        (campaign.wind, campaign.limits, campaign.samples, campaign.seed),
    )
    flown = (
        campaign.plant_name if is_nonlinear(campaign.plant_name) else "linear",
        _aircraft(campaign.plant_name),
        campaign.plant,
        law.model,
        [(gains.d_min, gains.d_max, gains.K1, gains.K2, gains.controller) for gains in sets_of(law)],
    )
    return hashlib.sha256(repr(_canonical((FORMAT, drawn, flown))).encode()).hexdigest()


def _aircraft(plant_name: str) -> Any:
    """Return the numbers of a ``sixdof:`` aircraft, which the plant's model does not say."""
    kind, _, name = plant_name.partition(":")
    if kind != "sixdof" or not name:
        return None
    from sitl.aircraft.aerodynamics import load_aircraft

    return load_aircraft(name)


def _canonical(value: Any) -> Any:
    """Return nested tuples of texts and numbers, exact, that are the same for the same data; models lose their name."""
    if isinstance(value, np.ndarray):
        return value.shape, _canonical(value.tolist())
    if is_dataclass(value):
        kept = [field.name for field in fields(value) if not (isinstance(value, Model) and field.name == "name")]
        return type(value).__name__, *((name, _canonical(getattr(value, name))) for name in kept)
    if isinstance(value, Mapping):
        return tuple(sorted((str(key), _canonical(item)) for key, item in value.items()))
    if isinstance(value, tuple | list):
        return tuple(map(_canonical, value))
    assert value is None or isinstance(value, str | int | float), type(value)
    return float(value) if isinstance(value, float) else value
