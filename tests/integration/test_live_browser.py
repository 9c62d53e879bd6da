"""``sitl live`` beside a flight over UDP, in a real browser."""

import os
import re
import shutil
from pathlib import Path

import pytest
from playwright.sync_api import Error, Page, sync_playwright

from tests.integration.programs import eventually, program

pytestmark = pytest.mark.realtime

BROWSER = os.environ.get("CHROMIUM") or next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
SAMPLES = "(globalThis.Bokeh?.documents[0]?.get_model_by_name('samples')?.get_length() ?? 0)"
STATE = "document.getElementById('state').dataset.state"


def shown(page: Page, condition: str) -> None:
    """Wait until a condition holds on the page; its own policy forbids to evaluate text there, so it is asked."""

    def asked() -> bool:
        try:
            return bool(page.evaluate(condition))
        except Error:  # it is being loaded again
            return False

    eventually(condition, asked, 20.0)


@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed, and CHROMIUM names none")
def test_a_flight_grows_on_the_page_and_ends_there_and_the_page_talks_to_nobody_else(tmp_path: Path) -> None:
    complaints: list[str] = []
    asked: set[str] = set()
    with (
        program(tmp_path, "sitl", "live", "flights", "--listen", "127.0.0.1:0") as live,
        sync_playwright() as playwright,
    ):
        url = eventually("an address", lambda: re.search(r"http://127\.0\.0\.1:\d+/", live.stderr))[0]
        browser = playwright.chromium.launch(executable_path=BROWSER, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 390, "height": 844})
        page.on("console", lambda said: complaints.append(said.text) if said.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("request", lambda request: asked.add(request.url))
        page.on("websocket", lambda opened: asked.add(opened.url.replace("ws:", "http:")))
        page.goto(url)
        shown(page, f"{STATE} === 'waiting'")
        flight = ("sitl", "fly", "nominal", "--duration", "6", "--port-base", "0", "--gcs", "none")
        with program(tmp_path, *flight, "--out", "flights/one") as flown:
            shown(page, f"{SAMPLES} > 20")
            before = page.evaluate(SAMPLES)
            shown(page, f"{STATE} === 'live' && {SAMPLES} > {before} + 40")
            assert page.evaluate("document.documentElement.scrollWidth") <= 390
            page.get_by_role("button", name="Pause").click()
            paused = page.evaluate(SAMPLES)
            page.wait_for_timeout(700)
            assert page.evaluate(SAMPLES) == paused
            page.get_by_role("button", name="Resume").click()
            shown(page, f"{STATE} === 'ended'")
            flown.wait()
        shown(page, f"{SAMPLES} === 240")
        assert page.locator("h1").text_content() == "Live: one"
        assert page.locator("#events tr").count() > 0
        drawn = "Bokeh.documents[0].get_model_by_name('samples').data.y.every(Number.isFinite)"
        assert page.evaluate(drawn)
        assert page.locator("#figures canvas").count() > 0
        browser.close()
        assert live.end() == 0
    assert complaints == []
    assert asked == {url, f"{url}stream"}
