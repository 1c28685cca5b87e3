"""The battery's parameters from a drive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from iort_analysis.mining.battery import mine
from tests.unit.analysis.proven import proven


def test_the_resistance_has_an_honest_interval() -> None:
    held = 0
    for car in range(6):
        drive, truth = proven(car)
        found = mine(drive).estimates["battery_resistance_ohm"]
        held += found.low < truth["battery_resistance_ohm"] < found.high
        assert found.high - found.low < 0.05 * found.value

    assert held >= 5


def test_a_charge_that_falls_while_the_load_grows_is_no_resistance() -> None:
    drive = proven(0).drive
    seconds = drive.seconds
    chance = np.random.default_rng(1)
    # Bursts of a second, each harder than the last.
    current = np.repeat(chance.uniform(0, 20, 1 + len(seconds) // 50), 50)[: len(seconds)]
    current *= seconds / seconds[-1]
    drawn_ah = np.cumsum(current) * 0.02 / 3600
    voltage = 12.0 - 3.0 * drawn_ah - 0.03 * current + chance.normal(0, 0.02, len(seconds))
    columns = {"vesc.current_input": current, "vesc.voltage_input": voltage.round(1)}
    found = mine(replace(drive, samples=drive.samples._replace(columns=columns))).estimates

    assert -np.polyfit(current, voltage, 1)[0] > 0.045
    assert found["battery_resistance_ohm"].value == pytest.approx(0.03, rel=0.02)
    assert found["battery_voltage_per_ah"].low < 3.0 < found["battery_voltage_per_ah"].high


def test_the_open_voltage_is_given_against_the_charge_drawn() -> None:
    drive, truth = proven(1)
    curve = mine(drive).tables["battery"]

    drawn = (truth["charge"] - truth["charge_left"]) * truth["capacity_ah"]
    assert curve["charge_drawn_ah"][-1] == pytest.approx(drawn, rel=0.01)
    assert (np.diff(curve["charge_drawn_ah"]) > 0).all()
    assert (curve["open_low_v"] < curve["open_high_v"]).all()


def test_a_cell_that_drops_out_does_not_spoil_the_resistance() -> None:
    drive, truth = proven(3, "cell_dropout", "middle")

    ohm = truth["battery_resistance_ohm"]
    assert mine(drive).estimates["battery_resistance_ohm"].value == pytest.approx(ohm, rel=0.03)


def test_a_steady_current_says_nothing_of_the_resistance() -> None:
    drive = proven(0).drive
    steady = drive.samples.columns | {"vesc.current_input": np.full(len(drive.samples.times_us), 4.0)}
    mined = mine(replace(drive, samples=drive.samples._replace(columns=steady)))

    assert not mined.estimates
    assert "hardly changes" in mined.missing["battery_resistance_ohm"]
