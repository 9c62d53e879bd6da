"""The page of a campaign: what was flown, what may be concluded and what not, tables and figures, in one HTML file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from gains.command import version
from gains.table import InputError
from sitl.campaign import words
from sitl.campaign.comparison import Comparison
from sitl.campaign.plots import delay_panel, exceedance_panel, gain_panel, pair_panel, sensitivity_panel
from sitl.campaign.sensitivity import Sensitivity
from sitl.campaign.statistics import Statistics, columns_of, measure
from sitl.report.page import Section, cards_html, facts_html, render, table_html
from sitl.report.plots import Panel

__all__ = ["campaign_page"]


def campaign_page(
    description: Mapping[str, Any],
    columns: Any,
    comparison: Comparison | None = None,
    *,
    threshold: float | None = None,
    measured: Statistics | None = None,
) -> str:
    """Return the page of a campaign.

    Parameters
    ----------
    description : mapping
        What was flown: gains, model, d_min, d_max, delays, transitions, samples, flights, seed, Ts, eta, eta_source;
        and maybe unit, of the errors.
    columns : mapping of str to ndarray, or pyarrow Table
        One row per flight.
    comparison : Comparison, optional
        With other controllers on the same draws.
    threshold : float, optional
        An error beyond it is a failure.
    measured : Statistics, optional
        Of these columns, where they are known already.

    Raises
    ------
    InputError
        When there is no flight, or the columns are no campaign's.
    """
    own = columns_of(columns)
    if not len(own["flight"]):
        raise InputError("campaign: expected at least one flight, found none")
    told = measured or measure(own, eta=description.get("eta"), threshold=threshold)
    said, mood = words.verdict(told)
    header = (
        f'<p class="verdict {mood}">{escape(said)}</p>'
        f"{cards_html(words.cards(description, told))}{facts_html(words.facts(description))}"
    )
    unit = str(description.get("unit") or "")
    maps = (exceedance_panel(own, unit, told.threshold, told.confidence), delay_panel(own, unit))
    sections = [
        Section(
            "What may be concluded",
            _paragraphs(words.concluded(description, told)),
            after=f"<h3>And what not</h3>{_paragraphs(words.not_concluded(description))}",
        ),
        Section(
            "Failures", table_html(words.failures(description, told), "Flights, and how probable such flights are")
        ),
        Section("Gain", panels=(gain_panel(told.gains),)),
        Section(
            "Errors",
            table_html(words.quantile_table(description, told), "Quantiles, with distribution-free intervals"),
            tuple(panel for panel in maps if panel is not None),
        ),
        *_sensitivities(told),
    ]
    if comparison is not None:
        sections.append(_compared(comparison))
    footer = (
        f"<p>Made by lagproof {escape(version())}. Probabilities: Clopper and Pearson. Quantiles: order statistics. "
        "Drag to zoom, a click in a legend hides a curve, the circle of arrows resets.</p>"
    )
    return render(words.title(description, told), header, sections, footer)


def _paragraphs(sentences: Sequence[str]) -> str:
    return "".join(f"<p>{escape(sentence)}</p>" for sentence in sentences)


def _sensitivities(told: Statistics) -> list[Section]:
    """Return the sections about which parameter hurts."""
    kinds: Sequence[tuple[Sensitivity | None, str, str]] = (
        (told.rms_sensitivity, "rms error", "Which parameter hurts: error"),
        (told.gain_sensitivity, "gain", "Which parameter hurts: gain"),
        (told.failure_sensitivity, "probability of failure", "Which parameter makes a flight fail"),
    )
    sections = []
    for n, (found, result, heading) in enumerate(kinds):
        panel: Panel | None = None if found is None else sensitivity_panel(found, result, f"sensitivity-{n}")
        if found is None or panel is None:
            continue
        table = table_html(words.sensitivities(found), f"What each parameter, alone, does to the {result}")
        note = f'<p class="note">{escape(words.left_out(found))}</p>'
        sections.append(Section(heading, panels=(panel,), after=f"{table}{note}"))
    return sections


def _compared(comparison: Comparison) -> Section:
    """Return the section about controllers on the same draws, with figures of the first beside each other one."""
    first = [pair for pair in comparison.pairs if pair.a == comparison.names[0]]
    after = table_html(words.controllers(comparison), "Controllers side by side")
    after += table_html(words.pairs(comparison), "Flight by flight, on the same draws")
    return Section(
        "Controllers on the same draws",
        _paragraphs(words.compared(comparison)),
        tuple(pair_panel(pair, place) for place, pair in enumerate(first)),
        after,
    )
