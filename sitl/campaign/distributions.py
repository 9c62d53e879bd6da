"""From what the flights of a campaign are drawn, as data and as the text of an option.

    delays      uniform | hold:P | geometric:MEAN | cycle:FILE
    signals     none | step:A | sine:A[:T] | square:A[:T] | white:A     gust and reference
    A and T     5deg, 0..5deg, 0.5s..10s       a number, or a span of equally likely ones, of periods in the logarithm

Delays may come from a link instead, which :mod:`sitl.campaign.linked` samples. Every flight draws its own amplitude,
period, phase and, where there is more than one channel, direction.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gains.table import InputError
from gains.witnessfile import TRANSITIONS, read_witness

__all__ = ["DelayProcess", "Kind", "Signal", "Span", "parse_delays", "parse_signal", "parse_span"]

Kind = Literal["none", "step", "sine", "square", "white"]
KINDS: tuple[Kind, ...] = ("none", "step", "sine", "square", "white")

LONGEST_PERIOD_S = 1e6
LARGEST = 1e9
"""Of an amplitude."""

_UNITS = {"": 1.0, "deg": math.pi / 180.0, "rad": 1.0}
_TIMES = {"s": 1.0, "ms": 1e-3}
_NUMBER = re.compile(r"[0-9]{1,20}(?:\.[0-9]{1,20})?")
_SPAN = re.compile(rf"({_NUMBER.pattern})([a-z]*)(?:\.\.({_NUMBER.pattern})([a-z]*))?")


class Span(NamedTuple):
    """Numbers from ``low`` to ``high``, which may be the same."""

    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.low:g}" if self.low == self.high else f"{self.low:g}..{self.high:g}"


NOTHING = Span(0.0, 0.0)
DEFAULT_PERIODS = Span(0.5, 10.0)


@dataclass(frozen=True, slots=True)
class Signal:
    """A disturbance or a reference.

    Attributes
    ----------
    kind : {"none", "step", "sine", "square", "white"}
        White: independent normal numbers, of the amplitude as their standard deviation.
    amplitude : Span
        In units of the channel.
    period_s : Span
        Of sine and square.
    """

    kind: Kind = "none"
    amplitude: Span = NOTHING
    period_s: Span = DEFAULT_PERIODS


@dataclass(frozen=True, slots=True)
class DelayProcess:
    """How the delay changes from sample to sample, without a link.

    Attributes
    ----------
    weights : tuple of float
        Probability of each delay, from ``d_min`` on; they sum to 1. Empty for a cycle.
    d_min : int
    hold : float
        Probability that the delay of the sample before stays, from 0 to below 1.
    fifo : bool
        Whether a delay exceeds the one before by at most 1: commands that come in order.
    cycle : tuple of int
        One period of a prescribed sequence, entered at a place of its own by each flight; empty for none.
    text : str
        As it was asked for.
    """

    weights: tuple[float, ...]
    d_min: int
    hold: float = 0.0
    fifo: bool = False
    cycle: tuple[int, ...] = ()
    text: str = "uniform"

    @property
    def d_max(self) -> int:
        """The largest delay."""
        return max(self.cycle) if self.cycle else self.d_min + len(self.weights) - 1

    def thresholds(self) -> NDArray[np.uint64]:
        """Return what a random word of 32 bits is compared with: d is d_min and one more for each not above it."""
        # of a single delay one that no word reaches: without any, a link is to say d
        shares = np.cumsum(self.weights[: max(1, len(self.weights) - 1)])
        return np.rint(shares * 2.0**32).astype(np.uint64)


def parse_delays(text: str, d_min: int, d_max: int, *, fifo: bool, longest: int) -> DelayProcess:
    """Return the process that a text names, in a window.

    Parameters
    ----------
    text : str
        See the module.
    d_min, d_max : int
        The window; ``geometric`` begins at d_min and goes beyond d_max, ``cycle`` has its own.
    fifo : bool
        Whether the transitions are FIFO's.
    longest : int
        The largest delay that can be flown: the tail of ``geometric`` is put there.

    Raises
    ------
    InputError
        When it is none of them.
    """
    kind, colon, value = text.partition(":")
    count = d_max - d_min + 1
    even = (1.0 / count,) * count
    if kind == "uniform" and not colon:
        return DelayProcess(even, d_min, 0.0, fifo, (), text)
    if kind == "hold":
        return DelayProcess(even, d_min, _share(text, value), fifo, (), text)
    if kind == "geometric":
        return DelayProcess(_geometric(text, value, longest - d_min), d_min, 0.0, fifo, (), text)
    if kind == "cycle" and value:
        witness = read_witness(value)
        if fifo and witness.transitions != TRANSITIONS[1]:
            raise InputError(f'delays "{text}": expected a sequence of transitions fifo, found {witness.transitions}')
        if witness.d_max > longest:
            raise InputError(f'delays "{text}": expected delays up to {longest}, found {witness.d_max}')
        return DelayProcess((), min(witness.delays), 0.0, fifo, witness.delays, text)
    raise InputError(f'delays "{text}": expected uniform, hold:P, geometric:MEAN or cycle:FILE')


def _share(text: str, value: str) -> float:
    share = float(value) if _NUMBER.fullmatch(value) else -1.0
    if not 0.0 <= share < 1.0:
        raise InputError(f'delays "{text}": expected a probability below 1 after hold:, found "{value}"')
    return share


def _geometric(text: str, value: str, most: int) -> tuple[float, ...]:
    """Return (1 − p) pⁿ with the mean p / (1 − p), the rest of the tail at its end."""
    mean = float(value) if _NUMBER.fullmatch(value) else -1.0
    if not 0.0 < mean <= most:
        raise InputError(f'delays "{text}": expected a mean of samples above 0 and up to {most}, found "{value}"')
    p = mean / (1.0 + mean)
    weights = [(1.0 - p) * p**n for n in range(most)]
    return (*weights, p**most)


def parse_signal(text: str, what: str) -> Signal:
    """Return the signal that a text names.

    Raises
    ------
    InputError
        When it is none.
    """
    name, *values = text.split(":")
    kind = next((kind for kind in KINDS if kind == name), None)
    most = {"none": 0, "step": 1, "white": 1}.get(name, 2)
    if kind is None or len(values) > most or (most and not values):
        raise InputError(f'{what} "{text}": expected none, step:A, white:A, sine:A[:T] or square:A[:T]')
    if kind == "none":
        return Signal()
    amplitude = parse_span(values[0], f'{what} "{text}"', _UNITS, 0.0, LARGEST)
    if len(values) < 2:
        return Signal(kind, amplitude)
    period = parse_span(values[1], f'{what} "{text}"', _TIMES, 1e-3, LONGEST_PERIOD_S)
    return Signal(kind, amplitude, period)


def parse_span(
    text: str, what: str, units: dict[str, float] = _UNITS, least: float = 0.0, most: float = LARGEST
) -> Span:
    """Return the span that a text names; a unit at its end alone counts for both, its start cannot have one alone.

    Raises
    ------
    InputError
        When it is none, or leaves [least, most].
    """
    match = _SPAN.fullmatch(text)
    if match is not None:
        first, first_unit, last, unit = match.groups()
        if last is None:
            last, unit = first, first_unit
        scales = units.get(first_unit or unit), units.get(unit)
        if None not in scales and (unit or not first_unit):
            low, high = (float(number) * scale for number, scale in zip((first, last), scales, strict=True) if scale)
            if least <= low <= high <= most:
                return Span(low, high)
    known = ", ".join(unit for unit in units if unit)
    with_unit = f" with its unit ({known})" if known else ""
    raise InputError(
        f'{what}: expected a number from {least:g} to {most:g}, or LOW..HIGH{with_unit}, LOW first, found "{text}"'
    )
