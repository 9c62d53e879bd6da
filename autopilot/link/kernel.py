"""What Linux knows of a socket or of a sleep and Python does not name: drops, buffers, times of arrival, timer slack.

Other systems do not know these, or by other names. There the answer is None or False, and nothing here raises.
"""

from __future__ import annotations

import ctypes
import socket
import struct
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from autopilot.link.clock import NS_PER_S

__all__ = [
    "STAMP_SPACE",
    "buffer_bytes",
    "dropped",
    "largest_buffer_bytes",
    "sharpen_timers",
    "stamp_arrivals",
    "stamp_of",
    "widen",
]

SO_MEMINFO = 55
"""This and the next two: ``asm-generic/socket.h``; few architectures number them otherwise, and those refuse."""
SO_RCVBUFFORCE = 33
SO_TIMESTAMPNS = 35
PR_SET_TIMERSLACK = 29
"""``linux/prctl.h``."""

_MEMINFO = struct.Struct("=9I")
_MEMINFO_DROPS = 8
_SOL_SOCKET = socket.SOL_SOCKET
_TIMESPEC = struct.Struct("@ll")
_timespec = _TIMESPEC.unpack
STAMP_SPACE = socket.CMSG_SPACE(_TIMESPEC.size) if sys.platform == "linux" else 0
"""Bytes of ancillary data that a time of arrival takes."""

_LIMIT_FILE = Path("/proc/sys/net/core/rmem_max")


def dropped(sock: socket.socket) -> int | None:
    """Return how many datagrams a full receive buffer dropped; None where the kernel does not tell."""
    try:
        info = sock.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, _MEMINFO.size)
    except OSError:
        return None
    return int(_MEMINFO.unpack(info)[_MEMINFO_DROPS]) if len(info) == _MEMINFO.size else None


def widen(sock: socket.socket, size: int) -> None:
    """Ask for a receive buffer of so many bytes, beyond the system's limit where we may; the kernel gives what it does.

    Its accounting is its own: a small datagram takes hundreds of bytes.
    """
    if sys.platform == "linux":
        with suppress(OSError):  # only root may, and those with CAP_NET_ADMIN
            sock.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, size)
            return
    with suppress(OSError):  # some systems refuse what Linux cuts to its limit
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, size)


def buffer_bytes(sock: socket.socket) -> int:
    """Return the size of the receive buffer, to be compared with what was asked: Linux reports its double."""
    size = sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
    return size // 2 if sys.platform == "linux" else size


def largest_buffer_bytes() -> int | None:
    """Return what a program without privileges may ask for, ``net.core.rmem_max``; None where that is unknown."""
    try:
        return int(_LIMIT_FILE.read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None


def stamp_arrivals(sock: socket.socket) -> bool:
    """Ask for the time of arrival with each datagram; return whether the kernel gives it."""
    if sys.platform != "linux":
        return False
    try:
        sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    except OSError:
        return False
    return True


def stamp_of(ancillary: Sequence[tuple[int, int, bytes]]) -> int | None:
    """Return the time of arrival, ns of the wall clock, that came with a datagram; None when none did."""
    for level, kind, data in ancillary:
        if kind == SO_TIMESTAMPNS and level == _SOL_SOCKET and len(data) == _TIMESPEC.size:
            seconds, ns = _timespec(data)
            stamp_ns: int = seconds * NS_PER_S + ns
            return stamp_ns
    return None


def sharpen_timers() -> bool:
    """Have this thread's sleeps end when they should, and not up to 50 us later; return whether the kernel does so."""
    if sys.platform != "linux":
        return False
    try:
        done: int = ctypes.CDLL(None).prctl(PR_SET_TIMERSLACK, ctypes.c_ulong(1), 0, 0, 0)
    except (OSError, AttributeError):
        return False
    return done == 0
