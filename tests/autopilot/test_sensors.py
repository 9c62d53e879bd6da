"""Which field carries which state."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from autopilot.link.sensors import MIN_TS_NS, Sensor, sensors_of
from autopilot.link.wire import AoaSsa, Attitude
from gains.store import load_model
from gains.table import InputError

HIRM = load_model("hirm")


def test_the_hirms_states_are_carried_as_the_contract_says():
    alpha, q, theta = sensors_of(HIRM)
    assert (alpha.message, alpha.field) == (AoaSsa, "AOA")
    assert alpha.to_field * math.pi == pytest.approx(180.0, rel=1e-15)
    assert (q, theta) == (Sensor(Attitude, "pitchspeed", 1.0), Sensor(Attitude, "pitch", 1.0))


def test_sensors_come_in_the_order_of_the_states():
    swapped = replace(HIRM, states=tuple(reversed(HIRM.states)))
    assert sensors_of(swapped) == tuple(reversed(sensors_of(HIRM)))


@pytest.mark.parametrize("stored", ["hirm", "hirm-printed", "pendulum", "pendulum-exact"])
def test_every_stored_model_can_be_flown(stored):
    assert len(sensors_of(load_model(stored))) == load_model(stored).nx


@pytest.mark.parametrize("name", ["ATTITUDE.wobble", "VFR_HUD.climb", "AOA_SSA.aoa"])
def test_an_unknown_field_is_refused_by_name(name):
    with pytest.raises(InputError, match=rf"hirm: sensors\.q_rad_s: .*found {name}"):
        sensors_of(replace(HIRM, sensors={**HIRM.sensors, "q_rad_s": name}))


def test_a_model_without_sensors_is_refused():
    with pytest.raises(InputError, match=r"sensors\.alpha_rad: .*found none"):
        sensors_of(replace(HIRM, sensors={}))


def test_one_field_cannot_carry_two_states():
    with pytest.raises(InputError, match=r"ATTITUDE\.pitch already carries q_rad_s"):
        sensors_of(replace(HIRM, sensors={**HIRM.sensors, "q_rad_s": "ATTITUDE.pitch"}))


def test_samples_that_the_stamps_cannot_tell_apart_are_refused():
    sensors_of(replace(HIRM, Ts=MIN_TS_NS / 1e9))
    with pytest.raises(InputError, match=r"Ts: expected at least 0\.004 s for flight, found 0\.003"):
        sensors_of(replace(HIRM, Ts=0.003))
