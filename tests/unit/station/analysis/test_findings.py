"""`iort findings`, on analysed drives."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from iort_contract.messages.analysis.findings import DriveKey, Estimate
from iort_contract.messages.analysis.run import AnalysedDrive
from iort_contract.page import history_link
from iort_station.cli.cloud_options import CloudOptions
from iort_station.cli.main import app
from iort_station.cloud import Cloud
from iort_station.data import findings
from iort_station.fleet import registry
from tests.unit.functions.test_analysis import finding

TOO_SHORT = "the drive must last 240 s"


@pytest.fixture
def iort(monkeypatch):
    def run(drives):
        monkeypatch.setattr(CloudOptions, "cloud", lambda _self: None)
        monkeypatch.setattr(registry, "get", lambda *_given: {})
        monkeypatch.setattr(findings, "drives", lambda *_given, most: drives[:most])
        done = CliRunner().invoke(app, ["findings", "car7", "--drives"], env={"COLUMNS": "120"})
        assert done.exit_code == 0, done.output
        return [" ".join(line.split()) for line in done.output.splitlines()]

    return run


def test_a_reason_that_many_share_is_said_once_and_a_share_is_in_percent(iort):
    missing = {"temperature_drift_k": TOO_SHORT, "vesc": "no motor controller", "controller_lag_s": TOO_SHORT}
    shares = {"style_standing_share": Estimate(0.14, 0.07, 0.26, "1")}
    key = DriveKey("car7", 0, "0badcafe")

    said = iort([AnalysedDrive(key, 60_000_000, "job", 3000, shares, missing, {})])

    assert "style_standing_share 14 % (7 to 26)" in said
    # A narrow terminal takes a second line.
    assert f"missing temperature_drift_k, controller_lag_s: {TOO_SHORT}" in " ".join(said)


@pytest.mark.parametrize(
    ("served", "options", "page"),
    [
        ("http://127.0.0.1:21047/", [], "http://127.0.0.1:21047/"),
        ("http://127.0.0.1:21047/", ["--page", "https://iort.lab:8444"], "https://iort.lab:8444/"),
        (None, [], ""),
    ],
)
def test_the_link_to_the_evidence_is_in_one_piece_and_names_the_page_that_is_served(
    monkeypatch, served, options, page
):
    monkeypatch.setattr(CloudOptions, "cloud", lambda _self: Cloud(page=served))
    one = finding()
    monkeypatch.setattr(findings, "findings", lambda *_given, most: [one][:most])
    done = CliRunner().invoke(app, ["findings", "car7", *options], env={"COLUMNS": "60"})
    assert f" evidence {history_link(page, one)}\n" in done.output


def test_a_range_without_an_analysed_drive_says_so(iort):
    assert "no drive in this range is analysed; `iort analyse` looks now" in iort([])
