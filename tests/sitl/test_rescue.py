"""``sitl recover``: cut-off and damaged recordings; the standard reader of MCAP files is the judge."""

from __future__ import annotations

import contextlib
import json
import resource
import struct
import sys
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import ChunkIndex
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from autopilot.link.record import read_mcap, read_metadata
from gains.command import run
from gains.table import InputError
from sitl import mcapwalk
from sitl.commands.recover import recover_command
from sitl.flight import fly_virtual
from sitl.recorder import FlightRecorder
from sitl.rescue import Rescue, recover
from sitl.scenario import load_scenario

MB = 1 << 20
CHUNK, MESSAGE, SCHEMA, CHANNEL, ATTACHMENT, METADATA = 6, 5, 3, 4, 9, 12

Content = list[tuple[Any, ...]]


def messages_of(path: Path) -> Content:
    """Return everything of each message but the ids, as the standard reader sees it."""
    with path.open("rb") as file:
        return [
            (schema and (schema.name, schema.encoding, schema.data), channel.topic, channel.message_encoding,
             channel.metadata, m.sequence, m.log_time, m.publish_time, m.data)
            for schema, channel, m in make_reader(file, validate_crcs=True).iter_messages(log_time_order=False)
        ]  # fmt: skip


def extras_of(path: Path) -> Content:
    """Return metadata and attachments, as the standard reader finds them by its index."""
    with path.open("rb") as file:
        reader = make_reader(file)
        metadata = [(m.name, m.metadata) for m in reader.iter_metadata()]
        return metadata + [
            (a.name, a.media_type, a.create_time, a.log_time, a.data) for a in reader.iter_attachments()
        ]  # fmt: skip


def chunks_of(path: Path) -> list[ChunkIndex]:
    """Return where the chunks of a finished file are."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        return sorted(summary.chunk_indexes, key=lambda chunk: chunk.chunk_start_offset)


def messages_in(path: Path, chunk: ChunkIndex) -> int:
    """Return how many messages are in a chunk, by its message indexes."""
    counts = 0
    with path.open("rb") as file:
        for offset in chunk.message_index_offsets.values():
            file.seek(offset + 9 + 2)
            counts += struct.unpack("<I", file.read(4))[0] // 16
    return counts


def recorded(folder: Path, duration_s: float) -> Path:
    scenario = replace(load_scenario("nominal"), duration_s=duration_s)
    with FlightRecorder(folder, {"scenario": "nominal"}) as recorder:
        fly_virtual(scenario, recorder.write)
    assert recorder.problems == []
    return recorder.files["mcap"]


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the recording of a flight of two seconds."""
    return recorded(tmp_path_factory.mktemp("flight"), 2.0)


@pytest.fixture
def cut(tmp_path: Path) -> Callable[[bytes], tuple[Rescue, Path]]:
    """Return a function that rescues what is left of a file."""

    def rescue(left: bytes) -> tuple[Rescue, Path]:
        source, target = tmp_path / "cut.mcap", tmp_path / "new.mcap"
        source.write_bytes(left)
        rescue = recover(source, target, force=True)
        assert source.read_bytes() == left
        assert sorted(p.name for p in tmp_path.iterdir()) in (["cut.mcap"], ["cut.mcap", "new.mcap"])
        return rescue, target

    return rescue


# what is cut off


def check_every_cut(flight: Path, places: Iterator[int] | range, cut: Callable[[bytes], tuple[Rescue, Path]]) -> None:
    whole = flight.read_bytes()
    written = messages_of(flight)
    ends, before = [], 0
    for chunk in chunks_of(flight):
        before += messages_in(flight, chunk)
        ends.append((chunk.chunk_start_offset + chunk.chunk_length, before))
    assert before == len(written)
    for place in places:
        rescue, target = cut(whole[:place])
        sure = max([count for end, count in ends if end <= place], default=0)
        assert not rescue.complete
        assert sure <= rescue.messages <= len(written)
        if rescue.nothing:
            assert not sure
            target.unlink(missing_ok=True)
            continue
        rescued = messages_of(target)
        assert len(rescued) == rescue.messages
        assert rescued == written[: len(rescued)]
        times = [m[5] for m in rescued]
        assert (rescue.start_ns, rescue.end_ns) == (min(times), max(times))
        assert rescue.bytes_dropped <= place - max([end for end, _ in ends if end <= place], default=len(MCAP0_MAGIC))


def test_wherever_a_flight_is_cut_off_all_but_its_last_chunk_is_rescued(flight, cut):
    size = flight.stat().st_size
    edges = [c.chunk_start_offset + c.chunk_length * end for c in chunks_of(flight)[:2] for end in (0, 1)]
    places = {place + by for place in edges for by in (-1, 0, 1, 9, 41)}
    places |= set(range(0, size, size // 15)) | set(range(0, 60, 5)) | {size - by for by in (1, 9, 38)}
    check_every_cut(flight, sorted(places), cut)


@pytest.mark.long
def test_wherever_a_short_flight_is_cut_off_at_every_byte(tmp_path_factory, cut):
    path = recorded(tmp_path_factory.mktemp("short"), 0.4)
    check_every_cut(path, range(path.stat().st_size), cut)


def test_what_is_rescued_is_what_our_reader_reads_with_its_metadata(flight, cut):
    whole = flight.read_bytes()
    last = chunks_of(flight)[-1]
    rescue, target = cut(whole[: last.chunk_start_offset + last.chunk_length])
    assert list(read_mcap(target)) == list(read_mcap(flight))
    assert read_metadata(target) == {"scenario": "nominal"}
    assert (rescue.complete, rescue.torn, rescue.bytes_dropped, rescue.metadata) == (False, False, 0, 1)
    with target.open("rb") as file, flight.open("rb") as original:
        assert make_reader(file).get_header() == make_reader(original).get_header()


def test_a_complete_file_is_said_to_be_complete_and_copied_identically(flight, cut):
    rescue, target = cut(flight.read_bytes())
    assert rescue.complete
    assert rescue.messages == len(messages_of(flight))
    assert rescue.bytes_dropped == rescue.damaged_chunks == rescue.dropped_records == 0
    assert target.read_bytes() == flight.read_bytes()
    assert recover(target, target.with_name("again.mcap")).complete


def test_a_finished_file_that_goes_on_is_not_complete(flight, cut):
    rescue, target = cut(flight.read_bytes() + b"x")
    assert not rescue.complete
    assert messages_of(target) == messages_of(flight)


# all that a file may hold


@pytest.fixture(params=["chunks", "uncompressed chunks", "no chunks"])
def foreign(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a file with everything in it that ours do not have, and a last chunk of many messages."""
    path = tmp_path_factory.mktemp("foreign") / "all.mcap"
    noise = np.random.default_rng(1)
    kind = CompressionType.NONE if request.param == "uncompressed chunks" else CompressionType.ZSTD
    with path.open("wb") as out:
        writer = Writer(out, chunk_size=2000, compression=kind, use_chunking=request.param != "no chunks")
        writer.start("profile", "library")
        schemas = [writer.register_schema(f"s{i}", "raw", bytes([i] * 20)) for i in range(3)]
        plain = writer.register_channel("bare", "", 0)
        channels = [writer.register_channel(f"t{i}", "raw", s, {"unit": "rad"}) for i, s in enumerate(schemas)]
        writer.add_attachment(7, 8, "first", "text/plain", b"content" * 100)
        for number in range(300):
            # neither log times nor publish times rise
            time = 1000 + 7 * (number ^ 1)
            writer.add_message((plain, *channels)[number % 4], time, noise.bytes(40), time - 500, number % 5)
            if number % 100 == 50:
                writer.add_metadata(f"m{number}", {"n": str(number), "": "é"})
        writer.add_attachment(9, 10, "second", "", b"")
        writer.finish()
    return path


def test_schemas_channels_metadata_attachments_order_and_times_are_kept(foreign, cut):
    whole = foreign.read_bytes()
    rescue, target = cut(whole[:-1])
    assert (rescue.messages, rescue.metadata, rescue.attachments, rescue.bytes_dropped) == (300, 3, 2, 0)
    assert messages_of(target) == messages_of(foreign)
    assert extras_of(target) == extras_of(foreign)
    assert cut(whole)[0].complete


def test_a_torn_chunk_without_compression_keeps_its_whole_messages(tmp_path, cut):
    path = tmp_path / "one.mcap.source"
    with path.open("wb") as out:
        writer = Writer(out, compression=CompressionType.NONE)
        writer.start()
        channel = writer.register_channel("a", "", 0)
        for number in range(100):
            writer.add_message(channel, number, b"x" * 69, number)  # 100 bytes each
        writer.finish()
    written, [chunk] = messages_of(path), chunks_of(path)
    whole = path.read_bytes()
    path.unlink()
    end = chunk.chunk_start_offset + chunk.chunk_length
    for missing in (1, 99, 100, 101, 5000):
        rescue, target = cut(whole[: end - missing])
        assert rescue.torn
        assert messages_of(target) == written[: 100 - -(-missing // 100)]


def test_a_torn_chunk_keeps_the_whole_messages_of_the_blocks_that_decompress(tmp_path, cut):
    path = tmp_path / "one.mcap.source"
    with path.open("wb") as out:
        writer = Writer(out, chunk_size=4 * MB)
        writer.start()
        channel = writer.register_channel("a", "", 0)
        noise = np.random.default_rng(1)
        for number in range(2000):
            writer.add_message(channel, number, noise.bytes(500), number)
        writer.finish()
    written, whole, [chunk] = messages_of(path), path.read_bytes(), chunks_of(path)
    path.unlink()
    left = whole[: len(whole) // 2]
    data_start = chunk.chunk_start_offset + 9 + 32 + len("zstd") + 8
    content = zstandard.ZstdDecompressor().decompressobj().decompress(left[data_start:])
    possible = (len(content) - len(A_CHANNEL)) // (9 + 22 + 500)
    rescue, target = cut(left)
    assert rescue.messages == possible > 500
    assert messages_of(target) == written[:possible]


# what is damaged


def flipped(whole: bytes, place: int, by: int = 0x55) -> bytes:
    return whole[:place] + bytes([whole[place] ^ by]) + whole[place + 1 :]


@pytest.mark.parametrize("number", [0, 1, -1], ids=["first", "second", "last"])
def test_a_damaged_chunk_is_counted_and_skipped_and_the_rest_goes_on(flight, cut, number):
    whole, written = flight.read_bytes(), messages_of(flight)
    chunks = chunks_of(flight)
    chunk = chunks[number]
    before = sum(messages_in(flight, c) for c in chunks if c.chunk_start_offset < chunk.chunk_start_offset)
    within = messages_in(flight, chunk)
    for place in (chunk.chunk_start_offset + 60, chunk.chunk_start_offset + chunk.chunk_length - 20):
        rescue, target = cut(flipped(whole, place))
        assert (rescue.complete, rescue.damaged_chunks, rescue.bytes_dropped) == (False, 1, chunk.chunk_length)
        assert messages_of(target) == written[:before] + written[before + within :]


def test_messages_that_nothing_describes_are_counted(flight, cut):
    """The schemas were in the damaged first chunk, and a file that was cut off has no summary that repeats them."""
    whole, chunks = flight.read_bytes(), chunks_of(flight)
    last = chunks[-1].chunk_start_offset + chunks[-1].chunk_length
    rescue, _ = cut(flipped(whole, chunks[0].chunk_start_offset + 60)[:last])
    assert rescue.damaged_chunks == 1
    assert rescue.messages + rescue.dropped_messages == len(messages_of(flight)) - messages_in(flight, chunks[0])
    assert rescue.dropped_messages > 0


def test_a_wrong_size_in_a_chunk_is_damage(flight, cut):
    chunk = chunks_of(flight)[1]
    size_at = chunk.chunk_start_offset + 9 + 16
    for claimed in (0, 1, chunk.uncompressed_size - 1, chunk.uncompressed_size + 1, 1 << 62):
        whole = bytearray(flight.read_bytes())
        whole[size_at : size_at + 8] = claimed.to_bytes(8, "little")
        assert cut(bytes(whole))[0].damaged_chunks == 1


def test_a_statistic_that_counts_other_messages_makes_a_file_incomplete(flight, cut):
    """A chunk whose kind is damaged looks like a record of a kind that does not exist yet."""
    chunk = chunks_of(flight)[1]
    rescue, target = cut(flipped(flight.read_bytes(), chunk.chunk_start_offset, 0x80))
    assert not rescue.complete
    assert len(messages_of(target)) == rescue.messages == len(messages_of(flight)) - messages_in(flight, chunk)


# what is hostile


def record(opcode: int, content: bytes, length: int | None = None) -> bytes:
    return struct.pack("<BQ", opcode, len(content) if length is None else length) + content


def chunk(data: bytes, size: int, compression: bytes = b"zstd", length: int | None = None, crc: int = 0) -> bytes:
    head = struct.pack("<QQQII", 0, 0, size, crc, len(compression)) + compression
    return record(CHUNK, head + struct.pack("<Q", len(data) if length is None else length) + data)


def text(value: bytes) -> bytes:
    return struct.pack("<I", len(value)) + value


HEADER = MCAP0_MAGIC + record(1, text(b"") + text(b""))
A_CHANNEL = record(CHANNEL, struct.pack("<HH", 1, 0) + text(b"a") + text(b"") + text(b""))
A_MESSAGE = record(MESSAGE, struct.pack("<HIQQ", 1, 0, 5, 5) + b"data")
GOOD = HEADER + A_CHANNEL + A_MESSAGE
HUGE = (1 << 64) - 1


@pytest.mark.parametrize(
    "tail",
    [
        *(record(opcode, bytes(100), HUGE) for opcode in (*range(17), 0x7F, 0x80, 0xFF)),
        record(CHUNK, struct.pack("<QQQII", 0, 0, HUGE, 0, (1 << 32) - 1)),
        chunk(zstandard.compress(bytes(1000)), HUGE),
        chunk(b"", 0, length=HUGE),
        chunk(zstandard.compress(b""), 0),
        chunk(b"no zstd", 100),
        chunk(b"??", 2, b"lz9"),
        chunk(record(MESSAGE, b"", HUGE), 9, b""),
        chunk(record(MESSAGE, b"short"), 14, b""),
        chunk(record(ATTACHMENT, b""), 9, b""),
        record(MESSAGE, b""),
        record(MESSAGE, struct.pack("<HIQQ", 9, 0, 5, 5)),
        record(SCHEMA, struct.pack("<HI", 3, (1 << 32) - 1)),
        record(SCHEMA, struct.pack("<H", 0) + text(b"") * 3),
        record(CHANNEL, struct.pack("<HH", 2, 77) + text(b"") * 3),
        record(CHANNEL, struct.pack("<HH", 2, 0) + text(b"\xff\xfe") * 3),
        record(CHANNEL, struct.pack("<HH", 1, 0) + text(b"another") + text(b"") * 2),
        record(CHANNEL, struct.pack("<HH", 2, 0) + text(b"") * 2 + struct.pack("<I", (1 << 32) - 1)),
        record(METADATA, text(b"") + struct.pack("<I", (1 << 32) - 1)),
        record(METADATA, b"\xff" * 8),
        record(ATTACHMENT, bytes(16) + text(b"") * 2 + struct.pack("<Q", HUGE)),
        record(ATTACHMENT, bytes(16) + text(b"") * 2 + struct.pack("<QI", 0, 12345)),
        record(ATTACHMENT, b""),
    ],
)
def test_lengths_that_lie_and_content_that_is_none_cost_no_more_than_themselves(cut, tail):
    rescue, target = cut(GOOD + tail)
    assert rescue.messages == 1
    assert [m[-1] for m in messages_of(target)] == [b"data"]
    assert not rescue.complete
    assert rescue.bytes_dropped in (0, len(tail))
    if tail[0] not in (1, 2, 7, 8, 10, 11, 13, 14, 15):  # indexes are made anew, and after DataEnd nothing is looked at
        assert rescue.bytes_dropped == len(tail) or tail[0] == CHUNK


def test_a_bomb_costs_no_memory(cut, monkeypatch):
    monkeypatch.setattr(mcapwalk, "MAX_RECORD_BYTES", MB)
    bomb = zstandard.compress(bytes(256 * MB))
    tracemalloc.start()
    try:
        for size in (256 * MB, 1000, HUGE):
            rescue, _ = cut(GOOD + chunk(bomb, size) + A_MESSAGE)
            assert (rescue.messages, rescue.damaged_chunks) == (2, 1)
        rescue, _ = cut(GOOD + chunk(bomb, 1000)[:-1])  # and a torn one
        assert rescue.messages == 1
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 8 * MB


def test_endless_definitions_metadata_and_index_entries_have_bounds(cut, monkeypatch):
    monkeypatch.setattr("sitl.rescue.MAX_DEFINITIONS", 10)
    monkeypatch.setattr("sitl.rescue.MAX_EXTRAS", 10)
    channels = [record(CHANNEL, struct.pack("<HH", i, 0) + text(b"a") + text(b"") * 2) for i in range(2, 100)]
    metadata = [record(METADATA, text(b"") * 2)] * 100
    rescue, _ = cut(GOOD + b"".join(channels + metadata) + A_MESSAGE)
    assert (rescue.messages, rescue.metadata, rescue.dropped_records) == (2, 10, 98 - 9 + 90)
    monkeypatch.setattr("sitl.rescue.MAX_INDEX_ENTRIES", 6)
    monkeypatch.setattr("sitl.rescue.CHUNK_BYTES", 1)
    rescue, target = cut(GOOD + A_MESSAGE * 9)
    assert (rescue.messages, rescue.bytes_dropped) == (3, 7 * len(A_MESSAGE))
    assert len(messages_of(target)) == 3


def test_records_too_long_are_dropped_and_counted(cut, monkeypatch):
    monkeypatch.setattr(mcapwalk, "MAX_RECORD_BYTES", 1000)
    long = record(MESSAGE, struct.pack("<HIQQ", 1, 0, 5, 5) + bytes(1000))
    packed = zstandard.compress(A_MESSAGE * 100)
    rescue, _ = cut(GOOD + long + A_MESSAGE + chunk(packed, len(A_MESSAGE) * 100) + A_MESSAGE)
    assert (rescue.messages, rescue.dropped_records, rescue.damaged_chunks) == (3, 1, 1)
    assert not rescue.torn


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Return a finished file of ours, of some kilobytes."""
    path = tmp_path_factory.mktemp("small") / "small.mcap"
    with path.open("wb") as out:
        writer = Writer(out, chunk_size=300)
        writer.start("lagproof", "lagproof")
        writer.add_metadata("flight", {"seed": "1"})
        channel = writer.register_channel("events", "json", writer.register_schema("events", "jsonschema", b"{}"))
        for number in range(60):
            writer.add_message(channel, number, b'{"number":%d}' % number, number)
        writer.finish()
    return path.read_bytes()


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_no_damage_raises_and_what_is_rescued_can_be_read(small, cut, data):
    left = bytearray(small[: data.draw(st.integers(0, len(small)) | st.just(len(small)))])
    for _ in range(data.draw(st.integers(0, 4)) if left else 0):
        left[data.draw(st.integers(0, len(left) - 1))] = data.draw(st.integers(0, 255))
    # where the magic is damaged it is no MCAP file
    with contextlib.suppress(InputError):
        rescue, target = cut(bytes(left))
        if not rescue.nothing:
            read = messages_of(target) if not rescue.complete else []
            assert rescue.complete or len(read) == rescue.messages
        target.unlink(missing_ok=True)


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(garbage=st.binary(max_size=300), whole=st.booleans())
def test_garbage_after_the_magic_raises_nothing(cut, garbage, whole):
    rescue, target = cut((GOOD if whole else MCAP0_MAGIC) + garbage)
    assert rescue.messages >= whole
    target.unlink(missing_ok=True)


# the command


def call(*arguments: object, monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(sys, "argv", ["sitl", *map(str, arguments)])
    with pytest.raises(SystemExit) as exit_:
        run(recover_command, "sitl")
    return int(exit_.value.code or 0)


@pytest.fixture
def torn(flight: Path, tmp_path: Path) -> Path:
    path = tmp_path / "flight.mcap"
    path.write_bytes(flight.read_bytes()[:-1000])
    return path


def test_the_new_file_is_beside_the_old_one_and_the_command_says_what_is_in_it(torn, monkeypatch, capsys):
    assert call(torn, monkeypatch=monkeypatch) == 0
    target = torn.with_name("flight.recovered.mcap")
    held = messages_of(target)
    span = (max(m[5] for m in held) - min(m[5] for m in held)) / 1e9
    out = capsys.readouterr().out
    assert out.startswith(f"rescued {len(held)} messages, {span:.3f} s from {torn} to {target}\n")
    assert f"of {torn.stat().st_size} bytes dropped" in out


def test_a_complete_file_is_told_to_be_so(flight, tmp_path, monkeypatch, capsys):
    assert call(flight, "-o", tmp_path / "copy.mcap", monkeypatch=monkeypatch) == 0
    assert f"{flight} is complete: {len(messages_of(flight))} messages" in capsys.readouterr().out


def test_json_has_every_number(torn, monkeypatch, capsys):
    assert call(torn, "--json", monkeypatch=monkeypatch) == 0
    told = json.loads(capsys.readouterr().out)
    target = torn.with_name("flight.recovered.mcap")
    assert told["file"] == str(target)
    assert (told["complete"], told["messages"]) == (False, len(messages_of(target)))
    assert told["bytes_read"] == torn.stat().st_size
    assert told["seconds"] == pytest.approx((told["end_ns"] - told["start_ns"]) / 1e9)


@pytest.mark.parametrize("left", [0, 5, 8, 30, 200])
def test_nothing_to_rescue_is_one_line_and_exit_1_and_no_file(torn, monkeypatch, capsys, left):
    torn.write_bytes(torn.read_bytes()[:left])
    assert call(torn, monkeypatch=monkeypatch) == 1
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert err == f"sitl: error: {torn}: nothing to rescue in its {left} bytes\n"
    assert list(torn.parent.iterdir()) == [torn]
    assert call(torn, "--json", monkeypatch=monkeypatch) == 1
    assert json.loads(capsys.readouterr().out)["file"] is None


def linked(link: Callable[[Path, Path], None]) -> Callable[[Path], list[object]]:
    def make(torn: Path) -> list[object]:
        link(torn, torn.with_name("link.mcap"))
        return [torn, "-o", torn.with_name("link.mcap"), "--force"]

    return make


REFUSED: dict[str, tuple[Callable[[Path], list[object]], str]] = {
    "missing": (lambda torn: [torn.with_name("none.mcap")], "No such file"),
    "a folder": (lambda torn: [torn.parent], "expected a regular file"),
    "a device": (lambda torn: ["/dev/zero"], "expected a regular file"),
    "another format": (lambda torn: [__file__], "expected an MCAP file"),
    "no folder for it": (lambda torn: [torn, "-o", torn.parent / "none" / "x.mcap"], "expected a folder"),
    "a folder as target": (lambda torn: [torn, "-o", torn.parent, "--force"], "can be written"),
    "onto itself": (lambda torn: [torn, "-o", torn, "--force"], "another file than the recording"),
    "onto itself by a link": (linked(lambda a, b: b.symlink_to(a)), "another file than the recording"),
    "onto itself by a hard link": (linked(lambda a, b: b.hardlink_to(a)), "another file than the recording"),
    "no option": (lambda torn: [torn, "--nonsense"], "--nonsense"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_bad_input_is_one_line_and_exit_2(torn, monkeypatch, capsys, case):
    arguments, why = REFUSED[case]
    before = torn.read_bytes()
    assert call(*arguments(torn), monkeypatch=monkeypatch) == 2
    err = capsys.readouterr().err
    assert why in err
    assert err.count("\n") == 1
    assert torn.read_bytes() == before


def test_an_existing_file_is_replaced_by_force_only(torn, monkeypatch, capsys):
    target = torn.with_name("flight.recovered.mcap")
    target.write_bytes(b"precious")
    assert call(torn, monkeypatch=monkeypatch) == 2
    assert "--force replaces it" in capsys.readouterr().err
    assert target.read_bytes() == b"precious"
    assert call(torn, "--force", monkeypatch=monkeypatch) == 0
    assert len(messages_of(target)) > 0
    torn.write_bytes(MCAP0_MAGIC)
    assert call(torn, "--force", monkeypatch=monkeypatch) == 1
    assert len(messages_of(target)) > 0  # nothing is no reason to lose something


def test_a_disk_that_fills_up_during_the_rescue_leaves_no_part_of_a_file(torn, monkeypatch, capsys):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (5000, hard))  # the kernel refuses what lies beyond
    try:
        code = call(torn, monkeypatch=monkeypatch)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert code == 2
    assert capsys.readouterr().err == "sitl: error: File too large\n"
    assert list(torn.parent.iterdir()) == [torn]


def test_the_standard_reader_refuses_what_has_not_been_rescued(torn):
    with torn.open("rb") as file, pytest.raises(McapError):
        make_reader(file).get_summary()
