"""A recorded flight as arrays: the plant's truth, the commands, the link, and the error of Eq. (10).

Time runs in seconds from sample k = 0. A plant that restarts counts its samples from 0 again; its samples
are then placed where they were in true time, and the reference model starts from zero again. An autopilot that is
dead flies nothing: its mode is STANDBY.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from autopilot.failsafe import Mode
from autopilot.profile import parse_profile
from gains.model import Matrix, Model
from gains.table import InputError
from sitl.faults import CorruptGains, Kill, Phase, fault_of, program_of
from sitl.link.impairment import Fate

__all__ = ["FlightData", "FlightEvent", "LinkPackets", "ModeInterval"]

LINKS = ("up", "down")
CLOCK_JUMP_NS = 100_000_000
"""A relay's clock that jumps by more, from one packet to the next, has been set, or the relay was started again."""


class ModeInterval(NamedTuple):
    """A mode of the failsafe from ``start_s`` to ``end_s``."""

    start_s: float
    end_s: float
    mode: str


class FlightEvent(NamedTuple):
    """Something that happened."""

    time_s: float
    kind: str
    text: str


class LinkPackets(NamedTuple):
    """The packets of one direction; duplicates count as packets, what a gate swallowed does not.

    Attributes
    ----------
    entered_s : ndarray, shape (packets,)
        When each entered the link, s.
    delay_s : ndarray, shape (packets,)
        How long it took, s; nan if it never arrived.
    """

    entered_s: Matrix
    delay_s: Matrix


@dataclass(frozen=True, slots=True, eq=False)
class FlightData:
    """A flight as arrays over its N samples, its M commands and its packets.

    Attributes
    ----------
    model : Model
        What was flown; gives units, travel and trim.
    metadata : mapping of str to str
        What the recording says about itself: scenario, gains, seed, d_min, d_max and so on.
    time_s : ndarray, shape (N,)
        k Ts, s.
    k : ndarray of int, shape (N,)
        Sample numbers as the plant counted them.
    start : ndarray of int, shape (N,)
        Where the sample's k = 0 lies on the axis of time, samples; 0 until the plant restarts.
    x : ndarray, shape (N, nx)
        State at sample k, absolute, units of the states.
    u : ndarray, shape (N, nu)
        Control held over [k, k+1), absolute, units of u.
    w : ndarray, shape (N, nw)
        Disturbance at sample k.
    j, d : ndarray, shape (N,)
        Sample the held command was computed from, and the true delay k - j; nan before the first.
    late_ns : ndarray of int, shape (N,)
        How late each tick was served, ns.
    output, reference, error : ndarray, shape (N, ny)
        y = C x + D u and yr, both absolute, and e = y - yr (10), in units of the outputs.
    engaged : ndarray of bool, shape (N,)
        Whether the law was to fly: neither disarmed nor in MANUAL.
    command_s : ndarray, shape (M,)
        Time of the sample j of each command, s; ascending.
    command_j : ndarray of int, shape (M,)
        Its number.
    command_sample : ndarray of int, shape (M,)
        Its place on the axis of time, samples: j and where the plant's k = 0 lies.
    xr : ndarray, shape (M, nr)
        Reference state the command used; nan without.
    forecast, forecast_low, forecast_high : ndarray, shape (M,)
        Forecast delay of the command and its bounds, samples; nan if unknown.
    saturated : ndarray of bool, shape (M,)
        Whether the command reached its limits.
    modes : tuple of ModeInterval
        Without gaps, from the first command to the end.
    events : tuple of FlightEvent
    links : mapping of str to LinkPackets
        Under ``up`` (plant to autopilot) and ``down``.
    """

    model: Model
    metadata: Mapping[str, str]
    time_s: Matrix
    k: NDArray[np.int64]
    start: NDArray[np.int64]
    x: Matrix
    u: Matrix
    w: Matrix
    j: Matrix
    d: Matrix
    late_ns: NDArray[np.int64]
    output: Matrix
    reference: Matrix
    error: Matrix
    engaged: NDArray[np.bool_]
    command_s: Matrix
    command_j: NDArray[np.int64]
    command_sample: NDArray[np.int64]
    xr: Matrix
    forecast: Matrix
    forecast_low: Matrix
    forecast_high: Matrix
    saturated: NDArray[np.bool_]
    modes: tuple[ModeInterval, ...]
    events: tuple[FlightEvent, ...]
    links: Mapping[str, LinkPackets]

    @classmethod
    def from_records(
        cls,
        records: Iterable[tuple[str, int, Mapping[str, Any]]],
        model: Model,
        metadata: Mapping[str, str] | None = None,
    ) -> Self:
        """Return the flight of a recording, as ``read_mcap`` yields it: (topic, log time in ns, body).

        Raises
        ------
        ValueError
            If there is no sample of ``plant/truth`` in it.
        """
        found = _Collected(model.Ts_ns)
        for topic, log_time_ns, body in records:
            found.add(topic, log_time_ns, body)
        if not found.truth:
            raise ValueError("recording holds no plant/truth: there is no flight in it")

        samples = np.array([sample for sample, _ in found.truth], dtype=np.int64)
        truth = [body for _, body in found.truth]
        time_s = np.asarray(samples * model.Ts, dtype=np.float64)
        x, u = _rows(truth, "x", model.nx), _rows(truth, "u", model.nu)
        deviation = (x - model.trim.x) @ model.C.T + (u - model.trim.u) @ model.D.T
        placed = found.placed_commands()
        places, commands = sorted(placed), [placed[place] for place in sorted(placed)]
        r = _reference_inputs(model, found.starts, placed, metadata or {})
        yr = _reference_outputs(model, samples, found.starts, r)
        trim = model.C @ model.trim.x + model.D @ model.trim.u

        return cls(
            model=model,
            metadata=dict(metadata or {}),
            time_s=time_s,
            k=_integers(truth, "k"),
            start=samples - _integers(truth, "k"),
            x=x,
            u=u,
            w=_rows(truth, "w", len(truth[0]["w"])),
            j=_numbers(truth, "j"),
            d=_numbers(truth, "d"),
            late_ns=_integers(truth, "late_ns"),
            output=deviation + trim,
            reference=yr + trim,
            error=deviation - yr,
            engaged=_engaged(samples, places, commands),
            command_s=np.array(places, dtype=np.float64) * model.Ts,
            command_j=_integers(commands, "j"),
            command_sample=np.array(places, dtype=np.int64),
            xr=_rows(commands, "xr", model.nr),
            forecast=_numbers(commands, "d"),
            forecast_low=_numbers(commands, "d_low"),
            forecast_high=_numbers(commands, "d_high"),
            saturated=np.array([bool(body["saturated"]) for body in commands], dtype=np.bool_),
            modes=_intervals(found.mode_changes(), float(time_s[-1]) + model.Ts),
            events=tuple(
                FlightEvent(found.time_s(log_time_ns), body["kind"], body["text"]) for log_time_ns, body in found.events
            ),
            links={way: found.packets(way) for way in LINKS},
        )

    @property
    def rms_error(self) -> Matrix:
        """Root of the mean of e² over the samples at which the law was to fly, per output; shape (ny,)."""
        with np.errstate(over="ignore"):  # a flight that diverged
            return np.asarray(np.sqrt(np.mean(self.flown_error**2, axis=0)), dtype=np.float64)

    @property
    def flown_error(self) -> Matrix:
        """The error where the law was to fly; all of it in a flight in which that was never so."""
        return self.error[self.engaged] if self.engaged.any() else self.error


@dataclass(slots=True)
class _Collected:
    """What the records hold, each sample placed on one time axis in samples."""

    Ts_ns: int
    zero_ns: int | None = None
    """Log time of sample 0."""
    starts: list[int] = field(default_factory=lambda: [0])
    """Where the plant's k = 0 lies: more than one entry after a restart."""
    truth: list[tuple[int, Mapping[str, Any]]] = field(default_factory=list)
    truth_ns: list[int] = field(default_factory=list)
    commands: list[tuple[int, Mapping[str, Any]]] = field(default_factory=list)
    modes: list[tuple[int, str]] = field(default_factory=list)
    events: list[tuple[int, Mapping[str, Any]]] = field(default_factory=list)
    links: dict[str, list[tuple[int, Mapping[str, Any]]]] = field(default_factory=lambda: {way: [] for way in LINKS})

    def add(self, topic: str, log_time_ns: int, body: Mapping[str, Any]) -> None:
        """Take one record; other topics are passed over."""
        match topic:
            case "plant/truth":
                self._add_truth(log_time_ns, body)
            case "autopilot/command":
                self.commands.append((log_time_ns, body))
                self.modes.append((log_time_ns, body["mode"]))
            case "link/up" | "link/down":
                if body["fate"] != Fate.GATED:
                    self.links[topic.removeprefix("link/")].append((log_time_ns, body))
            case "events":
                self.events.append((log_time_ns, body))
                if body["kind"] == "failsafe":
                    self.modes.append((log_time_ns, body["data"]["to"]))
                elif _kills_autopilot(body):
                    self.modes.append((log_time_ns, Mode.STANDBY.value))

    def _add_truth(self, log_time_ns: int, body: Mapping[str, Any]) -> None:
        k = body["k"]
        if self.zero_ns is None:
            self.zero_ns = log_time_ns - k * self.Ts_ns
        sample = self.starts[-1] + k
        if self.truth and sample <= self.truth[-1][0]:
            flown = round((log_time_ns - self.zero_ns) / self.Ts_ns)
            self.starts.append(max(flown - k, self.truth[-1][0] + 1))
            sample = self.starts[-1] + k
        self.truth.append((sample, body))
        self.truth_ns.append(log_time_ns)

    def placed_commands(self) -> dict[int, Mapping[str, Any]]:
        """Return the commands by the sample that each was computed from, on the one axis.

        An autopilot may notice late that the plant has restarted. A number that the plant had not reached since is
        one of an earlier start, or of none: such a command is left out.
        """
        placed = ((self._place(log_time_ns, body["j"]), body) for log_time_ns, body in self.commands)
        return {place: body for place, body in placed if place is not None}

    def _place(self, log_time_ns: int, j: int) -> int | None:
        if len(self.starts) == 1:
            return self.starts[0] + j
        flown = bisect_right(self.truth_ns, log_time_ns)
        newest = self.truth[flown - 1][0] if flown else -1
        for start in reversed(self.starts):
            if start + j <= newest:
                return start + j
            newest = min(newest, start - 1)
        return None

    def time_s(self, log_time_ns: int) -> float:
        """Return a log time as seconds from sample 0."""
        assert self.zero_ns is not None
        return (log_time_ns - self.zero_ns) / 1e9

    def mode_changes(self) -> list[tuple[float, str]]:
        """Return (time in s, mode) as commands and events say it, in order of time."""
        return [(self.time_s(log_time_ns), mode) for log_time_ns, mode in sorted(self.modes)]

    def packets(self, way: str) -> LinkPackets:
        """Return one direction's packets, the relay's clock mapped to true time.

        A packet is logged when it leaves. What is lost has no time of delivery; the clock's offset then
        comes from those delivered.
        """
        records = self.links[way]
        sent_ns = np.array([body["sent_ns"] for _, body in records], dtype=np.int64)
        log_ns = np.array([log_time_ns for log_time_ns, _ in records], dtype=np.int64)
        arrived = np.array([body["delivered_ns"] is not None for _, body in records], dtype=np.bool_)
        delivered_ns = np.array([body["delivered_ns"] or 0 for _, body in records], dtype=np.int64)
        left_ns = np.where(arrived, delivered_ns, sent_ns)
        entered_s = (sent_ns + _offsets_ns(log_ns - left_ns, arrived) - (self.zero_ns or 0)) / 1e9
        return LinkPackets(entered_s, np.where(arrived, (left_ns - sent_ns) / 1e9, np.nan))


def _kills_autopilot(event: Mapping[str, Any]) -> bool:
    """Return whether an event tells that a fault has killed the autopilot."""
    fault, phase = fault_of(event) or (None, None)
    dead = isinstance(fault, Kill | CorruptGains) and program_of(fault) == "autopilot"
    return dead and phase is Phase.BEGIN


def _offsets_ns(seen_ns: NDArray[np.int64], arrived: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return by how much the relay's clock is behind the log's at each packet, from what is seen of it there.

    The median over all packets between two jumps of the clock, of those that arrived if any did.
    """
    trusted = np.flatnonzero(arrived) if arrived.any() else np.arange(len(seen_ns))
    if not trusted.size:
        return seen_ns
    jumps = np.flatnonzero(np.abs(np.diff(seen_ns[trusted])) > CLOCK_JUMP_NS) + 1
    medians = [int(np.median(part)) for part in np.split(seen_ns[trusted], jumps)]
    return np.array(medians, dtype=np.int64)[np.searchsorted(trusted[jumps], np.arange(len(seen_ns)), side="right")]


def _engaged(samples: NDArray[np.int64], places: list[int], commands: list[Mapping[str, Any]]) -> NDArray[np.bool_]:
    """Return whether the law was to fly at each sample, as the latest command says; before the first one it was."""
    said = np.array([True, *(body.get("armed", True) and body.get("flight_mode") != "MANUAL" for body in commands)])
    return said[np.searchsorted(np.array(places, dtype=np.int64), samples, side="right")]


Commands = Mapping[int, Mapping[str, Any]]
"""By the sample that each was computed from."""


def _reference_inputs(
    model: Model, starts: list[int], commands: Commands, metadata: Mapping[str, str]
) -> Callable[[int], Matrix]:
    """Return r as a function of the sample: the programmed reference if that was flown, else what commands recorded.

    A sample whose command is missing does not say what r was; the last one known then stands in.
    """
    if (programmed := _programmed_inputs(model, starts, commands, metadata)) is not None:
        return programmed
    width = 0 if model.reference is None else model.reference.Br.shape[1]
    known = {place: body["r"] for place, body in commands.items() if body["r"] is not None}
    places = sorted(known)

    def recorded(sample: int) -> Matrix:
        i, start = bisect_right(places, sample), max(s for s in starts if s <= sample)
        known_since_start = i > 0 and places[i - 1] >= start
        return np.array(known[places[i - 1]], dtype=np.float64) if known_since_start else np.zeros(width)

    return recorded


def _programmed_inputs(
    model: Model, starts: list[int], commands: Commands, metadata: Mapping[str, str]
) -> Callable[[int], Matrix] | None:
    """Return the recording's programmed reference; None where a command was for another one."""
    try:
        profile = parse_profile(metadata["reference"], model.Ts)
    except (KeyError, InputError):  # none is named, or its file is elsewhere
        return None

    def programmed(sample: int) -> Matrix:
        return np.array([profile.r(sample - max(s for s in starts if s <= sample))])

    flown = all(body["r"] is None or body["r"] == programmed(place).tolist() for place, body in commands.items())
    return programmed if flown else None


def _reference_outputs(
    model: Model, samples: NDArray[np.int64], starts: list[int], r: Callable[[int], Matrix]
) -> Matrix:
    """Return yr(k) = Cr xr(k), xr(k+1) = Ar xr(k) + Br r(k), xr(0) = 0 (8); 0 without a reference, shape (N, ny)."""
    yr = np.zeros((len(samples), model.ny))
    reference = model.reference
    if reference is None:
        return yr
    rows = {int(sample): row for row, sample in enumerate(samples)}
    restarts = set(starts)
    xr = np.zeros(model.nr)
    for sample in range(int(samples[-1]) + 1):
        if sample in restarts:
            xr = np.zeros(model.nr)
        if sample in rows:
            yr[rows[sample]] = reference.Cr @ xr
        xr = reference.Ar @ xr + reference.Br @ r(sample)
    return yr


def _intervals(changes: list[tuple[float, str]], end_s: float) -> tuple[ModeInterval, ...]:
    """Return the intervals of equal mode; each ends where the next begins, the last at ``end_s``."""
    begins = [change for last, change in zip([(0.0, ""), *changes], changes, strict=False) if last[1] != change[1]]
    ends_s = [time_s for time_s, _ in begins[1:]] + [end_s]
    return tuple(
        ModeInterval(start_s, max(start_s, stop_s), mode)
        for (start_s, mode), stop_s in zip(begins, ends_s, strict=False)
    )


def _rows(bodies: list[Mapping[str, Any]], name: str, width: int) -> Matrix:
    """Return an array field, one row per body, nan where it is null; shape (len(bodies), width)."""
    missing = [np.nan] * width
    rows = [missing if body[name] is None else body[name] for body in bodies]
    return np.array(rows, dtype=np.float64).reshape(len(bodies), width)


def _numbers(bodies: list[Mapping[str, Any]], name: str) -> Matrix:
    """Return a number field, nan where it is null; shape (len(bodies),)."""
    return np.array([np.nan if body[name] is None else body[name] for body in bodies], dtype=np.float64)


def _integers(bodies: list[Mapping[str, Any]], name: str) -> NDArray[np.int64]:
    """Return an integer field; shape (len(bodies),)."""
    return np.array([body[name] for body in bodies], dtype=np.int64)
