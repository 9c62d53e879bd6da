"""Exit codes and single lines of complaint, of a command line that does what it is told."""

import json
import subprocess
import sys
from pathlib import Path

import click
import numpy as np
import pytest

from gains.command import print_json, run
from gains.table import InputError


@click.group()
def cli() -> None:
    """Behave as told."""


@cli.command()
@click.argument("how")
def act(how: str) -> int | None:
    """Act."""
    if how == "input":
        raise InputError("f.toml: x:\nexpected 1, found 2")
    if how == "interrupt":
        raise KeyboardInterrupt
    if how == "disk":
        raise OSError(28, "No space left on device", "out.toml")
    if how == "click":
        raise click.ClickException("no\nway")
    if how == "exit":
        raise SystemExit(1)
    if how == "bare exit":
        raise SystemExit
    if how == "context":
        click.get_current_context().exit(1)
    return {"negative": 1, "success": 0}.get(how)


@pytest.mark.parametrize(
    ("arguments", "code", "stderr"),
    [
        (["act", "success"], 0, ""),
        (["act", "nothing"], 0, ""),
        (["act", "negative"], 1, ""),
        (["act", "exit"], 1, ""),
        (["act", "bare exit"], 0, ""),
        (["act", "context"], 1, ""),
        (["act", "input"], 2, r"prog: error: f.toml: x:\nexpected 1, found 2"),
        (["act", "disk"], 2, "prog: error: out.toml: No space left on device"),
        (["act", "click"], 2, "prog: error: no way"),
        (["act"], 2, "prog: error: Missing argument 'HOW'. (see 'prog act --help')"),
        (["act", "x", "--no"], 2, "prog: error: No such option '--no'. (see 'prog act --help')"),
        (["atc", "x"], 2, "prog: error: No such command 'atc'. Did you mean 'act'? (see 'prog --help')"),
        ([], 2, "prog: error: expected a command, found none (see 'prog --help')"),
        (["act", "interrupt"], 130, ""),
        (["--help"], 0, ""),
        (["act", "--help"], 0, ""),
    ],
)
def test_every_end_has_its_code_and_at_most_one_line(
    arguments: list[str],
    code: int,
    stderr: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "argv", ["prog", *arguments])
    with pytest.raises(SystemExit) as ended:
        run(cli, "prog")
    assert ended.value.code == code
    assert capsys.readouterr().err.strip() == stderr


def test_a_bug_is_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    @click.command()
    def broken() -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(sys, "argv", ["prog"])
    with pytest.raises(ZeroDivisionError):
        run(broken, "prog")


PIPE = """
import click
from gains.command import run
@click.command()
def much():
    for i in range(100000):
        {statement}
run(much, "prog")
"""


@pytest.mark.parametrize("statement", ["print(i)", "click.echo(i)", "__import__('rich').print(i)"])
def test_a_reader_that_goes_away_ends_the_program_quietly(statement: str, tmp_path: Path) -> None:
    script = tmp_path / "much.py"
    script.write_text(PIPE.format(statement=statement))
    root = Path(__file__).parents[2]
    with subprocess.Popen(
        [sys.executable, str(script)],
        env={"PYTHONPATH": str(root)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.readline()
        process.stdout.close()
        assert process.stderr.read() == b""
        assert process.wait() == 141


def test_a_full_disk_is_a_complaint() -> None:
    if not Path("/dev/full").exists():
        pytest.skip("needs /dev/full")
    with open("/dev/full", "w") as full:
        result = subprocess.run(
            [sys.executable, "-m", "gains", "list", "--json"],
            cwd=Path(__file__).parents[2],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert result.returncode == 2
    assert result.stderr == "gains: error: No space left on device\n"


def test_json_takes_arrays_paths_and_numbered_keys(capsys: pytest.CaptureFixture[str]) -> None:
    print_json({"a": np.eye(2)[:, :1], "T": np.arange(4.0).reshape(2, 2).T, "p": Path("x"), 3: float("nan")})
    out = capsys.readouterr().out
    assert out.endswith("}\n")
    assert json.loads(out) == {"a": [[1.0], [0.0]], "T": [[0.0, 2.0], [1.0, 3.0]], "p": "x", "3": None}


def test_json_refuses_what_it_cannot_write() -> None:
    with pytest.raises(TypeError):
        print_json({"a": 1j})
