"""One direction of a link in operation: what its packets meet, what it did to them, how precisely.

A packet meets the SPEC of its direction or that of the first rule that applies to it. Each of these is a lane: an
:class:`~sitl.link.impairment.Impairment` with random streams and a queue of its own.

Randomness: the directions draw from the streams ``(0,)`` and ``(1,)`` of the seed, the n-th change of a direction
from ``(2, direction, n)``, its n-th rule from ``(3, direction, n)``, counted from 0. So a rule or a change leaves alone
what it is not about.
"""

from __future__ import annotations

from bisect import insort
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sitl.link.changes import MAX_CHANGES, Change
from sitl.link.impairment import Fate, Impairment, LinkSpec
from sitl.link.precision import Histogram
from sitl.link.rules import MAX_RULES, WAYS, Rule, Way, rule_finder

__all__ = ["DEFAULT_NAME", "LATEST", "Counters", "Delivery", "Direction", "Lane", "LinkConfig"]

DEFAULT_NAME = "link"
"""Of a link that is alone."""

LATEST = 1024
"""Deliveries per direction that are remembered, for who looks at the link while it runs."""

_NEVER_NS = 1 << 62
_PERFECT = LinkSpec()
_DELIVERED = Fate.DELIVERED  # asked for with each packet, and found slowly in its enumeration


@dataclass(frozen=True, slots=True)
class LinkConfig:
    """A link as data.

    Attributes
    ----------
    up, down : LinkSpec
        From the plant to the autopilot, and back.
    seed : int
        Of everything random.
    name : str
        What it is called where there are several.
    rules : tuple of Rule
        Messages that meet another SPEC; the first that applies counts. At most ``MAX_RULES``.
    changes : tuple of Change
        What changes in flight, in any order; of two at one instant the first comes first.
    """

    up: LinkSpec
    down: LinkSpec
    seed: int
    name: str = DEFAULT_NAME
    rules: tuple[Rule, ...] = ()
    changes: tuple[Change, ...] = ()

    def __post_init__(self) -> None:
        assert len(self.rules) <= MAX_RULES
        assert len(self.changes) <= MAX_CHANGES


@dataclass(slots=True)
class Counters:
    """What one direction, or one rule, did.

    Attributes
    ----------
    sent : int
        Packets that entered.
    delivered : int
        Copies that left.
    lost : int
        Copies lost by chance or to a blackout.
    refused : int
        Copies the queue had no room for.
    gated : int
        Copies that the gate swallowed.
    duplicated : int
        Further copies made, whatever became of them.
    reordered : int
        Copies that left after a copy of a packet that had entered later, in the same direction.
    bytes : int
        Payload of the delivered copies.
    unlogged : int
        Copies without a record of their own, as too many came in one second.
    """

    sent: int = 0
    delivered: int = 0
    lost: int = 0
    refused: int = 0
    gated: int = 0
    duplicated: int = 0
    reordered: int = 0
    bytes: int = 0
    unlogged: int = 0

    def count(self, fate: Fate, size: int, late: bool) -> None:
        """Count a copy of this many bytes by its fate; ``late`` if it left after one that had entered later."""
        if fate is _DELIVERED:
            self.delivered += 1
            self.bytes += size
            self.reordered += late
        elif fate is Fate.REFUSED:
            self.refused += 1
        elif fate is Fate.GATED:
            self.gated += 1
        else:
            self.lost += 1


Delivery = tuple[int, int, int | None, int]
"""A copy that left: when (link time, ns), its size, the delay that was asked for (None: the gate chose it) and the one
it had, ns."""


class Lane:
    """What some packets of a direction meet: its own SPEC, or that of a rule, which has a queue of its own.

    Attributes
    ----------
    impairment : Impairment
    rule : Rule or None
    counters : Counters or None
        Of the rule.
    queued : int
        Copies under way.
    limit : int
        The most of them.
    passes : bool
        It does nothing to any packet, so the impairment need not be asked.
    """

    __slots__ = ("counters", "impairment", "limit", "passes", "queued", "rule")

    def __init__(self, impairment: Impairment, rule: Rule | None) -> None:
        self.rule = rule
        self.counters = None if rule is None else Counters()
        self.queued = 0
        self.become(impairment)

    def become(self, impairment: Impairment) -> None:
        """Meet another SPEC from now on."""
        self.impairment = impairment
        self.limit = impairment.spec.limit
        self.passes = impairment.spec == _PERFECT


class Direction:
    """The state of one direction.

    Attributes
    ----------
    way : str
    topic, exit_port : str
        Where its records and its packets go.
    main : Lane
        What a packet meets to which no rule applies.
    rules : list of Lane
    counters : Counters
    newest : int
        The number of the latest-entered packet of which a copy has left.
    came_ns : int
        When the latest packet came, link time: below 0 where that was before the link's first packet was read.
    entered_ns : int
        When it entered, from 0; -1 before the first.
    queued : int
        Copies under way, of all lanes.
    changes : list of Change
        Those that wait for their time.
    next_change_ns : int
        The first one's.
    changed : int
        How many have been made.
    errors : Histogram
        How far each delivered copy's delay was from the one asked for; without those that the gate timed.
    latest : deque of Delivery
        The last ``LATEST`` copies that left.
    """

    __slots__ = (
        "_find",
        "_index",
        "_seed",
        "came_ns",
        "changed",
        "changes",
        "counters",
        "entered_ns",
        "errors",
        "exit_port",
        "latest",
        "main",
        "newest",
        "next_change_ns",
        "queued",
        "rules",
        "topic",
        "way",
    )

    def __init__(self, config: LinkConfig, way: Way, topic: str, exit_port: str) -> None:
        self.way = way
        self.topic = topic
        self.exit_port = exit_port
        self._seed = config.seed
        self._index = WAYS.index(way)
        spec = config.up if way == "up" else config.down
        self.main = Lane(Impairment(spec, self._rng(self._index)), None)
        rules = [rule for rule in config.rules if rule.way == way]
        self.rules = [Lane(Impairment(rule.spec, self._rng(3, self._index, n)), rule) for n, rule in enumerate(rules)]
        self._find: Callable[[bytes], int | None] | None = rule_finder(rules) if rules else None
        self.changes = sorted((change for change in config.changes if change.way == way), key=_at_ns)
        self.next_change_ns = self.changes[0].at_ns if self.changes else _NEVER_NS
        self.changed = 0
        self.counters = Counters()
        self.queued = 0
        self.newest = 0
        self.came_ns = -_NEVER_NS
        self.entered_ns = -1
        self.errors = Histogram()
        self.latest: deque[Delivery] = deque(maxlen=LATEST)

    def lane(self, datagram: bytes) -> Lane:
        """Return what a packet meets."""
        if self._find is None:
            return self.main
        index = self._find(datagram)
        return self.main if index is None else self.rules[index]

    def order(self, change: Change) -> None:
        """Have a change made when its time has come; the caller has seen to the room."""
        insort(self.changes, change, key=_at_ns)
        self.next_change_ns = self.changes[0].at_ns

    def change(self) -> Change:
        """Make the next change: what is under way keeps its times."""
        change = self.changes.pop(0)
        rng = self._rng(2, self._index, self.changed)
        self.main.become(Impairment(change.spec, rng, self.main.impairment))
        self.changed += 1
        self.next_change_ns = self.changes[0].at_ns if self.changes else _NEVER_NS
        return change

    def delivered(self, now_ns: int, size: int, entered_ns: int, exit_ns: int | None) -> None:
        """Note a delivery now, and how precise it was: it was to leave at ``exit_ns``; None when the gate chose."""
        requested_ns = None
        if exit_ns is not None:
            self.errors.add(now_ns - exit_ns)
            requested_ns = exit_ns - entered_ns
        self.latest.append((now_ns, size, requested_ns, now_ns - entered_ns))

    def spec_at(self, link_ns: int) -> LinkSpec:
        """Return the SPEC that holds at this time, not before the present."""
        due = [change.spec for change in self.changes if change.at_ns <= link_ns]
        return due[-1] if due else self.main.impairment.spec

    def _rng(self, *key: int) -> np.random.Generator:
        return np.random.Generator(np.random.PCG64(np.random.SeedSequence(self._seed, spawn_key=key)))


def _at_ns(change: Change) -> int:
    return change.at_ns
