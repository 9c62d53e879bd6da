"""The reader of TOML tables: exact complaints, and nothing but complaints."""

import contextlib
import datetime
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gains import table as table_module
from gains.table import InputError, Table

GOOD = """
name = "a"
count = 3
size = 2.5
on = true
row = [1, 2.5]
grid = [[1, 2], [3, 4]]
words = ["x", "y"]
[inner]
value = 1
[[many]]
value = 1
[[many]]
value = 2
"""


def parse(text: str) -> Table:
    return Table.parse(text.encode(), "f.toml")


def test_every_kind_of_value_is_read() -> None:
    table = parse(GOOD)
    assert table.string("name", choices=("a", "b")) == "a"
    assert table.integer("count", low=0, high=3) == 3
    assert table.number("size", above=2.0) == 2.5
    assert table.number("count") == 3.0
    assert table.boolean("on") is True
    assert table.vector("row", length=2).tolist() == [1.0, 2.5]
    grid = table.matrix("grid", shape=(2, None))
    assert grid.dtype == np.float64
    assert grid.tolist() == [[1.0, 2.0], [3.0, 4.0]]
    assert table.strings("words", length=2) == ("x", "y")
    assert table.table("inner").integer("value") == 1
    assert [t.integer("value") for t in table.tables("many")] == [1, 2]
    assert "name" in table
    assert "absent" not in table
    table.finish()


def test_absent_keys_give_their_defaults() -> None:
    table = parse("")
    assert table.string("a", None) is None
    assert table.number("b", 1.5, low=3.0) == 1.5
    assert table.integer("c", 4) == 4
    assert table.boolean("d", False) is False
    assert table.vector("e", None) is None
    assert table.table("f", None) is None
    assert table.tables("g", ()) == ()
    assert table.strings("h", ()) == ()
    assert table.mapping("i", None) is None


def test_a_free_table_is_taken_as_it_is() -> None:
    table = parse("[c]\nanything = [1, 'a']\n[c.deep]\nx = 1979-05-27")
    assert table.mapping("c") == {"anything": [1, "a"], "deep": {"x": datetime.date(1979, 5, 27)}}
    table.finish()


@pytest.mark.parametrize(
    ("text", "read", "complaint"),
    [
        ("", lambda t: t.number("x"), "x: expected a number, found nothing"),
        (
            "Tss = 1",
            lambda t: t.number("Ts"),
            "Ts: expected a number, found nothing; is Tss a misspelling of it?",
        ),
        ("x = true", lambda t: t.number("x"), "x: expected a number, found the boolean true"),
        ("x = true", lambda t: t.integer("x"), "x: expected an integer, found the boolean true"),
        ("x = 1.0", lambda t: t.integer("x"), "x: expected an integer, found 1.0"),
        ("x = 1", lambda t: t.boolean("x"), "x: expected true or false, found 1"),
        ("x = 'a'", lambda t: t.number("x"), 'x: expected a number, found the string "a"'),
        ("x = nan", lambda t: t.number("x"), "x: expected a finite number, found nan"),
        ("x = inf", lambda t: t.number("x", low=0.0), "x: expected a finite number of at least 0, found inf"),
        ("x = 0", lambda t: t.number("x", above=0.0), "x: expected a number above 0, found 0"),
        ("x = 2", lambda t: t.number("x", low=0.0, high=1.0), "x: expected a number from 0 to 1, found 2"),
        ("x = 2", lambda t: t.integer("x", high=1), "x: expected an integer of at most 1, found 2"),
        ("x = -1", lambda t: t.integer("x", low=0), "x: expected an integer of at least 0, found -1"),
        (
            "x = 9",
            lambda t: t.number("x", above=0.0, high=1.0),
            "x: expected a number above 0 and at most 1, found 9",
        ),
        ("x = ''", lambda t: t.string("x"), 'x: expected a string, found the string ""'),
        ("x = 'c'", lambda t: t.string("x", choices=("a",)), 'x: expected one of a, found the string "c"'),
        ("x = 1979-05-27", lambda t: t.string("x"), "x: expected a string, found a date or time"),
        ("x = 1", lambda t: t.vector("x"), "x: expected an array of numbers, found 1"),
        ("x = [1]", lambda t: t.vector("x", length=2), "x: expected 2 numbers, found 1"),
        ("x = [1, 2]", lambda t: t.vector("x", length=1), "x: expected 1 number, found 2"),
        ("x = [1, 'a']", lambda t: t.vector("x"), 'x[1]: expected a number, found the string "a"'),
        ("x = [1, 0]", lambda t: t.vector("x", above=0.0), "x[1]: expected a number above 0, found 0"),
        ("x = ['a', 1]", lambda t: t.strings("x"), "x[1]: expected a string, found 1"),
        ("x = 'ab'", lambda t: t.strings("x"), 'x: expected an array of strings, found the string "ab"'),
        ("x = 1", lambda t: t.matrix("x"), "x: expected a matrix (an array of rows), found 1"),
        ("x = []", lambda t: t.matrix("x"), "x: expected a matrix (an array of rows), found an empty array"),
        ("x = [[]]", lambda t: t.matrix("x"), "x[0]: expected a row of numbers, found an empty array"),
        ("x = [1]", lambda t: t.matrix("x"), "x[0]: expected a row of numbers, found 1"),
        ("x = [[1, 2], [3]]", lambda t: t.matrix("x"), "x[1]: expected 2 columns, found 1"),
        ("x = [[1], [2]]", lambda t: t.matrix("x", shape=(3, None)), "x: expected 3 rows, found 2"),
        ("x = [[1], [2]]", lambda t: t.matrix("x", shape=(1, None)), "x: expected 1 row, found 2"),
        ("x = [[1, 2]]", lambda t: t.matrix("x", shape=(1, 1)), "x: expected 1 column, found 2"),
        ("x = [[1, inf]]", lambda t: t.matrix("x"), "x[0][1]: expected a finite number, found inf"),
        ("x = [[1, false]]", lambda t: t.matrix("x"), "x[0][1]: expected a number, found the boolean false"),
        ("x = 1", lambda t: t.table("x"), "x: expected a table, found 1"),
        ("x = 1", lambda t: t.mapping("x"), "x: expected a table, found 1"),
        ("[x]\ny = 1", lambda t: t.tables("x"), "x: expected an array of tables, found a table"),
        ("x = [1]", lambda t: t.tables("x"), "x[0]: expected a table, found 1"),
        ("[x]\ny = 'a'", lambda t: t.table("x").number("y"), 'x.y: expected a number, found the string "a"'),
        ("x = [{}]", lambda t: t.tables("x")[0].number("y"), "x[0].y: expected a number, found nothing"),
        ("['a b']\ny = 1", lambda t: t.table("a b").string("y"), '"a b".y: expected a string, found 1'),
        (
            f"x = 0x{'f' * 5000}",
            lambda t: t.number("x"),
            "x: expected a finite number, found an integer of 20000 bits",
        ),
        (
            f"x = '{'y' * 99}'",
            lambda t: t.number("x"),
            f'x: expected a number, found the string "{"y" * 40}…"',
        ),
    ],
)  # fmt: skip
def test_a_wrong_value_is_refused_in_one_exact_line(text: str, read: Callable[[Table], object], complaint: str) -> None:
    with pytest.raises(InputError) as caught:
        read(parse(text))
    assert str(caught.value) == f"f.toml: {complaint}"


def test_an_unknown_key_is_refused_with_the_nearest_known_one() -> None:
    table = parse("name = 'a'\ndmax = 3")
    table.string("name")
    table.integer("d_max", None)
    with pytest.raises(InputError) as caught:
        table.finish()
    complaint = "expected one of name, d_max, found an unknown key; did you mean d_max?"
    assert str(caught.value) == f"f.toml: dmax: {complaint}"


def test_finish_reaches_the_tables_inside() -> None:
    table = parse("[[a]]\n[a.b]\nknown = 1\nqqq = 2")
    table.tables("a")[0].table("b").integer("known")
    with pytest.raises(InputError, match=r"^f\.toml: a\[0\]\.b\.qqq: expected one of known, found an unknown"):
        table.finish()


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (b"x = ", "expected TOML, found: Invalid value (at end of document)"),
        (b"\xff\xfe", "expected UTF-8 text, found byte 0 that is not"),
        (b"x = " + b"[" * 100_000, "expected TOML, found: "),
        (b"x = " + b"9" * 5000, "expected TOML, found: "),
    ],
)
def test_what_is_not_toml_is_refused(tmp_path: Path, content: bytes, found: str) -> None:
    path = tmp_path / "f.toml"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        Table.load(path)
    assert str(caught.value).startswith(f"{path}: {found}")
    assert "\n" not in str(caught.value)


def test_a_byte_order_mark_is_no_part_of_the_text() -> None:
    assert Table.parse(b"\xef\xbb\xbfx = 1", "f.toml").integer("x") == 1


def test_files_that_cannot_be_read_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=r"no\.toml: expected a file, found nothing of that name$"):
        Table.load(tmp_path / "no.toml")
    with pytest.raises(InputError, match=r"expected a readable file, found: Is a directory$"):
        Table.load(tmp_path)
    with pytest.raises(InputError, match="expected a file name, found: "):
        Table.load("a\0b")
    monkeypatch.setattr(table_module, "MAX_FILE_BYTES", 3)
    (tmp_path / "large.toml").write_text("x = 1")
    with pytest.raises(InputError, match=r"large\.toml: expected at most 3 bytes, found more$"):
        Table.load(tmp_path / "large.toml")


def test_the_folder_of_a_table_is_that_of_its_file(tmp_path: Path) -> None:
    (tmp_path / "f.toml").write_text("")
    assert Table.load(tmp_path / "f.toml").folder == tmp_path


def test_a_complaint_is_one_printable_line() -> None:
    assert str(InputError("a\nb\x1b[31m\r\udc80é")) == r"a\nb\x1b[31m\r\udc80é"


TOML_VALUES = st.recursive(
    st.booleans()
    | st.integers()
    | st.integers(min_value=10**400, max_value=10**401)
    | st.floats()
    | st.text(max_size=5)
    | st.dates()
    | st.datetimes()
    | st.times(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=12,
)

READERS: list[Callable[[Table], object]] = [
    lambda t: t.string("x"),
    lambda t: t.string("x", choices=("a", "b")),
    lambda t: t.boolean("x"),
    lambda t: t.integer("x", low=0, high=9),
    lambda t: t.number("x", low=0.0),
    lambda t: t.number("x", above=-1.0, high=1.0),
    lambda t: t.strings("x", length=2),
    lambda t: t.vector("x"),
    lambda t: t.vector("x", length=1),
    lambda t: t.matrix("x"),
    lambda t: t.matrix("x", shape=(1, 2)),
    lambda t: t.table("x"),
    lambda t: t.tables("x"),
    lambda t: t.mapping("x"),
    lambda t: t.finish(),
]


@given(TOML_VALUES, st.sampled_from(READERS))
def test_any_value_is_read_or_refused_in_one_line(value: object, read: Callable[[Table], object]) -> None:
    result: object = None
    complaint = "f.toml: x"
    try:
        result = read(Table({"x": value}, "f.toml"))
    except InputError as error:
        complaint = str(error)
    assert complaint.startswith("f.toml: x")
    assert complaint.isprintable()
    if isinstance(result, np.ndarray):
        assert result.dtype == np.float64
        assert np.isfinite(result).all()


@given(st.binary(max_size=60) | st.text(max_size=60).map(str.encode) | TOML_VALUES.map(
    lambda v: f"x = {json.dumps(v, default=str)}".encode()
))  # fmt: skip
def test_any_bytes_are_toml_or_refused(content: bytes) -> None:
    with contextlib.suppress(InputError):
        table = Table.parse(content, "f.toml")
        for read in READERS:
            with contextlib.suppress(InputError):
                read(table)
