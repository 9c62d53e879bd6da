"""Streams records from one process to the recorder, without ever waiting for it.

A loopback TCP connection, opened by the process that records. The first line is the hello: who speaks, the
token that the recorder gave it, and the ports it has bound. Then one line per record. What comes back are orders
(:mod:`autopilot.link.orders`), as a rule none; the recorder ends the process by closing the connection, and the
process that loses its recorder ends too. What does not fit into the bounded buffer is counted and dropped.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping

import orjson

from autopilot.link.node import Record
from autopilot.link.orders import Order, decode_order
from autopilot.link.record import encode_line
from autopilot.link.udp import Address
from gains.table import InputError

__all__ = ["TOKEN_VARIABLE", "StreamSink", "encode_hello"]

TOKEN_VARIABLE = "LAGPROOF_STREAM_TOKEN"
"""Environment variable that carries the token: never on a command line, where others can read it."""

MAX_BUFFERED_BYTES = 8 << 20
CONNECT_TIMEOUT_S = 5.0
DRAIN_TIMEOUT_S = 2.0
MAX_HEARD_BYTES = 1 << 12
"""Orders that wait to be taken; the recorder never has so many."""


def encode_hello(name: str, token: str, ports: Mapping[str, Address]) -> bytes:
    """Return the first line of a stream."""
    return orjson.dumps({"hello": name, "token": token, "ports": dict(ports)}) + b"\n"


class StreamSink:
    """The process's end of the stream.

    Parameters
    ----------
    address : Address
        Where the recorder listens.
    name : str
        Who speaks.
    ports : mapping
        Port name to the bound address.

    Attributes
    ----------
    lost : int
        Records that the buffer had no room for.
    closed : bool
        Whether the recorder has ended the stream: the process shall end.

    Raises
    ------
    InputError
        When nobody listens there.
    """

    def __init__(self, address: Address, name: str, ports: Mapping[str, Address]) -> None:
        self.lost = 0
        self.closed = False
        try:
            self._socket = socket.create_connection(address, CONNECT_TIMEOUT_S)
        except OSError as error:
            raise InputError(f"record stream {address[0]}:{address[1]}: {error.strerror or error}") from None
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.sendall(encode_hello(name, os.environ.get(TOKEN_VARIABLE, ""), ports))
        self._socket.setblocking(False)
        self._buffer = bytearray()
        self._heard = bytearray()

    def write(self, record: Record, log_time_ns: int) -> None:
        """Buffer a record."""
        if len(self._buffer) > MAX_BUFFERED_BYTES:
            self.lost += 1
            return
        self._buffer += encode_line(record, log_time_ns)

    def pump(self) -> None:
        """Send what the connection takes now, hear what has come, and see whether the recorder has closed it."""
        if self.closed:
            return
        try:
            if self._buffer:
                self._send()
            heard = self._socket.recv(MAX_HEARD_BYTES)
        except BlockingIOError:
            return
        except OSError:
            self.closed = True
            return
        self._heard += heard
        self.closed = not heard or len(self._heard) > MAX_HEARD_BYTES

    def _send(self) -> None:
        """Send what the connection takes; one that takes nothing may have something to say all the same."""
        try:
            del self._buffer[: self._socket.send(self._buffer)]
        except BlockingIOError:
            return

    def orders(self) -> list[Order]:
        """Take away the orders that have come; a line that is none ends the stream."""
        if not self._heard:
            return []
        *lines, rest = self._heard.split(b"\n")
        self._heard = bytearray(rest)
        try:
            return [decode_order(bytes(line)) for line in lines]
        except ValueError:
            self.closed = True
            return []

    def close(self) -> None:
        """Send the rest, waiting a little for a slow recorder, and close."""
        self._socket.settimeout(DRAIN_TIMEOUT_S)
        try:
            self._socket.sendall(self._buffer)
        except OSError:
            self.lost += self._buffer.count(b"\n")
        self._socket.close()
