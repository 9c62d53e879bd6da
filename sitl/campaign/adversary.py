"""The worst that can be found inside the certified sets: delays, disturbance, reference and uncertainty.

Maximised is ‖e‖/‖v‖ over a finite horizon from rest, v = [w; r]: a number that η may not be below. The search begins
with the worst periodic sequence (:mod:`gains.lower_gain`), the longest delay and random runs, and takes changes that
lift the gain while there are any: of the delays by :func:`~sitl.campaign.horizon.best_change`, of the uncertainty by
:meth:`~sitl.campaign.horizon.Horizon.aligned`. What it found is flown once more by Eqs. (4) to (9) as they stand, and
that is the gain that is told: the search may be wrong, the number not.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gains.atomic import replace_file
from gains.lower_gain import worst_gain
from gains.model import GainLaw, Matrix, sets_of
from gains.switched import Switched, Transitions, eq9, graph
from gains.witness import successors
from sitl.campaign.horizon import Horizon, Modes, best_change, modes_of

__all__ = ["Worst", "search", "worst_csv"]

LEVEL = 1.0 + 1e-7
"""γ over the gain of what was found so far."""

BETTER = 1.0 + 1e-6
"""A change counts when the gain rises so much."""

RUNS = (1, 2, 4, 8)
"""Samples that are given another mode at once."""

CHANGES = 60
"""The most sweeps from one start."""

MAX_SIGNS = 3
"""Blocks of Δ with more rows or columns are given these many signs, and zeros beyond."""


@dataclass(frozen=True, slots=True, eq=False)
class Worst:
    """What was found.

    Attributes
    ----------
    gain : float
        ‖e‖/‖v‖ of Eqs. (4), (8), (9) with what follows, from rest.
    delays : tuple of int
        d(k).
    sets : tuple of int
        The set of gains at each sample; 0 but for schedules.
    w, r : ndarray, shapes (N, nw) and (N, inputs)
        ‖[w; r]‖ = 1.
    delta : ndarray, shape (N, rows of Δ, columns of Δ)
        Bounded by delta_max; without rows where there is no uncertainty.
    sweeps : int
    starts : int
    """

    gain: float
    delays: tuple[int, ...]
    sets: tuple[int, ...]
    w: Matrix
    r: Matrix
    delta: Matrix
    sweeps: int
    starts: int


def search(
    law: GainLaw,
    d_min: int,
    d_max: int,
    *,
    transitions: Transitions = "any",
    delta_max: float = 0.0,
    samples: int = 1200,
    starts: int = 3,
    seed: int = 1,
) -> Worst:
    """Return the worst that was found; the same question has the same answer.

    Parameters
    ----------
    law : Gains or Schedule
    d_min, d_max : int
        The window.
    transitions : {"any", "fifo"}
    delta_max : float
        Bound on ‖Δ‖.
    samples : int
        The horizon: the longer, the nearer to the gain over all time.
    starts : int
        Sequences that the search begins with; the first is the worst periodic one.
    seed : int
        Of the sequences from the third on.
    """
    switched = eq9(law, d_min, d_max, delta_max)
    deltas = _signs(switched)
    modes, variants = modes_of(switched, deltas), len(deltas)
    may = successors(graph(switched, law, transitions), len(switched.modes))
    allowed = np.kron(may, np.ones((variants, variants), dtype=bool))
    best: tuple[float, NDArray[np.int64], Matrix] | None = None
    sweeps = 0
    for start in _starts(switched, law, transitions, may, samples, starts, seed):
        gain, sequence, v, swept = _climbed(modes, variants * start, allowed, variants)
        sweeps += swept
        if best is None or gain > best[0]:
            best = gain, sequence, v
    assert best is not None
    _, sequence, v = best
    keys = [switched.modes[i // variants] for i in sequence]
    nw = law.model.nw
    blocks = delta_max * deltas[sequence % variants]
    worst = Worst(
        0.0,
        tuple(key.d for key in keys),
        tuple(key.gain_set for key in keys),
        v[:, :nw],
        v[:, nw:],
        blocks,
        sweeps,
        starts,
    )
    return replace(worst, gain=flown_gain(law, worst))


def _signs(switched: Switched) -> Matrix:
    """Return Δ of norm 1: signs on the diagonal, all combinations; one that is empty without uncertainty."""
    shape = switched.U.shape[1], switched.J.shape[1]
    if not switched.robust:
        return np.zeros((1, *shape))
    diagonal = min(*shape, MAX_SIGNS)
    found = np.zeros((2**diagonal, *shape))
    for block, signs in zip(found, product((1.0, -1.0), repeat=diagonal), strict=True):
        block[range(diagonal), range(diagonal)] = signs
    return found


def _starts(
    switched: Switched,
    law: GainLaw,
    transitions: Transitions,
    may: NDArray[np.bool_],
    samples: int,
    count: int,
    seed: int,
) -> Iterator[NDArray[np.int64]]:
    """Yield sequences of modes: the worst periodic one, the longest delay, random ones of runs."""
    nominal = eq9(law, min(mode.d for mode in switched.modes), max(mode.d for mode in switched.modes))
    _, cycle = worst_gain(nominal, graph(nominal, law, transitions))
    longest = int(np.argmax([mode.d for mode in switched.modes]))
    given = [np.resize(np.array(cycle), samples), np.full(samples, longest)]
    yield from given[:count]
    rng = np.random.default_rng(seed)
    for _ in range(count - len(given)):
        sequence = np.empty(samples, dtype=np.int64)
        mode = longest
        for k in range(samples):
            if k == 0 or rng.random() < 0.1 or not may[mode, mode]:
                mode = int(rng.choice(np.flatnonzero(may[mode])))
            sequence[k] = mode
        yield sequence


def _climbed(
    modes: Modes, sequence: NDArray[np.int64], allowed: NDArray[np.bool_], variants: int
) -> tuple[float, NDArray[np.int64], Matrix, int]:
    """Return gain, sequence, v and sweeps of where changes lead to that lift the gain."""
    loop = Horizon(modes, sequence)
    gain, v = loop.gain()
    before, swept = 0.0, 0
    while gain > before * BETTER and swept < CHANGES:
        before, swept = gain, swept + 1
        while variants > 1:
            turned = loop.aligned(v, variants)
            other = Horizon(modes, turned)
            raised, its = other.gain(v)
            if raised <= gain * BETTER:
                break
            gain, v, sequence, loop = raised, its, turned, other
        changed = best_change(modes, sequence, gain * LEVEL, allowed, RUNS)
        other = Horizon(modes, changed)
        raised, its = other.gain(v)
        if raised > gain:
            gain, v, sequence, loop = raised, its, changed, other
    return gain, sequence, v, swept


def flown_gain(law: GainLaw, worst: Worst) -> float:
    """Return ‖e‖/‖v‖ of Eqs. (4), (6) to (9), sample by sample in plain NumPy, from rest."""
    model, reference, uncertainty = law.model, law.model.reference, law.model.uncertainty
    sets = sets_of(law)
    x = np.zeros(model.nx)
    xr = np.zeros(0 if reference is None else len(reference.Ar))
    past: list[Matrix] = []
    squared = 0.0
    for k, (d, chosen) in enumerate(zip(worst.delays, worst.sets, strict=True)):
        past.append(x)
        gains = sets[chosen]
        u = gains.K1 @ past[k - d] if d <= k else np.zeros(model.nu)
        if gains.K2 is not None:
            u = u + gains.K2 @ xr
        e = model.C @ x + model.D @ u
        following = model.A @ x + model.B @ u + model.E @ worst.w[k]
        if uncertainty is not None and worst.delta.size:
            following = following + uncertainty.F @ worst.delta[k] @ (uncertainty.J1 @ x + uncertainty.J2 @ u)
        if reference is not None:
            e = e - reference.Cr @ xr
            xr = reference.Ar @ xr + reference.Br @ worst.r[k]
        squared += float(e @ e)
        x = following
    return float(np.sqrt(squared / (np.sum(worst.w**2) + np.sum(worst.r**2))))


def worst_csv(path: Path, worst: Worst, about: dict[str, Any]) -> None:
    """Write d, w, r and Δ, a line for each sample after ``# key: value`` lines."""
    blocks = worst.delta.reshape(len(worst.delays), -1)
    names = ["k", "d"]
    for name, columns in (("w", worst.w.shape[1]), ("r", worst.r.shape[1]), ("delta", blocks.shape[1])):
        names += [f"{name}{n + 1}" for n in range(columns)]
    lines = [f"# {key}: {value}" for key, value in about.items()] + [",".join(names)]
    for k, d in enumerate(worst.delays):
        numbers = np.concatenate([worst.w[k], worst.r[k], blocks[k]])
        lines.append(",".join([str(k), str(d), *(repr(float(number)) for number in numbers)]))
    replace_file(path, ("\n".join(lines) + "\n").encode())
