"""What the ground has asked for: armed or not, the flight mode, and the pitch reference or the stick of that mode.

Disarmed, the elevator stays neutral. Armed, MANUAL gives it to the stick; in every other mode the law flies, under
failsafe, and the mode says where its pitch reference comes from:

=========  =====================================================================================
STABILIZE  a stick (MANUAL_CONTROL or RC_CHANNELS_OVERRIDE): full stick is ``stick_rad`` of pitch
AUTO       the programmed profile, from its beginning
GUIDED     a stream of SET_ATTITUDE_TARGET: a pitch, or a pitch rate
=========  =====================================================================================

A stick or a stream that falls silent counts as centred: the reference returns to trim, the elevator to neutral. The
modes have the numbers of ArduPlane, so every ground station knows their names. What failsafe makes of it all is in
``failsafe.py``; this module decides nothing about delays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from enum import IntEnum

from autopilot.link.clock import NS_PER_S
from autopilot.link.groundmessages import ManualControl, RcChannelsOverride, SetAttitudeTarget
from autopilot.link.messages import Severity

__all__ = ["ATTITUDE_IGNORE", "Commander", "FlightMode", "Moving", "Programmed", "Steady", "Target", "pitch_of"]

ATTITUDE_IGNORE = 128
"""ATTITUDE_TARGET_TYPEMASK bit: the quaternion is not meant."""
PITCH_RATE_IGNORE = 2
"""ATTITUDE_TARGET_TYPEMASK bit: the body's pitch rate is not meant."""
REFERENCE_NS = NS_PER_S
"""Default silence after which a stream or a stick counts as centred, ns."""
STALE_STAMP_MS = 1000
"""A setpoint whose stamp is behind the newest by less was overtaken on the way; by more, its sender restarted."""
STICK_CENTRE_US, STICK_REACH_US = 1500, 500
PULSE_LOW_US, PULSE_HIGH_US = 800, 2200
"""Pulses outside are no stick."""
MAX_SENDERS = 16
"""Senders of setpoints whose newest stamp is kept."""


class FlightMode(IntEnum):
    """Where the elevator's command, or the reference, comes from; ArduPlane's numbers."""

    MANUAL = 0
    STABILIZE = 2
    AUTO = 10
    GUIDED = 15

    @property
    def flags(self) -> int:
        """MAV_MODE_FLAG bits: manual input 64, stabilize 16, guided 8, auto 4."""
        return _FLAGS[self]


_FLAGS = {FlightMode.MANUAL: 64, FlightMode.STABILIZE: 64 | 16, FlightMode.AUTO: 16 | 8 | 4, FlightMode.GUIDED: 16 | 8}


@dataclass(frozen=True, slots=True)
class Steady:
    """A constant pitch reference, rad from trim."""

    pitch_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class Moving:
    """A pitch reference that moves at a constant rate, rad/s, from where it is."""

    rate_rad_s: float


@dataclass(frozen=True, slots=True, eq=False)
class Programmed:
    """The programmed profile, from its beginning; each time AUTO is entered is a new one."""


Target = Steady | Moving | Programmed
_TRIM = Steady()


def pitch_of(q: tuple[float, ...]) -> float | None:
    """Return the pitch of a quaternion (w, x, y, z), rad from -pi/2 to pi/2; None for what is no rotation."""
    norm = math.sqrt(sum(value * value for value in q))
    if not math.isfinite(norm) or not 0.5 < norm < 2.0:
        return None
    w, x, y, z = (value / norm for value in q)
    return math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x))))


class Commander:
    """Armed state, flight mode and reference, as ground stations command them.

    Parameters
    ----------
    unready : callable
        Returns what speaks against arming at a time, in words; empty when nothing does.
    tell : callable
        Takes severity, text and time of what people must know.
    trim_pitch_rad : float
        Pitch at trim; references count from there.
    self_arm : bool
        Whether the vehicle arms by itself, once, when its first good sample has come.

    Attributes
    ----------
    armed : bool
        Whether the elevator may leave neutral.
    mode : FlightMode
        The flight mode.
    stick_rad : float
        Pitch reference at full stick, rad.
    timeout_ns : int
        Silence of a stream or stick that centres it.
    require_certificate : bool
        Whether the ground can arm only gains with a verified certificate.
    refused : int
        Setpoints and sticks that were out of order, made no sense, or came while another station's were flown.
    """

    def __init__(
        self,
        unready: Callable[[int], list[str]],
        tell: Callable[[int, str, int], None],
        trim_pitch_rad: float,
        *,
        self_arm: bool,
    ) -> None:
        self.armed = False
        self.mode = FlightMode.AUTO
        self.stick_rad = math.radians(15.0)
        self.timeout_ns = REFERENCE_NS
        self.require_certificate = True
        self.certified = True
        self.refused = 0
        self._unready = unready
        self._tell = tell
        self._trim_pitch_rad = trim_pitch_rad
        self._self_arm = self_arm
        self._target: Target = Programmed()
        self._stick = 0.0
        self._heard_ns: int | None = None
        self._owner: Hashable = None
        self._rival_told = False
        self._stamps: dict[Hashable, int] = {}

    # What is asked by the pilot

    @property
    def engaged(self) -> bool:
        """Whether the law is to fly."""
        return self.armed and self.mode is not FlightMode.MANUAL

    @property
    def target(self) -> Target:
        """The pitch reference; a new object each time that it changes. Trim while disarmed by the ground."""
        return self._target if self.armed or self._self_arm else _TRIM

    @property
    def stick(self) -> float:
        """Where the elevator is asked to be in MANUAL, from -1 (nose down) to 1; 0 while disarmed."""
        return self._stick if self.armed and self.mode is FlightMode.MANUAL else 0.0

    @property
    def waiting(self) -> bool:
        """Whether the vehicle is still to arm by itself."""
        return self._self_arm

    @property
    def released_by(self) -> str:
        """Why the law is not to fly."""
        return "manual control" if self.armed else "disarmed"

    def usable_sample(self, now_ns: int) -> None:
        """Take note that a law could fly on the sample of now: what was to arm by itself does."""
        if self._self_arm:
            self.armed, self._self_arm = True, False
            text = "armed" if self.certified else "armed without a verified certificate"
            self._tell(Severity.NOTICE, text, now_ns)

    # Arming and modes

    def reasons(self, now_ns: int) -> list[str]:
        """Return what speaks against arming now, in words."""
        reasons = self._unready(now_ns)
        if self.require_certificate and not self.certified:
            reasons.append("no verified certificate")
        return reasons

    def arm(self, now_ns: int, *, force: bool = False) -> list[str]:
        """Arm, and return what spoke against it; forced, nothing does."""
        reasons = [] if force or self.armed else self.reasons(now_ns)
        if not reasons and not self.armed:
            self._arm(now_ns, "armed by force" if force else "armed")
        return reasons

    def _arm(self, now_ns: int, text: str) -> None:
        self.armed, self._self_arm = True, False
        self._begin(now_ns)
        self._tell(Severity.NOTICE, text, now_ns)

    def disarm(self, now_ns: int) -> None:
        """Disarm; the elevator goes to neutral, and nothing arms by itself again."""
        self._self_arm = False
        if self.armed:
            self.armed = False
            self._tell(Severity.NOTICE, "disarmed: elevator neutral", now_ns)

    def set_mode(self, mode: FlightMode, now_ns: int) -> None:
        """Change the flight mode; AUTO begins its profile anew, the others wait for their stick or stream."""
        if mode is self.mode:
            return
        self.mode = mode
        self._begin(now_ns)
        self._tell(Severity.NOTICE, f"mode {mode.name}", now_ns)

    def _begin(self, now_ns: int) -> None:
        """Let the reference of the mode begin; a stream or a stick has its time to come."""
        self._stick, self._heard_ns, self._rival_told = 0.0, None, False
        self._target = Programmed() if self.mode is FlightMode.AUTO else Steady()

    # Stick and setpoints: who is heard first is heard until it falls silent, so that two stations cannot pull in turn

    def attitude_target(self, message: SetAttitudeTarget, sender: Hashable, now_ns: int) -> None:
        """Take a setpoint; only GUIDED flies one."""
        if self.mode is not FlightMode.GUIDED or not self._in_order(sender, message.time_boot_ms):
            return
        target: Target | None = None
        if not message.type_mask & ATTITUDE_IGNORE:
            pitch = pitch_of(message.q)
            target = None if pitch is None else Steady(pitch - self._trim_pitch_rad)
        elif not message.type_mask & PITCH_RATE_IGNORE and math.isfinite(message.body_pitch_rate):
            target = Moving(message.body_pitch_rate)
        if target is None:
            self.refused += 1
            return
        if not self._owns(sender, now_ns):
            return
        if target != self._target:
            self._target = target

    def _owns(self, sender: Hashable, now_ns: int) -> bool:
        """Return whether a sender is the one whose stream or stick is flown; tell once when another wants to be."""
        if self._heard_ns is not None and sender != self._owner:
            self.refused += 1
            if not self._rival_told:
                self._rival_told = True
                self._tell(Severity.WARNING, f"{self.mode.name}: another station has the stick", now_ns)
            return False
        self._owner, self._heard_ns = sender, now_ns
        return True

    def _in_order(self, sender: Hashable, stamp_ms: int) -> bool:
        """Return whether a setpoint is newer than the newest of its sender; a stamp of 0 says nothing."""
        newest = self._stamps.get(sender)
        late = newest is not None and 0 < (newest - stamp_ms) % (1 << 32) < STALE_STAMP_MS
        if late and stamp_ms:
            self.refused += 1
            return False
        if newest is None and len(self._stamps) >= MAX_SENDERS:
            self._stamps.clear()
        self._stamps[sender] = stamp_ms
        return True

    def manual_control(self, message: ManualControl, sender: Hashable, now_ns: int) -> None:
        """Take a stick: x forward is nose down, as ArduPlane has it."""
        if not -1000 <= message.x <= 1000:
            self.refused += message.x != 32767
            return
        self._move_stick(-message.x / 1000.0, sender, now_ns)

    def rc_override(self, message: RcChannelsOverride, sender: Hashable, now_ns: int) -> None:
        """Take a stick as a pulse: long is nose up, as ArduPlane has it; 0 gives it back."""
        if message.chan2_raw == 0:
            if self._heard_ns is not None and sender == self._owner:
                self._move_stick(0.0, sender, now_ns)
                self._heard_ns = None  # given back: nobody to miss
        elif PULSE_LOW_US <= message.chan2_raw <= PULSE_HIGH_US:
            self._move_stick(
                max(-1.0, min(1.0, (message.chan2_raw - STICK_CENTRE_US) / STICK_REACH_US)), sender, now_ns
            )
        else:
            self.refused += message.chan2_raw != 65535

    def _move_stick(self, stick: float, sender: Hashable, now_ns: int) -> None:
        if self.mode not in (FlightMode.MANUAL, FlightMode.STABILIZE) or not self._owns(sender, now_ns):
            return
        self._stick = stick
        if self.mode is FlightMode.STABILIZE and self._target != Steady(stick * self.stick_rad):
            self._target = Steady(stick * self.stick_rad)

    # Time

    def tick(self, now_ns: int) -> None:
        """Centre a stream or a stick that has fallen silent."""
        due_ns = self.next_deadline_ns()
        if due_ns is None or now_ns < due_ns:
            return
        self._heard_ns, self._rival_told = None, False
        self._stick = 0.0
        if self.mode is FlightMode.MANUAL:
            self._tell(Severity.WARNING, "MANUAL: silence, elevator neutral", now_ns)
            return
        self._target = Steady()
        self._tell(Severity.WARNING, f"{self.mode.name}: silence, holding trim", now_ns)

    def warn(self, text: str, now_ns: int) -> None:
        """Tell people of what they must know while no law flies, and failsafe therefore says nothing."""
        self._tell(Severity.WARNING, text, now_ns)

    def next_deadline_ns(self) -> int | None:
        """Return when a silence is too long."""
        return None if self._heard_ns is None else self._heard_ns + self.timeout_ns
