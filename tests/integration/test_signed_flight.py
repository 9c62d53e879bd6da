"""Flights over signed links: the same flight as unsigned, and no other under 10,000 hostile frames."""

from __future__ import annotations

import hashlib
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from autopilot.app import AutopilotNode
from autopilot.config import AutopilotConfig
from autopilot.link.keyring import CONTROL_LINK, ground_link
from autopilot.link.node import Datagram, Record
from autopilot.link.signing import SIGNATURE_BLOCK_BYTES, Signing
from autopilot.link.virtual import Participant, VirtualNetwork
from autopilot.profile import parse_profile
from sitl.flight import WIRES
from sitl.link.relay import RelayNode
from sitl.link.spec import parse_spec
from sitl.plant import PlantNode
from sitl.scenario import Scenario, load_scenario
from tests.helpers import S

KEY, OTHER_KEY = hashlib.sha256(b"the key").digest(), hashlib.sha256(b"another key").digest()
START = 37_000_000_000_000
"""Both ends' clocks, 10 us since 2015, when the flight begins; nodes' own times differ and do not matter."""
DEPTH = 64
HOSTILE = 10_000
SIGNATURES = {"bad_signature", "replayed", "timestamp_too_old", "wrong_link", "unsigned"}
TRUNCATIONS = {"truncated", "no_frame", "malformed", "bad_crc", "unknown_id"}


class Attacker(RelayNode):
    """A relay that adds hostile frames behind those that it forwards, and forwards these as ever."""

    def __init__(self, scenario: Scenario, most: int) -> None:
        super().__init__(scenario.up, scenario.down, scenario.seed)
        self.rng = np.random.default_rng(42)
        self.most, self.sent = most, Counter[str]()
        self.seen: dict[str, list[bytes]] = {"plant": [], "autopilot": []}

    def outgoing(self) -> list[Datagram]:
        out = []
        for port, frame in super().outgoing():
            out.append((port, frame))
            self.seen[port].append(frame)
            for _ in range(9 if self.sent.total() < self.most else 0):
                kind = str(self.rng.choice(["replay", "truncate", "flip", "shift", "forge", "reflect", "other link"]))
                out.append((port, self.hostile(kind, port, frame)))
                self.sent[kind] += 1
        return out

    def hostile(self, kind: str, port: str, frame: bytes) -> bytes:
        rng, other = self.rng, "plant" if port == "autopilot" else "autopilot"
        body = frame[:-SIGNATURE_BLOCK_BYTES]
        match kind:
            case "replay":
                return self.seen[port][rng.integers(len(self.seen[port]))]
            case "truncate":
                return frame[: rng.integers(1, len(frame))]
            case "flip":
                at, bit = rng.integers(len(frame)), 1 << int(rng.integers(8))
                return frame[:at] + bytes((frame[at] ^ bit,)) + frame[at + 1 :]
            case "shift":
                stamp = int.from_bytes(frame[-12:-6], "little") + int(rng.choice([-(10**8), -1, 1, 10**8, 10**12]))
                return frame[:-12] + stamp.to_bytes(6, "little") + frame[-6:]
            case "forge":
                return Signing(OTHER_KEY, CONTROL_LINK, START + 10**9).sign(body)
            case "reflect":
                return self.seen[other][-1] if self.seen[other] else frame[:5]
            case _:  # signed with the key, for a ground station
                return Signing(KEY, ground_link(0), START + 10**9).sign(body)


def seal(offset_ns: int) -> Signing:
    """Return one end of the control link; its node's clock shows ``offset_ns`` at the start of the flight."""
    return Signing(KEY, CONTROL_LINK, START - offset_ns // 10_000, peer_link=CONTROL_LINK, depth=DEPTH)


def fly(scenario: Scenario, hostile: int, *, signed: bool = True) -> tuple[list[Any], Counter[str], Attacker]:
    """Return what the plant lived, what both ends rejected, and the relay."""
    clocks = scenario.clocks
    seals = {name: seal(clocks[name].offset_ns) if signed else None for name in ("plant", "autopilot")}
    plant = PlantNode(scenario.plant_node().config, seals["plant"])
    config = AutopilotConfig(scenario.gains, parse_profile(scenario.reference, scenario.plant.Ts))
    config = replace(config, seals={"plant": seals["autopilot"]} if signed else {})
    autopilot, relay = AutopilotNode(config), Attacker(scenario, hostile)
    lived: list[Any] = []

    def write(record: Record, _true_ns: int) -> None:
        if record.topic == "plant/truth":
            lived.append((record.body["k"], record.body["x"], record.body["u"], record.body["d"]))

    nodes = {"plant": plant, "relay": relay, "autopilot": autopilot}
    network = VirtualNetwork([Participant(name, node, clocks[name]) for name, node in nodes.items()], WIRES, write)
    network.run(lambda: plant.samples >= scenario.samples, 60 * S)
    rejects = Counter({str(kind): n for kind, n in plant.wire.rejects.items()})
    return lived, rejects + Counter({str(kind): n for kind, n in autopilot.wire.rejects.items()}), relay


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    up, down = (parse_spec(text) for text in ("delay=20ms,jitter=gamma:8ms,loss=0.02", "delay=5ms,jitter=uniform:20ms"))
    return replace(load_scenario("nominal"), up=up, down=down, duration_s=15.0)


@pytest.fixture(scope="module")
def calm(scenario: Scenario) -> tuple[list[Any], Counter[str], Attacker]:
    return fly(scenario, 0)


def test_a_signed_flight_over_a_reordering_link_is_the_unsigned_one(scenario, calm):
    lived, rejects, _relay = calm
    assert not rejects
    assert len(lived) == scenario.samples
    assert lived == fly(scenario, 0, signed=False)[0]


def test_ten_thousand_hostile_frames_change_nothing_and_each_is_refused(scenario, calm):
    lived, rejects, relay = fly(scenario, HOSTILE)
    assert lived == calm[0]
    assert relay.sent.total() >= HOSTILE
    assert min(relay.sent.values()) > HOSTILE / 10
    wrong_source = rejects.pop("wrong_source")
    assert wrong_source >= relay.sent["reflect"] * 0.99
    assert rejects.keys() <= SIGNATURES | TRUNCATIONS | {"unhandled"}
    assert rejects.total() + wrong_source >= relay.sent.total()
    assert rejects["replayed"] + rejects["timestamp_too_old"] == relay.sent["replay"]
