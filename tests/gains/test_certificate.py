"""Certificates in gain files: written, read back, verified; refused where model or gains have changed."""

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tomli_w

from gains.certificate import Certificate, gains_hash, law_hash, model_hash, read_certificate
from gains.lyapunov import eta
from gains.model import Gains, Schedule
from gains.store import load_gains, load_law, load_model, model_path, resolve, save_gains
from gains.table import InputError
from gains.verify import verified

HIRM = replace(load_gains("hirm-paper"), d_max=3)


@pytest.fixture(scope="module")
def certified() -> tuple[Gains, Certificate]:
    found = eta(HIRM, 1, 3, 0.15)
    assert found.certificate is not None
    return replace(HIRM, certificate=found.certificate.table(HIRM, 1e-8, {"numpy": "2"})), found.certificate


def test_a_certificate_survives_its_file_bit_by_bit(tmp_path: Path, certified: tuple[Gains, Certificate]) -> None:
    gains, certificate = certified
    save_gains(tmp_path / "g.toml", gains, "hirm")
    back = load_gains(tmp_path / "g.toml")
    assert (back.name, back.model.name, back.d_min, back.d_max) == ("hirm-paper", "hirm", 1, 3)
    np.testing.assert_array_equal(back.K1, gains.K1)
    read = read_certificate(back)
    assert read is not None
    for name in ("P", "Q", "R"):
        np.testing.assert_array_equal(getattr(read, name), getattr(certificate, name))
    scalars = ("method", "transitions", "d_min", "d_max", "delta_max", "eta", "mu")
    assert [getattr(read, k) for k in scalars] == [getattr(certificate, k) for k in scalars]
    assert verified(back).passed
    assert [path.name for path in tmp_path.iterdir()] == ["g.toml"]


def test_a_gain_file_names_its_model_relative_to_itself(tmp_path: Path) -> None:
    (tmp_path / "models").mkdir()
    (tmp_path / "out").mkdir()
    model = tmp_path / "models" / "m.toml"
    model.write_text(resolve("hirm").read_text())
    save_gains(tmp_path / "out" / "g.toml", HIRM, model)
    assert tomllib.loads((tmp_path / "out" / "g.toml").read_text())["model"] == "../models/m.toml"
    assert model_path(tmp_path / "out" / "g.toml").resolve() == model
    assert load_gains(tmp_path / "out" / "g.toml").model.name == "hirm"


def tampered(path: Path, field: str, value: object) -> str:
    data = tomllib.loads(path.read_text())
    *folders, key = field.split(".")
    inner = data
    for folder in folders:
        inner = inner[folder]
    if value is None:
        del inner[key]
    else:
        inner[key] = value
    path.write_text(tomli_w.dumps(data))
    with pytest.raises(InputError) as caught:
        load_law(path)
    return str(caught.value)


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("K1", [[-0.5054, 3.3877, 3.1152]], ["certificate.sha256.gains: expected the hash of K1 and K2"]),
        ("K2", [[0.2474, -3.2382, -3.1121]], ["certificate.sha256.gains"]),
        ("model", "hirm-printed", ["certificate.sha256.model: expected the hash of model hirm-printed", "changed"]),
        ("certificate.sha256.model", "00", ["certificate.sha256.model"]),
        ("certificate.eta", 0.1, ["certificate.sha256.certificate: expected the hash of the certificate", "changed"]),
        ("certificate.d_max", 9, ["certificate.sha256.certificate"]),
        ("certificate.delta_max", 0.9, ["certificate.sha256.certificate"]),
        ("certificate.P", [[1.0]], ["certificate.sha256.certificate"]),
        ("certificate.sha256.gains", None, ["certificate.sha256.gains: expected a string, found nothing"]),
        ("certificate.sha256", None, ["certificate.sha256: expected a table, found nothing"]),
    ],
)
def test_a_tampered_file_is_refused_by_name(
    tmp_path: Path, certified: tuple[Gains, Certificate], field: str, value: object, words: list[str]
) -> None:
    path = tmp_path / "g.toml"
    save_gains(path, certified[0], "hirm")
    complaint = tampered(path, field, value)
    assert complaint.startswith(f"{path}: ")
    for word in words:
        assert word in complaint


@pytest.mark.parametrize("field", ["P", "Q", "R", "eta", "mu", "d_max", "delta_max"])
def test_changed_numbers_of_the_proof_fail_verification(
    tmp_path: Path, certified: tuple[Gains, Certificate], field: str
) -> None:
    gains, certificate = certified
    worse = {"eta": 0.99, "mu": 0.2, "d_max": 1 / 3, "delta_max": 1.05}.get(field, 0.9)
    value = getattr(certificate, field) * worse
    table = replace(certificate, **{field: int(value) if field == "d_max" else value}).table(gains, 1.0, {})
    save_gains(tmp_path / "g.toml", replace(gains, certificate=table), "hirm")
    assert not verified(load_gains(tmp_path / "g.toml")).passed


def test_a_certificate_without_a_field_is_bad_input(certified: tuple[Gains, Certificate]) -> None:
    gains, _ = certified
    assert gains.certificate is not None
    table = dict(gains.certificate)
    del table["P"]
    with pytest.raises(InputError, match=r"certificate\.P: expected a matrix"):
        verified(replace(gains, certificate=table))


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "g.toml"
    path.write_text("old")
    with pytest.raises(TypeError):
        save_gains(path, replace(HIRM, certificate={"x": object()}), "hirm")
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["g.toml"]


def test_hashes_do_not_depend_on_the_last_bits_of_a_hold_but_on_everything_else() -> None:
    model = load_model("hirm")
    assert model_hash(replace(model, A=model.A * (1 + 4e-16))) == model_hash(model)
    assert model_hash(replace(model, name="other")) == model_hash(model)
    changed = [replace(model, **{k: getattr(model, k) + 1e-6}) for k in "ABECD"]
    changed += [replace(model, Ts=0.026), replace(model, reference=None), replace(model, uncertainty=None)]
    assert len({model_hash(m) for m in [model, *changed]}) == len(changed) + 1
    assert gains_hash(HIRM.K1, HIRM.K2) != gains_hash(np.nextafter(HIRM.K1, 9), HIRM.K2)
    assert gains_hash(HIRM.K1, HIRM.K2) != gains_hash(HIRM.K1, None)
    assert gains_hash(np.zeros((1, 1)), None) == gains_hash(-np.zeros((1, 1)), None)


LOW, HIGH = replace(HIRM, name="s[0]", d_max=2), replace(HIRM, name="s[1]", d_min=2, K1=1.01 * HIRM.K1)
SCHEDULE = Schedule("s", HIRM.model, (LOW, HIGH))


def test_plain_gains_keep_the_hash_of_k1_and_k2() -> None:
    assert law_hash(HIRM) == gains_hash(HIRM.K1, HIRM.K2)
    assert law_hash(replace(HIRM, d_max=9)) == law_hash(HIRM)


def test_the_hash_of_a_schedule_is_of_every_window_and_every_gain_in_their_order() -> None:
    assert HIGH.K2 is not None
    others = [
        (LOW,),
        (LOW, replace(HIGH, d_max=4)),
        (LOW, replace(HIGH, d_min=3)),
        (replace(LOW, K1=HIGH.K1), replace(HIGH, K1=LOW.K1)),
        (LOW, replace(HIGH, K1=np.nextafter(HIGH.K1, 9))),
        (LOW, replace(HIGH, K2=np.nextafter(HIGH.K2, 9))),
    ]
    hashes = {law_hash(Schedule("s", HIRM.model, sets)) for sets in others}
    assert len(hashes | {law_hash(SCHEDULE), law_hash(HIRM)}) == len(others) + 2
    assert law_hash(replace(SCHEDULE, name="other")) == law_hash(SCHEDULE)


def test_a_certificate_of_one_set_of_gains_proves_no_schedule(
    tmp_path: Path, certified: tuple[Gains, Certificate]
) -> None:
    table = certified[1].table(SCHEDULE, 1.0, {})
    save_gains(tmp_path / "s.toml", replace(SCHEDULE, certificate=table), "hirm")
    verification = verified(load_law(tmp_path / "s.toml"))
    assert not verification.passed
    assert verification.reason == ("a schedule cannot be verified: lyapunov certificates speak of one set of gains")
    assert verified(SCHEDULE).reason == "there is no certificate"


@pytest.mark.parametrize(
    ("field", "value"), [("d_max", 3), ("d_min", 3), ("K1", [[1.0, 2.0, 3.0]]), ("K2", [[1.0, 2.0, 3.0]])]
)
def test_a_tampered_schedule_is_refused_by_name(
    tmp_path: Path, certified: tuple[Gains, Certificate], field: str, value: object
) -> None:
    path = tmp_path / "s.toml"
    longer = Schedule("s", HIRM.model, (LOW, replace(HIGH, d_max=4)))
    save_gains(path, replace(longer, certificate=certified[1].table(longer, 1.0, {})), "hirm")
    data = tomllib.loads(path.read_text())
    data["window"][1][field] = value
    complaint = tampered(path, "window", data["window"])
    assert "certificate.sha256.gains: expected the hash of the windows and their K1 and K2" in complaint
