"""Clocks on the command line."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autopilot.link.clock import Clock
from autopilot.link.process import format_clock, parse_clock
from gains.table import InputError

S = 1_000_000_000


@pytest.mark.parametrize(
    ("text", "clock"),
    [
        ("0s", Clock()),
        ("137s", Clock(137 * S)),
        ("137s:+40ppm", Clock(137 * S, 40_000)),
        ("1042s:-60ppm", Clock(1042 * S, -60_000)),
        ("0.25s:0.5ppm", Clock(S // 4, 500)),
        ("1000s:200ppm", Clock(1000 * S, 200_000)),
    ],
)
def test_clocks_are_read(text, clock):
    assert parse_clock(text) == clock


@pytest.mark.parametrize(
    "text",
    [
        "",
        "137",
        "s",
        "-1s",
        "137ms",
        "nans",
        "infs",
        "1e999s",
        "137s:40",
        "137s:ppm:",
        "137s:201ppm",
        "137s:-201ppm",
        "137s:nanppm",
        "137s+40ppm",
        "x137s",
    ],
)
def test_what_is_no_clock_is_refused(text):
    with pytest.raises(InputError, match=r'clock ".*": expected OFFSETs:DRIFTppm within 200 ppm, such as 137s:\+40ppm'):
        parse_clock(text)


@settings(deadline=None)
@given(st.integers(0, 1 << 50), st.integers(-200_000, 200_000))
def test_a_formatted_clock_is_read_back_exactly(offset_ns, drift_ppb):
    clock = Clock(offset_ns, drift_ppb)
    assert parse_clock(format_clock(clock)) == clock
