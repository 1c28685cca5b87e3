"""Another answer changes a verdict: tests/local/emulator/test_verify_differs.py has clouds that give one."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest

from iort_station.cloud import Cloud
from testkit.target import EMBEDDED, Target
from verify.question import NOTE, Verdict, ask, compared
from verify.questions import ALL


@pytest.fixture
def verdict(tmp_path):
    """The verdict for an answer."""

    def judge(check, seen):
        asked = replace(check, ask=lambda _target: seen, not_embedded="")
        return ask(asked, Target(EMBEDDED, Cloud(), tmp_path), itertools.count().__next__).verdict

    return judge


@pytest.mark.parametrize("check", ALL, ids=lambda check: check.name)
def test_every_expected_value_decides_the_verdict_and_a_note_does_not(check, verdict):
    assert check.expected
    assert compared(check.expected) == check.expected
    assert verdict(check, {**check.expected, f"{NOTE}beside": "whatever"}) is Verdict.AS_ASSUMED
    for name in check.expected:
        wrong = {**check.expected, name: "another value"}
        assert verdict(check, wrong) is Verdict.DIFFERS, name
        del wrong[name]
        assert verdict(check, wrong) is Verdict.DIFFERS, name
    assert verdict(check, {**check.expected, "a key more": 1}) is Verdict.DIFFERS
