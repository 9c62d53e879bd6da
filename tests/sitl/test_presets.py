"""Links by name: each does what its sources say, and is told as text that gives it back."""

from __future__ import annotations

import itertools
import json
import re

import click.testing
import numpy as np
import pytest

from sitl.commands.links import links
from sitl.link.impairment import MAX_QUEUED, Fate, Impairment, LinkSpec
from sitl.link.presets import CATALOGUE, PRESETS, SOURCES, Quantity, parse_link, preset_table
from sitl.link.spec import parse_spec
from tests.sitl.links import MS, S

PACKETS = 20_000
PERIOD_NS = 25 * MS
MEASURED = [name for name, preset in CATALOGUE.items() if preset.claims]


def exits_ns(spec: LinkSpec, seed: int, entries_ns, size_bytes: int = 100) -> list[int | None]:
    """Return when each packet leaves; None if it is lost."""
    link = Impairment(spec, np.random.default_rng(seed))
    under_way: list[int] = []
    exits: list[int | None] = []
    for now_ns in entries_ns:
        if spec.limit < MAX_QUEUED:
            under_way = [exit_ns for exit_ns in under_way if exit_ns > now_ns]
        copy = link.step(size_bytes, now_ns, len(under_way))[0]
        exits.append(copy.exit_ns if copy.fate is Fate.DELIVERED else None)
        if copy.fate is Fate.DELIVERED and spec.limit < MAX_QUEUED:
            under_way.append(copy.exit_ns)
    return exits


def measured(name: str, seed: int) -> dict[Quantity, float]:
    """Return what a stream of packets, each answered at once, finds out of a link."""
    up, down = PRESETS[name]
    sent_ns = [n * PERIOD_NS for n in range(PACKETS)]
    met = sorted((at_ns, n) for n, at_ns in enumerate(exits_ns(up, seed, sent_ns)) if at_ns is not None)
    back = zip(met, exits_ns(down, seed + 1000, [at_ns for at_ns, _ in met]), strict=True)
    answered = sorted((n, at_ns, back_ns) for (at_ns, n), back_ns in back if back_ns is not None)
    rtt_ms = np.array([back_ns - sent_ns[n] for n, _, back_ns in answered]) / MS
    up_ms = np.array([at_ns - sent_ns[n] for at_ns, n in met]) / MS
    down_ms = np.array([back_ns - at_ns for _, at_ns, back_ns in answered]) / MS
    p50, p90, p99, p999 = np.quantile(rtt_ms, [0.5, 0.9, 0.99, 0.999])
    return {
        "rtt_min_ms": float(rtt_ms.min()),
        "rtt_mean_ms": float(rtt_ms.mean()),
        "rtt_p50_ms": float(p50),
        "rtt_p90_ms": float(p90),
        "rtt_p99_ms": float(p99),
        "rtt_spike_ms": float(p999 - p50),
        "rtt_step_ms": float(np.abs(np.diff(rtt_ms)).mean()),
        "up_above_down_ms": float(np.median(up_ms) - np.median(down_ms)),
        "up_within_50ms": float(np.count_nonzero(up_ms <= 50.0) / PACKETS),
        "rtt_loss": 1.0 - len(answered) / PACKETS,
    }


def missed(name: str, seed: int) -> list[str]:
    found = measured(name, seed)
    return [
        f"{c} found {found[c.quantity]}" for c in CATALOGUE[name].claims if not c.low <= found[c.quantity] <= c.high
    ]


@pytest.mark.parametrize("name", MEASURED)
def test_a_measured_link_does_what_its_sources_say(name):
    assert not missed(name, 1)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(2, 6))
@pytest.mark.parametrize("name", MEASURED)
def test_it_does_so_with_any_seed(name, seed):
    assert not missed(name, seed)


def test_the_links_made_up_for_tests_are_what_the_handbook_says():
    jittery = parse_spec("delay=5ms,jitter=uniform:28ms")
    assert PRESETS["perfect"] == (LinkSpec(), LinkSpec())
    assert PRESETS["lan"] == (parse_spec("delay=0.2ms"),) * 2
    assert PRESETS["jittery"] == (jittery, jittery)
    assert PRESETS["lossy"] == (parse_spec("delay=5ms,jitter=uniform:28ms,loss=0.03,dup=0.01"),) * 2


def test_every_claim_and_choice_names_a_source_and_every_source_is_named():
    for preset in CATALOGUE.values():
        assert all(re.search(r"\[[^]]+\]", claim.source) for claim in preset.claims)
        assert all(claim.low < claim.high for claim in preset.claims)
    text = " ".join(row.source + row.chosen for row in preset_table())
    assert set(re.findall(r"\[([^]]+)\]", text)) == set(SOURCES)


def test_the_text_of_a_preset_gives_its_link_back():
    assert [row.name for row in preset_table()] == list(PRESETS)
    for row in preset_table():
        assert parse_link(None, row.up, row.down) == parse_link(row.name, None, None)


def test_the_radio_is_half_duplex():
    size_bytes, air_ns = 28, 28 * 8 * S // 100_000
    on_air = []
    for seed, spec in enumerate(PRESETS["radio"]):
        exits = exits_ns(spec, seed, [n * 5 * MS for n in range(4000)], size_bytes)
        on_air += [
            (at_ns - spec.delay_ns - air_ns, at_ns - spec.delay_ns, seed) for at_ns in exits if at_ns is not None
        ]
    on_air.sort()
    assert {way for *_, way in on_air} == {0, 1}
    for (_, end_ns, _), (begin_ns, _, _) in itertools.pairwise(on_air):
        assert end_ns <= begin_ns


def test_the_radio_carries_four_messages_per_sample_up_and_one_down():
    up, down = PRESETS["radio"]
    sample = [n * PERIOD_NS for n in range(2000)]
    for spec, messages in ((up, 4), (down, 1)):
        entries = [at_ns for at_ns in sample for _ in range(messages)]
        delays_ms = [
            (x - e) / MS for e, x in zip(entries, exits_ns(spec, 1, entries, 28), strict=True) if x is not None
        ]
        assert len(delays_ms) / len(entries) == pytest.approx(0.99, abs=0.01)  # none refused
        assert max(delays_ms) < 35.0 + 70.4 + 12 * 2.24  # one round, and what waits with it


def test_the_command_lists_every_link_with_its_sources():
    text = click.testing.CliRunner().invoke(links)
    assert text.exit_code == 0
    for name, preset in CATALOGUE.items():
        assert f"{name}: {preset.title}" in text.output
    assert all(f"[{name}] {source}" in text.output for name, source in SOURCES.items())
    table = json.loads(click.testing.CliRunner().invoke(links, ["--json"]).output)
    assert table["sources"] == dict(SOURCES)
    assert {name: (parse_spec(row["up"]), parse_spec(row["down"])) for name, row in table["presets"].items()} == PRESETS
