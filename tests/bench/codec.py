"""Our codec against pymavlink's ``MAVLink`` object: the same messages packed, the same frames parsed, one by one."""

from __future__ import annotations

import statistics
import time
from dataclasses import replace

from pymavlink.dialects.v20 import ardupilotmega as dialect

from autopilot.link.wire import AUTOPILOT, PLANT, Attitude, Wire
from sitl.scenario import load_scenario
from tests.bench.flight import frames_of

DURATION_S = 10.0
ROUNDS = 15
LIMIT_PACK = 0.75
LIMIT_PARSE = 0.5


def measure() -> list[tuple[str, float, float, str]]:
    """Return the ratios of packing and of parsing."""
    _, received = frames_of(replace(load_scenario("nominal"), duration_s=DURATION_S))
    frames = [frame for frame in received if Wire(AUTOPILOT, PLANT).decode(frame)]  # what the plant sends
    messages = [Wire(AUTOPILOT, PLANT).decode(frame)[0] for frame in frames]
    mav = dialect.MAVLink(None, *PLANT)
    theirs = [mav.decode(bytearray(frame)) for frame in frames]
    fields = [(type(message), [getattr(message, name) for name in message.fieldnames]) for message in theirs]
    fields = [(kind, [v.encode() if isinstance(v, str) else v for v in values]) for kind, values in fields]
    assert any(isinstance(message, Attitude) for message in messages)
    times: dict[str, list[float]] = {"pack": [], "their pack": [], "parse": [], "their parse": []}
    for _ in range(ROUNDS + 1):
        wire = Wire(PLANT, AUTOPILOT)
        start = time.perf_counter()
        packed = [wire.encode(message) for message in messages]
        times["pack"].append(time.perf_counter() - start)
        start = time.perf_counter()
        for kind, values in fields:
            kind(*values).pack(mav)
        times["their pack"].append(time.perf_counter() - start)
        wire = Wire(AUTOPILOT, PLANT)
        start = time.perf_counter()
        for frame in packed:
            wire.decode(frame)
        times["parse"].append(time.perf_counter() - start)
        start = time.perf_counter()
        for frame in packed:
            mav.parse_buffer(frame)
        times["their parse"].append(time.perf_counter() - start)
    return [_row("pack", times, len(frames), LIMIT_PACK), _row("parse", times, len(frames), LIMIT_PARSE)]


def _row(what: str, times: dict[str, list[float]], count: int, limit: float) -> tuple[str, float, float, str]:
    ours, theirs = times[what][1:], times[f"their {what}"][1:]
    ratio = statistics.median(a / b for a, b in zip(ours, theirs, strict=True))
    each_us = (statistics.median(some) / count * 1e6 for some in (ours, theirs))
    return f"codec: {what} / pymavlink's", ratio, limit, "{:.1f} us a frame, {:.1f} us".format(*each_us)
