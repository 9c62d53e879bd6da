"""What the plots show against loops over all past states and a plain recursion; the figures by what they write."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread

from gains.decide import Bound, Decision, bound, decide
from gains.model import GainLaw, Gains, Matrix, Schedule, augmented, spectral_radius
from gains.plot import margins_figure, plot_margins, plot_response, require_format, response_figure
from gains.plotdata import Margins, Response, constant_delays, margins, respond, response
from gains.store import load_gains
from gains.table import InputError
from tests.gains.loops import FEASIBLE, random_gains
from tests.gains.test_proving import answer

KINDS = {"png": b"\x89PNG\r\n", "svg": b"<?xml", "pdf": b"%PDF-"}


def quiet(_text: str) -> None:
    pass


def companion(gains: Gains, d: int) -> Matrix:
    """x(k+1) = A x(k) + B K1 x(k−d) over [x(k); …; x(k−d)]."""
    nx = gains.model.nx
    whole = np.eye(nx * (d + 1), k=-nx)
    whole[:nx, :nx] += gains.model.A
    whole[:nx, nx * d :] += gains.model.B @ gains.K1
    return whole


def gain_on_circle(gains: Gains, d: int, points: int = 20_001) -> float:
    """The largest gain of e = (C + C1 z^−d) (z − A − A1 z^−d)^−1 B v on a grid of the unit circle."""
    loop = augmented(gains.model, gains.K1, gains.K2)
    z = np.exp(1j * np.linspace(0.0, np.pi, points))[:, None, None]
    late = z ** (-d)
    inner = np.linalg.solve(
        z * np.eye(loop.n) - loop.A - loop.A1 * late, np.broadcast_to(loop.B, (points, *loop.B.shape))
    )
    return float(np.linalg.norm((loop.C + loop.C1 * late) @ inner, 2, axis=(1, 2)).max())


def recursion(gains: Gains, past: Sequence[Matrix], delays: Sequence[int]) -> list[Matrix]:
    """y(0), y(1), … by Eq. (4) and the law; ``past`` begins with x(0), then x(−1), ….."""
    model, x = gains.model, {-i: state for i, state in enumerate(past)}
    y = []
    for k, d in enumerate(delays):
        u = gains.K1 @ x[k - d]
        y.append(model.C @ x[k] + model.D @ u)
        x[k + 1] = model.A @ x[k] + model.B @ u
    return y


def short_margins(law: GainLaw, limit: int) -> Margins:
    return margins(law, 1, limit, "any", bound(law, 1, limit), quiet)


@pytest.fixture(scope="module")
def hirm() -> Margins:
    return short_margins(load_gains("hirm-paper"), 6)


@pytest.fixture(scope="module")
def pendulum() -> Response:
    gains = load_gains("pendulum-paper")
    return response(gains, decide(gains, 1, 7, best_witness=True), "any")


# -- what is shown


@pytest.mark.parametrize("name", ["pendulum-paper", "hirm-paper"])
def test_constant_radii_are_those_of_the_companion_matrix_over_all_past_states(name: str):
    gains = load_gains(name)
    found = constant_delays(gains, 0, 8, "any")
    assert [constant.d for constant in found] == list(range(9))
    for constant in found:
        assert constant.radius == pytest.approx(spectral_radius(companion(gains, constant.d)), rel=1e-9)


def test_constant_norms_are_the_largest_gains_on_the_unit_circle():
    gains = load_gains("hirm-paper")
    for d, radius, norm in constant_delays(gains, 1, 6, "fifo"):
        if radius >= 1.0:
            assert math.isinf(norm)
        else:
            assert norm == pytest.approx(gain_on_circle(gains, d), rel=1e-3)


def test_a_loop_without_disturbance_and_reference_has_no_gain():
    gains = replace(FEASIBLE, model=replace(FEASIBLE.model, E=np.zeros((2, 0))))
    assert all(math.isnan(constant.norm) for constant in constant_delays(gains, 1, 3, "any"))


def test_a_schedule_shows_the_worst_set_that_may_run_at_a_delay():
    low = replace(random_gains(np.random.default_rng(3), 2, 1, 1, 0), d_min=1, d_max=1)
    high = replace(low, d_min=2, d_max=4, K1=-2.0 * low.K1)
    found = {one.d: one.radius for one in constant_delays(Schedule("two", low.model, (low, high)), 1, 4, "any")}
    both = {d: [spectral_radius(companion(own, d)) for own in (low, high)] for d in range(1, 5)}
    assert found[1] == pytest.approx(max(both[1]))  # an estimate may be wrong by one sample
    assert found[4] == pytest.approx(both[4][1])


def test_every_window_lies_between_its_bounds_and_says_what_was_decided(hirm: Margins):
    assert [window.d_max for window in hirm.windows] == [1, 2, 3, 4, 5, 6]
    assert [window.verdict for window in hirm.windows] == ["stable"] * 4 + ["unstable"] * 2
    for window in hirm.windows:
        constant = max(spectral_radius(companion(load_gains("hirm-paper"), d)) for d in range(1, window.d_max + 1))
        assert constant * (1.0 - 1e-12) <= window.lower <= window.upper
        assert (window.upper < 1.0) if window.verdict == "stable" else (window.lower > 1.0)


def test_bounds_rise_with_the_window(hirm: Margins):
    for name in ("lower", "upper"):
        values = [getattr(window, name) for window in hirm.windows]
        assert values == sorted(values)
    for name in ("eta", "eta_lower"):
        values = [getattr(window, name) for window in hirm.windows if window.verdict == "stable"]
        assert values == sorted(values)


def test_the_gain_of_a_proved_window_lies_in_a_band_around_the_measured_one(hirm: Margins):
    measured = {1: (0.1126, 0.1127), 2: (0.128, 0.1316), 3: (0.185, 0.2111), 4: (0.320, 0.4646)}
    for window in hirm.windows[:4]:
        low, high = measured[window.d_max]
        assert low <= window.eta_lower <= window.eta <= high
    assert all(math.isnan(window.eta) for window in hirm.windows[4:])


def test_no_window_is_above_the_limit_that_was_asked():
    assert [window.d_max for window in short_margins(load_gains("pendulum-paper"), 2).windows] == [1, 2]


def test_a_decision_of_one_window_carries_over_to_those_inside_and_around(monkeypatch: pytest.MonkeyPatch):
    """Windows that were left undecided by themselves, between a proof at 2 and a witness at 4."""
    monkeypatch.setattr("gains.plotdata.decide", lambda _law, d_min, d, **_: Decision("undecided", d_min, d, upper=2.0))
    proof = Decision("stable", 1, 2, lower=0.5, upper=0.9)
    refuted = Decision("unstable", 1, 4, witness=(4,), growth=1.25, lower=1.25, upper=1.5)
    found = margins(FEASIBLE, 1, 9, "any", Bound(2, proof, refuted), quiet)
    assert [window.verdict for window in found.windows] == ["stable", "stable", "undecided", "unstable", "unstable"]
    assert [window.upper for window in found.windows] == [0.9, 0.9, 1.5, 1.5, 2.0]
    assert [window.lower for window in found.windows[3:]] == [1.25, 1.25]


def test_a_response_is_the_plain_recursion():
    gains = random_gains(np.random.default_rng(1), 3, 2, 2, 0)
    rng = np.random.default_rng(2)
    past, delays = rng.normal(size=(5, 3)), rng.integers(0, 5, size=40)
    found = respond(gains, past, delays)
    np.testing.assert_allclose(found, recursion(gains, list(past[::-1]), delays.tolist()), rtol=1e-12, atol=1e-12)


def test_under_the_witness_the_response_grows_as_predicted_from_the_first_period_on(pendulum: Response):
    factor = pendulum.growth**pendulum.period
    before, after = pendulum.y[: -pendulum.period], pendulum.y[pendulum.period :]
    np.testing.assert_allclose(np.abs(after), factor * np.abs(before), atol=1e-6)
    assert np.abs(pendulum.y[: pendulum.period]).max() == pytest.approx(1.0)


@pytest.mark.parametrize(("name", "d_max"), [("pendulum-paper", 7), ("hirm-paper", 5), ("hirm-paper", 6)])
def test_the_envelope_encloses_the_response_and_touches_it(name: str, d_max: int):
    gains = load_gains(name)
    found = response(gains, decide(gains, 1, d_max), "any")
    ratio = np.abs(found.y) / found.envelope[:, None]
    assert ratio.max() == pytest.approx(1.0)
    assert found.envelope[1] / found.envelope[0] == pytest.approx(found.growth)


def test_the_delays_repeat_the_witness(pendulum: Response):
    gains = load_gains("pendulum-paper")
    witness = decide(gains, 1, 7, best_witness=True).witness
    assert witness is not None
    assert pendulum.d.tolist() == [witness[k % len(witness)] for k in range(len(pendulum.d))]


def test_beside_it_run_the_least_and_the_largest_stable_constant_delay_from_the_same_start(pendulum: Response):
    assert [(held.d, round(held.radius, 4)) for held in pendulum.held] == [(1, 0.9842), (7, 0.9924)]
    for held in pendulum.held:
        np.testing.assert_allclose(held.y[0], pendulum.y[0])  # D = 0: y(0) = C x(0)
        assert np.abs(held.y[-30:]).max() < 0.2


def test_a_constant_witness_is_shown_beside_stable_delays():
    gains = load_gains("pendulum-paper")
    found = response(gains, decide(gains, 1, 9), "any")
    assert set(found.d.tolist()) == {9}
    assert [held.d for held in found.held] == [1, 7]


def test_no_unstable_delay_is_shown_beside_a_witness():
    gains = load_gains("pendulum-paper")
    assert response(gains, decide(gains, 8, 9), "any").held == ()


# -- figures and files


@pytest.mark.parametrize("kind", KINDS)
def test_figures_are_written_in_the_format_of_their_suffix(
    kind: str, tmp_path: Path, hirm: Margins, pendulum: Response
):
    plot_margins(tmp_path / f"a.{kind}", hirm)
    plot_response(tmp_path / f"b.{kind}", pendulum)
    for name in "ab":
        content = (tmp_path / f"{name}.{kind}").read_bytes()
        assert content.startswith(KINDS[kind])
        assert len(content) > 5000


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_plot_has_the_same_bytes(kind: str, tmp_path: Path, pendulum: Response):
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        plot_response(tmp_path / folder / f"w.{kind}", pendulum)
    assert (tmp_path / "one" / f"w.{kind}").read_bytes() == (tmp_path / "two" / f"w.{kind}").read_bytes()


def test_an_upper_case_suffix_is_a_format_too(tmp_path: Path, pendulum: Response):
    require_format(tmp_path / "W.PNG")
    plot_response(tmp_path / "W.PNG", pendulum)
    assert imread(tmp_path / "W.PNG").shape[1] >= 1000


def texts(figure: Figure) -> str:
    legends = [text.get_text() for axes in figure.axes for text in axes.get_legend().get_texts()]
    return "\n".join([figure.get_suptitle(), *legends])


def test_the_title_says_gains_model_transitions_and_result(hirm: Margins):
    title = margins_figure(hirm).get_suptitle()
    for part in ("hirm-paper", "on hirm", "transitions: any", "25 ms", "proved from 1 to 4 (100 ms)", "5 breaks"):
        assert part in title


def test_proved_refuted_and_undecided_windows_have_their_own_marks(hirm: Margins):
    assert "undecided" not in texts(margins_figure(hirm))
    *before, last = hirm.windows
    open_ = replace(hirm, windows=(*before, replace(last, verdict="undecided", lower=0.99)))
    for part in ("proved stable", "refuted by a sequence", "undecided", "edge of stability"):
        assert part in texts(margins_figure(open_))


def test_without_gains_from_v_to_e_there_is_one_panel():
    gains = replace(FEASIBLE, model=replace(FEASIBLE.model, E=np.zeros((2, 0))))
    figure = margins_figure(short_margins(gains, 3))
    assert len(figure.axes) == 1
    assert "every bounded delay" in figure.get_suptitle()


def test_where_nothing_is_proved_the_figure_says_so():
    gains = load_gains("pendulum-paper")
    unstable = replace(gains, K1=0.0 * gains.K1)
    figure = margins_figure(short_margins(unstable, 3))
    assert "no window from 1 proved, 1 breaks" in figure.get_suptitle()


def test_great_growth_is_drawn_on_a_logarithmic_axis(pendulum: Response):
    assert response_figure(pendulum).axes[0].get_yscale() == "linear"
    steep = replace(pendulum, envelope=1.1 ** np.arange(len(pendulum.d)))
    assert response_figure(steep).axes[0].get_yscale() == "symlog"


# -- commands


@pytest.mark.parametrize(
    ("file", "named"),
    [("w.gif", ".png, .svg, .pdf"), ("w", ".png"), ("no/such/w.png", "folder"), ("is.png", "written")],
)
@pytest.mark.parametrize(
    "line", [["bound", "pendulum-paper"], ["witness", "pendulum-paper", "--delay", "1:7", "-o", "w"]]
)
def test_a_file_that_cannot_be_a_plot_is_refused_before_anything_is_computed(
    line: list[str], file: str, named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "is.png").mkdir()
    command = [sys.executable, "-m", "gains", *line, "--plot", file]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    assert ended.stdout == ""
    assert len(ended.stderr.splitlines()) == 1
    assert named in ended.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["is.png"]


def test_a_full_disk_is_bad_input(pendulum: Response, tmp_path: Path):
    (tmp_path / "full.png").symlink_to("/dev/full")
    with pytest.raises(InputError, match=r"full\.png"):
        plot_response(tmp_path / "full.png", pendulum)


def test_bound_draws_its_answer(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    file = tmp_path / "b.svg"
    code, said, _ = answer(capsys, "bound", "hirm-paper", "--limit", "2", "--plot", str(file))
    assert (code, said["d_max"], said["plot"]) == (0, 2, str(file))
    assert file.read_bytes().startswith(KINDS["svg"])


def test_bound_draws_the_exact_method_only(tmp_path: Path):
    from gains.__main__ import cli

    line = ["bound", "hirm-paper", "--method", "constant", "--plot", str(tmp_path / "b.png")]
    with pytest.raises(InputError, match="--plot: expected method exact, found constant"):
        cli.main(line, standalone_mode=False)


def test_witness_draws_the_loop_and_nothing_where_there_is_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    common = ["witness", "hirm-paper", "-o", str(tmp_path / "w.csv"), "--plot", str(tmp_path / "w.pdf")]
    code, said, complained = answer(capsys, *common, "--delay", "1:3")
    assert (code, said["plot"]) == (1, None)
    assert "not written" in complained
    assert not list(tmp_path.iterdir())
    code, said, _ = answer(capsys, *common, "--delay", "1:5")
    assert (code, said["plot"]) == (0, str(tmp_path / "w.pdf"))
    assert (tmp_path / "w.pdf").read_bytes().startswith(KINDS["pdf"])


def test_commands_that_draw_nothing_do_without_the_plotting_library():
    check = "import sys, gains.__main__, gains.deciding; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", check], check=False).returncode == 0
