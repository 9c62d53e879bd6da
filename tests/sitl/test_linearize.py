"""``sitl linearize``: the model file it writes is the aircraft's, units and all, and what it cannot do is one line."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from gains.model import Model
from gains.store import load_model, parse_model
from gains.table import InputError, Table
from gains.templates import short_period
from sitl.commands.linearize import linearize

HIRM = ("sixdof:hirm", "--mach", "0.3", "--altitude-m", "1600")
CESSNA = ("jsbsim:c172x", "--vc-kts", "100", "--altitude-ft", "5000")


def run(*arguments: str | Path) -> Result:
    result = CliRunner().invoke(linearize, [str(argument) for argument in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def printed(*arguments: str) -> Model:
    """Return the model that goes to standard output."""
    result = run(*arguments)
    assert result.exit_code == 0, result.output
    return parse_model(Table.parse(result.stdout.encode(), "stdout"))


@pytest.fixture(scope="module")
def cessna(tmp_path_factory: pytest.TempPathFactory) -> tuple[Model, dict[str, Any], str]:
    """The README's line: the model, the JSON, and the text of the file."""
    path = tmp_path_factory.mktemp("linearize") / "c172.toml"
    result = run(*CESSNA, "-o", path, "--json")
    assert result.exit_code == 0, result.output
    assert list(path.parent.iterdir()) == [path]
    return load_model(path), json.loads(result.stdout), path.read_text()


# -- what it writes


def test_the_cessna_is_where_it_was_asked_for(cessna: tuple[Model, dict[str, Any], str]) -> None:
    model, _, _ = cessna
    assert model.condition is not None
    assert model.condition.altitude_m == pytest.approx(5000.0 * 0.3048, abs=0.01)
    # 100 kt calibrated at 5,000 ft of standard air: sqrt(rho_0 / rho) = 1.0773, and little compressibility
    assert model.condition.airspeed_m_s == pytest.approx(100.0 * 1852.0 / 3600.0 * 1.0773, rel=2e-3)
    assert model.trim.x[1] == 0.0
    assert model.trim.x[0] == pytest.approx(model.trim.x[2], abs=1e-4)  # level flight: alpha is the pitch angle


def test_the_cessnas_file_has_all_that_a_flight_wants(cessna: tuple[Model, dict[str, Any], str]) -> None:
    model, _, text = cessna
    assert model.name == "c172"
    assert model.Ts == 0.025
    assert model.states == ("alpha_rad", "q_rad_s", "theta_rad")
    assert set(model.sensors) == set(model.states)
    assert model.actuator is not None
    assert model.actuator.low is not None
    assert model.actuator.high is not None
    assert model.actuator.low[0] < model.trim.u[0] < model.actuator.high[0]
    assert model.reference is not None
    assert np.abs(np.linalg.eigvals(model.reference.Ar)).max() < 1.0
    assert text.startswith("# jsbsim:c172x near level flight at 55.39 m/s true and 1524 m, made by sitl linearize.\n")


def test_the_json_says_what_the_file_holds(cessna: tuple[Model, dict[str, Any], str]) -> None:
    model, told, _ = cessna
    assert model.condition is not None
    assert model.reference is not None
    assert (told["aircraft"], told["model"], told["Ts"]) == ("jsbsim:c172x", "c172", 0.025)
    assert (told["airspeed_m_s"], told["altitude_m"]) == (model.condition.airspeed_m_s, model.condition.altitude_m)
    assert (told["alpha_rad"], told["theta_rad"], told["elevator"]) == (
        model.trim.x[0],
        model.trim.x[2],
        model.trim.u[0],
    )
    assert told["elevator_unit"] == "rad"
    assert 0.0 < told["throttle"] < 1.0
    assert (told["short_period_rad_s"], told["short_period_damping"]) == pytest.approx(short_period(model))
    poles = np.exp(model.Ts * np.array([complex(*pole) for pole in told["reference_poles"]]))
    assert np.sort_complex(poles) == pytest.approx(
        np.sort_complex(np.linalg.eigvals(model.reference.Ar).astype(complex))
    )
    assert told["file"].endswith("c172.toml")
    assert any("FGLinearization" in note for note in told["notes"])


def test_standard_output_is_a_model_file_and_nothing_else() -> None:
    model = printed(*HIRM)
    assert model.name == "hirm"
    assert np.abs(load_model("hirm").A - model.A).max() < 1e-4  # (48), held at the same Ts


def test_feet_and_metres_are_the_same_height() -> None:
    in_feet, in_metres = printed(*HIRM[:3], "--altitude-ft", "5249.343832"), printed(*HIRM)
    assert in_feet.condition is not None
    assert in_feet.condition.altitude_m == pytest.approx(1600.0, abs=1e-4)
    assert np.abs(in_feet.A - in_metres.A).max() < 1e-8


def test_mach_and_true_airspeed_are_the_same_speed() -> None:
    sound = math.sqrt(1.4 * 287.0529 * (288.15 - 0.0065 * 1600.0))
    in_m_s, in_mach = printed("sixdof:hirm", "--tas-m-s", f"{0.3 * sound:.6f}", "--altitude-m", "1600"), printed(*HIRM)
    assert np.abs(in_m_s.A - in_mach.A).max() < 1e-6


def test_a_table_for_people_says_trim_modes_and_file(tmp_path: Path) -> None:
    result = run(*HIRM, "-o", tmp_path / "aircraft.toml")
    for word in ("sixdof:hirm", "trim", "short period", "reference", "model file"):
        assert word in result.stdout
    assert load_model(tmp_path / "aircraft.toml").name == "aircraft"


@pytest.mark.parametrize("ts_ms", ["4", "20", "1000"])
def test_the_sampling_period_is_the_options(ts_ms: str) -> None:
    model = printed(*HIRM, "--ts-ms", ts_ms)
    assert model.Ts == float(ts_ms) / 1000.0
    assert short_period(model) == pytest.approx(short_period(printed(*HIRM)), rel=1e-4)  # one aircraft, however sampled


def test_the_reference_model_is_the_options() -> None:
    model = printed(*HIRM, "--template", "none")
    assert model.reference is None
    second = printed(*HIRM, "--template", "second-order", "--bandwidth", "1.5", "--damping", "0.9")
    assert second.reference is not None
    poles = np.log(np.linalg.eigvals(second.reference.Ar).astype(complex)) / 0.025
    assert np.abs(poles) == pytest.approx([1.5, 1.5])
    assert -poles.real / 1.5 == pytest.approx([0.9, 0.9])
    level1 = printed(*HIRM, "--bandwidth", "0.8")
    assert level1.reference is not None
    assert np.min(np.abs(np.linalg.eigvals(level1.reference.Ar) - math.exp(-0.8 * 0.025))) < 1e-9


def test_a_name_is_text_that_cannot_leave_its_place(tmp_path: Path) -> None:
    name = 'a "b"\nTs = 9.0 # [1, 2, ]'
    assert printed(*HIRM, "--name", name).name == name


# -- what it refuses


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["c172x"], "c172x: expected jsbsim:NAME or sixdof:NAME"),
        (["jsbsim:"], "jsbsim:: expected jsbsim:NAME or sixdof:NAME"),
        (["linear:hirm"], "linear:hirm: expected jsbsim:NAME or sixdof:NAME"),
        (["jsbsim:c172x"], "expected one of --vc-kts, --tas-m-s, found none"),
        (["jsbsim:c172x", "--mach", "0.2"], "expected one of --vc-kts, --tas-m-s, found --mach"),
        (["jsbsim:c172x", "--vc-kts", "1", "--tas-m-s", "1"], "found --vc-kts, --tas-m-s"),
        (["sixdof:hirm", "--vc-kts", "100"], "expected one of --mach, --tas-m-s, found --vc-kts"),
        (["sixdof:nobody", "--mach", "0.3"], "nobody"),
        (["sixdof:hirm", "--mach", "0.01"], "expected"),
        (["sixdof:hirm", "--mach", "0.3", "--bandwidth", "1e9"], "bandwidth: expected a number from"),
        (["jsbsim:c172", "--vc-kts", "100"], "did you mean c172"),
        (["jsbsim:c172x", "--vc-kts", "20"], "expected a trim in level flight at 20 kt and 1600 m, found none"),
        (["sixdof:hirm", "--mach", "0.3", "--json"], "--json: expected -o FILE"),
    ],
)
def test_what_makes_no_trim_is_one_complaint(arguments: list[str], complaint: str) -> None:
    with pytest.raises(InputError) as refused:
        run(*arguments, "--altitude-m", "1600")
    assert complaint in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("height", [[], ["--altitude-m", "0", "--altitude-ft", "0"]])
def test_one_altitude_is_wanted(height: list[str]) -> None:
    with pytest.raises(InputError, match=r"^--altitude-ft, --altitude-m: expected one of them$"):
        run("sixdof:hirm", "--mach", "0.3", *height)


@pytest.mark.parametrize(
    ("option", "value"), [("--altitude-m", "-501"), ("--altitude-m", "1e300"), ("--altitude-ft", "262500")]
)
def test_an_altitude_without_air_is_refused(option: str, value: str) -> None:
    with pytest.raises(InputError, match=rf"^{option}: expected a number from -\d+ to \d+, found "):
        run("jsbsim:c172x", "--vc-kts", "100", option, value)


@pytest.mark.parametrize(
    "arguments",
    [
        ["--vc-kts", "0"],
        ["--tas-m-s", "-1"],
        ["--mach", "nan"],
        ["--altitude-m", "inf"],
        ["--altitude-ft", "high"],
        ["--ts-ms", "3.9"],
        ["--ts-ms", "1001"],
        ["--template", "level2"],
        ["--bandwidth", "0"],
        ["--damping", "-0.7"],
        ["-o", "."],
    ],
)
def test_an_option_that_is_no_such_number_is_bad_usage(arguments: list[str]) -> None:
    result = run(*HIRM, *arguments)
    assert result.exit_code == 2
    assert "Invalid value" in result.stderr


def test_a_file_that_cannot_be_written_is_refused_before_anything_is_computed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "sitl.aircraft.trim", None)  # importing it would fail
    with pytest.raises(InputError, match="expected a folder to write to, found none"):
        run(*HIRM, "-o", tmp_path / "no" / "m.toml")
