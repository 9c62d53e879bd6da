"""The page and its stream over HTTP: two paths, GET only, for the programs and the people of this machine.

What is served says where an aircraft is. So a page of another site, in the same browser, must not read it: the name
in the Host header must be one of ours (a foreign name that resolves to 127.0.0.1 is not), and the stream asks for the
Origin of our own page. Everything is in the page, which may load nothing and talk to nobody but its stream.

Everybody gets what is new when it is new. Who does not take it is dropped with what waits for him, and may come again:
then a snapshot tells him all. A flight never waits for anybody.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import hashlib
import socket
from collections.abc import Callable
from html.parser import HTMLParser
from time import monotonic_ns  # noqa: TID251  a server lives in real time
from typing import Any, NamedTuple

from tornado.httpserver import HTTPServer
from tornado.iostream import IOStream
from tornado.web import Application, HTTPError, RequestHandler
from tornado.websocket import WebSocketClosedError, WebSocketHandler

from autopilot.link.ports import Address
from gains.table import InputError
from sitl.live.feed import Told
from sitl.live.session import Flight, Session

__all__ = ["MAX_BACKLOG_BYTES", "MAX_CLIENTS", "MAX_CONNECTIONS", "STREAM_PATH", "Counters", "LiveServer", "policy"]

STREAM_PATH = "/stream"
MAX_CLIENTS = 16
"""Streams at a time; a further one is refused."""
MAX_CONNECTIONS = 64
"""Connections that have not become streams; a further one is closed at once."""
MAX_BACKLOG_BYTES = 4 << 20
"""What may wait to be sent to one client, a few snapshots; a client with more is dropped."""
MAX_HEADER_BYTES = 1 << 13
HEADER_TIMEOUT_S = 5.0
PING_S = 10.0
POLL_S = 0.1
"""How often the file is looked at once everything in it has been read."""
NEWS_NS = 200_000_000
"""The least time between two news."""

_TRY_AGAIN = 1013
_POLICY = 1008


class Counters(NamedTuple):
    """What the server refused.

    Attributes
    ----------
    hosts, origins : int
        Requests that named another host, or streams that another page asked for.
    clients, connections : int
        Those beyond MAX_CLIENTS and MAX_CONNECTIONS.
    slow : int
        Clients that were dropped, as they did not take what was sent.
    talking : int
        Clients that were dropped, as they sent something.
    """

    hosts: int = 0
    origins: int = 0
    clients: int = 0
    connections: int = 0
    slow: int = 0
    talking: int = 0


class _Scripts(HTMLParser):
    """Collects the text of a page's scripts."""

    def __init__(self) -> None:
        super().__init__(convert_charrefs=False)
        self.found: list[str] = []
        self._inside = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Begin with a script."""
        if tag == "script":
            self._inside = True
            self.found.append("")

    def handle_data(self, data: str) -> None:
        """Take its text."""
        if self._inside:
            self.found[-1] += data

    def handle_endtag(self, tag: str) -> None:
        """End with it."""
        self._inside = self._inside and tag != "script"


def policy(page: str, host: str) -> str:
    """Return the Content-Security-Policy of a page: its own inline scripts, by their hashes, and its own stream."""
    scripts = _Scripts()
    scripts.feed(page)
    scripts.close()
    hashes = (base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in scripts.found)
    allowed = " ".join(dict.fromkeys(f"'sha256-{digest}'" for digest in hashes)) or "'none'"
    return (
        f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; img-src data: blob:; "
        f"connect-src ws://{host}{STREAM_PATH}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )


class _Guarded(RequestHandler):
    """What every answer has in common: for our own name only, nothing kept, no script of others."""

    @property
    def live(self) -> LiveServer:
        """The server."""
        server: LiveServer = self.settings["live"]
        return server

    def set_default_headers(self) -> None:
        """Say nothing of ourselves, and forbid what is not needed."""
        self.clear_header("Server")
        for name, value in (
            ("Cache-Control", "no-store"),
            ("Content-Security-Policy", "default-src 'none'; frame-ancestors 'none'"),
            ("Cross-Origin-Opener-Policy", "same-origin"),
            ("Cross-Origin-Resource-Policy", "same-origin"),
            ("Referrer-Policy", "no-referrer"),
            ("X-Content-Type-Options", "nosniff"),
            ("X-Frame-Options", "DENY"),
        ):
            self.set_header(name, value)

    def prepare(self) -> None:
        """Refuse a request for another name before anything else is looked at."""
        connection: Any = self.request.connection
        local = connection.stream.socket.getsockname() if connection.stream.socket is not None else None
        if not self.live.is_ours(self.request.host, local):
            self.live.count("hosts")
            raise HTTPError(403)

    def write_error(self, status_code: int, **kwargs: Any) -> None:
        """Answer with the code alone."""
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish(f"{status_code}\n")


class _Page(_Guarded):
    def get(self) -> None:
        page = self.live.page()
        self.set_header("Content-Type", "text/html; charset=utf-8")
        self.set_header("Content-Security-Policy", policy(page, self.request.host.lower()))
        self.finish(page)


class _Nothing(_Guarded):
    def prepare(self) -> None:
        super().prepare()
        raise HTTPError(404)


class _Stream(WebSocketHandler, _Guarded):
    backlog_bytes = 0

    def prepare(self) -> None:
        """Refuse another name, another page, and one client too many."""
        _Guarded.prepare(self)
        if self.request.headers.get("Origin", "").lower() != f"http://{self.request.host.lower()}":
            self.live.count("origins")
            raise HTTPError(403)
        if len(self.live.clients) >= MAX_CLIENTS:
            self.live.count("clients")
            raise HTTPError(503)

    def check_origin(self, origin: str) -> bool:
        """Say yes: it has been looked at."""
        return True

    def open(self, *_: str, **__: str) -> None:
        """Join."""
        self.set_nodelay(True)
        self.live.join(self)

    def send(self, text: bytes) -> bool:
        """Hand over a message, which waits until the system has taken it; return False where too much waits."""
        if self.backlog_bytes + len(text) > MAX_BACKLOG_BYTES:
            return False
        try:
            sent = asyncio.ensure_future(self.write_message(text))
        except WebSocketClosedError:
            return True  # gone: on_close will be called
        self.backlog_bytes += len(text)

        def done(future: asyncio.Future[None]) -> None:
            self.backlog_bytes -= len(text)
            if not future.cancelled():
                future.exception()  # gone meanwhile

        sent.add_done_callback(done)
        return True

    def drop(self) -> None:
        """Close the connection with all that waits, without a word: it would wait behind the rest."""
        stream = None if self.ws_connection is None else self.ws_connection.stream
        if stream is not None:
            stream.close()

    def on_message(self, message: str | bytes) -> None:
        """Drop who talks: a page says nothing."""
        self.live.count("talking")
        self.close(_POLICY)

    def on_close(self) -> None:
        """Leave."""
        self.live.clients.discard(self)


class _Bounded(HTTPServer):
    """An HTTP server with a bounded number of connections."""

    live: LiveServer
    open_connections = 0

    def handle_stream(self, stream: IOStream, address: tuple[Any, ...]) -> None:
        """Serve a new connection, or close it."""
        if self.open_connections >= MAX_CONNECTIONS:
            self.live.count("connections")
            stream.close()
            return
        self.open_connections += 1
        super().handle_stream(stream, address)

    def on_close(self, server_conn: object) -> None:
        """Count a connection that has ended, or has become a stream."""
        self.open_connections -= 1
        super().on_close(server_conn)


class LiveServer:
    """Serves a session's page and stream.

    Parameters
    ----------
    address : Address
        Where to listen; port 0 takes any free one.
    session : Session
    render : callable
        Makes the page of a flight.

    Attributes
    ----------
    counters : Counters
    clients : set
        The streams that are open.

    Raises
    ------
    InputError
        When the address is busy, not ours, or cannot be resolved.
    """

    def __init__(self, address: Address, session: Session, render: Callable[[Flight], str]) -> None:
        self.session = session
        self.counters = Counters()
        self.clients: set[_Stream] = set()
        self._render = render
        self._rendered: tuple[int, str] | None = None
        self._told: Told | None = None
        self._told_revision = -1
        self._told_flight = 0
        self._told_ns = 0
        self._stopped = asyncio.Event()
        try:
            family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
            self._socket = socket.create_server(address, family=family)
        except (OSError, UnicodeError) as error:
            said = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
            reason = said.partition(" (while attempting")[0]  # the standard library repeats the address
            raise InputError(f"address {address[0]}:{address[1]}: {reason}") from None
        self.host = address[0]
        self.port = int(self._socket.getsockname()[1])
        self._socket.setblocking(False)
        self._names = {name.lower() for name in ("localhost", "127.0.0.1", "[::1]", _bracketed(address[0]))}
        application = Application(
            [(r"/", _Page), (STREAM_PATH, _Stream)],
            default_handler_class=_Nothing,
            live=self,
            log_function=lambda _handler: None,
            websocket_ping_interval=PING_S,
            websocket_max_message_size=1 << 10,
        )
        self._server = _Bounded(
            application,
            max_header_size=MAX_HEADER_BYTES,
            max_body_size=1,
            max_buffer_size=1 << 16,
            idle_connection_timeout=HEADER_TIMEOUT_S,
            body_timeout=HEADER_TIMEOUT_S,
        )
        self._server.live = self
        self._server.add_socket(self._socket)

    @property
    def url(self) -> str:
        """Where the page is."""
        any_address = self.host in ("0.0.0.0", "::", "")
        return f"http://{'127.0.0.1' if any_address else _bracketed(self.host)}:{self.port}/"

    def is_ours(self, host: str, local: tuple[Any, ...] | None) -> bool:
        """Return whether a Host header names this server.

        Our names are loopback, the address that was asked for, and the number that the connection came to: a number
        is nobody's domain, so it cannot be made to resolve to us.
        """
        names = self._names if local is None else {*self._names, _bracketed(str(local[0]).partition("%")[0])}
        allowed = {f"{name}:{self.port}" for name in names} | (names if self.port == 80 else set())
        return host.lower() in allowed

    def count(self, what: str) -> None:
        """Count something that was refused, by its name in the counters."""
        self.counters = self.counters._replace(**{what: getattr(self.counters, what) + 1})

    def page(self) -> str:
        """Return the page of the flight that is followed."""
        flight = self.session.flight
        if self._rendered is None or self._rendered[0] != flight.number:
            self._rendered = flight.number, self._render(flight)
        return self._rendered[1]

    def join(self, client: _Stream) -> None:
        """Take a new client: the others are told what is new, he everything, and then all know the same."""
        if len(self.clients) >= MAX_CLIENTS:  # several shook hands at once
            self.count("clients")
            client.drop()
            return
        self._tell_all()
        self.clients.add(client)
        self._tell(client, self.session.snapshot())

    async def run(self) -> None:
        """Follow the session and tell everybody, until :meth:`stop`."""
        while not self._stopped.is_set():
            more = self.session.step(monotonic_ns())
            if monotonic_ns() - self._told_ns >= NEWS_NS:
                self._tell_all()
                self._told_ns = monotonic_ns()
            if more:
                await asyncio.sleep(0)
                continue
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._stopped.wait(), POLL_S)

    def stop(self) -> None:
        """Let :meth:`run` end."""
        self._stopped.set()

    async def close(self) -> None:
        """Close everything."""
        self._server.stop()
        for stream in list(self.clients):
            stream.close(1001)
        await self._server.close_all_connections()

    def _tell_all(self) -> None:
        """Tell every client what is new, if anything is."""
        session, number = self.session, self.session.flight.number
        if session.revision == self._told_revision:
            return
        if self.clients:
            text = session.news(self._told) if self._told_flight == number else session.snapshot()
            for client in list(self.clients):
                self._tell(client, text)
        self._told, self._told_flight, self._told_revision = session.feed.told(), number, session.revision

    def _tell(self, client: _Stream, text: bytes) -> None:
        if not client.send(text):
            self.count("slow")
            self.clients.discard(client)
            client.drop()


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host
