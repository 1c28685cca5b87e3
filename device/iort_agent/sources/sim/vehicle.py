"""The physics of a small electric car, such as F1TENTH's: motor, mass, battery, heat, steering and tyres.

The model is plausible, not exact. Speed, duty cycle, currents, voltage sag, counters and temperature depend
on each other as on a real VESC, so that a chart looks real. The car moves as a bicycle that slides where its
tyres have no more grip.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass

from iort_agent.common.schema import number, setting
from iort_agent.sources.sim.circuit import HALL, Circuit, Grip, wrapped
from iort_agent.sources.sim.driver import Driver, Pose, Wish
from iort_contract.catalog.derived import F1TENTH
from iort_contract.catalog.vesc import TACHOMETER_COUNTS
from iort_contract.limits import Value

_G = 9.81
_AMBIENT_DEGC = 24.0
# The power that the VESC's logic draws from the battery.
_IDLE_W = 1.5
# The board's heat capacity, and its cooling while the car stands.
_BOARD_J_PER_K, _BOARD_W_PER_K = 60.0, 0.25
# A servo turns the wheels this fast.
_STEERING_RAD_PER_S = 3.2
# The noise of a position from a laser scanner on a map.
_NOISE_M, _NOISE_RAD = 0.01, 0.005


@dataclass(frozen=True)
class VehicleConfig:
    """A car; the defaults are a 1:10 F1TENTH car with a three-cell battery."""

    mass_kg: float = setting(number(0.1, 5000, unit="kg"), 3.7)
    drag_area_m2: float = setting(number(0, 5, unit="m2, drag coefficient times area"), 0.03)
    rolling_resistance: float = setting(number(0, 0.5), 0.03)
    speed_to_erpm_gain: float = setting(number(1, 1e6, unit="erpm per m/s"), F1TENTH.speed_to_erpm_gain)
    pole_pairs: int = setting(number(1, 50, whole=True), 2)
    motor_kv: float = setting(number(1, 20_000, unit="rpm/V"), 3500.0)
    motor_resistance_ohm: float = setting(number(0.0001, 10, unit="ohm"), 0.03)
    drivetrain_efficiency: float = setting(number(0.1, 1), 0.85)
    max_current_a: float = setting(number(0.1, 1000, unit="A"), 40.0)
    max_brake_current_a: float = setting(number(0, 1000, unit="A"), 20.0)
    max_speed_mps: float = setting(number(0.1, 100, unit="m/s"), 6.5)
    wheelbase_m: float = setting(number(0.01, 20, unit="m"), 0.33)
    max_steering_rad: float = setting(number(0.01, 1.4, unit="rad"), 0.42)
    friction: float = setting(number(0.01, 5), 0.7)
    cells: int = setting(number(1, 100, whole=True), 3)
    capacity_ah: float = setting(number(0.01, 1000, unit="Ah"), 5.0)
    battery_resistance_ohm: float = setting(number(0, 10, unit="ohm"), 0.03)


class Vehicle:
    """A car's state: `step` advances it, `sample` is the report of its VESC, and `pose` where it is."""

    def __init__(self, config: VehicleConfig, seed: int, circuit: Circuit | None = None) -> None:
        self._config = config
        # Apart, so that the drive does not depend on how often it is measured.
        driving, self._chance, self._pose_chance = (random.Random(seed + i) for i in range(3))  # noqa: S311 - noise, not secrets
        # The motor's speed constant ties volts, newtons and m/s.
        self._volts_per_mps = config.speed_to_erpm_gain / config.pole_pairs / config.motor_kv
        rad_s_per_mps = config.speed_to_erpm_gain / config.pole_pairs * 2 * math.pi / 60
        self._newtons_per_amp = 60 / (2 * math.pi * config.motor_kv) * rad_s_per_mps
        self._lateral_mps2 = config.friction * _G
        driver = Driver(circuit or Circuit(HALL), self._grip(), config.wheelbase_m, driving)
        self._driver, self.pose = driver, driver.start()
        self._speed_mps = 0.0
        self._steering_rad = 0.0
        self._current_a = 0.0
        self._battery_a = 0.0
        self._charge_left = 0.97
        self._voltage = self._open_voltage()
        self._duty = 0.0
        self._board_degc = _AMBIENT_DEGC + 3.0
        self._counts = self._counts_abs = 0.0
        self._drawn_ah = self._regen_ah = self._drawn_wh = self._regen_wh = 0.0

    def step(self, dt: float, wish: Wish | None = None) -> None:
        """Advance by ``dt`` seconds as wished, or as the driver does; at most 20 ms keep it steady."""
        c = self._config
        if wish is None:
            wish = self._driver.wish(self.pose, self._speed_mps, dt)
        else:
            self._driver.leave()
        self._throttle(max(-c.max_speed_mps, min(c.max_speed_mps, wish.speed_mps)), dt)
        mean_mps = self._accelerate(dt)
        self._move(mean_mps, wish.steering_rad, dt)
        self._electrics(dt)
        counts = mean_mps * c.speed_to_erpm_gain / 60 * TACHOMETER_COUNTS * dt
        self._counts += counts
        self._counts_abs += abs(counts)

    def measured_pose(self) -> dict[str, Value]:
        """The pose as a localisation on a map gives it: with noise, to the millimetre."""
        x_m, y_m, heading_rad = self.pose
        noise = self._pose_chance.gauss
        return {
            "x": round(x_m + noise(0, _NOISE_M), 3),
            "y": round(y_m + noise(0, _NOISE_M), 3),
            "heading": round(wrapped(heading_rad + noise(0, _NOISE_RAD)), 3),
        }

    def sample(self) -> dict[str, Value]:
        """The 13 fields of the ROS 1 driver's VescState, in its units and resolution."""
        noise = self._chance.gauss
        erpm = self._speed_mps * self._config.speed_to_erpm_gain
        return {
            "voltage_input": round(self._voltage + noise(0, 0.02), 1),
            "temperature_pcb": round(self._board_degc + noise(0, 0.04), 1),
            "current_motor": round(self._current_a + noise(0, 0.08), 2),
            "current_input": round(self._battery_a + noise(0, 0.04), 2),
            "speed": float(round(erpm + (noise(0, 12) if erpm else 0))),
            "duty_cycle": round(self._duty, 3),
            "charge_drawn": float(int(self._drawn_ah * 1e4)),
            "charge_regen": float(int(self._regen_ah * 1e4)),
            "energy_drawn": float(int(self._drawn_wh * 1e4)),
            "energy_regen": float(int(self._regen_wh * 1e4)),
            "displacement": float(int(self._counts)),
            "distance_traveled": float(int(self._counts_abs)),
            "fault_code": 0,
        }

    def _grip(self) -> Grip:
        """The accelerations that motor and brakes reach at low speed, and the tyres in a corner."""
        c = self._config
        drive_n = c.max_current_a * self._newtons_per_amp * c.drivetrain_efficiency
        brake_n = c.max_brake_current_a * self._newtons_per_amp / c.drivetrain_efficiency
        rolling_n = c.rolling_resistance * c.mass_kg * _G
        return Grip(
            c.max_speed_mps,
            self._lateral_mps2,
            max(0.01, min(self._lateral_mps2, (drive_n - rolling_n) / c.mass_kg)),
            max(0.01, min(self._lateral_mps2, (brake_n + rolling_n) / c.mass_kg)),
        )

    def _throttle(self, target_mps: float, dt: float) -> None:
        """Set the motor current in proportion to the missing speed, and to hold it, within the limits."""
        c = self._config
        wanted = (target_mps - self._speed_mps) * c.mass_kg * 4 / self._newtons_per_amp
        if target_mps:
            held = math.copysign(self._resistance_n(target_mps), target_mps)
            wanted += held / c.drivetrain_efficiency / self._newtons_per_amp
        # Against the motion it brakes, as far as the car moves.
        forwards = c.max_current_a if self._speed_mps >= 0 else c.max_brake_current_a
        backwards = c.max_current_a if self._speed_mps <= 0 else c.max_brake_current_a
        wanted = max(-backwards, min(forwards, wanted))
        # The driver's foot needs a tenth of a second, and no current brakes a standing car.
        self._current_a += (wanted - self._current_a) * min(1.0, dt / 0.1)
        if self._speed_mps == 0 and self._current_a * target_mps <= 0:
            self._current_a = 0.0

    def _accelerate(self, dt: float) -> float:
        """Change the speed; returns the mean of before and after."""
        c, before = self._config, self._speed_mps
        force = self._current_a * self._newtons_per_amp
        # The losses of the gears always work against the motion.
        force *= c.drivetrain_efficiency if force * before >= 0 else 1 / c.drivetrain_efficiency
        resistance = self._resistance_n(before)
        if before == 0 and abs(force) <= resistance:
            return 0.0
        after = before + (force - math.copysign(resistance, before or force)) / c.mass_kg * dt
        # A car that brakes to a stand stands.
        self._speed_mps = after if before * after >= 0 else 0.0
        return (before + self._speed_mps) / 2

    def _resistance_n(self, speed_mps: float) -> float:
        """The drag of the air and of the wheels."""
        c = self._config
        return 0.5 * 1.2 * c.drag_area_m2 * speed_mps**2 + c.rolling_resistance * c.mass_kg * _G

    def _move(self, speed_mps: float, steering_rad: float, dt: float) -> None:
        """Turn the wheels, and move along the arc of a bicycle, or of what the tyres hold."""
        c = self._config
        wanted = max(-c.max_steering_rad, min(c.max_steering_rad, steering_rad))
        most = _STEERING_RAD_PER_S * dt
        self._steering_rad += max(-most, min(most, wanted - self._steering_rad))
        curvature = math.tan(self._steering_rad) / c.wheelbase_m
        held = self._lateral_mps2 / max(speed_mps**2, 1e-9)
        turned = max(-held, min(held, curvature)) * speed_mps * dt
        x_m, y_m, heading = self.pose
        middle = heading + turned / 2
        self.pose = Pose(
            x_m + speed_mps * math.cos(middle) * dt,
            y_m + speed_mps * math.sin(middle) * dt,
            wrapped(heading + turned),
        )

    def _electrics(self, dt: float) -> None:
        c = self._config
        motor_volts = self._speed_mps * self._volts_per_mps + self._current_a * c.motor_resistance_ohm
        watts = motor_volts * self._current_a + _IDLE_W
        # At the terminals V = open - I R and V I = watts; the root near no load is the real one.
        open_v = self._open_voltage()
        root = max(0.0, open_v**2 - 4 * c.battery_resistance_ohm * watts)
        self._voltage = (open_v + math.sqrt(root)) / 2
        self._battery_a = watts / self._voltage
        self._duty = max(-0.95, min(0.95, motor_volts / self._voltage))
        amp_hours = self._battery_a * dt / 3600
        if amp_hours > 0:
            self._drawn_ah += amp_hours
            self._drawn_wh += amp_hours * self._voltage
        else:
            self._regen_ah -= amp_hours
            self._regen_wh -= amp_hours * self._voltage
        self._charge_left = max(0.0, self._charge_left - amp_hours / c.capacity_ah)
        # The MOSFETs' resistance, a third of the motor's, heats the board.
        heat_w = self._current_a**2 * c.motor_resistance_ohm / 3 + _IDLE_W
        cooling_w = (self._board_degc - _AMBIENT_DEGC) * _BOARD_W_PER_K * (1 + abs(self._speed_mps) / 5)
        self._board_degc += (heat_w - cooling_w) / _BOARD_J_PER_K * dt

    def _open_voltage(self) -> float:
        """The voltage of a lithium-polymer battery at rest: a long flat stretch, then a knee."""
        left = self._charge_left
        return self._config.cells * (3.45 + 0.55 * left + 0.2 * left**8 - 0.45 * (1 - left) ** 12)
