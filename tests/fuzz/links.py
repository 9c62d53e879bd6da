"""What a relay is told does to it: its files, rules and changes as text, and requests while packets pass."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from unittest import mock

import orjson

from autopilot.link.clock import NS_PER_MS, NS_PER_S
from autopilot.link.messages import Attitude, Timesync
from autopilot.link.wire import AUTOPILOT, PLANT, Wire
from gains.table import InputError
from sitl.link import spec as grammar
from sitl.link.changes import MAX_CHANGES, format_change, parse_change
from sitl.link.control import MAX_ID, MAX_REPLY_BYTES, Refused, Set, decode_request
from sitl.link.direction import LinkConfig
from sitl.link.impairment import MAX_QUEUED
from sitl.link.relay import CONTROL_PORT, MAX_LINKS, RelayNode
from sitl.link.relayfile import load_relay
from sitl.link.rules import MAX_RULES, format_rule, parse_rule, rule_finder
from sitl.link.spec import parse_spec
from tests.fuzz.files import written
from tests.fuzz.refusing import refusing
from tests.helpers import HEARTBEAT
from tests.sitl.relays import conserved

NAMES = ("one", "two")
RULES = ("up:ATTITUDE:delay=30ms,limit=3", "down:TIMESYNC+253:loss=0.5,dup=0.5")
GAP_NS = 5 * NS_PER_MS
"""From one request to the next; between them a packet enters at each end of each link."""
MAX_REQUESTS = 64
"""Of one input: its lines, each a datagram."""


@cache
def _packets() -> tuple[tuple[str, bytes], ...]:
    """Return what enters a link between two requests: the end, and frames that rules apply to, or none."""
    plant, autopilot = Wire(PLANT, None), Wire(AUTOPILOT, None)
    attitude = plant.encode(Attitude(25, 0.0, 0.01, 0.0, 0.0, 0.0, 0.0))
    return (
        ("plant", attitude),
        ("autopilot", autopilot.encode(HEARTBEAT) + autopilot.encode(Timesync(0, 7))),
        ("plant", b"none of MAVLink"),
        ("autopilot", b""),
    )


@contextmanager
def _without_files() -> Iterator[None]:
    """Make a defect of every file that is opened, and of every look for one."""
    told = AssertionError("a stranger has made the relay look for a file")
    with (
        mock.patch.object(grammar, "load_trace", side_effect=told),
        mock.patch.object(grammar, "load_table", side_effect=told),
        mock.patch("builtins.open", side_effect=told),
    ):
        yield


@refusing()
def control(data: bytes) -> None:
    """Requests, one a line, to a relay whose links carry packets: each is counted, and answered if it can be.

    Packets are conserved whatever was asked for; what was done can be said again; no file is looked for.
    """
    configs = [LinkConfig(parse_spec("delay=2ms"), parse_spec("dup=0.5"), n, name) for n, name in enumerate(NAMES)]
    configs[0] = LinkConfig(configs[0].up, configs[0].down, 0, NAMES[0], tuple(map(parse_rule, RULES)))
    node = RelayNode.joining(configs)
    now_ns = NS_PER_S
    with _without_files():
        for number, datagram in enumerate(data.split(b"\n")[:MAX_REQUESTS], 1):
            now_ns += GAP_NS
            node.tick(now_ns)
            node.outgoing()
            _ask(node, datagram, now_ns, number)
            for name in NAMES:
                for port, payload in _packets():
                    node.receive(f"{name}/{port}", payload, now_ns)
            _check_links(node)
        node.tick(now_ns + NS_PER_S)
    _check_links(node)
    assert {record.topic.split("/")[0] for record in node.records()} <= {"events", "link"}


def _ask(node: RelayNode, datagram: bytes, now_ns: int, number: int) -> None:
    """Send one request, the ``number``-th, and check what came back."""
    request = decode_request(datagram)
    node.receive(CONTROL_PORT, datagram, now_ns)
    replies = node.outgoing()
    assert sum(node._control.values()) == number
    if isinstance(request, Refused) and request.id is None:
        assert replies == []
        return
    ((port, reply),) = replies
    assert port == CONTROL_PORT
    assert len(reply) <= MAX_REPLY_BYTES
    answer = orjson.loads(reply)
    assert request.id is not None
    assert 0 <= answer["id"] == request.id <= MAX_ID
    if not answer["ok"]:
        assert answer["error"].isprintable(), answer["error"]
    elif isinstance(request, Set):
        done = [parse_change(text) for text in answer["at"]]
        assert {change.way: change.spec for change in done} == request.specs
    else:
        assert set(answer["links"]) <= set(NAMES)


def _check_links(node: RelayNode) -> None:
    """Check that each copy of each direction and of each rule is accounted for, and that nothing grows."""
    assert conserved(node)
    for _, direction in node._directions():
        lanes = [direction.main, *direction.rules]
        assert direction.queued == sum(lane.queued for lane in lanes)
        assert all(0 <= lane.queued <= MAX_QUEUED for lane in lanes)
        assert len(direction.changes) <= MAX_CHANGES


@refusing(InputError)
def relayfile(data: bytes) -> None:
    """A file of links; files that it may name are none of this target. A relay of them passes packets on."""
    if any(word in data for word in (b"trace", b"table")):
        return
    links = load_relay(written(data, "relay.toml"))
    assert 1 <= len(links) <= MAX_LINKS
    assert len({link.config.name for link in links}) == len(links)
    for link in links:
        assert len(link.config.rules) <= MAX_RULES
        assert [parse_rule(format_rule(rule)) for rule in link.config.rules] == list(link.config.rules)
        assert [parse_change(format_change(change)) for change in link.config.changes] == list(link.config.changes)
    node = RelayNode.joining([link.config for link in links])
    for port in node._entries:
        node.receive(port, _packets()[0][1], 0)
    node.tick(NS_PER_S)
    _check_links(node)


@refusing(InputError)
def rule(data: bytes) -> None:
    """A rule, and behind the first line a datagram that it may be about."""
    text, _, datagram = data.partition(b"\n")
    if any(word in text for word in (b"trace", b"table")):
        return
    made = parse_rule(text.decode("utf-8", "surrogateescape"))
    assert parse_rule(format_rule(made)) == made, format_rule(made)
    assert made.ids
    assert rule_finder([made])(datagram) in (None, 0)


@refusing(InputError)
def change(data: bytes) -> None:
    """A change in flight."""
    if any(word in data for word in (b"trace", b"table")):
        return
    made = parse_change(data.decode("utf-8", "surrogateescape"))
    assert parse_change(format_change(made)) == made, format_change(made)
