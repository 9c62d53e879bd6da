"""Live control of a relay: requests and replies as JSON, one a datagram.

A request is ``{"id": 7, "do": "set", "link": "radio", "up": "loss=0.5"}``; ``link`` may be left out where there is but
one. ``set`` takes ``preset`` for both directions, ``up`` and ``down``, and leaves alone what is not named: all of it
is done, or nothing. ``show`` without a link shows all. The reply is ``{"id": 7, "ok": true, ...}``, or
``{"id": 7, "ok": false, "error": "one line"}``; whoever sends something without a readable id is not answered.

Any program of this machine can send requests, so a SPEC that names a file is refused: a relay must not read files for
strangers. Nothing here does any I/O, and nothing that was sent makes it raise.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import orjson

from gains.table import InputError
from sitl.link.impairment import LinkSpec
from sitl.link.presets import parse_link
from sitl.link.rules import Way

__all__ = [
    "DEFAULT_CONTROL",
    "MAX_REPLY_BYTES",
    "MAX_REQUEST_BYTES",
    "Refused",
    "Request",
    "Set",
    "Show",
    "decode_reply",
    "decode_request",
    "encode_refusal",
    "encode_reply",
    "encode_request",
]

DEFAULT_CONTROL = "127.0.0.1:14602"
"""Where a relay takes requests that is not told another address, and where they are sent."""

MAX_REQUEST_BYTES = 4096
MAX_REPLY_BYTES = 60_000
"""What fits into a datagram on the loopback."""

MAX_ID = (1 << 53) - 1
"""The largest id: every JSON reader holds it exactly."""


@dataclass(frozen=True, slots=True)
class Set:
    """Change a link.

    Attributes
    ----------
    id : int
        Of the request.
    link : str or None
        Its name; None for the only one.
    specs : mapping of Way to LinkSpec
        The directions that change, at least one.
    """

    id: int
    link: str | None
    specs: Mapping[Way, LinkSpec]


@dataclass(frozen=True, slots=True)
class Show:
    """Tell what a link does, and has done; ``link`` None for all."""

    id: int
    link: str | None


@dataclass(frozen=True, slots=True)
class Refused:
    """What was no request: its id, None where there was none to be read, and what is wrong, in one line."""

    id: int | None
    error: str


Request = Set | Show


def encode_request(id_: int, do: str, **fields: str | None) -> bytes:
    """Return a request; fields that are None are left out."""
    return orjson.dumps({"id": id_, "do": do} | {name: text for name, text in fields.items() if text is not None})


def decode_request(datagram: bytes) -> Request | Refused:
    """Return the request in a datagram, or why it is none."""
    if len(datagram) > MAX_REQUEST_BYTES:
        return Refused(None, f"expected at most {MAX_REQUEST_BYTES} bytes, found {len(datagram)}")
    try:
        content = orjson.loads(datagram)
    except ValueError as error:
        return Refused(None, f"expected JSON, found: {error}")
    if not isinstance(content, dict):
        return Refused(None, "expected an object")
    id_ = content.get("id")
    if type(id_) is not int or not 0 <= id_ <= MAX_ID:
        return Refused(None, f"id: expected a whole number from 0 to {MAX_ID}")
    try:
        do = content.get("do")
        if type(do) is not str or do not in _REQUESTS:
            raise InputError(f"do: expected one of {', '.join(_REQUESTS)}, found {_shown(do)}")
        known, read = _REQUESTS[do]
        return read(id_, _fields(content, known))
    except InputError as error:
        return Refused(id_, str(error))


def encode_reply(id_: int, answer: Mapping[str, Any]) -> bytes:
    """Return the reply to a request that was carried out, or the refusal of one that cannot be sent."""
    reply = orjson.dumps({"id": id_, "ok": True, **answer})
    if len(reply) > MAX_REPLY_BYTES:
        return encode_refusal(id_, f"reply: expected at most {MAX_REPLY_BYTES} bytes, found more: ask for one link")
    return reply


def encode_refusal(id_: int, error: str) -> bytes:
    """Return the reply to a request that was refused."""
    return orjson.dumps({"id": id_, "ok": False, "error": error})


def decode_reply(datagram: bytes, id_: int) -> dict[str, Any] | None:
    """Return the reply to a request; None when the datagram is none.

    Raises
    ------
    InputError
        When the request was refused; with what the relay says.
    """
    try:
        reply = orjson.loads(datagram)
    except ValueError:
        return None
    if not isinstance(reply, dict) or reply.get("id") != id_:
        return None
    if reply.get("ok") is not True:
        raise InputError(str(reply.get("error", "refused")))
    return reply


def _fields(content: Mapping[str, Any], known: tuple[str, ...]) -> dict[str, str]:
    """Return the fields of a request beside its id and what to do; all are text."""
    fields = {name: value for name, value in content.items() if name not in ("id", "do")}
    for name, value in fields.items():
        if name not in known:
            raise InputError(f"expected one of id, do, {', '.join(known)}, found {_shown(name)}")
        if not isinstance(value, str):
            raise InputError(f"{name}: expected text, found {_shown(value)}")
    return fields


def _set(id_: int, fields: Mapping[str, str]) -> Set:
    preset, texts = fields.get("preset"), {way: fields.get(way) for way in ("up", "down")}
    if preset is None and not any(text is not None for text in texts.values()):
        raise InputError("set: expected at least one of preset, up, down, found none")
    for way, text in texts.items():
        if text is not None:
            _refuse_files(way, text)
    up, down = parse_link(preset, texts["up"], texts["down"])
    specs: dict[Way, LinkSpec] = {}
    if preset is not None or texts["up"] is not None:
        specs["up"] = up
    if preset is not None or texts["down"] is not None:
        specs["down"] = down
    return Set(id_, fields.get("link"), specs)


def _refuse_files(way: str, text: str) -> None:
    """Refuse a SPEC that names a file, before anything looks at it."""
    for item in text.split(","):
        name, _, value = (part.strip() for part in item.partition("="))
        if name == "trace" or value.partition(":")[0].strip() == "table":
            raise InputError(
                f"{way}: expected a SPEC without files, found {name}=: a relay reads files for its command line only"
            )


_REQUESTS: Mapping[str, tuple[tuple[str, ...], Callable[[int, dict[str, str]], Request]]] = {
    "set": (("link", "preset", "up", "down"), _set),
    "show": (("link",), lambda id_, fields: Show(id_, fields.get("link"))),
}
"""What can be asked for: the fields that each takes, and how it is read."""


def _shown(value: object) -> str:
    """Return what was found, short and on one line."""
    if value is None:
        return "nothing"
    text = value if isinstance(value, str) else type(value).__name__
    return text[:40] or "nothing"
