"""The exact answers on the lifted form against the per-mode inequality on the lifting over all past states.

The plain way is the inequality as section 5 states it, one P for each delay, written in cvxpy over nx (d_max + 1) + nr
states and solved by Clarabel with its defaults: it takes seconds to minutes, so it is run once. And a table of cost
against d_max, the plain way only to 4.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TypeVar

from rich.console import Console
from rich.table import Table

from gains.decide import decide
from gains.exact import eta
from gains.store import load_gains
from gains.switched import eq9
from tests.gains import plain
from tests.gains.lifted import full_state

LIMIT = 0.1  # ten times faster
ROUNDS = 3
PLAIN_TO = 4
T = TypeVar("T")


def measure() -> list[tuple[str, float, float, str]]:
    """Return (what, ratio, limit, note) for a window with a proof and for one that only a witness decides."""
    hirm, pendulum = load_gains("hirm-paper"), load_gains("pendulum-paper")
    _table()
    ours, found = _timed(lambda: eta(hirm, 1, 4))
    theirs, expected = _timed(lambda: plain.least_eta(full_state(hirm, 1, 4)), 1)
    assert found.eta is not None
    assert abs(found.eta / expected - 1.0) < 1e-3, (found.eta, expected)
    note = f"eta {found.eta:.4f} in {ours:.2f} s, verified; plain {expected:.4f} in {theirs:.1f} s"
    decided, answer = _timed(lambda: decide(pendulum, 1, 7))
    tried, proved = _timed(lambda: plain.stable(full_state(pendulum, 1, 7)), 1)
    assert not proved
    assert answer.growth is not None
    other = f"{answer.verdict}, {answer.growth:.6f} per sample, in {decided:.2f} s; plain: no proof in {tried:.1f} s"
    return [
        ("exact eta, HIRM 1 to 4 / per-mode inequality over all past states", ours / theirs, LIMIT, note),
        ("decision, pendulum 1 to 7 / per-mode inequality over all past states", decided / tried, LIMIT, other),
    ]


def _table() -> None:
    """Print the cost of η against d_max, for gains that are stable throughout."""
    published = load_gains("hirm-paper")
    assert published.K2 is not None
    gentle = replace(published, name="half of hirm-paper", K1=0.5 * published.K1, K2=0.5 * published.K2)
    table = Table("d_max", "eta", "states", "s", "all past states", "s, plain", title=f"exact eta, {gentle.name}")
    for d_max in range(1, 7):
        full = full_state(gentle, 1, d_max)
        ours, found = _timed(partial(eta, gentle, 1, d_max), 1)
        row = [str(d_max), "-" if found.eta is None else f"{found.eta:.4f}", str(eq9(gentle, 1, d_max).N)]
        theirs = "" if d_max > PLAIN_TO else f"{_timed(partial(plain.least_eta, full), 1)[0]:.2f}"
        table.add_row(*row, f"{ours:.2f}", str(full.N), theirs)
    Console().print(table)


def _timed(ask: Callable[[], T], rounds: int = ROUNDS) -> tuple[float, T]:
    """Return the median seconds of an answer, and the answer."""
    seconds = []
    for _ in range(rounds):
        start = time.perf_counter()
        answer = ask()
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds), answer
