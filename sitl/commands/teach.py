"""The command ``sitl teach``: one HTML page on which the delay is moved until the loop breaks."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import click

from gains.command import print_json, require_writable
from gains.table import InputError

__all__ = ["DEFAULT", "MOST", "teach"]

DEFAULT = ("pendulum-paper", "hirm-paper", "hirm-d4", "hirm-d6")
"""The systems of a page on which none is named."""

MOST = 6
"""Systems of one page: each takes 0.6 MB and about ten seconds."""

_clock = time.perf_counter  # noqa: TID251  # a command says how long it took


@click.command()
@click.option(
    "--gains",
    "names",
    multiple=True,
    metavar="NAME",
    help=f"A stored gain file or a path; as many as you like up to {MOST}. Default: {', '.join(DEFAULT)}.",
)
@click.option("--delay", metavar="FROM:TO", help="The slider's ends, in samples. Default: d_min to d_max + 4 of each.")
@click.option(
    "--transitions",
    type=click.Choice(["any", "fifo"]),
    default="any",
    show_default=True,
    help="any: the delay may jump within the window; fifo: it grows by at most one per sample.",
)
@click.option(
    "-o",
    "--output",
    type=click.Path(dir_okay=False, path_type=Path),
    default=Path("teach.html"),
    show_default=True,
    help="The page.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def teach(names: tuple[str, ...], delay: str | None, transitions: Any, output: Path, as_json: bool) -> None:
    """Write a page to teach with: move the delay until the loop breaks, beside what is proved about it.

    The page is one file and needs no network. Curves, proofs and breaking delay sequences are computed here.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from gains.proving import parse_window
    from gains.store import load_gains
    from sitl.teach.lesson import lesson, positions  # with the solvers: --help does without
    from sitl.teach.page import page

    begun = _clock()
    laws = [load_gains(name) for name in names or DEFAULT]
    _check([law.name for law in laws])
    window = None if delay is None else parse_window(delay)
    sliders = [positions(law, window) for law in laws]
    require_writable(output)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("", total=sum(map(len, sliders)))

        def tell(text: str) -> None:
            progress.update(task, description=text, advance=1)

        lessons = [lesson(law, slider, transitions, tell) for law, slider in zip(laws, sliders, strict=True)]
    text = page(lessons)
    output.write_text(text, encoding="utf-8")
    size, seconds = len(text.encode()), _clock() - begun
    if as_json:
        shown = [
            {
                "gains": one.gains.name,
                "delays": list(one.delays),
                **{
                    f"{pattern}_{verdict}": [d for d in one.delays if one.cases[pattern, d].fact.verdict == verdict]
                    for pattern in ("constant", "worst")
                    for verdict in ("stable", "unstable", "undecided")
                },
            }
            for one in lessons
        ]
        print_json({"file": output, "bytes": size, "transitions": transitions, "systems": shown, "seconds": seconds})
    else:
        click.echo(f"{output}: {size / 1e6:.1f} MB, {', '.join(one.gains.name for one in lessons)}, {seconds:.0f} s")


def _check(names: list[str]) -> None:
    if len(names) > MOST:
        raise InputError(f"--gains: expected at most {MOST}, found {len(names)}")
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise InputError(f"--gains: expected every name once, found {twice[0]} again")
