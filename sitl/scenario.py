"""A flight as data: what flies, over which link, for how long, and the checks that decide its outcome.

Scenarios are TOML files, stored ones by name. This module alone knows all three nodes: it builds them
from a scenario, for either driver, and writes the command lines that build the same ones elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from autopilot.alpha import AlphaChoice
from autopilot.app import AutopilotNode
from autopilot.config import AutopilotConfig
from autopilot.link.clock import NS_PER_S, Clock
from autopilot.link.process import parse_clock
from autopilot.profile import parse_profile
from gains.model import GainLaw, Model
from gains.store import load_law
from gains.table import InputError, Table
from gains.witnessfile import Witness, read_witness
from sitl.aircraft.airframe import Airframe
from sitl.aircraft.disturbance import HarmonicGust, SquareDelta
from sitl.aircraft.plants import airframe_maker, is_nonlinear, plant_model
from sitl.aircraft.wind import WindSpec, parse_wind
from sitl.checks import METRICS, WITNESS_METRICS, Check, read_check
from sitl.faults import Fault, aircraft_faults, check_faults, parse_fault
from sitl.link.changes import MAX_CHANGES, Change, format_change, format_time, parse_change
from sitl.link.gate import Gate, check_flyable
from sitl.link.impairment import LinkSpec
from sitl.link.presets import parse_link
from sitl.link.relay import DEFAULT_LOG_RATE, RelayNode
from sitl.link.rules import MAX_RULES, Rule, parse_rule
from sitl.plant import PlantConfig, PlantNode
from sitl.seeds import MAX_SEED

__all__ = [
    "Scenario",
    "check_changes",
    "load_scenario",
    "stored_scenarios",
]

DEFAULT_CLOCKS: Mapping[str, str] = {
    "plant": "137s:+40ppm",
    "relay": "11s:-20ppm",
    "autopilot": "1042s:-60ppm",
}
"""No two clocks agree unless a scenario says so: mixed-up clocks fail at once."""

SERVO_TIMEOUT_MARGIN = 5
"""The plant's servo time-out is d_max, of gains or witness, and this many samples, unless a scenario says otherwise."""

MAX_START_UP_NS = 30 * NS_PER_S
"""Link time that passes before sample k = 0, at the most: a flight that has not begun by then never does."""

T = TypeVar("T")
_Word = TypeVar("_Word", bound=str)


@dataclass(frozen=True, slots=True, eq=False)
class Scenario:
    """One flight.

    Attributes
    ----------
    name, title : str
        Short and long name.
    gains_name, plant_name : str
        What the gains and the plant were loaded from: stored names or paths, or the name of a nonlinear aircraft.
    gains : Gains or Schedule
        What flies, on the model it was designed for.
    plant : Model
        What is flown, as a rule that same model; a nonlinear aircraft is described by it.
    duration_s : float
        Length from k = 0.
    seed : int
        Of everything random.
    reference : str
        Programmed reference (:func:`autopilot.profile.parse_profile`).
    up, down : LinkSpec
        Plant to autopilot, and back.
    clocks : mapping
        Node name to Clock.
    actuator, failsafe, latch, alpha
        As the programs take them.
    aoa : bool
        Whether the plant sends AOA_SSA.
    align : bool
        Whether the autopilot looks its reference ahead by the forecast delay.
    servo_timeout : int or None
        Samples, None for never.
    x0 : (nx,) array or None
        State at k = 0.
    gust : HarmonicGust or None
        Eq. (52).
    delta : SquareDelta or None
        Eq. (51).
    wind : WindSpec or None
        Turbulence and gusts of a nonlinear aircraft.
    witness_name : str or None
        File of the delay sequence that the link imposes.
    witness : Witness or None
        That sequence.
    faults : tuple of Fault
        What goes wrong, and when.
    rules : tuple of Rule
        Messages that meet another link than the rest of their direction.
    changes : tuple of Change
        What changes on the link in flight, by link time; a relay that starts again begins to count anew.
    checks : tuple of Check
        What must hold at the end.
    variants : mapping
        Name to the same scenario with one thing changed, flown beside it in virtual time to compare.
    """

    name: str
    title: str
    gains_name: str
    plant_name: str
    gains: GainLaw
    plant: Model
    duration_s: float
    seed: int
    reference: str
    up: LinkSpec
    down: LinkSpec
    clocks: Mapping[str, Clock]
    actuator: Literal["pwm", "float"] = "pwm"
    failsafe: Literal["on", "monitor"] = "on"
    latch: Literal["newest", "last"] = "newest"
    alpha: AlphaChoice = "auto"
    aoa: bool = True
    align: bool = True
    servo_timeout: int | None = None
    x0: NDArray[np.float64] | None = None
    gust: HarmonicGust | None = None
    delta: SquareDelta | None = None
    wind: WindSpec | None = None
    witness_name: str | None = None
    witness: Witness | None = None
    faults: tuple[Fault, ...] = ()
    rules: tuple[Rule, ...] = ()
    changes: tuple[Change, ...] = ()
    checks: tuple[Check, ...] = ()
    variants: Mapping[str, Scenario] = field(default_factory=dict)

    @property
    def samples(self) -> int:
        """Number of samples to fly."""
        return max(1, round(self.duration_s / self.plant.Ts))

    def with_faults(self, faults: Iterable[Fault]) -> Scenario:
        """Return the scenario with other faults.

        Raises
        ------
        InputError
            When they cannot be (:func:`sitl.faults.check_faults`).
        """
        faults = tuple(faults)
        check_faults(faults, self.plant.states, round(self.duration_s * NS_PER_S))
        return replace(self, faults=faults)

    def plant_node(self) -> PlantNode:
        """Return the plant, new."""
        return PlantNode(
            PlantConfig(
                self.plant,
                self.x0,
                self.gust,
                self.delta,
                self.latch,
                self.servo_timeout,
                self.aoa,
                aircraft_faults(self.faults),
                self.seed,
                self.airframe_maker(),
            )
        )

    def airframe_maker(self) -> Callable[[], Airframe] | None:
        """Return what makes the aircraft; None where it is the linear one.

        Raises
        ------
        InputError
            When the plant cannot fly what the scenario asks of it.
        """
        if is_nonlinear(self.plant_name) and (self.x0 is not None or self.delta is not None):
            asked = "x0" if self.x0 is not None else "uncertainty"
            raise InputError(f"{asked}: expected a linear model as plant, found {self.plant_name}")
        return airframe_maker(self.plant_name, self.plant, self.wind, self.seed)

    def relay_node(self, *, log_rate: int = DEFAULT_LOG_RATE) -> RelayNode:
        """Return the relay, new, which records at most so many packets a second."""
        return RelayNode(
            self.up,
            self.down,
            self.seed,
            None if self.witness is None else Gate(self.witness),
            rules=self.rules,
            changes=self.changes,
            log_rate=log_rate,
        )

    def autopilot_node(self, ground_stations: int) -> AutopilotNode:
        """Return the autopilot, new."""
        profile = parse_profile(self.reference, self.gains.model.Ts)
        return AutopilotNode(
            AutopilotConfig(
                self.gains,
                profile,
                self.actuator,
                self.failsafe,
                self.alpha,
                self.align,
                ground_stations=ground_stations,
            )
        )


def stored_scenarios() -> dict[str, Path]:
    """Return name and file of each stored scenario."""
    folder = resources.files("sitl") / "scenarios"
    paths = sorted(Path(str(entry)) for entry in folder.iterdir() if entry.name.endswith(".toml"))
    return {path.stem: path for path in paths}


def load_scenario(name_or_path: str, *, gains: str | None = None, plant: str | None = None) -> Scenario:
    """Return a stored scenario, or one from a file, optionally with other gains or another plant.

    Raises
    ------
    InputError
        When there is none, or it is not well formed.
    """
    stored = stored_scenarios()
    path = stored.get(name_or_path, Path(name_or_path))
    if name_or_path not in stored and not path.is_file():
        known = ", ".join(stored)
        raise InputError(f'scenario "{name_or_path}": expected one of {known}, or a file')
    table = Table.load(path)
    scenario = _parse(table, path.stem, gains, plant)
    table.finish()
    return scenario


def _parse(table: Table, name: str, gains_name: str | None, plant_name: str | None) -> Scenario:
    file_gains, file_plant = table.string("gains"), table.string("plant")
    gains_name, plant_name = gains_name or file_gains, plant_name or file_plant
    gains = load_law(gains_name)
    plant = plant_model(plant_name, gains.model)
    _check_fit(gains, plant)
    link = table.table("link", default=None)
    up, down = parse_link(*((link.string(key, default=None) if link else None) for key in ("preset", "up", "down")))
    latch: Literal["newest", "last"] = _choice(table, "latch", ("newest", "last"), "newest")
    witness_name = _witness_name(table, link)
    witness = None if witness_name is None else read_witness(witness_name)
    if witness is not None:
        check_flyable(witness, str(witness_name), latch, plant)
    duration_s = table.number("duration_s", above=0.0, high=86_400.0)
    longest = gains.d_max if witness is None else max(gains.d_max, witness.d_max)
    clocks = table.table("clocks", default=None)
    variants = table.table("variant", default=None)
    scenario = Scenario(
        name=name,
        title=table.string("title"),
        gains_name=gains_name,
        plant_name=plant_name,
        gains=gains,
        plant=plant,
        duration_s=duration_s,
        seed=table.integer("seed", default=1, low=0, high=MAX_SEED),
        reference=_reference(table),
        up=up,
        down=down,
        clocks={
            node: parse_clock(clocks.string(node, default=text) if clocks else text)
            for node, text in DEFAULT_CLOCKS.items()
        },
        actuator=_choice(table, "actuator", ("pwm", "float"), "pwm"),
        failsafe=_choice(table, "failsafe", ("on", "monitor"), "on"),
        latch=latch,
        alpha=_choice(table, "alpha", ("auto", "aoa_ssa", "vfr_hud"), "auto"),
        aoa=table.boolean("aoa", default=True),
        align=table.boolean("align", default=True),
        servo_timeout=_servo_timeout(table, longest + SERVO_TIMEOUT_MARGIN),
        x0=table.vector("x0", length=plant.nx, default=None),
        gust=_gust(table, plant),
        delta=_delta(table, plant),
        wind=_wind(table),
        witness_name=witness_name,
        witness=witness,
        rules=_link_texts(link, "rules", MAX_RULES, parse_rule),
        changes=_link_texts(link, "changes", MAX_CHANGES, lambda text: _change(text, duration_s)),
        checks=tuple(
            read_check(check, METRICS if witness is None else METRICS | WITNESS_METRICS, tuple(variants or ()))
            for check in table.tables("check", default=())
        ),
    )
    parse_profile(scenario.reference, gains.model.Ts)
    scenario.airframe_maker()
    scenario = scenario.with_faults(_faults(table))
    if variants is None:
        return scenario
    return replace(scenario, variants={v: _variant(scenario, variants.table(v)) for v in variants})


def _check_fit(gains: GainLaw, plant: Model) -> None:
    """Refuse a plant that the gains' state or sampling does not describe."""
    if plant.states != gains.model.states or plant.Ts_ns != gains.model.Ts_ns:
        raise InputError(
            f"gains {gains.name}: expected a plant with states {', '.join(gains.model.states)} at Ts"
            f" {gains.model.Ts} s, found {plant.name} with {', '.join(plant.states)} at {plant.Ts} s"
        )


def _choice(table: Table, key: str, words: tuple[_Word, ...], default: _Word) -> _Word:
    """Return one of some words."""
    chosen = table.string(key, default=default, choices=words)
    return next(word for word in words if word == chosen)


def _witness_name(table: Table, link: Table | None) -> str | None:
    """Return the witness file of ``[link]``, to which the scenario's folder is the place to start from."""
    name = link.string("witness", default=None) if link is not None else None
    return None if name is None else str(table.folder / name)


def _reference(table: Table) -> str:
    """Return the programmed reference; a file that it names is looked for from the scenario's folder."""
    text: str = table.string("reference", default="")
    return f"file:{table.folder / text.removeprefix('file:')}" if text.startswith("file:") else text


def _servo_timeout(table: Table, default: int | None) -> int | None:
    samples: int = table.integer("servo_timeout", default=default or 0, low=0)
    return samples or None


def _gust(table: Table, plant: Model) -> HarmonicGust | None:
    gust = table.table("gust", default=None)
    if gust is None:
        return None
    start_k = round(gust.number("start_s", default=0.0, low=0.0) / plant.Ts)
    if plant.nw == 0:
        raise table.error("gust", "a plant with a disturbance input E", f"{plant.name} without")
    return HarmonicGust(plant.nw, start_k)


def _delta(table: Table, plant: Model) -> SquareDelta | None:
    delta = table.table("uncertainty", default=None)
    if delta is None:
        return None
    if plant.uncertainty is None:
        raise table.error("uncertainty", "a plant with [uncertainty]", f"{plant.name} without")
    return SquareDelta(delta.number("amplitude", default=0.15), delta.integer("half_period", default=20, low=1))


def _wind(table: Table) -> WindSpec | None:
    text = table.string("wind", default=None)
    return None if text is None else parse_wind(text)


def _link_texts(link: Table | None, key: str, most: int, parse: Callable[[str], T]) -> tuple[T, ...]:
    """Return what the texts of a key of ``[link]`` say, at most so many; a complaint names file, key and place."""
    if link is None:
        return ()
    texts: Sequence[str] = link.strings(key, default=())
    if len(texts) > most:
        raise link.error(key, f"at most {most}", str(len(texts)))
    said = []
    for n, text in enumerate(texts):
        try:
            said.append(parse(text))
        except InputError as error:
            raise InputError(f"{link.source}: {link.name(key)}[{n}]: {error}") from None
    return tuple(said)


def _change(text: str, duration_s: float) -> Change:
    """Return a change of the link in a flight of this length."""
    change = parse_change(text)
    check_changes((change,), duration_s)
    return change


def check_changes(changes: Iterable[Change], duration_s: float) -> None:
    """Refuse changes of the link that would never be made, as the flight is over by then.

    Link time begins with the first packet, before sample k = 0, so a flight and its start-up are allowed for.

    Raises
    ------
    InputError
        For the first of them, in one line.
    """
    latest_ns = MAX_START_UP_NS + round(duration_s * NS_PER_S)
    for change in changes:
        if change.at_ns > latest_ns:
            raise InputError(
                f'change "{format_change(change)}": expected at most {format_time(latest_ns)}, which is a flight of'
                f" {duration_s:g} s and its start, found {format_time(change.at_ns)}"
            )


def _faults(table: Table) -> list[Fault]:
    """Return the faults of the file, none without the key."""
    return [parse_fault(text) for text in table.strings("faults", default=())]


def _variant(scenario: Scenario, table: Table) -> Scenario:
    """Return the scenario with what the variant's table changes."""
    faults = scenario.faults if table.strings("faults", default=None) is None else _faults(table)
    return replace(
        scenario.with_faults(faults),
        failsafe=_choice(table, "failsafe", ("on", "monitor"), scenario.failsafe),
        servo_timeout=_servo_timeout(table, scenario.servo_timeout),
        checks=(),
    )
