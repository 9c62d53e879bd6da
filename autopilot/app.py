"""The autopilot as a Node: wiring of clock, samples, delay, pilot and telemetry; no rule of its own.

One complete sample of the plant makes one command. Start-up: TIMESYNC runs until the delay can be
forecast, and only then the first heartbeat goes to the plant, whose clockwork starts with it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from autopilot.alpha import AlphaSource
from autopilot.clocksync import ClockSync
from autopilot.commander import ATTITUDE_IGNORE, Commander
from autopilot.config import AutopilotConfig
from autopilot.control import SetChanges
from autopilot.delay import DelayEstimator
from autopilot.failsafe import FLOWN_BY_FIRST_LAW, FLOWN_BY_LAW, Event, FailsafeState, Mode
from autopilot.ground.settings import Settings
from autopilot.ground.vehicle import Vehicle, banner
from autopilot.link.clock import NS_PER_MS, NS_PER_S, NS_PER_US, following
from autopilot.link.groundmessages import AttitudeTarget
from autopilot.link.node import Datagram, Record
from autopilot.link.sensors import pitch_index
from autopilot.link.wire import (
    AUTOPILOT,
    PLANT,
    U32,
    AoaSsa,
    Attitude,
    HilActuatorControls,
    Message,
    NamedValueInt,
    Reject,
    ServoOutputRaw,
    Severity,
    Timesync,
    VfrHud,
    Wire,
    autopilot_heartbeat,
)
from autopilot.monitors import Halves
from autopilot.pilot import Command, Notice, Pilot
from autopilot.state import JUMP_BACK_NS, Drop, Sample, SampleAssembler
from autopilot.telemetry import DelayTelemetry
from gains.model import GainLaw
from gains.verify import Verification, verified

__all__ = ["AutopilotNode"]

PLANT_PORT = "plant"
HEARTBEAT_NS = NS_PER_S
SILENT_HEARTBEAT_NS = NS_PER_S // 5
"""While no samples come: a plant that starts again waits for a heartbeat."""
TIMESYNC_START_NS = 50 * NS_PER_MS
TIMESYNC_NS = 100 * NS_PER_MS
SYNC_WAIT_NS = 2 * NS_PER_S
"""A plant that answers no TIMESYNC gets its heartbeat after this time all the same."""
COUNTERS_NS = NS_PER_S
RATES_AND_THRUST_IGNORE = 1 | 2 | 4 | 64
"""ATTITUDE_TARGET_TYPEMASK: body rates and thrust are not meant."""
NOT_SIGNED = (Reject.UNSIGNED, Reject.BAD_SIGNATURE)
HALF_NS = NS_PER_S
"""Half of the state may be missing for so long before that is said."""


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
        self.proof, self.conservative_proof = _proofs(config.gains)
        self._seals = tuple(config.seals.values())
        self.wire = Wire(AUTOPILOT, PLANT, seal=config.seals.get(PLANT_PORT))
        self.clock = ClockSync()
        self.delay = DelayEstimator(self.model.Ts_ns)
        self.samples = SampleAssembler(self.model, config.alpha)
        self.halves = Halves(self.samples.needed)
        self._pitch_index = pitch_index(self.model)
        self._trim_pitch = 0.0 if self._pitch_index is None else float(self.model.trim.x[self._pitch_index])
        self.commander = Commander(self._unready, self._commanded, self._trim_pitch, self_arm=not config.wait_arm)
        self.pilot = Pilot(config, self.commander, self._notice, self._missing_half)
        self.gain_set_changes = SetChanges()
        self.telemetry = DelayTelemetry()
        self.epoch = 0
        self._out: list[Datagram] = []
        self._records: list[Record] = []
        ports = tuple(f"gcs{i}" for i in range(config.ground_stations))
        self._started_ns: int | None = None
        self.settings = Settings(
            (config.gains, *config.alternatives),
            verified,
            self.pilot,
            self.commander,
            ports,
            self._gains_changed,
            config.parameters,
        )
        self.vehicle = Vehicle(
            ports,
            banner(self.pilot.gains, self.proof, self.conservative_proof),
            self.commander,
            self.settings.parameters,
            self.settings,
            config.home,
            {AttitudeTarget: self._attitude_target},
            config.seals,
        )
        self._steps_seen = 0
        self._alpha_told: AlphaSource | None = None
        self._half_told: str | None = None
        self._told: Command | None = None
        self._unsigned_told: set[str] = set()
        self._next_heartbeat_ns: int | None = None
        self._next_timesync_ns: int | None = None
        self._next_counters_ns: int | None = None
        self._periodic_ns = 0
        self._untold: list[Command] = []

    @property
    def windows(self) -> list[tuple[int, int]]:
        """The window of delays of each set of gains."""
        return self.pilot.windows

    @property
    def failsafe(self) -> FailsafeState:
        """Where failsafe stands."""
        return self.pilot.failsafe

    # Node

    def receive(self, port: str, datagram: bytes, now_ns: int) -> None:
        """Take one datagram from the plant or from a ground station."""
        for seal in self._seals:
            seal.tick(now_ns)
        if port != PLANT_PORT:
            if self.vehicle.receive(port, datagram, now_ns):
                self.pilot.heard_ground(now_ns)
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
                    self.samples.air(message, now_ns)
                    self.vehicle.show(message, now_ns)
                case _:
                    pass

    def tick(self, now_ns: int) -> None:
        """Send what is due by time alone: TIMESYNC, heartbeats, failsafe's deadlines, telemetry."""
        for seal in self._seals:
            seal.tick(now_ns)
        if self._started_ns is None:
            self._started_ns = self._next_timesync_ns = self._next_counters_ns = now_ns
            self._announce_gains(now_ns)
        untold, self._untold = self._untold, []
        for command in untold:
            self.pilot.sent(command)
            self._tell(command)
            self._told = command
        self._renew_delay(now_ns)
        self._tick_plant_link(now_ns)
        last = self.pilot.last
        if self.pilot.tick(now_ns) and last is not None:
            self.delay.repeated(last.j)
            self._send_command(last)
        self._tick_telemetry(now_ns)
        self.commander.tick(now_ns)
        self.vehicle.tick(now_ns, degraded=self._degraded)
        assert self._next_counters_ns is not None
        if now_ns >= self._next_counters_ns:
            self._next_counters_ns = following(self._next_counters_ns, COUNTERS_NS, now_ns)
            self._record_counters(now_ns)
            self._tell_missing_half(now_ns)
            self._tell_unsigned()
        self._periodic_ns = self._next_periodic_ns()

    def next_deadline_ns(self) -> int | None:
        """Return when ``tick`` is wanted: at once (0) for the first time, and to tell of a command just sent."""
        if self._started_ns is None or self._untold:
            return 0
        earliest_ns = self._periodic_ns
        pilot_ns, commander_ns = self.pilot.next_deadline_ns(), self.commander.next_deadline_ns()
        for due_ns in (pilot_ns, commander_ns, self.vehicle.next_deadline_ns()):
            if due_ns is not None and due_ns < earliest_ns:
                earliest_ns = due_ns
        return earliest_ns

    def _next_periodic_ns(self) -> int:
        """Return when something periodic is due; only a tick changes that."""
        due_ns = (
            self._next_timesync_ns,
            self._next_heartbeat_ns,
            self._next_counters_ns,
            self.telemetry.next_deadline_ns(),
        )
        return min(each for each in due_ns if each is not None)

    def outgoing(self) -> list[Datagram]:
        """Take away the datagrams to send, the plant's first."""
        out, self._out = self._out, []
        out += self.vehicle.outgoing()
        return out

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
        restarted = self.samples.jumped_back and self._plant_restarted()
        if why := "plant restarted" if restarted else self.samples.lost:
            self._new_epoch(why, now_ns)
            sample = self.samples.add(message, now_ns, peer_ns)
        if sample is not None:
            self._command(sample, peer_ns is not None, now_ns)
        self.halves.came(type(message), now_ns)

    def _missing_half(self, since_ns: int) -> str | None:
        """Return which half of the state has not come since a time, unless it need not come."""
        return None if self.samples.alpha is AlphaSource.VFR_HUD else self.halves.missing(since_ns)

    def _tell_missing_half(self, now_ns: int) -> None:
        """Say once that half of the state has been missing for long, in whatever mode."""
        missing = self._missing_half(now_ns - HALF_NS)
        if missing is not None and missing != self._half_told:
            self.vehicle.say(Severity.WARNING, missing)
            self._event("half", missing, now_ns)
        self._half_told = missing

    def _tell_unsigned(self) -> None:
        """Say once of each port that frames without a valid signature come: most often a key that is missing."""
        for port, wire in {PLANT_PORT: self.wire, **self.vehicle.wires}.items():
            if port not in self._unsigned_told and any(wire.rejects[kind] for kind in NOT_SIGNED):
                self._unsigned_told.add(port)
                self.vehicle.say(Severity.WARNING, f"{port}: frames without a valid signature")

    def _timesync(self, message: Timesync, now_ns: int) -> None:
        if message.tc1 == 0:
            self._send(Timesync(max(1, now_ns), message.ts1))  # a reply of 0 would be a request
            return
        steps, contradictions = self.clock.steps, self.clock.contradictions
        round_trip_ns = self.clock.answer(message.tc1, message.ts1, now_ns)
        if round_trip_ns is None:
            return
        if self.clock.steps > steps:
            self.delay.forget()
            self.samples.forget_number()
            self._event("clock", f"plant clock stepped by {self.clock.last_step_ns / NS_PER_S:+.3f} s", now_ns)
        elif self.clock.contradictions > contradictions:
            return  # of another clock, or forged
        self.telemetry.note_round_trip(round_trip_ns)
        self.delay.transit(message.tc1, message.ts1, now_ns)

    def _named_value(self, message: NamedValueInt, now_ns: int) -> None:
        if message.name == "SAMPLE_K":
            peer_ns = self.clock.peer_at_most_ns(now_ns)
            sample = self.samples.number(message.value, message.time_boot_ms, peer_ns)
            if self.samples.lost:
                self._new_epoch(self.samples.lost, now_ns)
                sample = self.samples.number(message.value, message.time_boot_ms, peer_ns)
            if sample is not None:
                self._command(sample, peer_ns is not None, now_ns)
        elif message.name == "DELAY_K":
            self.vehicle.show(message, now_ns)
            j = self.samples.command_of(message.time_boot_ms, message.value)
            if j is not None and self.pilot.reported(j, message.value, now_ns):
                self.delay.report(j + message.value, j, now_ns)
                self.telemetry.note_report(message.value)

    def _plant_restarted(self) -> bool:
        """Whether the clock has stepped back since the newest sample: with stamps that jumped back, a restart."""
        return self.clock.steps > self._steps_seen and self.clock.last_step_ns < -JUMP_BACK_NS // 2

    def _new_epoch(self, why: str, now_ns: int) -> None:
        self.epoch += 1
        self._steps_seen = self.clock.steps
        self.samples.restart()
        self.delay.forget_commands()
        self.halves.forget()
        self.pilot.restart()
        self._event("epoch", f"{why}, epoch {self.epoch}", now_ns)
        if self.pilot.mode is Mode.STANDBY:  # else failsafe says so
            self.vehicle.say(Severity.WARNING, why)
        self.pilot.event(Event.RESTARTED, why, now_ns)

    # One command per sample

    def _command(self, sample: Sample, clock_known: bool, now_ns: int) -> None:
        """Compute and send the command of one sample."""
        last = self.pilot.last
        if last is not None and sample.j <= last.j:
            self.samples.drops[Drop.LATE] += 1
            return
        self._steps_seen = self.clock.steps
        forecast = self.delay.forecast(sample.t_ns, now_ns)
        command = self.pilot.fly(sample, forecast, clock_known, now_ns)
        self._send_command(sample)
        self.delay.sent(sample.j, sample.t_ns, now_ns, forecast)
        self._untold.append(command)

    def _send_command(self, sample: Sample) -> None:
        stamp_us, travel, u = sample.t_ns // NS_PER_US, self.pilot.travel, self.pilot.u
        if self.config.actuator == "float":
            self._send(HilActuatorControls(stamp_us, travel.to_control(u)))
        else:
            self._send(ServoOutputRaw(stamp_us, travel.to_pwm(u)))

    def _tell(self, command: Command) -> None:
        """Show a command to the ground stations, and record it."""
        for part in command.sample.parts:
            self.vehicle.show(part, command.at_ns)
        self.vehicle.show(ServoOutputRaw(0, self.pilot.travel.to_pwm(command.u)), command.at_ns)
        self.telemetry.note_forecast(command.forecast)
        self._record_command(command)
        if command.sample.alpha is not self._alpha_told:
            self._tell_alpha(command)
        if command.mode in FLOWN_BY_FIRST_LAW:
            self._tell_gain_set(command)

    def _tell_alpha(self, command: Command) -> None:
        """Say where the angle of attack comes from, at start and when that has changed."""
        self._alpha_told = source = command.sample.alpha
        if source is AlphaSource.NONE:
            return
        noisy, text = source is AlphaSource.VFR_HUD, self.samples.alpha_report()
        self.vehicle.say(Severity.WARNING if noisy else Severity.INFO, text)
        self._event("alpha", text, command.at_ns, {"alpha": source, "noisy": noisy, "j": command.sample.j})

    def _tell_gain_set(self, command: Command) -> None:
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

    # Time

    def _renew_delay(self, now_ns: int) -> None:
        """Describe the link anew when enough is new; here no command waits."""
        if self.delay.due and (line := self.clock.line(now_ns)) is not None:
            self.delay.renew(line)

    def _tick_plant_link(self, now_ns: int) -> None:
        """Send TIMESYNC and, once the delay can be forecast, the heartbeat that starts the plant."""
        assert self._started_ns is not None
        assert self._next_timesync_ns is not None
        waited_ns = now_ns - self._started_ns
        if self._next_heartbeat_ns is None and (waited_ns >= SYNC_WAIT_NS or self.delay.ready(now_ns)):
            self._next_heartbeat_ns = now_ns
        if now_ns >= self._next_timesync_ns:
            starting = self._next_heartbeat_ns is None
            self._next_timesync_ns = now_ns + (TIMESYNC_START_NS if starting else TIMESYNC_NS)
            self._send(Timesync(0, self.clock.request(now_ns)))
        if self._next_heartbeat_ns is not None and self.pilot.is_stale(now_ns):
            self._next_heartbeat_ns = min(self._next_heartbeat_ns, now_ns + SILENT_HEARTBEAT_NS)
        if self._next_heartbeat_ns is not None and now_ns >= self._next_heartbeat_ns:
            self._next_heartbeat_ns = following(self._next_heartbeat_ns, HEARTBEAT_NS, now_ns)
            mode = self.commander.mode
            beat = autopilot_heartbeat(armed=self.commander.armed, custom_mode=mode, flags=mode.flags, degraded=False)
            self._send(beat)

    def _tick_telemetry(self, now_ns: int) -> None:
        """Show and record the statistics of delay and clocks when they are due."""
        messages, records = self.telemetry.due(now_ns, self.clock, self.delay)
        for message in messages:
            self.vehicle.show(message, now_ns)
        self._records += records

    # Output

    def _send(self, message: Message) -> None:
        self._out.append((PLANT_PORT, self.wire.encode(message)))

    def _announce_gains(self, now_ns: int) -> None:
        gains, proof = self.pilot.gains, self.proof
        data = {"gains": gains.name, "d_min": gains.d_min, "d_max": gains.d_max, "windows": self.windows}
        data |= {"verified": proof.passed, "reason": proof.reason}
        wide, wide_proof = gains.conservative, self.conservative_proof
        if wide is not None and wide_proof is not None:
            window = {"d_min": wide.d_min, "d_max": wide.d_max}
            data["conservative"] = {"gains": wide.name, **window, "verified": wide_proof.passed}
        self._event("gains", self.vehicle.banner[0].text, now_ns, data)

    def _gains_changed(self, gains: GainLaw, now_ns: int) -> None:
        """Take note of other gains; say so when that is in flight."""
        self.proof, self.conservative_proof = _proofs(gains)
        self.gain_set_changes = SetChanges()
        if self._started_ns is None:
            return  # chosen by the parameters on disk; told at start
        self.vehicle.banner = banner(gains, self.proof, self.conservative_proof)
        for text in self.vehicle.banner:
            self.vehicle.say(text.severity, text.text)
        low, high = self.pilot.window
        self.vehicle.say(Severity.INFO, f"flown at delay {low}..{high} of {gains.d_min}..{gains.d_max}")
        self._announce_gains(now_ns)

    @property
    def _degraded(self) -> bool:
        """Whether failsafe has the elevator, or flies with less than is asked for; or a stick has no aircraft."""
        if self.commander.engaged:
            return self.pilot.mode not in (Mode.TRACKING, Mode.STANDBY)
        return self.pilot.silent

    def _unready(self, now_ns: int) -> list[str]:
        """Return what keeps the law from flying now."""
        return self.pilot.unready(now_ns)

    def _commanded(self, severity: int, text: str, now_ns: int) -> None:
        """Tell of what the ground has asked for, or has stopped to ask for."""
        self.vehicle.say(severity, text)
        data = {"armed": self.commander.armed, "flight_mode": self.commander.mode.name}
        self._event("commander", text, now_ns, data)

    def _attitude_target(self, now_ns: int) -> AttitudeTarget:
        """Return ATTITUDE_TARGET: the pitch reference that is flown now; no attitude while no law flies."""
        command, mask = self._told, RATES_AND_THRUST_IGNORE
        pitch = self._trim_pitch
        if command is not None and self.pilot.mode in FLOWN_BY_LAW and self._pitch_index is not None:
            pitch += command.r
        else:
            mask |= ATTITUDE_IGNORE
        q = (math.cos(pitch / 2), 0.0, math.sin(pitch / 2), 0.0)
        return AttitudeTarget(now_ns // NS_PER_MS & U32, mask, q, 0.0, 0.0, 0.0, 0.0)

    def _notice(self, notice: Notice) -> None:
        """Tell of a change of mode."""
        self.vehicle.say(notice.severity, notice.text)
        self._event("failsafe", notice.text, notice.at_ns, notice.data)

    def _event(self, kind: str, text: str, now_ns: int, data: Mapping[str, object] | None = None) -> None:
        body = {"kind": kind, "node": "autopilot", "text": text, "data": data or {}}
        self._records.append(Record("events", now_ns, body))

    def _record_command(self, command: Command) -> None:
        sample, forecast, xr = command.sample, command.forecast, command.xr
        body = {
            "j": sample.j,
            "sample_ns": sample.t_ns,
            "epoch": self.epoch,
            "x": sample.x,
            "xr": xr or None,
            "r": [command.r] if xr else None,
            "u": [command.u],
            "saturated": command.saturated,
            "d": forecast.d,
            "d_low": forecast.low,
            "d_high": forecast.high,
            "d_probability": forecast.probability,
            "status": forecast.status,
            "mode": command.mode,
            "flight_mode": command.flight_mode.name,
            "armed": command.armed,
            "gain_set": command.gain_set,
            "alpha": sample.alpha,
        }
        self._records.append(Record("autopilot/command", command.at_ns, body))

    def _record_counters(self, now_ns: int) -> None:
        clock = self.clock.estimate(now_ns)
        data = {
            "rejects": {kind.value: n for kind, n in self.wire.rejects.items()},
            "drops": {kind.value: n for kind, n in self.samples.drops.items()},
            "timesync_unmatched": self.clock.unmatched,
            "timesync_contradictions": self.clock.contradictions,
            "ground": {port: {k.value: n for k, n in w.rejects.items()} for port, w in self.vehicle.wires.items()},
            "telemetry_refused": self.vehicle.refused,
            "ground_elsewhere": self.vehicle.elsewhere,
            "setpoints_refused": self.commander.refused,
            "gain_set_changes": self.gain_set_changes.total,
            "clock": clock.status,
            "clock_bound_ns": clock.bound_ns,
        }
        self._event("counters", "autopilot counters", now_ns, data)


def _proofs(gains: GainLaw) -> tuple[Verification, Verification | None]:
    """Return the verification of a law, and of its conservative gains if there are some."""
    return verified(gains), None if gains.conservative is None else verified(gains.conservative)
