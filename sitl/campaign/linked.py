"""d(k) of a flight over a link: the relay's own impairment, sampled.

What a flight sends in a sample goes through one :class:`~sitl.link.impairment.Impairment` per direction, the very one
that the relay uses, at the flight's own instants: the plant's messages at k Ts, the command as soon as all that carry
the state have come and none newer has. The plant latches the newest command that has come by k Ts; before the first
one the delay is k + 1, which Eq. (9) reads as a state of zero. What is left out: TIMESYNC and heartbeats, the time the
autopilot computes, and the plant's own failsafe.
"""

from __future__ import annotations

from bisect import bisect_right, insort
from functools import cache

import numpy as np
from numpy.typing import NDArray

from autopilot.link.wire import (
    AUTOPILOT,
    PLANT,
    AoaSsa,
    Attitude,
    Message,
    NamedValueInt,
    ServoOutputRaw,
    VfrHud,
    Wire,
)
from sitl.aircraft.plants import is_nonlinear
from sitl.campaign.job import Campaign
from sitl.campaign.kernel import MAX_DELAY
from sitl.link.impairment import Fate, Impairment, LinkSpec

__all__ = ["delays_over", "linked_delays"]

_STATE = ("ATTITUDE", "AOA_SSA")
"""What can carry a state, and does where the model does not say."""

_STREAM = 0x11AC  # of the seeds: apart from everything else that a campaign's seed feeds


def linked_delays(campaign: Campaign, start: int, stop: int) -> NDArray[np.uint8]:
    """Return d(k) of the flights from ``start`` to before ``stop``, shape (flights, samples).

    Older than ``MAX_DELAY`` samples counts as so old: what an elevator does then is no matter of this law.
    """
    sampled = np.empty((stop - start, campaign.samples), dtype=np.uint8)
    for flight in range(start, stop):
        seeds = np.random.SeedSequence(campaign.seed, spawn_key=(_STREAM, flight)).spawn(2)
        up, down = (np.random.Generator(np.random.PCG64(seed)) for seed in seeds)
        sampled[flight - start] = delays_over(campaign, up, down)
    return sampled


def delays_over(campaign: Campaign, up: np.random.Generator, down: np.random.Generator) -> NDArray[np.uint8]:
    """Return d(k) of one flight, shape (samples,).

    Parameters
    ----------
    campaign : Campaign
        Of a link.
    up, down : numpy.random.Generator
        Of the two directions.
    """
    assert campaign.link is not None
    samples, Ts_ns = campaign.samples, campaign.plant.Ts_ns
    fields = campaign.plant.sensors.values()
    carried = frozenset(field.partition(".")[0] for field in fields) or frozenset(_STATE)
    sent, halves, command_bytes = _sizes(carried, is_nonlinear(campaign.plant_name))
    upwards, downwards = _Way(campaign.link[0], up), _Way(campaign.link[1], down)
    came: list[tuple[int, int]] = []  # when the state of sample j was whole at the autopilot, and j
    for j in range(samples):
        exits = [upwards.arrival_ns(size, j * Ts_ns) for size in sent]
        whole = [exits[n] for n in halves]
        if None not in whole:
            came.append((max(at for at in whole if at is not None), j))
    latest, commands = -1, []  # when a command was at the plant, and its j
    for at_ns, j in sorted(came):
        if j > latest:
            latest = j
            arrived_ns = downwards.arrival_ns(command_bytes, at_ns)
            if arrived_ns is not None:
                commands.append((max(arrived_ns, j * Ts_ns + 1), j))  # t_j's tick latches before it sends x(j)
    return _latched(sorted(commands), samples, Ts_ns)


def _latched(commands: list[tuple[int, int]], samples: int, Ts_ns: int) -> NDArray[np.uint8]:
    """Return the age of the newest command at each sample."""
    delays = np.empty(samples, dtype=np.uint8)
    newest, n = -1, 0
    for k in range(samples):
        while n < len(commands) and commands[n][0] <= k * Ts_ns:
            newest = max(newest, commands[n][1])
            n += 1
        delays[k] = min(k - newest, MAX_DELAY)
    return delays


class _Way:
    """One direction, and what is under way in it."""

    def __init__(self, spec: LinkSpec, rng: np.random.Generator) -> None:
        self._impairment = Impairment(spec, rng)
        self._limited = spec.limit < LinkSpec().limit
        self._exits: list[int] = []

    def arrival_ns(self, size_bytes: int, now_ns: int) -> int | None:
        """Return when the first whole copy of a datagram arrives; None where none does."""
        queued = 0
        if self._limited:
            del self._exits[: bisect_right(self._exits, now_ns)]
            queued = len(self._exits)
        copies = self._impairment.step(size_bytes, now_ns, queued)
        if self._limited:
            for copy in copies:
                insort(self._exits, copy.exit_ns)
        whole = [copy.exit_ns for copy in copies if copy.fate is Fate.DELIVERED and not copy.flipped]
        return min(whole, default=None)


@cache
def _sizes(carried: frozenset[str], nonlinear: bool) -> tuple[tuple[int, ...], tuple[int, ...], int]:
    """Return the bytes of what a sample sends, which of them hold the state, and the bytes of a command.

    Parameters
    ----------
    carried : frozenset of str
        The messages that carry a state. A linear plant sends AOA_SSA only where it does.
    nonlinear : bool
        Whether the plant is.
    """
    plant = Wire(PLANT, AUTOPILOT)
    some = 1.0 / 3.0  # no zero at the end of a payload: MAVLink would cut it off
    messages: dict[str, Message] = {
        "NAMED_VALUE_INT": NamedValueInt(1, "DELAY_K", 3),
        "ATTITUDE": Attitude(1, some, some, some, some, some, some),
        "AOA_SSA": AoaSsa(1, some, some),
        "VFR_HUD": VfrHud(some, some, 1, 1, some, some),
    }
    sent = {
        name: len(plant.encode(message))
        for name, message in messages.items()
        if name != "AOA_SSA" or nonlinear or name in carried
    }
    halves = tuple(n for n, name in enumerate(sent) if name in carried)
    command = Wire(AUTOPILOT, PLANT).encode(ServoOutputRaw(1, servo2_raw=1500))
    return tuple(sent.values()), halves, len(command)
