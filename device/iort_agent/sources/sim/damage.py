"""What the faults in force have changed of a car, and what they do to it from moment to moment."""

from __future__ import annotations

import math
import random
from typing import MutableMapping, Sequence

from iort_agent.sources.sim.faults import FaultConfig
from iort_contract.limits import Value

# A dragging brake's force falls to 1/e in this time; it grips when the motor brakes with more than this.
_BRAKE_S, _BRAKE_FROM_A = 4.0, 2.0
# A cell drops out only under load.
_CELL_FROM_A = 3.0
_CELL_EVERY_S, _CELL_S = 10.0, (0.5, 3.0)
_CAN_GAP_S = (0.1, 0.5)
_DRIFT_S = 600.0
# A drifting value keeps the resolution of its sensor.
_DECIMALS = {"voltage_input": 1, "current_motor": 2, "temperature_pcb": 1}


class Damage:
    """The car's faults: `begin` those that are due, `step` those that come and go.

    The attributes without an underscore are what the faults change; a healthy car has their first values.
    """

    def __init__(self, faults: Sequence[FaultConfig], chance: random.Random) -> None:
        self._waiting = sorted(faults, key=lambda fault: fault.from_s)
        self._chance = chance
        self._now_s = 0.0
        self.battery_resistance = self.capacity = self.radius = self.rolling = self.cooling = 1.0
        self.friction_n = self.payload_kg = self.motor_resistance_ohm = 0.0
        self.pinion_holds_n = math.inf
        self.lost_v = 0.0
        self.drag_n = 0.0
        self.silent = False
        self._brake_n = self._cell_v = self._can_share = 0.0
        self._cell_until_s = self._can_until_s = 0.0
        self._sensors: list[FaultConfig] = []
        self._kept: dict[str, Value] = {}

    def begin(self) -> bool:
        """Put the faults into force that are due; whether there was one."""
        began = False
        while self._waiting and self._waiting[0].from_s <= self._now_s:
            self._apply(self._waiting.pop(0))
            began = True
        return began

    def step(self, dt: float, motor_a: float, speed_mps: float, battery_a: float) -> None:
        """Advance by ``dt`` seconds with the motor's current, the car's speed and the battery's current."""
        self._now_s = now = self._now_s + dt
        if self._brake_n:
            brakes = motor_a * speed_mps < 0 and abs(motor_a) > _BRAKE_FROM_A
            self.drag_n = self._brake_n if brakes else self.drag_n * math.exp(-dt / _BRAKE_S)
        if self._cell_v:
            if battery_a > _CELL_FROM_A and self._chance.random() < dt / _CELL_EVERY_S:
                self._cell_until_s = now + self._chance.uniform(*_CELL_S)
            self.lost_v = self._cell_v if now < self._cell_until_s else 0.0
        if self._can_share:
            often = self._can_share / (1 - self._can_share) / (sum(_CAN_GAP_S) / 2)
            if now >= self._can_until_s and self._chance.random() < often * dt:
                self._can_until_s = now + self._chance.uniform(*_CAN_GAP_S)
            self.silent = now < self._can_until_s

    def measure(self, sample: MutableMapping[str, Value]) -> None:
        """Change the fields of a sample whose sensors are wrong."""
        for fault in self._sensors:
            value = sample.get(fault.field)
            if not isinstance(value, (int, float)):
                continue
            since_s = self._now_s - fault.from_s
            if fault.kind == "sensor_drift":
                value += fault.value * min(1.0, since_s / _DRIFT_S)
                sample[fault.field] = round(value, _DECIMALS[fault.field])
            elif since_s < fault.value:
                sample[fault.field] = self._kept.setdefault(fault.field, value)

    def _apply(self, fault: FaultConfig) -> None:
        kind, value = fault.kind, fault.value
        if kind == "worn_battery":
            self.battery_resistance *= 1 + value
            self.capacity *= max(0.01, 1 - value / 5)
        elif kind == "added_friction":
            self.friction_n += value
        elif kind == "flat_tyre":
            self.radius *= 1 - value
            self.rolling *= 1 + 20 * value
        elif kind == "dragging_brake":
            self._brake_n += value
        elif kind == "cell_dropout":
            self._cell_v += value
        elif kind == "cooling_lost":
            self.cooling *= 1 - value
        elif kind == "loose_pinion":
            self.pinion_holds_n = min(self.pinion_holds_n, value)
        elif kind == "motor_resistance":
            self.motor_resistance_ohm += value
        elif kind == "payload":
            self.payload_kg += value
        elif kind == "intermittent_can":
            self._can_share = value
        else:
            self._sensors.append(fault)
