"""Scenarios that replay a witness: what their files say, and what is refused before anything flies."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from gains.table import InputError
from gains.witnessfile import Witness, read_witness, write_witness
from sitl.__main__ import cli
from sitl.arguments import autopilot_arguments, plant_arguments, relay_arguments
from sitl.faults import format_fault, parse_fault
from sitl.scenario import Scenario, load_scenario

FIFO = Witness("hirm-paper", "hirm", 0.025, 1, 3, "fifo", 1.01, (1, 2, 3))
ANY = Witness("hirm-paper", "hirm", 0.025, 1, 3, "any", 1.01, (1, 3))
TEXT = """
title = "a witness"
gains = "hirm-paper"
plant = "hirm"
duration_s = 1.0
{top}
[link]
witness = "w.csv"
{rest}
"""


def load(folder: Path, witness: Witness = FIFO, top: str = "", rest: str = "") -> Scenario:
    write_witness(folder / "w.csv", witness)
    (folder / "s.toml").write_text(TEXT.format(top=top, rest=rest))
    return load_scenario(str(folder / "s.toml"))


def test_the_witness_is_looked_for_beside_the_scenario_and_goes_to_the_relay(tmp_path: Path) -> None:
    scenario = load(tmp_path)
    assert scenario.witness == FIFO
    arguments = relay_arguments(scenario)
    assert read_witness(arguments[arguments.index("--witness") + 1]) == FIFO
    assert "--witness" not in relay_arguments(load_scenario("nominal"))


def test_actuator_failsafe_and_latch_go_to_the_programs(tmp_path: Path) -> None:
    scenario = load(tmp_path, ANY, 'actuator = "float"\nfailsafe = "monitor"\nlatch = "last"')
    assert "--actuator float --failsafe monitor" in " ".join(autopilot_arguments(scenario))
    assert "--latch last" in " ".join(plant_arguments(scenario))
    plain = load(tmp_path)
    assert (plain.actuator, plain.failsafe, plain.latch) == ("pwm", "on", "newest")


def test_a_plant_without_aoa_ssa_is_one_in_either_driver(tmp_path: Path) -> None:
    scenario = load(tmp_path, top='aoa = false\nalpha = "vfr_hud"')
    assert (scenario.aoa, scenario.plant_node().config.aoa, scenario.alpha) == (False, False, "vfr_hud")
    assert "--no-aoa" in plant_arguments(scenario)
    plain = load(tmp_path)
    assert (plain.aoa, plain.plant_node().config.aoa, plain.alpha) == (True, True, "auto")
    assert "--no-aoa" not in plant_arguments(plain)


def test_a_variant_changes_what_its_table_says_and_nothing_else(tmp_path: Path) -> None:
    rest = '[variant.watched]\nfailsafe = "on"\n[variant.loose]\nservo_timeout = 0\n[variant.same]\n'
    scenario = load(tmp_path, top='failsafe = "monitor"\nservo_timeout = 20', rest=rest)
    found = {name: (v.failsafe, v.servo_timeout, v.witness) for name, v in scenario.variants.items()}
    assert found == {"watched": ("on", 20, FIFO), "loose": ("monitor", None, FIFO), "same": ("monitor", 20, FIFO)}


def test_the_servo_time_out_outlasts_the_longest_delay_of_the_witness(tmp_path: Path) -> None:
    assert load(tmp_path).servo_timeout == 4 + 5
    assert load(tmp_path, Witness("", "", 0.025, 1, 30, "fifo", 1.01, (1, 2))).servo_timeout == 30 + 5


@pytest.mark.parametrize(
    ("witness", "top", "rest", "complaint"),
    [
        (ANY, "", "", 'transitions: expected fifo for a plant that latches the newest .* latch = "last"'),
        (Witness("", "", 0.03, 1, 3, "fifo", 1.01, (1,)), "", "", "Ts_s: expected 0.025 as that of hirm, found 0.03"),
        (Witness("", "", 0.025, 0, 3, "fifo", 1.01, (1,)), "", "", "d_min: expected at least 1"),
        (FIFO, 'latch = "oldest"', "", "latch: expected one of newest, last"),
        (FIFO, 'actuator = "analog"', "", "actuator: expected one of pwm, float"),
        (FIFO, 'alpha = "vane"', "", "alpha: expected one of auto, aoa_ssa, vfr_hud"),
        (FIFO, 'aoa = "no"', "", "aoa: expected true or false"),
        (FIFO, 'failsafe = "off"', "", "failsafe: expected one of on, monitor"),
        (FIFO, "", '[variant.v]\nfailsafe = "off"', "variant.v.failsafe: expected one of on, monitor"),
        (FIFO, "", '[[check]]\nname = "n"\nmetric = "witness.missmatches"\nat_most = 0', "such as witness.mismatches"),
    ],
)
def test_what_cannot_work_is_refused(tmp_path: Path, witness: Witness, top: str, rest: str, complaint: str) -> None:
    with pytest.raises(InputError, match=complaint):
        load(tmp_path, witness, top, rest)


def test_a_witness_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(TEXT.format(top="", rest=""))
    with pytest.raises(InputError, match=r"w\.csv: expected a witness file, found nothing of that name"):
        load_scenario(str(tmp_path / "s.toml"))


def test_a_check_of_the_witness_needs_a_witness(tmp_path: Path) -> None:
    text = TEXT.format(top="", rest='[[check]]\nname = "n"\nmetric = "witness.mismatches"\nat_most = 0')
    (tmp_path / "s.toml").write_text(text.replace('witness = "w.csv"', ""))
    with pytest.raises(InputError, match="metric: expected a number of the summary"):
        load_scenario(str(tmp_path / "s.toml"))


@pytest.mark.parametrize("name", ["witness", "witness-pendulum"])
def test_the_stored_witnesses_are_of_the_gains_and_the_model_they_fly_with(name: str) -> None:
    scenario = load_scenario(name)
    assert scenario.witness is not None
    assert (scenario.witness.gains, scenario.witness.model) == (scenario.gains.name, scenario.plant.name)
    assert scenario.plant_name == scenario.gains.model.name
    assert scenario.witness.d_max == scenario.gains.d_max + 1
    assert scenario.witness.growth_per_sample > 1.0


# faults

FAULTS = 'faults = ["kill:relay@0.2s+0.1s", "sensor:q_rad_s:noise:0.01@0.1s", "elevator:slow:0.5@0.5s+0.5s"]'


def test_faults_are_read_in_their_order_and_the_plant_gets_its_own(tmp_path: Path) -> None:
    scenario = load(tmp_path, top=FAULTS + "\nseed = 7", rest="[variant.same]\n[variant.calm]\nfaults = []\n")
    assert [format_fault(fault).partition(":")[0] for fault in scenario.faults] == ["kill", "sensor", "elevator"]
    config = scenario.plant_node().config
    assert (config.faults, config.seed) == (scenario.faults[1:], 7)
    arguments = plant_arguments(scenario)
    given = [arguments[i + 1] for i, word in enumerate(arguments) if word == "--fault"]
    assert [parse_fault(text) for text in given] == list(scenario.faults[1:])
    assert arguments[arguments.index("--seed") + 1] == "7"
    assert {name: variant.faults for name, variant in scenario.variants.items()} == {
        "same": scenario.faults,
        "calm": (),
    }


def test_a_plant_without_faults_is_started_as_ever() -> None:
    assert not {"--fault", "--seed"} & set(plant_arguments(load_scenario("nominal")))


@pytest.mark.parametrize(
    ("fault", "complaint"),
    [
        ("kill:gcs@0.1s", "expected kill:P"),
        ("sensor:beta_rad:nan@0.1s", "expected a state of alpha_rad, q_rad_s, theta_rad"),
        ("kill:plant@2s", "expected it within the flight of 1s"),
    ],
)
def test_a_scenario_with_an_impossible_fault_is_refused(tmp_path: Path, fault: str, complaint: str) -> None:
    with pytest.raises(InputError, match=complaint):
        load(tmp_path, top=f'faults = ["{fault}"]')
    with pytest.raises(InputError, match=complaint):
        load(tmp_path, rest=f'[variant.v]\nfaults = ["{fault}"]')


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["plant", "--fault", "kill:plant@1s"], "expected sensor:... or elevator:..."),
        (["plant", "--fault", "sensor:beta:nan@1s"], "expected a state of alpha_rad"),
        (["fly", "--virtual", "--fault", "elevator:gone@1s"], "expected kill:P"),
        (["fly", "--virtual", "--fault", "kill:plant@60s"], "expected it within the flight of 10s"),
        (["fly", "--virtual", "--duration", "2", "--fault", "kill:plant@3s"], "expected it within the flight of 2s"),
    ],
)
def test_the_programs_refuse_faults_that_cannot_be(arguments: list[str], complaint: str) -> None:
    result = CliRunner().invoke(cli, arguments)
    assert isinstance(result.exception, InputError)
    assert complaint in str(result.exception)
