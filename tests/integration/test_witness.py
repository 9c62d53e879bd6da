"""A witness replayed: the loop diverges as computed, whatever computes it.

What the flights are compared with knows nothing of nodes, links and frames: x(k+1) = A x(k) + B K1 x(k - d(k)),
run directly from the witness file, and the spectral radius of one period of it.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Mapping
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from functools import cached_property
from io import StringIO
from itertools import pairwise
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from rich.console import Console

from autopilot.link.record import read_mcap
from autopilot.link.topics import schema_of
from gains.model import Gains
from gains.store import load_gains
from sitl.__main__ import main
from sitl.fly import FlightOptions, fly
from sitl.scenario import Scenario, load_scenario, stored_scenarios
from tests.integration.programs import program

pytestmark = pytest.mark.realtime

NAMES = ("witness", "witness-pendulum")

SLOW_MODEL = """
name = "slow"
Ts = 0.1
[plant]
continuous = false
A = [[1.0, 0.095], [0.0, 0.905]]
B = [[-0.014], [-0.28]]
states = ["angle_rad", "rate_rad_s"]
[actuator]
low = [-1.0]
high = [1.0]
[sensors]
angle_rad = "ATTITUDE.pitch"
rate_rad_s = "ATTITUDE.pitchspeed"
"""
SLOW_GAINS = 'name = "slow-gains"\nmodel = "slow.toml"\nd_min = 1\nd_max = 4\nK1 = [[2.24, 1.4]]\n'
SLOW_SCENARIO = """
title = "a slow loop, for processes that are stopped now and then"
gains = "{folder}/gains.toml"
plant = "{folder}/slow.toml"
duration_s = 10.0
x0 = [1e-4, 0.0]
actuator = "float"
failsafe = "monitor"
[link]
witness = "w.csv"
[[check]]
name = "lives the delays"
metric = "witness.mismatch_fraction"
at_most = 0.001
"""
SLOW_DELAYS = (1, 2, 3, 4, 5, 2)


def delays_of(path: Path) -> tuple[int, ...]:
    """Return d of a witness file, read as plain CSV."""
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    return tuple(int(row["d"]) for row in csv.DictReader(lines))


def recursion(gains: Gains, delays: tuple[int, ...], x0: np.ndarray, samples: int) -> np.ndarray:
    """Return x(k+1) = A x(k) + B K1 x(k - d(k)), the input zero before the first command; shape (samples, nx)."""
    A, B, K1 = gains.model.A, gains.model.B, gains.K1
    x = [x0]
    for k in range(samples - 1):
        j = k - delays[k % len(delays)]
        x.append(A @ x[k] + (B @ (K1 @ x[j]) if j >= 0 else 0.0))
    return np.array(x)


def growth(gains: Gains, delays: tuple[int, ...]) -> float:
    """Return rho^(1/L) of the full lift z(k) = [x(k); x(k-1); ...; x(k-d_max)] over one period."""
    A, BK = gains.model.A, gains.model.B @ gains.K1
    nx, longest = len(A), max(delays)
    period = np.eye(nx * (longest + 1))
    for d in delays:
        step = np.eye(len(period), k=-nx)
        step[:nx, :nx] = A
        step[:nx, d * nx : (d + 1) * nx] += BK
        period = step @ period
    return float(np.abs(np.linalg.eigvals(period)).max() ** (1 / len(delays)))


@dataclass(frozen=True)
class Flight:
    """A flight, what it left in its folder, and what it said."""

    scenario: Scenario
    delays: tuple[int, ...]
    folder: Path
    summary: Mapping

    @cached_property
    def messages(self) -> list[tuple[str, int, Mapping]]:
        return list(read_mcap(self.folder / "flight.mcap"))

    @cached_property
    def truth(self) -> list[Mapping]:
        return [body for topic, _, body in self.messages if topic == "plant/truth"]

    def deviation(self, samples: int) -> float:
        """Return the largest |x - x'| over the first samples, relative to the largest |x'| up to there."""
        assert self.scenario.x0 is not None
        assert isinstance(self.scenario.gains, Gains)
        x = recursion(self.scenario.gains, self.delays, self.scenario.x0, samples)
        largest = np.maximum.accumulate(np.abs(x).max(axis=1))
        flown = np.array([body["x"] for body in self.truth[:samples]])
        return float((np.abs(flown - x).max(axis=1) / largest).max())

    def others(self) -> list[int]:
        """Return the samples that lived another delay than the file says."""
        wanted = [(k, self.delays[k % len(self.delays)]) for k in range(len(self.truth))]
        assert [body["k"] for body in self.truth] == [k for k, _ in wanted]
        return [k for k, d in wanted if k >= d and self.truth[k]["d"] != d]


@pytest.fixture(scope="module", params=NAMES)
def flight(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Flight:
    """A stored scenario, flown in virtual time with its variant beside it."""
    scenario, folder = load_scenario(request.param), tmp_path_factory.mktemp(request.param)
    outcome = fly(scenario, FlightOptions(True, folder), Console(file=StringIO()))
    assert outcome.passed, outcome.verdicts
    assert scenario.witness_name is not None
    return Flight(scenario, delays_of(Path(scenario.witness_name)), folder, outcome.summary)


def test_every_sample_lives_the_delay_of_the_file(flight: Flight) -> None:
    assert len(flight.truth) == flight.scenario.samples
    assert flight.others() == []
    assert flight.summary["witness"]["mismatches"] == 0


def test_the_states_are_those_of_the_plain_recursion_until_the_elevator_saturates(flight: Flight) -> None:
    high = flight.scenario.plant.actuator.high[0]
    saturated = [body["k"] for body in flight.truth if abs(body["u"][0]) > high - 1e-9]
    samples = saturated[0] if saturated else len(flight.truth)
    assert samples > 20 * len(flight.delays)
    assert flight.deviation(samples) < 1e-5


def test_the_growth_flown_the_growth_of_the_file_and_the_spectral_radius_agree(flight: Flight) -> None:
    found = flight.summary["witness"]
    computed = growth(flight.scenario.gains, flight.delays)
    assert computed > 1.001
    assert found["predicted"] == pytest.approx(computed, rel=1e-9)
    assert np.log(found["growth_per_sample"]) == pytest.approx(np.log(computed), rel=1e-3)
    assert found["growth_error"] < 1e-3


def test_the_same_gains_do_not_diverge_where_each_delay_is_constant(flight: Flight) -> None:
    for d in range(1, max(flight.delays) + 1):
        assert growth(flight.scenario.gains, (d,)) < 1.0


def test_a_failsafe_that_acts_leaves_tracking_within_a_sample(flight: Flight) -> None:
    assert 0.0 <= flight.summary["variants"]["failsafe-on"]["failsafe_reaction_samples"] <= 1.0
    window = flight.scenario.gains.d_max
    outside = [body["k"] for body in flight.truth if body["d"] is not None and body["d"] > window]
    modes = {body["j"]: body["mode"] for topic, _, body in flight.messages if topic == "autopilot/command"}
    first = [k for last, k in pairwise([-9, *outside]) if k > last + 1]
    assert len(first) > 20
    assert {modes[k] for k in first if k in modes} <= {"HOLD", "NEUTRAL"}  # monitored: it says so, and flies on


def test_the_recording_accounts_for_every_command(flight: Flight) -> None:
    down = [body for topic, _, body in flight.messages if topic == "link/down"]
    validate = jsonschema.Draft202012Validator(schema_of("link/down")).validate
    for body in down:
        validate(body)
    fates = [body["fate"] for body in down]
    assert set(fates) == {"delivered", "gated"}
    assert all((body["delivered_ns"] is None) == (body["fate"] == "gated") for body in down)
    assert fates.count("gated") == flight.summary["witness"]["gated"] > 100
    link = flight.summary["link"]["down"]
    assert link["sent"] + link["duplicated"] == link["delivered"] + link["lost"] + fates.count("gated")


def test_other_gains_survive_the_same_sequence() -> None:
    """The window is that of the gains, not of the aircraft: half the gains grow no more."""
    scenario = load_scenario("witness")
    assert isinstance(scenario.gains, Gains)
    assert scenario.witness is not None
    half = replace(scenario.gains, K1=0.5 * scenario.gains.K1)
    assert growth(half, scenario.witness.delays) < 1.0
    outcome = fly(replace(scenario, gains=half, variants={}), FlightOptions(True, None), Console(file=StringIO()))
    assert outcome.summary["witness"]["mismatches"] == 0
    assert outcome.summary["witness"]["growth_per_sample"] < 1.0
    assert not outcome.passed


@pytest.fixture(scope="module")
def over_udp(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Flight]:
    """Ten seconds over UDP with a slow sample: what a busy machine takes away is small against it."""
    folder = tmp_path_factory.mktemp("slow")
    (folder / "slow.toml").write_text(SLOW_MODEL)
    (folder / "gains.toml").write_text(SLOW_GAINS)
    rate = growth(load_gains(folder / "gains.toml"), SLOW_DELAYS)
    head = f"# Ts_s: 0.1\n# d_min: 1\n# d_max: 5\n# transitions: fifo\n# growth_per_sample: {rate!r}\nk,d\n"
    (folder / "w.csv").write_text(head + "".join(f"{k},{d}\n" for k, d in enumerate(SLOW_DELAYS)))
    (folder / "s.toml").write_text(SLOW_SCENARIO.format(folder=folder))
    options = ["--gcs", "none", "--port-base", "0", "--out", "out", "--json"]
    with program(folder, "sitl", "fly", "s.toml", *options) as flying:
        assert flying.wait() == 0, flying.stderr + flying.stdout
        yield Flight(load_scenario(str(folder / "s.toml")), SLOW_DELAYS, folder / "out", json.loads(flying.stdout))


def test_over_udp_at_most_one_sample_in_a_thousand_lives_another_delay(over_udp: Flight) -> None:
    assert len(over_udp.truth) == 100
    assert over_udp.summary["witness"]["mismatch_fraction"] <= 0.001
    assert len(over_udp.others()) == over_udp.summary["witness"]["mismatches"]


def test_over_udp_the_states_and_the_growth_are_those_computed(over_udp: Flight) -> None:
    assert over_udp.deviation(100) < 1e-5
    found = over_udp.summary["witness"]
    assert abs(np.log(found["predicted"])) > 0.001
    assert found["growth_error"] < 0.1


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["relay", "--listen", "127.0.0.1:0", "--witness", "none.csv"], "none.csv: expected a witness file"),
        (["relay", "--listen", "127.0.0.1:0", "--witness", "zero.csv"], "zero.csv: d_min: expected at least 1"),
        (["fly", "any.toml"], "any.csv: transitions: expected fifo"),
    ],
)
def test_a_witness_that_cannot_be_flown_is_refused_in_one_line(
    arguments: list[str], named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = stored_scenarios()["witness"].with_name("witness-hirm.csv").read_text()
    (tmp_path / "zero.csv").write_text(text.replace("d_min: 1", "d_min: 0"))
    (tmp_path / "any.csv").write_text(text.replace("fifo", "any"))
    (tmp_path / "any.toml").write_text(stored_scenarios()["witness"].read_text().replace("witness-hirm", "any"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["sitl", *arguments])
    out, err = StringIO(), StringIO()
    with redirect_stdout(out), redirect_stderr(err), pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 2
    assert err.getvalue().startswith(f"sitl: error: {named}")
    assert err.getvalue().count("\n") == 1
    assert out.getvalue() == ""
