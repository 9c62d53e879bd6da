"""Loss models against the algebra of Markov chains and the bivariate normal distribution."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.linalg import matrix_power
from scipy import stats

from sitl.link.losses import LOSSES, CorrelatedLoss, FourStateLoss, GilbertElliott, Loss, memoryless
from sitl.link.spec import parse_spec

PACKETS = 100_000
LAGS = (1, 2, 3, 5, 10, 20)
LONGEST = 1000
BLOCK = 500
FAR = 200
"""So many packets later the models tested here have forgotten."""


def loss_model(text: str) -> Loss:
    model = parse_spec(f"loss={text}").loss
    assert isinstance(model, Loss)
    return model


@functools.cache
def losses(text: str, packets: int = PACKETS, seed: int = 1) -> np.ndarray:
    """Return which packets are lost."""
    lost = loss_model(text).sampler(np.random.default_rng(seed))
    return np.array([lost() for _ in range(packets)])


def accepts(successes: int, trials: int, probability: float) -> bool:
    return stats.binomtest(successes, trials, probability).pvalue > 1e-3


def runs(flags: np.ndarray) -> np.ndarray:
    """Lengths of the runs of true, without one that the record may have cut at its end."""
    edges = np.diff(np.concatenate(([0], flags.astype(int), [0])))
    lengths = np.flatnonzero(edges == -1) - np.flatnonzero(edges == 1)
    return lengths[:-1] if len(lengths) and flags[-1] else lengths


def check_runs(lengths: np.ndarray, pmf) -> None:
    """Compare the lengths of runs with their distribution, pmf(1), pmf(2), ..., by a chi-squared test."""
    shares = np.array([pmf(length) for length in range(1, LONGEST)])
    expected = len(lengths) * np.append(shares, 1.0 - shares.sum())
    found = np.bincount(np.minimum(lengths, LONGEST), minlength=LONGEST + 1)[1:]
    bins = [[0.0, 0.0]]
    for seen, due in zip(found, expected, strict=True):  # so that no bin expects fewer than 5
        if bins[-1][1] >= 5.0:
            bins.append([0.0, 0.0])
        bins[-1][0] += seen
        bins[-1][1] += due
    if bins[-1][1] < 5.0:
        seen, due = bins.pop()
        bins[-1][0] += seen
        bins[-1][1] += due
    if len(bins) == 1:  # all but fewer than 5 are of one length
        assert np.count_nonzero(lengths != 1 + np.argmax(shares)) < 20
    else:
        assert stats.chisquare(*np.transpose(bins)).pvalue > 1e-3


def check_autocorrelation(lost: np.ndarray, rate: float, expected) -> None:
    """Compare the autocorrelation of the losses with a function of the lag; its error is taken from blocks."""
    for lag in LAGS:
        products = (lost[:-lag] - rate) * (lost[lag:] - rate) / (rate - rate**2)
        blocks = products[: len(products) // BLOCK * BLOCK].reshape(-1, BLOCK).mean(axis=1)
        tolerance = 4.0 * blocks.std() / math.sqrt(len(blocks))
        assert tolerance < 0.1
        assert products.mean() == pytest.approx(expected(lag), abs=tolerance)


def check_rate(lost: np.ndarray, rate: float, autocorrelation) -> None:
    """Compare the share of packets lost with a rate, given how far they depend on each other."""
    memory = 1.0 + 2.0 * sum(autocorrelation(lag) for lag in range(1, FAR))
    assert abs(lost.mean() - rate) < 3.3 * math.sqrt(rate * (1.0 - rate) * memory / len(lost))


# ---------------------------------------------------------------------------------------------- memoryless


@pytest.mark.parametrize("probability", [0.01, 0.3])
def test_loss_without_memory_has_its_rate_and_geometric_bursts_and_gaps(probability):
    lost_next = memoryless(probability, np.random.default_rng(2))
    lost = np.array([lost_next() for _ in range(PACKETS)])
    assert accepts(int(lost.sum()), PACKETS, probability)
    check_runs(runs(lost), lambda length: stats.geom.pmf(length, 1.0 - probability))
    check_runs(runs(~lost), lambda length: stats.geom.pmf(length, probability))
    check_autocorrelation(lost, probability, lambda lag: 0.0)


# ---------------------------------------------------------------------------------------------- correlated


CORRELATED = ["corr:0.1:0.5", "corr:0.02:0.5", "corr:0.6:0.9"]


def both_lost(model: CorrelatedLoss, lag: int) -> float:
    """P(a packet and that lag later are lost), by the bivariate normal distribution."""
    rho = model.rho**lag
    return float(stats.multivariate_normal([0.0, 0.0], [[1.0, rho], [rho, 1.0]]).cdf([stats.norm.ppf(model.p)] * 2))


@functools.cache
def gaussian_correlation(text: str, lag: int) -> float:
    model = loss_model(text)
    assert isinstance(model, CorrelatedLoss)
    return (both_lost(model, lag) - model.p**2) / (model.p - model.p**2)


@pytest.mark.parametrize("text", CORRELATED)
def test_correlated_loss_has_exactly_its_rate(text):
    check_rate(losses(text), loss_model(text).p, lambda lag: gaussian_correlation(text, lag))


@pytest.mark.parametrize("text", CORRELATED)
def test_correlated_losses_coincide_as_two_normal_numbers(text):
    lost = np.concatenate([losses(text, seed=seed) for seed in range(1, 5)])
    check_autocorrelation(lost, loss_model(text).p, lambda lag: gaussian_correlation(text, lag))


@pytest.mark.parametrize("text", CORRELATED)
def test_three_correlated_losses_in_a_row_are_as_frequent_as_three_normal_numbers_below_the_threshold(text):
    model, lost = loss_model(text), losses(text)
    powers = model.rho ** np.abs(np.subtract.outer(np.arange(3), np.arange(3)))
    expected = float(stats.multivariate_normal(np.zeros(3), powers).cdf([stats.norm.ppf(model.p)] * 3))
    all_three = lost[:-2] & lost[1:-1] & lost[2:]
    blocks = all_three[: len(all_three) // 1000 * 1000].reshape(-1, 1000).mean(axis=1)
    assert all_three.mean() == pytest.approx(expected, abs=3.3 * blocks.std() / math.sqrt(len(blocks)))


def test_correlated_loss_at_its_edges():
    assert not losses("corr:0:0.5", 1000).any()
    assert losses("corr:1:0.5", 1000).all()
    independent = losses("corr:0.3:0")
    assert accepts(int(independent.sum()), PACKETS, 0.3)
    check_runs(runs(independent), lambda length: stats.geom.pmf(length, 0.7))


# --------------------------------------------------------------------------------- chains in discrete time


class Chain:
    """A Markov chain of states that lose packets.

    Parameters
    ----------
    moves : ndarray
        Transition matrix, shape (n, n).
    loss : ndarray
        Probability that a packet that meets the state is lost, shape (n,).
    """

    def __init__(self, moves: np.ndarray, loss: np.ndarray) -> None:
        self.moves, self.loss = moves, loss
        system = np.vstack([moves.T - np.eye(len(moves)), np.ones(len(moves))])
        self.stationary = np.linalg.lstsq(system, np.append(np.zeros(len(moves)), 1.0), rcond=None)[0]
        self.rate = float(self.stationary @ loss)
        # P(state of the first lost packet of a run), and from one lost packet to the next
        first = (self.stationary * (1.0 - loss)) @ moves * loss
        self.first = first / first.sum()
        self.stay = moves * loss

    def correlation(self, lag: int) -> float:
        """Autocorrelation of the loss indicator, by the power of the transition matrix."""
        both = (self.stationary * self.loss) @ matrix_power(self.moves, lag) @ self.loss
        return float((both - self.rate**2) / (self.rate - self.rate**2))

    def burst(self, length: int) -> float:
        """P(so many packets are lost in a row)."""
        return float(self.first @ matrix_power(self.stay, length - 1) @ (1.0 - self.stay.sum(axis=1)))

    @property
    def mean_burst(self) -> float:
        return float(self.first @ np.linalg.solve(np.eye(len(self.moves)) - self.stay, np.ones(len(self.moves))))


def gilbert_elliott(model: GilbertElliott) -> Chain:
    """The states good and bad, as tc-netem(8) describes them."""
    return Chain(np.array([[1 - model.p, model.p], [model.r, 1 - model.r]]), np.array([model.good, model.bad]))


def four_states(p13: float, p31: float | None = None, p32: float = 0.0, p23: float = 1.0, p14: float = 0.0) -> Chain:
    """The states 1 to 4, as tc-netem(8) describes them."""
    moves = np.zeros((5, 5))
    moves[1, 3], moves[1, 4], moves[1, 1] = p13, p14, 1.0 - p13 - p14
    moves[2, 3], moves[2, 2] = p23, 1.0 - p23
    p31 = 1.0 - p13 if p31 is None else p31
    moves[3, 1], moves[3, 2], moves[3, 3] = p31, p32, 1.0 - p31 - p32
    moves[4, 1] = 1.0
    return Chain(moves[1:, 1:], np.array([0.0, 0.0, 1.0, 1.0]))


def numbers(text: str) -> list[float]:
    return [float(value) for value in text.split(":")[1:]]


@functools.cache
def chain_of(text: str) -> Chain:
    return gilbert_elliott(GilbertElliott(*numbers(text))) if text.startswith("ge:") else four_states(*numbers(text))


GILBERT_ELLIOTT = ["ge:0.02:0.18", "ge:0.3:0.1", "ge:0.05:0.1:0.8:0.02", "ge:0.9:0.8", "ge:0.1:0.3:0.2:0.9"]
FOUR_STATES = [
    "state:0.2",
    "state:0.02:0.18",
    "state:0.05:0.2:0.3:0.6:0.01",
    "state:0.3:0.1:0.8:0.9:0.2",
    "state:0:1:0:1:0.1",
]
CHAINS = [*GILBERT_ELLIOTT, *FOUR_STATES]
every_chain = pytest.mark.parametrize("text", CHAINS)


def test_every_loss_model_is_tested_here():
    assert {text.partition(":")[0] for text in [*CHAINS, *CORRELATED]} == set(LOSSES)


@every_chain
def test_loss_rate_is_that_of_the_chain(text):
    check_rate(losses(text), chain_of(text).rate, chain_of(text).correlation)


@every_chain
def test_losses_correlate_as_the_chain(text):
    check_autocorrelation(losses(text), chain_of(text).rate, chain_of(text).correlation)


@every_chain
def test_packets_lost_in_a_row_have_the_distribution_of_the_chain(text):
    chain, lengths = chain_of(text), runs(losses(text))
    check_runs(lengths, chain.burst)
    assert abs(lengths.mean() - chain.mean_burst) <= 3.3 * lengths.std() / math.sqrt(len(lengths))


inner = st.floats(0.01, 0.99)


@given(p=inner, r=inner, bad=inner, good=inner)
def test_loss_rate_mean_burst_and_autocorrelation_of_gilbert_elliott_are_those_of_the_chain(p, r, bad, good):
    model = GilbertElliott(p, r, bad, good)
    chain = gilbert_elliott(model)
    assert model.loss_rate == pytest.approx(chain.rate)
    assert model.mean_burst == pytest.approx(chain.mean_burst, rel=1e-6)
    scale = (bad - good) ** 2 * model.bad_share * (1 - model.bad_share)
    variance = model.loss_rate * (1 - model.loss_rate)
    for lag in (1, 2, 7):
        assert chain.correlation(lag) * variance == pytest.approx(scale * (1 - p - r) ** lag, abs=1e-12)


def test_loss_rate_and_mean_burst_at_the_edges():
    assert GilbertElliott(0.02, 0.18).loss_rate == pytest.approx(0.1)
    assert GilbertElliott(0.02, 0.18).mean_burst == pytest.approx(1 / 0.18)
    assert GilbertElliott(0.3, 0.7).mean_burst == pytest.approx(1 / 0.7)
    assert GilbertElliott(0.2, 0.4, 0.5, 0.5).mean_burst == pytest.approx(2.0)  # no memory left
    stays_good = GilbertElliott(0.0, 0.0)
    assert stays_good.loss_rate == 0.0
    assert math.isnan(stays_good.mean_burst)
    assert GilbertElliott(0.0, 0.5, good=0.25).mean_burst == pytest.approx(4 / 3)
    stays_bad = GilbertElliott(0.1, 0.0)
    assert stays_bad.loss_rate == 1.0
    assert stays_bad.mean_burst == math.inf


@pytest.mark.parametrize("text", ["ge:0.02:0.18", "ge:0.3:0.1", "ge:0.9:0.8"])
def test_gaps_between_bursts_of_the_simple_gilbert_model_are_geometric(text):
    check_runs(runs(~losses(text)), lambda length: stats.geom.pmf(length, numbers(text)[0]))


def test_the_first_packet_finds_the_good_state():
    assert not any(losses("ge:1:0", 1, seed)[0] for seed in range(100))
    assert losses("ge:1:0", 100).tolist() == [False] + [True] * 99


def test_certain_moves_alternate_between_the_states():
    assert losses("ge:1:1", 100).tolist() == [False, True] * 50
    assert losses("ge:1:1:0:1", 100).tolist() == [True, False] * 50


def test_a_chain_that_cannot_reach_the_bad_state_loses_only_in_the_good_one():
    assert not losses("ge:0:0").any()
    assert not losses("ge:0:0.5").any()
    assert losses("ge:0:0:0:1").all()
    assert accepts(int(losses("ge:0:0.5:1:0.1").sum()), PACKETS, 0.1)


@pytest.mark.parametrize("text", ["ge:0.3:0.7", "ge:0.02:0.18:0.3:0.3", "state:0.3", "state:0.3:0.7"])
def test_a_chain_without_memory_loses_as_plain_loss(text):
    lost = losses(text)[1:]
    assert accepts(int(lost.sum()), len(lost), 0.3)
    check_runs(runs(lost), lambda length: stats.geom.pmf(length, 0.7))


# ---------------------------------------------------------------------------------------------- four states


def test_the_four_states_move_as_documented_and_the_chain_begins_in_the_first():
    assert losses("state:1:0", 100).all()  # 1 to 3, and it stays
    assert losses("state:1:1", 100).tolist() == [True, False] * 50  # 1 to 3 to 1
    assert losses("state:1:0:1", 100).tolist() == [True, False] * 50  # 1 to 3 to 2 to 3
    assert losses("state:1:0:1:0", 100).tolist() == [True] + [False] * 99  # and it stays in 2
    assert losses("state:0:1:0:1:1", 100).tolist() == [True, False] * 50  # 1 to 4 to 1
    assert not losses("state:0", 100).any()


def test_losses_alone_never_come_in_pairs():
    lost = losses("state:0:1:0:1:0.1")
    assert runs(lost).max() == 1
    check_runs(runs(~lost)[1:], lambda length: stats.geom.pmf(length, 0.1))


def test_bursts_of_two_parameters_are_those_of_the_simple_gilbert_model():
    lost = losses("state:0.02:0.18")
    check_runs(runs(lost), lambda length: stats.geom.pmf(length, 0.18))
    check_runs(runs(~lost)[1:], lambda length: stats.geom.pmf(length, 0.02))


@given(st.lists(st.floats(0.0, 1.0), min_size=5, max_size=5), st.integers(0, 2**32))
def test_the_four_states_never_move_where_the_probability_is_0(values, seed):
    p13, p31, p32, p23, p14 = values
    model = FourStateLoss(p13 / 2, p31 / 2, p32 / 2, p23, p14 / 2)
    moves = model.moves
    assert np.allclose(moves.sum(axis=1), 1.0)
    assert moves.min() >= 0.0
    lost = model.sampler(np.random.default_rng(seed))
    taken = [lost() for _ in range(20)]
    assert not any(taken) or p13 + p14 > 0.0


def test_a_value_just_below_1_never_leads_out_of_the_four_states():
    class Highest:
        def random(self) -> float:
            return math.nextafter(1.0, 0.0)

    # 1 - 0.06 - 0.08 + 0.06 + 0.08 is that value, not 1; so is 0.01 + 0.06 + 1 - 0.01 - 0.06
    for p13, p14 in ((0.1, 0.9), (0.7, 0.3), (0.3, 0.7), (0.9, 0.1), (0.06, 0.08)):
        lost = FourStateLoss(p13, 1.0, 0.0, 1.0, p14).sampler(Highest())  # 1 to 4, the last that it can reach, and back
        assert [lost() for _ in range(100)] == [True, False] * 50
    for p31 in (0.1, 0.3, 0.7, 0.9):
        lost = FourStateLoss(1.0, p31, 1.0 - p31).sampler(Highest())  # 3 to 2, and back
        assert [lost() for _ in range(100)] == [True, False] * 50
    lost = FourStateLoss(1.0, 0.01, 0.06).sampler(Highest())  # 3 to 3
    assert all(lost() for _ in range(100))


@pytest.mark.parametrize(
    "values",
    [(0.6, 0.1, 0.1, 1.0, 0.5), (0.1, 0.6, 0.5), (0.1, None, 0.2), (1.5,), (0.1, -0.1), (0.1, 0.1, 0.1, 2.0)],
)
def test_four_states_whose_probabilities_do_not_go_together_are_refused(values):
    with pytest.raises(ValueError, match=r"P13|P31|probability"):
        FourStateLoss(*values)


@pytest.mark.parametrize("values", [(1.5, 0.0), (-0.1, 0.0), (0.1, 1.0), (0.1, -0.1)])
def test_correlated_loss_outside_its_range_is_refused(values):
    with pytest.raises(ValueError, match="RHO"):
        CorrelatedLoss(*values)
