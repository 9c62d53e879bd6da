"""The streamed reference, against a step-by-step model with promises."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autopilot import streamed as streamed_module
from autopilot.profile import MAX_GAP, Profile, Sine
from autopilot.streamed import Streamed
from tests.autopilot.test_profile import PROGRAMMED, TS, values

quick = settings(deadline=None)


class Model:
    """What a streamed reference is, one sample after another, every promise kept for ever."""

    def __init__(self, source):
        self.wanted = lambda k, before: source.r(k)
        self.promised: list[float] = []
        self.limit, self.low, self.high = math.inf, -math.inf, math.inf

    def r(self, k: int) -> float:
        while len(self.promised) <= k:
            before = self.promised[-1] if self.promised else 0.0
            target = np.clip(self.wanted(len(self.promised), before), self.low, self.high)
            self.promised.append(
                float(
                    target
                    if abs(target - before) <= self.limit
                    else before + math.copysign(self.limit, target - before)
                )
            )
        return self.promised[k]


limits = st.none() | st.floats(1e-3, 0.5)
STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("ask"), st.integers(-5, 40)),
        st.tuples(st.just("span"), st.integers(-5, 20), st.integers(1, 300)),
        st.tuples(st.just("target"), values, limits),
        st.tuples(st.just("rate"), st.floats(-0.1, 0.1), limits),
        st.tuples(st.just("source"), PROGRAMMED, limits),
        st.tuples(st.just("limits"), values, values),
        st.tuples(st.just("forget"), st.integers(0, 20)),
    ),
    max_size=40,
)


def take(step, streamed: Streamed, model: Model, first: int) -> int:
    """Do one step with both, and return the first sample that may be asked for."""
    horizon = len(model.promised) - 1
    match step:
        case "ask", ahead:
            k = max(first, horizon + ahead)
            assert streamed.r(k) == model.r(k)
        case "span", ahead, span:
            k = max(first, horizon + ahead)
            until = streamed.constant_until(k, k + span)
            assert k < until <= k + span
            assert {model.r(i) for i in range(k, until)} == {streamed.r(k)}
            model.r(k + span - 1)
        case "target", value, limit:
            streamed.set_target(value, limit)
            model.wanted, model.limit = (lambda k, before: value), limit or math.inf
        case "rate", rate, limit:
            streamed.set_rate(rate, limit)
            model.wanted, model.limit = (lambda k, before: before + rate), limit or math.inf
        case "source", source, limit:
            streamed.set_source(source, limit)
            model.wanted, model.limit = (lambda k, before: source.r(k)), limit or math.inf
        case "limits", a, b:
            streamed.set_limits(min(a, b), max(a, b))
            model.low, model.high = min(a, b), max(a, b)
        case "forget", back:
            first = max(first, horizon - back)
            streamed.forget(first)
    assert streamed.horizon == len(model.promised) - 1
    return first


@quick
@given(PROGRAMMED, STEPS)
def test_a_streamed_reference_is_the_step_by_step_model_and_its_promises_never_change(source, steps):
    streamed, model, first = Streamed(source), Model(source), 0
    for step in steps:
        first = take(step, streamed, model, first)
    kept = range(first, len(model.promised))
    assert [streamed.r(k) for k in kept] == [model.promised[k] for k in kept]
    assert streamed.skipped == streamed.dropped == 0


@quick
@given(st.lists(st.tuples(values, st.integers(1, 30)), max_size=10), st.floats(1e-3, 0.5), st.floats(0.01, 1.0))
def test_neither_the_rate_limit_nor_the_limits_are_ever_exceeded(targets, limit, high):
    streamed, r = Streamed(), [0.0]
    streamed.set_limits(-high, high)
    for value, samples in targets:
        streamed.set_target(value, limit)
        r += [streamed.r(len(r) - 1 + i) for i in range(samples)]
    assert np.abs(np.diff(r)).max(initial=0.0) <= limit * (1 + 1e-12) + 1e-15
    assert np.abs(r).max() <= high


@quick
@given(PROGRAMMED, st.lists(st.integers(0, 200), max_size=10))
def test_unshaped_it_gives_exactly_its_sources_numbers(source, ks):
    streamed = Streamed(source)
    assert [streamed.r(k) for k in ks] == [source.r(k) for k in ks]


def test_a_new_target_waits_for_what_was_looked_ahead_to():
    streamed = Streamed()
    assert streamed.r(7) == 0.0
    streamed.set_target(0.1)
    assert [streamed.r(k) for k in range(10)] == [0.0] * 8 + [0.1] * 2


def test_a_rate_moves_on_from_the_last_promise_and_stops_at_the_limit():
    streamed = Streamed()
    streamed.set_limits(-1.0, 1.0)
    streamed.set_target(0.5)
    streamed.r(3)
    streamed.set_rate(0.125)
    assert [streamed.r(k) for k in range(4, 10)] == [0.625, 0.75, 0.875, 1.0, 1.0, 1.0]
    assert streamed.limited == 2
    streamed.set_limits(-1.0, 1.5)
    assert [streamed.r(k) for k in range(10, 12)] == [1.125, 1.25]  # from where it is, not from where it would be
    streamed.set_rate(0.0)
    assert streamed.constant_until(12, 10**9) == 10**9
    assert streamed.r(10**9 - 1) == 1.25


def test_it_may_begin_anywhere():
    streamed = Streamed(start=100, value=0.5, rate_limit=0.125)
    assert [streamed.r(k) for k in (100, 101, 104)] == [0.375, 0.25, 0.0]
    with pytest.raises(AssertionError):
        streamed.r(99)


def test_r_outside_of_new_limits_comes_in_at_the_rate_limit():
    streamed = Streamed()
    streamed.set_target(1.0)
    streamed.r(0)
    streamed.set_target(1.0, 0.25)
    streamed.set_limits(0.0, 0.5)
    assert [streamed.r(k) for k in range(4)] == [1.0, 0.75, 0.5, 0.5]
    assert streamed.limited == 3
    assert streamed.constant_until(4, 100) == 100
    assert streamed.limited == 99


def test_where_it_is_settled_a_long_gap_is_one_promise():
    streamed = Streamed(Profile(((10, 0.3), (10**8, 0.1))), rate_limit=0.1)
    k, asked = 0, 0
    while k < 10**9:
        k, asked = streamed.constant_until(k, 10**9), asked + 1
    assert asked <= 7  # zero, three moves up, two moves down: the last of each is where r stays
    assert (streamed.r(10**8 - 1), streamed.r(10**9 - 1)) == (pytest.approx(0.3), pytest.approx(0.1))
    assert streamed.skipped == 0


@pytest.mark.parametrize("end", [MAX_GAP, MAX_GAP + 1, 10**9])
def test_a_gap_too_long_to_walk_ends_at_the_target(end):
    streamed = Streamed()
    streamed.set_target(1.0, 1e-9)
    arrived = streamed.r(end - 1) == 1.0
    assert arrived == (end > MAX_GAP)
    assert streamed.skipped == max(0, end - MAX_GAP)
    assert streamed.r(MAX_GAP - 1) == pytest.approx(MAX_GAP * 1e-9)


def test_a_gap_too_long_to_walk_ends_where_the_source_or_the_rate_has_gone():
    sine = Sine(1.0, 0.37, 0.0, TS)
    streamed = Streamed(sine)
    assert streamed.r(10**6) == sine.r(10**6)
    streamed.set_rate(-1e-6)
    assert streamed.r(2 * 10**6) == pytest.approx(sine.r(10**6) - 1.0, abs=1e-9)


def test_what_was_forgotten_is_not_told_again():
    streamed = Streamed(Profile(((0, 0.1), (5, 0.2))))
    streamed.r(20)
    streamed.forget(7)
    streamed.forget(3)
    assert (streamed.r(7), streamed.constant_until(7, 30)) == (0.2, 30)
    for ask in (lambda: streamed.r(6), lambda: streamed.constant_until(6, 9)):
        with pytest.raises(AssertionError, match="forgotten"):
            ask()
    streamed.forget(100)
    assert streamed.r(100) == 0.2


def test_memory_is_bounded_also_when_nobody_forgets(monkeypatch):
    monkeypatch.setattr(streamed_module, "MAX_PROMISES", 50)
    sine = Sine(1.0, 0.37, 0.0, TS)
    streamed = Streamed(sine)
    for k in range(200):
        streamed.r(k)
    assert [streamed.r(k) for k in range(150, 200)] == [sine.r(k) for k in range(150, 200)]
    assert streamed.dropped >= 149
    with pytest.raises(AssertionError, match="forgotten"):
        streamed.r(149)
