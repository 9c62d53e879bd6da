"""The elevator on the wire: pulse width or normalised control, mapped linearly onto the actuator's travel.

1000 us and -1 are the low end, 2000 us and +1 the high end. Neutral is the pulse of the trim input.
Both ends of the link use the same travel, so the mapping has one home.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from gains.model import Model
from gains.table import InputError

__all__ = ["PWM_HIGH_US", "PWM_LOW_US", "Travel", "travel_of"]

PWM_LOW_US = 1000
PWM_HIGH_US = 2000


@dataclass(frozen=True, slots=True)
class Travel:
    """Travel of the one control surface.

    Attributes
    ----------
    low, high : float
        Ends of the travel, in units of u.
    neutral : float
        The trim input.
    stop_low, stop_high : float
        Where a command must stop, within the travel or beyond it; none by default.
    """

    low: float
    high: float
    neutral: float
    stop_low: float = -math.inf
    stop_high: float = math.inf

    def to_pwm(self, u: float) -> int:
        """Return the pulse in microseconds for u, rounded to the nearest."""
        return round(PWM_LOW_US + (u - self.low) / (self.high - self.low) * (PWM_HIGH_US - PWM_LOW_US))

    def from_pwm(self, pwm_us: int) -> float | None:
        """Return u for a pulse, or None for one outside the travel (0 is an unused channel)."""
        if not PWM_LOW_US <= pwm_us <= PWM_HIGH_US:
            return None
        return self.low + (pwm_us - PWM_LOW_US) / (PWM_HIGH_US - PWM_LOW_US) * (self.high - self.low)

    def to_control(self, u: float) -> float:
        """Return the normalised control from -1 to 1 for u."""
        return 2.0 * (u - self.low) / (self.high - self.low) - 1.0

    def from_control(self, control: float) -> float | None:
        """Return u for a normalised control, or None for one outside -1 to 1."""
        if not -1.0 <= control <= 1.0:
            return None
        return self.low + 0.5 * (control + 1.0) * (self.high - self.low)

    def clip(self, u: float) -> float:
        """Return u limited to the travel and its stops."""
        return min(max(u, self.low, self.stop_low), self.high, self.stop_high)


def travel_of(model: Model) -> Travel:
    """Return the travel of the model's elevator.

    Raises
    ------
    InputError
        When the model has not exactly one input or does not say its limits.
    """
    if model.nu != 1:
        raise InputError(f"{model.name}: plant.B: flight takes one input (the elevator), found {model.nu}")
    if model.actuator is None or model.actuator.low is None or model.actuator.high is None:
        raise InputError(f"{model.name}: actuator: expected low and high, which the servo maps onto; found none")
    return Travel(float(model.actuator.low[0]), float(model.actuator.high[0]), float(model.trim.u[0]))
