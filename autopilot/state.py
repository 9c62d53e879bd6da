"""Messages to x(j): the halves of one sample paired by time, ordered, counted; half a sample is no sample.

``[sensors]`` of the model file says which MAVLink field carries each state. ATTITUDE comes on a 1 ms
grid, AOA_SSA in microseconds; two halves belong together when their stamps differ by less than half a
sampling period. A sample is complete when every message that carries a state has come. Where the angle of
attack is taken from VFR_HUD (``alpha.py``), ATTITUDE alone makes a sample.

ATTITUDE's u32 milliseconds wrap after 49.7 days. Some vehicles fill the u64 of AOA_SSA from a u32 counter
(ArduPlane: ``micros()``), so that a value that fits one wraps after 71.6 minutes. Both are taken as near as
can be to the plant's time, or to the newest stamp while that is not known, and never before 0.

The plant numbers its samples: NAMED_VALUE_INT ``SAMPLE_K`` gives k at a stamp. Samples wait for the
first number, so that j means the same sample on both ends although the first ones may be lost; a plant
that sends none is numbered from the first sample seen.

Nothing that one message says lasts. A number that contradicts the running one is set aside, and believed when
the next one agrees with it. Where samples are refused as too old for a while although their stamps rise as time
does, or their numbers have fallen back, the track is lost: ``lost`` says why, and the plant begins a new epoch.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

from autopilot.alpha import AlphaChoice, AlphaSource, alpha_selector
from autopilot.link.clock import NS_PER_MS, NS_PER_S, NS_PER_US, unwrap
from autopilot.link.sensors import Measurement, sensors_of
from autopilot.link.wire import AoaSsa, Attitude, VfrHud
from gains.model import Model

__all__ = ["JUMP_BACK_NS", "Drop", "Sample", "SampleAssembler"]

MAX_PENDING = 16
"""Incomplete samples that wait for their other half; the first to come is dropped first."""

NUMBER_WAIT_NS = 5 * NS_PER_S // 2
"""How long samples wait for the plant's SAMPLE_K, sent every second, before they are numbered from the first seen."""

JUMP_BACK_NS = NS_PER_S
"""A stamp older than the newest by more than this is no reordering but, with a clock step, a restart."""

OVERTAKEN_NS = 250_000_000
"""A sample's number may come behind its sample, and be overtaken by samples of so long."""

FUTURE_SLACK_NS = NS_PER_S
"""A stamp may be later than the plant's time by this much, beyond the bound of the clock estimate."""

RESYNC_NS = NS_PER_S
"""When all that came for so long, own time, was too old, the newest stamp is taken for the wrong one."""

RESYNC_MEASUREMENTS = 20
"""So many of one message must have come by then,"""

RESYNC_GAP_NS = 2 * NS_PER_S
"""none of them later than this after the one before."""

RESYNC_SPREAD_NS = NS_PER_S // 2
"""The stamps of such measurements rise with own time, up to this much: they are the plant's, and no old ones."""

MAX_STAMP_NS = 1 << 61
"""73 years: no clock shows more."""

U32 = 1 << 32
TURN_NS = U32 * NS_PER_MS
"""The time after which ATTITUDE's stamps repeat."""


class Drop(StrEnum):
    """Why a measurement did not become part of a sample."""

    LATE = "late"
    DUPLICATE = "duplicate"
    JUMPED_BACK = "jumped_back"
    FROM_THE_FUTURE = "from_the_future"
    HALF = "half"
    UNUSED = "unused"
    """An AOA_SSA while the angle of attack comes from VFR_HUD: too few have come to be trusted."""
    NO_AIR = "no_air"
    """No VFR_HUD to take the angle of attack from: none has come of late, or it is too slow."""


class Sample(NamedTuple):
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
    alpha : AlphaSource
        Where its angle of attack came from. VFR_HUD is the noisy one.
    """

    j: int
    t_ns: int
    x: tuple[float, ...]
    parts: tuple[Measurement, ...]
    alpha: AlphaSource


@dataclass(slots=True)
class _Pending:
    """The messages that have come for one sample."""

    t_ns: int
    parts: dict[type[Measurement], Measurement]


@dataclass(slots=True)
class _Refused:
    """Messages of one kind, in a row, that were too old: own times of the first and the last, offset, how many."""

    since_ns: int
    last_ns: int
    offset_ns: int
    """Stamp minus own time of the first."""
    count: int = 0


def _nearest(value: int, near: int, modulus: int) -> int:
    """Return the number congruent to ``value`` nearest to ``near``, but none below 0: no clock was there."""
    nearest = unwrap(value, near, modulus)
    return nearest if nearest >= 0 else nearest + modulus


class SampleAssembler:
    """Pairs, orders, de-duplicates and numbers the measurements of one plant.

    Parameters
    ----------
    model : Model
        Its sensors and sampling period.
    alpha : "auto", "aoa_ssa" or "vfr_hud"
        Where the angle of attack comes from, if the model has one.

    Attributes
    ----------
    drops : Counter
        Dropped measurements by kind.
    newest_ns : int or None
        Stamp of the newest complete sample.
    needed : frozenset of type
        The messages that carry a state: those that :meth:`add` takes.
    jumped_back : bool
        Whether the last stamp was older than the newest sample by more than JUMP_BACK_NS.
    lost : str
        Why stamps or numbers do not go on from where they were, as the last message showed; empty while they do.
        The caller then begins a new epoch, and gives that message again.

    Raises
    ------
    InputError
        When the model cannot be flown over these messages, or its state not without AOA_SSA as was asked for.
    """

    def __init__(self, model: Model, alpha: AlphaChoice = "auto") -> None:
        self.drops: Counter[Drop] = Counter()
        self.newest_ns: int | None = None
        self.jumped_back = False
        self.lost = ""
        self._Ts_ns = model.Ts_ns
        self._slip = JUMP_BACK_NS // self._Ts_ns
        """So many samples numbers may fall back: they are late, until numbers have caught up."""
        self._sensors = sensors_of(model)
        self._alpha = alpha_selector(self._sensors, alpha, model.name)
        self.needed = frozenset(sensor.message for sensor in self._sensors)
        if alpha == "vfr_hud":
            self.needed -= {AoaSsa}
        self._pending: list[_Pending] = []
        self._number: tuple[int, int] | None = None
        self._doubted: tuple[int, int] | None = None
        """The plant's last number, which contradicted the running one."""
        self._last_j: int | None = None
        """The highest number given in the epoch."""
        self._refused: dict[type[Measurement], _Refused] = {}
        self._waiting: Sample | None = None
        """The newest complete sample, whose number is not known yet."""
        self._first: tuple[int, int] | None = None
        """Own time and stamp of the first complete sample of the epoch."""
        self._seen_ns: int | None = None
        """The last stamp of the epoch, of whatever message."""
        self._settled = False
        """Whether the stamps kept are on the plant's time, rather than right up to turns of the counter."""

    @property
    def alpha(self) -> AlphaSource:
        """Where the angle of attack of the next sample will come from."""
        return self._alpha.source

    @property
    def alpha_since_ns(self) -> int | None:
        """Own time at which that source was changed to; None while it never was."""
        return self._alpha.since_ns

    def alpha_report(self) -> str:
        """Return what people must know of that source, in at most 50 characters."""
        return self._alpha.report()

    def restart(self) -> None:
        """Begin a new epoch: forget stamps and numbers, keep the counters."""
        self.jumped_back = False
        self.lost = ""
        self.newest_ns = None
        self._pending.clear()
        self._number = self._doubted = None
        self._last_j = None
        self._refused.clear()
        self._waiting = None
        self._first = None
        self._seen_ns = None
        self._settled = False
        self._alpha.restart()

    def forget_number(self) -> None:
        """Wait for the plant's next number: its clock has stepped, and stamps do not count samples across that."""
        self._number = self._doubted = None
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
        self.lost = ""
        if peer_ns is not None and not self._settled:
            self._settle(peer_ns)
        t_ns = self._stamp_ns(message, peer_ns)
        if t_ns >= MAX_STAMP_NS or (peer_ns is not None and t_ns > peer_ns + FUTURE_SLACK_NS):
            self.drops[Drop.FROM_THE_FUTURE] += 1
            return None
        self._note(message, t_ns, now_ns)
        half_ns = self._Ts_ns // 2
        if self.newest_ns is not None:
            self.jumped_back = t_ns < self.newest_ns - JUMP_BACK_NS
            if t_ns <= self.newest_ns + half_ns:
                late = t_ns < self.newest_ns - half_ns
                kind = Drop.JUMPED_BACK if self.jumped_back else Drop.LATE if late else Drop.DUPLICATE
                self.drops[kind] += 1
                if kind is not Drop.DUPLICATE:
                    self._refuse(type(message), t_ns, now_ns)
                return None
        alpha_rad = None
        if self._alpha.source is AlphaSource.VFR_HUD:
            if isinstance(message, AoaSsa):
                self.drops[Drop.UNUSED] += 1
                return None
            alpha_rad = self._alpha.alpha_rad(message.pitch, now_ns)
            if alpha_rad is None:
                self.drops[Drop.NO_AIR] += 1
                return None
        complete = self._pair(message, t_ns, half_ns)
        return self._numbered(self._whole(complete, alpha_rad), now_ns) if complete is not None else None

    def air(self, message: VfrHud, now_ns: int) -> None:
        """Take a VFR_HUD, from which the angle of attack may have to come."""
        self._alpha.air(message, now_ns)

    def number(self, k: int, time_boot_ms: int, peer_ns: int | None = None) -> Sample | None:
        """Take the plant's number k of the sample stamped ``time_boot_ms``; return a sample that waited for it."""
        self.lost = ""
        if peer_ns is not None and not self._settled:
            self._settle(peer_ns)
        at_ns = self._unwrap_ms(time_boot_ms, peer_ns)
        if k < 0 or at_ns >= MAX_STAMP_NS or not self._believed(k, at_ns):
            return None
        self._seen_ns = at_ns
        if self._fell_back(k, at_ns):
            return None
        self._number, self._doubted = (k, at_ns), None
        waiting, self._waiting = self._waiting, None
        return self._counted(waiting) if waiting is not None else None

    def command_of(self, time_boot_ms: int, d: int) -> int | None:
        """Return the sample j of the command that a reported delay d speaks of; None before samples are numbered."""
        if self._number is None:
            return None
        return self._count(self._number, self._unwrap_ms(time_boot_ms, None)) - d

    # The way back

    def _refuse(self, kind: type[Measurement], t_ns: int, now_ns: int) -> None:
        """Note that a measurement was too old; in a long row whose stamps rise as time does, the track is lost."""
        row, offset_ns = self._refused.get(kind), t_ns - now_ns
        if row is None or now_ns - row.last_ns > RESYNC_GAP_NS or abs(offset_ns - row.offset_ns) > RESYNC_SPREAD_NS:
            self._refused[kind] = row = _Refused(now_ns, now_ns, offset_ns)
        row.last_ns = now_ns
        row.count += 1
        if row.count >= RESYNC_MEASUREMENTS and now_ns - row.since_ns >= RESYNC_NS:
            self.lost = "stamps fell back"

    def _believed(self, k: int, at_ns: int) -> bool:
        """Whether a number of the plant agrees with the running one, or with the one set aside; or set it aside."""
        if self._number is None or self._count(self._number, at_ns) == k:
            return True
        doubted = self._doubted
        if doubted is None or self._count(doubted, at_ns) != k:
            self._doubted = (k, at_ns)
            return False
        return doubted[0] != k  # a copy of that message confirms nothing

    def _fell_back(self, k: int, at_ns: int) -> bool:
        """Whether the track is lost with this number: samples would get numbers well below those given."""
        if self._last_j is None or self.newest_ns is None:
            return False
        if self._number is None:  # the clock has stepped: stamps from before it count nothing
            if k < self._last_j - OVERTAKEN_NS // self._Ts_ns:
                self.lost = "plant restarted"
        elif max(k, self._count((k, at_ns), self.newest_ns)) < self._last_j - self._slip:
            self.lost = "sample numbers fell back"
        return bool(self.lost)

    # Stamps

    def _note(self, message: Measurement, t_ns: int, now_ns: int) -> None:
        """Note that a message has come, and what its stamp tells of the plant's time."""
        self._seen_ns = t_ns
        if isinstance(message, Attitude):
            self._alpha.attitude(now_ns)
            return
        self._alpha.angle(now_ns)
        if self.newest_ns is None and not self._settled:
            self._move(t_ns)

    def _stamp_ns(self, message: Measurement, peer_ns: int | None) -> int:
        if not isinstance(message, AoaSsa):
            return self._unwrap_ms(message.time_boot_ms, peer_ns)
        near_ns = self._near_ns(peer_ns)
        if message.time_usec >= U32 or near_ns is None:
            return message.time_usec * NS_PER_US
        return _nearest(message.time_usec, near_ns // NS_PER_US, U32) * NS_PER_US

    def _unwrap_ms(self, time_boot_ms: int, peer_ns: int | None) -> int:
        """Return a stamp in ns, in the turn of the counter that is nearest to the plant's time."""
        near_ns = self._near_ns(peer_ns)
        if near_ns is not None:
            time_boot_ms = _nearest(time_boot_ms, near_ns // NS_PER_MS, U32)
        return time_boot_ms * NS_PER_MS

    def _near_ns(self, peer_ns: int | None) -> int | None:
        """Return the plant's time as well as it is known: its clock, else the newest sample, else any stamp."""
        if peer_ns is not None:
            return peer_ns
        return self.newest_ns if self.newest_ns is not None else self._seen_ns

    def _settle(self, peer_ns: int) -> None:
        """Now that the plant's time is known, move what was stamped before to it."""
        self._settled = True
        self._move(peer_ns)

    def _move(self, near_ns: int) -> None:
        """Move every stamp by the turns of the counter that bring it nearest to ``near_ns``."""
        for pending in self._pending:
            pending.t_ns = _nearest(pending.t_ns, near_ns, TURN_NS)
        if self.newest_ns is not None:
            self.newest_ns = _nearest(self.newest_ns, near_ns, TURN_NS)
        if self._number is not None:
            self._number = (self._number[0], _nearest(self._number[1], near_ns, TURN_NS))
        if self._doubted is not None:
            self._doubted = (self._doubted[0], _nearest(self._doubted[1], near_ns, TURN_NS))
        if self._first is not None:
            self._first = (self._first[0], _nearest(self._first[1], near_ns, TURN_NS))
        if self._waiting is not None:
            self._waiting = self._waiting._replace(t_ns=_nearest(self._waiting.t_ns, near_ns, TURN_NS))

    # Samples

    def _pair(self, message: Measurement, t_ns: int, half_ns: int) -> _Pending | None:
        """Put a measurement with its other half; return the sample's parts when all are there."""
        for pending in self._pending:
            if abs(pending.t_ns - t_ns) < half_ns:
                if type(message) in pending.parts:
                    self.drops[Drop.DUPLICATE] += 1
                    return None
                pending.parts[type(message)] = message
                if isinstance(message, AoaSsa):
                    pending.t_ns = t_ns  # the finer of the two
                break
        else:
            pending = _Pending(t_ns, {type(message): message})
            self._pending.append(pending)
            if len(self._pending) > MAX_PENDING:
                oldest = self._pending.pop(0)
                self.drops[Drop.HALF] += len(oldest.parts)
        if len(pending.parts) < (1 if self._alpha.source is AlphaSource.VFR_HUD else len(self.needed)):
            return None
        for older in [p for p in self._pending if p.t_ns <= pending.t_ns]:
            self._pending.remove(older)
            if older is not pending:
                self.drops[Drop.HALF] += len(older.parts)
        return pending

    def _whole(self, complete: _Pending, alpha_rad: float | None) -> Sample:
        """Return the sample that is complete, not numbered yet; with ``alpha_rad`` where AOA_SSA is not its part."""
        parts = complete.parts
        x = [
            getattr(parts[sensor.message], sensor.field) / sensor.to_field
            if alpha_rad is None or sensor.message is Attitude
            else alpha_rad
            for sensor in self._sensors
        ]
        return Sample(0, complete.t_ns, tuple(x), tuple(parts.values()), self._alpha.source)

    def _numbered(self, whole: Sample, now_ns: int) -> Sample | None:
        """Return a complete sample with its number, or keep it until there is one."""
        self.newest_ns = whole.t_ns
        self._refused.clear()
        if self._number is None:
            if self._first is None:
                self._first = (now_ns, whole.t_ns)
            since_ns, first_ns = self._first
            if now_ns - since_ns < NUMBER_WAIT_NS:
                self._waiting = whole
                return None
            self._number = (0 if self._last_j is None else self._last_j + 1, first_ns)
        return self._counted(whole)

    def _counted(self, whole: Sample) -> Sample | None:
        """Return the sample with its number; None when the track is lost, as that is well below one given before."""
        assert self._number is not None
        j = self._count(self._number, whole.t_ns)
        if self._last_j is not None and j < self._last_j - self._slip:
            self.lost = "sample numbers fell back"
            return None
        self._last_j = j if self._last_j is None else max(j, self._last_j)
        return Sample(j, whole.t_ns, whole.x, whole.parts, whole.alpha)

    def _count(self, number: tuple[int, int], t_ns: int) -> int:
        """Return the number at a stamp, which is good to a millisecond."""
        k, at_ns = number
        return k + round((t_ns - at_ns) / self._Ts_ns)
