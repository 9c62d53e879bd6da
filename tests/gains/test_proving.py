"""The commands that prove and design, run as a person runs them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from gains.__main__ import cli
from gains.command import run
from gains.store import load_gains
from gains.verify import verified


def answer(capsys: pytest.CaptureFixture[str], *line: str) -> tuple[int, dict, str]:
    """Return exit code, the JSON object on standard output, and standard error."""
    with pytest.raises(SystemExit) as ended:
        _run(*line, "--json")
    captured = capsys.readouterr()
    return int(ended.value.code or 0), json.loads(captured.out), captured.err


def _run(*line: str) -> None:
    import sys

    before, sys.argv = sys.argv, ["gains", *line]
    try:
        run(cli, "gains")
    finally:
        sys.argv = before


def test_a_design_is_written_with_a_certificate_that_verifies(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    file = tmp_path / "mine.toml"
    code, said, _ = answer(
        capsys,
        "design",
        "hirm",
        "--delay",
        "1:2",
        "--method",
        "lyapunov",
        "--search",
        "quasi-newton",
        "--start",
        "hirm-paper",
        "-o",
        str(file),
    )
    gains = load_gains(file)
    assert code == 0
    assert (said["verdict"], said["file"], said["d_min"], said["d_max"]) == ("stable", str(file), 1, 2)
    assert said["eta"] < 0.2475  # the published gains prove that
    assert verified(gains).passed
    assert gains.certificate is not None
    assert gains.certificate["eta"] == said["eta"]
    np.testing.assert_array_equal(gains.K1, said["K1"])


def test_a_designed_gain_file_certifies_at_what_it_says(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    file = tmp_path / "mine.toml"
    _, designed, _ = answer(
        capsys,
        "design",
        "hirm",
        "--delay",
        "1:2",
        "--method",
        "lyapunov",
        "--search",
        "quasi-newton",
        "--start",
        "hirm-paper",
        "-o",
        str(file),
    )
    code, certified, _ = answer(capsys, "certify", str(file), "--method", "lyapunov")
    assert code == 0
    assert certified["eta"] == pytest.approx(designed["eta"], rel=1e-4)


def test_effort_costs_gain_and_saves_elevator(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    common = [
        "design",
        "hirm",
        "--delay",
        "1:2",
        "--method",
        "lyapunov",
        "--search",
        "quasi-newton",
        "--start",
        "hirm-paper",
    ]
    _, free, _ = answer(capsys, *common, "-o", str(tmp_path / "a.toml"))
    _, held, _ = answer(capsys, *common, "--weight", "effort", "0.01", "-o", str(tmp_path / "b.toml"))
    assert held["eta"] > free["eta"]
    assert np.linalg.norm(held["K1"]) < np.linalg.norm(free["K1"])
    assert held["objective"] > held["eta"]


def test_limits_bound_every_entry(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    line = [
        "design",
        "hirm",
        "--delay",
        "1:2",
        "--method",
        "lyapunov",
        "--search",
        "quasi-newton",
        "--start",
        "hirm-paper",
    ]
    _, said, _ = answer(capsys, *line, "--limit", "K1", "4", "--limit", "K2", "4", "-o", str(tmp_path / "a.toml"))
    assert said["eta"] is not None
    assert np.abs(said["K1"]).max() <= 4.0
    assert np.abs(said["K2"]).max() <= 4.0


def test_the_printed_method_says_why_it_cannot_design(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    file = tmp_path / "none.toml"
    code, said, _ = answer(capsys, "design", "hirm", "--delay", "1:2", "--method", "printed", "-o", str(file))
    assert code == 1
    assert said["verdict"] == "undecided"
    assert "eigenvalue" in said["reason"]
    assert not file.exists()


@pytest.mark.parametrize(
    ("line", "named"),
    [
        (["design", "hirm", "--delay", "3:1", "-o", "x.toml"], "--delay"),
        (["design", "hirm", "--delay", "1:2"], "--output"),
        (["design", "hirm", "--delay", "1:2", "-o", "no/such/folder/x.toml"], "no/such/folder"),
        (["design", "pendulum", "--delay", "1:2", "--delta", "0.1", "-o", "x.toml"], "delta_max"),
        (["design", "hirm", "--delay", "1:2", "--delta", "nan", "-o", "x.toml"], "--delta"),
        (["design", "hirm", "--delay", "1:2", "--start", "pendulum-paper", "-o", "x.toml"], "start"),
        (["design", "hirm-paper", "--delay", "1:2", "-o", "x.toml"], "hirm-paper"),
        (["certify", "hirm", "--delay", "1:2"], "hirm"),
    ],
)
def test_bad_input_is_one_line_and_exit_2(
    line: list[str], named: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        _run(*line)
    captured = capsys.readouterr()
    assert ended.value.code == 2
    assert captured.out == ""
    assert len(captured.err.splitlines()) == 1
    assert named in captured.err
