"""One flight of a campaign as a delay sequence that the MAVLink pair can fly: a witness file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from gains.model import GainLaw, Model, Schedule, sets_of
from gains.switched import eq9, state_loop
from gains.witnessfile import sequence_of, write_witness
from sitl.aircraft.plants import is_nonlinear
from sitl.campaign.engine import drawn_block
from sitl.campaign.job import Campaign
from sitl.campaign.kernel import LANES

__all__ = ["delays_of", "growth_per_sample", "write_delays"]


def delays_of(campaign: Campaign, flight: int) -> tuple[int, ...]:
    """Return d(k) of a flight."""
    if campaign.link is not None:
        from sitl.campaign.linked import linked_delays

        return tuple(linked_delays(campaign, flight, flight + 1)[0].tolist())
    return tuple(drawn_block(campaign, flight - flight % LANES).d[:, flight % LANES].tolist())


def growth_per_sample(campaign: Campaign, delays: tuple[int, ...]) -> float | None:
    """Return ρ^(1/L) of a sequence of L delays that repeats: by how much the loop grows from sample to sample.

    The loop is the law's around the plant that flies. None where that is not linear: a nonlinear aircraft, or an
    elevator with limits.
    """
    if campaign.limits or is_nonlinear(campaign.plant_name):
        return None
    loop = state_loop(eq9(_around(campaign.law, campaign.plant), min(delays), max(delays)))
    product, exponent = np.eye(loop.N), 0.0
    for d in delays:
        product = loop.F[loop.index(d)] @ product
        size = float(np.max(np.abs(product)))
        if size == 0.0:
            return float(np.finfo(float).tiny)
        product, exponent = product / size, exponent + np.log(size)
    rho = float(np.max(np.abs(np.linalg.eigvals(product))))
    return float(np.exp((np.log(max(rho, np.finfo(float).tiny)) + exponent) / len(delays)))


def _around(law: GainLaw, plant: Model) -> GainLaw:
    """Return the law around a plant, with the reference model of its own."""
    model = replace(plant, reference=law.model.reference)
    sets = tuple(replace(gains, model=model) for gains in sets_of(law))
    return replace(law, model=model, sets=sets) if isinstance(law, Schedule) else sets[0]


def write_delays(path: Path, campaign: Campaign, flight: int, gains: str) -> None:
    """Write d(k) of a flight as a witness file, one period as long as the flight.

    Raises
    ------
    InputError
        When the file cannot be written.
    """
    delays, plant = delays_of(campaign, flight), campaign.plant
    write_witness(path, sequence_of(delays, plant.Ts, gains, plant.name, growth_per_sample(campaign, delays)))
