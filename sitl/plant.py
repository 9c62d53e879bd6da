"""The aircraft behind a Node: integrate, sense, latch, report d(k); sensors and elevator may fail.

The clockwork. Sample k = 0 is the first instant of the grid i Ts (plant's clock) after the first heartbeat
of the autopilot; until then the state is held. At sample k the plant latches the command that holds over
[k, k+1), senses x(k) and sends it, and integrates to x(k+1). A late wake-up catches up sample by sample;
what counts is when a command arrived (over UDP: when its socket was read), not when the plant woke up.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from autopilot.link.clock import NS_PER_MS, NS_PER_S, NS_PER_US, following, unwrap
from autopilot.link.node import Datagram, Record
from autopilot.link.sensors import sensors_of
from autopilot.link.servo import travel_of
from autopilot.link.wire import (
    AUTOPILOT,
    PLANT,
    AoaSsa,
    Attitude,
    Heartbeat,
    HilActuatorControls,
    Message,
    NamedValueInt,
    Seal,
    ServoOutputRaw,
    Timesync,
    VfrHud,
    Wire,
    plant_heartbeat,
)
from gains.model import Model
from sitl.aircraft.airframe import Airframe, Pose
from sitl.aircraft.disturbance import HarmonicGust, SquareDelta
from sitl.aircraft.faulty import FaultyElevator, FaultySensors
from sitl.aircraft.linear import LinearAirframe
from sitl.faults import AircraftFault

__all__ = ["PlantConfig", "PlantNode", "Refusal"]

PORT = "autopilot"
MAX_COMMANDS = 256
"""Commands that may wait for the next sample; further ones are refused."""
MAX_CATCH_UP = 64
"""Samples that one wake-up may work off; the next follow at once, after the port has been served."""
DEFAULT_SERVO_TIMEOUT = 9
"""Samples; d_max + 5 for the published gains."""
SILENCE = 9
"""So many samples without a new command, and each is numbered: the autopilot may have to start again."""


class Refusal(StrEnum):
    """Why a command was not put on the elevator."""

    STAMP = "stamp"
    """It names a sample that has not been sent."""
    RANGE = "range"
    """Its pulse lies outside the travel."""
    OVERFLOW = "overflow"
    """Too many commands in one sample."""
    NOT_FLYING = "not_flying"
    """It came before the first heartbeat."""


@dataclass(frozen=True, slots=True, eq=False)
class PlantConfig:
    """One aircraft in one flight.

    Attributes
    ----------
    model : Model
        The plant.
    x0 : (nx,) array or None
        State at k = 0, absolute; None for trim.
    gust : HarmonicGust or None
        w(k).
    delta : SquareDelta or None
        Delta(k).
    latch : "newest" or "last"
        Of the commands that came in time: the one with the newest sample stamp, or the last arrived.
    servo_timeout : int or None
        Samples without a new command after which the elevator goes to neutral; None for never.
    aoa : bool
        Whether it sends AOA_SSA; many vehicles do not.
    faults : tuple of AircraftFault
        What its sensors and its elevator do wrong, times from sample k = 0.
    seed : int
        Of the sensors' noise.
    airframe : callable or None
        Makes the aircraft, at trim; None is the linear one of ``model``. With one ``x0`` is of no meaning.
    """

    model: Model
    x0: NDArray[np.float64] | None = None
    gust: HarmonicGust | None = None
    delta: SquareDelta | None = None
    latch: Literal["newest", "last"] = "newest"
    servo_timeout: int | None = DEFAULT_SERVO_TIMEOUT
    aoa: bool = True
    faults: tuple[AircraftFault, ...] = ()
    seed: int = 1
    airframe: Callable[[], Airframe] | None = None


@dataclass(frozen=True, slots=True)
class _Command:
    """A command on its way to the latch: when it came, the sample it used, the input."""

    arrived_ns: int
    j: int
    u: float


@dataclass(slots=True)
class _Latch:
    """What holds the elevator."""

    j: int | None = None
    u: float = 0.0
    since_k: int = 0
    timed_out: bool = False


@dataclass(slots=True)
class _Flight:
    """What changes from sample to sample."""

    t0_ns: int
    k: int
    position: NDArray[np.float64]
    latch: _Latch
    pending: list[_Command] = field(default_factory=list)
    crashed: bool = False


class PlantNode:
    """Node with the one port ``autopilot``.

    Parameters
    ----------
    config : PlantConfig
        What flies.
    seal : Seal, optional
        Signs what is sent, and checks what is heard.

    Attributes
    ----------
    samples : int
        Samples flown so far.
    refusals : Counter
        Commands that were not taken, by kind.
    """

    def __init__(self, config: PlantConfig, seal: Seal | None = None) -> None:
        self.config = config
        self.model = config.model
        self._Ts_ns = config.model.Ts_ns
        self._still = np.zeros(config.model.nw)
        self.travel = travel_of(config.model)
        nonlinear = config.airframe is not None
        self.airframe = config.airframe() if config.airframe is not None else LinearAirframe(config.model, config.x0)
        self.wire = Wire(PLANT, AUTOPILOT, seal=seal)
        self.refusals: Counter[Refusal] = Counter()
        self._gust = replace(config.gust) if config.gust is not None else None
        self._sensors = sensors_of(config.model)
        self._air_data = config.aoa and (nonlinear or any(sensor.message is AoaSsa for sensor in self._sensors))
        self._tells_air = nonlinear
        self._faulty_sensors = FaultySensors(config.model, config.faults, config.seed)
        self._elevator = FaultyElevator(config.model, config.faults)
        self._flight: _Flight | None = None
        self._next_heartbeat_ns: int | None = None
        self._out: list[Datagram] = []
        self._records: list[Record] = []

    @property
    def samples(self) -> int:
        """Number of samples flown."""
        return self._flight.k if self._flight is not None else 0

    # Node

    def receive(self, port: str, datagram: bytes, now_ns: int) -> None:
        """Take one datagram of the autopilot."""
        assert port == PORT
        if self.wire.seal is not None:
            self.wire.seal.tick(now_ns)
        for message in self.wire.decode(datagram):
            if self._next_heartbeat_ns is None:
                self._next_heartbeat_ns = now_ns
            match message:
                case Heartbeat():
                    if self._flight is None:
                        self._start(now_ns)
                case Timesync(tc1=0):
                    self._send(Timesync(max(1, now_ns), message.ts1))  # a reply of 0 would be a request
                case ServoOutputRaw():
                    self._take(message.time_usec, True, self.travel.from_pwm(message.servo2_raw), now_ns)
                case HilActuatorControls():
                    u = self.travel.from_control(message.elevator)
                    self._take(message.time_usec, False, u, now_ns)
                case _:
                    pass

    def tick(self, now_ns: int) -> None:
        """Work off the samples that are due."""
        if self.wire.seal is not None:
            self.wire.seal.tick(now_ns)
        if self._next_heartbeat_ns is not None and now_ns >= self._next_heartbeat_ns:
            self._next_heartbeat_ns = following(self._next_heartbeat_ns, NS_PER_S, now_ns)
            self._send(plant_heartbeat())
            self._record_counters(now_ns)
        flight = self._flight
        if flight is None:
            return
        for _ in range(MAX_CATCH_UP):
            t_ns = flight.t0_ns + flight.k * self._Ts_ns
            if t_ns > now_ns:
                break
            self._sample(flight, t_ns, now_ns)

    def next_deadline_ns(self) -> int | None:
        """Return when the next sample or heartbeat is due; None before the autopilot has spoken."""
        if self._flight is None or self._next_heartbeat_ns is None:
            return self._next_heartbeat_ns
        return min(self._next_heartbeat_ns, self._flight.t0_ns + self._flight.k * self._Ts_ns)

    def outgoing(self) -> list[Datagram]:
        """Take away the datagrams to send."""
        out, self._out = self._out, []
        return out

    def records(self) -> list[Record]:
        """Take away the records."""
        records, self._records = self._records, []
        return records

    # Commands

    def _start(self, now_ns: int) -> None:
        """Begin the clockwork at the next instant of the grid."""
        Ts_ns = self._Ts_ns
        self._flight = _Flight(
            t0_ns=-(-now_ns // Ts_ns) * Ts_ns,
            k=0,
            position=np.array(self.model.trim.u),
            latch=_Latch(u=self.travel.neutral),
        )
        self._event("clockwork", "first heartbeat: the clockwork starts", now_ns)

    def _take(self, stamp_us: int, wraps: bool, u: float | None, now_ns: int) -> None:
        """Put a command before the latch, if it is one."""
        flight = self._flight
        if flight is None:
            self.refusals[Refusal.NOT_FLYING] += 1
            return
        if u is None:
            self.refusals[Refusal.RANGE] += 1
            return
        if wraps:
            stamp_us = unwrap(stamp_us, now_ns // NS_PER_US, 1 << 32)
        j = round((stamp_us * NS_PER_US - flight.t0_ns) / self._Ts_ns)
        if not 0 <= j < flight.k:
            self.refusals[Refusal.STAMP] += 1
        elif len(flight.pending) >= MAX_COMMANDS:
            self.refusals[Refusal.OVERFLOW] += 1
        else:
            flight.pending.append(_Command(now_ns, j, u))

    def _update_latch(self, flight: _Flight, t_ns: int, now_ns: int) -> None:
        """Latch the command for [k, k+1) out of those that came before or at the sample."""
        latch = flight.latch
        came = [c for c in flight.pending if c.arrived_ns <= t_ns]
        if came:
            flight.pending = [c for c in flight.pending if c.arrived_ns > t_ns]
            # of equal stamps the last: a command may be repeated, or replaced by neutral, for the same sample
            chosen = came[-1] if self.config.latch == "last" else max(reversed(came), key=lambda c: c.j)
            if self.config.latch == "last" or latch.j is None or chosen.j >= latch.j:
                latch.j, latch.u, latch.since_k = chosen.j, chosen.u, flight.k
        timeout = self.config.servo_timeout
        timed_out = latch.j is not None and timeout is not None and flight.k - latch.since_k >= timeout
        if timed_out != latch.timed_out:
            text = f"no command for {timeout} samples: elevator to neutral" if timed_out else "commands are back"
            self._event("servo_timeout", text, now_ns, {"active": timed_out})
        latch.timed_out = timed_out

    # Samples

    def _sample(self, flight: _Flight, t_ns: int, now_ns: int) -> None:
        """Latch, sense and send, integrate: one sample."""
        self._update_latch(flight, t_ns, now_ns)
        latch, k = flight.latch, flight.k
        target = self.travel.neutral if latch.timed_out else latch.u
        flight.position = self._elevator.move(k, flight.position, np.array([target]))
        w = self._gust.w(k) if self._gust is not None else self._still
        delta = self.config.delta.delta(k) if self.config.delta is not None else 0.0
        d = None if latch.j is None else k - latch.j
        x, pose = self.airframe.x, self.airframe.pose
        body = {
            "k": k,
            "t_ns": t_ns,
            "late_ns": now_ns - t_ns,
            "x": x.tolist(),
            "u": flight.position.tolist(),
            "j": latch.j,
            "d": d,
            "w": w.tolist(),
            "delta": delta,
            "timeout": latch.timed_out,
        }
        if self._tells_air:
            body["air"] = {name: getattr(pose, name) for name in _AIR}
        self._records.append(Record("plant/truth", now_ns, body))
        self._sense(flight, x, pose, t_ns, d)
        if not flight.crashed and (reason := self.airframe.advance(flight.position, w, delta)) is not None:
            flight.crashed = True
            self._event("diverged", f"{reason} at sample {k + 1}", now_ns)
        flight.k += 1

    def _sense(self, flight: _Flight, x: NDArray[np.float64], pose: Pose, t_ns: int, d: int | None) -> None:
        """Send the sample's messages: its number while that is news, the delay, the state."""
        ms = t_ns // NS_PER_MS
        per_second = max(1, round(1.0 / self.model.Ts))
        silent = d is None or flight.k - flight.latch.since_k >= SILENCE
        if silent or flight.k % per_second == 0:
            self._send(NamedValueInt(ms, "SAMPLE_K", flight.k))
        if d is not None:
            self._send(NamedValueInt(ms, "DELAY_K", d))
        attitude = {"roll": pose.roll_rad, "pitch": pose.pitch_rad, "yaw": pose.yaw_rad}
        attitude |= {"rollspeed": pose.p_rad_s, "pitchspeed": pose.q_rad_s, "yawspeed": pose.r_rad_s}
        air = {"AOA": math.degrees(pose.alpha_rad), "SSA": math.degrees(pose.beta_rad)}
        sensed = self._faulty_sensors.sense(flight.k, x).tolist()
        for sensor, value in zip(self._sensors, sensed, strict=True):  # the states of the model may be sensed wrong
            fields = attitude if sensor.message is Attitude else air
            fields[sensor.field] = value * sensor.to_field
        self._send(Attitude(time_boot_ms=ms, **attitude))
        if self._air_data:
            self._send(AoaSsa(t_ns // NS_PER_US, **air))
        self._send(_hud(pose))  # the air data system is another sensor, without faults

    def _send(self, message: Message) -> None:
        self._out.append((PORT, self.wire.encode(message)))

    def _record_counters(self, now_ns: int) -> None:
        rejects = {kind.value: n for kind, n in self.wire.rejects.items()}
        refusals = {kind.value: n for kind, n in self.refusals.items()}
        self._event("counters", "plant counters", now_ns, {"rejects": rejects, "refusals": refusals})

    def _event(self, kind: str, text: str, now_ns: int, data: dict[str, object] | None = None) -> None:
        body = {"kind": kind, "node": "plant", "text": text, "data": data or {}}
        self._records.append(Record("events", now_ns, body))


_AIR = ("airspeed_m_s", "altitude_m", "climb_m_s", "roll_rad", "beta_rad", "throttle")
"""What else of an aircraft of more than the model's states is recorded."""


def _hud(pose: Pose) -> VfrHud:
    """Return VFR_HUD of a pose."""
    heading = round(math.degrees(pose.yaw_rad)) % 360
    throttle = round(100.0 * pose.throttle)
    return VfrHud(pose.airspeed_m_s, pose.groundspeed_m_s, heading, throttle, pose.altitude_m, pose.climb_m_s)
