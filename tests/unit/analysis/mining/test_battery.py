"""The battery's parameters from a drive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from iort_agent.sources.sim.vehicle import open_voltage
from iort_analysis.drives.building import with_derived
from iort_analysis.mining.battery import Spent, charge, mine
from iort_contract.catalog.derived import F1TENTH
from iort_contract.messages.analysis import Estimate
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


@pytest.mark.parametrize("car", range(4))
def test_the_charge_and_the_range_that_are_left_hold_the_truth(car: int) -> None:
    drive, truth = proven(car)
    known = {"capacity_ah": truth["capacity_ah"], "cells": truth["cells"]}
    samples = with_derived(drive.samples, "vesc", F1TENTH)
    found = mine(replace(drive, known=known, samples=samples)).estimates

    left = found["battery_charge_left"]
    assert left.low < truth["charge_left"] < left.high
    assert left.high - left.low < 0.5
    share = truth["charge"] - truth["charge_left"]
    assert found["battery_drawn_share"].value == pytest.approx(share, rel=0.02)
    km = samples.columns["vesc.distance_m"][-1] / 1000
    ranged = found["battery_range_left_km"]
    assert ranged.low < km / share * truth["charge_left"] < ranged.high


@pytest.mark.parametrize("left", np.linspace(0.02, 0.99, 20))
def test_the_charge_holds_that_of_a_cell_with_another_curve(left: float) -> None:
    first, last = (
        Estimate(3 * open_voltage(at), 3 * open_voltage(at), 3 * open_voltage(at), "V")
        for at in (left + 0.01, left)
    )
    found, _ = charge(Spent(0.05, None, first, last), {"cells": 3, "capacity_ah": 5})
    assert found["battery_charge_left"].low <= left <= found["battery_charge_left"].high


def test_without_capacity_or_cells_nothing_is_said_of_what_is_left() -> None:
    drive = proven(0).drive
    missing = mine(replace(drive, known={"cells": 3.0})).missing
    assert missing["battery_charge_left"] == "needs capacity_ah of the battery: iort robots set"
    assert missing.keys() == {"battery_drawn_share", "battery_charge_left", "battery_range_left_km"}
    still = mine(replace(drive, known={"cells": 3.0, "capacity_ah": 5.0}))
    assert "speed in m/s" in still.missing["battery_range_left_km"]
    wrong = mine(replace(drive, known={"cells": 6.0, "capacity_ah": 5.0}))
    assert "for each of 6 cells" in wrong.missing["battery_charge_left"]
