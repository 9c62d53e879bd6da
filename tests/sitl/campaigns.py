"""A campaign to start from, and a cluster of this machine, for the tests."""

from __future__ import annotations

import logging
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any

from distributed import LocalCluster

from gains.store import load_law, require_law
from sitl.campaign.distributions import Span, parse_delays, parse_signal
from sitl.campaign.job import Campaign
from sitl.campaign.kernel import MAX_DELAY


def campaign(gains: str = "hirm-paper", **changes: Any) -> Campaign:
    """Return one flight of the gains' own model and window, but for what is changed."""
    law = require_law(load_law(gains))
    base = Campaign(
        law=law,
        plant=law.model,
        plant_name=law.model.name,
        d_min=law.d_min,
        d_max=law.d_max,
        transitions="any",
        delays=parse_delays("uniform", law.d_min, law.d_max, fifo=False, longest=MAX_DELAY),
        link=None,
        gust=parse_signal("sine:0..3.5deg:0.5s..10s", "gust"),
        reference=parse_signal("square:0..5deg:1s..10s", "reference"),
        delta=Span(0.0, 0.0),
        x0=0.0,
        wind=None,
        limits=False,
        flights=1,
        samples=400,
        seed=1,
    )
    return replace(base, **changes)


def local_cluster() -> AbstractContextManager[Any]:
    """Return two workers, a process each, that nobody else can reach."""
    cluster: AbstractContextManager[Any] = LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
        silence_logs=logging.CRITICAL,
    )
    return cluster
