"""What ground stations see and how they are served, in virtual time and read by pymavlink."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as dialect  # ardupilotmega's has no CURRENT_MODE, development's no AOA_SSA

from autopilot.commander import Commander, FlightMode
from autopilot.config import ZURICH
from autopilot.ground.parameters import PARAMETERS, Parameters
from autopilot.ground.streams import GROUPS, STREAMED
from autopilot.ground.vehicle import (
    MAX_PER_TICK,
    MAX_WAITING,
    PARAMETERS_NS,
    PARAMETERS_PER_TICK,
    Vehicle,
    banner,
)
from autopilot.link.groundmessages import (
    AttitudeTarget,
    CommandLong,
    ExtendedSysState,
    HomePosition,
    MissionRequestList,
    ParamRequestList,
    ParamSet,
    Ping,
    RequestDataStream,
    SetMode,
)
from autopilot.link.signing import Signing
from autopilot.link.wire import (
    AUTOPILOT,
    GROUND_MESSAGES,
    AoaSsa,
    Attitude,
    Heartbeat,
    Message,
    NamedValueFloat,
    NamedValueInt,
    Seal,
    ServoOutputRaw,
    Severity,
    StatusText,
    Timesync,
    VfrHud,
    Wire,
    message_id,
)
from gains.model import Gains, Schedule
from gains.verify import verified
from tests.helpers import HIRM, MS, TS, S

GCS = (255, 190)
START = 1042 * S
NOW = 37_500_000_000_000
"""A time of signatures, in 2026."""
HELLO = Heartbeat(dialect.MAV_TYPE_GCS, dialect.MAV_AUTOPILOT_INVALID, 0, 0, dialect.MAV_STATE_ACTIVE)
OPEN = {"DELAY_MIN": 1, "DELAY_MAX": 4, "ELEV_LOW_DEG": -25, "ELEV_HIGH_DEG": 25}
SET_MESSAGE_INTERVAL, GET_MESSAGE_INTERVAL, REQUEST_MESSAGE, PREFLIGHT_STORAGE = 511, 510, 512, 245
DEFAULT_HZ = {
    "HEARTBEAT": 1.0,
    "SYS_STATUS": 1.0,
    "ATTITUDE": 20.0,
    "VFR_HUD": 5.0,
    "AOA_SSA": 10.0,
    "SERVO_OUTPUT_RAW": 10.0,
    "NAMED_VALUE_INT": 10.0,
    "NAMED_VALUE_FLOAT": 10.0,
    "GLOBAL_POSITION_INT": 2.0,
    "ATTITUDE_TARGET": 5.0,
    "CURRENT_MODE": 0.5,
}


@dataclass
class NoDisk:
    """Parameters that are kept nowhere, and have defaults all the same."""

    parameters: Parameters

    def busy(self, now_ns: int) -> bool:
        return False

    def save(self) -> str | None:
        return "nowhere"

    def reload(self, now_ns: int) -> str | None:
        return "nowhere"

    def defaults(self, now_ns: int) -> str | None:
        self.parameters.announce(self.parameters.reset(now_ns))
        return None


def level(now_ns: int) -> AttitudeTarget:
    return AttitudeTarget(now_ns // MS % (1 << 32), 0, (1.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0, 0.0)


@dataclass
class Scene:
    """A vehicle, what speaks against arming it, and all that its stations have got: time, port, message."""

    ports: tuple[str, ...] = ("gcs0",)
    banner: list[StatusText] = field(default_factory=list)
    seals: Mapping[str, Seal] = field(default_factory=dict)
    now_ns: int = START
    unready: list[str] = field(default_factory=list)
    degraded: bool = False
    got: list[tuple[int, str, dialect.MAVLink_message]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.commander = Commander(lambda _now: list(self.unready), self._tell, 0.0, self_arm=False)
        self.commander.require_certificate = False
        self.parameters = Parameters(OPEN, lambda *_: None, ports=self.ports, names=["hirm-paper"])
        self.vehicle = Vehicle(
            self.ports,
            self.banner,
            self.commander,
            self.parameters,
            NoDisk(self.parameters),
            ZURICH,
            {AttitudeTarget: level},
            self.seals,
        )
        self.stations = {port: Wire(GCS, None, GROUND_MESSAGES) for port in self.ports}

    def _tell(self, severity: int, text: str, _now_ns: int) -> None:
        self.vehicle.say(severity, text)

    def tick(self) -> None:
        self.vehicle.tick(self.now_ns, degraded=self.degraded)
        self.take()

    def take(self) -> None:
        for port, datagram in self.vehicle.outgoing():
            read = dialect.MAVLink(None).parse_buffer(bytearray(datagram))
            self.got += [(self.now_ns, port, m) for m in read]

    def to(self, now_ns: int) -> Scene:
        """Tick whenever something is due, up to ``now_ns``."""
        while (due_ns := self.vehicle.next_deadline_ns()) is not None and due_ns <= now_ns:
            self.now_ns = max(self.now_ns, due_ns)
            self.tick()
        self.now_ns = now_ns
        return self

    def fly(self, duration_ns: int, show: Callable[[int], Iterable[Message]] = lambda _k: ()) -> Scene:
        """Show what a sample says every 25 ms, the first one in 25 ms, and tick then and whenever something is due."""
        start_ns = self.now_ns
        for k in range(1, duration_ns // TS + 1):
            self.show(start_ns + k * TS, *show(k))
        return self

    def show(self, now_ns: int, *messages: Message) -> None:
        """Show messages at a time, and tick at once."""
        self.to(now_ns - 1)  # deliveries come before ticks
        self.now_ns = now_ns
        for message in messages:
            self.vehicle.show(message, now_ns)
        self.tick()

    def hear(self, *messages: Message, port: str = "gcs0") -> bool:
        """Let a station's messages arrive, one datagram each; return whether the last was a station's."""
        heard = False
        for message in messages:
            heard = self.vehicle.receive(port, self.stations[port].encode(message), self.now_ns)
        return heard

    def ask(self, command: int, *params: float, port: str = "gcs0") -> list[dialect.MAVLink_message]:
        """Send a command, and return what comes of it at once: the acknowledgement, and what it asked for."""
        seen = len(self.got)
        self.hear(CommandLong(1, 1, command, 0, *params, *[0.0] * (7 - len(params))), port=port)
        self.tick()
        return [m for _, where, m in self.got[seen:] if where == port]

    def of(self, kind: str, port: str = "gcs0") -> list[dialect.MAVLink_message]:
        return [m for _, where, m in self.got if where == port and m.get_type() == kind]

    def times(self, kind: str, port: str = "gcs0") -> list[int]:
        return [t_ns for t_ns, where, m in self.got if where == port and m.get_type() == kind]

    def texts(self, port: str = "gcs0") -> list[str]:
        return [m.text for m in self.of("STATUSTEXT", port)]


def started(*ports: str, **options) -> Scene:
    """Return a scene whose first heartbeat is gone."""
    scene = Scene(ports or ("gcs0",), **options)
    scene.tick()
    scene.got.clear()
    return scene


def attitude(pitch: float) -> Attitude:
    return Attitude(5, 0.0, pitch, 0.0, 0.0, 0.0, 0.0)


def everything(k: int) -> list[Message]:
    """Return one message of each kind that a sample leads to."""
    return [
        attitude(k / 1024),
        AoaSsa(5_000, k / 1024, 0.0),
        VfrHud(100.0, 100.0, 90, 0, 1600.0, 0.0),
        ServoOutputRaw(0, 1000 + k % 1000),
        NamedValueInt(0, "DELAY_K", k),
        NamedValueFloat(0, "D_PROB", k / 1024),
    ]


# who speaks


def test_everything_speaks_as_system_1_component_1_with_its_own_numbers_per_port():
    scene = started("gcs0", "gcs1", banner=[StatusText(Severity.WARNING, "hello")])
    for n in range(10):
        scene.hear(Ping(n, n, 0, 0), port="gcs1")
    scene.fly(4 * S, everything)
    for port, least in (("gcs0", 256), ("gcs1", 266)):
        messages = [m for _, where, m in scene.got if where == port]
        assert {(m.get_srcSystem(), m.get_srcComponent()) for m in messages} == {AUTOPILOT}
        assert len(messages) > least
        first = messages[0].get_seq()
        assert [m.get_seq() for m in messages] == [(first + n) % 256 for n in range(len(messages))]
    assert len(scene.of("PING", "gcs1")) == 10
    assert not scene.of("PING", "gcs0")


def test_without_stations_nothing_is_sent():
    scene = Scene(())
    scene.vehicle.show(ServoOutputRaw(0, 1500), START)
    scene.vehicle.say(Severity.NOTICE, "hello")
    scene.tick()
    assert scene.to(START + 5 * S).got == []
    assert scene.vehicle.refused == 0


# the heartbeat


def test_the_heartbeat_comes_once_a_second_from_the_first_tick_on():
    scene = Scene()
    assert scene.vehicle.next_deadline_ns() is None
    scene.now_ns = START + 7 * MS
    scene.tick()
    scene.to(START + 5 * S + 7 * MS)
    assert scene.times("HEARTBEAT") == [START + 7 * MS + n * S for n in range(6)]


def test_a_late_tick_sends_one_heartbeat_and_the_next_is_on_the_grid_again():
    scene = started()
    for late_ms in (1000, 4300, 5000, 5999, 6000):
        scene.now_ns = START + late_ms * MS
        scene.tick()
    assert scene.times("HEARTBEAT") == [START + ms * MS for ms in (1000, 4300, 5000, 6000)]


FLAGS = {
    FlightMode.MANUAL: dialect.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED,
    FlightMode.STABILIZE: dialect.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED | dialect.MAV_MODE_FLAG_STABILIZE_ENABLED,
    FlightMode.AUTO: dialect.MAV_MODE_FLAG_STABILIZE_ENABLED
    | dialect.MAV_MODE_FLAG_GUIDED_ENABLED
    | dialect.MAV_MODE_FLAG_AUTO_ENABLED,
    FlightMode.GUIDED: dialect.MAV_MODE_FLAG_STABILIZE_ENABLED | dialect.MAV_MODE_FLAG_GUIDED_ENABLED,
}


@pytest.mark.parametrize("mode", FlightMode)
@pytest.mark.parametrize("armed", [False, True])
@pytest.mark.parametrize("degraded", [False, True])
def test_the_heartbeat_says_mode_arming_and_health(mode, armed, degraded):
    scene = started(degraded=degraded)
    scene.commander.set_mode(mode, START)
    if armed:
        scene.commander.arm(START)
    [beat] = scene.to(START + S).of("HEARTBEAT")
    assert (beat.type, beat.autopilot) == (dialect.MAV_TYPE_FIXED_WING, dialect.MAV_AUTOPILOT_GENERIC)
    assert beat.custom_mode == getattr(dialect, f"PLANE_MODE_{mode.name}")
    own = dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | (dialect.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0)
    assert beat.base_mode == own | FLAGS[mode]
    flying = dialect.MAV_STATE_CRITICAL if degraded else dialect.MAV_STATE_ACTIVE
    assert beat.system_status == (flying if armed else dialect.MAV_STATE_STANDBY)


def test_the_first_mode_is_auto_and_a_change_is_in_the_next_heartbeat_and_current_mode():
    scene = started()
    scene.to(START + S)
    scene.hear(SetMode(1, 1, FlightMode.GUIDED))
    scene.to(START + 4 * S)
    assert [m.custom_mode for m in scene.of("HEARTBEAT")] == [10, 15, 15, 15]
    assert [m.custom_mode for m in scene.of("CURRENT_MODE")] == [15, 15]
    assert scene.texts() == ["mode GUIDED"]


# the banner


def test_the_banner_is_told_before_the_first_heartbeat_and_once_more_to_a_station_that_first_speaks():
    scene = Scene(("gcs0", "gcs1"), [StatusText(Severity.WARNING, "no certificate")])
    scene.tick()
    for port in scene.ports:
        assert [m.get_type() for _, where, m in scene.got if where == port] == [
            "HOME_POSITION",
            "STATUSTEXT",
            "HEARTBEAT",
        ]
    assert scene.texts() == ["no certificate"]
    scene.got.clear()
    for _ in range(3):
        scene.hear(HELLO, port="gcs1")
        scene.to(scene.now_ns)
    assert [(port, m.text, m.severity) for _, port, m in scene.got] == [("gcs1", "no certificate", 4)]


def test_noise_and_our_own_echo_are_nobody_speaking():
    scene = started(banner=[StatusText(Severity.WARNING, "no certificate")])
    frame = scene.stations["gcs0"].encode(HELLO)
    for datagram in (b"", b"noise", frame[:-1], Wire(AUTOPILOT, None).encode(HELLO)):
        assert not scene.vehicle.receive("gcs0", datagram, START)
    assert scene.to(START).got == []
    assert scene.vehicle.receive("gcs0", frame, START)
    assert scene.to(START).texts() == ["no certificate"]


def test_what_a_station_says_about_itself_is_no_measurement():
    scene = started()
    vehicle = Wire((1, 25), None)
    for message in everything(1):
        assert not scene.vehicle.receive("gcs0", vehicle.encode(message), START)
    assert {m.get_type() for _, _, m in scene.to(START + S).got} <= {"HEARTBEAT", "SYS_STATUS", "ATTITUDE_TARGET"}
    assert scene.vehicle.wires["gcs0"].rejects == {"unhandled": 6}


# what is shown


def test_what_is_shown_goes_out_when_due_with_the_time_it_was_shown_on_the_autopilots_clock():
    scene = started()
    scene.now_ns = START + 3 * MS
    for message in (
        Attitude(5, 0.5, 0.25, -0.5, 0.125, -0.5, 1.0),
        AoaSsa(5_000, 1.5, -0.5),
        ServoOutputRaw(0, 1520),
        VfrHud(100.0, 101.0, 90, 50, 1600.0, 2.5),
        NamedValueInt(7, "DELAY_K", 3),
        NamedValueFloat(8, "D_MEAN", 2.25),
    ):
        scene.vehicle.show(message, scene.now_ns)
    for ms in range(3, 201):
        scene.now_ns = START + ms * MS
        scene.tick()
    [shown], [air], [servo], [hud] = map(scene.of, ("ATTITUDE", "AOA_SSA", "SERVO_OUTPUT_RAW", "VFR_HUD"))
    [delay], [mean] = map(scene.of, ("NAMED_VALUE_INT", "NAMED_VALUE_FLOAT"))
    assert scene.times("ATTITUDE") == [START + 50 * MS]
    assert scene.times("AOA_SSA") == scene.times("SERVO_OUTPUT_RAW") == [START + 100 * MS]
    assert shown.time_boot_ms == 1_042_003
    assert (shown.roll, shown.pitch, shown.yaw) == (0.5, 0.25, -0.5)
    assert (shown.rollspeed, shown.pitchspeed, shown.yawspeed) == (0.125, -0.5, 1.0)
    assert (air.time_usec, air.AOA, air.SSA) == (1_042_003_000, 1.5, -0.5)
    assert (servo.time_usec, servo.servo2_raw) == (1_042_003_000, 1520)
    assert (hud.airspeed, hud.groundspeed, hud.heading, hud.throttle, hud.alt, hud.climb) == (
        *(100.0, 101.0, 90, 50, 1600.0, 2.5),
    )
    assert (delay.time_boot_ms, delay.name, delay.value) == (1_042_003, "DELAY_K", 3)
    assert (mean.time_boot_ms, mean.name, mean.value) == (1_042_003, "D_MEAN", 2.25)


def test_each_time_the_newest_value_is_shown():
    scene = started()
    scene.fly(2 * S, everything)
    assert [m.pitch * 1024 for m in scene.of("ATTITUDE")] == [2 * n for n in range(1, 41)]
    assert [m.value for m in scene.of("NAMED_VALUE_INT")] == [4 * n for n in range(1, 21)]
    assert scene.times("ATTITUDE") == [START + 2 * n * TS for n in range(1, 41)]
    assert [m.time_boot_ms for m in scene.of("ATTITUDE")] == [(START + 2 * n * TS) // MS for n in range(1, 41)]


def test_news_that_comes_when_a_message_is_overdue_is_shown_at_once_and_the_next_is_on_the_grid_again():
    scene = started()
    for ms in (63, 99, 100, 170, 199, 200):
        scene.show(START + ms * MS, attitude(ms / 1024))
    assert [t_ns - START for t_ns in scene.times("ATTITUDE")] == [63 * MS, 100 * MS, 170 * MS, 200 * MS]
    assert [m.pitch * 1024 for m in scene.of("ATTITUDE")] == [63, 100, 170, 200]


def test_what_a_source_that_stood_still_has_left_out_is_not_made_up_for():
    scene = started()
    scene.fly(S, everything)
    scene.fly(10 * S)
    scene.got.clear()
    scene.fly(S, everything)
    assert [len(scene.of(kind)) for kind in ("ATTITUDE", "AOA_SSA", "VFR_HUD")] == [1 + 20, 1 + 10, 1 + 5]
    assert scene.times("ATTITUDE")[:3] == [START + 11 * S + ms * MS for ms in (25, 50, 100)]


def test_no_stream_of_what_is_shown_wakes_the_vehicle():
    scene = started()
    for kind in ("SYS_STATUS", "GLOBAL_POSITION_INT", "ATTITUDE_TARGET", "CURRENT_MODE"):
        scene.ask(SET_MESSAGE_INTERVAL, next(n for n in STREAMED if dialect.mavlink_map[n].msgname == kind), -1.0)
    for message in everything(1):
        scene.vehicle.show(message, START)
    assert scene.vehicle.next_deadline_ns() == START + S


def test_nothing_is_shown_twice():
    scene = started()
    scene.fly(10 * S, lambda k: everything(1) if k == 1 else [])
    measured = ("ATTITUDE", "AOA_SSA", "VFR_HUD", "SERVO_OUTPUT_RAW", "NAMED_VALUE_INT", "NAMED_VALUE_FLOAT")
    assert [len(scene.of(kind)) for kind in measured] == [1] * 6
    scene.fly(S, lambda k: [attitude(2.0)] if k == 1 else [])
    assert [m.pitch for m in scene.of("ATTITUDE")] == [1 / 1024, 2.0]


def test_news_of_one_name_does_not_show_another_again():
    scene = started()
    scene.fly(S, lambda k: [NamedValueInt(0, "DELAY_K", k), *([NamedValueInt(0, "D_EST", 3)] if k == 1 else [])])
    counts = Counter(m.name for m in scene.of("NAMED_VALUE_INT"))
    assert counts == {"DELAY_K": 10, "D_EST": 1}


@pytest.mark.parametrize("seed", range(5))
def test_what_is_due_at_once_leaves_in_the_order_in_which_it_was_shown(seed):
    scene = started()
    shown = [everything(1)[n] for n in np.random.default_rng(seed).permutation(6)]
    scene.now_ns = START + 999 * MS
    for message in shown:
        scene.vehicle.show(message, scene.now_ns)
    scene.tick()
    ids = {message_id(type(message)) for message in shown}
    assert [m.get_msgId() for _, _, m in scene.got if m.get_msgId() in ids] == [message_id(type(m)) for m in shown]


def test_an_equal_value_that_is_new_is_shown_again():
    scene = started()
    scene.fly(S, lambda _k: [attitude(0.5)])
    assert len(scene.of("ATTITUDE")) == 20


def test_values_with_different_names_are_shown_side_by_side():
    scene = started()
    names = ["DELAY_K", "D_EST", "D_LOW"]
    scene.fly(S + 3 * TS, lambda k: [NamedValueInt(0, names[k % 3], k)] if k <= 40 else [])
    newest: dict[str, int] = {}
    for m in scene.of("NAMED_VALUE_INT"):
        assert m.value > newest.get(m.name, -1)
        newest[m.name] = m.value
    assert newest == {"DELAY_K": 39, "D_EST": 40, "D_LOW": 38}


def test_times_wrap_for_a_station_too():
    scene = Scene(now_ns=((1 << 32) + 9) * MS)
    scene.vehicle.show(attitude(0.0), scene.now_ns)
    scene.vehicle.show(ServoOutputRaw(0, 1500), scene.now_ns)
    scene.vehicle.show(VfrHud(100.0, 100.0, 90, 0, 1600.0, 0.0), scene.now_ns)
    shown_ns = scene.now_ns
    scene.tick()
    scene.fly(S)
    assert scene.of("ATTITUDE")[0].time_boot_ms == 9
    assert scene.of("SERVO_OUTPUT_RAW")[0].time_usec == (shown_ns // 1000) % (1 << 32)
    assert scene.of("GLOBAL_POSITION_INT")[0].time_boot_ms < 2000


# rates


def test_by_default_each_message_comes_at_its_rate_to_every_station():
    scene = started("gcs0", "gcs1").fly(20 * S, everything)
    for port in scene.ports:
        counts = Counter(m.get_type() for _, where, m in scene.got if where == port)
        assert {kind: count / 20 for kind, count in counts.items()} == DEFAULT_HZ


def test_each_station_has_its_own_rates():
    scene = started("gcs0", "gcs1", "gcs2")
    assert scene.ask(SET_MESSAGE_INTERVAL, 30, 25_000.0, port="gcs0")[0].result == dialect.MAV_RESULT_ACCEPTED
    assert scene.ask(SET_MESSAGE_INTERVAL, 30, -1.0, port="gcs1")[0].result == dialect.MAV_RESULT_ACCEPTED
    scene.got.clear()
    scene.fly(4 * S, everything)
    assert [len(scene.of("ATTITUDE", port)) for port in scene.ports] == [160, 0, 80]
    assert [len(scene.of("AOA_SSA", port)) for port in scene.ports] == [40, 40, 40]
    scene.ask(SET_MESSAGE_INTERVAL, 30, 0.0, port="gcs0")
    scene.got.clear()
    scene.fly(4 * S, everything)
    assert [len(scene.of("ATTITUDE", port)) for port in scene.ports] == [80, 0, 80]


@pytest.mark.parametrize(("asked_us", "found_us"), [(20_000, 20_000), (-1, -1), (0, 50_000), (1, 10_000)])
def test_an_interval_is_told_as_it_is_in_force_and_none_is_under_10_ms(asked_us, found_us):
    scene = started("gcs0", "gcs1")
    scene.ask(SET_MESSAGE_INTERVAL, 30, asked_us)
    for port, expected_us in (("gcs0", found_us), ("gcs1", 50_000)):
        ack, told = scene.ask(GET_MESSAGE_INTERVAL, 30, port=port)
        assert (ack.result, told.message_id, told.interval_us) == (dialect.MAV_RESULT_ACCEPTED, 30, expected_us)


def test_a_rate_that_a_parameter_sets_counts_for_stations_that_asked_for_none():
    scene = started("gcs0", "gcs1")
    scene.ask(SET_MESSAGE_INTERVAL, 30, 100_000.0, port="gcs1")
    scene.hear(ParamSet(1, 1, "RATE_ATT", 40.0, 9))
    scene.to(scene.now_ns)
    scene.got.clear()
    scene.fly(2 * S, everything)
    assert [len(scene.of("ATTITUDE", port)) for port in scene.ports] == [80, 20]
    scene.hear(ParamSet(1, 1, "RATE_ATT", 0.0, 9))
    scene.to(scene.now_ns)
    scene.got.clear()
    scene.fly(2 * S, everything)
    assert [len(scene.of("ATTITUDE", port)) for port in scene.ports] == [0, 20]


MEMBERS = {
    "RAW_SENSORS": set(),
    "EXTENDED_STATUS": {"SYS_STATUS"},
    "RC_CHANNELS": {"SERVO_OUTPUT_RAW"},
    "POSITION": {"GLOBAL_POSITION_INT"},
    "EXTRA1": {"ATTITUDE", "AOA_SSA", "ATTITUDE_TARGET"},
    "EXTRA2": {"VFR_HUD"},
    "EXTRA3": {"NAMED_VALUE_INT", "NAMED_VALUE_FLOAT"},
}


@pytest.mark.parametrize("group", [*MEMBERS, "ALL"])
@pytest.mark.parametrize("start", [0, 1])
def test_a_group_of_messages_is_set_to_a_rate_or_stopped(group, start):
    scene = started("gcs0", "gcs1")
    scene.hear(RequestDataStream(1, 1, getattr(dialect, f"MAV_DATA_STREAM_{group}"), 4, start))
    scene.fly(4 * S, everything)
    members = set().union(*MEMBERS.values()) if group == "ALL" else MEMBERS[group]
    for kind, default in DEFAULT_HZ.items():
        hz = 4.0 * start if kind in members else default
        assert (len(scene.of(kind)), len(scene.of(kind, "gcs1"))) == (4 * hz, 4 * default), kind


def test_the_groups_have_mavlinks_numbers():
    assert {getattr(dialect, f"MAV_DATA_STREAM_{group}") for group in MEMBERS} == set(GROUPS)


def test_every_streamed_message_can_be_had_at_once_and_at_a_rate():
    scene = started()
    scene.fly(100 * MS, everything)
    for number in STREAMED:
        kind = dialect.mavlink_map[number].msgname
        ack, *found = scene.ask(REQUEST_MESSAGE, number)
        assert (ack.get_type(), ack.result) == ("COMMAND_ACK", dialect.MAV_RESULT_ACCEPTED)
        assert [m.get_type() for m in found] == [kind]
        scene.ask(SET_MESSAGE_INTERVAL, number, 500_000.0)
        scene.got.clear()
        scene.fly(2 * S, everything)
        assert len(scene.of(kind)) == 4, kind


def test_what_is_not_known_yet_is_not_made_up_when_it_is_asked_for():
    scene = started()
    for number in (30, 74, 33):
        [ack] = scene.ask(REQUEST_MESSAGE, number)
        assert ack.result == dialect.MAV_RESULT_TEMPORARILY_REJECTED
    assert scene.to(START + S).of("GLOBAL_POSITION_INT") == []


def sent_in_two_hours(scene: Scene, gap_ms: int) -> dict[int, list[int]]:
    """Tick at random times, none further apart than ``gap_ms``, with news each time; return when each id was sent."""
    rng = np.random.default_rng(1)
    vehicle, sent = scene.vehicle, {}
    gaps_ms = rng.integers(1, gap_ms + 1, 2 * 7200 * 1000 // gap_ms + 1000)
    for now_ns in (START + np.cumsum(gaps_ms) * MS).tolist():
        if now_ns > START + 7200 * S:
            break
        vehicle.show(attitude(0.0), now_ns)
        vehicle.tick(now_ns, degraded=False)
        for _, datagram in vehicle.outgoing():
            sent.setdefault(int.from_bytes(datagram[7:10], "little"), []).append(now_ns)
    assert now_ns > START + 7200 * S
    return sent


@pytest.mark.parametrize(("hz", "gap_ms"), [(3.0, 200), (0.7, 250), (0.7, 700)])
def test_rates_do_not_drift_in_two_hours_however_late_the_ticks_come(hz, gap_ms):
    scene = started()
    scene.hear(RequestDataStream(1, 1, dialect.MAV_DATA_STREAM_ALL, 0, 0))
    interval_us = round(1e6 / hz)
    for number, interval in ((30, interval_us), (1, interval_us), (436, -1)):
        scene.ask(SET_MESSAGE_INTERVAL, number, interval)
    scene.to(START)
    sent = sent_in_two_hours(scene, gap_ms)
    assert sent.keys() == {0, 1, 30}
    for number, times_ns in sent.items():
        grid_ns = S if number == 0 else interval_us * 1000
        steps = [t_ns // grid_ns for t_ns in times_ns]  # START is on the heartbeat's grid
        assert steps == list(range(START // grid_ns + 1, steps[-1] + 1))
        assert times_ns[-1] >= START + 7200 * S - grid_ns - gap_ms * MS
        assert all(t_ns - n * grid_ns < gap_ms * MS for t_ns, n in zip(times_ns, steps, strict=True))


# what waits


def test_a_message_goes_to_every_station():
    scene = started("gcs0", "gcs1", "gcs2")
    scene.vehicle.say(Severity.NOTICE, "hello")
    scene.tick()
    assert [(port, m.severity, m.text) for _, port, m in scene.got] == [
        (port, 5, "hello") for port in ("gcs0", "gcs1", "gcs2")
    ]


def test_what_waits_for_a_station_is_bounded_and_counted_and_no_other_station_waits_for_it():
    scene = started("gcs0", "gcs1")
    scene.hear(*(Ping(n, n, 0, 0) for n in range(MAX_WAITING + 9)))
    scene.hear(Ping(7, 7, 0, 0), port="gcs1")
    assert scene.vehicle.refused == 9
    assert scene.vehicle.next_deadline_ns() == 0
    sizes = []
    while scene.vehicle.next_deadline_ns() == 0:
        before = len(scene.of("PING"))
        scene.tick()
        sizes.append(len(scene.of("PING")) - before)
        assert [m.seq for m in scene.of("PING", "gcs1")] == [7]
    assert [m.seq for m in scene.of("PING")] == list(range(MAX_WAITING))
    assert max(sizes) == MAX_PER_TICK
    assert len(sizes) == MAX_WAITING // MAX_PER_TICK


def test_streams_and_heartbeat_do_not_wait_for_answers():
    scene = started()
    scene.hear(*(Ping(n, n, 0, 0) for n in range(MAX_WAITING)))
    scene.now_ns = START + S
    scene.vehicle.show(attitude(0.5), START + S)
    scene.tick()
    kinds = [m.get_type() for _, _, m in scene.got]
    assert "PING" not in kinds[:-MAX_PER_TICK]
    assert {"HEARTBEAT", "ATTITUDE", "SYS_STATUS"} <= set(kinds[:-MAX_PER_TICK])


def test_what_is_shown_takes_no_room_however_much_it_is():
    scene = started()
    for n in range(10 * MAX_WAITING):
        scene.vehicle.show(NamedValueInt(0, "DELAY_K", n), START)
    assert scene.vehicle.next_deadline_ns() > START
    scene.vehicle.say(Severity.WARNING, "TRACKING to HOLD")
    scene.fly(S)
    assert scene.texts() == ["TRACKING to HOLD"]
    assert [m.value for m in scene.of("NAMED_VALUE_INT")] == [10 * MAX_WAITING - 1]
    assert scene.vehicle.refused == 0


def test_a_transition_is_said_even_when_everything_else_is_full():
    scene = started()
    scene.hear(*(Ping(n, n, 0, 0) for n in range(MAX_WAITING)))
    scene.vehicle.say(Severity.WARNING, "TRACKING to HOLD")
    scene.to(START)
    assert scene.texts() == ["TRACKING to HOLD"]


# signed links


def test_a_signed_link_takes_and_sends_signed_frames_only_and_leaves_the_others_as_they_are():
    seal = Signing(bytes(range(32)), 1, NOW)
    scene = started("gcs0", "gcs1", seals={"gcs0": seal})
    assert not scene.hear(Ping(7, 1, 0, 0))
    assert scene.hear(Ping(7, 2, 0, 0), port="gcs1")
    scene.stations["gcs0"].seal = Signing(bytes(range(32)), 9, NOW)
    assert scene.hear(Ping(7, 3, 0, 0))
    scene.to(START + S)
    assert [m.seq for m in scene.of("PING")] == [3]
    assert [m.seq for m in scene.of("PING", "gcs1")] == [2]
    assert scene.vehicle.wires["gcs0"].rejects == {"unsigned": 1}
    assert seal.counts == {"accepted": 1, "unsigned": 1}
    frames = {port: [m.get_msgbuf() for _, where, m in scene.got if where == port] for port in scene.ports}
    assert {frame[2] for frame in frames["gcs1"]} == {0}
    station = dialect.MAVLink(None)
    station.signing.secret_key, station.signing.timestamp = bytes(range(32)), NOW
    assert len(station.parse_buffer(b"".join(frames["gcs0"]))) == len(frames["gcs0"]) == station.signing.goodsig_count


# who is meant


@pytest.mark.parametrize(
    ("target", "served"),
    [((1, 1), True), ((1, 0), True), ((0, 0), True), ((2, 1), False), ((1, 2), False), ((255, 190), False)],
)
def test_only_what_is_addressed_to_us_or_to_all_is_served_and_the_rest_is_counted(target, served):
    scene = started()
    assert scene.hear(CommandLong(*target, REQUEST_MESSAGE, 0, 242.0, *[0.0] * 6))
    assert scene.hear(ParamRequestList(*target))
    assert scene.hear(MissionRequestList(*target, 0))
    scene.to(START + 500 * MS)
    kinds = {"COMMAND_ACK", "HOME_POSITION", "PARAM_VALUE", "MISSION_COUNT"}
    assert ({m.get_type() for _, _, m in scene.got} & kinds) == (kinds if served else set())
    assert scene.vehicle.elsewhere == (0 if served else 3)


def test_an_answer_goes_to_the_station_that_asked_and_names_it():
    scene = started("gcs0", "gcs1")
    scene.stations["gcs1"] = Wire((42, 17), None, GROUND_MESSAGES)
    ack, home = scene.ask(REQUEST_MESSAGE, 242, port="gcs1")
    assert (ack.command, ack.result, ack.target_system, ack.target_component) == (REQUEST_MESSAGE, 0, 42, 17)
    assert (home.latitude, home.longitude, home.altitude) == (473977420, 85455940, 488_000)
    assert [m for _, port, m in scene.got if port == "gcs0"] == []


def test_clocks_and_pings_are_answered_once_with_what_was_asked():
    scene = started()
    scene.hear(Timesync(0, 12345), Timesync(99, 12345), Ping(7, 3, 0, 0), Ping(7, 3, 1, 1))
    scene.to(START)
    [sync], [ping] = scene.of("TIMESYNC"), scene.of("PING")
    assert (sync.tc1, sync.ts1) == (START, 12345)
    assert (ping.time_usec, ping.seq, ping.target_system, ping.target_component) == (7, 3, *GCS)


def test_a_command_that_nobody_serves_is_acknowledged_as_unsupported():
    scene = started()
    [ack] = scene.ask(31_000)
    assert (ack.command, ack.result) == (31_000, dialect.MAV_RESULT_UNSUPPORTED)


# parameters


def test_a_list_of_parameters_goes_out_in_portions_and_to_the_station_that_asked():
    scene = started("gcs0", "gcs1")
    scene.hear(ParamRequestList(1, 1))
    scene.to(START + S)
    values, times = scene.of("PARAM_VALUE"), scene.times("PARAM_VALUE")
    assert [m.param_index for m in values] == list(range(len(PARAMETERS)))
    assert [m.param_id for m in values] == [each.name for each in PARAMETERS]
    assert {m.param_count for m in values} == {len(PARAMETERS)}
    assert times == [START + n // PARAMETERS_PER_TICK * PARAMETERS_NS for n in range(len(PARAMETERS))]
    assert scene.of("PARAM_VALUE", "gcs1") == []


def test_two_stations_get_their_lists_side_by_side():
    scene = started("gcs0", "gcs1")
    scene.hear(ParamRequestList(1, 1))
    scene.to(START + 15 * MS)
    scene.hear(ParamRequestList(1, 1), port="gcs1")
    scene.to(START + S)
    for port, at_ns in (("gcs0", START), ("gcs1", START + 15 * MS)):
        assert [m.param_index for m in scene.of("PARAM_VALUE", port)] == list(range(len(PARAMETERS)))
        assert scene.times("PARAM_VALUE", port)[0] == at_ns


def test_requests_for_the_list_without_end_do_not_make_it_come_faster():
    scene = started()
    for ms in range(100):
        scene.to(START + ms * MS)
        scene.hear(*[ParamRequestList(1, 1)] * 10)
    assert len(scene.of("PARAM_VALUE")) <= 10 * PARAMETERS_PER_TICK
    assert scene.vehicle.refused == 0
    scene.to(scene.now_ns + S)
    assert sorted(m.param_index for m in scene.of("PARAM_VALUE")[-len(PARAMETERS) :]) == list(range(len(PARAMETERS)))


def test_a_new_value_is_told_to_all_stations_and_a_refusal_to_the_asker_with_a_text_to_all():
    scene = started("gcs0", "gcs1")
    scene.hear(ParamSet(1, 1, "FS_HOLD_S", 2.0, 9), ParamSet(1, 1, "FS_HOLD_S", 61.0, 9))
    scene.to(START)
    values = {port: [m.param_value for m in scene.of("PARAM_VALUE", port)] for port in scene.ports}
    assert values == {"gcs0": [2.0, 2.0], "gcs1": [2.0]}
    [error] = scene.of("PARAM_ERROR")
    assert (error.param_id, error.error) == ("FS_HOLD_S", dialect.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE)
    assert scene.of("PARAM_ERROR", "gcs1") == []
    assert scene.texts() == scene.texts("gcs1") == ["FS_HOLD_S 61: expected 0 to 60"]


def test_values_that_went_back_to_their_defaults_are_told_to_all_stations():
    scene = started("gcs0", "gcs1")
    scene.hear(ParamSet(1, 1, "FS_HOLD_S", 2.0, 9), ParamSet(1, 1, "STICK_DEG", 5.0, 9))
    scene.to(START)
    scene.got.clear()
    scene.ask(PREFLIGHT_STORAGE, 2.0)
    scene.to(START + S)
    assert [m.result for m in scene.of("COMMAND_ACK")] == [dialect.MAV_RESULT_ACCEPTED]
    for port in scene.ports:
        told = [(m.param_id, m.param_value) for m in scene.of("PARAM_VALUE", port)]
        assert told == [("FS_HOLD_S", 0.5), ("STICK_DEG", 15.0)]


def test_parameters_that_cannot_be_kept_are_refused_with_the_reason():
    scene = started("gcs0", "gcs1")
    scene.ask(PREFLIGHT_STORAGE, 1.0)
    assert [m.result for m in scene.of("COMMAND_ACK")] == [dialect.MAV_RESULT_FAILED]
    assert scene.to(START).texts() == scene.texts("gcs1") == ["nowhere"]


# what a station's map and instruments need


def test_what_speaks_against_arming_is_in_sys_status_and_in_a_text_for_each_reason():
    scene = started("gcs0", "gcs1", unready=["plant clock not locked", "no fresh state"])
    scene.ask(400, 1.0)
    scene.to(START + S)
    assert scene.texts() == scene.texts("gcs1") == ["PreArm: plant clock not locked", "PreArm: no fresh state"]
    scene.unready.clear()
    scene.to(START + 2 * S)
    health = [
        bool(m.onboard_control_sensors_health & dialect.MAV_SYS_STATUS_PREARM_CHECK) for m in scene.of("SYS_STATUS")
    ]
    assert health == [False, True]
    scene.ask(400, 1.0)
    results = [(m.command, m.result) for m in scene.of("COMMAND_ACK")]
    assert results == [(400, dialect.MAV_RESULT_FAILED), (400, dialect.MAV_RESULT_ACCEPTED)]
    assert scene.commander.armed
    assert scene.texts()[2:] == scene.texts("gcs1")[2:] == ["armed"]


def test_the_position_goes_the_way_that_airspeed_and_heading_make():
    scene = started()
    scene.fly(10 * S, lambda _k: [VfrHud(100.0, 100.0, 90, 0, 1600.0, -2.0)])
    first, *_, last = scene.of("GLOBAL_POSITION_INT")
    seconds = (last.time_boot_ms - first.time_boot_ms) / 1000
    metres_per_degree = np.pi / 180 * 6_371_000 * np.cos(np.radians(47.397742))
    assert (last.lon - first.lon) / 1e7 * metres_per_degree == pytest.approx(100.0 * seconds, rel=1e-3)
    assert last.lat == first.lat == 473977420
    assert (last.vx, last.vy, last.vz, last.hdg) == (0, 10_000, 200, 9_000)
    assert (last.alt, last.relative_alt) == (1_600_000, 1_112_000)


def test_home_and_landed_state_are_told_when_asked_for():
    scene = started()
    for message, number in ((HomePosition, 242), (ExtendedSysState, 245)):
        ack, told = scene.ask(REQUEST_MESSAGE, number)
        assert ack.result == dialect.MAV_RESULT_ACCEPTED
        assert told.get_msgId() == number, message
    assert told.landed_state == dialect.MAV_LANDED_STATE_IN_AIR


# start-up texts


def scheduled(windows: list[tuple[int, int]]) -> Schedule:
    sets = [Gains(f"set {i}", HIRM.model, low, high, HIRM.K1, HIRM.K2) for i, (low, high) in enumerate(windows)]
    return Schedule("wide", HIRM.model, tuple(sets))


@pytest.mark.parametrize(
    ("windows", "text"),
    [
        ([(1, 2), (2, 4)], "2 gain sets: delay 1..2, 2..4"),
        ([(d, d + 1) for d in range(8, 12)], "4 gain sets: delay 8..9, 9..10, 10..11, 11..12"),
        ([(d, d + 1) for d in range(1, 40)], "39 gain sets: delay 1 to 40"),
    ],
)
def test_the_windows_of_a_schedule_are_told_whole_or_as_one(windows: list[tuple[int, int]], text: str) -> None:
    schedule = scheduled(windows)
    certificate, sets = banner(schedule, verified(schedule))
    assert certificate.text == "no verified certificate: schedule wide"
    assert sets.text == text
    assert len(sets.text) <= 50


def test_one_set_of_gains_is_announced_in_one_text() -> None:
    [text] = banner(HIRM, verified(HIRM))
    assert text.text == "no verified certificate: gains hirm-paper"
