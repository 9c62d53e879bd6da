"""A claim and what became of it, and a table: the data from which every page and file of a reproduction is written.

What a claim finds is text made of numbers computed in the run; the numbers themselves stand beside it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum

__all__ = ["OURS", "PAPER", "READING", "Cell", "Claim", "Section", "Table", "Verdict", "broken", "cell_text", "judged"]

Cell = float | int | str | None
"""What stands in a table; None is nothing known."""

PAPER, OURS, READING = "paper", "ours", "reading"
"""Who makes a claim; a reading is what we take the paper to mean, or to leave out."""


class Verdict(StrEnum):
    """What became of a claim."""

    HOLDS = "holds"
    FAILS = "does not hold"
    OPEN = "cannot be checked"


@dataclass(frozen=True, slots=True)
class Claim:
    """One claim.

    Attributes
    ----------
    id : str
        Its name, which does not change.
    where : str
        Where in the paper it stands, or what of it is concerned.
    says : str
        The claim.
    finds : str
        What was computed or flown.
    verdict : Verdict
    why : str
        What makes the verdict.
    by : str
        ``PAPER``, ``OURS`` or ``READING``. A claim of ours that does not hold is a failure of the run.
    numbers : mapping of str to Cell
        What ``finds`` is made of.
    """

    id: str
    where: str
    says: str
    finds: str
    verdict: Verdict
    why: str
    by: str = PAPER
    numbers: Mapping[str, Cell] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Table:
    """A table as it is written to a CSV file and to the pages.

    Attributes
    ----------
    name : str
        Of its file, without suffix.
    title : str
    columns : tuple of str
        With their units.
    rows : tuple of tuple of Cell
    notes : tuple of str
        Paragraphs below it.
    """

    name: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        assert all(len(row) == len(self.columns) for row in self.rows), self.name


@dataclass(frozen=True, slots=True)
class Section:
    """A part of the page: figures by file name and caption, tables, claims.

    Attributes
    ----------
    title : str
    text : tuple of str
        Paragraphs.
    figures : tuple of (str, str)
        Name of the figure without suffix, and its caption.
    tables : tuple of Table
    claims : tuple of Claim
    """

    title: str
    text: tuple[str, ...] = ()
    figures: tuple[tuple[str, str], ...] = ()
    tables: tuple[Table, ...] = ()
    claims: tuple[Claim, ...] = ()


def judged(holds: bool | None) -> Verdict:
    """Return the verdict on what was found to hold, or not, or could not be looked at."""
    if holds is None:
        return Verdict.OPEN
    return Verdict.HOLDS if holds else Verdict.FAILS


def broken(claims: Iterable[Claim]) -> list[Claim]:
    """Return the claims of ours that do not hold."""
    return [claim for claim in claims if claim.by == OURS and claim.verdict is Verdict.FAILS]


def cell_text(cell: Cell) -> str:
    """Return a cell as people read it: five significant digits, – for nothing."""
    if cell is None:
        return "–"
    if isinstance(cell, float):
        return f"{cell:.5g}"
    return str(cell)
