"""One flight of the reproduction: three nodes, MAVLink, virtual time, and a delay sequence that the link imposes.

What was flown is then computed again without any of that, by the recursions (4), (8) and (9) alone: with the
reference states that the commands recorded, which must give the same flight, and with xr fresh at the actuator, as
Eq. (9) has it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from autopilot.profile import parse_profile
from gains.model import GainLaw, Gains, Matrix, Model
from gains.witnessfile import Witness
from sitl.aircraft.disturbance import HarmonicGust, SquareDelta
from sitl.flight import fly_virtual
from sitl.flightdata import FlightData
from sitl.recorder import FlightRecorder
from sitl.scenario import Scenario, load_scenario
from sitl.witness import mismatches

__all__ = [
    "ROUNDING",
    "Aircraft",
    "Flown",
    "Recursion",
    "fly",
    "follows_eq9",
    "imposed",
    "recursion",
    "rms",
    "scenario",
    "uniform_delays",
]

ROUNDING = 100 * 2.0**-24
"""By how much, relative, a flight may differ from its recursion: MAVLink carries states as 32-bit floats, and a loop
with a memory adds their rounding up."""

Aircraft = Literal["hirm", "pendulum"]

_BASES: dict[Aircraft, str] = {"hirm": "witness", "pendulum": "witness-pendulum"}  # perfect links


class Recursion(NamedTuple):
    """What Eq. (4) gives.

    Attributes
    ----------
    x : ndarray, shape (N, nx)
    u : ndarray, shape (N, nu)
    error : ndarray, shape (N, ny)
        e = y − yr of Eq. (10).
    """

    x: Matrix
    u: Matrix
    error: Matrix


@dataclass(frozen=True, slots=True, eq=False)
class Flown:
    """A flight and what it came to; angles of the numbers in degrees.

    Attributes
    ----------
    flight : FlightData
    prescribed, missed : int
        Samples for which the sequence prescribes a command, and those that lived another delay.
    modelled : float or None
        Largest distance of a state from the recursion of (4) with the recorded delays and reference states, relative to
        the largest state; None where the law is none of Eq. (9).
    eq9 : Recursion or None
        The same flight with xr fresh at the actuator.
    gain : float or None
        ‖e‖₂ / ‖v‖₂ up to the end of the flight; None without disturbance and reference.
    """

    flight: FlightData
    prescribed: int
    missed: int
    modelled: float | None
    eq9: Recursion | None
    gain: float | None

    @property
    def error_deg(self) -> Matrix:
        """First output's error, deg; shape (N,)."""
        return np.rad2deg(self.flight.error[:, 0])

    @property
    def u_deg(self) -> Matrix:
        """First input, deg, where it is an angle; shape (N,)."""
        return np.rad2deg(self.flight.u[:, 0])


def uniform_delays(seed: int, d_min: int, d_max: int, samples: int) -> tuple[int, ...]:
    """Return d(k), independent and uniform on d_min..d_max: it may jump by more than one, as the paper allows."""
    rng = np.random.default_rng(seed)
    return tuple(int(d) for d in rng.integers(d_min, d_max + 1, samples))


def imposed(model: Model, delays: Sequence[int], growth: float = math.nan) -> Witness:
    """Return a delay sequence as the link's gate takes it; ``growth`` is that of the loop under it, where known."""
    largest_jump = max(d - last for last, d in zip((delays[-1], *delays), delays, strict=False))
    transitions = "fifo" if largest_jump <= 1 else "any"
    return Witness("", model.name, model.Ts, min(delays), max(delays), transitions, growth, tuple(delays))


def scenario(
    aircraft: Aircraft,
    gains: str,
    delays: Sequence[int],
    duration_s: float,
    *,
    seed: int,
    step_deg: float = 0.0,
    gust: bool = False,
    delta: bool = False,
    x0: Sequence[float] | None = None,
    actuator: Literal["pwm", "float"] = "float",
    growth: float = math.nan,
) -> Scenario:
    """Return a flight in which sample k lives d(k) = delays[k mod L], and nothing else of the link is felt.

    The failsafe only watches: what is asked is what the law does, also outside the window of its gains.

    Parameters
    ----------
    aircraft : {"hirm", "pendulum"}
    gains : str
        Stored name or file.
    delays : sequence of int
        One period.
    duration_s : float
    seed : int
    step_deg : float
        r from k = 0 on, deg.
    gust, delta : bool
        Eq. (52), Eq. (51).
    x0 : sequence of float or None
        State at k = 0; None for trim.
    actuator : {"float", "pwm"}
    growth : float
        As of :func:`imposed`.

    Raises
    ------
    InputError
        When there are no such gains.
    """
    base = load_scenario(_BASES[aircraft], gains=gains)
    sequence = imposed(base.plant, delays, growth)
    return replace(
        base,
        name="reproduce",
        duration_s=duration_s,
        seed=seed,
        reference=f"{step_deg:g}deg@0s" if step_deg else "",
        actuator=actuator,
        failsafe="monitor",
        latch="last" if sequence.transitions == "any" else "newest",
        servo_timeout=None,
        x0=None if x0 is None else np.array(x0, dtype=np.float64),
        gust=HarmonicGust(base.plant.nw) if gust else None,
        delta=SquareDelta() if delta else None,
        witness_name=None,
        witness=sequence,
        checks=(),
        variants={},
    )


def follows_eq9(law: GainLaw) -> bool:
    """Whether one set of gains flies the law of Eq. (9), and no other controller in its place."""
    return isinstance(law, Gains) and law.controller is None


def rms(values: Matrix) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def fly(flown: Scenario) -> Flown:
    """Fly a scenario of :func:`scenario` in virtual time, and compute it again."""
    with FlightRecorder(None, {"reference": flown.reference}) as recorder:
        fly_virtual(flown, recorder.write)
    flight = FlightData.from_records(recorder.kept, flown.plant, recorder.metadata)
    assert flown.witness is not None
    prescribed, missed = mismatches(flown.witness, flight)
    r = _inputs(flown, len(flight.k))
    modelled, eq9 = None, None
    if follows_eq9(flown.gains):
        again = recursion(flown, flight.d, xr=_applied_references(flight))
        modelled = float(np.max(np.abs(again.x - flight.x)) / np.max(np.abs(flight.x)))
        eq9 = recursion(flown, flight.d)
    v = math.sqrt(float(np.sum(flight.w**2) + np.sum(r**2)))
    gain = math.sqrt(float(np.sum(flight.error**2))) / v if v > 0.0 else None
    return Flown(flight, prescribed, missed, modelled, eq9, gain)


def recursion(flown: Scenario, d: Sequence[float] | Matrix, *, xr: Matrix | None = None) -> Recursion:
    """Return x(k+1) = A x + B u + E w with u of Eq. (9), deviations from trim, under a scenario's gust, Δ and r.

    Parameters
    ----------
    flown : Scenario
        Of a law of Eq. (9), without limits: what is flown here never meets them.
    d : sequence of float, length N
        Delay of the command held over each sample; nan before the first.
    xr : ndarray or None, shape (N, nr)
        The reference state in that command; None for xr(k), fresh at the actuator.
    """
    law, model = flown.gains, flown.plant
    assert isinstance(law, Gains)
    assert follows_eq9(law)
    F, J1, J2 = (np.zeros((model.nx, 1)), np.zeros((1, model.nx)), np.zeros((1, model.nu)))
    if model.uncertainty is not None:
        F, J1, J2 = model.uncertainty.F, model.uncertainty.J1, model.uncertainty.J2
    gust = None if flown.gust is None else replace(flown.gust)
    r = _inputs(flown, len(d))
    x = np.zeros((len(d) + 1, model.nx))
    x[0] = 0.0 if flown.x0 is None else flown.x0
    target, u, error = np.zeros(model.nr), np.zeros((len(d), model.nu)), np.zeros((len(d), model.ny))
    for k, delay in enumerate(d):
        if math.isfinite(delay):
            u[k] = law.K1 @ x[k - int(delay)]
            if law.K2 is not None:
                u[k] += law.K2 @ (target if xr is None else xr[k])
        w = np.zeros(model.nw) if gust is None else gust.w(k)
        delta = 0.0 if flown.delta is None else flown.delta.delta(k)
        error[k] = model.C @ x[k] + model.D @ u[k]
        if model.reference is not None:
            error[k] -= model.reference.Cr @ target
            target = model.reference.Ar @ target + model.reference.Br @ r[k]
        x[k + 1] = model.A @ x[k] + model.B @ u[k] + model.E @ w + delta * F @ (J1 @ x[k] + J2 @ u[k])
    return Recursion(x[:-1], u, error)


def _inputs(flown: Scenario, samples: int) -> Matrix:
    """Return r(k), shape (samples, inputs of the reference model)."""
    if flown.plant.reference is None:
        return np.zeros((samples, 0))
    profile = parse_profile(flown.reference, flown.plant.Ts)
    return np.array([[profile.r(k)] for k in range(samples)])


def _applied_references(flight: FlightData) -> Matrix:
    """Return the reference state in the command held at each sample; 0 before the first."""
    rows = {int(j): row for row, j in enumerate(flight.command_j)}
    applied = np.zeros((len(flight.k), flight.model.nr))
    for k, j in enumerate(flight.j):
        if math.isfinite(j):
            applied[k] = flight.xr[rows[int(j)]]
    return applied
