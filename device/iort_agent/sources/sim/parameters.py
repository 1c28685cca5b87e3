"""What a simulated car is made of: the settings under ``vehicle``, and the constants that follow."""

from __future__ import annotations

import math
from dataclasses import dataclass

from iort_agent.common.schema import number, setting
from iort_contract.catalog.derived import F1TENTH

G_MPS2 = 9.81
AIR_KG_PER_M3 = 1.2
# The power that the VESC's logic draws from the battery, and heats its board with.
IDLE_W = 1.5


@dataclass(frozen=True)
class VehicleConfig:
    """A car; the defaults are a 1:10 F1TENTH car with a three-cell battery.

    Forces, and masses of what turns, are those at the tyres. The motor runs in FOC: a winding's resistance
    is a phase's at 25 degC, and the MOSFETs' adds to it. The battery's resistance acts at once, and its slow
    resistance within ``battery_slow_s``. The air cools twice as well at 5 m/s as for a standing car.
    """

    mass_kg: float = setting(number(0.1, 5000, unit="kg"), 3.7)
    rotating_mass_kg: float = setting(number(0, 5000, unit="kg, inertia of motor, gears and wheels"), 0.35)
    drag_area_m2: float = setting(number(0, 5, unit="m2, drag coefficient times area"), 0.03)
    rolling_resistance: float = setting(number(0, 0.5), 0.03)
    drivetrain_friction_n: float = setting(number(0, 10_000, unit="N"), 1.0)
    drivetrain_efficiency: float = setting(number(0.1, 1), 0.93)
    speed_to_erpm_gain: float = setting(number(1, 1e6, unit="erpm per m/s"), F1TENTH.speed_to_erpm_gain)
    pole_pairs: int = setting(number(1, 50, whole=True), 2)
    motor_kv: float = setting(number(1, 20_000, unit="rpm/V"), 3500.0)
    motor_resistance_ohm: float = setting(number(0.0001, 10, unit="ohm"), 0.015)
    motor_inductance_h: float = setting(number(0, 0.1, unit="H"), 4e-6)
    fet_resistance_ohm: float = setting(number(0, 1, unit="ohm"), 0.005)
    motor_heat_capacity_j_per_k: float = setting(number(0.1, 1e7, unit="J/K"), 90.0)
    motor_cooling_w_per_k: float = setting(number(0.0001, 1e5, unit="W/K, standing"), 0.12)
    board_heat_capacity_j_per_k: float = setting(number(0.1, 1e7, unit="J/K"), 60.0)
    board_cooling_w_per_k: float = setting(number(0.0001, 1e5, unit="W/K, standing"), 0.25)
    motor_to_board_w_per_k: float = setting(number(0, 1e5, unit="W/K"), 0.01)
    max_current_a: float = setting(number(0.1, 1000, unit="A"), 45.0)
    max_brake_current_a: float = setting(number(0, 1000, unit="A"), 22.0)
    max_speed_mps: float = setting(number(0.1, 100, unit="m/s"), 6.5)
    wheelbase_m: float = setting(number(0.01, 20, unit="m"), 0.33)
    max_steering_rad: float = setting(number(0.01, 1.4, unit="rad"), 0.42)
    friction: float = setting(number(0.01, 5), 0.7)
    slip_stiffness: float = setting(number(1, 200, unit="share of the weight per share of slip"), 15.0)
    cells: int = setting(number(1, 100, whole=True), 3)
    capacity_ah: float = setting(number(0.01, 1000, unit="Ah"), 5.0)
    battery_resistance_ohm: float = setting(number(0, 10, unit="ohm"), 0.03)
    battery_slow_resistance_ohm: float = setting(number(0, 10, unit="ohm"), 0.015)
    battery_slow_s: float = setting(number(0.1, 10_000, unit="s"), 40.0)
    charge: float = setting(number(0.01, 1, unit="share of the capacity at the start"), 0.97)
    ambient_degc: float = setting(number(-40, 60, unit="degC"), 24.0)

    @property
    def flux_linkage_wb(self) -> float:
        """The motor's flux linkage, as VESC Tool has it."""
        return 60 / (2 * math.pi * math.sqrt(3) * self.motor_kv * self.pole_pairs)

    @property
    def newtons_per_amp(self) -> float:
        """The motor's force at the tyres, before the gears' losses."""
        motor_rad_per_m = self.speed_to_erpm_gain / self.pole_pairs * 2 * math.pi / 60
        return 1.5 * self.pole_pairs * self.flux_linkage_wb * motor_rad_per_m


def open_voltage(charge: float) -> float:
    """The voltage of a lithium-polymer cell at rest: a long flat stretch, then a knee."""
    return 3.45 + 0.55 * charge + 0.2 * charge**8 - 0.45 * (1 - charge) ** 12
