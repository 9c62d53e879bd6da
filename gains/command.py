"""What the command lines of the three programs share: exit codes, complaints on one line, JSON.

Exit 0 on success; 1 when the answer is negative or undecided; 2 on bad input, with one line on stderr;
130 after Ctrl-C; 141 when the reader of standard output went away.
"""

from __future__ import annotations

import io
import math
import os
import sys
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any, NoReturn

import click
import numpy as np
import orjson

from gains.table import InputError

__all__ = ["BAD_INPUT", "NEGATIVE", "SUCCESS", "FiniteRange", "print_json", "require_writable", "run", "version"]

SUCCESS = 0
NEGATIVE = 1
BAD_INPUT = 2
_INTERRUPTED = 130
_BROKEN_PIPE = 141


class FiniteRange(click.FloatRange):
    """A range of numbers that NaN and infinity are not in."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Parse a number and refuse those that are none."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number.", param, ctx)
        return number


def version() -> str:
    """Return the version of the installed distribution."""
    try:
        return metadata.version("lagproof")
    except metadata.PackageNotFoundError:
        return "unknown (not installed)"


def require_writable(path: Path) -> None:
    """Refuse a file that cannot be written, before it is computed.

    Raises
    ------
    InputError
        When there is no folder for it, or it may not be written.
    """
    folder = path.resolve().parent
    if not folder.is_dir():
        raise InputError(f"{path}: expected a folder to write to, found none at {folder}")
    if path.is_dir() or not os.access(path if path.exists() else folder, os.W_OK):
        raise InputError(f"{path}: expected a file that can be written")


def print_json(obj: object) -> None:
    """Print one JSON object and a newline on standard output; NaN and infinities become null."""
    options = orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_NON_STR_KEYS | orjson.OPT_APPEND_NEWLINE
    click.echo(orjson.dumps(obj, default=_plain, option=options), nl=False)


def run(cli: click.Command, prog: str) -> NoReturn:
    """Run a command line and end the process with its exit code.

    A command ends with ``return code``, ``raise SystemExit(code)``, or nothing for success; it raises
    :class:`~gains.table.InputError` for bad input. An ``OSError`` that it lets through, such as a full
    disk, is bad input too; any other exception is a bug and keeps its traceback.

    Parameters
    ----------
    cli : click.Command
    prog : str
        The program's name, for its usage and its complaints.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # names in files are any Unicode
    code = _call(cli, prog)
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        code = _BROKEN_PIPE
    except OSError as error:
        code = _complain(prog, _reason(error))
    if code == _BROKEN_PIPE:
        _discard_output()
    sys.exit(code)


def _call(cli: click.Command, prog: str) -> int:
    """Return the exit code of a command line; complaints are printed."""
    stdout = sys.stdout
    try:
        return _exit_code(cli.main(prog_name=prog, standalone_mode=False))
    except SystemExit as exit_:
        # A broken pipe arrives as an exit: click has replaced standard output, rich has chained the error.
        if sys.stdout is not stdout or isinstance(exit_.__context__, BrokenPipeError):
            return _BROKEN_PIPE
        return _exit_code(exit_.code)
    except InputError as error:
        return _complain(prog, str(error))
    except click.exceptions.NoArgsIsHelpError as error:
        command = error.ctx.command_path if error.ctx else prog
        return _complain(prog, f"expected a command, found none (see '{command} --help')")
    except click.UsageError as error:
        command = error.ctx.command_path if error.ctx else prog
        return _complain(prog, f"{error.format_message()} (see '{command} --help')")
    except click.ClickException as error:
        return _complain(prog, error.format_message())
    except (click.Abort, KeyboardInterrupt):
        return _INTERRUPTED
    except OSError as error:  # the disk is full, a file cannot be written: no fault of the program
        return _complain(prog, _reason(error))


def _exit_code(value: object) -> int:
    return value if isinstance(value, int) else SUCCESS


def _complain(prog: str, message: str) -> int:
    click.echo(f"{prog}: error: {' '.join(message.split())}", err=True)
    return BAD_INPUT


def _reason(error: OSError) -> str:
    reason = error.strerror or str(error)
    return f"{error.filename}: {reason}" if error.filename else reason


def _discard_output() -> None:
    """Send standard output nowhere, so that the interpreter's own flush at exit stays silent."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.close(nowhere)


def _plain(value: object) -> object:
    """Return what orjson cannot write in a form that it can."""
    if isinstance(value, np.ndarray):  # not contiguous
        return value.tolist()
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"cannot be written as JSON: {type(value).__name__}")
