"""The failsafe's page: diagram and full table, made from the table that flies, so that the two cannot differ.

``python -m autopilot.failsafe_page docs/failsafe.md`` writes it.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import click

from autopilot.failsafe import CALM_SAMPLES, GOOD_SAMPLES, REST_NS, TRANSITIONS, Event, Mode
from autopilot.link.clock import NS_PER_S
from gains.command import run

__all__ = ["COMMAND", "PATH", "page"]

PATH = "docs/failsafe.md"
"""Where the page is kept, from the top of the repository."""
COMMAND = f"python -m autopilot.failsafe_page {PATH}"
"""What writes it there."""

INTRO = f"""\
The autopilot's failsafe decides who has the elevator: a law, the last command, or neutral. A law flies only with a
fresh state and a delay inside the window that its gains are certified for. Otherwise its last command is held, then
the elevator goes to neutral, and the law comes back by itself after a row of good samples. Each sample is exactly one
of *good*, *wide*, *outside*, *implausible* and *frozen*; {GOOD_SAMPLES} samples in a row make *recovered* or
*wide_recovered*, {CALM_SAMPLES} make *calm*. This page is made from the table in `autopilot/failsafe.py` by
`{COMMAND}`; do not edit it."""

NOTES = f"""\
Four rules stand beside the table:

* Without a second, conservative set of gains *wide* counts as *outside*, and CONSERVATIVE cannot be reached.
* *expired* is believed only when HOLD has lasted its time. After *saturated*, NEUTRAL lasts at least
  {REST_NS / NS_PER_S:g} s, whatever the samples say.
* After CONSERVATIVE only *calm* leads to TRACKING, also where HOLD or NEUTRAL lies between: nothing certifies the
  switching of the two laws, so it must be rare.
* A lost ground station is remembered in every mode: what leads to TRACKING then leads to LEVEL."""


def page() -> str:
    """Return the page as Markdown."""
    modes = _rows(("Mode", "Who has the elevator"), ((mode, mode.meaning) for mode in Mode))
    events = _rows(("Event", "What has happened"), ((f"*{event}*", event.meaning) for event in Event))
    header = ("Event", *Mode)
    table = _rows(header, ((f"*{e}*", *(TRANSITIONS.get((mode, e), "–") for mode in Mode)) for e in Event))
    parts = (
        "# Failsafe",
        INTRO,
        _diagram(),
        "## Modes",
        modes,
        "## Events",
        events,
        "## Every event in every mode",
        "The next mode; – stays.",
        table,
        NOTES,
    )
    return "\n\n".join(parts) + "\n"


def _diagram() -> str:
    """Return the transitions as a Mermaid diagram, one edge for each pair of modes."""
    edges: dict[tuple[Mode, Mode], list[Event]] = {}
    for (mode, event), to in sorted(TRANSITIONS.items(), key=_order):
        edges.setdefault((mode, to), []).append(event)
    lines = [f"    {mode} --> {to}: {', '.join(events)}" for (mode, to), events in edges.items()]
    return "\n".join(["```mermaid", "stateDiagram-v2", f"    [*] --> {Mode.STANDBY}", *lines, "```"])


def _order(entry: tuple[tuple[Mode, Event], Mode]) -> tuple[int, int]:
    """Return where an entry stands: modes and events in the order of their enums."""
    (mode, event), _ = entry
    return list(Mode).index(mode), list(Event).index(event)


def _rows(header: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    """Return a Markdown table."""
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (header, ("---",) * len(header), *rows))


@click.command()
@click.argument("path", type=click.Path(dir_okay=False, path_type=Path))
def cli(path: Path) -> None:
    """Write the failsafe's page to PATH."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    run(cli, "autopilot.failsafe_page")
