"""The autopilot with and without AOA_SSA: what it flies, and what it tells of its angle of attack."""

from __future__ import annotations

import math

import numpy as np
import pytest

from autopilot.config import AutopilotConfig
from autopilot.link.wire import AoaSsa, Attitude, NamedValueInt, VfrHud
from sitl.plant import PlantConfig
from tests.autopilot.bench import TREMBLE, X0, Bench
from tests.autopilot.test_app import STEP
from tests.helpers import HIRM, MS, TS, Flight, S, constant


def give(b: Bench, first: int, last: int, *, aoa: bool) -> None:
    """Let samples ``first`` to ``last`` come with VFR_HUD, and with AOA_SSA or not."""
    for k in range(first, last + 1):
        t_ns, x = b.t0_ns + k * TS, X0 + (k % 2) * TREMBLE
        b.to(t_ns)
        b.give(
            NamedValueInt(t_ns // MS, "SAMPLE_K", k),
            Attitude(t_ns // MS, 0.0, x[2], 0.0, 0.0, x[1], 0.0),
            *[AoaSsa(t_ns // 1000, math.degrees(x[0]), 0.0)] * aoa,
            VfrHud(100.0, 100.0, 0, 0, 0.0, 100.0 * math.sin(x[2] - x[0])),
        )


def told(b: Bench) -> list[str]:
    assert [t for t in b.texts() if "alpha" in t] == [e["text"] for e in b.events if e["kind"] == "alpha"]
    return [e["data"]["alpha"] for e in b.events if e["kind"] == "alpha"]


@pytest.mark.parametrize(
    ("alpha", "aoa", "source", "first_j"),
    [
        ("auto", True, "aoa_ssa", 0),
        ("auto", False, "vfr_hud", 80),
        ("aoa_ssa", True, "aoa_ssa", 0),
        ("vfr_hud", True, "vfr_hud", 1),
        ("vfr_hud", False, "vfr_hud", 1),
    ],
)
def test_each_choice_flies_its_source_and_tells_it_once(alpha: str, aoa: bool, source: str, first_j: int) -> None:
    b = Bench(AutopilotConfig(HIRM, alpha=alpha))
    give(b, 0, 150, aoa=aoa)
    assert b.mode == "TRACKING"
    assert told(b) == [source]
    assert [c["j"] for c in b.commands] == list(range(first_j, 151))
    assert b.commands[-1]["x"] == pytest.approx(X0, rel=1e-6, abs=2e-7)


def test_aoa_ssa_alone_asked_for_is_waited_for() -> None:
    b = Bench(AutopilotConfig(HIRM, alpha="aoa_ssa"))
    give(b, 0, 300, aoa=False)
    assert (b.mode, b.commands, told(b)) == ("STANDBY", [], [])


def test_auto_goes_back_and_tells_it() -> None:
    b = Bench()
    give(b, 0, 100, aoa=False)
    give(b, 101, 120, aoa=True)
    assert told(b) == ["vfr_hud", "aoa_ssa"]


def test_an_aoa_ssa_that_stops_is_failsafe_and_no_change_of_source() -> None:
    b = Bench()
    give(b, 0, 100, aoa=True)
    give(b, 101, 300, aoa=False)
    assert (b.mode, told(b)) == ("NEUTRAL", ["aoa_ssa"])


def test_one_stray_aoa_ssa_costs_neither_the_mode_nor_the_angle_of_attack() -> None:
    b = Bench()
    give(b, 0, 100, aoa=False)
    b.to(b.t0_ns + 101 * TS)
    b.give(AoaSsa((b.t0_ns + 101 * TS) // 1000, 20.0, 0.0))
    give(b, 101, 300, aoa=False)
    assert (b.mode, told(b)) == ("TRACKING", ["vfr_hud"])
    assert [c["j"] for c in b.commands] == list(range(80, 301))


def test_the_aircraft_follows_its_reference_without_aoa_ssa() -> None:
    rng = np.random.default_rng(1)

    def jitter(_now_ns: int) -> int:
        return int(rng.integers(1, 25)) * MS

    flight = Flight(
        AutopilotConfig(HIRM, STEP), PlantConfig(HIRM.model, X0, aoa=False), up=jitter, down=constant(5 * MS)
    )
    flight.fly(15 * S)
    assert flight.transitions() == [("STANDBY", "TRACKING")]
    truth = {body["k"]: np.array(body["x"]) for body in flight.bodies("plant/truth")}
    commands = flight.bodies("autopilot/command")
    errors = [abs(c["x"][0] - truth[c["j"]][0]) for c in commands]
    gamma = np.array([x[2] - x[0] for x in truth.values()])
    assert max(errors) <= 2.001 * np.max(np.abs(np.diff(gamma)))  # one sample and the jitter old
    assert truth[max(truth)][2] == pytest.approx(math.radians(5.0), rel=0.05)
