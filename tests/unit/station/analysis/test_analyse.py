"""`iort analyse`: what it says while it waits."""

from __future__ import annotations

import json
import time

import pytest
from typer.testing import CliRunner

from iort_contract.catalog.analysis.kinds import ANALYSIS_FAILED
from iort_contract.messages.analysis.findings import DriveKey, Finding
from iort_station.cli.cloud_options import CloudOptions
from iort_station.cli.main import app
from iort_station.cli.verbs.operations import analyse
from iort_station.data import findings, inventory
from iort_station.fleet import registry
from iort_station.operations import analysis
from iort_station.operations.analysis import RUNNING, SUCCEEDED, Progress

S = 1_000_000


@pytest.mark.parametrize(
    ("done", "told"),
    [
        (0, "0 of 40 drives"),
        (10, "10 of 40 drives, 0:01:30 left"),
        (40, "40 drives analysed; comparing them with earlier ones"),
    ],
)
def test_who_waits_sees_how_far_it_is(done, told):
    assert analyse.progress(Progress(RUNNING, 40, done), 30.0) == told


def failed(start_us, end_us):
    drive = DriveKey("car7", start_us, "0badcafe")
    return Finding(
        drive, ANALYSIS_FAILED, "warning", ANALYSIS_FAILED, start_us, end_us, "vesc", (), "no memory is left"
    )


def test_a_failed_drive_counts_that_began_before_the_range_and_goes_on_in_it(monkeypatch):
    kept = [failed(100 * S, 200 * S), failed(300 * S, 500 * S)]

    def stored(_cloud, _robot, start_us, end_us):
        return [one for one in kept if start_us <= one.drive.start_us < end_us]

    monkeypatch.setattr(CloudOptions, "cloud", lambda _self: None)
    monkeypatch.setattr(registry, "get", lambda *_given: {})
    monkeypatch.setattr(analysis, "start", lambda *_given: "arn:run")
    monkeypatch.setattr(analysis, "watch", lambda *_given: iter([Progress(SUCCEEDED, 1, 1)]))
    monkeypatch.setattr(findings, "findings", stored)
    between = ["--from", "1970-01-01T00:06:40Z", "--to", "1970-01-01T00:10:00Z"]

    done = CliRunner().invoke(app, ["analyse", "car7", *between, "--wait", "--json"])

    assert (done.exit_code, json.loads(done.stdout)["failed"]) == (1, 1)
    assert done.stderr == "iort: car7: no memory is left\n"


def test_all_drives_are_all_and_without_one_it_is_told_what_is_recorded(monkeypatch):
    requests = []
    monkeypatch.setattr(CloudOptions, "cloud", lambda _self: None)
    monkeypatch.setattr(registry, "get", lambda *_given: {})
    monkeypatch.setattr(analysis, "start", lambda _cloud, request: requests.append(request) or "arn:run")
    monkeypatch.setattr(analysis, "watch", lambda *_given: iter([Progress(SUCCEEDED)]))
    monkeypatch.setattr(findings, "findings", lambda *_given: [])
    monkeypatch.setattr(inventory, "streams_of", lambda _cloud, robot: ["vesc"] * (robot == "car7"))
    monkeypatch.setattr(inventory, "extent", lambda *_given: ("2019-05-01T10:00:00Z", "2019-05-01T11:00:00Z"))

    done = CliRunner().invoke(app, ["analyse", "car7", "car8", "--last", "all", "--wait"])

    (request,) = requests
    # A clock that is ahead may be stored, too.
    assert (request.start_us, request.end_us > (time.time() + 300 * 86_400) * S) == (0, True)
    assert "car7: no drives from 1970-01-01T00:00:00Z to " in done.stderr
    assert "it recorded from 2019-05-01T10:00:00Z to 2019-05-01T11:00:00Z" in done.stderr
    assert "car8: no drives: it has recorded nothing" in done.stderr
