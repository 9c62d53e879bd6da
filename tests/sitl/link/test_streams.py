"""Random streams: the same seed gives the same link, and no feature changes what another one draws."""

from __future__ import annotations

import itertools
import math
from collections import Counter

import numpy as np
import pytest

from sitl.link.impairment import Fate, Impairment
from sitl.link.relay import RelayNode
from sitl.link.spec import parse_spec
from tests.sitl.links import MS, SAMPLES, S, impairment


def losses(text: str, packets: int = SAMPLES, seed: int = 1) -> np.ndarray:
    """Return which packets are lost."""
    link = impairment(text, seed)
    return np.array([not link.schedule(100, n) for n in range(packets)])


EVERYTHING = (
    "delay=5ms,jitter=gamma:28ms:3.0,corr=0.5,loss=corr:0.1:0.5,dup=0.1,reorder=0.1,gap=3,corrupt=0.1:2,"
    "rate=1Mbps,limit=50,slot=2ms:3,blackout=100ms:20ms:300ms,hold=50ms:5ms:100ms,handover=300ms:20ms,"
    "fade=100ms:50ms:10ms:0.2"
)


@pytest.mark.parametrize(
    "text",
    [
        "delay=5ms,jitter=gamma:28ms,loss=0.1,dup=0.1,reorder=0.1",
        "delay=5ms,jitter=gamma:28ms,loss=ge:0.02:0.18:0.9:0.01,dup=0.1,reorder=0.1",
        EVERYTHING,
        EVERYTHING.replace("corr:0.1:0.5", "state:0.1:0.5").replace("gamma:28ms:3.0", "paretonormal:28ms"),
    ],
)
def test_same_seed_gives_the_same_packets_and_another_seed_others(text):
    one, same, other = (
        [link.step(60, n * MS, n % 60) for n in range(1000)]
        for link in (impairment(text, 7), impairment(text, 7), impairment(text, 8))
    )
    assert one == same
    assert one != other


class Streams:
    """Stands for a generator and those spawned from it: counts the numbers drawn from each, by its place."""

    def __init__(self, rng: np.random.Generator, drawn: Counter[str], place: str = "") -> None:
        self._rng, self._drawn, self._place, self._spawned = rng, drawn, place, 0

    def spawn(self, n: int) -> list[Streams]:
        first, self._spawned = self._spawned, self._spawned + n
        # what a stream spawns further is the same feature's
        places = [self._place or str(first + child) for child in range(n)]
        return [Streams(rng, self._drawn, place) for rng, place in zip(self._rng.spawn(n), places, strict=True)]

    def __getattr__(self, name: str):
        method = getattr(self._rng, name)

        def draw(*args):
            value = method(*args)
            self._drawn[self._place] += np.size(value)
            return value

        return draw


FEATURES = {
    "loss": "loss=0.3",
    "bursts": "loss=ge:0.1:0.3",
    "correlated loss": "loss=corr:0.3:0.5",
    "four states": "loss=state:0.2:0.3",
    "jitter": "jitter=uniform:9ms",
    "correlated jitter": "jitter=uniform:9ms,corr=0.5",
    "dup": "dup=0.3",
    "reorder": "reorder=0.3,gap=2",
    "corrupt": "corrupt=0.3:2",
    "fade": "fade=20ms:20ms:5ms:0.5",
    "handover": "handover=30ms:10ms",
    "delay": "delay=7ms",
    "order": "order=keep",
    "rate": "rate=100kbps",
    "limit": "limit=3",
    "slot": "slot=5ms:2",
    "blackout": "blackout=10ms:20ms:50ms",
    "hold": "hold=20ms:10ms:40ms",
}
IN_TIME = {"8", "10"}
"""The streams of the radio's times and of handovers, from which time draws, not packets."""


def drawn_per_packet(*features: str) -> list[Counter[str]]:
    """Return how many numbers each stream has given after each packet, without those it began with."""
    drawn: Counter[str] = Counter()
    spec = parse_spec(",".join(FEATURES[feature] for feature in features))
    link = Impairment(spec, Streams(np.random.default_rng(1), drawn))
    drawn.clear()
    counts = []
    for n in range(120):
        link.step(50, n * MS, n % 5)
        counts.append(drawn.copy())
    return counts


def keywords(feature: str) -> set[str]:
    return {item.partition("=")[0] for item in FEATURES[feature].split(",")}


def test_no_feature_changes_how_many_numbers_another_draws_for_each_packet():
    alone = {feature: drawn_per_packet(feature) for feature in FEATURES}
    pairs = [(a, b) for a, b in itertools.combinations(FEATURES, 2) if not keywords(a) & keywords(b)]
    assert len(pairs) > 140
    for a, b in pairs:
        for n, both in enumerate(drawn_per_packet(a, b)):
            # also the loss of nothing draws, and one with memory more
            assert both["0"] == max(alone[a][n]["0"], alone[b][n]["0"])
            for feature in (a, b):
                for stream in set(alone[feature][n]) - IN_TIME - {"0"}:
                    assert both[stream] == alone[feature][n][stream], (a, b, n, stream)


def test_features_draw_from_streams_of_their_own():
    streams = {feature: set(drawn_per_packet(feature)[-1]) - {"0"} for feature in FEATURES}
    drawing = {feature for feature in FEATURES if streams[feature]}
    assert drawing == {"jitter", "correlated jitter", "dup", "reorder", "corrupt", "fade", "handover"}
    assert streams["jitter"] == streams["correlated jitter"]
    for a, b in itertools.combinations(drawing - {"jitter"}, 2):
        assert not streams[a] & streams[b]


def test_a_second_copy_draws_from_streams_of_its_own():
    rest = ("jitter", "reorder", "corrupt")
    once, twice = (set(drawn_per_packet(*features)[-1]) for features in (rest, (*rest, "dup")))
    assert twice - once == {"1", "3", "5", "7"}


def test_the_second_copy_of_a_packet_is_the_same_at_any_rate_of_duplication():
    text = "delay=9ms,jitter=gamma:5ms,reorder=0.2,corrupt=0.3"
    links = [impairment(f"{text},dup={dup}") for dup in (0.2, 1)]
    seldom, always = ([link.step(60, n * S) for n in range(1000)] for link in links)
    assert 100 < sum(len(copies) == 2 for copies in seldom) < 300
    assert all(some == both[: len(some)] for some, both in zip(seldom, always, strict=True))


def test_a_radio_that_is_bad_more_often_loses_the_same_packets_and_more():
    links = [impairment(f"fade={times}:0ms:0.4") for times in ("30ms:30ms", "1ms:1000s")]
    lost, more = (np.array([link.step(60, n * MS)[0].fate is Fate.LOST for n in range(2000)]) for link in links)
    assert lost.sum() > 200
    assert more.sum() > 1.5 * lost.sum()
    assert (more >= lost)[100:].all()  # the second is bad from then on


def test_the_two_directions_draw_neither_jitter_nor_losses_in_common():
    packets = 5000
    spec = parse_spec("delay=1ms,jitter=gamma:100us,loss=0.2")
    relay = RelayNode(spec, spec, seed=1)
    flights = {"link/up": {}, "link/down": {}}
    for n in range(packets):
        relay.receive("plant", b"up", n * S)
        relay.receive("autopilot", b"down", n * S)
        while (due_ns := relay.next_deadline_ns()) is not None:
            relay.tick(due_ns)
    for record in relay.records():
        if record.topic in flights:
            body = record.body
            lost = body["delivered_ns"] is None
            flights[record.topic][body["number"]] = np.nan if lost else body["delivered_ns"] - body["sent_ns"]
    up, down = (np.array([flights[way][n] for n in range(1, packets + 1)]) for way in ("link/up", "link/down"))
    both = np.isfinite(up) & np.isfinite(down)
    assert abs(np.corrcoef(np.isfinite(up), np.isfinite(down))[0, 1]) < 4.0 / math.sqrt(packets)
    assert abs(np.corrcoef(up[both], down[both])[0, 1]) < 4.0 / math.sqrt(both.sum())


@pytest.mark.parametrize("jitter", ["uniform:28ms", "normal:4ms", "gamma:20ms"])
@pytest.mark.parametrize("added", ["loss=0.2", "loss=ge:0.05:0.2", "dup=0.5", "reorder=0.1", "blackout=2s:3s"])
def test_adding_a_feature_leaves_the_jitter_of_each_packet_as_it_was(jitter, added):
    base = f"delay=40ms,jitter={jitter}"
    plain, impaired = impairment(base), impairment(f"{base},{added}")
    kept = 0
    for entry in range(0, 10 * S, 10 * MS):
        (expected,), found = plain.schedule(60, entry), impaired.schedule(60, entry)
        kept += bool(found) and found[0] == expected
        assert not found or found[0] in (expected, entry)  # entry: it overtook
    assert 500 < kept < 1000 or (added.startswith("dup") and kept == 1000)


@pytest.mark.parametrize(
    ("low", "high"),
    [
        ("0.1", "0.3"),
        ("ge:0.02:0.2", "ge:0.05:0.2"),  # more bursts
        ("ge:0.02:0.2", "ge:0.02:0.1"),  # longer ones
        ("ge:0.02:0.2:0.5", "ge:0.02:0.2:0.7:0.1"),  # the same, with more loss
    ],
)
def test_packets_lost_at_a_low_rate_are_lost_at_a_high_rate(low, high):
    at_low, at_high = losses(f"loss={low}", 5000), losses(f"loss={high}", 5000)
    assert (at_high >= at_low).all()
    assert at_high.sum() > at_low.sum() > 100


@pytest.mark.parametrize(
    "added", ["delay=5ms", "dup=0.3", "reorder=0.1", "jitter=gamma:1ms", "rate=9600bps,order=keep"]
)
def test_adding_a_feature_leaves_the_bursts_as_they_were(added):
    bursty = "loss=ge:0.02:0.18:0.9:0.01"
    assert (losses(bursty, 5000) == losses(f"{bursty},{added}", 5000)).all()


def test_a_blackout_leaves_the_bursts_after_it_as_they_were():
    plain, out = impairment("loss=ge:0.05:0.2"), impairment("loss=ge:0.05:0.2,blackout=1s:1s")
    fates = [(plain.step(60, n * MS)[0].fate, out.step(60, n * MS)[0].fate) for n in range(3000)]
    assert fates[:1000] + fates[2000:] == [(a, a) for a, _ in fates[:1000] + fates[2000:]]
    assert {fate for _, fate in fates[1000:2000]} == {Fate.LOST, Fate.BLACKOUT}


@pytest.mark.parametrize("loss", ["0.2", "ge:0.05:0.2"])
def test_entry_times_and_sizes_do_not_change_the_draws(loss):
    text = f"delay=5ms,jitter=uniform:28ms,loss={loss},dup=0.2"
    dense, sparse = impairment(text), impairment(text)
    for n in range(500):
        at_ns = n * S
        assert [t - n for t in dense.schedule(10, n)] == [t - at_ns for t in sparse.schedule(900, at_ns)]
