"""Campaigns as they are asked for: how the work is cut, and what the command says, writes and refuses."""

from __future__ import annotations

import re
import sys
import tempfile
import threading
import tomllib
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import orjson
import pyarrow.dataset as ds
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from scipy.linalg import expm

import sitl.__main__
from gains.command import run as run_command
from gains.store import load_gains, load_model, resolve
from gains.witnessfile import read_witness, sequence_of, write_witness
from sitl.campaign import parts as keeping
from sitl.campaign import run as running
from sitl.campaign.bounds import Bound
from sitl.campaign.conducting import describe
from sitl.campaign.engine import Columns
from sitl.campaign.job import Campaign
from sitl.campaign.parts import Parts, missing_ranges
from sitl.campaign.tasks import fly
from sitl.scenario import stored_scenarios
from tests.sitl.test_campaign_parts import campaign, equal, parts_in

DOCS = Path(__file__).parents[2] / "docs" / "campaigns.md"
DEG = np.pi / 180.0


class Said(NamedTuple):
    """How a command ended, and what it said."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> dict[str, Any]:
        assert self.err == ""
        found: dict[str, Any] = orjson.loads(self.out)
        return found


Command = Callable[..., Said]


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Command:
    """Give a function that runs ``sitl campaign`` in this process, in a folder of its own."""
    monkeypatch.chdir(tmp_path)

    def run_it(line: str, *more: str) -> Said:
        monkeypatch.setattr(sys, "argv", ["sitl", "campaign", *line.split(), *more])
        with pytest.raises(SystemExit) as ended:
            run_command(sitl.__main__.cli, "sitl")
        out, err = capsys.readouterr()
        assert isinstance(ended.value.code, int)
        return Said(ended.value.code, out, err)

    return run_it


def table_in(folder: Path) -> dict[str, Any]:
    """Return the columns as pyarrow's reader of whole folders has them, in its order."""
    table = ds.dataset(folder, format="parquet").to_table()
    return {name: table[name].to_numpy() for name in table.column_names}


SMALL = "--gains hirm-d6 --flights 200 --samples 100 --scheduler none"
"""Of gains with a certificate in their file, so that no eta is computed."""


# -- cutting


@settings(max_examples=50)
@given(st.lists(st.tuples(st.integers(0, 60), st.integers(0, 30)), max_size=10, unique=True), st.integers(1, 100))
def test_of_any_files_the_parts_that_count_and_the_missing_are_every_flight_once(
    pieces: list[tuple[int, int]], flights: int
) -> None:
    with tempfile.TemporaryDirectory() as place, pytest.MonkeyPatch.context() as patched:
        folder = Path(place)
        parts = Parts(folder, "of this campaign", {})
        patched.setattr(keeping, "_is_whole", lambda path, start, stop, _: int(path.read_text()) == stop - start > 0)
        for start, size in pieces:
            (folder / f"flights-{start:012d}-{start + size:012d}.parquet").write_text(str(size))
        found = parts.found(())
        assert parts.aside == len(list(folder.glob("_aside-*")))
        aside = list(folder.glob("_aside-*"))
        assert len(found) + len(aside) == len(pieces)  # nothing is deleted
        assert {part.path for part in found} == set(folder.glob("flights-*"))
    times = np.zeros(200, dtype=int)
    for part in found:
        times[part.start : part.stop] += 1
    assert times.max() <= 1
    for start, stop in missing_ranges(found, flights):
        assert start < stop <= flights
        times[start:stop] += 1
    assert (times[:flights] == 1).all()


@pytest.mark.parametrize("workers", [1, 2, 3])
@pytest.mark.parametrize(
    "kept",
    [[], [(0, 40)], [(7, 8), (100, 163), (400, 500)], [(0, 500)], [(300, 900)], [(600, 900)]],
    ids=lambda kept: f"{kept}",
)
def test_a_run_flies_what_is_missing_exactly_once_and_tells_of_each_flight(
    workers: int, kept: list[tuple[int, int]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job, lock, told = campaign(flights=500), threading.Lock(), list[int]()
    flown = np.zeros(900, dtype=int)

    def count(_: Campaign, start: int, stop: int) -> Columns:
        with lock:
            flown[start:stop] += 1
        return {"flight": np.arange(start, stop), "square": np.arange(start, stop) ** 2}

    parts, names = parts_in(tmp_path, job), {"flight": np.arange(1), "square": np.arange(1)}
    for start, stop in kept:
        parts.write(start, stop, count(job, start, stop))
    # a first flight, of which nothing is kept, compiles
    monkeypatch.setattr(running, "fly", lambda job, a, b: names if (a, b) == (0, 1) else count(job, a, b))
    monkeypatch.setattr(running, "_timed", lambda _job, ranges, _collected: (ranges, 1e-3))
    outcome = running.run(job, scheduler="none", workers=workers, parts=parts_in(tmp_path, job), told=told.append)
    assert (flown[:500] == 1).all()
    assert outcome.flown == 500 - sum(min(stop, 500) - min(start, 500) for start, stop in kept)
    assert sum(told) == 500
    assert outcome.columns["flight"].tolist() == list(range(500))
    assert outcome.columns["square"].tolist() == [n * n for n in range(500)]


@pytest.mark.parametrize("scheduler", ["none", "local"])
@pytest.mark.parametrize("workers", [1, 3])
def test_threads_fly_what_each_flight_alone_is_to_the_last_bit(scheduler: str, workers: int) -> None:
    law = load_gains("pendulum-paper")
    job = campaign(law=law, plant=law.model, plant_name="pendulum", flights=301, samples=150, x0=0.01)
    alone = [fly(job, n, n + 1) for n in range(job.flights)]
    expected = {name: np.concatenate([one[name] for one in alone]) for name in alone[0]}
    outcome = running.run(job, scheduler=scheduler, workers=workers)
    assert equal(outcome.columns, expected)
    assert len(np.unique(expected["rms_error"])) == 301


def test_an_error_in_a_thread_is_not_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(job: Campaign, start: int, stop: int) -> Columns:
        if start <= 500 < stop:
            raise ArithmeticError("flight 500")
        return fly(job, start, stop)

    monkeypatch.setattr(running, "fly", fail)
    with pytest.raises(ArithmeticError, match="flight 500"):
        running.run(campaign(), scheduler="none", workers=2)


# -- the folder


def test_the_folder_has_the_columns_of_the_manual_and_a_row_for_each_flight_in_order(
    command: Command, tmp_path: Path
) -> None:
    text = DOCS.read_text()
    manual = set(re.findall(r"`(\w+)`", text[text.index("\nColumns:") : text.index("\n`--json`")]))
    assert len(manual) == 20
    assert command(f"{SMALL} --x0 0.01 -o out").code == 0
    columns = table_in(tmp_path / "out")
    assert columns.keys() == manual - {"delta_amplitude"}
    assert columns["flight"].tolist() == list(range(200))
    whole = pq.read_table(tmp_path / "out")
    assert equal(columns, {name: whole[name].to_numpy() for name in whole.column_names})
    assert np.isfinite(columns["rms_error"]).all()
    assert columns["error_norm"] == pytest.approx(columns["rms_error"] * np.sqrt(100), rel=1e-12)
    assert columns["gain"] == pytest.approx(columns["error_norm"] / columns["input_norm"], rel=1e-12)
    assert (columns["diverged_at"] == -1).all()
    assert not columns["diverged"].any()
    assert set(columns["d_max"]) == {6}
    assert columns["d_mean"].mean() == pytest.approx(3.5, abs=5.0 * np.sqrt(35.0 / 12.0 / 200 / 100))


def test_the_command_goes_on_with_more_flights_and_flies_none_again(command: Command, tmp_path: Path) -> None:
    first = command(f"{SMALL} --json -o out").json
    there = {path.name: path.read_bytes() for path in (tmp_path / "out").glob("flights-*")}
    more = command(f"{SMALL} --flights 333 --json -o out").json
    assert (first["flown_now"], more["flown_now"], more["flights"]) == (200, 133, 333)
    assert {name: (tmp_path / "out" / name).read_bytes() for name in there} == there
    again = command(f"{SMALL} --flights 333 -o out")
    assert again.code == 0
    assert "were there already" in again.out
    command(f"{SMALL} --flights 333 --json -o whole")
    assert equal(table_in(tmp_path / "out"), table_in(tmp_path / "whole"))


def test_after_damage_the_same_command_has_the_same_rows(command: Command, tmp_path: Path) -> None:
    told = command(f"{SMALL} --json -o out").json
    expected = table_in(tmp_path / "out")
    [victim, *_] = sorted((tmp_path / "out").glob("flights-*"))
    rows = pq.read_metadata(victim).num_rows
    victim.write_bytes(victim.read_bytes()[:-20])
    (tmp_path / "out" / ".flights-000000000064-000000000128.4711.tmp").write_bytes(b"PAR1")
    again = command(f"{SMALL} --json -o out").json
    assert (again["flown_now"], again["put_aside"]) == (rows, 1)
    passing = {"flown_now", "put_aside", "seconds", "plant_steps_per_s", "workers"}
    assert {name: told[name] for name in told.keys() - passing} == {name: again[name] for name in told.keys() - passing}
    assert equal(table_in(tmp_path / "out"), expected)


# -- what is said


def test_the_numbers_of_the_json_are_those_of_the_rows(command: Command, tmp_path: Path) -> None:
    said = command(f"{SMALL} --threshold 0.2deg --json -o out")
    told, columns = said.json, table_in(tmp_path / "out")
    assert told.keys() >= {"flights", "samples", "diverged", "max_gain", "eta", "rms_error_rad", "seconds",
                           "plant_steps_per_s"}  # fmt: skip
    assert told.keys() >= {"failure_probability", "above_eta", "growth_per_sample", "worst_flight", "statistics"}
    failed = int((columns["max_error"] > 0.2 * DEG).sum())
    assert 0 < failed < 200
    assert said.code == 1
    exact = stats.binomtest(failed, 200).proportion_ci(0.95, "exact")
    probability = told["failure_probability"]
    assert (probability["count"], probability["total"]) == (failed, 200)
    assert (probability["low"], probability["high"]) == pytest.approx(exact, rel=1e-9)
    assert (told["flights"], told["samples"], told["seed"], told["diverged"]) == (200, 100, 1, 0)
    assert told["max_gain"] == columns["gain"].max()
    assert told["worst_flight"] == columns["gain"].argmax()
    for p, value in told["rms_error_rad"].items():
        assert value == np.quantile(columns["rms_error"], float(p), method="inverted_cdf")
    assert told["max_gain"] < told["eta"]
    assert (told["above_eta"], told["growth_per_sample"]) == (0, None)


@pytest.mark.parametrize(("above", "code"), [(1.001, 0), (0.999, 1)])
def test_the_exit_code_turns_at_the_largest_error(command: Command, above: float, code: int, tmp_path: Path) -> None:
    assert command(f"{SMALL} --json -o out").code == 0
    threshold = above * float(table_in(tmp_path / "out")["max_error"].max())
    said = command(f"{SMALL} --json -o out --threshold {threshold!r}")
    assert (said.code, said.json["failure_probability"]["count"]) == (code, code)


def test_a_gain_above_eta_is_a_failure_inside_the_window_and_none_outside(command: Command, tmp_path: Path) -> None:
    line = "--gains hirm-paper --delay 1:4 --flights 64 --samples 200 --scheduler none --json"
    outside = command(f"{line} --delays geometric:30 -o out")
    columns, eta = table_in(tmp_path / "out"), outside.json["eta"]
    above = columns["gain"] > eta
    assert above.any()
    assert (columns["outside"][above] > 0.0).all()
    assert (outside.code, outside.json["above_eta"], outside.json["diverged"]) == (0, 0, 0)


def test_a_witness_diverges_as_its_file_predicts_and_ends_with_1(command: Command) -> None:
    path = stored_scenarios()["witness-pendulum"].with_name("witness-pendulum.csv")
    line = "--gains pendulum-paper --delay 1:7 --transitions fifo --gust none --x0 0.005 --samples 20000 --flights 32"
    said = command(f"{line} --scheduler none --json --delays", f"cycle:{path}")
    told, written = said.json, float(re.findall("growth_per_sample: (.*)", path.read_text())[0])
    assert (said.code, told["diverged"], told["max_gain"]) == (1, 32, None)
    assert told["growth_per_sample"]["predicted"] == pytest.approx(written, rel=1e-9)
    assert np.log(told["growth_per_sample"]["measured"]) == pytest.approx(np.log(written), rel=3e-3)
    assert told["failure_probability"]["count"] == 32
    calm = command(f"{line} --scheduler none --json --delays hold:0.5")
    assert (calm.code, calm.json["diverged"], calm.json["growth_per_sample"]) == (0, 0, None)


def test_growth_is_told_of_the_plant_that_flies_where_it_grows(command: Command, tmp_path: Path) -> None:
    sequence = tmp_path / "four.csv"
    write_witness(sequence, sequence_of((4,), 0.025, "hirm-paper", "hirm"))
    text = resolve("hirm").read_text()
    assert "[actuator]" in text
    weak = re.sub(r"(?m)^B = .*$", "B = [[0.0], [0.0], [0.0]]", text)
    assert weak != text
    (tmp_path / "weak.toml").write_text(weak)
    line = f"--gains hirm-paper --flights 8 --samples 60 --json --scheduler none --delays cycle:{sequence} --plant"
    open_loop = command(f"{line} weak.toml").json["growth_per_sample"]
    eigenvalues = np.linalg.eigvals(load_model(str(tmp_path / "weak.toml")).A)
    assert open_loop["predicted"] == pytest.approx(np.abs(eigenvalues).max(), rel=1e-9)
    assert command(f"{line} weak.toml --limits --worst w.csv").json["growth_per_sample"]["predicted"] is None
    assert read_witness(tmp_path / "w.csv").growth_per_sample is None
    stable = command(f"{line} hirm").json["growth_per_sample"]
    assert stable["predicted"] < 1.0
    assert stable["measured"] is None  # the largest |x| so far cannot fall


def test_the_file_of_the_worst_flight_has_the_largest_gain_in_a_plain_loop(command: Command, tmp_path: Path) -> None:
    line = "--gains hirm-paper --delays geometric:3 --gust step:2deg --reference none --flights 200 --samples 100"
    told = command(f"{line} --scheduler none --json --worst worst.csv -o out").json
    witness = read_witness(tmp_path / "worst.csv")
    assert len(witness.delays) == 100
    plant = tomllib.loads(resolve("hirm").read_text())["plant"]
    nx = 3
    both = np.zeros((nx + 2, nx + 2))  # zero-order hold of u and w
    both[:nx] = np.hstack([np.array(plant[name], dtype=float) for name in "ABE"]) * 0.025
    held = expm(both)[:nx]
    K1 = np.array(tomllib.loads(resolve("hirm-paper").read_text())["K1"])
    x, errors = [np.zeros(nx)], []
    for k, d in enumerate(witness.delays):
        u = K1 @ x[k - d] if d <= k else np.zeros(1)
        errors.append(np.array(plant["C"]) @ x[k])
        x.append(held[:, :nx] @ x[k] + held[:, nx] * u + held[:, nx + 1] * 2.0 * DEG)
    gain = np.linalg.norm(errors) / (2.0 * DEG * np.sqrt(100))
    columns = table_in(tmp_path / "out")
    assert told["max_gain"] == pytest.approx(gain, rel=1e-9)
    assert columns["gain"][told["worst_flight"]] == columns["gain"].max()
    assert np.sort(columns["gain"])[-2] < gain * (1.0 - 1e-6)  # no other is as bad
    assert np.mean(witness.delays) == columns["d_mean"][told["worst_flight"]]


def test_several_gains_meet_the_same_draws_and_are_compared_in_pairs(command: Command, tmp_path: Path) -> None:
    line = "--gains hirm-d4 --gains hirm-paper --gains hirm-d6 --delay 1:4 --flights 300 --samples 100 --scheduler none"
    told = command(f"{line} --json -o out").json
    names = ["hirm-d4", "hirm-paper", "hirm-d6"]
    tables = {name: table_in(tmp_path / "out" / name) for name in names}
    for name in ("d_mean", "changes", "gust_amplitude", "gust_period_s", "reference_amplitude", "input_norm"):
        assert len({tables[which][name].tobytes() for which in names}) == 1
    assert [one["gains"] for one in told["campaigns"]] == names
    assert [one["max_gain"] for one in told["campaigns"]] == [tables[name]["gain"].max() for name in names]
    assert told["gains"] == "hirm-d4"
    assert [(pair["a"], pair["b"]) for pair in told["pairs"]] == [(names[0], names[1]), (names[0], names[2]),
                                                                  (names[1], names[2])]  # fmt: skip
    for pair in told["pairs"]:
        a, b = tables[pair["a"]]["rms_error"], tables[pair["b"]]["rms_error"]
        ratio = np.log(a / b)
        assert pair["better"]["count"] == (a < b).sum()
        assert pair["worse"]["count"] == (a > b).sum()
        assert pair["log_ratio"]["value"] == pytest.approx(
            np.quantile(ratio, 0.5, method="inverted_cdf"), rel=1e-9, abs=1e-15
        )
        assert pair["p_signed_rank"] == pytest.approx(stats.wilcoxon(ratio).pvalue, rel=1e-6, abs=1e-300)


class Links(HTMLParser):
    """What a page would fetch or lead to."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "action", "data")]


def test_the_page_needs_no_network(command: Command, tmp_path: Path) -> None:
    assert command(f"{SMALL} --gains hirm-d4 --delay 1:4 --page page.html").code == 0
    page = (tmp_path / "page.html").read_text()
    links = Links()
    links.feed(page)
    assert [link for link in links.found if not link.startswith(("#", "data:"))] == []
    [policy] = re.findall('http-equiv="Content-Security-Policy" content="([^"]*)"', page)
    directives = {name: set(sources) for name, *sources in (part.split() for part in policy.split(";"))}
    assert directives["default-src"] == {"'none'"}
    assert set().union(*directives.values()) <= {"'none'", "'unsafe-inline'", "'unsafe-eval'", "data:", "blob:"}
    assert "hirm-d4" in page
    assert "hirm-d6" in page
    assert "200" in page


def test_without_json_the_tables_say_the_same_failures(command: Command) -> None:
    said = command(f"{SMALL} --threshold 0.2deg")
    failed = command(f"{SMALL} --threshold 0.2deg --json").json["failure_probability"]["count"]
    assert (said.code, said.err) == (1, "")
    assert re.search(rf"\b{failed}\b", said.out)


def test_errors_have_the_unit_of_the_state_that_the_output_is() -> None:
    def unit_of(**changes: Any) -> str:
        job = campaign()
        told = describe("hirm-paper", replace(job, plant=replace(job.plant, **changes)), "uniform", Bound(None, ""))
        return str(told["unit"])

    assert unit_of() == "rad"
    assert unit_of(C=np.array([[0.0, 1.0, 0.0]])) == "rad/s"
    assert unit_of(states=("alpha", "q", "theta"), sensors={}) == ""
    for C, D in (([[0.0, 0.0, 2.0]], 0.0), ([[1.0, 0.0, 1.0]], 0.0), ([[0.0, 0.0, 1.0]], 1.0)):
        assert unit_of(C=np.array(C), D=np.array([[D]])) == ""


# -- what is refused


def with_other_reference(folder: Path) -> str:
    """Return a gain file of a model that is hirm but for its reference, and write that model."""
    model, gains = resolve("hirm").read_text(), resolve("hirm-paper").read_text()
    (folder / "fast.toml").write_text(model.replace("Br = [[0.0056], [0.1190]", "Br = [[0.0066], [0.1190]"))
    return gains.replace('model = "hirm"', 'model = "fast.toml"')


@pytest.mark.parametrize(
    ("line", "named"),
    [
        ("", "--gains"),
        ("--gains nowhere", "nowhere"),
        ("--gains hirm", "gain file"),
        ("--gains hirm-smith", "hirm-smith"),
        (f"{SMALL} --flights 0", "--flights"),
        (f"{SMALL} --flights 1000000000001", "--flights"),
        (f"{SMALL} --flights 40000000", "-o"),
        (f"{SMALL} --samples 1000001", "--samples"),
        (f"{SMALL} --delay 3:1", "3:1"),
        (f"{SMALL} --delay 1:1000", "--delay"),
        (f"{SMALL} --delays hold:1", "hold:1"),
        (f"{SMALL} --delays cycle:none.csv", "none.csv"),
        (f"{SMALL} --delays uniform --link lte", "--link"),
        (f"{SMALL} --link pigeon", "--link"),
        (f"{SMALL} --up loss=2", "loss"),
        (f"{SMALL} --gust sine", "sine"),
        (f"{SMALL} --threshold 0deg", "--threshold"),
        (f"{SMALL} --threshold nan", "--threshold"),
        (f"{SMALL} --x0 inf", "--x0"),
        (f"{SMALL} --seed -1", "--seed"),
        (f"{SMALL} --workers 0", "--workers"),
        (f"{SMALL} --plant pendulum", "pendulum"),
        (f"{SMALL} --plant sixdof:hirm --delta 0.1", "--delta"),
        (f"{SMALL} --wind dryden:moderate", "wind"),
        (f"{SMALL} --page no/page.html", "no/page.html"),
        (f"{SMALL} --worst no/worst.csv", "no/worst.csv"),
        (f"{SMALL} -o file/out", "file/out"),
        (f"{SMALL} -o file", "file"),
        (f"{SMALL} -o foreign", "other files"),
        (f"{SMALL} -o other", "another"),
        (f"{SMALL} --gains {' --gains '.join(f'copy{n}.toml' for n in range(6))}", "at most 6"),
        ("--gains a/same.toml --gains b/same.toml --flights 9 -o out", "same twice"),
        (f"{SMALL} --gains hirm-d4 --gains hirm-d4", "hirm-d4 twice"),
        (f"{SMALL} --gains faster.toml", "same reference model"),
        (f"{SMALL} --gust sine:5deg..10", "LOW..HIGH"),
        (f"{SMALL} --threshold=-1deg", "a number above 0, such as"),
        (f"{SMALL} --plant sixdof:hirm --wind dryden:moderat", "light, moderate, severe"),
        (f"{SMALL} --scheduler tcp://127.0.0.1:9 -o out", "tcp://127.0.0.1:9"),
    ],
)
def test_bad_input_ends_with_2_and_one_line_that_names_it(
    line: str, named: str, command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in (*(f"copy{n}.toml" for n in range(6)), "a/same.toml", "b/same.toml"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(resolve("hirm-paper").read_bytes())
    (tmp_path / "faster.toml").write_text(with_other_reference(tmp_path))
    (tmp_path / "file").write_text("a file")
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "thesis.tex").write_text("work of years")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "_campaign.json").write_bytes(orjson.dumps({"identity": 64 * "0"}))

    def refuse(*_: object) -> Columns:
        raise AssertionError("flown before everything was checked")

    monkeypatch.setattr(running, "fly", refuse)
    said = command(line)
    assert (said.code, said.out) == (2, "")
    assert said.err.startswith("sitl: error: ")
    assert said.err.index("\n") == len(said.err) - 1
    assert named in said.err
    assert [path.name for path in (tmp_path / "foreign").iterdir()] == ["thesis.tex"]
    assert not (tmp_path / "out" / "_campaign.json").exists()


@pytest.mark.parametrize("missing", ["numba", "pyarrow"])
def test_without_what_compiles_and_writes_the_command_says_what_to_install(
    missing: str, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, missing, None)
    said = command(SMALL)
    assert (said.code, said.out) == (2, "")
    assert "pip install 'lagproof[campaign]'" in said.err
    assert said.err.count("\n") == 1


def test_without_dask_a_scheduler_is_refused_and_one_process_flies(
    command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert command(f"{SMALL} --json").code == 0
    said = command(SMALL.replace("none", "tcp://127.0.0.1:9"))
    assert (said.code, said.out) == (2, "")
    assert "pip install 'lagproof[campaign]'" in said.err
    assert said.err.count("\n") == 1
