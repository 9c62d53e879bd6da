"""What a parameter's value does to the vehicle: gains in flight, windows, stops, times; parameters kept in a file."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as dialect

from autopilot.app import AutopilotNode
from autopilot.config import AutopilotConfig
from autopilot.ground.parameterfile import ParameterFile
from gains.model import Gains
from gains.store import load_gains
from gains.table import InputError
from tests.autopilot.test_commands import (
    ACCEPTED,
    ALONE,
    ARM,
    CUSTOM,
    DENIED,
    FAILED,
    MODES,
    PAPER,
    SET_MODE,
    STORAGE,
    Cockpit,
    cockpit,
)
from tests.helpers import MS, TS, S

D3, D6 = load_gains("hirm-d3"), load_gains("hirm-d6")
LAWS = {"hirm-d4": ALONE, "hirm-d6": D6, "hirm-d3": replace(D3, conservative=None), "hirm-paper": PAPER}
"""Windows 1 to 4, 1 to 6, 1 to 3, and 1 to 4 without a certificate; GAINS counts them in this order."""
OTHERS = tuple(LAWS.values())[1:]
SAVE, LOAD, DEFAULTS = 1.0, 0.0, 2.0
TRAVEL = math.radians(25)
NO_JUMP = 1e-9
"""What the elevator may move when other gains take over, rad: rounding."""
WILD = np.array([0.01, 0.0, 0.09])
"""A state that asks for more elevator than a few degrees."""


def flying(**options) -> Cockpit:
    """Return a cockpit whose law flies and may be another one, its elevator unquantised."""
    b = cockpit(alternatives=OTHERS, wait_arm=False, actuator="float", **options).fly(20)
    assert b.mode == "TRACKING"
    return b


def eq9(gains: Gains, command: dict) -> float:
    """Return u of Eq. (9) with the recorded xr, by NumPy."""
    assert gains.K2 is not None
    u = float((gains.K1 @ np.array(command["x"]) + gains.K2 @ np.array(command["xr"]))[0])
    return float(np.clip(u, -TRAVEL, TRAVEL))


def refused(b: Cockpit, name: str, value: float, reason: str) -> None:
    """Set a parameter, and see it refused with a reason and the old value told."""
    before, start = b.node.settings.parameters.values, len(b.messages)
    assert b.put(name, value) == np.float32(before[name])
    assert b.of("PARAM_ERROR", start=start)[0].param_id == name
    assert b.statements(start) == [reason]
    assert b.node.settings.parameters.values is before


# gains in flight


def test_other_gains_that_are_proved_over_the_present_window_are_taken_in_flight_without_a_jump():
    b = flying()
    assert b.put("GAINS", 1.0) == 1.0
    assert b.statements()[-2:] == ["certificate verified: gains hirm-d6", "flown at delay 1..4 of 1..6"]
    before = b.u
    b.fly(40)
    assert abs(b.commands[20]["u"][0] - before) < NO_JUMP
    for n, c in enumerate(b.commands):
        assert c["u"][0] == pytest.approx(eq9(ALONE if n < 20 else D6, c), abs=1e-12)
    assert {c["mode"] for c in b.commands[20:]} == {"TRACKING"}


@pytest.mark.parametrize(
    ("index", "reason"),
    [
        (2.0, "hirm-d3: 1..3; window now 1..4"),
        (3.0, "hirm-paper: armed, and no verified certificate"),
        (4.0, "GAINS 4: expected 0 to 3"),
        (-1.0, "GAINS -1: expected 0 to 3"),
        (0.5, "GAINS 0.5: expected a whole number"),
        (math.nan, "GAINS nan: expected a finite number"),
    ],
)
def test_a_change_that_is_refused_leaves_everything_as_it_was(index, reason):
    b, untouched = flying(), flying()
    refused(b, "GAINS", index, reason)
    for each in (b, untouched):
        each.fly(60)
    assert b.commands == untouched.commands
    assert b.node.pilot.window == (1, 4)
    assert b.node.commander.certified


def test_gains_for_longer_delays_leave_the_window_as_it_was_until_it_is_widened():
    b = flying()
    b.put("GAINS", 1.0)
    assert b.node.pilot.window == (1, 4)
    assert b.fly(1, age_ns=110 * MS).mode == "HOLD"
    assert b.commands[-1]["d"] == 5
    assert b.put("DELAY_MAX", 6.0) == 6.0
    assert b.fly(3, age_ns=110 * MS).mode == "TRACKING"


def test_gains_for_shorter_delays_are_taken_after_a_narrower_window():
    b = flying()
    refused(b, "GAINS", 2.0, "hirm-d3: 1..3; window now 1..4")
    assert b.put("DELAY_MAX", 3.0) == 3.0
    assert b.put("GAINS", 2.0) == 2.0
    b.fly(10)
    assert b.u == pytest.approx(eq9(D3, b.commands[-1]), abs=1e-12)
    refused(b, "DELAY_MAX", 4.0, "hirm-d3: expected a window in 1..3")


def test_disarmed_any_gains_are_taken_and_those_without_a_certificate_are_not_armed_then():
    b = flying()
    b.result(ARM, 0.0)
    assert b.put("GAINS", 3.0) == 3.0
    assert "no verified certificate: gains hirm-paper" in b.statements()
    b.fly(5)
    assert b.result(ARM, 1.0) == FAILED
    assert b.put("GAINS", 1.0) == 1.0
    assert b.result(ARM, 1.0) == ACCEPTED


def test_in_manual_gains_without_a_certificate_are_refused_as_well_as_the_vehicle_is_armed():
    b = flying()
    b.result(SET_MODE, CUSTOM, MODES["MANUAL"])
    b.fly(2)
    refused(b, "GAINS", 3.0, "hirm-paper: armed, and no verified certificate")


def test_gains_that_are_changed_forth_and_back_all_the_time_never_jump():
    b = flying()
    for n in range(40):
        b.put("GAINS", 1.0 - n % 2)
        before = b.u
        b.fly(1)
        assert abs(b.u - before) < NO_JUMP
        b.fly(2)
    assert {c["mode"] for c in b.commands[20:]} == {"TRACKING"}


def test_a_law_for_another_model_is_no_alternative():
    with pytest.raises(InputError, match="expected the model hirm, found pendulum"):
        AutopilotNode(AutopilotConfig(ALONE, alternatives=(load_gains("pendulum-paper"),)))


# windows


def test_outside_a_narrower_window_the_law_does_not_fly_and_inside_it_does():
    b = flying().fly(20, age_ns=80 * MS)
    assert (b.mode, b.commands[-1]["d"]) == ("TRACKING", 4)
    b.put("DELAY_MAX", 3.0)
    assert b.fly(1, age_ns=80 * MS).mode == "HOLD"
    assert b.transitions()[-1] == "TRACKING to HOLD: delay 4"
    b.put("DELAY_MAX", 4.0)
    assert b.fly(3, age_ns=80 * MS).mode == "TRACKING"


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("DELAY_MAX", 5.0, "hirm-d4: expected a window in 1..4"),
        ("DELAY_MIN", 5.0, "DELAY_MIN 5: expected at most DELAY_MAX"),
        ("DELAY_MAX", 0.0, "DELAY_MAX 0: expected 1 to 6"),
        ("DELAY_MAX", 7.0, "DELAY_MAX 7: expected 1 to 6"),
    ],
)
def test_a_window_stays_inside_that_of_the_gains(name, value, reason):
    b = flying()
    refused(b, name, value, reason)
    assert b.node.pilot.window == (1, 4)


# stops


def test_the_elevator_s_stops_are_obeyed_by_the_law_and_by_the_stick():
    b = cockpit(wait_arm=False).fly(5, WILD)
    assert abs(b.u) > math.radians(6)
    assert b.put("ELEV_HIGH_DEG", 4.0) == 4.0
    assert b.put("ELEV_LOW_DEG", -3.0) == -3.0
    b.fly(10, WILD).fly(10, -WILD)
    flown = [c["u"][0] for c in b.commands[5:]]
    assert (min(flown), max(flown)) == (pytest.approx(math.radians(-3)), pytest.approx(math.radians(4)))
    assert all(c["saturated"] for c in b.commands[6:12])
    b.result(SET_MODE, CUSTOM, MODES["MANUAL"])
    for x, stop_deg in ((-1000, -3.0), (1000, 4.0)):
        b.hear(dialect.MAVLink_manual_control_message(1, x, 0, 0, 0, 0)).fly(1)
        assert b.u == pytest.approx(math.radians(stop_deg))
    pulses = [m.servo2_raw for port, m in b.messages if port == "plant" and m.get_type() == "SERVO_OUTPUT_RAW"][5:]
    assert (min(pulses), max(pulses)) == (1500 - 60, 1500 + 80)  # 20 us per degree


def test_at_the_ends_of_the_travel_the_whole_travel_is_there_again():
    b = cockpit(wait_arm=False).fly(5)
    b.put("ELEV_HIGH_DEG", 4.0)
    assert b.put("ELEV_HIGH_DEG", 25.0) == 25.0
    b.result(SET_MODE, CUSTOM, MODES["MANUAL"])
    b.hear(dialect.MAVLink_manual_control_message(1, 1000, 0, 0, 0, 0)).fly(1)
    assert b.u == TRAVEL


def test_stops_stay_around_neutral_and_inside_the_travel():
    b = flying()
    refused(b, "ELEV_LOW_DEG", 1.0, "ELEV_LOW_DEG, _HIGH_DEG: neutral is 0 deg")
    refused(b, "ELEV_HIGH_DEG", -1.0, "ELEV_LOW_DEG, _HIGH_DEG: neutral is 0 deg")
    refused(b, "ELEV_HIGH_DEG", 26.0, "ELEV_HIGH_DEG 26: expected -25 to 25")
    b.fly(10, 3.0 * WILD)
    assert max(abs(c["u"][0]) for c in b.commands) == TRAVEL


# times and switches


def test_the_times_of_failsafe_are_those_of_the_parameters():
    b = flying()
    for name, value in (("FS_HOLD_S", 0.2), ("FS_SAT_S", 0.3), ("FS_GCS_S", 2.0)):
        assert b.put(name, value) == pytest.approx(value)
    b.to(b.now_ns + 6 * TS)
    since_ns = b.node.failsafe.since_ns
    assert b.mode == "HOLD"
    b.to(since_ns + 200 * MS - 1)
    assert b.mode == "HOLD"
    b.to(since_ns + 200 * MS)
    assert b.mode == "NEUTRAL"
    b.hear(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)).fly(70)
    assert b.mode == "TRACKING"
    b.fly(14)
    assert b.mode == "LEVEL"  # the station has been silent for 2 s
    b.fly(11, 3.0 * WILD)
    assert b.mode == "LEVEL"
    b.fly(3, 3.0 * WILD)
    assert b.mode == "NEUTRAL"


# on disk


def kept(path: Path, **options) -> Cockpit:
    return cockpit(alternatives=OTHERS, parameters=ParameterFile(path), **options)


def test_what_is_saved_is_there_after_a_restart_of_the_autopilot(tmp_path):
    path = tmp_path / "p.toml"
    b = kept(path).fly(2)
    for name, value in (("DELAY_MAX", 3.0), ("GAINS", 2.0), ("STICK_DEG", 7.5), ("ARM_CERT", 0.0), ("RATE_ATT", 4.0)):
        assert b.put(name, value) == value
    assert not path.exists()
    assert b.result(STORAGE, SAVE) == ACCEPTED
    assert path.read_text().splitlines()[1:] == [
        'GAINS = "hirm-d3"',
        "DELAY_MAX = 3",
        "STICK_DEG = 7.5",
        "ARM_CERT = false",
        "RATE_ATT = 4.0",
    ]
    again = kept(path)
    assert again.node.settings.parameters.values == b.node.settings.parameters.values
    assert again.node.pilot.gains.name == "hirm-d3"
    assert again.node.pilot.window == (1, 3)
    assert not again.node.commander.require_certificate
    assert again.node.commander.stick_rad == math.radians(7.5)
    start = len(again.messages)
    again.to(again.now_ns + 10 * S)
    again.fly(80)
    assert len(again.of("ATTITUDE", start=start)) == 8
    assert again.statements()[0] == "certificate verified: gains hirm-d3"


def test_reading_brings_back_what_is_kept_and_the_defaults_of_the_rest_and_tells_what_changed(tmp_path):
    path = tmp_path / "p.toml"
    b = kept(path).fly(2)
    b.put("STICK_DEG", 7.5)
    b.result(STORAGE, SAVE)
    b.put("STICK_DEG", 9.0)
    b.put("FS_HOLD_S", 2.0)
    start = len(b.messages)
    assert b.result(STORAGE, LOAD) == ACCEPTED
    b.to(b.now_ns + S)
    assert {m.param_id: m.param_value for m in b.of("PARAM_VALUE", start=start)} == {"STICK_DEG": 7.5, "FS_HOLD_S": 0.5}
    assert b.node.commander.stick_rad == math.radians(7.5)


def test_defaults_come_back_in_the_vehicle_and_the_file_stays(tmp_path):
    path = tmp_path / "p.toml"
    b = kept(path).fly(2)
    b.put("STICK_DEG", 7.5)
    b.put("GAINS", 1.0)
    b.result(STORAGE, SAVE)
    before = path.read_bytes()
    assert b.result(STORAGE, DEFAULTS) == ACCEPTED
    assert b.node.settings.parameters.values == b.node.settings.parameters.defaults
    assert (b.node.commander.stick_rad, b.node.pilot.gains.name) == (math.radians(15.0), "hirm-d4")
    assert path.read_bytes() == before


def test_without_a_file_there_is_nothing_to_read_and_nothing_changes(tmp_path):
    b = kept(tmp_path / "none.toml").fly(2)
    b.put("STICK_DEG", 7.5)
    assert b.result(STORAGE, LOAD) == FAILED
    assert b.statements()[-1] == "parameters: none are saved"
    assert b.node.commander.stick_rad == math.radians(7.5)


def broken_file(path: Path) -> None:
    path.write_text("STICK_DEG = 900\n")


def file_of_gains_without_a_certificate(path: Path) -> None:
    path.write_text('STICK_DEG = 3.0\nGAINS = "hirm-paper"\n')


@pytest.mark.parametrize("spoil", [broken_file, file_of_gains_without_a_certificate])
def test_a_file_that_is_refused_in_flight_is_refused_whole(tmp_path, spoil: Callable[[Path], None]):
    path = tmp_path / "p.toml"
    b = kept(path, wait_arm=False).fly(20)
    before = b.node.settings.parameters.values
    spoil(path)
    start = len(b.messages)
    assert b.result(STORAGE, LOAD) == FAILED
    [text] = b.statements(start)
    assert text.startswith("parameters: ")
    assert b.node.settings.parameters.values is before
    assert b.node.commander.stick_rad == math.radians(15.0)
    assert b.fly(20).mode == "TRACKING"
    assert {c["u"][0] for c in b.commands[-20:]} != {0.0}


def test_the_defaults_are_refused_in_flight_where_their_gains_are_not_proved():
    b = cockpit(gains=PAPER, alternatives=(D6,)).fly(5)
    b.put("GAINS", 1.0)
    assert b.result(ARM, 1.0) == ACCEPTED
    b.fly(5)
    assert b.result(STORAGE, DEFAULTS) == FAILED
    assert b.node.pilot.gains.name == "hirm-d6"
    b.result(ARM, 0.0)
    assert b.result(STORAGE, DEFAULTS) == ACCEPTED
    assert b.node.pilot.gains.name == "hirm-paper"


@pytest.mark.parametrize("what", [SAVE, LOAD])
def test_without_a_place_to_keep_them_parameters_are_neither_saved_nor_read(what):
    b = cockpit().fly(2)
    start = len(b.messages)
    assert b.result(STORAGE, what) == FAILED
    assert b.statements(start) == ["parameters: started without --parameters"]


def test_a_place_that_cannot_be_written_is_said(tmp_path):
    b = kept(tmp_path / "nowhere" / "p.toml").fly(2)
    start = len(b.messages)
    assert b.result(STORAGE, SAVE) == FAILED
    assert b.statements(start) == ["parameters: No such file or directory"]


@pytest.mark.parametrize("what", [3.0, -1.0, 0.5])
def test_other_words_for_storage_are_denied(tmp_path, what):
    assert kept(tmp_path / "p.toml").fly(2).result(STORAGE, what) == DENIED


def test_a_file_that_is_malformed_stops_the_start(tmp_path):
    path = tmp_path / "p.toml"
    path.write_text("STICK_DEG = 900\n")
    with pytest.raises(InputError, match="STICK_DEG: expected a number from 0 to 90, found 900"):
        kept(path)
