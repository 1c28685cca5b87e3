"""A lithium-polymer battery: an open voltage by charge, a resistance, and a slow one beside a capacitance."""

from __future__ import annotations

import math

from iort_agent.sources.sim.parameters import VehicleConfig, open_voltage


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
