"""``make bench``: what the program costs, as ratios to a yardstick measured side by side in the same run.

Absolute times say little on a shared machine; a ratio of medians, taken turn by turn, holds. The command
exits with 1 when a ratio is over its limit.
"""

from __future__ import annotations

import json
import platform
import sys
from collections.abc import Callable
from dataclasses import dataclass

from rich.console import Console
from rich.table import Table

from tests.bench import certify, design, estimators, exact, flight, flood, relay, turnaround


@dataclass(frozen=True)
class Row:
    what: str
    ratio: float
    limit: float
    note: str


def main() -> int:
    benches: list[Callable[[], list[tuple[str, float, float, str]]]] = [
        certify.measure,
        design.measure,
        estimators.measure,
        exact.measure,
        flight.measure,
        turnaround.measure,
        flood.measure,
        relay.measure,
    ]
    rows = [Row(*row) for bench in benches for row in bench()]
    table = Table("measured", "ratio", "limit", "", title=f"{platform.machine()}, Python {platform.python_version()}")
    for row in rows:
        colour = "green" if row.ratio <= row.limit else "red"
        table.add_row(row.what, f"[{colour}]{row.ratio:.2f}[/]", f"{row.limit:g}", row.note)
    Console().print(table)
    print(json.dumps([vars(row) for row in rows]))
    return int(any(row.ratio > row.limit for row in rows))


if __name__ == "__main__":
    sys.exit(main())
