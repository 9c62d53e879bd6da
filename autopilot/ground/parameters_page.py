"""The page of the vehicle's parameters, made from the table that is served, so that the two cannot differ.

``python -m autopilot.ground.parameters_page docs/parameters.md`` writes it.
"""

from __future__ import annotations

from pathlib import Path

import click

from autopilot.ground.parametertable import PARAMETERS, Parameter
from gains.command import run

__all__ = ["COMMAND", "PATH", "page"]

PATH = "docs/parameters.md"
"""Where the page is kept, from the top of the repository."""
COMMAND = f"python -m autopilot.ground.parameters_page {PATH}"
"""What writes it there."""

INTRO = f"""\
What a ground station can read and set while the autopilot runs. A new value counts at once, when it is in range and
obeys its rule; otherwise the old one stays, and the reason comes as a message. A file keeps only what differs from
the defaults, and `GAINS` by the name of the gain set. This page is made from the table in
`autopilot/ground/parametertable.py` by `{COMMAND}`; do not edit it."""

TYPES = """\
Every value travels as a float (MAV_PARAM_TYPE_REAL32), whole numbers and switches too: tools do not agree on how
integers travel, and a float reads the same to all. A value of any other type is refused. A program that sets whole
numbers therefore sets floats, such as `set_param_float("GAINS", 1)`."""

HEADER = ("Name", "Type", "Range", "Default", "Unit", "Meaning", "Rule")


def page() -> str:
    """Return the page as Markdown."""
    rows = "\n".join(f"| {' | '.join(cells)} |" for cells in (HEADER, ("---",) * len(HEADER), *map(_row, PARAMETERS)))
    return "\n\n".join(("# Parameters", INTRO, rows, TYPES)) + "\n"


def _row(parameter: Parameter) -> tuple[str, ...]:
    """Return the cells of one parameter."""
    return (
        f"`{parameter.name}`",
        parameter.kind,
        parameter.range,
        "–" if parameter.default is None else f"{parameter.default:g}",
        parameter.unit,
        parameter.meaning,
        parameter.rule,
    )


@click.command()
@click.argument("path", type=click.Path(dir_okay=False, path_type=Path))
def cli(path: Path) -> None:
    """Write the page of the parameters to PATH."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    run(cli, "autopilot.ground.parameters_page")
