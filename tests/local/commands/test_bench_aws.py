"""`make bench TARGET=aws`, tested on the embedded cloud's services as far as possible without an account."""

from __future__ import annotations

import argparse
import io
import json

import pytest
from botocore.exceptions import ClientError

from bench import run
from iort_station.fleet import robots
from testkit.target import AWS, open_target


def options(tmp_path, *only: str, yes: bool):
    return argparse.Namespace(only=list(only), values=[], target=AWS, namespace="iort", yes=yes, out=tmp_path)


def test_a_failed_removal_does_not_prevent_the_removal_of_other_robots(embedded):
    said = []
    with open_target(AWS, cloud=embedded.cloud, say=said.append) as target:
        kept, other = target.robot("bench-one").robot, target.robot("bench-other").robot
        # Another client removes the robot first.
        robots.remove(embedded.cloud, other)
    assert any(f"{other} could not be removed" in line for line in said)
    with pytest.raises(ClientError):
        embedded.cloud.client("iot").describe_thing(thingName=kept)


def test_a_run_without_consent_spends_nothing(embedded, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("sys.stdin", io.StringIO())
    before = embedded.cloud.client("iot").list_things()["things"]
    with pytest.raises(SystemExit) as ended:
        run.run(options(tmp_path, "cost", "command", yes=False), embedded.cloud)
    assert ended.value.code == 2
    said = capsys.readouterr().out
    assert "This costs about $0.0" in said
    assert "--yes" in said
    assert embedded.cloud.client("iot").list_things()["things"] == before
    assert not list(tmp_path.iterdir())


def test_the_report_names_its_target(embedded, tmp_path):
    with pytest.raises(SystemExit) as ended:
        run.run(options(tmp_path, "cost", "fleet", yes=True), embedded.cloud)
    # The cost at the full live rate misses its target.
    assert ended.value.code in {0, 1}
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["target"] == AWS
    cost, fleet = report["sections"]
    assert cost["ratios"]
    assert "Not run on AWS" in fleet["notes"][0]
