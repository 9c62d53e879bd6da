"""The one table of what is fuzzed: every decoder and every loader of a file.

A target takes bytes and lets out no exception but a defect: the documented ones it catches itself. Where there is
something that must hold (a round trip, counters that add up, a node that lives) it asserts that. The table serves
the corpus (``test_corpus.py``), hypothesis (``test_properties.py``) and the coverage-guided engine
(``python -m tests.fuzz``).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from tests.fuzz import files, links, live, nodes, texts, wires
from tests.fuzz.refusing import Run

CORPUS = Path(__file__).parent / "corpus"

_NUMBERS = (b"nan", b"inf", b"-1", b"0", b"-0.0", b"1e308", b"1e-308", b"1e999", b"18446744073709551616", b"0x1")
_ODD = (b"\0", b"\xff", b"\xef\xbb\xbf", b"\r\n", b"\n", "٣".encode(), b"_", b'"', b"[[]]", b"{}", b"[", b"#", b" = ")
_JSON = (b"null", b"true", b"[]", b"{}", b'""', b'"\\ud800"', b"1e400", b"9223372036854775808", b",", b":", b"\n")
_GAINS = (
    b"d_min",
    b"d_max",
    b"K1",
    b"K2",
    b"[[window]]",
    b"conservative",
    b"1000",
    b"hirm",
    b"pendulum",
    b"any",
    b"fifo",
)
_CERTIFICATE = (
    b"exact",
    b"lyapunov",
    b"memory",
    b"aheads",
    b"contraction",
    b"[[certificate.block]]",
    b"tree",
    b"paths",
)
_FRAMES = (b"\xfd", b"\xfe", b"\x01\x01", b"\x01\x19", b"\xff" * 8, b"\x00\x00\xc0\x7f", b"\x00\x00\x80\xff", b"\x7f")

_SPEC = (
    *(b"delay=", b"jitter=", b"loss=", b"dup=", b"reorder=", b"order=keep", b"rate=", b"corr=", b"gap=", b"slot="),
    *(b"corrupt=", b"limit=", b"blackout=", b"hold=", b"handover=", b"fade=", b"gamma:", b"pareto:", b"ge:"),
    *(b"uniform:", b"ms", b"us", b"ns", b"kbps", b":", b",", *_NUMBERS, *_ODD),
)


@dataclass(frozen=True, slots=True)
class Target:
    """What is fuzzed.

    Attributes
    ----------
    run : Run
        Takes one input.
    words : tuple of bytes
        What the grammar is made of: a dictionary for engines.
    """

    run: Run
    words: tuple[bytes, ...]


TARGETS: Mapping[str, Target] = {
    "datagram": Target(wires.datagram, _FRAMES),
    "framed": Target(wires.framed, _FRAMES),
    "sealed": Target(wires.sealed, _FRAMES),
    "autopilot": Target(nodes.autopilot, _FRAMES),
    "plant": Target(nodes.plant, _FRAMES),
    "relay": Target(nodes.relay, _FRAMES),
    "line": Target(texts.line, (b"topic", b"t_ns", b"log_time_ns", b"body", b"plant/truth", b"mavlink/", *_JSON)),
    "order": Target(
        texts.order, (b"order", b"step_clock", b"by_ns", b"drift_ppb", b"for_ns", b"move_peer", b"number", *_JSON)
    ),
    "stream": Target(texts.stream, (b'"hello"', b'"plant"', b'"token"', b'"t"', b'"ports"', *_JSON)),
    "spec": Target(texts.spec, _SPEC),
    "rule": Target(links.rule, (b"up:", b"down:", b"ATTITUDE", b"+", b"253", b":", b"\n", *_FRAMES, *_SPEC)),
    "change": Target(links.change, (b"3s:", b"up:", b"down:", *_SPEC)),
    "control": Target(
        links.control,
        (
            *(
                b'{"id":1,"do":"set",',
                b'{"id":2,"do":"show"',
                b'"link":"one"',
                b'"preset":"lte"',
                b'"up":"',
                b'"down":"',
            ),
            *(b"trace=", b"table:", b"/etc/hostname", b"\\u0000", *_JSON, *_SPEC),
        ),
    ),
    "relayfile": Target(
        links.relayfile,
        (
            *(b"[[link]]\n", b'name = "', b'listen = "127.0.0.1:1"\n', b'to = "[::1]:2"\n', b'peer = "', b"seed = "),
            *(b'preset = "lte"\n', b'up = "', b'rules = ["up:0:', b'changes = ["3s:up:', b'accept = "any"\n', *_SPEC),
        ),
    ),
    "fault": Target(
        texts.fault,
        (
            *(b"kill:", b"freeze:", b"mute:", b"step:", b"drift:", b"plant", b"relay", b"autopilot", b"corrupt-gains"),
            *(b"disk-full", b"sensor:", b"elevator:", b"stuck", b"slow:", b"noise:", b"nan", b"@", b"+", b"ppm", b"ms"),
            *(*_NUMBERS, *_ODD),
        ),
    ),
    "address": Target(texts.address, (b"127.0.0.1", b":", b"[::1]", b"udpout:", b"udpin:", b"65535", *_NUMBERS, *_ODD)),
    "clock": Target(texts.clock, (b"s:", b"ppm", b"+", b"-", b".", b"999999999", *_NUMBERS, *_ODD)),
    "profile": Target(
        texts.profile,
        (b"step:", b"doublet:", b"3211:", b"sine:", b"deg@", b"rad@", b"s:", b"Hz", b"Hz:", b",", b"e300", *_NUMBERS),
    ),
    "profile_file": Target(files.profile_file, (b"time_s,value_rad", b"time_s,value_deg", b",", *_NUMBERS, *_ODD)),
    "model": Target(files.model, (b"[plant]", b"[actuator]", b"[trim]", b"continuous", b"Ts", *_NUMBERS, *_ODD)),
    "law": Target(files.law, (*_GAINS, *_CERTIFICATE, *_NUMBERS, *_ODD)),
    "certificate": Target(files.certificate, (*_GAINS, *_CERTIFICATE, *_NUMBERS, *_ODD)),
    "witness": Target(files.witness, (b"# ", b"transitions: any", b"k,d", b"d_max: ", b"growth_per_sample", *_NUMBERS)),
    "scenario": Target(
        files.scenario,
        (
            b"[link]",
            b"[clocks]",
            b"[[check]]",
            b"[variant.x]",
            b"[gust]",
            b'faults = ["kill:plant@1s"]',
            *_NUMBERS,
            *_ODD,
        ),
    ),
    "trace": Target(
        files.trace,
        (b"delay_ms", b"up_ms,down_ms", b"t_s,", b"lost", b"PING ", b"icmp_seq=", b"time=", *_NUMBERS, *_JSON),
    ),
    "table": Target(files.table, (b"delay_ms", b"\n", *_NUMBERS, *_ODD)),
    "flight": Target(
        files.flight,
        (b"\x89MCAP0\r\n", *(bytes((op, n)) for op in range(1, 16) for n in (0, 9)), b"plant/truth", *_JSON),
    ),
    "live": Target(
        live.live, (b"\x89MCAP0\r\n", *(bytes((op, n)) for op in range(1, 16) for n in (0, 9)), b"plant/truth", *_JSON)
    ),
    "recovery": Target(
        files.recovery, (b"\x89MCAP0\r\n", *(bytes((op, n)) for op in range(1, 16) for n in (0, 9)), b"\xff" * 8)
    ),
    "parameters": Target(files.parameters, (b"DELAY_MAX", b"REF_MAX_DEG", b"FS_HOLD_S", b"GAINS", *_NUMBERS, *_ODD)),
    "key": Target(files.key, (b"0123456789abcdef", b"\xc2\x85", b"\xe2\x80\xa8", b"\t", b" ", *_ODD)),
    "timestamps": Target(files.timestamps, (b"[[port]]", b"[[port.stream]]", b"floor", b"next", b"unseen", *_NUMBERS)),
}
"""Name to target, which is the name of its folder in the corpus too."""


def corpus_of(name: str) -> dict[str, bytes]:
    """Return name and content of a target's samples, in order."""
    return {path.name: path.read_bytes() for path in sorted((CORPUS / name).iterdir()) if path.is_file()}
