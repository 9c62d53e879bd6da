"""What is proved of a campaign's law: the η that no flight inside the window exceeds."""

from __future__ import annotations

from typing import NamedTuple

from gains.model import GainLaw
from gains.switched import Transitions
from gains.verify import verified

__all__ = ["Bound", "certified_bound"]


class Bound(NamedTuple):
    """A verified η, or why there is none.

    Attributes
    ----------
    eta : float or None
    source : str
        "certificate of the gain file", "computed and verified", or the reason.
    """

    eta: float | None
    source: str


def certified_bound(
    law: GainLaw, d_min: int, d_max: int, transitions: Transitions, delta_max: float, memory: int = 0
) -> Bound:
    """Return η for a window: that of the gain file where it covers this and memory is 0, otherwise a new one.

    Parameters
    ----------
    law : Gains or Schedule
    d_min, d_max : int
    transitions : {"any", "fifo"}
    delta_max : float
    memory : int
        Past delays that a storage knows; more gives a smaller η.
    """
    if memory == 0 and (eta := _on_file(law, d_min, d_max, transitions, delta_max)) is not None:
        return Bound(eta, "certificate of the gain file")
    from gains.exact import eta as least_eta  # with the solver

    found = least_eta(law, d_min, d_max, transitions=transitions, delta_max=delta_max, memory=memory)
    if found.eta is None:
        return Bound(None, found.reason or "stable, without eta")
    return Bound(found.eta, "computed and verified")


def _on_file(law: GainLaw, d_min: int, d_max: int, transitions: Transitions, delta_max: float) -> float | None:
    """Return the η of the gain file's own certificate where it is verified and covers what is asked."""
    claim = law.certificate
    if claim is None or claim.get("eta") is None or claim.get("aheads") is not None or not verified(law).passed:
        return None
    low, high, uncertainty = (float(str(claim[key])) for key in ("d_min", "d_max", "delta_max"))
    covers = low <= d_min and d_max <= high and uncertainty >= delta_max
    covers = covers and claim.get("transitions", "any") in ("any", transitions)
    return float(str(claim["eta"])) if covers else None
