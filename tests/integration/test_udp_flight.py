"""Flights over UDP, from the command line to the files, seen by MAVProxy, mavlogdump and the recursion.

The gains are the paper's with a window of 40 samples in place of 4: a machine that stops for a tenth of a
second puts the loop delay up, and the recursion knows the law only, not the failsafe.
"""

from __future__ import annotations

import base64
import json
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from mcap.reader import make_reader

from autopilot.link.topics import schema_of
from gains.store import load_gains, resolve
from sitl.scenario import load_scenario
from tests.helpers import parse
from tests.integration.groundtools import BIN, MavProxy, mavproxy
from tests.integration.programs import Program, eventually, free_port, program
from tests.integration.recursion import deviation, tables

pytestmark = pytest.mark.realtime

MAVLOGDUMP = BIN / "mavlogdump.py"

SHORT = """
title = "a 5° pitch step"
gains = "{gains}"
plant = "hirm"
duration_s = 10.0
reference = "5deg@1s"
[link]
preset = "jittery"
"""


@dataclass(frozen=True)
class Flight:
    """A flight over UDP that has ended, and what it left."""

    folder: Path
    gains: Path
    code: int
    stdout: str
    stderr: str
    transcript: str = ""

    @cached_property
    def summary(self) -> dict[str, Any]:
        return json.loads(self.stdout)

    @cached_property
    def messages(self) -> list[tuple[str, str, bytes, int, dict[str, Any]]]:
        """Topic, schema's name and text, log time and body of every message, as the mcap reader reads them."""
        with (self.folder / "flight.mcap").open("rb") as file:
            return [
                (channel.topic, schema.name, schema.data, message.log_time, json.loads(message.data))
                for schema, channel, message in make_reader(file).iter_messages(log_time_order=False)
            ]

    @cached_property
    def truth_and_commands(self) -> tuple[list[dict], dict[int, dict]]:
        return tables((topic, log_time_ns, body) for topic, _, _, log_time_ns, body in self.messages)

    def frames(self, port: str, direction: str | None = None) -> Iterator[Any]:
        """Yield the MAVLink messages of a port as pymavlink reads them."""
        for topic, _, _, _, body in self.messages:
            if topic == f"mavlink/{port}" and direction in (None, body["direction"]):
                yield from parse(base64.b64decode(body["frame"]))

    @property
    def deviation(self) -> float:
        scenario = load_scenario("nominal", gains=str(self.gains))
        return deviation(scenario, *self.truth_and_commands)


def watch(station: MavProxy, flight: Program) -> int:
    """Ask the ground station for what it sees, twice a second, until the flight has ended."""
    for _ in range(120):
        station.say("status HEARTBEAT", "status ATTITUDE")
        try:
            return flight.wait(0.5)
        except subprocess.TimeoutExpired:
            pass
    raise AssertionError("the flight does not end")


@pytest.fixture(scope="module")
def gains(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("gains") / "wide.toml"
    path.write_text(resolve("hirm-paper").read_text().replace("d_max = 4", "d_max = 40"))
    assert load_gains(path).d_max == 40
    return path


@pytest.fixture(scope="module")
def flights(tmp_path_factory: pytest.TempPathFactory, gains: Path) -> dict[str, Flight]:
    """Two flights at the same time.

    ``watched``: 10 s of the nominal scenario with float commands, MAVProxy watching. ``unwatched``: 4 s with
    pulses, and nobody at the ground station's address.
    """
    folder, other = tmp_path_factory.mktemp("watched"), tmp_path_factory.mktemp("unwatched")
    (other / "short.toml").write_text(SHORT.format(gains=gains))
    files = ["--port-base", "0", "--out", "out", "--json"]
    floats = ["--actuator", "float", "--gains", str(gains)]
    pulses = ["--actuator", "pwm", "--duration", "4"]
    station, nobody = free_port(), free_port()
    with mavproxy(folder, station) as mav:
        eventually("MAVProxy's prompt", lambda: "MAV>" in mav.transcript)
        with (
            program(
                folder, "sitl", "fly", "nominal", *floats, *files, "--gcs", f"udpout:127.0.0.1:{station}"
            ) as flight,
            program(
                other, "sitl", "fly", "short.toml", *pulses, *files, "--gcs", f"udpout:127.0.0.1:{nobody}"
            ) as short,
        ):
            code = watch(mav, flight)
            short_code = short.wait()
        transcript = mav.transcript
    return {
        "watched": Flight(folder / "out", gains, code, flight.stdout, flight.stderr, transcript),
        "unwatched": Flight(other / "out", gains, short_code, short.stdout, short.stderr),
    }


@pytest.fixture(scope="module")
def watched(flights: dict[str, Flight]) -> Flight:
    return flights["watched"]


@pytest.fixture(scope="module")
def unwatched(flights: dict[str, Flight]) -> Flight:
    return flights["unwatched"]


@pytest.fixture(scope="module", params=["watched", "unwatched"])
def each(request: pytest.FixtureRequest, flights: dict[str, Flight]) -> Flight:
    return flights[request.param]


def test_a_flight_ends_well_and_says_so_in_one_json_object(watched: Flight) -> None:
    assert watched.code == 0, watched.stderr
    assert watched.stdout.count("\n") == 1
    assert {
        *("scenario", "seed", "virtual", "duration_s", "samples", "diverged", "rms_error_rad", "max_error_rad"),
        *("delay", "link", "failsafe_events", "late_ticks", "files"),
    } <= watched.summary.keys()
    fractions = {f"{what}_fraction" for what in ("estimated_exact", "within_one", "covered", "unknown", "outside")}
    assert watched.summary["delay"].keys() == {"true_histogram", *fractions}
    for way in ("up", "down"):
        assert watched.summary["link"][way].keys() == {"sent", "delivered", "lost", "duplicated", "reordered"}
    assert (watched.summary["scenario"], watched.summary["samples"]) == ("nominal", 400)
    assert (watched.summary["virtual"], watched.summary["diverged"]) == (False, False)
    assert all(check["passed"] for check in watched.summary["checks"])


def test_no_program_warns_or_complains(each: Flight) -> None:
    said = [each.stderr, *((each.folder / f"{p}.log").read_text() for p in ("plant", "relay", "autopilot"))]
    for text in said:
        assert not re.search("Traceback|Warning|Exception|error", text), text


def test_summary_json_is_what_was_printed(watched: Flight) -> None:
    assert json.loads((watched.folder / "summary.json").read_text()) == watched.summary


def test_every_file_of_the_summary_is_there_and_the_plot_is_a_png(watched: Flight) -> None:
    files = {name: watched.folder.parent / path for name, path in watched.summary["files"].items()}
    assert {"mcap", "tlog", "plot", "summary"} <= files.keys()
    assert all(path.stat().st_size > 1000 for path in files.values())
    png = files["plot"].read_bytes()
    assert png.startswith(b"\x89PNG\r\n\x1a\n")
    assert png.endswith(b"IEND\xaeB`\x82")


def test_every_message_conforms_to_the_schema_in_its_recording(each: Flight) -> None:
    validators = {}
    for topic, _, text, _, body in each.messages:
        if topic not in validators:
            schema = json.loads(text)
            jsonschema.Draft202012Validator.check_schema(schema)
            assert schema == schema_of(topic)
            validators[topic] = jsonschema.Draft202012Validator(schema)
        validators[topic].validate(body)
    topics = {"plant/truth", "autopilot/command", "link/up", "link/down", "events"}
    topics |= {"autopilot/estimate", "mavlink/plant", "mavlink/gcs0"}
    assert validators.keys() == topics


def test_log_times_are_true_times_since_the_start_of_the_flight(watched: Flight) -> None:
    truth = [(log_time_ns, body) for topic, _, _, log_time_ns, body in watched.messages if topic == "plant/truth"]
    start_ns = truth[0][0] - truth[0][1]["late_ns"]
    for log_time_ns, body in truth:
        on_the_grid_ns = start_ns + body["k"] * 25_000_000
        assert abs(log_time_ns - body["late_ns"] - on_the_grid_ns) < 1_000_000  # 40 ppm of 10 s are 0.4 ms
    assert min(log_time_ns for _, _, _, log_time_ns, _ in watched.messages) >= 0


def test_float_commands_over_udp_are_the_recursion_to_1e_5_rad(watched: Flight) -> None:
    truth, _ = watched.truth_and_commands
    assert len(truth) == 400
    assert max(abs(body["x"][2]) for body in truth) > 0.05
    assert watched.deviation < 1e-5


def test_pulses_over_udp_are_the_recursion_to_2e_4_rad(unwatched: Flight) -> None:
    truth, _ = unwatched.truth_and_commands
    assert len(truth) == 160
    assert max(abs(body["x"][2]) for body in truth) > 0.05
    assert 1e-7 < unwatched.deviation < 2e-4


def test_a_ground_station_that_is_not_there_is_no_error(unwatched: Flight) -> None:
    assert unwatched.code == 0, unwatched.stderr
    assert unwatched.summary["failsafe_events"] == 0
    sent = Counter(message.get_type() for message in unwatched.frames("gcs0"))
    assert sent["ATTITUDE"] > 70  # four seconds at 20 Hz


def test_the_true_delay_is_the_age_of_a_command_that_was_sent(each: Flight) -> None:
    truth, commands = each.truth_and_commands
    flown = [body for body in truth if body["d"] is not None]
    assert len(flown) > len(truth) - 40
    for body in flown:
        assert body["d"] == body["k"] - body["j"] >= 1
        assert body["j"] in commands
    assert {body["d"] for body in flown} >= {1, 2, 3}  # the link's delay alone


def test_the_delay_on_the_wire_is_the_plants_truth_at_the_same_sample(watched: Flight) -> None:
    truth, _ = watched.truth_and_commands
    by_time = {body["t_ns"] // 1_000_000: body["d"] for body in truth}
    on_the_wire = {
        message.time_boot_ms: message.value
        for message in watched.frames("plant", "received")
        if message.get_type() == "NAMED_VALUE_INT" and message.name == "DELAY_K"
    }
    assert len(on_the_wire) > 350
    assert on_the_wire.items() <= by_time.items()


def test_mavlogdump_reads_in_the_tlog_every_frame_of_the_recording(watched: Flight) -> None:
    command = [sys.executable, str(MAVLOGDUMP), "--format", "json", str(watched.folder / "flight.tlog")]
    dump = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    types = Counter(json.loads(line)["meta"]["type"] for line in dump.stdout.splitlines())
    unknown = {"CURRENT_MODE": "UNKNOWN_436"}  # what its dialect does not have yet
    assert types == Counter(unknown.get(m.get_type(), m.get_type()) for m in watched.frames("gcs0"))
    for name, rate_hz in (("ATTITUDE", 20), ("AOA_SSA", 10), ("SERVO_OUTPUT_RAW", 10)):
        assert types[name] > 0.9 * rate_hz * 10.0, name
    assert "BAD_DATA" not in types


def test_mavproxy_sees_the_vehicle_and_the_pitch_that_was_flown(watched: Flight) -> None:
    transcript = watched.transcript
    assert re.search(r"^Detected vehicle 1:1 on link 0", transcript, re.MULTILINE)
    assert re.search(r"^online system 1", transcript, re.MULTILINE)
    assert "AP: no verified certificate: gains hirm-paper" in transcript
    assert re.search(r"AP: STANDBY to TRACKING: delay \d", transcript)
    assert re.search(r"\b\d+: HEARTBEAT \{type : 1, autopilot : 0, .*system_status : 4", transcript)
    pitches = [float(text) for text in re.findall(r"\b\d+: ATTITUDE \{.*?, pitch : (\S+?),", transcript)]
    truth, _ = watched.truth_and_commands
    flown = [body["x"][2] for body in truth]
    assert len(pitches) >= 3
    assert max(pitches) > 0.06
    assert all(min(flown) - 1e-6 <= pitch <= max(flown) + 1e-6 for pitch in pitches)


def test_the_autopilot_hears_mavproxy(watched: Flight) -> None:
    heard = [message for message in watched.frames("gcs0", "received") if message.get_type() == "HEARTBEAT"]
    assert heard
    assert {(m.get_srcSystem(), m.get_srcComponent()) for m in heard} == {(255, 230)}
    told = [m.text for m in watched.frames("gcs0", "sent") if m.get_type() == "STATUSTEXT"]
    assert told.count("no verified certificate: gains hirm-paper") == 2  # at the start, and once it has been heard
