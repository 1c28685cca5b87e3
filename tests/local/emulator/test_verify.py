"""Every question of `make verify-aws`: the embedded cloud answers as assumed of AWS, or as measured on
AWS.
"""

from __future__ import annotations

import argparse
import errno
import io
import json
import signal
import sys
import time
from dataclasses import replace

import pytest

from iort_contract.tables import ROBOT
from iort_station.errors import StationError
from iort_station.fleet import robots
from iort_station.page.page import load_keys
from testkit.target import AWS, EMBEDDED, Target
from testkit.waiting import InstrumentError
from verify import report, run
from verify.deployment import CHANGES
from verify.question import CHANGED, ENDED, Question, Verdict, ask
from verify.questions import ALL

RULES = tuple(one for one in ALL if one.subject == "rules")


@pytest.fixture(scope="module")
def target(embedded, tmp_path_factory):
    target = Target(EMBEDDED, embedded.cloud, tmp_path_factory.mktemp("verify"), embedded, run="verify")
    yield target
    target.remove_robots(print)


@pytest.mark.heavy
@pytest.mark.parametrize("check", [one for one in ALL if not one.not_embedded], ids=lambda check: check.name)
def test_the_embedded_cloud_answers_as_assumed_or_measured(target, check):
    answer = ask(check, target, time.monotonic, report.load().seen.get(check.name))
    assert answer.verdict is Verdict.AS_ASSUMED, (answer.reason, answer.seen)


class Recorder:
    """An existing deployment that records its calls."""

    def __init__(self) -> None:
        self.told = []

    def deploy(self, settings):
        self.told.append(dict(settings))

    def destroy(self):
        self.told.append("destroyed")
        return []


def options(out, **given):
    return argparse.Namespace(
        **{
            "target": AWS,
            "only": RULES,
            "namespace": "iort",
            "out": out,
            "by": "",
            "yes": True,
            "keep": False,
            **given,
        }
    )


def test_a_run_deploys_queries_reports_and_destroys(embedded, tmp_path):
    recorder = Recorder()
    assert run.run(options(tmp_path), embedded.cloud, recorder) == 0
    assert recorder.told == [{}, "destroyed"]
    written = json.loads((tmp_path / "report.json").read_text())
    assert {one["verdict"] for one in written["answers"]} == {"as assumed"}
    assert "fine: stacks: 8 of 10 are there, each can be updated" in written["preflight"]
    assert "000000000000" not in json.dumps(written["preflight"])
    assert report.load(tmp_path / "report.json").seen.keys() == {one.name for one in RULES}


def test_a_run_without_consent_deploys_nothing(embedded, tmp_path):
    recorder = Recorder()
    with pytest.raises(InstrumentError, match="no terminal to ask"):
        run.run(options(tmp_path, yes=False), embedded.cloud, recorder)
    assert recorder.told == []


def test_a_failed_run_is_destroyed_and_its_answers_are_reported(embedded, tmp_path):
    class Failing(Recorder):
        def deploy(self, settings):
            super().deploy(settings)
            if settings:
                raise InstrumentError("cdk deploy failed")

    recorder, first = Failing(), RULES[0]
    with_key = replace(first, name="a.question", phase=CHANGED)
    with pytest.raises(InstrumentError, match="cdk deploy failed"):
        run.run(options(tmp_path, only=(first, with_key)), embedded.cloud, recorder)
    assert recorder.told == [{}, CHANGES, "destroyed"]
    assert len(json.loads((tmp_path / "report.json").read_text())["answers"]) == 1


def question(name, seen, ask):
    return Question(name=name, assumed="It is.", expected=seen, ask=ask)


def test_a_run_lends_pubnub_keys_to_every_question(embedded, tmp_path):
    cloud = replace(embedded.cloud, namespace="other")
    lent = question("a.question", {"lent": True}, lambda target: {"lent": bool(load_keys(target.cloud))})
    assert run.run(options(tmp_path, only=(lent,)), cloud, Recorder()) == 0
    with pytest.raises(StationError, match="not stored yet"):
        load_keys(cloud)


def test_the_last_questions_may_take_the_deployment_down(embedded, tmp_path):
    last = replace(
        question("a.question", {"left": []}, lambda lab: {"left": lab.target.destroy()}), phase=ENDED
    )
    recorder = Recorder()
    assert run.run(options(tmp_path, only=(RULES[0], last)), embedded.cloud, recorder) == 0
    # Once more, for what another run could have left.
    assert recorder.told == [{}, "destroyed", "destroyed"]


class ClosedTerminal(io.StringIO):
    """A closed terminal."""

    def write(self, _text):
        raise OSError(errno.EIO, "Input/output error")


def test_a_closed_terminal_does_not_stop_the_teardown(embedded, tmp_path, monkeypatch):
    def ask(target):
        target.robot("verify-gone")
        monkeypatch.setattr(sys, "stdout", ClosedTerminal())
        signal.raise_signal(signal.SIGHUP)

    recorder = Recorder()
    only = (question("a.question", {}, ask),)
    with pytest.raises(KeyboardInterrupt):
        run.run(options(tmp_path, only=only), embedded.cloud, recorder)
    assert recorder.told == [{}, "destroyed"]
    assert not [row for row in robots.listed(embedded.cloud) if row[ROBOT].startswith("verify-gone")]


def test_partial_answers_do_not_replace_complete_answers(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["verify", "--keep", "--only", "rules"])
    with pytest.raises(SystemExit):
        run.main()
    assert "leave --only away" in capsys.readouterr().err
