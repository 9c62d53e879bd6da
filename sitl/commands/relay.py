"""``sitl relay``: a link, or several, as a program of its own; its subcommands talk to one that runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from autopilot.link.clock import NS_PER_US
from autopilot.link.ports import WIDE_BUFFER_BYTES
from autopilot.link.process import ADDRESS, Parsed, ProcessOptions, process_options, run_node
from autopilot.link.udp import MAX_SPIN_NS, Address, UdpPort, answer, dial, listen
from autopilot.link.wire import AUTOPILOT, frames_of
from gains.command import version
from gains.table import InputError
from gains.witnessfile import read_witness
from sitl.commands.links import link_options
from sitl.commands.options import FILE, SEED
from sitl.link.changes import format_time, parse_time_ns
from sitl.link.control import DEFAULT_CONTROL
from sitl.link.direction import LinkConfig
from sitl.link.gate import Gate, check_flyable
from sitl.link.presets import parse_link
from sitl.link.relay import CONTROL_PORT, DEFAULT_LOG_RATE, RelayNode
from sitl.link.relayfile import RelayLink, load_relay, parse_changes, parse_rules

__all__ = ["DEFAULT_SPIN_NS", "relay"]

DEFAULT_SPIN_NS = 300 * NS_PER_US
"""How long before a packet is to leave the relay stops sleeping."""

MAX_LOG_RATE = 1_000_000

COMMANDS = {name: f"sitl.commands.relaycontrol:{name}_command" for name in ("set", "show", "watch")}
"""Subcommands, and where they are: a relay that starts again in flight has no time for them."""

_ONE_LINK = frozenset(
    ("address", "to", "peer", "accept", "preset", "up", "down", "seed", "witness_name", "rule_texts", "change_texts")
)
"""Options that describe the only link, and that a file takes the place of."""


class _Loaded(click.Group):
    """A group whose subcommands are imported when they are asked for."""

    def list_commands(self, _ctx: click.Context) -> list[str]:
        """Return the names."""
        return sorted(COMMANDS)

    def get_command(self, _ctx: click.Context, name: str) -> click.Command | None:
        """Return a subcommand; None when there is none of this name."""
        if name not in COMMANDS:
            return None
        module, _, attribute = COMMANDS[name].partition(":")
        command: click.Command = getattr(import_module(module), attribute)
        return command


def _parse_spin(text: str) -> int:
    spin_ns = parse_time_ns(text, "--spin")
    if spin_ns > MAX_SPIN_NS:
        raise InputError(f"--spin: expected at most {format_time(MAX_SPIN_NS)}, found {text}")
    return spin_ns


@click.group(cls=_Loaded, invoke_without_command=True)
@click.option("--listen", "address", type=ADDRESS, default="127.0.0.1:14601", show_default=True)
@click.option("--to", type=ADDRESS, default="127.0.0.1:14600", show_default=True, help="The plant.")
@click.option("--peer", type=ADDRESS, help="The one client to hear; else the first that sends a valid frame.")
@click.option("--accept", type=click.Choice(["mavlink", "any"]), default="mavlink", show_default=True,
              help="What a client must send to be heard: a frame of the autopilot, or anything.")  # fmt: skip
@link_options
@click.option("--seed", type=SEED, default=1, show_default=True)
@click.option("--witness", "witness_name", type=click.Path(dir_okay=False),
              help="Time the commands so that the plant lives the delay sequence of this file.")  # fmt: skip
@click.option("--rule", "rule_texts", multiple=True,
              help="Another SPEC for some messages: up:ATTITUDE+AOA_SSA:delay=40ms; may be repeated.")  # fmt: skip
@click.option("--at", "change_texts", multiple=True,
              help="Another SPEC from a link time on, as in 3s:up:loss=0.5; may be repeated.")  # fmt: skip
@click.option("--config", type=FILE, help="The links, one or several, from this TOML file (docs/links.md).")
@click.option("--control", type=ADDRESS, is_flag=False, flag_value=DEFAULT_CONTROL, metavar="[ADDRESS]",
              help=f"Take requests of this machine's programs, at {DEFAULT_CONTROL} or another address.")  # fmt: skip
@click.option("--spin", "spin_ns", type=Parsed("TIME", _parse_spin), default=format_time(DEFAULT_SPIN_NS),
              show_default=True, help="Stop sleeping so long before a packet is to leave.")  # fmt: skip
@click.option("--log-rate", type=click.IntRange(0, MAX_LOG_RATE), default=DEFAULT_LOG_RATE, show_default=True,
              help="Record at most so many packets a second, and count the others.")  # fmt: skip
@process_options
@click.pass_context
def relay(
    context: click.Context,
    /,
    config: Path | None,
    control: Address | None,
    spin_ns: int,
    log_rate: int,
    clock: Any,
    record: Any,
    stream: Any,
    **link: Any,
) -> None:
    """Delay, lose and reorder what passes between a client and the plant. Runs until Ctrl-C.

    The subcommands change and show a relay that was started with --control.
    """
    given = [name for name in context.params if context.get_parameter_source(name) is ParameterSource.COMMANDLINE]
    if context.invoked_subcommand is not None:
        if given:
            raise click.UsageError(f"{context.invoked_subcommand}: expected its options after it, found some before")
        return
    options = ProcessOptions(clock, record, stream)
    if record is None and stream is None:
        log_rate = 0  # nobody takes the records
    if config is None:
        node, openers = _one_link(link, log_rate)
        metadata = {"program": "sitl relay", "seed": str(link["seed"]), "lagproof": version()}
    else:
        if not _ONE_LINK.isdisjoint(given):
            raise InputError(f"--config {config}: expected no other option of a link, which the file describes")
        node, openers = _links_of(load_relay(config), log_rate)
        metadata = {"program": "sitl relay", "config": str(config), "lagproof": version()}
    ends = len(openers)
    if control is not None:
        openers.append(partial(answer, CONTROL_PORT, control))
    run_node("relay", node, openers, options, metadata, tap=False, control=ends, spin_ns=spin_ns, at_end=node.close)


def _one_link(given: Mapping[str, Any], log_rate: int) -> tuple[RelayNode, list[Callable[[], UdpPort]]]:
    """Return a relay of the link that the command line describes, and what opens its ports."""
    witness = None if given["witness_name"] is None else read_witness(given["witness_name"])
    if witness is not None:
        check_flyable(witness, given["witness_name"])
    node = RelayNode(
        *parse_link(given["preset"], given["up"], given["down"]),
        given["seed"],
        None if witness is None else Gate(witness),
        rules=parse_rules(given["rule_texts"], "--rule"),
        changes=parse_changes(given["change_texts"], "--at"),
        stamped=True,
        log_rate=log_rate,
    )
    ends = _openers("", given["address"], given["to"], given["peer"], accept_any=given["accept"] == "any")
    return node, ends


def _links_of(links: Sequence[RelayLink], log_rate: int) -> tuple[RelayNode, list[Callable[[], UdpPort]]]:
    """Return a relay of the links of a file, and what opens its ports."""
    configs: list[LinkConfig] = [link.config for link in links]
    node = RelayNode.joining(configs, stamped=True, log_rate=log_rate)
    openers: list[Callable[[], UdpPort]] = []
    for link in links:
        prefix = f"{link.config.name}/" if len(links) > 1 else ""
        openers += _openers(prefix, link.listen, link.to, link.peer, accept_any=link.accept_any)
    return node, openers


def _openers(
    prefix: str, address: Address, to: Address, peer: Address | None, *, accept_any: bool
) -> list[Callable[[], UdpPort]]:
    """Return what opens the two ends of a link."""
    heard = (lambda _datagram: True) if accept_any else frames_of(AUTOPILOT)
    wide: dict[str, Any] = {"stamps": True, "buffer_bytes": WIDE_BUFFER_BYTES}
    return [
        partial(listen, f"{prefix}autopilot", address, peer=peer, accept=heard, **wide),
        partial(dial, f"{prefix}plant", to, **wide),
    ]
