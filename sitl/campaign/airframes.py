"""Flights of any aircraft, one after the other, in Python: what compiled code cannot fly.

The same draws as :mod:`sitl.campaign.engine` and the same law, Eq. (9), on an
:class:`~sitl.aircraft.airframe.Airframe` of ``--plant``: a nonlinear aircraft, in wind. A linear one flown so gives
what compiled code gives, which the tests use.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gains.model import Matrix, sets_of
from sitl.aircraft.linear import LinearAirframe, move_actuator
from sitl.aircraft.plants import airframe_maker
from sitl.campaign.engine import Columns, Drawn, columns_of, drawn_block
from sitl.campaign.job import Campaign
from sitl.campaign.kernel import LANES, set_of_delay

__all__ = ["fly_airframes", "fly_one"]

_STREAM = 0xA1F


def fly_airframes(campaign: Campaign, start: int, stop: int, delays: NDArray[np.uint8] | None = None) -> Columns:
    """Fly the flights from ``start`` to before ``stop``; as :func:`sitl.campaign.engine.fly_range`."""
    table = []
    for flight in range(start, stop):
        if flight == start or flight % LANES == 0:
            block = drawn_block(campaign, flight - flight % LANES)
        drawn = block.flight(flight % LANES)
        if delays is not None:
            drawn = drawn._replace(d=delays[flight - start].astype(np.int32))
        table.append(fly_one(campaign, flight, drawn))
    return columns_of(campaign, start, np.array(table).reshape(stop - start, -1).T)


def fly_one(campaign: Campaign, flight: int, drawn: Drawn) -> list[float]:
    """Return one column of the table: results, delays and parameters."""
    law, plant, trim = campaign.law, campaign.plant, campaign.plant.trim
    reference = law.model.reference
    seed = int(np.random.SeedSequence(campaign.seed, spawn_key=(_STREAM, flight)).generate_state(1)[0])
    maker = airframe_maker(campaign.plant_name, plant, campaign.wind, seed)
    airframe = LinearAirframe(plant, trim.x + drawn.x0) if maker is None else maker()
    chosen = sets_of(law)
    set_at = set_of_delay(law)
    xr = np.zeros(0 if reference is None else len(reference.Ar))
    states: list[Matrix] = []
    position = np.array(trim.u)
    squared = disturbance = largest_error = largest_state = half_state = 0.0
    diverged_at = -1
    for k in range(campaign.samples):
        d = int(drawn.d[k])
        states.append(airframe.x - trim.x)
        gains = chosen[set_at[d]]
        u = gains.K1 @ states[k - d] if d <= k else np.zeros(plant.nu)
        if gains.K2 is not None:
            u = u + gains.K2 @ xr
        position = move_actuator(plant, position, trim.u + u) if campaign.limits else trim.u + u
        error = plant.C @ states[k] + plant.D @ (position - trim.u)
        if reference is not None:
            error = error - reference.Cr @ xr
            xr = reference.Ar @ xr + reference.Br @ drawn.r[k]
        squared += float(error @ error)
        disturbance += float(drawn.w[k] @ drawn.w[k] + drawn.r[k] @ drawn.r[k])
        largest_error = max(largest_error, float(np.max(np.abs(error))))
        if airframe.advance(position, drawn.w[k], float(drawn.delta[k, 0])) is not None:
            diverged_at = k + 1
            break
        largest_state = max(largest_state, float(np.max(np.abs(airframe.x - trim.x))))
        if k < campaign.samples // 2:
            half_state = largest_state
    results = [squared, disturbance, largest_error, largest_state, half_state, float(diverged_at)]
    return [*results, *_delay_facts(drawn.d, campaign), *drawn.parameters.tolist()]


def _delay_facts(d: NDArray[np.int32], campaign: Campaign) -> list[float]:
    outside = (d < campaign.d_min) | (d > campaign.d_max)
    changes = math.fsum(np.diff(d) != 0)
    return [float(np.mean(d)), float(np.max(d)), float(np.mean(outside)), changes]
