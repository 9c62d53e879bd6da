"""The targets under hypothesis: raw bytes, words of the grammar, and samples with small changes."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fuzz.mutation import KINDS, MAX_BYTES, Edit, edited
from tests.fuzz.targets import TARGETS, corpus_of

QUICK = settings(max_examples=40, deadline=None, derandomize=True, database=None)
THOROUGH = settings(max_examples=3000, deadline=None, suppress_health_check=list(HealthCheck))


def inputs(name: str) -> st.SearchStrategy[bytes]:
    """Return a strategy for one target's inputs."""
    words = st.sampled_from(TARGETS[name].words)
    raw = st.binary(max_size=300)
    insert = st.one_of(words, st.binary(min_size=1, max_size=8))
    edit = st.builds(Edit, st.integers(0, KINDS - 1), st.integers(0, MAX_BYTES), st.integers(1, 64), insert)
    samples = st.sampled_from(list(corpus_of(name).values()))
    changed = st.builds(edited, samples, st.lists(edit, min_size=1, max_size=6))
    sentence = st.lists(st.one_of(words, st.binary(max_size=3)), max_size=30).map(b"".join)
    return st.one_of(changed, sentence, raw)


def survives(name: str) -> Callable[[bytes], None]:
    """Return a test function for :func:`hypothesis.given`, which lets it return nothing."""

    def run(data: bytes) -> None:
        TARGETS[name].run(data)

    return run


@pytest.mark.parametrize("name", TARGETS)
def test_no_input_gets_past_what_is_documented(name: str) -> None:
    QUICK(given(inputs(name))(survives(name)))()


@pytest.mark.long
@pytest.mark.parametrize("name", TARGETS)
def test_nor_does_any_of_many(name: str) -> None:
    THOROUGH(given(inputs(name))(survives(name)))()
