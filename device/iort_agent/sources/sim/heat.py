"""Two bodies that warm up and cool: the motor with its windings, and the VESC's board with its MOSFETs."""

from __future__ import annotations

from iort_agent.sources.sim.parameters import VehicleConfig

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
