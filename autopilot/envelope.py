"""The straight lines that pass between two clouds of points: offset and skew of a clock at a constant rate.

One TIMESYNC exchange gives two points of the plane (own time, peer's time - own time), whatever its latencies:
at the time of sending one above the true line, at the time of receiving one below it. So the true line is one
of those that separate the clouds. They form a convex set, which depends on the lower hull of the points above
and the upper hull of the points below alone: a line is under all points when it is under the corners of their
hull. The extremes of the set are proved bounds of offset and skew. The best guess within is the edge of a hull,
from the way that jitters less (Moon, Skelly, Towsley, INFOCOM 1999; Zhang, Liu, Xia, INFOCOM 2002).

The points below are kept mirrored, (x, -y), so that one hull and one search serve both clouds. Plain floats and
lists: on 64 points NumPy costs more than it saves.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from math import ceil, inf

from autopilot.link.clock import NS_PER_S

__all__ = ["GRAIN_NS", "MAX_DRIFT_PPB", "WINDOW_NS", "Fit", "Point", "Window", "lower_hull", "steepest"]

MAX_DRIFT_PPB = 400_100
"""Largest relative drift between two clocks, parts per billion: two crystals at +-200 ppm, one against the other."""

WANDER_PPB = 1_000
"""By how much the relative rate may have differed from the present one within the window: crystals feel heat."""

GRAIN_NS = 1_000
"""Every inequality is loosened by the resolution of a peer's clock: many autopilots stamp whole microseconds."""

BUCKET_NS = 2 * NS_PER_S
"""Own time of which the best point of each cloud is kept."""

MAX_BUCKETS = 64
"""Buckets in the window; the oldest falls out."""

WINDOW_NS = MAX_BUCKETS * BUCKET_NS
"""Own time that the window covers."""

USUAL_DRIFT = 100e-6
"""Relative drift of two common crystals (1 sigma), on which the guess of the skew leans while jitter hides it."""

_MAX_DRIFT = MAX_DRIFT_PPB / NS_PER_S
_WANDER = WANDER_PPB / NS_PER_S

Point = tuple[float, float]


def lower_hull(points: list[Point]) -> list[Point]:
    """Return the corners of the lower convex hull, from left to right (monotone chain, linear time).

    Parameters
    ----------
    points : list of (x, y)
        In order of (x, y).
    """
    hull: list[Point] = []
    slopes = [-inf]  # of the edge that ends in each corner
    for point in points:
        if hull:
            x, y = point
            x1, y1 = hull[-1]
            if x <= x1:
                continue  # straight above the one before
            slope = (y - y1) / (x - x1)
            while slope <= slopes[-1]:
                slopes.pop()
                hull.pop()
                x1, y1 = hull[-1]
                slope = (y - y1) / (x - x1)
            slopes.append(slope)
        hull.append(point)
    return hull


def steepest(above: list[Point], below: list[Point], limit: float) -> tuple[float, float] | None:
    """Return the largest slope <= limit of a line between two hulls, and where that line meets x = 0, at the highest.

    The room for a line of slope s, min(above - s x) - max(below - s x), is concave in s, and straight while the
    same two corners, one of each hull, are the nearest. Newton's method from ``limit`` downwards ends after
    finitely many steps at its right root, which is the least slope from a corner below to a later corner above.
    Both corners only move one way, so the time is linear.

    Parameters
    ----------
    above : list of (x, y)
        Lower hull of the points above.
    below : list of (x, -y)
        Lower hull of the mirrored points below.
    limit : float
        Lines are searched among slopes of -limit to +limit.

    Returns
    -------
    tuple of float or None
        None when no line passes.
    """
    slope, a, b = limit, len(above) - 1, 0
    while True:
        while a and above[a - 1][1] - above[a][1] <= slope * (above[a - 1][0] - above[a][0]):
            a -= 1
        while b + 1 < len(below) and below[b + 1][1] - below[b][1] <= slope * (below[b][0] - below[b + 1][0]):
            b += 1
        (xa, ya), (xb, yb) = above[a], below[b]
        if ya + yb >= slope * (xa - xb):
            return slope, ya - slope * xa
        if xa <= xb:
            return None  # a smaller slope leaves no more room
        smaller = (ya + yb) / (xa - xb)
        if smaller >= slope:  # equal but for rounding
            return slope, ya - slope * xa
        if smaller < -limit:
            return None
        slope = smaller


def _guess(hull: list[Point], mean: Point, exchanges: int) -> tuple[float, float]:
    """Return the slope of the hull's edge at the mean time of all points, and its weight, 1 / variance.

    That edge is the line under all points with the least sum of distances. Its error is taken for that of least
    squares, jitter sqrt(12 / n) / span with the mean distance as jitter, which is larger if anything.
    """
    if len(hull) < 2 or exchanges < 3:
        return 0.0, 0.0
    k = 1
    while k + 1 < len(hull) and hull[k][0] < mean[0]:
        k += 1
    (x0, y0), (x1, y1) = hull[k - 1], hull[k]
    slope = (y1 - y0) / (x1 - x0)
    distance = max(0.0, mean[1] - y0 - slope * (mean[0] - x0))
    jitter = distance * exchanges / (exchanges - 2) + GRAIN_NS
    span = hull[-1][0] - hull[0][0]
    return slope, exchanges * span * span / (12.0 * jitter * jitter)


@dataclass(frozen=True, slots=True)
class Fit:
    """All lines between the clouds, and the best guess among them, at one own time.

    Attributes
    ----------
    at_ns, base_ns : int
        Own time of the fit, and the offset that low, high and guess count from.
    low, high : float
        Proved bounds of the offset at ``at_ns``, in ns above ``base_ns``.
    slope_low, slope_high : float
        Proved bounds of the skew at ``at_ns``, dimensionless.
    guess, slope : float
        The best guess of both.
    """

    at_ns: int
    base_ns: int
    low: float
    high: float
    slope_low: float
    slope_high: float
    guess: float
    slope: float

    def guess_ns(self, now_ns: int) -> int:
        """Return the best guess of the offset at an own time."""
        return self.base_ns + round(self.guess + self.slope * (now_ns - self.at_ns))

    def bound_ns(self, now_ns: int) -> int:
        """Return the largest error that the guess may have at an own time not before ``at_ns``."""
        age_ns = max(0, now_ns - self.at_ns)
        over = self.high - self.guess + (self.slope_high + _WANDER - self.slope) * age_ns
        under = self.guess - self.low + (self.slope + _WANDER - self.slope_low) * age_ns
        return ceil(max(over, under)) + 1

    def slope_bound(self) -> float:
        """Return the largest error that the guess of the skew may have."""
        return max(self.slope_high - self.slope, self.slope - self.slope_low) + _WANDER

    def allows(self, sent_ns: int, peer_ns: int, received_ns: int) -> bool:
        """Whether an exchange received not before ``at_ns`` is possible for some of the lines."""
        age_ns = received_ns - self.at_ns
        lower = peer_ns - received_ns - self.base_ns - GRAIN_NS
        if lower > self.high + (self.slope_high + _WANDER) * age_ns:
            return False
        age_ns = sent_ns - self.at_ns
        upper = peer_ns - sent_ns - self.base_ns + GRAIN_NS
        least = self.slope_low - _WANDER if age_ns >= 0 else self.slope_high + _WANDER
        return upper >= self.low + least * age_ns


@dataclass(slots=True)
class _Bucket:
    """The best points of one stretch of own time, the lower one mirrored, and sums over all its exchanges."""

    index: int
    upper: Point
    lower: Point
    exchanges: int = 0
    sent_sum: int = 0
    upper_sum: int = 0
    received_sum: int = 0


@dataclass(slots=True)
class Window:
    """The exchanges of the last MAX_BUCKETS buckets, thinned to one point of each cloud per bucket.

    Any subset of true inequalities is true, so thinning costs sharpness only, and little of it: the points that
    are nearest to the line are kept. Points count from the first exchange since the window was empty, so that
    floats hold whole nanoseconds, for 104 days.

    Attributes
    ----------
    exchanges : int
        How many exchanges the window is made of.
    """

    exchanges: int = 0
    _buckets: deque[_Bucket] = field(default_factory=deque)
    _origin_ns: tuple[int, int] = (0, 0)

    def clear(self) -> None:
        """Forget everything."""
        self._buckets.clear()
        self.exchanges = 0

    def add(self, sent_ns: int, peer_ns: int, received_ns: int, slope: float) -> bool:
        """Take one exchange; return whether it begins a bucket.

        Parameters
        ----------
        sent_ns, peer_ns, received_ns : int
            Own, peer's and own time; not received before those taken already.
        slope : float
            The skew as far as it is known: it tells which points of a bucket are the best.
        """
        index = received_ns // BUCKET_NS
        begins = not self._buckets or index > self._buckets[-1].index
        if begins:
            while self._buckets and self._buckets[0].index <= index - MAX_BUCKETS:
                self.exchanges -= self._buckets.popleft().exchanges
            if not self._buckets:
                self._origin_ns = (received_ns, peer_ns - received_ns)
        t0_ns, y0_ns = self._origin_ns
        sent, received = sent_ns - t0_ns, received_ns - t0_ns
        upper, lower = peer_ns - sent_ns - y0_ns, received_ns - peer_ns + y0_ns
        if begins:
            bucket = _Bucket(index, (float(sent), float(upper)), (float(received), float(lower)))
            self._buckets.append(bucket)
        else:
            bucket = self._buckets[-1]
            x, y = bucket.upper
            if upper - y < slope * (sent - x):
                bucket.upper = (float(sent), float(upper))
            x, y = bucket.lower
            if lower - y < slope * (x - received):
                bucket.lower = (float(received), float(lower))
        self.exchanges += 1
        bucket.exchanges += 1
        bucket.sent_sum += sent
        bucket.upper_sum += upper
        bucket.received_sum += received
        return begins

    def fit(self, now_ns: int) -> Fit | None:
        """Return the lines at an own time not before any exchange; None when no line fits them all.

        The skew at ``now_ns`` differs from that before by WANDER_PPB at the most, so a point of age t, loosened by
        WANDER_PPB t, bounds the line that has the present offset and skew.
        """
        t0_ns, y0_ns = self._origin_ns
        now = float(now_ns - t0_ns)
        base = -self._buckets[-1].lower[1]
        above = lower_hull(sorted([bucket.upper for bucket in self._buckets]))  # answers may overtake each other
        below = lower_hull([bucket.lower for bucket in self._buckets])
        above = [(x - now, y - base) for x, y in above]
        below = [(x - now, y + base) for x, y in below]
        loose_above = [(x, y + GRAIN_NS - _WANDER * x) for x, y in above]
        loose_below = [(x, y + GRAIN_NS - _WANDER * x) for x, y in below]
        up = steepest(loose_above, loose_below, _MAX_DRIFT)
        down = steepest(loose_below, loose_above, _MAX_DRIFT)
        if up is None or down is None or up[0] < -down[0]:
            return None
        slope = min(max(self._slope(above, below, now, base), -down[0]), up[0])
        nearest_above = min([y - slope * x for x, y in above])
        nearest_below = min([y + slope * x for x, y in below])
        guess = (nearest_above - nearest_below) / 2
        return Fit(now_ns, y0_ns + int(base), -down[1], up[1], -down[0], up[0], guess, slope)

    def _slope(self, above: list[Point], below: list[Point], now: float, base: float) -> float:
        """Return the guess of the skew: both hulls' and the usual, weighted by what they are worth."""
        sent, upper, received = 0, 0, 0
        for bucket in self._buckets:
            sent += bucket.sent_sum
            upper += bucket.upper_sum
            received += bucket.received_sum
        n = self.exchanges
        round_trip = (received - sent) / n
        mean_above = (sent / n - now, upper / n - base)
        mean_below = (received / n - now, round_trip - mean_above[1])
        rise, weight_above = _guess(above, mean_above, n)
        fall, weight_below = _guess(below, mean_below, n)
        weight = weight_above + weight_below + 1 / USUAL_DRIFT**2
        return (weight_above * rise - weight_below * fall) / weight
