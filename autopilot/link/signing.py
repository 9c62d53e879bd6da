"""MAVLink 2 signing of one link: a signature block on what is sent, a replay window on what is received.

A signature shows that a holder of the key made a frame, its timestamp that the frame was not taken before. The
signature is verified first and alone; only a frame that passes can change anything here, so a forged frame
costs one hash of at most 280 bytes and leaves no trace but a counter. Each stream (system, component, link id)
has a window of its own: the ``depth`` newest accepted timestamps are known one by one, and what is older than
all of them is refused. A frame that up to ``depth - 1`` newer ones overtook is thus taken, exactly once; one that was
kept back on the way for more than a minute is not.

What must outlive a restart is a :class:`Timestamps`. It is written *ahead*, by ``RESERVE`` of 2 s and every
second, and what is stored is never overrun: once :meth:`Signing.stored` was called, a frame beyond the stored
floor of its stream is refused as ``UNRESERVED`` until the next write covers it (the first frame of a stream, or one
after its sender's clock jumped), and a timestamp beyond the stored reserve is not sent (the last one is counted on by
one instead). So at any instant every accepted timestamp is at or below a stored floor, and every sent one below the
stored ``next``. Hence no frame is accepted twice and no timestamp sent twice, however the program ended and whatever
its clock says when it starts again. After a crash, legitimate frames of a sender whose timestamps follow a clock are
refused for at most the reserve; after a clean stop the exact values are stored and nothing new is too old.

What one link accepted says nothing to another. Where one key serves several links, a frame of one
could be played to another; ``peer_link`` refuses that where the peer's link id is known.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from enum import StrEnum
from hashlib import sha256
from hmac import compare_digest

__all__ = [
    "DEPTH",
    "KEY_BYTES",
    "LAST_TIMESTAMP",
    "MAX_DEPTH",
    "MAX_STREAMS",
    "NEW_STREAM_SPAN",
    "RESERVE",
    "SIGNATURE_BLOCK_BYTES",
    "UNIT_NS",
    "Signing",
    "Stream",
    "Timestamps",
    "Verdict",
    "timestamp_of",
]

KEY_BYTES = 32
SIGNATURE_BLOCK_BYTES = 13
"""Link id (1), timestamp (6, little endian), signature (6)."""

UNIT_NS = 10_000
"""One unit of a timestamp."""

EPOCH_UNIX_S = 1_420_070_400
"""Timestamps count from 2015-01-01 00:00 GMT."""

_S = 1_000_000_000 // UNIT_NS

NEW_STREAM_SPAN = 60 * _S
"""How far a stream that nothing is known about may be behind our own timestamp at first: one minute."""

RESERVE = 2 * _S
"""How far ahead of the newest timestamps those are that are stored while running."""

LAST_TIMESTAMP = (1 << 48) - 1

_ROOM = 86_400 * _S
"""Units at the end of the 48 bits that a received timestamp must leave, so that ours, which follows it, can go on."""

DEPTH = 64
"""Timestamps that a stream remembers unless told otherwise."""

MAX_DEPTH = 1024
MAX_STREAMS = 16
"""Streams that one link knows at a time; the C library has as many."""

_MARKER_V1, _MARKER_V2, _SIGNED = 0xFE, 0xFD, 0x01
_SIGNATURE_BYTES = 6
_OVERHEAD_BYTES = 12 + SIGNATURE_BLOCK_BYTES  # ten of header, two of checksum

Stream = tuple[int, int, int]
"""System, component and link id."""


class Verdict(StrEnum):
    """What became of one frame; everything but ``ACCEPTED`` is dropped."""

    ACCEPTED = "accepted"
    UNSIGNED = "unsigned"
    MALFORMED = "malformed_signature"
    BAD_SIGNATURE = "bad_signature"
    WRONG_LINK = "wrong_link"
    REPLAYED = "replayed"
    TOO_OLD = "timestamp_too_old"
    TOO_NEW = "timestamp_too_new"
    TOO_MANY_STREAMS = "too_many_streams"
    UNRESERVED = "timestamp_unreserved"


@dataclass(frozen=True, slots=True)
class Timestamps:
    """What one link has to know when its program starts again.

    Attributes
    ----------
    next : int
        The least timestamp that may be sent.
    unseen : int
        The floor of every stream that is not listed.
    floors : Mapping[Stream, int]
        Per stream, what an accepted timestamp must exceed.
    """

    next: int = 0
    unseen: int = -1
    floors: Mapping[Stream, int] = field(default_factory=dict)


@dataclass(slots=True)
class _Stream:
    """A peer's stream: what was accepted of it, and what its stored floor covers.

    Attributes
    ----------
    floor : int
        What an accepted timestamp must exceed as long as fewer than ``depth`` are remembered.
    times : list of int
        The newest accepted timestamps, rising.
    lead : int or None
        How far its newest timestamp was ahead of our clock; None before the first.
    covered : int
        The newest timestamp that its stored floor covers.
    """

    floor: int
    times: list[int] = field(default_factory=list)
    lead: int | None = None
    covered: int = -1

    @property
    def newest(self) -> int:
        return self.times[-1] if self.times else self.floor


class Signing:
    """Signs and checks the frames of one link.

    Parameters
    ----------
    key : bytes, 32
        The secret that both ends share.
    link_id : int
        Our link's id, 0 to 255; no two links of one program should share it.
    start : int
        What the clock shows when our own time is zero, in units of 10 µs since 2015 GMT; may be negative.
    timestamps : Timestamps, optional
        What an earlier run left.
    accept_unsigned : bool
        Whether frames without a signature pass, MAVLink 1 included. A signature that is there is checked all the same.
    depth : int
        Accepted timestamps that each stream remembers, 1 to ``MAX_DEPTH``.
    peer_link : int, optional
        The only link id that the peer's frames may carry.

    Attributes
    ----------
    counts : Counter of Verdict
        Frames by verdict.
    forgotten : int
        Streams that were forgotten because others came.
    held_back : int
        Frames that were sent with an earlier timestamp than the clock's, as no later one was stored.
    overdrawn : int
        Frames that were sent although the stored reserve was used up; zero unless storing was neglected or ended.
    wants_store : bool
        Whether something waits for the next write.

    Raises
    ------
    ValueError
        When a parameter is outside its range.
    """

    def __init__(
        self,
        key: bytes,
        link_id: int,
        start: int,
        timestamps: Timestamps | None = None,
        *,
        accept_unsigned: bool = False,
        depth: int = DEPTH,
        peer_link: int | None = None,
    ) -> None:
        known = timestamps if timestamps is not None else Timestamps()
        if len(key) != KEY_BYTES:
            raise ValueError(f"key: expected {KEY_BYTES} bytes, found {len(key)}")
        if not 1 <= depth <= MAX_DEPTH:
            raise ValueError(f"depth: expected 1 to {MAX_DEPTH}, found {depth}")
        if len(known.floors) > MAX_STREAMS:
            raise ValueError(f"floors: expected at most {MAX_STREAMS} streams, found {len(known.floors)}")
        self.counts: Counter[Verdict] = Counter()
        self.forgotten = 0
        self.held_back = 0
        self.overdrawn = 0
        self.wants_store = False
        self._key = bytes(key)
        self._link = bytes((link_id,))  # refuses what is no byte
        self._peer_link = peer_link
        self._start = start
        self._clock = start
        self._accept_unsigned = accept_unsigned
        self._depth = depth
        self._last = known.next - 1
        self._heard = -1
        self._unseen = known.unseen
        self._streams = {stream: _Stream(floor) for stream, floor in known.floors.items()}
        self._limit: int | None = None

    # -- own time

    def tick(self, now_ns: int) -> None:
        """Take our own time, which never goes back."""
        self._clock = max(self._clock, self._start + now_ns // UNIT_NS)

    @property
    def timestamp(self) -> int:
        """What is due next: the clock, but later than all that was sent and not before what was heard from peers."""
        return max(self._last + 1, self._clock, self._heard)

    # -- frames

    def sign(self, frame: bytes) -> bytes:
        """Return a frame with its signature block; the timestamps of consecutive frames strictly rise.

        Parameters
        ----------
        frame : bytes
            A MAVLink 2 frame up to its checksum, its header already saying that it is signed.
        """
        assert frame[0] == _MARKER_V2, "only MAVLink 2 frames are signed"
        assert frame[2] & _SIGNED, "the header, which the checksum covers, must say that the frame is signed"
        timestamp = self.timestamp
        if self._limit is not None and timestamp >= self._limit:
            timestamp = self._last + 1
            self.held_back += 1
            self.overdrawn += timestamp >= self._limit
            self.wants_store = True
        self._last = timestamp
        body = frame + self._link + timestamp.to_bytes(6, "little")
        return body + self._signature(body)

    def check(self, frame: bytes) -> Verdict:
        """Judge a frame as it was split off its datagram, before anything else of it is believed; count the verdict.

        The signature covers the checksum, so it may be checked before it. Nothing of a frame is remembered
        unless its signature is right.
        """
        verdict = self._judge(frame)
        self.counts[verdict] += 1
        return verdict

    def would_accept(self, frame: bytes) -> bool:
        """Return whether a frame is genuine and new, if need be after the next write; remember and count nothing."""
        signed = len(frame) > SIGNATURE_BLOCK_BYTES and frame[0] == _MARKER_V2 and bool(frame[2] & _SIGNED)
        if not signed:
            return self._accept_unsigned
        if not compare_digest(self._signature(frame[:-_SIGNATURE_BYTES]), frame[-_SIGNATURE_BYTES:]):
            return False  # before anything is copied: strangers are cheap
        return deepcopy(self).check(frame) in (Verdict.ACCEPTED, Verdict.UNRESERVED)

    def _judge(self, frame: bytes) -> Verdict:
        marker = frame[0] if len(frame) > 2 else None
        if marker == _MARKER_V1 or (marker == _MARKER_V2 and not frame[2] & _SIGNED):
            return Verdict.ACCEPTED if self._accept_unsigned else Verdict.UNSIGNED
        if marker != _MARKER_V2 or len(frame) != frame[1] + _OVERHEAD_BYTES:
            return Verdict.MALFORMED
        if not compare_digest(self._signature(frame[:-_SIGNATURE_BYTES]), frame[-_SIGNATURE_BYTES:]):
            return Verdict.BAD_SIGNATURE
        link_id = frame[-SIGNATURE_BLOCK_BYTES]
        if self._peer_link is not None and link_id != self._peer_link:
            return Verdict.WRONG_LINK
        timestamp = int.from_bytes(frame[-12:-6], "little")
        if timestamp > LAST_TIMESTAMP - _ROOM:
            return Verdict.TOO_NEW
        name = (frame[5], frame[6], link_id)
        stream = self._streams.get(name)
        if stream is None:
            made = self._new_stream(timestamp)
            if isinstance(made, Verdict):
                return made
            self._streams[name] = stream = made
        return self._take(stream, timestamp)

    def _signature(self, body: bytes) -> bytes:
        # Key and frame in one call: the key is shorter than a block of the hash, so a hash prepared with it would
        # save nothing, and copying that costs more than joining bytes.
        return sha256(self._key + body).digest()[:_SIGNATURE_BYTES]

    def _new_stream(self, timestamp: int) -> _Stream | Verdict:
        """Return a stream that begins with an authentic frame, or why it may not."""
        floor = max(self._unseen, self.timestamp - NEW_STREAM_SPAN - 1)
        if timestamp <= floor:
            return Verdict.TOO_OLD
        if len(self._streams) >= MAX_STREAMS and not self._forget():
            return Verdict.TOO_MANY_STREAMS
        return _Stream(floor)

    def _forget(self) -> bool:
        """Make room by the stream that is oldest, if it is older than a new one may be."""
        oldest = min(self._streams, key=lambda name: self._streams[name].newest)
        newest = self._streams[oldest].newest
        if newest >= self.timestamp - NEW_STREAM_SPAN:
            return False
        del self._streams[oldest]
        self._unseen = max(self._unseen, newest)  # whatever our own timestamp will be, its frames stay refused
        self.forgotten += 1
        return True

    def _take(self, stream: _Stream, timestamp: int) -> Verdict:
        """Judge an authentic frame by its stream's window, and remember it there if it is accepted."""
        times = stream.times
        position = len(times)
        is_newest = timestamp > stream.newest
        if not is_newest:
            position = bisect_left(times, timestamp)
            if position < len(times) and times[position] == timestamp:
                return Verdict.REPLAYED
            if timestamp <= stream.floor or (position == 0 and len(times) == self._depth):
                return Verdict.TOO_OLD
        if stream.lead is not None and timestamp < self._clock + stream.lead - NEW_STREAM_SPAN:
            return Verdict.TOO_OLD  # kept back on the way: its sender has long been later
        if is_newest:
            stream.lead = timestamp - self._clock
        if self._limit is not None and timestamp > stream.covered:
            self.wants_store = True
            return Verdict.UNRESERVED
        times.insert(position, timestamp)
        if len(times) > self._depth:
            del times[0]
        if timestamp > self._heard:
            self._heard = timestamp
        return Verdict.ACCEPTED

    # -- what outlives a restart

    def exact(self) -> Timestamps:
        """Return what to store when the link has ended."""
        floors = {name: stream.newest for name, stream in self._streams.items()}
        return Timestamps(max(self._last + 1, self._heard), self._unseen, floors)

    def ahead(self) -> Timestamps:
        """Return what to store while the link runs: what both ends will have used when ``RESERVE`` has passed."""
        floors = {}
        for name, stream in self._streams.items():
            floor = stream.newest
            if stream.lead is not None:
                # Counted from now, not from the last frame: a stream that resumes after a silence is covered.
                floor = min(max(floor, self._clock + stream.lead) + RESERVE, LAST_TIMESTAMP)
            floors[name] = floor
        return Timestamps(self.timestamp + RESERVE, self._unseen, floors)

    def stored(self, timestamps: Timestamps | None) -> None:
        """Take note of what is stored now, which nothing may overrun from here on.

        Parameters
        ----------
        timestamps : Timestamps or None
            What :meth:`ahead` or :meth:`exact` returned, with no frame signed or checked in between. None when
            storing failed: then frames pass as if nothing were ever stored, since a full disk must not end a flight.
        """
        self._limit = None if timestamps is None else timestamps.next
        for name, stream in self._streams.items():
            stream.covered = -1 if timestamps is None else timestamps.floors.get(name, -1)
        self.wants_store = False


def timestamp_of(unix_ns: int) -> int:
    """Return the timestamp of a time in ns since 1970 GMT; negative before 2015."""
    return (unix_ns - EPOCH_UNIX_S * 1_000_000_000) // UNIT_NS
