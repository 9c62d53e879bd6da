"""What failsafe watches besides delay and age: samples that cannot be, an elevator at its limit, and silence.

Each monitor is a small object with its own state. It is told what happens and when, and answers with an event for
failsafe, or with what is wrong in words. None of them reads a clock. :class:`Plausibility` runs on every sample, so
it works on plain floats.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from operator import mul
from typing import NamedTuple

from autopilot.failsafe import Event
from autopilot.link.clock import NS_PER_S
from autopilot.link.sensors import Measurement, sensors_of
from autopilot.link.wire import AoaSsa, Attitude
from gains.model import Model

__all__ = [
    "COMMAND_MEMORY",
    "FROZEN_CHANGE",
    "FROZEN_SAMPLES",
    "JUMP_RAD",
    "JUMP_SAMPLES",
    "MAX_RATE_RAD_S",
    "SATURATION_NS",
    "UNSTICK_SAMPLES",
    "Halves",
    "Plausibility",
    "Saturation",
    "Silence",
    "Verdict",
]

MAX_RATE_RAD_S = 10.0
"""No aircraft here turns faster: 573 deg/s."""
JUMP_RAD = 0.05
"""What an angle may jump beside that, rad: noise and rounding, 2.9 deg."""
JUMP_SAMPLES = 20
"""After a gap of more samples than this an angle may be anywhere."""
FROZEN_SAMPLES = 10
"""After so many samples that only repeat a value it is asked whether the value must have moved."""
FROZEN_CHANGE = math.radians(0.5)
"""A value must have moved when the model says at least this over FROZEN_SAMPLES, rad or rad/s."""
UNSTICK_SAMPLES = 200
"""What stands still is believed again when it need not have moved for so many samples in a row: 5 s at 25 ms."""
COMMAND_MEMORY = 20
"""The input in force may be any of so many commands before the row: the loop delay is not known here."""
CALM_SHARE = 0.01
"""A disturbance does not reach a state directly that it moves by less than this share of the state it moves most."""
SATURATION_NS = NS_PER_S
"""How long the elevator may stay at its limit, ns."""

_QUARTER, _HALF, _TURN = math.pi / 2.0, math.pi, 2.0 * math.pi
_ROUNDING = 1e-6
"""Floats of 32 bits and conversions from degrees may pass a limit by less than this, rad."""
_ANGLES: Mapping[str, float] = {"pitch": _QUARTER, "roll": _HALF, "yaw": _HALF, "AOA": _QUARTER, "SSA": _QUARTER}
"""Largest angle in each field, rad; all other fields are rates."""
_NAMES: Mapping[type[Measurement], str] = {Attitude: "ATTITUDE", AoaSsa: "AOA_SSA"}


@dataclass(frozen=True, slots=True)
class Verdict:
    """What is wrong with a sample.

    Attributes
    ----------
    event : Event
        IMPLAUSIBLE or FROZEN.
    reason : str
        The state, its value and the limit, on one short line.
    """

    event: Event
    reason: str


class _Change(NamedTuple):
    """What the model says of a row up to sample j: its first state, its steps, the change of each state.

    The changes are pairs, with the least and with the greatest of the commands that may be in force.
    """

    j: int
    first: Sequence[float]
    steps: int
    by_model: list[tuple[float, float]]


class Plausibility:
    """Tells samples that no aircraft can have sent, and values that stand still although they must move.

    *Implausible* is a value beyond the range of its field, or an angle that has moved since the last plausible
    sample i by more than MAX_RATE_RAD_S (j - i) Ts + JUMP_RAD. A single wrong sample thus costs itself only, and a
    lasting jump, of a sensor that has been set anew, is believed as soon as an aircraft could have turned so far.

    *Frozen* is a single state that has repeated its value exactly for FROZEN_SAMPLES while the row does not fit the
    model: the sum of ((A - I) x + B u) over the row, deviations from trim, misses the measured change by more than
    FROZEN_CHANGE. What is looked at is the change of the state itself, and of those that it moves and no disturbance
    does, as the pitch angle for a pitch rate; where the wind enters, the model explains too little. So a trimmed
    aircraft in still air may stand still for ever. As the input in force is not known, any between the least and
    the greatest of the last commands will do; before the first commands it is neutral. The sum never reaches
    further back than the row, so that a small error of the model does not add up in a long steady flight. It
    must miss whichever one sample is left out: a single wrong sample is no reason to call another state frozen.

    A frozen state stays frozen until its value moves, or until the row has fitted the model, with the commands that
    were sent, at UNSTICK_SAMPLES samples on end. It does not come back at once when the row fits, as with the neutral
    elevator that failsafe commands nothing has to move any more. It does come back in the end, as an aircraft at rest
    whose state was called frozen by mistake would otherwise stay at rest, and in neutral, for ever. The price: a
    sensor that really is frozen is believed again after some time of calm neutral flight, and found again when it
    must move, up to FROZEN_SAMPLES and the memory of commands later.

    A state that may as well be at rest is not told from a frozen one, so this finds a frozen sensor late in calm
    flight: a pitch angle when the pitch rate moves, all states together when the elevator is commanded away from
    where they would rest. A simulator without any noise, at rest in a steady wind of more than 2 deg/s that the
    model does not know, would be called frozen.

    Where the next sample may have to be held against the model, what the model says of it is computed with the
    command before it, as :meth:`commanded` is called when that has left, and :meth:`judge` while one waits.

    Parameters
    ----------
    model : Model
        With sensors and one input.
    memory : int
        COMMAND_MEMORY or more where the loop delay may be longer, samples.
    """

    def __init__(self, model: Model, memory: int = COMMAND_MEMORY) -> None:
        assert model.nu == 1, model.nu
        fields = [sensor.field for sensor in sensors_of(model)]
        self._names = model.states
        self._limits = [_ANGLES.get(field, MAX_RATE_RAD_S) + _ROUNDING for field in fields]
        self._angles = [i for i, field in enumerate(fields) if field in _ANGLES]
        self._jump_per_sample = MAX_RATE_RAD_S * model.Ts
        self._trim: list[float] = model.trim.x.tolist()
        self._neutral = float(model.trim.u[0])
        self._A: list[list[float]] = model.A.tolist()
        for i, row in enumerate(self._A):
            row[i] -= 1.0
        self._B: list[float] = model.B[:, 0].tolist()
        self._moved = _moved(model)
        self._u: deque[float] = deque(maxlen=memory + FROZEN_SAMPLES)
        self._row: deque[tuple[int, Sequence[float]]] = deque(maxlen=FROZEN_SAMPLES)
        self._same = [0] * model.nx
        self._stuck: list[str | None] = [None] * model.nx
        self._fitted = [0] * model.nx
        self._plausible: tuple[int, Sequence[float]] | None = None
        self._next: _Change | None = None
        """What the model says of the next sample, where that has stood still."""
        self.forget()

    def forget(self) -> None:
        """Begin anew, as after a restart of the plant: nothing measured yet, the elevator neutral."""
        self._u.extend([self._neutral] * (self._u.maxlen or 0))
        self._row.clear()
        self._same = [0] * len(self._same)
        self._stuck = [None] * len(self._stuck)
        self._fitted = [0] * len(self._fitted)
        self._plausible = None
        self._next = None

    def commanded(self, u: float) -> None:
        """Take a command as it was sent, absolute, in units of u; every one of them, also neutral."""
        self._u.append(u)
        if max(self._same) >= FROZEN_SAMPLES - 1:
            self._next = self._change(self._row, self._row[-1][0] + 1)

    def judge(self, j: int, x: Sequence[float]) -> Verdict | None:
        """Return what is wrong with sample j, or None. A number that does not rise begins anew.

        Parameters
        ----------
        j : int
            Number of the sample.
        x : sequence of float, length nx
            Its state, absolute, rad and rad/s.
        """
        if self._plausible is not None and j <= self._plausible[0]:
            self.forget()
        wrong = self._beyond(x) or self._jump(j, x)
        if wrong is not None:
            return Verdict(Event.IMPLAUSIBLE, wrong)
        self._plausible = (j, x)
        return self._frozen(j, x)

    def _beyond(self, x: Sequence[float]) -> str | None:
        """Say which value lies beyond its range; NaN lies beyond every one."""
        for i, (value, limit) in enumerate(zip(x, self._limits, strict=True)):
            if not -limit <= value <= limit:
                return f"{self._names[i]} {value:.3g} beyond {limit:.3g}"
        return None

    def _jump(self, j: int, x: Sequence[float]) -> str | None:
        """Say which angle has jumped since the last plausible sample; past a half turn is the short way round."""
        if self._plausible is None:
            return None
        i, before = self._plausible
        if j - i > JUMP_SAMPLES:
            return None
        most = self._jump_per_sample * (j - i) + JUMP_RAD
        for n in self._angles:
            change = math.remainder(x[n] - before[n], _TURN)
            if not -most <= change <= most:
                return f"{self._names[n]} jumped {change:.3g}, limit {most:.3g}"
        return None

    def _frozen(self, j: int, x: Sequence[float]) -> Verdict | None:
        """Return the verdict on a state that stands still although it must move."""
        if self._row:
            for i, (value, before) in enumerate(zip(x, self._row[-1][1], strict=True)):
                if value == before:
                    self._same[i] += 1
                else:
                    self._same[i], self._stuck[i] = 0, None
        still = max(self._same) >= FROZEN_SAMPLES
        if still:
            self._find_stuck(j, x)
        self._row.append((j, x))
        self._next = None
        stuck = next(filter(None, self._stuck), None) if still else None
        return None if stuck is None else Verdict(Event.FROZEN, stuck)

    def _find_stuck(self, j: int, x: Sequence[float]) -> None:
        """Note each state that has stood still over a row that does not fit the model; clear one when it long did."""
        still = [n for n, same in enumerate(self._same) if same >= FROZEN_SAMPLES]
        ready = self._next
        missed = _missed(ready if ready is not None and ready.j == j else self._change(self._row, j), x)
        if any(missed[i] > FROZEN_CHANGE for n in still for i in self._moved[n]):
            missed = self._missed_by_all([*self._row, (j, x)], missed)
        for n in still:
            i = max(self._moved[n], key=missed.__getitem__)
            if missed[i] <= FROZEN_CHANGE:
                self._fitted[n] += 1
                if self._fitted[n] >= UNSTICK_SAMPLES:
                    self._stuck[n] = None
                continue
            self._fitted[n] = 0
            if self._stuck[n] is None:
                off = f"{self._names[i]} off by {missed[i]:.2g} > {FROZEN_CHANGE:.2g}"
                self._stuck[n] = f"{self._names[n]} frozen at {x[n]:.3g}, {off}"

    def _missed_by_all(self, row: Sequence[tuple[int, Sequence[float]]], whole: list[float]) -> list[float]:
        """Return by how much each state misses the model's change at the least, with any one sample left out.

        Parameters
        ----------
        row : sequence of (j, x)
            The samples.
        whole : list of float, length nx
            By how much each state misses over all of them; as much as without a sample that only repeats the one
            before, which would stand for it.
        """
        (last, now), (second_last, before) = row[-1], row[-2]
        missed = [_missed(self._change(row[:-2], second_last), before)]
        for k, (_, x) in enumerate(row[:-1]):
            repeats = k > 0 and x == row[k - 1][1]
            missed.append(whole if repeats else _missed(self._change([*row[:k], *row[k + 1 : -1]], last), now))
        return [min(each) for each in zip(*missed, strict=True)]

    def _change(self, row: Iterable[tuple[int, Sequence[float]]], j: int) -> _Change:
        """Return what the model says of a row up to sample j; over lost samples the one before stands for them."""
        numbers, states = zip(*row, strict=True)
        spans = [after - before for before, after in pairwise([*numbers, j])]
        steps = j - numbers[0]
        columns = zip(*states, strict=True)
        dx = [sum(map(mul, spans, values)) - steps * trim for values, trim in zip(columns, self._trim, strict=True)]
        low, high = steps * (min(self._u) - self._neutral), steps * (max(self._u) - self._neutral)
        free = [sum(map(mul, A, dx)) for A in self._A]
        by_model = [(rest + B * low, rest + B * high) for rest, B in zip(free, self._B, strict=True)]
        return _Change(j, states[0], steps, by_model)


def _missed(change: _Change, x: Sequence[float]) -> list[float]:
    """Return by how much each state's change up to x misses the model's, at the least, per FROZEN_SAMPLES."""
    missed = []
    for (one, other), before, now in zip(change.by_model, change.first, x, strict=True):
        off, also = one - (now - before), other - (now - before)
        least = 0.0 if off * also <= 0.0 else min(abs(off), abs(also))
        missed.append(least * FROZEN_SAMPLES / change.steps)
    return missed


def _moved(model: Model) -> list[list[int]]:
    """Return for each state itself and the states that it moves while no disturbance reaches them directly."""
    gust = abs(model.E).sum(axis=1)
    calm = gust < CALM_SHARE * gust.max(initial=0.0)  # nowhere, where the model knows no disturbance
    return [[i for i in range(model.nx) if i == n or (calm[i] and model.A[i, n] != 0.0)] for n in range(model.nx)]


@dataclass(slots=True)
class Saturation:
    """Tells when the elevator has been at its limit without a break for too long.

    Parameters
    ----------
    limit_ns : int
        For how long it may be, ns; 0 switches the monitor off.
    """

    limit_ns: int = SATURATION_NS
    _since_ns: int | None = None

    def told(self, saturated: bool, now_ns: int) -> Event | None:
        """Take one command as it was sent, held and neutral ones too; return SATURATED for each that is one too many.

        Parameters
        ----------
        saturated : bool
            Whether the command is one that the travel limited.
        now_ns : int
            Own time.
        """
        if not saturated:
            self._since_ns = None
            return None
        if self._since_ns is None:
            self._since_ns = now_ns
        late = self.limit_ns > 0 and now_ns - self._since_ns >= self.limit_ns
        return Event.SATURATED if late else None


@dataclass(slots=True)
class Silence:
    """Tells when the ground station, once heard, has fallen silent, and when it is back; each of it once.

    Parameters
    ----------
    timeout_ns : int
        Silence for longer than this is a loss, ns; 0 switches the monitor off.

    Attributes
    ----------
    lost : bool
        Whether it is lost now; never before it was heard for the first time.
    """

    timeout_ns: int
    lost: bool = False
    _heard_ns: int | None = None

    def heard(self, now_ns: int) -> Event | None:
        """Take a sign of life; return GROUND_BACK when it was lost."""
        self._heard_ns = now_ns
        was_lost, self.lost = self.lost, False
        return Event.GROUND_BACK if was_lost else None

    def tick(self, now_ns: int) -> Event | None:
        """Return GROUND_LOST when the silence has just become too long."""
        due_ns = self.deadline_ns()
        if due_ns is None or now_ns < due_ns:
            return None
        self.lost = True
        return Event.GROUND_LOST

    def deadline_ns(self) -> int | None:
        """Return when ``tick`` is wanted; None while nothing can be lost."""
        if self._heard_ns is None or self.lost or self.timeout_ns <= 0:
            return None
        return self._heard_ns + self.timeout_ns


class Halves:
    """Tells which half of the state does not come any more while another does.

    Parameters
    ----------
    needed : iterable of type
        The messages that carry a state; with one there are no halves.
    """

    def __init__(self, needed: Iterable[type[Measurement]]) -> None:
        self._came_ns: dict[type[Measurement], int | None] = dict.fromkeys(needed)

    def forget(self) -> None:
        """Begin anew, as after a restart of the plant."""
        self._came_ns = dict.fromkeys(self._came_ns)

    def came(self, message: type[Measurement], now_ns: int) -> None:
        """Take the type of a measurement."""
        self._came_ns[message] = now_ns

    def missing(self, since_ns: int) -> str | None:
        """Return what has not come since a time although another half has, in words; None when there is no such."""
        came = {kind for kind, at_ns in self._came_ns.items() if at_ns is not None and at_ns > since_ns}
        if not came:
            return None
        return next((f"{_NAMES[kind]} missing" for kind in self._came_ns if kind not in came), None)
