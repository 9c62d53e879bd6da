"""Flights that show what the forecast of the delay is worth: links, recordings as arrays, scores.

A command that is lost, or overtaken by a newer one, is never applied: what is scored is each command's first sample in
force, as the plant knows it. Nothing here uses the estimator; frames are read by their published layout.
"""

from __future__ import annotations

import base64
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega as dialect

from autopilot.link.clock import NS_PER_MS, NS_PER_S, NS_PER_US, Clock
from autopilot.link.node import Record
from gains.store import load_law
from sitl.flight import fly_virtual
from sitl.link.spec import parse_spec
from sitl.scenario import Scenario, load_scenario

__all__ = [
    "CASES",
    "DURATION_S",
    "LINKS",
    "RANDOM_RETURN",
    "SETTLED_S",
    "STEADY_RETURN",
    "TS_NS",
    "Case",
    "Flight",
    "Forecasts",
    "Score",
    "agrees",
    "bins",
    "fly",
    "recomputed_delays",
    "scenario_of",
    "score",
    "tracking_errors",
]

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

TS_NS = 25 * NS_PER_MS
DURATION_S = 300.0
SETTLED_S = 10.0
"""What comes before is not scored."""
GAINS = "hirm-d6"

LTE = "delay=25ms,jitter=gamma:10ms"
LINKS: Mapping[str, tuple[str, str]] = {
    "LAN": ("delay=0.2ms", "delay=0.2ms"),
    "20/60 ms": ("delay=20ms", "delay=60ms"),
    "LTE up": (LTE, "delay=25ms"),
    "LTE": (LTE, LTE),
    "LTE loss": (LTE + ",loss=ge:0.02:0.18", LTE + ",loss=ge:0.02:0.18"),
    "30-70 ms": ("delay=30ms,jitter=uniform:40ms", "delay=30ms,jitter=uniform:40ms"),
    "10 ms up": ("delay=10ms", "delay=10ms,jitter=gamma:20ms"),
}
"""Each way, up (from the plant) first."""


@dataclass(frozen=True, slots=True)
class Case:
    """A link, and whether it keeps the order of its packets."""

    link: str
    keep_order: bool

    @property
    def specs(self) -> tuple[str, str]:
        up, down = LINKS[self.link]
        order = ",order=keep" if self.keep_order else ""
        return up + order, down + order

    def __str__(self) -> str:
        return self.link + (", in order" if self.keep_order else "")


CASES = tuple(
    Case(link, keep_order)
    for link, ways in LINKS.items()
    for keep_order in (False, True)
    if not keep_order or any("jitter" in way for way in ways)
)
"""Where nothing is random, order keeps itself."""
STEADY_RETURN = tuple(case for case in CASES if "jitter" not in case.specs[1])
RANDOM_RETURN = tuple(case for case in CASES if "jitter" in case.specs[1])


def scenario_of(case: Case, seed: int, duration_s: float = DURATION_S) -> Scenario:
    """Return a flight over a link; clocks at both ends of the drift they may have, one way or the other by the seed."""
    up, down = map(parse_spec, case.specs)
    drift_ppb = 100_000 if seed % 2 else -100_000
    clocks = {
        "plant": Clock(137 * NS_PER_S, drift_ppb),
        "relay": Clock(11 * NS_PER_S),
        "autopilot": Clock(1042 * NS_PER_S, -drift_ppb),
    }
    law = load_law(GAINS)
    nominal = replace(load_scenario("nominal"), gains=law, gains_name=GAINS, failsafe="monitor", clocks=clocks)
    return replace(nominal, up=up, down=down, seed=seed, duration_s=duration_s)


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """What a recording says, as integers; -1 where there is nothing.

    Attributes
    ----------
    scenario : Scenario
        What was flown.
    ticks : (samples, 4) array
        Per sample k of the plant: true time, the plant's time, j and d in force.
    commands : (n, 7) array
        Per command: j, stamp of the sample (plant's time), own and true time of leaving, forecast d, low, high.
    probability : (n,) array
        Of the interval of each forecast; nan where there is none.
    stamps_us : (packets,) array
        Of the commands among the datagrams that the autopilot has sent, in order; -1 for other datagrams.
    delivered : (m, 2) array
        True time and number (from 1) of those that reached the plant.
    reports : (r, 2) array
        DELAY_K as the autopilot received it: time_boot_ms, d.
    exchanges : (e, 3) array
        TIMESYNC: ts1, tc1, own time of receiving.
    """

    scenario: Scenario
    ticks: Ints
    commands: Ints
    probability: Floats
    stamps_us: Ints
    delivered: Ints
    reports: Ints
    exchanges: Ints

    @property
    def applied(self) -> tuple[Ints, Ints]:
        """Rows of ``commands`` that came in force after the first seconds, and the delay that each had first."""
        j, d = self.ticks[:, 2], self.ticks[:, 3]
        first = np.flatnonzero((j[1:] != j[:-1]) & (j[1:] >= 0)) + 1
        first = first[first * TS_NS >= SETTLED_S * NS_PER_S]
        rows = {int(number): row for row, number in enumerate(self.commands[:, 0])}
        return np.array([rows[int(number)] for number in j[first]], dtype=np.int64), d[first]

    @property
    def ages_ms(self) -> Floats:
        """True ages of the samples when their commands left."""
        plant = self.scenario.clocks["plant"]
        left = np.array([plant.node_ns(int(true_ns)) for true_ns in self.commands[:, 3]], dtype=np.int64)
        ages: Floats = (left - self.commands[:, 1]) / NS_PER_MS
        return ages


@dataclass(slots=True)
class _Log:
    """Takes the records of a flight as they come."""

    ticks: list[tuple[int, ...]] = field(default_factory=list)
    commands: list[tuple[int, ...]] = field(default_factory=list)
    probability: list[float] = field(default_factory=list)
    stamps_us: list[int] = field(default_factory=list)
    delivered: list[tuple[int, int]] = field(default_factory=list)
    reports: list[tuple[int, int]] = field(default_factory=list)
    exchanges: list[tuple[int, ...]] = field(default_factory=list)

    def write(self, record: Record, true_ns: int) -> None:
        body = record.body
        match record.topic:
            case "plant/truth":
                self.ticks.append((true_ns, body["t_ns"], _number(body["j"]), _number(body["d"])))
            case "link/down":
                if body["fate"] == "delivered":
                    self.delivered.append((true_ns, body["number"]))
            case "mavlink/plant":
                frame = base64.b64decode(body["frame"])
                if body["direction"] == "sent":
                    self.stamps_us.append(_stamp_us(frame))
                else:
                    self._received(frame, record.t_ns)
            case "autopilot/command":
                forecast = [_number(body[name]) for name in ("d", "d_low", "d_high")]
                self.commands.append((body["j"], body["sample_ns"], record.t_ns, true_ns, *forecast))
                self.probability.append(body["d_probability"] if body["d"] is not None else np.nan)
            case _:
                pass

    def _received(self, frame: bytes, own_ns: int) -> None:
        number = _message_id(frame)
        if number == dialect.MAVLINK_MSG_ID_TIMESYNC:
            tc1, ts1 = struct.unpack("<qq", _payload(frame, 16))
            self.exchanges.append((ts1, tc1, own_ns))
        elif number == dialect.MAVLINK_MSG_ID_NAMED_VALUE_INT:
            time_boot_ms, value, name = struct.unpack("<Ii10s", _payload(frame, 18))
            if name.rstrip(b"\0") == b"DELAY_K":
                self.reports.append((time_boot_ms, value))


def _number(value: Any) -> int:
    return -1 if value is None else int(value)


def _message_id(frame: bytes) -> int:
    return int.from_bytes(frame[7:10], "little")


def _payload(frame: bytes, size: int) -> bytes:
    """Return a payload of MAVLink 2 with the zeros that it is sent without; extensions are cut."""
    return frame[10 : 10 + frame[1]].ljust(size, b"\0")[:size]


def _stamp_us(frame: bytes) -> int:
    if _message_id(frame) != dialect.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW:
        return -1
    return int.from_bytes(_payload(frame, 4), "little")


@lru_cache(maxsize=128)
def fly(case: Case, seed: int, duration_s: float = DURATION_S) -> Flight:
    """Return a flight, flown once; 3 MB are kept of it."""
    scenario, log = scenario_of(case, seed, duration_s), _Log()
    fly_virtual(scenario, log.write)
    return Flight(
        scenario,
        np.array(log.ticks, dtype=np.int64),
        np.array(log.commands, dtype=np.int64),
        np.array(log.probability),
        np.array(log.stamps_us, dtype=np.int64),
        np.array(log.delivered, dtype=np.int64),
        np.array(log.reports, dtype=np.int64),
        np.array(log.exchanges, dtype=np.int64),
    )


def recomputed_delays(flight: Flight) -> Ints:
    """Return d(k) from the packets alone: of the commands that had come by sample k, the newest stamp is in force."""
    u32 = 1 << 32
    sample_of = {int(t_ns) // NS_PER_US % u32: k for k, t_ns in enumerate(flight.ticks[:, 1])}
    came = flight.delivered[np.argsort(flight.delivered[:, 0], kind="stable")]
    d, newest, n = [], -1, 0
    for k, tick_ns in enumerate(flight.ticks[:, 0].tolist()):
        while n < len(came) and came[n, 0] <= tick_ns:
            stamp_us = int(flight.stamps_us[came[n, 1] - 1])
            if stamp_us >= 0:
                newest = max(newest, sample_of[stamp_us])
            n += 1
        d.append(k - newest if newest >= 0 else -1)
    return np.array(d, dtype=np.int64)


def agrees(flight: Flight) -> bool:
    """Return whether truth, every report that came, and the packets say the same d."""
    d = flight.ticks[:, 3]
    sample_of = {int(t_ns) // NS_PER_MS: k for k, t_ns in enumerate(flight.ticks[:, 1])}
    reported = np.array([sample_of[int(time_boot_ms)] for time_boot_ms in flight.reports[:, 0]])
    return bool((recomputed_delays(flight) == d).all() and (flight.reports[:, 1] == d[reported]).all())


@dataclass(frozen=True, slots=True, eq=False)
class Forecasts:
    """Forecasts of many commands: the likeliest d, an interval, and its probability."""

    d: Ints
    low: Ints
    high: Ints
    probability: Floats

    @classmethod
    def of(cls, flight: Flight) -> Forecasts:
        """Return those that the autopilot made of the commands that were applied."""
        rows, _ = flight.applied
        d, low, high = flight.commands[rows, 4:].T
        return cls(d, low, high, flight.probability[rows])

    def covers(self, d: Ints) -> Bools:
        covered: Bools = (self.low <= d) & (d <= self.high)
        return covered


@dataclass(frozen=True, slots=True)
class Score:
    """Shares of forecasts that were exact and whose interval held d; the mean of what it claimed, and of its width."""

    exact: float
    covered: float
    claimed: float
    width: float


def score(forecasts: Forecasts, d: Ints) -> Score:
    """Return the score of forecasts against the true delays."""
    return Score(
        float(np.mean(forecasts.d == d)),
        float(np.mean(forecasts.covers(d))),
        float(np.mean(forecasts.probability)),
        float(np.mean(forecasts.high - forecasts.low)),
    )


def bins(probability: Floats, covered: Bools) -> list[tuple[float, int, float, bool]]:
    """Return per bin of a point: its left end, its size, by how much the coverage exceeds the claim, whether it counts.

    A bin counts when three standard errors of its coverage are less than a point. The last one ends with 1.
    """
    edges = np.array([0.0, 0.95, 0.96, 0.97, 0.98, 0.99])
    which = np.searchsorted(edges, probability, "right") - 1
    found = []
    for n in np.unique(which).tolist():
        claimed, came = probability[which == n], covered[which == n]
        mean = float(claimed.mean())
        counts = 3.0 * np.sqrt(mean * (1.0 - mean) / claimed.size) < 0.01
        found.append((float(edges[n]), int(claimed.size), float(came.mean() - mean), bool(counts)))
    return found


# What a forecast is good for

PERIOD_S = 8.0
"""Of a reference that goes up, down and back for two seconds, two seconds and four."""


def _doublet_deg(t_s: float) -> float:
    since_s = t_s % PERIOD_S
    return 5.0 if since_s < 2.0 else -5.0 if since_s < 4.0 else 0.0


def tracking_errors(case: Case, seed: int, duration_s: float) -> tuple[float, float]:
    """Return the rms of the error of the pitch angle with the reference aligned by the forecast, and without, rad."""
    switches = [start + after for start in np.arange(0.0, duration_s, PERIOD_S).tolist() for after in (0.0, 2.0, 4.0)]
    reference = ",".join(f"{_doublet_deg(t_s)}deg@{t_s}s" for t_s in switches)
    scenario = replace(scenario_of(case, seed, duration_s), reference=reference)
    return _tracking_error(scenario), _tracking_error(replace(scenario, align=False))


def _tracking_error(scenario: Scenario) -> float:
    """Return the rms of the output's error against the reference model, which is run again here."""
    model, outputs = scenario.plant, []

    def write(record: Record, _true_ns: int) -> None:
        if record.topic == "plant/truth":
            outputs.append(model.C @ (np.array(record.body["x"]) - model.trim.x))

    fly_virtual(scenario, write)
    assert model.reference is not None
    xr, errors = np.zeros(model.reference.Ar.shape[0]), []
    for k, output in enumerate(outputs):
        errors.append(output[0] - (model.reference.Cr @ xr)[0])
        xr = model.reference.Ar @ xr + model.reference.Br[:, 0] * np.radians(_doublet_deg(k * model.Ts))
    return float(np.sqrt(np.mean(np.square(errors))))
