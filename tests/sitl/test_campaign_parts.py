"""What a campaign keeps on disk, and how it is cut: nothing is flown twice or missing, foreign folders stay."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import orjson
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gains.model import Gains
from gains.table import InputError
from sitl.aircraft.aerodynamics import stored_aircraft
from sitl.campaign import run as running
from sitl.campaign.distributions import Span, parse_delays, parse_signal
from sitl.campaign.engine import fly_range
from sitl.campaign.job import Campaign, identity
from sitl.campaign.kernel import LANES, MAX_DELAY
from sitl.campaign.parts import Part, Parts, missing_ranges
from sitl.campaign.run import MAX_ROWS_KEPT, run
from tests.sitl import campaigns


def campaign(**changes: Any) -> Campaign:
    window = {"d_min": 1, "d_max": 4, "delays": parse_delays("uniform", 1, 4, fifo=False, longest=MAX_DELAY)}
    return campaigns.campaign(**{**window, "flights": 1000, "samples": 100, "seed": 3, **changes})


def parts_in(folder: Path, job: Campaign) -> Parts:
    return Parts(folder, identity(job), {"gains": "hirm-paper"})


def equal(one: dict[str, Any], other: dict[str, Any]) -> bool:
    return one.keys() == other.keys() and all(np.array_equal(one[n], other[n], equal_nan=one[n].dtype.kind == "f")
                                              for n in one)  # fmt: skip


# -- cutting


@given(
    st.lists(st.integers(1, 50), max_size=12), st.lists(st.booleans(), min_size=12, max_size=12), st.integers(1, 400)
)
def test_parts_and_the_missing_are_every_flight_once(sizes: list[int], there: list[bool], flights: int) -> None:
    at, parts = 0, []
    for size, is_there in zip(sizes, there, strict=False):
        if is_there:
            parts.append(Part(at, at + size, Path()))
        at += size
    covered = [n for part in parts for n in range(part.start, part.stop) if n < flights]
    missing = [n for start, stop in missing_ranges(parts, flights) for n in range(start, stop)]
    assert sorted(covered + missing) == list(range(flights))
    assert missing == sorted(missing)


@given(st.lists(st.tuples(st.integers(1, 5000), st.integers(0, 300)), min_size=1, max_size=5), st.floats(1e-7, 1.0))
def test_tasks_are_the_ranges_cut_at_whole_blocks(pieces: list[tuple[int, int]], per_flight_s: float) -> None:
    at, ranges = 0, []
    for size, gap in pieces:
        ranges.append((at + gap, at + gap + size))
        at += gap + size
    tasks = list(running._tasks(ranges, per_flight_s, 0.05))
    assert [n for start, stop in tasks for n in range(start, stop)] == [n for a, b in ranges for n in range(a, b)]
    starts = {start for start, _ in ranges}
    longest = max(1, round(0.05 / per_flight_s))
    assert all(stop - start <= longest for start, stop in tasks)
    if longest > LANES:
        assert all(start % LANES == 0 for start, _ in tasks if start not in starts)


@pytest.mark.parametrize("workers", [1, 2, 3])
def test_threads_and_one_range_fly_the_same_to_the_last_bit(workers: int) -> None:
    job = campaign()
    told: list[int] = []
    outcome = run(job, scheduler="none", workers=workers, told=told.append)
    assert equal(outcome.columns, fly_range(job, 0, job.flights))
    assert (outcome.flown, sum(told), outcome.workers) == (1000, 1000, workers)


def test_short_campaigns_are_cut_so_that_every_worker_has_some(monkeypatch: pytest.MonkeyPatch) -> None:
    cut: list[tuple[int, int]] = []

    def fly(job: Campaign, start: int, stop: int) -> Any:
        cut.append((start, stop))
        return fly_range(job, start, stop)

    monkeypatch.setattr(running, "fly", fly)
    monkeypatch.setattr(running, "_timed", lambda _job, ranges, _collected: (ranges, 1e-3))  # a second for all of it
    run(campaign(), scheduler="none", workers=4)
    assert len(cut) > 4 * 4


# -- the folder


def test_the_folder_reads_as_one_table_of_a_row_per_flight(tmp_path: Path) -> None:
    job = campaign()
    outcome = run(job, scheduler="none", workers=2, parts=parts_in(tmp_path / "new" / "out", job))
    table = pq.read_table(tmp_path / "new" / "out")  # as pandas does
    columns = {name: np.asarray(table[name]) for name in table.column_names}
    order = np.argsort(columns["flight"])
    assert equal({name: values[order] for name, values in columns.items()}, outcome.columns)
    assert columns["flight"][order].tolist() == list(range(1000))
    assert equal(outcome.columns, run(job, scheduler="none", workers=1).columns)
    assert columns.keys() >= {"diverged", "diverged_at", "gain", "rms_error", "max_error", "error_norm", "input_norm",
                              "max_state", "growth", "d_mean", "d_max", "outside", "changes", "gust_amplitude",
                              "gust_period_s", "reference_amplitude", "reference_period_s"}  # fmt: skip


def test_a_larger_campaign_goes_on_where_the_smaller_one_ended(tmp_path: Path) -> None:
    job, larger = campaign(), campaign(flights=1500)
    run(job, scheduler="none", workers=1, parts=parts_in(tmp_path, job))
    before = {path: path.stat().st_mtime_ns for path in tmp_path.glob("flights-*")}
    outcome = run(larger, scheduler="none", workers=2, parts=parts_in(tmp_path, larger))
    assert outcome.flown == 500
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert equal(outcome.columns, fly_range(larger, 0, 1500))
    again = run(job, scheduler="none", workers=1, parts=parts_in(tmp_path, job))
    assert again.flown == 0
    assert equal(again.columns, fly_range(job, 0, 1000))


@pytest.mark.parametrize("damage", ["cut", "emptied", "gone", "scribbled", "renamed"])
def test_what_is_damaged_is_flown_again_and_the_rest_is_not(tmp_path: Path, damage: str) -> None:
    job = campaign()
    first = run(job, scheduler="none", workers=1, parts=parts_in(tmp_path, job))
    [*_, victim] = sorted(tmp_path.glob("flights-*"))
    start, stop = map(int, victim.stem.split("-")[1:])
    content = victim.read_bytes()
    match damage:
        case "cut":
            victim.write_bytes(content[: len(content) // 2])
        case "emptied":
            victim.write_bytes(b"")
        case "gone":
            victim.unlink()
        case "scribbled":  # where the columns are: the footer is whole
            victim.write_bytes(content[:200] + b"\xff" * 200 + content[400:])
        case "renamed":  # to more flights than it has
            victim.rename(victim.with_name(f"flights-{start:012d}-{stop + 7:012d}.parquet"))
    (tmp_path / ".flights-000000000000-000000000064.77.tmp").write_bytes(b"half a part")
    again = run(job, scheduler="none", workers=1, parts=parts_in(tmp_path, job))
    assert again.flown == stop - start
    assert equal(again.columns, first.columns)
    assert pq.read_table(tmp_path).num_rows == 1000  # what is of no use is passed over by other tools, too


@pytest.mark.parametrize("wrong", ["flights", "columns"])
def test_a_part_of_other_flights_or_columns_than_its_name_says_is_put_aside(tmp_path: Path, wrong: str) -> None:
    job = campaign(flights=100)
    parts = parts_in(tmp_path, job)
    parts.write(0, 50, fly_range(job, 0, 50))
    table = fly_range(job, 0, 50) if wrong == "flights" else fly_range(job, 50, 100)
    parts.write(50, 100, {name: column for name, column in table.items() if wrong == "flights" or name != "growth"})
    again = parts_in(tmp_path, job)
    outcome = run(job, scheduler="none", workers=1, parts=again)
    assert (outcome.flown, again.aside) == (50, 1)
    assert equal(outcome.columns, fly_range(job, 0, 100))


def test_parts_that_overlap_count_once(tmp_path: Path) -> None:
    job = campaign(flights=200)
    parts = parts_in(tmp_path, job)
    for start, stop in ((0, 100), (50, 150), (150, 200)):
        parts.write(start, stop, fly_range(job, start, stop))
    outcome = run(job, scheduler="none", workers=1, parts=parts_in(tmp_path, job))
    assert outcome.flown == 50
    assert equal(outcome.columns, fly_range(job, 0, 200))
    assert sorted(np.asarray(pq.read_table(tmp_path)["flight"]).tolist()) == list(range(200))


@pytest.mark.parametrize(
    "change",
    [{"seed": 4}, {"samples": 101}, {"d_max": 5}, {"x0": 0.1}, {"limits": True}, {"delta": Span(0.0, 0.1)},
     {"gust": parse_signal("none", "gust")}, {"transitions": "fifo"}, {"plant_name": "sixdof:hirm"}],
)  # fmt: skip
def test_results_of_another_campaign_are_left_alone(tmp_path: Path, change: dict[str, Any]) -> None:
    parts_in(tmp_path, campaign())
    with pytest.raises(InputError, match="another"):
        parts_in(tmp_path, campaign(**change))
    parts_in(tmp_path, campaign(flights=5))  # how many there are does not tell campaigns apart


def of_plant(**changes: Any) -> Campaign:
    base = campaign(limits=True)
    return replace(base, plant=replace(base.plant, **changes))


def test_a_plant_that_differs_in_anything_that_flies_is_another_campaign() -> None:
    plant = campaign().plant
    assert plant.actuator is not None
    assert plant.actuator.low is not None
    others = [
        of_plant(actuator=None),
        of_plant(actuator=replace(plant.actuator, low=1.0001 * plant.actuator.low)),
        of_plant(trim=replace(plant.trim, u=plant.trim.u + 1e-3)),
        of_plant(trim=replace(plant.trim, x=plant.trim.x + 1e-3)),
        of_plant(A=plant.A * (1.0 + 1e-12)),  # less than a proof tells apart
        of_plant(),
    ]
    law = campaign().law
    assert isinstance(law, Gains)
    others += [campaign(law=replace(law, K1=law.K1 * (1.0 + 1e-12))), campaign(law=replace(law, d_max=5))]
    reference = law.model.reference
    assert reference is not None
    other_reference = replace(law.model, reference=replace(reference, Br=reference.Br * (1.0 + 1e-12)))
    others += [campaign(law=replace(law, model=other_reference))]
    assert len({identity(one) for one in others}) == len(others)


def test_names_notes_and_certificates_do_not_tell_campaigns_apart() -> None:
    base = campaign()
    assert isinstance(base.law, Gains)
    renamed = replace(base.law, name="other", certificate=None, model=replace(base.law.model, name="copy"))
    again = campaign(law=renamed, plant=replace(base.plant, name="copy"), plant_name="copy.toml")
    assert identity(again) == identity(base)


def test_an_aircraft_file_that_changed_is_another_campaign(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    stored = stored_aircraft()["hirm"].read_text()
    path.write_text(stored)
    before = identity(campaign(plant_name=f"sixdof:{path}"))
    path.write_text(f"# a note\n{stored}")
    assert identity(campaign(plant_name=f"sixdof:{path}")) == before
    first = next(line for line in stored.splitlines() if line.startswith("thrust"))
    path.write_text(stored.replace(first, "thrust = 12345.0"))
    assert identity(campaign(plant_name=f"sixdof:{path}")) != before


def test_a_folder_of_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("no results")
    with pytest.raises(InputError, match="other files"):
        parts_in(tmp_path, campaign())
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize("content", [b"", b"[]", b"{}", b"{", orjson.dumps({"identity": None})])
def test_a_description_that_is_none_is_refused_on_one_line(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "_campaign.json").write_bytes(content)
    with pytest.raises(InputError) as refused:
        parts_in(tmp_path, campaign())
    assert "\n" not in str(refused.value)


def test_a_file_in_the_folders_place_is_refused(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("a file")
    with pytest.raises(InputError, match="expected a folder"):
        parts_in(tmp_path / "out", campaign())


def test_more_flights_than_memory_holds_want_a_folder() -> None:
    with pytest.raises(InputError, match="-o"):
        run(campaign(flights=MAX_ROWS_KEPT + 1), scheduler="none", workers=1)


def test_a_part_is_there_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job = campaign(flights=10)
    parts = parts_in(tmp_path, job)

    def write_half(_table: pa.Table, where: Path, **_: Any) -> None:
        where.write_bytes(b"PAR1half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(pq, "write_table", write_half)
    with pytest.raises(InputError, match="No space left"):
        parts.write(0, 10, fly_range(job, 0, 10))
    assert [path.name for path in tmp_path.iterdir()] == ["_campaign.json"]
    assert parts_in(tmp_path, job).found(()) == []
