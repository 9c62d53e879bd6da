"""Reads recorded links: CSV, flight recordings (MCAP), and the output of ``ping`` and ``irtt``.

What a file holds is told from its content. ``FILE#up`` and ``FILE#down`` choose a direction where it holds both.

=====================  ============================================================================================
CSV with a header      ``delay_ms``, or ``up_ms,down_ms``; an empty entry or ``lost`` is a loss. With ``t_s`` too, the
                       time of each entry, packets meet it by time, else by number.
flight recording       what the relay recorded of ``link/up`` and ``link/down``, by time. Both directions keep their
                       common time. Duplicates and what a gate swallowed are left out.
``ping``               half of each round trip, by time: Linux, macOS, BusyBox. A number without a reply is a loss. The
                       stamps of ``ping -D`` tell the interval, which without them is taken for 1 s.
``irtt client -o``     by time; ``.json`` or ``.json.gz``. With a direction the one-way delay, for which both ends need
                       one clock; without one half of the round trip.
=====================  ============================================================================================

References
----------
irtt-client(1), "Output", json_format 1; ping(8) of iputils.
"""

from __future__ import annotations

import gzip
import math
import os
import re
import zlib
from collections.abc import Sequence
from io import BytesIO
from typing import Any, NamedTuple

import orjson

from autopilot.link.clock import NS_PER_MS, NS_PER_S
from gains.table import MAX_FILE_BYTES, InputError, read_content
from sitl.link.traces import MAX_ENTRIES, Trace

__all__ = ["MAX_DELAY_NS", "MAX_RECORDING_BYTES", "load_table", "load_trace"]

MAX_DELAY_NS = 1000 * NS_PER_S
"""The longest delay of an entry."""

MAX_RECORDING_BYTES = 2**30
"""Of a flight recording, which is read piece by piece; other files have ``MAX_FILE_BYTES`` at most, also unpacked."""

WAYS = ("up", "down")

_MAX_TIME_S = 1e10
"""Times may count from 1970."""
_MAX_DELAY_MS = MAX_DELAY_NS // NS_PER_MS
_MCAP_MAGIC = b"\x89MCAP0\r\n"
_GZIP_MAGIC = b"\x1f\x8b"
_PING_INTERVAL_NS = NS_PER_S
_PING_MODULUS = 1 << 16
"""``icmp_seq`` wraps there."""
_PING_REPLY = re.compile(
    r"(?:\[(?P<stamp>\d{1,12}\.\d{1,9})\] )?\d+ bytes from .{1,300}?[: ](?:icmp_)?seq=(?P<number>\d{1,5}) .{0,100}?"
    r"\btime=(?P<ms>\d{1,9}(?:\.\d{1,9})?) ?ms(?P<rest>.*)"
)
_PING_SENT = re.compile(r"(\d{1,9}) packets transmitted")
_DELAY = f"expected a delay from 0 to {_MAX_DELAY_MS} ms"


class _Refused(ValueError):
    """What is wrong with a line, whose place is put before it."""


def load_trace(source: str) -> Trace:
    """Return the trace of a file, ``FILE`` or ``FILE#up`` or ``FILE#down``.

    Raises
    ------
    InputError
        When there is no such file, or it holds no trace, or an entry is out of range, in one line.
    """
    path, way = _split(source)
    if _is_recording(path):
        return _from_recording(source, path, way)
    text = _text(path, "a trace")
    if text.lstrip().startswith("{"):
        return _from_irtt(source, path, way, text)
    if text.startswith("PING ") or " bytes from " in text:
        return _from_ping(source, path, way, text)
    return _from_csv(source, path, way, text)


def load_table(path: str) -> tuple[int, ...]:
    """Return the delays of a file, ns, ascending: at least two.

    The file holds one delay in ms per line, after a header ``delay_ms`` or without one.

    Raises
    ------
    InputError
        When there is no such file, or it holds fewer, or anything else, in one line.
    """
    lines = _text(path, "a table of delays").splitlines()
    header = bool(lines) and lines[0].strip() == "delay_ms"
    entries = [(n, text) for n, text in enumerate(map(str.strip, lines), 1) if text and not (header and n == 1)]
    if not 2 <= len(entries) <= MAX_ENTRIES:
        raise InputError(f"{path}: expected 2 to {MAX_ENTRIES} delays, found {len(entries)}")
    delays_ns: list[int] = []
    for n, text in entries:
        try:
            delays_ns.append(_delay_ns(text, f"delay_ms: {_DELAY}"))
        except _Refused as error:
            raise InputError(f"{path}: line {n}: {error}") from None
    return tuple(sorted(delays_ns))


# Files


def _split(source: str) -> tuple[str, str | None]:
    """Return the file and the direction; a ``#`` before anything else belongs to the name."""
    path, _, way = source.rpartition("#")
    return (path, way) if path and way in WAYS else (source, None)


def _is_recording(path: str) -> bool:
    try:
        with open(path, "rb") as file:
            return file.read(len(_MCAP_MAGIC)) == _MCAP_MAGIC
    except (OSError, ValueError):
        return False  # read_content says what is wrong


def _text(path: str, what: str) -> str:
    """Return the content of a file, unpacked."""
    content = read_content(path, what)
    if content.startswith(_GZIP_MAGIC):
        try:
            content = gzip.GzipFile(fileobj=BytesIO(content)).read(MAX_FILE_BYTES + 1)
        except (OSError, EOFError, zlib.error) as error:
            raise InputError(f"{path}: expected a gzip file, found: {error}") from None
        if len(content) > MAX_FILE_BYTES:
            raise InputError(f"{path}: expected at most {MAX_FILE_BYTES} bytes unpacked, found more")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: expected {what} in UTF-8, found byte {error.start} that is not") from None


def _number(text: str, maximum: float, expected: str) -> float:
    """Return a number from 0 to a maximum; ``expected`` is the complaint up to what was found."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 <= value <= maximum or not text.isascii() or "_" in text:  # which float takes
        raise _Refused(f"{expected}, found {text[:40] or 'nothing'}")
    return value


def _delay_ns(text: str, expected: str) -> int:
    return round(_number(text, _MAX_DELAY_MS, expected) * NS_PER_MS)


def _check_count(path: str, count: int) -> None:
    if not 0 < count <= MAX_ENTRIES:
        raise InputError(f"{path}: expected 1 to {MAX_ENTRIES} entries, found {count or 'none'}")


def _by_time(
    source: str, times_ns: Sequence[int], delays_ns: Sequence[int | None], span_ns: tuple[int, int] | None = None
) -> Trace:
    """Return the trace of entries with times, which do not fall, that stand for the time from begin to end.

    It goes on for one mean distance of its entries beyond the end.
    """
    begin_ns, end_ns = (times_ns[0], times_ns[-1]) if span_ns is None else span_ns
    distances = len(times_ns) - 1
    gap_ns = max(1, round((times_ns[-1] - times_ns[0]) / distances)) if distances else NS_PER_S
    since_ns = tuple(time_ns - begin_ns for time_ns in times_ns)
    return Trace(source, tuple(delays_ns), since_ns, end_ns - begin_ns + gap_ns)


# CSV


def _from_csv(source: str, path: str, way: str | None, text: str) -> Trace:
    """Return the trace of a CSV file."""
    header, *lines = text.splitlines() or [""]
    columns = [name.strip() for name in header.split(",")]
    wanted = _csv_column(path, way, columns)
    rows = [(n, line) for n, line in enumerate(lines, 2) if line.strip()]
    _check_count(path, len(rows))
    delays_ns: list[int | None] = []
    times_ns: list[int] = []
    delay_at, time_at = columns.index(wanted), columns.index("t_s") if "t_s" in columns else None
    expected = f"{wanted}: {_DELAY}, lost or nothing"
    for n, line in rows:
        cells = line.split(",")
        try:
            if len(cells) != len(columns):
                raise _Refused(f"expected {','.join(columns)}, found {len(cells)} of {len(columns)}")
            cell = cells[delay_at].strip()
            delays_ns.append(None if cell in ("", "lost") else _delay_ns(cell, expected))
            if time_at is not None:
                times_ns.append(_csv_time_ns(cells[time_at].strip(), times_ns))
        except _Refused as error:
            raise InputError(f"{path}: line {n}: {error}") from None
    return Trace(source, tuple(delays_ns)) if time_at is None else _by_time(source, times_ns, delays_ns)


def _csv_time_ns(cell: str, before_ns: Sequence[int]) -> int:
    """Return the time of an entry, which must not be before the one above."""
    time_ns = round(_number(cell, _MAX_TIME_S, f"t_s: expected a time from 0 to {_MAX_TIME_S:.0f} s") * NS_PER_S)
    if before_ns and time_ns < before_ns[-1]:
        raise _Refused(f"t_s: expected a time not before the one above, found {cell}")
    return time_ns


def _csv_column(path: str, way: str | None, columns: list[str]) -> str:
    """Return the column of the delays."""
    if sorted(set(columns) - {"t_s"}) == ["delay_ms"] and len(columns) == len(set(columns)):
        if way is not None:
            raise InputError(f"{path}: expected up_ms,down_ms for #{way}, found delay_ms")
        return "delay_ms"
    if sorted(set(columns) - {"t_s"}) == ["down_ms", "up_ms"] and len(columns) == len(set(columns)):
        if way is None:
            raise InputError(f"{path}: expected #up or #down after a file that holds both, found none")
        return f"{way}_ms"
    found = ",".join(columns)[:60] or "nothing"
    raise InputError(
        f"{path}: line 1: expected the header delay_ms or up_ms,down_ms, with or without t_s, a flight recording, or "
        f"the output of ping or irtt, found {found}"
    )


# Flight recordings


def _from_recording(source: str, path: str, way: str | None) -> Trace:
    """Return the trace of one direction of a flight."""
    if way is None:
        raise InputError(f"{path}: expected #up or #down after a flight recording, found none")
    _check_finished(path)
    packets: dict[str, list[tuple[int, int, int | None]]] = {name: [] for name in WAYS}
    try:
        _read_packets(path, packets)
    except InputError:
        raise
    except Exception as error:  # a damaged file ends the reader in many ways
        found = str(error) or type(error).__name__
        raise InputError(f"{path}: expected a readable flight recording, found: {found}") from None
    if not packets[way]:
        raise InputError(f"{path}: expected packets under link/{way}, found none")
    for entries in packets.values():
        entries.sort(key=lambda entry: entry[:2])
    begin_ns = min(entries[0][0] for entries in packets.values() if entries)
    end_ns = max(entries[-1][0] for entries in packets.values() if entries)
    times_ns, _, delays_ns = zip(*packets[way], strict=True)
    return _by_time(source, times_ns, delays_ns, (begin_ns, end_ns))


def _check_finished(path: str) -> None:
    """Refuse a recording that is too large or ends in the middle."""
    with open(path, "rb") as file:
        size = file.seek(0, os.SEEK_END)
        if size > MAX_RECORDING_BYTES:
            raise InputError(f"{path}: expected at most {MAX_RECORDING_BYTES} bytes, found {size}")
        file.seek(max(0, size - len(_MCAP_MAGIC)))
        if size < 2 * len(_MCAP_MAGIC) or file.read() != _MCAP_MAGIC:
            raise InputError(
                f'{path}: expected a whole flight recording, found one that is cut off: run "sitl recover {path}" first'
            )


def _read_packets(path: str, packets: dict[str, list[tuple[int, int, int | None]]]) -> None:
    """Add (when sent, number, delay) of each packet of a recording to its direction."""
    from autopilot.link.record import read_mcap  # costs 30 ms, which every command would pay

    for topic, _, body in read_mcap(path):
        entries = packets.get(topic.removeprefix("link/")) if topic.startswith("link/") else None
        if entries is None or body["copy"] > 0 or body["fate"] == "gated":
            continue
        sent_ns, delivered_ns = int(body["sent_ns"]), body["delivered_ns"]
        delay_ns = None if delivered_ns is None else int(delivered_ns) - sent_ns
        where = f"{path}: {topic}: packet {body['number']}"
        if delay_ns is not None and not 0 <= delay_ns <= MAX_DELAY_NS:
            raise InputError(f"{where}: expected a delay from 0 to {MAX_DELAY_NS} ns, found {delay_ns}")
        if len(entries) >= MAX_ENTRIES:
            raise InputError(f"{where}: expected at most {MAX_ENTRIES} packets, found more")
        entries.append((sent_ns, int(body["number"]), delay_ns))


# ping


class _Reply(NamedTuple):
    """A reply to ping: its number without wraps, the round trip, and when the request left, if it is told."""

    number: int
    rtt_ns: int
    sent_ns: int | None


def _from_ping(source: str, path: str, way: str | None, text: str) -> Trace:
    """Return the trace of the output of ``ping``."""
    if way is not None:
        raise InputError(f"{path}: expected no #{way}: ping tells round trips, of which a trace takes half")
    replies = _ping_replies(path, text)
    if not replies:
        raise InputError(f"{path}: expected the output of ping, found no reply in it")
    numbers = sorted(replies)
    first, last = numbers[0], numbers[-1]
    if text.startswith("PING "):  # from the beginning: the others count from 0 and write "PING host (address): ..."
        first = min(first, 0 if "): " in text.partition("\n")[0] else 1)
    sent = _PING_SENT.search(text)
    if sent is not None:
        last = max(last, first + int(sent[1]) - 1)
    _check_count(path, last - first + 1)
    interval_ns = _ping_interval_ns(path, replies[numbers[0]], replies[numbers[-1]])
    delays_ns = [replies[n].rtt_ns // 2 if n in replies else None for n in range(first, last + 1)]
    return _by_time(source, [n * interval_ns for n in range(len(delays_ns))], delays_ns)


def _ping_replies(path: str, text: str) -> dict[int, _Reply]:
    """Return the first reply to each number."""
    replies: dict[int, _Reply] = {}
    newest = 0
    for n, line in enumerate(text.splitlines(), 1):
        match = _PING_REPLY.match(line)
        if match is None or "DUP!" in match["rest"]:
            continue
        half = _PING_MODULUS // 2
        number = int(match["number"])
        if replies:
            number = newest + (number - newest + half) % _PING_MODULUS - half
        newest = max(newest, number)
        try:
            rtt_ns = _delay_ns(match["ms"], f"time: {_DELAY}")
        except _Refused as error:
            raise InputError(f"{path}: line {n}: {error}") from None
        stamp = match["stamp"]
        sent_ns = None if stamp is None else round(float(stamp) * NS_PER_S) - rtt_ns
        replies.setdefault(number, _Reply(number, rtt_ns, sent_ns))
        if len(replies) > MAX_ENTRIES:
            raise InputError(f"{path}: line {n}: expected at most {MAX_ENTRIES} replies, found more")
    return replies


def _ping_interval_ns(path: str, first: _Reply, last: _Reply) -> int:
    """Return the mean distance of the requests, from the stamps of ``ping -D`` where there are any."""
    if first.sent_ns is None or last.sent_ns is None or first.number == last.number:
        return _PING_INTERVAL_NS
    interval_ns = round((last.sent_ns - first.sent_ns) / (last.number - first.number))
    if interval_ns <= 0:
        raise InputError(f"{path}: expected stamps of ping -D that rise, found {interval_ns} ns from one to the next")
    return interval_ns


# irtt


def _from_irtt(source: str, path: str, way: str | None, text: str) -> Trace:
    """Return the trace of a result of ``irtt client``."""
    try:
        result = orjson.loads(text)
    except orjson.JSONDecodeError as error:
        raise InputError(f"{path}: expected the JSON of irtt, found: {error}") from None
    trips = result.get("round_trips") if isinstance(result, dict) else None
    if not isinstance(trips, list):
        raise InputError(f"{path}: round_trips: expected the list of irtt, found {type(trips).__name__}")
    _check_count(path, len(trips))
    times_ns: list[int] = []
    delays_ns: list[int | None] = []
    for n, trip in enumerate(trips):
        where = f"{path}: round_trips[{n}]"
        lost = _irtt_lost(where, trip)
        if way is not None and lost == f"true_{'down' if way == 'up' else 'up'}":
            continue  # it was lost on the other way: nothing is known of this one
        sent_ns = _irtt_sent_ns(where, trip)
        if times_ns and sent_ns < times_ns[-1]:
            raise InputError(f"{where}: expected to be sent after the one before, found {sent_ns} ns")
        times_ns.append(sent_ns)
        delays_ns.append(None if lost != "false" else _irtt_delay_ns(where, trip, way))
    _check_count(path, len(times_ns))
    return _by_time(source, times_ns, delays_ns)


def _irtt_lost(where: str, trip: Any) -> str:
    lost = trip.get("lost") if isinstance(trip, dict) else None
    text = str(lost).lower() if isinstance(lost, bool) else lost
    if text not in ("false", "true", "true_up", "true_down"):
        raise InputError(f"{where}.lost: expected true, true_up, true_down or false, found {str(lost)[:40]}")
    return str(text)


def _irtt_sent_ns(where: str, trip: Any) -> int:
    """Return when a request left, by the client's monotonic clock."""
    value = _at(trip, "timestamps", "client", "send", "monotonic")
    if type(value) is not int or value < 0:
        found = "nothing" if value is None else str(value)[:40]
        raise InputError(f"{where}.timestamps.client.send.monotonic: expected a time in ns, found {found}")
    return value


def _irtt_delay_ns(where: str, trip: Any, way: str | None) -> int:
    """Return the delay of one way, or half of the round trip."""
    rtt_ns = _at(trip, "delay", "rtt")
    if type(rtt_ns) is not int or not 0 <= rtt_ns <= MAX_DELAY_NS:
        raise InputError(f"{where}.delay.rtt: expected 0 to {MAX_DELAY_NS} ns, found {str(rtt_ns)[:40]}")
    if way is None:
        return rtt_ns // 2
    name = "send" if way == "up" else "receive"
    delay_ns = _at(trip, "delay", name)
    if type(delay_ns) is not int or not 0 <= delay_ns <= rtt_ns:
        raise InputError(
            f"{where}.delay.{name}: expected 0 to {rtt_ns} ns, the round trip, found {str(delay_ns)[:40]}: without one "
            f"clock at both ends leave out #{way}, which takes half the round trip"
        )
    return delay_ns


def _at(value: Any, *names: str) -> Any:
    """Return what stands at a place in nested objects; None where nothing does."""
    for name in names:
        value = value.get(name) if isinstance(value, dict) else None
    return value
