"""The proof of the analysis: its drives are the same each time, and differ as cars and drives do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bench.proof import report
from bench.proof.fleet import Simulated, drive_of, fault_of, simulated
from bench.proof.judging import RIGHT, TRUTHS, Analysed, Car, coverage, detection, judge
from iort_agent.sources.sim.faults import KINDS as FAULTS
from iort_analysis.results import DriveResult, Event, Mined
from iort_contract.catalog.analysis import KINDS, PARAMETERS
from iort_contract.messages.analysis import Estimate

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


@pytest.mark.parametrize("kind", FAULTS)
def test_cars_take_a_sensors_fields_in_turns(kind):
    fields = {fault_of(car, kind, "weak").field for car in range(10)}
    assert fields == set(FAULTS[kind].by_field or ["voltage_input"])


SPEC = drive_of(0, 0, seconds=SECONDS)


def drive(*events: Event, **estimates: float) -> Analysed:
    """What an analysis says of a drive, with intervals of a tenth to either side."""
    found = {name: Estimate(value, 0.9 * value, 1.1 * value, "ohm") for name, value in estimates.items()}
    mined = Mined(estimates=found, events=events)
    result = DriveResult(SPEC.key, SPEC.key.start_us, 3000, {}, mined)
    return Analysed(result, {"battery_resistance_ohm": 0.03})


def event(kind: str) -> Event:
    return Event(kind, SPEC.key.start_us, SPEC.key.start_us, "vesc", ("speed",), kind)


def test_every_fault_of_the_simulator_has_a_right_finding_of_the_catalogue():
    assert RIGHT.keys() == FAULTS.keys()
    assert frozenset().union(*RIGHT.values()) <= KINDS.keys()


def test_a_fault_is_found_by_a_right_finding_only_and_a_healthy_car_has_none():
    """The harness must be able to fail: neither a healthy drive nor a wrong finding counts as found."""
    worn, stuck = ("worn_battery", "strong"), ("sensor_stuck", "strong")
    cars = [
        Car([], [drive()], {worn: drive(event("battery_worn")), stuck: drive(event("battery_worn"))}, []),
        Car([], [drive(event("tyre_flat"))], {worn: drive(), stuck: drive()}, []),
    ]
    judged = [judge(car) for car in cars]
    found = detection(judged)
    assert (found[worn].drives, found[worn].found, dict(found[worn].others)) == (2, 1, {})
    assert (found[stuck].drives, found[stuck].found, dict(found[stuck].others)) == (2, 0, {"battery_worn": 1})
    assert [[finding.kind for finding in car.false_alarms] for car in judged] == [[], ["tyre_flat"]]


def test_an_interval_beside_the_truth_does_not_cover_it():
    drives = [drive(battery_resistance_ohm=value) for value in (0.030, 0.031, 0.04, 0.02)]
    found = coverage([*drives, drive()])["battery_resistance_ohm"]
    assert (found.drives, found.share) == (4, 0.5)
    assert (found.unit, found.off[2]) == ("%", pytest.approx(100 / 3))


def test_every_truth_is_of_a_parameter_and_in_its_unit():
    truth = {**simulated(SPEC, None).truth, "seconds": SECONDS, "motor_sensor": 1.0}
    assert TRUTHS.keys() <= PARAMETERS.keys()
    assert all(np.isfinite(of(truth)) for of in TRUTHS.values())


def test_more_hours_cost_more_and_a_slower_analysis_takes_longer():
    once, twice, slow = (report.bill(*these, 600.0) for these in ((100, 2.0), (200, 2.0), (100, 20.0)))
    assert sum(twice.dollars.values()) == pytest.approx(2 * sum(once.dollars.values()))
    assert slow.seconds > once.seconds
    computing, reading = "Lambda, GB-second, Arm", "DynamoDB, read request unit, up to 4 KB"
    assert slow.dollars[computing] > once.dollars[computing]
    assert slow.dollars[reading] == once.dollars[reading]
