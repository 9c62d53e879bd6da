"""Orders over the record stream: one line each, strict, and what a driver on real sockets does with them."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from contextlib import closing

import pytest
from hypothesis import given
from hypothesis import strategies as st

from autopilot.link.clock import NS_PER_MS, NS_PER_S, Clock
from autopilot.link.orders import BreakSends, DriftClock, MovePeer, Order, StepClock, decode_order, encode_order, obey
from autopilot.link.udp import UdpDriver, listen, true_ns

DAY_NS = 86_400 * NS_PER_S
HOME = ("127.0.0.1", 0)

orders = st.one_of(
    st.builds(StepClock, st.integers(-DAY_NS, DAY_NS)),
    st.builds(DriftClock, st.integers(-1_000_000, 1_000_000)),
    st.builds(BreakSends, st.integers(0, DAY_NS)),
    st.builds(MovePeer, st.integers(1, 65_535)),
)


class Idle:
    """A node that says what it is told to."""

    def __init__(self) -> None:
        self.out: list[tuple[str, bytes]] = []
        self.got: list[bytes] = []

    def receive(self, port, datagram, now_ns):
        self.got.append(datagram)

    def tick(self, now_ns):
        pass

    def next_deadline_ns(self):
        return None

    def outgoing(self):
        out, self.out = self.out, []
        return out

    def records(self):
        return []


@pytest.fixture
def driver() -> Iterator[UdpDriver]:
    port = listen("autopilot", HOME, accept=lambda datagram: datagram == b"hello")
    with closing(UdpDriver(Idle(), [port], Clock(137 * NS_PER_S, 40_000))) as driver:
        yield driver


@given(orders)
def test_every_order_survives_its_line(order: Order) -> None:
    line = encode_order(order)
    assert line.endswith(b"\n")
    assert line.count(b"\n") == 1
    assert decode_order(line) == order


def test_an_order_reads_as_what_it_is() -> None:
    assert json.loads(encode_order(StepClock(-500))) == {"order": "step_clock", "by_ns": -500}


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"[]",
        b"null",
        b"{}",
        b'{"order": []}',
        b'{"order": {}, "by_ns": 1}',
        b'{"order": "land"}',
        b'{"order": "step_clock"}',
        b'{"order": "step_clock", "by_ns": 1.0}',
        b'{"order": "step_clock", "by_ns": true}',
        b'{"order": "step_clock", "by_ns": null}',
        b'{"order": "step_clock", "by_ns": 86400000000001}',
        b'{"order": "step_clock", "by_ns": 1, "more": 1}',
        b'{"order": "step_clock", "drift_ppb": 1}',
        b'{"order": "drift_clock", "drift_ppb": 1000001}',
        b'{"order": "break_sends", "for_ns": -1}',
        b'{"order": "move_peer", "number": 0}',
        b'{"order": "move_peer", "number": -14600}',
        b'{"order": "move_peer", "number": 65536}',
    ],
)
def test_what_is_no_order_is_refused(line: bytes) -> None:
    with pytest.raises(ValueError):  # noqa: PT011  the JSON's own, too
        decode_order(line)


def test_a_stepped_clock_goes_on_from_where_it_was_put(driver: UdpDriver) -> None:
    at_ns = true_ns()
    before_ns = driver.clock.node_ns(at_ns)
    obey(StepClock(-3 * NS_PER_S), driver)
    later_ns = true_ns() + NS_PER_S
    elapsed_ns = later_ns - at_ns
    stepped_ns = driver.clock.node_ns(later_ns) - before_ns
    assert stepped_ns == pytest.approx(elapsed_ns * (1 + 40e-6) - 3 * NS_PER_S, abs=3)


def test_a_drifting_clock_does_not_jump(driver: UdpDriver) -> None:
    at_ns = true_ns() + NS_PER_MS
    before_ns = driver.clock.node_ns(at_ns)
    obey(DriftClock(-150_000), driver)
    assert driver.clock.node_ns(at_ns) == pytest.approx(before_ns, abs=NS_PER_MS * 1e-3)
    elapsed_ns = 100 * NS_PER_S
    gained_ns = driver.clock.node_ns(at_ns + elapsed_ns) - driver.clock.node_ns(at_ns) - elapsed_ns
    assert gained_ns == pytest.approx(-150e-6 * elapsed_ns, abs=2)


def test_broken_sends_are_counted_and_those_of_a_mended_one_arrive(driver: UdpDriver) -> None:
    [port] = driver.ports
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as far:
        far.bind(HOME)
        far.settimeout(5.0)
        port.peer = far.getsockname()
        obey(BreakSends(DAY_NS), driver)
        driver.node.out = [("autopilot", b"lost")]
        driver.serve(())
        assert port.unsent == 1
        obey(BreakSends(0), driver)
        driver.node.out = [("autopilot", b"kept")]
        driver.serve(())
        assert (far.recv(64), port.unsent) == (b"kept", 1)


def test_a_moved_peer_is_heard_at_once_and_the_old_one_no_longer(driver: UdpDriver) -> None:
    [port] = driver.ports
    with (
        closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as old,
        closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as new,
    ):
        for sock in (old, new):
            sock.connect(port.local)
            sock.settimeout(5.0)
        obey(MovePeer(new.getsockname()[1]), driver)
        assert port.peer is None  # nobody was there who could have moved

        def said(sock: socket.socket, datagram: bytes) -> list[bytes]:
            sock.send(datagram)
            driver.serve([port])
            got, driver.node.got = driver.node.got, []
            return got

        assert said(old, b"hello") == [b"hello"]
        assert said(new, b"hello") == []
        obey(MovePeer(new.getsockname()[1]), driver)
        assert said(new, b"at once") == [b"at once"]
        assert said(old, b"hello") == []
        assert port.strangers == 2
        driver.node.out = [("autopilot", b"to the new one")]
        driver.serve(())
        assert new.recv(64) == b"to the new one"
