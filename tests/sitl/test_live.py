import asyncio
import os
import signal
import socket
import sys
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import orjson
import pytest
from click.testing import CliRunner
from mcap.writer import Writer
from rich.console import Console
from tornado.httpclient import HTTPClientError, HTTPRequest
from tornado.websocket import WebSocketClientConnection, websocket_connect

from autopilot.link.node import Record
from autopilot.link.record import McapRecorder, read_mcap, read_metadata
from autopilot.link.topics import schema_of
from gains.model import Model
from gains.store import load_model
from gains.table import InputError
from sitl.commands.live import live
from sitl.flightdata import FlightData
from sitl.fly import FlightOptions, fly
from sitl.live import server as server_module
from sitl.live.feed import MAX_EVENTS, Feed
from sitl.live.follower import About, Attached, End, Follower, Found, Message
from sitl.live.foxglove import FoxgloveStream
from sitl.live.page import render
from sitl.live.server import MAX_CLIENTS, MAX_CONNECTIONS, STREAM_PATH, LiveServer, policy
from sitl.live.session import SILENT_NS, Flight, Session, State
from sitl.live.tail import PIECE_BYTES, Tail, Watch
from sitl.scenario import load_scenario
from tests.helpers import HIRM, S

UPGRADE = (
    "Upgrade: websocket",
    "Connection: Upgrade",
    "Sec-WebSocket-Version: 13",
    "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==",
)
DRIFT = 40e-6
"""Of the relay's clock at the most: the report takes one offset for all packets."""
FLOWN = ("blackout", "fault-kill-plant")


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, dict[str, Any]]]:
    """Two flights in virtual time: the link goes, and the plant dies and starts again; file and summary of each."""
    flights = {}
    for name in FLOWN:
        folder = tmp_path_factory.mktemp(name)
        scenario = replace(load_scenario(name), duration_s=8.0)
        outcome = fly(scenario, FlightOptions(True, folder, (), 0), Console(quiet=True))
        flights[name] = folder / "flight.mcap", outcome.summary
    return flights


def followed(data: bytes, size: int) -> list[Found]:
    follower = Follower()
    return [found for at in range(0, len(data), size) for found in follower.take(data[at : at + size])]


def recorded(path: Path, count: int = 3, **metadata: str) -> McapRecorder:
    """Return a recorder that is still open and has written that many chunks of one event each."""
    recorder = McapRecorder(path, {"plant": "hirm", **metadata})
    for number in range(2 * count):  # each chunk is closed by a message half a second later
        recorder.write(event(f"event {number}"), number * S // 2)
    return recorder


def event(text: str) -> Record:
    return Record("events", 0, {"kind": "mode", "node": "test", "text": text, "data": {}})


# follower


@pytest.mark.parametrize("size", [1, 7, 4096, 1 << 30])
def test_a_recording_cut_anywhere_is_read_as_the_standard_reader_reads_it_whole(tmp_path: Path, size: int) -> None:
    path = tmp_path / "flight.mcap"
    with recorded(path):
        pass
    found = followed(path.read_bytes(), size)
    messages = [(each.topic, each.log_time_ns, orjson.loads(each.data)) for each in found if isinstance(each, Message)]
    assert messages == list(read_mcap(path))
    assert found[0] == About(read_metadata(path))
    assert found[-1] == End(damaged=False)


def test_a_growing_recording_gives_each_message_once_and_never_a_half_one(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    with recorded(path, 4):
        pass
    data, follower, seen = path.read_bytes(), Follower(), []
    whole = [each.data for each in followed(data, 1 << 30) if isinstance(each, Message)]
    for at in range(len(data)):
        seen += [each.data for each in follower.take(data[at : at + 1]) if isinstance(each, Message)]
        assert seen == whole[: len(seen)]
    assert seen == whole


def test_an_attachment_with_a_wrong_checksum_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "attached.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_attachment(0, 0, "model.toml", "text/plain", b"name = 1")
        writer.finish()
    data = path.read_bytes()
    assert Attached("model.toml", b"name = 1") in followed(data, 11)
    follower = Follower()
    found = list(follower.take(data.replace(b"name = 1", b"name = 2")))
    assert not [each for each in found if isinstance(each, Attached)]
    assert follower.refused == 1


@pytest.mark.parametrize("data", [b"no recording", b"\x89MCAP0\r\n" + bytes(9)])
def test_what_is_no_recording_ends_the_following(data: bytes) -> None:
    assert followed(data, 3) == [End(damaged=True)]


def test_a_damaged_chunk_is_counted_and_the_next_one_is_read(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    with recorded(path, 2):
        pass
    data = bytearray(path.read_bytes())
    at = data.index(b"\x28\xb5\x2f\xfd")  # the first chunk's zstd frame
    data[at + 20] ^= 0xFF
    follower = Follower()
    messages = [found for found in follower.take(bytes(data)) if isinstance(found, Message)]
    assert follower.refused >= 1
    assert len(messages) < 4
    assert follower.over


# tail and watch


def test_a_file_is_read_as_it_grows_in_bounded_pieces(tmp_path: Path) -> None:
    path = tmp_path / "f"
    tail = Tail(path)
    assert tail.read() == (b"", False)
    path.write_bytes(b"a" * (PIECE_BYTES + 5))
    assert [len(tail.read().data) for _ in range(3)] == [PIECE_BYTES, 5, 0]
    with path.open("ab") as file:
        file.write(b"more")
    assert tail.read() == (b"more", False)
    tail.close()


@pytest.mark.parametrize("longer", [0, 100])
def test_a_file_begun_anew_is_read_from_its_start_although_it_is_longer_already(tmp_path: Path, longer: int) -> None:
    path = tmp_path / "f"
    path.write_bytes(bytes(range(100)))
    tail = Tail(path)
    tail.read()
    anew = b"other" + bytes(60 + longer)
    path.write_bytes(anew)
    assert tail.read() == (anew, True)
    tail.close()


def test_a_file_put_in_the_place_of_another_is_read_from_its_start(tmp_path: Path) -> None:
    path, other = tmp_path / "f", tmp_path / "g"
    path.write_bytes(b"same bytes")
    tail = Tail(path)
    tail.read()
    other.write_bytes(b"same bytes, and more")
    other.replace(path)
    assert tail.read() == (b"same bytes, and more", True)
    path.unlink()
    assert tail.read() == (b"", False)
    tail.close()


def test_a_pipe_or_a_folder_in_place_of_the_file_is_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path):
        tail = Tail(path)
        assert tail.read() == (b"", False)
        tail.close()


def test_the_newest_recording_is_found_then_each_newer_one_and_none_twice(tmp_path: Path) -> None:
    watch = Watch(tmp_path / "flights")
    assert watch.look() is None
    paths = [tmp_path / "flights" / name / "flight.mcap" for name in ("b", "a")]
    for n, path in enumerate(paths):
        path.parent.mkdir(parents=True)
        path.write_bytes(b"x")
        os.utime(path, (100 + n, 100 + n))
    assert watch.look() == paths[1]
    os.utime(paths[0], (300, 300))  # an older flight that goes on does not take the page back
    assert watch.look() is None
    new = tmp_path / "flights" / "by-hand.mcap"
    new.write_bytes(b"x")
    os.utime(new, (200, 200))
    assert watch.look() == new
    paths[0].write_bytes(b"")
    assert watch.look() == paths[0]  # begun anew


# feed


@pytest.mark.parametrize("name", FLOWN)
def test_at_the_end_the_numbers_are_those_of_the_summary(flown: dict[str, Any], name: str) -> None:
    path, summary = flown[name]
    metadata = read_metadata(path)
    model = load_model(metadata["plant"])
    feed = Feed(model, metadata)
    for found in followed(path.read_bytes(), 997):
        if isinstance(found, Message):
            feed.take(*found)
            feed.settle()
    feed.settle(end=True)
    numbers = feed.numbers()
    assert feed.malformed == 0
    assert numbers["rms_error"] == pytest.approx(summary["rms_error_rad"], rel=1e-9)
    assert numbers["max_error"] == pytest.approx(summary["max_error_rad"], rel=1e-9)
    assert numbers["exact_fraction"] == summary["delay"]["estimated_exact_fraction"]
    for key in ("samples", "failsafe_events", "late_ticks"):
        assert numbers[key] == summary[key]
    assert numbers["mode"] == summary["mode_at_end"]
    for way, counts in numbers["link"].items():
        expected = {key: summary["link"][way][key] for key in ("sent", "delivered", "lost", "duplicated")}
        assert {key: counts[key] for key in expected} == expected


@pytest.mark.parametrize("name", FLOWN)
def test_rows_are_the_flight_as_the_report_reads_it(flown: dict[str, Any], name: str) -> None:
    path, _ = flown[name]
    metadata = read_metadata(path)
    model = load_model(metadata["plant"])
    flight = FlightData.from_records(read_mcap(path), model, metadata)
    feed = Feed(model, metadata)
    told, rows = None, {}
    for topic, log_time_ns, body in read_mcap(path):
        feed.take(topic, log_time_ns, orjson.dumps(body))
        feed.settle()
        news = feed.since(told)
        told = feed.told()
        rows = {} if news.anew else rows
        for source, columns in news.rows.items():
            for column, values in columns.items():
                rows.setdefault(source, {}).setdefault(column, []).extend(values)
    feed.settle(end=True)
    for column, values in feed.since(told).rows["samples"].items():
        rows["samples"][column].extend(values)

    samples = {column: np.array(values, dtype=float) for column, values in rows["samples"].items()}
    np.testing.assert_allclose(samples["t"], flight.time_s, atol=1e-6)
    np.testing.assert_array_equal(samples["d"], flight.d)
    for column, expected in (("y", flight.output), ("yr", flight.reference), ("u", flight.u), ("e", flight.error)):
        np.testing.assert_allclose(samples[column], expected[:, 0], rtol=1e-5, atol=1e-12)
    for way, packets in flight.links.items():
        entered_s, delay_ms = (np.array(rows[way][column], dtype=float) for column in ("t", "ms"))
        arrived = np.isfinite(packets.delay_s)
        np.testing.assert_array_equal(np.isfinite(delay_ms), arrived)
        np.testing.assert_allclose(entered_s[arrived], packets.entered_s[arrived], atol=DRIFT * 8.0)
        np.testing.assert_allclose(delay_ms[arrived], 1e3 * packets.delay_s[arrived], rtol=1e-5)


def test_what_makes_no_sense_is_counted_and_changes_nothing() -> None:
    feed = Feed(HIRM.model, {})
    before = feed.since(None)
    for topic, data in (
        ("plant/truth", b"{"),
        ("plant/truth", b"[]"),
        ("plant/truth", b'{"k": 1000000000, "late_ns": 0, "j": 1, "d": 1, "x": [0, 0, 0], "u": [0]}'),
        ("plant/truth", b'{"k": 0, "late_ns": 0, "j": null, "d": null, "x": [0], "u": [0]}'),
        ("autopilot/command", b'{"j": "0"}'),
        ("link/up", b'{"fate": 0}'),
        ("events", b'{"kind": "failsafe", "node": "x", "text": "", "data": {"to": "NOWHERE", "from": "HOLD"}}'),
    ):
        feed.take(topic, 0, data)
    feed.settle(end=True)
    assert feed.malformed == feed.records == 7
    assert feed.since(None) == before


def test_the_rows_kept_are_bounded() -> None:
    feed = Feed(None, {})
    for number in range(MAX_EVENTS + 50):
        feed.take("events", number, orjson.dumps(event(str(number)).body))
    feed.settle()
    rows = feed.since(None).rows["events"]
    assert len(rows["text"]) == MAX_EVENTS
    assert rows["text"][-1] == str(MAX_EVENTS + 49)
    assert "x" * 1000 not in rows["text"]


# session


def test_a_session_waits_follows_falls_silent_and_ends(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    session = Session(path)
    assert not session.step(0)
    assert (session.state, session.flight.number) == (State.WAITING, 0)
    recorder = recorded(path, title="by hand")
    session.step(S)
    assert (session.state, session.flight.number) == (State.LIVE, 1)
    assert session.flight.metadata["title"] == "by hand"
    assert session.flight.model is not None
    session.step(S + SILENT_NS + 1)
    assert session.state is State.SILENT
    recorder.close()
    session.step(S + SILENT_NS + 2)
    assert session.state is State.ENDED
    session.close()


def test_a_session_goes_on_to_the_newer_flight_and_to_one_begun_anew(tmp_path: Path) -> None:
    session = Session(tmp_path)
    numbers = []
    for step, name in enumerate(("a", "b", "b")):
        (tmp_path / name).mkdir(exist_ok=True)
        with recorded(tmp_path / name / "flight.mcap", 1, title=f"{name} {step}"):
            pass
        for part in range(4):
            session.step((2 * step + 1) * S + part)
        numbers.append((session.flight.number, session.flight.name, session.flight.metadata["title"], session.state))
    assert numbers == [(1, "a", "a 0", "ended"), (2, "b", "b 1", "ended"), (3, "b", "b 2", "ended")]
    session.close()


def test_news_continue_the_snapshot(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    recorder = recorded(path, 1)
    session = Session(path, "run")
    session.step(0)
    first = orjson.loads(session.snapshot())
    told = session.feed.told()
    recorder.write(event("news"), 10 * S)
    recorder.close()
    session.step(1)
    news = orjson.loads(session.news(told))
    assert (first["run"], first["flight"], first["anew"], news["anew"]) == ("run", 1, True, False)
    assert [*first["rows"]["events"]["text"], *news["rows"]["events"]["text"]] == ["event 0", "event 1", "news"]
    session.close()


def test_a_model_named_by_the_recording_is_read_only_if_it_is_a_stored_one(tmp_path: Path) -> None:
    for name, known in (("hirm", True), ("../hirm.toml", False), ("/etc/hostname", False), ("nowhere", False)):
        path = tmp_path / "flight.mcap"
        with recorded(path, 1, plant=name):
            pass
        session = Session(path)
        session.step(0)
        assert (session.flight.model is not None) == known
        session.close()


# page


class Loads(HTMLParser):
    """Collects what a page loads, by any attribute that can load."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str | None] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [value for name, value in attrs if name in ("src", "href", "srcset", "data", "action")]


def loaded_by(page: str) -> list[str | None]:
    loads = Loads()
    loads.feed(page)
    return loads.found


def test_the_page_loads_nothing_and_a_recordings_text_stays_text() -> None:
    evil = '</script><script>alert("x")</script>$title<img src=x>'
    flight = Flight(1, evil, {"title": evil, "plant": evil}, HIRM.model)
    page = render(flight, "run")
    assert "<script>alert" not in page
    assert "<img" not in page
    assert loaded_by(page) == ["data:,"]
    assert len(page) < 1_600_000


def test_the_policy_allows_the_pages_own_scripts_and_its_stream_alone() -> None:
    allowed = policy("<script>a</script><p>b</p><script type='x'>c</script>", "127.0.0.1:8080")
    # sha256 of "a" and "c" by sha256sum, in base64
    assert "script-src 'sha256-ypeBEsobvcr6wjGzmiPcTaeG7/gUfE5yuYB3ha/uSLs='" in allowed
    assert "'sha256-Ln0sA6lQeuJl7PW1NWiFpTOTogKdJBOUmXJloaJa78Y='" in allowed
    assert "default-src 'none'" in allowed
    assert "connect-src ws://127.0.0.1:8080/stream;" in allowed
    assert "unsafe-eval" not in allowed


def test_a_page_without_a_flight_is_light_and_waits() -> None:
    page = render(Flight(0, "", {}, None), "run")
    assert "no flight yet" in page
    assert len(page) < 50_000


@pytest.mark.parametrize("model", [None, load_model("pendulum")])
def test_a_page_is_made_of_any_model_or_none(model: Model | None) -> None:
    assert "document" in render(Flight(1, "flight", {"d_min": "nan", "d_max": "x"}, model), "run")


# server

OPENED: list[WebSocketClientConnection] = []
"""Streams of the test that runs, to be closed at its end."""


async def close_streams() -> None:
    while OPENED:
        client = OPENED.pop()
        client.close()
        while await client.read_message() is not None:
            pass


def serving(path: Path, check: Callable[[LiveServer], Awaitable[None]], steps: int = 3) -> None:
    """Run a check against a server of a recording."""

    async def run() -> None:
        session = Session(path, "run")
        for step in range(steps):
            session.step(step)
        server = LiveServer(("127.0.0.1", 0), session, lambda flight: f"<script>{flight.number}</script>")
        try:
            await asyncio.wait_for(check(server), 20.0)
        finally:
            await server.close()
            await asyncio.wait_for(close_streams(), 5.0)
            session.close()
            await asyncio.sleep(0)

    asyncio.run(run())


async def asked(server: LiveServer, head: str) -> str:
    """Return the answer to a request, given as text."""
    reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
    writer.write((head + "\r\nConnection: close\r\n\r\n").encode())
    answer = await reader.read()
    writer.close()
    await writer.wait_closed()
    return answer.decode()


async def stream(server: LiveServer, host: str = "", origin: str = "") -> WebSocketClientConnection:
    here = f"127.0.0.1:{server.port}"
    headers = {"Host": host or here, "Origin": origin or f"http://{here}"}
    client = await websocket_connect(HTTPRequest(f"ws://{here}{STREAM_PATH}", headers=headers))
    OPENED.append(client)
    return client


async def refused(server: LiveServer, **headers: str) -> int:
    with pytest.raises(HTTPClientError) as error:
        await stream(server, **headers)
    return int(error.value.code)


@pytest.fixture
def recording(tmp_path: Path) -> Iterator[Path]:
    with recorded(tmp_path / "flight.mcap"):
        yield tmp_path / "flight.mcap"


def test_a_request_for_another_name_is_refused_and_ours_are_served(recording: Path) -> None:
    async def check(server: LiveServer) -> None:
        port = server.port
        for host in (f"127.0.0.1:{port}", f"localhost:{port}", f"LOCALHOST:{port}", f"[::1]:{port}"):
            assert (await asked(server, f"GET / HTTP/1.1\r\nHost: {host}")).startswith("HTTP/1.1 200")
        strange = ("evil.example", f"evil.example:{port}", "127.0.0.1", f"127.0.0.1:{port + 1}", f"10.0.0.1:{port}")
        for host in strange:
            for path in ("/", STREAM_PATH, "/nothing"):
                assert (await asked(server, f"GET {path} HTTP/1.1\r\nHost: {host}")).startswith("HTTP/1.1 403")
        assert (await asked(server, "GET / HTTP/1.0")).startswith("HTTP/1.1 403")
        assert await refused(server, host=f"evil.example:{port}") == 403
        assert server.counters.hosts == 3 * len(strange) + 2

    serving(recording, check)


def test_a_stream_asked_for_by_another_page_is_refused(recording: Path) -> None:
    async def check(server: LiveServer) -> None:
        origins = (
            "http://evil.example",
            "null",
            f"https://127.0.0.1:{server.port}",
            f"http://127.0.0.1:{server.port + 1}",
        )
        for origin in origins:
            assert await refused(server, origin=origin) == 403
        head = f"GET {STREAM_PATH} HTTP/1.1\r\nHost: 127.0.0.1:{server.port}"  # and without any
        assert (await asked(server, head)).startswith("HTTP/1.1 403")
        assert server.counters.origins == len(origins) + 1
        assert not server.clients

    serving(recording, check)


@pytest.mark.parametrize("method", ["POST", "HEAD", "PUT", "DELETE", "OPTIONS", "PATCH", "TRACE"])
def test_every_method_but_get_is_refused(recording: Path, method: str) -> None:
    async def check(server: LiveServer) -> None:
        answer = await asked(server, f"{method} / HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\nContent-Length: 0")
        assert answer.startswith("HTTP/1.1 405")
        assert "Access-Control" not in answer

    serving(recording, check)


def test_there_are_no_other_paths_and_every_answer_has_the_headers(recording: Path) -> None:
    async def check(server: LiveServer) -> None:
        host = f"127.0.0.1:{server.port}"
        answers = {path: await asked(server, f"GET {path} HTTP/1.1\r\nHost: {host}") for path in ("/", "/x", "/../etc")}
        assert [answer.split()[1] for answer in answers.values()] == ["200", "404", "404"]
        for answer in answers.values():
            for header in ("X-Content-Type-Options: nosniff", "Referrer-Policy: no-referrer", "default-src 'none'"):
                assert header in answer
            assert "Access-Control" not in answer
            assert "Tornado" not in answer
        assert f"connect-src ws://{host}{STREAM_PATH};" in answers["/"]

    serving(recording, check)


def test_a_client_gets_a_snapshot_and_then_what_is_new(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    recorder = recorded(path, 1)

    async def check(server: LiveServer) -> None:
        running = asyncio.create_task(server.run())
        client = await stream(server)
        first = orjson.loads(await client.read_message() or b"")
        recorder.write(event("news"), 10 * S)
        recorder.close()
        news = orjson.loads(await client.read_message() or b"")
        server.stop()
        await running
        assert first["rows"]["events"]["text"] == ["event 0", "event 1"]
        assert news["rows"]["events"]["text"] == ["news"]
        assert news["state"] == "ended"

    serving(path, check)


def test_one_client_too_many_is_refused_and_a_place_is_free_again(recording: Path) -> None:
    async def check(server: LiveServer) -> None:
        clients = [await stream(server) for _ in range(MAX_CLIENTS)]
        assert await refused(server) == 503
        assert server.counters.clients == 1
        clients.pop().close()  # its end is read with that of the others
        while len(server.clients) == MAX_CLIENTS:
            await asyncio.sleep(0)
        clients.append(await stream(server))
        assert len(server.clients) == MAX_CLIENTS

    serving(recording, check)


def test_a_client_that_talks_is_dropped(recording: Path) -> None:
    async def check(server: LiveServer) -> None:
        client = await stream(server)
        OPENED.remove(client)
        await client.write_message("hello")
        while await client.read_message() is not None:
            pass
        client.close()
        while server.clients:
            await asyncio.sleep(0)
        assert server.counters.talking == 1

    serving(recording, check)


def test_a_slow_client_is_dropped_with_what_waits_and_the_others_go_on(
    recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_module, "MAX_BACKLOG_BYTES", 1 << 18)

    async def check(server: LiveServer) -> None:
        slow = socket.socket()
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        slow.setblocking(False)
        loop = asyncio.get_running_loop()
        await loop.sock_connect(slow, ("127.0.0.1", server.port))
        host = f"127.0.0.1:{server.port}"
        head = (f"GET {STREAM_PATH} HTTP/1.1", f"Host: {host}", f"Origin: http://{host}", *UPGRADE, "", "")
        await loop.sock_sendall(slow, "\r\n".join(head).encode())
        quick = await stream(server)
        await quick.read_message()
        while len(server.clients) < 2:
            await asyncio.sleep(0)
        text = "x" * 190
        for number in range(4000):
            server.session.feed.take("events", number, orjson.dumps(event(text).body))
            if number % 200 == 0:
                server.session.revision += 1
                server.session.feed.settle()
                server._tell_all()
                assert orjson.loads(await quick.read_message() or b"")["flight"] == 1
        for _ in range(200):
            if server.counters.slow:
                break
            server.session.feed._axis += 1  # everything is told again: more than the kernel's buffers hold
            server.session.revision += 1
            server._tell_all()
            await quick.read_message()
        assert server.counters.slow == 1
        assert len(server.clients) == 1
        slow.close()

    serving(recording, check)


def test_connections_that_say_nothing_are_bounded(recording: Path) -> None:
    async def check(server: LiveServer) -> None:
        streams = [await asyncio.open_connection("127.0.0.1", server.port) for _ in range(MAX_CONNECTIONS + 3)]
        while server.counters.connections < 3:
            await asyncio.sleep(0)
        assert server.counters.connections == 3
        for _, writer in streams:
            writer.close()
        while server._server.open_connections:
            await asyncio.sleep(0)
        assert (await asked(server, f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{server.port}")).startswith("HTTP/1.1 200")

    serving(recording, check)


def test_a_busy_port_is_one_line(tmp_path: Path) -> None:
    with socket.socket() as busy:
        busy.bind(("127.0.0.1", 0))
        busy.listen()
        address = f"127.0.0.1:{busy.getsockname()[1]}"
        result = CliRunner().invoke(live, [str(tmp_path), "--listen", address], standalone_mode=False)
        assert isinstance(result.exception, InputError)
        assert str(result.exception) == f"address {address}: Address already in use"


@pytest.mark.parametrize(("host", "warned"), [("127.0.0.1", False), ("localhost", False), ("0.0.0.0", True)])
def test_the_command_says_where_it_is_warns_when_others_can_read_and_ends_with_ctrl_c(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, host: str, warned: bool
) -> None:
    async def interrupted(self: LiveServer) -> None:
        asyncio.get_running_loop().call_soon(os.kill, os.getpid(), signal.SIGINT)
        await run(self)

    run = LiveServer.run
    monkeypatch.setattr(LiveServer, "run", interrupted)
    result = CliRunner().invoke(live, [str(tmp_path), "--listen", f"{host}:0"], standalone_mode=False)
    assert (result.exception, result.return_value) == (None, 0)
    assert ("other machines can read this flight" in result.stderr) == warned
    assert "http://" in result.stderr


# Foxglove


@contextmanager
def foxglove_stream() -> Iterator[FoxgloveStream]:
    made = FoxgloveStream(("127.0.0.1", 0))
    try:
        yield made
    finally:
        made.close()


def test_foxglove_gets_a_channel_for_each_topic_and_the_records_as_they_are(flown: dict[str, Any]) -> None:
    path, _ = flown["blackout"]
    messages = [found for found in followed(path.read_bytes(), 1 << 20) if isinstance(found, Message)]
    truth = next(each for each in messages if each.topic == "plant/truth")

    async def check(made: FoxgloveStream) -> None:
        request = HTTPRequest(f"ws://127.0.0.1:{made.address[1]}/")
        client = await websocket_connect(request, subprotocols=["foxglove.sdk.v1"])
        for message in messages:
            made.take(message)
        wanted = {message.topic for message in messages}
        channels: dict[str, dict[str, Any]] = {}
        while channels.keys() < wanted:
            text = await client.read_message()
            if isinstance(text, str) and (said := orjson.loads(text))["op"] == "advertise":
                channels |= {channel["topic"]: channel for channel in said["channels"]}
        for topic, channel in channels.items():
            assert (channel["encoding"], channel["schemaEncoding"]) == ("json", "jsonschema")
            assert orjson.loads(channel["schema"]) == dict(schema_of(topic))
        subscription = {"id": 7, "channelId": channels["plant/truth"]["id"]}
        await client.write_message(orjson.dumps({"op": "subscribe", "subscriptions": [subscription]}).decode())
        data = None
        while data is None:
            made.take(truth)  # until the subscription is known
            try:
                said = await asyncio.wait_for(client.read_message(), 0.05)
            except TimeoutError:
                continue
            if isinstance(said, bytes) and said[0] == 1:  # message data: u8, u32 subscription, u64 log time, payload
                data = said
        assert int.from_bytes(data[1:5], "little") == 7
        assert int.from_bytes(data[5:13], "little") == truth.log_time_ns
        assert data[13:] == truth.data
        made.take(Message("unknown", 0, b"{}"))
        assert made.refused == 1
        client.close()
        while await client.read_message() is not None:
            pass

    with foxglove_stream() as made:
        asyncio.run(asyncio.wait_for(check(made), 20.0))


def test_a_busy_foxglove_port_is_one_line() -> None:
    with foxglove_stream() as made, pytest.raises(InputError, match=r"--foxglove 127\.0\.0\.1"):
        FoxgloveStream(made.address)


def test_without_the_sdk_the_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(InputError, match=r"pip install 'lagproof\[foxglove\]'"):
        FoxgloveStream(("127.0.0.1", 0))
