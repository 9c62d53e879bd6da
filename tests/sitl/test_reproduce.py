"""The reproduction: its flights against recursions and closed forms, its pages, its exit status; long: all of it."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.signal import cont2discrete

from gains.store import load_gains, load_model
from sitl.commands.reproduce import reproduce
from sitl.reproduce import printed, run, slips
from sitl.reproduce.cases import CONTROLLERS, D_MAX, D_MIN, Controller
from sitl.reproduce.claims import OURS, PAPER, Claim, Section, Table, Verdict, broken, cell_text, judged
from sitl.reproduce.flights import ROUNDING, Flown, fly, follows_eq9, imposed, recursion, scenario, uniform_delays
from sitl.reproduce.hirm import Hirm, flights_table, fly_hirm, pulses_table
from sitl.reproduce.hirm_claims import _paper_claims
from sitl.reproduce.pendulum import Pendulum
from sitl.reproduce.proofs import Proofs
from sitl.reproduce.run import Reproduction
from sitl.reproduce.writing import COMMAND, PAGE, html, markdown

REPOSITORY = Path(__file__).parents[2]
NO_PROOFS = Proofs((), {}, (), (), {}, {})
EXPECTED = {
    "pendulum-6": "holds",
    "pendulum-6-by-lemma-2": "does not hold",
    "pendulum-5-by-ref-16": "cannot be checked",
    "pendulum-degrades": "holds",
    "ours-pendulum-tight": "holds",
    "ours-pendulum-flown": "holds",
    "figure-6-good": "holds",
    "figure-6-dfsm": "cannot be checked",
    "figure-7-good": "holds",
    "conclusion-delay-free": "cannot be checked",
    "fresh-reference": "does not hold",
    "ours-hirm-flown": "holds",
    "ours-gust": "holds",
    "ours-settled": "holds",
    "ours-eta-flown": "holds",
    "robust-full": "does not hold",
    "robust-015": "holds",
    "d-min-matters": "holds",
    "ours-designs": "holds",
    "slip-w24": "does not hold",
    "slip-lemma-2": "does not hold",
    "slip-theorem-1": "does not hold",
    "reading-doubled": "holds",
    "slip-lemma-3": "does not hold",
    "reading-signs-48": "holds",
    "slip-a0-31": "does not hold",
    "slip-a0-12": "does not hold",
    "slip-delta-a": "does not hold",
    "reading-units": "holds",
    "slip-ar-23": "does not hold",
    "reading-signs-54": "holds",
    "reading-gust": "holds",
    "reading-open": "cannot be checked",
}


@pytest.fixture(scope="module")
def step() -> Flown:
    """Two seconds of the published gains: step, gust and uncertainty over delays that jump."""
    delays = uniform_delays(7, D_MIN, D_MAX, 80)
    return fly(scenario("hirm", "hirm-paper", delays, 2.0, seed=7, step_deg=1.0, gust=True, delta=True))


@pytest.fixture(scope="module")
def few() -> Hirm:
    """The published gains, the Smith predictor, and a controller that nobody has written."""
    known = {controller.gains: controller for controller in CONTROLLERS}
    wanted = (known["hirm-paper"], known["hirm-smith"], Controller("hirm-unwritten", "unwritten", "comparison"))
    return fly_hirm(1, lambda _: None, quick=True, controllers=wanted)


def claim(verdict: Verdict, by: str = PAPER, finds: str = "x") -> Claim:
    return Claim("an-id", "4.1", "says", finds, verdict, "why", by)


def made_of(*claims: Claim, tables: tuple[Table, ...] = (), figures: tuple[tuple[str, str], ...] = ()) -> Reproduction:
    section = Section("A title", ("A paragraph.",), figures, tables, claims)
    return Reproduction(1, False, cast(Pendulum, None), cast(Hirm, None), (section,), ())


def test_delays_are_of_their_seed_and_use_the_whole_window():
    delays = uniform_delays(1, 1, 3, 400)
    assert delays == uniform_delays(1, 1, 3, 400) != uniform_delays(2, 1, 3, 400)
    assert set(delays) == {1, 2, 3}
    assert max(later - earlier for earlier, later in pairwise(delays)) == 2, "it may jump, as the paper allows"


def test_only_a_sequence_that_jumps_asks_for_any_transitions():
    model = load_model("hirm")
    assert imposed(model, (1, 2, 3, 3)).transitions == "fifo"
    assert imposed(model, (1, 3, 3, 3)).transitions == "any"
    assert imposed(model, (3, 1, 2, 1)).transitions == "any", "from the last of a period to the first of the next"
    assert imposed(model, (8,)).transitions == "fifo"


def test_every_sample_lives_the_delay_that_was_prescribed(step):
    assert step.missed == 0
    assert step.prescribed >= 77, "all but the first few, before any command can have come"
    delays = np.array(uniform_delays(7, D_MIN, D_MAX, 80))
    flown = np.isfinite(step.flight.d)
    assert np.array_equal(step.flight.d[flown], delays[flown])


def test_a_flight_is_the_recursion_of_its_own_delays_and_reference_states(step):
    assert step.modelled is not None
    assert 0.0 < step.modelled < ROUNDING


def test_equal_seeds_fly_equal_flights(step):
    delays = uniform_delays(7, D_MIN, D_MAX, 80)
    again = fly(scenario("hirm", "hirm-paper", delays, 2.0, seed=7, step_deg=1.0, gust=True, delta=True))
    assert np.array_equal(again.flight.x, step.flight.x)
    assert np.array_equal(again.flight.u, step.flight.u)


def test_the_recursion_without_delay_is_the_closed_loop():
    gains = load_gains("pendulum-paper")
    asked = scenario("pendulum", "pendulum-paper", (1,), 1.0, seed=1, x0=(0.02, 0.01))
    found = recursion(asked, [0.0] * 20)
    closed = gains.model.A + gains.model.B @ gains.K1
    assert np.allclose(found.x[19], np.linalg.matrix_power(closed, 19) @ [0.02, 0.01], rtol=1e-12)


def test_a_pendulum_outside_its_window_is_flown_by_the_law_and_not_by_failsafe():
    flown = fly(scenario("pendulum", "pendulum-paper", (8,), 2.1, seed=1, x0=(0.02, 0.0)))
    assert flown.missed == 0
    assert flown.modelled is not None
    assert flown.modelled < ROUNDING
    assert flown.gain is None, "without gust and reference there is nothing to divide by"


def test_a_controller_without_a_gain_file_is_reported_as_not_flown(few):
    row = few.row("hirm-unwritten")
    assert row.missing == "no gain file hirm-unwritten is stored"
    assert not row.flown
    assert few.present == few.rows[:2]
    told = flights_table(few, NO_PROOFS).rows[2]
    assert told[0] == "unwritten"
    assert "not flown" in str(told[-1])


def test_another_controller_is_flown_but_no_recursion_and_no_proof_speak_of_it(few):
    smith = few.row("hirm-smith")
    assert not follows_eq9(load_gains("hirm-smith"))
    assert follows_eq9(load_gains("hirm-lq"))
    assert [one.modelled for one in smith.flown.values()] == [None] * 3
    assert [one.missed for one in smith.flown.values()] == [0] * 3
    assert set(few.sequences) == {"hirm-paper"}
    assert "no proof" in str(flights_table(few, NO_PROOFS).rows[1][-1])
    assert pulses_table(few).rows == (), "a quick run flies no pulses"


def test_a_claim_about_a_controller_that_was_not_flown_cannot_be_checked(few):
    known = {controller.gains: controller for controller in CONTROLLERS}
    rows = tuple(replace(few.rows[2], controller=known[name]) for name in ("hirm-dfsm", "hirm-lq"))
    claims = {one.id: one for one in _paper_claims(replace(few, rows=(few.rows[0], *rows)))}
    for name in ("figure-6-dfsm", "conclusion-delay-free"):
        assert claims[name].verdict is Verdict.OPEN
        assert "not flown" in claims[name].finds


def test_the_hold_is_that_of_scipy():
    Ap, Bp = slips._signed_plant()
    A, B = slips._hold(Ap, Bp, printed.Ts)
    theirs = cont2discrete((Ap, Bp[:, None], np.eye(3), np.zeros((3, 1))), printed.Ts)
    assert np.allclose(A, theirs[0], rtol=1e-12, atol=1e-15)
    assert np.allclose(B, theirs[1][:, 0], rtol=1e-12, atol=1e-15)


def test_what_is_printed_has_the_magnitudes_of_the_stored_model_but_for_the_known_slips():
    model = load_model("hirm-printed")
    differs = np.argwhere(np.abs(np.abs(model.A) - printed.A0) > 1e-12).tolist()
    assert differs == [[2, 0]]
    assert np.array_equal(np.abs(model.B[:, 0]), printed.B0)
    assert model.reference is not None
    assert np.argwhere(np.abs(np.abs(model.reference.Ar) - printed.AR) > 1e-12).tolist() == [[1, 2]]


def test_only_our_own_claims_break_a_run():
    theirs, ours = claim(Verdict.FAILS), claim(Verdict.FAILS, OURS)
    assert broken([theirs, claim(Verdict.OPEN, OURS), claim(Verdict.HOLDS, OURS)]) == []
    assert broken([theirs, ours]) == [ours]
    assert [judged(holds) for holds in (True, False, None)] == [Verdict.HOLDS, Verdict.FAILS, Verdict.OPEN]


def test_nothing_known_is_shown_as_such_and_numbers_to_five_digits():
    assert [cell_text(cell) for cell in (None, 1.0017445, 7, "unbounded")] == ["–", "1.0017", "7", "unbounded"]


@pytest.mark.parametrize(("verdict", "code"), [(Verdict.FAILS, 1), (Verdict.OPEN, 0), (Verdict.HOLDS, 0)])
def test_the_exit_status_is_one_when_a_claim_of_ours_does_not_hold(monkeypatch, tmp_path, verdict, code):
    found = made_of(claim(verdict, OURS), claim(Verdict.FAILS))
    monkeypatch.setattr(run, "reproduce", lambda *_, **__: found)
    monkeypatch.setattr("sitl.reproduce.writing.write", lambda folder, _: {"index.html": folder / "index.html"})
    assert reproduce.main(["-o", str(tmp_path / "new" / "folder"), "--json"], standalone_mode=False) == code


def test_a_folder_that_cannot_be_made_is_refused_before_anything_is_flown(monkeypatch, tmp_path):
    monkeypatch.setattr(run, "reproduce", lambda *_, **__: pytest.fail("it flew"))
    (tmp_path / "file").write_text("")
    with pytest.raises(Exception, match=r"file") as refused:
        reproduce.main(["-o", str(tmp_path / "file" / "below")], standalone_mode=False)
    assert type(refused.value).__name__ == "InputError"


class Reader(HTMLParser):
    """Collects what a page shows and what it would load."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.shown: list[str] = []
        self.loaded: list[str] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.loaded += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.shown.append(data)


def test_the_page_is_one_file_that_loads_nothing_and_escapes_what_it_shows():
    table = Table("t", "1 < 2", ("a", "b"), ((1.0, "x & <script>"), (None, 3)))
    found = made_of(claim(Verdict.HOLDS, finds="<b>"), tables=(table,), figures=(("figure2", 'a "caption"'),))
    page = Reader(html(found, {"figure2": b"png"}))
    assert page.loaded == ["data:image/png;base64,cG5n"]
    assert page.open == []
    assert {"x & <script>", "<b>", "1 < 2", 'a "caption"', "holds"} <= set(page.shown)


def test_no_cell_breaks_a_table_of_the_markdown_page():
    found = made_of(claim(Verdict.HOLDS, finds="|Δ| ≤ 0.15"), tables=(Table("t", "T", ("a|b",), (("c|d",),)),))
    rows = [line for line in markdown(found).splitlines() if line.startswith("|")]
    assert len({row.count("|") for row in rows[:3]}) == 1
    assert len({row.count("|") for row in rows[3:]}) == 1
    assert "![" not in markdown(found, figures=False)
    assert COMMAND in markdown(found, figures=False)


def test_the_stored_page_lists_every_claim_with_its_verdict():
    text = (REPOSITORY / PAGE).read_text(encoding="utf-8")
    rows = re.findall(
        r"^\| ([a-z0-9-]+) \((?:ours|the paper's|a reading)\) \|.*\| ([a-z ]+) \| [^|]*\|$", text, re.MULTILINE
    )
    assert dict(rows) == EXPECTED


@pytest.mark.long
def test_the_whole_reproduction_holds(tmp_path):
    page = tmp_path / "page.md"
    result = CliRunner().invoke(reproduce, ["-o", str(tmp_path / "out"), "--page", str(page), "--json"])
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    assert {one["id"]: one["verdict"] for one in told["claims"]} == EXPECTED
    assert told["broken"] == []
    for path in map(Path, told["files"].values()):
        assert path.stat().st_size > 0
        if path.suffix == ".png":
            assert path.read_bytes().startswith(b"\x89PNG")
    with (tmp_path / "out" / "delays.csv").open(encoding="utf-8", newline="") as file:
        delays = {(row["gains"], row["method"]): row["d_max"] for row in csv.DictReader(file)}
    assert delays["pendulum-paper", "Lemma 1"] == "5"
    assert delays["pendulum-paper", "exact, any sequence"] == "6"
    assert delays["pendulum-paper", "constant delays, exact"] == "7"
    index = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    assert all(source.startswith("data:") for source in Reader(index).loaded)
    numbers = re.compile(r"[-−]?\d+(\.\d+)?(e[-+]\d+)?%?")
    stored = (REPOSITORY / PAGE).read_text(encoding="utf-8")
    assert numbers.sub("#", page.read_text(encoding="utf-8")) == numbers.sub("#", stored), f"run {COMMAND}"
