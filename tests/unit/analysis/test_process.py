"""Every miner runs by itself, and a drive in any state gives a result that says what is missing."""

from __future__ import annotations

import math

import numpy as np
import statsmodels.api as sm

from bench.proof import recordings
from iort_analysis.drives.building import build
from iort_analysis.drives.drive import Drive
from iort_analysis.mining import battery, motor
from iort_analysis.process import MINERS, analyse
from iort_analysis.results import Event, Mined, encode_result
from iort_analysis.samples.blocks import EMPTY, Block, objects
from iort_contract.messages.analysis import DriveKey, Estimate
from tests.recordings import recording
from tests.unit.analysis.proven import proven
from tests.unit.analysis.simulated import KEY, START_US, VEHICLE, changed, streams

MASS = Estimate(3.7, 3.5, 3.9, "kg")


def test_a_miner_that_fails_does_not_stop_the_others() -> None:
    def fails(drive: Drive) -> Mined:
        return Mined(estimates={"mass": MASS._replace(value=drive.known["nobody knows"])})

    def finds(drive: Drive) -> Mined:
        at_us = drive.key.start_us
        return Mined(estimates={"mass": MASS}, events=[Event("odd", at_us, at_us, "vesc", (), "text")])

    def gives_up(_drive: Drive) -> Mined:
        return Mined(missing={"mass": "no hill", "drag": "too slow"})

    result = analyse(KEY, streams(), VEHICLE, miners={"a": fails, "b": finds, "c": gives_up})

    assert result.mined.estimates == {"mass": MASS}
    assert [event.kind for event in result.mined.events] == ["odd"]
    # What one miner found is not missing because another did not.
    assert result.mined.missing == {
        "a": "the miner failed: KeyError: 'nobody knows'",
        "drag": "too slow",
    }
    assert (result.samples, result.end_us) == (9000, START_US + 119_980_000)


def test_an_event_without_a_finite_effect_is_kept_without_it() -> None:
    def finds(drive: Drive) -> Mined:
        at_us, nothing = drive.key.start_us, MASS._replace(high=np.inf)
        return Mined(events=[Event("odd", at_us, at_us, "vesc", (), "text", nothing, p=np.nan)])

    (event,) = encode_result(analyse(KEY, streams(), VEHICLE, miners={"a": finds}))["events"]

    assert (event["effect"], event["p"]) == (None, 1.0)


def test_a_drive_in_any_state_has_a_result() -> None:
    times = START_US + np.arange(3) * 20_000
    texts = objects(["a", "b", None])
    cases = {
        "nothing": ({}, {"samples"}),
        "empty": ({"vesc": EMPTY}, {"samples"}),
        "few": ({"vesc": streams()["vesc"].take(slice(2))}, set()),
        "one": ({"vesc": streams()["vesc"].take(slice(1))}, set()),
        "null": (changed("current_motor", slice(None), np.nan), {"vesc.current_motor"}),
        "nulls": ({"log": Block(times, {"text": objects([None] * 3)})}, {"vesc", "log.text"}),
        "other": ({"log": Block(times, {"text": texts, "level": np.ones(3)})}, {"vesc"}),
        "flags": ({"bumper": Block(times, {"hit": np.array([True, False, True])})}, {"vesc"}),
    }
    for name, (given, missing) in cases.items():
        result = analyse(KEY, given, VEHICLE)

        assert {key for key in result.mined.missing if "." in key or key in {"samples", "vesc"}} == missing, (
            name
        )


def test_wild_values_are_repaired_and_named_where_they_are_too_many() -> None:
    healthy = analyse(KEY, streams(), VEHICLE).mined
    chance = np.random.default_rng(3)
    for share, is_named in ((0.02, False), (0.2, True)):
        vesc = streams()["vesc"]
        wild = chance.random(len(vesc.times_us)) < share
        current = np.where(wild, chance.uniform(-1e4, 1e4, len(wild)), vesc.columns["current_motor"])
        made = {**streams(), "vesc": Block(vesc.times_us, {**vesc.columns, "current_motor": current})}
        mined = analyse(KEY, made, VEHICLE).mined
        lost = healthy.estimates.keys() - mined.estimates.keys()
        assert ("motor_resistance_ohm" in lost) == bool(lost) == is_named
        assert all("% of vesc.current_motor are wild values" in mined.missing[name] for name in lost)
        if not is_named:
            before = healthy.estimates["motor_resistance_ohm"]
            assert before.low < mined.estimates["motor_resistance_ohm"].value < before.high


# The recordings of real cars: estimates that agree with what needs no model, and reasons for the rest.


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
