"""What a datagram does to a wire, signed and unsigned."""

from __future__ import annotations

from hashlib import sha256

from autopilot.link.codecs import CODECS
from autopilot.link.signing import Signing, Verdict
from autopilot.link.wire import (
    AUTOPILOT,
    CONTROL_MESSAGES,
    GROUND_MESSAGES,
    MAX_DATAGRAM_BYTES,
    MAX_FRAMES,
    PLANT,
    Reject,
    Source,
    Wire,
    frames_of,
    split_frames,
)
from tests.fuzz.refusing import refusing
from tests.fuzz.script import Datagram, Framed, frame, steps

KEY = bytes(range(32))
NOW = 37_500_000_000_000
"""A timestamp in 2026."""
STATION = (255, 190)
SIGNED = 1


@refusing()
def datagram(data: bytes) -> None:
    """One datagram, as it is: everything in it is accepted or counted, and what is accepted packs to the same."""
    for source, peer, accepts in ((AUTOPILOT, PLANT, CONTROL_MESSAGES), (AUTOPILOT, None, GROUND_MESSAGES)):
        wire = Wire(source, peer, accepts)
        accepted = wire.decode_from(data)
        _check_counts(wire, data, len(accepted))
        for sender, message in accepted:
            _check_round_trip(sender, message)
    assert frames_of(PLANT)(data) == bool(Wire((0, 0), PLANT).decode(data))


@refusing()
def framed(data: bytes) -> None:
    """Every message with any payload, framed correctly: none is damaged, and what comes back packs to the same."""
    for step in steps(data):
        if not isinstance(step, Framed):
            continue
        wire = Wire(AUTOPILOT, PLANT, frozenset(CODECS))
        for sender, message in wire.decode_from(frame(step.codec, step.payload, PLANT)):
            _check_round_trip(sender, message)
        rejected = set(wire.rejects)
        assert rejected <= {Reject.NON_FINITE}, rejected


@refusing()
def sealed(data: bytes) -> None:
    """Frames of a peer who has the key, at any time and on any link, and strangers' datagrams: no frame passes twice.

    ``would_accept`` says what ``check`` will, and counts add up.
    """
    seal = Signing(KEY, 0, NOW, peer_link=None)
    wire = Wire(AUTOPILOT, PLANT, CONTROL_MESSAGES, seal)
    heard = frames_of(PLANT, seal)
    seen: set[bytes] = set()
    for number, step in enumerate(steps(data)):
        seal.tick(10_000 * number)
        if isinstance(step, Framed):
            arrived = _signed(step)
        elif isinstance(step, Datagram):
            arrived = step.payload
        else:
            continue
        promises = [seal.would_accept(each) for each in split_frames(arrived)[0]]
        accepted_before, checked_before = seal.counts[Verdict.ACCEPTED], seal.counts.total()
        heard(arrived)
        assert seal.counts.total() == checked_before, "listening for a peer has changed what is known of it"
        messages = wire.decode_from(arrived)
        newly = seal.counts[Verdict.ACCEPTED] - accepted_before
        assert newly >= len(messages)
        if len(promises) == 1 and seal.counts.total() > checked_before:
            assert promises == [bool(newly)]
        if newly and isinstance(step, Framed):
            stamp = arrived[-13:-6]  # link and timestamp
            assert stamp not in seen, "a replayed frame was accepted"
            seen.add(stamp)


def _signed(step: Framed) -> bytes:
    """Return a frame with a genuine signature; its link and timestamp are made of the payload's first bytes."""
    link, offset = step.payload[0] % 4, int.from_bytes(step.payload[1:5].ljust(4, b"\0"), "little", signed=True)
    plain = frame(step.codec, step.payload, PLANT, flags=SIGNED)
    timestamp = min(max(0, NOW + offset), (1 << 48) - 1)
    body = plain + bytes((link,)) + timestamp.to_bytes(6, "little")
    return body + sha256(KEY + body).digest()[:6]


def _check_counts(wire: Wire, data: bytes, accepted: int) -> None:
    """Check that each frame, and what is no frame, was counted once."""
    frames, leftover = split_frames(data)
    assert b"".join(frames) == data[: sum(map(len, frames))]
    assert (leftover is None) == (sum(map(len, frames)) == len(data))
    total = accepted + wire.rejects.total()
    if len(data) > MAX_DATAGRAM_BYTES:
        assert total == wire.rejects[Reject.OVERSIZE] == 1
    else:
        assert total == len(frames) + (leftover is not None)
        assert accepted <= MAX_FRAMES
    assert wire.received == accepted


def _check_round_trip(sender: Source, message: object) -> None:
    """Check that an accepted message packs, and comes back the same; replaced characters are no text of ours."""
    if any(isinstance(value, str) and not value.isascii() for value in _values(message)):
        return
    packed = Wire(sender, None).encode(message)  # type: ignore[arg-type]
    (again,) = Wire((0, 0), sender, frozenset({type(message)})).decode(packed)
    assert repr(again) == repr(message)  # NaN equals nothing


def _values(message: object) -> list[object]:
    return [getattr(message, name) for name in type(message).__match_args__]  # type: ignore[attr-defined]
