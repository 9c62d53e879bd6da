"""The teaching page in Chromium: it draws, answers mouse and keyboard, fits a phone, and asks the network for nothing.

A page takes a second to open, so what needs no other window shares one.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, sync_playwright

from gains.model import Gains, Model, Trim
from gains.store import load_gains
from sitl.teach.lesson import SAMPLES, Lesson, lesson
from sitl.teach.page import page

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")

pytestmark = [
    pytest.mark.realtime,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this system"),
]

CURVES = "[...Bokeh.documents[0].get_model_by_name('curves').data['{}']]"


@pytest.fixture(scope="module")
def lessons() -> list[Lesson]:
    """Two systems, one with a reference and one without, at the delays where they turn."""
    return [lesson(load_gains("hirm-paper"), range(4, 6)), lesson(integrator(), range(1, 4))]


@pytest.fixture(scope="module")
def url(lessons: list[Lesson], tmp_path_factory: pytest.TempPathFactory) -> str:
    path: Path = tmp_path_factory.mktemp("teach") / "teach.html"
    path.write_text(page(lessons), encoding="utf-8")
    return path.as_uri()


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield chromium
        chromium.close()


@dataclass
class Heard:
    """What pages complained about, and what they asked for."""

    complaints: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)


@pytest.fixture(scope="module")
def heard() -> Heard:
    return Heard()


@pytest.fixture(scope="module")
def tab(browser: Browser, url: str, heard: Heard) -> Page:
    """The window that the tests share."""
    return opened(browser, url, heard, 1280)


@pytest.fixture(autouse=True)
def _silent(heard: Heard, url: str) -> Iterator[None]:
    yield
    assert heard.complaints == []
    assert {request.partition("#")[0] for request in heard.requests if not request.startswith("data:")} == {url}


def opened(browser: Browser, url: str, heard: Heard, width: int) -> Page:
    shown = browser.new_context(viewport={"width": width, "height": 800}, color_scheme="light").new_page()
    shown.on("console", lambda said: heard.complaints.append(said.text) if said.type in ("error", "warning") else None)
    shown.on("pageerror", lambda error: heard.complaints.append(str(error)))
    shown.on("request", lambda request: heard.requests.append(request.url))
    shown.goto(url)
    shown.wait_for_selector("body[data-ready]", timeout=20_000)
    return shown


def show(tab: Page, address: str) -> None:
    """Go to a case as a link to it does, and wait until the page has answered."""
    script = """address => new Promise((done) => {
        if (location.hash === address) return done();
        addEventListener("hashchange", () => done(), { once: true });
        location.hash = address;
    })"""
    tab.evaluate(script, f"#{address}")


def headline(tab: Page) -> str:
    return tab.locator("#headline").inner_text()


def curve(tab: Page, name: str) -> np.ndarray:
    return np.array([np.nan if value is None else value for value in tab.evaluate(CURVES.format(name))], dtype=float)


def test_moving_the_slider_changes_verdict_and_curves_to_those_that_python_computed(
    tab: Page, lessons: list[Lesson]
) -> None:
    assert headline(tab) == "Stable: proved"
    tab.locator("#delay").fill("5")
    assert headline(tab) == "Unstable: a delay sequence breaks it"
    assert tab.locator("#position").inner_text() == "5 samples, 125 ms"
    case = lessons[0].cases["worst", 5]
    assert curve(tab, "d").tolist() == case.delays.tolist()
    assert np.allclose(curve(tab, "y"), np.degrees(case.y), atol=1e-5)
    assert np.allclose(curve(tab, "yr"), np.degrees(lessons[0].yr), atol=1e-6)
    assert np.allclose(curve(tab, "t"), np.arange(SAMPLES) * 0.025)
    assert tab.url.endswith("#hirm-paper/worst/5")
    tab.locator("input[value=constant]").check(force=True)
    assert headline(tab) == "Stable: proved"
    assert np.allclose(curve(tab, "y"), np.degrees(lessons[0].cases["constant", 5].y), atol=1e-5)


def test_the_keyboard_alone_leads_through_the_lesson(tab: Page) -> None:
    show(tab, "hirm-paper/worst/4")
    tab.locator("#system").focus()
    tab.keyboard.press("Tab")
    tab.keyboard.press("ArrowLeft")
    assert tab.locator("#about").inner_text().startswith("Delays drawn at random in 1…4")
    tab.keyboard.press("Tab")
    assert tab.evaluate("document.activeElement.id") == "delay"
    tab.keyboard.press("ArrowRight")
    assert headline(tab) == "Looks calm, and is refuted"
    assert tab.locator("#delay").get_attribute("aria-valuetext") == "5 samples, 125 ms"
    assert tab.locator("#verdict").get_attribute("aria-live") == "polite"


def test_another_system_brings_its_own_slider_and_the_table_leads_to_its_cases(tab: Page) -> None:
    show(tab, "hirm-paper/worst/4")
    assert tab.locator(".withref").is_visible()
    tab.locator("#system").select_option("1")
    slider = tab.locator("#delay")
    assert [slider.get_attribute(end) for end in ("min", "max")] == ["1", "3"]
    assert tab.locator("#position").inner_text() == "3 samples, 300 ms"  # 4 is beyond its end
    assert not tab.locator(".withref").is_visible()
    tab.locator('#cells button[data-pattern="constant"][data-d="3"]').click()
    assert headline(tab) == "Unstable: this constant delay breaks it"
    assert tab.locator("#cells button[aria-pressed=true]").count() == 1
    assert np.isnan(curve(tab, "yr")).all()


def test_an_address_shows_its_case_and_a_wrong_one_changes_nothing(tab: Page) -> None:
    show(tab, "hirm-paper/random/5")
    assert headline(tab) == "Looks calm, and is refuted"
    show(tab, "hirm-paper/constant/5")
    assert headline(tab) == "Stable: proved"
    show(tab, "nothing/worst/99")
    assert headline(tab) == "Stable: proved"
    assert tab.url.endswith("#hirm-paper/constant/5")


def test_the_first_seconds_can_be_seen_alone(tab: Page) -> None:
    end = "Bokeh.documents[0].get_model_by_name('response').x_range.end"
    whole = tab.evaluate(end)
    tab.locator("#early").check()
    assert tab.evaluate(end) == 6
    tab.locator("#early").uncheck()
    assert tab.evaluate(end) == whole > 6


def test_a_phone_needs_no_sideways_scrolling_and_sees_the_verdict_first(
    browser: Browser, url: str, heard: Heard
) -> None:
    phone = opened(browser, url, heard, 390)
    show(phone, "hirm-paper/worst/5")
    assert phone.evaluate("document.documentElement.scrollWidth") == 390
    top = "document.querySelector('{}').getBoundingClientRect().top"
    assert phone.evaluate(top.format("#verdict")) < phone.evaluate(top.format(".pictures"))
    for name in ("response", "command", "delay", "left"):
        assert 200 < phone.evaluate(f"Bokeh.documents[0].get_model_by_name('{name}').inner_width") < 390


def test_dark_and_light_paint_text_that_can_be_read(tab: Page) -> None:
    label = "Bokeh.documents[0].get_model_by_name('response').left[0].axis_label_text_color"
    ground = "getComputedStyle(document.querySelector('.pictures')).backgroundColor"
    light = [tab.evaluate(label), tab.evaluate(ground)]
    tab.emulate_media(color_scheme="dark")
    tab.wait_for_function(f"{label} !== '{light[0]}'")
    dark = [tab.evaluate(label), tab.evaluate(ground)]
    for text, behind in (dark, light):
        assert contrast(rgb(text), rgb(behind)) > 7.0
    assert luminance(rgb(dark[1])) < luminance(rgb(light[1]))


def integrator() -> Gains:
    """x(k+1) = x(k) + u(k) with u(k) = -0.6 x(k - d): held constant, 1 and 2 are stable, 3 is not."""
    one = np.eye(1)
    model = Model("one", 0.1, one, one, np.zeros((1, 0)), one, 0.0 * one, ("x",), Trim(np.zeros(1), np.zeros(1)))
    return Gains("integrator", model, 1, 2, -0.6 * one)


def rgb(text: str) -> list[int]:
    """Return the parts of #rrggbb or of rgb(r, g, b)."""
    if text.startswith("#"):
        return [int(text[i : i + 2], 16) for i in (1, 3, 5)]
    return [int(part) for part in text.removeprefix("rgb(").removesuffix(")").split(",")]


def luminance(colour: list[int]) -> float:
    """Return the relative luminance of WCAG 2."""
    linear = [v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in (part / 255 for part in colour)]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(one: list[int], other: list[int]) -> float:
    """Return the contrast ratio of WCAG 2."""
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)
