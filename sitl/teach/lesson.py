"""Curves and facts for every delay that the page offers, of one set of gains.

For every position d of the slider there are three patterns: the delay that is always d; delays drawn at random in
[d_min, d]; and the worst sequence that was found in [d_min, d]. Each is flown twice: once as a pilot would see it, a
step of the reference, or from a start off balance where there is no reference; and once without reference from a start
off balance, for the growth per sample of what is left. Random delays are also flown many more times, which is what a
simulation campaign would do. Draws are seeded: the same gains give the same page.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from gains.model import Gains, Matrix
from gains.switched import Transitions
from gains.table import InputError
from sitl.teach.facts import Fact, constant_fact, nested, stored_eta, window_fact
from sitl.teach.recursion import Delays, fly, size

__all__ = [
    "BEYOND",
    "MOST_DELAY",
    "PATTERNS",
    "RUNS",
    "SAMPLES",
    "Case",
    "Drawn",
    "Lesson",
    "lesson",
    "output",
    "positions",
    "random_delays",
]

BEYOND = 4
"""Samples beyond the window of the gains that the page goes on to."""

MOST_DELAY = 16
"""The largest delay of a page: beyond it the facts take minutes."""

SAMPLES = 1000
"""Of each curve."""

RUNS = 50
"""Flights under random delays, for each d."""

Pattern = Literal["constant", "random", "worst"]
PATTERNS: tuple[Pattern, ...] = ("constant", "random", "worst")

_LONG = 1200  # samples of the flights that the growth is measured in
_SETTLED = 200  # samples that are left out of it: the other modes die out
_STEP_AT_S = 1.0
_START = 0.1  # of the first output, where there is no reference
_SEED = 26  # of the random delays
_LEAST = 1e-300  # a size below it would be lost to underflow

Floats: TypeAlias = NDArray[np.float64]


class Drawn(NamedTuple):
    """The growth per sample of many flights under random delays: the least, the mean, the largest; how many grew."""

    least: float
    mean: float
    largest: float
    grew: int


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """One delay pattern at one position of the slider.

    Attributes
    ----------
    pattern : {"constant", "random", "worst"}
    d : int
        The constant delay, or the largest of the window, samples.
    fact : Fact
        About the constant delay, or about every sequence in the window.
    delays : ndarray of int, shape (SAMPLES,)
        d(k), samples.
    y, u : ndarray, shape (SAMPLES,)
        First output and first input, deviations from trim, in the units of the model.
    left : ndarray, shape (SAMPLES,)
        What is left of a start off balance without reference, as a part of what it was; see
        :func:`sitl.teach.recursion.size`.
    growth : float
        Per sample: of the loop under the periodic sequence, or as measured in this flight where delays are random.
    drawn : Drawn or None
        Of many flights; None unless delays are random.
    """

    pattern: Pattern
    d: int
    fact: Fact
    delays: NDArray[np.intp]
    y: Floats
    u: Floats
    left: Floats
    growth: float
    drawn: Drawn | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Lesson:
    """All that the page shows of one set of gains.

    Attributes
    ----------
    gains : Gains
    transitions : {"any", "fifo"}
    delays : range
        The positions of the slider, samples.
    yr : ndarray or None, shape (SAMPLES,)
        The first output of the reference model; None without one.
    cases : Mapping of (pattern, d) to Case
    """

    gains: Gains
    transitions: Transitions
    delays: range
    yr: Floats | None
    cases: Mapping[tuple[Pattern, int], Case]


def lesson(
    gains: Gains, delays: range, transitions: Transitions = "any", tell: Callable[[str], None] | None = None
) -> Lesson:
    """Return curves and facts of a set of gains.

    Parameters
    ----------
    gains : Gains
    delays : range
        The positions of the slider, none below d_min; see :func:`positions`.
    transitions : {"any", "fifo"}
        Which delay sequences are admitted.
    tell : callable or None
        Called with a line before each delay.
    """
    assert gains.d_min <= delays[0] <= delays[-1] <= MOST_DELAY
    facts = _facts(gains, delays, transitions, tell or (lambda _text: None))
    which = list(facts)
    random = {d: random_delays(gains.d_min, d, RUNS, transitions) for d in delays}
    calm = _calm(gains, np.full((1, _LONG), gains.d_min, dtype=np.intp))
    shown = np.stack(
        [random[d][0] if pattern == "random" else _repeated(gains, facts[pattern, d], calm) for pattern, d in which]
    )
    x0, r = _start(gains)
    run = fly(gains, shown[:, :SAMPLES], x0, r)
    left = _left(gains, shown, calm, delays[-1])
    cases = {}
    for i, (pattern, d) in enumerate(which):
        drawn, growth = None, facts[pattern, d].growth
        if pattern == "random":
            growths = _measured(_left(gains, random[d], calm, delays[-1]))
            growth = float(growths[0])
            drawn = Drawn(float(growths.min()), float(growths.mean()), float(growths.max()), int((growths > 1.0).sum()))
        flown = (shown[i, :SAMPLES], run.y[i, :, 0], run.u[i, :, 0], left[i, :SAMPLES])
        cases[pattern, d] = Case(pattern, d, facts[pattern, d], *flown, growth, drawn)
    return Lesson(gains, transitions, delays, None if run.yr is None else run.yr[:, 0], cases)


def positions(gains: Gains, window: tuple[int, int] | None = None) -> range:
    """Return the positions of the slider: those of the window, or else d_min to d_max + 4 of the gains, samples.

    Raises
    ------
    InputError
        When they are too many for a page, or begin below d_min.
    """
    low, high = (gains.d_min, gains.d_max + BEYOND) if window is None else window
    if not gains.d_min <= low <= high <= MOST_DELAY:
        raise InputError(f"{gains.name}: expected delays within {gains.d_min}:{MOST_DELAY}, found {low}:{high}")
    return range(low, high + 1)


def random_delays(d_min: int, d_max: int, runs: int, transitions: Transitions) -> Delays:
    """Return delays drawn with equal chances in [d_min, d_max], shape (runs, 1200); under "fifo" d⁺ is cut at d + 1.

    Parameters
    ----------
    d_min, d_max : int
        Samples.
    runs : int
    transitions : {"any", "fifo"}
    """
    drawn = np.random.default_rng([_SEED, d_min, d_max]).integers(d_min, d_max + 1, size=(runs, _LONG), dtype=np.intp)
    if transitions == "fifo":
        for k in range(1, _LONG):
            drawn[:, k] = np.minimum(drawn[:, k], drawn[:, k - 1] + 1)
    return drawn


def output(gains: Gains) -> tuple[str, float]:
    """Return the label of the first output, and the factor from the model's unit to the label's."""
    state = gains.model.output_states[0]
    if state.endswith("_rad"):
        return f"{state.removesuffix('_rad').replace('_', ' ')}, deg", math.degrees(1.0)
    return (state or "first output y"), 1.0


def _facts(
    gains: Gains, delays: range, transitions: Transitions, tell: Callable[[str], None]
) -> dict[tuple[Pattern, int], Fact]:
    """Return the fact behind every case: one for a constant delay, one for the two patterns of a window."""
    constants: list[Fact] = []
    windows: list[Fact] = []
    for d in delays:
        tell(f"{gains.name}: delay {d}, and {gains.d_min} to {d}")
        constants.append(constant_fact(gains, d))
        worst = [fact.sequence for fact in windows if fact.verdict != "unstable"]
        windows.append(window_fact(gains, gains.d_min, d, transitions, worst))
    found: dict[tuple[Pattern, int], Fact] = {}
    whole = nested(windows, constants, stored_eta(gains, transitions))
    for constant, window in zip(constants, whole, strict=True):
        found["constant", window.d_max] = constant
        found["random", window.d_max] = found["worst", window.d_max] = window
    return found


def _repeated(gains: Gains, fact: Fact, calm: Matrix) -> NDArray[np.intp]:
    """Return the sequence of a fact over and over, from that of its samples after which most is left at the end.

    Which that is does not change the growth per sample, only how soon it shows.
    """
    sequence = np.array(fact.sequence, dtype=np.intp)
    turned = np.stack([np.resize(np.roll(sequence, -i), _LONG) for i in range(len(sequence))])
    left = _left(gains, turned[:, :SAMPLES], calm, fact.d_max)
    worst: NDArray[np.intp] = turned[int(left[:, -1].argmax())]
    return worst


def _start(gains: Gains) -> tuple[Matrix, Matrix | None]:
    """Return x(0) and r(k) of what is shown: a unit step of the first reference, or the first output off balance.

    The unit is that of :func:`output`, as the paper's step is 1 degree.
    """
    reference = gains.model.reference
    if reference is None:
        return _off_balance(gains), None
    r = np.zeros((SAMPLES, reference.Br.shape[1]))
    r[round(_STEP_AT_S / gains.model.Ts) :, 0] = 1.0 / output(gains)[1]
    return np.zeros(gains.model.nx), r


def _off_balance(gains: Gains) -> Matrix:
    """Return the least x with a first output of 0.1."""
    return np.asarray(np.linalg.pinv(gains.model.C)[:, 0] * _START, dtype=np.float64)


def _calm(gains: Gains, delays: Delays) -> Matrix:
    """Return the largest |x_i| under the least delay: units in which the states weigh the same."""
    peak = np.nanmax(np.abs(fly(gains, delays, _off_balance(gains)).x[0]), axis=0)
    return np.where(peak > 0.0, peak, 1.0)


def _left(gains: Gains, delays: Delays, calm: Matrix, depth: int) -> Matrix:
    """Return what is left of a start off balance, shape (runs, K − depth), 1 at first."""
    sizes = size(fly(gains, delays, _off_balance(gains)).x, calm, depth)
    return sizes / sizes[:, :1]


def _measured(left: Matrix) -> Matrix:
    """Return the growth per sample of each run, while it is a number."""
    each = np.arange(len(left))
    last = np.maximum(np.isfinite(left).sum(axis=1) - 1, 1)
    first = np.where(last > 2 * _SETTLED, _SETTLED, 0)
    logs = np.log(np.maximum(left, _LEAST))
    return np.asarray(np.exp((logs[each, last] - logs[each, first]) / (last - first)))
