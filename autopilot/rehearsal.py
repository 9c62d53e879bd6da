"""Rehearsal: an understudy flies a sample of its own, so that the next real one finds the way through the caches warm.

Between two samples a processor forgets: what runs on it meanwhile, and on its siblings, empties the caches, and a
command that takes 30 us when samples follow at once takes 100 us when they come every 25 ms. A ``busy`` autopilot,
which waits without sleeping, therefore flies an understudy meanwhile: a second node with the same gains and options,
against the linear model, in a time of its own. It hears nothing from outside, and nothing that it says leaves this
module. A sample takes it a tenth of a millisecond, and half of one when it renews its law of the transits, once in
some hundred.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from itertools import cycle

import numpy as np

from autopilot.app import PLANT_PORT, AutopilotNode
from autopilot.config import AutopilotConfig
from autopilot.link.clock import NS_PER_MS, NS_PER_S, NS_PER_US
from autopilot.link.sensors import sensors_of
from autopilot.link.wire import (
    AUTOPILOT,
    PLANT,
    U32,
    AoaSsa,
    Attitude,
    HilActuatorControls,
    Message,
    NamedValueInt,
    ServoOutputRaw,
    Timesync,
    VfrHud,
    Wire,
)

__all__ = ["Rehearsal"]

GUST_RAD = 1e-5
"""What moves each state at each sample: one that stands still is taken for a frozen sensor."""
GUST_RAD_PER_SAMPLE = 0.3
"""Phase of that motion."""
AIRSPEED_M_S = 100.0

TRANSIT_SHARES = (0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.6)
"""Transits of its TIMESYNC requests in turn, as shares of Ts: one alone would leave a forecast nothing to weigh."""


class Rehearsal:
    """A flight that nobody sees.

    Parameters
    ----------
    config : AutopilotConfig
        What the real autopilot flies. Ground stations, signing, stored parameters and other gains are left out.
    begin_ns : int
        The time with which the flight begins.

    Attributes
    ----------
    node : AutopilotNode
        The understudy.
    samples : int
        How many it has been sent.
    """

    def __init__(self, config: AutopilotConfig, begin_ns: int = NS_PER_S) -> None:
        self.node = AutopilotNode(
            replace(
                config,
                saturation_ns=0,
                ground_timeout_ns=0,
                ground_stations=0,
                wait_arm=False,
                alternatives=(),
                parameters=None,
                seals={},
            )
        )
        self.samples = 0
        model = config.gains.model
        self._model, self._sensors = model, sensors_of(model)
        self._begin_ns = begin_ns
        self._wire = Wire(PLANT, AUTOPILOT)
        self._d = config.gains.d_min
        self._age_ns = (self._d - 1) * model.Ts_ns + model.Ts_ns // 2  # the middle of what latches at d_min
        self._now_ns = begin_ns + self._age_ns
        self._transits = cycle(round(share * model.Ts_ns) for share in TRANSIT_SHARES)
        self._requests: list[tuple[int, Timesync]] = []
        self._x = np.array(model.trim.x)
        self._u = self.node.pilot.travel.neutral
        self._coming = deque([self._u] * (self._d - 1))

    def once(self) -> None:
        """Fly one sample: what is due, the plant's messages, the command, and what it does to the model."""
        node, k, Ts_ns = self.node, self.samples, self._model.Ts_ns
        t_ns = self._begin_ns + k * Ts_ns
        self._now_ns = t_ns + self._age_ns
        self._answer()
        due_ns = node.next_deadline_ns()
        if due_ns is not None and due_ns <= self._now_ns:
            node.tick(self._now_ns)
            self._heard()
        ms = t_ns // NS_PER_MS & U32
        if k == 0:
            self._say(NamedValueInt(ms, "SAMPLE_K", 0))
        if k >= self._d:
            self._say(NamedValueInt(ms, "DELAY_K", self._d))
        self._sense(t_ns)
        self._heard()
        node.records()
        self._coming.append(self._u)
        u = np.array([self._coming.popleft()])
        gust = GUST_RAD * math.sin(GUST_RAD_PER_SAMPLE * k)
        model = self._model
        self._x = model.trim.x + model.A @ (self._x - model.trim.x) + model.B @ (u - model.trim.u) + gust
        self.samples += 1

    def _sense(self, t_ns: int) -> None:
        """Send the state, as the model's sensors say it."""
        attitude = dict.fromkeys(Attitude._fields[1:], 0.0)
        air = dict.fromkeys(AoaSsa._fields[1:], 0.0)
        for sensor, value in zip(self._sensors, self._x.tolist(), strict=True):
            (attitude if sensor.message is Attitude else air)[sensor.field] = value * sensor.to_field
        if self.node.config.alpha == "vfr_hud":
            self._say(VfrHud(AIRSPEED_M_S, AIRSPEED_M_S, 0, 0, 0.0, 0.0))
        self._say(Attitude(t_ns // NS_PER_MS & U32, **attitude))
        if AoaSsa in self.node.samples.needed:
            self._say(AoaSsa(t_ns // NS_PER_US, **air))

    def _say(self, message: Message) -> None:
        self.node.receive(PLANT_PORT, self._wire.encode(message), self._now_ns)

    def _answer(self) -> None:
        """Answer the TIMESYNC requests of the sample before; both ends have one clock."""
        requests, self._requests = self._requests, []
        for sent_ns, request in requests:
            self._say(Timesync(sent_ns + next(self._transits), request.ts1))

    def _heard(self) -> None:
        """Take what the understudy has sent: its command and its TIMESYNC requests."""
        travel = self.node.pilot.travel
        for _, datagram in self.node.outgoing():
            for message in self._wire.decode(datagram):
                u: float | None = None
                match message:
                    case Timesync(tc1=0):
                        self._requests.append((self._now_ns, message))
                    case ServoOutputRaw():
                        u = travel.from_pwm(message.servo2_raw)
                    case HilActuatorControls():
                        u = travel.from_control(message.elevator)
                if u is not None:
                    self._u = u
