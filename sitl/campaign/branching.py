"""Flights that can be cut and drawn anew: the paths that :mod:`sitl.campaign.splitting` splits.

A path is a flight of a campaign, its gust, reference, uncertainty and x(0) included, whose delays come from a
:class:`~sitl.campaign.distributions.DelayProcess`. What comes after sample k depends on what came before by the state
of the loop and, where delays are held or in order, by d(k); so a path that keeps its first samples and draws the rest
anew is a flight like any other. It is flown from its first sample again, which is cheaper than keeping states.

The loop is that of :mod:`sitl.campaign.kernel`, sums in the same order, one flight after the other: here the score is
wanted at every sample. Delays are drawn from 64 bits, not 32 as there: the tail of ``geometric`` is what rare failures
are made of.
"""

# mypy: disallow-untyped-decorators=False, disallow-untyped-calls=False
from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gains.model import Matrix
from gains.table import InputError
from sitl.aircraft.linear import DIVERGED
from sitl.campaign import philox
from sitl.campaign.distributions import DelayProcess
from sitl.campaign.engine import drawn_block
from sitl.campaign.job import Campaign
from sitl.campaign.kernel import LANES, MAX_DELAY, loop_of
from sitl.campaign.philox import SPLIT, words

__all__ = ["MAX_CELLS", "FlightPaths", "Tails", "tails_of"]

MAX_CELLS = 1 << 24
"""Paths times samples that are kept at once, over all threads: some 40 bytes each with one gust and one reference."""

_HALF = np.uint64(32)
_REPLICA = 8
"""Bits of the counter's last word below the replica's number: what the numbers are for."""

Integers = NDArray[np.int64]


class Tails(NamedTuple):
    """A :class:`~sitl.campaign.distributions.DelayProcess` for 64 random bits, for compiled code.

    ``beyond[n]``: 2⁶⁴ times the probability that d exceeds d_min + n, which falls with n; ``hold`` likewise.
    """

    beyond: NDArray[np.uint64]
    hold: np.uint64
    d_min: int
    fifo: bool


def tails_of(delays: DelayProcess) -> Tails:
    """Return what delays are drawn from; sums begin at the far end, so that small probabilities keep their digits."""
    shares = np.cumsum(delays.weights[::-1])[::-1][1:]
    return Tails(
        np.array([_in_64_bits(float(share)) for share in shares], dtype=np.uint64),
        np.uint64(_in_64_bits(delays.hold)),
        delays.d_min,
        delays.fifo,
    )


def _in_64_bits(share: float) -> int:
    return min(round(share * 2**64), 2**64 - 1)


class FlightPaths:
    """The paths of one replica; :class:`sitl.campaign.splitting.Paths` says what is asked of it.

    Parameters
    ----------
    campaign : Campaign
        Of a linear plant, with a process of delays. Path i of replica n begins with the gust, reference, uncertainty
        and x(0) of flight n · particles + i.
    particles : int
    replica : int
    by_state : bool
        Whether max |x| is the score, rather than max |e|. Either is infinite from the sample on that diverges.

    Raises
    ------
    InputError
        When the campaign has no such process, or there are too many paths of so many samples.
    """

    def __init__(self, campaign: Campaign, particles: int, replica: int, *, by_state: bool) -> None:
        delays = campaign.delays
        if delays is None or delays.cycle:
            raise InputError("delays: expected uniform, hold:P or geometric:MEAN, for the future to be drawn anew")
        if particles * campaign.samples > MAX_CELLS:
            raise InputError(
                f"particles: expected at most {MAX_CELLS // campaign.samples} of {campaign.samples} samples,"
                f" found {particles}"
            )
        assert delays.d_max <= MAX_DELAY
        self._stacked = _stacked(campaign)
        self._tails, self._drawn = tails_of(delays), _drawn(campaign, replica * particles, particles)
        self._by_state = by_state
        self._seed, self._purpose, self._round = campaign.seed, SPLIT + (replica << _REPLICA), 0
        self._root = np.arange(particles)
        self._delays = np.zeros((particles, campaign.samples), dtype=np.uint8)
        self.scores = np.zeros((particles, campaign.samples))
        everyone = np.arange(particles)
        self._fly(everyone, everyone, np.zeros(particles, dtype=np.int64))

    @property
    def delays(self) -> NDArray[np.uint8]:
        """The paths' d(k), shape (particles, samples)."""
        delays = self._delays.copy()
        if self._tails.fifo:
            for k in range(1, delays.shape[1]):
                delays[:, k] = np.minimum(delays[:, k], delays[:, k - 1] + 1)
        return delays

    @property
    def roots(self) -> Integers:
        """Of which of the first paths each has the gust, reference, uncertainty and x(0), shape (particles,)."""
        return self._root.copy()

    def branch(self, killed: Integers, parents: Integers, kept: Integers) -> None:
        """Put in the place of killed paths what their parents did up to sample ``kept`` − 1, and new futures."""
        self._round += 1
        self._root[killed] = self._root[parents]
        self._fly(killed, parents, kept)

    def _fly(self, killed: Integers, parents: Integers, kept: Integers) -> None:
        _compiled()(
            self._stacked,
            self._tails,
            self._drawn,
            (self._seed, self._round, self._purpose),
            self._by_state,
            (killed, parents, kept),
            self._root,
            self._delays,
            self.scores,
        )


class _Stacked(NamedTuple):
    """The loop's matrices side by side, for a vector z = (x, u, w, q, xr, r) with q = δ (J1 x + J2 u).

    K1 and ``J`` begin at x and K2 at xr; ``error`` is (C, D, 0, 0, -Cr), ``next_state`` gives x and xr of the sample
    after. The zeros change no sum. ``bounds``: the elevator's low, high, decay and furthest, shape (4, nu).
    """

    K1: Matrix
    K2: Matrix
    J: Matrix
    error: Matrix
    next_state: Matrix
    set_of: Integers
    bounds: Matrix
    limited: bool


def _stacked(campaign: Campaign) -> _Stacked:
    """Return the matrices of a campaign's loop."""
    sizes, loop = loop_of(campaign.law, campaign.plant, limits=campaign.limits, uncertain=campaign.uncertain)
    nothing = np.zeros((sizes.ny, sizes.nw + sizes.blocks))
    state = np.hstack((loop.A, loop.B, loop.E, loop.F, np.zeros((sizes.nx, sizes.nr + sizes.nm))))
    reference = np.hstack((np.zeros((sizes.nr, state.shape[1] - sizes.nr - sizes.nm)), loop.Ar, loop.Br))
    return _Stacked(
        K1=loop.K1,
        K2=loop.K2,
        J=np.hstack((loop.J1, loop.J2)),
        error=np.hstack((loop.C, loop.D, nothing, -loop.Cr)),
        next_state=np.vstack((state, reference)),
        set_of=loop.set_of,
        bounds=np.vstack((loop.low, loop.high, loop.decay, loop.furthest)),
        limited=sizes.limited,
    )


class _Signals(NamedTuple):
    """What the first paths meet: w, r and δ, shape (particles, samples, channels), and x(0), (particles, nx)."""

    w: Matrix
    r: Matrix
    delta: Matrix
    x0: Matrix


def _drawn(campaign: Campaign, first: int, count: int) -> _Signals:
    """Return what flights of a campaign meet besides delays."""
    drawn = dataclasses.replace(campaign, limits=False)  # of no meaning here, and so one thing less to compile for
    blocks = [drawn_block(drawn, first + start) for start in range(0, count, LANES)]
    arrays = zip(*((block.w, block.r, block.delta, block.x0) for block in blocks), strict=True)
    return _Signals._make(
        np.ascontiguousarray(np.moveaxis(np.concatenate(parts, axis=-1), -1, 0)[:count]) for parts in arrays
    )


@njit(error_model="numpy")
def _draw(tails, stream, number, kept, d):  # type: ignore[no-untyped-def]
    """Draw a path's delays from sample ``kept`` on, before they are put in order."""
    seed, turn, purpose = stream
    path = (np.uint64(turn) << _HALF) | np.uint64(number)
    for k in range(kept, len(d)):
        one, two, three, four = words(seed, path, k, purpose)
        if k > 0 and ((three << _HALF) | four) < tails.hold:
            d[k] = d[k - 1]
            continue
        n, drawn = 0, (one << _HALF) | two
        while n < len(tails.beyond) and drawn < tails.beyond[n]:
            n += 1
        d[k] = tails.d_min + n


@njit(error_model="numpy")
def _added(total, matrix, row, z, at):  # type: ignore[no-untyped-def]
    """Return total + a matrix' row · z from ``at`` on, term by term."""
    for j in range(matrix.shape[1]):
        total += matrix[row, j] * z[at + j]
    return total


@njit(error_model="numpy")
def _limited(u, at, bounds, n):  # type: ignore[no-untyped-def]
    """Return where the elevator that was at ``at`` is after u (:func:`sitl.aircraft.linear.move_actuator`)."""
    low, high, decay, furthest = bounds[0, n], bounds[1, n], bounds[2, n], bounds[3, n]
    u = min(max(u, low), high)
    u = u + decay * (at - u)
    return at + min(max(u - at, -furthest), furthest)


@njit(error_model="numpy")
def _moved(next_state, z, nx, at_xr, following):  # type: ignore[no-untyped-def]
    """Put x(k+1) and xr(k+1) into z, Eqs. (4) and (8); return the largest |x(k+1)|."""
    largest = 0.0
    for n in range(len(following)):
        following[n] = _added(0.0, next_state, n, z, 0)
    for n in range(nx):
        z[n] = following[n]
        largest = max(largest, abs(z[n]))
    for n in range(nx, len(following)):
        z[at_xr + n - nx] = following[n]
    return largest


@njit(error_model="numpy")
def _score(stacked, by_state, fifo, delays, w, r, delta, x0, scores):  # type: ignore[no-untyped-def]
    """Fly one path, and fill in the largest |e|, or |x|, up to and with each sample."""
    K1, K2, J, error, next_state, set_of, bounds, limited = stacked
    nx, nu, nw, nq, nm = len(x0), bounds.shape[1], w.shape[1], len(J), r.shape[1]
    at_w, at_q, at_xr, at_r = nx + nu, nx + nu + nw, nx + nu + nw + nq, next_state.shape[1] - nm
    z, past, position = np.zeros(next_state.shape[1]), np.empty((len(delays), len(K1))), np.zeros(nu)
    following = np.empty(len(next_state))
    z[:nx] = x0
    d, score = np.int64(delays[0]), 0.0
    for k in range(len(delays)):
        d = min(np.int64(delays[k]), d + 1) if fifo else np.int64(delays[k])
        z[at_w:at_q], z[at_r:] = w[k], r[k]
        for n in range(len(K1)):
            past[k, n] = _added(0.0, K1, n, z, 0)
        for n in range(nu):
            first = set_of[d] * nu + n
            u = _added(past[k - d, first] if d <= k else 0.0, K2, first, z, at_xr)
            position[n] = _limited(u, position[n], bounds, n) if limited else u
            z[nx + n] = position[n]
        for n in range(nq):
            z[at_q + n] = delta[k, 0] * _added(0.0, J, n, z, 0)
        e = 0.0
        for n in range(len(error)):
            e = max(e, abs(_added(0.0, error, n, z, 0)))
        largest = _moved(next_state, z, nx, at_xr, following)
        if largest >= DIVERGED:
            scores[k:] = np.inf
            return
        score = max(score, largest if by_state else e)
        scores[k] = score


@cache
def _compiled() -> Any:
    """Return the compiled function that flies paths; it closes over what it calls elsewhere, for numba's cache."""
    sources = Path(str(philox.__file__)).read_text()

    def fly(stacked, tails, drawn, stream, by_state, cuts, root, delays, scores):  # type: ignore[no-untyped-def]
        """Copy what is kept of parents, draw the rest, and score it."""
        _ = sources
        seed, turn, purpose = stream
        killed, parents, kept = cuts
        for n in range(len(killed)):
            i = killed[n]
            delays[i, : kept[n]] = delays[parents[n], : kept[n]]
            _draw(tails, (seed, turn, purpose), i, kept[n], delays[i])
            at = root[i]
            signals = drawn.w[at], drawn.r[at], drawn.delta[at], drawn.x0[at]
            _score(stacked, by_state, tails.fifo, delays[i], *signals, scores[i])

    return njit(cache=True, nogil=True, error_model="numpy")(fly)
