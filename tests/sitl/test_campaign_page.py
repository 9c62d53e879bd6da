"""The page and tables of a campaign: they say what may be concluded and what not, and run nobody's text."""

from __future__ import annotations

import io
from collections.abc import Callable
from decimal import ROUND_CEILING, ROUND_FLOOR
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from gains.table import InputError
from sitl.campaign import words
from sitl.campaign.comparison import compare
from sitl.campaign.page import campaign_page
from sitl.campaign.statistics import measure
from sitl.campaign.tables import campaign_tables, comparison_tables
from tests.integration.browser import CHROMIUM, NO_BROWSER, chromium, opened, sideways
from tests.integration.test_report_browser import DRAWN
from tests.sitl.test_campaign_statistics import Columns, calm, campaign

ATTACK = "</script><img src=x onerror=alert(1)>[bold]'\""


def description(**changes: Any) -> dict[str, Any]:
    return {
        "gains": "hirm-d6",
        "model": "hirm",
        "d_min": 1,
        "d_max": 6,
        "delays": "uniform",
        "transitions": "any",
        "samples": 400,
        "flights": 1000,
        "seed": 1,
        "Ts": 0.025,
        "eta": 0.7,
        "eta_source": "certificate of the gain file",
        "unit": "rad",
        **changes,
    }


def text_of(tables: list[Any], width: int = 240) -> str:
    console = Console(file=io.StringIO(), width=width)
    for table in tables:
        console.print(table)
    written = console.file.getvalue()  # type: ignore[attr-defined]
    return str(written)


# -- what is said


def test_without_a_failure_the_page_names_the_bound_of_the_rule_of_three() -> None:
    page = campaign_page(description(), calm(), threshold=100.0)
    # 1 - 0.05^(1/1000) = 0.0029912, and never rounded down
    assert "a flight drawn like these diverges with a probability of at most 0.00369." in page
    assert "None of 1,000 flights failed" in page
    assert "1,000 flights of hirm-d6 on hirm, 10 s each" in page


def test_with_failures_it_names_both_ends() -> None:
    said = words.concluded(description(), measure(campaign(), eta=0.7))
    # Clopper and Pearson for 10 of 1000: 0.0048050, 0.0183131
    assert "diverges with a probability between 0.0048 and 0.0184." in said[0]
    assert not any("largest seen" in sentence for sentence in said)


def test_it_says_that_the_certificate_covers_every_sequence_and_the_campaign_only_what_it_draws() -> None:
    page = campaign_page(description(), calm())
    assert "A campaign samples a declared distribution" in page
    assert "The certificate covers every sequence of delays d = 1 to 6 in any order" in page
    assert "never exceeds 0.7 ‖v‖" in page


def test_without_eta_it_says_why_nothing_is_proved() -> None:
    page = campaign_page(description(eta=None, eta_source="gains are counted from rest"), calm())
    assert "No certificate speaks of what was flown here (gains are counted from rest)" in page
    assert "The certificate covers" not in page


def test_a_gain_above_eta_is_a_contradiction_inside_the_window_alone() -> None:
    columns = calm()
    columns["outside"][:] = 0.5
    outside = measure(columns, eta=0.3)
    assert "where it is not promised" in words.cards(description(), outside)[2].sentence
    assert words.verdict(outside) == ("None of 1,000 flights failed", "good")
    inside = measure(calm(), eta=0.3)
    assert "contradicts the certificate" in words.cards(description(), inside)[2].sentence
    assert words.verdict(inside)[1] == "bad"


@pytest.mark.parametrize(
    ("p", "rounding", "text"),
    [
        (2.99573e-6, ROUND_CEILING, "3e-6"),
        (3.001e-6, ROUND_CEILING, "3.01e-6"),
        (3.001e-6, ROUND_FLOOR, "3e-6"),
        (0.0299, ROUND_CEILING, "0.0299"),
        (0.123456, ROUND_FLOOR, "0.123"),
        (0.99999, ROUND_FLOOR, "0.999"),
        (0.99999, ROUND_CEILING, "1"),
        (0.0, ROUND_FLOOR, "0"),
        (float("nan"), ROUND_FLOOR, "—"),
    ],
)
def test_bounds_are_rounded_away_from_what_was_measured(p: float, rounding: str, text: str) -> None:
    assert words.chance(p, rounding) == text


# -- the page


def test_nobodys_text_becomes_html_or_markup() -> None:
    told = description(gains=ATTACK, model=ATTACK, delays=ATTACK, eta=None, eta_source=ATTACK, unit=ATTACK)
    both = compare({ATTACK: calm(), "other": {**calm(), "rms_error": np.ones(1000)}})
    page = campaign_page(told, calm(), both)
    assert "<img" not in page
    assert "&lt;img src=x onerror=alert(1)&gt;" in page
    assert text_of(campaign_tables(told, calm())).count("[bold]") > 1
    assert f"A: {ATTACK}, B: other" in text_of(comparison_tables(both))


def test_a_million_flights_make_no_larger_page_than_a_thousand() -> None:
    few, many = (len(campaign_page(description(), calm(flights))) for flights in (1000, 30_000))
    assert many < few + 100_000


def _all_diverged(columns: Columns) -> None:
    columns["diverged"][:], columns["gain"][:] = True, np.inf


def _no_input(columns: Columns) -> None:
    columns["gain"][:], columns["rms_error"][:], columns["max_error"][:] = np.nan, 0.0, 0.0


def _always_alike(columns: Columns) -> None:
    for name in ("d_mean", "gust_amplitude", "changes", "outside"):
        columns[name] = np.ones(len(columns["flight"]))


@pytest.mark.parametrize("flights", [1, 200])
@pytest.mark.parametrize("change", [_all_diverged, _no_input, _always_alike])
def test_a_campaign_at_its_limits_has_a_page(change: Callable[[Columns], None], flights: int) -> None:
    columns = calm(flights)
    change(columns)
    page = campaign_page(description(), columns, compare({"a": columns, "b": columns}), threshold=1.0)
    assert 'data-panel="gain"' in page
    assert 'data-panel="sensitivity-0"' not in page
    assert text_of(campaign_tables(description(), columns, threshold=1.0))


def test_no_flight_is_no_page() -> None:
    with pytest.raises(InputError, match="at least one flight"):
        campaign_page(description(), calm(0))


def test_tables_in_a_terminal_have_the_numbers_of_the_page() -> None:
    columns = campaign()
    told = measure(columns, eta=0.7, threshold=5.0)
    text = text_of(campaign_tables(description(), columns, threshold=5.0, measured=told))
    for row in (*words.failures(description(), told).rows, *words.quantile_table(description(), told).rows):
        assert all(cell in text for cell in row)
    assert "gust amplitude" in text
    narrow = text_of(campaign_tables(description(), columns, threshold=5.0, measured=told), width=80)
    assert all(cell in narrow for row in words.quantile_table(description(), told).rows for cell in row)
    assert "…" not in narrow
    assert "Left out, being the same in all of them: largest delay." in " ".join(text.split())


def test_a_comparison_says_who_tracks_better_and_whose_failures_are_more_than_chance() -> None:
    a = calm()
    b = {**a, "rms_error": 2.0 * a["rms_error"], "max_error": 2.0 * a["max_error"]}
    both = compare({"a": a, "b": b}, threshold=8.0)
    said = " ".join(words.compared(both))
    assert "a tracks better than b: in the median flight a has an rms error between 0.5 and 0.5 times that of b" in said
    assert "more than chance explains" in said
    assert "no more than" not in said
    page = campaign_page(description(), a, both)
    assert 'data-panel="pair-0"' in page
    assert "a tracks better than b" in page


@pytest.mark.realtime
@pytest.mark.skipif(CHROMIUM is None, reason=NO_BROWSER)
def test_chromium_paints_every_figure_fits_a_phone_and_asks_no_network(tmp_path: Path) -> None:
    path = tmp_path / "campaign.html"
    columns = campaign(2000)
    other = {**columns, "rms_error": columns["rms_error"] * np.linspace(0.5, 1.4, 2000)}
    path.write_text(
        campaign_page(description(gains=ATTACK), columns, compare({ATTACK: columns, "b": other}), threshold=8.0),
        encoding="utf-8",
    )
    with chromium() as browser:
        page, heard = opened(browser, path, width=390, scheme="dark")
        painted = page.evaluate(DRAWN)
        assert len(painted) == 7
        assert min(painted) > 1000
        assert sideways(page) == 0
        assert heard.complaints == []
        assert heard.requests == [path.as_uri()]
