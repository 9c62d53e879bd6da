"""Failsafe in whole flights: the conservative gains over a slow link, jitter at the edge, clocks, halves, restarts."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest

from autopilot.config import AutopilotConfig
from autopilot.failsafe import CALM_SAMPLES
from autopilot.link.clock import Clock
from autopilot.profile import parse_profile
from gains.model import Gains
from gains.store import load_gains
from sitl.plant import PlantConfig
from tests.helpers import HIRM, LINE_CLOCK, MS, PLANT_CLOCK, TS, Flight, Line, S, constant, parse

D3, D6 = load_gains("hirm-d3"), load_gains("hirm-d6")
"""Delays 1 to 3, and 1 to 6: the conservative gains of the first."""
STEP = parse_profile("2deg@1s", 0.025)
X0 = np.array([0.004, 0.0, 0.01])
TWENTY_MS = constant(20 * MS)


def slow_between(start_s: float, end_s: float, slow_ms: int) -> Callable[[int], int]:
    """Return a latency that is 20 ms, and another one for a while."""
    return lambda now_ns: slow_ms * MS if start_s * S <= now_ns < end_s * S else 20 * MS


def flown(gains: Gains, seconds: float, slow_ms: int = 90, **options) -> Flight:
    """Fly over a link of 40 ms there and back that is slower from 4 s to 8 s."""
    config = AutopilotConfig(gains, STEP, actuator="float", **options)
    plant = PlantConfig(HIRM.model, X0)
    return Flight(config, plant, TWENTY_MS, slow_between(4, 8, slow_ms)).fly(round(seconds * S))


def texts(flight: Flight) -> list[str]:
    return [m.text for _, m in flight.sent("autopilot", "gcs0") if m.get_type() == "STATUSTEXT"]


def reasons(flight: Flight, since_ns: int = 0) -> list[str]:
    return [e["text"] for e in flight.events("failsafe", since_ns)]


def eq9(gains: Gains, command: dict) -> float:
    """Return u of Eq. (9), within the travel, by NumPy."""
    assert gains.K2 is not None
    u = float((gains.K1 @ np.array(command["x"]) + gains.K2 @ np.array(command["xr"]))[0])
    return float(np.clip(u, -math.radians(25), math.radians(25)))


def laws(flight: Flight) -> list[tuple[int, str]]:
    """Return sample and name of each change of the law that flies."""
    by_law = [c for c in flight.bodies("autopilot/command") if c["mode"] in ("TRACKING", "LEVEL", "CONSERVATIVE")]
    return [(b["j"], str(b["mode"])) for a, b in pairwise(by_law) if a["mode"] != b["mode"]]


# the conservative gains


@pytest.fixture(scope="module")
def slower() -> Flight:
    """A flight over a link of 40 ms that has 110 ms for 4 s."""
    return flown(D3, 14)


def test_a_delay_that_outgrows_the_window_but_not_the_wider_one_is_flown_by_the_conservative_gains(slower):
    expected = ["STANDBY", "TRACKING", "HOLD", "CONSERVATIVE", "TRACKING"]
    assert slower.transitions() == list(pairwise(expected))
    assert reasons(slower)[1] in ("TRACKING to HOLD: delay 4 reported", "TRACKING to HOLD: delay 5")
    assert reasons(slower)[2:] == ["HOLD to CONSERVATIVE: delay 5", "CONSERVATIVE to TRACKING: delay 2"]
    assert [t for t in texts(slower) if " to " in t and "delay 1" not in t] == reasons(slower)
    _, hold, conservative, back = slower.when("failsafe")
    assert 4 * S < hold <= 4 * S + 7 * TS
    assert hold < conservative <= hold + 4 * TS
    assert 8 * S + 40 * TS <= back <= 8 * S + 55 * TS


def test_they_fly_equation_9_exactly_with_the_delay_of_the_slow_link(slower):
    commands = slower.bodies("autopilot/command")
    conservative = [c for c in commands if c["mode"] == "CONSERVATIVE"]
    assert len(conservative) > 150
    for c in conservative:
        assert (c["gain_set"], c["u"][0]) == (1, pytest.approx(eq9(D6, c), abs=1e-12))
    for c in commands:
        if c["mode"] == "TRACKING":
            assert (c["gain_set"], c["u"][0]) == (0, pytest.approx(eq9(D3, c), abs=1e-12))
    truth = {t["j"]: t["d"] for t in slower.bodies("plant/truth") if t["j"] is not None}
    assert {truth[c["j"]] for c in conservative[10:120]} == {5}
    assert {c["d"] for c in conservative[40:120]} == {5}
    assert np.mean([c["d"] == truth[c["j"]] for c in commands if c["j"] in truth]) > 0.97


def test_neither_change_is_a_jump_of_the_elevator_beyond_what_the_law_does_anyway(slower):
    commands = slower.bodies("autopilot/command")
    u = np.array([c["u"][0] for c in commands])
    own = np.abs(np.diff(u[40:70])).max()  # in the step of the reference
    for at in (n for n, (a, b) in enumerate(pairwise(commands), 1) if a["mode"] != b["mode"]):
        if commands[at]["mode"] in ("CONSERVATIVE", "TRACKING") and at > 10:
            assert u[at] == pytest.approx(u[at - 1], abs=1e-9)
        assert np.abs(np.diff(u[at - 1 : at + 20])).max() < own


def test_the_aircraft_hardly_notices(slower):
    theta = np.array([t["x"][2] for t in slower.bodies("plant/truth")])
    assert np.abs(theta[150:] - math.radians(2)).max() < math.radians(0.6)


def test_the_law_comes_back_with_the_fortieth_calm_sample(slower):
    commands = slower.bodies("autopilot/command")
    back = next(j for j, law in laws(slower) if law == "TRACKING")
    calm = [c for c in commands if back - CALM_SAMPLES < c["j"] <= back]
    assert [c["j"] for c in calm] == list(range(back - 39, back + 1))
    assert all(c["d"] <= D3.d_max for c in calm)
    reported = {t["k"]: t["d"] for t in slower.bodies("plant/truth")}
    # the last sample before the row: by the forecast or by the report that came with it it was not calm
    before = next(c for c in commands if c["j"] == back - 40)
    assert before["d"] > D3.d_max or max(reported[back - n] for n in (40, 41, 42)) > D3.d_max


def test_without_conservative_gains_the_same_link_is_neutral():
    flight = flown(replace(D3, conservative=None), 14)
    assert [b for _, b in flight.transitions()] == ["TRACKING", "HOLD", "NEUTRAL", "TRACKING"]
    assert {c["gain_set"] for c in flight.bodies("autopilot/command")} == {0}


def test_a_delay_beyond_both_windows_is_neutral_and_comes_back():
    flight = flown(D3, 14, slow_ms=180)
    names = [b for _, b in flight.transitions()]
    assert names[:2] == ["TRACKING", "HOLD"]
    assert "NEUTRAL" in names
    assert names[-1] == "TRACKING"
    slow = [c for c in flight.bodies("autopilot/command") if 5 * S < c["j"] * TS < 7 * S]
    assert {str(c["mode"]) for c in slow} == {"NEUTRAL"}


@pytest.mark.parametrize("slow_ms", [90, 180])
def test_the_monitor_flies_the_main_law_whatever_the_link_does(slow_ms):
    flight = flown(D3, 10, slow_ms, failsafe="monitor")
    commands = flight.bodies("autopilot/command")
    modes = {str(c["mode"]) for c in commands}
    assert modes & {"CONSERVATIVE", "NEUTRAL"}
    for c in commands:
        assert (c["gain_set"], c["u"][0]) == (0, pytest.approx(eq9(D3, c), abs=1e-12))


@pytest.mark.parametrize(("scale_ms", "seed"), [(6.0, 0), (6.0, 1), (7.0, 0), (15.0, 0)])
def test_a_delay_that_jitters_about_the_edge_of_the_window_gives_the_law_back_at_most_once_a_second(scale_ms, seed):
    rng = np.random.default_rng(seed)

    def edge(_now_ns: int) -> int:
        return 20 * MS + int(rng.gamma(2.0, scale_ms) * MS)

    flight = Flight(AutopilotConfig(D3, STEP), PlantConfig(HIRM.model, X0), TWENTY_MS, edge).fly(30 * S)
    truth = np.array([t["d"] for t in flight.bodies("plant/truth") if t["d"] is not None])
    assert 0.005 < np.mean(truth > D3.d_max) < 0.4
    changes = laws(flight)
    assert len(changes) > (4 if scale_ms < 10.0 else 0)
    assert len(changes) < 30  # less than one a second
    for law in ("TRACKING", "CONSERVATIVE"):
        at = [j for j, name in changes if name == law]
        assert all(later - earlier >= CALM_SAMPLES for earlier, later in pairwise(at))


# the other causes, over a link


@dataclass
class Lossy(Line):
    """A line of 20 ms each way that loses one kind of the plant's messages for a while."""

    up: Callable[[int], int | None] = TWENTY_MS
    down: Callable[[int], int | None] = TWENTY_MS
    kind: str = ""
    from_s: float = 0.0
    to_s: float = 0.0

    def receive(self, port: str, datagram: bytes, now_ns: int) -> None:
        gone = self.from_s * S <= now_ns - LINE_CLOCK.offset_ns < self.to_s * S
        if port == "plant" and gone and parse(datagram)[0].get_type() == self.kind:
            return
        super().receive(port, datagram, now_ns)


def missing(gains: Gains, kind: str, from_s: float, to_s: float, seconds: float) -> Flight:
    """Fly while one kind of the plant's messages is lost for a while."""
    flight = Flight(AutopilotConfig(gains, STEP), PlantConfig(HIRM.model, X0))
    flight.network.replace("line", Lossy(kind=kind, from_s=from_s, to_s=to_s), LINE_CLOCK)
    return flight.fly(round(seconds * S))


@pytest.mark.parametrize(("kind", "name"), [("AOA_SSA", "AOA_SSA missing"), ("ATTITUDE", "ATTITUDE missing")])
def test_a_half_that_is_lost_on_the_link_is_hold_then_neutral_then_the_law_again(kind, name):
    flight = missing(D6, kind, 4, 6, 10)
    assert reasons(flight, 3 * S) == [
        f"TRACKING to HOLD: {name}", "HOLD to NEUTRAL: no recovery", "NEUTRAL to TRACKING: delay 2",
    ]  # fmt: skip
    assert [str(e["data"]["event"]) for e in flight.events("failsafe", 3 * S)] == ["half", "expired", "good"]
    assert name in texts(flight)
    hold, _, back = flight.when("failsafe")[1:]
    assert 4 * S < hold < 4 * S + 8 * TS
    assert 6 * S < back < 6 * S + 6 * TS


@pytest.mark.parametrize(
    ("gains", "modes"),
    [(D3, ["HOLD", "CONSERVATIVE", "TRACKING"]), (replace(D3, conservative=None), ["HOLD", "NEUTRAL", "TRACKING"])],
    ids=["with conservative gains", "without"],
)
def test_a_plant_that_stops_answering_timesync_loses_the_law_after_15_s_and_gets_it_back(gains, modes):
    flight = missing(gains, "TIMESYNC", 4, 24, 30)
    assert [b for _, b in flight.transitions(3 * S)] == modes
    assert reasons(flight, 3 * S)[0] == "TRACKING to HOLD: plant clock lost"
    lost, _, back = flight.when("failsafe")[1:]
    assert 19 * S - 0.2 * S < lost < 19.2 * S
    assert 24 * S < back < 26 * S
    away = [c for c in flight.bodies("autopilot/command") if 20 * S < c["j"] * TS < 23 * S]
    assert {(str(c["mode"]), c["d"]) for c in away} == {(modes[1], 2)}


def test_a_short_silence_of_timesync_is_not_noticed():
    flight = missing(D3, "TIMESYNC", 4, 18, 20)
    assert flight.transitions() == [("STANDBY", "TRACKING")]


def test_without_any_report_a_clock_that_is_lost_has_lost_its_delay_before():
    flight = Flight(AutopilotConfig(replace(D3, conservative=None), STEP), PlantConfig(HIRM.model, X0))
    line = Lossy(kind="TIMESYNC", from_s=4, to_s=60)
    receive = line.receive

    def without_reports(port: str, datagram: bytes, now_ns: int) -> None:
        message = parse(datagram)[0]
        if message.get_type() != "NAMED_VALUE_INT" or message.name != "DELAY_K":
            receive(port, datagram, now_ns)

    line.receive = without_reports
    flight.network.replace("line", line, LINE_CLOCK)
    flight.fly(12 * S)
    assert reasons(flight, 3 * S) == ["TRACKING to HOLD: delay unknown", "HOLD to NEUTRAL: no recovery"]
    assert 8.8 * S < flight.when("failsafe", "delay unknown")[0] < 9.2 * S


@pytest.mark.parametrize(("at_s", "mode"), [(3, "TRACKING"), (6, "CONSERVATIVE")])
def test_a_plant_that_restarts_is_standby_whoever_flew_and_is_flown_again(at_s, mode):
    flight = flown(D3, at_s)
    assert str(flight.autopilot.failsafe.mode) == mode
    flight.restart_plant(Clock(PLANT_CLOCK.offset_ns, 40_000, flight.network.now_ns))
    flight.fly(14 * S)
    [restarted] = flight.when("failsafe", "plant restarted")
    changes = flight.transitions(at_s * S)
    assert [b for _, b in changes].count("STANDBY") == 1
    assert restarted < (at_s + 2) * S
    assert changes[-1][1] == "TRACKING"
    assert any(t.endswith(" to STANDBY: plant restarted") for t in texts(flight))
    assert [t for t in texts(flight) if " to " in t and t.split()[0].isupper()] == [r[:50] for r in reasons(flight)]
