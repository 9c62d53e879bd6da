"""The three programs of a flight as operating-system processes: started, listened to, ended, mourned.

Each process streams its records over a loopback TCP connection (:mod:`autopilot.link.stream`), which is
also its lifeline: closing our half ends it, and it ends by itself when we are gone. Its standard error
goes to a file, whose end is its last words.

A process may be killed and started again, frozen and thawed, and be given orders, all in flight. The hello of the
new one is heard when the stream of the old one has ended, and none that the old one left behind.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import selectors
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from hmac import compare_digest
from pathlib import Path
from time import monotonic  # noqa: TID251  a supervisor of processes waits in real time
from typing import Any

import orjson

from autopilot.link.node import Record
from autopilot.link.orders import Order, encode_order
from autopilot.link.record import MAX_LINE_BYTES, decode_line
from autopilot.link.stream import TOKEN_VARIABLE
from autopilot.link.udp import Address, true_ns
from gains.table import InputError

__all__ = ["CAN_FREEZE", "MAX_ORDERS", "MAX_UNKNOWN", "ChildDied", "FlightFailed", "Supervisor"]

CAN_FREEZE = sys.platform != "win32"
"""Whether the system can let a program stand still (SIGSTOP)."""

READ_BYTES = 1 << 18
HELLO_TIMEOUT_S = 30.0
STOP_TIMEOUT_S = 5.0
DRAIN_TIMEOUT_S = 1.0
"""Longest wait for what a killed program has sent; it is in the kernel, so it comes at once."""
MAX_LAST_WORDS = 2000
MAX_UNKNOWN = 16
"""Connections that have not said hello; the oldest is dropped for a further one."""
MAX_ORDERS = 16
"""Orders that wait for a program's hello; further ones are refused."""

if sys.platform == "win32":
    _OWN_GROUP: dict[str, Any] = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
else:
    _OWN_GROUP: dict[str, Any] = {"start_new_session": True}
"""Ctrl-C in the terminal reaches the supervisor alone, which then ends the others in order."""


class FlightFailed(Exception):
    """A flight that came to nothing, through nobody's bad input."""


class ChildDied(FlightFailed):
    """A process ended that should not have.

    Attributes
    ----------
    name : str
        Which.
    code : int or None
        Its exit code; negative for a signal; None when it had to be ended.
    last_words : str
        The end of its standard error.
    """

    def __init__(self, name: str, code: int | None, last_words: str) -> None:
        how = "hung" if code is None else f"died (signal {-code})" if code < 0 else f"died (exit code {code})"
        super().__init__(f"{name} {how}: {last_words or 'it said nothing'}")
        self.name = name
        self.code = code
        self.last_words = last_words


@dataclass(slots=True)
class _Child:
    """One process, from its start to its death."""

    name: str
    process: subprocess.Popen[bytes]
    log: Path
    log_start: int = 0
    """Where in the log its own words begin."""
    started_ns: int = 0
    may_end: bool = False
    connection: socket.socket | None = None
    ports: dict[str, Address] = field(default_factory=dict)
    orders: list[bytes] = field(default_factory=list)
    """Those that wait for its hello."""
    ended: bool = False
    """Its stream has ended."""
    frozen: bool = False
    mourned: bool = False
    """Its death is known and was no failure."""


@dataclass(slots=True, eq=False)
class _Connection:
    """One stream: unauthenticated until its hello."""

    socket: socket.socket
    child: _Child | None = None
    buffer: bytearray = field(default_factory=bytearray)


class Supervisor:
    """Starts the programs, passes on their records, and ends them.

    Parameters
    ----------
    folder : Path
        Where the programs' standard error goes, as ``NAME.log``.
    write : callable
        Takes each record and its true time.

    Attributes
    ----------
    malformed : int
        Lines of a stream that were no records.
    refused_orders : int
        Orders that a program could not be given.
    on_hello : callable
        Called when a program says hello, with its name, its ports and how long after its start that is, ns.
    on_exit : callable
        Called when a program ends by itself that may, with its name, its exit code and its last words.
    """

    def __init__(self, folder: Path, write: Callable[[Record, int], None]) -> None:
        self.malformed = 0
        self.refused_orders = 0
        self.on_hello: Callable[[str, Mapping[str, Address], int], None] = lambda _name, _ports, _after_ns: None
        self.on_exit: Callable[[str, int, str], None] = lambda _name, _code, _last_words: None
        self._folder = folder
        self._write = write
        self._token = secrets.token_hex(16)
        self._children: dict[str, _Child] = {}
        self._unknown: list[_Connection] = []
        self._selector = selectors.DefaultSelector()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.setblocking(False)
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._stopping = False

    def start(self, name: str, arguments: Sequence[str], *, may_end: bool = False) -> None:
        """Start ``python -m`` with the arguments, its record stream joined to ours; again, once it has been killed.

        Parameters
        ----------
        name : str
            The program, as it calls itself in its hello.
        arguments : sequence of str
            Module and command line.
        may_end : bool
            Whether it may end by itself, which is then told to ``on_exit``.
        """
        before = self._children.get(name)
        assert before is None or before.mourned, f"{name} still runs"
        host, port = self._listener.getsockname()
        log = self._folder / f"{name}.log"
        command = [sys.executable, "-m", *arguments, "--stream", f"{host}:{port}"]
        with log.open("wb" if before is None else "ab") as stderr:
            log_start = stderr.tell()
            started_ns = true_ns()
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=stderr,
                env={**os.environ, TOKEN_VARIABLE: self._token},
                **_OWN_GROUP,
            )
        self._children[name] = _Child(name, process, log, log_start, started_ns, may_end)

    def kill(self, name: str) -> None:
        """Kill a program (SIGKILL) that shall be dead, or started again; what it has sent is passed on first."""
        child = self._children[name]
        self._notice(child)
        child.process.kill()
        child.process.wait()
        child.mourned, child.frozen = True, False
        deadline = monotonic() + DRAIN_TIMEOUT_S
        while monotonic() < deadline and child.connection is not None and not child.ended:
            self._listen(0.05)
        self._listen(0.0)  # a connection without a hello

    def freeze(self, name: str) -> None:
        """Let a program stand still (SIGSTOP) until :meth:`thaw`.

        Raises
        ------
        InputError
            Where the system cannot.
        """
        if sys.platform == "win32":
            raise InputError("freeze: expected a system that can stop a program (SIGSTOP), found Windows")
        child = self._children[name]
        child.frozen = True
        child.process.send_signal(signal.SIGSTOP)

    def thaw(self, name: str) -> None:
        """Let a frozen program go on (SIGCONT)."""
        child = self._children[name]
        if sys.platform != "win32" and child.frozen:
            child.process.send_signal(signal.SIGCONT)
        child.frozen = False

    def order(self, name: str, order: Order) -> None:
        """Give a program an order, once it has said hello; count one that it cannot be given."""
        child = self._children[name]
        if child.mourned or child.ended or len(child.orders) >= MAX_ORDERS:
            self.refused_orders += 1
            return
        child.orders.append(encode_order(order))
        self._send_orders(child)

    def wait_ready(self, name: str, stopping: Callable[[], bool]) -> dict[str, Address]:
        """Wait until a program has bound its ports, and return them; empty when stopped before.

        Raises
        ------
        ChildDied
            When it ends instead, or says nothing for too long.
        """
        child = self._children[name]
        deadline = monotonic() + HELLO_TIMEOUT_S
        while child.connection is None and not stopping():
            if monotonic() > deadline:
                child.process.kill()
                child.process.wait()
                raise ChildDied(name, None, "it did not report in time")
            self.poll(0.05)
        return child.ports

    def poll(self, timeout_s: float) -> None:
        """Pass on what has come, waiting at most ``timeout_s`` for it.

        Raises
        ------
        ChildDied
            When a program has ended by itself that may not.
        """
        self._listen(timeout_s)
        if not self._stopping:
            for child in self._children.values():
                self._notice(child)

    def stop(self) -> list[str]:
        """End the programs, take their last records, and return the names of those that had to be killed."""
        self._stopping = True
        for child in self._children.values():
            self.thaw(child.name)  # a frozen program hears nothing
            if child.connection is None:
                child.process.terminate()
                continue
            with contextlib.suppress(OSError):  # it is gone already
                child.connection.shutdown(socket.SHUT_WR)
        deadline = monotonic() + STOP_TIMEOUT_S
        while monotonic() < deadline and not all(c.ended or c.connection is None for c in self._children.values()):
            self.poll(0.05)
        killed = []
        for child in self._children.values():
            try:
                child.process.wait(max(0.1, deadline - monotonic()))
            except subprocess.TimeoutExpired:
                child.process.kill()
                child.process.wait()
                killed.append(child.name)
        return killed

    def close(self) -> None:
        """Kill what still runs and close the sockets; once more does nothing."""
        for child in self._children.values():
            if child.process.poll() is None:
                child.process.kill()
                child.process.wait()
        sockets = self._selector.get_map()  # None once closed
        for key in list(sockets.values()) if sockets else ():
            assert isinstance(key.fileobj, socket.socket)
            key.fileobj.close()
        self._selector.close()

    def _listen(self, timeout_s: float) -> None:
        """Take what has come, waiting at most ``timeout_s`` for it."""
        for key, _ in self._selector.select(timeout_s):
            if key.fileobj is self._listener:
                self._accept()
            else:
                self._read(key.data)

    def _notice(self, child: _Child) -> None:
        """Notice when a program has ended; raise ChildDied if it may not."""
        code = child.process.poll()
        if code is None or child.mourned:
            return
        if not child.may_end:
            raise ChildDied(child.name, code, self._last_words(child))
        child.mourned = True
        self.on_exit(child.name, code, self._last_words(child))

    def _send_orders(self, child: _Child) -> None:
        """Send a program the orders that wait, if it has said hello."""
        if child.connection is None:
            return
        for line in child.orders:
            try:
                child.connection.sendall(line)  # tens of bytes into an empty buffer
            except OSError:
                self.refused_orders += 1  # it has just ended
        child.orders.clear()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):  # it is gone again, or there is no room for it
            accepted, _ = self._listener.accept()
            accepted.setblocking(False)
            connection = _Connection(accepted)
            self._selector.register(accepted, selectors.EVENT_READ, connection)
            self._unknown.append(connection)
            if len(self._unknown) > MAX_UNKNOWN:
                self._drop(self._unknown[0])

    def _read(self, connection: _Connection) -> None:
        """Take the lines that have come; drop a stream that ends or breaks the rules."""
        if connection.socket.fileno() < 0:
            return  # dropped in this very pass, to make room
        try:
            chunk = connection.socket.recv(READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            chunk = b""
        connection.buffer += chunk
        *lines, rest = connection.buffer.split(b"\n")
        connection.buffer = bytearray(rest)
        for line in lines:
            if connection.child is None:
                if not self._hello(connection, bytes(line)):
                    self._drop(connection)
                    return
                continue
            try:
                self._write(*decode_line(bytes(line)))
            except ValueError:
                self.malformed += 1
        if not chunk or len(rest) > MAX_LINE_BYTES:
            self._drop(connection)

    def _hello(self, connection: _Connection, line: bytes) -> bool:
        """Whether the first line names one of our programs and knows the token."""
        try:
            hello = orjson.loads(line)
            child = self._children[hello["hello"]]
            known = compare_digest(str(hello["token"]), self._token)
            ports = {str(name): (str(host), int(port)) for name, (host, port) in hello["ports"].items()}
        except (ValueError, KeyError, TypeError, AttributeError):
            return False
        if not known or child.connection is not None or child.mourned:
            return False
        child.connection, child.ports, connection.child = connection.socket, ports, child
        self._unknown.remove(connection)
        self._send_orders(child)
        self.on_hello(child.name, ports, true_ns() - child.started_ns)
        return True

    def _drop(self, connection: _Connection) -> None:
        if connection in self._unknown:
            self._unknown.remove(connection)
        self._selector.unregister(connection.socket)
        connection.socket.close()
        if connection.child is not None:
            connection.child.ended = True

    def _last_words(self, child: _Child) -> str:
        """Return the end of what a program wrote to standard error, as one line."""
        text = child.log.read_bytes()[child.log_start :][-MAX_LAST_WORDS:].decode("utf-8", errors="replace")
        lines = [line.strip() for line in text.splitlines() if line.strip()]
        return lines[-1] if lines else ""
