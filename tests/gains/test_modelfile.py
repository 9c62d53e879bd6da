"""Writing model files: what is read again is the same model, to the last bit, whatever it holds."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from gains.certificate import model_hash
from gains.model import Actuator, Condition, Matrix, Model, Reference, Trim, Uncertainty, zero_order_hold
from gains.modelfile import Continuous, model_text, save_model
from gains.store import load_model, parse_model, stored
from gains.table import InputError, Table

MODELS = [entry.name for entry in stored() if entry.kind == "model"]
MATRICES = ("A", "B", "E", "C", "D")


def read_again(text: str) -> Model:
    return parse_model(Table.parse(text.encode(), "m.toml"))


def same(one: object, two: object) -> bool:
    """Return whether two models are equal, part by part, every number to the last bit."""
    if isinstance(one, np.ndarray) and isinstance(two, np.ndarray):
        return one.shape == two.shape and one.tobytes() == two.tobytes()
    if hasattr(one, "__dataclass_fields__"):
        return type(one) is type(two) and all(
            same(getattr(one, name), getattr(two, name)) for name in one.__dataclass_fields__
        )
    return one == two


# -- any model

small = st.integers(1, 3)
finite = st.floats(-1e12, 1e12, allow_subnormal=True)
above_0 = st.floats(1e-9, 1e9)
names = st.text(st.characters(codec="utf-8", exclude_categories=("Cs",)), min_size=1, max_size=12)


def matrices(rows: int, columns: int) -> st.SearchStrategy[Matrix]:
    row = st.lists(finite, min_size=columns, max_size=columns)
    table = st.lists(row, min_size=rows, max_size=rows)
    return table.map(lambda values: np.array(values, dtype=np.float64).reshape(rows, columns))


def vectors(length: int, values: st.SearchStrategy[float] = finite) -> st.SearchStrategy[NDArray[np.float64]]:
    return st.lists(values, min_size=length, max_size=length).map(np.array)


@st.composite
def actuators(draw: st.DrawFn, u: NDArray[np.float64]) -> Actuator:
    travel = draw(st.booleans())
    low, high = (u - draw(vectors(len(u), above_0)), u + draw(vectors(len(u), above_0))) if travel else (None, None)
    rate = draw(st.none() | vectors(len(u), above_0))
    return Actuator(low, high, rate, draw(st.none() | vectors(len(u), st.floats(0.0, 10.0))))


@st.composite
def models(draw: st.DrawFn) -> Model:
    nx, nu, ny, nw = draw(small), draw(small), draw(small), draw(st.integers(0, 2))
    states = tuple(draw(st.lists(names, min_size=nx, max_size=nx, unique=True)))
    u = draw(vectors(nu, st.floats(-1e6, 1e6)))
    reference = uncertainty = None
    if draw(st.booleans()):
        nr, nv = draw(small), draw(small)
        Ar = np.tril(draw(matrices(nr, nr)), -1) + np.diag(draw(vectors(nr, st.floats(-0.99, 0.99))))
        reference = Reference(Ar, draw(matrices(nr, nv)), draw(matrices(ny, nr)))
    if draw(st.booleans()):
        rows, columns = draw(small), draw(small)
        F, J1, J2 = draw(matrices(nx, rows)), draw(matrices(columns, nx)), draw(matrices(columns, nu))
        uncertainty = Uncertainty(F, J1, J2, draw(st.floats(0.0, 1.0)))
    return Model(
        name=draw(names),
        Ts=draw(st.sampled_from([0.004, 0.025, 1.0 / 30.0, 0.1])),
        A=draw(matrices(nx, nx)),
        B=draw(matrices(nx, nu)),
        E=draw(matrices(nx, nw)),
        C=draw(matrices(ny, nx)),
        D=draw(matrices(ny, nu)),
        states=states,
        trim=Trim(draw(vectors(nx)), u),
        actuator=draw(st.none() | actuators(u)),
        sensors=draw(st.just({}) | st.just(dict.fromkeys(states, "ATTITUDE.pitch"))),
        reference=reference,
        uncertainty=uncertainty,
        condition=draw(st.none() | st.builds(Condition, above_0, finite)),
    )


@settings(deadline=None, max_examples=60)
@given(models(), st.lists(st.text(max_size=30), max_size=4))
def test_any_model_comes_back_to_the_last_bit_under_any_comment(model: Model, notes: list[str]) -> None:
    text = model_text(model, notes=notes)
    again = read_again(text)
    assert same(again, model)
    assert model_hash(again) == model_hash(model)
    assert model_text(again, notes=notes) == text


@pytest.mark.parametrize("name", MODELS)
def test_stored_models_come_back_to_the_last_bit(name: str, tmp_path: Path) -> None:
    model = load_model(name)
    save_model(tmp_path / "again.toml", model)
    again = load_model(tmp_path / "again.toml")
    assert same(again, model)
    assert model_hash(again) == model_hash(model)


def test_a_continuous_plant_is_held_by_the_reader_to_the_same_bits() -> None:
    Ap, Bp, Ep = np.array([[-0.5427, 1.0], [-1.069, -0.4134]]), np.array([[-0.113], [-3.259]]), np.array([[1.0], [0.0]])
    A, held = zero_order_hold(Ap, np.hstack([Bp, Ep]), 0.025)
    C, D = np.array([[1.0, 0.0]]), np.zeros((1, 1))
    trim = Trim(np.zeros(2), np.zeros(1))
    model = Model("m", 0.025, A, held[:, :1], held[:, 1:], C, D, ("alpha_rad", "q_rad_s"), trim)
    text = model_text(model, plant=Continuous(Ap, Bp, Ep))
    assert same(read_again(text), model)
    plant = tomllib.loads(text)["plant"]
    assert plant["continuous"] is True
    assert plant["A"] == Ap.tolist()


# -- the text

HIRM = load_model("hirm")


def test_a_matrix_has_one_row_per_line() -> None:
    lines = model_text(HIRM).splitlines()
    at = lines.index("A = [")
    assert [line.count(",") for line in lines[at + 1 : at + 4]] == [3, 3, 3]
    assert lines[at + 4] == "]"


@pytest.mark.parametrize("end", ["\n", "\r", "\r\n", "\v", "\f", "\x1c", "\x85", "\u2028", "\u2029"])
def test_no_line_end_breaks_out_of_a_comment(end: str) -> None:
    text = model_text(HIRM, notes=[f"harmless{end}Ts = 9.0", end])
    assert same(read_again(text), HIRM)


@pytest.mark.parametrize("code", [*range(32), 127, 0xD800, 0xDFFF])
def test_no_character_of_a_comment_makes_the_file_unreadable(code: int, tmp_path: Path) -> None:
    save_model(tmp_path / "m.toml", HIRM, notes=[f"a{chr(code)}b"])
    assert same(load_model(tmp_path / "m.toml"), HIRM)


def test_comments_are_at_the_head_and_an_empty_one_is_an_empty_line() -> None:
    lines = model_text(HIRM, notes=["one", "", "two  "]).splitlines()
    assert lines[:4] == ["# one", "#", "# two", ""]
    assert not model_text(HIRM).startswith(("#", "\n"))


@pytest.mark.parametrize("name", ["[1, 2, ]", "[ 0.5,\n]", 'a "b" \\', "# c", "\x00", "\x7f", "größe", "[plant]"])
def test_a_name_is_text_whatever_it_looks_like(name: str) -> None:
    assert read_again(model_text(replace(HIRM, name=name))).name == name


@pytest.mark.parametrize("name", ["", "\ud800", "a\udcffb"])
def test_a_name_that_no_file_has_room_for_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^name: expected a name in UTF-8, found '"):
        save_model(tmp_path / "m.toml", replace(HIRM, name=name))
    assert not any(tmp_path.iterdir())


# -- the file


def test_a_file_is_replaced_as_a_whole_and_readable_by_others(tmp_path: Path) -> None:
    path = tmp_path / "m.toml"
    path.write_text("old")
    save_model(path, HIRM)
    assert same(load_model(path), HIRM)
    assert list(tmp_path.iterdir()) == [path]
    assert path.stat().st_mode & 0o400


@pytest.mark.parametrize("place", ["no/such/m.toml", "file/m.toml", "folder"])
def test_a_file_that_cannot_be_written_is_one_complaint(tmp_path: Path, place: str) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError, match="expected a file that can be written, found: ") as refused:
        save_model(tmp_path / place, HIRM)
    assert "\n" not in str(refused.value)
    assert place.rpartition("/")[2] in str(refused.value)
    assert sorted(tmp_path.rglob("*")) == before
