"""Model and gain files: what is stored, what is refused and in which words."""

import contextlib
import copy
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st

from gains.certificate import claim_hash, gains_hash, law_hash, model_hash
from gains.model import Gains, Model, Schedule, sets_of
from gains.steady import equilibrium
from gains.store import (
    DELAY_LIMIT,
    load,
    load_gains,
    load_law,
    load_model,
    parse_gains,
    parse_law,
    parse_model,
    resolve,
    save_gains,
    stored,
)
from gains.table import InputError, Table
from gains.verify import verified

MODEL: dict[str, Any] = {
    "name": "m",
    "Ts": 0.025,
    "plant": {
        "continuous": False,
        "A": [[0.9, 0.1], [0.0, 1.0]],
        "B": [[0.0], [1.0]],
        "E": [[1.0], [0.0]],
        "C": [[1.0, 0.0]],
        "D": [[0.5]],
        "states": ["a_rad", "b_rad_s"],
    },
    "trim": {"x": [0.1, 0.0], "u": [0.2]},
    "actuator": {"low": [-1.0], "high": [1.0], "rate": [2.0], "tau": [0.0]},
    "sensors": {"a_rad": "ATTITUDE.pitch", "b_rad_s": "ATTITUDE.pitchspeed"},
    "reference": {"Ar": [[0.5]], "Br": [[0.5]], "Cr": [[1.0]]},
    "uncertainty": {"F": [[1.0], [0.0]], "J1": [[0.1, 0.2]], "J2": [[0.3]], "delta_max": 0.15},
    "condition": {"airspeed_m_s": 100.0, "altitude_m": -10.0},
}
GAINS: dict[str, Any] = {
    "name": "g",
    "model": "hirm",
    "d_min": 1,
    "d_max": 4,
    "K1": [[1.0, 2.0, 3.0]],
    "K2": [[1.0, 2.0, 3.0]],
}
SCHEDULE: dict[str, Any] = {
    "name": "s",
    "model": "hirm",
    "window": [
        {"d_min": 1, "d_max": 3, "K1": [[1.0, 2.0, 3.0]], "K2": [[4.0, 5.0, 6.0]]},
        {"d_min": 2, "d_max": 4, "K1": [[1.5, 2.0, 3.0]], "K2": [[4.5, 5.0, 6.0]]},
        {"d_min": 5, "d_max": 6, "K1": [[1.7, 2.0, 3.0]], "K2": [[4.7, 5.0, 6.0]]},
    ],
}
GONE = object()


def changed(base: dict[str, Any], field: str, value: object) -> dict[str, Any]:
    """A deep copy with one field, "plant.A", set or removed."""
    result = copy.deepcopy(base)
    *folders, key = field.split(".")
    inner = result
    for folder in folders:
        inner = inner[folder]
    if value is GONE:
        del inner[key]
    else:
        inner[key] = value
    return result


def complaint_of(read: Callable[[Table], object], data: dict[str, Any]) -> str:
    with pytest.raises(InputError) as caught:
        read(Table(data, "f.toml"))
    return str(caught.value)


def test_a_model_is_read_as_written() -> None:
    model = parse_model(Table(copy.deepcopy(MODEL), "f.toml"))
    assert (model.name, model.Ts, model.Ts_ns) == ("m", 0.025, 25_000_000)
    assert (model.nx, model.nu, model.ny, model.nw, model.nr) == (2, 1, 1, 1, 1)
    for name in "ABECD":
        assert getattr(model, name).tolist() == MODEL["plant"][name]
    assert model.states == ("a_rad", "b_rad_s")
    assert model.trim.x.tolist() == [0.1, 0.0]
    assert model.actuator is not None
    assert model.actuator.rate is not None
    assert model.actuator.rate.tolist() == [2.0]
    assert model.sensors == MODEL["sensors"]
    assert model.uncertainty is not None
    assert model.uncertainty.delta_max == 0.15
    assert model.condition is not None
    assert model.condition.airspeed_m_s == 100.0


def test_what_a_model_leaves_out_gets_the_documented_default() -> None:
    plant = {key: MODEL["plant"][key] for key in ("continuous", "A", "B", "states")}
    model = parse_model(Table({"name": "m", "Ts": 0.1, "plant": plant}, "f.toml"))
    assert model.E.shape == (2, 0)
    assert model.C.tolist() == [[1.0, 0.0], [0.0, 1.0]]
    assert model.D.tolist() == [[0.0], [0.0]]
    assert (model.trim.x == 0.0).all()
    assert (model.trim.u == 0.0).all()
    assert [model.actuator, model.reference, model.uncertainty, model.condition] == [None] * 4
    assert model.sensors == {}


def test_only_the_plant_of_a_continuous_model_is_held() -> None:
    model = parse_model(Table(changed(MODEL, "plant.continuous", True), "f.toml"))
    assert model.A[0, 0] == pytest.approx(np.exp(0.9 * 0.025))
    assert model.E.shape == (2, 1)
    assert model.E[0, 0] == pytest.approx(np.expm1(0.9 * 0.025) / 0.9)
    assert model.C.tolist() == MODEL["plant"]["C"]
    assert model.reference is not None
    assert model.uncertainty is not None
    assert model.reference.Ar.tolist() == [[0.5]]
    assert model.uncertainty.F.tolist() == [[1.0], [0.0]]


MODEL_COMPLAINTS = [
    ("name", GONE, "name: expected a string, found nothing"),
    ("name", 3, "name: expected a string, found 3"),
    ("Ts", 0, "Ts: expected a number from 1e-06 to 3600, found 0"),
    ("Ts", -0.1, "Ts: expected a number from 1e-06 to 3600, found -0.1"),
    ("Ts", float("nan"), "Ts: expected a finite number from 1e-06 to 3600, found nan"),
    ("Ts", True, "Ts: expected a number from 1e-06 to 3600, found the boolean true"),
    ("plant", GONE, "plant: expected a table, found nothing"),
    ("plant", 1, "plant: expected a table, found 1"),
    ("plant.continuous", GONE, "plant.continuous: expected true or false, found nothing"),
    ("plant.A", [[1.0, 2.0]], "plant.A: expected a square matrix, found 1 by 2"),
    ("plant.A", [[1.0, 2.0], [1.0]], "plant.A[1]: expected 2 columns, found 1"),
    ("plant.A", [[1.0, 0.0], [0.0, float("inf")]], "plant.A[1][1]: expected a finite number, found inf"),
    ("plant.B", [[1.0], [1.0], [1.0]], "plant.B: expected 2 rows, found 3"),
    ("plant.B", [0.0, 1.0], "plant.B[0]: expected a row of numbers, found 0.0"),
    ("plant.E", [[1.0]], "plant.E: expected 2 rows, found 1"),
    ("plant.C", [[1.0]], "plant.C: expected 2 columns, found 1"),
    ("plant.D", [[0.0, 0.0]], "plant.D: expected 1 column, found 2"),
    ("plant.D", [[0.0], [0.0]], "plant.D: expected 1 row, found 2"),
    ("plant.states", ["a_rad"], "plant.states: expected 2 strings, found 1"),
    ("plant.states", ["a_rad", "a_rad"], "plant.states: expected distinct names, found a_rad twice"),
    ("plant.state", [], "plant.state: expected one of continuous, A, B, E, C, D, states, "
                        "found an unknown key; did you mean states?"),
    ("trim.x", [0.0], "trim.x: expected 2 numbers, found 1"),
    ("trim.u", [2.0], "trim.u[0]: expected a number in the travel of [actuator], -1 to 1, found 2"),
    ("actuator.low", [1.0], "actuator.high[0]: expected a number above low (1), found 1"),
    ("actuator.low", [2.0], "actuator.high[0]: expected a number above low (2), found 1"),
    ("actuator.high", GONE, "actuator.high: expected an array of 1 number, found nothing"),
    ("actuator.high", [1.0, 1.0], "actuator.high: expected 1 number, found 2"),
    ("actuator.rate", [0.0], "actuator.rate[0]: expected a number above 0, found 0.0"),
    ("actuator.tau", [-0.1], "actuator.tau[0]: expected a number of at least 0, found -0.1"),
    ("sensors.a_rad", GONE, "sensors.a_rad: expected MESSAGE.field, such as ATTITUDE.pitch, found nothing"),
    ("sensors.a_rad", "pitch", 'sensors.a_rad: expected MESSAGE.field, such as ATTITUDE.pitch, '
                               'found the string "pitch"'),
    ("sensors.a_ra", "ATTITUDE.pitch", "sensors.a_ra: expected a state (a_rad, b_rad_s), "
                                       "found an unknown name; did you mean a_rad?"),
    ("reference.Ar", [[1.0, 0.0]], "reference.Ar: expected a square matrix, found 1 by 2"),
    ("reference.Ar", [[1.0]], "reference.Ar: expected a Schur matrix (spectral radius below 1), "
                              "found spectral radius 1"),
    ("reference.Br", [[1.0], [1.0]], "reference.Br: expected 1 row, found 2"),
    ("reference.Cr", [[1.0], [1.0]], "reference.Cr: expected 1 row, found 2"),
    ("reference.Cr", [[1.0, 1.0]], "reference.Cr: expected 1 column, found 2"),
    ("uncertainty.F", [[1.0]], "uncertainty.F: expected 2 rows, found 1"),
    ("uncertainty.J1", [[1.0]], "uncertainty.J1: expected 2 columns, found 1"),
    ("uncertainty.J2", [[1.0], [1.0]], "uncertainty.J2: expected 1 row, found 2"),
    ("uncertainty.delta_max", -0.1, "uncertainty.delta_max: expected a number of at least 0, found -0.1"),
    ("uncertainty.delta_max", GONE, "uncertainty.delta_max: expected a number of at least 0, found nothing"),
    ("condition.airspeed_m_s", 0, "condition.airspeed_m_s: expected a number above 0, found 0"),
    ("refrence", {}, "refrence: expected one of name, Ts, plant, actuator, trim, sensors, reference, "
                     "uncertainty, condition, found an unknown key; did you mean reference?"),
]  # fmt: skip


@pytest.mark.parametrize(("field", "value", "complaint"), MODEL_COMPLAINTS)
def test_a_wrong_model_is_refused_in_one_exact_line(field: str, value: object, complaint: str) -> None:
    assert complaint_of(parse_model, changed(MODEL, field, value)) == f"f.toml: {complaint}"


def test_neutral_outside_the_travel_is_refused_without_a_trim_too() -> None:
    data = changed(changed(MODEL, "trim", GONE), "actuator.low", [0.5])
    complaint = "trim.u[0]: expected a number in the travel of [actuator], 0.5 to 1, found 0"
    assert complaint_of(parse_model, data) == f"f.toml: {complaint}"


def test_a_plant_that_overflows_within_a_sample_is_refused() -> None:
    data = changed(changed(MODEL, "plant.continuous", True), "plant.A", [[1e6, 0.0], [0.0, 1.0]])
    complaint = "plant.A: expected a finite zero-order hold at Ts = 0.025 s, found an overflow"
    assert complaint_of(parse_model, data) == f"f.toml: {complaint}"


GAINS_COMPLAINTS = [
    ("name", GONE, "name: expected a string, found nothing"),
    ("model", 1, "model: expected a string, found 1"),
    ("model", "hirn", "model: hirn: expected a stored name or a file, found neither; did you mean hirm?"),
    ("d_min", -1, "d_min: expected an integer from 0 to 1000, found -1"),
    ("d_min", GONE, "d_min: expected an integer from 0 to 1000, found nothing"),
    ("d_min", 1.0, "d_min: expected an integer from 0 to 1000, found 1.0"),
    ("d_min", 5, "d_max: expected an integer from 5 to 1000, found 4"),
    ("d_max", True, "d_max: expected an integer from 1 to 1000, found the boolean true"),
    ("d_max", DELAY_LIMIT + 1, "d_max: expected an integer from 1 to 1000, found 1001"),
    ("K1", [[1.0, 2.0]], "K1: expected 3 columns, found 2"),
    ("K1", [[1.0, 2.0, 3.0]] * 2, "K1: expected 1 row, found 2"),
    ("K1", GONE, "K1: expected a matrix (an array of rows), found nothing"),
    ("K2", [[1.0]], "K2: expected 3 columns, found 1"),
    ("K2", GONE, "K2: expected a matrix (an array of rows), found nothing"),
    ("certificate", 1, "certificate: expected a table, found 1"),
    ("certficate", {}, "certficate: expected one of name, model, d_min, d_max, controller, K1, K2, certificate, "
                       "conservative, found an unknown key; did you mean certificate?"),
    ("conservativ", "hirm-d6", "conservativ: expected one of name, model, d_min, d_max, controller, K1, K2, "
                               "certificate, conservative, found an unknown key; did you mean conservative?"),
    ("conservative", 6, "conservative: expected a string, found 6"),
    ("conservative", "", 'conservative: expected a string, found the string ""'),
    ("conservative", {}, "conservative: expected a string, found a table"),
    ("conservative", "hirm-d7", "conservative: hirm-d7: expected a stored name or a file, found neither; "
                                "did you mean hirm-d6?"),
    ("conservative", "hirm", "conservative: expected one set of gains (d_min, d_max, K1), found hirm, a model"),
    ("conservative", "hirm-d3", "conservative: expected gains without conservative ones of their own, "
                                "found hirm-d3, which has some"),
    ("conservative", "pendulum-paper", "conservative: expected gains for the same model (hirm: Ts, states, trim and "
                                       "matrices), found pendulum-paper, for another (pendulum)"),
    ("conservative", "hirm-paper", "conservative: expected gains for delays from 1 or less to 5 or more, "
                                   "found hirm-paper, for 1 to 4"),
    ("window", [{}], "window: expected one set of gains (d_min, d_max, K1), found a schedule"),
]  # fmt: skip


@pytest.mark.parametrize(("field", "value", "complaint"), GAINS_COMPLAINTS)
def test_wrong_gains_are_refused_in_one_exact_line(field: str, value: object, complaint: str) -> None:
    assert complaint_of(parse_gains, changed(GAINS, field, value)) == f"f.toml: {complaint}"


def test_reference_gains_without_a_reference_are_refused() -> None:
    data = GAINS | {"model": "pendulum", "K1": [[1.0, 2.0]]}
    complaint = "K2: expected none, as model pendulum has no [reference], found one"
    assert complaint_of(parse_gains, data) == f"f.toml: {complaint}"


def test_a_certificate_is_kept_as_it_is() -> None:
    plain = parse_gains(Table(GAINS, "f.toml"))
    hashes = {"model": model_hash(plain.model), "gains": gains_hash(plain.K1, plain.K2)}
    claim = {"method": "exact", "anything": [1, {"deep": True}]}
    certificate = claim | {"sha256": hashes | {"certificate": claim_hash(claim)}}
    gains = parse_gains(Table(GAINS | {"certificate": certificate}, "f.toml"))
    assert gains.certificate == certificate
    assert parse_gains(Table(GAINS, "f.toml")).certificate is None


def test_a_schedule_is_read_as_written() -> None:
    schedule = parse_law(Table(SCHEDULE, "f.toml"))
    assert isinstance(schedule, Schedule)
    assert (schedule.name, schedule.model.name, schedule.d_min, schedule.d_max) == ("s", "hirm", 1, 6)
    assert [(g.name, g.d_min, g.d_max) for g in schedule.sets] == [("s[0]", 1, 3), ("s[1]", 2, 4), ("s[2]", 5, 6)]
    for gains, window in zip(schedule.sets, SCHEDULE["window"], strict=True):
        assert gains.K2 is not None
        assert (gains.K1.tolist(), gains.K2.tolist()) == (window["K1"], window["K2"])
    assert schedule.certificate is None


def test_a_schedule_without_a_reference_model_has_no_k2() -> None:
    data = {"name": "s", "model": "pendulum", "window": [{"d_min": 1, "d_max": 2, "K1": [[1.0, 2.0]]}]}
    law = parse_law(Table(data, "f.toml"))
    assert [gains.K2 for gains in sets_of(law)] == [None]


def windows(index: int, field: str, value: object) -> dict[str, Any]:
    """The schedule with one field of one window set or removed."""
    data = copy.deepcopy(SCHEDULE)
    data["window"][index] = changed(data["window"][index], field, value)
    return data


SCHEDULE_COMPLAINTS = [
    (windows(0, "d_min", GONE), "window[0].d_min: expected an integer from 0 to 1000, found nothing"),
    (windows(0, "d_min", 4), "window[0].d_max: expected an integer from 4 to 1000, found 3"),
    (windows(1, "d_max", 1001), "window[1].d_max: expected an integer from 2 to 1000, found 1001"),
    (windows(1, "d_max", 3), "window[1].d_max: expected a number above 3, by the window before, found 3"),
    (windows(2, "d_min", 6), "window[2].d_min: expected a number from 3 to 5, by the window before, found 6"),
    (windows(2, "d_min", 2), "window[2].d_min: expected a number from 3 to 5, by the window before, found 2"),
    (windows(2, "d_max", 5) | {"window": [*SCHEDULE["window"][::-1]]},
     "window[1].d_min: expected a number from 6 to 7, by the window before, found 2"),
    (SCHEDULE | {"window": [SCHEDULE["window"][0]] * 2},
     "window[1].d_min: expected a number from 2 to 4, by the window before, found 1"),
    (windows(0, "K1", [[1.0, 2.0]]), "window[0].K1: expected 3 columns, found 2"),
    (windows(1, "K2", GONE), "window[1].K2: expected a matrix (an array of rows), found nothing"),
    (windows(1, "K3", [[1.0]]), "window[1].K3: expected one of d_min, d_max, K1, K2, found an unknown key"),
    (SCHEDULE | {"model": "pendulum"}, "window[0].K1: expected 2 columns, found 3"),
    (SCHEDULE | {"window": []}, "window: expected at least one window, found none"),
    (SCHEDULE | {"window": 3}, "window: expected an array of tables, found 3"),
    (SCHEDULE | {"window": [1]}, "window[0]: expected a table, found 1"),
    (SCHEDULE | {"K1": [[1.0, 2.0, 3.0]]}, "K1: expected one of name, model, window, certificate, conservative, "
                                           "found an unknown key"),
    (windows(0, "conservative", "hirm-d6"), "window[0].conservative: expected one of d_min, d_max, K1, K2, "
                                            "found an unknown key"),
    (SCHEDULE | {"conservative": "hirm-d6"}, "conservative: expected gains for delays from 1 or less to 7 or more, "
                                             "found hirm-d6, for 1 to 6"),
    (SCHEDULE | {"certificate": 1}, "certificate: expected a table, found 1"),
    (changed(SCHEDULE, "name", GONE), "name: expected a string, found nothing"),
]  # fmt: skip


@pytest.mark.parametrize(("data", "complaint"), SCHEDULE_COMPLAINTS)
def test_a_wrong_schedule_is_refused_in_one_exact_line(data: dict[str, Any], complaint: str) -> None:
    assert complaint_of(parse_law, data) == f"f.toml: {complaint}"


@pytest.mark.parametrize("data", [SCHEDULE, windows(0, "K1", GONE), SCHEDULE | {"window": 3}])
def test_where_one_set_of_gains_is_wanted_a_schedule_is_refused_as_one(data: dict[str, Any]) -> None:
    complaint = "window: expected one set of gains (d_min, d_max, K1), found a schedule"
    assert complaint_of(parse_gains, data) == f"f.toml: {complaint}"


def test_a_schedule_survives_its_file_bit_by_bit(tmp_path: Path) -> None:
    schedule = parse_law(Table(windows(1, "K1", [[0.1 + 0.2, -1e-17, np.pi]]), "f.toml"))
    save_gains(tmp_path / "s.toml", schedule, "hirm")
    assert (tmp_path / "s.toml").read_text().count("[[window]]") == 3
    back = load_law(tmp_path / "s.toml")
    assert isinstance(back, Schedule)
    assert isinstance(load(tmp_path / "s.toml"), Schedule)
    assert (back.name, back.model.name, back.certificate) == ("s", "hirm", None)
    for read, written in zip(back.sets, sets_of(schedule), strict=True):
        assert (read.name, read.d_min, read.d_max) == (written.name, written.d_min, written.d_max)
        np.testing.assert_array_equal(read.K1, written.K1)
        np.testing.assert_array_equal(np.array(read.K2), np.array(written.K2))
    with pytest.raises(InputError, match=r"s\.toml: window: expected one set of gains .*, found a schedule$"):
        load_gains(tmp_path / "s.toml")


def gain_file(path: Path, **fields: object) -> Path:
    """Write gains for hirm, window 1 to 4, with fields set otherwise."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(tomli_w.dumps(GAINS | fields))
    return path


def model_file(path: Path, field: str, value: object) -> Path:
    """Write the model hirm under another name, with one field set otherwise."""
    data = tomllib.loads(resolve("hirm").read_text())
    path.write_text(tomli_w.dumps(changed(data, field, value) | {"name": "other"}))
    return path


def refusal(path: Path) -> str:
    """What is said of a file after its name."""
    with pytest.raises(InputError) as caught:
        load_law(path)
    return str(caught.value).removeprefix(f"{path}: ")


@pytest.mark.parametrize("data", [GAINS, windows(2, "d_max", 5)], ids=["gains", "schedule"])
def test_a_law_comes_with_the_conservative_gains_that_its_file_names(data: dict[str, Any]) -> None:
    law = parse_law(Table(data | {"conservative": "hirm-d6"}, "f.toml"))
    conservative = law.conservative
    assert isinstance(conservative, Gains)
    assert (conservative.name, conservative.d_min, conservative.d_max) == ("hirm-d6", 1, 6)
    assert conservative.model is law.model
    assert conservative.conservative is None
    assert law.conservative_file == resolve("hirm-d6")
    assert parse_law(Table(data, "f.toml")).conservative is None


def test_stored_designs_fall_back_on_the_one_of_the_widest_window() -> None:
    for name in ("hirm-d3", "hirm-d4"):
        conservative = load_law(name).conservative
        assert conservative is not None
        assert conservative.name == "hirm-d6"
        assert verified(conservative).passed
    assert load_law("hirm-d6").conservative is None


def test_conservative_gains_are_no_part_of_what_a_certificate_is_for() -> None:
    law = load_gains("hirm-d3")
    assert verified(law).passed
    assert verified(replace(law, conservative=None)).passed
    assert law_hash(law) == law_hash(replace(law, conservative=None))


def test_just_a_wider_window_around_the_first_is_conservative(tmp_path: Path) -> None:
    narrow = gain_file(tmp_path / "narrow.toml", d_min=1, d_max=3, conservative="wide.toml")
    for d_min in range(6):
        for d_max in range(d_min, 6):
            gain_file(tmp_path / "wide.toml", name="w", d_min=d_min, d_max=d_max)
            if d_min <= 1 and d_max > 3:
                assert load_gains(narrow).conservative is not None
            else:
                asked = "gains for delays from 1 or less to 4 or more"
                assert refusal(narrow) == f"conservative: expected {asked}, found w, for {d_min} to {d_max}"


def test_conservative_gains_are_one_set(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(tomli_w.dumps(SCHEDULE))
    file = gain_file(tmp_path / "g.toml", conservative="s.toml")
    asked = "one set of gains (d_min, d_max, K1)"
    assert refusal(file) == f"conservative: expected {asked}, found s.toml, a schedule"


@pytest.mark.parametrize("name", ["g.toml", "./g.toml", "../here/g.toml", "link.toml"])
def test_gains_are_not_their_own_conservative_ones(name: str, tmp_path: Path) -> None:
    file = gain_file(tmp_path / "here" / "g.toml", conservative=name)
    (tmp_path / "here" / "link.toml").symlink_to(file)
    assert refusal(file) == "conservative: expected another file, found this one"


def test_conservative_gains_make_no_chain_and_no_circle(tmp_path: Path) -> None:
    one = gain_file(tmp_path / "one.toml", d_max=2, conservative="two.toml")
    two = gain_file(tmp_path / "two.toml", d_max=3, conservative="one.toml")
    asked = "gains without conservative ones of their own"
    assert refusal(one) == f"conservative: expected {asked}, found two.toml, which has some"
    assert refusal(two) == f"conservative: expected {asked}, found one.toml, which has some"


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("Ts", 0.03),
        ("plant.states", ["q_rad_s", "alpha_rad", "theta_rad"]),
        ("plant.B", [[-0.113], [-3.259], [0.001]]),
        ("trim", {"x": [0.01, 0.0, 0.0]}),
        ("trim", {"u": [0.01]}),
        ("uncertainty.J2", [[0.5]]),
    ],
)
def test_conservative_gains_for_another_model_are_refused(field: str, value: object, tmp_path: Path) -> None:
    model_file(tmp_path / "other.toml", field, value)
    gain_file(tmp_path / "wide.toml", name="w", model="other.toml", d_max=6)
    file = gain_file(tmp_path / "g.toml", conservative="wide.toml")
    asked = "gains for the same model (hirm: Ts, states, trim and matrices)"
    assert refusal(file) == f"conservative: expected {asked}, found w, for another (other)"


def test_a_model_of_another_name_and_the_same_content_is_the_same_model(tmp_path: Path) -> None:
    model_file(tmp_path / "other.toml", "uncertainty.delta_max", 0.1)
    gain_file(tmp_path / "wide.toml", model="other.toml", d_max=6)
    law = load_gains(gain_file(tmp_path / "g.toml", conservative="wide.toml"))
    assert law.conservative is not None
    assert law.conservative.model is law.model


@pytest.mark.parametrize(
    ("fields", "complaint"),
    [
        ({"K1": [[1.0]]}, "K1: expected 3 columns, found 1"),
        ({"d_mox": 6}, "d_mox: expected one of name, model, d_min, d_max, controller, K1, K2, certificate, "
                       "found an unknown key; did you mean d_max?"),
        ({"certificate": {}}, "certificate.sha256: expected a table, found nothing"),
        ({"model": "nowhere"}, "model: nowhere: expected a stored name or a file, found neither"),
    ],
)  # fmt: skip
def test_a_fault_in_conservative_gains_names_their_file(fields: dict[str, Any], complaint: str, tmp_path: Path) -> None:
    wide = gain_file(tmp_path / "wide.toml", **({"d_max": 6} | fields))
    assert refusal(gain_file(tmp_path / "g.toml", conservative="wide.toml")) == f"{wide}: {complaint}"


@pytest.mark.parametrize("data", [GAINS, windows(2, "d_max", 5)], ids=["gains", "schedule"])
@pytest.mark.parametrize(
    ("given", "written"), [("hirm-d6", "hirm-d6"), ("sub/wide.toml", "../a/sub/wide.toml"), ("../w.toml", "../w.toml")]
)
def test_a_saved_law_names_its_conservative_gains_from_its_own_place(
    data: dict[str, Any], given: str, written: str, tmp_path: Path
) -> None:
    for name in ("a/sub/wide.toml", "w.toml"):
        gain_file(tmp_path / name, d_max=6, K1=[[0.1 + 0.2, 2.0, 3.0]])
    (tmp_path / "a" / "g.toml").write_text(tomli_w.dumps(data | {"conservative": given}))
    law = load_law(tmp_path / "a" / "g.toml")
    (tmp_path / "b").mkdir()
    save_gains(tmp_path / "b" / "g.toml", law, "hirm")
    assert tomllib.loads((tmp_path / "b" / "g.toml").read_text())["conservative"] == written
    back = load_law(tmp_path / "b" / "g.toml").conservative
    assert law.conservative is not None
    assert back is not None
    assert (back.name, back.d_min, back.d_max) == (law.conservative.name, 1, 6)
    np.testing.assert_array_equal(back.K1, law.conservative.K1)


def test_a_law_without_conservative_gains_is_saved_without_the_key(tmp_path: Path) -> None:
    for law in (load_gains("hirm-paper"), replace(load_gains("hirm-d3"), conservative=None)):
        save_gains(tmp_path / "g.toml", law, "hirm")
        assert "conservative" not in tomllib.loads((tmp_path / "g.toml").read_text())


def test_a_law_that_outgrows_its_conservative_gains_is_not_saved(tmp_path: Path) -> None:
    path, law = tmp_path / "g.toml", load_gains("hirm-d3")
    save_gains(path, replace(law, d_max=5, certificate=None), "hirm")
    before = path.read_bytes()
    for window in ({"d_max": 6}, {"d_min": 0}):
        with pytest.raises(InputError, match=r"g\.toml: conservative: expected gains .*, found hirm-d6, for 1 to 6$"):
            save_gains(path, replace(law, **window), "hirm")
    assert path.read_bytes() == before


def test_a_law_does_not_replace_its_conservative_gains(tmp_path: Path) -> None:
    wide = gain_file(tmp_path / "wide.toml", d_max=6)
    law, before = load_gains(gain_file(tmp_path / "g.toml", conservative="wide.toml")), wide.read_bytes()
    with pytest.raises(InputError, match=r"wide\.toml: conservative: expected another file, found this one$"):
        save_gains(wide, law, "hirm")
    assert wide.read_bytes() == before


def test_a_law_of_one_set_is_its_gains() -> None:
    gains = load_law("hirm-paper")
    assert isinstance(gains, Gains)
    assert (gains.K1 == load_gains("hirm-paper").K1).all()
    with pytest.raises(InputError, match=r"hirm\.toml: expected a gain file .*, found a model file$"):
        load_law("hirm")


def test_one_kind_of_file_is_not_the_other() -> None:
    with pytest.raises(InputError, match=r"hirm-paper\.toml: expected a model file .*, found a gain file$"):
        load_model("hirm-paper")
    with pytest.raises(InputError, match=r"hirm\.toml: expected a gain file .*, found a model file$"):
        load_gains("hirm")
    assert isinstance(load("hirm"), Model)
    assert isinstance(load("hirm-paper"), Gains)


def test_stored_files_load_under_their_own_names() -> None:
    entries = stored()
    assert [(e.name, e.kind) for e in entries] == [
        ("hirm", "model"), ("hirm-6dof", "model"), ("hirm-printed", "model"), ("pendulum", "model"),
        ("pendulum-exact", "model"),
        ("hirm-6dof-d6", "gains"), ("hirm-d3", "gains"), ("hirm-d4", "gains"), ("hirm-d6", "gains"),
        ("hirm-dfsm", "gains"), ("hirm-lq", "gains"), ("hirm-paper", "gains"), ("hirm-smith", "gains"),
        ("pendulum-exact-paper", "gains"), ("pendulum-paper", "gains"),
    ]  # fmt: skip
    for entry in entries:
        item = load(entry.name)
        assert item.name == entry.name
        model = item if isinstance(item, Model) else item.model
        assert set(model.sensors) == set(model.states)
        assert model.actuator is not None


@pytest.mark.parametrize(
    ("name", "window", "eta"),
    [
        ("hirm-d3", (1, 3), 0.0755),
        ("hirm-d4", (1, 4), 0.1175),
        ("hirm-d6", (1, 6), 0.21),
        ("pendulum-exact-paper", (1, 7), None),
    ],
)
def test_stored_designs_carry_a_certificate_that_verifies(
    name: str, window: tuple[int, int], eta: float | None
) -> None:
    gains = load_gains(name)
    assert (gains.d_min, gains.d_max) == window
    assert verified(gains).passed
    assert gains.certificate is not None
    assert gains.certificate["method"] == "exact"
    if eta is not None:
        assert gains.certificate["eta"] <= eta
        at = equilibrium(gains.model)
        assert at is not None
        assert gains.K2 is not None
        np.testing.assert_allclose(np.hstack([gains.K1, gains.K2]) @ at.z, at.u, atol=1e-12)


def test_stored_gains_carry_the_printed_windows_and_no_certificate() -> None:
    windows = {name: load_gains(name) for name in ("hirm-paper", "pendulum-paper")}
    assert {name: (g.d_min, g.d_max) for name, g in windows.items()} == {
        "hirm-paper": (1, 4),
        "pendulum-paper": (1, 6),
    }
    assert all(g.certificate is None for g in windows.values())
    assert windows["pendulum-paper"].K2 is None


def test_both_hirm_models_differ_in_the_plant_only() -> None:
    folder = resolve("hirm").parent
    exact, printed = (tomllib.loads((folder / f"{n}.toml").read_text()) for n in ("hirm", "hirm-printed"))
    for data in (exact, printed):
        del data["name"]
        for key in ("continuous", "A", "B", "E"):
            del data["plant"][key]
    assert exact == printed


def test_flight_condition_of_hirm_is_mach_0_3_in_the_standard_atmosphere() -> None:
    condition = load_model("hirm").condition
    assert condition is not None
    temperature_k = 288.15 - 0.0065 * condition.altitude_m
    assert condition.airspeed_m_s == pytest.approx(0.3 * np.sqrt(1.4 * 287.05287 * temperature_k), abs=0.01)


def test_exact_pendulum_is_the_one_of_the_physical_constants() -> None:
    data = tomllib.loads(resolve("pendulum-exact").read_text())
    M, m, length, g = 8.0, 2.0, 0.5, 9.8
    a = 3 * (M + m) * g / (length * (4 * M + m))
    b = -3 / (length * (4 * M + m))
    assert data["plant"]["A"] == [[0.0, 1.0], [a, 0.0]]
    assert data["plant"]["B"] == [[0.0], [b]]


def test_a_stored_name_wins_over_a_file_of_that_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "hirm").write_text("not toml")
    assert load_model("hirm").nx == 3
    with pytest.raises(InputError, match=r"^\./hirm|^hirm: expected TOML"):
        load_model("./hirm")


def test_the_model_of_gains_is_found_relative_to_their_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "a" / "plant.toml").write_text(resolve("pendulum").read_text())
    text = 'name = "g"\nmodel = "../plant.toml"\nd_min = 1\nd_max = 2\nK1 = [[1, 2]]\n'
    (tmp_path / "a" / "b" / "g.toml").write_text(text)
    monkeypatch.chdir("/")
    assert load_gains(tmp_path / "a" / "b" / "g.toml").model.name == "pendulum"


def test_a_fault_in_the_model_of_gains_names_the_model_file(tmp_path: Path) -> None:
    (tmp_path / "plant.toml").write_text('name = "p"\nTs = 0\n')
    (tmp_path / "g.toml").write_text('name = "g"\nmodel = "plant.toml"\nd_min = 1\nd_max = 2\nK1 = [[1]]\n')
    with pytest.raises(InputError, match=r"plant\.toml: Ts: expected a number from 1e-06 to 3600, found 0$"):
        load_gains(tmp_path / "g.toml")


@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("hirmm", "hirmm: expected a stored name or a file, found neither; did you mean hirm?"),
        ("./nowhere/x.toml", "./nowhere/x.toml: expected a stored name or a file, found neither"),
        ("a\0b", r"a\x00b: expected a "),
    ],
)
def test_a_name_that_is_nothing_is_refused(name: str, complaint: str) -> None:
    with pytest.raises(InputError) as caught:
        load(name)
    assert str(caught.value).startswith(complaint)


FIELDS = [f"{key}" for key in MODEL] + [
    f"{key}.{inner}" for key, value in MODEL.items() if isinstance(value, dict) for inner in value
]
NUMBERS = st.floats() | st.integers() | st.booleans()
VALUES = st.recursive(NUMBERS | st.text(max_size=3), lambda v: st.lists(v, max_size=3), max_leaves=9)
MATRICES = st.integers(1, 3).flatmap(
    lambda n: st.lists(st.lists(st.floats(), min_size=n, max_size=n), min_size=1, max_size=3)
)


@given(st.sampled_from(FIELDS), VALUES | MATRICES, st.booleans())
def test_any_value_in_any_field_of_a_model_is_taken_or_refused(field: str, value: object, continuous: bool) -> None:
    data = changed(changed(MODEL, "plant.continuous", continuous), field, value)
    with contextlib.suppress(InputError):
        assert np.isfinite(parse_model(Table(data, "f.toml")).A).all()


@given(st.sampled_from([*SCHEDULE["window"][0], "K3"]), st.integers(0, 2), VALUES | MATRICES)
def test_any_value_in_any_field_of_a_window_is_taken_or_refused(field: str, index: int, value: object) -> None:
    with contextlib.suppress(InputError):
        law = parse_law(Table(windows(index, field, value), "f.toml"))
        assert isinstance(law, Schedule)


@given(st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9)), min_size=1, max_size=5))
def test_windows_are_taken_just_when_they_rise_without_a_hole(bounds: list[tuple[int, int]]) -> None:
    data = SCHEDULE | {"window": [SCHEDULE["window"][0] | {"d_min": a, "d_max": b} for a, b in bounds]}
    delays = [set(range(a, b + 1)) for a, b in bounds]
    nested = any(i != k and a <= b for i, a in enumerate(delays) for k, b in enumerate(delays))
    covered = set().union(*delays)
    hole = covered != set(range(min(covered, default=0), max(covered, default=-1) + 1))
    fine = all(delays) and not nested and not hole and bounds == sorted(bounds)
    with contextlib.nullcontext() if fine else pytest.raises(InputError):
        assert [(g.d_min, g.d_max) for g in sets_of(parse_law(Table(data, "f.toml")))] == bounds


@given(st.sampled_from([*GAINS, "certificate", "window", "conservative"]), VALUES | MATRICES)
def test_any_value_in_any_field_of_gains_is_taken_or_refused(field: str, value: object) -> None:
    with contextlib.suppress(InputError):
        assert parse_gains(Table(GAINS | {field: value}, "f.toml")).K1.shape == (1, 3)
