"""Models and gains in other tools' files, and in python-control."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import control
import numpy as np
import pytest
from click.testing import CliRunner
from scipy.io import savemat

from gains.__main__ import cli
from gains.interop import MAX_BYTES, closed_loop, export_file, from_state_space, import_file, to_state_space
from gains.model import Gains, Model, spectral_radius
from gains.store import load_gains, load_model, stored
from gains.switched import eq9
from gains.table import InputError

MODELS = [entry.name for entry in stored() if entry.kind == "model"]
LAWS = ["hirm-paper", "hirm-d4", "pendulum-paper"]


def same(one: Model, other: Model) -> None:
    assert (one.name, one.Ts, one.states, dict(one.sensors)) == (
        other.name,
        other.Ts,
        other.states,
        dict(other.sensors),
    )
    for key in "ABECD":
        assert np.array_equal(getattr(one, key), getattr(other, key)), key
    for part in ("trim", "actuator", "reference", "uncertainty", "condition"):
        a, b = getattr(one, part), getattr(other, part)
        assert (a is None) == (b is None), part
        if a is not None:
            for key in type(a).__dataclass_fields__:
                assert np.array_equal(getattr(a, key), getattr(b, key)), key


@pytest.mark.parametrize("suffix", [".npz", ".mat"])
@pytest.mark.parametrize("name", MODELS)
def test_a_model_survives_the_way_there_and_back_to_the_last_bit(name: str, suffix: str, tmp_path: Path) -> None:
    export_file(load_model(name), tmp_path / f"m{suffix}")
    found = import_file(tmp_path / f"m{suffix}")
    assert isinstance(found, Model)
    same(load_model(name), found)


@pytest.mark.parametrize("suffix", [".npz", ".mat"])
@pytest.mark.parametrize("name", LAWS)
def test_gains_travel_with_their_model_and_without_their_certificate(name: str, suffix: str, tmp_path: Path) -> None:
    gains = load_gains(name)
    export_file(gains, tmp_path / f"g{suffix}")
    found = import_file(tmp_path / f"g{suffix}")
    assert isinstance(found, Gains)
    assert (found.name, found.d_min, found.d_max) == (gains.name, gains.d_min, gains.d_max)
    assert np.array_equal(found.K1, gains.K1)
    assert found.certificate is None
    same(gains.model, found.model)


def test_matlab_s_own_shapes_are_understood(tmp_path: Path) -> None:
    """Scalars 1 by 1, vectors as rows, names as a cell array, and a workspace with more in it."""
    cells = np.empty((1, 2), dtype=object)
    cells[0, 0], cells[0, 1] = "angle", "rate"
    savemat(tmp_path / "w.mat", {"name": "mine", "Ts": 0.02, "A": [[1.0, 0.02], [0.3, 1.0]], "B": [[0.0], [0.02]],
                                 "states": cells, "trim_x": [[0.1, 0.2]], "other": np.eye(3)})  # fmt: skip
    model = import_file(tmp_path / "w.mat")
    assert isinstance(model, Model)
    assert (model.name, model.Ts, model.states) == ("mine", 0.02, ("angle", "rate"))
    assert model.trim.x.tolist() == [0.1, 0.2]
    assert np.array_equal(model.C, np.eye(2))


def npz(path: Path, **variables: object) -> Path:
    np.savez(path, **variables)  # type: ignore[arg-type]
    return path


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"A": np.zeros((2, 3))}, "A: expected a square matrix"),
        ({"A": np.array([[1.0, np.nan], [0.0, 1.0]])}, "A"),
        ({"A": np.eye(2) * 1j}, "A: expected real numbers"),
        ({"A": np.array([["a", "b"], ["c", "d"]])}, "A: expected an array of numbers"),
        ({"Ts": np.array([0.1, 0.2])}, "Ts: expected a number, found 2"),
        ({"Ts": np.array(-1.0)}, "Ts: expected"),
        ({"states": np.array(["x", "x"])}, "states: expected distinct names"),
        ({"trim_x": np.zeros(3)}, "trim.x: expected"),
    ],
)
def test_what_is_no_model_is_refused_by_name(change: dict[str, object], complaint: str, tmp_path: Path) -> None:
    good = {"name": np.array("m"), "Ts": 0.1, "A": np.eye(2), "B": np.ones((2, 1)), "states": np.array(["x", "v"])}
    import_file(npz(tmp_path / "good.npz", **good))
    with pytest.raises(InputError) as refused:
        import_file(npz(tmp_path / "bad.npz", **{**good, **change}))
    assert f"bad.npz: {complaint}" in str(refused.value).replace("plant.", "")


def test_objects_are_never_unpickled(tmp_path: Path) -> None:
    evil = np.array([print], dtype=object)
    with pytest.raises(InputError, match=r"expected a NumPy \.npz file"):
        import_file(npz(tmp_path / "evil.npz", name=evil, Ts=0.1))


def test_what_would_unpack_to_much_is_refused_before_it_does(tmp_path: Path) -> None:
    inner = io.BytesIO()
    np.save(inner, np.zeros(MAX_BYTES // 8 + 1))
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("A.npy", inner.getvalue())
    assert (tmp_path / "bomb.npz").stat().st_size < 100_000
    with pytest.raises(InputError, match="expected at most 16 MiB unpacked"):
        import_file(tmp_path / "bomb.npz")
    savemat(tmp_path / "bomb.mat", {"A": np.zeros((1500, 1500))}, do_compression=True)
    with pytest.raises(InputError, match="expected at most 16 MiB unpacked"):
        import_file(tmp_path / "bomb.mat")


@pytest.mark.parametrize("name", ["text.npz", "text.mat", "none.npz"])
def test_a_file_that_is_none_is_one_line(name: str, tmp_path: Path) -> None:
    if name != "none.npz":
        (tmp_path / name).write_text("no such thing\n" * 20)
    with pytest.raises(InputError) as refused:
        import_file(tmp_path / name)
    assert "\n" not in str(refused.value)


def test_a_system_of_python_control_and_back_is_the_model() -> None:
    model = load_model("hirm")
    again = from_state_space(to_state_space(model), inputs=1)
    for key in "ABECD":
        assert np.array_equal(getattr(again, key), getattr(model, key))
    assert (again.Ts, again.states, again.name) == (model.Ts, model.states, model.name)


def test_a_continuous_system_is_held_exactly() -> None:
    system = control.ss([[0.0, 1.0], [-2.0, -0.3]], [[0.0], [1.0]], [[1.0, 0.0]], [[0.0]])
    sampled = control.c2d(system, 0.05, "zoh")
    model = from_state_space(system, Ts=0.05)
    assert np.abs(model.A - sampled.A).max() < 1e-12
    assert np.abs(model.B - sampled.B).max() < 1e-12
    with pytest.raises(InputError, match="expected a discrete system with its dt"):
        from_state_space(system)


@pytest.mark.parametrize("d", [0, 1, 3])
def test_the_loop_of_a_constant_delay_answers_as_the_recursion(d: int) -> None:
    gains = load_gains("hirm-paper")
    model, reference = gains.model, gains.model.reference
    assert reference is not None
    assert gains.K2 is not None
    _, e = control.step_response(closed_loop(gains, d), T=np.arange(120) * model.Ts, input=1)
    x, xr, past = np.zeros(3), np.zeros(3), [np.zeros(3)] * d
    for k in range(120):
        delayed = past[0] if d else x
        assert e.ravel()[k] == pytest.approx(float((model.C @ x - reference.Cr @ xr)[0]), abs=1e-12)
        u = gains.K1 @ delayed + gains.K2 @ xr
        past = [*past[1:], x]
        x, xr = model.A @ x + model.B @ u, reference.Ar @ xr + reference.Br[:, 0]


@pytest.mark.parametrize("d", [1, 4, 6])
def test_its_poles_are_those_of_the_lifted_loop(d: int) -> None:
    gains = load_gains("hirm-paper")
    lifted = spectral_radius(eq9(gains, d, d).F[0])
    assert max(abs(closed_loop(gains, d).poles())) == pytest.approx(lifted, abs=1e-9)


def test_the_commands_move_gains_into_matlab_and_back(tmp_path: Path) -> None:
    run = CliRunner().invoke
    assert run(cli, ["export", "hirm-d4", "-o", str(tmp_path / "g.mat")]).exit_code == 0
    assert run(cli, ["import", str(tmp_path / "g.mat"), "-o", str(tmp_path / "g.toml")]).exit_code == 0
    again = load_gains(tmp_path / "g.toml")
    assert np.array_equal(again.K2, load_gains("hirm-d4").K2)
    assert (
        run(cli, ["import", str(tmp_path / "g.mat"), "--model", "hirm", "-o", str(tmp_path / "h.toml")]).exit_code == 0
    )
    assert load_gains(tmp_path / "h.toml").model.name == "hirm"
    assert not (tmp_path / "h-model.toml").exists()


@pytest.mark.parametrize("name", ["hirm-smith", "hirm-dfsm"])
def test_other_controllers_do_not_travel(name: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected gains of the law"):
        export_file(load_gains(name), tmp_path / "g.npz")
