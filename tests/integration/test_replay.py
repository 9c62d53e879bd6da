"""A recorded flight flown again over its own trace: the same link, packet for packet."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from typing import Any

from autopilot.link.record import read_mcap
from sitl.flight import fly_virtual
from sitl.link.spec import parse_spec
from sitl.recorder import FlightRecorder
from sitl.scenario import Scenario, load_scenario

UNDER_WAY_NS = 100_000_000
"""What is under way at the end of a flight has no record."""


def flown(scenario: Scenario, folder: Path) -> tuple[str, dict[str, list[Any]]]:
    """Return the recording of a flight, and what became of the packets in each direction that had time for it."""
    with FlightRecorder(folder, {"scenario": scenario.name}) as recorder:
        fly_virtual(scenario, recorder.write)
    path, packets = str(folder / "flight.mcap"), defaultdict(list)
    for topic, _, body in read_mcap(path):
        if topic.startswith("link/"):
            packets[topic].append((body["sent_ns"], body["number"], body["size"], body["delivered_ns"]))
    end_ns = max(each[0] for each in packets["link/up"]) - UNDER_WAY_NS
    return path, {
        topic: sorted((each for each in found if each[0] < end_ns), key=itemgetter(0, 1))
        for topic, found in packets.items()
    }


def test_a_replayed_flight_meets_the_same_delay_and_loss_packet_for_packet(tmp_path: Path) -> None:
    spec = parse_spec("delay=20ms,jitter=gamma:8ms,loss=0.05,reorder=0.05")
    first = replace(load_scenario("nominal"), duration_s=6.0, up=spec, down=spec)
    (tmp_path / "first").mkdir()
    (tmp_path / "again").mkdir()
    path, packets = flown(first, tmp_path / "first")
    up, down = (parse_spec(f"trace={path}#{way}") for way in ("up", "down"))
    _, again = flown(replace(first, up=up, down=down, seed=first.seed + 1), tmp_path / "again")
    assert sum(len(each) for each in packets.values()) > 1000
    assert {None} < {delivered_ns for *_, delivered_ns in packets["link/up"]}
    assert len({each[0] for each in packets["link/up"]}) < 0.5 * len(packets["link/up"]), "none together"
    assert again == packets
