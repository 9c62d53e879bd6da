"""The checks of a scenario: which numbers of a summary may be judged, and how a file states a claim about one."""

from __future__ import annotations

import difflib
from dataclasses import dataclass

from autopilot.failsafe import Mode
from gains.table import Table

__all__ = ["LINK_COUNTS", "METRICS", "WITNESS_METRICS", "Check", "read_check"]

LINK_COUNTS = ("sent", "delivered", "lost", "duplicated", "reordered")

METRICS = frozenset(
    {
        "duration_s",
        "samples",
        "released_s",
        "rms_error_rad",
        "max_error_rad",
        "final_error_rad",
        "max_output_rad",
        "delay.estimated_exact_fraction",
        "delay.within_one_fraction",
        "delay.covered_fraction",
        "delay.unknown_fraction",
        "delay.outside_fraction",
        *(f"link.{way}.{n}" for way in ("up", "down") for n in LINK_COUNTS),
        "failsafe_events",
        "failsafe_reaction_samples",
        "mode_at_end",
        *(f"mode_s.{mode}" for mode in Mode),
        "longest_saturation_s",
        "reentry_saturation_s",
        "late_ticks",
        "recovery_s",
    }
)
"""What of a summary a check may judge; of a variant's too, after ``variants.NAME.``."""

WITNESS_METRICS = frozenset(
    f"witness.{name}"
    for name in ("predicted", "growth_per_sample", "growth_error", "mismatches", "mismatch_fraction", "gated")
)
"""And these, where the link replays a witness."""


@dataclass(frozen=True, slots=True)
class Check:
    """A bound on a number of the summary, or a text that it must be.

    Attributes
    ----------
    name : str
        What is claimed.
    metric : str
        Dotted path into the summary, for example ``delay.within_one_fraction``.
    at_most, at_least : float or None
        Inclusive bounds.
    equals : str or None
        The text that is wanted.
    """

    name: str
    metric: str
    at_most: float | None = None
    at_least: float | None = None
    equals: str | None = None


def read_check(table: Table, metrics: frozenset[str], variants: tuple[str, ...]) -> Check:
    """Return a check, its metric one that there will be.

    Parameters
    ----------
    table : Table
        Of the check, in a scenario's file.
    metrics : frozenset of str
        What a summary of the flight will have.
    variants : tuple of str
        Names of the scenario's variants.

    Raises
    ------
    InputError
        When it names no bound, or another metric.
    """
    check = Check(
        table.string("name"),
        table.string("metric"),
        table.number("at_most", default=None),
        table.number("at_least", default=None),
        table.string("equals", default=None),
    )
    if check.at_most is None and check.at_least is None and check.equals is None:
        raise table.error("at_most", "at_most, at_least or equals", "none")
    known = {*metrics, *(f"variants.{variant}.{metric}" for variant in variants for metric in metrics)}
    if check.metric not in known:
        near = difflib.get_close_matches(check.metric, known, 1)
        raise table.error(
            "metric", f"a number of the summary, such as {near[0] if near else 'rms_error_rad'}", check.metric
        )
    return check
