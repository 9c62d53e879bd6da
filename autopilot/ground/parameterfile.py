"""The file that keeps parameters from one flight to the next: the shell around :mod:`autopilot.ground.parameters`."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import tomli_w

from gains.atomic import replace_file
from gains.table import Table

__all__ = ["ParameterFile"]

HEADER = "# The vehicle's parameters, as far as they differ from their defaults.\n"


@dataclass(frozen=True, slots=True)
class ParameterFile:
    """A TOML file of parameters, which may not be there yet.

    Parameters
    ----------
    path : Path
    """

    path: Path

    def read(self) -> Table | None:
        """Return what the file holds, None when there is no such file.

        Raises
        ------
        InputError
            When it cannot be read, or is no TOML.
        """
        try:
            os.stat(self.path)
        except FileNotFoundError:
            return None
        except (OSError, ValueError):
            pass  # reading it says what is wrong
        return Table.load(self.path)

    def write(self, values: Mapping[str, object]) -> None:
        """Write the values; a file that is there is replaced at once or not at all.

        Raises
        ------
        OSError
            When that is not possible; the old file stays.
        """
        replace_file(self.path, (HEADER + tomli_w.dumps(values)).encode())
