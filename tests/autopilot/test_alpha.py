"""Angle of attack with and without AOA_SSA: which source, when it changes, and what VFR_HUD's is worth."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autopilot.alpha import (
    ALPHA_WAIT_NS,
    HUD_LIMIT_NS,
    MIN_AIRSPEED_M_S,
    MIN_ANGLES,
    AlphaSource,
    alpha_sigma_rad,
    gamma_rad,
)
from autopilot.link.wire import (
    AUTOPILOT,
    PLANT,
    AoaSsa,
    Attitude,
    HilActuatorControls,
    Message,
    NamedValueInt,
    VfrHud,
    Wire,
)
from autopilot.state import Drop, Sample, SampleAssembler
from gains.store import load_model
from gains.table import InputError
from sitl.plant import PlantConfig, PlantNode
from tests.helpers import HEARTBEAT, HIRM, MS, TS, S

MODEL = HIRM.model
SPEED = 100.0
T0 = 137 * S
WAIT = ALPHA_WAIT_NS // TS
SIDESLIP = replace(MODEL, sensors={**MODEL.sensors, "q_rad_s": "AOA_SSA.SSA"})
"""A model that wants sideslip too."""


def hud(climb: float, airspeed: float = SPEED) -> VfrHud:
    return VfrHud(airspeed, airspeed, 0, 0, 1600.0, climb)


@dataclass
class Bench:
    """The assembler behind a wire: frames in, samples out, both clocks equal."""

    alpha: str = "auto"
    model: object = MODEL
    samples: list[Sample] = field(default_factory=list)
    now_ns: int = T0

    def __post_init__(self) -> None:
        self.assembler = SampleAssembler(self.model, self.alpha)
        self.plant, self.autopilot = Wire(PLANT, None), Wire(AUTOPILOT, PLANT)
        self.assembler.number(0, T0 // MS)

    def give(self, *messages: Message) -> None:
        for message in messages:
            self.frame(self.plant.encode(message))

    def frame(self, frame: bytes) -> None:
        for message in self.autopilot.decode(frame):
            if isinstance(message, VfrHud):
                self.assembler.air(message, self.now_ns)
            elif type(message) in self.assembler.needed:
                sample = self.assembler.add(message, self.now_ns, self.now_ns)
                self.samples += [sample] if sample is not None else []

    def fly(self, first: int, last: int, *, aoa: bool = False, air: bool = True) -> None:
        """Let samples ``first`` to ``last`` come, with theta = 0.1, alpha = 0.03 and climb to match, as asked."""
        for k in range(first, last + 1):
            self.now_ns = T0 + k * TS
            self.give(Attitude(self.now_ns // MS, 0.5, 0.1, 0.0, 0.0, 0.2, 0.0))
            self.give(*[AoaSsa(self.now_ns // 1000, math.degrees(0.03), 0.0)] * aoa)
            self.give(*[hud(SPEED * math.sin(0.07))] * air)

    @property
    def sources(self) -> dict[int, str]:
        return {sample.j: str(sample.alpha) for sample in self.samples}


# which source


@pytest.mark.parametrize("alpha", ["auto", "aoa_ssa"])
def test_aoa_ssa_is_taken_whenever_it_comes(alpha: str) -> None:
    b = Bench(alpha)
    assert b.assembler.alpha is AlphaSource.AOA_SSA
    b.fly(0, 200, aoa=True)
    assert b.sources == dict.fromkeys(range(201), "aoa_ssa")
    assert b.assembler.alpha_since_ns is None
    assert b.samples[-1].x == pytest.approx((0.03, 0.2, 0.1), rel=1e-6)  # AOA_SSA is in degrees


def test_vfr_hud_is_taken_from_the_start_where_it_is_asked_for() -> None:
    b = Bench("vfr_hud")
    b.fly(0, 50, aoa=True)
    assert b.sources == dict.fromkeys(range(1, 51), "vfr_hud")  # sample 0 came before any VFR_HUD
    assert b.assembler.drops == {Drop.NO_AIR: 1}
    assert b.samples[-1].x == pytest.approx((0.03, 0.2, 0.1), rel=1e-6)  # climb is in m/s
    assert [type(part) for part in b.samples[-1].parts] == [Attitude]
    assert b.assembler.alpha_since_ns is None


def test_auto_goes_over_to_vfr_hud_when_it_has_waited_for_aoa_ssa() -> None:
    b = Bench()
    b.fly(0, WAIT - 1)
    assert (b.samples, b.assembler.alpha) == ([], AlphaSource.AOA_SSA)
    b.fly(WAIT, WAIT + 20)
    assert b.sources == dict.fromkeys(range(WAIT, WAIT + 21), "vfr_hud")
    assert (b.assembler.alpha, b.assembler.alpha_since_ns) == (AlphaSource.VFR_HUD, T0 + WAIT * TS)
    assert b.samples[-1].x == pytest.approx((0.03, 0.2, 0.1), rel=1e-6)


def test_auto_waits_on_while_no_vfr_hud_comes() -> None:
    b = Bench()
    b.fly(0, 3 * WAIT, air=False)
    assert (b.samples, b.assembler.alpha) == ([], AlphaSource.AOA_SSA)
    b.fly(3 * WAIT + 1, 3 * WAIT + 2)
    assert b.sources == {3 * WAIT + 2: "vfr_hud"}


def test_silence_of_the_link_is_not_silence_of_aoa_ssa() -> None:
    b = Bench()
    b.fly(0, 0)
    b.fly(2 * WAIT, 2 * WAIT + 50, aoa=True)
    assert b.sources == dict.fromkeys(range(2 * WAIT, 2 * WAIT + 51), "aoa_ssa")


def test_auto_goes_back_with_the_fifth_aoa_ssa_and_stays() -> None:
    b = Bench()
    b.fly(0, 100)
    b.fly(101, 120, aoa=True)
    b.fly(121, 121 + 3 * WAIT)
    # ATTITUDE of sample 105 had made its sample when AOA_SSA came
    assert [j for j, source in b.sources.items() if source == "vfr_hud"] == list(range(WAIT, 106))
    assert [j for j, source in b.sources.items() if source == "aoa_ssa"] == list(range(106, 121))
    assert (b.assembler.alpha, b.assembler.alpha_since_ns) == (AlphaSource.AOA_SSA, T0 + 105 * TS)


@pytest.mark.parametrize("came", [MIN_ANGLES, 40, 200])
def test_an_aoa_ssa_that_came_and_stops_has_no_stand_in(came: int) -> None:
    b = Bench()
    b.fly(0, came - 1, aoa=True)
    b.fly(came, came + 10 * WAIT)
    assert b.sources == dict.fromkeys(range(came), "aoa_ssa")


@pytest.mark.parametrize("came", [1, 40, 200])
def test_nor_has_one_that_was_asked_for_and_stops(came: int) -> None:
    b = Bench("aoa_ssa")
    b.fly(0, came - 1, aoa=True)
    b.fly(came, came + 10 * WAIT)
    assert b.sources == dict.fromkeys(range(came), "aoa_ssa")


@pytest.mark.parametrize("came", range(1, MIN_ANGLES))
def test_fewer_than_five_aoa_ssa_before_the_wait_is_over_only_begin_it_anew(came: int) -> None:
    b = Bench()
    b.fly(0, 19)
    b.fly(20, 19 + came, aoa=True)
    b.fly(20 + came, 300)
    assert [j for j, source in b.sources.items() if source == "aoa_ssa"] == list(range(20, 20 + came))
    assert [j for j, source in b.sources.items() if source == "vfr_hud"] == list(range(20 + came + WAIT, 301))


@pytest.mark.parametrize("came", range(1, MIN_ANGLES))
@pytest.mark.parametrize("first", [True, False])
def test_fewer_than_five_aoa_ssa_change_nothing_where_it_flies_on_vfr_hud(first: bool, came: int) -> None:
    b = Bench()
    b.fly(0, 100)
    for k in range(101, 101 + came):
        b.now_ns = T0 + k * TS
        angle = AoaSsa(b.now_ns // 1000, 20.0, 0.0)
        b.give(*[angle] * first, Attitude(b.now_ns // MS, 0.5, 0.1, 0.0, 0.0, 0.2, 0.0), *[angle] * (not first))
        b.give(hud(SPEED * math.sin(0.07)))
    b.fly(101 + came, 300)
    assert b.sources == dict.fromkeys(range(WAIT, 301), "vfr_hud")
    np.testing.assert_allclose([sample.x for sample in b.samples], [(0.03, 0.2, 0.1)] * len(b.samples), rtol=1e-6)
    assert b.assembler.alpha_since_ns == T0 + WAIT * TS


def test_stray_aoa_ssa_do_not_add_up_to_five() -> None:
    b = Bench()
    b.fly(0, 100)
    for n in range(2 * MIN_ANGLES):
        first = 101 + n * (WAIT + 1)
        b.fly(first, first, aoa=True)
        b.fly(first + 1, first + WAIT)
    assert set(b.sources.values()) == {"vfr_hud"}


def test_nor_has_one_that_was_asked_for_and_never_came() -> None:
    b = Bench("aoa_ssa")
    b.fly(0, 10 * WAIT)
    assert (b.samples, b.assembler.alpha) == ([], AlphaSource.AOA_SSA)


def test_an_aoa_ssa_from_the_future_decides_nothing() -> None:
    b = Bench()
    b.fly(0, 100)
    b.give(AoaSsa((b.now_ns + 10 * S) // 1000, 1.0, 0.0))
    assert b.assembler.drops[Drop.FROM_THE_FUTURE] == 1
    assert b.assembler.alpha is AlphaSource.VFR_HUD


@pytest.mark.parametrize("aoa", [False, True])
@pytest.mark.parametrize("last", [20, 200])
def test_a_restarted_plant_is_waited_for_again_whatever_the_one_before_had(last: int, aoa: bool) -> None:
    b = Bench()
    b.fly(0, last, aoa=aoa)
    b.assembler.restart()
    assert (b.assembler.alpha, b.assembler.alpha_since_ns) == (AlphaSource.AOA_SSA, None)
    b.samples.clear()
    b.assembler.number(0, T0 // MS)
    b.fly(300, 299 + WAIT)
    assert b.samples == []
    b.fly(300 + WAIT, 310 + WAIT)
    assert b.sources == dict.fromkeys(range(300 + WAIT, 311 + WAIT), "vfr_hud")


def test_a_restarted_plant_that_now_sends_aoa_ssa_is_flown_on_it_at_once() -> None:
    b = Bench()
    b.fly(0, 200)
    b.assembler.restart()
    b.samples.clear()
    b.assembler.number(0, T0 // MS)
    b.fly(300, 500, aoa=True)
    assert b.sources == dict.fromkeys(range(300, 501), "aoa_ssa")


@pytest.mark.parametrize(("alpha", "source"), [("aoa_ssa", AlphaSource.AOA_SSA), ("vfr_hud", AlphaSource.VFR_HUD)])
def test_a_restart_changes_no_choice(alpha: str, source: AlphaSource) -> None:
    b = Bench(alpha)
    b.fly(0, 10)
    b.assembler.restart()
    b.fly(20, 20 + 5 * WAIT)
    assert b.assembler.alpha is source


def test_a_model_without_angle_of_attack_has_no_source() -> None:
    for alpha in ("auto", "aoa_ssa", "vfr_hud"):
        assembler = SampleAssembler(load_model("pendulum"), alpha)
        assembler.number(0, 0)
        for k in range(200):
            sample = assembler.add(Attitude(30 * k, 0.0, 0.1, 0.0, 0.0, 0.2, 0.0), 30 * k * MS)
            assembler.air(hud(1.0), 30 * k * MS)
            assert (sample.j, sample.alpha) == (k, AlphaSource.NONE)


def test_vfr_hud_does_not_stand_in_for_sideslip() -> None:
    with pytest.raises(InputError, match=r"hirm: alpha vfr_hud: expected states in AOA_SSA\.AOA and ATTITUDE"):
        SampleAssembler(SIDESLIP, "vfr_hud")
    b = Bench("auto", SIDESLIP)
    b.fly(0, 5 * WAIT)
    assert (b.samples, b.assembler.alpha) == ([], AlphaSource.AOA_SSA)


def test_people_are_told_the_source_and_its_noise() -> None:
    b = Bench()
    assert b.assembler.alpha_report() == "alpha from AOA_SSA"
    b.fly(0, 100)
    assert b.assembler.alpha_report() == "alpha from VFR_HUD: 0.57 deg per m/s of climb"
    b.give(hud(0.0, MIN_AIRSPEED_M_S))
    assert b.assembler.alpha_report() == "alpha from VFR_HUD: 11.46 deg per m/s of climb"
    assert len(b.assembler.alpha_report()) <= 50
    assert Bench("vfr_hud").assembler.alpha_report() == "alpha from VFR_HUD"
    assert SampleAssembler(load_model("pendulum")).alpha_report() == "no alpha"


# order, copies, age


def test_reordered_and_doubled_frames_make_each_sample_once_and_in_order() -> None:
    rng = np.random.default_rng(11)
    stream = []
    for k in range(400):
        t_ns = T0 + k * TS
        attitude = Attitude(t_ns // MS, 0.0, 0.1 + 1e-3 * k, 0.0, 0.0, float(k), 0.0)
        for message in (attitude, hud(1.0)):
            stream += [(t_ns + int(rng.integers(0, 60)) * MS, n, message) for n in range(rng.integers(1, 3))]
    b = Bench("vfr_hud")
    for b.now_ns, _, message in sorted(stream, key=lambda item: item[:2]):
        b.give(message)
    numbers = [sample.j for sample in b.samples]
    assert numbers == sorted(set(numbers))
    assert len(numbers) > 200
    for sample in b.samples:
        alpha = 0.1 + 1e-3 * sample.j - math.asin(1.0 / SPEED)
        assert sample.x == pytest.approx((alpha, sample.j, 0.1 + 1e-3 * sample.j), rel=1e-5)
    drops = b.assembler.drops
    assert set(drops) <= {Drop.LATE, Drop.DUPLICATE, Drop.NO_AIR}
    copies = sum(isinstance(message, Attitude) for _, _, message in stream)
    assert len(numbers) + sum(drops.values()) == copies


def test_a_copy_of_a_sample_is_a_duplicate_from_either_source() -> None:
    b = Bench()
    b.fly(0, 100)
    b.give(Attitude(b.now_ns // MS, 0.0, 0.3, 0.0, 0.0, 0.0, 0.0))
    assert b.assembler.drops[Drop.DUPLICATE] == 1
    b.give(AoaSsa(b.now_ns // 1000, 1.0, 0.0))
    assert b.assembler.drops[Drop.DUPLICATE] == 2
    assert b.samples[-1].j == 100


@pytest.mark.parametrize(("age_ns", "made"), [(0, True), (HUD_LIMIT_NS, True), (HUD_LIMIT_NS + 1, False)])
def test_an_old_vfr_hud_makes_no_sample(age_ns: int, made: bool) -> None:
    b = Bench("vfr_hud")
    b.give(hud(1.0))
    b.now_ns += age_ns
    b.give(Attitude(b.now_ns // MS, *(6 * [0.0])))
    assert bool(b.samples) is made
    assert b.assembler.drops == ({} if made else {Drop.NO_AIR: 1})


@pytest.mark.parametrize(
    ("airspeed", "climb", "made"),
    [
        (5.0, 0.1, True),
        (4.99, 0.1, False),
        (0.0, 0.0, False),
        (-50.0, 1.0, False),
        (20.0, 20.0, True),
        (20.0, -21.0, False),
    ],
)
def test_without_airspeed_or_with_more_climb_than_that_there_is_no_sample(
    airspeed: float, climb: float, made: bool
) -> None:
    b = Bench("vfr_hud")
    b.give(hud(climb, airspeed), Attitude(b.now_ns // MS, *(6 * [0.0])))
    assert bool(b.samples) is made


@given(
    airspeed=st.floats(width=32, allow_nan=False, allow_infinity=False),
    climb=st.floats(width=32, allow_nan=False, allow_infinity=False),
)
def test_whatever_vfr_hud_says_gamma_is_an_angle_or_none(airspeed: float, climb: float) -> None:
    gamma = gamma_rad(hud(climb, airspeed))
    assert gamma is None or abs(gamma) <= math.pi / 2
    sigma = alpha_sigma_rad(hud(climb, airspeed), 0.1, 0.5)
    assert sigma is None or 0.0 < sigma < math.inf


# what it is worth


def flown(aoa: bool) -> tuple[Bench, np.ndarray]:
    """Fly the linear aircraft with a wild elevator into an assembler; return it and the true states."""
    plant, wire = PlantNode(PlantConfig(MODEL, np.array([0.05, 0.0, 0.1]), aoa=aoa)), Wire(AUTOPILOT, None)
    plant.receive("autopilot", wire.encode(HEARTBEAT), T0)
    rng, b, truth = np.random.default_rng(3), Bench("auto"), []
    for k in range(400):
        b.now_ns = T0 + k * TS
        plant.tick(b.now_ns)
        for _, frame in plant.outgoing():
            b.frame(frame)
        truth += [record.body["x"] for record in plant.records() if record.topic == "plant/truth"]
        elevator = HilActuatorControls(b.now_ns // 1000, float(rng.uniform(-0.5, 0.5)))
        plant.receive("autopilot", wire.encode(elevator), b.now_ns + 1)
    return b, np.array(truth)


def test_alpha_of_vfr_hud_is_the_true_one_but_for_the_age_of_the_message() -> None:
    """VFR_HUD follows ATTITUDE: gamma is one sample old, and alpha off by what it has moved in that."""
    b, truth = flown(aoa=False)
    assert b.sources == dict.fromkeys(range(WAIT, 400), "vfr_hud")
    gamma = truth[:, 2] - truth[:, 0]
    k = np.arange(WAIT, 400)
    x = np.array([sample.x for sample in b.samples])
    np.testing.assert_allclose(x[:, 1:], truth[k, 1:], rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(x[:, 0], truth[k, 2] - gamma[k - 1], atol=1e-7)
    assert np.max(np.abs(x[:, 0] - truth[k, 0])) <= np.max(np.abs(np.diff(gamma))) + 1e-7
    assert np.ptp(truth[k, 0]) > math.radians(2)


def test_alpha_of_aoa_ssa_is_the_true_one() -> None:
    b, truth = flown(aoa=True)
    assert b.sources == dict.fromkeys(range(400), "aoa_ssa")
    np.testing.assert_allclose([sample.x for sample in b.samples], truth, rtol=1e-6, atol=1e-8)


def climb_of(theta: float, alpha: float, phi: float = 0.0) -> float:
    """Return climb / airspeed of a rigid aircraft without sideslip, from its attitude and angle of attack."""
    return math.sin(theta) * math.cos(alpha) - math.cos(theta) * math.cos(phi) * math.sin(alpha)


def test_the_errors_of_bank_wind_and_airspeed_are_as_written() -> None:
    theta, alpha = 0.08, 0.06
    banked = theta - gamma_rad(hud(SPEED * climb_of(theta, alpha, math.radians(30))))
    assert 1 - banked / alpha == pytest.approx(0.13, abs=0.01)
    assert theta - gamma_rad(hud(SPEED * climb_of(theta, alpha))) == pytest.approx(alpha, rel=1e-12)
    rising = theta - gamma_rad(hud(SPEED * climb_of(theta, alpha) + 1.0))
    assert math.degrees(alpha - rising) == pytest.approx(0.6, abs=0.05)
    density = (1 - 0.0065 * 1600 / 288.15) ** 4.2559  # of the standard atmosphere, to that at sea level
    shown = SPEED * math.sqrt(density)
    calibrated = theta - gamma_rad(hud(SPEED * climb_of(theta, alpha), shown))
    assert 1 - shown / SPEED == pytest.approx(0.08, abs=0.005)
    assert calibrated - alpha == pytest.approx((theta - alpha) * (1 - SPEED / shown), rel=0.01)


@pytest.mark.parametrize("gamma", [-0.3, 0.0, 0.1, 0.8])
def test_the_noise_of_alpha_is_the_spread_of_noisy_messages(gamma: float) -> None:
    rng = np.random.default_rng(1)
    sigma_climb, sigma_airspeed = 0.2, 0.5
    climb = SPEED * math.sin(gamma) + sigma_climb * rng.standard_normal(20_000)
    airspeed = SPEED + sigma_airspeed * rng.standard_normal(20_000)
    expected = alpha_sigma_rad(hud(SPEED * math.sin(gamma)), sigma_climb, sigma_airspeed)
    assert np.std(np.arcsin(climb / airspeed)) == pytest.approx(expected, rel=0.02)


def test_straight_up_there_is_no_figure_for_the_noise() -> None:
    assert alpha_sigma_rad(hud(SPEED), 0.1) is None
    assert alpha_sigma_rad(hud(0.0, 0.0), 0.1) is None


def test_the_plants_number_is_waited_for_from_either_source() -> None:
    assembler = SampleAssembler(MODEL, "vfr_hud")
    assembler.air(hud(1.0), T0)
    assert assembler.add(Attitude(T0 // MS, 0.0, 0.1, 0.0, 0.0, 0.0, 0.0), T0) is None
    wire = Wire(AUTOPILOT, PLANT)
    [number] = wire.decode(Wire(PLANT, None).encode(NamedValueInt(T0 // MS, "SAMPLE_K", 7)))
    sample = assembler.number(number.value, number.time_boot_ms)
    assert (sample.j, sample.alpha) == (7, AlphaSource.VFR_HUD)
    assert sample.x[0] == pytest.approx(0.1 - math.asin(1.0 / SPEED))
