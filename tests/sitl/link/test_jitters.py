"""Jitter against scipy's distributions, independent and correlated: the marginal, the copula, and the tails."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
from scipy import stats

from sitl.link.jitters import (
    JITTERS,
    GammaJitter,
    Jitter,
    NormalJitter,
    ParetoJitter,
    ParetoNormalJitter,
    TableJitter,
    UniformJitter,
    autoregressive,
)
from tests.sitl.links import MS

SAMPLES = 100_000
RHO = 0.7
THIN = 20
"""RHO ** THIN < 1e-3: so far apart samples are as good as independent."""
LAGS = (1, 2, 5)


class Quantiles:
    """A distribution by a rising function of a standard normal number, inverted by straight lines on a fine grid."""

    def __init__(self, function, low: float = -9.0, high: float = 9.0) -> None:
        self._z = np.linspace(low, high, 400_001)
        self._x = function(self._z)

    def cdf(self, x):
        return stats.norm.cdf(np.interp(x, self._x, self._z))

    def sf(self, x):
        return stats.norm.sf(np.interp(x, self._x, self._z))


class PiecewiseLinear:
    """A distribution function of straight lines between sorted values."""

    def __init__(self, values) -> None:
        self._values = np.array(values, dtype=float)

    def cdf(self, x):
        return np.interp(x, self._values, np.linspace(0.0, 1.0, len(self._values)))

    def sf(self, x):
        return 1.0 - self.cdf(x)


def netem_pareto_normal(z):
    """Return what netem's table of this name holds, from the quantile's normal number: (normal + 3 Pareto) / 4."""
    pareto = (stats.pareto(3.0).isf(stats.norm.sf(z)) - 1.5) * 4.0 / 3.0
    return 4.0 * MS * (z + 3.0 * pareto) / 4.0


MEASURED = tuple(sorted({round(t) for t in np.random.default_rng(0).gamma(2.0, 5 * MS, 50)}))

MODELS = {
    "uniform": (UniformJitter(28 * MS), stats.uniform(scale=28 * MS)),
    "normal": (NormalJitter(4 * MS), stats.norm(scale=4 * MS)),
    "gamma": (GammaJitter(20 * MS), stats.gamma(a=2.0, scale=10 * MS)),
    "gamma:0.5": (GammaJitter(20 * MS, 0.5), stats.gamma(a=0.5, scale=40 * MS)),
    "gamma:7.5": (GammaJitter(20 * MS, 7.5), stats.gamma(a=7.5, scale=20 * MS / 7.5)),
    "pareto": (ParetoJitter(5 * MS), stats.lomax(c=3.0, scale=10 * MS)),
    "pareto:1.5": (ParetoJitter(5 * MS, 1.5), stats.lomax(c=1.5, scale=2.5 * MS)),
    "paretonormal": (ParetoNormalJitter(4 * MS), Quantiles(netem_pareto_normal)),
    "table": (TableJitter("measured.csv", MEASURED), PiecewiseLinear(MEASURED)),
}
every_model = pytest.mark.parametrize("name", MODELS)


@functools.cache
def samples(name: str, rho: float) -> np.ndarray:
    source = MODELS[name][0].sampler(np.random.default_rng(11), rho)
    return np.array([source() for _ in range(SAMPLES)])


def test_every_jitter_model_has_a_distribution_to_compare_with():
    assert {name.partition(":")[0] for name in MODELS} == set(JITTERS)
    for name, (model, _) in MODELS.items():
        assert type(model) is JITTERS[name.partition(":")[0]]


@every_model
def test_independent_jitter_follows_its_distribution(name):
    assert stats.kstest(samples(name, 0.0), MODELS[name][1].cdf).pvalue > 1e-3


@every_model
def test_independent_jitter_has_no_memory(name):
    x = samples(name, 0.0)
    for lag in LAGS:
        assert abs(stats.spearmanr(x[:-lag], x[lag:]).statistic) < 4.0 / math.sqrt(SAMPLES)


@every_model
def test_correlated_jitter_follows_the_same_distribution(name):
    assert stats.kstest(samples(name, RHO)[::THIN], MODELS[name][1].cdf).pvalue > 1e-3


def normals(name: str) -> np.ndarray:
    """Return the standard normal numbers behind correlated jitter, from its distribution."""
    x, truth = samples(name, RHO), MODELS[name][1]
    below = truth.cdf(x)
    return np.where(below < 0.5, stats.norm.ppf(below), stats.norm.isf(truth.sf(x)))


@every_model
def test_behind_correlated_jitter_is_a_gaussian_sequence_with_independent_innovations(name):
    z = normals(name)
    innovations = (z[1:] - RHO * z[:-1]) / math.sqrt(1.0 - RHO**2)
    innovations = innovations[np.isfinite(innovations)]
    assert len(innovations) > 0.999 * SAMPLES
    assert stats.kstest(innovations, stats.norm.cdf).pvalue > 1e-3
    for lag in LAGS:
        assert abs(np.corrcoef(innovations[:-lag], innovations[lag:])[0, 1]) < 4.0 / math.sqrt(SAMPLES)


@every_model
def test_rank_correlation_of_correlated_jitter_is_that_of_the_gaussian_copula(name):
    x = samples(name, RHO)
    tolerance = 4.0 * math.sqrt((1.0 + RHO**2) / (1.0 - RHO**2) / SAMPLES)
    for lag in LAGS:
        expected = 6.0 / math.pi * math.asin(RHO**lag / 2.0)
        assert stats.spearmanr(x[:-lag], x[lag:]).statistic == pytest.approx(expected, abs=tolerance)


@pytest.mark.parametrize("rho", [0.3, 0.9, 0.99])
def test_normal_jitter_has_autocorrelation_rho_to_the_lag(rho):
    source = autoregressive(np.random.default_rng(5), rho)
    z = np.array([source() for _ in range(SAMPLES)])
    for lag in (1, 2, 10, 50):
        # Bartlett: 1 / N times the sum of what the estimate at this lag owes to all others
        k = np.arange(1, 3000)
        variance = np.sum((rho ** (k + lag) + rho ** np.abs(k - lag) - 2.0 * rho**lag * rho**k) ** 2) / SAMPLES
        assert np.corrcoef(z[:-lag], z[lag:])[0, 1] == pytest.approx(rho**lag, abs=4.0 * math.sqrt(variance))


def test_a_correlated_sequence_is_stationary_from_its_first_number():
    first = [autoregressive(np.random.default_rng(seed), 0.99)() for seed in range(2000)]
    assert stats.kstest(first, stats.norm.cdf).pvalue > 1e-3


def correlated_at(model: Jitter, z: float) -> float:
    return model.correlated(lambda: lambda: z)()


@every_model
@pytest.mark.parametrize("z", [-8.0, -3.0, 0.0, 3.0, 8.0])
def test_correlated_jitter_is_the_quantile_of_the_normal_number_far_into_the_tails(name, z):
    model, truth = MODELS[name]
    if isinstance(truth, Quantiles):
        expected = float(netem_pareto_normal(np.array(z)))
    elif isinstance(truth, PiecewiseLinear):
        expected = float(np.interp(stats.norm.cdf(z), np.linspace(0.0, 1.0, len(MEASURED)), MEASURED))
    else:
        expected = float(truth.ppf(stats.norm.cdf(z)) if z < 0.0 else truth.isf(stats.norm.sf(z)))
    assert correlated_at(model, z) == pytest.approx(expected, rel=1e-6, abs=1.0)


@every_model
@pytest.mark.parametrize("z", [-12.0, 12.0])
def test_no_normal_number_that_can_be_drawn_makes_jitter_infinite(name, z):
    assert math.isfinite(correlated_at(MODELS[name][0], z))


@pytest.mark.parametrize("model", [UniformJitter, NormalJitter, GammaJitter, ParetoJitter, ParetoNormalJitter])
@pytest.mark.parametrize("rho", [0.0, 0.5])
def test_jitter_of_scale_0_is_0(model, rho):
    source = model(0).sampler(np.random.default_rng(0), rho)
    assert [source() for _ in range(100)] == [0.0] * 100


def test_a_table_gives_its_values_and_what_is_between_them_and_nothing_else():
    table = TableJitter("", (5, 5, 5, 9))
    source = table.independent(np.random.default_rng(1))
    x = np.array([source() for _ in range(20_000)])
    assert stats.binomtest(int((x == 5.0).sum()), len(x), 2.0 / 3.0).pvalue > 1e-3
    assert stats.kstest(x[x > 5.0], stats.uniform(5.0, 4.0).cdf).pvalue > 1e-3
    assert correlated_at(table, -40.0) == 5.0
    assert correlated_at(table, 40.0) == 9.0


def test_the_standard_deviation_of_pareto_normal_jitter_is_the_one_documented():
    x = netem_pareto_normal(stats.norm.ppf((np.arange(10**6) + 0.5) / 10**6)) / (4.0 * MS)
    assert x.mean() == pytest.approx(0.0, abs=1e-3)
    assert x.std() == pytest.approx(1.05, abs=0.01)


def test_two_sources_of_one_model_with_different_generators_are_independent():
    one, other = (GammaJitter(MS).sampler(np.random.default_rng(seed), RHO) for seed in (1, 2))
    x, y = np.array([(one(), other()) for _ in range(20_000)]).T
    for lag in range(3):
        assert abs(stats.spearmanr(x[lag:], y[: len(y) - lag]).statistic) < 4.0 * math.sqrt(3.0 / len(x))
