"""Links as text: the SPEC grammar.

``delay=25ms,jitter=uniform:28ms,loss=0.1`` is one direction of a link, :class:`~sitl.link.impairment.LinkSpec`.
To add a keyword: a field there, and a line of ``_KEYWORDS`` here.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, fields
from decimal import Decimal
from typing import Any

from autopilot.link.clock import NS_PER_MS, NS_PER_S, NS_PER_US
from gains.table import InputError
from sitl.link.impairment import MAX_QUEUED, Corruption, LinkSpec
from sitl.link.interruptions import MIN_MEAN_NS, Fading, Handover, Slots, Window
from sitl.link.jitters import (
    JITTERS,
    GammaJitter,
    Jitter,
    NormalJitter,
    ParetoJitter,
    ParetoNormalJitter,
    TableJitter,
    UniformJitter,
)
from sitl.link.losses import LOSSES, Loss
from sitl.link.tracefiles import load_table, load_trace

__all__ = ["MAX_RATE_BPS", "MAX_TIME_NS", "format_spec", "parse_spec"]

MAX_TIME_NS = 1_000_000 * NS_PER_S
"""The longest time a SPEC may hold (11.6 days): exact in a double too."""

MAX_RATE_BPS = 10**12
"""The highest rate a SPEC may hold, bit/s."""

MAX_CORRUPT_BITS = 1000
"""Bits flipped in one packet."""

MAX_SLOT_PACKETS = 1_000_000

_SCALED: Mapping[str, type[UniformJitter | NormalJitter | GammaJitter | ParetoJitter | ParetoNormalJitter]] = {
    "uniform": UniformJitter,
    "normal": NormalJitter,
    "gamma": GammaJitter,
    "pareto": ParetoJitter,
    "paretonormal": ParetoNormalJitter,
}
"""Jitter models that one time scales."""

_SHAPES = {"gamma": (0.01, 1000.0), "pareto": (1.01, 1000.0)}
"""Those that have a shape too, and its range."""

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


def _parse_count(text: str, maximum: int, least: int = 1) -> int:
    value = int(text) if text.isascii() and text.isdigit() and len(text) <= 10 else -1
    if not least <= value <= maximum:
        raise _Expected(f"a whole number from {least} to {maximum}")
    return value


def _parse_corruption(text: str) -> Corruption:
    probability, colon, bits = text.partition(":")
    return Corruption(_parse_probability(probability), _parse_count(bits, MAX_CORRUPT_BITS) if colon else 1)


def _format_corruption(corruption: Corruption) -> str:
    bits = f":{corruption.bits}" if corruption.bits > 1 else ""
    return f"{corruption.probability!r}{bits}"


def _parse_times(text: str, expected: str, least: int, most: int) -> list[int]:
    """Return some times, separated by colons."""
    times = text.split(":")
    if not least <= len(times) <= most:
        raise _Expected(expected)
    try:
        return [_parse_time_ns(time) for time in times]
    except _Expected:
        raise _Expected(expected) from None


def _format_times(*times_ns: int) -> str:
    return ":".join(map(_format_time, times_ns))


def _parse_window(text: str) -> Window:
    expected = "START:LENGTH, as in 3s:2s, or START:LENGTH:EVERY with EVERY above LENGTH"
    window = Window(*_parse_times(text, expected, 2, 3))
    if text.count(":") == 2 and window.every_ns <= window.length_ns:
        raise _Expected(expected)
    return window


def _format_window(window: Window) -> str:
    return _format_times(*(window if window.every_ns else window[:2]))


def _parse_handover(text: str) -> Handover:
    expected = f"EVERY:LENGTH with EVERY at least {_format_time(MIN_MEAN_NS)}, as in 20s:80ms"
    every_ns, length_ns = _parse_times(text, expected, 2, 2)
    if every_ns < MIN_MEAN_NS:
        raise _Expected(expected)
    return Handover(every_ns, length_ns)


def _parse_fading(text: str) -> Fading:
    least = _format_time(MIN_MEAN_NS)
    expected = f"GOOD:BAD:EXTRA[:LOSS], three times, the first two at least {least}, as in 5s:500ms:80ms:0.05"
    *times, last = text.split(":")
    try:
        if len(times) == 3:
            good_ns, bad_ns, extra_ns = _parse_times(":".join(times), expected, 3, 3)
            loss = _parse_probability(last, expected)
        else:
            (good_ns, bad_ns, extra_ns), loss = _parse_times(text, expected, 3, 3), 0.0
    except _Expected:
        raise _Expected(expected) from None
    if min(good_ns, bad_ns) < MIN_MEAN_NS:
        raise _Expected(expected)
    return Fading(good_ns, bad_ns, extra_ns, loss)


def _format_fading(fading: Fading) -> str:
    loss = f":{fading.loss!r}" if fading.loss else ""
    return _format_times(fading.good_ns, fading.bad_ns, fading.extra_ns) + loss


def _parse_slots(text: str) -> Slots:
    period, colon, packets = text.partition(":")
    period_ns = _parse_time_ns(period)
    if period_ns == 0:
        raise _Expected("PERIOD above 0, or PERIOD:PACKETS, as in 20ms:4")
    return Slots(period_ns, _parse_count(packets, MAX_SLOT_PACKETS) if colon else 0)


def _format_slots(slots: Slots) -> str:
    return _format_time(slots.period_ns) + (f":{slots.packets}" if slots.packets else "")


def _parse_correlation(text: str) -> float:
    expected = "a correlation from 0 to below 1"
    rho = _parse_probability(text, expected)
    if rho == 1.0:
        raise _Expected(expected)
    return rho


def _jitter_grammar(name: str) -> str:
    return f"{name}:FILE" if name == "table" else f"{name}:TIME" + ("[:SHAPE]" if name in _SHAPES else "")


def _parse_jitter(text: str) -> Jitter:
    name, colon, argument = text.partition(":")
    if not colon or name not in JITTERS:
        raise _Expected(f"one of {', '.join(map(_jitter_grammar, JITTERS))}, as in uniform:28ms")
    if name == "table":
        return TableJitter(argument, load_table(argument))
    scale, shaped, shape = argument.partition(":")
    scale_ns = _parse_time_ns(scale)
    if not shaped:
        return _SCALED[name](scale_ns)
    if name not in _SHAPES:
        raise _Expected(_jitter_grammar(name))
    return _SCALED[name](scale_ns, _parse_shape(name, shape))  # type: ignore[call-arg]  # those with a shape


def _parse_shape(name: str, text: str) -> float:
    low, high = _SHAPES[name]
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not low <= value <= high or not text.isascii() or "_" in text:
        raise _Expected(f"{_jitter_grammar(name)} with a shape from {low:g} to {high:g}")
    return value


def _format_jitter(jitter: Jitter) -> str:
    name = next(name for name, model in JITTERS.items() if type(jitter) is model)
    match jitter:
        case TableJitter(source=source):
            return f"{name}:{source}"
        case GammaJitter(shape=shape) | ParetoJitter(shape=shape) if jitter != type(jitter)(jitter.scale_ns):
            return f"{name}:{_format_time(jitter.scale_ns)}:{shape!r}"
        case _:
            assert isinstance(jitter, UniformJitter | NormalJitter | GammaJitter | ParetoJitter | ParetoNormalJitter)
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
    probabilities = [_parse_probability(value, expected) for value in values]
    try:
        return LOSSES[name](*probabilities)
    except ValueError as error:
        raise _Expected(f"{expected}, {error}") from None


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
    "corr": _Keyword("correlation", _parse_correlation, repr),
    "loss": _Keyword("loss", _parse_loss, _format_loss),
    "dup": _Keyword("dup", _parse_probability, repr),
    "reorder": _Keyword("reorder", _parse_probability, repr),
    "gap": _Keyword("gap", lambda text: _parse_count(text, 1_000_000), str),
    "corrupt": _Keyword("corruption", _parse_corruption, _format_corruption),
    "order": _Keyword("keep_order", _parse_order, lambda _: "keep"),
    "rate": _Keyword("rate_bps", _parse_rate_bps, lambda bps: _format_quantity(bps, _RATE_UNITS)),
    "limit": _Keyword("limit", lambda text: _parse_count(text, MAX_QUEUED), str),
    "slot": _Keyword("slots", _parse_slots, _format_slots),
    "blackout": _Keyword("blackouts", _parse_window, _format_window, repeats=True),
    "hold": _Keyword("holds", _parse_window, _format_window, repeats=True),
    "handover": _Keyword("handover", _parse_handover, lambda h: _format_times(h.every_ns, h.length_ns)),
    "fade": _Keyword("fading", _parse_fading, _format_fading),
    "trace": _Keyword("trace", load_trace, lambda trace: trace.source),
}
_PERFECT = LinkSpec()

_NEEDED = {"corr": "jitter", "gap": "reorder"}
"""Keywords that say nothing without another one."""


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
    for name, needed in _NEEDED.items():
        if _KEYWORDS[name].field in fields and _KEYWORDS[needed].field not in fields:
            raise InputError(f"{where}: {name}: expected {needed}=… beside it, found none")
    return LinkSpec(**fields)


def format_spec(spec: LinkSpec) -> str:
    """Return the SPEC of a direction; the inverse of :func:`parse_spec`."""
    items: list[str] = []
    said = {
        name for name, keyword in _KEYWORDS.items() if getattr(spec, keyword.field) != getattr(_PERFECT, keyword.field)
    }
    said |= {needed for name, needed in _NEEDED.items() if name in said}
    for name, keyword in _KEYWORDS.items():
        if name in said:
            value = getattr(spec, keyword.field)
            values = value if keyword.repeats else (value,)
            items.extend(f"{name}={keyword.format(each)}" for each in values)
    return ",".join(items) or "delay=0ns"
