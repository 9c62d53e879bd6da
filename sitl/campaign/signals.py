"""What each flight meets, drawn and laid out for a block of flights, compiled: d(k), w(k), r(k), δ(k), x(0).

Every number is a function of (seed, flight number, purpose, index): see :mod:`sitl.campaign.philox`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sitl.campaign.distributions import KINDS, DelayProcess, Signal, Span
from sitl.campaign.job import Campaign
from sitl.campaign.kernel import LANES
from sitl.campaign.philox import DELAY, GUST, HOLD, PARAMETERS, normals, uniform, words, words_inlined

__all__ = ["COLUMNS", "MAX_CHANNELS", "Draw", "Waveform", "draw_block", "draw_of"]

COLUMNS = (
    "gust_amplitude",
    "gust_period_s",
    "reference_amplitude",
    "reference_period_s",
    "delta_amplitude",
    "x0_norm",
)
"""What is told of a flight's parameters, the rows of ``parameters`` in :func:`draw_block`."""

_NONE, _STEP, _SINE, _SQUARE, _WHITE = (KINDS.index(kind) for kind in ("none", "step", "sine", "square", "white"))
_DELTA_PERIOD = Span(2.0, 200.0)
"""Samples, of the square wave δ; Eq. (51) has 40."""

_GUST_AT, _REFERENCE_AT, _DELTA_AT, _X0_AT = 0, 16, 32, 48
"""Where in the stream of parameters each begins: a gust or a reference has ``MAX_CHANNELS`` at most."""

MAX_CHANNELS = _REFERENCE_AT - _GUST_AT - 1


class Waveform(NamedTuple):
    """A :class:`~sitl.campaign.distributions.Signal` in samples, for compiled code."""

    kind: int
    low: float
    high: float
    shortest: float
    longest: float


class Draw(NamedTuple):
    """What the flights are drawn from, for compiled code.

    ``thresholds``: of :class:`~sitl.campaign.distributions.DelayProcess`; ``cycle``: its cycle, or empty.
    """

    seed: int
    thresholds: NDArray[np.uint64]
    cycle: NDArray[np.int32]
    d_min: int
    hold: np.uint64
    fifo: bool
    gust: Waveform
    reference: Waveform
    delta: Waveform
    x0: float


def draw_of(campaign: Campaign) -> Draw:
    """Return what the flights of a campaign are drawn from; delays of a link are handed in otherwise."""
    delays = campaign.delays or DelayProcess((1.0,), 0)
    Ts = campaign.plant.Ts
    return Draw(
        campaign.seed,
        delays.thresholds(),
        np.array(delays.cycle, dtype=np.int32),
        delays.d_min,
        np.uint64(round(delays.hold * 2**32)),
        delays.fifo,
        _waveform(campaign.gust, Ts),
        _waveform(campaign.reference, Ts),
        Waveform(_SQUARE if campaign.uncertain else _NONE, *map(float, (*campaign.delta, *_DELTA_PERIOD))),
        float(campaign.x0),
    )


def _waveform(signal: Signal, Ts: float) -> Waveform:
    low, high = signal.period_s
    return Waveform(KINDS.index(signal.kind), *map(float, (*signal.amplitude, low / Ts, high / Ts)))


@njit(error_model="numpy")
def draw_block(draw, first, d, w, r, delta, x0, parameters):  # type: ignore[no-untyped-def]
    """Draw a block of flights.

    Parameters
    ----------
    draw : Draw
    first : int
        Number of the block's first flight.
    d : ndarray of int32, shape (samples, LANES)
        Filled, but where ``draw`` has neither thresholds nor a cycle.
    w, r : ndarray, shapes (samples, nw, LANES) and (samples, nm, LANES)
    delta : ndarray, shape (samples, 1, LANES)
    x0 : ndarray, shape (nx, LANES)
    parameters : ndarray, shape (len(COLUMNS), LANES)
        Filled, all of them; what a signal of kind "none" leaves as it is shall be zero.
    """
    if len(draw.cycle):
        _cycle(draw, first, d)
    elif len(draw.thresholds):
        _delays(draw, first, d)
    _waves(draw.seed, first, draw.gust, _GUST_AT, w, parameters[0], parameters[1])
    _waves(draw.seed, first, draw.reference, _REFERENCE_AT, r, parameters[2], parameters[3])
    period = np.empty(LANES)
    _waves(draw.seed, first, draw.delta, _DELTA_AT, delta, parameters[4], period)
    for i in range(LANES):
        total = 0.0
        for j in range(len(x0)):
            word = words(draw.seed, first + i, _X0_AT + j, PARAMETERS)[0]
            x0[j, i] = draw.x0 * (2.0 * uniform(word) - 1.0)
            total += x0[j, i] ** 2
        parameters[5, i] = math.sqrt(total)


@njit(error_model="numpy")
def _delays(draw, first, d):  # type: ignore[no-untyped-def]
    """Draw independent delays, then hold some of them, then keep the order, as the process asks for."""
    four = np.empty((4, LANES), dtype=np.uint64)
    for start in range(0, len(d), 4):
        for i in range(LANES):
            four[0, i], four[1, i], four[2, i], four[3, i] = words_inlined(draw.seed, first + i, start // 4, DELAY)
        for n in range(min(4, len(d) - start)):
            for i in range(LANES):
                d[start + n, i] = draw.d_min
            for threshold in draw.thresholds:
                for i in range(LANES):
                    d[start + n, i] += four[n, i] >= threshold
    if draw.hold:
        for start in range(0, len(d), 4):
            for i in range(LANES):
                four[0, i], four[1, i], four[2, i], four[3, i] = words_inlined(draw.seed, first + i, start // 4, HOLD)
            for n in range(max(0, 1 - start), min(4, len(d) - start)):
                for i in range(LANES):
                    d[start + n, i] = d[start + n - 1, i] if four[n, i] < draw.hold else d[start + n, i]
    if draw.fifo:
        for k in range(1, len(d)):
            for i in range(LANES):
                d[k, i] = min(d[k, i], d[k - 1, i] + 1)


@njit(error_model="numpy")
def _cycle(draw, first, d):  # type: ignore[no-untyped-def]
    """Lay out a prescribed sequence, from a place of its own for each flight."""
    length = len(draw.cycle)
    for i in range(LANES):
        place = np.int64((words(draw.seed, first + i, 0, DELAY)[0] * np.uint64(length)) >> np.uint64(32))
        for k in range(len(d)):
            d[k, i] = draw.cycle[place]
            place = (place + 1) % length


@njit(error_model="numpy")
def _waves(seed, first, wave, at, out, amplitudes, periods):  # type: ignore[no-untyped-def]
    """Fill ``out``, shape (samples, channels, LANES), and what was drawn for it; periods in samples."""
    if wave.kind == _NONE:  # what is zero stays so
        amplitudes[:] = periods[:] = 0.0
        return
    channels = out.shape[1]
    direction = np.ones((max(1, channels), LANES))
    phase = np.empty(LANES)
    for i in range(LANES):
        one, two, three, four = words(seed, first + i, at, PARAMETERS)
        amplitudes[i] = wave.low + (wave.high - wave.low) * uniform(one)
        periods[i] = wave.shortest * (wave.longest / wave.shortest) ** uniform(two)
        phase[i] = uniform(three)
        if channels > 1:
            total = 0.0
            for c in range(channels):
                five, six, _, _ = words(seed, first + i, at + 1 + c, PARAMETERS)
                direction[c, i] = normals(five, six)[0]
                total += direction[c, i] ** 2
            for c in range(channels):
                direction[c, i] /= math.sqrt(total)
        elif wave.kind == _STEP and uniform(four) < 0.5:
            direction[0, i] = -1.0
    if wave.kind == _STEP:
        for k in range(len(out)):
            for c in range(channels):
                for i in range(LANES):
                    out[k, c, i] = amplitudes[i] * direction[c, i]
    elif wave.kind == _SINE:
        _sine(out, amplitudes, periods, phase, direction)
    elif wave.kind == _SQUARE:
        _square(out, amplitudes, periods, phase, direction)
    elif wave.kind == _WHITE:
        _white(seed, first, at, out, amplitudes)


@njit(error_model="numpy")
def _sine(out, amplitudes, periods, phase, direction):  # type: ignore[no-untyped-def]
    """Fill in A sin(2π (k / period + phase)), by rotation."""
    turn = np.empty((4, LANES))
    for i in range(LANES):
        turn[0, i] = math.cos(2.0 * math.pi / periods[i])
        turn[1, i] = math.sin(2.0 * math.pi / periods[i])
        turn[2, i] = amplitudes[i] * math.cos(2.0 * math.pi * phase[i])
        turn[3, i] = amplitudes[i] * math.sin(2.0 * math.pi * phase[i])
    for k in range(len(out)):
        for c in range(out.shape[1]):
            for i in range(LANES):
                out[k, c, i] = turn[3, i] * direction[c, i]
        for i in range(LANES):
            x, y = turn[2, i], turn[3, i]
            turn[2, i] = turn[0, i] * x - turn[1, i] * y
            turn[3, i] = turn[1, i] * x + turn[0, i] * y


@njit(error_model="numpy")
def _square(out, amplitudes, periods, phase, direction):  # type: ignore[no-untyped-def]
    """Fill in ± A, of half periods of whole samples; what was drawn as the period becomes the one that was flown."""
    half = np.empty(LANES)
    start = np.empty(LANES)
    for i in range(LANES):
        half[i] = max(1.0, float(round(periods[i] / 2.0)))
        periods[i] = 2.0 * half[i]
        start[i] = math.floor(phase[i] * periods[i])
    for k in range(len(out)):
        for c in range(out.shape[1]):
            for i in range(LANES):
                halves = math.floor((k + start[i]) / half[i])
                level = amplitudes[i] * direction[c, i]
                out[k, c, i] = level if halves % 2.0 == 0.0 else -level


@njit(error_model="numpy")
def _white(seed, first, at, out, amplitudes):  # type: ignore[no-untyped-def]
    """Fill in independent normal numbers; ``at`` keeps gust and reference apart."""
    samples, channels, _ = out.shape
    for i in range(LANES):
        for k in range(0, samples, 2):
            for c in range(channels):
                index = (k // 2) * (2 * channels) + 2 * c + (1 if at else 0)
                one, two, _, _ = words(seed, first + i, index, GUST)
                left, right = normals(one, two)
                out[k, c, i] = amplitudes[i] * left
                if k + 1 < samples:
                    out[k + 1, c, i] = amplitudes[i] * right
