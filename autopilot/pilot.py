"""Who flies, and what leaves: from a sample and the forecast of its command's delay to the command.

Per sample: what the sample is worth to failsafe, which set of gains its forecast chooses, the reference at the
expected instant of application, and the input of the law in force, or the one held, or the stick's, or neutral.
Between samples: what follows from silence. The rules are elsewhere (``commander.py``, ``failsafe.py``,
``monitors.py``, ``control.py``, ``reference.py``); this is their order.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from autopilot.commander import Commander, FlightMode, Moving, Programmed, Steady, Target
from autopilot.config import AutopilotConfig
from autopilot.control import ChosenSets, Law, SetChooser, law_of
from autopilot.controllers import Controller, controller_of
from autopilot.delay import DelayEstimate
from autopilot.failsafe import FLOWN_BY_FIRST_LAW, FLOWN_BY_LAW, Event, FailsafeState, Limits, Mode, step
from autopilot.link.clock import NS_PER_S
from autopilot.link.sensors import pitch_index
from autopilot.link.servo import Travel, travel_of
from autopilot.link.wire import Severity
from autopilot.monitors import COMMAND_MEMORY, Plausibility, Saturation, Silence
from autopilot.profile import Shifted
from autopilot.reference import ReferenceModel, match_reference
from autopilot.state import Sample
from autopilot.streamed import Streamed
from gains.model import DynamicFeedback, GainLaw, Gains, Matrix, Model, sets_of

__all__ = ["Command", "Notice", "Pilot"]

MAX_AHEAD = 200
"""Samples beyond the windows that the reference is looked ahead, whatever delay a peer makes us believe in."""
CLOCK_UNKNOWN = "plant clock unknown"
REPORT_NS = NS_PER_S
"""A delay that was reported longer ago says nothing about now."""

_USABLE = (Event.GOOD, Event.WIDE)
"""The samples that some law may fly on."""
_TRIM = Steady()
_STILL = Moving(0.0)
_NO_LIMITS = (-sys.float_info.max, sys.float_info.max)
_UPRIGHT = (-math.pi / 2, math.pi / 2)
"""A reference that is a pitch never goes further from trim."""


class Command(NamedTuple):
    """A command as it is sent.

    Attributes
    ----------
    at_ns : int
        Own time.
    sample : Sample
        What it was computed from.
    forecast : DelayEstimate
        Of its delay.
    xr : tuple of float
        The reference state it carries; empty without a reference.
    u : float
        The input, absolute, within the travel.
    saturated : bool
        Whether the travel limited it.
    mode : Mode
        Who made it.
    gain_set : int
        Index of the schedule's set in force; the number of sets where the conservative gains fly.
    r : float
        The reference input of its sample, r(j); 0 without a reference.
    flight_mode : FlightMode
        What the ground has asked for.
    armed : bool
        Whether the elevator might leave neutral.
    """

    at_ns: int
    sample: Sample
    forecast: DelayEstimate
    xr: tuple[float, ...]
    u: float
    saturated: bool
    mode: Mode
    gain_set: int
    r: float
    flight_mode: FlightMode
    armed: bool


class Notice(NamedTuple):
    """A change of mode, to be told to people and to the recording."""

    at_ns: int
    severity: int
    text: str
    data: Mapping[str, object]


class Pilot:
    """The law, its conservative stand-in, and failsafe over both.

    Parameters
    ----------
    config : AutopilotConfig
        What flies.
    commander : Commander
        What the ground has asked for.
    tell : callable
        Takes a Notice of each change of mode.
    missing : callable
        Says which half of the state has not come since a time (:meth:`autopilot.monitors.Halves.missing`).

    Attributes
    ----------
    gains : Gains or Schedule
        The law.
    window : (int, int)
        Delays, samples, in which the law may fly; within the window of its gains.
    travel : Travel
        The elevator's travel, with its stops.
    max_pitch, max_rate : float or None
        Largest pitch reference from trim, rad, and its fastest change, rad per sample; None for no limit.

    Raises
    ------
    InputError
        When the model cannot be flown over MAVLink (sensors, actuator).
    """

    def __init__(
        self,
        config: AutopilotConfig,
        commander: Commander,
        tell: Callable[[Notice], None],
        missing: Callable[[int], str | None],
    ) -> None:
        self.config = config
        self.model = config.gains.model
        self.failsafe = FailsafeState()
        self.limits = Limits(config.hold_ns)
        self.ground = Silence(config.ground_timeout_ns)
        self.saturation = Saturation(config.saturation_ns)
        self.travel = travel_of(self.model)
        self.max_pitch: float | None = None
        self.max_rate: float | None = None
        self._commander = commander
        self._tell = tell
        self._missing = missing
        self._Ts_ns = self.model.Ts_ns
        self._sense = elevator_sense(self.model)
        self._limits = _NO_LIMITS if pitch_index(self.model) is None else _UPRIGHT
        longest = max(law.d_max for law in (config.gains, *config.alternatives))
        self._plausibility = Plausibility(self.model, max(COMMAND_MEMORY, longest))
        self._u = self.travel.neutral
        self.use(config.gains)
        self.restart()

    def use(self, gains: GainLaw) -> None:
        """Fly other gains, for the same model, from the next sample on; the window becomes theirs."""
        self.gains = gains
        self.sets = sets_of(gains)
        self.windows = [(each.d_min, each.d_max) for each in self.sets]
        self.window = gains.d_min, gains.d_max
        self.conservative: Gains | None = gains.conservative
        self.limits = replace(self.limits, conservative=self.conservative is not None)
        self.chooser = SetChooser(self.windows)
        self._chosen = ChosenSets(self.windows)
        self._law_changed = True
        self.set_travel(self.travel)

    def set_travel(self, travel: Travel) -> None:
        """Give the elevator other stops; what is held now keeps them, too."""
        self.travel = travel
        self._u = travel.clip(self._u)
        self._laws = [controller_of(each, travel) for each in self.sets]
        first = self._laws[0]  # a schedule's sets are laws
        self._stateful = None if isinstance(first, Law) else first
        self._align = self.config.align and not isinstance(self.sets[0].controller, DynamicFeedback)
        self._conservative_law = law_of(self.conservative, travel) if self.conservative is not None else None

    def restart(self) -> None:
        """Begin a new epoch of the plant: nothing measured yet, the elevator neutral, the reference at rest."""
        self._source = Streamed()
        self.reference = None if self.model.reference is None else ReferenceModel(self.model.reference, self._source)
        self._target: Target | None = None
        self._program: tuple[Programmed, int] | None = None
        self._ahead = 0
        self._idle = self._law_changed = self._silence_told = False
        self._worth_last: tuple[Event, str] | None = None
        self.chooser = SetChooser(self.windows)
        self._chosen = ChosenSets(self.windows)
        if self._stateful is not None:
            self._stateful.restart()
        self._plausibility.forget()
        self.saturation.told(saturated=False, now_ns=0)
        self._u, self._saturated = self.travel.neutral, False
        self._last: Sample | None = None
        self._first_j: int | None = None
        self._fresh_ns: int | None = None
        self._stale_ns: int | None = None
        """When the state is stale: its age d_max samples, and a little for clocks that differ."""
        self._next_repeat_ns: int | None = None
        self._reported: tuple[int, int] | None = None
        self._clock_known = False

    @property
    def mode(self) -> Mode:
        """Who has the elevator."""
        return self.failsafe.mode

    @property
    def last(self) -> Sample | None:
        """The newest sample of the epoch."""
        return self._last

    # One command per sample

    def fly(self, sample: Sample, forecast: DelayEstimate, clock_known: bool, now_ns: int) -> Command:
        """Return the command of a sample that is newer than the last.

        Parameters
        ----------
        sample : Sample
            The state.
        forecast : DelayEstimate
            Of the command that leaves now.
        clock_known : bool
            Whether the plant's clock is.
        now_ns : int
            Own time.
        """
        was = self.mode
        if self.is_stale(now_ns):
            self.event(Event.STALE, "a gap before this sample", now_ns)
        if self._clock_known and not clock_known:
            self.event(Event.CLOCK_LOST, "plant clock lost", now_ns)
        self._fresh_ns, self._last, self._clock_known = now_ns, sample, clock_known
        if self._first_j is None:
            self._first_j = sample.j
            self._idle = sample.j > self.window[1]  # the flight had begun before, with another hand or with nobody
        engaged = self._engage(*self._worth(sample, forecast, now_ns), now_ns)
        chosen = self.chooser.choose(forecast.d, forecast.low, forecast.high)
        law, gains, gain_set = self._in_force(chosen)
        flown = engaged and law is not None
        xr, r = self._look(sample, forecast, gains, was, flown=flown)
        if not engaged:
            self._u, self._saturated = self._stick_u(), False
        elif law is not None:
            self._u, self._saturated = law.command(sample.x, xr, sample.j, self._ahead)
        elif self.mode is not Mode.HOLD:
            self._u, self._saturated = self.travel.neutral, False
        # another hand had the elevator, or nobody, until a law really flies; but not before the flight began
        self._idle = not (engaged or self._commander.waiting) or (self._idle and self.mode is Mode.STANDBY)
        self._silence_told = False
        if self.mode in FLOWN_BY_FIRST_LAW:
            self._chosen.note(sample.j, gain_set)
        self._stale_ns = now_ns + self._patience * self._Ts_ns + self._Ts_ns // 4
        commander = self._commander
        return Command(
            now_ns,
            sample,
            forecast,
            xr,
            self._u,
            self._saturated,
            self.mode,
            gain_set,
            r,
            commander.mode,
            commander.armed,
        )

    def sent(self, command: Command) -> None:
        """Take note of a command that has left; what follows from it alone could wait until now."""
        self._plausibility.commanded(command.u)
        if self._stateful is not None:
            self._stateful.sent(command.sample.j, command.u)
        self._next_repeat_ns = command.at_ns + self._Ts_ns
        if event := self.saturation.told(command.saturated, command.at_ns):
            self.event(event, "elevator at its limit", command.at_ns)
        if self.reference is not None:  # what the next command will most likely look ahead to
            self.reference.ahead(self._ahead + 1)
            self._source.forget(self.reference.k)

    def _engage(self, event: Event, reason: str, now_ns: int) -> bool:
        """Let failsafe take what a sample is worth, where the law is to fly; return whether it is."""
        self._worth_last = event, reason
        if event in _USABLE or self.config.failsafe == "monitor":
            self._commander.usable_sample(now_ns)
        if self._commander.engaged:
            self.event(event, reason, now_ns)
            return True
        self._release(now_ns)
        return False

    def _release(self, now_ns: int) -> None:
        """Take the elevator from the law that has it, when the ground has said so."""
        if not self._commander.engaged and self.mode is not Mode.STANDBY:
            self.event(Event.RELEASED, self._commander.released_by, now_ns)

    def _stick_u(self) -> float:
        """Return where the stick wants the elevator: its centre is neutral, its back end the stop that pitches up."""
        stick, travel = self._sense * self._commander.stick, self.travel
        end = travel.high if stick > 0.0 else travel.low
        return travel.clip(travel.neutral + abs(stick) * (end - travel.neutral))

    def unready(self, now_ns: int) -> list[str]:
        """Return what keeps the law from flying now, in words; empty when nothing does."""
        if self._worth_last is None or self._stale_ns is None or now_ns > self._stale_ns:
            return ["no fresh state"]
        reasons = [] if self._clock_known else ["plant clock not locked"]
        event, reason = self._worth_last
        if event not in _USABLE and reason not in (CLOCK_UNKNOWN,):
            reasons.append(reason)
        return reasons

    def _worth(self, sample: Sample, forecast: DelayEstimate, now_ns: int) -> tuple[Event, str]:
        """Return what a sample is to failsafe, and why."""
        verdict = self._plausibility.judge(sample.j, sample.x)
        if verdict is not None:
            return verdict.event, verdict.reason
        if forecast.d is None:
            return Event.OUTSIDE, "delay unknown"
        wide = self.conservative
        if wide is None and self._clock_known and self._in_window(forecast.d):
            return Event.GOOD, f"delay {forecast.d}"  # as nearly always, right between a packet in and a packet out
        # before the narrower law is believed in again, the plant's own word counts as much as the forecast
        delays = [forecast.d]
        if wide is not None and self._reported is not None and now_ns - self._reported[1] <= REPORT_NS:
            delays.append(self._reported[0])
        inside = all(self._in_window(d) for d in delays)
        if inside and self._clock_known:
            return Event.GOOD, f"delay {forecast.d}"
        reason = CLOCK_UNKNOWN if inside else f"delay {max(delays)}"
        usable = wide is not None and all(_holds(wide, d) for d in delays)
        return Event.WIDE if usable else Event.OUTSIDE, reason

    def _in_force(self, gain_set: int) -> tuple[Controller | None, Gains, int]:
        """Return the law that computes the command, if any, with its gains and the number of its set."""
        if self.config.failsafe == "on":
            if self.mode is Mode.CONSERVATIVE and self.conservative is not None:
                return self._conservative_law, self.conservative, len(self.sets)
            if self.mode not in FLOWN_BY_LAW:
                return None, self.sets[gain_set], gain_set
        return self._laws[gain_set], self.sets[gain_set], gain_set

    # The reference

    def _look(
        self, sample: Sample, forecast: DelayEstimate, gains: Gains, was: Mode, *, flown: bool
    ) -> tuple[tuple[float, ...], float]:
        """Return the reference state that the command carries, xr(j + d), and r(j).

        While no law flies nobody follows what is looked ahead to, so it reaches no further than the window: r is
        promised up to there, and a setpoint waits until then.
        """
        reference = self.reference
        if reference is None:
            return (), 0.0
        target = self._wanted_target()
        if target is _STILL and target is not self._target:
            self._aim(target)  # before the samples of a silence are gone through
        reference.advance(sample.j)
        ahead = 0
        if self._align:
            unknown, most = self.window[0], self.window[1] + (MAX_AHEAD if flown else 0)
            ahead = min(forecast.d, most) if forecast.d is not None else unknown
        self._ahead = ahead
        if target is not self._target:
            self._aim(target)
        if flown and self._takes_over(was):
            self._match_reference(reference, sample, gains, ahead)
        if flown:
            self._law_changed = False
        return reference.ahead(ahead), self._source.r(reference.k)  # k is j, but where j is before the beginning

    def _takes_over(self, was: Mode) -> bool:
        """Return whether a law takes over from a hand, from the last command, from neutral, or from another law."""
        if self._law_changed or self._idle:
            return True
        return self.config.failsafe == "on" and _enters(was, self.mode)

    def _wanted_target(self) -> Target:
        """Return the reference that is to be flown: the ground's, eased to trim while the ground is lost."""
        on = self.config.failsafe == "on"
        target = _TRIM if on and self.failsafe.ground_lost else self._commander.target
        if isinstance(target, Moving) and on and self.mode not in FLOWN_BY_LAW:
            return _STILL  # nobody follows
        return target

    def _aim(self, target: Target) -> None:
        """Follow another reference, from the first sample on that no command has looked ahead to."""
        first = self._target is None
        self._target = target
        source, max_rate = self._source, self.max_rate
        source.set_limits(*((-self.max_pitch, self.max_pitch) if self.max_pitch is not None else self._limits))
        match target:
            case Steady(pitch):
                source.set_target(pitch, max_rate)
            case Moving(rate):
                source.set_rate(rate * self.model.Ts, max_rate)
            case Programmed():
                if self._program is None or self._program[0] is not target:
                    self._program = target, 0 if first else source.horizon + 1
                start, profile = self._program[1], self.config.profile
                source.set_source(Shifted(profile, start) if start else profile, max_rate)

    def shape(self, max_pitch: float | None, max_rate: float | None) -> None:
        """Limit the pitch reference, rad from trim, and its change, rad per sample; None for no limit."""
        self.max_pitch, self.max_rate = max_pitch, max_rate
        if self._target is not None:
            self._aim(self._target)

    def _match_reference(self, reference: ReferenceModel, sample: Sample, gains: Gains, ahead: int) -> None:
        """Let the reference go on from where the aircraft is: a law takes over without a jump of the elevator."""
        if gains.K2 is None:
            return
        dx: Matrix | None = np.array(sample.x) - self.model.trim.x
        if self._stateful is not None and gains.controller is not None:
            dx = self._stateful.take_over(sample.x, self._u, sample.j, ahead)
        if dx is None:
            return
        du, step_ahead = self._u - self.travel.neutral, reference.step_ahead(ahead)
        reference.set(match_reference(self.model, gains.K1, gains.K2, dx, du, step_ahead))

    # What else happens

    def event(self, event: Event, reason: str, now_ns: int) -> None:
        """Let failsafe take one event, and tell of a change of mode."""
        before = self.failsafe.mode
        self.failsafe = step(self.failsafe, event, now_ns, self.limits)
        after = self.failsafe.mode
        if after is before:
            return
        worse = after not in (Mode.TRACKING, Mode.STANDBY)
        data = {"from": before, "to": after, "event": event, "monitor": self.config.failsafe == "monitor"}
        text = f"{before} to {after}: {reason}"
        self._tell(Notice(now_ns, Severity.WARNING if worse else Severity.NOTICE, text, data))

    def reported(self, j: int, d: int, now_ns: int) -> bool:
        """Take the delay of the command of sample j as the plant reports it; return whether it is one of ours."""
        if self._first_j is None or self._last is None or not self._first_j <= j <= self._last.j or d < 1:
            return False  # the command of an autopilot before this one, or of another epoch, or of none
        self._reported = (d, now_ns)
        if not self._commander.engaged:
            return True
        in_window = self._in_window(d)
        fits = in_window
        if self.conservative is not None and self.mode not in FLOWN_BY_FIRST_LAW:
            fits = _holds(self.conservative, d)
        if not fits:
            self.event(Event.OUTSIDE, f"delay {d} reported", now_ns)
        elif in_window and not self._chosen.covers(j, d):
            self.event(Event.OUTSIDE, f"delay {d} outside its gain set", now_ns)
        return True

    def heard_ground(self, now_ns: int) -> None:
        """Take a ground station's sign of life."""
        if event := self.ground.heard(now_ns):
            self.event(event, "ground station is back", now_ns)

    def tick(self, now_ns: int) -> bool:
        """Raise what is due by time alone; return whether neutral is to be sent again, as no sample comes."""
        if lost := self.ground.tick(now_ns):
            self.event(lost, "ground station lost", now_ns)
        self._release(now_ns)
        due_ns = self._mode_ends_ns()
        if due_ns is None or now_ns < due_ns:
            return False
        if self.mode in FLOWN_BY_LAW and self._fresh_ns is not None:
            missing = self._missing(self._fresh_ns)
            event = Event.HALF if missing else Event.STALE
            self.event(event, missing or f"no state for {self._patience} samples", now_ns)
        elif self.mode is Mode.HOLD:
            self.event(Event.EXPIRED, "no recovery", now_ns)
        neutral = self.mode is Mode.NEUTRAL and self.config.failsafe == "on"
        if self._last is None or not (neutral or self.mode is Mode.STANDBY):
            return False
        if not neutral and not self._silence_told and self._stale_ns is not None and now_ns >= self._stale_ns:
            self._silence_told = True
            self._commander.warn(f"no state for {self._patience} samples, {self._commander.released_by}", now_ns)
        self._u, self._saturated = self.travel.neutral if neutral else self._stick_u(), False
        self._plausibility.commanded(self._u)
        self.saturation.told(saturated=False, now_ns=now_ns)
        self._next_repeat_ns = now_ns + self._Ts_ns
        return True

    def is_stale(self, now_ns: int) -> bool:
        """Return whether samples have come, and none for longer than the state may be old."""
        return self._stale_ns is not None and now_ns > self._stale_ns

    @property
    def silent(self) -> bool:
        """Whether no samples come while no law is to fly."""
        return self._silence_told

    @property
    def u(self) -> float:
        """The input that was commanded last, absolute."""
        return self._u

    def next_deadline_ns(self) -> int | None:
        """Return when ``tick`` is wanted if no sample comes."""
        mode_ns, ground_ns = self._mode_ends_ns(), self.ground.deadline_ns()
        if mode_ns is None or ground_ns is None:
            return ground_ns if mode_ns is None else mode_ns
        return min(mode_ns, ground_ns)

    def _mode_ends_ns(self) -> int | None:
        """Return when the present mode ends, or repeats its command, if no sample comes."""
        match self.mode:
            case Mode.TRACKING | Mode.LEVEL | Mode.CONSERVATIVE:
                return self._stale_ns
            case Mode.HOLD:
                return self.failsafe.since_ns + self.limits.hold_ns
            case Mode.NEUTRAL if self.config.failsafe == "on":
                return self._next_repeat_ns
            case Mode.STANDBY if not self._commander.engaged and self._stale_ns and self._next_repeat_ns:
                # also where no sample asks for it: the stick, or neutral, and that at once
                waits = self._u == self._stick_u()
                return max(self._stale_ns, self._next_repeat_ns) if waits else self._next_repeat_ns
            case _:
                return None

    @property
    def _patience(self) -> int:
        """The oldest state that the law in force may use, samples."""
        if self.mode is Mode.CONSERVATIVE and self.conservative is not None:
            return self.conservative.d_max
        return self.window[1]

    def _in_window(self, d: int) -> bool:
        """Return whether the law may fly at a delay."""
        return self.window[0] <= d <= self.window[1]


def elevator_sense(model: Model) -> int:
    """Return 1 where more elevator pitches up, -1 where it pitches down: the sign of the pitch's first answer to it.

    Of y(k) = pitch the first non-zero of C B, C A B, ... counts; 1 without any, or without a pitch.
    """
    index = pitch_index(model)
    if index is None:
        return 1
    answer = model.B[:, 0]
    for _ in range(model.nx):
        if answer[index] != 0.0:
            return 1 if answer[index] > 0.0 else -1
        answer = model.A @ answer
    return 1


def _holds(gains: GainLaw, d: int) -> bool:
    """Return whether the window of gains, or of a schedule, contains a delay."""
    return gains.d_min <= d <= gains.d_max


def _enters(was: Mode, mode: Mode) -> bool:
    """Return whether a law takes over from the last command, from neutral, or from the other law."""
    if was is Mode.STANDBY:
        return False
    return was not in FLOWN_BY_LAW or (was is Mode.CONSERVATIVE) is not (mode is Mode.CONSERVATIVE)
