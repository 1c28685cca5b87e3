"""The simulated car's physics, against closed forms."""

from __future__ import annotations

import math
from typing import Any, Iterator

import pytest

from iort_agent.sources.sim import ALL, Sensors
from iort_agent.sources.sim.driver import Wish
from iort_agent.sources.sim.vehicle import G_MPS2, IDLE_W, Battery, Heat, Vehicle, VehicleConfig, open_voltage
from iort_agent.sources.vesc_protocol import LAYOUTS

DT = 0.02
CAR = VehicleConfig()


def steps(vehicle: Vehicle, seconds: float, wish: Wish | None = None) -> Iterator[Vehicle]:
    for _ in range(round(seconds / DT)):
        vehicle.step(DT, wish)
        yield vehicle


def test_the_battery_gives_what_the_drive_uses_and_the_losses_are_heat() -> None:
    vehicle = Vehicle(CAR, 1)
    joules = dict.fromkeys(("battery", "shaft", "windings", "board", "moving"), 0.0)
    for car in steps(vehicle, 60):
        rad_s = car.wheel_mps * CAR.speed_to_erpm_gain * 2 * math.pi / 60
        winding = car.motor_resistance_ohm - CAR.fet_resistance_ohm
        joules["battery"] += car.battery.voltage_v * car.battery.current_a * DT
        joules["shaft"] += 1.5 * rad_s * CAR.flux_linkage_wb * car.motor_a * DT
        joules["windings"] += 1.5 * winding * car.motor_a**2 * DT
        joules["board"] += (1.5 * CAR.fet_resistance_ohm * car.motor_a**2 + IDLE_W) * DT
    used = joules["shaft"] + joules["windings"] + joules["board"]
    assert joules["battery"] == pytest.approx(used, rel=1e-3)
    # What the shaft gave is in the car's motion, and in its losses, which only take.
    moving = 0.5 * (CAR.mass_kg + CAR.rotating_mass_kg) * vehicle.speed_mps**2
    least_n = CAR.rolling_resistance * CAR.mass_kg * G_MPS2 + CAR.drivetrain_friction_n
    driven_m = vehicle.counts / 6 * 60 / CAR.speed_to_erpm_gain
    assert moving + least_n * driven_m < joules["shaft"] < moving + 2.5 * least_n * driven_m


def test_at_an_even_speed_the_motor_pushes_against_friction_and_drag_alone() -> None:
    vehicle = Vehicle(CAR, 1)
    for _ in steps(vehicle, 20, Wish(3.0, 0.0)):
        pass
    against_n = CAR.rolling_resistance * CAR.mass_kg * G_MPS2 + CAR.drivetrain_friction_n
    against_n += 0.5 * 1.2 * CAR.drag_area_m2 * vehicle.speed_mps**2
    assert vehicle.speed_mps == pytest.approx(3.0, rel=0.01)
    assert vehicle.motor_a * CAR.newtons_per_amp * CAR.drivetrain_efficiency == pytest.approx(
        against_n, rel=1e-3
    )


def test_a_battery_under_an_even_load_sags_at_once_and_then_slowly_to_the_sum_of_its_resistances() -> None:
    config = VehicleConfig(capacity_ah=1000, charge=0.5)
    battery = Battery(config)
    battery.step(100.0, DT)
    at_once = (battery.open_v - battery.voltage_v) / battery.current_a
    assert at_once == pytest.approx(config.battery_resistance_ohm, rel=0.01)
    for _ in range(round(10 * config.battery_slow_s / DT)):
        battery.step(100.0, DT)
    in_the_end = (battery.open_v - battery.voltage_v) / battery.current_a
    both = config.battery_resistance_ohm + config.battery_slow_resistance_ohm
    assert in_the_end == pytest.approx(both, rel=0.01)
    assert battery.voltage_v * battery.current_a == pytest.approx(100.0)


def test_the_open_voltage_falls_with_the_charge() -> None:
    curve = [open_voltage(i / 100) for i in range(101)]
    assert curve == sorted(curve)
    assert (curve[0], curve[50], curve[100]) == pytest.approx((3.0, 3.73, 4.2), abs=0.01)


def test_motor_and_board_warm_up_to_the_temperature_at_which_they_lose_their_heat() -> None:
    config = VehicleConfig(motor_to_board_w_per_k=0.0)
    heat = Heat(config)
    for _ in range(40_000):
        heat.step(3.0, 2.0, 5.0, 0.5, 1.0)
    # At 5 m/s the cooling is twice as good, and half of it is left.
    assert heat.motor_degc - config.ambient_degc == pytest.approx(3.0 / config.motor_cooling_w_per_k)
    assert heat.board_degc - config.ambient_degc == pytest.approx(2.0 / config.board_cooling_w_per_k)
    assert heat.winding(0.01) == pytest.approx(0.01 * (1 + 0.0039 * (heat.motor_degc - 25)))


def test_wheels_spin_where_the_tyres_have_no_grip_and_hold_again() -> None:
    slippery = VehicleConfig(friction=0.3)
    vehicle = Vehicle(slippery, 1)
    ratios = [car.wheel_mps / car.speed_mps for car in steps(vehicle, 3, Wish(5.0, 0.0)) if car.speed_mps]
    assert max(ratios) > 1.5
    # The tyres cannot push harder than their grip, and on a dry floor they do not spin.
    assert vehicle.speed_mps <= slippery.friction * G_MPS2 * 3
    assert ratios[-1] == pytest.approx(1.0, abs=0.05)
    assert all(car.wheel_mps < car.speed_mps * 1.1 for car in steps(Vehicle(CAR, 1), 60))


def test_all_fields_are_those_of_the_serial_line_and_agree_with_the_motor() -> None:
    vehicle = Vehicle(CAR, 1)
    sensors = Sensors(vehicle, 1, ALL)
    rows: list[dict[str, Any]] = [sensors.vesc() for _ in steps(vehicle, 60)]
    newest = LAYOUTS[max(LAYOUTS)]
    assert sorted(rows[0]) == sorted(number.name for number in newest.numbers)
    for row in rows[100::37]:
        rad_s = row["speed"] * 2 * math.pi / 60
        ohm = CAR.motor_resistance_ohm * (1 + 0.0039 * (row["temp_motor"] - 25)) + CAR.fet_resistance_ohm
        assert row["avg_vq"] == pytest.approx(rad_s * CAR.flux_linkage_wb + ohm * row["avg_iq"], abs=0.06)
        watts = 1.5 * (row["avg_vq"] * row["avg_iq"] + row["avg_vd"] * row["avg_id"]) + IDLE_W
        assert row["voltage_input"] * row["current_input"] == pytest.approx(watts, abs=4 + 0.04 * abs(watts))
        assert math.sqrt(3) * math.hypot(row["avg_vd"], row["avg_vq"]) / row[
            "voltage_input"
        ] == pytest.approx(abs(row["duty_cycle"]), abs=0.012)
