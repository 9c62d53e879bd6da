"""Changes of a link in flight: from an instant of link time on, a direction follows another SPEC.

``3s:up:loss=0.5`` is a change. Whoever changes a link while it runs makes such a change, too, of the present instant;
its text is in the recording and does the same again to the same packets (``--at``).
"""

from __future__ import annotations

from dataclasses import dataclass, field

from gains.table import InputError
from sitl.link.impairment import LinkSpec
from sitl.link.rules import WAYS, Way
from sitl.link.spec import format_spec, parse_spec

__all__ = ["MAX_CHANGES", "Change", "format_change", "format_time", "parse_change", "parse_time_ns"]

MAX_CHANGES = 1000
"""Changes of one direction that wait for their time; more are refused."""


@dataclass(frozen=True, slots=True)
class Change:
    """Another SPEC for one direction.

    Attributes
    ----------
    at_ns : int
        From which link time on; a packet that enters at that instant meets the new SPEC.
    way : str
        The direction, ``up`` or ``down``.
    spec : LinkSpec
        What it follows from then on.
    live : bool
        Whether it was ordered while the link ran, and not before; no part of what the change is.
    """

    at_ns: int
    way: Way
    spec: LinkSpec
    live: bool = field(default=False, compare=False)


def parse_time_ns(text: str, where: str) -> int:
    """Return a time written as in a SPEC, such as ``300us``.

    Raises
    ------
    InputError
        For anything else; ``where`` begins the line.
    """
    try:
        if "," not in text:
            return parse_spec(f"delay={text}").delay_ns
    except InputError:
        pass
    raise InputError(f"{where}: expected a time with its unit (s, ms, us, ns), found {text or 'nothing'}")


def format_time(time_ns: int) -> str:
    """Return the time as :func:`parse_time_ns` reads it."""
    return format_spec(LinkSpec(delay_ns=time_ns)).removeprefix("delay=")


def parse_change(text: str) -> Change:
    """Return the change written as ``TIME:WAY:SPEC``.

    Raises
    ------
    InputError
        For anything else, in one line.
    """
    time, _, rest = text.partition(":")
    way, colon, spec = rest.partition(":")
    if way not in WAYS or not colon:
        raise InputError(f'change "{text}": expected TIME:up:SPEC or TIME:down:SPEC, as in 3s:up:loss=0.5')
    try:
        return Change(parse_time_ns(time, "time"), way, parse_spec(spec))
    except InputError as error:
        raise InputError(f'change "{text}": {error}') from None


def format_change(change: Change) -> str:
    """Return the text of a change; the inverse of :func:`parse_change`."""
    return f"{format_time(change.at_ns)}:{change.way}:{format_spec(change.spec)}"
