"""The ``gains`` command."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner

from gains.__main__ import cli
from gains.certificate import claim_hash, gains_hash, model_hash
from gains.model import Schedule
from gains.store import Stored, load_gains, load_model, resolve, save_gains
from gains.verify import verified

ROOT = Path(__file__).parents[2]


def invoke(*arguments: str) -> str:
    result = CliRunner().invoke(cli, arguments, prog_name="gains", catch_exceptions=False)
    assert result.exit_code == 0
    assert result.stderr == ""
    return result.stdout


def process(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "gains", *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


def test_list_names_everything_stored() -> None:
    text = invoke("list")
    entries = json.loads(invoke("list", "--json"))["stored"]
    assert len(entries) == 15
    for entry in entries:
        assert entry["name"] in text
        assert Path(entry["path"]).is_file()
        assert entry["kind"] in ("model", "gains")


@pytest.mark.parametrize("name", ["hirm", "hirm-printed", "pendulum", "pendulum-exact"])
def test_show_json_of_a_model_is_the_model(name: str) -> None:
    shown, model = json.loads(invoke("show", name, "--json")), load_model(name)
    assert (shown["kind"], shown["name"], shown["Ts"]) == ("model", name, model.Ts)
    for key in "ABECD":
        assert shown[key] == getattr(model, key).tolist()
    assert shown["sensors"] == model.sensors
    assert (shown["reference"] is None) == (model.reference is None)
    assert max(value["modulus"] for value in shown["eigenvalues"]) == shown["spectral_radius"]


def test_the_pendulum_is_shown_unstable() -> None:
    assert json.loads(invoke("show", "pendulum", "--json"))["spectral_radius"] == pytest.approx(1.1329, abs=1e-4)
    assert "spectral radius 1.1329" in invoke("show", "pendulum")


def test_show_json_of_gains_is_the_gains() -> None:
    shown, gains = json.loads(invoke("show", "hirm-paper", "--json")), load_gains("hirm-paper")
    assert shown == {
        "kind": "gains", "name": "hirm-paper", "model": "hirm", "Ts": 0.025, "d_min": 1, "d_max": 4,
        "K1": gains.K1.tolist(), "K2": gains.K2.tolist() if gains.K2 is not None else None,
        "certificate": "none", "conservative": None, "controller": "law",
    }  # fmt: skip


def test_conservative_gains_are_shown_with_their_own_certificate() -> None:
    text = invoke("show", "hirm-d3")
    line = "conservative: hirm-d6, delay 1 to 6 samples (25 to 150 ms), certificate verified: eta 0.2079"
    assert [shown.startswith(line) for shown in text.splitlines()].count(True) == 1
    assert "conservative" not in invoke("show", "hirm-d6")
    shown, wide = (json.loads(invoke("show", name, "--json")) for name in ("hirm-d3", "hirm-d6"))
    keys = ("name", "d_min", "d_max", "K1", "K2", "certificate")
    assert shown["conservative"] == {key: wide[key] for key in keys}


def conservative_pair(folder: Path) -> Path:
    """The published gains for delays 1 to 2, their conservative ones for 1 to 4 in the file beside them."""
    folder.mkdir()
    paper = load_gains("hirm-paper")
    save_gains(folder / "wide.toml", paper, "hirm")
    narrow = replace(paper, d_max=2, conservative=paper, conservative_file=folder / "wide.toml")
    save_gains(folder / "g.toml", narrow, "hirm")
    return folder / "g.toml"


def test_certified_gains_keep_their_conservative_ones(tmp_path: Path) -> None:
    file, path = conservative_pair(tmp_path / "from"), tmp_path / "proved.toml"
    for delay in ("1:3", "2:2"):
        result = process("certify", str(file), "--delay", delay, "--method", "lyapunov", "-o", str(path))
        assert result.returncode == 0
        assert 'conservative = "from/wide.toml"\n' in path.read_text()
        gains = load_gains(path)
        assert gains.conservative is not None
        assert (gains.conservative.d_max, verified(gains).passed) == (4, True)


def test_a_window_that_conservative_gains_do_not_hold_is_not_written(tmp_path: Path) -> None:
    file, path = conservative_pair(tmp_path / "from"), tmp_path / "proved.toml"
    result = process("certify", str(file), "--delay", "0:2", "--method", "lyapunov", "-o", str(path))
    assert result.returncode == 2
    asked = "gains for delays from 0 or less to 3 or more"
    assert result.stderr.endswith(
        f"gains: error: {path}: conservative: expected {asked}, found hirm-paper, for 1 to 4\n"
    )
    assert not path.exists()


def test_show_prints_matrices_with_the_names_of_the_states() -> None:
    text = invoke("show", "hirm")
    for part in ("alpha_rad", "0.02470026", "AOA_SSA.AOA", "spectral radius", "100.23 m/s at 1600 m", "0.15"):
        assert part in text
    assert "110.6827" in invoke("show", "pendulum-paper")
    text = invoke("show", "hirm-paper")
    for part in ("3.3877", "-3.2382", "delay 1 to 4 samples (25 to 100 ms)", "certificate: none"):
        assert part in text


def test_a_certificate_is_verified_before_it_is_shown_as_one(tmp_path: Path) -> None:
    path, text = tmp_path / "g.toml", resolve("hirm-paper").read_text()
    gains = load_gains("hirm-paper")
    parts = {"model": model_hash(gains.model), "gains": gains_hash(gains.K1, gains.K2)}
    parts["certificate"] = claim_hash({"method": "other"})
    hashes = f"sha256 = {{{', '.join(f'{key} = {json.dumps(value)}' for key, value in parts.items())}}}\n"
    path.write_text(text + f'[certificate]\nmethod = "other"\n{hashes}')
    shown = "present, not verified: method 'other' cannot be verified by this version"
    assert f"certificate: {shown}" in invoke("show", str(path))
    assert json.loads(invoke("show", str(path), "--json"))["certificate"] == shown


def test_certify_proves_writes_and_show_verifies(tmp_path: Path) -> None:
    path = tmp_path / "proved.toml"
    result = process(
        "certify", "hirm-paper", "--delay", "1:3", "--delta", "0.15", "--method", "lyapunov", "--json", "-o", str(path)
    )
    assert result.returncode == 0
    answer = json.loads(result.stdout)
    assert list(answer) == [
        "verdict", "eta", "eta_lower", "d_min", "d_max", "transitions", "method", "delta_max", "margin", "witness",
        "growth_per_sample", "seconds", "reason",
    ]  # fmt: skip
    assert answer["verdict"] == "stable"
    assert answer["eta"] == pytest.approx(1.015, rel=0.01)
    assert (answer["d_min"], answer["d_max"], answer["delta_max"]) == (1, 3, 0.15)
    assert answer["margin"] > 0
    assert "certifying" in result.stderr
    gains = load_gains(path)
    assert (gains.d_min, gains.d_max) == (1, 3)
    assert verified(gains).passed
    assert "certificate: verified: eta 1.01469, ||Delta|| <= 0.15" in invoke("show", str(path))


def test_certify_undecided_exits_1_and_writes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "g.toml"
    result = process("certify", "hirm-paper", "--method", "lyapunov", "--json", "-o", str(path))
    assert result.returncode == 1
    answer = json.loads(result.stdout)
    assert (answer["verdict"], answer["eta"], answer["margin"], answer["d_max"]) == ("undecided", None, None, 4)
    assert "sufficient" in answer["reason"]
    assert "not written" in result.stderr
    assert not path.exists()
    result = process("certify", "hirm-paper", "--method", "printed", "--delay", "1:1")
    assert result.returncode == 1
    assert "eigenvalue" in result.stdout or "spectral radius" in result.stdout


def test_bound_finds_the_largest_delay() -> None:
    answer = json.loads(process("bound", "pendulum-paper", "--method", "lyapunov", "--json").stdout)
    assert list(answer) == [
        "d_min", "d_max", "seconds_of_latency", "limit", "method", "transitions", "refuted", "seconds",
    ]  # fmt: skip
    assert (answer["d_max"], answer["limit"], answer["method"], answer["refuted"]) == (5, 20, "lyapunov", None)
    assert answer["seconds_of_latency"] == pytest.approx(0.15)
    answer = json.loads(process("bound", "pendulum-paper", "--method", "constant", "--json").stdout)
    assert answer["d_max"] == 7
    assert (answer["refuted"]["d_max"], answer["refuted"]["witness"]) == (8, [8])
    assert answer["refuted"]["growth_per_sample"] == pytest.approx(1.0087, abs=1e-4)
    result = process("bound", "pendulum-paper", "--d-min", "6", "--method", "lyapunov")
    assert result.returncode == 1
    assert "none from 6" in result.stdout


@pytest.mark.parametrize(
    ("arguments", "stderr"),
    [
        (["certify", "hirm-paper", "--delay", "3"], "--delay: expected MIN:MAX in samples, such as 1:3, found '3'"),
        (["certify", "hirm-paper", "--delay", "3:1"], "--delay: expected MIN <= MAX <= 1000, found 3:1"),
        (
            ["certify", "hirm-paper", "--delay", "0:0", "--method", "lyapunov"],
            "--delay: expected a window up to at least 1 sample, found 0:0",
        ),
        (["certify", "pendulum-paper", "--delta", "0.1"], "expected 0, as model pendulum has no [uncertainty]"),
        (["certify", "hirm"], "expected a gain file (model, K1), found a model file"),
        (["bound", "hirm-paper", "--d-min", "5", "--limit", "4"], "--limit: expected at least d_min (5), found 4"),
    ],
)
def test_bad_input_of_the_proofs_exits_2_with_one_line(arguments: list[str], stderr: str) -> None:
    result = process(*arguments)
    assert result.returncode == 2
    assert result.stdout == ""
    assert stderr in result.stderr
    assert result.stderr.count("\n") == 1


def test_names_in_files_are_shown_as_they_are(tmp_path: Path) -> None:
    path = tmp_path / "m.toml"
    path.write_text(resolve("pendulum").read_text().replace('name = "pendulum"', 'name = "[red]x:smile:"'))
    assert "[red]x:smile:" in invoke("show", str(path))


@pytest.mark.parametrize("arguments", [["--help"], ["-h"], ["list", "--help"], ["show", "--help"]])
def test_help_is_everywhere(arguments: list[str]) -> None:
    assert invoke(*arguments).startswith("Usage: gains")


def test_version_is_printed() -> None:
    assert invoke("--version").startswith("gains ")


@pytest.mark.parametrize(
    ("arguments", "stderr"),
    [
        (["show", "hirn"], "hirn: expected a stored name or a file, found neither; did you mean hirm?"),
        (["show"], "Missing argument 'NAME'. (see 'gains show --help')"),
        ([], "expected a command, found none (see 'gains --help')"),
    ],
)
def test_bad_input_exits_2_with_one_line(arguments: list[str], stderr: str) -> None:
    result = process(*arguments)
    assert result.returncode == 2
    assert result.stdout == ""
    assert result.stderr == f"gains: error: {stderr}\n"


def test_a_malformed_file_exits_2_with_one_line(tmp_path: Path) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(resolve("hirm").read_text().replace("B = [[-0.113], [-3.259], [0.0]]", "B = [[1], [2]]"))
    result = process("show", str(path))
    assert result.returncode == 2
    assert result.stderr == f"gains: error: {path}: plant.B: expected 3 rows, found 2\n"


def test_success_exits_0_and_writes_nothing_to_stderr() -> None:
    result = process("show", "hirm", "--json")
    assert result.returncode == 0
    assert result.stderr == ""
    assert json.loads(result.stdout)["name"] == "hirm"


@pytest.fixture
def schedule(tmp_path: Path) -> Path:
    gains = load_gains("hirm-paper")
    sets = replace(gains, d_max=2), replace(gains, d_min=2, K1=gains.K1 + 0.25)
    save_gains(tmp_path / "two.toml", Schedule("two", gains.model, sets), "hirm")
    return tmp_path / "two.toml"


def test_a_schedule_is_shown_window_by_window(schedule: Path) -> None:
    text = invoke("show", str(schedule))
    for part in ("two: for hirm, delay 1 to 4 samples (25 to 100 ms), schedule of 2 sets", "certificate: none"):
        assert part in text
    for part in ("set 0: delay 1 to 2", "set 1: delay 2 to 4", "K1 alpha_rad", "-0.5054", "-0.2554", "K2 xr3"):
        assert part in text


def test_show_json_of_a_schedule_is_the_schedule(schedule: Path) -> None:
    shown, gains = json.loads(invoke("show", str(schedule), "--json")), load_gains("hirm-paper")
    K2 = None if gains.K2 is None else gains.K2.tolist()
    assert shown == {
        "kind": "schedule", "name": "two", "model": "hirm", "Ts": 0.025, "d_min": 1, "d_max": 4,
        "window": [
            {"d_min": 1, "d_max": 2, "K1": gains.K1.tolist(), "K2": K2},
            {"d_min": 2, "d_max": 4, "K1": (gains.K1 + 0.25).tolist(), "K2": K2},
        ],
        "certificate": "none", "conservative": None, "controller": "law",
    }  # fmt: skip


def test_a_stored_schedule_is_listed(schedule: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gains.__main__.stored", lambda: [Stored("two", "gains", schedule)])
    assert "schedule of 2 sets" in " ".join(invoke("list").split())


def test_lemma_1_needs_one_set_of_gains_and_refuses_a_schedule(schedule: Path) -> None:
    result = process("bound", str(schedule), "--method", "lyapunov")
    assert result.returncode == 2
    complaint = "window: expected one set of gains (d_min, d_max, K1), found a schedule"
    assert result.stderr == f"gains: error: {schedule}: {complaint}\n"
