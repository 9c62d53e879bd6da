"""MAVProxy flies the vehicle: one session with the modules that it loads by itself, and the transcript of it."""

from __future__ import annotations

import re
from dataclasses import dataclass

import pytest

from autopilot.ground.parameters import PARAMETERS
from tests.integration.groundtools import PREARM_CHECK, STEP_RAD, MavProxy, mavproxy, near, vehicle
from tests.integration.programs import eventually, free_port

pytestmark = pytest.mark.realtime

PARAMETER, VALUE, OUT_OF_RANGE = "STICK_DEG", 7.5, -1.0
PASSPHRASE = "a good passphrase"
"""Both links of the vehicle are signed; the other tools' are not."""
UNPROVED = "hirm-paper"
"""Gains without a certificate, which the ground cannot arm until a parameter says otherwise."""


@dataclass(frozen=True)
class Session:
    """A session that has ended: its transcript, and the pitch of every sample as the plant knows it, rad."""

    transcript: str
    flown: list[float]


def pitches(transcript: str) -> list[float]:
    return [float(text) for text in re.findall(r"\b\d+: ATTITUDE \{.*?, pitch : (\S+?),", transcript)]


def can_be_armed(station: MavProxy) -> bool:
    """Ask, and return whether the vehicle has said before that it could be armed."""
    station.say("status SYS_STATUS")
    health = re.findall(r"SYS_STATUS \{.*?onboard_control_sensors_health : (\d+)", station.transcript)
    return bool(health) and bool(int(health[-1]) & PREARM_CHECK)


def climbs(station: MavProxy) -> bool:
    """Ask, and return whether most of the programmed step has been seen before."""
    station.say("status ATTITUDE")
    return max(pitches(station.transcript), default=0.0) > 0.7 * STEP_RAD


def fetched(station: MavProxy) -> float:
    return float(station.ask(f"param fetch {PARAMETER}", rf"^{PARAMETER} = (\S+)")[1])


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    folder, port = tmp_path_factory.mktemp("mavproxy"), free_port()
    with mavproxy(folder, port, modules=None) as station:
        eventually("MAVProxy's prompt", lambda: "MAV>" in station.transcript)
        station.ask(f'signing key "{PASSPHRASE}"', "Setup signing key")
        with vehicle(folder, port, gains=UNPROVED, passphrase=PASSPHRASE) as flying:
            eventually("the parameters", lambda: "Received" in station.transcript)
            station.ask("arm throttle", "COMPONENT_ARM_DISARM: FAILED")
            station.say("param set ARM_CERT 0")
            eventually("a vehicle that can be armed", lambda: can_be_armed(station))
            station.ask("arm throttle", "^ARMED")
            eventually("the step", lambda: climbs(station))
            station.ask("mode GUIDED", "Mode GUIDED")
            station.ask("mode STABILIZE", "Mode STABILIZE")
            station.say(f"param set {PARAMETER} {VALUE}")
            eventually("the value", lambda: fetched(station) == VALUE)
            station.ask(f"param set {PARAMETER} {OUT_OF_RANGE}", f"^AP: {PARAMETER}")
            station.ask("param show *", rf"^{PARAMETER} +\S+$")
            station.ask("ping", "^ping response")
            station.ask("disarm", "^DISARMED")
            flying.land()
        transcript = station.lines()
    return Session(transcript, [x[2] for x in flying.flown])


def test_mavproxy_finds_one_vehicle_and_nothing_to_complain_about(session: Session) -> None:
    assert re.findall(r"Detected vehicle (\S+) on link", session.transcript) == ["1:1"]
    _, online, since = session.transcript.partition("online system 1\n")
    assert online
    assert not re.search("Traceback|fence|link 1 down|no link|UNSUPPORTED|DENIED", since)


def test_mavproxy_receives_every_parameter(session: Session) -> None:
    (received,) = re.findall(r"^Received (\d+) parameters", session.transcript, re.MULTILINE)
    shown = re.findall(r"^([A-Z][A-Z0-9_]*) +-?[0-9.e+-]+$", session.transcript, re.MULTILINE)
    assert int(received) == len(PARAMETERS)
    assert sorted(shown) == sorted(parameter.name for parameter in PARAMETERS)


def test_mavproxy_is_told_why_the_vehicle_cannot_be_armed(session: Session) -> None:
    refusal, _, _ = session.transcript.partition("COMPONENT_ARM_DISARM: ACCEPTED")
    assert re.search(r"^AP: PreArm: no verified certificate$", refusal, re.MULTILINE)


def test_mavproxy_arms_and_disarms_the_vehicle(session: Session) -> None:
    results = re.findall(r"Got COMMAND_ACK: COMPONENT_ARM_DISARM: (\w+)", session.transcript)
    assert results == ["FAILED", "ACCEPTED", "ACCEPTED"]
    assert re.findall("^(?:DIS)?ARMED", session.transcript, re.MULTILINE) == ["ARMED", "DISARMED"]


def test_mavproxy_changes_modes_and_knows_their_names(session: Session) -> None:
    assert re.findall(r"\bMode (\w+)", session.transcript) == ["AUTO", "GUIDED", "STABILIZE"]
    assert session.transcript.count("Got COMMAND_ACK: DO_SET_MODE: ACCEPTED") == 2


def test_mavproxy_sets_a_parameter_and_reads_it_back(session: Session) -> None:
    read = re.findall(rf"^{PARAMETER} = (\S+)", session.transcript, re.MULTILINE)
    assert float(read[-1]) == VALUE


def test_mavproxy_is_told_why_a_value_is_refused_and_the_old_one_stays(session: Session) -> None:
    assert re.search(rf"^AP: {PARAMETER} -1: expected 0 to 90$", session.transcript, re.MULTILINE)
    assert float(re.findall(rf"^{PARAMETER} +([0-9.]+)$", session.transcript, re.MULTILINE)[-1]) == VALUE


def test_mavproxy_sees_the_pitch_that_was_flown(session: Session) -> None:
    seen = pitches(session.transcript)
    assert max(seen) > 0.7 * STEP_RAD
    assert all(near(pitch, session.flown) for pitch in seen)


def test_mavproxys_ping_comes_back_from_the_autopilot(session: Session) -> None:
    assert re.search(r"^ping response: [0-9.]+ms from=1/1 ", session.transcript, re.MULTILINE)
