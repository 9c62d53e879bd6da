"""The verdicts of a flight as a JUnit report, which GitLab, Jenkins and GitHub's readers show beside other tests.

One test suite per flight, one test case per check. A check that failed is a *failure*; a flight that came to nothing,
or was interrupted, is an *error* of one more case, so that a report without verdicts is not taken for a success. The
numbers of the summary are properties of the suite. Elements and attributes are those of the Jenkins schema
(junit-10.xsd), which the other readers accept. Nothing of the wall clock goes in: equal flights make equal reports but
for the seconds that they took.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from junitparser import Error, Failure, JUnitXml, TestCase, TestSuite

from gains.table import InputError
from sitl.checks import Check
from sitl.summary import Verdict

__all__ = ["write_junit"]

FLIGHT_CASE = "the flight comes to its end"
MAX_PROPERTIES = 500
"""Numbers of a summary that a report holds."""

_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_JUDGED = ("checks", "title")
"""What of a summary is in the report already."""


def write_junit(
    path: str | Path,
    name: str,
    verdicts: Sequence[Verdict],
    summary: Mapping[str, object],
    seconds: float,
    *,
    error: str | None = None,
) -> None:
    """Write the report of one flight; a file of that name is replaced.

    Parameters
    ----------
    path : str or Path
    name : str
        The scenario's.
    verdicts : sequence of Verdict
        The checks of the flight.
    summary : Mapping
        As ``sitl fly --json`` prints it; empty where there is none.
    seconds : float
        How long it all took. The first case has all of it, since readers add up the times of the cases.
    error : str, optional
        Why there is no verdict on the whole flight.

    Raises
    ------
    InputError
        When the file cannot be written.
    """
    suite = TestSuite(_text(name))
    for key, value in _properties(summary):
        suite.add_property(_text(key), _text(value))
    if error is None and summary.get("interrupted"):
        error = "interrupted before its end: the checks were not judged"
    cases = [_case(name, FLIGHT_CASE, None if error is None else Error(_text(error), "flight"))]
    cases += [_case(name, verdict.check.name, _failure(verdict)) for verdict in verdicts]
    cases[0].time = round(seconds, 3)
    suite.add_testcases(cases)
    suite.update_statistics()  # type: ignore[no-untyped-call]
    suite.time = round(seconds, 3)
    report = JUnitXml()
    report.add_testsuite(suite)
    for attribute in ("tests", "failures", "errors", "time"):  # of the root; its schema knows no "skipped"
        setattr(report, attribute, getattr(suite, attribute))
    try:
        Path(path).write_bytes(b'<?xml version="1.0" encoding="UTF-8"?>\n' + report.tostring() + b"\n")  # type: ignore[no-untyped-call]
    except OSError as failure:
        raise InputError(f"{path}: expected a file that can be written, found: {failure.strerror}") from None


def _case(suite: str, name: str, result: Failure | Error | None) -> TestCase:
    case = TestCase(_text(name), _text(f"sitl.{suite}"), 0.0)
    if result is not None:
        case.result = [result]
    return case


def _failure(verdict: Verdict) -> Failure | None:
    """Return what a failed check is in the report; None for one that passed."""
    if verdict.passed:
        return None
    check, value = verdict.check, verdict.value
    found = f"{value:.6g}" if isinstance(value, float) else "nothing" if value is None else str(value)
    return Failure(_text(f"{check.metric}: expected {_expected(check)}, found {found}"), "check")


def _expected(check: Check) -> str:
    bounds = [check.equals] if check.equals is not None else []
    bounds += [f"at least {check.at_least:g}"] if check.at_least is not None else []
    bounds += [f"at most {check.at_most:g}"] if check.at_most is not None else []
    return " and ".join(bounds) or "false"


def _properties(summary: Mapping[str, object]) -> Iterator[tuple[str, str]]:
    """Yield the numbers and words of a summary by their dotted paths, at most ``MAX_PROPERTIES``."""
    left = MAX_PROPERTIES
    for key, value in _leaves({key: value for key, value in summary.items() if key not in _JUDGED}, ""):
        if not left:
            return
        left -= 1
        yield key, value


def _leaves(values: Mapping[str, object], prefix: str) -> Iterator[tuple[str, str]]:
    for key, value in values.items():
        match value:
            case Mapping():
                yield from _leaves(value, f"{prefix}{key}.")
            case bool():
                yield prefix + key, str(value).lower()
            case int() | str():
                yield prefix + key, str(value)
            case float():
                yield prefix + key, repr(value)
            case _:
                pass  # a list is none of a reader's business, and nothing is nothing


def _text(text: str) -> str:
    """Return a text with what XML cannot hold written as an escape."""
    return _NOT_XML.sub(lambda found: ascii(found[0])[1:-1], text)
