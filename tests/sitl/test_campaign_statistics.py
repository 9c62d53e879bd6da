"""Statistics of a campaign: intervals hold what they promise, infinite and missing values count as what they are."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from numpy.typing import NDArray
from scipy import stats

from gains.table import InputError
from sitl.campaign.comparison import MAX_CONTROLLERS, compare, compare_pair, mcnemar
from sitl.campaign.intervals import QUANTILES, plain, proportion, quantiles
from sitl.campaign.sensitivity import rank_correlation, sensitivities, sobol_index
from sitl.campaign.statistics import Tally, measure

Columns = dict[str, NDArray[Any]]


def campaign(flights: int = 1000, seed: int = 1) -> Columns:
    """Return columns like a campaign's: the error grows with gust and delay, every hundredth flight diverges."""
    rng = np.random.default_rng(seed)
    gust, d_mean = rng.random(flights), rng.uniform(1.0, 6.0, flights)
    diverged = np.arange(flights) % 100 == 99
    error = gust * d_mean * rng.uniform(0.9, 1.1, flights)
    return {
        "flight": np.arange(flights),
        "diverged": diverged,
        "diverged_at": np.where(diverged, 17, -1),
        "gain": np.where(diverged, np.inf, error / 10.0),
        "rms_error": error,
        "max_error": 2.0 * error,
        "error_norm": error * 20.0,
        "input_norm": np.full(flights, 200.0),
        "d_mean": d_mean,
        "d_max": np.full(flights, 6),
        "outside": np.where(np.arange(flights) % 10 == 0, 0.25, 0.0),
        "changes": rng.integers(0, 300, flights),
        "gust_amplitude": gust,
    }


def calm(flights: int = 1000, seed: int = 1) -> Columns:
    """Return the same without divergence."""
    columns = campaign(flights, seed)
    return {
        **columns,
        "diverged": np.zeros(flights, dtype=bool),
        "gain": columns["rms_error"] / 10.0,
    }


# -- probabilities


@pytest.mark.parametrize(
    ("count", "low", "high"), [(0, 0.0, 0.3085), (1, 0.0025, 0.4450), (5, 0.1871, 0.8129), (10, 0.6915, 1.0)]
)
def test_the_interval_is_that_of_the_printed_tables_for_ten_trials(count: int, low: float, high: float) -> None:
    told = proportion(count, 10)
    assert (told.low, told.high) == pytest.approx((low, high), abs=5e-5)


@pytest.mark.parametrize("total", [1, 2, 7, 50, 1000, 10**6])
@pytest.mark.parametrize("confidence", [0.9, 0.95, 0.999])
def test_the_interval_is_that_of_the_exact_binomial_test(total: int, confidence: float) -> None:
    for count in {0, 1, total // 3, total - 1, total}:
        told = proportion(count, total, confidence)
        test = stats.binomtest(count, total)
        other = test.proportion_ci(confidence, "exact")
        # its root finder stops within 2e-12
        assert (told.low, told.high) == pytest.approx((other.low, other.high), rel=1e-6, abs=2e-12)
        one_sided = stats.binomtest(count, total, alternative="less").proportion_ci(confidence, "exact")
        assert told.upper == pytest.approx(one_sided.high, rel=1e-6, abs=2e-12)


@pytest.mark.parametrize("total", [1, 30, 10**6, 10**12])
def test_without_a_failure_the_bound_is_where_so_many_successes_have_five_percent(total: int) -> None:
    told = proportion(0, total)
    assert told.low == 0.0
    assert total * math.log1p(-told.upper) == pytest.approx(math.log(0.05), rel=1e-12)
    if total >= 30:
        assert 0.95 * 3.0 / total < told.upper < 3.0 / total  # the rule of three


def test_of_no_flight_nothing_is_known() -> None:
    told = proportion(0, 0)
    assert (told.low, told.high, told.upper) == (0.0, 1.0, 1.0)
    assert math.isnan(told.share)


# -- quantiles


@pytest.mark.parametrize("count", [1, 2, 99, 100, 1000])
def test_a_quantile_is_the_value_where_the_empirical_distribution_reaches_it(count: int) -> None:
    sample = np.sort(np.random.default_rng(2).normal(size=count))
    shares = [*QUANTILES, 0.07, 0.29, 0.57]
    for told in quantiles(sample, shares):
        rank = next(n for n in range(1, count + 1) if round(1000 * told.p) * count <= 1000 * n)
        assert told.value == sample[rank - 1]
        assert told.low <= told.value <= told.high


@pytest.mark.parametrize(("count", "p"), [(20, 0.5), (60, 0.25), (100, 0.95), (1000, 0.99)])
def test_the_interval_of_a_quantile_holds_it_as_often_as_promised(count: int, p: float) -> None:
    repeats, truth = 1000, -math.log1p(-p)
    samples = np.sort(np.random.default_rng(3).exponential(size=(repeats, count)), axis=1)
    told = [quantiles(sample, [p])[0] for sample in samples]
    held = sum(one.low <= truth <= one.high for one in told) / repeats
    assert held > 0.95 - 4.0 * math.sqrt(0.95 * 0.05 / repeats)


@pytest.mark.parametrize(("count", "p"), [(20, 0.5), (60, 0.25), (100, 0.95), (1000, 0.99), (10**6, 0.999)])
def test_the_interval_of_a_quantile_is_as_narrow_as_order_statistics_allow(count: int, p: float) -> None:
    (told,) = quantiles(np.arange(1.0, count + 1.0), [p])  # each value is its rank
    up_to, low, high = stats.binom(count, p).cdf, int(told.low), int(min(told.high, count + 1))
    assert up_to(low - 1) <= 0.025 < up_to(low)
    assert 1.0 - up_to(high - 1) <= 0.025 < 1.0 - up_to(high - 2)


def test_an_interval_has_no_upper_end_where_the_sample_is_too_small_for_one() -> None:
    (far,) = quantiles(np.arange(100.0), [0.999])
    assert (far.value, far.high) == (99.0, math.inf)
    (near,) = quantiles(np.arange(10_000.0), [0.999])
    assert near.high < 9999.0
    (least,) = quantiles(np.arange(20.0), [0.05])
    assert least.low == -math.inf


def test_infinite_values_are_ranked_and_not_interpolated() -> None:
    sample = np.concatenate([np.arange(990.0), np.full(10, np.inf)])
    told = {one.p: one for one in quantiles(sample)}
    assert told[0.99].value == 989.0
    assert told[0.99].high == math.inf
    assert told[0.999].value == told[1.0].value == math.inf
    assert told[0.5].high < 600.0


# -- the whole


def test_a_flight_that_diverged_counts_as_infinite_whatever_was_measured_until_then() -> None:
    told = measure({**campaign(), "max_error": np.zeros(1000)}, threshold=1.0)
    assert told.diverged.count == told.gains.infinite == 10
    assert told.beyond is not None
    assert told.beyond.count == told.failed.count == 10
    assert told.quantiles["max_error"][-1].value == math.inf
    assert told.quantiles["rms_error"][0].value < 1.0


def test_a_gain_without_input_is_left_out_and_counted() -> None:
    columns = calm()
    columns["gain"][::2] = np.nan
    told = measure(columns, eta=1.0)
    assert told.gains.undefined == 500
    assert sum(told.gains.histogram.counts) + told.gains.histogram.below + told.gains.histogram.beyond == 500
    assert told.quantiles["gain"][-1].value == np.nanmax(columns["gain"])
    assert told.gain_sensitivity is None


def test_only_flights_that_never_left_the_window_contradict_eta() -> None:
    columns = calm()
    eta = float(np.sort(columns["gain"])[-101])
    told = measure(columns, eta=eta)
    above = columns["gain"] > eta
    inside = above & (columns["outside"] == 0.0)
    assert told.gains.above == above.sum() == 100
    assert told.above is not None
    assert 0 < told.gains.above_inside == told.above.count == told.failed.count == inside.sum() < 100
    assert told.gains.ratio == columns["gain"].max() / eta
    assert told.left_window.count == 100


def test_a_gain_of_exactly_eta_stands_left_of_the_line_and_does_not_exceed_it() -> None:
    columns = calm(3)
    columns["gain"] = np.array([0.2, np.nextafter(0.2, 1.0), 0.1])
    columns["outside"] = np.zeros(3)
    told = measure(columns, eta=0.2)
    histogram = told.gains.histogram
    middle = histogram.edges.index(0.2)
    assert (histogram.counts[middle - 1], histogram.counts[middle]) == (1, 1)
    assert told.gains.above == 1


def test_gains_off_the_grid_are_counted() -> None:
    columns = calm(4)
    columns["gain"] = np.array([0.0, 1e-9, 1e9, 0.5])
    histogram = measure(columns).gains.histogram
    assert (histogram.below, histogram.beyond, sum(histogram.counts)) == (2, 1, 1)


def test_parts_in_any_size_give_the_numbers_of_the_whole() -> None:
    columns = campaign()
    tally = Tally(eta=0.3, threshold=5.0)
    for start, stop in ((0, 1), (1, 400), (400, 400), (400, 1000)):
        tally.add({name: column[start:stop] for name, column in columns.items()})
    whole = measure(columns, eta=0.3, threshold=5.0)
    none: dict[str, Any] = {"rms_sensitivity": None, "gain_sensitivity": None, "failure_sensitivity": None}
    assert tally.statistics() == replace(whole, **none)
    assert tally.statistics() == tally.statistics()


def test_values_beyond_those_that_are_kept_are_counted() -> None:
    columns = campaign()
    tally = Tally(most=300)
    for start in (0, 200, 400):
        tally.add({name: column[start : start + 200] for name, column in columns.items()})
    told = tally.statistics()
    first = {name: column[:300] for name, column in columns.items()}
    assert (told.flights, told.unkept, told.diverged.count) == (600, 300, 6)
    assert told.quantiles == measure(first).quantiles
    assert told.gains.largest == columns["rms_error"][:600][~columns["diverged"][:600]].max() / 10.0


def test_a_parquet_table_gives_the_same_as_its_columns() -> None:
    columns = campaign()
    assert measure(pa.table(columns), eta=0.3) == measure(columns, eta=0.3)


def test_results_are_json_with_infinities_as_texts() -> None:
    told = measure(campaign(), eta=0.3, threshold=1.0).to_json()
    read = json.loads(json.dumps(told, allow_nan=False))
    assert read == told
    assert read["quantiles"]["max_error"][-1] == {"p": 1.0, "value": "inf", "low": "-inf", "high": "inf"}
    assert plain((math.nan, -math.inf, 3, "text", None)) == [None, "-inf", 3, "text", None]


def test_nothing_flown_is_no_error() -> None:
    told = Tally(eta=1.0).statistics()
    assert (told.flights, told.failed.upper) == (0, 1.0)
    assert math.isnan(told.gains.largest)
    json.dumps(told.to_json(), allow_nan=False)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"gain": None}, "expected a column gain"),
        ({"d_mean": np.zeros(7)}, "d_mean: expected 1000 rows"),
        ({"rms_error": np.where(np.arange(1000) == 41, np.nan, 1.0)}, "rms_error: .* found nan in flight 41"),
    ],
)
def test_columns_that_are_no_campaign_are_refused(change: dict[str, Any], said: str) -> None:
    columns = {name: column for name, column in {**calm(), **change}.items() if column is not None}
    with pytest.raises(InputError, match=said):
        measure(columns)


def test_an_error_that_is_no_number_is_none_of_a_flight_that_diverged() -> None:
    columns = campaign()
    columns["max_error"][columns["diverged"]] = np.nan
    assert measure(columns).quantiles == measure(campaign()).quantiles


# -- sensitivity


def ishigami(flights: int, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    x = rng.uniform(-math.pi, math.pi, (3, flights))
    return x, np.sin(x[0]) + 7.0 * np.sin(x[1]) ** 2 + 0.1 * x[2] ** 4 * np.sin(x[0])


ISHIGAMI = (0.3139, 0.4424, 0.0)
"""First-order indices for a = 7, b = 0.1, as published."""


def test_the_indices_of_the_ishigami_function_are_the_published_ones() -> None:
    x, y = ishigami(200_000, np.random.default_rng(4))
    for parameter, index in zip(x, ISHIGAMI, strict=True):
        told = sobol_index(parameter, y)
        assert told.error < 0.002
        assert told.value == pytest.approx(index, abs=3.0 * told.error + 5e-5)


def test_standard_errors_are_what_repeated_campaigns_scatter_by() -> None:
    rng = np.random.default_rng(5)
    told = np.array(
        [
            [(*sobol_index(p, y), *rank_correlation(p, y)) for p in x]
            for x, y in (ishigami(1500, rng) for _ in range(200))
        ]
    )
    scatter, said = told.std(axis=0), told.mean(axis=0)
    # 200 repeats know a standard deviation to 5 %
    assert scatter[:, [0, 2]] == pytest.approx(said[:, [1, 3]], rel=0.2)
    # what fewer than forty bins lose of a curve is smaller than the noise
    assert np.abs(said[:, 0] - ISHIGAMI).max() < 0.6 * said[:, 1].max()


def test_the_rank_correlation_is_that_of_another_implementation_with_ties_too() -> None:
    rng = np.random.default_rng(6)
    few, y = rng.integers(1, 5, 500), rng.normal(size=500)
    for parameter, result in ((y, y**3 + rng.normal(size=500)), (few, few + y), (few, np.round(few + y))):
        told = rank_correlation(parameter.astype(float), result)
        assert told.value == pytest.approx(stats.spearmanr(parameter, result).statistic, abs=1e-12)


def test_a_rising_function_is_certain() -> None:
    x = np.random.default_rng(7).random(1000)
    up, down = rank_correlation(x, np.exp(5.0 * x)), rank_correlation(x, -x)
    assert (up.value, down.value) == (pytest.approx(1.0), pytest.approx(-1.0))
    assert up.error == pytest.approx(0.0, abs=1e-6)


def test_a_parameter_of_two_values_has_the_index_of_the_analysis_of_variance() -> None:
    rng = np.random.default_rng(8)
    groups = np.repeat([1.0, 2.0], 5000)
    y = groups + rng.normal(size=10_000)  # Var(E[y | group]) = 1/4 of a total of 5/4
    told = sobol_index(groups, y)
    assert told.value == pytest.approx(0.2, abs=3.0 * told.error)
    assert told.error < 0.01


def test_what_hurts_most_comes_first_and_what_never_changes_is_left_out_with_its_name() -> None:
    columns = campaign(20_000)
    columns["delta_amplitude"] = np.where(np.arange(20_000) < 5, np.nan, 0.1)
    told = measure(columns).rms_sensitivity
    assert told is not None
    assert [effect.name for effect in told.effects[:2]] == ["gust_amplitude", "d_mean"]
    assert told.constant == ("d_max",)
    assert told.undefined == ("delta_amplitude",)
    assert (told.flights, told.infinite) == (20_000, 200)
    by_name = {effect.name: effect for effect in told.effects}
    # gust · delay with gust ~ U(0, 1) and delay ~ U(1, 6): Var E[. | gust] = 3.5² / 12, Var E[. | delay] = 25 / 48
    total = (1 / 3) * (25 / 12 + 3.5**2) * (1 + 0.2**2 / 12) - 3.5**2 / 4
    for name, variance in (("gust_amplitude", 3.5**2 / 12), ("d_mean", 25 / 48)):
        assert by_name[name].sobol == pytest.approx(variance / total, abs=4.0 * by_name[name].sobol_error)
    assert abs(by_name["changes"].sobol) < 4.0 * by_name["changes"].sobol_error


def test_numbers_near_overflow_have_an_index() -> None:
    x = np.random.default_rng(9).random(1000)
    assert sobol_index(x, 1e300 * x) == pytest.approx(sobol_index(x, x))


def test_of_few_flights_or_a_constant_result_no_index_is_told() -> None:
    x = np.arange(29.0)
    assert math.isnan(sobol_index(x, x).value)
    (told,) = sensitivities({"d_mean": np.arange(100.0)}, [np.ones(100)])
    assert math.isnan(told.effects[0].sobol)
    assert math.isnan(told.effects[0].spearman)
    assert sensitivities({"d_mean": np.zeros(0)}, [np.zeros(0)])[0].effects == ()


def test_what_makes_flights_fail_is_told_where_some_did() -> None:
    columns = calm(20_000)
    told = measure(columns, threshold=8.0).failure_sensitivity
    assert told is not None
    assert {effect.name for effect in told.effects[:2]} == {"gust_amplitude", "d_mean"}
    assert measure(columns, threshold=1e6).failure_sensitivity is None


# -- comparison


@pytest.mark.parametrize(("one", "other"), [(0, 0), (3, 3), (0, 5), (12, 4), (900, 1000), (30_000, 30_500)])
def test_mcnemars_test_is_the_exact_binomial_test_of_the_discordant_flights(one: int, other: int) -> None:
    wanted = stats.binomtest(one, one + other).pvalue if one + other else 1.0
    assert mcnemar(one, other) == pytest.approx(wanted, rel=1e-9)


def pair_of(a: Columns, b: Columns, threshold: float | None = None) -> Any:
    return compare_pair(("A", a), ("B", b), threshold=threshold)


def test_pairs_find_a_difference_that_two_campaigns_side_by_side_hide() -> None:
    a = calm()
    b = {**a, "rms_error": a["rms_error"] * np.random.default_rng(10).lognormal(0.02, 0.1, 1000)}
    told = pair_of(a, b)
    differences = np.log(a["rms_error"] / b["rms_error"])
    assert told.log_ratio.low <= -0.02 <= told.log_ratio.high < 0.0
    assert told.p_signed_rank == pytest.approx(stats.wilcoxon(differences).pvalue)
    assert told.p_signed_rank < 1e-3
    assert told.better.count == (differences < 0).sum()
    assert told.better.low > 0.5
    assert told.better.count + told.worse.count == told.flights == 1000
    assert sum(told.counts) + told.off == 1000
    assert stats.mannwhitneyu(a["rms_error"], b["rms_error"]).pvalue > 0.3


def test_the_interval_of_the_median_ratio_is_that_of_the_sign_test() -> None:
    a = calm(101)
    b = {**a, "rms_error": a["rms_error"] * np.random.default_rng(11).lognormal(0.0, 0.3, 101)}
    told = pair_of(a, b)
    differences = np.log(a["rms_error"]) - np.log(b["rms_error"])
    for median, accepted in ((told.log_ratio.low + 1e-9, True), (told.log_ratio.low - 1e-9, False)):
        p = stats.binomtest(int((differences > median).sum()), 101).pvalue
        assert (p > 0.05) == accepted


def test_flights_are_paired_by_number_and_not_by_place() -> None:
    a = calm()
    b = {**a, "rms_error": 2.0 * a["rms_error"]}
    shuffled = np.random.default_rng(12).permutation(1000)[:800]
    told = pair_of(a, {name: column[shuffled] for name, column in b.items()})
    assert told.flights == told.better.count == 800
    assert told.log_ratio.low == pytest.approx(-math.log(2.0))
    assert told.log_ratio.high == pytest.approx(-math.log(2.0))


def test_a_divergence_is_worse_than_any_error_and_two_decide_nothing() -> None:
    a, b = calm(), calm()
    a["diverged"][:30], b["diverged"][20:60] = True, True
    told = pair_of(a, b)
    assert (told.worse.count, told.better.count, told.ties, told.both_diverged) == (20, 30, 940, 10)
    assert (told.only_a_failed, told.only_b_failed, told.both_failed) == (20, 30, 10)
    assert told.p_failures == told.p_sign == pytest.approx(stats.binomtest(20, 50).pvalue)
    instead = np.concatenate([np.full(20, 9.0), np.full(30, -9.0)])
    assert told.p_signed_rank == pytest.approx(stats.wilcoxon(instead).pvalue)
    assert told.log_ratio.value == 0.0


def test_equal_controllers_are_equal() -> None:
    told = pair_of(calm(), calm(), threshold=1.0)
    assert (told.ties, told.p_signed_rank, told.p_sign, told.p_failures) == (1000, 1.0, 1.0, 1.0)
    assert (told.log_ratio.low, told.log_ratio.high) == (0.0, 0.0)
    assert told.both_failed > 0


def test_errors_of_zero_are_compared_without_a_warning() -> None:
    a, b = calm(100), calm(100)
    a["rms_error"][:10] = b["rms_error"][5:15] = 0.0
    told = pair_of(a, b)
    assert (told.better.count, told.worse.count, told.ties, told.both_diverged) == (5, 5, 90, 0)


def test_three_controllers_make_three_pairs_each_with_its_statistics() -> None:
    a = calm()
    tables = {
        name: {**a, "rms_error": factor * a["rms_error"]} for name, factor in (("x", 1.0), ("y", 1.1), ("z", 0.9))
    }
    told = compare(tables, etas={"x": 1.0}, threshold=5.0)
    assert [(pair.a, pair.b) for pair in told.pairs] == [("x", "y"), ("x", "z"), ("y", "z")]
    assert [one.gains.eta for one in told.statistics] == [1.0, None, None]
    json.dumps(told.to_json(), allow_nan=False)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"flight": np.arange(1000) + 5000}, "in common, found none"),
        ({"flight": np.arange(1000) // 2}, "each flight once"),
        ({"gust_amplitude": np.linspace(0, 1, 1000)}, "another gust_amplitude in flight 0"),
    ],
)
def test_flights_that_are_no_pairs_are_refused(change: Columns, said: str) -> None:
    with pytest.raises(InputError, match=said):
        pair_of(calm(), {**calm(), **change})


@pytest.mark.parametrize("count", [1, MAX_CONTROLLERS + 1])
def test_one_controller_or_too_many_are_no_comparison(count: int) -> None:
    with pytest.raises(InputError, match=f"found {count}"):
        compare({str(n): calm(10) for n in range(count)})
