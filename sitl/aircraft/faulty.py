"""Sensors and an elevator that fail: what is sent is no longer the state, what moves no longer the command.

The truth stays the truth. A fault acts on the samples whose instants k Ts lie in it, counted from k = 0. Several at a
time act one after the other, in the order given; an elevator that is stuck is stuck whatever else it is.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from gains.model import Model
from sitl.aircraft.linear import move_actuator
from sitl.faults import AircraftFault, ElevatorFault, ElevatorFaultKind, SensorFault, SensorFaultKind

__all__ = ["FaultyElevator", "FaultySensors"]

Vector = NDArray[np.float64]


def _acts(fault: AircraftFault, t_ns: int) -> bool:
    end_ns = fault.end_ns
    return fault.at_ns <= t_ns and (end_ns is None or t_ns < end_ns)


class FaultySensors:
    """The sensors of all states.

    Parameters
    ----------
    model : Model
        Gives the states and Ts.
    faults : iterable of AircraftFault
        Those of sensors count.
    seed : int
        Of the noise. Each fault draws from a stream of its own, so that one more does not change the others.
    """

    def __init__(self, model: Model, faults: Iterable[AircraftFault], seed: int) -> None:
        self._Ts_ns = model.Ts_ns
        self._faults = [
            (model.states.index(fault.state), fault, np.random.default_rng((seed, n)))
            for n, fault in enumerate(faults)
            if isinstance(fault, SensorFault)
        ]
        self._sent: Vector | None = None

    def sense(self, k: int, x: Vector) -> Vector:
        """Return what the sensors say at sample k, to be asked once per sample in order.

        Parameters
        ----------
        k : int
            Number of the sample.
        x : (nx,) array
            The true state, absolute.
        """
        if not self._faults:
            return x
        sensed = x.copy()
        for i, fault, noise in self._faults:
            if _acts(fault, k * self._Ts_ns):
                sensed[i] = self._faulty(fault, i, float(sensed[i]), noise)
        self._sent = sensed
        return sensed

    def _faulty(self, fault: SensorFault, i: int, value: float, noise: np.random.Generator) -> float:
        match fault.kind:
            case SensorFaultKind.FROZEN:
                return value if self._sent is None else float(self._sent[i])
            case SensorFaultKind.BIAS:
                return value + fault.value
            case SensorFaultKind.NOISE:
                return value + fault.value * float(noise.standard_normal())
            case SensorFaultKind.NAN:
                return float("nan")


class FaultyElevator:
    """The actuator of the model, and what is wrong with it.

    Parameters
    ----------
    model : Model
        Its travel, lag and rate stay in force.
    faults : iterable of AircraftFault
        Those of the elevator count.
    """

    def __init__(self, model: Model, faults: Iterable[AircraftFault]) -> None:
        self._model = model
        self._faults = [fault for fault in faults if isinstance(fault, ElevatorFault)]

    def move(self, k: int, position: Vector, command: Vector) -> Vector:
        """Return the position over [k, k+1), units of u.

        Parameters
        ----------
        k : int
            Number of the sample.
        position, command : (nu,) array
            Where it was over the last period, and where it shall go; absolute.
        """
        if not self._faults:
            return move_actuator(self._model, position, command)
        acting = [fault for fault in self._faults if _acts(fault, k * self._model.Ts_ns)]
        kinds = [fault.kind for fault in acting]
        if ElevatorFaultKind.STUCK in kinds:
            return position
        if kinds.count(ElevatorFaultKind.REVERSED) % 2:
            command = 2.0 * self._model.trim.u - command
        moved = move_actuator(self._model, position, command)
        for fault in acting:
            if fault.kind is ElevatorFaultKind.SLOW:
                furthest = fault.value * self._model.Ts
                moved = position + np.clip(moved - position, -furthest, furthest)
        return moved
