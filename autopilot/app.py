"""The autopilot as a Node: wiring of clock, samples, delay, reference, law and failsafe; no rule of its own.

One complete sample of the plant makes one command. Start-up: TIMESYNC runs until the delay can be
forecast, and only then the first heartbeat goes to the plant, whose clockwork starts with it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from autopilot.clocksync import ClockSync
from autopilot.control import ChosenSets, SetChanges, choose_set, law_of
from autopilot.delay import UNKNOWN, DelayEstimate, DelayEstimator
from autopilot.failsafe import Event, FailsafeState, Limits, Mode, step
from autopilot.link.clock import NS_PER_MS, NS_PER_S, NS_PER_US, following
from autopilot.link.node import Datagram, Record
from autopilot.link.wire import (
    AUTOPILOT,
    PLANT,
    AoaSsa,
    Attitude,
    HilActuatorControls,
    Message,
    NamedValueInt,
    ServoOutputRaw,
    Severity,
    Timesync,
    VfrHud,
    Wire,
    autopilot_heartbeat,
)
from autopilot.reference import Profile, ReferenceModel, match_reference
from autopilot.state import JUMP_BACK_NS, Drop, Sample, SampleAssembler
from autopilot.vehicle import Vehicle, banner
from gains.model import GainLaw, sets_of
from gains.verify import verified

__all__ = ["AutopilotConfig", "AutopilotNode"]

PLANT_PORT = "plant"
HEARTBEAT_NS = NS_PER_S
TIMESYNC_START_NS = 50 * NS_PER_MS
TIMESYNC_NS = 100 * NS_PER_MS
SYNC_WAIT_NS = 2 * NS_PER_S
"""A plant that answers no TIMESYNC gets its heartbeat after this time all the same."""
COUNTERS_NS = NS_PER_S
MAX_AHEAD = 200
"""Samples that the reference is looked ahead at the most, whatever delay a peer makes us believe in."""


@dataclass(frozen=True, slots=True)
class AutopilotConfig:
    """What one autopilot flies, and how.

    Attributes
    ----------
    gains : Gains or Schedule
        K1 and K2 with their windows, and the model.
    profile : Profile
        The programmed reference.
    actuator : "pwm" or "float"
        SERVO_OUTPUT_RAW or HIL_ACTUATOR_CONTROLS to the plant.
    failsafe : "on" or "monitor"
        "monitor" reports every transition, and lets the law fly all the same.
    hold_ns : int
        How long the last command is held before neutral.
    ground_stations : int
        Number of ports gcs0, gcs1, ...
    """

    gains: GainLaw
    profile: Profile = field(default_factory=Profile)
    actuator: Literal["pwm", "float"] = "pwm"
    failsafe: Literal["on", "monitor"] = "on"
    hold_ns: int = NS_PER_S // 2
    ground_stations: int = 1


@dataclass(frozen=True, slots=True, eq=False)
class _Command:
    """A command as it was sent: what is told of it can wait until it is on its way."""

    at_ns: int
    sample: Sample
    forecast: DelayEstimate
    xr: tuple[float, ...]
    u: float
    saturated: bool
    mode: Mode
    gain_set: int


class AutopilotNode:
    """Node with the ports ``plant`` and ``gcs0``, ``gcs1``, ...

    Raises
    ------
    InputError
        When the model cannot be flown over MAVLink (sensors, actuator), or a certificate is malformed.
    """

    def __init__(self, config: AutopilotConfig) -> None:
        self.config = config
        self.model = config.gains.model
        self.proof = verified(config.gains)
        self.wire = Wire(AUTOPILOT, PLANT)
        self.clock = ClockSync()
        self.delay = DelayEstimator(self.model.Ts_ns)
        self.samples = SampleAssembler(self.model)
        self.sets = sets_of(config.gains)
        self.windows = [(gains.d_min, gains.d_max) for gains in self.sets]
        self.laws = [law_of(gains) for gains in self.sets]
        self.gain_set = 0
        self.gain_set_changes = SetChanges()
        self.chosen = ChosenSets(self.windows)
        self.travel = self.laws[0].travel
        self.reference = self._new_reference()
        self.limits = Limits(config.hold_ns)
        # d_max samples, and a little for clocks that differ
        self._stale_ns = config.gains.d_max * self.model.Ts_ns + self.model.Ts_ns // 4
        self.failsafe = FailsafeState()
        self.epoch = 0
        self.vehicle = Vehicle(
            tuple(f"gcs{i}" for i in range(config.ground_stations)), banner(config.gains, self.proof)
        )
        self._u = self.travel.neutral
        self._last: Sample | None = None
        self._fresh_ns: int | None = None
        self._first_j: int | None = None
        self._steps_seen = 0
        self._started_ns: int | None = None
        self._next_heartbeat_ns: int | None = None
        self._next_timesync_ns: int | None = None
        self._next_repeat_ns: int | None = None
        self._next_counters_ns: int | None = None
        self._untold: list[_Command] = []
        self._out: list[Datagram] = []
        self._records: list[Record] = []

    # Node

    def receive(self, port: str, datagram: bytes, now_ns: int) -> None:
        """Take one datagram from the plant or from a ground station."""
        if port != PLANT_PORT:
            self.vehicle.receive(port, datagram)
            return
        for message in self.wire.decode(datagram):
            match message:
                case Attitude() | AoaSsa():
                    self._measurement(message, now_ns)
                case Timesync():
                    self._timesync(message, now_ns)
                case NamedValueInt():
                    self._named_value(message, now_ns)
                case VfrHud():
                    self.vehicle.show(message, now_ns)
                case _:
                    pass

    def tick(self, now_ns: int) -> None:
        """Send what is due by time alone: TIMESYNC, heartbeats, failsafe's deadlines."""
        if self._started_ns is None:
            self._started_ns = self._next_timesync_ns = self._next_counters_ns = now_ns
            self._announce_gains(now_ns)
        untold, self._untold = self._untold, []
        for command in untold:
            self._tell(command)
        if untold and self.reference is not None:
            self.reference.ahead(self.config.gains.d_max + 1)  # computed while nothing waits for it
        self._tick_plant_link(now_ns)
        self._tick_failsafe(now_ns)
        mode = self.failsafe.mode
        self.vehicle.tick(now_ns, tracking=mode is Mode.TRACKING, degraded=mode in (Mode.HOLD, Mode.NEUTRAL))
        assert self._next_counters_ns is not None
        if now_ns >= self._next_counters_ns:
            self._next_counters_ns = following(self._next_counters_ns, COUNTERS_NS, now_ns)
            self._record_counters(now_ns)

    def next_deadline_ns(self) -> int | None:
        """Return when ``tick`` is wanted: at once (0) for the first time, and to tell of a command just sent."""
        if self._started_ns is None or self._untold:
            return 0
        earliest_ns = self._next_timesync_ns
        assert earliest_ns is not None
        for due_ns in (
            self._next_heartbeat_ns,
            self._next_counters_ns,
            self._failsafe_deadline_ns(),
            self.vehicle.next_deadline_ns(),
        ):
            if due_ns is not None and due_ns < earliest_ns:
                earliest_ns = due_ns
        return earliest_ns

    def outgoing(self) -> list[Datagram]:
        """Take away the datagrams to send, the plant's first."""
        out, self._out = self._out, []
        return out + self.vehicle.outgoing()

    def records(self) -> list[Record]:
        """Take away the records."""
        records, self._records = self._records, []
        return records

    # The plant's messages

    def _measurement(self, message: Attitude | AoaSsa, now_ns: int) -> None:
        if type(message) not in self.samples.needed:
            self.vehicle.show(message, now_ns)
            return
        peer_ns = self.clock.peer_at_most_ns(now_ns)
        sample = self.samples.add(message, now_ns, peer_ns)
        if self.samples.jumped_back and self._plant_restarted():
            self._new_epoch(now_ns)
            sample = self.samples.add(message, now_ns, peer_ns)
        if sample is not None:
            self._command(sample, now_ns)

    def _timesync(self, message: Timesync, now_ns: int) -> None:
        if message.tc1 == 0:
            self._send(Timesync(max(1, now_ns), message.ts1))  # a reply of 0 would be a request
            return
        steps = self.clock.steps
        if self.clock.answer(message.tc1, message.ts1, now_ns) is None:
            return
        if self.clock.steps > steps:
            self.delay.forget()
            self.samples.forget_number()
            self._event("clock", f"plant clock stepped by {self.clock.last_step_ns / NS_PER_S:+.3f} s", now_ns)
        self.delay.transit(message.tc1, message.ts1, now_ns)

    def _named_value(self, message: NamedValueInt, now_ns: int) -> None:
        if message.name == "SAMPLE_K":
            stepped = self.clock.steps > self._steps_seen
            if stepped and self._last is not None and message.value <= self._last.j:
                self._new_epoch(now_ns)
            sample = self.samples.number(message.value, message.time_boot_ms, self.clock.peer_at_most_ns(now_ns))
            if sample is not None:
                self._command(sample, now_ns)
        elif message.name == "DELAY_K":
            self.vehicle.show(message, now_ns)
            j = self.samples.command_of(message.time_boot_ms, message.value)
            if j is None or self._first_j is None or j < self._first_j:
                return  # the command of an autopilot before this one, or of another epoch
            if not self.config.gains.d_min <= message.value <= self.config.gains.d_max:
                self._failsafe_step(Event.OUTSIDE, f"delay {message.value} reported", now_ns)
            elif not self.chosen.covers(j, message.value):
                self._failsafe_step(Event.OUTSIDE, f"delay {message.value} reported of another gain set", now_ns)

    def _plant_restarted(self) -> bool:
        """Whether the clock has stepped back since the newest sample: with stamps that jumped back, a restart."""
        return self.clock.steps > self._steps_seen and self.clock.last_step_ns < -JUMP_BACK_NS // 2

    def _new_epoch(self, now_ns: int) -> None:
        self.epoch += 1
        self._steps_seen = self.clock.steps
        self.samples.restart()
        self.reference = self._new_reference()
        self.chosen = ChosenSets(self.windows)
        self._last = self._fresh_ns = self._first_j = None
        self._u = self.travel.neutral
        self._event("epoch", f"plant restarted, epoch {self.epoch}", now_ns)
        self._failsafe_step(Event.RESTARTED, "plant restarted", now_ns)

    # One command per sample

    def _command(self, sample: Sample, now_ns: int) -> None:
        """Compute and send the command of one sample."""
        if self._last is not None and sample.j <= self._last.j:
            self.samples.drops[Drop.LATE] += 1
            return
        self._steps_seen = self.clock.steps
        gains = self.config.gains
        forecast = self.delay.forecast(sample.t_ns, now_ns)
        inside = forecast.d is not None and gains.d_min <= forecast.d <= gains.d_max
        was = self.failsafe.mode
        if self._fresh_ns is not None and now_ns - self._fresh_ns > self._stale_ns:
            self._failsafe_step(Event.STALE, "a gap before this sample", now_ns)
        self._fresh_ns, self._last = now_ns, sample
        if self._first_j is None:
            self._first_j = sample.j
        reason = "delay unknown" if forecast.d is None else f"delay {forecast.d}"
        self._failsafe_step(Event.GOOD if inside else Event.OUTSIDE, reason, now_ns)
        self.gain_set = choose_set(self.windows, self.gain_set, forecast.d)
        self.chosen.note(sample.j, self.gain_set)
        ahead = min(forecast.d, MAX_AHEAD) if forecast.d is not None else gains.d_min
        if self.reference is not None:
            self.reference.advance(sample.j)
            if self.failsafe.mode is Mode.TRACKING and was in (Mode.HOLD, Mode.NEUTRAL):
                self._match_reference(sample, ahead)
        xr = self.reference.ahead(ahead) if self.reference is not None else ()
        saturated = False
        if self.failsafe.mode is Mode.TRACKING or self.config.failsafe == "monitor":
            self._u, saturated = self.laws[self.gain_set].command(sample.x, xr)
        elif self.failsafe.mode is not Mode.HOLD:
            self._u = self.travel.neutral
        self._next_repeat_ns = now_ns + self.model.Ts_ns
        self._send_command(sample)
        self._untold.append(
            _Command(now_ns, sample, forecast, xr, self._u, saturated, self.failsafe.mode, self.gain_set)
        )

    def _match_reference(self, sample: Sample, ahead: int) -> None:
        """Let the reference go on from where the aircraft is: re-entry without a jump of the elevator."""
        gains = self.sets[self.gain_set]
        if self.reference is None or gains.K2 is None or self.config.failsafe == "monitor":
            return
        dx = np.array(sample.x) - self.model.trim.x
        du, step_ahead = self._u - self.travel.neutral, self.reference.step_ahead(ahead)
        self.reference.set(match_reference(self.model, gains.K1, gains.K2, dx, du, step_ahead))

    def _send_command(self, sample: Sample) -> None:
        stamp_us = sample.t_ns // NS_PER_US
        if self.config.actuator == "float":
            self._send(HilActuatorControls(stamp_us, self.travel.to_control(self._u)))
        else:
            self._send(ServoOutputRaw(stamp_us, self.travel.to_pwm(self._u)))

    def _tell(self, command: _Command) -> None:
        """Show a command to the ground stations, and record it."""
        for part in command.sample.parts:
            self.vehicle.show(part, command.at_ns)
        self.vehicle.show(ServoOutputRaw(0, self.travel.to_pwm(command.u)), command.at_ns)
        self._record_command(command)
        if command.mode is Mode.TRACKING:
            self._tell_gain_set(command)

    def _tell_gain_set(self, command: _Command) -> None:
        """Say which set of gains flies now when it has changed; not more often than people can follow."""
        changes = self.gain_set_changes.flown(command.gain_set, command.at_ns)
        if not changes:
            return
        d_min, d_max = self.windows[command.gain_set]
        more = f", {changes} changes" if changes > 1 else ""
        text = f"gain set {command.gain_set}: delay {d_min} to {d_max}{more}"
        self.vehicle.say(Severity.INFO, text)
        data = {"gain_set": command.gain_set, "d": command.forecast.d, "changes": changes}
        self._event("gain_set", text, command.at_ns, data)

    def _new_reference(self) -> ReferenceModel | None:
        if self.model.reference is None:
            return None
        return ReferenceModel(self.model.reference, self.config.profile)

    # Time

    def _tick_plant_link(self, now_ns: int) -> None:
        """Send TIMESYNC and, once the delay can be forecast, the heartbeat that starts the plant."""
        assert self._started_ns is not None
        assert self._next_timesync_ns is not None
        if self._next_heartbeat_ns is None:
            ready = self.delay.forecast(0, now_ns) is not UNKNOWN
            if ready or now_ns - self._started_ns >= SYNC_WAIT_NS:
                self._next_heartbeat_ns = now_ns
        if now_ns >= self._next_timesync_ns:
            starting = self._next_heartbeat_ns is None
            self._next_timesync_ns = now_ns + (TIMESYNC_START_NS if starting else TIMESYNC_NS)
            self._send(Timesync(0, self.clock.request(now_ns)))
        if self._next_heartbeat_ns is not None and now_ns >= self._next_heartbeat_ns:
            self._next_heartbeat_ns = following(self._next_heartbeat_ns, HEARTBEAT_NS, now_ns)
            tracking = self.failsafe.mode is Mode.TRACKING
            self._send(autopilot_heartbeat(tracking=tracking, degraded=False))

    def _tick_failsafe(self, now_ns: int) -> None:
        """Raise STALE and EXPIRED when their time has come; repeat neutral while no sample comes."""
        due_ns = self._failsafe_deadline_ns()
        if due_ns is None or now_ns < due_ns:
            return
        match self.failsafe.mode:
            case Mode.TRACKING:
                self._failsafe_step(Event.STALE, f"no state for {self.config.gains.d_max} samples", now_ns)
            case Mode.HOLD:
                self._failsafe_step(Event.EXPIRED, "no recovery", now_ns)
            case _:
                pass
        if self.failsafe.mode is Mode.NEUTRAL and self._last is not None and self.config.failsafe == "on":
            self._u = self.travel.neutral
            self._next_repeat_ns = now_ns + self.model.Ts_ns
            self._send_command(self._last)

    def _failsafe_deadline_ns(self) -> int | None:
        """Return when the present mode ends, or repeats its command, if no sample comes."""
        match self.failsafe.mode:
            case Mode.TRACKING:
                assert self._fresh_ns is not None
                return self._fresh_ns + self._stale_ns
            case Mode.HOLD:
                return self.failsafe.since_ns + self.limits.hold_ns
            case Mode.NEUTRAL if self.config.failsafe == "on":
                return self._next_repeat_ns
            case _:
                return None

    def _failsafe_step(self, event: Event, reason: str, now_ns: int) -> None:
        """Take one event; every change of mode is a STATUSTEXT and a record."""
        before = self.failsafe.mode
        self.failsafe = step(self.failsafe, event, now_ns, self.limits)
        after = self.failsafe.mode
        if after is before:
            return
        worse = after in (Mode.HOLD, Mode.NEUTRAL)
        text = f"{before} to {after}: {reason}"
        self.vehicle.say(Severity.WARNING if worse else Severity.NOTICE, text)
        data = {"from": before, "to": after, "event": event, "monitor": self.config.failsafe == "monitor"}
        self._event("failsafe", text, now_ns, data)

    # Output

    def _send(self, message: Message) -> None:
        self._out.append((PLANT_PORT, self.wire.encode(message)))

    def _announce_gains(self, now_ns: int) -> None:
        gains, proof = self.config.gains, self.proof
        data = {"gains": gains.name, "d_min": gains.d_min, "d_max": gains.d_max, "windows": self.windows}
        self._event(
            "gains", self.vehicle.banner[0].text, now_ns, data | {"verified": proof.passed, "reason": proof.reason}
        )

    def _event(self, kind: str, text: str, now_ns: int, data: Mapping[str, object] | None = None) -> None:
        body = {"kind": kind, "node": "autopilot", "text": text, "data": data or {}}
        self._records.append(Record("events", now_ns, body))

    def _record_command(self, command: _Command) -> None:
        sample, forecast, xr = command.sample, command.forecast, command.xr
        body = {
            "j": sample.j,
            "sample_ns": sample.t_ns,
            "epoch": self.epoch,
            "x": sample.x,
            "xr": xr or None,
            "r": [self.config.profile.r(sample.j)] if xr else None,
            "u": [command.u],
            "saturated": command.saturated,
            "d": forecast.d,
            "d_low": forecast.low,
            "d_high": forecast.high,
            "status": forecast.status,
            "mode": command.mode,
            "gain_set": command.gain_set,
        }
        self._records.append(Record("autopilot/command", command.at_ns, body))

    def _record_counters(self, now_ns: int) -> None:
        clock = self.clock.estimate(now_ns)
        data = {
            "rejects": {kind.value: n for kind, n in self.wire.rejects.items()},
            "drops": {kind.value: n for kind, n in self.samples.drops.items()},
            "timesync_unmatched": self.clock.unmatched,
            "ground": {port: {k.value: n for k, n in w.rejects.items()} for port, w in self.vehicle.wires.items()},
            "telemetry_refused": self.vehicle.refused,
            "gain_set_changes": self.gain_set_changes.total,
            "clock": clock.status,
            "clock_bound_ns": clock.bound_ns,
        }
        self._event("counters", "autopilot counters", now_ns, data)
