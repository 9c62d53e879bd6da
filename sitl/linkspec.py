"""Links as text: the SPEC grammar, and presets by name.

``delay=25ms,jitter=uniform:28ms,loss=0.1`` is one direction of a link, :class:`~sitl.impairment.LinkSpec`.
To add a keyword: a field there, and a line of ``_KEYWORDS`` here.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, fields
from decimal import Decimal
from types import MappingProxyType
from typing import Any

from autopilot.link.clock import NS_PER_MS, NS_PER_S, NS_PER_US
from gains.table import InputError
from sitl.impairment import JITTERS, LOSSES, Jitter, LinkSpec, Loss, UniformJitter

__all__ = ["MAX_RATE_BPS", "MAX_TIME_NS", "PRESETS", "format_spec", "parse_link", "parse_spec"]

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


def _parse_probability(text: str, expected: str = "a probability from 0 to 1") -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not text.isascii() or "_" in text:  # which float takes
        value = -1.0
    if not 0.0 <= value <= 1.0:
        raise _Expected(expected)
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
    return JITTERS[name](_parse_time_ns(argument))


def _format_jitter(jitter: Jitter) -> str:
    name = next(name for name, model in JITTERS.items() if type(jitter) is model)
    return f"{name}:{_format_time(jitter.scale_ns)}"


def _loss_grammar(name: str) -> str:
    """Return how a loss model is written, as in ``ge:P:R[:BAD[:GOOD]]``."""
    needed = [parameter.name.upper() for parameter in fields(LOSSES[name]) if parameter.default is MISSING]
    others = [parameter.name.upper() for parameter in fields(LOSSES[name]) if parameter.default is not MISSING]
    return ":".join([name, *needed]) + "".join(f"[:{other}" for other in others) + "]" * len(others)


def _parse_loss(text: str) -> float | Loss:
    name, *values = text.split(":")
    if name not in LOSSES:
        return _parse_probability(text, f"a probability from 0 to 1 or {', '.join(map(_loss_grammar, LOSSES))}")
    expected = f"{_loss_grammar(name)}, each a probability from 0 to 1"
    parameters = fields(LOSSES[name])
    least = sum(parameter.default is MISSING for parameter in parameters)
    if not least <= len(values) <= len(parameters):
        raise _Expected(expected)
    return LOSSES[name](*(_parse_probability(value, expected) for value in values))


def _format_loss(loss: float | Loss) -> str:
    if not isinstance(loss, Loss):
        return repr(loss)
    name = next(name for name, model in LOSSES.items() if type(loss) is model)
    parameters = list(fields(loss))
    while parameters and getattr(loss, parameters[-1].name) == parameters[-1].default:
        parameters.pop()
    return ":".join([name, *(repr(getattr(loss, parameter.name)) for parameter in parameters)])


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
    "loss": _Keyword("loss", _parse_loss, _format_loss),
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
_LOSSY = LinkSpec(delay_ns=5 * NS_PER_MS, jitter=UniformJitter(28 * NS_PER_MS), loss=0.03, dup=0.01)

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
that a loop takes 10 to 66 ms and, sampled at Ts = 25 ms, spans d = 1..3; ``lossy`` adds to it 3 % loss
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
