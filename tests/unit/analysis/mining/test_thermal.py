"""Motor and controller as they warm up in a drive."""

from __future__ import annotations

from dataclasses import replace

import pytest

from iort_analysis.mining.thermal import mine
from tests.unit.analysis.proven import SECONDS, proven


def test_two_bodies_settle_where_the_simulator_says() -> None:
    drive, truth = proven(1)
    mined = mine(drive)

    wind = 1 + truth["distance_m"] / SECONDS / 5
    watts_per_k = truth["motor_cooling_w_per_k"] * wind + truth["motor_to_board_w_per_k"]
    rise = 1.5 * truth["motor_resistance_ohm"] / watts_per_k
    assert mined.estimates["motor_rise_k_per_a2"].value == pytest.approx(rise, rel=0.15)
    ohm = truth["motor_resistance_ohm"] + truth["fet_resistance_ohm"]
    found = mined.estimates["motor_thermal_resistance_k_per_w"]
    assert found.low < rise / 1.5 / ohm < found.high
    assert mined.estimates["motor_final_degc"].value > truth["motor_degc"]
    assert "settles at" in mined.missing["motor_time_to_limit_s"]


def test_lost_cooling_raises_the_controllers_temperature_for_a_load() -> None:
    healthy, lost = (mine(proven(0, fault).drive).estimates for fault in ("", "cooling_lost"))

    assert "motor_rise_k_per_a2" not in healthy
    assert lost["controller_rise_k_per_a2"].low > 1.5 * healthy["controller_rise_k_per_a2"].high


def test_a_motor_on_its_way_to_the_limit_says_when() -> None:
    drive = proven(1).drive
    # Eight times the simulated motor's heat: it settles above the limit, and is not there yet.
    degc = drive.samples.columns["vesc.temp_motor"]
    hot = drive.samples._replace(
        columns={**drive.samples.columns, "vesc.temp_motor": 8 * (degc - degc[0]) + 20}
    )
    settled = mine(replace(drive, samples=hot)).estimates

    assert settled["motor_final_degc"].low > 85
    assert settled["motor_time_to_limit_s"].low >= 0
    assert settled["motor_time_to_limit_s"].high < 600


def test_a_drive_without_a_temperature_says_so() -> None:
    drive = proven(0).drive
    columns = {name: column for name, column in drive.samples.columns.items() if "temp" not in name}
    mined = mine(replace(drive, samples=drive.samples._replace(columns=columns)))

    assert not mined.estimates
    assert mined.missing["controller_rise_k_per_a2"] == "the drive has no such temperature"
