"""The law, Eq. (9), by hand and by matrices."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autopilot.control import Law, law_of
from gains.model import Gains, Trim
from gains.store import load_gains
from gains.table import InputError

HIRM = load_gains("hirm-paper")
LAW = law_of(HIRM)
small = st.floats(-0.05, 0.05)


def trimmed(trim: Trim) -> Law:
    return law_of(replace(HIRM, model=replace(HIRM.model, trim=trim)))


def test_the_law_is_the_papers_by_hand():
    x, xr = (0.01, -0.02, 0.03), (0.01, 0.02, -0.03)
    by_hand = -0.5054 * 0.01 + 3.3877 * -0.02 + 3.1151 * 0.03
    by_hand += 0.2474 * 0.01 - 3.2382 * 0.02 - 3.1120 * -0.03
    assert LAW.command(x, xr) == (pytest.approx(by_hand, rel=1e-12), False)


@given(st.tuples(small, small, small), st.tuples(small, small, small))
def test_the_law_is_k1_x_plus_k2_xr_within_the_travel(x, xr):
    assert HIRM.K2 is not None
    wanted = float((HIRM.K1 @ x + HIRM.K2 @ xr)[0])
    u, saturated = LAW.command(x, xr)
    assert u == pytest.approx(np.clip(wanted, LAW.travel.low, LAW.travel.high), abs=1e-15)
    assert saturated == (abs(wanted) > LAW.travel.high)


def test_without_a_reference_model_the_law_is_state_feedback():
    pendulum = load_gains("pendulum-paper")
    u, _ = law_of(pendulum).command((0.1, -1.0), ())
    assert u == pytest.approx(11.06827 - 34.698)


def test_the_input_is_absolute_and_the_law_acts_on_deviations():
    law = trimmed(Trim(np.array([0.05, 0.0, 0.05]), np.array([-0.02])))
    assert law.command((0.05, 0.0, 0.05), (0.0, 0.0, 0.0)) == (-0.02, False)
    u, saturated = law.command((0.06, 0.0, 0.05), (0.0, 0.0, 0.0))
    assert u == pytest.approx(-0.02 - 0.005054, rel=1e-12)
    assert not saturated


@pytest.mark.parametrize(("theta", "end"), [(1.0, LAW.travel.high), (-1.0, LAW.travel.low)])
def test_the_travel_limits_the_input_and_says_so(theta, end):
    assert LAW.command((0.0, 0.0, theta), (0.0, 0.0, 0.0)) == (end, True)


def test_just_inside_the_travel_nothing_is_limited():
    theta = LAW.travel.high / 3.1151
    inside = LAW.command((0.0, 0.0, theta * 0.999999), (0.0, 0.0, 0.0))
    outside = LAW.command((0.0, 0.0, theta * 1.000001), (0.0, 0.0, 0.0))
    assert (inside[1], outside[1]) == (False, True)


def test_the_largest_state_that_fits_the_wire_is_limited():
    largest = float(np.finfo(np.float32).max)
    assert LAW.command((largest,) * 3, (0.0,) * 3) == (LAW.travel.high, True)


def test_a_law_of_several_inputs_is_refused():
    model = HIRM.model
    two = replace(model, B=np.hstack([model.B, model.B]), D=np.zeros((1, 2)), trim=Trim(np.zeros(3), np.zeros(2)))
    with pytest.raises(InputError, match="one input"):
        law_of(Gains("two", two, 1, 2, np.vstack([HIRM.K1, HIRM.K1]), np.zeros((2, 3))))
