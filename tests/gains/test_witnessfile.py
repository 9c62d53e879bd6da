"""Witness files: what is written reads back as the same; what is no witness is refused in one line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gains import table
from gains.table import InputError
from gains.witnessfile import MAX_PERIOD, Witness, read_witness, write_witness

GOOD = """\
# lagproof witness
# gains: pendulum-paper
# model: pendulum
# Ts_s: 0.03
# d_min: 1
# d_max: 3
# transitions: fifo
# growth_per_sample: 1.0017
k,d
0,1
1,2
2,3
3,3
"""
WITNESS = Witness("pendulum-paper", "pendulum", 0.03, 1, 3, "fifo", 1.0017, (1, 2, 3, 3))


@st.composite
def witnesses(draw: st.DrawFn) -> Witness:
    """Any witness: of transitions any, or fifo by cutting each delay to one more than the last."""
    d_min = draw(st.integers(0, 3))
    d_max = d_min + draw(st.integers(0, 6))
    delays = draw(st.lists(st.integers(d_min, d_max), min_size=1, max_size=40))
    transitions = draw(st.sampled_from(["any", "fifo"]))
    if transitions == "fifo":
        for k in range(1, 2 * len(delays)):
            i = k % len(delays)
            delays[i] = min(delays[i], delays[i - 1] + 1)
    name = st.text(st.characters(categories=["L", "N", "P"]), max_size=12)
    positive = st.floats(0.0, 1e300, exclude_min=True)
    return Witness(draw(name), draw(name), draw(positive), d_min, d_max, transitions, draw(positive), tuple(delays))


@given(witness=witnesses())
def test_what_is_written_reads_back_as_the_same(tmp_path_factory: pytest.TempPathFactory, witness: Witness) -> None:
    path = tmp_path_factory.mktemp("witness") / "w.csv"
    write_witness(path, witness)
    assert read_witness(path) == witness


def read(tmp_path: Path, text: str) -> Witness:
    (tmp_path / "w.csv").write_text(text)
    return read_witness(tmp_path / "w.csv")


def test_the_format_is_the_one_that_is_fixed(tmp_path: Path) -> None:
    assert read(tmp_path, GOOD) == WITNESS
    write_witness(tmp_path / "w.csv", WITNESS)
    assert (tmp_path / "w.csv").read_text() == GOOD


def test_keys_come_in_any_order_and_unknown_ones_are_passed_over(tmp_path: Path) -> None:
    comments, rows = GOOD.split("k,d\n")
    turned = "\n".join(["# found by: search: 3", "# no key", "#", *reversed(comments.splitlines())])
    assert read(tmp_path, f"{turned}\n\nk,d\n{rows}# end\n") == WITNESS


def test_a_file_with_windows_line_ends_reads_alike(tmp_path: Path) -> None:
    (tmp_path / "w.csv").write_bytes(b"\xef\xbb\xbf" + GOOD.replace("\n", "\r\n").encode())
    assert read_witness(tmp_path / "w.csv") == WITNESS


def test_names_may_be_missing(tmp_path: Path) -> None:
    text = GOOD.replace("# gains: pendulum-paper\n", "").replace("# model: pendulum\n", "")
    assert read(tmp_path, text) == replace(WITNESS, gains="", model="")


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        *((f"# {key}:", "# other:", f"{key}: ") for key in ("Ts_s", "d_min", "d_max", "transitions")),
        ("# d_min: 1", "# d_min: 1\n# d_min: 1", "d_min: expected one value"),
        ("k,d\n", "", "columns: expected k,d"),
        ("k,d", "d,k", "columns: expected k,d"),
        ("0,1\n", "", 'row 0: expected 0 and its delay, such as 0,1, found "1,2"'),
        ("2,3", "3,3", "row 2"),
        ("2,3\n", "2,3\n2,3\n", "row 3"),
        ("2,3", "2,3,4", "row 2"),
        ("2,3", "2,3.0", "row 2"),
        ("2,3", "2,-3", "row 2"),
        ("2,3", "2,٣", "row 2"),
        ("2,3", "2," + "3" * 5000, "row 2"),
        ("0,1", "0,0", "row 0: expected a delay from 1 to 3, found 0"),
        ("3,3", "3,4", "row 3: expected a delay from 1 to 3, found 4"),
        ("1,2\n2,3", "1,1\n2,3", "row 2: expected at most 2 after 1, as transitions are fifo, found 3"),
        ("0,1\n1,2\n2,3\n3,3", "0,3\n1,1", "row 0: expected at most 2 after 1"),
        ("Ts_s: 0.03", "Ts_s: nan", "Ts_s: expected a finite number above 0, found nan"),
        ("Ts_s: 0.03", "Ts_s: 0", "Ts_s: "),
        ("Ts_s: 0.03", "Ts_s: 30 ms", 'Ts_s: expected a number, found "30 ms"'),
        ("1.0017", "inf", "growth_per_sample: expected a finite number"),
        ("1.0017", "-1", "growth_per_sample: "),
        ("d_min: 1", "d_min: 4", "d_max: expected at least d_min = 4, found 3"),
        ("d_min: 1", "d_min: -1", "d_min: expected a number of samples"),
        ("d_max: 3", "d_max: 3.0", "d_max: expected a number of samples"),
        ("fifo", "lifo", 'transitions: expected any or fifo, found "lifo"'),
        ("0,1\n1,2\n2,3\n3,3\n", "", f"rows: expected 1 to {MAX_PERIOD}, found 0"),
    ],
)
def test_a_malformed_file_is_refused_in_one_line(tmp_path: Path, old: str, new: str, complaint: str) -> None:
    assert GOOD.count(old) == 1
    with pytest.raises(InputError) as refusal:
        read(tmp_path, GOOD.replace(old, new))
    message = str(refusal.value)
    assert message.startswith(f"{tmp_path / 'w.csv'}: {complaint}")
    assert "\n" not in message
    assert len(message) < 300 + len(str(tmp_path))


def test_a_jump_is_allowed_where_transitions_are_any(tmp_path: Path) -> None:
    assert read(tmp_path, GOOD.replace("fifo", "any").replace("1,2\n", "1,1\n")).delays == (1, 1, 3, 3)


def test_a_period_of_the_maximum_reads_and_one_more_does_not(tmp_path: Path) -> None:
    head = GOOD[: GOOD.index("0,1\n")]
    rows = "".join(f"{k},1\n" for k in range(MAX_PERIOD))
    assert len(read(tmp_path, head + rows).delays) == MAX_PERIOD
    with pytest.raises(InputError, match=f"rows: expected at most {MAX_PERIOD}, found {MAX_PERIOD + 1}"):
        read(tmp_path, f"{head}{rows}{MAX_PERIOD},1\n")


def test_what_cannot_be_read_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="nothing of that name"):
        read_witness(tmp_path / "none.csv")
    with pytest.raises(InputError, match="expected a readable file"):
        read_witness(tmp_path)
    with pytest.raises(InputError, match="expected a file name"):
        read_witness("a\0b")
    (tmp_path / "w.csv").write_bytes(GOOD.encode("utf-16"))
    with pytest.raises(InputError, match="expected UTF-8 text"):
        read_witness(tmp_path / "w.csv")
    monkeypatch.setattr(table, "MAX_FILE_BYTES", 20)
    with pytest.raises(InputError, match="expected at most 20 bytes"):
        read(tmp_path, GOOD)


@pytest.mark.parametrize(
    "wrong",
    [{"delays": ()}, {"delays": (1, 4)}, {"delays": (1, 3)}, {"gains": "a\nb"}, {"Ts": float("nan")}, {"d_max": 0}],
)
def test_a_malformed_witness_is_not_written(tmp_path: Path, wrong: dict) -> None:
    with pytest.raises(InputError):
        write_witness(tmp_path / "w.csv", replace(WITNESS, **wrong))
    assert not (tmp_path / "w.csv").exists()


def test_a_file_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected a file that can be written"):
        write_witness(tmp_path / "none" / "w.csv", WITNESS)
