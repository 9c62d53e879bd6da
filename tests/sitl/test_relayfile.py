"""Files of links: what they say, and that whatever else is in them is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from gains.table import InputError
from sitl.link.changes import parse_change
from sitl.link.direction import LinkConfig
from sitl.link.presets import PRESETS
from sitl.link.relay import MAX_LINKS
from sitl.link.relayfile import RelayLink, load_relay
from sitl.link.rules import MAX_RULES, parse_rule
from sitl.link.spec import parse_spec

ENDS = 'listen = "127.0.0.1:14701"\nto = "127.0.0.1:14600"\n'
FULL = f"""
[[link]]
name = "gcs"
{ENDS}
accept = "any"
peer = "127.0.0.1:14555"
seed = 7
preset = "radio"
up = "delay=40ms,loss=0.1"
rules = ["up:ATTITUDE+AOA_SSA:delay=40ms", "down:0:loss=1"]
changes = ["3s:up:loss=0.5", "1s:down:delay=9ms"]

[[link]]
name = "second"
{ENDS}
"""


def load(folder: Path, text: str) -> tuple[RelayLink, ...]:
    path = folder / "relay.toml"
    path.write_text(text)
    return load_relay(path)


def test_a_file_says_all_that_the_command_line_can_and_has_its_defaults(tmp_path):
    gcs, second = load(tmp_path, FULL)
    assert gcs == RelayLink(
        LinkConfig(
            parse_spec("delay=40ms,loss=0.1"),
            PRESETS["radio"][1],
            7,
            "gcs",
            tuple(map(parse_rule, ("up:ATTITUDE+AOA_SSA:delay=40ms", "down:0:loss=1"))),
            tuple(map(parse_change, ("3s:up:loss=0.5", "1s:down:delay=9ms"))),
        ),
        ("127.0.0.1", 14701),
        ("127.0.0.1", 14600),
        ("127.0.0.1", 14555),
        True,
    )
    assert second == RelayLink(LinkConfig(*PRESETS["perfect"], 2, "second"), ("127.0.0.1", 14701), ("127.0.0.1", 14600))


def one(more: str = "", name: str = "a", ends: str = ENDS) -> str:
    return f'[[link]]\nname = "{name}"\n{ends}{more}\n'


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "link: expected an array of tables, found nothing"),
        ("link = []", f"link: expected 1 to {MAX_LINKS} tables, found 0"),
        ("".join(one(name=str(n)) for n in range(MAX_LINKS + 1)), f"expected 1 to {MAX_LINKS} tables, found 17"),
        (one() + one(), "link[1].name: expected a name of its own, found a"),
        (one(name="A b"), "link[0].name: expected 1 to 32 of a-z"),
        (one(name="a" * 33), "link[0].name: expected 1 to 32 of a-z"),
        (one(ends='listen = "127.0.0.1:1"\n'), "link[0].to: expected a string, found nothing"),
        (one(ends='listen = "here"\nto = "127.0.0.1:1"\n'), 'link[0]: address "here": expected HOST:PORT'),
        (one('peer = "there"'), 'link[0]: address "there"'),
        (one('preset = "moon"'), "link[0]: link preset: expected one of"),
        (one('up = "loss=2"'), 'link[0]: link spec "loss=2"'),
        (one('rules = ["up:NO:loss=1"]'), 'link[0]: rule "up:NO:loss=1"'),
        (one(f"rules = {['up:0:loss=1'] * (MAX_RULES + 1)}"), f"rules: expected at most {MAX_RULES}, found 17"),
        (one('changes = ["up:loss=1"]'), 'link[0]: change "up:loss=1"'),
        (one("seed = -1"), "link[0].seed: expected an integer from 0"),
        (one('accept = "all"'), "link[0].accept: expected one of mavlink, any"),
        (one("sed = 1"), "link[0].sed: expected one of"),
        ("control = 5\n" + one(), "control: expected one of link, found an unknown key"),
    ],
)
def test_whatever_else_is_refused_in_one_line_that_names_file_and_place(tmp_path, text, said):
    with pytest.raises(InputError) as refusal:
        load(tmp_path, text)
    assert str(refusal.value).startswith(f"{tmp_path / 'relay.toml'}: ")
    assert said in str(refusal.value)
    assert "\n" not in str(refusal.value)
