"""The motor's parameters and what it moves, from a drive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from iort_analysis.drives.drive import Drive
from iort_analysis.mining import drivetrain, motor
from iort_analysis.mining.gain import with_gain
from iort_analysis.statistics.fitting import Fit
from iort_contract.catalog.derived import Vehicle
from tests.unit.analysis.proven import proven


def test_a_controller_that_reports_its_axes_gives_resistance_flux_and_inductance() -> None:
    drive, truth = proven(1)
    found = motor.mine(replace(drive, known={"pole_pairs": truth["pole_pairs"]})).estimates

    phase = truth["motor_resistance_ohm"] + truth["fet_resistance_ohm"]
    assert found["motor_resistance_25_ohm"].value == pytest.approx(phase, rel=0.01)
    assert found["motor_flux_linkage_wb"].value == pytest.approx(truth["flux_linkage_wb"], rel=0.001)
    assert found["motor_inductance_h"].value == pytest.approx(truth["motor_inductance_h"], rel=0.01)
    # A motor of so many rpm for a volt has so many newton metres for an ampere.
    torque = 60 / (2 * np.pi * truth["motor_kv"]) * np.sqrt(3) / 2
    assert found["motor_torque_nm_per_a"].value == pytest.approx(torque, rel=0.001)


def test_the_basic_fields_give_the_warm_resistance_and_the_flux() -> None:
    drive, truth = proven(0)
    mined = motor.mine(drive)

    resistance = mined.estimates["motor_resistance_ohm"]
    assert resistance.value == pytest.approx(truth["motor_resistance_now_ohm"], rel=0.01)
    assert mined.estimates["motor_flux_linkage_wb"].value == pytest.approx(
        truth["flux_linkage_wb"], rel=0.001
    )
    assert "pole pairs" in mined.missing["motor_torque_nm_per_a"]
    assert "avg_vd" in mined.missing["motor_inductance_h"]


def test_a_motor_in_six_step_control_is_not_taken_for_one_in_field_oriented_control() -> None:
    drive, truth = proven(0)
    columns = dict(drive.samples.columns)
    columns["vesc.current_input"] = columns["vesc.duty_cycle"] * columns["vesc.current_motor"]
    mined = motor.mine(replace(drive, samples=drive.samples._replace(columns=columns)))

    # Duty cycle times voltage is the voltage between two phases, in either mode.
    volts = np.sqrt(3) * truth["flux_linkage_wb"] * motor.RAD_S_PER_ERPM * 1000
    assert mined.estimates.keys() == {"motor_volts_per_krpm", "motor_volts_per_a"}
    assert mined.estimates["motor_volts_per_krpm"].value == pytest.approx(volts, rel=0.002)
    assert "1.00 of duty_cycle times current_motor" in mined.missing["motor_resistance_ohm"]


def _seen(car: int, dead_v: float, bend: float) -> tuple[Drive, float, float]:
    """A car's drive with a board's dead time, and a voltage that bends with the speed by a share; its flux
    linkage, and that of least squares."""
    drive, truth = proven(car)
    columns = dict(drive.samples.columns)
    speed, current = columns["vesc.speed"], columns["vesc.current_motor"]
    omega = speed * motor.RAD_S_PER_ERPM
    bent = truth["flux_linkage_wb"] * bend * omega * np.abs(omega) / np.nanmax(np.abs(omega))
    beyond = dead_v * np.tanh(current) - bent
    columns["vesc.duty_cycle"] = (
        columns["vesc.duty_cycle"] + np.sqrt(3) * beyond / columns["vesc.voltage_input"]
    )
    volts = columns["vesc.duty_cycle"] * columns["vesc.voltage_input"] / np.sqrt(3)
    if "vesc.avg_vq" in columns:
        volts = columns["vesc.avg_vq"] = columns["vesc.avg_vq"] + beyond
    usable = (np.abs(speed) > 500) & np.isfinite(volts)
    (flux, _), *_ = np.linalg.lstsq(np.stack([omega, current], axis=1)[usable], volts[usable])
    return replace(drive, samples=drive.samples._replace(columns=columns)), truth["flux_linkage_wb"], flux


@pytest.mark.parametrize("car", range(4))
@pytest.mark.parametrize(("dead_v", "bend"), [(0.0, 0.02), (0.2, 0.02), (-0.1, 0.04)])
def test_what_the_equations_leave_out_is_in_the_interval(car: int, dead_v: float, bend: float) -> None:
    drive, truth, plain = _seen(car, dead_v, bend)
    flux = motor.mine(drive).estimates["motor_flux_linkage_wb"]

    # At a stand the flux linkage is the truth; over all speeds it is what a plain fit says.
    assert flux.low < truth < flux.high
    assert flux.low < plain < flux.high
    assert flux.high - flux.low < 0.16 * truth
    healthy = motor.mine(proven(car).drive).estimates["motor_flux_linkage_wb"]
    assert healthy.high - healthy.low < 0.003 * truth


def test_a_drive_that_hardly_moves_tells_nothing_of_the_motor() -> None:
    for car in (0, 1):
        drive = proven(car).drive
        short = replace(drive, samples=drive.samples.take(slice(0, 16 * 50)))
        mined = motor.mine(short)
        assert not mined.estimates
        assert "needs 20 s of motion faster than 500 erpm, got 1" in mined.missing["motor_resistance_ohm"]


def test_a_resistance_with_an_interval_as_wide_as_itself_is_not_given() -> None:
    nothing = np.zeros((2, 2))

    def unknown(ohm: float, error: float) -> str:
        fitted = Fit(np.array([1e-3, ohm]), np.diag([1e-12, error**2]), np.zeros(9), 0.1, nothing, nothing)
        return motor.Motor(fitted, False, None).unknown_ohm

    assert unknown(0.06, 0.0015) == ""
    assert "as 0.0042 ohm from 0.0017 to 0.0067 only" in unknown(0.0042, 0.00145)
    assert unknown(-0.06, 0.0015) != ""


def test_mass_and_forces_follow_from_the_pose_and_the_electrical_fit() -> None:
    drive, truth = proven(0)
    found = drivetrain.mine(replace(drive, known={"mass_kg": truth["mass_kg"]})).estimates

    friction = truth["drivetrain_friction_n"] + truth["rolling_resistance"] * truth["mass_kg"] * 9.81
    assert found["speed_to_erpm_gain"].value == pytest.approx(truth["speed_to_erpm_gain"], rel=0.005)
    assert found["rotating_mass_kg"].value == pytest.approx(truth["rotating_mass_kg"], rel=0.05)
    assert found["friction_n"].value == pytest.approx(friction, rel=0.1)
    assert found["drivetrain_efficiency"].value == pytest.approx(truth["drivetrain_efficiency"], rel=0.01)
    assert found["brake_drag_n"].low < 0.05
    assert found["brake_drag_n"].high > -0.05


def test_a_payload_and_a_brake_that_drags_are_told_apart() -> None:
    healthy, heavier, braked = (
        drivetrain.mine(proven(0, fault, "middle").drive).estimates
        for fault in ("", "payload", "dragging_brake")
    )

    assert heavier["effective_mass_kg"].value - healthy["effective_mass_kg"].value == pytest.approx(
        0.9, abs=0.05
    )
    assert heavier["brake_drag_n"].value == pytest.approx(0, abs=0.2)
    assert braked["brake_drag_n"].value == pytest.approx(2.5, abs=0.3)
    assert braked["effective_mass_kg"].value == pytest.approx(healthy["effective_mass_kg"].value, rel=0.02)


def test_a_position_that_comes_from_the_motors_speed_is_no_second_source() -> None:
    drive = proven(0).drive
    seconds, speed = drive.seconds, drive.of("vesc", "speed")
    way = np.append(0, np.cumsum((speed[1:] + speed[:-1]) / 2 * np.diff(seconds))) / 4614.0
    odometry = drive.samples._replace(columns={"x": way, "y": 0 * way, "heading": 0 * way})
    mined = drivetrain.mine(replace(drive, streams={**drive.streams, "pose": odometry}))

    assert "calculated from the motor's speed" in mined.missing["speed_to_erpm_gain"]


@pytest.mark.parametrize(
    ("field", "noise_mps", "share"),
    [
        ("vesc.speed_meters_per_sec", 0.0, 0.03),
        ("gps.gnss_gVel", 0.05, 0.005),
        ("odom.twist.twist.linear.x", 0.0, 0.03),
    ],
)
def test_a_speed_in_the_log_is_a_second_source_of_the_gain(
    field: str, noise_mps: float, share: float
) -> None:
    """One that is calculated from the motor's own speed says what somebody has entered, and no more."""
    drive = replace(proven(0).drive, pose=None, vehicle=None)
    speed = drive.of("vesc", "speed")
    mps = speed / 1062 + np.random.default_rng(1).normal(0, noise_mps, len(speed))
    columns = {**drive.samples.columns, field: mps}
    streams = {"vesc": drive.streams["vesc"]}
    told = with_gain(replace(drive, streams=streams, samples=drive.samples._replace(columns=columns)))

    gain = drivetrain.mine(told).estimates["speed_to_erpm_gain"]
    assert gain.value == pytest.approx(1062, rel=1e-3)
    assert (gain.high - gain.low) / 2 / 1062 == pytest.approx(share, abs=0.005)
    assert told.of("vesc", "speed_mps") == pytest.approx(speed / told.vehicle.speed_to_erpm_gain)


def test_positions_without_a_heading_are_a_second_source_of_the_gain() -> None:
    drive, truth = proven(0)
    pose, chance = drive.streams["pose"], np.random.default_rng(1)
    # A receiver with half a metre's error that wanders slowly, on a track ten times as large.
    wander = np.cumsum(chance.normal(0, 0.01, (2, len(pose.times_us))), axis=1)
    degrees = {
        "lat": 48.1 + np.degrees((10 * pose.columns["y"] + wander[1]) / 6_371_008.8),
        "lon": 11.6
        + np.degrees((10 * pose.columns["x"] + wander[0]) / 6_371_008.8 / np.cos(np.radians(48.1))),
    }
    streams = {"vesc": drive.streams["vesc"], "gps": pose._replace(columns=degrees)}
    gain = drivetrain.mine(replace(drive, pose=None, streams=streams)).estimates["speed_to_erpm_gain"]

    assert gain.low < truth["speed_to_erpm_gain"] / 10 < gain.high
    assert gain.high - gain.low < 0.1 * gain.value


def test_what_no_car_has_is_refused_with_the_reason() -> None:
    drive, truth = proven(0)
    bare = replace(drive, pose=None, streams={"vesc": drive.streams["vesc"]})
    # Five times the gain is twenty-five times the mass.
    light = replace(
        bare, vehicle=Vehicle(truth["speed_to_erpm_gain"] * 5), known={"mass_kg": truth["mass_kg"]}
    )
    current = drive.samples.columns["vesc.current_motor"]
    columns = {**drive.samples.columns, "vesc.current_motor": np.where(current < 0, 2.5 * current, current)}
    strong = replace(drive, samples=drive.samples._replace(columns=columns))

    for wrong, name in ((light, "effective_mass_kg"), (strong, "drivetrain_efficiency")):
        mined = drivetrain.mine(wrong)
        assert not mined.estimates.keys() - {"speed_to_erpm_gain"}
        assert mined.missing["friction_n"].startswith(f"impossible: {name} would be ")
    unregistered = drivetrain.mine(replace(bare, vehicle=None, known={"speed_to_erpm_gain": 4614.0}))
    assert not unregistered.estimates
    assert "also if it is 4614, the default" in unregistered.missing["effective_mass_kg"]


def test_without_the_motors_flux_forces_are_known_for_each_kilogram() -> None:
    drive, truth = proven(0)
    columns = {name: column for name, column in drive.samples.columns.items() if "current_input" not in name}
    mined = drivetrain.mine(replace(drive, samples=drive.samples._replace(columns=columns)))

    kg = truth["mass_kg"] + truth["rotating_mass_kg"]
    found = mined.estimates["acceleration_per_a_mps2"].value
    assert found == pytest.approx(truth["newtons_per_amp"] / kg, rel=0.003)
    assert "control mode" in mined.missing["effective_mass_kg"]
