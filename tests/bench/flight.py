"""A virtual flight against pymavlink alone: packing and parsing the frames of that flight.

The yardstick builds each message that the flight sends from its fields and packs it, and parses each frame
that the flight receives, with a plain MAVLink object and nothing else.
"""

from __future__ import annotations

import math
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from pymavlink.dialects.v20 import ardupilotmega as dialect

from autopilot.app import AutopilotNode
from autopilot.link.groundmessages import ParamSet
from autopilot.link.virtual import VirtualNetwork
from sitl.flight import Write, virtual_network
from sitl.plant import PlantNode
from sitl.recorder import FlightRecorder
from sitl.scenario import Scenario, load_scenario

DURATION_S = 20.0
ROUNDS = 7
LIMIT = math.inf
"""Told only: what a flight may cost at most is asked of the compiled package (:mod:`tests.bench.compiled`)."""


def frames_of(scenario: Scenario) -> tuple[list[bytes], list[bytes]]:
    """Return the frames that the two ends send and those that they receive."""
    sent: list[bytes] = []
    received: list[bytes] = []

    def tap(_node: str, _port: str, direction: str, datagram: bytes, _true_ns: int) -> None:
        (sent if direction == "sent" else received).append(datagram)

    network, plant = shown_every_sample(scenario, None)
    tapped = VirtualNetwork(
        network._participants,
        {
            (network._participants[a].name, port): (network._participants[b].name, far)
            for (a, port), (b, far) in network._wires.items()
        },
        None,
        tap,
        ("plant", "autopilot"),
    )
    tapped.run(lambda: plant.samples >= scenario.samples, 10**12)
    return sent, received


def shown_every_sample(scenario: Scenario, write: Write | None) -> tuple[VirtualNetwork, PlantNode]:
    """Return the scenario's network with a ground station that is shown every sample, as many do that tune gains."""
    network, plant = virtual_network(scenario, write)
    [autopilot] = [p.node for p in network._participants if isinstance(p.node, AutopilotNode)]
    for name in ("RATE_ATT", "RATE_AOA", "RATE_SERVO", "RATE_DELAY", "RATE_HUD"):
        rate_hz = 1.0 / scenario.plant.Ts
        answer = autopilot.settings.parameters.handle(ParamSet(1, 1, name, rate_hz, 9), (255, 190), 0)
        assert answer.reason is None
    return network, plant


def fly(scenario: Scenario, write: Write | None) -> None:
    network, plant = shown_every_sample(scenario, write)
    samples = scenario.samples
    network.run(lambda: plant.samples >= samples, 10**12)


def pymavlink_alone(sent: list[bytes], received: list[bytes]) -> float:
    """Return the seconds that pymavlink takes to pack and parse the frames."""
    mav = dialect.MAVLink(None, 1, 1)
    fields = []
    for frame in sent:
        message = mav.decode(bytearray(frame))
        if isinstance(message, dialect.MAVLink_unknown):  # CURRENT_MODE, one in two seconds
            continue
        fields.append((type(message), [getattr(message, name) for name in message.fieldnames]))
    fields = [(kind, [v.encode() if isinstance(v, str) else v for v in values]) for kind, values in fields]
    start = time.process_time()
    for kind, values in fields:
        kind(*values).pack(mav)
    for frame in received:
        mav.parse_buffer(frame)
    return time.process_time() - start


def flight(scenario: Scenario, *, record: bool) -> float:
    """Return the processor seconds of one virtual flight."""
    if not record:
        start = time.process_time()
        fly(scenario, None)
        return time.process_time() - start
    with tempfile.TemporaryDirectory() as folder:
        start = time.process_time()
        with FlightRecorder(Path(folder), {"scenario": scenario.name}) as recorder:
            fly(scenario, recorder.write)
        return time.process_time() - start


def measure() -> list[tuple[str, float, float, str]]:
    """Return (what, ratio, limit, note) for recording off and on."""
    scenario = replace(load_scenario("nominal"), duration_s=DURATION_S)
    sent, received = frames_of(scenario)
    codec, off, on = [], [], []
    for _ in range(ROUNDS + 1):
        codec.append(pymavlink_alone(sent, received))
        off.append(flight(scenario, record=False))
        on.append(flight(scenario, record=True))
    rows = []
    for what, times in (("recording off", off), ("recording on", on)):
        ratio = statistics.median(t / c for t, c in zip(times[1:], codec[1:], strict=True))
        factor = DURATION_S / statistics.median(times[1:])
        note = f"{factor:.0f} x real time; {len(sent)} frames packed, {len(received)} parsed"
        rows.append((f"virtual flight, {what} / pymavlink packing and parsing", ratio, LIMIT, note))
    return rows
