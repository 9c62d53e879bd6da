"""Messages to x(j): the halves of one sample paired by time, ordered, counted; half a sample is no sample.

``[sensors]`` of the model file says which MAVLink field carries each state. ATTITUDE comes on a 1 ms
grid, AOA_SSA in microseconds; two halves belong together when their stamps differ by less than half a
sampling period. A sample is complete when every message that carries a state has come.

The plant numbers its samples: NAMED_VALUE_INT ``SAMPLE_K`` gives k at a stamp. Samples wait for the
first number, so that j means the same sample on both ends although the first ones may be lost; a plant
that sends none is numbered from the first sample seen.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

from autopilot.link.clock import NS_PER_MS, NS_PER_S, NS_PER_US, unwrap
from autopilot.link.sensors import Measurement, sensors_of
from autopilot.link.wire import AoaSsa
from gains.model import Model

__all__ = ["JUMP_BACK_NS", "Drop", "Sample", "SampleAssembler"]

MAX_PENDING = 16
"""Incomplete samples that wait for their other half; the oldest is dropped first."""

NUMBER_WAIT_NS = 5 * NS_PER_S // 2
"""How long samples wait for the plant's SAMPLE_K, sent every second, before they are numbered from the first seen."""

JUMP_BACK_NS = NS_PER_S
"""A stamp older than the newest by more than this is no reordering but, with a clock step, a restart."""


FUTURE_SLACK_NS = NS_PER_S
"""A stamp may be later than the plant's time by this much, beyond the bound of the clock estimate."""


class Drop(StrEnum):
    """Why a measurement did not become part of a sample."""

    LATE = "late"
    DUPLICATE = "duplicate"
    JUMPED_BACK = "jumped_back"
    FROM_THE_FUTURE = "from_the_future"
    HALF = "half"


@dataclass(frozen=True, slots=True)
class Sample:
    """One complete measurement of the state.

    Attributes
    ----------
    j : int
        Number of the sample.
    t_ns : int
        Its stamp on the plant's clock.
    x : tuple of float, length nx
        The state, absolute, in the model's units.
    parts : tuple of Attitude or AoaSsa
        The messages it was made of.
    """

    j: int
    t_ns: int
    x: tuple[float, ...]
    parts: tuple[Measurement, ...]


@dataclass(slots=True)
class _Pending:
    """The messages that have come for one sample."""

    t_ns: int
    parts: dict[type[Measurement], Measurement]


class SampleAssembler:
    """Pairs, orders, de-duplicates and numbers the measurements of one plant.

    Parameters
    ----------
    model : Model
        Its sensors and sampling period.

    Attributes
    ----------
    drops : Counter
        Dropped measurements by kind.
    newest_ns : int or None
        Stamp of the newest complete sample.
    needed : frozenset of type
        The messages that carry a state.
    jumped_back : bool
        Whether the last stamp was older than the newest sample by more than JUMP_BACK_NS.
    """

    def __init__(self, model: Model) -> None:
        self.drops: Counter[Drop] = Counter()
        self.newest_ns: int | None = None
        self.jumped_back = False
        self._Ts_ns = model.Ts_ns
        self._sensors = sensors_of(model)
        self.needed = frozenset(sensor.message for sensor in self._sensors)
        self._pending: list[_Pending] = []
        self._number: tuple[int, int] | None = None
        self._waiting: tuple[int, Mapping[type[Measurement], Measurement]] | None = None
        self._first: tuple[int, int] | None = None
        """Own time and stamp of the first complete sample of the epoch."""

    def restart(self) -> None:
        """Begin a new epoch: forget stamps and numbers, keep the counters."""
        self.jumped_back = False
        self.newest_ns = None
        self._pending.clear()
        self._number = None
        self._waiting = None
        self._first = None

    def forget_number(self) -> None:
        """Wait for the plant's next number: its clock has stepped, and stamps do not count samples across that."""
        self._number = None
        self._first = None

    def add(self, message: Measurement, now_ns: int, peer_ns: int | None = None) -> Sample | None:
        """Take one measurement; return the sample it completes.

        Parameters
        ----------
        message : Attitude or AoaSsa
            The measurement, of a needed type.
        now_ns : int
            Own time.
        peer_ns : int, optional
            The plant's time now, at the most; a stamp well after it is refused.
        """
        assert type(message) in self.needed, type(message)
        t_ns = self._stamp_ns(message, peer_ns)
        if peer_ns is not None and t_ns > peer_ns + FUTURE_SLACK_NS:
            self.drops[Drop.FROM_THE_FUTURE] += 1
            return None
        half_ns = self._Ts_ns // 2
        if self.newest_ns is not None:
            self.jumped_back = t_ns < self.newest_ns - JUMP_BACK_NS
            if t_ns <= self.newest_ns + half_ns:
                late = t_ns < self.newest_ns - half_ns
                kind = Drop.JUMPED_BACK if self.jumped_back else Drop.LATE if late else Drop.DUPLICATE
                self.drops[kind] += 1
                return None
        complete = self._pair(message, t_ns, half_ns)
        return self._numbered(complete, now_ns) if complete is not None else None

    def number(self, k: int, time_boot_ms: int, peer_ns: int | None = None) -> Sample | None:
        """Take the plant's number k of the sample stamped ``time_boot_ms``; return a sample that waited for it."""
        self._number = (k, self._unwrap_ms(time_boot_ms, peer_ns))
        if self._waiting is None:
            return None
        waiting, self._waiting = self._waiting, None
        return self._sample(*waiting)

    def command_of(self, time_boot_ms: int, d: int) -> int | None:
        """Return the sample j of the command that a reported delay d speaks of; None before samples are numbered."""
        if self._number is None:
            return None
        k, at_ns = self._number
        return k + round((self._unwrap_ms(time_boot_ms, None) - at_ns) / self._Ts_ns) - d

    def _stamp_ns(self, message: Measurement, peer_ns: int | None) -> int:
        if isinstance(message, AoaSsa):
            return message.time_usec * NS_PER_US
        return self._unwrap_ms(message.time_boot_ms, peer_ns)

    def _unwrap_ms(self, time_boot_ms: int, peer_ns: int | None) -> int:
        """Return a stamp in ns: the one nearest to the newest sample, or to the plant's time before there is one."""
        near_ns = self.newest_ns if self.newest_ns is not None else peer_ns
        if near_ns is not None:
            time_boot_ms = unwrap(time_boot_ms, near_ns // NS_PER_MS, 1 << 32)
        return time_boot_ms * NS_PER_MS

    def _pair(self, message: Measurement, t_ns: int, half_ns: int) -> _Pending | None:
        """Put a measurement with its other half; return the sample's parts when all are there."""
        for pending in self._pending:
            if abs(pending.t_ns - t_ns) < half_ns:
                if type(message) in pending.parts:
                    self.drops[Drop.DUPLICATE] += 1
                    return None
                pending.parts[type(message)] = message
                break
        else:
            pending = _Pending(t_ns, {type(message): message})
            self._pending.append(pending)
            if len(self._pending) > MAX_PENDING:
                oldest = min(self._pending, key=lambda p: p.t_ns)
                self._pending.remove(oldest)
                self.drops[Drop.HALF] += len(oldest.parts)
        if len(pending.parts) < len(self.needed):
            return None
        for older in [p for p in self._pending if p.t_ns <= pending.t_ns]:
            self._pending.remove(older)
            if older is not pending:
                self.drops[Drop.HALF] += len(older.parts)
        return pending

    def _numbered(self, complete: _Pending, now_ns: int) -> Sample | None:
        """Return a complete sample with its number, or keep it until there is one."""
        finest = complete.parts.get(AoaSsa)
        t_ns = complete.t_ns if finest is None else self._stamp_ns(finest, None)
        self.newest_ns = t_ns
        if self._number is None:
            if self._first is None:
                self._first = (now_ns, t_ns)
            since_ns, first_ns = self._first
            if now_ns - since_ns < NUMBER_WAIT_NS:
                self._waiting = (t_ns, complete.parts)
                return None
            self._number = (0, first_ns)
        return self._sample(t_ns, complete.parts)

    def _sample(self, t_ns: int, parts: Mapping[type[Measurement], Measurement]) -> Sample:
        """Return the sample stamped ``t_ns``, numbered; stamps are good to a millisecond."""
        assert self._number is not None
        k, at_ns = self._number
        j = k + round((t_ns - at_ns) / self._Ts_ns)
        x = [getattr(parts[sensor.message], sensor.field) / sensor.to_field for sensor in self._sensors]
        return Sample(j, t_ns, tuple(x), tuple(parts.values()))
