"""The virtual driver: order at equal instants, clocks, determinism, a node that boots anew."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autopilot.link.clock import Clock
from autopilot.link.node import Record
from autopilot.link.virtual import Loss, Participant, VirtualNetwork
from tests.helpers import AUTOPILOT_CLOCK, MS, PLANT_CLOCK, Flight, S, constant

quick = settings(deadline=None)


@dataclass
class Ticker:
    """Logs what happens to it; at its deadlines it sends ``sends`` and records itself."""

    name: str
    log: list
    deadlines: list[int] = field(default_factory=list)
    sends: list[tuple[str, bytes]] = field(default_factory=list)
    answers: dict[bytes, list[tuple[str, bytes]]] = field(default_factory=dict)
    out: list = field(default_factory=list)
    made: list = field(default_factory=list)

    def receive(self, port, datagram, now_ns):
        self.log.append(("receive", self.name, port, datagram, now_ns))
        self.out += self.answers.get(datagram, [])

    def tick(self, now_ns):
        self.log.append(("tick", self.name, now_ns))
        assert self.deadlines
        assert now_ns >= self.deadlines[0]
        self.deadlines.pop(0)
        self.out += self.sends
        self.made.append(Record("events", now_ns, {"node": self.name}))

    def next_deadline_ns(self):
        return self.deadlines[0] if self.deadlines else None

    def outgoing(self):
        out, self.out = self.out, []
        return out

    def records(self):
        made, self.made = self.made, []
        return made


def network(log, *nodes, wires=None, clocks=(), **more):
    clocks = [*clocks, *[Clock()] * (len(nodes) - len(clocks))]
    people = [Participant(n.name, n, c) for n, c in zip(nodes, clocks, strict=True)]
    return VirtualNetwork(people, wires or {}, **more)


def fly(net, limit_ns=S):
    net.run(lambda: False, limit_ns)


def test_at_one_instant_deliveries_come_before_ticks_and_ticks_in_node_order():
    log = []
    a = Ticker("a", log, [10], [("out", b"hello")])
    b, c = Ticker("b", log, [10]), Ticker("c", log, [10])
    fly(network(log, a, b, c, wires={("a", "out"): ("c", "in")}))
    assert log == [
        ("tick", "a", 10),
        ("receive", "c", "in", b"hello", 10),
        ("tick", "b", 10),
        ("tick", "c", 10),
    ]


def test_deliveries_of_one_instant_go_by_node_order_then_by_sequence():
    log = []
    sends = [("to_c", b"1"), ("to_b", b"2"), ("to_c", b"3"), ("to_b", b"4")]
    a, b, c = Ticker("a", log, [5], sends), Ticker("b", log), Ticker("c", log)
    fly(network(log, a, b, c, wires={("a", "to_c"): ("c", "in"), ("a", "to_b"): ("b", "in")}))
    assert [entry[1:4] for entry in log[1:]] == [
        ("b", "in", b"2"),
        ("b", "in", b"4"),
        ("c", "in", b"1"),
        ("c", "in", b"3"),
    ]


def test_an_answer_to_a_delivery_still_comes_before_the_ticks_of_that_instant():
    log = []
    a = Ticker("a", log, [5, 5], [("out", b"ping")])
    b = Ticker("b", log, answers={b"ping": [("back", b"pong")]})
    fly(network(log, a, b, wires={("a", "out"): ("b", "in"), ("b", "back"): ("a", "in")}))
    assert [entry[:2] for entry in log] == [
        ("tick", "a"),
        ("receive", "b"),
        ("receive", "a"),
        ("tick", "a"),
        ("receive", "b"),
        ("receive", "a"),
    ]


@quick
@given(
    st.lists(st.lists(st.integers(0, 50), max_size=8), min_size=1, max_size=4),
    st.lists(st.integers(-200_000, 200_000), min_size=4, max_size=4),
)
def test_every_deadline_is_served_in_true_time_order_at_the_first_instant_that_shows_it(plans, drifts):
    log = []
    clocks = [Clock(100 * i, drifts[i]) for i in range(len(plans))]
    nodes = [Ticker(str(i), log, sorted(100 * i + 1000 * t for t in plan)) for i, plan in enumerate(plans)]
    wanted = sorted((clocks[i].true_ns(due), i) for i, node in enumerate(nodes) for due in node.deadlines)
    fly(network(log, *nodes, clocks=clocks))
    assert [(int(name), now) for _, name, now in log] == [(i, clocks[i].node_ns(true_ns)) for true_ns, i in wanted]


def test_a_node_is_told_its_own_time_and_its_records_are_filed_at_true_time():
    log, filed = [], []
    clock = Clock(137 * S, 40_000, boot_ns=7)
    a = Ticker("a", log, [138 * S])
    fly(network(log, a, clocks=[clock], sink=lambda r, t: filed.append((r.t_ns, t))), 2 * S)
    [(_, _, now_ns)] = log
    true_ns = clock.true_ns(138 * S)
    assert now_ns == clock.node_ns(true_ns) >= 138 * S
    assert filed == [(now_ns, true_ns)]


def test_what_is_due_in_the_past_is_served_now():
    log = []
    a, b = Ticker("a", log, [100]), Ticker("b", log, [3])
    net = network(log, a, wires={})
    fly(net, 200)
    net.replace("a", b, Clock(0))
    fly(net, 300)
    assert log == [("tick", "a", 100), ("tick", "b", 200)]


def test_time_stops_at_the_limit_and_goes_on_from_there():
    log = []
    a = Ticker("a", log, [10, 20, 30])
    net = network(log, a)
    fly(net, 20)
    assert (net.now_ns, len(log)) == (20, 2)
    fly(net, 25)
    assert (net.now_ns, len(log)) == (25, 2)
    fly(net, 30)
    assert (net.now_ns, len(log)) == (30, 3)


def test_time_never_goes_back_to_an_earlier_limit():
    log = []
    net = network(log, Ticker("a", log, [10, 20]))
    fly(net, 15)
    fly(net, 12)
    assert net.now_ns == 15


def test_a_flight_ends_when_it_is_told_to():
    log = []
    net = network(log, Ticker("a", log, list(range(100))))
    net.run(lambda: len(log) >= 3, S)
    assert len(log) == 3


def test_a_port_without_wire_loses_what_is_sent():
    log = []
    fly(network(log, Ticker("a", log, [1], [("nowhere", b"x")]), Ticker("b", log)))
    assert [entry[0] for entry in log] == ["tick"]


def test_the_tap_sees_both_ways_of_the_tapped_nodes_only():
    log, seen = [], []
    a = Ticker("a", log, [5], [("out", b"ping")])
    b = Ticker("b", log, answers={b"ping": [("back", b"pong")]})
    wires = {("a", "out"): ("b", "in"), ("b", "back"): ("a", "in")}
    fly(network(log, a, b, wires=wires, tap=lambda *what: seen.append(what), tapped=["a"]))
    assert seen == [("a", "out", "sent", b"ping", 5), ("a", "in", "received", b"pong", 5)]


def test_a_node_in_the_place_of_a_frozen_one_boots_on_its_new_clock_and_takes_what_waits():
    log = []
    a = Ticker("a", log, [10], [("out", b"late")])
    b = Ticker("b", log)
    net = network(log, a, b, wires={("a", "out"): ("b", "in")})
    net.freeze("b")
    net.run(lambda: bool(log), S)
    fresh = Ticker("b", log, [500 + 7])
    net.replace("b", fresh, Clock(500, 0, net.now_ns))
    fly(net)
    assert log[1:] == [("receive", "b", "in", b"late", 500), ("tick", "b", 507)]
    assert net.now_ns == S


# what may happen to a node


def pair(log, a_deadlines=(), b_deadlines=(), max_waiting=256):
    """Return a network in which a sends b its number at each of its deadlines, 10 ns apart."""
    a = Ticker("a", log, list(a_deadlines), [("out", b"x")])
    b = Ticker("b", log, list(b_deadlines))
    people = [Participant("a", a, Clock()), Participant("b", b, Clock(), max_waiting)]
    return VirtualNetwork(people, {("a", "out"): ("b", "in")})


def of(log, name):
    return [(entry[0], entry[-1]) for entry in log if entry[1] == name]


def test_a_dead_node_does_nothing_and_what_is_for_it_is_lost():
    log = []
    net = pair(log, [10, 20, 30], [15, 25])
    fly(net, 12)
    net.kill("b")
    fly(net, 100)
    assert of(log, "b") == [("receive", 10)]
    assert net.losses["b"] == {Loss.DEAD: 2}


def test_what_waits_for_a_node_dies_with_it_and_a_new_one_lives():
    log = []
    net = pair(log, [10, 20, 30])
    net.freeze("b")
    fly(net, 15)
    net.kill("b")
    fly(net, 25)
    net.replace("b", Ticker("b", log, [7]), Clock(0, 0, 25))
    fly(net, 100)
    assert net.losses["b"] == {Loss.DEAD: 2}
    assert of(log, "b") == [("receive", 5), ("tick", 7)]


def test_a_frozen_node_takes_all_that_waits_when_it_thaws_and_then_ticks_once():
    log = []
    net = pair(log, [10, 20, 30], [15])
    net.freeze("b")
    fly(net, 25)
    assert of(log, "b") == []
    net.thaw("b")
    fly(net, 100)
    assert of(log, "b") == [("receive", 25), ("receive", 25), ("tick", 25), ("receive", 30)]
    assert not net.losses["b"]


def test_no_more_waits_for_a_frozen_node_than_there_is_room_for():
    log = []
    net = pair(log, [10, 20, 30, 40, 50], max_waiting=2)
    net.freeze("b")
    fly(net, 45)
    net.thaw("b")
    fly(net, 100)
    assert of(log, "b") == [("receive", 45), ("receive", 45), ("receive", 50)]
    assert net.losses["b"] == {Loss.OVERFLOW: 2}


def test_a_mute_node_hears_and_ticks_and_what_it_sends_is_lost():
    log = []
    net = pair(log, [10, 20, 30])
    fly(net, 15)
    net.mute("a", True)
    fly(net, 25)
    net.mute("a", False)
    fly(net, 100)
    assert of(log, "a") == [("tick", 10), ("tick", 20), ("tick", 30)]
    assert of(log, "b") == [("receive", 10), ("receive", 30)]
    assert net.losses["a"] == {Loss.MUTE: 1}


def test_a_muted_send_is_on_no_wire_and_in_no_tap():
    log, seen = [], []
    a = Ticker("a", log, [5, 6], [("out", b"x")])
    net = network(log, a, tap=lambda *what: seen.append(what[-1]), tapped=["a"])
    fly(net, 5)
    net.mute("a", True)
    fly(net, 10)
    assert seen == [5]


@pytest.mark.parametrize("by_ns", [-30, 30])
def test_a_clock_that_steps_moves_the_deadlines_of_its_node_only(by_ns):
    log = []
    net = pair(log, [100], [100])
    fly(net, 50)
    net.step_clock("b", by_ns)
    fly(net, 200)
    assert net.clock("b").node_ns(60) == 60 + by_ns
    assert of(log, "a") == [("tick", 100)]
    assert [entry for entry in log if entry[1] == "b" and entry[0] == "tick"] == [("tick", "b", 100)]
    order = [entry[1] for entry in log if entry[0] == "tick"]
    assert order == (["b", "a"] if by_ns > 0 else ["a", "b"])


def test_a_clock_of_another_rate_goes_on_from_what_it_shows():
    log = []
    a = Ticker("a", log, [2 * S])
    net = network(log, a, clocks=[Clock(0, 0)])
    fly(net, S)
    net.drift_clock("a", 200_000)
    assert net.clock("a").node_ns(S) == S
    assert net.clock("a").node_ns(2 * S) == 2 * S + 200_000
    fly(net, 2 * S - 199_960)
    assert of(log, "a") == [("tick", 2 * S)]


def test_a_clock_that_steps_back_past_a_deadline_makes_it_wait_again():
    log = []
    net = pair(log, [], [100, 110])
    fly(net, 105)
    net.step_clock("b", -50)
    fly(net, 159)
    assert of(log, "b") == [("tick", 100)]
    fly(net, 160)
    assert of(log, "b") == [("tick", 100), ("tick", 110)]


@pytest.mark.parametrize("seconds", [3])
def test_a_flight_is_the_same_bytes_every_time(seconds):
    flights = [
        Flight(
            up=constant(13 * MS), down=constant(21 * MS), plant_clock=PLANT_CLOCK, autopilot_clock=AUTOPILOT_CLOCK
        ).fly(seconds * S)
        for _ in range(2)
    ]
    assert len(flights[0].datagrams) > 1000
    assert flights[0].datagrams == flights[1].datagrams
    assert flights[0].bodies("plant/truth") == flights[1].bodies("plant/truth")
    assert flights[0].bodies("autopilot/command") == flights[1].bodies("autopilot/command")
