"""The record stream: hello, lines, bounds, and an end on either side."""

from __future__ import annotations

import json
import select
import socket
from collections.abc import Iterator
from contextlib import closing

import pytest

from autopilot.link import stream as stream_module
from autopilot.link.node import Record
from autopilot.link.orders import BreakSends, StepClock, encode_order
from autopilot.link.record import decode_line
from autopilot.link.stream import TOKEN_VARIABLE, StreamSink, encode_hello
from gains.table import InputError

TIMEOUT_S = 5.0


def record(number: int) -> Record:
    return Record("events", number, {"kind": "test", "node": "n", "text": "x" * 200, "data": {"n": number}})


@pytest.fixture
def server() -> Iterator[socket.socket]:
    with closing(socket.create_server(("127.0.0.1", 0))) as sock:
        sock.settimeout(TIMEOUT_S)
        yield sock


def connect(server: socket.socket) -> tuple[StreamSink, socket.socket]:
    sink = StreamSink(server.getsockname(), "plant", {"autopilot": ("127.0.0.1", 14600)})
    accepted, _ = server.accept()
    accepted.settimeout(TIMEOUT_S)
    return sink, accepted


def read_all(sock: socket.socket) -> list[bytes]:
    data = b""
    while part := sock.recv(1 << 16):
        data += part
    return data.splitlines(keepends=True)


def test_the_hello_says_who_speaks_with_which_token_and_ports(server, monkeypatch):
    monkeypatch.setenv(TOKEN_VARIABLE, "s3cret")
    sink, accepted = connect(server)
    with closing(accepted):
        sink.close()
        [hello] = read_all(accepted)
    assert hello == encode_hello("plant", "s3cret", {"autopilot": ("127.0.0.1", 14600)})
    assert json.loads(hello) == {
        "hello": "plant",
        "token": "s3cret",
        "ports": {"autopilot": ["127.0.0.1", 14600]},
    }
    assert hello.endswith(b"\n")


def test_without_a_token_the_hello_carries_an_empty_one(server, monkeypatch):
    monkeypatch.delenv(TOKEN_VARIABLE, raising=False)
    sink, accepted = connect(server)
    with closing(accepted):
        sink.close()
        assert json.loads(read_all(accepted)[0])["token"] == ""


def test_records_arrive_in_order_with_their_times(server):
    sink, accepted = connect(server)
    with closing(accepted):
        for number in range(500):
            sink.write(record(number), 1000 + number)
            if number % 7 == 0:
                sink.pump()
        sink.close()
        lines = read_all(accepted)[1:]
    assert [decode_line(line) for line in lines] == [(record(n), 1000 + n) for n in range(500)]
    assert sink.lost == 0


def test_a_slow_recorder_costs_records_and_not_time_or_memory(server, monkeypatch):
    monkeypatch.setattr(stream_module, "MAX_BUFFERED_BYTES", 100_000)
    sink, accepted = connect(server)
    monkeypatch.setattr(stream_module, "DRAIN_TIMEOUT_S", 0.05)
    written = 0
    with closing(accepted):
        while not sink.lost and written < 200_000:
            sink.write(record(written), written)
            sink.pump()
            written += 1
        assert sink.lost == 1
        assert len(sink._buffer) < 100_000 + 1000
        assert not sink.closed
        sink.close()
    assert sink.lost > 1


def test_the_recorder_ends_the_process_by_closing(server):
    sink, accepted = connect(server)
    sink.pump()
    assert not sink.closed
    accepted.close()
    select.select([sink._socket], [], [], TIMEOUT_S)
    sink.pump()
    assert sink.closed
    sink.write(record(1), 1)
    sink.pump()
    sink.close()


def test_a_recorder_that_dies_with_data_under_way_ends_the_process_too(server):
    sink, accepted = connect(server)
    accepted.close()  # unread hello: the connection is reset
    select.select([sink._socket], [], [], TIMEOUT_S)
    for number in range(10):
        sink.write(record(number), number)
        sink.pump()
    assert sink.closed
    sink.close()


def hear(sink: StreamSink) -> None:
    select.select([sink._socket], [], [], TIMEOUT_S)
    sink.pump()


def test_orders_are_heard_whole_in_order_and_once(server):
    sink, accepted = connect(server)
    with closing(accepted):
        assert sink.orders() == []
        first, second = encode_order(StepClock(-7)), encode_order(BreakSends(9))
        accepted.sendall(first + second[:10])
        hear(sink)
        assert sink.orders() == [StepClock(-7)]
        assert sink.orders() == []
        accepted.sendall(second[10:])
        hear(sink)
        assert sink.orders() == [BreakSends(9)]
        assert not sink.closed
        sink.close()


@pytest.mark.parametrize("said", [b'{"order": "land"}\n', b"x" * (stream_module.MAX_HEARD_BYTES + 1)])
def test_what_is_no_order_ends_the_stream(server, said):
    sink, accepted = connect(server)
    with closing(accepted):
        accepted.sendall(said)
        while not sink.closed:
            hear(sink)
            assert sink.orders() == []
        sink.close()


def test_orders_are_heard_while_the_recorder_takes_nothing(server, monkeypatch):
    monkeypatch.setattr(stream_module, "DRAIN_TIMEOUT_S", 0.05)
    sink, accepted = connect(server)
    with closing(accepted):
        while len(sink._buffer) < 1 << 20:
            sink.write(record(1), 1)
            sink.pump()
        accepted.sendall(encode_order(StepClock(1)))
        hear(sink)
        assert sink.orders() == [StepClock(1)]
        sink.close()


def test_nobody_listening_is_refused_by_address(server):
    address = server.getsockname()
    server.close()
    with pytest.raises(InputError, match=rf"record stream 127\.0\.0\.1:{address[1]}: Connection refused"):
        StreamSink(address, "plant", {})
