"""`iort calibrate`, on analysed drives."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from typer.testing import CliRunner

from iort_analysis.evaluation.combined import combined
from iort_contract.catalog.derived import Vehicle
from iort_contract.messages.analysis.findings import DriveKey, Estimate
from iort_contract.messages.analysis.run import AnalysedDrive
from iort_station.cli.cloud_options import CloudOptions
from iort_station.cli.main import app
from iort_station.data import findings
from iort_station.fleet import registry

DAY_US = 86_400_000_000


def drive(day, **estimates):
    key = DriveKey("car7", day * DAY_US, "0badcafe")
    missing = {"motor_torque_nm_per_a": "needs the motor's number of pole pairs"}
    return AnalysedDrive(key, key.start_us + 9, "job", 500, estimates, missing, {})


def gain(value):
    return Estimate(value, value - 2, value + 2, "erpm per m/s")


@pytest.fixture
def iort(monkeypatch):
    def run(drives, *arguments, registered=4614.0):
        monkeypatch.setattr(CloudOptions, "cloud", lambda _self: None)
        monkeypatch.setattr(findings, "drives", lambda *_given, most: drives[:most])
        monkeypatch.setattr(registry, "vehicle_of", lambda *_given: Vehicle(registered, -180.4))
        done = CliRunner().invoke(app, ["calibrate", "car7", *arguments], env={"COLUMNS": "120"})
        return done.stdout, done.stderr + str(done.exception or "")

    return run


def test_the_drives_give_one_value_with_its_interval_and_lines_for_the_car(iort):
    drives = [drive(3, speed_to_erpm_gain=gain(4701.0)), drive(2, speed_to_erpm_gain=gain(4699.0)), drive(1)]
    said, told = iort(drives)

    assert "speed_to_erpm_gain: 4700.0  # 469" in said
    assert "speed_to_erpm_offset: -180.4" in said
    assert "no motor_torque_nm_per_a: needs the motor's number of pole pairs" in said
    assert "registered is 4614" in told
    content = json.loads(iort(drives, "--json")[0])
    assert content["parameters"]["speed_to_erpm_gain"]["drives"] == 2
    assert "registered" not in iort(drives, registered=4700.0)[1]


def test_a_state_is_that_of_the_newest_drive(iort):
    voltages = [Estimate(value, value - 0.01, value + 0.01, "V") for value in (11.2, 12.4)]
    drives = [drive(3 - i, battery_open_voltage_v=one) for i, one in enumerate(voltages)]
    found = json.loads(iort(drives, "--json")[0])["parameters"]["battery_open_voltage_v"]

    assert found["value"] == 11.2
    assert found["drives"] == 1


def test_the_reasons_of_all_drives_are_told_the_most_frequent_first(iort):
    short = [replace(drive(9 - i), missing={"effective_mass_kg": f"lasts {i} s"}) for i in range(2)]
    steady = [replace(drive(7 - i), missing={"effective_mass_kg": "hardly accelerates"}) for i in range(5)]

    def missing(drives):
        return json.loads(iort(drives, "--json")[0])["missing"]["effective_mass_kg"]

    assert missing([*short, *steady]) == "hardly accelerates (5 of 7 drives); lasts 0 s (2 of 7 drives)"
    # One reason needs no count, though its numbers differ.
    assert missing(short) == "lasts 0 s"


def test_a_robot_without_analysed_drives_is_told(iort):
    assert "car7 has no analysed drives" in iort([])[1]


def test_drives_that_disagree_widen_the_interval_and_such_that_agree_do_not_shrink_it_to_nothing():
    agree = combined([gain(4700.0)] * 4)
    assert agree.high - agree.low == pytest.approx(2.0, rel=0.01)
    differ = combined([gain(value) for value in (4650.0, 4700.0, 4750.0)])
    assert differ.low < 4650
    assert differ.high > 4750
