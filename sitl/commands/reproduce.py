"""``sitl reproduce``: the paper's figures, tables and claims again, from flights and proofs."""

from __future__ import annotations

import time
from dataclasses import asdict
from pathlib import Path

import click

from gains.command import NEGATIVE, SUCCESS, print_json, require_writable
from gains.table import InputError
from sitl.commands.options import FILE, SEED

__all__ = ["reproduce"]

_clock = time.perf_counter  # noqa: TID251  # a command says how long it took


@click.command()
@click.option(
    "-o", "--output", required=True, type=click.Path(file_okay=False, path_type=Path), help="Folder for the files."
)
@click.option("--seed", type=SEED, default=1, show_default=True, help="Of the random delays and of the flights.")
@click.option("--quick", is_flag=True, help="Leave out what is slow, and say so.")
@click.option("--page", type=FILE, help="Also write reproduction.md there, without its figures.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object: the claims and the files.")
def reproduce(output: Path, seed: int, quick: bool, page: Path | None, as_json: bool) -> int:
    """Reproduce the paper: Figures 2 to 7, its tables, and what became of each of its claims and of ours.

    Every response is a flight over MAVLink in virtual time, every bound a proof made here. Exit status 1 when a claim
    that we make about our own designs does not hold. Equal seeds give equal numbers.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from sitl.reproduce.claims import broken
    from sitl.reproduce.run import STEPS
    from sitl.reproduce.run import reproduce as run_all  # with solvers and plots: --help does without
    from sitl.reproduce.writing import markdown, write

    begun = _clock()
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{output}: {error.strerror or error}") from None
    require_writable(output / "index.html")
    if page is not None:
        require_writable(page)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("", total=STEPS)

        def tell(text: str) -> None:
            progress.update(task, description=text, advance=1)

        found = run_all(seed, tell, quick=quick)
        tell("writing")
        files = write(output, found)
    if page is not None:
        page.write_text(markdown(found, figures=False), encoding="utf-8")
    failed = broken(found.claims)
    seconds = _clock() - begun
    if as_json:
        print_json(
            {
                "claims": [asdict(claim) | {"numbers": dict(claim.numbers)} for claim in found.claims],
                "broken": [claim.id for claim in failed],
                "seed": seed,
                "quick": quick,
                "skipped": found.skipped,
                "files": {name: str(path) for name, path in files.items()},
                "seconds": seconds,
            }
        )
    else:
        width = max(len(claim.id) for claim in found.claims)
        for claim in found.claims:
            click.echo(f"{claim.id:{width}}  {claim.verdict:17}  {claim.finds}")
        if found.skipped:
            click.echo(f"quick: without {', '.join(found.skipped)}")
        click.echo(f"{files['index.html']}: {len(found.claims)} claims, {len(failed)} of ours broken, {seconds:.0f} s")
    return NEGATIVE if failed else SUCCESS
