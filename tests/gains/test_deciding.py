"""``gains certify``, ``bound``, ``witness`` and ``schedule`` by the exact method, run as a person runs them."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gains.__main__ import cli
from gains.command import run
from gains.model import Gains, Schedule, spectral_radius
from gains.store import load_gains, load_law, save_gains
from gains.verify import verified
from gains.witnessfile import read_witness
from tests.gains.lifted import full_state
from tests.gains.test_decide import scalar
from tests.gains.test_verify_switched import saved_model

HIRM = load_gains("hirm-paper")

CERTIFY_KEYS = {
    "verdict", "eta", "eta_lower", "d_min", "d_max", "transitions", "method", "delta_max", "margin", "witness",
    "growth_per_sample", "seconds",
}  # fmt: skip
BOUND_KEYS = {
    "d_min", "d_max", "seconds_of_latency", "limit", "method", "transitions", "refuted", "seconds",
}  # fmt: skip


def said(capsys: pytest.CaptureFixture[str], *line: str) -> tuple[int, str, str]:
    """Exit code, standard output and standard error."""
    before, sys.argv = sys.argv, ["gains", *line]
    try:
        with pytest.raises(SystemExit) as ended:
            run(cli, "gains")
    finally:
        sys.argv = before
    captured = capsys.readouterr()
    return int(ended.value.code or 0), captured.out, captured.err


def answer(capsys: pytest.CaptureFixture[str], *line: str) -> tuple[int, dict[str, Any], str]:
    code, out, err = said(capsys, *line, "--json")
    assert len(out.splitlines()) == 1
    return code, json.loads(out), err


def saved(gains: Gains, folder: Path, name: str = "mine.toml") -> Path:
    save_gains(folder / name, gains, saved_model(gains.model, folder / "model.toml"))
    return folder / name


# -- certify


def test_certify_proves_eta_and_a_delay_sequence_that_comes_near(capsys: pytest.CaptureFixture[str]) -> None:
    code, found, _ = answer(capsys, "certify", "hirm-paper", "--delay", "1:2")
    assert code == 0
    assert found.keys() >= CERTIFY_KEYS
    assert (found["verdict"], found["method"], found["transitions"]) == ("stable", "exact", "any")
    assert (found["d_min"], found["d_max"], found["delta_max"]) == (1, 2, 0.0)
    assert found["eta"] == pytest.approx(0.1315, rel=0.005)
    assert 0.1287 * 0.999 < found["eta_lower"] <= found["eta"]
    assert found["margin"] > 0.0
    assert (found["witness"], found["growth_per_sample"]) == (None, None)
    assert found["eta_as_flown"]["unaligned"] > found["eta"]
    assert found["eta_as_flown"]["aligned"] > found["eta"]


def test_certify_writes_gains_whose_certificate_verifies(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "proved.toml"
    line = ["certify", "hirm-paper", "--delay", "1:2", "--delta", "0.15", "--no-flown", "-o", str(file)]
    code, found, _ = answer(capsys, *line)
    law = load_law(file)
    assert code == 0
    assert found["delta_max"] == 0.15
    assert found["eta_as_flown"] == {"unaligned": None, "aligned": None}
    assert verified(law).passed
    assert law.certificate is not None
    assert law.certificate["eta"] == found["eta"]
    assert (law.d_min, law.d_max) == (1, 2)


def test_memory_tightens_what_is_certified(capsys: pytest.CaptureFixture[str]) -> None:
    line = ["certify", "hirm-paper", "--delay", "1:2", "--no-flown", "--memory", "1"]
    _, found, _ = answer(capsys, *line)
    assert found["eta"] < 0.1312


def test_certify_answers_unstable_with_a_witness_and_exit_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "none.toml"
    code, found, err = answer(capsys, "certify", "hirm-paper", "--delay", "1:5", "-o", str(file))
    assert code == 1
    assert found.keys() >= CERTIFY_KEYS
    assert (found["verdict"], found["eta"], found["margin"]) == ("unstable", None, None)
    assert found["growth_per_sample"] == pytest.approx(growth(HIRM, found["witness"]), rel=1e-9)
    assert found["growth_per_sample"] >= 1.005
    assert not file.exists()
    assert f"{file} not written" in err


def test_certify_answers_undecided_with_a_reason_and_exit_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, found, _ = answer(capsys, "certify", "hirm-paper", "--delay", "1:2", "--delta", "1", "--no-flown")
    assert code == 1
    assert (found["verdict"], found["eta"], found["witness"]) == ("undecided", None, None)
    assert found["reason"]
    assert found["jsr_lower"] < found["jsr_upper"] < 1.0  # of the nominal loop


def test_a_loop_without_disturbance_and_reference_is_certified_without_eta(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = saved(scalar(0.5, 0.3), tmp_path)
    code, found, _ = answer(capsys, "certify", str(file), "-o", str(tmp_path / "proved.toml"))
    assert (code, found["verdict"], found["eta"], found["unbounded"]) == (0, "stable", None, True)
    assert verified(load_law(tmp_path / "proved.toml")).passed


def test_people_are_told_eta_the_latency_and_the_sequence(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = said(capsys, "certify", "hirm-paper", "--delay", "1:1", "--no-flown")
    assert code == 0
    assert "hirm-paper: stable for delays 1 to 1 (any), survives 25 ms" in out
    assert "0.1126" in out
    assert "verified" in out
    code, out, _ = said(capsys, "certify", "hirm-paper", "--delay", "1:5")
    assert code == 1
    assert "unstable" in out
    assert "1,1,2,3,4,5,5,5,5 grows 1.005023 per sample" in out


# -- bound


@pytest.mark.parametrize("transitions", ["any", "fifo"])
def test_bound_proves_the_published_window_and_refutes_the_next(
    transitions: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code, found, _ = answer(capsys, "bound", "pendulum-paper", "--transitions", transitions)
    assert code == 0
    assert found.keys() >= BOUND_KEYS
    assert (found["d_min"], found["d_max"], found["limit"]) == (1, 6, 20)
    assert (found["method"], found["transitions"]) == ("exact", transitions)
    assert found["seconds_of_latency"] == pytest.approx(0.18)
    assert found["refuted"].keys() == {"d_max", "witness", "growth_per_sample"}
    assert found["refuted"]["d_max"] == 7
    assert found["refuted"]["growth_per_sample"] == pytest.approx(
        growth(load_gains("pendulum-paper"), found["refuted"]["witness"]), rel=1e-9
    )


def test_bound_at_its_limit_refutes_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    code, found, _ = answer(capsys, "bound", "hirm-paper", "--limit", "3")
    assert (code, found["d_max"], found["refuted"]) == (0, 3, None)


def test_bound_without_end_is_said_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = saved(scalar(0.5, 0.3), tmp_path)
    code, found, _ = answer(capsys, "bound", str(file), "--limit", "5")
    assert (code, found["d_max"], found["seconds_of_latency"], found["refuted"]) == (0, "unbounded", None, None)
    _, out, _ = said(capsys, "bound", str(file), "--limit", "5")
    assert "every bounded delay" in out


def test_bound_of_nothing_is_null_and_exit_1(capsys: pytest.CaptureFixture[str]) -> None:
    code, found, _ = answer(capsys, "bound", "hirm-paper", "--d-min", "6", "--limit", "7")
    assert (code, found["d_max"], found["seconds_of_latency"]) == (1, None, None)
    assert found["refuted"]["witness"] == [6]


# -- witness


def growth(gains: Gains, delays: list[int] | tuple[int, ...]) -> float:
    """Growth per sample of a period, by the product over all past states."""
    full = full_state(gains, min(delays), max(delays))
    keep = slice(0, full.N - full.nr)
    whole = np.eye(full.N - full.nr)
    for d in delays:
        whole = full.F[full.index(d)][keep, keep] @ whole
    return float(spectral_radius(whole) ** (1.0 / len(delays)))


@pytest.mark.parametrize(
    ("name", "window", "transitions", "least"),
    [
        ("hirm-paper", "1:5", "any", 1.005),
        ("hirm-paper", "1:5", "fifo", 1.005),
        ("pendulum-paper", "1:7", "fifo", 1.001),
    ],
)
def test_witness_is_written_and_grows_as_it_says(
    name: str, window: str, transitions: str, least: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "witness.csv"
    line = ["witness", name, "--delay", window, "--transitions", transitions, "-o", str(file)]
    code, found, _ = answer(capsys, *line)
    read = read_witness(file)
    assert code == 0
    assert (found["verdict"], found["file"]) == ("unstable", str(file))
    assert list(read.delays) == found["witness"]
    assert read.growth_per_sample == found["growth_per_sample"] >= least
    assert read.growth_per_sample == pytest.approx(growth(load_gains(name), read.delays), rel=1e-9)
    assert (read.gains, read.transitions, f"{read.d_min}:{read.d_max}") == (name, transitions, window)
    if transitions == "fifo":
        assert all(after <= d + 1 for d, after in pairwise([*read.delays, read.delays[0]]))


def test_no_witness_is_written_where_the_loop_is_proved(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "witness.csv"
    code, found, _ = answer(capsys, "witness", "hirm-paper", "--delay", "1:3", "-o", str(file))
    assert (code, found["verdict"], found["witness"], found["file"]) == (1, "stable", None, None)
    assert not file.exists()


# -- schedule


def two_files(folder: Path) -> tuple[str, str]:
    assert HIRM.K2 is not None
    low = replace(HIRM, name="low", d_min=1, d_max=1)
    high = replace(HIRM, name="high", d_min=2, d_max=2, K1=0.7 * HIRM.K1, K2=0.7 * HIRM.K2)
    for own in (low, high):
        save_gains(folder / f"{own.name}.toml", own, "hirm")
    return str(folder / "low.toml"), str(folder / "high.toml")


def test_schedule_is_written_loaded_and_verified(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pushed = scalar(0.9, -0.2, 2)
    pushed = replace(pushed, model=replace(pushed.model, E=np.ones((1, 1))))
    low = saved(replace(pushed, d_max=1), tmp_path, "low.toml")
    high = saved(replace(pushed, d_min=2, K1=0.5 * pushed.K1), tmp_path, "high.toml")
    law, found = scheduled(capsys, str(low), str(high), tmp_path / "two.toml")
    assert np.array_equal(law.sets[1].K1, [[-0.1]])
    again, certified, _ = answer(capsys, "certify", str(tmp_path / "two.toml"))
    assert (again, certified["eta"]) == (0, pytest.approx(found["eta"], rel=1e-9))


@pytest.mark.long
def test_schedule_of_the_published_gains_is_certified_as_it_runs_too(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    low, high = two_files(tmp_path)
    law, found = scheduled(capsys, low, high, tmp_path / "two.toml")
    assert np.array_equal(law.sets[0].K1, HIRM.K1)
    assert found["eta_as_flown"]["aligned"] > found["eta"]


def scheduled(capsys: pytest.CaptureFixture[str], low: str, high: str, file: Path) -> tuple[Schedule, dict[str, Any]]:
    """The schedule for delays 1 and 2 that the command wrote, and its answer."""
    code, found, _ = answer(capsys, "schedule", high, low, "-o", str(file))
    law = load_law(file)
    assert code == 0
    assert found.keys() >= CERTIFY_KEYS
    assert (found["verdict"], found["d_min"], found["d_max"]) == ("stable", 1, 2)
    assert found["eta_lower"] <= found["eta"]
    assert isinstance(law, Schedule)
    assert [(own.d_min, own.d_max) for own in law.sets] == [(1, 1), (2, 2)]
    assert verified(law).passed
    assert law.certificate is not None
    assert law.certificate["eta"] == found["eta"]
    return law, found


def test_schedule_that_cannot_be_proved_is_not_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    low, high = two_files(tmp_path)
    save_gains(high, replace(load_gains(high), K1=3.0 * HIRM.K1), "hirm")
    file = tmp_path / "two.toml"
    code, found, _ = answer(capsys, "schedule", low, high, "-o", str(file))
    assert (code, found["verdict"]) == (1, "unstable")
    assert found["growth_per_sample"] > 1.0
    assert not file.exists()


# -- bad input


@pytest.mark.parametrize(
    ("line", "named"),
    [
        (["certify", "hirm-paper", "--delay", "3:1"], "--delay"),
        (["certify", "hirm-paper", "--delay", "1:2", "--memory", "9"], "--memory"),
        (["certify", "pendulum-paper", "--delta", "0.1"], "--delta"),
        (["certify", "hirm-paper", "--delta", "nan"], "--delta"),
        (["certify", "hirm"], "hirm"),
        (["certify", "no-such-gains"], "no-such-gains"),
        (["bound", "hirm-paper", "--d-min", "5", "--limit", "4"], "--limit"),
        (["bound", "hirm-paper", "--transitions", "lifo"], "--transitions"),
        (["witness", "hirm-paper", "-o", "w.csv"], "--delay"),
        (["witness", "hirm-paper", "--delay", "1:5"], "--output"),
        (["witness", "hirm-paper", "--delay", "1:5", "-o", "no/such/folder/w.csv"], "no/such/folder"),
        (["schedule", "-o", "s.toml"], "GAINS"),
        (["schedule", "hirm-paper", "pendulum-paper", "-o", "s.toml"], "one model"),
        (["schedule", "hirm-paper", "hirm-paper", "-o", "s.toml"], "windows"),
        (["certify", "pendulum-paper", "--delay", "1:1", "-o", "no/such/folder/c.toml"], "no/such/folder"),
        (["schedule", "pendulum-paper", "--delta", "0.1", "-o", "s.toml"], "--delta"),
    ],
)
def test_bad_input_is_one_line_and_exit_2(
    line: list[str], named: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = said(capsys, *line)
    complaints = [text for text in err.splitlines() if text.startswith("gains: error:")]
    assert code == 2
    assert out == ""
    assert len(complaints) == 1
    assert err.splitlines()[-1] == complaints[0]
    assert named in complaints[0]
