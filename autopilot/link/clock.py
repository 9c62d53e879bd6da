"""Clocks of nodes: integer nanoseconds, an offset and a drift against true time; counters that wrap.

A node never reads a clock. Its driver holds the node's :class:`Clock` and maps true time to the node's
time and back, exactly, in integers. A node's clock starts at its offset when the node boots, so that a
restart is a jump back, as on real hardware.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["NS_PER_MS", "NS_PER_S", "NS_PER_US", "Clock", "following", "unwrap"]

NS_PER_US = 1_000
NS_PER_MS = 1_000_000
NS_PER_S = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Clock:
    """A node's clock: node = offset + (true - boot) * (1 + drift).

    Attributes
    ----------
    offset_ns : int
        What the clock shows at boot.
    drift_ppb : int
        How much faster than true time it runs, in parts per billion.
    boot_ns : int
        The true time of boot.
    """

    offset_ns: int = 0
    drift_ppb: int = 0
    boot_ns: int = 0

    def node_ns(self, true_ns: int) -> int:
        """Return what the clock shows at a true time, rounded down."""
        elapsed_ns = true_ns - self.boot_ns
        return self.offset_ns + elapsed_ns + elapsed_ns * self.drift_ppb // NS_PER_S

    def true_ns(self, node_ns: int) -> int:
        """Return the earliest true time at which the clock shows at least ``node_ns``."""
        wanted_ns = node_ns - self.offset_ns
        return self.boot_ns - (-wanted_ns * NS_PER_S // (NS_PER_S + self.drift_ppb))  # rounded up


def following(due_ns: int, period_ns: int, now_ns: int) -> int:
    """Return when something periodic that was due is due again: on its grid, but never twice to catch up."""
    return due_ns + max(1, -(-(now_ns + 1 - due_ns) // period_ns)) * period_ns


def unwrap(value: int, near: int, modulus: int) -> int:
    """Return the number congruent to ``value`` that lies nearest to ``near``.

    MAVLink sends some times as counters that wrap (u32 microseconds after 71.6 minutes, u32
    milliseconds after 49.7 days). The result may be below ``near``: an older stamp is not a wrap.
    """
    behind = (near - value) % modulus
    return near - behind if behind <= modulus // 2 else near + modulus - behind
