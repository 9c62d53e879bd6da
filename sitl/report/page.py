"""The frame of the page, and the report of flights in it: one file, Bokeh's script inline, nothing from the network.

``render`` makes a page of sections and figures and knows nothing of flights. What comes from a recording is text until
``escape`` has been over it here; in figures it is data. The page says in its head that it may load nothing
(Content-Security-Policy), so that a mistake shows in a browser's console and not in somebody's server log.
"""

from __future__ import annotations

import string
from collections.abc import Mapping, Sequence
from functools import cache
from html import escape
from importlib import resources
from typing import Any, NamedTuple

from bokeh.embed import components
from bokeh.resources import Resources

from gains.command import version
from gains.table import InputError
from sitl.flightfile import FlightFile
from sitl.report import words
from sitl.report.numbers import Numbers, measure, outputs, plain_paths
from sitl.report.panels import MAX_FLIGHTS, panels
from sitl.report.plots import Panel
from sitl.report.words import Card, Table

__all__ = ["Section", "bars_html", "cards_html", "facts_html", "render", "report", "table_html"]


OUTSIDE = ' class="outside"'


class Section(NamedTuple):
    """A part of the page.

    Attributes
    ----------
    heading : str
        Plain text.
    html : str
        What stands above the figures, escaped.
    panels : tuple of Panel
        Figures; one whose heading is that of the section or empty gets none of its own.
    after : str
        What stands below them, escaped.
    """

    heading: str
    html: str = ""
    panels: tuple[Panel, ...] = ()
    after: str = ""


def render(title: str, header: str, sections: Sequence[Section], footer: str) -> str:
    """Return the page.

    Parameters
    ----------
    title : str
        Plain text.
    header, footer : str
        HTML below the title, and at the end; escaped.
    sections : sequence of Section
        With at least one figure among them, each with a name of its own.
    """
    figures = {panel.name: panel.figure for section in sections for panel in section.panels}
    script, divs = components(figures)
    parts = {
        "title": escape(title),
        "header": header,
        "body": "".join(_section(n, section, divs) for n, section in enumerate(sections)),
        "footer": footer,
        "style": _file("report.css"),
        "bokeh": _bokeh(),
        "figures": script,
        "script": _file("report.js"),
    }
    return string.Template(_file("report.html")).substitute(parts)


def _section(n: int, section: Section, divs: Mapping[str, str]) -> str:
    figures = "".join(_figure(panel, divs[panel.name], section.heading) for panel in section.panels)
    return (
        f'<section aria-labelledby="s{n}"><h2 id="s{n}">{escape(section.heading)}</h2>'
        f"{section.html}{figures}{section.after}</section>\n"
    )


def _figure(panel: Panel, div: str, heading: str) -> str:
    own = f"<h3>{escape(panel.heading)}</h3>" if panel.heading not in ("", heading) else ""
    note = f'<p class="note">{escape(panel.note)}</p>' if panel.note else ""
    label = escape(f"Figure: {panel.heading or heading}", quote=True)
    return f'<figure data-panel="{escape(panel.name, quote=True)}" aria-label="{label}">{own}{div}{note}</figure>'


@cache
def _bokeh() -> str:
    """Return the element with BokehJS: the core alone, without widgets, tables and WebGL."""
    return str(Resources(mode="inline", components=["bokeh"], log_level="warn").render())


def _file(name: str) -> str:
    return (resources.files("sitl.report") / name).read_text(encoding="utf-8")


# -- pieces


def table_html(table: Table, caption: str) -> str:
    """Return a table that scrolls by itself where it is too wide."""
    head = "".join(
        f'<th scope="col">{escape(column)}</th>' if column else "<td></td>" for column in table.columns
    )  # fmt: skip
    body = "".join(
        f'<tr><th scope="row">{escape(row[0])}</th>' + "".join(f"<td>{escape(cell)}</td>" for cell in row[1:]) + "</tr>"
        for row in table.rows
    )
    return (
        f'<div class="scroll" role="group" aria-label="{escape(caption, quote=True)}" tabindex="0"><table>'
        f"<caption>{escape(caption)}</caption><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def cards_html(cards: Sequence[Card]) -> str:
    """Return questions with their answers side by side."""
    return '<div class="cards">' + "".join(
        f'<div class="card {card.mood}"><h3>{escape(card.question)}</h3><p class="answer">{escape(card.answer)}</p>'
        f"<p>{escape(card.sentence)}</p></div>"
        for card in cards
    ) + "</div>"  # fmt: skip


def facts_html(facts: Sequence[tuple[str, str]]) -> str:
    """Return names and values as one list."""
    pairs = "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in facts)
    return f'<dl class="facts">{pairs}</dl>'


def bars_html(histogram: Mapping[str, int], window: tuple[int, int], Ts: float) -> str:
    """Return how many samples lived each delay, as a table with bars; those outside the window stand out."""
    whole = sum(histogram.values())
    shown = [(int(d), int(d), n) for d, n in sorted(histogram.items(), key=lambda item: int(item[0]))]
    tail = [row for row in shown if row[0] > window[1] + 2]
    if len(tail) > 1:  # a silent link lets the delay grow through many values
        shown[-len(tail) :] = [(tail[0][0], tail[-1][1], sum(n for *_, n in tail))]
    most = max((n for *_, n in shown), default=1)
    rows = [
        f'<tr{"" if window[0] <= low <= window[1] else OUTSIDE}><th scope="row">{_span(low, high)}</th>'
        f"<td>{_span(f'{1e3 * Ts * low:.4g}', f'{1e3 * Ts * high:.4g}')} ms</td><td>{n:,}</td>"
        f'<td>{n / whole:.1%}</td><td class="bar"><span style="width:{100.0 * n / most:.2f}%"></span></td></tr>'
        for low, high, n in shown
    ]
    return (
        '<div class="scroll" role="group" aria-label="Samples by delay" tabindex="0"><table class="bars">'
        "<caption>Samples that lived each delay</caption><thead><tr>"
        '<th scope="col">d</th><th scope="col">time</th><th scope="col">samples</th><th scope="col">share</th>'
        f'<th scope="col"><span class="unseen">as a bar</span></th></tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _span(low: object, high: object) -> str:
    return f"{low}" if low == high else f"{low}–{high}"


# -- flights


def report(files: Sequence[FlightFile]) -> str:
    """Return the page of one flight, or of several side by side.

    Raises
    ------
    InputError
        For more than ``MAX_FLIGHTS``, or flights whose output is not the same quantity.
    """
    assert files
    _check_comparable(files)
    measured = [measure(file) for file in files]
    drawn = {panel.name: panel for panel in panels(files, [plain_paths(label) for label in words.labels(files)])}
    notes = "".join(f'<p class="note">{escape(note)}</p>' for file in files for note in _notes(file))
    footer = (
        f"<p>Made by lagproof {escape(version())} from {escape(', '.join(words.labels(files)))}. "
        "Drag to zoom, Ctrl and wheel zooms the time of all figures, a click in a legend hides a curve, "
        "the circle of arrows resets.</p>"
    ) + notes
    if len(files) == 1:
        return render(*_alone(files[0], measured[0], drawn), footer)
    return render(*_compared(files, measured, drawn), footer)


def _check_comparable(files: Sequence[FlightFile]) -> None:
    if len(files) > MAX_FLIGHTS:
        raise InputError(f"expected at most {MAX_FLIGHTS} recordings on one page, found {len(files)}")
    shown = {outputs(file.flight.model)[0]: file.name for file in files}
    if len(shown) > 1:
        (one, name), (other, another) = list(shown.items())[:2]
        raise InputError(
            f"expected flights with one output to compare, found {one.name} in {name}, {other.name} in {another}"
        )


def _notes(file: FlightFile) -> list[str]:
    """Return what a reader must know of the recording."""
    notes = []
    if not file.complete:
        notes.append(
            f"{file.name} holds no model and gains of its own: the stored ones of the names it says were taken."
        )
    if file.left_out:
        notes.append(f"{file.name} holds {file.left_out:,} records more than are looked at.")
    return notes


Parts = tuple[str, str, list[Section]]


def _alone(file: FlightFile, measured: Numbers, drawn: dict[str, Panel]) -> Parts:
    """Return title, header and sections for one flight."""
    said, mood = words.verdict(measured)
    header = (
        f'<p class="verdict {mood}">{escape(said)}</p>'
        f"{cards_html(words.story(file, measured))}{facts_html(words.facts(file))}"
    )
    law = file.law
    bars = bars_html(measured.delay["true_histogram"], (law.d_min, law.d_max), file.flight.model.Ts)
    sections = [
        Section("Tracking", panels=_pick(drawn, "tracking", "error", "control")),
        Section("Delay", panels=_pick(drawn, "delay"), after=bars),
        Section(
            "Link", panels=_pick(drawn, "link-up", "link-down"),
            after=table_html(words.link(measured), "Packets and their one-way delays"),
        ),
        Section("Failsafe", panels=_pick(drawn, "timeline"), after=_events(file)),
    ]  # fmt: skip
    faults = words.troubles(file, measured)
    if faults is not None:
        sections.append(Section("Faults", table_html(faults, "What went wrong, and when the law flew again")))
    air = tuple(panel for name, panel in drawn.items() if name.startswith("air-"))
    if air:
        sections.append(Section("Aircraft", panels=air))
    sections += [
        Section("Certificate", table_html(words.certificate(law), "What is proved, verified when this page was made")),
        Section("Numbers", table_html(words.numbers([file], [measured]), "The flight in numbers")),
    ]
    title = plain_paths(file.metadata.get("title", "") or file.metadata.get("scenario", "") or file.name)
    return title[:1].upper() + title[1:], header, sections


def _events(file: FlightFile) -> str:
    table, more = words.events(file)
    rest = f'<p class="note">{more:,} further events are in the recording.</p>' if more else ""
    return f"<details><summary>{len(table.rows)} events in words</summary>{table_html(table, 'Events')}{rest}</details>"


def _compared(files: Sequence[FlightFile], measured: Sequence[Numbers], drawn: dict[str, Panel]) -> Parts:
    """Return title, header and sections for several flights."""
    cards = [_flight_card(n, file, numbers) for n, (file, numbers) in enumerate(zip(files, measured, strict=True))]
    names = words.labels(files)
    header = '<div class="cards">' + "".join(cards) + "</div>"
    sections = [
        Section("Side by side", table_html(words.numbers(files, measured), "The flights in numbers")),
        Section("Tracking", panels=_pick(drawn, "tracking", "error", "control")),
        Section("Delay", panels=_pick(drawn, "delay")),
        Section("Failsafe", panels=_pick(drawn, "timeline")),
    ]
    air = tuple(panel for name, panel in drawn.items() if name.startswith("air-"))
    if air:
        sections.append(Section("Aircraft", panels=air))
    for name, file in zip(names, files, strict=True):
        caption = f"What is proved of the gains of {name}"
        sections.append(Section(f"{name}: certificate and flight", facts_html(words.facts(file)),
                                after=table_html(words.certificate(file.law), caption)))  # fmt: skip
    title = f"{names[0]} and {names[1]}" if len(names) == 2 else f"{len(names)} flights"
    return plain_paths(f"{title}, side by side"), header, sections


def _flight_card(n: int, file: FlightFile, measured: Numbers) -> str:
    said, mood = words.verdict(measured)
    title = plain_paths(file.metadata.get("title", "")) or file.name
    return (
        f'<div class="card {mood} flight-{n}"><h3><i class="swatch" aria-hidden="true"></i>{escape(file.name)}</h3>'
        f'<p class="answer">{escape(said)}</p><p>{escape(title)}</p></div>'
    )


def _pick(drawn: Mapping[str, Any], *names: str) -> tuple[Panel, ...]:
    return tuple(drawn[name] for name in names if name in drawn)
