"""A recording that is followed while it grows: whatever its bytes are, it is read alike however it is cut."""

from __future__ import annotations

from itertools import pairwise

from sitl.live.feed import COLUMNS, MAX_ROWS, Feed
from sitl.live.follower import End, Follower, Found, Message
from sitl.mcapwalk import MAX_RECORD_BYTES
from tests.fuzz.refusing import refusing
from tests.helpers import HIRM


@refusing()
def live(data: bytes) -> None:
    """Followed whole and in pieces, a file says the same; its messages make rows or are counted, and never raise."""
    whole, bits = _followed(data, len(data) or 1), _followed(data, 1 + len(data) % 61)
    assert whole == bits
    assert sum(isinstance(found, End) for found in whole) <= 1
    feed = Feed(HIRM.model, {"reference": "5deg@1s"})
    for found in whole:
        if isinstance(found, Message):
            feed.take(*found)
            feed.settle()
    feed.settle(end=True)
    rows, anew = feed.since(None)
    assert anew
    assert all(len(values) <= MAX_ROWS for columns in rows.values() for values in columns.values())
    assert all(columns.keys() == set(COLUMNS[name]) for name, columns in rows.items())
    assert feed.malformed <= feed.records
    assert feed.numbers()["samples"] <= feed.records


def _followed(data: bytes, size: int) -> list[Found]:
    follower = Follower()
    found: list[Found] = []
    for start, end in pairwise([*range(0, len(data), size), len(data)]):
        found += follower.take(data[start:end])
        assert follower.held <= MAX_RECORD_BYTES + size
    return found
