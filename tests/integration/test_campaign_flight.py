"""Flights of a campaign flown once more through MAVLink, on the same delays, gusts and references.

The campaign tells sums and maxima. What its compiled loop computes at each sample is seen by flying the first n samples
for every n, with the quantity in question as the output: the sum of squares grows by its square.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gains.model import Gains, Matrix
from gains.store import load_law, require_law
from gains.witnessfile import read_witness
from sitl.campaign.airframes import fly_one
from sitl.campaign.distributions import Signal, parse_delays, parse_signal
from sitl.campaign.engine import Drawn, drawn_block, fly_range
from sitl.campaign.job import Campaign
from sitl.campaign.kernel import LANES, MAX_DELAY
from sitl.campaign.replaying import delays_of, growth_per_sample, write_delays
from sitl.flight import fly_virtual
from sitl.flightdata import FlightData
from sitl.link.presets import parse_link
from sitl.recorder import FlightRecorder
from sitl.scenario import Scenario, load_scenario, stored_scenarios
from sitl.summary import summarise
from tests.sitl import campaigns

SCENARIO = """
title = "a flight of a campaign"
gains = "{gains}"
plant = "{plant}"
duration_s = {duration}
actuator = "{actuator}"
failsafe = "monitor"
latch = "{latch}"
[link]
preset = "perfect"
witness = "worst.csv"
"""


@dataclass
class Drawing:
    """A gust that was drawn."""

    values: Matrix

    def w(self, k: int) -> Matrix:
        return self.values[k] if k < len(self.values) else np.zeros(self.values.shape[1])


def campaign(
    gains: str, delays: str, *, fifo: bool = False, window: tuple[int, int] | None = None, **more: Any
) -> Campaign:
    law = require_law(load_law(gains))
    d_min, d_max = window or (law.d_min, law.d_max)
    return campaigns.campaign(
        gains,
        d_min=d_min,
        d_max=d_max,
        transitions="fifo" if fifo else "any",
        delays=parse_delays(delays, d_min, d_max, fifo=fifo, longest=MAX_DELAY),
        **{
            "gust": parse_signal("sine:1deg..3deg:0.5s..5s", "gust"),
            "reference": Signal(),
            "flights": 100,
            "seed": 3,
            **more,
        },
    )


def drawn_of(job: Campaign, flight: int) -> Drawn:
    return drawn_block(job, flight - flight % LANES).flight(flight % LANES)


@dataclass(frozen=True)
class Flown:
    """What a flight through MAVLink recorded: the truth of its samples, and its summary."""

    truth: list[Mapping[str, Any]]
    summary: Mapping[str, Any]
    data: FlightData

    def states(self) -> Matrix:
        return np.array([body["x"] for body in self.truth])

    def inputs(self) -> Matrix:
        return np.array([body["u"] for body in self.truth])

    def delays(self) -> NDArray[np.uint8]:
        """Return d(k); what holds nothing is k + 1 samples old."""
        told = [body["k"] + 1 if body["d"] is None else body["d"] for body in self.truth]
        return np.array([told], dtype=np.uint8)


def fly_over_mavlink(scenario: Scenario) -> Flown:
    recorder = FlightRecorder(None, {"reference": scenario.reference})
    fly_virtual(scenario, recorder.write)
    data = FlightData.from_records(recorder.kept, scenario.plant, recorder.metadata)
    truth = [body for topic, _, body in recorder.kept if topic == "plant/truth"]
    assert [body["k"] for body in truth] == list(range(scenario.samples))
    return Flown(truth, summarise(scenario, recorder.kept, data, virtual=True), data)


def replay(job: Campaign, flight: int, folder: Path, actuator: str = "float", latch: str = "newest") -> Flown:
    """Write d(k) of a flight, and fly that file over MAVLink with the flight's gust and initial state."""
    write_delays(folder / "worst.csv", job, flight, job.law.name)
    text = SCENARIO.format(
        gains=job.law.name,
        plant=job.plant.name,
        duration=job.samples * job.plant.Ts,
        actuator=actuator,
        latch=latch,
    )
    (folder / "again.toml").write_text(text)
    drawn, scenario = drawn_of(job, flight), load_scenario(str(folder / "again.toml"))
    return fly_over_mavlink(replace(scenario, gust=Drawing(drawn.w), x0=drawn.x0))


def computed(job: Campaign, flight: int, delays: NDArray[np.uint8]) -> Callable[[Matrix, Matrix], Matrix]:
    """Return what gives |C x(k) + D u(k) − Cr xr(k)| of the compiled loop at each sample, for an output C and D."""

    def output(C: Matrix, D: Matrix) -> Matrix:
        plant = replace(job.plant, C=C.reshape(1, -1), D=D.reshape(1, -1))
        parts = [
            fly_range(replace(job, plant=plant, samples=n + 1), flight, flight + 1, delays[:, : n + 1])["error_norm"][0]
            for n in range(job.samples)
        ]
        return np.sqrt(np.maximum(np.diff(np.square(parts), prepend=0.0), 0.0))

    return output


def largest_difference(job: Campaign, flight: int, flown: Flown) -> tuple[float, float]:
    """Return the largest of x and of u, without a reference."""
    assert job.reference.kind == "none"
    output, nx = computed(job, flight, flown.delays()), job.plant.nx
    x = [output(row, np.zeros(1)) for row in np.eye(nx)]
    u = output(np.zeros(nx), np.ones(1))
    off = np.abs(np.abs(flown.states()) - np.array(x).T).max(), np.abs(np.abs(flown.inputs()[:, 0]) - u).max()
    return float(off[0]), float(off[1])


@pytest.mark.parametrize(
    ("job", "latch"),
    [
        (campaign("hirm-paper", "uniform", fifo=True), "newest"),
        (campaign("hirm-d6", "uniform", x0=0.02), "last"),
        (campaign("pendulum-paper", "hold:0.5", gust=parse_signal("sine:0.001..0.01:1s", "gust"), x0=0.01), "last"),
    ],
    ids=["hirm in order", "hirm-d6 in any", "pendulum in any"],
)
def test_a_flight_of_the_campaign_is_that_flight_over_mavlink_sample_by_sample(
    job: Campaign, latch: str, tmp_path: Path
) -> None:
    """To 1e-5 of the output, as the flight is to the plain recursion; u has the gains' factor."""
    flight = in_order(job)
    flown = replay(job, flight, tmp_path, latch=latch)
    asked = np.array(delays_of(job, flight))
    begun = int(np.flatnonzero(np.arange(job.samples) >= asked)[0])
    assert begun < 7
    later = max(7, begun)
    assert flown.delays()[0, later:].tolist() == asked[later:].tolist()
    high = job.plant.actuator.high[0] if job.plant.actuator is not None else math.inf
    assert 0.0 < np.abs(flown.inputs()).max() < 0.99 * high  # proofs and campaigns know no travel, the flight does
    x, u = largest_difference(job, flight, flown)
    assert x < 1e-5
    assert u < 1e-5 * np.abs(job.law.K1).sum()
    columns = fly_range(job, flight, flight + 1, flown.delays())
    assert flown.summary["max_error_rad"] == pytest.approx(columns["max_error"][0], abs=1e-5)
    assert flown.summary["rms_error_rad"] == pytest.approx(columns["rms_error"][0], abs=1e-5)
    assert np.abs(flown.states()).max() > 1e3 * x


def in_order(job: Campaign) -> int:
    """Return a flight whose delays, repeated, keep the order too where the campaign does: a witness goes round."""
    for flight in range(LANES):
        delays = delays_of(job, flight)
        if (job.transitions == "any" and job.link is None) or delays[0] <= delays[-1] + 1:
            return flight
    raise AssertionError


def test_with_pulses_instead_of_floats_it_is_that_flight_to_2e_4_rad(tmp_path: Path) -> None:
    job = campaign("hirm-d6", "uniform", fifo=True)
    flight = in_order(job)
    flown = replay(job, flight, tmp_path, actuator="pwm")
    e = computed(job, flight, flown.delays())(job.plant.C, np.zeros(1))
    off = np.abs(np.abs(flown.data.error[:, 0]) - e).max()
    assert 1e-7 < off < 2e-4


@pytest.mark.parametrize("delay", ["0ms", "12ms"])
def test_with_a_reference_and_a_constant_delay_the_tracking_error_is_the_campaigns(delay: str, tmp_path: Path) -> None:
    """Of one sample: a longer delay leaves the flight without its first commands, which the campaign's has."""
    job = campaign(
        "hirm-paper", "uniform", window=(1, 1), reference=parse_signal("square:1deg..5deg:2s..5s", "reference")
    )
    drawn = drawn_of(job, 17)
    rows = [f"{k * job.plant.Ts!r},{r!r}" for k, r in enumerate(drawn.r[:, 0].tolist())]
    (tmp_path / "r.csv").write_text("\n".join(["time_s,value_rad", *rows]) + "\n")
    up, down = parse_link(None, f"delay={delay}", f"delay={delay}")
    scenario = replace(
        load_scenario("nominal"),
        up=up,
        down=down,
        actuator="float",
        failsafe="monitor",
        reference=f"file:{tmp_path / 'r.csv'}",
        gust=Drawing(drawn.w),
        checks=(),
    )
    flown = fly_over_mavlink(scenario)
    assert (flown.delays() == 1).all()
    columns = fly_range(job, 17, 18)
    assert columns["max_error"][0] > 1e-3
    assert flown.summary["max_error_rad"] == pytest.approx(columns["max_error"][0], abs=1e-5)
    assert flown.summary["rms_error_rad"] == pytest.approx(columns["rms_error"][0], abs=1e-5)
    e = computed(job, 17, flown.delays())(job.plant.C, np.zeros(1))
    assert np.abs(np.abs(flown.data.error[:, 0]) - e).max() < 1e-5


def lifted_growth(law: Gains, delays: tuple[int, ...]) -> float:
    """Return ρ^(1/L) of the full lift over one period."""
    nx, n = law.model.nx, law.model.nx * (max(delays) + 1)
    period = np.eye(n)
    for d in delays:
        step = np.eye(n, k=-nx)
        step[:nx, :nx] = law.model.A
        step[:nx, d * nx : (d + 1) * nx] += law.model.B @ law.K1
        period = step @ period
    return float(np.abs(np.linalg.eigvals(period)).max() ** (1.0 / len(delays)))


def test_the_pendulum_diverges_alike_as_predicted_in_the_campaign_and_over_mavlink(tmp_path: Path) -> None:
    path = stored_scenarios()["witness-pendulum"].with_name("witness-pendulum.csv")
    job = campaign("pendulum-paper", f"cycle:{path}", fifo=True, window=(1, 7), gust=Signal(), x0=0.005, samples=1999)
    law, cycle = job.law, read_witness(path).delays
    assert isinstance(law, Gains)
    growth = lifted_growth(law, cycle)
    assert growth > 1.001
    assert growth_per_sample(job, cycle) == pytest.approx(growth, rel=1e-9)
    long = fly_range(replace(job, samples=20_000), 0, LANES)
    assert long["diverged"].all()
    assert np.log(long["growth"]) == pytest.approx(math.log(growth), rel=3e-3)
    flown = fly_over_mavlink(replace(load_scenario("witness-pendulum"), variants={}))
    assert np.log(flown.summary["witness"]["growth_per_sample"]) == pytest.approx(math.log(growth), rel=1e-3)
    assert flown.summary["witness"]["predicted"] == pytest.approx(growth, rel=1e-9)
    again = replace(job, samples=2000)
    flight = in_order(again)
    same = replay(again, flight, tmp_path)
    column = fly_range(job, flight, flight + 1, same.delays()[:, :1999])
    largest = np.abs(same.states()).max(axis=1)
    measured = (largest[1:].max() / largest[1:1000].max()) ** (1.0 / 1000)
    assert column["max_state"][0] == pytest.approx(largest[1:].max(), rel=1e-4)
    assert math.log(measured) == pytest.approx(math.log(column["growth"][0]), rel=1e-4)
    assert measured == pytest.approx(growth, abs=3e-5)  # within a period it is not even


def test_a_written_flight_is_read_back_with_its_delays_its_order_and_its_growth(tmp_path: Path) -> None:
    for fifo in (True, False):
        job = campaign("hirm-paper", "uniform", fifo=fifo, samples=60)
        flight = in_order(job)
        write_delays(tmp_path / "w.csv", job, flight, "hirm-paper")
        witness = read_witness(tmp_path / "w.csv")
        assert witness.delays == delays_of(job, flight) == tuple(drawn_of(job, flight).d.tolist())
        assert (witness.gains, witness.model, witness.Ts) == ("hirm-paper", "hirm", 0.025)
        assert witness.transitions == ("fifo" if fifo else "any")
        assert isinstance(job.law, Gains)
        assert witness.growth_per_sample == pytest.approx(lifted_growth(job.law, witness.delays), rel=1e-9)


def test_a_written_flight_over_a_link_has_the_delays_that_the_link_made(tmp_path: Path) -> None:
    up, down = parse_link(None, "delay=5ms,loss=0.3", "delay=5ms")
    job = replace(campaign("hirm-d6", "uniform"), delays=None, link=(up, down), samples=200)
    flight = in_order(job)
    flown, asked = replay(job, flight, tmp_path), delays_of(job, flight)
    assert max(asked) > 2
    assert flown.delays()[0].tolist() == list(asked)
    facts = fly_one(job, flight, drawn_of(job, flight)._replace(d=np.array(asked, dtype=np.int32)))
    assert flown.summary["max_error_rad"] == pytest.approx(facts[2], abs=1e-5)
