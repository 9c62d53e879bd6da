"""Links as text: what is read, what is refused, and that writing is the inverse of reading."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gains.table import InputError
from sitl.link.impairment import MAX_QUEUED, Corruption, LinkSpec
from sitl.link.interruptions import MIN_MEAN_NS, Fading, Handover, Slots, Window
from sitl.link.jitters import (
    JITTERS,
    GammaJitter,
    NormalJitter,
    ParetoJitter,
    ParetoNormalJitter,
    TableJitter,
    UniformJitter,
)
from sitl.link.losses import LOSSES, CorrelatedLoss, FourStateLoss, GilbertElliott
from sitl.link.presets import PRESETS, parse_link
from sitl.link.spec import _KEYWORDS, MAX_CORRUPT_BITS, MAX_RATE_BPS, MAX_TIME_NS, format_spec, parse_spec
from sitl.link.tracefiles import load_table, load_trace
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
        blackouts=(Window(3 * S, 2 * S),),
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
    assert spec == LinkSpec(delay_ns=MS, blackouts=(Window(S, S), Window(4 * S, S // 2)))


@pytest.mark.parametrize(
    ("text", "loss"),
    [
        ("ge:0.02:0.18", GilbertElliott(0.02, 0.18, bad=1.0, good=0.0)),
        ("ge:0.02:0.18:0.9", GilbertElliott(0.02, 0.18, bad=0.9, good=0.0)),
        ("ge:0.02:0.18:0.9:0.01", GilbertElliott(0.02, 0.18, bad=0.9, good=0.01)),
        ("ge:0.02:0.18:1.0:0.01", GilbertElliott(0.02, 0.18, good=0.01)),
        ("ge:0.0:0.0", GilbertElliott(0.0, 0.0)),
        ("ge:1.0:1.0:0.0:1.0", GilbertElliott(1.0, 1.0, 0.0, 1.0)),
        ("corr:0.1:0.5", CorrelatedLoss(0.1, 0.5)),
        ("state:0.1", FourStateLoss(0.1)),
        ("state:0.1:0.9", FourStateLoss(0.1, 0.9)),
        ("state:0.1:0.5:0.2:0.3", FourStateLoss(0.1, 0.5, 0.2, 0.3)),
        ("state:0.1:0.5:0.0:1.0:0.2", FourStateLoss(0.1, 0.5, p14=0.2)),
    ],
)
def test_a_loss_model_is_its_name_and_parameters_without_trailing_defaults(text, loss):
    assert parse_spec(f"loss={text}") == LinkSpec(loss=loss)
    assert format_spec(LinkSpec(loss=loss)) == f"loss={text}"


@pytest.mark.parametrize(
    ("text", "spec"),
    [
        ("jitter=gamma:2ms", LinkSpec(jitter=GammaJitter(2 * MS))),
        ("jitter=gamma:2ms:0.5", LinkSpec(jitter=GammaJitter(2 * MS, 0.5))),
        ("jitter=pareto:2ms", LinkSpec(jitter=ParetoJitter(2 * MS))),
        ("jitter=pareto:2ms:1.5", LinkSpec(jitter=ParetoJitter(2 * MS, 1.5))),
        ("jitter=paretonormal:2ms,corr=0.25", LinkSpec(jitter=ParetoNormalJitter(2 * MS), correlation=0.25)),
        ("reorder=0.1,gap=5", LinkSpec(reorder=0.1, gap=5)),
        ("reorder=0.0,gap=5", LinkSpec(gap=5)),
        ("corrupt=0.1", LinkSpec(corruption=Corruption(0.1))),
        ("corrupt=0.1:3", LinkSpec(corruption=Corruption(0.1, 3))),
        ("limit=1000", LinkSpec(limit=1000)),
        ("slot=20ms", LinkSpec(slots=Slots(20 * MS))),
        ("slot=20ms:4", LinkSpec(slots=Slots(20 * MS, 4))),
        ("blackout=3s:2s:10s", LinkSpec(blackouts=(Window(3 * S, 2 * S, 10 * S),))),
        ("hold=3s:20ms,hold=0s:1ms:1s", LinkSpec(holds=(Window(3 * S, 20 * MS), Window(0, MS, S)))),
        ("handover=20s:80ms", LinkSpec(handover=Handover(20 * S, 80 * MS))),
        ("fade=5s:500ms:80ms", LinkSpec(fading=Fading(5 * S, S // 2, 80 * MS))),
        ("fade=5s:500ms:80ms:0.05", LinkSpec(fading=Fading(5 * S, S // 2, 80 * MS, 0.05))),
    ],
)
def test_every_keyword_is_its_field_and_its_shortest_text(text, spec):
    assert parse_spec(text) == spec
    assert format_spec(spec) == text


TIME = "expected a time with its unit (s, ms, us, ns) up to 1000000s, found"
PROBABILITY = "expected a probability from 0 to 1, found"
MODELS = "ge:P:R[:BAD[:GOOD]], state:P13[:P31[:P32[:P23[:P14]]]]"
LOSS = f"loss: expected a probability from 0 to 1 or corr:P:RHO, {MODELS}, found"
BURSTY = "loss: expected ge:P:R[:BAD[:GOOD]], each a probability from 0 to 1, found"
STATES = "loss: expected state:P13[:P31[:P32[:P23[:P14]]]], each a probability from 0 to 1"
CORR = "loss: expected corr:P:RHO, each a probability from 0 to 1"
RATE = f"expected a rate above 0 with its unit (Mbps, kbps, bps) up to {MAX_RATE_BPS}bps, found"
JITTER = (
    "expected one of uniform:TIME, normal:TIME, gamma:TIME[:SHAPE], pareto:TIME[:SHAPE], paretonormal:TIME, "
    "table:FILE, as in uniform:28ms, found"
)
RHO = "corr: expected a correlation from 0 to below 1, found"
WINDOW = "expected START:LENGTH, as in 3s:2s, or START:LENGTH:EVERY with EVERY above LENGTH, found"
SLOT = "slot: expected PERIOD above 0, or PERIOD:PACKETS, as in 20ms:4, found"
PACKETS = "slot: expected a whole number from 1 to 1000000, found"
HANDOVER = "handover: expected EVERY:LENGTH with EVERY at least 1ms, as in 20s:80ms, found"
FADE = "fade: expected GOOD:BAD:EXTRA[:LOSS], three times, the first two at least 1ms, as in 5s:500ms:80ms:0.05, found"


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
        ("loss=corr:0.1", f"{CORR}, found corr:0.1"),
        ("loss=corr:0.1:1", f"{CORR}, RHO below 1, found corr:0.1:1"),
        ("loss=corr:0.1:0.5:0", f"{CORR}, found corr:0.1:0.5:0"),
        ("loss=state", f"{STATES}, found state"),
        ("loss=state:0.1:0.1:0.1:0.1:0.1:0.1", f"{STATES}, found state:0.1:0.1:0.1:0.1:0.1:0.1"),
        ("loss=state:0.1:0.6:0.6", f"{STATES}, P13 + P14 and P31 + P32 at most 1, found state:0.1:0.6:0.6"),
        (
            "loss=state:0.6:0.1:0:1:0.6",
            f"{STATES}, P13 + P14 and P31 + P32 at most 1, found state:0.6:0.1:0:1:0.6",
        ),
        ("jitter=", f"jitter: {JITTER} nothing"),
        ("jitter=uniform", f"jitter: {JITTER} uniform"),
        ("jitter=uniform:1ms:2", "jitter: expected uniform:TIME, found uniform:1ms:2"),
        ("jitter=gamma:1ms:", "jitter: expected gamma:TIME[:SHAPE] with a shape from 0.01 to 1000, found gamma:1ms:"),
        ("jitter=gamma:1ms:0", "jitter: expected gamma:TIME[:SHAPE] with a shape from 0.01 to 1000, found gamma:1ms:0"),
        (
            "jitter=pareto:1ms:1",
            "jitter: expected pareto:TIME[:SHAPE] with a shape from 1.01 to 1000, found pareto:1ms:1",
        ),
        (
            "jitter=pareto:1ms:2:3",
            "jitter: expected pareto:TIME[:SHAPE] with a shape from 1.01 to 1000, found pareto:1ms:2:3",
        ),
        (
            "jitter=pareto:1ms:nan",
            "jitter: expected pareto:TIME[:SHAPE] with a shape from 1.01 to 1000, found pareto:1ms:nan",
        ),
        ("jitter=normal:1ms,corr=1", f"{RHO} 1"),
        ("jitter=normal:1ms,corr=-0.1", f"{RHO} -0.1"),
        ("jitter=normal:1ms,corr=", f"{RHO} nothing"),
        ("corr=0.5", "corr: expected jitter=… beside it, found none"),
        ("gap=5", "gap: expected reorder=… beside it, found none"),
        ("reorder=0.1,gap=0", "gap: expected a whole number from 1 to 1000000, found 0"),
        ("reorder=0.1,gap=1.5", "gap: expected a whole number from 1 to 1000000, found 1.5"),
        ("reorder=0.1,gap=٣", "gap: expected a whole number from 1 to 1000000, found ٣"),
        ("corrupt=2", f"corrupt: {PROBABILITY} 2"),
        ("corrupt=0.1:", f"corrupt: expected a whole number from 1 to {MAX_CORRUPT_BITS}, found 0.1:"),
        ("corrupt=0.1:0", f"corrupt: expected a whole number from 1 to {MAX_CORRUPT_BITS}, found 0.1:0"),
        ("limit=0", f"limit: expected a whole number from 1 to {MAX_QUEUED}, found 0"),
        ("limit=many", f"limit: expected a whole number from 1 to {MAX_QUEUED}, found many"),
        (f"limit={MAX_QUEUED + 1}", f"limit: expected a whole number from 1 to {MAX_QUEUED}, found {MAX_QUEUED + 1}"),
        ("slot=0ms", f"{SLOT} 0ms"),
        ("slot=4", f"slot: {TIME} 4"),
        ("slot=20ms:0", f"{PACKETS} 20ms:0"),
        ("slot=20ms:1000001", f"{PACKETS} 20ms:1000001"),
        ("blackout=3s", f"blackout: {WINDOW} 3s"),
        ("blackout=3s:2", f"blackout: {WINDOW} 3s:2"),
        ("blackout=3s:2s:2s", f"blackout: {WINDOW} 3s:2s:2s"),
        ("blackout=3s:2s:0s", f"blackout: {WINDOW} 3s:2s:0s"),
        ("hold=3s", f"hold: {WINDOW} 3s"),
        ("hold=1s:1s,hold=3s:1s:5s:1s", f"hold: {WINDOW} 3s:1s:5s:1s"),
        ("handover=20s", f"{HANDOVER} 20s"),
        ("handover=0s:80ms", f"{HANDOVER} 0s:80ms"),
        ("handover=999us:80ms", f"{HANDOVER} 999us:80ms"),
        ("fade=5s:500ms", f"{FADE} 5s:500ms"),
        ("fade=0s:500ms:80ms", f"{FADE} 0s:500ms:80ms"),
        ("fade=5s:999999ns:80ms", f"{FADE} 5s:999999ns:80ms"),
        ("fade=5s:500ms:80ms:2", f"{FADE} 5s:500ms:80ms:2"),
        ("fade=5s:500ms:80ms:", f"{FADE} 5s:500ms:80ms:"),
        ("fade=5s:500ms:80ms:0.1:0.1", f"{FADE} 5s:500ms:80ms:0.1:0.1"),
        ("order=", "order: expected keep, found nothing"),
        ("delay=1ms,delay=2ms", "delay: expected once, found again with 2ms"),
        ("loss", "expected keyword=value, found loss"),
        ("", "expected keyword=value, found nothing"),
        ("loss=0.1,", "expected keyword=value, found nothing"),
        (
            "lag=3ms",
            "expected a keyword of delay, jitter, corr, loss, dup, reorder, gap, corrupt, order, rate, limit, slot, "
            "blackout, hold, handover, fade, trace, found lag",
        ),
    ],
)
def test_a_bad_spec_is_refused_in_one_clear_line(text, message):
    with pytest.raises(InputError) as refusal:
        parse_spec(text)
    assert str(refusal.value) == f'link spec "{text}": {message}'


@pytest.mark.parametrize("text", ["trace=", "trace=no/such/file", "jitter=table:", "jitter=table:no/such/file"])
def test_a_file_that_is_not_there_is_refused_in_one_line(text):
    with pytest.raises(InputError) as refusal:
        parse_spec(text)
    assert len(str(refusal.value).splitlines()) == 1


values = st.lists(
    st.sampled_from(
        [*JITTERS, *LOSSES, "keep", "0", "1", "0.5", "1e-3", "-1", "nan", "inf", "1ms", "20s", "0ns", "9kbps", ""]
    )
    | st.text(max_size=4),
    max_size=6,
).map(":".join)
almost = st.lists(st.tuples(st.sampled_from(sorted(set(_KEYWORDS) - {"trace"})), values), min_size=1, max_size=5).map(
    lambda items: ",".join(f"{name}={value}" for name, value in items)
)


@settings(max_examples=300)
@given(st.text() | almost)
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
means = st.integers(MIN_MEAN_NS, MAX_TIME_NS)
probabilities = st.floats(0, 1)
below_1 = st.floats(0, 1, exclude_max=True)
once = st.builds(Window, times, times, st.just(0))
repeated = st.builds(lambda start, length, gap: Window(start, length, length + gap), times, means, means).filter(
    lambda window: window.every_ns <= MAX_TIME_NS
)
windows = st.lists(once | repeated, max_size=3).map(tuple)
halves = st.floats(0, 0.5)
losses = {
    float: probabilities,
    CorrelatedLoss: st.builds(CorrelatedLoss, probabilities, below_1),
    GilbertElliott: st.builds(
        GilbertElliott, probabilities, probabilities, st.just(1.0) | probabilities, st.just(0.0) | probabilities
    ),
    FourStateLoss: st.builds(FourStateLoss, probabilities)
    | st.builds(FourStateLoss, halves, halves, halves, probabilities, halves),
}
jitters = {
    **{model: st.builds(model, times) for model in (UniformJitter, NormalJitter, ParetoNormalJitter)},
    GammaJitter: st.builds(GammaJitter, times, st.just(2.0) | st.floats(0.01, 1000.0)),
    ParetoJitter: st.builds(ParetoJitter, times, st.just(3.0) | st.floats(1.01, 1000.0)),
}


@pytest.fixture(scope="module")
def fields(tmp_path_factory) -> dict[str, st.SearchStrategy]:
    """Return a strategy for each field of a spec, by its name; traces and tables are files."""
    folder = tmp_path_factory.mktemp("links")
    delays, both_ways, table = (folder / name for name in ("delays.csv", "both ways.csv", "table"))
    delays.write_text("delay_ms\n1.5\n2\n40\n")
    both_ways.write_text("t_s,up_ms,down_ms\n0,1,2\n1,lost,3\n")
    table.write_text("3\n1\n2.5\n")
    traces = [load_trace(str(delays)), load_trace(f"{both_ways}#up"), load_trace(f"{both_ways}#down")]
    return {
        "delay_ns": times,
        "jitter": st.one_of(*jitters.values()) | st.just(TableJitter(str(table), load_table(str(table)))),
        "correlation": below_1,
        "loss": st.one_of(*losses.values()),
        "dup": probabilities,
        "reorder": probabilities,
        "gap": st.integers(1, 1_000_000),
        "corruption": st.builds(Corruption, probabilities, st.integers(1, MAX_CORRUPT_BITS)),
        "keep_order": st.booleans(),
        "rate_bps": st.integers(1, MAX_RATE_BPS),
        "limit": st.integers(1, MAX_QUEUED),
        "slots": st.builds(Slots, st.integers(1, MAX_TIME_NS), st.integers(0, 1_000_000)),
        "blackouts": windows,
        "holds": windows,
        "handover": st.builds(Handover, means, times),
        "fading": st.builds(Fading, means, means, times, probabilities),
        "trace": st.sampled_from(traces),
    }


def test_every_field_and_model_is_in_the_specs_that_are_tried(fields):
    assert set(fields) == {field.name for field in dataclasses.fields(LinkSpec)}
    assert {*losses} - {float} == set(LOSSES.values())
    assert {*jitters, TableJitter} == set(JITTERS.values())


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_parse_is_the_inverse_of_format(fields, data):
    chosen = data.draw(st.fixed_dictionaries({}, optional=fields))
    if "jitter" not in chosen:
        chosen.pop("correlation", None)
    spec = LinkSpec(**chosen)
    assert parse_spec(format_spec(spec)) == spec


def test_a_correlation_without_jitter_is_no_spec():
    with pytest.raises(AssertionError):
        LinkSpec(correlation=0.5)


def test_the_format_is_the_shortest_in_whole_units():
    assert format_spec(LinkSpec()) == "delay=0ns"
    assert format_spec(LinkSpec(delay_ns=200_000)) == "delay=200us"
    assert format_spec(LinkSpec(jitter=NormalJitter(4 * MS), rate_bps=10**6)) == "jitter=normal:4ms,rate=1Mbps"
    assert format_spec(LinkSpec(jitter=GammaJitter(1))) == "jitter=gamma:1ns"


# ---------------------------------------------------------------------------------------------- presets


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
    assert str(refusal.value) == f"link preset: expected one of {', '.join(PRESETS)}, found moon"
