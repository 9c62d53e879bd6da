"""A campaign as data: what flies, how often, and from what each flight is drawn.

A :class:`Campaign` goes to workers on other machines as it is, and its :func:`identity` names it on disk: of two
campaigns with the same identity flight n is the same flight, to the last bit.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

from gains.certificate import law_hash, model_hash
from gains.model import GainLaw, Model
from gains.switched import Transitions
from sitl.aircraft.wind import WindSpec
from sitl.campaign.distributions import DelayProcess, Signal, Span
from sitl.link.impairment import LinkSpec

__all__ = ["MAX_FLIGHTS", "MAX_SAMPLES", "Campaign", "identity"]

MAX_FLIGHTS = 10**12
MAX_SAMPLES = 10**6

FORMAT = 2
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
    """Return what tells campaigns of other flights apart, 64 hexadecimal digits; how many are flown does not count."""
    drawn = (
        campaign.plant_name,
        (campaign.d_min, campaign.d_max, campaign.transitions),
        None if campaign.delays is None else (campaign.delays.weights, campaign.delays.d_min, campaign.delays.hold),
        None if campaign.delays is None else (campaign.delays.fifo, campaign.delays.cycle),
        repr(campaign.link),
        tuple((signal.kind, *signal.amplitude, *signal.period_s) for signal in (campaign.gust, campaign.reference)),
        (*campaign.delta, campaign.x0, repr(campaign.wind), campaign.limits, campaign.samples, campaign.seed),
    )
    hashed = (FORMAT, law_hash(campaign.law), model_hash(campaign.law.model), model_hash(campaign.plant), drawn)
    return hashlib.sha256(repr(hashed).encode()).hexdigest()
