"""The ``sitl`` program: the world around the autopilot, piece by piece or as one flight.

Each subcommand is a module of its own, loaded when it is called: a program that starts again in the middle of a
flight has no time for what it does not use.
"""

from __future__ import annotations

from importlib import import_module

import click

from gains.command import run, version

__all__ = ["main"]

COMMANDS = {
    "adversary": "sitl.commands.adversary:adversary",
    "campaign": "sitl.commands.campaign:campaign",
    "fly": "sitl.commands.fly:fly_command",
    "linearize": "sitl.commands.linearize:linearize",
    "links": "sitl.commands.links:links",
    "live": "sitl.commands.live:live",
    "plant": "sitl.commands.plant:plant",
    "rare": "sitl.commands.rare:rare_command",
    "recover": "sitl.commands.recover:recover_command",
    "relay": "sitl.commands.relay:relay",
    "replay": "sitl.commands.replay:replay",
    "report": "sitl.commands.report:report",
    "reproduce": "sitl.commands.reproduce:reproduce",
    "scenarios": "sitl.commands.fly:scenarios",
    "teach": "sitl.commands.teach:teach",
}
"""Subcommands, and where they are."""


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


@click.group(cls=_Loaded, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(version())
def cli() -> None:
    """Fly the autopilot in the loop: aircraft, link, scenarios, recordings."""


def main() -> None:
    """Run the ``sitl`` command."""
    run(cli, "sitl")


if __name__ == "__main__":
    main()
