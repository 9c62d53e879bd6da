"""``sitl relay set``, ``show`` and ``watch``: what is said to a relay that runs with ``--control``."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from threading import Event
from typing import Any

import click
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from autopilot.link.process import ADDRESS
from autopilot.link.udp import Address
from gains.command import NEGATIVE, print_json
from gains.table import InputError
from sitl.commands.links import link_options
from sitl.link.control import DEFAULT_CONTROL, MAX_REPLY_BYTES, MAX_REQUEST_BYTES, decode_reply, encode_request
from sitl.link.rules import WAYS

__all__ = ["set_command", "show_command", "watch_command"]

ANSWER_S = 1.0
"""A relay that has not answered by then is none."""

WATCH_S = 0.5

MAX_STRAY = 16
"""Datagrams that are no reply to the request, taken before giving up: the socket is connected, so there are none."""

_CONTROL = click.option(
    "--control", type=ADDRESS, default=DEFAULT_CONTROL, show_default=True, help="Where the relay takes requests."
)
_NAME = click.option("--name", help="The link, where the relay has several.")


class NoAnswer(Exception):
    """No relay answered; the message says where."""


class Caller:
    """Asks one relay, and waits for its answers."""

    def __init__(self, address: Address) -> None:
        self._where = f"{address[0]}:{address[1]}"
        try:
            family, _, _, _, resolved = socket.getaddrinfo(*address, type=socket.SOCK_DGRAM)[0]
            self._socket = socket.socket(family, socket.SOCK_DGRAM)
            self._socket.settimeout(ANSWER_S)
            self._socket.connect(resolved)
        except OSError as error:
            raise InputError(f"address {self._where}: {error.strerror or error}") from None
        self._asked = 0

    def ask(self, do: str, **fields: str | None) -> dict[str, Any]:
        """Return the reply to a request.

        Raises
        ------
        InputError
            When the relay refuses it.
        NoAnswer
            When nobody answers.
        """
        self._asked += 1
        request = encode_request(self._asked, do, **fields)
        if len(request) > MAX_REQUEST_BYTES:
            raise InputError(f"request: expected at most {MAX_REQUEST_BYTES} bytes, found {len(request)}")
        with suppress(OSError):
            self._socket.send(request)
            for _ in range(MAX_STRAY):
                reply = decode_reply(self._socket.recv(MAX_REPLY_BYTES), self._asked)
                if reply is not None:
                    return reply
        raise NoAnswer(f"relay at {self._where}: no answer within {ANSWER_S:g} s: was it started with --control?")

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


@contextmanager
def _calling(address: Address) -> Iterator[Caller]:
    """Give a caller; end the program with one line when nobody answers it."""
    caller = Caller(address)
    try:
        yield caller
    except NoAnswer as nobody:
        click.echo(f"sitl: error: {nobody}", err=True)
        raise SystemExit(NEGATIVE) from None
    finally:
        caller.close()


@click.command("set")
@_CONTROL
@_NAME
@link_options
def set_command(control: Address, name: str | None, preset: str | None, up: str | None, down: str | None) -> None:
    """Change a link while it runs; a direction that is not named stays as it is.

    What is printed repeats the change exactly in another run with the same seed.
    """
    with _calling(control) as caller:
        reply = caller.ask("set", link=name, preset=preset, up=up, down=down)
    for text in reply["at"]:
        click.echo(f"--at {text}")


@click.command("show")
@_CONTROL
@_NAME
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def show_command(control: Address, name: str | None, as_json: bool) -> None:
    """Show what the links do: SPECs, counters, rates, delays asked for and achieved."""
    with _calling(control) as caller:
        reply = caller.ask("show", link=name)
    if as_json:
        print_json({"links": reply["links"], "control": reply["control"]})
    else:
        Console().print(status_view(reply["links"]))


@click.command("watch")
@_CONTROL
@_NAME
def watch_command(control: Address, name: str | None) -> None:
    """Show the same, live, until Ctrl-C."""
    pause = Event()
    with _calling(control) as caller, suppress(KeyboardInterrupt):
        reply = caller.ask("show", link=name)
        with Live(status_view(reply["links"]), auto_refresh=False) as live:
            while not pause.wait(WATCH_S):
                live.update(status_view(caller.ask("show", link=name)["links"]), refresh=True)


def status_view(links: Mapping[str, Any]) -> Group:
    """Return links as tables: one for each, with a column for each direction."""
    return Group(*(_link_table(name, status) for name, status in links.items()))


def _link_table(name: str, status: Mapping[str, Any]) -> Table:
    table = Table(title=Text(f"{name}, {status['link_ns'] / 1e9:.1f} s"), title_justify="left")
    for header in ("", *WAYS):
        table.add_column(header, overflow="fold")
    for title, read in _ROWS.items():
        table.add_row(title, *(Text(read(status[way])) for way in WAYS))
    for way in WAYS:
        for rule in status[way].get("rules", ()):
            told = f"{rule['rule'].partition(':')[2]}\n{_counts(rule)}, {rule['queued']} queued"
            table.add_row("rule", *(Text(told if column == way else "") for column in WAYS))
    return table


def _counts(counters: Mapping[str, Any]) -> str:
    """Return the fates in one line; what never happened is left out."""
    told = [f"{counters['sent']} sent", f"{counters['delivered']} delivered"]
    rare = ("lost", "refused", "gated", "duplicated", "reordered")
    return ", ".join([*told, *(f"{counters[name]} {name}" for name in rare if counters[name])])


def _delays(quantiles: Mapping[str, int] | None) -> str:
    if quantiles is None:
        return "-"
    return ", ".join(f"{name} {value / 1e6:.3f} ms" for name, value in quantiles.items())


def _rate(way: Mapping[str, Any]) -> str:
    return f"{way['rate_hz']:.0f} packets/s, {way['rate_bps'] / 1000:.1f} kbit/s"


_ROWS: Mapping[str, Callable[[Mapping[str, Any]], str]] = {
    "SPEC": lambda way: str(way["spec"]),
    "to come": lambda way: "\n".join(way["next_changes"]) or "-",
    "packets": _counts,
    "queue": lambda way: str(way["queued"]),
    "rate": _rate,
    "delay asked for": lambda way: _delays(way["requested_ns"]),
    "delay achieved": lambda way: _delays(way["achieved_ns"]),
    "off by": lambda way: _delays(way["error_ns"]),
}
"""The rows of a link's table, each from one direction's status."""
