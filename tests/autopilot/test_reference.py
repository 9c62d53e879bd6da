"""The reference model against scipy, over programmed and streamed references."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import dlsim

from autopilot import reference as reference_module
from autopilot.profile import MAX_GAP, Profile, Sine
from autopilot.reference import CHANGES_LIMIT, AffineStep, ReferenceModel, match_reference
from autopilot.streamed import Streamed
from tests.helpers import HIRM

quick = settings(deadline=None)
REFERENCE = HIRM.model.reference
AT_ONCE = AffineStep(np.eye(3), np.zeros(3))
SWITCHES = st.lists(st.integers(0, 400), max_size=5, unique=True).flatmap(
    lambda starts: st.lists(st.floats(-1.0, 1.0), min_size=len(starts), max_size=len(starts)).map(
        lambda values: Profile(tuple(zip(sorted(starts), values, strict=True)))
    )
)


def by_scipy(r: np.ndarray) -> np.ndarray:
    """Return xr(0), xr(1), ... of Eq. (8) as scipy simulates it."""
    n = REFERENCE.Ar.shape[0]
    _, _, xr = dlsim((REFERENCE.Ar, REFERENCE.Br, REFERENCE.Cr, np.zeros((1, 1)), 1.0), r[:, None], x0=np.zeros(n))
    return xr


def test_a_step_is_what_scipy_makes_of_it():
    model = ReferenceModel(REFERENCE, Profile(((40, 1.0),)))
    truth = by_scipy(np.where(np.arange(400) >= 40, 1.0, 0.0))
    for k in range(400):
        np.testing.assert_allclose(model.advance(k), truth[k], rtol=1e-11, atol=1e-13)


def test_the_papers_reference_model_settles_at_unit_gain_in_pitch():
    model = ReferenceModel(REFERENCE, Profile(((0, 1.0),)))
    assert (REFERENCE.Cr @ model.advance(20_000))[0] == pytest.approx(1.0, abs=0.02)


@quick
@given(SWITCHES, st.lists(st.integers(0, 500), min_size=1, max_size=10), st.integers(0, 40))
def test_any_profile_any_gaps_and_any_lookahead_match_scipy(profile, stops, samples):
    truth = by_scipy(np.array([profile.r(k) for k in range(600)]))
    model = ReferenceModel(REFERENCE, profile)
    for j in sorted(stops):
        np.testing.assert_allclose(model.advance(j), truth[j], rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(model.ahead(samples), truth[j + samples], rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("end", [63, 64, 65, 66, 500, 100_000])
def test_one_matrix_power_is_as_good_as_the_loop(monkeypatch, end):
    profile = Profile(((3, 1.0),))
    by_power = ReferenceModel(REFERENCE, profile).advance(end)
    monkeypatch.setattr(reference_module, "LOOP_LIMIT", 10**9)
    by_loop = ReferenceModel(REFERENCE, profile).advance(end)
    np.testing.assert_allclose(by_power, by_loop, rtol=1e-12, atol=1e-12)


def test_looking_ahead_does_not_move_the_state():
    model = ReferenceModel(REFERENCE, Profile(((0, 1.0),)))
    before = model.advance(7).copy()
    model.ahead(100)
    assert model.k == 7
    np.testing.assert_array_equal(model.xr, before)
    np.testing.assert_array_equal(model.ahead(0), before)


def test_an_earlier_sample_moves_nothing():
    model = ReferenceModel(REFERENCE, Profile(((0, 1.0),)))
    before = model.advance(7).copy()
    np.testing.assert_array_equal(model.advance(3), before)
    assert model.k == 7


def test_a_billion_lost_samples_cost_no_time():
    model = ReferenceModel(REFERENCE, Profile(((0, 1.0),)))
    assert np.all(np.isfinite(model.advance(10**9)))


# a streamed reference

TARGETS = st.lists(st.tuples(st.integers(1, 80), st.integers(0, 9), st.floats(-1.0, 1.0)), min_size=1, max_size=12)


@quick
@given(TARGETS, st.none() | st.floats(1e-3, 0.3), st.floats(-0.05, 0.05))
def test_over_a_streamed_reference_it_is_eq_8_with_the_promised_r(targets, limit, rate):
    streamed = Streamed()
    model = ReferenceModel(REFERENCE, streamed)
    looked: dict[int, tuple[float, ...]] = {}
    for gap, samples, target in targets:
        model.advance(model.k + gap)
        looked[model.k + samples] = model.ahead(samples)
        if target < -0.9:
            streamed.set_rate(rate)
        else:
            streamed.set_target(target, limit)
    xr, r = np.zeros(3), [streamed.r(k) for k in range(model.k + 10)]
    for k in range(len(r)):
        if k in looked:
            np.testing.assert_allclose(looked[k], xr, rtol=1e-10, atol=1e-12)
        xr = REFERENCE.Ar @ xr + REFERENCE.Br[:, 0] * r[k]


@pytest.mark.parametrize("look", [ReferenceModel.ahead, ReferenceModel.step_ahead])
def test_what_was_looked_ahead_to_is_promised_and_no_more(look):
    streamed = Streamed()
    model = ReferenceModel(REFERENCE, streamed)
    model.advance(10)
    look(model, 5)
    streamed.set_target(0.1)
    assert [streamed.r(k) for k in range(10, 17)] == [0.0] * 5 + [0.1] * 2


def test_a_state_that_is_put_elsewhere_goes_on_with_the_promised_r():
    streamed = Streamed()
    model = ReferenceModel(REFERENCE, streamed)
    model.advance(10)
    model.ahead(5)
    streamed.set_target(0.1)
    model.set(np.zeros(3))
    np.testing.assert_array_equal(model.ahead(5), np.zeros(3))
    np.testing.assert_allclose(model.ahead(6), REFERENCE.Br[:, 0] * 0.1, rtol=1e-12)


@pytest.mark.parametrize("source", [Sine(1.0, 0.2, 0.0, 0.025), Streamed(Sine(1.0, 0.2, 0.0, 0.025))])
def test_a_billion_lost_samples_of_a_sine_end_at_its_last_value_and_are_counted(source):
    model = ReferenceModel(REFERENCE, source)
    at_rest = np.linalg.solve(np.eye(3) - REFERENCE.Ar, REFERENCE.Br[:, 0] * source.r(10**9 - 1))
    np.testing.assert_allclose(model.advance(10**9), at_rest, rtol=1e-6, atol=1e-12)
    skipped = source.skipped if isinstance(source, Streamed) else model.skipped
    assert 10**9 - CHANGES_LIMIT <= skipped <= 10**9 - MAX_GAP


def test_a_sine_over_a_gap_that_can_be_walked_is_what_scipy_makes_of_it():
    sine = Sine(1.0, 0.2, 0.0, 0.025)
    truth = by_scipy(np.array([sine.r(k) for k in range(3001)]))[3000]
    for source in (sine, Streamed(sine)):
        model = ReferenceModel(REFERENCE, source)
        np.testing.assert_allclose(model.advance(3000), truth, rtol=1e-10, atol=1e-12)
        assert model.skipped == 0


# re-entry


@quick
@given(
    st.lists(st.floats(-0.3, 0.3), min_size=3, max_size=3).map(np.array),
    st.floats(-0.4, 0.4),
)
def test_a_matched_reference_has_the_aircrafts_output_and_its_input(x, u):
    xr = match_reference(HIRM.model, HIRM.K1, HIRM.K2, x, u, AT_ONCE)
    np.testing.assert_allclose(REFERENCE.Cr @ xr, HIRM.model.C @ x, atol=1e-9)
    np.testing.assert_allclose(HIRM.K2 @ xr, u - HIRM.K1 @ x, atol=1e-9)


def test_a_matched_reference_stays_nearest_to_the_state():
    x, u = np.array([0.02, -0.1, 0.05]), 0.03
    xr = match_reference(HIRM.model, HIRM.K1, HIRM.K2, x, u, AT_ONCE)
    rows = np.vstack([REFERENCE.Cr, HIRM.K2])
    free = np.linalg.svd(rows)[2][2]
    np.testing.assert_allclose(rows @ free, 0.0, atol=1e-12)
    assert abs(free @ (xr - x)) < 1e-9


def test_a_reference_that_matches_already_is_left_alone():
    x = np.array([0.02, -0.1, 0.05])
    u = float((HIRM.K1 @ x + HIRM.K2 @ x)[0])
    np.testing.assert_allclose(match_reference(HIRM.model, HIRM.K1, HIRM.K2, x, u, AT_ONCE), x, atol=1e-12)


@pytest.mark.parametrize("ahead", [0, 1, 3, 7])
def test_the_command_after_a_match_is_the_input_before_it_however_far_the_law_looks_ahead(ahead):
    model = ReferenceModel(REFERENCE, Profile(((0, 0.1), (12, -0.2))))
    model.advance(10)
    x, u = np.array([0.02, -0.1, 0.05]), 0.03
    model.set(match_reference(HIRM.model, HIRM.K1, HIRM.K2, x, u, model.step_ahead(ahead)))
    np.testing.assert_allclose(HIRM.K1 @ x + HIRM.K2 @ model.ahead(ahead), u, atol=1e-9)
    np.testing.assert_allclose(REFERENCE.Cr @ model.xr, HIRM.model.C @ x, atol=1e-9)


@pytest.mark.parametrize("ahead", [0, 1, 5])
def test_the_step_ahead_is_the_look_ahead(ahead):
    model = ReferenceModel(REFERENCE, Profile(((0, 0.1), (12, -0.2))))
    model.advance(10)
    step = model.step_ahead(ahead)
    np.testing.assert_allclose(step.matrix @ model.xr + step.offset, model.ahead(ahead), atol=1e-12)
