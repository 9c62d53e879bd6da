"""Every sample of the corpus, and every input that once broke something, goes through its target."""

from __future__ import annotations

import numpy as np
import pytest

from gains import verify_stability
from gains.switched_certificate import Block
from gains.verify_stability import check_blocks
from tests.fuzz.mutation import loop
from tests.fuzz.seeds import seeds
from tests.fuzz.targets import CORPUS, TARGETS, corpus_of

REFUSED: list[str] = []
"""Samples of what is refused on purpose."""


@pytest.mark.parametrize("name", TARGETS)
def test_it_means_something_or_is_refused_as_documented(name: str) -> None:
    samples = corpus_of(name)
    assert samples
    for data in samples.values():
        TARGETS[name].run(data)


def test_every_folder_of_the_corpus_has_a_target() -> None:
    assert {path.name for path in CORPUS.iterdir()} == set(TARGETS)


def test_the_samples_that_fuzzing_begins_with_are_still_taken() -> None:
    """Samples that a change of format has made invalid would be refused at once, and lead nowhere."""
    refused = [f"{target}/{name}" for target, name, content in seeds() if not TARGETS[target].run(content)]
    assert refused == REFUSED


def test_the_mutation_loop_finds_a_planted_defect() -> None:
    def planted(data: bytes) -> None:
        assert b"loss=1" not in data

    ran, data, error = loop(planted, [b"loss=0.1", b"dup=1"], [b"1"], lambda: False)
    assert data is not None
    assert b"loss=1" in data
    assert isinstance(error, AssertionError)
    assert ran > 1


def test_all_trees_of_a_certificate_share_one_allowance(monkeypatch: pytest.MonkeyPatch) -> None:
    def proved(count: int) -> bool:
        blocks = [Block((i,), "tree", 0, np.ones((1, 1, 1))) for i in range(count)]
        F = 0.999 * np.eye(count)[None]
        return check_blocks(F, np.zeros_like(F), np.zeros((1, 3), dtype=np.intp), blocks).passed

    assert proved(10)
    monkeypatch.setattr(verify_stability, "MAX_OPERATIONS", 9)
    assert proved(9)
    assert not proved(10)
