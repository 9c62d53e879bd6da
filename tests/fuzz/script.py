"""A conversation with a node as bytes: what arrives, at which port, and how much later.

Random bytes are almost never a frame with the right checksum, so a fuzzer that only sends datagrams stays in front of
:meth:`Wire.decode`. Here each step of an input is one of

* a datagram as it is,
* a message of the peer with any payload, framed and summed up correctly,
* an answer to the newest request that the node has sent, which nobody could guess,
* time that passes.

Any bytes are a script; what is cut off at the end counts as zeros.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

from fastcrc.crc16 import mcrf4xx

from autopilot.link.codecs import CODECS, Codec
from autopilot.link.wire import Source

MAX_STEPS = 64
MAX_ADVANCE_NS = 20_000_000_000
"""Of one script, and so of its running time."""

_ADVANCE_UNIT_NS = 125_000
_MESSAGES = tuple(CODECS[message] for message in sorted(CODECS, key=lambda message: CODECS[message].id))


@dataclass(frozen=True, slots=True)
class Datagram:
    """A datagram as it is."""

    port: int
    payload: bytes


@dataclass(frozen=True, slots=True)
class Framed:
    """A message of the peer with this payload."""

    port: int
    codec: Codec
    payload: bytes


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer to what the node has sent last, holding this number."""

    value: int


@dataclass(frozen=True, slots=True)
class Advance:
    """Time passes."""

    by_ns: int


Step = Datagram | Framed | Answer | Advance


class _Reader:
    """Takes bytes away from the front; zeros behind the end."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    @property
    def exhausted(self) -> bool:
        return self._at >= len(self._data)

    def take(self, n: int) -> bytes:
        taken = self._data[self._at : self._at + n]
        self._at += n
        return taken.ljust(n, b"\0")

    def rest_up_to(self, n: int) -> bytes:
        """Take away up to ``n`` bytes, no zeros behind the end."""
        taken = self._data[self._at : self._at + n]
        self._at += n
        return taken


def steps(data: bytes) -> Iterator[Step]:
    """Yield the steps of a script: at most ``MAX_STEPS``, within ``MAX_ADVANCE_NS``."""
    reader = _Reader(data)
    left_ns = MAX_ADVANCE_NS
    for _ in range(MAX_STEPS):
        if reader.exhausted:
            return
        kind, port = divmod(reader.take(1)[0], 4)
        match kind % 4:
            case 0:
                yield Datagram(port, reader.rest_up_to(int.from_bytes(reader.take(2), "little")))
            case 1:
                codec = _MESSAGES[reader.take(1)[0] % len(_MESSAGES)]
                yield Framed(port, codec, reader.take(codec.payload.size))
            case 2:
                yield Answer(*struct.unpack("<q", reader.take(8)))
            case _:
                by_ns = min(left_ns, _ADVANCE_UNIT_NS * int.from_bytes(reader.take(2), "little"))
                left_ns -= by_ns
                yield Advance(by_ns)


def datagram_step(port: int, payload: bytes) -> bytes:
    """Return the script of one datagram."""
    return bytes((port,)) + len(payload).to_bytes(2, "little") + payload


def message_step(port: int, message: object) -> bytes:
    """Return the script of one message."""
    codec = CODECS[type(message)]
    return bytes((4 + port, _MESSAGES.index(codec))) + codec.payload.pack(*codec.values(message))


def answer_step(value: int) -> bytes:
    """Return the script of an answer."""
    return bytes((8,)) + struct.pack("<q", value)


def advance_step(by_ns: int) -> bytes:
    """Return the script of some time, at most 8 s."""
    return bytes((12,)) + (by_ns // _ADVANCE_UNIT_NS).to_bytes(2, "little")


def frame(codec: Codec, payload: bytes, source: Source, *, flags: int = 0, number: int = 0) -> bytes:
    """Return a MAVLink 2 frame with this payload and the right checksum, trailing zeros left out."""
    payload = payload.rstrip(b"\0") or payload[:1]
    body = bytes((len(payload), flags, 0, number, *source)) + codec.id_bytes + payload
    return b"\xfd" + body + mcrf4xx(body + codec.crc_extra).to_bytes(2, "little")
