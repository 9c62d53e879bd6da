"""The flight's recorder on a disk that is full, at once or later: the flight goes on, what is missing is counted."""

from __future__ import annotations

import json
import os
import resource
import socket
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from autopilot.link.node import Record
from autopilot.link.record import encode_line, read_mcap
from autopilot.link.stream import StreamSink
from gains.table import InputError
from sitl.flight import fly_virtual
from sitl.fly import FlightOptions, fly
from sitl.recorder import FlightRecorder
from sitl.rescue import recover
from sitl.scenario import load_scenario

SHORT = replace(load_scenario("nominal"), duration_s=3.0, variants={})
NO_SPACE = "No space left on device"


@contextmanager
def disk_with_room_for(count: int) -> Iterator[None]:
    """Let the kernel refuse what would make any file longer."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (count, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.fixture(scope="module")
def flown() -> list[tuple[Record, int]]:
    """Return the records of a flight."""
    records: list[tuple[Record, int]] = []
    fly_virtual(SHORT, lambda record, at_ns: records.append((record, at_ns)))
    return records


def fed(recorder: FlightRecorder, records: list[tuple[Record, int]]) -> None:
    for record, at_ns in records:
        recorder.write(record, at_ns)


def lost_in(recorder: FlightRecorder, name: str) -> int:
    """Return how many records a file lacks, as the summary says."""
    [problem] = [p for p in recorder.problems if p.startswith(str(recorder.files[name]))]
    return int(problem.removesuffix(" lost").rpartition(" ")[2])


def rescued(recording: Path) -> int:
    target = recording.with_name("rescued.mcap")
    rescue = recover(recording, target)
    assert len(list(read_mcap(target))) == rescue.messages
    return rescue.messages


def test_a_disk_full_on_demand_ends_the_files_and_counts_and_the_rest_can_be_rescued(tmp_path, flown):
    half = len(flown) // 2
    with FlightRecorder(tmp_path, {}) as recorder:
        fed(recorder, flown[:half])
        recorder.fill_disk()
        sizes = {name: path.stat().st_size for name, path in recorder.files.items()}
        fed(recorder, flown[half:])
        assert len(recorder.kept) == sum(not r.topic.startswith("mavlink/") for r, _ in flown)
    assert {name: path.stat().st_size for name, path in recorder.files.items()} == sizes
    assert [problem.count(NO_SPACE) for problem in recorder.problems] == [1, 1]
    kept = rescued(recorder.files["mcap"])
    # what had come by then, but for the half second that waited for its chunk to be full
    in_time = sum(at_ns <= flown[half][1] - 500_000_000 for _, at_ns in flown)
    assert in_time <= kept <= half
    assert kept + lost_in(recorder, "mcap") == len(flown)


def test_a_full_disk_holds_no_memory(tmp_path, flown):
    with FlightRecorder(tmp_path, {}) as recorder:
        fed(recorder, flown[:500])
        recorder.fill_disk()
        fed(recorder, flown)
        assert recorder._mcap is not None
        assert recorder._tlog is not None
        assert recorder._mcap._file.pending == recorder._tlog._file.pending == 0
        assert recorder._mcap._unsaved == recorder._tlog._unsaved == 0


def test_a_disk_that_the_kernel_finds_full_is_no_different(tmp_path, flown):
    with disk_with_room_for(20_000), FlightRecorder(tmp_path, {}) as recorder:
        fed(recorder, flown)
    assert recorder.files["mcap"].stat().st_size == 20_000
    kept = rescued(recorder.files["mcap"])
    # the torn chunk counts as lost, and may be rescued where only its index is torn
    assert len(flown) <= kept + lost_in(recorder, "mcap") <= len(flown) + 400
    assert 0 < kept < len(flown)


@pytest.mark.parametrize("name", ["mcap", "tlog"])
def test_files_that_take_nothing_at_all_are_refused_or_counted(tmp_path, flown, name):
    (tmp_path / f"flight.{name}").symlink_to("/dev/full")
    if name == "mcap":
        with pytest.raises(InputError, match=NO_SPACE):
            FlightRecorder(tmp_path, {})
        return
    with FlightRecorder(tmp_path, {}, tlog_port="plant") as recorder:
        fed(recorder, flown)
    frames = sum(r.topic == "mavlink/plant" for r, _ in flown)
    assert lost_in(recorder, "tlog") >= frames > 0
    assert len(list(read_mcap(recorder.files["mcap"]))) == len(flown)


def test_a_file_that_cannot_be_saved_is_a_problem_and_leaves_no_part(tmp_path):
    with FlightRecorder(tmp_path, {}) as recorder:
        with disk_with_room_for(1000):
            recorder.save("plot", tmp_path / "plot.png", lambda path: path.write_bytes(bytes(2000)))
        recorder.save("summary", tmp_path / "summary.json", lambda path: path.write_bytes(b"{}"))
        recorder.fill_disk()
        recorder.save("more", tmp_path / "more", lambda path: path.write_bytes(b""))
    assert recorder.problems[-2:] == [f"{tmp_path}/plot.png: File too large", f"{tmp_path}/more: {NO_SPACE}"]
    assert sorted(recorder.files) == ["mcap", "summary", "tlog"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["flight.mcap", "flight.tlog", "summary.json"]


def test_a_flight_whose_disk_fills_up_ends_with_a_verdict_and_says_what_is_missing(tmp_path, monkeypatch):
    monkeypatch.setattr("sitl.plot.plot_flight", lambda path, _flight: path.write_bytes(bytes(30_000)))
    with disk_with_room_for(20_000):
        outcome = fly(SHORT, FlightOptions(True, tmp_path), Console(file=StringIO()))
    assert outcome.summary["samples"] == 120
    assert outcome.summary["mode_at_end"] == "TRACKING"
    told = Counter(problem.partition(":")[0] for problem in outcome.summary["problems"])
    assert told[str(tmp_path / "flight.mcap")] == told[str(tmp_path / "flight.png")] == 1
    assert "plot" not in outcome.summary["files"]
    assert not (tmp_path / "flight.png").exists()
    assert json.loads((tmp_path / "summary.json").read_bytes()) == outcome.summary


def test_a_recorder_that_stands_still_gets_ten_seconds_of_flight_later_and_what_it_cannot_get_is_counted(flown):
    """The sink alone: nobody reads for ten seconds, then for as long as its buffer takes, and then all of it."""
    lines = [encode_line(record, at_ns) for record, at_ns in flown]
    span_s = (flown[-1][1] - flown[0][1]) / 1e9
    with closing(socket.create_server(("127.0.0.1", 0))) as server:
        sink = StreamSink(server.getsockname(), "plant", {})
        accepted, _ = server.accept()
        written = 0
        while sink.lost < 1000:
            for record, at_ns in flown:
                sink.write(record, at_ns)
                sink.pump()
            written += len(flown)
            if written / len(flown) * span_s <= 10.0:
                assert sink.lost == 0
        received = bytearray()
        accepted.settimeout(10.0)
        while not sink.closed and sink._buffer:
            received += accepted.recv(1 << 20)
            sink.pump()
        sink.close()
        with closing(accepted):
            while part := accepted.recv(1 << 20):
                received += part
    found = bytes(received).splitlines(keepends=True)[1:]
    assert len(found) + sink.lost == written
    assert found[: len(lines)] == lines


@pytest.mark.long
def test_the_program_on_a_full_disk_ends_without_a_traceback(tmp_path):
    """Nothing fits: neither plot nor summary; standard output still has the summary."""
    limited = "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000));"
    limited += "from sitl.__main__ import main; sys.argv = ['sitl', *sys.argv[1:]]; main()"
    line = ["fly", "nominal", "--virtual", "--duration", "3", "--out", "out", "--json"]
    done = subprocess.run(
        [sys.executable, "-c", limited, *line],
        cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert "Traceback" not in done.stderr
    summary = json.loads(done.stdout)
    assert len(summary["problems"]) == 4
    assert sorted(summary["files"]) == ["mcap", "tlog"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["flight.mcap", "flight.tlog"]
