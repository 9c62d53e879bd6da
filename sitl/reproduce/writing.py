"""The files of a reproduction: figures, tables as CSV, everything as JSON, and the page as Markdown and as HTML.

The HTML page is one file with the figures inside; it needs no network. Nothing in any file tells the time or the
machine, so that equal runs are equal bytes.
"""

from __future__ import annotations

import base64
import csv
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from html import escape
from importlib import resources
from pathlib import Path
from typing import TypeVar

import orjson

from gains.atomic import replace_file
from gains.command import version
from sitl.reproduce.claims import OURS, PAPER, READING, Cell, Claim, Section, Table, Verdict, cell_text
from sitl.reproduce.figures import draw, save
from sitl.reproduce.run import Reproduction

__all__ = ["COMMAND", "PAGE", "html", "markdown", "write"]

PAGE = "docs/reproduction.md"
"""Where the page is kept, without its figures, from the top of the repository."""
COMMAND = f"sitl reproduce -o DIR --page {PAGE}"
"""What writes it there."""

T = TypeVar("T")

_TITLE = "The paper, reproduced"
_BY = {PAPER: "the paper's", OURS: "ours", READING: "a reading"}
_COLUMNS = ("claim", "where", "it says", "we find", "verdict", "why")


def write(folder: Path, found: Reproduction) -> dict[str, Path]:
    """Write all files into a folder that is there, and return them by name."""
    files: dict[str, Path] = {}
    for name, figure in draw(found.pendulum, found.hirm).items():
        files[name] = folder / f"{name}.png"
        save(figure, files[name])
    texts = {
        "reproduction.json": _json(found),
        "claims.csv": _csv(
            ("id", "by", "where", "says", "finds", "verdict", "why"),
            [(c.id, c.by, c.where, c.says, c.finds, str(c.verdict), c.why) for c in found.claims],
        ),
        "reproduction.md": markdown(found),
        **{f"{table.name}.csv": _csv(table.columns, table.rows) for table in found.tables},
    }
    images = {name: path.read_bytes() for name, path in files.items()}
    texts["index.html"] = html(found, images)
    for name, text in texts.items():
        files[name] = folder / name
        replace_file(files[name], text.encode())
    return files


def _json(found: Reproduction) -> str:
    content = {
        "lagproof": version(),
        "seed": found.seed,
        "quick": found.quick,
        "skipped": found.skipped,
        "delays": found.hirm.delays,
        "claims": [asdict(claim) for claim in found.claims],
        "tables": {table.name: asdict(table) for table in found.tables},
    }
    return orjson.dumps(content, option=orjson.OPT_INDENT_2 | orjson.OPT_APPEND_NEWLINE).decode()


def _csv(columns: Sequence[str], rows: Iterable[Sequence[Cell]]) -> str:
    """Return a CSV file at full precision; what is not known is empty."""
    into = io.StringIO()
    writer = csv.writer(into, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(["" if cell is None else cell for cell in row] for row in rows)
    return into.getvalue()


def _introduction(found: Reproduction) -> list[str]:
    count = {verdict: sum(claim.verdict is verdict for claim in found.claims) for verdict in Verdict}
    ours = [claim for claim in found.claims if claim.by == OURS]
    hold = sum(claim.verdict is Verdict.HOLDS for claim in ours)
    text = [
        "Figures 2 to 7 and the tables of Zhang, Wang, Dong, Jiang, H∞ output tracking control for flight control"
        " systems with time-varying delay (Chinese Journal of Aeronautics 26(5), 2013), from flights of the real"
        " programs over MAVLink in virtual time, and from proofs, all made in one run of `sitl reproduce`.",
        f"Of {len(found.claims)} claims {count[Verdict.HOLDS]} hold, {count[Verdict.FAILS]} do not, and"
        f" {count[Verdict.OPEN]} cannot be checked. {len(ours)} of them are ours, of which {hold} hold: where one does"
        " not, the command ends with exit status 1. The others are the paper's, or readings of what it leaves open."
        f" Seed {found.seed}.",
    ]
    if found.skipped:
        text.append(f"A quick run: without {', '.join(found.skipped)}.")
    return text


def markdown(found: Reproduction, *, figures: bool = True) -> str:
    """Return the page as Markdown, whose figures lie beside it; or without them, as the repository keeps it."""
    parts = [f"# {_TITLE}", *_introduction(found)]
    if not figures:
        parts.append(f"This page is written by `{COMMAND}`, which draws the figures into DIR; do not edit it.")
    for section in found.sections:
        parts += [f"## {section.title}", *section.text]
        for name, caption in section.figures if figures else ():
            parts += [f"![{caption}]({name}.png)", f"*{caption}*"]
        for table in section.tables:
            rows = [[cell_text(cell) for cell in row] for row in table.rows]
            parts += [f"### {table.title}", _markdown_table(table.columns, rows), *table.notes]
        if section.claims:
            parts += ["### Claims", _markdown_table(_COLUMNS, [_claim_cells(claim) for claim in section.claims])]
    return "\n\n".join(parts) + "\n"


def _claim_cells(claim: Claim) -> list[str]:
    return [f"{claim.id} ({_BY[claim.by]})", claim.where, claim.says, claim.finds, str(claim.verdict), claim.why]


def _markdown_table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = (columns, ["---"] * len(columns), *rows)
    return "\n".join(f"| {' | '.join(cell.replace('|', '&#124;') for cell in line)} |" for line in lines)


def html(found: Reproduction, images: Mapping[str, bytes]) -> str:
    """Return the page as one HTML file.

    Parameters
    ----------
    found : Reproduction
    images : mapping of str to bytes
        The figures as PNG files, by name.
    """
    style = (resources.files("sitl") / "reproduce" / "page.css").read_text(encoding="utf-8")
    body = [f"<h1>{escape(_TITLE)}</h1>", *(_paragraph(text) for text in _introduction(found))]
    for section in found.sections:
        body += _html_section(section, images)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(_TITLE)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n<main>\n"
        + "\n".join(body)
        + "\n</main>\n</body>\n</html>\n"
    )


def _html_section(section: Section, images: Mapping[str, bytes]) -> list[str]:
    body = [f"<h2>{escape(section.title)}</h2>", *(_paragraph(text) for text in section.text)]
    for name, caption in section.figures:
        data = base64.b64encode(images[name]).decode("ascii")
        image = f'<img src="data:image/png;base64,{data}" alt="{escape(caption)}">'
        body.append(f"<figure>{image}<figcaption>{escape(caption)}</figcaption></figure>")
    for table in section.tables:
        body += [f"<h3>{escape(table.title)}</h3>", _html_data(table), *(_paragraph(text) for text in table.notes)]
    if section.claims:
        body += ["<h3>Claims</h3>", _html_claims(section.claims)]
    return body


def _paragraph(text: str) -> str:
    """Return a paragraph, what stands between backquotes as code."""
    parts = escape(text).split("`")
    return "<p>" + "".join(f"<code>{part}</code>" if i % 2 else part for i, part in enumerate(parts)) + "</p>"


def _html_data(table: Table) -> str:
    def cell(value: Cell) -> str:
        kind = ' class="number"' if isinstance(value, float | int) or value is None else ""
        return f"<td{kind}>{escape(cell_text(value))}</td>"

    return _html_table(table.columns, table.rows, lambda row: "".join(map(cell, row)))


def _html_claims(claims: Sequence[Claim]) -> str:
    def cells(claim: Claim) -> str:
        kind = {Verdict.HOLDS: "holds", Verdict.FAILS: "fails", Verdict.OPEN: "open"}[claim.verdict]
        shown = [f"<td>{escape(text)}</td>" for text in _claim_cells(claim)]
        shown[4] = f'<td class="{kind}">{escape(str(claim.verdict))}</td>'
        return "".join(shown)

    return _html_table(_COLUMNS, claims, cells)


def _html_table(columns: Sequence[str], rows: Iterable[T], cells: Callable[[T], str]) -> str:
    head = "".join(f"<th>{escape(column)}</th>" for column in columns)
    lines = "\n".join(f"<tr>{cells(row)}</tr>" for row in rows)
    return f'<div class="wide"><table>\n<thead><tr>{head}</tr></thead>\n<tbody>\n{lines}\n</tbody>\n</table></div>'
