"""Findings, analysed drives, notes and a calibration, as their commands print them."""

from __future__ import annotations

import json
import time
from dataclasses import replace

import pytest
from typer.testing import CliRunner

from iort_analysis.baselines import combined
from iort_contract.catalog.analysis import ANALYSIS_FAILED
from iort_contract.catalog.derived import Vehicle
from iort_contract.findings_table import FindingsTable
from iort_contract.messages.analysis import AnalysedDrive, DriveKey, Estimate, Finding
from iort_contract.page import history_link
from iort_station.cli.main import app
from iort_station.cli.options import CloudOptions
from iort_station.cli.verbs import analysis as analyse
from iort_station.cloud import Cloud
from iort_station.data import findings, inventory
from iort_station.data import findings as stored
from iort_station.errors import StationError, UsageError
from iort_station.fleet import registry
from iort_station.operations import analysis
from iort_station.operations.analysis import RUNNING, SUCCEEDED, Progress
from iort_station.page import insights
from tests.unit.contract.test_messages import FIRST_NOTE_US, OneTable
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
    shares = {"battery_charge_left": Estimate(0.14, 0.07, 0.26, "1")}
    key = DriveKey("car7", 0, "0badcafe")

    said = iort([AnalysedDrive(key, 60_000_000, "job", 3000, shares, missing, {})])

    assert "battery_charge_left 14 % (7 to 26)" in said
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


@pytest.fixture
def table(monkeypatch):
    made = OneTable()
    monkeypatch.setattr(stored, "findings_table", lambda _cloud: FindingsTable(made, "findings"))
    monkeypatch.setattr(stored.registry, "get", lambda _cloud, _robot: {})
    return made


def test_the_page_writes_lists_and_deletes_notes(table):
    for at in (0, 60):
        asked = {"robot": "car7", "text": f" after {at} s ", "t_us": str(FIRST_NOTE_US + at * 1_000_000)}
        told = insights.write_note(None, asked)["notes"]
    assert [(one["t_us"] - FIRST_NOTE_US, one["text"]) for one in told] == [
        (60_000_000, "after 60 s"),
        (0, "after 0 s"),
    ]
    part = {"robot": "car7", "from_us": str(FIRST_NOTE_US), "to_us": str(FIRST_NOTE_US + 1)}
    assert [one["text"] for one in insights.notes(None, part)["notes"]] == ["after 0 s"]
    assert insights.remove_note(None, {"robot": "car7", "id": told[0]["id"]})["notes"] == told[1:]


def test_a_wrong_note_is_refused_and_nothing_is_written(table):
    with pytest.raises(UsageError, match="1 to 500 characters, got 501; nothing is written"):
        stored.write_note(None, "car7", "x" * 501, by="ada")
    with pytest.raises(UsageError, match="must be the id of a note"):
        stored.remove_note(None, "car7", "parameters#1")
    with pytest.raises(StationError, match="has no note"):
        stored.remove_note(None, "car7", f"{FIRST_NOTE_US}-00000000")
    assert table.items == {}


DAY_US = 86_400_000_000


def drive(day, **estimates):
    key = DriveKey("car7", day * DAY_US, "0badcafe")
    missing = {"motor_torque_nm_per_a": "needs the motor's number of pole pairs"}
    return AnalysedDrive(key, key.start_us + 9, "job", 500, estimates, missing, {})


def gain(value):
    return Estimate(value, value - 2, value + 2, "erpm per m/s")


@pytest.fixture
def calibrate(monkeypatch):
    def run(drives, *arguments, registered=4614.0):
        monkeypatch.setattr(CloudOptions, "cloud", lambda _self: None)
        monkeypatch.setattr(findings, "drives", lambda *_given, most: drives[:most])
        monkeypatch.setattr(registry, "vehicle_of", lambda *_given: Vehicle(registered, -180.4))
        done = CliRunner().invoke(app, ["calibrate", "car7", *arguments], env={"COLUMNS": "120"})
        return done.stdout, done.stderr + str(done.exception or "")

    return run


def test_the_drives_give_one_value_with_its_interval_and_lines_for_the_car(calibrate):
    drives = [drive(3, speed_to_erpm_gain=gain(4701.0)), drive(2, speed_to_erpm_gain=gain(4699.0)), drive(1)]
    said, told = calibrate(drives)

    assert "speed_to_erpm_gain: 4700.0  # 469" in said
    assert "speed_to_erpm_offset: -180.4" in said
    assert "no motor_torque_nm_per_a: needs the motor's number of pole pairs" in said
    assert "registered is 4614" in told
    content = json.loads(calibrate(drives, "--json")[0])
    assert content["parameters"]["speed_to_erpm_gain"]["drives"] == 2
    assert "registered" not in calibrate(drives, registered=4700.0)[1]


def test_a_state_is_that_of_the_newest_drive(calibrate):
    voltages = [Estimate(value, value - 0.01, value + 0.01, "V") for value in (11.2, 12.4)]
    drives = [drive(3 - i, battery_open_voltage_v=one) for i, one in enumerate(voltages)]
    found = json.loads(calibrate(drives, "--json")[0])["parameters"]["battery_open_voltage_v"]

    assert found["value"] == 11.2
    assert found["drives"] == 1


def test_the_reasons_of_all_drives_are_told_the_most_frequent_first(calibrate):
    short = [replace(drive(9 - i), missing={"effective_mass_kg": f"lasts {i} s"}) for i in range(2)]
    steady = [replace(drive(7 - i), missing={"effective_mass_kg": "hardly accelerates"}) for i in range(5)]

    def missing(drives):
        return json.loads(calibrate(drives, "--json")[0])["missing"]["effective_mass_kg"]

    assert missing([*short, *steady]) == "hardly accelerates (5 of 7 drives); lasts 0 s (2 of 7 drives)"
    # One reason needs no count, though its numbers differ.
    assert missing(short) == "lasts 0 s"


def test_a_robot_without_analysed_drives_is_told(calibrate):
    assert "car7 has no analysed drives" in calibrate([])[1]


def test_drives_that_disagree_widen_the_interval_and_such_that_agree_do_not_shrink_it_to_nothing():
    agree = combined([gain(4700.0)] * 4)
    assert agree.high - agree.low == pytest.approx(2.0, rel=0.01)
    differ = combined([gain(value) for value in (4650.0, 4700.0, 4750.0)])
    assert differ.low < 4650
    assert differ.high > 4750


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
