"""The JUnit report, held to the rules of the Jenkins schema and read by parsers that did not write it."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest
from lxml import etree

import sitl.__main__
import sitl.scenario
from gains.command import run
from gains.table import InputError
from sitl.checks import Check
from sitl.junit import FLIGHT_CASE, MAX_PROPERTIES, write_junit
from sitl.summary import Verdict

CHILDREN = {
    "testsuites": {"testsuite"},
    "testsuite": {"testsuite", "properties", "testcase", "system-out", "system-err"},
    "properties": {"property"},
    "property": set(),
    "testcase": {"skipped", "error", "failure", "system-out", "system-err"},
    "failure": set(),
    "error": set(),
}
"""By junit-10.xsd: what may stand in what, as far as a report of ours goes."""
REQUIRED = {"testsuite": {"name", "tests", "failures", "errors"}, "testcase": {"name"}, "property": {"name", "value"}}
OPTIONAL = {
    "testsuites": {"name", "time", "tests", "failures", "errors"},
    "testsuite": {
        "group",
        "time",
        "skipped",
        "timestamp",
        "hostname",
        "id",
        "package",
        "file",
        "log",
        "url",
        "version",
    },
    "testcase": {"time", "classname", "group"},
    "failure": {"type", "message"},
    "error": {"type", "message"},
}
TIME = re.compile(r"[0-9]*(\.[0-9]{0,3})?")

PASSED = Verdict(Check("stays up", "diverged"), False, True)
TOO_LARGE = Verdict(Check("tracks", "rms_error_rad", at_most=0.002), 0.25, False)
MISSING = Verdict(Check("hears & <sees>", "delay.covered_fraction", at_least=0.9, at_most=1.0), None, False)
WORD = Verdict(Check("ends\x00 in TRACKING", "mode_at_end", equals="TRACKING"), "HOLD\x1b", False)
SUMMARY = {
    "scenario": "nominal",
    "samples": 400,
    "diverged": False,
    "conservative": None,
    "delay": {"within_one_fraction": 1.0, "true_histogram": {"1": 3}},
    "failsafe_transitions": ["STANDBY to TRACKING"],
    "checks": [{"name": "told elsewhere"}],
}


def check_schema(path: Path) -> ElementTree.Element:
    """Return the root of a report after checking each element of it against the rules."""
    root = ElementTree.parse(path).getroot()
    assert root.tag == "testsuites"
    for element in root.iter():
        assert {child.tag for child in element} <= CHILDREN[element.tag], element.tag
        required, optional = REQUIRED.get(element.tag, set()), OPTIONAL.get(element.tag, set())
        assert required <= element.attrib.keys() <= required | optional, element.tag
        if element.tag != "testcase":  # there it may be any text
            assert TIME.fullmatch(element.get("time", "")), element.get("time")
    for suite in (root, *root.iter("testsuite")):
        cases = list(suite.iter("testcase"))
        assert int(suite.get("tests", "")) == len(cases)
        for counted, tag in (("failures", "failure"), ("errors", "error")):
            assert int(suite.get(counted, "")) == sum(case.find(tag) is not None for case in cases)
    return root


def test_each_check_is_a_case_and_a_failed_one_says_what_was_expected_and_found(tmp_path: Path) -> None:
    write_junit(tmp_path / "report.xml", "nominal", [PASSED, TOO_LARGE, MISSING, WORD], SUMMARY, 12.34567)
    root = check_schema(tmp_path / "report.xml")
    assert (root.get("tests"), root.get("failures"), root.get("errors")) == ("5", "3", "0")
    told = {case.get("name"): [(r.tag, r.get("message")) for r in case] for case in root.iter("testcase")}
    assert told == {
        FLIGHT_CASE: [],
        "stays up": [],
        "tracks": [("failure", "rms_error_rad: expected at most 0.002, found 0.25")],
        "hears & <sees>": [
            ("failure", "delay.covered_fraction: expected at least 0.9 and at most 1, found nothing"),
        ],
        "ends\\x00 in TRACKING": [("failure", "mode_at_end: expected TRACKING, found HOLD\\x1b")],
    }
    times = [float(case.get("time", "")) for case in root.iter("testcase")]
    assert sum(times) == float(root.get("time", "")) == 12.346


def test_the_numbers_of_the_summary_are_properties_of_the_suite(tmp_path: Path) -> None:
    write_junit(tmp_path / "report.xml", "nominal", [PASSED], SUMMARY, 1.0)
    root = check_schema(tmp_path / "report.xml")
    assert {p.get("name"): p.get("value") for p in root.iter("property")} == {
        "scenario": "nominal",
        "samples": "400",
        "diverged": "false",
        "delay.within_one_fraction": "1.0",
        "delay.true_histogram.1": "3",
    }
    write_junit(tmp_path / "many.xml", "many", [PASSED], {f"n{i}": i for i in range(2 * MAX_PROPERTIES)}, 1.0)
    assert len(list(check_schema(tmp_path / "many.xml").iter("property"))) == MAX_PROPERTIES


@pytest.mark.parametrize(
    ("summary", "error", "told"),
    [({}, "no sample within 20 s", "no sample"), ({"interrupted": True}, None, "interrupted")],
    ids=["failed", "interrupted"],
)
def test_a_flight_without_verdicts_is_no_success(
    tmp_path: Path, summary: dict[str, object], error: str | None, told: str
) -> None:
    write_junit(tmp_path / "report.xml", "nominal", [], summary, 1.0, error=error)
    root = check_schema(tmp_path / "report.xml")
    assert (root.get("tests"), root.get("errors")) == ("1", "1")
    (found,) = root.iter("error")
    assert told in found.get("message", "")


def test_another_parser_reads_the_same(tmp_path: Path) -> None:
    write_junit(tmp_path / "report.xml", "größer ☃ \U0001f6e9", [TOO_LARGE, WORD], SUMMARY, 3.0)
    ours = ElementTree.parse(tmp_path / "report.xml").getroot()
    theirs = etree.parse(tmp_path / "report.xml").getroot()
    assert [(e.tag, dict(e.attrib), e.text) for e in ours.iter()] == [
        (e.tag, dict(e.attrib), e.text) for e in theirs.iter()
    ]
    assert next(ours.iter("testsuite")).get("name") == "größer ☃ \U0001f6e9"


def test_a_report_that_cannot_be_written_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="a file that can be written"):
        write_junit(tmp_path, "nominal", [PASSED], {}, 1.0)


def test_a_flight_writes_it_and_a_folder_that_is_not_there_is_refused_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fly(report: Path) -> object:
        words = ["--virtual", "--gcs", "none", "--out", str(tmp_path / "out"), "--duration", "0.5"]
        monkeypatch.setattr(sys, "argv", ["sitl", "fly", "nominal", *words, "--junit", str(report)])
        with pytest.raises(SystemExit) as ended:
            run(sitl.__main__.cli, "sitl")
        return ended.value.code

    assert fly(tmp_path / "none" / "report.xml") == 2
    assert "expected a file in a folder that is there" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    fly(tmp_path / "report.xml")
    root = check_schema(tmp_path / "report.xml")
    assert int(root.get("tests", "")) == 1 + 1 + len(sitl.scenario.load_scenario("nominal").checks)
    assert {p.get("name"): p.get("value") for p in root.iter("property")}["samples"] == "20"
