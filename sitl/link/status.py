"""What a link tells of itself: its counters for the recording, its present state for who looks at it in flight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

from autopilot.link.clock import NS_PER_S
from sitl.link.changes import format_change
from sitl.link.direction import LATEST, Counters, Direction
from sitl.link.link import Link
from sitl.link.rules import format_rule
from sitl.link.spec import format_spec

__all__ = ["MAX_CHANGES_SHOWN", "link_counters", "link_status"]

MAX_CHANGES_SHOWN = 16
"""Changes to come that are told, of each direction; the number of all of them is told, too."""

_COUNTS = tuple(field.name for field in fields(Counters))


def link_counters(link: Link) -> dict[str, Any]:
    """Return the counters of a link, per direction and rule, and how precise its delays were, from its beginning on."""
    counters: dict[str, Any] = {direction.way: _counters(direction) for direction in link.directions}
    if link.gate is not None:
        counters["gate"] = {miss.value: n for miss, n in link.gate.misses.items()}
    if link.clock_steps:
        counters["clock_steps"] = link.clock_steps
    return counters


def _counters(direction: Direction) -> dict[str, Any]:
    counters: dict[str, Any] = _counted(direction.counters)
    counters["queued"] = direction.queued
    counters["error_ns"] = direction.errors.summary()
    if direction.rules:
        counters["rules"] = [
            {"rule": format_rule(lane.rule), **_counted(lane.counters), "queued": lane.queued}
            for lane in direction.rules
            if lane.rule is not None and lane.counters is not None
        ]
    return counters


def _counted(counters: Counters) -> dict[str, int]:
    """Return all counts by name; they are numbers, so nothing of them need be copied deeply."""
    return {name: getattr(counters, name) for name in _COUNTS}


def link_status(link: Link, now_ns: int) -> dict[str, Any]:
    """Return what a link does now, as it is shown.

    Delays and rates are those of the latest deliveries, ``LATEST`` of them or those of the last second.

    Parameters
    ----------
    link : Link
    now_ns : int
        The node's time.
    """
    link_ns = link.link_ns(now_ns)
    status = link_counters(link)
    for direction in link.directions:
        status[direction.way] |= _now(direction, link_ns)
    return {"link_ns": link_ns, **status}


def _now(direction: Direction, link_ns: int) -> dict[str, Any]:
    """Return what a direction does now, beside its counters."""
    coming = [change for change in direction.changes if change.at_ns > link_ns]
    latest = direction.latest
    recent = [entry for entry in latest if entry[0] > link_ns - NS_PER_S]
    # with no more than the latest few remembered, they may span less than a second
    span_ns = max(1, link_ns - recent[0][0]) if len(recent) == LATEST else NS_PER_S
    return {
        "spec": format_spec(direction.spec_at(link_ns)),
        "changes": len(coming),
        "next_changes": [format_change(change) for change in coming[:MAX_CHANGES_SHOWN]],
        "rate_hz": len(recent) * NS_PER_S / span_ns,
        "rate_bps": 8 * sum(size for _, size, _, _ in recent) * NS_PER_S / span_ns,
        "requested_ns": _quantiles([entry[2] for entry in latest if entry[2] is not None]),
        "achieved_ns": _quantiles([achieved_ns for _, _, _, achieved_ns in latest]),
    }


def _quantiles(values: Sequence[int]) -> dict[str, int] | None:
    """Return median and 99th percentile by nearest rank; None of none."""
    if not values:
        return None
    ordered = sorted(values)
    return {f"p{part}": ordered[-(-part * len(ordered) // 100) - 1] for part in (50, 99)}
