"""What ground stations ask for when they connect, answered by a whole autopilot; the clients are pymavlink's."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from pymavlink import mavftp
from pymavlink.dialects.v20 import all as dialect

from autopilot.config import AutopilotConfig, Home
from tests.autopilot.test_commands import ACCEPTED, ALONE, DENIED, UNSUPPORTED, Cockpit, cockpit
from tests.helpers import MS, S

REQUEST = 512
TYPES = {"MISSION": 0, "FENCE": 1, "RALLY": 2}
FTP = struct.Struct("<HBBBBBBI")
NAK = 129


def told(b: Cockpit, *messages: dialect.MAVLink_message, port: str = "gcs0") -> list[dialect.MAVLink_message]:
    """Return what a station gets for its messages, at once; every other station gets nothing."""
    start = len(b.messages)
    b.hear(*messages, port=port)
    assert not [m for where, m in b.messages[start:] if where not in (port, "plant")]
    return b.heard(port, start)


def two() -> Cockpit:
    """Return a cockpit with two stations; the second is (254, 190)."""
    return cockpit(ground_stations=2).fly(1)


# missions, fences, rally points


@pytest.mark.parametrize("kind", TYPES)
def test_there_are_no_items_of_any_kind_and_that_is_said_at_once(kind):
    [count] = told(two(), dialect.MAVLink_mission_request_list_message(1, 1, TYPES[kind]), port="gcs1")
    assert (count.get_type(), count.count, count.mission_type) == ("MISSION_COUNT", 0, TYPES[kind])
    assert (count.target_system, count.target_component) == (254, 190)


@pytest.mark.parametrize("kind", TYPES)
def test_clearing_what_is_empty_is_accepted(kind):
    [ack] = told(two(), dialect.MAVLink_mission_clear_all_message(1, 1, TYPES[kind]), port="gcs1")
    assert (ack.type, ack.mission_type) == (dialect.MAV_MISSION_ACCEPTED, TYPES[kind])
    assert (ack.target_system, ack.target_component) == (254, 190)


@pytest.mark.parametrize("kind", TYPES)
@pytest.mark.parametrize(("count", "result"), [(0, dialect.MAV_MISSION_ACCEPTED), (3, dialect.MAV_MISSION_UNSUPPORTED)])
def test_items_are_not_taken_and_an_empty_upload_is_what_there_is(kind, count, result):
    [ack] = told(two(), dialect.MAVLink_mission_count_message(1, 1, count, TYPES[kind]), port="gcs1")
    assert (ack.get_type(), ack.type, ack.mission_type) == ("MISSION_ACK", result, TYPES[kind])
    assert (ack.target_system, ack.target_component) == (254, 190)


@pytest.mark.parametrize(
    "request_of", [dialect.MAVLink_mission_request_message, dialect.MAVLink_mission_request_int_message]
)
def test_an_item_that_is_not_there_is_an_invalid_sequence(request_of):
    [ack] = told(two(), request_of(1, 1, 0, 1), port="gcs1")
    assert (ack.type, ack.mission_type) == (dialect.MAV_MISSION_INVALID_SEQUENCE, 1)


# files


@dataclass
class Master:
    """What pymavlink's file client takes for its connection: it writes frames, and takes messages."""

    cockpit: Cockpit
    source_system: int = 255
    source_component: int = 190
    waiting: list[dialect.MAVLink_message] = field(default_factory=list)
    asked: int = 0

    def __post_init__(self) -> None:
        self.mav = dialect.MAVLink(self, self.source_system, self.source_component)

    def write(self, frame: bytes) -> None:
        start = len(self.cockpit.messages)
        self.cockpit.node.receive("gcs0", bytes(frame), self.cockpit.now_ns)
        self.cockpit.to(self.cockpit.now_ns)
        self.asked += 1
        self.waiting += self.cockpit.of("FILE_TRANSFER_PROTOCOL", start=start)

    def recv_match(self, type: list[str], timeout: float) -> dialect.MAVLink_message | None:
        return self.waiting.pop(0) if self.waiting else None


def client() -> tuple[Master, mavftp.MAVFTP]:
    """Return pymavlink's client, which waits for more answers for 20 ms only."""
    master = Master(cockpit().fly(1))
    names = {"debug": 0, "pkt_loss_tx": 0, "pkt_loss_rx": 0, "max_backlog": 5, "burst_read_size": 80}
    names |= {"write_size": 80, "write_qsize": 5}
    times = {"idle_detection_time": 0.02, "read_retry_time": 0.01, "retry_time": 0.5}
    settings = [(name, int, value) for name, value in names.items()]
    settings += [(name, float, value) for name, value in times.items()]
    return master, mavftp.MAVFTP(master, 1, 1, mavftp.MAVFTPSettings(settings))


@pytest.mark.parametrize(
    ("order", "names"),
    [
        ("cmd_list", ["/"]),
        ("cmd_rm", ["/a.txt"]),
        ("cmd_rmdir", ["/a"]),
        ("cmd_mkdir", ["/a"]),
        ("cmd_crc", ["/a.txt"]),
    ],
)
def test_pymavlink_s_file_client_is_told_at_once_that_there_is_no_such_file(order, names):
    master, ftp = client()
    asked = master.asked  # sessions of before are ended first
    assert getattr(ftp, order)(names).error_code == mavftp.FtpError.FileNotFound
    assert (master.asked, master.waiting) == (asked + 1, [])


def test_pymavlink_s_file_client_gets_no_packed_parameters_and_leaves_no_file(tmp_path: Path):
    _, ftp = client()
    ftp.cmd_get(["@PARAM/param.pck", str(tmp_path / "p")])
    assert ftp.process_ftp_reply("OpenFileRO", 1.0).error_code == mavftp.FtpError.FileNotFound
    assert list(tmp_path.iterdir()) == []


def test_every_operation_on_files_is_refused_by_its_number_for_its_session():
    b = two()
    for opcode in range(256):
        header = FTP.pack((65_535 + opcode) % 65_536, opcode ^ 5, opcode, 3, 0, 0, 0, 9)
        payload = (header + b"abc").ljust(251, b"\0")
        message = dialect.MAVLink_file_transfer_protocol_message(0, 1, 1, list(payload))
        [answer] = told(b, message, port="gcs1")
        assert (answer.target_network, answer.target_system, answer.target_component) == (0, 254, 190)
        sequence, session, nak, size, asked, *_ = FTP.unpack_from(bytes(answer.payload))
        assert (sequence, session, nak, size, asked) == (opcode, opcode ^ 5, NAK, 1, opcode)
        assert answer.payload[12] == mavftp.FtpError.FileNotFound


# logs


def test_there_are_no_logs():
    [entry] = told(two(), dialect.MAVLink_log_request_list_message(1, 1, 0, 0xFFFF), port="gcs1")
    assert (entry.get_type(), entry.num_logs, entry.last_log_num) == ("LOG_ENTRY", 0, 0)


# clocks


def test_a_ping_to_all_or_to_nobody_comes_back_with_its_time_number_and_asker():
    b = two()
    [pong] = told(b, dialect.MAVLink_ping_message(123_456_789_012, 77, 0, 0), port="gcs1")
    assert (pong.time_usec, pong.seq) == (123_456_789_012, 77)
    assert (pong.target_system, pong.target_component) == (254, 190)
    assert told(b, dialect.MAVLink_ping_message(1, 78, 1, 1), port="gcs1") == []  # an answer to us


def test_timesync_is_answered_with_our_time_and_their_stamp_and_answers_are_not():
    b = two()
    [sync] = told(b, dialect.MAVLink_timesync_message(0, 987_654_321), port="gcs1")
    assert (sync.tc1, sync.ts1) == (b.now_ns, 987_654_321)
    assert told(b, dialect.MAVLink_timesync_message(5, 987_654_321), port="gcs1") == []


def test_a_station_s_timesync_does_not_touch_the_plant_s_clock():
    b, untouched = two(), two()
    for n in range(200):
        b.hear(dialect.MAVLink_timesync_message(0, n), dialect.MAVLink_timesync_message(10**18 + n, b.now_ns))
        for each in (b, untouched):
            each.fly(1)
    assert b.commands == untouched.commands
    assert b.node.clock.estimate(b.now_ns) == untouched.node.clock.estimate(b.now_ns)


def test_what_is_for_another_system_is_left_alone():
    b = two()
    payload = [0] * 251
    others = [
        dialect.MAVLink_ping_message(1, 1, 2, 1),
        dialect.MAVLink_mission_request_list_message(2, 1, 0),
        dialect.MAVLink_mission_clear_all_message(1, 2, 0),
        dialect.MAVLink_mission_count_message(2, 0, 3, 0),
        dialect.MAVLink_file_transfer_protocol_message(0, 2, 1, payload),
        dialect.MAVLink_log_request_list_message(1, 25, 0, 9),
        dialect.MAVLink_param_request_list_message(2, 1),
        dialect.MAVLink_param_request_read_message(2, 1, b"STICK_DEG", -1),
        dialect.MAVLink_param_set_message(2, 1, b"STICK_DEG", 3.0, 9),
        dialect.MAVLink_request_data_stream_message(2, 1, 0, 50, 1),
        dialect.MAVLink_set_attitude_target_message(0, 2, 1, 7, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0, 0.0),
        dialect.MAVLink_rc_channels_override_message(2, 1, 0, 2000, 0, 0, 0, 0, 0, 0),
    ]
    assert told(b, *others) == []
    assert b.node.vehicle.elsewhere == len(others)
    start = len(b.messages)
    b.to(b.now_ns + 100 * MS)
    assert {m.get_type() for m in b.heard(start=start)} <= {"ATTITUDE_TARGET", "HEARTBEAT", "SYS_STATUS"}
    assert b.node.settings.parameters.value("STICK_DEG") == 15.0


# who this is


@pytest.mark.parametrize("order", [(REQUEST, 148.0), (520, 1.0)])
def test_the_version_says_what_is_served_and_no_more(order):
    ack, version = cockpit().fly(1).order(*order)
    assert ack.result == ACCEPTED
    served = ("PARAM_FLOAT", "COMMAND_INT", "SET_ATTITUDE_TARGET", "MAVLINK2", "PARAM_ENCODE_C_CAST")
    assert version.capabilities == sum(getattr(dialect, f"MAV_PROTOCOL_CAPABILITY_{name}") for name in served)
    assert version.flight_sw_version & 0xFF == dialect.FIRMWARE_VERSION_TYPE_OFFICIAL
    assert bytes(version.flight_custom_version).rstrip(b"\0") == b"lagproof"


@pytest.mark.parametrize("index", range(5))
def test_the_modes_are_listed_one_by_one_or_all_at_once(index):
    ack, *modes = cockpit().fly(1).order(REQUEST, 435.0, float(index))
    assert ack.result == ACCEPTED
    every = [(1, 0, "MANUAL"), (2, 2, "STABILIZE"), (3, 10, "AUTO"), (4, 15, "GUIDED")]
    assert [(m.mode_index, m.custom_mode, m.mode_name) for m in modes] == (every if index == 0 else [every[index - 1]])
    assert {m.number_modes for m in modes} == {4}


@pytest.mark.parametrize("index", [5.0, -1.0, 255.0, 3e38])
def test_a_mode_that_is_not_there_is_denied(index):
    assert [m.get_type() for m in cockpit().fly(1).order(REQUEST, 435.0, index)] == ["COMMAND_ACK"]
    assert cockpit().fly(1).result(REQUEST, 435.0, index) == DENIED


def test_the_present_mode_can_be_asked_for():
    b = cockpit().fly(1)
    b.hear(dialect.MAVLink_set_mode_message(1, 1, 15))
    _, mode = b.order(REQUEST, 436.0)
    assert (mode.get_type(), mode.custom_mode, mode.intended_custom_mode) == ("CURRENT_MODE", 15, 15)


@pytest.mark.parametrize("order", [(REQUEST, 242.0), (410, 0.0)])
def test_home_is_where_it_was_said_to_be(order):
    b = Cockpit(AutopilotConfig(ALONE, wait_arm=True, home=Home(-33.5, 151.25, 20.5))).fly(1)
    ack, home = b.order(*order)
    assert (ack.result, home.get_type()) == (ACCEPTED, "HOME_POSITION")
    assert (home.latitude, home.longitude, home.altitude) == (-335_000_000, 1_512_500_000, 20_500)


@pytest.mark.parametrize("number", [0.0, 24.0, 65_535.0, -1.0, 3e38])
def test_a_message_that_is_not_to_be_had_is_unsupported(number):
    assert [m.result for m in cockpit().fly(1).order(REQUEST, number)] == [UNSUPPORTED]


def test_all_is_answered_within_the_tick_however_little_is_known():
    b = cockpit()
    b.to(b.now_ns + 10 * MS)  # no sample yet, no plant
    asked = [
        dialect.MAVLink_ping_message(1, 1, 0, 0),
        dialect.MAVLink_timesync_message(0, 5),
        dialect.MAVLink_mission_request_list_message(1, 1, 0),
        dialect.MAVLink_log_request_list_message(1, 1, 0, 9),
    ]
    assert [m.get_type() for m in told(b, *asked)] == ["PING", "TIMESYNC", "MISSION_COUNT", "LOG_ENTRY"]
    assert b.t0_ns - b.now_ns > S // 2
