"""Programmed sources of r, as text says."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autopilot.profile import Profile, Sampled, Shifted, Sine, parse_profile
from gains.table import InputError

TS = 0.025
FIVE = math.radians(5.0)
quick = settings(deadline=None)
values = st.floats(-1.0, 1.0)
SWITCHES = st.dictionaries(st.integers(0, 60), values, max_size=6).map(lambda d: Profile(tuple(sorted(d.items()))))
SINES = st.builds(Sine, values, st.floats(0.1, 10.0), st.floats(0.0, 1.0), st.just(TS), st.none() | st.floats(0.1, 1.0))
SAMPLED = st.dictionaries(st.integers(0, 60), values).map(
    lambda d: Sampled(tuple(sorted(d)), tuple(d[k] for k in sorted(d)))
)
PROGRAMMED = SWITCHES | SINES | SAMPLED | st.builds(Shifted, SWITCHES | SINES, st.integers(0, 30))


def r_of(text: str, samples: int = 800) -> np.ndarray:
    source = parse_profile(text, TS)
    return np.array([source.r(k) for k in range(samples)])


# the text


@pytest.mark.parametrize(
    ("text", "switches"),
    [
        ("", ()),
        (" , ", ()),
        ("5deg@1s", ((40, math.radians(5.0)),)),
        ("5deg@1s,0deg@6s", ((40, math.radians(5.0)), (240, 0.0))),
        (" 5deg@1s , -2.5deg@2s ", ((40, math.radians(5.0)), (80, math.radians(-2.5)))),
        ("0.1rad@0s", ((0, 0.1),)),
        ("1@0.075s", ((3, 1.0),)),
        ("1@0.0751s", ((4, 1.0),)),
        ("+1e-1@1e1s", ((400, 0.1),)),
    ],
)
def test_profiles_are_read(text, switches):
    assert parse_profile(text, 0.025).switches == switches


@pytest.mark.parametrize(
    "text",
    [
        "5",
        "5deg",
        "5deg@",
        "5deg@1",
        "@1s",
        "deg@1s",
        "5grad@1s",
        "5deg@-1s",
        "5deg@1s;0deg@2s",
        "nan@1s",
        "inf@1s",
        "1e999@1s",
        "1@1e999s",
        "1-1@1s",
        "5deg@1s,x",
        "5 deg@1s",
    ],
)
def test_what_is_no_profile_is_refused(text):
    with pytest.raises(InputError, match=r'reference ".*": expected VALUE@TIMEs such as 5deg@1s, found'):
        parse_profile(text, 0.025)


@pytest.mark.parametrize("text", ["1@2s,2@1s", "1@1s,2@1s", "1@1.001s,2@1.002s"])
def test_times_must_rise(text):
    with pytest.raises(InputError, match="expected rising times"):
        parse_profile(text, 0.025)


@quick
@given(st.integers(0, 3_000_000), st.sampled_from([0.004, 0.02, 0.025, 0.03, 1 / 30]))
def test_a_switch_at_a_samples_own_time_is_that_sample(k, Ts):
    assert parse_profile(f"1@{k * Ts!r}s", Ts).switches == ((k, 1.0),)


def test_a_named_step_is_the_step():
    assert parse_profile("step:5deg@1s", TS) == parse_profile("5deg@1s", TS) == Profile(((40, FIVE),))


def test_a_doublet_goes_up_then_down_and_sums_to_zero():
    r = r_of("doublet:5deg@1s:2s")
    np.testing.assert_array_equal(r, np.repeat([0.0, FIVE, -FIVE, 0.0], [40, 80, 80, 600]))
    assert math.fsum(r) == 0.0


def test_a_3211_lasts_3_2_1_1_units_with_alternating_sign():
    edges = np.array([start for start, _ in parse_profile("3211:-2deg@1s:0.5s", TS).switches])
    np.testing.assert_array_equal(edges, 40 + 20 * np.array([0, 3, 5, 6, 7]))
    r = r_of("3211:-2deg@1s:0.5s")[edges]
    np.testing.assert_allclose(r, np.radians([-2.0, 2.0, -2.0, 2.0, 0.0]), rtol=1e-15)


@pytest.mark.parametrize(("duration", "end"), [("", 800), (":4s", 200)])
def test_a_sine_is_numpys_at_the_sample_times(duration, end):
    t = np.arange(800) * TS
    truth = np.where((t >= 1.0) & (np.arange(800) < end), FIVE * np.sin(2 * np.pi * 0.7 * (t - 1.0)), 0.0)
    np.testing.assert_allclose(r_of(f"sine:5deg@1s:0.7Hz{duration}"), truth, atol=1e-14)


def test_every_change_takes_effect_at_the_first_sample_not_before_its_time():
    assert [k for k, _ in parse_profile("doublet:1@0.0751s:0.05s", TS).switches] == [4, 6, 8]
    assert [k for k, _ in parse_profile("doublet:1@0.1s:0.6s", TS).switches] == [4, 28, 52]
    sine = parse_profile("sine:1@0.0751s:0.5Hz:0.1s", TS)
    assert (sine.start, sine.end) == (4, 8)
    first = math.sin(math.pi * (0.1 - 0.0751))
    assert (sine.r(3), sine.r(4), sine.r(8)) == (0.0, pytest.approx(first), 0.0)


def test_items_are_joined_and_may_touch():
    text = "1@1s, doublet:2@2s:1s, 3211:3@4s:1s, step:4@11s, 5@12s"
    assert parse_profile(text, 1.0).switches == (
        *((1, 1.0), (2, 2.0), (3, -2.0)),
        *((4, 3.0), (7, -3.0), (9, 3.0), (10, -3.0)),
        *((11, 4.0), (12, 5.0)),
    )


@pytest.mark.parametrize(
    "text",
    ["doublet:1@1s:2s,1@4s", "1@1s,doublet:1@1s:2s", "3211:1@1s:1s,doublet:1@7s:1s", "doublet:1@5s:1s,doublet:1@1s:1s"],
)
def test_items_must_not_overlap(text):
    with pytest.raises(InputError, match=r'reference ".*": expected rising times'):
        parse_profile(text, 1.0)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("ramp:5deg@1s", 'expected VALUE@TIMEs such as 5deg@1s, found "ramp:5deg@1s"'),
        ("5deg@1s:2s", "expected VALUE@TIMEs such as 5deg@1s"),
        ("step:5deg@1s:2s", "expected step:VALUE@TIMEs such as step:5deg@1s"),
        ("doublet:5deg@1s", "expected doublet:VALUE@TIMEs:WIDTHs such as doublet:5deg@1s:2s"),
        ("doublet:5deg@1s:2", "expected doublet:"),
        ("doublet:5deg@-1s:2s", "expected doublet:"),
        ("doublet:5deg@1s:1e999s", "expected doublet:"),
        ("doublet:5deg@1s:1e308s", "expected doublet:"),
        ("3211:5deg@1s:s", "expected 3211:VALUE@TIMEs:UNITs such as 3211:5deg@1s:0.5s"),
        ("sine:5deg@1s", "expected sine:VALUE@TIMEs:FREQUENCYHz"),
        ("sine:5deg@1s:0.5Hz:", "expected sine:"),
        ("sine:nan@1s:0.5Hz", "expected sine:"),
        ("sine:5deg@1s:0.5Hz:1e308s", "expected sine:"),
        ("doublet:5deg@1s:0.01s", "expected parts of at least one sample, 0.025 s"),
        ("3211:5deg@1s:-1s", "expected parts of at least one sample"),
        ("sine:5deg@1s:0.5Hz:0s", "expected parts of at least one sample"),
        ("sine:5deg@1s:0Hz", "expected a frequency above 0 and below 20 Hz"),
        ("sine:5deg@1s:20Hz", "expected a frequency above 0 and below 20 Hz"),
        ("sine:5deg@1s:1Hz,5deg@2s", "expected a sine alone, found 2 items"),
        ("5deg@0s,sine:5deg@1s:1Hz", "expected a sine alone, found 2 items"),
        ("file:a.csv,5deg@1s", 'expected a file alone, found "file:a.csv" and more'),
        ("5deg@1s,file:a.csv", 'expected a file alone, found "file:a.csv" and more'),
    ],
)
def test_what_is_no_reference_is_refused_in_one_line(text, expected):
    with pytest.raises(InputError) as refused:
        parse_profile(text, TS)
    assert str(refused.value).startswith(f'reference "{text}": {expected}')
    assert "\n" not in str(refused.value)


# files


@pytest.mark.parametrize(("column", "unit"), [("value_rad", 1.0), ("value_deg", math.pi / 180.0)])
@pytest.mark.parametrize("ending", ["\n", "\r\n"])
def test_a_file_is_held_from_each_rows_time_on(tmp_path: Path, column, unit, ending):
    path = tmp_path / "r.csv"
    path.write_bytes(ending.join([f"time_s,{column}", "0.05,1", "0.06, -2.5", "0.07,3", "", "0.2,0"]).encode())
    source = parse_profile(f"file:{path}", TS)
    truth = np.array([0.0, 0.0, 1.0, 3.0, 3.0, 3.0, 3.0, 3.0, 0.0, 0.0]) * unit
    np.testing.assert_allclose([source.r(k) for k in range(10)], truth, rtol=1e-15)


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("", 'line 1: expected time_s,value_rad or time_s,value_deg, found ""'),
        ("t,r\n0,1\n", 'line 1: expected time_s,value_rad or time_s,value_deg, found "t,r"'),
        ("time_s,value_rad\n", "line 1: expected 1 to 100000 rows below, found 0"),
        ("time_s,value_rad\n" + "0,0\n" * 100_001, "line 1: expected 1 to 100000 rows below, found 100001"),
        (
            "time_s,value_rad\n\n0,1\n1,x\n",
            'line 4: expected a time of at least 0 and a value, such as 0.5,0.1, found "1,x"',
        ),
        ("time_s,value_rad\n-1,0\n", "line 2: expected a time of at least 0"),
        ("time_s,value_rad\n0,1e999\n", "line 2: expected a time of at least 0"),
        ("time_s,value_rad\n1e999,0\n", "line 2: expected a time of at least 0"),
        ("time_s,value_rad\n0,1,2\n", "line 2: expected a time of at least 0"),
        ("time_s,value_rad\n0,--\n", "line 2: expected a time of at least 0"),
        ("time_s,value_rad\n0,1\n0,2\n", 'line 3: expected a time after 0.0 s, found "0,2"'),
        (
            "time_s,value_rad\n0," + "1" * 60 + "x\n",
            'line 2: expected a time of at least 0 and a value, such as 0.5,0.1, found "0,1',
        ),
    ],
)
def test_what_is_wrong_in_a_file_is_named_with_its_line(tmp_path: Path, content, complaint):
    path = tmp_path / "r.csv"
    path.write_text(content)
    with pytest.raises(InputError) as refused:
        parse_profile(f"file:{path}", TS)
    assert str(refused.value).startswith(f"{path}: {complaint}")
    assert len(str(refused.value)) < len(str(path)) + 150


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path):
    with pytest.raises(InputError, match=r"none\.csv: expected a CSV file, found nothing of that name"):
        parse_profile(f"file:{tmp_path}/none.csv", TS)
    (tmp_path / "r.csv").write_bytes(b"\xff")
    with pytest.raises(InputError, match=r"r\.csv: expected UTF-8 text, found byte 0"):
        parse_profile(f"file:{tmp_path}/r.csv", TS)


# sources


@quick
@given(SWITCHES, st.integers(0, 500), st.integers(1, 100))
def test_r_is_constant_as_long_as_it_says(profile, k, span):
    until = profile.constant_until(k, k + span)
    assert k < until <= k + span
    assert len({profile.r(i) for i in range(k, until)}) == 1
    assert until == k + span or until in [start for start, _ in profile.switches]


@quick
@given(PROGRAMMED, st.integers(0, 80), st.integers(1, 80))
def test_every_source_is_constant_as_long_as_it_says(source, k, span):
    until = source.constant_until(k, k + span)
    assert k < until <= k + span
    assert len({source.r(i) for i in range(k, until)}) == 1


@quick
@given(SWITCHES | SINES | SAMPLED, st.integers(0, 50), st.integers(0, 150))
def test_a_shifted_source_is_later_and_zero_before(source, start, k):
    assert Shifted(source, start).r(k) == (source.r(k - start) if k >= start else 0.0)
