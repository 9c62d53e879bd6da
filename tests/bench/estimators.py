"""What the forecast of the delay costs and what it is worth.

Cost: every call that one flight makes of clock and delay estimator, recorded and made again on new ones, per sample,
against parsing one ATTITUDE. Worth, printed as tables: flights over each link, beside the best possible forecast,
beside what others do with TIMESYNC (``tests/integration/baselines.py``), and by the tracking error.
"""

from __future__ import annotations

import math
import statistics
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table

from autopilot.clocksync import ClockSync
from autopilot.delay import DelayEstimator
from autopilot.link.wire import AUTOPILOT, PLANT, Attitude, Wire
from sitl.flight import virtual_network
from tests.integration.baselines import compare
from tests.integration.estimation import CASES, TS_NS, Case, Forecasts, fly, scenario_of, score, tracking_errors
from tests.integration.forecasters import best

SEED = 3
RECORDED_S = 300.0
TRACKED_S = 30.0
ROUNDS = 9
FRAMES = 2000
LIMIT = 2.0
"""Against pymavlink's parser, which is what an autopilot in Python would parse with."""
LIMIT_OURS = 4.0
"""Against our own, which takes half the time."""

OTHERS = ("link", "", "bias", "spread", "wrong", "from, s", "then", "ours")
"""The last three: since when, how often wrong from then on, and how often we were at the same time."""

Call = tuple[str, str, tuple[Any, ...]]
"""Object ("clock" or "delay"), method or property, arguments."""


class Tapped:
    """An estimator that notes what is asked of it."""

    def __init__(self, target: object, name: str, calls: list[Call]) -> None:
        self._target, self._name, self._calls = target, name, calls

    def __getattr__(self, what: str) -> Any:
        value = getattr(self._target, what)
        if not callable(value):
            if isinstance(getattr(type(self._target), what, None), property):
                self._calls.append((self._name, what, ()))
            return value

        def noted(*arguments: Any) -> Any:
            self._calls.append((self._name, what, arguments))
            return value(*arguments)

        return noted


def record() -> tuple[list[Call], int]:
    """Return the calls of one flight, and its number of samples."""
    scenario = scenario_of(Case("LTE", False), SEED, RECORDED_S)
    network, plant = virtual_network(scenario, None)
    (autopilot,) = (p.node for p in network._participants if p.name == "autopilot")
    calls: list[Call] = []
    autopilot.clock = Tapped(autopilot.clock, "clock", calls)  # type: ignore[attr-defined]
    autopilot.delay = Tapped(autopilot.delay, "delay", calls)  # type: ignore[attr-defined]
    network.run(lambda: plant.samples >= scenario.samples, 10**12)
    samples = sum(what == "sent" for _, what, _ in calls)
    assert samples > 0.9 * scenario.samples, "the estimators are used behind the tap's back"
    return calls, samples


def _bound(calls: list[Call]) -> list[tuple[Callable[..., Any], tuple[Any, ...]]]:
    """Return the calls on new objects."""
    objects: dict[str, Any] = {"clock": ClockSync(), "delay": DelayEstimator(TS_NS)}

    def method(name: str, what: str) -> Callable[..., Any]:
        value = getattr(objects[name], what)
        return value if callable(value) else lambda: getattr(objects[name], what)

    return [(method(name, what), arguments) for name, what, arguments in calls]


def _nothing(*_arguments: Any) -> None:
    pass


def replay(calls: list[Call]) -> float:
    """Return the seconds of all calls, without those of calling."""
    bound = _bound(calls)
    empty = [(_nothing, arguments) for _, arguments in bound]
    seconds = []
    for made in (empty, bound):
        start = time.perf_counter()
        for call, arguments in made:
            call(*arguments)
        seconds.append(time.perf_counter() - start)
    return seconds[1] - seconds[0]


def by_method(calls: list[Call], samples: int) -> str:
    """Return the microseconds per sample of what costs most."""
    spent: dict[str, float] = defaultdict(float)
    for (call, arguments), (name, what, _) in zip(_bound(calls), calls, strict=True):
        start = time.perf_counter()
        call(*arguments)
        spent[f"{name}.{what}"] += time.perf_counter() - start
    most = sorted(spent.items(), key=lambda item: -item[1])[:4]
    return ", ".join(f"{what} {seconds / samples * 1e6:.1f}" for what, seconds in most)


def cost() -> list[tuple[str, float, float, str]]:
    """Return (what, ratio, limit, note) for both parsers."""
    calls, samples = record()
    sender, receiver, parser = Wire(PLANT, AUTOPILOT), Wire(AUTOPILOT, PLANT), dialect.MAVLink(None)
    frames = [sender.encode(Attitude(25 * n, 0.01, 0.02, 0.1, 0.001, 0.002, 0.003)) for n in range(FRAMES)]
    estimator, parsers = [], (receiver.decode, parser.parse_buffer)
    parses: tuple[list[float], list[float]] = [], []
    for _ in range(ROUNDS + 1):
        estimator.append(replay(calls) / samples)
        for parse, seconds in zip(parsers, parses, strict=True):
            start = time.perf_counter()
            for frame in frames:
                parse(frame)
            seconds.append((time.perf_counter() - start) / FRAMES)
    rows = []
    named = (("ours", LIMIT_OURS), ("pymavlink", LIMIT))
    for (parser_name, limit), seconds in zip(named, parses, strict=True):
        ratio = statistics.median(e / s for e, s in zip(estimator[1:], seconds[1:], strict=True))
        note = f"{statistics.median(estimator) * 1e6:.1f} us, one parse {statistics.median(seconds) * 1e6:.1f} us"
        rows.append((f"delay estimator per sample / parsing an ATTITUDE, {parser_name}", ratio, limit, note))
    what, ratio, limit, note = rows[0]
    rows[0] = what, ratio, limit, f"{note}; us per sample: {by_method(calls, samples)}"
    return rows


def worth() -> None:
    """Print how good the forecast is, beside others, and what it is good for."""
    forecasts = _table("forecast of d", "link", "exact %", "best", "held %", "said %", "width", "best")
    others = _table("offset error, ms, and wrong d, %; from when there is an offset", *OTHERS)
    tracking = _table("rms error of the pitch angle, degrees", "link", "aligned", "not")
    for case in CASES:
        flight = fly(case, SEED)
        rows, d = flight.applied
        ours, limit = score(Forecasts.of(flight), d), score(best(case, flight.ages_ms[rows]), d)
        shares = [f"{100.0 * share:.2f}" for share in (ours.exact, limit.exact, ours.covered, ours.claimed)]
        forecasts.add_row(str(case), *shares, f"{ours.width:.3f}", f"{limit.width:.3f}")
        for n, row in enumerate(compare(flight)):
            percent = [f"{100.0 * share:.2f}" for share in (row.wrong, row.usable_wrong, row.ours_wrong)]
            numbers = f"{row.bias_ms:.2f}", f"{row.spread_ms:.2f}", percent[0], f"{row.usable_s:.1f}", *percent[1:]
            others.add_row(str(case) if n == 0 else "", row.who, *("-" if text == "nan" else text for text in numbers))
        others.add_section()
        errors = tracking_errors(case, SEED, TRACKED_S)
        tracking.add_row(str(case), *(f"{math.degrees(error):.3f}" for error in errors))
    for table in (forecasts, others, tracking):
        Console().print(table)


def _table(title: str, *columns: str) -> Table:
    return Table(*columns, title=title, box=SIMPLE, padding=(0, 1, 0, 0))


def measure() -> list[tuple[str, float, float, str]]:
    """Return (what, ratio, limit, note) of the cost; print the rest."""
    worth()
    return cost()
