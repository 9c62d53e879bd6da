"""The table of the vehicle's parameters, and what a value of each must be; data and pure functions.

:mod:`autopilot.ground.parameters` serves it to ground stations, and :mod:`autopilot.ground.parameters_page` prints it.

Every value is the shortest decimal that its 32 bits on the wire stand for. What a person types, what the ground
station shows, what the file holds and what flies are then one number: 0.1 is 0.1, and not 0.100000001490116.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, Literal

import numpy as np

__all__ = [
    "BY_NAME",
    "GAINS",
    "MAX_NAME",
    "MAX_WHOLE",
    "ORDERED",
    "PARAMETERS",
    "Kind",
    "Parameter",
    "canonical",
    "disorder",
    "unfit",
]

MAX_NAME = 16
"""Characters of a parameter's name on the wire."""
MAX_WHOLE = 2**24
"""Up to here a 32-bit float holds every whole number."""

Kind = Literal["int", "float", "bool"]


def canonical(value: float) -> float:
    """Return the shortest decimal that becomes the same 32-bit float; 0 for −0, infinity where there is none."""
    with np.errstate(over="ignore"):
        single = np.float32(value)
    return float(str(single)) + 0.0


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of the vehicle.

    Attributes
    ----------
    name : str
        At most ``MAX_NAME`` characters, upper case.
    kind : "int", "float" or "bool"
        Whole numbers and switches (0 or 1) travel as floats too.
    low, high : float
        Least and greatest value.
    default : float or None
        None where it depends on what flies, and is given at construction.
    unit : str
        Empty for none.
    meaning : str
        One sentence.
    rule : str
        What else a new value must obey, or what its default is; empty for nothing.
    """

    name: str
    kind: Kind
    low: float
    high: float
    default: float | None
    unit: str
    meaning: str
    rule: str = ""

    def __post_init__(self) -> None:
        """Refuse a row that could not be served."""
        assert 0 < len(self.name) <= MAX_NAME, self.name
        assert self.name == self.name.upper(), self.name
        assert self.low <= self.high, self.name
        for bound in (self.low, self.high):
            assert canonical(bound) == bound, self.name
            assert self.kind == "float" or (bound == int(bound) and abs(bound) <= MAX_WHOLE), self.name
        assert self.kind != "bool" or (self.low, self.high) == (0, 1), self.name

    @property
    def range(self) -> str:
        """The range in words."""
        if self.kind == "bool":
            return "0 or 1"
        return f"{self.low:g}" if self.low == self.high else f"{self.low:g} to {self.high:g}"


def _rate(name: str, message: str, default: float) -> Parameter:
    """Return the parameter of a stream's default rate."""
    meaning = f"Default rate of {message}, for a ground station that asked for none of its own."
    return Parameter(name, "float", 0, 100, default, "Hz", meaning, "0: not sent")


GAINS: Final = "GAINS"
"""The parameter that is kept in a file by the name of the gain set, because its number depends on the list."""
_OF_GAINS = "inside the window of the gains; default: that of the gains given at start"
_OF_MODEL = "inside the model's travel, its default"

PARAMETERS: Final = (
    Parameter(
        GAINS,
        "int",
        0,
        15,
        0,
        "",
        "Which of the gain sets that may be flown is flown; 0 is the one given at start.",
        "a set that exists",
    ),
    Parameter(
        "DELAY_MIN",
        "int",
        1,
        200,
        None,
        "samples",
        "Least delay at which the law may fly.",
        f"at most DELAY_MAX, {_OF_GAINS}",
    ),
    Parameter(
        "DELAY_MAX",
        "int",
        1,
        200,
        None,
        "samples",
        "Greatest delay at which the law may fly.",
        f"at least DELAY_MIN, {_OF_GAINS}",
    ),
    Parameter("FS_HOLD_S", "float", 0, 60, 0.5, "s", "How long failsafe holds the last command before neutral."),
    Parameter(
        "FS_SAT_S",
        "float",
        0,
        3600,
        1,
        "s",
        "How long the elevator may stay at its limit before neutral.",
        "0: for ever",
    ),
    Parameter(
        "FS_GCS_S",
        "float",
        0,
        3600,
        0,
        "s",
        "Silence of all ground stations that counts as their loss, once one was heard.",
        "0: never",
    ),
    Parameter(
        "REF_MAX_DEG", "float", 0, 90, 90, "deg", "Largest pitch reference from trim, up or down.", "90: no limit"
    ),
    Parameter("REF_RATE_DS", "float", 0, 1000, 0, "deg/s", "Fastest change of the pitch reference.", "0: no limit"),
    Parameter(
        "REF_TIME_S",
        "float",
        0.1,
        60,
        1,
        "s",
        "Silence of a streamed reference after which the reference returns to trim.",
    ),
    Parameter("STICK_DEG", "float", 0, 90, 15, "deg", "Pitch reference, from trim, at full stick."),
    Parameter(
        "ELEV_LOW_DEG",
        "float",
        -90,
        90,
        None,
        "deg",
        "Software stop of the elevator, the lower one.",
        f"below ELEV_HIGH_DEG, {_OF_MODEL}",
    ),
    Parameter(
        "ELEV_HIGH_DEG",
        "float",
        -90,
        90,
        None,
        "deg",
        "Software stop of the elevator, the upper one.",
        f"above ELEV_LOW_DEG, {_OF_MODEL}",
    ),
    Parameter("ARM_CERT", "bool", 0, 1, 1, "", "Whether arming needs a verified certificate."),
    _rate("RATE_ATT", "ATTITUDE", 20),
    _rate("RATE_HUD", "VFR_HUD", 5),
    _rate("RATE_AOA", "AOA_SSA", 10),
    _rate("RATE_SERVO", "SERVO_OUTPUT_RAW", 10),
    _rate("RATE_DELAY", "each NAMED_VALUE_INT, such as DELAY_K", 10),
    _rate("RATE_EST", "each NAMED_VALUE_FLOAT, such as D_PROB", 10),
    _rate("RATE_POS", "GLOBAL_POSITION_INT", 2),
    _rate("RATE_TARGET", "ATTITUDE_TARGET", 5),
    _rate("RATE_SYS", "SYS_STATUS", 1),
)
"""All of them; the place in this table is the index on the wire."""

BY_NAME: Final = MappingProxyType({each.name: each for each in PARAMETERS})

ORDERED: Final = (("DELAY_MIN", "DELAY_MAX", True), ("ELEV_LOW_DEG", "ELEV_HIGH_DEG", False))
"""Pairs that must be in order, and whether the two may be equal."""


def unfit(parameter: Parameter, value: float) -> str | None:
    """Return what is expected of a value, a canonical one, that the parameter cannot have; None when it can."""
    if not math.isfinite(value):
        return "a finite number"
    if not parameter.low <= value <= parameter.high:
        return parameter.range
    if parameter.kind != "float" and value != int(value):
        return "0 or 1" if parameter.kind == "bool" else "a whole number"
    return None


def disorder(values: Mapping[str, float], changed: str | None = None) -> tuple[str, str] | None:
    """Return which value is not in order with another, and what is expected of it; None when all are.

    Of a pair it is the one that ``changed``, or else the second.
    """
    for low, high, may_be_equal in ORDERED:
        if values[low] < values[high] or (may_be_equal and values[low] == values[high]):
            continue
        if changed == low:
            return low, f"{'at most' if may_be_equal else 'below'} {high}"
        return high, f"{'at least' if may_be_equal else 'above'} {low}"
    return None
