"""A minute of well-formed frames that lie about stamps, numbers, delays and clocks, mixed with a plant's own.

Each frame passes for the plant's: no checksum and no address tells it apart. Nothing that one of them says may
last, so that the plant is flown again when they have ended.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeVar

import numpy as np
import pytest
from numpy.typing import NDArray

from autopilot.failsafe import Mode
from autopilot.link.node import Datagram
from autopilot.link.record import encode_line
from autopilot.link.wire import AUTOPILOT, PLANT, AoaSsa, Attitude, Message, NamedValueInt, Timesync, Wire
from sitl.plant import PORT, PlantConfig, PlantNode
from tests.helpers import HIRM, MS, PLANT_CLOCK, Flight, S, constant, parse

HOSTILE_S, HONEST_S = 60, 20
U32_MAX, U64_MAX, I64_MAX = (1 << 32) - 1, (1 << 64) - 1, (1 << 63) - 1
WILD = (0, 1, 1 << 31, U32_MAX, 1 << 32, 10**15, 10**18, 1 << 61, I64_MAX, U64_MAX)
NEAR_NS = (0, MS, -MS, 100 * MS, -100 * MS, 900 * MS, -900 * MS, 5 * S, -5 * S, 864_000 * S)


T = TypeVar("T")


class LyingPlant(PlantNode):
    """A plant among whose frames others are mixed, between two of its own times."""

    def __init__(self, config: PlantConfig, seed: int, from_ns: int, until_ns: int, x0: NDArray[np.float64]) -> None:
        super().__init__(config)
        self.rng = np.random.default_rng(seed)
        self.from_ns, self.until_ns = from_ns, until_ns
        self.now_ns, self.asked_ns, self.forged = 0, 1, 0
        self.x0 = x0
        self.mouth = Wire(PLANT, AUTOPILOT)

    def receive(self, port: str, datagram: bytes, now_ns: int) -> None:
        self.now_ns = now_ns
        for message in parse(datagram):
            if message.get_type() == "TIMESYNC" and message.tc1 == 0:
                self.asked_ns = message.ts1
        super().receive(port, datagram, now_ns)

    def tick(self, now_ns: int) -> None:
        self.now_ns = now_ns
        super().tick(now_ns)

    def outgoing(self) -> list[Datagram]:
        out = super().outgoing()
        if out and self.from_ns <= self.now_ns < self.until_ns:
            for _ in range(self._pick((0, 0, 1, 3))):
                lies = [(PORT, self.mouth.encode(message)) for message in self._lie()]
                self.forged += len(lies)
                out = lies + out if self.rng.random() < 0.5 else out + lies
        return out

    def _pick(self, among: Sequence[T]) -> T:
        return among[self.rng.integers(len(among))]

    def _lie(self) -> list[Message]:
        """Return one forged frame, or both halves of a forged sample."""
        rng, pick = self.rng, self._pick
        near_ns = max(1, self.now_ns + pick(NEAR_NS))
        stamp_ns = pick((near_ns, near_ns, pick(WILD) * 1000, int(rng.integers(1 << 62))))
        ms, us = (stamp_ns // MS) & U32_MAX, min(stamp_ns // 1000, U64_MAX)
        number = pick((int(rng.integers(5001)), 10**6, (1 << 31) - 1, -(1 << 31), -1))
        theta = pick((0.0, 0.05, -1.0, 3e38))
        attitude = Attitude(ms, 0.0, theta, 0.0, 0.0, self.x0[1], 0.0)
        air = AoaSsa(us, math.degrees(self.x0[0]), 0.0)
        match int(rng.integers(6)):
            case 0:
                return [NamedValueInt(ms, "SAMPLE_K", number)]
            case 1:
                return [NamedValueInt(ms, "DELAY_K", pick((number, int(rng.integers(-3, 13)))))]
            case 2:
                return [attitude, air]
            case 3:
                return [attitude]
            case 4:
                return [AoaSsa(pick((us, pick(WILD))), 1.0, 0.0)]
            case _:
                answer = pick((near_ns, pick((*WILD[:-1], -1, -I64_MAX))))
                return [Timesync(answer or 1, pick((self.asked_ns, self.asked_ns, int(rng.integers(1 << 60)))))]


@pytest.mark.parametrize("after_s", [0, 10], ids=["before the first lock", "in flight"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_plant_is_flown_again_after_a_minute_of_lies(seed: int, after_s: int) -> None:
    flight = Flight(up=constant(12 * MS), down=constant(12 * MS))
    from_ns = PLANT_CLOCK.offset_ns + after_s * S
    until_ns = from_ns + HOSTILE_S * S
    flight.plant = plant = LyingPlant(flight.plant_config, seed, from_ns, until_ns, np.full(HIRM.model.nx, 0.01))
    flight.network.replace("plant", plant, PLANT_CLOCK)
    flight.fly((after_s + HOSTILE_S) * S)
    assert plant.forged > 1000
    flight.fly((after_s + HOSTILE_S + HONEST_S) * S)
    assert flight.autopilot.failsafe.mode is Mode.TRACKING
    for at_ns, record in flight._records:
        encode_line(record, at_ns)
    numbers = {body["t_ns"] // 1000: body["k"] for body in flight.bodies("plant/truth")[-100:]}
    last = flight.bodies("autopilot/command")[-10:]
    assert [numbers[c["sample_ns"] // 1000] for c in last] == [c["j"] for c in last]
