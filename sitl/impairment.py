"""What a link does to packets: seeded, pure models, and the SPEC grammar that names them.

A :class:`LinkSpec` is one direction as data; :func:`parse_spec` reads it from
``delay=25ms,jitter=uniform:28ms,loss=0.1``. An :class:`Impairment` is that direction in operation. Its
times are *link time*: nanoseconds since the first packet entered the link in either direction.

One packet meets, in this order:

1. loss: gone, with no airtime used (as netem, which drops before it queues);
2. blackout: a radio that is out neither takes nor delivers, so a packet is dropped if it enters during
   ``[start, start + duration)``, and so is a copy whose exit would fall inside;
3. duplication: a second copy, which then takes its own turn through the rest;
4. room: a copy the queue has no room for is refused, with no airtime used;
5. reordering, as netem: with this probability a copy skips rate, delay and jitter, leaves at once and
   overtakes the queue;
6. rate: a copy waits until the one before is serialised, then takes ``8 size / rate``; size is that of
   the datagram handed in, without headers;
7. delay plus jitter, never below 0 together;
8. ``order=keep``: no copy leaves before one that left the stages above earlier. It wins over
   reordering: such a copy leaves as early as order allows.

Randomness: every feature draws from a stream of its own (loss, duplication; reordering and jitter of the
first copy; the same of the second), one value per packet whatever became of the packets before and
whatever becomes of this one. The n-th packet's jitter is therefore the same with loss and without,
at 1 % and at 10 %: flights under different links compare packet by packet.

To add a jitter model, write a class and register it with ``@_jitter``; to add a keyword, a field of
:class:`LinkSpec` and a line of ``_KEYWORDS``.

References
----------
S. Hemminger, "Network Emulation with NetEm", linux.conf.au 2005; tc-netem(8);
Linux ``net/sched/sch_netem.c``.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from decimal import Decimal
from enum import StrEnum
from types import MappingProxyType
from typing import Any, NamedTuple, Self, TypeVar

import numpy as np

from autopilot.link.clock import NS_PER_MS, NS_PER_S, NS_PER_US
from gains.table import InputError

__all__ = [
    "JITTERS",
    "MAX_RATE_BPS",
    "MAX_TIME_NS",
    "PRESETS",
    "Copy",
    "Fate",
    "GammaJitter",
    "Impairment",
    "Jitter",
    "LinkSpec",
    "NormalJitter",
    "UniformJitter",
    "format_spec",
    "parse_link",
    "parse_spec",
]

MAX_TIME_NS = 1_000_000 * NS_PER_S
"""The longest time a SPEC may hold (11.6 days): exact in a double too."""

MAX_RATE_BPS = 10**12
"""The highest rate a SPEC may hold, bit/s."""

_TIME_UNITS = {"s": NS_PER_S, "ms": NS_PER_MS, "us": NS_PER_US, "ns": 1}
_RATE_UNITS = {"Mbps": 10**6, "kbps": 10**3, "bps": 1}
_QUANTITY = re.compile(r"([0-9]{1,20}(?:\.[0-9]{1,20})?)([A-Za-z]+)")


class _Expected(ValueError):
    """What a value should have been; :func:`parse_spec` puts the rest of the message around it."""


def _parse_quantity(text: str, units: Mapping[str, int], maximum: int, expected: str) -> int:
    """Return a number with its unit as a whole number of the smallest unit, exactly."""
    match = _QUANTITY.fullmatch(text)
    if match is None or match[2] not in units:
        raise _Expected(expected)
    value = Decimal(match[1]) * units[match[2]]
    if value != int(value) or value > maximum:
        raise _Expected(expected)
    return int(value)


def _format_quantity(value: int, units: Mapping[str, int]) -> str:
    """Return the value in the largest unit that holds it as a whole number."""
    unit = next(unit for unit, size in units.items() if value % size == 0)
    return f"{value // units[unit]}{unit}"


def _parse_time_ns(text: str) -> int:
    expected = f"a time with its unit ({', '.join(_TIME_UNITS)}) up to {MAX_TIME_NS // NS_PER_S}s"
    return _parse_quantity(text, _TIME_UNITS, MAX_TIME_NS, expected)


def _format_time(time_ns: int) -> str:
    return _format_quantity(time_ns, _TIME_UNITS)


@dataclass(frozen=True, slots=True)
class Jitter(ABC):
    """A distribution of the time added to the delay, with one scale. A model with more reads it itself.

    Attributes
    ----------
    scale_ns : int
        Width, standard deviation or mean, as the model says.
    """

    scale_ns: int

    @classmethod
    def parse(cls, argument: str) -> Self:
        """Return the model from what follows ``name:`` in a SPEC."""
        return cls(_parse_time_ns(argument))

    def argument(self) -> str:
        """Return what :meth:`parse` reads."""
        return _format_time(self.scale_ns)

    @abstractmethod
    def sampler(self, rng: np.random.Generator) -> Callable[[], float]:
        """Return a source of jitter in ns. It owns ``rng``; a correlated model keeps its state in it."""


_MODELS: dict[str, type[Jitter]] = {}

JITTERS: Mapping[str, type[Jitter]] = MappingProxyType(_MODELS)
"""Jitter models by their name in a SPEC."""

_J = TypeVar("_J", bound=Jitter)


def _jitter(name: str) -> Callable[[type[_J]], type[_J]]:
    """Register a model under its name in a SPEC."""

    def register(model: type[_J]) -> type[_J]:
        assert name not in _MODELS
        _MODELS[name] = model
        return model

    return register


@_jitter("uniform")
@dataclass(frozen=True, slots=True)
class UniformJitter(Jitter):
    """Jitter U[0, W]; the scale is the width W."""

    def sampler(self, rng: np.random.Generator) -> Callable[[], float]:
        """Return a source of U[0, W]."""
        random, width_ns = rng.random, float(self.scale_ns)
        return lambda: width_ns * random()


@_jitter("normal")
@dataclass(frozen=True, slots=True)
class NormalJitter(Jitter):
    """Jitter N(0, S²); the scale is S. A sum of delay and jitter below 0 becomes 0 and raises the mean."""

    def sampler(self, rng: np.random.Generator) -> Callable[[], float]:
        """Return a source of N(0, S²)."""
        normal, sigma_ns = rng.standard_normal, float(self.scale_ns)
        return lambda: sigma_ns * normal()


@_jitter("gamma")
@dataclass(frozen=True, slots=True)
class GammaJitter(Jitter):
    """Jitter Gamma(2, M / 2): two exponential waits in a row; the scale is the mean M."""

    def sampler(self, rng: np.random.Generator) -> Callable[[], float]:
        """Return a source of Gamma(2, M / 2)."""
        gamma, half_ns = rng.standard_gamma, self.scale_ns / 2.0
        return lambda: half_ns * gamma(2.0)


@dataclass(frozen=True, slots=True)
class LinkSpec:
    """One direction of a link, as data. The default impairs nothing.

    Attributes
    ----------
    delay_ns : int
        Constant delay.
    jitter : Jitter or None
        Distribution of the time added to the delay.
    loss, dup, reorder : float
        Probabilities per packet (reorder: per copy), from 0 to 1.
    keep_order : bool
        Whether packets leave in the order in which they entered.
    rate_bps : int or None
        Serialisation rate, bit/s.
    blackouts : tuple of (start_ns, duration_ns)
        When the link is out, in link time; they may overlap.
    """

    delay_ns: int = 0
    jitter: Jitter | None = None
    loss: float = 0.0
    dup: float = 0.0
    reorder: float = 0.0
    keep_order: bool = False
    rate_bps: int | None = None
    blackouts: tuple[tuple[int, int], ...] = ()

    def __post_init__(self) -> None:
        assert self.delay_ns >= 0
        assert all(0.0 <= probability <= 1.0 for probability in (self.loss, self.dup, self.reorder))
        assert self.rate_bps is None or self.rate_bps > 0
        assert all(start_ns >= 0 and duration_ns >= 0 for start_ns, duration_ns in self.blackouts)

    def is_out(self, link_ns: int) -> bool:
        """Return whether a blackout covers this instant of link time."""
        return any(start_ns <= link_ns < start_ns + length_ns for start_ns, length_ns in self.blackouts)


class Fate(StrEnum):
    """What became of one copy of a packet."""

    DELIVERED = "delivered"
    LOST = "lost"
    BLACKOUT = "blackout"
    REFUSED = "refused"


class Copy(NamedTuple):
    """One copy of a packet: its fate, and when (link time, ns) it leaves or is dropped."""

    fate: Fate
    exit_ns: int


class Impairment:
    """One direction of a link in operation: a :class:`LinkSpec` and the state it needs.

    Parameters
    ----------
    spec : LinkSpec
        What the direction does.
    rng : numpy.random.Generator
        Where its six streams are spawned from; none of its own values is drawn.
    """

    def __init__(self, spec: LinkSpec, rng: np.random.Generator) -> None:
        self.spec = spec
        loss, dup, *rest = rng.spawn(6)
        self._loss, self._dup = loss.random, dup.random
        self._reorder = (rest[0].random, rest[1].random)
        jitter = spec.jitter
        self._jitter = None if jitter is None else (jitter.sampler(rest[2]), jitter.sampler(rest[3]))
        self._busy = 0
        """When the serialiser is free, in 1/rate ns of link time: integers, so that no error adds up."""
        self._last_exit_ns = 0

    def schedule(self, size_bytes: int, now_ns: int) -> tuple[int, ...]:
        """Return when the copies of a packet that enters at ``now_ns`` leave; empty if none does."""
        copies = self.step(size_bytes, now_ns)
        return tuple(copy.exit_ns for copy in copies if copy.fate is Fate.DELIVERED)

    def step(self, size_bytes: int, now_ns: int, room: int = 2) -> tuple[Copy, ...]:
        """Take one packet and return its copies with their fates, the original first.

        Parameters
        ----------
        size_bytes : int
            Its size.
        now_ns : int
            When it enters, link time; not before the packet before it.
        room : int
            How many copies the queue can still take.

        Returns
        -------
        tuple of Copy
            One, or two if it was duplicated. A copy in flight that meets a blackout has the instant at
            which it would have left: until then it is in the queue.
        """
        spec = self.spec
        lost = spec.loss > 0.0 and self._loss() < spec.loss
        copies = 1 + (spec.dup > 0.0 and self._dup() < spec.dup)
        flights = [self._draw(which) for which in ((0, 1) if spec.dup > 0.0 else (0,))]
        if lost:
            return (Copy(Fate.LOST, now_ns),)
        if spec.blackouts and spec.is_out(now_ns):
            return (Copy(Fate.BLACKOUT, now_ns),)
        return tuple(
            self._launch(size_bytes, now_ns, flight_ns) if n < room else Copy(Fate.REFUSED, now_ns)
            for n, flight_ns in enumerate(flights[:copies])
        )

    def _draw(self, which: int) -> int | None:
        """Return the delay and jitter of the first (0) or second (1) copy, ns; None: it overtakes."""
        spec = self.spec
        overtakes = spec.reorder > 0.0 and self._reorder[which]() < spec.reorder
        flight_ns = spec.delay_ns
        if self._jitter is not None:
            flight_ns = max(0, flight_ns + round(self._jitter[which]()))
        return None if overtakes else flight_ns

    def _launch(self, size_bytes: int, now_ns: int, flight_ns: int | None) -> Copy:
        """Return the exit of a copy that is neither lost nor refused; occupy the serialiser."""
        spec = self.spec
        exit_ns = now_ns
        if flight_ns is not None:
            if spec.rate_bps is not None:
                self._busy = max(self._busy, now_ns * spec.rate_bps) + 8 * size_bytes * NS_PER_S
                exit_ns = -(-self._busy // spec.rate_bps)
            exit_ns += flight_ns
        if spec.keep_order:
            exit_ns = self._last_exit_ns = max(exit_ns, self._last_exit_ns)
        return Copy(Fate.BLACKOUT if spec.blackouts and spec.is_out(exit_ns) else Fate.DELIVERED, exit_ns)


def _parse_probability(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not text.isascii() or "_" in text:  # which float takes
        value = -1.0
    if not 0.0 <= value <= 1.0:
        raise _Expected("a probability from 0 to 1")
    return value


def _parse_rate_bps(text: str) -> int:
    expected = f"a rate above 0 with its unit ({', '.join(_RATE_UNITS)}) up to {MAX_RATE_BPS}bps"
    rate_bps = _parse_quantity(text, _RATE_UNITS, MAX_RATE_BPS, expected)
    if rate_bps == 0:
        raise _Expected(expected)
    return rate_bps


def _parse_order(text: str) -> bool:
    if text != "keep":
        raise _Expected("keep")
    return True


def _parse_blackout(text: str) -> tuple[int, int]:
    start, colon, duration = text.partition(":")
    if not colon:
        raise _Expected("start:duration, as in 3s:2s")
    return _parse_time_ns(start), _parse_time_ns(duration)


def _parse_jitter(text: str) -> Jitter:
    name, colon, argument = text.partition(":")
    if not colon or name not in JITTERS:
        raise _Expected(f"one of {', '.join(f'{known}:…' for known in JITTERS)}, as in uniform:28ms")
    return JITTERS[name].parse(argument)


def _format_jitter(jitter: Jitter) -> str:
    name = next(name for name, model in JITTERS.items() if type(jitter) is model)
    return f"{name}:{jitter.argument()}"


@dataclass(frozen=True, slots=True)
class _Keyword:
    """A keyword of the SPEC grammar: the field it sets, and its value from and to text."""

    field: str
    parse: Callable[[str], Any]
    format: Callable[[Any], str]
    repeats: bool = False


_KEYWORDS: Mapping[str, _Keyword] = {
    "delay": _Keyword("delay_ns", _parse_time_ns, _format_time),
    "jitter": _Keyword("jitter", _parse_jitter, _format_jitter),
    "loss": _Keyword("loss", _parse_probability, repr),
    "dup": _Keyword("dup", _parse_probability, repr),
    "reorder": _Keyword("reorder", _parse_probability, repr),
    "order": _Keyword("keep_order", _parse_order, lambda _: "keep"),
    "rate": _Keyword("rate_bps", _parse_rate_bps, lambda bps: _format_quantity(bps, _RATE_UNITS)),
    "blackout": _Keyword("blackouts", _parse_blackout, lambda b: ":".join(map(_format_time, b)), repeats=True),
}
_PERFECT = LinkSpec()


def parse_spec(text: str) -> LinkSpec:
    """Return the direction described by a SPEC such as ``delay=25ms,jitter=uniform:28ms,loss=0.1``.

    Raises
    ------
    InputError
        On an unknown or repeated keyword or a value outside its range, in one line.
    """
    where = f'link spec "{text}"'
    fields: dict[str, Any] = {}
    for item in text.split(","):
        name, equals, value = (part.strip() for part in item.partition("="))
        if not equals:
            raise InputError(f"{where}: expected keyword=value, found {item.strip() or 'nothing'}")
        if name not in _KEYWORDS:
            raise InputError(f"{where}: expected a keyword of {', '.join(_KEYWORDS)}, found {name or 'nothing'}")
        keyword = _KEYWORDS[name]
        if keyword.field in fields and not keyword.repeats:
            raise InputError(f"{where}: {name}: expected once, found again with {value or 'nothing'}")
        try:
            parsed = keyword.parse(value)
        except _Expected as error:
            raise InputError(f"{where}: {name}: expected {error}, found {value or 'nothing'}") from None
        fields[keyword.field] = (*fields.get(keyword.field, ()), parsed) if keyword.repeats else parsed
    return LinkSpec(**fields)


def format_spec(spec: LinkSpec) -> str:
    """Return the SPEC of a direction; the inverse of :func:`parse_spec`."""
    items: list[str] = []
    for name, keyword in _KEYWORDS.items():
        value = getattr(spec, keyword.field)
        if value != getattr(_PERFECT, keyword.field):
            values = value if keyword.repeats else (value,)
            items.extend(f"{name}={keyword.format(each)}" for each in values)
    return ",".join(items) or "delay=0ns"


_LAN = LinkSpec(delay_ns=200 * NS_PER_US)
_JITTERY = LinkSpec(delay_ns=5 * NS_PER_MS, jitter=UniformJitter(28 * NS_PER_MS))
_LOSSY = LinkSpec(delay_ns=5 * NS_PER_MS, jitter=UniformJitter(28 * NS_PER_MS), loss=0.1, dup=0.01)

PRESETS: Mapping[str, tuple[LinkSpec, LinkSpec]] = MappingProxyType(
    {
        "perfect": (_PERFECT, _PERFECT),
        "lan": (_LAN, _LAN),
        "jittery": (_JITTERY, _JITTERY),
        "lossy": (_LOSSY, _LOSSY),
    }
)
"""Links (up, down) by name.

``perfect`` impairs nothing; ``lan`` is 0.2 ms each way; ``jittery`` is 5 ms + U[0, 28 ms] each way, so
that a loop takes 10 to 66 ms and, sampled at Ts = 25 ms, spans d = 1..3; ``lossy`` adds to it 10 % loss
and 1 % duplicates.
"""


def parse_link(preset: str | None, up: str | None, down: str | None) -> tuple[LinkSpec, LinkSpec]:
    """Return (up, down) from ``--link``, ``--up`` and ``--down``.

    Parameters
    ----------
    preset : str or None
        A name of :data:`PRESETS` for both directions; None is ``perfect``.
    up, down : str or None
        A SPEC that takes the place of the preset's, per direction.

    Raises
    ------
    InputError
        On an unknown preset, or as :func:`parse_spec`.
    """
    name = "perfect" if preset is None else preset
    if name not in PRESETS:
        raise InputError(f"link preset: expected one of {', '.join(PRESETS)}, found {name or 'nothing'}")
    preset_up, preset_down = PRESETS[name]
    return (
        preset_up if up is None else parse_spec(up),
        preset_down if down is None else parse_spec(down),
    )
