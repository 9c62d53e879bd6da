"""Campaigns: plant-steps per second against NumPy batching, python-control and what the machine could do; two threads.

NumPy does the same job, draws included, for thousands of flights at a time, as one writes it without a compiler;
python-control simulates the delayed loop of one flight, a state space of as many states, with ``forced_response``.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from multiprocessing import get_context
from multiprocessing.queues import SimpleQueue
from multiprocessing.synchronize import Barrier

import control
import numpy as np

from gains.store import load_gains
from gains.switched import eq9
from sitl.campaign.distributions import Signal, Span, parse_delays
from sitl.campaign.engine import fly_range
from sitl.campaign.job import Campaign
from sitl.campaign.run import run

ROUNDS = 5
SAMPLES = 400
FLIGHTS = 16_384
BATCH = 2048
"""Flights at a time for NumPy: of 512 to 8192 the fastest here."""

LIMIT_NUMPY = 1 / 15
LIMIT_CONTROL = 1 / 1000
LIMIT_WORKERS = 2.0 / 1.7
"""Two workers shall do 1.7 times the work of one where the machine lets two programs do twice that of one."""

DEGREE = math.pi / 180.0
GUST = Signal("sine", Span(0.0, 3.5 * DEGREE), Span(0.5, 10.0))
REFERENCE = Signal("square", Span(0.0, 5.0 * DEGREE), Span(1.0, 10.0))


def campaign(flights: int) -> Campaign:
    law = load_gains("hirm-paper")
    return Campaign(
        law=law,
        plant=law.model,
        plant_name=law.model.name,
        d_min=1,
        d_max=4,
        transitions="any",
        delays=parse_delays("uniform", 1, 4, fifo=False, longest=127),
        link=None,
        gust=GUST,
        reference=REFERENCE,
        delta=Span(0.0, 0.0),
        x0=0.0,
        wind=None,
        limits=False,
        flights=flights,
        samples=SAMPLES,
        seed=1,
    )


def batched(flights: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return gain and rms of flights as NumPy flies them."""
    law = load_gains("hirm-paper")
    model, reference = law.model, law.model.reference
    assert reference is not None
    assert law.K2 is not None
    rng = np.random.default_rng(seed)
    d = rng.integers(1, 5, size=(SAMPLES, flights))
    signals = []
    for signal in (GUST, REFERENCE):
        low, high = signal.period_s
        amplitude = rng.uniform(*signal.amplitude, size=flights)
        period = low / model.Ts * (high / low) ** rng.random(flights)
        signals.append((amplitude, period, rng.random(flights)))
    x, xr = np.zeros((3, flights)), np.zeros((3, flights))
    history = np.zeros((8, flights))
    every = np.arange(flights)
    error_squared, input_squared = np.zeros(flights), np.zeros(flights)
    max_error, max_state = np.zeros(flights), np.zeros(flights)
    for k in range(SAMPLES):
        (a, period, phase), (b, other, start) = signals
        w = a * np.sin(2.0 * np.pi * (k / period + phase))
        half = np.maximum(1.0, np.round(other / 2.0))
        r = np.where(np.floor((k + np.floor(start * other)) / half) % 2.0 == 0.0, b, -b)
        history[k % 8] = law.K1[0] @ x
        u = history[(k - d[k]) % 8, every] + law.K2[0] @ xr
        error = model.C[0] @ x - reference.Cr[0] @ xr
        error_squared += error * error
        input_squared += w * w + r * r
        np.maximum(max_error, np.abs(error), out=max_error)
        x = model.A @ x + model.B @ u[None] + model.E @ w[None]
        xr = reference.Ar @ xr + reference.Br @ r[None]
        np.maximum(max_state, np.abs(x).max(axis=0), out=max_state)
    return np.sqrt(error_squared / input_squared), np.sqrt(error_squared / SAMPLES)


def python_control() -> Callable[[], object]:
    law = load_gains("hirm-paper")
    loop = eq9(law, 1, 4)
    mode = loop.index(4)
    system = control.ss(loop.F[mode], loop.G[mode], loop.H[mode], loop.Hv[mode], law.model.Ts)
    times = np.arange(SAMPLES) * law.model.Ts
    inputs = np.random.default_rng(1).normal(size=(loop.m, SAMPLES))
    return lambda: control.forced_response(system, times, inputs)


def multiply_adds_per_s() -> float:
    """Return what one core does in double precision, by a matrix product in its cache."""
    from threadpoolctl import threadpool_limits

    left = np.random.default_rng(1).normal(size=(384, 384))
    with threadpool_limits(1):
        return 384**3 / min(seconds(lambda: left @ left) for _ in range(20))


def copied_per_s() -> float:
    """Return the bytes per second of a copy that no cache holds."""
    source = np.ones(1 << 24)
    target = np.empty_like(source)
    return 2 * source.nbytes / min(seconds(lambda: np.copyto(target, source)) for _ in range(5))


def counted(until: float) -> int:
    """Return how far a plain loop counts until a time."""
    n = 0
    while time.perf_counter() < until:
        for _ in range(10_000):
            n += 1
    return n


def _count_for(duration_s: float, together: Barrier, counts: SimpleQueue[int]) -> None:
    together.wait()
    counts.put(counted(time.perf_counter() + duration_s))


def machine_scaling(duration_s: float = 0.5) -> float:
    """Return how many times as far two programs count together as one alone, each in a process of its own."""

    def together(programs: int) -> int:
        context = get_context("spawn")
        barrier, counts = context.Barrier(programs), context.SimpleQueue()
        running = [context.Process(target=_count_for, args=(duration_s, barrier, counts)) for _ in range(programs)]
        for program in running:
            program.start()
        total = sum(counts.get() for _ in running)
        for program in running:
            program.join()
        return total

    return together(2) / together(1)


def seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def measure() -> list[tuple[str, float, float, str]]:
    """Return (what, ratio, limit, note)."""
    job, forced = campaign(4 * FLIGHTS), python_control()
    fly_range(job, 0, 64)
    ours, both, numpy, theirs, scaling = [], [], [], [], []
    for _ in range(ROUNDS + 1):
        numpy.append(seconds(lambda: batched(BATCH, 1)) / (BATCH * SAMPLES))
        theirs.append(min(seconds(forced) for _ in range(5)) / SAMPLES)
        ours.append(run(job, scheduler="none", workers=1).seconds / (job.flights * SAMPLES))
        both.append(run(job, scheduler="none", workers=2).seconds / (job.flights * SAMPLES))
        scaling.append(machine_scaling())

    def ratio(of: list[float], to: list[float]) -> float:
        return statistics.median(a / b for a, b in zip(of[1:], to[1:], strict=True))

    rate, pair = 1e-6 / statistics.median(ours[1:]), 1e-6 / statistics.median(both[1:])
    scales = statistics.median(scaling[1:])
    peak, bandwidth = multiply_adds_per_s(), copied_per_s()
    per_step = 42  # products and sums of Eqs. (4), (8), (9) for this model
    return [
        ("campaign, all cores / NumPy batching", ratio(both, numpy), LIMIT_NUMPY,
         f"{pair:.0f} M plant-steps/s, NumPy {1e-6 / statistics.median(numpy[1:]):.1f} M"),
        ("campaign, all cores / forced_response of python-control", ratio(both, theirs), LIMIT_CONTROL,
         f"{1e3 / pair:.2f} ns a plant-step against {1e9 * statistics.median(theirs[1:]):.0f} ns"),
        ("two programs as this machine scales them / campaign with two workers", scales * ratio(both, ours),
         LIMIT_WORKERS, f"{scales:.2f} times one, {pair / rate:.2f} times; {pair:.0f} and {rate:.0f} M plant-steps/s"),
        ("multiply-adds a core could do / those that it did", peak / (per_step * rate * 1e6), math.inf,
         f"{peak / 1e9:.1f} G/s in a matrix product; memory {bandwidth / 1e9:.1f} GB/s, the loop stays in the cache"),
    ]  # fmt: skip


if __name__ == "__main__":
    for row in measure():
        print(row)
