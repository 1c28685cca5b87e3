"""The recordings of real cars: estimates that agree with what needs no model, and reasons for the rest."""

from __future__ import annotations

from bench.proof import recordings
from iort_analysis.drives.building import build
from iort_analysis.drives.drive import Drive
from iort_analysis.mining import battery, motor
from iort_analysis.samples.blocks import Block
from iort_contract.messages.analysis.findings import DriveKey
from tests.recordings import recording


def _drive(streams: dict[str, Block]) -> Drive:
    return build(DriveKey("real", 1, "recorded"), streams)


def test_the_rides_battery_agrees_with_the_step_as_the_throttle_is_let_go() -> None:
    drive = _drive(recordings.ride(recording(recordings.RIDE).parent))
    found = battery.mine(drive).estimates["battery_resistance_ohm"]
    step = recordings.step_ohm(drive)

    assert found.low < step.value < found.high
    assert step.low < found.value < step.high


def test_the_rides_motor_is_told_as_far_as_a_log_with_twelve_samples_a_second_can() -> None:
    drive = _drive(recordings.ride(recording(recordings.RIDE).parent))
    mined, fitted = motor.mine(drive), motor.fit_motor(drive)

    assert not isinstance(fitted, str)
    # A textbook's fit gives 0.16 ohm, five times what the motor shows as it stands under current.
    low, high = recordings.standing_ohm(drive)
    assert fitted.resistance.low < low < high < fitted.resistance.high
    assert "too far apart" in mined.missing["motor_resistance_ohm"]
    # While it coasts the log's speed is older than its voltage, and so higher.
    assert 1 < mined.estimates["motor_flux_linkage_wb"].value / recordings.coasting_wb(drive)[1] < 1.06


def test_a_bag_whose_currents_are_not_the_firmwares_gives_reasons_and_no_numbers() -> None:
    drive = _drive(recordings.f1tenth(recording(recordings.F1TENTH_BAG).parent))

    mined = motor.mine(drive)
    assert not mined.estimates
    assert "does not follow duty_cycle" in mined.missing["motor_resistance_ohm"]
