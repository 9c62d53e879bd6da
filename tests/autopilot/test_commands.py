"""Commands of ground stations to a whole autopilot on the bench; stations speak and read by pymavlink alone."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import all as dialect

from autopilot.config import AutopilotConfig
from autopilot.link.wire import NamedValueInt
from autopilot.profile import parse_profile
from gains.store import load_gains
from tests.autopilot.bench import Bench
from tests.helpers import MS, TS, S

D4, PAPER = load_gains("hirm-d4"), load_gains("hirm-paper")
"""Delays 1 to 4, with a verified certificate and without one."""
ALONE = replace(D4, conservative=None)
X = np.array([0.002, 0.0, 0.005])
"""A state that leaves the elevator within its travel."""
ARM, CHECKS, SET_MODE, STORAGE = 400, 401, 176, 245
CUSTOM = dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
ACCEPTED, DENIED = dialect.MAV_RESULT_ACCEPTED, dialect.MAV_RESULT_DENIED
UNSUPPORTED, FAILED = dialect.MAV_RESULT_UNSUPPORTED, dialect.MAV_RESULT_FAILED
NAN = math.nan
MODES = {"MANUAL": 0, "STABILIZE": 2, "AUTO": 10, "GUIDED": 15}


@dataclass
class Cockpit(Bench):
    """An autopilot on the bench, a station of pymavlink's frames per port: (255, 190), (254, 190), ..."""

    config: AutopilotConfig = field(default_factory=lambda: AutopilotConfig(ALONE, wait_arm=True))

    def __post_init__(self) -> None:
        super().__post_init__()
        self.stations = {f"gcs{i}": dialect.MAVLink(None, 255 - i, 190) for i in range(self.config.ground_stations)}
        for port in self.stations:  # so that the banner is behind us
            self.hear(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3), port=port)

    def hear(self, *messages: dialect.MAVLink_message, port: str = "gcs0") -> Cockpit:
        """Let a station's messages arrive now, one datagram each, and tick what is due."""
        for message in messages:
            self.node.receive(port, message.pack(self.stations[port]), self.now_ns)
        self.to(self.now_ns)
        return self

    def fly(self, count: int, x: np.ndarray = X, age_ns: int = 0, reported: int | None = None) -> Cockpit:
        """Let the next samples come in a row, with the delay that the plant reports."""
        k = self.commands[-1]["j"] + 1 if self.commands else 0
        k = max(k, -(-(self.now_ns - self.t0_ns - age_ns) // TS))
        for n in range(k, k + count):
            self.sample(n, age_ns, x)
            if reported is not None:
                self.give(NamedValueInt((self.t0_ns + n * TS) // MS, "DELAY_K", reported))
        return self

    def heard(self, port: str = "gcs0", start: int = 0) -> list[dialect.MAVLink_message]:
        """Return what a station has got since so many messages, also what Bench's dialect does not know."""
        got = [m for where, m in self.messages[start:] if where == port]
        known = [[m] if m.get_type()[:7] != "UNKNOWN" else _read(bytes(m.get_msgbuf())) for m in got]
        return [m for each in known for m in each]

    def of(self, kind: str, port: str = "gcs0", start: int = 0) -> list[dialect.MAVLink_message]:
        return [m for m in self.heard(port, start) if m.get_type() == kind]

    def order(self, command: int, *params: float, port: str = "gcs0") -> list[dialect.MAVLink_message]:
        """Give a command, and return what comes of it at once."""
        start = len(self.messages)
        self.hear(long(command, *params), port=port)
        return self.heard(port, start)

    def result(self, command: int, *params: float) -> int:
        """Give a command, and return how it is acknowledged."""
        [ack] = [m for m in self.order(command, *params) if m.get_type() == "COMMAND_ACK"]
        assert ack.command == command
        return int(ack.result)

    def put(self, name: str, value: float) -> float:
        """Set a parameter, and return the value that is told after it."""
        start = len(self.messages)
        self.hear(dialect.MAVLink_param_set_message(1, 1, name.encode(), value, dialect.MAV_PARAM_TYPE_REAL32))
        return float(self.of("PARAM_VALUE", start=start)[-1].param_value)

    def statements(self, start: int = 0) -> list[str]:
        return [m.text for m in self.of("STATUSTEXT", start=start)]

    def heartbeat(self) -> dialect.MAVLink_message:
        """Return the next heartbeat, which comes after at most 1 s without samples."""
        start = len(self.messages)
        self.to(self.now_ns + S)
        return self.of("HEARTBEAT", start=start)[-1]

    @property
    def u(self) -> float:
        return float(self.commands[-1]["u"][0])


def _read(datagram: bytes) -> list[dialect.MAVLink_message]:
    return dialect.MAVLink(None).parse_buffer(bytearray(datagram)) or []


def long(command: int, *params: float, target: tuple[int, int] = (1, 1)) -> dialect.MAVLink_message:
    return dialect.MAVLink_command_long_message(*target, command, 0, *params, *[0.0] * (7 - len(params)))


def integer(command: int, *params: float, target: tuple[int, int] = (1, 1)) -> dialect.MAVLink_message:
    four = (*params, *[0.0] * 4)[:4]
    return dialect.MAVLink_command_int_message(*target, 0, command, 0, 0, *four, 0, 0, 0.0)


def set_mode(number: int, base: int = CUSTOM, system: int = 1) -> dialect.MAVLink_message:
    return dialect.MAVLink_set_mode_message(system, base, number)


def cockpit(**options) -> Cockpit:
    return Cockpit(AutopilotConfig(options.pop("gains", ALONE), wait_arm=options.pop("wait_arm", True), **options))


# what speaks against arming


def clock_lost() -> Cockpit:
    """Return a cockpit whose plant has answered no TIMESYNC for 16 s, while its reports keep the delay known."""
    b = cockpit().fly(40, reported=1)
    b.answers = False
    return b.fly(16 * 40, reported=1)


def no_state() -> Cockpit:
    b = cockpit()
    b.to(b.t0_ns + S)
    return b


def state_stopped() -> Cockpit:
    b = cockpit().fly(20)
    b.to(b.now_ns + (ALONE.d_max + 1) * TS)
    return b


REASONS: dict[str, tuple[Callable[[], Cockpit], str]] = {
    "clock": (clock_lost, "plant clock not locked"),
    "no state": (no_state, "no fresh state"),
    "state stopped": (state_stopped, "no fresh state"),
    "delay": (lambda: cockpit().fly(20, age_ns=160 * MS), "delay 7"),
    "certificate": (lambda: cockpit(gains=PAPER).fly(20), "no verified certificate"),
}


@pytest.mark.parametrize("case", REASONS)
def test_arming_fails_for_each_reason_alone_and_says_which(case):
    make, reason = REASONS[case]
    b = make()
    for order in (long(ARM, 1.0), integer(ARM, 1.0)):
        start = len(b.messages)
        b.hear(order)
        [ack] = b.of("COMMAND_ACK", start=start)
        assert (ack.command, ack.result) == (ARM, FAILED)
        assert b.statements(start) == [f"PreArm: {reason}"]
        assert b.of("STATUSTEXT", start=start)[0].severity <= dialect.MAV_SEVERITY_ERROR
    assert not b.heartbeat().base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED
    assert {c["armed"] for c in b.commands} <= {False}


@pytest.mark.parametrize("case", REASONS)
def test_the_checks_can_be_run_alone_and_say_the_same(case):
    make, reason = REASONS[case]
    b = make()
    start = len(b.messages)
    assert b.result(CHECKS) == ACCEPTED
    assert b.statements(start) == [f"PreArm: {reason}"]
    assert not b.node.commander.armed


def test_all_reasons_are_said_when_there_are_several():
    b = Cockpit(AutopilotConfig(PAPER, wait_arm=True), answers=False).fly(20)
    start = len(b.messages)
    assert b.result(ARM, 1.0) == FAILED
    expected = ["plant clock not locked", "delay unknown", "no verified certificate"]
    assert b.statements(start) == [f"PreArm: {reason}" for reason in expected]


@pytest.mark.parametrize("word", [21196.0, 2989.0])
@pytest.mark.parametrize("case", REASONS)
def test_forced_arming_asks_nothing(case, word):
    b = REASONS[case][0]()
    assert b.result(ARM, 1.0, word) == ACCEPTED
    assert b.statements()[-1] == "armed by force"
    assert b.heartbeat().base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED


@pytest.mark.parametrize("word", [0.0, 1.0, 21195.0, 2990.0, -21196.0, NAN, math.inf])
def test_no_other_word_forces(word):
    b = cockpit(gains=PAPER).fly(20)
    assert b.result(ARM, 1.0, word) == FAILED


def test_gains_without_a_certificate_are_armed_where_a_parameter_says_so_and_only_then():
    b = cockpit(gains=PAPER).fly(20)
    assert b.put("ARM_CERT", 0.0) == 0.0
    assert b.result(CHECKS) == b.result(ARM, 1.0) == ACCEPTED
    assert b.fly(1).mode == "TRACKING"
    assert b.result(ARM, 0.0) == ACCEPTED
    b.put("ARM_CERT", 1.0)
    assert b.fly(5).result(ARM, 1.0) == FAILED


def test_arming_what_is_armed_asks_nothing_again():
    b = cockpit().fly(20)
    assert b.result(ARM, 1.0) == ACCEPTED
    b.to(b.now_ns + S)  # by now there is no fresh state
    start = len(b.messages)
    assert b.result(ARM, 1.0) == ACCEPTED
    assert b.statements(start) == []


@pytest.mark.parametrize("what", [NAN, math.inf, -math.inf, 2.0, -1.0, 0.5])
def test_arming_wants_0_or_1_and_nothing_else(what):
    b = cockpit().fly(20)
    assert b.result(ARM, what) == DENIED
    assert not b.node.commander.armed
    b.result(ARM, 1.0)
    assert b.result(ARM, what) == DENIED
    assert b.node.commander.armed


def test_parameters_that_a_tool_does_not_use_may_be_nan():
    b = cockpit().fly(20)
    assert b.result(ARM, 1.0, *[NAN] * 6) == ACCEPTED
    assert b.result(SET_MODE, float(CUSTOM), 2.0, *[NAN] * 5) == ACCEPTED
    assert b.result(511, 30.0, 100_000.0, *[NAN] * 5) == ACCEPTED
    assert b.result(512, 30.0, *[NAN] * 6) == ACCEPTED
    assert b.result(CHECKS, *[NAN] * 7) == ACCEPTED
    assert b.result(410, *[NAN] * 7) == ACCEPTED
    assert b.result(520, *[NAN] * 7) == ACCEPTED
    assert b.result(ARM, 0.0, *[NAN] * 6) == ACCEPTED


def test_nan_in_every_parameter_of_every_served_command_raises_nothing_and_moves_nothing():
    b = cockpit().fly(20)
    b.result(ARM, 1.0)
    for command in (*SERVED, 1, 31_000, 65_535):
        [ack] = [m for m in b.order(command, *[NAN] * 7) if m.get_type() == "COMMAND_ACK"]
        assert ack.command == command
    assert b.node.commander.armed
    assert b.heartbeat().custom_mode == MODES["AUTO"]


# who arms, and when


def test_a_vehicle_that_waits_is_armed_by_the_ground_alone():
    b = cockpit().fly(200)
    assert {(c["armed"], c["mode"], c["u"][0]) for c in b.commands} == {(False, "STANDBY", 0.0)}
    assert b.result(ARM, 1.0) == ACCEPTED
    assert b.statements()[-1] == "armed"
    b.fly(1)
    assert (b.commands[-1]["armed"], b.mode) == (True, "TRACKING")


def test_a_vehicle_that_does_not_wait_arms_itself_once_at_the_first_usable_sample():
    b = cockpit(wait_arm=False)
    b.fly(10, age_ns=150 * MS)
    assert {c["armed"] for c in b.commands} == {False}
    b.fly(10)
    assert [c["armed"] for c in b.commands] == [False] * 10 + [True] * 10
    assert b.statements().count("armed") == 1


def test_a_vehicle_that_missed_its_first_samples_flies_the_profile_from_sample_0_all_the_same():
    profile = parse_profile("1deg@0.05s,2deg@0.3s", 0.025)
    b = cockpit(wait_arm=False, profile=profile)
    for k in range(6, 30):
        b.sample(k, 0, X)
    assert [c["r"][0] for c in b.commands] == [profile.r(k) for k in range(6, 30)]
    assert {c["mode"] for c in b.commands} == {"TRACKING"}


def test_a_vehicle_that_arms_itself_without_a_certificate_says_so():
    b = cockpit(gains=PAPER, wait_arm=False).fly(10)
    assert "armed without a verified certificate" in b.statements()


def test_what_the_ground_has_disarmed_never_arms_itself_again():
    b = cockpit(wait_arm=False).fly(20)
    assert b.result(ARM, 0.0) == ACCEPTED
    b.fly(200).to(b.now_ns + 3 * S)
    b.fly(200)
    assert not any(c["armed"] for c in b.commands[20:])
    assert {c["u"][0] for c in b.commands[20:]} == {0.0}
    assert b.statements().count("disarmed: elevator neutral") == 1


def test_a_vehicle_disarmed_before_its_first_sample_does_not_arm_itself():
    b = cockpit(wait_arm=False)
    b.to(b.now_ns)
    assert b.result(ARM, 0.0) == ACCEPTED
    b.fly(100)
    assert {(c["armed"], c["u"][0]) for c in b.commands} == {(False, 0.0)}


def test_a_plant_that_starts_anew_is_flown_again_without_being_armed_again():
    b = cockpit().fly(20)
    b.result(ARM, 1.0)
    b.fly(20)
    b.t0_ns = b.now_ns + 5 * S
    for k in range(40):
        b.sample(k, 0, X)
    assert (b.node.epoch, b.mode, b.node.commander.armed) == (1, "TRACKING", True)
    assert b.statements().count("armed") == 1


@pytest.mark.parametrize("mode", MODES)
def test_disarmed_the_elevator_is_neutral_whatever_sticks_and_setpoints_say(mode):
    b = cockpit(profile=parse_profile("5deg@0s", 0.025)).fly(5)
    assert b.result(SET_MODE, CUSTOM, MODES[mode]) == ACCEPTED
    pitch = math.radians(20)
    q = (math.cos(pitch / 2), 0.0, math.sin(pitch / 2), 0.0)
    for n in range(40):
        b.hear(
            dialect.MAVLink_manual_control_message(1, -1000, 0, 0, 0, 0),
            dialect.MAVLink_rc_channels_override_message(1, 1, 0, 2000, 0, 0, 0, 0, 0, 0),
            dialect.MAVLink_set_attitude_target_message(n + 1, 1, 1, 7, q, 0.0, 0.0, 0.0, 0.0),
        ).fly(1)
    assert {(c["u"][0], c["armed"], c["mode"]) for c in b.commands} == {(0.0, False, "STANDBY")}
    assert {m.servo2_raw for port, m in b.messages if m.get_type() == "SERVO_OUTPUT_RAW"} == {1500}


@pytest.mark.parametrize("mode", MODES)
def test_disarmed_in_flight_the_next_command_is_neutral(mode):
    b = cockpit(profile=parse_profile("5deg@0s", 0.025)).fly(5)
    b.result(SET_MODE, CUSTOM, MODES[mode])
    b.result(ARM, 1.0)
    stick = dialect.MAVLink_manual_control_message(1, -500, 0, 0, 0, 0)
    b.fly(5).hear(stick).fly(5)
    assert b.u != 0.0
    assert b.result(ARM, 0.0) == ACCEPTED
    assert b.mode == "STANDBY"
    assert b.hear(stick).fly(1).u == 0.0
    assert not b.commands[-1]["armed"]


@pytest.mark.parametrize("pause", [0, ALONE.d_max + 2, 60])
def test_disarmed_while_no_state_comes_the_plant_is_sent_neutral_all_the_same(pause):
    b = cockpit(wait_arm=False).fly(20, np.array([0.01, 0.0, 0.05]))
    assert b.u > 0.1
    b.to(b.now_ns + pause * TS)  # the law still flies, then HOLD, then NEUTRAL
    assert b.mode == {0: "TRACKING", 6: "HOLD", 60: "NEUTRAL"}[pause]
    start = len(b.messages)
    b.result(ARM, 0.0)
    b.to(b.now_ns + S)
    pulses = [m.servo2_raw for port, m in b.messages[start:] if port == "plant" and m.get_type() == "SERVO_OUTPUT_RAW"]
    assert set(pulses) == {1500}


# modes


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("way", ["DO_SET_MODE", "DO_SET_MODE as COMMAND_INT", "SET_MODE"])
def test_each_mode_is_set_in_three_ways(mode, way):
    b = cockpit().fly(2)
    b.hear(set_mode(MODES["MANUAL"] if mode != "MANUAL" else MODES["AUTO"]))
    orders = {
        "DO_SET_MODE": long(SET_MODE, CUSTOM, MODES[mode]),
        "DO_SET_MODE as COMMAND_INT": integer(SET_MODE, CUSTOM, MODES[mode]),
        "SET_MODE": set_mode(MODES[mode]),
    }
    start = len(b.messages)
    b.hear(orders[way])
    assert [m.result for m in b.of("COMMAND_ACK", start=start)] == ([] if way == "SET_MODE" else [ACCEPTED])
    assert b.statements(start) == [f"mode {mode}"]
    assert b.heartbeat().custom_mode == MODES[mode] == getattr(dialect, f"PLANE_MODE_{mode}")
    assert b.fly(1).commands[-1]["flight_mode"] == mode


@pytest.mark.parametrize("number", [1, 3, 4, 5, 7, 9, 11, 14, 16, 25, 0.5, -1.0, 1e9, 3e38])
def test_a_mode_that_is_not_there_is_denied_and_nothing_changes(number):
    b = cockpit().fly(2)
    start = len(b.messages)
    assert b.result(SET_MODE, CUSTOM, number) == DENIED
    if number == int(number) and 0 <= number < 1 << 32:
        b.hear(set_mode(int(number)))
    assert b.statements(start) == []
    assert b.heartbeat().custom_mode == MODES["AUTO"]


@pytest.mark.parametrize("base", [0, dialect.MAV_MODE_FLAG_SAFETY_ARMED, 220 & ~CUSTOM])
def test_a_mode_that_is_no_custom_mode_is_denied(base):
    b = cockpit().fly(2)
    assert b.result(SET_MODE, base, MODES["MANUAL"]) == DENIED
    b.hear(set_mode(MODES["MANUAL"], base))
    assert b.heartbeat().custom_mode == MODES["AUTO"]


def test_px4_s_offboard_is_guided():
    b = cockpit().fly(2)
    assert b.result(SET_MODE, CUSTOM, 6.0) == ACCEPTED
    assert b.heartbeat().custom_mode == MODES["GUIDED"]


def test_a_mode_that_is_set_again_begins_nothing_anew():
    b = cockpit(profile=parse_profile("1deg@0s,0deg@1s", 0.025)).fly(5)
    b.result(ARM, 1.0)
    b.fly(60)
    assert b.result(SET_MODE, CUSTOM, MODES["AUTO"]) == ACCEPTED
    b.fly(10)
    assert {c["r"][0] for c in b.commands[-15:]} == {0.0}


# every command


SERVED = (SET_MODE, STORAGE, ARM, CHECKS, 410, 510, 511, 512, 520)
BATCH = 32


def with_command(template: bytes, at: int, extra: int, command: int) -> bytes:
    """Return a frame with another command number, and the checksum of the frame that it then is."""
    frame = bytearray(template)
    frame[at : at + 2] = command.to_bytes(2, "little")
    frame[-2:] = mcrf4xx(bytes(frame[1:-2]) + bytes([extra])).to_bytes(2, "little")
    return bytes(frame)


@pytest.mark.parametrize("made", [long, integer], ids=["COMMAND_LONG", "COMMAND_INT"])
def test_every_number_of_a_command_gets_exactly_one_acknowledgement_that_goes_to_its_sender(made):
    b = cockpit(ground_stations=2).fly(1)
    kind = type(made(0))
    sender = dialect.MAVLink(None, 77, 91)
    template = made(0xFFFF, *[1.0] * 3).pack(sender)
    at = 10 + struct.calcsize("<" + kind.native_format.decode()[1:].split("H")[0])
    assert template[at : at + 2] == b"\xff\xff"
    for command in (0, 1, 400, 40_000):
        assert with_command(template, at, kind.crc_extra, command) == made(command, *[1.0] * 3).pack(sender)
    acks: list[bytes] = []
    for first in range(0, 1 << 16, BATCH):
        frames = (with_command(template, at, kind.crc_extra, first + n) for n in range(BATCH))
        b.node.receive("gcs0", b"".join(frames), b.now_ns)
        while b.node.next_deadline_ns() == 0:
            b.node.tick(b.now_ns)
        sent = [(port, datagram) for port, datagram in b.node.outgoing() if datagram[7:10] == b"\x4d\0\0"]
        assert {port for port, _ in sent} == {"gcs0"}
        acks += [datagram for _, datagram in sent]
    read = dialect.MAVLink(None).parse_buffer(bytearray(b"".join(acks)))
    assert [m.command for m in read] == list(range(1 << 16))
    assert {(m.target_system, m.target_component) for m in read} == {(77, 91)}
    assert {m.command for m in read if m.result != UNSUPPORTED} | {511} == set(SERVED)  # 511 of a stream there is not
    assert b.node.vehicle.refused == 0


@pytest.mark.parametrize("target", [(2, 1), (1, 2), (1, 25), (255, 190)])
@pytest.mark.parametrize("made", [long, integer])
def test_a_command_for_somebody_else_is_left_alone(made, target):
    b = cockpit().fly(20)
    start = len(b.messages)
    b.hear(made(ARM, 1.0, target=target), made(SET_MODE, CUSTOM, 0.0, target=target))
    b.hear(set_mode(0, system=2), dialect.MAVLink_manual_control_message(2, -1000, 0, 0, 0, 0))
    assert b.heard(start=start) == []
    assert not b.node.commander.armed
    assert b.heartbeat().custom_mode == MODES["AUTO"]
    assert b.node.vehicle.elsewhere == 4


@pytest.mark.parametrize("target", [(1, 1), (1, 0), (0, 0), (0, 1)])
def test_a_command_for_us_or_for_all_is_ours(target):
    b = cockpit().fly(20)
    b.hear(long(ARM, 1.0, target=target))
    assert b.node.commander.armed


def test_an_acknowledgement_goes_to_the_station_that_gave_the_command_and_texts_to_all():
    b = cockpit(ground_stations=3, gains=PAPER).fly(20)
    start = len(b.messages)
    assert [m.result for m in b.order(ARM, 1.0, port="gcs1") if m.get_type() == "COMMAND_ACK"] == [FAILED]
    b.to(b.now_ns + MS)
    [ack] = b.of("COMMAND_ACK", "gcs1", start)
    assert (ack.target_system, ack.target_component) == (254, 190)
    assert b.of("COMMAND_ACK", "gcs0", start) == b.of("COMMAND_ACK", "gcs2", start) == []
    for port in b.stations:
        assert [m.text for m in b.of("STATUSTEXT", port, start)] == ["PreArm: no verified certificate"]
