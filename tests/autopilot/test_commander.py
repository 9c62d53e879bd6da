"""What the ground has asked for, without a vehicle around it: setpoints against SciPy's rotations, sticks, silence."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect
from scipy.spatial.transform import Rotation

from autopilot.commander import (
    MAX_SENDERS,
    REFERENCE_NS,
    Commander,
    FlightMode,
    Moving,
    Programmed,
    Steady,
    pitch_of,
)
from autopilot.link.groundmessages import ManualControl, RcChannelsOverride, SetAttitudeTarget
from tests.helpers import MS, S

quick = settings(deadline=None)
GCS = (255, 190)
LEVEL = (1.0, 0.0, 0.0, 0.0)
IGNORE_ATTITUDE = dialect.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE
IGNORE_PITCH_RATE = dialect.ATTITUDE_TARGET_TYPEMASK_BODY_PITCH_RATE_IGNORE
ALL_RATES = 7
TRIM = math.radians(4.0)
angles = st.floats(-math.pi, math.pi)
pitches = st.floats(-1.5, 1.5)


@dataclass
class Scene:
    """A commander that has nothing against arming, armed in a mode at 100 s, and what it has told."""

    mode: FlightMode = FlightMode.GUIDED
    trim_rad: float = 0.0
    now_ns: int = 100 * S
    texts: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.it = Commander(lambda _now: [], self._tell, self.trim_rad, self_arm=False)
        assert self.it.arm(self.now_ns) == []
        self.it.set_mode(self.mode, self.now_ns)
        self.texts.clear()

    def _tell(self, _severity: int, text: str, _now_ns: int) -> None:
        self.texts.append(text)

    def setpoint(
        self,
        q: tuple[float, ...] = LEVEL,
        mask: int = ALL_RATES,
        rate: float = 0.0,
        stamp: int = 0,
        sender: tuple[int, int] = GCS,
    ) -> Scene:
        self.it.attitude_target(SetAttitudeTarget(stamp, 1, 1, mask, q, 9.0, rate, 9.0, 0.5), sender, self.now_ns)
        return self

    def forward(self, x: int) -> Scene:
        self.it.manual_control(ManualControl(1, x, 0, 0, 0, 0), GCS, self.now_ns)
        return self

    def pulse(self, chan2: int) -> Scene:
        self.it.rc_override(RcChannelsOverride(1, 1, chan2), GCS, self.now_ns)
        return self

    @property
    def pitch(self) -> float:
        target = self.it.target
        assert isinstance(target, Steady)
        return target.pitch_rad


def scalar_first(rotation: Rotation) -> tuple[float, ...]:
    x, y, z, w = rotation.as_quat()
    return w, x, y, z


def pitched(pitch: float) -> tuple[float, ...]:
    return scalar_first(Rotation.from_euler("y", pitch))


# the quaternion


@quick
@given(angles, pitches, angles, st.sampled_from([1.0, -1.0]), st.floats(0.6, 1.9))
def test_the_pitch_of_a_quaternion_is_that_of_scipy_s_yaw_pitch_roll_whatever_roll_yaw_sign_and_length(
    yaw, pitch, roll, sign, length
):
    rotation = Rotation.from_euler("ZYX", [yaw, pitch, roll])
    q = tuple(sign * length * value for value in scalar_first(rotation))
    assert pitch_of(q) == pytest.approx(rotation.as_euler("ZYX")[1], abs=1e-9)
    assert pitch_of(q) == pytest.approx(pitch, abs=1e-9)


@pytest.mark.parametrize(
    ("q", "degrees"),
    [
        (LEVEL, 0.0),
        ((math.cos(math.radians(15)), 0.0, math.sin(math.radians(15)), 0.0), 30.0),
        ((math.cos(math.radians(15)), 0.0, -math.sin(math.radians(15)), 0.0), -30.0),
        ((math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0), 90.0),
        ((0.0, 1.0, 0.0, 0.0), 0.0),  # on its back
        ((math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)), 0.0),  # to the east
    ],
)
def test_the_pitch_of_rotations_that_one_can_see(q, degrees):
    assert math.degrees(pitch_of(q)) == pytest.approx(degrees, abs=1e-6)


@pytest.mark.parametrize(
    "q",
    [
        (0.0, 0.0, 0.0, 0.0),
        (math.nan, 0.0, 0.0, 0.0),
        (1.0, math.nan, 0.0, 0.0),
        (math.inf, 0.0, 0.0, 0.0),
        (3.0, 3.0, 3.0, 3.0),
        (3e38, 3e38, 3e38, 3e38),
        (1e-30, 0.0, 0.0, 0.0),
        (0.49, 0.0, 0.0, 0.0),
    ],
)
def test_what_is_no_rotation_has_no_pitch_and_is_refused_and_counted(q):
    assert pitch_of(q) is None
    scene = Scene().setpoint(pitched(0.1)).setpoint(q)
    assert (scene.pitch, scene.it.refused) == (pytest.approx(0.1), 1)


def test_the_setpoint_counts_from_trim():
    assert Scene(trim_rad=TRIM).setpoint(pitched(0.1)).pitch == pytest.approx(0.1 - TRIM)


# the type mask


def test_the_mask_says_whether_a_pitch_or_a_pitch_rate_is_meant():
    for mask in range(256):
        scene = Scene().setpoint(pitched(0.1), mask, rate=0.02)
        if not mask & IGNORE_ATTITUDE:
            assert scene.pitch == pytest.approx(0.1), mask
        elif not mask & IGNORE_PITCH_RATE:
            assert scene.it.target == Moving(0.02), mask
        else:
            assert (scene.pitch, scene.it.refused) == (0.0, 1), mask
            assert scene.it.next_deadline_ns() is None
            continue
        assert scene.it.refused == 0


@pytest.mark.parametrize("rate", [math.nan, math.inf, -math.inf])
def test_a_pitch_rate_that_is_no_number_is_refused(rate):
    scene = Scene().setpoint(pitched(0.1)).setpoint(mask=IGNORE_ATTITUDE, rate=rate)
    assert (scene.pitch, scene.it.refused) == (pytest.approx(0.1), 1)


def test_numbers_that_the_mask_ignores_may_be_anything():
    nothing = (math.nan,) * 4
    assert Scene().setpoint(nothing, IGNORE_ATTITUDE, 0.02).it.target == Moving(0.02)
    assert Scene().setpoint(pitched(0.1), ALL_RATES, math.nan).pitch == pytest.approx(0.1)


# stamps


@pytest.mark.parametrize("first", [5_000, (1 << 32) - 10, 1])
def test_a_setpoint_that_was_overtaken_is_refused_and_counted_also_where_stamps_wrap(first):
    scene = Scene().setpoint(pitched(0.1), stamp=first).setpoint(pitched(0.2), stamp=(first + 50) % (1 << 32))
    for back in (1, 20, 49):
        stamp = (first + 50 - back) % (1 << 32)
        scene.setpoint(pitched(0.3), stamp=stamp)
    assert scene.pitch == pytest.approx(0.2)
    assert scene.it.refused == 3
    assert scene.setpoint(pitched(0.4), stamp=(first + 51) % (1 << 32)).pitch == pytest.approx(0.4)


def test_a_stamp_far_behind_is_a_sender_that_has_restarted():
    scene = Scene().setpoint(pitched(0.1), stamp=500_000).setpoint(pitched(0.2), stamp=30)
    assert (scene.pitch, scene.it.refused) == (pytest.approx(0.2), 0)


def test_a_sender_without_a_clock_is_never_late_and_equal_stamps_are_not_either():
    scene = Scene()
    for n, stamp in enumerate([0, 0, 700, 700, 0]):
        assert scene.setpoint(pitched(0.01 * n), stamp=stamp).pitch == pytest.approx(0.01 * n)
    assert scene.it.refused == 0


def test_each_sender_has_its_own_clock_and_the_first_has_the_stick_until_it_falls_silent():
    scene = Scene().setpoint(pitched(0.1), stamp=9_000)
    for _ in range(3):
        scene.setpoint(pitched(0.2), stamp=8_500, sender=(254, 190))
    assert (scene.pitch, scene.it.refused) == (pytest.approx(0.1), 3)
    assert sum("another station" in text for text in scene.texts) == 1
    scene.now_ns = scene.it.next_deadline_ns()
    scene.it.tick(scene.now_ns)
    scene.setpoint(pitched(0.2), stamp=8_500, sender=(254, 190))
    assert (scene.pitch, scene.it.refused) == (pytest.approx(0.2), 3)
    scene.setpoint(pitched(0.3), stamp=8_400, sender=(254, 190))
    assert (scene.pitch, scene.it.refused) == (pytest.approx(0.2), 4)


def test_however_many_senders_there_are_the_stamps_of_few_are_kept():
    scene = Scene()
    for n in range(2_000):
        scene.setpoint(stamp=1 + n, sender=(n % 255 + 1, n // 255 % 255))
        assert len(scene.it._stamps) <= MAX_SENDERS


# which mode takes what


@pytest.mark.parametrize("mode", [mode for mode in FlightMode if mode is not FlightMode.GUIDED])
def test_only_guided_takes_setpoints(mode):
    scene = Scene(mode)
    before = scene.it.target
    assert scene.setpoint(pitched(0.1)).it.target is before
    assert scene.it.next_deadline_ns() is None
    assert scene.it.refused == 0


@pytest.mark.parametrize("mode", [FlightMode.AUTO, FlightMode.GUIDED])
def test_only_manual_and_stabilize_take_a_stick(mode):
    scene = Scene(mode)
    before = scene.it.target
    scene.forward(-1000).pulse(2000)
    assert (scene.it.target, scene.it.stick, scene.it.next_deadline_ns()) == (before, 0.0, None)


@pytest.mark.parametrize(("x", "stick"), [(-1000, 1.0), (-250, 0.25), (0, 0.0), (1000, -1.0)])
def test_a_stick_that_is_pulled_back_is_nose_up(x, stick):
    assert Scene(FlightMode.MANUAL).forward(x).it.stick == stick
    scene = Scene(FlightMode.STABILIZE)
    scene.it.stick_rad = 0.4
    assert scene.forward(x).pitch == pytest.approx(0.4 * stick)
    assert scene.it.stick == 0.0  # the elevator is the law's


@pytest.mark.parametrize(
    ("pulse", "stick"), [(2000, 1.0), (1625, 0.25), (1500, 0.0), (1000, -1.0), (2200, 1.0), (800, -1.0)]
)
def test_a_long_pulse_is_nose_up(pulse, stick):
    assert Scene(FlightMode.MANUAL).pulse(pulse).it.stick == stick
    assert Scene(FlightMode.STABILIZE).pulse(pulse).pitch == pytest.approx(stick * math.radians(15.0))


def test_a_channel_that_is_given_back_is_a_stick_in_the_middle():
    assert Scene(FlightMode.MANUAL).pulse(1900).pulse(0).it.stick == 0.0


@pytest.mark.parametrize("pulse", [1, 500, 799, 2201, 40_000, 65_535])
def test_a_pulse_that_is_no_stick_leaves_the_stick_where_it_was_and_renews_no_time_out(pulse):
    scene = Scene(FlightMode.MANUAL).pulse(1900)
    scene.now_ns += 500 * MS
    scene.pulse(pulse)
    assert scene.it.stick == pytest.approx(0.8)
    assert scene.it.next_deadline_ns() == 100 * S + REFERENCE_NS
    assert scene.it.refused == (pulse != 65_535)  # 65535 is MAVLink's word for unused


@pytest.mark.parametrize("x", [-1001, 1001, -32768, 32766, 32767])
def test_a_stick_beyond_its_ends_is_refused(x):
    scene = Scene(FlightMode.MANUAL).forward(-500).forward(x)
    assert (scene.it.stick, scene.it.refused) == (0.5, x != 32767)  # 32767 is MAVLink's word for unused


# silence


@pytest.mark.parametrize("timeout_ns", [100 * MS, REFERENCE_NS, 60 * S])
def test_a_stream_that_falls_silent_returns_to_trim_at_its_very_instant_and_that_is_said_once(timeout_ns):
    scene = Scene()
    scene.it.timeout_ns = timeout_ns
    scene.setpoint(pitched(0.1))
    assert scene.it.next_deadline_ns() == scene.now_ns + timeout_ns
    scene.it.tick(scene.now_ns + timeout_ns - 1)
    assert (scene.pitch, scene.texts) == (pytest.approx(0.1), [])
    scene.it.tick(scene.now_ns + timeout_ns)
    scene.it.tick(scene.now_ns + 9 * timeout_ns)
    assert (scene.pitch, scene.texts) == (0.0, ["GUIDED: silence, holding trim"])
    assert scene.it.next_deadline_ns() is None
    assert scene.setpoint(pitched(0.2)).pitch == pytest.approx(0.2)


def test_a_rate_that_falls_silent_moves_no_further():
    scene = Scene().setpoint(mask=IGNORE_ATTITUDE, rate=0.1)
    scene.it.tick(scene.now_ns + REFERENCE_NS)
    assert scene.pitch == 0.0


@pytest.mark.parametrize("mode", [FlightMode.MANUAL, FlightMode.STABILIZE])
def test_a_stick_that_falls_silent_is_in_the_middle(mode):
    scene = Scene(mode).forward(-800)
    scene.it.tick(scene.now_ns + REFERENCE_NS)
    assert scene.it.stick == 0.0
    assert mode is FlightMode.MANUAL or scene.pitch == 0.0
    what = "elevator neutral" if mode is FlightMode.MANUAL else "holding trim"
    assert scene.texts == [f"{mode.name}: silence, {what}"]


def test_what_is_refused_does_not_keep_a_stream_alive():
    scene = Scene().setpoint(pitched(0.1), stamp=5_000)
    scene.now_ns += 900 * MS
    scene.setpoint((math.nan,) * 4, stamp=5_900).setpoint(pitched(0.2), stamp=4_950)
    assert scene.it.refused == 2
    scene.it.tick(100 * S + REFERENCE_NS)
    assert scene.pitch == 0.0


def test_a_stream_or_stick_that_has_not_begun_has_all_the_time_in_the_world():
    for mode in FlightMode:
        scene = Scene(mode)
        scene.it.tick(scene.now_ns + 3600 * S)
        assert (scene.texts, scene.it.next_deadline_ns()) == ([], None)


# modes and arming


def test_auto_begins_its_profile_anew_when_it_is_entered_or_armed_and_not_when_it_is_set_again():
    scene = Scene(FlightMode.AUTO)
    first = scene.it.target
    scene.it.set_mode(FlightMode.AUTO, scene.now_ns)
    assert isinstance(first, Programmed)
    assert scene.it.target is first
    scene.it.set_mode(FlightMode.GUIDED, scene.now_ns)
    assert scene.it.target == Steady()
    scene.it.set_mode(FlightMode.AUTO, scene.now_ns)
    second = scene.it.target
    scene.it.disarm(scene.now_ns)
    assert scene.it.target == Steady()
    assert scene.it.arm(scene.now_ns) == []
    third = scene.it.target
    assert all(isinstance(target, Programmed) for target in (first, second, third))
    assert len({id(target) for target in (first, second, third)}) == 3


def test_a_mode_waits_for_its_own_stream_and_forgets_that_of_the_one_before():
    scene = Scene().setpoint(pitched(0.1))
    scene.it.set_mode(FlightMode.STABILIZE, scene.now_ns)
    assert (scene.pitch, scene.it.next_deadline_ns()) == (0.0, None)
    scene.forward(-1000).it.set_mode(FlightMode.MANUAL, scene.now_ns)
    assert scene.it.stick == 0.0


@pytest.mark.parametrize("mode", FlightMode)
def test_the_law_is_to_fly_when_armed_but_for_manual_and_the_stick_has_the_elevator_there_alone(mode):
    scene = Scene(mode).forward(-500)
    assert scene.it.engaged is (mode is not FlightMode.MANUAL)
    assert (scene.it.stick != 0.0) is (mode is FlightMode.MANUAL)
    scene.it.disarm(scene.now_ns)
    assert (scene.it.engaged, scene.it.stick) == (False, 0.0)


@given(st.lists(st.sampled_from(["sample", "arm", "disarm", "AUTO", "MANUAL"]), max_size=12))
def test_a_vehicle_arms_itself_at_most_once_and_never_after_the_ground_has_spoken_of_arming(steps):
    texts: list[str] = []
    it = Commander(lambda _now: ["no"], lambda _severity, text, _now: texts.append(text), 0.0, self_arm=True)
    may = True
    for step in steps:
        before = it.armed
        match step:
            case "sample":
                it.usable_sample(0)
                assert it.armed == (before or may)
                may = False
            case "arm":
                it.arm(0)
                assert it.armed == before
            case "disarm":
                it.disarm(0)
                assert not it.armed
                may = False
            case mode:
                it.set_mode(FlightMode[mode], 0)
                assert it.armed == before
    it.certified = False
    assert sum(text.startswith("armed") for text in texts) <= 1


def test_what_is_asked_for_is_finite_whatever_frames_say():
    rng = np.random.default_rng(3)
    wild = np.array([math.nan, math.inf, -math.inf, 3e38, -3e38, 0.0, 1.0, -1.0, 1e-40])
    scene = Scene()
    for n in range(1_000):
        scene.now_ns += MS
        scene.it.set_mode(FlightMode(int(rng.choice([0, 2, 10, 15]))), scene.now_ns)
        for _ in range(4):
            q = tuple(rng.choice(wild, 4).tolist())
            scene.setpoint(q, int(rng.integers(256)), float(rng.choice(wild)), int(rng.integers(1 << 32)))
            scene.forward(int(rng.integers(-(1 << 15), 1 << 15))).pulse(int(rng.integers(1 << 16)))
        target = scene.it.target
        assert -1.0 <= scene.it.stick <= 1.0
        match target:
            case Steady(pitch):
                assert abs(pitch) <= math.pi / 2, n
            case Moving(rate):
                assert math.isfinite(rate), n
