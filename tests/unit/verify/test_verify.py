"""The verdicts and reports of verify, and the page of assumptions."""

from __future__ import annotations

import itertools
import json

import pytest

from iort_station.cloud import Cloud
from local.deployment import ROOT
from testkit.target import AWS, EMBEDDED, Target
from testkit.waiting import InstrumentError
from verify import report
from verify.question import CannotAskError, Question, Verdict, ask
from verify.questions import ALL

RUN = report.Run(target="AWS", region="eu-west-1", by="A. Tester", date="2026-01-01", version="abc")


def check(answer, **given):
    def asked(_target):
        if isinstance(answer, Exception):
            raise answer
        return answer

    usual = {"name": "a.question", "assumed": "One is one.", "expected": {"one": 1}}
    return Question(**{**usual, "ask": asked, **given})


def verdict(check, kind=AWS, expected=None):
    clock = itertools.count().__next__
    return ask(check, Target(kind, Cloud(), ROOT), clock, expected)


def test_an_answer_is_compared_with_the_assumption():
    assert verdict(check({"one": 1})).verdict is Verdict.AS_ASSUMED
    assert verdict(check({"one": 2})).verdict is Verdict.DIFFERS
    assert verdict(check({"one": 1, "two": 2})).verdict is Verdict.DIFFERS


def test_an_answer_of_aws_replaces_the_assumption():
    assert verdict(check({"one": 2}), expected={"one": 2}).verdict is Verdict.AS_ASSUMED
    assert verdict(check({"one": 1}), expected={"one": 2}).verdict is Verdict.DIFFERS


def test_a_note_is_reported_and_not_compared(tmp_path):
    noted = verdict(check({"one": 1, "note_version": "1.2"}))
    assert noted.verdict is Verdict.AS_ASSUMED
    known = {"one": 1, "note_version": "1.1"}
    assert verdict(check({"one": 1, "note_version": "1.2"}), expected=known).verdict is Verdict.AS_ASSUMED
    other = verdict(check({"one": 2, "note_version": "1.2"}))
    assert other.verdict is Verdict.DIFFERS
    assert report.differences(other) == [("one", "1", "2")]
    report.write(tmp_path, RUN, [noted])
    assert 'version "1.2"' in (tmp_path / "report.md").read_text()


@pytest.mark.parametrize(
    "error", [InstrumentError("no answer"), OSError("connection reset"), KeyError("another form")]
)
def test_an_error_is_reported_as_the_answer(error):
    answer = verdict(check(error))
    assert answer.verdict is Verdict.FAILED
    assert str(error) in answer.reason


def test_a_question_that_cannot_be_asked_has_its_reason():
    assert verdict(check(CannotAskError("no keys"))).reason == "no keys"
    answer = verdict(check({"one": 1}, not_embedded="no KMS"), kind=EMBEDDED)
    assert (answer.verdict, answer.reason) == (Verdict.NOT_ASKED, "no KMS")
    assert verdict(check({"one": 1}, not_embedded="no KMS")).verdict is Verdict.AS_ASSUMED


def test_a_kept_report_is_read_back(tmp_path):
    report.write(
        tmp_path, RUN, [verdict(check({"one": 2})), verdict(check(InstrumentError("x"), name="b.question"))]
    )
    known = report.load(tmp_path / "report.json")
    assert (known.by, known.seen) == ("A. Tester", {"a.question": {"one": 2}})
    text = (tmp_path / "report.md").read_text()
    assert "1 differs, 1 failed" in text
    assert "| one | 1 | 2 |" in text


def test_an_invalid_report_file_is_refused(tmp_path):
    (tmp_path / "report.json").write_text("[]")
    with pytest.raises(InstrumentError, match="must be a report of verify"):
        report.load(tmp_path / "report.json")


@pytest.mark.parametrize(
    "secret",
    [
        "123456789012",
        "AKIAIOSFODNN7EXAMPLE",
        "sub-c-12345678-abcd-4321",
        "-----BEGIN RSA PRIVATE KEY-----\nMIIE\n-----END RSA PRIVATE KEY-----",
        "X-Amz-Signature=0123abcd",
    ],
)
def test_a_report_contains_no_secret(tmp_path, secret):
    answers = [verdict(check({"one": f"a {secret} b"})), verdict(check(InstrumentError(f"a {secret} b")))]
    report.write(tmp_path, RUN, answers)
    for name in ("report.json", "report.md"):
        text = (tmp_path / name).read_text()
        assert secret.split("\n")[-1] not in text
        assert json.dumps(secret)[1:-1] not in text


def test_names_are_unique_and_every_row_has_a_basis():
    rows = report.rows(report.PAGE.read_text())
    names = [name for name, *_ in rows]
    assert len(names) == len(set(names)) > len(ALL)
    for _, _, basis, _ in rows:
        assert basis == "assumed" or basis.startswith(("documented: https://", "measured ("))


def test_the_page_lists_the_current_assumptions():
    written = report.PAGE.read_text()
    assert written == report.text(report.load(), written), "run `python -m verify.report`"


def test_the_page_names_the_person_who_measured():
    known = report.Measured(
        by="B", date="2026-02-02", region="eu-west-1", seen={ALL[0].name: ALL[0].expected}
    )
    text = report.text(known, report.PAGE.read_text())
    assert "measured by B on 2026-02-02" in text
    assert "measured (as assumed)" in text
