"""The proof of the analysis: its drives are the same each time, and differ as cars and drives do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bench.proof.cars import drive_of, fault_of
from bench.proof.drives import Simulated, simulated
from iort_agent.sources.sim.faults import KINDS

SECONDS = 60.0


def equal(a: Simulated, b: Simulated) -> bool:
    return a.truth == b.truth and all(
        np.array_equal(a.streams[name].times_us, b.streams[name].times_us)
        and all(np.array_equal(column, b.streams[name].columns[n]) for n, column in block.columns.items())
        for name, block in a.streams.items()
    )


def test_a_drive_is_the_same_when_it_is_made_again_and_when_it_was_kept(tmp_path):
    for car in (0, 1):
        spec = drive_of(car, 0, seconds=SECONDS)
        made = simulated(spec, tmp_path)
        assert equal(made, simulated(spec, tmp_path))
        assert equal(made, simulated(spec, None))
        assert not equal(made, simulated(drive_of(car, 1, seconds=SECONDS), None))
    assert len(list(tmp_path.iterdir())) == 2
    assert {len(block.times_us) for block in made.streams.values()} == {3000, 1200}


def test_cars_differ_more_than_the_drives_of_a_car_and_the_fault_changes_the_truth():
    def resistances(specs):
        return [spec.vehicle.battery_resistance_ohm for spec in specs]

    own = resistances(drive_of(3, number) for number in range(20))
    fleet = resistances(drive_of(car, 0) for car in range(20))
    assert np.std(own) < np.std(fleet) / 2
    healthy = drive_of(3, 0, seconds=SECONDS)
    worn = simulated(replace(healthy, faults=(fault_of(3, "worn_battery", "strong"),)), None)
    before = simulated(healthy, None).truth["battery_resistance_ohm"]
    assert worn.truth["battery_resistance_ohm"] == pytest.approx(2 * before)
    assert worn.truth["capacity_ah"] == pytest.approx(0.8 * healthy.vehicle.capacity_ah)


@pytest.mark.parametrize("kind", KINDS)
def test_cars_take_a_sensors_fields_in_turns(kind):
    fields = {fault_of(car, kind, "weak").field for car in range(10)}
    assert fields == set(KINDS[kind].by_field or ["voltage_input"])
