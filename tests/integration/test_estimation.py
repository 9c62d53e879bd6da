"""What the forecast of the delay is worth: flights of 300 s over many links, one seed each.

Clocks differ by seconds and drift by 100 ppm against each other's direction. The measure is the best forecaster, who
knows the links (``forecasters.py``).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest

from tests.integration.baselines import compare
from tests.integration.estimation import (
    CASES,
    RANDOM_RETURN,
    STEADY_RETURN,
    Case,
    Flight,
    Forecasts,
    agrees,
    bins,
    fly,
    score,
    tracking_errors,
)
from tests.integration.forecasters import best, by_convolution, by_table

SEED = 3
TRACKED_S = 20.0


def flight_of(case: Case) -> Flight:
    return fly(case, SEED)


def by_length(cases: Iterable[Case]) -> list[Any]:
    """Return the cases as parameters; those in order, which differ little from the others, are long."""
    return [pytest.param(case, marks=pytest.mark.long if case.keep_order else ()) for case in cases]


@pytest.mark.parametrize("case", by_length(STEADY_RETURN), ids=str)
def test_d_is_forecast_exactly_where_the_return_has_no_jitter(case: Case) -> None:
    flight = flight_of(case)
    _, d = flight.applied
    assert d.size > 9000
    assert score(Forecasts.of(flight), d).exact >= 0.999


@pytest.mark.parametrize("case", by_length(RANDOM_RETURN), ids=str)
def test_elsewhere_d_is_forecast_nearly_as_well_and_as_closely_as_is_possible(case: Case) -> None:
    flight = flight_of(case)
    rows, d = flight.applied
    ours, limit = score(Forecasts.of(flight), d), score(best(case, flight.ages_ms[rows]), d)
    assert d.size > 6000
    assert ours.exact >= limit.exact - 0.02, (ours, limit)
    assert ours.width <= limit.width + 0.1, (ours, limit)


@pytest.mark.parametrize(
    ("cases", "counting"),
    [
        pytest.param([case for case in CASES if not case.keep_order], 2, id="as they come"),
        pytest.param(CASES, 4, id="in order too", marks=pytest.mark.long),
    ],
)
def test_intervals_hold_the_delay_as_often_as_they_say(cases: list[Case], counting: int) -> None:
    flights = [(Forecasts.of(flight), flight.applied[1]) for flight in map(flight_of, cases)]
    probability = np.concatenate([forecasts.probability for forecasts, _ in flights])
    covered = np.concatenate([forecasts.covers(d) for forecasts, d in flights])
    found = bins(probability, covered)
    assert sum(counts for *_, counts in found) >= counting, found
    assert all(abs(excess) <= 0.01 for _, _, excess, counts in found if counts), found
    assert probability.min() >= 0.95


@pytest.mark.parametrize("case", by_length(CASES), ids=str)
def test_the_delay_reported_is_the_true_one_and_the_one_that_follows_from_the_packets(case: Case) -> None:
    flight = flight_of(case)
    assert agrees(flight)
    assert len(flight.reports) > 0.85 * len(flight.ticks)


@pytest.mark.parametrize("case", [case for case in RANDOM_RETURN if not case.keep_order], ids=str)
def test_the_best_forecaster_is_the_same_by_convolution_and_by_counting(case: Case) -> None:
    flight = flight_of(case)
    rows, d = flight.applied
    ages = flight.ages_ms[rows]
    one, other = by_convolution(case, ages), by_table(case, ages)
    assert abs(score(one, d).covered - score(one, d).claimed) < 0.01
    assert abs(score(one, d).exact - score(other, d).exact) < 0.003
    assert abs(score(one, d).width - score(other, d).width) < 0.05
    assert float(np.mean(one.d == other.d)) > 0.98
    alike = (one.low == other.low) & (one.high == other.high)
    assert float(np.abs(one.probability - other.probability)[alike].mean()) < 0.005


def test_the_estimators_of_others_do_what_they_are_made_for() -> None:
    """A baseline that did not work would be no measure."""
    lan = {row.who: row for row in compare(flight_of(Case("LAN", False)))}
    for who in ("mavros", "PX4"):
        assert abs(lan[who].bias_ms) < 0.05
        assert lan[who].spread_ms < 0.05
        assert 49.0 < lan[who].usable_s < 51.0  # 500 exchanges at 10 Hz
        assert lan[who].wrong == 0.0
    assert abs(lan["one-way"].bias_ms + 0.2) < 0.01  # it takes the way up for nothing
    lte = {row.who: row for row in compare(flight_of(Case("LTE", False)))}
    assert np.isnan(lte["mavros"].usable_s)  # no round trip is below its gate
    assert abs(lte["no gate"].bias_ms) < 1.0
    assert lte["no gate"].usable_wrong < 0.3


@pytest.mark.parametrize("case", [case for case in CASES if not case.keep_order], ids=str)
def test_a_reference_aligned_by_the_forecast_is_tracked_better_than_one_that_is_not(case: Case) -> None:
    aligned, late = tracking_errors(case, SEED, TRACKED_S)
    assert aligned < late, (aligned, late)
