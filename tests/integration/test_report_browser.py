"""The report in Chromium: it draws, zooms, changes its theme, fits a phone, runs nobody's text, asks no network."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page

from sitl.flight import fly_virtual
from sitl.flightfile import FlightFile, attachments_of, load_flight
from sitl.recorder import FlightRecorder
from sitl.report.page import report
from sitl.scenario import load_scenario
from tests.integration.browser import CHROMIUM, NO_BROWSER, Heard, chromium, opened, sideways

pytestmark = [pytest.mark.realtime, pytest.mark.skipif(CHROMIUM is None, reason=NO_BROWSER)]

ATTACK = "</script><img src=x onerror=alert(1)><script>alert(2)</script>'\"`${alert(3)}"
DRAWN = """() => [...document.querySelectorAll("figure")].map(figure => {
    const all = (root) => [...root.querySelectorAll("*")].flatMap(e => e.shadowRoot ? [e, ...all(e.shadowRoot)] : [e]);
    return all(figure).filter(e => e.tagName === "CANVAS" && e.width && e.height).reduce((sum, canvas) => {
        const pixels = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
        let painted = 0;
        for (let at = 3; at < pixels.length; at += 4) painted += pixels[at] > 0;
        return sum + painted;
    }, 0);
})"""
RANGE = "() => { const r = Bokeh.documents[0].get_model_by_name('time'); return [r.start, r.end]; }"
INKS = """() => [...Bokeh.documents[0].all_models].filter(m => m.tags.includes("ink")).map(m =>
    (m.line_color && m.line_color.value) || m.fill_color.value)"""


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> list[FlightFile]:
    files = []
    for name in ("nominal", "blackout"):
        folder = tmp_path_factory.mktemp("flights") / name
        scenario = replace(load_scenario(name), duration_s=5.0)
        metadata = {"title": f"{name} {ATTACK}", "scenario": name, "reference": scenario.reference}
        files_of = attachments_of(scenario.gains_name, scenario.plant_name)
        with FlightRecorder(folder, metadata, attachments=files_of) as recorder:
            fly_virtual(scenario, recorder.write)
        files.append(load_flight(folder / "flight.mcap"))
    return files


@pytest.fixture(scope="module")
def alone(flown: list[FlightFile], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path: Path = tmp_path_factory.mktemp("alone") / "report.html"
    path.write_text(report(flown[1:]), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def both(flown: list[FlightFile], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path: Path = tmp_path_factory.mktemp("both") / "report.html"
    path.write_text(report(flown), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="module")
def wide(browser: Browser, alone: Path) -> tuple[Page, Heard]:
    return opened(browser, alone)


def test_every_figure_is_painted_and_nothing_is_asked_of_the_network(wide: tuple[Page, Heard], alone: Path) -> None:
    page, heard = wide
    painted = page.evaluate(DRAWN)
    assert len(painted) == 7
    assert min(painted) > 2000
    assert heard.complaints == []
    assert [url for url in heard.requests if not url.startswith("data:")] == [alone.as_uri()]


def test_the_text_of_a_recording_is_shown_and_never_run(wide: tuple[Page, Heard]) -> None:
    page, heard = wide
    assert page.locator("h1").inner_text() == "Blackout " + ATTACK
    assert page.locator("main img, header img").count() == 0
    assert heard.complaints == []


def place(page: Page, x: float, y: float) -> tuple[float, float]:
    """Scroll to the figure of the output and return where in the window a point of its frame is, as parts of it."""
    canvas = page.locator("figure[data-panel=tracking] .bk-Canvas").first
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    assert box is not None
    return box["x"] + x * box["width"], box["y"] + y * box["height"]


def test_the_wheel_with_ctrl_zooms_the_time_of_all_figures_and_reset_brings_it_back(wide: tuple[Page, Heard]) -> None:
    page, heard = wide
    before = page.evaluate(RANGE)
    page.mouse.move(*place(page, 0.5, 0.5))
    scrolled = page.evaluate("scrollY")
    page.mouse.wheel(0, 50)
    page.wait_for_function("was => scrollY > was", arg=scrolled)
    assert page.evaluate(RANGE) == before  # without Ctrl the page scrolls
    page.mouse.move(*place(page, 0.5, 0.5))
    page.keyboard.down("Control")
    page.mouse.wheel(0, -300)
    page.keyboard.up("Control")
    page.wait_for_function("was => Bokeh.documents[0].get_model_by_name('time').start > was", arg=before[0])
    start, end = page.evaluate(RANGE)
    assert before[0] < start < end < before[1]
    assert page.evaluate("new Set(Bokeh.documents[0].roots().map(root => root.x_range.id)).size") == 1
    page.locator("figure[data-panel=delay] .bk-tool-icon-reset").click()
    page.wait_for_function("was => Bokeh.documents[0].get_model_by_name('time').start === was", arg=before[0])
    assert page.evaluate(RANGE) == before
    assert heard.complaints == []


def test_a_drag_zooms_into_a_box(wide: tuple[Page, Heard]) -> None:
    page, heard = wide
    before = page.evaluate(RANGE)
    page.mouse.move(*place(page, 0.3, 0.4))
    page.mouse.down()
    page.mouse.move(*place(page, 0.5, 0.8), steps=4)
    page.mouse.up()
    page.wait_for_function("was => Bokeh.documents[0].get_model_by_name('time').start > was", arg=before[0])
    start, end = page.evaluate(RANGE)
    assert end - start == pytest.approx(0.2 * (before[1] - before[0]), rel=0.2)
    assert heard.complaints == []


def test_the_page_follows_the_system_theme_and_its_button_turns_it(wide: tuple[Page, Heard]) -> None:
    page, heard = wide
    page.emulate_media(color_scheme="dark")
    ground = "getComputedStyle(document.body).backgroundColor"
    assert page.evaluate(ground) == "rgb(20, 23, 27)"
    dark = page.evaluate(INKS)
    assert set(dark) == {"#e8ebef"}
    page.locator("#theme").click()
    assert page.evaluate(ground) == "rgb(255, 255, 255)"
    assert set(page.evaluate(INKS)) == {"#1a1e23"}
    assert len(dark) > 2
    assert heard.complaints == []


def test_a_phone_in_the_dark_shows_the_page_without_scrolling_sideways(browser: Browser, alone: Path) -> None:
    page, heard = opened(browser, alone, width=390, scheme="dark")
    assert sideways(page) == 0
    assert min(page.evaluate(DRAWN)) > 500
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(20, 23, 27)"
    assert set(page.evaluate(INKS)) == {"#e8ebef"}
    assert heard.complaints == []


def test_flights_side_by_side_are_drawn_over_one_another_on_a_phone_too(browser: Browser, both: Path) -> None:
    page, heard = opened(browser, both)
    assert len(page.evaluate(DRAWN)) == 5
    columns = page.locator("section table").first.locator("thead th").all_inner_texts()
    assert columns == ["nominal", "blackout"]
    page.set_viewport_size({"width": 390, "height": 800})
    page.wait_for_function("document.documentElement.scrollWidth <= innerWidth")
    assert sideways(page) == 0
    assert heard.complaints == []
