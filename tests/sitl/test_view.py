"""The terminal's view: it fits, its numbers are the records', and nothing a flight does makes it fall over."""

from __future__ import annotations

import io
import json
import math
import tracemalloc
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from autopilot.failsafe import Mode
from autopilot.link.node import Record
from sitl.braille import EMPTY, bar, histogram, nice_range, percent, raster
from sitl.flight import fly_virtual
from sitl.flightdata import FlightData
from sitl.scenario import load_scenario
from sitl.view import MODE_STYLES, FlightView

S = 1_000_000_000
Ts_ns = 25_000_000
NOMINAL = load_scenario("nominal")
PENDULUM = load_scenario("pendulum")
RAD = math.radians(1.0)


def screen(width=80, height=24, encoding="utf-8", **more) -> Console:
    """Return a console on a buffer; a terminal if asked."""
    file = io.TextIOWrapper(io.BytesIO(), encoding=encoding, errors="strict", write_through=True)
    return Console(file=file, width=width, height=height, legacy_windows=False, _environ={}, **more)


def written(console: Console) -> str:
    return console.file.buffer.getvalue().decode(console.file.encoding)


def lines_of(view: FlightView) -> list[str]:
    """Return what the view shows, line by line, without colour."""
    view.console.begin_capture()
    view.console.print(view)
    return view.console.end_capture().removesuffix("\n").split("\n")


def line_of(view: FlightView, label: str) -> str:
    (line,) = [line for line in lines_of(view) if line.startswith(label)]
    return line


def truth(k, theta_deg=0.0, u_deg=0.0, j=None, **more) -> Record:
    body = {"k": k, "t_ns": 0, "late_ns": 0, "x": [0.0, 0.0, theta_deg * RAD], "u": [u_deg * RAD], "j": j}
    body |= {"d": None if j is None else k - j, "w": [0.0], "delta": 0.0, "timeout": False}
    return Record("plant/truth", 0, body | more)


def command(j, d=2, low=1, high=3, theta_r_deg=0.0, **more) -> Record:
    body = {"j": j, "sample_ns": 0, "epoch": 0, "x": [0.0] * 3, "xr": [0.0, 0.0, theta_r_deg * RAD], "r": [0.0]}
    body |= {"u": [0.0], "saturated": False, "d": d, "d_low": low, "d_high": high}
    return Record("autopilot/command", 0, body | {"status": "estimated", "mode": "TRACKING"} | more)


def packet(way, arrived=True, copy=0) -> Record:
    body = {"sent_ns": 0, "delivered_ns": 5 if arrived else None, "size": 40}
    return Record(f"link/{way}", 0, body | {"fate": "delivered" if arrived else "lost", "copy": copy})


def event(kind, text, **data) -> Record:
    return Record("events", 0, {"kind": kind, "node": "autopilot", "text": text, "data": data})


def fed(records, scenario=NOMINAL, console=None, **more) -> FlightView:
    """Return a view that has taken the records, one sample apart."""
    view = FlightView(scenario, console or screen(), **more)
    for i, record in enumerate(records):
        view.take(record, S + i * Ts_ns)
    return view


def flown(name, console, seconds) -> FlightView:
    scenario = replace(load_scenario(name), duration_s=seconds)
    view = FlightView(scenario, console, virtual=True)
    fly_virtual(scenario, view.take)
    return view


# It fits


@pytest.mark.parametrize("name", ["nominal", "blackout", "lossy", "pendulum"])
@pytest.mark.parametrize("width", [1, 20, 40, 79, 80, 120, 200])
def test_no_line_is_longer_than_the_console(name, width):
    console = screen(width, 24)
    assert max(map(len, lines_of(flown(name, console, 3.5)))) <= width


@pytest.mark.parametrize("encoding", ["utf-8", "ascii", "latin-1"])
@pytest.mark.parametrize(("width", "height"), [(80, 24), (120, 40)])
def test_a_flight_with_four_events_fits_the_terminal_with_its_plot(width, height, encoding):
    view = flown("blackout", screen(width, height, encoding), 5.0)
    lines = lines_of(view)
    assert len(lines) < height
    assert max(map(len, lines)) <= width
    assert sum("│" in line or " |" in line for line in lines) >= 8
    assert "NEUTRAL to TRACKING" in lines[-1]


def test_a_low_terminal_gives_up_the_plot_and_keeps_the_numbers():
    lines = lines_of(flown("nominal", screen(80, 16), 2.0))
    assert len(lines) < 16
    assert not any("│" in line for line in lines)
    assert any(line.startswith("delay") for line in lines)


def test_a_console_without_utf_8_gets_ascii_alone():
    console = screen(encoding="ascii")
    view = flown("blackout", console, 3.0)
    view.take(event("fault", "θ → ∞ at 5°"), 4 * S)
    console.print(view)
    console.print(view.plain_line())
    shown = written(console)
    assert shown.isascii()
    assert "theta_r" in shown
    assert "theta ? inf at 5 deg" in shown


# The numbers are those of the records


def test_output_reference_error_and_elevator_are_shown_in_degrees():
    view = fed([command(3, theta_r_deg=5.0), truth(5, theta_deg=4.25, u_deg=-1.5, j=3)])
    assert line_of(view, "θ").split()[:6] == ["θ", "4.25°", "θr", "5.00°", "error", "-0.75°"]
    assert line_of(view, "elevator").split()[1:3] == ["-1.50°", "-25°"]


def test_a_reference_whose_delay_has_left_the_window_is_not_shown():
    view = fed([command(3, theta_r_deg=5.0), truth(3 + NOMINAL.gains.d_max, j=3)])
    assert "5.00°" in line_of(view, "θ")
    view.take(truth(4 + NOMINAL.gains.d_max, j=3), 2 * S)
    assert line_of(view, "θ").split()[3] == "—"


def test_reference_is_eq_8_whenever_the_forecast_was_right():
    view, records, shown = FlightView(NOMINAL, screen()), [], {}

    def write(record, log_time_ns):
        records.append((record.topic, log_time_ns, record.body))
        view.take(record, log_time_ns)
        if record.topic == "plant/truth" and record.body["k"] % 7 == 0:
            shown[record.body["k"]] = line_of(view, "θ").split()

    fly_virtual(NOMINAL, write)
    flight = FlightData.from_records(records, NOMINAL.plant)
    forecast = dict(zip(flight.command_j.tolist(), flight.forecast.tolist(), strict=True))
    right = [k for k in shown if forecast.get(flight.j[k]) == flight.d[k]]
    assert len(right) > 20
    for k in right:
        assert float(shown[k][3].rstrip("°")) == pytest.approx(math.degrees(flight.reference[k, 0]), abs=0.00501)
    for k in shown:
        assert float(shown[k][1].rstrip("°")) == pytest.approx(math.degrees(flight.output[k, 0]), abs=0.00501)


def test_delay_is_shown_against_the_forecast_of_the_held_command():
    view = fed([command(7, d=2, low=1, high=3), command(8, d=4, low=4, high=4), truth(10, j=7)])
    assert "d  3   forecast 2 [1, 3], exact 0.0 % of 1   window 1..4" in line_of(view, "delay")


@pytest.mark.parametrize("command_first", [True, False])
def test_each_command_is_scored_once_at_its_first_use_in_either_order_of_the_records(command_first):
    view, k = FlightView(NOMINAL, screen()), 0
    for j, d, first in ((0, 2, 2), (4, 2, 3), (8, 2, 2), (12, None, 2)):
        k = j + first
        pair = [command(j, d=d), truth(k, j=j)]
        for record in pair if command_first else reversed(pair):
            view.take(record, k * Ts_ns)
        view.take(truth(k + 1, j=j), (k + 1) * Ts_ns)
    assert "exact 66.7 % of 3" in line_of(view, "delay")


def test_histogram_counts_every_sample_by_its_true_delay_and_lumps_the_tail():
    delays = [1] * 10 + [2] * 60 + [3] * 25 + [40] * 5
    view = fed([truth(100 + i, j=100 + i - d) for i, d in enumerate(delays)])
    line = line_of(view, "true d")
    assert [part.strip() for part in line.removeprefix("true d").split("%")[:3]] == ["1 ▂ 10", "2 █ 60", "3 ▄ 25"]
    assert "≥7 ▁ 5 %" in line


def test_link_counters_are_kept_per_direction():
    records = [packet("up")] * 6 + [packet("up", arrived=False)] * 2 + [packet("down"), packet("down", copy=1)]
    view = fed(records)
    up, down = (" ".join(line_of(view, f"link {way}").split()) for way in ("up", "down"))
    assert up == "link up sent 8 delivered 6 lost 25.0 % duplicated 0"
    assert down == "link down sent 1 delivered 2 lost 0.0 % duplicated 1"


def test_saturation_and_servo_timeout_are_flagged_only_while_they_last():
    view = fed([command(3, saturated=True), truth(5, j=3, timeout=True)])
    assert "SATURATED TIMEOUT" in line_of(view, "elevator")
    view.take(command(4), 2 * S)
    view.take(truth(6, j=4), 2 * S)
    assert "SATURATED" not in line_of(view, "elevator")
    assert "TIMEOUT" not in line_of(view, "elevator")


def test_the_last_four_events_are_shown_with_their_time_and_counters_are_not():
    view = fed([truth(0), *(event("clockwork", f"event {i}") for i in range(6)), event("counters", "counters")])
    shown = [line.split() for line in lines_of(view) if "autopilot" in line]
    assert [(line[0], line[-1]) for line in shown] == [("0.07", "2"), ("0.10", "3"), ("0.12", "4"), ("0.15", "5")]


def test_gains_without_a_verified_certificate_say_so_and_verified_ones_do_too():
    view = fed([])
    assert "no verified certificate" in lines_of(view)[1]
    view.take(event("gains", "", verified=True), 0)
    assert "certificate verified" in lines_of(view)[1]
    claimed = replace(NOMINAL, gains=replace(NOMINAL.gains, certificate={"method": "exact"}))
    assert "not checked" in lines_of(fed([], claimed))[1]


def test_title_names_the_driver_and_the_progress_line_the_time():
    view = fed([truth(k) for k in range(101)], virtual=True)
    lines = lines_of(view)
    assert lines[0].startswith("nominal  a 5° pitch step")
    assert lines[0].endswith("virtual, seed 1")
    assert lines[2].endswith("2.5 / 10 s")
    assert lines_of(fed([]))[0].endswith("UDP, seed 1")
    assert "waiting for sample k = 0" in lines_of(fed([]))[2]


def test_a_plant_that_falls_silent_is_reported():
    view = fed([truth(0)])
    view.refresh(S + int(1.25 * S))
    assert "no sample for 1.2 s" in lines_of(view)[2]
    assert "no sample for 1.2 s" in view.plain_line()


# Colour


def style_of(view: FlightView, text: str) -> str | None:
    """Return the name of the colour in which a text is shown."""
    colours = [s.style.color for s in view.console.render(view) if s.text.strip() == text and s.style]
    return colours[0].name if colours and colours[0] else None


@pytest.mark.parametrize("mode", list(Mode))
def test_every_mode_has_its_colour_from_a_command_and_from_an_event(mode):
    assert style_of(fed([command(0, mode=mode)]), mode) == MODE_STYLES[mode]
    assert style_of(fed([event("failsafe", "why", to=mode)]), mode) == MODE_STYLES[mode]
    assert style_of(fed([event("failsafe", "why", to=mode)]), "why") == MODE_STYLES[mode]


def test_a_delay_outside_the_window_is_red():
    assert style_of(fed([truth(9, j=6)]), "3") == "green"
    assert style_of(fed([truth(9, j=0)]), "9") == "red"


def test_no_color_is_respected():
    file = io.TextIOWrapper(io.BytesIO(), encoding="utf-8", write_through=True)
    console = Console(file=file, width=80, height=24, force_terminal=True, _environ={"NO_COLOR": "1"})
    console.print(fed([command(0, mode="HOLD")], console=console))
    assert "HOLD" in written(console)
    assert not any(f"\x1b[{code}" in written(console) for code in ("31", "32", "33", "34", "36", "7;33"))


# Terminals and files


def test_a_terminal_is_drawn_live_and_keeps_the_last_state():
    console = screen(force_terminal=True)
    with fed([truth(0, theta_deg=1.0)], console=console) as view:
        view.take(truth(1, theta_deg=2.0), S)
        view.refresh(S)
        assert "2.00°" in written(console)
        view.take(truth(2, theta_deg=3.0), S)
    assert "3.00°" in written(console)
    assert "\x1b[?1049h" not in written(console)


def test_a_file_gets_one_line_for_each_second_of_flight():
    console = screen(width=40)
    with FlightView(NOMINAL, console) as view:
        view.refresh(0)
        view.refresh(S // 2)
        for k in range(121):
            view.take(truth(k, theta_deg=k / 10), S // 2 + k * Ts_ns)
            view.refresh(S // 2 + k * Ts_ns)
    lines = written(console).splitlines()
    assert len(lines) == 5
    assert "waiting" in lines[0]
    assert [line.split()[0] for line in lines[1:]] == ["0.0", "1.0", "2.0", "3.0"]


def test_a_dumb_terminal_gets_lines():
    file = io.TextIOWrapper(io.BytesIO(), encoding="utf-8", write_through=True)
    console = Console(file=file, width=80, height=24, force_terminal=True, _environ={"TERM": "dumb"})
    with fed([truth(0)], console=console) as view:
        view.refresh(S)
    assert written(console).count("\n") == 1
    assert "\x1b[" not in written(console)


def test_plain_line_says_time_mode_output_input_delay_and_losses():
    records = [packet("up", arrived=False), packet("down"), command(3, theta_r_deg=5.0, saturated=True)]
    line = fed([*records, truth(5, theta_deg=4.25, u_deg=-25.0, j=3)]).plain_line()
    for part in ("0.1 / 10 s", "TRACKING", "θ 4.25°", "θr 5.00°", "elevator -25.00° saturated"):
        assert part in line
    assert line.endswith("d 2, forecast 2 [1, 3]  exact 100.0 %  up lost 100.0 %  down lost 0.0 %")
    assert "\n" not in line


# Nothing makes it fall over


ODD = [math.nan, math.inf, -math.inf, 1e300, -1e300, 1.7e308, None]


@pytest.mark.parametrize("value", ODD)
@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
def test_values_beyond_all_bounds_are_shown_and_do_not_raise(value, encoding):
    records = [truth(0), command(0, xr=[value] * 3), truth(1, j=0, x=[value] * 3, u=[value]), truth(2, 1.0, j=0)]
    view = fed(records[:3], console=screen(encoding=encoding))
    lines = lines_of(view)
    assert max(map(len, lines)) <= 80
    assert view.plain_line()
    if value is None or math.isnan(value):
        assert lines[4].split()[1] in ("—", "-")
    view.take(records[3], S)
    assert "1.00" in lines_of(view)[4]


def test_null_delays_and_a_missing_reference_are_dashes():
    view = fed([command(0, d=None, low=None, high=None, xr=None, status="unknown"), truth(0), truth(2, j=0)])
    assert "forecast unknown, exact — of 0" in line_of(view, "delay")
    assert line_of(view, "θ").split()[3] == "—"
    assert line_of(fed([truth(0)]), "delay").split()[:5] == ["delay", "d", "—", "forecast", "—,"]


def test_text_from_the_network_cannot_move_the_cursor_or_carry_markup():
    view = fed([truth(0), event("fault", "\x1b[2J\r\n[bold]x[/nope]")])
    assert lines_of(view)[-1].endswith(" [2J  [bold]x[/nope]")


def test_a_restart_forgets_the_commands_of_the_life_before():
    view = fed([command(0, theta_r_deg=5.0), truth(2, j=0), truth(0), truth(1)])
    assert line_of(view, "θ").split()[3] == "—"
    view.take(truth(3, j=0), 3 * S)
    assert line_of(view, "θ").split()[3] == "—"


def test_memory_is_bounded_over_a_hundred_thousand_records():
    view = FlightView(NOMINAL, screen())

    def feed(first, last):
        for k in range(first, last):
            for record in (command(k, d=k), truth(k + 2, float(k), j=k), packet("up"), event("fault", f"event {k}")):
                view.take(record, k * Ts_ns)

    feed(0, 5_000)
    tracemalloc.start()
    try:
        feed(5_000, 6_000)
        before = tracemalloc.get_traced_memory()[0]
        feed(6_000, 26_000)
        grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert grown < 20_000
    assert line_of(view, "link up").split()[3] == "26000"


def test_records_read_back_from_json_are_taken():
    view = FlightView(NOMINAL, screen())
    for record in (command(0), truth(2, 3.0, j=0), packet("up"), event("failsafe", "x", to="HOLD")):
        view.take(Record(record.topic, 0, json.loads(json.dumps(record.body))), S)
    view.take(Record("mavlink/plant", 0, {}), S)
    assert "3.00°" in line_of(view, "θ")
    assert " HOLD " in lines_of(view)[2]


# A plant of another kind


def test_the_pendulum_has_no_reference_and_a_force():
    view = fed([truth(0, x=[0.1, 0.0], u=[12.5])], PENDULUM)
    assert line_of(view, "angle").split() == ["angle", "5.73°"]
    assert line_of(view, "u").split()[1:3] == ["12.50", "-100"]
    assert "r " not in view.plain_line().split("u 12.50")[0].split("angle 5.73°")[1]


def test_an_output_that_is_no_state_has_no_unit():
    plant = replace(NOMINAL.plant, C=np.array([[-1.0, 0.0, 1.0]]))  # the path angle
    assert line_of(fed([truth(0, 4.0)], replace(NOMINAL, plant=plant)), "y").split()[1] == "0.07"


# Drawing


def dots_of(rows) -> set[tuple[int, int]]:
    bit = {(0, 0): 1, (0, 1): 2, (0, 2): 4, (1, 0): 8, (1, 1): 16, (1, 2): 32, (0, 3): 64, (1, 3): 128}
    return {
        (2 * x + dx, 4 * y + dy)
        for y, row in enumerate(rows)
        for x, (character, _) in enumerate(row)
        for (dx, dy), value in bit.items()
        if character != " " and (ord(character) - 0x2800) & value
    }


def test_a_straight_line_is_drawn_from_corner_to_corner():
    rows = raster([[(0.0, 0.0), (1.0, 1.0)]], (8, 4), (0.0, 1.0), (0.0, 1.0))
    assert dots_of(rows) == {(i, 15 - i) for i in range(16)}


@given(
    st.lists(st.tuples(st.floats(), st.floats()), max_size=30),
    st.integers(1, 12),
    st.integers(1, 6),
    st.booleans(),
)
def test_any_points_make_a_raster_of_the_size_asked_for(points, columns, rows, ascii_only):
    cells = raster([points, points], (columns, rows), (-1.0, 1.0), (-1.0, 1.0), ascii_only=ascii_only)
    assert [len(row) for row in cells] == [columns] * rows
    assert all((character == " ") == (curve == EMPTY) for row in cells for character, curve in row)


def test_a_jump_is_joined_and_a_gap_is_not():
    joined = raster([[(0.0, 0.0), (0.5, 0.0), (0.5, 1.0), (1.0, 1.0)]], (4, 2), (0.0, 1.0), (0.0, 1.0))
    heights = sorted(y for x, y in dots_of(joined) if x == 4)
    assert all(b - a == 1 for a, b in pairwise(heights))
    gap = raster([[(0.0, 0.0), (0.5, math.nan), (1.0, 0.0)]], (4, 1), (0.0, 1.0), (0.0, 1.0))
    assert dots_of(gap) == {(0, 3), (7, 3)}


@given(st.lists(st.floats(-1e8, 1e8), min_size=1))
def test_the_nice_range_holds_every_value(values):
    low, high = nice_range(values)
    assert low <= min(values) <= max(values) <= high
    assert low < high


def test_the_bar_grows_from_neutral_to_either_side():
    assert "".join(c for c, _ in bar(0.5, 1.0, 4, "x")) == "──━━"
    assert "".join(c for c, _ in bar(0.5, 0.125, 4, "x")) == "╺━──"
    assert "".join(c for c, _ in bar(0.5, math.nan, 4, "x")) == "────"
    assert "".join(c for c, _ in bar(0.5, math.inf, 4, "x", ascii_only=True)) == "--=="


def test_shares_without_a_whole_are_dashes():
    assert percent(0, 0) == "—"
    assert histogram([0, 0], lambda _: "") == [("—", "bright_black")]
