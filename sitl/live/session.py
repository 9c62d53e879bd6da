"""One flight after another: which file, what it holds so far, and what is told to those who look.

A session reads a piece whenever it is asked to, and hands out text for the page: a snapshot for who comes, news for
who has the snapshot. It reads no clock; the caller says what time it is.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from enum import StrEnum
from pathlib import Path
from typing import Any, NamedTuple

import orjson

from autopilot.link.clock import NS_PER_S
from gains.model import Model
from gains.store import load_law, load_model, parse_model
from gains.table import InputError, Table
from sitl.live.feed import Feed, Told
from sitl.live.follower import About, Attached, End, Follower, Message
from sitl.live.tail import Tail, Watch

__all__ = ["MODEL_FILE", "SILENT_NS", "Flight", "Session", "State"]

SILENT_NS = 3 * NS_PER_S
"""A recording that has not grown for so long, and has not ended, is silent: its program may have been killed."""
LOOK_NS = NS_PER_S // 2
"""How often a folder is searched for a newer recording."""
MODEL_FILE = "model.toml"
"""The recording's own copy of the model."""
MAX_MODEL_BYTES = 1 << 20
MAX_METADATA = 64
MAX_TEXT = 500

_STORED_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")


class State(StrEnum):
    """What is known of the flight; ``value`` is what the page is told."""

    WAITING = "waiting"
    LIVE = "live"
    SILENT = "silent"
    ENDED = "ended"
    DAMAGED = "damaged"


class Flight(NamedTuple):
    """The flight that is followed.

    Attributes
    ----------
    number : int
        Counts the flights of this session, from 1; 0 while there was none.
    name : str
        Folder or file, without the way there.
    metadata : mapping of str to str
        Of the recording.
    model : Model or None
        What is flown, where the recording tells.
    """

    number: int
    name: str
    metadata: Mapping[str, str]
    model: Model | None


def _nothing() -> None:
    """Do nothing."""


def _ignore(_message: Message) -> None:
    """Do nothing."""


class Session:
    """Follows a file, or the newest recording of a folder and each newer one.

    Parameters
    ----------
    source : Path
        A recording, which need not exist yet, or a folder of recordings.
    run : str
        What a page is told beside the flight's number, so that it can tell this session from one before.
    on_begin, on_message : callable, optional
        Called when another flight begins, and with every message: for another stream.

    Attributes
    ----------
    flight : Flight
        What is followed; its number changes with each flight.
    state : State
    feed : Feed
        Of this flight.
    revision : int
        Changes with whatever a page is told.
    """

    def __init__(
        self,
        source: Path,
        run: str = "",
        on_begin: Callable[[], None] = _nothing,
        on_message: Callable[[Message], None] = _ignore,
    ) -> None:
        self.state = State.WAITING
        self.run = run
        self.revision = 0
        self._on_begin = on_begin
        self._on_message = on_message
        self._watch = None if source.suffix == ".mcap" and not source.is_dir() else Watch(source)
        self._tail = Tail(source) if self._watch is None else None
        self._looked_ns: int | None = None
        self._grown_ns = 0
        self._begin(0)

    def step(self, now_ns: int) -> bool:
        """Read the next piece of the recording; return whether there was one, and so may be more."""
        self._look(now_ns)
        if self._tail is None:
            return False
        piece = self._tail.read()
        if piece.anew:
            self._begin(self.flight.number)
        if piece.data:
            self._grown_ns = now_ns
            self.revision += 1
            self._take(piece.data)
        elif self.state is State.LIVE and now_ns - self._grown_ns > SILENT_NS:
            self.state = State.SILENT
            self.revision += 1
        self.feed.settle(end=self.state is not State.LIVE)
        return bool(piece.data)

    def snapshot(self) -> bytes:
        """Return everything that a page needs, as JSON."""
        return self._told(None)

    def news(self, told: Told | None) -> bytes:
        """Return what is new since then, as JSON."""
        return self._told(told)

    def close(self) -> None:
        """Close the file."""
        if self._tail is not None:
            self._tail.close()

    def _look(self, now_ns: int) -> None:
        """Go on to a newer recording, where there is one."""
        if self._watch is None or (self._looked_ns is not None and now_ns - self._looked_ns < LOOK_NS):
            return
        self._looked_ns = now_ns
        newest = self._watch.look()
        if newest is None or (self._tail is not None and newest == self._tail.path):
            return  # the same file, begun anew, is the tail's to notice
        self.close()
        self._tail = Tail(newest)
        self._begin(self.flight.number)

    def _begin(self, number: int) -> None:
        """Start over, before the first bytes of a recording."""
        self.state = State.WAITING
        self.revision += 1
        self.flight = Flight(number, "", {}, None)
        self.feed = Feed(None, {})
        self._follower = Follower()
        self._metadata: dict[str, str] = {}
        self._model: Model | None = None
        self._begun = False

    def _take(self, data: bytes) -> None:
        if self.state is State.SILENT or (self.state is State.WAITING and not self._follower.over):
            self.state = State.LIVE
        for found in self._follower.take(data):
            match found:
                case About(metadata):
                    self._metadata = _bounded(metadata)
                case Attached(name, content):
                    if name == MODEL_FILE and len(content) <= MAX_MODEL_BYTES:
                        self._model = _parsed(content)
                case Message(topic, log_time_ns, content):
                    if not self._begun:
                        self._announce()
                    self.feed.take(topic, log_time_ns, content)
                    self._on_message(found)
                case End(damaged):
                    self.state = State.DAMAGED if damaged else State.ENDED

    def _announce(self) -> None:
        """Take the recording's head as complete: its first message has come."""
        assert self._tail is not None
        path = self._tail.path
        self._begun = True
        model = self._model or _named(self._metadata)
        name = path.parent.name if path.name == "flight.mcap" else path.name
        self.flight = Flight(self.flight.number + 1, name, self._metadata, model)
        self.feed = Feed(model, self._metadata)
        self._on_begin()

    def _told(self, told: Told | None) -> bytes:
        news = self.feed.since(told)
        content: dict[str, Any] = {
            "run": self.run,
            "flight": self.flight.number,
            "state": self.state,
            "anew": news.anew,
            "rows": news.rows,
            "numbers": self.feed.numbers(),
        }
        return orjson.dumps(content)


def _bounded(metadata: Mapping[str, str]) -> dict[str, str]:
    return {key[:MAX_TEXT]: value[:MAX_TEXT] for key, value in list(metadata.items())[:MAX_METADATA]}


def _parsed(content: bytes) -> Model | None:
    try:
        return parse_model(Table.parse(content, MODEL_FILE))
    except InputError:
        return None


def _named(metadata: Mapping[str, str]) -> Model | None:
    """Return the model that the metadata name: a stored one only, as a recording may be anybody's."""
    for key in ("plant", "gains"):
        name = metadata.get(key, "")
        if _STORED_NAME.fullmatch(name):
            try:
                return load_model(name) if key == "plant" else load_law(name).model
            except InputError:
                continue
    return None
