"""An autopilot on the bench: what its plant says is written frame by frame, without a plant."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from autopilot.app import AutopilotNode
from autopilot.config import AutopilotConfig
from autopilot.link.wire import PLANT, AoaSsa, Attitude, Message, NamedValueInt, Timesync, Wire
from tests.helpers import HIRM, MS, TS, S, parse

X0 = np.array([0.02, 0.0, 0.05])
TREMBLE = 1e-7
"""What a sample differs from its neighbours, rad and rad/s: just so much that floats of 32 bits show it."""


@dataclass
class Bench:
    """An autopilot on the bench: a plant of frames only, both clocks equal, one sample per call."""

    config: AutopilotConfig = field(default_factory=lambda: AutopilotConfig(HIRM))
    answers: bool = True
    now_ns: int = 500 * S
    messages: list = field(default_factory=list)
    events: list = field(default_factory=list)
    commands: list = field(default_factory=list)

    def __post_init__(self) -> None:
        self.node = AutopilotNode(self.config)
        self.wire = Wire(PLANT, None)
        self.t0_ns = self.now_ns + S

    def take(self) -> None:
        """Take what the node has made, and answer its TIMESYNC at once."""
        while made := self.node.outgoing():
            new = [(port, m) for port, datagram in made for m in parse(datagram)]
            self.messages += new
            for port, m in new:
                if self.answers and (port, m.get_type()) == ("plant", "TIMESYNC") and m.tc1 == 0:
                    self.node.receive("plant", self.wire.encode(Timesync(self.now_ns, m.ts1)), self.now_ns)
        for record in self.node.records():
            if record.topic in ("events", "autopilot/command"):
                (self.events if record.topic == "events" else self.commands).append(record.body)

    def to(self, now_ns: int) -> None:
        """Tick at every deadline up to ``now_ns``."""
        while (due_ns := self.node.next_deadline_ns()) is not None and due_ns <= now_ns:
            self.now_ns = max(self.now_ns, due_ns)
            self.node.tick(self.now_ns)
            self.take()
        self.now_ns = now_ns

    def give(self, *messages: Message) -> None:
        """Let messages arrive now, and then tick what is due."""
        for message in messages:
            self.node.receive("plant", self.wire.encode(message), self.now_ns)
        self.take()
        self.to(self.now_ns)

    def sample(self, k: int, age_ns: int = 0, x: np.ndarray = X0) -> None:
        """Let sample k arrive ``age_ns`` after it was taken; it trembles, as a sensor that stands still is broken."""
        x = x + (k % 2) * TREMBLE
        t_ns = self.t0_ns + k * TS
        self.to(t_ns + age_ns)
        self.give(
            NamedValueInt(t_ns // MS, "SAMPLE_K", k),
            Attitude(t_ns // MS, 0.0, x[2], 0.0, 0.0, x[1], 0.0),
            AoaSsa(t_ns // 1000, math.degrees(x[0]), 0.0),
        )

    def tracking(self, last: int = 9) -> Bench:
        """Fly samples 0 to ``last``."""
        for k in range(last + 1):
            self.sample(k)
        assert self.mode == "TRACKING"
        return self

    @property
    def mode(self) -> str:
        return str(self.node.failsafe.mode)

    def transitions(self) -> list[str]:
        return [e["text"] for e in self.events if e["kind"] == "failsafe"]

    def texts(self) -> list[str]:
        self.to(self.now_ns)
        return [m.text for port, m in self.messages if port == "gcs0" and m.get_type() == "STATUSTEXT"]
