"""The recordings of real cars: estimates that agree with what needs no model, and reasons for the rest."""

from __future__ import annotations

import math

import numpy as np
import statsmodels.api as sm

from bench.proof import recordings
from iort_analysis.drives.building import build
from iort_analysis.drives.drive import Drive
from iort_analysis.mining import battery, motor
from iort_analysis.process import MINERS
from iort_analysis.samples.blocks import Block
from iort_contract.messages.analysis import DriveKey
from tests.recordings import recording
from tests.unit.analysis.proven import proven


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
    assert "too far apart in time" in mined.missing["motor_resistance_ohm"]
    # While it coasts the log's speed is older than its voltage, and so higher.
    assert 1 < mined.estimates["motor_flux_linkage_wb"].value / recordings.coasting_wb(drive)[1] < 1.06


def _volts(drive: Drive) -> dict[str, np.ndarray]:
    """The phase's voltage as three sets of fields tell it."""
    direct, across, duty, battery = (
        drive.samples.columns[f"vesc.{name}"] for name in ("avg_vd", "avg_vq", "duty_cycle", "voltage_input")
    )
    return {"q": across, "length": np.hypot(direct, across), "duty": duty * battery / np.sqrt(3)}


def test_the_rides_flux_linkage_holds_what_independent_fits_say() -> None:
    drive = _drive(recordings.ride(recording(recordings.RIDE).parent))
    speed, amps = drive.samples.columns["vesc.speed"], drive.samples.columns["vesc.avg_iq"]
    omega = speed * motor.RAD_S_PER_ERPM
    flux = motor.mine(drive).estimates["motor_flux_linkage_wb"]

    turns = np.abs(speed) > 500
    design = np.stack([omega, amps, np.gradient(omega, drive.seconds)], axis=1)[turns]
    for name, volts in _volts(drive).items():
        robust = sm.RLM(volts[turns], design, M=sm.robust.norms.HuberT()).fit()
        assert flux.low < robust.params[0] < flux.high, name


def test_parts_of_the_ride_agree_within_their_intervals() -> None:
    streams = recordings.ride(recording(recordings.RIDE).parent)
    (name, block), *_ = streams.items()
    seconds = (block.times_us - block.times_us[0]) / 1e6
    agree = []
    for cut in np.arange(30.0, 45.0, 1.0):
        halves = [
            motor.mine(_drive({name: block.take(part)})).estimates["motor_flux_linkage_wb"]
            for part in (seconds < cut, seconds >= cut)
        ]
        apart = abs(halves[0].value - halves[1].value)
        agree.append(apart < math.hypot(*((one.high - one.low) / 2 for one in halves)))
    assert sum(agree) >= 0.85 * len(agree)


def test_no_interval_of_a_recording_or_a_simulated_drive_has_no_width() -> None:
    ride = _drive(recordings.ride(recording(recordings.RIDE).parent))
    for drive in (ride, proven(0).drive, proven(1).drive):
        for miner in MINERS.values():
            mined = miner(drive)
            assert {name for name, one in mined.estimates.items() if not one.low < one.high} == set()


def test_a_bag_whose_currents_are_not_the_firmwares_gives_reasons_and_no_numbers() -> None:
    drive = _drive(recordings.f1tenth(recording(recordings.F1TENTH_BAG).parent))

    mined = motor.mine(drive)
    assert not mined.estimates
    assert "does not follow duty_cycle" in mined.missing["motor_resistance_ohm"]
