"""Lemma 1 in its three forms: the free slack of the printed and of the standard form gains nothing over Jensen's."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from gains import lmi, lyapunov
from gains.lmi import Block, Slack, Weights
from gains.proof import ask
from gains.sdp import Program, Status, Variable, solve
from gains.store import load_gains

GAINS = load_gains("hirm-paper")


def optimum(form: str, d_max: int) -> float:
    """Return the least η of a form, its slack free where it has one, in the units of a balanced loop."""
    question = ask(GAINS, 1, d_max, 0.0)
    n, m = question.system.A.shape[0], question.system.B.shape[1]
    variables = {name: Variable(n, n, symmetric=True) for name in "PQR"} | {"eta2": Variable()}
    if form != "jensen":
        variables |= {"Y": Variable(n, n), "W": Variable(n, n), "U": Variable(m, n)}

    def statement(x: Mapping[str, Block]) -> Program:
        weights = Weights(x["P"], x["Q"], x["R"])
        if form == "jensen":
            blocks = lmi.jensen(question.system, weights, x["eta2"], question.window)
        else:
            inequality = lmi.eq13 if form == "printed" else lmi.standard
            slack = Slack(x["Y"], x["W"], x["U"])
            blocks = inequality(question.system, weights, slack, x["eta2"], question.window)
        return Program(x["eta2"], [blocks], [x[name] for name in "PQR"])

    solution = solve(variables, statement)
    assert solution.status in (Status.OPTIMAL, Status.INACCURATE)
    return float(np.sqrt(solution.values["eta2"][0, 0]))


@pytest.mark.parametrize("d_max", [2, 3])
def test_the_optima_of_the_three_forms_agree_to_1e_4(d_max: int) -> None:
    jensen = optimum("jensen", d_max)
    assert optimum("standard", d_max) == pytest.approx(jensen, rel=1e-4)
    assert optimum("printed", d_max) == pytest.approx(jensen, rel=1e-4)


def test_the_optimum_in_balanced_units_is_that_of_the_model_but_for_its_scale() -> None:
    ratios = [optimum("jensen", d) / (lyapunov.eta(GAINS, 1, d).eta or np.nan) for d in (2, 3)]
    assert ratios[0] == pytest.approx(ratios[1], rel=1e-3)
