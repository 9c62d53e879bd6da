"""What QGroundControl asks of a vehicle when it connects, in its order and with its messages, sent by pymavlink.

QGroundControl's own program needs a desktop; its sources say what it sends, from 255/190, and what it takes for
an answer: a command wants its COMMAND_ACK, and when that accepts a REQUEST_MESSAGE, the message itself, too.
Each request comes when the one before has been answered, over UDP in real time and on the bench in virtual time.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic  # noqa: TID251  the vehicle lives in real time

import pytest
from pymavlink.dialects.v20 import all as dialect  # AVAILABLE_MODES is not in ardupilotmega's

from autopilot.config import AutopilotConfig
from autopilot.ground.parameters import PARAMETERS
from tests.autopilot.bench import Bench
from tests.helpers import HIRM, MS, S
from tests.integration.groundtools import vehicle
from tests.integration.programs import a_socket

pytestmark = pytest.mark.realtime

QGC = (255, 190)
WITHIN_S = 1.0
ACCEPTED = dialect.MAV_RESULT_ACCEPTED
REFUSED = (dialect.MAV_RESULT_DENIED, dialect.MAV_RESULT_UNSUPPORTED)

Heard = list[dialect.MAVLink_message]


@dataclass(frozen=True)
class Request:
    """A message of QGroundControl's, and what it takes for an answer."""

    name: str
    message: dialect.MAVLink_message
    answered: Callable[[Heard], bool]


def of(heard: Heard, name: str) -> Heard:
    return [message for message in heard if message.get_type() == name]


def acknowledged(heard: Heard, command: int, *results: int) -> bool:
    """Whether a command has been acknowledged to QGroundControl, with one of the results."""
    return any(
        ack.command == command and ack.result in results and (ack.target_system, ack.target_component) == QGC
        for ack in of(heard, "COMMAND_ACK")
    )


def command(name: str, number: int, answered: Callable[[Heard], bool], *params: float) -> Request:
    values = [*params, *[0.0] * (7 - len(params))]
    return Request(name, dialect.MAVLink_command_long_message(1, 1, number, 0, *values), answered)


def wanted(name: str, complete: Callable[[Heard], bool] = bool) -> Request:
    """Ask for a message that there must be; ``complete`` says of its copies whether they are all."""
    number = getattr(dialect, f"MAVLINK_MSG_ID_{name}")
    ask = dialect.MAV_CMD_REQUEST_MESSAGE
    return command(name, ask, lambda heard: acknowledged(heard, ask, ACCEPTED) and complete(of(heard, name)), number)


def perhaps(name: str, number: int) -> Request:
    """Ask for a message that there need not be, but then a refusal; pymavlink has no name for its number."""
    ask = dialect.MAV_CMD_REQUEST_MESSAGE

    def answered(heard: Heard) -> bool:
        sent = any(message.get_msgId() == number for message in heard)
        return acknowledged(heard, ask, *REFUSED) or (sent and acknowledged(heard, ask, ACCEPTED))

    return command(name, ask, answered, number)


def plan(name: str, mission_type: int) -> Request:
    """Ask how many items a plan has."""
    return Request(
        name,
        dialect.MAVLink_mission_request_list_message(1, 1, mission_type),
        lambda heard: any(
            (count.mission_type, count.count, count.target_system, count.target_component) == (mission_type, 0, *QGC)
            for count in of(heard, "MISSION_COUNT")
        ),
    )


def all_modes(modes: Heard) -> bool:
    """Whether the last mode has come, which is what QGroundControl waits for; it has no time-out here."""
    return any(mode.mode_index >= mode.number_modes for mode in modes)


def all_parameters(heard: Heard) -> bool:
    values = of(heard, "PARAM_VALUE")
    return bool(values) and {value.param_index for value in values} >= set(range(values[0].param_count))


SEQUENCE = [
    wanted("AUTOPILOT_VERSION"),
    perhaps("PROTOCOL_VERSION", 300),
    wanted("AVAILABLE_MODES", all_modes),
    perhaps("COMPONENT_METADATA", 397),
    perhaps("COMPONENT_INFORMATION", 395),
    Request("parameters", dialect.MAVLink_param_request_list_message(1, dialect.MAV_COMP_ID_ALL), all_parameters),
    Request(
        "a missed parameter",
        dialect.MAVLink_param_request_read_message(1, 1, b"", 1),
        lambda heard: any(value.param_index == 1 for value in of(heard, "PARAM_VALUE")),
    ),
    plan("mission", dialect.MAV_MISSION_TYPE_MISSION),
    plan("fence", dialect.MAV_MISSION_TYPE_FENCE),
    plan("rally", dialect.MAV_MISSION_TYPE_RALLY),
]
NAMES = [request.name for request in SEQUENCE]
ARM = command(
    "arm",
    dialect.MAV_CMD_COMPONENT_ARM_DISARM,
    lambda heard: acknowledged(heard, dialect.MAV_CMD_COMPONENT_ARM_DISARM, ACCEPTED),
    1.0,
)
PLAN_READ = [
    dialect.MAVLink_mission_ack_message(1, 1, dialect.MAV_MISSION_ACCEPTED, mission_type) for mission_type in range(3)
]
"""How QGroundControl closes the reading of a plan; no answer follows."""


@dataclass
class Conversation:
    """What has been asked and heard, and how long each answer took; None where there was none."""

    seconds: dict[str, float | None] = field(default_factory=dict)
    heard: Heard = field(default_factory=list)

    def last(self, name: str) -> dialect.MAVLink_message:
        return of(self.heard, name)[-1]

    @property
    def modes(self) -> dict[int, dialect.MAVLink_message]:
        return {mode.custom_mode: mode for mode in of(self.heard, "AVAILABLE_MODES")}

    @property
    def parameters(self) -> dict[int, dialect.MAVLink_message]:
        return {value.param_index: value for value in of(self.heard, "PARAM_VALUE")}

    @property
    def shown_mode(self) -> str:
        """The flight mode's name in QGroundControl's tool bar, for a vehicle of generic firmware."""
        beat = self.last("HEARTBEAT")
        assert beat.base_mode & dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        mode = self.modes.get(beat.custom_mode)
        if mode is None:
            return f"Custom:{beat.custom_mode:#x}"
        return str(mode.mode_name) if mode.standard_mode == 0 else f"standard mode {mode.standard_mode}"


class OverUdp:
    """QGroundControl's socket; the vehicle is whoever speaks first."""

    def __init__(self, sock: socket.socket) -> None:
        self.sock = sock
        self.mav = dialect.MAVLink(None, *QGC)
        self.peer: tuple[str, int] | None = None

    def send(self, message: dialect.MAVLink_message) -> None:
        assert self.peer is not None
        self.sock.sendto(message.pack(self.mav), self.peer)

    def hear(self, until: Callable[[Heard], bool], timeout_s: float) -> tuple[Heard, float | None]:
        """Return what comes until it is enough, and after how long that was."""
        start, heard = monotonic(), []
        while (left := start + timeout_s - monotonic()) > 0:
            self.sock.settimeout(left)
            try:
                datagram, self.peer = self.sock.recvfrom(2048)
            except TimeoutError:
                break
            heard += dialect.MAVLink(None).parse_buffer(bytearray(datagram)) or []
            if until(heard):
                return heard, monotonic() - start
        return heard, None


class OnTheBench:
    """QGroundControl at an autopilot without a plant's program, in virtual time, a millisecond at a time."""

    def __init__(self) -> None:
        self.bench = Bench(AutopilotConfig(HIRM, ground_stations=1)).tracking()
        self.mav = dialect.MAVLink(None, *QGC)

    def send(self, message: dialect.MAVLink_message) -> None:
        self.bench.node.receive("gcs0", message.pack(self.mav), self.bench.now_ns)

    def hear(self, until: Callable[[Heard], bool], timeout_s: float) -> tuple[Heard, float | None]:
        node, start_ns, heard = self.bench.node, self.bench.now_ns, []
        while self.bench.now_ns <= start_ns + timeout_s * S:
            due_ns = node.next_deadline_ns()
            if due_ns is not None and due_ns <= self.bench.now_ns:
                node.tick(self.bench.now_ns)
            for port, datagram in node.outgoing():
                if port == "gcs0":
                    heard += dialect.MAVLink(None).parse_buffer(bytearray(datagram)) or []
            if until(heard):
                return heard, (self.bench.now_ns - start_ns) / S
            self.bench.now_ns += MS
        return heard, None


def connect(station: OverUdp | OnTheBench) -> Conversation:
    """Ask everything once, in order."""
    conversation = Conversation()
    for request in SEQUENCE:
        station.send(request.message)
        heard, conversation.seconds[request.name] = station.hear(request.answered, WITHIN_S)
        conversation.heard += heard
    for message in PLAN_READ:
        station.send(message)
    return conversation


@pytest.fixture(scope="module")
def over_udp(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Conversation]:
    folder: Path = tmp_path_factory.mktemp("qgroundcontrol")
    with closing(a_socket()) as sock, vehicle(folder, sock.getsockname()[1]) as flying:
        station = OverUdp(sock)

        def ready(heard: Heard) -> bool:
            beats, status = of(heard, "HEARTBEAT"), of(heard, "SYS_STATUS")
            healthy = dialect.MAV_SYS_STATUS_PREARM_CHECK
            return bool(beats and status and status[-1].onboard_control_sensors_health & healthy)

        heard, after_s = station.hear(ready, 20.0)
        assert after_s is not None, "the vehicle does not become ready"
        conversation = connect(station)
        conversation.heard[:0] = heard
        station.send(ARM.message)
        heard, conversation.seconds["arm"] = station.hear(ARM.answered, WITHIN_S)
        conversation.heard += heard
        heard, _ = station.hear(lambda heard: bool(of(heard, "HEARTBEAT")), 1.5)
        conversation.heard += heard
        flying.land()
    return conversation


@pytest.fixture(scope="module")
def on_the_bench() -> Conversation:
    return connect(OnTheBench())


@pytest.fixture(scope="module", params=["over_udp", "on_the_bench"])
def either(request: pytest.FixtureRequest) -> Conversation:
    return request.getfixturevalue(request.param)


@pytest.mark.parametrize("name", NAMES)
def test_every_request_at_connection_is_answered_within_a_second(either: Conversation, name: str) -> None:
    assert either.seconds[name] is not None, {message.get_type() for message in either.heard}


def test_qgroundcontrol_takes_the_heartbeat_for_an_aircraft(over_udp: Conversation) -> None:
    beat = of(over_udp.heard, "HEARTBEAT")[0]
    assert (beat.get_srcSystem(), beat.get_srcComponent()) == (1, dialect.MAV_COMP_ID_AUTOPILOT1)
    assert (beat.type, beat.autopilot) == (dialect.MAV_TYPE_FIXED_WING, dialect.MAV_AUTOPILOT_GENERIC)


def test_the_modes_come_in_the_order_of_their_index_and_each_once(either: Conversation) -> None:
    modes = of(either.heard, "AVAILABLE_MODES")
    assert [mode.mode_index for mode in modes] == list(range(1, len(modes) + 1))
    assert {mode.number_modes for mode in modes} == {len(modes)}
    assert len({mode.mode_name for mode in modes}) == len(modes)


def test_the_mode_is_shown_by_the_vehicles_own_name(over_udp: Conversation) -> None:
    assert over_udp.shown_mode == "AUTO"
    named = {number: mode.mode_name for number, mode in over_udp.modes.items()}
    assert named == {0: "MANUAL", 2: "STABILIZE", 10: "AUTO", 15: "GUIDED"}


def test_every_parameter_has_a_name_of_its_own_and_counts_them_all(either: Conversation) -> None:
    values = either.parameters
    assert {value.param_count for value in values.values()} == {len(values)}
    assert values.keys() == set(range(len(values)))
    assert sorted(value.param_id for value in values.values()) == sorted(each.name for each in PARAMETERS)


def test_a_parameter_means_the_same_to_stations_that_cast_and_to_those_that_reinterpret(either: Conversation) -> None:
    assert {value.param_type for value in either.parameters.values()} == {dialect.MAV_PARAM_TYPE_REAL32}


def test_no_fence_and_no_rally_points_are_promised(either: Conversation) -> None:
    capabilities = either.last("AUTOPILOT_VERSION").capabilities
    promised = dialect.MAV_PROTOCOL_CAPABILITY_MISSION_FENCE | dialect.MAV_PROTOCOL_CAPABILITY_MISSION_RALLY
    assert capabilities & promised == 0
    assert capabilities & dialect.MAV_PROTOCOL_CAPABILITY_MAVLINK2


def test_the_end_of_a_reading_is_not_taken_for_an_upload(over_udp: Conversation) -> None:
    assert not of(over_udp.heard, "MISSION_ACK")


def test_qgroundcontrol_arms_the_vehicle_and_sees_it_in_the_next_heartbeat(over_udp: Conversation) -> None:
    beats = of(over_udp.heard, "HEARTBEAT")
    assert not beats[0].base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED
    assert over_udp.seconds["arm"] is not None
    assert beats[-1].base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED
