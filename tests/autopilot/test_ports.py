"""Ports that answer, ports that know when a datagram came, and what the kernel is asked for, on the loopback."""

from __future__ import annotations

import ctypes
import select
import socket
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from autopilot.link import kernel, ports
from autopilot.link.clock import NS_PER_S
from autopilot.link.ports import (
    MAX_STAMP_AGE_NS,
    RECEIVE_BUFFER_BYTES,
    WIDE_BUFFER_BYTES,
    UdpPort,
    answer,
    dial,
    listen,
    true_ns,
)
from gains.table import InputError

HOME = ("127.0.0.1", 0)
TIMEOUT_S = 5.0


@pytest.fixture
def client() -> Iterator[socket.socket]:
    with closing(a_socket()) as sock:
        yield sock


@pytest.fixture
def other() -> Iterator[socket.socket]:
    with closing(a_socket()) as sock:
        yield sock


@pytest.fixture
def stamped() -> Iterator[UdpPort]:
    port = listen("p", HOME, accept=bool, stamps=True)
    with closing(port.socket):
        if not port.stamps:
            pytest.skip("this kernel does not tell when a datagram came")
        yield port


def a_socket() -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(HOME)
    sock.settimeout(TIMEOUT_S)
    return sock


def take(port: UdpPort, now_ns: int = 0) -> bytes | None:
    """Wait for a datagram at a port, and take it."""
    assert select.select([port.socket], [], [], TIMEOUT_S)[0]
    return port.receive(now_ns)


def arrival(port: UdpPort, sender: socket.socket) -> int:
    """Have a datagram sent and taken; return when the port says it came."""
    sender.sendto(b"x", port.local)
    assert take(port, true_ns()) == b"x"
    return port.came_ns(true_ns())


# ports that answer


def test_a_port_that_answers_hears_everybody_and_talks_to_whom_it_heard_last(client, other):
    port = answer("p", HOME)
    with closing(port.socket):
        for sender in (client, other, client):
            sender.sendto(b"question", port.local)
            assert take(port) == b"question"
            port.send(b"answer")
            assert sender.recv(99) == b"answer"
        assert (port.strangers, port.unsent) == (0, 0)


def test_a_port_that_answers_has_nobody_to_talk_to_before_it_was_asked():
    port = answer("p", ("localhost", 0))
    with closing(port.socket):
        port.send(b"answer")
        assert port.unsent == 1


@pytest.mark.parametrize("host", ["0.0.0.0", "192.0.2.1", "::"])
def test_a_port_that_answers_is_for_this_machine_only(host):
    with pytest.raises(InputError, match=r"14602: expected one of this machine alone, such as 127\.0\.0\.1"):
        answer("p", (host, 14602))


def test_a_port_that_answers_refuses_a_busy_address(client):
    with pytest.raises(InputError, match="in use"):
        answer("p", client.getsockname())


# when a datagram came


@pytest.mark.parametrize("dials", [False, True])
def test_a_datagram_came_when_the_kernel_got_it_and_not_when_it_was_taken(client, dials):
    port = dial("p", client.getsockname(), stamps=True) if dials else listen("p", HOME, accept=bool, stamps=True)
    with closing(port.socket):
        if not port.stamps:
            pytest.skip("this kernel does not tell when a datagram came")
        before_ns = true_ns()
        client.sendto(b"x", port.local)
        assert take(port, before_ns) == b"x"
        now_ns = true_ns()
        assert before_ns <= port.came_ns(now_ns) < now_ns
        assert port.unstamped == 0


def test_datagrams_came_in_the_order_in_which_they_are_taken(client, stamped):
    before_ns = true_ns()
    for _ in range(20):
        client.sendto(b"x", stamped.local)
    came = []
    for _ in range(20):
        take(stamped, before_ns)
        came.append(stamped.came_ns(true_ns()))
    assert came == sorted(came)
    assert before_ns <= came[0] < came[-1]


def test_without_stamps_a_datagram_came_when_it_was_taken(client):
    port = listen("p", HOME, accept=bool)
    with closing(port.socket):
        client.sendto(b"x", port.local)
        take(port)
        assert port.came_ns(12345) == 12345
        assert port.unstamped == 0


@pytest.mark.parametrize("step_ns", [-NS_PER_S // 1000, -NS_PER_S, MAX_STAMP_AGE_NS + 1, 3600 * NS_PER_S])
def test_a_stamp_in_the_future_or_too_old_is_not_believed_but_counted(client, stamped, monkeypatch, step_ns):
    wall_ns = ports.time_ns
    client.sendto(b"x", stamped.local)
    monkeypatch.setattr(ports, "time_ns", lambda: wall_ns() + step_ns)
    assert take(stamped) == b"x"
    now_ns = true_ns()
    assert stamped.came_ns(now_ns) == now_ns
    assert stamped.unstamped == 1


def test_no_datagram_came_before_the_one_before(client, stamped, monkeypatch):
    first_ns = arrival(stamped, client)
    wall_ns = ports.time_ns
    monkeypatch.setattr(ports, "time_ns", lambda: wall_ns() + NS_PER_S // 2)  # stepped, and not by enough to be seen
    assert arrival(stamped, client) == first_ns


def test_no_datagram_came_before_there_was_none(client, stamped, monkeypatch):
    empty_ns = true_ns()
    assert stamped.receive(empty_ns) is None
    wall_ns = ports.time_ns
    monkeypatch.setattr(ports, "time_ns", lambda: wall_ns() + NS_PER_S // 2)
    assert arrival(stamped, client) == empty_ns


def test_a_kernel_that_does_not_stamp_is_no_error(client, monkeypatch):
    monkeypatch.setattr(kernel, "SO_TIMESTAMPNS", 9999)
    port = listen("p", HOME, accept=bool, stamps=True)
    with closing(port.socket):
        assert not port.stamps
        client.sendto(b"x", port.local)
        assert take(port) == b"x"


def test_ancillary_data_of_another_kind_is_no_stamp():
    stamp = (socket.SOL_SOCKET, kernel.SO_TIMESTAMPNS, (5).to_bytes(8, "little") + (7).to_bytes(8, "little"))
    others = [(socket.SOL_SOCKET, 1, stamp[2]), (socket.IPPROTO_IP, stamp[1], stamp[2]), (*stamp[:2], b"short")]
    assert kernel.stamp_of(others) is None
    assert kernel.stamp_of([*others, stamp]) == 5 * NS_PER_S + 7


# what the kernel is asked for


@pytest.mark.parametrize("asked", [RECEIVE_BUFFER_BYTES, WIDE_BUFFER_BYTES])
def test_a_port_has_the_buffer_it_asked_for_or_what_the_kernel_allows(asked):
    port = listen("p", HOME, buffer_bytes=asked)
    with closing(port.socket):
        limit = kernel.largest_buffer_bytes()
        assert limit is not None
        assert kernel.buffer_bytes(port.socket) in {asked, min(asked, limit)}


def test_who_may_not_exceed_the_limit_gets_the_limit():
    class Unprivileged(socket.socket):
        def setsockopt(self, level, name, value):
            if name == kernel.SO_RCVBUFFORCE:
                raise PermissionError
            super().setsockopt(level, name, value)

    limit = kernel.largest_buffer_bytes()
    assert limit is not None
    with Unprivileged(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        kernel.widen(sock, 4 * limit)
        assert kernel.buffer_bytes(sock) == limit


def test_a_sharpened_thread_sleeps_without_slack():
    slack = Path(f"/proc/{threading.get_native_id()}/timerslack_ns")
    before = slack.read_text()
    try:
        assert kernel.sharpen_timers()
        assert slack.read_text() == "1\n"
    finally:
        ctypes.CDLL(None).prctl(kernel.PR_SET_TIMERSLACK, ctypes.c_ulong(0), 0, 0, 0)  # the default again
    assert slack.read_text() == before
