"""The fixtures as another project has them: pytest in a folder elsewhere, warnings as errors, a station of its own."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import pytest

from tests.integration.programs import eventually

pytestmark = pytest.mark.realtime

pytest_plugins = ("pytester",)

ROOT = Path(__file__).parents[2]

LIGHT = """
import sys

LOADED = set(sys.modules)  # as the first test is collected

def test_nothing_heavy_is_loaded_for_a_project_that_does_not_use_it():
    assert "sitl.pytest_plugin" in LOADED
    assert not LOADED & {"numpy", "scipy", "cvxpy", "click", "matplotlib", "mcap", "pymavlink"}
"""

PAIRS = """
import json
import subprocess
from pathlib import Path

import pytest
from pymavlink import mavutil
from sitl.pytest_plugin import FlightError

def children_of(*pids):
    table = subprocess.run(["ps", "-A", "-o", "pid=,ppid="], capture_output=True, text=True, check=True).stdout
    rows = [tuple(map(int, line.split())) for line in table.splitlines()]
    return [pid for pid, parent in rows if parent in pids]

def test_two_stations_hear_two_vehicles_and_the_test_fails(lagproof_pair):
    long = lagproof_pair(duration=600.0, gcs=True, link="lossy", seed=3)
    short = lagproof_pair("nominal", duration=0.5, gcs=True, up="delay=20ms", wait_arm=True)
    assert long.folder != short.folder
    assert long.gcs_address != short.gcs_address
    pairs = (long, short)
    stations = [mavutil.mavlink_connection("udpin:%s:%d" % pair.gcs_address) for pair in pairs]  # before any has flown
    for pair, station in zip(pairs, stations):
        heard = station.recv_match(type="HEARTBEAT", blocking=True, timeout=30)
        station.close()
        assert heard is not None, pair.log
        assert (heard.get_srcSystem(), heard.get_srcComponent()) == (1, 1)
    pids = children_of(long.pid)
    assert len(pids) == 3
    summary = short.wait(30.0)
    assert not short.running
    with pytest.raises(FlightError, match="not over within 0.01 s"):
        long.wait(0.01)
    assert long.running
    found = {"pids": [long.pid, short.pid, *pids], "short": summary, "long": str(long.folder), "log": long.log}
    found["files"] = [short.mcap.stat().st_size, short.tlog.stat().st_size]
    Path("found.json").write_text(json.dumps(found))
    raise AssertionError("as planned")

def test_what_cannot_fly_says_why_and_what_can_is_flown_in_virtual_time(lagproof_pair, lagproof_fly):
    wrong = lagproof_pair("nominale")
    summary = lagproof_fly("nominal", virtual=True, duration=0.25, seed=5)
    assert (summary["virtual"], summary["seed"], summary["samples"]) == (True, 5, 10)
    assert Path(summary["files"]["mcap"]).is_file()
    with pytest.raises(FlightError, match="nominale"):
        wrong.wait(30.0)
"""


def alive(pid: int) -> bool:
    """Whether a process runs; one that only waits for its parent's notice does not."""
    shown = subprocess.run(["ps", "-o", "stat=", "-p", str(pid)], capture_output=True, text=True, check=False).stdout
    return bool(shown.strip()) and not shown.startswith("Z")


@pytest.mark.skipif(os.name != "posix", reason="asks ps for processes")
def test_another_project_flies_pairs_side_by_side_and_a_failing_test_leaves_no_process_behind(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    pytester.makepyfile(test_1_light=LIGHT, test_2_pairs=PAIRS)
    (pytester.path / "sitl").mkdir()  # the other project has such a folder, too
    (pytester.path / "sitl" / "notes.txt").write_text("nothing to import\n")
    result = pytester.runpytest_subprocess("-W", "error", "-p", "no:cacheprovider")
    result.assert_outcomes(passed=2, failed=1)
    result.stdout.fnmatch_lines(["*AssertionError: as planned*"])
    found = json.loads((pytester.path / "found.json").read_text())
    assert len(found["pids"]) == 5
    eventually("all processes gone", lambda: not any(map(alive, found["pids"])), 10.0)
    assert found["short"]["samples"] == 20
    assert all(found["files"])
    ended = json.loads((Path(found["long"]) / "summary.json").read_bytes())
    assert ended["interrupted"]
    assert ended["seed"] == 3
