"""The numbers of a replayed witness, from flights made up so that the answer is known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gains.store import load_model
from gains.witnessfile import Witness
from sitl.flightdata import FlightData
from sitl.scenario import load_scenario
from sitl.summary import failsafe_reaction_samples, link_summary, summary_table
from sitl.witness import growth_per_sample, mismatches, witness_summary

SCENARIO = load_scenario("witness")
MODEL = load_model("hirm")
TS_NS = MODEL.Ts_ns
WITNESS = Witness("", "", 0.025, 1, 3, "fifo", 1.01, (1, 2, 3))


def truth(k: int, d: int | None, x: Any = (0.0, 0.0, 1.0), at_ns: int | None = None) -> tuple[str, int, dict]:
    body = {"k": k, "x": list(x), "u": [0.0], "j": None if d is None else k - d, "d": d, "w": [0.0], "late_ns": 0}
    return "plant/truth", k * TS_NS if at_ns is None else at_ns, body


def change(at_ns: int, before: str, after: str) -> tuple[str, int, dict]:
    data = {"from": before, "to": after}
    return "events", at_ns, {"kind": "failsafe", "node": "autopilot", "text": "", "data": data}


def flight_of(x: np.ndarray, d: list[int | None] | None = None) -> FlightData:
    delays = d or [1] * len(x)
    return FlightData.from_records([truth(k, delays[k], row) for k, row in enumerate(x)], MODEL)


def grown(rate: float, samples: int, period: int = 7) -> np.ndarray:
    """Return a state that grows by ``rate`` per sample and wobbles within each period; shape (samples, 3)."""
    k = np.arange(samples)
    wobble = np.stack([np.cos(2 * np.pi * k / period + phase) for phase in (0.0, 1.0, 2.0)], axis=1)
    return MODEL.trim.x + 1e-6 * rate ** k[:, None] * (2.0 + wobble)


# ----------------------------------------------------------------------------------------------- growth


@pytest.mark.parametrize("rate", [0.98, 1.0, 1.0017, 1.05])
def test_the_growth_of_a_state_that_wobbles_within_the_period_is_exact(rate: float) -> None:
    free = np.zeros(400, dtype=bool)
    assert growth_per_sample(7, flight_of(grown(rate, 400)), free) == pytest.approx(rate, rel=1e-9)


@given(
    rate=st.floats(0.98, 1.05),
    turn=st.floats(0.0, np.pi),
    start=st.floats(0.0, 6.0),
    noise=st.sampled_from([0.0, 1e-7]),
)
def test_the_growth_of_a_state_that_turns_from_period_to_period_is_exact(
    rate: float, turn: float, start: float, noise: float
) -> None:
    k = np.arange(420)
    phases = start + np.array([0.0, 1.0, 2.0]) + turn * k[:, None] / 7 + 2 * np.pi * k[:, None] / 7
    x = 1e-3 * rate ** k[:, None] * (np.cos(phases) + noise * np.random.default_rng(1).normal(size=(420, 3)))
    measured = growth_per_sample(7, flight_of(x + MODEL.trim.x), np.zeros(420, dtype=bool))
    assert measured == pytest.approx(rate, rel=1e-4)


def test_what_comes_after_the_first_saturation_does_not_count() -> None:
    x = np.concatenate([grown(1.01, 300), np.full((100, 3), 0.3)])
    saturated = np.arange(400) >= 300
    assert growth_per_sample(7, flight_of(x), saturated) == pytest.approx(1.01, rel=1e-9)
    assert growth_per_sample(7, flight_of(x), np.zeros(400, dtype=bool)) != pytest.approx(1.01, rel=1e-3)


def test_a_transient_of_the_first_half_does_not_count() -> None:
    x = grown(1.01, 400) + 0.1 * 0.8 ** np.arange(400)[:, None]
    assert growth_per_sample(7, flight_of(x), np.zeros(400, dtype=bool)) == pytest.approx(1.01, rel=1e-6)


@pytest.mark.parametrize(
    "x", [grown(1.01, 48), np.zeros((400, 3)), np.full((400, 3), 1e200)], ids=["short", "zero", "overflow"]
)
def test_where_there_is_no_growth_to_see_there_is_no_number(x: np.ndarray) -> None:
    flight = flight_of(x)
    assert growth_per_sample(7, flight, np.zeros(len(x), dtype=bool)) is None
    found = witness_summary(WITNESS, flight_of(x[:10]), np.zeros(10, dtype=bool))
    assert (found["growth_per_sample"], found["growth_error"]) == (None, None)


def test_a_growth_over_missing_samples_is_not_measured() -> None:
    x = grown(1.01, 400)
    records = [truth(k, 1, row) for k, row in enumerate(x) if k != 200]
    assert growth_per_sample(7, FlightData.from_records(records, MODEL), np.zeros(399, dtype=bool)) is None


def test_the_error_compares_the_logarithms() -> None:
    x, free = grown(1.011, 400, 3), np.zeros(400, dtype=bool)
    found = witness_summary(WITNESS, flight_of(x), free)
    assert found["growth_error"] == pytest.approx(abs(np.log(1.011) / np.log(1.01) - 1), rel=1e-6)
    assert witness_summary(replace(WITNESS, growth_per_sample=1.0), flight_of(x), free)["growth_error"] is None


# ------------------------------------------------------------------------------------------- mismatches


@given(lived=st.lists(st.none() | st.integers(1, 4), min_size=1, max_size=30))
def test_a_mismatch_is_a_sample_that_lived_another_delay_than_prescribed(lived: list[int | None]) -> None:
    prescribed = wrong = 0
    for k, d in enumerate(lived):
        if k >= WITNESS.delays[k % 3]:
            prescribed += 1
            wrong += d != WITNESS.delays[k % 3]
    flight = flight_of(np.ones((len(lived), 3)), lived)
    assert mismatches(WITNESS, flight) == (prescribed, wrong)
    found = witness_summary(WITNESS, flight, np.zeros(len(lived), dtype=bool))
    assert found["mismatch_fraction"] == (wrong / prescribed if prescribed else None)


# --------------------------------------------------------------------------------------------- reaction


TO_TRACKING = change(0, "STANDBY", "TRACKING")


@pytest.mark.parametrize(
    ("records", "samples"),
    [
        ([TO_TRACKING, truth(1, 4), truth(2, 1)], None),
        ([TO_TRACKING, truth(4, 5), change(4 * TS_NS, "TRACKING", "HOLD")], 0.0),
        ([TO_TRACKING, truth(4, 5), change(4 * TS_NS - 1, "TRACKING", "HOLD")], 0.0),
        ([TO_TRACKING, truth(4, 5), truth(5, 5), change(5 * TS_NS + TS_NS // 2, "TRACKING", "HOLD")], 1.5),
        ([TO_TRACKING, truth(4, 5), truth(10, 5)], 6.0),
        ([truth(4, 5), truth(10, 5)], None),
        ([TO_TRACKING, change(2 * TS_NS, "TRACKING", "HOLD"), truth(4, 5), truth(10, 5)], None),
        ([TO_TRACKING, ("autopilot/command", TS_NS, {"d": 5}), change(3 * TS_NS, "TRACKING", "HOLD")], 2.0),
        ([TO_TRACKING, ("autopilot/command", TS_NS, {"d": None}), truth(9, 1)], None),
    ],
    ids=[
        *("inside", "at once", "clocks differ by a nanosecond", "late", "never", "not yet tracking", "had left before"),
        *("forecast", "unknown forecast"),
    ],
)
def test_the_reaction_lasts_from_the_delay_leaving_the_window_to_the_mode_leaving_tracking(
    records: list, samples: float | None
) -> None:
    found = failsafe_reaction_samples(records, SCENARIO)
    assert found == samples if samples is None else found == pytest.approx(samples, abs=0.01)


# ---------------------------------------------------------------------------------------------- summary


def test_what_the_gate_swallowed_is_not_lost() -> None:
    def packet(fate: str) -> tuple[str, int, dict]:
        delivered_ns = 1 if fate == "delivered" else None
        return "link/down", 0, {"delivered_ns": delivered_ns, "fate": fate, "copy": 0, "number": 1, "sent_ns": 0}

    records = [packet(fate) for fate in ("delivered", "gated", "gated", "lost")]
    counts = link_summary(records)["down"]
    assert counts == {"sent": 4, "delivered": 1, "lost": 1, "duplicated": 0, "reordered": 0}
    flight = FlightData.from_records([truth(0, None), *records], MODEL)
    assert len(flight.links["down"].delay_s) == 2


def test_the_table_shows_the_witness() -> None:
    numbers = {"growth_per_sample": 1.0050232, "predicted": 1.005, "mismatches": 3, "prescribed_samples": 1000}
    summary = {
        **dict.fromkeys(("scenario", "title", "gains", "plant", "certificate", "mode_at_end"), ""),
        **dict.fromkeys(("samples", "duration_s", "seed", "failsafe_events", "late_ticks"), 0),
        **{f"{name}_error_rad": 0.0 for name in ("rms", "max", "final")},
        "delay": {"true_histogram": {}, "estimated_exact_fraction": None, "outside_fraction": None},
        "link": {},
        "witness": numbers,
    }
    cells = list(summary_table(summary, []).columns[1].cells)
    assert "growth per sample 1.005023, predicted 1.005000; 3 of 1000 samples lived another delay" in cells
    numbers["growth_per_sample"] = None  # type: ignore[assignment]
    assert any("too short to tell" in str(cell) for cell in summary_table(summary, []).columns[1].cells)
