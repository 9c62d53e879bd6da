"""Adaptive multilevel splitting: held to dynamic programming, to the campaign's own kernel and to plain Monte Carlo."""

from __future__ import annotations

import json
import math
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result
from numpy.typing import NDArray
from scipy import stats

from gains.model import Gains
from gains.store import load_law, require_law
from gains.table import InputError
from sitl.campaign import branching, splitting
from sitl.campaign.airframes import fly_one
from sitl.campaign.branching import MAX_CELLS, FlightPaths, tails_of
from sitl.campaign.distributions import DelayProcess, Signal, Span, parse_delays, parse_signal
from sitl.campaign.engine import drawn_block, fly_range
from sitl.campaign.job import Campaign
from sitl.campaign.kernel import MAX_DELAY
from sitl.campaign.splitting import LEAST, Descent, RareEvent, event_of, rare, split
from sitl.commands.rare import rare_command
from tests.sitl.campaigns import campaign

Integers = NDArray[np.int64]

# -- the algorithm on a process that needs no loop: the longest run of successes so far


class Runs:
    """Independent trials, many paths at once; the score is the longest run of successes so far."""

    def __init__(self, paths: int, samples: int, success: float, rng: np.random.Generator) -> None:
        self._success, self._rng = success, rng
        self._trials = rng.random((paths, samples)) < success
        self.scores = self._longest(self._trials)
        self.roots = np.arange(paths)

    @staticmethod
    def _longest(trials: NDArray[np.bool_]) -> NDArray[np.float64]:
        run, longest = np.zeros(len(trials)), np.zeros(trials.shape)
        for k in range(trials.shape[1]):
            run = np.where(trials[:, k], run + 1.0, 0.0)
            longest[:, k] = np.maximum(run, longest[:, k - 1] if k else 0.0)
        return longest

    def branch(self, killed: Integers, parents: Integers, kept: Integers) -> None:
        fresh = self._rng.random((len(killed), self._trials.shape[1])) < self._success
        own = np.arange(self._trials.shape[1]) < kept[:, None]
        self._trials[killed] = np.where(own, self._trials[parents], fresh)
        self.scores[killed] = self._longest(self._trials[killed])
        self.roots[killed] = self.roots[parents]


def run_probability(length: int, samples: int, success: float) -> float:
    """The probability of a run of at least ``length``, by dynamic programming over the run that goes on."""
    going = np.zeros(length + 1)
    going[0] = 1.0
    for _ in range(samples):
        moved = np.append([(1.0 - success) * going[:-1].sum()], success * going[:-1])
        moved[-1] += going[-1]
        going = moved
    return float(going[-1])


def run_estimates(
    replicas: int, length: int, samples: int, success: float, paths: int, killed: int, seed: int
) -> list[Descent]:
    found = []
    for n in range(replicas):
        rng = np.random.default_rng((seed, n))
        found.append(split(Runs(paths, samples, success, rng), length - 0.5, killed, rng))
    return found


@pytest.mark.parametrize(("paths", "killed"), [(20, 1), (20, 10), (5, 2)])
def test_the_mean_over_many_small_replicas_is_the_probability_although_scores_tie(paths: int, killed: int) -> None:
    found = run_estimates(1500, 6, 20, 0.5, paths, killed, 11)
    estimates = np.array([one.probability for one in found])
    truth = run_probability(6, 20, 0.5)
    z = (estimates.mean() - truth) / (estimates.std(ddof=1) / math.sqrt(len(estimates)))
    assert abs(z) < 3.0
    assert estimates.std() / math.sqrt(len(estimates)) < 0.06 * truth  # so that 3 of them would tell a bias


def test_a_run_of_probability_1e_minus_9_is_found_within_its_interval() -> None:
    truth = run_probability(12, 30, 0.15)
    assert 1e-9 < truth < 3e-9
    found = run_estimates(20, 12, 30, 0.15, 400, 40, 3)
    estimates = np.array([one.probability for one in found])
    error = estimates.std(ddof=1) / math.sqrt(len(found))
    assert error < 0.5 * truth
    assert abs(estimates.mean() - truth) < 3.0 * error
    assert sum(one.paths for one in found) < 1e-3 / truth


def test_a_threshold_below_most_paths_needs_no_level_and_is_the_plain_share() -> None:
    rng = np.random.default_rng(5)
    paths = Runs(100, 20, 0.5, rng)
    share = float(np.mean(paths.scores[:, -1] > 0.5))
    assert split(paths, 0.5, 1, rng) == Descent(share, 0, 100, round(100 * share), False)


def test_what_no_path_reaches_is_0_and_ends() -> None:
    rng = np.random.default_rng(6)
    extinct = split(Runs(50, 20, 0.5, rng), 20.5, 5, rng)  # runs of 21 in 20 trials
    assert extinct.probability == 0.0
    assert not extinct.given_up
    certain = split(Climb(40), 1e9, 20, rng)
    assert certain == Descent(0.0, math.ceil(-math.log2(LEAST)), 40 + 20 * (math.ceil(-math.log2(LEAST)) - 1), 0, True)


class Climb:
    """Paths of which each new one is better than all before: they never tie, and never arrive."""

    def __init__(self, paths: int) -> None:
        self.scores = np.arange(float(paths))[:, None]
        self.roots = np.arange(paths)

    def branch(self, killed: Integers, parents: Integers, kept: Integers) -> None:
        assert (kept == 1).all()
        self.scores[killed, 0] = self.scores.max() + 1.0 + np.arange(len(killed))


# -- flights


def hirm(**changes: Any) -> Campaign:
    delays = parse_delays("geometric:3", 1, 4, fifo=False, longest=MAX_DELAY)
    return campaign(**{"d_min": 1, "d_max": 4, "delays": delays, "samples": 100, **changes})


@pytest.mark.parametrize("transitions", ["any", "fifo"])
def test_a_path_is_the_flight_that_the_campaign_flies_with_its_delays_to_the_last_bit(transitions: str) -> None:
    delays = parse_delays("hold:0.5", 1, 20, fifo=transitions == "fifo", longest=MAX_DELAY)
    campaign = hirm(transitions=transitions, delays=delays)
    paths = FlightPaths(campaign, 40, 2, by_state=False)
    paths.branch(np.array([3, 4]), np.array([5, 39]), np.array([60, 1]))
    flown = fly_range(campaign, 80, 120, paths.delays)
    own = np.setdiff1d(np.arange(40), [3, 4])  # the others have the gusts of their parents
    assert np.array_equal(paths.scores[own, -1], flown["max_error"][own])
    assert list(paths.roots[[3, 4, 5]]) == [5, 39, 5]
    assert np.array_equal(paths.scores[3, :60], paths.scores[5, :60])
    assert paths.scores[3, -1] != paths.scores[5, -1] or (paths.delays[3] != paths.delays[5]).any()
    parent = fly_range(campaign, 85, 86, paths.delays[3:4])
    assert paths.scores[3, -1] == parent["max_error"][0]
    changes = np.diff(paths.delays.astype(int), axis=1)
    assert changes.max() == (1 if transitions == "fifo" else 19)


def test_the_elevators_limits_count_as_in_a_flight_of_the_aircraft() -> None:
    campaign = hirm(gust=parse_signal("sine:2000deg", "gust"), limits=True)
    paths, free = (FlightPaths(replace(campaign, limits=on), 4, 0, by_state=False) for on in (True, False))
    block = drawn_block(replace(campaign, limits=False), 0)  # which draws the same, and is compiled
    for flight in range(4):
        drawn = block.flight(flight)._replace(d=paths.delays[flight].astype(np.int32))
        assert paths.scores[flight, -1] == pytest.approx(fly_one(campaign, flight, drawn)[2], rel=1e-9)
        assert paths.scores[flight, -1] != pytest.approx(free.scores[flight, -1], rel=1e-3)


def test_uncertainty_and_x0_count_as_in_the_campaign() -> None:
    campaign = hirm(delta=Span(0.1, 0.15), x0=0.02)
    paths = FlightPaths(campaign, 32, 0, by_state=False)
    assert np.array_equal(paths.scores[:, -1], fly_range(campaign, 0, 32, paths.delays)["max_error"])
    assert (np.diff(paths.scores, axis=1) >= 0.0).all()


def test_delays_are_those_of_the_process_with_their_far_tail() -> None:
    process = parse_delays("geometric:1", 1, 4, fifo=False, longest=MAX_DELAY)
    beyond = tails_of(process).beyond
    assert beyond[:60].tolist() == [2 ** (63 - n) for n in range(60)]  # P(d > 1 + n) = 2^-(n + 1)
    paths = FlightPaths(hirm(delays=process), 1000, 0, by_state=False)
    counts = np.bincount(np.minimum(paths.delays.ravel(), 9), minlength=10)[1:]
    expected = 100_000 * np.array([*(0.5**n for n in range(1, 9)), 0.5**8])
    assert stats.chisquare(counts, expected).pvalue > 1e-3


def test_a_window_of_one_delay_and_held_ones_are_drawn_as_asked() -> None:
    constant = hirm(delays=parse_delays("uniform", 3, 3, fifo=False, longest=MAX_DELAY))
    assert (FlightPaths(constant, 10, 0, by_state=False).delays == 3).all()
    held = hirm(delays=parse_delays("hold:0.9", 1, 5, fifo=False, longest=MAX_DELAY))
    delays = FlightPaths(held, 1000, 0, by_state=False).delays
    stayed = int(np.count_nonzero(delays[:, 1:] == delays[:, :-1]))
    assert stats.binomtest(stayed, 99_000, 0.9 + 0.1 / 5).pvalue > 1e-3


def test_splitting_and_plain_flying_agree_where_both_can_tell() -> None:
    campaign, threshold = hirm(), math.radians(0.9)
    plain = fly_range(campaign, 0, 60_000)["max_error"] > threshold
    event = rare(campaign, threshold, particles=300, replicas=20, seed=2)
    share = float(plain.mean())
    assert 1e-3 < share < 1e-2
    error = math.hypot(event.relative_error * event.probability, math.sqrt(share / len(plain)))
    assert abs(event.probability - share) < 2.5 * error
    assert event.relative_error < 0.2


def test_the_same_seed_gives_the_same_result_to_the_last_bit_on_any_number_of_threads() -> None:
    campaign, threshold = hirm(), math.radians(0.9)
    one = rare(campaign, threshold, particles=60, replicas=10, seed=4)
    assert rare(campaign, threshold, particles=60, replicas=10, seed=4, workers=3) == one
    other = rare(campaign, threshold, particles=60, replicas=10, seed=5)
    assert other.replicas != one.replicas
    assert len(set(one.replicas)) == 10  # replicas are no copies of each other


# -- a loop whose flights can be counted: x(k + 1) = x(k - d(k)) + w, with d in {0, 1}


SLOW = 0.8
"""Probability of d = 1: then |x| climbs by one step in two samples, with d = 0 in one."""


def climbing(samples: int) -> Campaign:
    """Sizes are the pendulum's, so that nothing is compiled for it; the second state stays 0."""
    law = require_law(load_law("pendulum-paper"))
    assert isinstance(law, Gains)
    model = replace(
        law.model,
        A=np.zeros((2, 2)),
        B=np.array([[1.0], [0.0]]),
        E=np.array([[1.0, 0.0], [0.0, 0.0]]),
        C=np.array([[1.0, 0.0]]),
    )
    return hirm(
        law=replace(law, model=model, K1=np.array([[1.0, 0.0]]), certificate=None),
        plant=model,
        plant_name="pendulum",
        d_min=0,
        d_max=1,
        delays=DelayProcess((1.0 - SLOW, SLOW), 0),
        gust=Signal("step", Span(1.0, 1.0)),
        reference=Signal(),
        samples=samples,
    )


def climb_probability(samples: int, threshold: float) -> float:
    """The probability that |x| of samples 0 to samples - 1 exceeds the threshold.

    |x(k)| is an integer times |cos φ|, φ the evenly distributed direction of the gust, which has two channels.
    """
    chances = Counter({(0, 0, 0): 1.0})  # of x(k - 1), x(k) and the largest so far
    for k in range(samples - 1):
        following: Counter[tuple[int, int, int]] = Counter()
        for (before, now, largest), chance in chances.items():
            for d, share in ((0, 1.0 - SLOW), (1, SLOW)):
                new = (now if d == 0 else before if k else 0) + 1
                following[now, new, max(largest, new)] += share * chance
        chances = following
    steps: Counter[int] = Counter()
    for (_, _, largest), chance in chances.items():
        steps[largest] += chance
    return sum(
        chance * 2.0 / math.pi * math.acos(threshold / largest)
        for largest, chance in steps.items()
        if largest > threshold
    )


def test_the_count_of_the_climbing_loop_agrees_with_flying_it() -> None:
    flown = fly_range(climbing(30), 0, 100_000)["max_error"]
    for threshold in (16.5, 18.5):
        expected = climb_probability(30, threshold)
        assert stats.binomtest(int(np.count_nonzero(flown > threshold)), len(flown), expected).pvalue > 1e-3


def test_splitting_is_unbiased_for_flights_whose_gust_comes_along_with_the_copies() -> None:
    truth = climb_probability(30, 17.5)
    event = rare(climbing(30), 17.5, particles=20, killed=5, replicas=800, seed=8)
    z = (event.probability - truth) / (event.relative_error * event.probability)
    assert abs(z) < 3.0
    assert event.relative_error < 0.1


# -- a loop whose failures are runs: x(k + 1) = x(k) / 2 + (0 or 1), evenly by d in {0, 1}


def halving(samples: int) -> Campaign:
    """Return a loop of the sizes of hirm's.

    The second state is 0 and 1 by turns, so seen through a delay of 0 or 1 it is a fair coin, from sample 1 on. The
    first one halves and adds that: its binary digits are the coins, and exact up to 50 samples.
    """
    law = require_law(load_law("hirm-paper"))
    assert isinstance(law, Gains)
    model = replace(
        law.model,
        A=np.diag([0.5, -1.0, 0.0]),
        B=np.array([[1.0], [0.0], [0.0]]),
        E=np.array([[0.0], [1.0], [0.0]]),
        C=np.array([[1.0, 0.0, 0.0]]),
        D=np.zeros((1, 1)),
    )
    return hirm(
        law=replace(law, model=model, K1=np.array([[0.0, 1.0, 0.0]]), certificate=None),
        plant=model,
        delays=DelayProcess((0.5, 0.5), 0),
        gust=Signal("step", Span(1.0, 1.0)),
        reference=Signal(),
        samples=samples,
    )


def below(length: int) -> float:
    """Return the threshold that a run of ones of this length exceeds, and nothing else."""
    return math.nextafter(2.0 - 2.0 ** (1 - length), 0.0)


def test_runs_of_the_halving_loop_are_those_that_are_counted() -> None:
    flown = fly_range(halving(50), 0, 50_000)["max_error"]
    for length in (6, 9):
        expected = run_probability(length, 48, 0.5)
        assert stats.binomtest(int(np.count_nonzero(flown > below(length))), len(flown), expected).pvalue > 1e-3


def test_a_failure_of_probability_1e_minus_9_is_estimated_within_half_of_itself() -> None:
    truth = run_probability(33, 48, 0.5)
    assert 5e-10 < truth < 2e-9
    event = rare(halving(50), below(33), particles=1000, replicas=20, seed=7)
    assert event.relative_error < 0.5
    assert event.low <= truth <= event.high
    assert event.flights < 1e6
    assert event.plain_flights_for_the_same_error == pytest.approx(
        (1.0 - event.probability) / event.probability / event.relative_error**2
    )
    assert event.efficiency > 1000.0


# -- divergence, and what is told


def test_divergence_alone_is_judged_by_the_state_and_agrees_with_flying() -> None:
    pendulum = require_law(load_law("pendulum-paper"))
    campaign = hirm(
        law=pendulum,
        plant=pendulum.model,
        plant_name="pendulum",
        delays=parse_delays("uniform", 8, 20, fifo=False, longest=MAX_DELAY),
        gust=Signal("step", Span(0.1, 0.1)),
        reference=Signal(),
        samples=220,
    )
    paths = FlightPaths(campaign, 64, 0, by_state=True)
    flown = fly_range(campaign, 0, 64, paths.delays)
    assert 0 < np.count_nonzero(flown["diverged"]) < 64
    assert np.array_equal(np.isinf(paths.scores[:, -1]), flown["diverged"])
    first = np.where(flown["diverged"], np.argmax(np.isinf(paths.scores), axis=1) + 1, -1)
    assert np.array_equal(first, flown["diverged_at"])
    plain = fly_range(campaign, 0, 2000)["diverged"].mean()
    event = rare(campaign, None, particles=100, replicas=10)
    assert event.threshold is None
    assert abs(event.probability - plain) < 3.0 * math.hypot(
        event.relative_error * event.probability, math.sqrt(plain / 2000.0)
    )


def interval_of(estimates: Any, seed: int = 1, levels: int = 3) -> RareEvent:
    found = [Descent(float(p), levels, 100, 2, False) for p in estimates]
    return event_of(found, 0.1, 50, 5, hirm(seed=seed))


def test_the_interval_of_skewed_replicas_holds_the_mean_more_often_than_students() -> None:
    rng = np.random.default_rng(7)
    replicas = rng.lognormal(math.log(2e-9), 0.8, size=(500, 20))  # standard deviation 0.95 of the mean
    mean = 2e-9 * math.exp(0.32)
    held = [event.low <= mean <= event.high for event in map(interval_of, replicas)]
    students = [stats.ttest_1samp(row, 0.0).confidence_interval(0.95) for row in replicas]
    assert np.mean([low <= mean <= high for low, high in students]) < np.mean(held) - 0.03
    assert 0.9 < np.mean(held) < 0.98


def test_the_interval_of_normal_replicas_is_nearly_students() -> None:
    replicas = np.random.default_rng(8).normal(1e-3, 1e-4, 200)
    event, expected = interval_of(replicas), stats.ttest_1samp(replicas, 0.0).confidence_interval(0.95)
    assert (event.low, event.high) == pytest.approx((expected.low, expected.high), rel=3e-3)
    assert not event.unsure
    assert event.flights == 200 * 100


def test_replicas_that_scatter_by_their_mean_are_called_unsure() -> None:
    wild = interval_of([0.0] * 9 + [1e-9])
    assert wild.unsure
    assert wild.to_json()["unsure"] is True
    assert (wild.low, wild.high) == (0.0, 1.0)  # one replica in three finds nothing but zeros when drawn again
    assert not interval_of([1e-9, 2e-9] * 5).unsure


def test_replicas_without_a_level_are_independent_flights_with_an_exact_interval() -> None:
    certain = interval_of([1.0] * 10, levels=0)
    expected = stats.binomtest(500, 500).proportion_ci(0.95)
    assert (certain.low, certain.high) == pytest.approx((expected.low, 1.0))
    most = interval_of([0.98, 1.0] * 5, levels=0)
    expected = stats.binomtest(495, 500).proportion_ci(0.95)
    assert (most.low, most.high) == pytest.approx((expected.low, expected.high))


def test_so_many_replicas_at_once_as_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    pools: list[int] = []

    class Pool(ThreadPoolExecutor):
        def __init__(self, workers: int) -> None:
            pools.append(workers)
            super().__init__(workers)

    monkeypatch.setattr(splitting, "ThreadPoolExecutor", Pool)
    monkeypatch.setattr(branching, "MAX_CELLS", 3 * 60 * 150)
    campaign = hirm(samples=150)
    rare(campaign, math.radians(0.9), particles=60, replicas=10, workers=8)
    rare(campaign, math.radians(0.9), particles=60, replicas=10, workers=2)
    assert pools == [3, 2]


def test_where_nothing_was_found_nothing_is_claimed() -> None:
    event = event_of([Descent(0.0, 3, 100, 0, True)] * 10, 0.1, 50, 5, hirm())
    told = event.to_json()
    assert (told["probability"], told["low"], told["given_up"]) == (0.0, 0.0, 10)
    assert (
        told["high"] is told["relative_error"] is told["plain_flights_for_the_same_error"] is told["efficiency"] is None
    )


@pytest.mark.parametrize(
    ("changes", "options", "complaint"),
    [
        ({"plant_name": "sixdof:hirm"}, {}, "linear"),
        ({"delays": None}, {}, "drawn anew"),
        ({"delays": DelayProcess((), 1, cycle=(1, 2))}, {}, "drawn anew"),
        ({"samples": MAX_CELLS // 99}, {}, "particles"),
        ({}, {"killed": 100}, "killed"),
        ({}, {"killed": 0}, "killed"),
        ({}, {"replicas": 9}, "replicas"),
        ({}, {"threshold": math.inf}, "threshold"),
    ],
)
def test_what_cannot_be_split_is_refused(changes: dict[str, object], options: dict[str, float], complaint: str) -> None:
    asked = {"threshold": 0.1, "particles": 100, "replicas": 10, **options}
    with pytest.raises(InputError, match=complaint):
        rare(hirm(**changes), **asked)  # type: ignore[arg-type]


# -- the command


def run(*arguments: str) -> Result:
    result = CliRunner().invoke(rare_command, ["--gains", "hirm-paper", "--samples", "60", *arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


SMALL = ("--particles", "40", "--replicas", "10", "--delays", "geometric:3")


def test_the_command_prints_what_the_library_finds() -> None:
    result = run(*SMALL, "--threshold", "0.6deg", "--json", "--seed", "3")
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    assert told["probability"] == rare(
        hirm(samples=60), math.radians(0.6), particles=40, replicas=10, seed=3
    ).probability  # fmt: skip
    assert told["threshold"] == pytest.approx(math.radians(0.6))
    assert (told["d_min"], told["d_max"], told["delays"]) == (1, 4, "geometric:3")


def test_the_command_prints_a_table_with_the_interval_and_what_plain_flying_would_need() -> None:
    result = run(*SMALL, "--threshold", "0.6deg")
    for words in ("probability per flight", "95 % interval", "levels per replica", "plain Monte Carlo"):
        assert words in result.output


def test_the_command_says_so_when_nothing_was_found_with_exit_code_1() -> None:
    result = CliRunner().invoke(
        rare_command,
        ["--gains", "hirm-paper", "--samples", "20", *SMALL, "--threshold", "60deg"],
        standalone_mode=False,
    )
    assert result.return_value == 1
    assert "none of 10 replicas found a failure" in result.output


@pytest.mark.parametrize(
    "arguments",
    [("--threshold", "0"), ("--threshold", "1deg..2deg"), ("--delays", "cycle:none.csv"), ("--plant", "sixdof:hirm")],
)
def test_the_command_refuses_what_it_cannot_take(arguments: tuple[str, str]) -> None:
    with pytest.raises(InputError):
        run(*SMALL, *arguments)
