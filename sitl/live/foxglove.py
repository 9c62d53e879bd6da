"""The records of a flight as a live stream for Foxglove: a channel for each topic, with the schema of ``topics.py``.

The stream is the SDK's own server, on threads of its own; a viewer that is too slow loses messages there. It carries
what is read from the recording, as it is read: JSON and log times as they are in the file.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from autopilot.link.ports import Address
from autopilot.link.record import MAX_TOPICS
from autopilot.link.topics import is_topic, schema_of
from gains.table import InputError
from sitl.live.follower import Message

__all__ = ["MAX_BACKLOG", "FoxgloveStream"]

MAX_BACKLOG = 1 << 12
"""Messages that may wait for one viewer; the oldest are dropped."""
CLOCK_NS = 50_000_000
"""How often viewers are told the time."""


class FoxgloveStream:
    """Serves what it is given to Foxglove.

    Parameters
    ----------
    address : Address
        Where to listen; port 0 takes any free one.

    Attributes
    ----------
    refused : int
        Messages of topics that no recording of ours has, or beyond MAX_TOPICS.

    Raises
    ------
    InputError
        When the SDK is not installed, or the address cannot be had.
    """

    def __init__(self, address: Address) -> None:
        try:
            import foxglove
        except ImportError:
            raise InputError("--foxglove: expected foxglove-sdk (pip install 'lagproof[foxglove]')") from None
        self.refused = 0
        self._clock_ns = -CLOCK_NS
        self._context = foxglove.Context()
        self._make: Callable[..., Any] = foxglove.Channel
        self._channels: dict[str, Any] = {}
        try:
            self._server = foxglove.start_server(
                name="sitl live",
                host=address[0],
                port=address[1],
                context=self._context,
                capabilities=[foxglove.Capability.Time],
                message_backlog_size=MAX_BACKLOG,
            )
        except (OSError, RuntimeError, ValueError) as error:
            raise InputError(f"--foxglove {address[0]}:{address[1]}: {error}") from None
        self.address = address[0], int(self._server.port)

    def begin(self) -> None:
        """Let a new flight begin: viewers forget the one before."""
        self._server.clear_session()

    def take(self, message: Message) -> None:
        """Pass a message on."""
        channel = self._channels.get(message.topic)
        if channel is None:
            if not is_topic(message.topic) or len(self._channels) >= MAX_TOPICS:
                self.refused += 1
                return
            schema = dict(schema_of(message.topic))
            channel = self._make(message.topic, schema=schema, message_encoding="json", context=self._context)
            self._channels[message.topic] = channel
        channel.log(message.data, log_time=message.log_time_ns)
        if not 0 <= message.log_time_ns - self._clock_ns < CLOCK_NS:
            self._clock_ns = message.log_time_ns
            self._server.broadcast_time(message.log_time_ns)

    def close(self) -> None:
        """Close the stream."""
        self._server.stop()
