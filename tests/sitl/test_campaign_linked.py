"""d(k) of a campaign over a link: against what can be computed, plain NumPy, and the link in the MAVLink flight."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from sitl.campaign.distributions import Signal, Span
from sitl.campaign.engine import fly_range
from sitl.campaign.job import Campaign
from sitl.campaign.linked import linked_delays
from sitl.campaign.replaying import delays_of
from sitl.campaign.tasks import fly, is_compiled
from sitl.flight import fly_virtual
from sitl.link.presets import parse_link
from sitl.recorder import FlightRecorder
from sitl.scenario import load_scenario
from tests.sitl.campaigns import campaign

Integers = NDArray[np.int64]
MS = 1_000_000


def over(
    up: str | None, down: str | None, gains: str = "hirm-paper", preset: str | None = None, **more: int
) -> Campaign:
    gust = Signal("sine", Span(0.0, 0.06))
    return campaign(gains, delays=None, link=parse_link(preset, up, down), gust=gust, reference=Signal(), **more)


def delays(job: Campaign, flights: int, start: int = 0) -> Integers:
    return linked_delays(job, start, start + flights).astype(np.int64)


# -- links whose delays can be computed


@pytest.mark.parametrize("gains", ["hirm-paper", "pendulum-paper"])
@pytest.mark.parametrize(
    ("up_us", "down_us"),
    [(0, 0), (12_000, 12_000), (12_500, 12_500), (12_500, 12_501), (30_000, 0), (0, 30_001), (100_000, 70_000)],
)
def test_a_constant_latency_is_so_many_samples_rounded_up(gains: str, up_us: int, down_us: int) -> None:
    job = over(f"delay={up_us}us", f"delay={down_us}us", gains, samples=50)
    d = max(1, -(-1000 * (up_us + down_us) // job.plant.Ts_ns))
    expected = np.minimum(np.arange(1, 51), d)  # before the first command nothing came: k + 1
    assert (delays(job, 2) == expected).all()


def test_up_and_down_are_ways_of_their_own() -> None:
    """A command that is lost is one state that is lost; a state of two messages is lost twice as often."""
    up, down = (delays(over(*ways), 25)[:, ::20].mean() for ways in (("loss=0.3", None), (None, "loss=0.3")))
    assert down == pytest.approx(1.0 / 0.7, abs=0.1)
    assert up == pytest.approx(1.0 / 0.49, abs=0.2)


@pytest.mark.parametrize(
    ("gains", "up", "down", "passes"),
    [
        ("hirm-paper", 0.0, 0.4, 0.6),
        ("hirm-paper", 0.3, 0.0, 0.7**2),  # the angle of attack is in a message of its own
        ("hirm-paper", 0.2, 0.2, 0.8**3),
        ("pendulum-paper", 0.4, 0.0, 0.6),
        ("pendulum-paper", 0.2, 0.2, 0.8**2),
    ],
)
def test_under_loss_the_age_is_one_and_a_geometric_number_of_samples(
    gains: str, up: float, down: float, passes: float
) -> None:
    d = delays(over(f"delay=5ms,loss={up}", f"delay=5ms,loss={down}", gains), 30)[:, 40::30].ravel()
    counts = np.bincount(np.minimum(d, 5), minlength=6)[1:]
    chances = np.append(passes * (1.0 - passes) ** np.arange(4), (1.0 - passes) ** 4)
    assert stats.chisquare(counts, chances * d.size).pvalue > 1e-3


def test_a_blackout_makes_the_age_grow_by_one_per_sample() -> None:
    job = over("delay=10ms,blackout=2510ms:300ms", "delay=10ms", samples=130)
    d = delays(job, 1)[0]
    passed = [k for k in range(130) if not 2510 <= 25 * k < 2810 and not 2510 <= 25 * k + 10 < 2810]
    expected = [k - max((j for j in passed if j < k), default=-1) for k in range(130)]
    assert d.tolist() == expected
    assert d.max() == 14


SENT = (27, 36, 24, 28)
"""Bytes of DELAY_K, ATTITUDE, AOA_SSA and VFR_HUD of a linear aircraft in MAVLink 2, zeros at their ends cut off."""


def queued(rate: int, limit: int, samples: int) -> list[int]:
    """Return d(k) where a queue of so much room is sent at so many bit/s, then takes 1 ms, and the way down 1 ms."""
    busy, exits, commands = 0, [], []  # busy in 1/rate ns
    for j in range(samples):
        now, whole = 25 * MS * j, []
        for size in SENT:
            if sum(at > now for at in exits) < limit:
                busy = max(busy, now * rate) + 8 * size * 10**9
                exits.append(-(-busy // rate) + MS)
                whole.append((size, exits[-1]))
        at = dict(whole)
        if 36 in at and 24 in at:
            commands.append((max(at[36], at[24]) + MS, j))
    return [min(127, k - max((j for at, j in commands if at <= 25 * MS * k), default=-1)) for k in range(samples)]


@pytest.mark.parametrize(
    ("rate", "limit"), [(16_000, 10_000), (57_600, 10_000), (36_000, 4), (30_000, 6), (36_000, 9), (30_000, 3)]
)
def test_what_waits_for_the_serialiser_comes_later_and_what_finds_no_room_never(rate: int, limit: int) -> None:
    job = over(f"delay=1ms,rate={rate}bps,limit={limit}", "delay=1ms", samples=150)
    assert delays(job, 1)[0].tolist() == queued(rate, limit, 150)


def test_where_nothing_comes_the_age_is_that_of_nothing_up_to_the_longest_that_can_be_flown() -> None:
    assert (delays(over("loss=1", None), 2) == np.minimum(np.arange(1, 401), 127)).all()


def test_damaged_messages_count_as_lost_and_copies_help() -> None:
    lost, hit, twice = (
        delays(over(None, f"delay=5ms,{word}"), 25)[:, 20::20]
        for word in ("loss=0.3", "corrupt=0.3:3", "loss=0.3,dup=1")
    )
    assert stats.ttest_ind(lost.ravel(), hit.ravel()).pvalue > 1e-3
    assert hit.mean() == pytest.approx(1.0 / 0.7, abs=0.1)
    assert twice.mean() == pytest.approx(1.0 / 0.7, abs=0.1)  # a packet is lost with its duplicate
    both = delays(over(None, "delay=5ms,corrupt=0.3:3,dup=1"), 25)[:, 20::20]
    assert both.mean() == pytest.approx(1.0 / 0.91, abs=0.06)  # but of two copies one may be whole


def jittered(rng: np.random.Generator, halves: int, samples: int, Ts_ms: float, sending_ms: float) -> Integers:
    """Return d(k) of one flight over ways of 5 ms and uniform jitter, where packets overtake; commands queue."""
    came = 5.0 + Ts_ms * np.arange(samples) + rng.uniform(0.0, 70.0, (halves, samples)).max(axis=0)
    busy, arrives = 0.0, []
    for j in range(samples):
        if (came[j + 1 :] > came[j]).all():  # a state that was overtaken is not answered
            busy = max(busy, came[j]) + sending_ms
            arrives.append((busy + 5.0 + rng.uniform(0.0, 50.0), j))
    return np.array([k - max((j for at, j in arrives if at <= Ts_ms * k), default=-1) for k in range(samples)])


@pytest.mark.parametrize(
    ("gains", "halves", "rate"),
    [("hirm-paper", 2, None), ("pendulum-paper", 1, None), ("hirm-paper", 2, 5500)],
    ids=["two messages", "one message", "slow commands"],
)
def test_jitter_that_lets_packets_overtake_gives_the_delays_of_a_plain_simulation(
    gains: str, halves: int, rate: int | None
) -> None:
    slow = "" if rate is None else f",rate={rate}bps"
    job = over("delay=5ms,jitter=uniform:70ms", f"delay=5ms,jitter=uniform:50ms{slow}", gains, samples=100)
    rng = np.random.default_rng(3)
    sending_ms = 0.0 if rate is None else 160e3 / rate  # 20 bytes
    plain = np.array([jittered(rng, halves, 100, 1e3 * job.plant.Ts, sending_ms) for _ in range(150)])
    sampled = delays(job, 150)
    assert (np.diff(sampled, axis=1) <= 1).all()
    assert (np.diff(sampled, axis=1) < -1).any()
    for some in (slice(10, None, 12), slice(4, 5), slice(7, 8)):
        table = np.array([np.bincount(np.minimum(d[:, some], 9).ravel(), minlength=10) for d in (sampled, plain)])
        table = table[:, table.sum(axis=0) > 10]
        assert table.shape[1] > 1
        assert stats.chi2_contingency(table).pvalue > 1e-3


# -- flights


def test_a_flight_over_a_link_is_the_same_in_any_range_and_unlike_the_others() -> None:
    job = over("delay=5ms,jitter=gamma:20ms,loss=0.1", "delay=5ms,jitter=gamma:10ms", samples=120)
    whole = delays(job, 40, 2**40)
    assert np.array_equal(delays(job, 3, 2**40 + 31), whole[31:34])
    assert delays_of(job, 2**40 + 5) == tuple(whole[5])
    assert len({tuple(row) for row in whole}) == 40
    assert not np.array_equal(delays(replace(job, seed=2), 40, 2**40), whole)


def test_turning_loss_on_leaves_the_jitter_as_it_is() -> None:
    """What still comes comes when it came before: no delay is shorter."""
    free, lossy = (delays(over(f"delay=5ms,jitter=uniform:70ms{loss}", "delay=5ms"), 10) for loss in ("", ",loss=0.05"))
    assert (lossy >= free).all()
    assert (lossy == free).mean() > 0.75


def test_the_columns_tell_the_delays_that_were_flown() -> None:
    job = over("delay=5ms,jitter=gamma:30ms,loss=0.1", "delay=5ms,jitter=gamma:10ms")
    assert not is_compiled(job)
    d, columns = delays(job, 20, 30), fly(job, 30, 50)
    assert columns["d_mean"] == pytest.approx(d.mean(axis=1), rel=1e-14)
    assert np.array_equal(columns["d_max"], d.max(axis=1))
    assert columns["outside"] == pytest.approx(((d < 1) | (d > 4)).mean(axis=1), rel=1e-14)
    assert np.array_equal(columns["changes"], [sum(a != b for a, b in pairwise(row)) for row in d.tolist()])
    flown = fly_range(job, 30, 50, d.astype(np.uint8))
    assert all(np.array_equal(columns[name], flown[name], equal_nan=columns[name].dtype.kind == "f") for name in flown)


# -- the same link in the MAVLink flight


def flown_delays(job: Campaign, scenario: str, seed: int) -> Integers:
    """Return d(k) as the plant of a MAVLink flight in virtual time tells it; nothing held is k + 1 samples old."""
    assert job.link is not None
    recorder = FlightRecorder(None, {})
    flight = replace(
        load_scenario(scenario),
        up=job.link[0],
        down=job.link[1],
        seed=seed,
        failsafe="monitor",
        checks=(),
        duration_s=job.samples * job.plant.Ts,
    )
    fly_virtual(flight, recorder.write)
    truth = [body for topic, _, body in recorder.kept if topic == "plant/truth"]
    assert len(truth) == job.samples
    return np.array([body["k"] + 1 if body["d"] is None else body["d"] for body in truth])


@pytest.mark.parametrize(
    ("gains", "scenario", "up", "down"),
    [
        ("hirm-paper", "nominal", None, None),
        ("hirm-paper", "nominal", "delay=12ms", "delay=12ms"),
        ("hirm-paper", "nominal", "delay=31ms", "delay=14ms"),
        ("hirm-paper", "nominal", "delay=1ms", "delay=64ms"),
        ("hirm-paper", "nominal", "delay=20ms,rate=80kbps", "delay=1ms"),
        ("pendulum-paper", "pendulum", "delay=40ms", "delay=35ms"),
    ],
)
def test_over_a_link_without_chance_the_mavlink_flight_has_the_same_delays(
    gains: str, scenario: str, up: str | None, down: str | None
) -> None:
    job = over(up, down, gains, samples=200)
    flown = flown_delays(job, scenario, 1)
    assert np.array_equal(flown, delays(job, 1)[0]), flown


LONG = pytest.mark.long


LOSSY = ("delay=8ms,loss=0.2", "delay=8ms,loss=0.1")
JITTERY = ("delay=5ms,jitter=uniform:70ms", "delay=5ms,jitter=gamma:10ms")
BURSTS = ("delay=9ms,jitter=gamma:15ms,corr=0.5", "delay=5ms,loss=ge:0.05:0.3,order=keep")
OVERTAKING = ("delay=5ms,reorder=0.2,jitter=normal:20ms,dup=0.2", "delay=2ms,corrupt=0.1")
BOTH = ("delay=5ms,jitter=uniform:60ms,loss=0.2", "delay=5ms,loss=0.1")
NO = (None, None)


@pytest.mark.parametrize(
    ("gains", "scenario", "ways", "preset"),
    [
        ("hirm-paper", "nominal", LOSSY, None),
        pytest.param("hirm-paper", "nominal", JITTERY, None, marks=LONG),
        ("pendulum-paper", "pendulum", BOTH, None),
        pytest.param("hirm-paper", "nominal", BURSTS, None, marks=LONG),
        pytest.param("hirm-paper", "nominal", OVERTAKING, None, marks=LONG),
        pytest.param("hirm-paper", "nominal", NO, "jittery", marks=LONG),
        pytest.param("hirm-paper", "nominal", NO, "lossy", marks=LONG),
        pytest.param("hirm-paper", "nominal", NO, "leo", marks=LONG),
        pytest.param("hirm-paper", "nominal", NO, "5g", marks=LONG),
        pytest.param("pendulum-paper", "pendulum", NO, "lte-drone", marks=LONG),
    ],
)
def test_the_mavlink_flights_delays_are_distributed_as_the_campaigns(
    gains: str, scenario: str, ways: tuple[str | None, str | None], preset: str | None, request: pytest.FixtureRequest
) -> None:
    """Flights are independent, samples are not: means and shares of flights are compared, after the first second."""
    flights = 60 if request.node.get_closest_marker("long") else 12
    job = over(*ways, gains, preset)
    flown = np.array([flown_delays(job, scenario, seed) for seed in range(flights)])[:, 40:]
    sampled = delays(job, 3 * flights)[:, 40:]
    assert stats.ttest_ind(flown.mean(axis=1), sampled.mean(axis=1), equal_var=False).pvalue > 1e-3
    often = [d for d in range(1, 20) if (sampled == d).mean() > 0.02]
    assert len(often) > 1
    for d in often:
        shares = ((delay == d).mean(axis=1) for delay in (flown, sampled))
        assert stats.ttest_ind(*shares, equal_var=False).pvalue > 1e-3 / len(often), d
    tails = ((delay > max(often)).mean(axis=1) for delay in (flown, sampled))
    assert not math.isclose(flown.std(), 0.0)
    assert stats.mannwhitneyu(*tails).pvalue > 1e-3


@pytest.mark.long
def test_where_order_is_kept_the_traffic_that_is_left_out_moves_the_mean_by_little() -> None:
    """TIMESYNC and heartbeats make the commands behind them wait: 0.6 % of the delay over LTE."""
    job = over(None, None, preset="lte")
    flown = np.array([flown_delays(job, "nominal", seed) for seed in range(60)])[:, 40:]
    sampled = delays(job, 120)[:, 40:]
    assert 0.0 < flown.mean() / sampled.mean() - 1.0 < 0.012
