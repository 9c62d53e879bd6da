"""``sitl relay``: a link as a program of its own."""

from __future__ import annotations

from functools import partial
from typing import Any

import click

from autopilot.link.process import ADDRESS, ProcessOptions, process_options, run_node
from autopilot.link.udp import Address, dial, listen
from autopilot.link.wire import AUTOPILOT, frames_of
from gains.command import version
from gains.witnessfile import read_witness
from sitl.commands.links import link_options
from sitl.commands.options import SEED
from sitl.link.gate import Gate, check_flyable
from sitl.link.presets import parse_link
from sitl.link.relay import RelayNode

__all__ = ["relay"]


@click.command()
@click.option("--listen", "address", type=ADDRESS, default="127.0.0.1:14601", show_default=True)
@click.option("--to", type=ADDRESS, default="127.0.0.1:14600", show_default=True, help="The plant.")
@click.option("--peer", type=ADDRESS, help="The one client to hear; else the first that sends a valid frame.")
@click.option("--accept", type=click.Choice(["mavlink", "any"]), default="mavlink", show_default=True,
              help="What a client must send to be heard: a frame of the autopilot, or anything.")  # fmt: skip
@link_options
@click.option("--seed", type=SEED, default=1, show_default=True)
@click.option("--witness", "witness_name", type=click.Path(dir_okay=False),
              help="Time the commands so that the plant lives the delay sequence of this file.")  # fmt: skip
@process_options
def relay(
    address: Address,
    to: Address,
    peer: Address | None,
    accept: str,
    preset: str | None,
    up: str | None,
    down: str | None,
    seed: int,
    witness_name: str | None,
    **process: Any,
) -> None:
    """Delay, lose and reorder what passes between a client and the plant. Runs until Ctrl-C."""
    link = parse_link(preset, up, down)
    witness = None if witness_name is None else read_witness(witness_name)
    if witness is not None:
        check_flyable(witness, str(witness_name))
    heard = frames_of(AUTOPILOT) if accept == "mavlink" else lambda _datagram: True
    openers = [partial(listen, "autopilot", address, peer=peer, accept=heard), partial(dial, "plant", to)]
    metadata = {"program": "sitl relay", "seed": str(seed), "lagproof": version()}
    node = RelayNode(*link, seed, None if witness is None else Gate(witness))
    run_node("relay", node, openers, ProcessOptions(**process), metadata, tap=False, control=len(openers))
