"""The ``gains`` command."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from gains.__main__ import cli
from gains.store import load_gains, load_model, resolve

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
    assert len(entries) == 6
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
        "certificate": "none",
    }  # fmt: skip


def test_show_prints_matrices_with_the_names_of_the_states() -> None:
    text = invoke("show", "hirm")
    for part in ("alpha_rad", "0.02470026", "AOA_SSA.AOA", "spectral radius", "100.23 m/s at 1600 m", "0.15"):
        assert part in text
    assert "110.6827" in invoke("show", "pendulum-paper")
    text = invoke("show", "hirm-paper")
    for part in ("3.3877", "-3.2382", "delay 1 to 4 samples (25 to 100 ms)", "certificate: none"):
        assert part in text


def test_a_certificate_is_shown_as_present_and_not_verified(tmp_path: Path) -> None:
    path = tmp_path / "g.toml"
    path.write_text(resolve("hirm-paper").read_text() + '[certificate]\nmethod = "exact"\n')
    assert "certificate: present, not verified by this version" in invoke("show", str(path))
    shown = json.loads(invoke("show", str(path), "--json"))
    assert shown["certificate"] == "present, not verified by this version"


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
