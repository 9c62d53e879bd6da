"""``sitl campaign`` as it is typed: the contract's keys, exit codes, and what is refused on one line."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from gains.store import load_gains
from gains.table import InputError
from gains.witnessfile import read_witness
from sitl.campaign.engine import drawn_block, fly_range
from sitl.campaign.kernel import LANES
from sitl.commands.campaign import campaign as command
from tests.sitl.test_campaign_parts import campaign

SMALL = ("--flights", "300", "--samples", "100", "--seed", "3")
WITNESS = Path(__file__).parents[2] / "sitl" / "scenarios" / "witness-pendulum.csv"
"""Of 1 to 7, where the published gains are refuted."""


def typed(*arguments: str) -> Result:
    result = CliRunner().invoke(command, arguments, standalone_mode=False)
    if result.exception is not None:
        raise result.exception
    return result


def told(*arguments: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(typed(*arguments, "--json").stdout)
    return found


def test_the_contracts_keys_are_there_and_say_what_the_engine_flew() -> None:
    result = typed("--gains", "hirm-paper", "--delay", "1:4", *SMALL, "--json")
    said = json.loads(result.stdout)
    flown = fly_range(campaign(), 0, 300)
    assert result.return_value == 0
    assert (said["flights"], said["samples"], said["diverged"]) == (300, 100, 0)
    assert said["max_gain"] == flown["gain"].max()
    assert said["max_gain"] < said["eta"] < 1.0
    assert said["above_eta"] == 0
    assert said["worst_flight"] == np.argmax(flown["gain"])
    assert said["seconds"] > 0.0
    assert said["plant_steps_per_s"] > 0.0
    quantiles = {float(p): value for p, value in said["rms_error_rad"].items()}
    assert quantiles[0.5] == pytest.approx(np.quantile(flown["rms_error"], 0.5), rel=0.02)
    assert sorted(quantiles.values()) == [quantiles[p] for p in sorted(quantiles)]
    # Clopper and Pearson: without a failure the bound is 1 - 0.025^(1/n)
    assert said["failure_probability"]["high"] == pytest.approx(1.0 - 0.025 ** (1.0 / 300.0), rel=1e-9)


def test_a_witness_outside_the_window_diverges_as_predicted_with_exit_code_1() -> None:
    result = typed("--gains", "pendulum-paper", "--delay", "1:7", "--delays", f"cycle:{WITNESS}", "--flights", "32",
                   "--samples", "20000", "--gust", "none", "--reference", "none", "--x0", "1e-3", "--json")  # fmt: skip
    said = json.loads(result.stdout)
    assert result.return_value == 1
    assert said["diverged"] == 32
    growth = said["growth_per_sample"]
    assert growth["predicted"] > 1.0
    assert growth["measured"] - 1.0 == pytest.approx(growth["predicted"] - 1.0, rel=0.01)


def test_an_error_beyond_the_threshold_is_a_failure() -> None:
    limit = math.degrees(float(np.quantile(fly_range(campaign(), 0, 300)["max_error"], 0.9)))
    result = typed("--gains", "hirm-paper", *SMALL, "--threshold", f"{limit:.17g}deg", "--json")
    assert result.return_value == 1
    assert json.loads(result.stdout)["failure_probability"]["count"] == 30


def test_the_worst_flights_delays_replayed_give_its_gain(tmp_path: Path) -> None:
    file = tmp_path / "worst.csv"
    said = told("--gains", "hirm-paper", *SMALL, "--worst", str(file))
    witness, law = read_witness(file), load_gains("hirm-paper")
    drawn = drawn_block(campaign(), said["worst_flight"] // LANES * LANES).flight(said["worst_flight"] % LANES)
    assert list(witness.delays) == drawn.d.tolist()
    model, reference = law.model, law.model.reference
    assert reference is not None
    assert law.K2 is not None
    x, xr, past, e2, v2 = np.zeros(3), np.zeros(len(reference.Ar)), [], 0.0, 0.0
    for k, d in enumerate(witness.delays):
        past.append(law.K1 @ x)
        u = (past[k - d] if k >= d else 0.0) + law.K2 @ xr
        e2 += float(np.sum((model.C @ x + model.D @ u - reference.Cr @ xr) ** 2))
        v2 += float(drawn.w[k] @ drawn.w[k] + drawn.r[k] @ drawn.r[k])
        x, xr = model.A @ x + model.B @ u + model.E @ drawn.w[k], reference.Ar @ xr + reference.Br @ drawn.r[k]
    assert said["max_gain"] == pytest.approx(math.sqrt(e2 / v2), rel=1e-9)


def test_several_gains_fly_the_same_draws_and_are_compared_in_pairs(tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    said = told("--gains", "hirm-paper", "--gains", "hirm-d4", "--delay", "1:4", *SMALL, "--page", str(page))
    assert [each["gains"] for each in said["campaigns"]] == ["hirm-paper", "hirm-d4"]
    alone = [told("--gains", name, "--delay", "1:4", *SMALL)["max_gain"] for name in ("hirm-paper", "hirm-d4")]
    assert [each["max_gain"] for each in said["campaigns"]] == alone
    assert len(said["pairs"]) == 1
    assert "hirm-d4" in page.read_text()


def test_results_in_a_folder_are_gone_on_with_and_those_of_another_refused(tmp_path: Path) -> None:
    folder = str(tmp_path / "out")
    assert told("--gains", "hirm-paper", *SMALL, "-o", folder)["flown_now"] == 300
    assert told("--gains", "hirm-paper", *SMALL[2:], "--flights", "400", "-o", folder)["flown_now"] == 100
    with pytest.raises(InputError, match="another"):
        typed("--gains", "hirm-d4", *SMALL, "-o", folder)


def test_tables_are_printed_for_people() -> None:
    printed = typed("--gains", "hirm-paper", *SMALL).output
    for words in ("hirm-paper", "gain", "rms", "million plant-steps/s"):
        assert words in printed


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("--delay", "4:1"), "4:1"),
        (("--delay", "1:200"), "127"),
        (("--delays", "poisson:2"), "poisson"),
        (("--delays", "uniform", "--link", "lte"), "--link"),
        (("--gust", "sine:1parsec"), "parsec"),
        (("--delta", "0.1", "--plant", "sixdof:hirm"), "uncertainty"),
        (("--plant", "pendulum"), "states"),
        (("--threshold", "0"), "above 0"),
        (("--flights", str(10**13)), "--flights"),
        (("--page", "/nowhere/page.html"), "/nowhere/page.html"),
        (("--scheduler", "there"), "tcp://HOST:PORT"),
    ],
)
def test_what_cannot_be_flown_is_refused_on_one_line(arguments: tuple[str, ...], complaint: str) -> None:
    with pytest.raises(InputError) as refused:
        typed("--gains", "hirm-paper", *arguments)
    assert complaint in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("missing", ["numba", "pyarrow"])
def test_without_the_extra_it_says_what_to_install(missing: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(InputError, match=r"pip install 'lagproof\[campaign\]'"):
        typed("--gains", "hirm-paper")
