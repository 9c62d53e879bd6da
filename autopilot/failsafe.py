"""Failsafe as a transition table: who has the elevator, the law, the last command, or neutral.

The certificate covers the law only with a state at most d_max samples old and a delay inside the
window. Outside it the law must not fly: TRACKING gives way to HOLD (the last command), then NEUTRAL (the
trim input), and comes back by itself after a row of good samples. The table is data; :func:`step` is the
only code that reads it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum

__all__ = ["TRANSITIONS", "Event", "FailsafeState", "Limits", "Mode", "step"]


class Mode(StrEnum):
    """Who has the elevator."""

    STANDBY = "STANDBY"
    """Nobody yet: neutral until the first good sample."""
    TRACKING = "TRACKING"
    """The control law."""
    HOLD = "HOLD"
    """The last command of the law."""
    NEUTRAL = "NEUTRAL"
    """The trim input."""


class Event(StrEnum):
    """What a sample, or the lack of one, says."""

    GOOD = "good"
    """A fresh sample, its delay forecast inside the window."""
    RECOVERED = "recovered"
    """The last of a row of good samples."""
    OUTSIDE = "outside"
    """A fresh sample, its delay outside the window or unknown."""
    STALE = "stale"
    """No fresh sample within d_max samples."""
    EXPIRED = "expired"
    """HOLD has lasted its time."""
    RESTARTED = "restarted"
    """The plant has started anew."""


TRANSITIONS: Mapping[tuple[Mode, Event], Mode] = {
    (Mode.STANDBY, Event.GOOD): Mode.TRACKING,
    (Mode.STANDBY, Event.RECOVERED): Mode.TRACKING,
    (Mode.TRACKING, Event.OUTSIDE): Mode.HOLD,
    (Mode.TRACKING, Event.STALE): Mode.HOLD,
    (Mode.TRACKING, Event.RESTARTED): Mode.STANDBY,
    (Mode.HOLD, Event.RECOVERED): Mode.TRACKING,
    (Mode.HOLD, Event.EXPIRED): Mode.NEUTRAL,
    (Mode.HOLD, Event.RESTARTED): Mode.STANDBY,
    (Mode.NEUTRAL, Event.RECOVERED): Mode.TRACKING,
    (Mode.NEUTRAL, Event.RESTARTED): Mode.STANDBY,
}
"""(mode, event) -> next mode; every pair that is not here stays in its mode."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Times of the table.

    Attributes
    ----------
    hold_ns : int
        How long HOLD lasts before NEUTRAL.
    good_samples : int
        Consecutive good samples that end HOLD or NEUTRAL.
    """

    hold_ns: int
    good_samples: int = 3


@dataclass(frozen=True, slots=True)
class FailsafeState:
    """Mode, since when (own time), and how many good samples have come in a row."""

    mode: Mode = Mode.STANDBY
    since_ns: int = 0
    good_in_a_row: int = 0


def step(state: FailsafeState, event: Event, now_ns: int, limits: Limits) -> FailsafeState:
    """Return the state after an event.

    A GOOD event that completes the row counts as RECOVERED. EXPIRED is believed only when HOLD has really
    lasted its time, so the caller may raise it on every tick.
    """
    good = state.good_in_a_row + 1 if event is Event.GOOD else 0
    if event is Event.EXPIRED:
        if now_ns - state.since_ns < limits.hold_ns:
            return state
        good = state.good_in_a_row
    if event is Event.GOOD and good >= limits.good_samples:
        event = Event.RECOVERED
    mode = TRANSITIONS.get((state.mode, event), state.mode)
    if mode is not state.mode:
        return FailsafeState(mode, now_ns, 0)
    good = min(good, limits.good_samples)
    return state if good == state.good_in_a_row else replace(state, good_in_a_row=good)
