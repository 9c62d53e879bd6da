"""FlightData against direct loops; the figure by its pixels."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread

from gains.model import Gains, Model, Reference, Trim
from gains.store import load_gains
from sitl.flightdata import FlightData, LinkPackets, ModeInterval
from sitl.plot import DPI, SIZE_INCH, flight_figure, plot_flight

Entry = tuple[str, int, dict[str, Any]]
ZERO_NS = 700_000_000  # the flight's log time of k = 0
RELAY_OFFSET_NS = 5_000_000_000
DEG = float(np.deg2rad(1.0))


def pendulum() -> Model:
    return load_gains("pendulum-paper").model


def odd_model() -> Model:
    """Return a model with everything that could be forgotten: trim, D, two outputs, two inputs."""
    rng = np.random.default_rng(5)
    return Model(
        name="odd",
        Ts=0.05,
        A=0.9 * np.eye(3),
        B=rng.normal(size=(3, 2)),
        E=np.zeros((3, 0)),
        C=rng.normal(size=(2, 3)),
        D=rng.normal(size=(2, 2)),
        states=("a", "b", "c"),
        trim=Trim(rng.normal(size=3), rng.normal(size=2)),
        reference=Reference(0.5 * np.eye(2), rng.normal(size=(2, 2)), rng.normal(size=(2, 2))),
    )


def truth(k: int, log_ns: int, x: Any, u: Any, j: int | None = None, w: Any = ()) -> Entry:
    body = {
        "k": k,
        "t_ns": 9_000_000_000 + log_ns,
        "late_ns": 10 * k,
        "x": list(x),
        "u": list(u),
        "j": j,
        "d": None if j is None else k - j,
        "w": list(w),
        "delta": 0.0,
        "timeout": False,
    }
    return "plant/truth", log_ns, body


def command(j: int, log_ns: int, **more: Any) -> Entry:
    body = {
        "j": j,
        "sample_ns": 0,
        "epoch": 0,
        "x": [],
        "xr": None,
        "r": None,
        "u": [],
        "saturated": False,
        "d": None,
        "d_low": None,
        "d_high": None,
        "status": "ok",
        "mode": "TRACKING",
    }
    return "autopilot/command", log_ns, {**body, **more}


def packet(way: str, entered_ns: int, delay_ns: int | None, wait_ns: int = 30_000_000) -> Entry:
    sent_ns = entered_ns + RELAY_OFFSET_NS
    body = {
        "sent_ns": sent_ns,
        "delivered_ns": None if delay_ns is None else sent_ns + delay_ns,
        "number": 1,
        "size": 44,
        "fate": "lost" if delay_ns is None else "delivered",
        "copy": 0,
    }
    return f"link/{way}", entered_ns + (wait_ns if delay_ns is None else delay_ns), body


def event(log_ns: int, kind: str, text: str, **data: Any) -> Entry:
    return "events", log_ns, {"kind": kind, "node": "autopilot", "text": text, "data": data}


class Flight:
    """A small closed loop over a lossy link, with a blackout; records as the real one makes them."""

    def __init__(self, law: Gains, amplitude: float, x0: Any, seed: int = 1):
        self.model, self.K1, self.K2 = law.model, law.K1, law.K2
        self.amplitude, self.x0 = amplitude, np.asarray(x0, dtype=float)
        self.rng = np.random.default_rng(seed)

    def records(self, samples: int, blackout: range) -> Iterator[Entry]:
        model, rng = self.model, self.rng
        Ts_ns = model.Ts_ns
        assert model.actuator is not None
        low, high = model.actuator.low, model.actuator.high
        assert low is not None
        x, xr, held, newest = self.x0, np.zeros(model.nr), np.zeros(model.nu), None
        under_way: list[tuple[int, int, Any]] = []
        for k in range(samples):
            now_ns = ZERO_NS + k * Ts_ns
            dead = k in blackout
            arrived = [c for c in under_way if c[0] <= now_ns]
            under_way = [c for c in under_way if c[0] > now_ns]
            for _, j, u in sorted(arrived, key=lambda c: c[1]):
                if newest is None or j > newest:
                    newest, held = j, u
            yield truth(k, now_ns, x, held, newest, rng.normal(size=1))
            up_ns = None if dead or rng.random() < 0.04 else int(rng.gamma(2, 6e6) + 8e6)
            yield packet("up", now_ns, up_ns)
            r = np.array([self.amplitude if (k * model.Ts) % 10 < 5 else 0.0])
            if up_ns is not None:
                wanted = self.K1 @ x + (self.K2 @ xr if self.K2 is not None else 0.0)
                u = np.clip(wanted, low, high)
                down_ns = None if rng.random() < 0.04 else int(rng.gamma(2, 6e6) + 8e6)
                mode = "STANDBY" if k < 6 else "HOLD" if k - 12 in blackout else "TRACKING"
                guess = (up_ns + int(1.5e7)) // Ts_ns + 1
                more = {"xr": list(xr), "r": list(r)} if self.K2 is not None else {}
                yield command(
                    k, now_ns + up_ns, u=list(u), saturated=bool((u != wanted).any()), mode=mode, **more,
                    **({"d": guess, "d_low": guess - 1, "d_high": guess + 1} if k > 20 else {}),
                )  # fmt: skip
                yield packet("down", now_ns + up_ns, down_ns)
                if down_ns is not None:
                    under_way.append((now_ns + up_ns + down_ns, k, u))
            if dead and k == blackout.start + 8:
                yield event(now_ns, "failsafe", "NEUTRAL: no sample", to="NEUTRAL")
            x = model.A @ x + model.B @ held + (0.02 * DEG * rng.normal() if self.K2 is not None else 0.0)
            if model.reference is not None:
                xr = model.reference.Ar @ xr + model.reference.Br @ r


def flown(gains: str, amplitude: float, x0: Any, samples: int, blackout: range) -> FlightData:
    law = load_gains(gains)
    records = Flight(law, amplitude, x0).records(samples, blackout)
    meta = {"scenario": "nominal", "gains": law.name, "seed": "1"}
    meta |= {"d_min": str(law.d_min), "d_max": str(law.d_max)}
    return FlightData.from_records(records, law.model, meta)


def hirm_flight(amplitude: float = 5 * DEG) -> FlightData:
    return flown("hirm-paper", amplitude, np.zeros(3), 1200, range(600, 680))


def pendulum_flight() -> FlightData:
    return flown("pendulum-paper", 0.0, [3 * DEG, 0.0], 300, range(0))


# --- arrays


def odd_records(skip: set[int] | None = None) -> tuple[list[Entry], dict[int, Any]]:
    rng = np.random.default_rng(2)
    entries, inputs = [], {}
    for k in range(40):
        entries.append(truth(k, ZERO_NS + k * 50_000_000, rng.normal(size=3), rng.normal(size=2), max(k - 2, 0)))
        inputs[k] = rng.normal(size=2)
        if skip is None or k not in skip:
            entries.append(command(k, ZERO_NS + k * 50_000_000 + 9, r=list(inputs[k]), xr=[1.0, 2.0]))
    return entries, inputs


def direct_error(model: Model, entries: list[Entry], inputs: Mapping[int, Any]) -> list[list[float]]:
    """Compute e(k) = C x + D u − Cr xr entry by entry, with plain sums."""
    reference = model.reference
    assert reference is not None
    errors = []
    xr, r = [0.0, 0.0], [0.0, 0.0]
    for _, _, body in (entry for entry in entries if entry[0] == "plant/truth"):
        row = []
        for i in range(2):
            e = sum(model.C[i, n] * (body["x"][n] - model.trim.x[n]) for n in range(3))
            e += sum(model.D[i, n] * (body["u"][n] - model.trim.u[n]) for n in range(2))
            row.append(e - sum(reference.Cr[i, n] * xr[n] for n in range(2)))
        errors.append(row)
        r = list(inputs.get(body["k"], r))
        xr = [
            sum(reference.Ar[i, n] * xr[n] for n in range(2)) + sum(reference.Br[i, n] * r[n] for n in range(2))
            for i in range(2)
        ]
    return errors


@pytest.mark.parametrize("skip", [set(), {0, 1, 2}, {7, 8, 20, 39}, set(range(40))])
def test_error_is_that_of_a_direct_loop_and_r_is_held_where_commands_miss(skip: set[int]) -> None:
    model = odd_model()
    entries, inputs = odd_records(skip)
    flight = FlightData.from_records(entries, model)
    kept = {k: r for k, r in inputs.items() if k not in skip}
    np.testing.assert_allclose(flight.error, direct_error(model, entries, kept), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(flight.output - flight.reference, flight.error, atol=1e-12)
    np.testing.assert_array_equal(flight.command_j, sorted(kept))
    assert flight.xr.shape == (40 - len(skip), 2)
    assert flight.rms_error == pytest.approx(np.sqrt((flight.error**2).mean(axis=0)))


def test_error_without_a_reference_is_the_output() -> None:
    model = replace(odd_model(), reference=None)
    entries, _ = odd_records()
    flight = FlightData.from_records([e for e in entries if e[0] == "plant/truth"], model)
    x, u = (np.array([e[2][name] for e in entries if e[0] == "plant/truth"]) for name in ("x", "u"))
    expected = (x - model.trim.x) @ model.C.T + (u - model.trim.u) @ model.D.T
    np.testing.assert_allclose(flight.error, expected)
    assert flight.command_s.shape == (0,)
    assert flight.modes == ()


def test_arrays_hold_what_was_recorded() -> None:
    model = pendulum()
    entries = [
        truth(0, ZERO_NS, [0.1, 0.2], [0.0], None, [1.0]),
        truth(1, ZERO_NS + 30_000_000, [0.3, 0.4], [5.0], 0, [2.0]),
        command(0, ZERO_NS + 10, d=1, d_low=1, d_high=2, saturated=True),
        command(1, ZERO_NS + 30_000_010),
    ]
    flight = FlightData.from_records(entries, model, {"seed": "4"})
    np.testing.assert_allclose(flight.time_s, [0.0, 0.03])
    np.testing.assert_array_equal(flight.x, [[0.1, 0.2], [0.3, 0.4]])
    np.testing.assert_array_equal(flight.u, [[0.0], [5.0]])
    np.testing.assert_array_equal(flight.w, [[1.0], [2.0]])
    np.testing.assert_array_equal(flight.d, [np.nan, 1.0])
    np.testing.assert_array_equal(flight.j, [np.nan, 0.0])
    np.testing.assert_array_equal(flight.late_ns, [0, 10])
    np.testing.assert_array_equal(flight.forecast, [1.0, np.nan])
    np.testing.assert_array_equal(flight.forecast_low, [1.0, np.nan])
    np.testing.assert_array_equal(flight.forecast_high, [2.0, np.nan])
    np.testing.assert_array_equal(flight.saturated, [True, False])
    np.testing.assert_allclose(flight.command_s, [0.0, 0.03])
    assert flight.xr.shape == (2, 0)
    assert flight.metadata == {"seed": "4"}


def test_modes_are_intervals_without_gaps() -> None:
    model = pendulum()
    step = model.Ts_ns
    entries = [truth(k, ZERO_NS + k * step, [0, 0], [0]) for k in range(100)]
    names = ["STANDBY"] * 3 + ["TRACKING"] * 40 + ["HOLD"] * 2
    entries += [command(k, ZERO_NS + k * step, mode=mode) for k, mode in enumerate(names)]
    entries.append(event(ZERO_NS + 60 * step, "failsafe", "no sample", to="NEUTRAL"))
    entries.append(event(ZERO_NS + 70 * step, "fault", "servo"))
    flight = FlightData.from_records(entries, model)
    expected = [(0, 3, "STANDBY"), (3, 43, "TRACKING"), (43, 60, "HOLD"), (60, 100, "NEUTRAL")]
    for found, (start, end, mode) in zip(flight.modes, expected, strict=True):
        assert isinstance(found, ModeInterval)
        assert found.mode == mode
        assert (found.start_s, found.end_s) == pytest.approx((start * 0.03, end * 0.03))
    assert [(e.kind, e.text) for e in flight.events] == [("failsafe", "no sample"), ("fault", "servo")]
    assert flight.events[1].time_s == pytest.approx(2.1)


def test_packets_are_placed_in_true_time_whatever_the_relay_clock_shows() -> None:
    entries = [
        truth(0, ZERO_NS, [0, 0], [0]),
        packet("up", ZERO_NS + 100_000_000, 20_000_000),
        packet("up", ZERO_NS + 200_000_000, None, wait_ns=70_000_000),
        packet("up", ZERO_NS + 300_000_000, 50_000_000),
    ]
    flight = FlightData.from_records(entries, pendulum())
    assert isinstance(flight.links["up"], LinkPackets)
    np.testing.assert_allclose(flight.links["up"].entered_s, [0.1, 0.2, 0.3])
    np.testing.assert_allclose(flight.links["up"].delay_s, [0.02, np.nan, 0.05])
    assert flight.links["down"].entered_s.shape == (0,)


def test_a_restarted_plant_is_placed_in_true_time_with_the_reference_from_zero() -> None:
    model = odd_model()
    step = model.Ts_ns
    x, u = model.trim.x, model.trim.u
    entries = [truth(k, ZERO_NS + k * step, x, u) for k in range(10)]
    entries += [command(k, ZERO_NS + k * step, r=[1.0, 1.0]) for k in range(10)]
    entries += [truth(k, ZERO_NS + (30 + k) * step, x, u) for k in range(5)]
    flight = FlightData.from_records(entries, model)
    np.testing.assert_allclose(flight.time_s, 0.05 * np.array([*range(10), *range(30, 35)]))
    np.testing.assert_array_equal(flight.k, [*range(10), *range(5)])
    assert np.abs(flight.error[1:10]).max() > 0.1
    np.testing.assert_allclose(flight.error[10:], 0.0, atol=1e-12)


def test_a_recording_without_samples_is_refused() -> None:
    with pytest.raises(ValueError, match="plant/truth"):
        FlightData.from_records([command(0, 0)], pendulum())


# --- the figure


def check_png(path: Path, flight: FlightData) -> None:
    assert path.read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
    image = np.asarray(imread(path))[..., :3]
    height, width = image.shape[:2]
    assert (width, height) == tuple(round(DPI * inch) for inch in SIZE_INCH)
    figure = flight_figure(flight)
    figure.draw_without_rendering()
    for panel in figure.axes:
        box = panel.get_position()
        rows = slice(int((1 - box.y1) * height), int((1 - box.y0) * height))
        inside = image[rows, int(box.x0 * width) : int(box.x1 * width)]
        assert (inside.min(axis=2) < 0.6).mean() > 0.002  # something is drawn there


@pytest.mark.parametrize("make", [hirm_flight, pendulum_flight])
def test_the_figure_is_a_png_with_four_drawn_panels(tmp_path: Path, make: Any) -> None:
    flight = make()
    path = tmp_path / "flight.png"
    plot_flight(path, flight)
    check_png(path, flight)
    plot_flight(tmp_path / "again.png", flight)
    assert (tmp_path / "again.png").read_bytes() == path.read_bytes()


def test_angles_are_drawn_in_degrees_and_forces_as_they_are() -> None:
    hirm_panels, pendulum_panels = (flight_figure(make()).axes for make in (hirm_flight, pendulum_flight))
    assert [panel.get_ylabel() for panel in hirm_panels] == [
        "θ [deg]",
        "elevator [deg]",
        "delay [samples]",
        "one-way delay [ms]",
    ]
    assert [panel.get_ylabel() for panel in pendulum_panels[:2]] == ["angle [deg]", "u"]
    lines = {line.get_label(): line for line in hirm_panels[0].get_lines()}
    flight = hirm_flight()
    np.testing.assert_allclose(np.asarray(lines["θ"].get_ydata()), np.rad2deg(flight.x[:, 2]))
    legend = hirm_panels[2].get_legend()
    assert legend is not None
    names = [text.get_text() for text in legend.get_texts()]
    assert names == ["forecast interval", "forecast d", "true d(k)", "d_min, d_max", "beyond, to 83"]


def test_the_title_names_the_flight_and_its_error() -> None:
    flight = hirm_flight()
    (suptitle,) = [text.get_text() for text in [flight_figure(flight)._suptitle]]  # type: ignore[attr-defined]
    rms_deg = float(np.rad2deg(flight.rms_error[0]))
    assert suptitle == f"nominal · gains hirm-paper · seed 1 · rms error {rms_deg:.3g} deg"


def test_a_flight_of_one_sample_without_link_or_commands_can_be_drawn(tmp_path: Path) -> None:
    flight = FlightData.from_records([truth(0, 0, [0, 0], [0])], pendulum())
    plot_flight(tmp_path / "one.png", flight)
    assert (tmp_path / "one.png").stat().st_size > 10_000


def test_a_diverged_flight_can_be_drawn(tmp_path: Path) -> None:
    entries = [truth(k, k * 30_000_000, [10.0 ** (5 * k), -(10.0**k)], [100.0], max(0, k - 1)) for k in range(60)]
    entries += [truth(k, k * 30_000_000, [None, None], [100.0], k) for k in range(60, 70)]  # JSON has no inf
    flight = FlightData.from_records(entries, pendulum())
    assert np.isnan(flight.x[60:]).all()
    plot_flight(tmp_path / "diverged.png", flight)


def test_modes_other_than_tracking_are_shaded_in_every_panel_and_named_once() -> None:
    figure = flight_figure(hirm_flight())
    shaded = [sum(1 for patch in panel.patches if patch.get_alpha() == 0.22) for panel in figure.axes]
    assert shaded == [3, 3, 3, 3]
    legend = figure.axes[0].get_legend()
    assert legend is not None
    names = [text.get_text() for text in legend.get_texts()]
    assert sorted(names) == sorted(["θ", "reference θr", "STANDBY", "NEUTRAL", "HOLD"])
