"""Long flights in virtual time: what must not grow does not grow."""

from __future__ import annotations

import resource
from dataclasses import replace

import pytest

from autopilot.link.node import Record
from sitl.flight import virtual_network
from sitl.scenario import load_scenario


@pytest.mark.long
def test_two_hours_over_a_lossy_link_leave_the_memory_flat_and_the_law_in_command() -> None:
    modes: dict[str, int] = {}

    def count(record: Record, _log_time_ns: int) -> None:
        if record.topic == "autopilot/command":
            modes[record.body["mode"]] = modes.get(record.body["mode"], 0) + 1

    scenario = replace(load_scenario("lossy"), duration_s=7200.0)
    network, plant = virtual_network(scenario, None)
    network._sink = count
    peaks_kib = []
    for part in range(1, 5):
        network.run(lambda part=part: plant.samples >= scenario.samples * part // 4, 10**13)
        peaks_kib.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    assert plant.samples == scenario.samples
    assert peaks_kib[-1] - peaks_kib[0] < 2_000, peaks_kib  # 216,000 samples later
    assert modes["TRACKING"] > 0.9 * sum(modes.values())
