"""The report of a flight: a recording is enough for it, its numbers are the flight's, nobody's text becomes HTML."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from mcap.reader import make_reader

from autopilot.link.node import Record
from autopilot.link.record import McapRecorder, read_mcap
from gains.gainfile import content_of
from gains.store import load_gains, load_law, resolve
from gains.table import InputError
from gains.verify import verified
from sitl.commands.report import report as report_command
from sitl.flight import fly_virtual
from sitl.flightdata import FlightData, FlightEvent
from sitl.flightfile import FILES, MAX_SAMPLES, FlightFile, attachments_of, load_flight
from sitl.recorder import FlightRecorder
from sitl.report import words
from sitl.report.drawn import MAX_PACKETS, MAX_ROWS, compact, kept_packets, kept_rows, runs
from sitl.report.numbers import measure, plain_paths
from sitl.report.page import report
from sitl.report.panels import MAX_FLIGHTS, panels
from sitl.rescue import recover
from sitl.scenario import Scenario, load_scenario
from sitl.summary import summarise

ATTACK = "</script><img src=x onerror=alert(1)>'\""
SECRET = "/home/somebody/secret"


def recorded(scenario: Scenario, folder: Path, **metadata: str) -> Path:
    """Fly in virtual time and return the recording, as ``sitl fly`` writes it."""
    said = {"scenario": scenario.name, "title": scenario.title, "gains": scenario.gains.name, "plant": "hirm"}
    files = attachments_of(scenario.gains_name, scenario.plant_name)
    with FlightRecorder(folder, {**said, "reference": scenario.reference, **metadata}, attachments=files) as recorder:
        fly_virtual(scenario, recorder.write)
    return folder / "flight.mcap"


@pytest.fixture(scope="module")
def scenarios() -> dict[str, Scenario]:
    wide, silent = load_scenario("conservative"), load_scenario("blackout")
    return {"wide": replace(wide, duration_s=4.0), "silent": replace(silent, duration_s=5.0, variants={})}


@pytest.fixture(scope="module")
def recordings(scenarios: dict[str, Scenario], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("flights")
    return {name: recorded(scenario, folder / name) for name, scenario in scenarios.items()}


@pytest.fixture(scope="module")
def files(recordings: dict[str, Path]) -> dict[str, FlightFile]:
    return {name: load_flight(path) for name, path in recordings.items()}


def rewritten(source: Path, target: Path, change: Callable[[str, dict[str, Any]], None], **metadata: str) -> Path:
    """Copy a recording with its attachments, other metadata, and each body changed."""
    with source.open("rb") as file:
        texts = {attachment.name: attachment.data for attachment in make_reader(file).iter_attachments()}
    with McapRecorder(target, {"gains": "hirm-paper", "plant": "hirm", **metadata}, texts) as recorder:
        for topic, at_ns, body in read_mcap(source):
            change(topic, body)
            recorder.write(Record(topic, at_ns, body), at_ns)
    return target


def nothing(_topic: str, _body: dict[str, Any]) -> None:
    """Change nothing."""


# -- a recording is enough


def test_a_recording_holds_what_it_was_flown_with_and_proves_it_when_the_files_are_gone(tmp_path: Path) -> None:
    folder = tmp_path / "files"
    folder.mkdir()
    for name in ("hirm", "hirm-d4", "hirm-d6"):
        text = (
            resolve(name).read_text(encoding="utf-8").replace('conservative = "hirm-d6"', 'conservative = "wide.toml"')
        )
        (folder / {"hirm": "plane", "hirm-d4": "mine", "hirm-d6": "wide"}[name]).with_suffix(".toml").write_text(
            text.replace('model = "hirm"', 'model = "plane.toml"'), encoding="utf-8"
        )
    mine = str(folder / "mine.toml")
    law = load_law(mine)
    scenario = replace(load_scenario("nominal", gains=mine, plant=str(folder / "plane.toml")), duration_s=1.0)
    path = recorded(scenario, tmp_path / "flown")
    shutil.rmtree(folder)
    file = load_flight(path)
    assert file.complete
    assert (file.name, file.law.name, file.law.conservative and file.law.conservative.name) == (
        "flown",
        "hirm-d4",
        "hirm-d6",
    )
    assert content_of(file.law, "", "") == content_of(law, "", "")
    assert verified(file.law).passed
    assert file.law.conservative is not None
    assert verified(file.law.conservative).passed
    assert np.array_equal(file.flight.model.A, law.model.A)


def test_the_model_of_the_gains_is_kept_beside_that_of_the_plant_where_they_differ(tmp_path: Path) -> None:
    texts = attachments_of("hirm-paper", "hirm-printed")
    assert list(texts) == ["model.toml", "gains.toml", "gains-model.toml"]
    assert list(attachments_of("hirm-d3", "hirm")) == ["model.toml", "gains.toml", "conservative.toml"]
    scenario = replace(load_scenario("nominal", plant="hirm-printed"), duration_s=0.5)
    file = load_flight(recorded(scenario, tmp_path))
    assert (file.flight.model.name, file.law.model.name) == ("hirm-printed", "hirm")


def test_attachments_are_at_the_start_at_time_zero_and_the_standard_reader_finds_them(
    recordings: dict[str, Path],
) -> None:
    with recordings["wide"].open("rb") as file:
        found = {a.name: (a.create_time, a.log_time, a.data) for a in make_reader(file).iter_attachments()}
    assert found == {name: (0, 0, text) for name, text in attachments_of("hirm-d3", "hirm").items()}
    assert recordings["wide"].read_bytes().index(found["gains.toml"][2]) < 20_000


def test_a_recording_that_was_cut_off_is_refused_with_the_way_out_and_keeps_its_files(
    recordings: dict[str, Path], tmp_path: Path
) -> None:
    cut, whole = tmp_path / "cut.mcap", tmp_path / "whole.mcap"
    content = recordings["wide"].read_bytes()
    cut.write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match=r"cut off or damaged; sitl recover .*cut\.mcap"):
        load_flight(cut)
    recover(cut, whole)
    file = load_flight(whole)
    assert file.complete
    assert verified(file.law).passed
    assert 20 < len(file.flight.time_s) < 160


def test_an_older_recording_is_read_with_the_stored_gains_of_its_name_and_the_page_says_so(
    recordings: dict[str, Path], tmp_path: Path
) -> None:
    older = tmp_path / "older.mcap"
    with McapRecorder(older, {"gains": "hirm-d3", "plant": "hirm"}) as recorder:
        for topic, at_ns, body in read_mcap(recordings["wide"]):
            recorder.write(Record(topic, at_ns, body), at_ns)
    file = load_flight(older)
    assert not file.complete
    assert verified(file.law).passed
    assert "older holds no model and gains of its own" in report([file])


@pytest.mark.parametrize("gains", ["", "nobodys", "../../gains/stored/hirm-d3.toml", f"{SECRET}/x.toml"])
def test_an_older_recording_of_gains_that_are_not_stored_is_refused_in_one_line(
    recordings: dict[str, Path], tmp_path: Path, gains: str
) -> None:
    older = tmp_path / "older.mcap"
    with McapRecorder(older, {"gains": gains, "plant": "hirm"}) as recorder:
        for topic, at_ns, body in read_mcap(recordings["silent"]):
            recorder.write(Record(topic, at_ns, body), at_ns)
    with pytest.raises(InputError, match="expected a recording that holds its model and gains") as refused:
        load_flight(older)
    assert SECRET not in str(refused.value)


def test_attached_gains_that_were_changed_are_refused(recordings: dict[str, Path], tmp_path: Path) -> None:
    path = tmp_path / "changed.mcap"
    texts = attachments_of("hirm-d3", "hirm")
    texts["gains.toml"] = texts["gains.toml"].replace(b"eta = 0.07", b"eta = 0.01")
    with McapRecorder(path, {}, texts) as recorder:
        for topic, at_ns, body in read_mcap(recordings["wide"]):
            recorder.write(Record(topic, at_ns, body), at_ns)
    with pytest.raises(InputError, match=r"attached gains\.toml: certificate\.sha256"):
        load_flight(path)


def drop(key: str) -> Callable[[str, dict[str, Any]], None]:
    return lambda topic, body: body.pop(key, None) if topic != "events" else None


def put(topic: str, key: str, value: object) -> Callable[[str, dict[str, Any]], None]:
    return lambda of, body: body.update({key: value}) if of == topic else None


@pytest.mark.parametrize(
    "change",
    [
        drop("x"), drop("d_low"), drop("sent_ns"), put("plant/truth", "k", MAX_SAMPLES), put("plant/truth", "k", "1"),
        put("plant/truth", "x", [1.0]), put("plant/truth", "j", [1]), put("autopilot/command", "d_high", 1e12),
        put("autopilot/command", "mode", "<b>"), put("link/up", "fate", 3), put("link/down", "sent_ns", 1 << 63),
        put("events", "text", None), put("events", "data", {}), put("plant/truth", "air", {"altitude_m": "high"}),
    ],
)  # fmt: skip
def test_a_recording_with_malformed_records_is_refused_and_nothing_else_is_raised(
    recordings: dict[str, Path], tmp_path: Path, change: Callable[[str, dict[str, Any]], None]
) -> None:
    path = rewritten(recordings["silent"], tmp_path / "malformed.mcap", change)
    with pytest.raises(InputError, match=r"malformed\.mcap: .*expected"):
        load_flight(path)


def test_what_is_no_recording_of_a_flight_is_refused(tmp_path: Path) -> None:
    text, empty, idle = (tmp_path / name for name in ("text.mcap", "empty.mcap", "idle.mcap"))
    text.write_text("no recording", encoding="utf-8")
    empty.touch()
    with McapRecorder(idle, {}, attachments_of("hirm-d3", "hirm")):
        pass
    for path, complaint in (
        (text, "expected a recording"), (empty, "expected a recording"), (idle, "expected samples of a plant"),
        (tmp_path / "none.mcap", "No such file"), (tmp_path, "Is a directory"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=complaint):
            load_flight(path)


def test_a_chunk_with_a_wrong_checksum_is_refused_with_the_way_out(recordings: dict[str, Path], tmp_path: Path) -> None:
    content = bytearray(recordings["silent"].read_bytes())
    content[len(content) // 2] ^= 1
    path = tmp_path / "flipped.mcap"
    path.write_bytes(content)
    with pytest.raises(InputError, match="sitl recover"):
        load_flight(path)


# -- numbers


@pytest.mark.parametrize("name", ["wide", "silent"])
def test_the_numbers_are_those_of_the_summary_of_the_flight(
    files: dict[str, FlightFile], scenarios: dict[str, Scenario], name: str
) -> None:
    file, scenario = files[name], scenarios[name]
    summary = summarise(scenario, file.records, file.flight, virtual=True)
    numbers = measure(file)
    assert numbers.rms_error == pytest.approx(np.degrees(summary["rms_error_rad"]))
    assert numbers.max_error == pytest.approx(np.degrees(summary["max_error_rad"]))
    assert numbers.final_error == pytest.approx(np.degrees(summary["final_error_rad"]))
    assert numbers.delay == {key: summary["delay"][key] for key in numbers.delay}
    assert numbers.outside == summary["delay"]["outside_fraction"]
    assert {way: dict(link.counts) for way, link in numbers.links.items()} == summary["link"]
    assert numbers.failsafe_events == summary["failsafe_events"]
    assert numbers.mode_at_end == summary["mode_at_end"]
    assert numbers.law_s == pytest.approx(sum(summary["mode_s"][m] for m in ("TRACKING", "LEVEL", "CONSERVATIVE")))
    assert numbers.seconds == pytest.approx(summary["duration_s"])


def test_the_quantiles_of_the_link_are_those_of_its_packets(files: dict[str, FlightFile]) -> None:
    file = files["wide"]
    took = [
        1e-6 * (body["delivered_ns"] - body["sent_ns"])
        for topic, _, body in file.records
        if topic == "link/down" and body["delivered_ns"] is not None
    ]
    link = measure(file).links["down"]
    assert link.delays_ms == pytest.approx(np.quantile(took, [0.05, 0.5, 0.95, 0.99, 1.0]))
    assert sum(link.fates.values()) == link.counts["lost"] > 0


def test_the_story_tells_a_proved_window_from_one_that_is_only_claimed(files: dict[str, FlightFile]) -> None:
    wide, silent = (words.story(files[name], measure(files[name])) for name in ("wide", "silent"))
    assert [card.mood for card in wide] == ["fair", "fair", "fair"]
    assert wide[2].answer.startswith("Not for ")
    assert "was verified for this page" in wide[2].sentence
    assert silent[2].answer == "Nothing is proved"
    assert "there is no certificate" in silent[2].sentence
    inside = replace(files["wide"], law=load_gains("hirm-d6"))
    other = replace(inside, flight=replace(inside.flight, metadata={**inside.metadata, "plant": "jsbsim:c172x"}))
    assert "speaks of" not in words.story(inside, measure(inside))[2].sentence
    assert "the linear model hirm near trim; jsbsim:c172x flew" in words.story(other, measure(other))[2].sentence
    assert words.story(inside, measure(inside))[2].answer == "Yes, all the time"


def test_a_flight_that_diverges_is_said_to_and_is_framed_where_its_reference_is(files: dict[str, FlightFile]) -> None:
    flight = files["wide"].flight
    away = np.exp(np.linspace(0.0, 90.0, len(flight.time_s)))[:, None]  # to 1e39, beyond single precision
    lost = replace(flight, output=flight.output + away, error=flight.error + away)
    assert words.verdict(measure(replace(files["wide"], flight=lost))) == ("Did not track to the end", "bad")
    fallen = FlightEvent(3.9, "diverged", "state beyond all bounds")
    file = replace(files["wide"], flight=replace(lost, events=(*flight.events, fallen)))
    assert words.verdict(measure(file)) == ("Diverged", "bad")
    plot = next(panel.figure for panel in panels([file], ["x"]) if panel.name == "tracking")
    assert plot.y_range.end < 100.0
    assert np.isfinite(source(file, "samples-0")["y0"]).all()
    assert "No: it diverged" in report([file])


# -- figures


def source(file: FlightFile, name: str) -> Mapping[str, Any]:
    """Return the data of a named source of a flight's figures."""
    for panel in panels([file], ["x"]):
        for renderer in panel.figure.renderers:
            if getattr(renderer, "data_source", None) is not None and renderer.data_source.name == name:
                return dict(renderer.data_source.data)
    raise AssertionError(name)


def test_the_figures_show_the_samples_of_the_recording_in_degrees(files: dict[str, FlightFile]) -> None:
    flight, data = files["wide"].flight, source(files["wide"], "samples-0")
    assert data["k"].tolist() == flight.k.tolist()
    assert np.allclose(data["y0"], np.degrees(flight.output[:, 0]), rtol=1e-6, atol=1e-9)
    assert np.allclose(data["e0"], np.degrees(flight.error[:, 0]), rtol=1e-6, atol=1e-9)
    assert np.allclose(data["u0"], np.degrees(flight.u[:, 0]), rtol=1e-6, atol=1e-9)
    assert np.array_equal(data["d"], flight.d.astype(np.float32), equal_nan=True)
    assert data["y0"].dtype == np.float32


def test_every_forecast_lies_in_the_box_of_its_interval_and_every_loss_has_its_mark(
    files: dict[str, FlightFile],
) -> None:
    flight = files["wide"].flight
    dots, boxes = source(files["wide"], "forecasts-0"), source(files["wide"], "intervals-0")
    assert dots["j"].tolist() == [j for j, d in zip(flight.command_j, flight.forecast, strict=True) if not np.isnan(d)]
    for t, low, high in zip(dots["t"], dots["low"], dots["high"], strict=True):
        around = (boxes["left"] <= t) & (t <= boxes["right"]) & (boxes["d_low"] == low) & (boxes["d_high"] == high)
        assert around.any() or (dots["t"] == t).sum() > 1  # the later of two commands for one sample
    lost = source(files["wide"], "lost-up")
    assert np.allclose(lost["t"][::3], flight.links["up"].entered_s[np.isnan(flight.links["up"].delay_s)], atol=1e-5)


def test_samples_that_are_missing_leave_a_gap(recordings: dict[str, Path], tmp_path: Path) -> None:
    entries = [e for e in read_mcap(recordings["silent"]) if e[0] != "plant/truth" or not 40 <= e[2]["k"] < 60]
    model = load_gains("hirm-paper").model
    file = replace(load_flight(recordings["silent"]), flight=FlightData.from_records(entries, model, {}))
    data = source(file, "samples-0")
    (gap,) = np.flatnonzero(np.isnan(data["y0"]))
    assert data["k"][gap - 1 : gap + 2].tolist() == [39, 40, 60]
    assert data["t"][gap] == pytest.approx(1.0)


def test_what_else_an_aircraft_tells_has_figures_of_its_own(recordings: dict[str, Path], tmp_path: Path) -> None:
    def climb(topic: str, body: dict[str, Any]) -> None:
        if topic == "plant/truth":
            body["air"] = {"altitude_m": 100.0 + body["k"], "roll_rad": 0.1, "<b>": 1.0}

    file = load_flight(rewritten(recordings["silent"], tmp_path / "air.mcap", climb))
    assert list(file.air) == ["altitude_m", "roll_rad"]
    data = source(file, "samples-0")
    assert np.array_equal(data["air_altitude_m"], 100.0 + file.flight.k)
    assert np.allclose(data["air_roll_rad"], np.degrees(0.1))
    names = [panel.name for panel in panels([file], ["x"])]
    assert names[-2:] == ["air-altitude_m", "air-roll_rad"]


def test_thinning_keeps_every_extreme_and_the_first_and_last_row() -> None:
    rng = np.random.default_rng(5)
    columns = [rng.normal(size=100_000), rng.normal(size=100_000)]
    columns[0][rng.choice(100_000, 30_000)] = np.nan
    spikes = rng.choice(100_000, 40, replace=False)
    columns[1][spikes] = 50.0 * np.where(np.arange(40) % 2, 1.0, -1.0)
    rows = kept_rows(columns)
    assert len(rows) <= MAX_ROWS + 1
    assert np.all(np.diff(rows) > 0)
    assert {0, 99_999, int(np.nanargmax(columns[0])), int(np.nanargmin(columns[0]))} <= set(rows.tolist())
    alone = [s for s in spikes if np.abs(spikes - s)[spikes != s].min() > 100]
    assert len(alone) > 20
    assert set(alone) <= set(rows.tolist())
    assert kept_rows([columns[0][:MAX_ROWS]]).tolist() == list(range(MAX_ROWS))


def test_thinned_packets_keep_the_fastest_and_slowest_of_every_stretch() -> None:
    delay = np.random.default_rng(6).gamma(2.0, size=50_000)
    kept = kept_packets(delay)
    assert MAX_PACKETS // 2 < len(kept) <= MAX_PACKETS + 2
    drawn = delay[kept]
    for start in range(0, 50_000, 1000):
        inside = (kept >= start) & (kept < start + 1000)
        assert drawn[inside].max() == delay[start : start + 1000].max()
        assert drawn[inside].min() == delay[start : start + 1000].min()


def test_numbers_too_large_for_single_precision_stay_double() -> None:
    assert compact(np.array([1.0, np.nan, 2.0])).dtype == np.float32
    assert compact(np.array([1.0, np.inf, 1e38])).dtype == np.float64
    assert [tuple(run) for run in runs(np.array([True, False, True, True]))] == [(0, 0), (2, 3)]


# -- the page


class Loads(HTMLParser):
    """What a page would load, its elements, and its ids."""

    def __init__(self) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.tags: list[str] = []
        self.ids: list[str] = []
        self.lang = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        said = dict(attrs)
        self.tags.append(tag)
        self.loads += [said[key] or "" for key in ("src", "href", "data", "action", "srcset") if key in said]
        self.ids += [said["id"] or ""] if "id" in said else []
        self.lang = said.get("lang") or self.lang if tag == "html" else self.lang


def parsed(page: str) -> Loads:
    loads = Loads()
    loads.feed(page)
    return loads


def test_the_page_loads_nothing_and_is_one_document_with_headings(files: dict[str, FlightFile]) -> None:
    page = report([files["wide"]])
    found = parsed(page)
    assert found.loads == ["data:,"]
    assert "default-src 'none'" in page
    style = page[page.index("<style>") : page.index("</style>")]
    assert "url(" not in style
    assert "@import" not in style
    assert (found.lang, found.tags.count("h1"), found.tags.count("main")) == ("en", 1, 1)
    assert found.tags.count("figure") == 7
    assert found.tags.count("table") == found.tags.count("caption") >= 4
    assert len(set(found.ids)) == len(found.ids)


def test_text_of_a_recording_becomes_no_element_and_no_path_of_its_machine_is_told(
    recordings: dict[str, Path], tmp_path: Path
) -> None:
    def told(topic: str, body: dict[str, Any]) -> None:
        if topic == "events" and body["kind"] != "failsafe":
            body["text"] = f"{ATTACK} {SECRET}/gains.toml"

    said = dict.fromkeys(("title", "scenario", "reference", "up", "down", "rules", "changes", "seed", "time"), ATTACK)
    said |= {"witness": f"{SECRET}/w.csv", "wind": f"file:{SECRET}/wind.csv"}
    path = rewritten(recordings["silent"], tmp_path / "hostile.mcap", told, **said)
    file = load_flight(path)
    for page in (report([file]), report([file, file])):
        found = parsed(page)
        assert "img" not in found.tags
        assert found.loads == ["data:,"]
        assert "<img src=x" not in page
        assert "secret" not in page
        assert "&lt;/script&gt;&lt;img src=x onerror=alert(1)&gt;" in page


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("file:/home/me/a b/c.csv", "file:a b/c.csv"), ("trace=../x/y.csv,loss=0.1", "trace=y.csv,loss=0.1"),
        ("~/x/y.toml", "y.toml"), ("rate 5 deg/s", "rate 5 deg/s"), ("'/tmp/q'", "'q'"), ("a/b.toml", "a/b.toml"),
    ],
)  # fmt: skip
def test_paths_become_file_names(text: str, shown: str) -> None:
    assert plain_paths(text) == shown


def test_flights_side_by_side_have_a_column_each_and_one_reference_where_it_is_the_same(
    files: dict[str, FlightFile],
) -> None:
    pair = [files["silent"], replace(files["silent"], name="again")]
    page = report(pair)
    assert re.findall(r'<thead><tr><td></td><th scope="col">(.*?)</th><th scope="col">(.*?)</th>', page)[0] == (
        "silent",
        "again",
    )
    tracking = next(panel.figure for panel in panels(pair, ["silent", "again"]) if panel.name == "tracking")
    assert [item.label.value for item in tracking.legend[0].items] == ["reference θr", "silent", "again"]
    with pytest.raises(InputError, match="at most"):
        report([files["silent"]] * (MAX_FLIGHTS + 1))


def test_ten_minutes_make_a_page_below_five_megabytes_that_says_what_was_thinned(files: dict[str, FlightFile]) -> None:
    file, times = files["wide"], 150
    flight = file.flight
    count, Ts = len(flight.time_s), flight.model.Ts
    place = np.arange(times * count)
    shift = np.repeat(np.arange(times) * count, len(flight.command_s))
    ways = {
        way: type(packets)(
            np.concatenate([packets.entered_s + n * count * Ts for n in range(times)]), np.tile(packets.delay_s, times)
        )
        for way, packets in flight.links.items()
    }
    rows = {
        name: np.tile(getattr(flight, name), (times, 1)) for name in ("x", "u", "w", "output", "reference", "error")
    }
    flat = {name: np.tile(getattr(flight, name), times) for name in ("j", "d", "late_ns", "engaged", "forecast")}
    flat |= {name: np.tile(getattr(flight, name), times) for name in ("forecast_low", "forecast_high", "saturated")}
    long = replace(
        flight, **rows, **flat, time_s=place * Ts, k=place, start=0 * place, links=ways,
        command_s=np.tile(flight.command_s, times) + shift * Ts, command_j=np.tile(flight.command_j, times) + shift,
        command_sample=np.tile(flight.command_sample, times) + shift,
    )  # fmt: skip
    page = report([replace(file, flight=long, records=[])])
    assert len(long.time_s) == 24_000
    assert len(page.encode()) < 5_000_000
    assert "of 24,000 samples are drawn" in page
    assert "packets are drawn" in page


# -- the command


def test_the_command_writes_the_page_and_tells_what_it_did(recordings: dict[str, Path], tmp_path: Path) -> None:
    out = tmp_path / "report.html"
    arguments = [str(recordings["wide"]), str(recordings["silent"]), "-o", str(out), "--json"]
    done = CliRunner().invoke(report_command, arguments, catch_exceptions=False)
    assert done.exit_code == 0
    told = json.loads(done.stdout)
    assert told["bytes"] == out.stat().st_size
    assert [flight["name"] for flight in told["flights"]] == ["wide", "silent"]


def test_the_command_writes_nothing_over_the_recording_and_nothing_for_a_bad_one(
    recordings: dict[str, Path], tmp_path: Path
) -> None:
    before = recordings["wide"].read_bytes()
    same = CliRunner().invoke(report_command, [str(recordings["wide"]), "-o", str(recordings["wide"])])
    assert isinstance(same.exception, InputError)
    assert recordings["wide"].read_bytes() == before
    out = tmp_path / "report.html"
    bad = CliRunner().invoke(report_command, [str(tmp_path / "none.mcap"), "-o", str(out)])
    assert isinstance(bad.exception, InputError)
    assert not out.exists()


def test_the_names_of_the_attachments_are_what_other_tools_look_for() -> None:
    assert FILES[:2] == ("model.toml", "gains.toml")
    assert "conservative.toml" in FILES
