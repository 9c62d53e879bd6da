"""d(k) of a flight over a link: the relay's own impairment, sampled.

What a flight sends in a sample goes through one :class:`~sitl.link.impairment.Impairment` per direction, the very one
that the relay uses, at the flight's own instants: the plant's messages at k Ts, the command as soon as all that carry
the state have come and none newer has. The plant latches the newest command that has come by k Ts; before the first
one the delay is k + 1, which Eq. (9) reads as a state of zero. What is left out: TIMESYNC and heartbeats, the time the
autopilot computes, and the plant's own failsafe.
"""

from __future__ import annotations

import math
from bisect import bisect_right, insort
from functools import lru_cache

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
from gains.model import Model
from sitl.aircraft.airframe import Pose
from sitl.aircraft.linear import LinearAirframe
from sitl.aircraft.plants import is_nonlinear
from sitl.campaign.job import Campaign
from sitl.campaign.kernel import MAX_DELAY
from sitl.link.impairment import Fate, Impairment, LinkSpec

__all__ = ["delays_over", "linked_delays"]

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
    sent, halves, command_bytes = _sizes(campaign.plant, is_nonlinear(campaign.plant_name))
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


@lru_cache(maxsize=8)
def _sizes(plant: Model, nonlinear: bool) -> tuple[tuple[int, ...], tuple[int, ...], int]:
    """Return the bytes of what a sample sends, which of them hold the state, and the bytes of a command.

    MAVLink cuts zeros off the end of a payload: what a linear aircraft does not move in costs nothing.
    """
    somewhere = plant.trim.x + np.linspace(0.1, 0.2, plant.nx)
    pose = Pose(*[1.0 / 3.0] * len(Pose._fields)) if nonlinear else LinearAirframe(plant, somewhere).pose
    angles = (pose.roll_rad, pose.pitch_rad, pose.yaw_rad, pose.p_rad_s, pose.q_rad_s, pose.r_rad_s)
    turned = round(math.degrees(pose.yaw_rad))
    carried = {field.partition(".")[0] for field in plant.sensors.values()} or {"ATTITUDE", "AOA_SSA"}
    messages: dict[str, Message] = {
        "NAMED_VALUE_INT": NamedValueInt(1, "DELAY_K", 3),
        "ATTITUDE": Attitude(1, *angles),
        "AOA_SSA": AoaSsa(1, pose.alpha_rad, pose.beta_rad),
        "VFR_HUD": VfrHud(
            pose.airspeed_m_s,
            pose.groundspeed_m_s,
            turned,
            round(100.0 * pose.throttle),
            pose.altitude_m,
            pose.climb_m_s,
        ),
    }
    if not nonlinear and "AOA_SSA" not in carried:
        del messages["AOA_SSA"]
    wire = Wire(PLANT, AUTOPILOT)
    halves = tuple(n for n, name in enumerate(messages) if name in carried)
    command = Wire(AUTOPILOT, PLANT).encode(ServoOutputRaw(1, servo2_raw=1500))
    return tuple(len(wire.encode(message)) for message in messages.values()), halves, len(command)
