"""Turnaround of the autopilot over UDP, ATTITUDE and AOA_SSA in, SERVO_OUTPUT_RAW out, against a bare echo.

Both run as processes of their own on loopback and are asked in turn, at the pace of the samples, by the same
loop: the ratio is that of the two medians.
"""

from __future__ import annotations

import math
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from autopilot.link.servo import travel_of
from gains.store import load_model
from sitl.aircraft.linear import LinearAircraft

SAMPLES = 400
WARM_UP = 40
PERIOD_S = 0.025
REFERENCE = "sine:5deg@0s:0.5Hz"
"""What the autopilot tracks: a plant that stands still is frozen to its failsafe, and it would hold."""
LIMIT = math.inf
"""Told only: how long a command may take at most is asked of the compiled package (:mod:`tests.bench.compiled`)."""
U32 = 0xFFFFFFFF

ECHO = """
import socket
s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
s.bind(("127.0.0.1", 0))
print(s.getsockname()[1], flush=True)
while True:
    data, peer = s.recvfrom(2048)
    s.sendto(data, peer)
"""


class FakePlant:
    """An aircraft on one socket, system 1, component 25: samples on its grid, each command flown, TIMESYNC answered.

    The elevator that comes back within a sample moves it from the next sample on; without an answer it is held.
    """

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.mav = dialect.MAVLink(None, 1, 25)
        self.peer: tuple[str, int] | None = None
        self.start = 0.0
        self.model = load_model("hirm")
        self.aircraft = LinearAircraft(self.model)
        self.travel = travel_of(self.model)
        self.x = np.array(self.model.trim.x)
        self.u = self.travel.neutral

    def pack(self, message: dialect.MAVLink_message) -> bytes:
        frame: bytes = message.pack(self.mav)
        self.mav.seq = (self.mav.seq + 1) % 256
        return frame

    def send(self, frame: bytes) -> None:
        assert self.peer is not None
        self.socket.sendto(frame, self.peer)

    def serve(
        self, until: float, wanted: Callable[[dialect.MAVLink_message], bool] = lambda _message: False
    ) -> float | None:
        """Answer until a time, or until a message that is wanted; return when that came."""
        while (left := until - time.perf_counter()) > 0:
            self.socket.settimeout(left)
            try:
                data, self.peer = self.socket.recvfrom(2048)
            except TimeoutError:
                return None
            at = time.perf_counter()
            message = self.mav.decode(bytearray(data))
            if wanted(message):
                return at
            if message.get_type() == "TIMESYNC" and message.tc1 == 0:
                self.send(self.pack(dialect.MAVLink_timesync_message(time.perf_counter_ns(), message.ts1)))
        return None

    def started(self, patience_s: float = 30.0) -> bool:
        """Wait for the autopilot's heartbeat; sample 0 is that of this moment."""
        if self.serve(time.perf_counter() + patience_s, lambda message: message.get_type() == "HEARTBEAT") is None:
            return False
        self.start = time.perf_counter()
        self.send(self.pack(dialect.MAVLink_named_value_int_message(int(self.start * 1000) & U32, b"SAMPLE_K", 0)))
        return True

    def ask(self, k: int, patience_s: float = 0.02) -> float | None:
        """Send sample k in its time; return the seconds until its own command came, or None when it did not."""
        self.serve(self.start + k * PERIOD_S)
        stamp_us = int((self.start + k * PERIOD_S) * 1e6)
        alpha, q, theta = self.x.tolist()
        attitude = dialect.MAVLink_attitude_message(stamp_us // 1000 & U32, 0.0, theta, 0.0, 0.0, q, 0.0)
        aoa = dialect.MAVLink_aoa_ssa_message(stamp_us, math.degrees(alpha), 0.0)
        frames = [self.pack(attitude), self.pack(aoa)]
        self.x = self.aircraft.step(self.x, np.array([self.u]), np.zeros(self.model.nw), 0.0)

        def answers(message: dialect.MAVLink_message) -> bool:
            if message.get_type() != "SERVO_OUTPUT_RAW":
                return False
            behind_us = (stamp_us - message.time_usec) & U32  # the stamp is that of either half: ATTITUDE's is in ms
            if behind_us >= 1000:
                return False
            self.u = self.travel.from_pwm(message.servo2_raw) or self.travel.neutral
            return True

        sent = time.perf_counter()
        for frame in frames:
            self.send(frame)
        came = self.serve(sent + patience_s, answers)
        return None if came is None else came - sent


def measure() -> list[tuple[str, float, float, str]]:
    """Return the ratios of the median turnarounds: of an autopilot that sleeps, and of one that does not."""
    return [
        ("autopilot turnaround / bare UDP echo", *_ratio()),
        ("autopilot --busy turnaround / bare UDP echo", *_ratio("--busy")),
    ]


def _ratio(*options: str) -> tuple[float, float, str]:
    plant = FakePlant()
    echo_client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    echo = subprocess.Popen([sys.executable, "-c", ECHO], stdout=subprocess.PIPE, text=True)
    address = f"udpout:127.0.0.1:{plant.socket.getsockname()[1]}"
    autopilot = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "autopilot",
            "--plant",
            address,
            "--gcs",
            "udpout:127.0.0.1:9",
            "--reference",
            REFERENCE,
            *options,
        ],
        stderr=subprocess.DEVNULL,
    )
    try:
        assert echo.stdout is not None
        echo_client.connect(("127.0.0.1", int(echo.stdout.readline())))
        echo_client.settimeout(2.0)
        assert plant.started(), "the autopilot did not start"
        ours, theirs = _ask_in_turn(plant, echo_client)
    finally:
        for process in (echo, autopilot):
            process.kill()
            process.wait()
    ratio = statistics.median(ours) / statistics.median(theirs)
    note = f"median {statistics.median(ours) * 1e6:.0f} us, echo {statistics.median(theirs) * 1e6:.0f} us"
    return ratio, LIMIT, note


def _ask_in_turn(plant: FakePlant, echo_client: socket.socket) -> tuple[list[float], list[float]]:
    ours, theirs = [], []
    for k in range(SAMPLES + WARM_UP):
        turnaround = plant.ask(k)
        if turnaround is not None and k >= WARM_UP:
            ours.append(turnaround)
        plant.serve(plant.start + (k + 0.5) * PERIOD_S)
        sent = time.perf_counter()
        echo_client.send(b"x" * 40)
        echo_client.recv(2048)
        theirs.append(time.perf_counter() - sent)
    assert len(ours) > 0.9 * SAMPLES, f"only {len(ours)} of {SAMPLES} samples were answered"
    return ours, theirs
