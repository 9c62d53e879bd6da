"""Compiles the loop's hot path with mypyc when it is asked for; the project itself is in pyproject.toml.

    pip install mypy 'setuptools>=77'
    LAGPROOF_COMPILE=1 pip install --no-build-isolation .

The same sources, as a C extension: a flight costs less than half, and its recording is the same to the last byte
(tests/integration/test_compiled.py). It takes a C compiler and about a minute. Without it nothing is missing but speed.
"""

import os

from setuptools import setup

COMPILED = (
    "autopilot/app.py",
    "autopilot/clocksync.py",
    "autopilot/commander.py",
    "autopilot/control.py",
    "autopilot/controllers.py",
    "autopilot/delay.py",
    "autopilot/envelope.py",
    "autopilot/ground/streams.py",
    "autopilot/ground/vehicle.py",
    "autopilot/history.py",
    "autopilot/link/clock.py",
    "autopilot/link/codecs.py",
    "autopilot/link/mcapfile.py",
    "autopilot/link/record.py",
    "autopilot/link/sensors.py",
    "autopilot/link/servo.py",
    "autopilot/link/udp.py",
    "autopilot/link/virtual.py",
    "autopilot/link/wire.py",
    "autopilot/monitors.py",
    "autopilot/pilot.py",
    "autopilot/profile.py",
    "autopilot/reference.py",
    "autopilot/state.py",
    "autopilot/streamed.py",
    "autopilot/telemetry.py",
    "autopilot/transits.py",
    "sitl/aircraft/faulty.py",
    "sitl/aircraft/linear.py",
    "sitl/link/direction.py",
    "sitl/link/impairment.py",
    "sitl/link/link.py",
    "sitl/link/precision.py",
    "sitl/link/relay.py",
    "sitl/plant.py",
    "sitl/recorder.py",
)
"""What runs per packet or per sample."""

if os.environ.get("LAGPROOF_COMPILE") == "1":
    from mypyc.build import mypycify

    setup(ext_modules=mypycify(list(COMPILED), opt_level="3", debug_level="0"))
else:
    setup()
