import contextlib
import json
import os
import resource
import signal
import struct
import subprocess
import sys
import textwrap
from collections import Counter
from io import FileIO
from pathlib import Path
from types import MappingProxyType
from typing import Any

import jsonschema
import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from pymavlink.dialects.v20 import ardupilotmega as dialect

from autopilot.link.node import Record
from autopilot.link.record import (
    MAX_LINE_BYTES,
    MAX_TOPICS,
    SCHEMAS,
    McapRecorder,
    TlogWriter,
    decode_line,
    encode_line,
    frame_record,
    is_topic,
    read_mcap,
    read_metadata,
    schema_of,
)

PERIOD_NS = 25_000_000
JSON_TYPES: dict[str, type | tuple[type, ...]] = {
    "integer": int,
    "number": (int, float),
    "string": str,
    "boolean": bool,
    "array": list,
    "object": dict,
}


def sample_records(k: int) -> list[Record]:
    """Return about what one sample of a flight at 40 Hz records: 16 messages."""
    t_ns = k * PERIOD_NS
    x = [0.01 * k, np.sin(k), -0.3]
    known = k >= 2
    truth = {
        "k": k,
        "t_ns": t_ns,
        "late_ns": 1234 * k % 1000,
        "x": x,
        "u": [0.0345678],
        "j": k - 2 if known else None,
        "d": 2 if known else None,
        "w": [0.1, 0.0, 0.2],
        "delta": 0.0,
        "timeout": False,
    }
    command = {
        "j": k,
        "sample_ns": t_ns,
        "epoch": 0,
        "x": x,
        "xr": [0.0, 0.1] if known else None,
        "r": [0.0] if known else None,
        "u": [0.0345678],
        "saturated": False,
        "d": 2 if known else None,
        "d_low": 1 if known else None,
        "d_high": 3 if known else None,
        "d_probability": 0.97 if known else None,
        "status": "ok" if known else "unknown",
        "mode": "TRACKING",
        "flight_mode": "AUTO",
        "armed": True,
        "gain_set": 0,
        "alpha": "aoa_ssa",
    }
    packet = {
        "sent_ns": t_ns,
        "delivered_ns": t_ns + 9_000_000,
        "number": 1,
        "size": 44,
        "fate": "delivered",
        "copy": 0,
    }
    lost = {**packet, "delivered_ns": None, "fate": "lost"}
    frames = [frame_record("plant", t_ns + i, "received", bytes([0xFD, i, k % 256] * 15)) for i in range(10)]
    return [
        Record("plant/truth", t_ns, truth),
        Record("autopilot/command", t_ns, command),
        Record("link/up", t_ns, packet),
        Record("link/down", t_ns, lost if k % 7 == 0 else packet),
        *frames,
        Record("events", t_ns, {"kind": "mode", "node": "autopilot", "text": "TRACKING", "data": {"k": k}}),
        frame_record("gcs0", t_ns, "sent", b"\xfd" * 30),
    ]


def write_flight(path: Path, samples: int) -> list[tuple[str, int, dict[str, object]]]:
    written = []
    with McapRecorder(path, {"scenario": "nominal", "seed": "1"}) as recorder:
        for k in range(samples):
            for record in sample_records(k):
                recorder.write(record, k * PERIOD_NS)
                written.append((record.topic, k * PERIOD_NS, dict(record.body)))
        assert recorder.error == ""
    assert recorder.lost == recorder.refused == 0
    return written


def salvage(path: Path) -> list[Message]:
    """Return what a cut-off file still holds."""
    messages = []
    # a cut inside a record's head, its data, its compressed data
    cuts = contextlib.suppress(EndOfFile, struct.error, zstandard.ZstdError)
    with path.open("rb") as file, cuts:
        for message in StreamReader(file).records:
            if isinstance(message, Message):
                messages.append(message)
    return messages


# --- schemas


@pytest.mark.parametrize("topic", [*SCHEMAS, "mavlink/plant"])
def test_schemas_are_valid_and_describe_every_field(topic: str) -> None:
    schema = dict(schema_of(topic))
    jsonschema.Draft202012Validator.check_schema(schema)
    nullable = {name: field for part in schema.get("allOf", ()) for name, field in part["properties"].items()}
    assert {*schema["properties"], *nullable} == set(schema["required"])
    for field in [*schema["properties"].values(), *nullable.values()]:
        assert field["description"].endswith(".")
    # what viewers of MCAP files parse: one type per field, the fields of every object, the items of every array
    for field in schema["properties"].values():
        assert isinstance(field["type"], str)
        assert ("items" in field) == (field["type"] == "array")
        assert ("properties" in field) == (field["type"] == "object")


@pytest.mark.parametrize("k", [0, 5])
def test_messages_of_a_flight_keep_to_their_schemas(k: int) -> None:
    for record in sample_records(k):
        schema = dict(schema_of(record.topic))
        jsonschema.validate(dict(record.body), schema, jsonschema.Draft202012Validator)
        wrong = dict(record.body) | {name: object() for name in schema["required"][:1]}
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(wrong, schema, jsonschema.Draft202012Validator)


@pytest.mark.parametrize(
    "topic", ["", "plant", "mavlink/", "mavlink/A b", "mavlink/" + "a" * 33, "events/x", "mavlink/a\n"]
)
def test_other_topics_are_unknown(topic: str) -> None:
    assert not is_topic(topic)
    with pytest.raises(ValueError, match="unknown topic"):
        schema_of(topic)


# --- MCAP


def test_every_message_reads_back_equal_with_its_schema(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    written = write_flight(path, 100)
    with path.open("rb") as file:
        reader = make_reader(file)
        assert [dict(m.metadata) for m in reader.iter_metadata()] == [{"scenario": "nominal", "seed": "1"}]
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == len(written)
        read = []
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            assert json.loads(schema.data) == dict(schema_of(channel.topic))
            read.append((channel.topic, message.log_time, json.loads(message.data)))
    assert read == written
    assert list(read_mcap(path)) == written
    assert read_metadata(path) == {"scenario": "nominal", "seed": "1"}


def test_arrays_and_read_only_mappings_are_recorded_as_plain_json(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    arrays = {"x": np.array([0.1, 0.2]), "u": np.array([[1.0, 9.0], [2.0, 9.0]])[:, 0], "k": np.int64(3)}
    record = Record("plant/truth", 0, MappingProxyType(arrays))
    with McapRecorder(path, {}) as recorder:
        recorder.write(record, 5)
    plain = {"x": [0.1, 0.2], "u": [1.0, 2.0], "k": 3}
    assert list(read_mcap(path)) == [("plant/truth", 5, plain)]
    assert decode_line(encode_line(record, 5)) == (Record("plant/truth", 0, plain), 5)
    with pytest.raises(TypeError):
        encode_line(Record("events", 0, {"data": object()}), 0)


def test_equal_records_make_equal_bytes(tmp_path: Path) -> None:
    write_flight(tmp_path / "a.mcap", 60)
    write_flight(tmp_path / "b.mcap", 60)
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_an_empty_recording_is_a_valid_file(tmp_path: Path) -> None:
    path = tmp_path / "empty.mcap"
    recorder = McapRecorder(path, {})
    recorder.close()
    recorder.close()
    assert list(read_mcap(path)) == []


def test_topics_beyond_the_bound_are_refused_and_counted(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    with McapRecorder(path, {}) as recorder:
        for i in range(MAX_TOPICS + 3):
            recorder.write(frame_record(f"p{i}", 0, "sent", b""), 0)
    assert recorder.refused == 3
    assert len(list(read_mcap(path))) == MAX_TOPICS


def test_an_unknown_topic_is_an_error_of_the_caller(tmp_path: Path) -> None:
    with McapRecorder(tmp_path / "flight.mcap", {}) as recorder, pytest.raises(ValueError, match="unknown"):
        recorder.write(Record("nonsense", 0, {}), 0)


KILLED = """
    import os, runpy, signal, sys
    from pathlib import Path
    from autopilot.link.record import McapRecorder
    here = runpy.run_path(sys.argv[1])
    recorder = McapRecorder(Path(sys.argv[2]), {})
    chosen = slice(None) if sys.argv[3] == "all" else slice(0, 1)
    for k in range(400):
        for record in here["sample_records"](k)[chosen]:
            recorder.write(record, k * here["PERIOD_NS"])
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize(("which", "per_sample"), [("all", 16), ("one", 1)])
def test_a_killed_process_loses_less_than_a_second(tmp_path: Path, which: str, per_sample: int) -> None:
    path = tmp_path / "flight.mcap"
    command = [sys.executable, "-c", textwrap.dedent(KILLED), __file__, str(path), which]
    assert subprocess.run(command, check=False, timeout=60).returncode == -signal.SIGKILL
    kept = salvage(path)
    written = 400 * per_sample
    assert written - 40 * per_sample < len(kept) <= written
    order = Counter(message.log_time for message in kept)
    assert list(order) == [k * PERIOD_NS for k in range(len(order))]
    assert all(count == per_sample for count in list(order.values())[:-1])


def test_each_chunk_is_one_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = []

    class CountingFile(FileIO):
        def write(self, data: Any) -> int:
            sizes.append(len(data))
            return super().write(data)

    monkeypatch.setattr("autopilot.link.record.FileIO", CountingFile)
    path = tmp_path / "flight.mcap"
    write_flight(path, 200)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        assert summary.statistics is not None
        chunks = summary.statistics.chunk_count
    assert chunks > 20
    assert chunks <= len(sizes) <= chunks + 2
    assert 0 not in sizes
    assert sum(sizes) == path.stat().st_size


def test_a_full_disk_ends_the_recording_and_is_counted(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    recorder = McapRecorder(path, {})
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))  # the kernel refuses what lies beyond
    try:
        for k in range(200):
            for record in sample_records(k):
                recorder.write(record, k * PERIOD_NS)
        recorder.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert str(path) in recorder.error
    kept = salvage(path)
    assert len(kept) > 0
    # of the torn chunk, all counts as lost; a reader may still find its messages where only its index is torn
    assert 200 * 16 <= len(kept) + recorder.lost <= 200 * 16 + 200


@pytest.mark.parametrize("failing", range(1, 12))
def test_messages_are_saved_or_counted_wherever_the_disk_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: int
) -> None:
    class FailingFile(FileIO):
        writes = 0

        def write(self, data: Any) -> int:
            FailingFile.writes += 1
            if FailingFile.writes > failing:
                raise OSError(28, "No space left on device")
            return super().write(data)

    monkeypatch.setattr("autopilot.link.record.FileIO", FailingFile)
    path = tmp_path / "flight.mcap"
    recorder = McapRecorder(path, {})
    for k in range(60):
        for record in sample_records(k):
            recorder.write(record, k * PERIOD_NS)
        recorder.write(frame_record(f"late{k}", 0, "sent", b"a"), k * PERIOD_NS)
    recorder.close()
    assert "No space left on device" in recorder.error
    assert len(salvage(path)) + recorder.lost + recorder.refused == 60 * 17


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full")
def test_a_file_that_takes_no_header_is_refused_at_the_start() -> None:
    with pytest.raises(OSError, match=r"/dev/full: No space left on device"):
        McapRecorder("/dev/full", {"scenario": "nominal"})


def test_a_missing_folder_is_refused_at_the_start(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        McapRecorder(tmp_path / "none" / "flight.mcap", {})


# --- tlog


def attitude_frames(count: int) -> list[bytes]:
    mav = dialect.MAVLink(None, srcSystem=1, srcComponent=25)
    return [
        mav.attitude_encode(25 * k, 0.0, 0.001 * k, 0.0, 0.0, 0.02, 0.0).pack(mav, force_mavlink1=False)
        for k in range(count)
    ]


def test_mavlogdump_reads_the_tlog(tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    frames = attitude_frames(150)
    start_us = 1_700_000_000_000_000
    with TlogWriter(path) as log:
        for k, frame in enumerate(frames):
            log.write(frame, start_us + 25_000 * k)
    assert (log.lost, log.error) == (0, "")
    command = [sys.executable, "-m", "pymavlink.tools.mavlogdump", "--format", "json", str(path)]
    dump = subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout
    lines = [json.loads(line) for line in dump.splitlines() if line.startswith("{")]
    assert [line["meta"]["type"] for line in lines] == ["ATTITUDE"] * 150
    assert [line["data"]["time_boot_ms"] for line in lines] == [25 * k for k in range(150)]
    times = [line["meta"]["timestamp"] for line in lines]
    assert times == pytest.approx([1.7e9 + 0.025 * k for k in range(150)], abs=1e-4)


def test_a_tlog_reaches_the_file_every_64_frames(tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    log = TlogWriter(path)
    (frame,) = attitude_frames(1)
    for k in range(130):
        log.write(frame, k)
        assert path.stat().st_size == (k + 1) // 64 * 64 * (8 + len(frame))
    log.close()
    log.close()
    assert path.stat().st_size == 130 * (8 + len(frame))


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full")
def test_a_full_disk_ends_the_tlog_and_is_counted() -> None:
    with TlogWriter("/dev/full") as log:
        for k in range(100):
            log.write(b"frame", k)
    assert log.lost == 100
    assert log.error == "/dev/full: No space left on device"


def test_a_tlog_of_few_frames_reaches_the_file_within_half_a_second(tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    (frame,) = attitude_frames(1)
    with TlogWriter(path) as log:
        for k in range(40):
            log.write(frame, 7_000_000 + 100_000 * k)  # ten per second
            assert path.stat().st_size == (k + 1) // 6 * 6 * (8 + len(frame))


@pytest.mark.parametrize("kind", ["mcap", "tlog"])
def test_a_disk_filled_on_demand_takes_nothing_more(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"flight.{kind}"
    recorder: McapRecorder | TlogWriter = McapRecorder(path, {}) if kind == "mcap" else TlogWriter(path)
    for filled in (False, True):
        for k in range(100):
            if isinstance(recorder, McapRecorder):
                recorder.write(sample_records(k)[0], k * PERIOD_NS)
            else:
                recorder.write(b"frame", k)
        if not filled:
            recorder.fill_disk()
            size = path.stat().st_size
    recorder.close()
    assert path.stat().st_size == size > 0
    assert recorder.error == f"{path}: No space left on device"
    saved = len(salvage(path)) if kind == "mcap" else size // len(b"12345678frame")
    assert saved + recorder.lost == 200


# --- lines

json_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(st.characters(exclude_categories=["Cs"])),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text("abc\n é", max_size=3), inner),
    max_leaves=8,
)
topics = st.sampled_from(sorted(SCHEMAS)) | st.from_regex(r"mavlink/[a-z0-9_-]{1,32}", fullmatch=True)
times = st.integers(-(2**63), 2**63 - 1)


@given(
    topics,
    times,
    st.integers(0, 2**63 - 1),
    st.dictionaries(st.text("kxj", max_size=4), json_values, max_size=4),
)
def test_lines_round_trip(topic: str, t_ns: int, log_time_ns: int, body: dict[str, object]) -> None:
    record = Record(topic, t_ns, body)
    line = encode_line(record, log_time_ns)
    assert line.endswith(b"\n")
    assert line.count(b"\n") == 1
    assert decode_line(line) == (record, log_time_ns)
    assert decode_line(line.rstrip(b"\n")) == (record, log_time_ns)


@given(st.binary() | json_values.map(lambda value: json.dumps(value).encode()))
def test_foreign_lines_raise_value_error_only(line: bytes) -> None:
    with pytest.raises(ValueError, match=r".+"):
        decode_line(line)


@given(st.data())
def test_damaged_lines_raise_value_error_only(data: st.DataObject) -> None:
    line = bytearray(encode_line(sample_records(3)[0], 7))
    for _ in range(data.draw(st.integers(1, 3))):
        line[data.draw(st.integers(0, len(line) - 1))] = data.draw(st.integers(0, 255))
    with contextlib.suppress(ValueError):
        decode_line(bytes(line))


GOOD = {"topic": "events", "t_ns": 1, "log_time_ns": 2, "body": {}}


@pytest.mark.parametrize(
    "change",
    [
        {"topic": "other"},
        {"topic": 1},
        {"topic": ["events"]},
        {"t_ns": 1.0},
        {"t_ns": True},
        {"t_ns": None},
        {"t_ns": 2**63},
        {"log_time_ns": -1},
        {"log_time_ns": "2"},
        {"log_time_ns": 2**64},
        {"body": []},
        {"body": None},
        {"more": 1},
    ],
)
def test_malformed_lines_are_refused(change: dict[str, object]) -> None:
    assert decode_line(json.dumps(GOOD).encode()) == (Record("events", 1, {}), 2)
    with pytest.raises(ValueError, match=r".+"):
        decode_line(json.dumps({**GOOD, **change}).encode())


@pytest.mark.parametrize("missing", sorted(GOOD))
def test_incomplete_lines_are_refused(missing: str) -> None:
    with pytest.raises(ValueError, match="keys"):
        decode_line(json.dumps({k: v for k, v in GOOD.items() if k != missing}).encode())


@pytest.mark.parametrize("line", [b"", b"\n", b"{", b'{"a":' * 5000, b"\xff" * 9, b" " * (MAX_LINE_BYTES + 1)])
def test_lines_that_are_no_json_are_refused(line: bytes) -> None:
    with pytest.raises(ValueError, match=r".+"):
        decode_line(line)


def test_the_largest_datagram_fits_a_line() -> None:
    record = frame_record("plant", 2**62, "received", bytes(65_507))
    assert decode_line(encode_line(record, 2**62)) == (record, 2**62)


def test_a_record_too_long_for_a_line_is_refused() -> None:
    with pytest.raises(ValueError, match="at most"):
        encode_line(Record("events", 0, {"text": "a" * MAX_LINE_BYTES}), 0)
