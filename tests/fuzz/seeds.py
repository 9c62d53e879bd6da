"""The valid samples that fuzzing begins with: ``python -m tests.fuzz.seeds`` writes them into the corpus."""

from __future__ import annotations

import gzip
import tempfile
from collections.abc import Iterator, Mapping
from io import BytesIO
from pathlib import Path

import orjson
from mcap.writer import CompressionType, Writer

from autopilot.link.codecs import CODECS
from autopilot.link.groundmessages import CommandLong, ParamSet, SetAttitudeTarget
from autopilot.link.messages import Attitude, NamedValueInt, Timesync, VfrHud
from autopilot.link.node import Record
from autopilot.link.orders import BreakSends, DriftClock, MovePeer, StepClock, encode_order
from autopilot.link.record import McapRecorder, encode_line, frame_record
from autopilot.link.stream import encode_hello
from autopilot.link.wire import AUTOPILOT, PLANT, AoaSsa, HilActuatorControls, ServoOutputRaw, Wire, plant_heartbeat
from gains.store import resolve
from sitl.scenario import stored_scenarios
from tests.fuzz.script import advance_step, answer_step, datagram_step, message_step
from tests.fuzz.targets import CORPUS
from tests.fuzz.texts import TOKEN
from tests.helpers import HEARTBEAT

MS = 1_000_000
CONTROL = (
    *(plant_heartbeat(), Attitude(1000, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6), AoaSsa(10**6, 1.5, 0.5), Timesync(5, 6)),
    *(Timesync(0, 7), NamedValueInt(1000, "DELAY_K", 3), NamedValueInt(1000, "SAMPLE_K", 9), ServoOutputRaw(9, 1600)),
    *(HilActuatorControls(10**6, 0.5), VfrHud(100.0, 100.0, 90, 50, 1600.0, 0.1), HEARTBEAT),
)


COMMANDS = (176, 245, 246, 400, 511, 512, 519, 520)
"""MAV_CMD: mode, storage, restart, arming, intervals, messages, protocol, capabilities."""


def _zero(message: type) -> object:
    """Return a message of zeros that is addressed to the autopilot."""
    codec = CODECS[message]
    made = codec.message(codec.payload.unpack(bytes(codec.payload.size)))
    fields = {name: getattr(made, name) for name in message.__match_args__}  # type: ignore[attr-defined]
    fields |= {name: 1 for name in ("target_system", "target_component", "target") if name in fields}
    return message(**fields)


def _scripts() -> dict[str, dict[str, bytes]]:
    every = b"".join(message_step(2, _zero(message)) for message in CODECS)
    control = b"".join(message_step(0, message) for message in CONTROL)
    frames = b"".join(datagram_step(0, Wire(PLANT, None).encode(message)) for message in CONTROL)
    samples = b"".join(
        message_step(0, AoaSsa(at * 25_000, 1.0, 0.0))
        + message_step(0, Attitude(at * 25, 0.0, 0.01, 0.0, 0.0, 0.0, 0.0))
        + answer_step(at * 25 * MS + 1)
        + advance_step(25 * MS)
        for at in range(1, 12)
    )
    commands = (answer_step(1500) + answer_step(1501) + advance_step(25 * MS)) * 10
    nan, infinity = float("nan"), float("inf")
    commands_of_a_station = b"".join(
        message_step(2, CommandLong(1, 1, command, 0, first, nan, infinity, -infinity, 3.4e38, -3.4e38, 0.0))
        for command in COMMANDS
        for first in (1.0, nan, -1e30)
    )
    wishes = b"".join(
        message_step(2, message)
        for value in (nan, infinity, 3.4e38, 1e-40, -1.0)
        for message in (
            *(
                ParamSet(1, 1, name, value, 9)
                for name in ("DELAY_MIN", "DELAY_MAX", "FS_HOLD_S", "REF_MAX_DEG", "GAINS")
            ),
            SetAttitudeTarget(0, 1, 1, 7, (value, 0.0, 1.0, value), 0.0, value, 0.0, value),
        )
    )
    return {
        "framed": {"every": every, "control": control},
        "sealed": {"control": control, "frames": frames},
        "autopilot": {
            "fresh": b"\x00" + control + samples,
            "flying": b"\x01" + control,
            "ground": b"\x19" + every + advance_step(1000 * MS),
            "float": b"\x07" + samples,
            "commands": b"\x09" + commands_of_a_station + advance_step(500 * MS),
            "wishes": b"\x01" + wishes + advance_step(500 * MS),
        },
        "plant": {"commands": b"\x23" + commands, "last": b"\x2c" + control + commands, "fresh": b"\x10" + control},
        "relay": {f"link{n}": bytes((n,)) + frames + advance_step(40 * MS) + control + commands for n in (0, 1, 18, 3)},
    }


def _texts() -> dict[str, dict[str, bytes]]:
    words = {
        "spec": (
            "delay=25ms,jitter=uniform:28ms,loss=0.1",
            "jitter=gamma:4ms:1.5,corr=0.5,dup=0.01,reorder=0.05,gap=3,corrupt=0.1:2",
            "rate=57600bps,limit=10,order=keep,slot=20ms:4,loss=ge:0.1:0.3:0.9",
            "blackout=3s:2s,blackout=10s:1s:20s,hold=1s:20ms,handover=20s:80ms,fade=5s:500ms:80ms:0.05",
            "delay=0ns",
        ),
        "fault": (
            *("kill:plant@5s+0.5s", "freeze:relay@5s+1s", "step:autopilot:-0.5s@5s", "drift:plant:150ppm@5s"),
            *("mute:plant@5s+0.5s", "corrupt-gains@5s+1s", "disk-full@5s", "sensor:q_rad_s:bias:0.02@250ms+1s"),
            *("sensor:theta_rad:nan@5s", "elevator:slow:0.1@5s", "elevator:reversed@5s+1s"),
        ),
        "address": ("127.0.0.1:14550", "udpout:[::1]:14600", "udpin:localhost:0"),
        "clock": ("137s:+40ppm", "11s", "0.5s:-20.5ppm"),
        "profile": (
            *("5deg@1s,0deg@6s", "step:0.1rad@1s", "doublet:5deg@1s:2s", "3211:5deg@1s:0.5s", "sine:5deg@1s:0.5Hz:20s"),
            *("sine:1@0s:2Hz", "3211:1deg@0s:0.5s,doublet:1deg@10s:1s"),
        ),
    }
    return {name: {f"{n}": text.encode() for n, text in enumerate(each)} for name, each in words.items()}


REQUESTS = (
    {"id": 1, "do": "show"},
    {"id": 2, "do": "set", "link": "one", "up": "delay=40ms,jitter=gamma:4ms,loss=ge:0.1:0.3,dup=0.2"},
    {"id": 3, "do": "set", "link": "two", "preset": "lte", "down": "rate=57600bps,limit=3,slot=20ms:2,order=keep"},
    {"id": 4, "do": "set", "link": "two", "up": "fade=50ms:20ms:10ms:0.5,handover=100ms:30ms,hold=0s:5ms:20ms"},
    {"id": 5, "do": "set", "link": "one", "down": "hold=1s:20s:60s,handover=1ms:1ms,rate=9600bps"},
    {"id": 5, "do": "show", "link": "two"},
    {"id": 6, "do": "set", "link": "one", "up": "trace=/etc/hostname"},
    {"id": 7, "do": "set", "link": "three", "up": "loss=1"},
    {"id": 8, "do": "set", "down": "loss=1"},
    {"id": 9, "do": "reset"},
    {"do": "show"},
)
"""To the relay of :mod:`tests.fuzz.links`; the last ones are refused."""

RELAY_FILE = """[[link]]
name = "gcs"
listen = "127.0.0.1:14701"
to = "127.0.0.1:14600"
accept = "any"
peer = "[::1]:14555"
seed = 7
preset = "radio"
up = "delay=40ms,loss=0.1"
rules = ["up:ATTITUDE+AOA_SSA:delay=40ms", "down:0:loss=1"]
changes = ["3s:up:loss=0.5", "1s:down:delay=9ms"]
[[link]]
name = "second"
listen = "127.0.0.1:14702"
to = "localhost:14601"
"""


def _relays() -> dict[str, dict[str, bytes]]:
    heard = b"".join(Wire(PLANT, None).encode(message) for message in CONTROL)
    return {
        "control": {
            "requests": b"\n".join(map(orjson.dumps, REQUESTS)),
            "set": orjson.dumps({"id": 1, "do": "set", "link": "one", "up": "loss=0.5", "down": "corrupt=1:9"}),
        },
        "relayfile": {"two": RELAY_FILE.encode(), "one": RELAY_FILE.partition("accept")[0].encode()},
        "rule": {
            "plant": b"up:ATTITUDE+AOA_SSA+253:delay=40ms,loss=0.5\n" + heard,
            "bare": b"down:SERVO_OUTPUT_RAW:dup=1.0",
        },
        "change": {"0": b"3s:up:loss=0.5", "1": b"1234567ns:down:fade=5s:500ms:80ms:0.05,order=keep"},
    }


def _json() -> dict[str, dict[str, bytes]]:
    truth = {"k": 1, "t_ns": 2, "late_ns": 0, "x": [0.0, 1.0, 2.0], "u": [0.1], "j": None, "d": None}
    lines = {
        "truth": orjson.dumps({"topic": "plant/truth", "t_ns": 2, "log_time_ns": 3, "body": truth}) + b"\n",
        "frame": encode_line(frame_record("plant", 5, "sent", Wire(PLANT, None).encode(CONTROL[0])), 6),
    }
    hello = encode_hello("plant", TOKEN, {"autopilot": ("127.0.0.1", 14600)})
    orders = (StepClock(-5), DriftClock(40_000), BreakSends(10**9), MovePeer(14601))
    return {
        "line": lines,
        "stream": {"hello": hello + lines["truth"] + lines["frame"] + b"no line\n", "stranger": hello[:20] + b"\n"},
        "order": {type(order).__name__: encode_order(order) for order in orders},
    }


WITNESS = """# lagproof witness
# gains: pendulum-paper
# model: pendulum
# Ts_s: 0.03
# d_min: 1
# d_max: 7
# transitions: fifo
# growth_per_sample: 1.0017445994791603
k,d
0,2
1,3
"""

TIMESTAMPS = """[[port]]
name = "plant"
key = "{}"
next = 37500000000000
unseen = -1

[[port.stream]]
system = 1
component = 25
link = 0
floor = 37500000000000
"""

SCHEDULE = """name = "two"
model = "pendulum"
[[window]]
d_min = 1
d_max = 2
K1 = [[292.8, 68.4]]
[[window]]
d_min = 2
d_max = 4
K1 = [[250.0, 60.0]]
"""


PING = """PING example (192.0.2.1) 56(84) bytes of data.
[1700000000.100000] 64 bytes from 192.0.2.1: icmp_seq=1 ttl=56 time=20.5 ms
[1700000001.100000] 64 bytes from 192.0.2.1: icmp_seq=2 ttl=56 time=21.5 ms
[1700000003.100000] 64 bytes from 192.0.2.1: icmp_seq=4 ttl=56 time=19 ms

--- example ping statistics ---
5 packets transmitted, 3 received, 40% packet loss, time 4000ms
"""

ROUND_TRIP = {
    "lost": "false",
    "timestamps": {"client": {"send": {"monotonic": 5_000_000}}},
    "delay": {"rtt": 20_000_000, "send": 12_000_000, "receive": 8_000_000},
}


def _recording() -> bytes:
    """Return a finished recording of two packets and a lost one."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "flight.mcap"
        with McapRecorder(path, {"scenario": "none"}) as recorder:
            for number, (way, delivered_ns) in enumerate((("up", 9), ("down", 8), ("up", None)), 1):
                body = {"sent_ns": number, "delivered_ns": delivered_ns, "number": number, "size": 20, "copy": 0}
                recorder.write(Record(f"link/{way}", number, {**body, "fate": "delivered"}), number)
        return path.read_bytes()


def _plain_recording() -> bytes:
    """Return a recording that is neither compressed nor summed up: what is changed in it is looked at."""
    out = BytesIO()
    writer = Writer(out, chunk_size=200, compression=CompressionType.NONE, enable_crcs=False)
    writer.start("lagproof", "lagproof")
    schema = writer.register_schema("link/up", "jsonschema", b"{}")
    channels = [writer.register_channel(topic, "json", schema) for topic in ("link/up", "link/down")]
    for n in range(6):
        body = {"sent_ns": n, "delivered_ns": n + 5, "number": n + 1, "size": 20, "copy": 0, "fate": "delivered"}
        writer.add_message(channels[n % 2], n, orjson.dumps(body), n)
    writer.add_metadata("flight", {"scenario": "none"})  # type: ignore[no-untyped-call]
    writer.add_attachment(1, 2, "notes", "text/plain", b"none")  # type: ignore[no-untyped-call]
    writer.finish()  # type: ignore[no-untyped-call]
    return out.getvalue()


def _traces() -> dict[str, dict[str, bytes]]:
    return {
        "trace": {
            "number.csv": b"delay_ms\n12.5\nlost\n14\n",
            "time.csv": b"t_s,up_ms,down_ms\n0.0,12.5,3\n0.1,,4\n0.25,14,lost\n",
            "ping": PING.encode(),
            "irtt.json": orjson.dumps({"round_trips": [ROUND_TRIP, {**ROUND_TRIP, "lost": "true_up"}]}),
            "irtt.json.gz": gzip.compress(orjson.dumps({"round_trips": [ROUND_TRIP]}), mtime=0),
            "flight.mcap": _recording(),
            "plain.mcap": _plain_recording(),
        },
        "recovery": {
            "whole": _recording(),
            "plain": _plain_recording(),
            "cut": _recording()[:-40],
            "torn": _recording()[: len(_recording()) // 2],
        },
        "table": {"header": b"delay_ms\n3\n1.5\n", "bare": b"2\n1\n"},
    }


def _files() -> dict[str, dict[str, bytes]]:
    from autopilot.link.keyfile import _fingerprint
    from tests.fuzz.files import KEY

    stored = {name: resolve(name).read_bytes() for name in ("hirm", "pendulum-exact", "hirm-paper", "hirm-printed")}
    proved = {name: resolve(name).read_bytes() for name in ("hirm-d3", "pendulum-exact-paper")}
    scenarios = {
        name: stored_scenarios()[name].read_bytes() for name in ("nominal", "conservative", "gust", "uncertain")
    }
    return {
        "model": {name: stored[name] for name in ("hirm", "pendulum-exact", "hirm-printed")},
        "law": {"hirm-paper": stored["hirm-paper"], "schedule": SCHEDULE.encode(), "hirm-d3": proved["hirm-d3"]},
        "certificate": proved,
        "witness": {"fifo": WITNESS.encode()},
        "scenario": scenarios,
        "parameters": {"some": b"DELAY_MAX = 3\nFS_HOLD_S = 0.4\nREF_MAX_DEG = 20.0\n", "none": b""},
        "key": {"hexadecimal": b"0123456789abcdef" * 4 + b"\n", "passphrase": "grüezi mitenand".encode()},
        "timestamps": {"one": TIMESTAMPS.format(_fingerprint(KEY)).encode()},
        "profile_file": {"degrees": b"time_s,value_deg\n0.0,0.0\n1.0,5.0\n2.5,-1e-3\n"},
    }


def _datagrams() -> dict[str, dict[str, bytes]]:
    plant, autopilot = Wire(PLANT, None), Wire(AUTOPILOT, None)
    return {
        "datagram": {
            "control": b"".join(plant.encode(message) for message in CONTROL),
            "ground": b"".join(Wire((255, 190), None).encode(_zero(message)) for message in CODECS),  # type: ignore[arg-type]
            "own": autopilot.encode(HEARTBEAT),
        }
    }


def seeds() -> Iterator[tuple[str, str, bytes]]:
    """Yield target, name and content of each sample."""
    tables: tuple[Mapping[str, Mapping[str, bytes]], ...] = (
        *(_datagrams(), _scripts(), _texts(), _json(), _files(), _traces(), _relays()),
    )
    for table in tables:
        for target, samples in table.items():
            for name, content in samples.items():
                yield target, name, content


if __name__ == "__main__":
    for target, name, content in seeds():
        folder = CORPUS / target
        folder.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
