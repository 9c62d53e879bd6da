"""The gate at the plant's end of the link: it makes the plant live a prescribed delay sequence, d(k mod L).

The plant's sample k passes on its way up. Whatever reaches the plant from now on is latched at sample k + 1
at the earliest, so the gate now lets through the one command that sample k + 1 shall hold: that of sample
j = k + 1 - d(k + 1). If it has not come yet (with d = 1 it answers the very sample that passes), it goes
through on arrival. For j < 0 nothing goes through, nor where the plant holds the command of sample j already.

Commands are known by their stamps, the plant's time of the sample they used; samples by the stamp of
ATTITUDE, counted from the last ``SAMPLE_K``. A number that falls back is a restart of the plant: the gate
starts anew. A datagram without a command is none of its business.

A command waits until it is wanted, or too old to be wanted ever again: d_max samples. With transitions
``any`` the sequence may ask for an older command than the last one; a command that has gone through is
therefore kept, and goes through again. The plant takes it only with ``--latch last``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Generic, NamedTuple, TypeVar

from autopilot.link.clock import NS_PER_MS, NS_PER_S, NS_PER_US, unwrap
from autopilot.link.wire import (
    AUTOPILOT,
    PLANT,
    Attitude,
    HilActuatorControls,
    Message,
    NamedValueInt,
    ServoOutputRaw,
    Wire,
)
from gains.model import Model
from gains.table import InputError
from gains.witnessfile import Witness

__all__ = ["MAX_HISTORY", "Gate", "GateStep", "Miss", "check_flyable"]

MAX_HISTORY = 1024
"""The most commands kept: one per sample, d_max samples back. A witness with a larger d_max is not flown."""

_MS_MODULUS = 1 << 32
"""Stamps in milliseconds wrap there, so the plant's time is known up to it."""
_US_MODULI = {ServoOutputRaw: 1 << 32, HilActuatorControls: _MS_MODULUS * (NS_PER_MS // NS_PER_US)}
"""Stamps of commands, in microseconds: the first wraps, the second does not but has no more to say."""

P = TypeVar("P")


class Miss(StrEnum):
    """What went otherwise than prescribed."""

    ABSENT = "absent"
    """The command had not come when its sample was sensed: the plant lived another delay."""
    OLD = "old"
    """A command came when no later sample can want it."""
    UNKNOWN = "unknown"
    """A command of no sample that has passed, or a datagram with commands of several samples."""
    REPLACED = "replaced"
    """Another command of the same sample came before this one was wanted."""


class GateStep(NamedTuple, Generic[P]):
    """What one datagram sets going.

    Attributes
    ----------
    released : tuple of (parcel, int)
        Parcels that go to the plant now, in order, and how many times each has gone before.
    dropped : tuple of parcel
        Parcels that never went and never will.
    """

    released: tuple[tuple[P, int], ...] = ()
    dropped: tuple[P, ...] = ()


@dataclass(slots=True)
class _Held(Generic[P]):
    """A command that is kept."""

    parcel: P
    releases: int = 0


@dataclass(slots=True)
class _Epoch(Generic[P]):
    """What the gate knows since the plant started.

    Attributes
    ----------
    k, at_ns : int
        A sample's number and stamp, plant's clock: the origin of the count.
    passed : int or None
        The newest sample that has passed.
    now_ns : int
        Its stamp, to unwrap others by.
    wanted : int or None
        Sample whose command the next sample shall hold.
    latched : int or None
        Sample of the last command that went through.
    history : dict
        Commands by the sample that they used.
    """

    k: int
    at_ns: int
    now_ns: int
    passed: int | None = None
    wanted: int | None = None
    latched: int | None = None
    history: dict[int, _Held[P]] = field(default_factory=dict)


def check_flyable(witness: Witness, source: str, latch: str | None = None, model: Model | None = None) -> None:
    """Refuse a witness that cannot be flown.

    Parameters
    ----------
    witness : Witness
        The sequence.
    source : str
        Where it comes from, for the complaint.
    latch : str, optional
        What the plant latches, where that is known.
    model : Model, optional
        The plant, where it is known.

    Raises
    ------
    InputError
        When it asks for a delay below one sample or above ``MAX_HISTORY``, for older commands than a plant
        that latches the newest would take, or for another sampling period than the plant's.
    """
    if witness.d_min < 1:
        raise InputError(f"{source}: d_min: expected at least 1 to fly it, found {witness.d_min}")
    if witness.d_max > MAX_HISTORY:
        raise InputError(f"{source}: d_max: expected at most {MAX_HISTORY} to fly it, found {witness.d_max}")
    if latch == "newest" and witness.transitions == "any":
        raise InputError(
            f"{source}: transitions: expected fifo for a plant that latches the newest command, found any, which"
            ' needs latch = "last"'
        )
    if model is not None and round(witness.Ts * NS_PER_S) != model.Ts_ns:
        raise InputError(f"{source}: Ts_s: expected {model.Ts} as that of {model.name}, found {witness.Ts}")


class Gate(Generic[P]):
    """Lets commands through to the plant so that it lives ``witness.delays``.

    A parcel stands for a datagram, and is whatever its owner likes. There is no clock in it: the plant's
    stamps are its time.

    Parameters
    ----------
    witness : Witness
        The sequence; one that :func:`check_flyable` lets pass.

    Attributes
    ----------
    misses : Counter
        What went otherwise than prescribed, by kind.
    """

    def __init__(self, witness: Witness) -> None:
        assert 1 <= witness.d_min <= witness.d_max <= MAX_HISTORY
        self.witness = witness
        self.misses: Counter[Miss] = Counter()
        self._Ts_ns = round(witness.Ts * NS_PER_S)
        self._plant = Wire(AUTOPILOT, PLANT)
        self._autopilot = Wire(PLANT, AUTOPILOT)
        self._epoch: _Epoch[P] | None = None

    @property
    def held(self) -> int:
        """How many commands wait that have not gone to the plant."""
        return 0 if self._epoch is None else sum(not held.releases for held in self._epoch.history.values())

    def sense(self, datagram: bytes) -> GateStep[P]:
        """Take a datagram of the plant, on its way up."""
        steps = []
        for message in self._plant.decode(datagram):
            if isinstance(message, NamedValueInt) and message.name == "SAMPLE_K":
                steps.append(self._number(message.value, message.time_boot_ms))
            elif isinstance(message, Attitude) and self._epoch is not None:
                steps.append(self._sample(self._epoch, message.time_boot_ms))
        return _joined(steps)

    def command(self, datagram: bytes, parcel: P) -> GateStep[P] | None:
        """Take a datagram at the end of its way down to the plant; None: it holds no command and passes."""
        epoch, stamps = self._epoch, _stamps(self._autopilot.decode(datagram))
        if not stamps:
            return None
        if epoch is None or epoch.passed is None:
            return self._swallow(Miss.UNKNOWN, parcel)
        numbers = {self._count(epoch, unwrap(us, epoch.now_ns // NS_PER_US, m) * NS_PER_US) for us, m in stamps}
        j = numbers.pop()
        if numbers or not 0 <= j <= epoch.passed:
            return self._swallow(Miss.UNKNOWN, parcel)
        if j <= epoch.passed - self.witness.d_max:
            return self._swallow(Miss.OLD, parcel)
        dropped = self._replaced(epoch, j)
        held = epoch.history[j] = _Held(parcel)
        if j != epoch.wanted:
            return GateStep((), dropped)
        return GateStep((self._release(epoch, j, held),), dropped)

    # Samples and their numbers

    def _number(self, k: int, time_boot_ms: int) -> GateStep[P]:
        """Take the plant's number of the sample with this stamp; start anew if the count is another now."""
        epoch = self._epoch
        if epoch is None:
            at_ns = time_boot_ms * NS_PER_MS
            self._epoch = _Epoch(k, at_ns, at_ns)
            return GateStep()
        at_ns = unwrap(time_boot_ms, epoch.now_ns // NS_PER_MS, _MS_MODULUS) * NS_PER_MS
        if k == self._count(epoch, at_ns) and (epoch.passed is None or k >= epoch.passed):
            epoch.k, epoch.at_ns = k, at_ns
            return GateStep()
        self._epoch = _Epoch(k, at_ns, at_ns)
        return GateStep((), tuple(held.parcel for held in epoch.history.values() if not held.releases))

    def _count(self, epoch: _Epoch[P], stamp_ns: int) -> int:
        """Return the number of the sample with this stamp, which is good to a millisecond."""
        return epoch.k + round((stamp_ns - epoch.at_ns) / self._Ts_ns)

    def _sample(self, epoch: _Epoch[P], time_boot_ms: int) -> GateStep[P]:
        """Let the plant's sample pass: choose the command that the next one shall hold."""
        stamp_ns = unwrap(time_boot_ms, epoch.now_ns // NS_PER_MS, _MS_MODULUS) * NS_PER_MS
        k = self._count(epoch, stamp_ns)
        if epoch.passed is not None and k <= epoch.passed:
            return GateStep()  # a second copy
        if epoch.wanted is not None and epoch.wanted != epoch.latched:
            self.misses[Miss.ABSENT] += 1
        epoch.passed, epoch.now_ns = k, stamp_ns
        delays = self.witness.delays
        j = k + 1 - delays[(k + 1) % len(delays)]
        epoch.wanted = j if j >= 0 else None
        old = [i for i in epoch.history if i <= k - self.witness.d_max]
        dropped = tuple(held.parcel for held in map(epoch.history.pop, old) if not held.releases)
        assert len(epoch.history) <= MAX_HISTORY
        held = epoch.history.get(j)
        if held is None or j == epoch.latched:
            return GateStep((), dropped)
        return GateStep((self._release(epoch, j, held),), dropped)

    # Commands

    def _release(self, epoch: _Epoch[P], j: int, held: _Held[P]) -> tuple[P, int]:
        epoch.latched = j
        held.releases += 1
        return held.parcel, held.releases - 1

    def _replaced(self, epoch: _Epoch[P], j: int) -> tuple[P, ...]:
        """Return the parcel that a new command of sample j puts out of the history, unless it has gone through."""
        before = epoch.history.get(j)
        if before is None or before.releases:
            return ()
        self.misses[Miss.REPLACED] += 1
        return (before.parcel,)

    def _swallow(self, miss: Miss, parcel: P) -> GateStep[P]:
        self.misses[miss] += 1
        return GateStep((), (parcel,))


def _stamps(messages: Iterable[Message]) -> list[tuple[int, int]]:
    """Return stamp and modulus, in microseconds, of each command."""
    commands = (m for m in messages if isinstance(m, ServoOutputRaw | HilActuatorControls))
    return [(command.time_usec, _US_MODULI[type(command)]) for command in commands]


def _joined(steps: Iterable[GateStep[P]]) -> GateStep[P]:
    """Return several steps as one."""
    released: list[tuple[P, int]] = []
    dropped: list[P] = []
    for step in steps:
        released += step.released
        dropped += step.dropped
    return GateStep(tuple(released), tuple(dropped))
