"""The questions: every one can be answered otherwise, names real files, and says where its belief is from."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import pytest

from bench.target import EMBEDDED, Target
from station.cloud import Cloud
from verify.check import Basis, Verdict, ask
from verify.checks import ALL
from verify.errors import CannotAskError, VerifyError

ROOT = Path(__file__).resolve().parents[2]
CHECKS = pytest.mark.parametrize("check", ALL, ids=lambda check: check.name)


@pytest.fixture
def verdict(tmp_path):
    """The verdict on an answer."""

    def judge(check, seen):
        def answer(_target):
            if isinstance(seen, Exception):
                raise seen
            return seen

        clock = itertools.count().__next__
        asked = replace(check, ask=answer, not_embedded="")
        return ask(asked, Target(EMBEDDED, Cloud(), tmp_path), clock).verdict

    return judge


@CHECKS
def test_a_question_says_what_it_rests_on(check):
    assert check.assumed.endswith(".")
    assert check.relied_on_by
    assert [file for file in check.relied_on_by if not (ROOT / file).is_file()] == []
    urls = [url for url in check.source.split() if url != "and"]
    assert all(url.startswith("https://docs.aws.amazon.com/") for url in urls)
    assert bool(urls) == (check.basis is Basis.DOCUMENTED)


def test_no_two_questions_have_one_name():
    names = [check.name for check in ALL]
    assert len(set(names)) == len(names)


@CHECKS
def test_every_expected_value_decides(check, verdict):
    informational = dict.fromkeys(check.informational, "whatever was seen")
    assert not set(informational) & set(check.expected)
    assert verdict(check, {**check.expected, **informational}) is Verdict.AS_ASSUMED
    assert check.expected
    for name in check.expected:
        wrong = {**check.expected, name: "another value"}
        assert verdict(check, wrong) is Verdict.DIFFERS, name
        del wrong[name]
        assert verdict(check, wrong) is Verdict.DIFFERS, name
    assert verdict(check, {**check.expected, "a key more": 1}) is Verdict.DIFFERS


def test_what_goes_wrong_is_an_answer(verdict):
    assert verdict(ALL[0], CannotAskError("no keys")) is Verdict.NOT_ASKED
    assert verdict(ALL[0], VerifyError("nothing came")) is Verdict.FAILED
