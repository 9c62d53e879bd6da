"""Failsafe as a transition table: who has the elevator, a law, the last command, or neutral.

The certificate covers a law only with a state at most d_max samples old and a delay inside its window. Outside it
the law must not fly: it gives way to HOLD (the last command), then NEUTRAL (the trim input), and comes back by
itself after a row of good samples. A second set of gains, proved for a wider window, may fly meanwhile:
CONSERVATIVE. The table is data; :func:`step` is the only code that reads it.

Each sample is exactly one of GOOD, WIDE, OUTSIDE, IMPLAUSIBLE and FROZEN. :func:`step` counts the rows and adds
RECOVERED, CALM and WIDE_RECOVERED itself. ``autopilot.failsafe_page`` prints the whole table.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Self

from autopilot.link.clock import NS_PER_S

__all__ = [
    "CALM_SAMPLES",
    "FLOWN_BY_FIRST_LAW",
    "FLOWN_BY_LAW",
    "GOOD_SAMPLES",
    "REST_NS",
    "TRANSITIONS",
    "Event",
    "FailsafeState",
    "Limits",
    "Mode",
    "step",
]

GOOD_SAMPLES = 3
"""Samples in a row that end HOLD and NEUTRAL."""
CALM_SAMPLES = 40
"""GOOD samples in a row that end CONSERVATIVE: 1 s at 25 ms."""
REST_NS = NS_PER_S
"""The least time in NEUTRAL after SATURATED, ns."""


class _Word(StrEnum):
    """A word of the table with its meaning."""

    meaning: str

    def __new__(cls, value: str, meaning: str = "") -> Self:
        """Make the member that is written ``value``; without a meaning this is how a member is looked up."""
        word = str.__new__(cls, value)
        word._value_ = value
        word.meaning = meaning
        return word


class Mode(_Word):
    """Who has the elevator; ``meaning`` says it in words."""

    STANDBY = (
        "STANDBY",
        "No law: neutral until the vehicle is armed and the first good sample comes, or the stick in MANUAL.",
    )
    TRACKING = "TRACKING", "The control law."
    LEVEL = "LEVEL", "The control law with its reference eased to zero: the ground station is lost."
    CONSERVATIVE = "CONSERVATIVE", "The second set of gains, certified for a wider window of delays."
    HOLD = "HOLD", "The last command of a law."
    NEUTRAL = "NEUTRAL", "The trim input."


FLOWN_BY_FIRST_LAW = frozenset({Mode.TRACKING, Mode.LEVEL})
"""The modes in which the gains themselves fly, not the conservative ones."""
FLOWN_BY_LAW = FLOWN_BY_FIRST_LAW | {Mode.CONSERVATIVE}
"""The modes in which a law computes the command."""


class Event(_Word):
    """What a sample, or the lack of one, says; ``meaning`` says it in words."""

    GOOD = "good", "A fresh sample: its delay is inside the window of the law, the clock is known."
    WIDE = "wide", "A fresh sample for the conservative gains only: their window alone has its delay, or no clock."
    OUTSIDE = "outside", "A fresh sample whose delay is unknown or in no window."
    IMPLAUSIBLE = "implausible", "A sample that no aircraft can have sent."
    FROZEN = "frozen", "A sample that has not moved although it must have."
    RECOVERED = "recovered", "The last of a short row of GOOD samples."
    CALM = "calm", "The last of a long row of GOOD samples."
    WIDE_RECOVERED = "wide_recovered", "The last of a short row of samples that are GOOD or WIDE."
    STALE = "stale", "No fresh sample within d_max samples."
    HALF = "half", "One half of the state comes, the other does not."
    CLOCK_LOST = "clock_lost", "The plant's clock is not known any more."
    SATURATED = "saturated", "The elevator has been at its limit for too long."
    GROUND_LOST = "ground_lost", "The ground station has fallen silent."
    GROUND_BACK = "ground_back", "The ground station is heard again."
    EXPIRED = "expired", "HOLD has lasted its time."
    RESTARTED = "restarted", "The plant has started anew."
    RELEASED = "released", "The vehicle is disarmed, or flown by hand."


def _same(modes: tuple[Mode, ...], events: tuple[Event, ...], to: Mode) -> dict[tuple[Mode, Event], Mode]:
    """Return the entries of several modes that some events take to one mode."""
    return {(mode, event): to for mode in modes for event in events}


_NO_STATE = (Event.OUTSIDE, Event.STALE, Event.HALF, Event.IMPLAUSIBLE, Event.FROZEN)
"""No law may fly on these."""

TRANSITIONS: Mapping[tuple[Mode, Event], Mode] = {
    **_same((Mode.STANDBY,), (Event.GOOD, Event.RECOVERED, Event.CALM), Mode.TRACKING),
    **_same((Mode.STANDBY,), (Event.WIDE_RECOVERED,), Mode.CONSERVATIVE),
    **_same((Mode.TRACKING,), (Event.GROUND_LOST,), Mode.LEVEL),
    **_same((Mode.LEVEL,), (Event.GROUND_BACK,), Mode.TRACKING),
    **_same((Mode.TRACKING, Mode.LEVEL), (*_NO_STATE, Event.WIDE, Event.CLOCK_LOST), Mode.HOLD),
    **_same((Mode.CONSERVATIVE,), (Event.CALM,), Mode.TRACKING),
    **_same((Mode.CONSERVATIVE,), _NO_STATE, Mode.HOLD),
    **_same((Mode.HOLD, Mode.NEUTRAL), (Event.RECOVERED, Event.CALM), Mode.TRACKING),
    **_same((Mode.HOLD, Mode.NEUTRAL), (Event.WIDE_RECOVERED,), Mode.CONSERVATIVE),
    **_same((Mode.HOLD,), (Event.EXPIRED,), Mode.NEUTRAL),
    # the last command is the saturated one: no HOLD
    **_same((Mode.TRACKING, Mode.LEVEL, Mode.CONSERVATIVE, Mode.HOLD), (Event.SATURATED,), Mode.NEUTRAL),
    **_same(tuple(mode for mode in Mode if mode is not Mode.STANDBY), (Event.RESTARTED, Event.RELEASED), Mode.STANDBY),
}
"""(mode, event) -> next mode; every pair that is not here stays in its mode."""

_ROWS = frozenset({Event.RECOVERED, Event.CALM, Event.WIDE_RECOVERED})
"""What the last sample of a row says."""
_NO_SAMPLE = frozenset({Event.SATURATED, Event.GROUND_LOST, Event.GROUND_BACK, Event.EXPIRED})
"""These say nothing about the samples, so they break no row."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Times and counts of the table.

    Attributes
    ----------
    hold_ns : int
        How long HOLD lasts before NEUTRAL, ns.
    good_samples : int
        Samples in a row that end HOLD or NEUTRAL.
    calm_samples : int
        GOOD samples in a row that end CONSERVATIVE. Nothing certifies switching between the two laws, so a delay
        that wanders over the edge of the window must not do it all the time.
    rest_ns : int
        Least time in NEUTRAL, ns, when SATURATED has led there. The reason for the saturation is most likely still
        there after three samples, and the elevator would go between limit and neutral several times a second.
    conservative : bool
        Whether there is a conservative set of gains; without one WIDE is OUTSIDE.
    """

    hold_ns: int
    good_samples: int = GOOD_SAMPLES
    calm_samples: int = CALM_SAMPLES
    rest_ns: int = REST_NS
    conservative: bool = False

    @property
    def longest_row(self) -> int:
        """The longest row that counts, samples."""
        return max(self.good_samples, self.calm_samples)


@dataclass(frozen=True, slots=True)
class FailsafeState:
    """Where failsafe stands.

    Attributes
    ----------
    mode : Mode
        Who has the elevator.
    since_ns : int
        Since when, own time.
    good_in_a_row : int
        GOOD samples in a row in this mode; it stops at the longest row that counts.
    usable_in_a_row : int
        The same of samples that are GOOD or WIDE.
    resting : bool
        Whether SATURATED led to this NEUTRAL, which then lasts its least time.
    cautious : bool
        Whether the conservative gains flew last: then only CALM, and no short row of GOOD samples, gives the first
        law back, even where a HOLD lies between.
    ground_lost : bool
        Whether the ground station is lost, in any mode: CONSERVATIVE has no mode of its own for it, and its
        reference is to be eased to zero all the same.
    """

    mode: Mode = Mode.STANDBY
    since_ns: int = 0
    good_in_a_row: int = 0
    usable_in_a_row: int = 0
    resting: bool = False
    cautious: bool = False
    ground_lost: bool = False


def step(state: FailsafeState, event: Event, now_ns: int, limits: Limits) -> FailsafeState:
    """Return the state after an event.

    A GOOD or WIDE sample may also complete a row; the strongest of what it says that has an entry is taken, once.
    Rows begin anew with each mode, so no sample counts for two changes. EXPIRED, and a row while NEUTRAL rests
    after SATURATED, are believed only when the time has really passed, so the caller may raise EXPIRED on every
    tick. A lost ground station is remembered: a change to TRACKING then goes on to LEVEL.
    """
    if event is Event.GOOD and state.mode is Mode.TRACKING and state.good_in_a_row == limits.longest_row:
        return state  # as nearly always, right between a packet in and a packet out
    if event is Event.WIDE and not limits.conservative:
        event = Event.OUTSIDE
    good, usable = _rows(state, event, limits)
    ground_lost = event is Event.GROUND_LOST or (state.ground_lost and event is not Event.GROUND_BACK)
    said = [e for e in _meanings(event, good, usable, limits) if _believed(state, e, now_ns, limits)]
    mode = next((TRANSITIONS[state.mode, e] for e in said if (state.mode, e) in TRANSITIONS), state.mode)
    if ground_lost:
        mode = TRANSITIONS.get((mode, Event.GROUND_LOST), mode)
    if mode is not state.mode:
        cautious = mode is Mode.CONSERVATIVE or (state.cautious and mode in (Mode.HOLD, Mode.NEUTRAL))
        resting = event is Event.SATURATED
        return FailsafeState(mode, now_ns, resting=resting, cautious=cautious, ground_lost=ground_lost)
    if (good, usable, ground_lost) == (state.good_in_a_row, state.usable_in_a_row, state.ground_lost):
        return state
    return replace(state, good_in_a_row=good, usable_in_a_row=usable, ground_lost=ground_lost)


def _rows(state: FailsafeState, event: Event, limits: Limits) -> tuple[int, int]:
    """Return how many samples in a row are GOOD, and how many are GOOD or WIDE."""
    good, usable = state.good_in_a_row, state.usable_in_a_row
    if event in _NO_SAMPLE:
        return good, usable
    if event is Event.CLOCK_LOST:  # the samples before it were no GOOD ones any more, but WIDE ones
        return 0, usable
    longest = limits.longest_row
    good = min(good + 1, longest) if event is Event.GOOD else 0
    usable = min(usable + 1, longest) if event in (Event.GOOD, Event.WIDE) else 0
    return good, usable


def _meanings(event: Event, good: int, usable: int, limits: Limits) -> list[Event]:
    """Return all that an event says, the strongest first: a GOOD sample is also the last of its rows."""
    said = []
    if event is Event.GOOD and good >= limits.calm_samples:
        said.append(Event.CALM)
    if event is Event.GOOD and good >= limits.good_samples:
        said.append(Event.RECOVERED)
    said.append(event)
    if event in (Event.GOOD, Event.WIDE) and usable >= limits.good_samples:
        said.append(Event.WIDE_RECOVERED)
    return said


def _believed(state: FailsafeState, event: Event, now_ns: int, limits: Limits) -> bool:
    """Return whether the time for an event has come, and the gains that it asks for are there and may fly."""
    here_ns = now_ns - state.since_ns
    if event is Event.EXPIRED:
        return here_ns >= limits.hold_ns
    if event is Event.WIDE_RECOVERED and not limits.conservative:
        return False
    if event is Event.RECOVERED and state.cautious:
        return False
    return event not in _ROWS or not state.resting or here_ns >= limits.rest_ns
