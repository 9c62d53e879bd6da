"""What a person sees in the terminal during a flight.

The view takes the records as they come, keeps a bounded state of them, and draws it when asked: live on a
terminal, one line per second of flight elsewhere. It reads no clock: the caller says what time it is.

The reference shown is yr = Cr xr of the command that the plant holds: what that command was computed to
track, which is yr(k) of Eq. (8) if its forecast of the delay was right. Once its delay has left the window,
as while the link is down, it says nothing about now, and no reference is shown.
"""

from __future__ import annotations

import math
from collections import Counter, OrderedDict, deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Self

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from autopilot.link.clock import NS_PER_S
from autopilot.link.node import Record
from autopilot.link.servo import travel_of
from sitl.braille import Part, bar, count, fit, histogram, input_quantity, output_quantity, percent, plain, plot
from sitl.link.impairment import Fate
from sitl.scenario import Scenario

__all__ = ["MODE_STYLES", "FlightView"]

MODE_STYLES: Mapping[str, str] = {
    "STANDBY": "bright_black",
    "TRACKING": "green",
    "LEVEL": "cyan",
    "CONSERVATIVE": "magenta",
    "HOLD": "yellow",
    "NEUTRAL": "red",
}
"""Colour of each mode of the failsafe."""

PLOT_S = 10.0
MAX_POINTS = 4096
"""Samples kept for the plot; at a very small Ts it shows less than PLOT_S."""
MAX_PLOT_ROWS = 16
MIN_PLOT_ROWS = 3
MAX_COMMANDS = 512
"""Commands remembered until the plant holds them, and samples seen held before their command."""
MAX_DELAY = 64
"""Delays from here on share one bin of the histogram."""
ROOMY_ROWS = 34
"""From this height on, blank lines part the groups."""
SHOWN_EVENTS = 4
SILENT_EVENTS = frozenset({"counters", "gains", "ports"})
STALE_S = 0.5
LABEL = 10
OUTPUT_STYLE, REFERENCE_STYLE, DIM, ALARM = "cyan", "magenta", "bright_black", "bold red"


class _Command(NamedTuple):
    """What a command says about the delay and the reference."""

    d: int | None
    low: int | None
    high: int | None
    yr: float


class _Event(NamedTuple):
    """An event, its log time, and the colour to show it in."""

    log_time_ns: int
    node: str
    text: str
    style: str


@dataclass(slots=True)
class _State:
    """Everything the records have said so far that is still shown."""

    points: deque[tuple[float, float, float]]
    now_ns: int = 0
    zero_ns: int | None = None
    truth_ns: int = 0
    k: int = -1
    y: float = math.nan
    yr: float = math.nan
    u: float = math.nan
    d: int | None = None
    timeout: bool = False
    held: _Command | None = None
    commands: OrderedDict[int, _Command] = field(default_factory=OrderedDict)
    first_d: OrderedDict[int, int] = field(default_factory=OrderedDict)
    mode: str | None = None
    saturated: bool = False
    compared: int = 0
    exact: int = 0
    histogram: list[int] = field(default_factory=lambda: [0] * (MAX_DELAY + 1))
    links: dict[str, Counter[str]] = field(default_factory=lambda: {"up": Counter(), "down": Counter()})
    events: deque[_Event] = field(default_factory=lambda: deque(maxlen=SHOWN_EVENTS))
    verified: bool | None = None

    @property
    def flight_s(self) -> float | None:
        """Return the time since sample k = 0, or None before it."""
        return None if self.zero_ns is None else (self.now_ns - self.zero_ns) / NS_PER_S

    @property
    def silent_s(self) -> float:
        """Return the time since the last sample; 0 before the first."""
        return 0.0 if self.zero_ns is None else (self.now_ns - self.truth_ns) / NS_PER_S


class FlightView:
    """The terminal's view of one flight.

    Parameters
    ----------
    scenario : Scenario
        What is flown.
    console : rich.console.Console
        Where it is shown. Without UTF-8 the view keeps to ASCII.
    virtual : bool
        Flown in virtual time, not over UDP; for the title.

    Raises
    ------
    InputError
        When the plant has no travel, and so cannot be flown.
    """

    def __init__(self, scenario: Scenario, console: Console, *, virtual: bool = False) -> None:
        self.scenario = scenario
        self.console = console
        self.virtual = virtual
        plant = scenario.plant
        self._travel = travel_of(plant)
        self._ascii = console.legacy_windows or not console.encoding.lower().startswith("utf")
        self._output = output_quantity(plant, ascii_only=self._ascii)
        self._input = input_quantity(plant, ascii_only=self._ascii)
        self._C = [float(c) for c in plant.C[0]]
        self._D = [float(c) for c in plant.D[0]]
        self._yr_trim = _dot(self._C, plant.trim.x.tolist()) + _dot(self._D, plant.trim.u.tolist())
        reference = scenario.gains.model.reference
        self._Cr = None if reference is None else [float(c) for c in reference.Cr[0]]
        self._state = _State(deque(maxlen=min(MAX_POINTS, math.ceil(PLOT_S / plant.Ts) + 1)))
        self._state.verified = False if scenario.gains.certificate is None else None
        self._live: Live | None = None
        self._printed: tuple[bool, int] | None = None

    # Records

    def take(self, record: Record, log_time_ns: int) -> None:
        """Take one record, of any topic, made at ``log_time_ns`` of true time."""
        state, body = self._state, record.body
        state.now_ns = max(state.now_ns, log_time_ns)
        match record.topic:
            case "plant/truth":
                self._take_truth(body, log_time_ns)
            case "autopilot/command":
                self._take_command(body)
            case "link/up" | "link/down":
                link = state.links[record.topic.removeprefix("link/")]
                link["duplicated" if body["copy"] else "sent"] += 1
                if body["fate"] != Fate.GATED:
                    link["lost" if body["delivered_ns"] is None else "delivered"] += 1
            case "events":
                self._take_event(body, log_time_ns)
            case _:
                pass

    def _take_truth(self, body: Mapping[str, Any], log_time_ns: int) -> None:
        state, k, j, d = self._state, body["k"], body["j"], body["d"]
        if state.zero_ns is None:
            state.zero_ns = log_time_ns - k * self.scenario.plant.Ts_ns
        if k <= state.k:  # the plant has started anew: its samples count from 0 again
            state.commands.clear()
            state.first_d.clear()
            state.held, state.yr = None, math.nan
        state.k, state.truth_ns = k, log_time_ns
        state.y = _dot(self._C, body["x"]) + _dot(self._D, body["u"])
        state.u, state.d, state.timeout = _number(body["u"][0]), d, bool(body["timeout"])
        if j is not None and d is not None:
            state.histogram[min(max(d, 0), MAX_DELAY)] += 1
            state.held = state.commands.get(j, state.held)
            inside = d <= self.scenario.gains.d_max
            state.yr = state.held.yr if inside and state.held is not None else math.nan
            if j not in state.first_d:
                _remember(state.first_d, j, d)
                self._compare(j)
        state.points.append(((log_time_ns - state.zero_ns) / NS_PER_S, state.y, state.yr))

    def _take_command(self, body: Mapping[str, Any]) -> None:
        state, j, xr = self._state, body["j"], body["xr"]
        yr = math.nan if xr is None or self._Cr is None else _dot(self._Cr, xr) + self._yr_trim
        _remember(state.commands, j, _Command(body["d"], body["d_low"], body["d_high"], yr))
        state.mode, state.saturated = body["mode"], bool(body["saturated"])
        if j in state.first_d:  # the two records come from two processes, in either order
            self._compare(j)

    def _compare(self, j: int) -> None:
        """Count whether the delay of command j was forecast exactly, once both are known."""
        command = self._state.commands.get(j)
        if command is not None and command.d is not None:
            self._state.compared += 1
            self._state.exact += command.d == self._state.first_d[j]

    def _take_event(self, body: Mapping[str, Any], log_time_ns: int) -> None:
        state, kind, data = self._state, body["kind"], body["data"]
        style = ""
        if kind == "gains":
            state.verified = bool(data.get("verified"))
        elif kind == "failsafe":
            state.mode = data["to"]
            style = MODE_STYLES[state.mode]
        elif kind in ("fault", "diverged"):
            style = ALARM
        if kind not in SILENT_EVENTS:
            state.events.append(_Event(log_time_ns, body["node"], body["text"], style))

    # Showing

    def __enter__(self) -> Self:
        if self.console.is_terminal and not self.console.is_dumb_terminal:
            # stdout stays as it is: it may carry the flight's JSON
            self._live = Live(self, console=self.console, auto_refresh=False, redirect_stdout=False)
            self._live.start(refresh=True)
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()
            self._live = None

    def refresh(self, now_ns: int) -> None:
        """Show the state as of ``now_ns``, true time on the axis of the records' log times.

        A terminal is redrawn; elsewhere :meth:`plain_line` is printed, once in each second of flight.
        """
        state = self._state
        state.now_ns = max(state.now_ns, now_ns)
        if self._live is not None:
            self._live.refresh()
            return
        second = (state.zero_ns is not None, (state.now_ns - (state.zero_ns or 0)) // NS_PER_S)
        if second != self._printed:
            self._printed = second
            self.console.print(self.plain_line(), markup=False, highlight=False, soft_wrap=True)

    def plain_line(self) -> str:
        """Return the state in one line without colour."""
        state, output, control = self._state, self._output, self._input
        parts = [f"{self._progress_text():>16}", f"{state.mode or 'waiting':8}"]
        if state.flight_s is not None:
            parts.append(f"{output.name} {output.show(state.y)}")
            if self._Cr is not None:
                parts.append(f"{output.reference} {output.show(state.yr)}")
            saturated = " saturated" if state.saturated else ""
            parts.append(f"{control.name} {control.show(state.u)}{saturated}")
            parts.append(f"d {count(state.d)}, forecast {_forecast(state.held)}")
            parts.append(f"exact {percent(state.exact, state.compared)}")
            parts += [f"{way} lost {_lost(link)}" for way, link in state.links.items()]
        return plain("  ".join(parts), ascii_only=self._ascii)

    def __rich__(self) -> Group:
        """Return the view at the console's present size, one Text per line, none longer than the width."""
        gap: list[list[Part]] = [[]] if self.console.height >= ROOMY_ROWS else []
        links = [self._link_line(way) for way in self._state.links]
        events = [self._event_line(event) for event in self._state.events]
        above = [self._progress_line(), [], self._output_line()]
        below = [*gap, self._input_line(), self._delay_line(), self._histogram_line(), *gap, *links, *gap]
        used = 2 + len(above) + len(below) + SHOWN_EVENTS
        rows = min(self.console.height - used - 2, MAX_PLOT_ROWS)  # 2: the axis of time, and a line to spare
        curves = self._plot_lines(rows) if rows >= MIN_PLOT_ROWS else []
        width = self.console.width
        lines = (fit(parts, width, ascii_only=self._ascii) for parts in [*above, *curves, *below, *events])
        return Group(*self._title_lines(), *lines)

    def _title_lines(self) -> list[Text]:
        """Return what flies on what, and whether it is proved."""
        scenario, gains, verified = self.scenario, self.scenario.gains, self._state.verified
        network = f"{'virtual' if self.virtual else 'UDP'}, seed {scenario.seed}"
        proof = ("certificate verified", "green") if verified else ("no verified certificate", "yellow")
        if verified is None:
            proof = ("certificate not checked yet", DIM)
        window = f"gains {gains.name}, window d = {gains.d_min}..{gains.d_max}, plant {scenario.plant.name}"
        first: list[Part] = [(scenario.name, "bold"), ("  " + scenario.title, "")]
        ends = ((first, (network, DIM)), ([(window, "")], proof))
        return [fit(left, self.console.width, [right], ascii_only=self._ascii) for left, right in ends]

    def _progress_text(self) -> str:
        """Return the time flown, and for how long no sample has come if that is long."""
        state, duration_s = self._state, self.scenario.duration_s
        if state.flight_s is None:
            return "waiting for sample k = 0"
        silent = f", no sample for {state.silent_s:.1f} s" if self._silent else ""
        return f"{max(0.0, state.flight_s):.1f} / {duration_s:g} s{silent}"

    @property
    def _silent(self) -> bool:
        flight_s = self._state.flight_s
        return self._state.silent_s > STALE_S and (flight_s or 0.0) < self.scenario.duration_s

    def _progress_line(self) -> list[Part]:
        mode, text = self._state.mode or "waiting", self._progress_text()
        badge: Part = (f" {mode} ", f"reverse {MODE_STYLES.get(mode, DIM)}")
        cells = max(4, self.console.width - LABEL - 2 - len(text))
        done = (self._state.flight_s or 0.0) / self.scenario.duration_s
        filled = bar(0.0, done, cells, "blue", ascii_only=self._ascii)
        return [badge, (" " * (LABEL - len(badge[0])), ""), *filled, ("  " + text, ALARM if self._silent else "")]

    def _output_line(self) -> list[Part]:
        state, shown = self._state, self._output
        parts = [_label(shown.name), (shown.show(state.y).rjust(9), f"bold {OUTPUT_STYLE}")]
        if self._Cr is not None:
            name, yr, error = shown.reference, shown.show(state.yr), shown.show(state.y - state.yr)
            parts += [(f"   {name} ", DIM), (yr.rjust(9), f"bold {REFERENCE_STYLE}")]
            parts += [("   error ", DIM), (error.rjust(9), ""), (f"   {name}: of the held command", DIM)]
        return parts

    def _plot_lines(self, rows: int) -> list[list[Part]]:
        """Return the last seconds of the output over those of the reference."""
        state, factor = self._state, self._output.factor
        span_s = min(PLOT_S, (state.points.maxlen or 1) * self.scenario.plant.Ts)
        left_s = max(0.0, (state.flight_s or 0.0) - span_s)  # it fills up before it moves
        curves = [[(point[0], point[i] * factor) for point in state.points] for i in (2, 1)]
        styles, size = (REFERENCE_STYLE, OUTPUT_STYLE), (max(self.console.width, 2 * LABEL), rows)
        unit = self._output.unit.strip()
        return plot(curves, styles, size, (left_s, left_s + span_s), unit, ascii_only=self._ascii)

    def _input_line(self) -> list[Part]:
        state, travel, shown = self._state, self._travel, self._input
        neutral, place = ((value - travel.low) / (travel.high - travel.low) for value in (travel.neutral, state.u))
        cells = min(41, max(11, self.console.width - 55))
        style = "red" if state.saturated else OUTPUT_STYLE
        cell = bar(neutral, place, cells, style, ascii_only=self._ascii)
        cell[min(cells - 1, int(neutral * cells))] = ("┃", "")
        low, high = (f"{value * shown.factor:.4g}{shown.unit}" for value in (travel.low, travel.high))
        flags = " SATURATED" * state.saturated + " TIMEOUT" * state.timeout
        number: list[Part] = [_label(shown.name), (shown.show(state.u).rjust(9), "")]
        return [*number, (f"  {low} ", DIM), *cell, (f" {high}", DIM), (flags, ALARM)]

    def _delay_line(self) -> list[Part]:
        state, gains = self._state, self.scenario.gains
        parts = [_label("delay"), ("d ", DIM), (count(state.d).rjust(2), self._delay_style(state.d))]
        parts += [("   forecast ", DIM), (_forecast(state.held), "bold"), (", exact ", DIM)]
        parts += [(percent(state.exact, state.compared), "bold"), (f" of {state.compared}", DIM)]
        return [*parts, (f"   window {gains.d_min}..{gains.d_max}", DIM)]

    def _histogram_line(self) -> list[Part]:
        return [_label("true d"), *histogram(self._state.histogram, self._delay_style, ascii_only=self._ascii)]

    def _link_line(self, way: str) -> list[Part]:
        link = self._state.links[way]
        sent, delivered = f"{link['sent']:<9}", f"{link['delivered']:<9}"
        parts = [_label(f"link {way}"), ("sent ", DIM), (sent, ""), ("delivered ", DIM), (delivered, "")]
        parts += [("lost ", DIM), (_lost(link).ljust(10), "yellow" if link["lost"] else "")]
        return [*parts, ("duplicated ", DIM), (str(link["duplicated"]), "")]

    def _event_line(self, event: _Event) -> list[Part]:
        zero_ns = self._state.zero_ns
        time = "—" if zero_ns is None else f"{(event.log_time_ns - zero_ns) / NS_PER_S:.2f} s"
        return [(f"{time:>9}  ", DIM), (f"{event.node:11}", DIM), (event.text, event.style)]

    def _delay_style(self, d: int | None) -> str:
        if d is None:
            return DIM
        return "bold green" if self.scenario.gains.d_min <= d <= self.scenario.gains.d_max else ALARM


def _label(text: str) -> Part:
    return (text.ljust(LABEL), DIM)


def _lost(link: Counter[str]) -> str:
    """Return the share of a direction's copies that did not arrive."""
    return percent(link["lost"], link["lost"] + link["delivered"])


def _forecast(command: _Command | None) -> str:
    """Return the forecast of a command and its bounds."""
    if command is None:
        return "—"
    return "unknown" if command.d is None else f"{command.d} [{count(command.low)}, {count(command.high)}]"


def _number(value: object) -> float:
    """Return a number of a record; nan for the null that JSON has for it."""
    return float(value) if isinstance(value, int | float) else math.nan


def _dot(row: list[float], values: list[object]) -> float:
    """Return the inner product, a factor of zero hiding whatever it meets; Python's floats raise no warning."""
    return sum((c * _number(value) for c, value in zip(row, values, strict=True) if c), 0.0)


def _remember(table: OrderedDict[int, Any], key: int, value: object) -> None:
    """Put an entry into a bounded table, the oldest making room."""
    table[key] = value
    if len(table) > MAX_COMMANDS:
        table.popitem(last=False)
