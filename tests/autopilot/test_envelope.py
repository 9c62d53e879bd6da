"""The lines between two clouds: what the hulls say is what a linear program says."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from autopilot.envelope import (
    BUCKET_NS,
    GRAIN_NS,
    MAX_BUCKETS,
    MAX_DRIFT_PPB,
    WANDER_PPB,
    Window,
    lower_hull,
    steepest,
)
from tests.helpers import MS, S

quick = settings(deadline=None, max_examples=100)
LIMIT = MAX_DRIFT_PPB / S
WANDER = WANDER_PPB / S

# small whole numbers: ties, points in a row and equal times come up often
small = st.tuples(st.integers(0, 20), st.integers(-10, 10))
clouds = st.lists(small, min_size=1, max_size=20).map(lambda points: sorted((float(x), float(y)) for x, y in points))


def lines(above, below, objective, limit=LIMIT):
    """Minimise ``objective`` . (height at x = 0, slope) among the lines between the clouds; None: there is no line."""
    rows = [[1.0, x] for x, _ in above] + [[-1.0, -x] for x, _ in below]
    sides = [y for _, y in above] + [-y for _, y in below]
    found = linprog(objective, A_ub=rows, b_ub=sides, bounds=[(None, None), (-limit, limit)])
    assert found.status in (0, 2)
    return found.x if found.status == 0 else None


def mirrored(points):
    return sorted((x, -y) for x, y in points)


@quick
@given(clouds)
def test_a_hull_is_convex_and_no_point_lies_under_it(points):
    hull = lower_hull(points)
    assert set(hull) <= set(points)
    assert (hull[0][0], hull[-1][0]) == (points[0][0], points[-1][0])
    slopes = [(b[1] - a[1]) / (b[0] - a[0]) for a, b in pairwise(hull)]
    assert slopes == sorted(set(slopes))
    xs, ys = zip(*hull, strict=True)
    assert all(y >= np.interp(x, xs, ys) - 1e-9 for x, y in points)


@quick
@given(clouds, clouds, st.integers(0, 12), st.sampled_from([0.25, 3.0]))
def test_the_steepest_line_is_that_of_the_linear_program_or_there_is_none(above, below, lift, limit):
    above = [(x, y + lift) for x, y in above]
    found = steepest(lower_hull(above), lower_hull(mirrored(below)), limit)
    oracle = lines(above, below, [0.0, -1.0], limit)
    assert (found is None) == (oracle is None)
    if found is not None and oracle is not None:
        slope, height = found
        assert slope == pytest.approx(oracle[1], abs=1e-7)
        assert all(height + slope * x <= y + 1e-9 for x, y in above)
        assert all(height + slope * x >= y - 1e-9 for x, y in below)


@quick
@given(clouds, clouds, st.integers(0, 12))
def test_the_corners_of_the_hulls_say_of_the_slope_what_all_pairs_say(above, below, lift):
    above = [(x, y + lift) for x, y in above]
    found = steepest(lower_hull(above), lower_hull(mirrored(below)), 3.0)
    if found is not None:
        pairs = [(ya - yb) / (xa - xb) for xa, ya in above for xb, yb in below if xb < xa]
        assert found[0] == pytest.approx(min([3.0, *pairs]), abs=1e-12)


def random_window(rng, jitter_ms, exchanges, gap_ns, skew, t0_ns=0, y0_ns=0):
    """Return a window, the time after its last exchange, and all its points (x and y in ns, from t0 and y0)."""
    window, t_ns, above, below = Window(), t0_ns, [], []
    for _ in range(exchanges):
        t_ns += int(rng.integers(1, gap_ns))
        down_ns, up_ns = (int(5 * MS + jitter * MS * rng.gamma(2.0)) for jitter in jitter_ms)
        sent_ns, received_ns = t_ns, t_ns + down_ns + up_ns
        peer_ns = sent_ns + down_ns + y0_ns + round(skew * (sent_ns + down_ns - t0_ns))
        window.add(sent_ns, peer_ns, received_ns, skew)
        above.append((float(sent_ns - t0_ns), float(peer_ns - sent_ns - y0_ns)))
        below.append((float(received_ns - t0_ns), float(peer_ns - received_ns - y0_ns)))
        t_ns = received_ns
    return window, t_ns, above, below


def fit_as_the_linear_program_has_it(window, now_ns):
    """Return the fit of a window, after it was compared with the linear program over the same points."""
    fit = window.fit(now_ns)
    assert fit is not None
    above, below = [], []  # in seconds before now, and ms
    for bucket in window._buckets:
        for cloud, (x, y), way in ((above, bucket.upper, 1), (below, mirrored([bucket.lower])[0], -1)):
            age_ns = now_ns - window._origin_ns[0] - x
            y += window._origin_ns[1] - fit.base_ns + way * (GRAIN_NS + WANDER * age_ns)
            cloud.append((-age_ns / S, y / MS))

    def extreme(height, slope):
        return lines(above, below, [height, slope], LIMIT * S / MS)

    assert fit.high / MS == pytest.approx(extreme(-1, 0)[0], abs=1e-5)
    assert fit.low / MS == pytest.approx(extreme(1, 0)[0], abs=1e-5)
    assert fit.slope_high * S / MS == pytest.approx(extreme(0, -1)[1], abs=1e-5)
    assert fit.slope_low * S / MS == pytest.approx(extreme(0, 1)[1], abs=1e-5)
    return fit


@pytest.mark.parametrize("seed", range(30))
def test_the_bounds_of_a_fit_are_those_of_the_linear_program_over_its_points(seed):
    rng = np.random.default_rng(seed)
    skew = rng.uniform(-4e-4, 4e-4)
    window, now_ns, _, _ = random_window(rng, rng.uniform(0, 5, 2), int(rng.integers(2, 300)), S, skew)
    fit = fit_as_the_linear_program_has_it(window, now_ns)
    assert fit.slope_low <= skew <= fit.slope_high


@pytest.mark.parametrize("jitter_ms", [(0.01, 4.0), (4.0, 0.01)])
@pytest.mark.parametrize("seed", range(5))
def test_the_guess_of_the_skew_is_the_line_of_least_distances_of_the_better_way(seed, jitter_ms):
    rng = np.random.default_rng(seed)
    window, now_ns, above, below = random_window(rng, jitter_ms, 60, 4 * BUCKET_NS // 3, 5e-5)
    fit = window.fit(now_ns)
    assert fit is not None
    # the smooth way's line touches its points from below (above's) or from above (below's)
    points, way = (above, 1) if jitter_ms[0] < jitter_ms[1] else (below, -1)
    points = [(x / S, way * y / MS) for x, y in points]
    middle = sum(x for x, _ in points) / len(points)
    best = lines(points, [], [-1.0, -middle], 1.0)
    assert fit.slope * S / MS == pytest.approx(way * best[1], abs=1e-5)


def test_a_fit_is_the_same_wherever_the_clocks_stand():
    def fitted(t0_ns, y0_ns):
        window, now_ns, _, _ = random_window(np.random.default_rng(7), (3, 2), 200, S // 2, 7e-5, t0_ns, y0_ns)
        fit = window.fit(now_ns)
        assert fit is not None
        return fit.base_ns - y0_ns, fit.low, fit.high, fit.slope_low, fit.slope_high, fit.guess, fit.slope

    near = fitted(0, 0)
    for t0_ns, y0_ns in ((10**18, 0), (0, 10**18), (BUCKET_NS * 10**9, -(10**18))):
        assert fitted(t0_ns // BUCKET_NS * BUCKET_NS, y0_ns) == pytest.approx(near, rel=1e-12, abs=1e-12)


def test_answers_that_overtake_each_other_are_put_in_order():
    window = Window()
    for k in range(40):
        sent_ns = k * 500 * MS
        window.add(sent_ns, sent_ns + 10 * MS, sent_ns + 20 * MS, 0.0)
        if k % 8 == 7:  # one that was sent seven seconds ago
            window.add(sent_ns - 7 * S, sent_ns - 7 * S + (k % 5) * MS, sent_ns + 20 * MS, 0.0)
    sent = [bucket.upper[0] for bucket in window._buckets]
    assert sent != sorted(sent)
    fit_as_the_linear_program_has_it(window, 20 * S)


def test_a_fit_allows_what_one_of_its_lines_allows_to_the_nanosecond():
    window, now_ns, _, _ = random_window(np.random.default_rng(3), (3, 2), 200, S // 2, 7e-5)
    fit = window.fit(now_ns)
    assert fit is not None
    for later_ns in (0, 100 * MS, 3 * S, 60 * S):
        t_ns = now_ns + later_ns
        high_ns = fit.base_ns + fit.high + (fit.slope_high + WANDER) * later_ns + GRAIN_NS
        low_ns = fit.base_ns + fit.low + (fit.slope_low - WANDER) * later_ns - GRAIN_NS
        # the lower point, with an upper one far above, and the other way round
        assert fit.allows(t_ns - S, t_ns + int(high_ns) - 1, t_ns)
        assert not fit.allows(t_ns - S, t_ns + int(high_ns) + 2, t_ns)
        assert fit.allows(t_ns, t_ns + int(low_ns) + 2, t_ns + S)
        assert not fit.allows(t_ns, t_ns + int(low_ns) - 2, t_ns + S)


def test_a_fit_refuses_no_request_from_before_it_that_the_true_line_allows():
    rng, skew = np.random.default_rng(5), 3e-4
    window, now_ns, _, _ = random_window(rng, (0.02, 0.02), 200, S // 2, skew)
    fit = window.fit(now_ns)
    assert fit is not None
    for age_ns in (1, MS, S, 100 * S):
        sent_ns = now_ns - age_ns
        peer_ns = sent_ns + round(skew * sent_ns)  # it took no time to get there
        assert fit.allows(sent_ns, peer_ns, now_ns)
        assert not fit.allows(sent_ns, peer_ns - 50 * MS, now_ns)


def test_the_window_forgets_by_age_and_never_holds_more_than_its_buckets():
    window = Window()
    for k in range(3 * MAX_BUCKETS):
        for t_ns in (k * BUCKET_NS, k * BUCKET_NS + 5):
            window.add(t_ns, t_ns, t_ns + 1, 0.0)
        assert window.exchanges == 2 * min(k + 1, MAX_BUCKETS)
    t_ns = (4 * MAX_BUCKETS - 2) * BUCKET_NS
    window.add(t_ns, t_ns, t_ns, 0.0)
    assert window.exchanges == 2 + 1
    window.add(t_ns + 2 * MAX_BUCKETS * BUCKET_NS, t_ns, t_ns + 2 * MAX_BUCKETS * BUCKET_NS, 0.0)
    assert window.exchanges == 1


def test_exchanges_that_no_line_fits_have_no_fit():
    window = Window()
    for k, offset_ns in enumerate((0, 50 * MS, 0)):
        t_ns = k * BUCKET_NS
        window.add(t_ns, t_ns + MS + offset_ns, t_ns + 2 * MS, 0.0)
    assert window.fit(3 * BUCKET_NS) is None


@quick
@given(st.integers(-(1 << 62), 1 << 62), st.integers(0, 1 << 62), st.integers(0, 1 << 40))
def test_one_exchange_always_has_a_fit(tc1, ts1, round_trip_ns):
    window = Window()
    window.add(ts1, tc1, ts1 + round_trip_ns, 0.0)
    fit = window.fit(ts1 + round_trip_ns)
    assert fit is not None
    assert fit.bound_ns(ts1 + round_trip_ns) >= round_trip_ns // 2
    assert fit.allows(ts1, tc1, ts1 + round_trip_ns)
