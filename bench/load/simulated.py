"""A simulated drive: the samples of a VESC, by the agent's own simulation of a car."""

from __future__ import annotations

from iort_agent.sources.sim import Sensors
from iort_agent.sources.sim.vehicle import Vehicle, VehicleConfig
from iort_contract.limits import Value

RATE_HZ = 50
# With larger steps the driver swerves.
_STEP_S = 0.02


def simulated_drive(count: int, *, rate_hz: float = RATE_HZ, after_s: float = 0.0) -> list[dict[str, Value]]:
    """Return so many samples of the same drive, from ``after_s`` on."""
    vehicle = Vehicle(VehicleConfig(), seed=1)
    for _ in range(round(after_s / _STEP_S)):
        vehicle.step(_STEP_S)
    samples, measured = [], Sensors(vehicle, seed=1)
    for _ in range(count):
        vehicle.step(min(_STEP_S, 1 / rate_hz))
        samples.append(measured.vesc())
    return samples
