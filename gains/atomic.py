"""Replacing a file as a whole: whoever reads it finds the old content or the new, never a part."""

from __future__ import annotations

import contextlib
import os
import tempfile
from pathlib import Path

__all__ = ["replace_file"]


def replace_file(path: Path, content: bytes, *, private: bool = False, flush: bool = False) -> None:
    """Write a file; one of that name is replaced at once or not at all.

    Parameters
    ----------
    path : Path
    content : bytes
    private : bool
        Whether only the owner may read it (mode 0600); else whom the umask lets.
    flush : bool
        Whether it is on the disk on return, and so stays replaced when the power fails.

    Raises
    ------
    OSError
        When that is not possible; what was there stays.
    """
    handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)  # of mode 0600
    try:
        with os.fdopen(handle, "wb") as out:
            out.write(content)
            if flush:
                out.flush()
                os.fsync(out.fileno())
        if not private:
            mask = os.umask(0)
            os.umask(mask)
            os.chmod(temporary, 0o666 & ~mask)
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(temporary)
        raise
    if flush and os.name == "posix":
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
