"""``make bench``: what the program costs, as ratios to a yardstick measured side by side in the same run.

Absolute times say little on a shared machine; a ratio of medians, taken turn by turn, holds. The command exits with 1
when a ratio is over its limit. The last run that was kept is ``tests/bench/kept.json`` (``--keep`` replaces it): the
table shows the change since then, and one of a fifth or more to the worse by a ``!``.

    make bench                     all of it
    python -m tests.bench relay    some
"""

from __future__ import annotations

import json
import math
import os
import platform
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import click
from rich.console import Console
from rich.table import Table

from tests.bench import campaign, certify, codec, compiled, design, estimators, exact, flight, flood, relay, turnaround

KEPT = Path(__file__).with_name("kept.json")
WORSE = 1.2

BENCHES: dict[str, Callable[[], list[tuple[str, float, float, str]]]] = {
    "certify": certify.measure,
    "design": design.measure,
    "estimators": estimators.measure,
    "exact": exact.measure,
    "codec": codec.measure,
    "flight": flight.measure,
    "compiled": compiled.measure,
    "turnaround": turnaround.measure,
    "flood": flood.measure,
    "relay": relay.measure,
    "campaign": campaign.measure,
}


@dataclass(frozen=True)
class Row:
    """One line: a ratio, and what it may be at most; infinite for what is told only."""

    what: str
    ratio: float
    limit: float
    note: str

    @property
    def passed(self) -> bool:
        return self.ratio <= self.limit


def machine() -> dict[str, str | int]:
    """Return what was measured on."""
    cpu = next(
        (line.partition(":")[2].strip() for line in _lines("/proc/cpuinfo") if line.startswith("model name")),
        platform.processor() or platform.machine(),
    )
    return {"cpu": cpu, "cores": len(os.sched_getaffinity(0)), "python": platform.python_version()}


def _lines(path: str) -> list[str]:
    return Path(path).read_text().splitlines() if Path(path).exists() else []


def table_of(rows: Sequence[Row], kept: dict[str, float]) -> Table:
    known = machine()
    table = Table(
        "measured",
        "ratio",
        "limit",
        "kept",
        "",
        title=f"{known['cpu']}, {known['cores']} cores, Python {known['python']}",
    )
    for row in rows:
        limit = "" if math.isinf(row.limit) else f"{row.limit:.3g}"
        colour = "green" if row.passed else "red"
        before = kept.get(row.what)
        mark = " !" if before is not None and row.ratio > WORSE * before else ""
        then = "" if before is None else f"{before:.3g}{mark}"
        table.add_row(row.what, f"[{colour}]{row.ratio:.3g}[/]", limit, then, row.note)
    return table


@click.command()
@click.argument("names", nargs=-1, type=click.Choice(list(BENCHES)))
@click.option("--keep", is_flag=True, help=f"Keep the result in {KEPT.name}.")
def main(names: tuple[str, ...], keep: bool) -> None:
    """Measure what costs what, against a yardstick of the same run."""
    rows = [Row(*row) for name in names or BENCHES for row in BENCHES[name]()]
    old = json.loads(KEPT.read_text()) if KEPT.exists() else {"rows": []}
    Console(width=None if sys.stdout.isatty() else 200).print(
        table_of(rows, {r["what"]: r["ratio"] for r in old["rows"]})
    )
    said = [{**vars(row), "limit": None if math.isinf(row.limit) else row.limit} for row in rows]
    print(json.dumps(said))
    if keep:
        measured = {row["what"] for row in said}
        kept = [row for row in old["rows"] if row["what"] not in measured and names] + said
        date = datetime.now(UTC).date().isoformat()
        KEPT.write_text(json.dumps({"date": date, "machine": machine(), "rows": kept}, indent=1) + "\n")
    sys.exit(int(not all(row.passed for row in rows)))


if __name__ == "__main__":
    main()
