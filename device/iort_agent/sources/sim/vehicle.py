"""The physics of a small electric car, such as F1TENTH's: motor, mass, battery, heat, steering and tyres.

The model is plausible, not exact. Speed, duty cycle, currents, voltages, counters and temperatures depend on
each other as on a real VESC, and energy is conserved, so that an analysis can be held against the parameters.
The car moves as a bicycle that slides where its tyres have no more grip.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass
from typing import Sequence

from iort_agent.common.schema import number, setting
from iort_agent.sources.sim.driver import HALL, Circuit, Driver, Grip, Pose, Wish, wrapped
from iort_agent.sources.sim.faults import Damage, FaultConfig
from iort_contract.catalog.derived import F1TENTH
from iort_contract.catalog.vesc import TACHOMETER_COUNTS

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


class Battery:
    """The battery's state and the VESC's counters of charge and energy, in ampere-hours and watt-hours."""

    def __init__(self, config: VehicleConfig) -> None:
        self._config = config
        self.charge = config.charge
        self.wear(1.0, 1.0)
        self._slow_v = 0.0
        self.current_a = 0.0
        self.open_v = self.voltage_v = config.cells * open_voltage(self.charge)
        self.drawn_ah = self.regen_ah = self.drawn_wh = self.regen_wh = 0.0

    def wear(self, resistance: float, capacity: float) -> None:
        """Multiply the new battery's resistances and capacity."""
        c = self._config
        self._resistance_ohm = c.battery_resistance_ohm * resistance
        self._slow_ohm = c.battery_slow_resistance_ohm * resistance
        self._capacity_ah = c.capacity_ah * capacity

    def step(self, watts: float, dt: float, *, lost_v: float = 0.0) -> None:
        """Give so many watts for ``dt`` seconds; ``lost_v`` is what a bad cell does not give."""
        self.open_v = self._config.cells * open_voltage(self.charge)
        source_v = max(0.1, self.open_v - self._slow_v - lost_v)
        # At the terminals V = source - I R and V I = watts; the root near no load is the real one.
        root = max(0.0, source_v**2 - 4 * self._resistance_ohm * watts)
        self.voltage_v = voltage_v = (source_v + math.sqrt(root)) / 2
        self.current_a = current_a = watts / voltage_v
        self._slow_v += (current_a * self._slow_ohm - self._slow_v) * min(
            1.0, dt / self._config.battery_slow_s
        )
        amp_hours = current_a * dt / 3600
        if amp_hours > 0:
            self.drawn_ah += amp_hours
            self.drawn_wh += amp_hours * voltage_v
        else:
            self.regen_ah -= amp_hours
            self.regen_wh -= amp_hours * voltage_v
        self.charge = min(1.0, max(0.0, self.charge - amp_hours / self._capacity_ah))


# Copper's resistance grows by this share a kelvin; the settings are at this temperature.
_COPPER_PER_K, REFERENCE_DEGC = 0.0039, 25.0
# The car's own wind doubles the cooling at this speed.
WIND_MPS = 5.0
# The logic warms the board before the drive begins.
_WARM_K = 3.0


class Heat:
    """The temperatures of motor and board."""

    def __init__(self, config: VehicleConfig) -> None:
        self._config = config
        self.motor_degc = config.ambient_degc
        self.board_degc = config.ambient_degc + _WARM_K

    def winding(self, ohm: float) -> float:
        """A winding's resistance now, from the one at 25 degC."""
        return ohm * (1 + _COPPER_PER_K * (self.motor_degc - REFERENCE_DEGC))

    def step(self, motor_w: float, board_w: float, speed_mps: float, cooling: float, dt: float) -> None:
        """Heat both for ``dt`` seconds; ``cooling`` is the share of their cooling that is left."""
        c = self._config
        wind = cooling * (1 + abs(speed_mps) / WIND_MPS)
        across_w = (self.motor_degc - self.board_degc) * c.motor_to_board_w_per_k
        motor_out_w = (self.motor_degc - c.ambient_degc) * c.motor_cooling_w_per_k * wind + across_w
        board_out_w = (self.board_degc - c.ambient_degc) * c.board_cooling_w_per_k * wind - across_w
        self.motor_degc += (motor_w - motor_out_w) / c.motor_heat_capacity_j_per_k * dt
        self.board_degc += (board_w - board_out_w) / c.board_heat_capacity_j_per_k * dt


_RAD_S_PER_ERPM = 2 * math.pi / 60
# A servo turns the wheels this fast.
_STEERING_RAD_PER_S = 3.2
# The driver uses this share of the tyres' grip; a corner leaves at least this share for driving and braking.
_USED_GRIP, _LEAST_GRIP = 0.9, 0.2
# Tyres that slide, and a pinion that slips, hold this share of what they held before.
_SLIDING = 0.85
# The share of the rotating mass that turns with the motor's shaft; the rest is beyond the pinion.
_ROTOR = 0.3


class Vehicle:
    """A car's state: `step` advances it, and `Sensors` measures it.

    ``speed_mps`` is the car's speed; ``wheel_mps`` is the motor's, converted with the nominal gain.
    """

    def __init__(
        self,
        config: VehicleConfig,
        seed: int,
        circuit: Circuit | None = None,
        *,
        faults: Sequence[FaultConfig] = (),
        pace: float = 1.0,
    ) -> None:
        self.config = config
        # Apart, so that the drive depends neither on its measurement nor on a fault's chances.
        driving, faulty = random.Random(seed), random.Random(seed + 3)  # noqa: S311 - no secrets
        self.damage = Damage(faults, faulty)
        self.battery, self.heat = Battery(config), Heat(config)
        self._flux_wb, self._newtons_per_amp = config.flux_linkage_wb, config.newtons_per_amp
        driver = Driver(circuit or Circuit(HALL), self._grip(), config.wheelbase_m, driving, pace=pace)
        self._driver, self.pose = driver, driver.start()
        self.speed_mps = self.wheel_mps = 0.0
        self._steering_rad = 0.0
        self.slips = False
        self.motor_a = 0.0
        self.vd_v = self.vq_v = 0.0
        self.counts = self.counts_abs = 0.0
        self.damage.begin()
        self._wear()

    def step(self, dt: float, wish: Wish | None = None) -> None:
        """Advance by ``dt`` seconds as wished, or as the driver does; at most 20 ms keep it steady."""
        c = self.config
        if wish is None:
            wish = self._driver.wish(self.pose, self.wheel_mps, dt)
        else:
            self._driver.leave()
        self._throttle(max(-c.max_speed_mps, min(c.max_speed_mps, wish.speed_mps)), dt)
        speed_mps, wheel_mps = self.speed_mps, self.wheel_mps
        self._accelerate(dt)
        mean_mps, mean_wheel_mps = (speed_mps + self.speed_mps) / 2, (wheel_mps + self.wheel_mps) / 2
        self._move(mean_mps, wish.steering_rad, dt)
        self._electrics(dt)
        counts = mean_wheel_mps * c.speed_to_erpm_gain / 60 * TACHOMETER_COUNTS * dt
        self.counts += counts
        self.counts_abs += abs(counts)
        self.damage.step(dt, self.motor_a, self.speed_mps, self.battery.current_a)
        if self.damage.begin():
            self._wear()

    @property
    def motor_resistance_ohm(self) -> float:
        """The resistance of a phase now, as the VESC sees it: winding, joints and MOSFETs."""
        c = self.config
        return (
            self.heat.winding(c.motor_resistance_ohm + self.damage.motor_resistance_ohm)
            + c.fet_resistance_ohm
        )

    def _wear(self) -> None:
        damage, c = self.damage, self.config
        self.mass_kg = c.mass_kg + damage.payload_kg
        self._rolling_n = c.rolling_resistance * damage.rolling * self.mass_kg * G_MPS2
        self.battery.wear(damage.battery_resistance, damage.capacity)

    def _grip(self) -> Grip:
        """What the driver plans with: motor and brakes at low speed, and the tyres in a corner."""
        c = self.config
        lateral = _USED_GRIP * c.friction * G_MPS2
        drive_n = c.max_current_a * self._newtons_per_amp * c.drivetrain_efficiency
        brake_n = c.max_brake_current_a * self._newtons_per_amp / c.drivetrain_efficiency
        losses_n = c.rolling_resistance * c.mass_kg * G_MPS2 + c.drivetrain_friction_n
        mass_kg = c.mass_kg + c.rotating_mass_kg
        return Grip(
            c.max_speed_mps,
            lateral,
            max(0.01, min(lateral, (drive_n - losses_n) / mass_kg)),
            max(0.01, min(lateral, (brake_n + losses_n) / mass_kg)),
        )

    def _throttle(self, target_mps: float, dt: float) -> None:
        """Set the motor current in proportion to the missing speed, and to hold it, within the limits.

        The controller knows the healthy car only, and the speed of its wheels.
        """
        c, speed_mps = self.config, self.wheel_mps
        wanted = (target_mps - speed_mps) * c.mass_kg * 4 / self._newtons_per_amp
        if target_mps:
            held = 0.5 * AIR_KG_PER_M3 * c.drag_area_m2 * target_mps**2
            held += c.rolling_resistance * c.mass_kg * G_MPS2 + c.drivetrain_friction_n
            wanted += math.copysign(held / c.drivetrain_efficiency / self._newtons_per_amp, target_mps)
        # Against the motion it brakes, as far as the car moves.
        forwards = c.max_current_a if speed_mps >= 0 else c.max_brake_current_a
        backwards = c.max_current_a if speed_mps <= 0 else c.max_brake_current_a
        wanted = max(-backwards, min(forwards, wanted))
        # The driver's foot needs a tenth of a second, and no current brakes a standing car.
        self.motor_a += (wanted - self.motor_a) * min(1.0, dt / 0.1)
        if speed_mps == 0 and self.motor_a * target_mps <= 0:
            self.motor_a = 0.0

    def _accelerate(self, dt: float) -> None:
        """Change the speeds of car and wheels, which are one as far as tyres and pinion hold."""
        c, damage = self.config, self.damage
        # A smaller tyre has more force, and less way.
        motor_n = self.motor_a * self._newtons_per_amp / damage.radius
        # The losses of the gears always work against the motion.
        force = motor_n * (
            c.drivetrain_efficiency if motor_n * self.wheel_mps >= 0 else 1 / c.drivetrain_efficiency
        )
        friction_n = c.drivetrain_friction_n + damage.friction_n + damage.drag_n
        before = self.speed_mps
        drag_n = 0.5 * AIR_KG_PER_M3 * c.drag_area_m2 * before**2
        if self.slips:
            self._slide(force, friction_n, drag_n, dt)
            return
        resisting_n = friction_n + self._rolling_n + drag_n
        if before == 0 and abs(force) <= resisting_n:
            self.wheel_mps = 0.0
            return
        way = math.copysign(1.0, before or force)
        acceleration = (force - way * resisting_n) / (self.mass_kg + c.rotating_mass_kg)
        after = before + acceleration * dt
        # A car that brakes to a stand stands.
        self.speed_mps = after = after if before * after >= 0 else 0.0
        tyre_n = force - way * friction_n - c.rotating_mass_kg * acceleration
        slip = tyre_n / (c.slip_stiffness * self.mass_kg * G_MPS2)
        self.wheel_mps = after * (1 + slip) / damage.radius
        self.slips = after != 0 and (abs(tyre_n) > self._traction_n() or abs(force) > damage.pinion_holds_n)

    def _slide(self, force: float, friction_n: float, drag_n: float, dt: float) -> None:
        """The motor turns in a pinion that slips, or with wheels that spin, until they hold again."""
        c, damage = self.config, self.damage
        traction_n, holds_n = self._traction_n(), damage.pinion_holds_n
        before, turned = self.speed_mps, self.wheel_mps * damage.radius
        way = math.copysign(1.0, before or force)
        faster = math.copysign(1.0, turned - before)
        if holds_n < traction_n:
            inertia_kg, held_n, tyre_n = (
                c.rotating_mass_kg * _ROTOR,
                holds_n,
                faster * holds_n * _SLIDING - way * friction_n,
            )
            motor_n = force - faster * holds_n * _SLIDING
        else:
            inertia_kg, held_n, tyre_n = c.rotating_mass_kg, traction_n, faster * traction_n * _SLIDING
            motor_n = force - way * friction_n - tyre_n
        turning = turned + motor_n / max(inertia_kg, 0.01) * dt
        # As fast as the battery's voltage turns it, and never the other way by braking.
        most = (
            0.95
            * self.battery.voltage_v
            / (math.sqrt(3) * self._flux_wb * c.speed_to_erpm_gain * _RAD_S_PER_ERPM)
        )
        turning = max(-most, min(most, turning)) if turned * turning >= 0 else 0.0
        after = before + (tyre_n - way * (self._rolling_n + drag_n)) / self.mass_kg * dt
        self.speed_mps = after if before * after >= 0 else 0.0
        self.wheel_mps = turning / damage.radius
        slip = held_n / (c.slip_stiffness * self.mass_kg * G_MPS2) * abs(self.speed_mps)
        self.slips = self.speed_mps != 0 and (turning - self.speed_mps) * faster > slip

    def _traction_n(self) -> float:
        """The force that the tyres hold along the car, beside what the corner needs."""
        c = self.config
        most = c.friction * G_MPS2
        lateral = self.speed_mps**2 * math.tan(self._steering_rad) / c.wheelbase_m
        left = 1 - (lateral / most) ** 2
        return self.mass_kg * most * (math.sqrt(left) if left > _LEAST_GRIP**2 else _LEAST_GRIP)

    def _move(self, speed_mps: float, steering_rad: float, dt: float) -> None:
        """Turn the wheels, and move along the arc of a bicycle, or of what the tyres hold."""
        c = self.config
        wanted = max(-c.max_steering_rad, min(c.max_steering_rad, steering_rad))
        most = _STEERING_RAD_PER_S * dt
        self._steering_rad += max(-most, min(most, wanted - self._steering_rad))
        curvature = math.tan(self._steering_rad) / c.wheelbase_m
        held = c.friction * G_MPS2 / max(speed_mps**2, 1e-9)
        turned = max(-held, min(held, curvature)) * speed_mps * dt
        x_m, y_m, heading = self.pose
        middle = heading + turned / 2
        self.pose = Pose(
            x_m + speed_mps * math.cos(middle) * dt,
            y_m + speed_mps * math.sin(middle) * dt,
            wrapped(heading + turned),
        )

    def _electrics(self, dt: float) -> None:
        """The voltages of field-oriented control without a direct current, the battery, and the heat."""
        c, motor_a = self.config, self.motor_a
        rad_s = self.wheel_mps * c.speed_to_erpm_gain * _RAD_S_PER_ERPM
        self.vq_v = rad_s * self._flux_wb + self.motor_resistance_ohm * motor_a
        self.vd_v = -rad_s * c.motor_inductance_h * motor_a
        self.battery.step(1.5 * self.vq_v * motor_a + IDLE_W, dt, lost_v=self.damage.lost_v)
        winding_w = 1.5 * motor_a**2 * (self.motor_resistance_ohm - c.fet_resistance_ohm)
        board_w = 1.5 * motor_a**2 * c.fet_resistance_ohm + IDLE_W
        self.heat.step(winding_w, board_w, self.speed_mps, self.damage.cooling, dt)
