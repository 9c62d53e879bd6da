"""The teaching page without a browser: its curves against flights over MAVLink, its facts against the paper's."""

from __future__ import annotations

import base64
import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from gains.exact import eta
from gains.lower_gain import periodic_gain
from gains.lyapunov import constant_radius
from gains.model import Gains, Model, Trim
from gains.store import load_gains
from gains.switched import eq9
from gains.table import InputError
from gains.witness import confirm
from sitl.commands.teach import teach
from sitl.flight import fly_virtual
from sitl.link.presets import parse_link
from sitl.recorder import FlightRecorder
from sitl.scenario import Scenario, load_scenario
from sitl.teach.facts import Fact, nested, stored_eta
from sitl.teach.lesson import RUNS, SAMPLES, Lesson, lesson, positions, random_delays
from sitl.teach.page import page
from sitl.teach.recursion import fly, size
from sitl.teach.words import runs_of, standing, takeaway, verdict
from tests.integration.recursion import tables

HIRM, PENDULUM = load_gains("hirm-paper"), load_gains("pendulum-paper")


@pytest.fixture(scope="module")
def hirm() -> Lesson:
    """The published gains (54) at the edge: [1, 4] is proved, [1, 5] is refuted."""
    return lesson(HIRM, range(4, 6))


@pytest.fixture(scope="module")
def pendulum() -> Lesson:
    """The published gains (47) at the edge: [1, 6] is proved, [1, 7] is refuted."""
    return lesson(PENDULUM, range(6, 8))


def first_order(name: str = "slow", K1: float = -0.6) -> Gains:
    """x(k+1) = x(k) + u(k): under a constant delay of 1, 2, … stable for −K1 < 1, 0.618, 0.445, …; neither v nor e."""
    one = np.eye(1)
    model = Model("one", 0.1, one, one, np.zeros((1, 0)), one, 0.0 * one, ("x",), Trim(np.zeros(1), np.zeros(1)))
    return Gains(name, model, 1, 2, K1 * one)


# -- the recursion


def flown(scenario: Scenario) -> tuple[np.ndarray, np.ndarray]:
    """Return x(k) of a flight over MAVLink in virtual time, and the d(k) that the plant lived."""
    recorder = FlightRecorder(None, {})
    fly_virtual(scenario, recorder.write)
    truth, _ = tables(recorder.kept)
    delays = [k + 1 if body["d"] is None else body["d"] for k, body in enumerate(truth)]  # None: no command yet
    return np.array([body["x"] for body in truth]), np.array([delays])


def test_a_flight_over_mavlink_under_a_witness_is_the_recursion_on_the_same_delays() -> None:
    scenario = replace(load_scenario("witness-pendulum"), duration_s=300 * PENDULUM.model.Ts)
    x, delays = flown(scenario)
    assert set(delays[0].tolist()) == {1, 2, 3, 4, 5, 6, 7}
    assert np.abs(fly(PENDULUM, delays, np.array(scenario.x0)).x[0] - x).max() < 1e-7
    assert np.abs(x).max() > 1e-3


def test_a_flight_over_mavlink_of_a_step_is_the_recursion_on_the_same_delays() -> None:
    up, down = parse_link(None, "delay=30ms", "delay=30ms")
    samples, Ts = 300, HIRM.model.Ts
    scenario = replace(load_scenario("nominal"), up=up, down=down, actuator="float", duration_s=samples * Ts)
    x, delays = flown(scenario)
    r = np.zeros((samples, 1))
    r[round(1.0 / Ts) :] = math.radians(5.0)
    run = fly(HIRM, delays, np.zeros(3), r)
    assert delays[0, -1] == 3
    assert np.abs(run.x[0] - x).max() < 1e-6
    assert run.yr is not None
    assert run.y[0, -1, 0] == pytest.approx(run.yr[-1, 0], abs=1e-3)


def test_until_a_command_has_come_the_actuator_is_neutral() -> None:
    run = fly(first_order(), np.array([[3, 3, 3, 3, 3]]), np.ones(1))
    assert run.u[0, :, 0].tolist() == [0.0, 0.0, 0.0, -0.6, -0.6]


def test_runs_of_one_batch_do_not_touch_one_another() -> None:
    delays = random_delays(1, 5, 3, "any")[:, :80]
    together = fly(HIRM, delays, np.array([0.0, 0.1, 0.0])).x
    for i in range(3):
        alone = fly(HIRM, delays[i : i + 1], np.array([0.0, 0.1, 0.0])).x[0]
        assert np.allclose(alone, together[i], rtol=0.0, atol=1e-13)


def test_what_is_left_changes_by_the_spectral_radius_of_a_constant_delay() -> None:
    d = 7
    x = fly(PENDULUM, np.full((1, 1200), d), np.array([0.1, 0.0])).x
    left = size(x, np.ones(2), d)[0]
    assert left.shape == (1200 - d,)
    slope = np.polyfit(np.arange(600, 1100), np.log(left[600:1100]), 1)[0]
    assert math.exp(slope) == pytest.approx(constant_radius(PENDULUM, d), abs=2e-4)


@pytest.mark.parametrize("transitions", ["any", "fifo"])
def test_random_delays_fill_the_window_and_keep_to_the_transitions(transitions: str) -> None:
    delays = random_delays(2, 6, 4, transitions)  # type: ignore[arg-type]
    assert set(delays.ravel().tolist()) == {2, 3, 4, 5, 6}
    assert bool((np.diff(delays, axis=1) > 1).any()) == (transitions == "any")
    assert np.array_equal(delays, random_delays(2, 6, 4, transitions))  # type: ignore[arg-type]


# -- facts


def test_the_pendulum_is_proved_to_6_and_refuted_at_7_though_7_held_constant_is_stable(pendulum: Lesson) -> None:
    cases = pendulum.cases
    assert [cases["worst", d].fact.verdict for d in (6, 7)] == ["stable", "unstable"]
    assert [cases["constant", d].fact.verdict for d in (6, 7)] == ["stable", "stable"]
    assert cases["constant", 7].growth == pytest.approx(0.9924, abs=1e-4)
    assert cases["worst", 7].growth == pytest.approx(1.0017, abs=1e-4)


def test_the_published_gains_of_the_aircraft_are_proved_to_4_and_refuted_at_5(hirm: Lesson) -> None:
    cases = hirm.cases
    assert [cases["worst", d].fact.verdict for d in (4, 5)] == ["stable", "unstable"]
    assert [cases["constant", d].fact.verdict for d in (4, 5)] == ["stable", "stable"]
    assert cases["constant", 5].growth == pytest.approx(0.9989, abs=1e-4)
    assert cases["worst", 5].growth == pytest.approx(1.0050, abs=1e-4)
    assert cases["worst", 4].fact.eta == pytest.approx(0.4645, abs=1e-4)


def test_facts_are_what_other_functions_of_gains_compute(hirm: Lesson) -> None:
    proved, broken = hirm.cases["worst", 4].fact, hirm.cases["worst", 5].fact
    loop = eq9(HIRM, 1, 4)
    assert proved.eta_lower == periodic_gain(loop, [loop.index(d) for d in proved.sequence])
    assert proved.eta_lower > 0.3202  # what is measured in the paper's reading
    assert proved.eta_lower < proved.eta
    assert broken.growth == confirm(HIRM, broken.sequence) > 1.0
    assert hirm.cases["constant", 5].fact.eta == eta(HIRM, 5, 5).eta
    assert hirm.cases["constant", 5].growth == pytest.approx(constant_radius(HIRM, 5), abs=1e-9)
    assert hirm.cases["random", 4].fact is proved


def window(d_max: int, above: float, below: float, verdict: str = "stable", growth: float = 0.9) -> Fact:
    return Fact(1, d_max, verdict, "", 0.1, (d_max,), growth, above, below, 0.0, 1.0)  # type: ignore[arg-type]


def test_a_window_takes_bounds_over_from_those_inside_and_around() -> None:
    nan = math.nan
    own = [window(1, 1.0, 0.9), window(2, nan, 0.8), window(3, 3.0, 2.0), window(4, nan, 2.5, "undecided")]
    constants = [window(1, 1.0, 0.9), window(2, 0.5, 0.5), window(3, 0.5, 0.5), window(4, 2.6, 2.6)]
    facts = nested(own, constants)
    assert [one.eta for one in facts[:3]] == [1.0, 3.0, 3.0]
    assert math.isnan(facts[3].eta)
    assert [one.eta_lower for one in facts] == [0.9, 0.9, 2.0, 2.6]
    assert [one.sequence for one in facts] == [(1,), (1,), (3,), (4,)]
    assert [one.eta for one in nested(own, constants, (2, 0.95))[:3]] == [0.95, 0.95, 3.0]


def test_what_breaks_a_window_breaks_those_around_and_a_proof_holds_inside() -> None:
    nan, inf = math.nan, math.inf
    own = [window(1, nan, nan, "undecided"), window(2, 1.0, 0.5), window(3, nan, 2.0, "undecided")]
    own += [window(4, nan, inf, "unstable", 1.1)]
    constants = [window(1, 1.0, 0.9), window(2, 0.5, 0.5), window(3, nan, inf, "unstable", 1.2), window(4, 1.0, 0.5)]
    facts = nested(own, constants)
    assert [one.verdict for one in facts] == ["stable", "stable", "unstable", "unstable"]
    assert [one.growth for one in facts[2:]] == [1.2, 1.2]
    assert [one.sequence for one in facts[2:]] == [(3,), (3,)]
    assert [(one.d_min, one.d_max) for one in facts] == [(1, 1), (1, 2), (1, 3), (1, 4)]


def test_a_gain_files_certificate_counts_once_it_verifies() -> None:
    designed = load_gains("hirm-d4")
    found = stored_eta(designed, "any")
    assert found is not None
    assert designed.certificate is not None
    assert found == (4, designed.certificate["eta"])
    assert found[1] == pytest.approx(0.1165, abs=1e-4)
    assert stored_eta(replace(designed, K1=designed.K1 * 1.01), "any") is None
    assert stored_eta(replace(designed, certificate=None), "any") is None


# -- cases


def test_flights_under_random_delays_show_nothing_of_the_sequence_that_breaks_the_window(
    hirm: Lesson, pendulum: Lesson
) -> None:
    for one, d in ((hirm, 5), (pendulum, 7)):
        drawn = one.cases["random", d].drawn
        assert drawn is not None
        assert drawn.grew == 0
        assert drawn.least <= drawn.mean <= drawn.largest < 1.0 < one.cases["worst", d].growth
        assert standing(one.cases["random", d]) == "calm"


def test_the_curve_under_a_witness_grows_as_the_witness_says(pendulum: Lesson) -> None:
    case = pendulum.cases["worst", 7]
    period = len(case.fact.sequence)
    rounds = (SAMPLES - 1) // period // 2
    late, last = case.left[-1 - rounds * period], case.left[-1]
    assert (last / late) ** (1.0 / (rounds * period)) == pytest.approx(case.growth, abs=1e-4)
    assert np.abs(case.y[-100:]).max() > 2.0 * np.abs(case.y[100:200]).max()


def test_every_case_shows_delays_of_its_own_window_only(hirm: Lesson) -> None:
    for (pattern, d), case in hirm.cases.items():
        inside = {d} if pattern == "constant" else set(range(1, d + 1))
        assert set(case.delays.tolist()) <= inside
        assert len(case.delays) == len(case.y) == len(case.u) == len(case.left) == SAMPLES


def test_a_loop_without_reference_and_disturbance_has_a_page_too() -> None:
    one = lesson(first_order(), range(1, 4))
    worst = [one.cases["worst", d].fact.verdict for d in one.delays]
    constant = [one.cases["constant", d].fact.verdict for d in one.delays]
    assert constant == ["stable", "stable", "unstable"]  # K1 = −0.6 lies between −0.618 and −0.445
    assert worst[0] == "stable"
    assert worst[2] == "unstable"
    said = verdict(one, one.cases["constant", 1])
    assert dict(said.numbers)["gain η, Eq. (12)"].startswith("no bound")
    assert one.yr is None
    assert "slow" in page([one])


@pytest.mark.parametrize("window", [(0, 3), (2, 17)])
def test_a_slider_that_no_page_can_hold_is_refused(window: tuple[int, int]) -> None:
    with pytest.raises(InputError, match="expected delays within 1:16"):
        positions(HIRM, window)


# -- words


def test_a_verdict_says_proof_refutation_and_what_is_missing(hirm: Lesson) -> None:
    proved, broken = (verdict(hirm, hirm.cases["worst", d]) for d in (4, 5))
    assert (proved.standing, proved.headline) == ("proved", "Stable: proved")
    assert dict(proved.numbers)["gain η, Eq. (12)"].startswith("η ≤ 0.4645 proved, η ≥ 0.33")
    assert broken.standing == "refuted"
    assert "1…5" in broken.about
    assert dict(broken.numbers)["breaking sequence"] == f"{runs_of(hirm.cases['worst', 5].fact.sequence)}, then again"
    assert dict(broken.numbers)["gain η, Eq. (12)"] == "none: the error has no bound"
    calm = verdict(hirm, hirm.cases["random", 5])
    assert calm.headline == "Looks calm, and is refuted"
    assert f"All of {RUNS} flights" in calm.says


def test_a_bound_is_still_a_bound_when_it_is_printed(hirm: Lesson) -> None:
    case = hirm.cases["worst", 4]
    for value, shown in (
        (0.123449, "η ≤ 0.1235 proved"),
        (75.97311, "η ≤ 75.98 proved"),
        (12345.6, "η ≤ 12350 proved"),
    ):
        tight = replace(case, fact=replace(case.fact, eta=value, eta_lower=value))
        said = dict(verdict(hirm, tight).numbers)["gain η, Eq. (12)"]
        assert said.startswith(shown)
        assert float(re.findall(r"η ≥ ([\d.]+)", said)[0]) <= value


def test_a_growth_beside_1_is_told_from_1(hirm: Lesson) -> None:
    said = verdict(hirm, replace(hirm.cases["worst", 5], growth=1.0000012))
    assert "1.0000012" in dict(said.numbers)["growth per sample, this sequence"]


def test_the_takeaway_names_the_delays_at_which_it_turns(hirm: Lesson) -> None:
    text = takeaway(hirm)
    assert "every delay up to <b>5</b> is stable" in text
    assert "<b>1…4</b> are proved stable, but <b>1…5</b> breaks" in text
    assert "a simulation is no proof" in text


def test_runs_of_a_delay_sequence_are_shortened() -> None:
    assert runs_of((1, 1, 2, 3, 7, 7, 7)) == "1<sup>×2</sup> 2 3 7<sup>×3</sup>"


# -- the page


class Elements(HTMLParser):
    """What a page refers to, and the text of its scripts by id."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.ids: list[str] = []
        self.opened: list[str] = []
        self.scripts: dict[str, str] = {}
        self._script: str | None = None
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.opened.append(tag)
        self.links += [str(given[key]) for key in ("src", "href", "action", "data") if key in given]
        self.ids += [str(given["id"])] if "id" in given else []
        self._script = str(given.get("id", "")) if tag == "script" else None

    def handle_endtag(self, _tag: str) -> None:
        self._script = None

    def handle_data(self, data: str) -> None:
        if self._script is not None:
            self.scripts[self._script] = data


def test_the_page_holds_the_curves_and_refers_to_nothing(hirm: Lesson, pendulum: Lesson) -> None:
    text = page([pendulum, hirm])
    elements = Elements(text)
    assert elements.links == []
    assert not {"link", "img", "iframe", "object"} & set(elements.opened)
    assert "@import" not in text[: text.index("</style>")]
    assert len(elements.ids) == len(set(elements.ids))
    assert len(text.encode()) < 2_500_000
    assert "<!--" not in text[text.index("<body>") : text.index("<script")]
    system = json.loads(elements.scripts["lessons"])["systems"][1]
    shown, case = system["cases"]["worst"][1], hirm.cases["worst", 5]

    def unpacked(key: str, kind: str) -> np.ndarray:
        return np.frombuffer(base64.b64decode(shown[key]), kind)

    assert unpacked("d", "u1").tolist() == case.delays.tolist()
    y = unpacked("y", "<f4")
    assert np.allclose(y, np.degrees(case.y), atol=1e-5)
    assert shown["standing"] == "refuted"
    assert (system["first"], system["last"], system["name"]) == (4, 5, "hirm-paper")
    low, high = system["views"]["response"]
    assert low < 0.0
    assert 1.0 < high < np.abs(y).max()  # what grows leaves the picture


def test_a_curve_far_out_of_the_picture_ends_there() -> None:
    one = lesson(first_order(K1=-9.0), range(1, 2))
    assert one.cases["random", 1].drawn is not None
    assert one.cases["random", 1].drawn.grew == RUNS
    shown = json.loads(Elements(page([one])).scripts["lessons"])["systems"][0]["cases"]["constant"][0]
    y = np.frombuffer(base64.b64decode(shown["y"]), "<f4")
    first = int(np.isnan(y).argmax())
    assert 0 < first < SAMPLES
    assert np.isnan(y[first:]).all()


def test_a_name_from_a_file_is_text_and_no_markup() -> None:
    text = page([lesson(first_order("</script><b>x</b>"), range(1, 2))])
    assert "</script><b>" not in text
    assert "&lt;b&gt;x&lt;/b&gt;" in text


# -- the command


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., object]:
    monkeypatch.chdir(tmp_path)
    return lambda *arguments: CliRunner().invoke(teach, list(arguments), catch_exceptions=False, standalone_mode=False)


def test_the_command_writes_a_page_and_says_what_is_on_it(run: Callable[..., object], tmp_path: Path) -> None:
    result = run("--gains", "hirm-paper", "--delay", "1:1", "--transitions", "fifo", "-o", "page.html", "--json")
    answer = json.loads(result.stdout)  # type: ignore[attr-defined]
    assert answer["file"] == "page.html"
    assert answer["bytes"] == (tmp_path / "page.html").stat().st_size
    assert answer["systems"][0]["worst_stable"] == [1]
    assert json.loads(Elements((tmp_path / "page.html").read_text()).scripts["lessons"])["systems"][0]["fifo"]


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("--gains", "nothing.toml"), "nothing.toml"),
        (("--gains", "hirm-paper", "--gains", "hirm-paper"), "every name once"),
        (("--delay", "1:40"), "within 1:16"),
        (("--delay", "x"), "x"),
        (("-o", "nowhere/page.html"), "folder"),
        (tuple(word for _ in range(7) for word in ("--gains", "hirm-d4")), "at most 6"),
    ],
)
def test_bad_input_is_refused_before_anything_is_computed(
    run: Callable[..., object], arguments: tuple[str, ...], complaint: str
) -> None:
    with pytest.raises(InputError, match=complaint):
        run(*arguments)
