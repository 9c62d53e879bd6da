"""Links as text: what is read, what is refused, and that writing is the inverse of reading."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gains.table import InputError
from sitl.link.impairment import LinkSpec
from sitl.link.jitters import JITTERS, GammaJitter, NormalJitter, UniformJitter
from sitl.link.losses import GilbertElliott
from sitl.link.presets import PRESETS, parse_link
from sitl.link.spec import MAX_RATE_BPS, MAX_TIME_NS, format_spec, parse_spec
from tests.sitl.links import MS, S, flights_ns

# ---------------------------------------------------------------------------------------------- grammar


def test_the_spec_of_the_handbook_parses():
    text = "delay=25ms,jitter=uniform:28ms,loss=0.1,dup=0.01,reorder=0.05,order=keep,rate=57600bps,blackout=3s:2s"
    spec = LinkSpec(
        delay_ns=25 * MS,
        jitter=UniformJitter(28 * MS),
        loss=0.1,
        dup=0.01,
        reorder=0.05,
        keep_order=True,
        rate_bps=57_600,
        blackouts=((3 * S, 2 * S),),
    )
    assert parse_spec(text) == spec
    assert format_spec(spec) == text


@pytest.mark.parametrize(
    ("text", "delay_ns"),
    [
        ("0.2ms", 200_000),
        ("7ns", 7),
        ("1.5us", 1500),
        ("0.1s", 100 * MS),
        ("0s", 0),
        ("1000000s", MAX_TIME_NS),
    ],
)
def test_times_are_read_exactly_in_every_unit(text, delay_ns):
    assert parse_spec(f"delay={text}").delay_ns == delay_ns


@pytest.mark.parametrize(("text", "bps"), [("57600bps", 57_600), ("57.6kbps", 57_600), ("1.5Mbps", 1_500_000)])
def test_rates_are_read_exactly_in_every_unit(text, bps):
    assert parse_spec(f"rate={text}").rate_bps == bps


def test_spaces_around_items_are_ignored_and_blackouts_repeat():
    spec = parse_spec(" delay = 1ms , blackout=1s:1s, blackout=4s:500ms ")
    assert spec == LinkSpec(delay_ns=MS, blackouts=((S, S), (4 * S, S // 2)))


@pytest.mark.parametrize(
    ("text", "loss"),
    [
        ("ge:0.02:0.18", GilbertElliott(0.02, 0.18, bad=1.0, good=0.0)),
        ("ge:0.02:0.18:0.9", GilbertElliott(0.02, 0.18, bad=0.9, good=0.0)),
        ("ge:0.02:0.18:0.9:0.01", GilbertElliott(0.02, 0.18, bad=0.9, good=0.01)),
        ("ge:0.02:0.18:1.0:0.01", GilbertElliott(0.02, 0.18, good=0.01)),
        ("ge:0.0:0.0", GilbertElliott(0.0, 0.0)),
        ("ge:1.0:1.0:0.0:1.0", GilbertElliott(1.0, 1.0, 0.0, 1.0)),
    ],
)
def test_a_loss_model_is_its_name_and_parameters_without_trailing_defaults(text, loss):
    assert parse_spec(f"loss={text}") == LinkSpec(loss=loss)
    assert format_spec(LinkSpec(loss=loss)) == f"loss={text}"


TIME = "expected a time with its unit (s, ms, us, ns) up to 1000000s, found"
PROBABILITY = "expected a probability from 0 to 1, found"
LOSS = "loss: expected a probability from 0 to 1 or ge:P:R[:BAD[:GOOD]], found"
BURSTY = "loss: expected ge:P:R[:BAD[:GOOD]], each a probability from 0 to 1, found"
RATE = f"expected a rate above 0 with its unit (Mbps, kbps, bps) up to {MAX_RATE_BPS}bps, found"
JITTER = "expected one of uniform:…, normal:…, gamma:…, as in uniform:28ms, found"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("loss=2", f"{LOSS} 2"),
        ("loss=-0.1", f"{LOSS} -0.1"),
        ("loss=nan", f"{LOSS} nan"),
        ("loss=0_1", f"{LOSS} 0_1"),
        ("loss=٠.٥", f"{LOSS} ٠.٥"),
        ("loss=", f"{LOSS} nothing"),
        ("loss=0.1:0.2", f"{LOSS} 0.1:0.2"),
        ("loss=gilbert:0.1:0.2", f"{LOSS} gilbert:0.1:0.2"),
        ("loss=GE:0.1:0.2", f"{LOSS} GE:0.1:0.2"),
        ("loss=ge", f"{BURSTY} ge"),
        ("loss=ge:0.1", f"{BURSTY} ge:0.1"),
        ("loss=ge:0.1:", f"{BURSTY} ge:0.1:"),
        ("loss=ge:0.1:1.5", f"{BURSTY} ge:0.1:1.5"),
        ("loss=ge:-0.1:0.5", f"{BURSTY} ge:-0.1:0.5"),
        ("loss=ge:2%:18%", f"{BURSTY} ge:2%:18%"),
        ("loss=ge:0.1:0.2:nan", f"{BURSTY} ge:0.1:0.2:nan"),
        ("loss=ge:0.1:0.2:1:0:0", f"{BURSTY} ge:0.1:0.2:1:0:0"),
        ("loss=0.1,loss=ge:0.1:0.2", "loss: expected once, found again with ge:0.1:0.2"),
        ("dup=2", f"dup: {PROBABILITY} 2"),
        ("dup=many", f"dup: {PROBABILITY} many"),
        ("reorder=", f"reorder: {PROBABILITY} nothing"),
        ("delay=25", f"delay: {TIME} 25"),
        ("delay=-1ms", f"delay: {TIME} -1ms"),
        ("delay=25min", f"delay: {TIME} 25min"),
        ("delay=0.5ns", f"delay: {TIME} 0.5ns"),
        ("delay=1000001s", f"delay: {TIME} 1000001s"),
        ("delay=٣ms", f"delay: {TIME} ٣ms"),
        ("jitter=28ms", f"jitter: {JITTER} 28ms"),
        ("jitter=cauchy:3ms", f"jitter: {JITTER} cauchy:3ms"),
        ("jitter=normal:3", f"jitter: {TIME} normal:3"),
        ("order=lose", "order: expected keep, found lose"),
        ("rate=57600", f"rate: {RATE} 57600"),
        ("rate=0bps", f"rate: {RATE} 0bps"),
        ("rate=0.5bps", f"rate: {RATE} 0.5bps"),
        ("blackout=3s", "blackout: expected start:duration, as in 3s:2s, found 3s"),
        ("blackout=3s:2", f"blackout: {TIME} 3s:2"),
        ("delay=1ms,delay=2ms", "delay: expected once, found again with 2ms"),
        ("loss", "expected keyword=value, found loss"),
        ("", "expected keyword=value, found nothing"),
        ("loss=0.1,", "expected keyword=value, found nothing"),
        (
            "lag=3ms",
            "expected a keyword of delay, jitter, loss, dup, reorder, order, rate, blackout, found lag",
        ),
    ],
)
def test_a_bad_spec_is_refused_in_one_clear_line(text, message):
    with pytest.raises(InputError) as refusal:
        parse_spec(text)
    assert str(refusal.value) == f'link spec "{text}": {message}'


@given(st.text() | st.from_regex(r"(delay|jitter|loss|rate|blackout)=(ge:)?.*", fullmatch=True))
def test_any_text_is_a_spec_or_one_line_of_refusal(text):
    refusal = ""
    try:
        spec = parse_spec(text)
    except InputError as error:
        refusal = str(error)
    else:
        assert parse_spec(format_spec(spec)) == spec
    assert len(refusal.splitlines()) <= 1


times = st.integers(0, MAX_TIME_NS) | st.integers(0, 1000).map(lambda ms: ms * MS)
probabilities = st.floats(0, 1)
specs = st.builds(
    LinkSpec,
    delay_ns=times,
    jitter=st.none() | st.builds(lambda model, scale: model(scale), st.sampled_from(list(JITTERS.values())), times),
    loss=probabilities
    | st.builds(
        GilbertElliott, probabilities, probabilities, st.just(1.0) | probabilities, st.just(0.0) | probabilities
    ),
    dup=probabilities,
    reorder=probabilities,
    keep_order=st.booleans(),
    rate_bps=st.none() | st.integers(1, MAX_RATE_BPS),
    blackouts=st.lists(st.tuples(times, times), max_size=3).map(tuple),
)


@given(specs)
def test_parse_is_the_inverse_of_format(spec):
    assert parse_spec(format_spec(spec)) == spec


def test_the_format_is_the_shortest_in_whole_units():
    assert format_spec(LinkSpec()) == "delay=0ns"
    assert format_spec(LinkSpec(delay_ns=200_000)) == "delay=200us"
    assert format_spec(LinkSpec(jitter=NormalJitter(4 * MS), rate_bps=10**6)) == "jitter=normal:4ms,rate=1Mbps"
    assert format_spec(LinkSpec(jitter=GammaJitter(1))) == "jitter=gamma:1ns"


# ---------------------------------------------------------------------------------------------- presets


def test_presets_are_what_the_handbook_says():
    assert set(PRESETS) == {"perfect", "lan", "jittery", "lossy"}
    jittery = parse_spec("delay=5ms,jitter=uniform:28ms")
    assert PRESETS["perfect"] == (LinkSpec(), LinkSpec())
    assert PRESETS["lan"] == (parse_spec("delay=0.2ms"),) * 2
    assert PRESETS["jittery"] == (jittery, jittery)
    assert PRESETS["lossy"] == (replace(jittery, loss=0.03, dup=0.01),) * 2


def test_a_loop_over_the_jittery_link_spans_1_to_3_samples_of_25_ms():
    up, down = (flights_ns(format_spec(spec), seed) for seed, spec in enumerate(PRESETS["jittery"]))
    samples = np.ceil((up + down) / (25 * MS))
    assert set(samples.tolist()) == {1.0, 2.0, 3.0}


def test_up_and_down_take_the_place_of_the_preset():
    lan = PRESETS["lan"][0]
    assert parse_link(None, None, None) == PRESETS["perfect"]
    assert parse_link("lan", None, None) == PRESETS["lan"]
    assert parse_link("lan", "loss=0.5", None) == (LinkSpec(loss=0.5), lan)
    assert parse_link("lan", None, "loss=0.5") == (lan, LinkSpec(loss=0.5))
    assert parse_link(None, "delay=1s", "loss=0.5") == (LinkSpec(delay_ns=S), LinkSpec(loss=0.5))


def test_an_unknown_preset_is_refused_with_the_known_ones():
    with pytest.raises(InputError) as refusal:
        parse_link("moon", None, None)
    assert str(refusal.value) == "link preset: expected one of perfect, lan, jittery, lossy, found moon"
