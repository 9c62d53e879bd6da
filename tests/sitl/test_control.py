"""Live control: what is no request, replies, and that strangers neither harm a relay nor make it read files."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gains.table import InputError
from sitl.link.changes import Change, parse_change
from sitl.link.control import (
    MAX_ID,
    MAX_REPLY_BYTES,
    MAX_REQUEST_BYTES,
    Refused,
    Set,
    Show,
    decode_reply,
    decode_request,
    encode_refusal,
    encode_reply,
    encode_request,
)
from sitl.link.direction import LinkConfig
from sitl.link.presets import PRESETS
from sitl.link.relay import RelayNode
from sitl.link.spec import parse_spec
from sitl.link.status import MAX_CHANGES_SHOWN
from tests.sitl.relays import MS, PERFECT, S

json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=6,
)
nearly_requests = st.dictionaries(
    st.sampled_from(["id", "do", "link", "up", "down", "preset", "more"]),
    json_values | st.sampled_from(["set", "show", "loss=0.5", "radio", "trace=x", "one"]) | st.integers(0, 5),
)


def asked(request: dict) -> Set | Show | Refused:
    return decode_request(json.dumps(request).encode())


def error_of(request: dict) -> str:
    refused = asked(request)
    assert isinstance(refused, Refused)
    return refused.error


def answers(relay: RelayNode, request: object, now_ns: int = 0) -> list[dict]:
    datagram = request if isinstance(request, bytes) else json.dumps(request).encode()
    relay.receive("control", datagram, now_ns)
    sent = relay.outgoing()
    assert all(port == "control" for port, _ in sent)
    return [json.loads(reply) for _, reply in sent]


# --------------------------------------------------------------------------------------------- requests


def test_a_set_names_the_directions_that_change_and_no_others():
    up, down = PRESETS["radio"]
    loss = parse_spec("loss=0.5")
    assert asked({"id": 1, "do": "set", "up": "loss=0.5"}) == Set(1, None, {"up": loss})
    assert asked({"id": 2, "do": "set", "link": "a", "down": "loss=0.5"}) == Set(2, "a", {"down": loss})
    assert asked({"id": 3, "do": "set", "preset": "radio"}) == Set(3, None, {"up": up, "down": down})
    assert asked({"id": 4, "do": "set", "preset": "radio", "up": "loss=0.5"}) == Set(
        4, None, {"up": loss, "down": down}
    )
    assert asked({"id": MAX_ID, "do": "show"}) == Show(MAX_ID, None)


@pytest.mark.parametrize(
    ("request_", "said"),
    [
        ({"do": "show"}, "id: expected a whole number"),
        ({"id": -1, "do": "show"}, "id: expected a whole number"),
        ({"id": MAX_ID + 1, "do": "show"}, "id: expected a whole number"),
        ({"id": True, "do": "show"}, "id: expected a whole number"),
        ({"id": "1", "do": "show"}, "id: expected a whole number"),
        ({"id": 1}, "do: expected one of set, show, found nothing"),
        ({"id": 1, "do": ["set"]}, "do: expected one of set, show, found list"),
        ({"id": 1, "do": "set"}, "expected at least one of preset, up, down"),
        ({"id": 1, "do": "set", "up": 5}, "up: expected text, found int"),
        ({"id": 1, "do": "set", "upp": "loss=1"}, "found upp"),
        ({"id": 1, "do": "show", "up": "loss=1"}, "found up"),
        ({"id": 1, "do": "set", "up": "loss=2"}, "loss: expected"),
        ({"id": 1, "do": "set", "up": "loss=0.5", "down": ""}, "expected keyword=value"),
        ({"id": 1, "do": "set", "preset": "moon"}, "found moon"),
    ],
)
def test_what_is_no_request_is_refused_in_one_line(request_, said):
    error = error_of(request_)
    assert said in error
    assert "\n" not in error


@pytest.mark.parametrize(
    "datagram", [b"", b"{", b"[]", b"7", b"\xff", b'{"id":1', b"[" * 4000, b" " * (MAX_REQUEST_BYTES + 1)]
)
def test_what_has_no_readable_id_is_refused_without_one(datagram):
    refused = decode_request(datagram)
    assert isinstance(refused, Refused)
    assert refused.id is None


def test_a_request_may_be_as_long_as_is_said_and_no_longer():
    request = b'{"id":1,"do":"show"}'
    assert decode_request(request.ljust(MAX_REQUEST_BYTES)) == Show(1, None)
    assert isinstance(decode_request(request.ljust(MAX_REQUEST_BYTES + 1)), Refused)


@pytest.mark.parametrize(
    "spec",
    [
        "trace=FILE",
        "loss=0.5, trace = FILE",
        "jitter=table:FILE",
        "delay=5ms,jitter = table:FILE",
        "delay=5ms,jitter= table :FILE",
        "trace=FILE#up",
    ],
)
@pytest.mark.parametrize("way", ["up", "down"])
def test_a_spec_that_names_a_file_is_refused_and_the_file_is_never_opened(tmp_path, monkeypatch, spec, way):
    file = tmp_path / "delays.csv"
    file.write_text("delay_ms\n5\n6\n")
    text = spec.replace("FILE", str(file))
    opened = []
    monkeypatch.setattr("builtins.open", lambda *_, **__: opened.append(1))
    assert "expected a SPEC without files" in error_of({"id": 1, "do": "set", way: text})
    assert opened == []


@given(datagram=st.binary(max_size=200) | (json_values | nearly_requests).map(lambda value: json.dumps(value).encode()))
def test_nothing_that_is_sent_makes_the_relay_raise_and_each_request_is_counted_once(datagram):
    relay = RelayNode(PERFECT, PERFECT, 1)
    replies = answers(relay, datagram)
    counts = relay._control
    assert sum(counts.values()) == 1
    assert len(replies) == 1 - counts["malformed"]
    for reply in replies:
        assert reply["ok"] is (counts["requests"] == 1)
        assert reply["id"] == json.loads(datagram)["id"]
        assert reply["ok"] or "\n" not in reply["error"]


# ---------------------------------------------------------------------------------------------- replies


def test_a_reply_reads_back_and_those_to_other_requests_are_none():
    assert decode_reply(encode_reply(7, {"at": ["x"]}), 7) == {"id": 7, "ok": True, "at": ["x"]}
    assert decode_reply(encode_reply(8, {}), 7) is None
    assert decode_reply(b"noise", 7) is None
    assert decode_reply(b"[7]", 7) is None
    with pytest.raises(InputError, match="no such link"):
        decode_reply(encode_refusal(7, "no such link"), 7)
    assert asked(json.loads(encode_request(3, "set", link=None, up="loss=0.5"))) == Set(
        3, None, {"up": parse_spec("loss=0.5")}
    )


def test_a_reply_that_fits_no_datagram_becomes_a_refusal():
    with pytest.raises(InputError, match="ask for one link"):
        decode_reply(encode_reply(1, {"links": "x" * MAX_REPLY_BYTES}), 1)


# ------------------------------------------------------------------------------------------- the relay


def test_a_set_is_done_wholly_or_not_at_all():
    relay = RelayNode(PERFECT, PERFECT, 1)
    (refused,) = answers(relay, {"id": 5, "do": "set", "up": "loss=1", "down": "loss=oops"})
    assert refused["ok"] is False
    relay.receive("plant", b"x", 0)
    assert relay.outgoing() == [("autopilot", b"x")]
    (done,) = answers(relay, {"id": 6, "do": "set", "up": "loss=1", "down": "loss=1"}, 5)
    assert done == {"id": 6, "ok": True, "link": "link", "at": ["5ns:up:loss=1.0", "5ns:down:loss=1.0"]}
    for port in ("plant", "autopilot"):
        relay.receive(port, b"x", 6)
    assert relay.outgoing() == []


def test_of_several_links_the_one_that_is_named_changes():
    relay = RelayNode.joining([LinkConfig(PERFECT, PERFECT, n, name) for n, name in enumerate(("one", "two"))])
    (unnamed,) = answers(relay, {"id": 1, "do": "set", "up": "loss=1"})
    (unknown,) = answers(relay, {"id": 2, "do": "set", "link": "three", "up": "loss=1"})
    assert [unnamed["error"], unknown["error"]] == [
        "link: expected one of one, two, found nothing",
        "link: expected one of one, two, found three",
    ]
    assert answers(relay, {"id": 3, "do": "set", "link": "two", "up": "loss=1"})[0]["link"] == "two"
    for name in ("one", "two"):
        relay.receive(f"{name}/plant", b"x", 9)
    assert relay.outgoing() == [("one/autopilot", b"x")]
    assert list(answers(relay, {"id": 4, "do": "show"})[0]["links"]) == ["one", "two"]
    assert list(answers(relay, {"id": 5, "do": "show", "link": "two"})[0]["links"]) == ["two"]


def test_show_tells_specs_counters_rates_and_delays():
    relay = RelayNode(parse_spec("delay=20ms"), parse_spec("loss=1"), 1)
    for n in range(100):
        now_ns = n * 25 * MS
        relay.receive("plant", bytes(50), now_ns)
        relay.receive("autopilot", bytes(50), now_ns)
        relay.tick(now_ns + 21 * MS)
    relay.receive("plant", bytes(50), 2500 * MS)
    relay.outgoing()
    (reply,) = answers(relay, {"id": 1, "do": "show"}, 2501 * MS)
    status = reply["links"]["link"]
    up, down = status["up"], status["down"]
    assert status["link_ns"] == 2501 * MS
    assert (up["spec"], up["sent"], up["delivered"], up["queued"]) == ("delay=20ms", 101, 100, 1)
    assert (down["spec"], down["sent"], down["lost"]) == ("loss=1.0", 100, 100)
    assert up["requested_ns"] == {"p50": 20 * MS, "p99": 20 * MS}
    assert up["achieved_ns"] == {"p50": 21 * MS, "p99": 21 * MS}
    assert MS <= up["error_ns"]["p50"] <= up["error_ns"]["max"] == MS
    assert (up["rate_hz"], up["rate_bps"]) == (40.0, 16_000.0)
    assert (down["rate_hz"], down["achieved_ns"], down["error_ns"]) == (0.0, None, None)


def test_the_rate_is_that_of_the_last_second_or_of_the_latest_deliveries_when_there_are_too_many():
    relay = RelayNode(PERFECT, PERFECT, 1)
    for n in range(4001):  # 4 kHz up, 100 Hz down
        relay.receive("plant", bytes(25), n * MS // 4)
        if n % 40 == 0:
            relay.receive("autopilot", bytes(25), n * MS // 4)
    relay.outgoing()
    status = answers(relay, {"id": 1, "do": "show"}, 1 * S)[0]["links"]["link"]
    assert status["up"]["rate_hz"] == pytest.approx(4000, rel=0.002)
    assert status["up"]["rate_bps"] == pytest.approx(800_000, rel=0.002)
    assert (status["down"]["rate_hz"], status["down"]["rate_bps"]) == (100.0, 20_000.0)
    later = answers(relay, {"id": 1, "do": "show"}, 3 * S)[0]["links"]["link"]
    assert (later["up"]["rate_hz"], later["down"]["rate_hz"]) == (0.0, 0.0)


def test_the_delays_shown_are_quantiles_by_nearest_rank():
    relay = RelayNode(parse_spec("delay=1ms"), PERFECT, 1)
    achieved = [MS + n * 10_000 for n in range(150)]
    for n, achieved_ns in enumerate(achieved):
        relay.receive("plant", b"x", n * 10 * MS)
        relay.tick(n * 10 * MS + achieved_ns)
    relay.outgoing()
    up = answers(relay, {"id": 1, "do": "show"}, 2 * S)[0]["links"]["link"]["up"]
    assert up["requested_ns"] == {"p50": MS, "p99": MS}
    assert up["achieved_ns"] == {
        f"p{part}": np.quantile(achieved, part / 100, method="inverted_cdf") for part in (50, 99)
    }


def test_show_tells_the_first_of_many_changes_to_come_and_how_many_there_are():
    changes = [Change((1 + n) * S, "up", parse_spec(f"delay={n}ms")) for n in range(MAX_CHANGES_SHOWN + 4)]
    relay = RelayNode(PERFECT, PERFECT, 1, changes=changes)
    up = answers(relay, {"id": 1, "do": "show"})[0]["links"]["link"]["up"]
    assert up["changes"] == MAX_CHANGES_SHOWN + 4
    assert [parse_change(text) for text in up["next_changes"]] == changes[:MAX_CHANGES_SHOWN]


def test_show_tells_the_changes_to_come_and_the_spec_that_holds():
    relay = RelayNode(PERFECT, PERFECT, 1)
    relay.receive("plant", b"x", 0)
    relay.outgoing()
    for at_ns, spec in ((1 * S, "loss=0.1"), (2 * S, "loss=0.2")):
        answers(relay, {"id": 1, "do": "set", "up": spec}, at_ns)
    status = answers(relay, {"id": 1, "do": "show"}, 3 * S)[0]["links"]["link"]
    assert (status["up"]["spec"], status["up"]["changes"], status["down"]["spec"]) == ("loss=0.2", 0, "delay=0ns")


def test_the_recording_counts_requests():
    relay = RelayNode(PERFECT, PERFECT, 1)
    for request in ({"id": 1, "do": "show"}, {"id": 1, "do": "no"}, b"noise", b"more noise"):
        answers(relay, request)
    relay.close(1)
    assert relay.records()[-1].body["data"]["control"] == {"requests": 1, "refused": 1, "malformed": 2}
