"""What a parameter's value does: from the table of parameters to pilot and commander, with the vehicle's own refusals.

The one rule with weight is that of the gains: whoever changes them in flight must not leave what is proved. Other gains
are taken while armed only if their certificate is verified and their window covers the present one, [DELAY_MIN,
DELAY_MAX]; so a change to gains for shorter delays begins with a narrower window. Each law is proved alone: the
change itself is not, and the reference is set so that the elevator does not jump.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from autopilot.commander import Commander
from autopilot.config import ParameterStore
from autopilot.ground.parameters import Parameters
from autopilot.link.clock import NS_PER_S
from autopilot.link.sensors import pitch_index
from autopilot.pilot import Pilot
from gains.model import GainLaw
from gains.table import InputError
from gains.verify import Verification

__all__ = ["Settings"]

STORAGE_NS = NS_PER_S
STORAGE_MOST = 5
"""So many commands in that time, ns, may read or write parameters."""
NO_LIMIT_DEG = 90.0
"""REF_MAX_DEG: no limit; also where the reference is no pitch."""


class Settings:
    """The parameters of one autopilot, in force.

    Parameters
    ----------
    laws : sequence of GainLaw
        What may be flown; the first one is.
    verify : callable
        Returns the verification of a law's certificate; asked for each law at once, not in flight.
    pilot : Pilot
        What flies.
    commander : Commander
        What the ground has asked for.
    ports : sequence of str
        The ground stations.
    flown : callable
        Told of other gains, and when.
    store : ParameterStore, optional
        Where parameters are kept; what is there counts from the start.

    Raises
    ------
    InputError
        When a law is for another model, or what is kept is malformed.
    """

    def __init__(
        self,
        laws: Sequence[GainLaw],
        verify: Callable[[GainLaw], Verification],
        pilot: Pilot,
        commander: Commander,
        ports: Sequence[str],
        flown: Callable[[GainLaw, int], None],
        store: ParameterStore | None = None,
    ) -> None:
        for law in laws[1:]:
            if law.model.name != laws[0].model.name:
                raise InputError(f"gains {law.name}: expected the model {laws[0].model.name}, found {law.model.name}")
        self.laws = tuple(laws)
        self.proofs = [verify(law) for law in laws]
        self.conservative_proofs = [None if law.conservative is None else verify(law.conservative) for law in laws]
        self._pilot = pilot
        self._commander = commander
        self._flown = flown
        self._store = store
        self._stored_ns: int | None = None
        self._stored_more = 0
        self._neutral_deg = math.degrees(pilot.travel.neutral)
        stops = math.degrees(pilot.travel.low), math.degrees(pilot.travel.high)
        delays = min(law.d_min for law in laws), max(law.d_max for law in laws)
        self._is_pitch = pitch_index(pilot.model) is not None
        defaults = {
            "DELAY_MIN": laws[0].d_min,
            "DELAY_MAX": laws[0].d_max,
            "ELEV_LOW_DEG": stops[0],
            "ELEV_HIGH_DEG": stops[1],
            "FS_HOLD_S": pilot.limits.hold_ns / NS_PER_S,
            "FS_SAT_S": pilot.saturation.limit_ns / NS_PER_S,
            "FS_GCS_S": pilot.ground.timeout_ns / NS_PER_S,
        }
        self.parameters = Parameters(
            defaults,
            self._change,
            ports=ports,
            names=[law.name for law in laws],
            ranges={"ELEV_LOW_DEG": stops, "ELEV_HIGH_DEG": stops, "DELAY_MIN": delays, "DELAY_MAX": delays},
        )
        commander.certified = self.proofs[0].passed
        self._set(self.parameters.values)
        if store is not None and (kept := store.read()) is not None:
            self.parameters.load(kept, 0)

    # Parameters on disk (autopilot.ground.commands.Storage)

    def busy(self, now_ns: int) -> bool:
        """Return whether storage was asked for too often: a disk must not have the elevator's time."""
        if self._stored_ns is not None and now_ns - self._stored_ns < STORAGE_NS:
            self._stored_more += 1
        else:
            self._stored_ns, self._stored_more = now_ns, 0
        return self._stored_more >= STORAGE_MOST

    def save(self) -> str | None:
        """Keep the present values, and return why that was not possible."""
        if self._store is None:
            return "parameters: started without --parameters"
        try:
            self._store.write(self.parameters.as_table())
        except OSError as error:
            return f"parameters: {error.strerror or error}"
        return None

    def reload(self, now_ns: int) -> str | None:
        """Take what is kept, and return why that was not possible."""
        if self._store is None:
            return "parameters: started without --parameters"
        try:
            kept = self._store.read()
            if kept is None:
                return "parameters: none are saved"
            self.parameters.announce(self.parameters.load(kept, now_ns))
        except InputError as error:
            return f"parameters: {error}"
        return None

    def defaults(self, now_ns: int) -> str | None:
        """Go back to the defaults, and return why that was not possible."""
        try:
            self.parameters.announce(self.parameters.reset(now_ns))
        except InputError as error:
            return str(error)
        return None

    # What each value does

    def _change(self, after: Mapping[str, float], name: str, now_ns: int) -> str | None:
        """Put a new value into force, or return why not."""
        match name:
            case "GAINS":
                return self._change_gains(after, now_ns)
            case "DELAY_MIN" | "DELAY_MAX":
                return self._change_window(after)
            case "ELEV_LOW_DEG" | "ELEV_HIGH_DEG":
                return self._change_stops(after)
            case "REF_MAX_DEG" | "REF_RATE_DS":
                self._shape(after)
            case _:
                self._set(after)
        return None

    def _set(self, values: Mapping[str, float]) -> None:
        """Put those values into force that can be whatever their ranges allow; the vehicle looks up rates itself."""
        pilot, commander = self._pilot, self._commander
        pilot.limits = replace(pilot.limits, hold_ns=_ns(values["FS_HOLD_S"]))
        pilot.saturation.limit_ns = _ns(values["FS_SAT_S"])
        pilot.ground.timeout_ns = _ns(values["FS_GCS_S"])
        commander.timeout_ns = _ns(values["REF_TIME_S"])
        commander.stick_rad = math.radians(values["STICK_DEG"])
        commander.require_certificate = values["ARM_CERT"] != 0.0

    def _change_gains(self, after: Mapping[str, float], now_ns: int) -> str | None:
        index = int(after["GAINS"])
        law, proof = self.laws[index], self.proofs[index]
        window = int(after["DELAY_MIN"]), int(after["DELAY_MAX"])
        if law is self._pilot.gains:
            return None
        undone = index == int(self.parameters.value("GAINS"))  # taken back, since another value was refused
        if not undone:
            if not law.d_min <= window[0] <= window[1] <= law.d_max:
                return f"{law.name}: {law.d_min}..{law.d_max}; window now {window[0]}..{window[1]}"
            if self._commander.armed and not proof.passed:
                return f"{law.name}: armed, and no verified certificate"
        self._pilot.use(law)
        self._pilot.window = window
        self._commander.certified = proof.passed
        self._flown(law, now_ns)
        return None

    def _change_window(self, after: Mapping[str, float]) -> str | None:
        law = self.laws[int(after["GAINS"])]
        window = int(after["DELAY_MIN"]), int(after["DELAY_MAX"])
        if not law.d_min <= window[0] <= window[1] <= law.d_max:
            return f"{law.name}: expected a window in {law.d_min}..{law.d_max}"
        self._pilot.window = window
        return None

    def _change_stops(self, after: Mapping[str, float]) -> str | None:
        """Move the elevator's stops; at the ends of the travel the travel alone counts."""
        low, high = after["ELEV_LOW_DEG"], after["ELEV_HIGH_DEG"]
        if not low <= self._neutral_deg <= high:
            return f"ELEV_LOW_DEG, _HIGH_DEG: neutral is {self._neutral_deg:.4g} deg"
        stop_low = -math.inf if low == self.parameters.defaults["ELEV_LOW_DEG"] else math.radians(low)
        stop_high = math.inf if high == self.parameters.defaults["ELEV_HIGH_DEG"] else math.radians(high)
        self._pilot.set_travel(replace(self._pilot.travel, stop_low=stop_low, stop_high=stop_high))
        return None

    def _shape(self, after: Mapping[str, float]) -> None:
        most_deg, rate_deg_s = after["REF_MAX_DEG"], after["REF_RATE_DS"]
        most = math.radians(most_deg) if self._is_pitch and most_deg < NO_LIMIT_DEG else None
        rate = math.radians(rate_deg_s) * self._pilot.model.Ts if self._is_pitch and rate_deg_s > 0.0 else None
        self._pilot.shape(most, rate)


def _ns(seconds: float) -> int:
    return round(seconds * NS_PER_S)
