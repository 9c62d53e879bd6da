"""The file that keeps parameters from one flight to the next: the shell around :mod:`autopilot.ground.parameters`."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import tomli_w

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
        content = (HEADER + tomli_w.dumps(values)).encode()
        handle, temporary = tempfile.mkstemp(prefix=f".{self.path.name}.", dir=self.path.parent)
        try:
            with os.fdopen(handle, "wb") as out:
                out.write(content)
            mask = os.umask(0)
            os.umask(mask)
            os.chmod(temporary, 0o666 & ~mask)
            os.replace(temporary, self.path)
        except BaseException:
            with contextlib.suppress(OSError):
                os.unlink(temporary)
            raise
