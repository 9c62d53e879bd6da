"""``sitl live``: the page of a flight while it is flown."""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import secrets
import signal
import webbrowser
from contextlib import ExitStack
from pathlib import Path

import click

from autopilot.link.ports import Address, parse_address
from autopilot.link.process import ADDRESS, Parsed
from gains.command import SUCCESS
from gains.table import InputError

__all__ = ["live"]

FLIGHTS = Path("flights")
"""Where ``sitl fly`` puts its flights."""


def _parse_foxglove(text: str) -> Address:
    """Return the address written as ``[HOST:]PORT``, on 127.0.0.1 unless a host is named."""
    try:
        return parse_address(text if ":" in text else f"127.0.0.1:{text}")
    except InputError:
        raise InputError(f'--foxglove "{text}": expected [HOST:]PORT, such as 8765') from None


@click.command("live")
@click.argument("source", metavar="[FLIGHT.mcap|FOLDER]", default=FLIGHTS, type=click.Path(path_type=Path))
@click.option("--listen", type=ADDRESS, default="127.0.0.1:8080", show_default=True, help="Where the page is served.")
@click.option("--foxglove", "foxglove_address", type=Parsed("[HOST:]PORT", _parse_foxglove),
              help="Serve the records to Foxglove, too, as at 8765.")  # fmt: skip
@click.option("--open", "open_browser", is_flag=True, help="Open the page in the browser.")
def live(source: Path, listen: Address, foxglove_address: Address | None, open_browser: bool) -> int:
    """Show a flight in the browser while it is flown: the newest below flights, and each newer one.

    It reads the recording as it grows, so any program's --record can be followed, and no flight notices.
    Ctrl-C ends it.
    """
    with contextlib.suppress(KeyboardInterrupt):  # before the loop could take it
        asyncio.run(_serve(source, listen, foxglove_address, open_browser=open_browser))
    return SUCCESS


async def _serve(source: Path, listen: Address, foxglove_address: Address | None, *, open_browser: bool) -> None:
    """Serve until Ctrl-C or SIGTERM."""
    from sitl.live.foxglove import FoxgloveStream  # either takes its time to import
    from sitl.live.page import render
    from sitl.live.server import LiveServer
    from sitl.live.session import Session

    run = secrets.token_hex(8)
    with ExitStack() as stack:
        if foxglove_address is None:
            session = Session(source, run)
        else:
            stream = FoxgloveStream(foxglove_address)
            stack.callback(stream.close)
            session = Session(source, run, stream.begin, stream.take)
            _say_exposed("--foxglove", stream.address)
            click.echo(f"Foxglove: ws://{_written(stream.address)}", err=True)
        stack.callback(session.close)
        server = LiveServer(listen, session, lambda flight: render(flight, run))
        loop = asyncio.get_running_loop()
        for signum in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(signum, server.stop)
        _say_exposed("--listen", listen)
        click.echo(f"{server.url} shows {source}; Ctrl-C ends it", err=True)
        if open_browser:
            webbrowser.open(server.url)
        try:
            await server.run()
        finally:
            await server.close()


def _say_exposed(option: str, address: Address) -> None:
    """Warn where other machines can read along."""
    try:
        local = address[0] == "localhost" or ipaddress.ip_address(address[0]).is_loopback
    except ValueError:
        local = False
    if not local:
        click.echo(f"sitl: warning: {option} {_written(address)}: other machines can read this flight", err=True)


def _written(address: Address) -> str:
    host, port = address
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
