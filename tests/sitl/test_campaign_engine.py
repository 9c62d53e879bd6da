"""The campaign's draws and its compiled loop: published vectors, plain NumPy, SciPy, and what was asked for."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import signal, stats

from gains.model import Actuator, GainLaw, Gains, Schedule
from gains.store import load_law, require_law
from gains.table import InputError
from gains.witnessfile import Witness, write_witness
from sitl.aircraft.jsbsim import linearise
from sitl.aircraft.jsbsimload import FOOT
from sitl.aircraft.wind import parse_wind
from sitl.campaign import philox
from sitl.campaign.airframes import fly_airframes
from sitl.campaign.distributions import DelayProcess, Signal, Span, parse_delays, parse_signal, parse_span
from sitl.campaign.engine import Columns, Drawn, drawn_block, fly_range
from sitl.campaign.job import Campaign
from sitl.campaign.kernel import LANES, MAX_DELAY, set_of_delay
from sitl.campaign.replaying import delays_of, growth_per_sample
from sitl.linearizing import model_of
from tests.sitl.campaigns import campaign

DEG = math.pi / 180.0
WORD = 2**32
DELAY, HOLD, PARAMETERS, GUST = range(4)
GUST_AT, REFERENCE_AT, DELTA_AT, X0_AT = 0, 16, 32, 48


def delays(text: str, d_min: int = 1, d_max: int = 4, *, fifo: bool = False) -> DelayProcess:
    return parse_delays(text, d_min, d_max, fifo=fifo, longest=MAX_DELAY)


def flight_of(job: Campaign, number: int) -> Drawn:
    return drawn_block(job, number - number % LANES).flight(number % LANES)


def blocks_of(job: Campaign, count: int) -> Drawn:
    """Return what the first ``count`` blocks meet, of one more axis at the end for the flights."""
    drawn = [drawn_block(job, n * LANES) for n in range(count)]
    return Drawn._make(np.concatenate(arrays, axis=-1) for arrays in zip(*drawn, strict=True))


# -- Philox 4x32-10


def plain_philox(counter: tuple[int, ...], key: tuple[int, ...]) -> tuple[int, ...]:
    """Return the four words, in Python's integers, as the paper's figure says."""
    (c0, c1, c2, c3), (k0, k1) = counter, key
    for _ in range(10):
        left, right = 0xD2511F53 * c0, 0xCD9E8D57 * c2
        c0, c1, c2, c3 = (right // WORD) ^ c1 ^ k0, right % WORD, (left // WORD) ^ c3 ^ k1, left % WORD
        k0, k1 = (k0 + 0x9E3779B9) % WORD, (k1 + 0xBB67AE85) % WORD
    return c0, c1, c2, c3


def plain_words(seed: int, flight: int, index: int, purpose: int) -> tuple[int, ...]:
    return plain_philox((flight % WORD, flight // WORD, index, purpose), (seed % WORD, seed // WORD))


def share(word: int) -> float:
    return (word + 0.5) / WORD


VECTORS = [
    ("00000000 00000000 00000000 00000000", "00000000 00000000", "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
    ("ffffffff ffffffff ffffffff ffffffff", "ffffffff ffffffff", "408f276d 41c83b0e a20bc7c6 6d5451fd"),
    ("243f6a88 85a308d3 13198a2e 03707344", "a4093822 299f31d0", "d16cfe09 94fdcceb 5001e420 24126ea1"),
]
"""Counter, key and words, from the known answers of Random123 (kat_vectors)."""


@pytest.mark.parametrize(("counter", "key", "answer"), VECTORS, ids=["zeros", "ones", "digits of pi"])
def test_philox_gives_the_published_answers(counter: str, key: str, answer: str) -> None:
    c0, c1, c2, c3 = (int(word, 16) for word in counter.split())
    k0, k1 = (int(word, 16) for word in key.split())
    expected = tuple(int(word, 16) for word in answer.split())
    assert plain_philox((c0, c1, c2, c3), (k0, k1)) == expected
    found = philox.words(np.uint64(k1 * WORD + k0), np.uint64(c1 * WORD + c0), np.uint64(c2), np.uint64(c3))
    assert tuple(int(word) for word in found) == expected
    assert philox.philox.py_func(*(np.uint64(n) for n in (c0, c1, c2, c3, k0, k1))) == expected


@pytest.mark.parametrize("seed", [0, 1, WORD - 1, WORD + 7, 2**63 - 1])
def test_seed_and_flight_are_key_and_counter_in_full(seed: int) -> None:
    for flight in (0, 31, WORD - 1, WORD, 2**40 + 3, 10**12):
        for index, purpose in ((0, 0), (99, 3), (250_000, 1)):
            found = philox.words(seed, flight, index, purpose)
            assert tuple(map(int, found)) == plain_words(seed, flight, index, purpose)


def test_a_uniform_number_meets_neither_end() -> None:
    assert philox.uniform(np.uint64(0)) == 2.0**-33
    assert philox.uniform(np.uint64(WORD - 1)) == 1.0 - 2.0**-33
    assert philox.uniform(np.uint64(WORD // 2)) == 0.5 + 2.0**-33


def test_normals_are_those_of_box_and_muller_and_finite_at_the_ends() -> None:
    for one in (0, 1, 12345, WORD - 1):
        for two in (0, WORD // 4, WORD - 1):
            radius, turn = math.sqrt(-2.0 * math.log(share(one))), 2.0 * math.pi * share(two)
            found = philox.normals(np.uint64(one), np.uint64(two))
            assert found == pytest.approx((radius * math.cos(turn), radius * math.sin(turn)), rel=1e-12, abs=1e-14)


# -- distributions of what is drawn


def test_white_noise_is_standard_normal_and_independent_of_itself_and_of_the_reference() -> None:
    job = campaign(gust=parse_signal("white:2", "gust"), reference=parse_signal("white:0.5", "reference"))
    drawn = blocks_of(job, 8)
    w, r = drawn.w[:, 0] / 2.0, drawn.r[:, 0] / 0.5
    for noise in (w, r):
        flat = noise.ravel()
        assert stats.kstest(flat, "norm").pvalue > 1e-3
        assert abs(flat.mean()) < 4.0 / math.sqrt(flat.size)
        assert abs(flat.var() - 1.0) < 4.0 * math.sqrt(2.0 / flat.size)
        assert abs(stats.kurtosis(flat)) < 4.0 * math.sqrt(24.0 / flat.size)
        for lag in (1, 2, 4):
            assert abs(np.mean(noise[lag:] * noise[:-lag])) < 4.0 / math.sqrt(noise[lag:].size)
        assert abs(np.mean(noise[:, 1:] * noise[:, :-1])) < 4.0 / math.sqrt(noise.size)
    assert abs(np.mean(w * r)) < 4.0 / math.sqrt(w.size)


def test_white_noise_of_two_channels_is_independent() -> None:
    w = blocks_of(campaign("pendulum-paper", gust=parse_signal("white:1", "gust"), reference=Signal()), 8).w
    assert stats.kstest(w.ravel(), "norm").pvalue > 1e-3
    one, two = w[:, 0].ravel(), w[:, 1].ravel()
    for a, b in ((one, two), (one[1:], two[:-1]), (one[:-1], two[1:])):
        assert abs(np.mean(a * b)) < 4.0 / math.sqrt(a.size)


def test_white_noise_is_what_the_generator_says_number_by_number() -> None:
    job = campaign(gust=parse_signal("white:2", "gust"), samples=7, seed=WORD + 5)
    w = flight_of(job, 2**40 + 9).w[:, 0]
    for k in range(7):
        one, two, _, _ = plain_words(WORD + 5, 2**40 + 9, k // 2 * 2, GUST)
        turn = 2.0 * math.pi * share(two)
        part = math.sin(turn) if k % 2 else math.cos(turn)
        assert w[k] == pytest.approx(2.0 * math.sqrt(-2.0 * math.log(share(one))) * part, rel=1e-12)


def test_amplitudes_are_even_and_periods_even_in_the_logarithm_over_their_spans() -> None:
    job = campaign(
        gust=parse_signal("sine:1deg..3deg:0.5s..10s", "gust"),
        reference=parse_signal("square:0..5deg:1s..10s", "reference"),
        x0=0.3,
        samples=2,
    )
    columns = fly_range(job, 0, 20_000)
    spans = {"gust_amplitude": (DEG, 3.0 * DEG), "reference_amplitude": (0.0, 5.0 * DEG)}
    for name, (low, high) in spans.items():
        assert stats.kstest(columns[name], "uniform", (low, high - low)).pvalue > 1e-3
    assert stats.kstest(np.log(columns["gust_period_s"]), "uniform", (math.log(0.5), math.log(20.0))).pvalue > 1e-3
    halves = np.round(columns["reference_period_s"] / (2.0 * job.plant.Ts)).astype(int)
    exact = np.arange(20, 201)  # of periods from 40 to 400 samples, each rounded to its nearest whole half
    edges = np.clip(2.0 * np.append(exact - 0.5, 200.5), 40.0, 400.0)
    chances = np.diff(np.log(edges)) / math.log(10.0)
    counts = np.bincount(halves, minlength=201)[20:]
    assert stats.chisquare(counts, chances * 20_000).pvalue > 1e-3
    ranks = np.array([columns[name] for name in columns if name.endswith(("amplitude", "period_s", "x0_norm"))])
    assert len(ranks) == 5
    correlations = np.corrcoef(stats.rankdata(ranks, axis=1)) - np.eye(5)
    assert np.abs(correlations).max() < 4.0 / math.sqrt(20_000)


def test_a_span_of_one_number_is_that_number() -> None:
    job = campaign(
        gust=parse_signal("sine:2deg:1s", "gust"), reference=parse_signal("step:0.5deg", "reference"), samples=2
    )
    columns = fly_range(job, 0, 64)
    assert np.array_equal(columns["gust_amplitude"], np.full(64, 2.0 * DEG))
    assert columns["gust_period_s"] == pytest.approx(1.0, rel=1e-14)
    assert np.array_equal(columns["reference_amplitude"], np.full(64, 0.5 * DEG))
    assert "reference_period_s" not in columns


@pytest.mark.parametrize("samples", [400, 4000])
def test_a_sine_is_its_formula(samples: int) -> None:
    job = campaign(gust=parse_signal("sine:1..3:0.5s..10s", "gust"), samples=samples, seed=12)
    k, drawn = np.arange(samples), drawn_block(job, 64)
    for lane in (0, 7, 31):
        one, two, three, _ = map(share, plain_words(12, 64 + lane, GUST_AT, PARAMETERS))
        amplitude, period = 1.0 + 2.0 * one, 20.0 * 20.0**two
        assert drawn.parameters[:2, lane] == pytest.approx((amplitude, period), rel=1e-14)
        expected = amplitude * np.sin(2.0 * math.pi * (k / period + three))
        assert np.abs(drawn.w[:, 0, lane] - expected).max() < 1e-9


def test_a_square_wave_has_whole_half_periods_and_begins_anywhere_in_them() -> None:
    job = campaign(reference=parse_signal("square:1..2:0.5s..2.5s", "reference"), samples=300, seed=3)
    drawn = blocks_of(job, 64)
    halves, beginnings = np.rint(drawn.parameters[3] / 2.0).astype(int), []
    for lane, half in enumerate(halves):
        r = drawn.r[:, 0, lane]
        assert 10 <= half <= 50
        assert np.array_equal(np.abs(r), np.full(300, drawn.parameters[2, lane]))
        edges = np.flatnonzero(np.diff(r)) + 1
        assert 1 <= edges[0] <= half
        assert (np.diff(edges) == half).all()
        beginnings.append((half - edges[0] + 0.5) / half)
    assert stats.kstest(beginnings, "uniform").pvalue > 1e-3
    up = int(np.count_nonzero(drawn.r[0, 0] > 0.0))
    assert stats.binomtest(up, len(halves), 0.5).pvalue > 1e-3


def test_the_shortest_square_wave_alternates() -> None:
    drawn = drawn_block(campaign(gust=parse_signal("square:1:0.001s", "gust"), samples=20), 0)
    assert (drawn.w[1:] == -drawn.w[:-1]).all()
    assert (drawn.parameters[1] == 2.0).all()


def test_the_uncertainty_is_a_square_wave_of_its_spans() -> None:
    drawn = blocks_of(campaign(delta=Span(0.05, 0.15)), 32)
    assert stats.kstest(drawn.parameters[4], "uniform", (0.05, 0.1)).pvalue > 1e-3
    assert np.array_equal(np.abs(drawn.delta[:, 0]), np.tile(drawn.parameters[4], (400, 1)))
    changes = [np.flatnonzero(np.diff(row)) for row in drawn.delta[:, 0].T]
    halves = np.array([np.diff(row)[0] for row in changes if len(row) > 1])
    assert all(len(set(np.diff(row))) <= 1 for row in changes)
    assert len(halves) == 1024  # of 100 samples at most: each shows one in full
    chances = np.diff(np.log(np.clip(2.0 * np.append(np.arange(1, 101) - 0.5, 100.5), 2.0, 200.0))) / math.log(100.0)
    few = np.add.reduceat(chances, [0, 1, 2, 4, 8, 16, 32, 64])
    counts = np.add.reduceat(np.bincount(halves, minlength=101)[1:], [0, 1, 2, 4, 8, 16, 32, 64])
    assert stats.chisquare(counts, few * 1024).pvalue > 1e-3


def test_a_step_of_one_channel_has_either_sign_and_of_several_a_direction_of_length_one() -> None:
    r = blocks_of(campaign(reference=parse_signal("step:2", "reference"), samples=5), 32).r[:, 0]
    assert (r == r[0]).all()
    assert set(r[0]) == {-2.0, 2.0}
    assert stats.binomtest(int(np.count_nonzero(r[0] > 0.0)), 1024, 0.5).pvalue > 1e-3
    for kind in ("step:2", "square:2:0.001s"):
        w = blocks_of(campaign("pendulum-paper", gust=parse_signal(kind, "gust"), reference=Signal(), samples=5), 32).w[
            0
        ]
        assert np.hypot(*w) == pytest.approx(2.0, rel=1e-14)
        assert stats.kstest(np.arctan2(w[1], w[0]), "uniform", (-math.pi, 2.0 * math.pi)).pvalue > 1e-3


def test_of_several_channels_a_sine_keeps_its_direction() -> None:
    job = campaign("pendulum-paper", gust=parse_signal("sine:1..2:1s", "gust"), reference=Signal())
    drawn = drawn_block(job, 0)
    for lane in range(LANES):
        w = drawn.w[:, :, lane]
        assert np.linalg.matrix_rank(w, tol=1e-9) == 1
        assert np.hypot(*w.T).max() <= drawn.parameters[0, lane] * (1.0 + 1e-9)
        assert np.hypot(*w.T).max() > 0.99 * drawn.parameters[0, lane]


def test_none_is_zero_and_has_no_column() -> None:
    job = campaign(gust=Signal(), reference=Signal(), samples=50)
    drawn, columns = drawn_block(job, 0), fly_range(job, 0, 10)
    assert not drawn.w.any()
    assert not drawn.r.any()
    assert not drawn.delta.any()
    assert not drawn.x0.any()
    assert not drawn.parameters.any()
    assert not any(name.startswith(("gust", "reference", "delta", "x0")) for name in columns)
    assert np.isnan(columns["gain"]).all()  # no error and nothing that made one
    assert not columns["max_error"].any()


def test_each_state_begins_evenly_within_x0() -> None:
    x0 = blocks_of(campaign(x0=0.2, samples=1), 32).x0
    assert stats.kstest(x0.ravel(), "uniform", (-0.2, 0.4)).pvalue > 1e-3
    assert np.abs(np.corrcoef(x0) - np.eye(3)).max() < 4.0 / math.sqrt(1024)
    norms = fly_range(campaign(x0=0.2, samples=1), 0, 1024)["x0_norm"]
    assert norms == pytest.approx(np.linalg.norm(x0, axis=0), rel=1e-14)


OTHERWISE: list[tuple[dict[str, Any], set[str]]] = [
    ({"gust": Signal()}, {"w"}),
    ({"gust": Signal("white", Span(1.0, 1.0))}, {"w"}),
    ({"gust": Signal("square", Span(0.0, 9.0))}, {"w"}),
    ({"reference": Signal()}, {"r"}),
    ({"reference": Signal("white", Span(1.0, 1.0))}, {"r"}),
    ({"delta": Span(0.01, 0.02)}, {"delta"}),
    ({"x0": 0.5}, {"x0"}),
    ({"delays": delays("uniform", 2, 3)}, {"d"}),
    ({"delays": delays("hold:0.7")}, {"d"}),
    ({"law": require_law(load_law("hirm-d6"))}, set()),
    ({"flights": 9}, set()),
]


@pytest.mark.parametrize(("changes", "moved"), OTHERWISE, ids=[",".join(changes) for changes, _ in OTHERWISE])
def test_one_option_leaves_what_the_others_draw_to_the_last_bit(changes: dict[str, Any], moved: set[str]) -> None:
    job = campaign(delta=Span(0.1, 0.15), x0=0.01, samples=60)
    before, after = drawn_block(job, 96), drawn_block(replace(job, **changes), 96)
    same = {
        name for name in ("d", "w", "r", "delta", "x0") if np.array_equal(getattr(before, name), getattr(after, name))
    }
    assert {"d", "w", "r", "delta", "x0"} - same == moved


def test_another_seed_is_another_flight_throughout() -> None:
    job = campaign(delta=Span(0.1, 0.15), x0=0.01, samples=60)
    before, after = drawn_block(job, 0), drawn_block(replace(job, seed=2), 0)
    assert not any(np.array_equal(one, other) for one, other in zip(before, after, strict=True))


def test_hold_keeps_what_it_does_not_redraw() -> None:
    """A held sample has the delay before; the others have what uniform drew."""
    free, held = (blocks_of(campaign(delays=delays(text), samples=200), 4).d for text in ("uniform", "hold:0.6"))
    kept = held[1:] == held[:-1]
    assert (kept | (held[1:] == free[1:])).all()
    assert np.array_equal(held[0], free[0])


# -- delays


def test_uniform_delays_fill_the_window_evenly_and_independently() -> None:
    d = blocks_of(campaign(), 16).d
    counts = np.bincount(d.ravel(), minlength=5)
    assert counts[0] == 0
    assert stats.chisquare(counts[1:]).pvalue > 1e-3
    for before, after in ((d[:-1], d[1:]), (d[:-4], d[4:]), (d[:, :-1], d[:, 1:])):
        pairs = np.bincount((5 * before + after).ravel(), minlength=25).reshape(5, 5)[1:, 1:]
        assert stats.chi2_contingency(pairs).pvalue > 1e-3


def test_uniform_delays_are_what_the_generator_says() -> None:
    job = campaign(samples=9, seed=5)
    words = [word for index in range(3) for word in plain_words(5, 2**40 + 1, index, DELAY)]
    assert delays_of(job, 2**40 + 1) == tuple(1 + 4 * word // WORD for word in words[:9])


def test_held_delays_stay_and_move_with_the_probabilities_asked_for() -> None:
    d = blocks_of(campaign(delays=delays("hold:0.7")), 16).d
    pairs = np.bincount((5 * d[:-1] + d[1:]).ravel(), minlength=25).reshape(5, 5)[1:, 1:]
    expected = pairs.sum(axis=1, keepdims=True) * (0.7 * np.eye(4) + 0.3 / 4.0)
    assert stats.chisquare(pairs.ravel(), expected.ravel(), ddof=3).pvalue > 1e-3
    assert stats.chisquare(np.bincount(d[0], minlength=5)[1:]).pvalue > 1e-3


def test_geometric_delays_have_the_mean_and_the_tail_asked_for() -> None:
    d = blocks_of(campaign(delays=delays("geometric:2.5")), 16).d.ravel()
    p = 2.5 / 3.5
    assert d.mean() == pytest.approx(1.0 + 2.5, abs=4.0 * math.sqrt(2.5 * 3.5 / d.size))
    counts = np.bincount(np.minimum(d - 1, 25), minlength=26)
    chances = np.append((1.0 - p) * p ** np.arange(25), p**25)
    assert stats.chisquare(counts, chances * d.size).pvalue > 1e-3


def test_the_tail_of_geometric_delays_is_put_at_the_longest_that_can_be_flown() -> None:
    job = campaign(delays=parse_delays("geometric:9", 1, 4, fifo=False, longest=12))
    d = blocks_of(job, 4).d
    assert d.max() == 12
    assert stats.binomtest(int(np.count_nonzero(d == 12)), d.size, 0.9**11).pvalue > 1e-3


@pytest.mark.parametrize("text", ["uniform", "hold:0.4", "geometric:3"])
def test_in_order_a_delay_exceeds_the_one_before_by_one_at_most(text: str) -> None:
    free, fifo = (blocks_of(campaign(delays=delays(text, 1, 6, fifo=order)), 2).d for order in (False, True))
    assert np.diff(free, axis=0).max() > 1
    assert np.diff(fifo, axis=0).max() == 1
    assert fifo.min() == 1
    expected = free.copy()
    for k in range(1, len(free)):
        expected[k] = np.minimum(free[k], expected[k - 1] + 1)
    assert np.array_equal(fifo, expected)


def test_a_window_of_one_delay_has_that_one() -> None:
    assert (drawn_block(campaign(delays=delays("uniform", 3, 3)), 0).d == 3).all()
    assert (drawn_block(campaign(delays=delays("uniform", 0, 0)), 0).d == 0).all()


CYCLE = (2, 3, 1, 2, 2, 3, 4)


@pytest.fixture
def cycle(tmp_path: Path) -> str:
    write_witness(tmp_path / "cycle.csv", Witness("", "", 0.025, 1, 4, "fifo", 1.0, CYCLE[1:] + CYCLE[:1]))
    return f"cycle:{tmp_path / 'cycle.csv'}"


def test_a_cycle_is_entered_anywhere_and_repeats(cycle: str) -> None:
    d = blocks_of(campaign(delays=delays(cycle), samples=30), 16).d
    turned = {tuple(np.resize(np.roll(CYCLE, -n), 30).tolist()): n for n in range(7)}
    places = [turned[tuple(row)] for row in d.T.tolist()]
    assert stats.chisquare(np.bincount(places, minlength=7)).pvalue > 1e-3


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "expected uniform"),
        ("even", "expected uniform"),
        ("uniform:2", "expected uniform"),
        ("hold", "a probability"),
        ("hold:", "a probability"),
        ("hold:1", "a probability"),
        ("hold:1.0", "a probability"),
        ("hold:-0.1", "a probability"),
        ("hold:nan", "a probability"),
        ("hold:1e-3", "a probability"),
        ("geometric", "a mean"),
        ("geometric:0", "a mean"),
        ("geometric:127", "a mean"),
        ("geometric:inf", "a mean"),
        ("geometric:-2", "a mean"),
        ("cycle", "expected uniform"),
        ("cycle:", "expected uniform"),
        ("cycle:no-such-file.csv", "no-such-file.csv"),
    ],
)
def test_delays_that_are_none_are_refused(text: str, complaint: str) -> None:
    with pytest.raises(InputError, match=complaint):
        delays(text)


def test_a_cycle_must_keep_the_order_and_the_longest_delay(tmp_path: Path) -> None:
    path = tmp_path / "any.csv"
    write_witness(path, Witness("", "", 0.025, 1, 9, "any", 1.0, (1, 9)))
    assert delays(f"cycle:{path}").cycle == (1, 9)
    with pytest.raises(InputError, match="fifo"):
        delays(f"cycle:{path}", fifo=True)
    with pytest.raises(InputError, match="up to 8, found 9"):
        parse_delays(f"cycle:{path}", 1, 4, fifo=False, longest=8)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("none", Signal()),
        ("step:2", Signal("step", Span(2.0, 2.0))),
        ("white:0..1deg", Signal("white", Span(0.0, DEG))),
        ("sine:1deg..2deg", Signal("sine", Span(DEG, 2.0 * DEG), Span(0.5, 10.0))),
        ("square:1deg:20ms..3s", Signal("square", Span(DEG, DEG), Span(0.02, 3.0))),
        ("sine:0.5rad:2s", Signal("sine", Span(0.5, 0.5), Span(2.0, 2.0))),
    ],
)
def test_signals_are_read_as_written(text: str, expected: Signal) -> None:
    found = parse_signal(text, "gust")
    assert found.kind == expected.kind
    assert found.amplitude == pytest.approx(expected.amplitude, rel=1e-15)
    assert found.period_s == pytest.approx(expected.period_s, rel=1e-15)


@pytest.mark.parametrize(
    "text",
    [
        "", "noise:1", "none:1", "step", "step:", "step:1:2s", "white:1:2s", "sine", "sine:1:2s:3s", "sine:1:0s",
        "sine:1:0.5ms", "sine:1:1000001s", "sine:1:2", "sine:1:2deg", "sine:2..1", "sine:-1", "sine:1e3", "sine:nan",
        "sine:inf", "sine:1m", "sine:2000000000", "sine: 1", "sine:1..2..3", "sine:1:3s..2s",
    ],
)  # fmt: skip
def test_signals_that_are_none_are_refused(text: str) -> None:
    with pytest.raises(InputError, match="gust"):
        parse_signal(text, "gust")


def test_a_unit_at_the_end_of_a_span_counts_for_both_ends() -> None:
    assert parse_span("1..2deg", "x") == pytest.approx((DEG, 2.0 * DEG), rel=1e-15)
    assert parse_span("1rad..180deg", "x") == pytest.approx((1.0, math.pi), rel=1e-15)
    with pytest.raises(InputError, match="LOW"):
        parse_span("1deg..2", "x", {"deg": DEG})
    with pytest.raises(InputError, match="LOW"):
        parse_span("5deg..10", "x")  # 10 of what?


# -- the loop


def fly_plainly(job: Campaign, drawn: Drawn) -> dict[str, float]:
    """Return the results of one flight, Eqs. (4), (8) and (9) as they stand."""
    law, m = job.law, job.plant
    sets = law.sets if isinstance(law, Schedule) else (law,)
    reference = law.model.reference
    xr = np.zeros(0 if reference is None else len(reference.Ar))
    x, errors, inputs, largest = [drawn.x0], [], [], [0.0]
    at, diverged_at = np.zeros(m.nu), -1
    for k in range(job.samples):
        d = int(drawn.d[k])
        gains = next((one for one in sets if one.d_min <= d <= one.d_max), sets[0] if d < law.d_min else sets[-1])
        u = gains.K1 @ x[k - d] if d <= k else np.zeros(m.nu)
        e = m.C @ x[k]
        if reference is not None:
            assert gains.K2 is not None
            u = u + gains.K2 @ xr
            e = e - reference.Cr @ xr
            xr = reference.Ar @ xr + reference.Br @ drawn.r[k]
        if job.limits and (actuator := m.actuator) is not None:
            assert actuator.low is not None
            assert actuator.high is not None
            u = np.minimum(np.maximum(u, actuator.low), actuator.high)
            if actuator.tau is not None:
                u = at + (1.0 - np.exp(-m.Ts / actuator.tau)) * (u - at)
            if actuator.rate is not None:
                u = np.minimum(np.maximum(u, at - m.Ts * actuator.rate), at + m.Ts * actuator.rate)
            at = u
        e = e + m.D @ u
        following = m.A @ x[k] + m.B @ u + m.E @ drawn.w[k]
        if job.uncertain:
            assert m.uncertainty is not None
            part = m.uncertainty
            following = following + part.F @ (drawn.delta[k] * (part.J1 @ x[k] + part.J2 @ u))
        x.append(following)
        if diverged_at < 0:
            errors.append(e)
            inputs += [*drawn.w[k], *drawn.r[k]]
        largest.append(float(np.abs(following).max()))
        if diverged_at < 0 and largest[-1] >= 1e6:
            diverged_at = k + 1
    error, disturbance = float(np.linalg.norm(errors)), float(np.linalg.norm(inputs))
    return {
        "diverged": diverged_at >= 0,
        "diverged_at": diverged_at,
        "gain": math.inf if diverged_at >= 0 else error / disturbance,
        "error_norm": error,
        "input_norm": disturbance,
        "rms_error": error / math.sqrt(len(errors)),
        "max_error": float(np.abs(errors).max()),
        "max_state": max(largest),
        "growth": (max(largest) / max(largest[: 1 + job.samples // 2])) ** (1.0 / (job.samples - job.samples // 2)),
        "d_mean": float(np.mean(drawn.d)),
        "d_max": int(drawn.d.max()),
        "outside": float(np.mean([not job.d_min <= d <= job.d_max for d in drawn.d])),
        "changes": sum(int(one != other) for one, other in pairwise(drawn.d)),
    }


def agree(job: Campaign, columns: Columns, flights: list[int], start: int = 0, rel: float = 1e-12) -> None:
    assert columns["flight"].tolist() == list(range(start, start + len(columns["flight"])))
    for flight in flights:
        plain = fly_plainly(job, flight_of(job, flight))
        flown = {name: columns[name][flight - start] for name in plain}
        assert flown == pytest.approx(plain, rel=rel)


def two_sets(law: GainLaw) -> Schedule:
    assert isinstance(law, Gains)
    assert law.K2 is not None
    short = replace(law, name="short", d_min=1, d_max=2, K1=1.1 * law.K1, K2=1.1 * law.K2, certificate=None)
    long = replace(law, name="long", d_min=2, d_max=4, K1=0.7 * law.K1, K2=0.7 * law.K2, certificate=None)
    return Schedule("two", law.model, (short, long))


HIRM = require_law(load_law("hirm-paper"))
LAGGING = replace(HIRM.model, actuator=Actuator(np.array([-0.02]), np.array([0.03]), np.array([0.4]), np.array([0.04])))
HARD = parse_signal("sine:2deg..9deg:0.5s..10s", "gust")


@pytest.mark.parametrize(
    "job",
    [
        campaign(),
        campaign(x0=0.05, delays=delays("geometric:3")),
        campaign("hirm-d6", delays=delays("hold:0.9", 0, 9, fifo=True), gust=parse_signal("white:1deg", "gust")),
        campaign("pendulum-paper", gust=parse_signal("sine:0.1", "gust"), reference=Signal()),
        campaign(delta=Span(0.0, 0.15)),
        pytest.param(campaign(law=two_sets(HIRM), plant=LAGGING, limits=True, delta=Span(0.1, 0.15), gust=HARD, x0=0.1,
                              delays=delays("uniform", 0, 6)), marks=pytest.mark.long),
        pytest.param(campaign(law=two_sets(HIRM), delays=delays("uniform", 0, 6)), marks=pytest.mark.long),
        pytest.param(campaign(plant=LAGGING, limits=True, gust=HARD), marks=pytest.mark.long),
        pytest.param(campaign(limits=True, gust=parse_signal("sine:90deg", "gust")), marks=pytest.mark.long),
        pytest.param(campaign("pendulum-paper", limits=True, gust=parse_signal("step:0..0.5", "gust")),
                     marks=pytest.mark.long),
    ],
    ids=["hirm", "hirm from x0", "hirm-d6 in order", "pendulum", "uncertain", "all at once", "schedule", "lag and rate",
         "travel", "pendulum's travel"],
)  # fmt: skip
def test_a_flight_is_equations_4_8_and_9_as_they_stand(job: Campaign) -> None:
    agree(job, fly_range(job, 0, 70), [0, 1, 31, 32, 63, 64, 69])


def test_limits_and_sets_of_gains_matter_where_they_should() -> None:
    law = two_sets(HIRM)
    assert set_of_delay(law)[[0, 1, 2, 3, 4, 5, 127]].tolist() == [0, 0, 0, 1, 1, 1, 1]
    job = campaign(law=law, plant=LAGGING, limits=True, delta=Span(0.1, 0.15), gust=HARD, samples=100)
    drawn, flown = flight_of(job, 3), fly_range(job, 3, 4)
    for other in (replace(job, limits=False), replace(job, law=law.sets[0]), replace(job, law=law.sets[1])):
        assert fly_plainly(other, drawn)["error_norm"] != pytest.approx(flown["error_norm"][0], rel=1e-3)


@pytest.mark.parametrize("d", [0, 1, 4])
def test_under_a_constant_delay_the_error_is_that_of_scipys_linear_system(d: int) -> None:
    job = campaign(delays=delays("uniform", d, d), gust=parse_signal("white:1deg", "gust"))
    law, m = job.law, job.plant
    assert isinstance(law, Gains)
    assert m.reference is not None
    assert law.K2 is not None
    n, nr = m.nx * (d + 1), len(m.reference.Ar)
    A, B, C = np.zeros((n + nr, n + nr)), np.zeros((n + nr, 2)), np.zeros((1, n + nr))
    A[:n, :n] = np.eye(n, k=-m.nx)
    A[: m.nx, : m.nx] = m.A
    A[: m.nx, d * m.nx : n] += m.B @ law.K1
    A[: m.nx, n:], A[n:, n:] = m.B @ law.K2, m.reference.Ar
    B[: m.nx, :1], B[n:, 1:] = m.E, m.reference.Br
    C[:, : m.nx], C[:, n:] = m.C, -m.reference.Cr
    flown = fly_range(job, 5, 9)
    for flight in range(5, 9):
        drawn = flight_of(job, flight)
        _, e, _ = signal.dlsim((A, B, C, np.zeros((1, 2)), m.Ts), np.hstack([drawn.w, drawn.r]))
        assert flown["error_norm"][flight - 5] == pytest.approx(np.linalg.norm(e[:400]), rel=1e-11)
        assert flown["max_error"][flight - 5] == pytest.approx(np.abs(e[:400]).max(), rel=1e-11)


def equal(one: Columns, other: Columns) -> bool:
    assert one.keys() == other.keys()
    return all(np.array_equal(one[name], other[name], equal_nan=one[name].dtype.kind == "f") for name in one)


def part(columns: Columns, start: int, stop: int) -> Columns:
    return {name: values[start:stop] for name, values in columns.items()}


@pytest.mark.parametrize("base", [0, 5, WORD - 60, 2**40 - 7])
def test_a_flight_is_the_same_to_the_last_bit_in_any_range(base: int) -> None:
    job = campaign(x0=0.01, delays=delays("geometric:3", fifo=True), samples=120)
    whole = fly_range(job, base, base + 130)
    for start, stop in ((0, 1), (1, 32), (31, 64), (50, 51), (77, 130)):
        assert equal(fly_range(job, base + start, base + stop), part(whole, start, stop))
    agree(job, whole, [base, base + 63, base + 129], base)
    assert len(np.unique(whole["error_norm"])) == 130


def test_an_empty_range_is_an_empty_table() -> None:
    columns = fly_range(campaign(), 7, 7)
    assert {len(values) for values in columns.values()} == {0}


def test_a_flight_is_the_same_to_the_last_bit_whatever_room_its_delays_have() -> None:
    job = campaign()
    assert job.delays is not None
    flown = fly_range(job, 0, 40)
    for unused in (1, 4, 123):
        roomy = replace(job.delays, weights=(*job.delays.weights, *(0.0,) * unused))
        assert roomy.d_max == 4 + unused
        assert equal(fly_range(replace(job, delays=roomy), 0, 40), flown)
    given = np.array([delays_of(job, flight) for flight in range(40)], dtype=np.uint8)
    assert equal(fly_range(job, 0, 40, given), flown)
    assert equal(fly_range(job, 11, 40, given[11:]), part(flown, 11, 40))


def test_the_longest_delay_is_flown_as_any_other() -> None:
    job = campaign(delays=delays("geometric:100"), samples=300)
    columns = fly_range(job, 0, 33)
    assert columns["d_max"].max() == 127
    agree(job, columns, [0, 9, 32])


def test_a_range_again_after_another_campaign_finds_no_trace_of_it() -> None:
    job = campaign(samples=100)
    before = fly_range(job, 0, 33)
    fly_range(campaign(gust=parse_signal("white:9", "gust"), x0=3.0, delays=delays("geometric:50"), samples=90), 0, 33)
    assert equal(fly_range(job, 0, 33), before)


# -- divergence


def counting(step: float, samples: int = 20) -> Campaign:
    """Return x(k) = ± k step, in the sizes of hirm's."""
    assert isinstance(HIRM, Gains)
    model = replace(HIRM.model, A=np.diag([1.0, 0.0, 0.0]), E=np.array([[1.0], [0.0], [0.0]]), C=np.eye(1, 3))
    assert HIRM.K2 is not None
    law = replace(HIRM, model=model, K1=0.0 * HIRM.K1, K2=0.0 * HIRM.K2, certificate=None)
    gust = Signal("step", Span(step, step))
    return campaign(law=law, plant=model, gust=gust, reference=Signal(), samples=samples)


@pytest.mark.parametrize(("step", "first"), [(1e5, 10), (math.nextafter(1e5, 0.0), 11), (2e6, 1), (99_999.0, 11)])
def test_a_flight_has_diverged_at_the_first_sample_of_a_million(step: float, first: int) -> None:
    columns = fly_range(counting(step), 0, 40)
    assert (columns["diverged_at"] == first).all()
    assert columns["diverged"].all()
    assert np.isinf(columns["gain"]).all()
    assert columns["error_norm"] == pytest.approx(step * math.sqrt(sum(k * k for k in range(first))), rel=1e-12)
    assert columns["input_norm"] == pytest.approx(step * math.sqrt(first), rel=1e-12)
    assert columns["max_error"] == pytest.approx((first - 1) * step, rel=1e-12)
    assert columns["rms_error"] == pytest.approx(columns["error_norm"] / math.sqrt(first), rel=1e-15)


def test_a_flight_that_ends_below_a_million_has_not_diverged() -> None:
    columns = fly_range(counting(1e5, samples=9), 0, 40)
    assert not columns["diverged"].any()
    assert (columns["diverged_at"] == -1).all()
    assert columns["max_state"] == pytest.approx(9e5, rel=1e-12)
    assert columns["gain"] == pytest.approx(math.sqrt(sum(k * k for k in range(9)) / 9.0), rel=1e-12)


def test_a_pendulum_that_falls_has_diverged_when_plain_flying_says_so() -> None:
    job = campaign("pendulum-paper", delays=delays("uniform", 8, 20), gust=Signal("step", Span(0.1, 0.1)),
                   reference=Signal(), samples=220)  # fmt: skip
    columns = fly_range(job, 0, 64)
    assert 5 < np.count_nonzero(columns["diverged"]) < 59
    for flight in range(64):
        plain = fly_plainly(job, flight_of(job, flight))
        assert {name: columns[name][flight] for name in plain} == pytest.approx(plain, rel=1e-10)
    assert (columns["outside"] == 1.0).all()


def test_a_flight_that_overflows_is_one_that_diverged() -> None:
    job = campaign("pendulum-paper", delays=delays("uniform", 60, 60), gust=Signal("step", Span(0.1, 0.1)),
                   reference=Signal(), samples=10_000)  # fmt: skip
    columns = fly_range(job, 0, 32)
    assert columns["diverged"].all()
    assert np.isfinite(columns["error_norm"]).all()
    assert np.isfinite(columns["max_error"]).all()
    assert (columns["max_state"] >= 1e6).all()


def test_the_growth_of_a_constant_delay_is_its_spectral_radius() -> None:
    """Of the pendulum at d = 8, 1.0087 per sample."""
    job = campaign("pendulum-paper", delays=delays("uniform", 8, 8), gust=Signal("step", Span(0.1, 0.1)),
                   reference=Signal(), samples=8000)  # fmt: skip
    law = job.law
    assert isinstance(law, Gains)
    lifted = np.eye(18, k=-2)
    lifted[:2, :2] = law.model.A
    lifted[:2, 16:] += law.model.B @ law.K1
    radius = float(np.abs(np.linalg.eigvals(lifted)).max())
    assert radius == pytest.approx(1.0087, abs=5e-5)
    assert growth_per_sample(job, (8,)) == pytest.approx(radius, rel=1e-10)
    assert growth_per_sample(job, (8,) * 5) == pytest.approx(radius, rel=1e-9)
    assert np.log(fly_range(job, 0, 32)["growth"]) == pytest.approx(math.log(radius), rel=1e-2)


# -- the same flights in Python, on any airframe


@pytest.mark.parametrize(
    "job",
    [
        campaign(x0=0.05, delays=delays("geometric:3"), samples=150),
        campaign("pendulum-paper", gust=parse_signal("sine:0.1", "gust"), reference=Signal(), samples=150),
        pytest.param(campaign(law=two_sets(HIRM), plant=LAGGING, limits=True, delta=Span(0.1, 0.15), gust=HARD, x0=0.1,
                              samples=150, delays=delays("uniform", 0, 6)), marks=pytest.mark.long),
    ],
    ids=["hirm", "pendulum", "all at once"],
)  # fmt: skip
def test_a_linear_airframe_flies_what_compiled_code_flies(job: Campaign) -> None:
    one, other = fly_airframes(job, 30, 36), fly_range(job, 30, 36)
    assert one.keys() == other.keys()
    for name in one:
        assert one[name] == pytest.approx(other[name], rel=1e-12), name


def test_a_linear_airframe_diverges_with_compiled_code_and_flies_given_delays() -> None:
    job = campaign("pendulum-paper", gust=Signal("step", Span(0.1, 0.1)), reference=Signal(), samples=220)
    given = np.tile(np.array([[12], [16], [20]], dtype=np.uint8), (1, 220))
    one, other = fly_airframes(job, 31, 34, given), fly_range(job, 31, 34, given)
    assert one["diverged"].any()
    for name in ("diverged", "diverged_at", "gain", "error_norm", "input_norm", "rms_error", "max_error", "d_mean"):
        assert one[name] == pytest.approx(other[name], rel=1e-10), name


def sixdof(amplitude: str, **changes: Any) -> Campaign:
    return campaign(
        "hirm-6dof-d6",
        plant_name="sixdof:hirm",
        gust=parse_signal(f"sine:{amplitude}:1s..4s", "gust"),
        reference=parse_signal(f"square:{amplitude}:1s..4s", "reference"),
        **{"samples": 80, **changes},
    )


def test_six_degrees_of_freedom_in_a_tiny_gust_fly_as_the_model_they_are_linearised_to() -> None:
    tiny = sixdof("0.02deg")
    flown, linear = fly_airframes(tiny, 0, 4), fly_range(replace(tiny, plant_name="hirm-6dof"), 0, 4)
    for name in ("error_norm", "max_error", "max_state", "gain"):
        assert flown[name] == pytest.approx(linear[name], rel=0.02), name
    assert flown["input_norm"] == pytest.approx(linear["input_norm"], rel=1e-12)


def test_wind_differs_from_flight_to_flight_and_is_the_same_again() -> None:
    calm = sixdof("0.5deg", samples=40)
    windy = replace(calm, wind=parse_wind("dryden:moderate"))
    flown = fly_airframes(windy, 30, 34)
    assert equal(fly_airframes(windy, 31, 33), part(flown, 1, 3))
    still = fly_airframes(calm, 30, 34)
    assert (np.abs(flown["error_norm"] / still["error_norm"] - 1.0) > 1e-3).all()
    other = fly_airframes(replace(windy, gust=Signal(), reference=Signal()), 30, 34)
    assert len(set(other["error_norm"])) == 4


@pytest.mark.long
def test_jsbsim_in_a_small_gust_flies_as_the_model_it_is_linearised_to() -> None:
    """Within 4 %, over the second and a half in which the speed has not yet changed."""
    pytest.importorskip("jsbsim")
    model = model_of(linearise("c172x", vc_kts=100.0, altitude_m=5000.0 * FOOT), "c172x", 0.025, None, None, 0.7)
    law = Gains("weak", model, 1, 4, np.array([[0.0, 0.0, 0.5]]), None)
    job = campaign(
        law=law,
        plant=model,
        plant_name="jsbsim:c172x",
        gust=parse_signal("step:0.5deg", "gust"),
        reference=Signal(),
        samples=60,
    )
    flown, linear = fly_airframes(job, 30, 34), fly_range(replace(job, plant_name="c172x"), 30, 34)
    for name in ("error_norm", "max_error", "max_state", "gain"):
        assert flown[name] == pytest.approx(linear[name], rel=0.04), name
    assert equal(fly_airframes(job, 31, 33), part(flown, 1, 3))
