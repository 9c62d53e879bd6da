"""The worst flights: against brute force, against the H∞ norm, against η, and flown once more."""

from __future__ import annotations

import itertools
import json
import math
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from gains.model import Gains, Model, Reference, Trim, Uncertainty
from gains.store import load_gains
from sitl.campaign.adversary import flown_gain, search


def scalar_law(a: float = 0.9, k: float = -0.3, **more: object) -> Gains:
    """Return x(k+1) = a x + u + w, u = k x(k − d), e = x."""
    one = np.ones((1, 1))
    model = Model(
        name="scalar",
        Ts=0.1,
        A=a * one,
        B=one,
        E=one,
        C=one,
        D=0.0 * one,
        states=("x",),
        trim=Trim(np.zeros(1), np.zeros(1)),
        **more,  # type: ignore[arg-type]
    )
    return Gains(name="scalar", model=model, d_min=0, d_max=3, K1=k * one, K2=None)


def operator(law: Gains, delays: tuple[int, ...], deltas: tuple[float, ...] | None = None) -> np.ndarray:
    """Return e as a matrix of w, by flying an impulse at each sample."""
    N = len(delays)
    a, k = law.model.A[0, 0], law.K1[0, 0]
    columns = []
    for at in range(N):
        x = [0.0]
        for j, d in enumerate(delays):
            u = k * x[j - d] if d <= j else 0.0
            extra = 0.0 if deltas is None else deltas[j] * 0.2 * (x[j] + u)
            x.append(a * x[j] + u + extra + (1.0 if j == at else 0.0))
        columns.append(x[:N])
    return np.array(columns).T


def test_a_short_horizon_is_searched_to_its_true_worst() -> None:
    law, N = scalar_law(), 7
    brute = max(np.linalg.svd(operator(law, d), compute_uv=False)[0] for d in itertools.product((0, 1, 2), repeat=N))
    found = search(law, 0, 2, samples=N, starts=6)
    assert found.gain == pytest.approx(brute, rel=1e-9)


def test_fifo_is_kept_and_searched_to_its_true_worst() -> None:
    law, N = scalar_law(), 7
    admissible = [
        d for d in itertools.product((0, 1, 2, 3), repeat=N) if all(after <= now + 1 for now, after in pairwise(d))
    ]
    brute = max(np.linalg.svd(operator(law, d), compute_uv=False)[0] for d in admissible)
    found = search(law, 0, 3, transitions="fifo", samples=N, starts=8)
    assert all(after <= now + 1 for now, after in pairwise(found.delays))
    assert found.gain <= brute * (1.0 + 1e-12)
    assert found.gain >= 0.99 * brute


def test_a_short_horizon_with_uncertainty_is_searched_to_its_true_worst() -> None:
    one = np.ones((1, 1))
    law, N = scalar_law(uncertainty=Uncertainty(F=0.2 * one, J1=one, J2=one, delta_max=0.5)), 5
    brute = max(
        np.linalg.svd(operator(law, d, deltas), compute_uv=False)[0]
        for d in itertools.product((0, 1), repeat=N)
        for deltas in itertools.product((-0.5, 0.5), repeat=N)
    )
    found = search(law, 0, 1, delta_max=0.5, samples=N, starts=6)
    assert np.abs(found.delta).max() == 0.5
    assert found.gain == pytest.approx(brute, rel=1e-9)


def test_at_one_delay_a_long_horizon_tends_to_the_h_infinity_norm() -> None:
    law = scalar_law()
    theta = np.linspace(0.0, math.pi, 200_001)
    z = np.exp(1j * theta)
    norm = np.max(np.abs(1.0 / (z - 0.9 + 0.3 * z**-2)))
    gains = [search(law, 2, 2, samples=N, starts=1).gain for N in (40, 160, 640)]
    assert all(gain <= norm for gain in gains)
    assert gains == sorted(gains)
    assert gains[-1] == pytest.approx(norm, rel=1e-3)


def test_the_gain_is_that_of_the_flight_of_the_equations() -> None:
    law = load_gains("hirm-paper")
    found = search(law, 1, 3, samples=60, starts=2)
    assert set(found.delays) <= {1, 2, 3}
    assert np.sum(found.w**2) + np.sum(found.r**2) == pytest.approx(1.0)
    assert found.gain == flown_gain(law, found)
    assert found.gain == pytest.approx(independent_gain(law, found), rel=1e-12)


def independent_gain(law: Gains, found: object) -> float:
    """Return ‖e‖/‖v‖ with the augmented state of Eq. (11), one matrix per delay, not sample by sample."""
    model, reference = law.model, law.model.reference
    assert isinstance(reference, Reference)
    assert law.K2 is not None
    N, n = len(found.delays), model.nx  # type: ignore[attr-defined]
    big = np.zeros(((N + 1) * 2 * n,) * 2)
    x = lambda k: slice(2 * n * k, 2 * n * k + n)  # noqa: E731
    xr = lambda k: slice(2 * n * k + n, 2 * n * (k + 1))  # noqa: E731
    forced = np.zeros((N + 1) * 2 * n)
    for k, d in enumerate(found.delays):  # type: ignore[attr-defined]
        big[x(k + 1), x(k)] += model.A
        if d <= k:
            big[x(k + 1), x(k - d)] += model.B @ law.K1
        big[x(k + 1), xr(k)] += model.B @ law.K2
        big[xr(k + 1), xr(k)] += reference.Ar
        forced[x(k + 1)] = model.E @ found.w[k]  # type: ignore[attr-defined]
        forced[xr(k + 1)] = reference.Br @ found.r[k]  # type: ignore[attr-defined]
    states = np.linalg.solve(np.eye(len(big)) - big, forced)
    errors = [model.C @ states[x(k)] - reference.Cr @ states[xr(k)] for k in range(N)]  # D is 0
    return float(np.linalg.norm(errors))


def test_the_same_question_has_the_same_answer() -> None:
    law = scalar_law()
    one, other = (search(law, 0, 2, samples=12, starts=3, seed=7) for _ in range(2))
    assert one.gain == other.gain
    assert one.delays == other.delays
    assert np.array_equal(one.w, other.w)


def test_hirm_within_15_percent_of_eta_and_never_above() -> None:
    answer = adversary("--gains", "hirm-paper", "--delay", "1:3", "--starts", "1")
    assert answer["eta_source"] == "computed and verified"
    assert 0.85 * answer["eta"] <= answer["gain"] <= answer["eta"]


@pytest.mark.long
def test_hirm_within_10_percent_of_the_eta_that_memory_tightens() -> None:
    answer = adversary("--gains", "hirm-paper", "--delay", "1:3", "--memory", "2")
    assert 0.9 * answer["eta"] <= answer["gain"] <= answer["eta"]


@pytest.mark.long
@pytest.mark.parametrize(
    ("gains", "more"), [("hirm-d6", ()), ("pendulum-paper", ()), ("hirm-paper", ("--delta", "0.05"))]
)
def test_no_worst_flight_exceeds_eta(gains: str, more: tuple[str, ...]) -> None:
    window = ("--delay", "1:3") if more else ()
    answer = adversary("--gains", gains, *window, *more)
    assert 0.8 * answer["eta"] <= answer["gain"] <= answer["eta"]


def adversary(*options: str) -> dict[str, float]:
    done = subprocess.run(
        [sys.executable, "-m", "sitl", "adversary", *options, "--json"], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    answer: dict[str, float] = json.loads(done.stdout)
    return answer


def test_the_csv_holds_what_was_flown(tmp_path: Path) -> None:
    path = tmp_path / "worst.csv"
    answer = adversary("--gains", "hirm-paper", "--delay", "1:2", "--samples", "40", "--starts", "1", "-o", str(path))
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    assert lines[0] == "k,d,w1,r1"
    rows = np.array([[float(cell) for cell in line.split(",")] for line in lines[1:]])
    assert rows[:, 1].astype(int).tolist() == answer["delays"]
    assert np.sum(rows[:, 2:] ** 2) == pytest.approx(1.0)
