"""The forecast of the delay over several seeds per link and order, beside others' estimators, and over two hours."""

from __future__ import annotations

import gc
import resource
import sys
from functools import partial

import numpy as np
import pytest

from sitl.flight import virtual_network
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
    scenario_of,
    score,
    tracking_errors,
)
from tests.integration.forecasters import best

pytestmark = pytest.mark.long

SEEDS = range(11, 17)
ENDURANCE_S = 7200.0


def flights_of(case: Case) -> list[Flight]:
    return [fly(case, seed) for seed in SEEDS]


@pytest.mark.parametrize("case", STEADY_RETURN, ids=str)
def test_d_is_forecast_exactly_where_the_return_has_no_jitter_whatever_the_seed(case: Case) -> None:
    for flight in flights_of(case):
        assert score(Forecasts.of(flight), flight.applied[1]).exact >= 0.999, flight.scenario.seed


@pytest.mark.parametrize("case", RANDOM_RETURN, ids=str)
def test_elsewhere_d_is_forecast_nearly_as_well_as_is_possible_whatever_the_seed(case: Case) -> None:
    for flight in flights_of(case):
        rows, d = flight.applied
        ours, limit = score(Forecasts.of(flight), d), score(best(case, flight.ages_ms[rows]), d)
        assert ours.exact >= limit.exact - 0.02, (flight.scenario.seed, ours, limit)
        assert ours.width <= limit.width + 0.1, (flight.scenario.seed, ours, limit)


@pytest.mark.parametrize("case", CASES, ids=str)
def test_intervals_hold_the_delay_as_often_as_they_say_on_each_link(case: Case) -> None:
    flights = [(Forecasts.of(flight), flight.applied[1]) for flight in flights_of(case)]
    probability = np.concatenate([forecasts.probability for forecasts, _ in flights])
    found = bins(probability, np.concatenate([forecasts.covers(d) for forecasts, d in flights]))
    assert any(counts for *_, counts in found), found
    assert all(abs(excess) <= 0.01 for _, _, excess, counts in found if counts), found


@pytest.mark.parametrize("case", CASES, ids=str)
def test_reports_truth_and_packets_agree_whatever_the_seed(case: Case) -> None:
    assert all(map(agrees, flights_of(case)))


@pytest.mark.parametrize("case", CASES, ids=str)
def test_no_other_estimator_forecasts_better_and_one_that_errs_forecasts_worse(case: Case) -> None:
    for flight in flights_of(case):
        ours, *others = compare(flight)
        for theirs in others:
            assert ours.wrong <= theirs.wrong + 0.001, (flight.scenario.seed, ours, theirs)
            assert ours.wrong < theirs.wrong or theirs.wrong <= 0.01, (flight.scenario.seed, ours, theirs)


@pytest.mark.parametrize("case", CASES, ids=str)
def test_five_minutes_of_doublets_are_tracked_better_with_the_forecast(case: Case) -> None:
    aligned, late = tracking_errors(case, SEEDS[0], 300.0)
    assert aligned < late, (aligned, late)


def test_two_hours_of_estimation_leave_the_memory_flat() -> None:
    scenario = scenario_of(Case("LTE", False), SEEDS[0], ENDURANCE_S)
    network, plant = virtual_network(scenario, None)
    blocks, peaks_kib = [], []

    def reached(quarter: int) -> bool:
        return plant.samples >= scenario.samples * quarter // 4

    for quarter in range(1, 5):
        network.run(partial(reached, quarter), 10**13)
        gc.collect()
        blocks.append(sys.getallocatedblocks())
        peaks_kib.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    assert plant.samples == scenario.samples
    assert max(blocks[1:]) - blocks[0] < 5_000, blocks  # 216,000 samples later
    assert peaks_kib[-1] - peaks_kib[0] < 2_000, peaks_kib
