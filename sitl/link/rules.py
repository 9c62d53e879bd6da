"""Rules: messages of certain kinds meet another link than the rest of their direction.

``up:ATTITUDE+AOA_SSA:delay=40ms,loss=0.5`` is a rule: a direction, the messages by name or number, and the SPEC that
every datagram meets which holds a frame of one of them. Which messages a datagram holds is read from its headers, of
either version of MAVLink; no checksum is looked at, since a link does not know checksums either.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

from autopilot.link.codecs import message_ids
from gains.table import InputError
from sitl.link.impairment import LinkSpec
from sitl.link.spec import format_spec, parse_spec

__all__ = ["MAX_FRAMES", "MAX_RULES", "WAYS", "Rule", "Way", "format_rule", "parse_rule", "rule_finder"]

Way = Literal["up", "down"]

WAYS: tuple[Way, ...] = get_args(Way)

MAX_RULES = 16
"""Rules of one link, as each may have a queue of its own."""

MAX_FRAMES = 64
"""Frames of one datagram whose headers are read: what a datagram costs is bounded."""

_V2, _V1 = 0xFD, 0xFE
_SIGNED = 0x01
_V2_BYTES, _V1_BYTES, _SIGNATURE_BYTES = 12, 8, 13
"""What a frame has beside its payload: header and checksum; and the signature."""


@dataclass(frozen=True, slots=True)
class Rule:
    """Another link for certain messages.

    Attributes
    ----------
    way : str
        The direction, ``up`` or ``down``.
    messages : str
        The messages as they were given, names or numbers joined by ``+``.
    ids : frozenset of int
        Their numbers.
    spec : LinkSpec
        What their datagrams meet.
    """

    way: Way
    messages: str
    ids: frozenset[int]
    spec: LinkSpec


def parse_rule(text: str) -> Rule:
    """Return the rule written as ``WAY:MESSAGE[+MESSAGE...]:SPEC``.

    Raises
    ------
    InputError
        For anything else, in one line.
    """
    way, _, rest = text.partition(":")
    messages, colon, spec = rest.partition(":")
    if way not in WAYS or not colon:
        raise InputError(f'rule "{text}": expected up:MESSAGE+MESSAGE:SPEC or down:..., as in up:ATTITUDE:delay=40ms')
    try:
        return Rule(way, messages, message_ids(messages.split("+")), parse_spec(spec))
    except InputError as error:
        raise InputError(f'rule "{text}": {error}') from None


def format_rule(rule: Rule) -> str:
    """Return the text of a rule; the inverse of :func:`parse_rule`."""
    return f"{rule.way}:{rule.messages}:{format_spec(rule.spec)}"


def rule_finder(rules: Sequence[Rule]) -> Callable[[bytes], int | None]:
    """Return what finds the first of the rules that applies to a datagram: its index, None when none does.

    Parameters
    ----------
    rules : sequence of Rule
        Those of one direction.
    """
    first: dict[int, int] = {}
    for index, rule in enumerate(rules):
        for number in rule.ids:
            first.setdefault(number, index)

    def find(datagram: bytes) -> int | None:
        found: int | None = None
        start = 0
        for _ in range(MAX_FRAMES):
            head = _head(datagram, start)
            if head is None:
                break
            number, length = head
            index = first.get(number)
            if index is not None and (found is None or index < found):
                found = index
            start += length
        return found

    return find


def _head(datagram: bytes, start: int) -> tuple[int, int] | None:
    """Return message number and length of the frame that begins there; None when no whole frame does."""
    room = len(datagram) - start
    if room >= _V2_BYTES and datagram[start] == _V2:
        flags = datagram[start + 2]
        if flags & ~_SIGNED:
            return None  # a receiver must drop such a frame, as it cannot know what follows
        length = _V2_BYTES + datagram[start + 1] + (_SIGNATURE_BYTES if flags else 0)
        number = datagram[start + 7] | datagram[start + 8] << 8 | datagram[start + 9] << 16
    elif room >= _V1_BYTES and datagram[start] == _V1:
        length, number = _V1_BYTES + datagram[start + 1], datagram[start + 5]
    else:
        return None
    return (number, length) if length <= room else None
