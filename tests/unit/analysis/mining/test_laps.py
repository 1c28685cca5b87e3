"""Laps of the simulated car, against its true positions."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from iort_analysis import AnalysisError
from iort_analysis.mining import laps
from iort_analysis.mining.laps import Laps, compare, find_laps
from iort_analysis.mining.paths import path_of
from iort_analysis.results import attempt
from iort_analysis.samples.blocks import Block
from tests.unit.analysis.simulated import START_US, Driven, crossed_s, driven, sampled

_EARTH_M = 6_371_008.8


@cache
def ride() -> Driven:
    return driven(150)


def found(drive) -> Laps:
    by = find_laps(drive)
    assert isinstance(by, Laps), by
    return by


def without_pose(drive):
    return replace(drive, pose=None, streams={"vesc": drive.streams["vesc"]})


def test_laps_by_a_gate_are_the_true_ones_to_a_hundredth_of_a_second():
    laps_found = found(ride().drive)
    truth = crossed_s(ride(), *laps_found.gate)
    assert laps_found.method == "gate"
    assert laps_found.confidence == 1
    assert len(laps_found.time_s) == len(truth) - 1 >= 11
    assert laps_found.time_s == pytest.approx(np.diff(truth), abs=0.01)
    assert (laps_found.start_us - START_US) / 1e6 == pytest.approx(truth[:-1], abs=0.01)
    way = np.append(0, np.cumsum(np.hypot(np.diff(ride().x_m), np.diff(ride().y_m))))
    assert laps_found.distance_m == pytest.approx(np.diff(np.interp(truth, ride().seconds, way)), rel=0.01)


def test_the_intervals_of_the_best_and_the_mean_lap_hold_the_truth():
    mined = laps.mine(ride().drive)
    truth = np.diff(crossed_s(ride(), *found(ride().drive).gate))
    best, mean = mined.estimates["lap_best_s"], mined.estimates["lap_mean_s"]
    # The interval of the best lap is the noise of its time; three times its half width is five sigma.
    assert best.value == pytest.approx(truth.min(), abs=3 * (best.high - best.low) / 2)
    assert best.high - best.low < 0.03
    assert mean.low < truth.mean() < mean.high
    table = mined.tables["laps"]
    assert table["lap"][table["best"]] == [1 + truth.argmin()]
    assert mined.missing == {}


def test_the_energy_of_the_laps_is_that_of_the_counters():
    drive, by = ride().drive, found(ride().drive)
    seconds = (by.start_us - START_US) / 1e6
    used = drive.samples.columns["vesc.energy_drawn"] - drive.samples.columns["vesc.energy_regen"]
    counted = np.diff(np.interp([seconds[0], seconds[-1] + by.time_s[-1]], drive.seconds, used))[0] / 1e4
    assert by.energy_wh.sum() == pytest.approx(counted, rel=0.01)


def test_laps_by_the_pattern_of_the_drive_say_so_and_are_nearly_as_long():
    gate, pattern = found(ride().drive), found(without_pose(ride().drive))
    assert pattern.method == "pattern"
    assert 0.5 < pattern.confidence < 1
    assert len(gate.time_s) - 2 <= len(pattern.time_s) <= len(gate.time_s)
    assert np.median(pattern.time_s) == pytest.approx(np.median(gate.time_s), rel=0.02)
    assert np.median(pattern.distance_m) == pytest.approx(np.median(gate.distance_m), rel=0.02)
    # Bounds are worse known than by a gate, and the interval says so.
    assert pattern.jitter_s > 10 * gate.jitter_s


def test_laps_by_latitude_and_longitude_are_the_same():
    drive = ride().drive
    pose = drive.streams["pose"]
    gps = {
        "latitude": 48.1 + np.degrees(pose.columns["y"] / _EARTH_M),
        "longitude": 11.6 + np.degrees(pose.columns["x"] / _EARTH_M / math.cos(math.radians(48.1))),
    }
    by_gps = found(
        replace(drive, pose=None, streams={"vesc": drive.streams["vesc"], "fix": Block(pose.times_us, gps)})
    )
    # Another gate cuts the same way into other laps, of the same length.
    assert by_gps.distance_m.mean() == pytest.approx(found(drive).distance_m.mean(), rel=0.01)
    assert by_gps.time_s.mean() == pytest.approx(found(drive).time_s.mean(), rel=0.01)


def test_the_delta_time_of_two_laps_is_the_true_one_at_every_place():
    by = found(ride().drive)
    table = laps.mine(ride().drive).tables["lap_places"]
    delta = compare(table, 3, 7)
    assert delta["delta_s"][0] == 0
    assert delta["delta_s"][-1] == pytest.approx(by.time_s[6] - by.time_s[2], abs=0.001)
    # Half way round, at the reference lap's place there.
    reference = int(np.argmin(np.abs(by.time_s - np.median(by.time_s))))
    starts = (by.start_us - START_US) / 1e6
    middle = len(delta["place_m"]) // 2
    place_s = starts[reference] + by.places.since_s[reference, middle]
    x, y = (np.interp([place_s, place_s + 0.1], ride().seconds, v) for v in (ride().x_m, ride().y_m))
    passed = crossed_s(ride(), x[0], y[0], math.atan2(*np.diff(y), *np.diff(x)), 1.5)
    third, seventh = ((passed - starts[i])[passed > starts[i]][0] for i in (2, 6))
    assert delta["delta_s"][middle] == pytest.approx(seventh - third, abs=0.03)
    with pytest.raises(AnalysisError, match=r"lap must be from 1 to \d+, got 99"):
        compare(table, 3, 99)


def test_the_speed_at_a_place_is_the_motors_and_else_that_of_the_positions():
    drive = ride().drive
    by_motor = laps.mine(drive).tables["lap_places"]["speed_mps"]
    erpm = drive.samples.columns["vesc.speed"]
    assert by_motor.max() == pytest.approx(erpm.max() / drive.vehicle.speed_to_erpm_gain, rel=0.02)
    by_position = laps.mine(replace(drive, vehicle=None)).tables["lap_places"]["speed_mps"]
    assert np.median(np.abs(by_position - by_motor)) < 0.15


def wandering(seed: int) -> Driven:
    """A car that drives anywhere in a hall, at changing speeds."""
    chance, n = np.random.default_rng(seed), 6000
    heading = np.cumsum(np.cumsum(chance.normal(0, 0.004, n)) * 0.2)
    speed = 2 + np.convolve(chance.normal(0, 4, n), np.ones(100) / 100, "same")
    x, y = (np.cumsum(speed * each(heading)) / 50 for each in (np.cos, np.sin))
    # The walls of the hall reflect it.
    x, y = (20 * np.abs(v / 20 % 2 - 1) for v in (x, y))
    times_us = START_US + 20_000 * np.arange(n)
    vesc = {
        "speed": 4614 * speed,
        "current_motor": 3 * speed,
        "voltage_input": np.full(n, 12.0),
        "current_input": speed,
    }
    streams = {"vesc": Block(times_us, vesc), "pose": Block(times_us[::2], {"x": x[::2], "y": y[::2]})}
    return Driven(sampled(streams), np.arange(n) / 50, x, y)


@pytest.mark.parametrize("seed", range(5))
def test_a_drive_without_laps_says_so(seed):
    drive = wandering(seed).drive
    for each in (drive, without_pose(drive)):
        mined = laps.mine(each)
        assert mined.estimates == {}
        assert mined.missing["lap_best_s"].startswith("no laps: ")


def test_a_drive_without_position_and_motor_says_what_it_lacks():
    drive = ride().drive
    bare = replace(drive, pose=None, vesc=None, streams={})
    assert attempt(find_laps, bare) == "no stream has a position, and none has a motor's speed"


def test_a_lap_elsewhere_is_not_complete():
    drive = ride().drive
    pose = drive.streams["pose"]
    by = found(drive)
    # Three seconds on another way, up to 8 m aside.
    since_s = np.clip((pose.times_us - by.start_us[3]) / 1e6 - 4, 0, 3)
    moved = Block(
        pose.times_us, {**pose.columns, "y": pose.columns["y"] + 8 * np.sin(np.pi * since_s / 3) ** 2}
    )
    aside = found(replace(drive, streams={**drive.streams, "pose": moved}))
    assert np.flatnonzero(~aside.complete).tolist() == [3]


def received(degrees_of: dict[str, np.ndarray], **given) -> dict[str, np.ndarray]:
    """A receiver's fields of positions in metres."""
    return {
        "gnss_lat": 48.1 + np.degrees(degrees_of["y"] / _EARTH_M),
        "gnss_lon": 11.6 + np.degrees(degrees_of["x"] / _EARTH_M / math.cos(math.radians(48.1))),
        **given,
    }


def with_receiver(times_us, columns, **given):
    drive = ride().drive
    streams = {"vesc": drive.streams["vesc"], "gps": Block(times_us, columns)}
    return replace(drive, pose=None, streams=streams, **given)


@pytest.mark.parametrize("registered", [True, False])
def test_positions_that_jump_or_are_unsure_do_not_count(registered):
    """Two spells of another place, 5 km away; and one that the receiver itself calls unsure."""
    drive, chance = ride().drive, np.random.default_rng(1)
    pose = drive.streams["pose"]
    seconds, place = (pose.times_us - START_US) / 1e6, {name: pose.columns[name].copy() for name in "xy"}
    place["x"][(seconds > 20) & (seconds < 24) | (seconds > 60) & (seconds < 61)] += 5000
    unsure = (seconds > 90) & (seconds < 100)
    place["y"] += np.where(unsure, 0.4 * np.cumsum(chance.normal(0, 1, len(seconds)) * unsure), 0)
    columns = received(place, gnss_hAcc=np.where(unsure, 40.0, 0.02))
    known = {} if registered else {"vehicle": None}

    by = found(with_receiver(pose.times_us, columns, **known))

    usual = found(drive)
    assert np.median(by.time_s) == pytest.approx(np.median(usual.time_s), rel=0.02)
    assert by.distance_m.max() < 2 * usual.distance_m.max()
    assert by.complete.mean() >= 0.8


def test_positions_that_wander_while_the_car_stands_are_no_way():
    """A receiver that goes around in circles of 3 m, a metre a second, as the board is carried about."""
    times = START_US + 100_000 * np.arange(1500)
    turn = np.arange(1500) / 30
    place = {"x": 3 * np.cos(turn), "y": 3 * np.sin(turn)}
    drive = ride().drive
    slow = drive.samples._replace(
        columns={**drive.samples.columns, "vesc.speed": drive.samples.columns["vesc.speed"] / 100}
    )
    unsure = np.full(1500, 2.0)

    moved = attempt(path_of, with_receiver(times, received(place), samples=slow))
    wide = attempt(path_of, with_receiver(times, received(place, gnss_hAcc=unsure), vehicle=None))
    never = attempt(path_of, with_receiver(times, received(place, gnss_hAcc=20 * unsure)))

    assert "the positions of gps move 150 m, and the motor " in str(moved)
    assert "the positions of gps are within 8.48 m, and right to 2 m" in str(wide)
    assert "gps is right to 10 m at no time" in str(never)


def test_a_mean_that_may_be_below_zero_is_none():
    """Two laps of one track, of which the second has a long stop."""
    drive = ride().drive
    pose, by = drive.streams["pose"], found(drive)
    first = int(np.searchsorted(pose.times_us, by.start_us[0] - 500_000))
    last = int(np.searchsorted(pose.times_us, by.start_us[2] + 500_000))
    stop = int(np.searchsorted(pose.times_us, by.start_us[1] + 4_000_000))
    times = pose.times_us + np.where(np.arange(len(pose.times_us)) >= stop, 40_000_000, 0)
    part = Block(times, pose.columns).take(slice(first, last))
    mined = laps.mine(replace(drive, streams={"vesc": drive.streams["vesc"], "pose": part}, vehicle=None))

    assert mined.tables["laps"]["time_s"] == pytest.approx([by.time_s[0], by.time_s[1] + 40], abs=0.1)
    assert "lap_mean_s" not in mined.estimates
    assert mined.missing["lap_mean_s"].startswith("the laps differ too much: 2 of ")
    assert set(mined.tables["laps"]["confidence"]) == {0.5}
