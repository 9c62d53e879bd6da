"""What the plots of delay margins show, computed: stability and gain against the delay, and a witness's response.

Windows of one d_min lie in one another, so what holds for one says something about the others: a proof for a window
proves those inside, a breaking delay sequence breaks those around, a bound from above holds inside and one from below
around. :func:`margins` carries every bound as far as it goes. :func:`response` runs the loop from the start that the
witness stretches most, an eigenvector of its period over x(k), …, x(k−d_max).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gains.decide import Bound, Decision, decide
from gains.exact import eta, program_rows
from gains.lower_gain import Ascent, constant_norms, worst_gain
from gains.lyapunov import constant_radius
from gains.model import GainLaw, Gains, Matrix, sets_of, spectral_radius
from gains.stability import parts_of, prove_quadratic, tighten
from gains.switched import Transitions, eq9, graph, state_loop
from gains.witness import Cycle, successors

__all__ = ["Constant", "Margins", "Response", "Window", "constant_delays", "margins", "respond", "response"]

Tell = Callable[[str], None]

_ROWS = 12_000  # of a program for eta: larger ones take minutes each
_ASCENT = Ascent(kept=3, rounds=6, longest=20, frequencies=5)  # a second or so for each window
_PRODUCTS = 40_000  # of the trees that bound the growth of a refuted window from above
_GROWTH_SHOWN = 10.0
_FEWEST_PERIODS, _FEWEST_SAMPLES = 2, 30
_MOST_SAMPLES = 360  # beyond it single samples of d(k) can no longer be told apart


class Constant(NamedTuple):
    """A delay that never changes: its spectral radius per sample, and H∞ norm from v to e.

    The norm is infinite where the loop diverges, and NaN for a model without v or e.
    """

    d: int
    radius: float
    norm: float


@dataclass(frozen=True, slots=True)
class Window:
    """What is known of the delays from d_min to ``d_max``.

    Attributes
    ----------
    d_max : int
        Samples.
    verdict : {"stable", "unstable", "undecided"}
    lower, upper : float
        Bounds on the joint spectral radius, per sample.
    eta, eta_lower : float
        Gain from v to e: proved, and reached by a delay sequence; NaN where not known.
    """

    d_max: int
    verdict: Literal["stable", "unstable", "undecided"]
    lower: float
    upper: float
    eta: float = math.nan
    eta_lower: float = math.nan


@dataclass(frozen=True, slots=True, eq=False)
class Margins:
    """Stability and gain against the delay.

    Attributes
    ----------
    law : Gains or Schedule
    d_min : int
        Samples.
    transitions : {"any", "fifo"}
    found : Bound
    constants : tuple of Constant
        By rising d.
    windows : tuple of Window
        By rising d_max.
    """

    law: GainLaw
    d_min: int
    transitions: Transitions
    found: Bound
    constants: tuple[Constant, ...]
    windows: tuple[Window, ...]


class Held(NamedTuple):
    """The loop from the start of a witness under a constant delay; y has shape (K, ny)."""

    d: int
    radius: float
    y: Matrix


@dataclass(frozen=True, slots=True, eq=False)
class Response:
    """The loop under a witness, and under constant delays from the same start.

    Attributes
    ----------
    gains : Gains
    d_min, d_max : int
        The window that the witness was sought in, samples.
    transitions : {"any", "fifo"}
    growth : float
        Of the witness, per sample.
    period : int
        Samples.
    d : ndarray of int, shape (K,)
        d(k), samples.
    y : ndarray, shape (K, ny)
        Each output in units of its largest value in the first period.
    envelope : ndarray, shape (K,)
        growth^k, times the least factor with which it encloses every output.
    held : tuple of Held
    """

    gains: Gains
    d_min: int
    d_max: int
    transitions: Transitions
    growth: float
    period: int
    d: NDArray[np.intp]
    y: Matrix
    envelope: Matrix
    held: tuple[Held, ...]


def margins(law: GainLaw, d_min: int, limit: int, transitions: Transitions, found: Bound, tell: Tell) -> Margins:
    """Return what is known of every delay up to a sample beyond the smallest window that is refuted.

    Parameters
    ----------
    law : Gains or Schedule
    d_min, limit : int
        As they were asked of :func:`gains.decide.bound`; no delay is above ``limit``.
    transitions : {"any", "fifo"}
    found : Bound
        What was answered; its windows are not decided again.
    tell : callable
        Called with a line for each bound.
    """
    last = limit if found.refuted is None else min(limit, found.refuted.d_max + 1)
    known = {one.d_max: one for one in (found.proof, found.refuted, *found.undecided) if one is not None}
    first = max([d_min, *(own.d_min for own in sets_of(law)[1:])])  # as of the answer
    decided: list[Window] = []
    for d in range(first, last + 1):
        decided.append(_window(law, known.get(d) or decide(law, d_min, d, transitions=transitions), transitions))
        tell(f"plot: {d_min} to {d}: growth at most {decided[-1].upper:.6f} per sample")
    constants = constant_delays(law, d_min, last, transitions)
    windows = list(_nested(decided, constants))
    worst: list[Cycle] = []
    for i, window in enumerate(windows):
        if window.verdict == "stable":
            windows[i] = _with_gain(law, d_min, window, transitions, worst)
            if math.isfinite(windows[i].eta):
                tell(f"plot: {d_min} to {window.d_max}: eta {windows[i].eta_lower:.4g} to {windows[i].eta:.4g}")
    return Margins(law, d_min, transitions, found, constants, _nested(windows, constants))


def constant_delays(law: GainLaw, d_min: int, d_max: int, transitions: Transitions) -> tuple[Constant, ...]:
    """Return every constant delay in a window; of a schedule's sets the worst that may run at that delay."""
    switched = eq9(law, d_min, d_max)
    stays = np.diag(successors(graph(switched, law, transitions), len(switched.modes)))
    F = state_loop(switched).F
    asked = switched.m > 0 and switched.H.shape[1] > 0
    norms = constant_norms(switched) if asked else [(mode.d, math.nan) for mode in switched.modes]
    worst: dict[int, Constant] = {}
    for i in np.flatnonzero(stays):
        d, norm = norms[i]
        before = worst.get(d, Constant(d, 0.0, norm))
        worst[d] = Constant(d, max(before.radius, spectral_radius(F[i])), max(before.norm, norm))
    return tuple(worst.values())


def response(gains: Gains, found: Decision, transitions: Transitions) -> Response:
    """Return the loop under the witness of a decision, beside the least and the largest stable constant delay.

    Parameters
    ----------
    gains : Gains
    found : Decision
        With a witness.
    transitions : {"any", "fifo"}
        That it was sought under.
    """
    assert found.witness is not None, "no witness, no response"
    assert found.growth is not None
    period = len(found.witness)
    samples = math.ceil(math.log(_GROWTH_SHOWN) / math.log(found.growth))
    samples = max(_FEWEST_PERIODS * period, _FEWEST_SAMPLES, min(samples, _MOST_SAMPLES))
    d = np.resize(np.array(found.witness, dtype=np.intp), samples)
    past = _stretched(gains, found.witness, found.d_max)
    y = respond(gains, past, d)
    peak = np.abs(y[:period]).max(axis=0)
    peak[peak == 0.0] = 1.0  # an output that the state never reaches
    grown = np.power(found.growth, np.arange(samples, dtype=np.float64))
    radii = {held: constant_radius(gains, held) for held in range(found.d_min, found.d_max + 1)}
    stable = [held for held, radius in radii.items() if radius < 1.0]
    return Response(
        gains=gains,
        d_min=found.d_min,
        d_max=found.d_max,
        transitions=transitions,
        growth=found.growth,
        period=period,
        d=d,
        y=y / peak,
        envelope=grown * float((np.abs(y / peak) / grown[:, None]).max()),
        held=tuple(
            Held(held, radii[held], respond(gains, past, [held] * samples) / peak)
            for held in sorted({*stable[:1], *stable[-1:]})
        ),
    )


def respond(gains: Gains, past: Matrix, delays: Sequence[int] | NDArray[np.intp]) -> Matrix:
    """Return y(k) = C x(k) + D K1 x(k−d(k)), x(k+1) = A x(k) + B K1 x(k−d(k)); shape (K, ny).

    Parameters
    ----------
    gains : Gains
    past : ndarray, shape (depth + 1, nx)
        x(−depth), …, x(0).
    delays : sequence of int, length K
        d(0), d(1), …, none above the depth.
    """
    model, depth = gains.model, len(past) - 1
    x = np.zeros((depth + 1 + len(delays), model.nx))
    x[: depth + 1] = past
    y = np.zeros((len(delays), model.ny))
    for k, d in enumerate(delays, start=depth):
        u = gains.K1 @ x[k - d]
        y[k - depth] = model.C @ x[k] + model.D @ u
        x[k + 1] = model.A @ x[k] + model.B @ u
    return y


# -- windows


def _window(law: GainLaw, decision: Decision, transitions: Transitions) -> Window:
    """Return a window as it was decided; one without an upper bound is given that of a quadratic form and its trees."""
    upper = decision.upper
    if not math.isfinite(upper):
        switched = eq9(law, decision.d_min, decision.d_max)
        parts = parts_of(switched, graph(switched, law, transitions))
        low = max(decision.lower, float(np.finfo(float).tiny))
        upper = max(tighten(part, prove_quadratic(part), _PRODUCTS, low)[0] for part in parts)
    return Window(decision.d_max, decision.verdict, decision.lower, upper)


def _with_gain(law: GainLaw, d_min: int, window: Window, transitions: Transitions, worst: list[Cycle]) -> Window:
    """Return a stable window with both bounds on its gain, where there are v and e and the program is small enough.

    The search for a delay sequence begins with the ``worst`` of the windows inside, to which its own is added: modes
    are numbered by rising delay, the same in every window.
    """
    switched = eq9(law, d_min, window.d_max)
    if not (switched.m and switched.H.shape[1]) or program_rows(law, d_min, window.d_max, transitions) > _ROWS:
        return window
    proved = eta(law, d_min, window.d_max, transitions=transitions).eta
    lower, cycle = worst_gain(switched, graph(switched, law, transitions), worst, _ASCENT)
    worst.append(cycle)
    return replace(window, eta=math.nan if proved is None else proved, eta_lower=lower)


def _nested(windows: Sequence[Window], constants: Sequence[Constant]) -> tuple[Window, ...]:
    """Return the windows, rising, with what each says about those inside and those around, and constant delays too."""
    within: list[Window] = []
    for window in windows:
        inside = [constant for constant in constants if constant.d <= window.d_max]
        radius = max((constant.radius for constant in inside), default=0.0)
        norm = max((constant.norm for constant in inside), default=math.nan)
        before = within[-1] if within else window
        verdict = "unstable" if before.verdict == "unstable" else window.verdict
        lower = max(window.lower, before.lower, radius)
        reached = math.nan
        if verdict == "stable":
            reached = float(np.fmax.reduce([window.eta_lower, before.eta_lower, norm]))
        within.append(replace(window, verdict=verdict, lower=lower, eta_lower=reached))
    for i in range(len(within) - 2, -1, -1):
        window, around = within[i], within[i + 1]
        verdict = "stable" if around.verdict == "stable" else window.verdict
        upper, proved = min(window.upper, around.upper), float(np.fmin(window.eta, around.eta))
        within[i] = replace(window, verdict=verdict, upper=upper, eta=proved)
    return tuple(within)


# -- the start of a witness


def _stretched(gains: Gains, witness: Sequence[int], depth: int) -> Matrix:
    """Return x(−depth), …, x(0) that a period stretches most: (the real part of) the leading eigenvector.

    A period takes h = (x(k); x(k−1); …; x(k−depth)) to M h. Of an eigenvector M h = λ h the entries are the states
    of one trajectory, for λ ≠ 0: it could have been going on for ever.
    """
    nx = gains.model.nx
    M = np.eye(nx * (depth + 1))
    for d in witness:
        x = gains.model.A @ M[:nx] + gains.model.B @ gains.K1 @ M[nx * d : nx * (d + 1)]
        M = np.vstack([x, M[:-nx]])
    values, vectors = np.linalg.eig(M)
    leading = vectors[:, np.abs(values).argmax()]
    leading = leading * np.exp(-1j * np.angle(leading[np.abs(leading).argmax()]))  # its largest entry is real
    return np.asarray(leading.real.reshape(depth + 1, nx)[::-1], dtype=np.float64)
