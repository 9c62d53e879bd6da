"""The tables of a campaign for a terminal; words as on the page."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.table import Table as Grid
from rich.text import Text

from sitl.campaign import words
from sitl.campaign.comparison import Comparison
from sitl.campaign.statistics import Statistics, measure
from sitl.report.words import Table

__all__ = ["campaign_tables", "comparison_tables"]


def campaign_tables(
    description: Mapping[str, Any],
    columns: Any,
    *,
    threshold: float | None = None,
    measured: Statistics | None = None,
) -> list[Grid]:
    """Return a campaign's tables: failures, quantiles, and what moves error and gain; parameters as the page has them.

    Raises
    ------
    InputError
        When the columns are no campaign's.
    """
    told = measured or measure(columns, eta=description.get("eta"), threshold=threshold)
    tables = [
        _grid(words.failures(description, told), words.title(description, told), words.verdict(told)[0]),
        _grid(_stacked(words.quantile_table(description, told)), "Quantiles"),
    ]
    for found, result in ((told.rms_sensitivity, "rms error"), (told.gain_sensitivity, "gain")):
        if found is not None and found.effects:
            tables.append(_grid(words.sensitivities(found), f"What moves the {result}", words.left_out(found)))
    return tables


def comparison_tables(comparison: Comparison) -> list[Grid]:
    """Return a comparison's tables: the controllers side by side, and their pairs."""
    return [
        _grid(words.controllers(comparison), "Controllers on the same draws"),
        _grid(words.pairs(comparison), "Flight by flight", "\n".join(words.compared(comparison))),
    ]


def _stacked(table: Table) -> Table:
    """Return a table with every other column below the one before it, so that eighty characters are wide enough."""
    columns = (table.columns[0], *map("\n".join, zip(table.columns[1::2], table.columns[2::2], strict=True)))
    rows = [(row[0], *map("\n".join, zip(row[1::2], row[2::2], strict=True))) for row in table.rows]
    return Table(columns, rows)


def _grid(table: Table, title: str, caption: str = "") -> Grid:
    """Return a table of which no cell is read as markup."""
    grid = Grid(title=Text(title), caption=Text(caption) if caption else None, title_justify="left",
                caption_justify="left")  # fmt: skip
    for n, name in enumerate(table.columns):
        grid.add_column(Text(name), justify="right" if n else "left")
    for row in table.rows:
        grid.add_row(*map(Text, row))
    return grid
