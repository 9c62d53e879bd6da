"""What a worker does: one range of flights of a campaign, by whatever flies it."""

from __future__ import annotations

from sitl.aircraft.plants import is_nonlinear
from sitl.campaign.engine import Columns, fly_range
from sitl.campaign.job import Campaign

__all__ = ["fly", "is_compiled"]


def is_compiled(campaign: Campaign) -> bool:
    """Return whether compiled code does all of it, without Python in between: then threads are enough."""
    return campaign.link is None and not is_nonlinear(campaign.plant_name)


def fly(campaign: Campaign, start: int, stop: int) -> Columns:
    """Fly the flights from ``start`` to before ``stop``, and return a row for each."""
    delays = None
    if campaign.link is not None:
        from sitl.campaign.linked import linked_delays

        delays = linked_delays(campaign, start, stop)
    if is_nonlinear(campaign.plant_name):
        from sitl.campaign.airframes import fly_airframes

        return fly_airframes(campaign, start, stop, delays)
    return fly_range(campaign, start, stop, delays)
