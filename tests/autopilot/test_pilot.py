"""Who flies, and what leaves: each cause of failsafe on the bench, frame by frame, with its reason."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from autopilot.config import AutopilotConfig
from autopilot.failsafe import CALM_SAMPLES, REST_NS
from autopilot.link.wire import AoaSsa, Attitude, NamedValueInt, Wire
from autopilot.pilot import MAX_AHEAD
from autopilot.profile import parse_profile
from gains.model import Gains
from gains.store import load_gains
from tests.autopilot.bench import TREMBLE, Bench
from tests.helpers import HEARTBEAT, HIRM, MS, TS, S

D3, D6 = load_gains("hirm-d3"), load_gains("hirm-d6")
"""Delays 1 to 3, and 1 to 6: the conservative gains of the first."""
ALONE = replace(D3, conservative=None)
STEP = parse_profile("2deg@1s", 0.025)
X = np.array([0.002, 0.0, 0.005])
"""A state that leaves the elevator within its travel."""
TRAVEL = math.radians(25)
STATION = Wire((255, 190), None)
NEAR, FAR = 40 * MS, 110 * MS
"""Ages of samples whose commands have the delays 2 and 5."""


def bench(gains: Gains, **options) -> Bench:
    return Bench(AutopilotConfig(gains, **options))


def give(b: Bench, count: int, age_ns: int = 0, x: np.ndarray = X, reported: int | None = None) -> list[str]:
    """Let so many samples come in a row, each with the delay that the plant reports; return the mode after each."""
    modes = []
    k = b.commands[-1]["j"] + 1 if b.commands else 0
    k = max(k, -(-(b.now_ns - b.t0_ns - age_ns) // TS))
    for n in range(k, k + count):
        b.sample(n, age_ns, x)
        if reported is not None:
            b.give(NamedValueInt((b.t0_ns + n * TS) // MS, "DELAY_K", reported))
        modes.append(b.mode)
    return modes


def eq9(gains: Gains, command: dict) -> float:
    """Return u of Eq. (9), within the travel, by NumPy."""
    assert gains.K2 is not None
    u = float((gains.K1 @ np.array(command["x"]) + gains.K2 @ np.array(command["xr"]))[0])
    return float(np.clip(u, -TRAVEL, TRAVEL))


def last_change(b: Bench) -> tuple[str, str, str]:
    """Return event, mode before and mode after of the last change, which was told to the station as recorded."""
    b.node.tick(b.now_ns)
    b.take()
    event = [e for e in b.events if e["kind"] == "failsafe"][-1]
    text = next(t for t in reversed(b.texts()) if " to " in t and t.split()[0].isupper())
    assert text == event["text"][:50]
    assert len(text) <= 50
    return str(event["data"]["event"]), str(event["data"]["from"]), str(event["data"]["to"])


# a half, a spike, a sensor that stands still, an elevator at its limit


def halves(b: Bench, count: int, *, attitude: bool) -> None:
    """Let one half of the state come alone."""
    first = max(b.commands[-1]["j"] + 1, -(-(b.now_ns - b.t0_ns) // TS))
    for k in range(first, first + count):
        t_ns, x = b.t0_ns + k * TS, X + (k % 2) * TREMBLE
        b.to(t_ns)
        half = Attitude(t_ns // MS, 0.0, x[2], 0.0, 0.0, x[1], 0.0)
        b.give(half if attitude else AoaSsa(t_ns // 1000, math.degrees(x[0]), 0.0))


@pytest.mark.parametrize(("attitude", "missing"), [(True, "AOA_SSA missing"), (False, "ATTITUDE missing")])
def test_a_half_of_the_state_that_stops_is_hold_and_its_name_is_the_reason(attitude, missing):
    b = bench(D6)
    give(b, 10)
    halves(b, 8, attitude=attitude)
    assert last_change(b) == ("half", "TRACKING", "HOLD")
    assert b.transitions()[-1] == f"TRACKING to HOLD: {missing}"
    assert [e["text"] for e in b.events if e["kind"] == "half"] == []
    halves(b, 80, attitude=attitude)
    assert [e["text"] for e in b.events if e["kind"] == "half"] == [missing]  # once, as it lasts
    assert b.texts().count(missing) == 1


def test_a_half_that_is_missing_when_the_state_is_stale_is_the_reason_of_hold():
    b = bench(ALONE)
    give(b, 10)
    halves(b, 90, attitude=True)
    assert b.mode == "NEUTRAL"
    assert b.transitions()[1:] == ["TRACKING to HOLD: AOA_SSA missing", "HOLD to NEUTRAL: no recovery"]
    assert b.texts().count("AOA_SSA missing") == 1
    assert give(b, 3) == ["NEUTRAL", "NEUTRAL", "TRACKING"]


@pytest.mark.parametrize(
    ("spike", "reason"),
    [
        (np.array([0.0, 0.0, 1.0]), "theta_rad jumped 1, limit 0.3"),
        (np.array([0.0, 12.0, 0.0]), "q_rad_s 12 beyond 10"),
        (np.array([2.0, 0.0, 0.0]), "alpha_rad 2 beyond 1.57"),
    ],
)
def test_a_spike_costs_itself_and_three_good_samples(spike, reason):
    b = bench(HIRM)
    give(b, 10)
    held = b.commands[-1]["u"]
    assert give(b, 1, x=X + spike) == ["HOLD"]
    assert last_change(b) == ("implausible", "TRACKING", "HOLD")
    assert b.transitions()[-1] == f"TRACKING to HOLD: {reason}"
    assert give(b, 5) == ["HOLD", "HOLD", "TRACKING", "TRACKING", "TRACKING"]
    assert [c["u"] for c in b.commands[-6:-3]] == [held] * 3
    assert all(math.isfinite(c["u"][0]) for c in b.commands)


def test_a_frozen_sensor_is_hold_then_neutral_until_it_moves():
    b = bench(HIRM)
    give(b, 10)
    frozen = np.array([0.02, 0.0, 0.05])
    for _ in range(60):
        give(b, 1, x=frozen - (b.commands[-1]["j"] + 1) % 2 * TREMBLE)
    assert b.mode == "NEUTRAL"
    event, reason = [(e["data"]["event"], e["text"]) for e in b.events if e["kind"] == "failsafe"][1]
    assert event == "frozen"
    assert reason.startswith("TRACKING to HOLD: q_rad_s frozen at 0, ")
    assert any(t.startswith("TRACKING to HOLD: q_rad_s frozen at 0") for t in b.texts())
    assert give(b, 4, x=frozen)[-1] == "TRACKING"


@pytest.mark.parametrize("gains", [HIRM, D3, D6], ids=lambda gains: gains.name)
def test_an_elevator_at_its_limit_for_a_second_is_neutral_with_a_rest(gains):
    b = bench(gains)
    give(b, 10)
    for theta in (0.1, 0.2):
        give(b, 1, x=X + np.array([0.0, 0.0, theta]))
    pinned = X + np.array([0.0, 0.0, 0.3])
    give(b, 38, x=pinned)
    assert (b.mode, b.commands[-1]["saturated"], b.commands[-1]["u"][0]) == ("TRACKING", True, TRAVEL)
    give(b, 5, x=pinned)
    assert last_change(b) == ("saturated", "TRACKING", "NEUTRAL")
    assert b.transitions()[-1] == "TRACKING to NEUTRAL: elevator at its limit"
    since_ns = b.node.failsafe.since_ns
    assert b.commands[-1]["u"] == [0.0]
    give(b, 60)
    back_ns = b.node.failsafe.since_ns
    assert (b.mode, last_change(b)) == ("TRACKING", ("good", "NEUTRAL", "TRACKING"))
    assert REST_NS <= back_ns - since_ns <= REST_NS + TS


def test_an_elevator_may_stay_at_its_limit_for_ever_if_that_is_asked_for():
    b = bench(D3, saturation_ns=0)
    give(b, 10)
    give(b, 200, x=X + np.array([0.0, 0.0, 0.25]))
    assert (b.mode, b.commands[-1]["saturated"]) == ("TRACKING", True)


# the clock


@pytest.mark.parametrize(
    ("gains", "path"),
    [(D3, ["HOLD", "CONSERVATIVE"]), (ALONE, ["HOLD", "NEUTRAL"])],
    ids=["with conservative gains", "without"],
)
def test_a_clock_that_is_lost_leaves_the_law_although_reports_keep_the_delay_known(gains, path):
    b = bench(gains)
    give(b, 40, reported=1)
    b.answers = False
    lost_ns = b.now_ns
    give(b, 15 * 40 - 8, reported=1)
    assert b.mode == "TRACKING"
    give(b, 60, reported=1)
    changes = [e for e in b.events if e["kind"] == "failsafe"][1:]
    assert [str(e["data"]["to"]) for e in changes] == path
    assert changes[0]["data"]["event"] == "clock_lost"
    assert changes[0]["text"] == "TRACKING to HOLD: plant clock lost"
    assert "TRACKING to HOLD: plant clock lost" in b.texts()
    assert b.node.failsafe.since_ns - lost_ns > 15 * S
    assert b.commands[-1]["d"] == 1
    b.answers = True
    give(b, 60, reported=1)
    assert b.mode == "TRACKING"


def test_a_plant_that_never_answers_is_never_tracked_but_stays_in_standby_with_conservative_gains_too():
    b = Bench(AutopilotConfig(D3), answers=False)
    assert set(give(b, 200, reported=1)) == {"STANDBY"}
    assert {c["u"][0] for c in b.commands} == {0.0}


# the conservative gains


def test_a_delay_in_the_wider_window_alone_is_hold_and_after_three_samples_the_conservative_gains():
    b = bench(D3, profile=STEP)
    assert set(give(b, 50, NEAR)) == {"TRACKING"}
    assert give(b, 1, 75 * MS) == ["TRACKING"]
    assert give(b, 5, FAR) == ["HOLD", "HOLD", "HOLD", "CONSERVATIVE", "CONSERVATIVE"]
    assert b.transitions()[1:] == ["TRACKING to HOLD: delay 5", "HOLD to CONSERVATIVE: delay 5"]
    assert last_change(b) == ("wide", "HOLD", "CONSERVATIVE")


def test_the_conservative_gains_fly_equation_9_exactly_and_are_recorded_as_the_set_after_all_others():
    b = bench(D3, profile=STEP)
    give(b, 30, NEAR)
    give(b, 60, FAR)
    flown = [c for c in b.commands if c["mode"] == "CONSERVATIVE"]
    assert len(flown) >= 50
    assert {c["gain_set"] for c in flown} == {1}
    assert {c["d"] for c in flown} == {5}
    for c in flown:
        assert c["u"][0] == pytest.approx(eq9(D6, c), abs=1e-12)
    assert max(abs(eq9(D6, c) - eq9(D3, c)) for c in flown) > 1e-4
    assert {c["gain_set"] for c in b.commands if c["mode"] != "CONSERVATIVE"} == {0}


def test_the_fortieth_calm_sample_gives_the_law_back_and_one_that_is_not_begins_anew():
    b = bench(D3, profile=STEP)
    give(b, 30, NEAR)
    give(b, 10, FAR)
    assert CALM_SAMPLES == 40
    assert set(give(b, 39, NEAR)) == {"CONSERVATIVE"}
    assert give(b, 1, FAR) == ["CONSERVATIVE"]
    b.now_ns = max(b.now_ns, b.t0_ns)
    modes = give(b, 41, NEAR)
    assert modes[:39] == ["CONSERVATIVE"] * 39
    assert modes[39:] == ["TRACKING"] * 2
    assert last_change(b) == ("good", "CONSERVATIVE", "TRACKING")


def test_before_the_law_is_given_back_the_reported_delay_counts_as_much_as_the_forecast():
    b = bench(D3)
    give(b, 30, NEAR)
    give(b, 10, FAR)
    modes = []
    for _ in range(8):
        b.give(NamedValueInt(b.now_ns // MS, "DELAY_K", 4))
        modes += give(b, 10, NEAR)
    assert set(modes) == {"CONSERVATIVE"}
    assert set(give(b, 39, NEAR)) == {"CONSERVATIVE"}
    assert give(b, 41, NEAR)[-1] == "TRACKING"  # a second later the last report says nothing any more


@pytest.mark.parametrize(("age_ms", "mode"), [(150, "CONSERVATIVE"), (151, "HOLD")])
def test_the_wider_window_has_an_edge_too(age_ms, mode):
    b = bench(D3)
    give(b, 30, NEAR)
    give(b, 10, FAR)
    assert give(b, 1, age_ms * MS) == [mode]


def test_no_hold_is_a_short_cut_from_the_conservative_gains_to_the_law():
    b = bench(D3)
    give(b, 30, NEAR)
    give(b, 10, FAR)
    assert give(b, 1, 200 * MS) == ["HOLD"]
    assert "TRACKING" not in give(b, 39, NEAR)
    assert give(b, 5, NEAR)[-1] == "TRACKING"


def test_under_the_conservative_gains_a_state_may_be_as_old_as_they_allow():
    b = bench(D3)
    give(b, 30, NEAR)
    give(b, 10, FAR)
    last_ns = b.now_ns
    b.to(last_ns + D6.d_max * TS)
    assert b.mode == "CONSERVATIVE"
    b.to(last_ns + D6.d_max * TS + TS // 2)
    assert b.transitions()[-1] == "CONSERVATIVE to HOLD: no state for 6 samples"


@pytest.mark.parametrize("way", ["into", "out of"])
def test_neither_change_of_the_law_is_a_jump_of_the_elevator(way):
    b = bench(D3, profile=STEP, actuator="float")
    give(b, 50, NEAR)
    give(b, 10, FAR)
    if way == "out of":
        give(b, 50, NEAR)
    modes = [str(c["mode"]) for c in b.commands]
    was, then = ("HOLD", "CONSERVATIVE") if way == "into" else ("CONSERVATIVE", "TRACKING")
    at = next(n for n, pair in enumerate(pairwise(modes), 1) if pair == (was, then))
    before, after = b.commands[at - 1], b.commands[at]
    assert after["u"][0] == pytest.approx(before["u"][0], abs=1e-9)
    gains = D6 if way == "into" else D3
    assert after["u"][0] == pytest.approx(eq9(gains, after), abs=1e-12)
    unmatched = dict(after, xr=before["xr"])
    assert abs(eq9(gains, unmatched) - before["u"][0]) > 1e-5


@pytest.mark.parametrize("gains", [D3, HIRM], ids=lambda gains: gains.name)
def test_the_monitor_flies_the_main_law_whatever_failsafe_says(gains):
    b = bench(gains, profile=STEP, failsafe="monitor")
    give(b, 50, NEAR)
    give(b, 20, FAR)
    give(b, 10, 300 * MS)
    modes = {str(c["mode"]) for c in b.commands}
    assert modes >= ({"CONSERVATIVE", "HOLD"} if gains is D3 else {"HOLD"})
    for c in b.commands:
        assert (c["gain_set"], c["u"][0]) == (0, pytest.approx(eq9(gains, c), abs=1e-12))
    assert all(e["data"]["monitor"] for e in b.events if e["kind"] == "failsafe")


# the reference


def reference(count: int, r: float = math.radians(2), start: int = 40) -> np.ndarray:
    """Return xr(0), xr(1), ... of Eq. (8) by its recursion."""
    m, xr = HIRM.model.reference, [np.zeros(3)]
    for k in range(count):
        xr.append(m.Ar @ xr[-1] + m.Br[:, 0] * (r if k >= start else 0.0))
    return np.array(xr)


@pytest.mark.parametrize(("align", "ahead"), [(True, 2), (False, 0)])
def test_a_command_carries_the_reference_of_its_application_or_unaligned_that_of_its_sample(align, ahead):
    b = bench(D3, profile=STEP, align=align)
    give(b, 100, NEAR)
    xr = reference(110)
    for c in b.commands:
        np.testing.assert_allclose(c["xr"], xr[c["j"] + ahead], rtol=1e-9, atol=1e-12)
        assert c["u"][0] == pytest.approx(eq9(D3, c), abs=1e-12)


def test_the_reference_is_looked_ahead_200_samples_beyond_the_window_at_the_most():
    b = bench(D3, profile=STEP, failsafe="monitor")
    give(b, 60, NEAR)
    give(b, 1, 10 * S)
    command = b.commands[-1]
    assert command["d"] == 400
    np.testing.assert_allclose(command["xr"], reference(1000)[command["j"] + D3.d_max + MAX_AHEAD], rtol=1e-6)


# the ground station


def with_station(b: Bench, count: int, age_ns: int = NEAR) -> None:
    """Let samples come while the ground station sends its heartbeats."""
    for _ in range(count):
        b.node.receive("gcs0", STATION.encode(HEARTBEAT), b.now_ns)
        give(b, 1, age_ns)


def test_a_lost_ground_station_eases_the_reference_to_zero_and_it_comes_back_with_the_station():
    b = bench(D3, profile=STEP, ground_timeout_ns=2 * S)
    with_station(b, 100)
    give(b, 78, NEAR)
    assert b.mode == "TRACKING"
    give(b, 300, NEAR)
    assert last_change(b) == ("ground_lost", "TRACKING", "LEVEL")
    assert b.transitions()[-1] == "TRACKING to LEVEL: ground station lost"
    level = [c for c in b.commands if c["mode"] == "LEVEL"]
    m = HIRM.model.reference
    for now, then in pairwise(level):
        np.testing.assert_allclose(then["xr"], m.Ar @ np.array(now["xr"]), rtol=1e-9, atol=1e-12)
    assert abs((m.Cr @ np.array(level[0]["xr"]))[0]) > math.radians(1.9)
    assert abs((m.Cr @ np.array(level[-1]["xr"]))[0]) < math.radians(0.05)
    assert {c["gain_set"] for c in level} == {0}
    for c in level:
        assert c["u"][0] == pytest.approx(eq9(D3, c), abs=1e-12)
    with_station(b, 300)
    assert last_change(b) == ("ground_back", "LEVEL", "TRACKING")
    assert b.transitions()[-1] == "LEVEL to TRACKING: ground station is back"
    back = b.commands[-1]
    assert (m.Cr @ np.array(back["xr"]))[0] == pytest.approx(math.radians(2), rel=0.03)
    steps = np.abs(np.diff([c["xr"] for c in b.commands], axis=0)).max(axis=0)
    own = np.abs(np.diff(reference(400), axis=0)).max(axis=0)
    assert (steps <= 3.0 * own).all()  # the look ahead of two samples is given up at once, and no more


def test_the_loss_of_a_ground_station_is_told_at_its_very_instant():
    b = bench(D3, ground_timeout_ns=2 * S)
    with_station(b, 50)
    b.node.receive("gcs0", STATION.encode(HEARTBEAT), b.now_ns)
    heard_ns = b.now_ns
    give(b, 100, 33 * MS)
    assert (b.mode, b.node.failsafe.since_ns) == ("LEVEL", heard_ns + 2 * S)


def test_a_ground_station_may_be_silent_for_ever_unless_a_timeout_is_asked_for():
    b = bench(D3, profile=STEP)
    assert b.config.ground_timeout_ns == 0
    with_station(b, 20)
    give(b, 1000, NEAR)
    assert b.mode == "TRACKING"


def test_a_ground_station_that_never_spoke_cannot_be_lost():
    b = bench(D3, ground_timeout_ns=S)
    assert set(give(b, 300, NEAR)) == {"TRACKING"}


def test_without_a_ground_station_the_conservative_gains_ease_the_reference_as_well():
    b = bench(D3, profile=STEP, ground_timeout_ns=2 * S)
    with_station(b, 100)
    give(b, 20, FAR)
    assert b.mode == "CONSERVATIVE"
    give(b, 400, FAR)
    assert b.mode == "CONSERVATIVE"
    assert abs((HIRM.model.reference.Cr @ np.array(b.commands[-1]["xr"]))[0]) < math.radians(0.05)
    assert set(give(b, 50, NEAR)) == {"CONSERVATIVE", "LEVEL"}
    with_station(b, 10)
    assert b.mode == "TRACKING"
