"""What a flight that replays a witness came to: how fast it grew, and whether it lived the delays prescribed.

The loop under a periodic delay sequence of length L is linear and periodic: over one period the lifted state
is multiplied by one matrix, and once its other modes have died out the state grows by rho^(1/L) per sample,
which is what the witness predicts. It is measured from the recorded states alone, over the later half of the
whole periods before the elevator first meets an end of its travel.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gains.witnessfile import Witness
from sitl.flightdata import FlightData

__all__ = ["growth_per_sample", "mismatches", "witness_summary"]

MIN_PERIODS = 4
"""Fewer periods than that do not show a growth."""

ROUNDING = 1e-5
"""What is smaller than that beside the growing mode is the rounding of MAVLink's floats, and no mode."""


def witness_summary(witness: Witness, flight: FlightData, saturated: NDArray[np.bool_]) -> dict[str, Any]:
    """Return the numbers of a replayed witness, as they stand under ``witness`` in a summary.

    ``growth_error`` is |log(measured) / log(predicted) - 1|; measured and error are None where the flight is
    too short to tell, predicted and error where nothing is predicted.

    Parameters
    ----------
    witness : Witness
        What was prescribed.
    flight : FlightData
        What was flown.
    saturated : ndarray of bool, shape (N,)
        Where the elevator stood at an end of its travel.
    """
    measured = growth_per_sample(len(witness.delays), flight, saturated)
    predicted = witness.growth_per_sample
    error = None
    if measured is not None and predicted is not None and predicted != 1.0:
        error = abs(math.log(measured) / math.log(predicted) - 1.0)
    prescribed, missed = mismatches(witness, flight)
    return {
        "period": len(witness.delays),
        "predicted": predicted,
        "growth_per_sample": measured,
        "growth_error": error,
        "prescribed_samples": prescribed,
        "mismatches": missed,
        "mismatch_fraction": missed / prescribed if prescribed else None,
    }


def mismatches(witness: Witness, flight: FlightData) -> tuple[int, int]:
    """Return for how many samples the witness prescribes a command, and how many of them lived another delay.

    At sample k that is the command of sample k - d(k mod L); before sample 0 there is none.
    """
    delays = np.array(witness.delays)[flight.k % len(witness.delays)]
    prescribed = flight.k >= delays
    return int(prescribed.sum()), int(np.count_nonzero(prescribed & (flight.d != delays)))


def growth_per_sample(period: int, flight: FlightData, saturated: NDArray[np.bool_]) -> float | None:
    """Return rho^(1/L), rho the larger |z| with z^2 = a z + b, X(n+2) = a X(n+1) + b X(n) in least squares.

    X(n) holds the deviations from trim of all samples of period n, so two modes, or one that turns, are fitted
    exactly; of one mode alone any a and b with the right root will do, and the smallest are taken.

    None when there are too few periods before the first saturation, samples are missing among them, or the
    state is zero or not finite.
    """
    until = int(np.argmax(saturated)) if saturated.any() else len(flight.k)
    periods = until // period
    first = periods // 2
    if periods - first < MIN_PERIODS or not np.array_equal(flight.k[:until], np.arange(until)):
        return None
    X = (flight.x - flight.model.trim.x)[first * period : periods * period].reshape(periods - first, -1)
    with np.errstate(over="ignore"):
        norm = np.linalg.norm(X, axis=1)
    if not np.all(np.isfinite(norm) & (norm > 0.0)):
        return None
    weight = 1.0 / norm[1:-1, None]  # every period counts alike, however far the loop has grown
    before = np.stack([(weight * X[1:-1]).ravel(), (weight * X[:-2]).ravel()], axis=1)
    (a, b), *_ = np.linalg.lstsq(before, (weight * X[2:]).ravel(), rcond=ROUNDING)
    rho = np.abs(np.roots([1.0, -a, -b])).max()
    return float(rho ** (1.0 / period))
