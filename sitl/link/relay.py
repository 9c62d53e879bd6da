"""The relay as a Node: one link between a plant and an autopilot, or several, and their live control.

One link has the ports ``plant`` and ``autopilot``, of several links each has ``NAME/plant`` and ``NAME/autopilot``.
What a link does to packets, and that each is accounted for, is told in :mod:`sitl.link.link`. Port ``control`` takes
requests (:mod:`sitl.link.control`) and answers each where it came from. What passes through is not looked at but for
rules and by a gate: any datagrams do, and "plant" may be any vehicle, "autopilot" any ground station.

Once a second while packets pass, and at the end, an event tells the counters of every link, and how far the delays were
from those that were asked for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from autopilot.link.clock import NS_PER_S
from autopilot.link.node import Datagram, Record
from gains.table import InputError
from sitl.link.changes import Change, format_change
from sitl.link.control import Refused, Set, decode_request, encode_refusal, encode_reply
from sitl.link.direction import Counters, Direction, LinkConfig
from sitl.link.gate import Gate
from sitl.link.impairment import LinkSpec
from sitl.link.link import Link, Outbox
from sitl.link.rules import Rule
from sitl.link.status import link_counters, link_status

__all__ = ["CONTROL_PORT", "DEFAULT_LOG_RATE", "MAX_LINKS", "Counters", "RelayNode"]

CONTROL_PORT = "control"

MAX_LINKS = 16
"""Links of one relay: each takes two sockets, and two topics of a recording."""

DEFAULT_LOG_RATE = 5000
"""The most records of packets in one second, so that a flood does not fill the disk."""

_LONG_AGO_NS = -(1 << 62)


class RelayNode:
    """Links between autopilots and plants.

    Parameters
    ----------
    up : LinkSpec
        From port ``plant`` to port ``autopilot``.
    down : LinkSpec
        From port ``autopilot`` to port ``plant``.
    seed : int
        Seed of both directions, which draw from independent streams.
    gate : Gate, optional
        Times the commands at the plant's end.
    rules : sequence of Rule
        Messages that meet another SPEC than their direction's.
    changes : sequence of Change
        What changes in flight.
    stamped : bool
        Whether packets may be handed in with times that have passed; they then leave by :meth:`tick` only.
    log_rate : int
        The most records of packets in one second; the others are counted.
    """

    def __init__(
        self,
        up: LinkSpec,
        down: LinkSpec,
        seed: int,
        gate: Gate[Any] | None = None,
        *,
        rules: Sequence[Rule] = (),
        changes: Sequence[Change] = (),
        stamped: bool = False,
        log_rate: int = DEFAULT_LOG_RATE,
    ) -> None:
        config = LinkConfig(up, down, seed, rules=tuple(rules), changes=tuple(changes))
        self._join((config,), gate, stamped, log_rate)

    @classmethod
    def joining(
        cls, configs: Sequence[LinkConfig], *, stamped: bool = False, log_rate: int = DEFAULT_LOG_RATE
    ) -> RelayNode:
        """Return a relay of one or several links, at most ``MAX_LINKS`` of different names."""
        node = cls(LinkSpec(), LinkSpec(), 0)
        node._join(configs, None, stamped, log_rate)
        return node

    def _join(self, configs: Sequence[LinkConfig], gate: Gate[Any] | None, stamped: bool, log_rate: int) -> None:
        names = [config.name for config in configs]
        assert 1 <= len(set(names)) == len(names) <= MAX_LINKS, names
        self._outbox = Outbox(log_rate, [], [])
        prefixes = [f"{name}/" for name in names] if len(names) > 1 else [""]
        self._links = [
            Link(config, self._outbox, gate, prefix=prefix, stamped=stamped)
            for config, prefix in zip(configs, prefixes, strict=True)
        ]
        self._entries: dict[str, tuple[Link, Direction]] = {}
        for link, prefix in zip(self._links, prefixes, strict=True):
            self._entries[f"{prefix}plant"] = (link, link.up)
            self._entries[f"{prefix}autopilot"] = (link, link.down)
        self._control = {"requests": 0, "refused": 0, "malformed": 0}
        self._told: Mapping[str, Any] = {}
        self._told_ns = _LONG_AGO_NS

    @property
    def counters(self) -> dict[str, Counters]:
        """What each direction (``up``, ``down``; of several links ``NAME/up``, ...) did so far: copies."""
        return {name: replace(direction.counters) for name, direction in self._directions()}

    @property
    def queued(self) -> dict[str, int]:
        """How many copies are under way in each direction, at the gate or before it."""
        return {name: direction.queued for name, direction in self._directions()}

    def _directions(self) -> list[tuple[str, Direction]]:
        directions = [direction for link in self._links for direction in link.directions]
        return [(direction.topic.removeprefix("link/"), direction) for direction in directions]

    # The node

    def receive(self, port: str, datagram: bytes, now_ns: int) -> None:
        """Take a packet into a link, or a request."""
        entry = self._entries.get(port)
        if entry is None:
            self._answer(datagram, now_ns)
        else:
            link, direction = entry
            link.receive(direction, datagram, now_ns)
        if not -NS_PER_S < now_ns - self._told_ns < NS_PER_S:
            self._tell_each_second(now_ns)

    def tick(self, now_ns: int) -> None:
        """Let out what is due."""
        for link in self._links:
            link.tick(now_ns)
        if not -NS_PER_S < now_ns - self._told_ns < NS_PER_S:
            self._tell_each_second(now_ns)

    def next_deadline_ns(self) -> int | None:
        """Return when the next packet leaves, or None."""
        if len(self._links) == 1:
            return self._links[0].next_deadline_ns()
        return min((at for link in self._links if (at := link.next_deadline_ns()) is not None), default=None)

    def outgoing(self) -> list[Datagram]:
        """Take away the packets that have left, in order."""
        out = self._outbox.outgoing
        if out:
            self._outbox.outgoing = []
        return out

    def records(self) -> list[Record]:
        """Take away the records: one per copy, made when it left or was dropped, and events."""
        made = self._outbox.records
        if made:
            self._outbox.records = []
        return made

    def close(self, now_ns: int) -> None:
        """Tell the counters a last time, where they have changed since."""
        self._tell(now_ns)

    # Counters

    def _tell_each_second(self, now_ns: int) -> None:
        """Record the counters, as a second has passed since they were recorded; the first second begins now."""
        if self._told_ns == _LONG_AGO_NS:
            self._told_ns = now_ns
        else:
            self._tell(now_ns)

    def _tell(self, now_ns: int) -> None:
        """Record the counters if they have changed."""
        self._told_ns = now_ns
        data = {"links": {link.name: link_counters(link) for link in self._links}, "control": dict(self._control)}
        if data != self._told:
            self._told = data
            body = {"kind": "counters", "node": "relay", "text": "relay counters", "data": data}
            self._outbox.records.append(Record("events", now_ns, body))

    # Live control

    def _answer(self, datagram: bytes, now_ns: int) -> None:
        """Carry out a request; a bad one is counted, and answered if it has an id."""
        request = decode_request(datagram)
        if isinstance(request, Refused):
            if request.id is None:
                self._control["malformed"] += 1
                return
            self._control["refused"] += 1
            self._reply(encode_refusal(request.id, request.error))
            return
        try:
            links = self._asked(request.link)
            if isinstance(request, Set):
                reply = self._set(request, links, now_ns)
            else:
                status = {link.name: link_status(link, now_ns) for link in links}
                reply = {"links": status, "control": self._control}
        except InputError as error:
            self._control["refused"] += 1
            self._reply(encode_refusal(request.id, str(error)))
            return
        self._control["requests"] += 1
        self._reply(encode_reply(request.id, reply))

    def _reply(self, reply: bytes) -> None:
        self._outbox.outgoing.append((CONTROL_PORT, reply))

    def _asked(self, name: str | None) -> list[Link]:
        """Return the links of this name; all when there is no name."""
        links = [link for link in self._links if name in (None, link.name)]
        if not links:
            names = ", ".join(link.name for link in self._links)
            raise InputError(f"link: expected one of {names}, found {name or 'nothing'}")
        return links

    def _set(self, request: Set, links: Sequence[Link], now_ns: int) -> dict[str, Any]:
        """Change the one link that is asked for."""
        if len(links) > 1:
            names = ", ".join(link.name for link in links)
            raise InputError(f"link: expected one of {names}, found nothing")
        changes = links[0].order(request.specs, now_ns)
        return {"link": links[0].name, "at": [format_change(change) for change in changes]}
