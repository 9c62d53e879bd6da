"""``sitl replay``: the aircraft lives the recorded delays again, whatever flies; what cannot be told is refused."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from autopilot.link.node import Record
from gains.store import load_gains, model_path, save_gains, stored
from gains.witnessfile import read_witness
from sitl import replaying, scenario
from sitl.__main__ import cli
from sitl.commands.replay import DELAYS_FILE
from sitl.flight import fly_virtual
from sitl.flightdata import FlightData
from sitl.flightfile import attachments_of, load_flight
from sitl.link.gate import Gate
from sitl.recorder import FlightRecorder
from sitl.scenario import load_scenario

SHORT_S = 4.0
FIRST_COMMANDS = 5
"""By this sample a command has come, in every flight here."""

Rewrite = Callable[[Record], Record | None]


def sitl(*line: object) -> Result:
    words = [str(word) for word in line]
    return CliRunner().invoke(cli, words, catch_exceptions=False, standalone_mode=False)


def fly(folder: Path, *line: object, duration_s: float = SHORT_S) -> Path:
    """Fly in virtual time and return the recording."""
    sitl("fly", *line, "--virtual", "--duration", duration_s, "--out", folder, "--gcs", "none")
    return folder / "flight.mcap"


def replay(recording: Path, *line: object) -> tuple[dict[str, Any], FlightData]:
    """Replay in virtual time, and return the summary and the flight."""
    folder = recording.parent / "again"
    done = sitl("replay", recording, "--virtual", "--out", folder, "--gcs", "none", "--json", *line)
    assert done.return_value == 0, done.output
    return json.loads(done.stdout), load_flight(folder / "flight.mcap").flight


def recorded(
    folder: Path,
    metadata: Mapping[str, str] | None = None,
    rewrite: Rewrite = lambda record: record,
    name: str = "nominal",
) -> Path:
    """Return a recording of a second of flight that says of itself what it is told, its records rewritten."""
    folder.mkdir(exist_ok=True)
    flown = load_scenario(name)
    said = {"scenario": name, "title": flown.title, "gains": "hirm-paper", "plant": "hirm", "seed": "1"}
    with FlightRecorder(
        folder, {**said, **(metadata or {})}, attachments=attachments_of("hirm-paper", "hirm")
    ) as recorder:

        def write(record: Record, t_ns: int) -> None:
            if t_ns < 2 * 10**9 and (kept := rewrite(record)) is not None:
                recorder.write(kept, t_ns)

        fly_virtual(flown, write)
    return folder / "flight.mcap"


def same_delays(first: FlightData, second: FlightData) -> None:
    """Assert that two flights lived the same delays, and that these were more than one."""
    assert np.array_equal(first.k, second.k)
    assert np.isnan(first.d[: np.isnan(first.d).sum()]).all()
    assert np.array_equal(first.d, second.d, equal_nan=True)
    assert len(np.unique(first.d[FIRST_COMMANDS:])) > 1


LONG = [pytest.param(name, marks=pytest.mark.long) for name in ("lossy", "pendulum", "witness", "fault-mute")]


@pytest.mark.parametrize("name", ["blackout", "turbulence", "fault-kill-relay", *LONG])
def test_the_aircraft_lives_the_delays_of_the_recording(tmp_path: Path, name: str) -> None:
    recording = fly(tmp_path, name, duration_s=8.0)
    summary, again = replay(recording)
    first = load_flight(recording).flight
    same_delays(first, again)
    assert summary["witness"]["mismatches"] == 0
    assert summary["witness"]["predicted"] is None
    assert summary["link"]["up"]["lost"] == summary["link"]["down"]["lost"] == 0
    assert [check["metric"] for check in summary["checks"]] == ["diverged", "witness.mismatch_fraction"]
    sequence = read_witness(recording.parent / "again" / DELAYS_FILE)
    lived = ~np.isnan(first.d)
    assert np.array_equal(np.array(sequence.delays)[lived], first.d[lived])
    assert again.metadata["scenario"] == name


def test_a_delay_that_jumps_is_flown_by_a_plant_that_takes_the_last(tmp_path: Path) -> None:
    lasting = tmp_path / "last.toml"
    text = Path(replaying.stored_scenarios()["nominal"]).read_text()
    lasting.write_text(text.replace('title = "', 'latch = "last"\ntitle = "', 1))
    recording = fly(tmp_path, lasting, "--up", "delay=20ms", "--down", "delay=20ms,jitter=uniform:80ms")
    first = load_flight(recording).flight
    assert np.nanmax(np.diff(first.d)) > 1, "the newest was never overtaken by an older one"
    _, again = replay(recording, "--scenario", lasting)
    same_delays(first, again)


@pytest.mark.parametrize(
    ("line", "told"),
    [
        (("--gains", "hirm-d6"), {"gains": "hirm-d6"}),
        (("--plant", "hirm-printed"), {"plant": "hirm-printed"}),
        (("--gains", "hirm-6dof-d6", "--plant", "sixdof:hirm"), {"plant": "sixdof:hirm"}),
        (("--seed", 9), {"seed": 9}),
        (("--failsafe", "monitor"), {}),
        (("--reference", "sine:2deg@0s:0.5Hz"), {}),
    ],
)
def test_something_else_lives_them_too(tmp_path: Path, line: tuple[object, ...], told: Mapping[str, object]) -> None:
    recording = fly(tmp_path, "lossy")
    summary, again = replay(recording, *line)
    same_delays(load_flight(recording).flight, again)
    assert {key: summary[key] for key in told} == told
    if line[0] == "--reference":
        assert again.metadata["reference"] == line[1]


def test_what_the_command_line_changed_is_flown_again(tmp_path: Path) -> None:
    changed = ("--gains", "hirm-d6", "--seed", 7, "--reference", "sine:2deg@0s:0.5Hz", "--actuator", "float")
    recording = fly(tmp_path, "lossy", *changed)
    _, again = replay(recording)
    first = load_flight(recording).flight
    same_delays(first, again)
    for key in ("gains", "seed", "reference", "actuator", "plant"):
        assert again.metadata[key] == first.metadata[key]


def test_a_replay_is_replayed(tmp_path: Path) -> None:
    recording = fly(tmp_path, "lossy")
    replay(recording)
    _, third = replay(recording.parent / "again" / "flight.mcap", "--scenario", "lossy")
    same_delays(load_flight(recording).flight, third)


def test_the_check_fails_where_other_delays_are_lived(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The relay is told another sequence than the summary judges by."""
    recording = fly(tmp_path, "lossy")
    monkeypatch.setattr(scenario, "Gate", lambda sequence: Gate(replace(sequence, delays=(1,))))
    done = sitl("replay", recording, "--virtual", "--out", tmp_path / "again", "--gcs", "none", "--json")
    assert done.return_value == 1
    summary = json.loads(done.stdout)
    assert summary["witness"]["mismatch_fraction"] > 0.1
    assert [check["passed"] for check in summary["checks"]] == [True, False]


@pytest.mark.realtime
def test_it_is_flown_over_udp_too(tmp_path: Path) -> None:
    """A machine that is busy stops processes now and then, so that some samples live another delay."""
    recording = fly(tmp_path, "lossy")
    folder = tmp_path / "again"
    done = sitl("replay", recording, "--out", folder, "--gcs", "none", "--port-base", 0, "--json")
    share = json.loads(done.stdout)["witness"]["mismatch_fraction"]
    assert share < 0.1
    assert done.return_value == (share > replaying.MAX_MISMATCHES)
    first, again = load_flight(recording).flight, load_flight(folder / "flight.mcap").flight
    assert again.metadata["time"] == "udp"
    assert np.mean(first.d[FIRST_COMMANDS:] == again.d[FIRST_COMMANDS:]) > 0.9
    assert len(np.unique(again.d[FIRST_COMMANDS:])) > 1


# what is refused


def _without_sample_7(record: Record) -> Record | None:
    return None if record.topic == "plant/truth" and record.body["k"] == 7 else record


def _without_samples(record: Record) -> Record | None:
    return None if record.topic == "plant/truth" else record


def _restarted(record: Record) -> Record | None:
    if record.topic != "plant/truth" or record.body["k"] < 20:
        return record
    return record._replace(body={**record.body, "k": record.body["k"] - 20})


@pytest.mark.parametrize(
    ("metadata", "rewrite", "complaint"),
    [
        ({}, _without_sample_7, "expected every sample from 0 on, found sample 7 missing"),
        ({}, _without_samples, "expected samples of a plant (plant/truth), found none"),
        ({}, _restarted, "expected a flight in which the plant never restarted, found 1"),
        ({"scenario": "mine"}, None, "expected a flight of a stored scenario, found 'mine'; say --scenario FILE"),
        ({"scenario": "/etc/passwd"}, None, "expected a flight of a stored scenario"),
        ({"scenario": "lossy"}, None, "flown by another scenario than the stored lossy"),
        (
            {"gains": "../hirm-paper"},
            None,
            "a flight of stored gains, found '../hirm-paper'; say --gains FILE",
        ),
        ({"gains": "hirm-d6"}, None, "flown with other gains than the stored hirm-d6; say --gains FILE"),
        ({"plant": "jsbsim:../../x"}, None, "expected a flight of a stored plant, found 'jsbsim:../../x'"),
        ({"plant": "hirm-printed"}, None, "flown on another plant than the stored hirm-printed; say --plant FILE"),
        ({"plant": "/tmp/hirm.toml"}, None, "expected a flight of a stored plant"),
        ({"reference": "file:/etc/passwd"}, None, "flown with a reference from a file; say --reference file:NAME"),
        ({"reference": "nonsense"}, None, "nonsense"),
        ({"wind": "storm"}, None, "storm"),
    ],
)
def test_what_cannot_be_flown_again_is_one_line(
    tmp_path: Path, metadata: Mapping[str, str], rewrite: Rewrite | None, complaint: str
) -> None:
    recording = recorded(tmp_path / "first", metadata, rewrite or (lambda record: record))
    done = CliRunner().invoke(cli, ["replay", str(recording), "--virtual", "--out", str(tmp_path / "again")])
    assert complaint in str(done.exception)
    assert not (tmp_path / "again").exists()


def test_a_flight_too_long_for_a_sequence_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recording = recorded(tmp_path / "first")
    samples = len(load_flight(recording).flight.k)
    monkeypatch.setattr(replaying, "MAX_PERIOD", samples - 1)
    done = CliRunner().invoke(cli, ["replay", str(recording), "--virtual", "--out", str(tmp_path / "again")])
    assert f"expected at most {samples - 1} samples, found {samples}" in str(done.exception)
    assert not (tmp_path / "again").exists()


def test_the_recording_itself_is_not_written_over(tmp_path: Path) -> None:
    recording = recorded(tmp_path)
    before = recording.read_bytes()
    done = CliRunner().invoke(cli, ["replay", str(recording), "--virtual", "--out", str(tmp_path)])
    assert "expected another folder than that of the recording" in str(done.exception)
    assert recording.read_bytes() == before


def test_gains_of_ones_own_are_asked_for_by_their_file(tmp_path: Path) -> None:
    mine = tmp_path / "mine.toml"
    save_gains(mine, replace(load_gains("hirm-d4"), name="mine"), model_path("hirm-d4"))
    recording = fly(tmp_path, "lossy", "--gains", mine)
    refused = CliRunner().invoke(cli, ["replay", str(recording), "--virtual", "--out", str(tmp_path / "again")])
    assert "--gains" in str(refused.exception)
    _, again = replay(recording, "--gains", mine)
    same_delays(load_flight(recording).flight, again)


def test_every_stored_law_is_told_from_every_other() -> None:
    laws = [load_gains(entry.name) for entry in stored() if entry.kind != "model"]
    same = [(one.name, other.name) for one in laws for other in laws if replaying._same_law(one, other)]
    assert same == [(law.name, law.name) for law in laws]
