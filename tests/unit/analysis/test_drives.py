"""A drive is cleaned of each fault, with the repair counted, and is brought onto one clock."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from iort_analysis.drives.building import build
from iort_analysis.drives.drive import FROZEN, GAP, OUTLIER, SAME_TIME, SENSOR_FAULT, motion_among
from iort_analysis.samples.blocks import Block, join
from tests.unit.analysis.simulated import HZ, KEY, START_US, VEHICLE, changed, streams


def test_a_healthy_drive_needs_no_repair() -> None:
    for seed in range(1, 4):
        assert build(KEY, streams(600 if seed == 1 else 120, seed), VEHICLE).repairs == []


@pytest.mark.parametrize(
    ("field", "where", "value", "kind"),
    [
        ("temperature_pcb", slice(1000, 1003), -273.1, SENSOR_FAULT),
        ("temperature_pcb", slice(None), -273.1, SENSOR_FAULT),
        ("current_motor", slice(2000, 3000), 7.31, FROZEN),
        ("voltage_input", slice(1500, 1501), 3.0, OUTLIER),
        ("speed", slice(1500, 1502), -90_000.0, OUTLIER),
    ],
)
def test_a_fault_is_repaired_and_counted(field: str, where: slice, value: float, kind: str) -> None:
    drive = build(KEY, changed(field, where, value), VEHICLE)
    bad = np.zeros(120 * HZ, dtype=bool)
    bad[where] = True

    (repair,) = drive.repairs

    assert (repair.kind, repair.stream, repair.field, repair.samples) == (kind, "vesc", field, bad.sum())
    # Where it was is told, and what was recorded is still there.
    times = drive.raw["vesc"].times_us[bad]
    assert (repair.start_us, repair.end_us) == (times[0], times[-1])
    assert (drive.raw["vesc"].columns[field][bad] == value).all()
    healthy = streams()["vesc"].columns[field]
    clean = drive.streams["vesc"].columns[field]
    assert np.array_equal(clean[~bad], healthy[~bad])
    if kind == OUTLIER:
        assert clean[bad] == pytest.approx(healthy[bad], rel=0.1)
    else:
        assert np.isnan(clean[bad]).all()


def test_a_pause_and_a_repeated_time_are_counted() -> None:
    vesc = streams()["vesc"]
    there = np.ones(len(vesc.times_us), dtype=bool)
    there[1000:1100] = False
    twice = join([vesc.take(there), vesc.take(slice(50, 60))])

    repairs = build(KEY, {"vesc": twice}).repairs

    assert Counter({one.kind: one.samples for one in repairs}) == {GAP: 100, SAME_TIME: 10}


def test_streams_come_onto_the_motor_controllers_clock() -> None:
    there = np.ones(120 * HZ // 2, dtype=bool)
    there[500:550] = False
    pose = streams()["pose"].take(there)
    drive = build(KEY, {"vesc": streams()["vesc"], "pose": pose}, VEHICLE)
    x, heading = drive.of("pose", "x"), drive.of("pose", "heading")

    times = drive.samples.times_us
    assert np.array_equal(times, streams()["vesc"].times_us)
    # At its own times a value is what it was, and between two it lies on the line.
    assert x[:1000:2] == pytest.approx(pose.columns["x"][:500])
    assert x[1] == pytest.approx(pose.columns["x"][:2].mean())
    # Nothing is known in a pause, and after the last sample.
    paused = (times > pose.times_us[499]) & (times < pose.times_us[500])
    assert np.isnan(x[paused]).all()
    assert np.isnan(x[-1])
    assert np.isnan(x).sum() == paused.sum() + 1
    # A turn through pi passes no 0.
    known = heading[:999]
    assert (np.abs(np.angle(np.exp(1j * np.diff(known)))) < 0.2).all()


@pytest.mark.parametrize(
    ("streams_of", "stream", "field", "least"),
    [
        ({"vesc": {"speed": 0.0}}, "vesc", "speed", 200),
        ({"board": dict.fromkeys(("speed", "voltage_input", "current_motor"), 0.0)}, "board", "speed", 200),
        ({"base": {"speed": 0.0}}, "base", "speed", 0.05),
        (
            {"cmd": {"drive.speed": 0.0}, "odom": {"twist.twist.linear.x": 0.0}},
            "odom",
            "twist.twist.linear.x",
            0.05,
        ),
        ({"gps": {"gnss_gVel": 0.0}, "a": {"linear.x": 0.0}}, "gps", "gnss_gVel", 0.05),
        ({"pose": {"x": 0.0, "groundspeed": 0.0}}, None, None, None),
    ],
)
def test_the_field_that_tells_of_motion_has_the_unit_of_its_stream(
    streams_of: dict, stream: str | None, field: str | None, least: float | None
) -> None:
    motion = motion_among(streams_of)
    told = (None, None, None) if motion is None else (motion.stream, motion.field, motion.least)
    assert told == (stream, field, least)


def test_derived_quantities_follow_the_car() -> None:
    drive = build(KEY, streams(), VEHICLE)
    speed, distance = drive.of("vesc", "speed_mps"), drive.of("vesc", "distance_m")
    slope, power = drive.of("vesc", "acceleration_mps2"), drive.of("vesc", "power_w")

    # The car's tachometer counts six in each of 60 electrical revolutions a minute.
    counted = streams()["vesc"].columns["distance_traveled"][-1] / 6 * 60 / VEHICLE.speed_to_erpm_gain
    assert distance[-1] == pytest.approx(counted, rel=0.01)
    assert speed[200] - speed[100] == pytest.approx(slope[100:200].mean() * 2, abs=0.2)
    assert power[0] == pytest.approx(streams()["vesc"].columns["current_input"][0] * 12.4, abs=2)


def test_an_odometry_is_a_position() -> None:
    turn = np.array([0.0, 1.0, 3.0])
    block = Block(
        START_US + np.arange(3) * 20_000,
        {
            "pose.pose.position.x": turn,
            "pose.pose.position.y": -turn,
            "pose.pose.orientation.x": np.zeros(3),
            "pose.pose.orientation.y": np.zeros(3),
            "pose.pose.orientation.z": np.sin(turn / 2),
            "pose.pose.orientation.w": np.cos(turn / 2),
        },
    )
    drive = build(KEY, {"odom": block})

    assert drive.pose == "odom"
    assert drive.of("odom", "heading") == pytest.approx(turn)
