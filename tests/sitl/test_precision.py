"""The histogram of times: its quantiles against NumPy's."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sitl.link.precision import MAX_HELD_NS, Histogram

values_ns = st.integers(0, 200) | st.integers(0, 10**7) | st.integers(0, MAX_HELD_NS)


def histogram(values: list[int]) -> Histogram:
    made = Histogram()
    for value in values:
        made.add(value)
    return made


@given(values=st.lists(values_ns, min_size=1, max_size=60), q=st.sampled_from([0.0, 0.5, 0.9, 0.99, 1.0]))
def test_a_quantile_is_not_below_the_true_one_and_at_most_a_32nd_above(values, q):
    true_ns = int(np.quantile(np.array(values, dtype=np.int64), q, method="inverted_cdf"))
    told_ns = histogram(values).quantile(q)
    assert true_ns <= told_ns <= true_ns + true_ns // 32


@given(values=st.lists(st.integers(0, 63), min_size=1))
def test_below_64_ns_quantiles_are_exact(values):
    for q in (0.5, 0.99):
        assert histogram(values).quantile(q) == int(np.quantile(values, q, method="inverted_cdf"))


def test_the_maximum_is_exact_and_what_is_beyond_the_last_bucket_is_counted():
    made = histogram([3, MAX_HELD_NS + 12_345, 7])
    assert made.count == 3
    assert made.largest_ns == MAX_HELD_NS + 12_345
    assert made.summary() == {"p50": 7, "p99": MAX_HELD_NS, "max": MAX_HELD_NS + 12_345}


def test_nothing_has_no_quantile():
    assert Histogram().quantile(0.5) is None
    assert Histogram().summary() is None


def test_it_does_not_grow():
    made = Histogram()
    size = len(made._counts)
    for exponent in range(70):
        made.add(1 << exponent)
        made.add((1 << exponent) - 1)
    assert len(made._counts) == size < 1500
    assert made.count == sum(made._counts) == 140
