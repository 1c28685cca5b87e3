"""A robot says in its messages what only the cloud may say, in its neighbour's name: on the broker, by
its own certificate. tests/unit/test_spoofed_keys.py has the same where a payload's keys win."""

from __future__ import annotations

import time

import pytest

from bench.target import EMBEDDED, Target
from verify.check import Verdict, ask
from verify.checks import rules


@pytest.fixture(scope="module")
def target(embedded, tmp_path_factory):
    return Target(EMBEDDED, embedded.cloud, tmp_path_factory.mktemp("spoofed"), embedded, run="spoofed")


@pytest.mark.parametrize("check", rules.CHECKS, ids=lambda check: check.name)
def test_what_only_the_cloud_may_say_is_the_clouds(target, check):
    answer = ask(check, target, time.monotonic)
    assert (answer.verdict, answer.seen) == (Verdict.AS_ASSUMED, check.expected), answer.reason
