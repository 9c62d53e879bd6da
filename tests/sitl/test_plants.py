"""Which aircraft a name stands for, and what is refused before a flight begins."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gains.store import load_model
from gains.table import InputError
from sitl.aircraft.plants import airframe_maker, is_nonlinear, plant_model
from sitl.aircraft.wind import parse_wind

HIRM, SIX = load_model("hirm"), load_model("hirm-6dof")
LIGHT = parse_wind("dryden:light")


@pytest.mark.parametrize("name", ["sixdof:hirm", "jsbsim:c172x", "sixdof:", "sixdof:/tmp/a b.toml"])
def test_a_kind_and_a_colon_make_an_aircraft_of_its_own(name: str) -> None:
    assert is_nonlinear(name)
    assert plant_model(name, SIX) is SIX


@pytest.mark.parametrize("name", ["hirm", "sixdof", "jsbsim", "./sixdof:hirm", "Sixdof:hirm", "linear:hirm", ""])
def test_everything_else_is_a_linear_model(name: str) -> None:
    assert not is_nonlinear(name)
    assert airframe_maker(name, HIRM, None, 1) is None


def test_a_linear_plant_is_its_own_model() -> None:
    assert plant_model("hirm", SIX).name == "hirm"
    with pytest.raises(InputError):
        plant_model("sixdof", SIX)


def test_each_aircraft_made_is_new_trimmed_and_in_the_same_air() -> None:
    make = airframe_maker("sixdof:hirm", SIX, LIGHT, 1)
    assert make is not None
    one, other = make(), make()
    assert one is not other
    assert np.abs(one.x - SIX.trim.x).max() < 1e-3
    for flown in (one, other):
        assert flown.advance(SIX.trim.u, np.zeros(1), 0.0) is None
        assert flown.advance(SIX.trim.u, np.zeros(1), 0.0) is None
    assert np.array_equal(one.x, other.x)
    unlike = airframe_maker("sixdof:hirm", SIX, LIGHT, 2)
    assert unlike is not None
    stirred = unlike()
    for _ in range(2):
        stirred.advance(SIX.trim.u, np.zeros(1), 0.0)
    assert not np.array_equal(stirred.x, one.x)  # another seed, other air


def test_a_linear_model_has_no_room_for_wind() -> None:
    with pytest.raises(InputError, match=r"^wind: expected sixdof:\.\.\. or jsbsim:\.\.\. as plant, found hirm"):
        airframe_maker("hirm", HIRM, LIGHT, 1)


@pytest.mark.parametrize("name", ["sixdof:hirm", "jsbsim:c172x"])
def test_a_model_without_a_condition_says_not_where_to_trim(name: str) -> None:
    with pytest.raises(InputError, match=rf"^{name}: expected a model with \[condition\]"):
        airframe_maker(name, replace(SIX, condition=None), None, 1)


@pytest.mark.parametrize(
    "name", ["sixdof:", "sixdof:nobody", "jsbsim:", "jsbsim:nobody", "jsbsim:../c172x", "jsbsim:."]
)
def test_a_name_of_no_aircraft_is_refused_when_it_is_made(name: str) -> None:
    make = airframe_maker(name, SIX, None, 1)
    assert make is not None
    with pytest.raises(InputError, match="expected"):
        make()
