"""What a simulated car's VESC and its localisation measure: with noise, in their units and resolution."""

from __future__ import annotations

import math
import random

from iort_agent.common.schema import Rule, choice
from iort_agent.sources.sim.circuit import wrapped
from iort_agent.sources.sim.vehicle import Vehicle
from iort_contract.limits import Value

ROS1, ALL = "ros1", "all"
FIELDS: Rule = choice(ROS1, ALL)
# The noise of a position from a laser scanner on a map.
_NOISE_M, _NOISE_RAD = 0.01, 0.005
# A thermistor's noise, and that of the VESC's currents and voltages, before they are rounded.
_NOISE_K, _MOTOR_A, _BATTERY_A, _BATTERY_V, _MOTOR_V, _ERPM = 0.04, 0.08, 0.04, 0.02, 0.01, 12.0


class Sensors:
    """Samples of a car, with the ROS 1 driver's ``fields`` or all that a VESC sends on its serial line."""

    def __init__(self, vehicle: Vehicle, seed: int, fields: str = ROS1) -> None:
        self._vehicle, self._all = vehicle, fields == ALL
        # Apart, so that neither depends on how often the other is measured.
        self._chance, self._pose_chance, self._more = (random.Random(seed + i) for i in (1, 2, 4))  # noqa: S311 - noise

    def pose(self) -> dict[str, Value]:
        """The pose as a localisation on a map gives it, to the millimetre."""
        x_m, y_m, heading_rad = self._vehicle.pose
        noise = self._pose_chance.gauss
        return {
            "x": round(x_m + noise(0, _NOISE_M), 3),
            "y": round(y_m + noise(0, _NOISE_M), 3),
            "heading": round(wrapped(heading_rad + noise(0, _NOISE_RAD)), 3),
        }

    def vesc(self) -> dict[str, Value]:
        """The state of the VESC: the 13 fields of the ROS 1 driver's VescState, or those of firmware 6."""
        car, noise = self._vehicle, self._chance.gauss
        battery, rpm = car.battery, car.wheel_mps * car.config.speed_to_erpm_gain
        duty = math.copysign(math.sqrt(3) * math.hypot(car.vd_v, car.vq_v), car.vq_v) / battery.voltage_v
        sample: dict[str, Value] = {
            "voltage_input": round(battery.voltage_v + noise(0, _BATTERY_V), 1),
            "temperature_pcb": round(car.heat.board_degc + noise(0, _NOISE_K), 1),
            "current_motor": round(car.motor_a + noise(0, _MOTOR_A), 2),
            "current_input": round(battery.current_a + noise(0, _BATTERY_A), 2),
            "speed": float(round(rpm + (noise(0, _ERPM) if rpm else 0))),
            "duty_cycle": round(max(-0.95, min(0.95, duty)), 3),
            "charge_drawn": float(int(battery.drawn_ah * 1e4)),
            "charge_regen": float(int(battery.regen_ah * 1e4)),
            "energy_drawn": float(int(battery.drawn_wh * 1e4)),
            "energy_regen": float(int(battery.regen_wh * 1e4)),
            "displacement": float(int(car.counts)),
            "distance_traveled": float(int(car.counts_abs)),
            "fault_code": 0,
        }
        car.damage.measure(sample)
        return self._as_on_the_line(sample) if self._all else sample

    def _as_on_the_line(self, sample: dict[str, Value]) -> dict[str, Value]:
        """The sample with the motor's fields, too; the board's temperature is that of the MOSFETs."""
        car, noise = self._vehicle, self._more.gauss
        fet_degc = sample.pop("temperature_pcb")
        return {
            "temp_fet": fet_degc,
            "temp_motor": round(car.heat.motor_degc + noise(0, _NOISE_K), 1),
            **sample,
            "avg_id": round(noise(0, _MOTOR_A), 2),
            "avg_iq": sample["current_motor"],
            "pid_pos_now": 0.0,
            "controller_id": 0,
            "ntc_temp_mos1": fet_degc,
            "ntc_temp_mos2": fet_degc,
            "ntc_temp_mos3": fet_degc,
            "avg_vd": round(car.vd_v + noise(0, _MOTOR_V), 3),
            "avg_vq": round(car.vq_v + noise(0, _MOTOR_V), 3),
            "status": 0,
        }
